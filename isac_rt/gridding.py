r"""IF samples of many paths through an oversampled grid of fast-time frequency (a non-uniform FFT per chirp).

In each chirp every path is a tone of known start phase and frequency (float64). It is spread with WIDTH weights on a grid of
1.5 N frequencies, all receive elements at once; one FFT and one division make the samples. Three sets of weights on the same
grid points carry 1, x and x^2 (x: time from the middle of the chirp), so that the wideband delay of each receive
element (to second order) and the quadratic phase of motion (to first) need no second transform.
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np
import scipy.fft
from llvmlite import ir
from numba import njit, types
from numba.extending import intrinsic
from numba.np.arrayobj import make_array

from isac_rt.synthesis import FAST, Tones, chirp_terms, numbers, passed, sources
from isac_rt.waveform import Waveform

GRIDDED_ERROR = 1e-4
"""Bound of the relative RMS error against the exact model (measured: see tests/test_ifsignal.py)."""
_OVERSAMPLING = 1.5
_WIDTH = 6  # grid points per path
_DEGREE = 8  # of the polynomials that give the weights between grid points
_LANES = 24  # 3 weight sets of _WIDTH, padded to whole vectors
_BATCH = 8  # chirps per FFT call: the grids stay in the second-level cache


@lru_cache(maxsize=8)
def weights(num_samples: int) -> tuple[int, np.ndarray, np.ndarray]:
    r"""Grid size, weight polynomials and deconvolution for chirps of N samples.

    A tone r grid steps from the middle of its cell has, on the grid points j - (WIDTH - 1)/2, weights such that
    D(x) sum_j w_j exp(j 2 pi x (j - (WIDTH-1)/2 - r)/G) = 1, j x, x^2 for the three sets, x = -N/2 .. N/2 scaled to [-1, 1].
    Least squares in turn for w and for D, from a Kaiser-Bessel start; the weights are real by symmetry.

    Returns
    -------
    grid : G, number of grid frequencies
    polynomials : (DEGREE + 1, LANES) float32, highest power first
    deconvolution : (N,) float64, D at x = n - N//2
    """
    half = num_samples // 2
    grid = scipy.fft.next_fast_len(max(int(np.ceil(_OVERSAMPLING * num_samples)), 4 * _WIDTH))
    x = np.arange(-half, half + 1)
    nodes = np.cos(np.pi * (np.arange(2 * _DEGREE) + 0.5) / (2 * _DEGREE)) / 2
    steps = np.arange(_WIDTH) - (_WIDTH - 1) / 2
    basis = np.exp(2j * np.pi / grid * x[None, :, None] * (steps[None, None, :] - nodes[:, None, None]))
    scaled = x / half
    goals = np.stack([np.ones_like(scaled, complex), 1j * scaled, scaled**2 + 0j], axis=1)
    bell = np.i0(2.05 * _WIDTH * np.sqrt(np.clip(1 - ((steps - nodes[:, None]) * 2 / _WIDTH) ** 2, 0, None)))
    for _ in range(6):
        response = np.einsum("rxj,rj->rx", basis, bell)
        deconvolution = (response.real.sum(0)) / (np.abs(response) ** 2).sum(0)
        fits = [_real_least_squares(deconvolution[:, None] * b, goals) for b in basis]
        bell = np.array([f[:, 0] for f in fits])
    table = np.array(fits).transpose(0, 2, 1).reshape(nodes.size, 3 * _WIDTH)
    polynomials = np.zeros((_DEGREE + 1, _LANES), np.float32)
    polynomials[:, : 3 * _WIDTH] = np.polyfit(nodes, table, _DEGREE)
    return grid, polynomials, deconvolution[:num_samples]


def _real_least_squares(matrix: np.ndarray, goals: np.ndarray) -> np.ndarray:
    """Real solution of a complex least-squares problem."""
    both = np.concatenate([matrix.real, matrix.imag]), np.concatenate([goals.real, goals.imag])
    return np.linalg.lstsq(*both, rcond=None)[0]


@njit(nogil=True, fastmath=FAST, error_model="numpy")
def _horner(kernel, poly, r):
    """All weights at `r`; the powers are the inner loop, of constant length, so that the outer one becomes vector code."""
    for j in range(_LANES):
        value = poly[0, j]
        for d in range(1, _DEGREE + 1):
            value = value * r + poly[d, j]
        kernel[j] = value


@intrinsic
def _add_vector(typingctx, grid, index, strengths, start, lanes, w, u, v):
    """grid[index : index + 16] += w a + u b + v c; a, b, c: 16 of strengths from start, start + lanes, start + 2 lanes.

    LLVM does not turn the plain loop into vector code (it cannot know that the arrays do not overlap), so this says it.
    """

    def codegen(context, builder, signature, args):
        vector = ir.VectorType(ir.FloatType(), 16)

        def at(array, kind, position):
            data = make_array(kind)(context, builder, array).data
            return builder.bitcast(builder.gep(data, [position]), vector.as_pointer())

        def every(scalar):
            first = builder.insert_element(ir.Constant(vector, ir.Undefined), scalar, ir.Constant(ir.IntType(32), 0))
            zeros = ir.Constant(ir.VectorType(ir.IntType(32), 16), [0] * 16)
            return builder.shuffle_vector(first, ir.Constant(vector, ir.Undefined), zeros)

        target = at(args[0], signature.args[0], args[1])
        total, position = builder.load(target, align=4), args[3]
        for scalar in args[5:]:
            strength = builder.load(at(args[2], signature.args[2], position), align=4)
            product = builder.fmul(every(scalar), strength, flags=("contract",))
            total = builder.fadd(total, product, flags=("contract",))
            position = builder.add(position, args[4])
        builder.store(total, target, align=4)
        return context.get_dummy_value()

    return types.void(grid, types.intp, strengths, types.intp, types.intp, types.float32, types.float32, types.float32), codegen


@njit(nogil=True, fastmath=FAST, error_model="numpy")
def _spread(grid, start, kernel, strengths):
    """Add the three strengths (3 lanes,) of a path, all receive elements at once, to WIDTH rows of the flat grid from `start`."""
    lanes = strengths.shape[0] // 3
    for j in range(_WIDTH):
        for lane in range(0, lanes, 16):
            _add_vector(
                grid, start + j * lanes + lane, strengths, lane, lanes, kernel[j], kernel[_WIDTH + j], kernel[2 * _WIDTH + j]
            )


@njit(nogil=True, fastmath=FAST, error_model="numpy")
def _strengths(out, steer, lanes, cr, ci, lag, curve):
    """Strengths (3 lanes,) of 1, x, x^2: the steering (its phasors z, j z, the slants d) times the chirp's factor cr + j ci.

    Real and imaginary parts alternate; with z and j z both at hand no lane needs its neighbour.
    """
    phasor, ahead, slant = steer[:lanes], steer[lanes : 2 * lanes], steer[2 * lanes :]
    level, slope, bow = out[:lanes], out[lanes : 2 * lanes], out[2 * lanes :]
    for i in range(lanes):
        z, jz, d = phasor[i], ahead[i], slant[i]
        plain, turned = cr * z + ci * jz, cr * jz - ci * z
        late = lag * d  # the array sees the frequency that was sent, tau before
        value, quadrature = plain - late * turned, turned + late * plain
        level[i] = value
        slope[i] = d * value
        bow[i] = np.float32(-0.5) * d * d * value + curve * quadrature


@njit(cache=True, nogil=True, fastmath=FAST, error_model="numpy")
def _fill(grids, w, m, first, half, poly, path, offset, steer, link, factor, delay, rate, accel, begin, end, tx, symbol,
          send, antenna):  # fmt: skip
    """Spread every path of chirps first, first + 1, ... of group m on their grids (B, G + WIDTH, 2 lanes) float32."""
    groups, lanes = send.shape[1], grids.shape[2]
    size = grids.shape[1] - _WIDTH
    kernel = np.empty(_LANES, np.float32)
    strengths = np.zeros(3 * lanes, np.float32)
    grids[:] = np.float32(0)
    for i in range(path.shape[0]):  # chirps inside: a path's steering is read once, and its places on the grids are near
        k, source = path[i], m - offset[i]
        if source < 0 or source >= groups:
            continue
        for b in range(grids.shape[0]):
            p = first + b
            time = w[6] + p * w[4] + m * w[5]
            if time < begin[k] or time >= end[k]:
                continue
            q = link[k]
            tau = symbol[q, source, p] + delay[k] + (rate[k] + accel[k] * time / 2) * time - offset[i] * w[5]
            gain = passed(w, tau)
            if gain == 0.0:
                continue
            speed = rate[k] + accel[k] * time
            element = tau + tx[k, antenna[q, source, p]]
            phase, frequency, quadratic = chirp_terms(w, element, speed, accel[k])
            c = gain * factor[k] * send[q, source, p]
            angle = np.float32(2 * np.pi * (phase - 0.5))  # within half a turn, where float32 is finest
            co, si = -np.cos(angle), -np.sin(angle)
            cr, ci = np.float32(c.real) * co - np.float32(c.imag) * si, np.float32(c.real) * si + np.float32(c.imag) * co
            curve = np.float32(2 * np.pi * quadratic * half * half)
            lag = np.float32(tau / (w[2] * half))
            _strengths(strengths, steer[i], lanes, cr, ci, lag, curve)
            place = (frequency - np.floor(frequency)) * size
            cell = min(int(place), size - 1)
            r = np.float32(place - cell - 0.5)
            _horner(kernel, poly, r)
            _spread(grids[b].reshape(-1), cell * lanes, kernel, strengths)
    for b in range(grids.shape[0]):
        _fold(grids[b], size)


@njit(nogil=True)
def _fold(grid, size):
    """Wrap the margins: row g + WIDTH/2 - 1 is frequency g, taken modulo the size of the grid."""
    low = _WIDTH // 2 - 1
    for row in range(low):
        for lane in range(grid.shape[1]):
            grid[row + size, lane] += grid[row, lane]
    for row in range(low, _WIDTH - 1):
        for lane in range(grid.shape[1]):
            grid[row, lane] += grid[row + size, lane]


@njit(cache=True, nogil=True, fastmath=FAST)
def _emit(out, spectra, deconvolution, m, first):
    """Add the transformed grids (B, G, lanes) complex64, divided by the kernel's response, to out (M, L_rx, P, N)."""
    num_rx, size, grid, half = out.shape[1], out.shape[3], spectra.shape[1], out.shape[3] // 2
    block = 32
    for b in range(spectra.shape[0]):
        for start in range(0, size, block):
            for r in range(num_rx):
                for n in range(start, min(start + block, size)):
                    mode = n - half
                    out[m, r, first + b, n] += deconvolution[n] * spectra[b, mode if mode >= 0 else mode + grid, r]


