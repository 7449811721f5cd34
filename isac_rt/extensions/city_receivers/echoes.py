r"""Paths of a passive terminal as waves, fitted together where they lie near each other.

A path that is taken out channel by channel takes all of its cell with it, the echoes beside a line
of sight 50 dB above them too. A wave comes from one direction and has few parameters; what it
leaves belongs to others. In row i of the cleaned spectra of receiver r, in a chirp of transmit
antenna t, wave k is

.. math:: s_{kt}\, a_r(u_k)\, \varphi_k\, h(b_k + d_{kt} + e_r - i)

with the receivers' steering a(u) and delays e, the phase :math:`\varphi_k` and the beat b_k of its
delay and delay rate, the transform h of the window, and the delays d of the transmit antennas,
which lie in a direction that the receiver does not know. Gauss-Newton steps on the weighted squares
of what is left move all waves of a cluster. Each tangent is a function of chirp and row times one
of the receiver, and so the normal equations are products of the two.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np
from scipy.sparse.csgraph import connected_components

from isac_rt.receive.arms import element_delays
from isac_rt.receive.estimate import HALF_WIDTH, Estimate, hann_response
from isac_rt.receive.joint.tones import rate_bin
from isac_rt.receive.known import Known
from isac_rt.receive.maps import slow_window
from isac_rt.receive.passive import SAME_PATH
from isac_rt.receive.pursuit import LEAST, add_template, lobes_over

LOBES = 4.0
"""Cells and bins within which the main lobes of two waves overlap."""
STEP = 1e-3
"""Of the differences that are the slope of the window's transform [cells]."""
ITERATIONS, SETTLED = 3, 3e-3
"""Most steps of a cluster, and the step that ends them [cells, bins, resolutions]."""
LARGEST = 0.3
"""Of one step [cells, bins, resolutions]."""
PRIOR = 0.5
"""Deviation of a start from the truth [cells, bins, resolutions]."""
PARTS = (1.0, 0.3)
"""Of a step, tried until less is left."""


@dataclass
class Wave:
    """A path from one direction.

    Attributes
    ----------
    delay, rate : at mid-frame [s, 1]
    cosines : (2,) u_x, u_z of arrival
    sent : (L_tx,) complex amplitudes of a sample
    late : (L_tx,) delays of the transmit antennas [cells], fitted of a strong one
    reach : range rows on each side in which it is taken out
    strong : whether the delays of the transmit antennas are fitted
    spread : (4,) deviations of delay, rate and cosines over those of the wave alone
    """

    delay: float
    rate: float
    cosines: np.ndarray
    sent: np.ndarray
    late: np.ndarray
    reach: int
    strong: bool = False
    spread: np.ndarray = field(default_factory=lambda: np.ones(4))


class _Tangents(NamedTuple):
    """Derivatives of a wave by its parameters.

    Attributes
    ----------
    by_chirp : (N, M rows P) complex, of each parameter
    receiver : (N,) which of the functions of the receiver goes with each
    by_receiver : (3, L_rx) the steering and its derivatives by both cosines
    """

    by_chirp: np.ndarray
    receiver: np.ndarray
    by_receiver: np.ndarray


