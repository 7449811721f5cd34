"""Sweeps: what is refused, what a point is, that nothing depends on the workers, and that whoever
is killed loses nothing."""

from __future__ import annotations

import json
import os
import random
import signal
import socket
import subprocess
import sys
import time
from contextlib import suppress
from dataclasses import replace
from pathlib import Path

import numpy as np
import psutil
import pytest
import xarray as xr

import isac_rt
from isac_rt.cli.cli import main
from isac_rt.document import ScenarioError
from isac_rt.propagation.model import Census, Traced
from isac_rt.propagation.store import CachedPropagation, PathStore
from isac_rt.results.files import ResultsError
from isac_rt.results.metrics import binomial_interval
from isac_rt.results.provenance import UNSEEN_BY_PATHS
from isac_rt.scenario.file import load
from isac_rt.scenario.tree import Scenario
from isac_rt.settings import plain_tree
from isac_rt.simulation.setup import prepare
from isac_rt.simulation.simulate import summarise
from isac_rt.sweep import Outcomes, load_sweep, open_sweep, run_sweep, save_dataset, status
from isac_rt.sweep.definition import ground_of, paths_key, point_key
from isac_rt.sweep.execute import Job, run_job

ROOT = Path(__file__).parents[2]
BASE = """
name: tiny
frames: 3
radio: {samples_per_chirp: 64, chirps_per_frame: 12, bandwidth_hz: 320e6}
array: {element_pattern: isotropic, element_gain_dbi: 0, rx_x: 3, rx_z: 3}
propagation: {leakage: {enabled: false}}
noise: {model: snr, snr_db: 3}
modulation: {acquisition_frames: 2, pilot_every_frames: null}
swarm:
  A: {role: active, position_m: [0.3, 0.2, 50], velocity_mps: [0.7, 1.1, 0],
      boresight: [0, 1, 0], rcs: {model: constant}}
  P1: {role: passive, position_m: [-1.9, 5.3, 50.7], velocity_mps: [0.2, -0.9, 0],
       boresight: [0, -1, 0], rcs: {model: constant}}
"""
SWEEP = """
name: demo
scenario: base.yaml
axes:
  snr: {key: noise.snr_db, values: [-31, -9.5, 12]}
  order: {key: modulation.dpsk_order, values: [2, 8]}
repetitions: 2
seed: 7
"""


@pytest.fixture
def folder(tmp_path) -> Path:
    (tmp_path / "base.yaml").write_text(BASE)
    (tmp_path / "sweep.yaml").write_text(SWEEP)
    return tmp_path


def plan_of(folder: Path, text: str = SWEEP, **options):
    (folder / "sweep.yaml").write_text(text)
    return load_sweep(folder / "sweep.yaml", **options)


def job_of(plan, out: Path, point) -> Job:
    return Job(point.key, point.tree, point.ground, str(plan.base.folder), str(out), 1)


def run_here(plan, out: Path, points=None) -> None:
    """Without a cluster, in any order."""
    (out / "points").mkdir(parents=True, exist_ok=True)
    for p in points or plan.points():
        run_job(job_of(plan, out, p))


# ---- what a sweep is


def test_points_hold_the_axes_and_the_spawned_seeds(folder):
    """Against the scenarios written out by hand. Planted bug: repetitions outermost."""
    plan = plan_of(folder)
    points = list(plan.points())
    assert len(points) == plan.sweep.num_points == 12 and len({p.key for p in points}) == 12
    third = next(p for p in points if p.index == (1, 0, 1))
    by_hand = load(
        folder / "base.yaml", ["noise.snr_db=-9.5", "modulation.dpsk_order=2"], seed=plan.seed(1)
    )
    made = third.tree
    assert type(by_hand).model_validate(made).model_dump(exclude={"name"}) == by_hand.model_dump(
        exclude={"name"}
    )
    assert plan.seed(0) != plan.seed(1)
    assert [p.tree["seed"] for p in points] == [plan.seed(0), plan.seed(1)] * 6


@pytest.mark.parametrize(
    "name", ["canyon_power", "clutter", "front_ends", "own_sensor", "receivers", "rotors"]
)
def test_every_entry_of_the_examples_fits_its_scene(name):
    """`load_sweep` tries each on the base scenario; a point is what it says."""
    plan = load_sweep(ROOT / "scenes" / "sweeps" / f"{name}.yaml")
    assert sum(1 for _ in plan.points()) >= 5


