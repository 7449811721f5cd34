"""Settings of the chirp, the arrays, the data on the chirps, the roles and the noise."""

from __future__ import annotations

import math
from collections.abc import Iterator
from fractions import Fraction as Rational
from typing import Annotated, Any, ClassVar, Literal, NamedTuple

from pydantic import Field, model_validator

from isac_rt.settings import AspectTable, Decibels, Finite, Node, Positive, Problem


class ChirpTimes(NamedTuple):
    """Durations that follow from the numbers of a chirp [s]."""

    sampled: float
    """T, the sampled part of a chirp."""
    max_delay: float
    """T_d, the delay whose beat is the sampling rate."""
    chirp: float
    """T~ = T + 2 T_d."""
    slot: float
    """T-, from one chirp of a group to its next."""


def chirp_times(
    bandwidth: float, sampling_rate: float, num_samples: int, num_tx: int
) -> ChirpTimes:
    """Durations of a chirp; T_d = f_s T / (B - 2 f_s), see `isac_rt.frame.waveform.Waveform`."""
    sampled = num_samples / sampling_rate
    max_delay = sampling_rate * sampled / (bandwidth - 2 * sampling_rate)
    chirp = sampled + 2 * max_delay
    return ChirpTimes(sampled, max_delay, chirp, chirp + 2 * num_tx * max_delay)


def num_resource_blocks(bandwidth: float, sampling_rate: float, num_tx: int) -> int:
    """floor(T- / (2 T_d)) in rational arithmetic; with r = B/f_s it is (r - 2)/2 + 1 + L_tx (19 for
    the paper's numbers)."""
    ratio = Rational(bandwidth).limit_denominator() / Rational(sampling_rate).limit_denominator()
    return int((ratio - 2) / 2 + 1 + num_tx)


def hadamard_size(num_tx: int) -> int:
    """Least power of two that holds a code for each transmit antenna."""
    return 1 << (num_tx - 1).bit_length()


GAIN_ROUNDING_DB = 0.01
"""A gain stated to two digits may stand this far above the largest that is possible."""


def beam_solid_angle(half_view: float) -> float:
    """Solid angle [sr] of the directions in front with |u_x| and |u_z| up to sin(`half_view`).

    By the theorem of Gauss and Bonnet: four arcs of circles u = s, which turn about their axes by
    2 asin(s / sqrt(1 - s^2)) from corner to corner. Beyond 45 degrees the corners lie behind the
    horizon, and the half sphere less four half caps is left.

    Parameters
    ----------
    half_view : half of the field of view per axis [rad]
    """
    s = math.sin(min(half_view, math.pi / 2))
    if 2 * s * s >= 1:
        return 2 * math.pi - 4 * math.pi * (1 - s)
    slope = s / math.sqrt(1 - s * s)
    return 2 * math.pi - 4 * math.acos(-slope * slope) + 8 * s * math.asin(slope)


STATED_SHARE = 1e-2
"""A bandwidth that is stated twice may differ by this share."""


_MOST_BLOCKS = 10**9
"""More come of numbers that no chirp has, and are refused as these."""
TRANSITION_SHARE = 0.02
"""Width of the IF filter's skirts over the sampling rate; the paper names none."""


class Chirp(Node):
    """Timing of a plain FMCW chirp as a data sheet states it; samples and their rate stand in
    `radio.samples_per_chirp` and `radio.sampling_rate_hz`."""

    REMOVED: ClassVar[dict[str, str]] = {
        "samples": "radio.samples_per_chirp",
        "sampling_msps": "radio.sampling_rate_hz",
        "repetition_us": "idle_us: the repetition less the ramp",
    }

    slope_mhz_per_us: Positive
    """Slope of the ramp [MHz/us]. A steeper one sweeps more bandwidth while samples are taken:
    range cells get finer and the range shorter."""
    ramp_end_us: Positive | None = None
    """End of the ramp after its start [us]. null, the default: when the last sample is taken."""
    adc_start_us: Annotated[float, Field(ge=0, allow_inf_nan=False)]
    """First sample after the start of the ramp [us]; not before the echo of the longest range has
    come back."""
    idle_us: Annotated[float, Field(ge=0, allow_inf_nan=False)]
    """Pause between a ramp's end and the next one's start [us]."""


