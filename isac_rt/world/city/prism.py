"""Closed prisms and the ground under them, by numpy alone."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from isac_rt.world.city.materials import MaterialUse
from isac_rt.world.city.mesh import Surface


@dataclass(frozen=True)
class Finish:
    """Materials of a building."""

    wall: MaterialUse
    roof: MaterialUse
    floor: MaterialUse


def prism(
    rings: Sequence[NDArray[np.float64]],
    cap: NDArray[np.int64],
    base: float,
    top: float,
    finish: Finish,
) -> list[Surface]:
    """Return walls, roof and floor of a closed prism, normals outward.

    Parameters
    ----------
    rings : (N, 2) open rings [m], the outer one first and counter-clockwise, holes clockwise
    cap : (T, 3) counter-clockwise triangles over the corners of all rings
    base, top : heights of floor and roof [m]
    finish : materials
    """
    plan = np.concatenate(rings)
    num = len(plan)
    vertices = np.empty((2 * num, 3))
    vertices[:num, :2], vertices[num:, :2] = plan, plan
    vertices[:num, 2], vertices[num:, 2] = base, top
    lengths = np.array([len(ring) for ring in rings])
    ends = np.cumsum(lengths)
    here = np.arange(num)
    after = here + 1
    after[ends - 1] = ends - lengths  # rings close
    halves = np.array([[here, after, after + num], [here, after + num, here + num]])
    walls = halves.transpose(0, 2, 1).reshape(-1, 3)
    return [
        Surface(vertices, walls, finish.wall),
        Surface(vertices, cap + num, finish.roof),
        Surface(vertices, cap[:, ::-1], finish.floor),
    ]


def ground(
    low: NDArray[np.float64],
    high: NDArray[np.float64],
    margin: float,
    height: float,
    material: MaterialUse,
) -> Surface:
    """A rectangle under everything, facing up.

    Parameters
    ----------
    low, high : (2,) float64
        Corners of what stands on it. [m]
    margin : float
        Added on each side. [m]
    height : float
        [m]
    material : MaterialUse
    """
    (x_0, y_0), (x_1, y_1) = low - margin, high + margin
    vertices = np.array(
        [[x_0, y_0, height], [x_1, y_0, height], [x_1, y_1, height], [x_0, y_1, height]]
    )
    return Surface(vertices, np.array([[0, 1, 2], [0, 2, 3]]), material)
