"""The city's mesh, materials and sources against closed forms."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pyproj
import pytest
import trimesh

from isac_rt import scenario
from isac_rt.extensions.city_files.extrude import building
from isac_rt.world.city import CityError, CityMesh, load_city, mesh, parametric
from isac_rt.world.city.georeference import is_lonlat
from isac_rt.world.city.materials import (
    KNOWN_MATERIALS,
    MaterialUse,
    material_at,
)
from isac_rt.world.city.mesh import Surface, clean, distance_to_triangles
from isac_rt.world.city.meshfiles import _triangles
from isac_rt.world.city.prism import Finish
from isac_rt.world.settings import City

F_C = 77e9
ORIGIN = (0.0, 0.0, 0.0)
ROUNDING = (
    1e-9  # coordinates up to 1e5 m carry 1.5e-11 m each in float64; tens of operations follow
)
DATA = Path(__file__).parents[2] / "scenes" / "data"
COURT = [[3.17, 4.41], [33.17, 4.41], [33.17, 28.91], [3.17, 28.91], [3.17, 4.41]]
HOLE = [[9.67, 10.03], [9.67, 20.53], [27.47, 20.53], [27.47, 10.03], [9.67, 10.03]]


def node(**keys) -> scenario.City:
    return scenario.City.model_validate(keys)


def feature(*rings, **properties) -> dict:
    return {
        "type": "Feature",
        "properties": properties,
        "geometry": {"type": "Polygon", "coordinates": [list(r) for r in rings]},
    }


def write(folder: Path, *features, name: str = "town.geojson") -> Path:
    (folder / name).write_text(
        json.dumps({"type": "FeatureCollection", "features": list(features)})
    )
    return folder


def solid(city: CityMesh, chosen: np.ndarray) -> trimesh.Trimesh:
    return trimesh.Trimesh(city.vertices, city.faces[chosen], process=True)


def test_import_leaves_the_ray_tracer_alone():
    """Seen failing with `import mitsuba` at the top of mitsuba_xml.py."""
    code = (
        "import sys, isac_rt.world.city; print(sorted({'sionna', 'mitsuba', 'drjit'} & "
        "set(sys.modules)))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


# ---- extrusion


def test_courtyard_building_is_closed_with_the_right_volume_and_areas(tmp_path):
    """Seen failing with the holes' rings left counter-clockwise (walls of the courtyard facing
    inwards: volume off)."""
    height, margin = 13.7, 21.3
    write(tmp_path, feature(COURT, HOLE, height=height))
    keys = {
        "wall_material": "brick",
        "roof_material": "wood",
        "ground_material": "asphalt",
        "ground_margin_m": margin,
    }
    city = load_city(node(source="footprints", file="town.geojson", **keys), tmp_path, F_C, ORIGIN)
    names = [m.name for m in city.materials]
    of = {name: city.face_material == names.index(name) for name in names}
    plan = 30.0 * 24.5 - 17.8 * 10.5
    perimeter = 2 * (30.0 + 24.5) + 2 * (17.8 + 10.5)
    buffer = (30.0 + 2 * margin) * (24.5 + 2 * margin)
    relative = 1e-12  # a dozen sums of float64
    assert city.areas[of["brick"]].sum() == pytest.approx(perimeter * height, rel=relative)
    assert city.areas[of["wood"]].sum() == pytest.approx(plan, rel=relative)
    assert city.areas[of["asphalt"]].sum() == pytest.approx(plan + buffer, rel=relative)
    closed = np.ones(city.num_faces, dtype=bool)
    closed[-2:] = False  # the ground comes last
    prism = solid(city, closed)
    assert prism.is_watertight
    assert prism.is_winding_consistent
    assert prism.volume == pytest.approx(plan * height, rel=1e-10)


def test_corners_on_straight_walls_leave_no_gap():
    """A plan with a courtyard and several corners on straight walls, on which ear clipping skips
    some.

    Seen failing with the roof triangulated by ear clipping (wall and roof did not share all
    corners).
    """
    import shapely

    ring = [
        (3, 1),
        (3, 2),
        (3, 3),
        (1, 3),
        (1, 17 / 3),
        (1, 25 / 3),
        (1, 11),
        (4, 11),
        (7, 11),
        (7, 9),
        (10, 9),
        (10, 8),
        (10, 5),
        (10, 2),
        (9, 2),
        (9, 1),
        (6, 1),
    ]
    court = [(8, 3), (8, 5), (7, 5), (7, 3)]
    parts = building(
        shapely.Polygon(ring, [court]), -1.5, 8.25, Finish(*[MaterialUse("concrete")] * 3), "house"
    )
    mesh = trimesh.Trimesh(
        parts[0].vertices, np.concatenate([p.faces for p in parts]), process=True
    )
    assert mesh.is_watertight
    area = (
        9 * 10 - 2 * 2 - 1 * 1 - 3 * 2 - 1 * 2
    )  # the bounding box less its notches and the courtyard
    assert mesh.volume == pytest.approx(area * 9.75, rel=1e-12)  # rounding


def test_every_building_of_the_sample_quarter_is_closed():
    """Seen failing with a roof one metre above the walls."""
    city = load_city(
        node(source="footprints", file="quarter.geojson", ground_material="glass"),
        DATA,
        F_C,
        ORIGIN,
    )
    solids = trimesh.Trimesh(city.vertices, city.faces[:-2], process=False).split(
        only_watertight=True
    )
    assert len(solids) == 13
    tallest = max(body.bounds[1, 2] for body in solids)
    assert tallest == 41.0
    assert any("without 'height'" in note for note in city.notes)
    assert sum(body.volume for body in solids) > 0


def test_self_crossing_outline_is_repaired_and_a_line_refused(tmp_path):
    """Seen failing without make_valid (the bow tie's signed areas cancel)."""
    bow = [[0, 0], [20, 20], [20, 0], [0, 20], [0, 0]]
    write(tmp_path, feature(bow, height=10.0))
    city = load_city(
        node(source="footprints", file="town.geojson", wall_material="brick"), tmp_path, F_C, ORIGIN
    )
    body = solid(city, np.arange(city.num_faces) < city.num_faces - 2)
    assert body.volume == pytest.approx(200.0 * 10.0, rel=1e-9)  # two triangles of 100 m2
    write(tmp_path, feature([[0, 0], [20, 20], [40, 40], [0, 0]], height=10.0))
    with pytest.raises(CityError, match="feature 0"):
        load_city(node(source="footprints", file="town.geojson"), tmp_path, F_C, ORIGIN)


# ---- coordinates


def test_recentring_far_from_the_origin_is_exact(tmp_path):
    """Seen failing with the vertices cast to float32 on reading."""
    shift = np.array([412_345.125, 5_332_100.75])
    write(tmp_path, feature((np.array(COURT) + shift).tolist(), height=9.1))
    write(tmp_path, feature(COURT, height=9.1), name="near.geojson")
    centre = np.array([shift[0] + 11.1, shift[1] + 7.7, 31.3])
    city = load_city(node(source="footprints", file="town.geojson"), tmp_path, F_C, centre)
    near = load_city(
        node(source="footprints", file="near.geojson"), tmp_path, F_C, [11.1, 7.7, 31.3]
    )
    rounding = 4e-9  # float64 spacing at 5e6 m is 9e-10
    found, expected = (
        np.sort(city.corners.reshape(-1, 3), axis=0),
        np.sort(near.corners.reshape(-1, 3), axis=0),
    )
    assert np.abs(found - expected).max() < rounding
    assert np.array_equal(city.origin, centre)


def test_lonlat_distances_match_the_geodesic(tmp_path):
    """Seen failing with degrees scaled on a sphere (0.3 % short to the north)."""
    lon, lat = np.array([11.5703, 11.5829]), np.array([48.1342, 48.1417])
    features = []
    for x, y in zip(lon, lat, strict=True):
        d = 1e-4
        features.append(
            feature([[x, y], [x + d, y], [x + d, y + d], [x, y + d], [x, y]], height=8.0)
        )
    write(tmp_path, *features)
    city = load_city(
        node(source="footprints", file="town.geojson", ground_margin_m=0.0), tmp_path, F_C, ORIGIN
    )
    flat = city.vertices[city.vertices[:, 2] > 1]
    first, last = flat[np.argmin(flat.sum(axis=1))], flat[np.argmax(flat.sum(axis=1))]
    _, _, geodesic = pyproj.Geod(ellps="WGS84").inv(lon[0], lat[0], lon[1] + 1e-4, lat[1] + 1e-4)
    assert geodesic > 1000
    # through the centre the projection keeps distances; the corners are the bounding box's own
    # diagonal
    assert np.linalg.norm(last - first) == pytest.approx(geodesic, rel=1e-6)
    assert any("48.138" in note for note in city.notes)


def test_metres_and_degrees_are_told_apart():
    small_town_in_metres = np.array([[-40.0, -30.0, -18.0, -4.0], [12.0, 5.0, 41.0, 33.0]])
    degrees = np.array([[11.57, 48.13, 11.5703, 48.1302]])
    assert not is_lonlat(small_town_in_metres)
    assert is_lonlat(degrees)
    assert not is_lonlat(degrees * 1e5)


def test_swapped_longitude_and_latitude(tmp_path):
    write(
        tmp_path,
        feature([[35.1, 139.7], [35.1002, 139.7], [35.1002, 139.7002], [35.1, 139.7]], height=5.0),
    )
    with pytest.raises(CityError, match="swapped"):
        load_city(
            node(source="footprints", file="town.geojson", coordinates="lonlat"),
            tmp_path,
            F_C,
            ORIGIN,
        )


# ---- planes


def test_faces_of_one_wall_share_a_plane_whichever_way_they_face():
    """Seen failing with the plane's sign left in the comparison (the reversed face got its own
    plane)."""
    rng = np.random.default_rng(11)
    basis, _ = np.linalg.qr(rng.normal(size=(3, 3)))
    u, v, n = basis.T

    def tri(offset, flip=False):
        p = rng.uniform(-40, 40, (3, 2))
        t = offset * n + p[:, :1] * u + p[:, 1:] * v
        return t[::-1] if flip else t

    triangles = [tri(17.3), tri(17.3, flip=True), tri(17.3), tri(17.3 + 1e-3), tri(-17.3)]
    surface = Surface(
        np.concatenate(triangles), np.arange(15).reshape(5, 3), MaterialUse("concrete")
    )
    vertices, faces, _, _, tolerance = clean([surface], "walls", np.zeros(3), None)
    city = CityMesh("walls", vertices, faces, np.zeros(5, np.int16), (), np.zeros(3), (), tolerance)
    planes = city.plane_of_face
    assert planes[0] == planes[1] == planes[2]
    assert len({planes[0], planes[3], planes[4]}) == 3
    residual = np.einsum("fi,fki->fk", city.normals, city.corners) - city.plane_offsets[:, None]
    assert np.abs(residual).max() < ROUNDING


def test_float32_files_get_their_own_plane_tolerance():
    city = load_city(node(source="builtin", name="box"), ".", F_C, ORIGIN)
    assert city.plane_of_face.max() + 1 == 6
    canyon = load_city(
        node(source="builtin", name="simple_street_canyon"), ".", F_C, (3.3, 1.7, 20.1)
    )
    assert 1e-6 < canyon.plane_tolerance < 1e-4


@pytest.mark.parametrize("sweep", [3, 256])
def test_planes_of_boxes_are_those_of_a_search_through_all_faces(sweep, monkeypatch):
    """Boxes that share some planes and not others. Planted bugs: a plane taken for all that touch
    it with one corner; faces that have a plane get another one."""
    rng = np.random.default_rng(9)
    faces = []
    for x, height in zip(rng.uniform(-50, 50, 12), rng.choice([5.25, 8.5], 12), strict=True):
        start = rng.choice([0.0, 0.8e-6, 1.6e-6])  # the second in the planes of both others
        a, b = np.array([x, start, 0.0]), np.array([x + 3.3, 7.7, height])
        for axis in range(3):
            for end in (a, b):
                square = np.array([a, a, b, b])
                square[[1, 2], (axis + 1) % 3] = b[(axis + 1) % 3]
                square[[0, 3], (axis + 1) % 3] = a[(axis + 1) % 3]
                square[:, axis] = end[axis]
                faces += [square[[0, 1, 2]], square[[0, 2, 3]]]
    corners = np.array(faces)
    areas = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    size = np.linalg.norm(areas, axis=1)
    order = np.argsort(-size, kind="stable")
    corners, normals = corners[order], (areas / size[:, None])[order]
    offsets = (normals * corners[:, 0]).sum(axis=1)
    expected = np.full(len(corners), -1)
    for seed in range(len(corners)):
        if expected[seed] < 0:
            apart = [abs(normals[seed] @ corner.T - offsets[seed]).max() for corner in corners]
            expected[(expected < 0) & (np.array(apart) <= 1e-6)] = expected.max() + 1
    assert len(set(expected)) < len(expected) / 2
    monkeypatch.setattr(mesh, "PLANES_PER_SWEEP", sweep)
    np.testing.assert_array_equal(mesh.group_planes(corners, normals, offsets, 1e-6), expected)


# ---- cleaning


def test_bad_faces_are_removed_and_counted():
    vertices = np.array([[0.0, 0, 0], [4, 0, 0], [0, 3, 0], [2, 0, 0], [9, 9, 9]])
    faces = np.array([[0, 1, 2], [2, 1, 0], [0, 3, 1], [1, 1, 2], [0, 1, 4]])
    _, kept, _, notes, _ = clean(
        [Surface(vertices, faces, MaterialUse("metal"))], "x", np.zeros(3), None
    )
    assert len(kept) == 2
    assert "2 faces without area removed" in notes
    assert "1 repeated faces removed" in notes
    with pytest.raises(CityError, match="1 of 5 vertices are NaN"):
        clean(
            [Surface(np.where(vertices == 3, np.nan, vertices), faces, MaterialUse("metal"))],
            "x",
            np.zeros(3),
            None,
        )
    with pytest.raises(CityError, match="names vertex 7"):
        clean([Surface(vertices, faces[:1] + 5, MaterialUse("metal"))], "x", np.zeros(3), None)
    with pytest.raises(CityError, match="no face with an area"):
        clean([Surface(vertices, faces[2:4], MaterialUse("metal"))], "x", np.zeros(3), None)


def by_plane_and_sides(corners, point):
    """Distances (F,) to triangles (F, 3, 3): the height over the plane above the inside, else the
    nearest side's."""
    a = corners - point
    sides = np.roll(a, -1, axis=1) - a
    along = np.clip(-(a * sides).sum(axis=-1) / (sides**2).sum(axis=-1), 0.0, 1.0)
    beside = np.linalg.norm(a + along[..., None] * sides, axis=-1).min(axis=1)
    normal = np.cross(sides[:, 0], sides[:, 1])
    over = (np.einsum("fei,fi->fe", np.cross(a, sides), normal) >= 0).all(axis=1)
    height = np.abs((a[:, 0] * normal).sum(axis=1)) / np.linalg.norm(normal, axis=1)
    return np.where(over, height, beside)


def test_distances_to_triangles_are_those_to_plane_and_sides():
    """3,000 of three sizes, about the point and far from it, and one that is a line. Planted bugs:
    the plane's distance beside the triangle; lines that go on beyond their ends."""
    rng = np.random.default_rng(11)
    corners = rng.normal(size=(3000, 3, 3)) * rng.choice([0.01, 1, 80], size=(3000, 1, 1))
    corners += rng.normal(size=(3000, 1, 3)) * rng.choice([0, 3, 100], size=(3000, 1, 1))
    point = np.array([0.3, -0.2, 0.1])
    expected, found = by_plane_and_sides(corners, point), distance_to_triangles(corners, point)
    assert np.allclose(found, expected, rtol=1e-9, atol=1e-11)  # sums of numbers up to 300
    line = np.array([[[2.0, 0, 0], [5.0, 0, 0], [3.0, 0, 0]]])
    assert distance_to_triangles(line, np.zeros(3)) == pytest.approx([2.0])


def test_cropping_keeps_whole_faces_that_reach_into_the_radius():
    """Seen failing with the distance taken to the centroid (the large ground triangles vanish)."""
    city = node(source="blocks", blocks_x=5, blocks_y=5, keep_radius_m=45.0, block_size_m=30.0)
    small = load_city(city, ".", F_C, (0, 0, 30.0))
    whole = load_city(city.model_copy(update={"keep_radius_m": None}), ".", F_C, (0, 0, 30.0))
    assert 0 < small.num_faces < whole.num_faces
    weights = np.random.default_rng(3).dirichlet(np.ones(3), 20_000)
    brute = np.array([np.linalg.norm(weights @ c, axis=1).min() for c in whole.corners])
    exact = distance_to_triangles(whole.corners, np.zeros(3))
    assert (exact <= brute + ROUNDING).all()
    assert np.median(brute - exact) < 1.0  # sampling: 20 000 points on faces of up to 300 m
    assert small.num_faces == (exact <= 45.0).sum()
    assert (small.normals[:, 2] > 0.99).sum() >= 2  # the ground stays
    with pytest.raises(CityError, match="keep_radius_m"):
        load_city(city, ".", F_C, (0, 0, 500.0))


# ---- materials


def test_concrete_and_interpolated_brick_at_77_ghz():
    """P.2040 written out by hand. Seen failing with f in Hz inside the power law."""
    concrete = material_at("mat-itu_concrete", F_C)
    assert concrete.relative_permittivity == 5.24
    assert concrete.conductivity == pytest.approx(
        0.0462 * 10 ** (0.7822 * np.log10(77.0)), rel=1e-12
    )
    brick = material_at("brick", F_C)
    w = np.log(77 / 40) / np.log(110 / 40)
    assert brick.relative_permittivity == pytest.approx(3.91 + w * (4.15 - 3.91), rel=1e-12)
    edges = 0.0238 * 40**0.16, 0.0006 * 110**1.5712
    assert brick.conductivity == pytest.approx(edges[0] ** (1 - w) * edges[1] ** w, rel=1e-12)
    assert "interpolated" in brick.source
    assert "continued to 77 GHz" in material_at("asphalt", F_C).source
    assert "Dobson" in material_at("wet_ground", F_C).source
    assert material_at("metal", F_C).conductivity == 1e7
    assert "P.2040" in material_at("wet_ground", 5.9e9).source


def test_every_material_is_physical_from_1_to_300_ghz():
    for name in KNOWN_MATERIALS:
        for f in (1.3e9, 9.7e9, 38e9, 61e9, 77e9, 79.5e9, 105e9, 240e9):
            m = material_at(name, f)
            assert m.relative_permittivity >= 1, (name, f)
            assert 0 <= m.conductivity < 2e7, (name, f)
            assert 0 <= m.scattering_coefficient <= 1
            assert m.source


def test_overrides_new_materials_and_unknown_names():
    keys = {"source": "canyon", "wall_material": "stucco", "roof_material": "glass"}
    given = {
        "stucco": {
            "relative_permittivity": 3.3,
            "conductivity_s_per_m": 0.21,
            "scattering_coefficient": 0.37,
        },
        "glass": {"scattering_pattern": "directive", "thickness_m": 0.021},
    }
    city = load_city(node(**keys, materials=given), ".", F_C, ORIGIN)
    by_name = {m.name: m for m in city.materials}
    assert (by_name["stucco"].relative_permittivity, by_name["stucco"].conductivity) == (3.3, 0.21)
    assert by_name["stucco"].scattering_coefficient == 0.37
    assert by_name["glass"].scattering_pattern == "directive"
    assert (by_name["glass"].pattern_exponent, by_name["glass"].thickness) == (4, 0.021)
    assert by_name["glass"].relative_permittivity == 6.31
    assert "scenario: scattering_pattern" in by_name["glass"].source
    with pytest.raises(CityError, match="known are asphalt"):
        load_city(node(**keys), ".", F_C, ORIGIN)
    with pytest.raises(CityError, match="must both be given"):
        load_city(
            node(**keys, materials={"stucco": {"relative_permittivity": 2.0}}), ".", F_C, ORIGIN
        )


# ---- sources


@pytest.mark.parametrize(
    ("name", "faces"),
    [
        ("floor_wall", 4),
        ("simple_reflector", 2),
        ("double_reflector", 4),
        ("triple_reflector", 6),
        ("box", 12),
        ("simple_street_canyon", 74),
    ],
)
def test_builtin_scenes(name, faces):
    centre = np.array([1.3, -0.7, 2.1])
    city = load_city(node(source="builtin", name=name), ".", F_C, centre)
    assert city.num_faces == faces
    assert np.allclose(np.linalg.norm(city.normals, axis=1), 1, rtol=0, atol=1e-14)  # rounding
    assert city.areas.min() > 0
    assert all(m.source for m in city.materials)


def test_munich():
    city = load_city(
        node(source="builtin", name="munich", keep_radius_m=250.0), ".", F_C, (30.0, 40.0, 35.0)
    )
    assert 5_000 < city.num_faces < 38_936
    assert {m.name for m in city.materials} <= {"marble", "metal", "brick", "wood", "concrete"}
    assert distance_to_triangles(city.corners, np.zeros(3)).max() <= 250.0


def test_unknown_builtin_lists_those_there_are():
    with pytest.raises(CityError, match=r"munich.*simple_street_canyon"):
        load_city(node(source="builtin", name="muenchen"), ".", F_C, ORIGIN)


def test_mitsuba_transforms_defaults_and_own_materials(tmp_path):
    """A rectangle carried by scale, rotation and translation, corner by corner. Seen failing with
    the order reversed."""
    (tmp_path / "wall.xml").write_text("""<scene version="2.1.0"><default name="up" value="6.5"/>
      <bsdf type="radio-material" id="mat-plaster"><float name="relative_permittivity" value="2.9"/>
        <float name="conductivity" value="0.4"/><float name="thickness" value="0.03"/></bsdf>
      <shape type="rectangle" id="wall"><transform name="to_world"><scale x="3" y="2"/>
        <rotate x="1" angle="90"/><translate x="10" y="20" z="$up"/></transform>
        <ref id="mat-plaster" name="bsdf"/></shape></scene>""")
    city = load_city(node(source="mitsuba", file="wall.xml"), tmp_path, F_C, ORIGIN)
    expected = [[7, 20, 4.5], [7, 20, 8.5], [13, 20, 4.5], [13, 20, 8.5]]
    assert np.allclose(city.vertices, expected, rtol=0, atol=1e-14)  # rounding
    (material,) = city.materials
    assert (material.relative_permittivity, material.conductivity, material.thickness) == (
        2.9,
        0.4,
        0.03,
    )


def test_mitsuba_cube_faces_outward(tmp_path):
    """Seen failing with one of the cube's triangles reversed."""
    (tmp_path / "c.xml").write_text(
        '<scene version="2.1.0"><shape type="cube"><bsdf type="diffuse" '
        'id="mat-itu_wood"/></shape></scene>'
    )
    city = load_city(node(source="mitsuba", file="c.xml"), tmp_path, F_C, ORIGIN)
    body = solid(city, np.arange(12))
    assert body.is_watertight
    assert body.volume == pytest.approx(8.0, rel=1e-14)  # rounding
    assert [m.name for m in city.materials] == ["wood"]


def test_triangles_of_a_strip_and_of_a_fan_face_one_way():
    """A strip in zigzag and a fan, both wound counterclockwise as seen from above, by the cross
    products of their edges. Planted bug: every second triangle of a strip turned over."""
    strip = np.array([[i, i % 2, 0.1 * i] for i in range(7)])
    # the first triangle of glTF's strip is v0, v1, v2: here clockwise
    angle = np.linspace(0, 3, 6)
    fan = np.vstack([[0, 0, 0], np.stack([np.cos(angle), np.sin(angle), 0 * angle], axis=1)])
    for corners, mode, count, up in ((strip, 5, 5, -1), (fan, 6, 5, 1)):
        faces = _triangles(np.arange(len(corners)), mode)
        a, b, c = (corners[faces[:, k]] for k in range(3))
        assert len(faces) == count
        assert (np.sign(np.cross(b - a, c - a)[:, 2]) == up).all()


def test_glb_up_axis_transform_scale_and_materials(tmp_path):
    """Seen failing with the node's transform left out, and with y-up turned the wrong way."""
    box = trimesh.creation.box((2.0, 5.0, 3.0))  # x, up, depth
    plate = trimesh.creation.box((1.0, 1.0, 1.0))
    box.visual = trimesh.visual.TextureVisuals(
        material=trimesh.visual.material.PBRMaterial(name="itu_glass")
    )
    scene = trimesh.Scene()
    move = np.eye(4)
    move[:3, 3] = [7.0, 2.5, -11.0]
    scene.add_geometry(box, node_name="tower", geom_name="tower", transform=move)
    scene.add_geometry(plate, node_name="plate", geom_name="plate")
    scene.export(tmp_path / "yard.glb")
    keys = {
        "source": "mesh",
        "file": "yard.glb",
        "up_axis": "y",
        "scale": 1.5,
        "material_map": {"plate": "metal"},
    }
    city = load_city(node(**keys), tmp_path, F_C, ORIGIN)
    names = [m.name for m in city.materials]
    assert sorted(names) == ["glass", "metal"]
    glass = city.corners[city.face_material == names.index("glass")].reshape(-1, 3)
    float32 = 2e-6  # GLB holds float32
    assert np.allclose(glass.min(axis=0), 1.5 * np.array([6.0, 9.5, 0.0]), rtol=0, atol=float32)
    assert np.allclose(glass.max(axis=0), 1.5 * np.array([8.0, 12.5, 5.0]), rtol=0, atol=float32)
    with pytest.raises(CityError, match="roof, which the file lacks"):
        load_city(node(**{**keys, "material_map": {"roof": "metal"}}), tmp_path, F_C, ORIGIN)


def test_sample_hangars_stand_upright():
    mapping = {"corrugated_metal": "metal", "window": "glass", "tarmac": "asphalt"}
    city = load_city(
        node(source="mesh", file="hangars.obj", up_axis="y", material_map=mapping),
        DATA,
        F_C,
        ORIGIN,
    )
    assert city.bounds()[:, 2].tolist() == [0.0, 29.6]
    names = [m.name for m in city.materials]
    assert sorted(names) == ["asphalt", "concrete", "glass", "metal"]
    apron = city.areas[city.face_material == names.index("asphalt")].sum()
    assert apron == pytest.approx(280 * 260, rel=1e-12)  # rounding


@pytest.mark.parametrize("suffix", ["stl", "ply", "obj"])
def test_the_other_mesh_formats(tmp_path, suffix):
    trimesh.creation.icosphere(subdivisions=1, radius=4.0).export(tmp_path / f"ball.{suffix}")
    city = load_city(
        node(source="mesh", file=f"ball.{suffix}", material="wood"), tmp_path, F_C, ORIGIN
    )
    assert city.num_faces == 80
    assert [m.name for m in city.materials] == ["wood"]
    assert np.allclose(
        np.linalg.norm(city.vertices, axis=1), 4.0, rtol=0, atol=1e-6
    )  # float32 files


def test_missing_and_unreadable_files(tmp_path):
    with pytest.raises(CityError, match="does not exist"):
        load_city(node(source="mesh", file="nothing.ply"), tmp_path, F_C, ORIGIN)
    (tmp_path / "bad.ply").write_text("ply\nnot really\n")
    (tmp_path / "town.geojson").write_text("{")
    (tmp_path / "empty.geojson").write_text('{"type": "FeatureCollection", "features": []}')
    for source, file, text in (
        ("mesh", "bad.ply", "not readable"),
        ("footprints", "town.geojson", "JSON"),
        ("footprints", "empty.geojson", "no polygon"),
    ):
        with pytest.raises(CityError, match=text):
            load_city(node(source=source, file=file), tmp_path, F_C, ORIGIN)
    write(tmp_path, feature(COURT, height="high"))
    with pytest.raises(CityError, match="'high'"):
        load_city(node(source="footprints", file="town.geojson"), tmp_path, F_C, ORIGIN)


def cityjson(lod: str, geometry: list, kind: str, **attributes) -> dict:
    corners = [
        [x, y, z] for z in (0, 8200) for x, y in ((0, 0), (12400, 0), (12400, 9100), (0, 9100))
    ]
    return {
        "type": "CityJSON",
        "version": "2.0",
        "transform": {"scale": [1e-3] * 3, "translate": [690_100.5, 5_334_000.25, 511.5]},
        "CityObjects": {
            "a": {
                "type": "Building",
                "attributes": attributes,
                "geometry": [
                    {
                        "type": kind,
                        "lod": lod,
                        "boundaries": geometry,
                        "semantics": {"surfaces": [{"type": "RoofSurface"}], "values": [[None, 0]]},
                    }
                ],
            }
        },
        "vertices": corners,
    }


SHELL = [
    [[0, 3, 2, 1]],
    [[4, 5, 6, 7]],
    [[0, 1, 5, 4]],
    [[1, 2, 6, 5]],
    [[2, 3, 7, 6]],
    [[3, 0, 4, 7]],
]


@pytest.mark.parametrize("lod", ["2.2", "0"])
def test_cityjson_solid_and_footprint(tmp_path, lod):
    """Seen failing with `transform.translate` left out, and with the roof's semantics read one list
    too high."""
    if lod == "0":
        document = cityjson(lod, [[[0, 1, 2, 3]]], "MultiSurface", measuredHeight=8.2)
    else:
        document = cityjson(lod, [SHELL], "Solid")
    (tmp_path / "town.city.json").write_text(json.dumps(document))
    keys = {"wall_material": "brick", "roof_material": "wood", "ground_margin_m": 10.0}
    city = load_city(
        node(source="footprints", file="town.city.json", **keys),
        tmp_path,
        F_C,
        (690_100.5, 5_334_000.25, 511.5),
    )
    body = solid(city, np.arange(city.num_faces) < city.num_faces - 2)
    assert body.is_watertight
    rounding = 1e-7  # heights and sides carry 1e-9 m at 5e6 m
    assert body.volume == pytest.approx(12.4 * 9.1 * 8.2, rel=rounding)
    roof = city.areas[city.face_material == [m.name for m in city.materials].index("wood")].sum()
    assert roof == pytest.approx(12.4 * 9.1, rel=rounding)
    assert city.bounds()[0, 2] == pytest.approx(0.0, abs=ROUNDING)


@pytest.mark.parametrize(
    ("said", "height"),
    [
        ({"b3_h_maaiveld": -0.62, "b3_h_dak_70p": 6.91, "b3_h_dak_max": 9.4}, 7.53),
        ({"b3_h_maaiveld": -0.62, "b3_h_dak_70p": None, "b3_h_dak_max": 9.4}, 10.02),
        ({"b3_h_maaiveld": -0.62, "b3_h_dak_70p": 6.91, "measuredHeight": "8,2"}, 8.2),
        ({"b3_h_maaiveld": None, "b3_h_dak_70p": 6.91}, 10.0),
        ({"b3_h_maaiveld": 3.0, "b3_h_dak_70p": 1.0}, 10.0),
    ],
)
def test_heights_of_the_3d_bag(tmp_path, said, height):
    """Roof over ground of a building that could not be reconstructed; a height that is stated goes
    before it, and where nothing is known the default holds. Planted bug: the roof over the sea."""
    document = cityjson("0", [[[0, 1, 2, 3]]], "MultiSurface", **said)
    (tmp_path / "town.city.json").write_text(json.dumps(document))
    source = node(source="footprints", file="town.city.json", ground_margin_m=10.0)
    low, high = load_city(source, tmp_path, F_C, (690_100.5, 5_334_000.25, 511.5)).bounds()
    assert high[2] - low[2] == pytest.approx(height, abs=1e-6)


def test_canyon_has_its_street():
    keys = {
        "street_width_m": 17.3,
        "street_length_m": 90.7,
        "building_height_m": 22.1,
        "height_spread_m": 4.0,
    }
    city = load_city(node(source="canyon", **keys), ".", F_C, ORIGIN)
    facing = np.abs(city.normals[:, 0]) > 0.99
    inner = facing & (np.abs(np.abs(city.corners[:, :, 0]).max(axis=1) - 17.3 / 2) < ROUNDING)
    assert inner.any()
    assert np.ptp(city.corners[inner][:, :, 1]) == pytest.approx(90.7, abs=ROUNDING)
    tops = city.corners[inner][:, :, 2].max(axis=1)
    assert ((tops > 18.1 - ROUNDING) & (tops < 26.1)).all()
    assert len(set(tops)) > 2
    with pytest.raises(CityError, match="height_spread_m"):
        load_city(node(source="canyon", height_spread_m=30.0), ".", F_C, ORIGIN)


def test_no_city_is_free_space():
    city = load_city(None, ".", F_C, (5.0, 6.0, 7.0))
    assert city.num_faces == 0
    assert city.plane_of_face.size == city.areas.size == 0
    assert city.normals.shape == (0, 3)
    assert city.origin.tolist() == [5.0, 6.0, 7.0]


def test_a_box_of_a_canyon_is_the_prism_over_its_rectangle():
    """Corner by corner as shapely triangulates it. Planted bug: the other diagonal."""
    import shapely

    city = City(source="canyon", block_size_m=17.3, street_length_m=51.9, street_width_m=13.7)
    surfaces = parametric.canyon(city)
    finish = Finish(surfaces[0].material, surfaces[1].material, surfaces[2].material)
    for k in range(0, len(surfaces) - 1, 3):
        low, high = surfaces[k].vertices.min(axis=0), surfaces[k].vertices.max(axis=0)
        box = shapely.box(*low[:2], *high[:2])
        for made, drawn in zip(
            building(box, 0.0, high[2], finish, "box"), surfaces[k : k + 3], strict=True
        ):
            np.testing.assert_array_equal(made.vertices, drawn.vertices)
            np.testing.assert_array_equal(made.faces, drawn.faces)
