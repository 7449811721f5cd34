"""Files of a city: hostile and broken ones end in one message within seconds; what a city depends
on is every file that it is read from.

FUZZ=2000 pytest tests/world/test_city_files.py -k mutants looks further.
"""

from __future__ import annotations

import base64
import copy
import json
import os
import random
import struct
import sys
import time
import zipfile
from io import BytesIO
from pathlib import Path

import numpy as np
import pyproj
import pytest
import trimesh
from trimesh.exchange.ply import load_ply

from isac_rt import scenario
from isac_rt.cli.cli import main
from isac_rt.results.provenance import path_content, run_content
from isac_rt.scenario.file import load
from isac_rt.sweep import load_sweep
from isac_rt.world.area import city_about, city_digest
from isac_rt.world.city import CityError, city_files, load_city, meshfiles
from isac_rt.world.city.georeference import crs_name
from isac_rt.world.city.materials import MAX_MATERIALS

SECONDS = 8.0
"""For any file of these tests on a loaded machine; each takes well below one."""
QUARTER = json.loads(
    (Path(__file__).parents[2] / "scenes/data/quarter.geojson").read_text(encoding="utf-8")
)
SQUARE = [[0, 0], [20, 0], [20, 30], [0, 30], [0, 0]]


def city(folder: Path, source: str, file: str, **keys):
    node = scenario.City.model_validate({"source": source, "file": file, **keys})
    return load_city(node, folder, 77e9, (0.0, 0.0, 0.0))


def complaint(folder: Path, source: str, file: str, **keys) -> str | None:
    """What is said of a file, in one line and in time; None if it is a city of finite faces."""
    start = time.monotonic()
    try:
        found = city(folder, source, file, **keys)
    except CityError as problem:
        said = str(problem)
        assert 0 < len(said) < 1000 and said.isprintable() and "object at 0x" not in said
        return said
    finally:
        assert time.monotonic() - start < SECONDS
    assert np.isfinite(found.corners).all() and (found.areas > 0).all()
    return None


def feature(coordinates, kind: str = "Polygon", **properties) -> dict:
    return {
        "type": "Feature",
        "properties": properties,
        "geometry": {"type": kind, "coordinates": coordinates},
    }


def cityjson(**changes) -> dict:
    corners = [[x, y, z] for z in (0, 82) for x, y in ((0, 0), (124, 0), (124, 91), (0, 91))]
    walls = [[[0, 3, 2, 1]], [[4, 5, 6, 7]], [[0, 1, 5, 4]], [[1, 2, 6, 5]]]
    solid = {
        "type": "Solid",
        "lod": "2.2",
        "boundaries": [walls],
        "semantics": {"surfaces": [{"type": "RoofSurface"}], "values": [[None, 0, 0, None]]},
    }
    plan = {"type": "MultiSurface", "lod": 0, "boundaries": [[[0, 1, 2, 3]]]}
    return {
        "type": "CityJSON",
        "version": "2.0",
        "transform": {"scale": [0.1] * 3, "translate": [690_100.5, 5_334_000.25, 511.5]},
        "CityObjects": {
            "a": {"type": "Building", "attributes": {"height": 8.0}, "geometry": [solid]},
            "b": {"type": "Building", "attributes": {"measuredHeight": 8}, "geometry": [plan]},
        },
        "vertices": corners,
        **changes,
    }


def openstreetmap() -> bytes:
    """What people map: heights, parts, roofs, a reference system, something that is no building."""
    tags: list[dict] = [
        {"building": "yes", "height": "12,5 m", "roof:shape": "gabled", "roof:height": "3"},
        {"building": "house", "building:levels": "4;5", "roof:shape": "hipped"},
        {"building:part": "yes", "height": "40'", "min_height": "2"},
        {"tags": {"building": "roof", "height": 6, "roof:shape": "pyramidal"}},
        {"landuse": "forest"},
    ]
    squares = [[[x + 30 * i, y] for x, y in SQUARE] for i in range(len(tags))]
    features = [feature([ring], **t) for ring, t in zip(squares, tags, strict=True)]
    named = {"type": "name", "properties": {"name": "urn:ogc:def:crs:EPSG::25832"}}
    document = {"type": "FeatureCollection", "crs": named, "features": features}
    return json.dumps(document).replace("[0,", "[500000,").encode()


def by_lines() -> bytes:
    """CityJSONSeq of two buildings."""
    whole = cityjson(CityObjects={})
    rest = [
        {
            "type": "CityJSONFeature",
            "id": key,
            "CityObjects": {key: item},
            "vertices": whole["vertices"],
        }
        for key, item in cityjson()["CityObjects"].items()
    ]
    return "\n".join(json.dumps(line) for line in [whole | {"vertices": []}, *rest]).encode()


