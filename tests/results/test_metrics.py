"""Scores on hand-made cases."""

from __future__ import annotations

from dataclasses import replace
from itertools import permutations

import numpy as np
import pytest

from isac_rt.frame.antennas import Antennas, Arrays, resolutions
from isac_rt.frame.link import Link
from isac_rt.frame.payload import random_payload, unmodulated
from isac_rt.frame.schedule import conventional_schedule
from isac_rt.frame.waveform import Waveform
from isac_rt.receive.types import Reception, no_detections
from isac_rt.results.metrics import (
    SymbolCount,
    assigned,
    binomial_interval,
    count_symbols,
    gospa,
    score_tracks,
    truth_of,
    within_view,
)
from isac_rt.results.sensing import ERROR_KEYS, Sensing, summary_block
from isac_rt.world.swarm import Pose, attitude

WAVEFORM = Waveform()
ANTENNAS = Antennas(tx_x=2, tx_z=2, rx_x=8, rx_z=8, spacing=0.5774 * WAVEFORM.wavelength)
SMALL = Waveform(num_samples=64, num_chirps=12, num_groups=2)


def pose(position, velocity, boresight=(0.0, 1.0, 0.0)) -> Pose:
    return Pose(
        np.array(position, float),
        np.array(velocity, float),
        np.zeros(3),
        attitude(np.array(boresight)),
    )


def test_truth_one_way_and_bistatic():
    """A 3-4-5 triangle in a body frame that looks east; planted bug: azimuth towards -X."""
    observer = pose([1.0, 2.0, 3.0], [0.0, 0.5, 0.0], (1.0, 0.0, 0.0))
    uav = pose([5.0, 5.0, 3.0], [2.0, 0.5, 0.0])
    t = truth_of(observer, uav)
    # east is ahead (Y), south is right (X): 4 m ahead, 3 m to the left
    assert t == pytest.approx((5.0, 1.6, -0.6, 0.0, -np.arctan2(3, 4), 0.0), abs=1e-14)
    at = pose([5.0, 5.0, 15.0], [0.0, 0.0, 2.0])
    t = truth_of(observer, uav, at)
    assert t.range == pytest.approx(17.0) and t.velocity == pytest.approx(1.6 + 2.0)
    assert t.u_x == pytest.approx(-0.6)


def test_truth_rate_is_the_derivative_of_the_length():
    h = 1e-4
    poses = [
        ([1.3, 2.1, 3.7], [3.1, -2.7, 0.9]),
        ([15.1, 25.3, 8.8], [-4.1, 7.3, 1.1]),
        ([-21.7, 9.3, 33.1], [6.1, 2.9, -0.3]),
    ]
    ahead, behind = (
        [pose(np.array(p) + s * h * np.array(v), v) for p, v in poses] for s in (1, -1)
    )
    rate = (truth_of(*ahead).range - truth_of(*behind).range) / (2 * h)
    assert truth_of(*(pose(p, v) for p, v in poses)).velocity == pytest.approx(
        rate, abs=1e-7
    )  # h^2 and 80 m eps / h


def test_resolutions_of_table_one():
    """Published (notes, section 1): cells of range and velocity, and 16 or 8 elements at 0.5774
    wavelengths."""
    assert resolutions(WAVEFORM, ANTENNAS, 2) == pytest.approx(
        [0.24983, 0.249, 0.10824, 0.10824], rel=2e-3
    )
    assert resolutions(WAVEFORM, ANTENNAS, 1) == pytest.approx(
        [0.49965, 0.498, 0.21649, 0.21649], rel=2e-3
    )


def reception(payload, delay, transitions, bits, decoded=True) -> Reception:
    return Reception(
        detections=no_detections(),
        decoded=decoded,
        delay_symbols=delay,
        transitions=transitions,
        bits=bits,
        delay_confidence=np.ones(delay.shape),
        transition_confidence=np.ones(transitions.shape),
        raw_delay_symbols=delay,
        line_of_sight=True,
        reference_power=1.0,
    )


def test_symbol_counts():
    """Two wrong delay symbols of which one is erased, three wrong transitions, four wrong bits; the
    frame is erased with as many errors where its check fails; an undecoded frame is all errors; a
    pilot counts nothing; check sums are no payload. Planted bug: erased symbols left out of the
    errors."""
    schedule = conventional_schedule(2, 12, 3)
    p = random_payload(SMALL, schedule, 8, np.random.default_rng(2))
    delay, transitions, bits = p.delay_symbols.copy(), p.transitions.copy(), p.bits.copy()
    delay[0, 3], delay[1, 7] = -1, (delay[1, 7] + 1) % 32
    transitions[0, 1, :3] = (transitions[0, 1, :3] + 1) % 8
    bits[[1, 5, 9, 20]] ^= 1
    one, size = count_symbols(p, reception(p, delay, transitions, bits)), p.bits.size - 8
    assert one == SymbolCount(24, 2, 1, 18, 3, 0, size, 4, size, 1)
    failed = replace(reception(p, delay, transitions, bits), intact=False)
    assert count_symbols(p, failed) == SymbolCount(24, 2, 24, 18, 3, 18, size, 4, 0, 1)
    blank = np.zeros(0, np.uint8)
    lost = count_symbols(
        p, reception(p, np.full((2, 12), -1), np.full((2, 3, 3), -1), blank, decoded=False)
    )
    assert lost == SymbolCount(24, 24, 24, 18, 18, 18, size, size, 0, 1)
    pilot = unmodulated(SMALL)
    assert (
        count_symbols(pilot, reception(pilot, delay, transitions, blank, decoded=False))
        == SymbolCount()
    )
    block = summary_block("passive", Sensing.of_nothing(3), one + lost, duration=0.1)
    assert block["ser_delay"] == pytest.approx(26 / 48) and block["ser_dpsk"] == pytest.approx(
        21 / 36
    )
    assert block["ber"] == pytest.approx((4 + size) / (2 * size))
    assert block["erased"] == pytest.approx((1 + 24 + 18) / 84)
    assert block["bits"] == size and block["bit_rate_bps"] == pytest.approx(size / 0.1)
    assert block["hit_rate"] is None and block["rmse"] == dict.fromkeys(ERROR_KEYS)


