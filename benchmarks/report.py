"""Tables and figures of the benchmarks: speed against error, and cost against size with its
growth."""

from __future__ import annotations

import importlib
import importlib.util
import json
import os
import platform
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks import STAGES, command
from isac_rt.results.provenance import versions_in_use

Row = Mapping[str, Any]


def stages() -> list[str]:
    """Stages whose measurements are there."""
    return [
        name
        for name, module in STAGES.items()
        if importlib.util.find_spec(f"benchmarks.{module}") is not None
    ]


def machine() -> dict[str, Any]:
    """What the figures were measured on."""
    model = ""
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
        model = next(
            (line.split(":", 1)[1].strip() for line in lines if line.startswith("model name")), ""
        )
    except OSError:
        model = platform.processor()
    return {
        "processor": model or platform.machine(),
        "cores": os.cpu_count(),
        "platform": platform.platform(),
        "versions": versions_in_use(),
    }


def measure(
    names: Sequence[str], quick: bool, progress: Callable[[int, int], None] | None = None
) -> dict[str, Any]:
    """All rows of some stages, with the machine, the growth of every curve, and why a stage was
    left out."""
    rows: list[dict[str, Any]] = []
    left_out: dict[str, str] = {}
    commands: list[dict[str, Any]] = []
    for done, name in enumerate(names):
        module = importlib.import_module(f"benchmarks.{STAGES[name]}")
        reason = module.missing() if hasattr(module, "missing") else None
        if reason is None:
            rows += module.rows(quick)
            left_out |= module.left_out() if hasattr(module, "left_out") else {}
            commands += module.commands(quick) if hasattr(module, "commands") else []
        else:
            left_out[name] = reason
        if progress:
            progress(done + 1, len(names))
    return {
        "machine": machine(),
        "quick": quick,
        "rows": rows,
        "growth": growth(rows),
        "left_out": left_out,
        "commands": commands,
    }


def curves(rows: Sequence[Row]) -> dict[tuple[str, str, str], list[Row]]:
    """Rows by kind, method and unit, sorted by size."""
    out: dict[tuple[str, str, str], list[Row]] = {}
    for row in sorted(rows, key=lambda r: r["size"]):
        out.setdefault((row["kind"], row["method"], row.get("unit", "")), []).append(row)
    return out


def exponent(sizes: Sequence[float], costs: Sequence[float]) -> float:
    """Slope of log cost over log size by least squares: 1 is linear growth."""
    return float(np.polyfit(np.log(sizes), np.log(costs), 1)[0])


def growth(rows: Sequence[Row]) -> list[dict[str, Any]]:
    """Exponent of every curve of two sizes or more."""
    out = []
    for (kind, method, unit), of in curves(rows).items():
        if len({row["size"] for row in of}) > 1:
            value = exponent([r["size"] for r in of], [r["cost"] for r in of])
            out.append({"kind": kind, "method": method, "unit": unit, "exponent": round(value, 2)})
    return out


def markdown(found: Mapping[str, Any]) -> str:
    """The tables of `measure`."""
    m = found["machine"]
    text = [
        f"Machine: {m['processor']}, {m['cores']} cores, {m['platform']}. Cost in floors of the "
        "same run (CPU time).",
        "",
    ]
    for kind in dict.fromkeys(row["kind"] for row in found["rows"]):
        text += [
            f"## {kind}",
            "",
            "| method | size | cost [floors] | CPU s | floor [s] | error | of | also |",
            "|---|---|---|---|---|---|---|---|",
        ]
        for (of_kind, method, unit), rows in curves(found["rows"]).items():
            if of_kind == kind:
                text += [_line(method, unit, row) for row in rows]
        text.append("")
    if found.get("commands"):
        title = "## Whole commands: processor seconds, in brackets wall seconds"
        text += [title, "", *command.markdown(found["commands"]), ""]
    text += [
        "## Growth of cost with size",
        "",
        "| stage | method | size | exponent |",
        "|---|---|---|---|",
    ]
    text += [
        f"| {g['kind']} | {g['method']} | {g['unit']} | {g['exponent']} |" for g in found["growth"]
    ]
    text += [f"\n{name} left out: {reason}" for name, reason in found.get("left_out", {}).items()]
    return "\n".join(text) + "\n"


