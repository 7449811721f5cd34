"""Scenario files: YAML <-> `Scenario`. The only module that knows YAML.

Every complaint says where the value stands (file and line, or the command line's option), the key,
the value, what is wrong with it and what to do. Numbers are read as in YAML 1.2 (77e9 is a number,
010 is ten, yes is a word).
"""

from __future__ import annotations

import difflib
import os
import re
import typing
import warnings
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import yaml
from pydantic import BaseModel, ValidationError

from isac_rt.runtime import UserError
from isac_rt.scenario.node import Key, Node, Problem, dotted
from isac_rt.scenario.tree import Scenario

Tree = typing.TypeVar("Tree", bound=Node)

MAX_MESSAGES = 10
MAX_BYTES = 4_000_000
MAX_NODES = 200_000
MAX_DEPTH = 40


class ScenarioError(UserError):
    """The scenario cannot be used; the text is meant for the person who wrote it, one line per
    problem."""


class ScenarioWarning(UserWarning):
    """The scenario can be used, but a value looks as if it were in another unit."""


# ---- YAML


class _Loader(yaml.SafeLoader):
    """Composes nodes; only YAML 1.2's plain scalars are told from words."""


_Loader.yaml_implicit_resolvers = {}
for _tag, _pattern, _first in (
    ("null", r"~|null|Null|NULL|", ["~", "n", "N", ""]),
    ("bool", r"true|True|TRUE|false|False|FALSE", list("tTfF")),
    ("int", r"[-+]?[0-9]+|0x[0-9a-fA-F]+", list("-+0123456789")),
    (
        "float",
        r"[-+]?(\.[0-9]+|[0-9]+(\.[0-9]*)?)([eE][-+]?[0-9]+)?|[-+]?\.(inf|Inf|INF)|\.(nan|NaN|NAN)",
        list("-+.0123456789"),
    ),
):
    _Loader.add_implicit_resolver(
        f"tag:yaml.org,2002:{_tag}", re.compile(f"^(?:{_pattern})$"), _first
    )


def _scalar(node: yaml.ScalarNode) -> Any:
    kind, text = node.tag.removeprefix("tag:yaml.org,2002:"), node.value
    if kind == "str":
        return text
    if kind == "null":
        return None
    if kind == "bool":
        return text.lower() == "true"
    try:
        if kind == "int":
            return int(text, 16 if text.startswith("0x") else 10)
        if kind == "float":
            return float(
                text.replace(".inf", "inf").replace(".nan", "nan")
                if text.lower().endswith(("inf", "nan"))
                else text
            )
    except ValueError as error:
        raise yaml.MarkedYAMLError(
            problem=f"{text[:40]!r} is not a number that can be read", problem_mark=node.start_mark
        ) from error
    raise yaml.MarkedYAMLError(
        problem=f"the tag {node.tag!r} is not allowed; write a plain value",
        problem_mark=node.start_mark,
    )


class _Reader:
    """Nodes to plain values, noting where each key stands. Aliases count each time they are used,
    so that none can explode."""

    def __init__(self, place: str | None) -> None:
        self.places: dict[Key, str | int] = {}
        self._place = place
        self._left = MAX_NODES

    def value(self, node: yaml.Node, key: Key, depth: int = 0) -> Any:
        self._left -= 1
        if self._left < 0 or depth > MAX_DEPTH:
            limit = f"{MAX_NODES} values" if self._left < 0 else f"{MAX_DEPTH} levels"
            raise yaml.MarkedYAMLError(
                problem=f"more than {limit}; are aliases repeated or nested?",
                problem_mark=node.start_mark,
            )
        self.places.setdefault(key, self._place or node.start_mark.line + 1)
        if isinstance(node, yaml.ScalarNode):
            return _scalar(node)
        if isinstance(node, yaml.SequenceNode) and node.tag == "tag:yaml.org,2002:seq":
            return [self.value(item, (*key, i), depth + 1) for i, item in enumerate(node.value)]
        if isinstance(node, yaml.MappingNode) and node.tag == "tag:yaml.org,2002:map":
            return self._mapping(node, key, depth)
        raise yaml.MarkedYAMLError(
            problem=f"the tag {node.tag!r} is not allowed; write plain values",
            problem_mark=node.start_mark,
        )

    def _mapping(self, node: yaml.MappingNode, key: Key, depth: int) -> dict[str, Any]:
        values: dict[str, Any] = {}
        for name, item in node.value:
            if not isinstance(name, yaml.ScalarNode):
                raise yaml.MarkedYAMLError(
                    problem="a key must be a word", problem_mark=name.start_mark
                )
            below = (*key, name.value)
            if name.value in values:
                problem = (
                    f"the key {dotted(below)} stands here a second time (first in line "
                    f"{self.places[below]}); remove one"
                )
                raise yaml.MarkedYAMLError(problem=problem, problem_mark=name.start_mark)
            self.places[below] = self._place or name.start_mark.line + 1
            values[name.value] = self.value(item, below, depth + 1)
        return values


