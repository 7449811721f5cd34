r"""Scatterers merged, link by link, where noise covers them.

A range-Doppler cell that holds C times its noise in clutter shows an error of the clutter as the
share C/(1 + C) of it. So the area that one scatterer may stand for grows where C is small: the
error of a cell's clutter grows with area^(3/4) (`cells.area_for`), and that of noise plus clutter
stays what `clutter.max_error_db` allows as long as

.. math:: A \le A_0\,((1 + C)/C)^{4/3},

A_0 the area that the surface is cut to. That says how the clutter is spread over cells on average;
a cell with n scatterers at random errs by the share 1/sqrt(n) of C, so that none may hold more
than s(1 + C)^2/C of the noise, nor more than q(1 + C), since a faint cell with one scatterer
instead of many shows all of it or nothing; s and q go with the square of the error allowed. They
are set for a street whose clutter lies about the noise, the worst there is: a link takes up to six
times of both where nine of ten of its range-Doppler cells keep the error all the same at every
instant, and nine of ten of those whose clutter is over the noise. Nor does one scatterer hold more
than a sixth of a cell's clutter where that is over the noise: fewer would fix the cell's level by a
single draw.

The two halves of a cell merge while their joint area keeps the least of these limits over all
scatterers that they hold and all instants of the run. What is merged has the coherent sum of the
halves' amplitudes, weighted by the roots of their areas, which is Gaussian of unit power again, and
the place of one of them, drawn by area: its mean power is that of both wherever shadows fall. Each
link has one such cut for the whole run, so that nothing jumps.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from typing import NamedTuple

import numpy as np

from isac_rt.frame.antennas import Antennas
from isac_rt.frame.link import Link
from isac_rt.frame.waveform import Waveform
from isac_rt.propagation.clutter.cells import Cells

FEWEST = 6
"""Scatterers of a cell whose clutter is over the noise."""
ALL_ERR = 4.0
"""s over the square of the error that nine of ten cells keep to: what merges stays near, mostly in
the same cell."""
ONE_ERRS = 42.0
"""q over the square of the error: most cells are faint."""
EASED = (6.0, 3.0, 2.0, 1.0)
"""Times of s and q that are tried in turn; the last is taken unseen."""


@dataclass(frozen=True)
class NoiseFloor:
    """The noise that covers faint clutter, at instants of a run.

    Attributes
    ----------
    waveform, antennas : of the run
    longest_delay : of a path that is received at all [s]
    times : (K,) rising [s]
    over_noise : by link (K,) the power of a path over the noise of a range-Doppler cell, per power
        gain; 0 where the link is not received
    """

    waveform: Waveform
    antennas: Antennas
    longest_delay: float
    times: np.ndarray
    over_noise: Mapping[Link, np.ndarray]

    def record(self) -> str:
        """All of it, as text."""
        links = {str(link): factors.tolist() for link, factors in self.over_noise.items()}
        instruments = asdict(self.waveform), asdict(self.antennas)
        return json.dumps([*instruments, self.longest_delay, self.times.tolist(), links])


def resolution_cell(waveform: Waveform, delay: np.ndarray, rate: np.ndarray) -> np.ndarray:
    """(K,) int64 number of the range-Doppler cell in which paths of these delays [s] and delay
    rates are seen; velocities alias."""
    w = waveform
    beat = np.rint(w.slope * delay * w.sampled_duration).astype(np.int64)
    turns = np.rint(w.effective_carrier * rate * w.frame_duration).astype(np.int64)
    return beat * w.num_chirps + turns % w.num_chirps


class VisibleCells(NamedTuple):
    """Scatterers as a link receives them at one instant.

    Attributes
    ----------
    which : (K,) of those that are received
    power : (K,) mean power over the noise of a range-Doppler cell
    cell : (K,) int from 0 in which each is seen
    """

    which: np.ndarray
    power: np.ndarray
    cell: np.ndarray


def merged_below_noise(
    cells: Cells, visible: Sequence[VisibleCells], finest: np.ndarray, error_db: float
) -> Cells:
    """Merge a link's scatterers as far as noise covers the error.

    Parameters
    ----------
    visible : at the instants that show how the run changes
    finest : (N,) area to which the surface is cut at each of the N cells [m^2]
    error_db : of noise plus clutter that nine of ten range-Doppler cells keep to
    """
    for eased in EASED:
        limit = np.full(len(cells), np.inf)
        for some in visible:
            area = allowed_area(some, cells.area, finest, 10 ** (error_db / 10) - 1, eased)
            limit[some.which] = np.minimum(limit[some.which], area)
        place, left = merge(cells, limit)
        times = np.zeros(len(cells))
        times[place] = left.area / cells.area[place]
        if eased == EASED[-1] or _within(error_db, times, visible):
            break
    return left


def _within(error_db: float, times: np.ndarray, visible: Sequence[VisibleCells]) -> bool:
    """Return whether nine of ten range-Doppler cells keep an error at every instant, among all and
    among those whose clutter is over the noise, if scatterers (N,) represent multiples of their
    power."""
    for which, power, cell in visible:
        every, left = np.bincount(cell, power), np.bincount(cell, power * times[which])
        held = np.flatnonzero(every)
        error, loud = apart_db(every[held], left[held]), every[held] > 1
        if any(np.quantile(e, 0.9) > error_db for e in (error, error[loud]) if e.size):
            return False
    return True


def apart_db(one: np.ndarray, other: np.ndarray) -> np.ndarray:
    """Return the difference of noise plus clutter between two clutters over the noise [dB]."""
    return np.abs(10 * np.log10((1 + other) / (1 + one)))


def allowed_area(
    visible: VisibleCells, area: np.ndarray, finest: np.ndarray, error: float, eased: float
) -> np.ndarray:
    """Largest areas that scatterers may stand for at one instant.

    Parameters
    ----------
    area : (N,) that each stands for [m^2]
    finest : (N,) to which the surface is cut there [m^2]
    error : of noise plus clutter that is allowed, as a share
    eased : times that s and q are taken

    Returns
    -------
    area : (K,) of those that are received [m^2]
    """
    which, power, cell = visible
    clutter = np.bincount(cell, power)[cell]
    over = (1 + clutter) / clutter
    most = eased * error**2 * (1 + clutter) * np.minimum(ONE_ERRS, ALL_ERR * over)
    most = np.where(clutter > 1, np.minimum(most, clutter / FEWEST), most)
    return np.minimum(finest[which] * over ** (4 / 3), area[which] * most / power)


def merge(cells: Cells, limit: np.ndarray) -> tuple[np.ndarray, Cells]:
    """Cells whose halves are merged, again and again, while their area keeps to a limit.

    Parameters
    ----------
    limit : (N,) area that what holds each of the N cells may have [m^2]

    Returns
    -------
    place : (M,) which of the N cells each that is left stands in the place of
    cells : M that are left
    """
    halvings = np.frexp(cells.code.astype(float))[1] - 1
    along = cells.code << (62 - halvings).astype(np.uint64)
    order = np.lexsort([along, cells.face])
    some = cells.select(order)
    found = merged(
        some.face, some.code, halvings[order], some.area, some.amplitude, some.clock, limit[order]
    )
    place, area, amplitude = found
    out = some.select(place)
    return order[place], replace(
        out, area=area.astype(np.float32), amplitude=amplitude.astype(np.complex64)
    )


def merged(
    face: np.ndarray,
    code: np.ndarray,
    halvings: np.ndarray,
    area: np.ndarray,
    amplitude: np.ndarray,
    clock: np.ndarray,
    limit: np.ndarray,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Merge the halves of cells (N,), the finest first, while their area keeps to the least limit.

    The half whose exponential clock of a rate in proportion to its area rings first stands for
    both; amplitudes add, weighted by the roots of the areas. What does not merge is left, and so is
    what would merge with it.

    Returns
    -------
    place, area, amplitude : (M,) of what is left, as each is known to be left in a walk through the
        faces: by the last cell of what held it, the finest first
    """
    every = np.arange(len(area))
    sums = (np.sqrt(area) * amplitude).astype(complex)
    nodes = [face, code, every, area.astype(float), limit, sums, every]
    waiting, left = [part[:0] for part in nodes], []
    for level in range(halvings.max(initial=0), -1, -1):
        waiting = [
            np.append(w, part[halvings == level]) for w, part in zip(waiting, nodes, strict=True)
        ]
        order = np.lexsort(waiting[1::-1])
        faces, name, place, size, most, total, last = (part[order] for part in waiting)
        half = name >> np.uint64(1)
        one = np.flatnonzero((faces[1:] == faces[:-1]) & (half[1:] == half[:-1]) & (level > 0))
        other, least = one + 1, np.minimum(most[one], most[one + 1])
        both = size[one] + size[other]
        joins = (place[one] >= 0) & (place[other] >= 0) & (both <= least)
        apart = np.stack([one, other], axis=1)[~joins].ravel() if level else np.arange(len(name))
        last[one] = last[other]
        left.append([part[apart] for part in (last, place, size, total)] + [apart * 0 - level])
        first = np.where(clock[place[other]] < clock[place[one]], place[other], place[one])
        place[one], size[one], most[one] = np.where(joins, first, -1), both, least
        total[one] += total[other]
        kept = np.setdiff1d(np.arange(len(name)), other)
        waiting = [part[kept] for part in (faces, half, place, size, most, total, last)]
    last, place, size, total, fine = (np.concatenate(part) for part in zip(*left, strict=True))
    order = np.lexsort([fine, last])
    order = order[place[order] >= 0]
    return place[order], size[order], total[order] / np.sqrt(size[order])
