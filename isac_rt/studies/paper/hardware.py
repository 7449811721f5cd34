"""What real front ends do to the scheme: phase symbols, floors, biases, flights.

Closed forms: of two oscillators with the mask L the phase between two chirps k slots apart, each
read as the mean over its samples, has the variance 2 int 2 L 4 sin^2(pi f k T-) sinc^2(f T) df; a
DPSK symbol is wrong where it turns by more than pi/D. Quantisation leaves -6.02 b - 1.76 dB of a
full sine, white over the sampling rate.
"""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise
from math import erfc, pi, sqrt

import numpy as np
import pandas as pd
from matplotlib.figure import Figure

from isac_rt.frame.cube import ReceiveArray, Reference
from isac_rt.frame.payload import MODULATION_ORDERS, unmodulated
from isac_rt.frame.schedule import pseudo_random_schedule
from isac_rt.frame.waveform import SPEED_OF_LIGHT, Waveform
from isac_rt.hardware.front_end import Ends, front_end_of
from isac_rt.hardware.oscillator import Mask, oscillator_of, spread
from isac_rt.propagation.pathset import PathKind
from isac_rt.randomness import generator, seed_sequence
from isac_rt.scenario.file import load
from isac_rt.scenario.front_end import FrontEnd, Oscillator
from isac_rt.signal.methods import Direct
from isac_rt.signal.noise import WhiteNoise
from isac_rt.signal.received import received
from isac_rt.simulation import simulate
from isac_rt.studies import scene_file
from isac_rt.studies.paper.outcome import Outcome, Progress, Sentences, Verdict, blank, style, table
from isac_rt.studies.paper.symbols import Setting, count_errors, link_waveform, paper_antennas
from isac_rt.studies.waves import STILL, sender, waves

FREE_DBC = (-95.0, -105.0, -115.0, -125.0)
"""Free oscillators by their level at 1 MHz [dBc/Hz]."""
SNR_DB = 20.0
"""Of the links, far above where noise alone makes an error."""
PRESETS = ("awr1443", "pll_poor")
"""Held against ideal hardware in Munich."""
CHANGES = ("frame_interval_s=0.045",)

say = Sentences("""
walk: Two free oscillators of -95 dBc/Hz at 1 MHz turn by 1.27 rad from chirp to chirp and spoil
0.217, 0.537, 0.758, 0.877 of the symbols for D = 2, 4, 8, 16
  by the process itself {turn:.3f} rad and {shares}

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

range: The boards' own delay of 0.456 ns is a bias of 68 mm of every echo's range
  {bias:.1f} mm with awr1443, {ideal:.1f} mm with ideal hardware ({count} echoes)

munich: Real front ends leave hit rates and tracks over Munich as they are
  {rows}
""")


def run(quick: bool, seed: int, progress: Progress) -> Outcome:
    """Symbols over oscillators, floors over converters, biases in free space, flights in Munich."""
    frames, flight = (3, 6) if quick else (40, 78)
    oscillators = _oscillators()
    total = frames * len(oscillators) + len(_FLOORS) + 2 + len(PRESETS) + 1
    done = 0

    def step(count: int = 1) -> None:
        nonlocal done
        done += count
        progress(done, total)

    rates = []
    for name, one in oscillators.items():
        rates += _symbols(name, one, frames, seed)
        step(frames)
    floors = []
    for name, node in _FLOORS.items():
        floors.append((name, *_floor(node, seed)))
        step()
    biases = {}
    for name in ("ideal", "awr1443"):
        biases[name] = _range_errors(name, seed)
        step()
    flights = {}
    for name in ("ideal", *PRESETS):
        flights[name] = _flight(name, flight, seed)
        step()
    tables = {
        "symbols": table("oscillator order rate truth symbols delay_rate", rates),
        "floors": table("front_end floor_db truth_db", floors),
        "ranges": table("front_end bias_mm std_mm echoes", [(k, *v) for k, v in biases.items()]),
        "flights": pd.DataFrame(
            [{"front_end": k, "terminal": t, **row} for k, v in flights.items() for t, row in v]
        ),
    }
    settings = {"quick": quick, "seed": seed, "frames": frames, "flight_frames": flight}
    verdicts = _verdicts(tables, seed)
    title = "Real front ends"
    return Outcome("hardware", title, tables, _figure(tables), verdicts, settings)


