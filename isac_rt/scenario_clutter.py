"""What a scenario says about clutter: none, two statistical models for any scenario, and two that a city's mesh gives."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Annotated, Literal

from pydantic import Field

from isac_rt.scenario_base import Finite, Node, Positive, Problem


class Clutter(Node):
    """What is received beside line of sight, targets, ghosts and mirror images.

    none: nothing; with noise.model snr this is the paper's "Gaussian noise environment", whose SNR counts weak clutter and thermal
    noise as one. gaussian: white Gaussian clutter beside the thermal noise, so that the SNR that is asked for is the thermal noise's alone.
    rayleigh: the paper's urban model, a run of range cells that stand still (`isac_rt.propagation.statistical`). Both go with any
    propagation model. field: scatterers pinned to the mesh, the same in all frames and links. diffuse: Sionna's own, traced anew in
    every frame, which draws the points anew as well; to compare with.
    """

    model: Literal["none", "gaussian", "rayleigh", "diffuse", "field"] = "none"
    clutter_to_noise_db: Finite = 0.0
    """gaussian: power of the clutter over that of the thermal noise."""
    level_db: Finite = 10.0
    """rayleigh: mean level of one cell over the link's reference path (the strongest target at the AT, the line of sight at a PT) as
    it would be unshadowed and in view."""
    level_of: Literal["power", "amplitude"] = "power"
    """rayleigh: whether `level_db` is of the mean power or of the mean amplitude; the latter is 1.05 dB more of power."""
    cells: tuple[Annotated[int, Field(ge=1)], Annotated[int, Field(ge=1)]] = (40, 50)
    """rayleigh: least and most consecutive range cells, drawn in between."""
    centre: Literal["drawn", "reference"] = "drawn"
    """rayleigh: centre drawn uniformly within `centre_m`, or around the reference path."""
    centre_m: tuple[Positive, Positive] = (20.0, 30.0)
    """rayleigh, centre drawn: its least and greatest range, twice the same to fix it; one way at the AT, path length at a PT."""
    place: Literal["drawn", "grid"] = "drawn"
    """rayleigh: a scatterer anywhere in its range cell, or in the middle of it."""
    direction: Literal["field_of_view", "reference"] = "field_of_view"
    """rayleigh: directions drawn over the field of view of either end, or all that of the reference path."""
    cell_correlation: Annotated[float, Field(ge=0, lt=1)] = 0.0
    """rayleigh: correlation of the complex amplitudes of neighbouring cells."""
    redraw: Literal["each_frame", "once"] = "each_frame"
    """rayleigh: how often number, centre, places, directions and amplitudes are drawn."""
    rays: Annotated[int, Field(ge=100, le=10_000_000)] = 20_000
    """diffuse: rays of a re-trace, per transmitter."""
    max_error_db: Annotated[float, Field(gt=0, le=5, allow_inf_nan=False)] = 0.2
    """field: error of the mean power in a range cell of 4 m that nine of ten cells keep to, of those with a thousandth of all power and
    more; decides how many scatterers there are (`isac_rt.propagation.cells`)."""
    cell_area_per_metre_m: Annotated[float, Field(gt=0, le=100, allow_inf_nan=False)] | None = None
    """field: largest area that one scatterer stands for, over its distance to the nearest terminal's flight [m^2/m], in place of what
    max_error_db asks for."""
    smallest_cell_m2: Annotated[float, Field(ge=1e-4, le=1e4, allow_inf_nan=False)] = 0.05
    """field: cells of this area are cut no further, however near."""
    mirrors: Annotated[int, Field(ge=0, le=64)] = 0
    """field: walls, roofs and grounds per terminal, the strongest, by way of which each scatterer is lit and heard as well (two bounces);
    0: one bounce."""

    def applies(self, name: str) -> bool:
        if name == "centre_m" and self.centre != "drawn":
            return False
        return name == "model" or name in CLUTTER_KEYS[self.model]

    def problems(self) -> Iterator[Problem]:
        for name, (low, high) in (("cells", self.cells), ("centre_m", self.centre_m)):
            if low > high:
                yield Problem(((name,),), f"the first number must not exceed the second; write [{high:g}, {low:g}]")


CLUTTER_KEYS: dict[str, frozenset[str]] = {
    "none": frozenset(),
    "gaussian": frozenset({"clutter_to_noise_db"}),
    "rayleigh": frozenset(
        {"level_db", "level_of", "cells", "centre", "centre_m", "place", "direction", "cell_correlation", "redraw"}
    ),
    "diffuse": frozenset({"rays"}),
    "field": frozenset({"max_error_db", "cell_area_per_metre_m", "smallest_cell_m2", "mirrors"}),
}
"""Keys that each clutter model understands, beside model; the others may stand and are not written back."""
