"""Samples behind real front ends against a slow oracle that multiplies each path's samples."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from test_ifsignal import SMALL, START, antennas, paths, pose, sender

from isac_rt.extensions.hardware.channels import elements_of
from isac_rt.extensions.hardware.converter import converter_of
from isac_rt.extensions.hardware.front_end import IDEAL, Ends, FrontEnd
from isac_rt.extensions.hardware.oscillator import Mask, Oscillator, spread
from isac_rt.extensions.hardware.received import received
from isac_rt.extensions.hardware.sweep import Ramp, response_of, short_read
from isac_rt.frame import front_end as scenario
from isac_rt.frame.cube import ReceiveArray, Reference
from isac_rt.propagation.pathset import PathKind
from isac_rt.signal.if_signal import if_signal
from isac_rt.signal.methods import Direct, Exact, Gridded
from isac_rt.signal.noise import WhiteNoise

SILENT = WhiteNoise(0.0, np.zeros(2, np.uint32))
LOUD = Mask(((1e4, -60.0), (1e7, -90.0)))
W = SMALL


def terminal(name, mask=LOUD):
    return FrontEnd(oscillator=Oscillator(mask, W.sampling_rate, 3, name))


def scene(count, seed=1, **change):
    rng = np.random.default_rng(seed)
    found = paths(W, rng, count, **change)
    return [(sender(W, rng), found)], ReceiveArray(pose(0.1, 1.0, 0.2), antennas(W))


def heard_one_by_one(links, ear, ends):
    """The oracle: each path by itself in float64, its samples turned by the phases of the two
    oscillators at the instants of reception and of emission."""
    begin = START - 1e-4
    end = START + W.frame_duration + 1e-4

    def phase(front_end, time):
        one = front_end.oscillator
        return 0.0 if one is None else one.record(begin, end).at(time)

    out = 0.0
    time = START + W.chirp_time[:, :, None] + W.fast_time
    for (sent, found), theirs in zip(links, ends.senders, strict=True):
        mine = phase(ends.receiver, time)
        for k in range(len(found)):
            one = found.select(np.array([k]))
            later = time - found.epoch
            delay = found.delay[k] + found.delay_rate[k] * later
            alone = if_signal(W, [(sent, one)], ear, Reference(START), Exact()).samples
            turn = np.exp(1j * (mine - phase(theirs, time - delay)))
            out = out + alone * turn[:, None]
    return out


def error(found, truth):
    return np.linalg.norm(found - truth) / np.linalg.norm(truth)


@pytest.mark.parametrize("both_ways", [True, False], ids=["one oscillator", "two"])
def test_paths_by_themselves_carry_the_oscillators(both_ways):
    """Five paths, all of them by themselves: the error is that of float32, of the cubic through a
    phase sampled twice as fast as the IF (1 % of what lies near half the sampling rate), and of
    delays that change by 30 m/s within a frame of 0.3 ms. Planted bugs: phi(t + tau); the
    transmitter's phase with a plus; the strongest path's factor left out."""
    links, ear = scene(5)
    at = terminal("A")
    ends = Ends(at if both_ways else terminal("B"), (at,))
    found = received(W, links, ear, Reference(START), ends, Direct(), SILENT).samples
    truth = heard_one_by_one(links, ear, ends)
    ideal = if_signal(W, links, ear, Reference(START), Direct()).samples
    assert error(found, truth) < 5e-4
    assert error(ideal, truth) > 0.02


def test_many_paths_by_bins_keep_the_bound():
    """Forty paths under noise that none of them breaks: what is wrong is what was left out, the
    phase within a chirp beside that of the strongest path (`spread`). Planted bugs: bins in the
    wrong order; the mean over a chirp of the delay beyond."""
    links, ear = scene(40, seed=2)
    at, pt = (terminal(name, Mask(((1e4, -60.0), (1e5, -80.0), (1e7, -110.0)))) for name in "AB")
    ends = Ends(pt, (at,))
    power = 1e3
    noise = WhiteNoise(power, np.array([3, 4], np.uint32))
    quiet = received(W, links, ear, Reference(START), Ends(IDEAL, (IDEAL,)), Direct(), noise)
    found = received(W, links, ear, Reference(START), ends, Direct(), noise).samples
    found = found - quiet.samples + if_signal(W, links, ear, Reference(START), Direct()).samples
    truth = heard_one_by_one(links, ear, ends)
    paths_, main = links[0][1], links[0][1].delay[np.argmax(links[0][1].power)]
    mask, duration = at.oscillator.mask, W.sampled_duration
    left = [spread(mask, abs(d - main), duration, W.sampling_rate)[1] for d in paths_.delay]
    bound = np.sqrt(np.average(left, weights=paths_.power))
    assert error(found, truth) < 1.3 * bound
    ideal = if_signal(W, links, ear, Reference(START), Direct()).samples
    assert error(ideal, truth) > 3 * bound


def test_strong_paths_are_made_by_themselves():
    """A line of sight 60 dB over the others carries its own oscillator to 1e-3, under noise that
    its skirt breaks. Planted bug: SHARE of the power of the path, not of its noise."""
    links, ear = scene(12, seed=3)
    sent, found = links[0]
    gain = np.where(np.arange(12) < 2, 1e3, 1.0) * found.gain
    links = [(sent, replace(found, gain=gain, kind=np.full(12, PathKind.DIFFUSE)))]
    at = terminal("A")
    ends = Ends(at, (at,))
    noise = WhiteNoise(1e-3, np.array([3, 4], np.uint32))
    samples = received(W, links, ear, Reference(START), ends, Direct(), noise).samples
    assert error(samples, heard_one_by_one(links, ear, ends)) < 1e-3


def test_ideal_ends_change_no_bit():
    """Planted bug: factors of one applied as cos 0 + j sin 0 of a rounded phase."""
    links, ear = scene(9, seed=4)
    ends = Ends(IDEAL, (IDEAL,))
    assert ends.ideal
    found = received(W, links, ear, Reference(START), ends, Direct(), SILENT).samples
    assert np.array_equal(found, if_signal(W, links, ear, Reference(START), Direct()).samples)


def test_elements_reach_every_method():
    """Gains, phases, lines and coupling at both ends, in all methods: each
    against the exact one, which is against two of them by hand. Planted bugs: the factor of antenna
    0 for all in the gridded kernel; receive gains applied twice in the direct one."""
    links, ear = scene(30, seed=6)
    stated = scenario.Elements(
        gain_std_db=2.0,
        phase_std_deg=40.0,
        delay_std_ps=50.0,
        coupling_db=-15.0,
    )
    wave, at = W.wavelength, antennas(W)
    end = FrontEnd(
        transmit=elements_of(stated, at.tx_positions, wave, 3, "A", "tx"),
        receive=elements_of(stated, at.rx_positions, wave, 3, "A", "rx"),
    )
    ends = Ends(end, (end,))
    truth, *fast = (
        received(W, links, ear, Reference(START), ends, method, SILENT).samples
        for method in (Exact(), Direct(), Gridded())
    )
    assert error(fast[0], truth) < 1e-6
    assert error(fast[1], truth) < 1e-4  # 60 m/s of delay rate in a short chirp, as in `Gridded`
    assert error(if_signal(W, links, ear, Reference(START), Direct()).samples, truth) > 0.3


def test_one_path_by_hand():
    """One path, unmodulated antennas: the samples of element r and chirps of antenna a are those of
    the ideal array with the stated factors, whose line of 80 ps is a phase of 77 GHz and a shift
    of the beat. Planted bug: the delay of the receiver taken for the transmitter's."""
    links, ear = scene(1, seed=8)
    at = antennas(W)
    tx = scenario.Elements(gain_db=(3, 0, -3, 1, 0), phase_deg=(0, 30, 60, 90, -45))
    rx = scenario.Elements(delay_ps=(80, 0, 0, 0))
    end = FrontEnd(
        transmit=elements_of(tx, at.tx_positions, W.wavelength, 3, "A", "tx"),
        receive=elements_of(rx, at.rx_positions, W.wavelength, 3, "A", "rx"),
    )
    found = received(W, links, ear, Reference(START), Ends(end, (end,)), Exact(), SILENT).samples
    ideal = if_signal(W, links, ear, Reference(START), Exact()).samples
    factor = 10 ** (np.array(tx.gain_db) / 20) * np.exp(1j * np.radians(tx.phase_deg))
    schedule = links[0][0].schedule
    for m, p in np.ndindex(schedule.shape):
        strong = np.abs(ideal[m, 1, p]) > 0.5 * np.abs(ideal).max()
        ratio = found[m, 1:, p][:, strong] / ideal[m, 1:, p][:, strong]
        if strong.any():
            # groups hear their neighbours through the filter's skirts
            np.testing.assert_allclose(ratio, factor[schedule[m, p]], rtol=1e-4)
    line = found[:, 0] / ideal[:, 0] / (found[:, 1] / ideal[:, 1])
    frequency = W.carrier(time=W.fast_time) - W.slope * links[0][1].delay
    strong = np.abs(ideal[:, 0]) > 0.5 * np.abs(ideal).max()
    truth = np.broadcast_to(np.exp(2j * np.pi * 80e-12 * frequency), line.shape)
    assert np.abs(line - truth)[strong].max() < 0.02


