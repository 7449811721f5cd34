"""What a scenario says about the city, the paths in it, its clutter, and how near to the full model
a run has to come."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Annotated, Any, Literal

from pydantic import BeforeValidator, Field

from isac_rt.scenario.node import (
    Decibels,
    Finite,
    Fraction,
    Loss,
    Node,
    Positive,
    Problem,
    Vector,
)


class MaterialOverride(Node):
    """Properties of one material that replace those of the table; what is left out keeps its table
    value."""

    relative_permittivity: Annotated[float, Field(ge=1)] | None = None
    """Real part of the relative permittivity at the carrier, without unit. By default the value of
    ITU-R P.2040 or the rule that the report of a run states."""
    conductivity_s_per_m: Annotated[float, Field(ge=0)] | None = None
    """Conductivity at the carrier, which stands for all losses [S/m]. By default the value of ITU-R
    P.2040 or the rule that the report of a run states."""
    scattering_coefficient: Fraction | None = None
    """Share of the reflected amplitude that leaves diffusely; its square is the share of the power.
    By default the table's, 0.1 to 0.4 by roughness for building materials: a stated choice, for
    there is no agreed measurement at 77 GHz."""
    scattering_pattern: Literal["lambertian", "directive", "backscattering"] | None = None
    """Directions that diffuse power leaves in: `lambertian` about the normal, `directive` about the
    mirror direction, `backscattering` also back to the source. The table has `lambertian`."""
    pattern_exponent: Annotated[int, Field(ge=1, le=20)] | None = None
    """Narrowness of the lobes of `directive` and `backscattering`: a higher exponent makes them
    narrower. The default, 4, fitted measured buildings (Degli-Esposti 2007)."""
    thickness_m: Positive | None = None
    """Thickness of the slab that a face stands for [m]; the two faces of a thin one interfere. By
    default the table's, 0.1 m for most materials."""


