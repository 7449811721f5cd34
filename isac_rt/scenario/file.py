"""Scenario files: YAML <-> `Scenario`."""

from __future__ import annotations

import os
import re
import warnings
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any

import yaml

from isac_rt.document import TAG, Document, Loader, ScenarioWarning
from isac_rt.scenario.doubts import doubts
from isac_rt.scenario.tables import with_tables
from isac_rt.scenario.tree import Scenario
from isac_rt.settings import Problem, plain_tree


def load(
    path: str | os.PathLike[str] | Mapping[str, Any],
    overrides: Iterable[str] = (),
    frames: int | None = None,
    seed: int | None = None,
    *,
    without_removed: bool = False,
) -> Scenario:
    """Read and check a scenario.

    Parameters
    ----------
    path : path of the YAML file, or a mapping with the same keys; files that it names are relative
        to its folder, or to the working folder
    overrides : of the form "radio.groups=2", as after --set; the value is YAML
    frames, seed : replace the file's, as --frames and --seed do
    without_removed : leave out keys and values that earlier versions had, instead of refusing them

    Returns
    -------
    scenario : Scenario

    Raises
    ------
    ScenarioError
        With one line per problem, at most `isac_rt.document.MAX_MESSAGES`.

    Warns
    -----
    ScenarioWarning
        About values that look as if their unit were another.

    Examples
    --------
    >>> load("scenes/street_canyon.yaml", ["noise.tx_power_dbm=3"], frames=4).noise.tx_power_dbm
    3.0
    >>> radar = {"role": "active", "position_m": (0, 0, 30)}
    >>> load({"sensor": "awr1843", "swarm": {"radar": radar}}).radio.mode
    'fmcw'
    """
    if isinstance(path, Mapping):
        document = Document.of_tree(path)
    else:
        document = Document(Path(path), "a scenario needs at least a swarm")
        if re.fullmatch("[A-Za-z0-9_-]{1,100}", document.path.stem):
            document.data.setdefault("name", document.path.stem)
    if without_removed:
        document.drop_removed(Scenario)
    for override in [overrides] if isinstance(overrides, str) else overrides:
        document.override(override)
    for name, value in (("frames", frames), ("seed", seed)):
        if value is not None:
            document.data[name] = value
            document.places[(name,)] = f"--{name} {value}"
    folder = Path() if isinstance(path, Mapping) else document.path.parent
    tables: list[Problem] = []
    document.data = with_tables(document.data, folder, faults=tables)
    missing = list(_missing_files(document.data, folder))
    scenario = document.check(Scenario, tables, missing).in_folder(folder)
    for doubt in doubts(scenario):
        warnings.warn(document.complaint(doubt), ScenarioWarning, stacklevel=2)
    return scenario


def _missing_files(tree: Mapping[str, Any], folder: Path) -> Iterator[Problem]:
    """List files that a tree names and that are none."""
    swarm = tree.get("swarm")
    uavs = swarm.items() if isinstance(swarm, dict) else ()
    terminals = [(("swarm", name), uav) for name, uav in uavs if isinstance(uav, dict)]
    for at, above in [((), tree), *terminals]:
        for node, key, make in (
            ("city", "file", "the path is relative to the scenario's folder"),
            ("radio", "calibration", "make one with isac-rt calibrate --out {}"),
        ):
            here = above.get(node)
            name = here.get(key) if isinstance(here, dict) else None
            if isinstance(name, str) and not os.path.isfile(folder / name):
                message = f"no such file in {folder}; {make.format(folder / name)}"
                yield Problem(((*at, node, key),), message)


def folded_tree(scenario: Scenario, keys: Iterable[str]) -> dict[str, Any]:
    """A scenario as plain values, in which the formations that `keys` name stand as they were
    stated, so that these keys can be replaced; `isac_rt.scenario.swarm.unfolded` undoes it. What a
    sensor that they name filled in is left out.

    Parameters
    ----------
    keys : dotted, such as swarm.U.formation.spacing_m
    """
    tree: dict[str, Any] = plain_tree(scenario)
    named = {key.split(".")[1] for key in keys if key.startswith("swarm.")}
    swarm: dict[str, Any] = {}
    members = {
        f"{name}_{i}": name
        for name, formation in scenario.formations.items()
        if name in named
        for i in range(1, formation.count + 1)
    }
    for key, uav in tree["swarm"].items():
        name = members.get(key, key)
        if name not in swarm:
            swarm[name] = uav
            if name != key:
                swarm[name] = {**uav, "formation": plain_tree(scenario.formations[name])}
    for key in keys:
        path = key.split(".")
        if path == ["sensor"]:
            tree = _without_sensor(tree)
        elif path[-1] == "sensor" and path[1] in swarm:
            swarm[path[1]] = _without_sensor(swarm[path[1]])
    return {**tree, "swarm": swarm}


def _without_sensor(node: dict[str, Any]) -> dict[str, Any]:
    """Return a scenario or a terminal as plain values without those of its sensor, or the
    defaults where it has none."""
    radar = {"role": "active", "position_m": [0.0, 0.0, 1.0]}
    usual = Scenario.model_validate({"sensor": node.get("sensor"), "swarm": {"radar": radar}})
    out, filled = dict(node), plain_tree(usual)
    for part in ("radio", "array", "noise"):
        stated = out.get(part, {}).items()
        out[part] = {key: value for key, value in stated if filled[part].get(key) != value}
    return out


class _Dumper(yaml.SafeDumper):
    """Short lists on one line, and no word that a YAML 1.1 or 1.2 reader takes for a number."""

    def ignore_aliases(self, data: Any) -> bool:
        return True


def _float_node(dumper: yaml.SafeDumper, value: float) -> yaml.Node:
    # repr gives the shortest digits that read back as the same float64; YAML 1.1 readers want a
    # point and a sign in 7.7e+10
    text = repr(value)
    if "e" in text and "." not in text:
        text = text.replace("e", ".0e")
    return dumper.represent_scalar(f"{TAG}float", re.sub(r"e(\d)", r"e+\1", text))


def _list_node(dumper: yaml.SafeDumper, value: list[Any]) -> yaml.Node:
    flat = not any(isinstance(item, dict | list) for item in value)
    return dumper.represent_sequence(f"{TAG}seq", value, flow_style=flat)


_Dumper.yaml_implicit_resolvers = {
    first: yaml.SafeDumper.yaml_implicit_resolvers.get(first, [])
    + Loader.yaml_implicit_resolvers.get(first, [])
    for first in {*yaml.SafeDumper.yaml_implicit_resolvers, *Loader.yaml_implicit_resolvers}
}
_Dumper.add_representer(float, _float_node)
_Dumper.add_representer(list, _list_node)


def to_yaml(scenario: Scenario, folder: str | os.PathLike[str] | None = None) -> str:
    """The whole scenario as YAML, defaults included; `load` reads the same tree back.

    Parameters
    ----------
    scenario : Scenario
    folder : where the text will be saved, if not beside the original: `city.file` and
        `radio.calibration` are then written relative to it

    Returns
    -------
    text : str
    """
    data = plain_tree(scenario)
    if folder is not None and scenario.city is not None and scenario.city.file is not None:
        data["city"]["file"] = os.path.relpath(scenario.city_path(), folder)
    for radio in (data["radio"], *(u["radio"] for u in data["swarm"].values() if "radio" in u)):
        if folder is not None and radio.get("calibration") is not None:
            radio["calibration"] = os.path.relpath(scenario.folder / radio["calibration"], folder)
    return yaml.dump(data, Dumper=_Dumper, sort_keys=False, allow_unicode=True, width=120)