def ramped(links, ear, mine, theirs):
    """The oracle of a bent ramp: each path by itself, turned by the phases of both chirps."""
    out = 0.0
    sent, found = links[0]
    for k in range(len(found)):
        one = found.select(np.array([k]))
        alone = if_signal(W, [(sent, one)], ear, Reference(START), Exact()).samples
        later = W.chirp_time[:, :, None] + W.fast_time - W.frame_duration / 2
        data = sent.payload.delay_symbols[..., None] * W.delay_step
        delay = found.delay[k] + found.delay_rate[k] * later + data
        time = np.broadcast_to(W.fast_time, delay.shape)
        cycles = mine.cycles(time) - theirs.cycles(time - delay)
        out = out + alone * np.exp(2j * np.pi * cycles)[:, None]
    return out


@pytest.mark.parametrize("both_ways", [True, False], ids=["one ramp", "two"])
def test_a_bent_ramp_against_the_phases_of_both_chirps(both_ways):
    """To the ends of the chirp, beyond which samples are read: what is left is that tau/2 is that
    of one path and the mean symbol for all. Seen to fail at the ends, where a fifth of the first
    and the last samples was missing. Planted bugs: read earlier in place of later; the band's
    middle without the data; nothing beyond the ends."""
    links, ear = scene(6, seed=9, reach=0.5)
    theirs = Ramp(1e6, 3e5, 4e-6, W.chirp_duration)
    mine = theirs if both_ways else Ramp(-4e4, 0.0, 1e-5, W.chirp_duration)
    ends = Ends(FrontEnd(ramp=mine), (FrontEnd(ramp=theirs),))
    found = received(W, links, ear, Reference(START), ends, Direct(), SILENT).samples
    truth = ramped(links, ear, mine, theirs)
    ideal = if_signal(W, links, ear, Reference(START), Direct()).samples
    assert error(found, truth) < 0.04 and error(ideal, truth) > 0.2
    ends = np.r_[0:3, -3:0]
    assert error(found[..., ends], truth[..., ends]) < 0.04


