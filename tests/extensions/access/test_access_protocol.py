"""The stages before the data, end to end on the IF signal: who finds whom, and what goes wrong when
they cannot hear each other."""

from __future__ import annotations

import numpy as np
import pytest

from isac_rt.extensions.access.ook import Message
from isac_rt.extensions.access.protocol import Network, _Air, establish
from isac_rt.extensions.street.emitters import Arrival, Train, add_foreign
from isac_rt.frame.antennas import Antennas, Arrays
from isac_rt.frame.clock import Clock
from isac_rt.frame.cube import ReceiveArray, Reference
from isac_rt.frame.schedule import pseudo_random_schedule
from isac_rt.frame.waveform import SPEED_OF_LIGHT, Waveform
from isac_rt.propagation.pathset import PathKind, make_paths
from isac_rt.receive.settings import Receivers
from isac_rt.world.swarm import Pose

C = SPEED_OF_LIGHT
W = Waveform(num_samples=256, num_chirps=60)
PLACES = {
    "A": ((0.0, 0.0, 30.0), (1.3, 4.1, 0.2)),
    "B": ((21.7, 3.9, 33.1), (-2.1, 3.3, 0.0)),
    "P": ((3.1, 27.3, 28.7), (0.7, -3.9, 0.4)),
    "Q": ((-8.3, 19.1, 35.2), (2.2, 1.1, -0.3)),
    "R": ((17.9, 31.3, 26.1), (0.0, 0.0, 0.0)),
}


def scene_of(deaf=()):
    """Lines of sight of unit gain between all, but for the (transmitter, receiver) pairs in
    `deaf`."""

    def scene(time, links):
        poses = {
            name: Pose(np.array(x) + time * np.array(v), np.array(v), np.zeros(3), np.eye(3))
            for name, (x, v) in PLACES.items()
        }
        paths = {}
        for tx, rx in links:
            away = poses[rx].position - poses[tx].position
            length = np.linalg.norm(away)
            direction = (away / length)[None]
            every = make_paths(
                gain=np.array([1.0]),
                delay=np.array([length / C]),
                delay_rate=float(direction[0] @ (poses[rx].velocity - poses[tx].velocity)) / C,
                departure=direction,
                arrival=-direction,
                tx_radius=length,
                rx_radius=length,
                kind=PathKind.LINE_OF_SIGHT,
                epoch=time,
                tx=tx,
                rx=rx,
            )
            paths[tx, rx] = every.select(np.array([(tx, rx) not in deaf]))
        return poses, paths

    return scene


def network(**change) -> Network:
    rng = np.random.default_rng(7)
    names = ("A", "B", "P", "Q", "R")
    fields = {
        "waveform": W,
        "arrays": Arrays(Antennas(tx_x=2, tx_z=2, rx_x=2, rx_z=2, spacing=0.5774 * W.wavelength)),
        "schedule": pseudo_random_schedule(W.num_groups, W.num_chirps, W.num_tx, rng),
        "receivers": Receivers(),
        "scene": scene_of(),
        "wishes": {"A": 4, "B": 5},
        "listeners": {"A": ("P", "Q"), "B": ("R",)},
        "noise_power": dict.fromkeys(names, 3.0),
        "seed": 5,
    }
    return Network(**(fields | change))


def test_everybody_finds_everybody():
    """Two active terminals whose wishes overlap and three passive ones at -4.8 dB per sample. The
    second avoids the first's blocks 4 to 6 (the nearest free run to 5 starts at 7); P's clock is
    two blocks and 31 ns off, Q's is ahead of its path's delay. Clocks within 4 sigma of the truth,
    offsets known to 1 ns (a third of a metre). 17 frames each: 7 to listen, 7 to announce, 2
    rounds, 1 acknowledgment.

    Planted bug: the hold left out (Q is not heard by A)."""
    clocks = {
        "A": Clock(2.0e-9, 0.004e-6),
        "P": Clock(-2 * W.group_spacing - 31e-9, -0.01e-6),
        "Q": Clock(-73e-9, 0.007e-6),
        "R": Clock(11e-9),
    }
    n = network(clocks=clocks)
    got = establish(n)
    assert got.blocks == {"A": 4, "B": 7}
    assert got.num_frames == 2 * 17
    assert got.duration == pytest.approx(34 * W.frame_duration)
    assert got.links["A", "P"].received_block == 6
    for (at, pt), link in got.links.items():
        assert link.identified, (at, pt)
        assert link.acknowledged, (at, pt)
        assert link.message == Message(n.names.index(at), got.blocks[at])
        estimate = link.clock
        one, other = clocks.get(at, Clock()), clocks.get(pt, Clock())
        offset = one.late(estimate.time) - other.late(estimate.time)
        assert abs(estimate.offset - offset) < 4 * estimate.offset_std
        drift_std = np.sqrt(estimate.covariance[1, 1])
        assert abs(estimate.drift - (one.drift - other.drift)) < 4 * drift_std
        assert estimate.offset_std < 1e-9
    wrong = (
        got.missed_announcements,
        got.wrong_announcements,
        got.missed_acknowledgments,
        got.false_acknowledgments,
    )
    assert wrong == (0, 0, 0, 0)
    assert got.missed_blocks == got.false_blocks == {"A": 0, "B": 0}


def test_noise_alone_makes_no_link():
    """At -40 dB per sample nobody hears anybody, and no block seems taken. Planted bug: one hot
    chirp is enough."""
    got = establish(
        network(noise_power=dict.fromkeys("ABPQR", 1e4), wishes={"A": 4}, listeners={"A": ("P",)})
    )
    assert got.missed_announcements == 1
    assert not got.links["A", "P"].acknowledged
    assert got.false_blocks == {"A": 0}


def test_emitters_are_received_in_the_blocks_of_the_stage():
    """A foreign radar at A's place, at P in blocks 3 to 5 of frame 2. Planted bug: the reference of
    the slot's first block; paths of the first frame."""
    train = Train(W.carrier_frequency, 0.8 * W.slope, 20e-6, 23e-6, 1e-6, None, 0.0)

    def foreign(poses, time, names):
        paths = scene_of()(time, [("A", "P")])[1]["A", "P"]
        return {name: [Arrival(train, 50.0, paths)] for name in names}

    disturbed, quiet = _Air(network(foreign=foreign, start=-0.2)), _Air(network(start=-0.2))
    disturbed.frame = quiet.frame = 2
    extra = disturbed.received("P", 3).samples - quiet.received("P", 3).samples
    time = -0.2 + 2.5 * W.frame_duration
    poses, truth = scene_of()(time, [])[0], np.zeros(extra.shape, complex)
    array = ReceiveArray(poses["P"], disturbed.n.arrays.of("P"))
    start = Reference(-0.2 + 2 * W.frame_duration + 3 * W.group_spacing)
    add_foreign(truth, W, foreign(poses, time, ["P"])["P"][0], array, start)
    assert np.linalg.norm(extra - truth) < 1e-3 * np.linalg.norm(truth)
