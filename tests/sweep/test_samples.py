"""Samples of a data set: spectra and labels lie where the geometry says, batches have one size, and
the card is what Croissant asks for."""

from __future__ import annotations

import hashlib
import json
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest
from test_dataset import jobs_of, plan_of
from test_sweep import BASE

import isac_rt as irt
from isac_rt.frame.link import Link
from isac_rt.propagation.pathset import PathKind, make_paths
from isac_rt.results.files import ResultsError
from isac_rt.scenario.tree import Scenario
from isac_rt.sweep import Samples, collate
from isac_rt.sweep.execute import run_job
from isac_rt.sweep.make_dataset import Shards, _write_card
from isac_rt.sweep.parts import BOXES, labels

SET = """
name: one
scenario: base.yaml
scenes: 1
set: {noise.snr_db: 20, array.rx_x: 6}
draw: {swarm.P1.position_m: {uniform: [[-1.9, 5.3, 50.7], [-1.8, 5.4, 50.8]]}}
splits: {train: 1}
keep: [bits, paths, boxes, mask, range_azimuth, range_doppler, cube]
about: {license: CC-BY-4.0, creator: me, url: "https://example.org/one"}
"""


class Made(NamedTuple):
    """A finished set of one scene, and its scenario."""

    folder: Path
    scenario: Scenario


@pytest.fixture(scope="module")
def made(tmp_path_factory) -> Made:
    folder = tmp_path_factory.mktemp("set")
    (folder / "base.yaml").write_text(BASE)
    plan = plan_of(folder, SET)
    (job,) = jobs_of(plan, folder / "out")
    assert run_job(job).status == "done"
    _write_card(plan, Shards(folder / "out"))
    return Made(folder / "out", Scenario.model_validate(plan.scenes[0].tree))


def test_spectra_and_labels_lie_where_the_uavs_are(made):
    """Range, velocity and direction cosine of the other UAV from its position by hand: the peak of
    the cube within a cell and a step of the directions, the box's middle within a cell (a chirp's
    coupling of range and velocity is under one), the mask there. The box's SNR against the mean of
    the empty cells: both axes' scalloping is up to 3 dB. Planted bugs: steering conjugated;
    Doppler left in FFT order; virtual positions at the passive terminal."""
    setup = irt.prepare(made.scenario)
    uavs, samples = made.scenario.swarm, Samples(made.folder, "train")
    assert len(samples) == 6
    for sample in samples:
        own = sample["truth"]["receiver"] == "A"
        at, other, east = ("A", "P1", 1) if own else ("P1", "A", -1)
        time = sample["truth"]["time_s"]
        p, v = (
            np.subtract(getattr(uavs[other], key), getattr(uavs[at], key))
            for key in ("position_m", "velocity_mps")
        )
        p = p + v * time
        truth = np.linalg.norm(p), p @ v / np.linalg.norm(p), east * p[0] / np.linalg.norm(p)
        axes = sample["map_range"], sample["map_velocity"], sample["u_x"]
        peak = np.unravel_index(sample["cube"].argmax(), sample["cube"].shape)
        for axis, index, true in zip(axes, peak, truth, strict=True):
            assert abs(axis[index] - true) <= axis[1] - axis[0]
        assert sample["range_doppler"].shape == (3, 8, len(axes[0]), len(axes[1]))
        power = (np.abs(sample["range_doppler"]) ** 2).mean(axis=(0, 1))
        assert np.unravel_index(power.argmax(), power.shape) == peak[:2]
        np.testing.assert_allclose(sample["range_azimuth"], sample["cube"].mean(axis=1), rtol=1e-5)
        (box,) = (dict(zip(BOXES, row, strict=True)) for row in sample["boxes"])
        number = [*sample["truth"]["uavs"]].index(other)
        assert (box["uav"], box["height"], box["width"]) == (number, 2, 2)
        assert abs(box["row"] - truth[0] / axes[0][1]) < 1
        assert abs(box["u_x"] - truth[2]) < 1e-3
        assert sample["mask"][peak[:2]] == number + 2
        noise = power[sample["mask"] == 0].mean()
        assert 0.5 < power.max() / noise / box["snr"] < 1.1
        frame = setup.frame(int(sample["key"].split("_")[1]))
        assert np.array_equal(sample["bits"], frame.sent["A"].payload.bits)


def test_a_mask_says_what_is_strongest(made):
    """Three paths by hand, of a UAV, of a wall and of a wall under the noise. Planted bugs: the
    first path of a cell taken; clutter under the noise marked."""
    setup, link = irt.prepare(made.scenario), Link("A", "A")
    frame, cell = setup.frame(0), setup.waveform.range_cell(2)
    level = setup.noise_power(frame.poses, link) / setup.plan.cell_noise_gain(link.tx)
    kinds = [PathKind.TARGET, PathKind.SPECULAR, PathKind.DIFFUSE]
    paths = make_paths(
        tx="A",
        rx="A",
        epoch=0.0,
        gain=np.sqrt(level * np.array([1e3, 1e3, 1e-2])),
        delay=2 * cell * np.array([7.0, 15.0, 24.0]) / 299792458,
        departure=[[0.0, 1.0, 0.0]] * 3,
        arrival=[[0.0, 1.0, 0.0]] * 3,
        kind=kinds,
        target=[0, -1, -1],
        target_names=("P1",),
    )
    boxes, mask = labels(setup, replace(frame, paths={link: paths}), link)
    middle = mask.shape[1] // 2
    assert mask[[7, 15, 24], middle].tolist() == [3, 1, 0]
    assert boxes[0, :3] == pytest.approx([1, 7, middle], abs=1e-6)
    assert (mask > 0).mean() < 0.3


