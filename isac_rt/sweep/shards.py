"""The samples of a data set on disk: a tar file for each scene, as WebDataset reads them, with a
few files for each frame and link; and the reading of them.

Files of one sample share a name up to the first dot. Arrays are ``.npy`` without objects, the truth
is ``.json``; nothing in a shard can run code.
"""

from __future__ import annotations

import bisect
import io
import json
import tarfile
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from tokenize import TokenError
from typing import Any, NamedTuple

import numpy as np
import xarray as xr

from isac_rt.frame.link import Link
from isac_rt.results.files import ResultsError
from isac_rt.results.recorder import Results
from isac_rt.runtime import shortly
from isac_rt.simulation.setup import Setup
from isac_rt.storage import BAD_DATA, MOST_JSON_BYTES, read_whole

COLUMNS = {
    "paths": (
        "power_db",
        "delay",
        "delay_rate",
        "kind",
        "target",
        "bounces",
        "departure_x",
        "departure_y",
        "departure_z",
        "arrival_x",
        "arrival_y",
        "arrival_z",
    ),
    "detections": ("range", "velocity", "u_x", "u_z", "snr", "kind", "target"),
    "tracks": ("id", "range", "velocity", "u_x", "u_z", "confirmed", "uav"),
}
"""Columns of the tables, float64; names, units and meanings are those of ``results.nc``."""
_PREFIX = {"paths": "path", "detections": "det", "tracks": "track"}
TRUTH = ("range", "velocity", "azimuth", "elevation")
CARD = "card.json"


def samples_of(
    results: Results, setup: Setup, keep: Sequence[str], name: str
) -> Iterator[tuple[str, bytes]]:
    """Names and contents of the files of all frames and links of a scene.

    Parameters
    ----------
    results : of a run whose every frame is a snapshot
    keep : what is kept beside the truth
    name : of the scene, before the frame and the link
    """
    d = results.dataset
    for f, o in np.argwhere(d.processed.values).tolist():
        link = Link(str(d.transmitter.values[o]), str(d.receiver.values[o]))
        sample = f"{name}_{int(d.frame.values[f]):05d}_{link.tx}_to_{link.rx}"
        yield f"{sample}.json", json.dumps(_truth(d, f, o)).encode()
        for key, values in _arrays(d, setup, keep, f, o, link):
            yield f"{sample}.{key}.npy", _npy(values)


def _truth(d: xr.Dataset, f: int, o: int) -> dict[str, Any]:
    """Return the truth of every UAV in a frame on a link, and the axes of its map."""
    seen = d.isel(frame=f, observer=o)
    own = d.transmitter.values[o], d.receiver.values[o]
    uavs = {
        str(name): {
            "position_m": d.uav_position.values[f, u].tolist(),
            "velocity_mps": d.uav_velocity.values[f, u].tolist(),
            "in_view": bool(seen.in_view.values[u]),
            "shadowed": bool(seen.shadowed.values[u]),
            **{key: _finite(seen[f"truth_{key}"].values[u]) for key in TRUTH},
        }
        for u, name in enumerate(d.uav.values)
    }
    return {
        "time_s": float(d.time.values[f]),
        "modulated": bool(d.modulated.values[f]),
        "transmitter": str(own[0]),
        "receiver": str(own[1]),
        "uavs": uavs,
    }


def _finite(value: float) -> float | None:
    return float(value) if np.isfinite(value) else None


def _arrays(
    d: xr.Dataset, setup: Setup, keep: Sequence[str], f: int, o: int, link: Link
) -> Iterator[tuple[str, np.ndarray]]:
    number = int(d.frame.values[f])
    shot = np.flatnonzero(d.snapshot_frame.values == f)
    if "map" in keep and shot.size and np.isfinite(d.map_power.values[shot[0], o]).any():
        rows, columns = np.isfinite(d.map_range.values[o]), np.isfinite(d.map_velocity.values[o])
        yield "map", d.map_power.values[shot[0], o][np.ix_(rows, columns)]
        yield "map_range", d.map_range.values[o][rows]
        yield "map_velocity", d.map_velocity.values[o][columns]
    for table in (name for name in COLUMNS if name in keep):
        prefix = _PREFIX[table]
        mine = (d[f"{prefix}_frame"].values == f) & (d[f"{prefix}_observer"].values == o)
        values = [d[f"{prefix}_{name}"].values[mine] for name in COLUMNS[table]]
        yield table, np.stack(values, axis=1).astype(np.float64)
    if "samples" in keep or "bits" in keep:
        frame = setup.frame(number)
        if "bits" in keep:
            yield "bits", frame.sent[link.tx].payload.bits
        if "samples" in keep:
            yield "samples", frame.samples(link).samples


def _npy(values: np.ndarray) -> bytes:
    out = io.BytesIO()
    np.save(out, np.ascontiguousarray(values), allow_pickle=False)
    return out.getvalue()


