r"""Crossings of shadow edges along a flight, and the width of the penumbra.

Between a time sample of a flight from which a scatterer is visible and the next, from which it is
not, the ray to it crosses a shadow edge. Bisection with rays finds the crossing. The last blocked
ray hits the blocking triangle within millimetres of the shadow edge, so the edge is the nearest
side of that triangle. Let d_1 be the distance from the edge to the terminal, d_2 to the scatterer,
m the unit vector across edge and ray, v that of the flight, and w half the width of the scatterer's
cell across the edge. One Fresnel unit is then the length of flight

.. math:: \sigma = \frac{d_1}{d_2\,|v \cdot m|} \sqrt{\frac{\lambda d_2 (d_1 + d_2)}{2 d_1} + w^2}.

Near the crossing the Fresnel parameter is linear in the distance flown: it is that distance from
the crossing over sigma.

Import only after `isac_rt.runtime.activate()`.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import drjit as dr
import mitsuba as mi
import numpy as np

from isac_rt.propagation.segments.diffraction import knife_edge
from isac_rt.propagation.segments.geometry import RAY_OFFSET_M
from isac_rt.propagation.segments.rays import Triangles, computed, rays

HALVINGS = 6
"""Bisections between two time samples: 8 mm of half a metre."""
REACH = 4.0
"""Fresnel units from the edge to full light or shadow; the factor, there within 6 % of 0 or 1, is
tapered to them."""
HALF_WIDTH = 0.7
"""Half the width of a cell over the root of its area: that of a right isosceles triangle."""
_UNITS = np.linspace(-REACH, REACH, 1025)


def _tables() -> tuple[np.ndarray, np.ndarray]:
    """Tabulate the knife-edge factor over Fresnel units, tapered to 0 and 1 at the ends."""
    x = np.clip((np.abs(_UNITS) - REACH / 2) / (REACH / 2), 0, 1)
    far = x * x * (3 - 2 * x)
    factor = (1 - far) * knife_edge(-_UNITS) + far * (_UNITS > 0)
    return factor.real, factor.imag


_REAL, _IMAG = _tables()


def penumbra(units: np.ndarray) -> np.ndarray:
    """Return the complex knife-edge factor at Fresnel units (N,), positive in the light."""
    return np.interp(units, _UNITS, _REAL) + 1j * np.interp(units, _UNITS, _IMAG)


@dataclass(frozen=True)
class Crossings:
    """Crossings of shadow edges by the rays to K scatterers between two time samples.

    Attributes
    ----------
    index : (K,) int32 of the scatterer
    where : (K,) float32 position of the crossing, from 0 to 1 between the time samples
    width : (K,) float32 length of flight per Fresnel unit, sigma [m]; inf where no edge was found
    gained : (K,) bool, visible after the crossing
    """

    index: np.ndarray
    where: np.ndarray
    width: np.ndarray
    gained: np.ndarray


class Facets(NamedTuple):
    """N points on surfaces with unit normals (N, 3), local coordinates, and the areas (N,) of
    their cells [m^2]."""

    points: np.ndarray
    normals: np.ndarray
    area: np.ndarray

    def select(self, which: np.ndarray) -> Facets:
        """Select points by an index array."""
        return Facets(self.points[which], self.normals[which], self.area[which])


def crossings(
    triangles: Triangles,
    time_samples: np.ndarray,
    seen: np.ndarray,
    facets: Facets,
    wavelength: float,
) -> Crossings:
    """Find the crossings between two time samples (2, 3), for N points with visibility `seen`
    (2, N)."""
    index = np.flatnonzero(seen[0] != seen[1]).astype(np.int32)
    gained = seen[1][index].astype(bool)
    changed = facets.select(index)
    low, high = np.zeros(index.size), np.ones(index.size)
    for _ in range(HALVINGS if index.size else 0):  # bisection
        middle = (low + high) / 2
        ray = _rays(changed, _between(time_samples, middle))
        visible = ~computed(triangles.scene.ray_test(ray))
        after = visible == gained  # the middle lies after the crossing
        low, high = np.where(after, low, middle), np.where(after, middle, high)
    where = (low + high) / 2
    width = _widths(triangles, time_samples, np.where(gained, low, high), changed, wavelength)
    return Crossings(index, where.astype(np.float32), width.astype(np.float32), gained)


def _between(time_samples: np.ndarray, share: np.ndarray) -> np.ndarray:
    """Return positions (K, 3) at shares (K,) of the way between two time samples."""
    return time_samples[0] + share[:, None] * (time_samples[1] - time_samples[0])


def _rays(facets: Facets, positions: np.ndarray) -> mi.Ray3f:
    """Build rays from points, lifted off their surfaces, to one position each."""
    side = np.sign(((positions - facets.points) * facets.normals).sum(1))
    start = facets.points + RAY_OFFSET_M * side[:, None] * facets.normals
    span = positions - start
    length = np.linalg.norm(span, axis=1)
    return rays(start, span / length[:, None], length - RAY_OFFSET_M)


def _widths(
    triangles: Triangles,
    time_samples: np.ndarray,
    dark: np.ndarray,
    facets: Facets,
    wavelength: float,
) -> np.ndarray:
    """Return sigma (K,) [m] of the edges that occlude points from the positions at shares `dark`
    (K,) of the way between two time samples; infinite where no edge is found."""
    points, normals, area = facets
    if not points.shape[0]:
        return np.zeros(0)
    # triangle that blocks the last blocked ray, and the point where it does
    positions = _between(time_samples, dark)
    hit = triangles.scene.ray_intersect_preliminary(_rays(facets, positions))
    dr.eval(hit)  # once, not for each of its parts
    near, triangle = np.asarray(hit.t, np.float64), triangles.rows(hit)
    blocked = triangle >= 0
    corners = triangles.corners[triangle].astype(float)
    span = points - positions
    length = np.linalg.norm(span, axis=1)
    ray = span / length[:, None]
    behind = np.clip(near, RAY_OFFSET_M, length - RAY_OFFSET_M)
    at = points - behind[:, None] * ray
    # side of the triangle nearest to that point, and m = side x ray
    along = np.roll(corners, -1, axis=1) - corners
    size = np.maximum(np.linalg.norm(along, axis=2, keepdims=True), 1e-9)
    along = along / size
    offset = at[:, None] - corners
    share = np.clip((offset * along).sum(2, keepdims=True), 0, size)
    edge = along[np.arange(len(at)), np.linalg.norm(offset - share * along, axis=2).argmin(axis=1)]
    across = np.cross(edge, ray)
    size = np.linalg.norm(across, axis=1)
    across /= np.maximum(size, 1e-9)[:, None]
    # sigma: |v.m|, d_1, the root's two terms
    flight = time_samples[1] - time_samples[0]
    pace = np.abs(across @ (flight / np.linalg.norm(flight)))
    before = length - behind
    unit = wavelength * behind * length / (2 * before)
    cell = HALF_WIDTH**2 * area * (1 - (across * normals).sum(1) ** 2)
    with np.errstate(divide="ignore"):
        width = before / (behind * pace) * np.sqrt(unit + cell)
    return np.where(blocked & (size > 1e-6), width, np.inf)