def town() -> dict:
    """Relief, a tree by its template, water, a part above another, a reference system."""
    base = cityjson()
    solid = base["CityObjects"]["a"]["geometry"][0]
    plan = {"type": "MultiSurface", "lod": "1", "boundaries": [[[0, 1, 2]], [[0, 2, 3]]]}
    matrix = [2.0, 0, 0, 0, 0, 2, 0, 0, 0, 0, 2, 0, 0, 0, 0, 1]
    tree = {
        "type": "GeometryInstance",
        "template": 0,
        "boundaries": [4],
        "transformationMatrix": matrix,
    }
    objects = base["CityObjects"] | {
        "ground": {"type": "TINRelief", "geometry": [plan]},
        "tree": {"type": "SolitaryVegetationObject", "geometry": [tree]},
        "lake": {"type": "WaterBody", "geometry": [plan]},
        "part": {
            "type": "BuildingPart",
            "parents": ["a"],
            "geometry": [solid | {"semantics": None}],
        },
    }
    corners = [
        [float(x), float(y), float(z)] for z in (0, 3) for x, y in ((0, 0), (2, 0), (2, 2), (0, 2))
    ]
    return base | {
        "CityObjects": objects,
        "metadata": {"referenceSystem": "https://www.opengis.net/def/crs/EPSG/0/25832"},
        "geometry-templates": {"templates": [solid], "vertices-templates": corners},
    }


BOX = trimesh.creation.box(extents=(9.0, 7.0, 5.0))
SHAPE = '<shape type="{}" id="a"><string name="filename" value="{}"/>{}</shape>'


def scene(*shapes: str) -> str:
    return f'<scene version="2.1.0">{"".join(shapes)}</scene>'


def whole_cities() -> dict[str, tuple[str, str, dict[str, bytes]]]:
    """Of each kind of file a city: the source, the file's name, and all files by their names."""
    stage = trimesh.Scene()
    stage.add_geometry(BOX, node_name="tower", transform=trimesh.transformations.identity_matrix())
    gltf = trimesh.exchange.gltf.export_gltf(stage)
    ply = BOX.export(file_type="ply")
    xml = scene(
        '<default name="up" value="6.5"/><bsdf type="radio-material" id="mat-plaster">'
        '<float name="relative_permittivity" value="2.9"/><float name="thickness" value="0.03"/>'
        "</bsdf>",
        SHAPE.format("ply", "box.ply", '<ref id="mat-plaster" name="bsdf"/>'),
        '<shape type="cube"><transform name="to_world"><scale x="3" y="2"/><rotate x="1" '
        'angle="90"/><translate value="10, 20, $up"/></transform></shape>',
    )
    obj = (
        "mtllib box.mtl\no house\n"
        + "".join("v {} {} {}\n".format(*v) for v in BOX.vertices)
        + "usemtl itu_wood\nf 1 2 4 3\nf -1/1/1 -2/2/2 -3/3/3\nusemtl itu_brick\nf 5//1 6//1 8//1\n"
    )
    files = {
        "geojson": ("footprints", {"f.geojson": json.dumps(QUARTER).encode()}),
        "openstreetmap": ("footprints", {"f.geojson": openstreetmap()}),
        "cityjson": ("footprints", {"f.city.json": json.dumps(cityjson()).encode()}),
        "cityjson by lines": ("footprints", {"f.city.jsonl": by_lines()}),
        "a town of cityjson": ("footprints", {"f.city.json": json.dumps(town()).encode()}),
        "obj": ("mesh", {"box.obj": obj.encode(), "box.mtl": b"newmtl itu_wood\nKd 1 1 1\n"}),
        "binary ply": ("mesh", {"box.ply": ply}),
        "text ply": ("mesh", {"box.ply": BOX.export(file_type="ply", encoding="ascii")}),
        "binary stl": ("mesh", {"box.stl": BOX.export(file_type="stl")}),
        "text stl": ("mesh", {"box.stl": BOX.export(file_type="stl_ascii").encode()}),
        "glb": ("mesh", {"box.glb": stage.export(file_type="glb")}),
        "gltf": ("mesh", {"model.gltf": gltf["model.gltf"], **gltf}),
        "mitsuba": ("mitsuba", {"scene.xml": xml.encode(), "box.ply": ply}),
    }
    return {kind: (source, next(iter(of)), of) for kind, (source, of) in files.items()}


WHOLE = whole_cities()


def write(folder: Path, files: dict[str, bytes]) -> Path:
    for name, data in files.items():
        (folder / name).write_bytes(data)
    return folder


@pytest.mark.parametrize("kind", WHOLE)
def test_whole_cities_are_read(kind, tmp_path):
    source, name, files = WHOLE[kind]
    assert complaint(write(tmp_path, files), source, name) is None


# ---- broken files


