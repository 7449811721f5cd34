"""Line of sight and point targets in closed form, one-way and echo."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from isac_rt.frame.antennas import Antennas
from isac_rt.frame.link import Link
from isac_rt.frame.waveform import SPEED_OF_LIGHT
from isac_rt.propagation.elements import element_amplitude
from isac_rt.propagation.legs.geometry import straight
from isac_rt.propagation.model import Census, Traced
from isac_rt.propagation.pathset import PathKind, PathSet, make_paths, merge
from isac_rt.propagation.rcs import CrossSection
from isac_rt.scenario.swarm import Uav
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
    antennas : of every terminal
    wavelength : [m]
    seed : of the cross-sections' fluctuations
    """

    uavs: dict[str, Uav]
    antennas: Antennas
    wavelength: float
    seed: int

    @cached_property
    def names(self) -> tuple[str, ...]:
        """Of the UAVs."""
        return tuple(self.uavs)

    @cached_property
    def sections(self) -> dict[str, CrossSection]:
        """Cross-section of every UAV."""
        return {name: CrossSection(uav.rcs, name, self.seed) for name, uav in self.uavs.items()}

    def trace(self, poses: dict[str, Pose], epoch: float, links: list[Link]) -> Traced:
        """Paths of every link; those that no element sends or hears are left out."""
        return Traced({Link(*link): self._link(poses, epoch, *link) for link in links})

    def census(self) -> Census:
        """No clutter at all."""
        return Census()

    def _link(self, poses: dict[str, Pose], epoch: float, tx: str, rx: str) -> PathSet:
        parts = [self.echoes(poses, epoch, tx, rx)]
        if tx != rx:
            parts.insert(0, self.line_of_sight(poses, epoch, tx, rx))
        every = merge(parts)
        return every.select(every.gain != 0)

    def line_of_sight(self, poses: dict[str, Pose], epoch: float, tx: str, rx: str) -> PathSet:
        """The straight path of a link, by Friis."""
        leg = straight(
            poses[tx], poses[rx].position[None], poses[rx].velocity, poses[rx].acceleration
        )
        elements = element_amplitude(
            self.antennas, poses[tx], poses[rx], leg.departure, leg.arrival
        )
        return make_paths(
            gain=friis_amplitude(self.wavelength, leg.length) * elements,
            delay=leg.length / SPEED_OF_LIGHT,
            delay_rate=leg.rate / SPEED_OF_LIGHT,
            delay_accel=leg.accel / SPEED_OF_LIGHT,
            departure=leg.departure,
            arrival=leg.arrival,
            tx_radius=leg.length,
            rx_radius=leg.length,
            kind=PathKind.LINE_OF_SIGHT,
            epoch=epoch,
            tx=tx,
            rx=rx,
            target_names=self.names,
        )

    def echoes(self, poses: dict[str, Pose], epoch: float, tx: str, rx: str) -> PathSet:
        """Echoes of every UAV that is neither end, straight there and straight on."""
        others = [name for name in self.names if name not in (tx, rx)]
        there, on = ([self._leg(poses, end, name) for name in others] for end in (tx, rx))

        def stack(legs: list, name: str) -> np.ndarray:
            return (
                np.concatenate([getattr(leg, name) for leg in legs]) if legs else np.zeros((0, 3))
            )

        dep, arr = stack(there, "departure"), stack(on, "departure")
        d1, d2 = (np.array([leg.length[0] for leg in legs]) for legs in (there, on))
        amplitude = np.array(
            [
                self.echo_amplitude(poses, tx, rx, name, a, b)
                for name, a, b in zip(others, there, on, strict=True)
            ]
        )
        elements = element_amplitude(self.antennas, poses[tx], poses[rx], dep, arr)
        relative = np.array([self.uavs[name].rcs.model == "relative" for name in others], bool)
        return make_paths(
            gain=np.where(relative, amplitude * (elements > 0), amplitude * elements),
            delay=(d1 + d2) / SPEED_OF_LIGHT,
            delay_rate=np.array([a.rate[0] + b.rate[0] for a, b in zip(there, on, strict=True)])
            / SPEED_OF_LIGHT,
            delay_accel=np.array([a.accel[0] + b.accel[0] for a, b in zip(there, on, strict=True)])
            / SPEED_OF_LIGHT,
            departure=dep,
            arrival=arr,
            tx_radius=d1,
            rx_radius=d2,
            kind=PathKind.TARGET,
            target=np.array([self.names.index(name) for name in others], int),
            epoch=epoch,
            tx=tx,
            rx=rx,
            target_names=self.names,
            points=np.array([poses[name].position for name in others]).reshape(-1, 1, 3),
            faces=np.full((len(others), 1), -1),
        )

    def _leg(self, poses: dict[str, Pose], end: str, name: str):
        return straight(
            poses[end], poses[name].position[None], poses[name].velocity, poses[name].acceleration
        )

    def echo_amplitude(
        self, poses: dict[str, Pose], tx: str, rx: str, name: str, there, on
    ) -> float:
        """Amplitude of one UAV's echo: by the radar equation without the elements, or, with a
        relative cross-section, a fixed level under the link's reference path, elements included."""
        rcs = self.uavs[name].rcs
        if rcs.model == "relative":
            return self.reference_amplitude(poses, tx, rx) * 10 ** (rcs.level_db / 20)
        body = poses[name]
        section = self.sections[name].square_metres(
            body.to_body(there.arrival), body.to_body(on.arrival)
        )
        return float(radar_amplitude(self.wavelength, section, there.length, on.length)[0])

    def reference_amplitude(self, poses: dict[str, Pose], tx: str, rx: str) -> float:
        """Amplitude of a link's reference path as if unshadowed and on boresight at both ends.

        The line of sight of a link between two terminals; for a terminal's own echoes the strongest
        by the radar equation among the UAVs whose cross-section is not itself relative.

        Raises
        ------
        ValueError  If a terminal's own link has no such UAV.
        """
        if tx != rx:
            distance = np.linalg.norm(poses[rx].position - poses[tx].position)
            return float(friis_amplitude(self.wavelength, distance) * self.antennas.gain)
        return self._own_echoes(poses, tx)[self.strongest_target(poses, tx)] * self.antennas.gain

    def has_target(self, tx: str) -> bool:
        """Whether there is another UAV whose cross-section is its own."""
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
                leg = self._leg(poses, tx, name)
                out[name] = self.echo_amplitude(poses, tx, tx, name, leg, leg)
        return out
