"""Table II: who sees whom in which of the 500 frames, as printed and in the consistent variant, by
geometry."""

from __future__ import annotations

import numpy as np
import pandas as pd
from matplotlib.figure import Figure

from isac_rt.frame.waveform import waveform_of
from isac_rt.studies.paper.flight import VARIANTS, closing_speed, scenario, span, views
from isac_rt.studies.paper.outcome import Judgement, Outcome, Progress, Verdict, blank, style

_COLOURS = {"printed": "#D55E00", "consistent": "#0072B2"}
Views = dict[str, dict[tuple[str, str], np.ndarray]]


def run(quick: bool, seed: int, progress: Progress) -> Outcome:
    """Fields of view by geometry; nothing is random and `quick` changes nothing."""
    scenes = {variant: scenario(variant) for variant in VARIANTS}
    seen: Views = {}
    for i, (variant, scene) in enumerate(scenes.items()):
        seen[variant] = views(scene)
        progress(i + 1, len(scenes))
    rows = [
        {
            "variant": variant,
            "who": who,
            "whom": whom,
            "frames_in_view": int(mask.sum()),
            "frames": span(mask),
        }
        for variant, table in seen.items()
        for (who, whom), mask in table.items()
    ]
    for variant, table in seen.items():
        joint = table["AT", "PT2"] & table["PT1", "PT2"]
        rows.append(
            {
                "variant": variant,
                "who": "AT and PT1",
                "whom": "PT2",
                "frames_in_view": int(joint.sum()),
                "frames": span(joint),
            }
        )
    speed = {variant: closing_speed(scene, "AT", "PT2") for variant, scene in scenes.items()}
    limit = waveform_of(scenes["printed"]).max_velocity(2)
    settings = {
        "quick": quick,
        "seed": seed,
        "frames": scenes["printed"].frames,
        "counted_at": "middle of a frame",
    }
    return Outcome(
        "table2",
        "Table II",
        {"table2": pd.DataFrame(rows)},
        _figure(seen),
        _verdicts(seen, speed, limit),
        settings,
    )


def _verdicts(
    seen: Views, speed: dict[str, tuple[float, float]], limit: float
) -> tuple[Verdict, ...]:
    printed, mended = seen["printed"], seen["consistent"]

    def judge(as_printed: bool, as_mended: bool) -> Judgement:
        return (
            "holds" if as_printed else "holds under a condition" if as_mended else "does not hold"
        )

    def both(who: str, whom: str) -> str:
        return (
            f"as printed: {span(printed[who, whom])}; consistent variant: {span(mended[who, whom])}"
        )

    first = [
        int(np.argmax(t["AT", "PT2"])) if t["AT", "PT2"].any() else -1 for t in (printed, mended)
    ]
    joint = [t["AT", "PT2"] & t["PT1", "PT2"] for t in (printed, mended)]
    here = [span(j) == "107 to 359" for j in joint]
    return (
        Verdict(
            "PT1 stays in the AT's field of view",
            judge(*(bool(t["AT", "PT1"].all()) for t in (printed, mended))),
            both("AT", "PT1"),
        ),
        Verdict(
            "The AT stays in PT1's field of view",
            judge(*(bool(t["PT1", "AT"].all()) for t in (printed, mended))),
            both("PT1", "AT"),
        ),
        Verdict(
            "PT2 enters the AT's field of view",
            judge(first[0] >= 0, first[1] >= 0),
            both("AT", "PT2"),
        ),
        Verdict(
            "PT2 enters the AT's field of view at about frame 160",
            judge(*(150 <= f <= 170 for f in first)),
            both("AT", "PT2"),
        ),
        Verdict(
            "PT1 has PT2 by way of the AT in frames 107 to 359",
            judge(*here),
            f"as printed: {span(joint[0])}; consistent variant: {span(joint[1])}; 107 also "
            "contradicts the 160 of the AT, whose field of view is needed as well",
        ),
        Verdict(
            "The radial velocities stay unambiguous",
            judge(*(speed[v][1] < limit for v in VARIANTS)),
            "; ".join(
                f"AT to PT2 {v}: {speed[v][0]:.1f} to {speed[v][1]:.1f} m/s" for v in VARIANTS
            )
            + f"; limit {limit:.2f} m/s",
        ),
    )


def _figure(seen: Views) -> Figure:
    """One bar per pair over the frames in which it is seen."""
    with style():
        figure, axes = blank(size=(6.8, 3.4))
        ax, pairs = axes[0, 0], list(seen["printed"])
        for i, pair in enumerate(pairs):
            for offset, (variant, table) in zip((0.18, -0.18), seen.items(), strict=True):
                edges = np.flatnonzero(np.diff(np.concatenate([[0], table[pair].astype(int), [0]])))
                bars = [(a, b - a) for a, b in zip(edges[::2], edges[1::2], strict=True)]
                ax.broken_barh(
                    bars,
                    (-i + offset - 0.15, 0.3),
                    color=_COLOURS[variant],
                    label=variant if i == 0 else None,
                )
        for frame, text in ((160, "160"), (107, "107"), (359, "359")):
            ax.axvline(frame, color="#303030", lw=0.9, ls="--")
            ax.text(frame + 4, 0.62, text, fontsize=8)
        ax.set(
            xlabel="frame (dashed: the paper's 160, 107 and 359)",
            xlim=(0, 500),
            ylim=(-len(pairs) + 0.4, 1.0),
        )
        ax.set_yticks([-i for i in range(len(pairs))], [f"{a} has {b} in view" for a, b in pairs])
        handles, labels = ax.get_legend_handles_labels()
        figure.legend(
            handles, [f"Table II {name}" for name in labels], loc="outside upper center", ncols=2
        )
    return figure
