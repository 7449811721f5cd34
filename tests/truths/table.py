"""The table of a validation as JSON and Markdown."""

from __future__ import annotations

import datetime
import json
import math
from collections.abc import Sequence
from pathlib import Path

from isac_rt.results.provenance import commit, versions_in_use
from isac_rt.storage import program_fingerprint, write_whole
from truths.case import Measured

STATES = {True: "passes", False: "FAILS", None: "left out"}


def as_data(verdicts: Sequence[Measured]) -> dict[str, object]:
    """All of the table as plain data, with what it was made by; an error that is no finite number
    is null."""
    rows = []
    for v in verdicts:
        c = v.case
        rows.append(
            {
                "name": c.name,
                "group": c.group,
                "claim": c.claim,
                "truth": c.truth,
                "error": v.error if math.isfinite(v.error) else None,
                "bound": c.bound,
                "unit": c.unit,
                "why": c.why,
                "state": STATES[v.passed],
                "seconds": round(v.seconds, 3),
                "note": v.note,
            }
        )
    return {
        "date": datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds"),
        "program": program_fingerprint(),
        "commit": commit(),
        "versions": versions_in_use(),
        "passed": sum(v.passed is True for v in verdicts),
        "failed": sum(v.passed is False for v in verdicts),
        "left_out": sum(v.passed is None for v in verdicts),
        "cases": rows,
    }


def _cell(text: str) -> str:
    return text.replace("|", "\\|").replace("\n", " ")


def shown(value: float) -> str:
    """A number with two digits, or a dash."""
    return "-" if not math.isfinite(value) else f"{value:.2g}"


def as_markdown(verdicts: Sequence[Measured]) -> str:
    """A table per group: claim, truth, error, bound and why."""
    data = as_data(verdicts)
    counts = f"{data['passed']} cases pass, {data['failed']} fail, {data['left_out']} were left out"
    lines = [f"{counts} ({data['date']}, {data['program']}).", ""]
    for group in dict.fromkeys(v.case.group for v in verdicts):
        lines += [
            f"### {group}",
            "",
            "| case | claim | truth | error | bound | why that bound | s |",
            "|---|---|---|---|---|---|---|",
        ]
        for v in verdicts:
            c = v.case
            if c.group == group:
                found = shown(v.error) if v.passed is not None else f"left out: {v.note}"
                note = f" ({v.note})" if v.note and v.passed is not None else ""
                failed = "**FAILS** " if v.passed is False else ""
                cells = (
                    c.name,
                    c.claim + note,
                    c.truth,
                    failed + found,
                    f"{shown(c.bound)} {c.unit}",
                    c.why,
                    f"{v.seconds:.1f}",
                )
                lines.append("| " + " | ".join(_cell(str(x)) for x in cells) + " |")
        lines.append("")
    return "\n".join(lines) + "\n"


def write_json(verdicts: Sequence[Measured], file: Path) -> None:
    """The table as JSON; the file appears whole or not at all."""
    write_whole(file, json.dumps(as_data(verdicts), indent=1, allow_nan=False) + "\n")


def write_markdown(verdicts: Sequence[Measured], file: Path) -> None:
    """The table as Markdown; the file appears whole or not at all."""
    write_whole(file, as_markdown(verdicts))
