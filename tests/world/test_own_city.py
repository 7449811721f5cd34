"""Maps of one's own as they come: OpenStreetMap's tags, coordinates of every kind, the ground."""

from __future__ import annotations

import gzip
import json
from pathlib import Path

import numpy as np
import pyproj
import pytest
import trimesh
from hypothesis import given
from hypothesis import strategies as st

from isac_rt import scenario
from isac_rt.world.city import CityError, CityMesh, files, load_city
from isac_rt.world.city.heights import parse_length

F_C = 77e9


def square(x: float, y: float, side: float, depth: float | None = None) -> list[list[float]]:
    d = side if depth is None else depth
    return [[x, y], [x + side, y], [x + side, y + d], [x, y + d], [x, y]]


def feature(rings: list, kind: str = "Polygon", **properties) -> dict:
    geometry = {"type": kind, "coordinates": rings}
    return {"type": "Feature", "properties": properties, "geometry": geometry}


def written(folder: Path, *features, name: str = "town.geojson", **members) -> Path:
    document = {"type": "FeatureCollection", "features": list(features), **members}
    (folder / name).write_text(json.dumps(document))
    return folder


def read(folder: Path, file: str = "town.geojson", **keys) -> CityMesh:
    metres = {"coordinates": "metres"} if file.endswith(".geojson") and "crs" not in keys else {}
    node = scenario.City.model_validate({"source": "footprints", "file": file, **metres, **keys})
    return load_city(node, folder, F_C, (0.0, 0.0, 0.0))


def body(city: CityMesh, ground_faces: int = 2) -> trimesh.Trimesh:
    return trimesh.Trimesh(city.vertices, city.faces[: city.num_faces - ground_faces])


def said(city: CityMesh, *words: str) -> bool:
    return any(all(word in note for word in words) for note in city.notes)


# ---- heights


@pytest.mark.parametrize(
    ("text", "metres"),
    [
        ("12.5", 12.5),
        ("12,5", 12.5),
        (" 12 m", 12.0),
        ("12m.", 12.0),
        ("~12", 12.0),
        ("ca. 12 m", 12.0),
        ("40'", 40 * 0.3048),
        ("40 ft", 40 * 0.3048),
        ("131'3\"", 131 * 0.3048 + 3 * 0.0254),
        ("131 ft 3 in", 131 * 0.3048 + 3 * 0.0254),
        ("10;12", 12.0),
        ("10-12", 12.0),
        ("1,234.5", 1234.5),
        ("1.234,5", 1234.5),
        (7, 7.0),
        ("", None),
        (None, None),
    ],
)
def test_heights_as_people_write_them(text, metres):
    """Seen failing: "12,5" ended the whole file. Planted bug: inches as tenths of feet."""
    assert parse_length(text) == (metres if metres is None else pytest.approx(metres, rel=1e-12))


@pytest.mark.parametrize("text", ["high", "-4", "1.2.3", "5 km", True, [1], 1e9, "9" * 5000, "1e4"])
def test_what_is_no_height(text):
    with pytest.raises(ValueError, match="no height"):
        parse_length(text)


@given(st.integers(0, 99999), st.sampled_from([".", ","]), st.sampled_from(["", " m", "m"]))
def test_any_decimal_mark(centimetres, mark, unit):
    whole, rest = divmod(centimetres, 100)
    assert parse_length(f"{whole}{mark}{rest:02d}{unit}") == pytest.approx(centimetres / 100)


# ---- OpenStreetMap


def test_only_buildings_become_buildings(tmp_path):
    """Seen failing: land use and water were blocks ten metres high. Planted bug: `building=no`
    stands."""
    written(
        tmp_path,
        feature([square(0, 0, 20)], building="yes", height="12,5"),
        feature([square(30, 0, 20)], building="no", height="30"),
        feature([square(-500, -500, 2000)], landuse="residential"),
        feature([square(60, 0, 20)], natural="water"),
        feature([square(90, 0, 20)], building="garage", location="underground"),
        feature([0.0, 0.0], "Point", highway="crossing"),
        feature([[0, 0], [9, 9]], "LineString", highway="residential"),
        feature(square(0, 40, 10), "LineString", building="hut", height=4),
    )
    city = read(tmp_path)
    assert body(city).volume == pytest.approx(20 * 20 * 12.5 + 10 * 10 * 4)
    for words in ("1 of landuse", "1 of natural", "2 without a polygon", "1 underground"):
        assert said(city, words)


