"""Schedules of TDM-MIMO (which antenna sends when), and the codes of antennas that send at once."""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from scipy.linalg import hadamard

from isac_rt.frame.waveform import Waveform

Schedule = np.ndarray
"""(num_groups, num_chirps) int: the transmit antenna that each group uses in each slot."""


def conventional_schedule(num_groups: int, num_chirps: int, num_tx: int) -> Schedule:
    """Round robin; group m starts at antenna m (schemes (a) and (c) of Fig. 5)."""
    m, p = np.arange(num_groups)[:, None], np.arange(num_chirps)[None, :]
    return _frozen((p + m) % num_tx)


def pseudo_random_schedule(
    num_groups: int, num_chirps: int, num_tx: int, rng: np.random.Generator
) -> Schedule:
    """In each cycle of num_tx slots every group uses every antenna once, in random order, and no
    two groups use one antenna in the same slot: a random Latin rectangle (schemes (b) and (d) of
    Fig. 5)."""
    cycles = num_chirps // num_tx
    out = np.empty((num_groups, cycles, num_tx), dtype=np.int64)
    base = (np.arange(num_tx)[:, None] + np.arange(num_tx)[None, :]) % num_tx
    for c in range(cycles):
        square = base[rng.permutation(num_tx)][:, rng.permutation(num_tx)]
        out[:, c] = rng.permutation(num_tx)[square][:num_groups]
    return _frozen(out.reshape(num_groups, -1))


def is_latin(schedule: Schedule, num_tx: int) -> bool:
    """Return whether no slot uses an antenna twice (then, with M = num_tx, the union of the groups
    samples every antenna in every slot)."""
    ordered = np.sort(schedule, axis=0)
    return bool((ordered[1:] > ordered[:-1]).all() and schedule.max() < num_tx)


def schedule_of(kind: str, waveform: Waveform, rng: np.random.Generator) -> Schedule:
    """The antenna schedule of a kind (``array.schedule``); zeros where all send at once."""
    w = waveform
    if w.scheme != "tdm":
        return _frozen(np.zeros((1, w.num_chirps), np.int64))
    if kind == "conventional":
        return conventional_schedule(w.num_groups, w.num_chirps, w.num_tx)
    return pseudo_random_schedule(w.num_groups, w.num_chirps, w.num_tx, rng)


@lru_cache(maxsize=16)
def codes_of(waveform: Waveform) -> np.ndarray | None:
    r"""(L_tx, P) complex128: what each antenna multiplies its chirps by where all send at once;
    None where they take turns.

    With B bands antenna a sends :math:`e^{j 2\pi a p / B}` ("ddm": its echoes lie a/B of the span
    of velocities higher) or a row of a Hadamard matrix of size B, over and over ("bpm"). Two codes
    are orthogonal over every B chirps.
    """
    w = waveform
    if w.scheme == "tdm":
        return None
    antenna, chirp = np.arange(w.num_tx)[:, None], np.arange(w.num_chirps)[None, :]
    if w.scheme == "ddm":
        return _frozen(np.exp(2j * np.pi * (antenna * chirp % w.bands) / w.bands))
    rows = np.array(_hadamard_rows(w.num_tx, w.bands))[:, None]
    return _frozen(hadamard(w.bands)[rows, chirp % w.bands].astype(complex))


@lru_cache(maxsize=16)
def _hadamard_rows(num_tx: int, size: int) -> tuple[int, ...]:
    """Rows of Sylvester's matrix, one after the other so that the strongest image stays weakest.

    The product of rows i and j is row i ^ j, and an antenna's echoes appear in another's channel by
    the lines of that row.
    """
    lines = np.abs(np.fft.fft(hadamard(size), axis=1) / size) ** 2
    rows, image = [0], np.zeros(size)
    left = list(range(1, size))
    for _ in range(num_tx - 1):
        added = [image + 2 * lines[[r ^ s for s in rows]].sum(axis=0) for r in left]
        best = int(np.argmin([row.max().round(9) for row in added]))
        rows.append(left.pop(best))
        image = added[best]
    return tuple(rows)


def leaks(waveform: Waveform) -> np.ndarray:
    """(B, L_tx, L_tx) amplitude by which the channel of an antenna (axis 1) shows the echo of each
    one (axis 2) so many B-th parts of the span of velocities above its own, of antennas that send
    at once; B = 1 where they take turns."""
    codes = codes_of(waveform)
    if codes is None:
        return np.eye(waveform.num_tx)[None]
    period = codes[:, : waveform.bands]
    lines = np.fft.fft(period * period[:, None].conj(), axis=-1) / waveform.bands
    return np.moveaxis(lines, -1, 0)


def images(waveform: Waveform) -> np.ndarray:
    """(B,) power of a path on the map that is added over all channels, in each of the B bands, over
    that of one channel in the right one: L_tx in band 0, and less in the others unless velocities
    are ambiguous."""
    return np.asarray((np.abs(leaks(waveform)) ** 2).sum(axis=(1, 2)))


def unambiguous_share(waveform: Waveform) -> float:
    """Share of the velocities of one chirp in each slot that a plain radar tells apart: all, or one
    band where another is as strong; 1 / L_tx where antennas take turns; 1 where there are data."""
    w = waveform
    if w.carries_data:
        return 1.0
    if w.scheme == "tdm":
        return 1.0 / w.num_tx
    alike = np.flatnonzero(images(w) > w.num_tx - 1e-6)[1:]
    return float(alike[0]) / w.bands if alike.size else 1.0


def decoded_schedule(waveform: Waveform) -> Schedule:
    """The schedule of `Waveform.decoded`: group m holds the chirps of antenna m."""
    shape = waveform.num_tx, waveform.num_chirps
    return _frozen(np.broadcast_to(np.arange(waveform.num_tx)[:, None], shape).copy())


def _frozen(a: np.ndarray) -> np.ndarray:
    a.setflags(write=False)
    return a
