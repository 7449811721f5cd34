"""Calibration of a board from the echo of one strong reflector.

Whatever the array and whatever error each antenna has, one point seen by it gives a matrix of
receivers times transmitters of rank one: amplitude g_r h_t and delay d_r + e_t. What of the echo
is of rank one is the board's and the reflector's, what is not is neither.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from isac_rt.extensions.hardware.types import Capture, CaptureError, ti_window
from isac_rt.frame.cube import IFCube
from isac_rt.frame.waveform import SPEED_OF_LIGHT, Waveform
from isac_rt.runtime import shortly
from isac_rt.storage import BAD_DATA, load_data, save_data

LEAST_SHARE = 0.9
"""Rank-one share from which an echo is that of one reflector. A corner reflector in a room has
0.986 and more; echoes of walls and furniture, and the leakage, mostly stay under 0.8."""
LEAST_SNR_DB = 25.0
"""How far the reflector must stand out of the median range cell [dB]. Corner reflectors in rooms
stand 32 dB and more; second harmonics of the mixer, which have rank one too, reach 20 dB."""
REACH = 6
"""Range cells on each side of the echo that belong to it, and about zero that belong to the
leakage."""
MAX_RESIDUAL_DB = -6.0
"""What one tone per channel leaves of a reflector at most. Measured boards leave -11.5 dB and less;
of two reflectors in neighbouring cells, or of a spectrum that is cut, most is left."""
PADDING = 5
"""Points of the spectrum in a range cell, as TI's calibration has them."""
PASSED = 0.9
"""Share of the sampling rate that the boards' IF filters pass; what is seen beyond are negative
beats next to zero, of leakage, which can have rank one."""
FAINT_DB = 20.0
"""How far a channel may stay below the mean of all [dB]. Boards that work scatter by 1 or 2 dB; an
antenna that is not connected has next to nothing."""
SWEEP_POINTS = 32
ROUNDS = 25
KEY = "calibration 1"
"""Under which a calibration's file keeps its data."""


@dataclass(frozen=True, kw_only=True)
class Calibration:
    """Errors of a board that one reflector shows.

    A sample of receiver r and transmitter t at x = -1 .. 1 of the sweep is that of an ideal board
    times ``rx_gain[r] tx_gain[t] (1 + slope x)``, of an echo that is `rx_delay[r]` + `tx_delay[t]`
    late. Phases hold where the reflector stood; gains, delays and the sweep do not depend on it.

    Attributes
    ----------
    range_m : mean over the channels [m]
    range_scatter_mm : of the channels' ranges after a delay per transmitter and receiver [mm]
    range_bound_mm : what noise alone makes of a channel's range [mm], the Cramer-Rao bound
    rank_one_share : of the power of the amplitudes at the channels' mean beat
    residual_db, residual_deg : standard deviation of these amplitudes' levels [dB] and phases [deg]
        from rank one
    gain_spread_rx_db, gain_spread_tx_db : standard deviation of their mean levels [dB]
    unexplained_db, unexplained_response_db : power within `REACH` cells that one tone per channel
        leaves, and a tone with one linear complex response over the sweep for all channels [dB]
    snr_db : of the reflector over the median range cell [dB]
    rx_gain, tx_gain : (L_rx,), (L_tx,) complex, at each channel's own beat; their mean levels are
        0 dB
    rx_gain_std, tx_gain_std : relative standard deviations of these
    rx_delay, tx_delay : [s], of mean 0
    rx_delay_std, tx_delay_std : [s]
    pair_gain, pair_delay : (L_rx, L_tx) what the best fit with the response has besides these in
        every pair of antennas; of the scene as well as of the board, so `apply` leaves it
    response_slope : complex, over half of the sampled sweep
    response_delay : [s] that goes with it, so that the response as a whole delays nothing: to first
        order an imaginary slope is a delay
    sweep : (3, `SWEEP_POINTS`) frequency [Hz], mean complex response of all channels, and its
        standard deviation; 1 at the middle
    carrier_hz, half_sweep_hz : middle and half width of the sampled sweep
    """

    range_m: float
    range_scatter_mm: float
    range_bound_mm: float
    rank_one_share: float
    residual_db: float
    residual_deg: float
    gain_spread_rx_db: float
    gain_spread_tx_db: float
    unexplained_db: float
    unexplained_response_db: float
    snr_db: float
    rx_gain: np.ndarray
    tx_gain: np.ndarray
    rx_gain_std: np.ndarray
    tx_gain_std: np.ndarray
    rx_delay: np.ndarray
    tx_delay: np.ndarray
    rx_delay_std: np.ndarray
    tx_delay_std: np.ndarray
    pair_gain: np.ndarray
    pair_delay: np.ndarray
    response_slope: complex
    response_delay: float
    sweep: np.ndarray
    carrier_hz: float
    half_sweep_hz: float

    def check_size(self, num_rx: int, num_tx: int) -> None:
        """Refuse samples of other antennas.

        Raises
        ------
        CaptureError
        """
        known = self.rx_gain.size, self.tx_gain.size
        if (num_rx, num_tx) != known:
            raise CaptureError(
                f"the calibration is of {known[0]} receivers and {known[1]} transmitters, the "
                f"samples of {num_rx} and {num_tx}; calibrate this board"
            )


