"""Mutation testing: does anything notice when the program is wrong?

    python tests/mutation.py --planted [WORDS]     the bug of each case of `isac-rt validate`
                                                   (WORDS: parts of "group: name", with commas)
    python tests/mutation.py --hard [WORDS]        the bugs of planted.py, against their tests
    python tests/mutation.py --sample 90 --seed 1  sampled sign, factor, index and unit errors, and
                                                   in the rooms that keep and count (BOOKS)
                                                   conditions turned over and things left out

Both work on a copy in a temporary folder. --planted takes about ten minutes. --sample first runs
the tests once to see which of them call which function (--record FILE keeps that for the next
time), then tries each mutant on those that call its function, the quick ones first. The exit status
is 1 if a planted bug goes unnoticed, or if less than 90 % of the sample is caught.
"""

from __future__ import annotations

import argparse
import ast
import json
import os
import random
import re
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import numpy as np

ROOT = Path(__file__).parent.parent
TESTS_OF = {
    "frame/waveform.py": "test_waveform test_truths test_ifsignal",
    "frame/payload.py": "test_payload test_truths test_receive_data",
    "frame/antennas.py": "test_arrays test_view test_ifsignal",
    "frame/timetable.py": "test_timetable test_randomness",
    "randomness.py": "test_randomness test_noise",
    "scenario/swarm.py": "test_swarm",
    "world/swarm.py": "test_swarm test_passage",
    "kernels/signal_direct.py": "test_ifsignal",
    "signal/exact.py": "test_ifsignal",
    "signal/tones.py": "test_ifsignal test_hard_signal",
    "kernels/vector.py": "test_gridding test_receive_transform test_ifsignal",
    "kernels/signal_gridded.py": "test_ifsignal test_gridding",
    "kernels/fourier.py": "test_gridding test_receive_transform",
    "kernels/jit.py": "test_jit",
    "signal/methods.py": "test_methods test_ifsignal test_hard_signal test_separable",
    "signal/if_signal.py": "test_ifsignal test_hard_signal",
    "signal/noise.py": "test_noise",
    "frame/level.py": "test_linkbudget test_truths",
    "propagation/free_space.py": "test_propagation",
    "propagation/segments/geometry.py": "test_propagation test_truths test_raytrace_scenes",
    "propagation/rcs.py": "test_propagation test_truths",
    "propagation/raytrace.py": "test_raytrace_scenes test_chains",
    "propagation/segments/chains.py": "test_chains",
    "propagation/segments/images.py": "test_chains test_raytrace_scenes",
    "propagation/segments/clearance.py": "test_hard_geometry",
    "propagation/clutter/rayleigh.py": "test_clutter_models",
    "propagation/clutter/field.py": "test_clutter_field",
    "propagation/clutter/cells.py": "test_clutter_field",
    "extensions/two_bounces/two_bounces.py": "test_two_bounces",
    "extensions/two_bounces/mirrors.py": "test_two_bounces",
    "propagation/clutter/penumbra.py": "test_penumbra",
    "propagation/clutter/visibility.py": "test_penumbra test_clutter_field test_truths",
    "propagation/scatter_paths.py": "test_scatter_paths test_propagation test_raytrace_scenes",
    "propagation/segments/reflection.py": "test_mirrors test_chains test_raytrace_scenes",
    "propagation/pathset.py": "test_propagation test_ifsignal",
    "propagation/segments/discs.py": "test_diffraction test_shadow_edges",
    "propagation/segments/diffraction.py": "test_diffraction",
    "propagation/segments/direct.py": "test_shadow_edges test_diffraction",
    "propagation/segments/edges.py": "test_shadow_edges test_diffraction",
    "extensions/city_receivers/expectation.py": "test_clutter_field test_two_bounces",
    "track/filter.py": "test_filter test_tracking test_truths",
    "track/tracker.py": "test_association test_handover test_tracking",
    "track/terminal.py": "test_handover test_terminal",
    "track/reference.py": "test_handover test_terminal",
    "extensions/city_receivers/images.py": "test_images test_track_twins",
    "extensions/city_receivers/ghosts.py": "test_ghost_images test_ghosts",
    "extensions/access/protocol.py": "test_access_stages test_access_protocol",
    "extensions/access/synchronise.py": "test_access_synchronise test_access_answers",
    "simulation/connections.py": "test_access_answers test_access_run",
    "extensions/access/feedback.py": "test_access_feedback test_access_answers",
    "simulation/fall_back.py": "test_access_answers test_fall_back",
    "extensions/access/ook.py": "test_access_ook",
    "receive/active.py": "test_receive_detection",
    "receive/cfar.py": "test_receive_detection test_truths",
    "receive/clutter_filter.py": "test_clutter_filter",
    "receive/sense.py": "test_receive_detection test_receive_data",
    "receive/symbols.py": "test_receive_data test_receive_hard test_receive_joint",
    "receive/maps.py": "test_receive_detection test_receive_schemes",
    "receive/estimate.py": "test_receive_detection test_receive_data",
    "receive/passive.py": "test_receive_data",
    "receive/spectrum.py": "test_receive_data test_receive_detection test_receive_transform",
    "receive/known.py": "test_receive_detection test_receive_joint",
    "receive/arms.py": "test_receive_detection test_clutter_detectors",
    "receive/chain.py": "test_receive_detection test_receive_schemes",
    "receive/joint/fit.py": "test_receive_joint",
    "receive/joint/moments.py": "test_receive_joint",
    "receive/joint/neighbours.py": "test_receive_joint",
    "extensions/city_receivers/beams.py": "test_receive_beams",
    "receive/pursuit.py": "test_receive_pursuit",
    "extensions/city_receivers/adaptive.py": "test_clutter_detectors",
    "extensions/city_receivers/correction.py": "test_clutter_fit",
    "extensions/city_receivers/power.py": "test_clutter_detectors",
    "extensions/city_receivers/angle_doppler.py": "test_clutter_detectors",
    "receive/directions.py": "test_clutter_detectors test_directions",
    "storage.py": "test_storage",
    "propagation/store.py": "test_keys test_sweep",
    "simulation/resume.py": "test_resume",
    "simulation/simulate.py": "test_resume test_simulate test_fall_back",
    "simulation/stations.py": "test_resume test_simulate test_handed",
    "sweep/definition.py": "test_sweep test_keys",
    "sweep/execute.py": "test_sweep test_trouble",
    "sweep/outcomes.py": "test_sweep test_trouble",
    "results/provenance.py": "test_keys test_results",
    "results/labels.py": "test_labels test_scoring",
    "results/losses.py": "test_losses test_scoring",
    "results/metrics.py": "test_metrics test_view",
    "results/scoring.py": "test_scoring",
    "results/sensing.py": "test_sensing",
    "results/records.py": "test_results test_resume",
    "results/recorder.py": "test_results test_resume test_fall_back",
}
"""Modules of the signal, the propagation, the receivers, the terminals, access and flights, of what
is kept and of scores, and the tests that stand for each."""
BOOKS = ("storage.py", "propagation/store.py", "simulation/", "sweep/", "results/")
"""Rooms that keep and count: there is little arithmetic in them, and what can be wrong is a
condition, or something that is left out."""
LIMIT = 400
"""Seconds for a planted bug's case, and the least for the tests of one mutant; who does not end by
then has been noticed."""
BUDGET = 60.0
"""Seconds of tests, as they were recorded, that are tried on one mutant: what only a slower one
would notice counts as missed."""
EXCUSED = [
    (
        "propagation/clutter/cells.py",
        "np.repeat(code[large], 2) * np.uint64(4)",
        "names of cells, for the hash: different all the same",
    ),
    (
        "propagation/clutter/rayleigh.py",
        "- rng.uniform(-0.5, 0.5, count)",
        "a draw from -0.5 to 0.5: the same law",
    ),
    ("receive/estimate.py", "step / np.sign([gx, gy])", "a product with a sign is the quotient"),
    (
        "propagation/segments/discs.py",
        "reach / np.sqrt(wavelength * (before[i]",
        "a wider first look at a body; the exact one follows",
    ),
    ("propagation/segments/discs.py", "+ radius) * 2)", "wider as well"),
    (
        "propagation/segments/direct.py",
        "(which.size, 2, 3)) for name in pair]",
        "a part of no length, which nothing shades",
    ),
    ("kernels/signal_gridded.py", "t.link[k[:, 1]]", "the paths of a block are of one link"),
    ("kernels/signal_gridded.py", "lag[:, 1]", "and of one offset"),
    ("signal/methods.py", "* fast) % 2)", "whole turns, one or two"),
    ("extensions/access/ook.py", "total * (samples", "energies that are compared with each other"),
    ("propagation/clutter/penumbra.py", "RAY_OFFSET_M / side", "a quotient by a sign"),
    (
        "propagation/segments/images.py",
        "np.eye(6)",
        "the attitude of points, which no segment asks for",
    ),
    ("extensions/access/feedback.py", "+ away.min() ** 2", "a factor that all weights share"),
    ("results/provenance.py", "timeout=20", "a limit"),
    ("receive/omp.py", "support] = -2", "less than any modulus, as -1 is"),
]
"""Mutants (file, what the changed line holds and the line did not, why) that are not sampled: what
follows is as right."""


