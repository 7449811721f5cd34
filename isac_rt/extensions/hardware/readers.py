"""Files of radar boards to cubes."""

from __future__ import annotations

import hashlib
import io
import json
import math
from collections.abc import Callable, Sequence
from pathlib import Path
from tokenize import TokenError
from typing import Any

import numpy as np

from isac_rt.extensions.hardware.description import MOST_ELEMENTS, Description
from isac_rt.extensions.hardware.matfile import read_mat
from isac_rt.extensions.hardware.store import checked_cube
from isac_rt.extensions.hardware.types import Capture, CaptureError, ti_window
from isac_rt.frame.antennas import Antennas, ti_cascade
from isac_rt.frame.cube import IFCube
from isac_rt.frame.waveform import Sweep, Waveform
from isac_rt.results.files import ResultsError
from isac_rt.runtime import shortly
from isac_rt.storage import BAD_DATA, read_whole

TI_SAMPLING_RATE = 8e6
"""Of TI's calibration captures [Hz], where their file does not state it."""
MOST_BYTES = 2 * 1024**3
MOST_META_BYTES = 8 * 1024**2
"""No description of a recording is larger."""
SUFFIXES = {
    ".mat": "ti_calibration",
    ".bin": "dca1000",
    ".npy": "numpy",
    ".sigmf-meta": "sigmf",
    ".sigmf-data": "sigmf",
}
_SIGMF_TYPES = {
    f"{part}{kind}{8 * size}{end}": f"{mark}{kind}{size}"
    for part in "rc"
    for kind, sizes in (("f", (4, 8)), ("i", (2, 4)), ("u", (2, 4)))
    for size in sizes
    for end, mark in (("_le", "<"), ("_be", ">"))
} | {f"{part}{kind}8": f"{kind}1" for part in "rc" for kind in "iu"}
"""Numpy's names of a number of each; of a complex sample there are two."""
Recording = tuple[int, Callable[[int], Capture]]
"""Frames of a file, and how each is made."""
MOST_AMPLITUDE = 1e12
"""No converter counts so far; powers of larger samples overflow."""


def import_file(
    file: str | Path, description: Description | None = None, format: str | None = None
) -> Capture:
    """One measured frame from a file of a radar board.

    Parameters
    ----------
    file : TI's calibration (.mat), a DCA1000's raw samples (.bin), NumPy (.npy) or SigMF
    description : what the file does not say of itself; a TI calibration needs none
    format : kind of file; None: as the description or the file's name says

    Raises
    ------
    CaptureError  If the file cannot be read, does not fit the description, or holds what is no
        number.
    """
    found = import_frames(file, description, format)
    frame = 0 if description is None or len(found) == 1 else description.frame
    if frame >= len(found):
        raise CaptureError(f"{file}: has frames 0 to {len(found) - 1}; frame: {frame} is none")
    return found[frame]


def import_frames(
    file: str | Path, description: Description | None = None, format: str | None = None
) -> Sequence[Capture]:
    """All measured frames of a file; parameters and errors as of `import_file`. A frame is checked
    when it is taken."""
    file, said = Path(file), description or Description()
    kind = format or said.format or SUFFIXES.get(file.suffix)
    if kind not in _READERS:
        raise CaptureError(
            f"{file}: a name that ends in {file.suffix or 'nothing'} does not tell the format; "
            f"state one of {', '.join(_READERS)}"
        )
    count, make = _READERS[kind](file, said)
    return Frames(count, lambda k: _checked(file, make(k)))


class Frames(Sequence[Capture]):
    """Frames of a file, each made when it is taken."""

    def __init__(self, count: int, make: Callable[[int], Capture]) -> None:
        self._count, self._make = count, make

    def __len__(self) -> int:
        return self._count

    def __getitem__(self, k: Any) -> Any:
        if not -self._count <= k < self._count:
            raise IndexError(k)
        return self._make(int(k))


def _checked(file: Path, found: Capture) -> Capture:
    """A frame whose samples are finite and of a converter's size."""
    bad = int((~np.isfinite(found.cube.samples)).sum())
    if bad:
        raise CaptureError(
            f"{file}: {bad} of {found.cube.samples.size} samples are not finite; leave such chirps "
            "out"
        )
    largest = float(np.abs(found.cube.samples).max(initial=0.0))
    if largest > MOST_AMPLITUDE:
        raise CaptureError(
            f"{file}: the largest sample is {largest:g}, at most {MOST_AMPLITUDE:g} can be read; "
            "scale them to counts of the converter or volts"
        )
    return found


# ---- TI's calibration


