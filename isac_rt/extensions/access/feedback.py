"""Stage 4's feedback: what a passive terminal reports now and then, and how the active one tells it
of a whole-cell slip.

A passive terminal that takes its range for s cells too long reads every symbol s too low, and the
same frame tells nobody which is right. Two things do: data fill their alphabet, so that symbols
outside it bound the slip; and the active terminal has the same distance from its own echo, without
the passive one's integer. It weighs all slips that the alphabet allows by the difference of the
ranges.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.special import gammainccinv

from isac_rt.frame.waveform import SPEED_OF_LIGHT, Waveform
from isac_rt.receive.symbols import EXTRA_CELLS
from isac_rt.receive.types import Reception
from isac_rt.track.tracker import TrackSet

LARGEST_SLIP = 16  # cells; what is farther off was never acquired
CONFIDENT_RATE = 1e-3
"""Chance that noise alone makes one chirp's decision count."""
SUFFICIENT = 0.999
"""Probability of a slip from which it is corrected."""
SAME_DIRECTION = np.radians(4.0)
"""Half of the 16-element beam: an echo farther off the direction that the passive terminal reports
is another's."""


@dataclass(frozen=True)
class Feedback:
    """Message that a passive terminal sends back.

    Attributes
    ----------
    range, range_std : of the line of sight as it uses it, at an agreed time [m]
    lowest, highest : second lowest and second highest sure symbol of the last frame, so that one
        wrong decision does no harm; None when fewer than two were sure
    decided : sure symbols
    """

    range: float
    range_std: float
    lowest: int | None
    highest: int | None
    decided: int


@dataclass(frozen=True)
class Correction:
    """The active terminal's answer.

    Attributes
    ----------
    cells : by which the passive terminal's range is too long; 0 unless `sure`
    probability : of the likeliest number of cells; 0 when alphabet and echo contradict each other
    sure : whether this reaches `SUFFICIENT`
    """

    cells: int
    probability: float
    sure: bool


def summarise(
    reception: Reception, range_: float, range_std: float, num_rx: int, waveform: Waveform
) -> Feedback:
    """Feedback from the last frame: earlier ones may have been read before the slip, and their
    bounds would contradict its.

    Parameters
    ----------
    range_, range_std : of the line of sight as the terminal believes it [m]
    num_rx : receive antennas, for the law of the confidences where the reception does not say it
    """
    searched = waveform.num_delay_symbols + 2 * EXTRA_CELLS
    looks = reception.confidence_looks or num_rx
    level = gammainccinv(looks, CONFIDENT_RATE / searched) / looks
    r = reception
    sure = np.sort(r.raw_delay_symbols[_of_decided(r) > level]) if r.decoded else np.zeros(0, int)
    if sure.size < 2:
        return Feedback(range_, range_std, None, None, int(sure.size))
    return Feedback(range_, range_std, int(sure[1]), int(sure[-2]), int(sure.size))


def echo_of(reported: TrackSet, own: TrackSet) -> int | None:
    """The active terminal's track of a passive one: the nearest in direction to the line of sight
    that this one reports.

    Parameters
    ----------
    reported : the passive terminal's tracks; its reference points at the active one
    own : the active terminal's tracks
    """
    reference, sure = np.flatnonzero(reported.is_reference), np.flatnonzero(own.confirmed)
    if not reference.size or not sure.size:
        return None
    back = -reported.mean[reference[0], :3]
    echoes = own.mean[sure, :3]
    cosine = echoes @ back / (np.linalg.norm(echoes, axis=1) * np.linalg.norm(back))
    best = int(cosine.argmax())
    return int(sure[best]) if cosine[best] > np.cos(SAME_DIRECTION) else None


def exchange(
    reception: Reception,
    reported: TrackSet,
    own: TrackSet,
    num_rx: int,
    clock_std: float,
    waveform: Waveform,
) -> Correction | None:
    """One passive terminal's feedback after a frame and the active one's answer; None where either
    has nothing to go by.

    Parameters
    ----------
    reception, reported : of the passive terminal, the same frame
    own : the active terminal's tracks, the same frame
    num_rx : receive antennas of the passive terminal
    clock_std : of what is left of the clocks' offset [s]
    """
    echo = echo_of(reported, own)
    if echo is None or not reception.decoded:
        return None
    q = int(np.flatnonzero(reported.is_reference)[0])
    said = summarise(
        reception, float(reported.range[q]), float(reported.std[q, 0]), num_rx, waveform
    )
    return correct(said, float(own.range[echo]), float(own.std[echo, 0]), clock_std, waveform)


def _of_decided(reception: Reception) -> np.ndarray:
    """Confidences of the groups that the reception's raw symbols are of."""
    if len(reception.raw_delay_symbols) == len(reception.delay_confidence):
        return reception.delay_confidence
    return reception.delay_confidence[(reception.delay_symbols >= 0).any(axis=1)]


def correct(
    feedback: Feedback, echo_range: float, echo_std: float, clock_std: float, waveform: Waveform
) -> Correction:
    r"""The whole cells by which a passive terminal is off, as the active terminal sees it.

    .. math::

        P(s) \propto \exp\left[-\frac{(r_{PT} - r_{AT} - s\,c/\alpha T)^2}{2\sigma^2}\right],\quad
        -D_{\min} \le s \le N/2 - 1 - D_{\max}

    Parameters
    ----------
    feedback : from the passive terminal
    echo_range, echo_std : its distance from the active terminal's own echo at the agreed time (half
        of the way there and back) [m]
    clock_std : of what is left of the clocks' offset [s]

    Notes
    -----
    Uniform symbols are as likely under every slip that keeps them in the alphabet, so that they
    bound s and weigh nothing else.
    """
    cell = waveform.range_cell(1)
    least, most = -LARGEST_SLIP, LARGEST_SLIP
    if feedback.lowest is not None and feedback.highest is not None:
        least = max(least, -feedback.lowest)
        most = min(most, waveform.num_delay_symbols - 1 - feedback.highest)
    if least > most:
        return Correction(0, 0.0, False)
    slips = np.arange(least, most + 1)
    std = np.sqrt(feedback.range_std**2 + echo_std**2 + (clock_std * SPEED_OF_LIGHT) ** 2)
    away = np.abs(feedback.range - echo_range - slips * cell) / std
    if away.min() > max(5.0, cell / std):
        return Correction(0, 0.0, False)  # no slip explains the echo: it is another's
    weight = np.exp(-(away**2 - away.min() ** 2) / 2)
    best, probability = int(slips[weight.argmax()]), float(weight.max() / weight.sum())
    sure = probability >= SUFFICIENT
    return Correction(best if sure else 0, probability, sure)


def frames_to_repair(first_wrong: int, period: int, travel: int = 1) -> int:
    """Frames that are read with a slip: until the next feedback, after every `period`-th frame, and
    while the answer travels.

    Parameters
    ----------
    first_wrong : number of the first frame with the slip, from 0
    period : frames from one feedback to the next; it leaves after frames period - 1, 2 period - 1,
        ...
    travel : frames that go by before the correction is in force
    """
    return period - first_wrong % period + travel
