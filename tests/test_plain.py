"""Dataclasses as plain trees and back."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import Enum
from typing import Literal, NamedTuple

import numpy as np
import pytest

from isac_rt.plain import Stateful, plain, restored
from isac_rt.storage import pack, unpack


class Colour(Enum):
    RED = "red"


class Place(NamedTuple):
    x: float
    name: str | None


@dataclass(frozen=True)
class Leaf:
    place: Place
    values: np.ndarray
    mode: Literal["a", "b"] = "a"


@dataclass
class Tree:
    leaf: Leaf | None
    by_place: dict[Place, tuple[Leaf, str]]
    named: Mapping[str, list[int]]
    several: tuple[Leaf, ...]
    numbers: set[int]
    colour: Colour = Colour.RED


def leaf(x: float) -> Leaf:
    return Leaf(Place(x, None), np.array([[x, -3.7], [np.nan, np.inf]]), "b")


def through_a_file(value):
    return unpack(*pack(plain(value)))


def test_a_tree_of_all_kinds_comes_back():
    """By way of what is written to files. Planted bugs: the arguments of a mapping exchanged; a
    tuple that comes back as a list; None taken for a value."""
    tree = Tree(
        leaf(1.3), {Place(2.9, "n"): (leaf(-0.7), "via")}, {"a": [7, 3]}, (leaf(4.1),), {11, 5}
    )
    found = restored(Tree, through_a_file(tree))
    assert pack(plain(found)) == pack(plain(tree))
    assert isinstance(found.several, tuple) and isinstance(found.by_place[Place(2.9, "n")], tuple)
    assert found.numbers == {5, 11} and found.colour is Colour.RED
    assert found.leaf is not None and found.leaf.place == Place(1.3, None)
    assert restored(Tree, through_a_file(Tree(None, {}, {}, (), set()))).leaf is None


@pytest.mark.parametrize(
    "bent", [{"leaf": 3.0}, {"colour": "blue"}, {"numbers": 4}, {"by_place": [[1.0]]}, None]
)
def test_what_does_not_fit_is_refused(bent):
    whole = plain(Tree(None, {}, {}, (), set()))
    with pytest.raises((LookupError, TypeError, ValueError)):
        restored(Tree, {} if bent is None else whole | bent)


@dataclass
class Count:
    seen: dict[int, float] = field(default_factory=dict)


class Counter(Stateful):
    def __init__(self) -> None:
        self.state = Count()


@dataclass
class Notes(Stateful):
    told: list[Place] = field(default_factory=list)


class Whole(Stateful):
    def __init__(self) -> None:
        self.counter, self.notes = Counter(), Notes()

    @property
    def parts(self):
        return {"counter": self.counter, "notes": self.notes, "none": None}


def test_an_object_goes_on_with_its_parts():
    """Planted bugs: parts left out; a dataclass's own fields left out."""
    one, again = Whole(), Whole()
    one.counter.state.seen[4] = 2.5
    one.notes.told.append(Place(3.1, "p"))
    again.restore(through_a_file(one.memory()))
    assert again.counter.state == Count({4: 2.5})
    assert again.notes.told == [Place(3.1, "p")]
