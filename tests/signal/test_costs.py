"""The cost model of `auto`: predicted ranking against measured, errors of what it chooses, and its
files."""

from __future__ import annotations

import itertools
import json
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from benchmarks.fit import fit

from benchmarks.measure import cpu_seconds
from benchmarks.synthesis import Job, relative
from isac_rt.cli.cli import main
from isac_rt.document import ScenarioError
from isac_rt.frame.waveform import SPEED_OF_LIGHT, Waveform, hann
from isac_rt.scenario.file import load, to_yaml
from isac_rt.signal.choice import (
    CANDIDATES,
    DIRECT,
    FAINT,
    NAMES,
    SHIPPED,
    CostModel,
    Cover,
    read,
)
from isac_rt.signal.covered import summed_share
from isac_rt.signal.gridded import COVERING, DEFAULT
from isac_rt.signal.methods import Auto, Direct, Exact, Gridded, _strongest
from isac_rt.signal.tones import tones_of
from isac_rt.simulation.plan import decisions
from isac_rt.simulation.setup import prepare

SCENES = Path(__file__).parents[2] / "scenes"
SHAPE = (3, 15, 120, 1024)


def decide(count: int, **more):
    """What is chosen for `count` equal paths of 7 m/s."""
    one, auto = np.ones(count), Auto(**({"noise_power": np.inf, "max_error": 1e-4} | more))
    return auto.choose(SHAPE, one, 7.0 * one, np.zeros(count, bool))


@pytest.mark.parametrize("size", [2, 40, 400])
def test_what_is_predicted_twice_as_dear_is_dearer(size):
    """Direct and every setting, least of five: new memory takes 6 ms at times, as long as a job.
    Planted bug: the elements left out of the direct method's cost."""
    job, model = Job(12), read(SHIPPED)
    links, shape = job.paths(size), (3, 15, 12, 1024)
    predicted = {name: model.seconds(name, shape, size) for name in NAMES}
    works = {c.name: (lambda c=c: job.samples(links, Gridded(c.setting))) for c in CANDIDATES}
    works |= {
        c.name + FAINT: (lambda c=c: job.samples(links, Gridded(c.setting, faint=True)))
        for c in CANDIDATES
        if c.setting.faint
    }
    works[DIRECT] = lambda: job.samples(links, Direct())
    measured = {n: min(cpu_seconds(work, 1) for _ in range(5)) for n, work in works.items()}
    clear = [(a, b) for a, b in itertools.permutations(NAMES, 2) if predicted[a] > 2 * predicted[b]]
    assert clear or size == 2
    assert [(a, b) for a, b in clear if measured[a] <= measured[b]] == []


@pytest.mark.parametrize("speed", [0.0, 15.0, 70.0, 180.0])
def test_the_choice_keeps_the_stated_error(speed):
    """40 paths as of 20,000, against the exact model; the settings' own bounds are above the truth,
    and by ten times at the most. Planted bug: `error > max_error` left out, so that fast paths are
    gridded (2e-4 where 1e-4 is stated)."""
    job = Job(3, speed=speed)
    links = job.paths(40)
    truth = job.samples(links, Exact())
    for stated in (1e-2, 3.5e-4, 1e-4, 1e-5, 1e-6):
        found = job.samples(links, Auto(noise_power=np.inf, max_error=stated, decide_for=20_000))
        assert relative(found, truth) < stated
    for candidate in CANDIDATES:
        error = relative(job.samples(links, Gridded(candidate.setting)), truth)
        assert error < candidate.error_at(np.array(speed)) < 10 * error


def test_few_paths_go_direct_and_many_are_gridded():
    """Planted bug: the costs of both compared the other way round."""
    assert decide(3).alone.all()
    setting, alone, _ = decide(1000)
    assert setting == DEFAULT
    assert not alone.any()
    coarse = decide(100_000, max_error=1e-3).setting
    assert coarse == CANDIDATES[0].setting  # width 4 for very many
    assert (
        decide(300, max_error=1e-3)[0] == CANDIDATES[1].setting
    )  # the smallest grid for some hundreds