def _oscillators() -> dict[str, Oscillator]:
    """By name: free ones and the presets' locked ones."""
    out = {"ideal": Oscillator()}
    for level in FREE_DBC:
        mask = ((1e4, level + 40), (1e7, level - 20))
        out[f"free {level:g}"] = Oscillator(mask_dbc_hz=mask, locked=False)
    for preset in ("pll_good", "pll_poor"):
        out[preset] = FrontEnd(preset=preset).oscillator
    return out


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


_FLOORS = {
    "ideal": FrontEnd(),
    "12 bits": FrontEnd.model_validate({"converter": {"bits": 12}}),
    "10 bits": FrontEnd.model_validate({"converter": {"bits": 10}}),
    "8 bits": FrontEnd.model_validate({"converter": {"bits": 8}}),
    "pll_poor": FrontEnd(preset="pll_poor"),
}
_CELLS = np.arange(260, 380)
"""Range cells away from both waves."""
LEAKAGE_DB, WALL_DB = 46.0, 30.0
"""Power of the leakage and of a wall 40 m away over the thermal noise of a sample."""


def _floor(node: FrontEnd, seed: int) -> tuple[float, float]:
    """Noise floor of range-Doppler cells away from both waves over the thermal noise, and its
    closed form [dB]."""
    w = replace(link_waveform(1024), num_chirps=60)
    antennas, rng = paper_antennas(w), generator(seed, "hardware floor")
    schedule = pseudo_random_schedule(1, w.num_chirps, w.num_tx, rng)
    delays = np.array([1e-9, 80 / SPEED_OF_LIGHT])
    gain = 10 ** (np.array([LEAKAGE_DB, WALL_DB]) / 20)
    kinds = np.array([PathKind.LEAKAGE, PathKind.SPECULAR])
    paths = waves(w.frame_duration / 2, delays, gain=gain, kind=kinds)
    own = front_end_of(node, w, antennas, seed, "AT")
    words = seed_sequence(seed, "hardware floor noise").generate_state(2)
    job = w, [(sender(antennas, schedule, unmodulated(w)), paths)], ReceiveArray(STILL, antennas)
    noise = WhiteNoise(1.0, words)
    cube = received(*job, Reference(0.0), Ends(own, (own,)), Direct(), noise)
    window = np.hanning(w.num_samples) / np.sqrt((np.hanning(w.num_samples) ** 2).sum())
    cells = np.fft.fft(cube.samples[0] * window, axis=-1)[..., _CELLS]
    power, truth = gain**2, 1.0
    if node.converter.bits:
        full = 10 ** (node.converter.headroom_db / 10) * (power.sum() + 1)
        truth += full * 2 / 3 / 4**node.converter.bits
    if not node.oscillator.ideal:
        mask = Mask(node.oscillator.mask_dbc_hz, node.oscillator.locked)
        for p, delay in zip(power, delays, strict=True):
            offset = _CELLS / w.sampled_duration - w.slope * delay
            skirt = mask.level(offset) * 4 * np.sin(pi * offset * delay) ** 2
            truth += float(p * skirt.mean() * w.sampling_rate)
    found = float((np.abs(cells) ** 2).mean())
    return 10 * np.log10(found), 10 * np.log10(truth)


def _range_errors(preset: str, seed: int) -> tuple[float, float, int]:
    """Mean and scatter of the AT's range errors in the paper's swarm [mm], and of how many."""
    changes = ["frames=8", "receivers.active_every_frames=1"]
    scene = load(
        scene_file("paper_swarm_consistent.yaml"),
        [*changes, f"radio.front_end={{preset: {preset}}}"],
        seed=seed,
    )
    one = simulate.run(scene).dataset.sel(observer="AT")
    error = 1e3 * (one.detected_range - one.truth_range).values
    error = error[np.isfinite(error)]
    return float(error.mean()), float(error.std()), error.size


