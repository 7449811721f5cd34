"""Claims on antennas: the virtual array, angles of moving targets, DPSK antenna by antenna."""

from __future__ import annotations

import numpy as np
import pandas as pd

from isac_rt.frame.antennas import Antennas, resolutions, unit_vector
from isac_rt.frame.cube import IFCube
from isac_rt.frame.payload import Payload, random_payload
from isac_rt.frame.schedule import Schedule, conventional_schedule, pseudo_random_schedule
from isac_rt.frame.waveform import SPEED_OF_LIGHT as C
from isac_rt.frame.waveform import Waveform
from isac_rt.randomness import generator
from isac_rt.receive.active import receive_active
from isac_rt.receive.settings import Receivers
from isac_rt.receive.symbols import demodulate
from reproduce import onepath
from reproduce.outcome import Progress, Sentences, Verdict, proportion, table
from reproduce.waves import prediction

SNR_DB = 0.0
CLOSE = 0.1
"""Share of a resolution within which a direction must be found: an alias of the velocity turns the
transmit elements by a third of a cycle, which shifts the beam by less than a resolution."""

say = Sentences("""
virtual: The L-shaped arrays reach the aperture of a planar array with fewer elements
  {count} elements make gapless virtual arms of {places} places each; a planar array of that
  aperture has {planar}. Two targets in one cell are told apart on each axis alone, and not paired

random: Random order and CS remove the phase errors that motion causes in the angles
  targets at 0.5 to 0.9 of c/(4 T- f), {snr:g} dB, direction within {close:g} and velocity within
  one resolution in the schemes of Fig. 5: {text}

order: Differential modulation antenna by antenna needs no compensation of directions
  D = 8, random directions, {snr:g} dB: wrong in {wrong}; from slot to slot the change of antenna
  alone would spoil {spoilt}
""")


def virtual(arrays: Antennas) -> tuple[int, int]:
    """Elements and virtual places along the X arm, the latter only if they are gapless (else 0)."""
    sent, heard = arrays.tx_positions[: arrays.tx_x, 0], arrays.rx_positions[: arrays.rx_x, 0]
    places = np.unique(np.round((sent[:, None] + heard) / arrays.spacing, 6))
    gapless = bool(np.allclose(np.diff(places), 1, rtol=0, atol=1e-5))
    return arrays.num_tx + arrays.num_rx, places.size if gapless else 0


def noisy_frame(
    w: Waveform,
    schedule: Schedule,
    payload: Payload,
    arrays: Antennas,
    path: tuple[float, float, np.ndarray, np.ndarray],
    key: tuple[str | int, ...],
) -> IFCube:
    """IF samples of a plane wave of unit amplitude (length, rate, departure, arrival) at `SNR_DB`;
    `key` of the noise: seed and purpose."""
    length, rate, *ends = path
    delay = {"delay": length / C, "rate": rate / C}
    cube = onepath.frame(w, schedule, payload, arrays, **delay, ends=(ends[0], ends[1]))
    return onepath.noisy(cube, SNR_DB, int(key[0]), "claims", *key[1:])


def direction(rng: np.random.Generator) -> np.ndarray:
    """A unit vector whose two direction cosines are uniform over +-0.6."""
    return unit_vector(rng.uniform(-0.6, 0.6, 2))


def angle_hits(scheme: str, targets: int, seed: int) -> tuple[int, int]:
    """Targets whose direction is found within `CLOSE` of a resolution, and whose velocity is within
    one, at 0.5 to 0.9 of c/(4 T- f).

    Schemes as in Fig. 5: a, b with one group, d with three; the receiver chooses its method by the
    schedule.
    """
    w = Waveform(num_groups=3 if scheme == "d" else 1)
    arrays, angles, velocities = onepath.antennas(w, 4), 0, 0
    cell = resolutions(w, arrays, 2)
    for k in range(targets):
        rng = generator(seed, "claims", "angle", k)
        u, speed = direction(rng), rng.uniform(0.5, 0.9) * rng.choice([-1, 1]) * w.max_velocity(2)
        shape = (w.num_groups, w.num_chirps, w.num_tx)
        schedule = (
            conventional_schedule(*shape) if scheme == "a" else pseudo_random_schedule(*shape, rng)
        )
        payload = random_payload(w, schedule, 8, rng)
        path = 2 * 31.7, 2 * speed, u, u
        cube = noisy_frame(w, schedule, payload, arrays, path, (seed, "angle", scheme, k))
        found = receive_active(cube, payload, arrays, Receivers()).detections
        if len(found):
            i = int(found.snr.argmax())
            angles += int((np.abs(found.direction[i] - u[[0, 2]]) < CLOSE * cell[2:]).all())
            velocities += int(abs(found.velocity[i] - speed) < cell[1])
    return angles, velocities


def spatial_slips(order: int, pairs: int, seed: int) -> int:
    """DPSK transitions from slot to slot, out of `pairs`, that the way from one antenna to the
    other would turn by half a symbol."""
    w, rng = Waveform(), generator(seed, "claims", "slips", order)
    places, wrong = onepath.antennas(w, 8).tx_positions, 0
    for _ in range(pairs):
        one, other = rng.choice(w.num_tx, 2, replace=False)
        turn = w.effective_carrier / C * float((places[one] - places[other]) @ direction(rng))
        wrong += int(abs((turn + 0.5) % 1.0 - 0.5) > 0.5 / order)
    return wrong


def antenna_order(frames: int, seed: int) -> tuple[int, int]:
    """DPSK errors and symbols of a PT in random directions, antenna by antenna, D = 8."""
    w = Waveform(num_groups=1)
    arrays, wrong, total = onepath.antennas(w, 4), 0, 0
    for k in range(frames):
        rng = generator(seed, "claims", "order", k)
        schedule = pseudo_random_schedule(1, w.num_chirps, w.num_tx, rng)
        payload = random_payload(w, schedule, 8, rng)
        path = 43.817, -5.3, direction(rng), direction(rng)
        cube = noisy_frame(w, schedule, payload, arrays, path, (seed, "order", k))
        got = demodulate(cube, prediction(43.817, -5.3), 8)
        wrong += int((got.transitions != payload.transitions).sum())
        total += payload.transitions.size
    return wrong, total


def antennas(quick: bool, seed: int, report: Progress) -> tuple[pd.DataFrame, tuple[Verdict, ...]]:
    """All of them."""
    targets, frames, pairs = (12, 6, 2000) if quick else (100, 50, 20_000)
    rows = []
    for i, scheme in enumerate("abd"):
        rows.append((scheme, *angle_hits(scheme, targets, seed), targets))
        report(i + 1, 4)
    found = table("scheme angles_found velocities_found targets", rows)
    order, slips = antenna_order(frames, seed), spatial_slips(8, pairs, seed)
    report(4, 4)
    count, places = virtual(onepath.antennas(Waveform(), 8))
    text = "; ".join(
        f"({scheme}) direction {proportion(angles, n)}, velocity {proportion(speeds, n)}"
        for scheme, angles, speeds, n in rows
    )
    better = rows[1][1] == targets and rows[0][1] < targets
    wrong, spoilt = proportion(*order), proportion(slips, pairs)
    return found, (
        say("virtual", places == 16, count=count, places=places, planar=places**2),
        say("random", better, snr=SNR_DB, close=CLOSE, text=text),
        say("order", order[0] == 0, snr=SNR_DB, wrong=wrong, spoilt=spoilt),
    )
