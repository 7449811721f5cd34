"""UAVs out of sight that one wall shows, by hand in a street that turns a corner."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from test_images import ANTENNAS, ORIGIN, W, city

from isac_rt.receive.settings import Receivers
from isac_rt.receive.types import Detections, Reception, no_detections
from isac_rt.scenario.file import load
from isac_rt.simulation.setup import prepare
from isac_rt.terminal.filter import Gaussian, measure, reflected
from isac_rt.terminal.ghosts import Walls
from isac_rt.terminal.mirrors import mirror_of
from isac_rt.terminal.settings import Tracking
from isac_rt.terminal.terminal import ActiveTerminal
from isac_rt.world.swarm import Pose, attitude


def upright(start: list[float], end: list[float], height: float = 20.0) -> list[list[float]]:
    """A wall from one point of the ground to another."""
    return [[*start, 0.0], [*end, 0.0], [*end, height], [*start, height]]


FACADE = upright([12.4, 0.0], [12.4, 50.0])
CORNER = upright([-20.0, 12.0], [5.0, 12.0])
OWN = Pose(
    ORIGIN + np.array([0, 0, 5.0]),
    np.array([0.4, 1.1, 0.0]),
    np.zeros(3),
    attitude(np.array([1.0, 1.0, 0.0])),
)
PLACE, MOTION = np.array([3.1, 30.2, 6.3]), np.array([0.7, -5.2, 0.4])
IMAGE, IMAGE_MOTION = np.array([21.7, 30.2, 6.3]), np.array([-0.7, -5.2, 0.4])
"""Turned over in x = 12.4."""
CELL = 0.15


def track(place: np.ndarray = IMAGE, motion: np.ndarray = IMAGE_MOTION) -> Gaussian:
    """A track at a place, along, across and over its street known to 3, 2 and 1 dm."""
    mean = np.concatenate([ORIGIN + place, motion, np.zeros(3)])
    return Gaussian(mean, np.diag([0.3, 0.2, 0.1, 0.3, 0.2, 0.1, 1, 1, 1]) ** 2)


def test_an_image_is_turned_over_in_the_walls_plane():
    """In x + y = 10 (3, 4, 5) becomes (6, 7, 5), motions and covariances swap their first two axes
    and their signs: by hand. Twice is nothing. Planted bugs: the offset once and not twice; the
    covariance turned on one side only; the motion left as it was."""
    plane = np.array([np.sqrt(0.5), np.sqrt(0.5), 0.0, 10 * np.sqrt(0.5)])
    mean = np.array([3.0, 4.0, 5.0, 1.0, -2.0, 0.5])
    spread = np.array([[0.9, 0.1, 0.2], [0.1, 0.5, 0.3], [0.2, 0.3, 0.7]])
    covariance = np.kron(np.array([[1.0, 0.4], [0.4, 2.0]]), spread)
    body = reflected(plane, Gaussian(mean, covariance))
    assert body.mean == pytest.approx([6, 7, 5, 2, -1, 0.5], abs=1e-12)
    swapped = np.array([[0.5, 0.1, -0.3], [0.1, 0.9, -0.2], [-0.3, -0.2, 0.7]])
    expected = np.kron(np.array([[1.0, 0.4], [0.4, 2.0]]), swapped)
    assert body.covariance == pytest.approx(expected, abs=1e-12)
    again = reflected(plane, body)
    assert again.mean == pytest.approx(mean, abs=1e-12)


def test_a_facade_shows_what_the_corner_hides():
    """Seen at (21.7, 30.2, 6.3) behind the facade x = 12.4, which the way there meets 17.3 m up the
    street: the body is at (3.1, 30.2, 6.3), which the corner hides. Planted bugs: the farthest wall
    on the way taken for the mirror; the mesh's origin left out."""
    other = upright([16.0, 0.0], [16.0, 50.0])
    plane = mirror_of(track(), OWN, city(FACADE, CORNER, other), CELL)
    assert np.abs(plane[:3]) == pytest.approx([1, 0, 0], abs=1e-12)
    body = reflected(plane, track())
    assert body.mean[:6] == pytest.approx([*(ORIGIN + PLACE), *MOTION], abs=1e-9)


@pytest.mark.parametrize(
    ("why", "walls", "state"),
    [
        ("nothing before it", [CORNER], track()),
        ("the place itself is in sight", [FACADE], track()),
        ("it stands still", [FACADE, CORNER], track(motion=np.array([0.2, 0.1, 0.0]))),
        ("its motion is not known", [FACADE, CORNER], track(motion=np.array([1.1, 0.2, 0.0]))),
        (
            "the way from the facade is not free",
            [FACADE, CORNER, upright([5.0, 25.0], [9.0, 25.0])],
            track(),
        ),
        (
            "the wall is no mirror",
            [upright([12.4, 16.8], [12.4, 17.9], 6.8), CORNER],
            track(),
        ),
        (
            "the corner hides it by less than it is known",
            [FACADE, CORNER],
            track(IMAGE - [0, 17.6, 0]),
        ),
    ],
)
def test_what_no_mirror_explains(why: str, walls: list, state: Gaussian):
    """Each condition by itself. Planted bugs: each left out."""
    assert not mirror_of(state, OWN, city(*walls), CELL).size, why


