"""Joint maximum likelihood of several paths on a frame's samples: range, velocity, direction and
amplitude of all at once.

No window, no cells: the samples of the frame are compared with the sum of the paths' exact signals,

    s = sum_k a_k T_k + noise,    T_k = beta exp(j 2 pi (f_c tau + alpha tau (u - tau/2))),   tau =
    tau_D + tau_k + tau_dot_k t + e_k,

e_k the delays of the elements, spherical at the path's range. Gauss-Newton needs of the samples
only, for each path, chirp and receiver, the sums of s T* and of n s T* over the chirp; what the
paths leave in each other's sums is known in closed form (a tone's transform and its derivatives).
In white noise the estimate of an isolated path reaches the Cramer-Rao bound; paths within one cell
are told apart by their directions and velocities.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from isac_rt.frame.waveform import Waveform
from isac_rt.receive.arms import element_delays
from isac_rt.receive.known import Known

PARAMETERS = 4  # delay, delay rate, u_x, u_z
LARGEST_STEP = np.array([0.3, 0.3, 0.03, 0.03])
"""Of one iteration: cells, Doppler bins, direction cosines."""
SETTLED = 1e-2
"""A step under this share of the standard deviation ends the iteration."""


@dataclass(frozen=True)
class JointPath:
    """One path of the joint model.

    Attributes
    ----------
    delay, delay_rate : of the whole path at mid-frame [s, 1]
    direction : (2,) direction cosines u_x, u_z, of arrival at a PT, of both ways at the AT
    amplitude : (1,) complex of an echo; (L_tx,) at a PT, where the directions of departure are free
    std : (4,) standard deviations of delay, delay_rate, u_x, u_z by the curvature of the likelihood
    """

    delay: float
    delay_rate: float
    direction: np.ndarray
    amplitude: np.ndarray
    std: np.ndarray


def rate_bin(waveform: Waveform) -> float:
    """Delay rate of one Doppler bin."""
    return 1 / (waveform.frame_duration * waveform.effective_carrier)


def units(known: Known) -> np.ndarray:
    """(4,) steps of the scaled parameters: a cell of delay, a bin of delay rate, and 1 and 1."""
    return np.array([known.waveform.delay_step, rate_bin(known.waveform), 1.0, 1.0])


def amplitude_index(known: Known) -> np.ndarray:
    """(M, P) which of a path's amplitudes each chirp has."""
    return known.schedule if known.passes == 1 else np.zeros_like(known.schedule)


@dataclass(frozen=True)
class _Tone:
    """A path's signal: phase [cycles] and frequency [cycles per sample] at mid-chirp, (M, rx, P),
    curvature, and the sensitivities.

    `constant`, `slope` : (4 + 2 A, M, rx, P), derivative of the signal over the signal, at
    mid-chirp and per sample, by the scaled parameters and the real and imaginary parts of the
    amplitudes.
    """

    phase: np.ndarray
    frequency: np.ndarray
    curvature: float
    common_phase: np.ndarray
    common_frequency: np.ndarray
    receiver_delay: np.ndarray
    amplitude: np.ndarray
    constant: np.ndarray
    slope: np.ndarray


def _tone(known: Known, path: JointPath) -> _Tone:
    w, a, schedule = known.waveform, known.antennas, known.schedule
    T_s, radius = w.sample_interval, known.radius(path.delay)
    e_rx, de_rx = element_delays(a.rx_positions, path.direction, radius)
    e_tx, de_tx = element_delays(a.tx_positions, path.direction, radius)
    if known.passes == 1:
        e_tx, de_tx = np.zeros_like(e_tx), np.zeros_like(de_tx)
    u = w.window_start + (w.num_samples - 1) / 2 * T_s
    t = known.sampled_times
    tau = known.delay_symbols * w.delay_step + path.delay + path.delay_rate * t + e_tx[schedule]
    g = w.carrier(tau, u)
    phase = w.phase(tau, u)
    frequency = (path.delay_rate * g + w.slope * tau) * T_s
    apart = e_rx[:, None] * g[:, None, :] - w.slope * e_rx[:, None] ** 2 / 2
    amplitude = path.amplitude[amplitude_index(known)]
    constant, slope = _sensitivity(
        known, g, de_rx, de_tx[:, schedule], amplitude, path.amplitude.size
    )
    return _Tone(
        phase=phase[:, None, :] + apart,
        frequency=frequency[:, None, :] + w.slope * T_s * e_rx[:, None],
        curvature=w.slope * path.delay_rate * T_s**2,
        common_phase=phase,
        common_frequency=frequency,
        receiver_delay=e_rx,
        amplitude=np.broadcast_to(
            amplitude[:, None, :], (len(schedule), len(e_rx), schedule.shape[1])
        ),
        constant=constant,
        slope=slope,
    )


