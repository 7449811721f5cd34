"""Dataclasses as plain trees and back, and what an object carries over from frame to frame.

A plain tree holds numbers, words, lists, mappings with words for keys, and arrays: what
`isac_rt.storage` writes. It never holds code.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence, Set
from dataclasses import fields, is_dataclass
from enum import Enum
from functools import lru_cache
from types import NoneType, UnionType
from typing import Any, Union, get_args, get_origin, get_type_hints

import numpy as np


def plain(value: Any) -> Any:
    """Take a value apart: dataclasses become mappings, named tuples lists, sets sorted lists, and
    mappings with other keys than words lists of pairs.

    Examples
    --------
    >>> from isac_rt.frame.link import Link
    >>> plain({Link("AT", "PT1"): {3, 1}})
    [[['AT', 'PT1'], [1, 3]]]
    """
    if is_dataclass(value):
        return {f.name: plain(getattr(value, f.name)) for f in fields(value) if f.init}
    if isinstance(value, Enum):
        return value.value
    if isinstance(value, Mapping):
        if all(isinstance(key, str) for key in value):
            return {key: plain(item) for key, item in value.items()}
        return [[plain(key), plain(item)] for key, item in value.items()]
    if isinstance(value, Set):
        return [plain(item) for item in sorted(value)]
    if isinstance(value, list | tuple):
        return [plain(item) for item in value]
    return value


def restored(kind: Any, tree: Any) -> Any:
    """Build the value of a type hint that `plain` took apart.

    Raises
    ------
    LookupError, TypeError, ValueError  If the tree does not fit the type.

    Examples
    --------
    >>> from isac_rt.frame.link import Link
    >>> restored(dict[Link, set[int]], [[["AT", "PT1"], [1, 3]]])
    {Link(tx='AT', rx='PT1'): {1, 3}}
    """
    origin, of = get_origin(kind), get_args(kind)
    if origin in (Union, UnionType):
        (known,) = (one for one in of if one is not NoneType)
        return None if tree is None else restored(known, tree)
    if not isinstance(origin, type):
        return _restored_class(kind, tree)
    if issubclass(origin, Mapping):
        pairs = tree.items() if isinstance(tree, Mapping) else tree
        return {restored(of[0], key): restored(of[1], item) for key, item in pairs}
    if origin is tuple and of[-1] is not Ellipsis:
        return tuple(restored(one, item) for one, item in zip(of, tree, strict=True))
    if issubclass(origin, np.ndarray):
        return tree
    if issubclass(origin, Set):
        return {restored(of[0], item) for item in tree}
    if issubclass(origin, Sequence):
        items = [restored(of[0], item) for item in tree]
        return tuple(items) if origin is tuple else items
    raise TypeError(f"{kind} cannot be restored")


def _restored_class(kind: Any, tree: Any) -> Any:
    """`restored` of a class without parameters."""
    if not isinstance(kind, type):
        return tree
    if is_dataclass(kind):
        hints, names = _hints(kind), [f.name for f in fields(kind) if f.init]
        return kind(**{name: restored(hints[name], tree[name]) for name in names})
    if issubclass(kind, Enum):
        return kind(tree)
    if issubclass(kind, tuple):  # with named fields
        return kind(*map(restored, _hints(kind).values(), tree))
    return tree


@lru_cache(maxsize=256)
def _hints(kind: type) -> dict[str, Any]:
    """Type hints of a class, by field."""
    return get_type_hints(kind)


class Stateful:
    """An object that goes on from frame to frame. It carries over all its fields if it is a
    dataclass itself, else its `state`, and what its parts carry over.

    Attributes
    ----------
    state : dataclass; None: all is in the parts
    """

    state: Any = None

    @property
    def parts(self) -> Mapping[str, Stateful | None]:
        """Parts that carry over something themselves, by name; None: not there in this run."""
        return {}

    def memory(self) -> dict[str, Any]:
        """Return what is carried over as a plain tree."""
        state = self if is_dataclass(self) else self.state
        tree = {} if state is None else {"state": plain(state)}
        return tree | {name: one.memory() for name, one in self.parts.items() if one is not None}

    def restore(self, memory: Mapping[str, Any]) -> None:
        """Go on from a `memory`."""
        if is_dataclass(self):
            vars(self).update(vars(restored(type(self), memory["state"])))
        elif self.state is not None:
            self.state = restored(type(self.state), memory["state"])
        for name, one in self.parts.items():
            if one is not None:
                one.restore(memory[name])
