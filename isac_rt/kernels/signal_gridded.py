r"""IF samples of many paths through an oversampled grid of fast-time frequency (a non-uniform FFT
per chirp).

In a chirp a path is a tone of known start phase and frequency (float64). It is spread with a few
weights on a grid of frequencies, for all receive elements at once; one FFT and a division by the
transform of the weights give the samples. Two further sets of weights on the same grid points carry
x and x^2 (x: time from mid-chirp), for the quadratic phase of motion and the wideband delay of each
receive element, without a second transform:

.. math::

    z\,e^{-j\theta_l\lambda}\,e^{jq(x^2-c)}\,e^{j\theta_l x} \approx z\,e^{-j\theta_l\lambda}\,(1 +
    j\theta_l (1 + jq\kappa) x + (jq - \theta_l^2/2)(x^2-c) - c\theta_l^2/2)

with theta_l the phase of element l over half a chirp, lambda = tau/(T/2) (the array receives the
frequency sent tau earlier), c the mean of x^2, and kappa = 4/15, the least-squares fit of kappa x
to x (x^2 - c).
"""

from __future__ import annotations

from functools import lru_cache, partial
from typing import Any, NamedTuple

import numpy as np
import scipy.fft

from isac_rt.kernels.fourier import ROW, plan, transform
from isac_rt.kernels.jit import jit
from isac_rt.kernels.signal_below_noise import (
    EXTRA,
    TAPS,
    Batches,
    BelowNoisePaths,
    Buffer,
    Workspace,
    add_below_noise,
    batches,
    below_noise_paths,
    line_phase,
    make_workspace,
    no_paths,
    part_slots,
    plain_batches,
    shift_elements,
)
from isac_rt.kernels.signal_direct import OneByOne, flush, numbers, one_by_one, passed, sum_paths
from isac_rt.kernels.signal_noise import add_stream_by, words_buffer
from isac_rt.kernels.vector import (
    LANES,
    aligned,
    cos_sin,
    cos_sin_exact,
    floor,
    load,
    narrow,
    splat,
    store,
    stream,
    transpose,
    unset,
    zip_high,
    zip_low,
)
from isac_rt.storage import cached

OVERSAMPLING, WIDTH = 1.5, 12
"""Grid points per sample, at least, and per path. What noise covers is spread on `TAPS` of them."""
GRIDDED_ERROR = 1e-4
"""Bound of the relative RMS error of the samples against the exact model, up to 30 m/s and the 15
elements of the L (measured: tests/signal/test_gridding.py)."""
# paths that no longer stay in the second-level cache beside the grid; they are read once for
# several chirps
_MANY = 4000
_CHIRPS_PER_BATCH = 6
_MARGIN = LANES  # rows beyond the grid
_TILE = 2 * LANES * LANES  # floats of 16 complex samples of 16 channels
_STEP = 3 * LANES  # floats between the weights of a grid point and those of the next
_FIELDS = 3  # float64 of a path before its transmit elements' delays
_ONE, _HALF, _SIXTH = np.float32(1), np.float32(0.5), np.float32(1 / 6)
_SKEW = np.float32(4 / 15)  # x (x^2 - 1/3) is nearest to 4/15 x
_BELOW = 1 - 1e-14  # keeps a frequency that is rounded up to a whole turn on the grid