def _parse(text: str, reader: _Reader, key: Key = ()) -> Any:
    """The value of a YAML text; None if it is empty. Raises yaml.YAMLError, also for what nests too
    deeply."""
    try:
        node = yaml.compose(text, Loader=_Loader)
    except RecursionError:
        raise yaml.YAMLError(f"nested more than {MAX_DEPTH} levels deep") from None
    return None if node is None else reader.value(node, key)


def _yaml_complaint(error: yaml.YAMLError, text: str) -> tuple[int | None, str]:
    """Line and wording of what PyYAML or `_Reader` did not like."""
    if isinstance(error, yaml.MarkedYAMLError):
        mark = error.problem_mark or error.context_mark
        said = error.problem or error.context or "cannot be read"
        if "'\\t'" in said:
            said = "a tab stands where YAML wants spaces; indent with spaces"
        elif error.context and error.problem_mark is not None and error.context not in said:
            said = f"{said} ({error.context})"
        return (mark.line + 1 if mark else None), said
    if isinstance(error, yaml.reader.ReaderError):
        line = text.count("\n", 0, error.position) + 1
        return (
            line,
            f"the character #x{ord(text[error.position]):04x} is not allowed in YAML; remove it",
        )
    return None, str(error)


def _text_of(path: Path) -> str:
    """The characters of a scenario file, or the reason why there are none."""
    if path.is_dir():
        raise ScenarioError(f"{path}: is a folder; name the scenario file in it")
    if not path.exists():
        near = difflib.get_close_matches(
            path.name, [p.name for p in path.parent.glob("*.y*ml")], n=1
        )
        hint = f"did you mean {path.parent / near[0]}?" if near else "check the path"
        raise ScenarioError(f"{path}: no such file; {hint}")
    if not path.is_file():
        raise ScenarioError(f"{path}: is not a regular file; name a scenario file")
    try:
        size = path.stat().st_size
        if size > MAX_BYTES:
            raise ScenarioError(
                f"{path}: has {size} bytes, a scenario has at most {MAX_BYTES}; is it the right "
                "file?"
            )
        data = path.read_bytes()
    except OSError as error:
        raise ScenarioError(
            f"{path}: cannot be read: {error.strerror}; check its permissions"
        ) from None
    try:
        return data.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        line = data.count(b"\n", 0, error.start) + 1
        raise ScenarioError(
            f"{path}:{line}: byte 0x{data[error.start]:02x} is not UTF-8; save the file as UTF-8"
        ) from None


# ---- overrides


def _set(
    data: dict[str, Any], places: dict[Key, str | int], option: str, key: Key, value: Any
) -> None:
    """Put one value into the tree, making the mappings on its way."""
    here: Any = data
    for depth, name in enumerate(key[:-1]):
        if isinstance(here, list):
            here = here[_index(here, key, depth, option)]
        else:
            if here.get(name) is None:
                here[name] = {}
                places[key[: depth + 1]] = option
            here = here[name]
        if not isinstance(here, dict | list):
            raise ScenarioError(
                f"{option}: {dotted(key[: depth + 1])} is {_shown(here)}, which has no keys below "
                "it; check the key"
            )
    last: Any = _index(here, key, len(key) - 1, option) if isinstance(here, list) else key[-1]
    here[last] = value