class City(Node):
    """Where the mesh of the city comes from. `source` decides which of the other keys apply."""

    source: Literal["builtin", "mitsuba", "mesh", "footprints", "canyon", "blocks"]
    """Kind of city: `builtin` is a scene that comes with Sionna RT, `mitsuba`, `mesh` and
    `footprints` read a file, `canyon` is one street between two rows of buildings, `blocks` a grid
    of blocks."""
    name: str | None = None
    """Name of a scene of Sionna RT, such as munich, for `builtin`."""
    file: str | None = None
    """Path of the city's file, relative to the scenario's folder, for `mitsuba` (XML), `mesh` (PLY,
    OBJ, STL, GLB) and `footprints` (GeoJSON, CityJSON, CityJSONSeq; with the extra `cities` also
    GeoPackage, Shapefile, FlatGeobuf, GeoParquet, and OpenStreetMap's .osm and .osm.pbf)."""
    layer: str | None = None
    """Layer of a `footprints` file that holds the buildings, where it has several. By default the
    one with building in its name."""
    lod: Annotated[float, Field(ge=0, le=4)] | None = None
    """Highest level of detail that is taken of CityJSON, such as 1.2, without unit; a lower level
    has fewer faces. By default the highest that there is."""
    up_axis: Literal["y", "z"] = "z"
    """Axis of a `mesh` file that points up. The default is z; glTF has y by its standard."""
    scale: Positive = 1.0
    """Metres per unit of a `mesh` file. By default the file is in metres."""
    material: str = "concrete"
    """Material of the pieces of a `mesh` that neither `material_map` nor their names tell. The
    default, concrete, is the most common."""
    material_map: dict[str, str] = Field({})
    """Material by the name of a node, geometry or material of a `mesh` file; by the type of an
    object or surface of CityJSON, such as SolitaryVegetationObject. By default these names are
    looked up in the table of materials as they are, and a CityJSON type has the material that `new`
    prints."""
    coordinates: Literal["auto", "metres", "lonlat"] = "auto"
    """Coordinates of `footprints`: `metres`, `lonlat` for longitude and latitude in degrees, or
    `auto`, the default: told by their size."""
    crs: str | None = None
    """Coordinate reference system of a `footprints` file, such as EPSG:2056, which goes before what
    the file says. Grids in true metres are kept, all others projected about the origin. By default
    what the file says, else told by the size of its numbers."""
    origin: Vector | None = None
    """Point of a `footprints` file [x, y, z] that becomes the world's origin, in the coordinates of
    the file (metres, or longitude and latitude in degrees) and with a height in metres. By default
    that of the file where it is in metres, else the middle of the buildings at height 0."""
    terrain: str | None = None
    """Path of a GeoTIFF with heights of the ground [m], relative to the scenario's folder, for
    `footprints`; needs the extra `cities`. By default the relief of CityJSON, else a ground that is
    made through the feet of the buildings."""
    height_property: str = "height"
    """Property that holds a building's height [m] in a `footprints` file; text such as 12,5 or
    40 ft is understood. Where it is missing, `building:levels` counts. The default is what most
    exports of OpenStreetMap call it."""
    level_height_m: Positive = 3.0
    """Height of a storey [m], where a `footprints` file tells storeys. The default is that of
    OpenStreetMap's Simple 3D Buildings."""
    default_height_m: Positive = 10.0
    """Height of a building whose footprint has none [m]. The default is three storeys."""
    wall_material: str = "concrete"
    """Material of the walls, for `footprints`, `canyon` and `blocks`; by default concrete."""
    roof_material: str = "concrete"
    """Material of the roofs, for `footprints`, `canyon` and `blocks`; by default concrete."""
    ground_material: str = "asphalt"
    """Material of the ground, for `footprints`, `canyon` and `blocks`. The default is a
    street's."""
    ground_margin_m: Annotated[float, Field(ge=0)] = 50.0
    """How far the ground reaches beyond the outermost buildings [m], for `footprints`, `canyon` and
    `blocks`; what lies beyond sends nothing back. The default is as wide as a street and the
    yard behind it."""
    street_width_m: Positive = 20.0
    """Width of a street from facade to facade [m], for `canyon` and `blocks`. The default is a city
    street."""
    street_length_m: Positive = 120.0
    """Length of the street, along y [m], for `canyon`; a longer one has more walls to compute. The
    default has room for flights of some seconds."""
    building_height_m: Positive = 20.0
    """Mean height of the buildings [m], for `canyon` and `blocks`. The default is six storeys."""
    height_spread_m: Annotated[float, Field(ge=0)] = 0.0
    """Most that a building is higher or lower than `building_height_m` [m]; the same for the same
    building in every run. By default all are alike."""
    block_size_m: Positive = 40.0
    """Side of a square block, for `blocks`; depth of the rows and length of a building along the
    street, for `canyon` [m]. The default is a block of two rows of houses."""
    blocks_x: Annotated[int, Field(ge=1, le=100)] = 3
    """Number of blocks from west to east, for `blocks`; more of them make the city larger and runs
    slower. The default has a street on each side of the middle block."""
    blocks_y: Annotated[int, Field(ge=1, le=100)] = 3
    """Number of blocks from south to north, for `blocks`, as `blocks_x` from west to east. By
    default as many."""
    keep_radius_m: Positive | None = None
    """Horizontal distance from the middle of the flight within which the city is kept [m]. A
    smaller city is traced faster, but what is left out neither reflects nor shadows. By default all
    of it is kept."""
    materials: dict[str, MaterialOverride] = Field({})
    """Properties to change, by the name of the material. By default the table of ITU-R P.2040
    holds."""

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
        if self.crs is not None and self.coordinates != "auto":
            yield Problem(
                (("crs",), ("coordinates",)),
                f"says more than city.coordinates {self.coordinates}; remove one of them",
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
    "footprints": frozenset(
        {
            "file",
            "layer",
            "lod",
            "coordinates",
            "crs",
            "origin",
            "terrain",
            "height_property",
            "level_height_m",
            "default_height_m",
            "material_map",
        }
    )
    | _SURFACES,
    "canyon": _BUILT | _SURFACES | {"street_length_m"},
    "blocks": _BUILT | _SURFACES | {"blocks_x", "blocks_y"},
}
"""Keys that each source of a city understands, beside source, keep_radius_m and materials."""


class Leakage(Node):
    """What a terminal's receiver hears of its own transmitter on the same body."""

    enabled: bool = True
    """Whether leakage is simulated, with `propagation.model: ray_traced`. On by default, for no
    radar is without it."""
    isolation_db: Loss = 60.0
    """Loss from the transmit to the receive antennas of one body [dB]. The default is that of
    separate antennas on one board."""
    delay_s: Annotated[float, Field(ge=0)] = 1e-9
    """Delay of the leakage [s]. The default is 30 cm of way."""


