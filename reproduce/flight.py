"""The flight of Table II, as printed and made consistent: who is in whose view, and the flight as
the receivers saw it.

Figs. 9 and 10 and Table II share it. The consistent variant turns PT2 to fly along +y and PT1 to
face -y.
"""

from __future__ import annotations

import numpy as np
import xarray as xr

from isac_rt.frame.antennas import Antennas, antennas_of
from isac_rt.frame.waveform import waveform_of
from isac_rt.scenario.file import load
from isac_rt.scenario.tree import Scenario
from isac_rt.simulation import simulate
from isac_rt.simulation.setup import swarm_of
from isac_rt.world.swarm import Pose
from reproduce import SCENES
from reproduce.outcome import Progress

VARIANTS = {"printed": "paper_swarm.yaml", "consistent": "paper_swarm_consistent.yaml"}
UAVS = ("AT", "PT1", "PT2")


def scenario(variant: str, seed: int | None = None, overrides: tuple[str, ...] = ()) -> Scenario:
    """The scene of a variant in `VARIANTS`."""
    return load(SCENES / VARIANTS[variant], overrides, None, seed)


def views(scene: Scenario) -> dict[tuple[str, str], np.ndarray]:
    """Whether each UAV has each other in its own field of view, frame by frame, from the poses
    alone: {(who, whom): (frames,)}."""
    w = waveform_of(scene.radio, scene.array)
    antennas, swarm = antennas_of(scene.array, w), swarm_of(scene)
    poses = [swarm.poses((k + 0.5) * w.frame_duration) for k in range(scene.frames)]
    pairs = [(a, b) for a in UAVS for b in UAVS if a != b]
    return {(a, b): np.array([sees(antennas, p[a], p[b]) for p in poses]) for a, b in pairs}


def sees(antennas: Antennas, who: Pose, whom: Pose) -> bool:
    """Whether `whom` is inside the field of view of `who`."""
    offset = whom.position - who.position
    return bool(antennas.in_view(who.to_body(offset / np.linalg.norm(offset))))


def span(seen: np.ndarray) -> str:
    """Frames in view as text: "133 to 499", "never", or several spans."""
    edges = np.flatnonzero(np.diff(np.concatenate([[0], seen.astype(int), [0]])))
    return (
        ", ".join(f"{a} to {b - 1}" for a, b in zip(edges[::2], edges[1::2], strict=True))
        or "never"
    )


def closing_speed(scene: Scenario, who: str, whom: str) -> tuple[float, float]:
    """Smallest and largest |radial velocity| between two UAVs over the frames [m/s]."""
    w, swarm = waveform_of(scene.radio, scene.array), swarm_of(scene)
    rates = []
    for k in range(scene.frames):
        p = swarm.poses((k + 0.5) * w.frame_duration)
        offset, moving = p[whom].position - p[who].position, p[whom].velocity - p[who].velocity
        rates.append(abs(float(offset @ moving) / float(np.linalg.norm(offset))))
    return min(rates), max(rates)


def fly(
    variant: str, observer: str, frames: int, every: int, seed: int, progress: Progress
) -> xr.Dataset:
    """One observer's part of the results over `frames` frames, `every` frames apart: the same
    instants as in contiguous frames.

    The other passive terminal is only a target, so that its own receiver costs nothing; the AT
    processes each frame for itself, or none.
    """
    scene = scenario(variant)
    interval = every * waveform_of(scene.radio, scene.array).frame_duration
    own = observer == "AT"
    changes = [
        f"frame_interval_s={interval!r}",
        f"frames={frames}",
        f"receivers.active_every_frames={1 if own else frames}",
    ]
    scene = scenario(variant, seed, (*changes, "swarm.PT2.role=target"))
    return simulate.run(scene, progress=progress).dataset.sel(observer=observer)


def errors(part: xr.Dataset, uav: str, quantity: str) -> tuple[np.ndarray, np.ndarray]:
    """Absolute errors (n,) of the detected and of the tracked value, where there are both; m, m/s
    or degrees."""
    one = part.sel(uav=uav)
    scale = 180 / np.pi if quantity == "azimuth" else 1.0
    raw, fused = (
        np.abs((one[f"{group}_{quantity}"] - one[f"truth_{quantity}"]).values) * scale
        for group in ("detected", "tracked")
    )
    both = np.isfinite(raw) & np.isfinite(fused)
    return raw[both], fused[both]
