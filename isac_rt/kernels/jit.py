"""The decorator of every compiled function, and where their machine code is kept.

Machine code holds that of the functions which are called and the constants which are named, from
whatever module they come. It is therefore kept in a folder for each module, whose name is a digest
of the source of that module, of the modules with compiled functions that it imports, and of those
that these import constants from: changed source never finds old code. The folders stand in the one
that the variable `CACHE` of the environment names, else NUMBA_CACHE_DIR, else the user's cache.
Where it cannot be written, every process compiles for itself.
"""

from __future__ import annotations

import hashlib
import logging
import os
import re
import shutil
import tempfile
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from functools import cache, lru_cache, partial
from pathlib import Path
from typing import Any

import numba
from llvmlite import binding
from numba.core import caching, event

from isac_rt.storage import is_own_folder

_LOG = logging.getLogger(__name__)
CACHE = "ISAC_RT_CACHE"
"""Variable of the environment: folder of the machine code."""
MAX_CACHES = 8
"""Sources of a module whose machine code is kept, the last used."""
FAST = ("contract", "nnan", "ninf", "nsz")
"""Freedoms of the compiler that do not depend on the vector width."""
_COMPILES = re.compile(rb"^(from|import) (numba|isac_rt\.kernels\.jit)\b", re.MULTILINE)
_IMPORT = re.compile(rb"^from isac_rt\.([\w.]+) import (\([^)]*\)|.*)", re.MULTILINE)
_CONSTANT = re.compile(rb"\b_?[A-Z][A-Z0-9_]+\b")
_WORD = re.compile(rb"\w+")

AVX512 = bool(binding.get_host_cpu_features().get("avx512f"))
"""Whether a register holds sixteen float32 here."""


def use_whole_registers() -> None:
    """Let loops take whole AVX-512 registers, which LLVM halves for the first processors that had
    them: 6 % of a run's processor time, the same bits.

    For a process of its own, before another module of `kernels` is imported: it is a setting of
    numba as a whole, which the first decorated function fixes.
    """
    config: Any = numba.config
    if AVX512 and config.CPU_FEATURES is None:
        features = binding.get_host_cpu_features().flatten()
        config.CPU_FEATURES = f"{features},-prefer-256-bit"


class _Counter(event.Listener):
    """Logs how many kernels were compiled, which later runs need not."""

    def __init__(self) -> None:
        self.compiled = 0

    def on_start(self, compiling: event.Event) -> None:
        kernel = compiling.data["dispatcher"].py_func
        if kernel.__module__.startswith("isac_rt."):
            self.compiled += 1
            _LOG.info("compiling for this machine, kernel %d", self.compiled)

    def on_end(self, compiled: event.Event) -> None:
        pass


_COUNTER = _Counter()


def compilations_logged() -> AbstractContextManager[None]:
    """Log the count of kernels that this process compiled, as it grows meanwhile."""
    return event.install_listener("numba:compile", _COUNTER)


def jit(
    function: Callable | None = None,
    *,
    fast: bool = False,
    inline: bool = False,
    borrows: bool = False,
) -> Any:
    """Compile a function: it runs without the interpreter's lock and divides by zero as numpy does.

    Parameters
    ----------
    fast : products and sums are fused; NaN, infinities and the sign of zero are not minded
    inline : a part of the functions that call it, whose freedom it shares
    borrows : all its arrays are its caller's or parts of them: it makes none and returns none. Then
        nobody counts who refers to them, which else every part of an array and every array of a
        tuple does, twice, with an atomic addition that all threads wait for
    """
    if function is None:
        return partial(jit, fast=fast, inline=inline, borrows=borrows)
    compiled: Any = numba.njit  # whose stubs do not know `_nrt`
    with _located():
        return compiled(
            nogil=True,
            error_model="numpy",
            fastmath=set(FAST) if fast else False,
            inline="always" if inline else "never",
            cache=not inline and cache_folder(function.__module__) is not None,
            _nrt=not borrows,
        )(function)


TWINS_ONLY = os.environ.get("ISAC_RT_KERNELS") == "0"
"""Run the numpy twins instead of the kernels."""
TWINS: dict[str, tuple[Callable, Callable]] = {}
"""Kernel and numpy twin by the twin's full name, for the test that holds both together."""


