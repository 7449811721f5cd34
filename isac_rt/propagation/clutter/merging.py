r"""Merging of scatterers below the noise, link by link.

Let C be the clutter-to-noise ratio of a range-Doppler cell. A relative error of its clutter is an
error of C/(1 + C) times that of noise plus clutter. Three limits keep the latter within
`clutter.max_error_db`, e as a share:

1. Distribution over cells. The error of a cell's clutter grows as area^(3/4) (`cells.area_for`), so
   one scatterer may represent the area

.. math:: A \le A_0\,((1 + C)/C)^{4/3},

   A_0 the area without merging.
2. Random power. With n scatterers the clutter varies by 1/sqrt(n): the power of one over the noise
   is at most s (1 + C)^2/C, and at most q (1 + C) in faint cells, with s and q proportional to e^2.
   Both are set for clutter near the noise, the worst case; a link uses up to six times of both if
   the 90th percentile of the errors stays within e at all instants.
3. Speckle. Where C > 1, one scatterer holds at most C/6.

Two halves of a cell merge while their joint area is within the least limit of all scatterers that
they hold, at all instants of the run. The amplitude of the merged scatterer is the coherent sum,
weighted by the roots of the areas, which is Gaussian of unit power again. Its position is that of
one half, drawn by area, so the mean power is right behind shadow edges too. A link is merged once
for the whole run, without jumps between frames.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from typing import NamedTuple

import numpy as np

from isac_rt.frame.antennas import Arrays
from isac_rt.frame.link import Link
from isac_rt.frame.waveform import Waveform
from isac_rt.propagation.clutter.cells import Cells

FEWEST = 6
"""Least number of scatterers in a cell with clutter over the noise."""
GROUP_LIMIT = 4.0
"""s / e^2; merged scatterers are neighbours, mostly in one cell."""
SINGLE_LIMIT = 42.0
"""q / e^2; most cells are faint."""
LIMIT_FACTORS = (6.0, 3.0, 2.0, 1.0)
"""Factors on s and q, tried in this order; the last is used without a test."""


@dataclass(frozen=True)
class NoiseFloor:
    """Noise of each link at instants of a run.

    Attributes
    ----------
    waveform, arrays : of the run
    longest_delay : of a received path [s]
    times : (K,) increasing [s]
    over_noise : by link (K,) power of a path over the noise of a range-Doppler cell, per power
        gain; 0 where the link is not received
    """

    waveform: Waveform
    arrays: Arrays
    longest_delay: float
    times: np.ndarray
    over_noise: Mapping[Link, np.ndarray]

    @property
    def look_back(self) -> bool:
        """True if elements of some terminal radiate or receive behind their plane."""
        return any(antennas.look_back for antennas in self.arrays)

    def record(self) -> str:
        """Return all attributes as text, for the key of a cache."""
        links = {str(link): factors.tolist() for link, factors in self.over_noise.items()}
        instruments = asdict(self.waveform), asdict(self.arrays)
        return json.dumps([*instruments, self.longest_delay, self.times.tolist(), links])


def resolution_cell(waveform: Waveform, delay: np.ndarray, rate: np.ndarray) -> np.ndarray:
    """Return the number (K,) int64 of the range-Doppler cell of delays [s] and delay rates;
    velocities alias."""
    w = waveform
    beat = np.rint(w.slope * delay * w.sampled_duration).astype(np.int64)
    doppler_cycles = np.rint(w.effective_carrier * rate * w.frame_duration).astype(np.int64)
    return beat * w.num_chirps + doppler_cycles % w.num_chirps


class VisibleCells(NamedTuple):
    """Scatterers that a link receives at one instant.

    Attributes
    ----------
    which : (K,) indices
    power : (K,) mean power over the noise of a range-Doppler cell
    cell : (K,) int, number of the range-Doppler cell
    """

    which: np.ndarray
    power: np.ndarray
    cell: np.ndarray


def merged_below_noise(
    cells: Cells, visible: Sequence[VisibleCells], finest: np.ndarray, error_db: float
) -> Cells:
    """Merge a link's scatterers within the limits of the module's docstring.

    Parameters
    ----------
    visible : received scatterers at instants of the run
    finest : (N,) area A_0 of each cell [m^2]
    error_db : 90th percentile of the error of noise plus clutter
    """
    for factor in LIMIT_FACTORS:
        limit = np.full(len(cells), np.inf)  # least over the instants
        for some in visible:
            area = allowed_area(some, cells.area, finest, 10 ** (error_db / 10) - 1, factor)
            limit[some.which] = np.minimum(limit[some.which], area)
        place, left = merge(cells, limit)
        times = np.zeros(len(cells))
        times[place] = left.area / cells.area[place]
        if factor == LIMIT_FACTORS[-1] or _within(error_db, times, visible):
            break
    return left


def _within(error_db: float, times: np.ndarray, visible: Sequence[VisibleCells]) -> bool:
    """Test the 90th percentile of the error at each instant, over all range-Doppler cells and over
    those with C > 1, if scatterers represent `times` (N,) their power."""
    for which, power, cell in visible:
        every, left = np.bincount(cell, power), np.bincount(cell, power * times[which])
        held = np.flatnonzero(every)
        error, loud = difference_db(every[held], left[held]), every[held] > 1
        if any(np.quantile(e, 0.9) > error_db for e in (error, error[loud]) if e.size):
            return False
    return True


def difference_db(one: np.ndarray, other: np.ndarray) -> np.ndarray:
    """Return the difference of noise plus clutter between two clutter-to-noise ratios [dB]."""
    return np.abs(10 * np.log10((1 + other) / (1 + one)))


def allowed_area(
    visible: VisibleCells, area: np.ndarray, finest: np.ndarray, error: float, factor: float
) -> np.ndarray:
    """Return the largest areas that scatterers may represent at one instant.

    Parameters
    ----------
    area : (N,) that each represents [m^2]
    finest : (N,) A_0 [m^2]
    error : e, of noise plus clutter
    factor : times that s and q are taken

    Returns
    -------
    area : (K,) of those that are received [m^2]
    """
    which, power, cell = visible
    clutter = np.bincount(cell, power)[cell]  # C of each scatterer's cell
    over = (1 + clutter) / clutter
    most = factor * error**2 * (1 + clutter) * np.minimum(SINGLE_LIMIT, GROUP_LIMIT * over)
    most = np.where(clutter > 1, np.minimum(most, clutter / FEWEST), most)
    return np.minimum(finest[which] * over ** (4 / 3), area[which] * most / power)


def merge(cells: Cells, limit: np.ndarray) -> tuple[np.ndarray, Cells]:
    """Merge halves of cells repeatedly while their area is within a limit.

    Parameters
    ----------
    limit : (N,) largest area of a merged cell that holds each cell [m^2]

    Returns
    -------
    place : (M,) index of the cell at whose point each merged cell lies
    cells : M merged cells
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
    """Merge the halves of cells (N,), the finest first, while their area is within the least limit.

    The half with the smaller `clock`, an exponential variable of rate `area`, gives the point;
    amplitudes add, weighted by the roots of the areas. Halves that do not merge end the merging of
    the cells that hold them.

    Returns
    -------
    place, area, amplitude : (M,) merged cells, ordered by the last cell of their parent, the finest
        first
    """
    every = np.arange(len(area))
    sums = (np.sqrt(area) * amplitude).astype(complex)
    nodes = [face, code, every, area.astype(float), limit, sums, every]
    waiting, left = [part[:0] for part in nodes], []
    for level in range(halvings.max(initial=0), -1, -1):
        # cells of this level, sorted by face and code: halves of one cell are neighbours
        waiting = [
            np.append(w, part[halvings == level]) for w, part in zip(waiting, nodes, strict=True)
        ]
        order = np.lexsort(waiting[1::-1])
        faces, name, place, size, most, total, last = (part[order] for part in waiting)
        half = name >> np.uint64(1)
        one = np.flatnonzero((faces[1:] == faces[:-1]) & (half[1:] == half[:-1]) & (level > 0))
        other, least = one + 1, np.minimum(most[one], most[one + 1])
        both = size[one] + size[other]  # joint area
        joins = (place[one] >= 0) & (place[other] >= 0) & (both <= least)
        separate = np.stack([one, other], axis=1)[~joins].ravel() if level else np.arange(len(name))
        last[one] = last[other]
        left.append(
            [part[separate] for part in (last, place, size, total)] + [separate * 0 - level]
        )
        # merged cells go on to the next level at the point of the half with the smaller clock
        first = np.where(clock[place[other]] < clock[place[one]], place[other], place[one])
        place[one], size[one], most[one] = np.where(joins, first, -1), both, least
        total[one] += total[other]
        kept = np.setdiff1d(np.arange(len(name)), other)
        waiting = [part[kept] for part in (faces, half, place, size, most, total, last)]
    last, place, size, total, fine = (np.concatenate(part) for part in zip(*left, strict=True))
    order = np.lexsort([fine, last])
    order = order[place[order] >= 0]
    return place[order], size[order], total[order] / np.sqrt(size[order])
