"""Scenarios: what is refused and in which words, what is read, and what is written back."""

from __future__ import annotations

import copy
import json
import pickle
import re
import warnings
from pathlib import Path

import numpy as np
import pytest
import yaml
from hypothesis import given, settings
from hypothesis import strategies as st
from pydantic import ValidationError

from isac_rt.document import MAX_MESSAGES, Document, ScenarioError, ScenarioWarning, _models_in
from isac_rt.frame.waveform import waveform_of
from isac_rt.scenario.file import load, to_yaml
from isac_rt.scenario.swarm import Uav
from isac_rt.scenario.tree import Scenario, json_schema
from isac_rt.settings import Node
from isac_rt.world.settings import CITY_KEYS, City

SCENES = Path(__file__).parents[2] / "scenes"
BASE = """\
swarm:
  AT: {role: active, position_m: [0, 0, 1.5]}
  PT1: {role: passive, position_m: [0, 5.3, 1]}
"""


@pytest.fixture
def complaint(tmp_path, monkeypatch):
    """What load says about a text saved as s.yaml in the working folder."""
    monkeypatch.chdir(tmp_path)

    def say(text: str | bytes, *overrides: str, **options: int) -> str:
        Path("s.yaml").write_bytes(text if isinstance(text, bytes) else text.encode())
        with pytest.raises(ScenarioError) as caught:
            load("s.yaml", overrides, **options)
        return str(caught.value)

    return say


@pytest.mark.parametrize("path", sorted(SCENES.glob("*.yaml")), ids=lambda p: p.stem)
def test_scenes_load_without_doubts_and_round_trip(path, tmp_path):
    """Planted bug: to_yaml leaves out the null of pilot_every_frames."""
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        scenario = load(path)
    copied = tmp_path / "copy.yaml"
    copied.write_text(to_yaml(scenario, tmp_path))
    assert load(copied).model_dump(exclude={"city": {"file"}}) == scenario.model_dump(
        exclude={"city": {"file"}}
    )
    assert scenario.frame_duration_s == pytest.approx(
        waveform_of(scenario.radio, scenario.array).frame_duration, rel=1e-12
    )  # rounding


