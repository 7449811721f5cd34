"""Mutation testing: does anything notice when the program is wrong?

    python tests/mutation.py --planted [WORDS]        plant each case's bug of `isac-rt validate`; the case must fail
    python tests/mutation.py --sample 60 --seed 1     plant sampled sign, factor, index and unit errors; the tests must fail

Both work on a copy in a temporary folder. --planted takes about ten minutes, --sample half a minute per mutant on 2 cores. The exit status
is 1 if a planted bug goes unnoticed, or if less than 90 % of the sample is caught.
"""

from __future__ import annotations

import argparse
import ast
import json
import os
import random
import shutil
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).parent.parent
TESTS_OF = {
    "waveform.py": "test_waveform test_ifsignal",
    "payload.py": "test_payload test_receive_data",
    "arrays.py": "test_arrays test_ifsignal",
    "synthesis.py": "test_ifsignal",
    "gridding.py": "test_ifsignal test_gridding",
    "lanefft.py": "test_gridding",
    "separable.py": "test_separable",
    "ifsignal.py": "test_ifsignal",
    "noise.py": "test_noise",
    "linkbudget.py": "test_linkbudget",
    "propagation/free_space.py": "test_propagation",
    "propagation/geometry.py": "test_propagation test_raytrace_scenes",
    "propagation/rcs.py": "test_propagation",
    "propagation/raytrace.py": "test_raytrace_scenes",
    "propagation/statistical.py": "test_clutter_models",
    "propagation/clutter.py": "test_clutter_field",
    "propagation/cells.py": "test_clutter_field",
    "propagation/visibility.py": "test_clutter_coherence test_clutter_field",
    "propagation/elements.py": "test_propagation",
    "propagation/diffuse.py": "test_raytrace_scenes",
    "propagation/between.py": "test_between",
    "propagation/mirrors.py": "test_between",
    "propagation/bodies.py": "test_diffraction test_shadow_edges",
    "propagation/diffraction.py": "test_diffraction",
    "propagation/direct.py": "test_shadow_edges test_diffraction",
    "propagation/edges.py": "test_shadow_edges test_diffraction",
    "propagation/expected.py": "test_clutter_detectors",
    "propagation/expectation.py": "test_clutter_detectors",
    "receive/active.py": "test_receive_detection",
    "receive/cfar.py": "test_receive_detection",
    "receive/clutter_filter.py": "test_clutter_filter",
    "receive/common.py": "test_receive_detection test_receive_data",
    "receive/demodulate.py": "test_receive_data",
    "receive/doppler.py": "test_receive_detection",
    "receive/estimate.py": "test_receive_detection test_receive_data",
    "receive/passive.py": "test_receive_data",
    "receive/spectrum.py": "test_receive_data test_receive_detection",
    "receive/joint.py": "test_receive_joint",
    "receive/separate.py": "test_receive_joint",
    "receive/beams.py": "test_receive_beams",
    "receive/pursuit.py": "test_receive_pursuit",
    "receive/profile.py": "test_profile_decision",
    "receive/adaptive.py": "test_clutter_detectors",
    "receive/clutter_map.py": "test_clutter_detectors",
    "receive/detectors.py": "test_clutter_detectors",
}
"""Modules of the signal, the propagation and the receivers, and the tests that stand for each."""
COMPILED_FROM = {"synthesis.py": ("gridding",), "lanefft.py": ("gridding",)}
"""Modules whose compiled code holds another one's; its cache does not know that the other changed."""
LIMIT = 400
"""Seconds for the tests of one mutant; who does not end by then has been noticed."""


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


class _Finder(ast.NodeVisitor):
    """All places of a module where a sign, a factor, an index or a unit can be wrong."""

    def __init__(self, file: str, source: str) -> None:
        self.file, self.source, self.found = file, source, list[Mutant]()
        self._lines = [0]
        for line in source.splitlines(keepends=True):
            self._lines.append(self._lines[-1] + len(line))
        self._index = False

    def _at(self, line: int, column: int) -> int:
        return self._lines[line - 1] + len(self.source.splitlines()[line - 1].encode()[:column].decode())

    def _add(self, node: ast.AST, kind: str, start: int, old: str, new: str) -> None:
        self.found.append(Mutant(self.file, node.lineno, kind, start, old, new))  # type: ignore[attr-defined]

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

    def visit_If(self, node: ast.If) -> None:
        for statement in [*node.body, *node.orelse]:
            self.visit(statement)

    def visit_BinOp(self, node: ast.BinOp) -> None:
        signs = {ast.Add: ("+", "-"), ast.Sub: ("-", "+"), ast.Mult: ("*", "/"), ast.Div: ("/", "*")}
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
        self.generic_visit(node)

    def visit_Call(self, node: ast.Call) -> None:
        if isinstance(node.func, ast.Attribute) and node.func.attr == "conj":
            begin = self._at(node.func.value.end_lineno or 0, node.func.value.end_col_offset or 0)
            end = self._at(node.end_lineno or 0, node.end_col_offset or 0)
            self._add(node, "sign", begin, self.source[begin:end], "")
        self.visit(node.func)
        for argument in node.args:
            self.visit(argument)
        for keyword in node.keywords:
            if keyword.arg not in ("axis", "axes", "workers", "cache", "nogil", "maxsize", "rcond", "indexing", "kind"):
                self.visit(keyword.value)

    def visit_Subscript(self, node: ast.Subscript) -> None:
        self.visit(node.value)
        outer, self._index = self._index, True
        self.visit(node.slice)
        self._index = outer

    def visit_Constant(self, node: ast.Constant) -> None:
        if isinstance(node.value, bool) or not isinstance(node.value, int | float) or node.end_lineno != node.lineno:
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
    """Every mutant of a module of the package, but for its constants' own definitions (limits and thresholds are choices)."""
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

    def source(self, file: str) -> str:
        """A file of the package as it was when the copy was made."""
        return (self._whole / file).read_text()

    def run(self, file: str, source: str, command: list[str], limit: float) -> subprocess.CompletedProcess[str] | None:
        """Run a command with a file changed, and put it back; None if it takes too long."""
        target = self.folder / "isac_rt" / file
        target.write_text(source)
        for name in COMPILED_FROM.get(file, ()):
            for compiled in (target.parent / "__pycache__").glob(f"{name}.*.nb?"):
                compiled.unlink()
        environment = os.environ | {"PYTHONPATH": os.pathsep.join([str(self.folder), os.environ.get("PYTHONPATH", "")])}
        try:
            return subprocess.run(command, cwd=self.folder, env=environment, capture_output=True, text=True, timeout=limit)
        except subprocess.TimeoutExpired:
            return None
        finally:
            shutil.copy2(self._whole / file, target)


