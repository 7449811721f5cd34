"""Tables of a summary, by hand."""

from __future__ import annotations

import pytest

from isac_rt.results.losses import LOSSES
from isac_rt.scenario.tree import OWN
from isac_rt.views.tables import city_costs


@pytest.mark.parametrize(("hits", "loss"), [(0.75, "0.2"), (1.0, "-0.05")])
def test_a_city_costs_what_noise_alone_would_find_besides(hits: float, loss: str):
    """Planted bug: the sign."""
    link = {
        "bounds": {"clutter_free": 0.95},
        "hit_rate": hits,
        "in_view": 40,
        "losses": dict.fromkeys(LOSSES, 3),
    }
    kinds = {"ghost": 0.25, "specular": 0.125, "diffuse": None, "noise": 2.0}
    link |= {"tracked_rate": 0.5, "false_tracks": kinds, "ser_delay": 0.5}
    summary = {"links": {"A->P": link}, "timing_s": {"by_set": {OWN: {"A->P": 1.0}}}}
    table = city_costs(summary)
    (row,) = (dict(zip(table.columns, cells, strict=True)) for cells in table.rows)
    assert row["City loss"] == loss and float(row["False tracks of the city"]) == 0.375