def bent(data: bytes, chance: random.Random) -> bytes:
    """Bytes changed, cut off, put in, doubled, and numbers made huge."""
    out = bytearray(data)
    for _ in range(chance.randint(1, 4)):
        at = chance.randrange(len(out) + 1)
        action = chance.choice(["flip", "flip", "cut", "insert", "double", "number"])
        if action == "cut" and chance.random() < 0.5:
            del out[at:]
        elif action == "flip" and at < len(out):
            out[at] = chance.randrange(256)
        elif action == "insert":
            out[at:at] = chance.choice([b"\0", b"nan", b"[" * 9, b"-1", b"\xff\xfe", b"<", b'"'])
        elif action == "double":
            out[at:at] = out[at : at + chance.randrange(200)]
        elif action == "number":
            digits = [i for i, byte in enumerate(out) if 48 <= byte < 58]
            if digits:
                at = chance.choice(digits)
                out[at : at + 1] = chance.choice(
                    [b"9" * 5000, b"1e400", b"-7", b"4294967295", b"9223372036854775808", b"0.5"]
                )
    return bytes(out)


def swapped(tree, chance: random.Random):
    """A JSON tree with some of its values replaced by others, taken away, or nested deep."""
    tree = copy.deepcopy(tree)
    for _ in range(chance.randint(1, 3)):
        here, spots = tree, []
        while isinstance(here, dict | list) and here:
            key = chance.choice(list(here) if isinstance(here, dict) else range(len(here)))
            spots.append((here, key))
            here = here[key]
        if not spots:
            break
        here, key = chance.choice(spots)
        if chance.random() < 0.15:
            del here[key]
            continue
        odd = [None, True, -1, 0, 2**63, 10**400, 1e18, 1e308, float("nan"), float("inf"), "x"]
        odd += ["", "2" * 3000, [], {}, [[[]]], [None], [1, 2, 3], [key], {"type": "x"}]
        here[key] = chance.choice([*odd, copy.deepcopy(here)])
    return tree


def mutant(kind: str, chance: random.Random) -> dict[str, bytes]:
    """The files of a kind with one of them spoilt."""
    _, name, files = WHOLE[kind]
    spoilt = chance.choice(sorted(files)) if chance.random() < 0.3 else name
    data = files[spoilt]
    if data[:1] == b"{" and b"\n{" not in data and chance.random() < 0.6:
        return files | {spoilt: json.dumps(swapped(json.loads(data), chance)).encode()}
    if data[:4] == b"glTF" and chance.random() < 0.6:
        size = int.from_bytes(data[12:16], "little")
        text = json.dumps(swapped(json.loads(data[20 : 20 + size]), chance)).encode()
        head = data[:8] + struct.pack("<II", len(data) - size + len(text), len(text))
        return files | {spoilt: head + data[16:20] + text + data[20 + size :]}
    return files | {spoilt: bent(data, chance)}


@pytest.mark.parametrize("kind", WHOLE)
def test_mutants_give_a_city_or_one_message(kind, tmp_path):
    """Seen failing in 17 of 900 cases: properties that are no mapping, indices of 2^63, vertices of
    one number, coordinates of 1e18."""
    source, name, _files = WHOLE[kind]
    for case in range(int(os.environ.get("FUZZ", "12"))):
        write(tmp_path, mutant(kind, random.Random(f"{kind} {case}")))
        try:
            complaint(tmp_path, source, name)
            city_digest(scenario.City(source=source, file=name), tmp_path)
        except CityError:
            pass
        except BaseException as error:
            error.add_note(f"{kind}, case {case}")
            raise


# ---- hostile files


def gltf(**changes) -> dict:
    """One triangle, its numbers inside the file."""
    data = np.array([[0, 0, 0], [9, 0, 0], [0, 9, 3]], dtype="<f4").tobytes()
    uri = "data:application/octet-stream;base64," + base64.b64encode(data).decode()
    return {
        "asset": {"version": "2.0"},
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0, "name": "roof"}],
        "meshes": [{"primitives": [{"attributes": {"POSITION": 0}}]}],
        "accessors": [{"bufferView": 0, "componentType": 5126, "count": 3, "type": "VEC3"}],
        "bufferViews": [{"buffer": 0, "byteLength": len(data)}],
        "buffers": [{"uri": uri, "byteLength": len(data)}],
        **changes,
    }


def ply(vertices: str, faces: str, body: bytes, form: str = "binary_little_endian") -> bytes:
    return (
        f"ply\nformat {form} 1.0\nelement vertex {vertices}\nproperty float x\nproperty float y\n"
        f"property float z\nelement face {faces}\nproperty list uchar int vertex_indices\n"
        "end_header\n"
    ).encode() + body


