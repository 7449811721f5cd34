"""The paper's 500 frames, whole (minutes): `pytest -m slow -k paper_flight`."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from isac_rt.scenario.file import load
from isac_rt.simulation import simulate

SCENES = Path(__file__).parents[2] / "scenes"


def rms(dataset, observer: str, uav: str, quantity: str, group: str = "tracked") -> float:
    """Over frames 10..499 in which the observer has an estimate."""
    d = dataset.sel(observer=observer, uav=uav).isel(frame=slice(10, None))
    error = (d[f"{group}_{quantity}"] - d[f"truth_{quantity}"]).values
    return float(np.sqrt(np.nanmean(error**2)))


@pytest.mark.slow
def test_the_papers_flight():
    """The bounds of the prototype that started from the truth, met by terminals that acquire; PT2's
    reflected path is 20 dB under the reference."""
    r = simulate.run(load(SCENES / "paper_swarm_consistent.yaml"))
    d = r.dataset
    assert r.summary["terminals"]["PT1"]["ser_delay"] == 0
    assert r.summary["terminals"]["PT1"]["ser_dpsk"] == 0
    assert rms(d, "PT1", "AT", "range") <= 0.002
    assert rms(d, "PT1", "AT", "velocity") <= 0.05
    assert np.rad2deg(rms(d, "PT1", "AT", "azimuth")) <= 0.02
    assert rms(d, "AT", "PT1", "range") <= 0.03
    assert rms(d, "AT", "PT1", "velocity") <= 0.06
    assert np.rad2deg(rms(d, "AT", "PT1", "azimuth")) <= 0.03
    seen = np.flatnonzero(
        d.in_view.sel(observer="AT", uav="PT2").values & d.processed.sel(observer="AT").values
    )
    assert seen.min() == 140  # in view from frame 132 on, and the AT processes every 20th
    both = np.flatnonzero(d.in_view.sel(observer="PT1", uav="PT2").values)
    assert (both.min(), both.max()) == (
        132,
        232,
    )  # published: 133 to 233, counted at the start of a frame; here at its middle
    pt2 = d.sel(observer="PT2")
    assert (
        np.flatnonzero(pt2.decoded.values).min() == 151
    )  # the first data frame after the first pilot with the AT in view, 150
    wrong = pt2.symbol_errors.values[151:, :2].sum()
    assert wrong == 0
