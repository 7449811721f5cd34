"""Samples of real boards, where they are here: see docs/measured.md for whose they are."""

from __future__ import annotations

import csv
from functools import lru_cache
from pathlib import Path

import numpy as np

from isac_rt.extensions.hardware.calibrate import PARTS, Calibration, calibrate
from isac_rt.extensions.hardware.description import Description
from isac_rt.extensions.hardware.explain import unexplained_by
from isac_rt.extensions.hardware.matfile import read_mat
from isac_rt.extensions.hardware.readers import import_file
from isac_rt.extensions.hardware.types import MEASURED, Capture, measured_folder, ti_window
from isac_rt.frame.antennas import Antennas
from isac_rt.frame.front_end import FrontEnd
from isac_rt.propagation.rcs import SMALL_MEAN_DBSM, TR38901_STD_DB
from isac_rt.receive.known import Known
from isac_rt.receive.maps import Conventional, doppler_bins
from isac_rt.receive.spectrum import clean_spectrum
from truths.case import Errors, Skipped, case

BOARDS = {
    "phaseMismatchCalibration.mat": (4.7319, 0.44, 0.9946, 0.64, 1.05, 1.00, 0.68, -16.3, -21.0),
    "TxBF_calibrateResults_high.mat": (4.9082, 5.11, 0.9973, 0.32, 2.08, 0.85, 0.61, -16.4, -16.4),
    "calibrateResults_high.mat": (6.0771, 3.84, 0.9862, 0.95, 3.25, 1.04, 0.89, -11.5, -16.2),
}
"""What another program found in a file, in the order of `DIGITS`."""
DIGITS = {
    "range_m": 4,
    "range_scatter_mm": 2,
    "rank_one_share": 4,
    "residual_db": 2,
    "residual_deg": 2,
    "gain_spread_rx_db": 2,
    "gain_spread_tx_db": 2,
    "unexplained_db": 1,
    "unexplained_response_db": 1,
}
EXPLAINED_DB = dict(zip(BOARDS, (20.0, 16.0, 16.0), strict=True))
FRAME = Description(
    carrier_hz=77.4201e9,
    slope_mhz_per_us=60.0,
    sampling_rate_hz=2.5e6,
    samples_per_chirp=128,
    receivers=4,
    chirps=(0, 1),
    loops=128,
    chirp_interval_us=92.0,
    adc_start_us=6.0,
    axes=("frame", "loop", "chirp", "receiver", "sample"),
    wrapped=True,
)
"""Of the measured frame with transmitters in turn."""


def _here(name: str) -> Path:
    file = measured_folder() / name
    if not file.is_file():
        raise Skipped(f"{name} is not here; {MEASURED} names the folder of measured samples")
    return file


@lru_cache(maxsize=3)
def _board(name: str) -> tuple[Capture, Calibration]:
    capture = import_file(_here(name))
    return capture, calibrate(capture)


@case(
    "another program's table of the same files",
    "1.0 half digits",
    "to the last digit: half of one is what rounding leaves",
)
def boards_before_a_corner_reflector() -> Errors:
    """Range, scatter, rank-one share, what is left of it, gain spreads, and what tones leave, of
    three captures by TI's cascade."""
    for name, table in BOARDS.items():
        found = _board(name)[1]
        for (key, digits), truth in zip(DIGITS.items(), table, strict=True):
            yield abs(round(getattr(found, key), digits) - truth) * 2 * 10**digits


@case(
    "the measured samples",
    "0 dB",
    "asked for: 20 dB of the first capture, 16 dB of the others",
)
def measured_echo_explained_by_the_simulated() -> Errors:
    """The simulated cube of the same scene, with gains, delays, response and pairs of the board,
    leaves less of the reflector's cells than is allowed (dB over that)."""
    for name, limit in EXPLAINED_DB.items():
        (left,) = unexplained_by(*_board(name), [PARTS])
        yield left + limit


@case(
    "the measured samples",
    "0 dB",
    "an ideal board must explain less than 0.5 dB, each part that is left out must cost",
)
def each_part_of_a_board_counts() -> Errors:
    """Without gains, delays, response or pairs the simulated cube of the first capture leaves more
    than with them (dB that are missing for 1 dB more)."""
    one = _board("phaseMismatchCalibration.mat")
    without = [tuple(p for p in PARTS if p != part) for part in PARTS]
    whole, ideal, *left = unexplained_by(*one, [PARTS, (), *without])
    yield -0.5 - ideal
    yield from (1 - (level - whole) for level in left)