@pytest.mark.parametrize("nested", ["flat", "tags", "text", "other_tags"])
def test_tags_wherever_exports_put_them(nested, tmp_path):
    tags = {"building": "yes", "building:levels": "4", "roof:levels": "1", "@id": "way/7"}
    properties = {
        "flat": tags,
        "tags": {"tags": tags},
        "text": {"tags": json.dumps(tags)},
        "other_tags": {
            "building": "yes",
            "other_tags": '"building:levels"=>"4","roof:levels"=>"1"',
        },
    }[nested]
    written(tmp_path, feature([square(0, 0, 20)], **properties))
    assert read(tmp_path).bounds()[1, 2] == 5 * 3.0


def test_what_begins_above_the_ground(tmp_path):
    """A bridge between houses, and a canopy."""
    written(
        tmp_path,
        feature([square(0, 0, 20)], building="yes", height=15, min_height="5"),
        feature(
            [square(40, 0, 10)],
            **{"building:part": "yes", "building:levels": 6, "building:min_level": 4},
        ),
        feature([square(80, 0, 10)], building="roof", height=6),
    )
    city = read(tmp_path)
    z = {x: city.vertices[np.isin(city.vertices[:, 0], (x,)), 2].min() for x in (0.0, 40.0, 80.0)}
    assert z == pytest.approx({0.0: 5.0, 40.0: 12.0, 80.0: 5.7})
    assert body(city).is_watertight


def test_parts_replace_their_outline(tmp_path):
    """Planted bug: both stand. A part that covers a corner only leaves the outline."""
    part = {"building:part": "yes"}
    written(
        tmp_path,
        feature([square(0, 0, 40)], building="yes", height=30),
        feature([square(0, 0, 20, 40)], **part, height=10),
        feature([square(20, 0, 20, 40)], **part, height=25),
        feature([square(100, 0, 40)], building="yes", height=20),
        feature([square(105, 5, 10)], **part, height=50),
    )
    city = read(tmp_path)
    left = city.vertices[(city.vertices[:, 0] <= 40) & (city.vertices[:, 0] >= 0)]
    assert left[:, 2].max() == 25
    right = city.corners[(city.corners[:, :, 0] >= 100).all(axis=1)]
    assert set(np.round(right[:, :, 2].ravel(), 9)) >= {20.0, 50.0}
    assert said(city, "1 buildings drawn by their 2 parts")
    assert said(city, "less than half")


@pytest.mark.parametrize(
    ("shape", "share", "extra"),
    [
        ("gabled", 1 / 2, {}),
        ("gabled", 1 / 2, {"roof:orientation": "across"}),
        ("hipped", 1 / 2 - 12 / (6 * 30), {}),
        ("pyramidal", 1 / 3, {}),
        ("dome", 1.0, {}),
    ],
)
def test_simple_roofs(shape, share, extra, tmp_path):
    """Volumes of prism, hip, pyramid and box over 30 x 12 m turned by 0.4 rad. Planted bug: the
    ridge between the longer sides of a hip."""
    c, s = np.cos(0.4), np.sin(0.4)
    ring = [[x * c - y * s, x * s + y * c] for x, y in square(3, 5, 30, 12)]
    tags = {"building": "house", "height": 11, "roof:height": 4, "roof:shape": shape, **extra}
    written(tmp_path, feature([ring], **tags))
    city = read(tmp_path)
    assert body(city).is_watertight
    assert body(city).volume == pytest.approx(30 * 12 * (7 + 4 * share), rel=1e-9)
    assert city.bounds()[1, 2] == pytest.approx(11)
    assert said(city, "roofs drawn flat", "1 dome") == (shape == "dome")


def test_a_roof_over_a_plan_that_is_not_simple_is_flat_and_said(tmp_path):
    ell = [[0, 0], [30, 0], [30, 10], [10, 10], [10, 30], [0, 30], [0, 0]]
    tags = {"building": "yes", "height": 9, "roof:shape": "gabled"}
    city = read(written(tmp_path, feature([ell], **tags)))
    assert body(city).volume == pytest.approx(500 * 9)
    assert said(city, "roofs drawn flat", "gabled")