def test_zip_and_list_axes(folder):
    text = """
scenario: base.yaml
axes:
  size: {zip: {radio.samples_per_chirp: [64, 128], radio.chirps_per_frame: [12, 24]}}
  place: {list: {near: {swarm.P1.position_m: [0, 4, 50]},
                 far: {swarm.P1.position_m: [1, 9, 51], noise.snr_db: 20}}}
"""
    plan = plan_of(folder, text)
    trees = {p.index: p.tree for p in plan.points()}
    assert len(trees) == 4
    assert (
        trees[1, 0, 0]["radio"]["samples_per_chirp"],
        trees[1, 0, 0]["radio"]["chirps_per_frame"],
    ) == (128, 24)
    assert trees[0, 1, 0]["noise"]["snr_db"] == 20 and trees[0, 0, 0]["noise"]["snr_db"] == 3
    assert plan.sweep.axes["size"].labels() == [64, 128] and plan.sweep.axes["place"].labels() == [
        "near",
        "far",
    ]


FORMED = """
scenario: base.yaml
axes:
  apart: {key: swarm.P1.formation.spacing_m, values: [2.5, 4]}
  how: {key: swarm.P1.formation.shape, values: [line, column]}
  many: {key: swarm.P1.formation.count, values: [2, 3]}
"""


@pytest.fixture
def formed(folder) -> Path:
    """The base with its passive terminal in a formation of two."""
    stated = "P1: {formation: {shape: column, spacing_m: 3, count: 2}, role"
    (folder / "base.yaml").write_text(BASE.replace("P1: {role", stated))
    return folder


def test_a_formation_is_an_axis(formed):
    """Spacing, shape and number of a formation against scenarios that state them; read back from
    the folder of the outcomes the points are the same. Planted bugs: the base's members left
    beside the new ones; the formation forgotten when the folder is read."""
    plan = plan_of(formed, FORMED)
    points = {p.index[:3]: p for p in plan.points()}
    for i, apart in enumerate((2.5, 4)):
        for j, how in enumerate(("line", "column")):
            for k, many in enumerate((2, 3)):
                stated = f"swarm.P1.formation={{shape: {how}, spacing_m: {apart}, count: {many}}}"
                by_hand = load(formed / "base.yaml", [stated])
                made = type(by_hand).model_validate(points[i, j, k].tree)
                assert made.swarm == by_hand.swarm and len(made.swarm) == many + 1
    assert len({p.key for p in points.values()}) == 8
    outcomes = Outcomes(formed / "out")
    outcomes.save_definition(plan)
    assert [p.key for p in outcomes.definition().points()] == [p.key for p in plan.points()]


def test_a_member_of_a_formation_is_an_axis(formed):
    """Where the axes name no formation its members are UAVs like others."""
    text = FORMED.split("axes")[0] + "axes: {y: {key: swarm.P1_2.position_m.1, values: [7, 8]}}\n"
    found = [p.tree["swarm"]["P1_2"]["position_m"][1] for p in plan_of(formed, text).points()]
    assert found == [7, 8]


def test_a_formation_that_is_none_is_one_message(formed):
    for change, said in (("[2, 3]", "[2, 1]"), ("[line, column]", "[line, ring]")):
        with pytest.raises(ScenarioError, match="formation"):
            plan_of(formed, FORMED.replace(change, said))


@pytest.mark.parametrize("name", ["../../evil", "/abs/place", "..", '"a\\nb"'])
def test_a_sweep_s_name_is_no_path(folder, name):
    """Planted bug: `name: str`."""
    (folder / "s.yaml").write_text(SWEEP.replace("name: demo", f"name: {name}"))
    with pytest.raises(ScenarioError, match="a name may hold letters, digits, _ and - only"):
        load_sweep(folder / "s.yaml")


