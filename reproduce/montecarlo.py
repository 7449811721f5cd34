"""Monte-Carlo of error and hit rates: sample sizes that grow until the intervals are small,
thresholds with bootstrap intervals, theory.

A trial is a frame: all its symbols and all SNR points at once. It is a pure function of seed, curve
and number, so that a result depends on how many frames were run and on nothing else, and frames
that were run before an interruption need not be run again (`kept_in`). One trial serves all SNR
points with the same noise: neighbouring points of a curve are correlated, each by itself is not
biased. Symbols of a frame share its prediction error and its clutter, so that frames differ by more
than the binomial law; `interval` allows for it, and the intervals of thresholds resample whole
frames.
"""

from __future__ import annotations

import hashlib
import json
import os
import time
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager, suppress
from contextvars import ContextVar
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from scipy import special, stats

from isac_rt.randomness import generator
from isac_rt.results.metrics import binomial_interval
from isac_rt.storage import (
    BAD_DATA,
    load_data,
    program_fingerprint,
    save_data,
    source_digest,
    versions,
)
from reproduce.outcome import Progress

Counts = Mapping[str, tuple[np.ndarray, int]]
"""Counts of one frame: for every rate its events (SNR points,) and how many there could have been
at each point."""
BATCH = 4
FEWEST = 8
"""Frames that are always run: fewer say little of how they differ."""
WORKERS = min(2, os.cpu_count() or 1)
"""Frames at once, in threads; no result depends on it."""
INTERVAL = "95 %, Clopper-Pearson with the effective sample size of Korn and Graubard"
SAVE_EVERY = 20.0
"""Seconds between two savings of the frames so far."""
_folder: ContextVar[Path | None] = ContextVar("folder", default=None)


@contextmanager
def kept_in(folder: str | Path) -> Iterator[None]:
    """Inside, `sample` keeps the counts of its frames in `folder` and does not run again those that
    it finds there.

    They are found by seed, curve, the digest of this program and the versions under it: a changed
    program starts anew.
    """
    token = _folder.set(Path(folder))
    try:
        yield
    finally:
        _folder.reset(token)


def kept_folder() -> Path | None:
    """Where results in between are kept; None: nowhere."""
    return _folder.get()


@dataclass(frozen=True)
class Precision:
    """When to stop: every interval's half-width at most max(relative p, absolute), or `limit`
    frames."""

    limit: int
    relative: float = 0.1
    absolute: float = 0.01

    @property
    def text(self) -> str:
        return f"half-width <= max({self.relative} p, {self.absolute})"

    def reached(self, events: np.ndarray, trials: int) -> bool:
        """Whether all points of a curve are known well enough, from events (frames, points) of
        `trials` possible ones in a frame."""
        if len(events) < FEWEST:
            return False
        for column in events.T:
            low, high = interval(column, trials)
            if (high - low) / 2 > max(self.relative * column.mean() / trials, self.absolute):
                return False
        return True


def interval(events: np.ndarray, trials: float, confidence: float = 0.95) -> tuple[float, float]:
    """Clopper-Pearson with the sample size that frames of unequal rates amount to.

    Parameters
    ----------
    events : (frames,) of `trials` possible ones each

    References
    ----------
    .. [1] E. Korn, B. Graubard, "Confidence intervals for proportions with small expected number of
    positive counts estimated from
       survey data", Survey Methodology 24 (1998). The effective size is p (1 - p) over the variance
       of the mean of the frames, no more than the true size, and less by the ratio of Student's
       quantiles where frames are few.
    """
    frames, total = len(events), trials * len(events)
    p, size = float(events.sum() / total), float(total)
    if frames > 1 and 0 < p < 1 and trials > 1:
        variance = float(np.var(events / trials, ddof=1)) / frames
        if variance > p * (1 - p) / total:
            tail = (1 + confidence) / 2
            size = (
                p
                * (1 - p)
                / variance
                * float(stats.t.ppf(tail, total - 1) / stats.t.ppf(tail, frames - 1)) ** 2
            )
    size = min(size, float(total))
    return binomial_interval(p * size, size, confidence)


