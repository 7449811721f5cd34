"""Settings of a terminal's front end: departures of its hardware from the ideal."""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from typing import Annotated, Any, ClassVar, Literal

from pydantic import Field, model_validator

from isac_rt.settings import Decibels, Finite, Node, Problem

Offset = Annotated[float, Field(ge=1e-3, le=1e12, allow_inf_nan=False)]


class Oscillator(Node):
    """Phase noise of a terminal's oscillator, as a mask of its single-sideband spectrum."""

    REMOVED: ClassVar[dict[str, str]] = {
        "spurs_dbc": "mask_dbc_hz, with a narrow plateau of the line's power, or leave it out"
    }

    mask_dbc_hz: tuple[tuple[Offset, Decibels], ...] = ()
    """Points [offset from the carrier in Hz, single-sideband noise in dBc/Hz] by rising offset and
    falling level; interpolated on logarithmic axes and constant beyond the last point. Empty, the
    default: no phase noise."""
    locked: bool = True
    """Whether the oscillator is locked to one without noise: below the first point the level is
    held. If not, it goes on rising towards the carrier with the slope of the first two points.
    Locked by default."""

    @property
    def ideal(self) -> bool:
        """True if it has no noise."""
        return not self.mask_dbc_hz

    def problems(self) -> Iterator[Problem]:
        for i, (before, after) in enumerate(itertools.pairwise(self.mask_dbc_hz), start=1):
            if after[0] <= before[0]:
                text = (
                    f"an offset of {after[0]:g} Hz does not follow {before[0]:g} Hz; put the "
                    "points in the order of their offsets"
                )
                yield Problem((("mask_dbc_hz", i),), text)
            elif after[1] > before[1]:
                text = (
                    f"the mask rises from {before[1]:g} dBc/Hz to {after[1]:g} dBc/Hz; phase noise "
                    "falls or stays with the offset from the carrier"
                )
                yield Problem((("mask_dbc_hz", i),), text)
        if self.mask_dbc_hz and not self.locked and len(self.mask_dbc_hz) < 2:
            text = "a free oscillator needs two points or more, whose slope goes on to the carrier"
            yield Problem((("mask_dbc_hz",), ("locked",)), text)


Degrees = Annotated[float, Field(ge=-3600, le=3600, allow_inf_nan=False)]
Spread = Annotated[float, Field(ge=0, le=1e3, allow_inf_nan=False)]
GREATEST_DB = 120.0
"""No part of a front end has more gain or loss; samples stay finite in single precision."""
Gain = Annotated[float, Field(ge=-GREATEST_DB, le=GREATEST_DB, allow_inf_nan=False)]
GainSpread = Annotated[float, Field(ge=0, le=20, allow_inf_nan=False)]
Power = Annotated[float, Field(ge=-200, le=100, allow_inf_nan=False)]
"""Powers in dBm between that of a noiseless receiver's hum and ten megawatts."""
Picoseconds = Annotated[float, Field(ge=-1e5, le=1e5, allow_inf_nan=False)]
"""A delay of 100 ns is 15 m of cable; more is no error of an antenna."""


