"""The whole input of a run as a frozen, typed tree, and what must hold between its values.

Units stand in the key names. Unknown keys are refused. Everything inside the program is SI, radians and
linear power; the conversions from decibels and degrees happen where a value leaves this tree. Files are read
and written by `isac_rt.scenario_file`.
"""

from __future__ import annotations

import itertools
import math
import re
from collections.abc import Iterator
from fractions import Fraction as Rational
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import Field, PrivateAttr, field_validator

from isac_rt.scenario_accuracy import Accuracy
from isac_rt.scenario_base import Finite, Fraction, Key, Node, Positive, Problem, Vector
from isac_rt.scenario_clutter import Clutter
from isac_rt.scenario_doubts import implausible


def num_resource_blocks(bandwidth: float, sampling_rate: float, num_tx: int) -> int:
    """floor(T- / (2 T_d)) in rational arithmetic; with r = B/f_s it is (r - 2)/2 + 1 + L_tx (19 for the paper's numbers)."""
    ratio = Rational(bandwidth).limit_denominator() / Rational(sampling_rate).limit_denominator()
    return int((ratio - 2) / 2 + 1 + num_tx)


NEAREST_M = 0.05
"""Two bodies nearer than this are one to the ray tracer."""
FASTEST_MPS = 200.0
FARTHEST_M = 1e5


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
    # builtin: name of a scene that ships with Sionna RT; mitsuba, mesh, footprints: a file beside the scenario
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
                    f"has no meaning with city.source {self.source}, only with {sources}; remove the key or change the source",
                )
        if self.source == "builtin" and not self.name:
            yield Problem((("name",), ("source",)), "city.source builtin needs the name of a scene of Sionna RT, such as munich")
        if self.source in ("mitsuba", "mesh", "footprints") and not self.file:
            yield Problem((("file",), ("source",)), f"city.source {self.source} needs a file, relative to the scenario's folder")


_BUILT = frozenset({"street_width_m", "building_height_m", "height_spread_m", "block_size_m"})
_SURFACES = frozenset({"wall_material", "roof_material", "ground_material", "ground_margin_m"})
CITY_KEYS: dict[str, frozenset[str]] = {
    "builtin": frozenset({"name"}),
    "mitsuba": frozenset({"file"}),
    "mesh": frozenset({"file", "up_axis", "scale", "material", "material_map"}),
    "footprints": frozenset({"file", "coordinates", "height_property", "default_height_m"}) | _SURFACES,
    "canyon": _BUILT | _SURFACES | {"street_length_m"},
    "blocks": _BUILT | _SURFACES | {"blocks_x", "blocks_y"},
}
"""Keys that each source of a city understands, beside source, keep_radius_m and materials."""


class Radio(Node):
    """The chirp and the frame."""

    carrier_hz: Positive = 77e9
    bandwidth_hz: Positive = 640e6
    sampling_rate_hz: Positive = 20e6
    samples_per_chirp: Annotated[int, Field(ge=16, le=65536)] = 1024
    chirps_per_frame: Annotated[int, Field(ge=2, le=4096)] = 120
    groups: Annotated[int, Field(ge=1, le=16)] = 3
    filter_transition_hz: Positive = 0.4e6
    """Width of the IF filter's skirts on each side of its passband [0, sampling rate)."""

    def problems(self) -> Iterator[Problem]:
        if self.bandwidth_hz <= 2 * self.sampling_rate_hz:
            yield Problem(
                (("bandwidth_hz",), ("sampling_rate_hz",)),
                f"{self.bandwidth_hz:g} Hz must exceed twice the sampling rate of {self.sampling_rate_hz:g} Hz; "
                "raise the bandwidth or lower the sampling rate",
            )
        if self.samples_per_chirp % 2:
            yield Problem((("samples_per_chirp",),), "must be even: half of the range cells carry the data symbols")


