"""Claims of the text that have no figure, each with a number: `isac-rt reproduce claims`.

Their parts: the signal and a late clock (`claims_signal`), antennas (`claims_angle`), compressed
sensing (`claims_recovery`), complexity (`claims_cost`), and what terminals do with one another
(`claims_access`). All but the complexities, which are processor times, repeat from the seed.
"""

from __future__ import annotations

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from isac_rt.studies.paper import (
    claims_access,
    claims_angle,
    claims_cost,
    claims_recovery,
    claims_signal,
)
from isac_rt.studies.paper.outcome import Outcome, Progress, Verdict, blank, style

_WEIGHTS = {
    "signal": 3,
    "late clock": 6,
    "antennas": 8,
    "recovery": 10,
    "cost": 14,
    "blocks": 32,
    "sharing": 6,
    "streams": 14,
    "stages": 5,
    "feedback": 4,
}
"""About the seconds of each part of a quick run: steps of the progress."""


class _Steps:
    """Progress of the parts as that of the whole."""

    def __init__(self, progress: Progress) -> None:
        self._progress, self._done, self._all = progress, 0.0, sum(_WEIGHTS.values())

    def of(self, part: str) -> Progress:
        start = self._done
        self._done += _WEIGHTS[part]

        def report(done: int, total: int) -> None:
            self._progress(round(start + _WEIGHTS[part] * done / total), self._all)

        return report


def run(quick: bool, seed: int, progress: Progress) -> Outcome:
    """All claims; `quick` takes fewer frames and schedules."""
    steps, tables = _Steps(progress), {}
    verdicts: list[Verdict] = []

    def keep(name: str, part: tuple[pd.DataFrame, tuple[Verdict, ...]]) -> None:
        tables[name] = part[0]
        verdicts.extend(part[1])

    report = steps.of("signal")
    for k, (name, one) in enumerate(
        (
            ("model", claims_signal.model),
            ("intervals", claims_signal.intervals),
            ("ambiguities", claims_signal.ambiguities),
        )
    ):
        keep(name, one(seed))
        report(k + 1, 3)
    keep("angles", claims_signal.angles())
    verdicts.append(claims_signal.beyond_half(seed))
    keep("late_clock", claims_signal.late_clock(quick, seed, steps.of("late clock")))
    keep("antennas", claims_angle.antennas(quick, seed, steps.of("antennas")))
    several, found = claims_recovery.recovery(quick, seed, steps.of("recovery"))
    tables |= several
    verdicts.extend(found)
    keep("against_coherence", claims_recovery.against_coherence(quick, seed))
    keep("fallback", claims_recovery.fallback(quick, seed))
    keep("latin", claims_recovery.latin(quick, seed))
    keep("cost", claims_cost.cost(quick, seed, steps.of("cost")))
    report = steps.of("blocks")
    keep("blocks", claims_access.blocks(quick, seed))
    report(1, 3)
    keep("tolerance", claims_access.tolerance(quick, seed))
    report(3, 3)
    for name in ("sharing", "streams", "stages", "feedback"):
        keep(name, getattr(claims_access, name)(quick, seed, steps.of(name)))
    settings = {
        "quick": quick,
        "seed": seed,
        "samples": {name: len(table) for name, table in tables.items()},
        "sizes": "in the tables, beside every count",
    }
    return Outcome(
        "claims", "Claims of the text", tables, _figure(tables), tuple(verdicts), settings
    )


def _figure(tables: dict[str, pd.DataFrame]) -> Figure:
    with style():
        figure, axes = blank(2, 3, size=(13.2, 7.6))
        claims_recovery.draw(axes[0, 0], tables["recovery"])
        _coherence(axes[0, 1], tables["coherence"])
        _late(axes[0, 2], tables["late_clock"])
        claims_access.draw(axes[1, 0], tables["tolerance"])
        _ambiguity(axes[1, 1], tables["ambiguities"])
        claims_cost.draw(axes[1, 2], tables["cost"])
    return figure


def _coherence(ax: Axes, table: pd.DataFrame) -> None:
    ax.hist(table.coherence, bins=30, color="#0072B2")
    ax.axvline(1 / 3, color="#D55E00", ls="--", label="beyond: recovery certain\nfor one tone only")
    ax.set(
        xlabel="coherence of 40 of 120 chirps",
        ylabel="schedules",
        title="Pseudo-random schedules (round robin: 1)",
        xlim=(0, 0.6),
    )
    ax.legend(loc="upper left")


def _late(ax: Axes, table: pd.DataFrame) -> None:
    ax.plot(
        table.clock_offset_ns, table.range_bias_m, "o-", color="#0072B2", label="range bias [m]"
    )
    ax.set(xlabel="clock offset [ns]", ylabel="range bias [m]", title="A late clock")
    other = ax.twinx()
    for kind, colour in (("delay", "#D55E00"), ("dpsk", "#009E73")):
        other.plot(
            table.clock_offset_ns,
            table[f"{kind}_errors"] / table[f"{kind}_symbols"],
            "s--",
            color=colour,
            label=f"SER, {kind}",
        )
    other.set(ylabel="symbol error rate", ylim=(-0.02, 1))
    other.grid(False)
    handles = [h for a in (ax, other) for h in a.get_legend_handles_labels()[0]]
    ax.legend(handles, [str(h.get_label()) for h in handles], loc="upper left")


def _ambiguity(ax: Axes, table: pd.DataFrame) -> None:
    ax.plot(table.L_tx, table.pseudo_random_mps, "o-", color="#0072B2", label="pseudo-random")
    ax.plot(table.L_tx, table.conventional_mps, "s-", color="#D55E00", label="conventional")
    ax.set(
        xlabel="transmit antennas",
        ylabel="unambiguous velocity [m/s]",
        title="Velocity of an echo",
        ylim=(0, None),
    )
    ax.set_xticks(np.asarray(table.L_tx))
    ax.legend()
