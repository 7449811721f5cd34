"""What real front ends do to single waves: phases at an instant, floors, biases of range and angle.

Closed forms: two free oscillators of the linewidth B turn by a normal angle of the variance 4 pi B
t in the time t, and any two with the mask L by 2 int 2 L 4 sin^2(pi f t) df. A converter of b bits
that the automatic gain keeps H over the mean power P leaves P H 2/3 4^-b of noise, white where
noise covers its steps. A wave of power P at the delay tau leaves P L(f) 4 sin^2(pi f tau) f_s in a
range cell whose beat is f off its own. Phases psi of the virtual channels at x turn the direction
by the slope of their regression on k x.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from math import pi

import numpy as np

from isac_rt.extensions.hardware.converter import HEADROOM_DB
from isac_rt.extensions.hardware.front_end import IDEAL, Ends, front_end_of
from isac_rt.extensions.hardware.front_end import FrontEnd as Built
from isac_rt.extensions.hardware.oscillator import Mask
from isac_rt.extensions.hardware.received import received
from isac_rt.frame.antennas import Antennas
from isac_rt.frame.cube import IFCube, ReceiveArray, Reference
from isac_rt.frame.front_end import FrontEnd, Oscillator
from isac_rt.frame.link import Link
from isac_rt.frame.payload import MODULATION_ORDERS, unmodulated
from isac_rt.frame.schedule import pseudo_random_schedule
from isac_rt.frame.waveform import SPEED_OF_LIGHT, Waveform
from isac_rt.propagation.pathset import PathKind, PathSet
from isac_rt.randomness import generator, seed_sequence
from isac_rt.receive.active import receive_active
from isac_rt.receive.cfar import CfarRule
from isac_rt.receive.settings import Receivers
from isac_rt.signal.methods import Direct
from isac_rt.signal.noise import WhiteNoise
from reproduce.symbols import link_waveform, paper_antennas
from reproduce.waves import STILL, sender, waves

OWN = Link("AT", "AT")


def instants(one: Oscillator, frames: int, seed: int) -> tuple[float, dict[int, float], int]:
    """Turn of an AT-to-PT link between one sample of a chirp and the same of the next [rad], the
    share of DPSK symbols that it spoils, by order, and of how many.

    One antenna sends in every slot of the paper's frame, over 11.3 m, without noise; each frame has
    oscillators of its own at both ends. The turn is that of a normal angle with the same mean
    cosine.
    """
    w = link_waveform(1024)
    alone = Antennas(tx_x=1, tx_z=1, rx_x=1, rx_z=1, spacing=w.wavelength / 2)
    sent = sender(alone, np.zeros((1, w.num_chirps), np.int64), unmodulated(w))
    links = [(sent, waves(w.frame_duration / 2, 11.3 / SPEED_OF_LIGHT))]
    job = w, links, ReceiveArray(STILL, alone), Reference(0.0)
    node, middle = FrontEnd(oscillator=one), w.num_samples // 2

    def samples(ends: Ends) -> np.ndarray:
        quiet = WhiteNoise(0.0, np.zeros(2))
        return received(*job, ends, Direct(), quiet).samples[0, 0, :, middle]

    still, turns = samples(Ends(IDEAL, (IDEAL,))), []
    for index in range(frames):
        mine, theirs = (
            front_end_of(node, w, alone, seed, f"{end} {index}") for end in ("PT", "AT")
        )
        phasor = samples(Ends(mine, (theirs,))) / still
        turns.append(np.angle(phasor[1:] / phasor[:-1]))
    turn = np.concatenate(turns)
    shares = {d: float((np.abs(turn) > pi / d).mean()) for d in MODULATION_ORDERS}
    return float(np.sqrt(-2 * np.log(np.cos(turn).mean()))), shares, turn.size


@dataclass(frozen=True)
class Beside:
    """A front end beside a strong wave.

    Attributes
    ----------
    node : its hardware
    leakage_db : of the leakage over the thermal noise of a sample
    """

    node: FrontEnd
    leakage_db: float = 46.0


def _bits(count: int, leakage_db: float = 46.0) -> Beside:
    return Beside(FrontEnd.model_validate({"converter": {"bits": count}}), leakage_db)


FLOORS = {
    "ideal": Beside(FrontEnd()),
    "12 bits": _bits(12),
    "10 bits": _bits(10),
    "8 bits": _bits(8),
    "12 bits, leakage 20 dB stronger": _bits(12, 66.0),
    "pll_poor": Beside(FrontEnd(preset="pll_poor")),
}
WALL_DB = 30.0
"""Power of a wall 40 m away over the thermal noise of a sample."""
ECHO_DB = -36.0
"""The same of a target 80 m away: 4 dB over the detector's threshold beside ideal hardware."""
_DOPPLER = 8
"""Its velocity in cells; it recedes."""
_CELLS = np.r_[260:312, 330:380]
"""Range cells to both sides of the target, away from leakage and wall."""