@pytest.mark.parametrize(
    ("text", "said"),
    [
        (
            BASE + "radio:\n  carrier_hz: 77e9\n  grups: 3\n",
            "s.yaml:6: radio.grups = 3: unknown key; did you mean groups? allowed",
        ),
        (
            BASE + "sede: 3\n",
            "s.yaml:4: sede = 3: unknown key; did you mean seed? allowed here: name, seed",
        ),
        (
            BASE + "radio:\n  groups: 17\n",
            "s.yaml:5: radio.groups = 17: must be less than or equal to 16",
        ),
        (
            BASE + "radio: {groups: 5}\n",
            "s.yaml:4: radio.groups = 5: 5 groups are more than the 3 transmit antennas",
        ),
        (
            BASE + "radio: {chirps_per_frame: 121}\n",
            "radio.chirps_per_frame = 121: 121 chirps are not a multiple of the 3 transmit",
        ),
        (
            BASE + "radio: {samples_per_chirp: 1023}\n",
            "radio.samples_per_chirp = 1023: must be even",
        ),
        (
            BASE + "radio: {bandwidth_hz: 40e6}\n",
            "radio.bandwidth_hz = 40000000.0: 4e+07 Hz must exceed twice the sampling rate of "
            "2e+07",
        ),
        (
            BASE + "radio: {carrier_hz: 0.6e9}\n",
            "s.yaml:4: radio.bandwidth_hz: 6.4e+08 Hz is more than the carrier of 6e+08 Hz",
        ),
        (
            BASE + "array:\n  element_pattern: sector\n",
            "array.element_gain_dbi: with 5 dBi the sector element would radiate 1.16 times its "
            "power; at most 4.36 dBi are possible; lower the gain",
        ),
        (
            BASE + "  B: {role: target, position_m: [9, 9, 9], velocity_mps: [0, 3.0e+8, 0]}\n",
            "swarm.B.velocity_mps = [0, 300000000.0, 0]: a flight at 3e+08 m/s is faster than the "
            "10000 m/s that are modelled; fly slower",
        ),
        (
            BASE + "  B:\n    role: target\n    waypoints:\n"
            "      - {time_s: 0, position_m: [9, 9, 9]}\n"
            "      - {time_s: 0.01, position_m: [9, 209, 9]}\n",
            "s.yaml:8: swarm.B.waypoints.1.time_s = 0.01: a flight at 2e+04 m/s is faster",
        ),
        (
            BASE + "frame_interval_s: 0.0077\n",
            "s.yaml:4: frame_interval_s = 0.0077: is shorter than a frame, which lasts 0.0077824 s",
        ),
        (BASE + "frames: 3\n", "modulation.acquisition_frames lower"),
        (
            BASE + "seed: 1\nseed: 2\n",
            "s.yaml:5: the key seed stands here a second time (first in line 4)",
        ),
        (BASE + "seed: 1.5\n", "seed = 1.5: must be an integer"),
        (BASE + f"seed: {10**40}\n", "0000: must be less than 9223372036854775808"),
        (BASE + f"noise: {{noise_figure_db: {1e4}}}\n", "must be less than or equal to 400"),
        (BASE + "propagation: {weakest_path_db: 401}\n", "must be less than or equal to 400"),
        (BASE + f"name: {101 * 'x'}\n", "...: must have at most 100 characters"),
        *(
            (BASE + f"name: {name}\n", "a name may hold letters, digits, _ and - only; rename it")
            for name in ("../../evil", "/abs/place", "..", '"a\\nb"', '"a\\0b"', '""', "a b")
        ),
        (BASE + "seed: true\n", "seed = true: true and false do not belong here"),
        (BASE + "noise: {snr_db: .inf}\n", "noise.snr_db = inf: must be a finite number"),
        (BASE + "noise: {snr_db: .nan}\n", "noise.snr_db = nan: must be a finite number"),
        (BASE + "radio: 3\n", "radio = 3: must be a mapping with keys out of carrier_hz"),
        (BASE + "radio:\n", "radio = null (empty): must be a mapping"),
        (
            BASE + "receivers: {guard_cells: [1]}\n",
            "receivers.guard_cells = [1]: has too few numbers",
        ),
        (
            BASE + "receivers: {velocity_method: omp, clutter_detector: angle_doppler}\n",
            "receivers.velocity_method = omp: has no meaning with clutter_detector angle_doppler, "
            "only with cfar; leave it out, or change clutter_detector",
        ),
        (
            BASE + "compare: {a: {receivers: {active_every_frames: 3}}}\n",
            "s.yaml:4: compare.a.receivers.active_every_frames = 3: every set receives the same "
            "samples, and receivers.active_every_frames is 1; leave it out",
        ),
        (
            BASE + "compare: {own: {preset: paper}}\n",
            "compare.own: is the name of the scenario's own receivers; choose another",
        ),
        (
            BASE + "compare: {a: {preset: papper}}\n",
            "compare.a.preset = papper: must be",
        ),
        (
            BASE + "compare: {a: {receivers: {clutter_detector: angle_doppler}}}\n",
            "compare.a.receivers.clutter_detector = angle_doppler: angle_doppler predicts clutter",
        ),
        (
            BASE + "receivers: {velocity_method: pursuit, refinement: grid}\n",
            "receivers.refinement = grid: has no meaning with velocity_method pursuit",
        ),
        (
            BASE + "receivers: {clutter_detector: cfar, update_false_alarm_rate: 0.001}\n",
            "receivers.update_false_alarm_rate = 0.001: has no meaning with clutter_detector cfar",
        ),
        (
            BASE + "tracking: {confirm_hits: 6}\n",
            "tracking.confirm_hits = 6: 6 hits cannot be reached within confirm_window = 5",
        ),
        (
            BASE + "clutter: {model: field}\n",
            "clutter.model = field: field needs propagation.model ray_traced and a city",
        ),
        (
            BASE + "city: {source: canyon, name: munich}\n",
            "city.name = munich: has no meaning with city.source canyon, only with builtin",
        ),
        (BASE + "city: {source: mesh}\n", "city.source mesh needs a file"),
        (BASE + "city: {source: builtin}\n", "city.source builtin needs the name"),
        (
            BASE + "city: {source: mesh, file: no.ply}\n",
            "s.yaml:4: city.file = no.ply: no such file",
        ),
        (
            BASE + "city: {source: munich}\n",
            "must be builtin, mitsuba, mesh, footprints, canyon or blocks",
        ),
        (
            BASE + "  A b: {role: target, position_m: [9, 9, 9]}\n",
            "s.yaml:4: swarm.A b: a name may hold letters, digits, _ and - only; rename it",
        ),
        (
            BASE + "  B: {role: target, position_m: [9, 9, 9], resource_block: 3}\n",
            "resource_block = 3: has no meaning for a UAV that is target",
        ),
        (
            BASE + "  B: {role: active, position_m: [9, 9, 9], resource_block: 17}\n",
            "B would need the resource blocks 17 to 19; a slot has 19 (0 to 18)",
        ),
        (
            BASE + "role_changes: [{frame: 7, from_uav: PT1, to_uav: PT1}]\n",
            "role_changes.0.from_uav = PT1: PT1 is passive; name a UAV that is active then",
        ),
        (
            BASE + "role_changes: [{frame: 7, from_uav: AT, to_uav: X}]\n",
            "role_changes.0.to_uav = X: X is not in the swarm",
        ),
        (
            BASE + "role_changes: [{frame: 100, from_uav: AT, to_uav: PT1}]\n",
            "must be after 0 (the change before it) and below the number of frames, 100",
        ),
        (
            BASE + "modulation: {streams: {AT: [0]}}\n",
            "modulation.streams.AT = [0]: is never a passive terminal",
        ),
        (
            BASE + "modulation: {streams: {PT1: [0, 3]}}\n",
            "needs one group or more of 0 to 2 (radio.groups = 3), each once",
        ),
        (
            BASE + "  B: {role: target, position_m: [0, 5.3, 1.04]}\n",
            "PT1 and B are 0.04 m apart at the start",
        ),
        (
            BASE + "  B: {role: target}\n",
            "s.yaml:4: swarm.B.position_m: missing: a UAV needs either",
        ),
        (
            BASE + "  B: {role: target, position_m: [1, 2]}\n",
            "swarm.B.position_m = [1, 2]: must be three numbers [x, y, z]",
        ),
        (
            BASE + "  B: {role: target, position_m: [9, 9, 9], boresight: [0, 0.0, 0]}\n",
            "length zero points nowhere",
        ),
        (
            BASE + "  B: {role: target, position_m: [9, 9, 9], boresight: up}\n",
            "boresight = up: must be velocity or a direction",
        ),
        (
            BASE + "  B: {role: target, position_m: [9, 9, 9], rcs: {model: relative}}\n",
            "relative goes with noise.model snr only",
        ),
        (
            BASE + "  B:\n    role: target\n    waypoints: [{time_s: 0, position_m: [9, 9, 9]}]\n",
            "s.yaml:6: swarm.B.waypoints",
        ),
        ("seed: 1\n", "s.yaml:1: swarm: missing, and it has no default; add it"),
        ("swarm: {}\n", "no UAV has the role active"),
        ("", "s.yaml: is empty; a scenario needs at least a swarm"),
        ("# nothing\n", "s.yaml: is empty"),
        ("- 1\n", "s.yaml:1: must be a mapping of keys (a scenario needs at least a swarm)"),
        ("a: [1\n", "s.yaml:2: did not find expected ',' or ']'"),
        ("a:\n\tb: 1\n", "s.yaml:2: a tab stands where YAML wants spaces; indent with spaces"),
        (b"a: 1\nb: \xff\n", "s.yaml:2: byte 0xff is not UTF-8; save the file as UTF-8"),
        (BASE + "name: \x01\n", "s.yaml:4: the character #x0001 is not allowed"),
        (BASE + "seed: " + "9" * 5000, "s.yaml:4: '9999"),
        (BASE + "seed: *x\n", "s.yaml:4: found undefined alias"),
        (BASE + "name: !!python/name:os.system ''\n", "s.yaml:4: the tag"),
        (BASE + "---\na: 1\n", "expected a single document"),
        ("? [a]\n: 1\n", "s.yaml:1: a key must be a word"),
        ("[" * 5000, "nested more than"),
        ("a: &a [*a]\n", "s.yaml:1: more than 40 levels"),
    ],
)
def test_each_mistake_has_one_clear_message(complaint, text, said):
    message = complaint(text)
    assert said in message
    assert len(message.splitlines()) == 1
    assert message.startswith("s.yaml:")


