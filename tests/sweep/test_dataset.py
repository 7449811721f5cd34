"""Data sets: what is drawn keeps apart what it says, what is read back is what was simulated."""

from __future__ import annotations

import gzip
import hashlib
import io
import json
import tarfile
from pathlib import Path

import numpy as np
import pytest
from fake_run import fake_run
from test_sweep import BASE

import isac_rt as irt
from isac_rt.document import ScenarioError
from isac_rt.results.files import ResultsError
from isac_rt.scenario.tree import Scenario
from isac_rt.simulation.setup import prepare
from isac_rt.sweep import Samples, load_dataset
from isac_rt.sweep.execute import run_job
from isac_rt.sweep.make_dataset import SceneJob, Shards, _write_card, run_dataset
from isac_rt.sweep.outcomes import pending
from isac_rt.sweep.shards import _truth, tar_of

SET = """
name: drawn
scenario: base.yaml
set: {frame_interval_s: 0.5}
scenes: 20
seed: 5
place: {east_m: [-40, 70], north_m: [10, 121], cell_m: 18, up_m: [-3.5, 11]}
draw:
  noise.snr_db: {uniform: [-7.5, 12]}
  swarm.P1.position_m: {normal: [[-1.9, 5.3, 50.7], [0.4, 0.3, 0.2]]}
  radio.bandwidth_hz: {log_uniform: [2.1e8, 4.3e8]}
  modulation.dpsk_order: {choice: [2, 8]}
splits: {train: 0.6, test: 0.4}
"""
STAY = """
name: two
scenario: base.yaml
scenes: 2
draw: {noise.snr_db: {uniform: [3, 12]}}
splits: {train: 1, test: 1}
keep: [map, samples, paths, detections, tracks, bits]
"""


@pytest.fixture
def folder(tmp_path) -> Path:
    (tmp_path / "base.yaml").write_text(BASE)
    return tmp_path


def plan_of(folder: Path, text: str):
    (folder / "set.yaml").write_text(text)
    return load_dataset(folder / "set.yaml")


def test_an_earlier_key_is_refused_with_its_name_today(folder):
    """Planted bug: `rotate` without its entry among the removed keys."""
    text = SET.replace("cell_m: 18", "cell_m: 18, turn: false")
    with pytest.raises(ScenarioError, match=r"place\.turn.*rotate"):
        plan_of(folder, text)


def test_splits_share_no_street_and_no_flight(folder):
    """Where every UAV is at the first and the last frame, from the drawn numbers by hand: all of a
    scene in one cell of the grid, and no cell in two splits; shares to the scene. Planted bugs: the
    cell by the scene's number; a flight that begins in its cell and ends in the next."""
    plan = plan_of(folder, SET)
    cells: dict[str, set[tuple[int, int]]] = {"train": set(), "test": set()}
    slot = irt.prepare(Scenario.model_validate(plan.scenes[0].tree)).timetable
    for scene in plan.scenes:
        for uav in scene.tree["swarm"].values():
            for time in (slot.epoch(0), slot.epoch(2)):
                at = np.array(uav["position_m"]) + time * np.array(uav["velocity_mps"])
                east, north = (at[:2] - [-40, 10]) // 18
                cells[scene.split].add((int(east), int(north)))
                assert -40 <= at[0] <= 68 and 10 <= at[1] <= 118
                assert 40 < at[2] < 70
    assert not cells["train"] & cells["test"] and len(cells["train"]) > len(cells["test"]) > 2
    assert [sum(s.split == name for s in plan.scenes) for name in ("train", "test")] == [12, 8]
    assert len({json.dumps(scene.tree) for scene in plan.scenes}) == 20
    seeds = {scene.tree["seed"] for scene in plan.scenes}
    assert len(seeds) == 20


def test_a_swarm_is_turned_as_one(folder):
    """Directions between UAVs, along velocities and boresights keep their angles and lengths.
    Planted bug: boresights left where they were."""
    plan = plan_of(folder, SET.replace("  swarm.P1.position_m", "  # swarm.P1.position_m"))
    base = plan.base.swarm
    turns = set()
    for scene in plan.scenes:
        a, p = (scene.tree["swarm"][name] for name in ("A", "P1"))
        away = np.subtract(p["position_m"], a["position_m"])
        first = np.subtract(base["P1"].position_m, base["A"].position_m)
        assert np.linalg.norm(away) == pytest.approx(np.linalg.norm(first), rel=1e-12)
        for uav, own in ((a, base["A"]), (p, base["P1"])):
            for key in ("velocity_mps", "boresight"):
                before = np.dot(first, getattr(own, key))
                assert np.dot(away, uav[key]) == pytest.approx(before, abs=1e-9)
        turns.add(round(np.arctan2(away[1], away[0]), 3))
    assert len(turns) == 20


