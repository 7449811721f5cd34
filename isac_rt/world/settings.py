"""Settings of the city and of the swarm: surfaces, flights and radar cross-sections."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator
from typing import Annotated, Any, ClassVar, Literal

from pydantic import Field, field_validator

from isac_rt.registry import CITY_SOURCES
from isac_rt.settings import (
    AspectTable,
    ClockDrift,
    Decibels,
    Finite,
    Fraction,
    Node,
    Positive,
    Problem,
    Vector,
)

MAX_SPEED_MPS = 1e4
"""Nothing in the air is faster. Doppler shifts are modelled to the first order in v/c, which is
3e-5 here."""
SOUND_MPS = 340.0
"""Speed of sound, below which tips of blades stay."""


class MaterialOverride(Node):
    """Properties of one material that replace those of the table; what is left out keeps its table
    value."""

    REMOVED: ClassVar[dict[str, str]] = {
        "pattern_exponent": "leave it out: it is 4, which fitted measured buildings"
    }

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
    mirror direction, `backscattering` also back to the source, with the exponent 4 that fitted
    measured buildings (Degli-Esposti 2007). The table has `lambertian`."""
    thickness_m: Positive | None = None
    """Thickness of the slab that a face stands for [m]; the two faces of a thin one interfere. By
    default the table's, 0.1 m for most materials."""


class City(Node):
    """Where the mesh of the city comes from. `source` decides which of the other keys apply."""

    REMOVED: ClassVar[dict[str, str]] = {
        "level_height_m": "leave it out: a storey is 3 m, as in OpenStreetMap's Simple 3D Buildings"
    }

    source: Annotated[str, CITY_SOURCES]
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
    up_axis: Literal["auto", "y", "z"] = "auto"
    """Axis of a `mesh` file that points up. `auto`, the default, is y for glTF, as its standard
    has it, and z for all others, with a warning where the mesh seems to lie on its side."""
    scale: Positive = 1.0
    """Metres per unit of a `mesh` file: 0.001 where it is in millimetres. By default the file is in
    metres."""
    material: str = "concrete"
    """Material of the pieces of a `mesh` that neither `material_map` nor their names tell. The
    default, concrete, is the most common."""
    material_map: dict[str, str] = Field({})
    """Material by the name of a node, geometry or material of a `mesh` file, or by the type of a
    CityJSON object or surface. By default names are looked up in the table of materials; `new`
    prints CityJSON's."""
    coordinates: Literal["auto", "metres", "lonlat"] = "auto"
    """Coordinates of `footprints`: `metres`, `lonlat` for longitude and latitude in degrees, or
    `auto`, the default: told by their size."""
    crs: str | None = None
    """Coordinate reference system of a `footprints` file, such as EPSG:2056; it overrides the
    file's. Grids in true metres are kept, others projected about the origin. By default the file's,
    or inferred from the size of its numbers."""
    origin: Vector | None = None
    """Point of a `footprints` or `mesh` file [x, y, z], in the file's coordinates and units, that
    becomes the world's origin. By default the file's origin; for longitude and latitude, the middle
    of the buildings at height 0."""
    terrain: str | None = None
    """Path of a GeoTIFF with heights of the ground [m], relative to the scenario's folder, for
    `footprints`; needs the extra `cities`. By default the relief of CityJSON, else a ground that is
    made through the feet of the buildings."""
    height_property: str = "height"
    """Property that holds a building's height [m] in a `footprints` file; text such as 12,5 or
    40 ft is understood. Where it is missing, `building:levels` counts. The default is what most
    exports of OpenStreetMap call it."""
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
    """Distance from the middle of the flight within which the city is kept [m]. A smaller city is
    traced faster, but what is left out neither reflects nor occludes. By default all of it is
    kept."""
    materials: dict[str, MaterialOverride] = Field({})
    """Properties to change, by the name of the material. By default the table of ITU-R P.2040
    holds."""

    def applies(self, name: str) -> bool:
        known = CITY_KEYS.get(self.source, CITY_KEYS["mesh"])  # of another package
        return name in known or name in ("source", "keep_radius_m", "materials")

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
    "mesh": frozenset({"file", "up_axis", "scale", "origin", "material", "material_map"}),
    "footprints": _SURFACES
    | {"file", "layer", "lod", "coordinates", "crs", "origin", "terrain", "height_property"}
    | {"default_height_m", "material_map"},
    "canyon": _BUILT | _SURFACES | {"street_length_m"},
    "blocks": _BUILT | _SURFACES | {"blocks_x", "blocks_y"},
}
"""Keys that each source of a city understands, beside source, keep_radius_m and materials."""


