"""A small made-up run, driven through the recorder: for the tests of results, figures, report and
command line."""

from __future__ import annotations

import json
from dataclasses import asdict

import numpy as np

from isac_rt.frame.antennas import Arrays, antennas_of
from isac_rt.frame.schedule import conventional_schedule
from isac_rt.frame.waveform import waveform_of
from isac_rt.propagation.pathset import PathKind, make_paths
from isac_rt.receive.types import Detections, Maps, Reception
from isac_rt.results.losses import Loss
from isac_rt.results.metrics import Gospa, SymbolCount
from isac_rt.results.provenance import provenance
from isac_rt.results.recorder import Figures, Recorder, Results
from isac_rt.results.records import (
    DetectionLabels,
    FrameRecord,
    ObserverRecord,
    TrackTable,
    UavScores,
    UavValues,
)
from isac_rt.scenario.swarm import Uav
from isac_rt.scenario.tree import Scenario
from isac_rt.simulation.coverage import Coverage, coverage
from isac_rt.simulation.setup import swarm_of, timetable_of

STATES = ("acquiring", "tracking", "lost")
TIMING = {
    "setup": 1.25,
    "trace": 2.5,
    "synthesis": 3.75,
    "receive": 4.5,
    "track": 0.125,
    "other": 0.5,
    "total": 12.625,
    "wall": {
        "setup": 1.5,
        "trace": 2.5,
        "synthesis": 3.75,
        "receive": 4.75,
        "track": 0.25,
        "total": 8.5,
    },
}


def fake_scenario(frames: int = 7) -> Scenario:
    uavs = {
        "AT": Uav(role="active", position_m=(1.3, -20.7, 9.1), velocity_mps=(0.4, 6.1, 0.1)),
        "PT1": Uav(role="passive", position_m=(4.2, 13.7, 11.4), velocity_mps=(-0.3, -3.1, 0.2)),
        "U1": Uav(role="target", position_m=(-1.3, -4.9, 10.1), velocity_mps=(0.5, 9.7, 0.3)),
    }
    return Scenario(name="fake", seed=11, frames=frames, frame_interval_s=0.043, swarm=uavs)


def _values(own, poses, error: float = 0.0, keep=None) -> UavValues:
    columns = []
    for k, pose in enumerate(poses.values()):
        offset = pose.position - own.position
        distance = np.linalg.norm(offset)
        if distance == 0:
            columns.append([0.0, 0.0, 0.0, 0.0])
            continue
        e = own.to_body(offset / distance)
        rate = (offset / distance) @ (pose.velocity - own.velocity)
        row = np.array(
            [
                distance + error,
                rate - 2 * error,
                np.arctan2(e[0], e[1]) + error / 10,
                np.arcsin(e[2]),
            ]
        )
        columns.append(row if keep is None or keep[k] else row * np.nan)
    r, v, a, e = np.array(columns).T
    return UavValues(range=r, velocity=v, azimuth=a, elevation=e)


def _paths(own, poses, tx, rx, rng, count=23):
    kind = np.concatenate(
        [
            [PathKind.LEAKAGE if tx == rx else PathKind.LINE_OF_SIGHT, PathKind.TARGET],
            rng.integers(2, 5, count - 2),
        ]
    )
    u = rng.normal(size=(count, 3))
    u /= np.linalg.norm(u, axis=1, keepdims=True)
    return make_paths(
        gain=10 ** (-4 - 2 * rng.random(count)) * np.exp(2j * np.pi * rng.random(count)),
        delay=rng.uniform(3e-8, 6e-7, count),
        delay_rate=rng.normal(0, 3e-8, count),
        departure=u,
        arrival=-u,
        kind=kind,
        epoch=0.1,
        tx=tx,
        rx=rx,
        target=np.where(kind == PathKind.TARGET, 2, -1),
        bounces=np.where(kind == PathKind.SPECULAR, 1, 0),
        target_names=tuple(poses),
        points=rng.normal(0, 9, (count, 2, 3)),
        faces=rng.integers(0, 40, (count, 2)),
    )