class Elements(Node):
    """Errors of the elements of one array: what is stated of each, and what is drawn for each."""

    REMOVED: ClassVar[dict[str, str]] = {
        "common_delay_ps": "delay_ps with one value, which is that of all elements",
        "position_mm": "delay_ps, or the places as they are in array.tx and array.rx",
        "position_std_mm": "delay_std_ps: 3.3 ps are a millimetre",
        "tilt_deg": "leave it out: all elements look ahead",
        "tilt_std_deg": "leave it out: all elements look ahead; gain_std_db scatters their gains",
        "gain_drift_std_db_per_s": "leave it out: errors stay as they are drawn",
        "phase_drift_std_deg_per_s": "leave it out: errors stay as they are drawn",
        "coupling": "coupling_db, the level of the two nearest elements",
    }

    gain_db: tuple[Gain, ...] = ()
    """Gain of each element over what it should be [dB], in the order of the elements; one value is
    that of all. Empty, the default: 0."""
    phase_deg: tuple[Degrees, ...] = ()
    """Phase that each element adds to its IF samples [degrees]; one value is that of all. Empty,
    the default: 0."""
    delay_ps: tuple[Picoseconds, ...] = ()
    """Delay of each element's line [ps]: it shifts the range of what the element receives or sends.
    One value is that of all, such as of a board: a bias of all ranges. Empty, the default: 0."""
    gain_std_db: GainSpread = 0.0
    """Standard deviation of gains that are drawn for each element once a run [dB]; they add to
    those stated. By default none."""
    phase_std_deg: Spread = 0.0
    """The same for phases [degrees]. By default none."""
    delay_std_ps: Spread = 0.0
    """The same for delays [ps]. By default none."""
    coupling_db: Annotated[float, Field(ge=-400, le=-3, allow_inf_nan=False)] | None = None
    """Level at which the two nearest elements couple [dB]; between others it falls with the square
    of the distance, and its phase is that of the way. null, the default: no coupling."""

    @property
    def ideal(self) -> bool:
        """True if all elements are ideal."""
        return self == Elements()

    def counts(self) -> Iterator[tuple[str, int]]:
        """Keys that state something of each element, and of how many."""
        for name in ("gain_db", "phase_deg", "delay_ps"):
            if len(stated := getattr(self, name)) > 1:
                yield name, len(stated)


class Response(Node):
    """Complex gain over the sampled part of the chirp, from its beginning to its end."""

    REMOVED: ClassVar[dict[str, str]] = {
        "polynomial_db": "table_db, which for a straight line has two values",
        "polynomial_deg": "table_deg, which for a straight line has two values",
        "element_tables_db": "slope_std_db, by which elements differ",
        "element_tables_deg": "slope_std_deg, by which elements differ",
    }

    table_db: tuple[Gain, ...] = ()
    """Gain at places evenly spread over the samples of a chirp, the first and the last among them
    [dB]; straight lines between them. Empty, the default: 0."""
    table_deg: tuple[Degrees, ...] = ()
    """The same for the phase of the IF samples [degrees]. Empty, the default: none."""
    slope_std_db: GainSpread = 0.0
    """Standard deviation of slopes that are drawn for each element [dB from the middle of the
    chirp to its end]. By default all elements are alike."""
    slope_std_deg: Spread = 0.0
    """The same for the slopes of phases [degrees from the middle of the chirp to its end]. 0, the
    default: none."""

    @property
    def ideal(self) -> bool:
        """True if it is 1 at all elements."""
        return self == Response()

    @property
    def differs(self) -> bool:
        """True if elements have individual responses."""
        return bool(self.slope_std_db or self.slope_std_deg)

    def problems(self) -> Iterator[Problem]:
        for name in ("table_db", "table_deg"):
            if len(getattr(self, name)) == 1:
                yield Problem(((name,),), "one value is no table over the chirp; give two or more")


FARTHEST_HZ = 1e8
"""No ramp is so far from a straight line."""


class Ramp(Node):
    """Departure of the chirp's frequency from a straight line: the beat's error grows with the
    delay."""

    REMOVED: ClassVar[dict[str, str]] = {
        "cubic_hz": "quadratic_hz and ripple_hz",
        "ripple_period_s": "leave it out: it is 10e-6, that of a loop of 100 kHz",
    }

    quadratic_hz: Finite = 0.0
    """Frequency error at both ends of the chirp that grows with the square of the time from its
    middle [Hz]. By default none."""
    ripple_hz: Finite = 0.0
    """Swing of a sinusoidal frequency error [Hz], of a period of 10 us: that of a synthesiser's
    loop of 100 kHz. By default none."""

    @property
    def ideal(self) -> bool:
        """True if the frequency is a straight line."""
        return not (self.quadratic_hz or self.ripple_hz)

    def problems(self) -> Iterator[Problem]:
        for name in ("quadratic_hz", "ripple_hz"):
            if not abs(getattr(self, name)) <= FARTHEST_HZ:
                text = f"is no error of a ramp but another one; at most {FARTHEST_HZ:g} Hz"
                yield Problem(((name,),), text)


