"""Files of boards become cubes: every number stands where the format has it, and what does not fit
is refused with both numbers."""

from __future__ import annotations

import hashlib
import json
import struct
import tracemalloc
import zlib
from dataclasses import asdict

import h5py
import numpy as np
import pytest
import scipy.io
from synthetic import channels, write_ti

from isac_rt.cli.cli import main
from isac_rt.document import ScenarioError
from isac_rt.extensions.hardware.description import Description, load_description
from isac_rt.extensions.hardware.matfile import MOST_BYTES, read_mat
from isac_rt.extensions.hardware.readers import import_file
from isac_rt.extensions.hardware.store import load_capture, save_capture
from isac_rt.extensions.hardware.types import CaptureError
from isac_rt.results.files import ResultsError

FRAMES, LOOPS, CHIRPS, RX, SIZE = 2, 3, (0, 2, 1), 4, 16
COMMON = {
    "slope_mhz_per_us": 60.012,
    "sampling_rate_hz": 2.5e6,
    "samples_per_chirp": SIZE,
    "receivers": RX,
    "chirps": CHIRPS,
    "loops": LOOPS,
    "frames": FRAMES,
    "frame": 1,
    "chirp_interval_us": 92.0,
}


@pytest.fixture
def counts():
    """I and Q of (frame, chirp of it, receiver, sample), all different."""
    shape = (FRAMES, LOOPS * len(CHIRPS), RX, SIZE)
    i = np.arange(np.prod(shape)).reshape(shape) - 500
    return i, -3 * i + 7


def stream(i, q, sampling, interleaved, q_first):
    """The 16-bit words as TI's manual (SWRA581) draws them, word by word."""
    words = []
    for frame in range(FRAMES):
        for chirp in range(LOOPS * len(CHIRPS)):
            a, b = (x[frame, chirp] for x in ((q, i) if q_first else (i, q)))
            if sampling == "real":
                words += list((i[frame, chirp].T if interleaved else i[frame, chirp]).ravel())
            elif interleaved:
                for n in range(SIZE):
                    words += [a[rx, n] for rx in range(RX)] + [b[rx, n] for rx in range(RX)]
            else:
                for rx in range(RX):
                    for n in range(0, SIZE, 2):
                        words += [a[rx, n], a[rx, n + 1], b[rx, n], b[rx, n + 1]]
    return np.array(words, "<i2").tobytes()


@pytest.mark.parametrize("q_first", [False, True])
@pytest.mark.parametrize("interleaved", [False, True])
@pytest.mark.parametrize("sampling", ["complex_1x", "complex_2x", "real"])
def test_every_word_of_a_dca1000_has_its_place(counts, tmp_path, sampling, interleaved, q_first):
    """Planted bug: I Q I Q for two lanes; lanes of the next sample first."""
    i, q = counts
    (tmp_path / "adc.bin").write_bytes(stream(i, q, sampling, interleaved, q_first))
    said = Description(sampling=sampling, interleaved=interleaved, q_first=q_first, **COMMON)
    cube = import_file(tmp_path / "adc.bin", said).cube
    truth = i[1] + (0 if sampling == "real" else 1j) * q[1]
    assert np.array_equal(cube.samples[0], truth.transpose(1, 0, 2))
    assert cube.schedule.tolist() == [[0, 2, 1] * 3]
    assert cube.waveform.slot_duration == pytest.approx(92e-6, rel=1e-12)


def test_the_waveform_is_the_boards(tmp_path):
    """A target's phase at every sample, by the ramp that the board sends: f_0 + slope t over the
    samples from `adc_start_us` on.

    Planted bug: the carrier at the start of the ramp."""
    np.save(tmp_path / "a.npy", np.zeros((2, 9, 4, 16), np.complex64))
    said = {**COMMON, "adc_start_us": 4.3, "carrier_hz": 76.3e9}
    w = import_file(tmp_path / "a.npy", Description(**said)).cube.waveform
    tau, t = 31e-9, 4.3e-6 + np.arange(SIZE) / 2.5e6
    truth = 76.3e9 * tau + 60.012e12 * tau * (t - tau / 2)
    off = (w.phase(np.array(tau), w.fast_time) - truth + 0.5) % 1 - 0.5
    assert np.abs(off).max() < 1e-5
    assert w.slope == pytest.approx(60.012e12, rel=1e-12)
    assert w.range_cell(2) == pytest.approx(299792458 * 2.5e6 / SIZE / 2 / 60.012e12, rel=1e-12)


