"""Detectors in geometric clutter, on the same samples: false alarms on target-free frames, small
UAVs in and beside strong clutter.

At each place, hovering and at 10 m/s, the clutter's amplitudes are drawn twice. The first draw
gives a frame without targets on which every detector's threshold is scaled so that the rate over
all places is `RATE`. The second gives a frame without targets on which the false alarms are
counted; frames with UAVs are made of both. A hit is a detection within one cell of range and
Doppler. Beside them the same UAVs and noise without clutter, the bound. The signal carries data;
synthesis and reception are the program's own.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
import pandas as pd
from matplotlib.figure import Figure
from scipy import ndimage

from isac_rt.extensions.city_receivers.adaptive import noise_level
from isac_rt.extensions.city_receivers.angle_doppler import AngleDoppler, correct
from isac_rt.extensions.city_receivers.power import cells_of, expected_power
from isac_rt.frame.cube import IFCube
from isac_rt.frame.payload import Payload
from isac_rt.propagation.pathset import PathSet
from isac_rt.randomness import generator
from isac_rt.receive.cfar import CfarRule
from isac_rt.receive.chain import filter_of
from isac_rt.receive.known import Known
from isac_rt.receive.maps import accumulate, channel_maps
from isac_rt.receive.settings import Receivers
from isac_rt.receive.spectrum import clean_spectrum
from isac_rt.receive.types import ExpectedClutter
from isac_rt.results.metrics import binomial_interval
from reproduce.clutter_scenes import (
    PLACES,
    SPEED,
    Scenes,
    Targets,
    in_the_air,
    scenario,
)
from reproduce.outcome import (
    Outcome,
    Progress,
    Sentences,
    Verdict,
    blank,
    proportion,
    style,
    table,
)

RATE = 0.8e-3
"""False alarms per cell that thresholds are scaled to, some 150 events: what is counted on other
frames then stays below `WORST_RATE`."""
WORST_RATE = 1e-3
STRONG_DB = 20.0
POWER_DBM = 30.0
SPAN_M = 15.0, 115.0
APART = 5
"""Cells of range or of Doppler between two targets of a frame."""
COMPARED = "square", "street"


@dataclass(frozen=True)
class Mistakes:
    """Errors of a terminal: of its velocity [m/s], of the expected level, and the standard
    deviation of its mesh's planes along their normals [m]."""

    velocity: tuple[float, float, float] = (0.0, 0.0, 0.0)
    level_db: float = 0.0
    mesh_std: float = 0.0


@dataclass(frozen=True)
class Detector:
    """A row of the comparison.

    Attributes
    ----------
    text : for people
    settings : of the receiver
    mistakes : what the terminal has wrong
    fitted : it corrects its velocity and the clutter's level by each case's first frame, one with
        UAVs
    """

    text: str
    settings: dict
    mistakes: Mistakes = Mistakes()
    fitted: bool = True


ALL_WRONG = Mistakes((0.07, 0.07, 0.0), -3.0, 0.1)
"""0.1 m/s, 3 dB too low, 0.1 m rms of every plane."""
VELOCITY_WRONG = Mistakes(ALL_WRONG.velocity)
LEVEL_WRONG = Mistakes(level_db=ALL_WRONG.level_db)
MESH_WRONG = Mistakes(mesh_std=ALL_WRONG.mesh_std)
FILTER = {"clutter_detector": "angle_doppler"}
DETECTORS = {
    "cfar": Detector("CFAR", {}),
    "runs": Detector("CFAR after the paper's filter (runs)", {"clutter_filter": "runs"}),
    "notch": Detector("CFAR after a zero-Doppler notch", {"clutter_filter": "zero_doppler"}),
    "filter": Detector("mesh and velocity", FILTER),
    "velocity_wrong": Detector("mesh and velocity, velocity 0.1 m/s off", FILTER, VELOCITY_WRONG),
    "level_wrong": Detector("mesh and velocity, level 3 dB off", FILTER, LEVEL_WRONG),
    "mesh_wrong": Detector("mesh and velocity, mesh 0.1 m off", FILTER, MESH_WRONG),
    "filter_wrong": Detector("mesh and velocity, all three off", FILTER, ALL_WRONG),
    "unfitted": Detector("all three off, not corrected", FILTER, ALL_WRONG, fitted=False),
}
BOUNDS = {"bound": "filter"}
"""Detectors without any clutter."""


