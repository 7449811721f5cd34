"""Hits of one target in noise, frame by frame, for figure 14: AT, PT, conventional FMCW and
mmWave-LoRadar.

A frame holds one target (or, at a PT, one line of sight). The signal is the program's own; spectra
and maps are linear in the samples as long as the data are known, so that those of the signal and of
the noise serve all SNR points. At a PT the data are decided anew at every SNR. The estimate is that
of the strongest cell of the map: there is one target, and the receiver is told so. A hit is an
estimate whose errors in range, velocity and both direction cosines are all below the resolution.
With "detected" the cell is above the CFAR's threshold as well. A PT beside clutter, whose cells are
stronger than its line of sight, looks near its prediction only, as the program's receiver does
("gated").
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, replace
from functools import partial
from typing import Literal

import numpy as np
import scipy.fft

from isac_rt.frame.antennas import Antennas, unit_vector
from isac_rt.frame.cube import IFCube, ReceiveArray, Reference
from isac_rt.frame.payload import Payload, random_payload
from isac_rt.frame.schedule import Schedule, conventional_schedule, pseudo_random_schedule
from isac_rt.frame.waveform import SPEED_OF_LIGHT, Waveform
from isac_rt.kernels.jit import jit
from isac_rt.propagation.clutter.rayleigh import rayleigh_cells
from isac_rt.propagation.pathset import PathKind
from isac_rt.propagation.settings import Clutter
from isac_rt.randomness import generator
from isac_rt.receive.cfar import CfarRule, first_row
from isac_rt.receive.clutter_filter import RUN_CELLS, remove_static
from isac_rt.receive.estimate import Estimate, LocalSpectra, refine, start_point, to_delay
from isac_rt.receive.known import Known
from isac_rt.receive.maps import accumulate, channel_maps
from isac_rt.receive.passive import GATE_BINS, GATE_CELLS, predicted_cell
from isac_rt.receive.sense import describe
from isac_rt.receive.settings import Receivers
from isac_rt.receive.spectrum import clean_spectrum, tones
from isac_rt.receive.symbols import demodulate
from isac_rt.receive.types import Prediction
from isac_rt.signal.if_signal import if_signal
from isac_rt.signal.methods import Auto, Direct
from reproduce.baselines import Echoes, LoRadar, fmcw_frame, loradar_frame, resolution
from reproduce.baselines.fmcw import fmcw_spectra
from reproduce.baselines.loradar import Compensation, loradar_delay, loradar_spectra
from reproduce.baselines.tdm import doppler_maps, estimate_tdm
from reproduce.montecarlo import Counts
from reproduce.symbols import PLACE, RANGE_ERROR_CELLS, VELOCITY_ERROR, paper_antennas
from reproduce.waves import STILL, prediction, sender, waves

NEAREST, FARTHEST, WIDEST = 5.0, 100.0, 50.0
"""Ranges (of a PT: path lengths) [m] and azimuths and elevations [deg] that targets are drawn from,
uniformly."""
FASTEST = 0.93
"""Largest speed drawn, as a share of the unambiguous one."""
SETTINGS = Receivers()

Kind = Literal["FMCW", "AT", "PT", "LoRadar"]


@dataclass(frozen=True, kw_only=True)
class Setting:
    """What is simulated.

    Attributes
    ----------
    name : of the curve; draws depend on it
    kind : whose receiver
    snr_db : the points
    groups : M; more than one for the AT alone
    samples : per chirp
    orders : of DPSK, each with its own curve; the first one counts where the data are known
    speed : largest speed drawn, as a share of the unambiguous one of the full pulse rate
    fixed : PT1's place in the first frame of Table II instead of a target anywhere
    clutter : the paper's Rayleigh clutter, at rest, data and all
    filtered : the paper's clutter filter
    profile : a PT that predicts the clutter's cells and powers too
    known : a PT that is told the data
    gated : a PT that looks for the strongest cell near its prediction only
    unwindowed : an AT that also looks at range spectra without a window
    """

    name: str
    kind: Kind
    snr_db: tuple[float, ...]
    groups: int = 1
    samples: int = 1024
    orders: tuple[int, ...] = (8,)
    speed: float = FASTEST
    fixed: bool = False
    clutter: bool = False
    filtered: bool = False
    profile: bool = False
    known: bool = False
    gated: bool = False
    unwindowed: bool = False

    @property
    def passes(self) -> int:
        """1 for the way to a PT, 2 for that of echoes."""
        return 1 if self.kind == "PT" else 2

    @property
    def waveform(self) -> Waveform:
        w = Waveform(num_samples=self.samples, num_groups=self.groups)
        return fmcw_frame(w)[0] if self.kind == "FMCW" else w


@dataclass(frozen=True)
class Target:
    """Range, velocity, u_x, u_z, and the clutter's ranges and amplitudes."""

    truth: np.ndarray
    departure: np.ndarray
    phase: complex
    ranges: np.ndarray
    amplitudes: np.ndarray