class Propagation(Node):
    """Which paths there are between the terminals and by way of the targets."""

    model: Literal["free_space", "ray_traced"] = "free_space"
    """How paths are found: `free_space`, the default and the paper's, has lines of sight and echoes
    only; `ray_traced` finds reflections, ghosts and shadows in the city's mesh."""
    max_bounces: Annotated[int, Field(ge=0, le=6)] = 2
    """Most mirror reflections on a path between two terminals, and on the ways to and from a target
    together. More reflections cost time and add weaker paths; the default finds single and double
    ones."""
    rays: Annotated[int, Field(ge=100, le=10_000_000)] = 60_000
    """Rays that a terminal sends out at each knot of its flight to find which walls a wave may meet
    one after the other; five knots are pooled (`accuracy.max_untraced_m` says how far apart they
    are). More rays find paths over small faces more surely and take longer. Paths that are found do
    not depend on it. The default misses none over the noise of a cell in cities of some hundred
    metres."""
    ghosts: bool = True
    """Whether echoes of a target that also bounce off the city are simulated; a receiver takes them
    for targets. On by default, as in any street."""
    specular: bool = True
    """Whether mirror reflections off the city are simulated. On by default, as in any street."""
    weakest_path_db: Loss = 40.0
    """How far below the noise of one range-Doppler-antenna cell paths must be to be left out [dB].
    The default leaves out a ten-thousandth of the noise; a smaller value is faster."""
    leakage: Leakage = Leakage()
    """What a terminal's receiver hears of its own transmitter; it covers what is very near. The
    default is that of a board with separate antennas."""


class Clutter(Node):
    """What is received beside lines of sight, targets, ghosts and mirror images."""

    model: Literal["none", "gaussian", "rayleigh", "diffuse", "field"] = "none"
    """Kind of clutter. `none`, the default; with `noise.model: snr` it is the paper's "Gaussian
    noise environment". `gaussian`: white noise beside the thermal noise. `rayleigh`, the paper's
    urban model: a run of range cells that stand still. `field`: scatterers pinned to the city's
    mesh, the same in all frames and links. `diffuse`: Sionna RT's own diffuse paths, drawn anew in
    every frame, to compare with."""
    clutter_to_noise_db: Decibels = 0.0
    """Power of `gaussian` clutter over that of the thermal noise [dB]. By default they are
    alike."""
    level_db: Decibels = 10.0
    """Mean level of one cell of `rayleigh` clutter over the reference path of the link [dB]: the
    strongest target at an active terminal, the line of sight at a passive one, as if nothing hid
    it. The default is the paper's."""
    level_of: Literal["power", "amplitude"] = "power"
    """Whether `level_db` of `rayleigh` clutter is that of the mean power, the default, or of the
    mean amplitude, which is 1.05 dB more of power."""
    cells: tuple[Annotated[int, Field(ge=1)], Annotated[int, Field(ge=1)]] = (40, 50)
    """Least and most consecutive range cells of `rayleigh` clutter; the number is drawn in between.
    The default is the paper's."""
    centre: Literal["drawn", "reference"] = "drawn"
    """Where the middle of `rayleigh` clutter lies: `drawn` uniformly within `centre_m`, the
    default, or at the range of the `reference` path."""
    centre_m: tuple[Positive, Positive] = (20.0, 30.0)
    """Least and greatest range of the middle of `rayleigh` clutter that is drawn [m], twice the
    same to fix it; one way at an active terminal, path length at a passive one. The default is the
    paper's."""
    place: Literal["drawn", "grid"] = "drawn"
    """Where a scatterer of `rayleigh` clutter lies: `drawn` anywhere in its range cell, the
    default, or in its middle (`grid`)."""
    direction: Literal["field_of_view", "reference"] = "field_of_view"
    """Directions of `rayleigh` clutter: drawn over the `field_of_view` of both ends, the default,
    or all that of the `reference` path."""
    cell_correlation: Annotated[float, Field(ge=0, lt=1)] = 0.0
    """Correlation of the complex amplitudes of neighbouring cells of `rayleigh` clutter, from 0 to
    1. By default cells are independent."""
    redraw: Literal["each_frame", "once"] = "each_frame"
    """How often `rayleigh` clutter is drawn: in `each_frame`, the default, or `once` for the
    run."""
    rays: Annotated[int, Field(ge=100, le=10_000_000)] = 20_000
    """Rays that a transmitter sends out for `diffuse` clutter. More rays give more and weaker
    paths, the same power in all, and take longer. The default gives some thousand paths a link."""
    max_error_db: Annotated[float, Field(gt=0, le=5, allow_inf_nan=False)] = 0.2
    """Error that nine of ten cells keep to [dB], for `field`: of the mean clutter power in a range
    cell of 4 m, and of noise plus mean clutter in a range-Doppler cell, under whose noise
    scatterers are merged. A smaller error takes more scatterers. The default is far below the
    fluctuation of clutter itself."""
    cell_area_per_metre_m: Annotated[float, Field(gt=0, le=100, allow_inf_nan=False)] | None = None
    """Largest area that one scatterer stands for, per metre of distance to the nearest terminal's
    flight [m^2/m], for `field`. null, the default: what `max_error_db` asks for."""
    smallest_cell_m2: Annotated[float, Field(ge=1e-4, le=1e4, allow_inf_nan=False)] = 0.05
    """Area of a surface cell that is cut no further, however near a terminal flies [m^2], for
    `field`. The default bounds the number of scatterers beside a wall."""
    mirrors: Annotated[int, Field(ge=0, le=64)] = 0
    """Walls, roofs and grounds per terminal, the strongest, by way of which each scatterer is lit
    and heard as well, for `field`. 0, the default: clutter of one bounce only."""

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


