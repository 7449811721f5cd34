"""Doubts about a scenario: values that look as if they were in another unit (by a factor of a
thousand for most keys), and settings that have no effect."""

from __future__ import annotations

import math
from collections.abc import Iterator
from itertools import combinations, pairwise
from statistics import median

from isac_rt.scenario.tree import Scenario
from isac_rt.settings import Key, Problem

PLAUSIBLE: dict[Key, tuple[float, float, str]] = {
    ("radio", "carrier_hz"): (1e9, 1e12, "hertz"),
    ("radio", "bandwidth_hz"): (1e6, 1e11, "hertz"),
    ("radio", "sampling_rate_hz"): (2e5, 1e10, "hertz"),
    ("frame_interval_s",): (1e-5, 20.0, "seconds"),
    ("array", "spacing_wavelengths"): (0.05, 50.0, "wavelengths"),
    ("array", "element_gain_dbi"): (-60.0, 60.0, "dBi"),
    ("noise", "tx_power_dbm"): (-150.0, 100.0, "dBm"),
    ("noise", "noise_figure_db"): (-1.0, 60.0, "decibels"),
    ("noise", "snr_db"): (-150.0, 150.0, "decibels"),
    ("propagation", "leakage", "isolation_db"): (0.0, 300.0, "decibels"),
    ("propagation", "weakest_path_db"): (0.0, 400.0, "decibels"),
    ("receivers", "min_range_m"): (0.0, 2e3, "metres"),
    ("tracking", "acceleration_std_mps2"): (1e-3, 500.0, "m/s^2"),
    ("city", "street_width_m"): (0.5, 1e3, "metres"),
    ("city", "street_length_m"): (1.0, 1e5, "metres"),
    ("city", "building_height_m"): (0.5, 1.5e3, "metres"),
    ("city", "block_size_m"): (0.5, 5e3, "metres"),
    ("city", "default_height_m"): (0.5, 1.5e3, "metres"),
    ("city", "keep_radius_m"): (2.0, 2e5, "metres"),
}
"""Least and greatest value that raises no doubt, and the unit of the key."""
PLAUSIBLE_RCS = (-90.0, 70.0)
FASTEST_MPS = 200.0
FARTHEST_M = 1e5


def doubts(scenario: Scenario) -> Iterator[Problem]:
    """List what a person should be asked about a scenario, equal doubts as one."""
    by_doubt: dict[str, list[Key]] = {}
    for doubt in (*_doubts_of_keys(scenario), *_doubts_of_flights(scenario)):
        by_doubt.setdefault(doubt.text, []).extend(doubt.keys)
    for text, keys in by_doubt.items():
        others = list(dict.fromkeys(str(key[1]) for key in keys if key[0] == "swarm"))[1:]
        likewise = f" (likewise {', '.join(others)})" if others else ""
        yield Problem(tuple(keys), text + likewise)


def _doubts_of_keys(scenario: Scenario) -> Iterator[Problem]:
    for part in scenario.by_chirp():
        for (a, first), (b, second) in combinations(part.first_blocks().items(), 2):
            if abs(first - second) < part.radio.groups:
                message = f"{b} and {a} send in the same resource blocks; shall they collide?"
                yield Problem((("swarm", b, "resource_block"),), message)
    for key, (low, high, unit) in PLAUSIBLE.items():
        value: object = scenario
        for name in key:
            value = getattr(value, str(name), None)
        if isinstance(value, int | float) and not low <= value <= high:
            yield Problem((key,), f"{value:g} is outside {low:g} to {high:g}; is it in {unit}?")
    if scenario.array.fall_back and not _can_fall_back(scenario):
        yield Problem(
            (
                ("array", "fall_back"),
                ("array", "schedule"),
                ("radio", "groups"),
                ("receivers", "velocity_method"),
            ),
            "never acts: it needs the pseudo_random schedule and velocities from sparse sampling, "
            "by OMP",
        )


def _doubts_of_flights(scenario: Scenario) -> Iterator[Problem]:
    """List the doubts about each UAV: its RCS, its fastest segment, its farthest waypoint."""
    low, high = PLAUSIBLE_RCS
    centre, what = (0.0, 0.0, 0.0), "the origin"
    if scenario.city is not None and scenario.city.file is not None:
        # a map may have any origin, and the swarm is over it
        centre, what = _middle(scenario), "the middle of the swarm"
    for name, uav in scenario.swarm.items():
        if not low <= uav.rcs.value_dbsm <= high:
            yield Problem(
                (("swarm", name, "rcs", "value_dbsm"),),
                f"{uav.rcs.value_dbsm:g} is outside {low:g} to {high:g}; is it in decibels over a "
                "square metre?",
            )
        speeds: dict[Key, float] = {}
        distances: dict[Key, float] = {}
        if uav.waypoints is None:
            speeds["swarm", name, "velocity_mps"] = math.hypot(*uav.velocity_mps)
            distances["swarm", name, "position_m"] = math.dist(uav.position_at(0.0), centre)
        else:
            for i, (a, b) in enumerate(pairwise(uav.waypoints), start=1):
                speed = math.dist(a.position_m, b.position_m) / (b.time_s - a.time_s)
                speeds["swarm", name, "waypoints", i] = speed
            for i, w in enumerate(uav.waypoints):
                distance = math.dist(w.position_m, centre)
                distances["swarm", name, "waypoints", i, "position_m"] = distance
        for values, most, message, units in (
            (speeds, FASTEST_MPS, "flies at {:.4g} m/s", "metres and seconds"),
            (distances, FARTHEST_M, f"lies {{:.4g}} m from {what}", "metres"),
        ):
            exceeding = {key: value for key, value in values.items() if value > most}
            if not exceeding:
                continue
            worst = max(exceeding, key=exceeding.__getitem__)
            count = f", and above it {len(exceeding)} times" if len(exceeding) > 1 else ""
            yield Problem(
                (worst,),
                f"{message.format(values[worst])}, more than {most:g}{count}; is it in {units}?",
            )


def _middle(scenario: Scenario) -> tuple[float, float, float]:
    """The median of the places at which the swarm starts. [m]"""
    x, y, z = (
        median(axis)
        for axis in zip(*(uav.position_at(0.0) for uav in scenario.swarm.values()), strict=True)
    )
    return x, y, z


def _can_fall_back(scenario: Scenario) -> bool:
    """Return whether a receiver of this scenario ever tests sparsity: some have fewer groups than
    there are transmit antennas."""
    m = scenario.modulation
    partial = scenario.radio.groups < scenario.num_tx or any(
        len(groups) < scenario.num_tx for groups in m.streams.values()
    )
    return (
        scenario.array.schedule == "pseudo_random"
        and scenario.receivers.velocity_method == "auto"
        and partial
    )
