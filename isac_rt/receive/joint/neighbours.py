"""Detections through the joint model: estimates at the Cramer-Rao bound, and paths that share a
cell told apart by direction and velocity.

Takes what the windowed map found, fits the strongest of it at once (`isac_rt.receive.joint.fit`),
and looks in what the fit leaves about each path for another one that the map could not show: at the
same delay, within two Doppler bins, from any other direction in view. What is found joins the fit.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.special import gammainccinv

from isac_rt.frame.waveform import SPEED_OF_LIGHT
from isac_rt.receive.arms import element_delays
from isac_rt.receive.joint.fit import (
    JointPath,
    fit,
    rate_bin,
    residual_channels,
    units,
)
from isac_rt.receive.joint.moments import Moments
from isac_rt.receive.known import Known
from isac_rt.receive.types import Detections

MAX_PATHS = 8
"""Strongest detections that are fitted; the others keep their own estimates."""
MAX_HIDDEN = 3
FALSE_RATE = 1e-4
"""Chance that noise invents a path in one search."""
WEAKEST_DB = 25.0
"""A path this far under the one whose cell it shares is not told from what the model leaves
(acceleration, near field)."""
DIRECTIONS, DOPPLER_OFFSETS = 31, np.arange(-2.0, 2.01, 0.5)
FARTHEST = np.array([1.5, 3.0])
"""Cells and bins that a path found beside another one may move away from it in the fit."""
PROBED_CELLS = (-1.5, -0.75, 0.75, 1.5)
"""Where a neighbour in the main lobe of Hann's window is sought besides, off the path in delay."""
LINE_OF_SIGHT_DB = 10.0
"""The earliest of the paths in a reference's cell that are no more than this below it is taken for
the line of sight."""


def refine_jointly(
    samples: np.ndarray, known: Known, detections: Detections
) -> tuple[Detections, np.ndarray]:
    """Detections with joint estimates, strongest first after a reference, and the power of each
    path per sample (NaN if not fitted)."""
    d = detections
    usable = np.flatnonzero(np.isfinite(d.direction).all(axis=1) & (d.range > 0))
    order = usable[np.argsort(~d.is_reference[usable], kind="stable")][:MAX_PATHS]
    if not order.size:
        return d, np.full(len(d), np.nan)
    start = [_path(known, d, i) for i in order]
    moments = Moments(samples, known)
    paths = fit(moments, start)
    parent = list(range(len(paths)))
    if not all(_near(known, p, s) for p, s in zip(paths, start, strict=True)):
        # two detections of one path: the fit has no single answer
        return d, np.full(len(d), np.nan)
    for _ in range(MAX_HIDDEN):
        found = _hidden(moments, paths)
        if found is None:
            break
        beside, other = found
        trial = fit(moments, [*paths, other], iterations=8)
        if not _credible(known, trial, [*paths, paths[beside]]):
            break
        paths, parent = trial, [*parent, parent[beside]]
    return _merged(known, d, order, paths, parent)


def separate(
    samples: np.ndarray, known: Known, reference: Detections
) -> tuple[Detections, np.ndarray] | None:
    """A reference that shares its cell with another path told apart from it by direction, delay and
    velocity.

    Parameters
    ----------
    samples : (M, L_rx, P, N)
    reference : one detection, whose estimate the other path may have pulled

    Returns
    -------
    detections, power : of both paths, the earlier one of like power the reference, and their powers
        per sample; None where no second path is found or the fit does not settle beside it
    """
    if not np.isfinite(reference.direction).all() or reference.range[0] <= 0:
        return None
    moments, start = Moments(samples, known), _path(known, reference, 0)
    paths = fit(moments, [start])
    found = _hidden(moments, paths, PROBED_CELLS) if _near(known, paths[0], start) else None
    if found is None:
        return None
    trial = fit(moments, [*paths, found[1]], iterations=12)
    if not _credible(known, trial, [*paths, paths[0]]):
        return None
    return _merged(known, reference, np.zeros(1, int), trial, [0, 0])


def _path(known: Known, d: Detections, i: int) -> JointPath:
    scale = known.passes / SPEED_OF_LIGHT
    return JointPath(
        float(d.range[i]) * scale,
        float(d.velocity[i]) * scale,
        d.direction[i].copy(),
        np.ones(1),
        np.zeros(4),
    )


def _near(known: Known, path: JointPath, start: JointPath) -> bool:
    moved = (
        np.abs([path.delay - start.delay, path.delay_rate - start.delay_rate]) / units(known)[:2]
    )
    return bool(
        np.isfinite(moved).all() and (moved < FARTHEST).all() and (path.direction**2).sum() < 1
    )


def _credible(known: Known, paths: list[JointPath], near: list[JointPath]) -> bool:
    """Whether a fit stayed near its start, and the new path, the last, is within `WEAKEST_DB` of
    its neighbour and not on top of it."""
    if not all(_near(known, p, n) for p, n in zip(paths, near, strict=True)):
        return False
    power = [float((np.abs(p.amplitude) ** 2).mean()) for p in paths]
    beside = max(power[i] for i, n in enumerate(near[:-1]) if n is near[-1])
    return power[-1] > beside * 10 ** (-WEAKEST_DB / 10) and power[-1] < beside * 10


