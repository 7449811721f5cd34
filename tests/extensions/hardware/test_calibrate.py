"""Calibration from one reflector: made-up boards give their errors back, and what is none is
refused."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import scipy.io
from synthetic import C, channels, write_ti

from isac_rt.cli.cli import main
from isac_rt.extensions.hardware.calibrate import (
    KEY,
    PARTS,
    apply,
    calibrate,
    load_calibration,
    save_calibration,
)
from isac_rt.extensions.hardware.description import Description
from isac_rt.extensions.hardware.explain import unexplained_by
from isac_rt.extensions.hardware.readers import import_file, waveform_described
from isac_rt.extensions.hardware.types import Capture, CaptureError, measured_folder
from isac_rt.frame.antennas import Antennas, ti_cascade
from isac_rt.frame.cube import IFCube
from isac_rt.storage import load_data, save_data

TABLE = {
    "phaseMismatchCalibration": (4.7319, 0.44, 0.9946, 0.64, 1.05, 1.00, 0.68, -16.3, -21.0),
    "TxBF_calibrateResults_high": (4.9082, 5.11, 0.9973, 0.32, 2.08, 0.85, 0.61, -16.4, -16.4),
    "calibrateResults_high": (6.0771, 3.84, 0.9862, 0.95, 3.25, 1.04, 0.89, -11.5, -16.2),
}
"""Of the data's own README: what another program found in them."""
KEYS = (
    ("range_m", 4),
    ("range_scatter_mm", 2),
    ("rank_one_share", 4),
    ("residual_db", 2),
    ("residual_deg", 2),
    ("gain_spread_rx_db", 2),
    ("gain_spread_tx_db", 2),
    ("unexplained_db", 1),
    ("unexplained_response_db", 1),
)


@pytest.fixture
def board(tmp_path):
    def made(padding=5, **settings):
        samples, errors = channels(**settings)
        slope = settings.get("slope", 61.3e12) / 1e12
        write_ti(tmp_path / "b.mat", samples, slope, settings.get("rate", 9.1e6), padding)
        return import_file(tmp_path / "b.mat"), errors

    return made


@pytest.mark.parametrize("name", TABLE)
def test_the_measured_boards_give_the_table_to_its_last_digit(name):
    """Planted bug: a rectangular window in `_peaks`; amplitudes at each channel's own beat."""
    file = measured_folder() / f"{name}.mat"
    if not file.is_file():
        pytest.skip(f"the measured samples {file.name} are not here")
    found = calibrate(import_file(file))
    seen = tuple(round(getattr(found, key), digits) for key, digits in KEYS)
    assert seen == TABLE[name]


@pytest.mark.parametrize(
    "settings",
    [
        {},
        {"distance": 4.71, "slope": 29.7e12, "rate": 5e6, "size": 64},
        {"leakage": 3000.0, "size": 256, "num_rx": 4, "num_tx": 2},
    ],
    ids=["board", "slow and short", "leakage"],
)
def test_a_board_that_is_made_up_gives_its_errors_back(board, settings):
    """A point without clutter: range, gains, phases and delays as put in, to what single precision
    and other echoes leave. The leakage lies two cells from zero and reaches the echo by its
    window's skirts alone.

    Planted bug: `rx_delay` and `tx_delay` exchanged; the sign of the delay in `apply`."""
    capture, (g, h, d, e) = board(noise=0.01, **settings)
    found = calibrate(capture)
    assert found.range_m == pytest.approx(settings.get("distance", 4.37), abs=2e-4)
    assert found.rank_one_share > 0.9999
    ours, truth = found.rx_gain / found.rx_gain[0], g / g[0]
    assert ours == pytest.approx(truth, abs=5e-3)
    assert found.tx_gain / found.tx_gain[0] == pytest.approx(h / h[0], abs=5e-3)
    assert found.rx_delay == pytest.approx(d, abs=1e-12)
    assert found.tx_delay == pytest.approx(e, abs=1e-12)
    again = calibrate(apply(found, capture))
    assert np.ptp(np.abs(again.rx_gain)) < 1e-2
    assert again.rx_gain.real.min() > 0.99
    assert np.abs(again.rx_delay).max() < 1e-13