def test_file(name: str) -> str:
    """Path of a test module from the root of the checkout, whichever room it stands in."""
    (file,) = ROOT.glob(f"tests/**/{name}.py")
    return str(file.relative_to(ROOT))


@dataclass(frozen=True)
class Mutant:
    """One change of a file: `old` at an offset becomes `new`."""

    file: str
    line: int
    kind: str
    start: int
    old: str
    new: str

    def applied(self, source: str) -> str:
        assert source[self.start : self.start + len(self.old)] == self.old
        return source[: self.start] + self.new + source[self.start + len(self.old) :]


TURNED: dict[type[ast.cmpop], tuple[str, str]] = {
    ast.Eq: ("==", "!="),
    ast.NotEq: ("!=", "=="),
    ast.Is: ("is", "is not"),
    ast.IsNot: ("is not", "is"),
    ast.In: ("in", "not in"),
    ast.NotIn: ("not in", "in"),
    ast.Lt: ("<", ">="),
    ast.LtE: ("<=", ">"),
    ast.Gt: (">", "<="),
    ast.GtE: (">=", "<"),
}
"""Comparisons and what says the contrary."""


class _Finder(ast.NodeVisitor):
    """All places of a module where a sign, a factor, an index or a unit can be wrong; in `BOOKS`
    also a condition, or an entry or a call left out."""

    def __init__(self, file: str, source: str) -> None:
        self.file, self.source, self.found = file, source, list[Mutant]()
        self._lines = [0]
        for line in source.splitlines(keepends=True):
            self._lines.append(self._lines[-1] + len(line))
        self._index = False
        self._books = file.startswith(BOOKS)

    def _at(self, line: int, column: int) -> int:
        return self._lines[line - 1] + len(
            self.source.splitlines()[line - 1].encode()[:column].decode()
        )

    def _add(self, node: ast.AST, kind: str, start: int, old: str, new: str) -> None:
        self.found.append(Mutant(self.file, node.lineno, kind, start, old, new))  # type: ignore[attr-defined]  # a node with a place

    def visit_Raise(self, node: ast.Raise) -> None:
        """Messages are no physics."""

    def visit_JoinedStr(self, node: ast.JoinedStr) -> None:
        """Nor are they here."""

    def visit_AnnAssign(self, node: ast.AnnAssign) -> None:
        if node.value is not None:
            self.visit(node.value)

    def visit_FunctionDef(self, node: ast.FunctionDef) -> None:
        for statement in node.body:  # not the annotations, nor the defaults and decorators
            self.visit(statement)

    def visit_ClassDef(self, node: ast.ClassDef) -> None:
        for statement in node.body:
            if not isinstance(statement, ast.AnnAssign):  # a field's default is a choice
                self.visit(statement)

    def visit_If(self, node: ast.If) -> None:
        for part in [*([node.test] if self._books else []), *node.body, *node.orelse]:
            self.visit(part)

    def visit_Compare(self, node: ast.Compare) -> None:
        if self._books and len(node.ops) == 1 and (pair := TURNED.get(type(node.ops[0]))):
            begin = self._at(node.left.end_lineno or 0, node.left.end_col_offset or 0)
            end = self._at(node.comparators[0].lineno, node.comparators[0].col_offset)
            place = self.source.find(pair[0], begin, end)
            if place >= 0:
                self._add(node, "condition", place, *pair)
        self.generic_visit(node)

    def visit_BoolOp(self, node: ast.BoolOp) -> None:
        if self._books:
            old, new = ("and", "or") if isinstance(node.op, ast.And) else ("or", "and")
            begin = self._at(node.values[0].end_lineno or 0, node.values[0].end_col_offset or 0)
            end = self._at(node.values[1].lineno, node.values[1].col_offset)
            self._add(node, "condition", self.source.index(old, begin, end), old, new)
        self.generic_visit(node)

    def visit_Dict(self, node: ast.Dict) -> None:
        self._leave_out(node, [k or v for k, v in zip(node.keys, node.values, strict=True)])
        self.generic_visit(node)

    def visit_List(self, node: ast.List) -> None:
        if isinstance(node.ctx, ast.Load) and not self._index:
            self._leave_out(node, node.elts)
        self.generic_visit(node)

    def _leave_out(self, whole: ast.expr, parts: list[ast.expr]) -> None:
        """One of several entries, up to the next."""
        if not self._books or len(parts) < 2:
            return
        begins = [self._at(part.lineno, part.col_offset) for part in parts]
        if isinstance(whole, ast.Dict):
            begins = [b - 2 * (k is None) for b, k in zip(begins, whole.keys, strict=True)]
        last = self._at(whole.end_lineno or 0, whole.end_col_offset or 0) - 1
        for part, begin, end in zip(parts, begins, [*begins[1:], last], strict=True):
            self._add(part, "left out", begin, self.source[begin:end], "")

    def visit_Expr(self, node: ast.Expr) -> None:
        if self._books and isinstance(node.value, ast.Call):
            begin = self._at(node.lineno, node.col_offset)
            end = self._at(node.end_lineno or 0, node.end_col_offset or 0)
            self._add(node, "left out", begin, self.source[begin:end], "None")
        self.generic_visit(node)

    def visit_BinOp(self, node: ast.BinOp) -> None:
        signs = {
            ast.Add: ("+", "-"),
            ast.Sub: ("-", "+"),
            ast.Mult: ("*", "/"),
            ast.Div: ("/", "*"),
        }
        if type(node.op) in signs and not isinstance(node.left, ast.List | ast.Tuple):
            old, new = signs[type(node.op)]
            begin = self._at(node.left.end_lineno or 0, node.left.end_col_offset or 0)
            end = self._at(node.right.lineno, node.right.col_offset)
            place = self.source.find(old, begin, end)
            if place >= 0 and self.source[place : place + 2] != "**":
                self._add(node, "sign" if old in "+-" else "factor", place, old, new)
        self.generic_visit(node)

    def visit_UnaryOp(self, node: ast.UnaryOp) -> None:
        if isinstance(node.op, ast.USub) and not self._index:
            self._add(node, "sign", self._at(node.lineno, node.col_offset), "-", "+")
        if isinstance(node.op, ast.Not) and self._books:
            self._add(node, "condition", self._at(node.lineno, node.col_offset), "not ", "")
        self.generic_visit(node)

    def visit_Call(self, node: ast.Call) -> None:
        if isinstance(node.func, ast.Attribute) and node.func.attr == "conj":
            begin = self._at(node.func.value.end_lineno or 0, node.func.value.end_col_offset or 0)
            end = self._at(node.end_lineno or 0, node.end_col_offset or 0)
            self._add(node, "sign", begin, self.source[begin:end], "")
        self.visit(node.func)
        if isinstance(node.func, ast.Attribute) and node.func.attr == "reshape":
            return  # of a shape numpy takes any negative number for -1, and refuses most others
        for argument in node.args:
            self.visit(argument)
        for keyword in node.keywords:
            if keyword.arg not in (
                "axis",
                "axes",
                "workers",
                "cache",
                "nogil",
                "maxsize",
                "rcond",
                "indexing",
                "kind",
                "stacklevel",
            ):
                self.visit(keyword.value)

    def visit_Subscript(self, node: ast.Subscript) -> None:
        self.visit(node.value)
        outer, self._index = self._index, True
        self.visit(node.slice)
        self._index = outer

    def visit_Constant(self, node: ast.Constant) -> None:
        if (
            isinstance(node.value, bool)
            or not isinstance(node.value, int | float)
            or node.end_lineno != node.lineno
        ):
            return
        start = self._at(node.lineno, node.col_offset)
        old = self.source[start : self._at(node.lineno, node.end_col_offset or 0)]
        if self._index:
            if isinstance(node.value, int):
                self._add(node, "index", start, old, str(node.value + 1))
        elif node.value in (10, 20):
            self._add(node, "unit", start, old, str(30 - int(node.value)))
        elif node.value != 0 and 1e-3 < abs(node.value) < 1e3:
            self._add(node, "factor", start, old, str(node.value * 2))


