"""Samples of a data set as they are written: a tar file for each scene, as WebDataset reads them,
with a few files for each frame and link.

Files of one sample share a name up to the first dot. Arrays are ``.npy`` without objects, the truth
is ``.json``; nothing in a shard can run code.
"""

from __future__ import annotations

import io
import json
import tarfile
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np

from isac_rt.frame.link import Link
from isac_rt.results.recorder import Results
from isac_rt.sweep.parts import BOXES, FrameParts, npy

COLUMNS = {
    "paths": tuple(
        "power_db delay delay_rate kind target bounces "
        "departure_x departure_y departure_z arrival_x arrival_y arrival_z".split()
    ),
    "detections": ("range", "velocity", "u_x", "u_z", "snr", "kind", "target"),
    "tracks": ("id", "range", "velocity", "u_x", "u_z", "confirmed", "uav"),
    "boxes": BOXES,
}
"""Columns of the tables, float64; names, units and meanings are those of ``results.nc``, of the
boxes those of `isac_rt.sweep.parts.labels`."""
_PREFIX = {"paths": "path", "detections": "det", "tracks": "track"}
TRUTH = ("range", "velocity", "azimuth", "elevation")


def samples_of(
    results: Results, parts: FrameParts, keep: Sequence[str], name: str
) -> Iterator[tuple[str, bytes]]:
    """Names and contents of the files of all frames and links of a scene.

    Parameters
    ----------
    results : of a run whose every frame is a snapshot
    parts : that the run has filled
    keep : what is kept beside the truth
    name : of the scene, before the frame and the link
    """
    d = {str(key): value.values for key, value in results.dataset.variables.items()}
    for f, o in np.argwhere(d["processed"]).tolist():
        link, number = Link(str(d["transmitter"][o]), str(d["receiver"][o])), int(d["frame"][f])
        sample = f"{name}_{number:05d}_{link.tx}_to_{link.rx}"
        yield f"{sample}.json", json.dumps(_truth(d, f, o)).encode()
        own = [(f"{key}.npy", npy(values)) for key, values in _arrays(d, keep, f, o)]
        files = dict(own + parts.files[number, link])  # one of the axes that both have
        yield from ((f"{sample}.{ending}", content) for ending, content in files.items())


def _truth(d: Mapping[str, np.ndarray], f: int, o: int) -> dict[str, Any]:
    """Return the truth of every UAV in a frame on a link."""
    uavs = {
        str(name): {
            "position_m": d["uav_position"][f, u].tolist(),
            "velocity_mps": d["uav_velocity"][f, u].tolist(),
            "in_view": bool(d["in_view"][f, o, u]),
            "occluded": bool(d["occluded"][f, o, u]),
            **{key: _finite(d[f"truth_{key}"][f, o, u]) for key in TRUTH},
        }
        for u, name in enumerate(d["uav"])
    }
    return {
        "time_s": float(d["time"][f]),
        "modulated": bool(d["modulated"][f]),
        "transmitter": str(d["transmitter"][o]),
        "receiver": str(d["receiver"][o]),
        "uavs": uavs,
    }


def _finite(value: float) -> float | None:
    return float(value) if np.isfinite(value) else None


def _arrays(
    d: Mapping[str, np.ndarray], keep: Sequence[str], f: int, o: int
) -> Iterator[tuple[str, np.ndarray]]:
    """Yield the output of the receivers and the ledger of paths, float64 tables by `COLUMNS`."""
    shot = np.flatnonzero(d["snapshot_frame"] == f)
    if "map" in keep and shot.size and np.isfinite(d["map_power"][shot[0], o]).any():
        rows, columns = np.isfinite(d["map_range"][o]), np.isfinite(d["map_velocity"][o])
        yield "map", d["map_power"][shot[0], o][np.ix_(rows, columns)]
        yield "map_range", d["map_range"][o][rows]
        yield "map_velocity", d["map_velocity"][o][columns]
    for table, prefix in _PREFIX.items():
        if table in keep:
            mine = (d[f"{prefix}_frame"] == f) & (d[f"{prefix}_observer"] == o)
            values = [d[f"{prefix}_{name}"][mine] for name in COLUMNS[table]]
            yield table, np.stack(values, axis=1).astype(np.float64)


def tar_of(files: Iterator[tuple[str, bytes]]) -> bytes:
    """A tar file in memory; the same bytes for the same files, whenever and by whom it is made."""
    out = io.BytesIO()
    with tarfile.open(fileobj=out, mode="w", format=tarfile.PAX_FORMAT) as tar:
        for name, content in files:
            info = tarfile.TarInfo(name)
            info.size = len(content)
            tar.addfile(info, io.BytesIO(content))
    return out.getvalue()