def draw_target(case: Setting, rng: np.random.Generator) -> Target:
    """A target anywhere in view or PT1's place, and clutter."""
    w = case.waveform
    (u, away), distance = _directions(rng), rng.uniform(NEAREST, FARTHEST)
    velocity = rng.uniform(-1, 1) * case.speed * w.max_velocity(case.passes)
    if case.fixed:
        distance = float(np.linalg.norm(PLACE))
        u = away = np.array([PLACE[0] / distance, 0.0])
    phase = np.exp(2j * np.pi * rng.random())
    ranges, amplitudes = np.zeros(0), np.zeros(0)
    if case.clutter:
        ranges, amplitudes = rayleigh_cells(
            Clutter(model="rayleigh"), w.range_cell(case.passes), rng
        )
    return Target(np.array([distance, velocity, *u]), away, phase, ranges, amplitudes)


def _directions(rng: np.random.Generator) -> np.ndarray:
    """(2, 2) direction cosines of arrival and of departure."""
    azimuth, elevation = np.deg2rad(rng.uniform(-WIDEST, WIDEST, (2, 2)))
    return np.stack([np.cos(elevation) * np.sin(azimuth), np.sin(elevation)], axis=1)


def make_cube(case: Setting, target: Target, schedule: np.ndarray, payload: Payload) -> IFCube:
    """Noise-free samples of a target of unit amplitude, and clutter from the same direction."""
    w, antennas = case.waveform, paper_antennas(case.waveform)
    (distance, velocity), u = target.truth[:2], unit_vector(target.truth[2:])
    lengths = case.passes * np.append(distance, target.ranges)
    still = np.arange(lengths.size) > 0
    away = u if case.passes == 2 else unit_vector(target.departure)
    paths = waves(
        w.frame_duration / 2,
        lengths / SPEED_OF_LIGHT,
        np.where(still, 0.0, case.passes * velocity / SPEED_OF_LIGHT),
        gain=np.append(target.phase, target.amplitudes),
        ends=(away, u),
        kind=np.where(still, PathKind.DIFFUSE, PathKind.TARGET),
        radius=lengths / case.passes,
    )
    sent = sender(antennas, schedule, payload)
    method = Auto(max_direct=1) if case.clutter else Direct()
    return if_signal(w, [(sent, paths)], ReceiveArray(STILL, antennas), Reference(0.0), method)


def make_noise(case: Setting, seed: int, index: int) -> np.ndarray:
    """(M, L_rx, P, N) complex64 of unit power."""
    w, rng = case.waveform, generator(seed, "hit noise", case.name, index)
    pairs = rng.standard_normal((w.num_groups, 15, w.num_chirps, 2 * w.num_samples), np.float32)
    pairs *= np.float32(np.sqrt(0.5))
    return pairs.view(np.complex64)


def count_hits(case: Setting, seed: int, index: int) -> Counts:
    """Hits of frame `index` by method, at every SNR of the case."""
    found: dict[str, list[tuple[int, int]]] = {}

    def note(name: str, count: int, of: int = 1) -> None:
        found.setdefault(name, []).append((int(count), of))

    rng = generator(seed, "hits", case.name, index)
    target = draw_target(case, rng)
    run = {"FMCW": _fmcw, "AT": _active, "PT": _passive, "LoRadar": _loradar}[case.kind]
    run(case, target, rng, partial(make_noise, case, seed, index), note)
    return {
        name: (np.array([c for c, _ in counts]), counts[0][1]) for name, counts in found.items()
    }


Note = Callable[..., None]
MakeNoise = Callable[[], np.ndarray]


def levels(case: Setting) -> np.ndarray:
    """Noise amplitudes of the SNR points; a sample of the target has unit power."""
    return 10 ** (-np.array(case.snr_db) / 20)


