"""Tables and logs that a scenario names as files: read into its tree, so that what is kept of a
run, a path or a point of a sweep depends on their numbers and needs the files no more."""

from __future__ import annotations

import copy
import csv
import io
import logging
import math
import stat
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray
from pydantic import ValidationError

from isac_rt.frame.boards import BOARD_FILES, BoardFileError, read_board
from isac_rt.registry import extension
from isac_rt.scenario.sensors import completed
from isac_rt.settings import Key, Problem
from isac_rt.world.settings import City

if TYPE_CHECKING:
    from isac_rt.world.city.georeference import GeoReference

INPUT_NOTES = logging.getLogger("isac_rt.inputs")
"""Says in a line what was taken of a log or a pattern; the command line prints it."""
MAX_BYTES = 4_000_000
MAX_ROWS = 20_000
MAX_WAYPOINTS = 5_000
_DEGREES = ("lat", "lon", "alt")
_NAMES = {
    f"{name}{unit}": short
    for short, names in {
        "lat": ("lat", "latitude"),
        "lon": ("lon", "lng", "long", "longitude"),
        "alt": ("alt", "altitude", "height"),
        "x": ("x", "easting"),
        "y": ("y", "northing"),
        "z": ("z",),
    }.items()
    for name in names
    for unit in ("", "_deg", "_m")
}
"""What logs of flights call their columns."""
_GRID_M = 5e4
"""Places farther from the world's origin are in a grid such as UTM [m]."""


class TableError(ValueError):
    """A table cannot be used; the key that names it, and what is wrong."""

    def __init__(self, key: Key, text: str) -> None:
        super().__init__(text)
        self.key = key


def read_csv(
    path: Path,
    needed: tuple[str, ...],
    optional: tuple[str, ...] = (),
    otherwise: tuple[str, ...] = (),
    most: int = MAX_ROWS,
) -> dict[str, list[float]]:
    r"""Columns of a CSV file with a header: finite numbers, by comma or semicolon.

    Parameters
    ----------
    path : of a regular file of at most 4 MB; lines that begin with # are passed over
    needed, optional : names of the columns, in any order
    otherwise : columns that may stand in place of those `needed`
    most : rows

    Raises
    ------
    ValueError  With the line.

    Examples
    --------
    >>> import tempfile
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     file = Path(folder) / "rx.csv"
    ...     _ = file.write_text("x, z\n0, 0\n0.5, 0\n")
    ...     read_csv(file, ("x", "z"))
    {'x': [0.0, 0.5], 'z': [0.0, 0.0]}
    """
    lines, mark, header = opened(path)
    if otherwise and set(otherwise) <= set(header):
        needed = otherwise
    names = {*needed, *optional}
    if missing := [name for name in needed if name not in header]:
        wanted = ", ".join((*needed, *(f"[{name}]" for name in optional)))
        wanted += f" or {', '.join(otherwise)}" if otherwise else ""
        raise ValueError(
            f"line {lines[0][0]}: no column {missing[0]}; its header must be {wanted}, not "
            f"{', '.join(header)[:80]!r}"
        )
    if strange := [name for name in header if name not in names or header.count(name) > 1]:
        raise ValueError(f"line {lines[0][0]}: the column {strange[0][:40]!r} is not known here")
    if len(lines) > most + 1:
        raise ValueError(f"has {len(lines) - 1} rows, at most {most} are read; thin it out")
    columns: dict[str, list[float]] = {name: [] for name in header}
    for line in lines[1:]:
        fields = _split(line, mark)
        if len(fields) != len(header):
            raise ValueError(f"line {line[0]}: {len(fields)} fields, the header has {len(header)}")
        for name, field in zip(header, fields, strict=True):
            columns[name].append(number(field, line[0], name))
    if len(lines) == 1:
        raise ValueError("has a header and no rows")
    return columns


