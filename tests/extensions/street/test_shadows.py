"""Shadows of boxes on echoes, and of boxes that cross a path within a frame: against Fresnel
integrals."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from scipy.special import fresnel
from truths.cars import CHIRPS, OWN, SQUARE_METRE, WAVEFORM, WAVELENGTH, box_of, paths_at, stage

import isac_rt as irt
from isac_rt.document import ScenarioError
from isac_rt.extensions.street.shadows import STEP
from isac_rt.propagation.pathset import PathKind
from isac_rt.world.settings import Uav

SCENES = Path(__file__).parents[3] / "scenes"


def edge(height, before, after):
    """Field over an edge that reaches `height` [m] into the path."""
    s, c = fresnel(height * np.sqrt(2 * (before + after) / (WAVELENGTH * before * after)))
    return (1 + 1j) / 2 * ((0.5 - c) - 1j * (0.5 - s))


def screen(left, right, before, after):
    """Field past a screen between `left` and `right` [m] of the path, far above and below it."""
    return 1 - (edge(left, before, after) - edge(right, before, after))


@pytest.mark.parametrize("place", [-0.3, -0.1, 0.1, 0.3])
def test_an_echo_fades_by_the_distances_to_its_uav(place):
    """The square of the field on the way there, over 10 m and 20 m: the UAV sends a new wave. The
    ends of the wall 30 m above and below ripple by 1e-3 on each way. Planted bug: the whole way to
    the receiver behind the screen (0.3)."""

    def echo(x):
        wall = box_of((0.02, 40.0, 60.0), position_m=(x - 20, 10, 0), velocity_mps=(1e-3, 0, 0))
        uav = Uav(role="target", position_m=(0, 30, 0), rcs=SQUARE_METRE)
        still = {"at": (0.0, 0, 0), "velocities": ((0, 0, 0), (0, 0, 0)), "more": {"U": uav}}
        paths = paths_at(*stage(wall, **still), 0.0, OWN)
        uavs = paths.target_names.index("U")
        return paths.gain[(paths.kind == PathKind.TARGET) & (paths.target == uavs)][0]

    ratio = echo(place) / echo(-1000.0)
    assert ratio == pytest.approx(screen(place - 40, place, 10, 20) ** 2, abs=3e-3)


def test_a_uav_in_a_box_is_refused():
    """A quarter of the way along a wall, and beyond its end. Planted bug: its smallest half side
    as the distance kept."""
    scene, wall = SCENES / "quadcopter.yaml", "role: object, position_m: [500, 0, 50]"
    wall += ", boresight: [0, 1, 0], box: {size_m: [1, 80, 1]}"
    for north in (20, 41):
        uav = f"{{role: target, position_m: [500.4, {north}, 50.4]}}"
        said = [f"swarm.wall={{{wall}}}", f"swarm.inner={uav}"]
        if north < 40:
            with pytest.raises(ScenarioError, match=r"swarm.inner: is inside the box of wall"):
                irt.prepare(irt.load(scene, said))
        else:
            irt.prepare(irt.load(scene, said))


@pytest.mark.parametrize(("width", "speed", "distance"), [(60.0, 200.0, 1.0), (0.1, 200.0, 1.0)])
def test_pieces_follow_what_crosses_a_path_fast(width, speed, distance):
    """A wall's edge before the transmitter, and a pole whose path is lit, dark and lit again: at
    each chirp within what a piece of a slot or more may err, and what is left of ripples far
    outside. Planted bugs: movement near the edge alone counted (0.22); what is lit at three
    instants left whole (1.5)."""
    at, pt = (0.0, 0, 0), (0.0, 40.0, 0)
    middle = -30.0 if width > 1 else 0.0
    box = box_of((0.01, width, 60.0), position_m=(middle, distance, 0), velocity_mps=(speed, 0, 0))
    swarm, model = stage(box, at=at, pt=pt, velocities=((0, 0, 0), (0, 0, 0)))
    paths = paths_at(swarm, model, 0.0)
    line = paths.select(paths.kind == PathKind.LINE_OF_SIGHT)
    pieces = model.shadows(line, swarm.poses(0.0)).in_pieces(line, WAVEFORM, 0.0, 0.0)
    whole = WAVELENGTH / (4 * np.pi * 40)
    errors = []
    for t in CHIRPS:
        alive = (pieces.begin <= t) & (t < pieces.end)
        x = middle + speed * t
        factor = screen(x - width / 2, x + width / 2, distance, 40 - distance)
        assert alive.sum() == 1
        errors.append(abs(pieces.gain[alive][0] / whole - factor))
    unit = np.sqrt(WAVELENGTH * distance * (40 - distance) / 80)
    in_a_slot = speed * WAVEFORM.slot_duration / unit * (1 if width > 1 else 2)
    assert max(errors) < max(STEP, in_a_slot / 2) + 0.01
