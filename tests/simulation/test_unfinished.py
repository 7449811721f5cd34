"""Runs that are stopped and go on: the same bits as in one go, whatever was carried over; files
that are torn, another's or no one's."""

from __future__ import annotations

import os
import pickle
import signal
import struct
import subprocess
import sys
import zlib
from pathlib import Path

import numpy as np
import pytest
from test_fall_back import scenario as dense_scenario

from isac_rt.cli.cli import main
from isac_rt.results.files import open_results
from isac_rt.scenario.file import load, to_yaml
from isac_rt.simulation import simulate
from isac_rt.simulation.content import run_content
from isac_rt.simulation.resume import FILE, Unfinished, UnfinishedError

ROOT = Path(__file__).parents[2]
SCENES = ROOT / "scenes"


class Stopped(Exception):
    pass


def stopping_at(frame):
    def progress(done, total):
        if done == frame:
            raise Stopped

    return progress


def assert_equal_results(found, expected):
    for name, variable in expected.dataset.variables.items():
        assert np.array_equal(
            found.dataset[name].values, variable.values, equal_nan=variable.dtype.kind == "f"
        ), name
    assert found.dataset.attrs == expected.dataset.attrs
    assert {k: v for k, v in found.summary.items() if k != "timing_s"} == {
        k: v for k, v in expected.summary.items() if k != "timing_s"
    }


def scenarios():
    """Tracks, acquisition, data and fall-back; feedback, clocks and slips; ray tracing, shadows and
    clutter in a city."""
    access = ["frames=9", "access.feedback=true"]
    return {
        "dense": lambda: dense_scenario(frames=7),
        "access": lambda: load(SCENES / "access_swarm.yaml", access),
        "canyon": lambda: load(
            SCENES / "street_canyon.yaml", ["modulation.acquisition_frames=1"], frames=3
        ),
    }


@pytest.mark.parametrize(
    "name",
    [
        "dense",
        pytest.param("access", marks=pytest.mark.slow),
        pytest.param("canyon", marks=pytest.mark.sionna),
    ],
)
def test_a_stopped_run_goes_on_to_the_same_bits(name, tmp_path):
    """Stopped after two frames, and once more before the last one. Planted bugs: the terminals, the
    scores or the advice not taken up."""
    scenario = scenarios()[name]()
    whole = simulate.run(scenario, snapshots=2)
    parts, stops = 0, sorted({2, scenario.frames - 1})
    for stop in (*stops, None):
        unfinished = Unfinished(tmp_path, run_content(scenario, 2), every=0.0)
        assert unfinished.begun == (parts > 0)
        try:
            again = simulate.run(
                scenario, snapshots=2, unfinished=unfinished, progress=stopping_at(stop)
            )
        except Stopped:
            parts += 1
    assert parts == len(stops)
    assert_equal_results(again, whole)
    assert len(Unfinished(tmp_path, run_content(scenario, 2)).entries()) == scenario.frames - 1


def test_a_run_with_all_but_its_last_frame_kept_hears_that_one_alone(tmp_path, monkeypatch):
    """Nothing is received twice."""
    scenario = dense_scenario(frames=4)
    unfinished = Unfinished(tmp_path, run_content(scenario, 1), every=0.0)
    whole = simulate.run(scenario, snapshots=1, unfinished=unfinished)
    heard = []
    hear = simulate._Observer.hear
    monkeypatch.setattr(
        simulate._Observer,
        "hear",
        lambda self, frame, *rest: heard.append(frame.number) or hear(self, frame, *rest),
    )
    again = simulate.run(scenario, snapshots=1, unfinished=unfinished)
    assert set(heard) == {3}
    assert_equal_results(again, whole)
    assert again.summary["timing_s"]["total"] > 0


def kept(folder, *entries):
    unfinished = Unfinished(folder, "content")
    for entry in entries:
        unfinished.append(entry)
    return unfinished


def test_entries_come_back_in_order_and_another_run_sees_none(tmp_path):
    kept(tmp_path, {"a": np.arange(3.5)}, ["b"])
    first, second = Unfinished(tmp_path, "content").entries()
    assert np.array_equal(first["a"], np.arange(3.5)) and second == ["b"]
    other = Unfinished(tmp_path, "contents")
    assert not other.begun and other.entries() == []
    other.append(1)
    assert other.entries() == [1] and Unfinished(tmp_path, "content").entries() == []
    other.remove()
    assert not (tmp_path / FILE).exists()


@pytest.mark.parametrize("cut", range(1, 80, 9))
def test_a_torn_end_is_cut_off_and_the_rest_goes_on(tmp_path, cut):
    """Planted bug: the torn entry left before the next one."""
    unfinished = kept(tmp_path, "one", "two" * 10)
    file = tmp_path / FILE
    whole = file.read_bytes()
    file.write_bytes(whole[:-cut])
    assert unfinished.entries() == (
        ["one"] if cut <= 12 + len(pickle.dumps("two" * 10, protocol=5)) else []
    )
    unfinished.append("three")
    assert unfinished.entries()[-1] == "three"
    assert "two" * 10 not in unfinished.entries()


