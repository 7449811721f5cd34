"""Claims on the signal: the approximations of its model, intervals of the modulation, ambiguities,
angles, a late clock."""

from __future__ import annotations

from collections.abc import Iterable
from functools import partial

import numpy as np
import pandas as pd

from isac_rt.frame.antennas import Antennas
from isac_rt.frame.payload import Payload, random_payload, unmodulated
from isac_rt.frame.schedule import conventional_schedule, pseudo_random_schedule
from isac_rt.frame.waveform import SPEED_OF_LIGHT as C
from isac_rt.frame.waveform import Waveform
from isac_rt.randomness import generator
from isac_rt.receive.known import Known
from isac_rt.receive.maps import accumulate, channel_maps
from isac_rt.receive.passive import receive_passive
from isac_rt.receive.settings import Receivers
from isac_rt.receive.spectrum import clean_spectrum
from isac_rt.receive.symbols import demodulate
from reproduce import fig5, onepath
from reproduce.outcome import Progress, Sentences, Verdict, proportion, table
from reproduce.waves import prediction

SPACING = 0.5774
"""Spacing of the paper's receive elements [carrier wavelengths]."""

say = Sentences("""
model: The approximations that make the IF a product of range, Doppler and angle are negligible
  relative RMS error without data {text} (migration and the Doppler within a chirp); with data at
  least {worst:.2f} at any velocity, because the phases of the data delay are left out

travel: A delay interval of one cell exceeds what a target moves in a frame
  {cells:.4f} cells at the unambiguous velocity; what is needed besides is a prediction within half
  a cell (Fig. 12)

phases: The interval of the phases must exceed what the velocity error turns in p < 2 L_tx slots
  read as angles, 2 pi p f |dv|/c < pi/D at a PT (the paper compares complex numbers, and the AT's
  4 pi is not the PT's); tolerated without noise for D = 2, 4, 8, 16: {text} m/s

velocity: The maximum unambiguous velocity is L_tx times that of conventional TDM-MIMO
  {text}; it still falls as L_tx grows, since the guard interval 2 L_tx T_d lengthens the slot

dictionary: The redundant DFT dictionary gives the angles
  exp(-j pi l sin) belongs to half a wavelength; at {spacing} wavelengths it turns {text} degrees

departure: A PT estimates angles of departure
  its two transmit elements per axis stand {apart:.2f} wavelengths apart: {answers} answers within
  the field of view

far: UAVs are far-field points
  2 D^2/lambda is {far:.2f} m for the virtual aperture of {aperture:.1f} mm; the least distance of
  the flight is 4 m (wavefronts are spherical here all the same)

late: A constant synchronisation delay biases the range and leaves the data alone
  the range is off by c times the delay to within {bias:.1f} mm; symbol error rates at {snr:g} dB, 7
  receive antennas: {inside}; on condition that path and clock together stay below half of the
  range: {beyond}, and no acquisition

half: Range below N/2 cells and data below N/2 cells keep every chirp in its resource block
  chirps that keep an echo from 120 m: {inside}; from 200 m, beyond the {half:.1f} m: {outside}
""")


# ---------------------------------------------------------------- the separable model


def separable(w: Waveform, payload: Payload, length: float, rate: float) -> np.ndarray:
    """The paper's sampled IF (equations for AT and PT) of a path of unit amplitude: (M, P, N)
    complex."""
    n, p = np.arange(w.num_samples) / w.num_samples, np.arange(w.num_chirps) / w.num_chirps
    cells, bins = length / C / w.delay_step, w.frame_duration * w.carrier_frequency * rate / C
    fast = n * (cells + payload.delay_symbols[..., None])
    return payload.phases[..., None] * np.exp(2j * np.pi * ((fast + (p * bins)[:, None]) % 1.0))


