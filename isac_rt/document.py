"""YAML documents: plain values, where each of them stands, and complaints that say so.

Every complaint says where the value stands (file and line, or the command line's option), the key,
the value, what is wrong with it and what to do. Numbers are read as in YAML 1.2 (77e9 is a number,
010 is ten, yes is a word). PyYAML composes the nodes: ruamel.yaml would tell lines and duplicate
keys too, but neither places that are options nor how far aliases unfold.
"""

from __future__ import annotations

import difflib
import numbers
import re
import typing
from collections.abc import Iterable, Mapping, Sequence, Set
from pathlib import Path, PurePath
from typing import Any

import yaml
from pydantic import BaseModel, ValidationError

from isac_rt.runtime import UserError
from isac_rt.settings import Key, Node, Problem, dotted

Tree = typing.TypeVar("Tree", bound=Node)

_OF_A_TYPE = re.compile(r"\[key\]$|function-\w+\[\w+\(\)|literal\[|constrained-str$")
"""What pydantic puts between keys: of a mapping's key, and of each type that a value may have."""
MAX_MESSAGES = 10
MAX_BYTES = 4_000_000
MAX_NODES = 200_000
MAX_DEPTH = 40
TAG = "tag:yaml.org,2002:"
SCALARS = (
    ("null", r"~|null|Null|NULL|", ["~", "n", "N", ""]),
    ("bool", r"true|True|TRUE|false|False|FALSE", list("tTfF")),
    ("int", r"[-+]?[0-9]+|0x[0-9a-fA-F]+", list("-+0123456789")),
    (
        "float",
        r"[-+]?(\.[0-9]+|[0-9]+(\.[0-9]*)?)([eE][-+]?[0-9]+)?|[-+]?\.(inf|Inf|INF)|\.(nan|NaN|NAN)",
        list("-+.0123456789"),
    ),
)
"""YAML 1.2's plain scalars that are no words: name, pattern, first characters."""


class ScenarioWarning(UserWarning):
    """The scenario can be used, but a value looks as if it were in another unit."""


class ScenarioError(UserError):
    """The scenario cannot be used; the text is meant for the person who wrote it, one line per
    problem."""


# ---- YAML


if typing.TYPE_CHECKING:
    _SafeLoader = yaml.SafeLoader
else:  # by libyaml, where PyYAML was built with it
    _SafeLoader = getattr(yaml, "CSafeLoader", yaml.SafeLoader)


class Loader(_SafeLoader):
    """Composes at most `MAX_NODES` nodes; only `SCALARS` are told from words."""

    nodes = depth = 0

    def descend_resolver(self, parent: yaml.Node | None, index: Any) -> None:
        """Called before each node."""
        self.nodes += 1
        self.depth += 1
        if self.depth > 2 * MAX_DEPTH:
            raise yaml.YAMLError(f"nested more than {MAX_DEPTH} levels deep")
        if self.nodes > MAX_NODES:
            raise yaml.YAMLError(f"more than {MAX_NODES} values; is it the right file?")
        super().descend_resolver(parent, index)

    def ascend_resolver(self) -> None:
        self.depth -= 1
        super().ascend_resolver()


Loader.yaml_implicit_resolvers = {}
for _name, _pattern, _first in SCALARS:
    Loader.add_implicit_resolver(TAG + _name, re.compile(f"^(?:{_pattern})$"), _first)


def _fault(node: yaml.Node, text: str) -> yaml.MarkedYAMLError:
    return yaml.MarkedYAMLError(problem=text, problem_mark=node.start_mark)


def _scalar(node: yaml.ScalarNode) -> Any:
    kind, text = node.tag.removeprefix(TAG), node.value
    try:
        match kind:
            case "str":
                return text
            case "null":
                return None
            case "bool":
                return text.lower() == "true"
            case "int":
                return int(text, 16 if text.startswith("0x") else 10)
            case "float":
                return float(re.sub(r"\.(?=inf|nan)", "", text.lower()))
    except ValueError as error:
        raise _fault(node, f"{text[:40]!r} is not a number that can be read") from error
    raise _fault(node, f"the tag {node.tag!r} is not allowed; write a plain value")