def test_multipolygons_with_courts(tmp_path):
    court = square(5, 5, 10)[::-1]
    shape = [[square(0, 0, 20), court], [square(50, 0, 10)]]
    city = read(written(tmp_path, feature(shape, "MultiPolygon", building="yes", height=10)))
    assert body(city).volume == pytest.approx((400 - 100 + 100) * 10)


def test_one_bad_footprint_among_others_is_left_out_with_a_count(tmp_path):
    """Seen failing: each ended the whole file. Heights that are none are unknown."""
    good = [feature([square(40 * i, 0, 20)], building="yes", height=10) for i in range(12)]
    line = feature([[[0, 0], [20, 20], [40, 40], [0, 0]]], building="yes")
    bad = [
        line,
        feature([[["0", 0], [1, 1], [2, 0]]], building="yes"),
        {"type": "Feature", "properties": {"building": "yes"}, "geometry": {"type": "Curve"}},
        feature([square(0, 100, float("nan"))], building="yes"),
        feature([square(1e6, 1e6, 20)], building="yes"),
        feature([square(0, 100, 20)], building="yes", height=2, min_height=3),
    ]
    high = feature([square(0, 200, 20)], building="yes", height="high")
    city = read(written(tmp_path, *good, *bad, high))
    assert body(city).volume == pytest.approx(400 * 10 * 13)
    assert sum(int(n.split()[0]) for n in city.notes if "footprints left out" in n) == len(bad)
    assert said(city, "1 heights of 16", "'high'")
    with pytest.raises(CityError, match="no area"):
        read(written(tmp_path, line, line, *good[:1]))


def test_files_without_tags_are_read_as_before(tmp_path):
    written(tmp_path, feature([square(0, 0, 20)], HEIGHT="8 m"), feature([square(40, 0, 10)], id=7))
    city = read(tmp_path, default_height_m=6.0)
    assert body(city).volume == pytest.approx(400 * 8 + 100 * 6)
    with pytest.raises(CityError, match=r"no polygon of a building.*2 of landuse"):
        read(written(tmp_path, *[feature([square(0, 0, 20)], landuse="forest")] * 2))


def test_a_feature_in_each_line(tmp_path):
    lines = [json.dumps(feature([square(40 * i, 0, 20)], height=10)) for i in range(3)]
    (tmp_path / "town.geojsonl").write_text("\n".join(lines) + "\n")
    assert body(read(tmp_path, "town.geojsonl", coordinates="metres")).volume == 12_000


# ---- coordinates


def degrees(x: float, y: float, crs: str) -> list[float]:
    turned = pyproj.Transformer.from_crs("OGC:CRS84", crs, always_xy=True)
    return [list(turned.transform(*p)) for p in square(x, y, 2e-3, 1e-3)]


@pytest.mark.parametrize("crs", ["EPSG:3857", "EPSG:2056", "EPSG:2263", "EPSG:32632"])
@pytest.mark.parametrize("by_key", [True, False])
def test_sizes_are_true_in_every_reference_system(crs, by_key, tmp_path):
    """Against the geodesic. Seen failing: EPSG:3857 was taken for metres, 1.5 times too large at
    47 degrees; EPSG:2263 is in feet. UTM's own scale is 0.9996 at its middle."""
    lon, lat = (8.54, 47.37) if crs != "EPSG:2263" else (-73.98, 40.75)
    member = {
        "crs": {"type": "name", "properties": {"name": f"urn:ogc:def:crs:{crs[:4]}::{crs[5:]}"}}
    }
    written(tmp_path, feature([degrees(lon, lat, crs)], height=10), **({} if by_key else member))
    keys = {"crs": crs} if by_key else {"coordinates": "auto"}
    city = read(tmp_path, ground_margin_m=0.0, **keys)
    _, _, wide = pyproj.Geod(ellps="WGS84").inv(lon, lat, lon + 2e-3, lat)
    corners = np.unique(np.round(city.vertices[city.vertices[:, 2] > 5, :2], 6), axis=0)
    sides = np.linalg.norm(corners[:, None] - corners[None], axis=2)
    found = sides.ravel()[np.argmin(np.abs(sides - wide))]
    assert found == pytest.approx(wide, rel=5e-4)
    assert city.georeference is not None
    assert city.georeference.crs == crs
    back = city.georeference.to_file(city.vertices + city.origin)
    assert city.georeference.to_world(back) == pytest.approx(city.vertices + city.origin, abs=1e-6)


