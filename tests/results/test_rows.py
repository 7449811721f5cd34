"""What frames leave behind: rows, and no more memory than their numbers take."""

from __future__ import annotations

import gc
import tracemalloc
from pathlib import Path

import numpy as np
import pytest
from fake_run import fake_recorder, fake_records, fake_scenario

import isac_rt as irt
from isac_rt.results.dataset import row_of
from isac_rt.results.rows import Table

SCENES = Path(__file__).parents[2] / "scenes"
ROW = np.dtype([("x", float, (3,)), ("n", np.int16)])


def some(count, seed):
    out = np.zeros(count, ROW)
    out["x"] = np.random.default_rng(seed).normal(size=(count, 3))
    out["n"] = seed
    return out


def test_rows_come_back_as_they_were():
    """Two tables, frames without rows, one changed. Planted bugs: the frames before a table begins
    left out; a row kept without a copy; rows of another type taken."""
    one, two = Table(ROW), Table(ROW, 2)
    counts = [2, 0, 3, 1]
    for i, count in enumerate(counts):
        one.append(some(count, i))
        two.append(some(4 - count, 10 + i))
    changed = some(3, 77)
    one[2] = changed
    expected = [some(2, 0), some(0, 1), some(3, 77), some(1, 3)]
    changed["n"] = 5
    one[0]["n"] = 5
    assert np.array_equal(one.whole(), np.concatenate(expected))
    assert np.array_equal(
        two.whole(), np.concatenate([some(4 - c, 10 + i) for i, c in enumerate(counts)])
    )
    assert all(np.array_equal(one[i], rows) for i, rows in enumerate(expected))
    assert one.frames().tolist() == [0, 0, 2, 2, 2, 3]
    assert two.frames().tolist() == [2, 2, 3, 3, 3, 3, 4, 5, 5, 5]
    with pytest.raises(TypeError, match="rows of"):
        one.append(np.zeros(1))


def test_a_frame_takes_the_bytes_of_its_rows():
    """Twelve arrays a frame beside their numbers, 150 bytes each. Planted bug: the records
    themselves kept in a list (24 kB a frame)."""
    recorder, record = fake_recorder(fake_scenario()), fake_records(fake_scenario())[1]
    row = row_of(record)
    kinds = [kind for kind in row if kind in recorder.tables]
    size = sum(rows.nbytes for kind in kinds for rows in row[kind].values())
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
    assert len(recorder) == 400 and (held[1] - held[0]) / 200 < size + 12 * 150


@pytest.mark.slow
def test_memory_of_a_run_grows_by_its_rows():
    """A whole run with two sets of receivers, between its 40th frame and its 120th: less
    than 25 kB a frame. What comes and goes with a frame is 1 MB."""
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
