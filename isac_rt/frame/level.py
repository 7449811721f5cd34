"""Noise and transmit power: by a link budget, or by the paper's SNR of a reference path."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from isac_rt.frame.antennas import Antennas
from isac_rt.frame.settings import Noise
from isac_rt.frame.waveform import BOLTZMANN, Waveform

TEMPERATURE_K = 290.0
"""Temperature of the thermal noise, from which noise figures count."""


def thermal_noise_power(noise: Noise, waveform: Waveform) -> float:
    """k T f_s F [W]: E|n|^2 of a complex IF sample; the filter's noise bandwidth is f_s."""
    return BOLTZMANN * TEMPERATURE_K * waveform.sampling_rate * 10 ** (noise.noise_figure_db / 10)


def transmit_amplitude(noise: Noise) -> float:
    """sqrt(power of one antenna) [sqrt(W)]; 1 where an SNR sets the scale."""
    return 1.0 if noise.model == "snr" else float(np.sqrt(1e-3 * 10 ** (noise.tx_power_dbm / 10)))


def noise_power(noise: Noise, waveform: Waveform, reference_amplitude: float) -> float:
    """E|n|^2 of a complex IF sample [W] for a link whose reference path has this amplitude."""
    if noise.model == "snr":
        return reference_amplitude**2 / 10 ** (noise.snr_db / 10)
    return thermal_noise_power(noise, waveform)


@dataclass(frozen=True)
class LinkBudget:
    """One link's numbers at one instant, in decibels, for people.

    Attributes
    ----------
    link : "TX->RX"
    reference : what the reference path is
    distance_m : to the reference target or terminal
    received_dbm, noise_dbm : per sample and antenna
    snr_db : per sample and antenna, before processing
    processing_gain_db : range and Doppler DFT with Hann's losses, and the virtual channels in power
    processed_snr_db : snr_db and the gain
    """

    link: str
    reference: str
    distance_m: float
    received_dbm: float
    noise_dbm: float
    snr_db: float
    processing_gain_db: float
    processed_snr_db: float


def link_budget(
    link: tuple[str, str],
    reference: str,
    distance: float,
    powers: tuple[float, float],
    waveform: Waveform,
    antennas: Antennas,
) -> LinkBudget:
    """Return the budget of a link from the powers [W] of its reference path (elements on boresight)
    and of the noise, per sample.

    The gain counts N samples and P chirps coherently, less 1.76 dB for each of the two Hann
    windows, and the virtual channels as sqrt(L_tx L_rx), which is what adding powers gives near the
    threshold.
    """
    w = waveform
    received, level = powers
    channels = antennas.num_tx * antennas.num_rx
    gain = (
        10 * np.log10(w.num_samples * w.num_chirps)
        - 2 * 10 * np.log10(1.5)
        + 5 * np.log10(channels)
    )
    snr = 10 * np.log10(received / level)
    return LinkBudget(
        "->".join(link),
        reference,
        distance,
        10 * np.log10(received / 1e-3),
        10 * np.log10(level / 1e-3),
        snr,
        float(gain),
        float(snr + gain),
    )
