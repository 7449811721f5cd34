"""What a scenario says about the chirp, the arrays, the data on the chirps and the noise."""

from __future__ import annotations

from collections.abc import Iterator
from fractions import Fraction as Rational
from typing import Annotated, Literal, NamedTuple

from pydantic import Field

from isac_rt.scenario.node import Finite, Node, Positive, Problem


class ChirpTimes(NamedTuple):
    """Durations that follow from the numbers of a chirp [s]."""

    sampled: float
    """T, the sampled part of a chirp."""
    max_delay: float
    """T_d, the delay whose beat is the sampling rate."""
    chirp: float
    """T~ = T + 2 T_d."""
    slot: float
    """T-, from one chirp of a group to its next."""


def chirp_times(
    bandwidth: float, sampling_rate: float, num_samples: int, num_tx: int
) -> ChirpTimes:
    """Durations of a chirp; T_d = f_s T / (B - 2 f_s), see `isac_rt.frame.waveform.Waveform`."""
    sampled = num_samples / sampling_rate
    max_delay = sampling_rate * sampled / (bandwidth - 2 * sampling_rate)
    chirp = sampled + 2 * max_delay
    return ChirpTimes(sampled, max_delay, chirp, chirp + 2 * num_tx * max_delay)


def num_resource_blocks(bandwidth: float, sampling_rate: float, num_tx: int) -> int:
    """floor(T- / (2 T_d)) in rational arithmetic; with r = B/f_s it is (r - 2)/2 + 1 + L_tx (19 for
    the paper's numbers)."""
    ratio = Rational(bandwidth).limit_denominator() / Rational(sampling_rate).limit_denominator()
    return int((ratio - 2) / 2 + 1 + num_tx)


class Radio(Node):
    """The chirp and the frame."""

    carrier_hz: Positive = 77e9
    bandwidth_hz: Positive = 640e6
    sampling_rate_hz: Positive = 20e6
    samples_per_chirp: Annotated[int, Field(ge=16, le=65536)] = 1024
    chirps_per_frame: Annotated[int, Field(ge=2, le=4096)] = 120
    groups: Annotated[int, Field(ge=1, le=16)] = 3
    filter_transition_hz: Positive = 0.4e6
    """Width of the IF filter's skirts on each side of its passband [0, sampling rate)."""

    def problems(self) -> Iterator[Problem]:
        if self.bandwidth_hz <= 2 * self.sampling_rate_hz:
            yield Problem(
                (("bandwidth_hz",), ("sampling_rate_hz",)),
                f"{self.bandwidth_hz:g} Hz must exceed twice the sampling rate of "
                f"{self.sampling_rate_hz:g} Hz; "
                "raise the bandwidth or lower the sampling rate",
            )
        if self.samples_per_chirp % 2:
            yield Problem(
                (("samples_per_chirp",),),
                "must be even: half of the range cells carry the data symbols",
            )


class Array(Node):
    """L-shaped arrays: elements along X and Z that share the corner."""

    tx_x: Annotated[int, Field(ge=1, le=16)] = 2
    tx_z: Annotated[int, Field(ge=1, le=16)] = 2
    rx_x: Annotated[int, Field(ge=2, le=64)] = 8
    rx_z: Annotated[int, Field(ge=2, le=64)] = 8
    spacing_wavelengths: Positive = 0.5774
    schedule: Literal["pseudo_random", "conventional"] = "pseudo_random"
    fall_back: bool = False
    """Send the conventional schedule instead of the pseudo-random one as long as a receiver finds
    the scene not sparse."""
    element_pattern: Literal["isotropic", "sector", "cosine"] = "cosine"
    element_gain_dbi: Finite = 5.0
    field_of_view_deg: Annotated[float, Field(gt=0, le=180)] = 120.0


class Modulation(Node):
    """What is on the chirps, and in which frames nothing is."""

    dpsk_order: Literal[2, 4, 8, 16] = 8
    acquisition_frames: Annotated[int, Field(ge=1)] = 3
    """Unmodulated frames at the start, from which every terminal acquires."""
    pilot_every_frames: Annotated[int, Field(ge=2)] | None = 25
    """One unmodulated frame in so many, for late and lost terminals; null: none after the start."""
    streams: dict[str, tuple[Annotated[int, Field(ge=0)], ...]] = Field({})
    """Groups that carry data for a passive terminal, by its name; a terminal that is not named
    reads them all."""


class Noise(Node):
    """link_budget: thermal noise and transmit power. snr: per-sample IF SNR of the reference path
    (the strongest target at the AT, the line of sight at a PT) as it would be unshadowed and in
    view."""

    model: Literal["link_budget", "snr"] = "link_budget"
    tx_power_dbm: Finite = 12.0
    noise_figure_db: Finite = 12.0
    temperature_k: Positive = 290.0
    snr_db: Finite = 10.0
