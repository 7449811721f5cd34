"""The choice of the back end, on made-up machines."""

from __future__ import annotations

import ctypes
import os
import subprocess
import sys
from contextlib import nullcontext
from pathlib import Path

import pytest

from isac_rt import runtime
from isac_rt.runtime import Backend, RuntimeProblem

PROGRAM = Path(runtime.__file__)


@pytest.fixture
def machine(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """A machine without GPU whose only libraries are the files made in one folder; returns a maker
    of libraries.

    A made library is empty; `answers` says what it would tell of its version (None: it cannot be
    loaded)."""
    answers: dict[str, str | None] = {}
    monkeypatch.delenv("DRJIT_LIBLLVM_PATH", raising=False)
    monkeypatch.delenv("LD_LIBRARY_PATH", raising=False)
    monkeypatch.setattr(runtime, "SYSTEM_FOLDERS", (str(tmp_path),))
    monkeypatch.setattr(runtime, "_loader_cache", dict)
    monkeypatch.setattr(runtime, "_cuda", lambda: None)
    monkeypatch.setattr(runtime, "llvm_version", lambda path: answers[path])

    def make(name: str, version: str | None = None) -> str:
        path = tmp_path / name
        path.write_bytes(b"")
        answers[str(path)] = version
        return str(path)

    return make


def test_nothing_found_names_the_remedy(machine):
    with pytest.raises(
        RuntimeProblem, match=r"found none; install LLVM 19 .*libllvm19.*DRJIT_LIBLLVM_PATH"
    ):
        runtime.choose_backend()


@pytest.mark.parametrize(
    "name", ["libLLVM-14.so.1", "libLLVM-15.so", "libLLVM.so.16.0", "libLLVM.so.23.1"]
)
def test_unfit_versions_are_not_even_loaded(machine, name):
    """14 is refused by Dr.Jit, 15 and 16 abort it; planted bug: OLDEST_LLVM = 15."""
    machine(name, "19.1.7")  # would be taken if it were asked
    with pytest.raises(RuntimeProblem, match=rf"found only \S*{name} \(LLVM \d+\)"):
        runtime.choose_backend()


@pytest.mark.parametrize(
    ("names", "best"),
    [
        (["libLLVM.so.18.1", "libLLVM.so.19.1", "libLLVM.so.20.1"], "libLLVM.so.19.1"),
        (["libLLVM-17.so.1", "libLLVM.so.20.1", "libLLVM-15.so.1"], "libLLVM.so.20.1"),
        (["libLLVM.so"], "libLLVM.so"),
    ],
)
def test_best_version_is_taken(machine, names, best):
    paths = {name: machine(name, "18.1.3") for name in names}
    assert runtime.choose_backend() == Backend("llvm", paths[best], "18.1.3")


def test_a_library_that_lies_about_its_version_is_passed_over(machine):
    """The name says 19, the library 15; and one that cannot be loaded. Planted bug: the name alone
    is believed."""
    machine("libLLVM-19.so", "15.0.7")
    machine("libLLVM.so.20.1", None)
    good = machine("libLLVM.so.17.0", "17.0.6")
    assert runtime.choose_backend().path == good


def test_the_variable_is_believed_or_refused_but_never_passed_over(machine, monkeypatch):
    machine("libLLVM.so.19.1", "19.1.7")
    named = machine("libLLVM-18.so", "18.1.8")
    monkeypatch.setenv("DRJIT_LIBLLVM_PATH", named)
    assert runtime.choose_backend() == Backend("llvm", named, "18.1.8")
    for path, words in (
        (machine("libLLVM-15.so"), "is LLVM 15; .*unset DRJIT_LIBLLVM_PATH"),
        (named + ".missing", "not a file; unset DRJIT_LIBLLVM_PATH"),
        (machine("libLLVM-20.so", None), "cannot be loaded"),
        (machine("libLLVM.so", "16.0.6"), "is LLVM 16.0.6"),
    ):
        monkeypatch.setenv("DRJIT_LIBLLVM_PATH", path)
        with pytest.raises(RuntimeProblem, match=words):
            runtime.choose_backend()


def test_a_gpu_comes_before_llvm(machine, monkeypatch):
    machine("libLLVM.so.19.1", "19.1.7")
    monkeypatch.setattr(runtime, "_cuda", lambda: ("13.0", "a GPU"))
    assert runtime.choose_backend() == Backend("cuda", "libcuda.so.1", "13.0")


@pytest.mark.parametrize("library", [None, "libLLVM-15.so"])
def test_doctor_reports_what_is_missing(machine, library):
    """It must answer just where the ray tracer cannot run."""
    if library:
        machine(library)
    checks = {check.name: check for check in runtime.doctor()}
    assert set(checks) == {"python", "back end", "LLVM", "GPU", "memory", "cores", "packages"}
    assert not checks["back end"].ok and not checks["LLVM"].ok
    assert "libllvm19" in checks["LLVM"].remedy
    assert checks["python"].ok and checks["GPU"].ok


def test_doctor_names_missing_packages():
    check = runtime._check_packages(("numpy", "no-such-package-of-ours"))
    assert not check.ok and "no-such-package-of-ours" in check.remedy and "numpy" in check.found


def test_too_old_llvm_ends_a_process_with_one_message(tmp_path):
    """The whole program with no other libLLVM than a made-up 15: exit 2, one line, no abort (which
    would be -6)."""
    fake = tmp_path / "libLLVM-15.so"
    fake.write_bytes(b"not a library")
    environment = {**os.environ, "DRJIT_LIBLLVM_PATH": str(fake), "CUDA_VISIBLE_DEVICES": ""}
    done = subprocess.run(
        [sys.executable, "-I", str(PROGRAM)], capture_output=True, text=True, env=environment
    )
    assert done.returncode == 2
    assert done.stdout == ""
    assert (
        len(done.stderr.splitlines()) == 1
        and "LLVM 15" in done.stderr
        and "Traceback" not in done.stderr
    )


def test_a_file_that_is_no_library_does_not_answer(tmp_path):
    fake = tmp_path / "libLLVM.so"
    fake.write_bytes(b"\x7fELF nonsense")
    assert runtime.llvm_version(str(fake)) is None


@pytest.mark.sionna
def test_sionna_keeps_the_variant_that_activate_set():
    """In a process of its own: Sionna sets a variant on import only if none is set. Planted bug:
    activate() sets no variant."""
    program = (
        "from isac_rt.runtime import VARIANTS, activate\n"
        "backend = activate()\nassert activate() is backend\n"
        "import mitsuba as mi\nbefore = mi.variant()\nimport sionna.rt\n"
        "print(before == mi.variant() == VARIANTS[backend.kind])"
    )
    done = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True, cwd=PROGRAM.parent.parent
    )
    assert done.stdout.strip() == "True", done.stderr


