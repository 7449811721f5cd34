"""A passive terminal that reads data over a wall, and senses with them where the city's mesh and
what the transmitter says of its place explain that path."""

from __future__ import annotations

import numpy as np
import pytest
from receiver_cubes import ANTENNAS, Path, cube, frame
from test_images import ORIGIN, VELOCITY, WALL, city, pose

from isac_rt.extensions.city_receivers.out_of_sequence import OutOfSequence
from isac_rt.frame.payload import random_payload, unmodulated
from isac_rt.frame.waveform import Waveform
from isac_rt.receive.passive import PassiveReceiver
from isac_rt.receive.settings import Receivers
from isac_rt.track.filter import Gaussian
from isac_rt.track.parts import Equipment
from isac_rt.track.reference import Followed
from isac_rt.track.settings import Tracking
from isac_rt.track.terminal import PassiveTerminal
from isac_rt.track.tracker import Track
from isac_rt.world.swarm import Pose

W = Waveform(num_samples=256, num_chirps=48)
INTERVAL = 0.0041
OWN = pose([1.7, -3.1, 4.2], [1.0, 0.3, 0.0])
SENDER = ORIGIN + np.array([3.7, 8.9, 2.2])
TARGET = ORIGIN + np.array([5.9, 1.4, 5.1])
IMAGE = SENDER + np.array([2 * (11.3 - 3.7), 0.0, 0.0])
"""The transmitter flies as the terminal does, so that its image comes nearer by twice the wall's
speed."""


def ways(n, echo=0.08):
    """The way over the wall and the target's echo, of a target that flies along."""
    moved = VELOCITY * n * INTERVAL
    mirrored = moved * [-1, 1, 1]
    out = []
    for place, motion, before, amplitude in (
        (IMAGE + mirrored, VELOCITY * [-1, 1, 1], 0.0, 0.5),
        (TARGET + moved, VELOCITY, float(np.linalg.norm(TARGET - SENDER)), echo),
    ):
        span = place - OWN.position - moved
        e = span / np.linalg.norm(span)
        length, rate = before + float(span @ e), float(e @ (motion - VELOCITY))
        out.append(Path(length, rate, amplitude, arrival=tuple(OWN.to_body(e)[[0, 2]])))
    return out


def blind_terminal(transmit_amplitude):
    """A passive terminal that reads over any path, and knows the wall."""
    receivers = Receivers(link_acquisition="blind", symbol_decision="beams")
    over_walls = OutOfSequence(PassiveReceiver.of(ANTENNAS, receivers, 8, None), W, city(WALL))
    settings = W, ANTENNAS, receivers, Tracking(), 8, transmit_amplitude, None
    return PassiveTerminal(*settings, Equipment(other_paths=over_walls))


@pytest.mark.parametrize(
    ("said", "named"), [((0.0, 0.0, 0.0), True), ((0.0, -4.0, 0.0), False), (None, False)]
)
def test_a_path_over_a_wall_is_named(said, named):
    """The path is 20 dB weaker than a line of sight of its length, and the mesh has its wall: the
    target is found where it is and tracked, without a line of sight. Where the transmitter says to
    be elsewhere, or says nothing, data alone are read. Planted bugs: any path named; the place of
    the image taken for the transmitter's; the reference left among what is found as one."""
    _, schedule, _ = frame(waveform=W)
    rng = np.random.default_rng(3)
    free = ANTENNAS.gain * W.wavelength / (4 * np.pi * np.linalg.norm(IMAGE - OWN.position))
    terminal = blind_terminal(5.0 / free)
    for n in range(7):
        payload = random_payload(W, schedule, 8, rng)
        received = cube(W, schedule, payload, ways(n), noise=0.1, seed=n)
        moved = VELOCITY * n * INTERVAL
        own = Pose(OWN.position + moved, VELOCITY, np.zeros(3), OWN.rotation)
        place = None if said is None else SENDER + moved + said
        sender = None if place is None else Pose(place, VELOCITY, np.zeros(3), np.eye(3))
        heard, tracks = terminal.step(received, own, n * INTERVAL, True, sender=sender)
    assert heard.decoded and np.array_equal(heard.bits, payload.bits)
    assert not heard.line_of_sight and terminal.reference.track is None
    assert heard.placed == named
    d = heard.detections
    if not named:
        assert len(d) == 0 and len(tracks) == 0
        return
    assert not d.is_reference.any()
    echo = ways(6)[1]
    assert np.abs(d.range - echo.length).min() < 0.1 * W.range_cell(1)
    # 0.1 cells of range, and a direction known to 0.01 at 10 m
    off = np.linalg.norm(tracks.mean[tracks.confirmed, :3] + own.position - TARGET - moved, axis=1)
    assert off.min() < 0.5
    length = tracks.range[tracks.confirmed][off.argmin()]
    assert length == pytest.approx(echo.length, abs=0.1 * W.range_cell(1))