@pytest.mark.parametrize("dtype", [np.complex64, np.complex128, np.int16])
def test_numpy_axes_are_those_that_are_named(counts, tmp_path, dtype):
    """Joined axes too: frames and loops as one, chirps and receivers as one.

    Planted bug: the axes' names taken for where they go instead of where they are."""
    i, q = counts
    values = i + 1j * q if dtype != np.int16 else i
    at = values.reshape(FRAMES, LOOPS, len(CHIRPS), RX, SIZE)
    file = at.transpose(4, 2, 3, 0, 1).reshape(SIZE, -1, FRAMES * LOOPS).astype(dtype)
    np.save(tmp_path / "a.npy", file)
    sampling = "real" if dtype == np.int16 else "complex_1x"
    axes = ("sample", "chirp", "receiver", "frame", "loop")
    found = import_file(tmp_path / "a.npy", Description(axes=axes, sampling=sampling, **COMMON))
    assert np.array_equal(found.cube.samples[0], values[1].transpose(1, 0, 2))


def test_numbers_that_lost_their_sign_get_it_back(counts, tmp_path):
    """The least and the greatest number among them. Planted bug: -32768 left as 32768."""
    i, q = (values.copy() for values in counts)
    i[1, 0, 0, :3], q[1, 0, 0, :3] = (-32768, 32767, -1), (32767, -32768, 0)
    np.save(tmp_path / "a.npy", i % 65536 + 1j * (q % 65536))
    found = import_file(tmp_path / "a.npy", Description(wrapped=True, **COMMON))
    assert np.array_equal(found.cube.samples[0], (i + 1j * q)[1].transpose(1, 0, 2))


def test_sigmf_of_others_and_of_ours(counts, tmp_path):
    i, q = counts
    flat = np.stack([i, q], axis=-1).transpose(0, 1, 3, 2, 4)  # receivers are channels
    (tmp_path / "a.sigmf-data").write_bytes(flat.astype("<i2").tobytes())
    meta = {"global": {"core:datatype": "ci16_le", "core:num_channels": RX}}
    (tmp_path / "a.sigmf-meta").write_text(json.dumps(meta))
    said = Description(axes=("frame", "loop", "chirp", "sample", "receiver"), **COMMON)
    found = import_file(tmp_path / "a.sigmf-meta", said)
    assert np.array_equal(found.cube.samples[0], (i + 1j * q)[1].transpose(1, 0, 2))
    ours = {
        "core:datatype": "cf32_le",
        "isac_rt:waveform": asdict(found.cube.waveform),
        "isac_rt:schedule": found.cube.schedule.tolist(),
        "isac_rt:start_time_s": 0.0,
    }
    rows = found.cube.samples[0].transpose(1, 2, 0).astype("<c8").tobytes()
    (tmp_path / "b.sigmf-data").write_bytes(rows)
    ours["core:sha512"] = hashlib.sha512(rows).hexdigest()
    (tmp_path / "b.sigmf-meta").write_text(json.dumps({"global": ours}))
    again = import_file(tmp_path / "b.sigmf-data").cube
    assert np.array_equal(again.samples, found.cube.samples)
    assert again.waveform == found.cube.waveform


@pytest.mark.parametrize("version", ["5", "7.3"])
def test_a_ti_calibration_gives_its_samples_back(tmp_path, version):
    """Planted bug: Hann's window of N and not N + 1 steps."""
    samples, _ = channels(num_rx=16, num_tx=12, size=64)
    write_ti(tmp_path / "b.mat", samples, 61.3)
    if version == "7.3":
        tree = read_mat(tmp_path / "b.mat")
        with h5py.File(tmp_path / "b.mat", "w", userblock_size=512) as made:
            for struct_name, inner in tree.items():
                for name, value in inner.items():
                    value = value.T
                    if np.iscomplexobj(value):
                        parts = np.zeros(value.shape, [("real", "f8"), ("imag", "f8")])
                        parts["real"], parts["imag"] = value.real, value.imag
                        value = parts
                    made[f"{struct_name}/{name}"] = value
    found = import_file(tmp_path / "b.mat")
    assert found.cube.samples[0].transpose(2, 0, 1) == pytest.approx(samples, rel=1e-5)
    w = found.cube.waveform
    assert (w.num_samples, w.sampling_rate) == (64, 8e6)  # as TI's, where the file has no rate
    assert w.slope == pytest.approx(61.3e12)
    assert found.antennas is not None and found.antennas.num_tx == 12