def mutants_of(file: str, source: str) -> list[Mutant]:
    """Every mutant of a module of the package, but for its constants' own definitions (limits and
    thresholds are choices)."""
    finder = _Finder(file, source)
    for node in ast.parse(source).body:
        if isinstance(node, ast.FunctionDef | ast.ClassDef):
            finder.visit(node)
    return finder.found


class Copy:
    """A copy of the project in which one file at a time is changed."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder / "changed"
        self._whole = folder / "whole"
        shutil.copytree(ROOT / "isac_rt", self._whole)
        for name in ("isac_rt", "tests", "scenes"):
            shutil.copytree(ROOT / name, self.folder / name)
        shutil.copy2(ROOT / "pyproject.toml", self.folder)
        self.environment = os.environ | {
            "PYTHONPATH": os.pathsep.join(
                [str(self.folder), str(self.folder / "tests"), os.environ.get("PYTHONPATH", "")]
            ),
            # two changes of one length within a second would look alike
            "PYTHONDONTWRITEBYTECODE": "1",
            "ISAC_RT_CACHE": str(folder / "compiled"),
        }

    def source(self, file: str) -> str:
        """A file of the package as it was when the copy was made."""
        return (self._whole / file).read_text()

    @contextmanager
    def changed(self, file: str, source: str) -> Iterator[None]:
        """A file changed, and put back."""
        target = self.folder / "isac_rt" / file
        target.write_text(source)
        try:
            yield
        finally:
            shutil.copy2(self._whole / file, target)


@dataclass(frozen=True)
class Record:
    """Which tests call which function, from `mutation_record`: `called` by "file:name", `seconds`
    of each test."""

    called: dict[str, list[str]]
    seconds: dict[str, float]

    @staticmethod
    def made(copy: Copy, kept: Path | None, files: list[str]) -> Record:
        """Of the unchanged copy, from a file or by running all tests of some modules."""
        out = kept or copy.folder / "record.json"
        if not out.exists():
            names = sorted({name for file in files for name in TESTS_OF[file].split()})
            command = [
                sys.executable,
                "-m",
                "pytest",
                "-q",
                "--no-header",
                "-p",
                "no:cacheprovider",
                "-p",
                "mutation_record",
            ]
            environment = copy.environment | {"RECORD": str(out.absolute())}
            subprocess.run(
                [*command, *map(test_file, names)],
                cwd=copy.folder,
                env=environment,
                check=True,
            )
        found = Record(**json.loads(out.read_text()))
        files = sorted({t.partition("::")[0] for t in found.seconds})
        command = [
            sys.executable,
            "-m",
            "pytest",
            "-q",
            "--collect-only",
            "-p",
            "no:cacheprovider",
            *files,
        ]
        there = subprocess.run(
            command,
            cwd=copy.folder,
            env=copy.environment,
            capture_output=True,
            text=True,
            check=True,
        )
        ids = set(there.stdout.splitlines())
        return Record(
            found.called, {t: seconds for t, seconds in found.seconds.items() if t in ids}
        )

    def tests(self, mutant: Mutant, source: str) -> list[str]:
        """Those that call a mutant's function, or all of its module if none does: what is compiled
        is called unseen. Quick ones first."""
        name = next(
            (name for name, first, last in _functions(source) if first <= mutant.line <= last), ""
        )
        callers = set(self.called.get(f"{mutant.file}:{name}", ())) & set(self.seconds)
        files = tuple(f"{test_file(name)}::" for name in TESTS_OF[mutant.file].split())
        order = sorted(
            callers or {t for t in self.seconds if t.startswith(files)},
            key=self.seconds.__getitem__,
        )
        spent = np.cumsum([0.0, *(self.seconds[t] for t in order)]).tolist()
        return [test for test, before in zip(order, spent, strict=False) if before < BUDGET]


@lru_cache
def _functions(source: str) -> list[tuple[str, int, int]]:
    """All functions and methods by qualified name, with their first and last lines."""
    tree, found = ast.parse(source), []
    for holder in [tree, *(node for node in tree.body if isinstance(node, ast.ClassDef))]:
        head = f"{holder.name}." if isinstance(holder, ast.ClassDef) else ""
        for one in holder.body:
            if isinstance(one, ast.FunctionDef):
                found.append((head + one.name, one.lineno, one.end_lineno or 0))
    return found


def sampled(count: int, seed: int, copy: Copy, files: list[str]) -> list[Mutant]:
    """So many mutants of some modules, the modules in turn, so that small ones are not forgotten,
    in an order that leaves any first part a sample too."""
    rng = random.Random(seed)
    pools = {
        file: [m for m in mutants_of(file, copy.source(file)) if not excused(m, copy.source(file))]
        for file in files
    }
    for pool in pools.values():
        rng.shuffle(pool)
    out: list[Mutant] = []
    while len(out) < count and any(pools.values()):
        for file in rng.sample(list(pools), len(pools)):
            if pools[file] and len(out) < count:
                out.append(pools[file].pop())
    return out


def excused(mutant: Mutant, source: str) -> str | None:
    """Why a mutant is not to be caught."""
    before, after = (
        text.splitlines()[mutant.line - 1] for text in (source, mutant.applied(source))
    )
    return next(
        (
            why
            for file, new, why in EXCUSED
            if file == mutant.file and new in after and new not in before
        ),
        None,
    )


class Server:
    """`mutation_server.py` in a copy."""

    def __init__(self, copy: Copy) -> None:
        self._log = copy.folder / "pytest.log"
        command = [sys.executable, str(copy.folder / "tests" / "mutation_server.py")]
        self._process = subprocess.Popen(
            command,
            cwd=copy.folder,
            env=copy.environment,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
        )

    def outcome(self, tests: list[str], limit: float) -> tuple[str, str]:
        """ "passed", "failed" or "too long", and the first test that failed."""
        arguments = ["-q", "-x", "--no-header", "--tb=no", "-rfE", "-p", "no:cacheprovider", *tests]
        status = self._ended({"arguments": arguments}, limit)
        said = [
            line
            for line in self._log.read_text(errors="replace").splitlines()
            if line.startswith(("FAILED", "ERROR"))
        ]
        return {0: "passed", -1: "too long"}.get(status, "failed"), said[0].split(" - ")[
            0
        ].partition(" ")[2] if said else ""

    def said(self, program: str, limit: float) -> str:
        """The last line that a program printed, or its error's; "too long"."""
        status = self._ended({"program": program}, limit)
        lines = self._log.read_text(errors="replace").strip().splitlines()
        return "too long" if status == -1 else lines[-1] if lines else f"ended with {status}"

    def _ended(self, order: dict, limit: float) -> int:
        assert self._process.stdin and self._process.stdout
        self._process.stdin.write(
            json.dumps(order | {"limit": limit, "log": str(self._log)}) + "\n"
        )
        self._process.stdin.flush()
        return int(self._process.stdout.readline())

    def end(self) -> None:
        """Let it go."""
        assert self._process.stdin
        self._process.stdin.close()
        self._process.wait()