def twin_of(kernel: Callable) -> Callable[[Callable], Callable]:
    """Mark a numpy function as the readable twin of a kernel with the same arguments.

    The function's name then stands for the kernel, or with `ISAC_RT_KERNELS=0` for the twin.

    Examples
    --------
    >>> @jit
    ... def _total(values):
    ...     out = 0.0
    ...     for value in values:
    ...         out += value
    ...     return out
    >>> @twin_of(_total)
    ... def total(values):
    ...     return values.sum()
    """

    def chosen(twin: Callable) -> Callable:
        TWINS[f"{twin.__module__}.{twin.__qualname__}"] = kernel, twin
        return twin if TWINS_ONLY else kernel

    return chosen


@lru_cache
def digest(module: str) -> str:
    """Digest the source of all that a module's machine code depends on: the module and what it
    calls."""
    root = Path(__file__).parents[1]
    chosen = [root.joinpath(*module.split(".")[1:]).with_suffix(".py")]
    for path in chosen:  # grows while it is read
        if _compiles(path) or path == chosen[0]:  # of others only constants count
            chosen += [file for file in _needed(path) if file not in chosen]
    found = hashlib.sha256()
    for path in sorted(chosen):
        source = _source(path)
        found.update(f"{path.relative_to(root)}:{len(source)}:".encode() + source)
    return found.hexdigest()[:16]


_source = cache(Path.read_bytes)


@cache
def _compiles(path: Path) -> bool:
    """Return whether a file has compiled functions."""
    return _COMPILES.search(_source(path)) is not None


@cache
def _needed(path: Path) -> list[Path]:
    """The files of this package from which a file imports constants or compiled functions."""
    root, found = Path(__file__).parents[1], dict[Path, None]()
    for name, imported in _IMPORT.findall(_source(path)):
        source = root.joinpath(*name.decode().split("."))
        inside = [source / f"{word.decode()}.py" for word in _WORD.findall(imported)]
        some = [file for file in (source.with_suffix(".py"), *inside) if file.exists()]
        constants = _CONSTANT.search(imported) is not None
        found |= dict.fromkeys(file for file in some if constants or _compiles(file))
    return list(found)


@lru_cache
def cache_folder(module: str) -> Path | None:
    """Folder of a module's machine code, made if need be; None where none can be written, or others
    can write it: what lies there is run.

    Those of other sources of the module are removed but for the last used.
    """
    named = os.environ.get(CACHE) or os.environ.get("NUMBA_CACHE_DIR")
    short = module.removeprefix("isac_rt.")
    try:
        user = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "isac_rt"
        folder = (Path(named) if named else user) / f"{short}-{digest(module)}"
        folder.mkdir(parents=True, exist_ok=True)
        if not is_own_folder(folder.parent) or not is_own_folder(folder):
            return None
        tempfile.TemporaryFile(dir=folder).close()  # which also says that it was used today
        others = sorted(folder.parent.glob(f"{short}-*"), key=lambda f: f.stat().st_mtime)
    except (OSError, RuntimeError):
        return None
    for old in others[:-MAX_CACHES]:
        shutil.rmtree(old, ignore_errors=True)
    return folder


class Locator(caching._CacheLocator):
    """Says where numba keeps a function's machine code, by its setting `CACHE_LOCATOR_CLASSES`."""

    def __init__(self, function: Callable) -> None:
        self._function = function

    def get_cache_path(self) -> str:
        return str(cache_folder(self._function.__module__))

    def get_source_stamp(self) -> str:
        return digest(self._function.__module__)

    def get_disambiguator(self) -> str:
        return str(self._function.__code__.co_firstlineno)

    @classmethod
    def from_function(cls, py_func: Callable, py_file: str) -> Locator:
        return cls(py_func)


@contextmanager
def _located() -> Iterator[None]:
    """Have numba ask `Locator` alone for the places of what is decorated meanwhile."""
    config: Any = numba.config
    before = config.CACHE_LOCATOR_CLASSES
    config.CACHE_LOCATOR_CLASSES = f"{Locator.__module__}.{Locator.__qualname__}"
    try:
        yield
    finally:
        config.CACHE_LOCATOR_CLASSES = before
