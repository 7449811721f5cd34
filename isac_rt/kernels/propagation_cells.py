"""Kernels of `isac_rt.propagation.clutter.cells`."""

from __future__ import annotations

import numpy as np

from isac_rt.kernels.jit import jit

ALIKE = 1e-9
"""Edges whose lengths differ by less than this share are equally long; then the first is halved."""
BOX = 32
"""Places along a flight that are looked at only if the box about them is near enough."""
FINER = 4.0
"""How many cells near a flight share the surface of one, where a density asks for it."""


@jit
def leaves(faces, positions, boxes, density, most):
    """`isac_rt.propagation.clutter.cells.leaves`; `boxes` hold the places, `BOX` in each."""
    corners, area, face_states = faces
    capacity = max(2 * area.size, 1024)
    rows, codes = np.empty(capacity, np.int64), np.empty(capacity, np.uint64)
    areas, states, points = (
        np.empty(capacity),
        np.empty(capacity, np.uint64),
        np.empty((capacity, 3)),
    )
    line_codes, line_areas = np.empty(64, np.uint64), np.empty(64)
    line = np.empty((64, 3, 3))  # cells of one face that wait, those of few halvings first
    spans = np.empty((64, 2))  # their distances to the nearest place lie between these
    count = 0
    for row in range(area.size):
        line_codes[0], line_areas[0], line[0] = 1, area[row], corners[row]
        spans[0, 0], spans[0, 1] = 0.0, np.inf
        first, last = 0, 1
        while first < last:
            if count + last - first > most:
                return most + 1, rows[:0], codes[:0], areas[:0], states[:0], points[:0]
            if count == rows.size:
                rows, codes = np.append(rows, rows), np.append(codes, codes)
                areas, states = np.append(areas, areas), np.append(states, states)
                points = np.concatenate((points, points))
            if last + 2 > line_areas.size:
                line_codes = np.append(line_codes[first:last], line_codes)
                line_areas = np.append(line_areas[first:last], line_areas)
                line = np.concatenate((line[first:last], line))
                spans = np.concatenate((spans[first:last], spans))
                first, last = 0, last - first
            leaves, waiting = (rows, codes, areas, states, points), (line_codes, line_areas)
            at = row, face_states[row], count, first, last
            around = line, spans, positions, boxes, density, most
            count, first, last = _cut_face(at, leaves, waiting, *around)
    return count, rows[:count], codes[:count], areas[:count], states[:count], points[:count]


@jit(borrows=True)
def _cut_face(at, leaves, waiting, line, spans, positions, boxes, density, most):
    """Cut the waiting cells of a face further, until none is left, there is no room, or there are
    more than `most`; the new number of leaves, and the first and last of those that wait."""
    row, state, count, first, last = at
    rows, codes, areas, states, points = leaves
    line_codes, line_areas = waiting
    per_metre, smallest, near, farthest = density
    end = line_areas.size
    while first < last <= end - 2 and count < rows.size and count + last - first <= most:
        size = line_areas[first]
        if _beyond(line[first], farthest):
            first += 1
            continue
        reach = size / per_metre if size > smallest else 0.0
        if FINER * size > smallest:
            reach = max(reach, min(FINER * size / per_metre, near))
        if reach == 0 or not _near(line[first], reach, positions, boxes, spans[first]):
            rows[count], codes[count], areas[count] = row, line_codes[first], size
            states[count] = _hashed(state, line_codes[first])
            _place(line[first], states[count], points[count])
            count, first = count + 1, first + 1
            continue
        offset = _halve(line[first], line[last], line[last + 1]) / 6  # of a half's centroid
        for half in range(2):
            line_codes[last + half] = line_codes[first] * np.uint64(2) + np.uint64(half)
            line_areas[last + half] = line_areas[first] / 2
            spans[last + half, 0] = spans[first, 0] - offset
            spans[last + half, 1] = spans[first, 1] + offset
        first, last = first + 1, last + 2
    return count, first, last


