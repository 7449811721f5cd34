"""Chirp-DMA: oscillators mixed and filtered, against the signal model of the program and the closed
form of the blocks' beats."""

from __future__ import annotations

import numpy as np
import pytest

from isac_rt.frame.antennas import Antennas
from isac_rt.frame.cube import ReceiveArray, Reference, Transmission
from isac_rt.frame.payload import random_payload, unmodulated
from isac_rt.frame.schedule import pseudo_random_schedule
from isac_rt.frame.waveform import SPEED_OF_LIGHT, Waveform
from isac_rt.propagation.pathset import PathKind, make_paths
from isac_rt.receive.passive import receive_passive
from isac_rt.receive.settings import Receivers
from isac_rt.receive.types import Prediction
from isac_rt.signal.exact import filter_gain
from isac_rt.signal.if_signal import if_signal
from isac_rt.signal.methods import Direct, Exact
from isac_rt.world.swarm import Pose
from reproduce.dma import isolation, mix, raised_cosine

C = SPEED_OF_LIGHT
W = Waveform()
SKIRT = W.filter_transition
STILL = Pose.at_rest()


def sight(w, length, speed, gain=1.0, start=0.0):
    """A line of sight as a plane wave."""
    return make_paths(
        gain=np.array([gain]),
        delay=np.array([length / C]),
        delay_rate=speed / C,
        departure=np.array([[0.0, 1.0, 0.0]]),
        arrival=np.array([[0.0, 1.0, 0.0]]),
        kind=PathKind.LINE_OF_SIGHT,
        epoch=start + w.frame_duration / 2,
        tx="A",
        rx="B",
    )


def test_the_filter_has_the_gain_that_the_signal_model_states():
    """Fourier sum of the impulse response against `filter_gain`. Tolerance: the response is cut at
    120 us, where it has fallen as 1/t^3 to 1e-8 of its peak. Planted bug: the passband centred on
    0."""
    step = 1 / (8 * W.sampling_rate)
    t = np.arange(-19200, 19201) * step
    response = raised_cosine(t, W.sampling_rate, SKIRT)
    for beat in (
        -0.7 * SKIRT,
        -0.31 * SKIRT,
        0.0,
        4.7e6,
        19.93e6,
        W.sampling_rate + 0.37 * SKIRT,
        21.3e6,
        47.1e6,
    ):
        gain = (response * np.exp(-2j * np.pi * beat * t)).sum() * step
        assert gain == pytest.approx(filter_gain(W, np.array(beat)), rel=0, abs=1e-5)


def test_mixed_chirps_equal_the_signal_model():
    """Two active terminals one block apart, data on, moving, one with a clock error: the mixer's
    samples against `if_signal`.

    The model leaves out the filter's ringing at the edges of chirps: it decays as 1/t^3 within some
    1/SKIRT (50 samples) of the window's end. So the interior (100 samples off) agrees to 2e-3,
    measured 5e-4 for beats more than 10 cells inside the band; the whole window, whose last samples
    lie at the end of the reference, to 4 % RMS. Planted bug: a data phase that is not conjugated.
    """
    w = Waveform(num_tx=1, num_groups=1, num_chirps=6)
    rng = np.random.default_rng(11)
    one = Antennas(tx_x=1, tx_z=1, rx_x=1, rx_z=1, spacing=w.wavelength)
    schedule = np.zeros((1, 6), int)
    late, start = 0.13e-6, 2.3

    def terminal(block, offset):
        payload = random_payload(w, schedule, 8, rng)
        return Transmission(
            name="A",
            pose=STILL,
            antennas=one,
            schedule=schedule,
            payload=payload,
            first_block=block,
            clock_offset=offset,
            amplitude=1.3,
        )

    near, far = terminal(4, 0.0), terminal(5, late)
    links = [
        (near, sight(w, 37.3, -7.7, 0.8 + 0.3j, start)),
        (far, sight(w, 61.9, 4.1, -0.2 + 1.1j, start)),
    ]
    model = if_signal(w, links, ReceiveArray(STILL, one), Reference(start), Exact()).samples[0, 0]
    middle = np.arange(6) * w.slot_duration - w.frame_duration / 2
    samples = np.zeros_like(model, np.complex128)
    for block, (t, p), speed, gain in zip(
        (0, 1), links, (-7.7, 4.1), (0.8 + 0.3j, -0.2 + 1.1j), strict=True
    ):
        delay = (
            p.delay[0]
            + t.clock_offset
            + speed / C * middle
            + t.payload.delay_symbols[0] * w.delay_step
            + 2 * block * w.max_delay
        )
        amplitude = np.conj(gain) * 1.3 * t.payload.phases[0]
        samples += mix(w, delay[None], amplitude[None], rate=speed / C)
    error = np.abs(samples - model) / np.abs(model).mean()
    assert error[:, 100:-100].max() < 2e-3
    assert np.sqrt((error**2).mean()) < 0.04


