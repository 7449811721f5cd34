"""What real front ends do to the scheme: phase symbols, floors, biases, flights.

Closed forms: of two oscillators with the mask L the phase between two chirps k slots apart, each
read as the mean over its samples, has the variance 2 int 2 L 4 sin^2(pi f k T-) sinc^2(f T) df; a
DPSK symbol is wrong where it turns by more than pi/D. Quantisation leaves -6.02 b - 1.76 dB of a
full sine, white over the sampling rate.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from math import erfc, pi, sqrt

import numpy as np
import pandas as pd
from matplotlib.figure import Figure

from isac_rt.extensions.hardware.oscillator import Mask, spread
from isac_rt.frame.front_end import FrontEnd, Oscillator
from isac_rt.frame.payload import MODULATION_ORDERS
from isac_rt.frame.schedule import pseudo_random_schedule
from isac_rt.frame.waveform import Waveform
from isac_rt.randomness import generator
from isac_rt.scenario.file import load
from isac_rt.simulation import simulate
from reproduce import SCENES
from reproduce.front_ends import BOARDS, FLOORS, Bias, biases, floor, instants
from reproduce.outcome import Outcome, Progress, Sentences, Verdict, blank, style, table
from reproduce.symbols import Setting, count_errors, link_waveform

FREE_DBC = (-95.0, -105.0, -115.0, -125.0)
"""Free oscillators by their level at 1 MHz [dBc/Hz]."""
SNR_DB = 20.0
"""Of the links, far above where noise alone makes an error."""
PRESETS = ("awr1443", "pll_poor")
"""Held against ideal hardware in Munich."""
CHANGES = ("frame_interval_s=0.045",)
STATED = {
    "free -95": (0.217, 0.537, 0.758, 0.877),
    "plateau, 10 dB a decade": (0.0, 0.0, 0.0, 0.06),
}
"""Shares of wrong DPSK symbols for D = 2, 4, 8, 16 that two such oscillators alone make, as
computed elsewhere; the last to one digit."""

say = Sentences("""
walk: Two free oscillators of -95 dBc/Hz at 1 MHz turn by 1.27 rad from chirp to chirp and spoil
0.217, 0.537, 0.758, 0.877 of the symbols for D = 2, 4, 8, 16
  on an AT-to-PT link, a sample of a chirp against that of the next: {turn:.3f} rad and {shares}
  ({symbols} symbols)

plateau: Two synthesisers locked to -90 dBc/Hz up to 300 kHz let D = 8 work; D = 16 has some 6 %
errors by 0.10 rad where 10 dB a decade follow the plateau, and fewer with 20 dB
  10 dB a decade: {slow:.3f} rad and {slow_shares}; 20 dB (pll_good): {fast:.3f} rad and
  {fast_shares}

dpsk: The phase symbols that the receiver reads are wrong as oscillators alone would have it
  largest distance of a rate from its closed form {worst:.3f}, in {most:.1f} standard deviations of
  the count ({symbols} symbols a rate, errors of a frame taken as independent)

locked: With a good locked synthesiser 8 phases work and with a poor one 4
  rates for D = 2, 4, 8, 16: good {good}; poor {poor}

delay: Delay symbols do not mind the oscillators
  largest rate of errors {delay:.4f}, with the worst free oscillator; {others:.4f} with all others,
  {ideal:.4f} with ideal ones

floor: Converters and oscillators lift the floor beside a leakage as their closed forms say
  over the thermal noise, measured and by closed form: {floors}

hidden: A leakage 66 dB over the noise hides a target behind 12 bits, and a poor synthesiser one
beside a leakage of 46 dB, that ideal hardware shows
  the target over the detector's threshold, and the detector's background over that of ideal
  hardware: {echoes}

range: The boards' own delay is a bias of every echo's range
  {biases}

angle: Phases of the channels bias directions by their slope over the array
  {biases}

munich: Real front ends leave hit rates and tracks over Munich as they are
  {rows}
