"""Maps as tables and terrain as rasters, by the readers of the extra `cities`; each file is made
here. Without the extra one message names it."""

from __future__ import annotations

import base64
import contextlib
import json
import os
import random
import socket
import sqlite3
import sys
import threading
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pyproj
import pytest
from bounded import bounded_command

from isac_rt import scenario
from isac_rt.world.city import CityError, CityMesh, city_files, load_city

F_C = 77e9
EAST, NORTH = 2_683_000.0, 1_247_000.0
ROWS = [
    {"x": 0.0, "building": "yes", "height": "12,5", "levels": None},
    {"x": 40.0, "building": "house", "height": None, "levels": 4},
    {"x": 80.0, "building": "no", "height": "30", "levels": None},
]
VOLUME = 400 * 12.5 + 400 * 12.0
LOCAL = {"origin": [EAST, NORTH, 0], "ground_margin_m": 30.0}


def table(crs: str | None = "EPSG:2056"):
    geopandas = pytest.importorskip("geopandas")
    from shapely.geometry import box

    shapes = [box(EAST + r["x"], NORTH, EAST + r["x"] + 20, NORTH + 20) for r in ROWS]
    columns = {key: [r[key] for r in ROWS] for key in ("building", "height", "levels")}
    return geopandas.GeoDataFrame(columns, geometry=shapes, crs=crs)


def read(folder: Path, file: str, **keys) -> CityMesh:
    node = scenario.City.model_validate({"source": "footprints", "file": file, **LOCAL, **keys})
    return load_city(node, folder, F_C, (0.0, 0.0, 0.0))


def volume(city: CityMesh) -> float:
    """Of all closed bodies; the ground has none about the height 0. [m^3]"""
    a, b, c = np.moveaxis(city.corners, 1, 0)
    return float((a * np.cross(b, c)).sum() / 6)


OSM = """<?xml version="1.0" encoding="UTF-8"?>
<osm version="0.6" generator="test">
{nodes}
 <way id="11" version="1"><nd ref="1"/><nd ref="2"/><nd ref="3"/><nd ref="4"/><nd ref="1"/>
  <tag k="building" v="yes"/><tag k="building:levels" v="5"/></way>
 <way id="12" version="1"><nd ref="5"/><nd ref="6"/><nd ref="7"/><nd ref="8"/><nd ref="5"/>
  <tag k="landuse" v="forest"/></way>
</osm>"""


PBF = (
    "AAAADQoJT1NNSGVhZGVyGDsQLxo3eJxT4vMvzg1OzkjNTdQNM9AzU+JySc0rTvXLT0ktbmIUyMlMyi/OzSzN1TfS"
    "MzLWMwQAX2cOkwAAAAsKB09TTURhdGEYUhB2Gk54nONi4WLgYhDKE8rh4mCCAi0jLg5GKBDiYIACKThLCc7S4mCC"
    "spz4G/ad2cHM8EGPYUMuiPQSbPh/y/mAHcN+uwVzGMF0EFwfAIOlEUYAAAALCgdPU01EYXRhGG0QeBppeJzjsuBi"
    "4OJIKs3MScnMS+fih7GsclLLUnOKuZgrU4u5GE2BithzEvNSSotTudjS8otSi0uEbKRkObiFmBiZpJiYWZS4OBgF"
    "GCQYFBg0WJ1YmYCAVUqag0eIkU2KkR1VkgskCQB4PxR7"
)
"""The same town as OSM, packed by osmium."""


def osm(folder: Path) -> None:
    places = [
        (7.1 + x, 46.2 + y)
        for k in (0, 1e-3)
        for x, y in ((k, k), (k + 4e-4, k), (k + 4e-4, k + 3e-4), (k, k + 3e-4))
    ]
    nodes = "\n".join(
        f'<node id="{i}" version="1" lat="{lat:.7f}" lon="{lon:.7f}"/>'
        for i, (lon, lat) in enumerate(places, start=1)
    )
    (folder / "town.osm").write_text(OSM.format(nodes=nodes))


