"""Line of sight and point targets in closed form, one-way and echo."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from isac_rt.frame.antennas import Arrays
from isac_rt.frame.link import Link
from isac_rt.propagation.model import Census, Traced
from isac_rt.propagation.pathset import PathKind, PathSet, merge
from isac_rt.propagation.rcs import CrossSection
from isac_rt.propagation.scatter_paths import LinkState, ScatterPaths
from isac_rt.propagation.segments.geometry import Segments, straight
from isac_rt.registry import extension
from isac_rt.world.settings import Rcs, Uav
from isac_rt.world.swarm import Pose


def friis_amplitude(wavelength: float, distance: Any) -> Any:
    """lambda / (4 pi d), isotropic ends."""
    return wavelength / (4 * np.pi * distance)


def radar_amplitude(wavelength: float, cross_section: Any, there: Any, on: Any) -> Any:
    """sqrt(lambda^2 sigma / ((4 pi)^3 r1^2 r2^2)), isotropic ends: the bistatic radar equation."""
    return wavelength * np.sqrt(cross_section / (4 * np.pi) ** 3) / (there * on)


@dataclass(frozen=True)
class FreeSpace:
    """Paths between terminals and by way of the other UAVs, with nothing in between.

    Attributes
    ----------
    uavs : by name, in the order in which paths name them
    arrays : antennas of every terminal
    wavelength : [m]
    seed : of the cross-sections' fluctuations
    """

    uavs: Mapping[str, Uav]
    arrays: Arrays
    wavelength: float
    seed: int

    @cached_property
    def names(self) -> tuple[str, ...]:
        """Names of the UAVs."""
        return tuple(self.uavs)

    @cached_property
    def sections(self) -> dict[str, CrossSection]:
        """Cross-section of every UAV: as stated, or that of its extent."""
        return {
            name: CrossSection(uav.rcs, name, self.seed)
            if uav.extent is None or uav.rcs != Rcs()
            else extension("section_of_extent")(uav.extent, self.seed, name)
            for name, uav in self.uavs.items()
        }

    def trace(self, poses: dict[str, Pose], epoch: float, links: list[Link]) -> Traced:
        """Paths of every link; those that no element sends or receives are left out."""
        states = [
            LinkState(Link(tx, rx), epoch, poses[tx], poses[rx], self.names) for tx, rx in links
        ]
        return Traced({state.link: self._link(state, poses) for state in states})

    def census(self) -> Census:
        """No clutter at all."""
        return Census()

    def _link(self, state: LinkState, poses: dict[str, Pose]) -> PathSet:
        parts = [] if state.link.own else [self._line_of_sight(state)]
        return merge([*parts, self._echoes(state, poses)])

    def _line_of_sight(self, state: LinkState) -> PathSet:
        """The straight path of a link, by Friis."""
        end = state.end
        scatter_paths = ScatterPaths.along(
            straight(state.start, end.position[None], end.velocity, end.acceleration)
        )
        gain = friis_amplitude(self.wavelength, scatter_paths.length) * state.elements(
            self.arrays, scatter_paths
        )
        return state.paths(scatter_paths, gain, PathKind.LINE_OF_SIGHT)

    def _echoes(self, state: LinkState, poses: dict[str, Pose]) -> PathSet:
        """Echoes of every UAV that is neither end, straight there and straight on."""
        others = [name for name in self.names if name not in state.link]
        there, back = (self._segments(end, others, poses) for end in (state.start, state.end))
        scatter_paths = ScatterPaths.over(there, back)
        amplitude = np.empty(len(others))
        for k, name in enumerate(others):
            rcs, row = self.uavs[name].rcs, slice(k, k + 1)
            if rcs.model == "relative":
                amplitude[k] = self.reference_amplitude(poses, state.link)
                amplitude[k] *= 10 ** (rcs.level_db / 20)
            else:
                amplitude[k] = self._echo(name, poses, there.select(row), back.select(row))
        elements = state.elements(self.arrays, scatter_paths)
        relative = np.array([self.uavs[name].rcs.model == "relative" for name in others], bool)
        return state.paths(
            scatter_paths,
            np.where(relative, amplitude * (elements > 0), amplitude * elements),
            PathKind.TARGET,
            target=np.array([self.names.index(name) for name in others], int),
            points=np.array([poses[name].position for name in others]).reshape(-1, 1, 3),
            faces=np.full((len(others), 1), -1),
        )

    def _segments(self, end: Pose, names: Sequence[str], poses: dict[str, Pose]) -> Segments:
        """Straight segments from an end to UAVs."""
        motion = np.array([poses[name].motion() for name in names]).reshape(-1, 3, 3)
        return straight(end, *motion.swapaxes(0, 1))

    def _echo(self, name: str, poses: dict[str, Pose], there: Segments, back: Segments) -> float:
        """Amplitude of one UAV's echo by the radar equation, without the elements."""
        uav = poses[name]
        section = self.sections[name].square_metres(
            uav.to_body(there.arrival), uav.to_body(back.arrival)
        )
        return float(radar_amplitude(self.wavelength, section, there.length, back.length)[0])

    def reference_amplitude(self, poses: dict[str, Pose], link: Link) -> float:
        """Amplitude of a link's reference path as if unoccluded and on boresight at both ends.

        The line of sight of a link between two terminals; for a terminal's own echoes the strongest
        by the radar equation among the UAVs whose cross-section is not itself relative.

        Raises
        ------
        ValueError  If a terminal's own link has no such UAV.
        """
        tx, rx = link = Link(*link)
        if not link.own:
            distance = np.linalg.norm(poses[rx].position - poses[tx].position)
            return float(friis_amplitude(self.wavelength, distance) * self.arrays.at(link).gain)
        echoes = self._own_echoes(poses, tx)
        return echoes[self.strongest_target(poses, tx)] * self.arrays.of(tx).gain

    def has_target(self, tx: str) -> bool:
        """Return whether there is another UAV with a cross-section of its own."""
        return any(name != tx and uav.rcs.model != "relative" for name, uav in self.uavs.items())

    def strongest_target(self, poses: dict[str, Pose], tx: str) -> str:
        """The UAV whose echo is the reference of a terminal's own link."""
        echoes = self._own_echoes(poses, tx)
        if not echoes:
            raise ValueError(
                f"no UAV with a cross-section of its own to which {tx}'s SNR could refer; give one "
                "in swarm.*.rcs"
            )
        return max(echoes, key=echoes.__getitem__)

    def _own_echoes(self, poses: dict[str, Pose], tx: str) -> dict[str, float]:
        out = {}
        for name, uav in self.uavs.items():
            if name != tx and uav.rcs.model != "relative":
                segment = self._segments(poses[tx], [name], poses)
                out[name] = self._echo(name, poses, segment, segment)
        return out
