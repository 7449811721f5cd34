"""What the receivers achieved, scored against the truth: SER, BER, hit rate, RMSE, labels, GOSPA.

The only module besides the simulation itself that knows the truth; no receiver imports it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np
from scipy.optimize import linear_sum_assignment
from scipy.special import betaincinv

from isac_rt.frame.antennas import Antennas, azimuth_elevation
from isac_rt.frame.payload import Payload
from isac_rt.frame.waveform import SPEED_OF_LIGHT, Waveform
from isac_rt.propagation.pathset import PathKind, PathSet
from isac_rt.receive.types import Detections, Reception
from isac_rt.terminal.tracker import TrackSet
from isac_rt.world.swarm import Pose

GATE_RESOLUTIONS = 3.0
"""An estimate belongs to a target if it is within so many resolutions of it on every axis."""

ERROR_KEYS = ("range_m", "velocity_mps", "azimuth_deg", "elevation_deg")


RATES = ("ser_delay", "ser_dpsk", "ber", "hit_rate")
"""Shares of a summary that have a numerator and a denominator."""


class Truth(NamedTuple):
    """One UAV as one terminal ought to see it.

    range [m] and velocity [m/s, positive receding] in the terms of `Detections`; direction cosines
    u_x, u_z; azimuth from the boresight towards +X and elevation from the horizontal of the body
    [rad]
    """

    range: float
    velocity: float
    u_x: float
    u_z: float
    azimuth: float
    elevation: float


def truth_of(observer: Pose, uav: Pose, at: Pose | None = None) -> Truth:
    """What `observer` ought to measure of `uav`.

    Without `at` the one-way range and its rate: every target of an AT, and the AT itself at a PT.
    With `at` the bistatic path length AT - UAV - observer and its rate. The direction is that of
    arrival, over the whole sphere.
    """
    offset = uav.position - observer.position
    distance = float(np.linalg.norm(offset))
    velocity = float(offset @ (uav.velocity - observer.velocity)) / distance
    body = observer.to_body(offset / distance)
    length = distance
    if at is not None:
        outward = uav.position - at.position
        length += float(np.linalg.norm(outward))
        velocity += float(outward @ (uav.velocity - at.velocity)) / float(np.linalg.norm(outward))
    azimuth, elevation = np.arctan2(body[0], body[1]), np.arcsin(np.clip(body[2], -1, 1))
    return Truth(length, velocity, float(body[0]), float(body[2]), float(azimuth), float(elevation))


def resolutions(waveform: Waveform, antennas: Antennas, passes: int) -> np.ndarray:
    """Resolution of range [m], velocity [m/s], u_x and u_z (4,).

    The array's is wavelength over aperture: that of the virtual array (transmit times receive
    elements of an arm) for an echo (passes = 2), of the receive array alone for one pass.
    """
    across = antennas.rx_x * (antennas.tx_x if passes == 2 else 1)
    up = antennas.rx_z * (antennas.tx_z if passes == 2 else 1)
    step = waveform.wavelength / antennas.spacing
    return np.array(
        [waveform.range_cell(passes), waveform.velocity_cell(passes), step / across, step / up]
    )


def associate(
    truths: Sequence[Truth], estimates: np.ndarray, resolution: np.ndarray
) -> list[tuple[int, int]]:
    """One-to-one pairs (truth, estimate) within `GATE_RESOLUTIONS` on every axis, of the least
    total squared distance.

    `estimates` (Q, 4) range, velocity, u_x, u_z; a direction that is NaN is not compared. A
    velocity that aliased is a wrong velocity here.
    """
    if not truths or not len(estimates):
        return []
    wanted = np.array([t[:4] for t in truths])
    off = (estimates[None] - wanted[:, None]) / resolution
    off[..., 2:] = np.where(np.isfinite(off[..., 2:]), off[..., 2:], 0.0)
    inside = (np.abs(off) <= GATE_RESOLUTIONS).all(axis=-1)
    # a pair refused costs more than all pairs allowed together, so as many as possible are made
    refused = 4 * GATE_RESOLUTIONS**2 * (min(inside.shape) + 1)
    rows, columns = linear_sum_assignment(np.where(inside, np.sum(off**2, axis=-1), refused))
    return [(int(i), int(j)) for i, j in zip(rows, columns, strict=True) if inside[i, j]]


def direct_targets(paths: PathSet, names: list[str]) -> np.ndarray:
    """Whether each UAV is reached straight, without the city: the transmitter by the line of sight,
    the others by their echo."""
    straight = ~paths.bent
    echo = {paths.target_names[i] for i in paths.target[straight & (paths.kind == PathKind.TARGET)]}
    sight = bool((straight & (paths.kind == PathKind.LINE_OF_SIGHT)).any())
    return np.array([sight if name == paths.tx != paths.rx else name in echo for name in names])


class Explanation(NamedTuple):
    """What caused each of Q detections; -1 where no path is near (a false alarm or a sidelobe).

    kind : (Q,) int8 `PathKind`
    target : (Q,) int16 index into the set's target names, -1 also where no UAV is involved
    order : (Q,) int16 interactions with the city, 0 of a direct path
    face : (Q,) int32 face of the city's mesh that the path meets first, -1 also where it meets none
    """

    kind: np.ndarray
    target: np.ndarray
    order: np.ndarray
    face: np.ndarray


def explain(detections: Detections, paths: PathSet, waveform: Waveform, passes: int) -> Explanation:
    """Which path caused each detection: the strongest within one cell of it in range and in
    velocity.

    Paths are compared where the receiver sees them: velocity modulo the unambiguous span.
    """
    path_range = SPEED_OF_LIGHT * paths.delay / passes
    path_velocity = SPEED_OF_LIGHT * paths.delay_rate / passes
    span, power = 2 * waveform.max_velocity(passes), paths.power
    out = Explanation(
        *(np.full(len(detections), -1, dtype) for dtype in (np.int8, np.int16, np.int16, np.int32))
    )
    for q in range(len(detections)):
        off = detections.velocity[q] - path_velocity
        off -= span * np.round(off / span)
        near = np.flatnonzero(
            (np.abs(detections.range[q] - path_range) <= waveform.range_cell(passes))
            & (np.abs(off) <= waveform.velocity_cell(passes))
        )
        if near.size:
            strongest = near[np.argmax(power[near])]
            out.kind[q], out.target[q], out.order[q] = (
                paths.kind[strongest],
                paths.target[strongest],
                paths.bounces[strongest],
            )
            met = paths.faces[strongest][paths.faces[strongest] >= 0]
            out.face[q] = met[0] if met.size else -1
    return out


@dataclass(frozen=True)
class SymbolCount:
    """Symbols and bits sent to a terminal in data mode, and what became of them; `+` pools.

    Errors include what was erased (not decided). `frames` are data frames.
    """

    delay_total: int = 0
    delay_errors: int = 0
    delay_erased: int = 0
    dpsk_total: int = 0
    dpsk_errors: int = 0
    dpsk_erased: int = 0
    bits_total: int = 0
    bit_errors: int = 0
    bits_decoded: int = 0
    frames: int = 0

    def __add__(self, other: SymbolCount) -> SymbolCount:
        return SymbolCount(
            *(getattr(self, f) + getattr(other, f) for f in self.__dataclass_fields__)
        )


def count_symbols(
    payload: Payload, reception: Reception, groups: Sequence[int] | None = None
) -> SymbolCount:
    """One frame: what was sent in `groups` (None: in all) against what was decided. An unmodulated
    frame counts nothing."""
    if not payload.modulated:
        return SymbolCount()
    mine = list(range(len(payload.delay_symbols)) if groups is None else groups)

    def compare(sent: np.ndarray, decided: np.ndarray) -> tuple[int, int, int]:
        if not reception.decoded:
            return sent.size, sent.size, sent.size
        return sent.size, int((sent != decided).sum()), int((decided < 0).sum())

    bits = payload.bits_of(mine)
    decoded = bits.size if reception.decoded else 0
    wrong = int((bits != reception.bits).sum()) if decoded else bits.size
    return SymbolCount(
        *compare(payload.delay_symbols[mine], reception.delay_symbols[mine]),
        *compare(payload.transitions[mine], reception.transitions[mine]),
        bits.size,
        wrong,
        decoded,
        1,
    )


@dataclass
class Errors:
    """Sums of squares of associated errors in the four reported quantities; NaN directions are left
    out of theirs."""

    square: np.ndarray = field(default_factory=lambda: np.zeros(4))
    count: np.ndarray = field(default_factory=lambda: np.zeros(4, np.int64))

    def add(self, truth: Truth, estimate: np.ndarray) -> None:
        """`estimate` (4,) range, velocity, u_x, u_z."""
        error = np.array(
            [
                estimate[0] - truth.range,
                estimate[1] - truth.velocity,
                *_angle_errors(truth, estimate[2:]),
            ]
        )
        known = np.isfinite(error)
        self.square[known] += error[known] ** 2
        self.count += known

    def merge(self, other: Errors) -> None:
        self.square, self.count = self.square + other.square, self.count + other.count

    def rmse(self) -> dict[str, float | None]:
        """By the fixed keys; null where nothing was associated."""
        return {
            key: float(np.sqrt(s / n)) if n else None
            for key, s, n in zip(ERROR_KEYS, self.square, self.count, strict=True)
        }


def _angle_errors(truth: Truth, cosines: np.ndarray) -> tuple[float, float]:
    """Azimuth and elevation errors [deg] of estimated direction cosines (front half-space); NaN
    outside the unit disc."""
    azimuth, elevation = azimuth_elevation(cosines)
    azimuth = (azimuth - truth.azimuth + np.pi) % (2 * np.pi) - np.pi
    return float(np.rad2deg(azimuth)), float(np.rad2deg(elevation - truth.elevation))


@dataclass
class SensingScore:
    """Detections and tracks of one terminal (or link) against the targets in its view.

    Attributes
    ----------
    resolution : (4,) of `resolutions`
    frames, target_frames : frames scored; targets in view and unshadowed, summed over frames
    hits : target-frames with a detection within one resolution on all four axes
    matched, matched_tracks : target-frames with a detection (a confirmed track) within three
    false, clutter : detections of no target: those that no path explains, and those that some path
        explains
    detection_errors, track_errors : of the matched ones
    """

    resolution: np.ndarray
    frames: int = 0
    target_frames: int = 0
    hits: int = 0
    matched: int = 0
    matched_tracks: int = 0
    false: int = 0
    clutter: int = 0
    detection_errors: Errors = field(default_factory=Errors)
    track_errors: Errors = field(default_factory=Errors)

    def add(
        self,
        truths: Sequence[Truth],
        detections: Detections,
        tracks: TrackSet | None = None,
        kinds: np.ndarray | None = None,
    ) -> None:
        """One frame: `truths` of the targets in view and unshadowed, `kinds` (Q,) from `explain`
        (all unexplained if None)."""
        found = np.column_stack([detections.range, detections.velocity, detections.direction])
        pairs = associate(truths, found, self.resolution)
        for i, j in pairs:
            self.detection_errors.add(truths[i], found[j])
            self.hits += bool((np.abs(found[j] - np.array(truths[i][:4])) <= self.resolution).all())
        stray = np.ones(len(found), bool)
        stray[[j for _, j in pairs]] = False
        explained = np.zeros(len(found), bool) if kinds is None else kinds >= 0
        self.false += int((stray & ~explained).sum())
        self.clutter += int((stray & explained).sum())
        self.matched += len(pairs)
        self.target_frames += len(truths)
        self.frames += 1
        if tracks is not None:
            sure = np.column_stack([tracks.range, tracks.velocity, tracks.direction])[
                tracks.confirmed
            ]
            for i, j in associate(truths, sure, self.resolution):
                self.track_errors.add(truths[i], sure[j])
                self.matched_tracks += 1

    def merge(self, other: SensingScore) -> None:
        """Pool another link's score into this one."""
        for name in COUNTS:
            setattr(self, name, getattr(self, name) + getattr(other, name))
        self.detection_errors.merge(other.detection_errors)
        self.track_errors.merge(other.track_errors)

    def memory(self) -> dict[str, Any]:
        """The score so far as plain numbers and arrays, for `restore`."""
        errors = {name: vars(getattr(self, name)) for name in ERRORS}
        return {name: getattr(self, name) for name in COUNTS} | errors

    def restore(self, memory: dict[str, Any]) -> None:
        """Go on from a `memory`."""
        for name in COUNTS:
            setattr(self, name, memory[name])
        for name in ERRORS:
            setattr(self, name, Errors(**memory[name]))


