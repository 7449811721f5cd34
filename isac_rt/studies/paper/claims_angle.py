"""Claims on antennas: the virtual array, angles of moving targets, DPSK antenna by antenna."""

from __future__ import annotations

import numpy as np
import pandas as pd

from isac_rt.frame.antennas import Antennas, unit_vector
from isac_rt.frame.cube import IFCube, Transmission
from isac_rt.frame.payload import Payload, random_payload
from isac_rt.frame.schedule import Schedule, conventional_schedule, pseudo_random_schedule
from isac_rt.frame.waveform import SPEED_OF_LIGHT as C
from isac_rt.frame.waveform import Waveform
from isac_rt.propagation.pathset import PathKind, make_paths
from isac_rt.randomness import generator, seed_sequence
from isac_rt.receive import receive_active
from isac_rt.receive.symbols.powers import demodulate
from isac_rt.results.metrics import resolutions
from isac_rt.scenario.receivers import Receivers
from isac_rt.signal.if_signal import add_noise, if_signal
from isac_rt.studies.paper import onepath
from isac_rt.studies.paper.claims_signal import SPACING, prediction
from isac_rt.studies.paper.outcome import Progress, Verdict, proportion
from isac_rt.world.swarm import Pose

STILL = Pose.at_rest()
SNR_DB = 0.0
CLOSE = 0.1
"""Share of a resolution within which a direction must be found: an alias of the velocity turns the
transmit elements by a third of a cycle, which shifts the beam by less than a resolution."""


def virtual(arrays: Antennas) -> tuple[int, int]:
    """Elements and virtual places along the X arm, the latter only if they are gapless (else 0)."""
    places = np.unique(
        np.round(
            (
                arrays.tx_positions[: arrays.tx_x, None, 0]
                + arrays.rx_positions[None, : arrays.rx_x, 0]
            )
            / arrays.spacing,
            6,
        )
    )
    gapless = bool(np.allclose(np.diff(places), 1, rtol=0, atol=1e-5))
    return arrays.num_tx + arrays.num_rx, places.size if gapless else 0


def frame(
    w: Waveform,
    schedule: Schedule,
    payload: Payload,
    arrays: Antennas,
    length: float,
    rate: float,
    departure: np.ndarray,
    arrival: np.ndarray,
    seed: int,
    *purpose: str | int,
) -> IFCube:
    """IF samples of a plane wave of unit amplitude from and to any direction, at `SNR_DB`."""
    path = make_paths(
        gain=np.ones(1),
        delay=np.array([length / C]),
        delay_rate=rate / C,
        departure=departure[None],
        arrival=arrival[None],
        kind=int(PathKind.LINE_OF_SIGHT),
        epoch=w.frame_duration / 2,
        tx="sender",
        rx="receiver",
    )
    sent = Transmission(
        name="sender", pose=STILL, antennas=arrays, schedule=schedule, payload=payload
    )
    cube = if_signal(
        w,
        [(sent, path)],
        STILL,
        arrays,
        start_time=0.0,
    )
    return add_noise(
        cube, 10 ** (-SNR_DB / 10), seed_sequence(seed, "claims", *purpose).generate_state(2)
    )


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
        cube = frame(
            w, schedule, payload, arrays, 2 * 31.7, 2 * speed, u, u, seed, "angle", scheme, k
        )
        found = receive_active(cube, payload, arrays, Receivers()).detections
        if len(found):
            i = int(found.snr.argmax())
            angles += int((np.abs(found.direction[i] - u[[0, 2]]) < CLOSE * cell[2:]).all())
            velocities += int(abs(found.velocity[i] - speed) < cell[1])
    return angles, velocities


def spatial_slips(order: int, pairs: int, seed: int) -> int:
    """Of DPSK transitions that run from slot to slot, those that the way from one antenna to the
    other would turn by half a symbol."""
    w, rng = Waveform(), generator(seed, "claims", "slips", order)
    arrays, wrong = onepath.antennas(w, 8), 0
    for _ in range(pairs):
        one, other = rng.choice(w.num_tx, 2, replace=False)
        turn = (
            w.effective_carrier
            / C
            * float((arrays.tx_positions[one] - arrays.tx_positions[other]) @ direction(rng))
        )
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
        cube = frame(
            w,
            schedule,
            payload,
            arrays,
            43.817,
            -5.3,
            direction(rng),
            direction(rng),
            seed,
            "order",
            k,
        )
        got = demodulate(cube, prediction(43.817, -5.3), 8)
        wrong, total = (
            wrong + int((got.transitions != payload.transitions).sum()),
            total + payload.transitions.size,
        )
    return wrong, total


def antennas(quick: bool, seed: int, report: Progress) -> tuple[pd.DataFrame, tuple[Verdict, ...]]:
    """All of them."""
    targets, frames, pairs = (12, 6, 2000) if quick else (100, 50, 20_000)
    rows = []
    for i, scheme in enumerate("abd"):
        angles, velocities = angle_hits(scheme, targets, seed)
        rows.append(
            {
                "scheme": scheme,
                "angles_found": angles,
                "velocities_found": velocities,
                "targets": targets,
            }
        )
        report(i + 1, 4)
    table = pd.DataFrame(rows).set_index("scheme", drop=False)
    order, slips = antenna_order(frames, seed), spatial_slips(8, pairs, seed)
    report(4, 4)
    w = Waveform()
    count, places = virtual(
        Antennas(tx_x=2, tx_z=2, rx_x=8, rx_z=8, spacing=SPACING * w.wavelength)
    )
    text = "; ".join(
        f"({r.scheme}) direction {proportion(r.angles_found, r.targets)}, velocity "
        f"{proportion(r.velocities_found, r.targets)}"
        for r in table.itertuples()
    )
    better = table.angles_found["b"] == targets and table.angles_found["a"] < targets
    return table, (
        Verdict(
            "The L-shaped arrays reach the aperture of a planar array with fewer elements",
            "holds" if places == 16 else "does not hold",
            f"{count} elements make gapless virtual arms of {places} places each; a planar array "
            f"of that aperture has {places**2}. Two "
            "targets in one cell are told apart on each axis alone, and not paired",
        ),
        Verdict(
            "Random order and CS remove the phase errors that motion causes in the angles",
            "holds" if better else "does not hold",
            f"targets at 0.5 to 0.9 of c/(4 T- f), {SNR_DB:g} dB, direction within {CLOSE:g} and "
            f"velocity within one resolution in the schemes of Fig. 5: {text}",
        ),
        Verdict(
            "Differential modulation antenna by antenna needs no compensation of directions",
            "holds" if order[0] == 0 else "does not hold",
            f"D = 8, random directions, {SNR_DB:g} dB: wrong in {proportion(*order)}; from slot "
            f"to slot the change of antenna alone would spoil {proportion(slips, pairs)}",
        ),
    )
