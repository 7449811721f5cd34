"""The Dr.Jit back end: which one this machine can run, checked before anything can abort the
process.

Dr.Jit 1.5 refuses LLVM 14, aborts the process with 15 and 16, and works from 17 on; an abort cannot
be caught. So every module that imports sionna, mitsuba or drjit calls `activate()` first. Sionna RT
sets a Mitsuba variant when it is imported and none is set; after `activate()` one is, and that
import changes nothing.

Run as a program (``python isac_rt/runtime.py``) it says which back end there is, with nothing but
the standard library.
"""

from __future__ import annotations

import ctypes
import errno
import functools
import gc
import importlib
import importlib.metadata
import os
import re
import subprocess
import sys
from collections.abc import Iterable, Iterator
from contextlib import chdir, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

OLDEST_LLVM = 17
NEWEST_LLVM = 22
VARIANTS = {"cuda": "cuda_ad_mono_polarized", "llvm": "llvm_ad_mono_polarized"}
MEMORY_NEEDED = 6e9
"""What the largest scenario of `scenes/` is held to. [bytes]"""
PACKAGES = "numpy scipy numba drjit mitsuba sionna-rt xarray h5netcdf h5py pydantic".split()
SYSTEM_FOLDERS = (
    "/usr/lib/x86_64-linux-gnu",
    "/usr/lib/aarch64-linux-gnu",
    "/usr/lib64",
    "/usr/lib",
    "/usr/local/lib",
    *(f"/usr/lib/llvm-{version}/lib" for version in range(NEWEST_LLVM, OLDEST_LLVM - 1, -1)),
)
_INSTALL_LLVM = (
    "install LLVM 19 (Debian 12 and later, Ubuntu 24.04 and later: apt install libllvm19)"
)

COLLECT = 100_000
"""Objects made until garbage is looked for among them: what commands import stays, and looking
through it after each 700 takes over a second, after each 20,000 twice as long as after so many.
Older ones are looked through as often as ever: what runs leave, figures above all, would pile up in
a command of many runs."""
LINEAR_ALGEBRA = "OPENBLAS_NUM_THREADS", "1"
"""Frames work in threads of their own. Those of numpy's library have nothing to do, but look for
work at first, both of the two copies that come with numpy and scipy: 0.2 s, more on a busy machine;
they are begun when numpy is loaded, after this is set."""
SWITCH_S = 2e-4
"""Time after which a thread that waits for the interpreter is given it. With Python's 5 ms a thread
that comes out of a kernel waits that long for one that has small things to do, and its core with
it."""
FREED_IS_KEPT = {-8: 1, -4: 0, -1: (1 << 31) - 1}
"""M_ARENA_MAX, M_MMAP_MAX and M_TRIM_THRESHOLD of glibc's mallopt: memory that one array has left
is there for the next, in whatever thread, and does not go back to the system, which clears pages
before it gives them out (7 % of a run's processor time). M_MMAP_THRESHOLD ends at 32 MiB."""
_NUMBA_CONFIG = ".numba_config.yaml"
_OF_THE_NAME = (errno.ENOENT, errno.ENOTDIR, errno.EISDIR, errno.ELOOP, errno.ENAMETOOLONG)
"""Numbers of errors that are of the file which was asked for, and not of the machine."""
_NO_MORE = re.compile("out of memory|can't start new thread", re.IGNORECASE)
"""What libraries say that raise no MemoryError."""


def shortly(problem: BaseException) -> str:
    """Shorten a library's message about a bad file to one line of at most 300 characters."""
    return " ".join(str(problem).split())[:300]


def settle_process() -> None:
    """Set the interpreter and the C library for the work of a command, before numpy is loaded; for
    a process of its own."""
    gc.set_threshold(COLLECT)
    sys.setswitchinterval(SWITCH_S)
    os.environ.setdefault(*LINEAR_ALGEBRA)
    for parameter, value in FREED_IS_KEPT.items():
        _ask_glibc("mallopt", parameter, value)