def test_an_origin_makes_a_national_grid_local(tmp_path):
    shift = np.array([2_683_111.0, 1_247_222.0])
    ring = (np.array(square(0, 0, 20)) + shift).tolist()
    written(tmp_path, feature([ring], height=10))
    city = read(tmp_path, crs="EPSG:2056", origin=[2_683_100, 1_247_200, 400], ground_margin_m=0.0)
    assert city.bounds() == pytest.approx(np.array([[11, 22, -400], [31, 42, -390]]))
    with pytest.raises(CityError, match="no coordinate reference system"):
        read(tmp_path, crs="EPSG:1")
    with pytest.raises(CityError, match="no coordinate reference system"):
        read(tmp_path, crs="EPSG:5773")


# ---- CityJSON


def box(x: float, y: float, low: float, high: float, side: int = 10) -> list[list[float]]:
    return [
        [x + i, y + j, z]
        for z in (low, high)
        for i, j in ((0, 0), (side, 0), (side, side), (0, side))
    ]


SHELL = [
    [[0, 3, 2, 1]],
    [[4, 5, 6, 7]],
    [[0, 1, 5, 4]],
    [[1, 2, 6, 5]],
    [[2, 3, 7, 6]],
    [[3, 0, 4, 7]],
]
KINDS = [{"type": t} for t in ("GroundSurface", "RoofSurface", "WallSurface")]


def solid(start: int, lod: str = "2.2", shell: list | None = None, semantics: bool = True) -> dict:
    shifted = [[[i + start for i in ring] for ring in face] for face in shell or SHELL]
    values = {"semantics": {"surfaces": KINDS, "values": [[0, 1, 2, 2, 2, 2]]}}
    return {"type": "Solid", "lod": lod, "boundaries": [shifted]} | (values if semantics else {})


def cityjson(vertices: list, objects: dict, **members) -> dict:
    numbers = [[round(v * 1000) for v in p] for p in vertices]
    return {
        "type": "CityJSON",
        "version": "2.0",
        "transform": {"scale": [1e-3] * 3, "translate": [2_683_000.0, 1_247_000.0, 0.0]},
        "metadata": {"referenceSystem": "https://www.opengis.net/def/crs/EPSG/0/2056"},
        "CityObjects": objects,
        "vertices": numbers,
        **members,
    }


LOCAL = {"origin": [2_683_000, 1_247_000, 0], "ground_margin_m": 20.0}


