"""What a scenario says about the city, the paths in it, its clutter, and how near to the full model
a run has to come."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Annotated, Literal

from pydantic import Field

from isac_rt.scenario.node import Finite, Fraction, Node, Positive, Problem


class MaterialOverride(Node):
    """What a scenario changes of a material; what is left out keeps its table value."""

    relative_permittivity: Annotated[float, Field(ge=1)] | None = None
    conductivity_s_per_m: Annotated[float, Field(ge=0)] | None = None
    scattering_coefficient: Fraction | None = None
    scattering_pattern: Literal["lambertian", "directive", "backscattering"] | None = None
    pattern_exponent: Annotated[int, Field(ge=1, le=20)] | None = None
    thickness_m: Positive | None = None


class City(Node):
    """Where the mesh comes from. `source` decides which of the keys below it apply."""

    source: Literal["builtin", "mitsuba", "mesh", "footprints", "canyon", "blocks"]
    # builtin: name of a scene that ships with Sionna RT; mitsuba, mesh, footprints: a file beside
    # the scenario
    name: str | None = None
    file: str | None = None
    # mesh files
    up_axis: Literal["y", "z"] = "z"
    scale: Positive = 1.0
    material: str = "concrete"
    material_map: dict[str, str] = Field({})
    # footprints
    coordinates: Literal["auto", "metres", "lonlat"] = "auto"
    height_property: str = "height"
    default_height_m: Positive = 10.0
    wall_material: str = "concrete"
    roof_material: str = "concrete"
    ground_material: str = "asphalt"
    ground_margin_m: Annotated[float, Field(ge=0)] = 50.0
    # canyon and blocks
    street_width_m: Positive = 20.0
    street_length_m: Positive = 120.0
    building_height_m: Positive = 20.0
    height_spread_m: Annotated[float, Field(ge=0)] = 0.0
    block_size_m: Positive = 40.0
    blocks_x: Annotated[int, Field(ge=1, le=100)] = 3
    blocks_y: Annotated[int, Field(ge=1, le=100)] = 3
    # all
    keep_radius_m: Positive | None = None
    materials: dict[str, MaterialOverride] = Field({})

    def applies(self, name: str) -> bool:
        return name in CITY_KEYS[self.source] or name in ("source", "keep_radius_m", "materials")

    def problems(self) -> Iterator[Problem]:
        for name in type(self).model_fields:
            if name in self.model_fields_set and not self.applies(name):
                sources = " or ".join(source for source, keys in CITY_KEYS.items() if name in keys)
                yield Problem(
                    ((name,), ("source",)),
                    f"has no meaning with city.source {self.source}, only with {sources}; remove "
                    "the key or change the source",
                )
        if self.source == "builtin" and not self.name:
            yield Problem(
                (("name",), ("source",)),
                "city.source builtin needs the name of a scene of Sionna RT, such as munich",
            )
        if self.source in ("mitsuba", "mesh", "footprints") and not self.file:
            yield Problem(
                (("file",), ("source",)),
                f"city.source {self.source} needs a file, relative to the scenario's folder",
            )


_BUILT = frozenset({"street_width_m", "building_height_m", "height_spread_m", "block_size_m"})


_SURFACES = frozenset({"wall_material", "roof_material", "ground_material", "ground_margin_m"})


CITY_KEYS: dict[str, frozenset[str]] = {
    "builtin": frozenset({"name"}),
    "mitsuba": frozenset({"file"}),
    "mesh": frozenset({"file", "up_axis", "scale", "material", "material_map"}),
    "footprints": frozenset({"file", "coordinates", "height_property", "default_height_m"})
    | _SURFACES,
    "canyon": _BUILT | _SURFACES | {"street_length_m"},
    "blocks": _BUILT | _SURFACES | {"blocks_x", "blocks_y"},
}
"""Keys that each source of a city understands, beside source, keep_radius_m and materials."""


class Leakage(Node):
    """The transmitter heard by the receiver on the same body."""

    enabled: bool = True
    isolation_db: Annotated[float, Field(ge=0)] = 60.0
    delay_s: Annotated[float, Field(ge=0)] = 1e-9


class Propagation(Node):
    """Which paths there are."""

    model: Literal["free_space", "ray_traced"] = "free_space"
    max_bounces: Annotated[int, Field(ge=0, le=6)] = 2
    """Specular bounces per leg (terminal to terminal, terminal to target)."""
    rays: Annotated[int, Field(ge=100, le=10_000_000)] = 20_000
    ghosts: bool = True
    specular: bool = True
    weakest_path_db: Annotated[float, Field(ge=0)] = 40.0
    """Paths this far below the noise of one range-Doppler-antenna cell are left out."""
    leakage: Leakage = Leakage()


class Clutter(Node):
    """What is received beside line of sight, targets, ghosts and mirror images.

    none: nothing; with noise.model snr this is the paper's "Gaussian noise environment", whose SNR
    counts weak clutter and thermal noise as one. gaussian: white Gaussian clutter beside the
    thermal noise, so that the SNR that is asked for is the thermal noise's alone. rayleigh: the
    paper's urban model, a run of range cells that stand still
    (`isac_rt.propagation.clutter.rayleigh`). Both go with any propagation model. field: scatterers
    pinned to the mesh, the same in all frames and links. diffuse: Sionna's own, traced anew in
    every frame, which draws the points anew as well; to compare with.
    """

    model: Literal["none", "gaussian", "rayleigh", "diffuse", "field"] = "none"
    clutter_to_noise_db: Finite = 0.0
    """gaussian: power of the clutter over that of the thermal noise."""
    level_db: Finite = 10.0
    """rayleigh: mean level of one cell over the link's reference path (the strongest target at the
    AT, the line of sight at a PT) as it would be unshadowed and in view."""
    level_of: Literal["power", "amplitude"] = "power"
    """rayleigh: whether `level_db` is of the mean power or of the mean amplitude; the latter is
    1.05 dB more of power."""
    cells: tuple[Annotated[int, Field(ge=1)], Annotated[int, Field(ge=1)]] = (40, 50)
    """rayleigh: least and most consecutive range cells, drawn in between."""
    centre: Literal["drawn", "reference"] = "drawn"
    """rayleigh: centre drawn uniformly within `centre_m`, or around the reference path."""
    centre_m: tuple[Positive, Positive] = (20.0, 30.0)
    """rayleigh, centre drawn: its least and greatest range, twice the same to fix it; one way at
    the AT, path length at a PT."""
    place: Literal["drawn", "grid"] = "drawn"
    """rayleigh: a scatterer anywhere in its range cell, or in the middle of it."""
    direction: Literal["field_of_view", "reference"] = "field_of_view"
    """rayleigh: directions drawn over the field of view of either end, or all that of the reference
    path."""
    cell_correlation: Annotated[float, Field(ge=0, lt=1)] = 0.0
    """rayleigh: correlation of the complex amplitudes of neighbouring cells."""
    redraw: Literal["each_frame", "once"] = "each_frame"
    """rayleigh: how often number, centre, places, directions and amplitudes are drawn."""
    rays: Annotated[int, Field(ge=100, le=10_000_000)] = 20_000
    """diffuse: rays of a re-trace, per transmitter."""
    max_error_db: Annotated[float, Field(gt=0, le=5, allow_inf_nan=False)] = 0.2
    """field: error of the mean power in a range cell of 4 m that nine of ten cells keep to, of
    those with a thousandth of all power and more; decides how many scatterers there are
    (`isac_rt.propagation.clutter.cells`)."""
    cell_area_per_metre_m: Annotated[float, Field(gt=0, le=100, allow_inf_nan=False)] | None = None
    """field: largest area that one scatterer stands for, over its distance to the nearest
    terminal's flight [m^2/m], in place of what max_error_db asks for."""
    smallest_cell_m2: Annotated[float, Field(ge=1e-4, le=1e4, allow_inf_nan=False)] = 0.05
    """field: cells of this area are cut no further, however near."""
    mirrors: Annotated[int, Field(ge=0, le=64)] = 0
    """field: walls, roofs and grounds per terminal, the strongest, by way of which each scatterer
    is lit and heard as well (two bounces); 0: one bounce."""

    def applies(self, name: str) -> bool:
        if name == "centre_m" and self.centre != "drawn":
            return False
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
            "level_of",
            "cells",
            "centre",
            "centre_m",
            "place",
            "direction",
            "cell_correlation",
            "redraw",
        }
    ),
    "diffuse": frozenset({"rays"}),
    "field": frozenset({"max_error_db", "cell_area_per_metre_m", "smallest_cell_m2", "mirrors"}),
}
"""Keys that each clutter model understands, beside model; the others may stand and are not written
back."""


