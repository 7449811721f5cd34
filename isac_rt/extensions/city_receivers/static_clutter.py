"""Echoes of static surfaces that the terminal's mesh lacks.

What is static at several places near each other, and is explained by nothing that the terminal
knows, is a surface, or a swarm that hovers or crosses. They differ in time: a surface shows other
spots of itself in each frame, a UAV is found again where it was. The terminal follows such spots
for a while, and those that are not found again make a surface of what is beside them. Echoes of
one surface are about as strong as each other: what stands far out of its neighbours is a UAV, and
no neighbour of what is far weaker.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

from isac_rt.extensions.city_receivers.walls import Walls
from isac_rt.frame.antennas import Antennas, unit_vector
from isac_rt.frame.waveform import Waveform
from isac_rt.receive.types import Detections
from isac_rt.track.filter import INITIAL_SPEED_STD, Ambiguity, mahalanobis
from isac_rt.track.parts import Ownship, TrackRule
from isac_rt.track.tracker import CLEAR_M, Track, Tracker, assign
from isac_rt.world.swarm import Pose

STILL_MPS = 0.5
"""Off the rate of what stands still by no more than this, and three deviations, an echo may stand
still [m/s]: the own velocity's error, and twice the spread of a wall within its cell."""
MEMORY_S = 1.0
"""How long a spot is remembered that is not found again [s]."""
BESIDE_M = (1.5, 16.0)
"""Spots that far apart are beside each other [m]: not one and the same, and not another
building's."""
STANDS_ODDS = 10.0
"""Odds from which on a track stands still: the likelihood of its velocity if it does, over that if
it flies as UAVs do. What is not known of its velocity says nothing."""
CROWD = 3
"""So many spots beside it that were not found again make an echo part of a surface."""
SURFACE = 16
"""So many spots beside a track are a surface, whether found again or not: a dozen UAVs are less."""
FOUND_AGAIN = 0.5
"""Share of the frames since its first one in which a UAV is found."""
STANDS_OUT = 10.0
"""An echo weaker than another by more than this factor is not of the same surface."""


@dataclass
class StaticSpots:
    """Spots that were static lately: (n, 7) places, signal-to-noise ratios, times of the last echo,
    frames in which they were seen, and numbers of their first frame; and the frames so far."""

    spots: np.ndarray = field(default_factory=lambda: np.zeros((0, 7)))
    frames: int = 0


