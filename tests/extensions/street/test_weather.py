"""Air and rain: published series of Mie, the integral over the volume, and what a run makes of
them; tests/truths/street.py has the tables of ITU-R."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from truths.street import rain_of, rainy

from isac_rt import runtime
from isac_rt.document import ScenarioError
from isac_rt.extensions.street.air import gas_db_per_km, rain_coefficients
from isac_rt.extensions.street.drops import (
    DIAMETERS_MM,
    Drops,
    fall_speed,
    mie_amplitudes,
    mie_coefficients,
    permittivity,
)
from isac_rt.frame.antennas import Antennas
from isac_rt.frame.link import Link
from isac_rt.frame.waveform import SPEED_OF_LIGHT, Waveform
from isac_rt.propagation.pathset import PathKind
from isac_rt.propagation.settings import Weather
from isac_rt.scenario.file import load
from isac_rt.simulation.audit import make_plan
from isac_rt.simulation.setup import prepare
from isac_rt.simulation.simulate import run
from isac_rt.world.swarm import Pose

SCENE = Path(__file__).parents[3] / "scenes" / "rain.yaml"
WAVEFORM = Waveform()
F_C = WAVEFORM.effective_carrier
RAIN = 10.0


FEW = "isac_rt.extensions.street.weather.MOST_SCATTERERS"
"""Fewer of them where a test asks for no statistics."""


def efficiencies(size: float, index: complex) -> np.ndarray:
    """Extinction, scattering and backscattering over the sphere's disc."""
    a, b = mie_coefficients(size, index)
    weight = 2 * np.arange(1, a.size + 1) + 1
    back = mie_amplitudes(a, b, np.array([-1.0]))[0, 0]
    sums = (weight * (a + b).real).sum(), (weight * (abs(a) ** 2 + abs(b) ** 2)).sum()
    return np.array([2 * sums[0], 2 * sums[1], 4 * abs(back) ** 2]) / size**2


@pytest.mark.parametrize(
    ("size", "index", "published"),
    [
        (2 * np.pi * 0.525 / 0.6328, 1.55, (3.10543, 3.10543, 2.92534)),  # Bohren and Huffman, A
        (1.0, 1.5 + 1j, (2.336321, 0.663454, np.nan)),  # Wiscombe's cases
        (100.0, 1.5 + 1j, (2.097502, 1.283697, np.nan)),
    ],
)
def test_spheres_scatter_as_published_tables_say(size, index, published):
    """Planted bug: no factor m before psi's derivative in b_n."""
    found = efficiencies(size, index)
    known = np.isfinite(published)
    assert found[known] == pytest.approx(np.array(published)[known], rel=2e-6, abs=0)


def test_small_drops_obey_rayleighs_law_and_all_obey_the_optical_theorem():
    """Rayleigh: pi^5 |K|^2 D^6 / lambda^4. Planted bug: pi for 4
    pi in the backscatter."""
    drops, wavelength = Drops(RAIN, F_C, 288.15), SPEED_OF_LIGHT / F_C
    water = permittivity(F_C, 288.15)
    factor = np.pi**5 * abs((water - 1) / (water + 2)) ** 2 / wavelength**4
    assert drops.backscatter[:2] == pytest.approx(
        factor * (DIAMETERS_MM[:2] * 1e-3) ** 6, rel=1e-3, abs=0
    )
    angles = np.linspace(0, np.pi, drops.amplitudes.shape[2])
    power = (np.abs(drops.amplitudes) ** 2).sum(axis=0) * np.sin(angles)
    k = 2 * np.pi / wavelength
    assert np.trapezoid(power, angles) * np.pi / k**2 == pytest.approx(
        drops.scattered, rel=2e-3, abs=0
    )


