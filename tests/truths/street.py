"""Weather and foreign radars, against the tables of ITU-R, the radar equation and a dechirp at 20
times the rate."""

from __future__ import annotations

import csv
from pathlib import Path

import numpy as np

from isac_rt.extensions.street.air import gas_db_per_km, rain_coefficients
from isac_rt.extensions.street.emitters import Arrival, Train, add_foreign
from isac_rt.extensions.street.weather import Weathered
from isac_rt.frame.antennas import Antennas, Arrays
from isac_rt.frame.cube import ReceiveArray, Reference
from isac_rt.frame.link import Link
from isac_rt.frame.waveform import SPEED_OF_LIGHT, Waveform
from isac_rt.propagation.free_space import FreeSpace
from isac_rt.propagation.pathset import PathKind, PathSet, make_paths
from isac_rt.propagation.scatter_paths import LinkState
from isac_rt.propagation.settings import Weather
from isac_rt.scenario.emitters import Emitter
from isac_rt.scenario.swarm import Uav
from isac_rt.world.swarm import Pose
from truths.case import Errors, case

WAVEFORM = Waveform(num_samples=256, num_chirps=12, num_groups=2)
START = 0.037
OVERSAMPLING = 20
RAIN = 10.0


def table(name: str) -> list[list[str]]:
    """Rows of a table of ITU-R's validation examples."""
    with (Path(__file__).parent / "data" / name).open(encoding="utf-8") as file:
        return list(csv.reader(file))[2:]


@case(
    "ITU-R's validation examples of P.676-13, 350 frequencies",
    "2e-14 relative",
    "the table has 15 digits",
)
def attenuation_by_gas() -> Errors:
    """Air takes what the recommendation says, line by line, from 1 to 350 GHz."""
    for row in table("ITURP676-13_gamma.csv"):
        f, dry, kelvin, density, _, _, gamma = map(float, row)
        found = gas_db_per_km(f * 1e9, kelvin, dry, density * kelvin / 216.7)
        yield abs(found / gamma - 1)


@case(
    "ITU-R's validation examples of P.838-3, 64 paths",
    "6e-9 absolute",
    "the table has eight decimals",
)
def attenuation_by_rain() -> Errors:
    """Rain takes what the recommendation says: k, alpha and the loss, for any elevation and
    polarisation."""
    for row in table("ITURP838-3_rain_specific_attenuation.csv"):
        elevation, f, rain, tilt, *printed = map(float, row)
        k, alpha = rain_coefficients(f * 1e9, np.radians(elevation), np.radians(tilt))
        yield from np.abs(np.array([k, alpha, k * rain**alpha]) - printed)


def rainy(antennas: Antennas, settings: Weather | None = None) -> tuple[Weathered, FreeSpace]:
    """Return open space full of rain, and in vacuum."""
    waveform = Waveform()
    free = FreeSpace({}, Arrays(antennas), waveform.wavelength, 3)
    settings = settings or Weather(rain_mm_per_h=RAIN)
    return Weathered(settings, free, free, waveform, None), free


def rain_of(weather: Weathered, link: Link, ends: dict[str, Pose], draws: int) -> list[PathSet]:
    """Return draws of the rain of a link."""
    return [
        weather.rain_paths(LinkState(link, float(t), ends[link.tx], ends[link.rx]))
        for t in range(draws)
    ]


@case(
    "lambda^2 G^2 eta (1/r_1 - 1/r_2) / (16 pi^2)",
    "0.03 relative",
    "3 draws of 20,000 to 80,000 Gaussian amplitudes",
)
def echoes_of_rain() -> Errors:
    """The rain between two ranges of an isotropic antenna echoes by the radar equation."""
    ends = {"A": Pose.at_rest((3, 1, 20))}
    weather, free = rainy(Antennas(gain=2.0))
    found = rain_of(weather, Link("A", "A"), ends, 3)
    for near, far in ((4, 10), (10, 20), (40, 80)):
        ranges = [p.delay * SPEED_OF_LIGHT / 2 for p in found]
        power = [p.power[(r > near) & (r < far)].sum() for p, r in zip(found, ranges, strict=True)]
        per_metre = weather.drops.density @ weather.drops.backscatter
        integral = free.wavelength**2 * 4 * per_metre * (1 / near - 1 / far)
        yield abs(np.mean(power) / (integral / (16 * np.pi**2)) - 1)


def one_path(delay: float = 150e-9) -> PathSet:
    """Closing and accelerated, near enough for a spherical wave."""
    along = np.array([[0.4, -0.9, np.sqrt(1 - 0.97)]])
    return make_paths(
        gain=[3e-5 * np.exp(1j)],
        delay=[delay],
        delay_rate=[-38 / SPEED_OF_LIGHT],
        delay_accel=[300 / SPEED_OF_LIGHT],
        departure=-along,
        arrival=along,
        rx_radius=[delay * SPEED_OF_LIGHT],
        kind=PathKind.LINE_OF_SIGHT,
        epoch=START + WAVEFORM.frame_duration / 2,
        tx="E",
        rx="A",
    )


def receiver() -> ReceiveArray:
    antennas = Antennas(rx_x=3, rx_z=2, spacing=WAVEFORM.wavelength / 2)
    return ReceiveArray(Pose.at_rest((0, 0, 5), (0.3, 1, 0)), antennas)


def filtered(samples: np.ndarray, rate: float) -> np.ndarray:
    """Samples at a high rate behind the IF filter: 1 on [0, f_s], raised cosines beyond."""
    w = WAVEFORM
    f = np.fft.fftfreq(samples.shape[-1], 1 / rate)
    beyond = np.maximum(np.maximum(-f, f - w.sampling_rate), 0) / w.filter_transition
    gain = np.where(beyond < 1, np.cos(np.pi * np.minimum(beyond, 1) / 2) ** 2, 0.0)
    return np.fft.ifft(np.fft.fft(samples) * gain)