""")


def run(quick: bool, seed: int, progress: Progress) -> Outcome:
    """Symbols over oscillators, floors over converters, biases in free space, flights in Munich."""
    frames, boards, flight = (3, 2, 6) if quick else (40, 12, 78)
    oscillators = _oscillators()
    total = frames * len(oscillators) + len(FLOORS) + len(BOARDS) + len(PRESETS) + 1
    done = 0

    def step(count: int = 1) -> None:
        nonlocal done
        done += count
        progress(done, total)

    rates, turns = [], []
    for name, one in oscillators.items():
        turns += _turns(name, one, 8 * frames, seed)
        rates += _symbols(name, one, frames, seed)
        step(frames)
    floors, ideal = [], None
    for name, beside in FLOORS.items():
        found, background = floor(beside, seed, ideal)
        ideal = background if ideal is None else ideal
        floors.append((name, beside.leakage_db, *vars(found).values()))
        step()
    offs = []
    for name, node in BOARDS.items():
        offs += [_bias_row(name, one) for one in biases(node, boards, seed)]
        step()
    flights = {}
    for name in ("ideal", *PRESETS):
        flights[name] = _flight(name, flight, seed)
        step()
    tables = {
        "instants": table("oscillator order turn_rad rate truth symbols", turns),
        "symbols": table("oscillator order rate truth symbols delay_rate", rates),
        "floors": table("front_end leakage_db floor_db truth_db cfar_db echo_db", floors),
        "biases": table("front_end range_mm range_truth_mm u_x u_x_truth u_z u_z_truth", offs),
        "flights": pd.DataFrame(
            [{"front_end": k, "terminal": t, **row} for k, v in flights.items() for t, row in v]
        ),
    }
    settings = {"quick": quick, "seed": seed, "frames": frames, "boards": boards}
    settings |= {"flight_frames": flight}
    title = "Real front ends"
    return Outcome("hardware", title, tables, _figure(tables), _verdicts(tables), settings)


def _oscillators() -> dict[str, Oscillator]:
    """By name: free ones, the presets' locked ones, and one with a slower fall."""
    out = {"ideal": Oscillator()}
    for level in FREE_DBC:
        mask = ((1e4, level + 40), (1e7, level - 20))
        out[f"free {level:g}"] = Oscillator(mask_dbc_hz=mask, locked=False)
    for preset in ("pll_good", "pll_poor"):
        out[preset] = FrontEnd(preset=preset).oscillator
    out["plateau, 10 dB a decade"] = Oscillator(mask_dbc_hz=((3e5, -90.0), (1e7, -105.23)))
    return out


def _turns(name: str, one: Oscillator, frames: int, seed: int) -> list[tuple]:
    """A row for each order: the turn from slot to slot at an instant, the rate of wrong DPSK
    symbols, its closed form, and symbols."""
    if one.ideal:
        return []
    turn, shares, size = instants(one, frames, seed)
    w = link_waveform(1024)
    mask = Mask(one.mask_dbc_hz, one.locked)
    sigma = sqrt(2 * spread(mask, w.slot_duration, 1e-12, w.sampling_rate)[0])
    return [(name, d, turn, shares[d], wrapped(sigma, d), size) for d in MODULATION_ORDERS]


def _bias_row(name: str, one: Bias) -> tuple:
    (x, z), (true_x, true_z) = one.direction, one.direction_truth
    return name, one.range_mm, one.range_truth_mm, x, true_x, z, true_z


def _symbols(name: str, one: Oscillator, frames: int, seed: int) -> list[tuple]:
    """A row for each order: rate of wrong DPSK symbols, its closed form, symbols, and the rate of
    wrong delay symbols."""
    link = Setting(
        name=f"hardware {name}",
        waveform=link_waveform(1024),
        exact_prediction=True,
        orders=MODULATION_ORDERS,
        front_end=FrontEnd(oscillator=one),
    )
    wrong: dict[str, int] = {}
    size: dict[str, int] = {}
    for index in range(frames):
        for key, (count, total) in count_errors(link, np.array([SNR_DB]), seed, index).items():
            wrong[key] = wrong.get(key, 0) + int(count[0])
            size[key] = size.get(key, 0) + total
    gaps = _gaps(link.waveform, seed)
    rows = []
    for order in MODULATION_ORDERS:
        key = f"dpsk {order} known delay"
        truth = closed_form(one, link.waveform, order, gaps)
        delay = wrong["delay"] / size["delay"]
        rows.append((name, order, wrong[key] / size[key], truth, size[key], delay))
    return rows


def _gaps(w: Waveform, seed: int) -> np.ndarray:
    """Slots between a chirp and the next of the same antenna, of some schedules."""
    rng, out = generator(seed, "hardware gaps"), []
    for _ in range(20):
        schedule = pseudo_random_schedule(1, w.num_chirps, w.num_tx, rng)[0]
        for antenna in range(w.num_tx):
            out += [b - a for a, b in pairwise(np.flatnonzero(schedule == antenna))]
    return np.array(out)