def _index(items: list[Any], key: Key, depth: int, option: str) -> int:
    name = key[depth]
    if isinstance(name, int) and name < len(items):
        return name
    raise ScenarioError(
        f"{option}: {dotted(key[:depth])} is a list of {len(items)}; use an index from 0 to "
        f"{len(items) - 1} below it"
    )


def _apply_override(data: dict[str, Any], places: dict[Key, str | int], text: str) -> None:
    option = f"--set {text}"
    name, equals, written = text.partition("=")
    if not equals or not name.strip() or "" in name.strip().split("."):
        raise ScenarioError(
            f"{option}: must be key=value, with a dotted key such as radio.groups=2"
        )
    key: Key = tuple(int(part) if part.isdecimal() else part for part in name.strip().split("."))
    reader = _Reader(option)
    try:
        value = _parse(written, reader, key)
    except yaml.YAMLError as error:
        raise ScenarioError(
            f"{option}: the value cannot be read: {_yaml_complaint(error, written)[1]}"
        ) from None
    # a mapping may have a key that looks like an index: a UAV named 7
    key = _as_present(data, key)
    for old in [place for place in places if place[: len(key)] == key]:
        del places[old]
    places |= {(*key, *place[len(key) :]): option for place in reader.places} | {key: option}
    _set(data, places, option, key, value)


def _as_present(data: Any, key: Key) -> Key:
    """The key with numbers only where the tree has lists."""
    parts: list[str | int] = []
    for part in key:
        listed = isinstance(data, list)
        parts.append(part if listed else str(part))
        if listed and isinstance(part, int) and part < len(data):
            data = data[part]
        else:
            data = data.get(str(part)) if isinstance(data, dict) else None
    return tuple(parts)


# ---- complaints


def _shown(value: Any) -> str:
    """A value as a person would have written it, at most 60 characters."""
    words = {None: "null (empty)", True: "true", False: "false"}
    if value is None or isinstance(value, bool):
        return words[value]
    text = "{...}" if isinstance(value, dict) else str(value)
    text = text if text.isprintable() and text else repr(value)
    return text if len(text) <= 60 else text[:57] + "..."


_NOWHERE = object()


def _at(data: Any, key: Key) -> Any:
    for part in key:
        try:
            data = data[part]
        except (KeyError, IndexError, TypeError):
            return _NOWHERE
    return data


def _models_in(annotation: Any) -> tuple[type[BaseModel] | None, bool]:
    """The tree's class that an annotation holds, and whether it holds it by name (dict) or index
    (tuple)."""
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return annotation, False
    origin = typing.get_origin(annotation)
    for argument in typing.get_args(annotation):
        model, keyed = _models_in(argument)
        if model is not None:
            return model, keyed or origin in (dict, tuple)
    return None, False


def _names_allowed(root: type[BaseModel], key: Key) -> list[str]:
    """Keys that a tree of class `root` knows in the mapping at `key`."""
    model = root
    parts = iter(key)
    for part in parts:
        inner, keyed = _models_in(model.model_fields[str(part)].annotation)
        if inner is None:
            return []
        if keyed and next(parts, None) is None:
            return []
        model = inner
    return list(model.model_fields)


