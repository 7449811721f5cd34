r"""Merging of scatterers below the noise, link by link.

Let C be the clutter-to-noise ratio of a range-Doppler cell. A relative error of its clutter changes
noise plus clutter by C/(1 + C) of that error. Three limits keep the latter within
`clutter.max_error_db`, or a share e:

1. Mean power of a cell. Its relative error grows as area^(3/4) (`cells.area_for`), so one scatterer
   may represent the area

   .. math:: A \le A_0\,((1 + C)/C)^{4/3},

   with the area A_0 without merging.
2. Random power. The clutter of n scatterers varies by 1/sqrt(n). The power of one over the noise is
   therefore at most s (1 + C)^2/C, and at most q (1 + C) in faint cells, with s and q proportional
   to e^2. Both are set for clutter near the noise, the worst case. A link uses up to six times
   these values if the 90th percentile of the errors then stays within e at all instants.
3. Speckle. Where C > 1, one scatterer has at most C/6.

Two halves of a cell merge if their joint area is within the smallest limit of all scatterers in
them, over all instants of the run. The amplitude of the merged scatterer is the coherent sum,
weighted by the roots of the areas, and again Gaussian of unit power. Its position is that of one
half, drawn with a probability proportional to area, so that the mean power is right behind shadow
edges too. A link is merged once for the whole run: no scatterer changes between frames.
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
"""Smallest number of scatterers in a cell with clutter over the noise (limit 3)."""
GROUP_LIMIT = 4.0
"""s / e^2 of limit 2; merged scatterers are neighbours and mostly share a cell."""
SINGLE_LIMIT = 42.0
"""q / e^2 of limit 2, for faint cells, which are most."""
LIMIT_FACTORS = (6.0, 3.0, 2.0, 1.0)
"""Factors on s and q, tried in this order; the last is used without a test."""


@dataclass(frozen=True)
class NoiseFloor:
    """Noise of each link at instants of a run.

    Attributes
    ----------
    waveform, arrays : of the run
    longest_delay : largest delay of a received path [s]
    times : (K,) increasing [s]
    over_noise : by link (K,), power of a path of unit gain over the noise of a range-Doppler cell;
        0 at instants at which the link is not received
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
        limit = np.full(len(cells), np.inf)  # smallest over the instants
        for seen in visible:
            area = allowed_area(seen, cells.area, finest, 10 ** (error_db / 10) - 1, factor)
            limit[seen.which] = np.minimum(limit[seen.which], area)
        index, fewer = merge(cells, limit)
        times = np.zeros(len(cells))
        times[index] = fewer.area / cells.area[index]
        if factor == LIMIT_FACTORS[-1] or _within(error_db, times, visible):
            break
    return fewer


def _within(error_db: float, times: np.ndarray, visible: Sequence[VisibleCells]) -> bool:
    """Test that the 90th percentile of the error is within `error_db` at each instant, over all
    range-Doppler cells with clutter and over those with C > 1. Each scatterer then has `times` (N,)
    its power; 0: merged into another."""
    for which, power, cell in visible:
        before, after = np.bincount(cell, power), np.bincount(cell, power * times[which])
        occupied = np.flatnonzero(before)
        error, loud = difference_db(before[occupied], after[occupied]), before[occupied] > 1
        if any(np.quantile(e, 0.9) > error_db for e in (error, error[loud]) if e.size):
            return False
    return True


def difference_db(one: np.ndarray, other: np.ndarray) -> np.ndarray:
    """Return the difference |10 lg (1 + C_2)/(1 + C_1)| of noise plus clutter between two
    clutter-to-noise ratios [dB]."""
    return np.abs(10 * np.log10((1 + other) / (1 + one)))


def allowed_area(
    visible: VisibleCells, area: np.ndarray, finest: np.ndarray, error: float, factor: float
) -> np.ndarray:
    """Return the largest areas that scatterers may represent at one instant.

    Parameters
    ----------
    area : (N,) represented without merging [m^2]
    finest : (N,) A_0 [m^2]
    error : e, of noise plus clutter
    factor : on s and q

    Returns
    -------
    area : (K,) of the received scatterers [m^2]
    """
    which, power, cell = visible
    clutter = np.bincount(cell, power)[cell]  # C of each scatterer's cell
    over = (1 + clutter) / clutter
    # largest power of one scatterer by limits 2 and 3, then the area by it and by limit 1
    most = factor * error**2 * (1 + clutter) * np.minimum(SINGLE_LIMIT, GROUP_LIMIT * over)
    most = np.where(clutter > 1, np.minimum(most, clutter / FEWEST), most)
    return np.minimum(finest[which] * over ** (4 / 3), area[which] * most / power)