def test_alias_bombs_are_bounded(complaint):
    bomb = "a0: &a0 [x, x]\n" + "".join(
        f"a{i}: &a{i} [{', '.join([f'*a{i - 1}'] * 9)}]\n" for i in range(1, 12)
    )
    assert "more than 200000 values" in complaint(bomb)


def test_a_mapping_takes_over_what_another_holds(tmp_path):
    """YAML's `<<`: own keys win, then the first of a list, wherever it stands. Planted bug: what is
    taken over wins."""
    (tmp_path / "s.yaml").write_text(
        "swarm:\n  A: &a {role: active, position_m: [0, 0, 9], velocity_mps: [1, 2, 0]}\n"
        "  B: &b {<<: *a, role: target, position_m: [5, 5, 9]}\n"
        "  C: {role: target, position_m: [7, 7, 9], <<: [*b, *a]}\n"
        "  D: {role: target, position_m: [9, 7, 9], velocity_mps: [3, 0, 0], <<: {rcs: {}}}\n"
    )
    swarm = load(tmp_path / "s.yaml").swarm
    assert [uav.role for uav in swarm.values()] == ["active", "target", "target", "target"]
    assert [uav.velocity_mps for uav in swarm.values()] == [(1, 2, 0)] * 3 + [(3, 0, 0)]
    assert swarm["C"].position_m == (7, 7, 9)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("a: 1\n<<: 2\n", "s.yaml:2: what << takes over must be a mapping"),
        ("a: &a {<<: *a}\n", "more than 40 levels"),
        ('"<<": {}\n', "<<"),
    ],
)
def test_what_cannot_be_taken_over(complaint, text, said):
    assert said in complaint(text)


