"""The rows of the synthesis and reception benches: what they must hold, and errors within the
stated bounds. Times are not tested."""

from __future__ import annotations

import importlib.util
import json
import os

import pytest

from benchmarks import REQUIRED, datasets, endtoend, hermes, moving, nufft, reception, synthesis
from isac_rt.cli.cli import main
from isac_rt.kernels.signal_gridded import GRIDDED_ERROR


def test_errors_of_the_synthesis_are_as_stated():
    """Each method's by its bound; that of what noise covers is 8.7e-3 at the 15 m/s of the fastest
    path."""
    found = synthesis.errors()
    assert set(found) == {
        "direct",
        synthesis.BOTH,
        *(name for name, _ in synthesis.GRIDS),
        *([] if nufft.missing() else [nufft.NAME]),
    }
    assert found["direct"] < 1e-6
    covered = found.pop("gridded, of what noise covers")
    assert max(found.values()) < GRIDDED_ERROR < covered < 8.7e-3


@pytest.mark.slow
def test_rows_of_the_reception():
    """Both receivers find all four paths to a hundredth of a cell, by joint refinement and by
    pursuit too, and need less than three cubes of memory, a joint fit's transform one and a half
    more."""
    rows = reception.rows(quick=True)
    assert len(rows) == 6
    for row in rows:
        assert set(REQUIRED) <= set(row)
        assert row["kind"] == "reception"
        assert row["error"] < 0.01
        assert row["memory_cubes"] < (5 if "joint" in row["method"] else 3)


@pytest.mark.slow
@pytest.mark.sionna
def test_rows_of_data_sets():
    """The bytes of a sample by the sizes of what is kept: a map of 512 ranges and velocities of an
    echo, IF samples of 3 groups, 15 receivers, 120 chirps and 1024 samples. Planted bug: bytes of
    the whole shard."""
    rows = {row["method"]: row for row in datasets.rows(quick=True)}
    assert len(rows) == 7
    for row in rows.values():
        assert set(REQUIRED) <= set(row) and row["size"] == 8 and row["seconds"] > 0
    for end in ("read", "written"):
        said = str(rows[f"{end}: all with the IF samples"]["also"])
        size = float(said.split(", ")[-1].split()[0].replace(",", ""))
        assert 3 * 15 * 120 * 1024 * 8 / 1e3 < size < 3 * 15 * 120 * 1024 * 8 / 1e3 + 700


def test_rows_of_a_pedestrian():
    """At 0.05 % beside the exact model, which costs a hundred times as much. Planted bugs: a
    `PHASE_ERROR` of 0.1; the exact model's cost of some chirps for that of all."""
    ours, exact = moving.rows(quick=True)
    assert all(set(REQUIRED) <= set(row) for row in (ours, exact))
    assert (ours["size"], exact["error"], exact["oracle"]) == (128, 0.0, True)
    assert 0 < ours["error"] < 5e-4 and not ours["oracle"]
    assert exact["cost"] > 50 * ours["cost"]


def test_hermespy_is_left_out_where_it_is_not_installed(tmp_path, monkeypatch, capsys):
    """One message with the remedy, and the command is done. Planted bug: `missing` that looks at
    the variable alone."""
    monkeypatch.delenv(hermes.INTERPRETER, raising=False)
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    assert "HermesPy is not installed; set ISAC_RT_HERMESPY to" in (hermes.missing() or "")
    monkeypatch.setenv(hermes.INTERPRETER, str(tmp_path / "no-such-python"))
    assert "no-such-python is no program" in (hermes.missing() or "")
    monkeypatch.undo()
    monkeypatch.setenv(hermes.INTERPRETER, str(tmp_path / "no-such-python"))
    assert main(["bench", "hermespy", "--quick", "--out", str(tmp_path / "out")]) == 0
    assert capsys.readouterr().out.count("hermespy left out: ISAC_RT_HERMESPY=") == 1
    assert json.loads((tmp_path / "out" / "bench.json").read_text())["rows"] == []