@pytest.mark.parametrize("kind", ["gpkg", "shp", "fgb", "parquet"])
def test_tables_are_read_with_their_reference_system(kind, tmp_path):
    """Planted bug: rows with `building=no` stand."""
    file = tmp_path / f"town.{kind}"
    table().to_parquet(file) if kind == "parquet" else table().to_file(file)
    city = read(tmp_path, file.name)
    assert volume(city) == pytest.approx(VOLUME, rel=1e-6)
    assert city.georeference is not None
    assert city.georeference.crs == "EPSG:2056"
    named = {
        f.name for f in city_files(scenario.City(source="footprints", file=file.name), tmp_path)
    }
    assert named == {f.name for f in tmp_path.iterdir()}


def test_layers(tmp_path):
    file = tmp_path / "town.gpkg"
    table().to_file(file, layer="gis_buildings")
    table()[:1].to_file(file, layer="gis_landuse")
    assert volume(read(tmp_path, "town.gpkg")) == pytest.approx(VOLUME, rel=1e-6)
    one = read(tmp_path, "town.gpkg", layer="gis_landuse")
    assert volume(one) == pytest.approx(400 * 12.5, rel=1e-6)
    with pytest.raises(CityError, match="gis_landuse"):
        read(tmp_path, "town.gpkg", layer="roofs")


def test_columns_that_hold_lists_and_nothing(tmp_path):
    """As Overture's GeoParquet, whose `sources` are lists and whose `names` are structs; numbers
    that may be missing are those of pandas."""
    rows = table()
    rows["sources"] = [[{"dataset": "a"}, {"dataset": "b"}], [], None]
    rows["names"] = [{"primary": "x"}, None, {"primary": "y"}]
    rows["levels"] = rows["levels"].astype("Int64")
    rows.to_parquet(tmp_path / "town.parquet")
    assert volume(read(tmp_path, "town.parquet")) == pytest.approx(VOLUME, rel=1e-6)


def test_a_layer_without_shapes_is_one_message(tmp_path):
    pyogrio = pytest.importorskip("pyogrio")
    table().to_file(tmp_path / "town.gpkg", layer="buildings")
    bare = table().drop(columns="geometry")
    pyogrio.write_dataframe(bare, tmp_path / "town.gpkg", layer="owners")
    with pytest.raises(CityError, match="owners has no shapes"):
        read(tmp_path, "town.gpkg", layer="owners")


@pytest.mark.parametrize("name", ["town.osm", "town.osm.pbf"])
def test_openstreetmap(name, tmp_path):
    pytest.importorskip("pyogrio")
    osm(tmp_path)
    (tmp_path / "town.osm.pbf").write_bytes(base64.b64decode(PBF))
    city = read(tmp_path, name, origin=[7.1, 46.2, 0], ground_margin_m=0.0)
    assert city.bounds()[1, 2] == pytest.approx(15.0)
    assert city.bounds()[1, 0] == pytest.approx(4e-4 * 77_186, rel=1e-3)  # a degree there [m]
    assert any("1 of landuse" in note for note in city.notes)


@pytest.mark.parametrize(
    ("name", "content", "says"),
    [
        ("town.gpkg", b"<OGRVRTDataSource/>", "is no GeoPackage"),
        ("town.shp", b"PK\3\4", "is no Shapefile"),
        ("town.parquet", b"PAR1" + bytes(50), "not readable"),
        ("town.gpkg", b"SQLite format 3\0" + bytes(5000), "not readable"),
        ("town.osm", b'<!DOCTYPE osm [<!ENTITY a "b">]><osm/>', "document type"),
        ("town.osm", b"<!--" + b"x" * 6000 + b"--><!DOCTYPE osm []><osm/>", "document type"),
        ("town.osm", "<!DOCTYPE osm []><osm/>".encode("utf-16-le"), "document type"),
        ("town.osm", b"<osm version='0.6'><node id='1'", None),
        ("town.osm", b"<!-- -->" * 200_000, "begins with <osm>"),
        ("town.pbf", bytes(20), None),
        ("town.gml", b"<?xml version='1.0'?><CityModel/>", "citygml-tools to-cityjson town.gml"),
    ],
)
def test_what_is_none(name, content, says, tmp_path):
    pytest.importorskip("geopandas")
    (tmp_path / name).write_bytes(content)
    with pytest.raises(CityError, match=says):
        read(tmp_path, name)


