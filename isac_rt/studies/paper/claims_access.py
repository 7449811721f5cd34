"""Claims on sharing the band: isolation of blocks, timing errors, several active terminals,
streams, stages before the data, feedback."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from scipy import stats

from isac_rt.access import Clock, Network, correct, establish, isolation, summarise
from isac_rt.access.feedback import frames_to_repair
from isac_rt.frame.antennas import Antennas
from isac_rt.frame.cube import Transmission
from isac_rt.frame.payload import random_payload
from isac_rt.frame.schedule import pseudo_random_schedule
from isac_rt.frame.waveform import SPEED_OF_LIGHT as C
from isac_rt.frame.waveform import Waveform
from isac_rt.propagation.pathset import PathKind, PathSet, make_paths
from isac_rt.randomness import generator, seed_sequence
from isac_rt.receive import Reception, receive_passive
from isac_rt.results.metrics import SymbolCount, count_symbols
from isac_rt.scenario.receivers import Receivers
from isac_rt.signal.if_signal import add_noise, if_signal
from isac_rt.studies.paper import onepath
from isac_rt.studies.paper.claims_signal import prediction
from isac_rt.studies.paper.outcome import Progress, Verdict, proportion
from isac_rt.world.swarm import Pose

STILL = Pose.at_rest()
KEPT_DB = 20.0
"""A neighbour this far down counts as kept out."""


def path(w: Waveform, length: float, rate: float, gain: float = 1.0) -> PathSet:
    """A line of sight as a plane wave on boresight."""
    ahead = np.array([[0.0, 1.0, 0.0]])
    return make_paths(
        gain=np.array([gain]),
        delay=np.array([length / C]),
        delay_rate=rate / C,
        departure=ahead,
        arrival=ahead,
        kind=int(PathKind.LINE_OF_SIGHT),
        epoch=w.frame_duration / 2,
        tx="sender",
        rx="receiver",
    )


# ---------------------------------------------------------------- isolation


def blocks(quick: bool, seed: int) -> tuple[pd.DataFrame, tuple[Verdict, ...]]:
    """Isolation against the spacing of the blocks, mean over sets of chirps with its 95 %
    interval."""
    w, sets, rows = Waveform(), 3 if quick else 12, []
    for spacing in (-3, -2, -1, 1, 2, 3):
        every = [
            isolation(
                w,
                spacing,
                0.0,
                generator(seed, "claims", "blocks", spacing + 9, k),
                chirps=6,
            )
            for k in range(sets)
        ]
        power, peak = np.array([x.power_db for x in every]), np.array([x.peak_db for x in every])
        half = stats.t.ppf(0.975, sets - 1) / np.sqrt(sets)
        rows.append(
            {
                "spacing_blocks": spacing,
                "power_db": power.mean(),
                "power_ci_db": half * power.std(ddof=1),
                "peak_db": peak.mean(),
                "peak_ci_db": half * peak.std(ddof=1),
                "worst_power_db": power.min(),
            }
        )
    table = pd.DataFrame(rows)
    text = ", ".join(
        f"{r.spacing_blocks:+d}: {r.power_db:.1f} +- {r.power_ci_db:.1f} dB"
        for r in table.itertuples()
    )
    return table, (
        Verdict(
            "Blocks 2 T_d apart do not interfere once low-pass filtered",
            "holds" if table.power_db.min() > 40 else "does not hold",
            "power of a neighbour with data after mixing and filtering, below that of the same "
            f"block, by spacing: {text}; at least {table.peak_db.min():.0f} dB in the strongest "
            "cell of a Hann-windowed range spectrum. What is left lies at the edges of the chirps",
        ),
        Verdict(
            "A slot holds floor(T/2T_d) resource blocks",
            "holds",
            f"{w.num_resource_blocks}, enough for {w.num_resource_blocks // 3} "
            "active terminals of 3 groups",
        ),
    )


def tolerance(quick: bool, seed: int) -> tuple[pd.DataFrame, tuple[Verdict, ...]]:
    """Isolation of both neighbours against their timing error, for short and long delays."""
    w, rows = Waveform(), []
    grid = np.linspace(-2.125, 0.375, 21 if quick else 51)
    for spacing in (1, -1):
        for cells in (8.3, 511.7, 1015.3):
            for k, error in enumerate(spacing * grid):
                got = isolation(
                    w,
                    spacing,
                    float(error) * w.max_delay,
                    generator(seed, "claims", "tolerance", k),
                    chirps=1,
                    path_cells=cells,
                    modulated=False,
                    oversampling=32,
                )
                rows.append(
                    {
                        "spacing_blocks": spacing,
                        "delay_cells": cells,
                        "error_T_d": error,
                        "power_db": got.power_db,
                    }
                )
    table = pd.DataFrame(rows)
    heard = table[table.power_db < KEPT_DB]
    early = {
        c: heard[(heard.spacing_blocks == 1) & (heard.delay_cells == c)].error_T_d.max()
        for c in table.delay_cells.unique()
    }
    late = {
        c: heard[(heard.spacing_blocks == -1) & (heard.delay_cells == c)].error_T_d.min()
        for c in table.delay_cells.unique()
    }
    texts = [", ".join(f"{e:+.2f}" for e in limits.values()) for limits in (early, late)]
    return table, (
        Verdict(
            "The interval of 2 T_d tolerates synchronisation errors",
            "holds under a condition",
            f"a terminal of the next block is received from an error of {texts[0]} T_d on when "
            f"its data and path delays together are {', '.join(f'{c:.0f}' for c in early)} cells "
            f"of {w.num_samples}, one of the block before from {texts[1]} T_d on (isolation below "
            f"{KEPT_DB:.0f} dB; steps of {grid[1] - grid[0]:.3f} T_d): towards each other T_d "
            "plus the delay and 2 T_d less the delay, so T_d for sure and not 2 T_d; away from "
            "each other any error until the next occupied block",
        ),
    )


# ---------------------------------------------------------------- several terminals and streams


def _antennas(w: Waveform) -> Antennas:
    return onepath.antennas(w, 4)


def crowd(
    first_blocks: Mapping[int, float], frames: int, snr_db: float, seed: int, purpose: str
) -> SymbolCount:
    """Symbols of a terminal in blocks 0 to 2 beside others, {first block: level in dB over it}, by
    the whole passive receiver."""
    w, total = Waveform(num_chirps=30), SymbolCount()
    arrays = _antennas(w)
    for k in range(frames):
        rng = generator(seed, "claims", "crowd", purpose, k)
        schedule = pseudo_random_schedule(w.num_groups, w.num_chirps, w.num_tx, rng)
        links = []
        for i, (block, level) in enumerate([(0, 0.0), *first_blocks.items()]):
            length, rate = (
                (43.817, -5.3) if i == 0 else (rng.uniform(10, 120), rng.uniform(-12, 12))
            )
            sent = Transmission(
                name=f"AT{i}",
                pose=STILL,
                antennas=arrays,
                schedule=schedule,
                first_block=block,
                payload=random_payload(w, schedule, 8, rng),
            )
            links.append((sent, path(w, length, rate, 10 ** (level / 20))))
        cube = if_signal(w, links, STILL, arrays, start_time=0.0, method="direct")
        add_noise(
            cube,
            10 ** (-snr_db / 10),
            seed_sequence(seed, "claims", "crowd", purpose, "noise", k).generate_state(2),
        )
        got = receive_passive(cube, arrays, Receivers(), 8, prediction(43.817, -5.3), True)
        total += count_symbols(links[0][0].payload, got)
    return total


def _rates(n: SymbolCount) -> str:
    return (
        f"delay {proportion(n.delay_errors, n.delay_total)}, DPSK "
        f"{proportion(n.dpsk_errors, n.dpsk_total)}"
    )


def sharing(quick: bool, seed: int, report: Progress) -> tuple[pd.DataFrame, tuple[Verdict, ...]]:
    """Six active terminals at once, and two in the same blocks."""
    frames, snr = (4, -5.0) if quick else (24, -5.0)
    blocks_of_others = (3, 6, 9, 12, 15)
    cases: dict[str, dict[int, float]] = {
        "alone": {},
        "five others, equal": dict.fromkeys(blocks_of_others, 0.0),
        "five others, +30 dB": dict.fromkeys(blocks_of_others, 30.0),
        "same blocks, -6 dB": {0: -6.0},
        "same blocks, +6 dB": {0: 6.0},
    }
    found = {}
    for i, (name, others) in enumerate(cases.items()):
        # the same noise, schedule and data in all cases
        found[name] = crowd(others, frames, snr, seed, "sharing")
        report(i + 1, len(cases))
    rows = [
        {
            "case": name,
            "delay_errors": n.delay_errors,
            "delay_symbols": n.delay_total,
            "dpsk_errors": n.dpsk_errors,
            "dpsk_symbols": n.dpsk_total,
        }
        for name, n in found.items()
    ]
    clean = found["five others, +30 dB"].delay_errors == 0
    return pd.DataFrame(rows), (
        Verdict(
            "Several ATs use the band at once without interference",
            "holds under a condition" if clean else "does not hold",
            f"SER at {snr:g} dB, 7 receive antennas: "
            + "; ".join(f"{name}: {_rates(n)}" for name, n in found.items())
            + "; blocks must differ: in one block the stronger terminal takes the symbols",
        ),
    )


STREAMS = {"PT1": ((0,), 41.317, 6.2), "PT2": ((1, 2), 67.713, -3.9)}
"""Groups, length [m] and rate [m/s] of the users' lines of sight."""