def _sensitivity(
    known: Known,
    g: np.ndarray,
    de_rx: np.ndarray,
    de_tx: np.ndarray,
    amplitude: np.ndarray,
    count: int,
) -> tuple[np.ndarray, np.ndarray]:
    """`constant` and `slope` of `_Tone`: j 2 pi a dPhi by the parameters, 1 and j by the
    amplitudes."""
    w, T_s, t, unit = (
        known.waveform,
        known.waveform.sample_interval,
        known.sampled_times,
        units(known),
    )
    shape = (g.shape[0], de_rx.shape[1], g.shape[1])
    constant = np.zeros((PARAMETERS + 2 * count, *shape), np.complex128)
    slope = np.zeros_like(constant)
    lever = [np.ones(shape), np.broadcast_to(t[:, None, :], shape)]
    lever += [de_rx[i][None, :, None] + de_tx[i][:, None, :] for i in (0, 1)]
    turn = 2j * np.pi * amplitude[:, None, :]
    for i, b in enumerate(lever):
        constant[i] = turn * g[:, None, :] * b * unit[i]
        slope[i] = turn * w.slope * T_s * b * unit[i]
    slope[1] += turn * g[:, None, :] * T_s * unit[1]
    for i in range(count):
        mine = (amplitude_index(known) == i)[:, None, :]
        constant[PARAMETERS + 2 * i] = mine
        constant[PARAMETERS + 2 * i + 1] = 1j * mine
    return constant, slope


def _moments(samples: np.ndarray, known: Known, tone: _Tone) -> tuple[np.ndarray, np.ndarray]:
    """Sums of s T* and n s T* over each chirp, n from its middle: two of (M, rx, P)."""
    w = known.waveform
    n = np.arange(w.num_samples) - (w.num_samples - 1) / 2
    zeroth, first = np.empty((2, *tone.phase.shape), np.complex128)
    ramps = np.exp(
        -2j * np.pi * np.outer(tone.receiver_delay * w.slope * w.sample_interval, n)
    ).astype(np.complex64)
    for m in range(len(samples)):
        cycles = tone.common_frequency[m][:, None] * n + (tone.curvature * n**2)
        template = np.exp(-2j * np.pi * (cycles % 1.0).astype(np.float32))
        lever = template * n.astype(np.float32)
        for rx in range(samples.shape[1]):
            part = samples[m, rx] * ramps[rx]
            zeroth[m, rx] = np.einsum("pn,pn->p", part, template)
            first[m, rx] = np.einsum("pn,pn->p", part, lever)
        zeroth[m] *= known.phases[m].conj()
        first[m] *= known.phases[m].conj()
    back = np.exp(-2j * np.pi * tone.phase)
    return zeroth * back, first * back


def match_chirps(samples: np.ndarray, known: Known, path: JointPath) -> np.ndarray:
    """(M, P) the chirps against a path's signal, summed over their samples and the receivers in
    phase."""
    tone = _tone(known, path)
    return (_moments(samples, known, tone)[0] * tone.amplitude.conj()).sum(axis=1)


