"""Conventional sampling at the receiver, and its decision whether a scene is sparse enough for a
pseudo-random schedule."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from receiver_cubes import ANTENNAS, Path, cube

from isac_rt.frame.payload import random_payload, unmodulated
from isac_rt.frame.schedule import conventional_schedule, pseudo_random_schedule
from isac_rt.frame.waveform import Waveform
from isac_rt.receive.active import receive_active
from isac_rt.receive.chain import passive_detector_of
from isac_rt.receive.known import Known
from isac_rt.receive.maps import Conventional, LatinUnion, conventional_power, own_bins
from isac_rt.receive.omp import Omp, recovery_limit
from isac_rt.receive.passive import receive_passive
from isac_rt.receive.settings import Receivers
from isac_rt.receive.types import Prediction

FEW = replace(ANTENNAS, rx_x=2, rx_z=2)  # three receivers: what needs no aperture runs faster
SETTINGS = Receivers()
NOISE = 10.0  # per sample, 10 dB over each path


def short(groups: int) -> Waveform:
    return Waveform(num_samples=256, num_groups=groups)


def one_row(rng: np.random.Generator, w: Waveform, count: int) -> list[Path]:
    """Paths of one range and of velocities within an antenna's own unambiguous ones."""
    length, limit = rng.uniform(20, 100) * 2 * w.range_cell(2), 0.9 * w.max_velocity(2) / w.num_tx
    paths = []
    for _ in range(count):
        u = (float(rng.uniform(-0.4, 0.4)), float(rng.uniform(-0.4, 0.4)))
        paths.append(
            Path(length, 2 * rng.uniform(-limit, limit), np.exp(2j * np.pi * rng.random()), u, u)
        )
    return paths


def heard(
    w: Waveform,
    schedule: np.ndarray,
    paths: list[Path],
    seed: int,
    noise: float = NOISE,
    settings: Receivers = SETTINGS,
):
    payload = random_payload(w, schedule, 8, np.random.default_rng(seed))
    signal = cube(w, schedule, payload, paths, FEW, noise=noise, seed=seed)
    return receive_active(signal, payload, FEW, settings)


def test_method_follows_the_schedule():
    """Planted bug: a conventional schedule of two groups taken for random."""
    for groups, conventional, random in (
        (1, Conventional, Omp),
        (2, Conventional, Omp),
        (3, LatinUnion, LatinUnion),
    ):
        shuffled = pseudo_random_schedule(groups, 120, 3, np.random.default_rng(2))
        assert way(SETTINGS, conventional_schedule(groups, 120, 3)) is conventional
        assert way(SETTINGS, shuffled) is random
    named = Receivers(velocity_method="conventional")
    assert way(named, conventional_schedule(3, 120, 3)) is Conventional


def way(settings: Receivers, schedule: np.ndarray) -> type:
    """How the map of a frame with this schedule is made."""
    w = Waveform(num_groups=len(schedule))
    return type(
        passive_detector_of(settings).doppler_method(Known.unmodulated(w, schedule, FEW, 2))
    )


def test_conventional_map_is_each_antennas_own_transform():
    """Against sums written out. Planted bugs: the groups added before the power is taken, the tiles
    not centred."""
    w = Waveform(num_samples=64, num_chirps=24, num_groups=2)
    schedule = conventional_schedule(2, 24, 3)
    spectra = (
        np.random.default_rng(4)
        .standard_normal((2, 2, 5, 24, 2))
        .astype(np.float32)
        .view(np.complex64)[..., 0]
    )
    got = conventional_power(spectra, Known.unmodulated(w, schedule, FEW, 2))
    i = np.arange(8)
    window = np.sin(np.pi * (i + 0.5) / 8) ** 2
    for row, number in ((0, -12), (3, -1), (4, 7)):
        tone, power = np.exp(-2j * np.pi * number * i / 8), 0.0
        for m in range(2):
            for tx in range(3):
                for rx in range(2):
                    power += (
                        abs((spectra[m, rx, row, schedule[m] == tx] * window * tone).sum()) ** 2
                        / 12
                    )
        assert got[row, number + 12] == pytest.approx(power, rel=1e-5, abs=0)  # complex64
    assert own_bins(w).sum() == 8


@pytest.mark.parametrize("groups", [1, 2])
def test_a_conventional_schedule_measures_up_to_a_third_of_the_velocity(groups: int):
    """Range, velocity and direction within the limit; an echo beyond it is reported a whole period
    slower. Planted bugs: the limit of the full sampling."""
    w = short(groups)
    schedule, u, period = (
        conventional_schedule(groups, 120, 3),
        (0.23, -0.31),
        2 * w.max_velocity(2) / 3,
    )
    range_, slow, fast = 21.337, 3.271, 3.271 + period
    for speed in (slow, fast):
        payload = random_payload(w, schedule, 8, np.random.default_rng(5))
        signal = cube(
            w, schedule, payload, [Path(2 * range_, 2 * speed, 1.0, u, u)], noise=1e-4, seed=6
        )
        d = receive_active(signal, payload, ANTENNAS, SETTINGS).detections
        assert len(d) == 1
        # an alias is matched with the wrong migration, 2 Doppler cells per antenna of 18 in range
        # at most
        assert abs(d.range[0] - range_) < (2e-3 if speed == slow else w.range_cell(2) / 2)
        assert abs(d.velocity[0] - slow) < (1e-3 if speed == slow else 0.1 * w.velocity_cell(2))
        if speed == slow:
            assert np.abs(d.direction[0] - u).max() < 1e-3


