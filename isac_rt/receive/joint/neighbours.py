"""Detections through the joint model: estimates at the Cramer-Rao bound, and paths that share a
cell told apart by direction and velocity.

Takes what the windowed map found, fits it at once (`isac_rt.receive.joint.fit`), and looks in what
the fit leaves about the strongest paths for further ones that the map could not show: at the same
delay, within two Doppler bins, from any other direction in view. A path that is found is fitted
with those close to it; the others stay as they are.
"""

from __future__ import annotations

from collections.abc import Sequence, Set
from dataclasses import replace

import numpy as np
from scipy.special import gammainccinv

from isac_rt.frame.waveform import SPEED_OF_LIGHT
from isac_rt.receive.arms import element_delays
from isac_rt.receive.joint.fit import Fit, cell_positions, energy, fit, residual_channels
from isac_rt.receive.joint.interaction import clusters, shared
from isac_rt.receive.joint.moments import Moments
from isac_rt.receive.joint.tones import JointPath, rate_bin, units
from isac_rt.receive.known import Known
from isac_rt.receive.types import Detections

MAX_PATHS = 12
"""Strongest detections that are fitted; the others keep their own estimates."""
MAX_SEARCHED = 6
"""Strongest paths beside which others are looked for."""
MAX_NEIGHBOURS = 3
"""Further paths that are fitted in a frame."""
FALSE_RATE = 1e-4
"""Chance that noise invents a path in one search."""
MOST_STEPS = 8
"""Of a fit with a path that was found, which starts a fraction of a lobe off."""
WEAKEST_DB = 25.0
"""A path this far under the one whose cell it shares is not told from what the model leaves
(acceleration, near field)."""
DIRECTIONS, DOPPLER_OFFSETS = 31, np.arange(-2.0, 2.01, 0.5)
FARTHEST = np.array([1.5, 3.0])
"""Cells and bins that a path may move in the fit away from where it was found."""
MISFIT, MISFIT_OFFSETS = 2.5, np.array([-0.5, 0.0, 0.5])
"""Power of a channel over what is left about a path, where the path was taken out or so many bins
beside it, from which on the fit does not explain the samples; of 12 channels and more noise shows
it once in ten thousand."""
DISTANCES = np.array([-6.0, -5.0, -4.0, -3.0, -2.0, -1.0, 1.0, 2.0, 3.0, 4.0, 5.0, 6.0])
"""Cells or Doppler bins off a path where what is left is measured."""
PROBED_CELLS = (-1.5, -0.75, 0.75, 1.5)
"""Where a neighbour in the main lobe of Hann's window is sought besides, off the path in delay."""
LINE_OF_SIGHT_DB = 10.0
"""The earliest of the paths in a reference's cell that are no more than this below it is taken for
the line of sight."""


def refine_jointly(moments: Moments, detections: Detections) -> tuple[Detections, np.ndarray]:
    """Detections with joint estimates, strongest first after a reference, and the power of each
    path per sample (NaN if not fitted)."""
    known, d = moments.known, detections
    usable = np.flatnonzero(np.isfinite(d.direction).all(axis=1) & (d.range > 0))
    order = usable[np.argsort(~d.is_reference[usable], kind="stable")][:MAX_PATHS]
    if not order.size:
        return d, np.full(len(d), np.nan)
    start = [_path(known, d, i) for i in order]
    fitted = fit(moments, start)
    # two detections of one path run away from each other: neither has an answer of its own
    near = [_near(known, p, s) for p, s in zip(fitted.paths, start, strict=True)]
    group = _clusters(known, start)
    settled = ~np.isin(group, group[~np.array(near)])
    probed = {0} if d.is_reference[order[0]] else set()
    fitted, parent = _with_neighbours(moments, fitted, settled, probed)
    settled = np.append(settled, np.ones(len(parent), bool))
    return _merged(known, d, order, _widened(moments, fitted), parent, settled)


def _widened(moments: Moments, fitted: Fit) -> list[JointPath]:
    """The paths of a fit, with deviations by the power that is left about each: noise, and echoes
    that nothing found. They grow with the root of what the channels hold over it where the path
    was taken out: what no path explains may have moved it so far."""
    known, paths, noise = moments.known, fitted.paths, fitted.left / moments.size

    def left(beside: Sequence[JointPath], offsets: np.ndarray) -> np.ndarray:
        around = residual_channels(moments, fitted, beside, offsets)
        power = np.array([(np.abs(c) ** 2).mean(axis=(1, 2)) for c, _ in around])
        return power.reshape(len(paths), -1) / noise

    bins = left(paths, np.concatenate([DISTANCES, MISFIT_OFFSETS]))
    beside = [_probe(known, p, float(c)) for p in paths for c in DISTANCES]
    cells, at = left(beside, np.zeros(1)), bins[:, DISTANCES.size :].max(axis=1)
    near = np.abs(DISTANCES) == 1
    # a tangent of delay or of rate holds as much of a tone k cells or bins off as 1/k^2
    share = DISTANCES**-2.0 / (DISTANCES**-2.0).sum()
    about = np.hstack([cells[:, near], bins[:, : DISTANCES.size][:, near]]).mean(axis=1)
    level = np.stack([cells @ share, bins[:, : DISTANCES.size] @ share, about, about], axis=1)
    level[at > MISFIT * about] *= (at / about)[at > MISFIT * about, None]
    return [replace(p, std=p.std * s) for p, s in zip(paths, np.sqrt(level), strict=True)]