def calibrate(capture: Capture, cosines: tuple[float, float] = (0.0, 0.0)) -> Calibration:
    """Gains, phases, delays and the sweep of a board, from one strong reflector at rest.

    Parameters
    ----------
    cosines : (u_x, u_z) of the reflector; where the elements' places are known, what its place
        does to phases and delays is not counted among the board's

    Raises
    ------
    CaptureError  If no reflector is clear, with its rank-one share and level; if a channel does not
        receive it.
    """
    y, w = capture.channels(), capture.cube.waveform
    if min(y.shape[:2]) < 2:
        raise CaptureError(
            f"{y.shape[0]} receivers and {y.shape[1]} transmitters: a rank is seen from 2 and 2; "
            "calibrate with more antennas"
        )
    cell, snr_db = _reflector(y, w, capture.one_sided)
    cells = _peaks(y, cell)
    amplitude = _amplitudes(y, cells.mean())
    _refuse_faint(amplitude)
    rx, tx, share = _rank_one(amplitude)
    left = amplitude / (rx[:, None] * tx)
    free = left.size - sum(left.shape) + 1
    delay, rx_delay, tx_delay = _additive(cells * w.delay_step)
    scatter = float(np.sqrt((delay**2).sum() / free))
    rx, tx, _ = _rank_one(_amplitudes(y, cells - delay / w.delay_step))
    spread = np.abs(left - 1) * np.sqrt(left.size / free)
    levels, metres = _decibels(amplitude), w.range_cell(2)
    plain, fit = (_unexplained(y, cells, respond=respond) for respond in (False, True))
    _refuse_two(share, plain.unexplained_db, cells.mean() * metres)
    pair = fit.amplitude / (rx[:, None] * tx)
    pair_late = (fit.beat - cells + delay / w.delay_step) * w.delay_step
    rx_late, tx_late = _late(capture, cells.mean() * metres, cosines)
    return Calibration(
        range_m=float(cells.mean() * metres),
        range_scatter_mm=scatter * SPEED_OF_LIGHT / 2 * 1e3,
        range_bound_mm=_bound(y, amplitude) * metres * 1e3,
        rank_one_share=share,
        residual_db=float(_decibels(left).std()),
        residual_deg=float(np.rad2deg(np.angle(left).std())),
        gain_spread_rx_db=float(levels.mean(axis=1).std(ddof=1)),
        gain_spread_tx_db=float(levels.mean(axis=0).std(ddof=1)),
        unexplained_db=plain.unexplained_db,
        unexplained_response_db=fit.unexplained_db,
        snr_db=snr_db,
        rx_gain=_levelled(rx * np.exp(-2j * np.pi * w.effective_carrier * rx_late)),
        tx_gain=_levelled(tx * np.exp(-2j * np.pi * w.effective_carrier * tx_late)),
        rx_gain_std=np.sqrt((spread**2).mean(axis=1) / tx.size),
        tx_gain_std=np.sqrt((spread**2).mean(axis=0) / rx.size),
        rx_delay=_centred(rx_delay - rx_late),
        tx_delay=_centred(tx_delay - tx_late),
        rx_delay_std=np.full(rx.size, scatter / np.sqrt(tx.size)),
        tx_delay_std=np.full(tx.size, scatter / np.sqrt(rx.size)),
        pair_gain=pair,
        pair_delay=_centred(pair_late),
        response_slope=fit.slope,
        response_delay=float(pair_late.mean()),
        sweep=_sweep(y, cells, w),
        carrier_hz=float(w.effective_carrier),
        half_sweep_hz=w.slope * w.sampled_duration / 2,
    )