def streams(quick: bool, seed: int, report: Progress) -> tuple[pd.DataFrame, tuple[Verdict, ...]]:
    """Groups assigned to different passive terminals: rate and symbol error rate of each user and
    of one user with all groups."""
    w, frames = Waveform(), 2 if quick else 16
    arrays, users = _antennas(w), {**STREAMS, "one user": ((0, 1, 2), 41.317, 6.2)}
    schedule = pseudo_random_schedule(
        w.num_groups, w.num_chirps, w.num_tx, generator(seed, "claims", "streams")
    )
    levels = (10.0, -22.0)
    counts = {(name, snr): SymbolCount() for name in users for snr in levels}
    for k in range(frames):
        payload = random_payload(w, schedule, 8, generator(seed, "claims", "streams", k))
        for name, (groups, length, rate) in users.items():
            for snr in levels:
                cube = onepath.frame(
                    w,
                    schedule,
                    payload,
                    arrays,
                    delay=length / C,
                    rate=rate / C,
                    snr_db=snr,
                    seed=seed,
                    purpose=("streams", name, k),
                )
                got = receive_passive(
                    cube, arrays, Receivers(), 8, prediction(length, rate), True, groups=groups
                )
                counts[name, snr] += count_symbols(payload, got, groups)
        report(k + 1, frames)
    rows = []
    for (name, snr), n in counts.items():
        rows.append(
            {
                "user": name,
                "groups": " ".join(map(str, users[name][0])),
                "snr_db": snr,
                "rate_kbps": n.bits_total / n.frames / w.frame_duration / 1e3,
                "delay_errors": n.delay_errors,
                "delay_symbols": n.delay_total,
                "dpsk_errors": n.dpsk_errors,
                "dpsk_symbols": n.dpsk_total,
                "bit_errors": n.bit_errors,
                "bits": n.bits_total,
            }
        )
    table = pd.DataFrame(rows)
    high = table[table.snr_db == levels[0]].set_index("user")
    split = abs(high.rate_kbps["PT1"] + high.rate_kbps["PT2"] - high.rate_kbps["one user"]) < 1e-9
    text = "; ".join(
        f"{name} (groups {users[name][0]}) {high.rate_kbps[name]:.1f} kbit/s, {snr:g} dB: "
        f"{_rates(n)}"
        for (name, snr), n in counts.items()
    )
    return table, (
        Verdict(
            "Groups serve several PTs at once (multi-stream)",
            "holds" if split and high.delay_errors.sum() == 0 else "does not hold",
            f"{text}; the users' rates add up to one user's",
        ),
    )