def tone_sums(offset: np.ndarray, size: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Sums over n = -(N-1)/2 .. (N-1)/2 of 1, n and n^2 times exp(j 2 pi x n), x in cycles per
    sample below a half in magnitude; the first and the last are real, the second imaginary
    (returned without its j)."""
    x = np.where(np.abs(offset) < 1e-2 / size, 1e-2 / size, offset)  # the series takes over there
    s, c = np.sin(np.pi * size * x), np.cos(np.pi * size * x)
    t, k = np.sin(np.pi * x), np.cos(np.pi * x)
    sum0 = s / t
    sum1 = -(size * c * t - s * k) / (2 * t**2)
    sum2 = -((1 - size**2) * s / (4 * t) - k * (size * c * t - s * k) / (2 * t**3))
    small, second, fourth = (
        np.abs(offset) < 1e-2 / size,
        size * (size**2 - 1) / 12,
        size * (size**2 - 1) * (3 * size**2 - 7) / 240,
    )
    y = 2 * np.pi * offset
    sum0 = np.where(small, size - second * y**2 / 2, sum0)
    sum1 = np.where(small, second * y, sum1)
    sum2 = np.where(small, second - fourth * y**2 / 2, sum2)
    return sum0, sum1, sum2


def _cross(known: Known, of: _Tone, at: _Tone) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Sums of T_of T_at* times 1, n, n^2 over each chirp; the difference of their curvatures (0.003
    cycles) is left out."""
    sums = tone_sums(of.frequency - at.frequency, known.waveform.num_samples)
    turn = np.exp(2j * np.pi * (of.phase - at.phase))
    return sums[0] * turn, 1j * sums[1] * turn, sums[2] * turn


def fit(
    samples: np.ndarray, known: Known, paths: list[JointPath], iterations: int = 4
) -> list[JointPath]:
    """Gauss-Newton from near estimates of all paths; amplitudes of the start are not used.

    Parameters
    ----------
    samples : (M, L_rx, P, N)
    known : Known
    paths : within half a cell of their truths

    Returns
    -------
    paths : in the same order
    """
    paths = _with_amplitudes(samples, known, paths)
    for _ in range(iterations):
        gradient, gram, left = _normal_equations(samples, known, paths)
        covariance = np.linalg.inv(gram)
        step = covariance @ gradient
        paths = [
            _moved(known, p, s) for p, s in zip(paths, np.split(step, len(paths)), strict=True)
        ]
        deviation = np.sqrt(np.maximum(np.diag(covariance), 0) * left / 2)
        if (np.abs(step) < SETTLED * deviation).all():
            break
    unit, size = units(known), len(step) // len(paths)
    return [
        replace(p, std=deviation[i * size : i * size + PARAMETERS] * unit)
        for i, p in enumerate(paths)
    ]


def _with_amplitudes(samples: np.ndarray, known: Known, paths: list[JointPath]) -> list[JointPath]:
    """The least-squares amplitudes of paths whose other parameters are given."""
    count = known.antennas.num_tx if known.passes == 1 else 1
    paths = [replace(p, amplitude=np.ones(count, complex)) for p in paths]
    gradient, gram, _ = _normal_equations(samples, known, paths)
    size = PARAMETERS + 2 * count
    amplitudes = np.concatenate([np.arange(PARAMETERS, size) + i * size for i in range(len(paths))])
    step = np.linalg.solve(gram[np.ix_(amplitudes, amplitudes)], gradient[amplitudes]).reshape(
        len(paths), count, 2
    )
    return [
        replace(p, amplitude=p.amplitude + s[:, 0] + 1j * s[:, 1])
        for p, s in zip(paths, step, strict=True)
    ]


def _normal_equations(
    samples: np.ndarray, known: Known, paths: list[JointPath]
) -> tuple[np.ndarray, np.ndarray, float]:
    """Gradient and Gram matrix of the scaled parameters, path by path, and the noise power that the
    paths leave."""
    tones = [_tone(known, p) for p in paths]
    size, cells = tones[0].constant.shape[0], tones[0].phase.size
    gradient, gram = np.zeros(size * len(paths)), np.zeros((size * len(paths),) * 2)
    explained = 0.0
    for k, at in enumerate(tones):
        zeroth, first = _moments(samples, known, at)
        own = slice(k * size, (k + 1) * size)
        c0, c1 = at.constant.reshape(size, cells), at.slope.reshape(size, cells)
        seen = zeroth.copy()
        for j, of in enumerate(tones):
            G0, G1, G2 = (g.ravel() for g in _cross(known, of, at))
            zeroth = zeroth - of.amplitude * G0.reshape(zeroth.shape)
            first = first - of.amplitude * G1.reshape(first.shape)
            d0, d1 = of.constant.reshape(size, cells), of.slope.reshape(size, cells)
            block = c0.conj() @ (G0 * d0 + G1 * d1).T + c1.conj() @ (G1 * d0 + G2 * d1).T
            gram[own, j * size : (j + 1) * size] = block.real
        gradient[own] = (c0.conj() @ zeroth.ravel() + c1.conj() @ first.ravel()).real
        explained += float((at.amplitude.conj() * (seen + zeroth)).real.sum())
    total = float(np.vdot(samples, samples).real)
    left = max(total - explained, 1e-12 * total) / samples.size
    return gradient, gram, left


def residual_channels(
    samples: np.ndarray, known: Known, paths: list[JointPath], offsets: np.ndarray
) -> Iterator[tuple[JointPath, np.ndarray, np.ndarray, float]]:
    """What the paths of a fit leave about each of them, channel by channel.

    Parameters
    ----------
    offsets : (F,) Doppler offsets from the path [bins]

    Yields
    ------
    path
    channels : (F, L_tx, L_rx) mean residual amplitude over the chirps of a transmit antenna times
        the root of their samples
    counts : samples per amplitude of the path
    noise : power of a sample that all paths leave
    """
    w, num_tx = known.waveform, known.antennas.num_tx
    tones = [_tone(known, p) for p in paths]
    left = _normal_equations(samples, known, paths)[2]
    # a bin is one turn per frame
    turns = np.exp(-2j * np.pi * offsets[:, None, None] * known.sampled_times / w.frame_duration)
    sent = np.array([mine.sum() for mine in known.sent_by]) * w.num_samples
    for path, at in zip(paths, tones, strict=True):
        residual = _moments(samples, known, at)[0]
        for of in tones:
            residual = residual - of.amplitude * _cross(known, of, at)[0]
        channels = np.empty((len(offsets), num_tx, residual.shape[1]), np.complex128)
        for tx, mine in enumerate(known.sent_by):
            turned = np.where(mine, turns, 0.0)
            channels[:, tx] = np.einsum("fmp,mrp->fr", turned, residual) / np.sqrt(sent[tx])
        counts = (sent if known.passes == 1 else np.array([sent.sum()])) * known.antennas.num_rx
        yield path, channels, counts, left


def _moved(known: Known, path: JointPath, step: np.ndarray) -> JointPath:
    """A path after a step. The phase turns by 128 cycles per cell of delay: the amplitude follows
    that turn, and not its tangent."""
    change = np.clip(step[:PARAMETERS], -LARGEST_STEP, LARGEST_STEP)
    constant, index = _tone(known, path).constant[:PARAMETERS], amplitude_index(known)
    mine = [
        np.broadcast_to((index == i)[:, None, :], constant.shape[1:])
        for i in range(path.amplitude.size)
    ]
    turn = np.array([constant[:, m].mean(axis=1) for m in mine]) / path.amplitude[:, None]
    pairs = step[PARAMETERS:].reshape(-1, 2)
    amplitude = (
        path.amplitude
        + pairs[:, 0]
        + 1j * pairs[:, 1]
        + path.amplitude * (turn @ step[:PARAMETERS])
    )
    move = change * units(known)
    return replace(
        path,
        delay=path.delay + float(move[0]),
        delay_rate=path.delay_rate + float(move[1]),
        direction=path.direction + move[2:],
        amplitude=amplitude * np.exp(-1j * (turn @ change).imag),
    )