def closed_form(one: Oscillator, w: Waveform, order: int, gaps: np.ndarray) -> float:
    """Rate of wrong DPSK symbols between chirps `gaps` slots apart, read as means over chirps, with
    an oscillator like `one` at both ends."""
    if one.ideal:
        return 0.0
    mask = Mask(one.mask_dbc_hz, one.locked)
    slots, count = np.unique(gaps, return_counts=True)
    rate = [
        wrapped(
            sqrt(2 * spread(mask, k * w.slot_duration, w.sampled_duration, w.sampling_rate)[0]),
            order,
        )
        for k in slots
    ]
    return float(np.average(rate, weights=count))


def wrapped(sigma: float, order: int) -> float:
    """Probability that a normal phase of this standard deviation is nearer to another of `order`
    phases than to its own."""

    def beyond(x: float) -> float:
        return erfc(x / (sigma * sqrt(2))) / 2

    inside = sum(
        beyond(2 * pi * n - pi / order) - beyond(2 * pi * n + pi / order) for n in range(-20, 21)
    )
    return 1 - inside


def _flight(preset: str, frames: int, seed: int) -> list[tuple[str, dict[str, float]]]:
    """By terminal the figures of a shortened flight over Munich."""
    changes = [*CHANGES, f"frames={frames}", f"radio.front_end={{preset: {preset}}}"]
    scene = load(SCENES / "munich_swarm.yaml", changes, seed=seed)
    summary = simulate.summarise(scene)
    keys = ("hit_rate", "false_tracks_per_frame", "ser_dpsk", "ser_delay")
    out = []
    for name, one in summary["terminals"].items():
        row = {key: one[key] for key in keys}
        tracked = one["rmse_tracked"] or {}
        row |= {
            f"tracked_{key}": tracked.get(key)
            for key in ("range_m", "azimuth_deg", "elevation_deg")
        }
        out.append((name, row))
    return out


def _rates(column: pd.Series) -> str:
    return ", ".join(f"{value:.3f}" for value in column)


def _turn_verdicts(turns: pd.DataFrame) -> tuple[Verdict, Verdict]:
    """Free and locked oscillators at an instant; a rate holds within four standard deviations."""
    by = {name: part for name, part in turns.groupby("oscillator")}

    def near(name: str, stated: Sequence[float], digits: float) -> bool:
        rates, size = by[name].rate.to_numpy(), by[name].symbols.iloc[0]
        truth = np.array(stated)
        sigma = np.sqrt(truth * (1 - truth) / size)
        return bool((np.abs(rates - truth) <= 4 * sigma + digits).all())

    free, slow, fast = by["free -95"], by["plateau, 10 dB a decade"], by["pll_good"]
    walked = near("free -95", STATED["free -95"], 1e-3)
    held = near("plateau, 10 dB a decade", STATED["plateau, 10 dB a decade"], 5e-3)
    return (
        say(
            "walk",
            walked and abs(free.turn_rad.iloc[0] / 1.27 - 1) < 0.05,
            turn=free.turn_rad.iloc[0],
            shares=_rates(free.rate),
            symbols=int(free.symbols.iloc[0]),
        ),
        say(
            "plateau",
            held and bool((fast.rate.to_numpy()[:3] == 0).all()),
            slow=slow.turn_rad.iloc[0],
            slow_shares=_rates(slow.rate),
            fast=fast.turn_rad.iloc[0],
            fast_shares=_rates(fast.rate),
        ),
    )


def _symbol_verdicts(s: pd.DataFrame) -> tuple[Verdict, ...]:
    sigma = np.sqrt(np.maximum(s.truth * (1 - s.truth), 1e-3) / s.symbols)
    apart = (s.rate - s.truth).abs()
    rates = {name: part.rate for name, part in s.groupby("oscillator")}
    works = rates["pll_good"].iloc[2] < 0.01, rates["pll_poor"].iloc[1] < 0.01
    delay = s.groupby("oscillator").delay_rate.max()
    others = delay.drop(f"free {FREE_DBC[0]:g}").max()
    return (
        say(
            "dpsk",
            bool((apart < 5 * sigma).all()),
            worst=apart.max(),
            most=(apart / sigma).max(),
            symbols=int(s.symbols.min()),
        ),
        say(
            "locked",
            all(works),
            any(works),
            good=_rates(rates["pll_good"]),
            poor=_rates(rates["pll_poor"]),
        ),
        say(
            "delay",
            bool(delay.max() < 0.001),
            bool(others < 0.001),
            delay=delay.max(),
            ideal=delay["ideal"],
            others=others,
        ),
    )


