"""Samples and point clouds for other programs hold what the run has."""

from __future__ import annotations

import json
import shutil

import numpy as np
import pytest
from fake_run import fake_run
from talking import scenario

from isac_rt.extensions.hardware.description import load_description
from isac_rt.extensions.hardware.readers import import_file
from isac_rt.frame.link import Link
from isac_rt.scenario.tree import Scenario
from isac_rt.simulation import simulate
from isac_rt.simulation.setup import prepare
from isac_rt.storage import StorageError
from isac_rt.views.points import point_cloud, write_bag, write_points
from isac_rt.views.samples import SampleError, dca1000_words, write_samples

SENSOR = {
    "frames": 3,
    "sensor": "awr1843",
    "swarm": {
        "R": {"role": "active", "position_m": [0.3, -1.1, 9.0]},
        "U": {"role": "target", "position_m": [2.3, 17.1, 9.4], "velocity_mps": [0.2, -3.1, 0.3]},
    },
}


@pytest.fixture(scope="module")
def board():
    return prepare(Scenario.model_validate(SENSOR))


def test_an_array_holds_all_frames_of_a_link(tmp_path):
    """Each frame's samples are those of the set-up, in the order that the file beside it states; an
    AT that processes every second frame has a row for each of these. Planted bugs: frames by their
    numbers for rows; the schedule of the first frame for all."""
    setup = prepare(scenario(frames=4))
    links = [Link("AT", "PT"), Link("AT", "AT")]
    files = write_samples(setup, [1, 3], links, "npy", tmp_path)
    assert [f.name for f in files] == ["AT.json", "AT.npy", "PT.json", "PT.npy"]
    for name, link in (("PT", links[0]), ("AT", links[1])):
        found, about = (
            np.load(tmp_path / f"{name}.npy"),
            json.loads((tmp_path / f"{name}.json").read_text()),
        )
        assert found.dtype == np.complex64
        assert about["axes"] == ["frame", "group", "receiver", "chirp", "sample"]
        rows = [k for k in (1, 3) if link in setup.timetable.links(k)]
        assert [row["frame"] for row in about["frames"]] == rows and len(found) == len(rows)
        for row, said, samples in zip(rows, about["frames"], found, strict=True):
            cube = setup.frame(row).samples(link)
            assert np.array_equal(samples, cube.samples)
            assert np.array_equal(said["schedule"], cube.schedule)
            assert said["start_time_s"] == cube.start_time


def test_words_stand_as_the_capture_card_sends_them():
    """Word by word in a loop: chirp, receiver, pairs of samples, I I Q Q; beyond full scale it
    clips. Planted bugs: receivers before chirps; I Q I Q."""
    rng = np.random.default_rng(3)
    samples = rng.integers(-900, 900, (2, 3, 4, 2)).astype(np.float32) @ np.array([1, 1j])
    samples = samples.astype(np.complex64)
    samples[1, 2, 3] = 1e6 + 3j
    words, clipped = dca1000_words(samples, 2.0)
    expected = []
    for chirp in range(3):
        for receiver in range(2):
            for first in (0, 2):
                pair = samples[receiver, chirp, first : first + 2]
                expected += [2 * z.real for z in pair] + [2 * z.imag for z in pair]
    assert words.dtype == np.int16 and clipped == 1
    assert words.tolist() == np.minimum(expected, 32767).tolist()


def test_a_capture_comes_back_to_the_bit(board, tmp_path):
    """Imported by its own description, each frame has the samples rounded to counts, the chirp and
    the elements. Planted bugs: frames in the wrong order; a scale of each frame's own."""
    write_samples(board, range(3), [Link("R", "R")], "bin", tmp_path)
    said = load_description(tmp_path / "R.yaml")
    count = float((tmp_path / "R.yaml").read_text().split()[4])
    for k in range(3):
        found = import_file(tmp_path / "R.bin", said.model_copy(update={"frame": k}))
        true = board.frame(k).samples(("R", "R"))
        assert (found.cube.samples == np.round(found.cube.samples)).all()
        off = found.cube.samples * count - true.samples
        assert np.abs(off.view(np.float32)).max() <= 0.501 * count  # single precision
        assert np.array_equal(found.cube.schedule, true.schedule)
        one, other = found.cube.waveform, true.waveform
        assert one.slope == pytest.approx(other.slope) and one.num_chirps == other.num_chirps
        assert one.slot_duration == pytest.approx(other.slot_duration)
        assert found.antennas is not None
        assert np.allclose(found.antennas.virtual_positions, board.antennas.virtual_positions)


