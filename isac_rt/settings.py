"""Frozen, checked settings: the class that every mapping of a scenario extends, its kinds of
numbers, and its complaints. The settings of a room stand in its `settings.py`."""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Set
from typing import Annotated, Any, ClassVar, NamedTuple

from pydantic import BaseModel, BeforeValidator, ConfigDict, Field, field_validator, model_validator
from pydantic_core import PydanticCustomError

Key = tuple[str | int, ...]


class Problem(NamedTuple):
    """Something that cannot stand: the keys that take part in it, the one to name first, and what
    to say."""

    keys: tuple[Key, ...]
    text: str


def dotted(key: Key) -> str:
    """swarm.PT1.position_m.2 for ("swarm", "PT1", "position_m", 2)."""
    return ".".join(map(str, key))


def _three_numbers(value: Any) -> Any:
    if not isinstance(value, list | tuple) or len(value) != 3:
        raise ValueError("must be three numbers [x, y, z]")
    return value


Finite = Annotated[float, Field(allow_inf_nan=False)]
Positive = Annotated[float, Field(gt=0, allow_inf_nan=False)]
Decibels = Annotated[float, Field(ge=-400, le=400, allow_inf_nan=False)]
Loss = Annotated[float, Field(ge=0, le=400, allow_inf_nan=False)]
"""Decibels beyond 400 are beyond any ratio of powers in nature, and overflow not far beyond."""
ClockDrift = Annotated[float, Field(ge=-1e3, le=1e3, allow_inf_nan=False)]
"""Microseconds per second."""
Seed = Annotated[int, Field(ge=0, lt=2**63)]
"""A whole number that results can keep."""
Name = Annotated[str, Field(pattern=r"^[A-Za-z0-9_-]+$", max_length=100)]
"""What may name a file, a folder or a terminal anywhere."""
Fraction = Annotated[float, Field(ge=0, le=1, allow_inf_nan=False)]
Vector = Annotated[tuple[Finite, Finite, Finite], BeforeValidator(_three_numbers)]


def _holds_bool(value: Any) -> bool:
    return isinstance(value, bool) or (
        isinstance(value, list | tuple) and any(map(_holds_bool, value))
    )


class Node(BaseModel):
    """One mapping of the tree."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)

    REMOVED: ClassVar[dict[str, str]] = {}
    """New name of, or remedy for, keys ("rays") and values ("model: diffuse") of earlier
    versions."""
    KEEPS_NULL: ClassVar[bool] = False
    """Whether a null that equals the default is written out, since a preset would fill it in."""

    @field_validator("*", mode="before")
    @classmethod
    def _no_truth_for_a_number(cls, value: Any, info: Any) -> Any:
        if cls.model_fields[info.field_name].annotation is not bool and _holds_bool(value):
            raise ValueError("true and false do not belong here")
        return value

    @model_validator(mode="after")
    def _consistent(self) -> Node:
        problems = list(self.problems())
        if problems:
            text = "; ".join(f"{dotted(p.keys[0])}: {p.text}" for p in problems)
            raise PydanticCustomError(
                "inconsistent", "{text}", {"text": text, "problems": problems}
            )
        return self

    def problems(self) -> Iterator[Problem]:
        """List contradictions within this mapping; keys are relative to it."""
        yield from ()

    @classmethod
    def checked_together(cls, data: Any, broken: Set[str]) -> list[Problem]:
        """List contradictions between the fields of malformed data that are not `broken`."""
        return []

    def applies(self, name: str) -> bool:
        """Return whether a field has an effect besides the values of the others."""
        return True


def plain_tree(value: Any) -> Any:
    """A tree as lists, mappings and numbers, without the keys that have no meaning beside the
    others. A null that is no more than its default is left out, but where a preset would fill it
    in."""
    if isinstance(value, Node):
        fields, by_preset = type(value).model_fields, type(value).KEEPS_NULL
        return {
            name: plain_tree(item)
            for name, item in value
            if value.applies(name)
            and (by_preset or item is not None or fields[name].default is not None)
        }
    if isinstance(value, dict):
        return {name: plain_tree(item) for name, item in value.items()}
    return [plain_tree(item) for item in value] if isinstance(value, tuple) else value


Rising = Annotated[tuple[Finite, ...], Field(min_length=1, max_length=721)]


class AspectTable(Node):
    """Values over a grid of directions in the body's frame."""

    azimuth_deg: Rising
    """Azimuths of the columns, rising, from the boresight to the right [degrees]. Beyond the ends
    the nearest column counts; a table whose gap is at most one step of the circle, such as 0 to
    350, is periodic."""
    elevation_deg: Rising
    """Elevations of the rows, rising, from the horizontal upwards [degrees]."""
    values_db: tuple[tuple[Decibels, ...], ...]
    """A row for each elevation and in it a number for each azimuth: gain [dBi] or cross-section
    [dBsm]; between them it is interpolated in decibels."""

    def problems(self) -> Iterator[Problem]:
        for key, limit in (("azimuth_deg", 360.0), ("elevation_deg", 90.0)):
            line = getattr(self, key)
            if any(b <= a for a, b in itertools.pairwise(line)):
                yield Problem(((key,),), "must rise from each number to the next")
            if max(map(abs, line)) > limit:
                yield Problem(((key,),), f"must be within {limit:g} degrees on either side")
        shape = len(self.elevation_deg), len(self.azimuth_deg)
        found = len(self.values_db), {len(row) for row in self.values_db}
        if found != (shape[0], {shape[1]}):
            yield Problem(
                (("values_db",),),
                f"needs {shape[0]} rows (elevations) of {shape[1]} numbers (azimuths)",
            )