def opened(path: Path) -> tuple[list[tuple[int, str]], str, list[str]]:
    """Return a table's lines with their numbers, its separator and the names of its columns."""
    lines = [(i, line) for i, line in enumerate(text_of(path).splitlines(), start=1)]
    lines = [(i, line) for i, line in lines if line.strip() and not line.startswith("#")]
    if not lines:
        raise ValueError("is empty; a table needs a header and rows")
    mark = ";" if ";" in lines[0][1] else ","
    names = [name.strip().lower() for name in _split(lines[0], mark)]
    return lines, mark, [_NAMES.get(name, name) for name in names]


def text_of(path: Path) -> str:
    """Return the text of a regular file of at most 4 MB, or raise ValueError."""
    try:
        about = path.stat()
        if not stat.S_ISREG(about.st_mode):
            raise ValueError("is not a regular file; name a CSV file")
        if about.st_size > MAX_BYTES:
            raise ValueError(f"has {about.st_size} bytes, a table has at most {MAX_BYTES}")
        return path.read_bytes().decode("utf-8-sig")
    except UnicodeDecodeError:
        raise ValueError("is not UTF-8 text; save it in UTF-8") from None
    except OSError as error:
        raise ValueError(
            f"cannot be read: {error.strerror}; the path is relative to the scenario's folder"
        ) from None


def _split(line: tuple[int, str], mark: str) -> list[str]:
    try:
        return next(csv.reader(io.StringIO(line[1]), delimiter=mark, strict=True))
    except csv.Error as error:
        raise ValueError(f"line {line[0]}: {error}") from None


def number(field: str, line: int, name: str) -> float:
    """Return a finite number of a file, or raise ValueError with the line."""
    try:
        value = float(field)
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        raise ValueError(f"line {line}: {name} = {field.strip()[:40]!r} is no finite number")
    return value


Reader = Callable[[Path], dict[str, Any]]


def _places(path: Path) -> dict[str, Any]:
    columns = read_csv(path, ("x", "z"))
    rows = zip(columns["x"], columns["z"], strict=True)
    return {"positions": [list(row) for row in rows]}


def _flight(city: Any, folder: Path, directed: bool, path: Path) -> dict[str, Any]:
    """Waypoints of a flight, from a log or a table, smoothed where ~SECONDS follow its name.
    `directed`: a stated boresight stands in place of a log's attitudes."""
    name, mark, period = str(path).rpartition("~")
    if mark and not path.exists():
        points = _flight(city, folder, directed, Path(name))["waypoints"]
        return {"waypoints": _smoothed(points, number(period, 1, "~SECONDS"), Path(name).name)}
    log = extension("flight_log")(path)
    if log is None:
        return _flight_table(city, folder, path)
    INPUT_NOTES.info(log.note)
    positions = log.positions
    if log.in_degrees:
        positions = _from_degrees(positions, _georeference(city, folder))
    if log.without_height:
        positions[:, 2] = 0.0
    rows = zip(log.times.tolist(), positions.tolist(), strict=True)
    out = [{"time_s": time, "position_m": position} for time, position in rows]
    if log.attitudes is not None and not directed:
        for point, angles in zip(out, log.attitudes.tolist(), strict=True):
            point["attitude_deg"] = angles
    return {"waypoints": out}


def _smoothed(points: list[dict[str, Any]], period: float, file: str) -> list[dict[str, Any]]:
    """Return waypoints on a smoothing spline, which halves motions of a period [s] and leaves out
    faster ones.

    The spline minimises sum (y - f)^2 + w int f''^2. With n points a second it passes a motion of
    angular frequency o by 1/(1 + w o^4/n), hence w = n (period/(2 pi))^4 (C. Reinsch, "Smoothing
    by spline functions", Numerische Mathematik 10, 1967).
    """
    from scipy.interpolate import make_smoothing_spline

    if period <= 0 or len(points) < 5:
        raise ValueError(f"~{period:g}: smoothing needs a positive period and 5 positions or more")
    places = np.array([point["position_m"] for point in points])
    times = np.array([point["time_s"] for point in points])
    if (np.diff(times) <= 0).any():
        raise ValueError("its times must rise for smoothing; sort the rows")
    weight = len(points) / np.ptp(times) * (period / (2 * np.pi)) ** 4
    smooth = make_smoothing_spline(times, places, lam=weight)(times)
    moved = np.sqrt(((smooth - places) ** 2).sum(axis=1).mean())
    INPUT_NOTES.info(f"{file}: smoothed over {period:g} s, positions move by {moved:.2g} m (RMS)")
    rows = zip(points, smooth.tolist(), strict=True)
    return [{**point, "position_m": position} for point, position in rows]


