"""Samples behind real front ends against a slow oracle that multiplies each path's samples."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from test_ifsignal import SMALL, START, antennas, paths, pose, sender

from isac_rt.frame.cube import ReceiveArray, Reference
from isac_rt.hardware.front_end import IDEAL, Ends, FrontEnd
from isac_rt.hardware.oscillator import Mask, Oscillator, spread
from isac_rt.propagation.pathset import PathKind
from isac_rt.signal.if_signal import if_signal
from isac_rt.signal.methods import Direct, Exact
from isac_rt.signal.noise import WhiteNoise
from isac_rt.signal.received import received

SILENT = WhiteNoise(0.0, np.zeros(2, np.uint32))
LOUD = Mask(((1e4, -60.0), (1e7, -90.0)))
W = SMALL


def terminal(name, mask=LOUD):
    return FrontEnd(oscillator=Oscillator(mask, ((3.1e5, -45.0),), W.sampling_rate, 3, name))


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
    spurs = 2 * 10**-4.5 * 4 * np.sin(np.pi * 3.1e5 * (paths_.delay - main)) ** 2
    bound = np.sqrt(np.average(np.array(left) + spurs, weights=paths_.power))
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