class Rcs(Node):
    """Radar cross-section of a UAV: how strong its echo is."""

    model: Literal["constant", "tr38901", "relative", "table"] = "tr38901"
    """Radar cross-section: `constant`: `value_dbsm`; `tr38901`, the default: the UAV of 3GPP TR
    38.901 of the given `size`; `relative`: echo level `level_db` whatever the geometry, as in the
    paper; `table`: `table` or `file`, towards the bistatic bisector."""
    table: AspectTable | None = None
    """Cross-section by azimuth and elevation in the UAV's frame [dBsm], for `table`."""
    file: str | None = None
    """CSV file with the columns azimuth_deg, elevation_deg and dbsm, a row for each direction of a
    grid, in place of `table`; the path is relative to the scenario's folder."""
    value_dbsm: Decibels = -12.81
    """Cross-section over one square metre [dBsm], for `constant`. The default is the mean of TR
    38.901's small UAV."""
    size: Literal["small", "large"] = "small"
    """Which UAV of TR 38.901 is meant, for `tr38901`: `small`, the default, reflects alike to all
    sides; `large` has lobes to front, back, sides, top and bottom."""
    fluctuation_db: Annotated[float, Field(ge=0, le=20)] | None = None
    """Standard deviation of the cross-section over the aspect [dB], for `tr38901` and `constant`;
    the same on all links, without effect on the mean power. The default is 3GPP's for `tr38901`
    (3.74 small, 2.50 large), else none."""
    level_db: Decibels = -20.0
    """Level of the reflected path over the reference path of its link [dB], for `relative`: the
    line of sight at a passive terminal, the strongest other target at an active one. The default
    leaves the reference path far stronger."""

    def applies(self, name: str) -> bool:
        return name not in ("table", "file") or self.model == "table"

    def problems(self) -> Iterator[Problem]:
        if self.file is not None:
            yield Problem((("file",),), "is read by isac_rt.load, which was not used; state table")
        elif (self.table is None) == (self.model == "table"):
            text = "goes with model table, and model table with it or with file"
            yield Problem((("table",), ("model",)), text)


MOST_BLADES_M = 8.0
"""Length of all blades of a UAV together [m]; 1 m is 1,000 points in each slot, 0.2 GB a frame."""
NEAREST_BLADE_M = 0.05
"""Least distance of a terminal's blades from its arrays [m]: a few of the arrays' own size."""