def test_sights_fast_and_strong_paths_go_direct():
    """One of each among 500. Planted bug: `strong` and `sight` joined by `and`."""
    power, speed, sight = np.full(500, 1e-12), np.full(500, 3.0), np.zeros(500, bool)
    power[[7, 8, 9]], speed[20], sight[30] = (1.0, 2.0, 3.0), 300.0, True
    _, alone, _ = Auto(noise_power=1e-6, max_direct=2).choose(SHAPE, power, speed, sight)
    assert np.flatnonzero(alone).tolist() == [8, 9, 20, 30]


def test_noise_covers_what_a_cell_holds_together():
    """Twelve hundred paths in cells of one, one cell of forty of the same power, one strong path,
    one whose error is large and a line of sight: what is covered is known cell by cell, also where
    cells lie as far apart as those of transmitters whose clocks differ by a second. Planted bugs:
    the cell's sum taken for the path's own; one error for all paths; what they cost here left out;
    a sum for every cell of the span, a terabyte of them."""
    count, size = 1200, float(np.prod(SHAPE))
    cell, power = np.arange(count), np.full(count, 1e-9)
    cell[100:140], power[500], sight = 7, 1e-6, np.arange(count) == 600
    speed = np.full(count, 3.0)
    error = np.where(np.arange(count) == 700, 0.03, 3e-3)
    noise = 20 * 1e-9 * 3e-3**2 * size / 0.01  # twenty of the paths keep 20 dB under it
    cover = Cover(cell, error)
    choice = Auto(noise, covered=0.01).choose(SHAPE, power, speed, sight, cover)
    expected = (cell != 7) & (power < 1e-7) & ~sight & (np.arange(count) != 700)
    assert choice.setting == COVERING
    np.testing.assert_array_equal(choice.faint, expected)
    assert np.flatnonzero(choice.alone).tolist() == [600]
    apart = cover._replace(cell=cell * 10**8)
    far = Auto(noise, covered=0.01).choose(SHAPE, power, speed, sight, apart)
    np.testing.assert_array_equal(far.faint, expected)
    none = Auto(noise).choose(SHAPE, power, speed, sight, cover)
    assert not none.faint.any()
    dear = Auto(noise, covered=0.01).choose(SHAPE, power, speed, sight, cover._replace(dearer=9.0))
    assert dear.setting == DEFAULT


def test_what_covered_paths_cost_where_elements_send_seldom():
    """Sums are made for three chirps at a time: of four chirps of each element in twelve slots six,
    of twelve chirps twelve. Planted bug: the chirps' number over the sums'."""
    slots = 24
    for groups, num_tx, share in ((1, 3, 1.5), (3, 3, 1.0), (1, 12, 3.0), (2, 3, 9 / 8)):
        w = Waveform(num_chirps=slots, num_groups=groups, num_tx=num_tx)
        antenna = (np.arange(slots) + np.arange(groups)[:, None]) % num_tx
        tones = SimpleNamespace(rate=np.full(4, 1e-7), antenna=antenna[None])
        assert summed_share(w, tones, 1536) == pytest.approx(share)


def test_a_covered_cube_differs_by_less_than_its_noise():
    """A hundred paths against the exact model, each cell of the error under the noise by 20
    dB, all channels of a chirp in phase. Planted bug: the margin taken for an amplitude."""
    job = Job(3)
    links = job.paths(100)
    w, shape = job.waveform, (3, 15, 3, 1024)
    truth = job.samples(links, Exact())
    noise = float(np.mean(np.abs(truth) ** 2)) / 100 * np.prod(shape) * 3e-2
    auto = Auto(noise, covered=0.01, decide_for=20_000)
    error = job.samples(links, auto) - truth
    cells = np.abs(np.fft.fft(error * hann(np.arange(1024), 1024), axis=-1)) ** 2
    gain = 3 / 8 * w.num_samples
    assert relative(error + truth, truth) > 1e-3
    assert (cells.mean(axis=(0, 1, 2)) * 3 * 15 * 3).max() < 0.01 * noise * gain


def test_the_costs_decide():
    """With a made-up model whose direct method costs next to nothing. Planted bug: shipped costs
    whatever is given."""
    shipped = read(SHIPPED)
    free = CostModel("made up", shipped.chirp_ns | {DIRECT: 0.1}, shipped.path_ns | {DIRECT: 1e-3})
    assert decide(1000, costs=free).alone.all()
    assert decide(1000, decide_for=3).alone.all()
    job = Job(3)
    links = job.paths(30)
    found = job.samples(links, Auto(noise_power=np.inf, costs=free))
    np.testing.assert_array_equal(found, job.samples(links, Direct()))


