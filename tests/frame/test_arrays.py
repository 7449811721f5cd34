"""Arrays, patterns and schedules against constructions of their own."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pydantic import ValidationError

from isac_rt.frame.antennas import Antennas, l_shape
from isac_rt.frame.schedule import conventional_schedule, is_latin, pseudo_random_schedule
from isac_rt.frame.settings import Array
from isac_rt.scenario.file import load
from isac_rt.simulation.setup import prepare

SCENES = Path(__file__).parents[2] / "scenes"
PAPER = Antennas(tx_x=2, tx_z=2, rx_x=8, rx_z=8, spacing=2.2480e-3)


def test_counts_and_centroids():
    assert (PAPER.num_tx, PAPER.num_rx) == (3, 15)
    assert np.abs(PAPER.rx_positions.sum(axis=0)).max() < 1e-15  # rounding
    assert np.abs(PAPER.tx_positions.sum(axis=0)).max() < 1e-15


def test_virtual_arms_are_uniform_and_gapless():
    """Sums of transmit and receive positions along X make 16 places one spacing apart; planted bug:
    transmit elements one spacing apart."""
    tx, rx = PAPER.tx_positions, PAPER.rx_positions
    arm_tx, arm_rx = tx[:2], rx[:8]
    sums = np.sort((arm_tx[:, None, 0] + arm_rx[None, :, 0]).ravel())
    assert np.diff(sums) == pytest.approx(np.full(15, PAPER.spacing), rel=1e-12)
    assert np.ptp(arm_rx[:, 2]) == 0
    assert np.diff(rx[7:, 2]) == pytest.approx(np.full(7, PAPER.spacing), rel=1e-12)


def test_first_element_is_farthest_along_x():
    p = l_shape(5, 3, 1.3)
    assert np.argmax(p[:, 0]) == 0
    assert np.argmax(p[:, 2]) == 6


@pytest.mark.parametrize("view", [23.0, 71.3, 90.0, 117.9, 180.0])
def test_the_largest_gain_of_a_sector_radiates_its_power(view):
    """The mean over the sphere at `largest_gain_dbi` is 1, by midpoints of rings about the
    boresight. Planted bugs: the half sphere less four whole caps; interior for exterior angles."""
    stated = Array(element_pattern="sector", element_gain_dbi=-3, field_of_view_deg=view)
    gain = 10 ** (stated.largest_gain_dbi / 10)
    a = replace(PAPER, gain=gain, pattern="sector", half_view=np.deg2rad(view) / 2)
    count = 1500
    cosine = (np.arange(count) + 0.5) / count  # u_y: equal areas
    turn = (np.arange(4 * count) + 0.37) * np.pi / (2 * count)
    side = np.sqrt(1 - cosine**2)[:, None]
    u = np.stack(
        np.broadcast_arrays(side * np.cos(turn), cosine[:, None], side * np.sin(turn)), axis=-1
    )
    # half a cell of the edge on either side
    assert a.element_gain(u).mean() / 2 == pytest.approx(1.0, abs=3e-3)


@pytest.mark.parametrize(
    ("array", "possible"),
    [
        ({"element_pattern": "sector", "element_gain_dbi": 4.37}, True),
        ({"element_pattern": "sector", "element_gain_dbi": 4.39}, False),
        ({"element_pattern": "sector", "element_gain_dbi": 12.1, "field_of_view_deg": 50}, True),
        ({"element_pattern": "sector"}, False),
        ({"element_pattern": "isotropic", "element_gain_dbi": 0}, True),
        ({"element_pattern": "isotropic", "element_gain_dbi": 0.7}, False),
        ({"element_pattern": "cosine", "element_gain_dbi": 17.3}, True),
    ],
)
def test_no_element_radiates_more_than_its_power(array, possible):
    """Over 120 degrees 4.365 dBi are possible (2 pi - 4 pi (1 - sin 60 deg) = 4.5996 sr)."""
    if possible:
        Array(**array)
    else:
        with pytest.raises(ValidationError, match=r"times its power; at most .* dBi are possible"):
            Array(**array)


def test_sector_pattern_ends_at_the_field_of_view():
    a = Antennas(
        tx_x=1,
        tx_z=1,
        rx_x=2,
        rx_z=2,
        spacing=1e-3,
        gain=2.5,
        pattern="sector",
        half_view=np.deg2rad(60),
    )
    for azimuth, inside in ((59.9, True), (-59.9, True), (60.1, False), (180.0, False)):
        t = np.deg2rad(azimuth)
        assert a.element_gain(np.array([np.sin(t), np.cos(t), 0.0])) == (2.5 if inside else 0.0)


@settings(max_examples=60, deadline=None, derandomize=True)
@given(num_tx=st.integers(1, 8), cycles=st.integers(1, 12), data=st.data())
def test_conventional_schedules(num_tx, cycles, data):
    """Schemes (a) and (c) for any L_tx and M: each antenna of each group every L_tx slots, never
    twice in a slot. Planted bug: all groups at the same antenna."""
    groups = data.draw(st.integers(1, num_tx))
    schedule = conventional_schedule(groups, cycles * num_tx, num_tx)
    assert is_latin(schedule, num_tx)
    for row in schedule:
        for tx in range(num_tx):
            slots = np.flatnonzero(row == tx)
            assert slots.size == cycles
            assert (np.diff(slots) == num_tx).all()


@settings(max_examples=30, deadline=None, derandomize=True)
@given(num_tx=st.integers(1, 8), cycles=st.integers(1, 12), seed=st.integers(0, 2**32))
def test_as_many_groups_as_antennas_sample_everything(num_tx, cycles, seed):
    """With M = L_tx every antenna sends in every slot, in (c) and (d): the reason why the union
    needs no compressed sensing."""
    chirps, rng = cycles * num_tx, np.random.default_rng(seed)
    for schedule in (
        conventional_schedule(num_tx, chirps, num_tx),
        pseudo_random_schedule(num_tx, chirps, num_tx, rng),
    ):
        assert (np.sort(schedule, axis=0) == np.arange(num_tx)[:, None]).all()


@pytest.mark.parametrize(
    ("groups", "order"),
    [(1, "conventional"), (1, "pseudo_random"), (3, "conventional"), (3, "pseudo_random")],
)
def test_the_four_schemes_come_from_the_scenario_and_its_seed(groups, order):
    """Fig. 5(a) to (d) by two keys; the same seed gives the same schedule whatever else was drawn,
    another seed another random one.

    Planted bug: a seed of its own."""
    one, again, other = (
        load(
            SCENES / "paper_swarm.yaml",
            (f"radio.groups={groups}", f"array.schedule={order}"),
            None,
            seed,
        )
        for seed in (8, 8, 9)
    )
    first, second, third = (prepare(s).schedule for s in (one, again, other))
    assert first.shape == (groups, 120)
    assert (first == second).all()
    assert (first == third).all() == (order == "conventional")
    assert (order == "conventional") == (first == conventional_schedule(groups, 120, 3)).all()


def test_pseudo_random_order_is_not_periodic():
    schedule = pseudo_random_schedule(3, 120, 3, np.random.default_rng(5))
    cycles = schedule[0].reshape(40, 3)
    assert (
        len({tuple(c) for c in cycles}) == 6
    )  # all orders occur in 40 draws (missing one: 6 (5/6)^40 = 0.4 %, fixed seed)


def test_conventional_schedule():
    schedule = conventional_schedule(3, 12, 3)
    assert (schedule[1, :4] == [1, 2, 0, 1]).all()
    assert is_latin(schedule, 3)
