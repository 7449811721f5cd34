"""Joint maximum likelihood of several paths on a frame's samples: range, velocity, direction and
amplitude of all at once.

No window, no cells: the samples of the frame are compared with the sum of the paths' exact signals,

    s = sum_k a_k T_k + noise,    T_k = beta exp(j 2 pi (f_c tau + alpha tau (u - tau/2))),   tau =
    tau_D + tau_k + tau_dot_k t + e_k,

e_k the delays of the elements, spherical at the path's range. Gauss-Newton needs of the samples
only, for each path, transmit antenna and receiver, the sums of s T* times 1, n, t and n t; what the
paths leave in each other's sums is known in closed form (`isac_rt.receive.joint.tones`).
In white noise the estimate of an isolated path reaches the Cramer-Rao bound; paths within one cell
are told apart by their directions and velocities.

Only paths that are close to each other are solved for together. What the others leave in a path's
sums is taken out, unless it is too little to count, and a path that has settled is not asked again:
the time grows with the paths that touch (`isac_rt.receive.joint.interaction`).
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from isac_rt.receive.joint.interaction import (
    CLOSE,
    TANGENTS,
    CellPositions,
    clusters,
    ignored,
    shared,
)
from isac_rt.receive.joint.moments import Moments
from isac_rt.receive.joint.tones import (
    PARAMETERS,
    JointPath,
    Tones,
    Weights,
    cross_sums,
    own_sums,
    powers_of_time,
    rate_bin,
    units,
)
from isac_rt.receive.known import Known

LARGEST_STEP = np.array([0.3, 0.3, 0.03, 0.03])
"""Of one iteration: cells, Doppler bins, direction cosines."""
SETTLED = 0.05
"""A step under this share of the standard deviation ends the iteration."""
MAX_DRIFT = 0.05
"""Of its deviations a settled path may be moved by what other paths' later steps leave."""


class Fit(NamedTuple):
    """Paths of a fit, in the order of its start, and the energy of the samples that they leave."""

    paths: list[JointPath]
    left: float


def cell_positions(known: Known, paths: Sequence[JointPath]) -> CellPositions:
    """Where paths lie among the cells of a frame."""
    delay, rate = (np.array([getattr(p, n) for p in paths]) for n in ("delay", "delay_rate"))
    beat = known.waveform.beat_cells(delay, rate, 0.0)
    direction = np.array([p.direction for p in paths]).reshape(-1, 2)
    return CellPositions(beat, rate / rate_bin(known.waveform), direction, delay)


