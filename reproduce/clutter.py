"""The paper's symbol-error and hit-rate curves in three kinds of clutter on the same terminals:
Gaussian, Rayleigh, a mesh's.

Places, terminals and scatterers are those of `clutter_scenes`; a PT flies 11.31 m ahead of the AT,
at rest or at 10 m/s together with it. "paper": clutter scaled to the paper's level, so that the
mean over the 45 strongest neighbouring cells is 10 dB over the reference (the line of sight at a
PT, the target at the AT). "physical": as strong as the geometry makes it, the target a small UAV at
30 m. SNR is per sample and antenna, of the reference. A frame is one group at the PT, three at the
AT; the AT's targets share a frame.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import pandas as pd
from scipy import ndimage

from isac_rt.frame.antennas import unit_vector
from isac_rt.frame.cube import IFCube, ReceiveArray, Reference, Transmission
from isac_rt.frame.link import Link
from isac_rt.frame.payload import Payload, random_payload, unmodulated
from isac_rt.frame.waveform import SPEED_OF_LIGHT, Waveform
from isac_rt.propagation.clutter.rayleigh import rayleigh_cells
from isac_rt.propagation.free_space import friis_amplitude, radar_amplitude
from isac_rt.propagation.pathset import PathKind, PathSet
from isac_rt.propagation.scatter_paths import LinkState
from isac_rt.propagation.settings import Clutter
from isac_rt.randomness import generator, seed_sequence
from isac_rt.receive.cfar import CfarRule
from isac_rt.receive.clutter_filter import remove_static
from isac_rt.receive.known import Known
from isac_rt.receive.maps import accumulate, channel_maps
from isac_rt.receive.settings import Receivers
from isac_rt.receive.spectrum import clean_spectrum
from isac_rt.receive.symbols import decide, decide_transitions, known_cycles
from isac_rt.signal.if_signal import add_noise, if_signal
from isac_rt.signal.methods import Auto
from isac_rt.world.swarm import Pose
from reproduce import clutter_statistics as numbers
from reproduce.clutter_figure import draw
from reproduce.clutter_scenes import PLACES, SMALL_UAV_M2, SPEED, Scenes, scenario
from reproduce.outcome import (
    Outcome,
    Progress,
    Sentences,
    Verdict,
    proportion,
    table,
)
from reproduce.range_profile import correlate, learn_profile
from reproduce.symbols import make_cells
from reproduce.waves import AT_TO_PT, prediction, sender, waves

LEVEL_DB = 10.0
DISTANCE = 11.31
UAV_M = 30.0
PLACES_USED = "square", "street", "roofs"
PT_SNR = np.array([-32.0, -29.0, -27.0, -25.0, -22.0, -17.0, -10.0])
AT_SNR = np.array([-48.0, -45.0, -42.0, -39.0, -35.0, -30.0])
FALSE_ALARMS = 1e-4
TARGETS = 16
CLEAR_ROWS = 4
"""Range cells from a target within which a crossing of the threshold is not counted as a false
alarm."""
LEVELS = "paper", "physical"
PILOTS = {"profile": 1, "old profile": 12}
"""Frames from the pilot that a range profile is learned from to the data: one, and half of
`modulation.pilot_every_frames`' 25."""
ORDER = 8
OWN = Link("AT", "AT")


@dataclass(frozen=True)
class Kind:
    """One column of curves: what the clutter is and how the terminals move."""

    clutter: str
    speed: float

    @property
    def text(self) -> str:
        return self.clutter if self.clutter in ("gaussian", "rayleigh") else f"mesh, {self.clutter}"


def resting(
    ranges: np.ndarray, gains: np.ndarray, passes: int, epoch: float, direction: np.ndarray
) -> PathSet:
    """Paths that stand still, all from one direction."""
    link, arrival = (OWN, direction) if passes == 2 else (AT_TO_PT, -direction)
    delay, ends = passes * ranges / SPEED_OF_LIGHT, (direction, arrival)
    return waves(epoch, delay, gain=gains, ends=ends, kind=PathKind.DIFFUSE, link=link)


def strongest_mean(paths: PathSet, waveform: Waveform) -> float:
    """Mean power of the strongest run of 45 range cells."""
    cell = np.round(paths.delay / waveform.delay_step).astype(int)
    inside = cell < waveform.num_samples
    power = np.bincount(cell[inside], paths.power[inside], waveform.num_samples)
    return float(power[numbers.strongest_run(power)].mean())


