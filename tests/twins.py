"""Compares a kernel with its numpy twin on the same arguments."""

from __future__ import annotations

from copy import deepcopy
from typing import Any

import numpy as np

from isac_rt.kernels.jit import TWINS


def assert_twins_agree(name: str, *arguments: Any, rtol: float, atol: float = 0.0) -> None:
    """Assert that the kernel and the twin called `name` return, and write, the same.

    Parameters
    ----------
    name : full name of the twin, such as "isac_rt.signal.direct.add_paths"
    arguments : positional; each side gets a deep copy, and both copies are compared afterwards
    rtol, atol : relative to the largest value of each array, and absolute
    """
    kernel, twin = TWINS[name]
    by_kernel, by_twin = deepcopy(arguments), deepcopy(arguments)
    returned = kernel(*by_kernel), twin(*by_twin)
    _assert_close(*returned, rtol, atol)
    for found, expected in zip(by_kernel, by_twin, strict=True):
        _assert_close(found, expected, rtol, atol)
    changed = any(not _same(a, b) for a, b in zip(arguments, by_twin, strict=True))
    assert changed or returned[1] is not None, f"{name} neither returns nor writes anything"


def _assert_close(found: Any, expected: Any, rtol: float, atol: float) -> None:
    if isinstance(expected, tuple | list):
        assert len(found) == len(expected)
        for one, other in zip(found, expected, strict=True):
            _assert_close(one, other, rtol, atol)
    elif expected is None or isinstance(expected, str):
        assert found == expected
    else:
        found, expected = np.asarray(found), np.asarray(expected)
        assert found.shape == expected.shape
        if found.size and found.dtype.kind in "iufcb":
            largest = float(np.abs(np.nan_to_num(expected)).max())
            np.testing.assert_allclose(found, expected, rtol=0, atol=atol + rtol * largest)


def _same(a: Any, b: Any) -> bool:
    if isinstance(a, tuple | list):
        return all(_same(x, y) for x, y in zip(a, b, strict=True))
    return bool(np.array_equal(np.asarray(a), np.asarray(b)))
