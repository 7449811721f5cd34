"""Obstruction by the swarm's own UAVs: each is an opaque disc with its Fresnel shadow."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from isac_rt.kernels import propagation_discs
from isac_rt.kernels.jit import twin_of
from isac_rt.propagation.segments.diffraction import LIT_REACH, disc, fresnel_unit, tapered
from isac_rt.world.settings import Uav
from isac_rt.world.swarm import Pose


@dataclass(frozen=True)
class UavDiscs:
    """All UAVs at one instant, local coordinates.

    Attributes
    ----------
    names : of the N UAVs that have a size
    positions : (N, 3) [m]
    radii : (N,) [m]
    """

    names: tuple[str, ...]
    positions: np.ndarray
    radii: np.ndarray

    @classmethod
    def of(cls, uavs: Mapping[str, Uav], poses: dict[str, Pose]) -> UavDiscs:
        """UAVs of a scenario's UAVs where they are."""
        names = tuple(
            name
            for name, uav in uavs.items()
            if uav.body_radius_m > 0 and uav.box is None and name in poses
        )
        positions = np.array([poses[name].position for name in names]).reshape(-1, 3)
        return cls(names, positions, np.array([uavs[name].body_radius_m for name in names]))

    def spared(self, names: Sequence[Collection[str]]) -> np.ndarray:
        """(R, N) bool: the UAV ends or scatters the segment, so that it does not shadow it."""
        rows = [[uav in of_segment for uav in self.names] for of_segment in names]
        return np.array(rows, bool).reshape(len(rows), len(self.names))

    def factor(self, chain: np.ndarray, wavelength: float, spared: np.ndarray) -> np.ndarray:
        """Amplitude factor of paths past the UAVs: the product of `disc` over the UAVs and the
        straight parts.

        Parameters
        ----------
        chain : (K, B + 2, 3) both ends and the B points between them at which each path is mirrored
            or bent
        wavelength : [m]
        spared : (K, N), or (1, N) for all, which UAVs leave a path alone

        Returns
        -------
        (K,) complex128
        """
        out = np.ones(len(chain), complex)
        lengths = np.linalg.norm(np.diff(chain, axis=1), axis=2)
        total, before = lengths.sum(axis=1), np.cumsum(lengths, axis=1) - lengths
        for k in range(chain.shape[1] - 1):
            self._shade(out, chain[:, k], chain[:, k + 1], before[:, k], total, wavelength, spared)
        return out

    def gain(
        self,
        position: np.ndarray,
        points: np.ndarray,
        distance: np.ndarray,
        wavelength: float,
        spared: np.ndarray,
    ) -> np.ndarray:
        """(K,) modulus of the factor from one place (3,) to points (K, 3) at known distances (K,)
        [m]."""
        factor, out = np.ones(len(points), complex), np.ones(len(points))
        position, before = np.broadcast_to(position, points.shape), np.zeros(len(points))
        path = self._shade(factor, position, points, before, distance, wavelength, spared)
        out[path] = np.abs(factor[path])
        return out

    def _shade(
        self, out, starts, ends, before, total, wavelength: float, spared: np.ndarray
    ) -> np.ndarray:
        """Multiply `out` by the factors of straight parts that begin `before` along paths of length
        `total`; the paths that a body is near, once for each."""
        # one layout, for which `near` is compiled once
        starts, ends, before = (np.array(a, order="C") for a in (starts, ends, before))
        path, uav, off, along = near(
            starts, ends, before, total, self.positions, self.radii, spared, wavelength, LIT_REACH
        )
        radius = self.radii[uav]
        far = np.maximum(total[path] - along, radius)  # nearer than its own size a disc is none
        unit = fresnel_unit(wavelength, np.maximum(along, radius), far)
        nu, size = off / unit, radius / unit
        np.multiply.at(out, path, tapered(disc(nu, size), nu - size))
        return path


@twin_of(propagation_discs.near)
def near(starts, ends, before, total, positions, radii, spared, wavelength, reach):
    """Find the straight segments (K,) that pass a disc (N,) within `reach` Fresnel units of its
    edge, unless `spared` (K or 1, N).

    Parameters
    ----------
    starts, ends : (K, 3) of the segments [m]
    before, total : (K,) distance along the path before the segment, and of the whole path [m]
    positions, radii : (N, 3) and (N,) of the discs [m]

    Returns
    -------
    segment and disc of each pass, distance of the disc's centre and distance along the path [m]
    """
    span, to = ends - starts, positions - starts[:, None]
    square = np.maximum((span**2).sum(axis=1), np.finfo(float).tiny)[:, None]
    dot = (to * span[:, None]).sum(axis=2)
    across = np.sqrt(np.maximum((to**2).sum(axis=2) - dot**2 / square, 0.0))
    at = before[:, None] + dot / np.sqrt(square)
    first, rest = np.maximum(at, radii), np.maximum(total[:, None] - at, radii)
    edge = reach * np.sqrt(wavelength * first * rest / (2 * (first + rest)))  # reach of the shadow
    passed = (dot > 0) & (dot < square) & ~spared & (across - radii < edge)
    segment, disc = np.nonzero(passed)
    return segment, disc, across[passed], at[passed]
