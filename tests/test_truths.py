"""The validation: its cases are well formed, its truths independent, its tables and its command
honest."""

from __future__ import annotations

import ast
import json
import math
from dataclasses import replace
from pathlib import Path

import pytest
import truths
from planted import OF_CASES, OF_TESTS
from truths import Skipped, all_cases, run_case
from truths.case import case
from truths.table import as_data, as_markdown

from isac_rt.cli.cli import main

PACKAGE = Path(truths.__file__).parent
CASES = all_cases()


@case("zero", "0.5 m", "one half")
def a_case() -> float:
    """A claim | with a bar."""
    return 0.25


def test_there_are_enough_cases_each_complete():
    """Written against: a case without its reason."""
    assert len(CASES) >= 60
    assert len({c.name for c in CASES}) == len(CASES)
    for c in CASES:
        assert c.claim and c.truth and c.unit and c.why and math.isfinite(c.bound), c.name


def test_the_quick_selection_is_a_part_of_every_group():
    quick = all_cases(quick=True)
    assert {c.group for c in quick} == {c.group for c in CASES} and len(quick) < len(CASES)


def test_truths_take_nothing_from_the_program():
    """Written against: `from isac_rt.frame.waveform import SPEED_OF_LIGHT` in truths.py."""
    tree = ast.parse((PACKAGE / "truths.py").read_text())
    names = [n.module or "" for n in ast.walk(tree) if isinstance(n, ast.ImportFrom)]
    names += [a.name for n in ast.walk(tree) if isinstance(n, ast.Import) for a in n.names]
    assert not [name for name in names if name.startswith("isac_rt")]


def test_nothing_is_taken_from_the_tests():
    for file in PACKAGE.glob("*.py"):
        assert "tests" not in {
            n.module for n in ast.walk(ast.parse(file.read_text())) if isinstance(n, ast.ImportFrom)
        }, file.name
        assert "oracles" not in file.read_text(), file.name


def test_an_error_beyond_the_bound_a_nan_and_an_exception_fail():
    """Written against: `not error > bound` lets NaN pass."""
    assert run_case(a_case).passed is True
    assert run_case(replace(a_case, bound=0.2)).passed is False
    assert run_case(replace(a_case, measure=lambda: math.nan)).passed is False

    def breaks() -> float:
        raise ValueError("no such thing")

    broken = run_case(replace(a_case, measure=breaks))
    assert broken.passed is False and "no such thing" in broken.note


def test_what_cannot_be_run_is_left_out_with_the_reason():
    def refuses() -> float:
        raise Skipped("no ray tracer: none")

    assert run_case(replace(a_case, measure=refuses)).passed is None
    left = run_case(replace(a_case, package="no-such-package"))
    assert left.passed is None and "no-such-package" in left.note


def test_tables():
    others = (
        replace(a_case, name="worse", bound=0.1),
        replace(a_case, name="other", package="no-such"),
    )
    verdicts = [run_case(one) for one in (a_case, *others)]
    data = as_data(verdicts)
    assert (data["passed"], data["failed"], data["left_out"]) == (1, 1, 1)
    assert data["cases"][2]["error"] is None and json.dumps(data, allow_nan=False)
    text = as_markdown(verdicts)
    assert "A claim \\| with a bar." in text and "**FAILS** 0.25" in text and "left out" in text


def test_the_command_writes_its_tables_and_fails_with_a_case(tmp_path, capsys, monkeypatch):
    assert (
        main(
            [
                "validate",
                "--only",
                "binomial intervals",
                "--out",
                str(tmp_path),
                "--json",
                str(tmp_path / "x" / "t.json"),
            ]
        )
        == 0
    )
    assert "1 cases pass" in capsys.readouterr().out
    assert json.loads((tmp_path / "validation.json").read_text())["passed"] == 1
    assert (
        json.loads((tmp_path / "x" / "t.json").read_text())["cases"][0]["name"]
        == "binomial intervals"
    )
    assert "binomial intervals" in (tmp_path / "validation.md").read_text()
    monkeypatch.setattr(truths, "all_cases", lambda quick: [replace(a_case, bound=0.1)])
    assert main(["validate"]) == 1
    assert main(["validate", "--only", "nonsense"]) == 2
    assert "nonsense" in capsys.readouterr().err


QUICK = [
    pytest.param(c, id=c.name.replace(" ", "-"), marks=[pytest.mark.sionna] * c.tracer)
    for c in all_cases(quick=True)
    if c.group not in ("measured", "crosschecks") and c.name != "automatic choice"
]


@pytest.mark.parametrize("one", QUICK)
def test_quick_cases_pass(one):
    """The rest is run by the command; these are quick enough to stand among the tests, and what
    they claim no other test repeats."""
    verdict = run_case(one)
    assert verdict.passed, (verdict.error, one.bound, verdict.note)


def test_planted_bugs_fit_the_source():
    """Each case has one, and each stands in its file as it is written, once, so that
    tests/mutation.py can plant it."""
    assert list(OF_CASES) == [c.name for c in CASES]
    bugs = [*OF_CASES.items(), *OF_TESTS]
    root = PACKAGE.parents[1] / "isac_rt"
    assert [of for of, bug in bugs if (root / bug.file).read_text().count(bug.old) != 1] == []
    assert [of for of, bug in bugs if bug.old == bug.new] == []
