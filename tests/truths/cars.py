"""Boxes that move: mirrors and echoes against a trace anew in every chirp, shadows against Fresnel
integrals."""

from __future__ import annotations

import numpy as np
from scipy.special import fresnel

from isac_rt.extensions.street.boxes import Boxes
from isac_rt.frame.antennas import Antennas, Arrays
from isac_rt.frame.link import Link
from isac_rt.frame.waveform import SPEED_OF_LIGHT, Waveform
from isac_rt.propagation.free_space import FreeSpace
from isac_rt.propagation.pathset import PathKind, PathSet
from isac_rt.world.settings import Box, Rcs, Uav, Waypoint
from isac_rt.world.swarm import Swarm
from truths.case import Errors, case

WAVEFORM = Waveform()
WAVELENGTH = WAVEFORM.wavelength
HALF = WAVEFORM.frame_duration / 2
LINK, OWN = Link("AT", "PT"), Link("AT", "AT")
SQUARE_METRE = Rcs(model="constant", value_dbsm=0.0)
POINT = Arrays(Antennas(tx_x=1, tx_z=1, rx_x=1, rx_z=1, spacing=0.0, gain=1.0))


def box_of(size=(0.4, 8.0, 5.0), material="metal", **flight):
    return Uav(role="target", box=Box(size_m=size, material=material), **flight)


def turning(yaw_deg, places=((3.0, 9.0, 2.0), (3.4, 9.2, 2.1), (3.9, 9.3, 2.2)), tilt=1.0):
    """A box on three waypoints, with their yaw and some pitch and roll."""
    points = [
        Waypoint(time_s=t, position_m=p, attitude_deg=(yaw, 2 * tilt * t, -3 * tilt * t))
        for t, p, yaw in zip((0.0, 0.5, 1.0), places, yaw_deg, strict=True)
    ]
    return box_of(waypoints=points)


def stage(
    box,
    at=(-9.0, 3.0, 2.5),
    pt=(-8.0, 14.0, 1.5),
    velocities=((1, 0.5, 0), (0, -1, 0.2)),
    more=None,
):
    uavs = {
        "AT": Uav(role="active", position_m=at, velocity_mps=velocities[0]),
        "PT": Uav(role="passive", position_m=pt, velocity_mps=velocities[1]),
        "box": box,
        **(more or {}),
    }
    swarm = Swarm(uavs, 1.0)
    free = FreeSpace(uavs, POINT, WAVELENGTH, 3)
    return swarm, Boxes(swarm, {}, free, free, WAVEFORM, None)


def paths_at(swarm, model, epoch, link=LINK):
    return model.trace(swarm.poses(epoch), epoch, [link]).paths[link]


def mirrors(swarm, model, epoch, link=LINK):
    paths = paths_at(swarm, model, epoch, link)
    return paths.select(paths.kind == PathKind.SPECULAR)


def face_at(swarm, t):
    """Corners of the face to the left, in order."""
    pose, half = swarm.trajectories["box"].pose(t), np.array(swarm.uavs["box"].box.size_m) / 2
    signs = np.array([(-1, -1, -1), (-1, 1, -1), (-1, 1, 1), (-1, -1, 1)])
    return pose.position + (signs * half) @ pose.rotation.T


def traced_anew(swarm, t, link=LINK):
    """Length over the plane of the face at an instant, and whether its point is on the face."""
    corners = face_at(swarm, t)
    normal = np.cross(corners[1] - corners[0], corners[3] - corners[0])
    normal /= np.linalg.norm(normal)
    first, last = (swarm.trajectories[name].pose(t).position for name in link)
    heights = [normal @ (end - corners[0]) for end in (first, last)]
    length = np.sqrt(((first - last) ** 2).sum() + 4 * heights[0] * heights[1])
    feet = [end - h * normal for end, h in zip((first, last), heights, strict=True)]
    point = (feet[0] * heights[1] + feet[1] * heights[0]) / (heights[0] + heights[1])
    sides = np.roll(corners, -1, axis=0) - corners
    inside = (np.cross(sides, point - corners) @ normal > 0).all()
    return length, inside and heights[0] * heights[1] > 0


STEADY = ((3.0, 9.0, 2.0), (3.4, 9.2, 2.1), (3.8, 9.4, 2.2))
CHIRPS = WAVEFORM.chirp_time[0] + WAVEFORM.window_start - HALF
"""When the samples of a chirp begin [s since the middle of the frame]."""


