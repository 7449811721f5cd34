"""Keys of what is kept: each holds all that the kept thing depends on. Every input of every key is
changed once."""

from __future__ import annotations

import importlib.metadata
import json
import platform
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from isac_rt import storage
from isac_rt.document import ScenarioWarning
from isac_rt.frame.link import Link
from isac_rt.propagation.model import Census, Traced
from isac_rt.propagation.store import CachedPropagation, PathStore
from isac_rt.results import provenance
from isac_rt.results.provenance import UNSEEN_BY_PATHS, path_content, run_content
from isac_rt.scenario.file import load
from isac_rt.storage import PACKAGES
from isac_rt.sweep.definition import ground_of, load_sweep, paths_key, point_key
from isac_rt.world.swarm import Pose
from reproduce import montecarlo

SCENE = """
name: keyed
frames: 5
city: {source: mesh, file: house.obj}
propagation: {model: ray_traced}
radio: {calibration: board.cal}
clutter: {model: field}
receivers: {clutter_detector: cfar}
role_changes: [{frame: 4, from_uav: A, to_uav: B}]
swarm:
  A: {role: active, position_m: [0.3, 0.2, 50], velocity_mps: [0.7, 1.1, 0], boresight: [0, 1, 0]}
  B: {role: passive, position_m: [-1.9, 5.3, 50.7], rcs: {model: tr38901, size: large}}
"""
HOUSE = "v 0 0 0\nv 1 0 0\nv 0 1 0\nusemtl itu_concrete\nf 1 2 3\n"
SWEEP = "scenario: s.yaml\nname: w\naxes: {snr: {key: noise.snr_db, values: [1]}}\n"


@pytest.fixture
def folder(tmp_path) -> Path:
    (tmp_path / "s.yaml").write_text(SCENE)
    (tmp_path / "w.yaml").write_text(SWEEP)
    (tmp_path / "house.obj").write_text(HOUSE)
    (tmp_path / "board.cal").write_text("of a board")
    return tmp_path


def keys(folder: Path) -> dict[str, str]:
    """Every key that holds the program and the scenario's files."""
    storage._versions.cache_clear()
    montecarlo._folder.set(folder)
    scenario, point = load(folder / "s.yaml"), next(load_sweep(folder / "w.yaml").points())
    return {
        "run": run_content(scenario, 1),
        "point": point.key,
        "paths of a point": str(point.paths_key),
        "paths": path_content(scenario.model_dump(mode="json"), point.ground["city"]),
        "frames of a study": montecarlo._Store("curve", np.arange(2.0))._key,
    }


@pytest.fixture(autouse=True)
def fresh():
    yield
    storage._versions.cache_clear()
    montecarlo._folder.set(None)


@pytest.mark.parametrize("package", PACKAGES)
def test_keys_hold_the_version_of_every_package(folder, package, monkeypatch):
    """Planted bugs: `versions()` left out of `ground_of`, of `path_content`, of `run_content`."""
    before, version = keys(folder), importlib.metadata.version
    monkeypatch.setattr(
        importlib.metadata, "version", lambda n: version(n) + (".7" if n == package else "")
    )
    assert {name for name, key in keys(folder).items() if key == before[name]} == set()


def test_keys_hold_the_version_of_python_and_the_program(folder, monkeypatch):
    before = keys(folder)
    with monkeypatch.context() as once:
        once.setattr(platform, "python_version", lambda: "3.99.1")
        assert not set(keys(folder).values()) & set(before.values())
    for module in (
        "isac_rt.results.provenance",
        "isac_rt.sweep.definition",
        "reproduce.montecarlo",
    ):
        monkeypatch.setattr(f"{module}.program_fingerprint", lambda: "another")
    assert not set(keys(folder).values()) & set(before.values())


