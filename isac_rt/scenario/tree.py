"""The whole input of a run as a frozen, typed tree, and what must hold between its values.

Units stand in the key names. Unknown keys are refused. Everything inside the program is SI, radians
and linear power; the conversions from decibels and degrees happen where a value leaves this tree.
Files are read and written by `isac_rt.scenario.file`.
"""

from __future__ import annotations

import ast
import inspect
import itertools
import math
import textwrap
from collections.abc import Callable, Iterator, Sequence, Set
from contextlib import suppress
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal

from pydantic import Field, ModelWrapValidatorHandler, PrivateAttr, TypeAdapter, model_validator

from isac_rt import registry
from isac_rt.frame.access import Access
from isac_rt.frame.front_end import Elements, FrontEnd
from isac_rt.frame.settings import Array, Modulation, Noise, RoleChange
from isac_rt.propagation.settings import Clutter, Propagation, Weather
from isac_rt.receive.settings import Receivers
from isac_rt.scenario.emitters import FLIGHT, Emitter
from isac_rt.scenario.presets import Preset, ReceiverSet, with_preset
from isac_rt.scenario.radio import Radio
from isac_rt.scenario.sensors import SENSORS, BoardFile, Sensor, with_sensor
from isac_rt.scenario.swarm import HARDWARE, Uav, formations, unfolded
from isac_rt.settings import Key, Name, Node, Positive, Problem, Seed, dotted
from isac_rt.signal.settings import Accuracy
from isac_rt.track.settings import Belief, Tracking
from isac_rt.world.settings import TERMINAL_ROLES, City, Formation

_PARTS = {
    "clutter_detector": registry.DETECTORS,
    "passive_detector": registry.PASSIVE_DETECTORS,
    "symbol_decision": registry.SYMBOL_READERS,
}
OWN = "own"
"""Name of the scenario's own receivers beside those compared with them."""
NEAREST_M = 0.05
"""Two UAVs nearer than this are one to the ray tracer."""