class Array(Node):
    """L-shaped arrays: elements along X and Z that share the corner."""

    tx_x: Annotated[int, Field(ge=1, le=16)] = 2
    tx_z: Annotated[int, Field(ge=1, le=16)] = 2
    rx_x: Annotated[int, Field(ge=2, le=64)] = 8
    rx_z: Annotated[int, Field(ge=2, le=64)] = 8
    spacing_wavelengths: Positive = 0.5774
    schedule: Literal["pseudo_random", "conventional"] = "pseudo_random"
    fall_back: bool = False
    """Send the conventional schedule instead of the pseudo-random one as long as a receiver finds the scene not sparse."""
    element_pattern: Literal["isotropic", "sector", "cosine"] = "cosine"
    element_gain_dbi: Finite = 5.0
    field_of_view_deg: Annotated[float, Field(gt=0, le=180)] = 120.0


class Modulation(Node):
    """What is on the chirps, and in which frames nothing is."""

    dpsk_order: Literal[2, 4, 8, 16] = 8
    acquisition_frames: Annotated[int, Field(ge=1)] = 3
    """Unmodulated frames at the start, from which every terminal acquires."""
    pilot_every_frames: Annotated[int, Field(ge=2)] | None = 25
    """One unmodulated frame in so many, for late and lost terminals; null: none after the start."""
    streams: dict[str, tuple[Annotated[int, Field(ge=0)], ...]] = Field({})
    """Groups that carry data for a passive terminal, by its name; a terminal that is not named reads them all."""


class Rcs(Node):
    """Radar cross-section of a UAV.

    constant: `value_dbsm`. tr38901: mean of TR 38.901's UAV of small or large size; with `fluctuation_db` it varies
    smoothly with aspect, alike on all links and frames. relative: the reflected path stands `level_db` above the
    reference path of its link (line of sight at a PT, strongest other target at the AT), whatever the geometry.
    """

    model: Literal["constant", "tr38901", "relative"] = "tr38901"
    value_dbsm: Finite = -12.81
    size: Literal["small", "large"] = "small"
    fluctuation_db: Annotated[float, Field(ge=0, le=20)] = 0.0
    level_db: Finite = -20.0


class Waypoint(Node):
    """Where a UAV is at a time after the start of the run."""

    time_s: Finite
    position_m: Vector


