"""The hardware of one terminal, built from what its scenario states."""

from __future__ import annotations

from dataclasses import dataclass

from isac_rt.frame.waveform import Waveform
from isac_rt.hardware.oscillator import Oscillator, oscillator_of
from isac_rt.scenario import front_end as scenario


@dataclass(frozen=True)
class FrontEnd:
    """What a terminal's hardware does to what it sends and receives.

    Attributes
    ----------
    oscillator : None where it is ideal
    """

    oscillator: Oscillator | None = None


IDEAL = FrontEnd()


@dataclass(frozen=True)
class Ends:
    """The hardware that takes part in one receiver's samples.

    Attributes
    ----------
    receiver : its own
    senders : of each link's transmitter, in the order of the links
    """

    receiver: FrontEnd
    senders: tuple[FrontEnd, ...]

    @property
    def ideal(self) -> bool:
        """Whether the samples are those of `isac_rt.signal.if_signal.if_signal`."""
        return self.receiver == IDEAL and all(one == IDEAL for one in self.senders)


def front_end_of(node: scenario.FrontEnd, waveform: Waveform, seed: int, name: str) -> FrontEnd:
    """The front end of a terminal that a scenario states."""
    return FrontEnd(oscillator_of(node.oscillator, waveform.sampling_rate, seed, name))