def _floor_verdicts(f: pd.DataFrame) -> tuple[Verdict, Verdict]:
    floors = "; ".join(
        f"{row.front_end} {row.floor_db:.2f} and {row.truth_db:.2f} dB" for row in f.itertuples()
    )
    echoes = "; ".join(
        f"{row.front_end} {row.echo_db:.1f} and {row.cfar_db:.1f} dB" for row in f.itertuples()
    )
    by = f.set_index("front_end").echo_db
    hidden = by["12 bits, leakage 20 dB stronger"] < 0, by["pll_poor"] < 0
    seen = by["ideal"] > 0 and by["12 bits"] > 0
    return (
        say("floor", bool(((f.floor_db - f.truth_db).abs() < 1).all()), floors=floors),
        say("hidden", seen and all(hidden), seen and any(hidden), echoes=echoes),
    )


def _bias_verdicts(b: pd.DataFrame) -> tuple[Verdict, Verdict]:
    """A range holds to 2 mm, a hundredth of its cell; a direction to a fifth of the bias and 0.02
    degrees, RMS."""
    ranges, angles, kept = [], [], []
    for name, part in b.groupby("front_end", sort=False):
        found = part[["u_x", "u_z"]].to_numpy()
        truth = part[["u_x_truth", "u_z_truth"]].to_numpy()
        size, left = (np.degrees(np.sqrt((e**2).mean())) for e in (found, found - truth))
        apart = (part.range_mm - part.range_truth_mm).abs().max()
        kept.append((apart < 2.0, left < 0.02 + 0.2 * size))
        ranges.append(f"{name} {part.range_mm.mean():.1f} mm, {apart:.2f} mm off its delay at most")
        angles.append(f"{name} {size:.3f} degrees, {left:.3f} off the slope (RMS of both axes)")
    by_range, by_angle = zip(*kept, strict=True)
    count = f" ({len(b) // b.front_end.nunique()} echoes each)"
    return (
        say("range", all(by_range), biases="; ".join(ranges) + count),
        say("angle", all(by_angle), biases="; ".join(angles) + count),
    )


def _verdicts(tables: dict[str, pd.DataFrame]) -> tuple[Verdict, ...]:
    return (
        *_turn_verdicts(tables["instants"]),
        *_symbol_verdicts(tables["symbols"]),
        *_floor_verdicts(tables["floors"]),
        *_bias_verdicts(tables["biases"]),
        _munich_verdict(tables["flights"]),
    )


def _munich_verdict(flights: pd.DataFrame) -> Verdict:
    """Whether no terminal's hit rate falls by more than 0.05 nor its tracks' errors by a half."""
    by = flights.set_index(["terminal", "front_end"])
    kept, rows = [], []
    for terminal in dict.fromkeys(flights.terminal):
        ideal = by.loc[terminal, "ideal"]
        for preset in PRESETS:
            one = by.loc[terminal, preset]
            worse = float(one.tracked_range_m or 0) > 1.5 * float(ideal.tracked_range_m or np.inf)
            kept.append((one.hit_rate or 0) >= (ideal.hit_rate or 0) - 0.05 and not worse)
        texts = [
            f"{name} {_number(row.hit_rate)}, {_number(row.tracked_range_m)} m, "
            f"{_number(row.tracked_azimuth_deg)} deg, DPSK {_number(row.ser_dpsk)}"
            for name, row in ((n, by.loc[terminal, n]) for n in ("ideal", *PRESETS))
        ]
        rows.append(f"{terminal} (hit rate, tracked range, azimuth, SER): " + "; ".join(texts))
    return say("munich", all(kept), any(kept), rows=". ".join(rows))


def _number(value: float | None) -> str:
    return "-" if value is None or not np.isfinite(value) else f"{value:.3g}"


def _figure(tables: dict[str, pd.DataFrame]) -> Figure:
    with style():
        figure, axes = blank(1, 2, size=(10.0, 4.2))
        left, right = axes[0]
        for i, (order, part) in enumerate(tables["symbols"].groupby("order")):
            left.plot(part.oscillator, part.truth, f"C{i}-", lw=0.9)
            left.plot(part.oscillator, part.rate, f"C{i}o", label=f"D = {order}")
        left.set(ylabel="DPSK symbol error rate", title="read, and by closed form (lines)")
        left.tick_params(axis="x", rotation=40)
        left.legend()
        f = tables["floors"]
        right.bar(np.arange(len(f)) - 0.2, f.floor_db, 0.4, label="measured")
        right.bar(np.arange(len(f)) + 0.2, f.truth_db, 0.4, label="closed form")
        right.set(ylabel="floor over thermal noise [dB]", title="beside a leakage and a wall")
        right.set_xticks(np.arange(len(f)), f.front_end)
        right.legend()
    return figure