class _Complaints:
    """Turns what is wrong with a tree into lines that say where."""

    def __init__(
        self, root: type[Node], path: Path, data: Any, places: dict[Key, str | int]
    ) -> None:
        self._root, self._path, self._data, self._places = root, path, data, places

    def line(self, keys: Sequence[Key], text: str) -> str:
        """One complaint. The first key is named; the place is that of an option if one set any of
        the keys, else of the first key that the file holds."""
        named = keys[0]
        options = [key for key in keys if isinstance(self._places.get(key), str)]
        anchor = (
            options or [key for key in keys if _at(self._data, key) is not _NOWHERE] or [named]
        )[0]
        value = _at(self._data, named)
        place = next(
            self._places[anchor[:n]]
            for n in range(len(anchor), -1, -1)
            if anchor[:n] in self._places
        )
        shown = "" if value is _NOWHERE or isinstance(value, dict) else f" = {_shown(value)}"
        if isinstance(place, str):  # an option
            named_already = place.startswith((f"--set {dotted(named)}=", f"--{dotted(named)} "))
            about = "" if named_already else f"{dotted(named)}{shown}: "
            return f"{place}: {about}{text}"
        return f"{self._path}:{place}: {dotted(named)}{shown}: {text}"

    def problem(self, problem: Problem, below: Key = ()) -> str:
        keys = [below + key for key in problem.keys]
        return self.line(keys, problem.text)

    def of(self, error: ValidationError) -> list[str]:
        """All complaints of a validation, in the order of the tree."""
        lines: dict[Any, str] = {}
        for found in error.errors():
            key: Key = tuple(part for part in found["loc"] if part != "[key]")
            if found["type"] == "inconsistent":
                for problem in found["ctx"]["problems"]:
                    lines[key, problem] = self.problem(problem, key)
            else:
                lines.setdefault(key, self._standard(key, found))
        return list(lines.values())

    def _standard(self, key: Key, found: Any) -> str:
        kind = found["type"]
        if kind == "extra_forbidden":
            allowed = _names_allowed(self._root, key[:-1])
            near = difflib.get_close_matches(str(key[-1]), allowed, n=1, cutoff=0.6)
            guess = f"did you mean {near[0]}? " if near else ""
            return self.line([key], f"unknown key; {guess}allowed here: {', '.join(allowed)}")
        if kind == "missing" and isinstance(key[-1], int):
            return self.line([key[:-1]], "has too few numbers")
        if kind == "missing":
            return self.line([key], "missing, and it has no default; add it")
        if kind in ("model_type", "model_attributes_type", "dict_type"):
            allowed = _names_allowed(self._root, key)
            return self.line(
                [key],
                f"must be a mapping{' with keys out of ' + ', '.join(allowed) if allowed else ''}",
            )
        if kind == "string_pattern_mismatch":
            return self.line([key], "a name may hold letters, digits, _ and - only; rename it")
        if kind == "value_error":
            return self.line([key], str(found["ctx"]["error"]))
        return self.line([key], _plain_words(found["msg"]))


def _plain_words(message: str) -> str:
    message = (
        message.split(", unable to parse")[0]
        .replace("Input should be", "must be")
        .replace("String should have", "must have")
        .replace("Tuple should have", "must have")
        .replace("'", "")
    )
    return (
        message.replace("must be a valid ", "must be a ")
        .replace("a integer", "an integer")
        .replace("tuple", "list")
    )


def _refuse(lines: Iterable[str]) -> None:
    lines = list(lines)
    if not lines:
        return
    more = [f"... and {len(lines) - MAX_MESSAGES} more"] if len(lines) > MAX_MESSAGES else []
    raise ScenarioError("\n".join([*lines[:MAX_MESSAGES], *more]))


# ---- what others call


def load(
    path: str | os.PathLike[str],
    overrides: Iterable[str] = (),
    frames: int | None = None,
    seed: int | None = None,
) -> Scenario:
    """Read and check a scenario.

    Parameters
    ----------
    path : path of the YAML file; `city.file` and `accuracy.cost_model` in it are relative to its
        folder
    overrides : of the form "radio.groups=2", as after --set; the value is YAML
    frames, seed : replace the file's, as --frames and --seed do

    Returns
    -------
    scenario : Scenario

    Raises
    ------
    ScenarioError
        With one line per problem, at most `MAX_MESSAGES`.

    Warns
    -----
    ScenarioWarning
        About values that look as if their unit were another.
    """
    path = Path(path)
    data, places = read_tree(path, "a scenario needs at least a swarm")
    for override in overrides:
        _apply_override(data, places, override)
    for name, value in (("frames", frames), ("seed", seed)):
        if value is not None:
            data[name] = value
            places[(name,)] = f"--{name} {value}"
    return _checked(path, data, places)


def read_tree(path: Path, needs: str) -> tuple[dict[str, Any], dict[Key, str | int]]:
    """The mapping that a YAML file holds, and the line of each of its keys; `needs` is what to say
    of an empty file.

    Raises
    ------
    ScenarioError
    """
    text = _text_of(path)
    reader = _Reader(None)
    try:
        data = _parse(text, reader)
    except yaml.YAMLError as error:
        line, said = _yaml_complaint(error, text)
        raise ScenarioError(f"{path}{f':{line}' if line else ''}: {said}") from None
    if data is None:
        raise ScenarioError(f"{path}: is empty; {needs}")
    if not isinstance(data, dict):
        raise ScenarioError(
            f"{path}:{reader.places[()]}: must be a mapping of keys ({needs}), not {_shown(data)}"
        )
    return data, reader.places


