"""The hardware of one terminal, built from what its scenario states."""

from __future__ import annotations

from dataclasses import dataclass, fields

from isac_rt.extensions.hardware.channels import Elements, Shifter, elements_of, shifter_of
from isac_rt.extensions.hardware.converter import Converter, converter_of, watts
from isac_rt.extensions.hardware.oscillator import Oscillator, oscillator_of
from isac_rt.extensions.hardware.sweep import Ramp, Response, ramp_of, response_of
from isac_rt.frame import front_end as settings
from isac_rt.frame.antennas import Antennas
from isac_rt.frame.waveform import Waveform


@dataclass(frozen=True)
class FrontEnd:
    """Hardware between a terminal's signal and its antennas; None: a part that is ideal.

    Attributes
    ----------
    oscillator : its phase noise
    transmit, receive : errors of the elements
    transmit_response, receive_response : gain over the chirp
    shifter : phases of the transmit antennas' shifters
    ramp : errors of the chirp's frequency
    converter : of the receiver
    saturation : power at which the transmit amplifier saturates [W]
    """

    oscillator: Oscillator | None = None
    transmit: Elements | None = None
    receive: Elements | None = None
    transmit_response: Response | None = None
    receive_response: Response | None = None
    shifter: Shifter | None = None
    ramp: Ramp | None = None
    converter: Converter | None = None
    saturation: float | None = None

    @property
    def parts(self) -> tuple[str, ...]:
        """Names of the parts that are not ideal."""
        return tuple(part.name for part in fields(self) if getattr(self, part.name) is not None)

    @property
    def ideal(self) -> bool:
        """True if all parts are ideal."""
        return not self.parts

    def only(self, part: str) -> FrontEnd:
        """The same with all other parts ideal."""
        return FrontEnd(**{part: getattr(self, part)})


IDEAL = FrontEnd()


@dataclass(frozen=True)
class Ends:
    """The hardware that takes part in one receiver's samples.

    Attributes
    ----------
    receiver : its own
    senders : of each link's transmitter, in the order of the links; one for each of its antennas
        that send at once
    """

    receiver: FrontEnd
    senders: tuple[FrontEnd, ...]

    def only(self, part: str) -> Ends:
        """The same with all other parts ideal."""
        return Ends(self.receiver.only(part), tuple(one.only(part) for one in self.senders))

    @property
    def ideal(self) -> bool:
        """True if the samples are those of `isac_rt.signal.if_signal.if_signal`."""
        return self.receiver.ideal and all(one.ideal for one in self.senders)


def front_end_of(
    node: settings.FrontEnd, waveform: Waveform, antennas: Antennas, seed: int, name: str
) -> FrontEnd:
    """The front end of a terminal that a scenario states."""
    wave = waveform.wavelength
    return FrontEnd(
        oscillator_of(node.oscillator, waveform.sampling_rate, seed, name),
        elements_of(node.transmit, antennas.tx_positions, wave, seed, name, "tx"),
        elements_of(node.receive, antennas.rx_positions, wave, seed, name, "rx"),
        response_of(node.transmit_response, antennas.num_tx, seed, name, "tx"),
        response_of(node.receive_response, antennas.num_rx, seed, name, "rx"),
        shifter_of(node.shifter, antennas.num_tx, seed, name),
        ramp_of(node.ramp, waveform),
        converter_of(node.converter),
        None if node.saturation_dbm is None else watts(node.saturation_dbm),
    )