def model_error(velocity: float, modulated: bool, seed: int) -> float:
    """Relative RMS error of the separable model of an echo from 50 m once the best complex factor
    is taken out, one group."""
    w = Waveform(num_groups=1)
    schedule = conventional_schedule(1, w.num_chirps, w.num_tx)
    payload = unmodulated(w)
    if modulated:
        payload = random_payload(w, schedule, 8, generator(seed, "claims", "model"))
    length, rate, arrays = 100.0, 2 * velocity, onepath.antennas(w, 1)
    cube = onepath.frame(w, schedule, payload, arrays, delay=length / C, rate=rate / C)
    exact = cube.samples[:, 0]
    # the paper's range is that at the start of the frame
    paper = separable(w, payload, length - rate * w.frame_duration / 2, rate)
    factor = np.vdot(paper, exact) / np.vdot(paper, paper).real
    return float(np.linalg.norm(exact - factor * paper) / np.linalg.norm(exact))


def model(seed: int) -> tuple[pd.DataFrame, tuple[Verdict, ...]]:
    """How good the approximation after equation (8) is."""
    points = [(v, data) for data in (False, True) for v in (0.0, 0.5, 1.0, 5.0, 15.0)]
    rows = [(v, data, model_error(v, data, seed)) for v, data in points]
    worst = min(e for _, data, e in rows if data)
    text = ", ".join(f"{e:.2g} at {v:g} m/s" for v, data, e in rows if v and not data)
    verdict = say("model", False, text=text, worst=worst)
    return table("velocity_mps data relative_rms_error", rows), (verdict,)


# ---------------------------------------------------------------- intervals of the modulation


def travel_cells(w: Waveform) -> float:
    """Range cells that an echo at the unambiguous velocity moves in a frame: the right side of the
    paper's condition on the interval."""
    return 2 * C / (4 * w.slot_duration * w.carrier_frequency) * w.frame_duration / C / w.delay_step


def tolerated_error(order: int, seed: int, steps: int = 9) -> tuple[float, float]:
    """Velocity error [m/s] up to which a PT decides all DPSK symbols of a noiseless frame, by
    bisection, and the closed form c/(2 p f D) with p the longest time between two chirps of an
    antenna."""
    w = Waveform(num_groups=1)
    rng = generator(seed, "claims", "interval", "schedule")
    schedule = pseudo_random_schedule(1, w.num_chirps, w.num_tx, rng)
    payload = random_payload(w, schedule, order, generator(seed, "claims", "interval", order))
    length, rate, arrays = 43.817, 7.3, onepath.antennas(w, 1)
    cube = onepath.frame(w, schedule, payload, arrays, delay=length / C, rate=rate / C)
    gap = max(int(np.diff(np.flatnonzero(schedule[0] == tx)).max()) for tx in range(w.num_tx))
    limit = C / (2 * gap * w.slot_duration * w.effective_carrier * order)
    low, high = 0.5 * limit, 1.5 * limit
    for _ in range(steps):
        middle = (low + high) / 2
        found = demodulate(cube, prediction(length, rate + middle), order)
        right = (found.transitions == payload.transitions).all()
        low, high = (middle, high) if right else (low, middle)
    return (low + high) / 2, limit


def intervals(seed: int) -> tuple[pd.DataFrame, tuple[Verdict, ...]]:
    """The two conditions on the modulation's intervals."""
    cells = travel_cells(Waveform())
    rows = [(order, *tolerated_error(order, seed)) for order in (2, 4, 8, 16)]
    close = all(abs(measured / formula - 1) < 0.05 for _, measured, formula in rows)
    text = ", ".join(f"{measured:.2f} (formula {formula:.2f})" for _, measured, formula in rows)
    return table("D tolerated_velocity_error_mps formula_mps", rows), (
        say("travel", cells < 1, cells=cells),
        say("phases", False, close, text=text),
    )


# ---------------------------------------------------------------- ambiguities


