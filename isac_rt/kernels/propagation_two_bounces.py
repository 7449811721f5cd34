"""Kernels of `isac_rt.propagation.clutter.two_bounces`."""

from __future__ import annotations

import numpy as np

from isac_rt.kernels.jit import jit
from isac_rt.kernels.propagation_field import leg_to, scattered_power


@jit
def lay_out(points, normal, start, end, before, rows):
    """Geometry of ways over scatterers from `start` to `end` (position, velocity, acceleration),
    one of them an image behind the mirror; directions are those at the terminals themselves."""
    departure, arrival = rows.departure, rows.arrival
    for row in range(rows.cell.size):
        i = rows.cell[row]
        r1, v1, a1, x1, y1, z1 = leg_to(points[i, 0], points[i, 1], points[i, 2], start)
        r2, v2, a2, x2, y2, z2 = leg_to(points[i, 0], points[i, 1], points[i, 2], end)
        if before:
            k = 2 * (x1 * normal[0] + y1 * normal[1] + z1 * normal[2])
            x1, y1, z1 = x1 - k * normal[0], y1 - k * normal[1], z1 - k * normal[2]
        else:
            k = 2 * (x2 * normal[0] + y2 * normal[1] + z2 * normal[2])
            x2, y2, z2 = x2 - k * normal[0], y2 - k * normal[1], z2 - k * normal[2]
        rows.length[row], rows.rate[row], rows.accel[row] = r1 + r2, v1 + v2, a1 + a2
        rows.tx_radius[row], rows.rx_radius[row] = r1, r2
        departure[row, 0], departure[row, 1], departure[row, 2] = x1, y1, z1
        arrival[row, 0], arrival[row, 1], arrival[row, 2] = x2, y2, z2


@jit(inline=True)
def _dot(a, b):
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@jit(inline=True)
def _cross(a, b):
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]


@jit(inline=True)
def _turned(u, n):
    """A direction after a mirror of normal n."""
    k = 2 * _dot(u, n)
    return u[0] - k * n[0], u[1] - k * n[1], u[2] - k * n[2]


@jit(inline=True)
def _upright(u):
    """The spherical unit vector theta of a direction: the field of a vertically polarised isotropic
    element."""
    flat = np.sqrt(u[0] * u[0] + u[1] * u[1])
    x, y = (u[0] / flat, u[1] / flat) if flat > 0 else (1.0, 0.0)
    return u[2] * x, u[2] * y, -flat


@jit(inline=True)
def _mirrored(u, out, n, te, tm):
    """Field (three complex parts) along `out` after a mirror of normal n, of a wave along u with
    the upright field."""
    field, across = _upright(u), _cross(u, n)
    size = np.sqrt(_dot(across, across))
    if size < 1e-9:  # any direction will do, at normal incidence
        across = _cross(u, (1.0, 0.0, 0.0)) if abs(u[0]) < 0.9 else _cross(u, (0.0, 1.0, 0.0))
        size = np.sqrt(_dot(across, across))
    across = across[0] / size, across[1] / size, across[2] / size
    first, second = te * _dot(field, across), tm * _dot(field, _cross(across, u))
    beyond = _cross(across, out)
    return (
        first * across[0] + second * beyond[0],
        first * across[1] + second * beyond[1],
        first * across[2] + second * beyond[2],
    )


@jit
def weigh(surfaces, face, area, share, scale, normal, slab, before, rows, gain):
    """Complex gains of ways over scatterers; the scatterers' own amplitudes left out."""
    normals, departure, arrival = surfaces.normals, rows.departure, rows.arrival
    mirror = normal[0], normal[1], normal[2]
    for row in range(rows.cell.size):
        i = rows.cell[row]
        f, te, tm = face[i], slab[0][row], slab[1][row]
        n = normals[f, 0], normals[f, 1], normals[f, 2]
        away = departure[row, 0], departure[row, 1], departure[row, 2]
        home = -arrival[row, 0], -arrival[row, 1], -arrival[row, 2]
        if before:  # the field that reaches the scatterer has been through the mirror
            u, w = _turned(away, mirror), home
            x, y, z = _mirrored(away, u, mirror, te, tm)
            passed = _dot((x, y, z), _upright(u))
        else:
            u, w = away, _turned(home, mirror)
            up = _upright(u)
            x, y, z = complex(up[0]), complex(up[1]), complex(up[2])
            passed = _dot(_mirrored(w, home, mirror, te, tm), _upright(home))
        into, back = _dot(u, n), -_dot(w, n)
        if into * back <= 0:
            gain[row] = 0.0
            continue
        across = _cross(u, n)
        whole = (abs(x) ** 2 + abs(y) ** 2 + abs(z) ** 2) * _dot(across, across)
        part = min(abs(_dot((x, y, z), across)) ** 2 / whole, 1.0) if whole > 1e-24 else 0.5
        power = scattered_power(surfaces, f, area[i], into, back, -_dot(u, w), part)
        radii = rows.tx_radius[row] * rows.rx_radius[row]
        gain[row] = scale * share[row] * passed * np.sqrt(power) / radii
