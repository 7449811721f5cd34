r"""Searches of cells for directions: all channels coherently, over all looks and directions.

The channels :math:`x_t` of a cell's looks t are matched with the steering vector a(u) of every
direction,

.. math:: T(u) = \sum_t |a^H R^{-1} x_t|^2 / (a^H R^{-1} a),

R their covariance under noise and clutter, in units of the noise (see
`adaptive` of the city receivers). An echo has one look, all virtual channels; at a passive
terminal the transmit antennas are the looks, for nobody knows the direction in which they sent.
Where there is noise alone R = 1, and a bound on the sum over the lines of the array spares most
cells the search.

The channels may stand anywhere in the plane. Every line of them along an axis answers to one
direction cosine, and its phase against the others to the other one, so that the search is
separable: with F_l the spectrum of line l along X and G_l along Z,

.. math:: a^H y = \sum_l e^{jkz_lu_z} F_l(u_x) + \sum_l e^{jkx_lu_x} G_l(u_z).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property, lru_cache

import numpy as np
from scipy.linalg import lapack

from isac_rt.frame.antennas import SAME_POSITION_M, Antennas, aperture_of, folded
from isac_rt.kernels import hermitian, receive_directions
from isac_rt.kernels.jit import twin_of
from isac_rt.kernels.receive_directions import Axis
from isac_rt.kernels.vector import LANES
from isac_rt.receive.arms import Channels, all_channels

STEPS_OF_A_BEAM, MOST_DIRECTIONS = 4, 1024
"""Directions searched within a resolution (wavelength over aperture) on each axis, half as many
where all together were more than that; the peak between them is sought from there."""
PRUNED = 0.9
"""Share of the lower threshold below which a cell is not looked at further: between directions of
the grid a parabola misses a tenth of a peak at most."""
CLIMBED = 0.3, 0.12
"""Steps, in those of the grid, by which the peak between them is climbed."""
STENCILS = 0.15, 0.06, 0.03, 0.03
"""Half widths of the stencils on which a peak is fitted [resolutions]."""
MOST_SIDE_BY_SIDE = 128
"""Channels up to which sixteen covariances fit the cache that their inversion side by side needs;
above, one by one by LAPACK takes half the time."""
AROUND = np.stack(np.meshgrid([0, -1, 1], [0, -1, 1], indexing="ij"), axis=-1).reshape(-1, 2)
"""The nine points of a stencil."""


@dataclass(frozen=True)
class Lines:
    """The lines of an array along one axis.

    Attributes
    ----------
    members : of each line the numbers of its channels
    spectra : of each line (G, n) complex64, exp(+j k v u) along it
    phasors : (lines, H) complex64, exp(+j k v u) of its place on the other axis
    """

    members: tuple[np.ndarray, ...]
    spectra: tuple[np.ndarray, ...]
    phasors: np.ndarray

    @classmethod
    def of(
        cls, places: np.ndarray, number: np.ndarray, u: tuple[np.ndarray, np.ndarray], axis: int
    ) -> Lines:
        """The lines along an axis of channels at `places` (L, 2) [rad per unit cosine], each in
        the line of its `number`, -1: in none."""
        members = tuple(np.flatnonzero(number == n) for n in np.unique(number[number >= 0]))
        spectra = [np.exp(1j * np.outer(u[axis], places[m, axis])) for m in members]
        across = np.array([places[m[0], 1 - axis] for m in members])
        phasors = np.exp(1j * np.outer(across, u[1 - axis])).astype(np.complex64)
        return cls(members, tuple(s.astype(np.complex64) for s in spectra), phasors)


@dataclass(frozen=True)
class Search:
    """Grid and refinement of a search for directions over a set of channels, anywhere in a plane.

    Attributes
    ----------
    channels : Channels
    cosines : (G,) values of u_x and (H,) of u_z, even in number, H a multiple of `LANES`; all 0 on
        an axis that the channels do not observe
    along_x, along_z : Lines
    inside : (G, H) bool, directions (u_x, u_z) of the unit disc
    wavenumber : [rad/m]
    cosine_period : (2,) of `Antennas.cosine_period`
    beam : (2,) resolution, 0 on an axis that the channels do not observe
    """

    channels: Channels
    cosines: tuple[np.ndarray, np.ndarray]
    along_x: Lines
    along_z: Lines
    inside: np.ndarray
    wavenumber: float
    cosine_period: np.ndarray
    beam: np.ndarray

    @classmethod
    def of(
        cls, channels: Channels, wavenumber: float, limit: float, cosine_period: np.ndarray
    ) -> Search:
        """Directions within `limit` on both axes, or within the half period that the array tells
        apart."""
        places, limits = channels.positions[:, [0, 2]], np.minimum(limit, cosine_period / 2)
        seen = np.ptp(places, axis=0) > SAME_POSITION_M
        aperture = np.array([aperture_of(along) for along in places.T])
        beam = np.where(seen, 2 * np.pi / (wavenumber * aperture), 0.0)
        for step in (beam / STEPS_OF_A_BEAM, 2 * beam / STEPS_OF_A_BEAM):
            x, z = (_grid(*of) for of in zip(limits, step, strict=True))
            if x.size * z.size <= MOST_DIRECTIONS:
                break
        u = x, z
        # a channel belongs to the longer of the two lines through it
        row, column = (_numbers(along) for along in places.T[::-1])
        on_x = np.bincount(row)[row] >= np.bincount(column)[column]
        phases = wavenumber * places
        along_x = Lines.of(phases, np.where(on_x, row, -1), u, 0)
        along_z = Lines.of(phases, np.where(on_x, -1, column), u, 1)
        inside = np.add.outer(x**2, z**2) <= 1
        return cls(channels, u, along_x, along_z, inside, wavenumber, cosine_period, beam)

    @property
    def steps(self) -> np.ndarray:
        """(2,) of the grid."""
        return np.array([u[1] - u[0] for u in self.cosines])

    @property
    def observed(self) -> np.ndarray:
        """(2,) bool, axes that the channels observe."""
        return self.beam > 0

    def steering(self, cosines: np.ndarray) -> np.ndarray:
        """(..., L) complex64 exp(-j k v.u) of directions (..., 2)."""
        return turned(-self.wavenumber * (cosines @ self.channels.positions[:, [0, 2]].T))

    def reading(self, cosines: np.ndarray) -> np.ndarray:
        """Directions (..., 2) by the nearest to boresight of those that the channels do not tell
        apart; NaN beyond the horizon, and on an axis that they do not observe."""
        u = folded(cosines, self.cosine_period)
        real = (u**2).sum(axis=-1, keepdims=True) <= 1
        return np.where(real & self.observed, u, np.nan)

    @cached_property
    def axes(self) -> tuple[np.ndarray, Axis, Axis]:
        """Numbers of the channels line by line, first those along X, and both axes' lines."""
        axes = []
        for u, lines in zip(self.cosines, (self.along_x, self.along_z), strict=True):
            ends = np.cumsum([0, *(len(m) for m in lines.members)])
            spectra = np.concatenate([np.zeros((u.size, 0), np.complex64), *lines.spectra], 1)
            cosines, sines = np.stack([spectra.real, spectra.imag])
            phasors = np.stack([lines.phasors.real, lines.phasors.imag])
            axes.append(Axis(ends, cosines, sines, phasors))
        order = np.concatenate([*self.along_x.members, *self.along_z.members])
        return order, axes[0], axes[1]

    @cached_property
    def scalloping(self) -> float:
        """By how much a wave half a step off the grid on both axes exceeds, in amplitude, the sum
        of what the lines have of it on the grid."""
        half = self.wavenumber * self.steps / 2
        gains = [
            abs(np.exp(1j * half[axis] * self.channels.positions[members, 2 * axis]).sum())
            for axis, lines in enumerate((self.along_x, self.along_z))
            for members in lines.members
        ]
        return len(self.channels) / float(sum(gains))

    def spread(self, cosine: float) -> np.ndarray:
        """(L, L) by which a box of directions, so wide, tapers a covariance."""
        places = self.channels.positions
        separation = (places[:, None] - places) * self.wavenumber / (2 * np.pi) * cosine
        return (np.sinc(separation[..., 0]) * np.sinc(separation[..., 2])).astype(np.float32)

    def lines(self, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Spectra of the lines along X (S, T, lines, G) and Z (S, T, lines, H) of channels (S, T,
        L)."""
        out, each = [], y.reshape(-1, y.shape[2])
        for u, lines in zip(self.cosines, (self.along_x, self.along_z), strict=True):
            made = np.empty((len(each), len(lines.members), u.size), np.complex64)
            for k, (members, spectra) in enumerate(zip(lines.members, lines.spectra, strict=True)):
                made[:, k] = each[:, members] @ spectra.T
            out.append(made.reshape(*y.shape[:2], *made.shape[1:]))
        return out[0], out[1]


def _grid(limit: float, step: float) -> np.ndarray:
    """Values of a direction cosine within a limit at a step or less, which may be a tenth more; a
    multiple of `LANES`, all 0 without a step."""
    if step == 0:
        return np.zeros(LANES)
    size = LANES * max(int(np.ceil(2 * limit / step / LANES - 0.1)), 1)
    return limit * (2 * np.arange(size) + 1 - size) / size


def _numbers(along: np.ndarray) -> np.ndarray:
    """Number the lines of channels at `along` across them [m]."""
    return np.unique(np.round(along / SAME_POSITION_M), return_inverse=True)[1]


def turned(phases: np.ndarray) -> np.ndarray:
    """exp(j phi) as complex64: real and imaginary part by themselves, several times faster."""
    phases = phases.astype(np.float32)
    out = np.empty(phases.shape, np.complex64)
    np.cos(phases, out=out.real)
    np.sin(phases, out=out.imag)
    return out


@lru_cache(maxsize=16)
def search_of(antennas: Antennas, wavenumber: float, passes: int, limit: float = 1.0) -> Search:
    """The search over all channels of an echo, or over the receivers for one pass."""
    channels = all_channels(antennas)
    if passes == 1:
        rx = np.arange(antennas.num_rx)
        channels = Channels(np.zeros_like(rx), rx, antennas.rx_positions)
    cosine_period = antennas.cosine_period(2 * np.pi / wavenumber, passes)
    return Search.of(channels, wavenumber, limit, cosine_period)


def channel_search(antennas: Antennas, wavenumber: float) -> Search:
    """The search over all channels of an echo within the field of view."""
    return search_of(antennas, wavenumber, 2, antennas.view_limit)


def receiver_search(antennas: Antennas, wavenumber: float) -> Search:
    """The search over the receivers within the field of view."""
    return search_of(antennas, wavenumber, 1, antennas.view_limit)


@dataclass(frozen=True)
class DirectionPeaks:
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


def search_plain(x: np.ndarray, search: Search, noise: float, least: float) -> DirectionPeaks:
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
    rows = np.flatnonzero(peak >= least)
    y = np.ascontiguousarray(x[:, :, rows].transpose(2, 0, 1))
    whole = np.full((1, *search.inside.shape), scale, np.float32)
    peak[rows], cosines[rows] = strongest_on_grid(y, whole, search)
    above = peak[rows] >= least
    rows = rows[above]
    statistic = statistic_of(y[above], scale=scale)
    peak[rows], cosines[rows] = climbed(statistic, cosines[rows], search)
    return DirectionPeaks(cell, peak, cosines)


def _axis_bound(x: np.ndarray, search: Search) -> np.ndarray:
    """(S,) amplitudes of channels (T, L, S) in the best direction of all lines along X, and of all
    along Z; `line_bounds` lets each line have its own."""
    out = np.zeros(x.shape[2], np.float32)
    for lines in (search.along_x, search.along_z):
        total = np.zeros((1, x.shape[2]), np.float32)
        for members, spectra in zip(lines.members, lines.spectra, strict=True):
            beams = [spectra @ weights[members] for weights in x]
            total = total + np.sqrt(sum(beam.real**2 + beam.imag**2 for beam in beams))
        out += total.max(axis=0)
    return out


def search_white(
    x: np.ndarray, R: np.ndarray, cell: np.ndarray, search: Search, least: float = 0.0
) -> tuple[DirectionPeaks, np.ndarray]:
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
    peak, cosines = strongest_on_grid(y, 1 / denominators(inverse, search), search)
    rows = np.flatnonzero(peak >= least)
    statistic = statistic_of(y[rows], inverse[rows])
    peak[rows], cosines[rows] = climbed(statistic, cosines[rows], search)
    a = search.steering(cosines)
    white = np.einsum("sij,sj->si", inverse, a)
    share = 1 - (np.abs(white) ** 2).sum(axis=1) / (a.conj() * white).sum(axis=1).real
    return DirectionPeaks(cell, peak, cosines), 1 + (x.shape[1] - 1) * np.clip(share, 0, 1)


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
    statistic: Callable[[np.ndarray], np.ndarray], cosines: np.ndarray, search: Search
) -> tuple[np.ndarray, np.ndarray]:
    """Return the largest statistic near directions (S, 2), and where: a parabola between grid
    points may overshoot and lie beside the peak, and what counts is the statistic itself.

    `statistic` is of steering vectors (S, D, L), (S, D).
    """
    peak, rows = np.zeros(len(cosines), np.float32), np.arange(len(cosines))
    towards = search.steering(cosines)
    for part in CLIMBED:
        step = part * search.steps
        phasors = search.steering(step * AROUND)  # the phases of two directions add
        values = statistic(towards[:, None] * phasors)
        best = values.argmax(axis=1)
        peak, cosines = values[rows, best], cosines + step * AROUND[best]
        towards = towards * phasors[best]
    return peak, cosines


def settled(
    statistic: Callable[[np.ndarray], np.ndarray], cosines: np.ndarray, search: Search
) -> np.ndarray:
    """Return the directions (S, 2) of the largest statistic near some, by Newton's steps on
    paraboloids through its logarithm; parameters as for `climbed`."""
    u = np.array(cosines, float)
    for half in STENCILS:
        values = statistic(search.steering(u[:, None] + half * search.beam * AROUND))
        most = values.max(axis=1, keepdims=True).astype(float)
        g = np.log(np.maximum(values / np.maximum(most, 1e-300), 1e-6)).reshape(-1, 3, 3)
        slope = np.stack([g[:, 2, 0] - g[:, 1, 0], g[:, 0, 2] - g[:, 0, 1]], axis=1) / 2
        curvature = np.stack([g[:, 1:, 0].sum(axis=1), g[:, 0, 1:].sum(axis=1)], axis=1)
        curvature = np.where(search.observed, curvature - 2 * g[:, :1, 0], -1.0)
        mixed = (g[:, 2, 2] - g[:, 2, 1] - g[:, 1, 2] + g[:, 1, 1]) / 4
        det = curvature.prod(axis=1) - mixed**2
        peaked = (curvature < 0).all(axis=1) & (det > 0)
        move = (mixed[:, None] * slope[:, ::-1] - curvature[:, ::-1] * slope) / det.clip(1e-30)[
            :, None
        ]
        move = np.where(peaked[:, None], move, np.sign(slope))  # beside the peak: uphill
        u += half * search.beam * np.clip(move, -3, 3)
    return u


def strongest(y: np.ndarray, search: Search, *, on_grid: bool = False) -> np.ndarray:
    """Return the directions (S, 2) in which channels (S, T, L), in phase over L and in power over
    T, have most, which is the maximum-likelihood estimate of one wave in white noise.

    NaN on an axis that is not observed, and beyond the horizon. `on_grid`: the nearest of eight
    directions to a resolution.
    """
    level = np.sqrt((np.abs(y) ** 2).mean(axis=(1, 2), keepdims=True))
    y = (y / np.maximum(level, 1e-300)).astype(np.complex64)
    u = strongest_on_grid(y, np.ones((1, *search.inside.shape), np.float32), search)[1]
    u = settled(statistic_of(y), u, search)
    if on_grid:
        step = np.where(search.observed, search.beam / 8, 1.0)
        u = np.round(u / step) * step
    return search.reading(u)


@lru_cache(maxsize=16)
def direction_bound(antennas: Antennas, passes: int, wavenumber: float) -> np.ndarray:
    r"""(2, 2) Cramer-Rao bound of u_x and u_z of one wave at unit SNR of all channels together,
    infinite where an axis is not observed.

    The inverse of :math:`2 k^2 C`, with C the covariance of the channels' places.
    """
    places = antennas.virtual_positions if passes == 2 else antennas.rx_positions
    axes = np.flatnonzero(antennas.observes(passes))
    out = np.diag([np.inf, np.inf])
    if axes.size:
        fisher = np.atleast_2d(2 * wavenumber**2 * np.cov(places[:, 2 * axes].T, bias=True))
        least = 1e-9 * np.trace(fisher) * np.eye(axes.size)  # of a row that stands askew
        out[np.ix_(axes, axes)] = np.linalg.inv(fisher + least)
    return out


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
    if matrices.shape[1] <= MOST_SIDE_BY_SIDE:
        fill_inverses(matrices, out)
        return out
    for matrix, inverse in zip(matrices, out, strict=True):
        upper = np.triu(lapack.zpotri(lapack.zpotrf(matrix)[0])[0])
        inverse[:] = upper + np.triu(upper, 1).conj().T
    return out


@twin_of(hermitian.inverses)
def fill_inverses(matrices: np.ndarray, out: np.ndarray) -> None:
    """Fill the inverses of Hermitian matrices (S, L, L) complex64, whose eigenvalues are one and
    more, as noise of unit power has it."""
    out[:] = np.linalg.inv(matrices.astype(complex))


def denominators(matrix: np.ndarray, search: Search) -> np.ndarray:
    """a^H Q a of all directions: (S, G, H) float32 from Hermitian matrices Q (S, L, L)."""
    out = np.empty((len(matrix), *search.inside.shape), np.float32)
    quadratic_forms(np.ascontiguousarray(matrix, np.complex64), *search.axes, out)
    return out


@twin_of(receive_directions.quadratic_forms)
def quadratic_forms(
    matrices: np.ndarray, order: np.ndarray, x: Axis, z: Axis, out: np.ndarray
) -> None:
    """Fill a^H Q a of all directions (S, G, H), at least 1e-6, from Hermitian matrices Q (S, L, L)
    of channels which `order` sorts: those of the lines along X, then those along Z."""
    parts = []
    for axis, other in ((x, "ij"), (z, "ji")):
        line = np.repeat(np.arange(axis.ends.size - 1), np.diff(axis.ends))
        along = axis.cosines + 1j * axis.sines
        phasors = (axis.phasors[0] + 1j * axis.phasors[1])[line]
        parts.append(np.einsum(f"in,nj->{other}n", along, phasors))
    against = np.concatenate(parts, axis=2)  # a^*, of directions (i, j)
    Q = matrices[:, order][:, :, order]
    forms = np.einsum("ijm,smn,ijn->sij", against, Q, against.conj(), optimize=True)
    out[:] = np.maximum(forms.real, 1e-6)


def strongest_on_grid(
    y: np.ndarray, scale: np.ndarray, search: Search
) -> tuple[np.ndarray, np.ndarray]:
    """Largest sum of |a^H y|^2 over the looks of y (S, T, L) times a scale (S or 1, G, H), and its
    direction, interpolated."""
    peak, cosines = np.zeros(len(y), np.float32), np.zeros((len(y), 2), np.float32)
    _, x, z = search.axes
    inside, first = search.inside.ravel().astype(np.float32), [u[0] for u in search.cosines]
    lines = search.lines(y)
    search_directions(*lines, x.phasors, z.phasors, inside, scale.astype(np.float32), peak, cosines)
    return peak, first + cosines * search.steps


@twin_of(receive_directions.search_directions)
def search_directions(
    along_x: np.ndarray,
    along_z: np.ndarray,
    phasors_z: np.ndarray,
    phasors_x: np.ndarray,
    inside: np.ndarray,
    scale: np.ndarray,
    peak: np.ndarray,
    place: np.ndarray,
) -> None:
    """Fill the largest power of each cell over all directions, and its place in steps of the grid,
    by a parabola through the logarithms of three neighbours on both axes.

    Parameters
    ----------
    along_x, along_z : (S, T, lines, G) and (S, T, lines, H) complex64 spectra of the lines
    phasors_z, phasors_x : (2, lines, H or G) cosines and sines of the lines' places on the other
        axis
    inside : (G H) 1 for directions of the unit disc, else 0
    scale : (S or 1, G, H) of the power summed over the looks
    peak, place : (S,) and (S, 2) float32
    """
    beams = np.einsum("stki,kj->stij", along_x, phasors_z[0] + 1j * phasors_z[1])
    beams = beams + np.einsum("stkj,ki->stij", along_z, phasors_x[0] + 1j * phasors_x[1])
    power = (np.abs(beams) ** 2).sum(axis=1) * scale
    best = (power.reshape(len(power), -1) * inside).argmax(axis=1)
    for s, at in enumerate(zip(*np.divmod(best, power.shape[2]), strict=True)):
        peak[s], place[s] = power[s][at], at
        for axis, line in enumerate((power[s][:, at[1]], power[s][at[0]])):
            if 0 < at[axis] < line.size - 1:
                three = np.maximum(line[at[axis] - 1 : at[axis] + 2], 1e-20)
                low, _, high = np.log(three / three[1])
                if low + high < 0:
                    offset = np.clip(0.5 * (low - high) / (low + high), -0.5, 0.5)
                    place[s, axis] += offset
                    peak[s] *= np.exp(((high - low) + (low + high) * offset) * offset / 2)
