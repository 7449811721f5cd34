"""Kernels of `isac_rt.propagation.clutter.merging`."""

from __future__ import annotations

import numpy as np

from isac_rt.kernels.jit import jit

ONE = np.uint64(1)


@jit
def merged(face, code, halvings, area, amplitude, clock, limit):
    """Return which cells (N,), each followed by those halved from it, represent the rest, their
    area and amplitude. Cells are drawn by exponential clocks in proportion to their area, whatever
    group they are in."""
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
