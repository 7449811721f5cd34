"""Arrays placed element by element: the virtual array by hand."""

from __future__ import annotations

import numpy as np
import pytest

from isac_rt.frame.antennas import SPEED_OF_LIGHT, Antennas, resolutions, ti_cascade
from isac_rt.frame.waveform import Waveform


def test_virtual_positions_are_the_sums_about_both_centroids():
    """Three by two by hand; bug: rx_positions[:, None] + tx_positions (the other order)."""
    a = Antennas.placed([(0, 0), (6, 0), (0, 3)], [(1, 1), (3, 5)])
    tx = [(-2, -1), (4, -1), (-2, 2)]
    rx = [(-1, -2), (1, 2)]
    by_hand = [(t[0] + r[0], 0, t[1] + r[1]) for t in tx for r in rx]
    assert a.virtual_positions == pytest.approx(np.array(by_hand), abs=1e-15)
    assert (a.num_tx, a.num_rx) == (3, 2)
    assert a.observes(2) == (True, True)


def test_an_l_in_places_is_the_same_array():
    """Any element order and origin; bug: places taken without the centroid."""
    shape = Antennas(tx_x=2, tx_z=2, rx_x=4, rx_z=3, spacing=2e-3)
    at = np.array([0.3, -0.2])
    placed = Antennas.placed(
        shape.tx_positions[:, [0, 2]] + at, shape.rx_positions[:, [0, 2]] - at, gain=2.0
    )
    assert placed.virtual_positions == pytest.approx(shape.virtual_positions, abs=1e-15)
    w = Waveform()
    same = [resolutions(w, a, passes) for a in (shape, placed) for passes in (1, 2)]
    assert same[2][2:] == pytest.approx(same[0][2:])  # one pass: both receive arms are gapless
    assert placed.gain == 2.0


def test_a_row_observes_no_elevation():
    """Transmit elements above each other help an echo alone; bug: the receive array's span for
    both."""
    row = [(2e-3 * i, 0.0) for i in range(4)]
    assert Antennas.placed(row[:2], row).observes(2) == (True, False)
    raised = Antennas.placed([(0, 0), (4e-3, 2e-3)], row)
    assert raised.observes(2) == (True, True)
    assert raised.observes(1) == (True, False)
    assert resolutions(Waveform(), Antennas.placed(row[:1], row), 2)[3] > 100


def test_cascade_row_has_86_azimuth_places():
    """The nine lower transmitters give a filled virtual row of 86 half wavelengths (TI's number);
    bug: a transmit place of 12 half wavelengths written as 13."""
    tx, rx = ti_cascade()
    a = Antennas.placed(tx, rx)
    half = SPEED_OF_LIGHT / 76.8e9 / 2
    lower = a.virtual_positions.reshape(12, 16, 3)[3:, :, 0]
    places = np.round((lower - lower.min()) / half).astype(int)
    assert np.unique(places).tolist() == list(range(86))
    up = a.virtual_positions[:, 2].reshape(12, 16)
    assert np.round((up - up.min()) / half).astype(int)[:, 0].tolist() == [6, 4, 1] + 9 * [0]


@pytest.mark.parametrize(
    ("tx", "said"),
    [([], "needs positions"), ([(0, 0, 1)], "needs positions"), ([(0, np.nan)], "finite numbers")],
)
def test_places_that_are_none_are_refused(tx, said):
    """Bug: an empty list that makes an array without elements."""
    with pytest.raises(ValueError, match=f"tx: .*{said}"):
        Antennas.placed(tx, [(0, 0)])