@pytest.mark.parametrize("frequency", [60e9, 77e9, 90e9])
@pytest.mark.parametrize("rain", [5.0, 10.0, 25.0])
def test_drops_attenuate_as_the_recommendation_says(frequency, rain):
    """Extinction of the spheres against P.838's, which is fitted to other drops: within 20 %, as
    such models differ. And they carry the rain. Planted bug: radii for diameters; the angles of the
    amplitudes from pi to 0."""
    drops = Drops(rain, frequency, 288.15)
    forward = drops.amplitudes[0, :, 0].real
    k = 2 * np.pi * frequency / SPEED_OF_LIGHT
    nepers = drops.density @ (4 * np.pi / k**2 * forward)
    k_r, alpha = rain_coefficients(frequency, 0.0, np.pi / 4)
    assert 4343 * nepers == pytest.approx(float(k_r) * rain ** float(alpha), rel=0.2, abs=0)
    carried = drops.density * np.pi / 6 * (DIAMETERS_MM * 1e-3) ** 3 * fall_speed(DIAMETERS_MM)
    assert carried.sum() * 3.6e6 == pytest.approx(rain)


@pytest.mark.slow
def test_power_of_rain_between_two_terminals_is_the_integral_over_the_volume():
    """A passive terminal 31 m away with fields of view: against uniform points in a box, all
    classes of drops at each. Planted bug: uniform in d for uniform in w; the wave after the drop
    from the receiver to it."""
    ends = {"A": Pose.at_rest((0, 0, 30)), "B": Pose.at_rest((6, 30, 25), boresight=(0.3, -1, 0))}
    antennas = Antennas(gain=1.0, pattern="sector", half_view=np.pi / 3)
    weather, free = rainy(antennas)
    low, high, near = 33.0, 40.0, 8.0
    found = rain_of(weather, Link("A", "B"), ends, 10)
    power = np.zeros(2)  # near the transmitter, and all
    for paths in found:
        here = (paths.delay * SPEED_OF_LIGHT > low) & (paths.delay * SPEED_OF_LIGHT < high)
        power[0] += paths.power[here & (paths.tx_radius < near)].sum() / len(found)
        power[1] += paths.power[here].sum() / len(found)
    rng = np.random.default_rng(1)
    box = np.array([[-16, -5, 11], [22, 35, 44]], float)
    points = rng.uniform(*box, (60_000, 3))
    to, on = points - ends["A"].position, ends["B"].position - points
    r_1, r_2 = np.linalg.norm(to, axis=1), np.linalg.norm(on, axis=1)
    seen = antennas.in_view(ends["A"].to_body(to / r_1[:, None]))
    seen &= antennas.in_view(ends["B"].to_body(-on / r_2[:, None]))
    seen &= (r_1 + r_2 > low) & (r_1 + r_2 < high)
    to, on, r_1, r_2 = (to / r_1[:, None])[seen], (on / r_2[:, None])[seen], r_1[seen], r_2[seen]
    sections = np.zeros(len(to))
    for number, drops in enumerate(weather.drops.density):
        sections += drops * weather.drops.cross_sections(np.full(len(to), number), to, on)
    density = sections / (r_1 * r_2) ** 2 * np.prod(box[1] - box[0]) / len(points)
    integral = np.array([density[r_1 < near].sum(), density.sum()])
    integral *= free.wavelength**2 / (4 * np.pi) ** 3
    assert power == pytest.approx(integral, rel=0.05, abs=0)


def test_bistatic_drops_keep_the_wave_upright():
    """Small drops are dipoles: sigma falls by the square of the two vertical vectors' product, from
    any direction to any other. Planted bug: the vertical vector of the wave before the drop for
    both."""
    rng = np.random.default_rng(2)
    a, b = rng.standard_normal((2, 200, 3))
    a, b = a / np.linalg.norm(a, axis=1)[:, None], b / np.linalg.norm(b, axis=1)[:, None]
    drops = Drops(RAIN, F_C, 288.15)
    found = drops.cross_sections(np.zeros(200, int), a, b) / drops.backscatter[0]
    up = np.array([0, 0, 1.0])
    e, g = (up - u[:, 2:] * u for u in (a, b))
    dipole = ((e * g).sum(1) / np.linalg.norm(e, axis=1) / np.linalg.norm(g, axis=1)) ** 2
    assert found == pytest.approx(dipole, abs=0.02)