def without_weakest(paths: PathSet, share: float = 0.005) -> PathSet:
    """Without the weakest paths that have this share of the power together."""
    order = np.argsort(paths.power)
    return paths.select(np.sort(order[np.cumsum(paths.power[order]) > share * paths.power.sum()]))


class Bench:
    """Cubes of both links for every kind of clutter, in units of the reference's amplitude."""

    def __init__(self, scenes: Scenes, seed: int) -> None:
        self.scenes, self.seed, self.waveform, self.antennas = (
            scenes,
            seed,
            scenes.setup.waveform,
            scenes.setup.antennas,
        )

    def poses(self, kind: Kind) -> tuple[Pose, Pose]:
        """AT, and PT ahead of it that looks back."""
        place = kind.clutter if kind.clutter in PLACES else PLACES_USED[0]
        own = self.scenes.pose(place, kind.speed)
        ahead = self.scenes.pose(place, 1.0).velocity
        turned = own.rotation * np.array([-1.0, -1.0, 1.0])
        return own, replace(own, position=own.position + DISTANCE * ahead, rotation=turned)

    def clutter(self, kind: Kind, passes: int, frame: int, physical: bool) -> PathSet | None:
        """Paths relative to a reference of unit amplitude; None without any."""
        w, own_rng = self.waveform, generator(self.seed, "clutter", kind.clutter, passes, frame)
        if kind.clutter == "gaussian":
            return None
        if kind.clutter == "rayleigh":
            ranges, gains = rayleigh_cells(Clutter(model="rayleigh"), w.range_cell(passes), own_rng)
            return resting(
                ranges, gains, passes, self.scenes.epoch, self.poses(kind)[0].rotation[:, 1]
            )
        own, other = self.poses(kind)
        origin = self.scenes.setup.city.origin
        start = replace(own, position=own.position - origin)
        end = start if passes == 2 else replace(other, position=other.position - origin)
        names = kind.clutter, kind.clutter if passes == 2 else f"{kind.clutter}-pt"
        paths = self.scenes.field.paths(
            LinkState(Link(*names), self.scenes.epoch, start, end), self.scenes.setup.arrays
        )
        other_draw = own_rng.standard_normal((len(paths), 2)) @ np.array([1, 1j]) / np.sqrt(2)
        paths = without_weakest(
            replace(paths, gain=_mean_amplitude(self.scenes, paths, names, start, end) * other_draw)
        )
        gain = self.antennas.gain
        if not physical:
            return replace(
                paths, gain=paths.gain * np.sqrt(10 ** (LEVEL_DB / 10) / strongest_mean(paths, w))
            )
        reference = friis_amplitude(w.wavelength, DISTANCE)
        if passes == 2:
            reference = radar_amplitude(w.wavelength, SMALL_UAV_M2, UAV_M, UAV_M)
        return replace(paths, gain=paths.gain / (gain * reference))


def _mean_amplitude(
    scenes: Scenes, paths: PathSet, names: tuple[str, str], start: Pose, end: Pose
) -> np.ndarray:
    """Root of the mean power of a field's paths, without the field's own amplitudes."""
    state = LinkState(Link(*names), paths.epoch, start, end)
    seen = scenes.field.seen(state)
    ahead = state.elements(scenes.setup.arrays, seen) > 0  # behind the antennas there is no path
    return np.abs(paths.gain / scenes.field.cells.amplitude[seen.index[ahead]])


