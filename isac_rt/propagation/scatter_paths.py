"""Ways from a transmitter to a receiver, and the paths that run along them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from isac_rt.frame.antennas import Arrays
from isac_rt.frame.link import Link
from isac_rt.frame.waveform import SPEED_OF_LIGHT
from isac_rt.propagation.pathset import PathKind, PathSet, make_paths
from isac_rt.propagation.segments.geometry import Segments
from isac_rt.world.swarm import Pose


@dataclass(frozen=True)
class ScatterPaths:
    """K ways of waves between the ends of a link.

    Attributes
    ----------
    length, rate, accel : (K,) [m, m/s, m/s^2]
    tx_radius, rx_radius : (K,) of the wavefront's curvature at either end [m]
    departure, arrival : (K, 3) unit vectors at either end, away from it
    """

    length: np.ndarray
    rate: np.ndarray
    accel: np.ndarray
    tx_radius: np.ndarray
    rx_radius: np.ndarray
    departure: np.ndarray
    arrival: np.ndarray

    @classmethod
    def along(cls, segment: Segments) -> ScatterPaths:
        """From end to end in one segment."""
        ends = segment.length, segment.length, segment.departure, segment.arrival
        return cls(segment.length, segment.rate, segment.accel, *ends)

    @classmethod
    def over(cls, there: Segments, back: Segments) -> ScatterPaths:
        """By way of what scatters; `there` starts at the transmitter, `back` at the receiver."""
        motion = there.length + back.length, there.rate + back.rate, there.accel + back.accel
        return cls(*motion, there.length, back.length, there.departure, back.departure)


@dataclass(frozen=True)
class LinkState:
    """One link at one instant.

    Attributes
    ----------
    link : Link
    epoch : [s]
    start, end : poses of the transmitter and of the receiver
    target_names : what the paths' `target` may name
    """

    link: Link
    epoch: float
    start: Pose
    end: Pose
    target_names: tuple[str, ...] = ()

    def elements(self, arrays: Arrays, scatter_paths: ScatterPaths) -> np.ndarray:
        """(K,) sqrt(G_tx G_rx) of the elements at both ends: the one place where antennas touch a
        gain."""
        tx, rx = (arrays.of(name) for name in self.link)
        sent = tx.element_gain(self.start.to_body(scatter_paths.departure))
        if self.link.own and scatter_paths.arrival is scatter_paths.departure:
            return sent
        return np.sqrt(sent * rx.element_gain(self.end.to_body(scatter_paths.arrival)))

    def paths(
        self,
        scatter_paths: ScatterPaths,
        gain: np.ndarray,
        kind: np.ndarray | PathKind,
        *,
        bounces: np.ndarray | int = 0,
        target: np.ndarray | int = -1,
        points: np.ndarray | None = None,
        faces: np.ndarray | None = None,
    ) -> PathSet:
        """Paths along ways, with the interactions in the order in which the wave meets them; those
        that no element sends or receives are left out."""
        columns: dict[str, Any] = dict(
            gain=gain,
            delay=scatter_paths.length / SPEED_OF_LIGHT,
            delay_rate=scatter_paths.rate / SPEED_OF_LIGHT,
            delay_accel=scatter_paths.accel / SPEED_OF_LIGHT,
            departure=scatter_paths.departure,
            arrival=scatter_paths.arrival,
            tx_radius=scatter_paths.tx_radius,
            rx_radius=scatter_paths.rx_radius,
            kind=kind,
            target=target,
            bounces=bounces,
            points=points,
            faces=faces,
        )
        there = np.flatnonzero(gain)
        if there.size < gain.size:
            columns = {n: v.take(there, axis=0) if np.ndim(v) else v for n, v in columns.items()}
        (tx, rx), names = self.link, self.target_names
        return make_paths(tx=tx, rx=rx, epoch=self.epoch, target_names=names, **columns)
