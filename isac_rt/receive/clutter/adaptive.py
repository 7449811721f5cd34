r"""Angle-Doppler filters: the adaptive matched filter in every range-Doppler cell, scanned over
direction.

With x the channels of a cell, R their covariance under clutter and noise and a(u) the steering
vector,

.. math:: T(u) = |a^H R^{-1} x|^2 / (a^H R^{-1} a)

is exponential of mean one where there is no target [1]_. The largest over u exceeds t with a
probability that for high t is the mean Euler characteristic of the set {T > t} (Worsley [2]_, his
chi-squared field of two degrees of freedom):

.. math:: e^{-t}\,(1 + \mu_1\sqrt{t/\pi} + \mu_2 (2t - 1)/(2\pi)),

mu the length and area of the scanned directions in units of the correlation length, which follows
from the variances of the channels' places. Beams are half a lobe apart. R comes from the mesh
(`angle_doppler`), or from the cells around (`sample_matrix`), whose finite number makes the tail
heavier.

References
----------
.. [1] F. C. Robey et al., "A CFAR adaptive matched filter detector", IEEE Trans. Aerosp. Electron.
Syst. 28(1), 1992, doi:10.1109/7.135446
.. [2] K. J. Worsley, "Local maxima and the expected Euler characteristic of excursion sets of
chi-squared, F and t fields", Adv. Appl.
   Probab. 26(1), 1994, doi:10.2307/1427576
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from isac_rt.frame.waveform import SPEED_OF_LIGHT
from isac_rt.receive.arms import Channels
from isac_rt.receive.known import Known


@dataclass(frozen=True)
class Beams:
    """Directions in which a set of channels is scanned.

    Attributes
    ----------
    cosines : (B, 3) body-frame vectors; only the components that the channels measure matter
    steer : (B, L) complex64
    lengths : sides of the scanned interval or rectangle over the correlation length
    area : product of the sides over the correlation area; 0 for one axis
    """

    cosines: np.ndarray
    steer: np.ndarray
    lengths: tuple[float, ...]
    area: float


def beams_of(channels: Channels, known: Known, axes: tuple[int, ...]) -> Beams:
    """Beams half a lobe apart over the field of view, along the axes (0 is X, 2 is Z) that the
    channels span."""
    k = 2 * np.pi * known.waveform.effective_carrier / SPEED_OF_LIGHT
    limit = known.antennas.view_limit
    lines = []
    for axis in axes:
        aperture = np.ptp(channels.places[:, axis]) + known.antennas.spacing
        count = int(np.ceil(2 * limit * k * aperture / np.pi)) + 1
        lines.append(np.linspace(-limit, limit, count))
    grid = np.meshgrid(*lines, indexing="ij")
    cosines = np.zeros((grid[0].size, 3))
    for axis, values in zip(axes, grid, strict=True):
        cosines[:, axis] = values.ravel()
    cosines = cosines[(cosines**2).sum(axis=1) <= 1]
    steer = channels.steering(cosines, known).astype(np.complex64)
    return Beams(cosines, steer, *scanned(channels, k, limit, axes))


def scanned(
    channels: Channels, wavenumber: float, limit: float, axes: tuple[int, ...] = (0, 2)
) -> tuple[tuple[float, ...], float]:
    """Sides of the scanned directions over the correlation length, and their area over the
    correlation area; see `Beams`."""
    covariance = wavenumber**2 * np.cov(channels.places[:, list(axes)].T, bias=True).reshape(
        len(axes), len(axes)
    )
    sides = tuple(2 * limit * float(np.sqrt(covariance[i, i])) for i in range(len(axes)))
    area = float((2 * limit) ** 2 * np.sqrt(np.linalg.det(covariance))) if len(axes) == 2 else 0.0
    return sides, area


def scanned_within(
    channels: Channels, wavenumber: float, width: np.ndarray
) -> tuple[tuple[float, ...], float]:
    """`scanned` of directions within a box, so wide (2,) in both cosines."""
    sides, area = scanned(channels, wavenumber, 0.5)
    return (sides[0] * width[0], sides[1] * width[1]), area * width[0] * width[1]


def expected_count(t: np.ndarray | float, lengths: tuple[float, ...], area: float) -> np.ndarray:
    """Mean Euler characteristic of {T > t} over directions of such lengths and area (`scanned`); at
    least that of one beam."""
    t = np.asarray(t, float)
    more = sum(lengths) * np.sqrt(np.maximum(t, 0) / np.pi)
    more = more + area * np.maximum(2 * t - 1, 0) / (2 * np.pi)
    return np.exp(-t) * (1 + more)


def scan_threshold(beams: tuple[Beams, ...], false_alarm_rate: float) -> float:
    """What the sum over several scans' maxima exceeds at this rate, the scans taken as independent.

    The largest of one scan is below t with probability exp(-`expected_count`).
    """
    return threshold_of(tuple((b.lengths, b.area) for b in beams), false_alarm_rate)


@lru_cache(maxsize=64)
def threshold_of(sizes: tuple[tuple[tuple[float, ...], float], ...], rate: float) -> float:
    """`scan_threshold` of scans of such lengths and areas (`scanned`)."""
    grid = np.arange(0, 200, 0.01)
    density = np.zeros_like(grid)
    density[0] = 1.0
    for lengths, area in sizes:
        below = np.exp(-expected_count(grid, lengths, area))
        one = np.diff(np.maximum.accumulate(below), prepend=0.0)
        size = 2 * grid.size
        density = np.fft.irfft(np.fft.rfft(density, size) * np.fft.rfft(one, size), size)[
            : grid.size
        ]
    # below 1e-12 the transforms have no digits left: every tail is exp(-t) times a slow factor
    # there
    tail = np.cumsum(density[::-1])[::-1]
    trusted = np.flatnonzero(tail > 1e-10)[-1]
    if rate >= tail[trusted]:
        return float(np.interp(-np.log(rate), -np.log(tail[: trusted + 1]), grid[: trusted + 1]))
    return float(grid[trusted] + np.log(tail[trusted] / rate))


@dataclass(frozen=True)
class Scan:
    """What a scan found in every cell of a map, Doppler in FFT order.

    Attributes
    ----------
    peak : (rows, P) largest T over the beams
    beam : (rows, P) its beam
    energy : (rows, P) x^H R^-1 x / L, of mean one without a target if R is right
    """

    peak: np.ndarray
    beam: np.ndarray
    energy: np.ndarray


def white_scan(snapshots: np.ndarray, beams: Beams, noise: float) -> Scan:
    """The scan where there is noise alone."""
    rows, columns, size = snapshots.shape
    scan = Scan(
        np.empty((rows, columns), np.float32),
        np.empty((rows, columns), np.int32),
        np.empty((rows, columns), np.float32),
    )
    against = beams.steer.conj().T
    for row, x in enumerate(snapshots):
        power = np.abs(x @ against) ** 2
        scan.beam[row] = power.argmax(axis=1)
        scan.peak[row] = power.max(axis=1) / (size * noise)
        scan.energy[row] = (x.real**2 + x.imag**2).sum(axis=1) / (size * noise)
    return scan


@dataclass(frozen=True)
class Matched:
    """The filters of S cells.

    Attributes
    ----------
    inverse : (S, L, L) of the covariances, in units of the noise
    norm : (S, B) a^H R^-1 a
    against : (L, B) conjugate steering vectors
    """

    inverse: np.ndarray
    norm: np.ndarray
    against: np.ndarray

    @classmethod
    def of(cls, R: np.ndarray, beams: Beams) -> Matched:
        inverse = np.linalg.inv(R)
        against = beams.steer.conj().T
        return cls(
            inverse,
            np.maximum((against * np.matmul(inverse, beams.steer.T)).sum(axis=1).real, 1e-12),
            against,
        )

    def fill(self, scan: Scan, row: int, bins: np.ndarray, x: np.ndarray) -> None:
        """Set the cells of a scan from their snapshots (S, L), in units of the noise's
        amplitude."""
        y = np.einsum("sij,sj->si", self.inverse, x)
        power = np.abs(y @ self.against) ** 2 / self.norm
        scan.beam[row, bins] = power.argmax(axis=1)
        scan.peak[row, bins] = power.max(axis=1)
        scan.energy[row, bins] = np.maximum((x.conj() * y).sum(axis=1).real / x.shape[1], 0)
