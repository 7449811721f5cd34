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
from isac_rt.receive.joint.moments import Moments, tone_sums
from isac_rt.receive.known import Known

PARAMETERS = 4  # delay, delay rate, u_x, u_z
LARGEST_STEP = np.array([0.3, 0.3, 0.03, 0.03])
"""Of one iteration: cells, Doppler bins, direction cosines."""
SETTLED = 1e-2
"""A step under this share of the standard deviation ends the iteration."""
NEAR_CELLS = 12
"""Paths farther apart in beat are fitted at once, but each by its own curvature."""


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


def _moments(moments: Moments, tone: _Tone) -> tuple[np.ndarray, np.ndarray]:
    """Sums of s T* and n s T* over each chirp, n from its middle: two of (M, rx, P)."""
    w = moments.known.waveform
    ramp = tone.receiver_delay * w.slope * w.sample_interval
    zeroth, first = moments.of(tone.common_frequency, tone.curvature, ramp)
    back = np.exp(-2j * np.pi * tone.phase)
    return zeroth * back, first * back


def match_chirps(moments: Moments, path: JointPath) -> np.ndarray:
    """(M, P) the chirps against a path's signal, summed over their samples and the receivers in
    phase."""
    tone = _tone(moments.known, path)
    return (_moments(moments, tone)[0] * tone.amplitude.conj()).sum(axis=1)


def _cross(known: Known, of: _Tone, at: _Tone) -> np.ndarray:
    """Sums of T_of T_at* times 1, n, n^2 over each chirp, (3, M, rx, P); the difference of their
    curvatures (0.003 cycles) is left out."""
    out = np.empty((3, *of.phase.shape), np.complex128)
    size = float(known.waveform.num_samples)
    tone_sums(of.frequency - at.frequency, of.phase - at.phase, size, out)
    return out


def fit(moments: Moments, paths: list[JointPath], iterations: int = 4) -> list[JointPath]:
    """Gauss-Newton from near estimates of all paths; amplitudes of the start are not used.

    Parameters
    ----------
    moments : of the frame's samples
    paths : within half a cell of their truths

    Returns
    -------
    paths : in the same order
    """
    known, paths = moments.known, _with_amplitudes(moments, paths)
    for _ in range(iterations):
        gradient, gram, left = _normal_equations(moments, paths)
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


def _with_amplitudes(moments: Moments, paths: list[JointPath]) -> list[JointPath]:
    """The least-squares amplitudes of paths whose other parameters are given."""
    known = moments.known
    count = known.antennas.num_tx if known.passes == 1 else 1
    paths = [replace(p, amplitude=np.ones(count, complex)) for p in paths]
    gradient, gram, _ = _normal_equations(moments, paths)
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
    moments: Moments, paths: list[JointPath]
) -> tuple[np.ndarray, np.ndarray, float]:
    """Gradient and Gram matrix of the scaled parameters, path by path, and the noise power that the
    paths leave. The Gram matrix is left 0 between paths more than `NEAR_CELLS` apart: what they
    leave in each other's sums is in the gradient."""
    known = moments.known
    tones = [_tone(known, p) for p in paths]
    size, cells = tones[0].constant.shape[0], tones[0].phase.size
    gradient, gram = np.zeros(size * len(paths)), np.zeros((size * len(paths),) * 2)
    seen, left, first = _residuals(moments, tones)
    beats = [float(t.common_frequency.mean()) for t in tones]
    near = NEAR_CELLS / known.waveform.num_samples
    for k, at in enumerate(tones):
        own = slice(k * size, (k + 1) * size)
        c0, c1 = (v.reshape(size, cells) for v in (at.constant, at.slope))
        for j in range(k + 1):
            if abs(beats[k] - beats[j]) > near:
                continue
            G0, G1, G2 = _cross(known, tones[j], at).reshape(3, cells)
            d0, d1 = (v.reshape(size, cells) for v in (tones[j].constant, tones[j].slope))
            block = c0.conj() @ (G0 * d0 + G1 * d1).T + c1.conj() @ (G1 * d0 + G2 * d1).T
            gram[own, j * size : (j + 1) * size] = block.real
            gram[j * size : (j + 1) * size, own] = block.real.T
        gradient[own] = (c0.conj() @ left[k].ravel() + c1.conj() @ first[k].ravel()).real
    return gradient, gram, _noise(moments, tones, seen, left)


def _noise(
    moments: Moments, tones: list[_Tone], seen: list[np.ndarray], left: list[np.ndarray]
) -> float:
    """Power of a sample that all tones leave."""
    explained = sum(
        float((t.amplitude.conj() * (s + z)).real.sum())
        for t, s, z in zip(tones, seen, left, strict=True)
    )
    return max(moments.energy - explained, 1e-12 * moments.energy) / moments.size


def _residuals(
    moments: Moments, tones: list[_Tone]
) -> tuple[list[np.ndarray], list[np.ndarray], list[np.ndarray]]:
    """Of each tone the zeroth moments of the samples, and the zeroth and the first of what all
    tones leave."""
    known, size = moments.known, moments.known.waveform.num_samples
    seen, first = (list(one) for one in zip(*(_moments(moments, t) for t in tones), strict=True))
    left = [z - size * t.amplitude for z, t in zip(seen, tones, strict=True)]
    for k, at in enumerate(tones):
        for j, of in enumerate(tones[:k]):
            G0, G1, _ = _cross(known, of, at)
            left[k] = left[k] - of.amplitude * G0
            first[k] = first[k] - of.amplitude * G1
            left[j] = left[j] - at.amplitude * G0.conj()
            first[j] = first[j] - at.amplitude * G1.conj()
    return seen, left, first


def residual_channels(
    moments: Moments, paths: list[JointPath], offsets: np.ndarray
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
    known = moments.known
    w, num_tx = known.waveform, known.antennas.num_tx
    tones = [_tone(known, p) for p in paths]
    seen, residuals, _ = _residuals(moments, tones)
    left = _noise(moments, tones, seen, residuals)
    # a bin is one turn per frame
    turns = np.exp(-2j * np.pi * offsets[:, None, None] * known.sampled_times / w.frame_duration)
    sent = np.array([mine.sum() for mine in known.sent_by]) * w.num_samples
    for path, residual in zip(paths, residuals, strict=True):
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