def shut_out_working_folder() -> None:
    """Keep files of the working folder, which may be a stranger's, from setting libraries up; for a
    process of its own, before it starts threads.

    matplotlib reads `matplotlibrc` once, when it is imported; numba reads `.numba_config.yaml`
    whenever it compiles.

    Raises
    ------
    UserError  If there is a file for numba.
    """
    if os.path.lexists(_NUMBA_CONFIG):
        raise UserError(
            f"{_NUMBA_CONFIG} in the working folder would set up the compiler; work in another "
            "folder or remove it (what is yours may stand in NUMBA_... of the environment)"
        )
    if os.path.lexists("matplotlibrc"):
        with chdir("/"):
            importlib.import_module("matplotlib")


def _ask_glibc(function: str, *arguments: int) -> None:
    """Call a function of glibc; nothing with another C library."""
    symbol = getattr(ctypes.CDLL(None), function, None)
    if symbol is not None:
        symbol(*arguments)


class UserError(Exception):
    """Error that the user can mend: the text says what, where, the limit and the remedy. The
    command line prints it alone and exits with 2."""


class MissingPackage(UserError, ModuleNotFoundError):
    """A package that only some of the program needs is not installed."""


def needed(module: str, extra: str) -> Any:
    """Import a module that one of this package's extras installs.

    Raises
    ------
    MissingPackage  If it is not installed.
    """
    try:
        return importlib.import_module(module)
    except ModuleNotFoundError as problem:
        raise MissingPackage(
            f"this needs the package {module}: pip install 'isac_rt[{extra}]'"
        ) from problem


class MachineProblem(UserError):
    """The machine will not do as it is: its disk, its memory, a library. The same may succeed at
    another time or place."""


class RuntimeProblem(MachineProblem):
    """The ray tracer cannot run here; the text says why and what to do."""


def of_machine(problem: BaseException) -> bool:
    """Return whether the machine caused an error and not the request, also where another error was
    made of the machine's.

    Examples
    --------
    >>> of_machine(OSError(errno.ENOSPC, "No space left on device")), of_machine(ValueError("x"))
    (True, False)
    """
    seen: BaseException | None = problem
    while seen is not None:
        if isinstance(seen, MachineProblem | MemoryError):
            return True
        if isinstance(seen, OSError) and seen.errno not in (None, *_OF_THE_NAME):
            return True
        if isinstance(seen, RuntimeError) and _NO_MORE.search(str(seen)):
            return True
        seen = seen.__cause__ or seen.__context__
    return False


@dataclass(frozen=True)
class Backend:
    """Back end that Dr.Jit runs on.

    Parameters
    ----------
    kind : {'cuda', 'llvm'}
    path : str
        The shared library: libcuda or libLLVM.
    version : str
        Of the CUDA driver interface or of LLVM.
    """

    kind: str
    path: str
    version: str


@dataclass(frozen=True)
class Check:
    """One line of `doctor`: what was looked at, whether it will do, what was found, and what to do
    about it."""

    name: str
    ok: bool
    found: str
    remedy: str = ""


# ---- LLVM


def _library_folders() -> Iterator[Path]:
    for name in os.environ.get("LD_LIBRARY_PATH", "").split(":"):
        if name:
            yield Path(name)
    yield from map(Path, SYSTEM_FOLDERS)


def _loader_cache() -> dict[str, str]:
    """Library name -> path, as the dynamic loader's cache has it; empty where there is no such
    cache."""
    for program in ("/sbin/ldconfig", "/usr/sbin/ldconfig", "ldconfig"):
        try:
            listing = subprocess.run(
                [program, "-p"], capture_output=True, text=True, timeout=10, check=True
            ).stdout
        except (OSError, subprocess.SubprocessError):
            continue
        return {
            m[1]: m[2] for m in re.finditer(r"^\s*(\S+) \(.*\) => (\S+)$", listing, re.MULTILINE)
        }
    return {}


