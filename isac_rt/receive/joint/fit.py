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

Only paths that are close to each other are solved for together. What the others leave in a path's
sums is taken out, unless it is too little to count, and a path that has settled is not asked again:
the time grows with the paths that touch (`isac_rt.receive.joint.interaction`).
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np

from isac_rt.frame.waveform import Waveform
from isac_rt.receive.arms import element_delays
from isac_rt.receive.joint.interaction import CLOSE, TANGENTS, Places, clusters, ignored, shared
from isac_rt.receive.joint.moments import Apart, Moments, cross_sums, exchange
from isac_rt.receive.known import Known

PARAMETERS = 4  # delay, delay rate, u_x, u_z
LARGEST_STEP = np.array([0.3, 0.3, 0.03, 0.03])
"""Of one iteration: cells, Doppler bins, direction cosines."""
SETTLED = 0.05
"""A step under this share of the standard deviation ends the iteration."""
AWAKE = 0.05
"""Of its deviations a settled path may be moved by what other paths' later steps leave."""


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


class Fit(NamedTuple):
    """Paths of a fit, in the order of its start, and the energy of the samples that they leave."""

    paths: list[JointPath]
    left: float


@dataclass(frozen=True)
class _Tone:
    """A path's signal of unit amplitude.

    Attributes
    ----------
    cycles, frequency, carrier : (M, P) phase [cycles] and frequency [cycles per sample] at
        mid-chirp, and cycles per second of delay, for a receiver at the centroid
    delay : (L_rx,) of the receivers
    levers : (4, L_tx, L_rx) change of the delay by each scaled parameter, by the rate at 1 s
    """

    known: Known
    cycles: np.ndarray
    frequency: np.ndarray
    carrier: np.ndarray
    delay: np.ndarray
    levers: np.ndarray

    @classmethod
    def of(cls, known: Known, path: JointPath) -> _Tone:
        """The tone of a path."""
        w, a, schedule = known.waveform, known.antennas, known.schedule
        radius = known.radius(path.delay)
        e_rx, de_rx = element_delays(a.rx_positions, path.direction, radius)
        e_tx, de_tx = element_delays(a.tx_positions, path.direction, radius)
        if known.passes == 1:
            e_tx, de_tx = np.zeros_like(e_tx), np.zeros_like(de_tx)
        u = w.window_start + (w.num_samples - 1) / 2 * w.sample_interval
        tau = known.delay_symbols * w.delay_step + path.delay
        tau = tau + path.delay_rate * known.sampled_times + e_tx[schedule]
        g = w.carrier(tau, u)
        frequency = (path.delay_rate * g + w.slope * tau) * w.sample_interval
        levers = np.ones((PARAMETERS, a.num_tx, a.num_rx))
        levers[2:] = de_rx[:, None, :] + de_tx[:, :, None]
        levers *= units(known)[:, None, None]
        return cls(known, w.phase(tau, u), frequency, g, e_rx, levers)

    @cached_property
    def middle(self) -> float:
        """Mean of the carrier."""
        return float(self.carrier.mean())

    @cached_property
    def ramp(self) -> np.ndarray:
        """(L_rx,) further frequency at each receiver [cycles per sample]."""
        return self.delay * self.known.waveform.slope * self.known.waveform.sample_interval

    def seen(self, moments: Moments) -> np.ndarray:
        """(2, M, P, L_rx) sums of s T* and n s T* over each chirp, n from its middle."""
        late = self.delay
        apart = late * self.carrier[..., None] - self.known.waveform.slope * late**2 / 2
        return moments.of(self.cycles, self.frequency, self.ramp, apart)

    def before(self, other: _Tone) -> Apart:
        """What another tone has before this one."""
        turn = other.delay * other.middle - self.delay * self.middle
        turn -= self.known.waveform.slope * (other.delay**2 - self.delay**2) / 2
        return Apart(
            other.frequency - self.frequency,
            other.cycles - self.cycles,
            other.ramp - self.ramp,
            np.exp(2j * np.pi * turn),
            other.delay - self.delay,
            self.carrier - self.middle,
            float(self.known.waveform.num_samples),
        )

    def cross(self, other: _Tone) -> np.ndarray:
        """(3, M, P, L_rx) sums of 1, n and n^2 times another tone and this one's conjugate."""
        out = np.empty((3, *self.cycles.shape, self.delay.size), complex)
        cross_sums(self.before(other), out)
        return out

    def itself(self) -> np.ndarray:
        """`cross` of the tone with itself."""
        size = self.known.waveform.num_samples
        out = np.zeros((3, *self.cycles.shape, self.delay.size))
        out[0], out[2] = size, size * (size**2 - 1) / 12
        return out

    def slopes(self, amplitude: np.ndarray) -> np.ndarray:
        """(S, 4, L_tx, L_rx) derivatives of the signal over the unit tone, as factors of 1, t, n
        and n t, by the scaled parameters and the real and imaginary parts of the amplitudes."""
        w, count, num_tx = self.known.waveform, amplitude.size, self.levers.shape[1]
        out = np.zeros((PARAMETERS + 2 * count, 4, *self.levers.shape[1:]), complex)
        turn = 2j * np.pi * np.broadcast_to(amplitude, num_tx)[:, None] * self.levers
        carrier, slope = self.middle, w.slope * w.sample_interval
        for i in range(PARAMETERS):
            at = 1 if i == 1 else 0  # the delay rate moves the delay by t
            out[i, at], out[i, at + 2] = turn[i] * carrier, turn[i] * slope
        out[1, 2] = turn[1] * carrier * w.sample_interval
        for i in range(count):
            mine = np.ones((num_tx, 1)) if count == 1 else np.arange(num_tx)[:, None] == i
            out[PARAMETERS + 2 * i, 0] = mine
            out[PARAMETERS + 2 * i + 1, 0] = 1j * mine
        return out