def test_gospa_closed_forms():
    """Equal sets, one pair, a pair beyond the cut-off, cardinality alone. Planted bug: c^2
    instead of c^2/2 for a missed target."""
    c, x = 5.0, np.array([[1.3, 2.7, 0.4], [11.1, 3.3, 7.9]])
    assert gospa(x, x[::-1], c).distance == 0.0
    assert gospa(x[:1], x[:1] + np.array([3.0, 0.0, 4.0 - 1e-9]), c).distance == pytest.approx(5.0)
    assert gospa(x[:1], x[:1] + 100.0, c) == pytest.approx((5.0, 0.0, 12.5, 12.5))
    assert gospa(x, np.zeros((0, 3)), c).distance == pytest.approx(np.sqrt(2 * 12.5))
    assert gospa(np.zeros((0, 3)), np.zeros((0, 3)), c).distance == 0.0


def test_targets_are_scored_among_all_uavs():
    """Random tracks and UAVs, half of them scored, by trying every assignment to all UAVs: pairs of
    scored UAVs and tracks that are near nobody else make GOSPA. Planted bugs: tracks of the others
    left in; tracks assigned to the scored alone; near UAVs of one kind alone make a track true."""
    rng, stolen = np.random.default_rng(8), 0
    for _ in range(40):
        uavs, tracks = rng.normal(0, 4, (4, 3)), rng.normal(0, 5, (4, 3))
        scored = np.array([True, True, False, False])
        d2 = ((tracks[:, None] - uavs) ** 2).sum(axis=-1)
        best = min(
            permutations(range(4)), key=lambda p: sum(min(d2[k, u], 25.0) for k, u in enumerate(p))
        )
        pairs = {k: u for k, u in enumerate(best) if d2[k, u] < 25}
        mine = [k for k, u in pairs.items() if scored[u]]
        left = [k for k in range(4) if k not in pairs and (d2[k, 2:] >= 25).all()]
        found, false = score_tracks(tracks, uavs, scored)
        parts = sum(d2[k, pairs[k]] for k in mine), 12.5 * (2 - len(mine)), 12.5 * len(left)
        assert found[1:] == pytest.approx(parts)
        assert false.tolist() == (d2 >= 25).all(axis=1).tolist()
        stolen += found[1:] != gospa(uavs[scored], tracks, 5.0)[1:]
    assert stolen > 10


def test_one_track_stands_for_one_uav():
    """Two UAVs near one track, and two tracks near one UAV of two. Planted bug: each takes its
    nearest."""
    assert assigned(np.array([[1.0], [0.5]]), 3.0) == [(1, 0)]
    assert assigned(np.array([[0.1, 0.2], [2.9, 0.1]]), 3.0) == [(0, 0), (1, 1)]
    assert assigned(np.array([[0.1, 0.2], [0.3, 3.0]]), 3.0) == [(0, 1), (1, 0)]
    assert assigned(np.zeros((0, 2)), 3.0) == []


def test_both_fields_of_view_count():
    """A UAV before the receiver and behind the transmitter is not in view, and the other way round;
    between the two it is. The transmitter itself is in view of a receiver that it illuminates.
    Planted bugs: one of the two ends left out."""
    at, pt = pose([0, 0, 9], [0, 0, 0]), pose([3, 40, 9], [0, 0, 0], (0, -1, 0))
    between, behind_at, behind_pt = (
        pose([x, y, 9], [0, 0, 0]) for x, y in ((1, 20), (1, -20), (1, 70))
    )
    places = {"between": between, "behind_at": behind_at, "behind_pt": behind_pt}
    away = pose([0, 0, 9], [0, 0, 0], (0, -1, 0))
    turned = pose([3, 40, 9], [0, 0, 0])

    def seen(receiver: str, name: str, at: Pose = at, pt: Pose = pt) -> bool:
        poses = {"at": at, "pt": pt, **places}
        return within_view(Arrays(ANTENNAS), Link("at", receiver), poses, name)

    assert seen("pt", "between")
    assert not seen("pt", "behind_at")
    assert not seen("pt", "behind_pt")
    assert seen("at", "between") and seen("at", "behind_pt")
    assert not seen("at", "behind_at")
    assert seen("pt", "at")
    assert not seen("pt", "at", at=away)
    assert not seen("pt", "at", pt=turned)


def test_binomial_interval():
    """Closed form at none and at all of n."""
    assert binomial_interval(0, 37) == pytest.approx((0.0, 1 - 0.025 ** (1 / 37)))
    assert binomial_interval(37, 37) == pytest.approx((0.025 ** (1 / 37), 1.0))