class Radio(Node):
    """The chirp that is sent and the frame that chirps form."""

    REMOVED: ClassVar[dict[str, str]] = {
        "filter_transition_hz": "leave it out: the filter's skirts are 2 % of the sampling rate"
    }

    carrier_hz: Positive = 77e9
    """Frequency at which the chirp starts [Hz]; it sweeps upwards from there by `bandwidth_hz`.
    Wavelengths and Doppler shifts follow from it. The default is the automotive radar band, for
    which the paper is written."""
    bandwidth_hz: Positive = 640e6
    """Frequency that the whole chirp sweeps through [Hz]; more than twice the sampling rate. A
    wider sweep gives finer range cells: 25 cm for an echo with the default, which is the
    paper's."""
    sampling_rate_hz: Positive = 20e6
    """Rate of the complex IF samples [Hz]. It sets the longest delay that passes the filter: 256 m
    for an echo with the default, the paper's. Receivers search the half that every data symbol
    reaches."""
    samples_per_chirp: Annotated[int, Field(ge=16, le=65536)] = 1024
    """Samples taken of each chirp, an even number because half of the range cells carry the data
    symbols. More samples make chirps and frames longer. The default is the paper's."""
    chirps_per_frame: Annotated[int, Field(ge=2, le=4096)] = 120
    """Chirps in a frame, a multiple of the number of transmit antennas, which take turns. More
    chirps resolve velocities more finely (0.25 m/s for an echo with the default, which is the
    paper's) and make the frame longer."""
    groups: Annotated[int, Field(ge=1, le=16)] = 3
    """Chirp groups that are sent simultaneously, each in a resource block of its own and with its
    own data; at most the number of transmit antennas. The default uses all three transmit antennas
    of the default array."""
    mode: Literal["isac", "fmcw"] = "isac"
    """What the chirps are for. `isac`, the default and the paper's, carries data to passive
    terminals; `fmcw` is a plain radar without data, which sees all range cells."""
    scheme: Literal["simo", "tdm", "ddm", "bpm"] = "tdm"
    """How transmit antennas share the chirps, for `mode: fmcw`. `simo`: one antenna. `tdm`, the
    default: one after the other. `ddm`: simultaneously, by a phase step per chirp (Doppler bands).
    `bpm`: simultaneously, by a Hadamard code over the chirps."""
    sub_bands: Annotated[int, Field(ge=2, le=256)] | None = None
    """Doppler bands of `scheme: ddm`, or code length of `bpm` (a power of two); it divides
    `chirps_per_frame`. More bands than antennas keep the full velocity unambiguous. null, the
    default: the least number that holds the antennas."""
    chirp: Chirp | None = None
    """Timing of the chirp as a data sheet states it, for `mode: fmcw`, in place of `bandwidth_hz`,
    which follows. null, the default: `bandwidth_hz`, `sampling_rate_hz` and `samples_per_chirp` set
    the timing as in the paper."""

    @model_validator(mode="before")
    @classmethod
    def _as_stated(cls, data: Any) -> Any:
        """One group in a plain radar, and the numbers that follow from a data sheet's timing where
        they are not stated. What is malformed stays as it is, for whoever checks it."""
        if not isinstance(data, dict) or data.get("mode") != "fmcw":
            return data
        out = {"groups": 1, **data}
        chirp = data.get("chirp")
        chirp = chirp.model_dump() if isinstance(chirp, Chirp) else chirp
        if not isinstance(chirp, dict):
            return out
        numbers = {k: v for k, v in chirp.items() if type(v) in (int, float) and 0 <= v < 1e9}
        default = cls.model_fields
        size = out.get("samples_per_chirp", default["samples_per_chirp"].default)
        rate = out.get("sampling_rate_hz", default["sampling_rate_hz"].default)
        if type(size) is int and type(rate) in (int, float) and rate > 0:
            last = numbers.get("adc_start_us", 0.0) + size / rate * 1e6
            ramp = numbers.get("ramp_end_us", last)
            if sweep := numbers.get("slope_mhz_per_us", 0.0) * ramp:
                out.setdefault("bandwidth_hz", sweep * 1e6)
        return out

    def applies(self, name: str) -> bool:
        if name in ("scheme", "sub_bands", "chirp"):
            return self.mode == "fmcw"
        return name != "mode" or self.mode != "isac"

    @property
    def ramp_end_s(self) -> float:
        """End of the data sheet's ramp after its start."""
        assert self.chirp is not None
        if self.chirp.ramp_end_us is not None:
            return self.chirp.ramp_end_us * 1e-6
        return self.chirp.adc_start_us * 1e-6 + self.samples_per_chirp / self.sampling_rate_hz

    @property
    def repetition_s(self) -> float:
        """From the start of a data sheet's ramp to the start of the next."""
        assert self.chirp is not None
        return self.chirp.idle_us * 1e-6 + self.ramp_end_s

    def times(self, num_tx: int) -> ChirpTimes:
        """Durations of a chirp that `num_tx` antennas share."""
        rate, size = self.sampling_rate_hz, self.samples_per_chirp
        if self.chirp is None:
            return chirp_times(self.bandwidth_hz, rate, size, num_tx)
        longest = rate / (self.chirp.slope_mhz_per_us * 1e12)
        return ChirpTimes(size / rate, longest, self.ramp_end_s, self.repetition_s)

    def num_blocks(self, num_tx: int) -> int:
        """Resource blocks in a slot."""
        if self.chirp is None:
            return num_resource_blocks(self.bandwidth_hz, self.sampling_rate_hz, num_tx)
        times = self.times(num_tx)
        most = times.slot / (2 * times.max_delay) if times.max_delay > 0 else math.inf
        return int(min(max(most, 1), _MOST_BLOCKS))

    def bands(self, num_tx: int) -> int:
        """Doppler bands or length of the codes by which antennas that send at once are told apart;
        1 where they take turns."""
        if self.mode == "isac" or self.scheme in ("simo", "tdm"):
            return 1
        if self.sub_bands is not None:
            return self.sub_bands
        if self.scheme == "bpm":
            return hadamard_size(num_tx)
        able = (n for n in range(num_tx + 1, 257) if self.chirps_per_frame % n == 0)
        return next(able, num_tx + 1)

    def problems(self) -> Iterator[Problem]:
        yield from self._fmcw_problems()
        yield from self._chirp_problems()
        if self.chirp is None and self.bandwidth_hz <= 2 * self.sampling_rate_hz:
            yield Problem(
                (("bandwidth_hz",), ("sampling_rate_hz",)),
                f"{self.bandwidth_hz:g} Hz must exceed twice the sampling rate of "
                f"{self.sampling_rate_hz:g} Hz; "
                "raise the bandwidth or lower the sampling rate",
            )
        if self.bandwidth_hz > self.carrier_hz:
            yield Problem(
                (("bandwidth_hz",), ("carrier_hz",)),
                f"{self.bandwidth_hz:g} Hz is more than the carrier of {self.carrier_hz:g} Hz: "
                "no antenna sweeps over an octave at one gain; lower the bandwidth, or give both "
                "in hertz",
            )
        if self.samples_per_chirp % 2:
            yield Problem(
                (("samples_per_chirp",),),
                "must be even: half of the range cells carry the data symbols",
            )

    def _fmcw_problems(self) -> Iterator[Problem]:
        if self.mode == "isac":
            for key in ("chirp", "sub_bands"):
                if getattr(self, key) is not None:
                    text = "has no meaning with mode isac; set radio.mode: fmcw, or leave it out"
                    yield Problem(((key,), ("mode",)), text)
            return
        if self.groups != 1:
            text = f"{self.groups} groups carry data, which mode fmcw has none of; leave it out"
            yield Problem((("groups",), ("mode",)), text)
        if self.sub_bands is None:
            return
        if self.scheme in ("simo", "tdm"):
            text = f"has no meaning with scheme {self.scheme}, only with ddm or bpm; leave it out"
            yield Problem((("sub_bands",), ("scheme",)), text)
        elif self.scheme == "bpm" and self.sub_bands & (self.sub_bands - 1):
            text = "must be a power of two with scheme bpm, the length of a Hadamard code"
            yield Problem((("sub_bands",), ("scheme",)), text)

    def _chirp_problems(self) -> Iterator[Problem]:
        if self.chirp is None or self.mode == "isac":
            return
        c, sampled = self.chirp, self.samples_per_chirp / self.sampling_rate_hz
        follows = c.slope_mhz_per_us * 1e12 * self.ramp_end_s
        if not abs(self.bandwidth_hz - follows) <= STATED_SHARE * follows < math.inf:
            text = f"but {follows:g} follows from radio.chirp; leave one out (chirp: null)"
            yield Problem((("bandwidth_hz",), ("chirp",)), text)
        last = c.adc_start_us * 1e-6 + sampled
        if last > self.ramp_end_s * (1 + 1e-9):
            yield Problem(
                (("chirp", "ramp_end_us"), ("chirp", "adc_start_us"), ("samples_per_chirp",)),
                f"the last sample is taken {last * 1e6:g} us after the start of the ramp, which "
                "has ended by then; lengthen the ramp, or take fewer samples, earlier or faster",
            )
        longest = self.sampling_rate_hz / (c.slope_mhz_per_us * 1e12)
        if c.adc_start_us * 1e-6 < longest * (1 - 1e-9):
            yield Problem(
                (("chirp", "adc_start_us"), ("chirp", "slope_mhz_per_us")),
                f"the echo whose beat is the sampling rate comes back {longest * 1e6:.4g} us after "
                "the ramp's start, after the first sample; sample later or slower, or take a "
                "steeper ramp",
            )