def test_a_flight_of_a_file_is_turned_with_its_attitude(folder):
    """The nose keeps its angle to the way flown (37 degrees to the right of it), pitch and roll
    stay. Planted bug: the yaw of the file kept."""
    rows = "time_s,x,y,z,yaw_deg,pitch_deg,roll_deg\n0,1,5,50,37,-3,8\n10,1,9,51,37,-3,8\n"
    (folder / "p1.csv").write_text(rows)
    start = BASE.index("  P1:")
    (folder / "base.yaml").write_text(BASE[:start] + "  P1: {role: passive, flight: p1.csv}\n")
    text = SET.replace("  swarm.P1.position_m", "  # swarm.P1.position_m")
    for scene in plan_of(folder, text).scenes:
        first, last = scene.tree["swarm"]["P1"]["waypoints"]
        east, north, _ = np.subtract(last["position_m"], first["position_m"])
        yaw, pitch, roll = first["attitude_deg"]
        right = yaw - np.degrees(np.arctan2(east, north))
        assert right % 360 == pytest.approx(37, abs=1e-9)
        assert (pitch, roll) == (-3, 8)


def test_a_formation_is_drawn_and_turned_as_one(folder):
    """Its members stand as far apart as the drawn spacing says, in the heading of the turned
    flight. Planted bug: the members of the base scenario kept."""
    text = SET.replace(
        "swarm.P1.position_m: {normal: [[-1.9, 5.3, 50.7], [0.4, 0.3, 0.2]]}",
        "swarm.P1.formation.spacing_m: {uniform: [1.5, 2.5]}",
    ).replace("set: {", "set: {swarm.P1.formation: {shape: column, spacing_m: 9, count: 3}, ")
    drawn = set()
    for scene in plan_of(folder, text).scenes:
        swarm = scene.tree["swarm"]
        assert list(swarm) == ["A", "P1_1", "P1_2", "P1_3"]
        first, second, third = (np.array(swarm[f"P1_{k}"]["position_m"]) for k in (1, 2, 3))
        apart = np.linalg.norm(second - first)
        assert 1.5 <= apart <= 2.5
        way = np.array(swarm["P1_1"]["velocity_mps"])
        np.testing.assert_allclose(third - first, -2 * apart * way / np.linalg.norm(way), atol=1e-9)
        drawn.add(round(float(apart), 6))
    assert len(drawn) == 20


def test_draws_have_their_distributions(folder):
    """Bounds, and over 400 scenes the middle of each within four standard errors. Planted bug: a
    uniform draw in place of one uniform in the logarithm (its mean is 0.4 deviations higher)."""
    text = SET.replace("scenes: 20", "scenes: 400").replace("place:", "# place:")
    scenes = [scene.tree for scene in plan_of(folder, text).scenes]
    snr = np.array([t["noise"]["snr_db"] for t in scenes])
    assert snr.min() >= -7.5 and snr.max() <= 12
    assert abs(snr.mean() - 2.25) < 4 * 19.5 / np.sqrt(12 * 400)
    log = np.log([t["radio"]["bandwidth_hz"] for t in scenes])
    low, high = np.log([2.1e8, 4.3e8])
    assert abs(log.mean() - (low + high) / 2) < 4 * (high - low) / np.sqrt(12 * 400)
    east = np.array([t["swarm"]["P1"]["position_m"][0] for t in scenes])
    assert abs(east.mean() + 1.9) < 4 * 0.4 / 20 and abs(east.std() / 0.4 - 1) < 4 / np.sqrt(800)
    order = [t["modulation"]["dpsk_order"] for t in scenes]
    assert set(order) == {2, 8} and abs(order.count(2) - 200) < 4 * 10