class _Reader:
    """Nodes to plain values, noting where each key stands. Aliases count each time they are used,
    so that none can explode."""

    def __init__(self, place: str | None) -> None:
        self.places: dict[Key, str | int] = {}
        self._place = place
        self._left = MAX_NODES

    def parse(self, text: str, key: Key = ()) -> Any:
        """The value of a YAML text; None if it is empty. Raises yaml.YAMLError."""
        node = yaml.compose(text, Loader=Loader)
        return None if node is None else self._value(node, key, 0)

    def _value(self, node: yaml.Node, key: Key, depth: int) -> Any:
        self._left -= 1
        if self._left < 0 or depth > MAX_DEPTH:
            limit = f"{MAX_NODES} values" if self._left < 0 else f"{MAX_DEPTH} levels"
            raise _fault(node, f"more than {limit}; are aliases repeated or nested?")
        self.places.setdefault(key, self._place or node.start_mark.line + 1)
        if isinstance(node, yaml.ScalarNode):
            return _scalar(node)
        if isinstance(node, yaml.SequenceNode) and node.tag == f"{TAG}seq":
            return [self._value(item, (*key, i), depth + 1) for i, item in enumerate(node.value)]
        if isinstance(node, yaml.MappingNode) and node.tag == f"{TAG}map":
            return self._mapping(node, key, depth)
        raise _fault(node, f"the tag {node.tag!r} is not allowed; write plain values")

    def _mapping(self, node: yaml.MappingNode, key: Key, depth: int) -> dict[str, Any]:
        values: dict[str, Any] = {}
        merged = self._merged(node, key, depth)
        for name, item in node.value:
            if _merges(name):
                continue
            if not isinstance(name, yaml.ScalarNode):
                raise _fault(name, "a key must be a word")
            below = (*key, name.value)
            if name.value in values:
                first = self.places[below]
                message = f"stands here a second time (first in line {first}); remove one"
                raise _fault(name, f"the key {dotted(below)} {message}")
            self.places[below] = self._place or name.start_mark.line + 1
            values[name.value] = self._value(item, below, depth + 1)
        return merged | values

    def _merged(self, node: yaml.MappingNode, key: Key, depth: int) -> dict[str, Any]:
        """Return the keys that a mapping takes from others by its key `<<`; the first of a list
        wins."""
        merged: dict[str, Any] = {}
        for name, item in node.value:
            if not _merges(name):
                continue
            sources = item.value if isinstance(item, yaml.SequenceNode) else [item]
            for source in sources:
                values = self._value(source, key, depth + 1)
                if not isinstance(values, dict):
                    raise _fault(source, "what << takes over must be a mapping, such as *name")
                merged = values | merged
        return merged


def _merges(name: yaml.Node) -> bool:
    """Tell whether a key is YAML's `<<`."""
    return isinstance(name, yaml.ScalarNode) and name.value == "<<" and not name.style


def _plain(value: Any, key: Key, depth: int) -> Any:
    """A value from Python as YAML would have given it."""
    if depth > MAX_DEPTH:
        raise ScenarioError(f"load: {dotted(key[:3])}: nested more than {MAX_DEPTH} levels deep")
    if isinstance(value, Node):
        value = {k: v for k, v in value if k in value.model_fields_set}
    if isinstance(value, Mapping):
        return {str(k): _plain(v, (*key, str(k)), depth + 1) for k, v in value.items()}
    if value is None or isinstance(value, bool | str):
        return value
    if isinstance(value, PurePath):
        return str(value)
    if isinstance(value, numbers.Real):  # numpy's too
        return int(value) if isinstance(value, numbers.Integral) else float(value)
    if isinstance(value, Iterable) and not isinstance(value, bytes | Set):
        return [_plain(v, (*key, i), depth + 1) for i, v in enumerate(value)]
    raise ScenarioError(
        f"load: {dotted(key)}: {type(value).__name__} is no value of a scenario; give mappings, "
        "lists, numbers and words"
    )


