"""The rows of the synthesis and reception benches: what they must hold, and errors within the stated bounds. Times are not tested."""

from __future__ import annotations

import pytest

from isac_rt.bench import REQUIRED, reception, synthesis
from isac_rt.gridding import ACCURATE_ERROR, GRIDDED_ERROR


def test_errors_of_the_synthesis_are_as_stated():
    found = synthesis.errors()
    assert set(found) == {"direct", synthesis.BOTH, *(name for name, _ in synthesis.GRIDS + synthesis.DIRECTLY)}
    assert found["direct"] < 1e-6
    assert max(found.values()) < 3e-4
    assert found["gridded wideband, 1.5 N, width 6"] < GRIDDED_ERROR
    assert found["gridded narrowband, 1.5 N, width 8"] < 5e-6
    assert found["gridded wideband, cubic, 1.5 N, width 8"] < ACCURATE_ERROR


@pytest.mark.slow
def test_rows_of_the_reception():
    """Both receivers find all four paths to a hundredth of a cell, and need less than three cubes of memory."""
    rows = reception.rows(quick=True)
    assert len(rows) == 2
    for row in rows:
        assert set(REQUIRED) <= set(row)
        assert row["kind"] == "reception"
        assert row["error"] < 0.01
        assert row["memory_cubes"] < 3