@pytest.mark.parametrize(
    ("axes", "said"),
    [
        (
            "axes: {snr: {key: noise.snr, values: [1]}}",
            "s.yaml:3: axes.snr: entry 0 of snr (noise.snr = 1): noise.snr: unknown key; did you "
            "mean snr_db?",
        ),
        (
            "axes: {snr: {key: noise.snr_db, values: [1, x]}}",
            'entry 1 of snr (noise.snr_db = "x"): noise.snr_db: must be a number',
        ),
        (
            "axes: {a: {key: noise.snr_db, values: []}}",
            "s.yaml:3: axes.a.key = noise.snr_db: has no entry",
        ),
        ("axes: {a: {key: noise.snr_db}}", "an axis has either key and values, or zip, or list"),
        (
            "axes: {a: {zip: {frames: [5, 6], noise.snr_db: [1]}}}",
            "different numbers of values (frames: 2, noise.snr_db: 1)",
        ),
        (
            "axes: {a: {key: noise.snr_db, values: [1]}, b: {key: noise.snr_db, values: [2]}}",
            "axes.a: sets noise.snr_db, but axes.b sets",
        ),
        (
            "axes: {a: {key: noise, values: [{}]}, b: {key: noise.snr_db, values: [2]}}",
            "axes.b sets noise.snr_db too",
        ),
        (
            "axes: {a: {key: seed, values: [1]}}",
            "sets seed, but repetitions set it; set each key in one place",
        ),
        (
            "set: {frames: 9}\naxes: {a: {key: frames, values: [5]}}",
            "set.frames = 9: sets frames, but axes.a sets frames too",
        ),
        (
            "axes: {link: {key: frames, values: [5]}}",
            "an axis's name must be a word other than link",
        ),
        ("axes: {}", "s.yaml:3: axes: has no axis; for a single scenario use isac-rt run"),
        ("axis: {}", "s.yaml:3: axis: unknown key; did you mean axes?"),
        (
            "axes: {a: {key: frames, values: [5]}}\nkeep: [foo]",
            "keep.0 = foo: fits no quantity; there are ser_dpsk",
        ),
        (
            "axes: {a: {key: frames, values: [5]}}\nfigures: [{quantity: ber, against: b}]",
            "is no axis of this sweep; the axes are a",
        ),
        ("axes: {a: {key: swarm.P9.role, values: [target]}}", "swarm.P9.position_m: "),
    ],
)
def test_what_cannot_be_is_refused_before_anything_starts(folder, axes, said, capsys):
    """Exit 2 and one message with the file and the line; nothing is written. Planted bug: axes
    tried only when their points run."""
    (folder / "s.yaml").write_text(f"scenario: base.yaml\nname: x\n{axes}\n")
    if said.startswith("swarm.P9"):  # a cross-check: allowed here, may be mended by another axis
        load_sweep(folder / "s.yaml")
        return
    assert main(["sweep", str(folder / "s.yaml"), "--out", str(folder / "out")]) == 2
    message = capsys.readouterr().err
    assert said in message and "Traceback" not in message
    assert not (folder / "out").exists()


def test_too_many_points_are_counted_and_refused(folder, capsys):
    text = (
        "scenario: base.yaml\naxes: {a: {key: noise.snr_db, values: [1, 2, 3]}, b: {key: "
        "frames, values: [4, 5]}}\nrepetitions: 20\n"
    )
    (folder / "s.yaml").write_text(text)
    assert main(["sweep", str(folder / "s.yaml"), "--max-points", "100"]) == 2
    assert (
        "3 a x 2 b x 20 repetitions are 120 points, more than 100; shorten"
        in capsys.readouterr().err
    )


@pytest.mark.parametrize(
    ("text", "said"),
    [
        (
            "scenario: no.yaml\naxes: {a: {key: frames, values: [4]}}\n",
            "scenario = no.yaml: the base scenario cannot",
        ),
        ("", "s.yaml: is empty; a sweep needs a scenario and axes"),
    ],
)
def test_a_sweep_without_a_base_is_refused(folder, text, said):
    (folder / "s.yaml").write_text(text)
    with pytest.raises(ScenarioError, match=r"no\.yaml|empty") as caught:
        load_sweep(folder / "s.yaml")
    assert said in str(caught.value)


def test_the_key_is_of_the_content(folder, monkeypatch):
    """Other values, another seed, another program: other keys; another name or order of axes: the
    same. Planted bug: the name in it."""
    keys = {p.key for p in plan_of(folder).points()}
    assert keys == {
        p.key for p in plan_of(folder, SWEEP.replace("name: demo", "name: other")).points()
    }
    swapped = SWEEP.replace(
        "snr: {key: noise.snr_db, values: [-31, -9.5, 12]}",
        "q: {key: noise.snr_db, values: [12, -31, -9.5]}",
    )
    assert keys == {p.key for p in plan_of(folder, swapped).points()}
    assert not keys & {p.key for p in plan_of(folder, SWEEP.replace("seed: 7", "seed: 8")).points()}
    (folder / "base.yaml").write_text(BASE + "receivers: {guard_cells: [2, 2]}\n")
    assert not keys & {p.key for p in plan_of(folder).points()}
    monkeypatch.setattr("isac_rt.sweep.definition.program_fingerprint", lambda: "another")
    assert not keys & {p.key for p in plan_of(folder).points()}


# ---- outcomes


