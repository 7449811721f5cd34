"""Ghost tracks in a street: what explains each, and how many a geometric test at the active terminal finds.

An active terminal and two other UAVs in a canyon whose facades and ground mirror; no diffuse clutter. The truth (`det_kind`, `det_order`,
`det_face`, `track_uav`) says which tracks are ghosts; the test (`isac_rt.ghosts`) has the mesh, the terminal's own pose and its tracks.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import pandas as pd
import xarray as xr

from isac_rt import simulate
from isac_rt.arrays import antennas_of
from isac_rt.experiments.flight import SCENES
from isac_rt.experiments.outcome import Outcome, Progress, Verdict, proportion
from isac_rt.ghosts import Suspicion, Walls, suspicion
from isac_rt.metrics import resolutions
from isac_rt.propagation.pathset import PathKind
from isac_rt.randomness import generator
from isac_rt.scenario import Scenario
from isac_rt.scenario_file import load
from isac_rt.terminal import ActiveTerminal
from isac_rt.tracking import TrackSet
from isac_rt.waveform import waveform_of

SHARE = 0.5
"""A track is a ghost (or suspect) as a whole if it is in at least this share of its confirmed frames."""


def scene(seed: int, index: int, frames: int) -> Scenario:
    """The street canyon without diffuse clutter, its terminals and bodies at places and with speeds of their own."""
    rng = generator(seed, "ghosts", index)
    changes = [f"frames={frames}", "frame_interval_s=0.05", "clutter.model=none", "swarm.PT1.role=target"]
    for name, y in (("AT", -20.0), ("U1", rng.uniform(-10, 5)), ("PT1", rng.uniform(5, 20))):
        place = [rng.uniform(-6, 6), y, rng.uniform(6, 14)]
        speed = [rng.uniform(-1, 1), rng.uniform(2, 12) * (1 if name == "AT" else rng.choice([-1, 1])), rng.uniform(-0.5, 0.5)]
        changes += [f"swarm.{name}.position_m={np.round(place, 2).tolist()}", f"swarm.{name}.velocity_mps={np.round(speed, 2).tolist()}"]
    return load(SCENES / "street_canyon.yaml", tuple(changes), None, seed + index)


class Watched(ActiveTerminal):
    """The standard active terminal, asked after every frame which of its tracks are suspect."""

    def __init__(self, setup: simulate.Setup) -> None:
        s = setup.scenario
        super().__init__(setup.waveform, setup.antennas, s.receivers, s.tracking)
        self._walls = Walls(setup.city)
        self._resolution = resolutions(setup.waveform, setup.antennas, 2)
        self._period = 2 * setup.waveform.max_velocity(2)
        self.said: list[tuple[TrackSet, Suspicion]] = []

    def step(self, cube: Any, payload: Any, own_pose: Any, time: float, **options: Any) -> Any:
        reception, tracks = super().step(cube, payload, own_pose, time, **options)
        self.said.append((tracks, suspicion(tracks, own_pose, self._walls, self._resolution, self._period)))
        return reception, tracks


def watch(scenario: Scenario) -> tuple[xr.Dataset, list[tuple[TrackSet, Suspicion]]]:
    """Run a scenario with one active terminal and no passive one: its results, and what its test said frame by frame."""
    setup = simulate.prepare(scenario)
    terminal = Watched(setup)
    return simulate.run(scenario, setup=setup, terminal=lambda _setup, _link: terminal, snapshots=0).dataset, terminal.said


def explained_tracks(dataset: xr.Dataset, resolution: np.ndarray, velocity_period: float) -> pd.DataFrame:
    """Every confirmed track of every frame with what explains its detection.

    A track's detection is the nearest of its frame within one resolution of range and of velocity. Columns frame, observer, id, uav, and
    kind, order, face as in the results (-1 where the frame has no such detection).
    """
    d, rows = dataset, []
    places = {(f, o): np.flatnonzero((d.det_frame.values == f) & (d.det_observer.values == o))
              for f, o in set(zip(d.track_frame.values.tolist(), d.track_observer.values.tolist(), strict=True))}  # fmt: skip
    for t in np.flatnonzero(d.track_confirmed.values):
        frame, observer = int(d.track_frame.values[t]), int(d.track_observer.values[t])
        near = places[frame, observer]
        off = np.stack([d[f"det_{name}"].values[near] - d[f"track_{name}"].values[t] for name in ("range", "velocity")], axis=1)
        off[:, 1] -= velocity_period * np.round(off[:, 1] / velocity_period)
        off = np.abs(off) / resolution[:2]
        row = {"frame": frame, "observer": observer, "id": int(d.track_id.values[t]), "uav": int(d.track_uav.values[t])}
        inside = np.flatnonzero((off <= 1).all(axis=1))
        q = near[inside[np.argmin((off[inside] ** 2).sum(axis=1))]] if inside.size else None
        rows.append(row | {name: -1 if q is None else int(d[f"det_{name}"].values[q]) for name in ("kind", "order", "face")})
    return pd.DataFrame(rows, columns=["frame", "observer", "id", "uav", "kind", "order", "face"])


def whole_tracks(rows: pd.DataFrame) -> pd.DataFrame:
    """One row per track of `explained_tracks` with a column `suspect` (bool): number of confirmed frames, what the track is ("uav", "ghost"
    or "other": neither follows a UAV nor has detections that ghost paths explain), order and face that most ghost detections have, and
    whether the test suspects it."""
    out = []
    for key, track in rows.groupby([c for c in ("scene", "observer", "id") if c in rows]):
        found = track[track.kind >= 0]
        ghost = found[found.kind == int(PathKind.GHOST)]
        follows = (track.uav >= 0).mean() >= SHARE
        what = "uav" if follows else "ghost" if len(ghost) and len(ghost) >= SHARE * len(found) else "other"
        usual = [int(ghost[c].mode().iloc[0]) if what == "ghost" else -1 for c in ("order", "face")]
        out.append([*key, len(track), what, *usual, bool(track.suspect.mean() >= SHARE)])
    names = [c for c in ("scene", "observer", "id") if c in rows]
    return pd.DataFrame(out, columns=[*names, "frames", "what", "order", "face", "suspect"])


def run(quick: bool, seed: int, progress: Progress) -> Outcome:
    """Three flights of 12 frames, or ten of 24."""
    flights, frames = (3, 12) if quick else (10, 24)
    parts = []
    for index in range(flights):
        progress(index, flights)
        s = scene(seed, index, frames)
        w = waveform_of(s)
        dataset, said = watch(s)
        rows = explained_tracks(dataset, resolutions(w, antennas_of(s, w), 2), 2 * w.max_velocity(2))
        doubt = [(f, int(i), bool(q)) for f, (t, x) in enumerate(said) for i, q in zip(t.ids, x.suspect, strict=True)]
        parts.append(rows.merge(pd.DataFrame(doubt, columns=["frame", "id", "suspect"]), on=["frame", "id"]).assign(scene=index))
    progress(flights, flights)
    every = pd.concat(parts)
    tracks = whole_tracks(every)
    settings = {"quick": quick, "seed": seed, "flights": flights, "frames": frames, "share": SHARE}
    return Outcome("ghosts", "Ghost tracks and a geometric test", {"tracks": tracks, "frames": every}, None, verdicts(tracks), settings)


def verdicts(tracks: pd.DataFrame) -> tuple[Verdict, ...]:
    """The rates with and without the test, and what it costs."""
    kept, ghosts, uavs = tracks[~tracks.suspect], tracks[tracks.what == "ghost"], tracks[tracks.what == "uav"]

    def rate(some: pd.DataFrame) -> str:
        return proportion(int((some.what == "ghost").sum()), len(some)) if len(some) else "no track"

    explained = bool((ghosts.order > 0).all() and (ghosts.face >= 0).all())
    lost = proportion(int(uavs.suspect.sum()), len(uavs)) if len(uavs) else "no track"
    fewer = (kept.what == "ghost").sum() < len(ghosts)
    return (
        Verdict("Every ghost track is explained by its wall and order", "holds" if explained else "does not hold",
                f"{len(ghosts)} ghost tracks, {(ghosts.order == 1).sum()} of order 1, {(ghosts.order == 2).sum()} of order 2; "
                f"{(tracks.what == 'other').sum()} confirmed tracks are neither ghosts nor UAVs"),
        Verdict("A geometric test removes ghost tracks", "holds" if fewer else "does not hold",
                f"share of ghosts among confirmed tracks: without it {rate(tracks)}, with it {rate(kept)}; "
                f"tracks of UAVs that it takes away: {lost}"),
    )  # fmt: skip
