r"""A passive terminal's search for weak echoes: strong paths out, then every direction of every
cell, whitened where clutter is.

What each transmit antenna sends comes from a direction that the receiver does not know, so that
the channels of a cell are matched receiver by receiver and added in power over the L_tx transmit
antennas,

.. math:: T(u) = \sum_t |a^H R^{-1} x_t|^2 / (a^H R^{-1} a),

R the covariance of the receivers under noise and clutter, the same for all transmit antennas, in
units of the noise. Without a target 2 T is a chi-squared field of 2 L_tx degrees of freedom. Where
clutter remains the transmit antennas receive the same of it: with c its share of the beam's power,
c = 1 - a^H R^-2 a / a^H R^-1 a, one of the L_tx terms grows to 1 + (L_tx - 1) c, and the threshold
with it.

The search is separable as at the active terminal (`isac_rt.receive.directions`).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from isac_rt.extensions.city_receivers.adaptive import (
    LEAST_CLUTTER,
    field_threshold,
    scanned,
    unexplained,
)
from isac_rt.extensions.city_receivers.angle_doppler import noise_level
from isac_rt.extensions.city_receivers.covariance import Bucketed
from isac_rt.extensions.city_receivers.power import TAPER, expected_power
from isac_rt.receive.cfar import (
    first_row,
    strongest_peaks,
)
from isac_rt.receive.directions import (
    PRUNED,
    Search,
    receiver_search,
    search_plain,
    search_white,
)
from isac_rt.receive.estimate import (
    Estimate,
    LocalSpectra,
    near_beam,
    standard_deviations,
)
from isac_rt.receive.known import Known
from isac_rt.receive.maps import UNION_FLOOR
from isac_rt.receive.pursuit import RESIDUAL_DB, BySchedule, extract_strong
from isac_rt.receive.sense import Sensed, describe
from isac_rt.receive.types import NO_HINTS, Detections, ExpectedClutter, Hints

BESIDE = (3, 1)
"""Rows and bins about a path that was taken out which may hold its remainder, `RESIDUAL_DB` below
it."""
STD_CELLS = 0.1
"""Smallest deviation of range and velocity, in cells, of what shares its cell with others."""


@dataclass(frozen=True)
class BeamSearch(BySchedule):
    """The CFAR for paths that stand out, beams for those that do not."""

    def sense(self, spectra: np.ndarray, known: Known, hints: Hints = NO_HINTS) -> Sensed:
        if not known.full:
            return super().sense(spectra, known, hints)
        clutter = hints.clutter
        strong, snr, power, left, maps, rest = extract_strong(spectra, known, self.settings)
        _, level = self.rule(known).detect(power)
        left_over = Remainder.of(strong, snr, known, rest.shape)
        noise, expected = self._noise(rest, known, clutter)
        ratio, sure, cosines = self._test(maps, noise, expected, known, clutter, left_over)
        found = rest / (noise + expected)
        held_up = unexplained(found, ratio > 1, self.settings, left_over.power > 0)
        ratio, sure = ratio / held_up, sure / held_up
        ratio[: first_row(self.settings, known.range_cell)] = 0
        rows, bins = strongest_peaks(ratio, ratio > 1, self.settings, UNION_FLOOR)
        weak, estimates = [], []
        for row, column in zip(rows.tolist(), bins.tolist(), strict=True):
            beam = _Beam(left, known, row, cosines[row, column])
            e = self.estimator.at(beam, ratio, row, column)
            estimates.append(e)
            weak.append(near_beam(e, known, cosines[row, column]))
        limit = self._limits(receiver_search(known.antennas, known.wavenumber), known)[0]
        detections = _described(
            estimates, np.array(weak).reshape(-1, 2), ratio[rows, bins] * limit, known
        )
        detections = replace(detections, starts=sure[rows, bins] > 1)
        joined = Detections.joined([describe(strong, snr, known), detections])
        return Sensed([*strong, *estimates], joined, power, level)

    def _noise(
        self, power: np.ndarray, known: Known, clutter: ExpectedClutter | None
    ) -> tuple[float, np.ndarray]:
        """Return the noise of a cell of one channel, and the clutter's (rows, P)."""
        if clutter is None:
            return noise_level(power, None, known.channels), np.zeros_like(power)
        expected = expected_power(clutter, known, len(power), TAPER)
        return noise_level(power, expected, known.channels), expected

    def _test(
        self,
        maps: np.ndarray,
        noise: float,
        expected: np.ndarray,
        known: Known,
        clutter: ExpectedClutter | None,
        left_over: Remainder,
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """T over its two thresholds, (rows, P), and its directions (rows, P, 2), Doppler
        centred."""
        search = receiver_search(known.antennas, known.wavenumber)
        limit, least = self._limits(search, known), PRUNED * self._limits(search, known)[0]
        shape = maps.shape[2:]
        ratio, sure = np.zeros((2, maps[0, 0].size), np.float32)
        cosines = np.full((ratio.size, 2), np.nan)
        x = maps.reshape(*maps.shape[:2], -1)
        plain = search_plain(x, search, noise, least)
        ratio[plain.cell], sure[plain.cell] = plain.peak / limit[0], plain.peak / limit[1]
        cosines[plain.cell] = plain.cosines
        held = np.fft.ifftshift(expected / noise + left_over.power, axes=1).ravel()
        cell = plain.cell[(held[plain.cell] > LEAST_CLUTTER) & (plain.peak > least)]
        if cell.size:
            rows, bins = np.divmod(cell, shape[1])
            R = left_over.covariances(rows, bins, search)
            if clutter is not None:
                R += Bucketed.of(clutter, known, search, noise, TAPER).covariances(rows, bins)
            else:
                R += np.eye(R.shape[1], dtype=np.float32)
            y = x[:, :, cell].transpose(2, 0, 1) / np.float32(np.sqrt(noise))
            white, common = search_white(y, R, cell, search, least)
            ratio[cell] = white.peak / (limit[0] * common)
            sure[cell] = white.peak / (limit[1] * common)
            cosines[cell] = white.cosines
        ratio, sure, cosines = (
            np.fft.fftshift(a.reshape(*shape, *a.shape[1:]), axes=1) for a in (ratio, sure, cosines)
        )
        return ratio, sure, cosines

    def _limits(self, search: Search, known: Known) -> tuple[float, float]:
        """Thresholds of a detection and of one that may start a track."""
        size = scanned(search)
        usual, sure = self.settings.false_alarm_rates
        looks = known.antennas.num_tx
        return field_threshold(*size, looks, usual), field_threshold(*size, looks, sure)


@dataclass(frozen=True)
class Remainder:
    """Residue of the removal of strong paths, from their directions.

    Attributes
    ----------
    power : (rows, P) over the noise of a cell of one channel, Doppler centred
    owner : (rows, P) number of the strong path that leaves most there
    channels : (S, L_tx, L_rx) the strong paths' own
    """

    power: np.ndarray
    owner: np.ndarray
    channels: np.ndarray

    @classmethod
    def of(
        cls, strong: list[Estimate], snr: np.ndarray, known: Known, shape: tuple[int, ...]
    ) -> Remainder:
        """`RESIDUAL_DB` below each strong path, in the cells `BESIDE` it."""
        w, power, owner = known.waveform, np.zeros(shape, np.float32), np.zeros(shape, np.int64)
        for k, (e, over) in enumerate(zip(strong, snr, strict=True)):
            row = round(float(w.beat_cells(e.delay, e.delay_rate, 0.0)))
            column = round(e.delay_rate * w.frame_duration * w.effective_carrier) + shape[1] // 2
            rows = np.arange(max(row - BESIDE[0], 0), min(row + BESIDE[0] + 1, shape[0]))
            block = np.ix_(rows, (np.arange(-BESIDE[1], BESIDE[1] + 1) + column) % shape[1])
            more = over * 10 ** (-RESIDUAL_DB / 10) > power[block]
            power[block] = np.where(more, over * 10 ** (-RESIDUAL_DB / 10), power[block])
            owner[block] = np.where(more, k, owner[block])
        size = known.antennas.num_tx, known.antennas.num_rx
        return cls(power, owner, np.array([e.channels for e in strong]).reshape(-1, *size))

    def covariances(self, rows: np.ndarray, bins: np.ndarray, search: Search) -> np.ndarray:
        """(S, L, L) complex64 in cells, Doppler in FFT order, in units of the noise."""
        c = self.channels
        if not len(c):
            return np.zeros((rows.size, c.shape[2], c.shape[2]), np.complex64)
        power, owner = (np.fft.ifftshift(x, axes=1)[rows, bins] for x in (self.power, self.owner))
        each = np.einsum("sti,stj->sij", c, c.conj())
        each *= (
            search.spread(TAPER.cosine) / (np.abs(c) ** 2).mean(axis=2).sum(axis=1)[:, None, None]
        )
        return power[:, None, None] * each.astype(np.complex64)[owner]


class _Beam(LocalSpectra):
    """The rows around a peak, of which only the power towards one direction counts."""

    def __init__(self, spectra: np.ndarray, known: Known, row: int, cosines: np.ndarray) -> None:
        towards = receiver_search(known.antennas, known.wavenumber).steering(cosines).conj()
        beam = np.tile(towards.astype(complex), (known.antennas.num_tx, 1))
        super().__init__(spectra, known, row, beam=beam)


def _described(
    found: list[Estimate], direction: np.ndarray, statistic: np.ndarray, known: Known
) -> Detections:
    """Detections with deviations by what the beam holds."""
    w, looks = known.waveform, known.antennas.num_tx
    snr = np.maximum(statistic - looks, 1.0) / known.channels
    std = standard_deviations(snr, 0.0, known)
    floor = STD_CELLS * np.array([w.range_cell(1), w.velocity_cell(1), 0.0, 0.0])
    limit = known.antennas.view_limit
    return Detections(
        range=np.array([e.delay for e in found]) * known.metres,
        velocity=np.array([e.delay_rate for e in found]) * known.metres,
        direction=np.where((np.abs(direction) <= limit), direction, np.nan),
        snr=1 + snr,
        std=np.hypot(std, floor),
        is_reference=np.zeros(len(found), bool),
        starts=np.ones(len(found), bool),
    )
