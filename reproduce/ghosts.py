"""Ghost tracks in a street: what explains each, and how many a geometric test at the terminals
finds.

An active terminal, a passive one and another UAV in a canyon whose facades and ground mirror; no
diffuse clutter. The truth (`det_kind`, `det_order`, `det_face`, `track_uav`) says which tracks are
ghosts; the test (`isac_rt.extensions.city_receivers.ghosts`) has the mesh, the terminal's own pose
and its tracks.
At the passive terminal the line of sight over a wall, which shows the active terminal again, counts
as a ghost too.
"""

from __future__ import annotations

from typing import Any, Self

import numpy as np
import pandas as pd
import xarray as xr

from isac_rt.extensions.city_receivers.ghosts import Leeway, Suspicion, suspicion
from isac_rt.extensions.city_receivers.walls import Walls
from isac_rt.frame.antennas import antennas_of, resolutions
from isac_rt.frame.level import transmit_amplitude
from isac_rt.frame.link import Link
from isac_rt.frame.waveform import waveform_of
from isac_rt.propagation.pathset import PathKind
from isac_rt.randomness import generator
from isac_rt.scenario.file import load
from isac_rt.scenario.tree import Scenario
from isac_rt.simulation import simulate
from isac_rt.simulation.setup import Setup, prepare
from isac_rt.track.terminal import ActiveTerminal, PassiveTerminal
from isac_rt.track.tracker import TrackSet
from isac_rt.world.swarm import Pose
from reproduce import SCENES
from reproduce.outcome import Outcome, Progress, Sentences, Verdict, proportion

SHARE = 0.5
"""A track is a ghost (or suspect) as a whole if it is in at least this share of its confirmed
frames."""


def scene(seed: int, index: int, frames: int) -> Scenario:
    """The street canyon without diffuse clutter, its terminals and bodies at places and with speeds
    of their own."""
    rng = generator(seed, "ghosts", index)
    changes = [f"frames={frames}", "frame_interval_s=0.05", "clutter.model=none"]
    changes.append("receiver_preset=plain")  # initiation is to be tested here, not forbidden
    for name, y in (("AT", -20.0), ("U1", rng.uniform(-10, 5)), ("PT1", rng.uniform(5, 20))):
        place = [rng.uniform(-6, 6), y, rng.uniform(6, 14)]
        speed = [
            rng.uniform(-1, 1),
            rng.uniform(2, 12) * (1 if name == "AT" else rng.choice([-1, 1])),
            rng.uniform(-0.5, 0.5),
        ]
        changes += [
            f"swarm.{name}.position_m={np.round(place, 2).tolist()}",
            f"swarm.{name}.velocity_mps={np.round(speed, 2).tolist()}",
        ]
    return load(SCENES / "street_canyon.yaml", tuple(changes), None, seed + index)


class _Watched:
    """A standard terminal, asked after every frame which of its tracks are suspect."""

    def watch(self, setup: Setup, passes: int) -> Self:
        """`passes` of the range: 2 at an active terminal, 1 at a passive one."""
        self._walls = Walls(setup.city)
        self._leeway = Leeway.of(setup.waveform, setup.antennas, passes)
        self.said: list[tuple[TrackSet, Suspicion]] = []
        return self

    def note(self, tracks: TrackSet, own: Pose) -> None:
        """The test's answer for one frame's tracks."""
        self.said.append((tracks, suspicion(tracks, own, self._walls, self._leeway)))


class WatchedActive(_Watched, ActiveTerminal):
    """The active one."""

    def step(self, cube: Any, payload: Any, own_pose: Any, time: float, **options: Any) -> Any:
        reception, tracks = super().step(cube, payload, own_pose, time, **options)
        self.note(tracks, own_pose)
        return reception, tracks


class WatchedPassive(_Watched, PassiveTerminal):
    """The passive one."""

    def step(self, cube: Any, own_pose: Any, time: float, modulated: bool, **options: Any) -> Any:
        reception, tracks = super().step(cube, own_pose, time, modulated, **options)
        self.note(tracks, own_pose)
        return reception, tracks


