"""The paths of one link in one frame: what propagation hands to the signal model and to the
ledger."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from enum import IntEnum
from typing import Any

import numpy as np

from isac_rt.frame.link import Link


class PathKind(IntEnum):
    """What a path is; its label from the mesh to the detection it causes."""

    LINE_OF_SIGHT = 0
    TARGET = 1  # one echo of a UAV, straight there and straight on
    GHOST = 2  # an echo of a UAV with bounces off the city before or after it
    SPECULAR = 3  # the city alone, mirror-like
    DIFFUSE = 4  # the city alone, scattered
    LEAKAGE = 5  # the transmitter into its own receiver


@dataclass(frozen=True, kw_only=True)
class PathSet:
    """K paths from one transmitter to one receiver, flat arrays, read-only.

    Attributes
    ----------
    gain : (K,) complex128; amplitude and reflection phase, antenna elements included, the carrier
        phase exp(-j 2 pi f_c tau) not
    delay, delay_rate, delay_accel : (K,) float64 [s, 1, 1/s] at `epoch`; tau(t) = delay +
        delay_rate*t + delay_accel*t^2/2 with t since the epoch; Doppler is -f_c * delay_rate
        (closing is positive)
    departure, arrival : (K, 3) unit vectors in world axes; along the first segment, and from the
        receiver towards where the wave comes from
    tx_radius, rx_radius : (K,) radius of curvature of the wavefront at either end [m]; inf is a
        plane wave
    kind : (K,) int8 PathKind
    target : (K,) int16 index into `target_names`, -1 where no UAV is involved
    bounces : (K,) int16 interactions with the city
    begin, end : (K,) float64 [s since the epoch], when the path lives; -inf and inf for the whole
        frame
    epoch : time of the middle of the frame [s]
    tx, rx : names of the terminals
    target_names : names that `target` indexes
    points : (K, B, 3) interaction points in world coordinates, NaN where there is none (a UAV's own
        position, and shadow edges round which a path bends, included)
    faces : (K, B) int32 face of the city mesh at each point, -1 where there is none
    """

    gain: np.ndarray
    delay: np.ndarray
    delay_rate: np.ndarray
    delay_accel: np.ndarray
    departure: np.ndarray
    arrival: np.ndarray
    tx_radius: np.ndarray
    rx_radius: np.ndarray
    kind: np.ndarray
    target: np.ndarray
    bounces: np.ndarray
    begin: np.ndarray
    end: np.ndarray
    epoch: float
    tx: str
    rx: str
    target_names: tuple[str, ...]
    points: np.ndarray
    faces: np.ndarray

    def __post_init__(self) -> None:
        count = self.delay.shape[0]
        for field in fields(self):
            value = getattr(self, field.name)
            if isinstance(value, np.ndarray):
                if value.shape[0] != count:
                    raise ValueError(
                        f"PathSet.{field.name} has {value.shape[0]} rows, delay has {count}"
                    )
                value.setflags(write=False)
        finite = (
            np.isfinite(self.delay).all()
            and np.isfinite(self.gain).all()
            and np.isfinite(self.delay_rate).all()
        )
        if not finite:
            raise ValueError(
                f"paths {self.tx}->{self.rx}: a delay, delay rate or gain is not finite"
            )

    def __len__(self) -> int:
        return self.delay.shape[0]

    def __repr__(self) -> str:
        kinds = ", ".join(
            f"{count} {name.replace('_', ' ')}" for name, count in self.counts().items() if count
        )
        spans = (
            f", {self.delay.min() * 1e9:.1f} to {self.delay.max() * 1e9:.1f} ns"
            if len(self)
            else ""
        )
        return (
            f"<PathSet {self.tx} -> {self.rx} at {self.epoch:.4f} s: {kinds or 'no paths'}{spans}>"
        )

    @property
    def link(self) -> Link:
        """Who hears whom."""
        return Link(self.tx, self.rx)

    @property
    def power(self) -> np.ndarray:
        """(K,) ``|gain|^2``."""
        return np.abs(self.gain) ** 2

    @property
    def bent(self) -> np.ndarray:
        """(K,) whether a path bends round a shadow edge: it has a point that is neither a bounce
        nor a UAV."""
        return np.isfinite(self.points).all(axis=2).sum(axis=1) > self.bounces + (self.target >= 0)

    def select(self, which: np.ndarray) -> PathSet:
        """The paths that a mask or an index array chooses."""
        return replace(
            self,
            **{
                f.name: getattr(self, f.name)[which]
                for f in fields(self)
                if isinstance(getattr(self, f.name), np.ndarray)
            },
        )

    def counts(self) -> dict[str, int]:
        """Number of paths of each kind, by the kind's name in lower case."""
        return {k.name.lower(): int((self.kind == k).sum()) for k in PathKind}


