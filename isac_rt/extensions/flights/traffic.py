"""Traffic from floating-car data of SUMO: every vehicle and person of a file as an object of its
own.

SUMO states the middle of the front bumper on the road and the course, clockwise from north; the box
of a vehicle of length L has its middle L/2 behind it, half its height up.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from isac_rt.extensions.flights.logs import FloatingCars, floating_cars
from isac_rt.scenario.tables import INPUT_NOTES, number

MOST_VEHICLES = 200
STEPS_BESIDE = 3
"""Steps of the file before and after the run that are kept, for the spline's slopes."""
CAR_M = (1.8, 5.0, 1.5)
"""Width, length and height of SUMO's passenger car [m]."""
HIPS_M = 0.93
"""Height of the hips of a pedestrian of 1.75 m [m]."""
PERSON: Mapping[str, Any] = {
    "box": None,
    "extent": {"kind": "pedestrian"},
    "rcs": {"model": "constant", "value_dbsm": -1.37, "fluctuation_db": 3.94},
}
"""Person, of the cross-section of TR 38.901 (v19) with its random component, in place of what is
stated for vehicles."""
ToWorld = Callable[[NDArray[np.float64]], NDArray[np.float64]]


def traffic(
    stated: Mapping[str, Any], file: Path, start: str, duration: float, from_degrees: ToWorld
) -> dict[str, dict[str, Any]]:
    """Return the vehicles and persons of FILE#*@START that move during a run, by name.

    Parameters
    ----------
    stated : plain values of the UAV that all are
    start : empty, or @START [s]
    duration : of the run [s]
    from_degrees : turns latitude, longitude [degrees] and height [m] into world coordinates

    Raises
    ------
    ValueError  If the file cannot be used.
    """
    try:
        cars = floating_cars(file, "*")
    except OSError as problem:
        raise ValueError(f"cannot be read: {problem.strerror}") from None
    if start and start[0] != "@":
        raise ValueError(f"#*{start} is not #*@START, START the time in the file [s]")
    begin = number(start[1:], 1, "START") if start else 0.0
    reach = STEPS_BESIDE * cars.step
    out: dict[str, dict[str, Any]] = {}
    for name, rows in cars.rows.items():
        times = rows[:, 0] - begin
        held = (times >= -reach) & (times <= duration + reach)
        if (held & (times >= 0) & (times <= duration)).any() and held.sum() >= 2:
            key = re.sub("[^A-Za-z0-9_-]", "_", name)
            while key in out:
                key += "_"
            row = np.column_stack([times, rows[:, 1:]])[held]
            out[key] = _vehicle(stated, cars, name, row, from_degrees)
    if not 0 < len(out) <= MOST_VEHICLES:
        raise ValueError(
            f"{len(out)} of {len(cars.rows)} vehicles and persons move in the {duration:g} s from "
            f"START, 1 to {MOST_VEHICLES} are taken; take another START, or thin the file out"
        )
    INPUT_NOTES.info(f"{file.name}: {len(out)} of {len(cars.rows)} vehicles and persons")
    return out


def _vehicle(
    stated: Mapping[str, Any],
    cars: FloatingCars,
    name: str,
    rows: NDArray[np.float64],
    from_degrees: ToWorld,
) -> dict[str, Any]:
    """Return one vehicle as plain values, from rows of time, x, y, z, course and slope."""
    out = {key: value for key, value in stated.items() if key != "flight"}
    places = np.nan_to_num(rows[:, 1:4])
    if cars.on_earth:
        places = from_degrees(places[:, [1, 0, 2]])
        places[np.isnan(rows[:, 3]), 2] = 0.0
    if np.isnan(rows[:, 4]).any():
        raise ValueError(f"{name} has no angle, which says where it heads; have SUMO write it")
    course, slope = rows[:, 4], np.nan_to_num(rows[:, 5])
    if name in cars.persons:
        out |= PERSON
        places[:, 2] += HIPS_M
    else:
        box, extent = stated.get("box") or {}, stated.get("extent") or {}
        size = cars.sizes.get(name) or box.get("size_m") or CAR_M
        if box:
            out["box"] = {**box, "size_m": list(size)}
        if extent.get("kind") == "vehicle":
            out["extent"] = {"size_m": list(size), **extent}
        turn = np.radians(course)
        places[:, :2] -= size[1] / 2 * np.column_stack([np.sin(turn), np.cos(turn)])
        places[:, 2] += size[2] / 2
    out["waypoints"] = [
        {"time_s": time, "position_m": place, "attitude_deg": [angle, pitch, 0.0]}
        for time, place, angle, pitch in zip(
            rows[:, 0].tolist(), places.tolist(), course.tolist(), slope.tolist(), strict=True
        )
    ]
    return out