def test_a_passive_terminal_reads_a_conventional_schedule_beyond_the_limit():
    """The prediction says which alias the reference is. Planted bug: the reference sought within
    the limit."""
    w = short(1)
    schedule, rng = conventional_schedule(1, 120, 3), np.random.default_rng(6)
    payload, rate = random_payload(w, schedule, 8, rng), 0.71 * w.max_velocity(1)
    signal = cube(w, schedule, payload, [Path(41.83, rate)], FEW, noise=0.1)
    ones = np.ones(1)
    expected = Prediction(
        range=41.85 * ones,
        velocity=(rate - 0.1) * ones,
        direction=np.zeros((1, 2)),
        range_std=0.03 * ones,
        velocity_std=0.1 * ones,
        weight=ones,
    )
    r = receive_passive(signal, FEW, SETTINGS, 8, expected, True)
    assert r.line_of_sight and np.array_equal(r.bits, payload.bits)
    assert abs(r.detections.velocity[0] - rate) < 0.1 * w.velocity_cell(1)


def test_groups_add_up_beyond_the_limit():
    """Two groups see an aliased path in phases of their own, antenna by antenna. Planted bug:
    responses added without turning."""
    w = short(2)
    schedule, pilot = conventional_schedule(2, 120, 3), unmodulated(w)
    signal = cube(w, schedule, pilot, [Path(41.83, 0.71 * w.max_velocity(1))], FEW, noise=1e-3)
    r = receive_passive(signal, FEW, SETTINGS, 8, None, False)
    assert r.line_of_sight
    assert r.reference_power == pytest.approx(1.0, rel=0.1)  # matched with the alias's migration


@pytest.mark.parametrize(
    ("count", "sparse"), [(0, True), (1, True), (3, True), (9, False), (14, False)]
)
@pytest.mark.parametrize("groups", [1, 2])
def test_receiver_decides_whether_the_scene_is_sparse(count: int, sparse: bool, groups: int):
    """40 random chirps of 120 recover 4 atoms. Planted bug: the limit without the logarithm."""
    w, rng = short(groups), np.random.default_rng([count, groups])
    assert recovery_limit(40, 120) == 4
    schedule, paths = pseudo_random_schedule(groups, 120, 3, rng), one_row(rng, w, count)
    assert heard(w, schedule, paths, 7).sparse is sparse
    # a conventional frame says the same of the scene, so that there is a way back
    assert heard(w, conventional_schedule(groups, 120, 3), paths, 7).sparse is sparse


def test_noise_does_not_make_a_scene_dense():
    """Two paths, each weaker in a chirp of their range cell than the noise. Planted bug: noise
    counted as unexplained."""
    w, rng = short(1), np.random.default_rng(11)
    r = heard(w, pseudo_random_schedule(1, 120, 3, rng), one_row(rng, w, 2), 7, noise=500.0)
    assert len(r.detections) and r.sparse is True


@pytest.mark.slow
@pytest.mark.parametrize("groups", [1, 2])
def test_fall_back_pays_where_the_rule_asks_for_it(groups: int):
    """Hits of schemes (d) and (c) on the same scenes against the paths in a range row, with the
    share of frames called sparse: where the rule says sparse (d) by OMP loses nothing, where it
    says not (c) is at least as good. Pursuit, the default, is better than both. Run with -s for the
    table."""
    w, trials = short(groups), 24
    hits = np.zeros((2, 3))  # (sparse, way)
    paths_seen = np.zeros(2)
    print(f"\n{groups} group(s)\npaths  hits (d) omp, (c), (d) pursuit  sparse")
    for count in (1, 3, 4, 5, 6, 9, 14):
        found, verdicts = np.zeros(3), []
        for trial in range(trials):
            rng = np.random.default_rng([count, trial])
            paths = one_row(rng, w, count)
            random, even = (
                pseudo_random_schedule(groups, 120, 3, rng),
                conventional_schedule(groups, 120, 3),
            )
            by_omp = Receivers(velocity_method="omp")
            ways = ((random, by_omp), (even, SETTINGS), (random, SETTINGS))
            all_ = [heard(w, s, paths, trial, settings=by) for s, by in ways]
            one = np.array([sum(_hit(r.detections, p, w) for p in paths) for r in all_])
            assert all_[0].sparse == all_[2].sparse
            verdicts.append(bool(all_[0].sparse))
            found += one
            hits[int(verdicts[-1])] += one
            paths_seen[int(verdicts[-1])] += count
        print(f"{count:5d}", (found / count / trials).round(3), f"{np.mean(verdicts):6.2f}")
    rate = hits / paths_seen[:, None]
    spread = np.sqrt(0.25 / paths_seen)  # binomial, at most
    assert rate[1, 0] > rate[1, 1] - 2 * spread[1]
    assert rate[0, 1] > rate[0, 0] - 2 * spread[0]
    assert (rate[:, 2] >= rate[:, :2].max(axis=1)).all()


def _hit(detections, path: Path, w: Waveform) -> bool:
    near = np.abs(detections.range - path.length / 2) < w.range_cell(2)
    return bool((near & (np.abs(detections.velocity - path.rate / 2) < w.velocity_cell(2))).any())
