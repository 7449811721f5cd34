"""Tables of shapes, by readers that are an extra: GeoPackage, Shapefile, FlatGeobuf, GeoParquet,
OpenStreetMap's XML and PBF."""

from __future__ import annotations

import warnings
from pathlib import Path
from typing import Any

import numpy as np
import shapely

from isac_rt.world.city.buildings import Feature
from isac_rt.world.city.files import needs_extra, read_bytes
from isac_rt.world.city.materials import CityError

TABLES: dict[str, tuple[str, tuple[bytes, ...]]] = {
    ".gpkg": ("GeoPackage", (b"SQLite format 3\0",)),
    ".shp": ("Shapefile", (b"\0\0\x27\x0a",)),
    ".fgb": ("FlatGeobuf", (b"fgb",)),
    ".parquet": ("GeoParquet", (b"PAR1",)),
    ".geoparquet": ("GeoParquet", (b"PAR1",)),
    ".osm": ("OpenStreetMap XML", (b"<",)),
    ".pbf": ("OpenStreetMap PBF", (b"\0\0\0",)),
}
"""What each ending stands for, and how such a file begins: GDAL goes by content."""
_BESIDE = (".shx", ".dbf", ".prj", ".cpg")
PBF_FACTOR = 60
"""Memory over the size of a PBF file."""
_FACTOR = 12


def table_files(path: Path) -> list[Path]:
    """A table's file and those that it is read from."""
    if path.suffix.lower() != ".shp":
        return [path]
    endings = [e for e in _BESIDE] + [e.upper() for e in _BESIDE]
    found = [path.with_suffix(ending) for ending in endings]
    return [path, *(file for file in found if file.is_file())]


def read_table(path: Path, layer: str | None, notes: list[str]) -> tuple[list[Feature], str]:
    """The rows of a table as features of a map, and its coordinate reference system.

    Raises
    ------
    CityError  If the file is not what its name says, or the readers are not installed.
    """
    kind, starts = TABLES[path.suffix.lower()]
    data = read_bytes(path, PBF_FACTOR if path.suffix.lower() == ".pbf" else _FACTOR)
    if not data.lstrip(b"\xef\xbb\xbf \r\n\t" if starts == (b"<",) else b"").startswith(starts):
        raise CityError(f"{path.name}: is no {kind}; check its ending")
    if starts == (b"<",) and (b"<!DOCTYPE" in data or b"\0" in data):  # \0: in two bytes a letter
        raise CityError(f"{path.name}: has a document type; remove it")
    needs_extra("pyogrio", path.name, kind)
    geopandas = needs_extra("geopandas", path.name, kind)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # of an ending that bytes do not have, and the like
            table = (
                _parquet(geopandas, data)
                if kind == "GeoParquet"
                else _by_gdal(geopandas, path, data, _layer(path, data, kind, layer))
            )
    except CityError:
        raise
    except Exception as error:
        raise CityError(
            f"{path.name}: not readable as {kind} ({type(error).__name__}: {error})"
        ) from None
    if not hasattr(table, "crs"):
        raise CityError(f"{path.name}: {layer or 'its layer'} has no shapes; set city.layer")
    return _features(table, path.name), "" if table.crs is None else table.crs.to_wkt()


def _parquet(geopandas: Any, data: bytes) -> Any:
    from io import BytesIO

    return geopandas.read_parquet(BytesIO(data))


def _by_gdal(geopandas: Any, path: Path, data: bytes, layer: str | None) -> Any:
    return geopandas.read_file(
        path if path.suffix.lower() == ".shp" else data, layer=layer, engine="pyogrio"
    )


def _layer(path: Path, data: bytes, kind: str, wanted: str | None) -> str | None:
    """The layer with buildings."""
    import pyogrio

    if kind.startswith("OpenStreetMap"):
        return "multipolygons"
    if kind == "Shapefile":
        return None
    layers = [(str(name), str(shape)) for name, shape in pyogrio.list_layers(data)]
    names = [name for name, _ in layers]
    if wanted is not None and wanted not in names:
        raise CityError(
            f"{path.name}: has no layer {wanted!r} (city.layer); it has {', '.join(names)}"
        )
    if wanted is not None:
        return wanted
    areas = [name for name, shape in layers if "Polygon" in shape or "Unknown" in shape]
    called = [name for name in areas if "building" in name.lower()]
    chosen = called if len(called) == 1 else areas
    if len(chosen) != 1:
        raise CityError(
            f"{path.name}: which layer holds the buildings? Set city.layer to one of "
            f"{', '.join(areas or names)}"
        )
    return chosen[0]


def _features(table: Any, name: str) -> list[Feature]:
    """Rows as features; what is missing is left out of their properties."""
    shapes = shapely.force_2d(np.asarray(table.geometry.values))
    areas = np.isin(shapely.get_type_id(shapes), (3, 6))
    rows = table.drop(columns=table.geometry.name).to_dict("records")
    found = []
    for i, (shape, row, area) in enumerate(zip(shapes, rows, areas.tolist(), strict=True)):
        own = {str(key): _plain(value) for key, value in row.items()}
        own = {key: value for key, value in own.items() if value is not None}
        number = own.get("osm_id") or own.get("osm_way_id") or own.get("id") or f"row {i}"
        found.append(Feature(shape if area else shapely.Polygon(), own, f"{name}: {number}"))
    return found


def _plain(value: Any) -> Any:
    """A cell as JSON would hold it."""
    import pandas as pd  # most cities are read without

    if isinstance(value, np.generic):
        value = value.item()
    if isinstance(value, np.ndarray | list):  # GeoParquet's, of which no tag is one
        return None
    return None if pd.isna(value) else value
