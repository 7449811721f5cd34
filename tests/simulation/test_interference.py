"""Plain radars that receive each other's chirps."""

from __future__ import annotations

import re
import warnings
from dataclasses import replace

import numpy as np
import pytest
from scipy.constants import Boltzmann, speed_of_light

import isac_rt as irt
from isac_rt.document import ScenarioWarning
from isac_rt.simulation.preflight import warn_of_interference
from isac_rt.world.city.mesh import empty_city

TWO = {
    "name": "two",
    "frames": 5,
    "frame_interval_s": 0.02,
    "sensor": "awr1843",
    "swarm": {
        "r1": {"role": "active", "position_m": [0, 0, 2], "boresight": [0, 1, 0]},
        "r2": {"role": "active", "position_m": [2, 60, 2], "boresight": [0, -1, 0]},
        "car": {"role": "target", "position_m": [1, 25, 2], "velocity_mps": [0, -7, 0]},
    },
    "propagation": {"model": "free_space"},
}


def doubts(**second: object) -> list[str]:
    swarm = TWO["swarm"] | {"r2": TWO["swarm"]["r2"] | second}
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        setup = irt.prepare(irt.load(TWO | {"swarm": swarm}))
    assert setup.waveform.sweep is not None
    return [str(one.message) for one in said if "arrive at" in str(one.message)]


def test_radars_that_face_each_other_are_doubted():
    """Power by Friis and the noise of a sample by hand, from the board's data. Seen to fail: the
    run said nothing and held no interference. Planted bugs: the gain of one end; the distance not
    squared."""
    (said,) = doubts()
    s = irt.load(TWO)
    noise, r = s.noise, s.radio
    gain = 10 ** (s.array.element_gain_dbi / 10)
    distance, wavelength = np.hypot(60, 2), speed_of_light / r.carrier_hz
    at_once = s.num_tx if r.bands(s.num_tx) > 1 else 1
    forward = (60 / distance) ** max(gain / 2 - 1, 0)
    assert s.array.element_pattern == "cosine"
    power = at_once * 1e-3 * 10 ** (noise.tx_power_dbm / 10) * (gain * forward) ** 2
    power *= (wavelength / (4 * np.pi * distance)) ** 2
    floor = Boltzmann * 290 * r.sampling_rate_hz * 10 ** (noise.noise_figure_db / 10)
    dbm, over = (float(x) for x in re.findall(r"(-?\d+\.\d) dB", said))
    assert dbm == pytest.approx(10 * np.log10(power / 1e-3), abs=0.06)
    assert over == pytest.approx(10 * np.log10(power / floor), abs=0.06)


@pytest.mark.parametrize(
    "second",
    [{"boresight": [0, 1, 0]}, {"position_m": [2, 900, 2]}, {"role": "target", "boresight": None}],
    ids=["back", "far", "one"],
)
def test_radars_that_do_not_receive_each_other_are_not(second: dict[str, object]):
    """Planted bugs: patterns left out; a path under the noise."""
    if second.get("boresight", 0) is None:
        second = {"role": "target"}
    assert doubts(**second) == []


def test_a_wall_between_radars_keeps_them_apart():
    """Planted bug: the city left out."""
    s = irt.load(TWO)
    with pytest.warns(ScenarioWarning):
        setup = irt.prepare(s)
    corners = np.array([[-9.0, 30, -9], [9, 30, -9], [9, 30, 9], [-9, 30, 9]])
    wall = replace(
        empty_city("wall", np.zeros(3)),
        vertices=corners,
        faces=np.array([[0, 1, 2], [0, 2, 3]], np.int32),
        face_material=np.zeros(2, np.int16),
    )
    given = setup.swarm, setup.timetable, setup.arrays
    budget = setup.plan.amplitudes, setup.noise_power
    with pytest.warns(ScenarioWarning, match="arrive at"):
        warn_of_interference(*given, empty_city("none", np.zeros(3)), budget)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        warn_of_interference(*given, wall, budget)
