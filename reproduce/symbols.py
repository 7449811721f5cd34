"""Symbol errors of a link AT -> PT, frame by frame, for figures 11 and 12.

The noise-free cube is the program's own IF signal with the data delays; noise is drawn where the
receiver decides, in its derotated range cells: the transform of white noise is white. With S the
signal and W the noise of a cell the summed power at noise level s is |S|^2 + 2 s Re(conj(S) W) +
s^2 |W|^2 over the receive antennas, so that one transform serves all SNR points, and turning a
chirp, noise and all, by its DPSK phase serves all orders. Decisions are those of
`isac_rt.receive.symbols`; a test gives both the same samples.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import scipy.fft

from isac_rt.extensions.hardware.front_end import Ends, front_end_of
from isac_rt.extensions.hardware.received import received
from isac_rt.frame.antennas import Antennas
from isac_rt.frame.cube import ReceiveArray, Reference
from isac_rt.frame.front_end import FrontEnd
from isac_rt.frame.payload import Payload, running_phases
from isac_rt.frame.schedule import pseudo_random_schedule
from isac_rt.frame.waveform import SPEED_OF_LIGHT, Waveform
from isac_rt.propagation.clutter.rayleigh import rayleigh_cells
from isac_rt.propagation.pathset import PathKind, merge
from isac_rt.propagation.settings import Clutter
from isac_rt.randomness import generator
from isac_rt.receive.clutter_filter import runs
from isac_rt.receive.symbols import WEAKEST_WEIGHT, decide, decide_transitions, known_cycles
from isac_rt.signal.if_signal import if_signal
from isac_rt.signal.methods import Auto, Direct
from isac_rt.signal.noise import WhiteNoise
from isac_rt.world.swarm import Pose
from reproduce.montecarlo import Counts, Curve, Precision, sample
from reproduce.outcome import Progress
from reproduce.waves import sender, waves

PLACE = np.array([-8.0, 8.0, 0.0])
"""PT1 from the AT in the first frame of Table II [m]."""
RANGE_ERROR_CELLS = 0.1
VELOCITY_ERROR = 0.25
"""Errors of the prediction: standard deviation in range cells; largest, uniform [m/s]."""


IDEAL_NODE = FrontEnd()
PREDICTION_ERROR = f"{RANGE_ERROR_CELLS} cell rms, up to {VELOCITY_ERROR} m/s"


def link_waveform(num_samples: int) -> Waveform:
    """One group of the paper's frame; 512 samples (T = 25.6 us) halve all times and keep the sweep
    of 640 MHz."""
    return Waveform(num_samples=num_samples, num_groups=1, filter_transition=1e6)


def paper_antennas(waveform: Waveform) -> Antennas:
    """The L-shaped arrays of section V."""
    return Antennas(tx_x=2, tx_z=2, rx_x=8, rx_z=8, spacing=0.5774 * waveform.wavelength)


@dataclass(frozen=True, kw_only=True)
class Setting:
    """What is simulated.

    Attributes
    ----------
    name : of the curve; draws depend on it
    waveform : of one group
    random_fraction : whether the path length is drawn within a range cell around the first frame's
        of Table II, or is exactly that
    exact_prediction : whether range and velocity are predicted without error
    clutter : whether the paper's Rayleigh clutter is there, data and all
    profile : whether the receiver predicts the clutter's cells and powers too, as from an
        unmodulated frame (else the line of sight alone)
    run_cells : least run of occupied cells that the paper's clutter filter leaves out of the
        decision; None: no filter
    orders : of the DPSK symbols that are decided
    literal : decide by the paper's letter as well: floor and round on the integer grid, data phases
        left in
    front_end : hardware of both ends, drawn anew for each frame
    """

    name: str
    waveform: Waveform
    random_fraction: bool = False
    exact_prediction: bool = False
    clutter: bool = False
    profile: bool = False
    run_cells: int | None = None
    orders: tuple[int, ...] = ()
    literal: bool = False
    front_end: FrontEnd = IDEAL_NODE


@dataclass(frozen=True)
class LinkFrame:
    """One trial: noise-free samples (L_rx, P, N) of unit amplitude, what was sent, and what the
    receiver expects."""

    samples: np.ndarray
    schedule: np.ndarray
    delay_symbols: np.ndarray
    transitions: dict[int, np.ndarray]
    lengths: np.ndarray
    rate: float
    weights: np.ndarray


def draw_frame(link: Setting, seed: int, index: int) -> LinkFrame:
    """Schedule, data, path and prediction of frame `index`. `lengths`, `weights`: predicted paths,
    line of sight first."""
    w, rng = link.waveform, generator(seed, "symbols", link.name, index)
    antennas = paper_antennas(w)
    schedule = pseudo_random_schedule(1, w.num_chirps, w.num_tx, rng)
    shape = (1, w.num_tx, w.num_chirps // w.num_tx - 1)
    transitions = {order: rng.integers(0, order, shape) for order in link.orders}
    symbols = rng.integers(0, w.num_delay_symbols, (1, w.num_chirps))
    length = float(np.linalg.norm(PLACE))
    if link.random_fraction:
        length += w.range_cell(1) * rng.uniform(-0.5, 0.5)
    direction = PLACE / np.linalg.norm(PLACE)
    epoch, ends = w.frame_duration / 2, (direction, -direction)
    paths = waves(epoch, length / SPEED_OF_LIGHT, ends=ends, radius=length)
    lengths, weights = np.array([length]), np.ones(1)
    if link.clutter:
        ranges, amplitudes = rayleigh_cells(Clutter(model="rayleigh"), w.range_cell(1), rng)
        delay = ranges / SPEED_OF_LIGHT
        others = waves(epoch, delay, gain=amplitudes, ends=ends, kind=PathKind.DIFFUSE)
        paths = merge([paths, others])
        if link.profile:
            lengths = np.append(lengths, ranges)
            weights = np.append(weights, np.abs(amplitudes) ** 2)
    payload = Payload(
        np.zeros(0, np.uint8), symbols, np.zeros(shape, int), np.ones((1, w.num_chirps), complex)
    )
    tx = Pose.at_rest()
    rx = Pose.at_rest(length * direction, (0, -1, 0))
    sent = sender(antennas, schedule, payload, tx)
    method = Auto(max_direct=1) if link.clutter else Direct()
    job = w, [(sent, paths)], ReceiveArray(rx, antennas), Reference(0.0)
    if link.front_end.ideal:
        cube = if_signal(*job, method)
    else:
        own, other = (
            front_end_of(link.front_end, w, antennas, seed, f"{end} {link.name} {index}")
            for end in ("PT", "AT")
        )
        cube = received(*job, Ends(own, (other,)), method, WhiteNoise(0.0, np.zeros(2)))
    errors = 0.0, 0.0
    if not link.exact_prediction:
        errors = RANGE_ERROR_CELLS * rng.standard_normal(), rng.uniform(-1, 1) * VELOCITY_ERROR
    predicted = lengths + errors[0] * w.range_cell(1)
    return LinkFrame(cube.samples[0], schedule, symbols, transitions, predicted, errors[1], weights)


def cell_noise(link: Setting, seed: int, index: int, num_rx: int = 15) -> np.ndarray:
    """(L_rx, P, N) complex64 noise of the range cells, variance N: the transform of white noise of
    unit power."""
    w = link.waveform
    rng = generator(seed, "symbol noise", link.name, index)
    pairs = rng.standard_normal((num_rx, w.num_chirps, 2 * w.num_samples), np.float32)
    pairs *= np.float32(np.sqrt(w.num_samples / 2))
    return pairs.view(np.complex64)


Parts = tuple[np.ndarray, np.ndarray, np.ndarray]
"""Sums over the receivers of |S|^2, Re(conj(S) W) and |W|^2."""


@dataclass(frozen=True)
class Cells:
    """Signal and noise of the range cells, and the parts of their summed power; `windowed`: of
    Hann's, where the filter needs it."""

    signal: np.ndarray
    noise: np.ndarray
    parts: Parts
    windowed: Parts | None = None

    def power(self, level: float, run_cells: int | None = None) -> np.ndarray:
        """(P, N) summed over the receivers at noise amplitude `level`; 0 in runs of occupied
        cells."""
        power = _at_level(self.parts, level)
        if run_cells is not None and self.windowed is not None:
            num_rx = len(self.signal)
            power[runs(_at_level(self.windowed, level) / num_rx, num_rx, run_cells)] = 0
        return power

    def at(self, cells: np.ndarray, level: float) -> np.ndarray:
        """(1, L_rx, P) complex, one cell of every chirp."""
        index = cells.reshape(1, -1, 1)
        both = [
            np.take_along_axis(a, index, axis=2)[..., 0].astype(complex)
            for a in (self.signal, self.noise)
        ]
        return (both[0] + level * both[1])[None]


