"""A scene of one radar and one target with moving parts, and its samples by every point's place at
every sample."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

import isac_rt as irt
from isac_rt.frame.link import Link
from isac_rt.frame.waveform import SPEED_OF_LIGHT
from isac_rt.propagation.pathset import PathKind, PathSet, make_paths
from isac_rt.scenario.tree import Scenario
from isac_rt.signal.exact import filter_gain

OWN = Link("radar", "radar")
OVER_GROUND = (1, 1, 1), (1, 1, -1)
"""Mirrors of a radar without and by way of the ground, z = 0."""
Places = Callable[[np.ndarray], np.ndarray]


def scene(target: dict[str, Any], chirps: int = 24, frames: int = 2, **radar: Any) -> Scenario:
    """Return a 77 GHz radar at the origin, 1 m high, that looks ahead, and a target."""
    return Scenario.model_validate(
        {
            "frames": frames,
            "frame_interval_s": 0.05,
            "sensor": "awr1843",
            "radio": {"chirps_per_frame": chirps},
            "receiver_preset": "plain",
            "accuracy": {"preset": "everything"},
            "swarm": {
                "radar": {"role": "active", "position_m": [0, 0, 1], "boresight": [0, 1, 0]}
                | radar,
                "T": {"role": "target"} | target,
            },
        }
    )


def samples_of(setup: irt.Setup, frame: irt.Frame, paths: Any = None) -> np.ndarray:
    """Return a frame's samples without noise, or those of some paths alone."""
    links = frame._arriving(OWN) if paths is None else [(frame.sent["radar"], paths)]
    return irt.if_signal(setup.waveform, links, *frame._listening(OWN), irt.Direct()).samples


def sum_over_points(
    setup: irt.Setup,
    frame: irt.Frame,
    places: Places,
    amplitudes: Callable[[np.ndarray, np.ndarray], np.ndarray],
    images: tuple[tuple[int, int, int], ...] = ((1, 1, 1),),
    loss: float = 1.0,
) -> np.ndarray:
    """Return the samples of points in float64, element by element.

    Parameters
    ----------
    places : (N, K, 3) of the points at times (N,) [s] of the run
    amplitudes : (N, K) of the echo without spreading, at times and places, times the product of
        the distances from the radar; with the elements' gain towards the target's place
    images : mirrors of the radar's position, over each of which a path comes and goes
    loss : amplitude of a reflection at the others than the first
    """
    w, pose, antennas = setup.waveform, frame.poses["radar"], setup.arrays.of("radar")
    tx, rx = (
        pose.position + pose.to_world(r) for r in (antennas.tx_positions, antennas.rx_positions)
    )
    sent, target = frame.sent["radar"], frame.poses["T"].position
    out = np.zeros((1, len(rx), w.num_chirps, w.num_samples), complex)

    def seen(points: np.ndarray, mirror: tuple[int, int, int]) -> tuple[np.ndarray, np.ndarray]:
        """Distances over a mirror, and the elements' gain over that towards the target."""
        each, one = points - pose.position * mirror, target - pose.position * mirror
        length, ahead = np.linalg.norm(each, axis=2), one / np.linalg.norm(one)
        towards = [pose.to_body(v * mirror) for v in (each / length[..., None], ahead)]
        gain = [antennas.element_gain(v) for v in towards]
        return length, gain[0] / gain[1]

    for p in range(w.num_chirps):
        time = setup.timetable.start_time(frame.number) + p * w.slot_duration + w.fast_time
        points = places(time)
        level = amplitudes(time, points)
        for a, there in enumerate(images):
            sends = np.linalg.norm(points - tx[sent.schedule[0, p]] * there, axis=2)
            from_radar, pattern = seen(points, there)
            for b, back in enumerate(images):
                to_radar, other = seen(points, back)
                gain = (
                    level
                    / (from_radar * to_radar)
                    * np.sqrt(pattern * other)
                    * loss ** ((a > 0) + (b > 0))
                )
                for r, element in enumerate(rx):
                    tau = sends + np.linalg.norm(points - element * back, axis=2)
                    phase = w.phase(tau / SPEED_OF_LIGHT, w.fast_time[:, None])
                    out[0, r, p] += (gain * np.exp(2j * np.pi * phase)).sum(axis=1)
    return out * filter_gain(w, 0.0) * sent.amplitude


def echo_amplitude(frame: irt.Frame, section: float) -> float:
    """Return |gain| of the target's echo times its distances, for one square metre, where its
    cross-section is `section` [m^2]."""
    distance = np.linalg.norm(frame.poses["T"].position - frame.poses["radar"].position)
    return float(np.abs(frame.paths[OWN].gain[0]) * distance**2 / np.sqrt(section))


def over_ground(frame: irt.Frame, loss: float) -> PathSet:
    """Return T's echo and those by way of the ground, z = 0, which reflects by `loss`."""
    radar, q = (frame.poses[name] for name in ("radar", "T"))
    images = np.array([radar.position, radar.position * [1, 1, -1]])

    def delay(t: float) -> np.ndarray:
        ways = np.linalg.norm(q.position + np.multiply.outer(t, q.velocity) - images, axis=-1)
        return (ways[..., :, None] + ways[..., None, :]).ravel() / SPEED_OF_LIGHT

    h = 1e-4
    before, now, after = (delay(t) for t in (-h, 0.0, h))
    away = q.position - images
    far = np.linalg.norm(away, axis=1)
    share = images[1, 2] / (images[1, 2] - q.position[2])
    hit = images[1] + share * away[1]
    unit = away / far[:, None] * [[1, 1, 1], [1, 1, -1]]
    nowhere = np.full(3, np.nan)
    there, back = np.array([0, 0, 1, 1]), np.array([0, 1, 0, 1])
    points = [
        [hit if a else nowhere, q.position, hit if b else nowhere]
        for a, b in zip(there, back, strict=True)
    ]
    return make_paths(
        gain=frame.paths[OWN].gain[0]
        * loss ** (there + back)
        * (far[0] ** 2 / far[there] / far[back]),
        delay=now,
        delay_rate=(after - before) / (2 * h),
        delay_accel=(after - 2 * now + before) / h**2,
        departure=unit[there],
        arrival=unit[back],
        tx_radius=far[there],
        rx_radius=far[back],
        kind=np.where(there + back, PathKind.GHOST, PathKind.TARGET),
        target=1,
        bounces=there + back,
        points=points,
        faces=[[a - 1, -1, b - 1] for a, b in zip(there, back, strict=True)],
        tx="radar",
        rx="radar",
        epoch=frame.paths[OWN].epoch,
        target_names=("radar", "T"),
    )


def error_of(found: np.ndarray, truth: np.ndarray) -> float:
    """Return the RMS error over the RMS of the truth."""
    return float(np.linalg.norm(found - truth) / np.linalg.norm(truth))
