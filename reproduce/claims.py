"""Claims of the text that have no figure, each with a number: `isac-rt reproduce claims`.

Their parts: the signal and a late clock (`claims_signal`), antennas (`claims_angle`), compressed
sensing (`claims_recovery`), complexity (`claims_cost`), and what terminals do with one another
(`claims_access`). All but the complexities, which are processor times, repeat from the seed.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from reproduce import claims_access as access
from reproduce import claims_angle, claims_cost
from reproduce import claims_recovery as sensing
from reproduce import claims_signal as signal
from reproduce.montecarlo import Steps
from reproduce.outcome import Outcome, Progress, Verdict, blank, style

Part = tuple[pd.DataFrame | dict[str, pd.DataFrame], tuple[Verdict, ...]]
Parts = list[tuple[str, int, Callable[[Progress], Part]]]


def parts(quick: bool, seed: int) -> Parts:
    """Every part: name of its table, about the seconds of a quick run, and what runs it."""
    size = quick, seed
    return [
        ("model", 1, lambda _: signal.model(seed)),
        ("intervals", 1, lambda _: signal.intervals(seed)),
        ("ambiguities", 1, lambda _: signal.ambiguities(seed)),
        ("angles", 0, lambda _: signal.angles()),
        ("half", 0, lambda _: ({}, (signal.beyond_half(seed),))),
        ("late_clock", 6, lambda report: signal.late_clock(*size, report)),
        ("antennas", 8, lambda report: claims_angle.antennas(*size, report)),
        ("recovery", 10, lambda report: sensing.recovery(*size, report)),
        ("against_coherence", 0, lambda _: sensing.against_coherence(*size)),
        ("fallback", 0, lambda _: sensing.fallback(*size)),
        ("latin", 0, lambda _: sensing.latin(*size)),
        ("cost", 14, lambda report: claims_cost.cost(*size, report)),
        ("blocks", 11, lambda _: access.blocks(*size)),
        ("tolerance", 21, lambda _: access.tolerance(*size)),
        ("sharing", 6, lambda report: access.sharing(*size, report)),
        ("streams", 14, lambda report: access.streams(*size, report)),
        ("stages", 5, lambda report: access.stages(*size, report)),
        ("feedback", 4, lambda report: access.feedback(*size, report)),
    ]


def run(quick: bool, seed: int, progress: Progress) -> Outcome:
    """All claims; `quick` takes fewer frames and schedules."""
    todo = parts(quick, seed)
    steps = Steps(progress, sum(weight for _, weight, _ in todo))
    tables: dict[str, pd.DataFrame] = {}
    verdicts: list[Verdict] = []
    for name, weight, part in todo:
        found, judged = part(steps.part(weight))
        tables |= found if isinstance(found, dict) else {name: found}
        verdicts += judged
    settings = {
        "quick": quick,
        "seed": seed,
        "samples": {name: len(table) for name, table in tables.items()},
        "sizes": "in the tables, beside every count",
    }
    steps.part(0)
    figure = _figure(tables)
    return Outcome("claims", "Claims of the text", tables, figure, tuple(verdicts), settings)


def _figure(tables: dict[str, pd.DataFrame]) -> Figure:
    with style():
        figure, axes = blank(2, 3, size=(13.2, 7.6))
        sensing.draw(axes[0, 0], tables["recovery"])
        _coherence(axes[0, 1], tables["coherence"])
        _late(axes[0, 2], tables["late_clock"])
        access.draw(axes[1, 0], tables["tolerance"])
        _ambiguity(axes[1, 1], tables["ambiguities"])
        claims_cost.draw(axes[1, 2], tables["cost"])
    return figure


def _coherence(ax: Axes, table: pd.DataFrame) -> None:
    ax.hist(table.coherence, bins=30, color="#0072B2")
    ax.axvline(1 / 3, color="#D55E00", ls="--", label="beyond: recovery certain\nfor one tone only")
    ax.set(xlabel="coherence of 40 of 120 chirps", ylabel="schedules", xlim=(0, 0.6))
    ax.set(title="Pseudo-random schedules (round robin: 1)")
    ax.legend(loc="upper left")


def _late(ax: Axes, table: pd.DataFrame) -> None:
    offset = table.clock_offset_ns
    ax.plot(offset, table.range_bias_m, "o-", color="#0072B2", label="range bias [m]")
    ax.set(xlabel="clock offset [ns]", ylabel="range bias [m]", title="A late clock")
    other = ax.twinx()
    for kind, colour in (("delay", "#D55E00"), ("dpsk", "#009E73")):
        rate = table[f"{kind}_errors"] / table[f"{kind}_symbols"]
        other.plot(offset, rate, "s--", color=colour, label=f"SER, {kind}")
    other.set(ylabel="symbol error rate", ylim=(-0.02, 1))
    other.grid(False)
    handles = [h for a in (ax, other) for h in a.get_legend_handles_labels()[0]]
    ax.legend(handles, [str(h.get_label()) for h in handles], loc="upper left")


def _ambiguity(ax: Axes, table: pd.DataFrame) -> None:
    ax.plot(table.L_tx, table.pseudo_random_mps, "o-", color="#0072B2", label="pseudo-random")
    ax.plot(table.L_tx, table.conventional_mps, "s-", color="#D55E00", label="conventional")
    ax.set(xlabel="transmit antennas", title="Velocity of an echo")
    ax.set(ylabel="unambiguous velocity [m/s]", ylim=(0, None))
    ax.set_xticks(np.asarray(table.L_tx))
    ax.legend()
