"""Ghost tracks by geometry: the terminal knows its own pose and the city's mesh, and nothing of the
truth.

A wall shows each UAV again, as a mirror does. Two questions are asked of a track, and either is
enough to make it suspect:

- Is it one of the echoes that a nearer UAV must have over walls? There (straight) and back (over
  a wall), the reverse, or over a wall on both ways: their ranges, rates and directions follow from
  the source's state and the wall's plane. An echo over a wall is longer than the direct one, and
  so weaker by a factor that the lengths bound. The source is another track, or a UAV that other
  terminals report: one that the line of sight masks is received by its echoes over walls.
- Does it lie behind a surface of the mesh? No UAV there could be seen straight.

A passive terminal asks the same of its reflectors, whose echoes come from its reference, the active
terminal, as it tracks it; and whether one is that terminal itself over a wall.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
from scipy.special import ndtr

from isac_rt.extensions.city_receivers.walls import Walls
from isac_rt.frame.antennas import Antennas, folded, resolutions
from isac_rt.frame.waveform import Waveform
from isac_rt.receive.types import Detections
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
ONE_WAY_SHARE = 2.0
"""The same for the direction of an echo over a wall on one way at an active terminal: its transmit
antennas see another direction than its receive antennas, so that the halves of the virtual array do
not join, and the receive antennas' resolution is twice as wide."""
AVERAGED = 9
"""Most frames over which a track averages the pull on its range and its rate."""
SHOWN = 0.3
"""Probability that a frame shows the path of a UAV over a wall, if it shows the UAV: in twelve
flights over six cities 0.02 to 0.38, and about 0.3 where there are many."""
PULLED = 1.5
"""Factor by which what walls show of a UAV is farther off than the deviations of its state say: its
echo over the ground pulls its height on boards, where it is off by 1.3 to 1.9 deviations (rms)."""
STRADDLED, IN_PHASE = 2.0, 4.0
"""Factors in power by which a path over walls may exceed what lengths allow: for cells that its
source straddles, and at an active terminal for the two waves of an echo over a wall on one way, out
over it and back, whose phases are the same."""
ALIKE = 4.0
"""Factor in power within which the waves of such an echo are found, and over the noise from which
on both are."""
APART = np.array([3.0, 1.0, 0.1, 0.1])
"""Deviations of a target's range [m], rate [m/s] and direction cosines from another's, over one
pass or two: swarms fly in formations."""
CROSSING_M = 3.0
"""Tracks that were reported before are held against the walls so near to them [m]: one that lay
before all walls comes by here on its way behind one."""


