"""Sensing of a terminal over a run: rates, errors, GOSPA, causes of losses."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields
from itertools import pairwise
from typing import Any

import numpy as np

from isac_rt.propagation.pathset import PathKind
from isac_rt.results.bounds import error_quantile
from isac_rt.results.columns import MEASURES, PARTS
from isac_rt.results.dataset import Columns, errors_of, row_type
from isac_rt.results.losses import LOSSES
from isac_rt.results.metrics import GOSPA_CUTOFF_M, SymbolCount
from isac_rt.results.records import KINDS

RATES = ("ser_delay", "ser_dpsk", "ber", "hit_rate", "tracked_rate")
"""Shares of a summary that have a numerator and a denominator."""
BOUNDS = ("genie", "clutter_free", "whitened")
"""Detectors that the receiver is compared with: a matched filter at the true parameters, its own in
noise alone, and one that whitens the channels of a cell by the true clutter."""
SNR = ("matched", "windows", "straddling", "clutter")
"""SNR of a matched filter, and what windows, cells and whitening lose of it."""
ERROR_KEYS = tuple(key for _, key in MEASURES.values())
FALSE_CAUSES = (*KINDS, "noise")
"""What a false track is fed by; the last stands for -1."""


@dataclass(frozen=True)
class Sensing:
    """F frames of one or more links over U UAVs.

    Attributes
    ----------
    seen : (F, U) bool, in view and unoccluded; all that follows is of these only
    occluded : (F, U) bool, in the field of view but occluded
    hit : (F, U) bool
    detected, tracked : (F, U, 4) errors [m, m/s, deg, deg], NaN where there is no estimate
    followed : (F, U) bool, a confirmed track is within three resolutions
    bound : (F, U, 4) their least standard deviations, NaN where it is not seen
    loss : (F, U) `Loss`, -1 where it is not seen
    switched : (F, U) bool, another track follows it than the last that did
    resumed : (F, U) bool, followed again after frames in view in which no track did
    cooperative : (F, U) bool, terminals
    bounds : (F, U, 3) probabilities of detection, by `BOUNDS`
    snr : (F, U, 4) SNR of a matched filter and losses from it [dB], by `SNR`
    gospa : (F, 3) localisation, missed, false [m^2] of targets
    num_false, num_clutter : (F,) detections
    false_tracks : (F, kinds + 1) confirmed tracks far from every UAV, by `FALSE_CAUSES`
    object_tracks : (F,) confirmed tracks of objects
    ghosts : (F, U) those of them that ghosts of each UAV feed
    """

    seen: np.ndarray
    occluded: np.ndarray
    hit: np.ndarray
    detected: np.ndarray
    tracked: np.ndarray
    followed: np.ndarray
    bound: np.ndarray
    loss: np.ndarray
    switched: np.ndarray
    resumed: np.ndarray
    cooperative: np.ndarray
    bounds: np.ndarray
    snr: np.ndarray
    gospa: np.ndarray
    num_false: np.ndarray
    num_clutter: np.ndarray
    false_tracks: np.ndarray
    object_tracks: np.ndarray
    ghosts: np.ndarray

    @classmethod
    def of(cls, values: Columns, tracks: Columns, frame: np.ndarray) -> Sensing:
        """One link's frames in their order, of `isac_rt.results.columns.TABLES`.

        Parameters
        ----------
        values : (F,) of the observer
        tracks, frame : (K,) its tracks, and the frame of each
        """
        in_view, occluded = np.array(values["in_view"]), np.array(values["occluded"])
        count, num_uavs = in_view.shape

        def errors(group: str) -> np.ndarray:
            by_axis = {
                name: values[f"bound_{name}"]
                if group == "bound"
                else errors_of(values, group, name)
                for name in MEASURES
            }
            in_units = [np.rad2deg(e) if MEASURES[n][0] == "rad" else e for n, e in by_axis.items()]
            return np.stack(in_units, axis=-1)

        def counted(what: np.ndarray, of: np.ndarray, most: int) -> np.ndarray:
            """Count the tracks of each number under `most`, frame by frame."""
            out = np.zeros((count, most), int)
            np.add.at(out, (frame[of], what[of]), 1)
            return out

        false = tracks["false"] > 0
        kind, ghost_of = tracks["kind"], tracks["target"]
        ghost = false & (kind == PathKind.GHOST) & (ghost_of >= 0)
        return cls(
            in_view & ~occluded,
            occluded,
            np.array(values["hit"]),
            errors("detected"),
            errors("tracked"),
            counted(tracks["uav"], tracks["uav"] >= 0, num_uavs) > 0,
            errors("bound"),
            np.array(values["loss"]),
            *_breaks(tracks, frame, in_view & ~occluded),
            np.array(values["cooperative"]),
            np.stack([values[name] for name in BOUNDS], axis=-1),
            _levels(values),
            np.stack([values[f"gospa_{part}"] for part in PARTS], axis=-1),
            np.array(values["num_false"]),
            np.array(values["num_clutter"]),
            counted(np.where(kind < 0, len(KINDS), kind), false, len(FALSE_CAUSES)),
            np.bincount(frame, tracks["object"], count).astype(int),
            counted(ghost_of, ghost, num_uavs),
        )

    @classmethod
    def of_nothing(cls, num_uavs: int) -> Sensing:
        """No frame at all."""
        values, tracks = (np.zeros(0, row_type(kind, num_uavs)) for kind in ("observer", "track"))
        return cls.of(values, tracks, np.zeros(0, int))

    @staticmethod
    def pooled(parts: Sequence[Sensing]) -> Sensing:
        """Several links' frames together."""
        names = [f.name for f in fields(Sensing)]
        return Sensing(*(np.concatenate([getattr(p, name) for p in parts]) for name in names))

    def block(self) -> dict[str, Any]:
        """Summarise sensing under the keys of a terminal or link in `summary.json`."""
        frames, false = len(self.seen), self.false_tracks.sum(axis=0)
        return {
            **self._scores(~self.cooperative),
            "gospa": gospa_block(self.gospa, self.seen & ~self.cooperative),
            "false_per_frame": share(int(self.num_false.sum()), frames),
            "clutter_per_frame": share(int(self.num_clutter.sum()), frames),
            "false_tracks_per_frame": share(int(false.sum()), frames),
            "false_tracks": {
                name: share(int(n), frames) for name, n in zip(FALSE_CAUSES, false, strict=True)
            },
            "object_tracks_per_frame": share(int(self.object_tracks.sum()), frames),
            "cooperative": self._scores(self.cooperative),
        }

    def targets(self, names: Sequence[str]) -> dict[str, dict[str, Any]]:
        """Summarise each UAV, by its name."""
        return {name: self._target(i) for i, name in enumerate(names)}

    def _target(self, i: int) -> dict[str, Any]:
        errors, least = self.detected[self.seen[:, i], i], self.bound[self.seen[:, i], i]
        least = np.where(np.isfinite(errors), least, np.nan)
        return {
            "in_view": int(self.seen[:, i].sum()),
            "occluded": int(self.occluded[:, i].sum()),
            "found": int(self.hit[:, i].sum()),
            "detected": int(np.isfinite(errors[:, 0]).sum()),
            "tracked": int((self.followed & self.seen)[:, i].sum()),
            "switches": int(self.switched[:, i].sum()),
            "interruptions": int(self.resumed[:, i].sum()),
            "ghost_tracks": int(self.ghosts[:, i].sum()),
            "median": _by_axis(np.abs(errors), np.median),
            "p90": _by_axis(np.abs(errors), lambda e: np.percentile(e, 90)),
            "bound_median": _by_axis(least, lambda s: error_quantile(s, 0.5)),
            "bound_p90": _by_axis(least, lambda s: error_quantile(s, 0.9)),
            "losses": _counts(self.loss[:, i]),
        }

    def counts(self) -> dict[str, list[int]]:
        """Return numerator and denominator of the targets' rates."""
        seen = self.seen & ~self.cooperative
        rates = {"hit_rate": self.hit, "tracked_rate": self.followed}
        return {name: [int((of & seen).sum()), int(seen.sum())] for name, of in rates.items()}

    def _scores(self, of: np.ndarray) -> dict[str, Any]:
        """Score some of the UAVs (F, U) over the target-frames in view."""
        seen = self.seen & of
        detected, tracked = (
            np.isfinite(errors[..., 0]) & seen for errors in (self.detected, self.tracked)
        )
        shares = {
            "hit_rate": self.hit & seen,
            "tracked_rate": self.followed & seen,
            "matched": detected,
            "matched_tracked": tracked,
        }
        in_view = int(seen.sum())
        return {
            "in_view": in_view,
            **{name: share(int(mask.sum()), in_view) for name, mask in shares.items()},
            "bounds": _means(self.bounds[seen], BOUNDS),
            "snr_db": _means(self.snr[seen], SNR),
            "rmse": _by_axis(self.detected[detected], rms),
            "rmse_tracked": _by_axis(self.tracked[tracked], rms),
            "losses": _counts(self.loss[seen]),
        }


