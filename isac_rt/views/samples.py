"""IF samples of a run as files of other programs, written frame by frame.

Files take their names when all frames are there; until then they stand in a hidden folder beside
them.
"""

from __future__ import annotations

import json
import logging
import os
import shutil
import tempfile
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict
from pathlib import Path
from typing import Any, NamedTuple, Protocol

import numpy as np
import yaml

from isac_rt.frame.antennas import Antennas
from isac_rt.frame.boards import Board
from isac_rt.frame.cube import IFCube
from isac_rt.frame.link import Link
from isac_rt.frame.waveform import SPEED_OF_LIGHT
from isac_rt.results.files import check_folder
from isac_rt.runtime import UserError
from isac_rt.simulation.setup import Setup
from isac_rt.storage import StorageError
from isac_rt.views.interchange import write_sigmf

_LOG = logging.getLogger(__name__)
HEADROOM = 4.0
"""Full scale of a converter over the largest sample of the first frame: 12 dB, as front ends have
it by default."""
FULL_SCALE = 2**15 - 1
"""Counts of a converter of 16 bits."""
AXES = "frame", "group", "receiver", "chirp", "sample"


class SampleError(UserError):
    """Samples that a format cannot hold."""


class Recorded(NamedTuple):
    """Samples of one link in one frame, with the antennas of both ends; `name` is of the link."""

    name: str
    frame: int
    cube: IFCube
    antennas: Antennas


class Writer(Protocol):
    """Files of one link, to which frames are added in turn."""

    sample_bytes: int

    def __init__(self, folder: Path, first: Recorded, frames: int) -> None: ...

    def add(self, one: Recorded) -> None:
        """Write a frame."""
        ...

    def close(self) -> None:
        """Write what is known at the end alone."""
        ...


def write_samples(
    setup: Setup,
    frames: Sequence[int],
    links: Sequence[Link],
    form: str,
    folder: str | Path,
    report: Callable[[int, int], None] = lambda done, total: None,
) -> list[Path]:
    """Write IF samples of a run in one of `SAMPLE_FORMATS`, simulated anew; memory holds one frame.

    Parameters
    ----------
    frames : their numbers
    links : a link is left out of frames that it does not receive

    Raises
    ------
    SampleError  If the format cannot hold them.
    isac_rt.storage.StorageError  If the folder cannot be written or has too little room.
    """
    writers: dict[Link, Writer] = {}
    received = {f: setup.timetable.links(f) for f in frames}
    size = 0
    for link in (one for there in received.values() for one in links if one in there):
        w = setup.of(link.tx).waveform
        size += setup.arrays.at(link).num_rx * w.num_groups * w.num_chirps * w.num_samples
    check_folder(folder, size * _WRITERS[form].sample_bytes)
    with staged(Path(folder)) as made:
        for done, number in enumerate(frames):
            report(done, len(frames))
            frame = setup.frame(number)
            for link in (one for one in links if one in received[number]):
                name = str(setup.timetable.labels[link]).replace("->", "_to_")
                one = Recorded(name, number, frame.samples(link), setup.arrays.at(link))
                if link not in writers:
                    count = sum(link in there for there in received.values())
                    writers[link] = _WRITERS[form](made.stage, one, count)
                writers[link].add(one)
        for writer in writers.values():
            writer.close()
        report(len(frames), len(frames))
    return made.files


class Staged:
    """Folder in which files are made, and where they are afterwards."""

    def __init__(self, stage: Path) -> None:
        self.stage = stage
        self.files: list[Path] = []


