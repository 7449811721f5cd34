"""Fig. 12: error rate of the delay symbols against SNR, on the link AT -> PT1 of Table II at
rest."""

from __future__ import annotations

import numpy as np
import pandas as pd
from matplotlib.figure import Figure
from scipy import stats

from isac_rt.frame.payload import MODULATION_ORDERS
from isac_rt.receive.clutter_filter import RUN_CELLS
from isac_rt.receive.symbols import EXTRA_CELLS
from reproduce.montecarlo import INTERVAL, Curve, Precision, Steps, delay_error_rate
from reproduce.outcome import (
    Outcome,
    Progress,
    Sentences,
    Verdict,
    blank,
    proportion,
    style,
)
from reproduce.symbols import (
    PREDICTION_ERROR,
    Setting,
    decibels,
    difference,
    link_waveform,
    run_link,
)

SNR_DB = np.array(
    [-36, -34, -33, -32, -31, -30, -29, -28, -27, -26, -25, -24, -23, -22, -20, -18.0]
)
_LONG, _SHORT = link_waveform(1024), link_waveform(512)


def links() -> tuple[Setting, ...]:
    """Orders have draws of their own; the paper's letter is followed at the fixed and at a random
    fraction of a cell."""
    return (
        *(Setting(name=f"D = {d}", waveform=_LONG, literal=d == 8) for d in MODULATION_ORDERS),
        Setting(name="random fraction", waveform=_LONG, random_fraction=True, literal=True),
        Setting(name="exact prediction", waveform=_LONG, exact_prediction=True),
        Setting(name="T = 25.6 us", waveform=_SHORT),
        Setting(name="clutter", waveform=_LONG, clutter=True),
        Setting(
            name="clutter, filtered",
            waveform=_LONG,
            clutter=True,
            run_cells=RUN_CELLS,
        ),
        Setting(name="clutter, profile known", waveform=_LONG, clutter=True, profile=True),
    )


def theory() -> dict[str, np.ndarray]:
    """Closed forms for an exact prediction; the search runs past the alphabet on both sides."""
    sizes = {"51.2 us": _LONG, "25.6 us": _SHORT}
    return {
        t: delay_error_rate(SNR_DB, w.num_samples, w.num_delay_symbols + 2 * EXTRA_CELLS, 15)
        for t, w in sizes.items()
    }


def run(quick: bool, seed: int, progress: Progress) -> Outcome:
    """Frames of one group (120 symbols) until every 95 % interval is small enough; `quick` stops at
    16 frames a curve."""
    precision = Precision(16) if quick else Precision(100, absolute=0.001)
    all_links = links()
    steps = Steps(progress, precision.limit * len(all_links))
    curves: dict[str, Curve] = {}
    for link in all_links:
        for name, curve in run_link(
            link, SNR_DB, precision, seed, steps.part(precision.limit)
        ).items():
            curves[link.name if name == "delay" else f"{link.name}, {name.split()[1]}"] = curve
    progress(precision.limit * len(all_links), precision.limit * len(all_links))
    closed = theory()
    lines = [c.table().assign(curve=name) for name, c in curves.items()]
    lines += [
        pd.DataFrame({"curve": f"theory, exact prediction, T = {t}", "snr_db": SNR_DB, "rate": p})
        for t, p in closed.items()
    ]
    settings = {
        "quick": quick,
        "seed": seed,
        "frames": {name: len(c.events) for name, c in curves.items()},
        "symbols_per_frame": 120,
        "snr": "per complex IF sample and receive antenna, line of sight, before processing",
        "interval": INTERVAL,
        "stop": f"{precision.text} or {precision.limit} frames",
        "prediction_error": PREDICTION_ERROR,
    }
    tables, figure = {"fig12": pd.concat(lines)}, _figure(curves, closed)
    verdicts = _verdicts(curves)
    return Outcome("fig12", "Delay symbol error rate", tables, figure, verdicts, settings)


_LOOKS = {
    "D = 2": ("o-", "D = 2, T = 51.2 us"),
    "D = 4": ("s-", "D = 4, T = 51.2 us"),
    "D = 8": ("D-", "D = 8, T = 51.2 us"),
    "D = 16": ("^-", "D = 16, T = 51.2 us"),
    "T = 25.6 us": ("v--", "D = 8, T = 25.6 us"),
    "clutter": ("x:", "clutter, line of sight tracked alone"),
    "clutter, filtered": ("+:", "clutter, the paper's filter"),
    "clutter, profile known": ("P-.", "clutter, its profile known"),
    "D = 8, floor": ("1:", "printed rule: floor"),
    "D = 8, round": ("2:", "rounded instead"),
    "random fraction, floor": ("3--", "floor, random fraction of a cell"),
    "random fraction, round": ("4--", "rounded, random fraction of a cell"),
}