def _centred_index(size: int) -> np.ndarray:
    """Samples from the middle of the chirp."""
    return np.arange(size) - (size - 1) / 2


def _decibels(amplitude: np.ndarray) -> np.ndarray:
    return np.asarray(20 * np.log10(np.abs(amplitude)))


def _centred(values: np.ndarray) -> np.ndarray:
    return np.asarray(values - values.mean())


def _levelled(gain: np.ndarray) -> np.ndarray:
    """Normalise to a mean level of 0 dB and a mean phase of about 0."""
    phasor = gain.sum() / abs(gain.sum())
    return np.asarray(gain / phasor / np.exp(np.log(np.abs(gain)).mean()))


def _reflector(y: np.ndarray, w: Waveform, one_sided: bool) -> tuple[float, float]:
    """Range cell and SNR [dB] of the strongest echo that is of one reflector."""
    size = y.shape[-1]
    spectra = np.fft.fft(y * ti_window(size), PADDING * size, axis=-1)
    power = (np.abs(spectra) ** 2).mean(axis=(0, 1))
    floor = float(np.median(power))
    if not floor > 0:
        raise CaptureError("the samples are zero in most range cells; capture again")
    first = REACH * PADDING
    last = int(min(size * (0.5 if one_sided else 1.0) - REACH, size * PASSED) * PADDING)
    around = np.lib.stride_tricks.sliding_window_view(power, 4 * PADDING + 1).max(axis=1)
    peaks = [k for k in range(first, last) if power[k] == around[k - 2 * PADDING]]
    tried = [
        (_rank_one(spectra[:, :, k])[2], 10 * float(np.log10(power[k] / floor)), k) for k in peaks
    ]
    clear = [one for one in tried if one[0] >= LEAST_SHARE and one[1] >= LEAST_SNR_DB]
    if not clear:
        share, level, k = max(
            tried, key=lambda t: min(t[0] / LEAST_SHARE, t[1] / LEAST_SNR_DB), default=(0, 0, 0)
        )
        raise CaptureError(
            f"no clear reflector: of {len(tried)} echoes the nearest to one, at "
            f"{k / PADDING * w.range_cell(2):.2f} m, has a rank-one share of {share:.3f} (at least "
            f"{LEAST_SHARE:g}) at {level:.1f} dB over the median cell (at least {LEAST_SNR_DB:g}); "
            "set up one corner reflector in front of the board"
        )
    _, level, k = max(clear, key=lambda one: one[1])
    return k / PADDING, level


def _refuse_faint(amplitude: np.ndarray) -> None:
    """Raise a `CaptureError` if the echo is missing in channels (L_rx, L_tx)."""
    power = np.abs(amplitude) ** 2
    faint = power < power.mean() * 10 ** (-FAINT_DB / 10)
    if faint.any():
        r, t = np.argwhere(faint)[0]
        raise CaptureError(
            f"receiver {r} receives the reflector from TX {t} more than {FAINT_DB:g} dB below "
            f"the mean of all, and so do {faint.sum()} of {faint.size} channels; see whether these "
            "antennas are connected"
        )


def _refuse_two(share: float, unexplained: float, metres: float) -> None:
    """Raise a `CaptureError` if the echo that was fitted is not that of one reflector."""
    if share < LEAST_SHARE or unexplained > MAX_RESIDUAL_DB:
        raise CaptureError(
            f"no clear reflector: what stands at {metres:.2f} m has a rank-one share of "
            f"{share:.3f} (at least {LEAST_SHARE:g}), and one tone leaves {unexplained:.1f} dB "
            f"of it (at most {MAX_RESIDUAL_DB:g}); keep other things out of the reflector's range "
            "cells, and see whether the file holds whole spectra"
        )


def _peaks(y: np.ndarray, cell: float) -> np.ndarray:
    """Maximum-likelihood beat of every channel [range cells] within two cells, under the window."""
    size = y.shape[-1]
    index = _centred_index(size)
    still = y * ti_window(size) * np.exp(-2j * np.pi * cell / size * index)
    offset = np.linspace(-2, 2, 41)
    spectra = still @ np.exp(-2j * np.pi / size * np.outer(index, offset))
    found = offset[np.abs(spectra).argmax(axis=-1)]
    exponent = -2j * np.pi / size * index
    for _ in range(ROUNDS):  # Newton on the periodogram
        e = still * np.exp(found[..., None] * exponent)
        s, d, dd = e.sum(axis=-1), e @ exponent, e @ exponent**2
        curvature = np.abs(d) ** 2 + (s.conj() * dd).real
        step = (s.conj() * d).real / np.where(curvature < 0, curvature, -(np.abs(d) ** 2) - 1e-300)
        found = found - np.clip(step, -0.1, 0.1)
    return np.asarray(cell + found)