@contextmanager
def staged(folder: Path) -> Iterator[Staged]:
    """A hidden folder whose files move into `folder` at the end; nothing is left after a fault."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
        made = Staged(Path(tempfile.mkdtemp(prefix=".", dir=folder)))
        try:
            yield made
            for file in sorted(made.stage.iterdir()):
                os.replace(file, folder / file.name)
                made.files.append(folder / file.name)
        finally:
            shutil.rmtree(made.stage, ignore_errors=True)
    except OSError as problem:
        raise StorageError(
            f"cannot write samples into {folder}: {problem.strerror or problem}; choose another "
            "--out, or make room"
        ) from problem


class _Numpy:
    """`LINK.npy`, complex64 over `AXES`, and `LINK.json`: axes, waveform, schedules, times."""

    sample_bytes = 8

    def __init__(self, folder: Path, first: Recorded, frames: int) -> None:
        self._file, self._about = folder / f"{first.name}.npy", folder / f"{first.name}.json"
        shape = frames, *first.cube.samples.shape
        self._made = np.lib.format.open_memmap(self._file, "w+", np.complex64, shape)
        self._waveform, self._rows = first.cube.waveform, list[dict[str, Any]]()

    def add(self, one: Recorded) -> None:
        self._made[len(self._rows)] = one.cube.samples
        schedule, start = np.asarray(one.cube.schedule).tolist(), one.cube.start_time
        self._rows.append({"frame": one.frame, "start_time_s": start, "schedule": schedule})

    def close(self) -> None:
        self._made.flush()
        about = {"axes": AXES, "unit": "sqrt(W)", "waveform": asdict(self._waveform)}
        self._about.write_text(json.dumps(about | {"frames": self._rows}, indent=1) + "\n")


class _Single:
    """Files of their own for each frame: MATLAB or SigMF."""

    sample_bytes = 8

    def __init__(self, folder: Path, first: Recorded, frames: int) -> None:
        self._folder = folder

    def _base(self, one: Recorded) -> Path:
        return self._folder / f"{one.name}_{one.frame:04d}"

    def close(self) -> None:
        """Each frame is whole already."""


class _Mat(_Single):
    """`LINK_FRAME.mat` with `samples` (group, receiver, chirp, sample) [sqrt(W)], `schedule`,
    `start_time_s` and the struct `waveform`."""

    def add(self, one: Recorded) -> None:
        from scipy.io import savemat

        about = {k: np.nan if v is None else v for k, v in asdict(one.cube.waveform).items()}
        content = {
            "samples": one.cube.samples,
            "schedule": np.asarray(one.cube.schedule),
            "start_time_s": one.cube.start_time,
            "waveform": about,
        }
        savemat(self._base(one).with_suffix(".mat"), content, long_field_names=True)


class _Sigmf(_Single):
    """`LINK_FRAME.sigmf-data` and `.sigmf-meta` (`write_sigmf`)."""

    def add(self, one: Recorded) -> None:
        write_sigmf(one.cube, self._base(one))


class _Dca1000:
    """`LINK.bin`, the words of a DCA1000 on two lanes, and `LINK.yaml`, the description with which
    `isac-rt import` reads them back.

    Receivers stand one after the other; of each two samples first both I, then both Q (TI,
    "Mmwave Radar Device ADC Raw Data Capture", SWRA581B, section 24).
    """

    sample_bytes = 4

    def __init__(self, folder: Path, first: Recorded, frames: int) -> None:
        w, schedule = first.cube.waveform, np.asarray(first.cube.schedule)
        if w.sweep is None or len(schedule) > 1:
            raise SampleError(
                f"--as bin: {first.name} is no plain FMCW chirp; a DCA1000 captures those of one "
                "board, so use mode: fmcw, or --as npy, mat_samples or sigmf"
            )
        self._loop = _loop_of(schedule[0])
        if w.num_samples % 2:
            raise SampleError(
                f"--as bin: radio.samples_per_chirp is {w.num_samples}, two lanes deliver an even "
                "number of them"
            )
        self._file, self._about = folder / f"{first.name}.bin", folder / f"{first.name}.yaml"
        parts = np.abs(first.cube.samples.view(np.float32))
        self._scale = FULL_SCALE / (HEADROOM * max(float(parts.max()), 1e-30))
        self._first, self._frames, self._clipped = first, frames, 0
        self._starts: list[float] = []

    def add(self, one: Recorded) -> None:
        if _loop_of(np.asarray(one.cube.schedule)[0]) != self._loop:
            raise SampleError(
                f"--as bin: {one.name} sends in another order in frame {one.frame}; a DCA1000's "
                "frames are alike, so use --as npy, mat_samples or sigmf"
            )
        self._starts.append(one.cube.start_time)
        words, clipped = dca1000_words(one.cube.samples[0], self._scale)
        self._clipped += clipped
        with self._file.open("ab") as file:
            file.write(words.tobytes())

    def close(self) -> None:
        if self._clipped:
            _LOG.warning("%s: %d samples clipped at full scale", self._file.name, self._clipped)
        w, antennas = self._first.cube.waveform, self._first.antennas
        assert w.sweep is not None
        half = SPEED_OF_LIGHT / w.carrier_frequency / 2
        used = sorted(set(self._loop))
        board = Board(
            start_hz=w.carrier_frequency,
            slope=w.sweep.slope,
            idle=w.sweep.repetition - w.sweep.ramp_end,
            adc_start=w.sweep.adc_start,
            ramp_end=w.sweep.ramp_end,
            samples=w.num_samples,
            rate=w.sampling_rate,
            receivers=antennas.num_rx,
            chirps=tuple(self._loop),
            loops=w.num_chirps // len(self._loop),
            frames=self._frames,
            period=float(np.diff(self._starts).mean()) if self._frames > 1 else 0.0,
            sampling="complex_1x",
        )
        about = {"format": "dca1000"} | board.description()
        about["elements"] = {
            "unit_hz": w.carrier_frequency,
            "transmitters": (antennas.tx_positions[used][:, [0, 2]] / half).tolist(),
            "receivers": (antennas.rx_positions[:, [0, 2]] / half).tolist(),
        }
        note = f"# 1 count is {1 / self._scale:.9g} sqrt(W)\n"
        self._about.write_text(note + yaml.safe_dump(about, sort_keys=False))


def _loop_of(schedule: np.ndarray) -> list[int]:
    """Shortest order of transmitters whose repetition is a schedule (P,)."""
    for size in range(1, len(schedule) + 1):
        if len(schedule) % size == 0 and (schedule.reshape(-1, size) == schedule[:size]).all():
            break
    return [int(k) for k in schedule[:size]]


def dca1000_words(samples: np.ndarray, scale: float) -> tuple[np.ndarray, int]:
    """Words (int16) of samples (receivers, chirps, N) in counts of `scale` per unit, and how many
    parts were beyond full scale."""
    by_chirp = np.ascontiguousarray(samples.transpose(1, 0, 2))
    counts = np.rint(scale * np.stack([by_chirp.real, by_chirp.imag], axis=-1).astype(np.float64))
    clipped = int((np.abs(counts) > FULL_SCALE).sum())
    words = np.clip(counts, -FULL_SCALE, FULL_SCALE).astype("<i2")
    pairs = words.reshape(*words.shape[:2], -1, 2, 2)  # of two samples both I, then both Q
    return np.swapaxes(pairs, -1, -2).ravel(), clipped


_WRITERS: dict[str, type[Writer]] = {
    "npy": _Numpy,
    "mat_samples": _Mat,
    "bin": _Dca1000,
    "sigmf": _Sigmf,
}
SAMPLE_FORMATS = tuple(_WRITERS)