def hit(case: Setting, target: Target, estimate: Estimate, antennas: Antennas) -> bool:
    """Whether all four errors are below the resolution."""
    w = case.waveform
    bound = resolution(w, antennas)
    if case.passes == 1:
        spacing = antennas.spacing / w.wavelength
        bound = np.array(
            [
                w.range_cell(1),
                w.velocity_cell(1),
                1 / (spacing * antennas.rx_x),
                1 / (spacing * antennas.rx_z),
            ]
        )
    schedule = conventional_schedule(w.num_groups, w.num_chirps, w.num_tx)
    known = Known.unmodulated(w, schedule, antennas, case.passes)
    d = describe([estimate], np.ones(1), known)
    errors = np.abs(np.array([d.range[0], d.velocity[0], *d.direction[0]]) - target.truth)
    return bool((errors < bound).all())  # an angle out of view is NaN and no hit


def strongest(
    power: np.ndarray, first: int, near: tuple[int, int] | None = None
) -> tuple[int, int]:
    """Row and column of the strongest cell, from row `first` on or within the receiver's gate about
    the cell `near`."""
    if near is not None:
        rows = np.arange(max(near[0] - GATE_CELLS, 0), near[0] + GATE_CELLS + 1)
        columns = (np.arange(-GATE_BINS, GATE_BINS + 1) + near[1]) % power.shape[1]
        i, j = np.unravel_index(power[np.ix_(rows, columns)].argmax(), (rows.size, columns.size))
        return int(rows[i]), int(columns[j])
    row, column = np.unravel_index(power[first:].argmax(), power[first:].shape)
    return int(row) + first, int(column)


def is_detected(power: np.ndarray, row: int, column: int, looks: int) -> bool:
    """Whether a cell is above the CFAR's threshold."""
    return bool(CfarRule.of(SETTINGS, looks).detect(power)[0][row, column])


def _fmcw(
    case: Setting, target: Target, rng: np.random.Generator, noise: MakeNoise, note: Note
) -> None:
    w, schedule, payload = fmcw_frame(case.waveform)
    times = np.arange(w.num_chirps) * w.slot_duration
    both = [
        fmcw_spectra(samples[0])
        for samples in (make_cube(case, target, schedule, payload).samples, noise())
    ]
    first = first_row(SETTINGS, w.range_cell(2))
    _tdm(
        case,
        target,
        both,
        (schedule[0], times),
        lambda cell, bin_: to_delay(cell, bin_, w),
        first,
        "hits",
        note,
    )


def _loradar(
    case: Setting, target: Target, rng: np.random.Generator, noise: MakeNoise, note: Note
) -> None:
    system, (r, v, *u) = LoRadar(case.waveform), target.truth
    antennas = paper_antennas(case.waveform)
    echo = Echoes(np.array([r]), np.array([v]), np.array([u]), np.array([target.phase]))
    sent = loradar_frame(system, echo, antennas, 0.0, rng)
    white = noise()[0]
    kinds: tuple[Compensation, ...] = ("ordered", "phase")
    for kind in kinds:
        spectra, times = loradar_spectra(sent, system, kind)
        both = [spectra, loradar_spectra(replace(sent, samples=white), system, kind)[0]]
        _tdm(
            case,
            target,
            both,
            (sent.schedule, times),
            partial(loradar_delay, system),
            first_row(SETTINGS, system.range_cell),
            kind,
            note,
        )


def _tdm(
    case: Setting,
    target: Target,
    both: list[np.ndarray],
    pulses: tuple[np.ndarray, np.ndarray],
    convert: Callable[[float, float], tuple[float, float]],
    first: int,
    name: str,
    note: Note,
) -> None:
    """The baselines' receiver on spectra of signal and noise; `pulses`: antennas and times."""
    schedule, times = pulses
    w, antennas = case.waveform, paper_antennas(case.waveform)
    signal, noise = (doppler_maps(s, schedule, times, w.frame_duration, w.num_tx) for s in both)
    for level in levels(case):
        maps = signal + np.float32(level) * noise
        power = accumulate(maps)
        row, column = strongest(power, first)
        success = hit(
            case,
            target,
            estimate_tdm(maps, power, row, column, schedule, times, convert, w),
            antennas,
        )
        note(name, success)
        note(f"{name}, detected", success and is_detected(power, row, column, 45))