def test_a_sweep_that_another_version_finished_is_opened(folder, monkeypatch):
    """Its own dataset, and not points of today's program, of which there are none. Planted bug:
    the saved dataset never looked at."""
    plan, out = plan_of(folder), folder / "out"
    Outcomes(out).save_definition(plan)
    run_here(plan, out, list(plan.points())[:2])
    finished = open_sweep(out)
    save_dataset(finished, out)
    for module in ("definition", "outcomes"):
        monkeypatch.setattr(f"isac_rt.sweep.{module}.program_fingerprint", lambda: "another")
    found = open_sweep(out)
    assert found.attrs["program"] == finished.attrs["program"] != "another"
    assert int(found.state.sum()) == 2 and found.equals(finished)
    (out / "sweep.nc").write_bytes(b"half")
    with pytest.raises(ResultsError, match=r"sweep\.nc cannot be read"):
        open_sweep(out)


def test_the_dataset_holds_each_points_summary(folder):
    """Against runs of the same scenarios outside of the sweep; pooled rates and bounds from their
    counts. Planted bug: bounds of the last repetition alone."""
    plan, out = plan_of(folder), folder / "out"
    Outcomes(out).save_definition(plan)
    run_here(plan, out)
    d = open_sweep(out)
    assert d.sizes["snr"] == 3 and list(d.link.values) == ["A->A", "A->P1"]
    errors = total = 0
    for repetition in range(2):
        s = load(
            folder / "base.yaml",
            ["noise.snr_db=-31", "modulation.dpsk_order=8"],
            seed=plan.seed(repetition),
        )
        block = summarise(s)["links"]["A->P1"]
        here = d.sel(snr=-31, order=8, repetition=repetition, link="A->P1")
        assert float(here.ser_delay) == block["ser_delay"]
        assert np.array_equal(
            float(here.rmse_range_m),
            np.nan if block["rmse"]["range_m"] is None else block["rmse"]["range_m"],
            equal_nan=True,
        )
        errors, total = (
            errors + block["counts"]["ser_delay"][0],
            total + block["counts"]["ser_delay"][1],
        )
    low, high = binomial_interval(errors, total)
    here = d.sel(snr=-31, order=8, link="A->P1")
    assert total == 2 * 3 * 12
    assert d.attrs["title"] == "isac_rt sweep: demo" and d.attrs["seed"] == 7
    assert json.loads(d.attrs["base"]) == plain_tree(plan.base)
    assert (d.attrs["axis_snr"], d.attrs["axis_order"]) == ("noise.snr_db", "modulation.dpsk_order")
    assert (
        float(here.ser_delay_pooled),
        float(here.ser_delay_low),
        float(here.ser_delay_high),
    ) == (errors / total, low, high)
    assert float(d.ser_delay_pooled.sel(snr=12, order=8, link="A->P1")) == 0
    assert (d.state == 1).all()


def test_an_unfinished_sweep_can_be_read_and_a_failed_point_does_not_stop_it(folder, capsys):
    """A UAV on top of the AT at one entry: recorded with its error in one line, key first;
    `--retry-failed` alone runs it again. Planted bug: str of pydantic's error, whose first line
    says nothing."""
    text = (
        "scenario: base.yaml\nname: x\naxes:\n  y: {key: 'swarm.P1.position_m', values: [[0.3, "
        "0.2, 50.01], [0, 5, 50], [0, 6, 50]]}\n"
    )
    plan, out = plan_of(folder, text), folder / "out"
    Outcomes(out).save_definition(plan)
    points = list(plan.points())
    run_here(plan, out, points[:2])
    assert open_sweep(out).state.values.ravel().tolist() == [-1, 1, 0]
    found = status(out)
    assert (found.total, found.done, found.failed) == (3, 1, 1)
    assert found.errors[0][0] == "y [0.3, 0.2, 50.01]"
    assert found.errors[0][1].startswith("swarm.P1.position_m: A and P1 are 0.01 m apart")
    assert main(["sweep", "--status", str(out)]) == 0
    assert "1 of 3 points done, 1 failed, 1 to do" in capsys.readouterr().out
    outcomes = Outcomes(out)
    stamps = [outcomes.file(p.key).stat().st_mtime_ns for p in points[:2]]
    run_here(
        plan, out, points[:2]
    )  # Dask repeats tasks of a worker that died; outcomes that are there stay
    assert stamps == [outcomes.file(p.key).stat().st_mtime_ns for p in points[:2]]
    for p, again in zip(points[:2], (True, False), strict=True):  # a failed one, a done one
        before = outcomes.file(p.key).stat().st_mtime_ns
        run_job(replace(job_of(plan, out, p), retry_failed=True))
        assert (outcomes.file(p.key).stat().st_mtime_ns != before) is again
    assert (
        outcomes.done(points[0].key, False)
        and not outcomes.done(points[0].key, True)
        and outcomes.done(points[1].key, True)
    )


