"""Paths of two segments, and the element at each end that weighs them, by hand."""

from __future__ import annotations

import numpy as np
import pytest

from isac_rt.frame.antennas import Antennas, Arrays
from isac_rt.frame.link import Link
from isac_rt.propagation.pathset import PathKind
from isac_rt.propagation.scatter_paths import LinkState, ScatterPaths
from isac_rt.propagation.segments.geometry import Segments
from isac_rt.world.swarm import Pose

COSINE = Antennas(tx_x=1, tx_z=1, rx_x=2, rx_z=2, spacing=1e-3, gain=4.0, pattern="cosine")
"""4 cos(angle): q = 4/2 - 1."""
SENDER = Pose.at_rest((3, 4, 20), boresight=(0, 1, 0))
RECEIVER = Pose.at_rest((30, 4, 20), boresight=(-1, 0, 0))


def unit(*v: float) -> np.ndarray:
    return np.array([v]) / np.linalg.norm(v)


def segment(
    motion: tuple[float, float, float], departure: np.ndarray, arrival: np.ndarray
) -> Segments:
    """A segment of this length, rate and acceleration."""
    length, rate, accel = (np.array([x]) for x in motion)
    return Segments(length, rate, accel, departure, arrival, np.zeros((1, 0, 3)))


def segments() -> tuple[Segments, Segments]:
    return (
        segment((17.0, 2.5, 0.3), unit(0.6, 0.8, 0), unit(-1, 0, 0)),
        segment((29.0, -7.0, 1.1), unit(-0.8, 0, 0.6), unit(0, 1, 0)),
    )


def test_a_path_over_a_target_adds_its_segments():
    """Length, rate and acceleration of both; the wave curves about the body at either end, and
    leaves and comes by the segments' first pieces. Planted bugs: ends exchanged; one segment's
    acceleration."""
    path = ScatterPaths.over(*segments())
    assert (path.length[0], path.rate[0], path.accel[0]) == pytest.approx((46.0, -4.5, 1.4))
    assert (path.tx_radius[0], path.rx_radius[0]) == (17.0, 29.0)
    assert path.departure[0].tolist() == [0.6, 0.8, 0.0]
    assert path.arrival[0] == pytest.approx([-0.8, 0.0, 0.6])
    one = ScatterPaths.along(segments()[0])
    assert (one.length[0], one.tx_radius[0], one.rx_radius[0]) == (17.0, 17.0, 17.0)
    assert one.departure[0].tolist() == [0.6, 0.8, 0.0] and one.arrival[0].tolist() == [-1, 0, 0]


@pytest.mark.parametrize("own", [False, True])
def test_each_end_weighs_by_its_own_axes(own):
    """The sender looks north, 0.8 of the departure; the receiver west, 0.8 of where it comes
    from; at an active terminal both in the terminal's own axes, by different directions there and
    back as over a wall. Planted bugs: the arrival in the sender's axes; the departure's gain
    twice."""
    path = ScatterPaths.over(*segments())
    end = SENDER if own else RECEIVER
    state = LinkState(Link("A", "A" if own else "B"), 0.0, SENDER, end)
    arrival = 4 * max(path.arrival[0] @ end.rotation[:, 1], 0)
    assert arrival == pytest.approx(0.0 if own else 3.2)
    assert state.elements(Arrays(COSINE), path)[0] == pytest.approx(np.sqrt(3.2 * arrival))
    there = segments()[0]
    bent = ScatterPaths.over(there, segment((29.0, -7.0, 1.1), unit(0, 0.6, 0.8), unit(0, 1, 0)))
    straight = ScatterPaths.over(there, there)
    if own:
        assert state.elements(Arrays(COSINE), bent)[0] == pytest.approx(np.sqrt(3.2 * 2.4))
        assert state.elements(Arrays(COSINE), straight)[0] == pytest.approx(3.2)


def test_delays_are_lengths_over_the_speed_of_light():
    """Delays, directions and radii of the paths, their names and what happens on them. Planted
    bugs: metres for seconds; directions exchanged."""
    path = ScatterPaths.over(*segments())
    state = LinkState(Link("A", "B"), 0.7, SENDER, RECEIVER, ("T", "U"))
    points, faces = np.array([[[1.0, 2, 3]]]), np.array([[5]])
    p = state.paths(
        path, np.array([2j]), PathKind.GHOST, bounces=1, target=1, points=points, faces=faces
    )
    c = 299_792_458.0
    found = p.delay[0] * c, p.delay_rate[0] * c, p.delay_accel[0] * c
    assert found == pytest.approx((46.0, -4.5, 1.4))
    assert (p.tx_radius[0], p.rx_radius[0], p.gain[0]) == (17.0, 29.0, 2j)
    assert p.departure.tolist() == path.departure.tolist()
    assert p.arrival.tolist() == path.arrival.tolist()
    assert (p.tx, p.rx, p.epoch, p.target_names) == ("A", "B", 0.7, ("T", "U"))
    assert (p.kind[0], p.bounces[0], p.target[0], p.faces[0, 0]) == (2, 1, 1, 5)
    assert p.points.tolist() == points.tolist()