COUNTS = ("frames", "target_frames", "hits", "matched", "matched_tracks", "false", "clutter")
ERRORS = ("detection_errors", "track_errors")


def pool(scores: Sequence[SensingScore]) -> SensingScore:
    """Several links' scores in one; the resolution is the first's."""
    out = SensingScore(scores[0].resolution)
    for score in scores:
        out.merge(score)
    return out


def summary_block(
    role: str | list[str], sensing: SensingScore, symbols: SymbolCount | None, duration: float
) -> dict[str, object]:
    """One terminal's (or link's) figures under the fixed keys of `summary.json`; null where one
    does not apply.

    `bits` are the payload bits that were decoded, right or wrong; `bit_rate_bps` is these over
    `duration` [s], the time from the first frame to the end of the last, pauses and pilots
    included. `ber` counts undecoded bits as errors. `counts` holds numerator and denominator of the
    rates, for pooling and for intervals.
    """
    c = symbols or SymbolCount()
    receives = symbols is not None

    def share(part: int, whole: int) -> float | None:
        return part / whole if whole else None

    counts = [
        [c.delay_errors, c.delay_total],
        [c.dpsk_errors, c.dpsk_total],
        [c.bit_errors, c.bits_total],
        [sensing.hits, sensing.target_frames],
    ]
    return {
        "role": role,
        "ser_dpsk": share(c.dpsk_errors, c.dpsk_total),
        "ser_delay": share(c.delay_errors, c.delay_total),
        "ber": share(c.bit_errors, c.bits_total),
        "erased": share(c.delay_erased + c.dpsk_erased, c.delay_total + c.dpsk_total),
        "bits": c.bits_decoded if receives else None,
        "bit_rate_bps": c.bits_decoded / duration if receives else None,
        "hit_rate": share(sensing.hits, sensing.target_frames),
        "matched": share(sensing.matched, sensing.target_frames),
        "matched_tracked": share(sensing.matched_tracks, sensing.target_frames),
        "false_per_frame": share(sensing.false, sensing.frames),
        "clutter_per_frame": share(sensing.clutter, sensing.frames),
        "rmse": sensing.detection_errors.rmse(),
        "rmse_tracked": sensing.track_errors.rmse(),
        "counts": dict(zip(RATES, counts, strict=True)),
    }