def test_a_capture_comes_back_and_is_checked(counts, tmp_path):
    i, q = counts
    np.save(tmp_path / "a.npy", i + 1j * q)
    elements = {"transmitters": [[0, 0], [4, 0], [2, 1]], "receivers": [[n, 0] for n in range(4)]}
    found = import_file(tmp_path / "a.npy", Description(elements=elements, **COMMON))
    save_capture(found, tmp_path / "a.nc")
    again = load_capture(tmp_path / "a.nc")
    assert np.array_equal(again.cube.samples, found.cube.samples)
    assert again.cube.waveform == found.cube.waveform
    assert again.antennas.virtual_positions == pytest.approx(found.antennas.virtual_positions)
    assert dict(again.source) == dict(found.source)
    with h5py.File(tmp_path / "a.nc", "r+") as opened:
        opened["schedule"][0, 2] = 7
    with pytest.raises(ResultsError, match="a transmit antenna cannot be"):
        load_capture(tmp_path / "a.nc")


# ---- what does not fit


def refused(tmp_path, pattern, name="adc.bin", **changes):
    with pytest.raises(CaptureError, match=pattern):
        import_file(tmp_path / name, Description(**{**COMMON, **changes}))


@pytest.mark.parametrize(
    ("kind", "dtype"), [("ci8", "i1"), ("ci16_be", ">i2"), ("ci32_le", "<i4"), ("cf64_be", ">f8")]
)
def test_sigmf_of_any_width_and_order_of_bytes(tmp_path, kind, dtype):
    """Pairs of I and Q. Planted bug: the order of bytes of this machine."""
    rng = np.random.default_rng(1)
    pairs = rng.integers(-100, 100, (FRAMES, LOOPS * len(CHIRPS), RX, SIZE, 2))
    (tmp_path / "a.sigmf-data").write_bytes(pairs.astype(dtype).tobytes())
    (tmp_path / "a.sigmf-meta").write_text(json.dumps({"global": {"core:datatype": kind}}))
    found = import_file(tmp_path / "a.sigmf-meta", Description(**COMMON)).cube.samples[0]
    truth = (pairs[..., 0] + 1j * pairs[..., 1])[1]
    assert np.array_equal(found, truth.transpose(1, 0, 2))


def test_what_a_recording_says_of_itself_is_held(tmp_path):
    """Rate, channels and checksum of SigMF; a rate that nobody else states is its own.

    Planted bug: `_as_stated` returns the description."""
    content = np.ones((FRAMES, LOOPS * len(CHIRPS), RX, SIZE), "<c8").tobytes()
    (tmp_path / "a.sigmf-data").write_bytes(content)

    def write(**said):
        said = {"core:datatype": "cf32_le"} | {f"core:{key}": said[key] for key in said}
        (tmp_path / "a.sigmf-meta").write_text(json.dumps({"global": said}))

    write(sample_rate=1e6)
    refused(tmp_path, r"rate of 1e\+06 samples/s, the description 2.5e\+06", name="a.sigmf-meta")
    write(sample_rate="fast")
    refused(tmp_path, "core:sample_rate is 'fast', no number", name="a.sigmf-meta")
    write(num_channels=3)
    refused(tmp_path, "has 3 channels, the description states 4", name="a.sigmf-meta")
    write(num_channels=RX)
    refused(tmp_path, "axes end with sample; let them end with rec", name="a.sigmf-meta")
    write(sha512="0" * 128)
    refused(tmp_path, "is not what core:sha512 of a.sigmf-meta says", name="a.sigmf-meta")
    said = {"sample_rate": 2e6, "num_channels": RX, "sha512": hashlib.sha512(content).hexdigest()}
    write(**said)
    told = {key: value for key, value in COMMON.items() if key != "sampling_rate_hz"}
    told["axes"] = ("frame", "loop", "chirp", "sample", "receiver")
    found = import_file(tmp_path / "a.sigmf-meta", Description(**told))
    assert found.cube.waveform.sampling_rate == 2e6


@pytest.mark.parametrize(("sampling", "dtype"), [("real", "c8"), ("complex_1x", "f4")])
def test_real_and_complex_numbers_are_not_taken_for_each_other(sampling, dtype, tmp_path):
    """Of real samples the upper half of the range cells are images. Planted bug: no such check."""
    np.save(tmp_path / "a.npy", np.ones((FRAMES, LOOPS * len(CHIRPS), RX, SIZE), dtype))
    refused(
        tmp_path,
        f"numbers, the description states sampling: {sampling}",
        "a.npy",
        sampling=sampling,
    )


