"""The claims of the text: what their numbers rest on, each against a truth of its own."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pandas as pd
import pytest

from isac_rt.frame.antennas import Antennas
from isac_rt.frame.waveform import Waveform
from isac_rt.results.metrics import binomial_interval
from reproduce import (
    claims_access,
    claims_angle,
    claims_cost,
    claims_recovery,
    claims_signal,
)

C = 299_792_458.0


def silent(done, total):
    assert 0 <= done <= total


def test_the_separable_model_leaves_out_migration_and_doppler():
    """Of a slow target the error is the RMS of the phase that the paper drops, about its mean: the
    Doppler within a chirp, the migration, the window's late start. Second order in a phase of 0.01:
    1e-4 relative.

    Planted bug: the paper's range taken at mid-frame, which adds a term of the size of the
    migration."""
    w, v = Waveform(num_groups=1), 0.11
    n, p = np.arange(1024)[None, :] / 20e6, np.arange(120)[:, None] * w.slot_duration
    rate = 2 * v / C
    t = p + n + w.window_start
    tau = 100.0 / C + rate * (t - w.frame_duration / 2)
    u = n + w.window_start
    exact = 77e9 * (tau - 100.0 / C) + w.slope * tau * (u - tau / 2)
    start = (100.0 - 2 * v * w.frame_duration / 2) / C
    dropped = exact - (w.slope * start * n + 77e9 * rate * p)
    assert claims_signal.model_error(v, False, 1) == pytest.approx(
        2 * np.pi * dropped.std(), rel=1e-3
    )


def test_data_phases_make_the_separable_model_useless():
    assert claims_signal.model_error(0.0, False, 1) < 1e-6  # complex64
    assert claims_signal.model_error(0.0, True, 1) > 0.9


@pytest.mark.parametrize("order", [2, 8])
def test_tolerated_velocity_error_is_a_half_symbol_in_the_longest_gap(order):
    """Tolerance: the last step of the bisection is 0.2 % of the limit; the window and the range
    prediction take another per cent.

    Planted bug: the AT's two passes."""
    measured, formula = claims_signal.tolerated_error(order, 3)
    assert measured == pytest.approx(formula, rel=0.02)
    # five slots between two chirps of an antenna: last of a cycle... first of the next is 1, first
    # ... last is 5
    assert formula == pytest.approx(C / (2 * 5 * 64.8533e-6 * 77.34e9 * order), rel=1e-4)


def test_a_cell_is_more_than_a_frames_travel():
    """The notes' 0.4675 by hand: 15.0085 m/s for 7.7824 ms over 0.24983 m."""
    assert claims_signal.travel_cells(Waveform()) == pytest.approx(
        15.0085 * 7.7824e-3 / 0.24983, rel=1e-4
    )


def test_the_papers_dictionary_stretches_the_sine():
    """sin' = 2 x 0.5774 sin, within half a step of the grid (0.09 degrees). Planted bug: the true
    spacing in the dictionary."""
    for angle in (-33.3, 12.7, 45.0):
        expected = np.rad2deg(np.arcsin(2 * 0.5774 * np.sin(np.deg2rad(angle))))
        assert claims_signal.paper_angle(angle) == pytest.approx(expected, abs=0.1)


def test_departure_answers_are_the_beams_of_two_elements():
    """Peaks of |1 + exp(j 2 pi 4.62 (u - u_0))| within +-sin 60, counted. Planted bug: the period
    of neighbouring elements."""
    u = np.linspace(-np.sin(np.pi / 3), np.sin(np.pi / 3), 200_001)
    beam = np.abs(1 + np.exp(2j * np.pi * 8 * 0.5774 * (u - 0.137)))
    peaks = (beam[1:-1] > beam[:-2]) & (beam[1:-1] >= beam[2:])
    assert claims_signal.departure_answers(0.137) == peaks.sum()