def test_the_slope_of_the_response_is_found_and_corrected(board):
    """Planted bug: `slope += 0.5 * change`, which another start would hide."""
    curvature = -0.41 + 0.07j
    capture, _ = board(curvature=curvature, noise=0.5)
    found = calibrate(capture)
    assert found.response_slope == pytest.approx(curvature, abs=5e-3)
    assert found.unexplained_db > -20 > -45 > found.unexplained_response_db
    again = calibrate(apply(found, capture))
    assert again.unexplained_db == pytest.approx(found.unexplained_response_db, abs=2)
    x = (found.sweep[0].real - found.carrier_hz) / found.half_sweep_hz
    truth = np.abs(1 + curvature * x)
    assert np.abs(found.sweep[1]) == pytest.approx(truth / truth[np.abs(x).argmin()], abs=0.05)


def test_standard_deviations_are_those_of_repetitions(board):
    """Twenty captures in noise: the scatter of a receiver's gain and delay over them is what each
    states, within the 16 % of twenty draws, doubled. The ranges scatter 1.52 times as much as their
    bound, by the window: sqrt(sum (w n)^2 sum n^2) / sum w n^2.

    Planted bug: sqrt(tx.size) left out."""
    levels, delays, said, ratios = [], [], [], []
    capture, clean = board()[0], channels(num_rx=6, num_tx=6)[0]
    rng = np.random.default_rng(5)
    for _ in range(20):
        white = rng.normal(size=clean.shape) + 1j * rng.normal(size=clean.shape)
        found = calibrate(replace_samples(capture, clean + 40 * white))
        levels.append(np.abs(found.rx_gain))
        delays.append(found.rx_delay)
        said.append((found.rx_gain_std.mean() / np.sqrt(2), found.rx_delay_std.mean()))
        ratios.append(found.range_scatter_mm / found.range_bound_mm)
    assert np.mean(ratios) == pytest.approx(1.52, rel=0.2)
    gain_std, delay_std = np.mean(said, axis=0)
    assert np.std(levels, axis=0).mean() == pytest.approx(gain_std, rel=0.4)
    assert np.std(delays, axis=0).mean() == pytest.approx(delay_std, rel=0.4)


def replace_samples(capture, samples):
    """The capture of another board's samples (N, L_rx, L_tx)."""
    num_tx = samples.shape[2]
    w = replace(capture.cube.waveform, num_chirps=num_tx, num_tx=num_tx)
    cube = replace(
        capture.cube,
        samples=samples.transpose(1, 2, 0)[None],
        waveform=w,
        schedule=np.arange(num_tx)[None],
    )
    return replace(capture, cube=cube)


def test_a_scene_without_a_reflector_is_refused_with_the_reason(board):
    """Noise and leakage alone; then ten scatterers in the cell of one.

    Planted bug: LEAST_SHARE = 0."""
    capture, _ = board(level=0.0, noise=1.0, leakage=9000.0, num_rx=16, num_tx=12)
    with pytest.raises(CaptureError, match=r"no clear reflector: .* rank-one share of 0\.\d+ \(at"):
        calibrate(capture)
    rng = np.random.default_rng(1)
    samples = sum(channels(seed=s, distance=4.37 + 0.02 * rng.normal())[0] for s in range(10))
    with pytest.raises(CaptureError, match="no clear reflector"):
        calibrate(replace_samples(capture, samples))