class Rotors(Node):
    """Rotors of a UAV, whose blades turn in the plane across its body's Z axis."""

    number: Annotated[int, Field(ge=1, le=16)] = 4
    """Number of rotors, evenly spaced about the body, the first of four halfway between ahead and
    right; one stands in the middle. Every second one turns the other way. By default four."""
    arm_m: Annotated[float, Field(ge=0, le=10)] = 0.2
    """Distance of each rotor's hub from the middle of the body [m]. The default is that of a
    quadcopter of 1 kg."""
    blades: Annotated[int, Field(ge=1, le=8)] = 2
    """Number of blades of each rotor; by default two."""
    blade_length_m: Annotated[float, Field(ge=0.005, le=1)] = 0.12
    """Length of a blade from the hub to its tip [m]. The default is that of a quadcopter of
    1 kg."""
    rev_per_min: Annotated[float, Field(ge=0)] | tuple[float, ...] = 6000.0
    """Revolutions per minute, or those of each rotor, positive clockwise seen from above. The
    default is that of a quadcopter of 1 kg that hovers; 0: blades stand still."""
    phase_deg: tuple[Finite, ...] | None = None
    """Angle of each rotor's first blade at time 0, clockwise from ahead seen from above [degrees].
    null, the default: drawn by `seed` and the UAV's name."""
    blade_dbsm: Decibels | None = None
    """Cross-section of a blade at its flash, seen across its length [dBsm]. null, the default: that
    of a plastic edge, or along the normal of a plastic plate (docs/moving.md)."""
    chord_m: Annotated[float, Field(gt=0, le=0.3)] | None = None
    """Width of a blade as a flat plate [m], such as 0.015 of the default blades; it matters near
    the blades' normals, and before a terminal's own arrays. null, the default: a thin wire."""
    incidence_deg: Annotated[float, Field(ge=-45, le=45)] = 10.0
    """Angle by which a flat blade's leading edge is above its trailing edge [degrees]. The default
    is that of a propeller with a pitch of 4 inches at three quarters of 12 cm."""
    height_m: Annotated[float, Field(ge=-2, le=2)] = 0.0
    """Height of the rotors over the UAV's position, where its arrays are [m]. The default is 0."""

    @field_validator("rev_per_min", mode="before")
    @classmethod
    def _one_speed_or_one_for_each(cls, value: Any) -> Any:
        least, numbers = (-math.inf, value) if isinstance(value, list | tuple) else (0, [value])
        if not all(isinstance(n, int | float) and math.isfinite(n) and n >= least for n in numbers):
            raise ValueError("must be a number from 0 on, or a list with one for each rotor")
        return value

    def applies(self, name: str) -> bool:
        return name != "incidence_deg" or self.chord_m is not None

    @property
    def nearest(self) -> float:
        """Distance of the blades from the middle of the UAV [m]."""
        inner = max(self.arm_m - self.blade_length_m, 0.0) if self.number > 1 else 0.0
        return math.hypot(inner, self.height_m)

    @property
    def total_length(self) -> float:
        """Length of all blades together [m]."""
        return self.number * self.blades * self.blade_length_m

    @property
    def speeds(self) -> tuple[float, ...]:
        """Revolutions per minute of each rotor, positive clockwise seen from above."""
        if isinstance(self.rev_per_min, tuple):
            return self.rev_per_min
        return tuple((-1) ** i * self.rev_per_min for i in range(self.number))

    @property
    def tip_speed(self) -> float:
        """Speed of the fastest blade's tip [m/s]."""
        fastest = max(map(abs, self.speeds), default=0.0)
        return 2 * math.pi * fastest / 60 * self.blade_length_m

    def problems(self) -> Iterator[Problem]:
        for key in ("rev_per_min", "phase_deg"):
            values = getattr(self, key)
            if isinstance(values, tuple) and len(values) != self.number:
                text = f"{len(values)} values for {self.number} rotors; state one for each"
                yield Problem(((key,), ("number",)), text)
        if (total := self.total_length) > MOST_BLADES_M:
            yield Problem(
                (("number",), ("blades",), ("blade_length_m",)),
                f"blades of {total:g} m together, at most {MOST_BLADES_M:g} m fit the memory; "
                "take fewer or shorter ones",
            )
        if self.tip_speed > SOUND_MPS:
            yield Problem(
                (("rev_per_min",), ("blade_length_m",)),
                f"the tips fly at {self.tip_speed:.4g} m/s, faster than sound ({SOUND_MPS:g} m/s); "
                "lower rev_per_min, or shorten the blades",
            )


MOST_SIZE_M = 100.0
Side = Annotated[float, Field(gt=0, le=MOST_SIZE_M)]
"""Of a moving body [m]."""


class Centre(Node):
    """One scattering centre of a target with extent."""

    position_m: Vector
    """Position from the middle of the UAV: to the right, ahead, up [m]."""
    value_dbsm: Decibels | None = None
    """Cross-section, the same to all sides [dBsm]; in place of `table`."""
    table: AspectTable | None = None
    """Cross-section by azimuth and elevation of the bisector in the UAV's frame [dBsm]."""
    phase_table: AspectTable | None = None
    """Phase of the echo, a table as `table` [degrees, within +-400]. null, the default: 0."""

    def problems(self) -> Iterator[Problem]:
        if (self.value_dbsm is None) == (self.table is None):
            yield Problem((("value_dbsm",), ("table",)), "a centre has one of both; state one")
        if (off := math.hypot(*self.position_m)) > MOST_SIZE_M:
            text = f"is {off:.4g} m from the middle of the UAV, at most {MOST_SIZE_M:g} m are taken"
            yield Problem((("position_m",),), f"{text}; it is in metres")