def llvm_candidates() -> list[str]:
    """Every libLLVM on this machine, one path per file, in the order in which they were found."""
    paths = [Path(path) for name, path in _loader_cache().items() if name.startswith("libLLVM")]
    for folder in _library_folders():
        try:
            paths += sorted(folder.glob("libLLVM*.so*"))
        except OSError:  # a folder that may not be read
            continue
    distinct: dict[str, str] = {}
    for path in paths:
        if path.is_file():
            distinct.setdefault(os.path.realpath(path), str(path))
    return list(distinct.values())


def _version_in_name(path: str) -> int | None:
    """Major version from names such as libLLVM.so.19.1, libLLVM-19.so.1 and libLLVM-19.1.7.so."""
    name = os.path.basename(os.path.realpath(path))
    match = re.match(r"libLLVM(?:\.so\.|-)(\d+)", name)
    return int(match[1]) if match else None


def _ask(program: str, *arguments: str) -> str | None:
    """Return what a Python program prints in a process of its own; None when it fails or dies."""
    try:
        done = subprocess.run(
            [sys.executable, "-I", "-S", "-c", program, *arguments],
            capture_output=True,
            text=True,
            timeout=60,
        )
    except (OSError, subprocess.SubprocessError):
        return None
    return done.stdout.strip() if done.returncode == 0 else None


_LLVM_PROGRAM = """
import ctypes, sys
library = ctypes.CDLL(sys.argv[1])
numbers = [ctypes.c_uint() for _ in range(3)]
library.LLVMGetVersion(*map(ctypes.byref, numbers))  # since LLVM 16
print('.'.join(str(n.value) for n in numbers))
"""


def llvm_version(path: str) -> str | None:
    """Version of a libLLVM, asked of the library itself in another process; None if it cannot be
    loaded or is older than 16."""
    return _ask(_LLVM_PROGRAM, path)


def _usable(version: int) -> bool:
    return OLDEST_LLVM <= version <= NEWEST_LLVM


def _refusal(path: str, version: str) -> str:
    return (
        f"{path} is LLVM {version}; the ray tracer (Dr.Jit 1.5) needs LLVM {OLDEST_LLVM} to "
        f"{NEWEST_LLVM} "
        "(14 is refused, 15 and 16 end the process)"
    )


def _llvm_from_environment(path: str) -> Backend:
    """The library that DRJIT_LIBLLVM_PATH names, or the reason why it will not do."""
    remedy = (
        f"unset DRJIT_LIBLLVM_PATH or let it name a libLLVM of version {OLDEST_LLVM} to "
        f"{NEWEST_LLVM}"
    )
    if "/" not in path:
        path = _loader_cache().get(path, path)
    if "/" in path and not os.path.isfile(path):
        raise RuntimeProblem(f"DRJIT_LIBLLVM_PATH names {path}, which is not a file; {remedy}")
    named = _version_in_name(path)
    if named is not None and not _usable(named):
        raise RuntimeProblem(f"DRJIT_LIBLLVM_PATH: {_refusal(path, str(named))}; {remedy}")
    version = llvm_version(path)
    if version is None:
        raise RuntimeProblem(
            f"DRJIT_LIBLLVM_PATH: {path} cannot be loaded as LLVM of version 16 or later; {remedy}"
        )
    if not _usable(int(version.split(".")[0])):
        raise RuntimeProblem(f"DRJIT_LIBLLVM_PATH: {_refusal(path, version)}; {remedy}")
    return Backend("llvm", path, version)


def _preference(path: str) -> tuple[bool, int]:
    """Names that state LLVM 19 first (the version most used here), then newer before older, then
    names without a version."""
    version = _version_in_name(path)
    return version != 19, -(version or 0)


def _find_llvm() -> Backend:
    given = os.environ.get("DRJIT_LIBLLVM_PATH")
    if given:
        return _llvm_from_environment(given)
    unfit = []
    for path in sorted(llvm_candidates(), key=_preference):
        named = _version_in_name(path)
        if named is not None and not _usable(named):
            unfit.append(f"{path} (LLVM {named})")
            continue
        version = llvm_version(path)
        if version is not None and _usable(int(version.split(".")[0])):
            return Backend("llvm", path, version)
        unfit.append(f"{path} ({f'LLVM {version}' if version else 'cannot be loaded'})")
    candidates = f"only {', '.join(unfit)}" if unfit else "none"
    raise RuntimeProblem(
        f"no usable LLVM: the ray tracer (Dr.Jit 1.5) needs libLLVM {OLDEST_LLVM} to {NEWEST_LLVM} "
        f"or an NVIDIA GPU; found {candidates}; "
        f"{_INSTALL_LLVM}, or set DRJIT_LIBLLVM_PATH to one"
    )