VRT = (
    "<OGRVRTDataSource><OGRVRTLayer name='multipolygons'><SrcDataSource>{}</SrcDataSource>"
    "<SrcLayer>a</SrcLayer></OGRVRTLayer></OGRVRTDataSource>"
)
WFS = "<OGRWFSDataSource><URL>{}</URL></OGRWFSDataSource>"


@contextlib.contextmanager
def listener() -> Iterator[tuple[str, list[str]]]:
    """A port of this machine, and who came to it."""
    seen: list[str] = []
    with socket.create_server(("127.0.0.1", 0)) as server:

        def wait() -> None:
            with contextlib.suppress(OSError):
                while True:
                    caller, address = server.accept()
                    seen.append(str(address))
                    caller.close()

        threading.Thread(target=wait, daemon=True).start()
        yield f"http://127.0.0.1:{server.getsockname()[1]}", seen
        server.shutdown(socket.SHUT_RDWR)


@pytest.mark.parametrize("document", [VRT.replace("{}", "/vsicurl/{}/a.geojson"), WFS])
@pytest.mark.parametrize(
    ("name", "before", "after"),
    [
        ("town.osm", "", ""),
        ("town.osm", "<!-- <osm> -->", ""),
        ("town.osm", "<!-- ", " --><osm version='0.6'></osm>"),
        ("town.osm", "<osm version='0.6'><!-- ", " --></osm>"),
        ("town.osm", "<osm version='0.6'><note><![CDATA[ ", "]]></note></osm>"),
        ("town.fgb", "fgb", ""),
    ],
)
def test_a_document_of_another_driver_opens_no_connection(document, name, before, after, tmp_path):
    """GDAL's drivers look for their word anywhere in the first bytes."""
    pytest.importorskip("geopandas")
    with listener() as (address, seen):
        (tmp_path / name).write_text(before + document.format(address) + after)
        with pytest.raises(CityError, match=name):
            read(tmp_path, name)
    assert not seen


@pytest.mark.parametrize(
    ("name", "before"), [("town.osm", ""), ("town.fgb", "fgb"), ("town.osm", "<!-- <osm> -->")]
)
def test_a_document_of_another_driver_opens_no_local_file(name, before, tmp_path):
    pytest.importorskip("geopandas")
    (tmp_path / "elsewhere").mkdir()
    ring = [[7.1, 46.2], [7.101, 46.2], [7.101, 46.201], [7.1, 46.2]]
    shape = {"type": "Polygon", "coordinates": [ring]}
    feature = {"type": "Feature", "properties": {"building": "yes"}, "geometry": shape}
    file = tmp_path / "elsewhere" / "t.geojson"
    file.write_text(json.dumps({"type": "FeatureCollection", "features": [feature]}))
    named = VRT.format(file).replace("<SrcLayer>a<", "<SrcLayer>t<")
    (tmp_path / name).write_text(before + named)
    with pytest.raises(CityError, match=name):
        read(tmp_path, name, origin=None)


_VIEWS = {
    "endless": "WITH RECURSIVE c(i) AS (SELECT 1 UNION ALL SELECT i + 1 FROM c) "
    "SELECT i AS fid, (SELECT geom FROM b) AS geom FROM c",
    "endless without rows": "WITH RECURSIVE c(i) AS (SELECT 1 UNION ALL SELECT i + 1 FROM c) "
    "SELECT i AS fid, NULL AS geom FROM c WHERE i < 0",
    "huge cell": "SELECT fid, geom, hex(randomblob(400000000)) AS height FROM b",
    "huge text": "SELECT fid, geom, printf('%.*c', 900000000, '1') AS height FROM b",
    "many large cells": "WITH RECURSIVE c(i) AS (SELECT 1 UNION ALL SELECT i + 1 FROM c LIMIT 999) "
    "SELECT i AS fid, b.geom AS geom, printf('%.*c', 9000000, '1') AS height FROM c, b",
}