def watch(scenario: Scenario) -> tuple[xr.Dataset, dict[str, list[tuple[TrackSet, Suspicion]]]]:
    """Run a scenario with one active terminal: its results, and what each terminal's test said
    frame by frame."""
    setup = prepare(scenario)
    s = setup.scenario
    watched: dict[str, WatchedActive | WatchedPassive] = {}

    def terminal(_setup: Setup, link: Link) -> WatchedActive | WatchedPassive:
        common = setup.waveform, setup.antennas, s.receivers, s.tracking
        if link.own:
            watched[link.rx] = WatchedActive(*common).watch(setup, 2)
        else:
            groups = setup.timetable.groups(link)
            passive = WatchedPassive(
                *common, s.modulation.dpsk_order, transmit_amplitude(s.noise), groups=groups
            )
            watched[link.rx] = passive.watch(setup, 1)
        return watched[link[1]]

    dataset = simulate.run(
        scenario, progress=None, setup=setup, terminal=terminal, snapshots=0
    ).dataset
    return dataset, {name: one.said for name, one in watched.items()}


def explained_tracks(
    dataset: xr.Dataset,
    observer: int,
    resolution: np.ndarray,
    velocity_period: float,
    passive: bool,
) -> pd.DataFrame:
    """Every confirmed track of every frame of one observer with what explains its detection.

    A track's detection is the nearest of its frame within one resolution of range and of velocity.
    Columns frame, observer, id, uav, kind, order, face as in the results (-1 where the frame has no
    such detection), and ghost: an echo with bounces or, at a passive terminal, the line of sight
    over a wall.
    """
    d, rows = dataset, []
    places = {
        (f, o): np.flatnonzero((d.det_frame.values == f) & (d.det_observer.values == o))
        for f, o in set(
            zip(d.track_frame.values.tolist(), d.track_observer.values.tolist(), strict=True)
        )
    }
    for t in np.flatnonzero(
        d.track_confirmed.values.astype(bool) & (d.track_observer.values == observer)
    ):
        frame = int(d.track_frame.values[t])
        near = places[frame, observer]
        off = np.stack(
            [
                d[f"det_{name}"].values[near] - d[f"track_{name}"].values[t]
                for name in ("range", "velocity")
            ],
            axis=1,
        )
        off[:, 1] -= velocity_period * np.round(off[:, 1] / velocity_period)
        off = np.abs(off) / resolution[:2]
        row = {
            "frame": frame,
            "observer": observer,
            "id": int(d.track_id.values[t]),
            "uav": int(d.track_uav.values[t]),
        }
        inside = np.flatnonzero((off <= 1).all(axis=1))
        q = near[inside[np.argmin((off[inside] ** 2).sum(axis=1))]] if inside.size else None
        row |= {
            name: -1 if q is None else int(d[f"det_{name}"].values[q])
            for name in ("kind", "order", "face")
        }
        rows.append(
            row
            | {
                "ghost": row["kind"] == PathKind.GHOST
                or (passive and row["kind"] == PathKind.SPECULAR)
            }
        )
    return pd.DataFrame(
        rows, columns=["frame", "observer", "id", "uav", "kind", "order", "face", "ghost"]
    )


def whole_tracks(rows: pd.DataFrame) -> pd.DataFrame:
    """One row per track of `explained_tracks` with columns terminal ("active" or "passive") and
    suspect (bool): number of confirmed frames, what the track is ("uav", "ghost" or "other":
    neither follows a UAV nor has detections that ghost paths explain), order and face that most
    ghost detections have, and whether the test suspects it."""
    out = []
    for key, track in rows.groupby([c for c in ("scene", "terminal", "id") if c in rows]):
        found = track[track.kind >= 0]
        ghost = found[found.ghost.astype(bool)]
        follows = (track.uav >= 0).mean() >= SHARE
        what = (
            "uav"
            if follows
            else "ghost"
            if len(ghost) and len(ghost) >= SHARE * len(found)
            else "other"
        )
        usual = [int(ghost[c].mode().iloc[0]) if what == "ghost" else -1 for c in ("order", "face")]
        out.append([*key, len(track), what, *usual, bool(track.suspect.mean() >= SHARE)])
    names = [c for c in ("scene", "terminal", "id") if c in rows]
    return pd.DataFrame(out, columns=[*names, "frames", "what", "order", "face", "suspect"])