def _with_neighbours(
    moments: Moments, fitted: Fit, settled: np.ndarray, probed: Set[int]
) -> tuple[Fit, list[int]]:
    """A fit with the paths that are found beside its strongest settled ones behind, and beside
    which path each was; beside those `probed` they are sought off in delay too. Only what is close
    to a new path is fitted again."""
    parent = list(range(len(fitted.paths)))
    power = np.array([float((np.abs(p.amplitude) ** 2).mean()) for p in fitted.paths])
    searched = np.flatnonzero(settled)[np.argsort(-power[settled], kind="stable")][:MAX_SEARCHED]
    stale, spent = set(searched.tolist()), 0
    best: dict[int, tuple[float, int, JointPath]] = {}
    while spent < MAX_NEIGHBOURS:
        for k in stale:
            delays = PROBED_CELLS if k in probed else ()
            if (further := _further_path(moments, fitted, [k], delays)) is not None:
                best[k] = further
        stale = set()
        if not best:
            break
        surest = max(best, key=lambda k: best[k][0])
        trial = _joined(moments, fitted, surest, best.pop(surest)[2], settled)
        spent += 1
        if trial is None:
            continue
        fitted = trial
        parent.append(parent[surest])
        settled = np.append(settled, True)
        # what was found elsewhere may have been a sidelobe of the new one
        stale = {surest, *best, len(fitted.paths) - 1}
        best = {}
    return fitted, parent[power.size :]


def _joined(
    moments: Moments, fitted: Fit, beside: int, second: JointPath, settled: np.ndarray
) -> Fit | None:
    """A fit with another path behind, for which those close to it are fitted again; None where it
    does not settle."""
    known = moments.known
    group = _clusters(known, [*fitted.paths, second])
    mine = np.flatnonzero((group[:-1] == group[-1]) & settled)
    mine = np.union1d(mine, [beside])
    rest = np.setdiff1d(np.arange(len(fitted.paths)), mine)
    members = [fitted.paths[k] for k in mine]
    trial = fit(
        moments,
        [*members, second],
        iterations=MOST_STEPS,
        fixed=[fitted.paths[k] for k in rest],
        energy=fitted.left + energy(known, members),
    )
    at = int(np.searchsorted(mine, beside))
    if trial.left > fitted.left or not _credible(known, trial.paths, [*members, second], at):
        return None
    paths = [*fitted.paths, trial.paths[-1]]
    for k, path in zip(mine, trial.paths, strict=False):
        paths[k] = path
    return Fit(paths, trial.left)


def _clusters(known: Known, paths: list[JointPath]) -> np.ndarray:
    """(K,) number of the cluster of each path."""
    where = cell_positions(known, paths)
    return clusters(shared(known, where, where))


def separate(moments: Moments, reference: Detections) -> tuple[Detections, np.ndarray] | None:
    """A reference that shares its cell with another path told apart from it by direction, delay and
    velocity.

    Parameters
    ----------
    moments : of the frame's samples
    reference : one detection, whose estimate the other path may have pulled

    Returns
    -------
    detections, power : of both paths, the earlier one of like power the reference, and their powers
        per sample; None where no second path is found or the fit does not settle beside it
    """
    if not np.isfinite(reference.direction).all() or reference.range[0] <= 0:
        return None
    known = moments.known
    start = _path(known, reference, 0)
    single = fit(moments, [start])
    near = _near(known, single.paths[0], start)
    pair = _further_path(moments, single, [0], PROBED_CELLS) if near else None
    if pair is None:
        return None
    trial = fit(moments, [*single.paths, pair[2]], iterations=MOST_STEPS)
    if trial.left > single.left or not _credible(known, trial.paths, [*single.paths, pair[2]], 0):
        return None
    return _merged(
        known, reference, np.zeros(1, int), _widened(moments, trial), [0], np.ones(2, bool)
    )


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


def _credible(known: Known, paths: list[JointPath], before: list[JointPath], beside: int) -> bool:
    """Return whether a fit stayed near what was `before`, and the new path, the last, near where it
    was found, within `WEAKEST_DB` of the one `beside` which that was and not on top of it."""
    if not all(_near(known, p, n) for p, n in zip(paths, before, strict=True)):
        return False
    power = [float((np.abs(p.amplitude) ** 2).mean()) for p in paths]
    return power[beside] * 10 ** (-WEAKEST_DB / 10) < power[-1] < power[beside] * 10


