"""Ghost tracks by geometry: the terminal knows its own pose and the city's mesh, and nothing of the
truth.

A wall shows each UAV again, as a mirror does. Two questions are asked of a track, and either is
enough to make it suspect:

- Is it one of the echoes that a nearer UAV must have over walls? There (straight) and back (over
  a wall), the reverse, or over a wall on both ways: their ranges, rates and directions follow from
  the source's state and the wall's plane, their power from lengths and from what the array makes of
  two waves, but for the aspects. The source is another track, or a UAV that other terminals report:
  one that the line of sight masks is received by its echoes over walls.
- Does it lie behind a surface of the mesh? No UAV there could be seen straight.

A passive terminal asks the same of its reflectors, whose echoes come from its reference, the active
terminal, as it tracks it; and whether one is that terminal itself over a wall.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property
from typing import NamedTuple

import numpy as np
from scipy.special import expit, ndtr

from isac_rt.extensions.city_receivers.walls import Walls
from isac_rt.frame.antennas import Antennas, folded, resolutions
from isac_rt.frame.waveform import Waveform
from isac_rt.propagation.rcs import TR38901_STD_DB
from isac_rt.track.filter import Ambiguity, jacobian, measure, transmitter_jacobian, wrapped
from isac_rt.track.parts import Ownship, TrackRule
from isac_rt.track.tracker import Track, Tracker, TrackSet, track_set
from isac_rt.world.swarm import Pose

DEVIATIONS = 3.0
"""How many standard deviations a track may be off."""
MEETING = 1e-9
"""How far off its faces a wave may meet a mirror, for rounding [m]."""
RESOLUTION_SHARE = 0.5
"""Share of the resolution that it may be off besides: echoes that share a cell pull each other's
estimates."""
AVERAGED = 9
"""Most frames over which a track averages the pull on its range and its rate."""
SHOWN = 0.3
"""Probability that a frame shows the path of a UAV over a wall, if it shows the UAV: in twelve
flights over six cities 0.02 to 0.38, and about 0.3 where there are many."""
PULLED = 1.5
"""Factor by which what walls show of a UAV is farther off than the deviations of its state say: its
echo over the ground pulls its height on boards, where it is off by 1.3 to 1.9 deviations (rms)."""
ASPECT_STD_DB = np.sqrt(2) * TR38901_STD_DB["small"]
"""Deviation of a UAV's cross-section over a wall from its direct one [dB]: it fluctuates by aspect,
and walls show another one."""
APART = np.array([3.0, 1.0, 0.1, 0.1])
"""Deviations of a target's range [m], rate [m/s] and direction cosines from another's, over one
pass or two: swarms fly in formations."""
LEAST_SOURCE = 0.2
"""A track that follows a target less probably than so, as from a first detection, explains none."""


class Ghosts(TrackRule):
    """Tracks that walls explain are doubted, in each frame that shows them so.

    Parameters
    ----------
    walls : the mesh
    leeway : what detections leave open
    """

    def __init__(self, walls: Walls, leeway: Leeway) -> None:
        self._walls, self._leeway = walls, leeway

    def prune(self, tracker: Tracker, own: Ownship) -> None:
        """Doubt the tracks that are a nearer target's echoes over a wall, of targets that others
        report too, and those that lie behind one."""
        if not any(one.credible for one in tracker.tracks):
            return
        tracks = tracker.snapshot(own.pose, own.reference)
        others = track_set([Track.of_state(u.state) for u in own.reports], own.pose, own.reference)
        exist = np.ones(len(tracks))
        exist[~tracks.is_reference] = expit([one.odds for one in tracker.tracks])
        rows = ~tracks.is_reference & (exist > LEAST_SOURCE)
        said = suspicion(tracks, own.pose, self._walls, self._leeway, others, rows, exist)
        tracker.doubt(dict(zip(tracks.ids.tolist(), said.ratio.tolist(), strict=True)))


@dataclass(frozen=True)
class Leeway:
    """Uncertainty of a path that a detection leaves.

    Attributes
    ----------
    resolution : (4,) range [m], velocity [m/s], u_x, u_z, of `frame.antennas.resolutions`; of one
        pass at a passive terminal
    ambiguity : of range and velocity
    cosine_period : of `Antennas`: an image may stand beyond the view
    tx, rx : (L, 2) places of transmit and receive elements [wavelengths], x and z
    """

    resolution: np.ndarray
    ambiguity: Ambiguity
    cosine_period: np.ndarray | float = np.inf
    tx: np.ndarray = field(default_factory=lambda: np.zeros((1, 2)))
    rx: np.ndarray = field(default_factory=lambda: np.zeros((1, 2)))

    @classmethod
    def of(cls, waveform: Waveform, antennas: Antennas, passes: int) -> Leeway:
        """At an active terminal (2 passes) or a passive one (1)."""
        cells = resolutions(waveform, antennas, passes)
        cosine_period = antennas.cosine_period(waveform.wavelength, passes)
        both = antennas.tx_positions, antennas.rx_positions
        places = (of[:, [0, 2]] / waveform.wavelength for of in both)
        return cls(cells, Ambiguity.of(waveform, passes), cosine_period, *places)

    def off(self, difference: np.ndarray) -> np.ndarray:
        """Return differences (..., 4) of paths' measures, the least that ambiguities leave."""
        off = wrapped(difference, self.ambiguity)
        return np.concatenate([off[..., :2], folded(off[..., 2:], self.cosine_period)], axis=-1)

    def pull(self, age: int | np.ndarray = 0) -> np.ndarray:
        """Return by how much (..., 4) other echoes may change what a track of an `age` [frames]
        measures."""
        looks = np.minimum(np.asarray(age)[..., None] + 1, AVERAGED)
        averaged = np.where([True, True, False, False], np.sqrt(looks), 1.0)
        return np.asarray(RESOLUTION_SHARE * self.resolution / averaged)

    def explained(self, off: np.ndarray, std: np.ndarray, pull: np.ndarray) -> np.ndarray:
        """Return whether differences `off` (..., 4) are insignificant, by deviations and pulls."""
        return np.asarray((np.abs(off) <= DEVIATIONS * std + pull).all(axis=-1))

    def waves(self, towards: np.ndarray, ends: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return what all channels added up towards directions (..., 2) receive of two equal waves,
        out from one of both `ends` (P, 2, 2) and in from the other: the power (..., P) over that of
        one wave from there, 4 at most, and half the side of a square of direction cosines over
        which detections are spread as they are there. Over all directions the power adds up to
        the channels' mean power by their number (Parseval, if no two are at the same place)."""
        off = 2 * np.pi * (ends - np.asarray(towards)[..., None, None, :])
        sent, received = (np.exp(1j * off @ of.T).mean(axis=-1) for of in (self.tx, self.rx))
        response = np.maximum(np.abs((sent * received[..., ::-1]).sum(axis=-1)) ** 2, 1e-9)
        apart = 2 * np.pi * (ends[:, 0] - ends[:, 1])
        one, other = (np.exp(1j * apart @ of.T).mean(axis=-1) for of in (self.tx, self.rx))
        power = 2 + 2 * (one * other.conj()).real
        field = power * np.prod(np.minimum(2.0, self.cosine_period) * np.ones(2))
        return response, np.sqrt(field / (4 * len(self.tx) * len(self.rx) * response))


@dataclass(frozen=True)
class Suspicion:
    """Result of the test for K tracks.

    Attributes
    ----------
    mirrored : (K,) int32 face of the wall that explains the track as an echo of a nearer one, -1:
        none does
    source : (K,) int64 id of that nearer track, -1: none, or one that others report
    order : (K,) int8 bounces: 1 off that wall on one of the two ways, 2 on both, 0: none. At a
        passive terminal the second wall may be another; `mirrored` is the first
    behind : (K,) int32 face that hides the place of the track from the terminal or, at a passive
        one, from its transmitter, -1: it is in sight
    ratio : (K,) density of targets there over that of the echo's measures, if its source exists,
        the frame shows it (`SHOWN`) and it is as strong, 0 behind a face; inf: none is known
    """

    mirrored: np.ndarray
    source: np.ndarray
    order: np.ndarray
    behind: np.ndarray
    ratio: np.ndarray

    @property
    def suspect(self) -> np.ndarray:
        """(K,) bool, a target less probably than an echo"""
        return np.asarray(self.ratio < 1)


def suspicion(
    tracks: TrackSet,
    own: Pose,
    walls: Walls,
    leeway: Leeway,
    reported: TrackSet | None = None,
    asked: np.ndarray | None = None,
    exist: np.ndarray | None = None,
) -> Suspicion:
    """Hold the tracks of a terminal against the mesh.

    Parameters
    ----------
    tracks : TrackSet of an active terminal (its own echoes), or of a passive one with its
        reference, which itself is not suspected
    own : its pose
    walls : the mesh
    leeway : what detections leave open
    reported : likewise, UAVs that other terminals report, with the same reference. Those not
        known to a resolution would explain anything, and are left out, as are those that an
        active terminal tracks itself
    asked : (K,) bool, the tracks that may lie behind a wall; None: all but the reference
    exist : (K,) probabilities that tracks follow a target, which may explain others; None: those of
        the confirmed ones are 1, of the others 0
    """
    count = len(tracks)
    out = Suspicion(
        np.full(count, -1, np.int32),
        np.full(count, -1),
        np.zeros(count, np.int8),
        np.full(count, -1, np.int32),
        np.full(count, np.inf),
    )
    told = tracks.select(np.zeros(count, bool)) if reported is None else reported
    held = _Held(tracks, own, walls, leeway, told)
    ends = [own.position + to for to in ([0.0] if held.sender is None else [0.0, held.sender[:3]])]
    for k in np.flatnonzero(~tracks.is_reference if asked is None else asked):
        place, P = own.position + tracks.mean[k, :3], tracks.covariance[k, :3, :3]
        out.behind[k] = occluded_by(place, P, ends, walls, leeway.resolution[0])
    exist = tracks.confirmed.astype(float) if exist is None else exist
    sources = [(tracks, int(s)) for s in np.flatnonzero((exist > LEAST_SOURCE) & (out.behind < 0))]
    sources += [(told, int(s)) for s in np.flatnonzero(held.useful)]
    found = [of for known, s in sources if (of := held.explained(known, s)).row.size]
    is_target = tracks.confirmed & ~tracks.is_reference & (out.behind < 0)
    for of in found:
        is_target[of.row] = False
    for of in found:
        exists = exist[tracks.ids == of.source][0] if of.report < 0 else 1.0
        ratio = held.density(of, is_target) / (SHOWN * exists * of.likelihood)
        for i, k in enumerate(of.row):
            if ratio[i] < out.ratio[k]:
                out.mirrored[k], out.order[k] = of.faces[i], of.orders[i]
                out.source[k], out.ratio[k] = of.source, ratio[i]
    out.ratio[out.behind >= 0] = 0.0
    return out


class _Explained(NamedTuple):
    """Pairs (n,) of a track and a path of one source that explains it.

    Attributes
    ----------
    row : of the track
    source, report : id of the source, and its row among those that others report, -1: it is none
    faces, orders : of the path
    off, std, pull : (n, 4) by how much the track is off, deviations, and the most that other echoes
        change
    as_strong : (n,) probability that the path is as strong as the track
    """

    row: np.ndarray
    source: int
    report: int
    faces: np.ndarray
    orders: np.ndarray
    off: np.ndarray
    std: np.ndarray
    pull: np.ndarray
    as_strong: np.ndarray

    @property
    def likelihood(self) -> np.ndarray:
        """(n,) density of normal errors and pulls that are alike up to the most, for an echo as
        strong."""
        off = np.abs(self.off)
        share = ndtr((self.pull - off) / self.std) - ndtr((-self.pull - off) / self.std)
        return np.asarray((share / (2 * self.pull)).prod(axis=1) * self.as_strong)


@dataclass(frozen=True)
class _Held:
    """Tracks that are held against a mesh, and the UAVs that others report (S,)."""

    tracks: TrackSet
    own: Pose
    walls: Walls
    leeway: Leeway
    told: TrackSet

    @cached_property
    def sender(self) -> np.ndarray | None:
        """(6,) of a passive terminal's transmitter, relative to the terminal."""
        is_reference = self.tracks.is_reference
        return self.tracks.mean[is_reference][0] if is_reference.any() else None

    def density(self, of: _Explained, is_target: np.ndarray) -> np.ndarray:
        """Return how many targets (n,) there are by unit of range [m], rate [m/s] and direction
        cosines where tracks are measured as in `of`: about those that are targets (K,), one
        anywhere, and one where others report one that the track fits best."""
        z, std, leeway = self.tracks.measured[of.row], self.tracks.std[of.row], self.leeway
        pull = leeway.pull(self.tracks.age[of.row])
        span = np.array([self.tracks.range.max(), leeway.ambiguity.period, 2.0, 2.0])
        span[2:] = np.minimum(span[2:], leeway.cosine_period)
        out = 1 / np.maximum(span, 2 * pull).prod(axis=1)

        def near(places: np.ndarray, apart: np.ndarray) -> np.ndarray:
            blurred = np.sqrt(apart**2 + (std**2 + pull**2 / 3)[:, None])
            off = leeway.off(z[:, None] - places) / blurred
            peak = 1 / (np.sqrt(2 * np.pi) * blurred).prod(axis=2)
            return np.asarray(peak * np.exp(-(off**2).sum(axis=2) / 2))

        out += near(self.tracks.measured[is_target], APART).sum(axis=1)
        counts = (self.whose == of.row[:, None]) & (np.arange(len(self.told)) != of.report)
        return out + (near(self.told.measured, self.told.std) * counts).sum(axis=1)

    @cached_property
    def whose(self) -> np.ndarray:
        """(S,) track that each fits best that others report; -1: it is the reference."""
        off = self.leeway.off(self.told.measured[:, None] - self.tracks.measured)
        std = np.hypot(self.told.std[:, None], self.tracks.std)
        cost = ((off / std) ** 2 + 2 * np.log(std)).sum(axis=2)
        cost[:, self.tracks.is_reference] = np.inf
        return np.where(self.told.is_reference, -1, cost.argmin(axis=1))

    @property
    def useful(self) -> np.ndarray:
        """(S,) which UAVs that others report may explain tracks."""
        sure = (self.told.std < self.leeway.resolution).all(axis=1) & ~self.told.is_reference
        if self.sender is None:  # an own track tells how strong echoes may be; nothing masks it
            seen = self.tracks.select(self.tracks.confirmed)
            off = self.leeway.off(self.told.measured[:, None] - seen.measured)
            std = np.hypot(self.told.std[:, None], seen.std)
            sure &= ~self.leeway.explained(off, std, self.leeway.pull()).any(axis=1)
        return np.asarray(sure)

    def shown(self, known: TrackSet, s: int) -> Paths:
        """Return `echoes` or `reflections` of a source."""
        reach = 2 * float(np.max(self.tracks.range, initial=0.0)) + 1
        if self.sender is None:
            return echoes(known.mean[s], self.own, self.walls, reach)
        start = None if known.is_reference[s] else self.sender
        return reflections(known.mean[s], start, self.own, self.walls, reach)

    def explained(self, known: TrackSet, s: int) -> _Explained:
        """Return which tracks are echoes of a source over walls by their measures. An active
        terminal's over a wall on one way has no direction, for its channels receive two waves."""
        shown, tracks, leeway = self.shown(known, s), self.tracks, self.leeway
        may_be = ~tracks.is_reference & (tracks.range > known.range[s])
        most = np.tile(_weaker(known, s, self.sender, tracks.range), (shown.orders.size, 1)).T
        if known is not tracks:  # a track of the UAV itself is no echo of it
            off = leeway.off(tracks.measured - known.measured[s])
            std = np.hypot(tracks.std, known.std[s])
            may_be &= ~leeway.explained(off, std, leeway.pull())
        of_source = np.maximum(known.std[s], PULLED * shown.std(known.covariance[s]))
        off = leeway.off(tracks.measured[:, None] - shown.measured)
        std = np.hypot(tracks.std[:, None], of_source)
        pull = np.broadcast_to(leeway.pull(tracks.age)[:, None], off.shape)
        if shown.ends is not None:
            one_way = shown.orders == 1
            response, beam = leeway.waves(tracks.measured[:, 2:], shown.ends)
            most = np.where(one_way, response, 1.0) * most
            open_side = one_way[:, None] & np.array([False, False, True, True])
            off = np.where(open_side, 0.0, off)
            pull = np.where(open_side, beam[..., None], pull)
        with np.errstate(divide="ignore", invalid="ignore"):  # no power is told of reports
            excess = 10 * np.log10(tracks.snr[:, None] / (known.snr[s] * most)) / ASPECT_STD_DB
        hit = leeway.explained(off, std, pull) & may_be[:, None] & (excess < DEVIATIONS)
        row, path = np.nonzero(hit)
        of_pair = (of[row, path] for of in (off, std, pull, ndtr(-excess)))
        source, report = int(known.ids[s]), -1 if known is tracks else s
        return _Explained(row, source, report, shown.faces[path], shown.orders[path], *of_pair)


def _weaker(known: TrackSet, s: int, sender: np.ndarray | None, ranges: np.ndarray) -> np.ndarray:
    """Return the power of echoes of track `s` over walls, of such ranges (K,), relative to its
    direct one, at most: no segment is shorter than the direct path's."""
    back = float(np.linalg.norm(known.mean[s, :3]))
    if known.is_reference[s]:
        return (back / ranges) ** 2
    out = back if sender is None else float(np.linalg.norm(known.mean[s, :3] - sender[:3]))
    length = 2 * ranges if sender is None else ranges
    longer = np.maximum(length - (out + back), 0.0)
    return np.maximum(out / (out + longer), back / (back + longer)) ** 2


class Paths(NamedTuple):
    """Paths (P,) of a UAV over walls.

    Attributes
    ----------
    faces : (P,) of the wall, the first of two; -1: none
    orders : (P,) bounces
    measured : (P, 4) range, its rate, u_x, u_z
    slopes : (P, 4, 6) by the UAV's position and velocity
    ends : (P, 2, 2) of an active terminal's, u_x, u_z out and in: walls on one way have both orders
    """

    faces: np.ndarray
    orders: np.ndarray
    measured: np.ndarray
    slopes: np.ndarray
    ends: np.ndarray | None = None

    def std(self, covariance: np.ndarray) -> np.ndarray:
        """Return deviations (P, 4) for a UAV's covariance (6, 6): a height that its range and its
        rate say little of decides what the ground shows."""
        return np.asarray(np.sqrt(((self.slopes @ covariance) * self.slopes).sum(axis=-1)))


def echoes(state: np.ndarray, own: Pose, walls: Walls, reach: float = np.inf) -> Paths:
    """Return a target's echoes over each single wall, two of each, images beyond `reach` [m] left
    out.

    `state` (6,) is position and velocity relative to the terminal, world axes. Over the wall on one
    way two equal waves arrive, from the UAV and from the image, at the mean of all measures. Over
    it on both ways the echo is the image's.
    """
    here = np.concatenate([own.position, own.velocity])
    faces, images, turned = _images(state + here, here, walls, reach)
    seen = np.concatenate([measure(images, own)[..., None], jacobian(images, own) @ turned], axis=2)
    direct, mirrored = np.broadcast_to(seen[0], seen[1:].shape), seen[1:]
    out = np.stack([(direct + mirrored) / 2, mirrored], axis=1).reshape(-1, 4, 7)
    ends = np.stack([[direct, mirrored], [mirrored, mirrored]])[..., 2:, 0]  # way, end, wall, u
    ends = ends.transpose(2, 0, 1, 3).reshape(-1, 2, 2)
    orders = np.tile([1, 2], len(mirrored))
    return Paths(np.repeat(faces[1:], 2), orders, out[..., 0], out[..., 1:], ends)


def reflections(
    state: np.ndarray, sender: np.ndarray | None, own: Pose, walls: Walls, reach: float = np.inf
) -> Paths:
    """Return a target's paths over walls at a passive terminal, one wall on each segment at most,
    images beyond `reach` [m] of either end left out.

    `state` and `sender` (6,) are the UAV's and the active terminal's, relative to the own pose.
    With `sender` None the UAV is the active terminal itself: its line of sight over a wall. The
    wave comes from the UAV, or from its image in the last wall.
    """
    here = np.concatenate([own.position, own.velocity])
    last, images, turned = _images(state + here, here, walls, reach)
    seen = np.concatenate([measure(images, own)[..., None], jacobian(images, own) @ turned], axis=2)
    if sender is None:
        return Paths(last[1:], np.ones(last.size - 1, int), seen[1:, :, 0], seen[1:, :, 1:])
    start = sender + here
    first, images, turned = _images(state + here, start, walls, reach)
    way = measure(images, own, start) - measure(images, own)
    slopes = -transmitter_jacobian(images, start) @ turned
    sent = np.concatenate([way[..., None], slopes], axis=2)
    faces = np.where(first >= 0, first, last[:, None]).T
    orders = (first >= 0)[:, None].astype(int) + (last >= 0)
    out = (sent[:, None] + seen)[orders > 0]
    return Paths(faces[orders > 0], orders[orders > 0], out[..., 0], out[..., 1:])


def _images(
    target: np.ndarray, end: np.ndarray, walls: Walls, reach: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the walls' faces (K,), the images (K, 6) of a UAV (6,) in those that show it to an end
    (6,) within reach [m], world coordinates, and what they make of its motion (K, 6, 6); the UAV
    itself first, with -1."""
    mirrors, images, _ = walls.images(target, end, reach, MEETING)
    n = walls.mirrors[1][mirrors][..., None]
    turned = np.kron(np.eye(2), np.eye(3) - 2 * n * np.swapaxes(n, 1, 2))
    return (
        np.append(-1, walls.mirrors[0][mirrors]),
        np.vstack([target, images]),
        np.concatenate([np.eye(6)[None], turned]),
    )


def occluded_by(
    place: np.ndarray,
    covariance: np.ndarray,
    seen_from: list[np.ndarray],
    walls: Walls,
    range_resolution: float,
) -> int:
    """The face that a place (3,) lies behind by more than it may be off, seen from any of the
    points; -1: none."""
    for start in seen_from:
        for face in walls.blocking(start, place):
            n = walls.city.normals[face]
            depth = abs(n @ place - walls.city.plane_offsets[face] - n @ walls.city.origin)
            spread = DEVIATIONS * np.sqrt(n @ covariance @ n)
            if depth > spread + RESOLUTION_SHARE * range_resolution:
                return int(face)
    return -1