def test_a_slightly_bent_ramp_is_read_by_few_taps():
    """A transmitter's ramp off by a twentieth of a sample, in the receiver's band: what is left is
    the bound of the taps and tau/2 of one path for all. Planted bugs: turned back by the receiver's
    band; the last samples of a chirp read from the next."""
    links, ear = scene(6, seed=9, reach=0.5)
    size = 0.05 * W.slope / W.sampling_rate
    theirs = Ramp(size, 0.2 * size, 4e-6, W.chirp_duration)
    assert short_read(1.2 * 0.05) is not None
    end = Ends(IDEAL, (FrontEnd(ramp=theirs),))
    still = Ramp(0.0, 0.0, 1e-5, W.chirp_duration)
    found = received(W, links, ear, Reference(START), end, Direct(), SILENT).samples
    truth = ramped(links, ear, still, theirs)
    ideal = if_signal(W, links, ear, Reference(START), Direct()).samples
    assert error(found, truth) < 5e-3 and error(ideal, truth) > 0.05
    ends = np.r_[0:3, -3:0]
    assert error(found[..., ends], truth[..., ends]) < 5e-3
    gridded = received(W, links, ear, Reference(START), end, Gridded(), SILENT).samples
    assert error(gridded, truth) < 5e-3


def test_gains_over_the_chirp_follow_what_was_sent():
    """A receiver that falls by 4 dB over the chirp and a transmitter that rises by 6 dB, of which
    an echo shows what was sent its whole delay, data and all, earlier. Planted bugs: the data's
    delay left out; the receiver's gain by element 0."""
    links, ear = scene(1, seed=10)
    rx = response_of(scenario.Response(table_db=(2, -2), slope_std_db=1.0), 4, 3, "rx")
    tx = response_of(scenario.Response(table_db=(-3, 3), slope_std_deg=30.0), 5, 3, "tx")
    ends = Ends(FrontEnd(receive_response=rx), (FrontEnd(transmit_response=tx),))
    found = received(W, links, ear, Reference(START), ends, Direct(), SILENT).samples
    ideal = if_signal(W, links, ear, Reference(START), Direct()).samples
    sent, path = links[0]
    x = 2 * np.arange(W.num_samples) / (W.num_samples - 1) - 1
    for m, p in np.ndindex(sent.schedule.shape):
        late = path.delay[0] + sent.payload.delay_symbols[m, p] * W.delay_step
        step = 2 * W.sampling_rate / (W.num_samples - 1)
        gain = tx.at(x - late * step)[sent.schedule[m, p]] * rx.at(x)
        strong = np.abs(ideal[m, :, p]) > 0.5 * np.abs(ideal).max()
        # half a sample of 90 is 0.6 % of the slope over half the chirp: 6 dB and 30 degrees
        np.testing.assert_allclose(
            (found[m, :, p] / ideal[m, :, p])[strong], gain[strong], rtol=0.02
        )


