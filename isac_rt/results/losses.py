"""Why a UAV in view was found or not: one cause for each frame."""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum

import numpy as np
from scipy.special import chndtr

from isac_rt.frame.antennas import Antennas
from isac_rt.frame.cube import Transmission
from isac_rt.frame.schedule import is_latin
from isac_rt.frame.waveform import Waveform
from isac_rt.kernels.jit import jit
from isac_rt.kernels.receive_maps import lobe_bound
from isac_rt.propagation.pathset import PathKind, PathSet
from isac_rt.receive.cfar import STRONG, CfarRule
from isac_rt.receive.maps import UNION_FLOOR
from isac_rt.receive.settings import Receivers
from isac_rt.results.labels import Places, cells_apart, hann_response

MATCHED_DB = 13.0
"""SNR under which a coherent matched filter is taken to see nothing: with 13.1 dB it finds a steady
target nine times in ten at 1e-6 false alarms (Albersheim)."""
HOPELESS, CERTAIN = 0.1, 0.99
"""Probabilities of detection in noise alone: under the first a target is noise to the detector,
over the second chance does not explain that it was missed."""
SIDELOBE_MARGIN = 4.0
"""Peaks within this factor of a stronger path's sidelobes are taken for them
(`cfar.without_sidelobes`)."""
HANN_LOSS = 1.5
"""Noise bandwidth of a Hann window in cells."""


class Loss(IntEnum):
    """What became of a UAV in view in one frame; of several that hold, the first."""

    FOUND = 0  # by its own path, within one resolution on all four axes
    TOO_WEAK = 1  # for a matched filter that is coherent over samples, chirps and antennas
    NOT_READ = 2  # a PT did not read the data, or misread them, and had nothing clean to look at
    INACCURATE = 3  # detected by its own path, but farther off than one resolution
    NOISE = 4  # to a detector that adds the channels' powers
    MASKED = 5  # by a stronger line of sight, mirror image, leakage, or another UAV's echo
    CLUTTER = (
        6  # its cell holds more clutter than noise, those around it raise their background, or
    )
    # it was taken for a wall
    THRESHOLD = 7  # missed by chance: its probability of detection is not near 1
    OTHER = 8  # none of these


LOSSES = tuple(loss.name.lower() for loss in Loss)


@dataclass(frozen=True)
class Sensitivity:
    """How a frame of a link shows a path of unit power (|gain|^2).

    Attributes
    ----------
    matched : SNR of a matched filter that is coherent over all samples, chirps and antennas
    cell : SNR in the cell of one channel of a Hann-windowed range-Doppler map
    rule : by which a cell of that map stands out of those around it
    beam_rate : false alarms in a cell of a detector that adds the channels in phase, None: this one
        adds their powers
    """

    matched: float
    cell: float
    rule: CfarRule
    beam_rate: float | None = None

    @classmethod
    def of(
        cls,
        waveform: Waveform,
        antennas: Antennas,
        settings: Receivers,
        sent: Transmission,
        noise_power: float,
        groups: int,
        own: bool = False,
    ) -> Sensitivity:
        """What the link budget says of a frame of which the receiver reads so many groups; `own`:
        it hears its own chirps."""
        groups = groups * sent.num_streams
        w, chirps = waveform, groups * waveform.num_chirps
        sample = sent.amplitude**2 / noise_power
        united = sent.codes is not None or (
            groups == w.num_tx and is_latin(sent.schedule, w.num_tx)
        )
        united = united and settings.velocity_method != "conventional"
        looks = antennas.num_tx * antennas.num_rx * (1 if united else groups)
        per_look = chirps * antennas.num_rx / looks
        return cls(
            sample * w.num_samples * chirps * antennas.num_rx,
            sample * w.window_length * per_look / HANN_LOSS**2,
            CfarRule.of(settings, looks),
            settings.false_alarm_rates[0] if settings.looks_by_beam(own) else None,
        )

    def detection_probability(self, snr: float, background: float = 0.0) -> float:
        """Of a steady path with this SNR in its cell, in noise and a background of so many times
        its power in the cells around."""
        degrees, threshold = 2 * self.rule.looks, self.rule.threshold * (1 + background)
        return float(1 - chndtr(degrees * threshold, degrees, degrees * snr))

    def clutter_free(self, snr: float) -> float:
        """Probability that this detector would find a steady path with this SNR in a channel's cell
        if there were noise alone."""
        if self.beam_rate is None:
            return self.detection_probability(snr)
        return single_look(snr * self.rule.looks, self.beam_rate)

    def genie(self, snr: float) -> float:
        """Probability that a matched filter at a path's true delay, Doppler and direction finds it,
        from its coherent SNR; its false alarms are those of a cell."""
        return single_look(snr, self.rule.rate)


def single_look(snr: float, rate: float) -> float:
    """Probability of detection of a steady path by one coherent test with a rate of false
    alarms."""
    return float(1 - chndtr(-2 * np.log(rate), 2, 2 * snr))