def pt_errors(
    bench: Bench, kind: Kind, physical: bool, frame: int
) -> dict[tuple[str, str], np.ndarray]:
    """Errors of one group's frame at each SNR, {(symbol, decision): counts}: the delay symbols by
    the strongest cell and by the profiles of unmodulated frames before it (`PILOTS`), the DPSK
    symbols from the cells so decided."""
    w = replace(bench.waveform, num_groups=1, checked=None)
    own, other = bench.poses(kind)
    rng = generator(bench.seed, "pt data", kind.clutter, round(kind.speed), frame)
    schedule = bench.scenes.setup.schedule[:1]
    ahead = (other.position - own.position) / DISTANCE  # they fly side by side
    delay, ends = DISTANCE / SPEED_OF_LIGHT, (ahead, -ahead)
    sight = waves(bench.scenes.epoch, delay, ends=ends, radius=DISTANCE)
    clutter = bench.clutter(kind, 1, frame, physical)

    def received(payload: Payload, before: int) -> IFCube:
        sent = sender(bench.antennas, schedule, payload, own)
        links = [(sent, sight)]
        if clutter is not None:
            links += [(sent, earlier(clutter, before * w.frame_duration))]
        return if_signal(w, links, ReceiveArray(other, bench.antennas), Reference(0.0), Auto(1e-3))

    payload = random_payload(w, schedule, ORDER, rng)
    cube = received(payload, 0)
    pilots = {
        name: received(unmodulated(w), frames)
        for name, frames in PILOTS.items()
        if kind.speed or frames == 1
    }
    beats = w.beat_cells(DISTANCE / SPEED_OF_LIGHT, 0.0)[0]
    shape = cube.samples[0].shape
    pairs = rng.standard_normal((*shape[:2], 2 * shape[2]), np.float32) * np.float32(
        np.sqrt(w.num_samples / 2)
    )
    cells = make_cells(cube.samples[0].copy(), beats, pairs.view(np.complex64))
    reference = prediction(DISTANCE, 0.0, std=(1.0, 1.0))
    wrong: dict[tuple[str, str], list[int]] = {
        (symbol, d): [] for symbol in ("delay", "dpsk") for d in ("strongest cell", *pilots)
    }
    for number, level in enumerate(10 ** (-PT_SNR / 20)):
        power = cells.power(level)
        metrics = {"strongest cell": power}
        for name, pilot in pilots.items():
            heard = replace(pilot, samples=pilot.samples.copy())
            key = "pilot noise", name, kind.clutter, frame, number
            words = seed_sequence(bench.seed, *key).generate_state(2)
            profile = learn_profile(add_noise(heard, level**2, words), reference)
            metrics[name] = correlate(power, profile) if profile.any() else power
        for name, metric in metrics.items():
            raw = decide(metric, [], w)[0]
            decided = np.clip(raw, 0, w.num_delay_symbols - 1)
            wrong["delay", name].append(int((decided != payload.delay_symbols[0]).sum()))
            known = known_cycles(w, DISTANCE / SPEED_OF_LIGHT, 0.0, raw[None])
            picked = cells.at(raw % w.num_samples, level) * np.exp(-2j * np.pi * known)[:, None]
            turned = decide_transitions(picked, schedule, w.num_tx, ORDER)[0]
            wrong["dpsk", name].append(int((turned != payload.transitions).sum()))
    return {name: np.array(counts) for name, counts in wrong.items()}


def earlier(paths: PathSet, seconds: float) -> PathSet:
    """The same scatterers some time before, gains and directions as they are: 0.94 m of flight in
    12 frames at 10 m/s."""
    rate = paths.delay_rate - seconds * paths.delay_accel
    return replace(
        paths,
        delay=paths.delay - seconds * (rate + seconds * paths.delay_accel / 2),
        delay_rate=rate,
    )


def at_hits(bench: Bench, kind: Kind, frame: int) -> dict[tuple[bool, str], np.ndarray]:
    """Those of `TARGETS` targets of unit amplitude that the CFAR finds within a cell at each SNR,
    without a filter and after the zero-Doppler notch, for the clutter at the paper's level and as
    it is: {(physical, filter): (SNR, 3) hits, false alarms and cells in which there could have been
    one}."""
    w, schedule = bench.waveform, bench.scenes.setup.schedule
    own, _ = bench.poses(kind)
    rng = generator(bench.seed, "at data", kind.clutter, round(kind.speed), frame)
    payload = random_payload(w, schedule, 8, rng)
    sent = sender(bench.antennas, schedule, payload, own)
    targets, cells = _targets(bench, own, rng)
    cube = bench.scenes.noisy([], "at", kind.clutter, round(kind.speed), frame)
    known = Known(w, schedule, payload.delay_symbols, payload.phases, bench.antennas, 2)
    parts = {
        "noise": replace(cube, samples=cube.samples / np.float32(np.sqrt(bench.scenes.noise))),
        "targets": _cube(bench, targets, sent),
    }
    paths = bench.clutter(kind, 2, frame, False)
    ratio = 1.0
    if paths is not None:
        parts["clutter"] = _cube(bench, paths, sent)
        physical = bench.clutter(kind, 2, frame, True)
        ratio = (
            float(np.sqrt(physical.power.sum() / paths.power.sum()))
            if physical is not None
            else 1.0
        )
    out = {}
    for name in ("none", "notch"):
        maps = {}
        for part, one in parts.items():
            spectra = clean_spectrum(one, known)
            if name == "notch":
                remove_static(spectra, schedule, None)
            maps[part] = channel_maps(spectra, known)
        for physical_level in (False, True):
            fixed = maps["targets"]
            if "clutter" in maps:
                fixed = fixed + np.float32(ratio if physical_level else 1.0) * maps["clutter"]
            out[physical_level, name] = np.array(
                [
                    _found(fixed + np.float32(10 ** (-snr / 20)) * maps["noise"], cells)
                    for snr in AT_SNR
                ]
            )
    return out