MAX_ELEMENTS = 1024
FARTHEST = 1e6
"""No element is farther from the origin of its array, in its unit."""


class Elements(Node):
    """The elements of one array in its plane, X to the right and Z upwards, in place of an L."""

    shape: Literal["positions", "linear", "planar", "ti_cascade"] = "positions"
    """Arrangement of the elements. `positions`, the default: as `positions` or `file` list them.
    `linear`: `columns` in a row along X. `planar`: `columns` times `rows`. `ti_cascade`: TI's
    4-chip cascade board, 12 transmit and 16 receive antennas."""
    positions: (
        Annotated[tuple[tuple[Finite, Finite], ...], Field(max_length=MAX_ELEMENTS)] | None
    ) = None
    """Place (x, z) of each element from any origin, in the order of the channels, for `shape:
    positions`."""
    file: str | None = None
    """CSV file with the columns x and z and a row for each element, in place of `positions`; the
    path is relative to the scenario's folder. null, the default: none."""
    columns: Annotated[int, Field(ge=1, le=64)] = 4
    """Elements along X, for `linear` and `planar`. The default is what most radar chips receive
    with."""
    rows: Annotated[int, Field(ge=1, le=64)] = 1
    """Elements along Z, for `planar`. By default one."""
    spacing: tuple[Positive, Positive] = (0.5, 0.5)
    """Distance of neighbours along X and along Z, for `linear` and `planar`. The default is half a
    wavelength, unambiguous in all directions in front."""
    unit: Literal["wavelengths", "metres"] = "wavelengths"
    """Unit of `positions`, `file` and `spacing`: wavelengths at `radio.carrier_hz`, the default, or
    metres."""

    def applies(self, name: str) -> bool:
        named = {
            "positions": ("positions", "file", "unit"),
            "linear": ("columns", "spacing", "unit"),
            "planar": ("columns", "rows", "spacing", "unit"),
            "ti_cascade": (),
        }
        return name == "shape" or name in named[self.shape]

    def count(self, sending: bool) -> int:
        """Elements of the array."""
        match self.shape:
            case "ti_cascade":
                return 12 if sending else 16
            case "linear":
                return self.columns
            case "planar":
                return self.columns * self.rows
        return len(self.positions or ())

    def problems(self) -> Iterator[Problem]:
        if self.file is not None:
            text = "is read by isac_rt.load, which was not used; state positions"
            yield Problem((("file",),), text)
        elif self.shape == "positions" and not self.positions:
            text = "missing: shape positions needs one element or more; add positions or file"
            yield Problem((("positions",), ("shape",)), text)
        if self.shape != "positions" and self.positions is not None:
            text = f"has no meaning with shape {self.shape}; leave it out, or set shape: positions"
            yield Problem((("positions",), ("shape",)), text)
        far = max((abs(v) for position in self.positions or () for v in position), default=0.0)
        if far > FARTHEST:
            text = f"{far:g} is no place in an array, {FARTHEST:g} is the farthest; correct it"
            yield Problem((("positions",),), text)
        if self.count(True) > MAX_ELEMENTS:
            text = f"{self.count(True)} elements are more than {MAX_ELEMENTS}; take fewer"
            yield Problem((("columns",), ("rows",)), text)


