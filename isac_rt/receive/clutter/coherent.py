r"""All virtual channels of a cell coherently, over all directions, and whitened where clutter is.

A cell's channels x are matched with the steering vector a(u) of every direction,

.. math:: T(u) = |a^H R^{-1} x|^2 / (a^H R^{-1} a),

R their covariance under noise and clutter, in units of the noise (see
`isac_rt.receive.clutter.adaptive`). Where hardly any clutter is expected R = 1 and all channels
take part, and a bound on the sum over the lines of the array spares most cells the search. Where
clutter is expected and the plain search finds something, R is summed over the scatterers about the
cell, for the channels of both arms.

Every line of channels along an axis answers to one direction cosine, and its phase against the
others to the other one, so that the search is separable: with F_l the spectrum of line l along X
and G_l along Z,

.. math:: a^H y = \sum_l e^{jkz_lu_z} F_l(u_x) + \sum_l e^{jkx_lu_x} G_l(u_z).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache

import numpy as np

from isac_rt.frame.antennas import Antennas
from isac_rt.frame.waveform import Waveform
from isac_rt.kernels.hermitian import inverses
from isac_rt.kernels.jit import jit
from isac_rt.kernels.vector import LANES, load, splat, store
from isac_rt.receive.arms import Channels, all_channels, both_arms
from isac_rt.receive.clutter.power import REACH, Taper, cells_of, range_power, slow_power
from isac_rt.receive.clutter.scan import (
    Axis,
    line_bounds,
    quadratic_forms,
    search_coherent,
)
from isac_rt.receive.known import Known
from isac_rt.receive.types import ExpectedClutter

DIRECTIONS = 32
"""Values of each direction cosine that are searched; the peak between them is sought from there."""
PRUNED = 0.9
"""Share of the lower threshold below which a cell is not looked at further: between directions of
the grid a parabola misses a tenth of a peak at most."""
CLIMBED = 0.3, 0.12
"""Steps, in those of the grid, by which the peak between them is climbed."""
TOGETHER = 8
"""Scatterers that are added to a covariance at once."""
FINE = 32
"""Entries per cell of the tables of responses."""
LEAST_WEIGHT = 1e-3
"""Scatterers weaker in a cell than this share of the noise are left out of its covariance."""


@dataclass(frozen=True)
class Lines:
    """The lines of an array along one axis.

    Attributes
    ----------
    members : of each line the numbers of its channels
    spectra : of each line (G, n) complex64, exp(+j k v u) along it
    turns : (lines, G) complex64, exp(+j k v u) of its place on the other axis
    """

    members: tuple[np.ndarray, ...]
    spectra: tuple[np.ndarray, ...]
    turns: np.ndarray


@dataclass(frozen=True)
class Search:
    """How a set of channels is searched for directions.

    Attributes
    ----------
    channels : Channels
    cosines : (G,) values of each direction cosine
    along_x, along_z : Lines
    inside : (G, G) bool, directions (u_x, u_z) of the unit disc
    wavenumber : [rad/m]
    """

    channels: Channels
    cosines: np.ndarray
    along_x: Lines
    along_z: Lines
    inside: np.ndarray
    wavenumber: float

    @classmethod
    def of(cls, channels: Channels, wavenumber: float, limit: float) -> Search:
        """Directions within `limit` on both axes."""
        u = limit * (2 * np.arange(DIRECTIONS) + 1 - DIRECTIONS) / DIRECTIONS
        places = channels.places[:, [0, 2]]
        # a channel belongs to the longer of the two lines through it
        x, z = places.T
        on_x = _sizes(z) >= _sizes(x)
        make = []
        for axis, some in ((0, on_x), (1, ~on_x)):
            rows = [
                np.flatnonzero(some & (np.abs(places[:, 1 - axis] - c) < 1e-9))
                for c in np.unique(np.round(places[some, 1 - axis], 9))
            ]
            spectra = [
                np.exp(1j * wavenumber * np.outer(u, places[r, axis])).astype(np.complex64)
                for r in rows
            ]
            turns = [np.exp(1j * wavenumber * u * places[r[0], 1 - axis]) for r in rows]
            shape = len(rows), DIRECTIONS
            make.append(
                Lines(tuple(rows), tuple(spectra), np.array(turns, np.complex64).reshape(shape))
            )
        return cls(channels, u, make[0], make[1], np.add.outer(u**2, u**2) <= 1, wavenumber)

    def steering(self, cosines: np.ndarray) -> np.ndarray:
        """(..., L) complex64 exp(-j k v.u) of directions (..., 2)."""
        return turned(-self.wavenumber * (cosines @ self.channels.places[:, [0, 2]].T))

    @cached_property
    def axes(self) -> tuple[np.ndarray, Axis, Axis]:
        """Numbers of the channels line by line, first those along X, and both axes' lines."""
        axes = []
        for lines in (self.along_x, self.along_z):
            ends = np.cumsum([0, *(len(m) for m in lines.members)])
            spectra = np.concatenate([np.zeros((DIRECTIONS, 0), np.complex64), *lines.spectra], 1)
            cosines, sines = np.stack([spectra.real, spectra.imag])
            turns = np.stack([lines.turns.real, lines.turns.imag])
            axes.append(Axis(ends, cosines, sines, turns))
        order = np.concatenate([*self.along_x.members, *self.along_z.members])
        return order, axes[0], axes[1]

    @cached_property
    def scalloping(self) -> float:
        """By how much a wave half a step off the grid on both axes exceeds, in amplitude, the sum
        of what the lines have of it on the grid."""
        half = self.wavenumber * (self.cosines[1] - self.cosines[0]) / 2
        kept = [
            abs(np.exp(1j * half * self.channels.places[members, axis]).sum())
            for axis, lines in ((0, self.along_x), (2, self.along_z))
            for members in lines.members
        ]
        return len(self.channels) / float(sum(kept))

    def spread(self, cosine: float) -> np.ndarray:
        """(L, L) by which a box of directions, so wide, tapers a covariance."""
        places = self.channels.places
        apart = (places[:, None] - places) * self.wavenumber / (2 * np.pi) * cosine
        return (np.sinc(apart[..., 0]) * np.sinc(apart[..., 2])).astype(np.float32)

    def lines(self, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Spectra of the lines along X and Z (lines, G, S) of channels (L, S)."""
        out = []
        for lines in (self.along_x, self.along_z):
            made = [s @ x[m] for m, s in zip(lines.members, lines.spectra, strict=True)]
            out.append(np.array(made, np.complex64).reshape(len(made), DIRECTIONS, x.shape[1]))
        return out[0], out[1]


def turned(phases: np.ndarray) -> np.ndarray:
    """exp(j phi) as complex64: real and imaginary part by themselves, several times faster."""
    phases = phases.astype(np.float32)
    out = np.empty(phases.shape, np.complex64)
    np.cos(phases, out=out.real)
    np.sin(phases, out=out.imag)
    return out


def _sizes(values: np.ndarray) -> np.ndarray:
    """Of each value how many are equal to it."""
    return (np.abs(values[:, None] - values) < 1e-9).sum(axis=1)


@lru_cache(maxsize=8)
def searches(antennas: Antennas, wavenumber: float) -> tuple[Search, Search]:
    """The search over all channels, and over those of both arms."""
    limit = antennas.view_limit
    return (
        Search.of(all_channels(antennas), wavenumber, limit),
        Search.of(both_arms(antennas), wavenumber, limit),
    )


@dataclass(frozen=True)
class Found:
    """The largest statistic of some cells and where it lies.

    Attributes
    ----------
    cell : (S,) flat numbers of the cells
    peak : (S,) T over the directions
    cosines : (S, 2) its direction, NaN where the peak is a bound
    """

    cell: np.ndarray
    peak: np.ndarray
    cosines: np.ndarray


def search_plain(maps: np.ndarray, search: Search, noise: float, least: float) -> Found:
    """The largest T of cells against noise alone; exact where it is `least` / `PRUNED` or more.
    Below it is that of the grid, or a bound without a direction.

    Parameters
    ----------
    maps : (L_tx, L_rx, rows, P) complex64 of `channel_maps`
    noise : mean power of a cell of one channel
    """
    c = search.channels
    x = maps.reshape(-1, maps.shape[2] * maps.shape[3])
    channel = c.tx * maps.shape[1] + c.rx
    scale = 1 / (len(c) * noise)
    # what a wave has between the grid's directions, as far as `PRUNED` does not allow for it
    raised = scale * max(PRUNED * search.scalloping**2, 1)
    bound = np.zeros(x.shape[1], np.float32)
    for lines in (search.along_x, search.along_z):
        for members, spectra in zip(lines.members, lines.spectra, strict=True):
            bound += np.sqrt(line_bounds(x, channel[members][None], spectra))
    cell = np.flatnonzero(bound**2 * raised >= least)
    x = np.ascontiguousarray(x[channel[:, None], cell])
    # of each line the best direction, then of all lines along an axis one
    best = [np.sqrt(f.real**2 + f.imag**2).sum(axis=0).max(axis=0) for f in search.lines(x)]
    peak, cosines = (best[0] + best[1]) ** 2 * raised, np.full((cell.size, 2), np.nan)
    some = np.flatnonzero(peak >= least)
    y = np.ascontiguousarray(x[:, some].T)
    whole = np.full((1, DIRECTIONS, DIRECTIONS), scale)
    peak[some], cosines[some] = _whitened(y, whole, search)
    above = peak[some] >= least
    some, y = some[above], y[above]

    def statistic(a: np.ndarray) -> np.ndarray:
        return scale * np.abs(np.matmul(a, y.conj()[..., None])[..., 0]) ** 2

    peak[some], cosines[some] = climbed(statistic, cosines[some], search)
    return Found(cell, peak, cosines)


def search_white(
    x: np.ndarray, R: np.ndarray, cell: np.ndarray, search: Search, least: float
) -> Found:
    """The largest T of cells with covariances; exact where it can be `least` or more, else a bound.

    Parameters
    ----------
    x : (S, L) channels in units of the noise's amplitude
    R : (S, L, L) covariances in units of the noise
    cell : (S,) their numbers
    """
    inverse = inverses(R)
    y = np.matmul(inverse, x[..., None])[..., 0]
    # a^H R^-1 a is L^2 / a^H R a at least, by Cauchy and Schwarz
    peak, cosines = _whitened(y, denominators(R, search) / len(search.channels) ** 2, search)
    some = np.flatnonzero(peak >= least)
    inverse = inverse[some]
    peak[some], cosines[some] = _whitened(y[some], 1 / denominators(inverse, search), search)

    def statistic(a: np.ndarray) -> np.ndarray:
        norm = ((a.conj() @ inverse) * a).sum(axis=-1).real
        return np.abs(np.matmul(a, y[some].conj()[..., None])[..., 0]) ** 2 / norm

    peak[some], cosines[some] = climbed(statistic, cosines[some], search)
    return Found(cell, peak, cosines)


def climbed(
    statistic: Callable[[np.ndarray], np.ndarray], cosines: np.ndarray, search: Search
) -> tuple[np.ndarray, np.ndarray]:
    """The largest statistic near directions (S, 2), and where: a parabola between grid points may
    overshoot and lie beside the peak, and what counts is the statistic itself.

    `statistic` of steering vectors (S, 9, L) is (S, 9).
    """
    peak, each = np.zeros(len(cosines), np.float32), np.arange(len(cosines))
    towards = search.steering(cosines)
    around = np.stack(np.meshgrid([0, -1, 1], [0, -1, 1], indexing="ij"), axis=-1).reshape(9, 2)
    for part in CLIMBED:
        step = part * (search.cosines[1] - search.cosines[0])
        turns = search.steering(step * around)  # the phases of two directions add
        values = statistic(towards[:, None] * turns)
        best = values.argmax(axis=1)
        peak, cosines = values[each, best], cosines + step * around[best]
        towards = towards * turns[best]
    return peak, cosines


def _whitened(y: np.ndarray, scale: np.ndarray, search: Search) -> tuple[np.ndarray, np.ndarray]:
    """Largest |a^H y|^2 times a scale (S, G, G), and its direction."""
    along_x, along_z = search.lines(np.ascontiguousarray(y.T))
    return _best(
        np.ascontiguousarray(along_x.transpose(2, 0, 1)),
        np.ascontiguousarray(along_z.transpose(2, 0, 1)),
        scale.astype(np.float32),
        search,
    )


def denominators(matrix: np.ndarray, search: Search) -> np.ndarray:
    """a^H Q a of all directions: (S, G, G) float32 from Hermitian matrices Q (S, L, L)."""
    out = np.empty((len(matrix), DIRECTIONS, DIRECTIONS), np.float32)
    quadratic_forms(np.ascontiguousarray(matrix, np.complex64), *search.axes, out)
    return out


def _best(
    along_x: np.ndarray, along_z: np.ndarray, scale: np.ndarray, search: Search
) -> tuple[np.ndarray, np.ndarray]:
    """The largest statistic over the directions and where, interpolated."""
    peak = np.zeros(len(along_x), np.float32)
    place = np.zeros((len(along_x), 2), np.float32)
    _, x, z = search.axes
    inside = search.inside.ravel().astype(np.float32)
    search_coherent(along_x, along_z, x.turns, z.turns, inside, scale, peak, place)
    u = search.cosines
    return peak, u[0] + place * (u[1] - u[0])


@dataclass(frozen=True)
class Bucketed:
    """Expected scatterers sorted by the cell that they lie in.

    Attributes
    ----------
    start : where those of each cell (row, bin) begin, the strongest first; the rows begin `REACH`
        before the first
    beat, doppler : of each scatterer, off the middle of its cell
    power : over the noise of a cell of one channel, before the responses
    steer : (K, L) complex64
    tables : responses in range and Doppler at offsets of 0, 1/FINE, ... cells
    shape : (L, L) of the taper over directions
    num_bins : P
    """

    start: np.ndarray
    beat: np.ndarray
    doppler: np.ndarray
    power: np.ndarray
    steer: np.ndarray
    tables: tuple[np.ndarray, np.ndarray]
    shape: np.ndarray
    num_bins: int

    @classmethod
    def of(
        cls, clutter: ExpectedClutter, known: Known, search: Search, noise: float, taper: Taper
    ) -> Bucketed:
        """The scatterers that some cell holds; `noise` of a cell of one channel."""
        w = known.waveform
        beat, doppler = cells_of(clutter, w)
        tables = _tables(w, taper)
        strongest = tables[0].max() * tables[1].max()
        rows = w.num_range_cells + 2 * REACH
        row = np.round(beat).astype(np.int64) + REACH
        heard = (row >= 0) & (row < rows) & (clutter.power * strongest > LEAST_WEIGHT * noise)
        clutter, beat, doppler, row = clutter.select(heard), beat[heard], doppler[heard], row[heard]
        column = np.round(doppler).astype(np.int64)
        bucket = row * w.num_chirps + column % w.num_chirps
        share = (clutter.power / noise).astype(np.float32)
        # by bucket, then by falling power, whose bits grow as it does
        order = np.argsort((bucket << 32) - share.view(np.int32))
        places = search.channels.places
        return cls(
            np.searchsorted(bucket[order], np.arange(rows * w.num_chirps + 1)),
            (beat - row + REACH)[order].astype(np.float32),
            (doppler - column)[order].astype(np.float32),
            share[order],
            turned(-known.wavenumber * (clutter.arrival[order] @ places.T)),
            tables,
            search.spread(taper.cosine),
            w.num_chirps,
        )

    def among(self, some: np.ndarray) -> Bucketed:
        """The same of some of the channels."""
        steer = np.ascontiguousarray(self.steer[:, some])
        return replace(self, steer=steer, shape=self.shape[np.ix_(some, some)])

    def covariances(self, rows: np.ndarray, bins: np.ndarray) -> np.ndarray:
        """(S, L, L) complex64 of noise and clutter in cells, Doppler in FFT order, in units of the
        noise."""
        size = self.steer.shape[1]
        out = np.empty((rows.size, size, size), np.complex64)
        scatterers = self.start, self.beat, self.doppler, self.power, self.steer
        cells = rows + REACH, bins, self.num_bins
        _covariances(cells, scatterers, self.tables, self.shape, out)
        return out


@lru_cache(maxsize=8)
def _tables(waveform: Waveform, taper: Taper) -> tuple[np.ndarray, np.ndarray]:
    """Responses in range and in Doppler at offsets of 0, 1/FINE, ... up to REACH + 1 cells."""
    offset = np.arange((REACH + 1) * FINE + 2) / FINE
    return (
        range_power(waveform, offset, taper.range_cells).astype(np.float32),
        slow_power(waveform, offset, taper.doppler_bins).astype(np.float32),
    )


@jit(fast=True)
def _covariances(cells, scatterers, tables, shape, out):
    """`Bucketed.covariances`: the scatterers about each cell are added `TOGETHER` at a time."""
    rows, bins, num_bins = cells
    start, beat, doppler, power, steer = scatterers
    size = steer.shape[1]
    width = size + -size % LANES
    most = np.zeros((2, REACH + 1), np.float32)  # of a response, so many cells off
    for axis in range(2):
        for k in range(REACH * FINE + FINE // 2 + 1):
            cell = (k + FINE // 2) // FINE
            most[axis, cell] = max(most[axis, cell], tables[axis][k])
            if k % FINE == FINE // 2:  # between two cells
                most[axis, cell - 1] = max(most[axis, cell - 1], tables[axis][k])
    # what lies beyond the channels stays zero
    re, im = np.zeros(TOGETHER * width, np.float32), np.zeros(TOGETHER * width, np.float32)
    sums = np.zeros((2, size, width), np.float32)
    for c in range(rows.size):
        sums[:], count = 0.0, 0
        for i in range(-REACH, REACH + 1):
            row = rows[c] + i
            if row < 0 or row >= (start.size - 1) // num_bins:
                continue
            for j in range(-REACH, REACH + 1):
                bucket = row * num_bins + (bins[c] + j) % num_bins
                least = LEAST_WEIGHT / (most[0, abs(i)] * most[1, abs(j)])
                for s in range(start[bucket], start[bucket + 1]):
                    if power[s] < least:
                        break  # the strongest stand first
                    at_r = abs(i + beat[s]) * FINE
                    at_d = abs(j + doppler[s]) * FINE
                    weight = power[s] * tables[0][int(at_r + 0.5)] * tables[1][int(at_d + 0.5)]
                    if weight < LEAST_WEIGHT:
                        continue
                    root = np.sqrt(weight)
                    for k in range(size):
                        re[count * width + k] = steer[s, k].real * root
                        im[count * width + k] = steer[s, k].imag * root
                    count += 1
                    if count == TOGETHER:
                        _add_products(re, im, count, size, sums)
                        count = 0
        _add_products(re, im, count, size, sums)
        for k in range(size):
            for m in range(k):
                value = complex(sums[0, k, m], sums[1, k, m]) * shape[k, m]
                out[c, k, m], out[c, m, k] = value, value.conjugate()
            out[c, k, k] = 1.0 + sums[0, k, k] * shape[k, k]


@jit(fast=True, borrows=True)
def _add_products(re, im, count, size, sums):
    """sums[k, m] += x[q, k] x[q, m]^* over q < `count`, for m <= k, and some that no one reads."""
    width, flat = sums.shape[2], sums.reshape(-1)
    for k in range(size):
        for m in range(0, k + 1, LANES):
            at, other = k * width + m, (size + k) * width + m
            c, d = load(flat, at), load(flat, other)
            for q in range(0, count * width, width):
                a, b = splat(re[q + k]), splat(im[q + k])
                x, y = load(re, q + m), load(im, q + m)
                c, d = c + a * x + b * y, d + b * x - a * y
            store(flat, at, c)
            store(flat, other, d)