def test_far_echoes_lose_chirps_to_the_filter():
    """A chirp is kept while path plus data stay below N and the part of the skirt above it in which
    the power gain exceeds 1/2.

    Uniform symbols: a binomial, 4.5 sigma. Planted bug: one way instead of there and back."""
    kept, total = claims_signal.kept_chirps(400.0, 5)
    beyond = np.arccos(2 * np.sqrt(0.5) - 1) / np.pi * 0.4e6 / (20e6 / 1024)
    share = (1024 + beyond - 400.0 / (C / 600e6)) / 512
    assert abs(kept - share * total) < 4.5 * np.sqrt(total * share * (1 - share))


def test_coherence_and_isometry_of_every_pair():
    """Coherence by all inner products; the isometry constant of two columns is their correlation,
    so at most the coherence.

    Planted bug: the zeroth difference, which is 1, left in."""
    rng = np.random.default_rng(8)
    chosen = claims_recovery.slots(True, rng)
    atoms = np.exp(2j * np.pi * np.outer(chosen, np.arange(120)) / 120) / np.sqrt(40)
    products = np.abs(atoms.conj().T @ atoms) - np.eye(120)
    mu = claims_recovery.coherence(chosen)
    assert mu == pytest.approx(products.max(), rel=1e-9)
    assert 0.3 * mu < claims_recovery.isometry(chosen, 2, 300, rng) <= mu + 1e-9
    assert claims_recovery.coherence(claims_recovery.slots(False, rng)) == pytest.approx(
        1, rel=1e-12
    )


def test_recovery_is_certain_where_coherence_says_so_and_fails_beyond_the_samples():
    """One tone always; sixty of 40 samples never, nor off the grid. Planted bug: the support
    compared by its size alone."""
    assert claims_recovery.recovered(1, 60, 0.0, False, 1) == 60
    assert claims_recovery.recovered(38, 60, 0.0, False, 1) == 0
    assert claims_recovery.united_error(60, 30, 1) < 1e-12  # rounding: the full DFT


def test_recovery_falls_as_coherence_rises():
    """120 chirps shared by two to six antennas. Six tones: certain from 60 chirps (2 K ln P = 57),
    not from 20.

    Planted bug: the schedule of three antennas for all."""
    table, (verdict,) = claims_recovery.against_coherence(True, 4)
    assert verdict.verdict == "holds under a condition"
    assert (table.coherence.diff().dropna() > 0).all()
    assert table.recovered.iloc[0] > 0.98 * 400 and table.recovered.iloc[-1] < 0.7 * 400


def test_the_rule_of_the_fall_back_ends_where_recovery_does():
    """One path in a cell is sparse, sixteen of 40 samples are not. Planted bug: the noise taken for
    the paths."""
    assert claims_recovery.judged_sparse(1, 5, 3) == 5
    assert claims_recovery.judged_sparse(16, 5, 3) == 0


def test_dependable_sparsity_ends_at_the_first_failure():
    low = [0.99, 0.96, 0.94, 0.97]
    table = pd.DataFrame({"levels": "a", "sparsity": [1, 2, 3, 4], "low": low})
    assert claims_recovery.dependable(table, "a") == 2
    assert claims_recovery.dependable(table.assign(low=0.99), "a") == 4
    assert claims_recovery.dependable(table.assign(low=0.5), "a") == 0


