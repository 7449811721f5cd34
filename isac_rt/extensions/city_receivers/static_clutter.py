"""Echoes that stand still: of a face of the terminal's mesh, or of a building that it lacks.

A UAV may hover, but not in a face: what stands still there, as far as is known of its place, is
the wall, whose brightest spots pass the threshold that its mean return sets. It hovers alone, too,
and in one place. What stands still in the world at several places near each other, and is explained
by nothing that the terminal knows, is a surface. The terminal remembers such echoes for a while,
because each frame shows other parts of it. Echoes of one surface are about as strong as each other:
what stands far out of its neighbours is a UAV, and no neighbour of what is far weaker.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

from isac_rt.extensions.city_receivers.walls import Walls
from isac_rt.frame.antennas import Antennas, unit_vector
from isac_rt.frame.waveform import Waveform
from isac_rt.receive.types import Detections
from isac_rt.track.filter import Ambiguity
from isac_rt.track.parts import Own, TrackRule
from isac_rt.track.tracker import Track, Tracker
from isac_rt.world.swarm import Pose

STILL_MPS = 0.5
"""Off the rate of what stands still by no more than this, and three deviations, an echo may stand
still [m/s]: the own velocity's error, and twice the spread of a wall within its cell."""
MEMORY_S = 1.0
"""How long an echo that stood still is remembered [s]."""
BESIDE_M = (1.5, 16.0)
"""Echoes that far apart are beside each other [m]: not one and the same place, and not another
building's."""
STANDS = 11.3
"""Squared distance of a velocity from nothing within which a track may stand still: 0.99 of chi
squared of three."""
CROWD = 3
"""So many beside it make an echo part of a surface."""
ON_FACE_M = 0.3
"""Off a face by no more than this, and three deviations, what stands still may be the face [m]."""
CLEAR_M = 0.5
"""No UAV flies nearer to a face than this [m]: its arms are as long. What is nearer, by two
deviations, is an echo of something else over the wall."""
STANDS_OUT = 10.0
"""An echo weaker than another by more than this factor is not of the same surface."""


@dataclass
class Seen:
    """Echoes that stood still lately: (n, 5) times, places and signal-to-noise ratios."""

    echoes: np.ndarray = field(default_factory=lambda: np.zeros((0, 5)))