def match_chirps(moments: Moments, path: JointPath) -> np.ndarray:
    """(M, P) the chirps against a path's signal, summed over their samples and the receivers in
    phase."""
    known = moments.known
    sums = moments.of(Tones.of(known, [path])[0], Weights.by_chirp(known))[0, 0, 0].sum(axis=-1)
    sums = sums.reshape(known.schedule.shape)
    return sums * path.amplitude[known.schedule if known.passes == 1 else 0].conj()


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
    pending = np.full(len(paths), True)
    for _ in range(iterations):
        group = state.group
        pending = np.isin(group, group[pending])
        if not pending.any():
            break
        pending = state.step(np.flatnonzero(pending))
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
        self.count = known.antennas.num_tx if known.passes == 1 else 1
        self.paths = [*paths, *fixed]
        self.weights = powers_of_time(known, 3)
        self.own = own_sums(float(known.waveform.num_samples), self.weights)
        self.tones, self.levers = Tones.of(known, self.paths)
        where = cell_positions(known, self.paths)
        self.share = shared(known, where, where)[: self.free]
        np.fill_diagonal(self.share, 0)
        self.group = clusters(self.share[:, : self.free])
        # samples that count for each amplitude
        self.samples = self._by_amplitude(np.repeat(self.own[0, 0], known.antennas.num_rx, axis=1))
        self.seen = moments.of(self.tones.select(slice(self.free)), self._fewer)
        sums = np.array([p.amplitude * self.samples for p in fixed]).reshape(-1, self.count)
        sums = np.concatenate([self._by_amplitude(self.seen[:, 0, 0]), sums])
        self.power = (np.abs(sums) ** 2 / self.samples).sum(axis=1)
        self.coupled = self._coupled(moments.noise)
        self.size = PARAMETERS + 2 * self.count
        self.told = np.full(self.size, True)  # not the axes along which the array has one place
        self.told[PARAMETERS - 2 : PARAMETERS] = known.antennas.observes(known.passes)
        self.explained = np.zeros(self.free)
        self.deviation = np.full((self.free, self.size), np.inf)
        self.stirred, self.stale = np.zeros(self.free), np.zeros(self.free, bool)
        self.last, self.reach = np.zeros((self.free, PARAMETERS)), np.ones(self.free)

    def _coupled(self, noise: float) -> np.ndarray:
        """(free, K) bool, which other paths count in the sums of each free one."""
        out = ~ignored(self.share, self.power / noise) | (self.share > CLOSE)
        out[:, : self.free] |= out[:, : self.free].T
        out[np.arange(self.free), np.arange(self.free)] = False
        return out

    @property
    def _fewer(self) -> Weights:
        """Return the chirps' design with 1 and t alone."""
        return self.weights._replace(factors=self.weights.factors[:2])

    def _by_amplitude(self, sums: np.ndarray) -> np.ndarray:
        """Sums (..., L_tx, L_rx) added up for each amplitude of a path."""
        norms = sums.sum(axis=-1)
        return norms if self.count > 1 else norms.sum(axis=-1, keepdims=True)

    def _amplitudes(self) -> np.ndarray:
        """(K, L_tx) amplitudes of all paths."""
        num_tx = self.known.antennas.num_tx
        return np.array([np.broadcast_to(p.amplitude, num_tx) for p in self.paths])

    def amplitudes(self) -> None:
        """Give the free paths the amplitudes of least squares where they are."""
        of, at = np.nonzero(self.coupled)
        used = (at < of) | (at >= self.free)
        of, at = of[used], at[used]
        alone = self.weights._replace(factors=self.weights.factors[:1])
        sums = cross_sums(self.tones, np.column_stack([of, at]), alone, 1)[:, 0, 0]
        gram = np.zeros((self.count, self.free, self.free), complex)
        gram[:, np.arange(self.free), np.arange(self.free)] = self.samples[:, None]
        right = self._by_amplitude(self.seen[:, 0, 0])
        by_amplitude = self._by_amplitude(sums)
        for k, j, both in zip(of.tolist(), at.tolist(), by_amplitude, strict=True):
            if j >= self.free:
                right[k] -= self.paths[j].amplitude * both
            else:
                gram[:, k, j], gram[:, j, k] = both, both.conj()
        solved = [np.linalg.lstsq(g, r, rcond=1e-9)[0] for g, r in zip(gram, right.T, strict=True)]
        for k, amplitude in enumerate(np.array(solved).T):
            self.paths[k] = replace(self.paths[k], amplitude=amplitude)

    def step(self, active: np.ndarray) -> np.ndarray:
        """One step of the clusters of some free paths; (free,) bool, whom it leaves unsettled."""
        gradient, gram = self._equations(active)
        noise, moved = self.noise, np.zeros(self.free)
        self.power = np.array([(np.abs(p.amplitude) ** 2 @ self.samples) for p in self.paths])
        self.coupled = self._coupled(max(noise, self.moments.noise))
        for g in np.unique(self.group[active]):
            mine = np.flatnonzero(self.group == g)
            told = (mine[:, None] * self.size + np.flatnonzero(self.told)).ravel()
            covariance = np.linalg.inv(gram[np.ix_(told, told)])
            steps = np.zeros((self.free, self.size))
            steps.flat[told] = covariance @ gradient[told]
            steps = steps[mine]
            self.deviation.flat[told] = np.sqrt(np.maximum(np.diag(covariance), 0) * noise / 2)
            moved[mine] = (np.abs(steps) / np.maximum(self.deviation[mine], 1e-300)).max(axis=1)
            share = self._within_reach(mine, steps[:, :PARAMETERS] / LARGEST_STEP)
            self._move(mine, share * steps)
        self.stirred[active] = 0
        self.stirred += (
            TANGENTS * (self.share[:, : self.free] * self.coupled[:, : self.free]) @ moved
        )
        return (moved > SETTLED) | (self.stirred > MAX_DRIFT)

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
        self._refresh()
        total = self.size * self.free
        gram, amplitude = np.zeros((total, total)), self._amplitudes()
        left, slopes = self.seen.copy(), self._slopes(amplitude)
        near, far = self._pairs(active)
        self._take_out(left, far, cross_sums(self.tones, far, self._fewer, 2), amplitude)
        seen = left[:, 0, 0].copy()
        sums = cross_sums(self.tones, near, self.weights)
        self._take_out(left, near, sums, amplitude)
        left[active] -= amplitude[active, None, None, :, None] * self.own[:2, :2]
        itself = np.broadcast_to(self.own, (active.size, *sums.shape[1:])).astype(complex)
        _put_blocks(gram, np.column_stack([active, active]), slopes, itself)
        _put_blocks(gram, near, slopes, sums)
        parts = left.reshape(self.free, 4, *left.shape[3:])
        gradient = np.einsum("ksbrt,kbrt->ks", slopes.conj(), parts, optimize=True).real.ravel()
        twice = self._by_amplitude(seen + left[:, 0, 0])
        for k in active:
            self.explained[k] = float((self.paths[k].amplitude.conj() @ twice[k]).real)
        return gradient, gram

    def _take_out(
        self, left: np.ndarray, pairs: np.ndarray, sums: np.ndarray, amplitude: np.ndarray
    ) -> None:
        """Take paths out of each other's sums, in place."""
        for (k, j), both in zip(pairs.tolist(), sums[:, :2, :2], strict=True):
            left[k] -= amplitude[j, :, None] * both
            if j < self.free:
                left[j] -= amplitude[k, :, None] * both.conj()

    def _pairs(self, active: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Active paths with each one that they feel, (Q, 2), each pair of free ones once: those of
        a cluster, and the others."""
        of, at = np.nonzero(self.coupled)
        acts = np.isin(np.arange(len(self.paths)), active)
        used = acts[of] & ((at < of) | ~acts[at])
        of, at = of[used], at[used]
        group = np.append(self.group, np.full(len(self.paths) - self.free, -1))
        same, pairs = group[of] == group[at], np.column_stack([of, at])
        return pairs[same], pairs[~same]

    def _slopes(self, amplitude: np.ndarray) -> np.ndarray:
        """(free, S, 4, L_tx, L_rx) derivatives of the signals over the unit tones, as factors of
        1, t, n and n t, by the scaled parameters and both parts of the amplitudes."""
        tones, free, num_tx = self.tones, self.free, amplitude.shape[1]
        shape = free, self.size, 4, num_tx, self.known.antennas.num_rx
        out = np.zeros(shape, complex)
        factor = 2j * np.pi * amplitude[:free, None, :, None] * self.levers[:free]
        carrier = tones.middle[:free, None, None, None]
        for i in range(PARAMETERS):
            at = 1 if i == 1 else 0  # the delay rate moves the delay by t
            out[:, i, at] = factor[:, i] * carrier[:, 0]
            out[:, i, at + 2] = factor[:, i] * (tones.slope * tones.interval)
        out[:, 1, 2] = factor[:, 1] * carrier[:, 0] * tones.interval
        for i in range(self.count):
            mine = np.ones((num_tx, 1)) if self.count == 1 else np.arange(num_tx)[:, None] == i
            out[:, PARAMETERS + 2 * i, 0] = mine
            out[:, PARAMETERS + 2 * i + 1, 0] = 1j * mine
        return out

    def _move(self, mine: np.ndarray, moves: np.ndarray) -> None:
        """Let some paths take their steps. The phase turns by 128 cycles per cell of delay: the
        amplitude follows that turn, and not its tangent."""
        sent, late = self.own[0, 0, :, 0], self.own[0, 1, :, 0] / self.own[0, 0, :, 0]
        levers = self.levers[mine].mean(axis=3)
        levers[:, 1] *= late
        if self.count == 1:
            levers = (levers @ sent / sent.sum())[..., None]
        change, pairs = moves[:, :PARAMETERS], moves[:, PARAMETERS:].reshape(len(mine), -1, 2)
        angle = 2 * np.pi * self.tones.middle[mine, None] * (change[:, None] @ levers)[:, 0]
        more = pairs @ np.array([1, 1j])
        moves = change * units(self.known)
        for i, k in enumerate(mine.tolist()):
            path, move = self.paths[k], moves[i]
            amplitude = path.amplitude * (1 + 1j * angle[i]) + more[i]
            self.paths[k] = replace(
                path,
                delay=path.delay + float(move[0]),
                delay_rate=path.delay_rate + float(move[1]),
                direction=path.direction + move[2:],
                amplitude=amplitude * np.exp(-1j * angle[i]),
            )
        self.stale[mine] = True

    def _refresh(self) -> None:
        """Read the samples where paths have moved."""
        moved = np.flatnonzero(self.stale)
        if moved.size:
            tones, self.levers[moved] = Tones.of(self.known, [self.paths[k] for k in moved])
            self.seen[moved] = self.moments.of(tones, self._fewer)
            self.tones.put(moved, tones)
        self.stale[:] = False

    def fit(self) -> Fit:
        """The free paths with their deviations."""
        unit = units(self.known)
        paths = [
            replace(p, std=std[:PARAMETERS] * unit)
            for p, std in zip(self.paths[: self.free], self.deviation, strict=True)
        ]
        return Fit(paths, self.noise * self.moments.size)


def _put_blocks(gram: np.ndarray, pairs: np.ndarray, slopes: np.ndarray, sums: np.ndarray) -> None:
    """Put the products of two paths' derivatives over all samples into the Gram matrix, for each
    pair and turned round; `slopes` as `_Descent._slopes`, `sums` as `cross_sums`."""
    size, part = slopes.shape[1], np.arange(4)
    n, t = part // 2, part % 2  # powers of the sample and of time that a part of a slope has
    both = sums[:, n[:, None] + n, t[:, None] + t]
    for (k, j), products in zip(pairs.tolist(), both, strict=True):
        block = np.einsum(
            "iaxr,abxr,nbxr->in", slopes[k].conj(), products, slopes[j], optimize=True
        ).real
        rows, columns = slice(k * size, (k + 1) * size), slice(j * size, (j + 1) * size)
        gram[rows, columns], gram[columns, rows] = block, block.T


def energy(known: Known, paths: Sequence[JointPath]) -> float:
    """Energy of the sum of a few paths over the samples of a frame."""
    tones, weights = Tones.of(known, paths)[0], powers_of_time(known, 1)
    num_tx = known.antennas.num_tx
    wave = np.array([np.broadcast_to(p.amplitude, num_tx) for p in paths])
    of, at = np.tril_indices(len(paths), -1)
    both = cross_sums(tones, np.column_stack([of, at]), weights, 1)[:, 0, 0].sum(axis=-1)
    sums = own_sums(float(known.waveform.num_samples), weights, 1)[0, 0, :, 0]
    alone = (np.abs(wave) ** 2 @ sums).sum() * known.antennas.num_rx
    return float(alone + 2 * (wave[of].conj() * wave[at] * both).sum().real)


def residual_channels(
    moments: Moments, fitted: Fit, beside: Sequence[JointPath], offsets: np.ndarray
) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Return what the paths of a fit leave at some places, channel by channel.

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
    known, num = moments.known, len(fitted.paths)
    w, num_tx = known.waveform, known.antennas.num_tx
    # a bin is one turn per frame
    back = np.exp(-2j * np.pi * offsets[:, None, None] * known.sampled_times / w.frame_duration)
    weights = Weights.by_antenna(known, back)
    sent = np.array([mine.sum() for mine in known.sent_by]) * w.num_samples
    counts = (sent if known.passes == 1 else np.array([sent.sum()])) * known.antennas.num_rx
    power = np.array([(np.abs(p.amplitude) ** 2 * counts).sum() for p in fitted.paths])
    share = shared(known, cell_positions(known, fitted.paths), cell_positions(known, beside))
    at, of = np.nonzero(~ignored(share, power / moments.noise))
    tones = Tones.of(known, [*fitted.paths, *beside])[0]
    left = moments.of(tones.select(slice(num, None)), weights)[:, 0]
    sums = cross_sums(tones, np.column_stack([num + at, of]), weights, 1)[:, 0]
    for i, j, both in zip(at, of, sums, strict=True):
        left[i] -= np.broadcast_to(fitted.paths[j].amplitude, num_tx)[:, None] * both
    for channels in left:
        yield channels / np.sqrt(sent)[:, None], counts
