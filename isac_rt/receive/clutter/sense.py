"""The active terminal's detections where another detector than the CFAR decides: peaks of its
statistic, estimated off the grid.

A filter that looks at directions also estimates there: the beam towards a detection takes out most
of the clutter that shares its range-Doppler cell from elsewhere. The estimates' beam is the plain
one, so that clutter within a lobe still pulls them.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from isac_rt.frame.antennas import Antennas
from isac_rt.frame.schedule import Schedule
from isac_rt.frame.waveform import Waveform
from isac_rt.receive.cfar import first_row, strongest_peaks
from isac_rt.receive.clutter.detectors import judge
from isac_rt.receive.clutter.power import joint_channels, steering
from isac_rt.receive.estimate import Estimate, LocalSpectra
from isac_rt.receive.maps import UNION_FLOOR, accumulate, channel_maps
from isac_rt.receive.sense import Sensed, describe, estimate_at
from isac_rt.receive.types import ExpectedClutter
from isac_rt.scenario.receivers import Receivers

FINE = 0.03, 0.01, 0.003
"""Steps of the search for a direction around the filter's beam [cosine]."""


class BeamSpectra(LocalSpectra):
    """The rows around a peak, of which only one beam's power counts."""

    weights: np.ndarray

    def power(self, delay: float, delay_rate: float) -> float:
        """Power of the beam: what the estimate maximises."""
        return float(np.abs((self.weights.conj() * self.respond(delay, delay_rate)).sum()) ** 2)


def sense_in_clutter(
    spectra: np.ndarray,
    waveform: Waveform,
    schedule: Schedule,
    delay_symbols: np.ndarray,
    antennas: Antennas,
    settings: Receivers,
    clutter: ExpectedClutter | None,
) -> Sensed:
    """As `sense`, with the settings' detector in place of the CFAR; echoes only."""
    w = waveform
    maps = channel_maps(spectra, w, schedule, delay_symbols)
    power = accumulate(maps)
    judged = judge([maps], w, antennas, schedule, delay_symbols, settings, clutter)[0]
    ratio = judged.ratio.copy()
    ratio[: first_row(settings, w.range_cell(2))] = 0
    rows, bins = strongest_peaks(ratio, ratio > 1, settings, UNION_FLOOR)
    found, towards = [], judged.cosines[rows, bins]
    for row, column, cosines in zip(rows.tolist(), bins.tolist(), towards, strict=True):
        kind = BeamSpectra if np.isfinite(cosines).all() else LocalSpectra
        local = kind(spectra, w, schedule, delay_symbols, row)
        if isinstance(local, BeamSpectra):
            local.weights = _beam(antennas, w, cosines)
        found.append(
            estimate_at(local, power if kind is LocalSpectra else ratio, row, column, settings)
        )
    snr = power[rows, bins] / judged.level[rows, bins]
    on_grid = settings.refinement == "grid"
    detections = describe(
        found, np.maximum(snr, ratio[rows, bins]), antennas, w, 2, on_grid=on_grid
    )
    direction = detections.direction.copy()
    for i, cosines in enumerate(towards):
        if np.isfinite(cosines).all():
            direction[i] = cosines if on_grid else _direction(found[i], antennas, w, cosines)
    return Sensed(found, replace(detections, direction=direction), power, judged.level)


def _beam(antennas: Antennas, waveform: Waveform, cosines: np.ndarray) -> np.ndarray:
    """(L_tx, L_rx) weights of the virtual L towards (u_x, u_z), zero off the L."""
    channels = joint_channels(antennas)
    out = np.zeros((antennas.num_tx, antennas.num_rx), complex)
    out[channels.tx, channels.rx] = steering(
        channels.places, np.array([[cosines[0], 0.0, cosines[1]]]), waveform
    )[0]
    return out


def _direction(
    estimate: Estimate, antennas: Antennas, waveform: Waveform, cosines: np.ndarray
) -> np.ndarray:
    """(u_x, u_z) of the most power of the virtual L near the filter's beam."""
    channels = joint_channels(antennas)
    values = estimate.channels[channels.tx, channels.rx]
    best = np.array(cosines, float)
    for step in FINE:
        i, j = np.meshgrid(np.arange(-2, 3), np.arange(-2, 3), indexing="ij")
        tried = np.stack(
            [best[0] + step * i.ravel(), np.zeros(25), best[1] + step * j.ravel()], axis=1
        )
        power = np.abs(steering(channels.places, tried, waveform).conj() @ values) ** 2
        best = tried[power.argmax()][[0, 2]]
    return best if (best**2).sum() <= 1 else np.full(2, np.nan)
