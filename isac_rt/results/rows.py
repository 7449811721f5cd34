"""Rows that the frames of a run leave behind: of one type, any number of them for each frame."""

from __future__ import annotations

import numpy as np


class Table:
    """Rows of one type, any number of them for each frame.

    Parameters
    ----------
    dtype : of a row, with named fields
    frames : number of frames without rows that come first
    """

    def __init__(self, dtype: np.dtype, frames: int = 0) -> None:
        self.dtype = dtype
        self._none = np.zeros(0, dtype)
        self._rows = [self._none] * frames

    def append(self, rows: np.ndarray) -> None:
        """Add the rows of the next frame.

        Raises
        ------
        TypeError  If they are of another type.
        """
        self._rows.append(self._none)
        self[-1] = rows

    def __getitem__(self, frame: int) -> np.ndarray:
        """Return a copy of the rows of a frame."""
        return self._rows[frame].copy()

    def __setitem__(self, frame: int, rows: np.ndarray) -> None:
        if rows.dtype != self.dtype:
            raise TypeError(f"rows of {rows.dtype}")
        self._rows[frame] = rows.copy() if len(rows) else self._none

    def whole(self) -> np.ndarray:
        """Return the rows of all frames."""
        return np.concatenate([self._none, *self._rows])

    def frames(self) -> np.ndarray:
        """Return the frame of each row."""
        return np.repeat(np.arange(len(self._rows)), [len(rows) for rows in self._rows])