def test_the_status_counts_points_of_other_versions_and_scenarios(folder, capsys, monkeypatch):
    """Two points of an older program and one of another value lie beside one that is done. Planted
    bugs: points of the sweep counted too; the versions not compared."""
    plan = plan_of(
        folder, "scenario: base.yaml\nname: x\naxes:\n  s: {key: noise.snr_db, values: [1, 2]}\n"
    )
    outcomes = Outcomes(folder / "out")
    outcomes.save_definition(plan)
    first, _ = plan.points()
    for key in (first.key, "a1" * 16):
        outcomes.write(key, {"status": "done"})
    with monkeypatch.context() as older:
        older.setattr("isac_rt.sweep.outcomes.program_fingerprint", lambda: "0.1+old")
        for key in ("b2" * 16, "c3" * 16):
            outcomes.write(key, {"status": "failed", "error": "no"})
    found = status(outcomes.folder)
    assert (found.total, found.done, found.failed) == (2, 1, 0)
    assert (found.other_version, found.other_scenario) == (2, 1)
    assert main(["sweep", "--status", str(outcomes.folder)]) == 0
    said = capsys.readouterr().out
    assert "2 more in the folder were computed by another version of isac_rt" in said
    assert "1 more in the folder were computed for other values of the scenario" in said


def test_status_of_no_sweep_is_refused(tmp_path, capsys):
    assert main(["sweep", "--status", str(tmp_path)]) == 2
    assert "holds no sweep" in capsys.readouterr().err
    assert main(["sweep"]) == 2


# ---- Dask


def same(a: xr.Dataset, b: xr.Dataset) -> None:
    assert set(a.variables) == set(b.variables)
    for name, variable in a.variables.items():
        assert np.array_equal(
            variable.values, b[name].values, equal_nan=variable.dtype.kind == "f"
        ), name


def test_the_command_runs_resumes_and_gives_the_same_with_any_workers(folder, capsys):
    """One worker and two, and point after point without Dask in reverse order: bit for bit the same
    dataset; the second time nothing is run. Planted bug: the seed drawn in the worker."""
    few = SWEEP.replace("[-31, -9.5, 12]", "[-31, 12]").replace("repetitions: 2", "repetitions: 1")
    plan = plan_of(folder, few + "figures: [{quantity: ser_delay, against: snr, by: order}]\n")
    assert (
        main(["sweep", str(folder / "sweep.yaml"), "--out", str(folder / "two"), "--workers", "2"])
        == 0
    )
    assert "4 of 4 points done, 0 failed, 0 to do" in capsys.readouterr().out
    assert (folder / "two" / "sweep.nc").is_file() and (
        folder / "two" / "figures" / "ser_delay_snr_order.png"
    ).stat().st_size > 1000
    stamps = {f: f.stat().st_mtime_ns for f in (folder / "two" / "points").rglob("*.json")}
    run_sweep(plan, folder / "two", workers=1)
    assert stamps == {f: f.stat().st_mtime_ns for f in (folder / "two" / "points").rglob("*.json")}
    run_here(plan, folder / "none", reversed(list(plan.points())))
    Outcomes(folder / "none").save_definition(plan)
    same(isac_rt.open_sweep(folder / "two"), open_sweep(folder / "none"))


@pytest.mark.slow
@pytest.mark.parametrize("workers", [1, 4])
def test_one_worker_and_four_give_the_same(folder, workers):
    """Two are in the test above. Planted bug: results in the order of arrival."""
    plan = plan_of(folder, SWEEP)
    run_sweep(plan, folder / "many", workers=workers)
    run_here(plan, folder / "none", reversed(list(plan.points())))
    Outcomes(folder / "none").save_definition(plan)
    same(isac_rt.open_sweep(folder / "many"), open_sweep(folder / "none"))


CLIENT = """
import sys
from isac_rt.cli.cli import main
if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
"""
LONGER = SWEEP.replace("repetitions: 2", "repetitions: 5")


_CLIENTS: list[subprocess.Popen] = []


@pytest.fixture(autouse=True)
def no_client_stays():
    """A test that fails leaves no sweep running behind it."""
    yield
    while _CLIENTS:
        try:
            os.killpg(_CLIENTS.pop().pid, signal.SIGKILL)
        except ProcessLookupError:
            pass


