"""Cities from a few numbers: a street canyon and a grid of blocks."""

from __future__ import annotations

import numpy as np

from isac_rt.randomness import splitmix64
from isac_rt.world import settings
from isac_rt.world.city.materials import CityError, MaterialUse
from isac_rt.world.city.mesh import Surface
from isac_rt.world.city.prism import Finish, ground, prism

_BOX_CAP = np.array([[2, 3, 0], [0, 1, 2]])
"""Triangles over the corners of a box from its south-east corner counter-clockwise."""


def spread_fraction(i: int, j: int) -> float:
    """A number in [0, 1) that depends on the index of a building alone, not on a seed."""
    return int(splitmix64(np.zeros(1, np.uint64), np.array([(i << 32) + j], np.uint64))[0]) / 2**64


def _height(city: settings.City, i: int, j: int) -> float:
    return city.building_height_m + city.height_spread_m * (2 * spread_fraction(i, j) - 1)


def _check(city: settings.City) -> None:
    if city.height_spread_m >= city.building_height_m:
        raise CityError(
            f"city.height_spread_m {city.height_spread_m:g} is not below building_height_m "
            f"{city.building_height_m:g}: "
            "a building could vanish; lower the spread"
        )


def _blocks(
    city: settings.City, boxes: list[tuple[float, float, float, float, float]]
) -> list[Surface]:
    finish = Finish(
        *(MaterialUse(m) for m in (city.wall_material, city.roof_material, city.ground_material))
    )
    surfaces: list[Surface] = []
    for x_0, y_0, x_1, y_1, height in boxes:
        corners = np.array([[x_1, y_0], [x_1, y_1], [x_0, y_1], [x_0, y_0]])
        surfaces += prism([corners], _BOX_CAP, 0.0, height, finish)
    edges = np.array(boxes)
    low, high = edges[:, :2].min(axis=0), edges[:, 2:4].max(axis=0)
    return [*surfaces, ground(low, high, city.ground_margin_m, 0.0, finish.floor)]


def canyon(city: settings.City) -> list[Surface]:
    """A street along y, centred on the origin, its surface at z = 0, with a closed row of buildings
    on each side.

    The facades stand at x = -street_width/2 and +street_width/2 over street_length. Each row is cut
    into buildings of about block_size along the street, as deep as block_size, of building_height
    +- height_spread.
    """
    _check(city)
    half, length = city.street_width_m / 2, city.street_length_m
    count = max(1, round(length / city.block_size_m))
    cuts = np.linspace(-length / 2, length / 2, count + 1)
    boxes = []
    for row, (x_0, x_1) in enumerate(
        ((-half - city.block_size_m, -half), (half, half + city.block_size_m))
    ):
        boxes += [
            (x_0, float(cuts[k]), x_1, float(cuts[k + 1]), _height(city, row, k))
            for k in range(count)
        ]
    return _blocks(city, boxes)


def blocks(city: settings.City) -> list[Surface]:
    """blocks_x by blocks_y square blocks with streets between them, centred on the origin, the
    ground at z = 0."""
    _check(city)
    pitch = city.block_size_m + city.street_width_m
    boxes = []
    for i in range(city.blocks_x):
        for j in range(city.blocks_y):
            x_0 = (i - (city.blocks_x - 1) / 2) * pitch - city.block_size_m / 2
            y_0 = (j - (city.blocks_y - 1) / 2) * pitch - city.block_size_m / 2
            boxes.append(
                (x_0, y_0, x_0 + city.block_size_m, y_0 + city.block_size_m, _height(city, i, j))
            )
    return _blocks(city, boxes)
