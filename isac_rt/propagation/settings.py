"""Settings of the city, the paths in it, and its clutter."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Annotated, ClassVar, Literal

from pydantic import Field

from isac_rt.registry import PROPAGATION_MODELS
from isac_rt.settings import Decibels, Loss, Node, Positive, Problem, Vector

LEAST_RAIN = 0.01
"""Rain rate [mm/h] below which there are too few drops for a distribution of their sizes."""
MOST_WIND_MPS = 100.0


class Leakage(Node):
    """Coupling of a terminal's transmitter into its own receiver."""

    REMOVED: ClassVar[dict[str, str]] = {"delay_s": "leave it out: it is 1e-9, 30 cm of way"}

    enabled: bool = True
    """Whether leakage is simulated, with `propagation.model: ray_traced`. On by default, for no
    radar is without it."""
    isolation_db: Loss = 60.0
    """Loss from the transmit to the receive antennas of one body [dB]. The default is that of
    separate antennas on one board."""


class Propagation(Node):
    """Paths between the terminals and by way of the targets."""

    REMOVED: ClassVar[dict[str, str]] = {"specular": "max_bounces: 0 for no mirror reflections"}

    model: Annotated[str, PROPAGATION_MODELS] = "free_space"
    """How paths are found: `free_space`, the default and the paper's, has lines of sight and echoes
    only; `ray_traced` finds reflections, ghosts and shadows in the city's mesh."""
    max_bounces: Annotated[int, Field(ge=0, le=6)] = 2
    """Most mirror reflections on a path between two terminals, and on the ways to and from a target
    together. More reflections cost time and add weaker paths; the default finds single and double
    ones."""
    rays: Annotated[int, Field(ge=100, le=10_000_000)] = 60_000
    """Rays per terminal and time sample that search for chains of walls; five time samples are
    pooled (`accuracy.max_untraced_m`). More rays find small faces more surely and take longer. The
    default suffices in cities of some hundred metres."""
    ghosts: bool = True
    """Whether echoes of a target that also bounce off the city are simulated; a receiver takes them
    for targets. On by default, as in any street."""
    weakest_path_db: Loss = 40.0
    """How far below the noise of one range-Doppler-antenna cell paths must be to be left out [dB].
    The default leaves out a ten-thousandth of the noise; a smaller value is faster."""
    leakage: Leakage = Leakage()
    """What a terminal's receiver receives of its own transmitter; it covers what is very near. The
    default is that of a board with separate antennas."""


class Weather(Node):
    """Air and rain on the paths, the same everywhere."""

    rain_mm_per_h: Annotated[float, Field(ge=0, le=300, allow_inf_nan=False)] = 0.0
    """Rain rate [mm/h]: it attenuates every path and scatters. 1 is drizzle, 10 steady rain, 50 a
    cloudburst. The default is none."""
    wind_mps: Vector = (0.0, 0.0, 0.0)
    """Wind that carries the drops: east, north, up [m/s]. By default drops fall straight down."""
    turbulence_mps: Annotated[float, Field(ge=0, le=10, allow_inf_nan=False)] = 0.0
    """Standard deviation of the air's velocity on each axis, which widens the rain's Doppler
    spectrum [m/s]: 0.5 in steady rain, 2 in a thunderstorm. The default is calm air."""
    temperature_c: Annotated[float, Field(ge=-40, le=60, allow_inf_nan=False)] = 15.0
    """Temperature of air and drops [degrees Celsius]. The default is ITU's."""
    pressure_hpa: Annotated[float, Field(ge=300, le=1100, allow_inf_nan=False)] = 1013.25
    """Pressure of the air, water vapour included [hPa]. The default is that at sea level."""
    vapour_g_per_m3: Annotated[float, Field(ge=0, le=100, allow_inf_nan=False)] = 7.5
    """Density of water vapour [g/m^3], 12.8 at most at 15 degrees. The default is ITU's."""

    def applies(self, name: str) -> bool:
        return name not in ("wind_mps", "turbulence_mps") or self.rain_mm_per_h > 0

    def problems(self) -> Iterator[Problem]:
        if 0 < self.rain_mm_per_h < LEAST_RAIN:
            text = f"is no rain yet; take 0, or at least {LEAST_RAIN:g} mm/h"
            yield Problem((("rain_mm_per_h",),), text)
        if (wind := math.hypot(*self.wind_mps)) > MOST_WIND_MPS:
            text = f"blows at {wind:.4g} m/s, at most {MOST_WIND_MPS:g} m/s are taken; lower it"
            yield Problem((("wind_mps",),), text)
        celsius = self.temperature_c
        # Magnus' formula for the pressure [hPa] of saturated vapour, and its density
        saturated = 6.112 * math.exp(17.62 * celsius / (243.12 + celsius))
        most = 216.7 * saturated / (celsius + 273.15)
        if self.vapour_g_per_m3 > 1.01 * most:
            yield Problem(
                (("vapour_g_per_m3",), ("temperature_c",)),
                f"air of {celsius:g} degrees holds {most:.3g} g/m^3 at most; state as much or "
                "less, or warmer air",
            )