def test_speed_is_the_largest_in_the_frame():
    """v = 11.3 m/s there and back, 40 m/s^2 over half of 7.2 ms. Planted bug: one way taken for
    two."""
    job = Job(3)
    tones = tones_of(job.waveform, job.paths(1), job.receiver, 0.0, 0)
    rate, accel = np.array([-2 * 11.3 / SPEED_OF_LIGHT]), np.array([2 * 40 / SPEED_OF_LIGHT])
    found = tones._replace(rate=rate, accel=accel).speed(7.2e-3)
    assert found[0] == pytest.approx(11.3 + 40 * 3.6e-3, rel=1e-12)


def test_a_fit_is_a_model(tmp_path, capsys, monkeypatch):
    """Thirty chirps, three times: the file is read, and 1000 paths are dearer one by one (35
    times). A run names it, by a path from where its scenario is saved. Planted bug: `record` of the
    shipped model whatever the scenario names."""
    monkeypatch.setattr("benchmarks.fit.fit", lambda progress: fit(30, 3, progress))
    file = tmp_path / "here" / "mine.json"
    assert main(["bench", "--fit", str(file)]) == 0
    assert "mine.json" in capsys.readouterr().out
    model = read(file)
    assert model.seconds(DIRECT, SHAPE, 1000) > model.seconds(CANDIDATES[2].name, SHAPE, 1000)
    (tmp_path / "s.yaml").write_text(
        (SCENES / "paper_swarm_consistent.yaml").read_text()
        + "\naccuracy:\n  cost_model: here/mine.json\n"
    )
    scenario = load(tmp_path / "s.yaml")
    record = decisions(prepare(scenario).plan)["cost_model"]
    assert record == model.record()
    assert record["source"] == "mine.json"
    assert "cost_model: ../here/mine.json" in to_yaml(scenario, tmp_path / "out")
    assert (
        decisions(prepare(load(SCENES / "paper_swarm_consistent.yaml")).plan)["cost_model"]
        == read(SHIPPED).record()
    )


def test_files_that_are_no_model(tmp_path):
    """Missing: told with the line of the key. Not JSON, another format, a cost of 0, a method
    missing: told with the file. Planted bug: `values > 0` left out."""
    text = (
        SCENES / "paper_swarm_consistent.yaml"
    ).read_text() + "\naccuracy:\n  cost_model: mine.json\n"
    (tmp_path / "s.yaml").write_text(text)
    with pytest.raises(ScenarioError, match=r"s\.yaml:\d+.*cost_model.*no such file"):
        load(tmp_path / "s.yaml")
    good = json.loads(SHIPPED.read_text())
    bad = [
        good | {"format": "other"},
        good | {"methods": good["methods"] | {DIRECT: {"chirp_ns": 1.0, "path_ns": 0.0}}},
    ]
    bad.append(good | {"methods": {k: v for k, v in good["methods"].items() if k != NAMES[2]}})
    for number, content in enumerate([*map(json.dumps, bad), "no JSON"]):
        file = tmp_path / f"{number}.json"
        file.write_text(content)
        with pytest.raises(ValueError, match=rf"{number}\.json.*isac-rt bench --fit"):
            read(file)
    (tmp_path / "mine.json").write_text("[]")
    with pytest.raises(ScenarioError, match=r"accuracy\.cost_model.*is no cost model"):
        prepare(load(tmp_path / "s.yaml"))


def test_the_strongest_paths_are_the_first_of_equal_ones():
    """Against a stable sort, with many ties. Planted bug: paths as strong as the weakest that goes
    direct are taken from the end."""
    rng = np.random.default_rng(3)
    for _ in range(300):
        power, count = rng.integers(0, 6, rng.integers(0, 12)).astype(float), rng.integers(0, 14)
        expected = np.zeros(power.size, bool)
        expected[np.argsort(-power, kind="stable")[:count]] = True
        assert _strongest(power, int(count)).tolist() == expected.tolist()