# ---- CUDA

_CUDA_PROGRAM = """
import ctypes
cuda = ctypes.CDLL('libcuda.so.1')
ctypes.CDLL('libnvoptix.so.1')
count, version, device = ctypes.c_int(), ctypes.c_int(), ctypes.c_int()
name = ctypes.create_string_buffer(100)
assert cuda.cuInit(0) == 0 and cuda.cuDeviceGetCount(ctypes.byref(count)) == 0 and count.value > 0
assert cuda.cuDriverGetVersion(ctypes.byref(version)) == 0
assert cuda.cuDeviceGet(ctypes.byref(device), 0) == 0
cuda.cuDeviceGetName(name, 100, device)
print(version.value // 1000, version.value % 1000 // 10, name.value.decode(), sep='|')
"""


@functools.cache
def _cuda() -> tuple[str, str] | None:
    """Driver interface version and name of the first NVIDIA GPU; None without a GPU, its driver or
    the driver's OptiX.

    Mitsuba's CUDA variants trace rays by OptiX, which containers often lack although CUDA works.
    Asked in another process, because a driver once started does not survive a fork.
    `CUDA_VISIBLE_DEVICES=` (empty) hides the GPU.
    """
    if not os.path.exists("/dev/nvidiactl") and not os.path.exists("/dev/dxg"):
        return None
    answer = _ask(_CUDA_PROGRAM)
    if not answer:
        return None
    major, minor, name = answer.split("|", 2)
    return f"{major}.{minor}", name


# ---- choice


def choose_backend() -> Backend:
    """The back end that Dr.Jit is to use: CUDA where an NVIDIA GPU is usable, else LLVM.

    Returns
    -------
    backend : Backend

    Raises
    ------
    RuntimeProblem
        If there is neither; the text names what was found and the remedy.
    """
    gpu = _cuda()
    return Backend("cuda", "libcuda.so.1", gpu[0]) if gpu else _find_llvm()


@functools.cache
def activate() -> Backend:
    """Choose the back end, tell Dr.Jit and set Mitsuba's variant. Called before every import of
    sionna; later calls are free.

    Returns
    -------
    backend : Backend

    Raises
    ------
    RuntimeProblem
        If no back end is usable or Mitsuba was already set to a variant that Sionna RT cannot use.
    """
    backend = choose_backend()
    if backend.kind == "llvm":
        os.environ["DRJIT_LIBLLVM_PATH"] = backend.path
    import mitsuba as mi

    variant = mi.variant()
    if variant is None:
        try:
            mi.set_variant(VARIANTS[backend.kind])
        except ImportError as error:
            raise RuntimeProblem(
                f"Mitsuba cannot start its variant {VARIANTS[backend.kind]}: {error}; install the "
                "locked packages again (make setup)"
            ) from None
    elif variant not in VARIANTS.values():
        raise RuntimeProblem(
            f"Mitsuba is already set to the variant {variant}, the ray tracer needs "
            f"{' or '.join(VARIANTS.values())}; "
            "call isac_rt.runtime.activate() before anything else sets a variant"
        )
    resolver_of: Any = mi.file_resolver  # which its stubs do not know
    resolver = resolver_of()  # looks for libraries in the working folder first
    resolver.clear()
    resolver.append(str(Path(mi.__file__).parent))
    return backend


@contextmanager
def tracing_in_one_thread() -> Iterator[None]:
    """Let the ray tracer, where it is loaded, work in a single thread.

    Its other threads look for work all the time while there is none.
    """
    drjit = sys.modules.get("drjit")
    if drjit is None:
        yield
        return
    before = drjit.thread_count()
    drjit.set_thread_count(1)
    try:
        yield
    finally:
        drjit.set_thread_count(before)