def unambiguous(num_tx: int, random: bool, seed: int) -> tuple[float, float]:
    """Velocity up to which an echo's spectrum has one answer [m/s], and the error of its peak at
    0.93 of c/(4 T f) [m/s]."""
    w = Waveform(num_groups=1, num_tx=num_tx)
    arrays = Antennas(tx_x=num_tx, tx_z=1, rx_x=1, rx_z=1, spacing=SPACING * w.wavelength)
    schedule = conventional_schedule(1, w.num_chirps, num_tx)
    if random:
        rng = generator(seed, "claims", "ambiguity", num_tx)
        schedule = pseudo_random_schedule(1, w.num_chirps, num_tx, rng)
    velocity, pilot = 0.93 * w.max_velocity(2), unmodulated(w)
    cube = onepath.frame(w, schedule, pilot, arrays, delay=2 * 23.7 / C, rate=2 * velocity / C)
    known = Known.of(cube, pilot, arrays, 2)
    power = accumulate(channel_maps(clean_spectrum(cube, known, 256), known))
    found = fig5.judge("", False, power[power.max(axis=1).argmax()], w)
    return found.unambiguous, float(found.velocity[found.power_db.argmax()] - velocity)


def ambiguities(seed: int) -> tuple[pd.DataFrame, tuple[Verdict, ...]]:
    """Whether the random order multiplies the unambiguous velocity by L_tx, for other L_tx than the
    paper's."""
    rows = []
    for num_tx in (2, 3, 4, 6):
        plain, _ = unambiguous(num_tx, False, seed)
        random, error = unambiguous(num_tx, True, seed)
        rows.append((num_tx, plain, random, random / plain, error))
    exact = all(abs(row[3] - row[0]) < 1e-9 for row in rows)
    text = "; ".join(f"L_tx = {row[0]}: {row[1]:.2f} to {row[2]:.2f} m/s" for row in rows)
    found = table("L_tx conventional_mps pseudo_random_mps ratio error_mps", rows)
    return found, (say("velocity", exact, text=text),)


def kept_chirps(length: float, seed: int) -> tuple[int, int]:
    """Data chirps whose beat of a path of this length stays in the IF band, from the samples'
    power, and all of them."""
    w = Waveform(num_groups=1, num_chirps=1200)
    schedule = conventional_schedule(1, w.num_chirps, w.num_tx)
    payload = random_payload(w, schedule, 8, generator(seed, "claims", "kept"))
    cube = onepath.frame(w, schedule, payload, onepath.antennas(w, 1), delay=length / C)
    return int(((np.abs(cube.samples[0, 0]) ** 2).mean(axis=1) > 0.5).sum()), w.num_chirps


# ---------------------------------------------------------------- angles


def paper_angle(angle: float, elements: int = 16, redundancy: int = 64) -> float:
    """The angle [deg] that the paper's redundant dictionary, exp(-j pi l sin), finds for a wave
    from `angle` [deg]."""
    element, size = np.arange(elements), redundancy * elements
    grid = np.deg2rad((np.arange(size) - size / 2) * 180 / size)
    wave = np.exp(2j * np.pi * SPACING * element * np.sin(np.deg2rad(angle)))
    match = np.abs(np.exp(-1j * np.pi * np.outer(np.sin(grid), element)) @ wave)
    return float(np.rad2deg(grid[match.argmax()]))


def departure_answers(sine: float = 0.137) -> int:
    """Angles of departure within the field of view that two transmit elements 8 spacings apart
    cannot tell from `sine`."""
    answers = sine + 1 / (8 * SPACING) * np.arange(-40, 41)
    return int((np.abs(answers) <= np.sin(np.pi / 3)).sum())


def angles() -> tuple[pd.DataFrame, tuple[Verdict, ...]]:
    """The paper's dictionaries against the paper's own array."""
    rows = [(a, paper_angle(a)) for a in (10.0, 20.0, 45.0, 59.0)]
    text = ", ".join(f"{a:.0f} to {found:.1f}" for a, found in rows)
    w = Waveform()
    aperture = 15 * SPACING * w.wavelength
    return table("angle_deg paper_deg", rows), (
        say("dictionary", False, spacing=SPACING, text=text),
        say("departure", False, apart=8 * SPACING, answers=departure_answers()),
        say("far", True, far=2 * aperture**2 / w.wavelength, aperture=aperture * 1e3),
    )


# ---------------------------------------------------------------- a late clock