def test_receivers_do_not_run_for_what_they_do_not_make(made, tmp_path):
    """The paths of a set are the same whether receivers run or not. Planted bug: the scenario's
    receivers run for every set."""
    (tmp_path / "base.yaml").write_text(BASE)
    plan = plan_of(tmp_path, SET.replace("keep: [", "keep: [detections, "))
    (job,) = jobs_of(plan, tmp_path / "out")
    run_job(job)
    _write_card(plan, Shards(tmp_path / "out"))
    for one, other in zip(
        Samples(made.folder, "train"), Samples(tmp_path / "out", "train"), strict=True
    ):
        assert np.array_equal(one["paths"], other["paths"])
        assert "detections" not in one
        assert len(other["detections"]) >= (other["truth"]["receiver"] == "A")


def test_a_batch_has_one_size():
    """By hand: NaN for floats, 0 for integers, nothing where a sample has no such array or UAV.
    Planted bug: arrays cut to the smallest."""
    first = {"key": "a", "map": np.ones((2, 1)), "truth": {"uavs": {"U1": {"range": 3.0}}}}
    second = {
        "key": "b",
        "map": np.full((1, 2), 5.0),
        "bits": np.ones(2, np.uint8),
        "truth": {"uavs": {"U1": {"range": np.nan}, "U2": {"in_view": True, "range": 1.0}}},
    }
    batch = collate([first, second])
    nan = np.nan
    np.testing.assert_array_equal(batch["map"], [[[1, nan], [1, nan]], [[5, 5], [nan, nan]]])
    np.testing.assert_array_equal(batch["map_valid"], ~np.isnan(batch["map"]))
    assert batch["bits"].tolist() == [[0, 0], [1, 1]] and batch["bits"].dtype == np.uint8
    assert batch["bits_valid"].tolist() == [[False, False], [True, True]]
    uavs = batch["truth"]["uavs"]
    np.testing.assert_array_equal(uavs["U1"]["range"], [3, nan])
    np.testing.assert_array_equal(uavs["U2"]["range"], [nan, 1])
    assert uavs["U2"]["in_view"].tolist() == [False, True] and batch["key"] == ["a", "b"]
    assert set(collate([first])) == {"key", "map", "map_valid", "truth"}


def test_a_loader_gets_samples_of_one_size(made):
    """What PyTorch stacks: the same keys and shapes; a batch of them is not padded again."""
    train = Samples(made.folder, "train", ["paths", "boxes", "bits"])
    items = train.__getitems__([0, 5, 3])
    assert [item["key"] for item in items] == [train[k]["key"] for k in (0, 5, 3)]
    shapes = [{k: v.shape for k, v in i.items() if isinstance(v, np.ndarray)} for i in items]
    assert shapes[0] == shapes[1] == shapes[2]
    assert collate(items)["bits"].shape == (3, train[5]["bits"].size) and len(items[0]) == 8
    position = items[0]["truth"]["uavs"]["A"]["position_m"]
    assert position.shape == (3,) and np.isnan(items[0]["truth"]["uavs"]["A"]["range"])


def test_a_part_that_is_not_there_is_one_message(made):
    with pytest.raises(ResultsError, match="no part mpa, map; it has bits, paths, boxes"):
        Samples(made.folder, "train", ["bits", "mpa", "map"])


def test_the_card_is_croissant_s(made):
    """Properties that the specification requires, and files and parts that are named are there.
    Planted bugs: a set of files in no shard; sizes of the samples for those of the shards."""
    card = json.loads((made.folder / "croissant.json").read_text())
    for key in "@context @type name description license url creator datePublished".split():
        assert card[key], key
    assert card["conformsTo"] == "http://mlcommons.org/croissant/1.0"
    assert card["license"] == "CC-BY-4.0" and card["creator"]["name"] == "me"
    by_id = {entry["@id"]: entry for entry in card["distribution"]}
    shards = [e for e in by_id.values() if e["@type"] == "cr:FileObject"]
    for shard in shards:
        content = (made.folder / shard["contentUrl"]).read_bytes()
        assert shard["sha256"] == hashlib.sha256(content).hexdigest()
        assert shard["contentSize"] == f"{len(content)} B"
    parts = [e for e in by_id.values() if e["@type"] == "cr:FileSet"]
    assert {e["includes"] for e in parts} >= {"*.json", "*.cube.npy", "*.mask.npy"}
    assert all(by_id[at["@id"]] in shards for e in parts for at in e["containedIn"])
    (records,) = card["recordSet"]
    assert all(field["source"]["fileSet"]["@id"] in by_id for field in records["field"])
    spent = json.loads((made.folder / "card.json").read_text())["processor_s"]
    stages = {name: s for name, s in spent.items() if name != "total"}
    assert spent["total"] == pytest.approx(sum(stages.values()), rel=0.05)
    assert stages["parts"] > 0