def test_latin_schedules_are_counted_and_a_broken_one_is_seen(monkeypatch):
    """Planted bug: only the groups checked, not the slots."""
    table, (verdict,) = claims_recovery.latin(True, 2)
    assert verdict.verdict == "holds" and len(table) == 36

    def same_in_all_groups(groups, chirps, num_tx, rng):
        return np.tile(np.tile(rng.permutation(num_tx), chirps // num_tx), (groups, 1))

    monkeypatch.setattr(claims_recovery, "pseudo_random_schedule", same_in_all_groups)
    table, (verdict,) = claims_recovery.latin(True, 2)
    assert verdict.verdict == "does not hold"
    assert (table[table.M > 1].latin == 0).all() and (
        table[table.M == 1].latin == table[table.M == 1].cycles
    ).all()


def test_growth_fits_the_exponent(monkeypatch):
    """A clock that advances by size^1.7 per call, and by 50 s more in the first two. Planted bug:
    the mean instead of the least time."""
    now = [0.0]

    def make(size):
        late = [50.0, 50.0]

        def call():
            now[0] += size**1.7 * 1e-3 + (late.pop() if late else 0.0)

        return call

    monkeypatch.setattr(claims_cost.time, "process_time", lambda: now[0])
    got = claims_cost.growth("s", "n", [10, 20, 40, 80], make, 3)
    assert got.exponent == pytest.approx(1.7, abs=1e-6)
    assert got.deviation < 1e-6


def test_a_constant_offset_of_the_clock_is_a_range():
    """Acquired range and symbols at 10 dB; planted bug: the offset subtracted."""
    bias, count = claims_signal.late_frames(307e-9, 10.0, 1, 4)
    assert bias == pytest.approx(307e-9 * C, abs=0.01)  # a fiftieth of a cell
    assert count[0] == count[2] == 0 and count[1] == 360 and count[3] == 351


def test_an_alias_of_the_velocity_turns_the_transmit_elements():
    """At 0.5 to 0.9 of the limit scheme (a) takes an alias, a third of a cycle from antenna to
    antenna, and the beam moves; (b) does not.

    Planted bug: velocities below a third of the limit."""
    assert claims_angle.angle_hits("a", 3, 1) == (0, 0)
    assert claims_angle.angle_hits("b", 3, 1) == (3, 3)


def test_virtual_places_are_counted_and_gaps_seen():
    """Planted bug: places counted without looking for gaps."""
    full = Antennas(tx_x=2, tx_z=2, rx_x=8, rx_z=8, spacing=2.2e-3)
    assert claims_angle.virtual(full) == (18, 16)
    # transmit elements rx_x = 8 spacings apart, but two receive elements are missing from the arm
    gapped = SimpleNamespace(
        tx_x=2,
        rx_x=6,
        num_tx=3,
        num_rx=13,
        spacing=2.2e-3,
        tx_positions=full.tx_positions,
        rx_positions=full.rx_positions[2:],
    )
    assert claims_angle.virtual(gapped)[1] == 0


def test_a_change_of_antenna_turns_the_phase():
    """The elements' distances in wavelengths are 4.6 and more, so that the turn is nearly uniform:
    1 - 1/D of it spoils a symbol, to the ripple of sinc(4.6 x 1.2) (0.06). Antenna by antenna
    nothing is spoilt. Planted bug: a whole symbol allowed."""
    assert claims_angle.spatial_slips(8, 4000, 1) / 4000 == pytest.approx(7 / 8, abs=0.06)
    assert claims_angle.antenna_order(1, 1) == (0, 117)


def test_terminals_share_the_band_unless_in_one_block():
    """Others at +30 dB in other blocks cost nothing; at +6 dB in the same block they take the
    frame."""
    apart = claims_access.crowd({3: 30.0, 15: 30.0}, 1, 0.0, 1, "test")
    same = claims_access.crowd({0: 6.0}, 1, 0.0, 1, "test")
    assert (apart.delay_errors, apart.delay_total) == (0, 90)
    assert binomial_interval(same.delay_errors, same.delay_total)[0] > 0.5


@pytest.mark.slow
def test_all_claims(tmp_path):
    """The whole quick run: every table, every verdict, the figure; the verdicts that do not depend
    on the machine's speed."""
    from reproduce import claims
    from reproduce.outcome import write

    outcome = claims.run(True, 20260, silent)
    assert all(v.finding for v in outcome.verdicts) and len(outcome.verdicts) == 31
    judged = {v.claim: v.verdict for v in outcome.verdicts if " costs O(" not in v.claim}
    assert {c for c, v in judged.items() if v == "does not hold"} == {
        "The approximations that make the IF a product of range, Doppler and angle are negligible",
        "The redundant DFT dictionary gives the angles",
        "A PT estimates angles of departure",
    }
    assert len(write(outcome, tmp_path)) == len(outcome.tables) + 2
