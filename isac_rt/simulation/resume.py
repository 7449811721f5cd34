"""The frames of a run that was stopped, in a file beside its results: the same run goes on after
them, to the same bits.

The file begins with a line that says which run it is of: a digest of the scenario, the city's file,
the program and the versions under it. Entries follow, each with its length and a checksum; one that
was torn when the process was killed is cut off. Entries are pickled, and reading them makes nothing
but arrays and classes of this package: a file from elsewhere cannot run code.
"""

from __future__ import annotations

import hashlib
import io
import pickle
import struct
import time
import zlib
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any

from isac_rt.runtime import UserError

FILE = "unfinished.frames"
EVERY = 5.0
"""Least time between two entries: what a stop can cost, beside the frame at work. [s]"""
_FRONT = struct.Struct("<QI")
_ARRAYS = {
    ("collections", "deque"),
    ("numpy", "dtype"),
    ("numpy", "ndarray"),
    ("numpy._core.multiarray", "_reconstruct"),
    ("numpy._core.multiarray", "scalar"),
    ("numpy._core.numeric", "_frombuffer"),
}


class UnfinishedError(UserError):
    """The file holds what no run of this package wrote."""


class Unfinished:
    """The kept frames of one run.

    Parameters
    ----------
    folder : of the results
    content : all that the run's results depend on, as text
    every : least time between two entries [s]
    """

    def __init__(self, folder: str | Path, content: str, every: float = EVERY) -> None:
        self.file = Path(folder) / FILE
        self._head = f"isac_rt {hashlib.sha256(content.encode()).hexdigest()}\n".encode()
        self._every, self._last, self._broken = every, time.monotonic(), False

    @property
    def begun(self) -> bool:
        """Whether there is a file of this very run."""
        try:
            with self.file.open("rb") as file:
                return file.readline(len(self._head)) == self._head
        except OSError:
            return False

    def entries(self) -> list[Any]:
        """What an earlier call kept, in its order; none if there is nothing or if it belongs to
        another run. A torn end is cut off.

        Raises
        ------
        UnfinishedError  If an entry asks for more than arrays and classes of this package.
        """
        if not self.begun:
            return []
        with self.file.open("rb+") as file:
            file.seek(len(self._head))
            try:
                found = list(_whole(file))
            except pickle.UnpicklingError as problem:
                raise UnfinishedError(
                    f"{self.file} was not written by isac-rt: {problem}; delete it"
                ) from problem
            file.truncate()
        return found

    def due(self) -> bool:
        """Whether it is time for an entry."""
        return not self._broken and time.monotonic() - self._last >= self._every

    def append(self, entry: Any) -> None:
        """Keep an entry. Where it cannot be written the run goes on and nothing is kept."""
        text = pickle.dumps(entry, protocol=5)
        try:
            ours = self.begun
            with self.file.open("ab" if ours else "wb") as file:
                file.write(
                    (b"" if ours else self._head) + _FRONT.pack(len(text), zlib.crc32(text)) + text
                )
        except OSError:
            self._broken = True
            self.remove()
        self._last = time.monotonic()

    def remove(self) -> None:
        """Let go of what was kept."""
        with suppress(OSError):
            self.file.unlink(missing_ok=True)


def _whole(file: Any) -> Iterator[Any]:
    """Entries up to the first that is not whole; leaves the file at the end of the last."""
    while True:
        here = file.tell()
        front = file.read(_FRONT.size)
        if len(front) == _FRONT.size:
            length, checksum = _FRONT.unpack(front)
            text = file.read(length)
            if len(text) == length and zlib.crc32(text) == checksum:
                yield _Reader(io.BytesIO(text)).load()
                continue
        file.seek(here)
        return


class _Reader(pickle.Unpickler):
    """Makes arrays and this package's own classes."""

    def find_class(self, module: str, name: str) -> Any:
        found = (
            super().find_class(module, name)
            if (module, name) in _ARRAYS or module.startswith("isac_rt.")
            else None
        )
        if found is None or not (isinstance(found, type) or (module, name) in _ARRAYS):
            raise pickle.UnpicklingError(f"it asks for {module}.{name}")
        return found