class Scenario(Node):
    """Everything that a run depends on."""

    REMOVED: ClassVar[dict[str, str]] = {"cooperation: detections": "cooperation: tracks"}

    name: Name = "unnamed"
    """Name of the scenario, which titles results and names the folder they go to by default. It may
    hold letters, digits, _ and - only. By default that of its file."""
    seed: Seed = 1
    """Number that all randomness follows from: the same seed gives the same bits, another seed
    another draw of noise, data and clutter. The default is as good as any other."""
    frames: Annotated[int, Field(ge=1, le=1_000_000)] = 100
    """Number of frames to simulate; more than `modulation.acquisition_frames`, or no data flow. The
    run's time and the size of its results grow with it. The default
    is 0.8 s of flight, or longer with `frame_interval_s`."""
    frame_interval_s: Positive | None = None
    """Time from the start of a frame to the start of the next [s], at least a frame long. null, the
    default: frames follow each other without a pause."""
    sensor: Sensor | BoardFile | None = None
    """A plain FMCW sensor: `awr1642`, `awr1843`, `awr2243`, `awr2243_cascade`, `awr2944`,
    `iwr1443`, `iwr6843`, `bgt24mtr12`, or a board's `.cfg` or `.mmwave.json`. It fills in `radio`,
    `array` and `noise`, which keys stated there override. null, the default: none."""
    radio: Radio = Radio()
    """The chirp and the frame. By default the paper's."""
    array: Array = Array()
    """The antenna arrays of every terminal. By default the paper's."""
    modulation: Modulation = Modulation()
    """The data on the chirps, and the frames that carry none. By default the paper's 8-DPSK."""
    swarm: dict[Name, Uav]
    """The UAVs by name, at least one of them active. A name may hold letters, digits, _ and -
    only."""
    role_changes: tuple[RoleChange, ...] = ()
    """Changes of roles during the flight, in the order of their frames. By default every UAV keeps
    its role."""
    access: Access = Access()
    """How the terminals find each other before the first frame. By default links are as stated."""
    city: City | None = None
    """The city's mesh. null, the default: open space."""
    propagation: Propagation = Propagation()
    """Which paths there are between the terminals and by way of the targets. By default those of
    free space."""
    accuracy: Accuracy = Accuracy()
    """How near to the full model a run has to come. By default errors stay well under the noise, at
    a fraction of the time."""
    clutter: Clutter = Clutter()
    """What is received beside lines of sight, targets, ghosts and mirror images. By default
    nothing."""
    weather: Weather | None = None
    """Air and rain on the paths. null, the default: vacuum."""
    emitters: dict[Name, Emitter] = Field({})
    """Foreign FMCW radars by name. By default none."""
    noise: Noise = Noise()
    """How strong the receiver's noise is: by a link budget, the default, or by a stated SNR."""
    receiver_preset: Preset | None = None
    """Settings of `receivers` and `tracking` by name, which stated keys override. `paper`: the
    paper's. `plain`: better estimates, no knowledge of the city. `city`: uses the mesh. null, the
    default: `city` in a traced city, else `plain`."""
    receivers: Receivers = Receivers()
    """How terminals detect targets and decode data. By default by CFAR and added powers."""
    tracking: Tracking = Tracking()
    """The Kalman filters, and when a track begins and ends. By default for gentle flight."""
    belief: Belief = Belief()
    """What terminals believe wrongly of themselves and of the city. By default nothing."""
    cooperation: Literal["none", "tracks"] = "none"
    """Exchange between terminals. `none`, the default. `tracks`: confirmed tracks and own
    positions, with an active terminal's data or a passive one's feedback; each terminal fuses
    them."""
    compare: dict[Name, ReceiverSet] = Field({})
    """Further sets of receivers by name, which receive the same samples. By default none."""

    _folder: Path = PrivateAttr(default=Path())
    _formations: dict[str, Formation] = PrivateAttr(default={})

    @model_validator(mode="wrap")
    @classmethod
    def _remember(cls, data: Any, check: ModelWrapValidatorHandler[Scenario]) -> Scenario:
        """Keep which UAVs were stated as formations."""
        scenario = check(data)
        if isinstance(data, dict):
            scenario._formations = formations(data.get("swarm"))
        return scenario

    @model_validator(mode="before")
    @classmethod
    def _presets(cls, data: Any) -> Any:
        return _with_presets(data)

    @property
    def folder(self) -> Path:
        """Folder of the scenario file, to which `city.file` and `radio.calibration` are
        relative; the working folder for a tree made in Python."""
        return self._folder

    def in_folder(self, folder: Path) -> Scenario:
        """The same scenario with its files looked for beside another place."""
        scenario = self.model_copy()
        scenario._folder = folder
        return scenario

    @property
    def formations(self) -> dict[str, Formation]:
        """The formations of the swarm by the name that they were stated under; its members stand in
        `swarm` as NAME_1, NAME_2 and so on."""
        return dict(self._formations)

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

    def calibration_path(self) -> Path | None:
        """The file of radio.calibration, found from the scenario's folder; None without one."""
        return None if self.radio.calibration is None else self.folder / self.radio.calibration

    def by_chirp(self) -> tuple[Scenario, ...]:
        """The scenario as the radars of each chirp and clock have it for themselves: their `radio`
        is that of all, the other radars are targets, and emitters where their chirps sweep over the
        same frequencies and send a stated power. The common chirp comes first; where all have it on
        one clock, this very scenario is returned."""
        radars = [n for n, u in self.swarm.items() if u.role == "active"]
        if self.radio.mode != "fmcw" or not radars:
            return (self,)
        timed = [self._chirp_of(name) for name in radars]
        chirps = [(self.radio, self.num_tx, *timed[0][2:]), *timed]
        different = [c for i, c in enumerate(chirps) if c not in chirps[:i]]
        groups = [[n for n in radars if self._chirp_of(n) == chirp] for chirp in different]
        if len(groups[0]) == len(radars):
            return (self,)
        parts = [self._alone(names) for names in groups if names]
        return tuple(part._among([one for one in parts if one is not part]) for part in parts)

    def _chirp_of(self, name: str) -> tuple[Radio, int, float, float]:
        """Return the radio, the number of transmit elements, and the clock of a terminal."""
        uav = self.swarm[name]
        num_tx = (uav.array or self.array).num_tx
        return uav.radio or self.radio, num_tx, uav.clock_offset_s, uav.clock_drift_ppm

    def _alone(self, names: Sequence[str]) -> Scenario:
        """Return the scenario of some radars of one chirp, the other radars as targets."""
        first, swarm = self.swarm[names[0]], dict[str, Uav]()
        for name, uav in self.swarm.items():
            hidden = ("sensor", "radio") if name in names or uav.role != "active" else HARDWARE
            role = uav.role if name in names or uav.role == "object" else "target"
            swarm[name] = uav.model_copy(update=dict.fromkeys(hidden) | {"role": role})
        shared = {"radio": first.radio or self.radio, "array": first.array or self.array}
        interval = self.frame_interval_s or self.frame_duration_s
        alone = {"sensor": None, "swarm": swarm, "frame_interval_s": interval}
        return self.model_copy(update=shared | alone)

    def _among(self, others: Sequence[Scenario]) -> Scenario:
        """Return the scenario of some radars with those of other chirps as emitters."""
        emitters = dict(self.emitters)
        if self.noise.model == "link_budget":
            low, high = self._band
            for one in others:
                if max(low, one._band[0]) < min(high, one._band[1]):
                    names = [name for name, uav in one.swarm.items() if uav.role == "active"]
                    emitters |= {name: one._as_emitter(name) for name in names}
        return self.model_copy(update={"emitters": emitters})

    @property
    def _band(self) -> tuple[float, float]:
        """Frequencies at the start and the end of a chirp [Hz]."""
        return self.radio.carrier_hz, self.radio.carrier_hz + self.radio.bandwidth_hz

    def _as_emitter(self, name: str) -> Emitter:
        """Return an active radar as what others receive of it; antennas that send at once add their
        powers."""
        uav, times = self.swarm[name], self.radio.times(self.num_tx)
        at_once = self.num_tx if self.radio.bands(self.num_tx) > 1 else 1
        slope = self.radio.bandwidth_hz / times.chirp * 1e-12
        if self.radio.chirp is not None:
            slope = self.radio.chirp.slope_mhz_per_us
        late = self.first_blocks()[name] * 2 * times.max_delay + uav.clock_offset_s
        return Emitter.model_construct(
            **{key: getattr(uav, key) for key in FLIGHT if key in uav.model_fields_set},
            power_dbm=self.noise_of(name).tx_power_dbm + 10 * math.log10(at_once),
            array=uav.array or self.array,
            start_hz=self.radio.carrier_hz,
            slope_mhz_per_us=slope,
            ramp_us=times.chirp * 1e6,
            idle_us=(times.slot - times.chirp) * 1e6,
            offset_us=late * 1e6,
            clock_drift_ppm=uav.clock_drift_ppm,
            burst_chirps=self.radio.chirps_per_frame,
            burst_interval_s=self.frame_interval_s,
        )

    @property
    def num_tx(self) -> int:
        """L_tx, transmit elements."""
        return self.array.num_tx

    @property
    def schedule(self) -> str:
        """Order in which transmit antennas take the slots: `array.schedule`; in a plain radar one
        after the other."""
        return self.array.schedule if self.radio.mode == "isac" else "conventional"

    @property
    def num_rx(self) -> int:
        """L_rx, receive elements."""
        return self.array.num_rx

    @property
    def frame_duration_s(self) -> float:
        """P T-, the longest terminal's frame without the pause that `frame_interval_s` may leave
        after it."""
        radars = [name for name, uav in self.swarm.items() if uav.role == "active"]
        chirps = [self._chirp_of(name)[:2] for name in radars] or [(self.radio, self.num_tx)]
        return max(radio.chirps_per_frame * radio.times(num_tx).slot for radio, num_tx in chirps)

    @property
    def flight_duration_s(self) -> float:
        """Time from the start of the first frame to the end of the last and its pause."""
        return self.frames * (self.frame_interval_s or self.frame_duration_s)

    def problems(self) -> Iterator[Problem]:
        for rule in self._rules():
            yield from rule()

    def _rules(self) -> tuple[Callable[[], Iterator[Problem]], ...]:
        """Return the rules between the nodes, each of which reads few of them."""
        return (
            self._slot_problems,
            self._interval_problems,
            self._acquisition_problems,
            self._fmcw_role_problems,
            self._fmcw_access_problems,
            self._fmcw_array_problems,
            self._fmcw_receiver_problems,
            self._swarm_problems,
            self._role_problems,
            self._access_problems,
            self._stream_problems,
            self._block_problems,
            self._rcs_problems,
            self._clutter_problems,
            self._weather_problems,
            self._emitter_problems,
            self._detector_problems,
            self._initiation_problems,
            self._calibration_problems,
            self._hardware_problems,
            self._own_chirp_problems,
            self._front_end_problems,
            self._self_calibration_problems,
            self._set_problems,
            self._sensor_problems,
        )

    @classmethod
    def checked_together(cls, data: Any, broken: Set[str]) -> list[Problem]:
        """List what the rules find that read none of the `broken` nodes."""
        prepared, values = _with_presets(data), {}
        for name, field in cls.model_fields.items():
            if name in prepared and name not in broken:
                kind: Any = Annotated[field.annotation, field]
                values[name] = TypeAdapter(kind).validate_python(prepared[name])
        scenario = cls.model_construct(**values)
        for name in broken & cls.model_fields.keys():
            scenario.__dict__.pop(name, None)  # whoever reads it meets an AttributeError
        problems: list[Problem] = []
        for rule in scenario._rules():
            with suppress(AttributeError):
                for problem in rule():
                    problems.append(problem)
        return problems

    def _slot_problems(self) -> Iterator[Problem]:
        sizes = (("array", "tx_x"), ("array", "tx_z"))
        of = " (array.tx_x + array.tx_z - 1)" if self.array.tx is None else ""
        antennas = f"the {self.num_tx} transmit antennas{of}"
        if self.radio.bands(self.num_tx) > 1:
            yield from self._code_problems()
        elif self.radio.chirps_per_frame % self.num_tx:
            yield Problem(
                (("radio", "chirps_per_frame"), *sizes),
                f"{self.radio.chirps_per_frame} chirps are not a multiple of {antennas}; every "
                "antenna needs the same number of slots",
            )
        if self.radio.groups > self.num_tx:
            message = (
                f"{self.radio.groups} groups are more than {antennas}; use fewer groups or more "
                "transmit antennas"
            )
            yield Problem((("radio", "groups"), *sizes), message)

    def _interval_problems(self) -> Iterator[Problem]:
        if self.frame_interval_s is not None and self.frame_interval_s < self.frame_duration_s * (
            1 - 1e-12
        ):
            yield Problem(
                (
                    ("frame_interval_s",),
                    ("radio", "chirps_per_frame"),
                    ("radio", "samples_per_chirp"),
                ),
                f"is shorter than a frame, which lasts {self.frame_duration_s:.7g} s; lengthen it, "
                "or leave it out for contiguous frames",
            )

    def _acquisition_problems(self) -> Iterator[Problem]:
        carries = self.radio.mode == "isac"
        if carries and self.modulation.acquisition_frames >= self.frames:
            yield Problem(
                (("modulation", "acquisition_frames"), ("frames",)),
                f"{self.modulation.acquisition_frames} acquisition frames leave none of the "
                f"{self.frames} frames for data; "
                "run more frames or set modulation.acquisition_frames lower",
            )

    def _code_problems(self) -> Iterator[Problem]:
        """List what antennas that send at once lack."""
        r, sizes = self.radio, (("array", "tx_x"), ("array", "tx_z"))
        bands = r.bands(self.num_tx)
        if bands < self.num_tx:
            yield Problem(
                (("radio", "sub_bands"), *sizes),
                f"{bands} do not hold the {self.num_tx} transmit antennas; take as many at least",
            )
        if r.chirps_per_frame % bands:
            yield Problem(
                (("radio", "chirps_per_frame"), ("radio", "sub_bands"), *sizes),
                f"{r.chirps_per_frame} chirps are not a multiple of the {bands} sub_bands of "
                f"scheme {r.scheme}; change one of them",
            )

    def _fmcw_role_problems(self) -> Iterator[Problem]:
        if self.radio.mode == "isac":
            return
        for name, uav in self.swarm.items():
            if uav.role == "passive":
                message = "mode fmcw has no passive terminals; make it a target, or active"
                yield Problem((("swarm", name, "role"), ("radio", "mode")), message)

    def _fmcw_access_problems(self) -> Iterator[Problem]:
        if self.radio.mode == "isac":
            return
        for key in ("establish", "feedback"):
            if getattr(self.access, key):
                message = "mode fmcw has no links between terminals; leave it out"
                yield Problem((("access", key), ("radio", "mode")), message)

    def _fmcw_array_problems(self) -> Iterator[Problem]:
        r = self.radio
        if r.mode == "isac":
            return
        if self.array.fall_back:
            message = "mode fmcw has its own order of antennas (radio.scheme); leave it out"
            yield Problem((("array", "fall_back"), ("radio", "mode")), message)
        if r.scheme == "simo" and self.num_tx != 1:
            yield Problem(
                (("radio", "scheme"), ("array", "tx_x"), ("array", "tx_z")),
                f"simo sends from one antenna, and there are {self.num_tx}; set array.tx_x and "
                "array.tx_z to 1, or take another scheme",
            )

    def _fmcw_receiver_problems(self) -> Iterator[Problem]:
        """List what a plain radar's receivers cannot do."""
        r = self.radio
        if r.mode == "isac":
            return
        usual: dict[str, tuple[str, ...]] = {
            "velocity_method": ("auto", "latin_union", "conventional")
        }
        if r.bands(self.num_tx) > 1:
            usual = {
                "velocity_method": ("auto",),
                "refinement": ("local", "grid"),
                "clutter_filter": ("none", "zero_doppler"),
            }
        elif r.scheme == "tdm":
            usual = {"velocity_method": ("auto", "conventional")}
        for at, receivers in self._all_receivers().items():
            for key, values in usual.items():
                if not _fits(key, value := getattr(receivers, key), values):
                    yield Problem(
                        ((*at, key), ("radio", "scheme")),
                        f"{value} is not made for mode fmcw with scheme {r.scheme}; use "
                        f"{' or '.join(values)}, or another scheme",
                    )

    def _all_receivers(self) -> dict[Key, Receivers]:
        """The scenario's own receivers and those compared with them, by their keys."""
        sets: dict[Key, Receivers] = {("receivers",): self.receivers}
        return sets | {("compare", n, "receivers"): x.receivers for n, x in self.compare.items()}

    def _swarm_problems(self) -> Iterator[Problem]:
        active = [name for name, uav in self.swarm.items() if uav.role == "active"]
        if not active:
            yield Problem(
                (("swarm",),), "no UAV has the role active; give it to the one that transmits"
            )
        for (a, first), (b, second) in itertools.combinations(self.swarm.items(), 2):
            distance = math.dist(first.position_at(0.0), second.position_at(0.0))
            if distance < NEAREST_M:
                key = "position_m" if second.waypoints is None else "waypoints"
                yield Problem(
                    (("swarm", b, key), ("swarm", a)),
                    f"{a} and {b} are {distance:.3g} m apart at the start, at least {NEAREST_M} m "
                    "are needed; move one of them",
                )

    def _role_problems(self) -> Iterator[Problem]:
        roles, last = {name: uav.role for name, uav in self.swarm.items()}, 0
        for i, change in enumerate(self.role_changes):
            key = ("role_changes", i)
            if change.frame <= last or change.frame >= self.frames:
                message = (
                    f"must be after {last} (the change before it) and below the number of "
                    f"frames, {self.frames}"
                )
                yield Problem(((*key, "frame"), ("frames",)), message)
            last = max(last, change.frame)
            for end, name, role in (
                ("from_uav", change.from_uav, "active"),
                ("to_uav", change.to_uav, "passive"),
            ):
                if roles.get(name) != role:
                    now = f"is {roles[name]}" if name in roles else "is not in the swarm"
                    yield Problem(
                        ((*key, end), ("swarm",)), f"{name} {now}; name a UAV that is {role} then"
                    )
            roles |= {change.from_uav: "passive", change.to_uav: "active"}

    def _access_problems(self) -> Iterator[Problem]:
        if self.access.synchronisation == "two_round" and not self.access.establish:
            message = (
                "two_round measures clocks in the stages before the data; set access.establish: "
                "true, or take external or none"
            )
            yield Problem((("access", "synchronisation"), ("access", "establish")), message)
        if self.access.synchronisation == "none" and self.access.feedback:
            message = (
                "feedback compares ranges of two terminals, which need the same clock; leave it "
                "out, or take external or two_round"
            )
            yield Problem((("access", "feedback"), ("access", "synchronisation")), message)
        if self.access.establish and self.role_changes:
            message = (
                "the stages are gone through once, before the first frame; a change of roles "
                "needs them again; leave one of the two out"
            )
            yield Problem((("access", "establish"), ("role_changes",)), message)

    def _stream_problems(self) -> Iterator[Problem]:
        ever_passive = {name for name, uav in self.swarm.items() if uav.role == "passive"}
        ever_passive |= {change.from_uav for change in self.role_changes}
        for name, groups in self.modulation.streams.items():
            stream: Key = ("modulation", "streams", name)
            if name not in ever_passive:
                yield Problem(
                    (stream, ("swarm",)),
                    "is never a passive terminal of the swarm; name one that receives",
                )
            if (
                not groups
                or len(set(groups)) < len(groups)
                or max(groups, default=0) >= self.radio.groups
            ):
                message = (
                    f"needs one group or more of 0 to {self.radio.groups - 1} (radio.groups = "
                    f"{self.radio.groups}), each once"
                )
                yield Problem((stream, ("radio", "groups")), message)

    def _own_chirp_problems(self) -> Iterator[Problem]:
        """List what terminals cannot have of a chirp of their own."""
        for name, uav in self.swarm.items():
            stated = [key for key in ("sensor", "radio") if getattr(uav, key) is not None]
            if stated and self.radio.mode == "isac":
                message = "terminals that send data share the chirp; leave it out, or set "
                keys = ("swarm", name, stated[0]), ("radio", "mode")
                yield Problem(keys, f"{message}radio.mode: fmcw for all")
            elif uav.radio is not None and uav.radio.mode == "isac":
                message = "is isac, and radio.mode of all terminals is fmcw; leave it out"
                yield Problem((("swarm", name, "radio", "mode"), ("radio", "mode")), message)
                return
        for one in self.by_chirp():
            if one is not self:
                yield from self._problems_alone(one)

    def _problems_alone(self, alone: Scenario) -> Iterator[Problem]:
        """List what is wrong with the radars of one chirp, by the keys under which they state
        it."""
        name = next(n for n, u in alone.swarm.items() if u.role == "active")
        rules = [
            alone._slot_problems,
            alone._fmcw_array_problems,
            alone._block_problems,
            alone._self_calibration_problems,
            alone._calibration_problems,
            alone._front_end_problems,
            alone._weather_problems,
        ]
        if alone.radio.scheme != self.radio.scheme:
            rules.append(alone._fmcw_receiver_problems)
        for rule in rules:
            for problem in rule():
                keys = tuple(
                    ("swarm", name, *key) if key[0] in ("radio", "array") else key
                    for key in problem.keys
                )
                yield Problem(keys, problem.text)

    def _block_problems(self) -> Iterator[Problem]:
        if self.by_chirp()[0] is not self:
            return
        r = self.radio
        limit = r.num_blocks(self.num_tx)
        for name, first in self.first_blocks().items():
            if first + r.groups > limit:
                yield Problem(
                    (
                        ("swarm", name, "resource_block"),
                        ("radio", "groups"),
                        ("radio", "bandwidth_hz"),
                    ),
                    f"{name} would need the resource blocks {first} to {first + r.groups - 1}; a "
                    f"slot has {limit} (0 to {limit - 1}); "
                    "choose a lower block, fewer groups or fewer active UAVs",
                )

    def front_end_of(self, name: str) -> FrontEnd:
        """The hardware of a terminal: its own, or that of all."""
        uav = self.swarm[name]
        return uav.front_end or (uav.radio or self.radio).front_end

    def noise_of(self, name: str) -> Noise:
        """The transmit power and the noise of a terminal: its own, or those of all."""
        return self.swarm[name].noise or self.noise

    def _hardware_problems(self) -> Iterator[Problem]:
        """List what terminals with hardware of their own must share."""
        for name, uav in self.swarm.items():
            array = uav.array or self.array
            if array.num_tx != self.num_tx and uav.radio is None:
                message = (
                    f"{array.num_tx} transmit elements, and array has {self.num_tx}: all terminals "
                    "share the order in which these take turns; state as many"
                )
                yield Problem((("swarm", name, "array"), ("array",)), message)
            for key in ("schedule", "fall_back"):
                if getattr(array, key) != getattr(self.array, key):
                    message = f"all terminals share array.{key}; leave it out"
                    yield Problem((("swarm", name, "array", key), ("array", key)), message)
            if uav.noise is not None and uav.noise.model != self.noise.model:
                message = f"all terminals share noise.model, {self.noise.model}; leave it out"
                yield Problem((("swarm", name, "noise", "model"), ("noise", "model")), message)

    def _self_calibration_problems(self) -> Iterator[Problem]:
        """Schedules by which the channels of an echo cannot be told in one frame."""
        if self.radio.groups == self.num_tx and self.radio.bands(self.num_tx) == 1:
            return
        message = (
            f"needs as many groups as the {self.num_tx} transmit antennas, one of which sends at a "
            f"time, and there are {self.radio.groups}; set it to none, or change radio.groups"
        )
        if self.radio.mode == "fmcw":
            message = (
                f"needs one transmit antenna in mode fmcw, and there are {self.num_tx}; set it to "
                "none, or send from one antenna"
            )
        for at, receivers in self._all_receivers().items():
            if receivers.self_calibration != "none":
                yield Problem(((*at, "self_calibration"), ("radio", "groups")), message)

    def _calibration_problems(self) -> Iterator[Problem]:
        if self.radio.calibration is not None and self.radio.bands(self.num_tx) > 1:
            message = "gains of antennas that send at once cannot be told in the samples; take tdm"
            yield Problem((("radio", "scheme"), ("radio", "calibration")), message)

    def _front_end_problems(self) -> Iterator[Problem]:
        common: Key = ("radio", "front_end")
        stated: list[tuple[Key, FrontEnd, Key, Array]]
        stated = [(common, self.radio.front_end, ("array",), self.array)]
        for name, uav in self.swarm.items():
            key = common if uav.front_end is None else ("swarm", name, "front_end")
            at: Key = ("array",) if uav.array is None else ("swarm", name, "array")
            if uav.is_terminal and uav.radio is None:
                stated.append((key, self.front_end_of(name), at, uav.array or self.array))
        for key, one, at, array in stated:
            yield from self._element_problems((*key, "transmit"), one.transmit, at, self.num_tx)
            yield from self._element_problems((*key, "receive"), one.receive, at, array.num_rx)
            sent = one.transmit_response
            if sent.differs and self.radio.bands(self.num_tx) > 1:
                message = (
                    "antennas that send at once have one response over the chirp here; state it by "
                    "a table of all and set its slope_std_db and slope_std_deg to "
                    "0, or take another scheme"
                )
                yield Problem(((*key, "transmit_response"), ("radio", "scheme")), message)
            powers: list[Key] = [("converter", name) for name in one.converter.powers()]
            powers += [("saturation_dbm",)] if one.saturation_dbm is not None else []
            if powers and self.noise.model == "snr":
                message = (
                    "states a power in dBm, which noise.model snr does not know; take link_budget, "
                    "or leave it out"
                )
                yield Problem(((*key, *powers[0]), ("noise", "model")), message)

    @staticmethod
    def _element_problems(key: Key, elements: Elements, array: Key, size: int) -> Iterator[Problem]:
        for name, count in elements.counts():
            if count != size:
                of = f"{size} {key[-1]} elements of {dotted(array)}"
                message = f"{count} values for {of}; state one of each"
                yield Problem(((*key, name), array), message)
                return

    def first_blocks(self) -> dict[str, int]:
        """First resource block of every UAV that is active at the start; a successor takes over its
        predecessor's. Radars of different chirps share no blocks."""
        if self.by_chirp()[0] is not self:
            return {n: b for one in self.by_chirp() for n, b in one.first_blocks().items()}
        active = {name: uav for name, uav in self.swarm.items() if uav.role == "active"}
        out = {
            name: uav.resource_block
            for name, uav in active.items()
            if uav.resource_block is not None
        }
        occupied = {block + i for block in out.values() for i in range(self.radio.groups)}
        for name in active:
            if name not in out:
                block = 0
                while occupied & set(range(block, block + self.radio.groups)):
                    block += 1
                out[name] = block
                occupied |= set(range(block, block + self.radio.groups))
        return {name: out[name] for name in active}

    def _rcs_problems(self) -> Iterator[Problem]:
        for name, uav in self.swarm.items():
            if uav.rcs.model == "relative" and self.propagation.model != "free_space":
                yield Problem(
                    (("swarm", name, "rcs", "model"), ("propagation", "model")),
                    "relative goes with propagation.model free_space only: a traced echo needs a "
                    "radar cross-section; "
                    "use constant or tr38901",
                )
            if uav.rcs.model == "relative" and self.noise.model != "snr":
                yield Problem(
                    (("swarm", name, "rcs", "model"), ("noise", "model")),
                    "relative goes with noise.model snr only: a link budget needs a radar "
                    "cross-section; use constant or tr38901",
                )

    def _clutter_problems(self) -> Iterator[Problem]:
        if self.clutter.model == "field" and (
            self.propagation.model != "ray_traced" or self.city is None
        ):
            yield Problem(
                (("clutter", "model"), ("propagation", "model"), ("city",)),
                "field needs propagation.model ray_traced and a city to scatter from; "
                "add them or set clutter.model to none",
            )

    def _weather_problems(self) -> Iterator[Problem]:
        if self.weather is not None and not 1e9 <= self.radio.carrier_hz <= 1e12:
            message = "is known from 1 to 1000 GHz; leave it out, or give the carrier in hertz"
            yield Problem((("weather",), ("radio", "carrier_hz")), message)

    def _emitter_problems(self) -> Iterator[Problem]:
        for name, emitter in self.emitters.items():
            if name in self.swarm:
                said = "is the name of a UAV of the swarm; choose another"
                yield Problem((("emitters", name), ("swarm", name)), said)
            place = emitter.uav().position_at(0.0)
            for other, uav in self.swarm.items():
                if math.dist(place, uav.position_at(0.0)) < NEAREST_M:
                    said = f"is less than {NEAREST_M} m from {other} at the start; move one of them"
                    yield Problem((("emitters", name), ("swarm", other)), said)
        if self.emitters and self.noise.model == "snr":
            said = "send a power in dBm, which noise.model snr does not know; take link_budget"
            yield Problem((("emitters",), ("noise", "model")), said)

    def _detector_problems(self) -> Iterator[Problem]:
        for at, one in self._all_receivers().items():
            traced = self.propagation.model == "ray_traced" and self.city is not None
            if one.needs_mesh and not traced:
                detector = (*at, "clutter_detector")
                yield Problem(
                    (detector, ("propagation", "model"), ("city",)),
                    f"{one.clutter_detector} predicts clutter from a city's mesh: it "
                    "needs propagation.model ray_traced and a city; "
                    f"add them or set {dotted(detector)} to cfar",
                )

    def _initiation_problems(self) -> Iterator[Problem]:
        sets: dict[Key, Tracking] = {("tracking",): self.tracking}
        sets |= {("compare", name, "tracking"): x.tracking for name, x in self.compare.items()}
        for at, one in sets.items():
            if one.needs_mesh and self.city is None:
                key = (*at, "initiation")
                message = f"{one.initiation} needs a city; add one or set {dotted(key)} to all"
                yield Problem((key, ("city",)), message)

    def _sensor_problems(self) -> Iterator[Problem]:
        stated: dict[Key, str | None] = {("sensor",): self.sensor}
        stated |= {("swarm", name, "sensor"): uav.sensor for name, uav in self.swarm.items()}
        for key, sensor in stated.items():
            if sensor is not None and sensor not in SENSORS:
                message = "is read by isac_rt.load, which was not used; state radio and array"
                yield Problem((key,), message)

    def _set_problems(self) -> Iterator[Problem]:
        for name, one in self.compare.items():
            if name == OWN:
                message = "is the name of the scenario's own receivers; choose another"
                yield Problem((("compare", name),), message)
            for key in ("active_every_frames",):
                own, other = getattr(self.receivers, key), getattr(one.receivers, key)
                if own != other:
                    yield Problem(
                        (("compare", name, "receivers", key), ("receivers", key)),
                        f"every set receives the same samples, and receivers.{key} is {own}; "
                        "leave it out",
                    )

    @property
    def needs_mesh(self) -> bool:
        """True if some terminal predicts clutter from the city's mesh."""
        sets = self._all_receivers().values()
        traced = self.propagation.model == "ray_traced" and self.city is not None
        by_beams = traced and any(one.passive_detector == "beams" for one in sets)
        return by_beams or any(one.needs_mesh for one in sets)


