"""Claims on sharing the band: isolation of blocks, timing errors, several active terminals,
streams, stages before the data, feedback."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from scipy import stats

from isac_rt.extensions.access.feedback import correct, frames_to_repair, summarise
from isac_rt.extensions.access.protocol import Network, establish
from isac_rt.frame.antennas import Arrays
from isac_rt.frame.clock import Clock
from isac_rt.frame.cube import ReceiveArray, Reference
from isac_rt.frame.link import Link
from isac_rt.frame.payload import random_payload
from isac_rt.frame.schedule import pseudo_random_schedule
from isac_rt.frame.waveform import SPEED_OF_LIGHT as C
from isac_rt.frame.waveform import Waveform
from isac_rt.propagation.pathset import PathSet
from isac_rt.randomness import generator
from isac_rt.receive.passive import receive_passive
from isac_rt.receive.settings import Receivers
from isac_rt.results.metrics import SymbolCount, count_symbols
from isac_rt.signal.if_signal import if_signal
from isac_rt.signal.methods import Direct
from isac_rt.world.swarm import Pose
from reproduce import onepath
from reproduce.dma import isolation
from reproduce.outcome import Progress, Sentences, Verdict, proportion, table
from reproduce.waves import STILL, prediction, sender, waves

KEPT_DB = 20.0
"""A neighbour this far down counts as kept out."""
SYMBOLS = "delay_errors delay_symbols dpsk_errors dpsk_symbols"

say = Sentences("""
blocks: Blocks 2 T_d apart do not interfere once low-pass filtered
  power of a neighbour with data after mixing and filtering, below that of the same block, by
  spacing: {text}; at least {peak:.0f} dB in the strongest cell of a Hann-windowed range spectrum.
  What is left lies at the edges of the chirps

slots: A slot holds floor(T/2T_d) resource blocks
  {blocks}, enough for {terminals} active terminals of 3 groups

tolerance: The interval of 2 T_d tolerates synchronisation errors
  a terminal of the next block is received from an error of {early} T_d on when its data and path
  delays together are {cells} cells of {samples}, one of the block before from {late} T_d on
  (isolation below {kept:.0f} dB; steps of {step:.3f} T_d): towards each other T_d plus the delay
  and 2 T_d less the delay, so T_d for sure and not 2 T_d; away from each other any error until the
  next occupied block

sharing: Several ATs use the band at once without interference
  SER at {snr:g} dB, 7 receive antennas: {text}; blocks must differ: in one block the stronger
  terminal takes the symbols

streams: Groups serve several PTs at once (multi-stream)
  {text}; the users' rates add up to one user's

learn: PTs learn the AT's blocks from on-off keyed chirps and acknowledge the same way
  at {snr:g} dB per sample and 3 receive antennas announcements understood: {heard}, acknowledged:
  {acknowledged}

rounds: Two rounds of estimation give the synchronisation delay
  clocks known in {known} links, offset to {offset:.3f} ns ({metres:.3f} m) and drift to
  {drift:.3f} ppb RMS; the rounds must be solved for motion and drift too: 0.01 ppm alone looks like
  3 m/s

feedback: Periodic feedback corrects errors
  a slip of 1 or 3 cells makes delay symbols wrong in {suffered}; one feedback undoes it in
  {repaired}, the AT's echo being known to {std:g} m ({share:.2f} cells; worse than half a cell it
  cannot tell). With feedback every 4 frames a slip costs {least} to {most} frames of {bits} delay
  bits
