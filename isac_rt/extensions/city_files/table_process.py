"""The process that GDAL and Arrow read a table in: `tables` starts it.

It is run as a file of its own, with the packages of the process that starts it, and imports nothing
of this one. The table comes over standard input, so that the process needs no file; every driver
of GDAL but the table's is switched off before GDAL starts; its memory and processor time are
limited. It answers with one line of JSON and the shapes as well-known binary.
"""

from __future__ import annotations

import importlib
import io
import json
import os
import resource
import sys
import tempfile
import time
import zipfile
from typing import Any

MAX_TEXT = 1000
"""Letters of a cell; a longer one is left out."""
_SWITCHED_OFF = "ISAC_RT_DRIVERS_OFF"


class _Refused(Exception):
    """Error that the user can mend, in words of this program."""


def _only_driver(driver: str) -> None:
    """Start this program again with all other drivers off, a list that GDAL reads when loaded."""
    import pyogrio

    others = [name for name in pyogrio.list_drivers() if name != driver]
    settings = {
        "GDAL_SKIP": ",".join(others),
        "OGR_SQLITE_PRAGMA": "trusted_schema=OFF",
        "CPL_TMPDIR": os.environ.get("CPL_TMPDIR") or tempfile.gettempdir(),
        "GDAL_HTTP_PROXY": "127.0.0.1:9",  # no driver that is left uses the network
        _SWITCHED_OFF: "1",
    }
    os.execve(sys.executable, [sys.executable, "-I", "-S", *sys.argv], {**os.environ, **settings})


def _limit(kind: int, value: int) -> None:
    hard = resource.getrlimit(kind)[1]
    value = value if hard == resource.RLIM_INFINITY else min(value, hard)
    resource.setrlimit(kind, (value, value))


def _data_bytes() -> int:
    """Memory that this process has asked for. [bytes]"""
    try:
        with open("/proc/self/status") as status:
            return next(1024 * int(line.split()[1]) for line in status if line[:7] == "VmData:")
    except (OSError, StopIteration):
        return 0


def _source(files: list[tuple[str, bytes]]) -> bytes:
    """The table as one piece of memory: a Shapefile is several files, which GDAL reads as a zip."""
    if len(files) == 1 and not files[0][0].endswith(".shp"):
        return files[0][1]
    packed = io.BytesIO()
    with zipfile.ZipFile(packed, "w") as archive:
        for name, content in files:
            archive.writestr(name, content)
    return packed.getvalue()


def _by_gdal(
    driver: str, data: bytes, wanted: str | None
) -> tuple[dict[str, Any], list[bytes | None]]:
    from pyogrio import raw

    layer = "multipolygons" if driver == "OSM" else None
    if driver in ("GPKG", "FlatGeobuf"):
        layer = _layer(data, wanted)
    meta, _, shapes, columns = raw.read(data, layer=layer, force_2d=True)
    names = [str(name) for name in meta["fields"]]
    table = {n: [_plain(v) for v in c.tolist()] for n, c in zip(names, columns, strict=True)}
    if shapes is None:
        raise _Refused(f"{layer or 'its layer'} has no shapes; set city.layer")
    return {"crs": meta["crs"] or "", "columns": table}, list(shapes)


def _layer(data: bytes, wanted: str | None) -> str:
    """The layer with buildings.

    Raises
    ------
    _Refused  If there is no such layer, or several could be meant.
    """
    import pyogrio

    layers = [(str(name), str(shape)) for name, shape in pyogrio.list_layers(data)]
    names = [name for name, _ in layers]
    if wanted is not None:
        if wanted not in names:
            raise _Refused(f"has no layer {wanted!r} (city.layer); it has {', '.join(names)}")
        return wanted
    areas = [name for name, shape in layers if "Polygon" in shape or "Unknown" in shape]
    called = [name for name in areas if "building" in name.lower()]
    chosen = called if len(called) == 1 else areas
    if len(chosen) != 1:
        listed = ", ".join(areas or names)
        raise _Refused(f"which layer holds the buildings? Set city.layer to one of {listed}")
    return chosen[0]


def _by_arrow(data: bytes) -> tuple[dict[str, Any], list[bytes | None]]:
    import geopandas

    table = geopandas.read_parquet(io.BytesIO(data))
    columns = {
        str(name): [_plain(value) for value in table[name].astype(object).tolist()]
        for name in table.columns
        if name != table.geometry.name
    }
    crs = "" if table.crs is None else table.crs.to_wkt()
    return {"crs": crs, "columns": columns}, list(table.geometry.to_wkb())


def _plain(value: Any) -> str | int | float | bool | None:
    """A cell as JSON holds it: lists and dates become nothing, no tag of a building is one."""
    if isinstance(value, str):
        return value if len(value) <= MAX_TEXT else None
    if isinstance(value, bool | int):
        return value
    return value if isinstance(value, float) and value == value else None


def _answer(found: dict[str, Any], shapes: list[bytes | None]) -> None:
    blobs = [shape or b"" for shape in shapes]
    found |= {"lengths": [len(blob) for blob in blobs]}
    sys.stdout.buffer.write(json.dumps(found).encode() + b"\n")
    sys.stdout.buffer.write(b"".join(blobs))


def main() -> None:
    """Read one table as the first line of standard input says it."""
    sys.path[:0] = json.loads(sys.argv[1])
    driver, memory, seconds = sys.argv[2], int(sys.argv[3]), int(sys.argv[4])
    if driver != "Parquet" and _SWITCHED_OFF not in os.environ:
        _only_driver(driver)
    request = json.loads(sys.stdin.buffer.readline())
    files = [(name, sys.stdin.buffer.read(size)) for name, size in request["files"]]
    try:
        # what this takes of memory and time does not count
        importlib.import_module("geopandas" if driver == "Parquet" else "pyogrio.raw")
        _limit(resource.RLIMIT_DATA, _data_bytes() + memory)
        _limit(resource.RLIMIT_CPU, int(time.process_time()) + seconds)
        data = _source(files)
        found = _by_arrow(data) if driver == "Parquet" else _by_gdal(driver, data, request["layer"])
        _answer(*found)
    except _Refused as refusal:
        _answer({"refused": str(refusal)}, [])
    except Exception as problem:
        said = " ".join(f"{type(problem).__name__}: {problem}".split())
        _answer({"problem": said[:300]}, [])


if __name__ == "__main__":
    main()
