"""Detectors in clutter, one interface: maps in, in every cell the statistic over its threshold out.

- cfar: the mean power over the channels against its surroundings (`isac_rt.receive.cfar`);
- map: the same power against the clutter power that the mesh predicts for the cell, and the noise;
- angle_doppler: the adaptive matched filter with the covariance that the mesh and the platform's
  own velocity predict;
- sample_matrix: the same filter with the covariance of the cells around.

map and angle_doppler first correct what the terminal believes of its velocity and of the clutter's
level by the frame's own clutter (`isac_rt.receive.clutter.correction`). `clutter_channels` says
whether the last two filter each arm of the virtual L by itself and add the two, or both arms
jointly. The level of angle_doppler is held up by the energy that the filter leaves around a cell,
the greater of both sides in range, where that is more than predicted.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy import ndimage

from isac_rt.frame.antennas import Antennas
from isac_rt.frame.schedule import Schedule
from isac_rt.frame.waveform import Waveform
from isac_rt.receive.cfar import CfarRule, strong_lobes
from isac_rt.receive.clutter.adaptive import (
    Beams,
    Scan,
    beams_of,
    map_factor,
    predicted,
    sampled,
    scan_threshold,
)
from isac_rt.receive.clutter.correction import fit
from isac_rt.receive.clutter.power import Channels, Taper, arm_channels, joint_channels, power_map
from isac_rt.receive.maps import accumulate
from isac_rt.receive.types import ExpectedClutter
from isac_rt.scenario.receivers import Receivers

QUIET = 0.3
"""Share of the cells, those with the least clutter to be expected, whose median power is taken for
the noise's."""

LEAST = 0.03
"""Cells whose expected clutter is less than this share of the noise are taken to hold noise
alone."""


@dataclass(frozen=True)
class Judged:
    """A detector's verdict on every cell, Doppler centred.

    Attributes
    ----------
    ratio : (rows, P) statistic over its threshold; above 1 is a detection
    level : (rows, P) power of a channel that counts as background
    cosines : (rows, P, 2) direction in which a filter found most, NaN where the detector does not
        look at directions
    """

    ratio: np.ndarray
    level: np.ndarray
    cosines: np.ndarray


def judge(
    frames: Sequence[np.ndarray],
    waveform: Waveform,
    antennas: Antennas,
    schedule: Schedule,
    delay_symbols: np.ndarray,
    settings: Receivers,
    clutter: ExpectedClutter | None = None,
    taper: Taper | None = None,
    fitted: bool = True,
) -> list[Judged]:
    """The verdict of the detector that the settings name, on frames that share their data and the
    expected clutter.

    Parameters
    ----------
    frames : (L_tx, L_rx, rows, P) complex64 of `channel_maps` each
    clutter : what is expected; needed by map and angle_doppler
    taper : how uncertain that is; None: `Taper()`
    fitted : correct the own velocity and the clutter's level by the first frame
        (`isac_rt.receive.clutter.correction`) before anything is decided

    Raises
    ------
    ValueError  If the detector needs the expected clutter and there is none.
    """
    name, powers = settings.clutter_detector, [accumulate(maps) for maps in frames]
    looks, rate = frames[0].shape[0] * frames[0].shape[1], settings.false_alarm_rate
    if name == "cfar":
        return [Judged(*cfar_ratio(power, looks, settings), _nowhere(power)) for power in powers]
    scans = _scans(waveform, antennas, settings.clutter_channels)
    if name == "sample_matrix":
        noise = [noise_level(power, None, looks) for power in powers]
        found = [
            [(sampled(m, c, b, n, settings.guard_cells[0]), b) for c, b in scans]
            for m, n in zip(frames, noise, strict=True)
        ]
        levels = [np.full_like(power, n) for power, n in zip(powers, noise, strict=True)]
        return [
            _directed(parts, level, rate, None) for parts, level in zip(found, levels, strict=True)
        ]
    if clutter is None:
        raise ValueError(
            f"receivers.clutter_detector {name} needs the clutter that the mesh predicts; give it, "
            "or use cfar"
        )
    expected = power_map(clutter, waveform, powers[0].shape[0], schedule, delay_symbols, taper)
    noise = [noise_level(power, expected, looks) for power in powers]
    if fitted:
        clutter = fit(powers[0], noise[0], clutter, waveform, schedule, delay_symbols).apply(
            clutter
        )
        expected = power_map(clutter, waveform, powers[0].shape[0], schedule, delay_symbols, taper)
    if name == "map":
        limits = [n * map_factor(expected / n, looks, rate) for n in noise]
        return [
            Judged(p / limit, n + expected, _nowhere(p))
            for p, n, limit in zip(powers, noise, limits, strict=True)
        ]
    wanted = np.fft.ifftshift(expected > LEAST * np.mean(noise), axes=1)
    by_scan = [
        predicted(frames, c, b, noise, wanted, clutter, waveform, schedule, delay_symbols, taper)
        for c, b in scans
    ]
    by_frame = [
        [(scan, b) for scan, (_, b) in zip(one, scans, strict=True)]
        for one in zip(*by_scan, strict=True)
    ]
    return [
        _directed(parts, n + expected, rate, settings)
        for parts, n in zip(by_frame, noise, strict=True)
    ]