class Accuracy(Node):
    """How near to the full model a run has to come; what the scene then needs is decided link by
    link and frame by frame (`isac_rt.simulation.plan`, `isac-rt plan`).

    budget: what the keys below and propagation.weakest_path_db allow is left out. everything:
    nothing is left out, every frame is traced. fastest: plane wavefronts, straight flight within a
    frame, weak paths up to the noise of a cell left out, few traces.
    """

    preset: Literal["budget", "everything", "fastest"] = "budget"
    max_phase_error_rad: Positive = 0.05
    """budget: most by which approximations together may turn the phase of a path, at any element
    and chirp."""
    max_untraced_m: Annotated[float, Field(ge=0)] = 1.0
    """budget: farthest that a UAV flies between two traced instants; 0: every frame is traced."""
    synthesis_error: Annotated[float, Field(ge=1e-6, le=0.1)] = 1e-4
    """budget, everything: relative RMS error that fast synthesis of IF samples may have; the
    cheapest method that keeps it is taken."""
    cost_model: str | None = None
    """budget, everything: what the methods cost, a file of `isac-rt bench --fit`, relative to the
    scenario's folder; without one, the costs that ship with the program. It decides between methods
    that all keep synthesis_error."""

    def applies(self, name: str) -> bool:
        if name in ("synthesis_error", "cost_model"):
            return self.preset != "fastest"
        return name == "preset" or self.preset == "budget"
