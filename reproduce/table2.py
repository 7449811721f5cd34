"""Table II: who sees whom in which of the 500 frames, as printed and in the consistent variant, by
geometry."""

from __future__ import annotations

import numpy as np
from matplotlib.figure import Figure

from isac_rt.frame.waveform import waveform_of
from reproduce.flight import VARIANTS, closing_speed, scenario, span, views
from reproduce.outcome import Outcome, Progress, Sentences, Verdict, blank, style, table

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
        (variant, who, whom, int(mask.sum()), span(mask))
        for variant, every in seen.items()
        for (who, whom), mask in every.items()
    ]
    for variant, every in seen.items():
        joint = every["AT", "PT2"] & every["PT1", "PT2"]
        rows.append((variant, "AT and PT1", "PT2", int(joint.sum()), span(joint)))
    speed = {variant: closing_speed(scene, "AT", "PT2") for variant, scene in scenes.items()}
    printed = scenes["printed"]
    limit = waveform_of(printed.radio, printed.array).max_velocity(2)
    settings = {
        "quick": quick,
        "seed": seed,
        "frames": scenes["printed"].frames,
        "counted_at": "middle of a frame",
    }
    tables = {"table2": table("variant who whom frames_in_view frames", rows)}
    verdicts = _verdicts(seen, speed, limit)
    return Outcome("table2", "Table II", tables, _figure(seen), verdicts, settings)


say = Sentences("""
PT1: PT1 stays in the AT's field of view
  {text}

AT: The AT stays in PT1's field of view
  {text}

PT2: PT2 enters the AT's field of view
  {text}

160: PT2 enters the AT's field of view at about frame 160
  {text}

by the AT: PT1 has PT2 by way of the AT in frames 107 to 359
  {text}; 107 also contradicts the 160 of the AT, whose field of view is needed as well

speed: The radial velocities stay unambiguous
  {text}; limit {limit:.2f} m/s
""")


def _verdicts(
    seen: Views, speed: dict[str, tuple[float, float]], limit: float
) -> tuple[Verdict, ...]:
    def both(masks: list[np.ndarray]) -> str:
        return f"as printed: {span(masks[0])}; consistent variant: {span(masks[1])}"

    views = {pair: [every[pair] for every in seen.values()] for pair in seen["printed"]}
    one, back, two = (views[pair] for pair in (("AT", "PT1"), ("PT1", "AT"), ("AT", "PT2")))
    joint = [a & b for a, b in zip(two, views["PT1", "PT2"], strict=True)]
    there = [bool(mask.any()) for mask in two]
    at_160 = [bool(mask.any()) and 150 <= int(np.argmax(mask)) <= 170 for mask in two]
    inside = [speed[v][1] < limit for v in VARIANTS]
    speeds = (f"AT to PT2 {v}: {speed[v][0]:.1f} to {speed[v][1]:.1f} m/s" for v in VARIANTS)
    return (
        say("PT1", *(bool(mask.all()) for mask in one), text=both(one)),
        say("AT", *(bool(mask.all()) for mask in back), text=both(back)),
        say("PT2", *there, text=both(two)),
        say("160", *at_160, text=both(two)),
        say("by the AT", *(span(j) == "107 to 359" for j in joint), text=both(joint)),
        say("speed", *inside, text="; ".join(speeds), limit=limit),
    )


def _figure(seen: Views) -> Figure:
    """One bar per pair over the frames in which it is seen."""
    with style():
        figure, axes = blank(size=(6.8, 3.4))
        ax, pairs = axes[0, 0], list(seen["printed"])
        for i, pair in enumerate(pairs):
            for offset, (variant, masks) in zip((0.18, -0.18), seen.items(), strict=True):
                edges = np.flatnonzero(np.diff(np.concatenate([[0], masks[pair].astype(int), [0]])))
                bars = [(a, b - a) for a, b in zip(edges[::2], edges[1::2], strict=True)]
                label = variant if i == 0 else None
                place = (-i + offset - 0.15, 0.3)
                ax.broken_barh(bars, place, color=_COLOURS[variant], label=label)
        for frame, text in ((160, "160"), (107, "107"), (359, "359")):
            ax.axvline(frame, color="#303030", lw=0.9, ls="--")
            ax.text(frame + 4, 0.62, text, fontsize=8)
        ax.set(xlabel="frame (dashed: the paper's 160, 107 and 359)", xlim=(0, 500))
        ax.set(ylim=(-len(pairs) + 0.4, 1.0))
        ax.set_yticks([-i for i in range(len(pairs))], [f"{a} has {b} in view" for a, b in pairs])
        handles, labels = ax.get_legend_handles_labels()
        figure.legend(
            handles, [f"Table II {name}" for name in labels], loc="outside upper center", ncols=2
        )
    return figure
