"""Slow reference implementations, written from the equations and sharing no code with the
package."""

from __future__ import annotations

import numpy as np

LIGHT = np.longdouble(299_792_458)


def mixed_chirps(w, links, rx_pose, rx_antennas, start_time, block=0):
    """IF samples by mixing, sample by sample, the reference chirp with the chirp that arrives (long
    double).

    `start_time` is that of the first reference chirp, which is sent in resource block `block` of
    its slot. Times are counted from the start of the slot, so that no phase is formed from f_c
    times an absolute time. Elements are placed as points: a path with a radius comes from (goes to)
    a point at this distance; a line of sight joins two elements.
    """
    ld, transition = np.longdouble, w.filter_transition
    period = ld(1) / ld(w.sampling_rate)
    window = ld(w.num_samples) * period
    longest = ld(w.sampling_rate) * window / (ld(w.bandwidth) - 2 * ld(w.sampling_rate))
    chirp = window + 2 * longest
    slope = ld(w.bandwidth) / chirp
    slot, begin = chirp + 2 * w.num_tx * longest, 2 * longest
    if w.sweep is not None:  # timing of a data sheet
        slope, slot, begin = ld(w.sweep.slope), ld(w.sweep.repetition), ld(w.sweep.adc_start)
        longest = ld(w.sampling_rate) / slope
    frame = w.num_chirps * slot
    fast = np.arange(w.num_samples).astype(ld) * period + begin

    def oscillator(since):  # phase of a chirp in cycles
        return ld(w.carrier_frequency) * since + slope * since * since / 2

    rx = (rx_pose.rotation @ rx_antennas.rx_positions.T).T.astype(ld)
    out = np.zeros((w.num_groups, len(rx), w.num_chirps, w.num_samples), np.complex128)
    for sender, paths in links:
        tx = (sender.pose.rotation @ sender.antennas.tx_positions.T).T.astype(ld)
        later = ld(start_time) + frame / 2 - ld(paths.epoch)
        for m, source, p, k in np.ndindex(w.num_groups, w.num_groups, w.num_chirps, len(paths)):
            a = sender.schedule[source, p]
            begun = 2 * (source + sender.first_block) * longest + ld(
                sender.payload.delay_symbols[source, p]
            ) / (slope * window)
            reference = 2 * (m + block) * longest
            slot_time = reference + fast
            t = 2 * m * longest + fast + p * slot - frame / 2
            aged = t + later
            tau = (
                ld(paths.delay[k])
                + ld(paths.delay_rate[k]) * aged
                + ld(paths.delay_accel[k]) * aged * aged / 2
            )
            tau = tau + ld(sender.clock_offset) + ld(sender.clock_drift) * t
            middle = begun + tau[w.num_samples // 2] - reference
            beat = float(slope * middle)
            if -transition < beat < 0:
                gain = np.cos(np.pi * beat / transition / 2) ** 2
            elif w.sampling_rate < beat < w.sampling_rate + transition:
                gain = np.cos(np.pi * (beat - w.sampling_rate) / transition / 2) ** 2
            else:
                gain = float(0 <= beat <= w.sampling_rate)
            lives = (paths.begin[k] <= aged) & (aged < paths.end[k])
            on = 1.0 if sender.active is None else sender.active[source, p]
            sent = sender.amplitude * np.conj(sender.payload.phases[source, p]) * on
            for r in range(len(rx)):
                extra = _element_path(paths, k, tx[a], rx[r]) / LIGHT
                cycles = oscillator(slot_time - begun - tau - extra)
                turn = oscillator(slot_time - reference) - cycles
                turn = (turn - np.floor(turn)).astype(float)
                received = paths.gain[k] * sent * gain * lives
                out[m, r, p] += np.conj(received) * np.exp(2j * np.pi * turn)
    return out


def _element_path(paths, k, tx, rx):
    """How much longer the path between two elements is than that between the centroids [m]."""
    ld = np.longdouble
    d, u = paths.departure[k].astype(ld), paths.arrival[k].astype(ld)
    if paths.kind[k] == 0 and np.isfinite(paths.rx_radius[k]):
        length = ld(paths.rx_radius[k])
        return _norm(length * d + rx - tx) - length
    total = ld(0)
    for element, direction, radius in ((tx, d, paths.tx_radius[k]), (rx, u, paths.rx_radius[k])):
        if np.isinf(radius):
            total -= element @ direction
        else:
            total += _norm(ld(radius) * direction - element) - ld(radius)
    return total


def _norm(v):
    return np.sqrt((v * v).sum())


def tones_to_second_order(w, t):
    """IF samples (M, L_rx, P, N) of `Tones` t by the series that the gridded method sums:

        z exp(j 2 pi (f0 + f1 n)) s_l exp(-j theta lambda) (1 - c theta^2/2 + j theta (1 + j q k) x
        + (j q - theta^2/2) (x^2 - c)),

    x = n/(N/2) from the middle sample, f0, f1 and q the phase's first coefficients there, theta the
    turn of a receive element over half a chirp, lambda = tau/(T/2), k = 4/15.
    """
    ld = np.longdouble
    step, half = ld(1) / ld(w.sampling_rate), w.num_samples // 2
    window = w.num_samples * step
    longest = ld(w.sampling_rate) * window / (ld(w.bandwidth) - 2 * ld(w.sampling_rate))
    slope = ld(w.bandwidth) / (window + 2 * longest)
    slot, middle = window + 2 * (1 + w.num_tx) * longest, 2 * longest + half * step
    first = middle - w.num_chirps * slot / 2
    since = np.poly1d(np.array([step, middle]))
    n = np.arange(w.num_samples) - half
    x = n / half
    c = (x**2).mean()
    out = np.zeros((w.num_groups, t.rx_delay.shape[1], w.num_chirps, w.num_samples), complex)
    for k, m, source, p in np.ndindex(t.delay.size, w.num_groups, w.num_groups, w.num_chirps):
        q = t.link[k]
        time = first + p * slot + 2 * m * longest
        if not t.begin[k] <= time < t.end[k]:
            continue
        rate, late = t.rate[k] + t.accel[k] * time, 2 * (source - m) * longest
        tau = t.symbol_delay[q, source, p] + t.delay[k] + late
        tau = tau + (t.rate[k] + t.accel[k] * time / 2) * time
        beat, sidelobe = float(slope * tau), w.filter_transition
        outside = min(max(-beat, beat - w.sampling_rate, 0.0) / sidelobe, 1.0)
        z = t.factor[k] * t.send[q, source, p] * np.cos(np.pi * outside / 2) ** 2
        if z == 0:
            continue
        sent = tau + t.tx_delay[k, t.antenna[q, source, p]]
        delay = np.poly1d(np.array([t.accel[k] * step**2 / 2, rate * step, sent]))
        phase = delay * ld(w.carrier_frequency) + delay * (since - delay / 2) * slope
        f0, f1, curvature = (float(phase[i] % 1) if i < 2 else float(phase[i]) for i in range(3))
        bow = 2 * np.pi * curvature * half**2
        e = t.rx_delay[k].astype(ld)
        turn = (ld(w.carrier_frequency) + slope * middle) * e - slope * e**2 / 2
        theta = (2 * np.pi * slope * step * half * e).astype(float)[:, None]
        series = 1 - c * theta**2 / 2 + (1j * bow - theta**2 / 2) * (x**2 - c)
        series = series + 1j * theta * (1 + 4j / 15 * bow) * x
        start = np.exp(2j * np.pi * (turn % 1).astype(float))[:, None]
        start = start * np.exp(-1j * theta * float(tau / (step * half)))
        tone = z * np.exp(2j * np.pi * (f0 + f1 * n) + 1j * bow * c)
        out[m, :, p] += start * tone * series
    return out


def splitmix64(state: int, word: int) -> int:
    """The state moved on by the golden ratio's multiple and mixed, in whole numbers of Python; the
    published generator with word 0."""
    mask = 2**64 - 1
    z = state + (word + 1) * 0x9E3779B97F4A7C15 & mask
    z = (z ^ z >> 30) * 0xBF58476D1CE4E5B9 & mask
    z = (z ^ z >> 27) * 0x94D049BB133111EB & mask
    return z ^ z >> 31


def what_is_measured(state, own, sender=None):
    """Length of the way to a body, its rate and the direction cosines u_x, u_z of arrival (..., 4),
    of states (..., 6 or more) in long double.

    The rate is the imaginary part of the length an imaginary instant later; `sender` is the state
    (..., 6 or more) of the end from which the wave comes to the body, None: only the way from the
    body counts.
    """
    instant = 1e-15

    def way(start):
        gap = (state - start).astype(np.longdouble)
        later = gap[..., :3] + 1j * instant * gap[..., 3:]
        length = np.sqrt((later**2).sum(-1))
        return length.real, length.imag / instant

    state = np.asarray(state)[..., :6]
    length, rate = way(np.concatenate([own.position, own.velocity]))
    towards = (state[..., :3] - own.position) @ own.rotation / length[..., None]
    if sender is not None:
        more = way(np.asarray(sender)[..., :6])
        length, rate = length + more[0], rate + more[1]
    return np.stack([length, rate, towards[..., 0], towards[..., 2]], axis=-1)


def slopes(function, at, step=1e-5):
    """Derivative of a vector function with respect to a vector, by central differences in long
    double: (values, variables)."""
    at = np.asarray(at).astype(np.longdouble)
    moves = step * np.eye(at.size)
    columns = [(function(at + move) - function(at - move)) / (2 * step) for move in moves]
    return np.stack(columns, axis=-1)
