"""Fields of view by explicit angles: of an array, of both ends of a link, and of what is warned
of."""

from __future__ import annotations

import warnings
from dataclasses import replace
from itertools import product

import numpy as np
import pytest

from isac_rt.document import ScenarioWarning
from isac_rt.frame.antennas import Antennas, Arrays, antennas_of, azimuth_elevation, unit_vector
from isac_rt.frame.link import Link
from isac_rt.frame.settings import Array
from isac_rt.frame.waveform import Waveform
from isac_rt.propagation.settings import Propagation
from isac_rt.results.metrics import within_view
from isac_rt.scenario.radio import Radio
from isac_rt.scenario.swarm import Uav
from isac_rt.scenario.tree import Scenario
from isac_rt.simulation.setup import prepare
from isac_rt.world.swarm import Pose

HALF = 50.0
ANTENNAS = Antennas(
    tx_x=2, tx_z=2, rx_x=4, rx_z=4, spacing=1e-3, gain=3.0, half_view=np.deg2rad(HALF)
)


def towards(azimuth: float, elevation: float) -> np.ndarray:
    """Body axes: azimuth from ahead to the right, elevation from the horizon up [degrees]."""
    a, e = np.deg2rad([azimuth, elevation])
    return np.array([np.cos(e) * np.sin(a), np.cos(e) * np.cos(a), np.sin(e)])


@pytest.mark.parametrize(
    ("azimuth", "elevation", "seen"),
    [
        (0, 0, True),
        (49.9, 0, True),
        (50.1, 0, False),
        (-49.9, 0, True),
        (-50.1, 0, False),
        (0, 49.9, True),
        (0, 50.1, False),
        (0, -49.9, True),
        (0, -50.1, False),
        (130.1, 0, False),
        (180, 0, False),
        (180, 49.9, False),
        # 45 degrees up, 60 degrees aside are 38 off the plane across the arm along X
        (60, 45, True),
        (50.1, 50.1, False),
    ],
)
def test_an_array_sees_so_far_on_each_arm(azimuth, elevation, seen):
    """The cone about each arm: |cos(e) sin(a)| and |sin(e)| within the sine of 50 degrees, ahead.
    Planted bugs: the arm along Z forgotten; what lies behind seen as well."""
    u = towards(azimuth, elevation)
    assert bool(ANTENNAS.in_view(u)) is seen
    sector = replace(ANTENNAS, pattern="sector")
    assert sector.element_gain(u) == (3.0 if seen else 0.0)
    every = np.stack([u, towards(0, 0)])
    assert ANTENNAS.in_view(every).tolist() == [seen, True]


def test_a_view_of_more_than_a_half_space_is_a_half_space():
    """Planted bug: the sine of 100 degrees taken, as far as that of 80."""
    wide = replace(ANTENNAS, half_view=np.deg2rad(100))
    assert wide.in_view(towards(88, 0)) and not wide.in_view(towards(92, 0))


def test_the_scenarios_view_is_the_whole_angle_and_its_gain_in_decibels():
    """90 degrees are 45 to either side; 6.02 dBi are four times the power; elements half a
    wavelength apart. Planted bugs: the whole angle to either side; decibels of amplitude."""
    w = Waveform()
    a = antennas_of(
        Array(field_of_view_deg=90, element_gain_dbi=6.0206, spacing_wavelengths=0.5), w
    )
    assert a.in_view(towards(44.9, 0)) and not a.in_view(towards(45.1, 0))
    assert a.gain == pytest.approx(4.0, rel=1e-5)
    assert a.spacing == pytest.approx(0.5 * 299_792_458 / w.carrier_frequency, rel=1e-12)


def test_a_cosine_pattern_falls_to_its_side_and_is_silent_behind():
    """Gain 6 ahead and 6 cos^2 off boresight, q = 6/2 - 1; nothing backwards, where an even power
    would be positive; a gain below 2 has no negative power. Planted bug: the back lobe left in."""
    a = replace(ANTENNAS, gain=6.0, pattern="cosine")
    for angle in (0, 30, 60, 89, 91, 120, 180):
        expected = 6 * max(np.cos(np.deg2rad(angle)), 0) ** 2
        assert a.element_gain(towards(angle, 0)) == pytest.approx(expected, abs=1e-12)
    low = replace(a, gain=1.5)
    assert low.element_gain(towards(75, 0)) == pytest.approx(1.5)
    assert low.element_gain(towards(105, 0)) == 0