""")


# ---------------------------------------------------------------- isolation


def blocks(quick: bool, seed: int) -> tuple[pd.DataFrame, tuple[Verdict, ...]]:
    """Isolation against the spacing of the blocks, mean over sets of chirps with its 95 %
    interval."""
    w, sets, rows = Waveform(), 3 if quick else 12, []
    for spacing in (-3, -2, -1, 1, 2, 3):
        draws = (generator(seed, "claims", "blocks", spacing + 9, k) for k in range(sets))
        every = [isolation(w, spacing, 0.0, rng, chirps=6) for rng in draws]
        power, peak = np.array([(x.power_db, x.peak_db) for x in every]).T
        half = stats.t.ppf(0.975, sets - 1) / np.sqrt(sets)
        spread = half * power.std(ddof=1), half * peak.std(ddof=1)
        rows.append((spacing, power.mean(), spread[0], peak.mean(), spread[1], power.min()))
    columns = "spacing_blocks power_db power_ci_db peak_db peak_ci_db worst_power_db"
    found = table(columns, rows)
    text = ", ".join(f"{r[0]:+d}: {r[1]:.1f} +- {r[2]:.1f} dB" for r in rows)
    count = w.num_resource_blocks
    return found, (
        say("blocks", found.power_db.min() > 40, text=text, peak=found.peak_db.min()),
        say("slots", True, blocks=count, terminals=count // 3),
    )


def tolerance(quick: bool, seed: int) -> tuple[pd.DataFrame, tuple[Verdict, ...]]:
    """Isolation of both neighbours against their timing error, for short and long delays."""
    w, rows = Waveform(), []
    grid = np.linspace(-2.125, 0.375, 21 if quick else 51)
    alike = partial(isolation, chirps=1, modulated=False, oversampling=32)
    for spacing in (1, -1):
        for cells in (8.3, 511.7, 1015.3):
            for k, error in enumerate(spacing * grid):
                rng = generator(seed, "claims", "tolerance", k)
                shift = float(error) * w.max_delay
                got = alike(w, spacing, shift, rng, path_cells=cells)
                rows.append((spacing, cells, error, got.power_db))
    found = table("spacing_blocks delay_cells error_T_d power_db", rows)
    heard = found[found.power_db < KEPT_DB]
    ends = heard.groupby(["spacing_blocks", "delay_cells"]).error_T_d.agg(["max", "min"])
    early, late = (", ".join(f"{e:+.2f}" for e in x) for x in (ends["max"][1], ends["min"][-1]))
    fields = {"early": early, "late": late, "samples": w.num_samples, "kept": KEPT_DB}
    fields |= {"cells": ", ".join(f"{c:.0f}" for c in found.delay_cells.unique())}
    verdict = say("tolerance", False, True, step=grid[1] - grid[0], **fields)
    return found, (verdict,)


# ---------------------------------------------------------------- several terminals and streams


def crowd(
    first_blocks: Mapping[int, float], frames: int, snr_db: float, seed: int, purpose: str
) -> SymbolCount:
    """Symbols of a terminal in blocks 0 to 2 beside others, {first block: level in dB over it}, by
    the whole passive receiver."""
    w, total = Waveform(num_chirps=30), SymbolCount()
    arrays, epoch = onepath.antennas(w, 4), w.frame_duration / 2
    for k in range(frames):
        rng = generator(seed, "claims", "crowd", purpose, k)
        schedule = pseudo_random_schedule(w.num_groups, w.num_chirps, w.num_tx, rng)
        links = []
        for i, (block, level) in enumerate([(0, 0.0), *first_blocks.items()]):
            length, rate = 43.817, -5.3
            if i:
                length, rate = rng.uniform(10, 120), rng.uniform(-12, 12)
            sent = sender(arrays, schedule, random_payload(w, schedule, 8, rng))
            path = waves(epoch, length / C, rate / C, gain=10 ** (level / 20))
            links.append((replace(sent, name=f"AT{i}", first_block=block), path))
        cube = if_signal(w, links, ReceiveArray(STILL, arrays), Reference(0.0), Direct())
        onepath.noisy(cube, snr_db, seed, "claims", "crowd", purpose, "noise", k)
        got = receive_passive(cube, arrays, Receivers(), 8, prediction(43.817, -5.3), True)
        total += count_symbols(links[0][0].payload, got)
    return total


def _rates(n: SymbolCount) -> str:
    delay, dpsk = proportion(n.delay_errors, n.delay_total), proportion(n.dpsk_errors, n.dpsk_total)
    return f"delay {delay}, DPSK {dpsk}"


def _counts(n: SymbolCount) -> tuple[int, ...]:
    return n.delay_errors, n.delay_total, n.dpsk_errors, n.dpsk_total


def sharing(quick: bool, seed: int, report: Progress) -> tuple[pd.DataFrame, tuple[Verdict, ...]]:
    """Six active terminals at once, and two in the same blocks."""
    frames, snr = (4, -5.0) if quick else (24, -5.0)
    others = (3, 6, 9, 12, 15)
    cases: dict[str, dict[int, float]] = {
        "alone": {},
        "five others, equal": dict.fromkeys(others, 0.0),
        "five others, +30 dB": dict.fromkeys(others, 30.0),
        "same blocks, -6 dB": {0: -6.0},
        "same blocks, +6 dB": {0: 6.0},
    }
    found = {}
    for i, (name, first_blocks) in enumerate(cases.items()):
        # the same noise, schedule and data in all cases
        found[name] = crowd(first_blocks, frames, snr, seed, "sharing")
        report(i + 1, len(cases))
    text = "; ".join(f"{name}: {_rates(n)}" for name, n in found.items())
    clean = found["five others, +30 dB"].delay_errors == 0
    rows = [(name, *_counts(n)) for name, n in found.items()]
    return table(f"case {SYMBOLS}", rows), (say("sharing", False, clean, snr=snr, text=text),)


STREAMS = {"PT1": ((0,), 41.317, 6.2), "PT2": ((1, 2), 67.713, -3.9)}
"""Groups, length [m] and rate [m/s] of the users' lines of sight."""


