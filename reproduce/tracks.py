"""Figs. 9 and 10: the estimates of one terminal over the flight, raw and from the filter, and the
distributions of their errors."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pandas as pd
import xarray as xr
from matplotlib.figure import Figure

from isac_rt.frame.antennas import azimuth_elevation
from isac_rt.frame.waveform import waveform_of
from isac_rt.simulation.setup import swarm_of
from isac_rt.track.filter import (
    Ambiguity,
    Gaussian,
    initiate_all,
    measure,
    measurement_covariance,
    predict,
    update,
)
from reproduce.flight import errors, scenario
from reproduce.outcome import Sentences, Verdict, blank, proportion, style

Pairs = dict[str, tuple[np.ndarray, np.ndarray]]
"""Absolute errors before and after the filter, by quantity."""
ANGLE_STEP_DEG = 0.25
"""Step of the paper's redundant angle dictionary, whose size it does not give."""
SETTLED = 3
"""Detections after which the errors of the filter on the grid are counted."""
UNITS = {"range": "m", "velocity": "m/s", "azimuth": "deg"}
_COLOURS = {"PT1": "#0072B2", "PT2": "#D55E00", "AT": "#009E73"}


def table(runs: Sequence[xr.Dataset], every: int, uavs: Sequence[str]) -> pd.DataFrame:
    """True, detected and tracked values of every frame; angles in degrees."""
    parts = []
    for number, run in enumerate(runs):
        for uav in uavs:
            one = run.sel(uav=uav)
            columns = {
                "run": number,
                "frame": one.frame.values * every,
                "uav": uav,
                "in_view": one.in_view.values,
            }
            for quantity in UNITS:
                scale = 180 / np.pi if quantity == "azimuth" else 1.0
                for group, word in (("truth", "true"), ("detected", "raw"), ("tracked", "ekf")):
                    columns[f"{quantity}_{word}"] = one[f"{group}_{quantity}"].values * scale
            parts.append(pd.DataFrame(columns))
    return pd.concat(parts, ignore_index=True)


def pooled(
    runs: Sequence[xr.Dataset], uavs: Sequence[str], quantity: str
) -> tuple[np.ndarray, np.ndarray]:
    """Absolute errors of all runs, raw and filtered."""
    both = [errors(run, uav, quantity) for run in runs for uav in uavs]
    return np.concatenate([a for a, _ in both]), np.concatenate([b for _, b in both])


def on_grid(runs: Sequence[xr.Dataset], uavs: Sequence[str], every: int, observer: str) -> Pairs:
    """Errors with estimates as coarse as the paper's: detections rounded to range cells, Doppler
    bins and `ANGLE_STEP_DEG`, and an EKF that knows it (cell/sqrt(12)).

    The paper's DFT and OMP choose cells; this program's receivers estimate between them, so that
    their raw errors are a hundredth.
    """
    scene = scenario("consistent")
    acceleration_std = scene.tracking.acceleration_std_mps2
    w, swarm, passes = (
        waveform_of(scene.radio, scene.array),
        swarm_of(scene),
        2 if observer == "AT" else 1,
    )
    step = np.array([w.range_cell(passes), w.velocity_cell(passes), np.deg2rad(ANGLE_STEP_DEG)])
    std = np.append(step, step[2]) / np.sqrt(12)
    out: dict[str, tuple[list[float], list[float]]] = {quantity: ([], []) for quantity in UNITS}
    for run in runs:
        for uav in uavs:
            one, state, count, last = run.sel(uav=uav), None, 0, 0.0
            for k in np.flatnonzero(
                np.isfinite(one.detected_range.values) & np.isfinite(one.detected_azimuth.values)
            ):
                time = (k * every + 0.5) * w.frame_duration
                own = swarm.poses(time)[observer]
                found = np.array([one[f"detected_{quantity}"].values[k] for quantity in UNITS])
                raw = np.round(found / step) * step
                z = np.array([raw[0], raw[1], np.sin(raw[2]), 0.0])
                if state is None:
                    first = z[None], std[None], own
                    states = initiate_all(*first, acceleration_std=acceleration_std)[1]
                    state = next((Gaussian(*of) for of in zip(*states, strict=True)), None)
                else:
                    state = predict(state, time - last, acceleration_std)
                    state = update(
                        state,
                        z,
                        measurement_covariance(std, state.mean),
                        own,
                        ambiguity=Ambiguity.of(w, passes),
                    )
                last, count = time, count + 1
                if state is None or count <= SETTLED:
                    continue
                r, v, u_x, u_z = measure(state.mean, own)
                for i, (quantity, fused) in enumerate(
                    zip(UNITS, (r, v, azimuth_elevation([u_x, u_z])[0]), strict=True)
                ):
                    truth, scale = (
                        float(one[f"truth_{quantity}"].values[k]),
                        180 / np.pi if quantity == "azimuth" else 1.0,
                    )
                    out[quantity][0].append(abs(raw[i] - truth) * scale)
                    out[quantity][1].append(abs(float(fused) - truth) * scale)
    return {quantity: (np.array(a), np.array(b)) for quantity, (a, b) in out.items()}


