"""The study of self-calibration: its bounds, and what its verdicts say."""

from __future__ import annotations

import numpy as np
import pandas as pd
import pytest

from reproduce import self_calibration as study


@pytest.mark.parametrize("passes", [2, 1])
def test_an_array_without_errors_keeps_its_bound_and_one_with_them_finds_it(passes, monkeypatch):
    """Without errors nothing is over the bound but what looks add: a tenth of it in power, and half
    of that is found by 40 arrays. With errors the first is many times the bound."""
    found = study.ratios(passes, 40, 3)
    assert found[0] > 5
    assert found[-1] < 1.25  # of 80 cosines: 1.05, give or take 8 %
    monkeypatch.setattr(study, "PHASE_DEG", 0.0)
    monkeypatch.setattr(study, "GAIN_DB", 0.0)
    assert study.ratios(passes, 40, 4)[0] == pytest.approx(1, abs=0.2)


def flights(hit_rate: float, azimuth: float) -> pd.DataFrame:
    rows = [("ideal", 0.8, 0.1), ("none", 0.5, 2.0), ("positions", hit_rate, azimuth)]
    return pd.DataFrame(
        [
            {"terminal": "AT", "calibration": n, "hit_rate": h, "tracked_azimuth_deg": a}
            for n, h, a in rows
        ]
        + [
            {"terminal": "PT", "calibration": n, "hit_rate": 0.0, "tracked_azimuth_deg": None}
            for n, *_ in rows
        ]
    )


@pytest.mark.parametrize(
    ("hit_rate", "azimuth", "verdict"),
    [(0.76, 0.3, "holds"), (0.74, 0.3, "does not hold"), (0.76, 1.1, "does not hold")],
)
def test_munich_is_judged_by_hit_rates_and_angles(hit_rate, azimuth, verdict):
    """A terminal that finds nothing with ideal hardware either is not judged."""
    assert study._munich_verdict(flights(hit_rate, azimuth)).verdict == verdict


def test_bounds_are_judged_by_the_last_look():
    looks = pd.DataFrame(
        [(t, n, r) for t in ("active", "passive") for n, r in enumerate((9.0, 1.1))],
        columns=["terminal", "looks", "error_over_bound"],
    )
    assert study._bound_verdict(looks, 5).verdict == "holds"
    assert np.isfinite(looks.error_over_bound).all()
    looks.loc[3, "error_over_bound"] = 1.13
    assert study._bound_verdict(looks, 5).verdict == "does not hold"
