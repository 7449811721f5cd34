"""Files that the program wrote and reads back, bent: what is wrong is refused with one message or
made anew, and never believed, a traceback, a hang, or written about outside its folder.

Bytes are cut, flipped, swapped, doubled and taken from other files; trees are broken with the right
checksum, as by somebody who means it. FUZZ=2000 pytest tests/scenario/test_fuzz_kept.py looks
further.
"""

from __future__ import annotations

import json
import random
import sqlite3
import warnings
from contextlib import closing
from pathlib import Path

import numpy as np
import pytest
import xarray as xr
from bending import bent
from hypothesis import given, settings
from hypothesis import strategies as st
from test_fuzz import JUNK, PROFILE, broken, one_message

from isac_rt.extensions.hardware.readers import read_sigmf
from isac_rt.extensions.hardware.store import load_cube, save_cube
from isac_rt.frame.cube import IFCube
from isac_rt.propagation.store import PathStore
from isac_rt.results.files import ResultsError, open_results, save, write_dataset
from isac_rt.runtime import UserError
from isac_rt.scenario.file import load
from isac_rt.simulation import simulate, stations
from isac_rt.simulation.resume import FILE, Resume, ResumeError
from isac_rt.simulation.setup import prepare
from isac_rt.storage import checksum, load_data, pack, save_data
from isac_rt.sweep import Outcomes, load_sweep, open_sweep, save_dataset, status
from isac_rt.sweep.execute import Job, run_job
from isac_rt.sweep.outcomes import _checksum, assemble
from isac_rt.views.interchange import write_sigmf
from reproduce import montecarlo

SCENE = """
name: small
frames: 4
radio: {samples_per_chirp: 32, chirps_per_frame: 6, bandwidth_hz: 320e6}
array: {element_pattern: isotropic, element_gain_dbi: 0, rx_x: 2, rx_z: 2}
propagation: {leakage: {enabled: false}}
noise: {model: snr, snr_db: 12}
modulation: {acquisition_frames: 2, pilot_every_frames: null}
compare: {other: {receivers: {clutter_filter: runs}}}
swarm:
  A: {role: active, position_m: [0.3, 0.2, 50], boresight: [0, 1, 0], rcs: {model: constant}}
  P: {role: passive, position_m: [-1.9, 5.3, 50.7], boresight: [0, -1, 0], rcs: {model: constant}}
"""
SWEEP = "scenario: s.yaml\nname: w\naxes: {snr: {key: noise.snr_db, values: [1, 9]}}\n"
CURVE = [{"ser": [3, 40]}, {"ser": [0, 40]}]


