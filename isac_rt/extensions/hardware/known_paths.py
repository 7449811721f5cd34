"""A terminal that learns of its hardware from strong paths that come from where it knows that
somebody is."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from isac_rt.extensions.hardware.self_calibration import (
    FREE,
    Change,
    KnownDirection,
    SelfCalibration,
)
from isac_rt.frame.antennas import unit_vector
from isac_rt.frame.waveform import SPEED_OF_LIGHT, Waveform
from isac_rt.receive.types import PathChannels, Reception
from isac_rt.track.filter import Ambiguity, Gaussian, measure, wrapped
from isac_rt.track.parts import Ownship
from isac_rt.track.tracker import Track, Tracker, TrackSet
from isac_rt.world.swarm import Pose

POSITION_STD, VELOCITY_STD = 0.02, 0.05
"""Of what terminals say of themselves, per axis: satellites by carrier phase, and their velocities
[m, m/s]."""
NEAR_CELLS = 1.5
"""Cells of range and of velocity within which a path is the one that is expected."""


class LearnedHardware(SelfCalibration):
    """The terminal's estimate of its hardware, fed by the frames that it receives."""

    def learn_from(
        self, reception: Reception, own: Ownship, tracker: Tracker, reference: Track | None
    ) -> None:
        if self._passes == 2:
            tracks = tracker.snapshot(own.pose)
            seen = echoes(
                reception.path_channels, self.waveform, own.pose, own.reported_poses, tracks
            )
        elif reference is None or reference.missed:
            return
        else:
            seen = known_lines_of_sight(
                reception.path_channels, own.pose, own.reported_poses, reference.state
            )
        change = self.learn_all(seen)
        if reference is not None:
            reference.state = seen_after(reference.state, own.pose, change, 1)
        for track in tracker.tracks:
            track.state = seen_after(track.state, own.pose, change, 2)


def echoes(
    measured_paths: Sequence[PathChannels],
    waveform: Waveform,
    own: Pose,
    reported_poses: Sequence[Pose],
    tracks: TrackSet,
) -> list[tuple[PathChannels, KnownDirection]]:
    """Looks at an active terminal that show another terminal or a confirmed track, each once, the
    terminals first."""
    ahead = [p for p in reported_poses if own.to_body(p.position - own.position)[1] > 0]
    known = [_known(pose, own, 2) for pose in ahead]
    seen = tracks.confirmed & (tracks.detection >= 0) & np.isfinite(tracks.direction).all(axis=1)
    for k in np.flatnonzero(seen):
        direction = KnownDirection(tracks.direction[k], float(tracks.range[k]), FREE)
        known.append((np.array([tracks.range[k], tracks.velocity[k]]), direction))
    out, left = [], list(measured_paths)
    for expected, known_direction in known:
        nearest = _nearest(left, expected[:2], waveform)
        if nearest is not None:
            out.append((left.pop(nearest), known_direction))
    return out


def known_lines_of_sight(
    measured_paths: Sequence[PathChannels],
    own: Pose,
    reported_poses: Sequence[Pose],
    reference: Gaussian,
) -> list[tuple[PathChannels, KnownDirection]]:
    """The measured path of a passive terminal at its transmitter, which says where it is or is
    tracked."""
    if reported_poses:
        return [(measured, _known(reported_poses[0], own, 1)[1]) for measured in measured_paths]
    z = measure(reference.mean, own)
    return [(measured, KnownDirection(z[2:], float(z[0]), FREE)) for measured in measured_paths]


def _known(pose: Pose, own: Pose, passes: int) -> tuple[np.ndarray, KnownDirection]:
    """Range, its rate and direction cosines of another terminal, and the path to it and maybe
    back."""
    z = measure(np.concatenate([pose.position, pose.velocity]), own)
    of_path = np.array([z[0], z[1], POSITION_STD, VELOCITY_STD]) * passes / SPEED_OF_LIGHT
    delay, rate, *std = of_path.tolist()
    return z, KnownDirection(z[2:], float(z[0]), POSITION_STD / float(z[0]), (delay, rate, *std))


def _nearest(
    measured_paths: Sequence[PathChannels], expected: np.ndarray, waveform: Waveform
) -> int | None:
    """The strongest echo within `NEAR_CELLS` of a range and a velocity."""
    w, best, most = waveform, None, 0.0
    cells = np.array([w.range_cell(2), w.velocity_cell(2)])
    for i, measured in enumerate(measured_paths):
        found = np.array([measured.delay, measured.delay_rate]) * SPEED_OF_LIGHT / 2
        offset = wrapped(found - expected, Ambiguity.of(w, 2))
        power = float(np.sum(np.abs(measured.modes[0]) ** 2))
        if (np.abs(offset) < NEAR_CELLS * cells).all() and power > most:
            best, most = i, power
    return best


def seen_after(state: Gaussian, own: Pose, change: Change, passes: int) -> Gaussian:
    """A UAV as it is seen once the hardware is known better, by paths that pass the way to it so
    often."""
    direction_to = own.to_body(state.mean[:3] - own.position)
    distance = np.linalg.norm(direction_to)
    if direction_to[1] <= 0:  # out of view
        return state
    u = direction_to[[0, 2]] / distance - change.direction
    towards = own.to_world(unit_vector(u * min(1.0, 1 / np.linalg.norm(u))))
    mean, metres = state.mean.copy(), SPEED_OF_LIGHT / passes
    mean[:3] = own.position + towards * (distance - change.delay * metres)
    mean[3:6] -= towards * (change.rate * metres)
    covariance, axes = state.covariance.copy(), own.rotation[:, [0, 2]] * distance
    covariance[:3, :3] += (axes * change.spread**2) @ axes.T
    return Gaussian(mean, covariance)
