"""Paths as flat arrays of tones, the input of all methods of synthesis."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from isac_rt.frame.cube import ReceiveArray, Transmission
from isac_rt.frame.waveform import SPEED_OF_LIGHT, Waveform
from isac_rt.propagation.pathset import PathKind, PathSet

Links = Sequence[tuple[Transmission, PathSet]]
"""Transmissions, each with the paths from it to the receiver."""
NO_GAIN = np.zeros((0, 0), complex)
_CHUNK = 1024
"""Paths whose element delays fit into the second-level cache."""


class Tones(NamedTuple):
    """K paths of Q links as arrays for kernels. Times are in seconds from mid-frame.

    Attributes
    ----------
    link : (K,) int64
    is_los : (K,) bool, lines of sight
    power : (K,) received power [W]
    factor : (K,) complex128, conj(path gain)
    delay, rate, accel : (K,) float64, the clock of the transmitter included
    begin, end : (K,) interval in which the path exists [s]
    tx_delay, rx_delay : (K, L_tx), (K, L_rx) delay of each element [s]
    cross_row : (K,) int64 row of `cross`
    cross : (R, L_tx, L_rx) part of a delay that depends on both elements jointly [s]; row 0 is zero
    symbol_delay : (Q, M, P) delay of the data [s]
    send : (Q, M, P) complex128, amplitude times DPSK phase, zero where nothing is sent
    antenna : (Q, M, P) int64 transmit element
    tx_gain, rx_gain : (K, L_tx), (K, L_rx) complex128, gain of each path at an element;
        `NO_GAIN`: 1
    """

    link: np.ndarray
    is_los: np.ndarray
    power: np.ndarray
    factor: np.ndarray
    delay: np.ndarray
    rate: np.ndarray
    accel: np.ndarray
    begin: np.ndarray
    end: np.ndarray
    tx_delay: np.ndarray
    rx_delay: np.ndarray
    cross_row: np.ndarray
    cross: np.ndarray
    symbol_delay: np.ndarray
    send: np.ndarray
    antenna: np.ndarray
    tx_gain: np.ndarray = NO_GAIN
    rx_gain: np.ndarray = NO_GAIN

    @property
    def size(self) -> int:
        """K."""
        return self.delay.shape[0]

    def select(self, which: np.ndarray) -> Tones:
        """Select paths by a mask or an index array."""
        shared = ("cross", "symbol_delay", "send", "antenna")
        rows = np.flatnonzero(which) if np.asarray(which).dtype == bool else which
        return self._replace(
            **{
                name: v.take(rows, axis=0)
                for name, v in self._asdict().items()
                if name not in shared and v.shape != NO_GAIN.shape
            }
        )

    def sources(self, waveform: Waveform) -> tuple[np.ndarray, np.ndarray]:
        """Return the pairs of a path and a group offset m - m' that pass the filter in some chirp:
        indices of the paths and offsets, (C,) int64 each."""
        w, t = waveform, self
        half = w.frame_duration / 2 + w.chirp_duration + w.num_groups * w.group_spacing
        # largest change of the delay by motion and data, against the band of the filter
        motion = np.abs(t.rate) * half + np.abs(t.accel) * half**2 / 2
        longest = float(t.symbol_delay.max(initial=0.0))
        margin = w.filter_transition / w.slope
        paths, offsets = [], []
        for offset in range(1 - w.num_groups, w.num_groups):
            delay = t.delay - offset * w.group_spacing
            passes = (delay + motion + longest >= -margin) & (
                delay - motion <= w.max_delay + margin
            )
            paths.append(np.flatnonzero(passes))
            offsets.append(np.full(paths[-1].size, offset))
        return np.concatenate(paths), np.concatenate(offsets).astype(np.int64)

    def speed(self, duration: float) -> np.ndarray:
        """Return c/2 times the largest delay rate of each path in a frame (K,) [m/s]."""
        return (np.abs(self.rate) + np.abs(self.accel) * duration / 2) * (SPEED_OF_LIGHT / 2)


def tones_of(
    waveform: Waveform, links: Links, receiver: ReceiveArray, middle: float, first_block: int
) -> Tones:
    """Return the tones of all links at a receiver whose frame has its middle at `middle` [s] and
    whose reference chirps begin with resource block `first_block`."""
    w = waveform
    links = [(stream, paths) for sent, paths in links for stream in sent.streams()]
    rx = receiver.pose.to_world(receiver.antennas.rx_positions)
    num_tx = max((t.antennas.num_tx for t, _ in links), default=1)
    none, grid = np.zeros(0), (w.num_groups, w.num_chirps)
    parts = [
        dict.fromkeys(set(Tones._fields) - {"tx_gain", "rx_gain"}, none)
        | {"link": none.astype(np.int64), "cross_row": none.astype(np.int64)}
        | {"is_los": none.astype(bool), "factor": none.astype(complex)}
        | {"tx_delay": np.zeros((0, num_tx)), "rx_delay": np.zeros((0, len(rx)))}
        | {"cross": np.zeros((1, num_tx, len(rx))), "symbol_delay": np.zeros((0, *grid))}
        | {"send": np.zeros((0, *grid), complex), "antenna": np.zeros((0, *grid), np.int64)}
    ]
    rows = 1  # of `cross`
    for q, (t, s) in enumerate(links):
        tx = np.zeros((num_tx, 3))
        tx[: t.antennas.num_tx] = t.pose.to_world(t.antennas.tx_positions)
        is_los = s.kind == PathKind.LINE_OF_SIGHT
        near = np.flatnonzero(is_los & np.isfinite(s.rx_radius))
        row = np.zeros(len(s), np.int64)
        row[near] = rows + np.arange(near.size)
        rows += near.size
        # far-field or spherical delays of the elements; lines of sight jointly for both arrays
        tx_delay = element_delay(tx, s.departure, s.tx_radius)
        rx_delay = element_delay(rx, s.arrival, s.rx_radius)
        joint = _straight_delay(tx, rx, s.departure[near], s.rx_radius[near])
        # from the epoch of the paths to mid-frame
        later = middle - s.epoch
        moved = s.delay + (s.delay_rate + s.delay_accel * later / 2) * later
        parts.append(
            {
                "link": np.full(len(s), q, np.int64),
                "is_los": is_los,
                "power": t.amplitude**2 * s.power,
                "factor": s.gain.conj(),
                "delay": moved + t.clock_offset + (t.first_block - first_block) * w.group_spacing,
                "rate": s.delay_rate + s.delay_accel * later + t.clock_drift,
                "accel": s.delay_accel,
                "begin": s.begin - later,
                "end": s.end - later,
                "tx_delay": tx_delay,
                "rx_delay": rx_delay,
                "cross_row": row,
                "cross": joint - tx_delay[near, :, None] - rx_delay[near, None, :],
                "symbol_delay": t.payload.delay_symbols[None] * w.delay_step,
                "send": t.amplitude
                * t.payload.phases[None]
                * (1.0 if t.active is None else t.active),
                "antenna": np.array(t.schedule[None], np.int64),
            }
        )
    return Tones(**{name: np.concatenate([p[name] for p in parts]) for name in parts[0]})


def element_delay(elements: np.ndarray, direction: np.ndarray, radius: np.ndarray) -> np.ndarray:
    """Return (|R u - r| - R)/c, or -r.u/c for infinite R: (K, L) [s]. With x = r^2 - 2 R r.u this
    is x / (sqrt(R^2 + x) + R), without cancellation."""
    along = direction @ elements.T
    out = along * (-1 / SPEED_OF_LIGHT)
    square = (elements**2).sum(1)
    near = np.flatnonzero(np.isfinite(radius))
    for chunk in np.split(near, range(_CHUNK, near.size, _CHUNK)):
        far = radius[chunk, None]
        change = square - 2 * far * along[chunk]
        distance = far**2 + change
        np.sqrt(distance, out=distance)
        distance += far
        change /= distance
        change /= SPEED_OF_LIGHT
        out[chunk] = change
    return out


def _straight_delay(
    tx: np.ndarray, rx: np.ndarray, direction: np.ndarray, length: np.ndarray
) -> np.ndarray:
    """Return (|L d + r_rx - r_tx| - L)/c of straight paths (K, L_tx, L_rx) [s], written as in
    `element_delay`."""
    offset = rx[None, :] - tx[:, None]
    along = np.einsum("trx,kx->ktr", offset, direction)
    change = 2 * length[:, None, None] * along + (offset**2).sum(2)
    distance = np.sqrt(length[:, None, None] ** 2 + change)
    return change / (distance + length[:, None, None]) / SPEED_OF_LIGHT