def _at_level(parts: Parts, level: float) -> np.ndarray:
    return parts[0] + np.float32(2 * level) * parts[1] + np.float32(level**2) * parts[2]


def _parts(signal: np.ndarray, noise: np.ndarray, window: bool) -> Parts:
    total = tuple(np.zeros(signal.shape[1:], np.float32) for _ in range(3))
    for pair in zip(signal, noise, strict=True):
        # Hann's window sin(pi n/N)^2 is 1/2 less half of the mean of the neighbouring cells
        s, n = (
            (a / 2 - (np.roll(a, 1, -1) + np.roll(a, -1, -1)) / 4 if window else a) for a in pair
        )
        total[0][:] += s.real**2 + s.imag**2
        total[1][:] += s.real * n.real + s.imag * n.imag
        total[2][:] += n.real**2 + n.imag**2
    return total[0], total[1], total[2]


def make_cells(
    samples: np.ndarray, beats: np.ndarray, noise: np.ndarray, window: bool = False
) -> Cells:
    """Cells of samples derotated by `beats` (P,); `window`: the windowed powers too."""
    size = samples.shape[-1]
    turn = np.exp(-2j * np.pi * ((beats[:, None] * np.arange(size) / size) % 1.0)).astype(
        np.complex64
    )
    signal = scipy.fft.fft(samples * turn, axis=-1, workers=1, overwrite_x=True)
    return Cells(
        signal, noise, _parts(signal, noise, False), _parts(signal, noise, True) if window else None
    )


