"""Chirps and frames of TI's boards, from the files that configure them: the command line's `.cfg`
(mmWave SDK, "mmwave_sdk_user_guide", section 3.4) and mmWave Studio's `.mmwave.json`.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, NamedTuple

from isac_rt.storage import BAD_DATA, read_whole

BOARD_FILES = (".cfg", ".json")
MOST_BYTES = 1_000_000
MOST_CHIRPS = 512
"""Chirp configurations of a device."""
Sampling = Literal["complex_1x", "complex_2x", "real"]
_SAMPLINGS: tuple[Sampling, ...] = ("real", "complex_1x", "complex_2x")
"""By the number that the files state. A further one, 3, is TI's pseudo real, which is not read."""
TI_TX = ((0.0, 0.0), (1.0, 0.5), (2.0, 0.0))
"""Transmitters of AWR1843BOOST and IWR6843ISK [wavelengths], right and up; four receivers stand
half a wavelength apart."""


class BoardFileError(ValueError):
    """A board's file cannot be used; the text says where and why."""


@dataclass(frozen=True)
class Board:
    """One profile and frame of a board.

    Attributes
    ----------
    start_hz, slope : where the ramp starts, and its slope [Hz, Hz/s]
    idle, adc_start, ramp_end : before the ramp, and from its start [s]
    samples, rate : of a chirp; per second
    receivers : switched on
    chirps : transmitter of each chirp of a loop
    loops, frames : loops of a frame; frames, 0: without end
    period : from frame to frame [s], 0: not stated
    sampling : kind of a sample
    interleaved : receivers stand together, None: not stated
    q_first : Q stands before I
    """

    start_hz: float
    slope: float
    idle: float
    adc_start: float
    ramp_end: float
    samples: int
    rate: float
    receivers: int
    chirps: tuple[int, ...]
    loops: int
    frames: int
    period: float
    sampling: Sampling
    interleaved: bool | None = None
    q_first: bool = False

    def description(self) -> dict[str, Any]:
        """Keys of a description of the board's samples (`isac-rt import`). The elements are those
        of TI's evaluation boards where the board has their numbers of antennas."""
        out = {
            "carrier_hz": self.start_hz,
            "slope_mhz_per_us": self.slope / 1e12,
            "adc_start_us": self.adc_start * 1e6,
            "sampling_rate_hz": self.rate,
            "samples_per_chirp": self.samples,
            "receivers": self.receivers,
            "chirps": self._numbered(),
            "loops": self.loops,
            "frames": self.frames,
            "chirp_interval_us": (self.idle + self.ramp_end) * 1e6,
            "frame_interval_ms": self.period * 1e3 or None,
            "sampling": self.sampling,
            "interleaved": bool(self.interleaved),
            "q_first": self.q_first,
        }
        if self.receivers == 4 and max(self.chirps) < len(TI_TX):
            places = {
                "unit_hz": self.start_hz,
                "transmitters": [[2 * x, 2 * z] for x, z in self._places()],
                "receivers": [[k, 0] for k in range(4)],
            }
            out["elements"] = places
        return out

    def scenario(self) -> dict[str, dict[str, Any]]:
        """Keys of a scenario of plain FMCW: `radio` and `array`. Real samples and those with the
        image band become half as many complex ones at half the rate."""
        half = 1 if self.sampling == "complex_1x" else 2
        used = self._numbered()
        array: dict[str, Any] = {"rx": {"shape": "linear", "columns": self.receivers}}
        if max(self.chirps) < len(TI_TX):
            places = [list(position) for position in self._places()]
            array["tx"] = {"shape": "positions", "positions": places}
        else:
            array["tx"] = {"shape": "linear", "columns": max(used) + 1}
        return {
            "radio": {
                "mode": "fmcw",
                "scheme": "tdm" if max(used) else "simo",
                "carrier_hz": self.start_hz,
                "chirps_per_frame": self.loops * len(self.chirps),
                "samples_per_chirp": self.samples // half,
                "sampling_rate_hz": self.rate / half,
                "chirp": {
                    "slope_mhz_per_us": self.slope / 1e12,
                    "idle_us": self.idle * 1e6,
                    "adc_start_us": self.adc_start * 1e6,
                    "ramp_end_us": self.ramp_end * 1e6,
                },
            },
            "array": array,
        }

    def _numbered(self) -> tuple[int, ...]:
        """Transmitters that send, counted from 0, chirp by chirp."""
        used = sorted(set(self.chirps))
        return tuple(used.index(tx) for tx in self.chirps)

    def _places(self) -> list[tuple[float, float]]:
        return [TI_TX[tx] for tx in sorted(set(self.chirps))]