class Extent(Node):
    """Scattering centres of a target that is no point. In the samples they take the place of its
    one echo."""

    kind: Literal["uav", "vehicle", "agv", "pedestrian", "centres"]
    """Kind of target: `uav`, `vehicle` and `agv` are 3GPP TR 38.901's with a centre on each face,
    `pedestrian` has limbs that swing, `centres` are stated."""
    size_m: tuple[Side, Side, Side] | None = None
    """Width, length and height [m]; of a pedestrian the height counts. null, the default: 3GPP's,
    1.5 x 1.6 x 0.7 (uav), 2 x 5 x 1.6 (vehicle), 1 x 0.5 x 0.5 (agv), 0.5 x 0.5 x 1.75."""
    centres: tuple[Centre, ...] = ()
    """Centres, for the kind `centres`. By default none."""
    file: str | None = None
    """CSV file in place of `centres`: right_m, ahead_m, up_m, dbsm, and optionally phase_deg,
    azimuth_deg and elevation_deg; a row for each centre, or for each direction of each."""

    def applies(self, name: str) -> bool:
        return name == "kind" or (name == "size_m") != (self.kind == "centres")

    def problems(self) -> Iterator[Problem]:
        if self.file is not None:
            yield Problem(
                (("file",),), "is read by isac_rt.load, which was not used; state centres"
            )
        elif bool(self.centres) != (self.kind == "centres"):
            text = "go with kind centres, and kind centres with them"
            yield Problem((("centres",), ("kind",)), text)
        if self.size_m is not None and self.kind == "centres":
            text = "has no meaning beside centres, which have places; remove it"
            yield Problem((("size_m",), ("kind",)), text)


class Box(Node):
    """Closed box about a UAV's position that shadows and mirrors, such as a car or a tram, or a
    convex solid in its place."""

    size_m: tuple[Side, Side, Side] | None = None
    """Width, length and height [m], along right, ahead and up of the body. By default a mesh's."""
    corners_m: tuple[Vector, ...] | None = None
    """Corners of a convex solid: to the right, ahead, up of the UAV's position [m]. null, the
    default: those of a cuboid."""
    file: str | None = None
    """Closed mesh in metres, y ahead, z up (glTF: y up), its middle at the UAV's position: PLY,
    OBJ, STL, glTF or GLB. Its convex hull is taken, scaled to `size_m` where that is stated."""
    material: str = "metal"
    """Material of all faces, by its name in the table of materials or in `city.materials`. By
    default metal, as of a car."""

    def problems(self) -> Iterator[Problem]:
        if self.file is not None:
            yield Problem((("file",),), "is read by isac_rt.load, which was not used; state size_m")
        elif self.size_m is None and self.corners_m is None:
            text = "a box needs its size_m, or the file of a mesh"
            yield Problem((("size_m",), ("file",)), text)


class Waypoint(Node):
    """Where a UAV is at one time."""

    time_s: Finite
    """Time after the start of the run [s]; later than that of the waypoint before."""
    position_m: Vector
    """Position at that time: x east, y north, z up [m]."""
    attitude_deg: Vector | None = None
    """Attitude at that time: yaw (clockwise from north), pitch (nose up) and roll (right side down)
    [degrees], at all waypoints or at none, interpolated smoothly. null, the default: `boresight`
    states it."""