def collection(*features) -> bytes:
    return json.dumps({"type": "FeatureCollection", "features": list(features)}).encode()


def crossing(corners: int) -> list:
    """A ring that crosses itself some corners^2 times."""
    plan = np.random.default_rng(1).uniform(0, 900, (corners, 2)).tolist()
    return [[*plan, plan[0]]]


def wall(transform: str) -> str:
    return scene(f'<shape type="cube"><transform name="to_world">{transform}</transform></shape>')


def bomb() -> str:
    grown = "".join(f'<!ENTITY e{i} "{f"&e{i - 1};" * 10}">' for i in range(1, 10))
    return f'<!DOCTYPE scene [<!ENTITY e0 "x">{grown}]><scene version="2.1.0">&e9;</scene>'


def plaster(number: int, value: str = "2.9") -> str:
    return (
        f'<shape type="cube"><bsdf type="radio-material" id="m{number}">'
        f'<float name="relative_permittivity" value="{value}"/>'
        f'<float name="thickness" value="{number + 1}"/></bsdf></shape>'
    )


JSON = {
    "deep": b"[" * 5000,
    "deep properties": b'{"type": "Feature", "properties": {"a": ' + b"[" * 5000,
    "deep geometry": collection(feature([[SQUARE]], "MultiPolygon")).replace(b"[[[[", b"[" * 5000),
    "digits": collection(feature([SQUARE])).replace(b"20", b"9" * 5000),
    "digits of a height": collection(feature([SQUARE], height=7)).replace(b" 7", b"9" * 5000),
    "long height": collection(feature([SQUARE], height="9" * 5000)),
    "literal": collection(feature([SQUARE])).replace(b"20", b"NaN"),
    "literal infinity": collection(feature([SQUARE])).replace(b"20", b"-Infinity"),
    "too large": collection(feature([SQUARE])).replace(b"20", b"1e400"),
    "no place": collection(feature([SQUARE])).replace(b"20", b"1e18"),
    "endless height": collection(feature([SQUARE], height=1e300)),
    "empty": b"",
    "cut": collection(feature([SQUARE]))[:-9],
    "zeros": bytes(1000),
    "UTF-16": collection(feature([SQUARE])).decode().encode("utf-16"),
    "list": b"[]",
    "number": b"7",
    "no type": b"{}",
    "features": b'{"type": "FeatureCollection", "features": {"a": 1}}',
    "odd feature": b'{"type": "FeatureCollection", "features": [7]}',
    "odd properties": collection(feature([SQUARE]) | {"properties": [1]}),
    "odd ring": collection(feature([SQUARE, 3])),
    "short ring": collection(feature([[[0, 0], [1, 1]]])),
    "flat position": collection(feature([[1, 2, 3, 4]])),
    "words": collection(feature([[["0", "0"], ["9", "0"], ["9", "9"], ["0", "0"]]])),
    "everywhere": collection(feature(crossing(6000))),
    "everywhere often": collection(*[feature(crossing(600))] * 200),
    "a million": b'{"type": "FeatureCollection", "features": [' + b"[]," * 10**6 + b"[]]}",
    "long name": collection(feature([SQUARE]) | {"type": "x\n" * 9000}),
}
CITYJSON = {
    "objects": {"CityObjects": [1]},
    "object": {"CityObjects": {"a": 3}},
    "attributes": {"CityObjects": {"a": {"type": "Building", "attributes": [1]}}},
    "geometry": {"CityObjects": {"a": {"type": "Building", "geometry": {"type": "Solid"}}}},
    "level": {"CityObjects": {"a": {"geometry": [{"type": "MultiPoint", "lod": "x"}]}}},
    "vertices": {"vertices": [[1]]},
    "no vertices": {"vertices": []},
    "scale": {"transform": {"scale": [1e300] * 3, "translate": [0, 0, 0]}},
    "transform": {"transform": {"scale": 1, "translate": [0, 0, 0]}},
}
MESH = {
    "short.obj": b"v 1\nf 1 1 1\n",
    "word.obj": b"v 1 2 x\n",
    "nan.obj": b"v nan 0 0\nv 9 0 0\nv 0 9 0\nf 1 2 3\n",
    "far.obj": b"v 1e18 0 0\nv 9 0 0\nv 0 9 0\nf 1 2 3\n",
    "beyond.obj": b"v 1 0 0\nv 9 0 0\nv 0 9 0\nf 1 2 9223372036854775808\n",
    "digits.obj": b"v 1 0 0\nv 9 0 0\nv 0 9 0\nf 1 2 " + b"9" * 5000,
    "before.obj": b"v 1 0 0\nv 9 0 0\nv 0 9 0\nf 1 2 -4\n",
    "empty.obj": b"",
    "noise.obj": bytes(range(256)) * 99,
    "empty.ply": b"",
    "empty.stl": b"",
    "empty.glb": b"",
    "head.glb": b"glTF\2\0\0\0",
    "billions.stl": bytes(80) + struct.pack("<I", 0xFFFFFFFF) + bytes(50),
    "billions.ply": ply("3", "4000000000", bytes(90)),
    "billions of points.ply": ply("4000000000", "1", bytes(90)),
    "text billions.ply": ply("3", "4000000000", b"0 0 0\n9 0 0\n0 9 0\n3 0 1 2\n", "ascii"),
    "digits.ply": ply("3", "9" * 5000, b""),
    "negative.ply": ply("3", "-1", bytes(36)),
    "far.ply": ply("3", "1", b"1e18 0 0\n9 0 0\n0 9 0\n3 0 1 2\n", "ascii"),
    "beyond.ply": ply("3", "1", b"0 0 0\n9 0 0\n0 9 0\n3 0 1 9223372036854775808\n", "ascii"),
    "word.ply": ply("3", "1", b"0 x 0\n9 0 0\n0 9 0\n3 0 1 2\n", "ascii"),
    "no end.ply": b"ply\nformat ascii 1.0\nelement vertex 3\n",
    "deep.gltf": b"[" * 5000,
    "billions.glb": json.dumps(
        gltf(accessors=[{"componentType": 5126, "count": 10**10, "type": "VEC3"}])
    ).encode(),
    "overlapping.gltf": json.dumps(
        gltf(accessors=[{**gltf()["accessors"][0], "count": 4 * 10**9}])
    ).encode(),
    "still.gltf": json.dumps(gltf(bufferViews=[{**gltf()["bufferViews"][0], "byteStride": 0}]))
    .replace('"count": 3', '"count": 29000000')
    .encode(),
    "far.gltf": json.dumps(gltf(nodes=[{"mesh": 0, "scale": [1e200, 1, 1]}])).encode(),
    "round.gltf": json.dumps(gltf(nodes=[{"mesh": 0, "children": [0]}])).encode(),
    "odd.gltf": json.dumps(gltf(nodes={"mesh": 0})).encode(),
    "remote.gltf": json.dumps(gltf(buffers=[{"uri": "http://127.0.0.1/m.bin"}])).encode(),
    "above.gltf": json.dumps(gltf(buffers=[{"uri": "../secret.obj"}])).encode(),
    "coded.gltf": json.dumps(gltf(buffers=[{"uri": "%2e%2e/secret.obj"}])).encode(),
    "device.gltf": json.dumps(gltf(buffers=[{"uri": "/dev/zero"}])).encode(),
    "pipe.gltf": json.dumps(gltf(buffers=[{"uri": "pipe.ply"}])).encode(),
    "link.gltf": json.dumps(gltf(buffers=[{"uri": "link"}])).encode(),
    "nul.gltf": json.dumps(gltf(buffers=[{"uri": "a\0b"}])).encode(),
    "long.gltf": json.dumps(gltf(buffers=[{"uri": "x" * 5000}])).encode(),
    "points.gltf": json.dumps(
        gltf(
            scenes=[{"nodes": list(range(2000))}],
            nodes=[{"mesh": 0}] * 2000,
            meshes=[{"primitives": [{"attributes": {"POSITION": 0}, "mode": 0}]}],
            accessors=[{**gltf()["accessors"][0], "count": 500_000}],
            bufferViews=[{"buffer": 0, "byteLength": 6_000_000}],
            buffers=[{"uri": "data:;base64," + "A" * 8_000_000}],
        )
    ).encode(),
    "properties.ply": b"ply\nformat binary_little_endian 1.0\nelement vertex 1\n"
    + b"".join(b"property list uchar float x%d\n" % i for i in range(5000))
    + b"end_header\n"
    + bytes(5000),
    "unequal.stl": b"solid a\nvertex 0 0 0\nvertex 9 0 0\nendsolid\n",
    "zip.zip": b"PK",
}
XML = {
    "entities": bomb(),
    "empty": "",
    "cut": "<scene",
    "archive": scene(SHAPE.format("ply", "bomb.zip", "")),
    "pipe": scene(SHAPE.format("ply", "pipe.ply", "")),
    "device": scene(SHAPE.format("ply", "/dev/zero", "")),
    "above": scene(SHAPE.format("obj", "../secret.obj", "")),
    "link": scene(SHAPE.format("obj", "link", "")),
    "long file": scene(SHAPE.format("obj", "x" * 999, "")),
    "linked folder": scene(SHAPE.format("obj", "out/secret.obj", "")),
    "there and back": scene(SHAPE.format("obj", "out/../../secret.obj", "")),
    "folder": scene(SHAPE.format("obj", ".", "")),
    "remote": scene(SHAPE.format("obj", "http://127.0.0.1/m.obj", "")),
    "two scales": wall('<scale value="1 2"/>'),
    "no axis": wall('<rotate angle="9"/>'),
    "odd matrix": wall('<matrix value="1 2 3"/>'),
    "no number": wall('<translate x="nan"/>'),
    "far": wall('<translate x="1e18"/>'),
    "grown": scene(
        f'<default name="a" value="{"1 " * 200_000}"/>',
        *['<shape type="cube"><transform name="to_world"><scale value="$a"/></transform></shape>']
        * 2000,
    ),
    "long": scene(
        f'<default name="a" value="{"1 " * 999}"/>', wall(f'<scale value="{"$a" * 99999}"/>')
    ),
    "often": scene(*[SHAPE.format("obj", "large.obj", "")] * 20_000),
    "below vacuum": scene(plaster(0, "0.1")),
    "permittivity": scene(plaster(0, "nan")),
    "materials": scene(*(plaster(i) for i in range(MAX_MATERIALS + 1))),
    "deep": "<scene>" + "<a>" * 100_000 + "</a>" * 100_000 + "</scene>",
}