@pytest.mark.parametrize("second", [{"position_m": "[9, 9, 9]"}, {"velocity_mps": "[1, 0, 0]"}])
def test_waypoints_stand_alone(complaint, second):
    points = "[{time_s: 0, position_m: [9, 9, 9]}, {time_s: 1.5, position_m: [9, 9, 8]}]"
    ((key, value),) = second.items()
    message = complaint(
        BASE + f"  B:\n    role: target\n    waypoints: {points}\n    {key}: {value}\n"
    )
    assert message.startswith(f"s.yaml:7: swarm.B.{key} = [")


def test_waypoints_in_the_order_of_time(complaint):
    points = "[{time_s: 2.5, position_m: [9, 9, 9]},\n      {time_s: 2.5, position_m: [9, 9, 8]}]"
    message = complaint(BASE + f"  B:\n    role: target\n    waypoints: {points}\n")
    assert message.startswith(
        "s.yaml:7: swarm.B.waypoints.1.time_s = 2.5: must be later than the waypoint before, at "
        "2.5 s"
    )


@pytest.mark.parametrize(
    ("option", "said"),
    [
        ("radio.groups=7", "--set radio.groups=7: 7 groups are more than the 3 transmit antennas"),
        ("radio.grups=7", "--set radio.grups=7: unknown key; did you mean groups?"),
        ("radio.groups", "--set radio.groups: must be key=value"),
        ("radio..groups=2", "--set radio..groups=2: must be key=value"),
        ("noise.snr_db={a: 1}", "--set noise.snr_db={a: 1}: must be a number"),
        ("noise.snr_db=[1", "--set noise.snr_db=[1: the value cannot be read"),
        (
            "swarm.PT1.position_m.7=3",
            "--set swarm.PT1.position_m.7=3: swarm.PT1.position_m is a list of 3; use an index "
            "from 0 to 2",
        ),
        (
            "swarm.PT1.role.x=3",
            "--set swarm.PT1.role.x=3: swarm.PT1.role is passive, which has no keys below it",
        ),
        (
            "array.tx_x=4",
            "--set array.tx_x=4: radio.chirps_per_frame = 123: 123 chirps are not a multiple of "
            "the 5",
        ),
        (
            "frames=2",
            "--set frames=2: modulation.acquisition_frames: 3 acquisition frames leave none of the "
            "2 frames",
        ),
    ],
)
def test_overrides_name_the_option(complaint, option, said):
    """Also where the option contradicts a value in the file. Planted bug: the file's line is
    named."""
    message = complaint(BASE + "radio: {groups: 3, chirps_per_frame: 123}\n", option)
    assert message.startswith(said)
    assert "s.yaml" not in message