def check_sample(mutants: list[Mutant], copy: Copy, record: Record, report: Path | None) -> int:
    """Plant mutants one by one; print what is not caught."""
    caught, rows, server, sound = 0, [], Server(copy), set[str]()
    for mutant in mutants:
        begin, outcome, by = time.monotonic(), "passed", ""
        source = copy.source(mutant.file)
        tests = record.tests(mutant, source)
        limit = LIMIT + 4 * sum(record.seconds[t] for t in tests)
        if tests:  # else nothing could notice
            with copy.changed(mutant.file, mutant.applied(source)):
                outcome, by = server.outcome(tests, limit)
        if (
            by not in sound and outcome == "failed"
        ):  # what failed has to pass where nothing is changed
            if server.outcome([by] if by else tests, 10 * LIMIT)[0] == "passed":
                sound.add(by)
            else:
                outcome = "passed"
        if outcome == "too long" and server.outcome(tests, limit)[0] != "passed":
            outcome = "passed"
        caught += outcome != "passed"
        line = source.splitlines()[mutant.line - 1].strip()
        rows.append(
            {
                "file": mutant.file,
                "line": mutant.line,
                "kind": mutant.kind,
                "old": mutant.old,
                "new": mutant.new,
                "code": line,
                "outcome": outcome,
                "by": by,
            }
        )
        word, change = (
            {"passed": "SURVIVED", "failed": "caught  "}.get(outcome, outcome),
            f"{mutant.kind} {mutant.old} -> {mutant.new}",
        )
        print(
            f"{word} {mutant.file}:{mutant.line} {change}  in  {line}  "
            f"({time.monotonic() - begin:.0f} s) {by}",
            flush=True,
        )
        if report:
            report.write_text(json.dumps(rows, indent=1) + "\n")
    server.end()
    print(f"{caught} of {len(rows)} caught")
    return 0 if caught >= 0.9 * len(rows) else 1


