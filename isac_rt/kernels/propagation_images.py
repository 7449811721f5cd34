"""Kernels of `isac_rt.propagation.segments.images`."""

from __future__ import annotations

import numpy as np

from isac_rt.kernels.jit import jit

WIDER = 1e-6
"""What a face holds beyond its edges [m], so that no point falls between two faces that share
one."""


@jit(borrows=True)
def _face_at(mirrors, plane, x, y, z):
    """The face of a plane that holds a point of it, the first in the order of the faces; -1 where
    there is none."""
    m, place = mirrors, (x, y, z)
    u, v = place[m.axes[plane, 0]], place[m.axes[plane, 1]]
    low, high = m.first[plane], m.first[plane + 1]
    left = u - m.widest[plane] - WIDER
    while low < high:
        middle = (low + high) // 2
        if m.begin[middle] < left:
            low = middle + 1
        else:
            high = middle
    best = -1
    for row in range(low, m.first[plane + 1]):
        if m.begin[row] > u + WIDER:
            break
        inside = True
        for k in range(3):
            side = m.sides[row, k, 0] * u + m.sides[row, k, 1] * v + m.sides[row, k, 2]
            inside = inside and side >= -WIDER
        if inside and (best < 0 or m.face[row] < best):
            best = m.face[row]
    return best


@jit
def reflected(chains, mirrors, depth, start, ends):
    """Chains that lead from a place (3,) to places (S, 3) by way of faces, whatever stands between.

    Returns
    -------
    number of the place (K,), faces (K, depth) in order, -1 where a chain is shorter
    """
    planes, parents = chains.plane, chains.parent
    # an array that is taken out of a tuple within the loop is counted there, at 10 ns each
    normals, offsets, low, high = mirrors.normals, mirrors.offsets, mirrors.low, mirrors.high
    count = planes.size
    image, behind = np.empty((count, 3)), np.empty(count)
    met = np.empty(depth, np.int64)
    found = [0 for _ in range(0)]
    for k in range(count):
        plane, parent = planes[k], parents[k]
        n = normals[plane]
        source = start if parent < 0 else image[parent]
        height = n[0] * source[0] + n[1] * source[1] + n[2] * source[2] - offsets[plane]
        for i in range(3):
            image[k, i] = source[i] - 2 * height * n[i]
        behind[k] = -height
        for s in range(ends.shape[0]):
            x, y, z = ends[s, 0], ends[s, 1], ends[s, 2]
            row, bounces = k, 0
            while row >= 0:
                plane = planes[row]
                above = (
                    normals[plane, 0] * x
                    + normals[plane, 1] * y
                    + normals[plane, 2] * z
                    - offsets[plane]
                )
                if not above * behind[row] < 0:
                    break
                share = behind[row] / (behind[row] - above)
                x = image[row, 0] + share * (x - image[row, 0])
                y = image[row, 1] + share * (y - image[row, 1])
                z = image[row, 2] + share * (z - image[row, 2])
                if not (
                    low[plane, 0] <= x <= high[plane, 0]
                    and low[plane, 1] <= y <= high[plane, 1]
                    and low[plane, 2] <= z <= high[plane, 2]
                ):
                    break
                met[bounces] = _face_at(mirrors, plane, x, y, z)
                if met[bounces] < 0:
                    break
                bounces += 1
                row = parents[row]
            if row < 0:
                found.append(s)
                for b in range(depth):
                    found.append(met[bounces - 1 - b] if b < bounces else -1)
    return np.array(found, np.int64).reshape(-1, depth + 1)