def _means(values: np.ndarray, names: Sequence[str]) -> dict[str, float | None]:
    """Average finite values (n, names) over target-frames; null of none."""
    finite = values[np.isfinite(values).all(axis=1)]
    mean = finite.mean(axis=0) if len(finite) else [None] * len(names)
    return {k: None if v is None else float(v) for k, v in zip(names, mean, strict=True)}


def _levels(values: Columns) -> np.ndarray:
    """(F, U, 4) `SNR` of the UAVs in view, NaN of the others [dB]."""
    matched, cell, whitened = (values[f"target_{k}snr"] for k in ("", "cell_", "whitened_"))
    share = values["target_straddling"]
    with np.errstate(divide="ignore", invalid="ignore"):  # a path that begins at the frame's end
        ratios = [matched, matched * share / cell, 1 / share, cell / whitened]
        return np.stack([10 * np.log10(ratio) for ratio in ratios], axis=-1)


def gospa_block(parts: np.ndarray, seen: np.ndarray) -> dict[str, float | None]:
    """GOSPA over frames under the keys of the summary; null without frames.

    Parameters
    ----------
    parts : (F, 3) localisation, missed, false [m^2]
    seen : (F, U) bool, what ought to be in the set of fused tracks
    """
    if not len(parts):
        return dict.fromkeys(("total_m", "missed", "false", "localisation_m", "no_tracks_m"))
    localisation, missed, false = np.mean(parts, axis=0)
    penalty = GOSPA_CUTOFF_M**2 / 2
    return {
        "total_m": float(np.sqrt(localisation + missed + false)),
        "missed": float(missed / penalty),
        "false": float(false / penalty),
        "localisation_m": float(np.sqrt(localisation)),
        "no_tracks_m": float(np.sqrt(penalty * seen.sum(axis=1).mean())),
    }