@dataclass
class Tally:
    """What one detector did over all cases: ratios of statistic to threshold."""

    tuning: list[np.ndarray] = field(default_factory=list)
    free: list[np.ndarray] = field(default_factory=list)
    hits: list[np.ndarray] = field(default_factory=list)

    def scale(self) -> float:
        """Factor on the design threshold that gives `RATE` on the tuning frames."""
        return float(np.quantile(np.concatenate(self.tuning), 1 - RATE))


@dataclass(frozen=True)
class Recorded:
    """One place and speed: cleaned spectra of every frame, and what is known of it.

    Attributes
    ----------
    payload : of all frames
    spectra : tuning frame, free frame, frames with targets
    maps : of the spectra; `quiet`: the same without clutter
    targets : of each frame with targets; `cells` their (row, centred column), `strength_db` the
        clutter over the noise there
    """

    place: str
    speed: float
    payload: Payload
    spectra: list[np.ndarray]
    maps: list[np.ndarray]
    quiet: list[np.ndarray]
    targets: list[Targets]
    cells: list[np.ndarray]
    strength_db: list[np.ndarray]


def strengths(scenes: Scenes, place: str, speed: float, payload: Payload) -> np.ndarray:
    """(rows, P) expected clutter over noise [dB], with the noise as it is in a map."""
    known = _known(scenes, payload)
    power = accumulate(channel_maps(clean_spectrum(scenes.noisy([], place, "level"), known), known))
    level = noise_level(power, None, known.channels)
    clutter = _expected(scenes, place, speed, Mistakes())
    expected = expected_power(clutter, known, known.waveform.num_delay_symbols)
    return 10 * np.log10(np.maximum(expected / level, 1e-6))


def choose_targets(
    scenes: Scenes, place: str, strength_db: np.ndarray, rng: np.random.Generator, count: int
) -> Targets:
    """About half of the UAVs in cells with strong clutter, where there are any, the others anywhere
    in range and velocity."""
    w = scenes.setup.waveform
    first, last = (round(r / w.range_cell(2)) for r in SPAN_M)
    strong = np.argwhere(strength_db[first:last] > STRONG_DB) + np.array([first, 0])
    picked = (
        strong[rng.permutation(len(strong))[: 3 * count]] if len(strong) else np.zeros((0, 2), int)
    )
    anywhere = np.stack(
        [rng.integers(first, last, count), rng.integers(4, w.num_chirps - 4, count)], axis=1
    )
    kept: list[np.ndarray] = []
    for cell in [*picked, *anywhere]:
        if all(np.abs(cell - other).max() > APART for other in kept):
            kept.append(cell)
    cells = np.array(kept) + rng.uniform(-0.5, 0.5, (len(kept), 2))
    doppler = cells[:, 1] - w.num_chirps // 2
    ranges = (cells[:, 0] - doppler * w.sampled_duration / w.frame_duration) * w.range_cell(2)
    return in_the_air(scenes, place, ranges, doppler * w.velocity_cell(2), rng)


def make_case(scenes: Scenes, place: str, speed: float, target_frames: int, count: int) -> Recorded:
    """Samples of one place and speed."""
    payload = scenes.payload(place, round(speed))
    sent = scenes.transmission(place, speed, payload)
    strength_db = strengths(scenes, place, speed, payload)
    clutter = [scenes.samples(scenes.clutter(place, speed, draw), sent) for draw in (1, 2)]
    frames = [[clutter[0]], [clutter[1]]]
    quiet: list[list[IFCube]] = [[], []]
    targets, cells, under = [], [], []
    for k in range(target_frames):
        rng = generator(scenes.setup.scenario.seed, "targets", place, round(speed), k)
        some = choose_targets(scenes, place, strength_db, rng, count)
        paths = some.paths(scenes, place, speed)
        echoes = scenes.samples(paths, sent)
        frames.append([clutter[1 - k % 2], echoes])
        quiet.append([echoes])
        targets.append(some)
        cells.append(_cells(paths, scenes))
        under.append(strength_db[tuple(cells[-1].T)])
    name = place, round(speed)
    known = _known(scenes, payload)
    spectra, without = (
        [clean_spectrum(scenes.noisy(parts, *name, i), known) for i, parts in enumerate(some)]
        for some in (frames, quiet)
    )
    maps, empty = ([channel_maps(one, known) for one in some] for some in (spectra, without))
    return Recorded(place, speed, payload, spectra, maps, empty, targets, cells, under)


