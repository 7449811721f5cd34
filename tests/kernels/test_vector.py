"""How many lanes a kernel takes at once is a matter of speed alone."""

from __future__ import annotations

import os
import subprocess
import sys

import pytest

from isac_rt.kernels.vector import LANES, PART

TRANSFORMED = """
from isac_rt.receive.transform import transform
samples, factor = rng.standard_normal((2, 2, 16, 240, 2)) @ [1, 1j]
out = np.empty((2, 37, 16), np.complex64)
transform(samples.astype(np.complex64), factor[0], np.arange(37), out)
found = out
"""


@pytest.mark.slow
@pytest.mark.parametrize("what", [TRANSFORMED], ids=["transform"])
def test_all_lanes_at_once_or_half_of_them_make_the_same_bits(what, tmp_path):
    """As compiled for a processor with AVX-512 and for one without, on whatever this one is.
    Planted bugs: a line's sums of the second half of the lanes begin with those of the first; the
    squares beside the diagonal are transposed and not exchanged."""
    found = set()
    for wide in (True, False):
        program = (
            "import hashlib, numpy as np; from llvmlite import binding\n"
            "features = binding.get_host_cpu_features()\n"
            f"told = type('', (type(features),), {{'get': lambda self, name: {wide}}})(features)\n"
            "binding.get_host_cpu_features = lambda: told\n"
            "from isac_rt.kernels import vector; print(vector.PART)\n"
            f"rng = np.random.default_rng(8)\n{what}\n"
            "print(np.abs(found).max() > 0, hashlib.sha256(found.tobytes()).hexdigest())\n"
        )
        run = subprocess.run(
            [sys.executable, "-c", program],
            env=os.environ | {"ISAC_RT_CACHE": str(tmp_path / str(wide))},
            capture_output=True,
            text=True,
            check=True,
        )
        part, *bits = run.stdout.split()
        assert part == str(LANES if wide else LANES // 2)
        assert bits[0] == "True"
        found.add(bits[1])
    assert PART in (LANES, LANES // 2)
    assert len(found) == 1
