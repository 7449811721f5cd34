"""Saved frames of an interrupted run, in a file next to its results: the same run resumes after
them, with identical results.

The file is an SQLite database, so that a killed process leaves no partial entry. It holds a digest
of scenario, city file, program and package versions. An entry is data with a checksum; a corrupted
one is ignored."""

from __future__ import annotations

import fcntl
import hashlib
import itertools
import os
import sqlite3
import time
import warnings
from collections.abc import Iterator
from contextlib import closing, contextmanager, suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any

from isac_rt.document import ScenarioWarning
from isac_rt.runtime import UserError, shortly
from isac_rt.scenario.file import to_yaml
from isac_rt.storage import BAD_DATA, checksum, pack, read_whole, unpack

if TYPE_CHECKING:
    from isac_rt.scenario.tree import Scenario

FILE = "resume.sqlite"
EARLIER = "unfinished.frames"
"""Name of files of earlier versions, which are not read."""
TABLES = {
    "run": "(digest TEXT PRIMARY KEY)",
    "entry": "(id INTEGER PRIMARY KEY, tree TEXT, arrays BLOB, checksum TEXT)",
}
EVERY = 5.0
"""Least time between two entries [s]; a stop loses at most this and the frame in progress."""


class ResumeError(UserError):
    """The file belongs to another run, or no run of this package wrote it."""


@contextmanager
def sole_use(folder: Path) -> Iterator[None]:
    """Lock a folder of results for one run.

    Raises
    ------
    ResumeError  If another run holds it.
    """
    opened = os.open(folder, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
    try:
        try:
            fcntl.flock(opened, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            raise _in_use(folder) from None
        except OSError:  # not every file system locks
            pass
        yield
    finally:
        os.close(opened)


def check_replaces_nothing(folder: Path, scenario: Scenario) -> None:
    """Refuse a folder with complete results of another scenario.

    Raises
    ------
    ResumeError
    """
    if not (folder / "summary.json").exists():
        return
    try:
        earlier = read_whole(folder / "scenario.yaml").decode().splitlines()
    except (OSError, ValueError):
        earlier = []
    pairs = itertools.zip_longest(earlier, to_yaml(scenario, folder).splitlines(), fillvalue="")
    changed = [(there.strip(), now.strip()) for there, now in pairs if there != now]
    if changed:
        there, now = changed[0]
        raise ResumeError(
            f"{folder} holds the results of another scenario (there {there[:60]!r}, now "
            f"{now[:60]!r}); give another folder with --out, or --overwrite to replace them"
        )


def _in_use(folder: Path) -> ResumeError:
    return ResumeError(
        f"{folder} is in use by another run; wait for its end or give another folder with --out"
    )


def _is_locked(problem: BaseException) -> bool:
    """Return whether another process has a database open for writing."""
    code = getattr(problem, "sqlite_errorcode", None)
    return code in (sqlite3.SQLITE_BUSY, sqlite3.SQLITE_LOCKED)


class Resume:
    """Saved frames of one run.

    Parameters
    ----------
    folder : of the results
    content : everything the run's results depend on, as text
    every : least time between two entries [s]
    """

    def __init__(self, folder: str | Path, content: str, every: float = EVERY) -> None:
        self.file = Path(folder) / FILE
        self._digest = hashlib.sha256(content.encode()).hexdigest()
        self._every, self._last = every, time.monotonic()

    @property
    def begun(self) -> bool:
        """Test that frames of this run are saved."""
        return self._owner() == self._digest

    def check(self) -> None:
        """Refuse a folder with saved frames of another run.

        Raises
        ------
        ResumeError
        """
        earlier = self.file.with_name(EARLIER)
        if earlier.exists() or self._owner() not in ("", self._digest):
            raise ResumeError(
                f"{earlier if earlier.exists() else self.file} keeps frames of another scenario, "
                "option or version, or is damaged; give another folder with --out, or --restart "
                "to discard them"
            )

    def entries(self) -> Iterator[Any]:
        """Yield the entries of earlier calls of this run, in order.

        Raises
        ------
        ResumeError  If the frames are another run's, or an entry is not one of this package's.
        """
        self.check()
        if not self.begun:
            return
        with self.reading(), self._open("rw") as database:
            for tree, arrays, seal in database.execute(
                "SELECT tree, arrays, checksum FROM entry ORDER BY id"
            ):
                if seal == checksum(self._digest, tree.encode() + arrays):
                    yield unpack(tree, arrays)

    @contextmanager
    def reading(self) -> Iterator[None]:
        """Convert errors of reading an entry into one message."""
        try:
            yield
        except (sqlite3.Error, *BAD_DATA) as problem:
            if _is_locked(problem):
                raise _in_use(self.file) from None
            raise ResumeError(
                f"{self.file} is damaged or was not written by isac-rt "
                f"({type(problem).__name__}: {shortly(problem)}); --restart discards it"
            ) from problem

    def due(self) -> bool:
        """Test that the next entry is due."""
        return time.monotonic() - self._last >= self._every

    def append(self, entry: Any) -> bool:
        """Save an entry; return False if that failed.

        After a failure, such as a full disk, earlier entries remain, the run continues, and the
        next entry is due after twice the time."""
        tree, arrays = pack(entry)
        seal = checksum(self._digest, tree.encode() + arrays)
        try:
            with self._open("rwc") as database, database:
                database.execute("BEGIN")
                for name, columns in TABLES.items():
                    database.execute(f"CREATE TABLE IF NOT EXISTS {name} {columns}")
                database.execute("INSERT OR IGNORE INTO run VALUES (?)", (self._digest,))
                if database.execute("SELECT digest FROM run").fetchall() != [(self._digest,)]:
                    raise sqlite3.IntegrityError("it is another run's")
                database.execute(
                    "INSERT INTO entry (tree, arrays, checksum) VALUES (?, ?, ?)",
                    (tree, arrays, seal),
                )
        except sqlite3.Error as problem:
            self._every *= 2
            message = f"{self.file}: the frames since the last entry are not kept ({problem})"
            warnings.warn(ScenarioWarning(message), stacklevel=2)
            return False
        finally:
            self._last = time.monotonic()
        return True

    def remove(self) -> None:
        """Delete the saved frames."""
        for name in (FILE, f"{FILE}-journal", EARLIER):
            with suppress(OSError):
                self.file.with_name(name).unlink(missing_ok=True)

    def _owner(self) -> str | None:
        """Return the digest of the run whose frames are saved; "" without frames, None if
        unreadable."""
        if not self.file.exists():
            return ""
        try:
            with self._open("rw") as database:
                made = {sql for (sql,) in database.execute("SELECT sql FROM sqlite_master") if sql}
                if not made:
                    return ""  # killed before its first entry was there
                if made != {f"CREATE TABLE {name} {columns}" for name, columns in TABLES.items()}:
                    return None  # a view might never end
                ((digest,),) = database.execute("SELECT digest FROM run").fetchmany(2)
                return digest
        except (sqlite3.Error, ValueError) as problem:
            if _is_locked(problem):
                raise _in_use(self.file) from None
            return None

    @contextmanager
    def _open(self, mode: str) -> Iterator[sqlite3.Connection]:
        address = f"{self.file.absolute().as_uri()}?mode={mode}"
        with closing(sqlite3.connect(address, uri=True)) as database:
            database.execute("PRAGMA trusted_schema = OFF")
            yield database
