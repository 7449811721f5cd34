"""Fig. 10: PT1 estimates and tracks the AT, sees PT2 by its reflection and decodes, frame by frame
at 10 dB."""

from __future__ import annotations

import numpy as np

from isac_rt.studies.paper import tracks
from isac_rt.studies.paper.flight import fly
from isac_rt.studies.paper.outcome import Judgement, Outcome, Progress, Verdict, proportion

FRAMES = 500
QUICK_EVERY = 10
WARM_UP = 3
PRINTED_FRAMES = 10
"""Frames of the run as printed, spread over the flight: PT1 hears nothing in any of them."""


def run(quick: bool, seed: int, progress: Progress) -> Outcome:
    """All 500 frames of the consistent variant, or one in `QUICK_EVERY` over the same time; a few
    as printed."""
    every = QUICK_EVERY if quick else 1
    frames = FRAMES // every
    total = frames + PRINTED_FRAMES
    found = fly("consistent", "PT1", frames, every, seed, lambda k, n: progress(k, total))
    printed = fly(
        "printed",
        "PT1",
        PRINTED_FRAMES,
        FRAMES // PRINTED_FRAMES,
        seed,
        lambda k, n: progress(frames + k, total),
    )
    settings = {
        "quick": quick,
        "seed": seed,
        "frames": frames,
        "every_frames": every,
        "printed_frames": PRINTED_FRAMES,
        "snr_db": 10,
        "scene": "paper_swarm_consistent.yaml; as printed: paper_swarm.yaml",
    }
    tables = {
        "consistent": tracks.table([found], every, ("AT", "PT2")),
        "printed": tracks.table([printed], FRAMES // PRINTED_FRAMES, ("AT", "PT2")),
    }
    grid = tracks.on_grid([found], ("AT",), every, "PT1")
    figure = tracks.figure([found], every, ("AT",), ("AT", "PT2"), (107, 359), grid)
    return Outcome(
        "fig10", "Tracking at PT1", tables, figure, _verdicts(found, printed, every, grid), settings
    )


def _seen(mask: np.ndarray, every: int) -> str:
    """Frames in view as numbers of the whole flight."""
    frames = np.flatnonzero(mask) * every
    return f"{frames.min()} to {frames.max()}" if frames.size else "none"


def _verdicts(found, printed, every: int, grid: tracks.Pairs) -> tuple[Verdict, ...]:
    followed = tracks.followed([found], "AT", WARM_UP)
    heard = int(np.isfinite(printed.sel(uav="AT").detected_range.values).sum())
    wrong, symbols = (found[f"symbol_{name}"].values.sum(axis=0) for name in ("errors", "total"))
    two = found.sel(uav="PT2")
    seen = np.isfinite(two.detected_range.values)
    frames = np.flatnonzero(seen) * every
    tracked: Judgement = (
        "holds under a condition" if followed[0] == followed[1] else "does not hold"
    )
    clean: Judgement = "holds under a condition" if wrong[:2].sum() == 0 else "does not hold"
    return (
        Verdict(
            "The AT stays within PT1's field of view and is tracked",
            tracked,
            f"consistent variant: tracked in {proportion(*followed)} frames after {WARM_UP}; as "
            f"printed heard in {heard} of {PRINTED_FRAMES}, for the AT is behind PT1",
        ),
        Verdict(
            "Data demodulation is achieved",
            clean,
            "consistent variant: delay symbols wrong in "
            f"{proportion(int(wrong[0]), int(symbols[0]))}, DPSK symbols in "
            f"{proportion(int(wrong[1]), int(symbols[1]))}; condition: unmodulated frames first, "
            "fractional decisions, all data phases removed",
        ),
        Verdict(
            "PT2 appears between frames 107 and 359",
            "does not hold",
            f"consistent variant: in view in frames {_seen(two.in_view.values, every)}, detected "
            f"in {seen.sum()} of {int(two.in_view.values.sum())}"
            + (f", frames {frames.min()} to {frames.max()}" if frames.size else "")
            + "; as printed in "
            f"{int(np.isfinite(printed.sel(uav='PT2').detected_range.values).sum())}",
        ),
        tracks.filter_verdict([found], ("AT",), "PT1", grid),
    )