class Whole:
    """One of everything that is read back, as it was written."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        (folder / "s.yaml").write_text(SCENE)
        (folder / "w.yaml").write_text(SWEEP)
        self.scenario = load(folder / "s.yaml")
        self.setup = prepare(self.scenario)
        self._run()
        self._sweep()
        frame = self.setup.frame(1)
        self.cube = frame.samples(("A", "P"))
        self.paths = simulate_paths(self.setup)
        save_cube(self.cube, folder / "cube.nc")
        write_sigmf(self.cube, folder / "cube")
        PathStore(folder / "paths").put("ab12", *self.paths)
        save_data(folder / "curve", "k", CURVE)
        self.bytes = {
            name: (folder / name).read_bytes()
            for name in (
                f"run/{FILE}",
                "run/results.nc",
                "run/summary.json",
                "run/scenario.yaml",
                "sweep/sweep.nc",
                "sweep/sweep.json",
                str(self.point.relative_to(folder)),
                "cube.nc",
                "cube.sigmf-data",
                "cube.sigmf-meta",
                "paths/ab/ab12.paths",
                "curve",
            )
        }

    def _run(self) -> None:
        resume = Resume(self.folder / "run", "content", every=0.0)
        (self.folder / "run").mkdir()
        save(simulate.run(self.scenario, setup=self.setup, resume=resume), self.folder / "run")

    def _sweep(self) -> None:
        self.plan, self.outcomes = (
            load_sweep(self.folder / "w.yaml"),
            Outcomes(self.folder / "sweep"),
        )
        self.outcomes.save_definition(self.plan)
        self.keys = [p.key for p in self.plan.points()]
        for p in self.plan.points():
            run_job(Job(p.key, p.tree, p.ground, str(self.folder), str(self.outcomes.folder), 1))
        self.dataset = open_sweep(self.outcomes.folder).assign_attrs(program="earlier")
        save_dataset(self.dataset, self.outcomes.folder)
        self.point = self.outcomes.file(self.keys[0])

    def spoilt(self, name: str, content: bytes) -> Path:
        """Another content of a file; all others as they were."""
        for other, data in self.bytes.items():
            if other != name and (self.folder / other).read_bytes() != data:
                (self.folder / other).write_bytes(data)
        (self.folder / name).write_bytes(content)
        return self.folder / name


def simulate_paths(setup):
    traced = setup.propagation.trace(setup.swarm.poses(0.1), 0.1, setup.timetable.links(0))
    return traced, setup.propagation.census()


@pytest.fixture(scope="module")
def whole(tmp_path_factory) -> Whole:
    return Whole(tmp_path_factory.mktemp("kept"))


def spoil(whole: Whole, name: str, chance: random.Random) -> Path:
    others = [data for other, data in whole.bytes.items() if other != name]
    return whole.spoilt(name, bent(whole.bytes[name], others, chance))


SLOWER = settings(PROFILE, max_examples=max(3, PROFILE.max_examples // 8))
CHANCE = st.randoms(use_true_random=False)


def dataset_or_message(read, *problems):
    """What a reader returns, or None after one message of the kinds that it promises."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            return read()
    except problems as problem:
        one_message(problem)
        return None


# ---- sweeps


@PROFILE
@given(CHANCE)
def test_bent_point_files(whole, chance):
    """As it was, or not there."""
    file = spoil(whole, str(whole.point.relative_to(whole.folder)), chance)
    found = whole.outcomes.read(whole.keys[0])
    expected = json.loads(whole.bytes[str(file.relative_to(whole.folder))])
    expected.pop("checksum")
    assert found is None or found == expected


def points(whole):
    return [json.loads(whole.bytes[str(whole.point.relative_to(whole.folder))])]


@PROFILE
@given(st.data())
def test_point_files_of_other_trees(whole, data):
    """With their key and the right checksum: numbers, or as if they were not there."""
    tree = data.draw(broken(points(whole)))
    if not isinstance(tree, dict):
        return
    tree.pop("checksum", None)
    try:
        tree["checksum"] = _checksum(tree["key"], tree)
    except (ValueError, KeyError, TypeError, AttributeError):
        return
    whole.spoilt(str(whole.point.relative_to(whole.folder)), json.dumps(tree).encode())
    found = assemble(whole.plan, whole.outcomes)
    assert found.state.shape == (2, 1) and set(found.state.values.ravel()) <= {-1, 0, 1}
    assert status(whole.outcomes.folder).total == 2


@PROFILE
@given(CHANCE)
def test_bent_definitions_of_sweeps(whole, chance):
    spoil(whole, "sweep/sweep.json", chance)
    dataset_or_message(lambda: status(whole.outcomes.folder), ResultsError)


@PROFILE
@given(st.data())
def test_definitions_of_other_sweeps(whole, data):
    tree = data.draw(broken([json.loads(whole.bytes["sweep/sweep.json"])]))
    whole.spoilt("sweep/sweep.json", json.dumps(tree).encode())
    dataset_or_message(lambda: status(whole.outcomes.folder), ResultsError)


@SLOWER
@given(CHANCE)
def test_bent_datasets_of_sweeps(whole, chance):
    spoil(whole, "sweep/sweep.nc", chance)
    dataset_or_message(lambda: open_sweep(whole.outcomes.folder), ResultsError)


# ---- runs


@SLOWER
@given(CHANCE, st.sampled_from(["results.nc", "results.nc", "summary.json", "scenario.yaml"]))
def test_bent_results(whole, chance, name):
    spoil(whole, f"run/{name}", chance)
    found = dataset_or_message(lambda: open_results(whole.folder / "run"), UserError)
    assert found is None or repr(found)