def streams(quick: bool, seed: int, report: Progress) -> tuple[pd.DataFrame, tuple[Verdict, ...]]:
    """Groups assigned to different passive terminals: rate and symbol error rate of each user and
    of one user with all groups."""
    w, frames = Waveform(), 2 if quick else 16
    arrays, users = onepath.antennas(w, 4), {**STREAMS, "one user": ((0, 1, 2), 41.317, 6.2)}
    rng = generator(seed, "claims", "streams")
    schedule = pseudo_random_schedule(w.num_groups, w.num_chirps, w.num_tx, rng)
    levels = (10.0, -22.0)
    counts = {(name, snr): SymbolCount() for name in users for snr in levels}
    for k in range(frames):
        payload = random_payload(w, schedule, 8, generator(seed, "claims", "streams", k))
        for name, (groups, length, rate) in users.items():
            expected = prediction(length, rate)
            for snr in levels:
                cube = onepath.frame(w, schedule, payload, arrays, delay=length / C, rate=rate / C)
                onepath.noisy(cube, snr, seed, "streams", name, k)
                got = receive_passive(cube, arrays, Receivers(), 8, expected, True, groups=groups)
                counts[name, snr] += count_symbols(payload, got, groups)
        report(k + 1, frames)
    rows, texts = [], []
    for (name, snr), n in counts.items():
        groups = users[name][0]
        rate = w.of_groups(groups).bits_per_frame(8) / w.frame_duration / 1e3
        bits = n.bit_errors, n.bits_total
        rows.append((name, " ".join(map(str, groups)), snr, rate, *_counts(n), *bits))
        texts.append((name, f"{snr:g} dB: {_rates(n)}"))
    found = table(f"user groups snr_db rate_kbps {SYMBOLS} bit_errors bits", rows)
    high = found[found.snr_db == levels[0]].set_index("user")
    rate = high.rate_kbps
    split = abs(rate["PT1"] + rate["PT2"] - rate["one user"]) < 1e-9
    text = "; ".join(
        f"{name} (groups {users[name][0]}) {rate[name]:.1f} kbit/s, {said}" for name, said in texts
    )
    return found, (say("streams", split and high.delay_errors.sum() == 0, text=text),)


# ---------------------------------------------------------------- the stages before the data


