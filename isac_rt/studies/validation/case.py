"""What a case of the validation is, and how one is run."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from importlib import metadata
from types import ModuleType


class Skipped(Exception):
    """A case cannot be run here; the text says why."""


@dataclass(frozen=True)
class Case:
    """One claim with an independent truth.

    Attributes
    ----------
    name, group : what it is called, and where it belongs
    claim : what the program says of itself
    truth : what it is held against; shares no code with what is tested
    unit : of error and bound; "sigma" are standard deviations of the estimate itself
    bound, why : largest error that passes, and the reason for it
    measure : returns the error
    quick : whether it belongs to the quick selection
    tracer : whether it needs the ray tracer
    package : another project's package that it needs, if any; the case is left out where that is
        not installed
    """

    name: str
    group: str
    claim: str
    truth: str
    unit: str
    bound: float
    why: str
    measure: Callable[[], float]
    quick: bool
    tracer: bool
    package: str


@dataclass(frozen=True)
class Verdict:
    """What became of a case: `passed` is None where it was left out, `note` says why, or with which
    version of another package."""

    case: Case
    error: float
    passed: bool | None
    seconds: float
    note: str = ""


def case(
    *,
    truth: str,
    unit: str,
    bound: float,
    why: str,
    quick: bool = True,
    tracer: bool = False,
    package: str = "",
) -> Callable[[Callable[[], float]], Case]:
    """Make a case of a function that measures an error; its docstring is the claim, its name the
    name."""

    def made(measure: Callable[[], float]) -> Case:
        claim = " ".join((measure.__doc__ or "").split())
        name, group = measure.__name__.replace("_", " "), measure.__module__.rpartition(".")[2]
        return Case(
            name,
            group,
            claim,
            truth,
            unit,
            bound,
            why,
            measure,
            quick,
            tracer,
            package,
        )

    return made


def cases_of(module: ModuleType) -> list[Case]:
    """The cases of a module, in the order in which they stand there."""
    return [value for value in vars(module).values() if isinstance(value, Case)]


def run_case(case: Case) -> Verdict:
    """Measure one case. An error that is not a number fails; so does an exception, whose text
    becomes the note."""
    note = ""
    if case.package:
        try:
            note = f"{case.package} {metadata.version(case.package)}"
        except metadata.PackageNotFoundError:
            return Verdict(case, math.nan, None, 0.0, f"{case.package} is not installed")
    begin = time.perf_counter()
    try:
        if case.tracer:
            _start_tracer()
        error = float(case.measure())
    except Skipped as reason:
        return Verdict(case, math.nan, None, time.perf_counter() - begin, str(reason))
    except Exception as problem:
        return Verdict(
            case,
            math.inf,
            False,
            time.perf_counter() - begin,
            f"{type(problem).__name__}: {problem}",
        )
    return Verdict(case, error, bool(error <= case.bound), time.perf_counter() - begin, note)


def _start_tracer() -> None:
    from isac_rt.runtime import RuntimeProblem, activate

    try:
        activate()
    except RuntimeProblem as problem:
        raise Skipped(f"no ray tracer: {problem}") from None


def run_cases(cases: list[Case]) -> Iterator[Verdict]:
    """One case after the other, each as soon as it is done."""
    for one in cases:
        yield run_case(one)
