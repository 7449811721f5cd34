"""Meshes in place of boxes: a cuboid against the box, a wedge against images and edges by hand."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import trimesh
from fake_run import fake_run
from scipy.special import fresnel
from truths.cars import LINK, OWN, WAVELENGTH, box_of, mirrors, paths_at, stage, turning

import isac_rt as irt
from isac_rt.document import ScenarioError
from isac_rt.extensions.street.solid import corners_of_mesh, solid_of, solid_of_box
from isac_rt.frame.waveform import SPEED_OF_LIGHT
from isac_rt.propagation.pathset import PathKind
from isac_rt.runtime import UserError
from isac_rt.simulation.simulate import _with_boxes
from isac_rt.views.scene import boxes_in, moving_scene
from isac_rt.world.city.mesh import empty_city
from isac_rt.world.settings import Box, Uav
from isac_rt.world.swarm import Swarm

SCENES = Path(__file__).parents[3] / "scenes"
SIDES = (0.4, 8.0, 5.0)
STILL = {"velocities": ((0, 0, 0), (0, 0, 0))}


def with_solid(uav, corners):
    """A UAV whose box is the hull of corners (N, 3)."""
    return uav.model_copy(update={"box": Box(corners_m=np.asarray(corners).tolist())})


def test_a_cuboid_mesh_is_the_box(tmp_path):
    """Each side as 32 triangles with corners of their own, in another place and in single
    precision: paths over faces and shadows while it turns. Planted bugs: `FLAT` of 0 (more than six
    facets); the mean of the vertices as the middle (a load inside); rims turned over."""
    mesh = trimesh.creation.box(SIDES).subdivide().subdivide()
    mesh.apply_translation((30, -20, 7)).export(tmp_path / "one.stl")
    load = trimesh.creation.box((0.1, 0.2, 0.3)).apply_translation((0.1, 3.0, 2.0))
    trimesh.util.concatenate([trimesh.creation.box(SIDES), load]).export(tmp_path / "two.obj")
    box = turning((-25.0, 0.0, 25.0))
    for file in ("one.stl", "two.obj"):
        corners = corners_of_mesh(tmp_path / file)["corners_m"]
        assert len(solid_of(np.array(corners)).planes) == 6 and len(corners) == 8
        stages = stage(box), stage(with_solid(box, corners))
        for link in (LINK, OWN):
            for epoch in (0.13, 0.14, 0.4, 0.75):
                ours, of_box = (paths_at(swarm, m, epoch, link) for swarm, m in stages[::-1])
                assert len(ours) == len(of_box)
                for name in ("delay", "delay_rate", "delay_accel", "gain", "begin", "end"):
                    found, expected = getattr(ours, name), getattr(of_box, name)
                    assert found == pytest.approx(expected, rel=1e-4, abs=1e-14), name
    trimesh.convex.convex_hull(WEDGE).export(tmp_path / "three.ply")
    wedge = np.array(corners_of_mesh(tmp_path / "three.ply")["corners_m"])
    assert wedge.max(axis=0) == pytest.approx(np.ones(3)) == -wedge.min(axis=0)
    behind = stage(box, pt=(9.0, 14.0, 1.5)), stage(with_solid(box, corners), pt=(9.0, 14.0, 1.5))
    shadows = [paths_at(swarm, model, 0.4).gain[0] for swarm, model in behind]
    assert shadows[1] == pytest.approx(shadows[0], rel=1e-6)
    assert abs(shadows[0]) < 0.3 * abs(paths_at(*stage(box, pt=(-9.0, 14.0, 1.5)), 0.4).gain[0])


WEDGE = np.array([[0, 0, 0], [2, 0, 0], [0, 2, 0], [0, 0, 2.0]])
"""A tetrahedron whose facet x + y + z = 2 is a triangle."""


@pytest.mark.parametrize(("shift", "on_it"), [((0, 0, 0), True), ((-0.9, 1.2, -0.3), False)])
def test_a_slanted_triangle_mirrors_by_its_image(shift, on_it):
    """The foot of a radar before x + y + z = 2, in the triangle, or in the box about it alone;
    rates are those of the plane's own flight. Planted bugs: ends themselves for their
    feet; the plane's height with the other sign; the least depth over the box's six planes."""
    normal = np.ones(3) / np.sqrt(3)
    foot = np.array([2, 2, 2]) / 3 + np.array(shift)
    foot -= normal * (normal @ foot - 2 / np.sqrt(3))
    assert (foot > 0).all() == on_it
    at = foot + 9 * normal
    course = np.array([0.3, -0.5, 1.1])
    body = Uav(role="target", position_m=(0, 0, 0), velocity_mps=tuple(course), boresight=(0, 1, 0))
    swarm, model = stage(with_solid(body, WEDGE), at=tuple(at), **STILL)
    paths = mirrors(swarm, model, 0.0, OWN)
    assert len(paths) == on_it
    if on_it:
        assert paths.delay * SPEED_OF_LIGHT == pytest.approx(18, abs=1e-9)
        assert paths.delay_rate * SPEED_OF_LIGHT == pytest.approx(-2 * normal @ course)
        assert paths.departure[0] == pytest.approx(-normal)
        friis = WAVELENGTH / (4 * np.pi * 18)
        assert abs(paths.gain[0]) == pytest.approx(friis * np.sqrt(1 - 0.1**2), rel=1e-3)


def knife(height, unit):
    s, c = fresnel(height / unit)
    return (1 + 1j) / 2 * ((0.5 - c) - 1j * (0.5 - s))


def test_a_roof_shadows_by_the_rectangle_about_its_silhouette():
    """A prism across a path, 12 m from one end and 18 m from the other. Planted bugs: the edges of
    the first facet alone; the corners' middle for the body's position."""
    roof = np.array(
        [[x, y, z] for y, z in ((-0.5, -0.6), (0.5, -0.6), (0.1, 0.9)) for x in (-1, 1)]
    )
    body = Uav(role="target", position_m=(0.3, 0.0, 0.0), boresight=(0, 1, 0))
    swarm, model = stage(with_solid(body, roof), at=(0, -12.0, 0), pt=(0, 18.0, 0), **STILL)
    unit = np.sqrt(WAVELENGTH * 12 * 18 / (2 * 30))
    across = knife(-0.7, unit) - knife(1.3, unit)
    expected = 1 - across * (knife(-0.6, unit) - knife(0.9, unit))
    line = paths_at(swarm, model, 0.0)
    found = line.gain[line.kind == PathKind.LINE_OF_SIGHT][0] * 4 * np.pi * 30 / WAVELENGTH
    assert found == pytest.approx(expected, abs=1e-6)


def test_a_uav_may_fly_beside_a_hull_within_its_box():
    """Planted bug: depths of the other sign."""
    depths = solid_of(WEDGE).depths(np.array([[0.5, 0.5, 0.5], [1.0, 1.0, 1.0]]))
    assert (depths >= 0).all(axis=1).tolist() == [True, False]


def test_results_and_figures_hold_a_mesh_beside_a_box():
    """The last corner stands for those that a solid lacks in the file. Planted bug: the corners of
    the first box for all."""
    run = fake_run()
    car = box_of((2.0, 6.0, 1.0), position_m=(5, 3, 0.5), boresight=(0, 1, 0))
    wedge = with_solid(car.model_copy(update={"position_m": (9, 1, 0)}), WEDGE)
    radar = Uav(role="active", position_m=(0, 0, 5))
    swarm = Swarm({"AT": radar, "PT1": car, "U1": wedge}, 1.0)
    dataset = _with_boxes(run.dataset, swarm)
    assert dataset.box_corner.sizes["corner"] == 8
    shown = boxes_in(dataset)[2][-1]
    assert shown == pytest.approx(WEDGE[[0, 1, 2, 3, 3, 3, 3, 3]] + np.array([9, 1, 0]))
    traces = moving_scene(dataset, empty_city("", np.zeros(3)))["frames"][2]["data"]
    drawn = next(t for t in traces if t["name"] == "boxes")
    assert len(drawn["x"]) == 16 and len(drawn["i"]) == 12 + 4


def test_a_car_of_a_file_shadows_and_mirrors_as_its_box(tmp_path):
    """The scene with a mesh, beside the box. Planted bug: the folder of the scene left out."""
    trimesh.creation.box((1.8, 4.6, 1.5)).export(tmp_path / "car.ply")
    change = f"swarm.car.box={{file: {tmp_path / 'car.ply'}}}"
    ours, of_box = (
        irt.prepare(irt.load(SCENES / "street_traffic.yaml", c)).find(10)[1]["radar", "radar"]
        for c in ([change], [])
    )
    assert ours.gain == pytest.approx(of_box.gain, rel=1e-4)


def saved(tmp_path, mesh, name="car.stl"):
    mesh.export(tmp_path / name)
    return name


SPIKES = trimesh.creation.icosphere(3)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda at: "none.stl", r"none.stl: cannot be read \(.*No such file.*give a file"),
        (lambda at: saved(at, SPIKES, "car.off"), r"'.off' is not a mesh format.*use one of .ply"),
        (
            lambda at: saved(at, trimesh.creation.box((1800, 4600, 1500))),
            r"4600 m large, 0.01 to 100 m.*millimetres by 0.001",
        ),
        (
            lambda at: saved(at, trimesh.Trimesh(*holed(trimesh.creation.box((2, 4, 1))))),
            r"is open: 3 edges have one triangle; close the mesh",
        ),
        (lambda at: saved(at, SPIKES), r"more than 200 facets; simplify it"),
        (lambda at: empty(at), r"is 0 m large"),
    ],
    ids=["missing", "format", "millimetres", "open", "facets", "empty"],
)
def test_bad_meshes_are_refused_with_file_and_key(tmp_path, make, message):
    """Planted bugs: `require_count=2`; no limit of size; `CityError` let through."""
    file = make(tmp_path)
    change = f"swarm.car.box={{file: {tmp_path / file}}}"
    with pytest.raises(ScenarioError, match=r"swarm.car.box.file.*" + message):
        irt.load(SCENES / "street_traffic.yaml", [change])


def holed(mesh):
    return mesh.vertices, mesh.faces[1:]


def empty(at):
    (at / "car.obj").write_text("v 0 0 0\n")
    return "car.obj"


def test_a_mesh_is_scaled_to_the_size_beside_it():
    """As vehicles of a traffic file have sizes of their own. Planted bug: the length for all."""
    box = Box(corners_m=WEDGE.tolist(), size_m=(1.0, 4.0, 3.0))
    assert solid_of_box("car", box).corners == pytest.approx(WEDGE * [0.5, 2.0, 1.5])


def test_corners_in_a_plane_and_boxes_of_no_size_are_refused():
    """Planted bug: no name in the message."""
    flat = "swarm.car.box={corners_m: [[0,0,0],[1,0,0],[0,1,0],[1,1,0]]}"
    with pytest.raises(UserError, match=r"swarm.car.box.*is flat"):
        irt.prepare(irt.load(SCENES / "street_traffic.yaml", [flat]))
    with pytest.raises(ScenarioError, match=r"car.box.*needs its size_m, or the file of a mesh"):
        irt.load(SCENES / "street_traffic.yaml", ["swarm.car.box={material: glass}"])


def test_a_ball_keeps_its_facets():
    """Euler's V - E + F = 2. Planted bug: `FLAT` of 0.1 m."""
    ball = solid_of(np.asarray(trimesh.creation.icosphere(1).vertices))
    assert len(ball.planes) == 80
    assert len(ball.corners) - len(ball.edges) + len(ball.planes) == 2
