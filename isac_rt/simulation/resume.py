"""The frames of a run that was stopped, in a file beside its results: the same run goes on after
them, to the same bits.

The file is an SQLite database, so that an entry is in it whole or not at all, whenever the process
is killed. It says which run it is of: a digest of the scenario, the city's file, the program and
the versions under it. An entry is data only: a tree of words, numbers, lists and mappings as JSON,
and the bytes of its arrays.
"""

from __future__ import annotations

import hashlib
import json
import math
import sqlite3
import time
from collections.abc import Iterator
from contextlib import closing, contextmanager, suppress
from pathlib import Path
from typing import Any, Literal

import numpy as np

from isac_rt.runtime import UserError

FILE = "resume.sqlite"
EARLIER = "unfinished.frames"
"""What earlier versions wrote, which is not read."""
TABLES = (
    "BEGIN",
    "CREATE TABLE IF NOT EXISTS run (digest TEXT PRIMARY KEY)",
    "CREATE TABLE IF NOT EXISTS entry (id INTEGER PRIMARY KEY, tree TEXT, arrays BLOB)",
)
EVERY = 5.0
"""Least time between two entries: what a stop can cost, beside the frame at work. [s]"""
ENTRY_PROBLEMS = (sqlite3.Error, ArithmeticError, LookupError, RuntimeError, TypeError, ValueError)
"""What reading an entry can raise that no run wrote."""
ARRAY = "array"
"""Key of a mapping that stands for an array: its type, shape and order (C, F), and where its
bytes begin."""


class ResumeError(UserError):
    """The file holds what no run of this package wrote."""


class Resume:
    """The kept frames of one run.

    Parameters
    ----------
    folder : of the results
    content : all that the run's results depend on, as text
    every : least time between two entries [s]
    """

    def __init__(self, folder: str | Path, content: str, every: float = EVERY) -> None:
        self.file = Path(folder) / FILE
        self._digest = hashlib.sha256(content.encode()).hexdigest()
        self._every, self._last, self._broken = every, time.monotonic(), False

    @property
    def begun(self) -> bool:
        """Whether there is a file of this very run."""
        try:
            with self._open("rw") as database:
                return database.execute("SELECT digest FROM run").fetchall() == [(self._digest,)]
        except sqlite3.Error:
            return False

    @property
    def other(self) -> Path | None:
        """A file that is not of this run: of another one, or of an earlier version."""
        files = (self.file, self.file.with_name(EARLIER))
        return None if self.begun else next((file for file in files if file.exists()), None)

    def entries(self) -> Iterator[Any]:
        """What an earlier call kept, in its order; nothing if there is none or if it belongs to
        another run.

        Raises
        ------
        ResumeError  If an entry is not one of this package's.
        """
        if self.begun:
            with self.reading(), self._open("rw") as database:
                for tree, arrays in database.execute("SELECT tree, arrays FROM entry ORDER BY id"):
                    yield unpack(tree, arrays)

    @contextmanager
    def reading(self) -> Iterator[None]:
        """Turn what goes wrong with an entry into one message."""
        try:
            yield
        except ENTRY_PROBLEMS as problem:
            raise ResumeError(
                f"{self.file} was not written by isac-rt ({type(problem).__name__}: {problem}); "
                "delete it"
            ) from problem

    def due(self) -> bool:
        """Whether it is time for an entry."""
        return not self._broken and time.monotonic() - self._last >= self._every

    def append(self, entry: Any) -> None:
        """Keep an entry. Where it cannot be written the run goes on and nothing is kept."""
        try:
            if not self.begun:
                self.remove()
            with self._open("rwc") as database, database:
                for command in TABLES:
                    database.execute(command)
                database.execute("INSERT OR IGNORE INTO run VALUES (?)", (self._digest,))
                database.execute("INSERT INTO entry (tree, arrays) VALUES (?, ?)", pack(entry))
        except sqlite3.Error:
            self._broken = True
            self.remove()
        self._last = time.monotonic()

    def remove(self) -> None:
        """Let go of what was kept."""
        for name in (FILE, f"{FILE}-journal", EARLIER):
            with suppress(OSError):
                self.file.with_name(name).unlink(missing_ok=True)

    @contextmanager
    def _open(self, mode: str) -> Iterator[sqlite3.Connection]:
        address = f"{self.file.absolute().as_uri()}?mode={mode}"
        with closing(sqlite3.connect(address, uri=True)) as database:
            database.execute("PRAGMA trusted_schema = OFF")
            yield database


def pack(value: Any) -> tuple[str, bytes]:
    """A tree of plain values and arrays as JSON and bytes.

    Examples
    --------
    >>> tree, arrays = pack({"time": 0.25, "mean": np.arange(3.0)})
    >>> unpack(tree, arrays)
    {'time': 0.25, 'mean': array([0., 1., 2.])}
    """
    arrays: list[bytes] = []
    position = 0

    def plain(value: Any) -> Any:
        nonlocal position
        if isinstance(value, np.ndarray):
            order: Literal["C", "F"] = "C" if value.flags.c_contiguous else "F"
            arrays.append(value.tobytes(order))
            here = position
            position += value.nbytes
            return {ARRAY: [value.dtype.str, list(value.shape), order, here]}
        if isinstance(value, np.generic):
            return value.item()
        if isinstance(value, dict):
            return {key: plain(entry) for key, entry in value.items()}
        return [plain(entry) for entry in value] if isinstance(value, list | tuple) else value

    return json.dumps(plain(value)), b"".join(arrays)


def unpack(tree: str, arrays: bytes) -> Any:
    """The value that `pack` took apart."""

    def made(node: dict[str, Any]) -> Any:
        if node.keys() != {ARRAY}:
            return node
        dtype, shape, order, begin = node[ARRAY]
        if np.dtype(dtype).kind not in "biufc" or min(shape, default=0) < 0:
            raise ValueError(f"an array of {dtype}, {shape}")
        flat = np.frombuffer(arrays, dtype, math.prod(shape), begin)
        return flat.reshape(shape, order=order).copy(order)

    return json.loads(tree, object_hook=made)