def _ti_calibration(file: Path, d: Description) -> Recording:
    """The mean chirp of every channel, as TI's calibration keeps it: its zero-padded FFT under the
    window sin^2(pi (n+1)/(N+1))."""
    tree = read_mat(file)
    result, params = tree.get("calibResult"), tree.get("params")
    spectra = result.get("Rx_fft") if isinstance(result, dict) else None
    if not isinstance(spectra, np.ndarray) or spectra.ndim != 3 or min(spectra.shape) < 1:
        seen = "no array" if not isinstance(spectra, np.ndarray) else f"an array of {spectra.shape}"
        raise CaptureError(
            f"{file}: calibResult.Rx_fft is {seen}, a calibration has (cells, receivers, "
            "transmitters); give a file that TI's cascade calibration wrote"
        )
    if max(spectra.shape[1:]) > MOST_ELEMENTS:
        raise CaptureError(
            f"{file}: calibResult.Rx_fft is of {spectra.shape[1]} receivers and {spectra.shape[2]} "
            f"transmitters, at most {MOST_ELEMENTS} of each can be read"
        )
    params = params if isinstance(params, dict) else {}
    stated = params.get("Slope_MHzperus"), params.get("Sampling_Rate_sps")
    slope = _stated(file, stated[0], d.slope_mhz_per_us, ("slope", "MHz/us", 1e-6, 1e6))
    rate = _stated(file, stated[1], d.sampling_rate_hz, ("sampling rate", "samples/s", 1.0, 1e13))
    if slope is None:
        raise CaptureError(f"{file}: no slope is stated; give slope_mhz_per_us in a description")
    samples = _without_window(file, spectra, d.samples_per_chirp)
    size, num_rx, num_tx = samples.shape
    said = Description.model_validate(
        d.model_dump()
        | {
            "slope_mhz_per_us": slope,
            "sampling_rate_hz": rate or TI_SAMPLING_RATE,
            "samples_per_chirp": size,
            "chirps": tuple(range(num_tx)),
            "loops": 1,
        }
    )
    _same(file, "receivers", num_rx, d.receivers)
    antennas = d.antennas()
    if antennas is None and (num_tx, num_rx) == (12, 16):
        antennas = Antennas.placed(*ti_cascade())
    chirps = samples.transpose(1, 2, 0)[None]  # (group, rx, chirp, sample)
    return 1, lambda _: _capture(file, said, chirps, antennas, "ti_calibration")


def _stated(
    file: Path, found: Any, described: float | None, about: tuple[str, str, float, float]
) -> float | None:
    """A number that the file states or the description; refused where they differ. `about`: what it
    is, its unit, the least and the largest that there is."""
    what, unit, least, most = about
    if not isinstance(found, np.ndarray) or found.size == 0:
        return described
    value = float(np.ravel(found)[0].real)
    if found.size != 1:
        raise CaptureError(f"{file}: states {found.size} numbers for the {what}; state one")
    if not (math.isfinite(value) and value > 0):
        raise CaptureError(f"{file}: the {what} is {value:g} {unit}, it must be above 0")
    if not least <= value <= most:
        raise CaptureError(
            f"{file}: the {what} is {value:g} {unit}, between {least:g} and {most:g} can be read"
        )
    if described is not None and abs(described / value - 1) > 1e-6:
        raise CaptureError(
            f"{file}: the file states a {what} of {value:g} {unit}, the description {described:g}; "
            "leave the latter out or correct it"
        )
    return value


def _without_window(file: Path, spectra: np.ndarray, stated: int | None) -> np.ndarray:
    """IF samples (N, L_rx, L_tx) of zero-padded spectra under TI's window."""
    if not np.isfinite(spectra).all():
        bad = int((~np.isfinite(spectra)).sum())
        raise CaptureError(
            f"{file}: {bad} of {spectra.size} numbers of Rx_fft are not finite; capture again"
        )
    padded = np.fft.ifft(spectra.astype(np.complex128), axis=0)
    level = np.abs(padded).max(axis=(1, 2))
    least = level.max() * 1e-6  # single precision leaves some 1e-7 behind the chirp's end
    if not least > 0:
        raise CaptureError(f"{file}: Rx_fft is zero everywhere; capture again")
    size = int(np.flatnonzero(level > least)[-1]) + 1
    if stated is not None and size > stated:
        raise CaptureError(
            f"{file}: the chirps have {size} samples, the description states {stated}; correct "
            "samples_per_chirp"
        )
    size = stated or size
    if not 16 <= size <= 65536:
        raise CaptureError(f"{file}: the chirps have {size} samples, 16 to 65536 can be read")
    return np.asarray(padded[:size] / ti_window(size)[:, None, None])


