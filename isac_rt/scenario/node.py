"""What every mapping of a scenario is made of: the frozen node, its kinds of numbers, and how it
complains."""

from __future__ import annotations

from collections.abc import Iterator
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
    """What to write instead of keys ("rays") and values ("model: diffuse") of earlier versions."""

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
        """What in this mapping contradicts itself; keys are relative to it."""
        yield from ()

    def applies(self, name: str) -> bool:
        """Whether a field means anything beside the values of the others."""
        return True
