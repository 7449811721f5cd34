"""What a case of the validation is, and how one is run."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from importlib import metadata
from types import ModuleType

import numpy as np


class Skipped(Exception):
    """A case cannot be run here; the text says why."""


Errors = Iterator[float]
"""What a case finds, one after the other: the largest counts."""


@dataclass(frozen=True)
class Case:
    """One claim with an independent truth.

    Attributes
    ----------
    name, group : what it is called, and where it belongs
    claim : what the program says of itself
    truth : what it is held against; shares no code with what is tested
    bound, unit, why : largest error that passes, its unit ("sigma" are standard deviations of the
        estimate itself), and the reason for it
    measure : returns the error or yields several
    quick : whether it belongs to the quick selection
    tracer : whether it needs the ray tracer
    package : another project's package that it needs, if any; the case is left out where that is
        not installed
    """

    name: str
    group: str
    claim: str
    truth: str
    bound: float
    unit: str
    why: str
    measure: Callable[[], float | Errors]
    quick: bool
    tracer: bool
    package: str


@dataclass(frozen=True)
class Measured:
    """What became of a case: `passed` is None where it was left out, `note` says why, or with which
    version of another package."""

    case: Case
    error: float
    passed: bool | None
    seconds: float
    note: str = ""


def case(
    truth: str,
    bound: str,
    why: str,
    *,
    quick: bool = True,
    tracer: bool = False,
    package: str = "",
) -> Callable[[Callable[[], float | Errors]], Case]:
    """Make a case of a function that measures; its docstring is the claim, its name the name.

    Parameters
    ----------
    bound : number and unit: "1e-9 m"
    """

    def made(measure: Callable[[], float | Errors]) -> Case:
        claim = " ".join((measure.__doc__ or "").split())
        name, group = measure.__name__.replace("_", " "), measure.__module__.rpartition(".")[2]
        limit, unit = bound.split(" ", 1)
        what = (name, group, claim, truth, float(limit), unit, why, measure)
        return Case(*what, quick, tracer, package)

    return made


traced = partial(case, tracer=True)
slow = partial(case, quick=False)
slow_traced = partial(case, quick=False, tracer=True)


def cases_of(module: ModuleType) -> list[Case]:
    """The cases of a module, in the order in which they stand there."""
    return [value for value in vars(module).values() if isinstance(value, Case)]


def run_case(case: Case) -> Measured:
    """Measure one case. An error that is not a number fails; so does an exception, whose text
    becomes the note."""
    error, note, begin = math.nan, "", time.perf_counter()
    passed: bool | None = None
    try:
        if case.package:
            note = f"{case.package} {metadata.version(case.package)}"
        if case.tracer:
            _start_tracer()
        found = case.measure()
        error = float(np.max(list(found) if isinstance(found, Iterator) else found))
        passed = error <= case.bound
    except metadata.PackageNotFoundError:
        note = f"{case.package} is not installed"
    except Skipped as reason:
        note = str(reason)
    except Exception as problem:
        error, passed, note = math.inf, False, f"{type(problem).__name__}: {problem}"
    return Measured(case, error, passed, time.perf_counter() - begin, note)


def _start_tracer() -> None:
    from isac_rt.runtime import RuntimeProblem, activate

    try:
        activate()
    except RuntimeProblem as problem:
        raise Skipped(f"no ray tracer: {problem}") from None