class Ghosts(TrackRule):
    """Tracks that walls explain are doubted, in each frame that shows them so.

    Parameters
    ----------
    walls : the mesh
    leeway : what detections leave open
    """

    def __init__(self, walls: Walls, leeway: Leeway) -> None:
        self._walls, self._leeway = walls, leeway
        self._alone = np.zeros(1, bool)

    def candidates(self, detections: Detections, own: Ownship) -> Detections:
        self._alone = np.append(alone(detections, self._leeway), False)  # without a detection
        return detections

    def prune(self, tracker: Tracker, own: Ownship) -> None:
        """Doubt the tracks that are a nearer target's echoes over a wall, of targets that others
        report too, and those that lie behind one, which is asked where they are first to be
        reported and where they pass one."""
        credible = [t for t in tracker.tracks if t.credible]
        if not credible:
            return
        tracks, walls = tracker.snapshot(own.pose, own.reference), self._walls
        new = {t.id for t in credible if t.id in own.tentative}
        passing = {t.id for t in credible if walls.within(t.state.mean[:3], CROSSING_M)}
        rows = np.isin(tracks.ids, [*new, *passing]) & ~tracks.is_reference
        others = track_set([Track.of_state(u.state) for u in own.reports], own.pose, own.reference)
        single = self._alone[tracks.detection]
        said = suspicion(tracks, own.pose, walls, self._leeway, others, rows, single)
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
    tells : (2,) bool, axes along which the array has three places or more: with two, two waves are
        one from between them
    """

    resolution: np.ndarray
    ambiguity: Ambiguity
    cosine_period: np.ndarray | float = np.inf
    tells: tuple[bool, bool] = (True, True)

    @classmethod
    def of(cls, waveform: Waveform, antennas: Antennas, passes: int) -> Leeway:
        """At an active terminal (2 passes) or a passive one (1)."""
        cells = resolutions(waveform, antennas, passes)
        cosine_period = antennas.cosine_period(waveform.wavelength, passes)
        across, up = antennas.places(passes)
        return cls(cells, Ambiguity.of(waveform, passes), cosine_period, (across > 2, up > 2))

    def off(self, difference: np.ndarray) -> np.ndarray:
        """Return differences (..., 4) of paths' measures, the least that ambiguities leave."""
        off = wrapped(difference, self.ambiguity)
        return np.concatenate([off[..., :2], folded(off[..., 2:], self.cosine_period)], axis=-1)

    def pull(self, one_way: bool | np.ndarray = False, age: int | np.ndarray = 0) -> np.ndarray:
        """Return by how much (..., 4) other echoes may change what a track of an `age` [frames]
        measures, and whether of an active terminal's echo over a wall on `one_way`."""
        share = np.where(np.asarray(one_way)[..., None], ONE_WAY_SHARE, RESOLUTION_SHARE)
        share = np.where([False, False, True, True], share, RESOLUTION_SHARE)
        looks = np.minimum(np.asarray(age)[..., None] + 1, AVERAGED)
        share = share / np.where([True, True, False, False], np.sqrt(looks), 1.0)
        return np.asarray(share * self.resolution)

    def explained(self, off: np.ndarray, std: np.ndarray, pull: np.ndarray) -> np.ndarray:
        """Return whether differences `off` (..., 4) are insignificant, by deviations and pulls."""
        return np.asarray((np.abs(off) <= DEVIATIONS * std + pull).all(axis=-1))

    def apart(self, paths: np.ndarray) -> np.ndarray:
        """(P,) whether the array tells the two waves of `echoes` (P, 4) on one way apart."""
        off = np.abs(self.off(paths[3::4] - paths[0::4]))[:, 2:] > self.resolution[2:]
        return np.repeat((off & self.tells).any(axis=1), 4)


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
    ratio : (K,) density of targets there over that of the echo's measures, if the frame shows it
        (`SHOWN`), 0 behind a face; inf: nothing speaks against a target
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
    single: np.ndarray | None = None,
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
    single : (K,) bool, those whose detection is `alone`; None: none
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
    sources = [(tracks, int(s)) for s in np.flatnonzero(tracks.confirmed & (out.behind < 0))]
    sources += [(told, int(s)) for s in np.flatnonzero(held.useful)]
    found = [of for known, s in sources if (of := held.explained(known, s, single)).row.size]
    is_target = tracks.confirmed & ~tracks.is_reference & (out.behind < 0)
    for of in found:
        is_target[of.row] = False
    for of in found:
        ratio = held.density(of, is_target) / (SHOWN * of.likelihood)
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
    """

    row: np.ndarray
    source: int
    report: int
    faces: np.ndarray
    orders: np.ndarray
    off: np.ndarray
    std: np.ndarray
    pull: np.ndarray

    @property
    def likelihood(self) -> np.ndarray:
        """(n,) density of normal errors and pulls that are alike up to the most."""
        off = np.abs(self.off)
        share = ndtr((self.pull - off) / self.std) - ndtr((-self.pull - off) / self.std)
        return np.asarray((share / (2 * self.pull)).prod(axis=1))


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
        span = np.array([self.tracks.range.max(), leeway.ambiguity.period, 2.0, 2.0])
        span[2:] = np.minimum(span[2:], leeway.cosine_period)
        out = 1 / np.maximum(span, 2 * of.pull).prod(axis=1)

        def near(places: np.ndarray, apart: np.ndarray) -> np.ndarray:
            blurred = np.sqrt(apart**2 + (std**2 + of.pull**2 / 3)[:, None])
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

    def explained(self, known: TrackSet, s: int, single: np.ndarray | None) -> _Explained:
        """Return which tracks are echoes of a source over walls by their measures."""
        shown, tracks, leeway = self.shown(known, s), self.tracks, self.leeway
        std = np.hypot(tracks.std, known.std[s])
        one_way = (shown.orders == 1) & (self.sender is None)
        may_be = ~tracks.is_reference & (tracks.range > known.range[s])
        most = known.snr[s] * _weaker(known, s, self.sender, tracks.range)
        if known is not tracks:  # a track of the UAV itself is no echo of it
            off = leeway.off(tracks.measured - known.measured[s])
            may_be &= ~leeway.explained(off, std, leeway.pull())
        of_source = np.maximum(known.std[s], PULLED * shown.std(known.covariance[s]))
        off = leeway.off(tracks.measured[:, None] - shown.measured)
        std = np.hypot(tracks.std[:, None], of_source)
        pull = leeway.pull(one_way, tracks.age[:, None])
        hit = leeway.explained(off, std, pull) & may_be[:, None]
        hit &= tracks.snr[:, None] <= np.where(one_way, IN_PHASE, STRADDLED) * most[:, None]
        if single is not None and self.sender is None:
            hit &= ~(single[:, None] & one_way & leeway.apart(shown.measured))
        row, path = np.nonzero(hit)
        of_pair = (a[row, path] for a in np.broadcast_arrays(off, std, pull))
        source, report = int(known.ids[s]), -1 if known is tracks else s
        return _Explained(row, source, report, shown.faces[path], shown.orders[path], *of_pair)


def alone(d: Detections, leeway: Leeway) -> np.ndarray:
    """Return which detections (Q,) are too strong for an echo over a wall on one way without its
    other wave, which comes from elsewhere."""
    off = np.abs(leeway.off(d.measured[:, None] - d.measured))
    near, far = off < leeway.resolution, off >= leeway.resolution  # neither without a direction
    other = near[..., :2].all(axis=2) & far[..., 2:].any(axis=2)
    other &= ALIKE * d.snr > d.snr[:, None]
    return np.asarray((d.snr > ALIKE) & ~other.any(axis=1))


def _weaker(known: TrackSet, s: int, sender: np.ndarray | None, ranges: np.ndarray) -> np.ndarray:
    """Return a bound on the power of echoes of track `s` over walls, of such ranges (K,), relative
    to its direct one: no segment is shorter than the direct path's."""
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
    """

    faces: np.ndarray
    orders: np.ndarray
    measured: np.ndarray
    slopes: np.ndarray

    def std(self, covariance: np.ndarray) -> np.ndarray:
        """Return deviations (P, 4) for a UAV's covariance (6, 6): a height that its range and its
        rate say little of decides what the ground shows."""
        return np.asarray(np.sqrt(((self.slopes @ covariance) * self.slopes).sum(axis=-1)))


def echoes(state: np.ndarray, own: Pose, walls: Walls, reach: float = np.inf) -> Paths:
    """Return a target's echoes over each single wall, four of each, images beyond `reach` [m] left
    out.

    `state` (6,) is position and velocity relative to the terminal, world axes. Over the wall on one
    way two equal waves arrive, from the UAV and from the image, at the mean of the two ranges;
    where the virtual array, which adds the phases of both ways, points then is left open: at the
    UAV, at the image or midway. Over it on both ways the echo is the image's.
    """
    here = np.concatenate([own.position, own.velocity])
    faces, images, turned = _images(state + here, here, walls, reach)
    seen = np.concatenate([measure(images, own)[..., None], jacobian(images, own) @ turned], axis=2)
    mirrored, middle = seen[1:], (seen[1:] + seen[0]) / 2
    direct = np.broadcast_to(seen[0], mirrored.shape)
    out = np.stack([direct, mirrored, middle, mirrored], axis=1)
    out[:, :3, :2] = middle[:, None, :2]
    out, orders = out.reshape(-1, 4, 7), np.tile([1, 1, 1, 2], len(mirrored))
    return Paths(np.repeat(faces[1:], 4), orders, out[..., 0], out[..., 1:])


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
