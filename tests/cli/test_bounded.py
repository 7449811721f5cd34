"""Files that ask for time or memory without end: one message within 5 s and 1 GiB."""

from __future__ import annotations

import json
import zlib
from collections.abc import Callable
from pathlib import Path

import h5py
import numpy as np
import pytest
from bounded import bounded_command

from isac_rt.results.files import ResultsError
from isac_rt.sweep.samples import read_card

MANY = 900_000
TEXTS = {
    "flow list": "a: [" + "1," * MANY + "]",
    "block list": "a:\n" + "- 1\n" * MANY,
    "flow maps": "a: [" + "{}," * MANY + "]",
    "keys": "{" + ",".join(f"k{i}" for i in range(400_000)) + "}",
    "nothing as a key": "a: {" + "? ," * MANY + "}",
    "directives": "%A b\n" * 600_000 + "---\na: 1",
    "words that are no numbers": "chirps: [" + "a," * 90_000 + "]",
    "levels": "[" * MANY,
    "unknown keys": "{" + ",".join(f"k{i}: 1" for i in range(30_000)) + "}",
    "one number": "a: " + "1" * 3_900_000,
    "antennas": "{samples_per_chirp: 64, receivers: 4, chirps: [0, 3000000000]}",
    "many antennas": "{samples_per_chirp: 64, receivers: 4, chirps: [3000000000, -3000000000]}",
    "chirps": "{samples_per_chirp: 64, receivers: 4, chirps: [0], loops: 1000000, frames: 1000000}",
}


@pytest.mark.parametrize("text", TEXTS)
def test_a_description_without_end(text, tmp_path):
    (tmp_path / "a.bin").write_bytes(bytes(4096))
    (tmp_path / "a.yaml").write_text(TEXTS[text])
    arguments = ["import", "a.bin", "--description", "a.yaml", "--out", "a.nc"]
    assert "a." in bounded_command(arguments, tmp_path)


@pytest.mark.parametrize("text", ["flow list", "unknown keys"])
def test_a_scenario_without_end(text, tmp_path):
    (tmp_path / "a.yaml").write_text(TEXTS[text])
    assert "a.yaml" in bounded_command(["plan", "a.yaml"], tmp_path)


@pytest.mark.parametrize(
    "value", ["NaN", "Infinity", "-Infinity", "1e400", "1" + "0" * 400, "-2", "[1]", '"x"']
)
@pytest.mark.parametrize("key", ["num_channels", "sample_rate"])
def test_a_recording_that_states_no_number(key, value, tmp_path):
    """Numbers of JSON that no float holds, or that count nothing."""
    meta = f'{{"global": {{"core:datatype": "ci16_le", "core:{key}": {value}}}}}'
    (tmp_path / "a.sigmf-meta").write_text(meta)
    (tmp_path / "a.sigmf-data").write_bytes(bytes(4 * 64))
    (tmp_path / "d.yaml").write_text(
        "{slope_mhz_per_us: 30, sampling_rate_hz: 8e6, samples_per_chirp: 64, receivers: 1}"
    )
    arguments = ["import", "a.sigmf-meta", "--description", "d.yaml", "--out", "a.nc"]
    assert "a.sigmf-meta" in bounded_command(arguments, tmp_path)


def test_a_recording_described_without_end(tmp_path):
    (tmp_path / "a.sigmf-meta").write_text("[" + "[]," * 5_000_000 + "[]]")
    (tmp_path / "a.sigmf-data").write_bytes(b"")
    arguments = ["import", "a.sigmf-meta", "--out", "a.nc"]
    assert "a.sigmf-meta" in bounded_command(arguments, tmp_path)


def _sparse(file: h5py.File) -> None:
    file.create_dataset("x", (100_000_000,), "f8")


def _sparse_pieces(file: h5py.File) -> None:
    file.create_dataset("x", (100_000_000,), "f8", chunks=(1000,))


def _huge_piece(file: h5py.File) -> None:
    """1.2 GB of zeros for eight numbers."""
    packer, zeros = zlib.compressobj(1), bytes(2**20)
    piece = b"".join(packer.compress(zeros) for _ in range(1200)) + packer.flush()
    pieces = {"chunks": (1200 * 2**18,), "maxshape": (None,), "compression": "gzip"}
    file.create_dataset("x", (8,), "f4", **pieces)
    file["x"].id.write_direct_chunk((0,), piece)


def _named_often(file: h5py.File) -> None:
    file["x0"] = np.zeros(100_000)
    for i in range(1, 2_000):
        file[f"x{i}"] = file["x0"]


@pytest.mark.parametrize("make", [_sparse, _sparse_pieces, _huge_piece, _named_often])
@pytest.mark.parametrize("name", ["a.mat", "a.nc"])
def test_hdf5_that_unfolds_without_end(make: Callable, name: str, tmp_path: Path):
    with h5py.File(tmp_path / name, "w") as file:
        make(file)
    arguments = ["calibrate", name, "--out", "a.cal"]
    if name.endswith(".mat"):
        arguments = ["import", name, "--out", "b.nc"]
    assert name in bounded_command(arguments, tmp_path)


def test_a_data_set_whose_card_is_without_end(tmp_path):
    """Nothing but empty lists: 53 times their size in memory."""
    (tmp_path / "card.json").write_text("[" + "[]," * 9_000_000 + "[]]")
    with pytest.raises(ResultsError, match="larger than"):
        read_card(tmp_path)


def test_a_run_whose_results_unfold_without_end(tmp_path):
    (tmp_path / "summary.json").write_text(json.dumps({"frames": 1, "seed": 1, "terminals": {}}))
    with h5py.File(tmp_path / "results.nc", "w") as file:
        _sparse(file)
    assert "results" in bounded_command(["figures", "."], tmp_path)