def read_board(file: str | Path) -> Board:
    """Board of a `.cfg` or `.mmwave.json`.

    Raises
    ------
    BoardFileError  With the line or the entry.
    """
    file = Path(file)
    try:
        text = read_whole(file, MOST_BYTES).decode()
    except OSError as problem:
        raise BoardFileError(f"{file}: cannot be read: {problem.strerror}") from None
    except BAD_DATA:
        raise BoardFileError(f"{file}: is no text; give a board's .cfg or .mmwave.json") from None
    reader = _of_json if file.suffix == ".json" else _of_cfg
    return reader(file, text)


class _Chirp(NamedTuple):
    first: int
    last: int
    profile: int
    mask: int


class _Place(NamedTuple):
    """A file and where in it; `fail` is the error there."""

    file: Path
    where: str

    def fail(self, text: str) -> BoardFileError:
        return BoardFileError(f"{self.file}{self.where}: {text}")

    def number(self, value: Any, what: str, least: float, most: float) -> float:
        """A number within limits."""
        try:
            parsed = float(int(value, 0) if str(value).lower().startswith("0x") else value)
        except (TypeError, ValueError):
            raise self.fail(f"{what} is {str(value)[:40]!r}, no number") from None
        if not least <= parsed <= most:
            raise self.fail(f"{what} is {parsed:g}, it must be {least:g} to {most:g}")
        return parsed


_LIMITS = {
    "startFreq": (1.0, 500.0),
    "idleTime": (0.0, 1e6),
    "adcStartTime": (0.0, 1e6),
    "rampEndTime": (1e-3, 1e6),
    "freqSlopeConst": (1e-6, 1e6),
    "numAdcSamples": (16.0, 65536.0),
    "digOutSampleRate": (1.0, 1e9),
}
"""GHz, us, us, us, MHz/us, samples, ksamples/s."""


def _board(
    place: _Place,
    profile: Mapping[str, float],
    chirps: Sequence[_Chirp],
    frame: tuple[int, int, int, int, float],
    about: tuple[int, Sampling, bool | None, bool],
) -> Board:
    """Put the parts of a file together."""
    first, last, loops, frames, period = frame
    order: list[int] = []
    for k in range(first, last + 1):
        match = [c for c in chirps if c.first <= k <= c.last]
        if len(match) != 1:
            raise place.fail(f"chirp {k} of the frame is configured {len(match)} times, not once")
        if match[0].profile != chirps[0].profile:
            raise place.fail(f"chirp {k} has another profile; let all chirps have one")
        mask = match[0].mask
        if mask <= 0 or mask & (mask - 1):
            raise place.fail(
                f"chirp {k} switches {mask.bit_count()} transmitters on; let each chirp have one"
            )
        order.append(mask.bit_length() - 1)
    counts = {order.count(tx) for tx in set(order)}
    if len(counts) > 1:
        raise place.fail("transmitters do not send equally often in a loop; let them")
    receivers, sampling, interleaved, q_first = about
    return Board(
        start_hz=profile["startFreq"] * 1e9,
        slope=profile["freqSlopeConst"] * 1e12,
        idle=profile["idleTime"] * 1e-6,
        adc_start=profile["adcStartTime"] * 1e-6,
        ramp_end=profile["rampEndTime"] * 1e-6,
        samples=int(profile["numAdcSamples"]),
        rate=profile["digOutSampleRate"] * 1e3,
        receivers=receivers,
        chirps=tuple(order),
        loops=loops,
        frames=frames,
        period=period * 1e-3,
        sampling=sampling,
        interleaved=interleaved,
        q_first=q_first,
    )


# ---- the command line's .cfg

_PROFILE = {
    "startFreq": 1,
    "idleTime": 2,
    "adcStartTime": 3,
    "rampEndTime": 4,
    "freqSlopeConst": 7,
    "numAdcSamples": 9,
    "digOutSampleRate": 10,
}
"""Places of `profileCfg`'s numbers."""


