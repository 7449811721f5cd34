"""Fig. 11: error rate of the DPSK symbols against SNR, on the link AT -> PT1 of Table II at rest,
and mmWave-LoRadar's."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pandas as pd
from matplotlib.figure import Figure

from isac_rt.frame.payload import MODULATION_ORDERS
from isac_rt.randomness import generator
from isac_rt.receive.clutter_filter import RUN_CELLS
from reproduce.baselines import LoRadar, loradar_symbol_errors
from reproduce.fig12 import SNR_DB, clutter_verdict, draw_rate
from reproduce.montecarlo import (
    INTERVAL,
    Counts,
    Curve,
    Precision,
    Steps,
    dpsk_error_rate,
    sample,
)
from reproduce.outcome import Outcome, Progress, Sentences, Verdict, blank, style
from reproduce.symbols import (
    PREDICTION_ERROR,
    Setting,
    decibels,
    difference,
    link_waveform,
    run_link,
)

_LONG, _SHORT = link_waveform(1024), link_waveform(512)
LEVEL = 0.1
"""Error rate at which curves are compared."""
LORADAR_SNR_DB = np.arange(-28.0, -19.0)
LORADAR_BATCH = 8


def links() -> tuple[Setting, ...]:
    """The paper's curves, those by its letter, and the clutter with and without knowledge of its
    profile."""
    return (
        Setting(name="T = 51.2 us", waveform=_LONG, orders=MODULATION_ORDERS),
        Setting(name="letter", waveform=_LONG, orders=(8,), literal=True),
        Setting(name="T = 25.6 us", waveform=_SHORT, orders=(8,)),
        Setting(
            name="exact prediction", waveform=_LONG, orders=MODULATION_ORDERS, exact_prediction=True
        ),
        Setting(name="clutter", waveform=_LONG, orders=(8,), clutter=True),
        Setting(
            name="clutter, filtered",
            waveform=_LONG,
            orders=(8,),
            clutter=True,
            run_cells=RUN_CELLS,
        ),
        Setting(
            name="clutter, profile known", waveform=_LONG, orders=(8,), clutter=True, profile=True
        ),
    )


def run(quick: bool, seed: int, progress: Progress) -> Outcome:
    """Frames of one group (117 symbols) until every 95 % interval is small enough; `quick` stops at
    16 frames a curve."""
    precision = Precision(16) if quick else Precision(100, absolute=0.001)
    all_links = links()
    steps = Steps(progress, precision.limit * (len(all_links) + 1))
    curves: dict[str, Curve] = {}
    for link in all_links:
        for name, curve in run_link(
            link, SNR_DB, precision, seed, steps.part(precision.limit)
        ).items():
            if name.startswith("dpsk"):
                curves[f"{link.name}: {name.removeprefix('dpsk ')}"] = curve
    batches = replace(precision, limit=precision.limit // (2 if quick else 1))
    loradar = sample(
        lambda i: _loradar(seed, i),
        LORADAR_SNR_DB,
        batches,
        steps.part(batches.limit),
        key=f"{seed} LoRadar",
    )
    curves["mmWave-LoRadar"] = loradar["mmWave-LoRadar"]
    progress(precision.limit * (len(all_links) + 1), precision.limit * (len(all_links) + 1))
    theory = {d: dpsk_error_rate(SNR_DB, 1024, d, 15) for d in MODULATION_ORDERS}
    lines = [c.table().assign(curve=name) for name, c in curves.items()]
    lines += [
        pd.DataFrame({"curve": f"theory, D = {d}, known delay", "snr_db": SNR_DB, "rate": p})
        for d, p in theory.items()
    ]
    settings = {
        "quick": quick,
        "seed": seed,
        "frames": {name: len(c.events) for name, c in curves.items()},
        "symbols_per_frame": 117,
        "loradar_symbols_per_batch": LORADAR_BATCH,
        "snr": "per complex IF sample and receive antenna, line of sight, before processing",
        "stop": f"{precision.text} or {precision.limit} frames",
        "interval": INTERVAL,
        "prediction_error": PREDICTION_ERROR,
    }
    tables, figure = {"fig11": pd.concat(lines)}, _figure(curves, theory)
    return Outcome("fig11", "DPSK symbol error rate", tables, figure, _verdicts(curves), settings)


def _loradar(seed: int, index: int) -> Counts:
    """LORADAR_BATCH symbols at every SNR: the delay known, one path, as the baseline assumes."""
    system = LoRadar(_LONG)
    wrong = [
        loradar_symbol_errors(
            snr, LORADAR_BATCH, generator(seed, "loradar", index, repr(float(snr))), system
        ).sum()
        for snr in LORADAR_SNR_DB
    ]
    return {"mmWave-LoRadar": (np.array(wrong), LORADAR_BATCH)}


_LOOKS = {
    "T = 25.6 us: 8": ("v--", "C4", "D = 8, T = 25.6 us"),
    "clutter, profile known: 8": ("P-.", "C5", "D = 8, clutter, its profile known"),
    "clutter, filtered: 8": ("+:", "C8", "D = 8, clutter, the paper's filter"),
    "clutter: 8": ("x:", "C6", "D = 8, clutter, line of sight tracked alone"),
    "letter: 8 literal": ("1:", "C7", "D = 8, data phases left in (as printed)"),
    "mmWave-LoRadar": ("*--", "k", "mmWave-LoRadar"),
}


def _figure(curves: dict[str, Curve], theory: dict[int, np.ndarray]) -> Figure:
    with style():
        figure, axes = blank(1, 2, size=(10.5, 4.8), sharey=True)
        left, right = axes[0]
        for i, (d, mark) in enumerate(zip(MODULATION_ORDERS, "osD^", strict=True)):
            long, colour = f"T = 51.2 us: {d}", f"C{i}"
            exact = curves[f"exact prediction: {d} known delay"]
            within = f"D = {d}, velocity within 0.25 m/s"
            draw_rate(left, curves[long], mark + "-", colour, f"D = {d}, T = 51.2 us")
            draw_rate(right, exact, mark, colour, f"D = {d}, velocity exact")
            draw_rate(right, curves[f"{long} known delay"], mark + ":", colour, within)
            right.plot(SNR_DB, theory[d], color=colour, lw=0.9, label=f"theory, D = {d}")
        for name, (look, colour, label) in _LOOKS.items():
            draw_rate(left, curves[name], look, colour, label)
        left.set(
            ylabel="DPSK symbol error rate", yscale="log", ylim=(3e-4, 1.5), title="end to end"
        )
        right.set(title="delay symbols known")
        for ax in (left, right):
            ax.set(xlabel="SNR per sample and antenna [dB]", xlim=(-36, -18))
        left.legend(fontsize=6.5, loc="lower left")
        right.legend(fontsize=6.5, loc="upper center", bbox_to_anchor=(0.5, -0.14), ncols=3)
    return figure


say = Sentences("""
floor: At very low SNR the SER levels off at a value that depends on D
  at -36 dB {floor} by guessing