# ---- doctor


def _check_python() -> Check:
    version = ".".join(map(str, sys.version_info[:3]))
    return Check("python", sys.version_info >= (3, 11), version, "use Python 3.11 or later")


def _check_backend() -> Check:
    try:
        backend = choose_backend()
    except RuntimeProblem as problem:
        return Check("back end", False, "none", str(problem))
    return Check("back end", True, f"{backend.kind} {backend.version} ({backend.path})")


def _check_llvm() -> Check:
    try:
        backend = _find_llvm()
    except RuntimeProblem as problem:
        # with a GPU there is no need of LLVM
        return Check("LLVM", _cuda() is not None, "none that is usable", str(problem))
    return Check("LLVM", True, f"{backend.version} ({backend.path})")


def _check_gpu() -> Check:
    gpu = _cuda()
    return Check("GPU", True, f"{gpu[1]}, CUDA {gpu[0]}" if gpu else "none; LLVM is used")


def _number_in(path: str) -> float | None:
    try:
        return float(Path(path).read_text().strip())
    except (OSError, ValueError):  # a control group without a limit says "max"
        return None


def available_memory() -> float | None:
    """Memory that this process may still take: the machine's or its control group's, whichever is
    less. [bytes]"""
    _ask_glibc("malloc_trim", 0)  # what was kept for the next array goes back
    try:
        match = re.search(
            r"^MemAvailable:\s+(\d+) kB", Path("/proc/meminfo").read_text(), re.MULTILINE
        )
    except OSError:
        match = None
    limits = [1024.0 * int(match[1])] if match else []
    group = "/sys/fs/cgroup"
    for limit_file, use_file in (
        ("memory.max", "memory.current"),
        ("memory/memory.limit_in_bytes", "memory/memory.usage_in_bytes"),
    ):
        limit, use = _number_in(f"{group}/{limit_file}"), _number_in(f"{group}/{use_file}")
        if limit is not None and use is not None:
            limits.append(limit - use)
    return min(limits, default=None)


def _check_memory() -> Check:
    memory = available_memory()
    size = "unknown" if memory is None else f"{memory / 1e9:.1f} GB available"
    remedy = f"free some memory: the largest scenes take up to {MEMORY_NEEDED / 1e9:.0f} GB"
    return Check("memory", memory is None or memory >= MEMORY_NEEDED, size, remedy)


def _check_cores() -> Check:
    cores = len(os.sched_getaffinity(0))
    set_variables = [
        f"{name}={os.environ[name]}"
        for name in ("NUMBA_NUM_THREADS", "OMP_NUM_THREADS")
        if name in os.environ
    ]
    return Check(
        "cores",
        cores >= 2,
        ", ".join([str(cores), *set_variables]),
        "runs on one core, but slowly; give the process two or more",
    )


def _check_packages(names: Iterable[str] = PACKAGES) -> Check:
    present, missing = [], []
    for name in names:
        try:
            present.append(f"{name} {importlib.metadata.version(name)}")
        except importlib.metadata.PackageNotFoundError:
            missing.append(name)
    return Check(
        "packages",
        not missing,
        ", ".join(present),
        f"missing: {', '.join(missing)}; run make setup",
    )


def doctor() -> list[Check]:
    """Look at everything that a run rests on. Starts no back end, so it answers on a machine that
    cannot run one.

    Returns
    -------
    checks : list of Check
        `remedy` is meant for a check that is not ok.
    """
    looks = (
        _check_python,
        _check_backend,
        _check_llvm,
        _check_gpu,
        _check_memory,
        _check_cores,
        _check_packages,
    )
    return [check() for check in looks]


def main() -> int:
    """Print the back end and return 0, or the reason why there is none and return 2."""
    try:
        backend = choose_backend()
    except RuntimeProblem as problem:
        print(problem, file=sys.stderr)
        return 2
    print(f"{backend.kind} {backend.version} ({backend.path})")
    return 0


if __name__ == "__main__":
    sys.exit(main())