class Clutter(Node):
    """Echoes of the city besides lines of sight, targets, ghosts and mirror images."""

    REMOVED: ClassVar[dict[str, str]] = {
        "level_of": "leave it out: level_db is of the mean power; of the mean amplitude, add 1.05",
        "centre": "centre_m with the range of the reference path twice, or leave it out",
        "place": "leave it out: scatterers lie anywhere in their range cells",
        "direction": "leave it out: directions are drawn over the field of view",
        "cell_correlation": "leave it out: cells are independent",
        "redraw": "leave it out: every frame has a draw of its own",
        "model: diffuse": "model: field, scatterers that stay in place from frame to frame",
        "rays": "model: field with max_error_db: a larger error takes fewer scatterers",
    }

    model: Literal["none", "gaussian", "rayleigh", "field"] = "none"
    """Kind of clutter. `none`, the default. `gaussian`: white noise in addition to thermal noise.
    `rayleigh`, the paper's urban model: a run of static range cells. `field`: scatterers pinned to
    the city's mesh, the same in all frames and links."""
    clutter_to_noise_db: Decibels = 0.0
    """Power of `gaussian` clutter over that of the thermal noise [dB]. By default they are
    alike."""
    level_db: Decibels = 10.0
    """Mean power of one cell of `rayleigh` clutter over the unobstructed reference path of the link
    [dB]: the strongest target at an active terminal, the line of sight at a passive one. The
    default is the paper's."""
    cells: tuple[Annotated[int, Field(ge=1)], Annotated[int, Field(ge=1)]] = (40, 50)
    """Least and most consecutive range cells of `rayleigh` clutter; the number is drawn in between.
    The default is the paper's."""
    centre_m: tuple[Positive, Positive] = (20.0, 30.0)
    """Least and greatest range of the middle of `rayleigh` clutter that is drawn [m], twice the
    same to fix it; one way at an active terminal, path length at a passive one. The default is the
    paper's."""
    max_error_db: Annotated[float, Field(gt=0, le=5, allow_inf_nan=False)] = 0.2
    """Error that nine of ten cells keep to, for `field` [dB]: of the mean clutter power in a 4 m
    range cell, and of noise plus clutter in a range-Doppler cell. A smaller error takes more
    scatterers than the default."""
    cell_area_per_metre_m: Annotated[float, Field(gt=0, le=100, allow_inf_nan=False)] | None = None
    """Largest area that one scatterer stands for, per metre of distance to the nearest terminal's
    flight [m^2/m], for `field`. null, the default: what `max_error_db` asks for."""
    smallest_cell_m2: Annotated[float, Field(ge=1e-4, le=1e4, allow_inf_nan=False)] = 0.05
    """Area of a surface cell that is cut no further, however near a terminal flies [m^2], for
    `field`. The default bounds the number of scatterers beside a wall."""
    mirrors: Annotated[int, Field(ge=0, le=64)] = 0
    """Walls, roofs and grounds per terminal, the strongest, by way of which each scatterer is lit
    and received as well, for `field`. 0, the default: clutter of one bounce only."""

    @property
    def noise_rise(self) -> float:
        """Power of thermal noise and `gaussian` clutter together over that of the thermal noise:
        the sum of two white Gaussian processes is one."""
        return 1 + 10 ** (self.clutter_to_noise_db / 10) if self.model == "gaussian" else 1.0

    def applies(self, name: str) -> bool:
        return name == "model" or name in CLUTTER_KEYS[self.model]

    def problems(self) -> Iterator[Problem]:
        for name, (low, high) in (("cells", self.cells), ("centre_m", self.centre_m)):
            if low > high:
                yield Problem(
                    ((name,),),
                    f"the first number must not exceed the second; write [{high:g}, {low:g}]",
                )


CLUTTER_KEYS: dict[str, frozenset[str]] = {
    "none": frozenset(),
    "gaussian": frozenset({"clutter_to_noise_db"}),
    "rayleigh": frozenset(
        {
            "level_db",
            "cells",
            "centre_m",
        }
    ),
    "field": frozenset({"max_error_db", "cell_area_per_metre_m", "smallest_cell_m2", "mirrors"}),
}
"""Keys that each clutter model understands, beside model; the others may stand and are not written
back."""