orders: For T = 51.2 us the SER grows with D
  SER {level} at {levels}; at -26 dB {rates}

short: A smaller T raises the SER
  D = 8, T = 25.6 us (all times halved): SER {level} comes {later} later

loradar: For D <= 16 mmWave-LoRadar's SER is worse
  for D in {better}; SER {level} of LoRadar (delay and timing known) comes at {radar}, after DPSK by
  {finding}

bits: A frame carries 4293 bits against LoRadar's 1800
  {bits} with D = 8 and M = 3; {others}

printed: The detector as printed decides the symbols
  without compensating the data's phases (and with the conjugate it lacks) the SER is {rate} at -18
  dB, guessing
""")


def _verdicts(curves: dict[str, Curve]) -> tuple[Verdict, ...]:
    long = {d: curves[f"T = 51.2 us: {d}"] for d in MODULATION_ORDERS}
    passes = {d: c.threshold(LEVEL) for d, c in long.items()}
    levels = "; ".join(f"D = {d}: {decibels(p)}" for d, p in passes.items())
    rates = "; ".join(f"D = {d}: {c.text(-26)}" for d, c in long.items())
    rising = all(passes[a][0] <= passes[b][0] for a, b in ((2, 4), (4, 8), (8, 16)))
    rising &= passes[2][2] < passes[8][1] and passes[8][2] < passes[16][1]
    floor = "; ".join(f"D = {d}: {c.text(-36)} against {1 - 1 / d:.4f}" for d, c in long.items())
    later = difference(curves["T = 25.6 us: 8"], long[8], LEVEL)
    radar = curves["mmWave-LoRadar"]
    apart = {d: difference(radar, c, LEVEL) for d, c in long.items()}
    better = [d for d in MODULATION_ORDERS if apart[d][1] > 0]
    finding = "; ".join(f"D = {d}: {decibels(a)}" for d, a in apart.items())
    bits, others = replace(_LONG, num_groups=3).bits_per_frame(8), LoRadar(_LONG).bits_per_frame
    half = {"radar": decibels(radar.threshold(LEVEL)), "finding": finding, "level": LEVEL}
    return (
        say("floor", True, floor=floor),
        say("orders", rising, level=LEVEL, levels=levels, rates=rates),
        say("short", later[1] > 0, level=LEVEL, later=decibels(later)),
        clutter_verdict("dpsk clutter", long[8], curves, ": 8"),
        say("loradar", len(better) == 4, len(better) > 0, better=better, **half),
        say("bits", (bits, others) == (4293, 1800), bits=bits, others=others),
        say("printed", False, rate=curves["letter: 8 literal"].text(-18)),
    )