def test_matlab_reads_a_frame(board, tmp_path):
    """Scipy's reader finds samples, schedule and the chirp. Planted bug: receivers last."""
    from scipy.io import loadmat

    (file,) = write_samples(board, [2], [Link("R", "R")], "mat_samples", tmp_path)
    found = loadmat(file, squeeze_me=True, struct_as_record=False)
    assert file.name == "R_0002.mat"
    assert np.array_equal(found["samples"][None], board.frame(2).samples(("R", "R")).samples)
    assert found["waveform"].num_chirps == board.waveform.num_chirps


def test_what_cannot_be_held_leaves_nothing(tmp_path):
    """Chirps of a random order are none of a board's; a fault leaves no file, hidden ones
    included. Planted bug: files written under their names at once."""
    setup = prepare(scenario(frames=3))
    with pytest.raises(SampleError, match="use mode: fmcw"):
        write_samples(setup, [0], [Link("AT", "PT")], "bin", tmp_path / "out")
    assert not list((tmp_path / "out").iterdir())


def test_a_disk_without_room_is_refused_before_the_first_frame(board, tmp_path, monkeypatch):
    """Three frames of 4 receivers x chirps x samples of 4 bytes: with a byte less free no frame is
    simulated. Planted bugs: room for one frame; bytes of complex samples for words."""
    w = board.waveform
    size = 3 * 4 * w.num_chirps * w.num_samples * 4
    free = shutil.disk_usage(tmp_path)._replace(free=size)
    monkeypatch.setattr(shutil, "disk_usage", lambda _: free)
    write_samples(board, range(3), [Link("R", "R")], "bin", tmp_path)
    assert (tmp_path / "R.bin").stat().st_size == size
    monkeypatch.setattr(shutil, "disk_usage", lambda _: free._replace(free=size - 1))
    monkeypatch.setattr(type(board), "frame", lambda *_: pytest.fail("a frame was simulated"))
    with pytest.raises(StorageError, match="MB are needed"):
        write_samples(board, range(3), [Link("R", "R")], "bin", tmp_path)


def test_points_lie_where_targets_are(tmp_path):
    """Detections that are right to the last digit lie at the UAV, by range and direction at the
    terminal and by the path's length at another one; the covariance is that of 20,000 draws of the
    measurement (3 %: two deviations). The cloud's files hold the same numbers. Planted bugs: half
    the path's length for the range; the covariance of the unit vector."""
    d = fake_run().dataset.load()
    uav = [str(name) for name in d.uav.values].index("U1")
    sender = {k: str(d.transmitter.values[k]) for k in range(d.sizes["observer"])}
    rng = np.random.default_rng(5)
    for k in range(d.sizes["detection"]):
        f, o = int(d.det_frame.values[k]), int(d.det_observer.values[k])
        own = list(d.uav.values).index(str(d.receiver.values[o]))
        tx = list(d.uav.values).index(sender[o])
        places, turn = d.uav_position.values[f], d.uav_attitude.values[f, own]
        off = places[uav] - places[own]
        u = turn.T @ off / np.linalg.norm(off)
        length = np.linalg.norm(off)
        if tx != own:
            length += np.linalg.norm(places[uav] - places[tx])
        d.det_range[k], d.det_u_x[k], d.det_u_z[k] = length, u[0], u[2]
        for name, std in (("range", 0.02), ("u_x", 0.002), ("u_z", 0.003)):
            d[f"det_{name}_std"][k] = std
    d["det_is_reference"] = d.det_is_reference & False
    cloud = point_cloud(d)
    assert set(cloud.observer) == {"AT", "PT1"}
    for row in cloud.itertuples():
        places = d.uav_position.values[list(d.frame.values).index(row.frame)]
        assert np.allclose([row.x, row.y, row.z], places[uav], atol=1e-9)
    for observer in ("AT", "PT1"):
        row = cloud[cloud.observer == observer].iloc[0]
        f = list(d.frame.values).index(row.frame)
        own, tx = (
            list(d.uav.values).index(name)
            for name in (observer, sender[list(d.observer.values).index(observer)])
        )
        places, turn = d.uav_position.values[f], d.uav_attitude.values[f, own]
        e0 = turn.T @ (places[uav] - places[own])
        length = np.linalg.norm(e0) + (0 if tx == own else np.linalg.norm(places[uav] - places[tx]))
        e0 = e0 / np.linalg.norm(e0)
        z = np.array([length, e0[0], e0[2]]) + rng.standard_normal((20000, 3)) * [0.02, 2e-3, 3e-3]
        e = np.stack([z[:, 1], np.sqrt(1 - z[:, 1] ** 2 - z[:, 2] ** 2), z[:, 2]], 1) @ turn.T
        rho = z[:, 0]
        if tx != own:
            b = places[tx] - places[own]
            rho = (rho**2 - b @ b) / (2 * (rho - e @ b))
        drawn = np.cov((rho[:, None] * e).T)
        names = ["xx", "xy", "xz", "yy", "yz", "zz"]
        stated = np.array([row[f"cov_{name}"] for name in names])
        scale = np.sqrt(np.outer(np.diag(drawn), np.diag(drawn)))[np.triu_indices(3)]
        assert np.abs(stated - drawn[np.triu_indices(3)]).max() < 0.03 * scale.max()
    files = write_points(d, tmp_path)
    head, _, rows = files[1].read_text().partition("DATA ascii\n")
    observer, frame = files[1].stem.rsplit("_", 1)
    part = cloud[(cloud.observer == observer) & (cloud.frame == int(frame))]
    assert f"POINTS {len(part)}\n" in head
    numbers = np.array([line.split() for line in rows.splitlines()], float)
    assert np.allclose(numbers[:, :3], part[["x", "y", "z"]].to_numpy(), rtol=1e-8)


