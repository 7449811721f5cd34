"""Antenna schedules of TDM-MIMO: which antenna sends in each group and slot."""

from __future__ import annotations

import numpy as np

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
    """Whether no slot uses an antenna twice (then, with M = num_tx, the union of the groups samples
    every antenna in every slot)."""
    return all(len(set(column)) == len(column) for column in schedule.T) and schedule.max() < num_tx


def schedule_of(kind: str, waveform: Waveform, rng: np.random.Generator) -> Schedule:
    """The antenna schedule of a kind (``array.schedule``)."""
    w = waveform
    if kind == "conventional":
        return conventional_schedule(w.num_groups, w.num_chirps, w.num_tx)
    return pseudo_random_schedule(w.num_groups, w.num_chirps, w.num_tx, rng)


def _frozen(a: np.ndarray) -> np.ndarray:
    a.setflags(write=False)
    return a