def _of_cfg(file: Path, text: str) -> Board:
    lines = list(_commands(file, text))

    def all_of(command: str, least: int) -> list[tuple[_Place, list[str]]]:
        found = [(place, words) for place, name, words in lines if name == command]
        for place, words in found:
            if len(words) < least:
                raise place.fail(f"{command} has {len(words)} numbers, it needs {least}")
        return found

    def one(command: str, least: int) -> tuple[_Place, list[str]]:
        matching = all_of(command, least)
        if not matching:
            raise BoardFileError(f"{file}: has no {command}; give the board's whole configuration")
        return matching[0]

    whole = _Place(file, "")
    at, words = one("profileCfg", 14)
    profile = {name: at.number(words[k], name, *_LIMITS[name]) for name, k in _PROFILE.items()}
    chirps = [
        _Chirp(*(int(p.number(w[k], "a chirp's number", 0, 65535)) for k in (0, 1, 2, 7)))
        for p, w in all_of("chirpCfg", 8)
    ]
    if not chirps:
        raise BoardFileError(f"{file}: has no chirpCfg; give the board's whole configuration")
    at, words = one("frameCfg", 7)
    period = words[5] if len(words) > 7 else words[4]  # newer ones state the samples before it
    first, last = (int(at.number(words[k], "frameCfg", 0, MOST_CHIRPS)) for k in (0, 1))
    frame = (
        first,
        last,
        int(at.number(words[2], "the loops", 1, 65535)),
        int(at.number(words[3], "the frames", 0, 65535)),
        at.number(period, "the frame period", 1e-3, 1e5),
    )
    at, words = one("channelCfg", 2)
    receivers = int(at.number(words[0], "the receivers' mask", 1, 65535)).bit_count()
    at, words = one("adcCfg", 2)
    sampling = _SAMPLINGS[int(at.number(words[1], "the output format", 0, 2))]
    buffers = all_of("adcbufCfg", 4)
    interleaved, q_first = None, False
    if buffers:  # newer ones state a subframe first
        at, words = buffers[0]
        q_first = at.number(words[-3], "SampleSwap", 0, 1) == 1
        interleaved = at.number(words[-2], "the channels' order", 0, 1) == 0
    return _board(whole, profile, chirps, frame, (receivers, sampling, interleaved, q_first))


def _commands(file: Path, text: str) -> Iterator[tuple[_Place, str, list[str]]]:
    for number, line in enumerate(text.splitlines(), 1):
        words = line.split("%")[0].split()
        if words:
            yield _Place(file, f":{number}"), words[0], words[1:]


# ---- mmWave Studio's JSON

_STUDIO = {
    "startFreq": "startFreqConst_GHz",
    "idleTime": "idleTimeConst_usec",
    "adcStartTime": "adcStartTimeConst_usec",
    "rampEndTime": "rampEndTime_usec",
    "freqSlopeConst": "freqSlopeConst_MHz_usec",
    "numAdcSamples": "numAdcSamples",
    "digOutSampleRate": "digOutSampleRate",
}
_CHIRP_KEYS = "chirpStartIdx", "chirpEndIdx", "profileId", "txEnable"


def _of_json(file: Path, text: str) -> Board:
    try:
        device = json.loads(text)["mmWaveDevices"][0]
        rf = device["rfConfig"]
        parts = {
            "rlProfileCfg_t": rf["rlProfiles"][0]["rlProfileCfg_t"],
            "rlFrameCfg_t": rf["rlFrameCfg_t"],
            "rlChanCfg_t": rf["rlChanCfg_t"],
            "fmt": rf["rlAdcOutCfg_t"]["fmt"],
        }
        stated = [one["rlChirpCfg_t"] for one in rf["rlChirps"]]
        capture = device.get("rawDataCaptureConfig") or {}
        order = capture.get("rlDevDataFmtCfg_t") or {}
        channels, swapped = order.get("chInterleave"), order.get("iqSwapSel")
    except (*BAD_DATA, RecursionError) as problem:
        raise BoardFileError(
            f"{file}: is no configuration of mmWave Studio ({type(problem).__name__}: "
            f"{str(problem)[:60]}); give a .mmwave.json"
        ) from None
    value = _values(file, parts)
    profile = {name: value("rlProfileCfg_t", key, *_LIMITS[name]) for name, key in _STUDIO.items()}
    chirps = []
    for k, one in enumerate(stated):
        of_chirp = _values(file, {f"rlChirps[{k}]": one})
        chirps.append(_Chirp(*(int(of_chirp(f"rlChirps[{k}]", n, 0, 65535)) for n in _CHIRP_KEYS)))
    frame = (
        int(value("rlFrameCfg_t", "chirpStartIdx", 0, MOST_CHIRPS)),
        int(value("rlFrameCfg_t", "chirpEndIdx", 0, MOST_CHIRPS)),
        int(value("rlFrameCfg_t", "numLoops", 1, 65535)),
        int(value("rlFrameCfg_t", "numFrames", 0, 65535)),
        value("rlFrameCfg_t", "framePeriodicity_msec", 1e-3, 1e5),
    )
    receivers = int(value("rlChanCfg_t", "rxChannelEn", 1, 65535)).bit_count()
    sampling = _SAMPLINGS[int(value("fmt", "b2AdcOutFmt", 0, 2))]
    interleaved = None if channels is None else channels == 0
    if not chirps:
        raise BoardFileError(f"{file}: rlChirps is empty; give the board's whole configuration")
    about = receivers, sampling, interleaved, swapped == 1
    return _board(_Place(file, ""), profile, chirps, frame, about)


def _values(file: Path, parts: Mapping[str, Any]) -> Callable[[str, str, float, float], float]:
    def value(part: str, key: str, least: float, most: float) -> float:
        here = parts[part]
        place = _Place(file, f": {part}")
        if not isinstance(here, dict) or key not in here:
            raise place.fail(f"has no {key}; give the board's whole configuration")
        return place.number(here[key], key, least, most)

    return value