def hill(folder: Path, semantics: bool = True, relief: bool = False) -> Path:
    """Sixteen houses on a slope of one in four, and a tower on the roof of the first."""
    vertices: list = []
    objects: dict = {}
    for i in range(16):
        x, y = 60.0 * (i % 4), 60.0 * (i // 4)
        low = 400.0 + x / 4
        objects[f"h{i}"] = {
            "type": "Building",
            "geometry": [solid(len(vertices), semantics=semantics)],
        }
        vertices += box(x, y, low, low + 12)
    objects["h0"] |= {"children": ["tower"]}
    objects["tower"] = {
        "type": "BuildingPart",
        "parents": ["h0"],
        "geometry": [solid(len(vertices), semantics=semantics)],
    }
    vertices += box(3, 3, 412.0, 430.0, 4)
    if relief:
        start = len(vertices)
        vertices += [[x, y, 395.0 + x / 4] for x in (-100, 300) for y in (-100, 300)]
        boundaries = [[[start, start + 2, start + 3]], [[start, start + 3, start + 1]]]
        surface = {"type": "CompositeSurface", "lod": "1", "boundaries": boundaries}
        objects["relief"] = {"type": "TINRelief", "geometry": [surface]}
    (folder / "hill.city.json").write_text(json.dumps(cityjson(vertices, objects)))
    return folder


def gaps(city: CityMesh) -> np.ndarray:
    """How far the lowest point of each house hangs above the ground under its corners. [m]"""
    up = trimesh.Trimesh(city.vertices, city.faces, process=False)
    asphalt = [i for i, m in enumerate(city.materials) if m.name == "asphalt"]
    out = []
    for i in range(16):
        x, y = 60.0 * (i % 4), 60.0 * (i // 4)
        inside = (np.abs(city.corners[..., :2] - [x + 5, y + 5]) < 5.001).all(axis=(1, 2))
        lowest = city.corners[inside][..., 2].min()
        floor = ~inside & np.isin(city.face_material, asphalt) & (city.normals[:, 2] > 0.5)
        ground = trimesh.Trimesh(up.vertices, up.faces[floor], process=False)
        corners = np.array([[x + a, y + b, 1000.0] for a in (0, 10) for b in (0, 10)])
        hits = ground.ray.intersects_location(corners, np.tile([0, 0, -1.0], (4, 1)))[0]
        assert len(hits) >= 4
        out.append(lowest - hits[:, 2].min())
    return np.array(out)


@pytest.mark.parametrize("semantics", [True, False])
@pytest.mark.parametrize("relief", [True, False])
def test_no_building_floats(semantics, relief, tmp_path):
    """Seen failing: on one plane at the lowest foot they hang up to 45 m above it. Planted bugs:
    the tower's foot is a point of the ground; nothing goes down."""
    city = read(hill(tmp_path, semantics, relief), "hill.city.json", **LOCAL)
    assert (gaps(city) <= 1e-6).all()
    roofs = np.sort(np.unique(np.round(city.corners[city.normals[:, 2] > 0.99][..., 2], 3)))
    assert {412.0, 427.0, 442.0, 457.0, 430.0} <= set(roofs.tolist())
    tower = city.corners[(np.abs(city.corners[..., :2] - 5) < 2.001).all(axis=(1, 2))]
    assert tower[..., 2].min() == pytest.approx(412.0)  # on its roof


def test_level_towns_keep_one_plane(tmp_path):
    """One plane reflects as one; its height is that of low feet."""
    feet = [0.3 * i for i in range(12)]
    vertices = [p for i, z in enumerate(feet) for p in box(30.0 * i, 0, z, z + 9)]
    objects = {f"b{i}": {"type": "Building", "geometry": [solid(8 * i)]} for i in range(12)}
    (tmp_path / "c.json").write_text(json.dumps(cityjson(vertices, objects)))
    city = read(tmp_path, "c.json", **LOCAL)
    assert len(np.unique(np.round(city.corners[-2:, :, 2], 9))) == 1
    assert city.bounds()[0, 2] == 0.0
    houses = city.corners[:-2]
    for i in range(12):
        here = (np.abs(houses[..., 0] - 30 * i - 5) < 5.001).all(axis=1)
        assert houses[here][..., 2].min() == pytest.approx(0.0, abs=0.31)


def test_triangles_stay_as_they_are_and_concave_walls_are_whole(tmp_path):
    """An arrow of four corners is cut where it may be; the volume is that of the prism."""
    plan = [(0, 0), (10, 4), (0, 8), (3, 4)]
    vertices = [[x, y, z] for z in (0, 5) for x, y in plan]
    shell = [
        [[0, 3, 2, 1]],
        [[4, 5, 7]],
        [[5, 6, 7]],
        *[[[i, (i + 1) % 4, (i + 1) % 4 + 4, i + 4]] for i in range(4)],
    ]
    objects = {"a": {"type": "Building", "geometry": [solid(0, "2", shell, semantics=False)]}}
    (tmp_path / "c.json").write_text(json.dumps(cityjson(vertices, objects)))
    made = body(read(tmp_path, "c.json", **LOCAL))
    assert made.is_watertight
    assert made.volume == pytest.approx(5 * (40 - 12))


def test_level_of_detail_and_solids_of_all_kinds(tmp_path):
    """MultiSolid, null semantics, an extension's object; `lod` takes the lower box."""
    vertices = [*box(0, 0, 0, 20), *box(0, 0, 0, 8), *box(40, 0, 0, 6)]
    many = {"type": "MultiSolid", "lod": "2", "boundaries": [solid(16)["boundaries"]]}
    objects = {
        "a": {"type": "Building", "geometry": [solid(8, "1.2"), solid(0, "2.2")]},
        "b": {"type": "+Shed", "attributes": None, "geometry": [many | {"semantics": None}]},
    }
    (tmp_path / "c.json").write_text(json.dumps(cityjson(vertices, objects)))
    assert body(read(tmp_path, "c.json", **LOCAL)).volume == pytest.approx(100 * 26)
    assert body(read(tmp_path, "c.json", lod=1.9, **LOCAL)).volume == pytest.approx(100 * 14)


def test_what_is_no_building_is_named_with_its_material(tmp_path):
    """Trees are templates at a place, scaled; `material_map` goes before the table."""
    scale = [2.0, 0, 0, 0, 0, 2.0, 0, 0, 0, 0, 3.0, 1.0, 0, 0, 0, 1]
    tree = {
        "type": "GeometryInstance",
        "template": 0,
        "boundaries": [8],
        "transformationMatrix": scale,
    }
    pond = {"type": "MultiSurface", "lod": "1", "boundaries": [[[8, 9, 10, 11]]]}
    objects = {
        "a": {"type": "Building", "geometry": [solid(0)]},
        "tree": {"type": "SolitaryVegetationObject", "geometry": [tree]},
        "pond": {"type": "WaterBody", "geometry": [pond]},
        "bench": {"type": "CityFurniture", "geometry": [solid(12)]},
        "chair": {"type": "BuildingFurniture", "geometry": [solid(12)]},
    }
    flat = [[50, 0, 1], [60, 0, 1], [60, 10, 1], [50, 10, 1]]
    vertices = [*box(0, 0, 0, 20), *flat, *box(90, 0, 0, 1, 1)]
    templates = {"templates": [solid(0, semantics=False)], "vertices-templates": box(0, 0, 0, 1, 1)}
    document = cityjson(vertices, objects, **{"geometry-templates": templates})
    (tmp_path / "c.json").write_text(json.dumps(document))
    city = read(tmp_path, "c.json", **LOCAL)
    assert said(city, "1 SolitaryVegetationObject: vegetation", "1 WaterBody: water", "metal")
    assert said(city, "BuildingFurniture inside")
    leaves = [m.name for m in city.materials].index("vegetation")
    crown = city.corners[city.face_material == leaves].reshape(-1, 3)
    assert np.ptp(crown, axis=0) == pytest.approx([2, 2, 3])
    assert crown.min(axis=0) == pytest.approx([50, 0, 2])
    mapped = read(tmp_path, "c.json", material_map={"WaterBody": "glass"}, **LOCAL)
    assert said(mapped, "1 WaterBody: glass")


def test_gzip_is_unpacked_and_a_bomb_is_not(tmp_path, monkeypatch):
    """As the tiles of 3DBAG come."""
    document = json.dumps(
        cityjson(box(0, 0, 0, 10), {"a": {"type": "Building", "geometry": [solid(0)]}})
    )
    packed = gzip.compress(document.encode())
    (tmp_path / "c.city.json.gz").write_bytes(packed)
    assert body(read(tmp_path, "c.city.json.gz", **LOCAL)).volume == pytest.approx(1000)
    (tmp_path / "c.city.json.gz").write_bytes(packed[:-20])
    with pytest.raises(CityError, match="cut off"):
        read(tmp_path, "c.city.json.gz", **LOCAL)
    (tmp_path / "c.city.json.gz").write_bytes(packed[:30] + b"xxxx" + packed[34:])
    with pytest.raises(CityError, match="gzip"):
        read(tmp_path, "c.city.json.gz", **LOCAL)
    (tmp_path / "c.city.json.gz").write_bytes(packed + gzip.compress(b"\n"))
    with pytest.raises(CityError, match="several gzip streams"):
        read(tmp_path, "c.city.json.gz", **LOCAL)
    monkeypatch.setattr(files, "MAX_BYTES", 1_000_000)
    (tmp_path / "c.city.json.gz").write_bytes(gzip.compress(b"[" * 2_000_000))
    with pytest.raises(CityError, match="holds more"):
        read(tmp_path, "c.city.json.gz", **LOCAL)


def test_an_object_without_a_surface_is_left_out(tmp_path):
    """Seen failing in case 478 of a fuzz: the box about no corner."""
    line = {"type": "MultiSurface", "lod": "2", "boundaries": [[[0, 1]]]}
    objects = {
        "a": {"type": "Building", "geometry": [solid(0)]},
        "b": {"type": "Building", "geometry": [line]},
    }
    (tmp_path / "c.json").write_text(json.dumps(cityjson(box(0, 0, 0, 10), objects)))
    assert said(read(tmp_path, "c.json", **LOCAL), "1 of 2 objects left out", "no surface")
    (tmp_path / "c.json").write_text(json.dumps(cityjson(box(0, 0, 0, 10), {"b": objects["b"]})))
    with pytest.raises(CityError, match="no surface"):
        read(tmp_path, "c.json", **LOCAL)


def test_cityjson_by_lines_and_one_bad_object(tmp_path):
    head = cityjson([], {})
    lines = [head]
    for i in range(4):
        vertices = [[round(1000 * v) for v in p] for p in box(40.0 * i, 0, 0, 10)]
        objects = {f"b{i}": {"type": "Building", "geometry": [solid(0)]}}
        lines.append(
            {"type": "CityJSONFeature", "id": f"b{i}", "CityObjects": objects, "vertices": vertices}
        )
    lines[-1]["CityObjects"]["b3"]["geometry"][0]["boundaries"][0][0][0][0] = 99
    (tmp_path / "c.city.jsonl").write_text("\n".join(map(json.dumps, lines)))
    city = read(tmp_path, "c.city.jsonl", **LOCAL)
    assert body(city).volume == pytest.approx(3 * 1000)
    assert said(city, "1 of 4 objects left out", "vertex 99")
    assert city.georeference is not None
    assert city.georeference.crs == "EPSG:2056"


@pytest.mark.parametrize(
    ("said", "height"),
    [
        ({"height": -1}, 10.0),
        ({"height": -9999.0, "num_floors": 5}, 15.0),
        ({"GESAMTHOEHE": 13.5, "DACH_MAX": 421.5}, 13.5),
        ({"b3_h_dak_70p": 420.1, "b3_h_maaiveld": 408.6}, 11.5),
    ],
)
def test_heights_of_national_tables(tmp_path, said, height):
    """A negative number is a table's way to say that it does not know; the Swiss and the Dutch
    words for a building's height. Planted bugs: the whole file refused for a height of -1; the
    roof's height over the sea."""
    ring = [[7.1, 46.2], [7.1003, 46.2], [7.1003, 46.2002], [7.1, 46.2002], [7.1, 46.2]]
    shape = {"type": "Polygon", "coordinates": [ring]}
    feature = {"type": "Feature", "properties": said, "geometry": shape}
    (tmp_path / "f.geojson").write_text(
        json.dumps({"type": "FeatureCollection", "features": [feature]})
    )
    node = scenario.City.model_validate({"source": "footprints", "file": "f.geojson"})
    low, high = load_city(node, tmp_path, 77e9, (0.0, 0.0, 0.0)).bounds()
    assert high[2] - low[2] == pytest.approx(height)


# ---- what other tools call it


@pytest.mark.parametrize("name", ["Hoehe_m", "HEIGHT_M", "hauteur", "bldg_hgt", "altezza_vol"])
def test_heights_under_another_name_are_suggested(tmp_path, name):
    """Where most buildings have none by the known names. Planted bug: the ground's height."""
    houses = [
        feature([square(40 * i, 0, 20)], **{name: 12.0 + i, "ground_height": 520.0, "id": i})
        for i in range(3)
    ]
    written(tmp_path, *houses)
    assert said(read(tmp_path), f"city.height_property: {name}")
    assert read(tmp_path, height_property=name).bounds()[1, 2] == 14.0
    assert not said(read(tmp_path, height_property=name), "looks like")
    written(tmp_path, feature([square(0, 0, 20)], **{"height": 9, name: 12.0}))
    assert not said(read(tmp_path), "looks like")


@pytest.mark.parametrize("tags", [{"is_underground": True}, {"location": "underground"}])
def test_underground_buildings_are_left_out(tmp_path, tags):
    """Also of Overture, whose buildings have no building tag; its False is no underground."""
    houses = [feature([square(0, 0, 20)], height=30.0, num_floors=None, **tags)]
    houses.append(feature([square(50, 0, 20)], height=21.5, is_underground=False))
    written(tmp_path, *houses)
    city = read(tmp_path)
    assert city.bounds()[1, 2] == 21.5
    assert said(city, "left out", "1 underground")
