"""Bits to symbols and back."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from isac_rt.frame.payload import (
    demodulate_bits,
    modulate,
    passes_check,
    random_payload,
    remainder,
    unmodulated,
)
from isac_rt.frame.schedule import pseudo_random_schedule
from isac_rt.frame.waveform import Waveform


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


@settings(max_examples=200, deadline=None, derandomize=True)
@given(
    order=st.sampled_from([2, 4, 8, 16]),
    num_tx=st.integers(1, 9),
    cycles=st.integers(1, 40),
    half=st.integers(8, 700),
    ratio=st.floats(2.5, 60),
    rate=st.floats(1e6, 9e7),
    data=st.data(),
)
def test_bits_and_rate_are_exact(order, num_tx, cycles, half, ratio, rate, data):
    """N_bit and the slot for any L_tx, M <= L_tx, P, N, D and T: bits counted symbol by symbol in
    integers, the slot in units of T as 1 + (2 + 2 L_tx) f_s/(B - 2 f_s), from T~ = T + 2 T_d, T_GI
    = 2 L_tx T_d and T_d = f_s T~/B.

    Planted bug: floor(log2(N)) in place of floor(log2(N/2))."""
    groups = data.draw(st.integers(1, num_tx))
    w = Waveform(
        sampling_rate=rate,
        bandwidth=ratio * rate,
        num_samples=2 * half,
        num_chirps=cycles * num_tx,
        num_groups=groups,
        num_tx=num_tx,
    )
    per_delay, per_phase = 0, {2: 1, 4: 2, 8: 3, 16: 4}[order]
    while 2 ** (per_delay + 1) <= half:
        per_delay += 1
    count = sum(
        per_delay + (per_phase if cycle else 0)
        for _ in range(groups)
        for cycle in range(cycles)
        for _ in range(num_tx)
    )
    assert w.bits_per_frame(order) == count
    rng = np.random.default_rng(half)
    p = random_payload(w, pseudo_random_schedule(groups, w.num_chirps, num_tx, rng), order, rng)
    assert p.bits.size == count
    assert p.delay_symbols.size * per_delay + p.transitions.size * per_phase == count
    duration = 2 * half / rate
    slot = duration * (1 + (2 + 2 * num_tx) / (ratio - 2))
    assert w.slot_duration == pytest.approx(slot, rel=1e-9)  # rounding, where B is near 2 f_s
    assert count / w.frame_duration == pytest.approx(count / (cycles * num_tx * slot), rel=1e-9)


@settings(max_examples=60, deadline=None, derandomize=True)
@given(
    order=st.sampled_from([2, 4, 8, 16]),
    samples=st.sampled_from([16, 50, 100, 512, 1024]),
    groups=st.integers(1, 3),
    seed=st.integers(0, 999),
)
def test_every_single_bit_reaches_its_symbol(order, samples, groups, seed):
    """Turning one bit changes one symbol and, through the running product, no phase before it.
    Planted bug: the groups' bits in the order of time."""
    w, rng = (
        Waveform(num_samples=samples, num_chirps=12, num_groups=groups),
        np.random.default_rng(seed),
    )
    schedule = pseudo_random_schedule(groups, 12, 3, rng)
    one = random_payload(w, schedule, order, rng)
    bits = one.bits.copy()
    k = int(rng.integers(bits.size))
    bits[k] ^= 1
    other = modulate(bits, w, schedule, order)
    changed = [
        (one.delay_symbols != other.delay_symbols).sum(),
        (one.transitions != other.transitions).sum(),
    ]
    assert changed == ([1, 0] if k < one.num_delay_bits else [0, 1])
    group = (
        k // (12 * w.bits_per_delay_symbol)
        if k < one.num_delay_bits
        else (k - one.num_delay_bits) // (9 * (order.bit_length() - 1))
    )
    kept = [m for m in range(groups) if m != group]
    assert (one.bits_of([group]) != other.bits_of([group])).sum() == 1
    assert not kept or (one.bits_of(kept) == other.bits_of(kept)).all()
    assert (one.phases[kept] == other.phases[kept]).all()


