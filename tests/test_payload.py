"""Bits to symbols and back."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from isac_rt.arrays import pseudo_random_schedule
from isac_rt.payload import by_antenna, demodulate_bits, modulate, random_payload, unmodulated
from isac_rt.waveform import Waveform


@settings(max_examples=40, deadline=None, derandomize=True)
@given(
    order=st.sampled_from([2, 4, 8, 16]),
    num_tx=st.integers(1, 4),
    cycles=st.integers(1, 6),
    samples=st.sampled_from([64, 100, 1024]),
    seed=st.integers(0, 2**32),
    data=st.data(),
)
def test_bits_survive(order, num_tx, cycles, samples, seed, data):
    groups = data.draw(st.integers(1, num_tx))
    w = Waveform(num_samples=samples, num_chirps=cycles * num_tx, num_groups=groups, num_tx=num_tx)
    rng = np.random.default_rng(seed)
    schedule = pseudo_random_schedule(groups, w.num_chirps, num_tx, rng)
    p = random_payload(w, schedule, order, rng)
    assert (demodulate_bits(p.delay_symbols, p.transitions, w, order) == p.bits).all()
    assert 0 <= p.delay_symbols.min()
    assert p.delay_symbols.max() < samples // 2


def test_phases_are_the_running_product():
    """beta starts at 1 for every antenna and its steps are the transitions; planted bug: cumsum without the leading 0."""
    w, rng = Waveform(num_chirps=24), np.random.default_rng(3)
    schedule = pseudo_random_schedule(3, 24, 3, rng)
    p = random_payload(w, schedule, 8, rng)
    beta = by_antenna(p.phases, schedule, 3)
    assert (beta[..., 0] == 1).all()
    steps = np.angle(beta[..., 1:] * beta[..., :-1].conj()) / (2 * np.pi / 8)
    assert np.abs((steps - p.transitions + 4) % 8 - 4).max() < 1e-12  # rounding of unit phasors


def test_neighbouring_symbols_differ_in_one_bit():
    """Gray mapping, delay and phase; planted bug: natural binary."""
    w, schedule = Waveform(), pseudo_random_schedule(3, 120, 3, np.random.default_rng(0))
    p = random_payload(w, schedule, 16, np.random.default_rng(1))
    near = (p.delay_symbols + 1) % w.num_delay_symbols
    bits = demodulate_bits(near, (p.transitions + 1) % 16, w, 16)
    assert (bits != p.bits).sum() == p.delay_symbols.size + p.transitions.size


def test_unmodulated_frame():
    p = unmodulated(Waveform())
    assert not p.modulated
    assert (p.phases == 1).all()
    assert not p.delay_symbols.any()


def test_wrong_number_of_bits():
    w, schedule = Waveform(), pseudo_random_schedule(3, 120, 3, np.random.default_rng(0))
    with pytest.raises(ValueError, match="4293"):
        modulate(np.zeros(7, np.uint8), w, schedule, 8)