def sampled(count: int, seed: int, copy: Copy) -> list[Mutant]:
    """So many mutants, the modules in turn, so that small ones are not forgotten."""
    rng = random.Random(seed)
    pools = {file: mutants_of(file, copy.source(file)) for file in TESTS_OF}
    for pool in pools.values():
        rng.shuffle(pool)
    out: list[Mutant] = []
    while len(out) < count and any(pools.values()):
        for pool in pools.values():
            if pool and len(out) < count:
                out.append(pool.pop())
    return sorted(out, key=lambda m: (m.file, m.line))


def check_sample(count: int, seed: int, report: Path | None) -> int:
    """Plant a sample; print what is not caught."""
    caught, rows = 0, []
    with tempfile.TemporaryDirectory() as folder:
        copy = Copy(Path(folder))
        for mutant in sampled(count, seed, copy):
            begin = time.monotonic()
            tests = [f"tests/{name}.py" for name in TESTS_OF[mutant.file].split()]
            command = [sys.executable, "-m", "pytest", "-q", "-x", "--no-header", "-p", "no:cacheprovider", *tests]
            done = copy.run(mutant.file, mutant.applied(copy.source(mutant.file)), command, LIMIT)
            noticed = done is None or done.returncode != 0
            caught += noticed
            line = copy.source(mutant.file).splitlines()[mutant.line - 1].strip()
            rows.append({"file": mutant.file, "line": mutant.line, "kind": mutant.kind, "old": mutant.old, "new": mutant.new, "code": line,
                         "caught": noticed})  # fmt: skip
            word, change = "caught  " if noticed else "SURVIVED", f"{mutant.kind} {mutant.old} -> {mutant.new or 'nothing'}"
            print(f"{word} {mutant.file}:{mutant.line} {change}  in  {line}  ({time.monotonic() - begin:.0f} s)", flush=True)
            if report:
                report.write_text(json.dumps(rows, indent=1) + "\n")
    print(f"{caught} of {len(rows)} caught")
    return 0 if caught >= 0.9 * len(rows) else 1


def check_planted(words: str) -> int:
    """Plant the bug of every case; print those that do not make it fail."""
    from isac_rt.validation import all_cases

    wrong = 0
    with tempfile.TemporaryDirectory() as folder:
        copy = Copy(Path(folder))
        for one in all_cases():
            if words not in f"{one.group} {one.name}":
                continue
            p = one.planted
            source = copy.source(p.file)
            if source.count(p.old) != 1:
                wrong += 1
                print(f"STALE    {one.name}: {p.file} holds {p.old!r} {source.count(p.old)} times", flush=True)
                continue
            program = (
                "from isac_rt.validation import all_cases, run_case; "
                f"v = run_case(next(c for c in all_cases() if c.name == {one.name!r})); print(v.passed, v.error, v.note)"
            )
            done = copy.run(p.file, source.replace(p.old, p.new), [sys.executable, "-c", program], LIMIT)
            said = "too long" if done is None else (done.stdout.strip().splitlines() or ["broken " + done.stderr[-300:]])[-1]
            state = {"False": "fails   ", "None ": "LEFT OUT"}.get(said[:5], "UNNOTICED" if said.startswith("True") else "fails   ")
            wrong += state == "UNNOTICED"
            print(f"{state} {one.name}: {said[:150]}", flush=True)
    return 1 if wrong else 0


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--planted", nargs="?", const="", metavar="WORDS")
    parser.add_argument("--sample", type=int, default=0, metavar="COUNT")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--report", type=Path, help="JSON of the sample")
    arguments = parser.parse_args()
    if arguments.planted is not None:
        return check_planted(arguments.planted)
    if arguments.sample:
        return check_sample(arguments.sample, arguments.seed, arguments.report)
    parser.print_help()
    return 2


if __name__ == "__main__":
    sys.exit(main())