def make_paths(
    *,
    gain: np.ndarray,
    delay: np.ndarray,
    departure: np.ndarray,
    arrival: np.ndarray,
    kind: np.ndarray | int,
    epoch: float,
    tx: str,
    rx: str,
    delay_rate: np.ndarray | float = 0.0,
    delay_accel: np.ndarray | float = 0.0,
    tx_radius: np.ndarray | float = np.inf,
    rx_radius: np.ndarray | float = np.inf,
    target: np.ndarray | int = -1,
    bounces: np.ndarray | int = 0,
    begin: np.ndarray | float = -np.inf,
    end: np.ndarray | float = np.inf,
    target_names: tuple[str, ...] = (),
    points: np.ndarray | None = None,
    faces: np.ndarray | None = None,
) -> PathSet:
    """A PathSet from what is known; the rest gets its neutral value. Arrays are copied."""
    count = np.asarray(delay).shape[0]

    def full(value: np.ndarray | float, dtype: type) -> np.ndarray:
        return np.array(np.broadcast_to(value, (count,)), dtype=dtype)

    return PathSet(
        gain=full(gain, np.complex128),
        delay=full(delay, np.float64),
        delay_rate=full(delay_rate, np.float64),
        delay_accel=full(delay_accel, np.float64),
        departure=np.array(departure, np.float64).reshape(count, 3),
        arrival=np.array(arrival, np.float64).reshape(count, 3),
        tx_radius=full(tx_radius, np.float64),
        rx_radius=full(rx_radius, np.float64),
        kind=full(kind, np.int8),
        target=full(target, np.int16),
        bounces=full(bounces, np.int16),
        begin=full(begin, np.float64),
        end=full(end, np.float64),
        epoch=float(epoch),
        tx=tx,
        rx=rx,
        target_names=target_names,
        points=np.full((count, 0, 3), np.nan) if points is None else np.array(points, np.float64),
        faces=np.full((count, 0), -1, np.int32) if faces is None else np.array(faces, np.int32),
    )


def merge(parts: list[PathSet]) -> PathSet:
    """All paths of one link in one set, in the order given; interaction lists are padded to the
    longest."""
    first = parts[0]
    if any(
        (p.tx, p.rx, p.epoch, p.target_names)
        != (first.tx, first.rx, first.epoch, first.target_names)
        for p in parts
    ):
        raise ValueError("merge needs path sets of one link, epoch and list of targets")
    depth = max(p.faces.shape[1] for p in parts)

    def padded(a: np.ndarray, fill: float) -> np.ndarray:
        width = [(0, 0), (0, depth - a.shape[1])] + [(0, 0)] * (a.ndim - 2)
        return np.pad(a, width, constant_values=fill)

    stacked: dict[str, Any] = {}
    for f in fields(first):
        values = [getattr(p, f.name) for p in parts]
        if f.name == "points":
            values = [padded(v, np.nan) for v in values]
        elif f.name == "faces":
            values = [padded(v, -1) for v in values]
        if isinstance(values[0], np.ndarray):
            stacked[f.name] = np.concatenate(values)
    return replace(first, **stacked)