def _breaks(tracks: Columns, frame: np.ndarray, seen: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(F, U) where another track follows a UAV than the last that did, and where one follows it
    again after frames in view in which none did."""
    switched, resumed = np.zeros((2, *seen.shape), bool)
    last: dict[int, int] = {}
    lost: set[int] = set()
    followed = tracks["uav"] >= 0
    uav, number, frame = tracks["uav"][followed], tracks["id"][followed], frame[followed]
    edges = np.searchsorted(frame, np.arange(len(seen) + 1))
    for f, (begin, end) in enumerate(pairwise(edges)):
        follows = dict(zip(uav[begin:end].tolist(), number[begin:end].tolist(), strict=True))
        for u, k in follows.items():
            switched[f, u] = last.get(u, k) != k
            resumed[f, u] = u in lost
            last[u] = k
        lost -= follows.keys()
        lost |= {u for u in last if seen[f, u] and u not in follows}
    return switched, resumed


def rms(errors: np.ndarray) -> float:
    """Root of the mean square."""
    return float(np.sqrt(np.mean(errors**2)))


def _by_axis(errors: np.ndarray, measure: Any) -> dict[str, float | None]:
    """A measure of the errors (n, 4) on each axis that are not NaN, by the fixed keys; null where
    there are none."""
    out: dict[str, float | None] = {}
    for key, column in zip(ERROR_KEYS, errors.reshape(-1, len(ERROR_KEYS)).T, strict=True):
        finite = column[np.isfinite(column)]
        out[key] = float(measure(finite)) if finite.size else None
    return out


def _counts(loss: np.ndarray) -> dict[str, int]:
    return {name: int((loss == i).sum()) for i, name in enumerate(LOSSES)}


def share(part: int, whole: int) -> float | None:
    """A part of a whole; null of nothing."""
    return part / whole if whole else None


MISREAD = 0.5
"""Share of wrong delay or DPSK symbols from which on a frame that was read is misread."""


def latencies(symbols: SymbolCount | None, rows: Sequence[np.ndarray]) -> dict[str, Any] | None:
    """Data frames sent to a receiver and read by it, at once or late; null where it receives none.

    Parameters
    ----------
    symbols : what was sent to it
    rows : of the receiver's links
    """
    if symbols is None:
        return None
    names = ("latency_frames", "symbol_errors", "symbol_total")
    waits, errors, total = (np.concatenate([of[name] for of in rows]) for name in names)
    misread = (errors > MISREAD * total)[:, :2].any(axis=1)
    read = waits[waits >= 0]
    return {
        "sent": symbols.frames,
        "read": read.size,
        "erased": symbols.frames - read.size,
        "misread": int((misread & (waits >= 0)).sum()),
        "late": int((read > 0).sum()),
        "mean": float(read.mean()) if read.size else None,
        "most": int(read.max()) if read.size else None,
    }


def summary_block(
    role: str | list[str], sensing: Sensing, symbols: SymbolCount | None, duration: float
) -> dict[str, Any]:
    """One terminal's (or link's) figures under the fixed keys of `summary.json`; null where one
    does not apply (`docs/outputs.md` says what each means).

    Parameters
    ----------
    duration : from the first frame to the end of the last, pauses and pilots included [s]
    """
    c = symbols or SymbolCount()
    receives = symbols is not None
    counts = {
        "ser_delay": [c.delay_errors, c.delay_total],
        "ser_dpsk": [c.dpsk_errors, c.dpsk_total],
        "ber": [c.bit_errors, c.bits_total],
        **sensing.counts(),
    }
    return {
        "role": role,
        "ser_dpsk": share(c.dpsk_errors, c.dpsk_total),
        "ser_delay": share(c.delay_errors, c.delay_total),
        "ber": share(c.bit_errors, c.bits_total),
        "erased": share(c.delay_erased + c.dpsk_erased, c.delay_total + c.dpsk_total),
        "bits": c.bits_decoded if receives else None,
        "bit_rate_bps": c.bits_decoded / duration if receives else None,
        **sensing.block(),
        "counts": counts,
    }