class Formation(Node):
    """Several UAVs from one: all fly the same way, apart from each other."""

    shape: Literal["line", "column", "wedge", "grid"]
    """Arrangement about the direction of flight: `line` to the right and left in turn, `column`
    behind each other, `wedge` behind to the right and left in turn, `grid` in rows to the right,
    each behind the one before."""
    spacing_m: Annotated[float, Field(gt=0, le=10_000, allow_inf_nan=False)]
    """Distance of neighbours along the line, the column and the rows, and sideways and behind in
    the wedge [m]."""
    count: Annotated[int, Field(ge=2, le=200)]
    """How many there are, the one that is stated included; they get its name with _1, _2 and so
    on."""

    def positions(self) -> list[tuple[float, float]]:
        """(right, ahead) of each [m], the first at (0, 0)."""
        out = []
        width = math.ceil(math.sqrt(self.count))
        for i in range(self.count):
            step = (i + 1) // 2
            side = step if i % 2 else -step
            right, ahead = {
                "line": (side, 0),
                "column": (0, -i),
                "wedge": (side, -step),
                "grid": (i % width, -(i // width)),
            }[self.shape]
            out.append((right * self.spacing_m, ahead * self.spacing_m))
        return out


TERMINAL_ROLES = ("active", "passive")
"""Roles of UAVs that send or receive."""


class Uav(Node):
    """One UAV: its role, its flight and its body. It flies straight from `position_m`, or a smooth
    curve through `waypoints`."""

    role: Literal["active", "passive", "target", "object"]
    """What the UAV does: `active` sends the chirps and senses with their echoes, `passive` decodes
    the data and senses with the chirps it receives, `target` only reflects, as does an `object`,
    such as a car, which is not scored."""
    position_m: Vector | None = None
    """Position at the start of the run: x east, y north, z up [m]. A UAV has either this or
    `waypoints`."""
    velocity_mps: Vector = (0.0, 0.0, 0.0)
    """Velocity of a straight flight: east, north, up [m/s]; beside `position_m` only. By default
    the UAV hovers."""
    waypoints: tuple[Waypoint, ...] | None = None
    """Two places or more with their times, which the UAV flies through on a smooth curve; in place
    of `position_m` and `velocity_mps`."""
    flight: str | None = None
    """File instead of `waypoints`, in the scenario's folder: CSV of time_s and x, y, z [m] or lat,
    lon, alt, optionally yaw_deg, pitch_deg, roll_deg; or a log (PX4, ROS 2, SUMO): FILE#PART@START,
    SUMO's whole traffic FILE#*. ~SECONDS smooths."""
    mount_deg: Vector = (0.0, 0.0, 0.0)
    """How the arrays are turned against the UAV's own frame: yaw to the right, pitch up, roll
    [degrees], as of a radar that looks sideways from a car. By default they look ahead."""
    formation: Formation | None = None
    """Further UAVs of the same kind that fly beside this one. null, the default: none."""
    boresight: Literal["velocity"] | Vector = "velocity"
    """Direction [x, y, z] that the arrays look in, of any length, or `velocity`, the default: where
    the UAV flies to. Targets outside the field of view about it are not seen."""
    rcs: Rcs = Rcs()
    """Radar cross-section: how strong the echo is. By default that of `extent` or a small UAV."""
    rotors: Rotors | None = None
    """Rotors whose blades modulate the UAV's echo. null, the default: none."""
    extent: Extent | None = None
    """Several scattering centres in place of one. null, the default: a point target."""
    box: Box | None = None
    """Box that shadows other paths and mirrors them with its faces; for targets and objects, in
    place of the disc of `body_radius_m`. null, the default: none."""
    clock_offset_s: Finite = 0.0
    """How late the UAV's clock is at time 0 [s]: what it sends arrives later by this, what it
    receives seems to arrive earlier. By default all clocks agree."""
    clock_drift_ppm: ClockDrift = 0.0
    """How much later the clock gets [microseconds per second]; 0.01 ppm against another clock looks
    like 3 m/s of velocity. By default none."""
    body_radius_m: Annotated[float, Field(ge=0, le=10, allow_inf_nan=False)] = 0.2
    """Radius of the opaque disc that shadows what passes behind the UAV [m], with
    `propagation.model: ray_traced`; 0: transparent. A body does not shadow its own paths and
    echoes. The default is that of a small quadcopter."""
    resource_block: Annotated[int, Field(ge=0)] | None = None
    """First of the consecutive resource blocks, one per group, that an active UAV sends in, counted
    from 0. null, the default: the lowest blocks that the active UAVs before it leave free."""

    @field_validator("boresight", mode="before")
    @classmethod
    def _velocity_or_direction(cls, value: Any) -> Any:
        if value != "velocity" and not (isinstance(value, list | tuple) and len(value) == 3):
            raise ValueError("must be velocity or a direction [x, y, z]")
        if isinstance(value, list | tuple) and not any(value):
            raise ValueError(
                "a direction of length zero points nowhere; give a direction such as [0, 1, 0], or "
                "velocity"
            )
        return value

    @property
    def is_terminal(self) -> bool:
        """True if it sends or receives at the start."""
        return self.role in TERMINAL_ROLES

    def applies(self, name: str) -> bool:
        if name == "resource_block":
            return self.role == "active"
        return name != "velocity_mps" or self.waypoints is None

    def problems(self) -> Iterator[Problem]:
        if self.resource_block is not None and self.role != "active":
            text = (
                f"has no meaning for a UAV that is {self.role} at the start (who takes over the "
                "role takes over its blocks); remove it"
            )
            yield Problem((("resource_block",), ("role",)), text)
        if self.flight is not None:
            text = "is read by isac_rt.load, which was not used; state waypoints"
            yield Problem((("flight",),), text)
        if self.formation is not None:
            text = "is unfolded in the swarm of a scenario; state UAVs one by one here"
            yield Problem((("formation",),), text)
        turned = [w.attitude_deg is not None for w in self.waypoints or ()]
        if any(turned) and not all(turned):
            text = "some have attitude_deg and some have not; state it at all or at none"
            yield Problem((("waypoints",),), text)
        if any(turned) and self.boresight != "velocity":
            text = "the waypoints' attitude_deg says where the UAV looks; leave one of the two out"
            yield Problem((("boresight",), ("waypoints",)), text)
        if self.box is not None and self.is_terminal:
            text = "is for targets and objects: a terminal would sit within it; remove it"
            yield Problem((("box",), ("role",)), text)
        if self.rotors is not None and self.is_terminal and self.rotors.nearest < NEAREST_BLADE_M:
            yield Problem(
                (("rotors", "height_m"), ("rotors", "arm_m"), ("role",)),
                f"the blades come to {self.rotors.nearest:.2g} m from the arrays of a terminal, at "
                f"least {NEAREST_BLADE_M:g} m are needed; raise height_m or arm_m",
            )
        for key in ("rotors", "extent"):
            if getattr(self, key) is not None and self.rcs.model == "relative":
                text = "needs a cross-section in square metres; give the UAV another rcs.model"
                yield Problem(((key,), ("rcs", "model")), text)
        if (speed := math.hypot(*self.velocity_mps)) > MAX_SPEED_MPS:
            yield Problem((("velocity_mps",),), _too_fast(speed))
        if self.waypoints is None and self.position_m is None:
            yield Problem((("position_m",),), "missing: a UAV needs either position_m or waypoints")
        if self.waypoints is None:
            return
        if self.position_m is not None:
            yield Problem(
                (("position_m",), ("waypoints",)),
                "a UAV has either position_m or waypoints, not both; remove one of them",
            )
        if "velocity_mps" in self.model_fields_set:
            yield Problem(
                (("velocity_mps",), ("waypoints",)),
                "waypoints say how a UAV flies; remove velocity_mps or the waypoints",
            )
        if len(self.waypoints) < 2:
            yield Problem(
                (("waypoints",),),
                "needs two waypoints or more; for a UAV at rest or in straight flight use "
                "position_m",
            )
        for i, (before, after) in enumerate(itertools.pairwise(self.waypoints), start=1):
            if after.time_s <= before.time_s:
                yield Problem(
                    (("waypoints", i, "time_s"), ("waypoints", i - 1, "time_s")),
                    f"must be later than the waypoint before, at {before.time_s:g} s; put the "
                    "waypoints in the order of their times",
                )
                continue
            distance = math.dist(before.position_m, after.position_m)
            if (speed := distance / (after.time_s - before.time_s)) > MAX_SPEED_MPS:
                yield Problem(
                    (("waypoints", i, "time_s"), ("waypoints", i, "position_m")), _too_fast(speed)
                )

    def position_at(self, time: float) -> tuple[float, ...]:
        """Position [m] with straight lines between waypoints: near enough to judge an input, not to
        fly by."""
        if self.waypoints is None:
            assert self.position_m is not None
            return tuple(
                p + time * v for p, v in zip(self.position_m, self.velocity_mps, strict=True)
            )
        for a, b in itertools.pairwise(self.waypoints):
            if time < b.time_s or b is self.waypoints[-1]:
                share = (time - a.time_s) / (b.time_s - a.time_s)
                return tuple(
                    p + share * (q - p) for p, q in zip(a.position_m, b.position_m, strict=True)
                )
        raise AssertionError("two waypoints at least")


def _too_fast(speed: float) -> str:
    """Return what is wrong with a speed [m/s]."""
    return (
        f"a flight at {speed:.4g} m/s is faster than the {MAX_SPEED_MPS:g} m/s that are modelled; "
        "fly slower"
    )