class Gospa(NamedTuple):
    """distance^2 = localisation + missed + false (each already to the power of two) [m, m^2]."""

    distance: float
    localisation: float
    missed: float
    false: float


def gospa(truths: np.ndarray, estimates: np.ndarray, cutoff: float) -> Gospa:
    r"""Generalised optimal sub-pattern assignment with p = 2, alpha = 2.

    .. math::

        d^2 = \min_\gamma \sum_{(i,j)\in\gamma} |x_i-y_j|^2 + \tfrac{c^2}{2}(|X|+|Y|-2|\gamma|)

    Parameters
    ----------
    truths, estimates : (n, D), (m, D) [m]
    cutoff : c [m]; a pair farther apart counts as one missed and one false

    References
    ----------
    .. [1] A. S. Rahmathullah et al., "Generalized optimal sub-pattern assignment metric", FUSION
    2017,
       doi:10.23919/ICIF.2017.8009645
    """
    x, y = np.asarray(truths, float), np.asarray(estimates, float)
    square, pairs = 0.0, 0
    if len(x) and len(y):
        d2 = np.minimum(np.sum((x[:, None] - y[None]) ** 2, axis=-1), cutoff**2)
        rows, columns = linear_sum_assignment(d2)
        chosen = d2[rows, columns]
        square, pairs = float(chosen[chosen < cutoff**2].sum()), int((chosen < cutoff**2).sum())
    missed, false = (len(x) - pairs) * cutoff**2 / 2, (len(y) - pairs) * cutoff**2 / 2
    return Gospa(float(np.sqrt(square + missed + false)), square, missed, false)


def decibels(ratio: float) -> float | None:
    """10 log10; None for nothing."""
    return round(float(10 * np.log10(ratio)), 2) if ratio > 0 else None


def binomial_interval(
    successes: float, trials: float, confidence: float = 0.95
) -> tuple[float, float]:
    """Clopper-Pearson: the proportions that would not make `successes` or fewer, or as many or
    more, too unlikely."""
    tail = (1 - confidence) / 2
    low = float(betaincinv(successes, trials - successes + 1, tail)) if successes else 0.0
    high = (
        float(betaincinv(successes + 1, trials - successes, 1 - tail))
        if successes < trials
        else 1.0
    )
    return low, high


def within_view(antennas: Antennas, own: Pose, active: Pose, body: Pose) -> bool:
    """Whether a body is in the field of view of the receiver and, unless it is the transmitter
    itself, of the transmitter."""
    ends = [(own, body)]
    if body is active:
        ends.append((active, own))
    elif own is not active:
        ends.append((active, body))
    offsets = [(a, b.position - a.position) for a, b in ends]
    return all(bool(antennas.in_view(a.to_body(d / np.linalg.norm(d)))) for a, d in offsets)