def _active(
    case: Setting, target: Target, rng: np.random.Generator, noise: MakeNoise, note: Note
) -> None:
    w = case.waveform
    schedule = pseudo_random_schedule(w.num_groups, w.num_chirps, w.num_tx, rng)
    payload = random_payload(w, schedule, case.orders[0], rng)
    cubes = [cube := make_cube(case, target, schedule, payload), replace(cube, samples=noise())]
    known = Known.of(cube, payload, paper_antennas(w), 2)
    signal, white = (clean_spectrum(c, known) for c in cubes)
    if case.filtered:  # not linear in the samples
        for level in levels(case):
            spectra = signal + np.float32(level) * white
            remove_static(spectra, schedule, RUN_CELLS)
            look = _Look(case, target, spectra, known)
            note("hits", look.at(one_atom_power(spectra, w, schedule))[0])
            _note_united(look, accumulate(channel_maps(spectra, known)), note)
        return
    sums = {"hits": _Sums(*(correlations(s, w, schedule) for s in (signal, white)))}
    if case.unwindowed:
        sums["hits, no window"] = _Sums(
            *(correlations(plain_spectrum(c, payload), w, schedule) for c in cubes)
        )
    united = _Parts(*(channel_maps(s, known) for s in (signal, white)))
    for level in levels(case):
        spectra = signal + np.float32(level) * white
        look = _Look(case, target, spectra, known)
        for name, one in sums.items():
            note(name, look.at(one.power(level))[0])
        _note_united(look, united.power(level), note)


def _note_united(look: _Look, power: np.ndarray, note: Note) -> None:
    """Whether the map of the united correlations hits (M = L_tx: the transform of the full
    sampling), and whether in a detection."""
    success, cell = look.at(power)
    note("hits, united", success)
    note("hits, united, detected", success and is_detected(power, *cell, 45))


@dataclass(frozen=True)
class _Look:
    """Cleaned spectra of one frame at one SNR and what is known of them."""

    case: Setting
    target: Target
    spectra: np.ndarray
    known: Known
    near: tuple[int, int] | None = None

    def by_omp(self) -> bool:
        """Whether the paper's map hits: OMP, summed over the channels; made near the prediction
        only where nothing else is looked at."""
        w, num_rows = self.case.waveform, self.spectra.shape[2]
        if self.near is None:
            return self.at(one_atom_power(self.spectra, w, self.known.schedule))[0]
        rows = slice(max(self.near[0] - GATE_CELLS, 0), self.near[0] + GATE_CELLS + 1)
        power = np.zeros((num_rows, w.num_chirps))
        power[rows] = one_atom_power(self.spectra[:, :, rows], w, self.known.schedule)
        return self.at(power)[0]

    def at(self, power: np.ndarray) -> tuple[bool, tuple[int, int]]:
        """Whether the estimate at a map's strongest cell hits, and the cell."""
        w = self.case.waveform
        row, column = strongest(
            power, first_row(SETTINGS, w.range_cell(self.case.passes)), self.near
        )
        local = LocalSpectra(self.spectra, self.known, row)
        estimate = refine(local, *start_point(power, row, column, w))
        return hit(self.case, self.target, estimate, self.known.antennas), (row, column)


class _Sums:
    """Maps of OMP with one atom at any noise amplitude, from the correlations of signal and
    noise."""

    def __init__(self, signal: Iterable[np.ndarray], white: Iterable[np.ndarray]) -> None:
        self._pairs = list(zip(signal, white, strict=True))

    def power(self, level: float) -> np.ndarray:
        total = np.zeros(self._pairs[0][0].shape[1:])
        for signal, white in self._pairs:
            _add_strongest(total, signal + np.float32(level) * white)
        return np.fft.fftshift(total, axes=-1)


class _Parts:
    """Mean power over the channels of maps at any noise amplitude s: |S|^2 + 2 s Re(conj(S) W) +
    s^2 |W|^2."""

    def __init__(self, signal: np.ndarray, white: np.ndarray) -> None:
        both = signal + white
        self._signal, self._white, together = (
            accumulate(maps).astype(float) for maps in (signal, white, both)
        )
        self._cross = together - self._signal - self._white

    def power(self, level: float) -> np.ndarray:
        return (self._signal + level * self._cross + level**2 * self._white).astype(np.float32)


def plain_spectrum(cube: IFCube, payload: Payload) -> np.ndarray:
    """As `clean_spectrum` without its Hann window: all samples of every chirp."""
    w, symbols = cube.waveform, payload.delay_symbols
    out = np.empty((*cube.samples.shape[:2], w.num_delay_symbols, w.num_chirps), np.complex64)
    for m, samples in enumerate(cube.samples):
        cells = (symbols[m][:, None] + np.arange(w.num_delay_symbols)) % w.num_samples
        turn = (payload.phases[m].conj() * np.exp(-2j * np.pi * w.data_phase(symbols[m]))).astype(
            np.complex64
        )[:, None]
        turn = turn * tones(w.data_shift(symbols[m]) / w.num_samples, w.num_delay_symbols)
        for rx, one in enumerate(samples):
            out[m, rx] = (
                np.take_along_axis(scipy.fft.fft(one, axis=1, workers=1), cells, axis=1) * turn
            ).T
    return out