def test_frames_and_seed_name_their_options(complaint):
    assert complaint(BASE, frames=0).startswith("--frames 0: must be greater than or equal to 1")
    assert complaint(BASE, seed=-7).startswith("--seed -7: must be greater than or equal to 0")


@pytest.mark.parametrize(
    ("file", "name"), [("quarter-2.yaml", "quarter-2"), ("my b.yaml", "unnamed")]
)
def test_a_scenario_without_a_name_is_named_after_its_file(tmp_path, file, name):
    """Two of them share no folder of results. Planted bug: `unnamed` for all."""
    (tmp_path / file).write_text("swarm: {A: {role: active, position_m: [0, 0, 9]}}\n")
    assert load(tmp_path / file).name == name
    assert load(tmp_path / file, ["name=mine"]).name == "mine"


def test_overrides_reach_into_the_tree(tmp_path):
    path = tmp_path / "s.yaml"
    path.write_text(BASE)
    s = load(
        path,
        [
            "swarm.PT1.position_m.1=-7.25",
            "radio.bandwidth_hz=0.32e9",
            "swarm.U7={role: target, position_m: [3, 4, 5]}",
        ],
        17,
        99,
    )
    assert s.swarm["PT1"].position_m == (0, -7.25, 1)
    assert s.radio.bandwidth_hz == 320e6
    assert s.swarm["U7"].role == "target"
    assert (s.frames, s.seed) == (17, 99)


def test_many_problems_one_line_each(complaint):
    lines = complaint(BASE + "".join(f"k{i}: 1\n" for i in range(14))).splitlines()
    assert len(lines) == MAX_MESSAGES + 1
    assert [line.split(":")[1] for line in lines[:-1]] == [str(4 + i) for i in range(MAX_MESSAGES)]
    assert lines[-1] == "... and 4 more"