def check_planted(words: str) -> int:
    """Plant the bug of every case; print those that do not make it fail by its number."""
    sys.path.insert(0, str(ROOT))  # the cases of this checkout, whichever is installed
    from planted import OF_CASES
    from truths import all_cases

    wrong, count = 0, 0
    with tempfile.TemporaryDirectory() as folder:
        copy = Copy(Path(folder))
        server = Server(copy)
        for one in all_cases():
            if not any(word in f"{one.group}: {one.name}" for word in words.split(",")):
                continue
            p, count = OF_CASES[one.name], count + 1
            source = copy.source(p.file)
            if source.count(p.old) != 1:
                wrong += 1
                print(
                    f"STALE    {one.name}: {p.file} holds {p.old!r} {source.count(p.old)} times",
                    flush=True,
                )
                continue
            program = (
                "from truths import all_cases, run_case; "
                f"v = run_case(next(c for c in all_cases() if c.name == {one.name!r})); "
                "print(v.passed, v.error, v.note)"
            )
            with copy.changed(p.file, source.replace(p.old, p.new)):
                said = server.said(program, LIMIT)
            state = {"False": "fails   ", "None ": "LEFT OUT"}.get(
                said[:5], "UNNOTICED" if said.startswith("True") else "fails   "
            )
            if re.match(
                r"False inf \w+: ", said
            ):  # the bug is no wrong number but a program that does not run
                state = "CRASHES "
            wrong += state in ("UNNOTICED", "CRASHES ")
            print(f"{state} {one.name}: {said[:150]}", flush=True)
        server.end()
    print(f"{count - wrong} of {count} noticed or left out")
    return 1 if wrong else 0


