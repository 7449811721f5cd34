"""Files of radar boards, bent at random: a capture of finite samples or one message, never a
traceback or a hang. FUZZ=2000 pytest test_fuzz_boards.py looks further."""

from __future__ import annotations

import json
import os
import random
import warnings

import h5py
import numpy as np
import pytest
from bending import bent
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from synthetic import channels, write_ti

from isac_rt.extensions.hardware.description import load_description
from isac_rt.extensions.hardware.readers import import_file
from isac_rt.runtime import UserError

EXAMPLES = int(os.environ.get("FUZZ", "60"))
PROFILE = settings(
    max_examples=EXAMPLES,
    deadline=20_000,
    derandomize=EXAMPLES < 1000,
    suppress_health_check=list(HealthCheck),
    database=None,
)
SAID = """
slope_mhz_per_us: 60.012
sampling_rate_hz: 2.5e+6
samples_per_chirp: 16
receivers: 2
chirps: [0, 1]
loops: 3
"""


@pytest.fixture(scope="module")
def boards(tmp_path_factory):
    """Folder and content of one file of every kind, with a description of those that need one."""
    folder = tmp_path_factory.mktemp("boards")
    rng = np.random.default_rng(3)
    write_ti(folder / "five.mat", channels(num_rx=2, num_tx=2, size=16)[0], 61.3)
    values = rng.normal(size=(2, 2, 80))
    with h5py.File(folder / "seven.mat", "w", userblock_size=512) as made:
        parts = np.zeros(values.shape, [("real", "f8"), ("imag", "f8")])
        parts["real"] = values
        made["calibResult/Rx_fft"], made["params/Slope_MHzperus"] = parts, [[61.3]]
    words = rng.integers(-999, 999, (3 * 2, 2, 16, 2))
    (folder / "card.bin").write_bytes(words.astype("<i2").tobytes())
    np.save(folder / "array.npy", words[..., 0] + 1j * words[..., 1])
    (folder / "other.sigmf-data").write_bytes(words.astype("<i2").tobytes())
    (folder / "other.sigmf-meta").write_text(json.dumps({"global": {"core:datatype": "ci16_le"}}))
    (folder / "said.yaml").write_text(SAID)
    return folder, {file.name: file.read_bytes() for file in folder.iterdir()}


def imported(folder, name):
    said = None if name.endswith(".mat") else load_description(folder / "said.yaml")
    return import_file(folder / name, said)


def test_all_of_them_are_read(boards):
    folder, content = boards
    for name, data in content.items():
        (folder / name).write_bytes(data)
        if name != "said.yaml":
            assert imported(folder, name).cube.samples.size, name


@PROFILE
@given(
    st.sampled_from(
        "five.mat seven.mat card.bin array.npy other.sigmf-data other.sigmf-meta said.yaml".split()
    ),
    st.randoms(use_true_random=False),
)
def test_bent_files_of_boards(boards, name, chance: random.Random):
    folder, content = boards
    for other, data in content.items():
        (folder / other).write_bytes(data)
    others = [data for other, data in content.items() if other != name]
    (folder / name).write_bytes(bent(content[name], others, chance))
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            found = imported(folder, "card.bin" if name == "said.yaml" else name)
    except UserError as problem:
        text = str(problem)
        assert text.strip() and len(text.splitlines()) <= 12 and "object at 0x" not in text
        return
    assert found.cube.samples.size and np.isfinite(found.cube.samples).all()
