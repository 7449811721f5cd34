"""Captures: what one terminal is given in successive frames, in one file.

``python captures.py CAPTURE.npz OUT.npz`` runs a terminal on it alone: one that gives the same bits
there as in a run has used nothing else.
"""

from __future__ import annotations

import json
import sys
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from isac_rt.frame.antennas import Antennas
from isac_rt.frame.cube import IFCube
from isac_rt.frame.payload import Payload
from isac_rt.frame.waveform import Waveform
from isac_rt.receive.settings import Receivers
from isac_rt.receive.types import Reception
from isac_rt.track.settings import Tracking
from isac_rt.track.terminal import ActiveTerminal, PassiveTerminal
from isac_rt.track.tracker import TrackSet
from isac_rt.world.swarm import Pose

POSE = ("position", "velocity", "acceleration", "rotation")
PAYLOAD = ("bits", "delay_symbols", "transitions", "phases")


class Step(NamedTuple):
    """What a terminal is given in one frame; the payload is the active terminal's own."""

    cube: IFCube
    own: Pose
    time: float
    modulated: bool
    payload: Payload | None = None


def save_capture(
    path: Path | str,
    steps: list[Step],
    antennas: Antennas,
    receivers: Receivers,
    tracking: Tracking,
    dpsk_order: int = 8,
    transmit_amplitude: float = 1.0,
) -> None:
    """Samples and public parameters of successive frames of one terminal in one .npz file."""
    public = {
        "waveform": asdict(steps[0].cube.waveform),
        "antennas": asdict(antennas),
        "receivers": receivers.model_dump(mode="json"),
        "tracking": tracking.model_dump(mode="json"),
        "dpsk_order": dpsk_order,
        "transmit_amplitude": transmit_amplitude,
    }
    arrays: dict[str, Any] = {"schedule": steps[0].cube.schedule}
    for i, s in enumerate(steps):
        arrays |= {
            f"{i}/samples": s.cube.samples,
            f"{i}/times": np.array([s.cube.start_time, s.time]),
            f"{i}/modulated": s.modulated,
        }
        arrays |= {f"{i}/own_{name}": getattr(s.own, name) for name in POSE}
        if s.payload is not None:
            arrays |= {f"{i}/sent_{name}": getattr(s.payload, name) for name in PAYLOAD}
    np.savez(path, public=np.array(json.dumps(public)), **arrays)


def replay(path: Path | str) -> dict[str, Any]:
    """Run a terminal on a capture alone: detections, symbols, bits and tracks of every frame, as
    flat named arrays."""
    with np.load(path) as file:
        data = {name: file[name] for name in file.files}
    public = json.loads(str(data["public"]))
    w = Waveform(**public["waveform"])
    if w.checked is not None:  # JSON knows no tuples
        w = replace(w, checked=tuple(map(tuple, w.checked)))
    known = (
        w,
        Antennas(**public["antennas"]),
        Receivers.model_validate(public["receivers"]),
        Tracking.model_validate(public["tracking"]),
    )
    active = ActiveTerminal(*known)
    passive = PassiveTerminal(*known, public["dpsk_order"], public["transmit_amplitude"])
    out: dict[str, np.ndarray] = {}
    for i in range(sum(name.endswith("/samples") for name in data)):
        start, time = data[f"{i}/times"].tolist()
        cube = IFCube(
            samples=data[f"{i}/samples"], waveform=w, schedule=data["schedule"], start_time=start
        )
        own = Pose(*(data[f"{i}/own_{name}"] for name in POSE))
        if f"{i}/sent_bits" in data:
            payload = Payload(*(data[f"{i}/sent_{name}"] for name in PAYLOAD))
            outcome = active.step(cube, payload, own, time)
        else:
            outcome = passive.step(cube, own, time, bool(data[f"{i}/modulated"]))
        out |= flat(i, *outcome)
    return out


def flat(frame: int, reception: Reception, tracks: TrackSet) -> dict[str, np.ndarray]:
    """One frame's outcome as named arrays, for comparing runs bit by bit."""
    d, names = reception.detections, ("delay_symbols", "transitions", "bits", "delay_confidence")
    out = {f"{frame}/{name}": np.asarray(getattr(reception, name)) for name in names}
    out |= {f"{frame}/det_{name}": np.asarray(value) for name, value in vars(d).items()}
    return out | {
        f"{frame}/track_{name}": np.asarray(value) for name, value in vars(tracks).items()
    }


if __name__ == "__main__":
    np.savez(sys.argv[2], **replay(sys.argv[1]))