def start_client(folder: Path, out: Path, *options: str, cwd: Path = ROOT) -> subprocess.Popen:
    (folder / "client.py").write_text(CLIENT)
    command = [
        sys.executable,
        str(folder / "client.py"),
        "sweep",
        str(folder / "sweep.yaml"),
        "--out",
        str(out),
        *options,
    ]
    made = subprocess.Popen(
        command,
        cwd=cwd,
        env={**os.environ, "PYTHONPATH": str(ROOT)},
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
    )
    _CLIENTS.append(made)
    return made


MOST_CPU_S, PATIENCE_S = 240.0, 1800.0
"""CPU time in which a client and its workers make the points asked for (they take some 20 s), and
the clock's last word: on a machine that others keep busy the one says little about the other."""


def cpu_seconds(process: psutil.Process) -> float:
    """Of a process and all below it that live."""
    total = 0.0
    with suppress(psutil.NoSuchProcess):
        for one in [process, *process.children(recursive=True)]:
            with suppress(psutil.NoSuchProcess):
                times = one.cpu_times()
                total += times.user + times.system
    return total


def wait_for_points(client: subprocess.Popen, out: Path, number: int) -> list[Path]:
    watched, end, look = psutil.Process(client.pid), time.monotonic() + PATIENCE_S, 0.0
    while len(found := list((out / "points").rglob("*.json"))) < number:
        if time.monotonic() > look:
            assert client.poll() is None, client.stderr.read()
            assert cpu_seconds(watched) < MOST_CPU_S and time.monotonic() < end, "no progress"
            look = time.monotonic() + 5.0
        time.sleep(0.02)
    return found


def whole(files: list[Path]) -> bool:
    return all(json.loads(f.read_text())["status"] == "done" for f in files)


@pytest.mark.slow
def test_a_killed_client_loses_nothing_and_repeats_nothing(folder):
    """SIGKILL when five points are done; the same command finishes the rest, and does not touch
    what was there."""
    plan, out = plan_of(folder, LONGER), folder / "out"
    client = start_client(folder, out, "--workers", "2")
    wait_for_points(client, out, 5)
    workers = psutil.Process(client.pid).children(recursive=True)
    client.kill()
    client.wait()
    psutil.wait_procs(workers, timeout=60)  # its workers go with it
    before = list((out / "points").rglob("*.json"))
    stamps = {f: f.stat().st_mtime_ns for f in before}
    assert whole(before) and len(before) < plan.sweep.num_points
    run_sweep(plan, out, workers=1)
    assert {f: f.stat().st_mtime_ns for f in before} == stamps
    assert status(out).done == plan.sweep.num_points == len(list((out / "points").rglob("*.json")))


def test_interrupt_ends_soon_and_keeps_what_is_finished(folder):
    """Ctrl-C: exit 130 within two seconds (three here: its workers go too), in one of three tries,
    for others may keep the machine busy."""
    plan = plan_of(folder, LONGER.replace("repetitions: 5", "repetitions: 60"))
    for i in range(3):
        out = folder / f"out{i}"
        client = start_client(folder, out, "--workers", "1")
        wait_for_points(client, out, 3)
        os.killpg(client.pid, signal.SIGINT)
        begin = time.monotonic()
        assert client.wait(timeout=60) == 130
        took = time.monotonic() - begin
        assert "interrupted" in client.stderr.read()
        assert (
            whole(list((out / "points").rglob("*.json")))
            and status(out).done < plan.sweep.num_points
        )
        if took < 3.0:
            return
    pytest.fail(f"{took:.1f} s")


@pytest.mark.slow
@pytest.mark.parametrize("trial", range(8))
def test_whoever_is_killed_at_a_random_moment(folder, trial):
    """One of two workers, or the client, is killed at a random moment; the client is started again,
    and in the end the dataset is that of an undisturbed run."""
    rng = random.Random(trial)
    plan, out = plan_of(folder, LONGER), folder / "out"
    client = start_client(folder, out, "--workers", "2")
    wait_for_points(client, out, 1 + rng.randrange(20))
    workers = psutil.Process(client.pid).children(recursive=True)
    victim = rng.choice([*workers, client])
    victim.send_signal(signal.SIGKILL)
    before = {f: f.stat().st_mtime_ns for f in (out / "points").rglob("*.json")}
    if victim is client:
        assert client.wait(timeout=480) != 0
        again = start_client(folder, out, "--workers", "2")
        assert again.wait(timeout=480) == 0, again.stderr.read()
    else:
        assert client.wait(timeout=480) == 0, client.stderr.read()
    assert all(f.stat().st_mtime_ns == stamp for f, stamp in before.items())
    run_here(plan, folder / "calm")
    Outcomes(folder / "calm").save_definition(plan)
    same(open_sweep(out), open_sweep(folder / "calm"))