def over_frame(paths: PathSet, k: int) -> np.ndarray:
    """Lengths of a path in every chirp [m]."""
    delay = paths.delay[k] + paths.delay_rate[k] * CHIRPS + paths.delay_accel[k] * CHIRPS**2 / 2
    return delay * SPEED_OF_LIGHT


@case(
    "the length over the face's plane at its corners of each chirp",
    "1e-6 wavelengths",
    "the third derivative over half a frame",
)
def moving_walls() -> Errors:
    """The side of a car that drives and turns mirrors as if traced anew in every chirp."""
    for link, yaw in ((LINK, 0.0), (OWN, -40.0)):
        swarm, model = stage(turning((yaw, yaw + 2, yaw + 4), STEADY, 0.0))
        path = mirrors(swarm, model, 0.4, link)
        lengths = np.array([traced_anew(swarm, 0.4 + t, link)[0] for t in CHIRPS])
        yield len(path) - 1
        yield np.abs(over_frame(path, 0) - lengths).max() / WAVELENGTH


def stage_with_uav():
    uav = Uav(role="target", position_m=(-4, 10, 2.2), velocity_mps=(2, -3, 0.5), rcs=SQUARE_METRE)
    return stage(turning((0.0, 2.0, 4.0), STEADY, 0.0), more={"U": uav})


def echoes_over(swarm, model, epoch, link):
    paths = paths_at(swarm, model, epoch, link)
    return paths.select((paths.kind == PathKind.GHOST) & (paths.target == 3))


def anew(swarm, t, link, over):
    """Length to a UAV and on at an instant, each way straight or over the face to the left."""
    corners = face_at(swarm, t)
    normal = np.cross(corners[1] - corners[0], corners[3] - corners[0])
    normal /= np.linalg.norm(normal)
    uav, *ends = (swarm.trajectories[name].pose(t).position for name in ("U", *link))
    behind = [end - 2 * (normal @ (end - corners[0])) * normal for end in ends]
    chosen = [far if o else end for end, far, o in zip(ends, behind, over, strict=True)]
    return sum(np.linalg.norm(uav - end) for end in chosen)


@case(
    "the length over the face's plane and the UAV at their places of each chirp",
    "1e-5 wavelengths",
    "the third derivative over half a frame",
)
def uavs_in_moving_walls() -> Errors:
    """A UAV echoes over the side of a car that drives and turns, before it, behind it and both."""
    swarm, model = stage_with_uav()
    for link in (LINK, OWN):
        over = echoes_over(swarm, model, 0.4, link)
        yield len(over) - 3
        for k, way in enumerate(((False, True), (True, False), (True, True))):
            lengths = np.array([anew(swarm, 0.4 + t, link, way) for t in CHIRPS])
            yield np.abs(over_frame(over, k) - lengths).max() / WAVELENGTH


@case(
    "Fresnel's integral of a half plane at the place of the edge in each chirp",
    "0.053 of the unshadowed path",
    "pieces of the frame of 0.05, and the wall's far edges",
)
def sliding_shadows() -> Errors:
    """A wall that slides into a path is the static knife edge at each instant."""
    wall = box_of((0.1, 60.0, 60.0), position_m=(0, -30, 0), velocity_mps=(0, 50, 0))
    ends = {"at": (-20.0, 0, 0), "pt": (20.0, 0, 0), "velocities": ((0, 10, 0), (0, 10, 0))}
    swarm, model = stage(wall, **ends)
    paths = paths_at(swarm, model, 0.0)
    line = paths.select(paths.kind == PathKind.LINE_OF_SIGHT)
    pieces = model.shadows(line, swarm.poses(0.0)).in_pieces(line, WAVEFORM, 0.0, 0.0)
    unit = np.sqrt(WAVELENGTH * 20 * 20 / (2 * 40))
    for t in CHIRPS:
        alive = (pieces.begin <= t) & (t < pieces.end)
        s, c = fresnel(40 * t / unit)
        yield alive.sum() - 1
        factor = pieces.gain[alive][0] / WAVELENGTH * 4 * np.pi * 40
        yield abs(factor - (1 + 1j) / 2 * ((0.5 - c) - 1j * (0.5 - s)))