@pytest.mark.parametrize("told", [True, False])
def test_a_reference_that_is_not_where_the_transmitter_is_becomes_a_path(told):
    """Acquired by pilots, a wall's image stands in for the line of sight, as strong as one. Once
    data are read that say where the transmitter is, it is read over as a path, and the target is
    tracked where it is; nobody knows better where they say nothing. Planted bugs: the strength
    alone asked; the tracks that rested on the image kept."""
    _, schedule, _ = frame(waveform=W)
    rng = np.random.default_rng(4)
    free = ANTENNAS.gain * W.wavelength / (4 * np.pi * np.linalg.norm(IMAGE - OWN.position))
    terminal = blind_terminal(0.5 / free)
    for n in range(9):
        payload = random_payload(W, schedule, 8, rng) if n > 1 else unmodulated(W)
        received = cube(W, schedule, payload, ways(n, 0.04), noise=0.1, seed=n)
        moved = VELOCITY * n * INTERVAL
        own = Pose(OWN.position + moved, VELOCITY, np.zeros(3), OWN.rotation)
        sender = Pose(SENDER + moved, VELOCITY, np.zeros(3), np.eye(3)) if told else None
        heard, tracks = terminal.step(received, own, n * INTERVAL, n > 1, sender=sender)
        assert heard.decoded == (n > 1)
    assert np.array_equal(heard.bits, payload.bits)
    assert (terminal.reference.track is None) == told and heard.line_of_sight != told
    places = tracks.mean[tracks.confirmed & ~tracks.is_reference, :3]
    off = np.linalg.norm(places + own.position - TARGET - moved, axis=1)
    assert (off.min(initial=np.inf) < 0.5) == told


class Asked(Exception):
    """What the city shows was asked for."""


@pytest.mark.parametrize("read", [False, True])
def test_the_city_is_expected_from_where_the_data_say(read):
    """Once a data frame was read its word counts, and before it the track, 1 m off and 1.2 m/s.
    Planted bug: the track asked though the data were read."""
    asked = []

    def clutter(state, own):
        asked.append(state)
        raise Asked

    equipment = Equipment(expect_clutter=clutter)
    terminal = PassiveTerminal(W, ANTENNAS, Receivers(), Tracking(), 8, 1.0, equipment=equipment)
    told = Pose(SENDER, VELOCITY, np.zeros(3), np.eye(3))
    off = np.array([1.0, 0.0, 0.0, 0.0, 1.2, 0.0])
    tracked = Gaussian(np.concatenate([SENDER, VELOCITY]) + off, np.eye(6) * 1e-4)
    terminal.reference.state = Followed(Track.of_state(tracked), 0.0, read=read)
    with pytest.raises(Asked):
        terminal.step(None, OWN, 0.0, True, sender=told)
    expected = tracked.mean - off * read
    np.testing.assert_allclose(asked[0], expected, rtol=0, atol=1e-9)