@pytest.mark.parametrize("view", _VIEWS)
def test_a_geopackage_that_computes_without_end_is_one_message_soon(view, tmp_path):
    """5 s and 1 GiB at most, whatever the file asks for, in all processes together."""
    table()[:1].to_file(tmp_path / "town.gpkg", layer="b")
    with contextlib.closing(sqlite3.connect(tmp_path / "town.gpkg")) as file, file:
        file.execute(f"CREATE VIEW z AS {_VIEWS[view]}")
        for of in ("gpkg_contents", "gpkg_geometry_columns"):
            file.execute(f"UPDATE {of} SET table_name = 'z'")
        file.execute("UPDATE gpkg_contents SET identifier = 'z'")
    (tmp_path / "s.yaml").write_text(
        "city: {source: footprints, file: town.gpkg, layer: z}\n"
        "swarm: {A: {role: active, position_m: [0, 0, 30]}}\n"
    )
    answer = bounded_command(["run", "s.yaml", "--out", "out"], tmp_path)
    assert "town.gpkg" in answer


@pytest.mark.parametrize("name", ["town.gpkg", "town.osm", "town.parquet"])
def test_without_the_extra_one_message_names_it(name, tmp_path, monkeypatch):
    start = {"gpkg": b"SQLite format 3\0", "osm": b"<osm/>", "parquet": b"PAR1"}
    (tmp_path / name).write_bytes(start[name.rpartition(".")[2]])
    monkeypatch.setitem(sys.modules, "geopandas", None)
    with pytest.raises(CityError, match=r"pip install 'isac_rt\[cities\]'"):
        read(tmp_path, name)


# ---- terrain


def raster(folder: Path, crs: str = "EPSG:2056", hole: bool = False) -> str:
    """A slope of one in five to the east at 400 m, 2 m a cell; heights at the middles of cells."""
    rasterio = pytest.importorskip("rasterio")
    columns, _ = np.meshgrid(np.arange(150), np.arange(100))
    heights = (400 + 0.2 * (2.0 * columns + 1 - 100)).astype(np.float32)
    if hole:
        heights[:, 60:70] = -9999
    profile = {"driver": "GTiff", "dtype": "float32", "count": 1, "width": 150, "height": 100}
    west_north = rasterio.transform.from_origin(EAST - 100, NORTH + 120, 2.0, 2.0)
    with rasterio.open(
        folder / "dem.tif", "w", crs=crs, transform=west_north, nodata=-9999, **profile
    ) as file:
        file.write(heights, 1)
    return "dem.tif"


def town(folder: Path) -> str:
    squares = [
        [[EAST + x + a, NORTH + b] for a, b in ((0, 0), (20, 0), (20, 20), (0, 20), (0, 0))]
        for x in (0, 60)
    ]
    features = [
        {
            "type": "Feature",
            "properties": {"building": "yes", "height": 10},
            "geometry": {"type": "Polygon", "coordinates": [ring]},
        }
        for ring in squares
    ]
    (folder / "t.geojson").write_text(
        json.dumps({"type": "FeatureCollection", "features": features})
    )
    return "t.geojson"


