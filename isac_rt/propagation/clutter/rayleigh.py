"""The paper's urban clutter: consecutive range cells with static Rayleigh amplitudes, added to any
propagation model.

The paper (section V.A) says: Rayleigh amplitudes "with the noise variance as 1", on average 10 dB
over the target's; 40 to 50 consecutive range cells; their centre drawn between 20 and 30 m;
velocity 0. The choices it leaves open are:

- the mean power is 10 dB over the link's reference path: at a PT its line of sight, which the
  paper calls its target;
- cells that would begin before cell 1 are shifted, not cut;
- amplitudes are constant within a frame, so coherent, and independent between frames and cells;
- scatterers lie at random in their cells, so that their sidelobes show;
- directions are uniform in azimuth and elevation over the field of view. On a monostatic link
  departure and arrival are equal, between two terminals they are independent.

Each scatterer is a path of kind DIFFUSE with delay rate 0: static relative to the receiver, as a
city is only for a hovering one. As an echo of the transmitted chirps it carries their data.
"""

from __future__ import annotations

import numpy as np

from isac_rt.frame.link import Link
from isac_rt.frame.waveform import SPEED_OF_LIGHT, Waveform
from isac_rt.propagation.free_space import FreeSpace
from isac_rt.propagation.model import Census, Propagation, Traced
from isac_rt.propagation.pathset import PathKind, PathSet, make_paths, merge
from isac_rt.propagation.settings import Clutter
from isac_rt.randomness import generator
from isac_rt.world.swarm import Pose


def rayleigh_cells(
    clutter: Clutter, range_cell: float, rng: np.random.Generator
) -> tuple[np.ndarray, np.ndarray]:
    """Draw the clutter of one link and frame.

    Parameters
    ----------
    range_cell : [m]

    Returns
    -------
    ranges : (K,) [m], one in each of K consecutive cells from cell 1 on
    amplitudes : (K,) complex, circular Gaussian - Rayleigh magnitude, uniform phase - relative to
        the reference path's amplitude
    """
    low, high = clutter.cells
    count = int(rng.integers(low, high + 1))
    centre = rng.uniform(*clutter.centre_m) / range_cell
    first = max(round(centre - (count - 1) / 2), 1)
    ranges = (first + np.arange(count) + rng.uniform(-0.5, 0.5, count)) * range_cell
    white = rng.standard_normal((count, 2)) @ np.array([1, 1j]) / np.sqrt(2)
    return ranges, 10 ** (clutter.level_db / 20) * white


class RayleighClutter:
    """A propagation model with the paper's clutter on every link."""

    def __init__(
        self, model: Propagation, reference: FreeSpace, clutter: Clutter, waveform: Waveform
    ) -> None:
        self.model, self._reference, self._clutter = model, reference, clutter
        self._waveform = waveform

    def census(self) -> Census:
        """Return the census of the underlying model."""
        return self.model.census()

    def trace(self, poses: dict[str, Pose], epoch: float, links: list[Link]) -> Traced:
        """Return the paths of the model and of the clutter, drawn by seed, link and epoch."""
        paths, dropped = self.model.trace(poses, epoch, links)
        return Traced(
            {link: merge([p, self._scatterers(p, poses)]) for link, p in paths.items()}, dropped
        )

    def _scatterers(self, paths: PathSet, poses: dict[str, Pose]) -> PathSet:
        (tx, rx), epoch, own = paths.link, paths.epoch, paths.link.own
        passes = paths.link.passes
        rng = generator(self._reference.seed, "rayleigh clutter", tx, rx, repr(float(epoch)))
        ranges, amplitudes = rayleigh_cells(self._clutter, self._waveform.range_cell(passes), rng)
        departure = arrival = poses[tx].to_world(self._directions(tx, ranges.size, rng))
        if not own:
            arrival = poses[rx].to_world(self._directions(rx, ranges.size, rng))
        return make_paths(
            gain=self._reference.reference_amplitude(poses, paths.link) * amplitudes,
            delay=passes * ranges / SPEED_OF_LIGHT,
            departure=departure,
            arrival=arrival,
            kind=PathKind.DIFFUSE,
            epoch=epoch,
            tx=tx,
            rx=rx,
            target_names=paths.target_names,
        )

    def _directions(self, name: str, count: int, rng: np.random.Generator) -> np.ndarray:
        """Draw unit vectors (count, 3) in the body frame, uniform in azimuth and elevation over a
        terminal's field of view."""
        half_view = self._reference.arrays.of(name).half_view
        azimuth, elevation = rng.uniform(-half_view, half_view, (2, count))
        flat = np.cos(elevation)
        return np.stack([flat * np.sin(azimuth), flat * np.cos(azimuth), np.sin(elevation)], axis=1)
