"""One measured frame."""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from isac_rt.frame.antennas import Antennas
from isac_rt.frame.cube import IFCube
from isac_rt.runtime import UserError

MEASURED = "ISAC_RT_MEASURED"
"""Variable of the environment: folder of measured samples for checks of the program."""


def measured_folder() -> Path:
    """Where the measured samples lie that the program is checked with, if they are here: as the
    environment says, or `shared/measured` beside the project."""
    named = os.environ.get(MEASURED)
    return Path(named) if named else Path(__file__).parents[3] / "shared" / "measured"


def ti_window(size: int) -> np.ndarray:
    """Hann window (size,) under which TI's scripts take range spectra, sin^2(pi (n+1)/(N+1))."""
    return np.asarray(np.sin(np.pi * (np.arange(size) + 1) / (size + 1)) ** 2)


class CaptureError(UserError):
    """A file of samples, its description or what was asked of it will not do; the text says why and
    what to do."""


@dataclass(frozen=True, kw_only=True)
class Capture:
    """One frame of a radar board.

    Attributes
    ----------
    cube : its samples as a cube of one group, in the units of the board's converters
    antennas : positions of the elements; None: not stated
    source : where it comes from and what was done to it, in words
    """

    cube: IFCube
    antennas: Antennas | None = None
    source: Mapping[str, str] = field(default_factory=dict)

    @property
    def one_sided(self) -> bool:
        """Return whether the upper half of the range cells holds images."""
        return self.source.get("sampling") in ("real", "complex_2x")

    def channels(self) -> np.ndarray:
        """Mean of the chirps of every pair of antennas (L_rx, L_tx, N) complex128.

        Raises
        ------
        CaptureError  If a transmit antenna never sends, or groups overlap.
        """
        cube = self.cube
        if cube.samples.shape[0] != 1:
            raise CaptureError(
                f"the cube has {cube.samples.shape[0]} groups of chirps that overlap; channels are "
                "separated in a cube of 1 group"
            )
        senders = cube.schedule[0]
        silent = np.setdiff1d(np.arange(cube.waveform.num_tx), senders)
        if silent.size:
            raise CaptureError(
                f"transmit antenna {silent[0]} never sends in this frame; take a frame in which "
                "every antenna does"
            )
        return np.stack(
            [
                cube.samples[0][:, senders == tx].mean(axis=1, dtype=np.complex128)
                for tx in range(cube.waveform.num_tx)
            ],
            axis=1,
        )
