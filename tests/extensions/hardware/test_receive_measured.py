"""Measured frames go through the program's receiver."""

from __future__ import annotations

import numpy as np
import pytest
import xarray as xr
from synthetic import C, channels, write_ti

from isac_rt.cli.cli import main
from isac_rt.extensions.hardware.description import Description
from isac_rt.extensions.hardware.readers import import_file
from isac_rt.extensions.hardware.sense import range_azimuth, sense
from isac_rt.extensions.hardware.types import CaptureError
from isac_rt.receive.settings import Receivers

RATE, SLOPE, SIZE, LOOPS, AGAIN = 5e6, 40e12, 64, 16, 60e-6
ELEMENTS = {
    "unit_hz": 77e9,
    "transmitters": [[0, 0], [4, 0], [0, 1]],
    "receivers": [[n, 0] for n in range(4)],
}


def moving(tmp_path, real=False):
    """A point 7.3 m away at (u_x, u_z) = (0.31, -0.12) that recedes at 2.6 m/s, three transmitters
    in turn; by the equation of the ramp, distances by Pythagoras at every chirp."""
    half = C / 77e9 / 2
    tx, rx = (half * np.array(ELEMENTS[k], float) for k in ("transmitters", "receivers"))
    tx, rx = tx - tx.mean(axis=0), rx - rx.mean(axis=0)
    u = np.array([0.31, -0.12])
    forward = np.sqrt(1 - u @ u)
    out = np.empty((LOOPS, 3, 4, SIZE), complex)
    t = 6e-6 + np.arange(SIZE) / RATE
    for loop in range(LOOPS):
        for sender in range(3):
            start = (3 * loop + sender - 1.5 * LOOPS) * AGAIN
            far = 7.3 + 2.6 * (start + t[SIZE // 2])
            way = [
                np.hypot(np.hypot(far * u[0] - at[..., 0], far * u[1] - at[..., 1]), far * forward)
                for at in (tx[sender], rx)
            ]
            tau = (way[0] + way[1])[:, None] / C
            out[loop, sender] = np.exp(
                2j * np.pi * ((77e9 * tau) % 1 + SLOPE * tau * (t - tau / 2))
            )
    rng = np.random.default_rng(3)
    out += 0.3 * (rng.normal(size=out.shape) + 1j * rng.normal(size=out.shape))
    np.save(tmp_path / "m.npy", out.real if real else out)
    said = Description(
        slope_mhz_per_us=SLOPE / 1e12,
        sampling_rate_hz=RATE,
        samples_per_chirp=SIZE,
        receivers=4,
        chirps=(0, 1, 2),
        loops=LOOPS,
        chirp_interval_us=AGAIN * 1e6,
        sampling="real" if real else "complex_1x",
        elements=ELEMENTS,
    )
    return import_file(tmp_path / "m.npy", said)


@pytest.mark.parametrize("real", [False, True], ids=["complex", "real"])
def test_a_moving_point_is_found_where_it_is(tmp_path, real):
    """Range to a tenth of a cell of 0.29 m, velocity to a tenth of one of 0.68 m/s, direction to a
    tenth of a beam; a real frame's image is left out. What a plain radar misses by the way of a
    chirp, f_c v / alpha, is 5 mm.

    Planted bug: slow time in slots of the ramp's length; images kept."""
    found = sense(moving(tmp_path, real), Receivers()).detections
    best = found.select(np.array([found.snr.argmax()]))
    assert best.range[0] == pytest.approx(7.3, abs=0.03)
    assert best.velocity[0] == pytest.approx(2.6, abs=0.07)
    assert best.direction[0, 0] == pytest.approx(0.31, abs=0.03)
    assert best.direction[0, 1] == pytest.approx(-0.12, abs=0.1)  # two elements half a wave apart
    assert len(found) == 1


def test_places_are_needed_for_directions(tmp_path):
    write_ti(tmp_path / "b.mat", channels()[0], 61.3)
    capture = import_file(tmp_path / "b.mat")
    for asked in (lambda: sense(capture, Receivers()), lambda: range_azimuth(capture, None, 9.0)):
        with pytest.raises(CaptureError, match="positions of the elements are unknown"):
            asked()


@pytest.mark.parametrize(
    "asked",
    [
        {"clutter_detector": "angle_doppler"},
        {"refinement": "joint"},
    ],
)
def test_what_a_measured_frame_does_not_have_is_refused(tmp_path, asked):
    """Both ended in tracebacks."""
    ((key, value),) = asked.items()
    with pytest.raises(CaptureError, match=f"receivers.{key}: {value} is not made for a measured"):
        sense(moving(tmp_path), Receivers(**asked))


def test_a_board_with_one_channel_has_ranges(tmp_path):
    """One transmitter and one receiver: no direction, and nothing by which channels could differ;
    a division by zero before."""
    samples, _ = channels(num_rx=1, num_tx=1, size=64, distance=7.3, slope=40e12, rate=5e6)
    out = np.repeat(samples.T[None], LOOPS, axis=0)
    rng = np.random.default_rng(5)
    out += 300 * (rng.normal(size=out.shape) + 1j * rng.normal(size=out.shape))
    np.save(tmp_path / "one.npy", out)
    said = Description(
        slope_mhz_per_us=40.0,
        sampling_rate_hz=5e6,
        samples_per_chirp=64,
        receivers=1,
        loops=LOOPS,
        chirp_interval_us=60.0,
        elements={"transmitters": [[0, 0]], "receivers": [[0, 0]]},
    )
    found = sense(import_file(tmp_path / "one.npy", said), Receivers()).detections
    assert len(found) == 1
    assert found.range[0] == pytest.approx(
        7.3, abs=0.15
    )  # beat at the ramp's middle: a cell is 0.3
    assert np.isnan(found.direction).all()


def test_the_picture_has_its_point_where_it_is(tmp_path):
    """The point recedes by 8 mm in the frame, two wavelengths: the mean chirp fades, so it is
    looked for in a frame of one loop. Planted bug: the transmitters' ways left out."""
    capture = moving(tmp_path)
    samples = np.load(tmp_path / "m.npy")[:1]
    np.save(tmp_path / "m.npy", samples)
    said = Description(
        slope_mhz_per_us=SLOPE / 1e12,
        sampling_rate_hz=RATE,
        samples_per_chirp=SIZE,
        receivers=4,
        chirps=(0, 1, 2),
        elements={**ELEMENTS, "transmitters": [[0, 0], [4, 0], [8, 0]]},
    )
    capture = import_file(tmp_path / "m.npy", said)
    capture.cube.samples[:, :, 2] = 0  # it stands elsewhere
    picture = range_azimuth(capture, np.deg2rad(np.arange(-60, 61)), 12.0)
    best = picture.where(picture == picture.max(), drop=True)
    assert float(best.range[0]) == pytest.approx(7.3, abs=0.3)
    assert float(best.azimuth[0]) == pytest.approx(np.rad2deg(np.arcsin(0.31)), abs=3)


def test_a_calibrated_board_points_ahead(tmp_path, capsys):
    """On the command line, from TI's file to detections and pictures: the reflector that calibrated
    the board stands at its range and, by definition, on the boresight.

    Planted bug: the calibration read and not applied."""
    samples, _ = channels(
        num_rx=16, num_tx=12, size=128, slope=60e12, rate=8e6, noise=30.0, distance=5.2
    )
    write_ti(tmp_path / "b.mat", samples, 60.0)
    file, cal, out = (str(tmp_path / name) for name in ("b.mat", "b.cal", "out"))
    assert main(["calibrate", file, "--out", cal]) == 0
    assert main(["receive", file, "--out", out, "--calibration", cal]) == 0
    assert "detections" in capsys.readouterr().out
    with xr.open_dataset(tmp_path / "out" / "reception.nc", engine="h5netcdf") as d:
        best = int(d.det_snr.argmax())
        assert float(d.det_range[best]) == pytest.approx(5.2, abs=0.01)
        assert abs(float(d.det_u_x[best])) < 0.002 and abs(float(d.det_u_z[best])) < 0.01
        assert float(d.det_velocity[best]) == 0
        assert d.map_power.shape == (d.map_range.size, d.map_velocity.size)
    for name in ("range_doppler.png", "range_azimuth.png"):
        assert (tmp_path / "out" / name).read_bytes()[:4] == b"\x89PNG"
    (tmp_path / "r.yaml").write_text("max_detections: many")
    assert main(["receive", file, "--out", out, "--receivers", str(tmp_path / "r.yaml")]) == 2
    assert "max_detections" in capsys.readouterr().err


def recording(tmp_path, frames=6, behind=0):
    """Words of a DCA1000 of a point that approaches from 9 m at 3 m/s, 50 ms from frame to frame,
    one transmitter in a loop of 32 chirps; exact phases of the ramp at every chirp."""
    t = 6e-6 + np.arange(SIZE) / RATE
    rng = np.random.default_rng(5)
    out = np.empty((frames, 32, 4, SIZE), complex)
    for frame in range(frames):
        for chirp in range(32):
            start = 0.05 * frame + chirp * AGAIN
            tau = 2 * (9.0 - 3.0 * (start + t[SIZE // 2])) / C
            wave = np.exp(2j * np.pi * ((77e9 * tau) % 1 + SLOPE * tau * (t - tau / 2)))
            out[frame, chirp] = 900 * wave
    out += 90 * (rng.normal(size=out.shape) + 1j * rng.normal(size=out.shape))
    words = []
    for pair in np.rint(out).reshape(-1, 2):
        words += [pair[0].real, pair[1].real, pair[0].imag, pair[1].imag]
    (tmp_path / "a.bin").write_bytes(np.array(words, "<i2").tobytes() + bytes(behind))
    (tmp_path / "a.yaml").write_text(
        f"slope_mhz_per_us: {SLOPE / 1e12}\nsampling_rate_hz: {RATE}\nsamples_per_chirp: {SIZE}\n"
        f"receivers: 4\nloops: 32\nchirp_interval_us: {AGAIN * 1e6}\nframe_interval_ms: 50\n"
        "elements: {unit_hz: 77.0e9, transmitters: [[0, 0]], receivers: [[0, 0], [1, 0], [2, 0], "
        f"[3, 0]]}}\nframes: {frames}\n"
    )
    return ["receive", str(tmp_path / "a.bin"), "--description", str(tmp_path / "a.yaml")]


def test_all_frames_of_a_recording_are_tracked(tmp_path):
    """Each frame's range is 9 m less what was flown (a tenth of a cell of 0.29 m), and one track is
    confirmed and follows. Planted bugs: the first frame for all; the interval in seconds."""
    command = recording(tmp_path)
    assert main([*command, "--out", str(tmp_path / "out")]) == 0
    d = xr.open_dataset(tmp_path / "out" / "reception.nc", engine="h5netcdf")
    middle = 0.05 * np.arange(6) + 16 * AGAIN
    for frame in range(6):
        mine = d.det_frame.values == frame
        best = d.det_range.values[mine][d.det_snr.values[mine].argmax()]
        assert best == pytest.approx(9.0 - 3.0 * middle[frame], abs=0.03)
    last = (d.track_frame.values == 5) & d.track_confirmed.values.astype(bool)
    assert last.sum() == 1
    assert d.track_state.values[last][0, 1] == pytest.approx(9.0 - 3.0 * middle[5], abs=0.05)
    assert d.track_state.values[last][0, 4] == pytest.approx(-3.0, abs=0.1)


def test_a_frame_that_was_cut_off_is_refused(tmp_path, capsys):
    """Where to cut is said: six frames of 32 x 4 x 64 samples of 4 bytes. Planted bug: rows read
    up to there without a word."""
    command = recording(tmp_path, behind=1000)
    assert main([*command, "--out", str(tmp_path / "out")]) == 2
    assert "cut the file off at 196608 bytes" in capsys.readouterr().err


def test_the_number_of_frames_is_offered(tmp_path, capsys):
    command = recording(tmp_path)
    text = (tmp_path / "a.yaml").read_text()
    (tmp_path / "a.yaml").write_text(text.replace("frames: 6", "frames: 2"))
    assert main([*command, "--out", str(tmp_path / "out")]) == 2
    assert "state frames: 6" in capsys.readouterr().err