def _network(seed: int, snr_db: float) -> tuple[Network, dict[str, Clock]]:
    """One active and two passive terminals on random straight courses, clocks within 80 ns and 0.01
    ppm."""
    w, rng = Waveform(num_chirps=60), generator(seed, "claims", "stages")
    place = {name: rng.uniform([-40, -20, 20], [40, 60, 40]) for name in ("A", "P", "Q")}
    speed = {name: rng.uniform(-6, 6, 3) for name in place}

    def scene(time: float, links: Sequence[Link]) -> tuple[dict[str, Pose], dict[Link, PathSet]]:
        poses = {
            name: Pose(place[name] + time * speed[name], speed[name], np.zeros(3), np.eye(3))
            for name in place
        }
        paths: dict[Link, PathSet] = {}
        for link in links:
            away = poses[link.rx].position - poses[link.tx].position
            length = float(np.linalg.norm(away))
            u = away / length
            rate = float(u @ (speed[link.rx] - speed[link.tx])) / C
            ends = u, -u
            paths[link] = waves(time, length / C, rate, ends=ends, radius=length, link=link)
        return poses, paths

    clocks = {name: Clock(rng.uniform(-80e-9, 80e-9), rng.uniform(-1e-8, 1e-8)) for name in place}
    net = Network(
        waveform=w,
        arrays=Arrays(onepath.antennas(w, 2)),
        schedule=pseudo_random_schedule(w.num_groups, w.num_chirps, w.num_tx, rng),
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
        for (at, pt), link in establish(net).links.items():
            offset = drift = float("nan")
            if (clock := link.clock) is not None:
                late = [clocks[name].late(clock.time) for name in (at, pt)]
                offset = clock.offset - late[0] + late[1]
                drift = clock.drift - clocks[at].drift + clocks[pt].drift
            done = link.identified, link.acknowledged
            rows.append((k, f"{at}->{pt}", *done, offset * 1e9, drift * 1e9))
        report(k + 1, networks)
    columns = "network link identified acknowledged offset_error_ns drift_error_ppb"
    found = table(columns, rows)
    known = found[found.offset_error_ns.notna()]
    rms = [float(np.sqrt((known[name] ** 2).mean())) for name in columns.split()[-2:]]
    heard, total = int(found.identified.sum()), len(found)
    learnt = {
        "heard": proportion(heard, total),
        "acknowledged": proportion(int(found.acknowledged.sum()), total),
    }
    errors = {"offset": rms[0], "metres": rms[0] * 0.2998, "drift": rms[1]}
    share = proportion(len(known), total)
    return found, (
        say("learn", heard == total, True, snr=snr, **learnt),
        say("rounds", False, True, known=share, **errors),
    )


# ---------------------------------------------------------------- feedback


def feedback(quick: bool, seed: int, report: Progress) -> tuple[pd.DataFrame, tuple[Verdict, ...]]:
    """Whole-cell slips planted at a passive terminal: what the data suffer and how often one
    feedback undoes them."""
    w, tries = Waveform(num_samples=256, num_chirps=60), 8 if quick else 64
    arrays, cell, rows = onepath.antennas(w, 4), w.range_cell(1), []
    length, rate, echo_std = 21.317, -3.1, 0.09
    slips = (-3, -1, 1, 3)
    for s, slip in enumerate(slips):
        wrong = symbols = repaired = 0
        expected = prediction(length + slip * cell, rate)
        for k in range(tries):
            rng = generator(seed, "claims", "feedback", s, k)
            schedule = pseudo_random_schedule(w.num_groups, w.num_chirps, w.num_tx, rng)
            payload = random_payload(w, schedule, 8, rng)
            cube = onepath.frame(w, schedule, payload, arrays, delay=length / C, rate=rate / C)
            onepath.noisy(cube, 0.0, seed, "feedback", s, k)
            got = receive_passive(cube, arrays, Receivers(), 8, expected, True)
            said = summarise(got, length + slip * cell, 0.02, arrays.num_rx, w)
            answer = correct(said, length + echo_std * rng.standard_normal(), echo_std, 0.0, w)
            wrong += int((got.delay_symbols != payload.delay_symbols).sum())
            symbols += payload.delay_symbols.size
            repaired += int(answer.sure and answer.cells == slip)
        rows.append((slip, wrong, symbols, repaired, tries))
        report(s + 1, len(slips))
    found = table("slip_cells delay_errors delay_symbols repaired feedbacks", rows)
    wrong, symbols, good, total = (int(n) for n in found.sum()[1:])
    paper = Waveform()
    verdict = say(
        "feedback",
        False,
        good > 0,
        suffered=proportion(wrong, symbols),
        repaired=proportion(good, total),
        std=echo_std,
        share=echo_std / cell,
        least=frames_to_repair(3, 4),
        most=frames_to_repair(0, 4),
        bits=paper.bits_per_delay_symbol * paper.num_groups * paper.num_chirps,
    )
    return found, (verdict,)


def draw(ax: Axes, tolerated: pd.DataFrame) -> None:
    """Isolation against timing error."""
    for i, ((spacing, cells), part) in enumerate(
        tolerated.groupby(["spacing_blocks", "delay_cells"], sort=False)
    ):
        dash, which = ("-", "next") if spacing == 1 else ("--", "previous")
        label = f"{which} block, delay {cells:.0f} cells"
        ax.plot(part.error_T_d, part.power_db, dash, color=f"C{i % 3}", label=label)
    ax.axvspan(-1, 1, color="#009E73", alpha=0.12, lw=0)
    ax.set(xlabel="timing error [T_d], late is positive", ylabel="isolation [dB]")
    ax.set(title="Chirp-DMA (green: tolerated for any delay)")
    ax.legend(fontsize=5.8, loc="lower center")
