"""A run drawn by methods."""

from __future__ import annotations

import matplotlib
import numpy as np
import pytest
from fake_run import fake_run

import isac_rt as irt
from isac_rt.results.files import ResultsError, save

matplotlib.use("Agg", force=True)


@pytest.fixture(scope="module")
def run():
    return fake_run()


def test_a_run_is_opened_and_drawn_in_one_line(run, tmp_path):
    """Every method from the folder: axes with something on them, and what they show belongs to the
    terminal that is asked for. Planted bug: always the first observer."""
    import matplotlib.pyplot as plt

    save(run, tmp_path)
    plots = irt.Plots(tmp_path)
    d = run.dataset
    drawn = [
        plots.scene(),
        plots.range_doppler("PT1"),
        plots.tracks("PT1", "velocity"),
        plots.errors("azimuth"),
        plots.paths("PT1", "doppler"),
        plots.decoding("PT1"),
        plots.reference_snr(),
    ]
    assert all(ax.has_data() for ax in drawn)
    limits = drawn[1].get_ylim()
    far = [np.nanmax(d.map_range.values[[*d.observer.values].index(o)]) for o in ("AT", "PT1")]
    assert limits[1] == pytest.approx(far[1], rel=0.05) and far[0] != pytest.approx(far[1])
    axes = plt.figure().subplots()
    assert plots.errors(ax=axes) is axes
    plt.close("all")


def test_what_is_not_there_is_one_message(run, tmp_path):
    plots = irt.Plots(run)
    with pytest.raises(ResultsError, match="choose from AT, PT1"):
        plots.tracks("PT9")
    with pytest.raises(ResultsError, match="kept 1 frames"):
        plots.range_doppler(snapshot=3)
    with pytest.raises(ResultsError, match="cannot read results"):
        irt.Plots(tmp_path)


def test_a_measure_that_there_is_not_is_refused(run):
    """Seen as a KeyError, and as a plot over delay. Planted bug: no `_check` in `paths`."""
    plots = irt.Plots(run)
    for draw in (plots.tracks, plots.errors):
        with pytest.raises(ResultsError, match="height: choose from range, velocity, azimuth, el"):
            draw(measure="height")
    with pytest.raises(ResultsError, match="range: choose from delay, doppler"):
        plots.paths(against="range")
