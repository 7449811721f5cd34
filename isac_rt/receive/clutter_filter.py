"""The paper's clutter filter: find consecutive occupied range cells, then filter them.

The paper (section V.A) says no more than that. Here a cell is occupied if its power exceeds the
median over all cells, which most of the noise-only cells share, by `occupied_factor`; gaps of up to
`GAP` cells are closed (Rayleigh amplitudes fade); a run counts as clutter from a least number of
cells on. What happens in a run:

- the AT, which has taken its data out, subtracts from each range cell what stands still over the
  chirps of each antenna and group. A target at rest relative to the radar goes with it;
  `zero_doppler` does so in all range cells, for clutter that is too weak or too short to make a
  run;
- a PT, which does not know the data yet, leaves the run out of the symbol decision, chirp by chirp.
  A line of sight within the run is left out too.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import special

from isac_rt.frame.schedule import Schedule
from isac_rt.receive.spectrum import transform

RUN_CELLS = 15
"""Consecutive occupied range cells from which on a run counts as clutter: below the 40 cells that
the paper's clutter has at least."""
GAP = 3
MARGIN = 2
"""Cells that the window's main lobe reaches beyond a run."""
FALSE_RATE = 1e-3
LEAST_FACTOR = 2.0


@dataclass(frozen=True)
class ClutterFilter:
    """Clutter filter of range cells in runs of at least `least` occupied ones; None: of all cells
    at the AT, of none at a PT, whose line of sight may be static."""

    least: int | None

    def clean(
        self, spectra: np.ndarray, schedule: Schedule, codes: np.ndarray | None = None
    ) -> None:
        """Remove static echoes from the AT's spectra, in place; `codes` (L_tx, P): of antennas that
        send at once; None: they send in turn."""
        if codes is not None:
            spectra -= (spectra @ codes.conj().T.astype(np.complex64)) @ (
                codes / codes.shape[1]
            ).astype(np.complex64)
            return
        remove_static(spectra, schedule, self.least)


def occupied_factor(looks: float) -> float:
    """Return the least power of an occupied cell over the median of noise, a mean of `looks`
    exponentials; at least 3 dB."""
    rare, median = special.gammainccinv(looks, FALSE_RATE), special.gammaincinv(looks, 0.5)
    return max(float(rare / median), LEAST_FACTOR)


def runs(power: np.ndarray, looks: float, least: int) -> np.ndarray:
    """Mark the range cells in runs of at least `least` occupied ones, with a margin.

    Parameters
    ----------
    power : (..., cells) mean power over `looks` independent channels, of a windowed spectrum
        (without a window the sidelobes of strong clutter make one endless run)

    Returns
    -------
    inside : as `power`, bool
    """
    lines = power.reshape(-1, power.shape[-1])
    floor = np.median(lines, axis=1, keepdims=True)
    inside = _in_runs(lines > occupied_factor(looks) * floor, least)
    return inside.reshape(power.shape)


def _in_runs(occupied: np.ndarray, least: int) -> np.ndarray:
    """Mark the cells of lines that lie in runs of at least `least` occupied ones, gaps closed, with
    a margin."""
    gap = max(GAP, 2 * MARGIN) + 1  # empty cells between the lines keep their runs apart
    wide = np.pad(occupied, ((0, 0), (MARGIN, gap)))
    at = np.flatnonzero(wide)
    breaks = np.flatnonzero(np.diff(at) > GAP + 1)
    first, last = at[np.append(0, breaks + 1)[: at.size]], at[np.append(breaks, -1)[: at.size]]
    long = last - first + 1 >= least
    steps = np.zeros(wide.size + 1, np.int64)
    np.add.at(steps, first[long] - MARGIN, 1)
    np.add.at(steps, last[long] + MARGIN + 1, -1)
    inside = np.cumsum(steps[:-1]).reshape(wide.shape) > 0
    return inside[:, MARGIN : MARGIN + occupied.shape[1]]


def remove_static(spectra: np.ndarray, schedule: Schedule, least: int | None) -> np.ndarray:
    """Subtract in place, in range cells of runs, the mean over the chirps of each antenna and
    group.

    Parameters
    ----------
    spectra : (M, L_rx, rows, P) windowed, data removed
    least : cells of a run; None: every cell is filtered, in a run or not

    Returns
    -------
    rows : (rows,) bool, those that were filtered
    """
    num_groups, num_rx, num_rows, num_chirps = spectra.shape
    rows = np.ones(num_rows, bool)
    if least is not None:
        power = np.zeros(num_rows)
        for channel in spectra.reshape(-1, num_rows, num_chirps):
            power += (channel.real**2 + channel.imag**2).mean(axis=1)
        rows = runs(power / (num_groups * num_rx), num_groups * num_rx * num_chirps, least)
    chosen = np.flatnonzero(rows)
    for m in range(num_groups):
        part = spectra[m][:, chosen]
        for tx in np.unique(schedule[m]):
            sent = schedule[m] == tx
            part[..., sent] -= part[..., sent].mean(axis=-1, keepdims=True)
        spectra[m][:, chosen] = part
    return rows


def chirp_runs(samples: np.ndarray, derotation: np.ndarray, least: int) -> np.ndarray:
    """Mark the cells of each chirp in a run, before data decisions.

    Parameters
    ----------
    samples : (L_rx, P, N) of one group
    derotation : (P, N) by which the decision derotates them

    Returns
    -------
    inside : (P, N) bool
    """
    num_rx, num_chirps = samples.shape[:2]
    power = np.zeros(samples.shape[1:], np.float32)
    none = np.zeros(0, int), np.empty((num_rx, 0, num_chirps), np.complex64)
    transform(samples, derotation, *none, tapered=power)
    return runs(power / num_rx, num_rx, least)
