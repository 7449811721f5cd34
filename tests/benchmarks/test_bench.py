"""How cost grows, never how long anything takes; and that the report says what was measured."""

from __future__ import annotations

import json
import subprocess
import sys

import numpy as np
import pytest

from benchmarks import REQUIRED, command, report
from benchmarks.measure import cpu_seconds, floor_seconds
from isac_rt.cli.cli import main
from isac_rt.simulation.plan import faintest

# measured exponents scatter by 0.1 to 0.2 on a busy machine; n log n is 1.1 here, n^2 would be 2
LINEAR = 1.3


def test_an_exponent_is_found_from_its_own_curve():
    """Planted bug: sizes and costs exchanged."""
    sizes = np.array([3, 10, 70, 400])
    assert report.exponent(sizes, 0.3 * sizes**1.7) == pytest.approx(1.7, rel=1e-9)


def test_the_report_holds_every_row(tmp_path):
    """Tables, figures and JSON of rows that are made up. Planted bug: rows of the first kind
    only."""
    rows = [
        {
            "kind": kind,
            "method": method,
            "size": size,
            "unit": "paths",
            "error": error,
            "cost": size * cost,
            "floor_s": 0.04,
            "seconds": size * cost * 0.04,
            "oracle": error == 0,
        }
        for kind in ("synthesis", "tracing")
        for method, cost, error in (("slow", 0.1, 0.0), ("quick", 0.01, 3e-4))
        for size in (10, 100)
    ]
    assert all(set(REQUIRED) <= set(row) for row in rows)
    found = {
        "machine": report.machine(),
        "quick": True,
        "rows": rows,
        "growth": report.growth(rows),
    }
    files = report.write(found, tmp_path)
    assert {file.name for file in files} == {
        "bench.json",
        "bench.md",
        "synthesis.png",
        "tracing.png",
    }
    assert all(file.stat().st_size > 0 for file in files)
    assert json.loads((tmp_path / "bench.json").read_text())["rows"] == rows
    text = (tmp_path / "bench.md").read_text()
    assert text.count("\n| quick |") + text.count("\n| slow |") == 8
    assert all(row["exponent"] == 1.0 for row in found["growth"])
    assert found["machine"]["processor"] in text


def test_the_floor_grows_with_the_cube():
    """Planted bug: a floor of a fixed shape."""
    assert floor_seconds((3, 4, 30, 1024), 3) < floor_seconds((3, 4, 240, 1024), 3)


def test_leaving_out_the_faintest_grows_no_faster_than_sorting():
    """Planted bug: for each path the sum over its whole cell."""
    rng = np.random.default_rng(3)
    sizes = (30_000, 300_000)
    seconds = []
    for count in sizes:
        power, cell = rng.exponential(1.0, count), rng.integers(0, 500, count)
        seconds.append(cpu_seconds(lambda power=power, cell=cell: faintest(power, cell, 3.0), 3))
    assert report.exponent(sizes, seconds) < LINEAR


def test_the_command_measures_the_stages_that_are_asked_for(tmp_path, monkeypatch, capsys):
    """With measurements that take no time. Planted bug: all stages measured whatever was asked
    for."""
    rows = [
        {
            "kind": "tracing",
            "method": "Sionna's solver",
            "size": k,
            "error": 0.0,
            "cost": 1.5 * k,
            "floor_s": 0.04,
        }
        for k in (2, 4)
    ]
    monkeypatch.setattr("benchmarks.tracing.rows", lambda quick: rows)
    assert (
        main(
            [
                "bench",
                "trace",
                "--quick",
                "--out",
                str(tmp_path / "out"),
                "--json",
                str(tmp_path / "rows.json"),
            ]
        )
        == 0
    )
    assert json.loads((tmp_path / "rows.json").read_text())["rows"] == rows
    assert "tracing: Sionna's solver" in capsys.readouterr().out
    assert main(["bench", "nonsense", "--out", str(tmp_path / "out")]) == 2
    assert "choose from" in capsys.readouterr().err


def test_whole_commands_are_a_table():
    """Made-up seconds. Planted bug: wall and processor exchanged."""
    parts = {part: 0.25 + i for i, part in enumerate((*command.PARTS, "total"))}
    one = {
        "scene": "street",
        "frames": 4,
        "processor": parts,
        "wall": {part: 2 * s for part, s in parts.items()},
        "stages": {"trace": 6.0, "receive": 3.0},
        "peak_memory_mib": 1234.4,
        "paths_per_frame": 17.0,
    }
    lines = command.markdown([one, one | {"scene": "town"}])
    assert lines[0] == "| part | street, 4 frames | town, 4 frames |"
    assert lines[3] == "| set-up [s] | 1.25 (2.50) | 1.25 (2.50) |"
    assert "| trace, all frames [s] | 6.00 | 6.00 |" in lines
    assert "| receive, all frames [s] | 3.00 | 3.00 |" in lines
    assert "| peak memory [MiB] | 1,234 | 1,234 |" in lines
    found = {"machine": report.machine(), "quick": True, "rows": [], "growth": []}
    assert lines[3] in report.markdown(found | {"commands": [one, one | {"scene": "town"}]})


def test_whole_commands_say_which_one_is_at_work(monkeypatch, caplog):
    """Half an hour without `quick`. Planted bug: nothing logged, so that the step before is said
    to go on."""
    monkeypatch.setattr(command, "_answer", lambda *_: {})
    with caplog.at_level("INFO", "isac_rt"):
        command.measured("Munich", quick=False)
    assert caplog.messages == [
        "Munich, 78 frames, call 1 of 2",
        "Munich, 78 frames, call 2 of 2",
    ]


@pytest.mark.slow
def test_the_peak_of_memory_is_of_the_process_alone():
    """A process that takes 400 MB starts another, which says what it has had: some 50 MB, and what
    it then takes. The children of a benchmark said 1,248 MB each, that of the benchmark itself.
    Planted bug: `resource.getrusage`."""
    child = (
        "from benchmarks.command import peak_memory_mib as peak; few = peak(); "
        "taken = bytearray(150 << 20); print(few, peak())"
    )
    parent = (
        "import subprocess, sys; taken = bytearray(400 << 20); "
        f"print(subprocess.run([sys.executable, '-c', {child!r}], capture_output=True, "
        "text=True, check=True).stdout)"
    )
    done = subprocess.run(
        [sys.executable, "-c", parent], capture_output=True, text=True, check=True
    )
    few, many = map(float, done.stdout.split())
    assert 0 < few < 300 and many - few == pytest.approx(150, abs=10)


@pytest.mark.slow
def test_the_parts_of_a_whole_command_add_up():
    """A process of its own; the parts are those that the table names. Planted bug: the first frame
    not marked."""
    found = command.measured("paper's swarm", quick=True)
    for clock in ("processor", "wall"):
        seconds = found[clock]
        assert set(seconds) == {*command.PARTS, "total"} and min(seconds.values()) > 0
        assert sum(seconds[part] for part in command.PARTS) == pytest.approx(seconds["total"])
    assert found["frames"] == 20 and found["peak_memory_mib"] > 100