def _cube(bench: Bench, paths: PathSet, sent: Transmission) -> IFCube:
    return if_signal(
        bench.waveform,
        [(sent, paths)],
        ReceiveArray(sent.pose, bench.antennas),
        Reference(0.0),
        Auto(1e-2),
    )


def _found(maps: np.ndarray, cells: np.ndarray) -> tuple[int, int, int]:
    """Targets found; crossings of the threshold in range cells without a target near, and the
    number of cells there."""
    settings = Receivers(false_alarm_rate=FALSE_ALARMS)
    power = accumulate(maps)
    above, _ = CfarRule.of(settings, maps.shape[0] * maps.shape[1]).detect(power)
    near = ndimage.maximum_filter(above, size=3, mode=("nearest", "wrap"))
    clear = np.abs(np.arange(len(power))[:, None] - cells[:, 0]).min(axis=1) > CLEAR_ROWS
    return int(near[tuple(cells.T)].sum()), int(above[clear].sum()), above[clear].size


def _targets(bench: Bench, own: Pose, rng: np.random.Generator) -> tuple[PathSet, np.ndarray]:
    """Targets between 10 and 100 m at up to 14 m/s, seven cells apart at least, anywhere in view;
    and their cells."""
    w = bench.waveform
    cells: list[np.ndarray] = []
    while len(cells) < TARGETS:
        tried = np.array(
            [rng.uniform(10, 100) / w.range_cell(2), rng.uniform(-14, 14) / w.velocity_cell(2)]
        )
        if all(np.abs(tried - c).max() > 7 for c in cells):
            cells.append(tried)
    place = np.array(cells)
    u = rng.uniform(-0.6, 0.6, (TARGETS, 2))
    towards = own.to_world(unit_vector(u))
    paths = waves(
        bench.scenes.epoch,
        place[:, 0] * w.range_cell(2) * 2 / SPEED_OF_LIGHT,
        place[:, 1] * w.velocity_cell(2) * 2 / SPEED_OF_LIGHT,
        gain=np.exp(2j * np.pi * rng.uniform(size=TARGETS)),
        ends=(towards, towards),
        kind=PathKind.TARGET,
        link=OWN,
    )
    beat = place[:, 0] + place[:, 1] * w.sampled_duration / w.frame_duration
    return paths, np.stack(
        [np.round(beat), (np.round(place[:, 1]) + w.num_chirps // 2) % w.num_chirps], axis=1
    ).astype(int)


def kinds() -> list[Kind]:
    """Statistical clutter knows no motion."""
    return [
        Kind("gaussian", 0.0),
        Kind("rayleigh", 0.0),
        *(Kind(p, v) for p in PLACES_USED for v in (0.0, SPEED)),
    ]


def run(quick: bool, seed: int, progress: Progress) -> Outcome:
    """Curves of twenty frames and statistics; `quick`: of one frame and coarser scatterers."""
    frames = 1 if quick else 20
    scenes = Scenes(scenario(PLACES_USED, seed, 0.05 if quick else 0.02, 30.0, partners=DISTANCE))
    bench = Bench(scenes, seed)
    symbols, hits = [], []
    done, steps = itertools.count(1), sum(2 + (kind.clutter in PLACES) for kind in kinds()) * frames

    def each(what: Callable, *arguments: object) -> list:
        out = []
        for f in range(frames):
            out.append(what(bench, *arguments, f))
            progress(next(done), steps)
        return out

    for kind in kinds():
        for physical in (False, True) if kind.clutter in PLACES else (False,):
            errors = each(pt_errors, kind, physical)
            for symbol, name in errors[0]:
                wrong = np.sum([e[symbol, name] for e in errors], axis=0)
                trials = (120 if symbol == "delay" else 117) * frames
                point = kind.clutter, kind.speed, LEVELS[physical], name
                symbols += [
                    (symbol, *point, s, int(n), trials, n / trials)
                    for s, n in zip(PT_SNR, wrong, strict=True)
                ]
        found = each(at_hits, kind)
        for physical, name in found[0]:
            if physical and kind.clutter not in PLACES:
                continue
            count = np.sum([f[physical, name] for f in found], axis=0)
            point, trials = (kind.clutter, kind.speed, LEVELS[physical], name), TARGETS * frames
            hits += [
                (*point, s, int(n), trials, n / trials, int(a), int(c), a / c)
                for s, (n, a, c) in zip(AT_SNR, count, strict=True)
            ]
    columns = "clutter speed_mps level decision snr_db count trials rate"
    tables = {
        "symbols": table("symbol " + columns, symbols),
        "hits": table(columns + " false_alarms free_cells false_alarm_rate", hits),
        "statistics": _statistics(scenes),
    }
    settings = {
        "quick": quick,
        "seed": seed,
        "frames": frames,
        "false_alarm_rate": FALSE_ALARMS,
        "level_db": LEVEL_DB,
        "places": {p: PLACES[p].text for p in PLACES_USED},
        "speed_mps": SPEED,
    }
    figure, verdicts = draw(tables, scenes), _verdicts(tables)
    return Outcome("clutter", "Three kinds of clutter", tables, figure, verdicts, settings)


def _statistics(scenes: Scenes) -> pd.DataFrame:
    rows = [{"clutter": "rayleigh", "speed_mps": 0.0, **numbers.RAYLEIGH}]
    for place in PLACES_USED:
        for speed in (0.0, SPEED):
            expected = scenes.expected(place, scenes.pose(place, speed))
            found = numbers.statistics(
                expected, scenes.setup.waveform, scenes.amplitude, scenes.setup.antennas.gain
            )
            rows.append({"clutter": place, "speed_mps": speed, **found})
    return pd.DataFrame(rows)


say = Sentences("""
level: Urban clutter is about 10 dB over the target
  median over the cells of 20 to 100 m, place by place, over a small UAV: {median} dB; 10th
  percentiles {low}, 90th {high} dB

extent: It fills 40 to 50 range cells
  cells within 20 dB of the strongest: {cells}

law: Its amplitudes are Rayleigh
  E|a|^4/(E|a|^2)^2 over the strongest 45 cells: {moment} (2 is Rayleigh); each cell by itself is
  Rayleigh, the levels differ; correlation of neighbouring cells' levels {correlation}

rest: It stands still
  hovering yes; at {speed:g} m/s a cell's power spreads by {rms} m/s rms over {cells} Doppler cells,
  and its amplitude correlates from frame to frame by {frames} (hovering 1)

symbols: A passive terminal reads its symbols in urban clutter at +10 dB
  delay symbols at {snr:g} dB SNR by the strongest cell: mesh {plain} wrong, Rayleigh {r[0]}; by the
  range profile learned one frame before: mesh {read}, Rayleigh {r[1]}; learned {age} frames before
  at {speed:g} m/s: mesh {old}; at the physical level, mesh, by the strongest cell: {physical}. DPSK
  symbols (D = {order}), mesh: by the profile at +10 dB {dpsk[0]}, at the physical level {dpsk[1]}

hits: The clutter filter gives the active terminal its targets back
  hits at {snr:g} dB SNR, mesh at +10 dB: hovering {found[none]} without and {found[notch]} with a
  zero-Doppler notch; at {speed:g} m/s {flying[none]} without and {flying[notch]} with it. False
  alarms per cell, {design:g} by design: hovering {rate[none]:.1e} and {rate[notch]:.1e}, at
  {speed:g} m/s {moving[none]:.1e} and {moving[notch]:.1e}; at the physical level and {speed:g} m/s
  {physical[none]:.1e} and {physical[notch]:.1e}
""")


def _verdicts(tables: dict[str, pd.DataFrame]) -> tuple[Verdict, ...]:
    statistics, symbols, hits = (tables[name] for name in ("statistics", "symbols", "hits"))
    return (*_of_the_model(statistics), _of_the_symbols(symbols), _of_the_hits(hits))


def _of_the_model(found: pd.DataFrame) -> list[Verdict]:
    """What the Rayleigh model assumes."""
    mesh = found[found.clutter != "rayleigh"]
    flying, hovering = mesh[mesh.speed_mps > 0], mesh[mesh.speed_mps == 0]

    def span(part: pd.Series, form: str = ".1f") -> str:
        return f"{part.min():{form}} to {part.max():{form}}"

    level = {
        "median": span(hovering.level_over_uav_db),
        "low": span(hovering.level_p10_db),
        "high": span(hovering.level_p90_db),
    }
    law = {
        "moment": span(hovering.fourth_moment, ".2f"),
        "correlation": span(hovering.level_correlation, ".2f"),
    }
    motion = {
        "rms": span(flying.doppler_rms_mps, ".2f"),
        "cells": span(flying.doppler_cells, ".0f"),
        "frames": span(flying.frame_correlation, ".3f"),
    }
    still = [bool((part.frame_correlation > 0.99).all()) for part in (flying, hovering)]
    near = abs(float(mesh.level_over_uav_db.median()) - LEVEL_DB) <= 5
    filled = bool(mesh.cells_within_20_db.between(40, 50).all())
    return [
        say("level", near, **level),
        say("extent", filled, cells=span(hovering.cells_within_20_db, ".0f")),
        say("law", bool((mesh.fourth_moment < 2.2).all()), **law),
        say("rest", *still, speed=SPEED, **motion),
    ]


def _best_snr(
    found: pd.DataFrame, decision: str, level: str, speed: float | None = None
) -> pd.DataFrame:
    """Rows of the highest SNR in a mesh's clutter."""
    part = found[(found.snr_db == found.snr_db.max()) & found.clutter.isin(PLACES_USED)]
    part = part[(part.decision == decision) & (part.level == level)]
    return part if speed is None else part[part.speed_mps == speed]


def _share(part: pd.DataFrame) -> str:
    return proportion(int(part["count"].sum()), int(part.trials.sum()))


def _of_the_symbols(symbols: pd.DataFrame) -> Verdict:
    delay, dpsk = (symbols[symbols.symbol == name] for name in ("delay", "dpsk"))
    rayleigh = delay[(delay.clutter == "rayleigh") & (delay.snr_db == delay.snr_db.max())]
    plain, read = (_best_snr(delay, d, "paper") for d in ("strongest cell", "profile"))
    low = [part["count"].sum() < 0.01 * part.trials.sum() for part in (plain, read)]
    ways = (("profile", "paper"), ("strongest cell", "physical"))
    return say(
        "symbols",
        *low,
        snr=PT_SNR[-1],
        plain=_share(plain),
        read=_share(read),
        r=[_share(rayleigh[rayleigh.decision == d]) for d in ("strongest cell", "profile")],
        age=PILOTS["old profile"],
        speed=SPEED,
        old=_share(_best_snr(delay, "old profile", "paper", SPEED)),
        physical=_share(_best_snr(delay, "strongest cell", "physical")),
        order=ORDER,
        dpsk=[_share(_best_snr(dpsk, *way)) for way in ways],
    )


def _of_the_hits(hits: pd.DataFrame) -> Verdict:
    def rates(level: str, speed: float) -> dict[str, float]:
        parts = {name: _best_snr(hits, name, level, speed) for name in ("none", "notch")}
        return {n: p.false_alarms.sum() / p.free_cells.sum() for n, p in parts.items()}

    def shares(speed: float) -> dict[str, str]:
        return {name: _share(_best_snr(hits, name, "paper", speed)) for name in ("none", "notch")}

    moving, still = rates("paper", SPEED), rates("paper", 0.0)
    kept = [rate["notch"] < 2 * FALSE_ALARMS for rate in (moving, still)]
    told = {"found": shares(0.0), "flying": shares(SPEED), "snr": AT_SNR[-1], "speed": SPEED}
    told |= {"rate": still, "moving": moving, "physical": rates("physical", SPEED)}
    return say("hits", *kept, design=FALSE_ALARMS, **told)