class Uav(Node):
    """One UAV: position and velocity, or waypoints with times (flown as a smooth curve through them)."""

    role: Literal["active", "passive", "target"]
    position_m: Vector | None = None
    velocity_mps: Vector = (0.0, 0.0, 0.0)
    waypoints: tuple[Waypoint, ...] | None = None
    boresight: Literal["velocity"] | Vector = "velocity"
    rcs: Rcs = Rcs()
    clock_offset_s: Finite = 0.0
    """By how much the clock is late at time 0: what the UAV sends arrives later by it, what it receives seems earlier."""
    clock_drift_ppm: Finite = 0.0
    """How much later it gets [us/s]; 0.01 ppm against another clock is 3 m/s of apparent velocity."""
    body_radius_m: Annotated[float, Field(ge=0, le=10, allow_inf_nan=False)] = 0.2
    """ray_traced: of the opaque disc that shadows what passes behind it; 0: transparent. No body shadows its own paths and echoes."""
    resource_block: Annotated[int, Field(ge=0)] | None = None
    """First of the consecutive resource blocks, one per group, in which the UAV sends while it is active; null: the lowest that
    the active UAVs before it leave free."""

    @field_validator("boresight", mode="before")
    @classmethod
    def _velocity_or_direction(cls, value: Any) -> Any:
        if value != "velocity" and not (isinstance(value, list | tuple) and len(value) == 3):
            raise ValueError("must be velocity or a direction [x, y, z]")
        if isinstance(value, list | tuple) and not any(value):
            raise ValueError("a direction of length zero points nowhere; give a direction such as [0, 1, 0], or velocity")
        return value

    def applies(self, name: str) -> bool:
        if name == "resource_block":
            return self.role == "active"
        return name != "velocity_mps" or self.waypoints is None

    def problems(self) -> Iterator[Problem]:
        if self.resource_block is not None and self.role != "active":
            said = f"has no meaning for a UAV that is {self.role} at the start (who takes over the role takes over its blocks); remove it"
            yield Problem((("resource_block",), ("role",)), said)
        if self.waypoints is None and self.position_m is None:
            yield Problem((("position_m",),), "missing: a UAV needs either position_m or waypoints")
        if self.waypoints is None:
            return
        if self.position_m is not None:
            yield Problem((("position_m",), ("waypoints",)), "a UAV has either position_m or waypoints, not both; remove one of them")
        if "velocity_mps" in self.model_fields_set:
            yield Problem((("velocity_mps",), ("waypoints",)), "waypoints say how a UAV flies; remove velocity_mps or the waypoints")
        if len(self.waypoints) < 2:
            yield Problem((("waypoints",),), "needs two waypoints or more; for a UAV at rest or in straight flight use position_m")
        for i, (before, after) in enumerate(itertools.pairwise(self.waypoints), start=1):
            if after.time_s <= before.time_s:
                yield Problem(
                    (("waypoints", i, "time_s"), ("waypoints", i - 1, "time_s")),
                    f"must be later than the waypoint before, at {before.time_s:g} s; put the waypoints in the order of their times",
                )

    def place(self, time: float) -> tuple[float, ...]:
        """Position [m] with straight lines between waypoints: near enough to judge an input, not to fly by."""
        if self.waypoints is None:
            assert self.position_m is not None
            return tuple(p + time * v for p, v in zip(self.position_m, self.velocity_mps, strict=True))
        for a, b in itertools.pairwise(self.waypoints):
            if time < b.time_s or b is self.waypoints[-1]:
                share = (time - a.time_s) / (b.time_s - a.time_s)
                return tuple(p + share * (q - p) for p, q in zip(a.position_m, b.position_m, strict=True))
        raise AssertionError("two waypoints at least")


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


class Noise(Node):
    """link_budget: thermal noise and transmit power. snr: per-sample IF SNR of the reference path (the strongest target at
    the AT, the line of sight at a PT) as it would be unshadowed and in view."""

    model: Literal["link_budget", "snr"] = "link_budget"
    tx_power_dbm: Finite = 12.0
    noise_figure_db: Finite = 12.0
    temperature_k: Positive = 290.0
    snr_db: Finite = 10.0