def _fits(key: str, value: str, values: tuple[str, ...]) -> bool:
    """Return whether a setting of receivers has one of some values, or names another package's
    part, of which nothing is known."""
    return value in values or (key in _PARTS and value not in _PARTS[key].own)


def _with_presets(data: Any) -> Any:
    """Fill in what a sensor and presets say, and what the sets to compare take over."""
    if not isinstance(data, dict):
        return data
    out = with_sensor(data)
    out = with_preset(out, out.get("receiver_preset") or _usual_preset(out), {})
    if isinstance(out.get("swarm"), dict):
        out["swarm"] = {
            name: _with_own_hardware(uav, out) for name, uav in unfolded(out["swarm"]).items()
        }
    own = {key: _plain(out.get(key)) for key in ("receivers", "tracking")}
    if isinstance(sets := out.get("compare"), dict):
        out["compare"] = {
            name: with_preset(one, one.get("preset"), own) if isinstance(one, dict) else one
            for name, one in sets.items()
        }
    return out


def _with_own_hardware(uav: Any, data: dict[str, Any]) -> Any:
    """Complete the radio, the array and the noise that a terminal states by those of its sensor or
    of all."""
    if not isinstance(uav, dict) or uav.get("role") not in TERMINAL_ROLES:
        return uav
    out = with_sensor(uav)
    for key in ("noise",) if out.get("sensor") else ("radio", "array", "noise"):
        own, common = _plain(out.get(key)), _plain(data.get(key))
        if isinstance(own, dict) and isinstance(common, dict):
            out[key] = {**common, **own}
            if "bandwidth_hz" not in own and out[key].get("chirp") is not None:
                out[key].pop("bandwidth_hz", None)  # follows from the chirp
    return out


