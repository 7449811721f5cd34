"""Conventional TDM-MIMO sensing, which both baselines share: a Doppler transform per transmit
antenna, a non-coherent sum, CFAR, angles."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from isac_rt.frame.antennas import Antennas
from isac_rt.frame.waveform import SPEED_OF_LIGHT, Waveform, hann
from isac_rt.receive.cfar import CfarRule, strongest_peaks
from isac_rt.receive.estimate import Estimate
from isac_rt.receive.known import Known
from isac_rt.receive.maps import accumulate
from isac_rt.receive.sense import describe
from isac_rt.receive.settings import Receivers
from isac_rt.receive.types import Detections

SIDELOBES = 1e-6
"""Share of a path's power that may lie in any Doppler bin of its range row: Hann's far sidelobes
and migration."""

Conversion = Callable[[float, float], tuple[float, float]]
"""From a range cell and a Doppler bin (both fractional) to delay [s] and delay rate."""


def doppler_maps(
    spectra: np.ndarray, schedule: np.ndarray, times: np.ndarray, frame_duration: float, num_tx: int
) -> np.ndarray:
    """Hann-windowed Doppler transform of each antenna's own P/L_tx chirps, on bins of
    1/frame_duration.

    Parameters
    ----------
    spectra : (L_rx, rows, P) complex
    schedule : (P,) transmit antenna of each chirp
    times : (P,) to which each chirp's phase belongs [s]

    Returns
    -------
    maps : (L_tx, L_rx, rows, P/L_tx) complex64, FFT order, phases referred to time 0 at the bin's
        own frequency
    """
    num_rx, rows, num_chirps = spectra.shape
    pulses = num_chirps // num_tx
    bins = np.fft.fftfreq(pulses, 1 / pulses) / frame_duration
    window = hann(np.arange(pulses) + 0.5, pulses)
    out = np.empty((num_tx, num_rx, rows, pulses), np.complex64)
    for tx in range(num_tx):
        mine = np.flatnonzero(schedule == tx)
        operator = (np.exp(-2j * np.pi * np.outer(bins, times[mine])) * window).astype(np.complex64)
        np.matmul(
            spectra[..., mine].reshape(-1, pulses), operator.T, out=out[tx].reshape(-1, pulses)
        )
    return out


def sense_tdm(
    spectra: np.ndarray,
    schedule: np.ndarray,
    times: np.ndarray,
    convert: Conversion,
    waveform: Waveform,
    antennas: Antennas,
    settings: Receivers,
    first_row: int,
) -> Detections:
    """Detections of a monostatic conventional TDM-MIMO radar; unambiguous up to max_velocity /
    L_tx.

    Parameters
    ----------
    spectra, schedule, times : see `doppler_maps`; spectra Hann-windowed in range
    convert : of a peak's cell and bin
    waveform : frame duration, carrier and antennas of the frame
    first_row : rows before it are not searched
    """
    w = waveform
    maps = doppler_maps(spectra, schedule, times, w.frame_duration, w.num_tx)
    power = accumulate(maps)
    above, level = CfarRule.of(settings, antennas.num_tx * antennas.num_rx).detect(power)
    above[:first_row] = False
    rows, columns = strongest_peaks(power, above, settings, SIDELOBES)
    estimates = [
        estimate_tdm(maps, power, int(r), int(c), schedule, times, convert, w)
        for r, c in zip(rows, columns, strict=True)
    ]
    return describe(
        estimates,
        power[rows, columns] / level[rows, columns],
        Known.unmodulated(w, schedule[None], antennas, 2),
    )


def estimate_tdm(
    maps: np.ndarray,
    power: np.ndarray,
    row: int,
    column: int,
    schedule: np.ndarray,
    times: np.ndarray,
    convert: Conversion,
    waveform: Waveform,
) -> Estimate:
    """The path behind a peak of the accumulated, centred map `power` of `maps`."""
    w = waveform
    cell, fraction = (
        row + hann_fraction(power[:, column], row, False),
        hann_fraction(power[row], column, True),
    )
    centred = column - power.shape[1] // 2
    # TDM: antennas answer at different times; the whole bin's turn is in the transform, the
    # fraction's is taken out here
    middle = np.array([times[schedule == tx].mean() for tx in range(w.num_tx)])
    turn = np.exp(-2j * np.pi * fraction / w.frame_duration * middle)
    channels = maps[:, :, row, centred % power.shape[1]] * turn[:, None]
    return Estimate(*convert(cell, centred + fraction), channels)


def hann_fraction(power: np.ndarray, peak: int, wraps: bool) -> float:
    """Offset of a Hann-windowed tone from its strongest cell, from the stronger neighbour's
    amplitude."""
    size = power.size
    before, after = (
        (peak - 1) % size if wraps else max(peak - 1, 0),
        (peak + 1) % size if wraps else min(peak + 1, size - 1),
    )
    low, middle, high = np.sqrt(power[[before, peak, after]].astype(float))
    if middle == 0:
        return 0.0
    ratio = max(low, high) / middle
    offset = float(np.clip((2 * ratio - 1) / (1 + ratio), -0.5, 0.5))
    return offset if high >= low else -offset


def resolution(waveform: Waveform, antennas: Antennas) -> np.ndarray:
    """(4,) range [m], velocity [m/s] and the two direction cosines that an echo's estimates
    resolve: within these an estimate hits."""
    w, spacing = waveform, antennas.spacing * waveform.carrier_frequency / SPEED_OF_LIGHT
    arms = [
        1 / (spacing * num_tx * num_rx)
        for num_tx, num_rx in ((antennas.tx_x, antennas.rx_x), (antennas.tx_z, antennas.rx_z))
    ]
    return np.array([w.range_cell(2), w.velocity_cell(2), *arms])
