"""The shape of the package: what may import what, and what importing costs."""

from __future__ import annotations

import ast
import re
import subprocess
import sys
from graphlib import TopologicalSorter
from pathlib import Path

import pytest

PACKAGE = Path(__file__).parent.parent / "isac_rt"
MODULES = sorted(PACKAGE.rglob("*.py"))
# a room may import itself and those before it
ORDER = (
    "runtime randomness storage plain registry settings document kernels world frame "
    "propagation signal receive track scenario results simulation extensions sweep views cli"
).split()
GROUND = {"runtime", "randomness"}
GROUND_FILES = ("runtime", "randomness", "storage", "plain", "registry", "settings", "document")
NEVER = {("receive", "signal"), ("receive", "propagation"), ("world", "frame")}
"""(room, what it must not import although it stands above it)"""


def room_of(path: Path) -> str:
    """The room that a file belongs to."""
    first = path.relative_to(PACKAGE).parts[0]
    return first.removesuffix(".py")


def imported_rooms(source: str) -> set[str]:
    """Rooms that a module imports, anywhere in it."""
    rooms: set[str] = set()
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Import):
            names = [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, "relative imports hide the order"
            names = (
                [f"{node.module}.{alias.name}" for alias in node.names]
                if node.module == "isac_rt"
                else [node.module or ""]
            )
        else:
            continue
        rooms |= {name.split(".")[1] for name in names if name.startswith("isac_rt.")}
    return rooms


def ids(path: Path) -> str:
    return str(path.relative_to(PACKAGE))


@pytest.mark.parametrize(
    "path", [m for m in MODULES if m.parent != PACKAGE or m.name != "__init__.py"], ids=ids
)
def test_imports_run_one_way_through_the_rooms(path: Path):
    """Planted bug: `from isac_rt.cli.cli import main` in frame/waveform.py; `from
    isac_rt.signal.noise import add_white_noise` in receive/cfar.py."""
    room = room_of(path)
    assert room in ORDER, f"{ids(path)} stands in no room"
    below = set() if room in GROUND else set(ORDER[: ORDER.index(room)])
    assert imported_rooms(path.read_text()) <= {room} | {
        other for other in below if (room, other) not in NEVER
    }


OUTSIDE = re.compile(r"^\s*(from|import) (reproduce|benchmarks|truths|tests)\b", re.MULTILINE)


@pytest.mark.parametrize("path", [m for m in MODULES if m.name != "studies.py"], ids=ids)
def test_what_judges_the_program_is_imported_by_its_commands_only(path: Path):
    """Planted bug: `from reproduce import names` in views/report.py."""
    assert not OUTSIDE.search(path.read_text())


CORE = "kernels frame world propagation signal receive track simulation".split()
DOOR = ["scenario", "results"]


@pytest.mark.parametrize("path", [m for m in MODULES if room_of(m) in CORE + DOOR], ids=ids)
def test_core_and_door_never_import_an_extension(path: Path):
    """Planted bug: `from isac_rt.extensions.city_receivers import gates` in receive/chain.py."""
    assert "extensions" not in imported_rooms(path.read_text())


def test_import_finder_sees_every_form():
    source = (
        "import isac_rt.cli\nfrom isac_rt import report, figures as f\ndef g():\n    from "
        "isac_rt.sweep.grid import x\nimport numpy"
    )
    assert imported_rooms(source) == {"cli", "report", "figures", "sweep"}


def imported_files(path: Path) -> set[Path]:
    """Files of the package that a file imports, at once or when one of its functions is called."""
    found = set()
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.ImportFrom) and (node.module or "").startswith("isac_rt"):
            for dotted in (f"{node.module}.{alias.name}" for alias in node.names):
                for name in (dotted, node.module or ""):
                    at = PACKAGE.parent / name.replace(".", "/")
                    file = (
                        at.with_suffix(".py")
                        if at.with_suffix(".py").is_file()
                        else at / "__init__.py"
                    )
                    if file.is_file():
                        found.add(file)
                        break
    return found - {path}