class StaticClutter(TrackRule):
    """Where echoes stood still that nothing explains.

    Parameters
    ----------
    cosine_period : of `Antennas`: an echo from beyond the view is seen so far beside its direction
    walls : the mesh; None: nothing is known of it
    velocity_period : span of unambiguous velocities [m/s]
    """

    def __init__(
        self, cosine_period: np.ndarray | float, walls: Walls | None, velocity_period: float
    ) -> None:
        self._walls, self._period = walls, velocity_period
        self._crowd = np.zeros(0, bool)
        self.state = StaticSpots()
        by = [(0.0, -t, t) if np.isfinite(t) else (0.0,) for t in np.broadcast_to(cosine_period, 2)]
        self._aliases = np.array([(x, z) for x in by[0] for z in by[1]])

    @classmethod
    def of(
        cls, antennas: Antennas, waveform: Waveform, passes: int, walls: Walls | None
    ) -> StaticClutter:
        """For the array of an active terminal (passes = 2) or a passive one."""
        period = Ambiguity.of(waveform, passes).period
        return cls(antennas.cosine_period(waveform.wavelength, passes), walls, period)

    def candidates(self, detections: Detections, own: Ownship) -> Detections:
        self._crowd = np.zeros(len(detections), bool)
        if own.clutter_known:  # else the city's own echoes are among them
            sender = None if own.transmitter is None else own.transmitter.mean[:6]
            self._crowd = self.update(detections, own.pose, own.time, sender)
        return replace(detections, starts=detections.starts & ~self._crowd)

    def prune(self, tracker: Tracker, own: Ownship) -> None:
        """End the tracks in a face or static within a crowd, and those, not reported before, that
        an echo of one carries on: from beyond the view and along a wall they seem to move. Doubt
        reported ones that it carries on with gaps: what a wall mirrors moves too. Few hits confirm
        none beside a surface, whose spots carry it on, nor before the clutter is known."""
        for track in (t for t in tracker.tracks if t.id in own.tentative):
            if track.confirmed and sum(track.recent) < tracker.settings.confirm_window:
                track.confirmed = int(self._beside(track.state.mean[None, :3]).sum()) < SURFACE
            track.confirmed &= own.clutter_known  # else it may be an echo of the city
        fed = {t.id for t in tracker.tracks if t.detection >= 0 and self._crowd[t.detection]}
        still = {t.id for t in tracker.tracks if self.holds(t)}
        tracker.drop(still | (fed & own.tentative))
        gaps = {t.id for t in tracker.tracks if not all(t.recent)}
        tracker.doubt(dict.fromkeys(fed & gaps, 1.0))  # a surface shows it as well as a UAV

    def update(
        self, d: Detections, own: Pose, time: float, sender: np.ndarray | None = None
    ) -> np.ndarray:
        """Take down a frame's echoes that stand still, of those that may start a track. What would
        stand still in a direction that it may be an alias of stands there.

        Parameters
        ----------
        time : of the frame [s]
        sender : at a passive terminal (6,) of its transmitter, world coordinates

        Returns
        -------
        (Q,) which of all detections are static within a crowd
        """
        u = d.direction[:, None] + self._aliases
        far = np.linalg.norm(u, axis=-1)
        real = far < 1 + 3 * d.std[:, None, 2:].max(axis=-1, initial=0.0)
        u = u / np.maximum(far, 1.0)[..., None]  # square to the boresight, but for the error
        towards = own.to_world(unit_vector(u))
        place, rate, speed, seen = _still(d.range, towards, own, sender)
        off = d.velocity[:, None] - rate
        off = np.where(real, np.abs(off - self._period * np.round(off / self._period)), np.inf)
        best = off.argmin(axis=1)  # the direction in which it would stand still
        each = np.arange(len(d))
        across = speed * np.linalg.norm(d.std[:, 2:], axis=1)
        allowed = STILL_MPS + 3 * np.hypot(d.std[:, 1], across)
        # between both ends of a passive link a UAV that flies along it has the rate of a still one
        tells = INITIAL_SPEED_STD.max() * seen[each, best] > 3 * allowed
        still = tells & (off[each, best] < allowed)
        place = place[each, best]
        some = still & d.starts & ~d.is_reference
        self._note(place[some], d.select(some), own, time)
        return still & self.crowded(place, d.snr)

    def _beside(self, places: np.ndarray) -> np.ndarray:
        """Return which spots lie beside places (n, 3): (n, spots)."""
        separation = np.linalg.norm(places[:, None] - self.state.spots[None, :, :3], axis=-1)
        return np.asarray((separation > BESIDE_M[0]) & (separation < BESIDE_M[1]))

    def _note(self, places: np.ndarray, d: Detections, own: Pose, time: float) -> None:
        """Follow the spots to a frame's echoes at places (n, 3), within three deviations in
        direction."""
        state, snr = self.state, d.snr
        old = state.spots[state.spots[:, 4] > time - MEMORY_S]
        far = np.linalg.norm(places - own.position, axis=1)
        off = own.to_body(places[:, None] - old[None, :, :3])
        most = np.full((len(d), 3), BESIDE_M[0])
        most[:, [0, 2]] = np.maximum(most[:, [0, 2]], 3 * far[:, None] * d.std[:, 2:])
        separation = np.linalg.norm(off / most[:, None], axis=-1)
        pairs = assign(np.where(separation < 1, separation, np.inf))
        echo, spot = np.array(pairs, int).reshape(-1, 2).T
        old[spot, :5] = np.column_stack([places, snr, np.full(len(snr), time)])[echo]
        old[spot, 5] += 1
        new = np.setdiff1d(np.arange(len(snr)), echo)
        more = np.column_stack([places, snr, np.tile([time, 1, state.frames], (len(snr), 1))])[new]
        state.spots, state.frames = np.concatenate([old, more]), state.frames + 1

    def crowded(self, places: np.ndarray, snr: np.ndarray) -> np.ndarray:
        """(n,) whether what is seen at places (n, 3), so far above the noise (n,), lies among spots
        as strong of which most were not found again. What touches the mesh may stand out of them:
        the foot of a wall shines too."""
        spots = self.state.spots
        fleeting = spots[:, 5] <= FOUND_AGAIN * (self.state.frames - spots[:, 6])
        beside = self._beside(places) & (spots[:, 3] < STANDS_OUT * snr[:, None])
        like = beside & (STANDS_OUT * spots[:, 3] > snr[:, None])

        def is_surface(some: np.ndarray) -> np.ndarray:
            count = (some & fleeting).sum(axis=1)
            return np.asarray((count >= CROWD) & (2 * count > some.sum(axis=1)))

        out = is_surface(like)
        if self._walls is not None:
            for i in np.flatnonzero(is_surface(beside) & ~out):
                out[i] = self._walls.within(places[i], BESIDE_M[0])
        return out

    def holds(self, track: Track) -> bool:
        """Return whether a track is static within a crowd, or where no UAV can be, in a face. A
        confirmed one that was found in each of the latest frames is no passing spot."""
        place, P = track.state.mean[:3], track.state.covariance[:3, :3]
        clear = CLEAR_M - 2 * float(np.sqrt(np.linalg.eigvalsh(P)[-1]))
        in_face = self._walls is not None and self._walls.within(place, clear)
        passing = rests(track) and not (track.confirmed and all(track.recent))
        return in_face or (passing and bool(self.crowded(place[None], np.array([track.snr]))[0]))


def rests(track: Track) -> bool:
    """Return whether a track is static, by the odds of its velocity."""
    velocity, P = track.state.mean[3:6], track.state.covariance[3:6, 3:6]
    spread = np.square([np.full(3, STILL_MPS), INITIAL_SPEED_STD])[:, None] * np.eye(3)
    d2, log_det = mahalanobis(np.tile(velocity, (2, 1)), P + spread)
    still, flies = -(d2 + log_det) / 2
    return bool(still - flies > np.log(STANDS_ODDS))


def _still(
    range: np.ndarray, towards: np.ndarray, own: Pose, sender: np.ndarray | None
) -> tuple[np.ndarray, np.ndarray, float, np.ndarray]:
    """Return where echoes (Q,) are if they come from directions (Q, A, 3), the rate (Q, A) at which
    they recede if they stand still there, how fast the ends fly, and the rate of what moves at
    1 m/s along the way to both ends (Q, A)."""
    speed = float(np.linalg.norm(own.velocity))
    rate = -(towards @ own.velocity)
    if sender is None:
        place = own.position + range[:, None, None] * towards
        return place, rate, speed, np.ones(rate.shape)
    span, r = sender[:3] - own.position, range[:, None]
    far = (r**2 - span @ span) / (2 * np.maximum(r - towards @ span, 1e-9))
    place = own.position + far[..., None] * towards
    away = place - sender[:3]
    away /= np.maximum(np.linalg.norm(away, axis=-1, keepdims=True), 1e-9)
    rate = rate - away @ sender[3:]
    seen = np.linalg.norm(towards + away, axis=-1)
    return place, rate, speed + float(np.linalg.norm(sender[3:])), seen
