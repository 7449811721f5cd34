"""Kernels of `isac_rt.propagation.clutter.field`."""

from __future__ import annotations

import numpy as np

from isac_rt.kernels.jit import jit


@jit
def advance(surfaces, points, face, area, share, scale, start, end, own, rows):
    """Fill all `rows` but `cell`; they are independent. `start`, `end`: position, velocity,
    acceleration; `own`: both are one body, and `arrival` is `departure`."""
    index, length, rate, accel = rows.cell, rows.length, rows.rate, rows.accel
    tx_radius, rx_radius, magnitude = rows.tx_radius, rows.rx_radius, rows.magnitude
    departure, arrival = rows.departure, rows.arrival
    for row in range(index.size):
        i = index[row]
        f = face[i]
        nx, ny, nz = surfaces.normals[f, 0], surfaces.normals[f, 1], surfaces.normals[f, 2]
        r1, v1, a1, x1, y1, z1 = segment_to(points[i, 0], points[i, 1], points[i, 2], start)
        r2, v2, a2, x2, y2, z2 = r1, v1, a1, x1, y1, z1
        departure[row, 0], departure[row, 1], departure[row, 2] = x1, y1, z1
        if not own:
            r2, v2, a2, x2, y2, z2 = segment_to(points[i, 0], points[i, 1], points[i, 2], end)
            arrival[row, 0], arrival[row, 1], arrival[row, 2] = x2, y2, z2
        # sums over both segments; nothing passes through the surface
        tx_radius[row], rx_radius[row] = r1, r2
        length[row], rate[row], accel[row] = r1 + r2, v1 + v2, a1 + a2
        into = x1 * nx + y1 * ny + z1 * nz
        back = x2 * nx + y2 * ny + z2 * nz
        if into * back <= 0:
            magnitude[row] = 0.0
            continue
        cos_i = min(abs(into), 1.0)
        # share of TE, along u x n, in the power of a vertical field
        whole = (x1 * x1 + y1 * y1) * (1 - cos_i * cos_i)
        part = min((ny * x1 - nx * y1) ** 2 / whole, 1.0) if whole > 1e-12 else 0.5
        between = x1 * x2 + y1 * y2 + z1 * z2
        # root of the mean power gain, times visibility
        power = scattered_power(surfaces, f, area[i], into, back, between, part)
        magnitude[row] = scale * share[i] * np.sqrt(power) / (r1 * r2)


@jit(inline=True)
def scattered_power(surfaces, face, area, into, back, between, part):
    """Return S^2 Gamma^2 f_s cos(theta_i) A of a cell, the bistatic cross-section over 4 pi.

    `into` and `back` are the signed cosines of incidence and departure, `between` the cosine of the
    angle between both directions, `part` the share of TE in the power.
    """
    # reflectivity and norm of the lobe, interpolated over the cosine of incidence
    table, m = surfaces.table, surfaces.material[face]
    last = table.shape[1] - 2
    cos_i = min(abs(into), 1.0)
    at = cos_i * (last + 1)
    k = min(int(at), last)
    at -= k
    te = table[m, k, 0] + at * (table[m, k + 1, 0] - table[m, k, 0])
    tm = table[m, k, 1] + at * (table[m, k + 1, 1] - table[m, k, 1])
    power = surfaces.coefficient[m] * (part * te + (1 - part) * tm) * cos_i * area
    # Lambert's cosine, or lobes about the mirror direction and towards the source
    lobe, exponent = surfaces.lobe[m], surfaces.exponent[m]
    if lobe < 0:
        power *= abs(back) / np.pi
    else:
        norm = table[m, k, 2] + at * (table[m, k + 1, 2] - table[m, k, 2])
        mirror = max(0.5 * (1 + (2 * into * back - between)), 0.0) ** exponent
        source = max(0.5 * (1 + between), 0.0) ** exponent
        power *= (lobe * mirror + (1 - lobe) * source) * norm
    return power


@jit(inline=True)
def segment_to(px, py, pz, platform):
    """Return the distance r from a moving terminal to a point, its rate -u.v and acceleration
    (v^2 - rate^2)/r - u.a, and the unit vector u towards the point."""
    x, y, z = px - platform[0, 0], py - platform[0, 1], pz - platform[0, 2]
    r = np.sqrt(x * x + y * y + z * z)
    x, y, z = x / r, y / r, z / r
    a = -(x * platform[1, 0] + y * platform[1, 1] + z * platform[1, 2])
    speed = platform[1, 0] ** 2 + platform[1, 1] ** 2 + platform[1, 2] ** 2
    b = (speed - a * a) / r - (x * platform[2, 0] + y * platform[2, 1] + z * platform[2, 2])
    return r, a, b, x, y, z