say = Sentences("""
filter: The EKF shifts the CDFs of the errors at the {terminal} to the left
  estimates on the paper's grids: {grid}; left at every decile: {grid_left}. Estimates between the
  cells, this program's: {refined}; left at every decile: {refined_left} (the filter allows for
  errors of 1 mm, 1 cm/s and 2e-4, which these are below)
""")


def filter_verdict(
    runs: Sequence[xr.Dataset], uavs: Sequence[str], terminal: str, grid: Pairs
) -> Verdict:
    """Whether the distributions of the filter's errors lie to the left of the raw ones, on the
    paper's grids and for refined estimates."""
    refined = {quantity: pooled(runs, uavs, quantity) for quantity in UNITS}
    left = {name: left_of(pairs) for name, pairs in (("grid", grid), ("refined", refined))}
    count = [len(found) for found in left.values()]
    texts = {"grid": _improvement(grid), "refined": _improvement(refined), "terminal": terminal}
    names = {f"{name}_left": ", ".join(found) or "none" for name, found in left.items()}
    return say("filter", min(count) == len(UNITS), max(count) > 0, **texts, **names)


def left_of(pairs: Pairs) -> list[str]:
    """Quantities whose filtered errors have the smaller quantile at every decile."""
    share = np.linspace(0.1, 0.9, 9)
    return [
        q
        for q, (raw, fused) in pairs.items()
        if (np.quantile(fused, share) < np.quantile(raw, share)).all()
    ]


def _improvement(pairs: Pairs) -> str:
    texts = []
    for quantity, (raw, fused) in pairs.items():
        before, after = (float(np.sqrt(np.mean(e**2))) for e in (raw, fused))
        closer = proportion(int((fused < raw).sum()), raw.size)
        texts.append(
            f"{quantity} RMS {before:.2g} raw, {after:.2g} {UNITS[quantity]} filtered, closer in "
            f"{closer}"
        )
    return "; ".join(texts)


def followed(runs: Sequence[xr.Dataset], uav: str, after: int) -> tuple[int, int]:
    """Frames with a track of `uav` within three resolutions, and frames in view, both after the
    first `after` in view."""
    hits = total = 0
    for run in runs:
        one = run.sel(uav=uav)
        seen = np.flatnonzero(one.in_view.values)[after:]
        hits += int(np.isfinite(one.tracked_range.values[seen]).sum())
        total += seen.size
    return hits, total


def figure(
    runs: Sequence[xr.Dataset],
    every: int,
    tracked: Sequence[str],
    shown: Sequence[str],
    marks: Sequence[float],
    grid: Pairs,
) -> Figure:
    """Time series on the left, from the first run; on the right CDFs over all runs of the UAVs that
    are tracked."""
    with style():
        out, axes = blank(3, 2, size=(9.6, 7.4), width_ratios=(1.7, 1))
        for (quantity, unit), (ax, cdf) in zip(UNITS.items(), axes, strict=True):
            _series(ax, runs[0], every, shown, tracked, quantity)
            for mark in marks:
                ax.axvline(mark, color="#303030", lw=0.9, ls="--")
            ax.set(xlabel="frame", ylabel=f"{quantity} [{unit}]", xlim=(0, 500))
            pairs = pooled(runs, tracked, quantity), grid[quantity]
            names = ("True Estimate", "Fused Estimate"), ("paper's grid", "paper's grid, EKF")
            for errors_of, labels, colour in zip(pairs, names, ("k", "#D55E00"), strict=True):
                for e, dash, name in zip(errors_of, ("--", "-"), labels, strict=True):
                    share = np.arange(1, e.size + 1) / e.size
                    cdf.plot(np.sort(e), share, dash, color=colour, label=f"{name} ({e.size})")
            cdf.set(
                xlabel=f"|{quantity} error| [{unit}]", ylabel="CDF", ylim=(0, 1.02), xscale="log"
            )
        handles, labels = (
            a + b for a, b in zip(*(ax.get_legend_handles_labels() for ax in axes[0]), strict=True)
        )
        out.legend(handles, labels, loc="outside upper center", ncols=5, fontsize=7)
    return out


def _series(
    ax, run: xr.Dataset, every: int, shown: Sequence[str], tracked: Sequence[str], quantity: str
) -> None:
    scale, frame = 180 / np.pi if quantity == "azimuth" else 1.0, run.frame.values * every
    for uav in shown:
        one, colour = run.sel(uav=uav), _COLOURS[uav]
        true = np.where(one.in_view.values, one[f"truth_{quantity}"].values * scale, np.nan)
        ax.plot(frame, true, color=colour, lw=1, label=f"{uav}, True Parameter")
        marks = {"detected": ("o", 4, "True Estimate"), "tracked": ("x", 4.5, "Fused Estimate")}
        for group, (mark, size, words) in marks.items():
            if group == "detected" or uav in tracked:
                values = one[f"{group}_{quantity}"].values * scale
                label = f"{uav}, {words}"
                ax.plot(frame, values, mark, mfc="none", color=colour, ms=size, label=label)
