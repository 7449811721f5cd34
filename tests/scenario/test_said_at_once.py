"""All problems of a scenario that can be judged are said at once."""

from __future__ import annotations

import copy
import itertools
from pathlib import Path
from typing import Any

import pytest

import isac_rt as irt
from isac_rt.document import ScenarioError
from isac_rt.scenario.tree import Scenario

BASE: dict[str, Any] = {
    "frames": 20,
    "swarm": {
        "AT": {"role": "active", "position_m": [0, 0, 30]},
        "PT": {"role": "passive", "position_m": [0, 20, 30]},
    },
}
FAULTS: dict[str, tuple[str, Any, str]] = {
    "radio": ("bandwidth_hz", -3.0, "must be greater than 0"),
    "array": ("tx_x", 0, "must be greater than or equal to 1"),
    "swarm": ("AT.roll", 3, "unknown key"),
    "receivers": ("false_alarm_rate", 7, "must be less than"),
    "tracking": ("acceleration_std_mps2", -1, "must be greater than 0"),
    "noise": ("model", "loud", "must be"),
    "propagation": ("model", "magic", "must be"),
    "access": ("establish", 3, "must be"),
    "modulation": ("dpsk_order", "x", "must be"),
    "clutter": ("model", "dense", "must be"),
}
"""One malformed value of each node: key within it, value, what is said."""
CROSS: dict[str, tuple[set[str], dict[str, Any], str]] = {
    "detector": (
        {"receivers", "propagation", "compare", "city"},
        {"receivers.clutter_detector": "angle_doppler"},
        "predicts clutter from a city's mesh",
    ),
    "initiation": (
        {"tracking", "compare", "city"},
        {"tracking.initiation": "unexplained"},
        "unexplained needs a city",
    ),
    "clutter": ({"clutter", "propagation", "city"}, {"clutter.model": "field"}, "field needs"),
    "clocks": (
        {"access"},
        {"access.synchronisation": "two_round"},
        "two_round measures clocks in the stages",
    ),
    "acquisition": (
        {"radio", "modulation", "frames"},
        {"modulation.acquisition_frames": 30},
        "acquisition frames leave none",
    ),
    "groups": ({"radio", "array"}, {"radio.groups": 11}, "groups are more than"),
    "places": ({"swarm"}, {"swarm.PT.position_m": [0, 0, 30]}, "m apart at the start"),
    "rcs": (
        {"swarm", "noise", "propagation"},
        {"swarm.PT.rcs": {"model": "relative"}},
        "relative goes with noise.model snr only",
    ),
}
"""Wrong combinations: the nodes that their rule reads, values that make them, what is said."""


def put(tree: dict[str, Any], key: str, value: Any) -> None:
    *above, last = key.split(".")
    for part in above:
        tree = tree.setdefault(part, {})
    tree[last] = value


def complaints(tree: dict[str, Any]) -> list[str]:
    with pytest.raises(ScenarioError) as caught:
        irt.load(tree)
    return str(caught.value).splitlines()


@pytest.mark.parametrize(("node", "rule"), [*itertools.product(FAULTS, CROSS)])
def test_a_wrong_combination_is_said_beside_a_malformed_node(node: str, rule: str):
    """Each node malformed, beside each wrong combination of nodes: both are said in one message,
    where the rule reads other nodes; else the node's alone. Planted bugs: rules not judged beside
    malformed nodes; a malformed node judged by its default."""
    key, value, fault = FAULTS[node]
    reads, change, said = CROSS[rule]
    tree = copy.deepcopy(BASE)
    for name, wrong in change.items():
        put(tree, name, wrong)
    assert any(said in line for line in complaints(tree))
    put(tree, f"{node}.{key}", value)
    lines = complaints(tree)
    assert sum(fault in line for line in lines) == 1
    assert sum(said in line for line in lines) == (node not in reads)


def test_tables_files_nodes_and_combinations_are_said_together(tmp_path: Path):
    """A table that is none, a mesh that is none, a malformed node and a wrong combination, each in
    one line with its place; the array that lacks its table is not judged. Planted bugs: tables
    raised first; missing files looked for last."""
    file = tmp_path / "x.yaml"
    file.write_text(
        "radio: {bandwidth_hz: -3, groups: 11}\n"
        "swarm: {AT: {role: active, position_m: [0, 0, 30]}}\n"
        "array: {tx: {file: tx.csv}, rx: {file: rx.csv}}\n"
        "city: {source: mesh, file: city.ply}\n"
        "access: {synchronisation: two_round}\n"
    )
    lines = complaints_of(file)
    assert [line.split(": ")[0].removeprefix(f"{file}:") for line in lines] == list("13354")
    for line, said in zip(
        lines,
        ("bandwidth_hz = -3", "tx.csv: cannot", "rx.csv: cannot", "two_round", "city.ply: no such"),
        strict=True,
    ):
        assert said in line


def complaints_of(file: Path) -> list[str]:
    with pytest.raises(ScenarioError) as caught:
        irt.load(file)
    return str(caught.value).splitlines()


def test_a_whole_scenario_is_judged_by_the_same_rules():
    """Planted bug: a rule left out of the list."""
    rules = {r.__name__ for r in Scenario.model_validate(BASE)._rules()}
    stated = {n for n in vars(Scenario) if n.endswith("_problems")}
    assert stated - rules == {"_code_problems", "_element_problems"}