def test_a_changed_bit_ends_the_entries(tmp_path):
    unfinished = kept(tmp_path, "one", "two")
    file = tmp_path / FILE
    content = bytearray(file.read_bytes())
    content[-5] ^= 1
    file.write_bytes(content)
    assert unfinished.entries() == ["one"]


class Harm:
    def __reduce__(self):
        return os.system, ("echo harm",)


@pytest.mark.parametrize("entry", [Harm(), subprocess.run, Path("x")])
def test_a_file_from_elsewhere_runs_nothing(tmp_path, entry, capfd):
    unfinished = kept(tmp_path, "one")
    text = pickle.dumps(entry)
    with (tmp_path / FILE).open("ab") as file:
        file.write(struct.pack("<QI", len(text), zlib.crc32(text)) + text)
    with pytest.raises(UnfinishedError, match=r"not written by isac-rt.*delete it"):
        unfinished.entries()
    assert "harm" not in capfd.readouterr().out


def test_what_cannot_be_kept_does_not_end_the_run(tmp_path):
    """A folder in the file's place: no entry, and none is tried again."""
    (tmp_path / FILE).mkdir()
    unfinished = Unfinished(tmp_path, "content", every=0.0)
    assert unfinished.due()
    unfinished.append(1)
    assert not unfinished.due() and unfinished.entries() == []


def test_entries_are_some_time_apart(tmp_path):
    unfinished = Unfinished(tmp_path, "content", every=1e3)
    assert not unfinished.due()
    unfinished = Unfinished(tmp_path, "content", every=0.0)
    unfinished.append(1)
    assert unfinished.due()


def test_the_command_says_what_it_keeps_and_goes_on(tmp_path, monkeypatch, capsys):
    """Ctrl-C after three frames: exit 130 and where they are; the next call says that it goes on,
    and leaves no such file behind."""
    (tmp_path / "scene.yaml").write_text(to_yaml(dense_scenario(frames=4)))
    monkeypatch.setattr(Unfinished.__init__, "__defaults__", (0.0,))
    monkeypatch.setattr("isac_rt.views.figures.make_figures", lambda *_: [])

    def stopped(work, *_):
        def report(done, total):
            if done == 3:
                raise KeyboardInterrupt

        return work(report)

    command = ["run", str(tmp_path / "scene.yaml"), "--out", str(tmp_path / "out")]
    with monkeypatch.context() as once:
        once.setattr("isac_rt.cli.simulation.with_progress", stopped)
        assert main(command) == 130
    said = capsys.readouterr().err
    assert (
        f"{tmp_path / 'out' / FILE} keeps the frames so far" in said
        and "interrupted" in said
        and "going on" not in said
    )
    assert main(command) == 0
    assert "going on after the frames" in capsys.readouterr().err
    assert not (tmp_path / "out" / FILE).exists() and (tmp_path / "out" / "results.nc").exists()


@pytest.mark.slow
@pytest.mark.parametrize("how", [signal.SIGINT, signal.SIGTERM, signal.SIGKILL])
def test_the_command_goes_on_after_it_was_stopped(tmp_path, how):
    """From outside, once an entry is written: the message, the frames taken up, the same results,
    and no file left behind."""
    scenario = tmp_path / "scene.yaml"
    scenario.write_text(to_yaml(dense_scenario(frames=8)))
    out = tmp_path / "out"
    program = f"""
import sys, isac_rt.simulation.resume
isac_rt.simulation.resume.Unfinished.__init__.__defaults__ = (0.0,)
from isac_rt.cli.cli import main
sys.exit(main(["run", {str(scenario)!r}, "--out", {str(out)!r}]))
"""
    command = [sys.executable, "-c", program]
    child = subprocess.Popen(
        command, stderr=subprocess.PIPE, stdout=subprocess.DEVNULL, text=True, cwd=ROOT
    )
    while child.poll() is None and not (
        (out / FILE).exists() and (out / FILE).stat().st_size > 1000
    ):
        pass
    os.kill(child.pid, how)
    _, said = child.communicate(timeout=60)
    if how != signal.SIGKILL:
        assert child.returncode == 128 + how and "keeps the frames so far" in said
    assert (out / FILE).exists() and not (out / "results.nc").exists()
    again = subprocess.run(command, capture_output=True, text=True, cwd=ROOT, timeout=300)
    assert again.returncode == 0 and "going on after the frames" in again.stderr
    assert not (out / FILE).exists()
    assert_equal_results(open_results(out), simulate.run(dense_scenario(frames=8)))
