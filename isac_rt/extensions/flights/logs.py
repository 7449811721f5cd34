"""Flights from logs: PX4's ULog, bags of ROS 2 and floating-car data of SUMO."""

from __future__ import annotations

import math
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any
from xml.parsers import expat

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation, Slerp

from isac_rt.runtime import needed, shortly
from isac_rt.scenario.tables import MAX_WAYPOINTS, number

KEPT_BEFORE_S = 1.0
"""Part of a log that is kept before the run's start, for the spline's slope there [s]."""
_ATTITUDE = "vehicle_attitude"
_LOCAL, _GLOBAL = "vehicle_local_position", "vehicle_global_position"
_VALID = ("xy_valid", "z_valid", "lat_lon_valid", "alt_valid")
_FIX, _ODOMETRY = "sensor_msgs/msg/NavSatFix", "nav_msgs/msg/Odometry"
_TYPES = (_ODOMETRY, "geometry_msgs/msg/PoseStamped", _FIX)


@dataclass(frozen=True)
class FlightLog:
    """Times (N,) [s] and positions (N, 3) of one UAV or object: east, north, up [m], or latitude,
    longitude [degrees] and height [m]. `note` says what was taken. `attitudes` (N, 3): yaw, pitch
    and roll [degrees], None where the log states none."""

    note: str
    times: NDArray[np.float64]
    positions: NDArray[np.float64]
    in_degrees: bool
    without_height: bool = False
    attitudes: NDArray[np.float64] | None = None


def flight_log(path: Path) -> FlightLog | None:
    """Read FILE, FILE#PART or FILE#PART@START, with which the run begins START seconds after the
    log, or raise ValueError; None: it is no log."""
    file, part, begin = path, "", 0.0
    if not os.path.exists(path) and "#" in str(path):
        head, _, tail = str(path).rpartition("#")
        part, _, start = tail.partition("@")
        file, begin = Path(head), number(start, 1, "START") if start else 0.0
    is_bag = os.path.isfile(file / "metadata.yaml")
    read = _bag if is_bag else _READERS.get(file.suffix.lower())
    if read is None or not (is_bag or os.path.isfile(file)):
        return None
    try:
        log = read(file, part)
    except (ValueError, ImportError):
        raise
    except Exception as problem:  # libraries raise all kinds for damaged files
        raise ValueError(f"is damaged or of another kind: {shortly(problem)}") from problem
    return _thinned(replace(log, times=log.times - begin), file.name)


def _thinned(log: FlightLog, file: str) -> FlightLog:
    """Return a log of valid positions whose times rise, at most `MAX_WAYPOINTS`."""
    before = np.maximum.accumulate(np.append(-math.inf, log.times))[:-1]
    valid = np.isfinite(log.positions).all(axis=1) & (log.times >= -KEPT_BEFORE_S)
    held = np.flatnonzero((log.times > before) & valid)
    if held.size < 2:
        said = f"{log.note}: {held.size} of {valid.size} positions are valid and after the start"
        raise ValueError(f"{said}, 2 are needed; take another part or START")
    step = math.ceil(held.size / MAX_WAYPOINTS)
    note = f"{file}: {log.note}, {held.size} positions, {np.ptp(log.times[held]):.1f} s"
    note += f", one of {step} is taken" if step > 1 else ""
    held = held[::step]
    attitudes = log.attitudes
    if attitudes is not None:
        note, attitudes = f"{note}, with attitudes", attitudes[held]
    times, positions = log.times[held], log.positions[held]
    return replace(log, note=note, times=times, positions=positions, attitudes=attitudes)


def _choose(part: str, parts: Sequence[str], kind: str) -> str:
    """Return the part of a log that is asked for, or its only one."""
    if part in parts or (not part and len(parts) == 1):
        return part or parts[0]
    named = ", ".join(sorted(parts))[:200]
    raise ValueError(
        f"name a {kind} as FILE#NAME; there are {len(parts)}{': ' * bool(parts)}{named}"
    )


