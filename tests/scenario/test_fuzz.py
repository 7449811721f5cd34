"""Input that cannot hurt: whatever a file holds, there is a result or one clear complaint, never a
traceback and never a hang.

`hypothesis` breaks valid files at random places. The number of examples is small here; FUZZ=2000
pytest tests/scenario/test_fuzz.py looks further.
"""

from __future__ import annotations

import copy
import itertools
import os
import random
import warnings
from pathlib import Path

import numpy as np
import pytest
import trimesh
import yaml
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from isac_rt import scenario as tree
from isac_rt.cli.cli import main
from isac_rt.document import ScenarioError, ScenarioWarning
from isac_rt.runtime import of_machine
from isac_rt.scenario.file import load
from isac_rt.sweep import SweepError, load_sweep
from isac_rt.world.city import CityError, load_city

ROOT = Path(__file__).parents[2]
SCENES = sorted((ROOT / "scenes").glob("*.yaml"))
EXAMPLES = int(os.environ.get("FUZZ", "25"))
DEADLINE = 20_000  # ms for one example on a loaded machine: far beyond any of them, and no hang
PROFILE = settings(
    max_examples=EXAMPLES,
    deadline=DEADLINE,
    derandomize=EXAMPLES < 1000,
    suppress_health_check=list(HealthCheck),
    database=None,
)

JUNK = st.one_of(
    st.none(),
    st.booleans(),
    st.integers(-(10**30), 10**30),
    st.floats(),
    st.sampled_from([0, -1, 1e-300, 1e300, 77e12, 1e9, 0.5, 2**63]),
    st.text(max_size=12),
    st.lists(st.one_of(st.floats(), st.none(), st.text(max_size=3)), max_size=4),
    st.dictionaries(st.text(max_size=5), st.integers(), max_size=3),
)


def places(value, path=()):
    """The path of every value below one."""
    yield path
    items = (
        value.items()
        if isinstance(value, dict)
        else enumerate(value)
        if isinstance(value, list)
        else ()
    )
    for key, item in items:
        yield from places(item, (*path, key))


@st.composite
def broken(draw, whole):
    """A tree with up to four of its values replaced, taken away, doubled, or scaled by a
    thousand."""
    out = copy.deepcopy(draw(st.sampled_from(whole)))
    for _ in range(draw(st.integers(1, 4))):
        spots = [p for p in places(out) if p]
        if not spots:
            break
        *way, last = draw(st.sampled_from(spots))
        here = out
        for key in way:
            here = here[key]
        action = draw(st.sampled_from(["replace", "replace", "remove", "rename", "scale"]))
        if action == "replace":
            here[last] = draw(JUNK)
        elif action == "remove":
            del here[last]
        elif action == "rename" and isinstance(here, dict):
            here[draw(st.text(max_size=8))] = here.pop(last)
        elif (
            action == "scale"
            and isinstance(here[last], int | float)
            and not isinstance(here[last], bool)
        ):
            here[last] = here[last] * draw(st.sampled_from([1000, 1e-3, -1, 1e6]))
    return out


def one_message(problem: Exception) -> None:
    """A complaint is for people: some words, no object of the program's, at most a dozen lines."""
    text = str(problem)
    assert (
        text.strip()
        and len(text.splitlines()) <= 12
        and "object at 0x" not in text
        and "Traceback" not in text
    )


def scenes() -> list[dict]:
    return [yaml.safe_load(f.read_text().replace("e9", "e+9").replace("e6", "e+6")) for f in SCENES]