def _yaml_complaint(error: yaml.YAMLError, text: str) -> tuple[int | None, str]:
    """Line and wording of what PyYAML or `_Reader` did not like."""
    if isinstance(error, yaml.MarkedYAMLError):
        mark = error.problem_mark or error.context_mark
        message = error.problem or error.context or "cannot be read"
        lines = text.split("\n")
        if mark and mark.line < len(lines) and lines[mark.line][mark.column :].startswith("\t"):
            message = "a tab stands where YAML wants spaces; indent with spaces"
        elif error.context and error.problem_mark is not None and error.context not in message:
            message = f"{message} ({error.context})"
        return (mark.line + 1 if mark else None), message
    if isinstance(error, yaml.reader.ReaderError):
        at = yaml.reader.Reader.NON_PRINTABLE.search(text)
        assert at is not None
        character, line = f"#x{ord(at[0]):04x}", text.count("\n", 0, at.start()) + 1
        return line, f"the character {character} is not allowed in YAML; remove it"
    return None, str(error)


def _text_of(path: Path) -> str:
    """The characters of a file, or the reason why there are none."""
    if path.is_dir():
        raise ScenarioError(f"{path}: is a folder; name the scenario file in it")
    if not path.exists():
        names = [p.name for p in path.parent.glob("*.y*ml")]
        near = difflib.get_close_matches(path.name, names, n=1)
        hint = f"did you mean {path.parent / near[0]}?" if near else "check the path"
        raise ScenarioError(f"{path}: no such file; {hint}")
    if not path.is_file():
        raise ScenarioError(f"{path}: is not a regular file; name a scenario file")
    try:
        size = path.stat().st_size
        if size > MAX_BYTES:
            message = f"has {size} bytes, a scenario has at most {MAX_BYTES}; is it the right file?"
            raise ScenarioError(f"{path}: {message}")
        data = path.read_bytes()
    except OSError as error:
        message = f"cannot be read: {error.strerror}; check its permissions"
        raise ScenarioError(f"{path}: {message}") from None
    try:
        return data.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        line = data.count(b"\n", 0, error.start) + 1
        raise ScenarioError(
            f"{path}:{line}: byte 0x{data[error.start]:02x} is not UTF-8; save the file as UTF-8"
        ) from None


# ---- documents


