r"""Air and rain between the terminals: attenuation of every path, and the rain's own echoes.

Rain echoes are paths of random scatterers, many drops each, that share the radar equation over the
volume (docs/weather.md) in cells of path length s = r_1 + r_2 between the ends. On ellipsoids about
ends L_0 apart, d = r_1 - r_2, the volume is :math:`dV = r_1 r_2/(2 L_0)\, ds\, dd\, d\varphi`. With
d = s tanh(w), dd/(r_1 r_2) is 4 dw/s, so that scatterers that are uniform in s, w and the angle phi
have equal shares. Amplitudes are circular Gaussian and hold within a frame while delays move. Each
frame draws anew: drops whose speeds differ by 1 m/s decorrelate in half a wavelength over that
speed, 2 ms at 77 GHz, less than a frame.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from isac_rt.extensions.street.air import (
    ZERO_CELSIUS,
    gas_db_per_km,
    rain_coefficients,
    vapour_pressure,
)
from isac_rt.extensions.street.drops import DIAMETERS_MM, Drops, fall_speed
from isac_rt.extensions.street.occlusion import Occlusion
from isac_rt.frame.level import LinkBudget
from isac_rt.frame.link import Link
from isac_rt.frame.waveform import SPEED_OF_LIGHT, Waveform
from isac_rt.propagation.free_space import FreeSpace
from isac_rt.propagation.model import Census, Propagation, Traced
from isac_rt.propagation.pathset import PathKind, PathSet, merge
from isac_rt.propagation.scatter_paths import LinkState, ScatterPaths
from isac_rt.propagation.segments.geometry import straight
from isac_rt.propagation.settings import Weather
from isac_rt.randomness import generator
from isac_rt.world.city.mesh import CityMesh
from isac_rt.world.swarm import Pose

MOST_SCATTERERS = 512
"""Scatterers drawn in a range cell, ten in a Doppler cell: CFAR finds as many false targets as with
4,096; with 128, which is no Gaussian field, 2.5 times as many."""
THINNED_BEYOND = 100
"""Range cell beyond which cells get fewer scatterers, in inverse proportion to the range: there the
noise is as strong as the rain of a range-Doppler cell."""


class Air:
    """Specific attenuation of a scenario's weather at one frequency.

    Attributes
    ----------
    gas : of the air [dB/km]
    """

    def __init__(self, settings: Weather, frequency: float) -> None:
        self._frequency, self._rain = frequency, settings.rain_mm_per_h
        kelvin = settings.temperature_c + ZERO_CELSIUS
        vapour = vapour_pressure(settings.vapour_g_per_m3, kelvin)
        self.gas = gas_db_per_km(frequency, kelvin, settings.pressure_hpa - vapour, vapour)

    def rain(self, elevation: np.ndarray | float) -> np.ndarray:
        """Return the specific attenuation of rain on paths of an elevation [rad], vertical
        polarisation [dB/km]."""
        k, alpha = rain_coefficients(self._frequency, elevation, np.pi / 2)
        return np.asarray(k * self._rain**alpha)

    def loss_db(self, paths: PathSet) -> np.ndarray:
        """Return the loss of each path (K,), rain by the mean of the elevations at both ends;
        leakage stays on its board."""
        kilometres = np.where(
            paths.kind == PathKind.LEAKAGE, 0.0, paths.delay * SPEED_OF_LIGHT / 1e3
        )
        ends = np.arcsin(np.clip(np.abs([paths.departure[:, 2], paths.arrival[:, 2]]), 0, 1))
        return np.asarray((self.gas + self.rain(ends.mean(axis=0))) * kilometres)


class Weathered:
    """A propagation model with weather.

    Parameters
    ----------
    settings : of the weather
    model : of the paths in vacuum
    free : terminals and antennas
    waveform : of the run
    city : whose surfaces hide rain; None: open space
    """

    def __init__(
        self,
        settings: Weather,
        model: Propagation,
        free: FreeSpace,
        waveform: Waveform,
        city: CityMesh | None,
    ) -> None:
        self.model, self._settings = model, settings
        self._free, self._waveform = free, waveform
        self._occlusion = Occlusion(city, waveform.carrier_frequency)
        frequency = waveform.effective_carrier
        self.air = Air(settings, frequency)
        self.drops = Drops(settings.rain_mm_per_h, frequency, settings.temperature_c + ZERO_CELSIUS)

    def census(self) -> Census:
        """Return the census of the underlying model."""
        return self.model.census()

    def trace(self, poses: dict[str, Pose], epoch: float, links: list[Link]) -> Traced:
        """Return the model's paths and the rain's, attenuated."""
        found, dropped = self.model.trace(poses, epoch, links)
        out = {}
        for link, paths in found.items():
            if self._settings.rain_mm_per_h:
                state = LinkState(link, epoch, poses[link.tx], poses[link.rx], paths.target_names)
                paths = merge([paths, self.rain_paths(state)])
            out[link] = replace(paths, gain=paths.gain * 10 ** (-self.air.loss_db(paths) / 20))
        return Traced(out, dropped)

    def rain_paths(self, state: LinkState) -> PathSet:
        """Draw the rain echoes of a link, without attenuation."""
        rng = generator(self._free.seed, "rain", *state.link, repr(float(state.epoch)))
        points, weight = self._places(state, rng)
        classes, expected = self._classes(len(points), rng)
        white = rng.standard_normal((len(points), 2)) @ np.array([1, 1j]) / np.sqrt(2)
        velocity = self._settings.turbulence_mps * rng.standard_normal(points.shape)
        velocity += self._settings.wind_mps
        velocity[:, 2] -= fall_speed(DIAMETERS_MM[classes])
        there, back = (straight(end, points, velocity) for end in (state.start, state.end))
        ways = ScatterPaths.over(there, back)
        section = expected * self.drops.cross_sections(classes, there.departure, back.arrival)
        amplitude = np.sqrt(self._free.wavelength**2 / (4 * np.pi) ** 3 * weight * section)
        amplitude *= state.elements(self._free.arrays, ways)
        amplitude[self._occlusion.hidden(state, points)] = 0.0
        return state.paths(ways, amplitude * white, PathKind.DIFFUSE)

    def _places(self, state: LinkState, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
        """Draw scatterers (K, 3) in cells of path length, the first one cell beyond the straight
        path, and the integral of dV / (r_1 r_2)^2 that each stands for (K,) [1/m]."""
        step = SPEED_OF_LIGHT * self._waveform.delay_step
        span = state.end.position - state.start.position
        apart = float(np.linalg.norm(span))
        count = int((SPEED_OF_LIGHT * self._waveform.max_delay - apart) / step)
        cell = np.arange(1, max(count, 1))
        draws = np.ceil(MOST_SCATTERERS * np.minimum(THINNED_BEYOND / cell, 1.0)).astype(int)
        cell, draws = np.repeat(cell, draws), np.repeat(draws, draws)
        u, phi, within = rng.uniform((-1, 0, 0), (1, 2 * np.pi, 1), (cell.size, 3)).T
        length = apart + (cell + within) * step
        ratio = np.maximum(apart / length, 1e-9)  # of one end to itself: any small number
        limit = np.arctanh(ratio)
        along = np.tanh(u * limit) / ratio  # d / L_0
        # prolate spheroidal coordinates about the middle of both ends
        across = np.sqrt((length**2 - apart**2) * np.maximum(1 - along**2, 0.0)) / 2
        axes = _axes(span)
        points = (length * along / 2)[:, None] * axes[0] + across[:, None] * (
            np.cos(phi)[:, None] * axes[1] + np.sin(phi)[:, None] * axes[2]
        )
        weight = 8 * np.pi * limit / (ratio * length**2) * step / draws
        return (state.start.position + state.end.position) / 2 + points, weight

    def _classes(self, count: int, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
        """Draw the diameter class of each scatterer by what the classes scatter, and the drops in a
        cubic metre (K,) that it stands for."""
        share = self.drops.density * self.drops.scattered
        share = share / share.sum()
        classes = rng.choice(share.size, count, p=share)
        return classes, self.drops.density[classes] / share[classes]


def _axes(span: np.ndarray) -> np.ndarray:
    """Return three unit vectors (3, 3) at right angles, the first along a span; along x of no
    span."""
    first = span / np.linalg.norm(span) if span.any() else np.array([1.0, 0.0, 0.0])
    least = np.eye(3)[np.abs(first).argmin()]
    second = np.cross(first, least) / np.linalg.norm(np.cross(first, least))
    return np.stack([first, second, np.cross(first, second)])


def plan_rows(
    settings: Weather, waveform: Waveform, budgets: list[LinkBudget]
) -> list[dict[str, Any]]:
    """Return a row of the plan for each link budget: loss per kilometre and of the reference
    path."""
    frequency = waveform.effective_carrier
    air, rain = Air(settings, frequency), settings.rain_mm_per_h
    attenuation = f"gas {air.gas:.3g} dB/km, rain {float(air.rain(0.0)):.3g} dB/km"
    if rain:
        drops = Drops(rain, frequency, settings.temperature_c + ZERO_CELSIUS)
        echo = 10 * np.log10(drops.density @ drops.backscatter)  # of a cubic metre
        attenuation += f" and {echo:.1f} dB of echo per metre"
    rows = []
    for row in budgets:
        passes = 2 if len(set(row.link.split("->"))) == 1 else 1
        loss = (air.gas + float(air.rain(0.0))) * passes * row.distance_m / 1e3
        cost = f"{attenuation}: {loss:.3g} dB of the {row.reference}"
        said = {"what": "weather", "modelled": cost, "left_out": "in what receivers expect"}
        rows.append({**said, "link": row.link})
    return rows