def _amplitudes(y: np.ndarray, cells: float | np.ndarray) -> np.ndarray:
    """Complex amplitudes at the middle of the chirp, of a tone at `cells`, under the window."""
    size = y.shape[-1]
    window = ti_window(size) / ti_window(size).sum()
    index = _centred_index(size)
    phasors = np.exp(-2j * np.pi / size * np.multiply.outer(np.asarray(cells), index))
    return np.asarray((y * (window * phasors)).sum(axis=-1))


def _rank_one(a: np.ndarray) -> tuple[np.ndarray, np.ndarray, float]:
    """Factors of the nearest matrix of rank one, and its share of the power."""
    u, s, v = np.linalg.svd(a)
    total = float((s**2).sum())
    share = float(s[0] ** 2) / total if total > 0 else 0.0
    return u[:, 0] * np.sqrt(s[0]), v[0] * np.sqrt(s[0]), share


def _additive(values: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Fit a sum of a term by row and one by column; return the residual and these terms less their
    mean."""
    rows, columns = (_centred(values.mean(axis=axis)) for axis in (1, 0))
    return values - values.mean() - rows[:, None] - columns, rows, columns


def _late(
    capture: Capture, distance: float, cosines: tuple[float, float]
) -> tuple[np.ndarray, np.ndarray]:
    """Delays [s] of the reflector's wave at every receiver and transmitter against that at the
    origin; zero where the places are unknown."""
    forward = np.sqrt(max(1 - cosines[0] ** 2 - cosines[1] ** 2, 0.0))
    target = distance * np.array([cosines[0], forward, cosines[1]])
    if capture.antennas is None:
        return np.zeros(capture.cube.samples.shape[1]), np.zeros(capture.cube.waveform.num_tx)
    positions = capture.antennas.rx_positions, capture.antennas.tx_positions
    rx, tx = ((np.linalg.norm(target - at, axis=1) - distance) / SPEED_OF_LIGHT for at in positions)
    return rx, tx


def _bound(y: np.ndarray, amplitude: np.ndarray) -> float:
    """Cramer-Rao bound of a beat [range cells], root mean square over the channels; the noise is
    that of the quietest quarter of the range cells."""
    size = y.shape[-1]
    window = ti_window(size)
    power = (np.abs(np.fft.fft(y * window, axis=-1)) ** 2).mean(axis=(0, 1)) / (window**2).sum()
    noise = np.sort(power)[: size // 4].mean()
    information = 2 * (2 * np.pi / size) ** 2 * (_centred_index(size) ** 2).sum() / noise
    return float(np.sqrt((1 / (information * np.abs(amplitude) ** 2)).mean()))


class _Fit(NamedTuple):
    """Beats [cells] and amplitudes (L_rx, L_tx) of tones, the slope of the response, and the power
    that they leave over the power [dB]."""

    beat: np.ndarray
    amplitude: np.ndarray
    slope: complex
    unexplained_db: float


def _unexplained(y: np.ndarray, cells: np.ndarray, respond: bool) -> _Fit:
    """The best tones within `REACH` cells, with one response for all if they `respond`.

    Each tone's amplitude and beat are fitted to the windowed spectrum there, by Levenberg and
    Marquardt: to first order an imaginary slope is a common shift of the beats.
    """
    size = y.shape[-1]
    index, window = _centred_index(size), ti_window(size)
    x, exponent = index / (size / 2), 2j * np.pi / size * index
    offset = np.arange(-REACH * PADDING, REACH * PADDING + 1) / PADDING
    atoms = np.exp(-np.multiply.outer(exponent, offset))
    beat = cells.ravel()
    begin = np.round(beat * PADDING) / PADDING
    seen = (y.reshape(-1, size) * window * np.exp(-np.multiply.outer(begin, exponent))) @ atoms
    best, least, damping = (beat, 0j, seen[:, :1]), np.inf, 1e-3
    slope = 0j
    for _ in range(ROUNDS):
        tones = window * np.exp(np.multiply.outer(beat - begin, exponent))
        plain, bent, moved = (tones * f @ atoms for f in (1.0, x, exponent * (1 + slope * x)))
        model = plain + slope * bent
        amplitude = _projection(model, seen)
        rest = seen - amplitude * model
        left = float((np.abs(rest) ** 2).sum())
        if left < least:
            best, least, damping = (beat, slope, amplitude), left, damping / 4
            moved, bent = (amplitude * (d - _projection(model, d) * model) for d in (moved, bent))
            equations = _Equations.of(moved, bent, rest)
        else:
            damping *= 8
        step, change = equations.solved(damping, respond)
        beat, slope = best[0] + np.clip(step, -0.3, 0.3), best[1] + change
    beat, slope, amplitude = best
    unexplained_db = 10 * float(np.log10(least / (np.abs(seen) ** 2).sum()))
    return _Fit(beat.reshape(cells.shape), amplitude.reshape(cells.shape), slope, unexplained_db)


@dataclass(frozen=True)
class _Equations:
    """Normal equations of a beat per channel and one complex slope: `own` (channels,), `mixed`
    (2, channels), `common` (2, 2), and their right sides."""

    own: np.ndarray
    mixed: np.ndarray
    common: np.ndarray
    own_right: np.ndarray
    common_right: np.ndarray

    @classmethod
    def of(cls, moved: np.ndarray, bent: np.ndarray, rest: np.ndarray) -> _Equations:
        """From the derivatives by the beats and by the slope, and what is left."""
        both = np.stack([bent, 1j * bent])
        return cls(
            (moved.conj() * moved).real.sum(axis=1),
            (moved.conj() * both).real.sum(axis=2),
            np.einsum("ikp,jkp->ij", both.conj(), both).real,
            (moved.conj() * rest).real.sum(axis=1),
            (both.conj() * rest).real.sum(axis=(1, 2)),
        )

    def solved(self, damping: float, respond: bool) -> tuple[np.ndarray, complex]:
        """Steps of the beats and of the slope."""
        own = self.own * (1 + damping)
        if not respond:
            return self.own_right / own, 0j
        matrix = self.common * (1 + damping * np.eye(2)) - self.mixed / own @ self.mixed.T
        change = np.linalg.solve(matrix, self.common_right - self.mixed / own @ self.own_right)
        return (self.own_right - change @ self.mixed) / own, complex(*change)


def near_spectra(capture: Capture, cell: float) -> np.ndarray:
    """Windowed five-fold spectra (L_rx, L_tx, points) of every channel within `REACH` cells."""
    y = capture.channels()
    size = y.shape[-1]
    offset = np.round(cell * PADDING) + np.arange(-REACH * PADDING, REACH * PADDING + 1)
    cycles = np.multiply.outer(_centred_index(size), offset / PADDING / size)
    return np.asarray((y * ti_window(size)) @ np.exp(-2j * np.pi * cycles))


def _projection(on: np.ndarray, of: np.ndarray) -> np.ndarray:
    """Coefficient (rows, 1) of each row's projection on another."""
    return np.asarray((on.conj() * of).sum(axis=1) / (np.abs(on) ** 2).sum(axis=1))[:, None]


def _sweep(y: np.ndarray, cells: np.ndarray, w: Waveform) -> np.ndarray:
    """Mean response of the channels over the sweep, with its standard deviation.

    The echo is brought to beat 0 and kept within `REACH` cells; the window is taken out again
    where it is more than a tenth.
    """
    size = y.shape[-1]
    index, window = _centred_index(size), ti_window(size)
    phasors = np.exp(-2j * np.pi / size * np.multiply.outer(cells, index))
    spectra = np.fft.fft(y * window * phasors, axis=-1)
    spectra[..., REACH + 1 : size - REACH] = 0
    response = np.fft.ifft(spectra, axis=-1) / window / _amplitudes(y, cells)[..., None]
    at = np.round((0.5 + 0.4 * np.linspace(-1, 1, SWEEP_POINTS)) * (size - 1)).astype(int)
    flat = response.reshape(-1, size)
    mean = flat.mean(axis=0)
    middle = mean[(size - 1) // 2]
    frequency = w.effective_carrier + index[at] * w.slope / w.sampling_rate
    spread = flat[:, at].std(axis=0) / np.sqrt(len(flat)) / abs(middle)
    return np.stack([frequency, mean[at] / middle, spread])


# ---- used on other samples


PARTS = ("gains", "delays", "response", "pairs")
"""What a board does, by name."""
ANTENNAS_AND_SWEEP = PARTS[:3]
"""What of it belongs to the board whatever the scene is."""


def apply(calibration: Calibration, capture: Capture) -> Capture:
    """The frame as an ideal board would have delivered it: every channel's gain, phase and delay
    and the response over the sweep are taken out.

    Raises
    ------
    CaptureError  If the board has other antennas.
    """
    return replace(
        capture,
        cube=ideal(calibration, capture.cube),
        source={**capture.source, "calibrated": "yes"},
    )


def ideal(calibration: Calibration, cube: IFCube) -> IFCube:
    """A frame's samples, in single precision, without `ANTENNAS_AND_SWEEP`.

    Raises
    ------
    CaptureError  If the board has other antennas.
    """
    samples = cube.samples / board(calibration, cube, ANTENNAS_AND_SWEEP)
    return replace(cube, samples=samples.astype(np.complex64))


def board(calibration: Calibration, cube: IFCube, parts: Sequence[str]) -> np.ndarray:
    """Factor on every sample (M, L_rx, P, N) that the `parts` of a board make.

    Raises
    ------
    CaptureError  If the board has other antennas.
    """
    w, senders, one = cube.waveform, cube.schedule, calibration
    one.check_size(cube.samples.shape[1], w.num_tx)
    sweep = _centred_index(w.num_samples) * w.slope / w.sampling_rate
    off = w.effective_carrier - one.carrier_hz + sweep
    gain = np.ones((one.rx_gain.size, one.tx_gain.size), complex)
    delay = np.zeros(gain.shape)
    if "gains" in parts:
        gain = gain * one.rx_gain[:, None] * one.tx_gain
    if "delays" in parts:
        delay = delay + one.rx_delay[:, None] + one.tx_delay
    if "pairs" in parts:
        gain, delay = gain * one.pair_gain, delay + one.pair_delay
    by_chirp = (value[:, senders].transpose(1, 0, 2)[..., None] for value in (gain, delay))
    level, late = by_chirp  # (M, L_rx, P, 1)
    out = level * np.exp(2j * np.pi * late * off)
    if "response" in parts:
        phasor = np.exp(2j * np.pi * one.response_delay * off)
        relative = np.clip(off / one.half_sweep_hz, -1, 1)  # beyond what was swept it is held
        out = out * phasor * (1 + one.response_slope * relative)
    return np.asarray(out)


def save_calibration(calibration: Calibration, file: str | Path) -> None:
    """Write a calibration; the file appears whole or not at all."""
    plain = {name: _parted(value) for name, value in vars(calibration).items()}
    save_data(Path(file), KEY, plain)


def load_calibration(file: str | Path) -> Calibration:
    """A calibration that `save_calibration` wrote.

    Raises
    ------
    CaptureError  If the file is none.
    """
    found = load_data(Path(file), KEY)
    try:
        if not isinstance(found, dict):
            raise ValueError("it is cut off, changed or of another kind")
        made = Calibration(**{name: _whole(value) for name, value in found.items()})
        _check(made)
    except BAD_DATA as problem:
        raise CaptureError(
            f"{file}: is no calibration ({shortly(problem)}); give a file that isac-rt calibrate "
            "--out wrote"
        ) from None
    return made


def _check(one: Calibration) -> None:
    """Raise a `ValueError` unless all numbers are there, fit each other and can be divided by."""
    rx, tx = one.rx_gain.size, one.tx_gain.size
    shapes: dict[str, tuple[int, ...]] = {"sweep": (3, SWEEP_POINTS)}
    shapes |= {f"pair_{what}": (rx, tx) for what in ("gain", "delay")}
    for what in ("gain", "gain_std", "delay", "delay_std"):
        shapes |= {f"rx_{what}": (rx,), f"tx_{what}": (tx,)}
    mixed = ("rx_gain", "tx_gain", "pair_gain", "response_slope", "sweep")
    for name, value in vars(one).items():
        array = np.asarray(value)
        kinds = "ifc" if name in mixed else "if"
        if array.shape != shapes.get(name, ()) or array.dtype.kind not in kinds:
            raise ValueError(f"{name} is {array.dtype} of {array.shape}")
        if not np.isfinite(array).all():
            raise ValueError(f"{name} is not finite")
    if not (one.rx_gain.all() and one.tx_gain.all() and one.half_sweep_hz > 0):
        raise ValueError("a gain or the sweep is zero")


def _parted(value: Any) -> Any:
    return [value.real, value.imag] if isinstance(value, complex) else value


def _whole(value: Any) -> Any:
    return complex(*value) if isinstance(value, list) else value
