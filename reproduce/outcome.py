"""What an experiment hands back, and the files it becomes."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, Literal

import matplotlib
import pandas as pd
from matplotlib.figure import Figure

from isac_rt.results.files import write_figure
from isac_rt.results.metrics import binomial_interval
from isac_rt.results.provenance import commit, versions_in_use
from isac_rt.storage import write_whole

Judgement = Literal["holds", "holds under a condition", "does not hold"]
Progress = Callable[[int, int], None]
"""Called with the steps done and the steps in all."""

STYLE: Any = {
    "figure.dpi": 130,
    "figure.constrained_layout.use": True,
    "font.size": 9,
    "axes.grid": True,
    "grid.color": "#D8D8D8",
    "grid.linewidth": 0.6,
    "axes.axisbelow": True,
    "axes.titlesize": 9.5,
    "legend.fontsize": 8,
    "lines.linewidth": 1.4,
    "lines.markersize": 4.5,
}
"""Boxed axes with a full grid, as in the paper's figures."""


@dataclass(frozen=True)
class Verdict:
    """A claim of the paper and what became of it.

    Attributes
    ----------
    claim : as the paper says it
    verdict : "holds", "holds under a condition" or "does not hold"
    finding : the number that shows it, with its confidence interval where it is random, and the
        condition where there is one
    """

    claim: str
    verdict: Judgement
    finding: str


@dataclass(frozen=True)
class Outcome:
    """One experiment, done.

    Attributes
    ----------
    name, title : of the experiment
    tables : the data, one row per point, by name; units in the column names
    figure : to be read beside the paper's
    verdicts : one per claim
    settings : seed, sample sizes and whatever else fixes the numbers; JSON values
    """

    name: str
    title: str
    tables: Mapping[str, pd.DataFrame]
    figure: Figure | None
    verdicts: tuple[Verdict, ...]
    settings: Mapping[str, Any] = field(default_factory=dict)


def judged(always: bool, sometimes: bool = False) -> Judgement:
    """What a claim deserves that holds always, or under a condition that its finding names."""
    return "holds" if always else "holds under a condition" if sometimes else "does not hold"


class Sentences:
    r"""Claims of the paper and templates of their findings, by a key.

    Parameters
    ----------
    text : blocks apart by an empty line. "key: claim" in the first lines, the template below it,
        indented; fields stand in braces as for `str.format`

    Examples
    --------
    >>> say = Sentences("far: UAVs are far-field points\n  2 D^2/lambda is {far:.2f} m")
    >>> say("far", True, far=1.2345)
    Verdict(claim='UAVs are far-field points', verdict='holds', finding='2 D^2/lambda is 1.23 m')
    """

    def __init__(self, text: str) -> None:
        self._known: dict[str, tuple[str, str]] = {}
        for block in text.strip().split("\n\n"):
            key, rest = block.split(": ", 1)
            lines = rest.split("\n")
            claim = " ".join(line for line in lines if not line.startswith("  "))
            self._known[key] = claim, " ".join(x.strip() for x in lines if x.startswith("  "))

    def __call__(
        self, key: str, always: bool, sometimes: bool = False, /, **fields: object
    ) -> Verdict:
        """The verdict on one claim (`judged`); `fields` fill its claim and its finding."""
        claim, finding = (words.format(**fields) for words in self._known[key])
        return Verdict(claim, judged(always, sometimes), finding)


def table(columns: str, rows: Iterable[Sequence[object]]) -> pd.DataFrame:
    """Rows as a table; names of the columns apart by spaces."""
    return pd.DataFrame(list(rows), columns=columns.split())


def proportion(successes: int, trials: int, confidence: float = 0.95) -> str:
    """A proportion and its Clopper-Pearson interval as text: ``0.5130 [0.4843, 0.5416] (616 of
    1200)``."""
    low, high = binomial_interval(successes, trials, confidence)
    return f"{successes / trials:.4g} [{low:.4g}, {high:.4g}] ({successes} of {trials})"


@contextmanager
def style() -> Iterator[None]:
    """Figures made inside look alike."""
    with matplotlib.rc_context(STYLE):
        yield


def blank(
    rows: int = 1, columns: int = 1, size: tuple[float, float] = (6.4, 4.6), **options: Any
) -> tuple[Figure, Any]:
    """A figure outside pyplot, so that none stays open, and its axes (rows, columns). Call it
    within `style`."""
    figure = Figure(figsize=size)
    return figure, figure.subplots(rows, columns, squeeze=False, **options)


def write(outcome: Outcome, folder: str | Path) -> list[Path]:
    """Write NAME.csv (NAME_TABLE.csv where there are several), NAME.png and NAME.json; each appears
    whole or not at all.

    Returns
    -------
    files : in the order of writing, the JSON file with verdicts and settings last

    Raises
    ------
    isac_rt.storage.StorageError  If the folder cannot be written.
    """
    folder, written = Path(folder), []
    for table, frame in outcome.tables.items():
        stem = outcome.name if len(outcome.tables) == 1 else f"{outcome.name}_{table}"
        written.append(folder / f"{stem}.csv")
        write_whole(written[-1], frame.to_csv(index=False, lineterminator="\n"))
    if (figure := outcome.figure) is not None:
        written.append(folder / f"{outcome.name}.png")
        with style():
            write_figure(written[-1], figure)
    about = {
        "name": outcome.name,
        "title": outcome.title,
        "verdicts": [asdict(v) for v in outcome.verdicts],
        "settings": dict(outcome.settings),
        "files": [file.name for file in written],
        "versions": versions_in_use(),
        "commit": commit(),
    }
    written.append(folder / f"{outcome.name}.json")
    write_whole(written[-1], json.dumps(about, indent=1, allow_nan=False) + "\n")
    return written