def _flight_table(city: Any, folder: Path, path: Path) -> dict[str, Any]:
    """Waypoints of a flight in world coordinates, or in those of the city's file: longitude and
    latitude, or a grid's metres from far beyond the world's origin."""
    turned, xyz, degrees = ("yaw_deg", "pitch_deg", "roll_deg"), ("x", "y", "z"), _DEGREES
    c = read_csv(path, ("time_s", *xyz), turned, ("time_s", *degrees))
    if len(c["time_s"]) > MAX_WAYPOINTS:
        raise ValueError(
            f"has {len(c['time_s'])} rows, a flight has at most {MAX_WAYPOINTS}; thin it out"
        )
    some = [name for name in turned if name in c]
    if some and turned[0] not in some:
        raise ValueError(f"has {' and '.join(some)} without {turned[0]}; add it")
    positions = np.column_stack([c[name] for name in (xyz if "x" in c else degrees)])
    if "x" not in c:
        positions = _from_degrees(positions, _georeference(city, folder))
    elif np.abs(np.median(positions[:, :2], axis=0)).max() > _GRID_M:
        positions = _from_grid(positions, _georeference(city, folder), city)
    out: list[dict[str, Any]] = [
        {"time_s": time, "position_m": position}
        for time, position in zip(c["time_s"], positions.tolist(), strict=True)
    ]
    for i, point in enumerate(out if some else ()):
        point["attitude_deg"] = [c[name][i] if name in c else 0.0 for name in turned]
    return {"waypoints": out}


def _georeference(city: Any, folder: Path) -> GeoReference | None:
    """Return where a scenario's city lies, by its tree."""
    from isac_rt.world.city.sources import city_georeference

    try:
        settings = None if city is None else City.model_validate(city)
    except ValidationError:  # told by whoever checks the scenario
        return None
    return None if settings is None else city_georeference(settings, folder)


def _from_degrees(positions: NDArray[np.float64], geo: GeoReference | None) -> NDArray[np.float64]:
    """Latitude, longitude [degrees] and height [m] to world coordinates."""
    if geo is None or not geo.crs:
        raise ValueError(
            "has latitude and longitude, and no map says where on Earth the world's origin lies; "
            "state x, y, z [m] from the origin, or city.crs with footprints"
        )
    if np.abs(positions[:, 0]).max() > 90:
        raise ValueError("has a latitude beyond 90 degrees; exchange lat and lon")
    return geo.from_degrees(positions[:, [1, 0, 2]])


def _from_grid(
    positions: NDArray[np.float64], geo: GeoReference | None, city: Any
) -> NDArray[np.float64]:
    """Metres of the grid of a city's file, such as UTM, to world coordinates; a city without an
    origin of its own lies in that grid too."""
    source = city.get("source") if isinstance(city, dict) else None
    if (geo is not None and geo.plane) or source in ("builtin", "canyon", "blocks"):
        where = "" if geo is None else f", {geo.words().removeprefix('world origin ')}"
        raise ValueError(
            f"lies {np.abs(positions[0, :2]).max():.0f} m from the world's origin{where}, as in "
            "UTM; state x, y, z [m] from the origin, or lat, lon, alt over a map"
        )
    return positions if geo is None else geo.to_world(positions)