@dataclass(frozen=True)
class Curve:
    """One rate against SNR: `events` (frames, points) of `trials` possible ones in each frame."""

    name: str
    snr_db: np.ndarray
    events: np.ndarray
    trials: int

    @property
    def rate(self) -> np.ndarray:
        return self.events.sum(axis=0) / (self.trials * len(self.events))

    def table(self) -> pd.DataFrame:
        """One row per SNR with the 95 % interval."""
        total = self.trials * len(self.events)
        found = self.events.sum(axis=0)
        low, high = np.array([interval(column, self.trials) for column in self.events.T]).T
        return pd.DataFrame(
            {
                "curve": self.name,
                "snr_db": self.snr_db,
                "rate": found / total,
                "low": low,
                "high": high,
                "events": found,
                "trials": total,
                "frames": len(self.events),
            }
        )

    def at(self, snr_db: float) -> tuple[int, int]:
        """Events and trials at the SNR point nearest to `snr_db`."""
        point = int(np.argmin(np.abs(self.snr_db - snr_db)))
        return int(self.events[:, point].sum()), self.trials * len(self.events)

    def text(self, snr_db: float) -> str:
        """The rate nearest to `snr_db` with its interval: ``0.5047 [0.4821, 0.5273] (969 of
        1920)``."""
        low, high = interval(
            self.events[:, int(np.argmin(np.abs(self.snr_db - snr_db)))], self.trials
        )
        found, total = self.at(snr_db)
        return f"{found / total:.4g} [{low:.4g}, {high:.4g}] ({found} of {total})"

    def threshold(
        self, level: float, seed: int = 1, resamples: int = 400
    ) -> tuple[float, float, float]:
        """SNR [dB] at which the rate passes `level`, and its 95 % bootstrap interval over frames;
        NaN where it does not pass."""
        rng = generator(seed, "bootstrap", self.name, len(self.events))
        draws = rng.integers(0, len(self.events), (resamples, len(self.events)))
        found = [
            crossing(self.snr_db, self.events[d].sum(axis=0), self.trials * len(d), level)
            for d in draws
        ]
        low, high = (
            np.nanquantile(found, [0.025, 0.975]) if np.isfinite(found).any() else (np.nan, np.nan)
        )
        total = self.trials * len(self.events)
        return crossing(self.snr_db, self.events.sum(axis=0), total, level), float(low), float(high)


def crossing(snr_db: np.ndarray, events: np.ndarray, trials: int, level: float) -> float:
    """First SNR at which a rate passes `level`, linear in the logit; a rate of 0 or 1 counts as
    half an event."""
    p = np.clip(events / trials, 0.5 / trials, 1 - 0.5 / trials)
    height = np.log(p / (1 - p)) - np.log(level / (1 - level))
    passes = np.flatnonzero(np.sign(height[1:]) != np.sign(height[:-1]))
    if not passes.size:
        return float("nan")
    i = passes[0]
    return float(snr_db[i] + (snr_db[i + 1] - snr_db[i]) * height[i] / (height[i] - height[i + 1]))


def sample(
    trial: Callable[[int], Counts],
    snr_db: np.ndarray,
    precision: Precision,
    progress: Progress,
    *,
    key: str,
    prefix: str = "",
) -> dict[str, Curve]:
    """Run frames 0, 1, ... in batches until every rate is precise enough or the limit is reached.

    Parameters
    ----------
    trial : number -> counts, a pure function
    key : all that `trial` depends on besides the program, seed included: where its frames are kept
        under `kept_in`
    prefix : of the curves' names
    """
    store = _Store(key, snr_db)
    frames: list[Counts] = []
    with ThreadPoolExecutor(WORKERS) as pool:
        while len(frames) < precision.limit:
            numbers = range(len(frames), min(len(frames) + BATCH, precision.limit))
            frames += list(pool.map(lambda i: store.known(i) or trial(i), numbers))
            store.save(frames)
            progress(len(frames), precision.limit)
            if all(
                precision.reached(np.array([f[name][0] for f in frames]), frames[0][name][1])
                for name in frames[0]
            ):
                break
    store.save(frames, now=True)
    return {
        name: Curve(
            prefix + name, snr_db, np.array([f[name][0] for f in frames]), frames[0][name][1]
        )
        for name in frames[0]
    }


def _counts(frame: Mapping[str, Any], shape: tuple[int, ...]) -> Counts:
    """The counts of one frame as they were kept.

    Raises
    ------
    One of `BAD_DATA`  If they are none.
    """
    out = {}
    for name, (events, total) in frame.items():
        if events.shape != shape or not ((events >= 0) & (events <= total)).all() or total < 1:
            raise ValueError(f"{name}: {events} of {total}")
        out[name] = events, total
    return out