def run(quick: bool, seed: int, progress: Progress) -> Outcome:
    """Three flights of 12 frames, or ten."""
    flights, frames = (3 if quick else 10), 12
    parts = []
    for index in range(flights):
        progress(index, flights)
        s = scene(seed, index, frames)
        dataset, said = watch(s)
        parts += [
            _of_terminal(s, dataset, name, received).assign(scene=index)
            for name, received in said.items()
        ]
    progress(flights, flights)
    every = pd.concat(parts, ignore_index=True)
    tracks = whole_tracks(every)
    settings = {"quick": quick, "seed": seed, "flights": flights, "frames": frames, "share": SHARE}
    tables = {"tracks": tracks, "frames": every}
    title = "Ghost tracks and a geometric test"
    return Outcome("ghosts", title, tables, None, verdicts(tracks), settings)


def _of_terminal(
    s: Scenario, dataset: xr.Dataset, name: str, said: list[tuple[TrackSet, Suspicion]]
) -> pd.DataFrame:
    """Explained tracks of one terminal and what its test said of them; a passive one's reference,
    which it does not doubt, is left out."""
    w, passive = waveform_of(s.radio, s.array), s.swarm[name].role == "passive"
    passes = 1 if passive else 2
    observer = dataset.observer.values.tolist().index(name)
    rows = explained_tracks(
        dataset,
        observer,
        resolutions(w, antennas_of(s.array, w), passes),
        2 * w.max_velocity(passes),
        passive,
    )
    doubt = [
        (f, int(t.ids[k]), bool(x.suspect[k]))
        for f, (t, x) in enumerate(said)
        for k in np.flatnonzero(~t.is_reference)
    ]
    reported = pd.DataFrame(doubt, columns=["frame", "id", "suspect"])
    return rows.merge(reported, on=["frame", "id"]).assign(
        terminal="passive" if passive else "active"
    )


say = Sentences("""
explained: Every ghost track of the {terminal} terminal is explained by its wall and order
  {ghosts} ghost tracks, {first} of order 1, {second} of order 2; {other} confirmed tracks are
  neither ghosts nor UAVs

removed: A geometric test removes ghost tracks of the {terminal} terminal
  share of ghosts among confirmed tracks: without it {without}, with it {with_it}; tracks of UAVs
  that it takes away: {lost}
""")


def verdicts(tracks: pd.DataFrame) -> tuple[Verdict, ...]:
    """The rates with and without the test, and what it costs, of each kind of terminal."""
    out: list[Verdict] = []
    for terminal, some in tracks.groupby("terminal"):
        out += _verdicts(str(terminal), some)
    return tuple(out)


def _verdicts(terminal: str, tracks: pd.DataFrame) -> tuple[Verdict, ...]:
    kept, ghosts, uavs = (
        tracks[~tracks.suspect],
        tracks[tracks.what == "ghost"],
        tracks[tracks.what == "uav"],
    )

    def rate(some: pd.DataFrame) -> str:
        return proportion(int((some.what == "ghost").sum()), len(some)) if len(some) else "no track"

    explained = bool((ghosts.order > 0).all() and (ghosts.face >= 0).all())
    lost = proportion(int(uavs.suspect.sum()), len(uavs)) if len(uavs) else "no track"
    fewer = (kept.what == "ghost").sum() < len(ghosts)
    reported = {
        "terminal": terminal,
        "ghosts": len(ghosts),
        "other": (tracks.what == "other").sum(),
    }
    orders = {"first": (ghosts.order == 1).sum(), "second": (ghosts.order == 2).sum()}
    rates = {"without": rate(tracks), "with_it": rate(kept), "lost": lost}
    return (
        say("explained", explained, **reported, **orders),
        say("removed", bool(fewer), terminal=terminal, **rates),
    )
