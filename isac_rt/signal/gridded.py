r"""IF samples of many paths through an oversampled grid of fast-time frequency (a non-uniform FFT
per chirp).

In each chirp every path is a tone of known start phase and frequency (float64). It is spread with a
few weights on a grid of frequencies, all receive elements at once; one FFT and one division make
the samples. Further sets of weights on the same grid points carry x and x^2 (x: time from the
middle of the chirp), so that the quadratic phase of motion and the wideband delay of each receive
element need no second transform:

.. math::

    z\,e^{-j\theta_l\lambda}\,e^{jq(x^2-c)}\,e^{j\theta_l x} \approx z\,e^{-j\theta_l\lambda}\,(1 +
    j\theta_l (1 + jq\kappa) x + (jq - \theta_l^2/2)(x^2-c) - c\theta_l^2/2)

with theta_l the turn of element l over half a chirp, lambda = tau/(T/2) (the array sees the
frequency sent tau earlier), c the mean of x^2, and kappa = 4/15 (x (x^2 - c) is nearest to kappa
x). A cubic setting has a fourth set for x^3 - 3/5 x, of strength theta_l (jq - theta_l^2/6), and
theta_l (1 - theta_l^2/10 + jq kappa) with x. The narrowband model has theta_l = 0.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache, partial
from typing import Any, NamedTuple

import numpy as np
import scipy.fft

from isac_rt.frame.payload import Payload
from isac_rt.frame.waveform import Waveform
from isac_rt.kernels.fourier import ROW, plan, transform
from isac_rt.kernels.jit import jit
from isac_rt.kernels.vector import (
    LANES,
    aligned,
    cos_sin,
    cos_sin_exact,
    floor,
    load,
    narrow,
    new_memory,
    splat,
    store,
    stream,
    transpose,
    unset,
    zip_high,
    zip_low,
)
from isac_rt.signal.covered import (
    EXTRA,
    TAPS,
    Batches,
    Covered,
    Desk,
    Sheet,
    add_covered,
    batches,
    covered_paths,
    desk,
    line_turn,
    no_paths,
    part_slots,
    plain_batches,
    turn_elements,
)
from isac_rt.signal.direct import (
    OneByOne,
    add_direct,
    flush,
    numbers,
    one_by_one,
    passed,
    sum_paths,
)
from isac_rt.signal.noise import SILENCE, WhiteNoise, add_stream_by, words_room
from isac_rt.signal.profiles import CHIRPS, Band, make_band, no_band, to_cells, write_cells
from isac_rt.signal.tones import Tones, sources
from isac_rt.storage import kept


@dataclass(frozen=True)
class Setting:
    """How a grid is made. Errors and costs: docs/performance.md.

    Attributes
    ----------
    oversampling : grid points per sample, at least
    width : grid points per path, 2 to 16, even
    wideband : delays of the receive elements applied to the whole chirp (to second order), not to
        its middle alone
    cubic : the third order in x too, of a wideband setting
    faint : paths that noise covers are shared between lines (`isac_rt.signal.covered`), to whose
        `TAPS` grid points the division by the kernel's response is fitted then
    """

    oversampling: float
    width: int
    wideband: bool
    cubic: bool = False
    faint: bool = False


DEFAULT = Setting(1.5, 6, True)
"""For runs: error below `GRIDDED_ERROR`."""
GRIDDED_ERROR = 1e-4
"""Bound of the relative RMS error of `DEFAULT` against the exact model (measured: see
tests/signal/test_ifsignal.py)."""
PROFILES = Setting(1.25, 6, True)
"""For range cells made directly: error below `GRIDDED_ERROR` under the window, 3e-4 of samples."""
ACCURATE = Setting(1.5, 8, True, True)
"""Error below `ACCURATE_ERROR` of the full model up to 15 m/s and |u| = 0.87; grows with the square
of the speed."""
ACCURATE_ERROR = 5e-6
COVERING = Setting(1.5, 12, True, faint=True)
"""Error below `GRIDDED_ERROR`; of paths that noise covers below
`isac_rt.signal.covered.covered_error`."""
# paths that no longer stay in the second-level cache beside the grid; they are read once for
# several chirps
_MANY = 4000
_TOGETHER = 6
_MARGIN = LANES  # rows beyond the grid
_TILE = 2 * LANES * LANES  # floats of 16 complex samples of 16 channels
_STEP = 4 * LANES  # floats between the weights of a grid point and those of the next
_DOPPLER = 4 / 1024  # cycles per sample, more than motion and elements move a frequency
_FIELDS = 3  # float64 of a path before its transmit elements' delays
_ONE, _HALF, _SIXTH, _TENTH = np.float32(1), np.float32(0.5), np.float32(1 / 6), np.float32(1 / 10)
_SKEW = np.float32(4 / 15)  # x (x^2 - 1/3) is nearest to 4/15 x
_MEAN_CUBE = 3 / 5  # and x^3 to 3/5 x
_BELOW = 1 - 1e-14  # keeps a frequency that is rounded up to a whole turn on the grid


class Kernel(NamedTuple):
    """What spreads tones on a grid and what divides its response out.

    Attributes
    ----------
    grid : G, number of grid frequencies
    polynomials : (4, degree + 1, width) float32, highest power first
    faint : (4, degree + 1, faint width) float32, of paths that noise covers
    deconvolution : (N,) float32, D at x = n - N//2
    """

    grid: int
    polynomials: np.ndarray
    faint: np.ndarray
    deconvolution: np.ndarray


def grid_size(num_samples: int, oversampling: float, width: int) -> int:
    """Grid points a turn for chirps of N samples."""
    return scipy.fft.next_fast_len(
        max(int(np.ceil(oversampling * num_samples)), 4 * width), real=True
    )


@lru_cache(maxsize=16)
def weights(num_samples: int, oversampling: float, width: int, faint: int = 0) -> Kernel:
    """As `_weights`, which takes as long as two cubes, or as an earlier run kept them."""
    of = num_samples, oversampling, width, faint
    return Kernel(*kept("grid weights", of, lambda: list(_weights(*of))))


def _weights(num_samples: int, oversampling: float, width: int, faint: int) -> Kernel:
    r"""Grid size, weight polynomials and deconvolution for chirps of N samples.

    A tone r grid steps from the middle of its cell has, on the grid points j - (WIDTH - 1)/2,
    weights such that D(x) sum_j w_j exp(j 2 pi x (j - (WIDTH-1)/2 - r)/G) = 1, j x, x^2 - c, j (x^3
    - 3/5 x) for the four sets, x = -N/2 .. N/2 scaled to [-1, 1]. Least squares in turn for w and
    for D, from a Kaiser-Bessel start; the weights are real by symmetry. With `faint` D is that of
    so many grid points, and what more of them leave is fitted to it.
    """
    first = faint or width
    grid = grid_size(num_samples, oversampling, width)
    nodes, basis = _basis(num_samples, grid, first)
    steps = np.arange(first) - (first - 1) / 2
    beta = 0.98 * np.pi * (1 - num_samples / grid / 2) * first
    bell = np.i0(beta * np.sqrt(np.clip(1 - ((steps - nodes[:, None]) * 2 / first) ** 2, 0, None)))
    for _ in range(12):
        response = np.einsum("rxj,rj->rx", basis, bell)
        deconvolution = response.real.sum(0) / (np.abs(response) ** 2).sum(0)
        fits = _fits(num_samples, basis, deconvolution)
        bell = fits[:, :, 0]
    narrow = _polynomials(nodes, fits)
    if faint:
        nodes, basis = _basis(num_samples, grid, width)
        wide = _polynomials(nodes, _fits(num_samples, basis, deconvolution))
    else:
        wide, narrow = narrow, np.zeros((4, 1, 0), np.float32)
    return Kernel(grid, wide, narrow, deconvolution[:num_samples].astype(np.float32))


def _basis(num_samples: int, grid: int, width: int) -> tuple[np.ndarray, np.ndarray]:
    """Places in a cell (R,) and the tones of the grid points about each, (R, N + 1, width)."""
    half, degree = num_samples // 2, width + EXTRA
    nodes = np.cos(np.pi * (np.arange(2 * degree) + 0.5) / (2 * degree)) / 2
    steps = np.arange(width) - (width - 1) / 2
    x = np.arange(-half, half + 1)
    return nodes, np.exp(
        2j * np.pi / grid * x[None, :, None] * (steps[None, None, :] - nodes[:, None, None])
    )


def _fits(num_samples: int, basis: np.ndarray, deconvolution: np.ndarray) -> np.ndarray:
    """(R, width, 4) weights of the four sets at each place."""
    half = num_samples // 2
    scaled = np.arange(-half, half + 1) / half
    goals = np.stack(
        [
            np.ones_like(scaled, complex),
            1j * scaled,
            scaled**2 - mean_square(num_samples) + 0j,
            1j * (scaled**3 - _MEAN_CUBE * scaled),
        ],
        axis=1,
    )
    return np.array([_real_least_squares(deconvolution[:, None] * b, goals) for b in basis])


def _polynomials(nodes: np.ndarray, fits: np.ndarray) -> np.ndarray:
    """(4, degree + 1, width) float32."""
    degree = nodes.size // 2
    sets = [np.polyfit(nodes, fits[:, :, k], degree) for k in range(4)]
    return np.array(sets).astype(np.float32)


def mean_square(num_samples: int) -> float:
    """Mean of x^2 over the samples, x scaled to [-1, 1]."""
    half = num_samples // 2
    return float(((np.arange(num_samples) - half) ** 2).mean()) / half**2


def _real_least_squares(matrix: np.ndarray, goals: np.ndarray) -> np.ndarray:
    """Real solution of a complex least-squares problem."""
    both = np.concatenate([matrix.real, matrix.imag]), np.concatenate([goals.real, goals.imag])
    return np.linalg.lstsq(*both, rcond=None)[0]


class _View(NamedTuple):
    """What of a chirp is wanted: numbers of one chirp, or arrays (M P,) of all.

    Attributes
    ----------
    shift : cycles per sample taken off every frequency
    origin : samples from the chirp's middle one to the origin
    share : samples of the chirp to one of the grid's
    below : frequencies below zero that are kept
    limit : first frequency left out
    turn : complex, factor of the chirp's paths
    """

    shift: Any
    origin: Any
    share: Any
    below: Any
    limit: Any
    turn: Any


class _Grid(NamedTuple):
    """How chirps are gridded: half their samples, mean of x^2, one 0 per grid point of a path, the
    orders of the wideband term, `weights`, the `plan` of the transform, and in which order chirps
    are made."""

    half: float
    centre: float
    taps: tuple[int, ...]
    wideband: bool
    cubic: bool
    poly: np.ndarray
    deconvolution: np.ndarray
    radices: np.ndarray
    twiddles: np.ndarray
    rows: np.ndarray
    order: Batches


class _Blocks(NamedTuple):
    """Paths sixteen by sixteen, neighbours on the grid together, each block of one link and one
    offset.

    Attributes
    ----------
    path : (16 B,) index into the tones, the last repeated where a block is not full
    table : float64, of each block 16 delays, rates, accelerations and delays of each transmit
        element
    factor : float32, of each block 16 real and 16 imaginary parts; where elements differ, of each
        transmit element one after the other
    life : float64, of each block 16 begins and 16 ends
    blocks : (B, 4) link, offset, number of paths, whether any of them is born or dies in the frame
    bounds : (B, 2) least and greatest delay in the frame, without data
    """

    path: np.ndarray
    table: np.ndarray
    factor: np.ndarray
    life: np.ndarray
    blocks: np.ndarray
    bounds: np.ndarray


class _Faint(NamedTuple):
    """Paths that noise covers, how they are spread, and the memory of their sums."""

    paths: Covered
    sheet: Sheet
    desk: Desk


class _Heard(NamedTuple):
    """What is heard: blocks of paths, the `_steering` of these, what noise covers, and what is
    added past the grid."""

    blocks: _Blocks
    steer: np.ndarray
    faint: _Faint
    alone: OneByOne


class _Room(NamedTuple):
    """Memory of the kernel: the grids, numbers of 16 paths, their places and frequencies, their
    weights, what is emitted, and random words of its noise."""

    grid: np.ndarray
    work: np.ndarray
    places: np.ndarray
    scratch: np.ndarray
    tile: np.ndarray
    words: np.ndarray


@jit(fast=True, borrows=True)
def _prepare(work, places, b, block, w, g, view, time, symbol, send, antenna):
    """Of 16 paths: place on the grid and frequency [cycles/sample] to `places`; distance from the
    middle of the cell, complex factor (less the filter's gain), quadratic term [rad] and lambda, 16
    floats of each, to `work`."""
    f_c, slope, ts, u = w.carrier, w.slope, w.step, w.middle + view.origin * w.step
    half, size = g.half, g.rows.shape[0]
    variants = b.factor.shape[0] // (32 * b.blocks.shape[0])  # by transmit element, or one
    f = 32 * (block * variants + (antenna if variants > 1 else 0))
    table, at = b.table, block * (b.table.shape[0] // b.blocks.shape[0])
    delay, rate, accel, extra = (
        load(table, at),
        load(table, at + 16),
        load(table, at + 32),
        load(table, at + (_FIELDS + antenna) * 16),
    )
    tau = delay + splat(symbol) + (rate + accel * splat(time / 2)) * splat(time)
    element = tau + extra
    step, a = (rate + accel * splat(time)) * splat(ts), accel * splat(ts * ts / 2)
    carrier = splat(f_c + slope * u)
    sent = carrier - splat(slope) * element
    cycles = element * (carrier - splat(slope / 2) * element)
    frequency = sent * step + splat(slope * ts) * element
    wanted = frequency - splat(view.shift)
    fold = floor(wanted + splat(view.below))
    wanted, cycles = wanted - fold, cycles - fold * splat(view.origin)
    store(places, 16, wanted)
    wanted = wanted * splat(view.share)
    place = (wanted - floor(wanted)) * splat(size * _BELOW)
    cell = floor(place)
    store(places, 0, cell)
    store(work, 0, narrow(place - cell) - splat(_HALF))
    bend = narrow(
        (sent * a + splat(slope) * step * (splat(ts) - splat(0.5) * step)) * splat(half * half)
    )
    c, s = cos_sin(narrow(cycles - floor(cycles + splat(0.5))) + bend * splat(np.float32(g.centre)))
    br, bi = load(b.factor, f), load(b.factor, f + 16)
    sr, si = splat(np.float32(send.real)), splat(np.float32(send.imag))
    ar, ai = br * sr - bi * si, br * si + bi * sr
    store(work, 16, ar * c - ai * s)
    store(work, 32, ar * s + ai * c)
    store(work, 48, bend * splat(np.float32(2 * np.pi)))
    store(work, 64, narrow((tau - splat(view.origin * ts)) * splat(1 / (ts * half))))


@jit(fast=True, borrows=True)
def _gate(work, b, block, w, time, symbol):
    """Multiply the factors of 16 paths by the filter's gain, and by 0 when they are not alive."""
    table, life, f = b.table, b.life, 32 * block
    at = block * (table.shape[0] // b.blocks.shape[0])
    for i in range(16):
        tau = table[at + i] + symbol + (table[at + 16 + i] + table[at + 32 + i] * time / 2) * time
        alive = life[f + i] <= time < life[f + 16 + i]
        gain = np.float32(passed(w, tau)) if alive else np.float32(0)
        work[16 + i] *= gain
        work[32 + i] *= gain


@jit(fast=True, borrows=True)
def _weigh(work, scratch, poly, taps, wideband, cubic):
    """Weights of the grid points of 16 paths: times the complex factor (narrowband), or the sets as
    they are."""
    r, c, s, q = load(work, 0), load(work, 16), load(work, 32), load(work, 48)
    width, degree = len(taps), len(taps) + EXTRA
    set_size = (degree + 1) * width
    for j in range(width):
        v0, v1, v2 = splat(poly[j]), splat(poly[set_size + j]), splat(poly[2 * set_size + j])
        for d in range(1, degree + 1):
            v0 = v0 * r + splat(poly[d * width + j])
            v2 = v2 * r + splat(poly[2 * set_size + d * width + j])
            if wideband:
                v1 = v1 * r + splat(poly[set_size + d * width + j])
        if wideband:
            store(scratch, _STEP * j, v0)
            store(scratch, _STEP * j + 16, v1)
            store(scratch, _STEP * j + 32, v2)
        else:
            bent = q * v2
            store(scratch, _STEP * j, c * v0 - s * bent)
            store(scratch, _STEP * j + 16, s * v0 + c * bent)
        if cubic:
            v3 = splat(poly[3 * set_size + j])
            for d in range(1, degree + 1):
                v3 = v3 * r + splat(poly[3 * set_size + d * width + j])
            store(scratch, _STEP * j + 48, v3)


@jit(fast=True, borrows=True)
def _spread(grid, base, places, scratch, count, taps, steer, k):
    """Add `count` of 16 paths to `width` rows each of the grid that lies from float `base`."""
    for i in range(count):
        at = base + int(places[i]) * ROW
        ar, ai = load(steer, k), load(steer, k + 16)
        for tap in range(len(taps)):
            j = i + _STEP * tap
            c, s = splat(scratch[j]), splat(scratch[j + 16])
            store(grid, at, load(grid, at) + c * ar - s * ai)
            store(grid, at + 16, load(grid, at + 16) + c * ai + s * ar)
            at += ROW
        k += 32


@jit(inline=True)
def _centred(steer, work, i, k):
    """Of path i: its amplitude at every element about the middle of the chirp (real, imaginary),
    theta and q."""
    ar, ai, theta = load(steer, k), load(steer, k + 16), load(steer, k + 32)
    c, s, late = splat(work[16 + i]), splat(work[32 + i]), theta * splat(work[64 + i])
    pr, pi = c * ar - s * ai, c * ai + s * ar
    square = late * late
    cosine, sine = splat(_ONE) - square * splat(_HALF), late - late * square * splat(_SIXTH)
    return pr * cosine + pi * sine, pi * cosine - pr * sine, theta, splat(work[48 + i])


@jit(fast=True, borrows=True)
def _spread_wideband(grid, base, places, scratch, count, taps, steer, k, work, centre):
    """The same with every element's own delay: strengths of 1, j x and x^2 - c."""
    for i in range(count):
        at = base + int(places[i]) * ROW
        er, ei, theta, q = _centred(steer, work, i, k)
        minus = theta * theta * splat(-_HALF)
        gr, gi = minus * er - q * ei, minus * ei + q * er
        bow = minus * splat(centre)
        skew = q * splat(_SKEW)
        br, bi = theta * (er - skew * ei), theta * (ei + skew * er)
        er, ei = er + bow * er, ei + bow * ei
        for tap in range(len(taps)):
            j = i + _STEP * tap
            u, v, w = splat(scratch[j]), splat(scratch[j + 16]), splat(scratch[j + 32])
            store(grid, at, load(grid, at) + u * er + v * br + w * gr)
            store(grid, at + 16, load(grid, at + 16) + u * ei + v * bi + w * gi)
            at += ROW
        k += 48


@jit(fast=True, borrows=True)
def _spread_cubic(grid, base, places, scratch, count, taps, steer, k, work, centre):
    """The same to the third order: strengths of 1, j x, x^2 - c and j (x^3 - 3/5 x)."""
    for i in range(count):
        at = base + int(places[i]) * ROW
        er, ei, theta, q = _centred(steer, work, i, k)
        square = theta * theta
        minus = square * splat(-_HALF)
        gr, gi = minus * er - q * ei, minus * ei + q * er
        third = square * splat(-_SIXTH)
        tr, ti = theta * (third * er - q * ei), theta * (third * ei + q * er)
        bow, skew, less = (
            minus * splat(centre),
            q * splat(_SKEW),
            splat(_ONE) - square * splat(_TENTH),
        )
        br, bi = theta * (less * er - skew * ei), theta * (less * ei + skew * er)
        er, ei = er + bow * er, ei + bow * ei
        for tap in range(len(taps)):
            j = i + _STEP * tap
            u, v, w, x = (
                splat(scratch[j]),
                splat(scratch[j + 16]),
                splat(scratch[j + 32]),
                splat(scratch[j + 48]),
            )
            store(grid, at, (load(grid, at) + u * er + v * br) + (w * gr + x * tr))
            store(grid, at + 16, (load(grid, at + 16) + u * ei + v * bi) + (w * gi + x * ti))
            at += ROW
        k += 48


@jit(fast=True, borrows=True)
def _fold(grid, size, low, width):
    """Wrap the margins: row g + low is frequency g, taken modulo the size of the grid."""
    for i in range(0, low * ROW, 16):
        store(grid, size * ROW + i, load(grid, size * ROW + i) + load(grid, i))
    for i in range(low * ROW, width * ROW, 16):
        store(grid, i, load(grid, i) + load(grid, size * ROW + i))


@jit(fast=True, borrows=True)
def _divide(deconvolution, channels, grid, low, order, tile):
    """Divide the rows of the samples by the kernel's response and put them together channel by
    channel in the tile: in memory the channels lie where they would drive each other out of the
    cache."""
    num_samples, size = deconvolution.shape[0], order.shape[0]
    half, line = num_samples // 2, 2 * num_samples + ROW
    for start in range(0, num_samples, 16):
        for i in range(min(16, num_samples - start)):
            mode = start + i - half
            row = (low + order[mode if mode >= 0 else mode + size]) * ROW
            d = splat(deconvolution[start + i])
            store(tile, 16 * i, d * load(grid, row))
            store(tile, 256 + 16 * i, d * load(grid, row + 16))
        transpose(tile, 0)
        transpose(tile, 256)
        for r in range(channels):
            re, im = load(tile, 16 * r), load(tile, 256 + 16 * r)
            here = _TILE + r * line + 2 * start
            store(tile, here, zip_low(re, im))
            store(tile, here + 16, zip_high(re, im))


@jit(fast=True, borrows=True)
def _emit(out, at, stride, channels, num_samples, tile):
    """Write the tile: sample n of channel r to out[at + r stride + 2 n]."""
    line, blocks = 2 * num_samples + ROW, num_samples // 16 * 32
    whole = (out.ctypes.data + 4 * at) % 64 == 0 and stride % 16 == 0
    for r in range(channels):
        to, here = at + r * stride, _TILE + r * line
        for i in range(0, blocks, 16):
            if whole:
                stream(out, to + i, load(tile, here + i))
            else:
                store(out, to + i, load(tile, here + i))
        for i in range(blocks, 2 * num_samples):
            out[to + i] = tile[here + i]


@jit(fast=True, borrows=True)
def _in_band(work, places, count, limit):
    """Strike out the paths from the frequency `limit` on; the number up to the last one that
    stays."""
    last = 0
    for i in range(count):
        if places[16 + i] < limit:
            last = i + 1
        else:
            work[16 + i], work[32 + i], places[i] = np.float32(0), np.float32(0), 0.0
    return last


@jit(fast=True, borrows=True)
def _chirps(out, shape, first_channel, w, views, g, heard, t, band, noise, room):
    """Synthesise all chirps for up to 16 receive elements, in this order: spread, transform, divide
    and add paths one by one and noise, emit, one batch of chirps after the other."""
    grid, work, places, scratch, tile, words = room
    power, key0, key1 = noise
    b, steer, faint, alone = heard
    groups, num_rx, num_chirps, num_samples = shape
    size, width, cells = g.rows.shape[0], len(g.taps), band.turn.shape[0]
    low, centre, channels = width // 2 - 1, np.float32(g.centre), min(16, num_rx - first_channel)
    top, skirt, per_delay = w.rate / w.slope, w.transition / w.slope, w.slope * w.step
    cut = top + skirt
    stride = (size + _MARGIN) * ROW
    for batch in range(g.order.parts.shape[0]):
        start, count, segment = g.order.parts[batch]
        chirps = g.order.chirp[start : start + count]
        grid[:] = np.float32(0)
        for i in range(b.blocks.shape[0]):
            q, used = b.blocks[i, 0], b.blocks[i, 2]
            for c in range(count):
                m, p = chirps[c] // num_chirps, chirps[c] % num_chirps
                source = m - b.blocks[i, 1]
                if source < 0 or source >= groups or t.send[q, source, p] == 0:
                    continue
                view = _View(
                    views.shift[chirps[c]],
                    views.origin[chirps[c]],
                    views.share[chirps[c]],
                    views.below[chirps[c]],
                    views.limit[chirps[c]],
                    views.turn[chirps[c]],
                )
                time = w.first + view.origin * w.step + p * w.slot + m * w.spacing
                delay = t.symbol_delay[q, source, p]
                least, most = b.bounds[i, 0] + delay, b.bounds[i, 1] + delay
                if least > cut or most < -skirt:
                    continue
                low_end, high_end = least * per_delay - view.shift, most * per_delay - view.shift
                if low_end > view.limit + _DOPPLER and high_end < 1 - view.below - _DOPPLER:
                    continue
                sent = t.send[q, source, p] * view.turn
                antenna = t.antenna[q, source, p]
                _prepare(work, places, b, i, w, g, view, time, delay, sent, antenna)
                if b.blocks[i, 3] or least < 0 or most > top:
                    _gate(work, b, i, w, time, delay)
                last = _in_band(work, places, used, view.limit) if cells else used
                to, k = c * stride, i * 16 * 48
                _weigh(work, scratch, g.poly, g.taps, g.wideband, g.cubic)
                if g.cubic:
                    _spread_cubic(grid, to, places, scratch, last, g.taps, steer, k, work, centre)
                elif g.wideband:
                    _spread_wideband(
                        grid, to, places, scratch, last, g.taps, steer, k, work, centre
                    )
                else:
                    _spread(grid, to, places, scratch, last, g.taps, steer, i * 16 * 32)
        if faint.paths.groups.shape[0]:
            add_covered(grid, faint.paths, segment, chirps, t, w, faint.sheet, faint.desk)
        for c in range(count):
            m, p = chirps[c] // num_chirps, chirps[c] % num_chirps
            table = grid[c * stride : (c + 1) * stride]
            _fold(table, size, low, width)
            transform(table, low * ROW, size, g.radices, g.twiddles)
            line = m * num_rx + first_channel
            if cells == 0:
                to, step = 2 * num_samples * (line * num_chirps + p), 2 * num_samples * num_chirps
                _divide(g.deconvolution, channels, table, low, g.rows, tile)
                for r in range(channels):
                    here = _TILE + r * (2 * num_samples + ROW)
                    if sum_paths(alone, w, g.half, m, first_channel + r, p):
                        flush(tile, here, num_samples, alone.room.sums, False)
                    if power > 0:
                        chirp = tile[here : here + 2 * num_samples]
                        draw = ((line + r) * num_chirps + p) * num_samples
                        add_stream_by(chirp, power, key0, key1, np.uint64(draw), words)
                _emit(out, to, step, channels, num_samples, tile)
                continue
            draw = ((first_channel // 16 * groups + m) * num_chirps + p) * g.deconvolution.shape[0]
            to_cells(table, low, g.rows, g.deconvolution, band, draw * LANES, p % CHIRPS)
            if p % CHIRPS == CHIRPS - 1 or p == num_chirps - 1:
                to = 2 * (line * cells * num_chirps + p - p % CHIRPS)
                done, step = p % CHIRPS + 1, 2 * cells * num_chirps
                write_cells(out, to, step, channels, done, num_chirps, cells, band.stage, tile)


@jit(fast=True, borrows=True)
def _steer(out, planes, path, rx, first, frequency, slope, turn, delay):
    """`_steering` of the listed paths to the flat `out`; `delay`: room for 16 float64, zero from
    the last element on."""
    rx_delay, gain = rx
    count = min(LANES, rx_delay.shape[1] - first)
    for i in range(path.shape[0]):
        for r in range(count):
            delay[r] = rx_delay[path[i], first + r]
        late, at = load(delay, 0), i * planes * LANES
        cycles = late * (splat(frequency) - splat(slope / 2) * late)
        c, s = cos_sin_exact(cycles - floor(cycles + splat(0.5)))
        store(out, at, c)
        store(out, at + LANES, s)
        for r in range(count if gain.shape[0] else 0):
            own = gain[path[i], first + r] * complex(out[at + r], out[at + LANES + r])
            out[at + r], out[at + LANES + r] = own.real, own.imag
        if planes == 3:
            store(out, at + 2 * LANES, narrow(late * splat(turn)))


def _steering(
    waveform: Waveform,
    rx: tuple[np.ndarray, np.ndarray],
    path: np.ndarray,
    first: int,
    wideband: bool,
) -> np.ndarray:
    """Of each listed path the phasors of the up to 16 receive elements from `first` on at
    mid-window (real, imaginary) and, `wideband`, their turn over half a chirp [rad]: (32 or 48 n,)
    float32."""
    w, planes = waveform, 3 if wideband else 2
    out = unset(len(path) * planes * LANES)
    middle = w.carrier_frequency + w.slope * w.fast_time[w.num_samples // 2]
    turn = 2 * np.pi * w.slope * w.sample_interval * (w.num_samples // 2)
    _steer(out, planes, path, rx, first, middle, w.slope, turn, np.zeros(LANES))
    return out


def _blocks(waveform: Waveform, t: Tones, path: np.ndarray, offset: np.ndarray) -> _Blocks:
    """Of the listed paths and their offsets."""
    w = waveform
    order = np.lexsort((t.delay[path], offset, t.link[path]))
    path, offset = path[order], offset[order]
    kind = t.link[path] * (2 * w.num_groups) + offset
    segment = np.cumsum(np.r_[True, np.diff(kind) != 0]) - 1 if path.size else path
    _, starts, counts = np.unique(segment, return_index=True, return_counts=True)
    full = -(-counts // LANES)
    first = np.concatenate(
        [s + LANES * np.arange(f) for s, f in zip(starts, full, strict=True)] or [starts]
    )
    last = np.repeat(starts + counts, full) - 1
    index = np.minimum(first[:, None] + np.arange(LANES), last[:, None])
    k, lag = path[index], offset[index]
    delay = t.delay[k] - lag * w.group_spacing
    table = np.stack([delay, t.rate[k], t.accel[k], *np.moveaxis(t.tx_delay[k], 2, 0)], axis=1)
    life = np.stack([t.begin[k], t.end[k]], axis=1)
    reach = w.frame_duration / 2
    motion = np.abs(t.rate[k]) * reach + np.abs(t.accel[k]) * reach**2 / 2
    bounds = np.stack([(delay - motion).min(axis=1), (delay + motion).max(axis=1)], axis=1)
    mortal = ((t.begin[k] > -reach) | (t.end[k] < reach)).any(axis=1)
    used = np.minimum(last - first + 1, LANES)
    blocks = np.stack([t.link[k[:, 0]], lag[:, 0], used, mortal], axis=1)
    if t.tx_gain.size:
        by_antenna = t.factor[k][:, None] * np.moveaxis(t.tx_gain[k], 2, 1)
        factor = np.stack([by_antenna.real, by_antenna.imag], axis=2).astype(np.float32)
    else:
        factor = np.stack([t.factor[k].real, t.factor[k].imag], axis=1).astype(np.float32)
    return _Blocks(
        k.ravel(), table.ravel(), factor.ravel(), life.ravel(), blocks.astype(np.int64), bounds
    )


def make_gridded(
    samples: np.ndarray,
    waveform: Waveform,
    tones: Tones,
    setting: Setting = DEFAULT,
    *,
    faint: np.ndarray | None = None,
    alone: Tones | None = None,
    noise: WhiteNoise = SILENCE,
) -> None:
    """Samples of many weak paths; relative RMS error of `DEFAULT` below `GRIDDED_ERROR` (up to 30
    m/s and 15 elements of the L).

    Left out: the joint curvature `Tones.cross`; with `DEFAULT` the third order of the wideband
    term. A path lives in whole chirps. Runs in one thread without the interpreter's lock; the
    result depends on nothing but the arguments.

    Parameters
    ----------
    samples : (M, L_rx, P, N) complex64, contiguous, which is written
    faint : (K,) bool, paths that noise covers, of a setting that has a way for them
    alone : paths that are added one by one, as `isac_rt.signal.direct.add_direct` does
    noise : is added, as `isac_rt.signal.noise.add_white_noise` does
    """
    count = waveform.num_groups * waveform.num_chirps
    none, one = np.zeros(count), np.ones(count)
    views = _View(none, none, one, none, one, one.astype(complex))
    job = _Job(waveform, tones, setting, faint, alone, noise)
    if not _synthesise(samples, samples.shape, job, no_band(), views):
        add_direct(samples, waveform, job.one_by_one, fresh=True)
        noise.add_to(samples)


def range_cells(
    waveform: Waveform,
    tones: Tones,
    payload: Payload,
    num_cells: int,
    setting: Setting = PROFILES,
    noise: WhiteNoise | None = None,
) -> np.ndarray:
    """Range cells under Hann's window, made directly (`isac_rt.signal.profiles`): what a transform
    of the windowed samples gives.

    The window of a chirp with delay symbol D starts D / (alpha T) (the delay) after its first
    sample, and cell k is read at k + D, its phase counted from the start of the window.

    Parameters
    ----------
    payload : its delay symbols D and its phases beta^(D) are taken out
    num_cells : from cell 0, at most 3/4 of N: beyond the band a path's tail has no right phase
    noise : of the IF samples

    Returns
    -------
    cells : (M, L_rx, num_cells, P) complex64
    """
    w = waveform
    if 4 * num_cells > 3 * w.num_samples:
        raise ValueError(
            f"{num_cells} range cells of {w.num_samples} samples: at most three quarters can be "
            "made directly; take samples"
        )
    length = w.window_length
    delay_symbols, phases = payload.delay_symbols, payload.phases
    band = make_band(w.num_samples, num_cells, length, noise or SILENCE)
    start = np.ravel(w.data_shift(delay_symbols))
    size = len(band.window)
    pad = (size - num_cells) // 2 / w.num_samples
    limit = num_cells / w.num_samples + pad if size < w.num_samples else 1.0
    middle = start + length / 2 - w.num_samples // 2
    one = np.ones(start.size)
    shape = (w.num_groups, tones.rx_delay.shape[1], w.num_chirps, w.num_samples)
    out = new_memory((*shape[:2], num_cells, w.num_chirps))
    cycles = delay_symbols.ravel() * (start + length / 2) / w.num_samples + np.ravel(
        w.data_phase(delay_symbols)
    )
    views = _View(
        shift=delay_symbols.ravel() / w.num_samples,
        origin=middle,
        share=w.num_samples / size * one,
        below=pad * one,
        limit=limit * one,
        turn=np.ravel(phases).conj() * np.exp(-2j * np.pi * (cycles % 1.0)),
    )
    _synthesise(out, shape, _Job(w, tones, setting), band, views)
    return out


class _Job(NamedTuple):
    """What is synthesised and how; `faint`, `alone` and `noise` as of `make_gridded`."""

    waveform: Waveform
    tones: Tones
    setting: Setting
    faint: np.ndarray | None = None
    alone: Tones | None = None
    noise: WhiteNoise = SILENCE

    @property
    def one_by_one(self) -> Tones:
        """What is added past the grid."""
        return self.tones.select(np.zeros(0, int)) if self.alone is None else self.alone


def _synthesise(
    out: np.ndarray,
    shape: tuple[int, ...],
    job: _Job,
    band: Band,
    views: _View,
) -> bool:
    """Run the kernel over all elements; False, and nothing done, where no path can be heard and
    there is no band."""
    w, t, setting, faint, _, noise = job
    path, offset = sources(w, t)
    apart = np.zeros(path.size, bool)
    if faint is not None and setting.faint:
        reach = w.frame_duration / 2
        apart = (faint & (t.begin <= -reach) & (t.end >= reach))[path]
    if path.size == 0 and band.turn.size == 0:
        return False
    num_samples = len(band.window) or w.num_samples
    taps = TAPS if setting.faint else 0
    kernel = weights(num_samples, setting.oversampling, setting.width, taps)
    b = _blocks(w, t, path[~apart], offset[~apart])
    weak, order = (path[apart], offset[apart]), plain_batches(views.share.size, 1)
    if b.path.size > _MANY:
        order = plain_batches(views.share.size, _TOGETHER)
    if apart.any():
        slots = part_slots(w, t.rate[weak[0]], kernel.grid)
        order = batches(t.antenna[0], slots)
    g = _Grid(
        float(w.num_samples // 2),
        mean_square(num_samples),
        (0,) * setting.width,
        setting.wideband,
        setting.wideband and setting.cubic,
        kernel.polynomials.ravel(),
        kernel.deconvolution,
        *plan(kernel.grid),
        order,
    )
    stride = (kernel.grid + _MARGIN) * ROW
    sheet = Sheet(
        kernel.grid,
        line_turn(kernel.grid, g.half) ** 2 * g.centre / 2,
        stride,
        (setting.width - taps) // 2 * ROW,
        kernel.faint.ravel(),
    )
    grids = unset(int(order.parts[:, 1].max()) * stride)
    tile = aligned(_TILE + LANES * (2 * num_samples + ROW))
    scratch = aligned(_STEP * setting.width)
    room = _Room(grids, aligned(80), np.zeros(32), scratch, tile, words_room())
    alone = one_by_one(w, job.one_by_one)
    flat, rx, shared = out.reshape(-1).view(np.float32), (t.rx_delay, t.rx_gain), numbers(w)
    for first in range(0, shape[1], LANES):
        steer = _steering(w, rx, b.path, first, setting.wideband)
        paths = no_paths(t.tx_delay.shape[1])
        if apart.any():
            steering = partial(_turned_steering, w, rx, first, kernel.grid)
            paths = covered_paths(w, t, weak, slots, kernel.grid, g.centre, steering)
        weakest = _Faint(paths, sheet, desk(paths))
        heard = _Heard(b, steer, weakest, alone)
        _chirps(flat, shape, first, shared, views, g, heard, t, band, noise.numbers, room)
    return True


def _turned_steering(
    waveform: Waveform,
    rx: tuple[np.ndarray, np.ndarray],
    first: int,
    size: int,
    path: np.ndarray,
    late: np.ndarray,
) -> np.ndarray:
    """`_steering`, wideband, for `Covered`: with what the paths' own delays, in half chirps, do to
    the frequency that the elements see."""
    out = _steering(waveform, rx, path, first, True)
    turn_elements(out, late, line_turn(size, waveform.num_samples // 2))
    return out