def _steering(waveform: Waveform, tones: Tones, path: np.ndarray, lanes: int) -> np.ndarray:
    """Per source the phasors z of the receive elements at mid-window, j z, and twice each slant pi alpha e T [rad].

    Returns (C, 6 lanes) float32, real and imaginary parts alternating.
    """
    w, num_rx = waveform, tones.rx_delay.shape[1]
    delay = tones.rx_delay
    cycles = (w.carrier_frequency + w.slope * w.fast_time[w.num_samples // 2]) * delay - w.slope * delay**2 / 2
    out = np.zeros((len(tones), 3, lanes), np.complex64)
    out[:, 0, :num_rx] = np.exp(2j * np.pi * (cycles % 1))
    out[:, 1] = 1j * out[:, 0]
    slant = 2 * np.pi * w.slope * w.sample_interval * (w.num_samples // 2) * delay
    out[:, 2, :num_rx] = slant * (1 + 1j)
    return out.reshape(len(tones), -1).view(np.float32)[path]


def add_gridded(samples: np.ndarray, waveform: Waveform, tones: Tones, transition: float) -> None:
    """Add many weak paths; relative RMS error against `exact` below `GRIDDED_ERROR` (up to 30 m/s and 15 elements of the L).

    Left out: the joint curvature `Tones.cross`; the third order of the wideband term. A path lives in whole chirps. Runs
    in one thread; kernels and transforms release the interpreter's lock; the result depends on nothing but the arguments.

    Parameters
    ----------
    samples : (M, L_rx, P, N) complex64, contiguous, added to
    """
    w, t = waveform, tones
    path, offset = sources(w, t, transition)
    if path.size == 0:
        return
    order = np.lexsort((path, t.delay[path], offset))  # neighbours on the grid follow each other
    path, offset = path[order], offset[order]
    size, poly, deconvolution = weights(w.num_samples)
    lanes = -(-t.rx_delay.shape[1] // 8) * 8
    steer = _steering(w, t, path, lanes)
    values = numbers(w, transition)
    buffer = np.empty((_BATCH, size + _WIDTH, 2 * lanes), np.float32)
    low = _WIDTH // 2 - 1
    for m in range(w.num_groups):
        for first in range(0, w.num_chirps, _BATCH):
            grids = buffer[: min(_BATCH, w.num_chirps - first)]
            _fill(grids, values, m, first, w.num_samples // 2, poly, path, offset, steer, t.link, t.factor, t.delay,
                  t.rate, t.accel, t.begin, t.end, t.tx_delay, t.symbol_delay, t.send, t.antenna)  # fmt: skip
            spectra = scipy.fft.ifft(grids.view(np.complex64)[:, low : low + size], axis=1, norm="forward")
            _emit(samples, spectra, deconvolution.astype(np.float32), m, first)