def test_numbers_beyond_any_board_are_refused(tmp_path):
    """Powers of 1e300 overflow far behind the import. Planted bug: the largest real part."""
    np.save(tmp_path / "a.npy", np.full((2, 9, 4, 16), 3e20j))
    refused(tmp_path, r"the largest sample is 3e\+20, at most 1e\+12", name="a.npy")
    np.save(tmp_path / "b.npy", np.full((2, 9, 4, 16), 1e300j))
    refused(tmp_path, "576 of 576 samples are not finite", name="b.npy")
    for key in ("slope_mhz_per_us", "sampling_rate_hz", "carrier_hz", "chirp_interval_us"):
        with pytest.raises(ValueError, match="less than or equal to"):
            Description(**{**COMMON, key: 1e300})


def test_sizes_that_do_not_fit_are_refused_with_both_numbers(counts, tmp_path):
    i, q = counts
    content = stream(i, q, "complex_1x", False, False)
    (tmp_path / "adc.bin").write_bytes(content)
    size = len(content)
    refused(tmp_path, rf"has {size} bytes, .* {size // 2}: .* 2 bytes", sampling="real")
    refused(tmp_path, rf"has {size} bytes, .* {3 * size // 4}: ", receivers=3)
    (tmp_path / "adc.bin").write_bytes(content[:-2])
    refused(tmp_path, rf"has {size - 2} bytes, the description asks for {size}: 2 frames x 3 loops")
    np.save(tmp_path / "a.npy", np.zeros((2, 9, 4, 15), np.complex64))
    refused(tmp_path, r"2 x 9 x 4 x 15 has 1080 numbers, .* make 1152", name="a.npy")
    elements = {"transmitters": [[0, 0]] * 3, "receivers": [[0, 0]] * 5}
    np.save(tmp_path / "a.npy", np.zeros((2, 9, 4, 16), np.complex64))
    refused(tmp_path, "has 4 receivers, .* states 5", name="a.npy", elements=elements)
    refused(tmp_path, "has 4 receivers, .* states 16", "a.npy", elements="ti_cascade")
    elements = {"transmitters": [[0, 0]] * 2, "receivers": [[0, 0]] * 4}
    refused(tmp_path, "has 3 transmitters, .* states 2", "a.npy", elements=elements)


def test_what_is_missing_or_no_number_is_said(tmp_path):
    refused(tmp_path, "No such file", name="none.bin")
    bad = np.zeros((2, 9, 4, 16), np.complex64)
    bad[1, 0, 0, :3] = np.nan
    np.save(tmp_path / "a.npy", bad)
    refused(tmp_path, "3 of 576 samples are not finite", name="a.npy")
    np.save(tmp_path / "o.npy", np.array([{}], object), allow_pickle=True)
    refused(tmp_path, "is no NumPy file of numbers", name="o.npy")
    np.save(tmp_path / "s.npy", np.array(["a"]))
    refused(tmp_path, "holds no array of numbers", name="s.npy")
    refused(tmp_path, "does not tell the format", name="x.dat")
    with pytest.raises(CaptureError, match="does not say its slope_mhz_per_us, sampling_rate_hz"):
        import_file(tmp_path / "a.npy")


@pytest.mark.parametrize(
    ("change", "pattern"),
    [
        ({"calibResult": {"RangeMat": np.ones(3)}}, "Rx_fft is no array"),
        ({"calibResult": {"Rx_fft": np.ones((5, 4))}}, r"an array of \(5, 4\)"),
        ({"calibResult": {"Rx_fft": np.zeros((640, 4, 2))}}, "zero everywhere"),
        ({"calibResult": {"Rx_fft": np.full((640, 4, 2), np.nan)}}, "5120 of 5120 numbers"),
        ({"params": {"Slope_MHzperus": -3.0}}, "the slope is -3 MHz/us"),
        ({"params": {"Slope_MHzperus": 1e300}}, r"slope is 1e\+300 MHz/us, between 1e-06 and"),
        ({"params": {"Slope_MHzperus": [60.0, 61.0]}}, "states 2 numbers for the slope"),
        ({"params": {}}, "no slope is stated"),
        ({"calibResult": {"Rx_fft": np.ones((80, 2, 600))}}, "600 transmitters, at most 256"),
    ],
    ids=[
        "no spectra",
        "two axes",
        "zero",
        "nan",
        "slope",
        "steep",
        "two slopes",
        "no slope",
        "600 antennas",
    ],
)
def test_bent_calibrations_are_refused(tmp_path, change, pattern):
    write_ti(tmp_path / "b.mat", channels()[0], 61.3, **change)
    with pytest.raises(CaptureError, match=pattern):
        import_file(tmp_path / "b.mat")