def test_what_is_drawn_does_not_depend_on_who_asks(folder):
    keys = [point.key for point in plan_of(folder, SET).points()]
    assert keys == [point.key for point in plan_of(folder, SET).points()]
    other = [point.key for point in plan_of(folder, SET.replace("seed: 5", "seed: 6")).points()]
    assert not set(keys) & set(other)
    kept = SET + "keep: [map]\n"
    assert not set(keys) & {point.key for point in plan_of(folder, kept).points()}


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (("cell_m: 18", "cell_m: 200"), "no whole cell fits"),
        (("cell_m: 18", "cell_m: 60"), "1 cells for 2 splits, which share none"),
        (("cell_m: 18", "cell_m: 2.5"), "the flights need"),
        (("uniform: [-7.5, 12]", "uniform: [12, -7.5]"), "the second no lower"),
        (("uniform: [-7.5, 12]", "uniform: [1, 2], choice: [3]"), "keep one of these"),
        (("log_uniform: [2.1e8", "log_uniform: [-1"), "must be over 0"),
        (("noise.snr_db:", "noise.snr_dB:"), "snr_dB"),
        (("swarm.P1.position_m: {normal", "swarm.P9.position_m.0: {normal"), "P9"),
        (("  noise.snr_db", "  seed: {choice: [1]}\n  noise.snr_db"), "own; remove it"),
        (("scenes: 20", "scenes: 0"), "scenes"),
        (("noise.snr_db:", "swarm:"), "no such key"),
        (("swarm.P1.position_m: {normal", "swarm.P1.position_m.x: {normal"), "no such key"),
        (("[-7.5, 12]", "[-1.0e+308, 1.0e+308]"), "must be finite"),
        (("east_m: [-40, 70]", "east_m: [-1.0e+308, 1.0e+308]"), "east_m"),
        (("cell_m: 18", "cell_m: 1.0e-7"), "make them larger"),
        (("train: 0.6", "train: 1.0e+308"), "train"),
        (("scenario: base.yaml", "scenario: none.yaml"), "cannot be used"),
    ],
)
def test_what_cannot_be_drawn_is_one_message(folder, change, said):
    assert change[0] in SET
    with pytest.raises(ScenarioError, match=said) as refused:
        plan_of(folder, SET.replace(*change))
    assert "set.yaml" in str(refused.value)


def jobs_of(plan, out: Path) -> list[SceneJob]:
    (out / "points").mkdir(parents=True, exist_ok=True)
    return [
        SceneJob(
            key=point.key,
            tree=point.tree,
            ground=point.ground,
            scenario_folder=str(plan.base.folder),
            folder=str(out),
            threads=1,
            number=point.index[0],
            split=plan.scenes[point.index[0]].split,
            keep=plan.data.keep,
        )
        for point in plan.points()
    ]


def test_samples_are_those_of_the_run(folder):
    """Every array of a split against a run of the drawn scenario by itself. Planted bugs: frames
    of the next scene; bits of the other transmitter."""
    plan, out = plan_of(folder, STAY), folder / "out"
    for job in jobs_of(plan, out):
        assert run_job(job).status == "done"
    card = _write_card(plan, Shards(out))
    assert {name: sum(s.values()) for name, s in card["splits"].items()} == {"train": 6, "test": 6}
    number = next(k for k, scene in enumerate(plan.scenes) if scene.split == "test")
    alone = Scenario.model_validate(plan.scenes[number].tree)
    setup = prepare(alone)
    d = irt.run(alone, setup=setup, snapshots=3).dataset
    samples = Samples(out, "test")
    assert len(samples) == 6 and len(Samples(out, "train")) == 6
    seen, maps = set(), 0
    for k in range(6):
        sample = samples[k]
        _, frame, link = sample["key"].split("_", 2)
        f, o = int(frame), ["A_to_A", "A_to_P1"].index(link)
        seen.add((f, o))
        cube = setup.frame(f).samples(tuple(link.split("_to_")))
        assert np.array_equal(sample["samples"], cube.samples)
        assert np.array_equal(sample["bits"], setup.frame(f).sent["A"].payload.bits)
        rows = np.isfinite(d.map_range.values[o])
        columns = np.isfinite(d.map_velocity.values[o])
        shot = [*d.snapshot_frame.values].index(f) if f in d.snapshot_frame.values else None
        if shot is not None and np.isfinite(d.map_power.values[shot, o]).any():
            power = d.map_power.values[shot, o][np.ix_(rows, columns)]
            assert np.array_equal(sample["map"], power)
            assert len(sample["map_range"]) == len(power)
            maps += 1
        else:
            assert "map" not in sample
        mine = (d.path_frame.values == f) & (d.path_observer.values == o)
        assert np.array_equal(sample["paths"][:, 1], d.path_delay.values[mine])
        found = (d.det_frame.values == f) & (d.det_observer.values == o)
        assert np.array_equal(sample["detections"][:, 0], d.det_range.values[found])
        a, p = (sample["truth"]["uavs"][name] for name in ("A", "P1"))
        away = np.linalg.norm(np.subtract(a["position_m"], p["position_m"]))
        assert p["range"] == pytest.approx(away) if o == 0 else a["range"] == pytest.approx(away)
    assert len(seen) == 6 and maps == 6
    assert set(Samples(out, "test", ["bits"])[0]) == {"key", "truth", "bits"}
    with pytest.raises(IndexError):
        samples[6]
    with pytest.raises(ResultsError, match="there are train, test"):
        Samples(out, "val")


