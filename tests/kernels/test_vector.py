"""How many lanes a kernel takes at once is a matter of speed alone."""

from __future__ import annotations

import os
import subprocess
import sys

import pytest

from isac_rt.kernels.vector import LANES

PROGRAM = """
import hashlib
import numpy as np
from isac_rt.kernels import jit
jit.AVX512 = {wide}
from isac_rt.kernels.vector import PART
from isac_rt.receive.spectrum import transform
samples, factor = np.random.default_rng(8).standard_normal((2, 2, 16, 240, 2)) @ [1, 1j]
out = np.zeros((2, 37, 16), np.complex64)
transform(samples.astype(np.complex64), factor[0], np.arange(37), out)
print(PART, np.abs(out).max() > 0, hashlib.sha256(out.tobytes()).hexdigest())
"""


@pytest.mark.slow
def test_all_lanes_at_once_or_half_of_them_make_the_same_bits(tmp_path):
    """Range spectra as compiled for a processor with AVX-512 and for one without, on whatever this
    one is. Planted bug: the squares beside the diagonal are transposed and not exchanged."""
    found = set()
    for wide, lanes in ((True, LANES), (False, LANES // 2)):
        run = subprocess.run(
            [sys.executable, "-c", PROGRAM.format(wide=wide)],
            env=os.environ | {"ISAC_RT_CACHE": str(tmp_path / str(wide))},
            capture_output=True,
            text=True,
            check=True,
        )
        part, filled, bits = run.stdout.split()
        assert part == str(lanes)
        assert filled == "True"
        found.add(bits)
    assert len(found) == 1