class Document:
    """The mapping that a YAML file holds, with what options replace in it.

    Parameters
    ----------
    path : of the file
    needs : what to say of an empty file

    Attributes
    ----------
    data : the values
    places : by key the line it stands in, or the option that set it

    Raises
    ------
    ScenarioError
        If the file is none or holds no mapping.
    """

    def __init__(self, path: Path, needs: str) -> None:
        text, reader = _text_of(path), _Reader(None)
        try:
            data = reader.parse(text)
        except yaml.YAMLError as error:
            line, message = _yaml_complaint(error, text)
            raise ScenarioError(f"{path}{f':{line}' if line else ''}: {message}") from None
        if data is None:
            raise ScenarioError(f"{path}: is empty; {needs}")
        if not isinstance(data, dict):
            message = f"must be a mapping of keys ({needs}), not {_shown(data)}"
            raise ScenarioError(f"{path}:{reader.places[()]}: {message}")
        self.path = path
        self.data: dict[str, Any] = data
        self.places = reader.places

    def drop_removed(self, root: type[BaseModel]) -> None:
        """Rename or take out the keys and values of earlier versions that the nodes of `root`
        list."""

        def drop(tree: dict[str, Any], at: tuple[str, ...]) -> None:
            for name, value in list(tree.items()):
                instead = _instead_of_removed(root, (*at, name), value)
                if instead in _names_allowed(root, at):
                    tree[instead] = tree.pop(name)
                elif instead is not None:
                    del tree[name]
                elif isinstance(value, dict):
                    drop(value, (*at, name))

        drop(self.data, ())

    @classmethod
    def of_tree(cls, tree: Mapping[str, Any]) -> Document:
        """The document of a mapping made in Python, from the working folder.

        Raises
        ------
        ScenarioError  If it holds anything but mappings, lists, numbers and words.
        """
        document = cls.__new__(cls)
        document.path, document.places = Path(), {(): "load"}
        document.data = _plain(tree, (), 0)
        return document

    def override(self, text: str) -> None:
        """Replace a value as --set does: `text` is "key=value", the value YAML.

        Raises
        ------
        ScenarioError
        """
        option = f"--set {text}"
        name, equals, written = text.partition("=")
        parts = name.strip().split(".")
        if not equals or "" in parts:
            message = "must be key=value, with a dotted key such as radio.groups=2"
            raise ScenarioError(f"{option}: {message}")
        reader = _Reader(option)
        try:
            value = reader.parse(written, tuple(parts))
        except yaml.YAMLError as error:
            message = _yaml_complaint(error, written)[1]
            raise ScenarioError(f"{option}: the value cannot be read: {message}") from None
        here, key = self._locate(parts, option)
        here[key[-1]] = value
        for old in [at for at in self.places if at[: len(key)] == key]:
            del self.places[old]
        self.places |= {(*key, *at[len(key) :]): option for at in reader.places}
        self.places[key] = option

    def _locate(self, parts: list[str], option: str) -> tuple[Any, Key]:
        """The mapping or list that the last of the parts is in, and the key; mappings on the way
        are made."""
        here: Any = self.data
        key: Key = ()
        for i, part in enumerate(parts):
            if isinstance(here, list):
                if not part.isdecimal() or int(part) >= len(here):
                    raise ScenarioError(
                        f"{option}: {dotted(key)} is a list of {len(here)}; use an index from 0 to "
                        f"{len(here) - 1} below it"
                    )
                key = (*key, int(part))
            elif isinstance(here, dict):
                key = (*key, part)
            else:
                message = f"is {_shown(here)}, which has no keys below it; check the key"
                raise ScenarioError(f"{option}: {dotted(key)} {message}")
            if i + 1 < len(parts):
                if isinstance(here, dict) and here.get(part) is None:
                    here[part] = {}
                    self.places[key] = option
                here = here[key[-1]]
        return here, key

    def check(
        self, root: type[Tree], tables: Sequence[Problem] = (), files: Sequence[Problem] = ()
    ) -> Tree:
        """The values as a tree of class `root`.

        Parameters
        ----------
        root : class of the tree
        tables : problems of files whose numbers are missing in the mappings that name them
        files : problems of other files

        Raises
        ------
        ScenarioError
            With one line per problem, at most `MAX_MESSAGES`: all that can be judged, of rules
            between nodes those that read none that is malformed.
        """
        lines: dict[Any, str] = {}
        without = [key for problem in tables if (key := problem.keys[0][:-1])]
        broken = {str(key[0]) for key in without}
        try:
            tree = root.model_validate(self.data)
        except ValidationError as error:
            errors = [(_key_of(fault), fault) for fault in error.errors()]
            broken |= {str(key[0]) for key, _ in errors if key}
            for key, fault in errors:
                if (key or not broken) and not any(key[: len(of)] == of for of in without):
                    for about, line in self._complaints(root, key, fault):
                        lines.setdefault(about, line)
        else:
            if not tables and not files:
                return tree
        beside = root.checked_together(self.data, broken) if broken else []
        lines |= {problem: self.complaint(problem) for problem in (*tables, *beside, *files)}
        raise ScenarioError(few_lines(list(lines.values())))

    def complaint(self, problem: Problem, below: Key = ()) -> str:
        """Say what is wrong, with its place. The first key is named; the place is that of an option
        if one set any of the keys, else of the first key that the file holds."""
        return self._line([below + key for key in problem.keys], problem.text)

    def _line(self, keys: Sequence[Key], text: str) -> str:
        named = keys[0]
        options = [key for key in keys if isinstance(self.places.get(key), str)]
        present = [key for key in keys if _at(self.data, key) is not _NOWHERE]
        anchor = [*options, *present, named][0]
        above = (anchor[:n] for n in range(len(anchor), -1, -1))
        line = next(self.places[key] for key in above if key in self.places)
        value = _at(self.data, named)
        shown = "" if value is _NOWHERE or isinstance(value, dict) else f" = {_shown(value)}"
        if not isinstance(line, str):
            return f"{self.path}:{line}: {dotted(named)}{shown}: {text}"
        named_already = line.startswith((f"--set {dotted(named)}=", f"--{dotted(named)} "))
        return f"{line}: {text}" if named_already else f"{line}: {dotted(named)}{shown}: {text}"

    def _complaints(self, root: type[Node], key: Key, error: Any) -> list[tuple[Any, str]]:
        """Return the complaints of a finding of a validation, each with what it is about."""
        if error["type"] == "inconsistent":
            return [((key, p), self.complaint(p, key)) for p in error["ctx"]["problems"]]
        at = key[:-1] if error["type"] == "missing" and isinstance(key[-1], int) else key
        return [(key, self._line([at], _said(root, key, error)))]


