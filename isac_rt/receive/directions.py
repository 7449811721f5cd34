r"""Searches of cells for directions: all channels coherently, over all looks and directions.

The channels :math:`x_t` of a cell's looks t are matched with the steering vector a(u) of every
direction,

.. math:: T(u) = \sum_t |a^H R^{-1} x_t|^2 / (a^H R^{-1} a),

R their covariance under noise and clutter, in units of the noise (see
`adaptive` of the city receivers). An echo has one look, all virtual channels; at a passive
terminal the transmit antennas are the looks, for nobody knows the direction in which they sent.
Where there is noise alone R = 1, and a bound on the sum over the lines of the array spares most
cells the search.

Every line of channels along an axis answers to one direction cosine, and its phase against the
others to the other one, so that the search is separable: with F_l the spectrum of line l along X
and G_l along Z,

.. math:: a^H y = \sum_l e^{jkz_lu_z} F_l(u_x) + \sum_l e^{jkx_lu_x} G_l(u_z).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache

import numpy as np

from isac_rt.frame.antennas import Antennas
from isac_rt.kernels import hermitian, receive_directions
from isac_rt.kernels.jit import twin_of
from isac_rt.kernels.receive_directions import Axis
from isac_rt.kernels.vector import LANES
from isac_rt.receive.arms import Channels, all_channels

DIRECTIONS = 32
"""Values of each direction cosine that are searched; the peak between them is sought from there."""
PRUNED = 0.9
"""Share of the lower threshold below which a cell is not looked at further: between directions of
the grid a parabola misses a tenth of a peak at most."""
CLIMBED = 0.3, 0.12
"""Steps, in those of the grid, by which the peak between them is climbed."""
FINE = 0.03, 0.01, 0.003
"""Steps of the search for a direction around a beam [cosine]."""


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
    """Grid and refinement of a search for directions over a set of channels.

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

    def lines(self, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Spectra of the lines along X and Z (S, T, lines, G) of channels (S, T, L)."""
        out, each = [], y.reshape(-1, y.shape[2])
        for lines in (self.along_x, self.along_z):
            made = np.empty((len(each), len(lines.members), DIRECTIONS), np.complex64)
            for k, (members, spectra) in enumerate(zip(lines.members, lines.spectra, strict=True)):
                made[:, k] = each[:, members] @ spectra.T
            out.append(made.reshape(*y.shape[:2], *made.shape[1:]))
        return out[0], out[1]


def turned(phases: np.ndarray) -> np.ndarray:
    """exp(j phi) as complex64: real and imaginary part by themselves, several times faster."""
    phases = phases.astype(np.float32)
    out = np.empty(phases.shape, np.complex64)
    np.cos(phases, out=out.real)
    np.sin(phases, out=out.imag)
    return out


def _sizes(values: np.ndarray) -> np.ndarray:
    """Count for each value how many are equal to it."""
    return (np.abs(values[:, None] - values) < 1e-9).sum(axis=1)


@lru_cache(maxsize=8)
def channel_search(antennas: Antennas, wavenumber: float) -> Search:
    """The search over all channels of an echo."""
    return Search.of(all_channels(antennas), wavenumber, antennas.view_limit)


@lru_cache(maxsize=8)
def receiver_search(antennas: Antennas, wavenumber: float) -> Search:
    """The search over the receivers."""
    rx = np.arange(antennas.num_rx)
    channels = Channels(np.zeros_like(rx), rx, antennas.rx_positions)
    return Search.of(channels, wavenumber, antennas.view_limit)


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


def search_plain(x: np.ndarray, search: Search, noise: float, least: float) -> Found:
    """Return the largest T of cells against noise alone; exact where it is `least` / `PRUNED` or
    more. Below it is that of the grid, or a bound without a direction.

    Parameters
    ----------
    x : (T, L, S) complex64, channels of each look
    noise : mean power of a cell of one channel
    """
    size, scale = len(search.channels), 1 / (len(search.channels) * noise)
    # what a wave has between the grid's directions, as far as `PRUNED` does not allow for it
    raised = scale * max(PRUNED * search.scalloping**2, 1)
    flat, looks = x.reshape(-1, x.shape[2]), size * np.arange(len(x))[:, None]
    bound = np.zeros(x.shape[2], np.float32)
    for lines in (search.along_x, search.along_z):
        for members, spectra in zip(lines.members, lines.spectra, strict=True):
            bound += np.sqrt(line_bounds(flat, looks + members, spectra))
    cell = np.flatnonzero(bound**2 * raised >= least)
    x, bound = np.take(x, cell, axis=2), bound[cell]
    if max(len(lines.members) for lines in (search.along_x, search.along_z)) > 1:
        bound = _axis_bound(x, search)
    peak, cosines = bound**2 * raised, np.full((cell.size, 2), np.nan)
    some = np.flatnonzero(peak >= least)
    y = np.ascontiguousarray(x[:, :, some].transpose(2, 0, 1))
    whole = np.full((1, DIRECTIONS, DIRECTIONS), scale, np.float32)
    peak[some], cosines[some] = on_grid(y, whole, search)
    above = peak[some] >= least
    some = some[above]
    statistic = statistic_of(y[above], scale=scale)
    peak[some], cosines[some] = climbed(statistic, cosines[some], search)
    return Found(cell, peak, cosines)


def _axis_bound(x: np.ndarray, search: Search) -> np.ndarray:
    """(S,) amplitudes of channels (T, L, S) in the best direction of all lines along X, and of all
    along Z; `line_bounds` lets each line have its own."""
    out = np.zeros(x.shape[2], np.float32)
    for lines in (search.along_x, search.along_z):
        total = np.zeros((DIRECTIONS, x.shape[2]), np.float32)
        for members, spectra in zip(lines.members, lines.spectra, strict=True):
            beams = [spectra @ look[members] for look in x]
            total += np.sqrt(sum(beam.real**2 + beam.imag**2 for beam in beams))
        out += total.max(axis=0)
    return out


def search_white(
    x: np.ndarray, R: np.ndarray, cell: np.ndarray, search: Search, least: float = 0.0
) -> tuple[Found, np.ndarray]:
    """Return the largest T of cells with covariances, that of the grid where it is below `least`;
    and how much wider than in noise it scatters, 1 + (T - 1) c with c the share of clutter in the
    beam's power.

    Parameters
    ----------
    x : (S, T, L) channels of each look in units of the noise's amplitude
    R : (S, L, L) covariances in units of the noise
    cell : (S,) their numbers
    """
    inverse = inverses(R)
    y = np.matmul(x, inverse.transpose(0, 2, 1))
    peak, cosines = on_grid(y, 1 / denominators(inverse, search), search)
    some = np.flatnonzero(peak >= least)
    statistic = statistic_of(y[some], inverse[some])
    peak[some], cosines[some] = climbed(statistic, cosines[some], search)
    a = search.steering(cosines)
    white = np.einsum("sij,sj->si", inverse, a)
    share = 1 - (np.abs(white) ** 2).sum(axis=1) / (a.conj() * white).sum(axis=1).real
    return Found(cell, peak, cosines), 1 + (x.shape[1] - 1) * np.clip(share, 0, 1)


def statistic_of(
    y: np.ndarray, inverse: np.ndarray | None = None, scale: float = 1.0
) -> Callable[[np.ndarray], np.ndarray]:
    """Return the statistic of whitened channels y (S, T, L) as a function of steering vectors
    (S or 1, D, L), (S, D); `inverse` (S, L, L) is R^-1, None: 1, and T is as `scale` says."""

    def statistic(a: np.ndarray) -> np.ndarray:
        power = (np.abs(np.matmul(a, y.conj().transpose(0, 2, 1))) ** 2).sum(axis=2)
        if inverse is None:
            return np.asarray(scale * power)
        return np.asarray(power / ((a.conj() @ inverse) * a).sum(axis=-1).real)

    return statistic


def climbed(
    statistic: Callable[[np.ndarray], np.ndarray],
    cosines: np.ndarray,
    search: Search,
    steps: Sequence[float] | None = None,
    reach: int = 1,
) -> tuple[np.ndarray, np.ndarray]:
    """Return the largest statistic near directions (S, 2), and where: a parabola between grid
    points may overshoot and lie beside the peak, and what counts is the statistic itself.

    Parameters
    ----------
    statistic : of steering vectors (S, D, L), (S, D)
    steps : of the places that are tried, shrinking [cosine]; None: `CLIMBED`
    reach : steps to each side
    """
    if steps is None:
        steps = [part * float(search.cosines[1] - search.cosines[0]) for part in CLIMBED]
    peak, each = np.zeros(len(cosines), np.float32), np.arange(len(cosines))
    towards = search.steering(cosines)
    near = sorted(range(-reach, reach + 1), key=abs)
    around = np.stack(np.meshgrid(near, near, indexing="ij"), axis=-1).reshape(-1, 2)
    for step in steps:
        turns = search.steering(step * around)  # the phases of two directions add
        values = statistic(towards[:, None] * turns)
        best = values.argmax(axis=1)
        peak, cosines = values[each, best], cosines + step * around[best]
        towards = towards * turns[best]
    return peak, cosines


def line_bounds(x: np.ndarray, channels: np.ndarray, spectra: np.ndarray) -> np.ndarray:
    """Return the largest power of each cell of x (C, S) in a line's directions, added over the
    looks, (S,); parameters as for `fill_line_bounds`."""
    short = -x.shape[1] % LANES
    whole = np.ascontiguousarray(np.pad(x, ((0, 0), (0, short))) if short else x)
    out = np.empty(whole.shape[1], np.float32)
    fill_line_bounds(whole.view(np.float32), channels, spectra, out)
    return out[: x.shape[1]]


@twin_of(receive_directions.line_bounds)
def fill_line_bounds(
    maps: np.ndarray, channels: np.ndarray, spectra: np.ndarray, out: np.ndarray
) -> None:
    """Fill the largest power of each cell over a line's directions, added over the looks.

    Parameters
    ----------
    maps : (C, 2 S) float32, real and imaginary parts of channels in turn, S a multiple of 16
    channels : (T, n) numbers of the line's channels in each look
    spectra : (G, n) complex64, exp(+j k v u) along the line; an even number of directions
    out : (S,)
    """
    beams = spectra @ maps.view(np.complex64)[channels]
    out[:] = (beams.real**2 + beams.imag**2).sum(axis=0).max(axis=0)


def inverses(matrices: np.ndarray) -> np.ndarray:
    """(S, L, L) complex64, the inverses of Hermitian positive definite matrices (S, L, L)."""
    matrices = np.ascontiguousarray(matrices, np.complex64)
    out = np.empty_like(matrices)
    fill_inverses(matrices, out)
    return out


@twin_of(hermitian.inverses)
def fill_inverses(matrices: np.ndarray, out: np.ndarray) -> None:
    """Fill the inverses of Hermitian matrices (S, L, L) complex64, whose eigenvalues are one and
    more, as noise of unit power has it."""
    out[:] = np.linalg.inv(matrices.astype(complex))


def denominators(matrix: np.ndarray, search: Search) -> np.ndarray:
    """a^H Q a of all directions: (S, G, G) float32 from Hermitian matrices Q (S, L, L)."""
    out = np.empty((len(matrix), DIRECTIONS, DIRECTIONS), np.float32)
    quadratic_forms(np.ascontiguousarray(matrix, np.complex64), *search.axes, out)
    return out


@twin_of(receive_directions.quadratic_forms)
def quadratic_forms(
    matrices: np.ndarray, order: np.ndarray, x: Axis, z: Axis, out: np.ndarray
) -> None:
    """Fill a^H Q a of all directions (S, G, G), at least 1e-6, from Hermitian matrices Q (S, L, L)
    of channels which `order` sorts: those of the lines along X, then those along Z."""
    parts = []
    for axis, other in ((x, "ij"), (z, "ji")):
        line = np.repeat(np.arange(axis.ends.size - 1), np.diff(axis.ends))
        along = axis.cosines + 1j * axis.sines
        turns = (axis.turns[0] + 1j * axis.turns[1])[line]
        parts.append(np.einsum(f"in,nj->{other}n", along, turns))
    against = np.concatenate(parts, axis=2)  # a^*, of directions (i, j)
    Q = matrices[:, order][:, :, order]
    forms = np.einsum("ijm,smn,ijn->sij", against, Q, against.conj(), optimize=True)
    out[:] = np.maximum(forms.real, 1e-6)


def on_grid(y: np.ndarray, scale: np.ndarray, search: Search) -> tuple[np.ndarray, np.ndarray]:
    """Largest sum of |a^H y|^2 over the looks of y (S, T, L) times a scale (S or 1, G, G), and its
    direction, interpolated."""
    peak, place = np.zeros(len(y), np.float32), np.zeros((len(y), 2), np.float32)
    _, x, z = search.axes
    inside, u = search.inside.ravel().astype(np.float32), search.cosines
    lines = search.lines(y)
    search_directions(*lines, x.turns, z.turns, inside, scale.astype(np.float32), peak, place)
    return peak, u[0] + place * (u[1] - u[0])


@twin_of(receive_directions.search_directions)
def search_directions(
    along_x: np.ndarray,
    along_z: np.ndarray,
    turns_z: np.ndarray,
    turns_x: np.ndarray,
    inside: np.ndarray,
    scale: np.ndarray,
    peak: np.ndarray,
    place: np.ndarray,
) -> None:
    """Fill the largest power of each cell over all directions, and its place in steps of the grid,
    by a parabola through the logarithms of three neighbours on both axes.

    Parameters
    ----------
    along_x, along_z : (S, T, lines, G) complex64 spectra of the lines
    turns_z, turns_x : (2, lines, G) cosines and sines of the lines' places on the other axis
    inside : (G G) 1 for directions of the unit disc, else 0
    scale : (S or 1, G, G) of the power summed over the looks
    peak, place : (S,) and (S, 2) float32
    """
    beams = np.einsum("stki,kj->stij", along_x, turns_z[0] + 1j * turns_z[1])
    beams = beams + np.einsum("stkj,ki->stij", along_z, turns_x[0] + 1j * turns_x[1])
    power = (np.abs(beams) ** 2).sum(axis=1) * scale
    size = power.shape[1]
    best = (power.reshape(-1, size * size) * inside).argmax(axis=1)
    for s, at in enumerate(zip(*np.divmod(best, size), strict=True)):
        peak[s], place[s] = power[s][at], at
        for axis, line in enumerate((power[s][:, at[1]], power[s][at[0]])):
            if 0 < at[axis] < size - 1:
                three = np.maximum(line[at[axis] - 1 : at[axis] + 2], 1e-20)
                low, _, high = np.log(three / three[1])
                if low + high < 0:
                    offset = np.clip(0.5 * (low - high) / (low + high), -0.5, 0.5)
                    place[s, axis] += offset
                    peak[s] *= np.exp(((high - low) + (low + high) * offset) * offset / 2)