def _cells(paths: PathSet, scenes: Scenes) -> np.ndarray:
    """(Q, 2) row and centred column of paths."""
    w = scenes.setup.waveform
    beat, doppler = cells_of(
        ExpectedClutter(paths.delay, paths.delay_rate, paths.power, paths.departure, paths.arrival),
        w,
    )
    return np.stack(
        [np.round(beat), (np.round(doppler) + w.num_chirps // 2) % w.num_chirps], axis=1
    ).astype(int)


def _known(scenes: Scenes, payload: Payload) -> Known:
    s = scenes.setup
    return Known(s.waveform, s.schedule, payload.delay_symbols, payload.phases, s.antennas, 2)


def _ratios(
    settings: Receivers,
    fitted: bool,
    frames: Sequence[np.ndarray],
    known: Known,
    expected: ExpectedClutter,
) -> list[np.ndarray]:
    """Statistic over its threshold in every cell of each frame (rows, P)."""
    if settings.clutter_detector == "cfar":
        rule = CfarRule.of(settings, known.channels)
        return [rule.ratio(accumulate(maps))[0] for maps in frames]
    powers = [accumulate(maps) for maps in frames]
    if fitted:
        expected = correct(powers[0], known, expected).apply(expected)
    detector, each = AngleDoppler(settings), zip(frames, powers, strict=True)
    return [detector.test_cells(*one, known, expected)[0] for one in each]


def _expected(scenes: Scenes, place: str, speed: float, mistakes: Mistakes) -> ExpectedClutter:
    """What the terminal expects, without what is 20 dB and more under a cell's noise."""
    w = scenes.setup.waveform
    pose = scenes.pose(place, speed)
    pose = replace(pose, velocity=pose.velocity + np.array(mistakes.velocity))
    found = scenes.expected(place, pose, mistakes.mesh_std)
    found = replace(found, power=found.power * 10 ** (mistakes.level_db / 10))
    return found.select(found.power > 0.01 * scenes.noise * 2.25 / (w.num_samples * w.num_chirps))


NOTHING = ExpectedClutter(np.zeros(0), np.zeros(0), np.zeros(0), np.zeros((0, 3)), np.zeros((0, 3)))


def score(
    scenes: Scenes, case: Recorded, detector: Detector, tally: Tally, *, quiet: bool = False
) -> None:
    """Run one detector on a case's frames."""
    known = _known(scenes, case.payload)
    settings = Receivers(false_alarm_rate=1e-3, **detector.settings)
    frames = case.quiet if quiet else case.maps
    clutter_filter = filter_of(settings)
    if clutter_filter is not None:
        frames = []
        for spectra in (one.copy() for one in case.spectra):
            clutter_filter.clean(spectra, known.schedule)
            frames.append(channel_maps(spectra, known))
    expected = NOTHING if quiet else _expected(scenes, case.place, case.speed, detector.mistakes)
    # the first one corrects the terminal, and what is in the air must not hinder that
    frames = [*frames[2:], *frames[:2]]
    ratios = _ratios(settings, detector.fitted, frames, known, expected)
    rows = slice(*(round(r / known.waveform.range_cell(2)) for r in SPAN_M))
    tally.tuning.append(ratios[-2][rows].ravel())
    tally.free.append(ratios[-1][rows].ravel())
    for ratio, cells in zip(ratios[:-2], case.cells, strict=True):
        best = ndimage.maximum_filter(ratio, size=3, mode=("nearest", "wrap"))
        tally.hits.append(best[tuple(cells.T)])


def run(quick: bool, seed: int, progress: Progress) -> Outcome:
    """Every detector on every place; `quick`: coarser scatterers, fewer UAVs."""
    places = COMPARED
    target_frames, count = (1, 60) if quick else (3, 60)
    scenes = Scenes(scenario(places, seed, 0.03 if quick else 0.015, POWER_DBM))
    bounds = {name: DETECTORS[of] for name, of in BOUNDS.items()}
    tallies = {name: Tally() for name in [*DETECTORS, *bounds]}
    about: list[tuple] = []
    done, steps = 0, 2 * len(places)
    for place in places:
        for speed in (0.0, SPEED):
            case = make_case(scenes, place, speed, target_frames, count)
            for name, detector in DETECTORS.items():
                score(scenes, case, detector, tallies[name])
            for name, detector in bounds.items():
                score(scenes, case, detector, tallies[name], quiet=True)
            for some, strength in zip(case.targets, case.strength_db, strict=True):
                values = some.range, some.velocity, strength
                about += [(place, speed, *row) for row in zip(*values, strict=True)]
            done += 1
            progress(done, steps)
    targets = table("place speed_mps range_m velocity_mps clutter_db", about)
    summary, hits = summarise(tallies, targets)
    settings = {
        "quick": quick,
        "seed": seed,
        "tx_power_dbm": POWER_DBM,
        "places": {p: PLACES[p].text for p in places},
        "speeds_mps": [0.0, SPEED],
        "rate": RATE,
        "targets": len(targets),
        "strong_targets": int((targets.clutter_db > STRONG_DB).sum()),
        "span_m": list(SPAN_M),
    }
    tables = {"summary": summary, "targets": pd.concat([targets, hits], axis=1)}
    figure, verdicts = _figure(summary, targets, hits), _verdicts(summary)
    return Outcome(
        "detectors", "Detectors in geometric clutter", tables, figure, verdicts, settings
    )


def summarise(
    tallies: dict[str, Tally], targets: pd.DataFrame
) -> tuple[pd.DataFrame, pd.DataFrame]:
    """A row per detector, and whether each found each target at its scaled threshold."""
    rows, hits = [], {}
    strong = (targets.clutter_db > STRONG_DB).to_numpy()
    moving = (targets.speed_mps > 0).to_numpy()
    parts = strong, strong & ~moving, strong & moving, ~strong
    for name, tally in tallies.items():
        scale, free = tally.scale(), np.concatenate(tally.free)
        hits[name] = hit = np.concatenate(tally.hits) > scale
        events = int((free > scale).sum())
        false = events, free.size, events / free.size, *binomial_interval(events, free.size)
        found = [(hit[w].mean() if w.any() else np.nan, int(w.sum())) for w in parts]
        designed = float((free > 1).mean())
        rows.append((name, *false, designed, scale, hit.mean(), *itertools.chain(*found)))
    names = "strong", "strong_hovering", "strong_moving", "weak"
    columns = "detector false_alarms cells rate rate_low rate_high rate_as_designed scale pd "
    summary = table(columns + " ".join(f"pd_{n} n_{n}" for n in names), rows)
    return summary.set_index("detector", drop=False), pd.DataFrame(hits)


def rate_text(row: pd.Series) -> str:
    """False alarms per cell with their interval, for people."""
    return proportion(int(row.false_alarms), int(row.cells))


say = Sentences("""
false alarms: False alarms are at most 1e-3 per cell on target-free frames, counted on at least
100 events
  worst {worst.detector}: {worst_rate}; {best}: {rate}

bound: The angle-Doppler filter comes within 0.03 of the clutter-free bound over all UAVs
  {best} {top.pd:.4f}, bound {limit.pd:.4f}, {uavs} UAVs

strong: In strong-clutter cells the filter finds at least 0.95
  {best} {strong}; bound {strong_limit}; hovering {top.pd_strong_hovering:.3f}, at {speed:g} m/s
  {top.pd_strong_moving:.3f}; {top.n_strong} UAVs in cells with clutter over {level:g} dB

wrong: The filter holds this with 0.1 m/s of velocity error, 3 dB of level error and
0.1 m of mesh error
  all three at once, {wrong.detector}: {wrong.pd:.4f} over all, {strong} in strong clutter, false
  alarms {rate}; {alone}; not corrected by the frame {raw.pd:.4f} and {raw.pd_strong:.3f}

others: What the others reach (no claim; stated beside the filter)
  {losers}
""")


def _verdicts(found: pd.DataFrame) -> tuple[Verdict, ...]:
    """What is demanded of the filter, by name."""
    top, limit = found.loc["filter"], found.loc["bound"]
    wrong, raw = found.loc["filter_wrong"], found.loc["unfitted"]
    alone = [found.loc[n] for n in ("velocity_wrong", "level_wrong", "mesh_wrong")]

    def strong(row: pd.Series) -> str:
        return proportion(round(row.pd_strong * row.n_strong), int(row.n_strong))

    worst = found[~found.index.isin(BOUNDS)].sort_values("rate").iloc[-1]
    quiet = worst.rate <= WORST_RATE and found.false_alarms.min() >= 100
    kept = all(row.pd >= limit.pd - 0.03 and row.pd_strong >= 0.95 for row in (wrong, *alone))
    each = ", ".join(f"{row.detector} alone {row.pd:.4f} and {row.pd_strong:.3f}" for row in alone)
    losers = ", ".join(
        f"{DETECTORS[n].text} {found.pd[n]:.3f} ({found.pd_strong[n]:.3f} in strong clutter)"
        for n in found.index
        if n in ("cfar", "runs", "notch")
    )
    rates = {"worst_rate": rate_text(worst), "rate": rate_text(top)}
    both = {"strong": strong(top), "strong_limit": strong(limit)}
    cells = {"speed": SPEED, "level": STRONG_DB}
    uavs, told = int(top.n_strong + top.n_weak), {"best": "filter", "top": top}
    failed = {"strong": strong(wrong), "rate": rate_text(wrong), "alone": each}
    return (
        say("false alarms", quiet, best="filter", worst=worst, **rates),
        say("bound", top.pd >= limit.pd - 0.03, **told, limit=limit, uavs=uavs),
        say("strong", top.pd_strong >= 0.95, **told, **both, **cells),
        say("wrong", kept, wrong=wrong, raw=raw, **failed),
        say("others", True, losers=losers),
    )


DRAWN = "cfar", "notch", "filter", "filter_wrong", "bound"


def _figure(found: pd.DataFrame, targets: pd.DataFrame, hits: pd.DataFrame) -> Figure:
    names = [n for n in [*DETECTORS, *BOUNDS] if n in found.index]
    text = {n: DETECTORS[n].text if n in DETECTORS else f"no clutter, {BOUNDS[n]}" for n in names}
    with style():
        figure, axes = blank(1, 2, (10.5, 4.6), width_ratios=(1.25, 1))
        ax, curve = axes[0]
        y, strong = np.arange(len(names))[::-1], f"clutter > {STRONG_DB:g} dB over noise"
        ax.barh(y + 0.2, found.pd[names], 0.36, color="#4C78A8", label="all UAVs")
        ax.barh(y - 0.2, found.pd_strong[names], 0.36, color="#E45756", label=strong)
        for at, n in zip(y, names, strict=True):
            ax.text(1.01, at, f"{found.rate[n]:.1e}", fontsize=7, va="center")
        ax.set_yticks(y, [text[n] for n in names])
        ax.set(xlabel="probability of detection; right: false alarms per cell, measured")
        ax.set(xlim=(0, 1.2))
        outside = {"fontsize": 7, "ncols": 2, "framealpha": 1}
        ax.legend(loc="upper right", bbox_to_anchor=(1.0, 1.09), **outside)
        edges = np.array([-100.0, 0, 10, 15, 20, 25, 30, 60])
        bins = np.digitize(targets.clutter_db, edges)
        inside = [w for b in range(1, edges.size) if (w := bins == b).sum() > 4]
        at = [float(np.clip(targets.clutter_db[w].mean(), -10, 60)) for w in inside]
        for n, mark in zip(DRAWN, "v<oD+", strict=True):
            if n in names:
                curve.plot(at, [hits[n][w].mean() for w in inside], mark + "-", label=text[n])
        curve.set(xlabel="clutter over noise in the UAV's cell [dB]")
        curve.set(ylabel="probability of detection", ylim=(-0.02, 1.04))
        curve.legend(loc="upper center", bbox_to_anchor=(0.5, -0.13), **outside)
    return figure
