"""Conventional TDM-MIMO FMCW at the same parameters: no data, one group, antennas in turn,
monostatic.

What the paper leaves open and is assumed here: the chirps are those of the ISAC waveform without
data, so that all N range cells are targets' (twice the range of the ISAC waveform, whose upper half
is the data's); every antenna has its own 40-point Doppler transform, which folds at max_velocity /
L_tx (4.98 m/s), with a Hann window on both axes; the 45 channels' powers are added; CFAR as in the
other receivers; the antennas' time offsets are compensated with the estimated Doppler before the
angles; fractions of a cell from two-cell ratios.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import scipy.fft

from isac_rt.frame.antennas import Antennas
from isac_rt.frame.cube import IFCube
from isac_rt.frame.payload import Payload, unmodulated
from isac_rt.frame.schedule import Schedule, conventional_schedule
from isac_rt.frame.waveform import Waveform, hann
from isac_rt.receive.cfar import first_row
from isac_rt.receive.estimate import to_delay
from isac_rt.receive.settings import Receivers
from isac_rt.receive.types import Detections
from reproduce.baselines.tdm import sense_tdm


def fmcw_frame(waveform: Waveform) -> tuple[Waveform, Schedule, Payload]:
    """The frame of the conventional radar with the numbers of an ISAC waveform: one group, round
    robin, no data."""
    w = replace(waveform, num_groups=1, blocks=None)
    return w, conventional_schedule(1, w.num_chirps, w.num_tx), unmodulated(w)


def receive_fmcw(cube: IFCube, antennas: Antennas, settings: Receivers) -> Detections:
    """Range (one way), velocity and direction of the echoes in a frame of `fmcw_frame`; the first
    group only.

    Raises
    ------
    ValueError  If the antennas do not take turns: a conventional Doppler transform needs uniform
    pulses.
    """
    w, schedule = cube.waveform, np.asarray(cube.schedule[0])
    if not np.array_equal(schedule[: -w.num_tx], schedule[w.num_tx :]):
        raise ValueError(
            "receive_fmcw needs antennas in turn (fmcw_frame); this schedule is pseudo-random"
        )
    first = first_row(settings, w.range_cell(2))
    times = np.arange(w.num_chirps) * w.slot_duration
    spectra = fmcw_spectra(cube.samples[0])
    return sense_tdm(
        spectra,
        schedule,
        times,
        lambda cell, bin_: to_delay(cell, bin_, w),
        w,
        antennas,
        settings,
        first,
    )


def fmcw_spectra(samples: np.ndarray) -> np.ndarray:
    """(L_rx, N, P) Hann-windowed range spectra of (L_rx, P, N) samples."""
    size = samples.shape[-1]
    window = hann(np.arange(size) + 0.5, size).astype(np.float32)
    return scipy.fft.fft(samples * window, axis=-1, workers=1, overwrite_x=True).transpose(0, 2, 1)