def _nowhere(power: np.ndarray) -> np.ndarray:
    return np.full((*power.shape, 2), np.nan)


def cfar_ratio(power: np.ndarray, looks: int, settings: Receivers) -> tuple[np.ndarray, np.ndarray]:
    """Power over the threshold of `CfarRule.detect`, and the background."""
    rule = CfarRule.of(settings, looks)
    level = rule.detect(power)[1]
    return power / (rule.factors(len(power))[:, None] * level), level


def noise_level(power: np.ndarray, expected: np.ndarray | None, looks: int) -> float:
    """Mean noise power of a cell, from the median of the quietest cells, or of all where nothing is
    known of the clutter.

    The median of a mean of n exponentials is (1 - 1/(9 n))^3 of its mean (Wilson and Hilferty).
    """
    some = power if expected is None else power[expected <= np.quantile(expected, QUIET)]
    return float(np.median(some)) / (1 - 1 / (9 * looks)) ** 3


def _scans(waveform: Waveform, antennas: Antennas, which: str) -> list[tuple[Channels, Beams]]:
    if which == "joint":
        channels = joint_channels(antennas)
        return [(channels, beams_of(channels, waveform, antennas, (0, 2)))]
    arms = [(arm_channels(antennas, axis), axis) for axis in (0, 2)]
    return [(channels, beams_of(channels, waveform, antennas, (axis,))) for channels, axis in arms]


def _directed(
    parts: list[tuple[Scan, Beams]], level: np.ndarray, rate: float, settings: Receivers | None
) -> Judged:
    """Scans added, over their threshold; with `settings` the left energy of the surroundings is
    held against them."""
    total = np.fft.fftshift(np.sum([scan.peak for scan, _ in parts], axis=0), axes=1)
    limit = scan_threshold(tuple(b for _, b in parts), rate)
    ratio = total / limit
    if settings is not None:
        left = np.fft.fftshift(np.mean([scan.energy for scan, _ in parts], axis=0), axes=1)
        found = ndimage.binary_dilation(ratio > 1, np.ones((3, 3), bool))
        around = CfarRule.of(settings, 1).background(left, ~(found | strong_lobes(left)))
        ratio = ratio / np.maximum(around, 1.0)
    cosines = np.zeros((*ratio.shape, 2))
    for scan, beams in parts:
        # each arm's beams lie along its own axis, so that the sum puts the two together
        cosines += np.fft.fftshift(beams.cosines[scan.beam][..., [0, 2]], axes=1)
    return Judged(ratio, level, cosines)