def test_no_file_imports_itself_by_way_of_others():
    """Planted bug: `from isac_rt.receive.active import receive_active` in receive/cfar.py."""
    graph = {path: imported_files(path) for path in MODULES}
    TopologicalSorter(graph).prepare()  # raises CycleError with the files


@pytest.mark.parametrize("path", MODULES, ids=ids)
def test_nothing_that_is_read_can_be_code(path: Path):
    """Planted bug: `import pickle` in simulation/resume.py."""
    tree = ast.parse(path.read_text())
    used = {
        name.split(".")[0]
        for node in ast.walk(tree)
        if isinstance(node, ast.Import | ast.ImportFrom)
        for name in [getattr(node, "module", None) or "", *(a.name for a in node.names)]
    }
    called = {
        node.func.id
        for node in ast.walk(tree)
        if isinstance(node, ast.Call) and isinstance(node.func, ast.Name)
    }
    assert not used & {"pickle", "cloudpickle", "dill", "joblib", "marshal", "shelve"}
    assert not called & {"eval", "exec", "compile"}
    assert "allow_pickle=True" not in path.read_text()


def test_importing_the_package_starts_no_ray_tracer():
    """Planted bug: `import drjit` in isac_rt/__init__.py."""
    program = (
        "import sys, isac_rt; print([m for m in ('sionna', 'mitsuba', 'drjit') if m in "
        "sys.modules])"
    )
    done = subprocess.run(
        [sys.executable, "-c", program],
        capture_output=True,
        text=True,
        cwd=PACKAGE.parent,
        check=True,
    )
    assert done.stdout.strip() == "[]"


@pytest.mark.parametrize("how", [("check",), ("format", "--check")], ids=" ".join)
def test_style(how):
    """Planted bug: an unused import; a line that the formatter would break."""
    done = subprocess.run(
        [sys.executable, "-m", "ruff", *how, "."],
        capture_output=True,
        text=True,
        cwd=PACKAGE.parent,
        check=False,
    )
    assert done.returncode == 0, done.stdout + done.stderr


def parameters(function: ast.FunctionDef) -> int:
    a = function.args
    names = [one.arg for one in (*a.posonlyargs, *a.args, *a.kwonlyargs)]
    return len(names) - (names[:1] in (["self"], ["cls"]))


def test_parameter_lists_are_short():
    """Eight; twelve of what is compiled, of its twin, and of commands. Planted bug: one more for
    `if_signal`, which has five; one more for the gridded kernel, which has twelve."""
    long = {}
    for path in MODULES:
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.FunctionDef):
                marks = " ".join(ast.unparse(d) for d in node.decorator_list)
                many = "jit" in marks or "twin_of" in marks or path.parent.name == "cli"
                if parameters(node) > (12 if many else 8):
                    long[f"{ids(path)}:{node.name}"] = parameters(node)
                if node.name == "if_signal":
                    assert parameters(node) == 5
    assert long == {}


def test_suppressions_are_few_and_carry_their_reason():
    """Planted bug: a bare `# type: ignore[assignment]`."""
    mark = re.compile(r"# (?:noqa|type: ignore|fmt: \w+|pragma: no cover)\b(.*)")
    found = {
        f"{path}:{number}": said.group(1)
        for folder in ("isac_rt", "tests", "notebooks", "docs")
        for path in (PACKAGE.parent / folder).rglob("*.py")
        for number, line in enumerate(path.read_text().splitlines(), start=1)
        if (said := mark.search(line)) and path != Path(__file__)
    }
    assert len(found) <= 20
    assert [place for place, rest in found.items() if not re.search(r"[-#] \w", rest)] == []


@pytest.mark.slow
def test_types():
    """Planted bug: an argument too many."""
    done = subprocess.run(
        [sys.executable, "-m", "mypy"],
        capture_output=True,
        text=True,
        cwd=PACKAGE.parent,
        check=False,
    )
    assert done.returncode == 0, done.stdout + done.stderr