@pytest.mark.parametrize("hole", [False, True])
def test_buildings_stand_on_a_raster_of_heights(hole, tmp_path):
    """Heights count from the lowest point under a building, as OpenStreetMap has them; the ground
    follows the raster. Planted bug: rows and columns swapped; half a cell off (0.2 m)."""
    keys = {
        "crs": "EPSG:2056",
        "terrain": raster(tmp_path, hole=hole),
        "origin": [EAST, NORTH, 390],
    }
    city = read(tmp_path, town(tmp_path), **keys)
    concrete = [m.name for m in city.materials].index("concrete")
    tops = city.corners[(city.face_material == concrete) & (city.normals[:, 2] > 0.9)]
    found = {round(float(p[0, 0]) // 60 * 60): float(p[0, 2]) for p in tops}
    assert found == pytest.approx({0: 10 + 10 + 0.0, 60: 10 + 10 + 12.0}, abs=2e-3)
    up = city.normals[:, 2] > 0.9
    sloped = city.corners[up & (np.ptp(city.corners[..., 2], axis=1) > 1e-3)].reshape(-1, 3)
    assert len(sloped) > 1000
    free = sloped if not hole else sloped[(sloped[:, 0] < 15) | (sloped[:, 0] > 45)]
    assert free[:, 2] == pytest.approx(10 + 0.2 * free[:, 0], abs=2e-3)
    node = scenario.City(source="footprints", file="t.geojson", terrain="dem.tif")
    assert [f.name for f in city_files(node, tmp_path)] == ["t.geojson", "dem.tif"]


def test_a_raster_of_cells_without_a_size_is_one_message(tmp_path):
    rasterio = pytest.importorskip("rasterio")
    name = raster(tmp_path)
    with rasterio.open(tmp_path / name, "r+") as file:
        file.transform = rasterio.Affine(0, 0, EAST, 0, 0, NORTH)
    with pytest.raises(CityError, match="says not where it lies"):
        read(tmp_path, town(tmp_path), crs="EPSG:2056", terrain=name)


def test_a_raster_in_other_coordinates_and_elsewhere(tmp_path):
    name = raster(tmp_path)
    turn = pyproj.Transformer.from_crs("EPSG:2056", "OGC:CRS84", always_xy=True)
    x, y = turn.transform(EAST + 10, NORTH + 10)
    ring = [
        [x - 1e-4, y - 1e-4],
        [x + 1e-4, y - 1e-4],
        [x + 1e-4, y + 1e-4],
        [x - 1e-4, y + 1e-4],
        [x - 1e-4, y - 1e-4],
    ]
    shape = {"type": "Polygon", "coordinates": [ring]}
    (tmp_path / "d.geojson").write_text(
        json.dumps({"type": "Feature", "properties": {"height": 5}, "geometry": shape})
    )
    city = read(tmp_path, "d.geojson", terrain=name, origin=[x, y, 0], ground_margin_m=5.0)
    west = 1e-4 * 75_500  # half of the building [m]
    assert city.bounds()[1, 2] == pytest.approx(405 + 0.2 * (10 - west), abs=0.15)
    ring = [[a + 1.0, b] for a, b in ring]
    shape = {"type": "Polygon", "coordinates": [ring]}
    (tmp_path / "e.geojson").write_text(
        json.dumps({"type": "Feature", "properties": {"height": 5}, "geometry": shape})
    )
    with pytest.raises(CityError, match="lies elsewhere"):
        read(tmp_path, "e.geojson", terrain=name, origin=[x, y, 0])
    (tmp_path / "dem.tif").write_bytes(b"II*\0" + bytes(100))
    with pytest.raises(CityError, match=r"dem\.tif"):
        read(tmp_path, "d.geojson", terrain=name, origin=[x, y, 0])
    with pytest.raises(CityError, match=r"city\.terrain"):
        read(tmp_path, "d.geojson", terrain="nothing.tif", origin=[x, y, 0])


@pytest.mark.parametrize("kind", ["gpkg", "shp", "fgb", "parquet", "osm", "tif"])
def test_bent_tables_and_rasters_give_a_city_or_one_message(kind, tmp_path):
    """FUZZ=500 looks further. Bytes changed and cut off, in one of the files."""
    if kind == "osm":
        pytest.importorskip("geopandas")
        osm(tmp_path)
    elif kind == "tif":
        town(tmp_path)
        raster(tmp_path)
    elif kind == "parquet":
        table().to_parquet(tmp_path / "town.parquet")
    else:
        table().to_file(tmp_path / f"town.{kind}")
    whole = {file: file.read_bytes() for file in tmp_path.iterdir() if file.suffix != ".geojson"}
    name, keys = ("t.geojson", {"terrain": "dem.tif"}) if kind == "tif" else (f"town.{kind}", {})
    for case in range(int(os.environ.get("FUZZ", "2"))):
        chance = random.Random(f"{kind} {case}")
        for file, data in whole.items():
            file.write_bytes(data)
        file = chance.choice(sorted(whole))
        bent = bytearray(whole[file])
        for _ in range(chance.randint(1, 5)):
            bent[chance.randrange(len(bent))] = chance.randrange(256)
        file.write_bytes(bent[: chance.choice([len(bent), len(bent), chance.randrange(len(bent))])])
        with contextlib.suppress(CityError):
            assert np.isfinite(read(tmp_path, name, **keys).corners).all()