class StaticClutter(TrackRule):
    """Where echoes stood still that nothing explains.

    Parameters
    ----------
    turn : of `Antennas`: an echo from beyond the view is seen so far beside its direction
    walls : the mesh; None: nothing is known of it
    velocity_period : span of unambiguous velocities [m/s]
    """

    def __init__(self, turn: float, walls: Walls | None, velocity_period: float) -> None:
        self._walls, self._period = walls, velocity_period
        self._crowd = np.zeros(0, bool)
        self.state = Seen()
        steps = (0, -1, 1) if np.isfinite(turn) else (0,)
        by = [step * turn if step else 0.0 for step in steps]
        self._aliases = np.array([(x, z) for x in by for z in by])

    @classmethod
    def of(
        cls, antennas: Antennas, waveform: Waveform, passes: int, walls: Walls | None
    ) -> StaticClutter:
        """For the array of an active terminal (passes = 2) or a passive one."""
        period = Ambiguity.of(waveform, passes).period
        return cls(antennas.turn(waveform.wavelength, passes), walls, period)

    def births(self, detections: Detections, own: Own) -> Detections:
        self._crowd = np.zeros(len(detections), bool)
        if own.clutter_known:  # else the city's own echoes are among them
            sender = None if own.transmitter is None else own.transmitter.mean[:6]
            self._crowd = self.update(detections, own.pose, own.time, sender)
        return replace(detections, starts=detections.starts & ~self._crowd)

    def prune(self, tracker: Tracker, own: Own) -> None:
        """End the tracks that stand still within a crowd or on a face, and those, not confirmed
        before, that an echo of either carries on: from beyond the view and along a wall they seem
        to move."""
        fed = {t.id for t in tracker.tracks if t.detection >= 0 and self._crowd[t.detection]}
        still = {t.id for t in tracker.tracks if self.holds(t)}
        tracker.drop(still | (fed & own.tentative))

    def update(
        self,
        d: Detections,
        own: Pose,
        time: float,
        sender: np.ndarray | None = None,
    ) -> np.ndarray:
        """Take down a frame's echoes that stand still, of those that may start a track. What would
        stand still in a direction that it may be an alias of stands there.

        Parameters
        ----------
        time : of the frame [s]
        sender : at a passive terminal (6,) of its transmitter, world coordinates

        Returns
        -------
        (Q,) which of all detections stand still within a crowd or on a face
        """
        u = d.direction[:, None] + self._aliases
        far = np.linalg.norm(u, axis=-1)
        real = far < 1 + 3 * d.std[:, None, 2:].max(axis=-1, initial=0.0)
        u = u / np.maximum(far, 1.0)[..., None]  # square to the boresight, but for the error
        towards = own.to_world(unit_vector(u))
        place, rate, speed = _still(d.range, towards, own, sender)
        off = d.velocity[:, None] - rate
        off = np.where(real, np.abs(off - self._period * np.round(off / self._period)), np.inf)
        best = off.argmin(axis=1)  # the direction in which it would stand still
        each = np.arange(len(d))
        across = speed * np.linalg.norm(d.std[:, 2:], axis=1)
        still = off[each, best] < STILL_MPS + 3 * np.hypot(d.std[:, 1], across)
        place = place[each, best]
        spread = np.hypot(d.std[:, 0], d.range * d.std[:, 2:].max(axis=1, initial=0.0))
        on = self._on_face(place, spread, still)
        new = np.column_stack([np.full(len(d), time), place, d.snr])
        new = new[still & d.starts & ~d.is_reference]
        self.state.echoes = np.concatenate(
            [self.state.echoes[self.state.echoes[:, 0] > time - MEMORY_S], new]
        )
        return on | still & self.crowded(place, d.snr)

    def _on_face(self, places: np.ndarray, spread: np.ndarray, asked: np.ndarray) -> np.ndarray:
        """(n,) which of the places (n, 3) asked for, known to a deviation (n,), may lie on a face.
        What is not known to `BESIDE_M` may lie on any, and is told by its crowd."""
        reach = ON_FACE_M + 3 * spread
        out = asked & (reach < BESIDE_M[0])
        if self._walls is None:
            return np.zeros(len(out), bool)
        out[out] = [
            self._walls.within(place, float(far))
            for place, far in zip(places[out], reach[out], strict=True)
        ]
        return out

    def crowded(self, places: np.ndarray, snr: np.ndarray) -> np.ndarray:
        """(n,) whether what is seen at places (n, 3), so far above the noise (n,), lies among
        echoes that stood still, and does not stand out of them. What touches the mesh does not:
        the foot of a wall shines too."""
        apart = np.linalg.norm(places[:, None] - self.state.echoes[None, :, 1:4], axis=-1)
        beside = (apart > BESIDE_M[0]) & (apart < BESIDE_M[1])
        beside &= self.state.echoes[:, 4] < STANDS_OUT * snr[:, None]
        some = self._among(beside)
        out = some & ~self._among(beside & (STANDS_OUT * self.state.echoes[:, 4] > snr[:, None]))
        if self._walls is not None:
            out[out] = [not self._walls.within(place, BESIDE_M[0]) for place in places[out]]
        return some & ~out

    def _among(self, beside: np.ndarray) -> np.ndarray:
        """(n,) whether what is seen beside each (n, S) makes a crowd."""
        some = beside.sum(axis=1) >= CROWD
        some[some] = [_spots(self.state.echoes[near, 1:4]) >= CROWD for near in beside[some]]
        return some

    def holds(self, track: Track) -> bool:
        """Return whether a track is static, as far as is known of it, within a crowd or on a face,
        or flies where no UAV can, in a face."""
        place = track.state.mean[:3]
        spread = float(np.sqrt(np.linalg.eigvalsh(track.state.covariance[:3, :3])[-1]))
        if not rests(track):
            return self._walls is not None and self._walls.within(place, CLEAR_M - 2 * spread)
        on = self._on_face(place[None], np.array([spread]), np.ones(1, bool))
        return bool(on[0] or self.crowded(place[None], np.array([track.snr]))[0])


def rests(track: Track) -> bool:
    """Return whether a track is static, as far as is known of it."""
    velocity, P = track.state.mean[3:6], track.state.covariance[3:6, 3:6]
    d2 = velocity @ np.linalg.solve(P + STILL_MPS**2 * np.eye(3), velocity)
    return bool(d2 < STANDS)


def _spots(places: np.ndarray) -> int:
    """Count the places (n, 3) that are apart from each other, up to `CROWD`: a target that hovers
    nearby is one, however often it was seen."""
    spots: list[np.ndarray] = []
    for place in places:
        if all(np.linalg.norm(place - spot) > BESIDE_M[0] for spot in spots):
            spots.append(place)
        if len(spots) >= CROWD:
            break
    return len(spots)


def _still(
    range: np.ndarray, towards: np.ndarray, own: Pose, sender: np.ndarray | None
) -> tuple[np.ndarray, np.ndarray, float]:
    """Where echoes (Q,) are if they come from directions (Q, A, 3), the rate (Q, A) at which they
    recede if they stand still there, and how fast the ends fly."""
    speed = float(np.linalg.norm(own.velocity))
    rate = -(towards @ own.velocity)
    if sender is None:
        return own.position + range[:, None, None] * towards, rate, speed
    span, r = sender[:3] - own.position, range[:, None]
    far = (r**2 - span @ span) / (2 * np.maximum(r - towards @ span, 1e-9))
    place = own.position + far[..., None] * towards
    away = place - sender[:3]
    rate = rate - (away @ sender[3:]) / np.maximum(np.linalg.norm(away, axis=-1), 1e-9)
    return place, rate, speed + float(np.linalg.norm(sender[3:]))
