"""Fig. 10: PT1 estimates and tracks the AT, sees PT2 by its reflection and decodes, frame by frame
at 10 dB."""

from __future__ import annotations

import numpy as np

from reproduce import tracks
from reproduce.flight import fly
from reproduce.outcome import Outcome, Progress, Sentences, Verdict, proportion

FRAMES = 500
QUICK_EVERY = 10
WARM_UP = 3
UAVS = "AT", "PT2"
PRINTED_FRAMES = 10
"""Frames of the run as printed, spread over the flight: PT1 receives nothing in any of them."""


def run(quick: bool, seed: int, progress: Progress) -> Outcome:
    """All 500 frames of the consistent variant, or one in `QUICK_EVERY` over the same time; a few
    as printed."""
    every = QUICK_EVERY if quick else 1
    frames = FRAMES // every
    total = frames + PRINTED_FRAMES
    found = fly("consistent", "PT1", frames, every, seed, lambda k, n: progress(k, total))
    apart = FRAMES // PRINTED_FRAMES

    def report(done: int, _: int) -> None:
        progress(frames + done, total)

    printed = fly("printed", "PT1", PRINTED_FRAMES, apart, seed, report)
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
        "consistent": tracks.table([found], every, UAVS),
        "printed": tracks.table([printed], apart, UAVS),
    }
    grid = tracks.on_grid([found], ("AT",), every, "PT1")
    figure = tracks.figure([found], every, ("AT",), UAVS, (107, 359), grid)
    verdicts = _verdicts(found, printed, every, grid)
    return Outcome("fig10", "Tracking at PT1", tables, figure, verdicts, settings)


def _seen(mask: np.ndarray, every: int) -> str:
    """Frames in view as numbers of the whole flight."""
    frames = np.flatnonzero(mask) * every
    return f"{frames.min()} to {frames.max()}" if frames.size else "none"


say = Sentences("""
tracked: The AT stays within PT1's field of view and is tracked
  consistent variant: tracked in {share} frames after {warm_up}; as printed heard in {heard} of
  {printed}, for the AT is behind PT1

data: Data demodulation is achieved
  consistent variant: delay symbols wrong in {delay}, DPSK symbols in {dpsk}; condition: unmodulated
  frames first, fractional decisions, all data phases removed

appears: PT2 appears between frames 107 and 359
  consistent variant: in view in frames {view}, detected in {seen} of {total}{frames}; as printed in
  {printed}
""")


def _verdicts(found, printed, every: int, grid: tracks.Pairs) -> tuple[Verdict, ...]:
    followed = tracks.followed([found], "AT", WARM_UP)
    heard = {u: int(np.isfinite(printed.sel(uav=u).detected_range.values).sum()) for u in UAVS}
    wrong, symbols = (found[f"symbol_{name}"].values.sum(axis=0) for name in ("errors", "total"))
    two = found.sel(uav="PT2")
    seen, view = np.isfinite(two.detected_range.values), two.in_view.values
    said = {"warm_up": WARM_UP, "heard": heard["AT"], "printed": PRINTED_FRAMES}
    rates = [proportion(int(n), int(of)) for n, of in zip(wrong[:2], symbols[:2], strict=True)]
    where = {"view": _seen(view, every), "seen": seen.sum(), "total": int(view.sum())}
    where["frames"] = f", frames {_seen(seen, every)}" if seen.any() else ""
    clean = wrong[:2].sum() == 0
    return (
        say("tracked", False, followed[0] == followed[1], share=proportion(*followed), **said),
        say("data", False, clean, delay=rates[0], dpsk=rates[1]),
        say("appears", False, **where, printed=heard["PT2"]),
        tracks.filter_verdict([found], ("AT",), "PT1", grid),
    )