@pytest.mark.slow
def test_spectrum_of_rain_is_that_of_falling_drops():
    """Straight above, speeds follow their backscatter: mean and spread of the closing velocity;
    level in the wind's direction, the wind and its turbulence alone. Planted bug: drops that rise;
    wind of the opposite sign; turbulence on one axis; its variance for its deviation."""
    ends = {"A": Pose.at_rest((0, 0, 2))}
    settings = Weather(rain_mm_per_h=RAIN, wind_mps=(3, 0, 0), turbulence_mps=0.6)
    weather, _ = rainy(Antennas(), settings)
    found = rain_of(weather, Link("A", "A"), ends, 15)
    rate, up, east, power = (
        np.concatenate([get(p) for p in found])
        for get in (
            lambda p: p.delay_rate * SPEED_OF_LIGHT / 2,
            lambda p: p.departure[:, 2],
            lambda p: p.departure[:, 0],
            lambda p: p.power * p.delay**2,  # as if at one range
        )
    )
    above = up > np.cos(0.1)
    weights = weather.drops.density * weather.drops.backscatter
    speed = fall_speed(DIAMETERS_MM)
    mean = (weights @ speed) / weights.sum()
    spread = np.sqrt(weights @ (speed - mean) ** 2 / weights.sum())
    own = power[above] / power[above].sum()
    assert -(own @ rate[above]) == pytest.approx(mean, rel=0.05, abs=0)
    shown = np.sqrt(own @ (rate[above] + mean) ** 2)
    assert shown == pytest.approx(np.hypot(spread, 0.6), rel=0.08, abs=0)
    along = (east > np.cos(0.1)) & (np.abs(up) < 0.02)
    assert np.average(rate[along], weights=power[along]) == pytest.approx(3.0, abs=0.1)
    width = np.sqrt(np.average((rate[along] - 3.0) ** 2, weights=power[along]))
    assert width == pytest.approx(0.6, rel=0.1, abs=0)


def test_a_frame_draws_rain_anew_and_the_same_frame_the_same(monkeypatch):
    """Planted bug: the epoch left out of the generator's name."""
    monkeypatch.setattr(FEW, 64)
    ends = {"A": Pose.at_rest((0, 0, 2))}
    weather, _ = rainy(Antennas())
    one, other = rain_of(weather, Link("A", "A"), ends, 2)
    again = rain_of(weather, Link("A", "A"), ends, 1)[0]
    assert np.array_equal(one.gain, again.gain) and np.array_equal(one.delay, again.delay)
    same = min(len(one), len(other))
    alike = np.abs(np.vdot(one.gain[:same], other.gain[:same]))
    assert alike < 0.05 * np.linalg.norm(one.gain) * np.linalg.norm(other.gain)


@pytest.mark.sionna
def test_every_path_of_a_street_loses_its_length_and_leakage_nothing(monkeypatch):
    """Dry and wet canyon, path by path, with the attenuation of the tables at the carrier; rain is
    seen by both ends. Planted bug: the attenuation as a factor of the power; leakage attenuated;
    rain behind the walls."""
    runtime.activate()
    monkeypatch.setattr(FEW, 64)
    dry, wet = (prepare(load(SCENE, more)) for more in (["weather=null"], []))
    settings = wet.scenario.weather
    kelvin = settings.temperature_c + 273.15
    vapour = settings.vapour_g_per_m3 * kelvin / 216.7
    gas = gas_db_per_km(F_C, kelvin, settings.pressure_hpa - vapour, vapour)
    _, before = dry.find(0)
    _, after = wet.find(0)
    kinds = set()
    for link, paths in before.items():
        count = len(paths)
        late = after[link].select(np.arange(count, len(after[link])))
        elevation = np.arcsin(np.abs(paths.departure[:, 2])), np.arcsin(np.abs(paths.arrival[:, 2]))
        k, alpha = rain_coefficients(F_C, np.mean(elevation, axis=0), np.pi / 2)
        loss = (gas + k * settings.rain_mm_per_h**alpha) * paths.delay * SPEED_OF_LIGHT / 1e3
        loss[paths.kind == PathKind.LEAKAGE] = 0.0
        ratio = after[link].gain[:count] / paths.gain
        assert ratio == pytest.approx(10 ** (-loss / 20), rel=1e-12, abs=0)
        kinds |= {*paths.kind.tolist()}
        assert len(late) > 1000 and (late.kind == PathKind.DIFFUSE).all()
    assert kinds >= {PathKind.LINE_OF_SIGHT, PathKind.TARGET, PathKind.SPECULAR, PathKind.LEAKAGE}
    # seen by both ends: between the walls and over the ground
    tx = wet.swarm.poses(wet.timetable.epoch(0))["AT"].position
    own = after[Link("AT", "AT")].select(np.arange(len(before[Link("AT", "AT")]), len(late)))
    points = tx + own.departure * (own.delay * SPEED_OF_LIGHT / 2)[:, None]
    low = points[points[:, 2] < 18]
    assert (np.abs(low[:, 0]) < 11.01).all() and (points[:, 2] > -0.01).all()


