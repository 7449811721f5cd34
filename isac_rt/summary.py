"""The numbers of `summary.json`, from the labelled arrays of a run."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import xarray as xr

from isac_rt.results import KINDS, MEASURES, SYMBOLS, TIMINGS, versions
from isac_rt.scenario import Scenario


def summarize(dataset: xr.Dataset, scenario: Scenario, timing: Mapping[str, float], fidelity: Mapping[str, Any]) -> dict[str, Any]:
    """The summary of a run under its fixed keys; null stands for what does not apply.

    A terminal's figures pool its links. SER and BER count every symbol sent to a terminal while data mode is on; undecoded ones
    are errors and `erased` is their share of the symbols. `bit_rate_bps` is the rate of rightly received bits over the whole run.
    `hit_rate` is the share of UAVs in view and unshadowed that a detection is associated with; `matched` (`matched_tracked`) is
    the share of all UAV-frames over which `rmse` (`rmse_tracked`) is taken; `false_per_frame` counts detections that no path explains.
    """
    observers = [str(o) for o in dataset.observer.values]
    senders = [str(t) for t in dataset.transmitter.values]
    roles = {name: uav.role for name, uav in scenario.swarm.items()}
    of_terminal = {name: [i for i, o in enumerate(observers) if o == name] for name in dict.fromkeys(observers)}
    links = {f"{senders[i]}->{o}": [i] for i, o in enumerate(observers) if senders[i]}
    return {
        "scenario": scenario.name,
        "seed": scenario.seed,
        "frames": int(dataset.sizes["frame"]),
        "terminals": {name: _figures(dataset, columns, name, roles[name]) for name, columns in of_terminal.items()},
        "links": {name: _figures(dataset, c, observers[c[0]], roles[observers[c[0]]]) for name, c in links.items()},
        "paths": {kind: int(n) for kind, n in zip(KINDS, dataset.path_count.sum(("frame", "observer")).values, strict=True)},
        "timing_s": {key: float(timing[key]) if key in timing else None for key in TIMINGS},
        "fidelity": dict(fidelity),
        "versions": versions(),
    }


def _figures(dataset: xr.Dataset, columns: Sequence[int], name: str, role: str) -> dict[str, Any]:
    """Figures of a terminal or a link: `columns` are its positions along the dimension observer."""
    d = dataset.isel(observer=list(columns))
    errors, erased, total = (dict(zip(SYMBOLS, d[f"symbol_{k}"].sum(("frame", "observer")).values.tolist(), strict=True))
                             for k in ("errors", "erased", "total"))  # fmt: skip
    symbols = total["delay"] + total["dpsk"]
    duration = d.sizes["frame"] * float(dataset.attrs["frame_interval_s"])
    others = d.isel(uav=[i for i, u in enumerate(d.uav.values) if u != name])
    visible = (others.in_view & ~others.shadowed & others.processed).values
    possible = int((others.processed & (others.truth_range > 0)).sum())
    hit, followed = (np.isfinite(others[f"{group}_range"].values) for group in ("detected", "tracked"))
    return {
        "role": role,
        "ser_dpsk": _ratio(errors["dpsk"], total["dpsk"]),
        "ser_delay": _ratio(errors["delay"], total["delay"]),
        "ber": _ratio(errors["bit"], total["bit"]),
        "erased": _ratio(erased["delay"] + erased["dpsk"], symbols),
        "bits": total["bit"] or None,
        "bit_rate_bps": (total["bit"] - errors["bit"]) / duration if total["bit"] else None,
        "hit_rate": _ratio(int((hit & visible).sum()), int(visible.sum())),
        "matched": _ratio(int(hit.sum()), possible),
        "matched_tracked": _ratio(int(followed.sum()), possible),
        "false_per_frame": _ratio(int(d.num_false.sum()), int(d.processed.sum())),
        "rmse": rmse(others, "detected"),
        "rmse_tracked": rmse(others, "tracked"),
    }


def rmse(dataset: xr.Dataset, group: str) -> dict[str, float | None]:
    """Root mean square errors of the "detected" or "tracked" values over all that were associated; angles in degrees."""
    out: dict[str, float | None] = {}
    for name, (units, key) in MEASURES.items():
        e = errors_of(dataset, group, name)
        e = e[np.isfinite(e)]
        value = float(np.sqrt(np.mean(e**2))) if e.size else None
        out[key] = float(np.rad2deg(value)) if value is not None and units == "rad" else value
    return out


def errors_of(dataset: xr.Dataset, group: str, name: str) -> np.ndarray:
    """Estimate less truth (frame, observer, uav), NaN where none; angles [rad] wrapped to (-pi, pi]."""
    e = (dataset[f"{group}_{name}"] - dataset[f"truth_{name}"]).values
    return np.angle(np.exp(1j * e)) if MEASURES[name][0] == "rad" else e


def _ratio(part: int, whole: int) -> float | None:
    return part / whole if whole else None