class Receivers(Node):
    """How terminals detect and demodulate."""

    velocity_method: Literal["auto", "omp", "pursuit", "latin_union", "conventional"] = "auto"
    """omp: the paper's, for sparse sampling. pursuit: OMP off the grid, path by path. latin_union: all groups as one uniform sampling, for
    M = L_tx. conventional: the DFT over each antenna's equally spaced chirps, up to the unambiguous velocity divided by L_tx. auto: by the
    schedule and the groups received."""
    refinement: Literal["grid", "local", "joint"] = "local"
    """grid: the centres of range and Doppler cells, the paper's. local: maximum likelihood on the windowed spectra about each peak.
    joint: all paths at once on the samples, at the Cramer-Rao bound; paths in one cell are told apart by direction (slower)."""
    symbol_decision: Literal["powers", "profile", "beams"] = "powers"
    """How a PT reads symbols. powers: the receivers' powers added, the paper's. profile: the same, delay symbols by correlation with the
    range profile of the last unmodulated frame, in which clutter votes with the line of sight. beams: receivers added in phase towards
    the tracked paths, the error of the predicted velocity taken out, and a log-likelihood ratio for every bit."""
    false_alarm_rate: Annotated[float, Field(gt=0, lt=0.1)] = 1e-6
    """Of one cell of the range-Doppler map."""
    guard_cells: tuple[Annotated[int, Field(ge=0)], Annotated[int, Field(ge=0)]] = (3, 3)
    training_cells: tuple[Annotated[int, Field(ge=1)], Annotated[int, Field(ge=1)]] = (8, 6)
    """Range, Doppler; on each side."""
    cluster_cells: tuple[Annotated[int, Field(ge=1)], Annotated[int, Field(ge=1)]] = (1, 1)
    max_detections: Annotated[int, Field(ge=1, le=10_000)] = 64
    min_range_m: Annotated[float, Field(ge=0)] = 2.0
    clutter_filter: Literal["none", "zero_doppler", "runs"] = "none"
    """runs: the paper's. Range cells that lie in a run of occupied ones are cleared of what stands still (AT), or left out of the
    symbol decision (PT). zero_doppler: all range cells are cleared of what stands still at the AT; a PT's line of sight may, so that it
    filters nothing."""
    clutter_run_cells: Annotated[int, Field(ge=2)] = 15
    """Consecutive occupied range cells from which on a run counts as clutter."""
    clutter_detector: Literal["cfar", "map", "angle_doppler", "sample_matrix"] = "cfar"
    """What the AT holds a cell against, after the filter if there is one. cfar: its surroundings. map: the clutter power that the city's
    mesh predicts. angle_doppler: filtered over the antennas with the covariance that the mesh and the terminal's own velocity predict.
    sample_matrix: filtered with the covariance of the cells around. map and angle_doppler first correct the own velocity and the
    clutter's level by the frame."""
    clutter_channels: Literal["arms", "joint"] = "arms"
    """angle_doppler, sample_matrix: filter each arm of the virtual L by itself, or both jointly (several times slower)."""
    active_every_frames: Annotated[int, Field(ge=1)] = 1
    """The AT processes one frame in so many."""
    active_input: Literal["samples", "profiles"] = "samples"
    """samples: the AT transforms IF samples. profiles: range profiles made directly (`isac_rt.ifsignal.range_profiles`), faster."""

    def problems(self) -> Iterator[Problem]:
        if self.active_input == "profiles" and self.refinement == "joint":
            yield Problem((("active_input",), ("refinement",)), "joint refinement needs samples; set active_input: samples or another one")


class Tracking(Node):
    """The Kalman filters and the life of a track."""

    acceleration_std_mps2: Positive = 1.0
    gate_probability: Annotated[float, Field(gt=0.5, lt=1)] = 0.999
    confirm_hits: Annotated[int, Field(ge=1)] = 3
    confirm_window: Annotated[int, Field(ge=1)] = 5
    drop_misses: Annotated[int, Field(ge=1)] = 8

    def problems(self) -> Iterator[Problem]:
        if self.confirm_hits > self.confirm_window:
            yield Problem(
                (("confirm_hits",), ("confirm_window",)),
                f"{self.confirm_hits} hits cannot be reached within confirm_window = {self.confirm_window}; lower it or widen the window",
            )


class Access(Node):
    """How terminals find each other before the first frame."""

    establish: bool = False
    """Go through the stages before the data (`isac_rt.access.establish`): active terminals listen for free blocks and announce theirs,
    clocks are measured, links acknowledged, with every wrong decision that the noise brings. Else blocks and links are as stated."""
    synchronisation: Literal["external", "two_round", "none"] = "external"
    """external: an outside source keeps all clocks equal. two_round: passive terminals correct theirs by what the stages measured.
    none: nobody corrects anything."""
    feedback: bool = False
    """After every frame that the active terminals process, the passive ones report their range and their symbols, and the active ones,
    which have the same distance from their echoes, answer by how many whole range cells it is off."""


class RoleChange(Node):
    """An active terminal and a passive one change places."""

    frame: Annotated[int, Field(ge=1)]
    """First frame in the new roles; acquisition frames follow, as at the start."""
    from_uav: str
    """Active until then, passive from then on."""
    to_uav: str
    """Passive until then; takes over the role and the resource blocks."""