def refused_or_loaded(file: Path):
    """The scenario of a file, or None after a complaint that may stand."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", ScenarioWarning)
            return load(file)
    except ScenarioError as problem:
        one_message(problem)
        return None


@PROFILE
@given(broken(scenes()))
def test_broken_scenarios(tmp_path_factory, data):
    """Values replaced, taken away, renamed, scaled by a thousand: a scenario or a complaint."""
    file = tmp_path_factory.mktemp("s") / "s.yaml"
    file.write_text(yaml.safe_dump(data, allow_unicode=True), encoding="utf-8")
    refused_or_loaded(file)


@PROFILE
@given(
    st.one_of(
        st.binary(max_size=300),
        st.text(max_size=300).map(lambda t: t.encode("utf-8", "surrogatepass")),
    )
)
def test_files_that_are_no_scenarios(tmp_path_factory, data):
    file = tmp_path_factory.mktemp("s") / "s.yaml"
    file.write_bytes(data)
    assert refused_or_loaded(file) is None


@PROFILE
@given(st.sampled_from([f.read_bytes() for f in SCENES]), st.randoms(use_true_random=False))
def test_scenarios_with_broken_bytes(tmp_path_factory, data, chance: random.Random):
    """Bytes changed, cut and moved about."""
    out = bytearray(data)
    for _ in range(chance.randint(1, 6)):
        at = chance.randrange(len(out))
        out[at : at + chance.randint(0, 3)] = bytes(
            chance.choices(b"{}[]&*!|>%@`\"'#:,-?\t\n 0azA\xff\x00", k=chance.randint(0, 3))
        )
    file = tmp_path_factory.mktemp("s") / "s.yaml"
    file.write_bytes(bytes(out))
    refused_or_loaded(file)


BOMBS = {
    "aliases": "a: &a [x,x]\n"
    + "".join(f"{c}: &{c} [{(9 * f',*{p}')[1:]}]\n" for p, c in itertools.pairwise("abcdefghi")),
    "merge": "a: &a {x: 1}\nb: {<<: *a}\n",
    "depth": "[" * 100_000,
    "itself": "a: &a [*a]\n",
    "python": "a: !!python/object/apply:os.system ['true']\n",
    "digits": "seed: " + "9" * 10_000 + "\n",
    "exponent": "frames: 1e999999999\n",
    "long key": "x" * 200_000 + ": 1\n",
    "zeros": "\0" * 1000,
    "two documents": "a: 1\n---\nb: 2\n",
}


@pytest.mark.parametrize("name", BOMBS)
def test_bombs_end_at_once_with_2_and_one_message(name, tmp_path, capsys):
    file = tmp_path / "bomb.yaml"
    file.write_text(BOMBS[name])
    assert main(["run", str(file), "--out", str(tmp_path / "o")]) == 2
    said = capsys.readouterr().err
    assert (
        "Traceback" not in said
        and 1 <= len(said.strip().splitlines()) <= 11
        and max(map(len, said.splitlines())) < 1000
    )
    assert not (tmp_path / "o").exists()


SWEEP = {
    "scenario": "../x.yaml",
    "name": "s",
    "repetitions": 2,
    "axes": {"snr": {"key": "noise.snr_db", "values": [1, 2]}},
}


@PROFILE
@given(broken([SWEEP, yaml.safe_load((ROOT / "scenes/sweeps/canyon_power.yaml").read_text())]))
def test_broken_sweeps(tmp_path_factory, data):
    folder = tmp_path_factory.mktemp("w")
    (folder / "street_canyon.yaml").write_text((ROOT / "scenes/street_canyon.yaml").read_text())
    (folder / "sweeps").mkdir()
    file = folder / "sweeps" / "w.yaml"
    file.write_text(yaml.safe_dump(data, allow_unicode=True), encoding="utf-8")
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", ScenarioWarning)
            load_sweep(file, 1000)
    except (SweepError, ScenarioError) as problem:
        one_message(problem)


def city_or_complaint(folder: Path, **keys) -> int | None:
    """Number of faces of a city, or None after a complaint that may stand."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            city = load_city(tree.City.model_validate(keys), folder, 77e9, (0.0, 0.0, 0.0))
    except CityError as problem:
        one_message(problem)
        return None
    assert (
        np.isfinite(city.corners).all()
        and np.isfinite(city.normals).all()
        and (city.areas > 0).all()
    )
    return city.num_faces


def _box(suffix: str) -> bytes:
    return trimesh.creation.box(extents=(9, 7, 5)).export(file_type=suffix)


WHOLE = {
    suffix: data if isinstance(data := _box(suffix), bytes) else data.encode()
    for suffix in ("ply", "stl", "glb", "obj")
}


def test_quads_become_triangles(tmp_path):
    """PLY and OBJ quads, which Sionna itself refuses."""
    (tmp_path / "m.obj").write_text("v 0 0 0\nv 9 0 0\nv 9 0 7\nv 0 0 7\nf 1 2 3 4\n")
    header = (
        "ply\nformat ascii 1.0\nelement vertex 4\nproperty float x\nproperty float "
        "y\nproperty float z\nelement face 1\n"
    )
    (tmp_path / "m.ply").write_text(
        header
        + "property list uchar int vertex_indices\nend_header\n0 0 0\n9 0 0\n9 0 7\n0 0 7\n4 0 1 2 "
        "3\n"
    )
    for file in ("m.obj", "m.ply"):
        assert city_or_complaint(tmp_path, source="mesh", file=file) == 2