def test_finufft_is_left_out_where_it_is_not_installed(monkeypatch):
    """With the remedy. Planted bug: `left_out` empty."""
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    assert "pip install isac_rt[bench]" in synthesis.left_out()["finufft"]
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: True)
    assert synthesis.left_out() == {}


def _pretender(folder, lines: str):
    """A program in the place of an interpreter with HermesPy."""
    file = folder / "pretender"
    file.write_text(f"#!/bin/sh\n{lines}\n")
    file.chmod(0o755)
    return str(file)


def test_rows_beside_hermespy(tmp_path, monkeypatch):
    """Arithmetic of the rows, with an answer that is made up: 3.5 CPU s for 20 paths of 120 x 1024
    x 15 samples. Our error on the job is as stated. Planted bug: samples counted at one antenna."""
    answer = {
        "seconds": {"20": 3.5, "60": 10.1},
        "error": 0.8,
        "versions": {"hermespy": "0", "python": "3", "numpy": "2"},
    }
    monkeypatch.setenv(
        hermes.INTERPRETER, _pretender(tmp_path, f"echo noise; echo '{json.dumps(answer)}'")
    )
    rows = hermes.rows(quick=True)
    theirs, ours = (
        [r for r in rows if "HermesPy" in r["method"]],
        [r for r in rows if r["method"] in hermes.OURS],
    )
    assert [r["size"] for r in theirs] == [20, 60]
    assert theirs[0]["per_path_and_sample_s"] == pytest.approx(
        3.5 / (20 * 120 * 1024 * 15), rel=1e-12, abs=0
    )
    assert len(ours) == 2 * len(hermes.OURS)
    assert all(set(REQUIRED) <= set(row) for row in rows)
    assert all(row["error"] < 3e-4 < theirs[0]["error"] for row in ours)
    monkeypatch.setenv(
        hermes.INTERPRETER, _pretender(tmp_path, "echo ModuleNotFoundError >&2; exit 3")
    )
    with pytest.raises(RuntimeError, match="ended with 3 and said: ModuleNotFoundError"):
        hermes.measured({})


@pytest.mark.slow
@pytest.mark.skipif(
    os.environ.get(hermes.INTERPRETER) is None,
    reason=f"needs HermesPy: {hermes.INTERPRETER} names no Python",
)
def test_hermespy_floors_its_delays():
    """A shift by a fraction f of a sample turns a sample at the part t of the sweep by pi f (1 - 2
    t): RMS^2 = 2 - 2 Re mean exp(j ...) over f from 0 to 1 and t from 0.2 to 1, 0.805^2; for 40
    paths within a tenth. Cost is linear in the paths (a quarter for the machine). Planted bug: the
    truth with delays in whole samples (error 0)."""
    job = {
        "bandwidth_hz": 1e9,
        "carrier_hz": 77e9,
        "num_samples": 1024,
        "num_chirps": 30,
        "num_rx": 15,
        "sizes": [20, 80],
        "error_paths": 40,
        "seed": 3,
    }
    found = hermes.measured(job)
    assert found["error"] == pytest.approx(0.805, rel=0.1)
    assert found["seconds"]["80"] == pytest.approx(4 * found["seconds"]["20"], rel=0.25)


@pytest.mark.slow
@pytest.mark.sionna
def test_denser_clutter_is_nearer_the_densest():
    """Errors fall with the stated one and stay within twice of it; scatterers grow. Planted bugs:
    the truth of another link; scatterers under noise merged, which keep the error of range-Doppler
    cells alone (0.46 dB at 0.2 dB)."""
    rows = endtoend.densities(True, 1.0)
    errors, sizes = ([row[key] for row in rows] for key in ("error", "size"))
    assert errors == sorted(errors, reverse=True) and sizes == sorted(sizes)
    stated = [*endtoend.ERRORS_DB, endtoend.TRUTH_DB]
    assert all(error < 2 * db for error, db in zip(errors, stated, strict=True))