def _figure(curves: dict[str, Curve], closed: dict[str, np.ndarray]) -> Figure:
    with style():
        figure, axes = blank(size=(8.6, 5.0))
        ax = axes[0, 0]
        for p, label in zip(closed.values(), ("theory, exact prediction", None), strict=True):
            ax.plot(SNR_DB, p, color="k", lw=0.9, label=label)
        for i, (name, (look, label)) in enumerate(_LOOKS.items()):
            draw_rate(ax, curves[name], look, f"C{i % 10}", label)
        ax.set(xlabel="SNR per sample and antenna [dB]", xlim=(-36, -18))
        ax.set(ylabel="delay symbol error rate", yscale="log", ylim=(3e-4, 1.5))
        ax.legend(fontsize=7, loc="center left", bbox_to_anchor=(1.0, 0.5))
    return figure


def draw_rate(ax, curve: Curve, look: str, colour: str, label: str, zeros: bool = False) -> None:
    """A rate with its intervals; `zeros`: points without events too, which a logarithmic axis
    cannot show."""
    t = curve.table()
    t = t if zeros else t[t.events > 0]
    ends = [t.rate - t.low, t.high - t.rate]
    look_of = {"fmt": look, "color": colour, "label": label}
    ax.errorbar(t.snr_db, t.rate, ends, **look_of, capsize=1.5, elinewidth=0.6)


say = Sentences("""
orders: For T = 51.2 us the SER remains largely unchanged as D grows
  at -30 dB {rates}; equal with p = {chance:.2f}. Exactly so: turning a chirp leaves every power as
  it was

short: With T = 25.6 us the SER is higher, as the time-bandwidth product is smaller
  SER 0.5 at {long} (51.2 us) and {short} (25.6 us, all times halved): {later} later; at -25 dB
  {rate} with 51.2 us

floor: The symbol is floor(peak - prediction)
  with the prediction's fraction kept, at a random fraction of a cell, {floor} fail at -18 dB;
  derotating by the prediction first, {derotated}

dpsk clutter: With urban clutter a higher SNR is needed, and at high SNR the system is still robust
  at -18 dB {shown} fail, without clutter {without}. SER {level} at {known} with the profile,
  {filtered} with the filter and {plain} without clutter

delay clutter: Urban clutter degrades the delay demodulation to a certain degree
  at -18 dB {shown} fail, without clutter {without}. SER {level} at {known} with the profile,
  {filtered} with the filter and {plain} without clutter
""")


def _verdicts(curves: dict[str, Curve]) -> tuple[Verdict, ...]:
    eight, short = curves["D = 8"], curves["T = 25.6 us"]
    counts = [curves[f"D = {d}"].at(-30) for d in MODULATION_ORDERS]
    chance = stats.chi2_contingency([[k, n - k] for k, n in counts]).pvalue
    rates = "; ".join(
        f"D = {d}: {proportion(*c)}" for d, c in zip(MODULATION_ORDERS, counts, strict=True)
    )
    later = difference(short, eight, 0.5)
    half = {"long": decibels(eight.threshold(0.5)), "short": decibels(short.threshold(0.5))}
    rounded = {"floor": curves["random fraction, floor"], "derotated": curves["random fraction"]}
    return (
        say("orders", bool(chance > 0.01), rates=rates, chance=chance),
        say("short", later[1] > 0, **half, later=decibels(later), rate=eight.text(-25)),
        clutter_verdict("delay clutter", eight, curves),
        say("floor", False, **{name: c.text(-18) for name, c in rounded.items()}),
    )


def clutter_verdict(
    claim: str, without: Curve, curves: dict[str, Curve], suffix: str = "", level: float = 0.1
) -> Verdict:
    """Robust if a tenth at most fails at -18 dB without knowledge of the clutter, with or without
    the filter; else under a condition."""
    kinds = {
        "nothing known": "",
        "the filter": ", filtered",
        "its profile known": ", profile known",
    }
    cases = {name: curves[f"clutter{kind}{suffix}"] for name, kind in kinds.items()}
    alone, filtered, known = (c.at(-18)[0] / c.at(-18)[1] <= level for c in cases.values())
    at = {"known": "its profile known", "filtered": "the filter"}
    passes = {name: decibels(cases[which].threshold(level)) for name, which in at.items()}
    passes["plain"] = decibels(without.threshold(level))
    shown = "; ".join(f"with {name} {c.text(-18)}" for name, c in cases.items())
    texts = {"shown": shown, "without": without.text(-18), "level": level}
    return say(claim, alone or filtered, known, **texts, **passes)