def test_a_package_in_use_that_is_not_the_installed_one_is_said_once(monkeypatch):
    """In the results, with both versions; keys hold the installed one, which every process sees.
    Planted bug: the module not looked at."""
    import scipy

    assert provenance.versions_in_use() == storage.versions()
    monkeypatch.setattr(scipy, "__version__", "0.1")
    with pytest.warns(ScenarioWarning, match=r"scipy .*in use: 0\.1.*PYTHONPATH") as said:
        found = [provenance.versions_in_use() for _ in range(3)]
    assert len(said) == 1 and found[0] == found[2]
    assert found[0].pop("scipy") == f"{storage.versions()['scipy']} (in use: 0.1)"
    assert found[0].items() <= storage.versions().items()


def test_the_program_is_every_source_and_table(tmp_path, monkeypatch):
    """A line, a name, a file more or less in any room; notes beside them are none of it. Planted
    bug: tables left out."""
    package = tmp_path / "isac_rt"
    for name in ("signal/if.py", "signal/costs.json", "storage.py"):
        (package / name).parent.mkdir(parents=True, exist_ok=True)
        (package / name).write_text(name)
    monkeypatch.setattr(storage, "__file__", str(package / "storage.py"))
    fingerprint = storage.program_fingerprint.__wrapped__
    seen = [fingerprint()]
    (package / "signal" / "notes.md").write_text("x")
    assert fingerprint() == seen[0]
    for change in (
        lambda: (package / "signal" / "if.py").write_text("signal/iF.py"),
        lambda: (package / "signal" / "costs.json").write_text("{}"),
        lambda: (package / "signal" / "if.py").rename(package / "signal" / "of.py"),
        lambda: (package / "new.py").touch(),
        lambda: (package / "new.py").rename(package / "signal" / "new.py"),
        lambda: (package / "storage.py").unlink(),
    ):
        change()
        seen.append(fingerprint())
    assert len(set(seen)) == len(seen)
    monkeypatch.setattr(importlib.metadata, "version", lambda _: "9.9")
    assert fingerprint() not in seen


@pytest.mark.parametrize("name", ["house.obj", "board.cal"])
def test_keys_hold_the_files_that_a_scenario_names(folder, name):
    """Paths and studies do not depend on the board. Planted bug:
    the digest kept from the last look."""
    before = keys(folder)
    text = (folder / name).read_text()
    (folder / name).write_text(text.replace("v 1 0", "v 2 0") + " ")
    same = {key for key, value in keys(folder).items() if value == before[key]}
    paths = {"paths", "paths of a point"}
    assert same == {"frames of a study"} | (set() if name == "house.obj" else paths)


def test_files_of_a_sweep_are_those_beside_its_base(folder):
    """The sweep lies in a folder of its own, with another mesh of the same name beside it. Planted
    bug: files looked for beside the sweep."""
    (folder / "sweeps").mkdir()
    (folder / "sweeps" / "w.yaml").write_text(SWEEP.replace("s.yaml", "../s.yaml"))
    (folder / "sweeps" / "house.obj").write_text(HOUSE.replace("v 1 0", "v 3 0"))
    here, there = (load_sweep(folder / f / "w.yaml") for f in (".", "sweeps"))
    assert next(there.points()).ground == next(here.points()).ground
    assert there.base.folder == folder.resolve()


def leaves(tree, at=()):
    """Places of all values in a tree of mappings and lists, empty ones included."""
    inside = tree.items() if isinstance(tree, dict) else enumerate(tree)
    for key, value in inside:
        if isinstance(value, dict | list) and value:
            yield from leaves(value, (*at, key))
        else:
            yield (*at, key)


def other(value):
    """Another value of the same kind, or another kind where there is but one."""
    if isinstance(value, bool):
        return not value
    if isinstance(value, int | float):
        return value + 1
    return f"{value}x" if isinstance(value, str) else "something"


def changed(tree, at):
    first, *rest = at
    out = dict(tree) if isinstance(tree, dict) else list(tree)
    out[first] = changed(tree[first], rest) if rest else other(tree[first])
    return out