@pytest.mark.parametrize(
    ("address", "said"),
    [
        ("tcp://127.0.0.1:1", "without TLS lets everybody who reaches it run code as you"),
        ("127.0.0.1:8786", "write tls://HOST:PORT"),
        ("tls://127.0.0.1:1", "no scheduler answers at tls://127.0.0.1:1"),
    ],
)
def test_a_scheduler_without_tls_or_that_is_not_there(folder, capsys, address, said):
    """Planted bug: a tcp address connected to."""
    plan_of(folder)
    command = ["sweep", str(folder / "sweep.yaml"), "--out", str(folder / "o")]
    assert main([*command, "--scheduler", address]) == 2
    assert said in capsys.readouterr().err


# ---- what others can do to a sweep at work


EVIL = "open({marker!r}, 'a').write(__name__ + chr(10))\nraise ImportError('evil')\n"
NAMES = "multiprocessing numpy isac_rt yaml usercustomize resource encodings typing".split()


def test_others_neither_connect_to_a_sweep_at_work_nor_run_their_modules_in_it(folder):
    """No process of a sweep listens, neither on a port nor on a socket with a name, and none takes
    a module from the working folder. Planted bugs: the embedded Dask cluster of earlier versions;
    processes that begin without PYTHONSAFEPATH."""
    marker, place, out = folder / "ran", folder / "place", folder / "out"
    place.mkdir()
    for name in NAMES:
        (place / f"{name}.py").write_text(EVIL.format(marker=str(marker)))
    plan_of(folder)
    client = start_client(folder, out, "--workers", "2", cwd=place)
    wait_for_points(client, out, 2)
    processes = [(p := psutil.Process(client.pid)), *p.children(recursive=True)]
    assert len(processes) >= 3  # the client and two workers
    listening = []
    for process in processes:
        for c in process.net_connections("all"):
            if c.status == psutil.CONN_LISTEN or (c.family == socket.AF_UNIX and c.laddr):
                listening.append((process.name(), c))
    assert listening == []
    assert client.wait(timeout=480) == 0, client.stderr.read()
    assert not marker.exists(), marker.read_text()


# ---- shared paths


class Counted:
    """A propagation model that counts its calls, leaves two paths out and holds scatterers."""

    def __init__(self, model) -> None:
        self.model, self.calls = model, 0

    def trace(self, *arguments):
        self.calls += 1
        return self.model.trace(*arguments)._replace(dropped=2)

    def census(self):
        return Census(7, 9, mirrors={"AT": {"count": 1, "share": 0.1, "share_left_out": 0.25}})


def test_cached_paths_are_the_same_and_made_once(folder, tmp_path):
    """Bit for bit; another content, instant or place is another key. Planted bug: the epoch left
    out of the key."""
    setup = prepare(load(folder / "base.yaml"))
    model, store = Counted(setup.propagation), PathStore(tmp_path / "paths")
    links = setup.timetable.links(0)
    poses, epoch = setup.swarm.poses(0.1), 0.1
    first = CachedPropagation(lambda: model, store, "x")
    second = CachedPropagation(lambda: pytest.fail("made without need"), store, "x")
    (one, dropped), (two, again) = (m.trace(poses, epoch, links) for m in (first, second))
    assert model.calls == 1
    assert dropped == again == 2
    assert first.census() == second.census() == model.census()
    for link in links:
        for name, value in vars(one[link]).items():
            assert np.array_equal(
                value, getattr(two[link], name), equal_nan=name in ("points", "gain")
            ), name
    for content, time_, where in (
        ("y", epoch, poses),
        ("x", 0.2, poses),
        ("x", epoch, setup.swarm.poses(0.2)),
    ):
        CachedPropagation(lambda: model, store, content).trace(where, time_, links)
    assert model.calls == 4


CHANGES = {
    "name": "other",
    "seed": 9,
    "frames": 5,
    "frame_interval_s": 0.05,
    "radio": {"carrier_hz": 78e9},
    "array": {"element_gain_dbi": 2},
    "modulation": {"dpsk_order": 4},
    "swarm": {"P1": {"position_m": [-1.9, 5.4, 50.7]}},
    "role_changes": [{"frame": 2, "from_uav": "A", "to_uav": "P1"}],
    "access": {"feedback": True},
    "city": {"block_size_m": 21},
    "propagation": {"max_bounces": 1},
    "accuracy": {"max_untraced_m": 0.3},
    "clutter": {"model": "field"},
    "noise": {"snr_db": 5},
    "receivers": {"clutter_filter": "runs"},
    "receiver_preset": "paper",
    "compare": {"runs": {"receivers": {"clutter_filter": "runs"}}},
    "tracking": {"confirm_hits": 2},
    "belief": {"level_db": 1.5},
    "cooperation": "tracks",
    "sensor": "awr1843",
    "weather": {"rain_mm_per_h": 5},
    "emitters": {"car": {"position_m": [0, 9, 1]}},
}
"""One change of each part of a scenario."""