def by_aspect(unit: str) -> Reader:
    """A grid of directions, in any order of rows; `unit`: name of the column of values."""

    def read(path: Path) -> dict[str, Any]:
        c = read_csv(path, ("azimuth_deg", "elevation_deg", unit))
        return {"table": _grid(c["azimuth_deg"], c["elevation_deg"], c[unit])}

    return read


def _grid(azimuth: list[float], elevation: list[float], column: list[float]) -> dict[str, Any]:
    """Return the table by aspect of rows in any order."""
    angles = list(zip(elevation, azimuth, strict=True))
    values = dict(zip(angles, column, strict=True))
    rows, columns = sorted({e for e, _ in angles}), sorted({a for _, a in angles})
    if len(values) != len(angles):
        raise ValueError("holds a direction twice")
    if len(values) != len(rows) * len(columns):
        raise ValueError(
            f"{len(values)} directions are no grid of {len(columns)} azimuths and {len(rows)} "
            "elevations; add those that are missing"
        )
    table = [[values[e, a] for a in columns] for e in rows]
    return {"azimuth_deg": columns, "elevation_deg": rows, "values_db": table}


def _centres(path: Path) -> dict[str, Any]:
    """Scattering centres: a row for each, or one for each direction of each."""
    at, aspect = ("right_m", "ahead_m", "up_m"), ("azimuth_deg", "elevation_deg")
    c = read_csv(path, (*at, "dbsm"), (*aspect, "phase_deg"))
    places: dict[tuple[float, ...], list[int]] = {}
    for row, place in enumerate(zip(*(c[name] for name in at), strict=True)):
        places.setdefault(place, []).append(row)
    out = []
    for place, rows in places.items():
        azimuth, elevation = (
            [c[name][row] if name in c else 0.0 for row in rows] for name in aspect
        )
        centre: dict[str, Any] = {"position_m": list(place)}
        for key, name in (("table", "dbsm"), ("phase_table", "phase_deg")):
            if name in c:
                centre[key] = _grid(azimuth, elevation, [c[name][row] for row in rows])
        out.append(centre)
    return {"centres": out}


def _pattern(path: Path) -> dict[str, Any]:
    pattern: dict[str, Any] = extension("antenna_pattern")(path)
    return pattern


def _solid(path: Path) -> dict[str, Any]:
    corners: dict[str, Any] = extension("corners_of_mesh")(path)
    return corners


def _tables_of(tree: dict[str, Any], folder: Path) -> Iterator[tuple[Key, str, Reader]]:
    """Mappings of a tree that may name a table, the key that does, and how it is read."""
    swarm = tree.get("swarm")
    uavs: list[Key] = [("swarm", name) for name in swarm] if isinstance(swarm, dict) else []
    for owner in [(), *uavs]:
        yield (*owner, "array", "tx"), "file", _places
        yield (*owner, "array", "rx"), "file", _places
        yield (*owner, "array"), "pattern_file", _pattern
    for _, name in uavs:
        uav = _at(tree, ("swarm", name))
        directed = isinstance(uav, dict) and uav.get("boresight", "velocity") != "velocity"
        yield ("swarm", name), "flight", partial(_flight, tree.get("city"), folder, directed)
        yield ("swarm", name, "rcs"), "file", by_aspect("dbsm")
        yield ("swarm", name, "extent"), "file", _centres
        yield ("swarm", name, "box"), "file", _solid