def _further_path(
    moments: Moments, fitted: Fit, which: list[int], delays: tuple[float, ...] = ()
) -> tuple[float, int, JointPath] | None:
    """The surest path that the residual of a fit holds about some of its paths, with its power over
    the noise and the number of the path that it is beside; sought at that path's delay and at so
    many cells off it."""
    known = moments.known
    limit = known.antennas.view_limit
    axis = np.linspace(-limit, limit, DIRECTIONS)
    grid = np.stack(np.meshgrid(axis, axis, indexing="ij"), axis=-1).reshape(-1, 2)
    grid = grid[(grid**2).sum(axis=1) < 0.98]
    noise, sums = fitted.left / moments.size, 1 if known.passes == 2 else known.antennas.num_tx
    near_paths = [fitted.paths[k] for k in which]
    beside = [*near_paths, *(_probe(known, p, cells) for p in near_paths for cells in delays)]
    parents = [*which, *(k for k in which for _ in delays)]
    tried = len(grid) * len(DOPPLER_OFFSETS) * MAX_SEARCHED * (1 + len(delays))
    level = gammainccinv(sums, FALSE_RATE / tried)
    best: tuple[float, int, JointPath] | None = None
    around = residual_channels(moments, fitted, beside, DOPPLER_OFFSETS)
    for k, path, (channels, counts) in zip(parents, beside, around, strict=True):
        strength = float((np.abs(fitted.paths[k].amplitude) ** 2 * counts).sum()) / noise
        least = max(level, 10 ** (-WEAKEST_DB / 10) * strength, 0.0 if best is None else best[0])
        if (np.abs(channels) ** 2).sum(axis=(1, 2)).max() <= least * noise:
            continue  # no beam holds more than all channels
        # (direction, offset), a sum of `sums` exponentials in noise
        power = _beams(known, path, channels, grid) / noise
        i, j = np.unravel_index(power.argmax(), power.shape)
        if power[i, j] > least:
            rate = path.delay_rate + DOPPLER_OFFSETS[j] * rate_bin(known.waveform)
            best = float(power[i, j]), k, replace(path, delay_rate=rate, direction=grid[i].copy())
    return best


def _probe(known: Known, path: JointPath, cells: float) -> JointPath:
    """A path without power beside another one: its residual is what the others leave there."""
    delay = path.delay + cells * known.waveform.delay_step
    return replace(path, delay=delay, amplitude=np.zeros_like(path.amplitude))


def _beams(known: Known, path: JointPath, channels: np.ndarray, grid: np.ndarray) -> np.ndarray:
    """Power of channel residuals (offset, L_tx, L_rx) in the directions of `grid` (G, 2): over both
    arrays for an echo; at a PT over the receivers, added over the transmit antennas. Normalised to
    what one beam of white noise holds per unit `noise`."""
    a, radius = known.antennas, known.radius(path.delay)
    j_omega = 2j * np.pi * known.waveform.effective_carrier

    def steer(positions: np.ndarray) -> np.ndarray:
        delays = element_delays(positions, path.direction, radius)[0]
        return np.exp(j_omega * (element_delays(positions, grid, radius)[0] - delays))

    beams = channels @ steer(a.rx_positions).conj().T  # (offset, L_tx, G)
    if known.passes == 2:
        beams = np.einsum("otg,gt->og", beams, steer(a.tx_positions).conj())[:, None, :]
    share = a.num_rx * (a.num_tx if known.passes == 2 else 1)
    return (np.abs(beams) ** 2).sum(axis=1).T / share


def _merged(
    known: Known,
    d: Detections,
    order: np.ndarray,
    paths: list[JointPath],
    parent: list[int],
    settled: np.ndarray,
) -> tuple[Detections, np.ndarray]:
    """The detections with the fitted and `settled` ones in place of theirs, and the new ones, each
    beside its `parent`, behind."""
    old, scale = len(d), known.metres
    source = np.append(np.arange(old), order[parent])
    rows = np.append(order, np.arange(old, source.size))[settled]
    paths = [p for p, is_settled in zip(paths, settled, strict=True) if is_settled]
    power = np.full(source.size, np.nan)
    power[rows] = [float((np.abs(p.amplitude) ** 2).mean()) for p in paths]
    v = {name: value[source] for name, value in vars(d).items()}
    v["range"][rows] = [p.delay * scale for p in paths]
    v["velocity"][rows] = [p.delay_rate * scale for p in paths]
    limit = known.antennas.view_limit
    for row, p in zip(rows, paths, strict=True):
        v["direction"][row] = np.where(np.abs(p.direction) <= limit, p.direction, np.nan)
        v["std"][row] = p.std * [scale, scale, 1, 1]
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
