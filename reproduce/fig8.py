"""Fig. 8: velocity by OMP from pseudo-random pulses and by FFT from conventional ones, in a
target's range cell after the range transform.

One antenna has P/L_tx = 40 of the 120 slots. Conventional TDM takes every third, which folds
velocities beyond a third of the range; pseudo-random TDM one at random of every three, with 120
hypotheses. The paper does not say how many pulses either curve has: here both have 40, and beside
it OMP has all 120 slots. With one path and one atom OMP is the strongest correlation.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial

import numpy as np
import pandas as pd
from matplotlib.figure import Figure

from isac_rt.frame.schedule import pseudo_random_schedule
from isac_rt.randomness import generator
from isac_rt.receive.omp import omp
from reproduce.fig12 import draw_rate
from reproduce.montecarlo import INTERVAL, Counts, Curve, Precision, Steps, sample
from reproduce.outcome import Outcome, Progress, Sentences, Verdict, blank, style
from reproduce.symbols import decibels

PULSES, SLOTS = 40, 120
SNR_DB = np.arange(-28.0, 3.0, 2.0)
VECTORS = 50
"""Velocities in one trial."""


@dataclass(frozen=True)
class Curves:
    """`span`: share of the velocity range in use (1/3 is the FFT's own); `pulses` that OMP has;
    channels summed in power."""

    name: str
    span: float
    pulses: int
    off_grid: bool
    channels: int = 1


CASES = (
    Curves("40 pulses each, FFT's range", 1 / 3, 40, False),
    Curves("40 pulses each, FFT's range, off the grid", 1 / 3, 40, True),
    Curves("40 pulses each, full range", 1.0, 40, False),
    Curves("OMP with 120 pulses, FFT's range", 1 / 3, 120, False),
    Curves("OMP with 120 pulses, FFT's range, off the grid", 1 / 3, 120, True),
    Curves("40 pulses each, 45 channels", 1 / 3, 40, False, 45),
)


def run(quick: bool, seed: int, progress: Progress) -> Outcome:
    """Batches of 50 velocities until every 95 % interval is small enough; `quick` stops at 20
    batches (4 for 45 channels)."""
    steps = Steps(progress, sum(_limit(case, quick) for case in CASES))
    curves: dict[str, Curve] = {}
    for case in CASES:
        precision = Precision(_limit(case, quick), absolute=0.02 if quick else 0.005)
        part = steps.part(precision.limit)
        got = sample(partial(hits, case, seed), SNR_DB, precision, part, key=f"{seed} {case}")
        curves |= {f"{case.name}: {name}": c for name, c in got.items()}
    found = pd.concat([c.table().assign(curve=name) for name, c in curves.items()])
    settings = {
        "quick": quick,
        "seed": seed,
        "trials": {name: VECTORS * len(c.events) for name, c in curves.items()},
        "stop": f"{precision.text} or the limit of batches",
        "interval": INTERVAL,
        "snr": "per pulse after the range transform; 30.1 dB less per IF sample",
        "hit": "velocity error below one Doppler bin",
    }
    tables, figure = {"fig8": found}, _figure(curves)
    return Outcome(
        "fig8", "Velocity by OMP and by FFT", tables, figure, _verdicts(curves), settings
    )


def _limit(case: Curves, quick: bool) -> int:
    return (20 if quick else 200) // (5 if case.channels > 1 else 1)


def hits(case: Curves, seed: int, index: int) -> Counts:
    """How many of VECTORS velocities OMP and FFT find, at every SNR."""
    rng = generator(seed, "fig8", case.name, index)
    bins = rng.uniform(-0.5, 0.5, VECTORS) * (SLOTS * case.span - 1)
    bins = bins if case.off_grid else np.round(bins)
    chosen = (
        np.flatnonzero(pseudo_random_schedule(1, SLOTS, 3, rng)[0] == 0)
        if case.pulses == PULSES
        else np.arange(SLOTS)
    )
    regular = np.arange(0, SLOTS, 3)
    phases = np.exp(2j * np.pi * rng.random((VECTORS, case.channels, 1)))
    noise = (rng.standard_normal((VECTORS, case.channels, SLOTS, 2)) / np.sqrt(2)).view(complex)[
        ..., 0
    ]
    signal = phases * np.exp(2j * np.pi * bins[:, None, None] * np.arange(SLOTS) / SLOTS)
    found: dict[str, list[int]] = {"OMP": [], "FFT": []}
    for level in 10 ** (-SNR_DB / 20):
        samples = signal + level * noise
        sparse = omp(samples[..., chosen].reshape(-1, chosen.size), chosen, SLOTS, 1)
        found["OMP"].append(_count(sparse.reshape(VECTORS, case.channels, SLOTS), bins))
        found["FFT"].append(_count(np.fft.fft(samples[..., regular], axis=-1), bins))
    return {name: (np.array(n), VECTORS) for name, n in found.items()}


def _count(spectra: np.ndarray, bins: np.ndarray) -> int:
    """How many of (V, channels, bins) spectra in FFT order have their strongest summed power within
    a bin of the truth."""
    size = spectra.shape[-1]
    best = np.fft.fftfreq(size, 1 / size)[(np.abs(spectra) ** 2).sum(axis=1).argmax(axis=1)]
    # bins of 40 and of 120 slots are equally wide; an estimate that folds is wrong
    return int((np.abs(best - bins) < 1).sum())


def _figure(curves: dict[str, Curve]) -> Figure:
    with style():
        figure, axes = blank(2, 3, size=(11, 6.2), sharex=True, sharey=True)
        for ax, case in zip(axes.ravel(), CASES, strict=True):
            draw_rate(ax, curves[f"{case.name}: FFT"], "s--", "C0", "FFT")
            draw_rate(ax, curves[f"{case.name}: OMP"], "o-", "C1", "OMP")
            ax.set(title=case.name, ylim=(0, 1.03), xlim=(SNR_DB[0], SNR_DB[-1]))
            ax.legend(loc="upper left")
        for ax in axes[-1]:
            ax.set_xlabel("SNR per pulse after the range transform [dB]")
        for ax in axes[:, 0]:
            ax.set_ylabel("velocity found")
    return figure


def advantage(curves: dict[str, Curve], case: str) -> tuple[np.ndarray, np.ndarray]:
    """SNR points where OMP's interval lies above the FFT's, and below."""
    omp_, fft = curves[f"{case}: OMP"].table(), curves[f"{case}: FFT"].table()
    return SNR_DB[(omp_.low > fft.high).to_numpy()], SNR_DB[(fft.low > omp_.high).to_numpy()]


say = Sentences("""
crossing: At low SNR OMP finds the velocity less often than the FFT, at moderate SNR more often, at
high SNR both find it
  40 pulses each, in the FFT's range and on its grid: half are found at {omp} (OMP) and {fft} (FFT);
  OMP is better beyond the intervals at {equal[0]}, worse at {equal[1]}. With all 120 pulses OMP
  needs {more_omp}: better at {more[0]}, worse at {more[1]}. Velocities over the full range: better
  at {wide[0]}, worse at {wide[1]}; there the FFT folds and ends at 1/3

range: Pseudo-random pulses keep the full velocity range
  velocities over the full range at {snr:g} dB: OMP {full[0]}, FFT {full[1]}
""")


def _verdicts(curves: dict[str, Curve]) -> tuple[Verdict, ...]:
    equal, wide, more = (CASES[i].name for i in (0, 2, 3))
    better = {name: advantage(curves, name) for name in (equal, wide, more)}
    crosses = all(points.size for points in better[equal])
    words = {name: [_list(points) for points in both] for name, both in better.items()}
    half = [f"{equal}: OMP", f"{equal}: FFT", f"{more}: OMP"]
    omp_, fft, more_omp = (decibels(curves[name].threshold(0.5)) for name in half)
    found = {"omp": omp_, "fft": fft, "more_omp": more_omp}
    parts = {"equal": words[equal], "more": words[more], "wide": words[wide]}
    full = [curves[f"{wide}: {name}"].text(SNR_DB[-1]) for name in ("OMP", "FFT")]
    return (
        say("crossing", crosses, **found, **parts),
        say("range", bool(better[wide][0].size), snr=SNR_DB[-1], full=full),
    )


def _list(points: np.ndarray) -> str:
    return f"{points[0]:g} to {points[-1]:g} dB" if points.size else "no SNR"