def _maps(w, rng, passes):
    rows, doppler = 40, w.num_chirps
    power = rng.exponential(1e-12, (rows, doppler))
    power[17, 60] = 3e-9
    speed = (np.arange(doppler) - doppler // 2) * w.velocity_cell(passes)
    return Maps(
        range_doppler=power,
        range_axis=np.arange(rows) * w.range_cell(passes),
        velocity_axis=speed,
        equivalent_range=rng.rayleigh(1e-6, (64, doppler)),
        equivalent_detections=rng.random((64, doppler)) < 0.01,
    )


def _reception(w, rng, truth, maps, decoded, detections):
    found = Detections(
        range=truth.range[2] + rng.normal(0, 0.05, detections),
        velocity=truth.velocity[2] + rng.normal(0, 0.1, detections),
        direction=rng.uniform(-0.5, 0.5, (detections, 2)),
        snr=rng.uniform(20, 400, detections),
        std=np.full((detections, 4), 0.07),
        is_reference=np.zeros(detections, bool),
        starts=np.ones(detections, bool),
    )
    none = np.full((1, 1), -1)
    return Reception(
        detections=found,
        decoded=decoded,
        delay_symbols=none,
        transitions=none,
        bits=np.zeros(0, np.uint8),
        delay_confidence=none,
        transition_confidence=none,
        raw_delay_symbols=none,
        line_of_sight=decoded,
        reference_power=3.3e-13,
        maps=maps,
    )


def _labels(detections):
    rows = np.array([[1, 2, 0, -1], [3, -1, 1, 70123], [-1, -1, -1, -1], [4, -1, 1, 5]])
    kind, target, order, face = rows[:detections].T
    return DetectionLabels(kind, target, order, face, np.zeros(detections, bool), target)


def fake_records(scenario: Scenario, *, detections: int = 3) -> list[FrameRecord]:
    """Frames in which PT1 decodes all but the first, PT1 loses a tenth of the symbols of frame 3,
    and U1 is hidden in frame 4."""
    w, swarm, out = waveform_of(scenario.radio, scenario.array), swarm_of(scenario), []
    for f in range(scenario.frames):
        rng = np.random.default_rng([5, f])
        poses, snapshot, data = swarm.poses(f * 0.043 + 0.004), f == 2, f > 0
        observers = {}
        for name in ("AT", "PT1") if f % 2 == 0 else ("PT1",):
            own = poses[name]
            truth = _values(own, poses)
            hidden = np.array([False, False, f == 4])
            see = np.array([name == "PT1", False, True]) & ~hidden
            lost = 90 if f == 3 else 0
            sent = data and name == "PT1"
            observers[name] = ObserverRecord(
                transmitter="AT",
                reception=_reception(
                    w,
                    rng,
                    truth,
                    _maps(w, rng, 2 if name == "AT" else 1) if snapshot else None,
                    sent,
                    detections,
                ),
                paths=_paths(own, poses, "AT", name, rng),
                uavs=UavScores(
                    truth=truth,
                    detected=_values(own, poses, 0.0637, see),
                    tracked=_values(own, poses, 0.0213, see),
                    bound=UavValues(
                        **{
                            name: np.where(see, 0.004 * (k + 1), np.nan)
                            for k, name in enumerate(("range", "velocity", "azimuth", "elevation"))
                        }
                    ),
                    in_view=np.array([name == "PT1", False, True]),
                    occluded=hidden,
                    hit=see & (f != 5),
                    loss=np.where(see, Loss.INACCURATE if f == 5 else Loss.FOUND, -1),
                    target_snr=np.where(see, 317.0, np.nan),
                    target_cell_snr=np.where(see, 100.0, np.nan),
                    target_straddling=np.where(see, 0.8, np.nan),
                    target_whitened_snr=np.where(see, 50.0, np.nan),
                    target_clutter=np.where(see, 0.37, np.nan),
                    cooperative=np.array([True, True, False]),
                    genie=np.where(see, 0.97, np.nan),
                    clutter_free=np.where(see, 0.83, np.nan),
                    whitened=np.where(see, 0.79, np.nan),
                ),
                labels=_labels(detections),
                tracks=TrackTable(
                    id=np.array([4]),
                    range=truth.range[2:],
                    velocity=truth.velocity[2:],
                    u_x=np.array([0.1]),
                    u_z=np.array([0.02]),
                    confirmed=np.array([True]),
                    state=(
                        np.concatenate([poses["U1"].position - own.position, [0.3, -0.7, 0.1]])
                        + 0.0213
                    )[None],
                    covariance=np.diag([0.09, 0.16, 0.25, 0.04, 0.01, 0.02])[None],
                    kind=np.array([1]),
                    target=np.array([2]),
                    uav=np.array([2 if see[2] else -1]),
                    false=np.array([not see[2]]),
                    object=np.zeros(1, bool),
                ),
                state=int(f > 0),
                gospa=Gospa(0.3, 0.09, 0.0, 12.5 * (not see[2])),
                symbols=SymbolCount(
                    360, lost // 3, lost // 3, 351, lost, lost // 2, 4293, 2 * lost, 4293, 1
                )
                if sent
                else SymbolCount(),
                reference_snr=7.7,
            )
        out.append(
            FrameRecord(
                frame=f,
                time=f * 0.043 + 0.004,
                modulated=data,
                poses=poses,
                observers=observers,
                snapshot=snapshot,
            )
        )
    return out


def fake_recorder(scenario: Scenario) -> Recorder:
    w = waveform_of(scenario.radio, scenario.array)
    schedule = conventional_schedule(w.num_groups, w.num_chirps, w.num_tx)
    return Recorder(timetable_of(scenario, w, schedule), STATES)


def fake_coverage(scenario: Scenario) -> Coverage:
    w, a = waveform_of(scenario.radio, scenario.array), scenario.array
    schedule = conventional_schedule(w.num_groups, w.num_chirps, w.num_tx)
    timetable = timetable_of(scenario, w, schedule)
    return coverage(
        swarm_of(scenario), timetable, Arrays(antennas_of(a, w)), scenario.receivers, a.schedule
    )


def fake_run(scenario: Scenario | None = None, *, detections: int = 3) -> Results:
    scenario = scenario or fake_scenario()
    recorder = fake_recorder(scenario)
    for record in fake_records(scenario, detections=detections):
        recorder.add(record)
    budget = [{"link": "AT->PT1", "range_m": 34.4, "received_dbm": -71.2, "snr_db": 18.6}]
    plan = {"model": "free_space", "if_model": "exact"}
    summary = recorder.summary(Figures(TIMING, plan))
    attributes = {"fidelity": summary["fidelity"], "materials": {}, "link_budget": budget}
    attributes["coverage"] = asdict(fake_coverage(scenario))
    dataset = recorder.dataset().assign_attrs(
        provenance(scenario) | {name: json.dumps(value) for name, value in attributes.items()}
    )
    return Results(dataset, {"scenario": scenario.name, "seed": scenario.seed} | summary, scenario)
