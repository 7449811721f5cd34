"""Statistical clutter against the laws that the paper states, and as a run sees it."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from scipy import stats

from isac_rt.document import ScenarioError
from isac_rt.frame.link import Link
from isac_rt.propagation.clutter.rayleigh import rayleigh_cells
from isac_rt.propagation.pathset import PathKind
from isac_rt.propagation.settings import Clutter
from isac_rt.scenario.file import load
from isac_rt.simulation.setup import prepare, trace

SCENES = Path(__file__).parents[2] / "scenes"
C = 299_792_458.0
AT_CELL, PT_CELL = 0.249827, 0.499654  # c T~ / (2 B T) and twice that, of the paper's settings
DRAWS = 400


def draws(range_cell=AT_CELL, **keys):
    rng = np.random.default_rng(20)
    return [
        rayleigh_cells(Clutter(model="rayleigh", **keys), range_cell, rng) for _ in range(DRAWS)
    ]


def test_extent_and_centre():
    """40 to 50 consecutive cells, every number with probability 1/11; the centre uniform over
    20..30 m (half a cell of rounding). Planted bug: `rng.integers(low, high)`, which never draws
    50."""
    every = draws()
    counts = np.array([r.size for r, _ in every])
    assert set(counts) == set(
        range(40, 51)
    )  # 400 draws miss one of 11 with probability 11 (10/11)^400 = 3e-16
    for r, _ in every:
        assert np.array_equal(np.diff(np.round(r / AT_CELL)), np.ones(r.size - 1))
    middle = np.array(
        [(np.round(r[0] / AT_CELL) + np.round(r[-1] / AT_CELL)) / 2 * AT_CELL for r, _ in every]
    )
    assert middle.min() > 20 - AT_CELL
    assert middle.max() < 30 + AT_CELL
    assert stats.kstest(middle, stats.uniform(20, 10).cdf).pvalue > 1e-4


def test_a_run_before_the_first_cell_begins_there():
    """Around 11.31 m, within a cell; a run that would begin before cell 1 begins there and keeps
    its length. Planted bug: cut at 0."""
    for r, _ in draws(centre_m=[11.31, 11.31], cells=[41, 41]):
        assert np.round(r / AT_CELL).mean() * AT_CELL == pytest.approx(11.31, rel=0, abs=AT_CELL)
    for r, _ in draws(PT_CELL, centre_m=[11.31, 11.31], cells=[48, 48]):
        assert r.size == 48
        assert round(r[0] / PT_CELL) == 1


def test_places_are_uniform_in_their_cells():
    """Planted bug: offsets within half of the cell."""
    offset = np.concatenate([r / AT_CELL - np.round(r / AT_CELL) for r, _ in draws()])
    assert stats.kstest(offset, stats.uniform(-0.5, 1).cdf).pvalue > 1e-4


def scene(*overrides, frames=4):
    return load(
        SCENES / "paper_swarm_consistent.yaml",
        ["clutter.model=rayleigh", *overrides],
        frames=frames,
    )


def diffuse(scenario, frame, link):
    paths = trace(scenario, frame)[link]
    return paths.select(paths.kind == PathKind.DIFFUSE)


@pytest.mark.parametrize(("link", "passes"), [(("AT", "AT"), 2), (("AT", "PT1"), 1)])
def test_paths_of_a_run(link, passes):
    """In every link: delays of the run, no Doppler whatever flies (exact), level over the reference
    path's amplitude, directions in view. Planted bug: one pass for an echo."""
    s = scene("clutter.centre_m=[24, 24]", "clutter.cells=[45, 45]")
    setup = prepare(s)
    frame = setup.frame(0)
    poses, found = frame.poses, frame.paths[link]
    d = found.select(found.kind == PathKind.DIFFUSE)
    cell = {2: AT_CELL, 1: PT_CELL}[passes]
    where = d.delay * C / passes
    assert len(d) == 45
    where = np.round(where / cell) * cell
    assert where.mean() == pytest.approx(24, rel=0, abs=0.5 * cell + 1e-3)
    assert np.ptp(where) == pytest.approx(44 * cell, rel=1e-5, abs=0)
    assert not d.delay_rate.any()
    assert not d.delay_accel.any()
    power = (np.abs(d.gain) ** 2).mean() / setup.reference.reference_amplitude(poses, link) ** 2
    assert power == pytest.approx(
        10, rel=5 / np.sqrt(45), abs=0
    )  # mean of 45 exponentials, 5 sigma
    assert setup.antennas.in_view(poses[link[0]].to_body(d.departure)).all()
    assert setup.antennas.in_view(poses[link[1]].to_body(d.arrival)).all()
    assert np.array_equal(d.departure, d.arrival) == (
        passes == 2
    )  # an echo comes back from where it was sent to


def test_draws_repeat_from_the_seed_and_by_frame():
    """Exact. Planted bug: the epoch left out of the name of the generator."""
    link = ("AT", "PT1")
    anew, again = diffuse(scene(), 1, link), diffuse(scene(), 1, link)
    assert np.array_equal(anew.gain, again.gain)
    assert not np.array_equal(anew.delay[:40], diffuse(scene(), 2, link).delay[:40])
    assert not np.array_equal(anew.delay[:40], diffuse(scene("seed=77"), 1, link).delay[:40])


def test_every_link_has_a_draw_of_its_own():
    """Two transmitters at one receiver, one at two, and both ways. Planted bugs: the transmitter,
    or the receiver, left out of the name of the generator."""
    setup = prepare(scene())
    links = [Link(*ends) for ends in (("AT", "PT1"), ("PT2", "PT1"), ("AT", "PT2"), ("PT1", "AT"))]
    found = setup.propagation.trace(setup.swarm.poses(0.0), 0.0, links).paths
    phases = [
        np.angle(found[link].gain[found[link].kind == PathKind.DIFFUSE])[:40] for link in links
    ]
    for i, one in enumerate(phases):
        assert all(np.abs(one - other).min() > 0 for other in phases[:i])


def test_gaussian_clutter_is_noise_beside_the_noise():
    """A link's noise power with clutter 3.2 dB over the thermal noise, in both noise models; exact.
    Planted bug: the clutter instead of the sum."""
    for model in ("snr", "link_budget"):
        levels = []
        for clutter in (
            ["clutter.model=none"],
            ["clutter.model=gaussian", "clutter.clutter_to_noise_db=3.2"],
        ):
            overrides = [f"noise.model={model}", *clutter]
            if model == "link_budget":
                overrides += [f"swarm.{name}.rcs.model=constant" for name in ("AT", "PT1", "PT2")]
            setup = prepare(load(SCENES / "paper_swarm_consistent.yaml", overrides, frames=4))
            levels.append(setup.noise_power(setup.swarm.poses(0.0), Link("AT", "PT1")))
        assert levels[0] > 0
        assert levels[1] / levels[0] == pytest.approx(1 + 10**0.32, rel=1e-12, abs=0)


def test_bounds_in_the_wrong_order_are_refused():
    with pytest.raises(ScenarioError, match=r"cells.*\[40, 50\]"):
        scene("clutter.cells=[50, 40]")
