"""Tables of shapes, by readers that are an extra: GeoPackage, Shapefile, FlatGeobuf, GeoParquet,
OpenStreetMap's XML and PBF."""

from __future__ import annotations

import itertools
import json
import math
import os
import re
import subprocess
import sys
from collections.abc import Mapping, Sequence
from importlib.util import find_spec
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import shapely
from numpy.typing import NDArray

from isac_rt.extensions.city_files.buildings import Feature
from isac_rt.world.city.files import missing_extra, read_bytes
from isac_rt.world.city.materials import CityError


class Table(NamedTuple):
    """A kind of table: its name, how such a file begins, the only driver that may read it, and the
    memory that this may take over the size of the file."""

    kind: str
    start: bytes
    driver: str
    factor: float = 12.0


TABLES = {
    ".gpkg": Table("GeoPackage", b"SQLite format 3\0", "GPKG"),
    ".shp": Table("Shapefile", b"\0\0\x27\x0a", "ESRI Shapefile"),
    ".fgb": Table("FlatGeobuf", b"fgb", "FlatGeobuf"),
    ".parquet": Table("GeoParquet", b"PAR1", "Parquet", 40.0),
    ".geoparquet": Table("GeoParquet", b"PAR1", "Parquet", 40.0),
    ".osm": Table("OpenStreetMap XML", b"<", "OSM"),
    ".pbf": Table("OpenStreetMap PBF", b"\0\0\0", "OSM", 60.0),
}
"""What each ending stands for."""
_BESIDE = (".shx", ".dbf", ".prj", ".cpg")
_BASE_BYTES, _BASE_S = 500_000_000, 1
"""Memory and processor time of the process that reads a table, without the table."""
_BYTES_PER_S = 12e6
"""Of memory over the file: a fifth of what is read on one core."""
_ALONE = {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1", "ARROW_IO_THREADS": "1"}
"""Threads of the process that reads a table: each would take memory of its own."""
_ROOT = re.compile(rb"\s*+(?:<\?xml[^>]*>\s*+)?(?:(?><!--.*?-->)\s*+)*+<osm[\s>/]", re.DOTALL)
"""How OpenStreetMap's XML begins."""


def table_files(path: Path) -> list[Path]:
    """A table's file and those that it is read from."""
    if path.suffix.lower() != ".shp":
        return [path]
    endings = [e for e in _BESIDE] + [e.upper() for e in _BESIDE]
    found = [path.with_suffix(ending) for ending in endings]
    return [path, *(file for file in found if file.is_file())]


def read_table(path: Path, layer: str | None) -> tuple[list[Feature], str]:
    """The rows of a table as features of a map, and its coordinate reference system.

    Raises
    ------
    CityError  If the file is not what its name says, or the readers are not installed.
    """
    table = TABLES[path.suffix.lower()]
    files = [(file.name, read_bytes(file, table.factor)) for file in table_files(path)]
    _check_start(path.name, table, files[0][1])
    for package in ("pyogrio", "geopandas"):
        if find_spec(package) is None:
            raise missing_extra(path.name, table.kind)
    found, shapes = _read_apart(table, files, layer)
    if "refused" in found:
        raise CityError(f"{path.name}: {found['refused']}")
    if "problem" in found:
        raise CityError(f"{path.name}: not readable as {table.kind} ({found['problem']})")
    try:
        return _features(shapely.from_wkb(shapes), found["columns"], path.name), found["crs"]
    except shapely.errors.ShapelyError as error:
        raise CityError(f"{path.name}: not readable as {table.kind} ({error})") from None


def _check_start(name: str, table: Table, data: bytes) -> None:
    """Refuse a file that does not begin as its ending says."""
    xml = table.kind == "OpenStreetMap XML"
    text = data.removeprefix(b"\xef\xbb\xbf")
    if not (text.lstrip() if xml else data).startswith(table.start):
        raise CityError(f"{name}: is no {table.kind}; check its ending")
    if xml and (b"<!DOCTYPE" in data or b"\0" in data):  # \0: in two bytes a letter
        raise CityError(f"{name}: has a document type; remove it")
    if xml and not _ROOT.match(text):
        raise CityError(f"{name}: is no OpenStreetMap XML, which begins with <osm>; check it")


def _read_apart(
    table: Table, files: Sequence[tuple[str, bytes]], layer: str | None
) -> tuple[dict[str, Any], list[bytes]]:
    """Return the answer of `table_process`: its line, and each row's shape as well-known binary."""
    size = sum(len(content) for _, content in files)
    seconds = _BASE_S + math.ceil(size * table.factor / _BYTES_PER_S)
    memory = _BASE_BYTES + int(size * table.factor)
    packages = json.dumps([path for path in sys.path if os.path.isabs(path)])
    program = [str(Path(__file__).with_name("table_process.py")), packages]
    # files of the working folder are not this process's, nor are settings for Python
    request = json.dumps({"layer": layer, "files": [(n.lower(), len(c)) for n, c in files]})
    try:
        answer = subprocess.run(
            [sys.executable, "-I", "-S", *program, table.driver, str(memory), str(seconds)],
            input=b"\n".join([request.encode(), b"".join(content for _, content in files)]),
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
            cwd="/",
            env=os.environ | _ALONE,
            timeout=10 * seconds,
        )
    except subprocess.TimeoutExpired:
        return {"problem": f"it takes longer than {10 * seconds} s"}, []
    if answer.returncode:
        allowed = f"{seconds} s and {memory / 1e9:.2g} GB, allowed for {size / 1e6:.3g} MB"
        return {"problem": f"it takes more than {allowed}, or ended the reader"}, []
    line, _, blobs = answer.stdout.partition(b"\n")
    found = json.loads(line)
    ends = np.cumsum([0, *found["lengths"]]).tolist()
    return found, [blobs[a:b] for a, b in itertools.pairwise(ends)]


def _features(
    shapes: NDArray[np.object_], columns: Mapping[str, Sequence[Any]], name: str
) -> list[Feature]:
    """Rows as features; what is missing is left out of their properties."""
    areas = np.isin(shapely.get_type_id(shapes), (3, 6))
    shapes = shapely.force_2d(shapes)
    found = []
    for i, (shape, area) in enumerate(zip(shapes, areas.tolist(), strict=True)):
        own = {key: cells[i] for key, cells in columns.items() if cells[i] is not None}
        number = own.get("osm_id") or own.get("osm_way_id") or own.get("id") or f"row {i}"
        found.append(Feature(shape if area else shapely.Polygon(), own, f"{name}: {number}"))
    return found