class Scenario(Node):
    """Everything that a run depends on."""

    name: str = "unnamed"
    seed: Annotated[int, Field(ge=0)] = 1
    frames: Annotated[int, Field(ge=1, le=1_000_000)] = 100
    frame_interval_s: Positive | None = None
    """From the start of a frame to the next; null: contiguous frames."""
    radio: Radio = Radio()
    array: Array = Array()
    modulation: Modulation = Modulation()
    swarm: dict[str, Uav]
    role_changes: tuple[RoleChange, ...] = ()
    access: Access = Access()
    city: City | None = None
    propagation: Propagation = Propagation()
    accuracy: Accuracy = Accuracy()
    clutter: Clutter = Clutter()
    noise: Noise = Noise()
    receivers: Receivers = Receivers()
    tracking: Tracking = Tracking()

    _folder: Path = PrivateAttr(default=Path())

    @property
    def folder(self) -> Path:
        """Folder of the scenario file, to which `city.file` and `accuracy.cost_model` are relative; the working folder for a tree made in
        Python."""
        return self._folder

    def in_folder(self, folder: Path) -> Scenario:
        """The same scenario with its files looked for beside another place."""
        scenario = self.model_copy()
        scenario._folder = folder
        return scenario

    def city_path(self) -> Path:
        """The city's file, found from the scenario's folder.

        Raises
        ------
        ValueError
            If the scenario has no city with a file.
        """
        if self.city is None or self.city.file is None:
            raise ValueError("the scenario has no city.file")
        return self.folder / self.city.file

    def cost_model_path(self) -> Path | None:
        """The file of accuracy.cost_model, found from the scenario's folder; None for the costs that ship with the program."""
        return None if self.accuracy.cost_model is None else self.folder / self.accuracy.cost_model

    @property
    def num_tx(self) -> int:
        """L_tx, elements of the transmitting L."""
        return self.array.tx_x + self.array.tx_z - 1

    @property
    def frame_duration_s(self) -> float:
        """P T-, as `Waveform` has it: T- = T + 2 (1 + L_tx) T_d with T_d = f_s T / (B - 2 f_s)."""
        r = self.radio
        sampled = r.samples_per_chirp / r.sampling_rate_hz
        max_delay = r.samples_per_chirp / (r.bandwidth_hz - 2 * r.sampling_rate_hz)
        return r.chirps_per_frame * (sampled + 2 * (1 + self.num_tx) * max_delay)

    def problems(self) -> Iterator[Problem]:
        yield from self._timing_problems()
        yield from self._swarm_problems()
        yield from self._role_problems()
        yield from self._block_problems()
        yield from self._model_problems()

    def _timing_problems(self) -> Iterator[Problem]:
        sizes = (("array", "tx_x"), ("array", "tx_z"))
        antennas = f"the {self.num_tx} transmit antennas (array.tx_x + array.tx_z - 1)"
        if self.radio.chirps_per_frame % self.num_tx:
            yield Problem(
                (("radio", "chirps_per_frame"), *sizes),
                f"{self.radio.chirps_per_frame} chirps are not a multiple of {antennas}; every antenna needs the same number of slots",
            )
        if self.radio.groups > self.num_tx:
            said = f"{self.radio.groups} groups are more than {antennas}; use fewer groups or more transmit antennas"
            yield Problem((("radio", "groups"), *sizes), said)
        if self.frame_interval_s is not None and self.frame_interval_s < self.frame_duration_s * (1 - 1e-12):
            yield Problem(
                (("frame_interval_s",), ("radio", "chirps_per_frame"), ("radio", "samples_per_chirp")),
                f"is shorter than a frame, which lasts {self.frame_duration_s:.7g} s; lengthen it, or leave it out for contiguous frames",
            )
        if self.modulation.acquisition_frames >= self.frames:
            yield Problem(
                (("modulation", "acquisition_frames"), ("frames",)),
                f"{self.modulation.acquisition_frames} acquisition frames leave none of the {self.frames} frames for data; "
                "run more frames or set modulation.acquisition_frames lower",
            )

    def _swarm_problems(self) -> Iterator[Problem]:
        for name in self.swarm:
            if not re.fullmatch(r"[A-Za-z0-9_-]+", name):
                yield Problem((("swarm", name),), "a UAV's name may hold letters, digits, _ and - only; rename it")
        active = [name for name, uav in self.swarm.items() if uav.role == "active"]
        if not active:
            yield Problem((("swarm",),), "no UAV has the role active; give it to the one that transmits")
        for (a, first), (b, second) in itertools.combinations(self.swarm.items(), 2):
            apart = math.dist(first.place(0.0), second.place(0.0))
            if apart < NEAREST_M:
                key = "position_m" if second.waypoints is None else "waypoints"
                yield Problem(
                    (("swarm", b, key), ("swarm", a)),
                    f"{a} and {b} are {apart:.3g} m apart at the start, at least {NEAREST_M} m are needed; move one of them",
                )

    def _role_problems(self) -> Iterator[Problem]:
        roles, last = {name: uav.role for name, uav in self.swarm.items()}, 0
        ever_passive = {name for name, role in roles.items() if role == "passive"}
        for i, change in enumerate(self.role_changes):
            key = ("role_changes", i)
            if change.frame <= last or change.frame >= self.frames:
                said = f"must be after {last} (the change before it) and below the number of frames, {self.frames}"
                yield Problem(((*key, "frame"), ("frames",)), said)
            last = max(last, change.frame)
            for end, name, role in (("from_uav", change.from_uav, "active"), ("to_uav", change.to_uav, "passive")):
                if roles.get(name) != role:
                    now = f"is {roles[name]}" if name in roles else "is not in the swarm"
                    yield Problem(((*key, end), ("swarm",)), f"{name} {now}; name a UAV that is {role} then")
            roles |= {change.from_uav: "passive", change.to_uav: "active"}
            ever_passive.add(change.from_uav)
        if self.access.synchronisation == "two_round" and not self.access.establish:
            said = "two_round measures clocks in the stages before the data; set access.establish: true, or take external or none"
            yield Problem((("access", "synchronisation"), ("access", "establish")), said)
        if self.access.synchronisation == "none" and self.access.feedback:
            said = "feedback compares ranges of two terminals, which need the same clock; leave it out, or take external or two_round"
            yield Problem((("access", "feedback"), ("access", "synchronisation")), said)
        if self.access.establish and self.role_changes:
            said = "the stages are gone through once, before the first frame; a change of roles needs them again; leave one of the two out"
            yield Problem((("access", "establish"), ("role_changes",)), said)
        for name, groups in self.modulation.streams.items():
            stream: Key = ("modulation", "streams", name)
            if name not in ever_passive:
                yield Problem((stream, ("swarm",)), "is never a passive terminal of the swarm; name one that receives")
            if not groups or len(set(groups)) < len(groups) or max(groups, default=0) >= self.radio.groups:
                said = f"needs one group or more of 0 to {self.radio.groups - 1} (radio.groups = {self.radio.groups}), each once"
                yield Problem((stream, ("radio", "groups")), said)

    def _block_problems(self) -> Iterator[Problem]:
        r = self.radio
        limit = num_resource_blocks(r.bandwidth_hz, r.sampling_rate_hz, self.num_tx)
        for name, first in self.first_blocks().items():
            if first + r.groups > limit:
                yield Problem(
                    (("swarm", name, "resource_block"), ("radio", "groups"), ("radio", "bandwidth_hz")),
                    f"{name} would need the resource blocks {first} to {first + r.groups - 1}; a slot has {limit} (0 to {limit - 1}); "
                    "choose a lower block, fewer groups or fewer active UAVs",
                )

    def first_blocks(self) -> dict[str, int]:
        """First resource block of every UAV that is active at the start; a successor takes over its predecessor's."""
        active = {name: uav for name, uav in self.swarm.items() if uav.role == "active"}
        out = {name: uav.resource_block for name, uav in active.items() if uav.resource_block is not None}
        taken = {block + i for block in out.values() for i in range(self.radio.groups)}
        for name in active:
            if name not in out:
                block = 0
                while taken & set(range(block, block + self.radio.groups)):
                    block += 1
                out[name] = block
                taken |= set(range(block, block + self.radio.groups))
        return {name: out[name] for name in active}

    def _model_problems(self) -> Iterator[Problem]:
        for name, uav in self.swarm.items():
            if uav.rcs.model == "relative" and self.propagation.model != "free_space":
                yield Problem(
                    (("swarm", name, "rcs", "model"), ("propagation", "model")),
                    "relative goes with propagation.model free_space only: a traced echo needs a radar cross-section; "
                    "use constant or tr38901",
                )
            if uav.rcs.model == "relative" and self.noise.model != "snr":
                yield Problem(
                    (("swarm", name, "rcs", "model"), ("noise", "model")),
                    "relative goes with noise.model snr only: a link budget needs a radar cross-section; use constant or tr38901",
                )
        if self.clutter.model in ("diffuse", "field") and (self.propagation.model != "ray_traced" or self.city is None):
            yield Problem(
                (("clutter", "model"), ("propagation", "model"), ("city",)),
                f"{self.clutter.model} needs propagation.model ray_traced and a city to scatter from; "
                "add them or set clutter.model to none",
            )
        if self.receivers.clutter_detector in ("map", "angle_doppler") and (self.propagation.model != "ray_traced" or self.city is None):
            yield Problem(
                (("receivers", "clutter_detector"), ("propagation", "model"), ("city",)),
                f"{self.receivers.clutter_detector} predicts clutter from a city's mesh: it needs propagation.model ray_traced and a city; "
                "add them or set receivers.clutter_detector to cfar or sample_matrix",
            )

    def doubts(self) -> Iterator[Problem]:
        """What may stand but is probably not meant: values in the wrong unit, active UAVs that talk over each other."""
        for (a, first), (b, second) in itertools.combinations(self.first_blocks().items(), 2):
            if abs(first - second) < self.radio.groups:
                yield Problem((("swarm", b, "resource_block"),), f"{b} and {a} send in the same resource blocks; shall they collide?")
        yield from implausible(self)
        for name, uav in self.swarm.items():
            if uav.waypoints is None:
                speeds: list[tuple[Key, float]] = [(("swarm", name, "velocity_mps"), math.hypot(*uav.velocity_mps))]
                places: list[tuple[Key, tuple[float, ...]]] = [(("swarm", name, "position_m"), uav.place(0.0))]
            else:
                legs = enumerate(itertools.pairwise(uav.waypoints), start=1)
                key = ("swarm", name, "waypoints")
                speeds = [((*key, i), math.dist(a.position_m, b.position_m) / (b.time_s - a.time_s)) for i, (a, b) in legs]
                places = [((*key, i, "position_m"), w.position_m) for i, w in enumerate(uav.waypoints)]
            for where, speed in speeds:
                if speed > FASTEST_MPS:
                    yield Problem((where,), f"flies at {speed:.4g} m/s, more than {FASTEST_MPS:g}; is it in metres and seconds?")
            for where, place in places:
                if math.hypot(*place) > FARTHEST_M:
                    yield Problem((where,), f"lies {math.hypot(*place):.4g} m from the origin, more than {FARTHEST_M:g}; is it in metres?")


def json_schema() -> dict[str, Any]:
    """JSON Schema of a scenario file, for editors; docstrings become descriptions."""
    return {"$schema": "https://json-schema.org/draft/2020-12/schema", **Scenario.model_json_schema()}