def tar_of(files: Iterator[tuple[str, bytes]]) -> bytes:
    """A tar file in memory; the same bytes for the same files, whenever and by whom it is made."""
    out = io.BytesIO()
    with tarfile.open(fileobj=out, mode="w", format=tarfile.PAX_FORMAT) as tar:
        for name, content in files:
            info = tarfile.TarInfo(name)
            info.size = len(content)
            tar.addfile(info, io.BytesIO(content))
    return out.getvalue()


class Samples:
    """The samples of a split, by number: what PyTorch's `DataLoader` takes as a data set.

    Parameters
    ----------
    folder : of a data set
    split : its name
    keep : arrays that are read; None: all

    Raises
    ------
    ResultsError  If it is the folder of no finished data set, has no such split, or a shard cannot
        be read.
    """

    def __init__(self, folder: str | Path, split: str, keep: Sequence[str] | None = None) -> None:
        self.folder, self.keep = Path(folder), keep
        card = read_card(self.folder)
        if split not in card["splits"]:
            raise ResultsError(
                f"{folder} has no split {split}; there are {', '.join(card['splits'])}"
            )
        shards: Mapping[str, int] = card["splits"][split]
        self._shards, self._ends = [*shards], np.cumsum([*shards.values()], dtype=int).tolist()
        self._indices: dict[str, Index] = {}

    def __len__(self) -> int:
        return self._ends[-1] if self._ends else 0

    def __getitem__(self, number: int) -> dict[str, Any]:
        """Its name, its truth, and its arrays by name."""
        if not 0 <= number < len(self):
            raise IndexError(f"sample {number} of {len(self)}")
        k = bisect.bisect_right(self._ends, number)
        within = number - (self._ends[k - 1] if k else 0)
        name = self._shards[k]
        if name not in self._indices:
            self._indices[name] = index_of(self.folder / name)
        return read_sample(self.folder / name, self._indices[name], within, self.keep)


def read_card(folder: Path) -> dict[str, Any]:
    """Read the card of a finished data set.

    Raises
    ------
    ResultsError  If it is the folder of none.
    """
    try:
        card = json.loads(read_whole(folder / CARD, MOST_JSON_BYTES))
        for name, count in (item for shards in card["splits"].values() for item in shards.items()):
            if type(count) is not int or count < 0 or ".." in name or Path(name).is_absolute():
                raise ValueError(f"the shard {name[:80]} cannot be")
    except (OSError, *BAD_DATA) as problem:
        raise ResultsError(
            f"{folder} holds no finished data set ({shortly(problem)}); give the folder that "
            "`isac-rt dataset` wrote"
        ) from problem
    return dict(card)


class _File(NamedTuple):
    """A file of a shard: its name after the first dot, and where its bytes are."""

    ending: str
    start: int
    size: int


Index = dict[str, list[_File]]
"""The files of each sample of a shard, by its name."""
_UNREADABLE = (
    OSError,
    EOFError,
    MemoryError,
    SyntaxError,
    TokenError,
    tarfile.TarError,
    *BAD_DATA,
)


def index_of(shard: Path) -> Index:
    """Index the contents of a shard from the headers of its files.

    Raises
    ------
    ResultsError  If it cannot be read.
    """
    found: Index = {}
    try:
        with tarfile.open(shard, "r:") as tar:  # not packed: what is read is as large as the file
            for member in tar:
                if member.issparse():
                    raise ValueError("a file in it has holes")
                stem, _, ending = member.name.partition(".")
                files = found.setdefault(stem, [])
                if member.isreg():
                    files.append(_File(ending, member.offset_data, member.size))
    except _UNREADABLE as problem:
        raise _unreadable(shard, problem) from problem
    return found


def read_sample(
    shard: Path, index: Index, number: int, keep: Sequence[str] | None = None
) -> dict[str, Any]:
    """A sample of a shard: `key`, `truth`, and the arrays by name.

    Raises
    ------
    ResultsError  If it cannot be read.
    """
    try:
        key = [*index][number]
        out: dict[str, Any] = {"key": key}
        with shard.open("rb") as opened:
            for ending, start, size in index[key]:
                name = ending.removesuffix(".npy")
                if ending != "json" and keep is not None and name not in keep:
                    continue
                opened.seek(start)
                content = opened.read(size)
                if len(content) < size:
                    raise EOFError(f"{ending} ends early")
                if ending == "json":
                    out["truth"] = json.loads(content)
                    continue
                out[name] = np.load(io.BytesIO(content), allow_pickle=False)
                if not isinstance(out[name], np.ndarray):
                    raise ValueError(f"{ending} is no array")
    except _UNREADABLE as problem:
        raise _unreadable(shard, problem) from problem
    return out


def _unreadable(shard: Path, problem: BaseException) -> ResultsError:
    return ResultsError(f"{shard} cannot be read ({shortly(problem)}); make the data set again")