def test_the_truth_of_a_sample_tells_who_is_occluded():
    """Against the dataset of a run with UAVs in view, out of it and behind walls. Planted bug: in
    view instead."""
    dataset = fake_run().dataset
    d = {name: variable.values for name, variable in dataset.variables.items()}
    view, shadow = d["in_view"], d["occluded"]
    assert shadow.any() and (shadow != view).any() and (shadow == view).any()
    for f, o, u in np.ndindex(shadow.shape):
        told = _truth(d, f, o)["uavs"][str(d["uav"][u])]
        assert (told["in_view"], told["occluded"]) == (view[f, o, u], shadow[f, o, u])


def test_a_shard_that_is_not_whole_is_made_anew(folder):
    """Truncated, changed or gone: the scene is to do again, and its bytes are the same then; the
    others stay as they are. Planted bug: the shard believed because it is there."""
    plan, out = plan_of(folder, STAY.replace("samples, ", "")), folder / "out"
    jobs = jobs_of(plan, out)
    for job in jobs:
        run_job(job)
    shards = Shards(out)
    assert not [*pending(plan, shards, False)]
    file = next((out / "train").glob("*.tar"))
    whole = file.read_bytes()
    for damage in (whole[:-512], b"", whole.replace(b"npy", b"exe"), None):
        file.unlink() if damage is None else file.write_bytes(damage)
        (left,) = pending(plan, shards, False)
        run_job(jobs[left.index[0]])
        assert file.read_bytes() == whole and not [*pending(plan, shards, False)]
    assert all(m.isreg() for m in tarfile.open(file).getmembers())
    outcome = shards.read(jobs[0].key)
    assert outcome is not None and outcome["status"] == "done"


def test_shards_are_looked_at_once(folder, monkeypatch):
    """Headers of a shard once for all samples of it, its bytes once for a call that has nothing to
    make. Planted bugs: the index made for every sample; the card with a look at every shard."""
    plan, out = plan_of(folder, STAY.replace("samples, ", "")), folder / "out"
    for job in jobs_of(plan, out):
        run_job(job)
    hashed, opened, digest, open_tar = [], [], hashlib.file_digest, tarfile.open
    monkeypatch.setattr(hashlib, "file_digest", lambda *a: hashed.append(a) or digest(*a))
    run_dataset(plan, out)
    assert len(hashed) == 2
    monkeypatch.setattr(tarfile, "open", lambda *a: opened.append(a) or open_tar(*a))
    samples = Samples(out, "train")
    assert len({samples[k]["key"] for k in [5, *range(6)]}) == 6
    assert len(opened) == 1


def test_two_scenes_never_have_one_key(folder):
    """Also where they are the same: each has a shard of its own."""
    plan = plan_of(folder, STAY)
    vars(plan)["scenes"] = [plan.scenes[0]] * 2
    first, second = plan.points()
    assert first.tree == second.tree and first.key != second.key


def test_a_folder_that_is_none_is_one_message(tmp_path):
    with pytest.raises(ResultsError, match="holds no finished data set"):
        Samples(tmp_path, "train")
    (tmp_path / "card.json").write_text(json.dumps({"splits": {"train": {"train/0.tar": 3}}}))
    with pytest.raises(ResultsError, match="cannot be read"):
        Samples(tmp_path, "train")[0]