def test_a_run_keeps_its_samples():
    """What receivers were given, by frame and link. Planted bug: the last frame's for all."""
    s = scenario(frames=3)
    found = simulate.run(s, snapshots=0, keep=["samples"]).samples
    setup = prepare(s)
    assert set(found) == {(f, link) for f in range(3) for link in setup.timetable.links(f)}
    for (frame, link), cube in found.items():
        assert np.array_equal(cube.samples, setup.frame(frame).received(link).samples)
    assert not simulate.run(s, snapshots=0).samples


def test_a_bag_holds_the_points(tmp_path):
    """Read back by rosbags: topics, stamps and fields of each frame, those without points too.
    Planted bugs: the stamp of the last frame; float64 in fields of four bytes."""
    from rosbags.rosbag2 import Reader
    from rosbags.typesys import Stores, get_typestore

    d, store = fake_run().dataset.load(), get_typestore(Stores.ROS2_HUMBLE)
    cloud = point_cloud(d)
    for _ in range(2):  # a second export replaces the first
        (folder,) = write_bag(d, tmp_path / "run_bag")
    found = 0
    with Reader(folder) as bag:
        assert {c.topic for c in bag.connections} == {f"/{o}/points" for o in d.observer.values}
        for connection, stamp, raw in bag.messages():
            message = store.deserialize_cdr(raw, connection.msgtype)
            part = cloud[cloud.observer == connection.topic.split("/")[1]]
            part = part[np.isclose(part.time, stamp * 1e-9, atol=1e-8)]
            layout = {
                "names": [f.name for f in message.fields],
                "formats": [{5: "<i4", 7: "<f4"}[f.datatype] for f in message.fields],
                "offsets": [f.offset for f in message.fields],
                "itemsize": message.point_step,
            }
            points = np.frombuffer(message.data, np.dtype(layout))
            assert message.header.frame_id == "world"
            for name in ("x", "y", "z", "cov_xx", "cov_zz", "velocity", "snr"):
                assert np.allclose(points[name], part[name], rtol=1e-6)
            kinds = np.append(d.kind.values, "none")
            assert kinds[points["label"]].tolist() == part.label.tolist()
            found += message.width
    assert found == len(cloud) > 0
    assert [file.name for file in tmp_path.iterdir()] == ["run_bag"]


def test_no_point_is_a_cloud_too(tmp_path):
    """Planted bug: a table without columns, which cannot be grouped."""
    d = fake_run().dataset.load()
    assert len(write_points(d.isel(detection=slice(0)), tmp_path)) == 1
