"""What frames leave behind lies on the disk, not in memory."""

from __future__ import annotations

import gc
import tracemalloc
from pathlib import Path

import numpy as np
import pytest
from fake_run import fake_recorder, fake_records, fake_scenario

import isac_rt as irt
from isac_rt.results import spool
from isac_rt.results.spool import Spool, Table

SCENES = Path(__file__).parents[2] / "scenes"
ROW = np.dtype([("x", float, (3,)), ("n", np.int16)])


def some(count, seed):
    out = np.zeros(count, ROW)
    out["x"] = np.random.default_rng(seed).normal(size=(count, 3))
    out["n"] = seed
    return out


@pytest.mark.parametrize("room", [0, 100, 10**6])
def test_rows_come_back_as_they_were(tmp_path, monkeypatch, room):
    """Two tables in one file, frames without rows, one changed, whatever of it the disk has room
    for; no file is seen. Planted bugs: a part of a row taken for all of it; the frames before a
    table begins left out; a changed row written over the next one."""
    write = spool.os.pwrite
    monkeypatch.setattr(
        spool.os, "pwrite", lambda file, data, at: write(file, data[: max(room - at, 0)], at)
    )
    keeps = Spool(tmp_path)
    one, two = Table(ROW, keeps), Table(ROW, keeps, 2)
    counts = [2, 0, 3, 1]
    for i, count in enumerate(counts):
        one.append(some(count, i))
        two.append(some(4 - count, 10 + i))
    one[2] = changed = some(3, 77)
    expected = [some(2, 0), some(0, 1), changed, some(1, 3)]
    assert np.array_equal(one.whole(), np.concatenate(expected))
    assert np.array_equal(
        two.whole(), np.concatenate([some(4 - c, 10 + i) for i, c in enumerate(counts)])
    )
    assert all(np.array_equal(one[i], rows) for i, rows in enumerate(expected))
    assert one.frames().tolist() == [0, 0, 2, 2, 2, 3]
    assert two.frames().tolist() == [2, 2, 3, 3, 3, 3, 4, 5, 5, 5]
    assert list(tmp_path.iterdir()) == []
    with pytest.raises(TypeError, match="rows of"):
        one.append(np.zeros(1))


def test_a_folder_that_cannot_be_written_is_done_without(tmp_path):
    table = Table(ROW, Spool(tmp_path / "none"))
    table.append(some(2, 5))
    assert np.array_equal(table.whole(), some(2, 5))


def test_memory_does_not_grow_with_the_frames():
    """Places and counts of eight tables: 16 bytes each and frame, and the spare room of growing
    arrays. Planted bug: frames kept in a list (24 kB each)."""
    recorder, record = fake_recorder(fake_scenario()), fake_records(fake_scenario())[1]
    tracemalloc.start()
    try:
        held = []
        for _ in range(2):
            for _ in range(200):
                recorder.add(record)
            gc.collect()
            held.append(tracemalloc.get_traced_memory()[0])
    finally:
        tracemalloc.stop()
    assert len(recorder) == 400 and (held[1] - held[0]) / 200 < 500


@pytest.mark.slow
def test_memory_of_a_run_does_not_grow_with_the_frames():
    """A whole run with two sets of receivers, between its 40th frame and its 120th. What comes and
    goes with a frame is 1 MB; 100 kB a frame while rows were kept."""
    small = ["radio.samples_per_chirp=256", "radio.chirps_per_frame=48", "frame_interval_s=0.0051"]
    compare = ["cooperation=tracks", "compare={pilots: {receivers: {link_acquisition: pilots}}}"]
    scenario = irt.load(SCENES / "paper_swarm_consistent.yaml", small + compare, frames=120)
    held = []

    def progress(done: int, _: int) -> None:
        if done in (40, 120):
            gc.collect()
            held.append(tracemalloc.get_traced_memory()[0])

    tracemalloc.start()
    try:
        irt.run(scenario, progress=progress, snapshots=1, threads=1)
    finally:
        tracemalloc.stop()
    assert (held[1] - held[0]) / 80 < 25e3