def test_a_description_that_contradicts_the_file_is_refused_with_both(tmp_path):
    write_ti(tmp_path / "b.mat", channels()[0], 61.3, 9.1e6)
    for said, pattern in (
        ({"slope_mhz_per_us": 60.0}, "slope of 61.3 MHz/us, the description 60"),
        ({"sampling_rate_hz": 8e6}, r"rate of 9.1e\+06 samples/s, the description 8e\+06"),
        ({"samples_per_chirp": 100}, "have 128 samples, the description states 100"),
        ({"receivers": 4}, "has 5 receivers, the description states 4"),
    ):
        with pytest.raises(CaptureError, match=pattern):
            import_file(tmp_path / "b.mat", Description(**said))


@pytest.mark.parametrize(
    ("text", "pattern"),
    [
        ("chirps: [0, 0, 1]", r"send \[2, 1\] times in a loop"),
        ("axes: [loop, chirp]", "axes: must|axes = .*: must"),
        ("frame: 3", "there are frames 0 to 0"),
        ("elements: {transmitters: [], receivers: [[0, 0]]}", r"elements\.transmitters"),
        ("slope_mhz_per_us: .nan", "slope_mhz_per_us"),
        ("slope: 3", "unknown key; did you mean loops|unknown key"),
    ],
)
def test_bent_descriptions_are_refused(tmp_path, text, pattern):
    (tmp_path / "d.yaml").write_text(text)
    with pytest.raises(ScenarioError, match=pattern):
        load_description(tmp_path / "d.yaml")


# ---- hostile MATLAB files


def element(kind, data):
    return struct.pack("<II", kind, len(data)) + data + b"\0" * (-len(data) % 8)


def matrix(kind, shape, parts, name=b"x"):
    head = element(6, struct.pack("<II", kind, 0)) + element(
        5, struct.pack(f"<{len(shape)}i", *shape)
    )
    return element(14, head + element(1, name) + b"".join(parts))


def mat(*elements):
    return b"MATLAB 5.0".ljust(124) + b"\x00\x01IM" + b"".join(elements)


def test_objects_cells_and_functions_are_passed_over(tmp_path):
    good = matrix(6, (2, 1), [element(9, struct.pack("<dd", 1.5, -2.0))], b"good")
    others = [matrix(kind, (1, 1), [element(1, b"abc")], b"bad") for kind in (1, 3, 16, 17)]
    (tmp_path / "x.mat").write_bytes(mat(*others, good))
    found = read_mat(tmp_path / "x.mat")
    assert list(found) == ["good"]
    assert found["good"].ravel().tolist() == [1.5, -2.0]
    deep = matrix(2, (1, 1), [element(5, struct.pack("<i", 8)), element(1, b"a".ljust(8, b"\0"))])
    (tmp_path / "x.mat").write_bytes(mat(deep))  # a field without its element
    with pytest.raises(CaptureError, match="is no MATLAB file"):
        read_mat(tmp_path / "x.mat")


