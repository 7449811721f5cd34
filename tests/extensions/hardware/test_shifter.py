"""Phases of shifters against the theory of rounded phases."""

from __future__ import annotations

import numpy as np
import pytest

from isac_rt.extensions.hardware.channels import shifter_of
from isac_rt.frame.front_end import FrontEnd, Shifter


@pytest.mark.parametrize("bits", [2, 3, 5])
def test_rounded_phases_leave_what_a_uniform_error_does(bits):
    """A code that comes by all phases keeps sinc(2^-b)^2 of its power in its own band, the rest is
    in the others. Planted bug: rounded down, which keeps as much but turns by half a step."""
    size = 1009
    code = np.exp(2j * np.pi * 7 * np.arange(size) / size)
    sent = shifter_of(Shifter(bits=bits), 1, 1, "A").sent(0, code)
    kept = np.mean(sent * code.conj())
    assert abs(kept) ** 2 == pytest.approx(np.sinc(2.0**-bits) ** 2, rel=1e-3)
    assert np.angle(kept) == pytest.approx(0, abs=2e-3)


def test_quarter_turns_need_no_rounding():
    code = 1j ** np.arange(24)
    np.testing.assert_allclose(
        shifter_of(Shifter(bits=6), 2, 1, "A").sent(1, code), code, atol=1e-12
    )


def test_a_measured_cascade_has_its_errors():
    """2.7 degrees over all steps and antennas: 1.6 in common, 2.2 of each. Planted bug: all
    antennas alike."""
    stated = FrontEnd(preset="awr2243_cascade").shifter
    built = shifter_of(stated, 400, 1, "A")
    nominal = np.exp(2j * np.pi * np.arange(64) / 64)
    off = np.angle(built.steps / nominal, deg=True)
    assert off.std() == pytest.approx(2.7, abs=0.06)
    assert off.mean(axis=0).std() == pytest.approx(1.62, abs=0.05)
    assert shifter_of(Shifter(), 3, 1, "A") is None