def merged(tree, change):
    if not isinstance(tree, dict) or not isinstance(change, dict):
        return change
    return tree | {key: merged(tree.get(key), value) for key, value in change.items()}


def test_the_key_of_a_point_depends_on_every_file_of_its_city(tmp_path):
    """Buildings, the other files of a Shapefile, and the heights under them, each changed once."""
    city = {"source": "footprints", "file": "town.shp", "terrain": "dem.tif"}
    files = [tmp_path / name for name in ("town.shp", "town.dbf", "town.prj", "dem.tif")]
    for file in files:
        file.write_text(file.name)
    keys = [point_key({"city": city}, ground_of({"city": city}, tmp_path))]
    for file in files:
        file.write_text("another")
        keys.append(point_key({"city": city}, ground_of({"city": city}, tmp_path)))
    assert len(set(keys)) == 5


def test_paths_are_shared_by_what_differs_in_nothing_that_they_depend_on(folder):
    """Every part of a scenario changed once: the key of its paths changes with all but those of one
    list, and paths of scenarios that differ in these are the same. Planted bug: the swarm in the
    list."""
    text = BASE.replace("{leakage", "{model: ray_traced, leakage") + "city: {source: blocks}\n"
    (folder / "base.yaml").write_text(text + "receiver_preset: plain\n")
    plan = plan_of(folder)
    base = plain_tree(plan.base)
    assert set(CHANGES) == set(Scenario.model_fields)
    ground = ground_of(base, folder)
    keys = {part: paths_key(merged(base, {part: CHANGES[part]}), ground) for part in CHANGES}
    shared = {part for part, key in keys.items() if key == paths_key(base, ground)}
    assert shared == set(UNSEEN_BY_PATHS)
    free = base | {"city": None, "propagation": {"leakage": {"enabled": False}}}
    expected = prepare(Scenario.model_validate(free))
    for part in shared - {"weather", "emitters"}:  # these act on the paths that are kept
        found = prepare(Scenario.model_validate(merged(free, {part: CHANGES[part]})))
        for link in expected.timetable.links(0):
            one, two = (s.find(1)[1][link] for s in (expected, found))
            assert np.array_equal(one.delay, two.delay) and np.array_equal(one.gain, two.gain)


def test_the_store_stays_under_its_limit_and_survives_what_others_do(folder, tmp_path):
    """The least recently used go first; damaged and vanished files are traced again; an unwritable
    folder is no error."""
    setup = prepare(load(folder / "base.yaml"))
    traced, census = Traced(setup.frame(0).paths, 1), Census()
    one = PathStore(tmp_path / "probe")
    one.put("aa", traced, census)
    size = next((tmp_path / "probe").rglob("*.paths")).stat().st_size
    store = PathStore(tmp_path / "paths", limit=int(4.5 * size))
    for i, key in enumerate(["a1", "b2", "c3", "d4"]):
        store.put(key, traced, census)
        os.utime(store._store._file(key), (i, i))
    assert store.get("a1") is not None  # touched: now the latest
    store.put("e5", traced, census)
    assert [k for k in ("a1", "b2", "c3", "d4", "e5") if store.get(k) is not None] == [
        "a1",
        "d4",
        "e5",
    ]
    store._store._file("d4").write_bytes(store._store._file("d4").read_bytes()[:200])
    assert store.get("d4") is None
    (tmp_path / "file").write_text("")
    PathStore(tmp_path / "file" / "below").put("a", traced, census)


def test_a_city_is_loaded_once_while_it_stays_the_same(tmp_path):
    """The same object for another seed and noise; another one when the city or the place of the
    swarm (so its origin) differs."""
    (tmp_path / "s.yaml").write_text(BASE + "city: {source: canyon, street_width_m: 17.3}\n")
    city = prepare(load(tmp_path / "s.yaml")).city
    assert prepare(load(tmp_path / "s.yaml", ["seed=9", "noise.snr_db=1"])).city is city
    assert prepare(load(tmp_path / "s.yaml", ["city.street_width_m=17.4"])).city is not city
    assert not np.array_equal(
        prepare(load(tmp_path / "s.yaml", ["swarm.A.position_m=[7, 0.2, 50]"])).city.origin,
        city.origin,
    )