@pytest.mark.sionna
def test_a_foreign_variant_is_refused():
    program = (
        "import mitsuba as mi\nmi.set_variant('scalar_rgb')\nfrom isac_rt.runtime import "
        "RuntimeProblem, activate\n"
        "try:\n    activate()\nexcept RuntimeProblem as problem:\n    print(problem)"
    )
    done = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True, cwd=PROGRAM.parent.parent
    )
    assert "already set to the variant scalar_rgb" in done.stdout, done.stderr


@pytest.mark.parametrize("ends", [None, KeyError])
def test_rays_are_traced_in_one_thread_for_a_while(ends):
    """The number of threads is what it was afterwards, whether or not what was done ended well.
    Planted bugs: the number not set; not set back after an error."""
    runtime.activate()
    import drjit

    before = drjit.thread_count()
    drjit.set_thread_count(3)
    try:
        with pytest.raises(KeyError) if ends else nullcontext(), runtime.tracing_in_one_thread():
            assert drjit.thread_count() == 1
            if ends:
                raise ends
        assert drjit.thread_count() == 3
    finally:
        drjit.set_thread_count(before)


@pytest.mark.skipif(not hasattr(ctypes.CDLL(None), "mallopt"), reason="is not glibc")
def test_memory_that_an_array_has_left_is_there_for_the_next():
    """Of 64 MB that a thread frees nothing goes back until it is asked how much there is. Planted
    bugs: nothing is said to glibc; nothing is given back."""
    code = """
import resource, threading
from pathlib import Path
from isac_rt.runtime import available_memory, settle_process
settle_process()
import numpy as np

def resident():
    return int(Path("/proc/self/statm").read_text().split()[1]) * resource.getpagesize()

def work():
    array = np.ones(8 << 20)
    before = resident()
    del array
    print(before - resident())
    available_memory()
    print(before - resident())

worker = threading.Thread(target=work)
worker.start()
worker.join()
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    kept, gone = map(int, done.stdout.split())
    assert abs(kept) < 8e6 < 56e6 < gone, done.stderr