@pytest.fixture
def traps(tmp_path: Path) -> Path:
    """A folder with a pipe, an archive that grows, a link that leads out, and a large mesh."""
    inside = tmp_path / "inside"
    inside.mkdir()
    (tmp_path / "secret.obj").write_bytes(WHOLE["obj"][2]["box.obj"])
    os.mkfifo(inside / "pipe.ply")
    (inside / "link").symlink_to(tmp_path / "secret.obj")
    (inside / "out").symlink_to(tmp_path)
    with zipfile.ZipFile(inside / "bomb.zip", "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("m.obj", WHOLE["obj"][2]["box.obj"] + b"# " + bytes(10**7))
    grid = "".join(f"v {i} {i * i % 97} {i % 7}\n" for i in range(3000))
    faces = "".join(f"f {i} {i + 1} {i + 2}\n" for i in range(1, 2999))
    (inside / "large.obj").write_text(grid + faces)
    return inside


@pytest.mark.parametrize("name", JSON)
def test_hostile_json_ends_in_one_message(name, tmp_path):
    (tmp_path / "f.geojson").write_bytes(JSON[name])
    assert complaint(tmp_path, "footprints", "f.geojson", coordinates="metres")


@pytest.mark.parametrize("name", CITYJSON)
def test_broken_cityjson_ends_in_one_message(name, tmp_path):
    (tmp_path / "f.json").write_text(json.dumps(cityjson(**CITYJSON[name])))
    assert complaint(tmp_path, "footprints", "f.json")


@pytest.mark.parametrize("index", [-1, 8, 2**31, 2**63, 10**400, 0.5, "0", None])
def test_boundaries_with_odd_indices(index, tmp_path):
    document = cityjson()
    document["CityObjects"]["a"]["geometry"][0]["boundaries"][0][1][0][2] = index
    (tmp_path / "f.json").write_text(json.dumps(document))
    notes = city(tmp_path, "footprints", "f.json").notes
    assert any("1 of 2 objects left out" in note for note in notes)
    del document["CityObjects"]["b"]
    (tmp_path / "f.json").write_text(json.dumps(document))
    assert complaint(tmp_path, "footprints", "f.json")


@pytest.mark.parametrize("name", MESH)
def test_hostile_meshes_end_in_one_message(name, traps):
    (traps / name).write_bytes(MESH[name])
    assert complaint(traps, "mesh", name)


@pytest.mark.parametrize("name", XML)
def test_hostile_scenes_end_in_one_message(name, traps):
    (traps / "scene.xml").write_text(XML[name])
    assert complaint(traps, "mitsuba", "scene.xml")


@pytest.mark.parametrize(
    "text",
    [
        "+init={}:1",
        "+type=crs +init={}:1",
        "+proj=utm +zone=32 +datum=WGS84 +nadgrids={} +type=crs",
        "+proj=tmerc +ellps=GRS80 +geoidgrids={} +type=crs",
        "+proj=utm +zone=32 +datum=WGS84 " + 100_000 * " ",
    ],
)
def test_a_reference_system_opens_no_file(text, tmp_path):
    """PROJ reads the definition that stands in the file. Planted bug: any text that pyproj
    takes."""
    (tmp_path / "own").write_text("<1> +proj=utm +zone=32 +datum=WGS84 +units=m <>\n")
    assert crs_name(text.format(tmp_path / "own")) is None
    assert crs_name("+proj=utm +zone=32 +datum=WGS84 +type=crs") is not None
    assert crs_name(pyproj.CRS("EPSG:25832").to_wkt()) == "EPSG:25832"
    assert crs_name(pyproj.CRS("EPSG:25832").to_json()) == "EPSG:25832"


def test_a_scene_that_windows_wrote_names_its_files(tmp_path):
    (tmp_path / "mesh").mkdir()
    (tmp_path / "mesh/box.ply").write_bytes(BOX.export(file_type="ply"))
    (tmp_path / "scene.xml").write_text(scene(SHAPE.format("ply", "mesh\\box.ply", "")))
    found = city(tmp_path, "mitsuba", "scene.xml")
    assert len(found.faces) == len(BOX.faces)
    (tmp_path / "scene.xml").write_text(scene(SHAPE.format("ply", "..\\box.ply", "")))
    assert "outside its folder" in complaint(tmp_path, "mitsuba", "scene.xml")


@pytest.mark.parametrize("source", ["mesh", "mitsuba", "footprints"])
@pytest.mark.parametrize("name", ["pipe.ply", ".", "/dev/zero", "nothing.ply", "a\0b", "x" * 5000])
def test_what_is_no_file_is_refused(source, name, traps):
    assert complaint(traps, source, name)


def test_a_node_behind_twenty_thousand_others(tmp_path):
    nodes = [{"children": [i + 1]} for i in range(20_000)]
    (tmp_path / "m.gltf").write_text(json.dumps(gltf(nodes=[*nodes, {"mesh": 0}])))
    assert complaint(tmp_path, "mesh", "m.gltf") is None


def test_twenty_thousand_materials_in_a_mesh(tmp_path):
    """Written against: a pass over all vertices for each of them."""
    corners = "".join(f"v {i} {i % 89} {i % 7}\n" for i in range(100_000))
    faces = "".join(f"usemtl m{i}\nf {i} {i + 1} {i + 2}\n" for i in range(1, 20_000))
    (tmp_path / "m.obj").write_text(corners + faces)
    complaint(tmp_path, "mesh", "m.obj")


def test_twenty_thousand_solids_in_an_stl(tmp_path):
    """Seen failing: trimesh looks for a free name among all those before."""
    facet = "outer loop\nvertex 0 0 0\nvertex {} 0 0\nvertex 0 9 0\nendloop\n"
    solids = "".join(f"solid a\n{facet.format(i + 1)}endsolid a\n" for i in range(20_000))
    (tmp_path / "m.stl").write_text(solids)
    assert complaint(tmp_path, "mesh", "m.stl", material_map={"a": "metal"}) is None


def test_a_byte_order_mark_is_no_harm(tmp_path):
    (tmp_path / "f.geojson").write_bytes(b"\xef\xbb\xbf" + collection(feature([SQUARE])))
    assert complaint(tmp_path, "footprints", "f.geojson", coordinates="metres") is None


# ---- what a city depends on


SCENARIO = """
name: s
city: {{source: {source}, file: {file}}}
propagation: {{model: ray_traced}}
swarm:
  A: {{role: active, position_m: [0, 0, 60]}}
  U: {{role: target, position_m: [1, 30, 60]}}
"""
SWEEP = """
scenario: s.yaml
name: w
axes: {snr: {key: noise.snr_db, values: [1, 2]}}
"""


def keys(folder: Path) -> dict[str, str]:
    """All keys that hold the city of the scenario in a folder."""
    read = load(folder / "s.yaml")
    point = next(load_sweep(folder / "w.yaml").points())
    return {
        "city": city_digest(read.city, folder),
        "paths": path_content(read.model_dump(mode="json"), city_digest(read.city, folder)),
        "run": run_content(read, 0),
        "point": point.key,
        "paths of a point": str(point.paths_key),
    }


def opened(folder: Path, source: str, file: str) -> set[str]:
    """Names of the files in a folder that reading a city opens."""
    names, watched = set[str](), True

    def watch(event: str, arguments: tuple) -> None:
        if watched and event == "open" and str(arguments[0]).startswith(str(folder)):
            names.add(Path(arguments[0]).name)

    sys.addaudithook(watch)
    city(folder, source, file)
    watched = False
    return names


@pytest.mark.parametrize("kind", WHOLE)
def test_keys_hold_every_file_that_is_read_and_no_other(kind, tmp_path):
    """Each file changed once. Seen failing for the meshes of a Mitsuba scene and the buffers of a
    glTF file. An OBJ's colours are not read: its materials go by their names in `usemtl`."""
    source, name, files = WHOLE[kind]
    folder = write(tmp_path, files | {"beside.txt": b"x", "unused.ply": b"x"})
    (folder / "s.yaml").write_text(SCENARIO.format(source=source, file=name))
    (folder / "w.yaml").write_text(SWEEP)
    before = keys(folder)
    used = {file.name for file in city_files(scenario.City(source=source, file=name), folder)}
    assert used == opened(folder, source, name)
    assert used == set(files) - {"box.mtl"}
    for changed in [*files, "beside.txt", "unused.ply"]:
        whole = (folder / changed).read_bytes()
        (folder / changed).write_bytes(whole + b"\n")
        after = keys(folder)
        assert {k for k in before if before[k] != after[k]} == (
            set(before) if changed in used else set()
        )
        (folder / changed).write_bytes(whole)
    assert keys(folder) == before


def test_a_city_that_changes_behind_its_file_is_read_anew(tmp_path):
    """Seen failing: the city in memory was handed out again."""
    source, name, files = WHOLE["mitsuba"]
    write(tmp_path, files)
    node, place = scenario.City(source=source, file=name), np.zeros(3)
    assert city_about(place, node, tmp_path, 77e9) is city_about(place, node, tmp_path, 77e9)
    first = city_about(place, node, tmp_path, 77e9).bounds()
    (tmp_path / "box.ply").write_bytes(
        trimesh.creation.box(extents=(99.0, 7.0, 5.0)).export(file_type="ply")
    )
    assert not np.array_equal(city_about(place, node, tmp_path, 77e9).bounds(), first)


def test_built_in_cities_are_held_by_their_files():
    munich, box = (scenario.City(source="builtin", name=name) for name in ("munich", "box"))
    assert len(city_files(munich, Path())) > 100
    assert city_digest(munich, Path()) != city_digest(box, Path()) != ""
    assert city_digest(scenario.City(source="canyon"), Path()) == city_digest(None, Path()) == ""


@pytest.mark.parametrize(
    ("source", "file"),
    [
        ("mitsuba", "scene.xml"),
        ("footprints", "deep.geojson"),
        ("mesh", "remote.gltf"),
        ("mesh", "pipe.ply"),
        ("mesh", "x" * 5000),
        ("mesh", '"a\\0b"'),
    ],
)
def test_a_run_in_a_hostile_city_ends_with_2_and_one_line(source, file, traps, capsys):
    """One line after those that say what is being done."""
    (traps / "scene.xml").write_text(XML["pipe"])
    (traps / "deep.geojson").write_bytes(JSON["deep"])
    (traps / "remote.gltf").write_bytes(MESH["remote.gltf"])
    (traps / "s.yaml").write_text(SCENARIO.format(source=source, file=file))
    assert main(["run", str(traps / "s.yaml"), "--out", str(traps / "o")]) == 2
    *doing, said = capsys.readouterr().err.strip().splitlines()
    assert set(doing) <= {"loading the program", "setting up"}
    assert said and "Traceback" not in said
    assert not list(traps.glob("o/*"))


def test_plain_binary_meshes_are_read_as_trimesh_reads_them(tmp_path):
    """Corners and faces to the last bit, with and without more numbers of a corner, and what is not
    plain goes the old way: a face of four corners, bytes at the end, other names, a comment.
    Planted bugs: faces begin a byte late; the count of corners is not looked at; the numbers after
    z are taken for places."""
    rng = np.random.default_rng(5)
    points = rng.normal(size=(9, 3)).astype("<f4")
    faces = np.zeros(5, [("count", "u1"), ("corners", "<i4", 3)])
    faces["count"], faces["corners"] = 3, rng.integers(0, 9, (5, 3))
    body = points.tobytes() + faces.tobytes()
    plain = ply("9", "5", body)
    z = b"property float z\n"
    textured = ply("9", "5", np.hstack([points, points[:, ::-1]]).tobytes() + faces.tobytes())
    textured = textured.replace(
        z, z + b"property float s\nproperty float t\nproperty float Col_0\n"
    )
    for one in (plain, textured):
        assert meshfiles._plain_triangles(one) is not None
        (tmp_path / "m.ply").write_bytes(one)
        (piece,) = meshfiles.pieces(tmp_path / "m.ply")
        found = load_ply(BytesIO(one))  # puts vertices with textures in another order
        corners = np.asarray(found["vertices"], float)[found["faces"]]
        assert np.array_equal(piece.vertices[piece.faces], corners)
        assert (piece.vertices.dtype, piece.faces.dtype) == (np.float64, np.int64)
    quads = np.zeros(5, [("count", "u1"), ("corners", "<i4", 3)])
    quads["count"] = 4
    for other in (
        plain + b"\0",
        plain[:-1],
        ply("9", "5", points.tobytes() + quads.tobytes()),
        ply("9", "0", body),
        plain.replace(b"float z", b"float w"),
        plain.replace(z, z + b"property float s\n"),
        textured.replace(b"float s", b"float x"),
        textured.replace(b"float s", b"int s"),
        plain.replace(b"list uchar int", b"list uchar uint"),
        plain.replace(b"little", b"big"),
        plain.replace(b"element vertex", b"comment a\nelement vertex"),
    ):
        assert meshfiles._plain_triangles(other) is None
