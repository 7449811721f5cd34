"""Records of every frame."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from isac_rt.frame.link import Link
from isac_rt.propagation.pathset import PathKind, PathSet
from isac_rt.receive.types import Reception
from isac_rt.results.metrics import Gospa, SymbolCount
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
    """The tracks that an observer keeps after a frame, one row each.

    Attributes
    ----------
    id, range, velocity, u_x, u_z, confirmed : number, estimates [m, m/s], whether confirmed
    state, covariance : (K, 6), (K, 6, 6) position and velocity relative to the observer, world axes
        [m, m/s]
    kind, target : of the path that explains the latest detection that updated it: `PathKind` and
        index of the UAV involved, -1: none
    uav : index of the UAV in view that it follows (`isac_rt.results.scoring`), -1: none
    false : confirmed, follows no UAV and is at least the cutoff of GOSPA from every one
    object : confirmed, follows no UAV, and is near an object or fed by one
    """

    id: np.ndarray
    range: np.ndarray
    velocity: np.ndarray
    u_x: np.ndarray
    u_z: np.ndarray
    confirmed: np.ndarray
    state: np.ndarray
    covariance: np.ndarray
    kind: np.ndarray
    target: np.ndarray
    uav: np.ndarray
    false: np.ndarray
    object: np.ndarray


@dataclass(frozen=True, kw_only=True)
class UavScores:
    """Scores of a frame at an observer by UAV of the scenario, in its order.

    Attributes
    ----------
    truth, detected, tracked : over all UAVs; estimates are NaN where none is associated
    bound : least standard deviations of an estimate (Cramer-Rao), NaN where the UAV is not in view
        or occluded
    in_view, occluded : (U,) bool; whether it is in the field of view; whether the city hides it
    hit : (U,) bool; whether it is in view, unoccluded and found by its own path, within one
        resolution on all four axes
    loss : (U,) `isac_rt.results.losses.Loss` where it is in view and unoccluded, else -1
    target_snr : (U,) SNR of its own path behind a matched filter that is coherent over the whole
        frame (linear), NaN where it is not in view or occluded
    target_cell_snr, target_straddling, target_whitened_snr : (U,) its SNR in its cell of the
        Hann-windowed map with all channels in phase (linear), the share of it that lying between
        cells leaves, and the SNR after whitening by the true clutter, likewise
    target_clutter : (U,) power of the clutter in its cell over the noise (linear), likewise
    cooperative : (U,) bool; terminals, which report their position; none in a swarm of terminals
        alone, whose terminals are its targets
    genie : (U,) probability that a matched filter at the true parameters finds its own path, NaN
        where it is not in view or occluded
    clutter_free : (U,) probability that the receiver's detector would find it in noise alone,
        likewise
    whitened : (U,) probability that a detector finds it that whitens the channels of its cell by
        the true clutter, likewise
    """

    truth: UavValues
    detected: UavValues
    tracked: UavValues
    bound: UavValues
    in_view: np.ndarray
    occluded: np.ndarray
    hit: np.ndarray
    loss: np.ndarray
    target_snr: np.ndarray
    target_cell_snr: np.ndarray
    target_straddling: np.ndarray
    target_whitened_snr: np.ndarray
    target_clutter: np.ndarray
    cooperative: np.ndarray
    genie: np.ndarray
    clutter_free: np.ndarray
    whitened: np.ndarray


@dataclass(frozen=True)
class DetectionLabels:
    """Explanations of Q detections (`isac_rt.results.labels.Explanation`), targets as indices of
    UAVs, and the UAV whose own path explains each (`uav`, -1: none's)."""

    kind: np.ndarray
    target: np.ndarray
    order: np.ndarray
    face: np.ndarray
    sidelobe: np.ndarray
    uav: np.ndarray


@dataclass(frozen=True, kw_only=True)
class ObserverRecord:
    """Inputs and outputs of one link's receiving terminal in one frame.

    Attributes
    ----------
    transmitter : whose chirps it received
    paths : what it received
    reception : what it found
    labels : of its detections
    uavs : what it found of each UAV
    tracks : after this frame
    state : code of the terminal's state, an index into the recorder's `states`
    gospa : of the confirmed tracks against the targets in view and unoccluded
    symbols : what was sent to it and became of it
    latency : frames after which its data were read, -1: they were erased
    slips : symbols decided outside their alphabet
    fell_back : whether the transmitter sent the conventional schedule in place of the scenario's
        (`isac_rt.simulation.fall_back`)
    reference_snr : per sample and antenna before processing (linear); NaN where there is no
        reference path
    """

    transmitter: str
    paths: PathSet
    reception: Reception
    labels: DetectionLabels
    uavs: UavScores
    tracks: TrackTable
    state: int
    gospa: Gospa
    symbols: SymbolCount = field(default_factory=SymbolCount)
    latency: int = -1
    slips: int = 0
    fell_back: bool = False
    reference_snr: float = np.nan


@dataclass(frozen=True)
class LateRecord:
    """Results of a link's earlier frame once its data were read; names as in `ObserverRecord`.

    Attributes
    ----------
    frame : its number
    reception : its symbols
    symbols : what was sent and became of it
    latency : frames after which it was read, -1: its check sum fails
    """

    frame: int
    reception: Reception
    symbols: SymbolCount
    latency: int


@dataclass(frozen=True, kw_only=True)
class FusedRecord:
    """One set of fused tracks of a frame: of a terminal, or of all together. B UAVs, U UAVs.

    Attributes
    ----------
    gospa : (3,) localisation, missed, false [m^2], over targets in view of anyone
    seen, found : (U,) bool; a target that a link's receiver had in view, and found, when it last
        received
    tracked : (U,) bool; a fused track is within the cutoff of GOSPA and within three resolutions of
        a link that has the target in view
    error : (U, 3) of those tracked: position [m], velocity [m/s], squared error of position in the
        deviations stated over its axes
    false : fused tracks at least the cutoff of GOSPA from every UAV
    reports, age : what was received from others and counts, and its mean age [s]
    messages, lost : that reached the terminal in this frame, and those of them that were lost
    late : earlier ones, lost until then, that came with a frame that was read late
    bits, capacity : of these messages, and of the links to the terminal in this frame
    left_out : tracks or detections that these messages had no room for
    origin, number : (B,) name: index of the link and number of its track
    mean, std : (B, 6) position and velocity in world axes [m, m/s]
    members : (B,) how many tracks are taken for it
    terminal : (B,) index of the UAV of the swarm that it is recognised as, -1: none
    uav : (B,) index of the target that it tracks, -1: none
    """

    gospa: np.ndarray
    seen: np.ndarray
    found: np.ndarray
    tracked: np.ndarray
    error: np.ndarray
    false: int
    reports: int
    age: float
    messages: int
    lost: int
    late: int
    bits: int
    capacity: int
    left_out: int
    origin: np.ndarray
    number: np.ndarray
    mean: np.ndarray
    std: np.ndarray
    members: np.ndarray
    terminal: np.ndarray
    uav: np.ndarray


@dataclass(frozen=True)
class Use:
    """Share of one link's paths that was kept in one frame, and the bounds of the rest.

    Attributes
    ----------
    found, filtered, weak : number of paths found, stopped by the IF filter and left out as too weak
    kept : by kind
    bounces : most bounces of a kept path
    left_out : largest power left out of one range cell over the noise of a cell (linear)
    plane, straight : kept paths with a plane wavefront, without acceleration
    plane_error, straight_error : bounds of their phase errors [rad]
    turning_error : bound of the phase by which directions turn within the frame, which is not
        modelled [rad]
    """

    found: int
    filtered: int
    weak: int
    kept: dict[str, int]
    bounces: int
    left_out: float
    plane: int
    straight: int
    plane_error: float
    straight_error: float
    turning_error: float


@dataclass(frozen=True, kw_only=True)
class FrameRecord:
    """One frame.

    Attributes
    ----------
    frame, time : its index and the time of its middle [s]
    modulated : whether it carries data
    poses : of all UAVs at its middle
    observers : every observer that received in it, by its label
    snapshot : whether the whole path ledger and the maps are kept
    uses : what was kept of the paths of each link
    dropped : traced paths that the float64 geometry contradicted
    fused_records : of the terminals and of all together by name, where terminals cooperate
    """

    frame: int
    time: float
    modulated: bool
    poses: Mapping[str, Pose]
    observers: Mapping[str, ObserverRecord]
    snapshot: bool = False
    uses: Mapping[Link, Use] = field(default_factory=dict)
    dropped: int = 0
    fused_records: Mapping[str, FusedRecord] = field(default_factory=dict)