def check_hard(words: str) -> int:
    """Plant the bugs that the hard cases are written against; print those that their tests do not
    see."""
    from planted import OF_TESTS

    wrong, count = 0, 0
    with tempfile.TemporaryDirectory() as folder:
        copy = Copy(Path(folder))
        server = Server(copy)
        for of, bug in OF_TESTS:
            if words not in of:
                continue
            source, count = copy.source(bug.file), count + 1
            state = "STALE"
            if source.count(bug.old) == 1:
                name, _, test = of.partition("::")
                with copy.changed(bug.file, source.replace(bug.old, bug.new)):
                    state = server.outcome([f"{test_file(name)}::{test}"], LIMIT)[0]
            wrong += state in ("passed", "STALE")
            print(f"{state:8s} {of}: {bug.file} {bug.new}", flush=True)
        server.end()
    print(f"{count - wrong} of {count} noticed")
    return 1 if wrong else 0


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--planted", nargs="?", const="", metavar="WORDS")
    parser.add_argument("--hard", nargs="?", const="", metavar="WORDS")
    parser.add_argument("--sample", type=int, default=0, metavar="COUNT")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument(
        "--only",
        default="",
        metavar="WORDS",
        help="sample the files with one of these in their name alone (parts of it, with commas)",
    )
    parser.add_argument(
        "--record", type=Path, help="which tests call which function; made if it is not there"
    )
    parser.add_argument("--report", type=Path, help="JSON of the sample")
    arguments = parser.parse_args()
    if arguments.planted is not None:
        return check_planted(arguments.planted)
    if arguments.hard is not None:
        return check_hard(arguments.hard)
    if arguments.sample:
        with tempfile.TemporaryDirectory() as folder:
            copy = Copy(Path(folder))
            files = [f for f in TESTS_OF if any(word in f for word in arguments.only.split(","))]
            mutants = sampled(arguments.sample, arguments.seed, copy, files)
            record = Record.made(copy, arguments.record, files)
            return check_sample(mutants, copy, record, arguments.report)
    parser.print_help()
    return 2


if __name__ == "__main__":
    sys.exit(main())