def shard_with(kind: str) -> bytes:
    """A tar file as only a stranger makes it."""
    if kind == "empty array":
        return tar_of(iter([("a.map.npy", b"")]))
    if kind == "archive":
        packed = io.BytesIO()
        np.savez(packed, a=np.arange(3))
        return tar_of(iter([("a.map.npy", packed.getvalue())]))
    if kind == "bent header":
        return tar_of(iter([("a.map.npy", b"\x93NUMPY\x01\x00\x06\x00{'a':\n")]))
    if kind == "packed":
        return gzip.compress(tar_of(iter([("a.json", b"{}")])))
    info = tarfile.TarInfo("a.json")  # a header alone that asks for 100 GB of holes
    info.type, info.size = tarfile.GNUTYPE_SPARSE, 0
    head = bytearray(info.tobuf(tarfile.GNU_FORMAT))
    head[386:410] = b"00000000000\x0000000000000\x00"
    head[483:495] = tarfile.itn(100 * 1024**3, 12, tarfile.GNU_FORMAT)
    head[148:156] = b"%06o\0 " % tarfile.calc_chksums(bytes(head))[0]
    return bytes(head) + bytes(1024)


@pytest.mark.parametrize("kind", ["empty array", "archive", "bent header", "packed", "holes"])
def test_a_stranger_s_shard_is_one_message(kind, tmp_path):
    (tmp_path / "train").mkdir()
    (tmp_path / "train" / "0.tar").write_bytes(shard_with(kind))
    (tmp_path / "card.json").write_text(json.dumps({"splits": {"train": {"train/0.tar": 1}}}))
    with pytest.raises(ResultsError, match="cannot be read"):
        Samples(tmp_path, "train")[0]


@pytest.mark.parametrize("shards", [{"../0.tar": 1}, {"/0.tar": 1}, {"0.tar": -1}, {"0.tar": "1"}])
def test_a_stranger_s_card_names_shards_in_its_folder(shards, tmp_path):
    (tmp_path / "card.json").write_text(json.dumps({"splits": {"train": shards}}))
    with pytest.raises(ResultsError, match="cannot be"):
        Samples(tmp_path, "train")


def test_long_names_of_terminals_fit_into_a_shard():
    """Two names of 100 letters, as a scenario may have them."""
    name = f"000001_00002_{'A' * 100}_to_{'B' * 100}.json"
    with tarfile.open(fileobj=io.BytesIO(tar_of(iter([(name, b"{}")])))) as tar:
        assert tar.getnames() == [name]


@pytest.mark.slow
def test_pytorch_takes_the_samples(folder):
    """A `DataLoader` batches a split whose samples differ in size, alone and with `collate`."""
    data = pytest.importorskip("torch.utils.data")
    plan, out = plan_of(folder, STAY), folder / "out"
    for job in jobs_of(plan, out):
        run_job(job)
    _write_card(plan, Shards(out))
    train = Samples(out, "train", ["bits", "paths"])
    for also in ({}, {"collate_fn": irt.collate}):
        batch = next(iter(data.DataLoader(train, batch_size=6, **also)))
        assert batch["bits"].shape[0] == batch["paths_valid"].shape[0] == 6
        assert batch["truth"]["uavs"]["A"]["position_m"].shape == (6, 3)


@pytest.mark.slow
@pytest.mark.sionna
def test_the_command_makes_what_the_file_says(tmp_path, capsys):
    """The shipped example on Dask, once: shards of three splits; called again it says the same and
    makes nothing."""
    from isac_rt.cli.cli import main

    example = Path(__file__).parents[2] / "scenes" / "sweeps" / "canyon_dataset.yaml"
    command = ["dataset", str(example), "--out", str(tmp_path), "--workers", "2"]
    assert main(command) == 0
    first = {file: file.stat().st_mtime_ns for file in tmp_path.glob("*/*.tar")}
    assert len(first) == 12 and "train: 8 scenes, 64 samples" in capsys.readouterr().out
    assert main(command) == 0
    assert first == {file: file.stat().st_mtime_ns for file in tmp_path.glob("*/*.tar")}
