"""Compiled functions: the machine code that is kept is that of the source as it is."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

PACKAGE = Path(__file__).parents[2] / "isac_rt"
INNER = """from isac_rt.kernels.jit import jit

@jit
def inner(x):
    return x + 1000
"""
OUTER = """from isac_rt.kernels.inner import inner
from isac_rt.kernels.jit import jit
from isac_rt.randomness import SHIFT

@jit
def outer(x):
    return inner(x) + SHIFT
"""
RUN = "from isac_rt.kernels.outer import outer; print(outer(1), len(outer.stats.cache_hits))"


@pytest.fixture
def copy(tmp_path):
    """A copy of the package with two small kernels of its own in it."""
    shutil.copytree(PACKAGE, tmp_path / "isac_rt", ignore=shutil.ignore_patterns("__pycache__"))
    (tmp_path / "isac_rt/kernels/outer.py").write_text(OUTER)
    (tmp_path / "isac_rt/kernels/inner.py").write_text(INNER)
    constants = tmp_path / "isac_rt/randomness.py"
    constants.write_text(constants.read_text() + "\nSHIFT = 20000\n")
    return tmp_path


def run(folder: Path, code: str = RUN, **environment: str) -> list[str]:
    """What a process says that runs the copy."""
    done = subprocess.run(
        [sys.executable, "-c", code],
        env=os.environ
        | {"PYTHONPATH": str(folder), "ISAC_RT_CACHE": str(folder / "cache")}
        | {"PYTHONDONTWRITEBYTECODE": "1"}
        | environment,
        cwd=folder,
        capture_output=True,
        text=True,
        check=True,
    )
    return done.stdout.split()


BORROWS = """import numpy as np
from isac_rt.kernels.jit import jit

@jit(borrows=True)
def total(x, out):
    for i in range(len(x)):
        line = x[i]
        for k in range(i % 3, line.size):
            out[0] += line[k]

@jit(borrows=True)
def part(x):
    return x[1:]

@jit(borrows=True)
def copied(x):
    return (x + 1).size
"""


def change(file: Path, old: str, new: str) -> None:
    """Another line of the same length at the same time: nothing but the text tells."""
    when = file.stat()
    assert len(old) == len(new) and file.read_text().count(old) == 1
    file.write_text(file.read_text().replace(old, new))
    os.utime(file, ns=(when.st_atime_ns, when.st_mtime_ns))


@pytest.mark.parametrize(
    ("file", "old", "new", "answer"),
    [
        pytest.param(
            "kernels/outer.py",
            "inner(x) + SHIFT",
            "inner(x) - SHIFT",
            "-18999",
            marks=pytest.mark.slow,
        ),
        ("kernels/inner.py", "x + 1000", "x + 4000", "24001"),
        ("randomness.py", "SHIFT = 20000", "SHIFT = 70000", "71001"),
    ],
)
def test_a_changed_line_runs(copy, file, old, new, answer):
    """In the function itself, in one that it calls and in a constant from another module. Planted
    bugs: `digest` of kernels/jit.py alone (the called function's and the constant's old values
    answer); a function that was loaded links the module of names to one that is compiled."""
    assert run(copy) == ["21001", "0"]
    assert run(copy) == ["21001", "1"]
    change(copy / "isac_rt" / file, old, new)
    assert run(copy) == [answer, "0"]
    change(copy / "isac_rt" / file, new, old)
    assert run(copy) == ["21001", "1"]


@pytest.mark.parametrize(
    "body",
    [
        pytest.param("{'a': x, 'b': 2}['a'] + 1", marks=pytest.mark.slow),
        pytest.param(
            "np.linalg.solve(np.eye(3), np.full(3, 1.0 * x)).sum() + np.random.rand()",
            marks=pytest.mark.slow,
        ),
        pytest.param("sorted([str(n) for n in range(x, x + 40)])[0]", marks=pytest.mark.slow),
        "len(set([x, 3, x + 1])) + math.erf(x) + abs((x + 2j) ** 0.5)",
    ],
)
def test_machine_code_finds_what_it_calls(copy, body):
    """What numba brings along: hashes of words, linear algebra, random numbers, lists, sets. A name
    that is not there ends the process. Planted bug: the memory of arrays is not there."""
    inner = copy / "isac_rt/kernels/inner.py"
    inner.write_text("import math\nimport numpy as np\n" + INNER.replace("x + 1000", body))
    code = "from isac_rt.kernels.inner import inner; inner(3); print(len(inner.stats.cache_hits))"
    assert run(copy, code) == ["0"]
    assert run(copy, code) == ["1"]


def test_a_layout_that_is_not_known_is_loaded_whole(copy):
    """As a later numba may keep machine code: here in a box. Planted bug: it is taken apart all the
    same (ValueError)."""
    boxed = """