def _line(method: str, unit: str, row: Row) -> str:
    error = "" if row["error"] is None else "oracle" if row.get("oracle") else f"{row['error']:.2g}"
    seconds = row.get("seconds", row["cost"] * row["floor_s"])
    return (
        f"| {method} | {row['size']:,} {unit} | {row['cost']:.3g} | {seconds:.3g} | "
        f"{row['floor_s']:.3g} | {error} "
        f"| {row.get('error_of', 'samples')} | {row.get('also', '')} |"
    )


def write(found: Mapping[str, Any], folder: Path) -> list[Path]:
    """bench.json, bench.md and one figure per stage."""
    from isac_rt.storage import write_whole

    files = [folder / "bench.json", folder / "bench.md"]
    write_whole(files[0], json.dumps(found, indent=1) + "\n")
    write_whole(files[1], markdown(found))
    for kind in dict.fromkeys(row["kind"] for row in found["rows"]):
        files.append(figure(found, kind, folder / f"{kind}.png"))
    return files


_MARKERS = "os^D"


def figure(found: Mapping[str, Any], kind: str, file: Path) -> Path:
    """Cost against error and against size of one stage; the oracle is marked, the floor is the line
    at one."""
    import matplotlib.pyplot as plt

    from isac_rt.results.files import write_figure

    drawn = [
        (method, unit, rows)
        for (of_kind, method, unit), rows in curves(found["rows"]).items()
        if of_kind == kind
    ]
    with plt.rc_context({"font.size": 8, "axes.grid": True, "grid.alpha": 0.3}):
        canvas, (left, right) = plt.subplots(
            1, 2, figsize=(9.5, 3.9 + 0.08 * len(drawn)), layout="constrained"
        )
        for number, (method, unit, rows) in enumerate(drawn):
            cost = [row["cost"] for row in rows]
            oracle = any(row.get("oracle") for row in rows)
            error = [max(row["error"] or 0.0, 1e-8) for row in rows]
            marker = (
                "*" if oracle else _MARKERS[number // 10 % len(_MARKERS)]
            )  # there are ten colours
            (line,) = right.loglog(
                [r["size"] for r in rows],
                cost,
                marker=marker,
                label=f"{method} ({unit})" if unit else method,
            )
            if rows[0]["error"] is not None and (not oracle or max(error) > 1e-8):
                left.loglog(error, cost, ls="none", marker=marker, color=line.get_color())
        for axis in (left, right):
            axis.axhline(1.0, color="k", lw=1, ls=":")
            axis.set_ylabel("cost [floors]")
            _whole_decades(axis)
        left.set_xlabel("error (1e-8 and less at the edge)")
        right.set_xlabel("size")
        canvas.legend(fontsize=6.5, loc="outside lower center", ncols=2)
        canvas.suptitle(f"{kind}: {found['machine']['processor']}; star: oracle; dotted: floor")
        write_figure(file, canvas, dpi=130)
        plt.close(canvas)
    return file


def _whole_decades(axis: Any) -> None:
    """Limits at powers of ten with labels there only, so that neighbours do not look far apart nor
    labels run into each other."""
    from matplotlib.ticker import NullFormatter

    axis.set_xscale("log")
    for one, limits, move in (
        (axis.xaxis, axis.get_xlim(), axis.set_xlim),
        (axis.yaxis, axis.get_ylim(), axis.set_ylim),
    ):
        move(10 ** np.floor(np.log10(limits[0])), 10 ** np.ceil(np.log10(limits[1])))
        one.set_minor_formatter(NullFormatter())