def _angles(quaternions: NDArray[np.float64], at: Any = None, to: Any = None) -> Any:
    """Return yaw, pitch and roll [degrees] (M, 3), intrinsic about z, y and x, of quaternions
    (N, 4) x, y, z, w at times `at`, interpolated to times `to`; None where they are not set or all
    the identity that writers leave."""
    norm = np.linalg.norm(quaternions, axis=1)
    unset = (quaternions[:, :3] == 0).all()
    if norm.size < 2 or unset or not (np.isfinite(norm) & (norm > 0)).all():
        return None
    turned = Rotation.from_quat(quaternions)
    if at is not None:
        at, first = np.unique(at, return_index=True)
        turned = Slerp(at, turned[first])(np.clip(to, at[0], at[-1]))
    return turned.as_euler("ZYX", degrees=True)


def _ulog(file: Path, part: str) -> FlightLog:
    """Read the positions of a ULog: local ones are north, east and down from where the autopilot
    began; and its attitudes, which turn nose, right and down into these."""
    log = needed("pyulog", "flights").ULog(str(file), [_LOCAL, _GLOBAL, _ATTITUDE])
    data: dict[str, Mapping[str, Any]] = {d.name: d.data for d in log.data_list if d.multi_id == 0}
    attitude = data.pop(_ATTITUDE, None)
    name = _choose(part, list(data), "message with positions")
    c = data[name]
    valid = np.all([c[flag] > 0 for flag in _VALID if flag in c] or [[True]], axis=0)
    stamp, angles = _stamps(c), None
    if attitude is not None:
        q = np.column_stack([attitude[f"q[{k}]"].astype(float) for k in (1, 2, 3, 0)])
        angles = _angles(q, _stamps(attitude), stamp)
    keys = ("lat", "lon", "alt") if name == _GLOBAL else ("y", "x", "z")
    positions = np.column_stack([c[key].astype(float) for key in keys])
    positions[:, 2] *= 1 if name == _GLOBAL else -1
    positions[~np.broadcast_to(valid, stamp.shape)] = np.nan
    times = (stamp - stamp[0]) * 1e-6
    return FlightLog(name, times, positions, name == _GLOBAL, attitudes=angles)


def _stamps(message: Mapping[str, Any]) -> NDArray[np.int64]:
    """Return when a message of a ULog holds [us]."""
    key = "timestamp_sample" if "timestamp_sample" in message else "timestamp"
    return np.asarray(message[key].astype(np.int64))


def _bag(file: Path, part: str) -> FlightLog:
    """Read a topic of a bag of ROS 2. Times are those of the headers, from the first of all topics
    with positions; axes are east, north and up, a quaternion turns ahead, left and up into them
    (REP 103)."""
    needed("rosbags", "flights")
    from rosbags.rosbag2 import Reader
    from rosbags.typesys import Stores, get_typestore

    store = get_typestore(Stores.ROS2_HUMBLE)  # types that a bag defines would become code
    stamps, positions, quaternions, first = [], [], [], math.inf
    with Reader(file) as bag:
        placed = [c for c in bag.connections if c.msgtype in _TYPES]
        kinds = {c.topic: c.msgtype for c in placed}
        topic = _choose(part, list(kinds), "topic of Odometry, PoseStamped or NavSatFix")
        for connection, _, raw in bag.messages(connections=placed):
            message: Any = store.deserialize_cdr(raw, connection.msgtype)
            stamp = message.header.stamp.sec * 10**9 + message.header.stamp.nanosec
            first = min(first, stamp)
            if connection.topic != topic:
                continue
            stamps.append(stamp)
            if connection.msgtype == _FIX:
                valid = 1.0 if message.status.status >= 0 else math.nan
                p = message.latitude * valid, message.longitude, message.altitude
            else:
                pose = message.pose.pose if connection.msgtype == _ODOMETRY else message.pose
                p = pose.position.x, pose.position.y, pose.position.z
                q = pose.orientation
                quaternions.append((q.x, q.y, q.z, q.w))
            positions.append(p)
    times = np.array([stamp - first for stamp in stamps]) * 1e-9
    angles = _angles(np.reshape(quaternions, (-1, 4)))
    if angles is not None:  # yaw counts from east to the left, pitch downwards
        angles = angles * [-1, -1, 1] + [90, 0, 0]
    places = np.reshape(positions, (-1, 3))
    return FlightLog(topic, times, places, kinds[topic] == _FIX, attitudes=angles)