class Array(Node):
    """The antenna arrays of every terminal: an L of elements along X and Z for sending and one for
    receiving."""

    tx_x: Annotated[int, Field(ge=1, le=16)] = 2
    """Transmit elements along X (to the right of the boresight), the corner of the L included. The
    default gives three transmit antennas with `tx_z`, as in the paper."""
    tx_z: Annotated[int, Field(ge=1, le=16)] = 2
    """Transmit elements along Z (upwards), the corner of the L included. The default gives three
    transmit antennas with `tx_x`, as in the paper."""
    rx_x: Annotated[int, Field(ge=1, le=64)] = 8
    """Receive elements along X (to the right of the boresight), the corner of the L included. More
    elements resolve azimuth more finely. The default is the paper's."""
    rx_z: Annotated[int, Field(ge=1, le=64)] = 8
    """Receive elements along Z (upwards), the corner of the L included. More elements resolve
    elevation more finely; with 1, and `tx_z` 1, elevation is not observed. The default is the
    paper's."""
    spacing_wavelengths: Positive = 0.5774
    """Distance between neighbouring receive elements, in wavelengths at `radio.carrier_hz`;
    transmit elements stand one receive arm apart. The default makes directions unambiguous within
    60 degrees of the boresight."""
    tx: Elements | None = None
    """Transmit elements one by one or by a shape, in place of the L of `tx_x` and `tx_z`. null, the
    default: the L."""
    rx: Elements | None = None
    """Receive elements one by one or by a shape, in place of the L of `rx_x` and `rx_z`. null, the
    default: the L."""
    schedule: Literal["pseudo_random", "conventional"] = "pseudo_random"
    """Order in which the transmit antennas take the slots. `pseudo_random`, the default and the
    paper's, keeps the full unambiguous velocity; `conventional` goes round the antennas, which
    divides it by their number."""
    fall_back: bool = False
    """Whether a transmitter sends the conventional schedule instead of the pseudo-random one while
    a receiver finds too many paths for sparse recovery. Off by default: the default groups need no
    sparse recovery."""
    element_pattern: Literal["isotropic", "sector", "cosine", "table"] = "cosine"
    """Pattern of one element: `isotropic`; `sector`: constant within the field of view and zero
    outside; `cosine`, the default: that of a patch antenna; `table`: as `pattern` or `pattern_file`
    state, over `element_gain_dbi`."""
    pattern: AspectTable | None = None
    """Gain of one element by azimuth and elevation, relative to `element_gain_dbi` [dB], for
    `table`."""
    pattern_file: str | None = None
    """File of the pattern in place of `pattern`: CSV with azimuth_deg, elevation_deg, dbi of a
    grid, or with two cuts, `.msi` of Planet, or a table of HFSS. The path is relative to the
    scenario's folder."""
    element_gain_dbi: Decibels = 5.0
    """Gain of one element on boresight [dBi]. The limit is the directivity of the pattern: 0 with
    `isotropic`, 4.36 with `sector` of 120 degrees. The default is that of a patch antenna."""
    field_of_view_deg: Annotated[float, Field(gt=0, le=180)] = 120.0
    """Full angle that the arrays look at, in azimuth as in elevation [degrees]. Targets outside
    count as out of view. The default is what the default spacing tells without ambiguity."""

    @property
    def num_tx(self) -> int:
        """L_tx, transmit elements."""
        return self.tx_x + self.tx_z - 1 if self.tx is None else self.tx.count(sending=True)

    @property
    def num_rx(self) -> int:
        """L_rx, receive elements."""
        return self.rx_x + self.rx_z - 1 if self.rx is None else self.rx.count(sending=False)

    def applies(self, name: str) -> bool:
        if name in ("pattern", "pattern_file"):
            return self.element_pattern == "table"
        if name in ("tx_x", "tx_z"):
            return self.tx is None
        if name in ("rx_x", "rx_z"):
            return self.rx is None
        return name != "spacing_wavelengths" or self.tx is None or self.rx is None

    @property
    def largest_gain_dbi(self) -> float:
        """Gain on boresight at which an element radiates just its power [dBi]: 4 pi over the solid
        angle of its beam. A `cosine` narrows with its gain and has no limit."""
        if self.element_pattern in ("cosine", "table"):
            return math.inf
        beam = 4 * math.pi
        if self.element_pattern == "sector":
            beam = beam_solid_angle(math.radians(self.field_of_view_deg) / 2)
        return 10 * math.log10(4 * math.pi / beam)

    def problems(self) -> Iterator[Problem]:
        if self.pattern_file is not None:
            text = "is read by isac_rt.load, which was not used; state pattern"
            yield Problem((("pattern_file",),), text)
        elif (self.pattern is None) == (self.element_pattern == "table"):
            text = "goes with element_pattern table, which needs it or pattern_file"
            yield Problem((("pattern",), ("element_pattern",)), text)
        excess = self.element_gain_dbi - self.largest_gain_dbi
        if excess > GAIN_ROUNDING_DB:
            yield Problem(
                (("element_gain_dbi",), ("element_pattern",), ("field_of_view_deg",)),
                f"with {self.element_gain_dbi:g} dBi the {self.element_pattern} element would "
                f"radiate {10 ** (excess / 10):.3g} times its power; at most "
                f"{self.largest_gain_dbi:.2f} dBi are possible; lower the gain, or take the "
                "pattern cosine, whose beam narrows with its gain",
            )