def test_files_that_are_none(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    Path("munich.yaml").write_text(BASE)
    wrong = {
        "munch.yaml": r"no such file; did you mean munich\.yaml\?",
        ".": "is a folder",
        "/dev/null": "not a regular file",
    }
    for name, said in wrong.items():
        with pytest.raises(ScenarioError, match=said):
            load(name)


@pytest.mark.parametrize(
    ("written", "value"),
    [("77e9", 77e9), ("7.65E+10", 76.5e9), ("077000000000", 77e9), ("+78.e9", 78e9)],
)
def test_numbers_as_in_yaml_1_2(tmp_path, written, value):
    """Planted bug: PyYAML's own resolver, to which 77e9 is a word, yes is true and 077 is octal."""
    path = tmp_path / "s.yaml"
    path.write_text(BASE + f"radio: {{carrier_hz: {written}}}\nname: yes\n")
    s = load(path)
    assert s.radio.carrier_hz == value
    assert s.name == "yes"


@pytest.mark.parametrize(
    ("option", "said"),
    [
        ("radio.carrier_hz=9e8", "is it in hertz"),
        ("radio.carrier_hz=77e12", "is it in hertz"),
        ("noise.tx_power_dbm=120", "is it in dBm"),
        ("noise.noise_figure_db=120", "is it in"),
        ("frame_interval_s=45", "is it in seconds"),
        ("swarm.PT1.velocity_mps=[0, 1500, 0]", "is it in metres and seconds"),
        ("swarm.PT1.position_m=[0, 2e5, 0]", "is it in metres"),
    ],
)
def test_units_wrong_by_a_thousand_are_doubted(tmp_path, option, said):
    path = tmp_path / "s.yaml"
    path.write_text(BASE)
    with pytest.warns(ScenarioWarning, match=f"--set .*{said}"):
        load(path, [option])


def test_equal_doubts_are_one(recwarn):
    """One line for each flight and cause: 600 waypoints 300 m apart in 0.1 s, the farthest after
    180 km; two UAVs of one speed share a line. Planted bugs: a line for each waypoint; the first
    waypoint that is too far for the farthest."""
    points = [{"time_s": i * 0.1, "position_m": [3, i * 300.0, 50 + i]} for i in range(600)]
    fast = {"role": "passive", "velocity_mps": [0, 900, 0]}
    swarm = {
        "AT": {"role": "active", "position_m": [0, 0, 50]},
        "PT1": fast | {"position_m": [0, 90, 50]},
        "PT2": fast | {"position_m": [0, 99, 50]},
        "U1": {"role": "target", "waypoints": points},
    }
    load({"name": "x", "frames": 4, "swarm": swarm})
    said = [str(w.message) for w in recwarn if issubclass(w.category, ScenarioWarning)]
    assert len(said) == 3
    assert "900 m/s" in said[0] and said[0].endswith("(likewise PT2)")
    assert "3000 m/s" in said[1] and "599 times" in said[1]
    assert "1.797e+05 m from the origin" in said[2] and "266 times" in said[2]


def test_a_tree_made_in_python_is_checked_too():
    with pytest.raises(ValidationError, match="no UAV has the role active"):
        Scenario(
            swarm={
                "PT": Uav(role="passive", position_m=(0, 0, 1)),
                "A2": Uav(role="target", position_m=(0, 0, 2)),
            }
        )


def test_city_file_is_relative_to_the_scenario(tmp_path, monkeypatch):
    """And stays findable when the resolved scenario is saved elsewhere; planted bug: relative to
    the working folder."""
    home, out = tmp_path / "scenes", tmp_path / "out" / "run"
    home.mkdir()
    out.mkdir(parents=True)
    (home / "block.ply").write_bytes(b"ply")
    (home / "s.yaml").write_text(BASE + "city: {source: mesh, file: block.ply}\n")
    monkeypatch.chdir(tmp_path)
    s = load("scenes/s.yaml")
    assert s.city_path() == Path("scenes/block.ply") and s.folder == Path("scenes")
    assert (
        pickle.loads(pickle.dumps(s)).city_path() == copy.deepcopy(s).city_path() == s.city_path()
    )
    assert "file: block.ply" in to_yaml(s)
    (out / "scenario.yaml").write_text(to_yaml(s, out))
    assert load(out / "scenario.yaml").city_path().samefile(home / "block.ply")


def test_every_city_key_belongs_to_a_source():
    assert set(City.model_fields) == {"source", "keep_radius_m", "materials"}.union(
        *CITY_KEYS.values()
    )


def test_every_key_of_the_schema_explains_itself():
    """A sentence or more, on one line, of at most 40 words, that also speaks of the default where
    there is one. Planted bugs: the docstring of one field taken away; the sentence on its
    default."""
    schema = json_schema()
    for title, node in {"Scenario": schema, **schema["$defs"]}.items():
        for key, entry in {"": node, **node["properties"]}.items():
            said = entry.get("description", "")
            where = f"{title}.{key}: {said!r}"
            assert 5 <= len(said.split()) <= 40 and said[0].isupper() and said.endswith("."), where
            assert not said.startswith(("Of ", "The key")) and "\n" not in said, where
            assert entry.get("default") is None or "default" in said.lower(), where


def test_schema_describes_every_mapping():
    schema = json_schema()
    assert json.loads(json.dumps(schema)) == schema
    assert schema["additionalProperties"] is False
    assert {"Radio", "Uav", "City"} <= set(schema["$defs"])
    assert "IF samples" in schema["$defs"]["Radio"]["properties"]["sampling_rate_hz"]["description"]


numbers = st.floats(-5e3, 5e3).map(lambda x: x + 0.0)
vectors = st.tuples(numbers, numbers, numbers)
awkward = st.sampled_from(["yes", "77e9", "null", "1:30", "010", "~", "<<"])
NAME = re.compile(r"[A-Za-z0-9_-]{1,20}", re.ASCII)
words = awkward | st.text(st.characters(exclude_categories=("Cs", "Cc")), max_size=20)


@st.composite
def scenarios(draw) -> dict:
    """Trees as a file holds them, all valid, with generic values and awkward words."""
    names = draw(
        st.lists(
            st.from_regex(r"[A-Za-z0-9_-]{1,6}", fullmatch=True),
            min_size=1,
            max_size=4,
            unique=True,
        )
    )
    swarm = {}
    for i, name in enumerate(names):
        height = float(draw(st.integers(0, 90)) + 100 * i)  # far from one another
        swarm[name] = {"role": "active" if i == 0 else draw(st.sampled_from(["passive", "target"]))}
        if draw(st.booleans()):
            swarm[name] |= {
                "position_m": [draw(numbers), draw(numbers), height],
                "velocity_mps": draw(vectors),
            }
        else:
            times = np.cumsum(draw(st.lists(st.floats(1.5, 9), min_size=2, max_size=4))) - draw(
                st.floats(0, 5)
            )
            swarm[name]["waypoints"] = [
                {"time_s": float(t), "position_m": [draw(numbers), draw(numbers), height]}
                for t in times
            ]
        swarm[name]["boresight"] = draw(st.just("velocity") | vectors.filter(any))
    tree = {
        "name": draw(awkward.filter(NAME.fullmatch) | st.from_regex(NAME, fullmatch=True)),
        "seed": draw(st.integers(0, 2**63 - 1)),
        "frames": draw(st.integers(4, 10**6)),
        "swarm": swarm,
    }
    tree["modulation"] = {
        "pilot_every_frames": draw(st.none() | st.integers(2, 99)),
        "dpsk_order": draw(st.sampled_from([2, 4, 8, 16])),
    }
    tree["radio"] = {
        "carrier_hz": draw(st.floats(1e10, 1e12)),
    }
    tree["noise"] = {"snr_db": draw(st.floats(-400, 400))}
    material = {"scattering_coefficient": draw(st.floats(0, 1))}
    city = {
        "source": "builtin",
        "name": draw(words.filter(bool)),
        "materials": {draw(words): material},
    }
    return tree | {"city": draw(st.none() | st.just(city))}


@settings(max_examples=80, deadline=None, derandomize=True)
@given(tree=scenarios())
def test_round_trip(tmp_path_factory, tree):
    """load(to_yaml(s)) is s to the last bit, whatever the numbers and words. Planted bug: floats
    written with 15 digits."""
    scenario = Scenario.model_validate(tree)
    path = tmp_path_factory.getbasetemp() / "round_trip.yaml"
    path.write_text(to_yaml(scenario), encoding="utf-8")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", ScenarioWarning)
        assert load(path).model_dump() == scenario.model_dump()


def test_presets_fill_in_what_is_not_stated(tmp_path):
    """What is stated beside a preset holds; of what neither says a set does as the scenario's own.
    Planted bugs: the preset over what is stated; the own settings over the preset."""
    file = tmp_path / "s.yaml"
    file.write_text(
        BASE
        + "receiver_preset: paper\n"
        + "receivers: {refinement: local, max_detections: 7}\n"
        + "tracking: {confirm_window: 9}\n"
        + "compare:\n  a: {preset: plain}\n"
        + "  b: {receivers: {symbol_decision: beams}, tracking: {confirm_hits: 2}}\n"
    )
    s = load(file)
    own, a, b = s.receivers, s.compare["a"], s.compare["b"]
    assert (own.velocity_method, own.refinement, own.clutter_filter) == ("omp", "local", "runs")
    assert (a.receivers.velocity_method, a.receivers.clutter_filter) == ("auto", "none")
    assert b.receivers == own.model_copy(update={"symbol_decision": "beams"})
    assert a.tracking == s.tracking and b.tracking.confirm_hits == 2
    assert {o.max_detections for o in (own, a.receivers)} == {7} == {b.receivers.max_detections}
    assert b.tracking.confirm_window == 9
    file.write_text(to_yaml(s))
    assert load(file) == s


def test_the_city_preset_is_the_default_where_paths_are_traced_in_a_city(tmp_path):
    """With any array, and nowhere else: open space and free space keep `plain`; what a file states
    of a detector takes the preset's keys along that mean nothing beside it. Planted bugs: the
    preset by the city alone; the rates of the preset left beside a stated detector."""
    traced = BASE + "city: {source: canyon}\npropagation: {model: ray_traced}\n"

    def read(text: str) -> Scenario:
        (tmp_path / "s.yaml").write_text(text)
        return load(tmp_path / "s.yaml")

    for array in ("", "array: {rx_z: 1}\n", "array: {rx: {shape: planar, rows: 2}}\n"):
        found = read(traced + array)
        assert found.receivers.passive_detector == "beams"
        assert found.receivers.false_alarm_rates == (1e-4, 1e-6)
        assert found.tracking.initiation == "unexplained"
    others = (
        BASE,
        BASE + "city: {source: canyon}\n",
        traced + "receiver_preset: plain\n",
    )
    for text in others:
        kept = read(text)
        assert kept.receivers.clutter_detector == "cfar", text
        assert kept.tracking.initiation == "all", text
    stated = read(traced + "receivers: {clutter_detector: cfar}\n").receivers
    assert stated.update_false_alarm_rate is None
    assert stated.passive_detector == "beams"
    assert read(traced + "receivers: {false_alarm_rate: 1.0e-3}\n").receivers.false_alarm_rates == (
        1e-3,
        1e-3,
    )
    again = tmp_path / "again.yaml"
    again.write_text(to_yaml(read(traced + "receiver_preset: plain\n")))
    assert load(again).receivers == read(traced + "receiver_preset: plain\n").receivers


def test_a_null_that_overrides_a_preset_is_written_down(tmp_path):
    """Of the preset city one rate and the time of deletion are taken back. The bug that was there:
    nulls that equal their default were left out, and the preset came back with the file."""
    scenario = load(
        SCENES / "munich_swarm.yaml",
        ["receivers.update_false_alarm_rate=null", "tracking.drop_after_s=null"],
    )
    assert scenario.receivers.clutter_detector == "angle_doppler"
    file = tmp_path / "again.yaml"
    file.write_text(to_yaml(scenario, tmp_path))
    assert load(file).receivers.update_false_alarm_rate is None
    assert load(file).tracking.drop_after_s is None


def test_a_uav_named_like_a_validator_is_named_in_its_complaint(complaint):
    """Pydantic's own names of checks are left out of the place, names of the file are not. Planted
    bug: whatever begins with "function-" is left out."""
    text = BASE + "  function-1: {role: target, position_m: [0, 9, 1], rolle: 3}\n"
    assert "swarm.function-1" in complaint(text)


def nodes_with_removals() -> dict[str, tuple[type[Node], str]]:
    """Dotted place of every removed key or value, with its class and what to write instead."""

    def below(model: type[Node], place: str):
        for name, instead in model.REMOVED.items():
            yield f"{place}{name}", (model, instead)
        for name, field in model.model_fields.items():
            inner, keyed = _models_in(field.annotation)
            if inner is not None and issubclass(inner, Node):
                yield from below(inner, f"{place}{name}.{'*.' if keyed else ''}")

    return dict(below(Scenario, ""))


@pytest.mark.parametrize("place", nodes_with_removals() or ["none"])
def test_removed_keys_and_values_say_what_to_write_instead(place, complaint):
    """Planted bug: `_said` looks a removed value up as a key."""
    if place == "none":
        pytest.skip("nothing has been removed")
    *above, last = place.split(".")
    key, _, value = last.partition(": ")
    tree: dict = {key: value or 1}
    for i, part in reversed(list(enumerate(above))):
        in_list = part == "*" and above[i - 1] in ("role_changes", "waypoints")
        tree = [tree] if in_list else {"AT" if part == "*" else part: tree}
    scenario = yaml.safe_load(BASE)
    scenario["swarm"]["AT"] |= tree.pop("swarm", {}).get("AT", {})
    said = complaint(yaml.safe_dump(scenario | tree))
    model, instead = nodes_with_removals()[place]
    renamed = instead in model.model_fields
    assert f"{'renamed; write' if renamed else 'removed in this version;'} {instead}" in said


def test_a_renamed_key_of_an_earlier_run_keeps_its_value():
    """Planted bug: `drop_removed` deletes the key."""
    document = Document.of_tree({"tracking": {"births": "unexplained"}})
    document.drop_removed(Scenario)
    assert document.data == {"tracking": {"initiation": "unexplained"}}