def test_keys_hold_every_value_of_a_scenario(folder):
    """Every number, word and truth of the tree changed once, cross-sections, flights and roles of
    the swarm among them: the keys of points and runs all differ, those of paths but for the parts
    of one list. Planted bugs: the swarm in that list; the name of a UAV's cross-section dropped."""
    scenario = load(folder / "s.yaml")
    tree = scenario.model_dump(mode="json")
    ground, places = ground_of(tree, folder), list(leaves(tree))
    assert ("swarm", "B", "rcs", "size") in places and ("swarm", "A", "position_m", 2) in places
    assert len(places) > 150
    point, paths, content = set(), set(), set()
    unseen = [
        at
        for at in places
        if at[0] in UNSEEN_BY_PATHS or {"front_end", "calibration", "rotors"} & set(at)
    ]
    for at in places:
        one = changed(tree, at)
        point.add(point_key(one, ground))
        paths.add(paths_key(one, ground))
        content.add(path_content(one, "city"))
    assert len(point | {point_key(tree, ground)}) == len(places) + 1
    # paths of an untraced model have no key; the seen differ from each other and from the tree's
    assert len(paths - {None, paths_key(tree, ground)}) == len(places) - len(unseen) - 1
    assert len(content - {path_content(tree, "city")}) == len(places) - len(unseen)


def test_a_run_s_content_holds_its_scenario_and_what_is_asked_of_it(folder):
    """Planted bug: the snapshots left out."""
    scenario = load(folder / "s.yaml")
    content = json.loads(run_content(scenario, 3))
    assert scenario.model_dump(mode="json") in content
    assert run_content(scenario, 4) != run_content(scenario, 3)
    assert run_content(load(folder / "s.yaml", seed=9), 3) != run_content(scenario, 3)


def test_frames_of_a_study_are_kept_by_curve_and_points(folder):
    store = montecarlo._Store
    found = {
        store(key, np.array(snr))._key
        for key, snr in (("a", [1.0]), ("b", [1.0]), ("a", [1.5]), ("a", [1.0, 2.0]), ("a1", [0.0]))
    }
    assert len(found) == 5


class Nothing:
    """A model without paths that counts how often it is asked."""

    asked = 0

    def trace(self, *_):
        self.asked += 1
        return Traced({}, self.asked)

    def census(self):
        return Census()


def test_stored_paths_hold_the_instant_the_links_and_every_pose(tmp_path):
    """Every number of every pose changed by its last bit, another UAV, another name, the links,
    their order, the content. Planted bugs: links left out; accelerations left out; numbers
    rounded."""
    model, store = Nothing(), PathStore(tmp_path / "paths")

    def ask(content="x", poses=None, epoch=0.1, links=(("A", "B"),)):
        links = [Link(*link) for link in links]
        return CachedPropagation(lambda: model, store, content).trace(poses or base, epoch, links)

    def pose(seed):
        rng = np.random.default_rng(seed)
        return Pose(*(rng.normal(size=3) for _ in range(3)), rng.normal(size=(3, 3)))

    base = {"A": pose(1), "B": pose(2)}
    assert ask() == ask() == Traced({}, 1)
    tries = [
        {"content": "y"},
        {"epoch": np.nextafter(0.1, 1)},
        {"links": [("B", "A")]},
        {"links": [("A", "B"), ("A", "A")]},
        {"links": [("A", "A"), ("A", "B")]},
        {"links": []},
        {"poses": {"A": base["A"]}},
        {"poses": {"A": base["A"], "C": base["B"]}},
        {"poses": {"A": base["B"], "B": base["A"]}},
        {"poses": base | {"C": pose(3)}},
    ]
    for name in base:
        for field, values in vars(base[name]).items():
            for i in np.ndindex(values.shape):
                moved = values.copy()
                moved[i] = np.nextafter(moved[i], 9.0)
                tries.append({"poses": base | {name: replace(base[name], **{field: moved})}})
    assert len(tries) == 10 + 2 * 18
    dropped = [ask(**one).dropped for one in tries]
    assert dropped == list(range(2, 2 + len(tries)))
