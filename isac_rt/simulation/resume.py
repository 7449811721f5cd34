"""The frames of a run that was stopped, in a file beside its results: the same run goes on after
them, to the same bits.

The file is an SQLite database, so that an entry is in it whole or not at all, whenever the process
is killed. It says which run it is of: a digest of the scenario, the city's file, the program and
the versions under it. An entry is data only, with a checksum: one that is bent is as one that was
never kept.
"""

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
"""What earlier versions wrote, which is not read."""
TABLES = {
    "run": "(digest TEXT PRIMARY KEY)",
    "entry": "(id INTEGER PRIMARY KEY, tree TEXT, arrays BLOB, checksum TEXT)",
}
EVERY = 5.0
"""Least time between two entries: what a stop can cost, beside the frame at work. [s]"""


class ResumeError(UserError):
    """The file is of another run, or holds what no run of this package wrote."""


@contextmanager
def sole_use(folder: Path) -> Iterator[None]:
    """Hold a folder of results for one run.

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
    """Refuse a folder that holds the whole results of another scenario.

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


def _in_use(place: Path) -> ResumeError:
    return ResumeError(
        f"{place} is in use by another run; wait for its end or give another folder with --out"
    )


def _is_locked(problem: BaseException) -> bool:
    """Return whether another process has a database open for writing."""
    code = getattr(problem, "sqlite_errorcode", None)
    return code in (sqlite3.SQLITE_BUSY, sqlite3.SQLITE_LOCKED)


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
        self._every, self._last = every, time.monotonic()

    @property
    def begun(self) -> bool:
        """Return whether frames of this very run are kept."""
        return self._owner() == self._digest

    def check(self) -> None:
        """Refuse a folder that keeps frames of another run, which are not this one's to take away.

        Raises
        ------
        ResumeError
        """
        earlier = self.file.with_name(EARLIER)
        if earlier.exists() or self._owner() not in ("", self._digest):
            raise ResumeError(
                f"{earlier if earlier.exists() else self.file} keeps frames of another scenario, "
                "option or version, or is damaged; give another folder with --out, or --restart "
                "to let go of them"
            )

    def entries(self) -> Iterator[Any]:
        """Yield what an earlier call of this run kept, in its order.

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
        """Turn what goes wrong with an entry into one message."""
        try:
            yield
        except (sqlite3.Error, *BAD_DATA) as problem:
            if _is_locked(problem):
                raise _in_use(self.file) from None
            raise ResumeError(
                f"{self.file} is damaged or was not written by isac-rt "
                f"({type(problem).__name__}: {shortly(problem)}); --restart lets go of it"
            ) from problem

    def due(self) -> bool:
        """Return whether it is time for an entry."""
        return time.monotonic() - self._last >= self._every

    def append(self, entry: Any) -> bool:
        """Keep an entry, and return whether it could be kept.

        Where it could not (a full disk) what was kept before is still there, the run goes on, and
        the next entry is due after twice the time.
        """
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
            said = f"{self.file}: the frames since the last entry are not kept ({problem})"
            warnings.warn(ScenarioWarning(said), stacklevel=2)
            return False
        finally:
            self._last = time.monotonic()
        return True

    def remove(self) -> None:
        """Let go of what was kept."""
        for name in (FILE, f"{FILE}-journal", EARLIER):
            with suppress(OSError):
                self.file.with_name(name).unlink(missing_ok=True)

    def _owner(self) -> str | None:
        """Digest of the run whose frames are kept; "" if there are none, None if that cannot be
        read."""
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