# ---- DCA1000


def _dca1000(file: Path, d: Description) -> Recording:
    """Raw samples of 16 bits as TI's capture card streams them."""
    said = _complete(file, d)
    rows, num_rx, size = said.loops * len(said.chirps), said.receivers, said.size
    parts = 1 if d.sampling == "real" else 2
    content = _read(file)
    said = _counted(said, len(content), 2 * parts * rows * num_rx * size)
    _fits(file, said, len(content), 2 * parts * said.frames * rows * num_rx * size)
    rows *= said.frames
    words = np.frombuffer(content, "<i2").astype(np.float32)
    shape = (rows, size, num_rx) if d.interleaved else (rows, num_rx, size)
    if parts == 1:
        flat = words.reshape(shape).astype(np.complex64)
    elif d.interleaved:
        pairs = words.reshape(rows, size, 2, num_rx)
        flat = _joined(pairs[:, :, 0], pairs[:, :, 1], d)
    else:
        if size % 2:
            raise CaptureError(
                f"{file}: {size} samples per chirp; two lanes deliver an even number of them"
            )
        pairs = words.reshape(rows, num_rx, size // 2, 2, 2)
        flat = _joined(pairs[:, :, :, 0], pairs[:, :, :, 1], d).reshape(shape)
    by_rx = flat.transpose(0, 2, 1) if d.interleaved else flat
    return _framed(file, said, by_rx.reshape(said.frames, -1, num_rx, size), "dca1000")


def _joined(first: np.ndarray, second: np.ndarray, d: Description) -> np.ndarray:
    i, q = (second, first) if d.q_first else (first, second)
    return (i + 1j * q).astype(np.complex64)


# ---- NumPy and SigMF


def _numpy(file: Path, d: Description) -> Recording:
    try:
        array = np.load(io.BytesIO(_read(file)), allow_pickle=False)
    except (OSError, EOFError, MemoryError, SyntaxError, TokenError, *BAD_DATA):
        raise CaptureError(
            f"{file}: is no NumPy file of numbers; save an array with numpy.save"
        ) from None
    if not isinstance(array, np.ndarray) or array.dtype.kind not in "iufc":
        raise CaptureError(f"{file}: holds no array of numbers; save one with numpy.save")
    return _ordered(file, array, d, "numpy")


def _sigmf(file: Path, d: Description) -> Recording:
    base = _without_end(file)
    meta, data = (base.with_name(base.name + end) for end in (".sigmf-meta", ".sigmf-data"))
    try:
        info = json.loads(_read(meta, MOST_META_BYTES))["global"]
        kind = str(info["core:datatype"])
    except BAD_DATA as problem:
        raise CaptureError(f"{meta}: is no SigMF description ({shortly(problem)})") from None
    if "isac_rt:waveform" in info:
        whole = Capture(cube=read_sigmf(base), source={"file": file.name, "format": "sigmf"})
        return 1, lambda _: whole
    if kind not in _SIGMF_TYPES:
        raise CaptureError(
            f"{meta}: samples of type {kind} are not read; r or c with f32, f64, i16, u16, i32 or "
            "u32 and _le or _be are, such as ci16_le, and ri8, ru8, ci8, cu8"
        )
    d = _as_stated(meta, info, d)
    content, dtype = _read(data), np.dtype(_SIGMF_TYPES[kind])
    checksum = info.get("core:sha512")
    if checksum is not None and hashlib.sha512(content).hexdigest() != str(checksum).lower():
        raise CaptureError(f"{data}: is not what core:sha512 of {meta.name} says; copy both again")
    if len(content) % dtype.itemsize:
        raise CaptureError(
            f"{data}: {len(content)} bytes are no whole number of samples of {dtype.itemsize} bytes"
        )
    flat = np.frombuffer(content, dtype)
    if kind.startswith("c"):
        if flat.size % 2:
            raise CaptureError(f"{data}: {flat.size} numbers are no pairs of I and Q")
        pairs = _unwrapped(flat, d).astype(np.float64).reshape(-1, 2)
        return _ordered(data, pairs[:, 0] + 1j * pairs[:, 1], d, "sigmf")
    return _ordered(data, flat, d, "sigmf")


def _as_stated(meta: Path, info: dict[str, Any], d: Description) -> Description:
    """The description with what the recording says of itself; refused where they differ."""
    rate, channels = (info.get(f"core:{key}") for key in ("sample_rate", "num_channels"))
    for key, value in (("sample_rate", rate), ("num_channels", channels)):
        if value is not None and not _is_finite(value):
            said = str(value) if isinstance(value, str | float) else type(value).__name__
            raise CaptureError(f"{meta}: core:{key} is {said[:40]!r}, no number; correct it")
    if channels is not None and channels != 1:  # 1 is what writers state of one interleaved stream
        if channels != round(channels) or not 1 <= channels <= MOST_ELEMENTS:
            raise CaptureError(
                f"{meta}: core:num_channels is {channels:g}, 1 to {MOST_ELEMENTS} can be read"
            )
        _same(meta, "channels", int(channels), d.receivers)
        if d.axes[-1] != "receiver":
            raise CaptureError(
                f"{meta}: {channels:g} channels take turns sample by sample, the description's "
                f"axes end with {d.axes[-1]}; let them end with receiver"
            )
    if rate is None:
        return d
    about = ("sampling rate", "samples/s", 1.0, 1e13)
    found = _stated(meta, np.array(rate, np.float64), d.sampling_rate_hz, about)
    return d.model_copy(update={"sampling_rate_hz": found})


def _is_finite(value: Any) -> bool:
    """Return whether a value of JSON is a number that a float holds."""
    try:
        return isinstance(value, int | float) and math.isfinite(value)
    except OverflowError:  # an integer of hundreds of digits
        return False


def _without_end(file: Path) -> Path:
    """The name that both files of a SigMF recording share."""
    return file.with_suffix("") if file.suffix in (".sigmf-meta", ".sigmf-data") else file


def read_sigmf(file: str | Path) -> IFCube:
    """An IF cube from a recording that `write_sigmf` made; `file` is either of its files, or their
    name without the suffix.

    Raises
    ------
    ResultsError  If it is none, or its data are not those of its checksum.
    """
    base = _without_end(Path(file))
    try:
        meta = read_whole(base.with_name(base.name + ".sigmf-meta"), MOST_META_BYTES)
        data = read_whole(base.with_name(base.name + ".sigmf-data"))
        info = json.loads(meta)["global"]
        if hashlib.sha512(data).hexdigest() != info["core:sha512"]:
            raise ValueError("the data are not those of its checksum")
        w, schedule = info["isac_rt:waveform"], np.array(info["isac_rt:schedule"])
        shape = (w["num_chirps"], w["num_samples"], len(schedule), -1)
        samples = np.frombuffer(data, "<c8").reshape(shape).transpose(2, 3, 0, 1)
        return checked_cube(samples, w, schedule, info["isac_rt:start_time_s"])
    except (OSError, MemoryError, *BAD_DATA) as problem:
        raise ResultsError(
            f"cannot read an IF cube from {base}: {shortly(problem)}; give a recording that "
            "`write_sigmf` made"
        ) from problem


def _unwrapped(values: np.ndarray, d: Description) -> np.ndarray:
    return np.where(values >= 32768, values - 65536.0, values) if d.wrapped else values


def _ordered(file: Path, array: np.ndarray, d: Description, kind: str) -> Recording:
    """The frames of an array whose axes the description names."""
    said = _complete(file, d)
    of_frame = said.loops * len(said.chirps) * said.receivers * said.size
    said = _counted(said, array.size, of_frame)
    sizes = {
        "frame": said.frames,
        "loop": said.loops,
        "chirp": len(said.chirps),
        "receiver": said.receivers,
        "sample": said.size,
    }
    shape = tuple(sizes[name] for name in d.axes)
    if array.size != math.prod(shape):
        raise CaptureError(
            f"{file}: an array of {' x '.join(map(str, array.shape))} has {array.size} numbers, "
            f"{' x '.join(f'{n} {name}s' for name, n in zip(d.axes, shape, strict=True))} make "
            f"{math.prod(shape)}; correct the description"
        )
    if np.iscomplexobj(array) == (d.sampling == "real"):
        holds, other = ("complex", "complex_1x") if d.sampling == "real" else ("real", "real")
        raise CaptureError(
            f"{file}: holds {holds} numbers, the description states sampling: {d.sampling}; "
            f"state {other}, or save the numbers that it means"
        )
    if np.iscomplexobj(array):
        array = _unwrapped(array.real, d) + 1j * _unwrapped(array.imag, d)
    else:
        array = _unwrapped(array, d)
    wanted = [d.axes.index(name) for name in ("frame", "loop", "chirp", "receiver", "sample")]
    frames = array.reshape(shape).transpose(wanted)
    return _framed(file, said, frames.reshape(said.frames, -1, said.receivers, said.size), kind)


# ---- what all have in common


class _Complete(Description):
    """A description with every number that a cube needs."""

    slope_mhz_per_us: float
    sampling_rate_hz: float
    samples_per_chirp: int
    receivers: int

    @property
    def size(self) -> int:
        return self.samples_per_chirp


def _complete(file: Path, d: Description) -> _Complete:
    needed = ("slope_mhz_per_us", "sampling_rate_hz", "samples_per_chirp", "receivers")
    missing = [name for name in needed if getattr(d, name) is None]
    if missing:
        raise CaptureError(
            f"{file}: does not say its {', '.join(missing)}; state them in a description"
        )
    return _Complete.model_validate(d.model_dump())


def _read(file: Path, most: int = MOST_BYTES) -> bytes:
    try:
        return read_whole(file, most)
    except OSError as problem:
        raise CaptureError(f"{file}: cannot be read: {problem.strerror}; check the path") from None


def _counted(d: _Complete, found: int, each: int) -> _Complete:
    """Return a description that states the frames of a file, which 0 leaves to its size."""
    return d if d.frames else d.model_copy(update={"frames": max(1, found // each)})


def _fits(file: Path, d: _Complete, found: int, wanted: int) -> None:
    """Refuse a file of another size. A recording that was cut off within a frame cannot be told
    from a wrong description, so neither is read."""
    if found == wanted:
        return
    each = wanted // d.frames
    whole, rest = divmod(found, each)
    offer = "correct the description"
    if whole and not rest:
        offer = f"state frames: {whole} (frameCfg or numFrames of a board's file), or 0 for all"
    if whole and rest:
        offer += f", or cut the file off at {whole * each} bytes, its last whole frame"
    raise CaptureError(
        f"{file}: has {found} bytes, the description asks for {wanted}: {d.frames} frames x "
        f"{d.loops} loops x {len(d.chirps)} chirps x {d.receivers} receivers x {d.size} "
        f"samples of {2 if d.sampling == 'real' else 4} bytes; {offer}"
    )


def _same(file: Path, what: str, found: int, stated: int | None) -> None:
    if stated is not None and found != stated:
        raise CaptureError(
            f"{file}: has {found} {what}, the description states {stated}; correct it"
        )


def _framed(file: Path, d: _Complete, frames: np.ndarray, kind: str) -> Recording:
    """The frames of (frames, chirps, L_rx, N)."""

    def frame(k: int) -> Capture:
        return _capture(file, d, frames[k].transpose(1, 0, 2)[None], d.antennas(), kind)

    return len(frames), frame


def waveform_described(d: Description) -> Waveform:
    """A board's chirp as a `Waveform` without data."""
    assert d.slope_mhz_per_us and d.sampling_rate_hz and d.samples_per_chirp
    slope, start = d.slope_mhz_per_us * 1e12, d.adc_start_us * 1e-6
    end = start + d.samples_per_chirp / d.sampling_rate_hz
    again = end if d.chirp_interval_us is None else d.chirp_interval_us * 1e-6
    if again < end - start:
        raise CaptureError(
            f"chirp_interval_us: {again * 1e6:g} us from chirp to chirp, but the samples of one "
            f"take {(end - start) * 1e6:g} us; correct the description"
        )
    return Waveform(
        carrier_frequency=d.carrier_hz,
        bandwidth=slope * end,
        sampling_rate=d.sampling_rate_hz,
        num_samples=d.samples_per_chirp,
        num_chirps=d.loops * len(d.chirps),
        num_groups=1,
        num_tx=d.num_tx,
        sweep=Sweep(slope, end, start, again),
        carries_data=False,
    )


def _capture(
    file: Path, d: Description, chirps: np.ndarray, antennas: Antennas | None, kind: str
) -> Capture:
    """A capture of (1, L_rx, chirps, N) samples."""
    if antennas is not None:
        _same(file, "receivers", chirps.shape[1], antennas.num_rx)
        _same(file, "transmitters", d.num_tx, antennas.num_tx)
    with np.errstate(over="ignore", invalid="ignore"):  # infinite numbers are refused later
        samples = np.ascontiguousarray(chirps, np.complex64)
    cube = IFCube(
        samples=samples,
        waveform=waveform_described(d),
        schedule=np.tile(np.array(d.chirps, np.int64), d.loops)[None],
        start_time=0.0,
    )
    return Capture(
        cube=cube,
        antennas=antennas,
        source={"file": file.name, "format": kind, "sampling": d.sampling},
    )


_READERS: dict[str, Callable[[Path, Description], Recording]] = {
    "ti_calibration": _ti_calibration,
    "dca1000": _dca1000,
    "numpy": _numpy,
    "sigmf": _sigmf,
}
FORMATS = tuple(_READERS)