def with_tables(
    tree: dict[str, Any],
    folder: Path,
    *,
    replace: bool = False,
    faults: list[Problem] | None = None,
) -> dict[str, Any]:
    """A scenario's tree with the numbers of the files that it names in place of their names.

    What is malformed stays as it is, for whoever checks it. `replace`: numbers that stand beside
    the file give way, as those of a sweep's base do. `faults`: filled with what is wrong instead of
    raising it; such mappings stay as they are.

    Raises
    ------
    TableError  If a file is none, is not readable as a table, or numbers are stated beside it.
    """
    tree = _with_traffic(tree, folder, faults)
    out = _with_board(tree, folder, (), faults)
    swarm = out.get("swarm")
    for name, uav in swarm.items() if isinstance(swarm, dict) else ():
        if isinstance(uav, dict):
            own = _with_board(uav, folder, ("swarm", name), faults)
            if own is not uav:
                out = {**out, "swarm": {**out["swarm"], name: own}}
    for key, name, reader in _tables_of(tree, folder):
        here = _at(out, key)
        file = here.get(name) if isinstance(here, dict) else None
        if not isinstance(file, str):
            continue
        if out is tree:  # never in place
            out = copy.deepcopy(tree)
            here = _at(out, key)
        try:
            table = reader(folder / file)
            double = [k for k in table if here.get(k) is not None]
            if double and not replace:
                raise ValueError(f"stands beside {double[0]}; leave one of the two out")
        except ValueError as problem:
            if faults is None:
                raise TableError((*key, name), str(problem)) from None
            faults.append(Problem(((*key, name),), str(problem)))
            continue
        del here[name]
        here.update(table)
    return out


def _with_traffic(
    tree: dict[str, Any], folder: Path, faults: list[Problem] | None
) -> dict[str, Any]:
    """A tree with each vehicle of FILE#* in place of the UAV that names it so."""
    swarm, out = tree.get("swarm"), dict[str, Any]()
    swarm = swarm if isinstance(swarm, dict) else {}
    files = {
        name: uav["flight"].partition("#*")
        for name, uav in swarm.items()
        if isinstance(uav, dict) and "#*" in str(uav.get("flight"))
    }
    for name, uav in swarm.items():
        if name not in files:
            out[name] = uav
            continue
        head, _, start = files[name]
        try:
            frames, interval = tree.get("frames", 100), tree.get("frame_interval_s")
            if not all(isinstance(n, int | float) for n in (frames, interval)):
                raise ValueError("all vehicles of a file need frame_interval_s; state it")
            degrees = partial(_from_degrees, geo=_georeference(tree.get("city"), folder))
            about = folder / head, start, frames * interval, degrees
            found = extension("traffic")(uav, *about)
            vehicles = {f"{name}_{key}": vehicle for key, vehicle in found.items()}
            if twice := sorted(vehicles.keys() & {*swarm, *out}):
                raise ValueError(
                    f"{head} has a vehicle or person that is named swarm.{twice[0]}, which is "
                    f"stated too; rename one of swarm.{name} and swarm.{twice[0]}"
                )
            out.update(vehicles)
        except ValueError as problem:
            if faults is None:
                raise TableError(("swarm", name, "flight"), str(problem)) from None
            faults.append(Problem((("swarm", name, "flight"),), str(problem)))
            out[name] = {key: value for key, value in uav.items() if key != "flight"}
    return {**tree, "swarm": out} if files else tree


def _with_board(
    tree: dict[str, Any], folder: Path, at: Key, faults: list[Problem] | None
) -> dict[str, Any]:
    """A tree, or the terminal `at` which it stands, whose `sensor` names a board's configuration,
    with what that says under the keys that are stated."""
    file = tree.get("sensor")
    if not isinstance(file, str) or Path(file).suffix not in BOARD_FILES:
        return tree
    try:
        board = read_board(folder / file)
    except BoardFileError as problem:
        if faults is None:
            raise TableError((*at, "sensor"), str(problem)) from None
        faults.append(Problem(((*at, "sensor"),), str(problem)))
        return {key: value for key, value in tree.items() if key != "sensor"}
    out = completed(copy.deepcopy(tree), board.scenario())
    del out["sensor"]
    if not at:
        out.setdefault("frame_interval_s", board.period)
    return out


def _at(tree: Any, key: Key) -> Any:
    for part in key:
        tree = tree.get(part) if isinstance(tree, dict) else None
    return tree
