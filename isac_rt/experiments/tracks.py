"""Figs. 9 and 10: the estimates of one terminal over the flight, raw and from the filter, and the distributions of their errors."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pandas as pd
import xarray as xr
from matplotlib.figure import Figure

from isac_rt.experiments.flight import errors
from isac_rt.experiments.outcome import Judgement, Verdict, blank, proportion, style

UNITS = {"range": "m", "velocity": "m/s", "azimuth": "deg"}
_COLOURS = {"PT1": "#0072B2", "PT2": "#D55E00", "AT": "#009E73"}


def table(runs: Sequence[xr.Dataset], every: int, uavs: Sequence[str]) -> pd.DataFrame:
    """True, detected and tracked values of every frame; angles in degrees."""
    parts = []
    for number, run in enumerate(runs):
        for uav in uavs:
            one = run.sel(uav=uav)
            columns = {"run": number, "frame": one.frame.values * every, "uav": uav, "in_view": one.in_view.values}
            for quantity in UNITS:
                scale = 180 / np.pi if quantity == "azimuth" else 1.0
                for group, word in (("truth", "true"), ("detected", "raw"), ("tracked", "ekf")):
                    columns[f"{quantity}_{word}"] = one[f"{group}_{quantity}"].values * scale
            parts.append(pd.DataFrame(columns))
    return pd.concat(parts, ignore_index=True)


def pooled(runs: Sequence[xr.Dataset], uavs: Sequence[str], quantity: str) -> tuple[np.ndarray, np.ndarray]:
    """Absolute errors of all runs, raw and filtered."""
    both = [errors(run, uav, quantity) for run in runs for uav in uavs]
    return np.concatenate([a for a, _ in both]), np.concatenate([b for _, b in both])


def filter_verdict(runs: Sequence[xr.Dataset], uavs: Sequence[str], terminal: str) -> Verdict:
    """Whether the distributions of the filter's errors lie to the left of the raw ones."""
    better, texts = [], []
    for quantity, unit in UNITS.items():
        raw, fused = pooled(runs, uavs, quantity)
        share = np.linspace(0.1, 0.9, 9)
        better.append(bool((np.quantile(fused, share) < np.quantile(raw, share)).all()))
        rms = [float(np.sqrt(np.mean(e**2))) for e in (raw, fused)]
        closer = proportion(int((fused < raw).sum()), raw.size)
        texts.append(f"{quantity} RMS {rms[0]:.2g} raw, {rms[1]:.2g} {unit} filtered, closer in {closer}")
    judged: Judgement = "holds" if all(better) else "holds under a condition" if any(better) else "does not hold"
    condition = "" if all(better) else f" (left at every decile only in {', '.join(q for q, b in zip(UNITS, better, strict=True) if b)})"
    return Verdict(f"The EKF shifts the CDFs of the errors at the {terminal} to the left", judged, "; ".join(texts) + condition)


def followed(runs: Sequence[xr.Dataset], uav: str, after: int) -> tuple[int, int]:
    """Frames with a track of `uav` within three resolutions, and frames in view, both after the first `after` in view."""
    hits = total = 0
    for run in runs:
        one = run.sel(uav=uav)
        seen = np.flatnonzero(one.in_view.values)[after:]
        hits += int(np.isfinite(one.tracked_range.values[seen]).sum())
        total += seen.size
    return hits, total


def figure(runs: Sequence[xr.Dataset], every: int, tracked: Sequence[str], shown: Sequence[str], marks: Sequence[float]) -> Figure:
    """Time series on the left, from the first run; on the right CDFs over all runs of the UAVs that are tracked."""
    with style():
        out, axes = blank(3, 2, size=(9.6, 7.4), width_ratios=(1.7, 1))
        for (quantity, unit), (ax, cdf) in zip(UNITS.items(), axes, strict=True):
            _series(ax, runs[0], every, shown, tracked, quantity)
            for mark in marks:
                ax.axvline(mark, color="#303030", lw=0.9, ls="--")
            ax.set(xlabel="frame", ylabel=f"{quantity} [{unit}]", xlim=(0, 500))
            for e, dash, name in zip(pooled(runs, tracked, quantity), ("--", "-"), ("True Estimate", "Fused Estimate"), strict=True):
                cdf.plot(np.sort(e), np.arange(1, e.size + 1) / e.size, "k" + dash, label=f"{name} ({e.size})")
            cdf.set(xlabel=f"|{quantity} error| [{unit}]", ylabel="CDF", ylim=(0, 1.02), xscale="log")
            cdf.legend(loc="upper left", fontsize=7)
        handles, labels = axes[0, 0].get_legend_handles_labels()
        out.legend(handles, labels, loc="outside upper center", ncols=3, fontsize=7.5)
    return out


def _series(ax, run: xr.Dataset, every: int, shown: Sequence[str], tracked: Sequence[str], quantity: str) -> None:
    scale, frame = 180 / np.pi if quantity == "azimuth" else 1.0, run.frame.values * every
    for uav in shown:
        one, colour = run.sel(uav=uav), _COLOURS[uav]
        seen = one.in_view.values
        ax.plot(frame, np.where(seen, one[f"truth_{quantity}"].values * scale, np.nan), color=colour, lw=1, label=f"{uav}, True Parameter")
        ax.plot(frame, one[f"detected_{quantity}"].values * scale, "o", mfc="none", color=colour, ms=4, label=f"{uav}, True Estimate")
        if uav in tracked:
            ax.plot(frame, one[f"tracked_{quantity}"].values * scale, "x", color=colour, ms=4.5, label=f"{uav}, Fused Estimate")