def check_tree(
    root: type[Tree], path: Path, data: dict[str, Any], places: dict[Key, str | int]
) -> Tree:
    """The mapping of a file as a tree of class `root`.

    Raises
    ------
    ScenarioError
        With one line per problem.
    """
    try:
        return root.model_validate(data)
    except ValidationError as error:
        _refuse(_Complaints(root, path, data, places).of(error))
        raise


def complain(
    root: type[Node],
    path: Path,
    data: dict[str, Any],
    places: dict[Key, str | int],
    problem: Problem,
) -> ScenarioError:
    """A problem found outside the tree's own checks, with the line of its key."""
    return ScenarioError(_Complaints(root, path, data, places).problem(problem))


def _checked(path: Path, data: dict[str, Any], places: dict[Key, str | int]) -> Scenario:
    scenario = check_tree(Scenario, path, data, places).in_folder(path.parent)
    complaints = _Complaints(Scenario, path, data, places)
    if (
        scenario.city is not None
        and scenario.city.file is not None
        and not scenario.city_path().is_file()
    ):
        said = f"no such file in {path.parent}; the path is relative to the scenario's folder"
        raise ScenarioError(complaints.line([("city", "file")], said))
    costs = scenario.cost_model_path()
    if costs is not None and not costs.is_file():
        said = f"no such file in {path.parent}; make one with isac-rt bench --fit {costs}"
        raise ScenarioError(complaints.line([("accuracy", "cost_model")], said))
    for doubt in scenario.doubts():
        warnings.warn(complaints.problem(doubt), ScenarioWarning, stacklevel=3)
    return scenario


def plain_tree(value: Any) -> Any:
    """A tree as lists, mappings and numbers, without the keys that have no meaning beside the
    others."""
    if isinstance(value, Node):
        fields = type(value).model_fields
        return {
            name: plain_tree(item)
            for name, item in value
            if value.applies(name) and not (item is None and fields[name].default is None)
        }
    if isinstance(value, dict):
        return {name: plain_tree(item) for name, item in value.items()}
    return [plain_tree(item) for item in value] if isinstance(value, tuple) else value


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
    return dumper.represent_scalar("tag:yaml.org,2002:float", re.sub(r"e(\d)", r"e+\1", text))


def _list_node(dumper: yaml.SafeDumper, value: list[Any]) -> yaml.Node:
    flat = not any(isinstance(item, dict | list) for item in value)
    return dumper.represent_sequence("tag:yaml.org,2002:seq", value, flow_style=flat)


_Dumper.yaml_implicit_resolvers = {
    first: yaml.SafeDumper.yaml_implicit_resolvers.get(first, [])
    + _Loader.yaml_implicit_resolvers.get(first, [])
    for first in {*yaml.SafeDumper.yaml_implicit_resolvers, *_Loader.yaml_implicit_resolvers}
}
_Dumper.add_representer(float, _float_node)
_Dumper.add_representer(list, _list_node)


def to_yaml(scenario: Scenario, folder: str | os.PathLike[str] | None = None) -> str:
    """The whole scenario as YAML, defaults included; `load` reads the same tree back.

    Parameters
    ----------
    scenario : Scenario
    folder : where the text will be saved, if not beside the original: `city.file` and
        `accuracy.cost_model` are then written relative to it

    Returns
    -------
    text : str
    """
    data = plain_tree(scenario)
    if folder is not None and scenario.city is not None and scenario.city.file is not None:
        data["city"]["file"] = os.path.relpath(scenario.city_path(), folder)
    costs = scenario.cost_model_path()
    if folder is not None and costs is not None:
        data["accuracy"]["cost_model"] = os.path.relpath(costs, folder)
    return yaml.dump(data, Dumper=_Dumper, sort_keys=False, allow_unicode=True, width=120)