def test_angles_of_cosines_and_back():
    """Azimuth and elevation of directions made from angles; outside the unit disc there are none.
    Planted bug: the azimuth as if the elevation were zero."""
    for azimuth, elevation in product((-70, -13, 0, 42), (-61, 0, 5, 38)):
        u = towards(azimuth, elevation)
        found = np.degrees(azimuth_elevation(u[[0, 2]]))
        assert found == pytest.approx([azimuth, elevation], abs=1e-9)
        assert unit_vector(u[[0, 2]]) == pytest.approx(u, abs=1e-12)
    assert np.isnan(azimuth_elevation(np.array([0.8, 0.7]))).all()
    assert unit_vector(np.array([0.8, 0.7])).tolist() == [0.8, 0.0, 0.7]


PLACES = {"own": (0.0, 0.0, 30.0), "active": (40.0, 0.0, 30.0), "body": (20.0, 30.0, 30.0)}
LOOKS = {
    # directions in which an end looks, and whom it sees then (north is +Y, 50 degrees to each side)
    "own": {"north": {"body"}, "east": {"active"}, "north-east": {"body", "active"}, "west": set()},
    "active": {"north": {"body"}, "west": {"own"}, "north-west": {"body", "own"}, "east": set()},
}
COMPASS = {
    "north": (0, 1, 0),
    "east": (1, 0, 0),
    "west": (-1, 0, 0),
    "north-east": (1, 1, 0),
    "north-west": (-1, 1, 0),
}


@pytest.mark.parametrize(("own", "active"), list(product(LOOKS["own"], LOOKS["active"])))
def test_a_body_is_in_view_of_both_ends(own, active):
    """A reflector must be seen by the receiver and by the transmitter, the transmitter by the
    receiver and the other way round, an active terminal's echo by itself alone. A triangle of 56
    degrees at its base. Planted bugs: the transmitter's view forgotten; for its own line of sight;
    the receiver's forgotten."""
    poses = {
        "own": Pose.at_rest(PLACES["own"], COMPASS[own]),
        "active": Pose.at_rest(PLACES["active"], COMPASS[active]),
        "body": Pose.at_rest(PLACES["body"]),
    }
    by_own, by_active = LOOKS["own"][own], LOOKS["active"][active]

    def within(receiver: str, body: str) -> bool:
        return within_view(Arrays(ANTENNAS), Link("active", receiver), poses, body)

    assert within("own", "body") is ("body" in by_own and "body" in by_active)
    assert within("own", "active") is ("active" in by_own and "own" in by_active)
    assert within("active", "body") is ("body" in by_active)
    assert within("active", "own") is ("own" in by_active)


def warned(a_looks, p_looks) -> set[str]:
    """Whose speed a scenario is warned of: all close in on A, which rests, at 130 m/s; the
    limits are half of that for an echo and less than it for a line of sight."""
    swarm = {
        "A": Uav(role="active", position_m=(0, 0, 50), boresight=a_looks),
        "P": Uav(
            role="passive", position_m=(0, 40, 50), velocity_mps=(0, -130, 0), boresight=p_looks
        ),
        "T": Uav(role="target", position_m=(0, 60, 50), velocity_mps=(0, -130, 0)),
    }
    scenario = Scenario(
        name="fast",
        frames=4,
        radio=Radio(samples_per_chirp=256),
        array=Array(field_of_view_deg=100),
        propagation=Propagation(leakage={"enabled": False}),
        swarm=swarm,
    )
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always", ScenarioWarning)
        prepare(scenario)
    return {str(w.message).partition(" moves")[0] for w in said if "moves at" in str(w.message)}


@pytest.mark.parametrize(
    ("a_looks", "p_looks", "expected"),
    [
        ((0, 1, 0), (0, -1, 0), {"the echo of P at A", "the echo of T at A", "P from A"}),
        ((0, 1, 0), (0, 1, 0), {"the echo of P at A", "the echo of T at A"}),
        ((0, -1, 0), (0, -1, 0), set()),
        ((1, 0, 0), (0, -1, 0), set()),
    ],
)
def test_only_what_is_in_view_is_warned_of(a_looks, p_looks, expected):
    """Echoes that the active terminal looks at, and a line of sight that both ends look along.
    Planted bugs: the other end's view forgotten; nobody's view asked."""
    assert warned(a_looks, p_looks) == expected