def places(known: Known, paths: Sequence[JointPath]) -> Places:
    """Where paths lie among the cells of a frame."""
    delay, rate = (np.array([getattr(p, n) for p in paths]) for n in ("delay", "delay_rate"))
    beat = known.waveform.beat_cells(delay, rate, 0.0)
    direction = np.array([p.direction for p in paths]).reshape(-1, 2)
    return Places(beat, rate / rate_bin(known.waveform), direction, delay)


def match_chirps(moments: Moments, path: JointPath) -> np.ndarray:
    """(M, P) the chirps against a path's signal, summed over their samples and the receivers in
    phase."""
    sums = _Tone.of(moments.known, path).seen(moments)[0].sum(axis=-1)
    return sums * path.amplitude[amplitude_index(moments.known)].conj()


def fit(
    moments: Moments,
    paths: Sequence[JointPath],
    iterations: int = 4,
    fixed: Sequence[JointPath] = (),
    energy: float | None = None,
) -> Fit:
    """Gauss-Newton from near estimates of all paths; amplitudes of the start are not used.

    Parameters
    ----------
    moments : of the frame's samples
    paths : within half a cell of their truths
    fixed : further paths, which are taken out and stay as they are
    energy : of the samples without the `fixed` ones, None: all of it
    """
    state = _Descent(moments, paths, fixed, moments.energy if energy is None else energy)
    state.amplitudes()
    awake = np.full(len(paths), True)
    for _ in range(iterations):
        group = state.group
        awake = np.isin(group, group[awake])
        if not awake.any():
            break
        awake = state.step(np.flatnonzero(awake))
    return state.fit()