class Waves:
    """Waves of a frame, and what they leave of it.

    Parameters
    ----------
    left : (M, L_rx, rows, P) cleaned spectra, from which waves are taken in place
    noise : mean power of a sample of the spectra
    beam : (2,) resolution of u_x and u_z, 0 on an axis that the receivers do not observe
    """

    def __init__(self, left: np.ndarray, known: Known, noise: float, beam: np.ndarray) -> None:
        self.waves: list[Wave] = []
        self.left, self._changed = left, np.zeros(left.shape[2], bool)
        self._known, self._noise, self._beam = known, noise, beam
        self._axes = np.flatnonzero(beam > 0)
        self._schedule = np.array(known.schedule, order="C")
        self._weight = np.sqrt(slow_window(known.waveform)).astype(float)

    def wave(self, e: Estimate, cosines: np.ndarray, power: float, *, strong: bool) -> Wave:
        """Return the wave from a direction in the channels of an estimate, whose peak has such a
        power over the noise."""
        a = self._steering(e.delay, cosines)[0][0]
        sent, reach = e.channels @ a.conj() / a.size, lobes_over(power / LEAST)
        late = np.zeros(sent.size)
        return Wave(e.delay, e.delay_rate, np.array(cosines), sent, late, reach, strong)

    def estimate(self, wave: Wave) -> Estimate:
        """Return a wave as an estimate."""
        a = self._steering(wave.delay, wave.cosines)[0][0]
        return Estimate(wave.delay, wave.rate, np.outer(wave.sent, a))

    def place(self, wave: Wave) -> np.ndarray:
        """Return beat [cells] and Doppler [bins] of a wave at mid-frame."""
        w = self._known.waveform
        beat = float(w.beat_cells(wave.delay, wave.rate, 0.0))
        return np.array([beat, wave.rate / rate_bin(w)])

    def apart(self, places: np.ndarray, others: np.ndarray) -> np.ndarray:
        """Return the separation (..., 2) of places in cells and bins, which wrap."""
        size, off = self._known.waveform.num_chirps, np.abs(places - others)
        off[..., 1] = np.minimum(off[..., 1] % size, -off[..., 1] % size)
        return off

    def holds(self, wave: Wave) -> bool:
        """Return whether another of the waves is the same path."""
        for other in self.waves:
            off = self.apart(self.place(other), self.place(wave)).max()
            turned = np.abs(other.cosines - wave.cosines)[self._axes] / self._beam[self._axes]
            if other is not wave and off < SAME_PATH[0] and turned.max(initial=0.0) < SAME_PATH[1]:
                return True
        return False

    def changed_rows(self) -> np.ndarray:
        """Return the rows that have changed since the last call."""
        rows, self._changed[:] = np.flatnonzero(self._changed), False
        return rows

    def take_out(self, waves: list[Wave]) -> None:
        """Add waves, take them out of the spectra, and fit what they touch."""
        self.waves += waves
        for wave in waves:
            self._add(wave, -1.0)
        places = np.array([self.place(wave) for wave in self.waves]).reshape(-1, 2)
        near = (self.apart(places[:, None], places) < LOBES).all(axis=2)
        number = connected_components(near, directed=False)[1]
        for group in np.unique(number[len(self.waves) - len(waves) :]):
            mine = [self.waves[k] for k in np.flatnonzero(number == group)]
            if len(mine) > 1 or mine[0].strong:
                self._fit(mine)

    def put_back(self, wave: Wave) -> None:
        """Undo a wave."""
        self.waves = [other for other in self.waves if other is not wave]
        self._add(wave, 1.0)

    def _rows(self, wave: Wave) -> tuple[int, int]:
        """Return the range [first, last) of a wave's rows."""
        middle, size = round(self.place(wave)[0]), self.left.shape[2]
        return min(max(middle - wave.reach, 0), size), max(min(middle + wave.reach + 1, size), 0)

    def _steering(self, delay: float, cosines: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the functions of the receiver of `_Tangents`, and the receivers' delays
        [cells]."""
        known, w = self._known, self._known.waveform
        late, slopes = element_delays(known.antennas.rx_positions, cosines, known.radius(delay))
        turn = 2j * np.pi * w.effective_carrier
        a = np.exp(turn * late)
        return np.stack([a, *(turn * self._beam[:, None] * slopes * a)]), late / w.delay_step

    def _cycles(self, wave: Wave) -> np.ndarray:
        w = self._known.waveform
        return w.phase(wave.delay + wave.rate * self._known.times, w.window_middle)

    def _add(self, wave: Wave, sign: float) -> None:
        """Add a wave times `sign` to the spectra."""
        w, rows = self._known.waveform, self._rows(wave)
        at_receivers, late = self._steering(wave.delay, wave.cosines)
        beat = w.beat_cells(wave.delay, wave.rate, self._known.times)
        phasor = np.exp(2j * np.pi * self._cycles(wave))
        window = float(w.window_length), float(w.num_samples)
        channels = sign * np.outer(wave.sent, at_receivers[0])
        add_template(
            self.left, rows, channels, self._schedule, beat, phasor, wave.late, late, window
        )
        self._changed[slice(*rows)] = True

    def _fit(self, waves: list[Wave]) -> None:
        """Move the waves of a cluster to where they leave least."""
        middles = np.array([round(self.place(wave)[0]) for wave in waves])
        rows = np.unique(middles[:, None] + np.arange(-HALF_WIDTH, HALF_WIDTH + 1))
        rows = rows[(rows >= 0) & (rows < self.left.shape[2])]
        step = np.inf
        for _ in range(ITERATIONS if rows.size else 0):
            if step < SETTLED:
                break
            left = self.left[:, :, rows] * self._weight
            tangents = [self._tangents(wave, rows) for wave in waves]
            moves, spreads = self._solved(tangents, left)
            before, energy = [replace(wave) for wave in waves], (np.abs(left) ** 2).sum()
            for part in PARTS:
                step = 0.0
                for wave, move in zip(waves, moves, strict=True):
                    self._add(wave, 1.0)
                    step = max(step, self._move(wave, part * move))
                    self._add(wave, -1.0)
                left = self.left[:, :, rows] * self._weight
                if (np.abs(left) ** 2).sum() <= energy:
                    for wave, spread in zip(waves, spreads, strict=True):
                        wave.spread = spread
                    break
                for wave, old in zip(waves, before, strict=True):
                    self._add(wave, 1.0)
                    vars(wave).update(vars(old))
                    self._add(wave, -1.0)
                step = 0.0

    def _tangents(self, wave: Wave, rows: np.ndarray) -> _Tangents:
        """Return the derivatives by both parts of each amplitude, by the delays [cells] of all
        antennas or of each, the rate [bins] and the cosines [resolutions]."""
        known, w, times = self._known, self._known.waveform, self._known.times
        beat = w.beat_cells(wave.delay, wave.rate, times)
        faster = w.beat_cells(wave.delay, wave.rate + rate_bin(w), times) - beat
        offset = (beat + wave.late[self._schedule])[:, None] - rows[:, None]
        back = np.exp(-1j * np.pi * rows[:, None] * w.window_length / w.num_samples)
        phasor = np.exp(2j * np.pi * self._cycles(wave))[:, None] * back * self._weight
        unit = phasor * hann_response(w, offset)
        ahead, behind = (hann_response(w, offset + step) for step in (STEP, -STEP))
        sent, by_antenna = wave.sent[self._schedule][:, None], [m[:, None] for m in known.sent_by]
        later = sent * phasor * (ahead - behind) / (2 * STEP)
        turn = 2j * np.pi * rate_bin(w) * w.effective_carrier * times[:, None]
        parts = [unit * mine * factor for mine in by_antenna for factor in (1, 1j)]
        parts += [later * mine for mine in by_antenna] if wave.strong else [later]
        parts += [turn * sent * unit + faster[:, None] * later]
        receiver = np.append(np.zeros(len(parts), int), 1 + self._axes)
        parts += [sent * unit] * (receiver.size - len(parts))
        by_chirp = np.array(parts).reshape(len(parts), -1)
        return _Tangents(by_chirp, receiver, self._steering(wave.delay, wave.cosines)[0])

    def _solved(
        self, tangents: list[_Tangents], left: np.ndarray
    ) -> tuple[list[np.ndarray], list[np.ndarray]]:
        """Return each wave's step of least squares, and its `spread`."""
        f = np.concatenate([t.by_chirp for t in tangents])
        g = np.concatenate([t.by_receiver[t.receiver] for t in tangents])
        each = np.concatenate([t.by_receiver for t in tangents])
        before = np.cumsum([0, *(len(t.by_receiver) for t in tangents)])
        number = np.concatenate([n + t.receiver for n, t in zip(before, tangents, strict=False)])
        seen = np.einsum("br,mrip->bmip", each.conj(), left, optimize=True).reshape(len(each), -1)
        matched = np.einsum("nk,nk->n", f.conj(), seen[number]).real
        gram = ((f.conj() @ f.T) * (g.conj() @ g.T)).real
        amplitudes = 2 * self._known.antennas.num_tx
        free = [np.arange(len(t.receiver)) < amplitudes for t in tangents]
        prior = np.where(np.concatenate(free), 0.0, self._noise / PRIOR**2)
        gram += np.diag(prior + 1e-9 * np.diag(gram))
        inverse = np.linalg.inv(gram)
        steps, ends = inverse @ matched, np.cumsum([0, *(len(t.receiver) for t in tangents)])
        moves, spreads = [], []
        for t, (first, last) in zip(tangents, itertools.pairwise(ends), strict=True):
            mine = slice(first, last)
            alone = np.diag(np.linalg.inv(gram[mine, mine]))
            wider = np.sqrt(np.maximum(np.diag(inverse)[mine] / alone, 1.0))
            turns, spread = np.flatnonzero(t.receiver), np.ones(4)
            rate = len(wider) - len(turns) - 1
            spread[0], spread[1] = wider[amplitudes:rate].max(), wider[rate]
            spread[1 + t.receiver[turns]] = wider[turns]
            moves.append(steps[mine])
            spreads.append(spread)
        return moves, spreads

    def _move(self, wave: Wave, move: np.ndarray) -> float:
        """Move a wave; return the largest step [cells, bins, resolutions]. The phase turns by 128
        cycles per cell of delay: the amplitudes follow."""
        w, size, before = self._known.waveform, wave.sent.size, self._cycles(wave)
        sent = wave.sent + move[: 2 * size : 2] + 1j * move[1 : 2 * size : 2]
        rest = np.clip(move[2 * size :], -LARGEST, LARGEST)
        late, rest = np.split(rest, [size if wave.strong else 1])
        late = wave.late + late
        wave.late = late - late.mean()
        wave.delay += float(late.mean()) * w.delay_step
        wave.rate += float(rest[0]) * rate_bin(w)
        u = wave.cosines.copy()
        u[self._axes] += rest[1:] * self._beam[self._axes]
        wave.cosines = u / max(float(np.linalg.norm(u)), 1.0)
        turned = np.exp(2j * np.pi * (self._cycles(wave) - before))
        by_antenna = np.array([turned[mine].mean() for mine in self._known.sent_by])
        wave.sent = sent * np.exp(-1j * np.angle(by_antenna))
        return float(np.abs(move[2 * size :]).max())