@dataclass(frozen=True)
class Chance:
    """What one UAV's own path amounts to in a frame, over the noise.

    Attributes
    ----------
    matched : SNR of the coherent matched filter
    cell : SNR in its cell of one channel's map
    clutter : power of the diffuse paths in that cell
    background : what other paths add to the mean of the cells around it
    masked : a stronger path covers it
    """

    matched: float
    cell: float
    clutter: float
    background: float
    masked: bool

    @classmethod
    def of(
        cls, own: int, paths: PathSet, places: Places, waveform: Waveform, sees: Sensitivity
    ) -> Chance:
        """Of path number `own`."""
        w, power = waveform, paths.power
        half = w.frame_duration / 2
        life = max(min(paths.end[own], half) - max(paths.begin[own], -half), 0.0) / (2 * half)
        beat = float(w.beat_cells(paths.delay[own], paths.delay_rate[own], 0.0))
        doppler = places.velocity[own] / places.cells[1]
        off_grid = hann_response(abs(beat - round(beat))) * hann_response(
            abs(doppler - round(doppler))
        )
        mine = power[own]
        clutter, background, masked = _around(
            (places.range - places.range[own], places.velocity - places.velocity[own]),
            (places.cells, places.span),
            power,
            paths.kind == PathKind.DIFFUSE,
            (mine, mine * off_grid, sees.cell),
            (sees.rule.guard, sees.rule.training),
        )
        return cls(
            float(sees.matched * life * mine),
            float(sees.cell * life**2 * mine * off_grid),
            sees.cell * clutter,
            background,
            masked,
        )


@jit
def _around(
    off: tuple[np.ndarray, np.ndarray],
    scales: tuple[tuple[float, float], float],
    power: np.ndarray,
    diffuse: np.ndarray,
    levels: tuple[float, float, float],
    blocks: tuple[tuple[int, int], tuple[int, int]],
) -> tuple[float, float, bool]:
    """Power of the clutter in a path's cell; what K paths add to the greater of the means before
    and behind it, over the noise; and whether a stronger one covers it.

    Parameters
    ----------
    off : (K,) ranges and velocities beyond the path's
    scales : cells of both and the span of velocities
    power : (K,); what is over `STRONG` is kept out of the training
    levels : the path's power, that in its cell, and what makes SNR of power in a cell
    blocks : guard and training cells
    """
    (cells, span), (mine, in_cell, gain), (guard, training) = scales, levels, blocks
    width = guard[1] + training[1] + 0.5
    clutter, before, behind, masked = 0.0, 0.0, 0.0, False
    most = max(guard[0] + training[0] + 1, 2) * cells[0]
    for i in range(power.size):
        if diffuse[i] and abs(off[0][i]) >= most:  # of most it is this that is asked alone
            continue
        row, column = cells_apart(off[0][i], off[1][i], cells, span)
        if diffuse[i] and row < 2 and column < 2:
            clutter += power[i] * hann_response(row) * hann_response(column)
        if not diffuse[i] and power[i] > mine:
            lobes = lobe_bound(row) * (lobe_bound(column) + UNION_FLOOR)
            masked |= SIDELOBE_MARGIN * power[i] * lobes >= in_cell
        along = row - guard[0] - 0.5
        if 0 < along <= training[0] and column <= width and gain * power[i] < STRONG:
            if off[0][i] > 0:
                behind += gain * power[i]
            else:
                before += gain * power[i]
    return clutter, max(before, behind) * HANN_LOSS**2 / (training[0] * 2 * width), masked


def cause_of(
    hit: bool, own: bool, beside: np.ndarray, chance: Chance, sees: Sensitivity, read: bool
) -> Loss:
    """What became of a UAV in view in one frame.

    Parameters
    ----------
    hit : found by its own path within one resolution on all axes
    own : a detection is explained by its own path
    beside : kinds of the paths that explain the detections within a cell of it
    chance : what its path amounts to
    sees : the detector's sensitivity
    read : the frame held no data, or data that were read
    """
    likely = sees.detection_probability(chance.cell)
    causes = {
        Loss.FOUND: hit,
        Loss.TOO_WEAK: chance.matched < 10 ** (MATCHED_DB / 10),
        Loss.NOT_READ: not read,
        Loss.INACCURATE: own,
        Loss.NOISE: likely < HOPELESS,
        Loss.MASKED: chance.masked or bool(((beside >= 0) & (beside != PathKind.DIFFUSE)).any()),
        Loss.CLUTTER: chance.clutter > 1
        or sees.detection_probability(chance.cell, chance.background) < likely / 2
        or bool((beside == PathKind.DIFFUSE).any()),
        Loss.THRESHOLD: likely < CERTAIN,
    }
    return next((loss for loss, holds in causes.items() if holds), Loss.OTHER)