class _Descent:
    """A fit on its way: paths, their tones, and what is felt of whom. The first are free, the
    fixed ones follow."""

    def __init__(
        self,
        moments: Moments,
        paths: Sequence[JointPath],
        fixed: Sequence[JointPath],
        energy: float,
    ) -> None:
        known, self.free = moments.known, len(paths)
        self.moments, self.known, self.energy = moments, known, energy
        self.index = amplitude_index(known)
        self.count = int(self.index.max()) + 1 if known.passes == 1 else 1
        self.paths = [*paths, *fixed]
        self.tones = [_Tone.of(known, p) for p in self.paths]
        self.seen = [tone.seen(moments) for tone in self.tones[: self.free]]
        where = places(known, self.paths)
        self.share = shared(known, where, where)[: self.free]
        np.fill_diagonal(self.share, 0)
        self.group = clusters(self.share[:, : self.free])
        # samples that count for each amplitude
        self.samples = self._by_antenna(np.full(self.seen[0].shape[1:], self._length)).real
        sums = [self._by_antenna(z[0]) for z in self.seen]
        sums += [p.amplitude * self.samples for p in fixed]
        self.power = (np.abs(sums) ** 2 / self.samples).sum(axis=1)
        self.felt = self._felt(moments.noise)
        self.size = PARAMETERS + 2 * self.count
        self.explained = np.zeros(self.free)
        self.deviation = np.full((self.free, self.size), np.inf)
        self.stirred = np.zeros(self.free)
        self.last, self.reach = np.zeros((self.free, PARAMETERS)), np.ones(self.free)
        self._unused = np.empty_like(self.seen[0])

    def _felt(self, noise: float) -> np.ndarray:
        """(free, K) bool, which other paths count in the sums of each free one."""
        out = ~ignored(self.share, self.power / noise) | (self.share > CLOSE)
        out[:, : self.free] |= out[:, : self.free].T
        out[np.arange(self.free), np.arange(self.free)] = False
        return out

    @property
    def _length(self) -> float:
        return float(self.known.waveform.num_samples)

    def _by_antenna(self, sums: np.ndarray) -> np.ndarray:
        """Sums (M, P, L_rx) added up for each amplitude of a path."""
        chirps = sums.sum(axis=-1)
        return np.array([chirps[self.index == i].sum() for i in range(self.count)])

    def _amplitude(self, k: int) -> np.ndarray:
        """(M, P, 1) amplitude of a path in each chirp."""
        return self.paths[k].amplitude[self.index][..., None]

    def amplitudes(self) -> None:
        """Give the free paths the amplitudes of least squares where they are."""
        seen = [z[0] for z in self.seen]
        gram = np.zeros((self.count, self.free, self.free), complex)
        for k in range(self.free):
            gram[:, k, k] = self._by_antenna(self.tones[k].itself()[0])
            for j in np.flatnonzero(self.felt[k]).tolist():
                if j >= self.free:
                    seen[k] = seen[k] - self._amplitude(j) * self.tones[k].cross(self.tones[j])[0]
                elif j < k:
                    shared_sum = self._by_antenna(self.tones[k].cross(self.tones[j])[0])
                    gram[:, k, j], gram[:, j, k] = shared_sum, shared_sum.conj()
        right = np.array([self._by_antenna(z) for z in seen]).T
        found = [np.linalg.lstsq(g, r, rcond=1e-9)[0] for g, r in zip(gram, right, strict=True)]
        for k, amplitude in enumerate(np.array(found).T):
            self.paths[k] = replace(self.paths[k], amplitude=amplitude)

    def step(self, active: np.ndarray) -> np.ndarray:
        """One step of the clusters of some free paths; (free,) bool, whom it leaves unsettled."""
        gradient, gram = self._equations(active)
        noise, moved = self.noise, np.zeros(self.free)
        self.power = np.array([(np.abs(p.amplitude) ** 2 @ self.samples) for p in self.paths])
        self.felt = self._felt(max(noise, self.moments.noise))
        for g in np.unique(self.group[active]):
            mine = np.flatnonzero(self.group == g)
            cells = (mine[:, None] * self.size + np.arange(self.size)).ravel()
            covariance = np.linalg.inv(gram[np.ix_(cells, cells)])
            steps = (covariance @ gradient[cells]).reshape(mine.size, -1)
            variance = np.maximum(np.diag(covariance), 0).reshape(steps.shape) * noise / 2
            self.deviation[mine] = np.sqrt(variance)
            moved[mine] = (np.abs(steps) / np.maximum(self.deviation[mine], 1e-300)).max(axis=1)
            share = self._within_reach(mine, steps[:, :PARAMETERS] / LARGEST_STEP)
            for k, one in zip(mine, share * steps, strict=True):
                self.paths[k] = _moved(self.tones[k], self.paths[k], one)
                self.tones[k] = _Tone.of(self.known, self.paths[k])
                self.seen[k] = self.tones[k].seen(self.moments)
        self.stirred[active] = 0
        self.stirred += TANGENTS * (self.share[:, : self.free] * self.felt[:, : self.free]) @ moved
        return (moved > SETTLED) | (self.stirred > AWAKE)

    def _within_reach(self, mine: np.ndarray, steps: np.ndarray) -> float:
        """The share of a cluster's step that is taken: no farther than its paths reach, and half as
        far as the last step where it leads back."""
        last, size = self.last[mine], float(np.abs(steps).max())
        reach = float(self.reach[mine[0]])
        if (last * steps).sum() < 0:
            reach = min(reach, 0.5 * float(np.abs(last).max()))
        share = min(1.0, reach / max(size, 1e-300))
        self.last[mine], self.reach[mine] = share * steps, reach
        return share

    @property
    def noise(self) -> float:
        """Power of a sample that all paths leave."""
        left = max(self.energy - float(self.explained.sum()), 1e-12 * self.moments.energy)
        return left / self.moments.size

    def _equations(self, active: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Gradient and Gram matrix of the scaled parameters, path by path; filled for the active
        paths, and the matrix within clusters."""
        size, total = self.size, self.size * self.free
        gradient, gram = np.zeros(total), np.zeros((total, total))
        left = {k: self.seen[k].copy() for k in active.tolist()}
        slopes = {k: self.tones[k].slopes(self.paths[k].amplitude) for k in left}
        for k in left:
            for j in (np.flatnonzero(self.felt[k, self.free :]) + self.free).tolist():
                self._exchange(k, j, left)
        seen = {k: left[k][0].copy() for k in left}
        for k, j in self._pairs(left):
            if self.group[j] != self.group[k]:
                self._exchange(k, j, left)
                continue
            sums = self.tones[k].cross(self.tones[j]) if j != k else self.tones[k].itself()
            left[k] -= self._amplitude(j) * sums[:2]
            if j != k:
                left[j] -= self._amplitude(k) * sums[:2].conj()
            own, other = (slice(i * size, (i + 1) * size) for i in (k, j))
            gram[own, other] = self._block(slopes[k], slopes[j], sums)
            gram[other, own] = gram[own, other].T
        for k, sums in left.items():
            parts = _by_channel(self.known, sums, 2).reshape(4, *slopes[k].shape[2:])
            own = slice(k * size, (k + 1) * size)
            gradient[own] = np.einsum("sbrt,brt->s", slopes[k].conj(), parts).real
            twice = self._by_antenna(seen[k] + sums[0])
            self.explained[k] = float((self.paths[k].amplitude.conj() * twice).real.sum())
        return gradient, gram

    def _exchange(self, k: int, j: int, left: dict[int, np.ndarray]) -> None:
        """Take two paths out of each other's sums, in place."""
        own, other = (self.paths[i].amplitude[self.index] for i in (k, j))
        beside = left.get(j, self._unused)
        exchange(self.tones[k].before(self.tones[j]), own, other, left[k], beside)

    def _pairs(self, active: dict[int, np.ndarray]) -> Iterator[tuple[int, int]]:
        """Active paths with each free one that they feel, and with themselves; each pair once."""
        for k in active:
            yield k, k
            for j in np.flatnonzero(self.felt[k, : self.free]).tolist():
                if j < k or j not in active:
                    yield k, j

    def _block(self, own: np.ndarray, other: np.ndarray, sums: np.ndarray) -> np.ndarray:
        """(S, S) products of two paths' derivatives over all samples."""
        powers = _by_channel(self.known, sums, 3)  # of n and of t
        mixed = np.empty((4, 4, *powers.shape[2:]), complex)
        for a in range(4):
            for b in range(4):
                mixed[a, b] = powers[a // 2 + b // 2, a % 2 + b % 2]
        channels = own.shape[2] * own.shape[3]
        left, middle, right = (
            np.moveaxis(x.reshape(*x.shape[:2], channels), -1, 0) for x in (own, mixed, other)
        )
        return (left.conj() @ middle @ right.transpose(0, 2, 1)).sum(axis=0).real

    def fit(self) -> Fit:
        """The free paths with their deviations."""
        unit = units(self.known)
        paths = [
            replace(p, std=std[:PARAMETERS] * unit)
            for p, std in zip(self.paths[: self.free], self.deviation, strict=True)
        ]
        return Fit(paths, self.noise * self.moments.size)


def _by_channel(known: Known, sums: np.ndarray, powers: int) -> np.ndarray:
    """(K, powers, L_tx, L_rx): sums (K, M, P, L_rx) times 1, t, t^2 .. added over the chirps of
    each transmit antenna."""
    times = known.sampled_times.ravel() ** np.arange(powers)[:, None]
    sent = np.array([mine.ravel() for mine in known.sent_by], float)
    weights = (times[:, None] * sent).reshape(-1, times.shape[1]).astype(sums.dtype)
    total = weights @ sums.reshape(len(sums), times.shape[1], -1)
    return total.reshape(len(sums), powers, len(sent), -1)


def energy(known: Known, paths: Sequence[JointPath]) -> float:
    """Energy of the sum of a few paths over the samples of a frame."""
    index, total = amplitude_index(known), 0.0
    tones = [_Tone.of(known, p) for p in paths]
    waves = [p.amplitude[index][..., None] for p in paths]
    for k, at in enumerate(tones):
        for j in range(k + 1):
            sums = at.cross(tones[j])[0] if j < k else at.itself()[0]
            both = float((waves[k].conj() * waves[j] * sums).sum().real)
            total += both if j == k else 2 * both
    return total


def residual_channels(
    moments: Moments, found: Fit, beside: Sequence[JointPath], offsets: np.ndarray
) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """What the paths of a fit leave at some places, channel by channel.

    Parameters
    ----------
    found : the fit
    beside : the places, of which some may be its paths
    offsets : (F,) Doppler offsets from them [bins]

    Yields
    ------
    channels : (F, L_tx, L_rx) mean residual amplitude over the chirps of a transmit antenna times
        the root of their samples
    counts : samples per amplitude of a path
    """
    known = moments.known
    w, num_tx, index = known.waveform, known.antennas.num_tx, amplitude_index(known)
    # a bin is one turn per frame
    turns = np.exp(-2j * np.pi * offsets[:, None, None] * known.sampled_times / w.frame_duration)
    sent = np.array([mine.sum() for mine in known.sent_by]) * w.num_samples
    counts = (sent if known.passes == 1 else np.array([sent.sum()])) * known.antennas.num_rx
    power = np.array([(np.abs(p.amplitude) ** 2 * counts).sum() for p in found.paths])
    share = shared(known, places(known, found.paths), places(known, beside))
    felt = ~ignored(share, power / moments.noise)
    tones = [_Tone.of(known, p) for p in found.paths]
    for place, mine in zip(beside, felt, strict=True):
        at = _Tone.of(known, place)
        left = at.seen(moments)[0]
        for j in np.flatnonzero(mine):
            left -= found.paths[j].amplitude[index][..., None] * at.cross(tones[j])[0]
        channels = np.empty((len(offsets), num_tx, left.shape[-1]), complex)
        for tx, chirps in enumerate(known.sent_by):
            turned = np.where(chirps, turns, 0.0)
            channels[:, tx] = np.tensordot(turned, left, 2) / np.sqrt(sent[tx])
        yield channels, counts


def _moved(tone: _Tone, path: JointPath, step: np.ndarray) -> JointPath:
    """A path after a step. The phase turns by 128 cycles per cell of delay: the amplitude follows
    that turn, and not its tangent."""
    known, count = tone.known, path.amplitude.size
    change = step[:PARAMETERS]
    sent = np.array([mine.sum() for mine in known.sent_by], float)
    late = np.array([known.sampled_times[mine].sum() for mine in known.sent_by]) / sent
    levers = tone.levers.mean(axis=2)
    levers[1] *= late
    if count == 1:
        levers = (levers @ sent / sent.sum())[:, None]
    turn = 2j * np.pi * tone.middle * levers.T
    pairs = step[PARAMETERS:].reshape(-1, 2)
    amplitude = path.amplitude * (1 + turn @ change) + pairs[:, 0] + 1j * pairs[:, 1]
    move = change * units(known)
    return replace(
        path,
        delay=path.delay + float(move[0]),
        delay_rate=path.delay_rate + float(move[1]),
        direction=path.direction + move[2:],
        amplitude=amplitude * np.exp(-1j * (turn @ change).imag),
    )