def _four_numbers(value: Any) -> Any:
    if (
        not isinstance(value, list | tuple)
        or len(value) != 4
        or not all(isinstance(v, int | float) for v in value)
    ):
        raise ValueError("must be four numbers [x_min, y_min, x_max, y_max]")
    if value[0] >= value[2] or value[1] >= value[3]:
        raise ValueError("holds nothing; state [x_min, y_min, x_max, y_max] in this order")
    return value


Rectangle = Annotated[tuple[Finite, Finite, Finite, Finite], BeforeValidator(_four_numbers)]


class Belief(Node):
    """What terminals believe wrongly of themselves and of the city, to see what it costs them. What
    is sent, and what returns, is as it truly is."""

    missing_m: tuple[Rectangle, ...] = ()
    """Rectangles [x_min, y_min, x_max, y_max] on the ground whose buildings are missing in the
    terminals' mesh [m]: all faces that lie wholly within one. By default none."""
    position_m: Vector = (0.0, 0.0, 0.0)
    """Error of the position that each terminal believes to be at: east, north, up [m]. By default
    none."""
    velocity_mps: Vector = (0.0, 0.0, 0.0)
    """Error of the velocity that each terminal believes to have: east, north, up [m/s]. By default
    none."""
    attitude_deg: Vector = (0.0, 0.0, 0.0)
    """Turn of the attitude that each terminal believes to have, about the axes east, north and up
    [deg]. By default none."""
    level_db: Decibels = 0.0
    """Error of the clutter's level that terminals expect [dB]. By default none."""
    mesh_m: Annotated[float, Field(ge=0, le=100, allow_inf_nan=False)] = 0.0
    """Standard deviation of the error of each face of the terminals' mesh along its normal [m], for
    the clutter that they expect. By default none."""


class Accuracy(Node):
    """How near to the full model a run has to come. What the scene then needs is decided link by
    link and frame by frame; `isac-rt plan` shows it."""

    preset: Literal["budget", "everything", "fastest"] = "budget"
    """What may be left out. `budget`, the default: what the keys below and
    `propagation.weakest_path_db` allow. `everything`: nothing is left out, rays search for walls in
    every frame. `fastest`: plane wavefronts, straight flight within a frame, no path below the
    noise of a cell, few searches."""
    max_phase_error_rad: Positive = 0.05
    """Most by which plane wavefronts and straight flight together may turn the phase of a path at
    any element and chirp [rad], for `budget`. Directions that turn within a frame are modelled in
    no run and come on top (1.2 rad for an echo at 3.5 m and 28 m/s across); `isac-rt plan` and the
    summary state them. The default costs at most 0.01 dB of the path's power."""
    max_untraced_m: Annotated[float, Field(ge=0)] = 2.0
    """Farthest that a terminal flies between two knots, places from which rays search for chains of
    walls [m], for `budget`; 0: they search from where it is in each frame. A longer way is faster
    and may miss paths over walls that are seen for a shorter way only. Where the chains run, and
    which of them are free, is found out in every frame. The default is shorter than walls are
    wide."""
    synthesis_error: Annotated[float, Field(ge=1e-6, le=0.1)] = 1e-4
    """Relative RMS error that fast synthesis of IF samples may have, for `budget` and `everything`;
    the cheapest method that keeps it is taken. The default is 80 dB below the signal."""
    covered_error_db: Annotated[float, Field(ge=0, le=400)] | None = 20.0
    """How far under the noise of a range-Doppler cell of all channels the error stays that
    noise covers in the synthesis [dB], for `budget`: most scatterers of a `field` take half of
    the time then, at a larger error than `synthesis_error`. The default is a hundredth of the
    noise's power. null: none is covered."""
    cost_model: str | None = None
    """File of what the methods of synthesis cost on a machine, made by `isac-rt bench --fit` and
    relative to the scenario's folder, for `budget` and `everything`. It decides between methods
    that all keep `synthesis_error`. By default the costs that come with the program hold."""

    def applies(self, name: str) -> bool:
        if name in ("synthesis_error", "cost_model"):
            return self.preset != "fastest"
        return name == "preset" or self.preset == "budget"