def test_the_automatic_gain_fills_the_converter():
    """A twelve-bit converter 12 dB over the mean power leaves noise of -62 dB of it: 6.02 b + 1.76
    less 12 dB, of complex samples. With a leakage 40 dB over the echoes it is 22 dB under them.
    Planted bug: the gain set by the sum of all elements."""
    links, ear = scene(3, seed=11)
    c = converter_of(scenario.Converter(bits=12))
    ends = Ends(FrontEnd(converter=c), (IDEAL,))
    found = received(W, links, ear, Reference(START), ends, Direct(), SILENT).samples
    ideal = if_signal(W, links, ear, Reference(START), Direct()).samples
    noise = np.mean(np.abs(found - ideal) ** 2)
    level = np.mean(np.abs(ideal[:, :, 0]) ** 2, axis=(0, 2)).max()
    assert 10 * np.log10(noise / level) == pytest.approx(-6.02 * 12 - 1.76 + 12, abs=0.2)


def test_a_driven_amplifier_sends_less():
    """At its saturation 1.5 dB less, in all that is received. Planted bug: once for each chirp."""
    links, ear = scene(2, seed=12)
    ends = Ends(IDEAL, (FrontEnd(saturation=links[0][0].amplitude ** 2),))
    found = received(W, links, ear, Reference(START), ends, Direct(), SILENT).samples
    ideal = if_signal(W, links, ear, Reference(START), Direct()).samples
    np.testing.assert_allclose(found, ideal * 2**-0.25, rtol=1e-5, atol=1e-5)


def test_each_bin_of_delay_has_its_own_phase_once_a_chirp():
    """Noise so slow that a chirp of 5 us turns as a whole: what one phase for all delays would
    leave is taken away by the bins. Planted bugs: the bins' phase with the other sign; none."""
    links, ear = scene(40, seed=2)
    at = FrontEnd(
        oscillator=Oscillator(
            Mask(((2e4, -45.0), (2e5, -125.0), (1e7, -125.0))), W.sampling_rate, 3, "A"
        )
    )
    ends = Ends(at, (at,))
    noise = WhiteNoise(1e3, np.array([3, 4], np.uint32))
    quiet = received(W, links, ear, Reference(START), Ends(IDEAL, (IDEAL,)), Direct(), noise)
    ideal = if_signal(W, links, ear, Reference(START), Direct()).samples
    found = received(W, links, ear, Reference(START), ends, Direct(), noise).samples
    found = found - quiet.samples + ideal
    truth = heard_one_by_one(links, ear, ends)
    assert error(found, truth) < 0.45 * error(ideal, truth)