class Shifter(Node):
    """Phase shifters of the transmit antennas, by which those that send at once (`scheme: ddm` or
    `bpm`) turn their chirps. Where antennas take turns none is used."""

    bits: Annotated[int, Field(ge=1, le=10)] | None = None
    """Bits of a phase: it is rounded to the nearest of 2^bits equal steps. null, the default: any
    phase."""
    errors_deg: tuple[Degrees, ...] = ()
    """What each of the 2^bits steps, from 0 on, has over its nominal phase [degrees]. Empty, the
    default: none."""

    errors_std_deg: Annotated[float, Field(ge=0, le=90, allow_inf_nan=False)] = 0.0
    """Standard deviation of errors that are drawn for each antenna and step once a run [degrees];
    they add to those stated. By default none."""

    @property
    def ideal(self) -> bool:
        """True if any phase can be sent as it is."""
        return self.bits is None

    def problems(self) -> Iterator[Problem]:
        if (self.errors_deg or self.errors_std_deg) and self.bits is None:
            name = "errors_deg" if self.errors_deg else "errors_std_deg"
            text = "is of steps of which there are none; state bits, or leave it out"
            yield Problem(((name,), ("bits",)), text)
        elif self.bits is not None and len(self.errors_deg) not in (0, 2**self.bits):
            text = f"{len(self.errors_deg)} values for the {2**self.bits} steps of {self.bits} bits"
            yield Problem((("errors_deg",), ("bits",)), f"{text}; state one of each step")


class Converter(Node):
    """Receiver behind its antennas: amplifier, mixer, converters, on signal and noise alike."""

    REMOVED: ClassVar[dict[str, str]] = {
        "headroom_db": "leave it out: the automatic gain leaves 12 dB; or full_scale_dbm fixes it"
    }

    compression_dbm: Power | None = None
    """Power at the receiver's input at which its gain is 1 dB lower [dBm]. null, the default: the
    amplifier is linear."""
    iq_gain_db: Annotated[float, Field(ge=-20, le=20, allow_inf_nan=False)] = 0.0
    """Gain of the quadrature channel over the in-phase one [dB]. By default they are alike."""
    iq_phase_deg: Annotated[float, Field(ge=-45, le=45, allow_inf_nan=False)] = 0.0
    """How far the two are from a right angle [degrees]. By default none."""
    dc_dbm: Power | None = None
    """Power of a constant in the samples, as if it came in at the input [dBm]. null, the default:
    none."""
    real: bool = False
    """Whether only the in-phase channel is sampled: every beat has an image at the sampling rate
    less its own frequency, of the same level. Off by default."""
    bits: Annotated[int, Field(ge=1, le=24)] | None = None
    """Bits of each converter. null, the default: neither quantisation nor saturation."""
    full_scale_dbm: Power | None = None
    """Input power of a sine at the converters' full scale [dBm]. null, the default: an automatic
    gain sets it 12 dB over the mean power of the strongest element in a chirp before the frame's
    first."""

    @property
    def ideal(self) -> bool:
        """True if samples are kept unchanged."""
        return self == Converter()

    def applies(self, name: str) -> bool:
        return name != "full_scale_dbm" or self.bits is not None

    def problems(self) -> Iterator[Problem]:
        if self.full_scale_dbm is not None and self.bits is None:
            text = "is the full scale of converters without bits; state bits, or leave it out"
            yield Problem((("full_scale_dbm",), ("bits",)), text)

    def powers(self) -> Iterator[str]:
        """Keys that state a power at the input."""
        for name in ("compression_dbm", "dc_dbm", "full_scale_dbm"):
            if getattr(self, name) is not None:
                yield name