def few_lines(lines: Sequence[str]) -> str:
    """Return lines of a message, at most `MAX_MESSAGES` of them."""
    more = len(lines) - MAX_MESSAGES
    return "\n".join([*lines[:MAX_MESSAGES], *([f"... and {more} more"] if more > 0 else [])])


def first_complaint(root: type[Node], error: ValidationError) -> str:
    """Return the first finding of a validation of `root` in one line, with its key."""
    found = error.errors()[0]
    key = _key_of(found)
    if found["type"] == "inconsistent":
        problem = found["ctx"]["problems"][0]
        return f"{dotted(key + problem.keys[0])}: {problem.text}"
    return f"{dotted(key)}: {_said(root, key, found)}"


def _key_of(error: Any) -> Key:
    """Return the key of what pydantic found."""
    return tuple(part for part in error["loc"] if not _OF_A_TYPE.match(str(part)))


def _said(root: type[Node], key: Key, found: Any) -> str:
    """Say in plain words what pydantic found."""
    kind = found["type"]
    instead = _instead_of_removed(root, key, found["input"])
    if instead is not None:
        renamed = instead in _names_allowed(root, key[:-1])
        return f"renamed; write {instead}" if renamed else f"removed in this version; {instead}"
    if kind == "extra_forbidden":
        allowed = _names_allowed(root, key[:-1])
        near = difflib.get_close_matches(str(key[-1]), allowed, n=1, cutoff=0.6)
        guess = f"did you mean {near[0]}? " if near else ""
        return f"unknown key; {guess}allowed here: {', '.join(allowed)}"
    if kind == "missing":
        few = isinstance(key[-1], int)
        few_said = f"has too few numbers, it needs more than {key[-1]}"
        return few_said if few else "missing, and it has no default; add it"
    if kind in ("model_type", "model_attributes_type", "dict_type"):
        allowed = _names_allowed(root, key)
        return f"must be a mapping{' with keys out of ' + ', '.join(allowed) if allowed else ''}"
    if kind == "string_pattern_mismatch":
        return "a name may hold letters, digits, _ and - only; rename it"
    if kind == "value_error":
        return str(found["ctx"]["error"])
    message = found["msg"].split(", unable to parse")[0]
    for theirs, ours in (
        ("Input should be", "must be"),
        ("Tuple should have", "must have"),
        ("String should have", "must have"),
        ("'", ""),
        ("must be a valid ", "must be a "),
        ("a integer", "an integer"),
        ("tuple", "list"),
    ):
        message = message.replace(theirs, ours)
    return message


def _shown(value: Any) -> str:
    """A value as a person would have written it, at most 60 characters."""
    if value is None:
        return "null (empty)"
    if isinstance(value, bool):
        return str(value).lower()
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


def _names_allowed(root: type[BaseModel], key: Iterable[str | int]) -> list[str]:
    """Keys that a tree of class `root` knows in the mapping at `key`."""
    model = _model_at(root, key)
    return list(model.model_fields) if model else []


def _instead_of_removed(root: type[BaseModel], key: Key, value: Any) -> str | None:
    """Return what to write instead of a key or a value that earlier versions had."""
    model = _model_at(root, key[:-1]) if key else None
    if model is None or not issubclass(model, Node):
        return None
    return model.REMOVED.get(str(key[-1]), model.REMOVED.get(f"{key[-1]}: {value}"))


def _model_at(root: type[BaseModel], key: Iterable[str | int]) -> type[BaseModel] | None:
    """The class of the mapping at `key` in a tree of class `root`."""
    model, parts = root, iter(key)
    for part in parts:
        field = model.model_fields.get(str(part))
        inner, keyed = _models_in(field.annotation) if field else (None, False)
        if inner is None or (keyed and next(parts, None) is None):
            return None
        model = inner
    return model