@pytest.mark.parametrize(
    ("spacing", "least"), [(1, 47.0), (-1, 47.0), (2, 53.0), (-2, 53.0), (3, 56.0), (-3, 56.0)]
)
def test_neighbours_are_kept_out(spacing, least):
    """Isolation with data on. The bound lies 4 dB under the value measured with these twelve chirps
    (51.5, 58.1 and 61.7 dB).

    Planted bug: a group spacing of T_d."""
    found = isolation(W, spacing, 0.0, np.random.default_rng(1), chirps=12)
    assert found.power_db > least
    assert found.peak_db > 85


def test_isolation_does_not_depend_on_the_mixers_rate():
    """Twice the rate changes it by less than 0.2 dB: the edges of chirps, which alias, are laid
    between the samples."""
    coarse, fine = (
        isolation(W, 1, 0.0, np.random.default_rng(1), chirps=4, oversampling=rate).power_db
        for rate in (32, 64)
    )
    assert fine == pytest.approx(coarse, abs=0.2)


@pytest.mark.parametrize("cells", [2.3, 200.7, 1021.4])
def test_timing_errors_are_tolerated_as_the_beats_say(cells):
    """Next block: in the band once early by T_d plus the delay; block before: once late by 2 T_d
    less the delay (the sum of data and path).

    A neighbour is kept out (25 dB) a skirt and 2 % of T_d before that and is received whole as much
    after it: at the limit the gain is 1, the skirt lies outside the band. Planted bug: a tolerance
    of 2 T_d for both signs.
    """
    limit, margin = W.max_delay, 0.02 * W.max_delay + SKIRT / W.slope
    delay = cells * W.delay_step
    for spacing, error in ((1, -(limit + delay)), (-1, 2 * limit - delay)):
        outwards = 1 if spacing == 1 else -1
        kept, answers = (
            isolation(
                W,
                spacing,
                error + outwards * sign * margin,
                np.random.default_rng(4),
                chirps=2,
                path_cells=cells,
                modulated=False,
            ).power_db
            for sign in (1, -1)
        )
        assert kept > 25
        # the reference power is that of the own block, whose beat 2 cells from the band's edge
        # rings a little
        assert answers == pytest.approx(0, abs=0.5)
    away = isolation(
        W,
        1,
        1.9 * limit,
        np.random.default_rng(4),
        chirps=2,
        path_cells=cells,
        modulated=False,
    )
    assert away.power_db > 40


def collided(first_block, modulated, rng, strength=1.0):
    """A passive terminal's frame of terminal A beside a terminal B of this relative amplitude in
    other or the same blocks."""
    w = Waveform(num_chirps=30)
    antennas = Antennas(tx_x=2, tx_z=2, rx_x=2, rx_z=2, spacing=0.5774 * w.wavelength)
    schedule = pseudo_random_schedule(w.num_groups, w.num_chirps, w.num_tx, rng)
    links = []
    for block, length, speed, gain in (
        (0, 43.817, -5.3, 1.0),
        (first_block, 71.341, 8.9, strength),
    ):
        payload = random_payload(w, schedule, 8, rng) if modulated else unmodulated(w)
        fields = {
            "pose": STILL,
            "antennas": antennas,
            "schedule": schedule,
            "payload": payload,
            "first_block": block,
        }
        links.append((Transmission(name="A", **fields), sight(w, length, speed, gain)))
    cube = if_signal(w, links, ReceiveArray(STILL, antennas), Reference(0.0), Direct())
    noise = (
        np.float32(np.sqrt(0.05))
        * rng.standard_normal((*cube.samples.shape, 2), np.float32).view(np.complex64)[..., 0]
    )
    cube.samples[:] += noise
    known = Prediction(
        range=np.array([43.817]),
        velocity=np.array([-5.3]),
        direction=np.zeros((1, 2)),
        range_std=np.array([0.02]),
        velocity_std=np.array([0.05]),
        weight=np.ones(1),
    )
    return links[0][0].payload, receive_passive(
        cube, antennas, Receivers(), 8, known if modulated else None, modulated
    )


def test_the_stronger_of_two_in_a_block_takes_the_symbols():
    """In neighbouring blocks a terminal of 6 dB more power costs nothing. In the same block the
    stronger tone is decided in every chirp: B 3 dB down leaves A's symbols, 3 dB up nothing, since
    its Doppler betrays it and the frame is erased (undecoded symbols are wrong): A's velocity is
    known to 0.05 m/s, where 0.1 m/s would allow B's phases too.

    Equal power is decided by what the fractions of a cell cost: A's is known and B's is not.
    Planted bug: `first_block` left out of the delay."""
    expected = {(3, 2.0): 0.0, (0, 0.707): 0.0, (0, 1.413): 1.0}
    for (block, strength), share in expected.items():
        sent, got = collided(block, True, np.random.default_rng(5), strength)
        wrong = (got.delay_symbols != sent.delay_symbols).mean()
        print("collision", block, strength, wrong, got.decoded)
        assert wrong == share


def test_a_collision_in_an_unmodulated_frame_is_a_ghost():
    """The other terminal's line of sight is one more detection, and none in other blocks. Planted
    bug: as above."""
    both, alone = (
        collided(block, False, np.random.default_rng(6))[1].detections for block in (0, 3)
    )
    assert len(alone) == 1
    assert np.sort(both.range) == pytest.approx([43.817, 71.341], abs=0.05)  # a tenth of a cell