@SLOWER
@given(st.data())
def test_summaries_of_other_runs(whole, data):
    tree = data.draw(broken([json.loads(whole.bytes["run/summary.json"])]))
    whole.spoilt("run/summary.json", json.dumps(tree).encode())
    found = dataset_or_message(lambda: open_results(whole.folder / "run"), UserError)
    assert found is None or repr(found)


@PROFILE
@given(CHANCE)
def test_bent_kept_frames(whole, chance):
    """All that comes out of it came in, in its order."""
    resume = Resume(whole.folder / "run", "content")
    whole.spoilt("curve", whole.bytes["curve"])  # all as they were
    entries = [pack(entry) for entry in resume.entries()]
    spoil(whole, f"run/{FILE}", chance)
    found = dataset_or_message(lambda: [*resume.entries()], ResumeError)
    assert found is None or [e for e in map(pack, found) if e not in entries] == []


@SLOWER
@given(st.data())
def test_kept_frames_of_other_trees(whole, data):
    """With the right checksum: refused before a frame, or taken up."""
    whole.spoilt("curve", whole.bytes["curve"])
    resume = Resume(whole.folder / "run", "content")
    entries = [pack(entry) for entry in resume.entries()]
    at = data.draw(st.integers(0, len(entries) - 1))
    tree = data.draw(broken([json.loads(entries[at][0])]))
    text = json.dumps(tree)
    seal = checksum(resume._digest, text.encode() + entries[at][1])
    with closing(sqlite3.connect(resume.file)) as database, database:
        database.execute(
            "UPDATE entry SET tree = ?, checksum = ? WHERE id = ?", (text, seal, at + 1)
        )
    run = simulate._Run.begin(whole.scenario, whole.setup, 1, stations.standard_terminal)
    dataset_or_message(lambda: run.restore(resume), ResumeError)


# ---- stores


@PROFILE
@given(CHANCE)
def test_bent_stored_paths(whole, chance):
    spoil(whole, "paths/ab/ab12.paths", chance)
    found = PathStore(whole.folder / "paths").get("ab12")
    assert found is None or str(found) == str(whole.paths)


@PROFILE
@given(st.data())
def test_stored_paths_of_other_trees(whole, data):
    """With the right checksum: paths whose arrays fit each other, or none."""
    body = whole.bytes["paths/ab/ab12.paths"].partition(b"\n")[2]
    tree, _, arrays = body.partition(b"\n")
    other = data.draw(broken([json.loads(tree)]))
    resealed(whole.folder / "paths/ab/ab12.paths", "ab12", json.dumps(other).encode(), arrays)
    found = PathStore(whole.folder / "paths").get("ab12")
    if found is not None:
        for link, paths in found[0].paths.items():
            assert repr(paths) and paths.link == link and paths.bent.shape == (len(paths),)
            assert paths.departure.shape == paths.arrival.shape == (len(paths), 3)
            assert paths.points.shape == (*paths.faces.shape, 3)


def resealed(file: Path, key: str, tree: bytes, arrays: bytes) -> None:
    body = tree + b"\n" + arrays
    file.write_bytes(f"isac_rt {key} {checksum(key, body)}\n".encode() + body)


@PROFILE
@given(CHANCE)
def test_bent_data(whole, chance):
    file = spoil(whole, "curve", chance)
    assert load_data(file, "k") in (None, CURVE)


@PROFILE
@given(st.recursive(JUNK, lambda inside: st.lists(inside, max_size=3), max_leaves=6))
def test_frames_of_a_study_of_other_trees(whole, value):
    """With the right key and checksum: counts, or as if they were not there."""
    with montecarlo.kept_in(whole.folder / "study"):
        store = montecarlo._Store("c", np.arange(2.0))
        try:
            save_data(store._file, store._key, value)
        except (ValueError, TypeError):
            return
        again = montecarlo._Store("c", np.arange(2.0))
        assert again.known(0) is None or isinstance(again.known(0), dict)


# ---- captures