class Told:
    """A receiver that is told what to find."""

    def __init__(self) -> None:
        self.found = no_detections()

    def receive(self, *known: object) -> Reception:
        return Reception.undecoded(W, self.found)


def flown(walls: Walls, mirrors: str, frames: int = 8) -> list:
    """Tracks of a terminal that is told of the image of the body behind the corner, and at last of
    the body that comes into sight."""
    tracking = Tracking(births="unexplained", mirrors=mirrors)
    terminal, rng = (
        ActiveTerminal(W, ANTENNAS, Receivers(), tracking, walls),
        np.random.default_rng(4),
    )
    terminal.other, said = Told(), []
    std = np.array([0.02, 0.05, 0.004, 0.004])
    for k in range(frames):
        own = replace(OWN, position=OWN.position + OWN.velocity * 0.05 * k)
        mean = np.concatenate([ORIGIN + IMAGE + IMAGE_MOTION * 0.05 * k, IMAGE_MOTION])
        z = measure(mean, own) + std * rng.standard_normal(4)
        terminal.other.found = Detections(
            range=z[:1],
            velocity=z[1:2],
            direction=z[None, 2:],
            snr=np.full(1, 100.0),
            std=std[None],
            is_reference=np.zeros(1, bool),
        )
        _, tracks = terminal.step(None, None, own, 0.05 * k)
        memory = terminal.memory()
        terminal.restore(memory)
        truth = np.concatenate(
            [PLACE + MOTION * 0.05 * k - own.position + ORIGIN, MOTION - own.velocity]
        )
        said.append((tracks, truth))
    return said


def test_a_terminal_follows_what_the_facade_shows():
    """From its confirmation in the third frame on the track is reported where the UAV is, within
    its own covariance (0.999 of chi squared of six, 22.5, in each of six frames), and measured as
    its image; where mirrors are ignored, or where there is no corner, none is confirmed. Planted
    bugs: the filter's own state turned over; the covariance not."""
    walls = city(FACADE, CORNER)
    for k, (tracks, truth) in enumerate(flown(walls, "place")):
        assert tracks.mirrored.tolist() == [k >= 2] and tracks.confirmed.tolist() == [k >= 2]
        if k >= 2:
            off = tracks.mean[0] - truth
            assert off @ np.linalg.solve(tracks.covariance[0], off) < 22.5
            assert tracks.range[0] == pytest.approx(
                np.linalg.norm(IMAGE - [0, 0, 5]), abs=3.0
            )  # it comes nearer
    assert not any(t.confirmed.any() for t, _ in flown(walls, "ignore"))
    assert not any(t.confirmed.any() for t, _ in flown(city(FACADE), "place"))


def test_a_track_ends_where_the_facade_does():
    """The facade begins 16.6 m up the street. The way to the image meets it 17.3 m up at first, and
    12.5 cm less a frame: the track ends some three frames after it is confirmed. Planted bug: asked
    once, when it is confirmed."""
    short = upright([12.4, 0.0], [12.4, 50.0])
    short[0][1] = short[3][1] = 16.6
    counts = [int(t.mirrored.sum()) for t, _ in flown(city(short, CORNER), "place", 14)]
    assert counts[2] == 1 and counts[-1] == 0


@pytest.mark.slow
def test_a_terminal_finds_a_uav_behind_a_corner(tmp_path):
    """The whole chain, rays and samples, at a crossing of streets whose facades are of metal: the
    UAV round the corner is hidden 4 m deep, its image 58 m away. From the third frame on it is
    placed within 0.6 m of the truth (its deviations are 0.2 m on each axis). 50 s."""
    scene = tmp_path / "corner.yaml"
    scene.write_text(SCENE)
    scenario = load(scene)
    setup = prepare(scenario)
    receivers, tracking = scenario.receivers, scenario.tracking
    terminal = ActiveTerminal(
        setup.waveform, setup.antennas, receivers, tracking, Walls(setup.city)
    )
    for k in range(scenario.frames):
        frame = setup.frame(k)
        poses, paths = frame.poses, frame.paths[("AT", "AT")]
        cube, sent = frame.samples(("AT", "AT")), frame.sent["AT"]
        _, tracks = terminal.step(
            cube, sent.payload, poses["AT"], time=paths.epoch, clutter=frame.expected["AT"]
        )
        if k >= 2:
            place = tracks.mean[tracks.mirrored, :3]
            truth = poses["U1"].position - poses["AT"].position
            assert place.shape == (1, 3) and np.linalg.norm(place - truth) < 0.6


SCENE = """
name: corner
seed: 9
frames: 6
frame_interval_s: 0.04
city: {source: blocks, street_width_m: 20, building_height_m: 22, block_size_m: 50,
       blocks_x: 2, blocks_y: 2, wall_material: metal}
swarm:
  AT: {role: active, position_m: [-20.4, -6.3, 12.0], velocity_mps: [3.1, 0.4, 0.1],
       boresight: [1, 1, 0]}
  U1: {role: target, position_m: [0.7, 36.2, 12.9], velocity_mps: [0.3, -5.2, 0.2],
       rcs: {model: tr38901, size: large}}
propagation: {model: ray_traced, max_bounces: 2}
clutter: {model: none}
receiver_preset: city
tracking: {mirrors: place}
noise: {model: link_budget, tx_power_dbm: 20, noise_figure_db: 12}
"""