def dechirped(
    train: Train, paths: PathSet, ear: ReceiveArray, drift_ppm: float = 0.0
) -> np.ndarray:
    """Samples (M, L_rx, P, N) of one path: both chirps at 20 times the rate with the true delay of
    each element at each instant, multiplied, filtered, and every 20th taken. The chirps are those
    of a clock that gets so much later."""
    w, rate = WAVEFORM, OVERSAMPLING * WAVEFORM.sampling_rate
    beyond = 400 * OVERSAMPLING  # 20 us before and after the samples
    u = w.fast_time[0] + np.arange(-beyond, w.num_samples * OVERSAMPLING + beyond) / rate
    source = float(paths.rx_radius[0]) * paths.arrival[0]
    out = np.zeros((w.num_groups, ear.antennas.num_rx, w.num_chirps, w.num_samples), complex)
    for m in range(w.num_groups):
        for p in range(w.num_chirps):
            time = START + w.chirp_time[m, p] + u
            since = time - paths.epoch
            delay = paths.delay[0] + paths.delay_rate[0] * since
            delay = delay + paths.delay_accel[0] * since**2 / 2
            for rx, place in enumerate(ear.pose.to_world(ear.antennas.rx_positions)):
                farther = np.linalg.norm(source - place) - np.linalg.norm(source)
                sent = (time - delay - farther / SPEED_OF_LIGHT) / (1 + drift_ppm * 1e-6)
                sent -= train.offset
                v = (sent + 1 / rate) % train.repetition - 1 / rate
                phase = w.carrier_frequency * u + w.slope * u**2 / 2
                phase = phase - train.frequency * v - train.slope * v**2 / 2
                beat = w.carrier_frequency + w.slope * u - train.frequency - train.slope * v
                # a band about the filter's, since what is far would alias at this rate too
                off = np.abs(beat - w.sampling_rate / 2) / w.sampling_rate
                wide = np.cos(np.pi / 2 * np.clip((off - 6) / 3, 0, 1)) ** 2
                # the share of the step about each instant in which the chirp lasts
                lasts = np.clip(np.minimum(v, train.duration - v) * rate + 0.5, 0, 1)
                signal = np.exp(2j * np.pi * (phase % 1)) * lasts * wide
                chosen = slice(beyond, beyond + w.num_samples * OVERSAMPLING, OVERSAMPLING)
                out[m, rx, p] = filtered(signal, rate)[chosen]
    return out * 2.0 * paths.gain[0].conj()


def near_an_end(train: Train, paths: PathSet) -> np.ndarray:
    """Mark the samples (M, P, N) within five samples of a foreign chirp's start or end."""
    w = WAVEFORM
    time = START + w.chirp_time[:, :, None] + w.fast_time
    v = (time - paths.delay[0] - train.offset) % train.repetition
    reach = 5 / w.sampling_rate
    return (v < reach) | (v > train.repetition - reach) | (np.abs(v - train.duration) < reach)


def train_of(slope: float, start: float, duration: float = 20e-6, idle: float = 3.3e-6) -> Train:
    """Chirps of a slope over the receiver's, that start above its carrier [Hz]."""
    w = WAVEFORM
    return Train(
        w.carrier_frequency + start, w.slope * slope, duration, duration + idle, 4.1e-6, None, 0.0
    )


FOREIGN = (
    train_of(0.5, 100e6),
    train_of(-0.8, 400e6),
    train_of(1.7, -40e6),
    train_of(1.02, 30e6, 15e-6),
    Train(
        WAVEFORM.carrier_frequency - 5e6,
        WAVEFORM.slope * 1.0001,
        WAVEFORM.chirp_duration * 1.3,
        WAVEFORM.slot_duration,
        START % WAVEFORM.slot_duration,
        None,
        0.0,
    ),
)
"""Slower, falling, steeper, of nearly the same slope, and a tone of 11.6 MHz."""
SAME = Emitter.model_construct(
    start_hz=WAVEFORM.carrier_frequency,
    slope_mhz_per_us=WAVEFORM.slope * 1e-12,
    ramp_us=WAVEFORM.chirp_duration * 1e6,
    idle_us=(WAVEFORM.slot_duration - WAVEFORM.chirp_duration) * 1e6,
    offset_us=2.75,
    clock_drift_ppm=-40.0,
)
"""A radar of the receiver's chirp."""


@case(
    "both chirps mixed and filtered at 20 times the rate, each element's delay at each instant",
    "1e-3 of the largest sample",
    "the filter's transients 10 us away; clicks of chirps that end far from the band are left out",
)
def foreign_chirps() -> Errors:
    """A foreign chirp crosses the IF band as it would on the air, at any slope."""
    ear, paths = receiver(), one_path()
    own_clock = Train.of(SAME, "E", 0)
    late = own_clock.as_received(SAME, Uav.model_construct(role="active"))
    trains = [*((train, train, 0.0) for train in FOREIGN), (late, own_clock, SAME.clock_drift_ppm)]
    for train, sent, drift in trains:
        truth = dechirped(sent, paths, ear, drift)
        found = np.zeros(truth.shape, complex)
        add_foreign(found, WAVEFORM, Arrival(train, 2.0, paths), ear, Reference(START))
        error = np.moveaxis(np.abs(found - truth), 1, 0)[:, ~near_an_end(train, paths)]
        crosses = np.abs(truth).max() > 5e-5
        yield error.max() / np.abs(truth).max() if crosses else np.inf