def test_no_registry_address_in_the_set_up():
    root = PACKAGE.parent
    for name in ("requirements.lock", "pyproject.toml", "Makefile", ".ci/run"):
        assert "://" not in (root / name).read_text(), name


@pytest.mark.parametrize("path", [m for m in MODULES if room_of(m) != "kernels"], ids=ids)
def test_compiled_functions_stand_in_their_room(path: Path):
    """Planted bug: `@jit` before a function of receive/cfar.py."""
    decorators = [
        ast.unparse(decorator)
        for node in ast.walk(ast.parse(path.read_text()))
        if isinstance(node, ast.FunctionDef)
        for decorator in node.decorator_list
    ]
    assert not [name for name in decorators if "jit" in name]


MAX_LINES = {
    "kernels": 4060,
    "frame": 2831,
    "world": 3880,
    "propagation": 4789,
    "signal": 837,
    "receive": 6057,
    "track": 1973,
    "scenario": 2212,
    "results": 3745,
    "simulation": 3786,
    "sweep": 2784,
    "views": 3676,
    "cli": 2314,
    "extensions": 15715,
}
"""Lines of each room, which only go down."""


@pytest.mark.parametrize("room", MAX_LINES)
def test_rooms_do_not_grow(room: str):
    """Planted bug: a room that is left out of the table."""
    lines = sum(m.read_text().count("\n") for m in MODULES if room_of(m) == room)
    assert 0 < lines <= MAX_LINES[room]
    assert MAX_LINES.keys() == set(ORDER) - set(GROUND_FILES)


PRIVATE_WORDS = ("Of", "What", "Whether", "Those", "How", "That", "Which")


@pytest.mark.parametrize("path", MODULES, ids=ids)
def test_docstrings_begin_with_a_verb_or_a_noun(path: Path):
    """Planted bug: `Whether noise covers a path.` as a docstring in signal/noise.py."""
    documented = (ast.Module, ast.ClassDef, ast.FunctionDef, ast.AsyncFunctionDef)
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, documented) and (text := ast.get_docstring(node)):
            assert text.split()[0].strip(",.;:") not in PRIVATE_WORDS, text


def compiled_functions(path: Path) -> set[str]:
    """Names of the functions of a file of kernels that are compiled, but for those inlined."""
    return {
        node.name
        for node in ast.parse(path.read_text()).body
        if isinstance(node, ast.FunctionDef)
        and any(
            ast.unparse(mark).startswith("jit") and "inline" not in ast.unparse(mark)
            for mark in node.decorator_list
        )
    }


COMPILED = {path.stem: compiled_functions(path) for path in (PACKAGE / "kernels").glob("*.py")}


def kernels_named(tree: ast.AST) -> set[str]:
    """Full names of the compiled functions that a module outside the kernels names."""
    found, files = set(), {}
    for node in ast.walk(tree):
        if isinstance(node, ast.ImportFrom) and node.module == "isac_rt.kernels":
            files |= {alias.asname or alias.name: alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and (node.module or "").startswith("isac_rt.kernels"):
            file = str(node.module).rpartition(".")[2]
            found |= {f"{file}.{alias.name}" for alias in node.names}
    for node in ast.walk(tree):
        if isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name):
            found.add(f"{files.get(node.value.id)}.{node.attr}")
    return {f"{file}.{name}" for file, names in COMPILED.items() for name in names} & found


def test_every_kernel_that_a_room_calls_has_a_twin():
    """Planted bug: `propagation_discs.near` called instead of its twin's name, without a twin."""
    named, twins = set(), set()
    for path in MODULES:
        if room_of(path) == "kernels":
            continue
        tree = ast.parse(path.read_text())
        marks = [
            mark
            for node in ast.walk(tree)
            if isinstance(node, ast.FunctionDef)
            for mark in node.decorator_list
            if ast.unparse(mark).startswith("twin_of(")
        ]
        twins |= {ast.unparse(mark)[8:-1] for mark in marks}
        named |= kernels_named(tree)
    assert len(named) >= 20
    assert named - twins == set()
