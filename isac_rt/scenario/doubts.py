"""Values that may stand but look as if they were in another unit: by a factor of a thousand for
most keys."""

from __future__ import annotations

from collections.abc import Iterator
from functools import reduce
from typing import Any

from isac_rt.scenario.node import Key, Problem

PLAUSIBLE: dict[Key, tuple[float, float, str]] = {
    ("radio", "carrier_hz"): (1e9, 1e12, "hertz"),
    ("radio", "bandwidth_hz"): (1e6, 1e11, "hertz"),
    ("radio", "sampling_rate_hz"): (2e5, 1e10, "hertz"),
    ("radio", "filter_transition_hz"): (5e3, 5e7, "hertz"),
    ("frame_interval_s",): (1e-5, 20.0, "seconds"),
    ("array", "spacing_wavelengths"): (0.05, 50.0, "wavelengths"),
    ("array", "element_gain_dbi"): (-60.0, 60.0, "dBi"),
    ("noise", "tx_power_dbm"): (-150.0, 100.0, "dBm"),
    ("noise", "noise_figure_db"): (-1.0, 60.0, "decibels"),
    ("noise", "temperature_k"): (1.0, 2e4, "kelvins"),
    ("noise", "snr_db"): (-150.0, 150.0, "decibels"),
    ("propagation", "leakage", "isolation_db"): (0.0, 300.0, "decibels"),
    ("propagation", "leakage", "delay_s"): (0.0, 1e-6, "seconds"),
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


def implausible(scenario: Any) -> Iterator[Problem]:
    """What of a scenario lies outside the plausible."""
    for key, (low, high, unit) in PLAUSIBLE.items():
        value = reduce(lambda at, name: getattr(at, str(name), None), key, scenario)
        if isinstance(value, int | float) and not low <= value <= high:
            yield Problem((key,), f"{value:g} is outside {low:g} to {high:g}; is it in {unit}?")
    if scenario.array.fall_back and not _can_fall_back(scenario):
        said = (
            "never acts: it needs the pseudo_random schedule and velocities from sparse "
            "sampling, by OMP"
        )
        yield Problem(
            (
                ("array", "fall_back"),
                ("array", "schedule"),
                ("radio", "groups"),
                ("receivers", "velocity_method"),
            ),
            said,
        )
    low, high = PLAUSIBLE_RCS
    for name, uav in scenario.swarm.items():
        if not low <= uav.rcs.value_dbsm <= high:
            said = (
                f"{uav.rcs.value_dbsm:g} is outside {low:g} to {high:g}; is it in decibels over "
                "a square metre?"
            )
            yield Problem((("swarm", name, "rcs", "value_dbsm"),), said)


def _can_fall_back(scenario: Any) -> bool:
    """Whether a receiver of this scenario ever judges sparsity: some have fewer groups than there
    are transmit antennas."""
    m = scenario.modulation
    partial = scenario.radio.groups < scenario.num_tx or any(
        len(groups) < scenario.num_tx for groups in m.streams.values()
    )
    return (
        scenario.array.schedule == "pseudo_random"
        and scenario.receivers.velocity_method == "auto"
        and partial
    )