def test_a_mesh_too_large_for_memory_is_refused_before_it_is_read(tmp_path, monkeypatch):
    """A sparse file of 2 GB against 1 GB free; a file that is large but fits is read. It is the
    machine's trouble and not that of a sweep's point. Written against: no look at the size (not to
    be planted: the reader takes the memory)."""
    from isac_rt.world.city import files

    with (tmp_path / "m.ply").open("wb") as out:
        out.truncate(2_000_000_000)
    monkeypatch.setattr(files, "available_memory", lambda: 1e9)
    with pytest.raises(CityError, match=r"2 GB.*about 12 GB of memory.*1 GB") as refused:
        load_city(tree.City(source="mesh", file="m.ply"), tmp_path, 77e9, (0.0, 0.0, 0.0))
    assert of_machine(refused.value)


def scenario_text(**changes) -> str:
    base = {
        "frames": 5,
        "swarm": {
            "A": {"role": "active", "position_m": [0, 0, 9]},
            "U": {"role": "target", "position_m": [1, 9, 9]},
        },
    }
    return yaml.safe_dump(base | changes)


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        (
            {
                "radio": {"samples_per_chirp": 65536, "chirps_per_frame": 4095},
                "array": {"rx_x": 64, "rx_z": 64},
            },
            "GB of memory",
        ),
        ({"city": {"source": "mesh", "file": "nothing.ply"}}, "nothing.ply"),
        (
            {
                "noise": {"model": "snr"},
                "swarm": {"A": {"role": "active", "position_m": [0, 0, 9]}},
            },
            "no UAV with a cross-section",
        ),
        (
            {
                "frames": 200,
                "swarm": {
                    "A": {"role": "active", "position_m": [0, 0, 9], "velocity_mps": [0, 10, 0]},
                    "U": {"role": "target", "position_m": [0, 9.3, 9]},
                },
            },
            "change one of their flights",
        ),
    ],
)
def test_what_cannot_run_is_refused_before_it_starts(changes, words, tmp_path, capsys):
    """Exit 2, one line after those of progress, nothing written. Written against: no estimate of
    the memory."""
    file = tmp_path / "s.yaml"
    file.write_text(scenario_text(**changes))
    assert main(["run", str(file), "--out", str(tmp_path / "o")]) == 2
    *progress, said = capsys.readouterr().err.strip().splitlines()
    assert words in said and "Traceback" not in said
    assert {line.split(":")[0] for line in progress} <= {"loading the program", "setting up"}
    assert not list(tmp_path.glob("o/*"))


def test_files_outside_the_scenarios_folder_only_where_they_are_named(tmp_path):
    """A mesh elsewhere is read where the scenario names it; a scene file of somebody else cannot
    reach out of its own folder."""
    (tmp_path / "inside").mkdir()
    (tmp_path / "secret.obj").write_bytes(WHOLE["obj"])
    assert city_or_complaint(tmp_path / "inside", source="mesh", file="../secret.obj") == 12
    shape = (
        '<scene version="3.0.0"><shape type="obj" id="a"><string name="filename" '
        'value="{}"/></shape></scene>'
    )
    for name in ("../secret.obj", str(tmp_path / "secret.obj")):
        (tmp_path / "inside" / "scene.xml").write_text(shape.format(name))
        assert city_or_complaint(tmp_path / "inside", source="mitsuba", file="scene.xml") is None
    (tmp_path / "inside" / "own.obj").write_bytes(WHOLE["obj"])
    (tmp_path / "inside" / "scene.xml").write_text(shape.format("own.obj"))
    assert city_or_complaint(tmp_path / "inside", source="mitsuba", file="scene.xml") == 12


def test_an_xml_bomb_is_refused(tmp_path):
    """Entities that grow by ten a level: refused, not expanded. Expat is held to it."""
    entities = "".join(f'<!ENTITY e{i} "{f"&e{i - 1};" * 10}">' for i in range(1, 10))
    (tmp_path / "scene.xml").write_text(
        f'<!DOCTYPE scene [<!ENTITY e0 "x">{entities}]><scene version="3.0.0">&e9;</scene>'
    )
    assert city_or_complaint(tmp_path, source="mitsuba", file="scene.xml") is None