class Kernel(NamedTuple):
    """Window that spreads tones on a grid, and the division by its response.

    Attributes
    ----------
    grid : G, number of grid frequencies
    polynomials : (3, degree + 1, width) float32, highest power first
    faint : (3, degree + 1, faint width) float32, of paths that noise covers
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
    return Kernel(*cached("grid weights", of, lambda: list(_weights(*of))))


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
    """(R, width, 3) weights of the three sets at each place."""
    half = num_samples // 2
    scaled = np.arange(-half, half + 1) / half
    goals = np.stack(
        [
            np.ones_like(scaled, complex),
            1j * scaled,
            scaled**2 - mean_square(num_samples) + 0j,
        ],
        axis=1,
    )
    return np.array([_real_least_squares(deconvolution[:, None] * b, goals) for b in basis])


def _polynomials(nodes: np.ndarray, fits: np.ndarray) -> np.ndarray:
    """(3, degree + 1, width) float32."""
    degree = nodes.size // 2
    sets = [np.polyfit(nodes, fits[:, :, k], degree) for k in range(3)]
    return np.array(sets).astype(np.float32)


def mean_square(num_samples: int) -> float:
    """Mean of x^2 over the samples, x scaled to [-1, 1]."""
    half = num_samples // 2
    return float(((np.arange(num_samples) - half) ** 2).mean()) / half**2


def _real_least_squares(matrix: np.ndarray, goals: np.ndarray) -> np.ndarray:
    """Real solution of a complex least-squares problem."""
    both = np.concatenate([matrix.real, matrix.imag]), np.concatenate([goals.real, goals.imag])
    return np.linalg.lstsq(*both, rcond=None)[0]


class _Grid(NamedTuple):
    """Layout of gridded chirps: half their samples, mean of x^2, one 0 per grid point of a path,
    `weights`, the `plan` of the transform, and the order in which chirps are made."""

    half: float
    centre: float
    taps: tuple[int, ...]
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

    paths: BelowNoisePaths
    buffer: Buffer
    workspace: Workspace


class _Contributions(NamedTuple):
    """Received paths: blocks of them, their `_steering`, the below-noise paths, and what is added
    past the grid."""

    blocks: _Blocks
    steer: np.ndarray
    faint: _Faint
    alone: OneByOne


class _Workspace(NamedTuple):
    """Memory of the kernel: the grids, numbers of 16 paths, their places and frequencies, their
    weights, what is emitted, and random words of its noise."""

    grid: np.ndarray
    work: np.ndarray
    cells: np.ndarray
    scratch: np.ndarray
    tile: np.ndarray
    words: np.ndarray


@jit(fast=True, borrows=True)
def _prepare(work, cells, b, block, w, g, time, symbol, send, antenna):
    """Prepare 16 paths: place on the grid to `cells`; distance from the middle of the cell,
    complex factor (less the filter's gain), quadratic term [rad] and lambda, 16 floats of each, to
    `work`."""
    f_c, slope, ts, u = w.carrier, w.slope, w.step, w.middle
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
    # delay of the centroid and of the transmit element, at mid-chirp
    tau = delay + splat(symbol) + (rate + accel * splat(time / 2)) * splat(time)
    element = tau + extra
    step, a = (rate + accel * splat(time)) * splat(ts), accel * splat(ts * ts / 2)
    carrier = splat(f_c + slope * u)
    sent = carrier - splat(slope) * element
    cycles = element * (carrier - splat(slope / 2) * element)
    frequency = sent * step + splat(slope * ts) * element
    # grid cell of the frequency [cycles/sample], and the distance from its middle
    position = (frequency - floor(frequency)) * splat(size * _BELOW)
    cell = floor(position)
    store(cells, 0, cell)
    store(work, 0, narrow(position - cell) - splat(_HALF))
    curvature = narrow(
        (sent * a + splat(slope) * step * (splat(ts) - splat(0.5) * step)) * splat(half * half)
    )
    # factor times exp(j 2 pi phase), with q c of the quadratic term's mean; then q and lambda
    c, s = cos_sin(
        narrow(cycles - floor(cycles + splat(0.5))) + curvature * splat(np.float32(g.centre))
    )
    br, bi = load(b.factor, f), load(b.factor, f + 16)
    sr, si = splat(np.float32(send.real)), splat(np.float32(send.imag))
    ar, ai = br * sr - bi * si, br * si + bi * sr
    store(work, 16, ar * c - ai * s)
    store(work, 32, ar * s + ai * c)
    store(work, 48, curvature * splat(np.float32(2 * np.pi)))
    store(work, 64, narrow(tau * splat(1 / (ts * half))))


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
def _weigh(work, scratch, poly, taps):
    """The three sets of weights of the grid points of 16 paths."""
    r, width, degree = load(work, 0), len(taps), len(taps) + EXTRA
    set_size = (degree + 1) * width
    for j in range(width):
        v0, v1, v2 = splat(poly[j]), splat(poly[set_size + j]), splat(poly[2 * set_size + j])
        for d in range(1, degree + 1):
            v0 = v0 * r + splat(poly[d * width + j])
            v1 = v1 * r + splat(poly[set_size + d * width + j])
            v2 = v2 * r + splat(poly[2 * set_size + d * width + j])
        store(scratch, _STEP * j, v0)
        store(scratch, _STEP * j + 16, v1)
        store(scratch, _STEP * j + 32, v2)


@jit(inline=True)
def _centred(steer, work, i, k):
    """Return path i's amplitude at every element about the middle of the chirp (real, imaginary),
    theta and q."""
    ar, ai, theta = load(steer, k), load(steer, k + 16), load(steer, k + 32)
    c, s, late = splat(work[16 + i]), splat(work[32 + i]), theta * splat(work[64 + i])
    pr, pi = c * ar - s * ai, c * ai + s * ar
    square = late * late
    cosine, sine = splat(_ONE) - square * splat(_HALF), late - late * square * splat(_SIXTH)
    return pr * cosine + pi * sine, pi * cosine - pr * sine, theta, splat(work[48 + i])


@jit(fast=True, borrows=True)
def _spread(grid, base, cells, scratch, count, taps, steer, k, work, centre):
    """Add `count` of 16 paths to `width` rows each of the grid that lies from float `base`, with
    every element's own delay: strengths of 1, j x and x^2 - c."""
    for i in range(count):
        # strengths of 1, j x and x^2 - c by the module's equation
        at = base + int(cells[i]) * ROW
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
def _chirps(out, shape, first_channel, w, g, contributions, t, noise, workspace):
    """Synthesise all chirps for up to 16 receive elements, in this order: spread, transform, divide
    and add paths one by one and noise, emit, one batch of chirps after the other."""
    grid, work, cells, scratch, tile, words = workspace
    power, key0, key1 = noise
    b, steer, faint, alone = contributions
    groups, num_rx, num_chirps, num_samples = shape
    size, width = g.rows.shape[0], len(g.taps)
    low, centre, channels = width // 2 - 1, np.float32(g.centre), min(16, num_rx - first_channel)
    top, sidelobe = w.rate / w.slope, w.transition / w.slope
    cut = top + sidelobe
    stride = (size + _MARGIN) * ROW
    for batch in range(g.order.parts.shape[0]):
        start, count, segment = g.order.parts[batch]
        chirps = g.order.chirp[start : start + count]
        # spread: blocks of paths that are sent in a chirp and pass the filter
        grid[:] = np.float32(0)
        for i in range(b.blocks.shape[0]):
            q, used = b.blocks[i, 0], b.blocks[i, 2]
            for c in range(count):
                m, p = chirps[c] // num_chirps, chirps[c] % num_chirps
                source = m - b.blocks[i, 1]
                if source < 0 or source >= groups or t.send[q, source, p] == 0:
                    continue
                time = w.first + p * w.slot + m * w.spacing
                delay = t.symbol_delay[q, source, p]
                least, most = b.bounds[i, 0] + delay, b.bounds[i, 1] + delay
                if least > cut or most < -sidelobe:
                    continue
                send, antenna = t.send[q, source, p], t.antenna[q, source, p]
                _prepare(work, cells, b, i, w, g, time, delay, send, antenna)
                if b.blocks[i, 3] or least < 0 or most > top:
                    _gate(work, b, i, w, time, delay)
                to, k = c * stride, i * 16 * 48
                _weigh(work, scratch, g.poly, g.taps)
                _spread(grid, to, cells, scratch, used, g.taps, steer, k, work, centre)
        if faint.paths.groups.shape[0]:
            add_below_noise(grid, faint.paths, segment, chirps, t, w, faint.buffer, faint.workspace)
        # transform and divide; paths one by one, noise; write
        for c in range(count):
            m, p = chirps[c] // num_chirps, chirps[c] % num_chirps
            table = grid[c * stride : (c + 1) * stride]
            _fold(table, size, low, width)
            transform(table, low * ROW, size, g.radices, g.twiddles)
            line = m * num_rx + first_channel
            to, step = 2 * num_samples * (line * num_chirps + p), 2 * num_samples * num_chirps
            _divide(g.deconvolution, channels, table, low, g.rows, tile)
            for r in range(channels):
                here = _TILE + r * (2 * num_samples + ROW)
                if sum_paths(alone, w, g.half, m, first_channel + r, p):
                    flush(tile, here, num_samples, alone.workspace.sums, False)
                if power > 0:
                    chirp = tile[here : here + 2 * num_samples]
                    draw = ((line + r) * num_chirps + p) * num_samples
                    add_stream_by(chirp, power, key0, key1, np.uint64(draw), words)
            _emit(out, to, step, channels, num_samples, tile)


@jit(fast=True, borrows=True)
def _steer(out, path, rx, first, frequency, slope, half_chirp_phase, delay):
    """`_steering` of the listed paths to the flat `out`; `delay`: room for 16 float64, zero from
    the last element on."""
    rx_delay, gain = rx
    count = min(LANES, rx_delay.shape[1] - first)
    for i in range(path.shape[0]):
        for r in range(count):
            delay[r] = rx_delay[path[i], first + r]
        late, at = load(delay, 0), i * 3 * LANES
        cycles = late * (splat(frequency) - splat(slope / 2) * late)
        c, s = cos_sin_exact(cycles - floor(cycles + splat(0.5)))
        store(out, at, c)
        store(out, at + LANES, s)
        for r in range(count if gain.shape[0] else 0):
            own = gain[path[i], first + r] * complex(out[at + r], out[at + LANES + r])
            out[at + r], out[at + LANES + r] = own.real, own.imag
        store(out, at + 2 * LANES, narrow(late * splat(half_chirp_phase)))


def _steering(
    waveform: Any, rx: tuple[np.ndarray, np.ndarray], path: np.ndarray, first: int
) -> np.ndarray:
    """(48 n,) float32, of each listed path the phasors of the up to 16 receive elements from
    `first` on at mid-window (real, imaginary) and their turn over half a chirp [rad]."""
    w, out = waveform, unset(len(path) * 3 * LANES)
    middle = w.carrier_frequency + w.slope * w.fast_time[w.num_samples // 2]
    half_chirp_phase = 2 * np.pi * w.slope * w.sample_interval * (w.num_samples // 2)
    _steer(out, path, rx, first, middle, w.slope, half_chirp_phase, np.zeros(LANES))
    return out


def _blocks(waveform: Any, t: Any, path: np.ndarray, offset: np.ndarray) -> _Blocks:
    """Group the listed paths into blocks and return their offsets."""
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
    waveform: Any,
    tones: Any,
    faint: np.ndarray,
    alone: Any,
    noise: tuple[Any, Any, Any] = (np.float32(0), np.uint32(0), np.uint32(0)),
) -> None:
    """Make the samples of many weak paths; relative RMS error below `GRIDDED_ERROR`.

    Left out: the joint curvature `Tones.cross`, and the third order of the wideband term. A path
    lives in whole chirps. Runs in one thread without the interpreter's lock; the result depends on
    nothing but the arguments.

    Parameters
    ----------
    samples : (M, L_rx, P, N) complex64, contiguous, which is written
    tones : at least one of them received
    faint : (K,) bool, paths that noise covers; those that live for a part of the frame are made as
        the others
    alone : `Tones` that are added one by one
    noise : power, and the two words of its key (`isac_rt.signal.noise`)
    """
    w, t, shape = waveform, tones, samples.shape
    # received paths, those below noise apart, in blocks
    path, offset = t.sources(w)
    reach = w.frame_duration / 2
    faint_path = (faint & (t.begin <= -reach) & (t.end >= reach))[path]
    kernel = weights(w.num_samples, OVERSAMPLING, WIDTH, TAPS)
    b = _blocks(w, t, path[~faint_path], offset[~faint_path])
    # order of the chirps: many at once where the paths do not stay in the cache
    count = w.num_groups * w.num_chirps
    weak, order = (path[faint_path], offset[faint_path]), plain_batches(count, 1)
    if b.path.size > _MANY:
        order = plain_batches(count, _CHIRPS_PER_BATCH)
    if faint_path.any():
        slots = part_slots(w, t.rate[weak[0]], kernel.grid)
        order = batches(t.antenna[0], slots)
    g = _Grid(
        float(w.num_samples // 2),
        mean_square(w.num_samples),
        (0,) * WIDTH,
        kernel.polynomials.ravel(),
        kernel.deconvolution,
        *plan(kernel.grid),
        order,
    )
    stride = (kernel.grid + _MARGIN) * ROW
    buffer = Buffer(
        kernel.grid,
        line_phase(kernel.grid, g.half) ** 2 * g.centre / 2,
        stride,
        (WIDTH - TAPS) // 2 * ROW,
        kernel.faint.ravel(),
    )
    grids = unset(int(order.parts[:, 1].max()) * stride)
    tile = aligned(_TILE + LANES * (2 * w.num_samples + ROW))
    workspace = _Workspace(
        grids, aligned(80), np.zeros(16), aligned(_STEP * WIDTH), tile, words_buffer()
    )
    flat, rx, shared = samples.reshape(-1).view(np.float32), (t.rx_delay, t.rx_gain), numbers(w)
    one_after_the_other = one_by_one(w, alone)
    # sixteen receive elements at a time
    for first in range(0, shape[1], LANES):
        steer = _steering(w, rx, b.path, first)
        paths = no_paths(t.tx_delay.shape[1])
        if faint_path.any():
            steering = partial(_shifted_steering, w, rx, first, kernel.grid)
            paths = below_noise_paths(w, t, weak, slots, kernel.grid, g.centre, steering)
        contributions = _Contributions(
            b, steer, _Faint(paths, buffer, make_workspace(paths)), one_after_the_other
        )
        _chirps(flat, shape, first, shared, g, contributions, t, noise, workspace)


def _shifted_steering(
    waveform: Any,
    rx: tuple[np.ndarray, np.ndarray],
    first: int,
    size: int,
    path: np.ndarray,
    late: np.ndarray,
) -> np.ndarray:
    """`_steering` for `BelowNoisePaths`: with what the paths' own delays, in half chirps, do to the
    frequency that the elements see."""
    out = _steering(waveform, rx, path, first)
    shift_elements(out, late, line_phase(size, waveform.num_samples // 2))
    return out
