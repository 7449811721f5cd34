"""Boxes that move, such as cars and trams: their shadows on all paths, and paths over their
faces."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from isac_rt.extensions.street.centres import attitude_about, body_axes
from isac_rt.extensions.street.faces import Box, Mirrors
from isac_rt.extensions.street.occlusion import Occlusion
from isac_rt.extensions.street.shadows import STEP, Shadows
from isac_rt.extensions.street.solid import Solid, solid_of_box
from isac_rt.frame.link import Link
from isac_rt.frame.waveform import Waveform
from isac_rt.propagation.free_space import FreeSpace
from isac_rt.propagation.model import Census, Propagation, Traced
from isac_rt.propagation.pathset import PathSet, merge
from isac_rt.propagation.scatter_paths import LinkState
from isac_rt.world.city.materials import CityError, Material, MaterialUse, resolve_materials
from isac_rt.world.settings import MaterialOverride
from isac_rt.world.swarm import Pose, Swarm

TURN_STEP = 1e-4
"""Step [s] of the differences that are a box's turn: 1e-9 rad/s and 1e-8 rad/s^2 of error."""
SHADOWED = 0.5
"""Factor of the amplitude up to which the plan calls a path shadowed: 6 dB, that at an edge."""


class Boxes:
    """A propagation model with boxes.

    Parameters
    ----------
    swarm : whose UAVs may have boxes
    changes : of materials, by name
    model : of the paths without boxes
    free : terminals and antennas
    waveform : of the run
    city : whose surfaces hide faces; None: open space
    """

    def __init__(
        self,
        swarm: Swarm,
        changes: Mapping[str, MaterialOverride],
        model: Propagation,
        free: FreeSpace,
        waveform: Waveform,
        city: Any,
    ) -> None:
        self.model, self._swarm, self._free = model, swarm, free
        self._half_frame = waveform.frame_duration / 2
        self._occlusion = Occlusion(city, waveform.carrier_frequency)
        self._shapes: dict[str, tuple[Solid, Material]] = {}
        for name, uav in swarm.uavs.items():
            if uav.box is not None:
                use = MaterialUse(uav.box.material)
                try:
                    _, (material,) = resolve_materials([use], waveform.carrier_frequency, changes)
                except CityError as problem:
                    raise CityError(f"swarm.{name}.box.material: {problem}") from None
                self._shapes[name] = solid_of_box(name, uav.box), material

    def census(self) -> Census:
        """Return the census of the underlying model."""
        return self.model.census()

    def trace(self, poses: dict[str, Pose], epoch: float, links: list[Link]) -> Traced:
        """Return the model's paths and those over faces, shadowed."""
        found, dropped = self.model.trace(poses, epoch, links)
        out, boxes = {}, self._boxes(poses, epoch)
        mirrors = Mirrors(boxes, self._free, self._occlusion, self._half_frame)
        for link, paths in found.items():
            shadows = self.shadows(paths, poses, boxes)
            echoes = mirrors.echoes(shadows.state, poses)
            lit = merge([paths, *mirrors.between_terminals(shadows.state), *echoes])
            out[link] = replace(lit, gain=lit.gain * shadows.factor(lit))
        return Traced(out, dropped)

    def shadows(
        self, paths: PathSet, poses: dict[str, Pose], boxes: list[Box] | None = None
    ) -> Shadows:
        """Return the shadows on a link's paths at their epoch, of the boxes at that time."""
        boxes = self._boxes(poses, paths.epoch) if boxes is None else boxes
        (tx, rx), names = paths.link, paths.target_names
        state = LinkState(paths.link, paths.epoch, poses[tx], poses[rx], names)
        return Shadows(boxes, state, poses, self._free.wavelength, self._half_frame)

    def _boxes(self, poses: dict[str, Pose], epoch: float) -> list[Box]:
        """Return the boxes at an instant."""
        out, names = [], list(self._swarm.uavs)
        for name, shape in self._shapes.items():
            attitude = attitude_about(self._swarm, name, epoch, TURN_STEP)
            out.append(Box(names.index(name), *shape, poses[name], attitude))
        return out

    def report(
        self, frames: Sequence[tuple[dict[str, Pose], Mapping[Link, PathSet]]]
    ) -> list[dict[str, Any]]:
        """Return what the plan says of the boxes in some frames: `Item`'s values by name."""
        counts: dict[Link, list[list[int]]] = {}
        for poses, found in frames:
            for link, paths in found.items():
                shadows = self.shadows(paths, poses)
                hidden = np.abs(shadows.factor(paths)) <= SHADOWED
                masks = hidden, shadows.counts(paths) > 1, (paths.faces < -1).any(axis=1)
                counts.setdefault(link, []).append([int(mask.sum()) for mask in masks])
        rows = []
        for link, of_link in counts.items():
            hidden, changing, over = (f"{n:.3g}" for n in np.mean(of_link, axis=0))
            row = {"what": "boxes of " + ", ".join(self._shapes), "link": str(link)}
            row["modelled"] = f"{hidden} paths a frame shadowed by 6 dB or more, {changing} whose "
            row["modelled"] += f"shadow changes in the frame, {over} over faces"
            row["left_out"] = "edges of faces, two boxes in turn, a box and a wall"
            rows.append({**row, "estimate": STEP, "unit": "of a path's amplitude"})
        return rows


def box_corners(swarm: Swarm, times: Sequence[float]) -> dict[str, np.ndarray]:
    """Return the corners (T, V, 3) of a swarm's boxes at some times [s], by UAV."""
    out = {}
    for name, uav in swarm.uavs.items():
        if uav.box is not None:
            corners, flight = solid_of_box(name, uav.box).corners, swarm.trajectories[name]
            axes = np.array([body_axes(swarm, name, t) for t in times])
            out[name] = flight.positions(np.asarray(times))[:, None] + corners @ axes.swapaxes(1, 2)
    return out