def merge(cells: Cells, limit: np.ndarray) -> tuple[np.ndarray, Cells]:
    """Merge halves of cells repeatedly while their joint area is within a limit.

    Parameters
    ----------
    limit : (N,) largest area of a merged cell that holds each cell [m^2]

    Returns
    -------
    index : (M,) of the cell whose point each merged cell takes
    cells : M merged cells
    """
    # order of the cells along their faces: by code, its first bit shifted to one place
    halvings = np.frexp(cells.code.astype(float))[1] - 1
    along = cells.code << (62 - halvings).astype(np.uint64)
    order = np.lexsort([along, cells.face])
    c = cells.select(order)
    index, area, amplitude = merged(
        c.face, c.code, halvings[order], c.area, c.amplitude, c.clock, limit[order]
    )
    out = replace(
        c.select(index), area=area.astype(np.float32), amplitude=amplitude.astype(np.complex64)
    )
    return order[index], out


def merged(
    face: np.ndarray,
    code: np.ndarray,
    halvings: np.ndarray,
    area: np.ndarray,
    amplitude: np.ndarray,
    clock: np.ndarray,
    limit: np.ndarray,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Merge halves of cells (N,), the finest first, while their joint area is within the smallest
    limit of the cells in both.

    The half with the smaller `clock`, an exponential variable of rate `area`, gives the point;
    amplitudes add, weighted by the roots of the areas. Where two halves do not merge, the cells
    that hold them do not merge either.

    Returns
    -------
    index, area, amplitude : (M,) cell whose point is used, and values of the merged cells, ordered
        by the last cell of their parent, the finest first
    """
    every = np.arange(len(area))
    sums = (np.sqrt(area) * amplitude).astype(complex)
    # nodes of the binary trees: face, code, index of the point (-1: does not merge any more), area,
    # limit, sum of roots of areas times amplitudes, last cell
    nodes = [face, code, every, area.astype(float), limit, sums, every]
    waiting, done = [part[:0] for part in nodes], []
    for level in range(halvings.max(initial=0), -1, -1):
        # nodes of this level, sorted by face and code: halves of one cell are neighbours
        waiting = [
            np.append(w, part[halvings == level]) for w, part in zip(waiting, nodes, strict=True)
        ]
        order = np.lexsort(waiting[1::-1])
        faces, codes, index, size, most, total, last = (part[order] for part in waiting)
        parent = codes >> np.uint64(1)
        same_parent = (faces[1:] == faces[:-1]) & (parent[1:] == parent[:-1]) & (level > 0)
        first = np.flatnonzero(same_parent)
        second, least = first + 1, np.minimum(most[first], most[first + 1])
        joint = size[first] + size[second]
        joins = (index[first] >= 0) & (index[second] >= 0) & (joint <= least)
        # halves that do not merge are results; at level 0 all that is left
        ends = np.stack([first, second], axis=1)[~joins].ravel() if level else np.arange(len(codes))
        last[first] = last[second]
        done.append([part[ends] for part in (last, index, size, total)] + [ends * 0 - level])
        # parents go on to the next level, merged ones at the point with the smaller clock
        earlier = clock[index[second]] < clock[index[first]]
        point = np.where(earlier, index[second], index[first])
        index[first], size[first], most[first] = np.where(joins, point, -1), joint, least
        total[first] += total[second]
        parents = np.setdiff1d(np.arange(len(codes)), second)
        waiting = [part[parents] for part in (faces, parent, index, size, most, total, last)]
    last, index, size, total, fine = (np.concatenate(part) for part in zip(*done, strict=True))
    order = np.lexsort([fine, last])
    order = order[index[order] >= 0]
    return index[order], size[order], total[order] / np.sqrt(size[order])