# ---------------------------------------------------------------- the stages before the data


def _network(seed: int, snr_db: float) -> tuple[Network, dict[str, Clock]]:
    """One active and two passive terminals on random straight courses, clocks within 80 ns and 0.01
    ppm."""
    w, rng = Waveform(num_chirps=60), generator(seed, "claims", "stages")
    place = {name: rng.uniform([-40, -20, 20], [40, 60, 40]) for name in ("A", "P", "Q")}
    speed = {name: rng.uniform(-6, 6, 3) for name in place}

    def scene(
        time: float, links: Sequence[tuple[str, str]]
    ) -> tuple[dict[str, Pose], dict[tuple[str, str], PathSet]]:
        poses = {
            name: Pose(place[name] + time * speed[name], speed[name], np.zeros(3), np.eye(3))
            for name in place
        }
        paths = {}
        for tx, rx in links:
            away = poses[rx].position - poses[tx].position
            length = float(np.linalg.norm(away))
            direction = (away / length)[None]
            paths[tx, rx] = make_paths(
                gain=np.ones(1),
                delay=np.array([length / C]),
                delay_rate=float(direction[0] @ (speed[rx] - speed[tx])) / C,
                departure=direction,
                arrival=-direction,
                tx_radius=length,
                rx_radius=length,
                kind=int(PathKind.LINE_OF_SIGHT),
                epoch=time,
                tx=tx,
                rx=rx,
            )
        return poses, paths

    clocks = {name: Clock(rng.uniform(-80e-9, 80e-9), rng.uniform(-1e-8, 1e-8)) for name in place}
    arrays = Antennas(tx_x=2, tx_z=2, rx_x=2, rx_z=2, spacing=0.5774 * w.wavelength)
    schedule = pseudo_random_schedule(w.num_groups, w.num_chirps, w.num_tx, rng)
    net = Network(
        waveform=w,
        antennas=arrays,
        schedule=schedule,
        receivers=Receivers(),
        scene=scene,
        wishes={"A": int(rng.integers(0, 17))},
        listeners={"A": ("P", "Q")},
        noise_power=dict.fromkeys(place, 10 ** (-snr_db / 10)),
        clocks=clocks,
        seed=seed,
    )
    return net, clocks