def test_neighbouring_symbols_differ_in_one_bit():
    """Gray mapping, delay and phase; planted bug: natural binary."""
    w, schedule = Waveform(), pseudo_random_schedule(3, 120, 3, np.random.default_rng(0))
    p = random_payload(w, schedule, 16, np.random.default_rng(1))
    near = (p.delay_symbols + 1) % w.num_delay_symbols
    bits = demodulate_bits(near, (p.transitions + 1) % 16, w, 16)
    assert (bits != p.bits).sum() == p.delay_symbols.size + p.transitions.size


def divided(bits, divisor=0b110011011):
    """Remainder of bits by D^8 + D^7 + D^4 + D^3 + D + 1, by long division of integers."""
    left = int("".join(map(str, bits)) or "0", 2)
    while left.bit_length() >= divisor.bit_length():
        left ^= divisor << left.bit_length() - divisor.bit_length()
    return left


def test_check_sum_is_that_of_the_standard():
    """0xEA of "123456789" is the published check value of the CRC-8 of 3GPP TS 36.212; lengths at
    random by long division. Planted bug: a polynomial without its D^4."""
    text = np.unpackbits(np.frombuffer(b"123456789", np.uint8))
    assert remainder(np.append(text, np.zeros(8, np.uint8))) == 0xEA
    rng = np.random.default_rng(5)
    for size in (1, 8, 9, 300):
        bits = rng.integers(0, 2, size, dtype=np.uint8)
        assert remainder(bits) == divided(bits)


@pytest.mark.parametrize("checked", [None, ((0, 2), (1,))])
def test_check_sums_hold_and_notice_errors(checked):
    """Every set of groups ends with its own sum, which a receiver of these groups alone can test;
    one wrong bit, and any burst within 8, fails it. Planted bug: the sums' places counted over all
    groups."""
    w = Waveform(num_samples=64, num_chirps=12, checked=checked)
    schedule = pseudo_random_schedule(3, 12, 3, np.random.default_rng(2))
    p = random_payload(w, schedule, 4, np.random.default_rng(3))
    sets = [(0, 1, 2)] if checked is None else checked
    assert w.bits_per_frame(4) - w.payload_bits(4) == 8 * len(sets) == p.check.size
    for groups in sets:
        mine, own = p.bits_of(groups), w.of_groups(groups)
        assert divided(mine) == 0 and passes_check(mine, own, 4)
        assert p.is_check(groups).sum() == 8 and p.is_check(groups)[-8:].all()
        for first in range(mine.size - 7):
            wrong = mine.copy()
            wrong[first : first + 8] ^= np.array([1, 0, 0, 1, 0, 0, 1, first % 2], np.uint8)
            assert not passes_check(wrong, own, 4)
    assert w.of_groups((2,)).payload_bits(4) == w.bits_per_frame(4) // 3  # nothing to check it by


def test_frames_without_room_carry_no_check_sum():
    w = Waveform(num_samples=16, num_chirps=3, num_groups=1)
    schedule = pseudo_random_schedule(1, 3, 3, np.random.default_rng(0))
    assert w.bits_per_frame(2) == 9 and w.payload_bits(2) == 1
    w = Waveform(num_samples=8, num_chirps=3, num_groups=1)
    assert w.bits_per_frame(2) == w.payload_bits(2) == 6
    assert passes_check(random_payload(w, schedule, 2, np.random.default_rng(0)).bits, w, 2)


def test_unmodulated_frame():
    p = unmodulated(Waveform())
    assert not p.modulated
    assert (p.phases == 1).all()
    assert not p.delay_symbols.any()


def test_wrong_number_of_bits():
    w, schedule = Waveform(), pseudo_random_schedule(3, 120, 3, np.random.default_rng(0))
    with pytest.raises(ValueError, match="4293"):
        modulate(np.zeros(7, np.uint8), w, schedule, 8)