@jit(inline=True)
def _hashed(state, word):
    """`splitmix64` of one."""
    state = state + (word + np.uint64(1)) * np.uint64(0x9E3779B97F4A7C15)
    state = (state ^ (state >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    state = (state ^ (state >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    return state ^ (state >> np.uint64(31))


@jit(borrows=True)
def _place(corners, state, point):
    """A point, uniform in a triangle (3, 3)."""
    root = np.sqrt((np.float64(_hashed(state, np.uint64(0)) >> np.uint64(11)) + 0.5) / 2**53)
    share = (np.float64(_hashed(state, np.uint64(1)) >> np.uint64(11)) + 0.5) / 2**53
    for axis in range(3):
        a, b, c = corners[0, axis], corners[1, axis], corners[2, axis]
        point[axis] = (1 - root) * a + root * ((1 - share) * b + share * c)


@jit(borrows=True)
def _near(corners, limit, points, boxes, span):
    """Return whether a place is nearer than `limit` to a triangle (3, 3): to the nearest point of a
    sphere about its centroid that holds it. `span` bounds the distance from the centroid to the
    nearest place; places are searched only where it leaves the answer open, and it is exact
    afterwards."""
    x, y, z = _middle(corners, 0), _middle(corners, 1), _middle(corners, 2)
    reach = 0.0
    for k in range(3):
        reach = max(reach, _square(corners[k, 0] - x, corners[k, 1] - y, corners[k, 2] - z))
    reach = np.sqrt(reach)
    if span[1] < (1 - ALIKE) * (limit + reach):
        return True
    if span[0] > (1 + ALIKE) * (limit + reach):
        return False
    least = (1 + ALIKE) * span[1] ** 2
    for b in range(len(boxes)):
        dx = max(boxes[b, 0, 0] - x, x - boxes[b, 1, 0], 0.0)
        dy = max(boxes[b, 0, 1] - y, y - boxes[b, 1, 1], 0.0)
        dz = max(boxes[b, 0, 2] - z, z - boxes[b, 1, 2], 0.0)
        if _square(dx, dy, dz) > (1 + ALIKE) * least:
            continue
        for k in range(b * BOX, min((b + 1) * BOX, len(points))):
            least = min(least, _square(points[k, 0] - x, points[k, 1] - y, points[k, 2] - z))
    span[0] = span[1] = np.sqrt(least)
    return max(span[0] - reach, 0.0) < limit


@jit(borrows=True)
def _beyond(corners, far):
    """Return whether a triangle (3, 3) lies outside the cube of half the side `far`."""
    for k in range(3):
        a, b, c = corners[0, k], corners[1, k], corners[2, k]
        if min(a, b, c) > far or max(a, b, c) < -far:
            return True
    return False


@jit(inline=True)
def _middle(corners, axis):
    return (corners[0, axis] + corners[1, axis] + corners[2, axis]) / 3


@jit(inline=True)
def _square(x, y, z):
    return x * x + y * y + z * z


@jit(borrows=True)
def _halve(corners, one, other):
    """Cut a triangle (3, 3) from the middle of its longest edge into two; that edge's length."""
    edges = _edge(corners, 0), _edge(corners, 1), _edge(corners, 2)
    longest = max(edges)
    least = longest * (1 - ALIKE)
    first = 0 if edges[0] >= least else 1 if edges[1] >= least else 2
    for axis in range(3):
        a, b = corners[first, axis], corners[(first + 1) % 3, axis]
        middle = (a + b) / 2
        one[0, axis], one[1, axis], one[2, axis] = a, middle, corners[(first + 2) % 3, axis]
        other[0, axis], other[1, axis], other[2, axis] = middle, b, corners[(first + 2) % 3, axis]
    return longest


@jit(inline=True)
def _edge(corners, k):
    a, b = corners[k], corners[(k + 1) % 3]
    return np.sqrt(_square(b[0] - a[0], b[1] - a[1], b[2] - a[2]))
