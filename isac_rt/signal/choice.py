r"""What a synthesis costs and how far off it may be, from which `isac_rt.signal.methods.Auto`
chooses.

Cost [CPU s] of a cube of C chirps, L receive elements and N samples with K paths, fitted by
`isac-rt bench --fit FILE`:

.. math::

    C L \frac{N}{1024} (a_d + K b_d) \text{ (direct)}, \qquad C \lceil L/16 \rceil \left(a_s
    \frac{N}{1024} + K b_s\right) \text{ (gridded, each setting)}

Paths that noise covers have a b_s of their own. Data do not enter: the delay symbols move paths
over the grid. The coefficients that ship with the
program stand in `cost_model.json`, with the machine they were measured on. Others are read only
where a scenario names their file (``accuracy.cost_model``), so that a run depends on no machine
unless its user says so.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from isac_rt.kernels.vector import LANES
from isac_rt.signal.gridded import ACCURATE, COVERING, DEFAULT, Setting

FORMAT = "isac_rt cost model 2"
DIRECT = "direct"
FAINT = ", covered"
"""After the name of a candidate: its paths that noise covers."""
MOST_CELLS = 1 << 24
"""Span of cells whose sums are kept as one array: a hundred times what a link spans. Transmitters
whose clocks are a second apart span 10^11."""
SHIPPED = Path(__file__).with_name("cost_model.json")


class Cover(NamedTuple):
    """What says which paths noise covers.

    Attributes
    ----------
    cell : (K,) int, range-Doppler cell in which each is seen
    error : (K,) relative RMS error that it would have (`isac_rt.signal.covered.covered_error`)
    dearer : what such a path costs over that of a frame with three groups
    """

    cell: np.ndarray
    error: np.ndarray
    dearer: float = 1.0


@dataclass(frozen=True)
class Candidate:
    """A setting of the gridded method that `Auto` may take.

    Attributes
    ----------
    name : of its coefficients
    setting : `isac_rt.signal.gridded.Setting`
    error : coefficients of 1, v and v^2 [m/s] in a bound of the relative RMS error against the full
        model of a path whose delay changes by 2 v/c, up to |u| = 0.87 and the paper's 640 MHz
        (measured: `docs/performance_synthesis.md`)
    """

    name: str
    setting: Setting
    error: tuple[float, float, float]

    def error_at(self, speed: np.ndarray) -> np.ndarray:
        """The bound at each speed [m/s]."""
        return np.polynomial.polynomial.polyval(speed, self.error)

    def covered(self, power: np.ndarray, cover: Cover, limit: float) -> np.ndarray:
        """Which paths (K,) may take the way for those that noise covers, if the setting has one:
        the powers [W] of the errors of all paths of their cell stay within a limit."""
        if not self.setting.faint or not power.size:
            return np.zeros(power.size, bool)
        number = cover.cell - cover.cell.min()
        if number.max() > MOST_CELLS:
            number = np.unique(number, return_inverse=True)[1]
        return np.bincount(number, power * cover.error**2)[number] <= limit


CANDIDATES = (
    Candidate("gridded, 2.25 N, width 4", Setting(2.25, 4, True), (3e-4, 1.2e-6, 0.0)),
    Candidate("gridded, 1.25 N, width 6", Setting(1.25, 6, True), (3e-4, 1.2e-6, 0.0)),
    Candidate("gridded, 1.5 N, width 6", DEFAULT, (4e-5, 1.0e-6, 0.0)),
    Candidate("gridded, 1.5 N, width 8, cubic", ACCURATE, (3e-6, 0.0, 4e-9)),
    Candidate("gridded, 1.5 N, width 12 over 4", COVERING, (5e-5, 1.0e-6, 0.0)),
)
"""The first two alone go beyond 1e-4; the errors of the others meet it up to 60, 155 and 50 m/s."""
NAMES = (
    DIRECT,
    *(c.name for c in CANDIDATES),
    *(c.name + FAINT for c in CANDIDATES if c.setting.faint),
)


@dataclass(frozen=True)
class CostModel:
    """Coefficients a and b of each method by its name [ns], and where they are from."""

    source: str
    chirp_ns: dict[str, float]
    path_ns: dict[str, float]

    def seconds(
        self, method: str, shape: tuple[int, ...], num_paths: float, num_faint: float = 0.0
    ) -> float:
        """CPU time of a cube of shape (M, L_rx, P, N) with so many paths, and so many more that
        noise covers [s]."""
        groups, elements, chirps, samples = shape
        fixed, each = self.chirp_ns[method], self.path_ns[method] * num_paths
        if num_faint:
            each += self.path_ns[method + FAINT] * num_faint
        if method == DIRECT:
            return 1e-9 * groups * chirps * elements * samples / 1024 * (fixed + each)
        return 1e-9 * groups * chirps * -(-elements // LANES) * (fixed * samples / 1024 + each)

    def record(self) -> dict[str, Any]:
        """For summary.json."""
        return {"source": self.source, "chirp_ns": self.chirp_ns, "path_ns": self.path_ns}


@lru_cache(maxsize=8)
def read(file: Path) -> CostModel:
    """The model of a file that `isac-rt bench --fit` wrote.

    Raises
    ------
    ValueError  If the file cannot be read or is no such model: file, what is wrong, remedy.
    """
    remedy = f"make one with isac-rt bench --fit {file.name}"
    try:
        data = json.loads(file.read_text(encoding="utf-8"))
        methods = {name: data["methods"][name] for name in NAMES}
        chirp, path = (
            {name: float(row[key]) for name, row in methods.items()}
            for key in ("chirp_ns", "path_ns")
        )
    except OSError as problem:
        raise ValueError(f"{file}: {problem.strerror or problem}; {remedy}") from None
    except (ValueError, KeyError, TypeError) as problem:
        raise ValueError(
            f"{file}: is no cost model ({type(problem).__name__}: {problem}); {remedy}"
        ) from None
    if data.get("format") != FORMAT:
        raise ValueError(f"{file}: format {data.get('format')!r} is not {FORMAT!r}; {remedy}")
    values = np.array([*chirp.values(), *path.values()])
    if not (np.isfinite(values).all() and (values > 0).all()):
        raise ValueError(f"{file}: costs must be above 0 ns; {remedy}")
    return CostModel("shipped" if file == SHIPPED else file.name, chirp, path)