@pytest.mark.slow
def test_two_reflectors_side_by_side_and_half_a_spectrum_are_refused(board, tmp_path):
    """A second reflector of the same strength 1.6 cells behind the first, in another direction: the
    strongest point between them passes for one. Of a spectrum cut in half the range would be
    twice what it is.

    Planted bug: no `_refuse_two`."""
    capture, _ = board(num_rx=16, num_tx=12)
    cell = capture.cube.waveform.range_cell(2)
    samples = sum(
        channels(seed=k, num_rx=16, num_tx=12, distance=4.37 + 1.6 * k * cell)[0] for k in range(2)
    )
    with pytest.raises(CaptureError, match=r"no clear reflector: what stands at .* leaves -?\d"):
        calibrate(replace_samples(capture, samples))
    whole, _ = channels(num_rx=4, num_tx=3)
    write_ti(tmp_path / "half.mat", whole, 61.3, 9.1e6, 5)
    content = scipy.io.loadmat(tmp_path / "half.mat", simplify_cells=True)
    spectra = content["calibResult"]["Rx_fft"]
    content["calibResult"] = {"Rx_fft": spectra[: len(spectra) // 2]}
    scipy.io.savemat(tmp_path / "half.mat", {k: content[k] for k in ("calibResult", "params")})
    with pytest.raises(CaptureError, match=r"no clear reflector.*whole spectra"):
        calibrate(import_file(tmp_path / "half.mat"))


def test_one_transmitter_has_no_rank(board):
    capture, _ = board(num_tx=1)
    with pytest.raises(CaptureError, match="5 receivers and 1 transmitters"):
        calibrate(capture)


def test_a_calibration_comes_back_and_another_file_is_refused(board, tmp_path):
    capture, _ = board()
    found = calibrate(capture)
    save_calibration(found, tmp_path / "b.cal")
    again = load_calibration(tmp_path / "b.cal")
    assert all(np.array_equal(getattr(again, k), v) for k, v in vars(found).items())
    (tmp_path / "c.cal").write_text("no")
    with pytest.raises(CaptureError, match="is no calibration"):
        load_calibration(tmp_path / "c.cal")
    fewer, _ = board(num_rx=4)
    with pytest.raises(CaptureError, match="5 receivers and 3 transmitters, the samples of 4 and"):
        apply(found, fewer)


@pytest.mark.parametrize("receiver", [True, False])
@pytest.mark.parametrize("level", [0.0, 0.05])
def test_an_antenna_that_is_not_connected_is_named(board, receiver, level):
    """Its gain was 0/0 before, or so small that `apply` made noise of it a strong channel."""
    capture, _ = board(noise=1.0)
    samples = capture.cube.samples.copy()
    hurt = samples[:, 2] if receiver else samples[:, :, 2]
    hurt *= level
    capture = replace(capture, cube=replace(capture.cube, samples=samples))
    told = "receiver 2 receives .* from TX 0" if receiver else "receiver 0 .* TX 2"
    count = 3 if receiver else 5
    with pytest.raises(CaptureError, match=f"{told} more than 20 dB .* {count} of 15 channels"):
        calibrate(capture)


def test_an_antenna_that_never_sends_is_named(board):
    capture, _ = board()
    schedule = np.array([[0, 1, 1]])
    capture = replace(capture, cube=replace(capture.cube, schedule=schedule))
    with pytest.raises(CaptureError, match="transmit antenna 2 never sends"):
        capture.channels()


@pytest.mark.parametrize(
    ("change", "pattern"),
    [
        ({"rx_gain": "five"}, "no attribute 'size'"),
        ({"rx_gain": np.zeros(5, complex)}, "a gain or the sweep is zero"),
        ({"tx_gain": np.full(3, np.nan + 0j)}, "tx_gain is not finite"),
        ({"rx_delay": np.zeros(7)}, r"rx_delay is float64 of \(7,\)"),
        ({"tx_delay": np.zeros(3, complex)}, "tx_delay is complex128"),
        ({"response_slope": [1.0, 2.0, 3.0]}, "complex"),
        ({"half_sweep_hz": None}, "half_sweep_hz is object"),
        ({"half_sweep_hz": 0.0}, "a gain or the sweep is zero"),
        ({"one_more": 1.0}, "one_more"),
    ],
    ids=lambda value: next(iter(value)) if isinstance(value, dict) else "",
)
def test_a_sealed_file_of_other_numbers_is_refused(board, tmp_path, change, pattern):
    """The seal says that a file is whole, not who wrote it."""
    capture, _ = board()
    save_calibration(calibrate(capture), tmp_path / "b.cal")
    plain = load_data(tmp_path / "b.cal", KEY)
    save_data(tmp_path / "b.cal", KEY, plain | change)
    with pytest.raises(CaptureError, match=f"is no calibration .*{pattern}"):
        load_calibration(tmp_path / "b.cal")


@pytest.mark.parametrize("where", ["stdout", "first", "file"])
def test_figures_come_as_json(board, tmp_path, capsys, where):
    """Planted bug: `with_standard_output` hands everything on."""
    board()
    cube, file = str(tmp_path / "b.mat"), str(tmp_path / "f.json")
    asked = {
        "stdout": ["calibrate", cube, "--json"],
        "first": ["calibrate", "--json", cube],
        "file": ["calibrate", "--json", file, cube, "--out", str(tmp_path / "b.cal")],
    }[where]
    assert main(asked) == 0
    text = Path(file).read_text() if where == "file" else capsys.readouterr().out
    found = json.loads(text)
    assert [key for key, _ in KEYS] == list(found)[: len(KEYS)]
    assert found["range_m"] == pytest.approx(4.37, abs=1e-3)
    assert (len(found["rx"]["delay_ps"]), len(found["tx"]["phase_std_deg"])) == (5, 3)


def test_a_file_without_a_reflector_ends_with_2(board, tmp_path, capsys):
    board(level=0.0, noise=1.0)
    assert main(["calibrate", str(tmp_path / "b.mat"), "--json"]) == 2
    assert "no clear reflector" in capsys.readouterr().err


def test_the_reflectors_place_is_no_error_of_the_board():
    """Where elements stand and the wave is spherical: an ideal board has no errors left.

    Truth: distances by Pythagoras. Planted bug: the reflector's delay added and not taken away."""
    half = C / 77e9 / 2
    rx, tx = (
        half * np.array([[i, 0.0] for i in range(8)]),
        half * np.array([[0, 0], [8, 0], [0, 4]]),
    )
    antennas = Antennas.placed(tx, rx)
    u = np.array([0.21, 0, -0.13])
    u[1] = np.sqrt(1 - u @ u)
    target = 3.3 * u
    size, slope, rate = 128, 60e12, 9e6
    way = [
        np.linalg.norm(target - at, axis=1) for at in (antennas.rx_positions, antennas.tx_positions)
    ]
    tau = (way[0][:, None] + way[1]) / C
    t = np.arange(size) / rate + 6e-6
    samples = np.exp(2j * np.pi * ((77e9 * tau) % 1 + slope * tau * (t[:, None, None] - tau / 2)))
    d = Description(
        slope_mhz_per_us=60, sampling_rate_hz=rate, samples_per_chirp=size, chirps=(0, 1, 2)
    )
    cube = IFCube(
        samples=samples.transpose(1, 2, 0)[None],
        waveform=waveform_described(d),
        schedule=np.arange(3)[None],
        start_time=0.0,
    )
    found = calibrate(Capture(cube=cube, antennas=antennas), (u[0], u[2]))
    assert found.range_m == pytest.approx(3.3, abs=1e-3)
    assert np.abs(np.rad2deg(np.angle(found.rx_gain))).max() < 0.5
    assert np.abs(np.rad2deg(np.angle(found.tx_gain))).max() < 0.5
    assert np.abs(found.rx_delay).max() < 0.05e-12


def test_the_simulated_board_explains_the_measured(tmp_path):
    """A made-up board of TI's size in front of a point: the program's own cube with all parts is
    the same to what noise and the definition of gains at a common range leave, and each part that
    is left out costs. Without places of elements there is no scene.

    Planted bug: the response's sign in `board`; spherical waves left out of `simulated`."""
    antennas = Antennas.placed(*ti_cascade())
    slope, rate, distance, size = 60e12, 8e6, 4.4, 128
    samples, _ = channels(
        num_rx=16, num_tx=12, slope=slope, rate=rate, distance=distance, size=size, curvature=-0.3
    )
    target = np.array([0, distance, 0])
    middle = 77e9 + slope * (6e-6 + (size - 1) / 2 / rate)
    t = (np.arange(size) - (size - 1) / 2) / rate
    for end, at in ((1, antennas.rx_positions), (2, antennas.tx_positions)):
        late = (np.linalg.norm(target - at, axis=1) - distance) / C
        wave = np.exp(2j * np.pi * (middle * late + slope * np.multiply.outer(t, late)))
        samples = samples * (wave[:, :, None] if end == 1 else wave[:, None, :])
    write_ti(tmp_path / "b.mat", samples, slope / 1e12, rate)
    capture = import_file(tmp_path / "b.mat")
    found = calibrate(capture)
    sets = [PARTS, PARTS[:3], *([p for p in PARTS[:3] if p != part] for part in PARTS[:3]), ()]
    whole, three, *without, ideal = unexplained_by(capture, found, sets)
    assert whole < -60 and three < -40 and ideal > -1
    assert min(without) > three + 10
    with pytest.raises(CaptureError, match="positions of the elements are unknown"):
        unexplained_by(replace(capture, antennas=None), found, sets)