@dataclass(frozen=True)
class Floor:
    """What lies beside a leakage and a wall, all in dB.

    Attributes
    ----------
    mean : noise of the range cells over the thermal noise
    truth : its closed form
    cfar : background that the detector takes of the range-Doppler map, over that of ideal hardware
    echo : a weak target over the detector's threshold
    """

    mean: float
    truth: float
    cfar: float
    echo: float


def floor(one: Beside, seed: int, ideal: float | None = None) -> tuple[Floor, float]:
    """The floor beside a leakage and a wall, and the median background [power] of the detector.

    Parameters
    ----------
    ideal : the background with ideal hardware; None: this one's own
    """
    w = replace(link_waveform(1024), num_chirps=60)
    antennas, rng = paper_antennas(w), generator(seed, "hardware floor")
    schedule = pseudo_random_schedule(1, w.num_chirps, w.num_tx, rng)
    delays = np.array([1e-9, 80 / SPEED_OF_LIGHT, 160 / SPEED_OF_LIGHT])
    gain = 10 ** (np.array([one.leakage_db, WALL_DB, ECHO_DB]) / 20)
    kinds = np.array([PathKind.LEAKAGE, PathKind.SPECULAR, PathKind.TARGET])
    rate = np.array([0.0, 0.0, 2 * _DOPPLER * w.velocity_cell(2) / SPEED_OF_LIGHT])
    paths = waves(w.frame_duration / 2, delays, rate, gain=gain, kind=kinds)
    own = front_end_of(one.node, w, antennas, seed, "AT")
    words = seed_sequence(seed, "hardware floor noise").generate_state(2)
    job = w, [(sender(antennas, schedule, unmodulated(w)), paths)], ReceiveArray(STILL, antennas)
    cube = received(*job, Reference(0.0), Ends(own, (own,)), Direct(), WhiteNoise(1.0, words))
    cells = np.fft.fft(cube.samples[0] * _hann(w.num_samples), axis=-1)[..., : w.num_range_cells]
    maps = np.fft.fft(cells * _hann(w.num_chirps)[:, None], axis=1)
    power = (np.abs(maps) ** 2).mean(axis=0).T
    settings = Receivers()
    ratio, level = CfarRule.of(settings, antennas.num_rx).ratio(power)
    away = np.abs(np.arange(w.num_chirps) - w.num_chirps / 2) < w.num_chirps / 4
    background = float(np.median(level[_CELLS][:, away]))
    echo = int(np.rint(w.beat_cells(delays[2], rate[2])[0, 0]))
    found = (
        float((np.abs(cells[..., _CELLS]) ** 2).mean()),
        _floor_truth(one, gain**2, delays, w),
        background / (background if ideal is None else ideal),
        float(ratio[echo - 1 : echo + 2, _DOPPLER - 1 : _DOPPLER + 2].max()),
    )
    return Floor(*(float(10 * np.log10(value)) for value in found)), background


def _hann(size: int) -> np.ndarray:
    window = np.hanning(size)
    return window / np.sqrt((window**2).sum())


def _floor_truth(one: Beside, power: np.ndarray, delays: np.ndarray, w: Waveform) -> float:
    """Noise of the range cells over the thermal noise."""
    node, truth = one.node, 1.0
    if node.converter.bits:
        full = 10 ** (HEADROOM_DB / 10) * (power.sum() + 1)
        truth += full * 2 / 3 / 4**node.converter.bits
    if not node.oscillator.ideal:
        mask = Mask(node.oscillator.mask_dbc_hz, node.oscillator.locked)
        for p, delay in zip(power, delays, strict=True):
            offset = np.abs(_CELLS / w.sampled_duration - w.slope * delay) + 1.0
            skirt = mask.level(offset) * 4 * np.sin(pi * offset * delay) ** 2
            truth += float(p * skirt.mean() * w.sampling_rate)
    return truth


@dataclass(frozen=True)
class Bias:
    """Errors of one target's range [mm] and direction cosines, and what closed forms say of them:
    the delay of the boards, and the slope of the channels' phases over the array."""

    range_mm: float
    direction: tuple[float, float]
    range_truth_mm: float
    direction_truth: tuple[float, float]