def _flight(preset: str, frames: int, seed: int) -> list[tuple[str, dict[str, float]]]:
    """By terminal the figures of a shortened flight over Munich."""
    changes = [*CHANGES, f"frames={frames}", f"radio.front_end={{preset: {preset}}}"]
    scene = load(scene_file("munich_swarm.yaml"), changes, seed=seed)
    summary = simulate.summarise(scene)
    keys = ("hit_rate", "ser_dpsk", "ser_delay")
    out = []
    for name, one in summary["terminals"].items():
        row = {key: one[key] for key in keys}
        tracked = one["rmse_tracked"] or {}
        row |= {f"tracked_{key}": tracked.get(key) for key in ("range_m", "azimuth_deg")}
        out.append((name, row))
    return out


def _walk(seed: int) -> tuple[float, dict[int, float]]:
    """Turn from slot to slot of two free oscillators of -95 dBc/Hz at 1 MHz [rad], and the share of
    symbols that it spoils, by order."""
    one = _oscillators()[f"free {FREE_DBC[0]:g}"]
    slot, steps = link_waveform(1024).slot_duration, []
    for index in range(16):
        two = [oscillator_of(one, 20e6, seed, f"{end}{index}") for end in ("AT", "PT")]
        time = 1e-4 + np.arange(110) * slot
        a, b = (o.record(0.0, 7.3e-3).at(time) for o in two if o is not None)
        steps.append(np.diff(a - b))
    turn = np.concatenate(steps)
    off = np.abs(turn - 2 * pi * np.rint(turn / (2 * pi)))
    return float(turn.std()), {d: float((off > pi / d).mean()) for d in MODULATION_ORDERS}


def _verdicts(tables: dict[str, pd.DataFrame], seed: int) -> tuple[Verdict, ...]:
    turn, shares = _walk(seed)
    stated = dict(zip(MODULATION_ORDERS, (0.217, 0.537, 0.758, 0.877), strict=True))
    near = all(abs(shares[d] - stated[d]) < 0.04 for d in stated) and abs(turn / 1.27 - 1) < 0.05
    s = tables["symbols"]
    sigma = np.sqrt(np.maximum(s.truth * (1 - s.truth), 1e-3) / s.symbols)
    apart = (s.rate - s.truth).abs()
    by_name = {name: part.rate.to_numpy() for name, part in s.groupby("oscillator")}
    rates = {name: ", ".join(f"{r:.3f}" for r in rows) for name, rows in by_name.items()}
    works = by_name["pll_good"][2] < 0.01, by_name["pll_poor"][1] < 0.01
    delay = s.groupby("oscillator").delay_rate.max()
    f = tables["floors"]
    floors = "; ".join(
        f"{row.front_end} {row.floor_db:.2f} and {row.truth_db:.2f} dB" for row in f.itertuples()
    )
    r = tables["ranges"].set_index("front_end")
    bias = float(r.bias_mm["awr1443"]), float(r.bias_mm["ideal"])
    return (
        say("walk", near, turn=turn, shares=", ".join(f"{v:.3f}" for v in shares.values())),
        say(
            "dpsk",
            bool((apart < 5 * sigma).all()),
            worst=apart.max(),
            most=(apart / sigma).max(),
            symbols=int(s.symbols.min()),
        ),
        say("locked", all(works), any(works), good=rates["pll_good"], poor=rates["pll_poor"]),
        say(
            "delay",
            bool(delay.max() < 0.001),
            bool(delay.drop(f"free {FREE_DBC[0]:g}").max() < 0.001),
            delay=delay.max(),
            ideal=delay["ideal"],
            others=delay.drop(f"free {FREE_DBC[0]:g}").max(),
        ),
        say("floor", bool(((f.floor_db - f.truth_db).abs() < 1).all()), floors=floors),
        say(
            "range",
            abs(bias[0] - bias[1] - 68.4) < 10,
            bias=bias[0],
            ideal=bias[1],
            count=int(r.echoes["awr1443"]),
        ),
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
