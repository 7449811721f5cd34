"""One transmitter's frame, and what a receiver's converters deliver of it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np

from isac_rt.frame.antennas import Antennas
from isac_rt.frame.payload import Payload
from isac_rt.frame.schedule import Schedule
from isac_rt.frame.waveform import Waveform
from isac_rt.world.swarm import Pose


@dataclass(frozen=True, kw_only=True)
class Transmission:
    """One transmitter's frame.

    Attributes
    ----------
    name : of the terminal
    pose : at the epoch (the middle of the frame)
    antennas : its arrays
    schedule : (M, P) transmit antenna of each group and chirp
    payload : what it modulates
    amplitude : sqrt(transmit power of one antenna) [sqrt(W)]
    clock_offset, clock_drift : of the transmitter's clock against the receiver's [s, 1]; they add
        to every delay
    active : (M, P) bool, False where nothing is sent (on-off keying)
    first_block : resource block of its group 0; block b starts 2 b T_d into every slot
    codes : (L_tx, P) by which each antenna multiplies its chirps where all send at once; None: one
        sends in each group and slot, by `schedule`
    """

    name: str
    pose: Pose
    antennas: Antennas
    schedule: Schedule
    payload: Payload
    amplitude: float = 1.0
    clock_offset: float = 0.0
    clock_drift: float = 0.0
    active: np.ndarray | None = None
    first_block: int = 0
    codes: np.ndarray | None = None

    @property
    def num_streams(self) -> int:
        """Antennas that send at once."""
        return 1 if self.codes is None else len(self.codes)

    def streams(self) -> list[Transmission]:
        """The same as transmissions in which one antenna sends at a time."""
        if self.codes is None:
            return [self]
        return [
            replace(
                self,
                codes=None,
                schedule=np.full_like(self.schedule, a),
                payload=replace(self.payload, phases=self.payload.phases * code),
            )
            for a, code in enumerate(self.codes)
        ]


@dataclass(frozen=True)
class ReceiveArray:
    """Where and with what a receiver listens.

    Attributes
    ----------
    pose : at the epoch (the middle of the frame)
    antennas : its arrays, of which the receive elements count
    """

    pose: Pose
    antennas: Antennas


@dataclass(frozen=True)
class Reference:
    """The reference chirps with which a receiver dechirps a frame.

    Attributes
    ----------
    start_time : of the first reference chirp [s], block `first_block` of its slot
    first_block : resource block of the first reference chirp; None: that of the first transmission
    schedule : of the cube; None: that of the first transmission
    """

    start_time: float
    first_block: int | None = None
    schedule: Schedule | None = None


@dataclass(frozen=True, kw_only=True)
class IFCube:
    """Samples of one receiver in one frame, as its converters deliver them. It never holds the
    payload.

    Attributes
    ----------
    samples : (M, L_rx, P, N) complex64 [sqrt(W)]
    waveform, schedule : public parameters of the frame
    start_time : of the frame's first reference chirp [s]
    """

    samples: np.ndarray
    waveform: Waveform
    schedule: Schedule
    start_time: float

    def __repr__(self) -> str:
        groups, antennas, chirps, size = self.samples.shape
        rms = float(np.sqrt(np.mean(np.abs(self.samples) ** 2)))
        shape = f"{groups} groups x {antennas} antennas x {chirps} chirps x {size} samples"
        return f"<IFCube {shape} at {self.start_time:.4f} s, RMS {rms:.2e} sqrt(W)>"

    def shared(self) -> SharedCube:
        """The same samples, which must not change any more, for several receivers."""
        return SharedCube(**vars(self))

    def of_groups(self, groups: Sequence[int]) -> IFCube:
        """Return the part that a receiver of these groups alone has."""
        chosen = list(groups)
        return IFCube(
            samples=self.samples[chosen],
            waveform=self.waveform.of_groups(groups),
            schedule=self.schedule[chosen],
            start_time=self.start_time,
        )


class SharedCube(IFCube):
    """A cube that several receivers receive: what one has made of it the next one need not make."""

    @cached_property
    def made(self) -> dict[str, Any]:
        """By name."""
        return {}
