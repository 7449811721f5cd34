"""The shape of the package: what may import what, how long things may be, and what importing costs."""

from __future__ import annotations

import ast
import subprocess
import sys
from pathlib import Path

import pytest

PACKAGE = Path(__file__).parent.parent / "isac_rt"
MODULES = sorted(PACKAGE.rglob("*.py"))
# a module may import those before it
ORDER = (
    "scenario_base scenario_accuracy scenario_clutter scenario_doubts scenario scenario_file provenance runtime randomness waveform arrays "
    "payload timetable city swarm surroundings preflight linkbudget propagation simd lanefft synthesis separable noise rangecells gridding "
    "costs ifsignal receive tracking ghosts terminal baselines access metrics fidelity fall_back results unfinished simulate budget sweep "
    "experiments validation bench figures render interactive animate report interchange starter console interruption cli"
).split()
ALONE = {"runtime", "randomness"}
MAX_MODULE_LINES = 600
MAX_FUNCTION_LINES = 60


def part_of(path: Path) -> str:
    """The name in ORDER that a file belongs to."""
    first = path.relative_to(PACKAGE).parts[0]
    return first.removesuffix(".py")


def imported_parts(source: str) -> set[str]:
    """Names in ORDER that a module imports from this package, anywhere in it."""
    parts: set[str] = set()
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Import):
            names = [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, "relative imports hide the order"
            names = [f"{node.module}.{alias.name}" for alias in node.names] if node.module == "isac_rt" else [node.module or ""]
        else:
            continue
        parts |= {name.split(".")[1] for name in names if name.startswith("isac_rt.")}
    return parts


def code_lines(function: ast.FunctionDef | ast.AsyncFunctionDef) -> int:
    """Lines of a function without its docstring."""
    length = (function.end_lineno or 0) - function.lineno + 1
    first = function.body[0]
    if ast.get_docstring(function) is not None:
        length -= (first.end_lineno or 0) - first.lineno + 1
    return length


def ids(path: Path) -> str:
    return str(path.relative_to(PACKAGE))


@pytest.mark.parametrize("path", [m for m in MODULES if m != PACKAGE / "__init__.py"], ids=ids)
def test_imports_point_upwards(path: Path):
    """Planted bug: `from isac_rt.cli import main` in waveform.py."""
    part = part_of(path)
    assert part in ORDER, f"{ids(path)} has no place in the order of the modules"
    allowed = {part} if part in ALONE else {name for name in ORDER if ORDER.index(name) <= ORDER.index(part)}
    assert imported_parts(path.read_text()) <= allowed


def test_import_finder_sees_every_form():
    source = "import isac_rt.cli\nfrom isac_rt import report, figures as f\ndef g():\n    from isac_rt.sweep.grid import x\nimport numpy"
    assert imported_parts(source) == {"cli", "report", "figures", "sweep"}


@pytest.mark.parametrize("path", MODULES, ids=ids)
def test_modules_and_functions_are_short(path: Path):
    """Planted bug: sixty-one statements in one function."""
    source = path.read_text()
    assert len(source.splitlines()) <= MAX_MODULE_LINES
    functions = [n for n in ast.walk(ast.parse(source)) if isinstance(n, ast.FunctionDef | ast.AsyncFunctionDef)]
    assert {f.name: code_lines(f) for f in functions if code_lines(f) > MAX_FUNCTION_LINES} == {}


def test_importing_the_package_starts_no_ray_tracer():
    """Planted bug: `import drjit` in isac_rt/__init__.py."""
    program = "import sys, isac_rt; print([m for m in ('sionna', 'mitsuba', 'drjit') if m in sys.modules])"
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, cwd=PACKAGE.parent, check=True)
    assert done.stdout.strip() == "[]"


def test_style():
    """Planted bug: an unused import."""
    done = subprocess.run([sys.executable, "-m", "ruff", "check", "."], capture_output=True, text=True, cwd=PACKAGE.parent, check=False)
    assert done.returncode == 0, done.stdout + done.stderr


@pytest.mark.slow
def test_types():
    """Planted bug: an argument too many."""
    done = subprocess.run([sys.executable, "-m", "mypy"], capture_output=True, text=True, cwd=PACKAGE.parent, check=False)
    assert done.returncode == 0, done.stdout + done.stderr


def test_no_registry_address_in_the_set_up():
    root = PACKAGE.parent
    for name in ("requirements.lock", "pyproject.toml", "Makefile", ".ci/run"):
        assert "://" not in (root / name).read_text(), name
