"""Inverses of covariances, sixteen side by side, against numpy's of each."""

from __future__ import annotations

import numpy as np
import pytest

from isac_rt.kernels.hermitian import inverses


@pytest.mark.parametrize(("count", "size"), [(1, 1), (16, 5), (37, 15), (3, 45)])
def test_inverses_are_those_of_numpy(count: int, size: int):
    """Clutter 50 dB over noise of unit power, so that the inverse's elements are one at most: the
    rounding of complex64. Planted bugs: sums in float32 (3e-4); the last matrices, which fill no
    vector, left out; the upper half not conjugated."""
    rng = np.random.default_rng(5)
    waves = rng.standard_normal((count, size, 3, 2)) @ [1, 1j]
    R = np.eye(size) + 1e5 * waves @ waves.conj().transpose(0, 2, 1)
    R = R.astype(np.complex64)
    found, expected = inverses(R), np.linalg.inv(R.astype(complex))
    assert np.abs(found - expected).max() < 1e-6
    assert found.dtype == np.complex64
