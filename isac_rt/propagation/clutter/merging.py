r"""Scatterers merged, link by link, where noise covers them.

A range-Doppler cell that holds C times its noise in clutter shows an error of the clutter as the
share C/(1 + C) of it. So the area that one scatterer may stand for grows where C is small: the
error of a cell's clutter grows with area^(3/4) (`cells.area_for`), and that of noise plus clutter
stays what `clutter.max_error_db` allows as long as

.. math:: A \le A_0\,((1 + C)/C)^{4/3},

A_0 the area that the surface is cut to. That says how the clutter is spread over cells on average;
a cell with n scatterers at random errs by the share 1/sqrt(n) of C, so that none may hold more
than s(1 + C)^2/C of the noise, nor more than q(1 + C), since a faint cell with one scatterer
instead of many shows all of it or nothing; s and q go with the square of the error allowed. Nor
does one hold more than a sixth of a cell's clutter where that is over the noise: fewer would fix
the cell's level by a single draw.

The two halves of a cell merge while their joint area keeps the least of these limits over all
scatterers that they hold and all instants of the run. What is merged has the coherent sum of the
halves' amplitudes, weighted by the roots of their areas, which is Gaussian of unit power again, and
the place of one of them, drawn by area: its mean power is that of both wherever shadows fall. Each
link has one such cut for the whole run, so that nothing jumps.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace

import numpy as np

from isac_rt.frame.antennas import Antennas
from isac_rt.frame.link import Link
from isac_rt.frame.waveform import Waveform
from isac_rt.kernels.jit import jit
from isac_rt.propagation.clutter.cells import Cells

ONE = np.uint64(1)
FEWEST = 6
"""Scatterers of a cell whose clutter is over the noise."""
ALL_ERR = 4.0
"""s over the square of the error that nine of ten cells keep to: what merges stays near, mostly in
the same cell."""
ONE_ERRS = 42.0
"""q over the square of the error: most cells are faint."""


@dataclass(frozen=True)
class NoiseFloor:
    """The noise that covers faint clutter, at instants of a run.

    Attributes
    ----------
    waveform, antennas : of the run
    longest_delay : of a path that is heard at all [s]
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


def allowed_area(
    power: np.ndarray, cell: np.ndarray, area: np.ndarray, finest: np.ndarray, error: float
) -> np.ndarray:
    """Largest areas that scatterers may stand for at one instant.

    Parameters
    ----------
    power : (K,) mean power over the noise of a range-Doppler cell
    cell : (K,) int from 0 in which each is seen
    area : (K,) that each stands for [m^2]
    finest : (K,) to which the surface is cut there [m^2]
    error : of noise plus clutter that is allowed, as a share

    Returns
    -------
    area : (K,) [m^2]
    """
    clutter = np.bincount(cell, power)[cell]
    over = (1 + clutter) / clutter
    most = error**2 * (1 + clutter) * np.minimum(ONE_ERRS, ALL_ERR * over)
    most = np.where(clutter > 1, np.minimum(most, clutter / FEWEST), most)
    return np.minimum(finest * over ** (4 / 3), area * most / power)


def merge(cells: Cells, limit: np.ndarray) -> Cells:
    """Cells whose halves are merged, again and again, while their area keeps to a limit.

    Parameters
    ----------
    limit : (N,) area that what holds each of the N cells may have [m^2]
    """
    halvings = np.frexp(cells.code.astype(float))[1] - 1
    along = cells.code << (62 - halvings).astype(np.uint64)
    order = np.lexsort([along, cells.face])
    some = cells.select(order)
    found = _merged(
        some.face, some.code, halvings[order], some.area, some.amplitude, some.clock, limit[order]
    )
    place, area, amplitude = found
    out = some.select(place)
    return replace(out, area=area.astype(np.float32), amplitude=amplitude.astype(np.complex64))


@jit
def _merged(face, code, halvings, area, amplitude, clock, limit):
    """Which cells (N,), each before what is halved from the next, stand for what is left, its area
    and its amplitude. The cell whose clock rings first is drawn by area, whatever it is among."""
    count = 0
    places, areas = np.empty(area.size, np.int64), np.empty(area.size)
    amplitudes = np.empty(area.size, np.complex128)
    # nodes that wait for their other half: their names, what they hold, and who stands for them;
    # -1: has been given out in parts
    name, place = np.empty(64, np.uint64), np.empty(64, np.int64)
    size, most, total = np.empty(64), np.empty(64), np.empty(64, np.complex128)
    last = -1
    for i in range(area.size):
        last += 1
        name[last], place[last], size[last], most[last] = code[i], i, area[i], limit[i]
        total[last] = np.sqrt(area[i]) * amplitude[i]
        while name[last] > 1:
            if last > 0 and name[last - 1] >> ONE == name[last] >> ONE:
                last -= 1
                both = size[last] + size[last + 1]
                least = min(most[last], most[last + 1])
                if place[last] >= 0 and place[last + 1] >= 0 and both <= least:
                    if clock[place[last + 1]] < clock[place[last]]:
                        place[last] = place[last + 1]
                    size[last], most[last] = both, least
                    total[last] += total[last + 1]
                else:
                    for k in (last, last + 1):
                        if place[k] >= 0:
                            places[count], areas[count] = place[k], size[k]
                            amplitudes[count] = total[k] / np.sqrt(size[k])
                            count += 1
                    place[last] = -1
            elif name[last] & ONE == 0 and i + 1 < area.size and face[i + 1] == face[i]:
                up = halvings[i + 1]
                mine = name[last]
                while mine > 1:
                    mine >>= ONE
                    up -= 1
                if up >= 0 and code[i + 1] >> np.uint64(up) == name[last] + ONE:
                    break  # the other half is to come
            name[last] >>= ONE
        if name[last] == 1:
            if place[last] >= 0:
                places[count], areas[count] = place[last], size[last]
                amplitudes[count] = total[last] / np.sqrt(size[last])
                count += 1
            last = -1
    return places[:count], areas[:count], amplitudes[:count]