class _Store:
    """Counts of the frames of one curve on disk, if there is a folder for them."""

    def __init__(self, key: str, snr_db: np.ndarray) -> None:
        program = program_fingerprint(), source_digest(Path(__file__).parent), versions()
        whole = json.dumps([key, *program, snr_db.tolist()])
        self._key, folder = hashlib.sha256(whole.encode()).hexdigest()[:24], _folder.get()
        self._file = None if folder is None else folder / f"{self._key}.frames"
        self._saved_at = time.monotonic()
        kept = None if self._file is None else load_data(self._file, self._key)
        self._known: list[Counts] = []
        with suppress(*BAD_DATA):  # sealed, but not by `save`
            self._known = [_counts(frame, snr_db.shape) for frame in kept or ()]

    def known(self, number: int) -> Counts | None:
        return self._known[number] if number < len(self._known) else None

    def save(self, frames: list[Counts], now: bool = False) -> None:
        if (
            self._file is None
            or len(frames) <= len(self._known)
            or not (now or time.monotonic() - self._saved_at > SAVE_EVERY)
        ):
            return
        save_data(self._file, self._key, frames)
        self._known, self._saved_at = list(frames), time.monotonic()


class Steps:
    """Progress of several runs as one count, which a run that stops early fills up."""

    def __init__(self, progress: Progress, total: int) -> None:
        self._progress, self._total, self._before = progress, total, 0

    def part(self, size: int) -> Progress:
        """The progress of a run that makes up `size` steps; the runs before it count as done."""
        start = self._before
        self._before += size
        self._progress(start, self._total)
        return lambda done, of: self._progress(start + round(size * done / of), self._total)


def delay_error_rate(snr_db: np.ndarray, num_samples: int, cells: int, num_rx: int) -> np.ndarray:
    """Error rate of the strongest of `cells` orthogonal tones, square-law combined over `num_rx`
    branches, in white noise.

    P = 1 - E[F(z)^(cells-1)] with z the sent cell's power, non-central chi-square of 2 num_rx
    degrees of freedom and F the law of an empty cell (J. Proakis, "Digital Communications",
    noncoherent orthogonal signalling with diversity). The tone lies on a cell.
    """
    out = []
    for snr in 10 ** (np.asarray(snr_db, float) / 10):
        z = stats.ncx2(2 * num_rx, 2 * num_rx * num_samples * snr)
        grid = np.linspace(z.ppf(1e-10), z.isf(1e-10), 4001)
        # 1 - F^(n-1) and not 1 - integral of F^(n-1): no cancellation where errors are rare
        wrong = -np.expm1((cells - 1) * np.log1p(-stats.chi2.sf(grid, 2 * num_rx)))
        out.append(np.trapezoid(z.pdf(grid) * wrong, grid))
    return np.array(out)


def dpsk_error_rate(snr_db: np.ndarray, num_samples: int, order: int, num_rx: int) -> np.ndarray:
    """Error rate of differential phase detection, summed over `num_rx` branches, the delay known
    and the tone on a cell.

    The symbol is wrong where the angle t of Z = sum of x conj(x') is beyond +-pi/D. With g the SNR
    of a cell, L branches and r = 2 tan(f), Re(Z exp(-j s)) has the characteristic function
    cos(f)^(2L) exp(-2 L g sin(f)^2 + j L g sin(2f) cos(s)) at r, half the difference of two squared
    norms. e^(jnt) depends on the angle alone; its Fourier transform falls as n/r^2. So, Parseval
    and Bessel's integral over s,

        E[cos(n t)] = n integral_0^(pi/2) cos(f)^(2L) exp(-2 L g sin(f)^2) J_n(L g sin(2f)) df /
        (sin(f) cos(f)),

    and the wedge's Fourier series gives P = 1 - 1/D - 2/pi sum_n sin(n pi/D) E[cos(n t)] / n. Exact
    for every D and L.
    """
    nodes, weights = np.polynomial.legendre.leggauss(400)
    out = []
    for g in num_samples * 10 ** (np.asarray(snr_db, float) / 10):
        end = min(
            np.pi / 2, 9 / np.sqrt(2 * num_rx * (1 + g))
        )  # beyond it the weight is below 1e-16
        f = end / 2 * (1 + nodes)
        weight = (
            end
            / 2
            * weights
            * np.cos(f) ** (2 * num_rx - 1)
            * np.exp(-2 * num_rx * g * np.sin(f) ** 2)
            / np.sin(f)
        )
        spread = np.sqrt((1 + 1 / (2 * g)) / (num_rx * g))
        n = np.arange(1, int(np.clip(8 / spread, 30, 1500)) + 1)
        moments = special.jv(n[:, None], num_rx * g * np.sin(2 * f)) @ weight
        out.append(1 - 1 / order - 2 / np.pi * (np.sin(n * np.pi / order) @ moments))
    return np.array(out)