def stages(quick: bool, seed: int, report: Progress) -> tuple[pd.DataFrame, tuple[Verdict, ...]]:
    """Announcement, two rounds and acknowledgment of random networks."""
    networks, snr = (3 if quick else 16), -6.0
    rows = []
    for k in range(networks):
        net, clocks = _network(seed + k, snr)
        got = establish(net)
        for (at, pt), link in got.links.items():
            row = {
                "network": k,
                "link": f"{at}->{pt}",
                "identified": link.identified,
                "acknowledged": link.acknowledged,
            }
            offset = drift = float("nan")
            if link.clock is not None:
                offset = (
                    link.clock.offset
                    - clocks[at].late(link.clock.time)
                    + clocks[pt].late(link.clock.time)
                )
                drift = link.clock.drift - clocks[at].drift + clocks[pt].drift
            rows.append(row | {"offset_error_ns": offset * 1e9, "drift_error_ppb": drift * 1e9})
        report(k + 1, networks)
    table = pd.DataFrame(rows)
    known = table[table.offset_error_ns.notna()]
    rms = [
        float(np.sqrt((known[name] ** 2).mean())) for name in ("offset_error_ns", "drift_error_ppb")
    ]
    heard, total = int(table.identified.sum()), len(table)
    return table, (
        Verdict(
            "PTs learn the AT's blocks from on-off keyed chirps and acknowledge the same way",
            "holds" if heard == total else "holds under a condition",
            f"at {snr:g} dB per sample and 3 receive antennas announcements understood: "
            f"{proportion(heard, total)}, acknowledged: "
            f"{proportion(int(table.acknowledged.sum()), total)}",
        ),
        Verdict(
            "Two rounds of estimation give the synchronisation delay",
            "holds under a condition",
            f"clocks known in {proportion(len(known), total)} links, offset to {rms[0]:.3f} ns "
            f"({rms[0] * 0.2998:.3f} m) and drift to {rms[1]:.3f} ppb RMS; the rounds must be "
            "solved for motion and drift too: 0.01 ppm alone looks like 3 m/s",
        ),
    )