_PLACES_DEG = ((0.0, 0.0), (-25.0, 5.0), (15.0, -10.0), (40.0, 0.0))
"""Azimuth and elevation of the targets."""
_RANGE, _SPEED = 31.4, 4.3  # [m], [m/s] receding


UNCALIBRATED = FrontEnd.model_validate(
    {"transmit": {"phase_std_deg": 30}, "receive": {"phase_std_deg": 30}}
)
BOARDS = {name: FrontEnd(preset=name) for name in ("ideal", "awr1443", "awr2243_cascade")} | {
    "phases of 30 degrees": UNCALIBRATED
}
"""Whose biases are measured."""


def biases(node: FrontEnd, boards: int, seed: int) -> list[Bias]:
    """What an AT with such hardware finds of single targets, a board drawn for each
    `len(_PLACES_DEG)` of them; targets that are not found are left out."""
    w = link_waveform(512)
    antennas, out = paper_antennas(w), []
    for board in range(boards):
        own = front_end_of(node, w, antennas, seed, f"AT {board}")
        direction_truth, range_truth = _slope(own, antennas, w), _late(own, w)
        for place, angles in enumerate(np.radians(_PLACES_DEG)):
            paths = _echo(angles, w)
            seen = _seen(w, antennas, own, paths, (seed, board, place))
            if seen is None:
                continue
            direction = seen[1] - paths.arrival[0, [0, 2]]
            out.append(
                Bias(
                    1e3 * (seen[0] - _RANGE),
                    (float(direction[0]), float(direction[1])),
                    range_truth,
                    direction_truth,
                )
            )
    return out


def _echo(angles: np.ndarray, w: Waveform) -> PathSet:
    azimuth, elevation = angles
    ahead = np.cos(elevation)
    u = np.array([np.sin(azimuth) * ahead, np.cos(azimuth) * ahead, np.sin(elevation)])
    delay, rate = 2 * _RANGE / SPEED_OF_LIGHT, 2 * _SPEED / SPEED_OF_LIGHT
    middle, kind = w.frame_duration / 2, PathKind.TARGET
    return waves(middle, delay, rate, ends=(u, u), kind=kind, link=OWN)


def _seen(
    w: Waveform, antennas: Antennas, own: Built, paths: PathSet, case: tuple[int, int, int]
) -> tuple[float, np.ndarray] | None:
    """Range and direction of the strongest detection; None where there is none."""
    rng = generator(case[0], "hardware bias", case[1], case[2])
    schedule = pseudo_random_schedule(1, w.num_chirps, w.num_tx, rng)
    sent = sender(antennas, schedule, unmodulated(w))
    noise = WhiteNoise(0.1, rng.integers(0, 2**32, 2, dtype=np.uint32))
    job = w, [(sent, paths)], ReceiveArray(STILL, antennas), Reference(0.0)
    cube: IFCube = received(*job, Ends(own, (own,)), Direct(), noise)
    found = receive_active(cube, sent.payload, antennas, Receivers()).detections
    if not len(found):
        return None
    best = int(np.argmax(found.snr))
    return float(found.range[best]), found.direction[best]


def _late(own: Built, w: Waveform) -> float:
    """Bias of ranges [mm] by the mean delay of the elements and the mean slope of their phase over
    the chirp, of which pi is a range cell."""
    delays = [p.delay.mean() for p in (own.transmit, own.receive) if p is not None]
    slopes = [
        p.slopes.imag.mean() for p in (own.transmit_response, own.receive_response) if p is not None
    ]
    return float(1e3 * (sum(delays) * SPEED_OF_LIGHT / 2 + sum(slopes) / pi * w.range_cell(2)))


def _slope(own: Built, antennas: Antennas, w: Waveform) -> tuple[float, float]:
    """What the phases of the channels add to (u_x, u_z): their regression over the virtual
    channels. An element at r turns the IF by -k r u."""
    phase = np.zeros((antennas.num_tx, antennas.num_rx))
    if own.transmit is not None:
        phase += np.angle(own.transmit.gain)[:, None]
    if own.receive is not None:
        phase += np.angle(own.receive.gain)
    place = 2 * pi / w.wavelength * antennas.virtual_positions[:, [0, 2]]
    slope = np.linalg.lstsq(place - place.mean(axis=0), -phase.ravel(), rcond=None)[0]
    return float(slope[0]), float(slope[1])