def _hidden(
    moments: Moments, paths: list[JointPath], delays: tuple[float, ...] = ()
) -> tuple[int, JointPath] | None:
    """The surest path that the residual of a fit holds about one of its paths, with that path's
    number; sought at its delay and at so many cells off it."""
    known = moments.known
    limit = known.antennas.view_limit
    axis = np.linspace(-limit, limit, DIRECTIONS)
    grid = np.stack(np.meshgrid(axis, axis, indexing="ij"), axis=-1).reshape(-1, 2)
    grid = grid[(grid**2).sum(axis=1) < 0.98]
    best: tuple[float, int, JointPath] | None = None
    sums = 1 if known.passes == 2 else known.antennas.num_tx
    places = [*paths, *(_probe(known, p, cells) for p in paths for cells in delays)]
    parents = [*range(len(paths)), *(k for k in range(len(paths)) for _ in delays)]
    level = gammainccinv(sums, FALSE_RATE / (len(grid) * len(DOPPLER_OFFSETS) * len(places)))
    around = residual_channels(moments, places, DOPPLER_OFFSETS)
    for k, (path, channels, counts, noise) in zip(parents, around, strict=True):
        # (direction, offset), a sum of `sums` exponentials in noise
        power = _beams(known, path, channels, grid) / noise
        i, j = np.unravel_index(power.argmax(), power.shape)
        floor = (
            10 ** (-WEAKEST_DB / 10)
            * float((np.abs(paths[k].amplitude) ** 2 * counts).sum())
            / noise
        )
        if power[i, j] > max(level, floor) and (best is None or power[i, j] > best[0]):
            rate = path.delay_rate + DOPPLER_OFFSETS[j] * rate_bin(known.waveform)
            best = float(power[i, j]), k, replace(path, delay_rate=rate, direction=grid[i].copy())
    return None if best is None else best[1:]


def _probe(known: Known, path: JointPath, cells: float) -> JointPath:
    """A path without power beside another one: its residual is what the others leave there."""
    delay = path.delay + cells * known.waveform.delay_step
    return replace(path, delay=delay, amplitude=np.zeros_like(path.amplitude))


def _beams(known: Known, path: JointPath, channels: np.ndarray, grid: np.ndarray) -> np.ndarray:
    """Power of channel residuals (offset, L_tx, L_rx) in the directions of `grid` (G, 2): over both
    arrays for an echo; at a PT over the receivers, added over the transmit antennas. Normalised to
    what one beam of white noise holds per unit `noise`."""
    a, radius = known.antennas, known.radius(path.delay)
    turn = 2j * np.pi * known.waveform.effective_carrier

    def steer(positions: np.ndarray) -> np.ndarray:
        own = element_delays(positions, path.direction, radius)[0]
        return np.exp(turn * (element_delays(positions, grid, radius)[0] - own))

    beams = channels @ steer(a.rx_positions).conj().T  # (offset, L_tx, G)
    if known.passes == 2:
        beams = np.einsum("otg,gt->og", beams, steer(a.tx_positions).conj())[:, None, :]
    share = a.num_rx * (a.num_tx if known.passes == 2 else 1)
    return (np.abs(beams) ** 2).sum(axis=1).T / share


def _merged(
    known: Known, d: Detections, order: np.ndarray, paths: list[JointPath], parent: list[int]
) -> tuple[Detections, np.ndarray]:
    """The detections with the fitted ones in place of theirs and the new ones behind."""
    old, scale = len(d), known.metres
    source = np.append(np.arange(old), order[parent[order.size :]])
    rows = np.append(order, np.arange(old, source.size))
    power = np.full(source.size, np.nan)
    power[rows] = [float((np.abs(p.amplitude) ** 2).mean()) for p in paths]
    v = {name: value[source] for name, value in vars(d).items()}
    v["range"][rows] = [p.delay * scale for p in paths]
    v["velocity"][rows] = [p.delay_rate * scale for p in paths]
    limit = known.antennas.view_limit
    v["direction"][rows] = [
        np.where(np.abs(p.direction) <= limit, p.direction, np.nan) for p in paths
    ]
    v["std"][rows] = [p.std * [scale, scale, 1, 1] for p in paths]
    v["snr"][old:] *= power[old:] / power[source[old:]]
    v["is_reference"][old:] = False
    v["is_reference"] = _earlier_reference(v["is_reference"], v["range"], power, source, old)
    return Detections(**v), power


def _earlier_reference(
    reference: np.ndarray, ranges: np.ndarray, power: np.ndarray, source: np.ndarray, old: int
) -> np.ndarray:
    """(Q,) bool, the reference: of paths found in its cell within 10 dB of it the earliest is the
    line of sight."""
    out = np.zeros(reference.size, bool)
    for r in np.flatnonzero(reference)[:1]:
        least = 10 ** (-LINE_OF_SIGHT_DB / 10) * power[r]
        beside = old + np.flatnonzero((source[old:] == r) & (power[old:] > least))
        siblings = np.append(r, beside)
        out[siblings[np.argmin(ranges[siblings])]] = True
    return out
