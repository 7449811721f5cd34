"""What frames leave behind, on the disk while a run goes on: rows of fixed types, so many for each
frame."""

from __future__ import annotations

import os
import tempfile
import weakref
from array import array
from collections.abc import Sequence
from contextlib import suppress
from functools import cached_property
from pathlib import Path

import numpy as np


class Spool:
    """Bytes in a file without a name, which is gone with the process however that ends. What the
    disk has no room for stays in memory.

    Parameters
    ----------
    folder : whose disk it is; None: that of the system's temporary files
    """

    def __init__(self, folder: Path | None = None) -> None:
        self._folder = folder
        self._end = 0
        self._in_memory: list[bytes] = []

    @cached_property
    def _file(self) -> int:
        file = tempfile.TemporaryFile(dir=self._folder, buffering=0)
        weakref.finalize(self, file.close)
        return file.fileno()

    def put(self, data: bytes) -> int:
        """Keep bytes; returns their place."""
        with suppress(OSError):
            if os.pwrite(self._file, data, self._end) == len(data):
                self._end += len(data)
                return self._end - len(data)
        self._in_memory.append(data)
        return -len(self._in_memory)

    def get(self, place: int, size: int) -> bytes:
        """The bytes of a place."""
        return self._in_memory[~place] if place < 0 else os.pread(self._file, size, place)


class Table:
    """Rows of one type, any number of them for each frame.

    Parameters
    ----------
    dtype : of a row, with named fields
    spool : where the rows lie
    frames : so many without rows come first
    """

    def __init__(self, dtype: np.dtype, spool: Spool, frames: int = 0) -> None:
        self.dtype, self._spool = dtype, spool
        self._counts, self._places = (array("q", [0] * frames) for _ in range(2))

    def append(self, rows: np.ndarray) -> None:
        """Keep the rows of the next frame.

        Raises
        ------
        TypeError  If they are of another type.
        """
        self._counts.append(0)
        self._places.append(0)
        if len(rows):
            self[-1] = rows

    def __getitem__(self, frame: int) -> np.ndarray:
        """The rows of a frame, as a copy."""
        return self._read([frame])

    def __setitem__(self, frame: int, rows: np.ndarray) -> None:
        if rows.dtype != self.dtype:
            raise TypeError(f"rows of {rows.dtype}")
        self._counts[frame], self._places[frame] = len(rows), self._spool.put(rows.tobytes())

    def whole(self) -> np.ndarray:
        """The rows of all frames."""
        return self._read(range(len(self._counts)))

    def frames(self) -> np.ndarray:
        """The frame of each row."""
        return np.repeat(np.arange(len(self._counts)), self._counts)

    def _read(self, frames: Sequence[int]) -> np.ndarray:
        out = np.empty(sum(self._counts[f] for f in frames), self.dtype)
        flat, at = out.view(np.uint8), 0
        for frame in frames:
            size = self._counts[frame] * self.dtype.itemsize
            if size:
                data = self._spool.get(self._places[frame], size)
                flat[at : at + size] = np.frombuffer(data, np.uint8)
                at += size
        return out
