"""What is recorded of every frame."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from isac_rt.propagation.pathset import PathKind, PathSet
from isac_rt.receive.types import Reception
from isac_rt.results.metrics import SymbolCount
from isac_rt.world.swarm import Pose

KINDS = tuple(kind.name.lower() for kind in PathKind)


@dataclass(frozen=True, kw_only=True)
class UavValues:
    """One value per UAV of the scenario, in its order: truth, or estimates with NaN where a UAV was
    not matched.

    Attributes
    ----------
    range, velocity : (U,) as in `Detections` [m], [m/s, positive receding]: one way at the AT and
        of the transmitter itself, path length and its rate for what reflects to a PT
    azimuth, elevation : (U,) [rad] in the observer's body frame
    """

    range: np.ndarray
    velocity: np.ndarray
    azimuth: np.ndarray
    elevation: np.ndarray


@dataclass(frozen=True, kw_only=True)
class TrackTable:
    """The tracks that an observer keeps after a frame, one row each: id, range [m], velocity [m/s],
    direction cosines, whether confirmed, and the index of the UAV that the track follows in truth
    (-1: none)."""

    id: np.ndarray
    range: np.ndarray
    velocity: np.ndarray
    u_x: np.ndarray
    u_z: np.ndarray
    confirmed: np.ndarray
    uav: np.ndarray


@dataclass(frozen=True, kw_only=True)
class ObserverRecord:
    """What one link's receiving terminal had and made of one frame.

    Attributes
    ----------
    transmitter : whose chirps it received
    reception : what it found
    paths : what it received
    truth, detected, tracked : over all UAVs; estimates are NaN where none is associated
    in_view, shadowed : (U,) bool; whether a UAV is in the field of view; whether the city hides it
    tracks : after this frame
    state : code of the terminal's state, an index into the recorder's `states`
    detection_kind, detection_target, detection_order, detection_face : (Q,) what explains each
        detection, as `metrics.Explanation` says
    symbols : what was sent to it and became of it
    fell_back : whether the transmitter sent the conventional schedule in place of the scenario's
        (`isac_rt.access.fall_back`)
    num_false : detections that no path explains
    slips : symbols decided outside their alphabet
    reference_snr : per sample and antenna before processing (linear); NaN where there is no
        reference path
    """

    transmitter: str
    reception: Reception
    paths: PathSet
    truth: UavValues
    detected: UavValues
    tracked: UavValues
    in_view: np.ndarray
    shadowed: np.ndarray
    tracks: TrackTable
    state: int
    detection_kind: np.ndarray
    detection_target: np.ndarray
    detection_order: np.ndarray
    detection_face: np.ndarray
    symbols: SymbolCount = field(default_factory=SymbolCount)
    fell_back: bool = False
    num_false: int = 0
    slips: int = 0
    reference_snr: float = np.nan


@dataclass(frozen=True, kw_only=True)
class FrameRecord:
    """One frame: its index, the time of its middle [s], all poses then, and by its label every
    observer that received in it. Of a `snapshot` frame the whole path ledger and the maps are
    kept."""

    frame: int
    time: float
    modulated: bool
    poses: Mapping[str, Pose]
    observers: Mapping[str, ObserverRecord]
    snapshot: bool = False


@dataclass(frozen=True)
class _Slim:
    """An `ObserverRecord` with its paths reduced to numbers and power by kind, and the ledger of a
    snapshot."""

    record: ObserverRecord
    counts: np.ndarray
    power: np.ndarray
    ledger: PathSet | None


@dataclass(frozen=True, kw_only=True)
class _SlimFrame:
    """A `FrameRecord` of such observers."""

    frame: int
    time: float
    modulated: bool
    poses: Mapping[str, Pose]
    observers: Mapping[str, _Slim]
    snapshot: bool


def _sparse(s: _Slim) -> int:
    return -1 if s.record.reception.sparse is None else int(s.record.reception.sparse)


def _slim(o: ObserverRecord, snapshot: bool) -> _Slim:
    kind, power = o.paths.kind, o.paths.power
    counts = np.bincount(kind, minlength=len(KINDS))
    total = np.bincount(kind, weights=power, minlength=len(KINDS))
    return _Slim(
        ObserverRecord(**{**vars(o), "paths": o.paths.select(np.zeros(0, int))}),
        counts,
        total,
        o.paths if snapshot else None,
    )