class Modulation(Node):
    """The data on the chirps, and the frames that carry none."""

    dpsk_order: Literal[2, 4, 8, 16] = 8
    """Number of phases of the differential phase-shift keying between chirps. More phases carry
    more bits (3 per symbol with the default, which is the paper's) and need a higher SNR."""
    acquisition_frames: Annotated[int, Field(ge=1)] = 3
    """Frames without data at the start and after a change of roles, from which every terminal
    acquires the others. The default is what a track needs to be confirmed
    (`tracking.confirm_hits`)."""
    pilot_every_frames: Annotated[int, Field(ge=2)] | None = 25
    """One frame in so many carries no data, so that late or lost terminals can acquire; null: none
    after the start. The default spends 4 % of the data rate on it."""
    streams: dict[str, tuple[Annotated[int, Field(ge=0)], ...]] = Field({})
    """Groups, counted from 0, that carry data for a passive terminal, by its name. A terminal that
    is not named reads all groups, and that is the default for all."""


class Noise(Node):
    """Strength of the receiver's noise: by a link budget in watts, or by a stated SNR."""

    REMOVED: ClassVar[dict[str, str]] = {
        "temperature_k": "noise_figure_db, which counts from 290 K: 10 log10(F - 1 + T/290)"
    }

    model: Literal["link_budget", "snr"] = "link_budget"
    """How the noise is set: `link_budget`, the default, takes transmit power and thermal noise, so
    that paths stand in their true proportion; `snr` takes `snr_db`, as the paper does."""
    tx_power_dbm: Decibels = 12.0
    """Transmit power of one antenna [dBm], for `link_budget`. The default is what one channel of a
    77 GHz radar chip delivers."""
    noise_figure_db: Decibels = 12.0
    """Noise figure of the receiver [dB], for `link_budget`: how far its noise is above the thermal
    noise. The default is that of a 77 GHz radar chip."""
    snr_db: Decibels = 10.0
    """SNR of one IF sample of the unobstructed reference path, for `snr` [dB]: the strongest target
    at an active terminal, the line of sight at a passive one. The default is far above the onset of
    symbol errors."""


class RoleChange(Node):
    """An active terminal and a passive one change places."""

    frame: Annotated[int, Field(ge=1)]
    """First frame in the new roles, counted from 0; frames without data follow, as at the start
    (`modulation.acquisition_frames`)."""
    from_uav: str
    """Name of the UAV that is active until then and passive from then on."""
    to_uav: str
    """Name of the UAV that is passive until then; it takes over the role and the resource
    blocks."""