def late_frames(offset: float, snr_db: float, frames: int, seed: int) -> tuple[float, np.ndarray]:
    """Acquisition from an unmodulated frame and data frames under a constant clock offset [s].

    Returns
    -------
    bias : of the acquired range [m], NaN where nothing was found (then the data are read with the
        true sum of path and clock)
    symbols : delay errors and symbols, DPSK errors and symbols, all of them decided
    """
    w = Waveform()
    arrays, rng = onepath.antennas(w, 4), generator(seed, "claims", "late")
    schedule = pseudo_random_schedule(w.num_groups, w.num_chirps, w.num_tx, rng)
    length, rate = 43.817, 3.7
    received = partial(onepath.frame, w, schedule, arrays=arrays, delay=length / C, rate=rate / C)
    pilot = received(unmodulated(w), clock_offset=offset)
    onepath.noisy(pilot, 10.0, seed, "late", "pilot")
    found = receive_passive(pilot, arrays, Receivers(), 8, None, False).detections
    i = np.flatnonzero(found.is_reference)
    known = prediction(length + offset * C, rate)
    if i.size:
        known = prediction(float(found.range[i[0]]), float(found.velocity[i[0]]))
    count = np.zeros(4, int)
    for k in range(frames):
        payload = random_payload(w, schedule, 8, generator(seed, "claims", "late", k))
        cube = received(payload, clock_offset=offset)
        onepath.noisy(cube, snr_db, seed, "late", k)
        got = demodulate(cube, known, 8)
        pairs = (payload.delay_symbols, got.delay), (payload.transitions, got.transitions)
        for at, (sent, decided) in enumerate(pairs):
            count[2 * at : 2 * at + 2] += (sent != decided).sum(), sent.size
    return float(found.range[i[0]]) - length if i.size else float("nan"), count


OFFSETS = (0.0, 53e-9, 307e-9, 641e-9)
"""Clock offsets [s]: none, and three that keep path and clock together below half of the range."""
TOO_LATE = 1.19e-6
"""One that does not [s]."""
LATE_SNR = -25.0
"""With 7 receive antennas: some symbols fail, so that a difference could be seen."""


def late_clock(
    quick: bool, seed: int, report: Progress
) -> tuple[pd.DataFrame, tuple[Verdict, ...]]:
    """What a constant delay of the clocks does to range and to data."""
    frames, rows = 3 if quick else 16, []
    for k, offset in enumerate((*OFFSETS, TOO_LATE)):
        bias, counts = late_frames(offset, LATE_SNR, frames, seed)
        rows.append((offset * 1e9, bias, offset * C, *counts))
        report(k + 1, len(OFFSETS) + 1)
    symbols = "delay_errors delay_symbols dpsk_errors dpsk_symbols"
    found = table(f"clock_offset_ns range_bias_m expected_bias_m {symbols}", rows)
    inside = found.iloc[: len(OFFSETS)]
    biased = float(np.abs(inside.range_bias_m - inside.expected_bias_m).max())

    def rates(part: Iterable) -> str:
        return "; ".join(
            f"{r[0]:.0f} ns: delay {proportion(*r[3:5])}, DPSK {proportion(*r[5:])}" for r in part
        )

    same = True
    # each rate within four deviations of that without an offset, both being random
    for kind in ("delay", "dpsk"):
        p = inside[f"{kind}_errors"] / inside[f"{kind}_symbols"]
        spread = np.sqrt(2 * p.mean() * (1 - p.mean()) / inside[f"{kind}_symbols"].iloc[0])
        same &= bool((np.abs(p - p.iloc[0]) <= 4 * spread).all())
    fields = {"inside": rates(rows[: len(OFFSETS)]), "beyond": rates(rows[len(OFFSETS) :])}
    return found, (
        say("late", False, biased < 0.05 and same, bias=biased * 1e3, snr=LATE_SNR, **fields),
    )


def beyond_half(seed: int) -> Verdict:
    """Data and range share the band."""
    inside, outside = kept_chirps(2 * 120.0, seed), kept_chirps(2 * 200.0, seed)
    texts = {"inside": proportion(*inside), "outside": proportion(*outside)}
    good = inside[0] == inside[1] and outside[0] < outside[1]
    return say("half", good, half=Waveform().max_delay * C / 4, **texts)