def bomb():
    worker, parts = zlib.compressobj(9), []
    for _ in range(MOST_BYTES // 2**24 + 1):
        parts.append(worker.compress(bytes(2**24)))
    return b"".join([*parts, worker.flush()])


@pytest.mark.parametrize(
    "content",
    [
        b"",
        b"MATLAB 5.0",
        mat(element(15, b"no zlib")),
        mat(struct.pack("<II", 14, 2**31)),
        mat(matrix(6, (2**20, 2**20), [element(9, bytes(8))])),
        mat(matrix(6, (-1, -1), [element(9, bytes(8))])),
        mat(matrix(6, (1, 1), [element(99, bytes(8))])),
        mat(matrix(2, (1, 1), [element(5, struct.pack("<i", 0)), element(1, b"ab")])),
        b"\x89HDF\r\n\x1a\n" + bytes(600),
    ],
    ids=["empty", "short", "zlib", "long", "huge", "negative", "type", "names", "hdf5"],
)
def test_bent_mat_files_are_one_message(tmp_path, content):
    """Planted bug: `struct.error` left out of what is caught."""
    (tmp_path / "x.mat").write_bytes(content)
    with pytest.raises(CaptureError, match=r"is no MATLAB file of version 5 or 7\.3"):
        read_mat(tmp_path / "x.mat")


@pytest.mark.slow
def test_what_unfolds_without_end_is_refused(tmp_path):
    """A megabyte that unfolds to more than a gigabyte. Planted bug: `decompress` without a
    limit."""
    (tmp_path / "x.mat").write_bytes(mat(element(15, bomb())))
    with pytest.raises(CaptureError, match="unfolds to more than"):
        read_mat(tmp_path / "x.mat")


def test_what_unfolds_with_nothing_left_is_refused_before_it_does(tmp_path, monkeypatch):
    """An array that takes exactly what may be unfolded, and after it what unfolds to 16 MiB: for
    zlib no byte left was no limit."""
    most = 2**16
    monkeypatch.setattr("isac_rt.extensions.hardware.matfile.MOST_BYTES", most)
    count = most // 16
    whole = matrix(6, (count, 1), [element(9, bytes(8 * count))])
    (tmp_path / "x.mat").write_bytes(mat(whole, element(15, zlib.compress(bytes(2**24), 9))))
    tracemalloc.start()
    try:
        with pytest.raises(CaptureError, match="unfolds to more than 65536 bytes"):
            read_mat(tmp_path / "x.mat")
        assert tracemalloc.get_traced_memory()[1] < 2**21
    finally:
        tracemalloc.stop()


def test_every_cut_of_a_real_file_is_one_message(tmp_path):
    """A file cut short or with a byte changed is read or refused, and never anything else."""
    write_ti(tmp_path / "b.mat", channels(size=16, num_rx=2, num_tx=2)[0], 61.3)
    whole = (tmp_path / "b.mat").read_bytes()
    scipy.io.savemat(tmp_path / "c.mat", {"x": {"a": np.arange(5.0), "b": "word", "c": {"d": 1}}})
    plain = (tmp_path / "c.mat").read_bytes()
    rng = np.random.default_rng(7)
    for trial in range(150):
        content = bytearray((whole, plain)[trial % 2])
        if trial % 3:
            content[rng.integers(100, len(content))] ^= 1 << rng.integers(8)
        else:
            del content[rng.integers(len(content)) :]
        (tmp_path / "x.mat").write_bytes(content)
        try:
            read_mat(tmp_path / "x.mat")
        except CaptureError:
            continue
    assert read_mat(tmp_path / "c.mat")["x"]["a"].ravel().tolist() == [0, 1, 2, 3, 4]


def test_hdf5_links_to_other_files_are_not_followed(tmp_path):
    """Planted bug: `group.get(name)` without `getlink`."""
    with h5py.File(tmp_path / "secret.h5", "w") as made:
        made["x"] = np.arange(3.0)
    with h5py.File(tmp_path / "x.mat", "w") as made:
        made["far"] = h5py.ExternalLink(str(tmp_path / "secret.h5"), "/x")
        made.create_dataset("raw", (2,), "f8", external=str(tmp_path / "secret.h5"))
        made["params/Slope_MHzperus"] = np.array([[61.3]])
    found = read_mat(tmp_path / "x.mat")
    assert list(found) == ["params"]


# ---- the command


def test_import_on_the_command_line(counts, tmp_path, capsys):
    i, q = counts
    (tmp_path / "adc.bin").write_bytes(stream(i, q, "complex_1x", True, False))
    lines = [f"{key}: {list(value) if key == 'chirps' else value}" for key, value in COMMON.items()]
    (tmp_path / "d.yaml").write_text("\n".join([*lines, "interleaved: true"]))
    out = str(tmp_path / "cube.nc")
    asked = ["import", str(tmp_path / "adc.bin"), "--out", out, "--description"]
    assert main([*asked, str(tmp_path / "d.yaml"), "--format", "dca1000"]) == 0
    assert "1 groups x 4 antennas x 9 chirps x 16 samples" in capsys.readouterr().out
    assert np.array_equal(load_capture(out).cube.samples[0], (i + 1j * q)[1].transpose(1, 0, 2))
    (tmp_path / "d.yaml").write_text("\n".join([*lines, "sampling: real"]))
    assert main([*asked, str(tmp_path / "d.yaml")]) == 2
    assert "bytes, the description asks for" in capsys.readouterr().err
    assert main([*asked, str(tmp_path / "d.yaml"), "--format", "wav"]) == 2