def fits(cube: IFCube | None) -> bool:
    """A cube whose parts fit each other."""
    if cube is None:
        return True
    w = cube.waveform
    groups, _, chirps, samples = cube.samples.shape
    return (
        (groups, chirps, samples) == (w.num_groups, w.num_chirps, w.num_samples)
        and cube.schedule.shape == (groups, chirps)
        and cube.schedule.dtype.kind in "iu"
        and 0 <= cube.schedule.min() <= cube.schedule.max() < w.num_tx
        and np.isfinite(cube.samples).all()
        and isinstance(cube.start_time, float)
        and np.isfinite([cube.start_time, w.slope, w.delay_step, w.frame_duration]).all()
        and bool(repr(cube))
    )


@PROFILE
@given(CHANCE, st.sampled_from(["cube.nc", "cube.sigmf-data", "cube.sigmf-meta"]))
def test_bent_captures(whole, chance, name):
    spoil(whole, name, chance)
    read = {"cube.nc": lambda: load_cube(whole.folder / name)}.get(
        name, lambda: read_sigmf(whole.folder / "cube")
    )
    assert fits(dataset_or_message(read, ResultsError))


@PROFILE
@given(st.data())
def test_recordings_of_other_trees(whole, data):
    """SigMF's metadata with values replaced, taken away, renamed, scaled."""
    tree = data.draw(broken([json.loads(whole.bytes["cube.sigmf-meta"])]))
    whole.spoilt("cube.sigmf-meta", json.dumps(tree).encode())
    assert fits(dataset_or_message(lambda: read_sigmf(whole.folder / "cube"), ResultsError))


@st.composite
def datasets(draw, made: xr.Dataset):
    """Variables taken away, of other types and sizes, not finite; attributes replaced."""
    out = made.copy(deep=True)
    for _ in range(draw(st.integers(1, 3))):
        name = draw(st.sampled_from(sorted(out.variables)))
        attribute = draw(st.sampled_from(sorted(out.attrs)))
        match draw(st.integers(0, 6)):
            case 0:
                out = out.drop_vars(name)
            case 1 if out[name].dtype.kind == "f" and out[name].size:
                out[name] = out[name].where(False, draw(st.sampled_from([np.nan, np.inf, 1e300])))
            case 2:
                kind = draw(st.sampled_from(["f4", "i1", "U3"]))
                with warnings.catch_warnings():
                    warnings.simplefilter("ignore")
                    out = out.assign({name: out[name].astype(kind)})
            case 3 if out[name].ndim:
                out = out.isel({out[name].dims[0]: slice(0, draw(st.integers(0, 2)))})
            case 4:
                out.attrs[attribute] = draw(st.sampled_from(["", "{", "[1]", "{}", 7, "[" * 9999]))
            case 5:
                del out.attrs[attribute]
            case 6:
                tree = json.loads(made.attrs["waveform"]) if "waveform" in made.attrs else {"a": 1}
                out.attrs["waveform"] = json.dumps(draw(broken([tree])))
        if not out.variables or not out.attrs:
            break
    return out


@SLOWER
@given(st.data())
def test_cubes_of_other_variables(whole, data):
    with xr.open_dataset(whole.spoilt("cube.nc", whole.bytes["cube.nc"]), engine="h5netcdf") as d:
        made = d.load()
    write_dataset(data.draw(datasets(made)), whole.folder / "cube.nc")
    assert fits(dataset_or_message(lambda: load_cube(whole.folder / "cube.nc"), ResultsError))


def test_the_trees_are_what_the_files_hold(whole):
    """So that bending them means something: each file is read as it was written."""
    whole.spoilt("curve", whole.bytes["curve"])
    assert whole.outcomes.read(whole.keys[0])["status"] == "done"
    assert len([*Resume(whole.folder / "run", "content").entries()]) > 1
    run = simulate._Run.begin(whole.scenario, whole.setup, 1, stations.standard_terminal)
    assert run.restore(Resume(whole.folder / "run", "content")) >= 2
    assert str(PathStore(whole.folder / "paths").get("ab12")) == str(whole.paths)
    assert load_data(whole.folder / "curve", "k") == CURVE
    assert open_results(whole.folder / "run").summary["frames"] == 4
    for cube in (load_cube(whole.folder / "cube.nc"), read_sigmf(whole.folder / "cube")):
        assert fits(cube) and (cube.samples == whole.cube.samples).all()