def count_errors(link: Setting, snr_db: np.ndarray, seed: int, index: int) -> Counts:
    """Errors of frame `index`: "delay", "dpsk D" (end to end), "dpsk D known delay", and by the
    paper's letter "delay floor", "delay round", "dpsk D literal"."""
    w, frame, noise = link.waveform, draw_frame(link, seed, index), cell_noise(link, seed, index)
    delay, rate = frame.lengths[0] / SPEED_OF_LIGHT, frame.rate / SPEED_OF_LIGHT
    beats = w.beat_cells(delay, rate)
    cells = make_cells(frame.samples, beats[0], noise, link.run_cells is not None)
    offsets = [
        np.round(w.beat_cells(x / SPEED_OF_LIGHT, rate) - beats).astype(int)[0]
        for x in frame.lengths[1:]
    ]
    # the weight is relative to the strongest prediction in the receiver's terms: the line of sight
    # votes with 1
    others = [
        (float(g), o)
        for g, o in zip(frame.weights[1:], offsets, strict=True)
        if g >= WEAKEST_WEIGHT
    ]
    wrong: dict[str, list[int]] = {}

    def note(name: str, count: int) -> None:
        wrong.setdefault(name, []).append(count)

    for level in 10 ** (-np.asarray(snr_db, float) / 20):
        raw = decide(cells.power(level, link.run_cells), others, w)[0][None]
        note("delay", int((np.clip(raw, 0, w.num_delay_symbols - 1) != frame.delay_symbols).sum()))
        for order, sent in frame.transitions.items():
            for name, picks in (("", raw), (" known delay", frame.delay_symbols)):
                picked = (
                    cells.at(picks % w.num_samples, level)
                    * np.exp(-2j * np.pi * known_cycles(w, delay, rate, picks))[:, None]
                )
                note(f"dpsk {order}{name}", _dpsk_errors(picked, frame, order, sent, w))
    if link.literal:
        _by_the_letter(link, frame, noise, beats[0], snr_db, note)
    sizes = {"delay": frame.delay_symbols.size}
    if frame.transitions:
        sizes["dpsk"] = next(iter(frame.transitions.values())).size
    totals = {name: sizes[name.split()[0]] for name in wrong}
    return {name: (np.array(counts), totals[name]) for name, counts in wrong.items()}


def _dpsk_errors(
    picked: np.ndarray, frame: LinkFrame, order: int, sent: np.ndarray, w: Waveform
) -> int:
    turned = picked * running_phases(sent, frame.schedule, order)[:, None]
    return int((decide_transitions(turned, frame.schedule, w.num_tx, order)[0] != sent).sum())


def _by_the_letter(
    link: Setting,
    frame: LinkFrame,
    noise: np.ndarray,
    beats: np.ndarray,
    snr_db: np.ndarray,
    note: Callable[[str, int], None],
) -> None:
    """Peak on the integer grid, less the fractional prediction, floored (the paper) or rounded;
    DPSK with the data's phases left in, but with the conjugate that the paper's detector lacks."""
    w = link.waveform
    first = int(np.floor(beats.min()))
    cells = make_cells(frame.samples, np.full(w.num_chirps, float(first)), noise)
    for level in 10 ** (-np.asarray(snr_db, float) / 20):
        peak = decide(cells.power(level), [], w)[0]
        for name, rule in (("floor", np.floor), ("round", np.round)):
            note(f"delay {name}", int((rule(peak + first - beats) != frame.delay_symbols[0]).sum()))
        for order, sent in frame.transitions.items():
            note(
                f"dpsk {order} literal",
                _dpsk_errors(cells.at(peak % w.num_samples, level), frame, order, sent, w),
            )


def run_link(
    link: Setting, snr_db: np.ndarray, precision: Precision, seed: int, progress: Progress
) -> dict[str, Curve]:
    """The curves of a link, by what they count; each is called "LINK: COUNT"."""
    return sample(
        lambda i: count_errors(link, snr_db, seed, i),
        snr_db,
        precision,
        progress,
        key=f"{seed} {link}",
        prefix=f"{link.name}: ",
    )


def difference(later: Curve, earlier: Curve, level: float) -> tuple[float, float, float]:
    """How many dB `later` passes `level` after `earlier`, with the interval of two independent
    thresholds."""
    a, b = later.threshold(level), earlier.threshold(level)
    middle = a[0] - b[0]
    below, above = np.hypot(a[0] - a[1], b[2] - b[0]), np.hypot(a[2] - a[0], b[0] - b[1])
    return middle, middle - float(below), middle + float(above)


def decibels(found: tuple[float, float, float]) -> str:
    """A threshold or difference and its 95 % interval as text."""
    if not np.isfinite(found[0]):
        return "not reached"
    return f"{found[0]:.2f} dB [{found[1]:.2f}, {found[2]:.2f}]"
