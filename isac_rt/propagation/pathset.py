"""The paths of one link in one frame."""

from __future__ import annotations

from dataclasses import dataclass, replace
from enum import IntEnum
from functools import cached_property
from typing import Any, Required, TypedDict, Unpack

import numpy as np
from numpy.typing import ArrayLike

from isac_rt.frame.link import Link


class PathKind(IntEnum):
    """Kind of a path; its label from the mesh to the detection it causes.

    Examples
    --------
    >>> PathKind(4).name, int(PathKind.GHOST)
    ('DIFFUSE', 2)
    """

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
    faces : (K, B) int32 face of the city mesh at each point, -1 without one, -2 - n on UAV n's box

    Examples
    --------
    >>> paths = make_paths(
    ...     tx="AT",
    ...     rx="PT1",
    ...     epoch=0.0,
    ...     gain=[1e-6, 2e-7j],
    ...     delay=[1e-7, 3e-7],
    ...     departure=[[0, 1, 0], [1, 0, 0]],
    ...     arrival=[[0, -1, 0], [1, 0, 0]],
    ...     kind=[PathKind.LINE_OF_SIGHT, PathKind.SPECULAR],
    ... )
    >>> paths
    <PathSet AT -> PT1 at 0.0000 s: 1 line of sight, 1 specular, 100.0 to 300.0 ns>
    >>> paths.select(paths.kind == PathKind.SPECULAR).delay.tolist()
    [3e-07]
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
        for name, array in self.arrays().items():
            if array.shape[0] != count:
                raise ValueError(f"PathSet.{name} has {array.shape[0]} rows, delay has {count}")
            array.setflags(write=False)
        if not all(np.isfinite(a).all() for a in (self.delay, self.gain, self.delay_rate)):
            raise ValueError(f"paths {self.link}: a delay, delay rate or gain is not finite")

    def __len__(self) -> int:
        return self.delay.shape[0]

    def __repr__(self) -> str:
        kinds = ", ".join(
            f"{count} {name.replace('_', ' ')}" for name, count in self.counts().items() if count
        )
        spans = ""
        if len(self):
            spans = f", {self.delay.min() * 1e9:.1f} to {self.delay.max() * 1e9:.1f} ns"
        return (
            f"<PathSet {self.tx} -> {self.rx} at {self.epoch:.4f} s: {kinds or 'no paths'}{spans}>"
        )

    @property
    def link(self) -> Link:
        """Who receives whom."""
        return Link(self.tx, self.rx)

    @cached_property
    def power(self) -> np.ndarray:
        """(K,) ``|gain|^2``."""
        return np.abs(self.gain) ** 2

    @property
    def bent(self) -> np.ndarray:
        """(K,) bool: the path bends round an edge, a point neither a bounce nor a UAV."""
        return np.isfinite(self.points).all(axis=2).sum(axis=1) > self.bounces + (self.target >= 0)

    def select(self, which: np.ndarray) -> PathSet:
        """The paths that a mask or an index array chooses."""
        rows = np.flatnonzero(which) if np.asarray(which).dtype == bool else which
        chosen: dict[str, Any] = {n: a.take(rows, axis=0) for n, a in self.arrays().items()}
        return replace(self, **chosen)

    def arrays(self) -> dict[str, np.ndarray]:
        """The columns by name."""
        every = vars(self).items()
        return {n: a for n, a in every if isinstance(a, np.ndarray) and n != "power"}

    def counts(self) -> dict[str, int]:
        """Number of paths of each kind, by the kind's name in lower case."""
        return {k.name.lower(): int((self.kind == k).sum()) for k in PathKind}


class Columns(TypedDict, total=False):
    """The arrays of a `PathSet`, or one value for all paths."""

    gain: Required[ArrayLike]
    delay: Required[ArrayLike]
    departure: Required[ArrayLike]
    arrival: Required[ArrayLike]
    kind: Required[ArrayLike]
    delay_rate: ArrayLike
    delay_accel: ArrayLike
    tx_radius: ArrayLike
    rx_radius: ArrayLike
    target: ArrayLike
    bounces: ArrayLike
    begin: ArrayLike
    end: ArrayLike
    points: ArrayLike | None
    faces: ArrayLike | None


_NEUTRAL: dict[str, tuple[type, float]] = {
    "gain": (np.complex128, np.nan),
    "delay": (np.float64, np.nan),
    "delay_rate": (np.float64, 0.0),
    "delay_accel": (np.float64, 0.0),
    "tx_radius": (np.float64, np.inf),
    "rx_radius": (np.float64, np.inf),
    "kind": (np.int8, -1),
    "target": (np.int16, -1),
    "bounces": (np.int16, 0),
    "begin": (np.float64, -np.inf),
    "end": (np.float64, np.inf),
}
"""Type and neutral value of each column of numbers."""


def make_paths(
    *,
    tx: str,
    rx: str,
    epoch: float,
    target_names: tuple[str, ...] = (),
    **columns: Unpack[Columns],
) -> PathSet:
    """A PathSet from what is known; the rest gets its neutral value. Arrays are copied."""
    given: dict[str, Any] = {name: v for name, v in columns.items() if v is not None}
    count = np.asarray(given["delay"]).shape[0]
    flat: dict[str, Any] = {}
    for name, (dtype, neutral) in _NEUTRAL.items():
        flat[name] = np.empty(count, dtype)
        flat[name][:] = given.get(name, neutral)
    return PathSet(
        **flat,
        departure=np.array(given["departure"], np.float64).reshape(count, 3),
        arrival=np.array(given["arrival"], np.float64).reshape(count, 3),
        points=np.array(given.get("points", np.zeros((count, 0, 3))), np.float64),
        faces=np.array(given.get("faces", np.zeros((count, 0))), np.int32),
        epoch=float(epoch),
        tx=tx,
        rx=rx,
        target_names=target_names,
    )


def widened(a: np.ndarray, depth: int, fill: float) -> np.ndarray:
    """An array whose second axis is lengthened to `depth` by `fill`; numpy's own pad is slow."""
    if a.shape[1] == depth:
        return a
    out = np.full((a.shape[0], depth, *a.shape[2:]), fill, a.dtype)
    out[:, : a.shape[1]] = a
    return out


def merge(parts: list[PathSet], shift: np.ndarray | float = 0.0) -> PathSet:
    """All paths of one link in one set, in the order given; interaction lists are padded to the
    longest, and their points moved by `shift` [m]."""
    first = parts[0]
    if len({(p.link, p.epoch, p.target_names) for p in parts}) > 1:
        raise ValueError("merge needs path sets of one link, epoch and list of targets")
    columns, depth = [p.arrays() for p in parts], max(p.faces.shape[1] for p in parts)
    joined: dict[str, Any] = {
        name: np.concatenate([c[name] for c in columns])
        for name in columns[0]
        if name not in ("points", "faces")
    }
    count, row = sum(map(len, parts)), 0
    joined["points"] = np.full((count, depth, 3), np.nan)
    joined["faces"] = np.full((count, depth), -1, np.int32)
    for p in parts:
        rows, met = slice(row, row + len(p)), p.faces.shape[1]
        np.add(p.points, shift, out=joined["points"][rows, :met])
        joined["faces"][rows, :met] = p.faces
        row = rows.stop
    return replace(first, **joined)
