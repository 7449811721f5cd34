"""Properties of a recording that its file does not hold: the chirp, the frame, the order of the
numbers and the array."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
from pydantic import Field

from isac_rt.document import Document
from isac_rt.extensions.hardware.types import CaptureError
from isac_rt.frame.antennas import CASCADE_HZ, Antennas, ti_cascade
from isac_rt.frame.boards import BOARD_FILES, BoardFileError, read_board
from isac_rt.frame.waveform import SPEED_OF_LIGHT
from isac_rt.settings import Node, Problem

Format = Literal["ti_calibration", "dca1000", "numpy", "sigmf"]
Axis = Literal["frame", "loop", "chirp", "receiver", "sample"]
Offset = Annotated[float, Field(ge=-1e5, le=1e5, allow_inf_nan=False)]
Place = tuple[Offset, Offset]
Hertz = Annotated[float, Field(ge=1.0, le=1e13, allow_inf_nan=False)]
Count = Annotated[int, Field(ge=1, le=1_000_000)]
MOST_ELEMENTS = 256
"""Antennas of an array."""
Element = Annotated[int, Field(ge=0, lt=MOST_ELEMENTS)]
Places = Annotated[tuple[Place, ...], Field(min_length=1, max_length=MOST_ELEMENTS)]


class Elements(Node):
    """Places of the antenna elements in a plane, x to the right and z up as seen from behind."""

    unit_hz: Hertz = CASCADE_HZ
    """Places are counted in half wavelengths of this frequency [Hz]."""
    transmitters: Places
    """[x, z] of each transmit element [half wavelengths], in the order of its numbers."""
    receivers: Places
    """[x, z] of each receive element [half wavelengths], in the order of the file."""

    def antennas(self) -> Antennas:
        """The arrays."""
        half = SPEED_OF_LIGHT / self.unit_hz / 2
        return Antennas.placed(half * np.array(self.transmitters), half * np.array(self.receivers))


class Description(Node):
    """Format of a file of samples."""

    format: Format | None = None
    """Kind of file; by default what the file's name ends in says."""
    carrier_hz: Hertz = 77e9
    """Frequency at which the ramp starts [Hz]."""
    slope_mhz_per_us: Annotated[float, Field(ge=1e-6, le=1e6)] | None = None
    """Slope of the ramp [MHz/us]; TI's calibration files state theirs."""
    adc_start_us: Annotated[float, Field(ge=0, le=1e6, allow_inf_nan=False)] = 6.0
    """From the start of the ramp to the first sample [us]."""
    sampling_rate_hz: Hertz | None = None
    """Samples per second of each receiver, complex or real [Hz]."""
    samples_per_chirp: Annotated[int, Field(ge=16, le=65536)] | None = None
    """Samples of a chirp."""
    receivers: Annotated[int, Field(ge=1, le=MOST_ELEMENTS)] | None = None
    """Receive antennas in the file."""
    chirps: Annotated[tuple[Element, ...], Field(min_length=1, max_length=512)] = (0,)
    """Transmit antenna of each chirp of a loop, counted from 0; every antenna sends equally
    often."""
    loops: Count = 1
    """How often a frame repeats the chirps."""
    frames: Annotated[int, Field(ge=0, le=1_000_000)] = 1
    """Frames in the file; 0: as many as its size says."""
    frame: Annotated[int, Field(ge=0)] = 0
    """Frame that is read, counted from 0."""
    chirp_interval_us: Annotated[float, Field(gt=0, le=1e6)] | None = None
    """From the start of a ramp to the start of the next [us]: idle time and ramp. Velocities need
    it."""
    frame_interval_ms: Annotated[float, Field(gt=0, le=1e6)] | None = None
    """From the start of a frame to the start of the next [ms]. Tracks need it."""
    sampling: Literal["complex_1x", "complex_2x", "real"] = "complex_1x"
    """What a sample is. `complex_1x`: I and Q of an IF from 0 to the sampling rate; `complex_2x`: I
    and Q of an IF to half of it, with the image band; `real`: I alone, of an IF to half of it.
    With the last two the upper half of the range cells holds images."""
    interleaved: bool = False
    """Order of a DCA1000 file. True: the receivers of each sample stand together, as four lanes
    deliver them (AWR1243, AWR1443): of a complex sample all I, then all Q. False: receivers stand
    one after the other, as two lanes deliver them (AWR1642, AWR1843, AWR6843): I of two samples,
    then Q of the two."""
    q_first: bool = False
    """Whether Q stands before I."""
    axes: tuple[Axis, ...] = ("frame", "loop", "chirp", "receiver", "sample")
    """Order of the axes of a NumPy file or of a SigMF recording, slowest first; axes that the file
    has joined into one are named one after the other."""
    wrapped: bool = False
    """Whether negative numbers were stored as if they had no sign, 65535 for -1."""
    elements: Elements | Literal["ti_cascade"] | None = None
    """Places of the antenna elements, or the name of a board."""

    @property
    def num_tx(self) -> int:
        """Transmit antennas that send."""
        return max(self.chirps) + 1

    def problems(self) -> Iterator[Problem]:
        counts = [self.chirps.count(tx) for tx in range(self.num_tx)]
        if len(set(counts)) > 1:
            yield Problem(
                (("chirps",),),
                f"antennas 0 to {self.num_tx - 1} send {counts} times in a loop; let each send "
                "equally often",
            )
        if sorted(self.axes) != sorted(("frame", "loop", "chirp", "receiver", "sample")):
            yield Problem(
                (("axes",),), "must name frame, loop, chirp, receiver and sample once each"
            )
        if 0 < self.frames <= self.frame:
            yield Problem(
                (("frame",), ("frames",)),
                f"there are frames 0 to {self.frames - 1}; choose one of these",
            )

    def antennas(self) -> Antennas | None:
        """The arrays, if stated."""
        if self.elements == "ti_cascade":
            return Antennas.placed(*ti_cascade())
        return None if self.elements is None else self.elements.antennas()


def load_description(file: str | Path) -> Description:
    """The description that a YAML file holds, or a board's configuration (`read_board`).

    Raises
    ------
    isac_rt.document.ScenarioError  With one line per problem.
    CaptureError  If a board's configuration cannot be used.
    """
    if Path(file).suffix in BOARD_FILES:
        try:
            return Description.model_validate(read_board(file).description())
        except BoardFileError as problem:
            raise CaptureError(str(problem)) from None
    return Document(Path(file), "describe the chirp and the frame").check(Description)