_AWR2243_SHIFTER_DEG = [
    float(x)
    for x in """
    -0.9 -0.2 1.3 2.2 2.8 3.0 2.8 2.4 1.6 0.7 -0.2 -0.7 -1.1 -1.2 -1.1 -0.7
    0.0 0.5 1.1 1.2 1.2 1.0 0.6 -0.1 -0.8 -1.6 -2.1 -2.3 -2.4 -2.3 -2.1 -1.7
    -0.9 -0.2 1.3 2.3 2.9 3.0 2.8 2.5 1.8 0.8 -0.1 -0.8 -1.1 -1.4 -1.3 -0.9
    -0.7 0.0 0.7 1.0 1.1 0.9 0.6 -0.1 -0.8 -1.5 -2.0 -2.4 -2.5 -2.3 -2.1 -1.6
    """.split()
]
"""Mean error of each phase step over the twelve antennas of a cascade."""
_AWR_MASK = [[3e5, -85.0], [1e7, -115.5]]
PRESETS: dict[str, dict[str, dict[str, Any]]] = {
    "ideal": {},
    "pll_good": {"oscillator": {"mask_dbc_hz": [[3e5, -90.0], [1e7, -120.5]]}},
    "pll_poor": {"oscillator": {"mask_dbc_hz": [[3e5, -80.0], [1e7, -110.5]]}},
    "awr1443": {
        "oscillator": {"mask_dbc_hz": _AWR_MASK},
        "transmit": {"gain_std_db": 1.0, "phase_std_deg": 1.4, "delay_ps": [228.0]},
        "receive": {"gain_std_db": 1.0, "phase_std_deg": 1.4, "delay_ps": [228.0]},
        "transmit_response": {"slope_std_deg": 1.6},
        "receive_response": {"slope_std_deg": 1.6},
    },
    "awr2243_cascade": {
        "oscillator": {"mask_dbc_hz": _AWR_MASK},
        "transmit": {"gain_std_db": 0.68, "phase_std_deg": 1.4},
        "receive": {"gain_std_db": 1.0, "phase_std_deg": 1.4},
        "transmit_response": {"table_db": [0.6, -0.6]},
        "receive_response": {"table_db": [0.6, -0.6]},
        "shifter": {"bits": 6, "errors_deg": _AWR2243_SHIFTER_DEG, "errors_std_deg": 2.2},
    },
}
"""What each preset says of the parts; where the numbers are from stands in `docs/hardware.md`."""


class FrontEnd(Node):
    """Departures of a terminal's hardware from the ideal. Each part is off by default and
    independent of the others."""

    preset: Literal["ideal", "pll_good", "pll_poor", "awr1443", "awr2243_cascade"] = "ideal"
    """Settings by name, which the keys stated beside it override. `pll_good`, `pll_poor`: a locked
    oscillator alone. `awr1443`, `awr2243_cascade`: boards as measured, after calibration of their
    phases, with an oscillator as of data sheets. The default says nothing."""
    oscillator: Oscillator = Oscillator()
    """Phase noise. At an active terminal one oscillator serves both ways, so that near
    echoes hardly show its noise; at a passive one its own and the transmitter's add up. None by
    default."""

    transmit: Elements = Elements()
    """Errors of the transmit elements. None by default."""
    receive: Elements = Elements()
    """Errors of the receive elements. None by default."""

    transmit_response: Response = Response()
    """Gain of what is sent over the chirp. By default it is flat."""
    receive_response: Response = Response()
    """Gain of what is received over the chirp. By default it is flat."""
    shifter: Shifter = Shifter()
    """Phase shifters of the transmit elements. Ideal by default."""
    ramp: Ramp = Ramp()
    """Errors of the chirp's frequency. By default it is a straight line."""
    converter: Converter = Converter()
    """Amplifier, mixer and converters of the receiver. Ideal by default."""
    saturation_dbm: Power | None = None
    """Power at which the transmit amplifier saturates [dBm]; `noise.tx_power_dbm` is what it would
    send if it did not. null, the default: it does not."""

    @model_validator(mode="before")
    @classmethod
    def _with_preset(cls, data: Any) -> Any:
        """Fill in what the preset says of keys that are not stated."""
        name = data.get("preset") if isinstance(data, dict) else None
        parts = PRESETS.get(name, {}) if isinstance(name, str) else {}
        out = dict(data) if parts else data
        for part, keys in parts.items():
            stated = out.get(part, {})
            stated = stated.model_dump() if isinstance(stated, Node) else stated
            if isinstance(stated, dict):
                out[part] = {**keys, **stated}
        return out

    @property
    def ideal(self) -> bool:
        """True if nothing departs from the ideal."""
        parts = (
            self.oscillator,
            self.transmit,
            self.receive,
            self.transmit_response,
            self.receive_response,
            self.shifter,
            self.ramp,
            self.converter,
        )
        return self.saturation_dbm is None and all(part.ideal for part in parts)