# ---------------------------------------------------------------- feedback


def feedback(quick: bool, seed: int, report: Progress) -> tuple[pd.DataFrame, tuple[Verdict, ...]]:
    """Whole-cell slips planted at a passive terminal: what the data suffer and how often one
    feedback undoes them."""
    w, tries = Waveform(num_samples=256, num_chirps=60), 8 if quick else 64
    arrays, cell, rows = _antennas(w), w.range_cell(1), []
    length, rate, echo_std = 21.317, -3.1, 0.09
    slips = (-3, -1, 1, 3)
    for s, slip in enumerate(slips):
        wrong = symbols = repaired = 0
        for k in range(tries):
            rng = generator(seed, "claims", "feedback", s, k)
            schedule = pseudo_random_schedule(w.num_groups, w.num_chirps, w.num_tx, rng)
            payload = random_payload(w, schedule, 8, rng)
            cube = onepath.frame(
                w,
                schedule,
                payload,
                arrays,
                delay=length / C,
                rate=rate / C,
                snr_db=0.0,
                seed=seed,
                purpose=("feedback", s, k),
            )
            got: Reception = receive_passive(
                cube, arrays, Receivers(), 8, prediction(length + slip * cell, rate), True
            )
            said = summarise(got, length + slip * cell, 0.02, arrays.num_rx, w)
            answer = correct(said, length + echo_std * rng.standard_normal(), echo_std, 0.0, w)
            wrong, symbols = (
                wrong + int((got.delay_symbols != payload.delay_symbols).sum()),
                symbols + payload.delay_symbols.size,
            )
            repaired += int(answer.sure and answer.cells == slip)
        rows.append(
            {
                "slip_cells": slip,
                "delay_errors": wrong,
                "delay_symbols": symbols,
                "repaired": repaired,
                "feedbacks": tries,
            }
        )
        report(s + 1, len(slips))
    table = pd.DataFrame(rows)
    good, total = int(table.repaired.sum()), int(table.feedbacks.sum())
    paper = Waveform()
    bits = paper.bits_per_delay_symbol * paper.num_groups * paper.num_chirps
    suffered = proportion(int(table.delay_errors.sum()), int(table.delay_symbols.sum()))
    return table, (
        Verdict(
            "Periodic feedback corrects errors",
            "holds under a condition" if good else "does not hold",
            f"a slip of 1 or 3 cells makes delay symbols wrong in {suffered}; one feedback undoes "
            f"it in {proportion(good, total)}, the AT's echo being known to {echo_std:g} m "
            f"({echo_std / cell:.2f} cells; worse than half a cell it cannot tell). With feedback "
            f"every 4 frames a slip costs {frames_to_repair(3, 4)} to {frames_to_repair(0, 4)} "
            f"frames of {bits} delay bits",
        ),
    )


def draw(ax: Axes, table: pd.DataFrame) -> None:
    """Isolation against timing error."""
    for i, ((spacing, cells), part) in enumerate(
        table.groupby(["spacing_blocks", "delay_cells"], sort=False)
    ):
        ax.plot(
            part.error_T_d,
            part.power_db,
            "-" if spacing == 1 else "--",
            color=f"C{i % 3}",
            label=f"{'next' if spacing == 1 else 'previous'} block, delay {cells:.0f} cells",
        )
    ax.axvspan(-1, 1, color="#009E73", alpha=0.12, lw=0)
    ax.set(
        xlabel="timing error [T_d], late is positive",
        ylabel="isolation [dB]",
        title="Chirp-DMA (green: tolerated for any delay)",
    )
    ax.legend(fontsize=5.8, loc="lower center")