@case(
    "the frame's own description: range bin 60, Doppler bin +7, 48.9 dB over the median cell",
    "0.1 dB",
    "Hann's window of N and not N + 1 steps; both bins must be these",
)
def people_in_a_measured_frame() -> float:
    """The strongest mover of a measured TDM frame, by the receiver's own map."""
    capture = import_file(_here("tdm_frame/doppler_example_1.npy"), FRAME)
    w = capture.cube.waveform
    known = Known.unmodulated(
        w, capture.cube.schedule, Antennas.placed([(0, 0)] * 2, [(0, 0)] * 4), 2
    )
    rows = clean_spectrum(capture.cube, known, num_rows=w.num_samples)
    power, bins = Conventional().power(rows, known), doppler_bins(w)
    own = np.abs(bins + 0.5) < w.num_chirps / w.num_tx / 2
    moving = power[:, own] * (np.abs(bins[own]) > 2)
    row, column = np.unravel_index(moving.argmax(), moving.shape)
    if (int(row), int(bins[own][column])) != (60, 7):
        return float("inf")
    return abs(10 * float(np.log10(moving.max() / np.median(power[:, own]))) - 48.9)


@case(
    "the frame's own description: 0.993 as it is, 0.996 after the phase of the second slot",
    "1.0 half digits",
    "to the last digit; the channels are a line of eight, two transmitters times four receivers",
)
def channels_of_a_measured_mover_in_line() -> Errors:
    """Largest sum in phase of the eight channels of that mover over the sum of their amplitudes,
    before and after taking out what it moves from one transmitter's slot to the next's."""
    capture = import_file(_here("tdm_frame/doppler_example_1.npy"), FRAME)
    samples = capture.cube.samples[0].reshape(4, 128, 2, 128)  # receiver, loop, chirp, sample
    window = ti_window(128)
    cells = (samples * window) @ np.exp(-2j * np.pi * 60 / 128 * np.arange(128))
    moving = np.exp(-2j * np.pi * 7 / 128 * np.arange(128)) * window
    line = np.einsum("rlc,l->cr", cells, moving)
    steering = np.exp(-1j * np.outer(np.linspace(-np.pi, np.pi, 4001), np.arange(8)))
    for late, stated in ((0.0, 0.993), (np.pi * 7 / 128, 0.996)):
        channels = (line * np.exp(np.array([[0.0], [-1j * late]]))).ravel()
        found = np.abs(steering @ channels).max() / np.abs(channels).sum()
        yield abs(round(float(found), 3) - stated) * 2 * 10**3


@case(
    "another program's table of the same file; the preset awr2243_cascade",
    "1.0 half digits",
    "to the last digit: 5.60 degrees, 2.7, 11.1; the preset keeps a digit of each mean",
)
def phase_shifters_of_a_cascade() -> Errors:
    """Mean step of twelve measured transmit phase shifters, standard deviation and largest size of
    what they are off 5.625 degrees a step, and the errors that the preset has of each step."""
    steps = -np.unwrap(read_mat(_here("phaseShifterCalibration.mat"))["Ph"], axis=0, period=360)
    yield abs(round(float(np.diff(steps, axis=0).mean()), 2) - 5.60) * 2 * 10**2
    off = steps - 5.625 * np.arange(1, 64)[:, None, None]
    off = off - off.mean(axis=0)
    yield abs(round(float(off.std()), 1) - 2.7) * 2 * 10
    yield abs(round(float(np.abs(off).max()), 1) - 11.1) * 2 * 10
    mean = np.append(0.0, steps.mean(axis=(1, 2))) - 5.625 * np.arange(64)
    stated = FrontEnd(preset="awr2243_cascade").shifter
    yield np.abs(np.array(stated.errors_deg) - (mean - mean.mean())).max() * 2 * 10 - 0.01
    apart = steps.mean(axis=1) - steps.mean(axis=(1, 2))[:, None]
    apart = apart - apart.mean(axis=0)
    yield abs(round(float(apart.std()), 1) - stated.errors_std_deg) * 2 * 10


@case("TR 38.901 v19.4.0, table 7.9.2.1-1 as published", "0 dB", "the same digits")
def small_uav_as_published() -> Errors:
    """Mean and standard deviation of a small UAV's cross-section."""
    with _here("tr38901/table-7.9.2.1-1.csv").open(encoding="utf-8") as file:
        text = ",".join(cell for row in csv.reader(file) for cell in row)
    for number in (SMALL_MEAN_DBSM, TR38901_STD_DB["small"]):
        yield 0.0 if str(number).lstrip("-") in text else np.inf