from numba.core.caching import CompileResultCacheImpl as kept
reduce, rebuild = kept.reduce, kept.rebuild
kept.reduce = lambda self, result: [reduce(self, result)]
kept.rebuild = lambda self, target, box: rebuild(self, target, *box)
"""
    assert run(copy, boxed + RUN) == ["21001", "0"]
    assert run(copy, boxed + RUN) == ["21001", "1"]


@pytest.mark.parametrize(
    ("module", "file"),
    [
        ("kernels.signal_noise", "kernels/signal_noise.py"),
        ("kernels.signal_gridded", "kernels/vector.py"),
        ("receive.spectrum", "kernels/fourier.py"),
        ("extensions.two_bounces.two_bounces", "propagation/clutter/field.py"),
    ],
)
def test_every_kernel_that_is_called_counts(copy, module, file):
    """A line of any kernel of a module's own changes the folder; one that it does not use does not.

    `receive.spectrum` imports its kernels as a module.
    """
    code = f"from isac_rt.kernels.jit import digest; print(digest('isac_rt.{module}'))"
    first = run(copy, code)
    for other in ("views/report.py", "views/render.py"):
        (copy / "isac_rt" / other).write_text("")
    assert run(copy, code) == first
    with (copy / "isac_rt" / file).open("a") as source:
        source.write("\n")
    assert run(copy, code) != first


def test_what_borrows_makes_no_array(copy):
    """And returns none: it is not compiled. Planted bug: `_nrt` left at its default."""
    (copy / "isac_rt/kernels/outer.py").write_text(BORROWS)
    code = """
import numpy as np
from numba.core.errors import NumbaError
from isac_rt.kernels import outer
x, out = np.ones((4, 5)), np.zeros(1)
outer.total(x, out)
print(out[0])
for wrong in outer.part, outer.copied:
    try:
        wrong(x)
    except NumbaError:
        print("no")
"""
    assert run(copy, code) == ["17.0", "no", "no"]


def test_where_nothing_can_be_written_every_process_compiles(copy):
    (copy / "file").write_text("")
    assert run(copy, ISAC_RT_CACHE=str(copy / "file")) == ["21001", "0"]


@pytest.mark.parametrize("way", ["others write it", "others write above", "of another", "linked"])
def test_machine_code_that_others_could_plant_is_not_run(way, copy):
    """Planted bug: only the folder itself is looked at; links are not followed."""
    above = copy / "above"
    cache = above / "cache"
    cache.mkdir(parents=True)
    assert run(copy, ISAC_RT_CACHE=str(cache)) == ["21001", "0"]
    assert run(copy, ISAC_RT_CACHE=str(cache)) == ["21001", "1"]
    if way == "others write it":
        cache.chmod(0o1777)
    elif way == "others write above":
        above.chmod(0o777)
    elif os.geteuid():
        pytest.skip("only root gives a folder to another")
    else:
        os.chown(above, 12345, -1)
    if way == "linked":
        (copy / "link").symlink_to(cache)
        cache = copy / "link"
    assert run(copy, ISAC_RT_CACHE=str(cache)) == ["21001", "0"]


def test_a_folder_in_one_that_all_share_as_tmp_is_used(copy):
    (copy / "shared").mkdir()
    (copy / "shared").chmod(0o1777)
    assert run(copy, ISAC_RT_CACHE=str(copy / "shared/own")) == ["21001", "0"]
    assert run(copy, ISAC_RT_CACHE=str(copy / "shared/own")) == ["21001", "1"]


def test_old_machine_code_goes(copy):
    """Of twelve sources of a module the eight last used stay."""
    for number in range(11):
        old = copy / f"cache/kernels.outer-{number:02}"
        old.mkdir(parents=True)
        os.utime(old, (number, number))
    run(copy)
    left = sorted(f.name for f in (copy / "cache").glob("kernels.outer-*"))
    assert len(left) == 8 and "kernels.outer-03" not in left and "kernels.outer-04" in left


def test_two_processes_compile_at_once(copy):
    code = f"{RUN}; from isac_rt.kernels.inner import inner; inner(1.5)"
    environment = os.environ | {"PYTHONPATH": str(copy), "ISAC_RT_CACHE": str(copy / "cache")}
    settings = {"env": environment, "cwd": copy, "stdout": subprocess.PIPE, "text": True}
    both = [subprocess.Popen([sys.executable, "-c", code], **settings) for _ in range(2)]
    assert [p.communicate()[0].split()[0] for p in both] == ["21001"] * 2
    assert run(copy) == ["21001", "1"]


def test_a_run_asks_for_whole_registers_before_its_first_kernel():
    """The first decorated function fixes numba's target. Seen failing where `run` asked once the
    program was loaded: kernels then used half registers."""
    code = """if True:
    import sys
    from isac_rt.kernels import jit
    jit.use_whole_registers = lambda: print([m for m in sys.modules if "isac_rt.kernels." in m])
    from isac_rt.cli.cli import main
    main(["run", "none.yaml"])"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "['isac_rt.kernels.jit']"