def one_atom_power(spectra: np.ndarray, waveform: Waveform, schedule: Schedule) -> np.ndarray:
    """(rows, P) power of OMP with one atom in every vector, summed over groups, antennas and
    receivers, Doppler centred.

    With one atom OMP keeps the strongest correlation of each vector of an antenna's chirps and no
    other.
    """
    total = np.zeros(spectra.shape[2:])
    for found in correlations(spectra, waveform, schedule):
        _add_strongest(total, found)
    return np.fft.fftshift(total, axes=-1)


def correlations(
    spectra: np.ndarray, waveform: Waveform, schedule: Schedule
) -> Iterator[np.ndarray]:
    """(L_rx, rows, P) complex64 for every group and transmit antenna: its chirps against the
    Doppler atoms, FFT order."""
    num_chirps = waveform.num_chirps
    bins = np.fft.fftfreq(num_chirps, 1 / num_chirps)
    for m, group in enumerate(spectra):
        for tx in range(waveform.num_tx):
            chosen = np.flatnonzero(schedule[m] == tx)
            atoms = np.exp(-2j * np.pi * np.outer(chosen, bins) / num_chirps).astype(np.complex64)
            # indexing would leave a layout that the matrix product does not like
            found = np.take(group, chosen, axis=-1).reshape(-1, chosen.size) @ atoms
            yield found.reshape(*group.shape[:2], num_chirps)


@jit
def _add_strongest(total, found):
    """Add the strongest power of every vector of (L_rx, rows, P) to its place in `total`."""
    for one in found:
        for row in range(one.shape[0]):
            best, largest = 0, np.float32(-1)
            for k in range(one.shape[1]):
                power = one[row, k].real ** 2 + one[row, k].imag ** 2
                if power > largest:
                    best, largest = k, power
            total[row, best] += largest


def _passive(
    case: Setting, target: Target, rng: np.random.Generator, noise: MakeNoise, note: Note
) -> None:
    w = case.waveform
    schedule = pseudo_random_schedule(w.num_groups, w.num_chirps, w.num_tx, rng)
    payloads = {order: random_payload(w, schedule, order, rng) for order in case.orders}
    first = payloads[case.orders[0]]
    bare = replace(first, phases=np.ones_like(first.phases))
    predicted = _predict(case, target, rng)
    # the symbols of `first` are on the delays of all; only the phases differ
    cube, white = make_cube(case, target, schedule, bare), noise()
    for level in levels(case):
        for order, payload in payloads.items():
            samples = (
                cube.samples * payload.phases.astype(np.complex64)[:, None, :, None]
                + np.float32(level) * white
            )
            got = replace(cube, samples=samples)
            if case.known:
                note(
                    "data known",
                    _read(case, target, got, first.delay_symbols, payload.phases, predicted),
                )
                continue
            symbols = demodulate(got, predicted, order, RUN_CELLS if case.filtered else None)
            note(
                f"D = {order}, delay errors",
                (symbols.delay != first.delay_symbols).sum(),
                symbols.delay.size,
            )
            note(f"D = {order}", _read(case, target, got, symbols.raw, symbols.phases, predicted))


def _read(
    case: Setting,
    target: Target,
    cube: IFCube,
    delay_symbols: np.ndarray,
    phases: np.ndarray,
    predicted: Prediction,
) -> bool:
    """Whether sensing hits with these symbols taken out."""
    w = case.waveform
    known = Known(w, cube.schedule, delay_symbols, phases, paper_antennas(w), 1)
    near = predicted_cell(predicted, w) if case.gated else None
    return _Look(case, target, clean_spectrum(cube, known), known, near).by_omp()


def _predict(case: Setting, target: Target, rng: np.random.Generator) -> Prediction:
    """The line of sight with the errors of figures 11 and 12, and the clutter where its profile is
    known."""
    error = RANGE_ERROR_CELLS * case.waveform.range_cell(1) * rng.standard_normal()
    rate = rng.uniform(-1, 1) * VELOCITY_ERROR
    ranges, weights = target.truth[:1] + error, np.ones(1)
    if case.profile:
        ranges = np.append(ranges, target.ranges + error)
        weights = np.append(weights, np.abs(target.amplitudes) ** 2)
    velocity = np.where(np.arange(ranges.size) > 0, rate, target.truth[1] + rate)
    return prediction(ranges, velocity, weights, std=(0.0, 0.0))