def _usual_preset(data: dict[str, Any]) -> Preset:
    """The preset of a file that states none. What is malformed is `plain`, for whoever checks
    it."""
    city, model = (_plain(data.get(key)) for key in ("city", "propagation"))
    traced = isinstance(model, dict) and model.get("model") == "ray_traced"
    return "city" if city is not None and traced else "plain"


def _plain(value: Any) -> Any:
    """A node as the mapping that states it."""
    return value.model_dump() if isinstance(value, Node) else value


def json_schema() -> dict[str, Any]:
    """JSON Schema of a scenario file, for editors; docstrings become descriptions, each on one
    line."""
    tree = {
        "$schema": "https://json-schema.org/draft/2020-12/schema",
        **Scenario.model_json_schema(),
    }
    every = [*_descendants(Node)]
    nodes = {node.__name__: node for node in every}  # two of one name go by their modules too
    nodes |= {f"{node.__module__}.{node.__name__}".replace(".", "__"): node for node in every}
    for name, entry in {"Scenario": tree, **tree["$defs"]}.items():
        entry["description"] = " ".join(entry["description"].split())
        docstrings = _docstrings(nodes[name])
        for key, own in entry.get("properties", {}).items():
            own["description"] = " ".join(docstrings[key].split())
            entry["properties"][key] = dict(sorted(own.items()))
    return tree


def _descendants(node: type[Node]) -> Iterator[type[Node]]:
    for kind in node.__subclasses__():
        yield kind
        yield from _descendants(kind)


def _docstrings(node: type[Node]) -> dict[str, str]:
    """Return the text under each field of a node and of those that it extends.

    The source is read here, for the schema alone: pydantic's `use_attribute_docstrings` does it for
    each model at every import.
    """
    texts: dict[str, str] = {}
    for kind in (kind for kind in reversed(node.__mro__) if issubclass(kind, Node)):
        parsed = ast.walk(ast.parse(textwrap.dedent(inspect.getsource(kind))))
        definition = next(part for part in parsed if isinstance(part, ast.ClassDef))
        for two in itertools.pairwise(definition.body):
            match two:
                case (
                    ast.AnnAssign(target=ast.Name(id=field)),
                    ast.Expr(value=ast.Constant(value=str(text))),
                ):
                    texts[field] = text
    return texts
