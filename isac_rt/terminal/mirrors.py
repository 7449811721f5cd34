"""Mirrors as eyes: a UAV out of sight that one wall shows.

An active terminal that sees a body by one wall on both ways sees its image: the range, the rate and
the direction are those of a body behind the wall, and so is its motion, for a reflection changes no
distance. The image is tracked as it is; what is reported is unfolded through the wall's plane,
place, motion and covariance. A track is taken for an image only if nothing simpler explains it: it
lies behind a wall and is no echo of a nearer track, the way from the wall to the unfolded place is
free, that place itself is out of sight, and it moves. What stands still behind a wall is a wall.
"""

from __future__ import annotations

import numpy as np

from isac_rt.terminal.filter import Gaussian, reflected
from isac_rt.terminal.ghosts import Walls, hidden_by
from isac_rt.world.swarm import Pose

MOVES = 16.3
"""Squared distance of a velocity from nothing beyond which a body moves: 0.999 of chi squared of
three."""
LEAST_SPEED = 1.0
"""And at least so fast [m/s]: the clutter that two walls return stands still to its scatter."""
OFF_THE_WALL = 1e-3
"""Where the way from the wall begins, beyond rounding [m]."""


def mirror_of(state: Gaussian, own: Pose, walls: Walls, range_resolution: float) -> np.ndarray:
    """The wall by which a terminal sees the body of a track: unit normal and offset n.x [m], world
    coordinates, of its plane, (4,); (0,) if the track is no such image.

    Parameters
    ----------
    state : of the track, the first six are place and motion
    range_resolution : [m]
    """
    nothing, place = np.zeros(0), state.mean[:3]
    velocity, spread = state.mean[3:6], state.covariance[3:6, 3:6]
    speed = float(np.linalg.norm(velocity))
    if speed < LEAST_SPEED or velocity @ np.linalg.solve(spread, velocity) < MOVES:
        return nothing
    faces = walls.blocking(own.position, place)
    if not faces.size:
        return nothing
    normals = walls.city.normals[faces]
    offsets = walls.city.plane_offsets[faces] + normals @ walls.city.origin
    span = place - own.position
    shares = (offsets - normals @ own.position) / (normals @ span)
    first = int(shares.argmin())
    if not np.isin(walls.city.plane_of_face[faces[first]], walls.planes):
        return nothing
    plane = np.append(normals[first], offsets[first])
    body, met = reflected(plane, state), own.position + shares[first] * span
    way = body.mean[:3] - met
    start = met + way * (OFF_THE_WALL / max(float(np.linalg.norm(way)), OFF_THE_WALL))
    if walls.blocking(start, body.mean[:3]).size:
        return nothing
    spread = body.covariance[:3, :3]
    hides = hidden_by(body.mean[:3], spread, [own.position], walls, range_resolution)
    return plane if hides >= 0 else nothing