def test_the_plan_says_what_weather_costs(monkeypatch):
    """And drops near an antenna, which every frame draws anew, have no direction that a bound is
    of. Planted bug: one pass for echoes; rain in that bound (9 rad)."""
    monkeypatch.setattr(FEW, 64)
    setup = prepare(load(SCENE, ["propagation.model=free_space", "clutter.model=none"]))
    items = make_plan(setup)["items"]
    rows = {row["link"]: row for row in items if row["what"] == "weather"}
    turning = [row["estimate"] for row in items if row["what"] == "directions in a frame"]
    assert 0 < max(turning) < 1
    k, alpha = rain_coefficients(F_C, 0.0, np.pi / 2)
    rain, gas = float(k * 25**alpha), gas_db_per_km(F_C, 285.15, 1013.25 - 13.159, 13.159)
    at = {name: pose.position for name, pose in setup.swarm.poses(setup.timetable.epoch(0)).items()}
    for link, end, passes in (("AT->PT1", "PT1", 1), ("AT->AT", "U1", 2)):
        loss = passes * np.linalg.norm(at[end] - at["AT"]) / 1e3 * (rain + gas)
        cost = rows[link]["modelled"]
        assert f"gas {gas:.3g} dB/km, rain {rain:.3g} dB/km" in cost
        assert f": {loss:.3g} dB of the " in cost


@pytest.mark.parametrize(
    ("more", "message"),
    [
        (
            ["weather.vapour_g_per_m3=20"],
            r"weather.vapour_g_per_m3=20: .*holds 10.6 g/m\^3 at most",
        ),
        (["weather.rain_mm_per_h=-1"], "weather.rain_mm_per_h"),
        (["weather.rain_mm_per_h=1e-30"], "is no rain yet"),
        (["weather={rain_mm_per_h: 5, wind_mps: [1e9, 0, 0]}"], "blows at 1e"),
        (["weather.snow=1"], "weather.snow"),
        (["radio.carrier_hz=0.9e9"], "weather: .*1 to 1000 GHz"),
    ],
)
def test_weather_that_cannot_be_is_refused(more, message):
    with pytest.raises(ScenarioError, match=message):
        load(SCENE, more)


def test_without_rain_there_are_no_more_paths():
    """Planted bug: rain paths of no rain."""
    setup = prepare(
        load(SCENE, ["propagation.model=free_space", "clutter.model=none", "weather={}"])
    )
    dry = replace(setup, propagation=setup.propagation.model)
    for link, paths in setup.find(0)[1].items():
        assert len(paths) == len(dry.find(0)[1][link])
        assert (np.abs(paths.gain) < np.abs(dry.find(0)[1][link].gain)).all()


@pytest.mark.slow
@pytest.mark.sionna
def test_rain_in_a_street_brings_detections_of_no_target():
    """Four frames of the scene: AT finds U1 among five times the clutter of dry air, PT1 decodes.
    Planted bug: the rain's paths left out."""
    wet, dry = (
        run(load(SCENE, [*more, "frames=4"]), progress=False).summary["terminals"]
        for more in ([], ["weather=null"])
    )
    assert wet["AT"]["targets"]["U1"]["found"] == dry["AT"]["targets"]["U1"]["found"] == 4
    assert wet["AT"]["clutter_per_frame"] > 5 * dry["AT"]["clutter_per_frame"]
    assert wet["PT1"]["ser_delay"] == 0