@dataclass(frozen=True)
class FloatingCars:
    """Vehicles and persons of a file of SUMO.

    Attributes
    ----------
    rows : time since the file's first step [s], x, y, z, course and slope [degrees] of each
        (N, 6), NaN where there is none
    ids, persons : of all, and of those that are persons
    sizes : width, length and height [m] of those of which the file has them
    step : of the file [s]
    on_earth : x is longitude, y latitude
    """

    rows: dict[str, NDArray[np.float64]]
    ids: frozenset[str]
    persons: frozenset[str]
    sizes: dict[str, tuple[float, float, float]]
    step: float
    on_earth: bool


def floating_cars(file: Path, part: str) -> FloatingCars:
    """Read a vehicle or person of floating-car data, or all that ride in no vehicle (*).

    Places are x, y [m] of the net, or longitude and latitude where the file's first comment tells
    of --fcd-output.geo; sizes are attributes of vehicles or of their `vType`. A document type is
    refused: its entities might grow without end."""
    parser = expat.ParserCreate()
    ids: dict[str, str] = {}
    types: dict[str, str] = {}
    sizes: dict[str, tuple[float, float, float]] = {}
    steps: list[float] = []
    rows: dict[str, list[tuple[float, ...]]] = {}
    on_earth: list[bool] = []
    within: list[str] = []

    def doctype(*_: Any) -> None:
        raise ValueError(f"line {parser.CurrentLineNumber}: a <!DOCTYPE> is not read; remove it")

    def start(tag: str, of: Mapping[str, str]) -> None:
        def value(key: str, otherwise: float | None = None) -> float:
            if otherwise is not None and key not in of:
                return otherwise
            return number(of.get(key, ""), parser.CurrentLineNumber, key)

        name, rides = of.get("id", ""), tag == "person" and "vehicle" in within
        within.append(tag)
        if tag == "timestep":
            steps.append(value("time"))
        elif tag in ("vehicle", "person") and steps and not (rides and part == "*"):
            ids[name], types[name] = tag, of.get("type", "")
            if part in ("", "*", name):
                place = value("x"), value("y"), value("z", math.nan)
                turn = value("angle", math.nan), value("slope", math.nan)
                rows.setdefault(name, []).append((steps[-1] - steps[0], *place, *turn))
        if tag in ("vehicle", "vType") and {"width", "length", "height"} <= of.keys():
            sizes[f"{tag} {name}"] = value("width"), value("length"), value("height")

    parser.StartDoctypeDeclHandler = doctype
    parser.StartElementHandler = start
    parser.EndElementHandler = lambda _: within.pop()
    parser.CommentHandler = lambda text: on_earth.append('fcd-output.geo value="true"' in text)
    try:
        with file.open("rb") as opened:
            parser.ParseFile(opened)
    except expat.ExpatError as problem:
        raise ValueError(f"{problem}; run SUMO again") from None
    stated = {
        name: sizes.get(f"vehicle {name}") or sizes.get(f"vType {types[name]}") for name in ids
    }
    return FloatingCars(
        {name: np.array(of_one) for name, of_one in rows.items()},
        frozenset(ids),
        frozenset(name for name, tag in ids.items() if tag == "person"),
        {name: size for name, size in stated.items() if size},
        float(np.median(np.diff(steps))) if len(steps) > 1 else 0.0,
        any(on_earth),
    )


def _sumo(file: Path, part: str) -> FlightLog:
    """Read a vehicle or person of floating-car data."""
    cars = floating_cars(file, part)
    name = _choose(part, list(cars.ids), "vehicle")
    c = cars.rows[name]
    positions = np.nan_to_num(c[:, [2, 1, 3] if cars.on_earth else [1, 2, 3]])
    return FlightLog(name, c[:, 0], positions, cars.on_earth, bool(np.isnan(c[:, 3]).any()))


_READERS = {".ulg": _ulog, ".xml": _sumo, ".db3": _bag, ".mcap": _bag, ".bag": _bag}
