"""Runs that are stopped and go on: the same bits as in one go, whatever was carried over; files
that are torn, another's or no one's."""

from __future__ import annotations

import errno
import os
import signal
import sqlite3
import subprocess
import sys
import time
from collections import deque
from contextlib import closing, contextmanager
from pathlib import Path

import numpy as np
import pytest
from talking import small
from test_fall_back import scenario as dense_scenario
from test_own_chirps import TREE as TWO_BOARDS

from isac_rt.cli.cli import main
from isac_rt.cli.interruption import Terminated
from isac_rt.document import ScenarioWarning
from isac_rt.receive.settings import Receivers
from isac_rt.results.files import open_results
from isac_rt.results.provenance import run_content
from isac_rt.results.recorder import Recorder
from isac_rt.scenario.file import load, to_yaml
from isac_rt.scenario.presets import ReceiverSet
from isac_rt.simulation import resume as simulate_resume
from isac_rt.simulation import simulate, stations
from isac_rt.simulation.resume import EARLIER, FILE, Resume, ResumeError
from isac_rt.simulation.setup import prepare
from isac_rt.storage import ARRAY, checksum, pack, unpack
from isac_rt.track.settings import Tracking

ROOT = Path(__file__).parents[2]
SCENES = ROOT / "scenes"
UNSEEN = pytest.mark.filterwarnings("ignore::isac_rt.scenario.file.ScenarioWarning")
SMALL = ["radio.samples_per_chirp=256", "radio.chirps_per_frame=36"]


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
    """Tracks, acquisition, data and fall-back; feedback, clocks, slips and self-calibration; ray
    tracing, shadows and clutter in a city; radars of two chirps."""
    access = ["frames=9", "access.feedback=true", "receivers.self_calibration=positions"]
    return {
        "dense": lambda: dense_scenario(frames=7),
        "two boards": lambda: load(TWO_BOARDS),
        "access": lambda: load(SCENES / "access_swarm.yaml", access),
        "canyon": lambda: load(
            SCENES / "street_canyon.yaml",
            ["modulation.acquisition_frames=1", *SMALL],
            frames=3,
        ),
    }


@pytest.mark.parametrize(
    "name",
    [
        "dense",
        pytest.param("two boards", marks=UNSEEN),
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
        resume = Resume(tmp_path, run_content(scenario, 2), every=0.0)
        assert resume.begun == (parts > 0)
        try:
            again = simulate.run(scenario, snapshots=2, resume=resume, progress=stopping_at(stop))
        except Stopped:
            parts += 1
    assert parts == len(stops)
    assert_equal_results(again, whole)
    entries = list(Resume(tmp_path, run_content(scenario, 2)).entries())
    assert len(entries) == scenario.frames - 1


@pytest.mark.filterwarnings("ignore::isac_rt.scenario.file.ScenarioWarning")
def test_frames_are_kept_while_receivers_are_at_work_on_later_ones(tmp_path, monkeypatch):
    """Two terminals that hear every frame and one that hears every second; each frame is kept only
    once the receivers are done with the next. Stopped after a frame of either kind, the run goes on
    to the same bits. Planted bugs: what a terminal carries after the later frame is kept; that of
    a terminal which the frame passes over is."""
    every_second = ["receivers.active_every_frames=2", "modulation.acquisition_frames=2"]
    scenario = load(SCENES / "paper_swarm_consistent.yaml", every_second + SMALL, frames=6)
    assert len(prepare(scenario).timetable.links(1)) < len(prepare(scenario).timetable.all_links)
    whole = simulate.run(scenario, snapshots=1)
    collect = simulate._Run.collect

    def late(self, frame, jobs):
        collect(self, frame, jobs)
        time.sleep(0.4)

    monkeypatch.setattr(simulate._Run, "collect", late)
    for stop in (2, 3):
        resume = Resume(tmp_path / str(stop), run_content(scenario, 1), every=0.0)
        resume.file.parent.mkdir()
        with pytest.raises(Stopped):
            simulate.run(scenario, snapshots=1, resume=resume, progress=stopping_at(stop))
        assert len(list(resume.entries())) == stop
        with monkeypatch.context() as quick:
            quick.setattr(simulate._Run, "collect", collect)
            assert_equal_results(simulate.run(scenario, snapshots=1, resume=resume), whole)


def differences(a, b, at=""):
    """Places at which two objects differ, whatever they are made of."""
    if a is b or callable(a):
        return
    if isinstance(a, np.ndarray):
        if a.dtype != b.dtype or a.shape != b.shape or a.tobytes() != b.tobytes():
            yield at
    elif isinstance(a, Recorder):
        rows = ([one.row(i) for i in range(len(one))] for one in (a, b))
        yield from differences(*rows, at)
    elif isinstance(a, dict):
        if a.keys() != b.keys():
            yield f"{at}: keys"
        for key in a.keys() & b.keys():
            yield from differences(a[key], b[key], f"{at}[{key}]")
    elif isinstance(a, list | tuple | deque):
        if len(a) != len(b) or (isinstance(a, deque) and a.maxlen != b.maxlen):
            yield f"{at}: length"
        for i, (one, other) in enumerate(zip(a, b, strict=False)):
            yield from differences(one, other, f"{at}[{i}]")
    elif hasattr(a, "__dict__"):
        for name, value in vars(a).items():
            yield from differences(value, vars(b)[name], f"{at}.{name}")
    elif not (a == b or (a != a and b != b)):
        yield at


def counted(value, step=1):
    """Give every count of an object, and of what it holds, a number of its own."""
    for name, held in vars(value).items():
        if type(held) is int:
            step += 1
            setattr(value, name, held + 1000 * step)
        elif type(held) is dict and held and all(type(v) is int for v in held.values()):
            setattr(value, name, {k: v + 77 * i for i, (k, v) in enumerate(held.items(), 1)})


def test_everything_that_is_carried_over_is_taken_up(tmp_path):
    """Every attribute of every receiver, tracker, track, scorer and schedule after four frames,
    counts made different from each other and from nothing. Planted bugs: a scorer's labels, the
    time of a tracker, the next track's number, the status of a link, or the feedback forgotten."""
    scenario = dense_scenario(frames=5).model_copy(
        update={"compare": {"other": ReceiverSet(receivers=Receivers(), tracking=Tracking())}}
    )
    setup = prepare(scenario)

    def begin():
        return simulate._Run.begin(scenario, setup, 1, stations.standard_terminal)

    resume = Resume(tmp_path, "content", every=1e9)
    first, second = begin(), begin()
    with pytest.raises(Stopped):
        first.fly(stopping_at(4), 1, resume)
    for one in first.sets.values():
        for observer in one.stations.values():
            for part in (observer, observer.terminal):
                counted(part)
            counted(observer.terminal.tracker.state)
            observer.scorer.state.labels |= {70: [1, 2], 71: [0]}
            observer.scorer.state.followed |= {5: 70}
    assert resume.append(first.memory([{}, {}]))
    assert second.restore(resume) == 4
    first.kept = second.kept
    second.stopwatch = first.stopwatch  # the seconds of two runs differ
    assert list(differences(first, second)) == []


def test_a_run_with_all_but_its_last_frame_kept_hears_that_one_alone(tmp_path, monkeypatch):
    """Nothing is received twice."""
    scenario = small(frames=4)
    resume = Resume(tmp_path, run_content(scenario, 1), every=0.0)
    whole = simulate.run(scenario, snapshots=1, resume=resume)
    heard = []
    hear = stations.Station.receive
    monkeypatch.setattr(
        stations.Station,
        "receive",
        lambda self, frame, *rest: heard.append(frame.number) or hear(self, frame, *rest),
    )
    again = simulate.run(scenario, snapshots=1, resume=resume)
    assert set(heard) == {3}
    assert_equal_results(again, whole)
    assert again.summary["timing_s"]["total"] > 0


def kept(folder, *entries):
    resume = Resume(folder, "content")
    for entry in entries:
        resume.append(entry)
    return resume


def test_entries_come_back_in_order_and_another_run_takes_none_away(tmp_path):
    """Planted bugs: another's entries removed by `append`; the same digest for all."""
    kept(tmp_path, {"a": np.arange(3.5)}, ["b"])
    first, second = Resume(tmp_path, "content").entries()
    assert np.array_equal(first["a"], np.arange(3.5)) and second == ["b"]
    other = Resume(tmp_path, "contents")
    assert not other.begun
    with pytest.raises(
        ResumeError, match=r"resume\.sqlite keeps frames of another .*--out, or --re"
    ):
        list(other.entries())
    with pytest.warns(ScenarioWarning, match="not kept"):
        assert not other.append(1)
    assert len(list(Resume(tmp_path, "content").entries())) == 2
    other.remove()
    assert not list(tmp_path.iterdir()) and other.append(1) and list(other.entries()) == [1]


@pytest.mark.parametrize(
    "value",
    [
        np.array([0.1, -0.0, np.nan, -np.inf, 5e-324]),
        np.asfortranarray(np.arange(12.0).reshape(3, 4)[:, 1:] / 7),
        np.array([[1 + 2j]], np.complex64),
        np.zeros((0, 3), np.int8),
        np.array([True, False]),
    ],
)
def test_an_array_comes_back_bit_by_bit(value):
    """Also its order in memory, by which sums over it are rounded. Planted bug: the order left
    out."""
    back = unpack(*pack({"x": [value, 1]}))["x"][0]
    assert back.dtype == value.dtype and back.shape == value.shape and back.flags.writeable
    assert back.tobytes() == value.tobytes()
    assert back.flags.c_contiguous == value.flags.c_contiguous


def test_numbers_come_back_bit_by_bit():
    for value in (0.1, -np.inf, 1e-310, np.float64(1) / 3, np.int16(7), None, "word", [True]):
        assert unpack(*pack(value)) == value
    assert np.isnan(unpack(*pack(np.nan)))


def test_an_entry_is_there_whole_or_not_at_all(tmp_path):
    """Killed in the middle of an entry: it is gone, the one before it is there, and the next one
    follows. Planted bug: a database without a journal."""
    resume = kept(tmp_path, "one")
    program = f"""
import os, sqlite3
database = sqlite3.connect({str(tmp_path / FILE)!r})
database.execute("PRAGMA cache_size = 1")
for i in range(200):  # more than the cache holds: a part is in the file
    database.execute("INSERT INTO entry (tree, arrays, checksum) VALUES ('1', zeroblob(9000), '')")
os._exit(9)
"""
    size = (tmp_path / FILE).stat().st_size
    assert subprocess.run([sys.executable, "-c", program]).returncode == 9
    assert (tmp_path / f"{FILE}-journal").exists() and (tmp_path / FILE).stat().st_size > size
    assert resume.begun and list(resume.entries()) == ["one"]
    resume.append("three")
    assert list(resume.entries()) == ["one", "three"]


def hostile(tree, arrays=b""):
    """An entry that this package did not write, with the checksum of one that it did."""

    def spoil(file):
        with closing(sqlite3.connect(file)) as database, database:
            ((digest,),) = database.execute("SELECT digest FROM run").fetchall()
            seal = checksum(digest, tree.encode() + arrays) if tree else None
            database.execute(
                "INSERT INTO entry (tree, arrays, checksum) VALUES (?, ?, ?)", (tree, arrays, seal)
            )

    return spoil


@pytest.mark.parametrize(
    "spoil",
    [
        hostile("no JSON"),
        hostile(None),
        hostile(f'{{"{ARRAY}": ["O", [1], "C", 0]}}', bytes(8)),
        hostile(f'{{"{ARRAY}": [[["a", "O"]], [1], "C", 0]}}', bytes(8)),
        hostile(f'{{"{ARRAY}": [[["a", [["b", "O"]]]], [1], "C", 0]}}', bytes(8)),
        hostile(f'{{"{ARRAY}": ["<f8", [3], "C", 0]}}', bytes(8)),
        hostile(f'{{"{ARRAY}": ["<f8", [-1], "C", 0]}}', bytes(8)),
        hostile(f'{{"{ARRAY}": 3}}'),
        hostile("[" * 100_000),
    ],
)
def test_a_file_from_elsewhere_is_refused_with_one_message(tmp_path, spoil):
    """Planted bug: arrays of objects made."""
    resume = kept(tmp_path, "one" * 4000)
    spoil(tmp_path / FILE)
    with pytest.raises(ResumeError, match=r"not written by isac-rt.*--restart discards it"):
        list(resume.entries())


@pytest.mark.parametrize(
    "entry",
    [
        3,
        {},
        {"first": 0, "sets": {"own": {"rows": [{"frame": 0}]}}, "advice": [], "seconds": {}},
        {"first": 0, "sets": {"own": {"rows": []}}, "advice": [], "seconds": {}},
    ],
)
def test_an_entry_that_is_no_runs_is_refused_before_a_frame(tmp_path, entry):
    scenario = small(frames=4)
    resume = Resume(tmp_path, run_content(scenario, 1))
    resume.append(entry)
    with pytest.raises(ResumeError, match=r"not written by isac-rt.*--restart discards it"):
        simulate.run(scenario, snapshots=1, resume=resume)


def test_bent_entries_are_done_once_more(tmp_path):
    """Any byte of an entry's arrays or tree changed: it is as if it had not been kept, and those
    about it are there. Planted bug: the checksum not compared."""
    resume = kept(tmp_path, "one", {"a": np.arange(3.0)}, "three")
    with closing(sqlite3.connect(tmp_path / FILE)) as database, database:
        database.execute("UPDATE entry SET arrays = zeroblob(24) WHERE id = 2")
    assert list(resume.entries()) == ["one", "three"]
    with closing(sqlite3.connect(tmp_path / FILE)) as database, database:
        database.execute("UPDATE entry SET tree = '\"ten\"' WHERE id = 3")
    assert list(resume.entries()) == ["one"]


def test_a_file_that_is_no_database_is_not_taken_away(tmp_path):
    """Nor what earlier versions wrote; an empty one, of a run killed before its first entry, is
    taken up."""
    resume = Resume(tmp_path, "content")
    (tmp_path / EARLIER).write_bytes(b"isac_rt")
    with pytest.raises(ResumeError, match=EARLIER):
        resume.check()
    resume.remove()
    cut = kept(tmp_path, "one" * 9000).file.read_bytes()[:-5000]
    for content in (b"no database" * 999, cut):
        (tmp_path / FILE).write_bytes(content)
        with pytest.raises(ResumeError, match="damaged"):
            list(resume.entries())
        assert (tmp_path / FILE).read_bytes() == content
    (tmp_path / FILE).write_bytes(b"")
    assert list(resume.entries()) == []
    assert resume.append("one") and list(resume.entries()) == ["one"]


def test_a_database_of_other_tables_is_not_asked(tmp_path):
    """A view without end in a table's place. Planted bug: the tables not looked at."""
    endless = "WITH RECURSIVE n(digest) AS (SELECT 1 UNION ALL SELECT 1 FROM n) SELECT * FROM n"
    with closing(sqlite3.connect(tmp_path / FILE)) as database, database:
        database.execute(f"CREATE VIEW run AS {endless}")
    with pytest.raises(ResumeError, match="damaged"):
        Resume(tmp_path, "content").check()


def test_what_cannot_be_kept_does_not_end_the_run_nor_take_away_what_was(tmp_path):
    """A database that is full: a warning, the entries before it stay, the next follows once there
    is room, and the run that goes on is the same. Planted bug: the file removed."""
    resume = kept(tmp_path, "one")
    pages = resume.file.stat().st_size // 4096

    class Full(Resume):
        @contextmanager
        def _open(self, mode):
            with super()._open(mode) as database:
                database.execute(f"PRAGMA max_page_count = {pages}")
                yield database

    full = Full(tmp_path, "content", every=0.0)
    with pytest.warns(ScenarioWarning, match=r"not kept \(database or disk is full"):
        assert not full.append("two" * 9000)
    assert list(resume.entries()) == ["one"]
    assert resume.append("three") and list(resume.entries()) == ["one", "three"]


def test_frames_that_could_not_be_kept_are_kept_with_the_next(tmp_path, monkeypatch):
    """Planted bug: frames taken for kept before they are."""
    scenario = small(frames=5)
    whole = simulate.run(scenario, snapshots=1)
    resume = Resume(tmp_path, run_content(scenario, 1), every=0.0)
    append, tries = resume.append, iter([False, True, False, True])
    monkeypatch.setattr(resume, "append", lambda entry: next(tries) and append(entry))
    simulate.run(scenario, snapshots=1, resume=resume)
    assert [len(entry["sets"]["own"]["rows"]) for entry in resume.entries()] == [2, 2]
    again = Resume(tmp_path, run_content(scenario, 1), every=1e3)
    assert_equal_results(simulate.run(scenario, snapshots=1, resume=again), whole)


def test_frames_that_two_calls_kept_are_taken_up_once(tmp_path):
    """Two calls of one run at the same time keep the same frames, each in pieces of its own:
    what does not follow on is passed over. Planted bug: every entry taken."""
    scenario = small(frames=5)
    whole = simulate.run(scenario, snapshots=1)
    folders = [tmp_path / name for name in ("one", "two", "both")]
    for folder in folders:
        folder.mkdir()
    one, two, both = (Resume(f, run_content(scenario, 1), every=0.0) for f in folders)
    simulate.run(scenario, snapshots=1, resume=one)
    tries = iter([False, True, True, True])
    append = two.append
    two.append = lambda entry: next(tries) and append(entry)
    simulate.run(scenario, snapshots=1, resume=two)
    (a, b, *_), (c, *_) = (list(r.entries()) for r in (one, two))
    assert [(len(e["sets"]["own"]["rows"]), e["first"]) for e in (a, b, c)] == [
        (1, 0),
        (1, 1),
        (2, 0),
    ]
    for entry in (a, c, b, b, c):
        both.append(entry)
    run = simulate._Run.begin(scenario, prepare(scenario), 1, stations.standard_terminal)
    assert run.restore(both) == 2
    assert run.recorder.dataset().frame.values.tolist() == [0, 1]
    assert_equal_results(simulate.run(scenario, snapshots=1, resume=both), whole)


def test_entries_are_some_time_apart(tmp_path):
    resume = Resume(tmp_path, "content", every=1e3)
    assert not resume.due()
    resume = Resume(tmp_path, "content", every=0.0)
    resume.append(1)
    assert resume.due()


def test_what_could_not_be_kept_is_tried_again_after_twice_the_time(tmp_path, monkeypatch):
    """Planted bug: four times."""
    now = [100.0]
    monkeypatch.setattr(simulate_resume.time, "monotonic", lambda: now[0])
    resume = Resume(tmp_path, "content", every=7.0)
    (tmp_path / FILE).mkdir()
    for step, wait in enumerate((14.0, 28.0)):
        with pytest.warns(ScenarioWarning, match="not kept"):
            assert not resume.append(step)
        now[0] += wait - 0.5
        assert not resume.due()
        now[0] += 0.5
        assert resume.due()


def test_frames_that_another_run_keeps_just_now_are_in_use(tmp_path):
    """Planted bug: taken for damaged, which --restart would take away."""
    resume = kept(tmp_path, "one")
    with closing(sqlite3.connect(resume.file)) as other:
        other.execute("BEGIN EXCLUSIVE")
        with pytest.raises(ResumeError, match="in use by another run") as told:
            resume.check()
    assert "--restart" not in str(told.value)


def test_a_schema_from_elsewhere_is_not_trusted(tmp_path):
    """What a stranger's file has in its schema may not run functions. Planted bug: the pragma left
    out."""
    with kept(tmp_path, "one")._open("rw") as database:
        assert database.execute("PRAGMA trusted_schema").fetchall() == [(0,)]


def keep_every_frame(monkeypatch):
    """And draw nothing."""
    monkeypatch.setattr(Resume.__init__, "__defaults__", (0.0,))
    monkeypatch.setattr("isac_rt.views.figures.make_figures", lambda *_: [])
    monkeypatch.setattr("isac_rt.views.report.write_report", lambda *_: None)


def test_the_command_says_what_it_keeps_and_goes_on(tmp_path, monkeypatch, capsys):
    """Ctrl-C after three frames: exit 130 and where they are; another scenario leaves them alone
    unless told to let go; the next call says that it goes on, and leaves no such file behind."""
    (tmp_path / "scene.yaml").write_text(to_yaml(small(frames=4)))
    keep_every_frame(monkeypatch)

    def stopped(work, *_):
        def report(done, total):
            if done == 3:
                raise KeyboardInterrupt

        return work(report)

    command = ["run", str(tmp_path / "scene.yaml"), "--out", str(tmp_path / "out")]
    other = [*command, "--seed", "77"]
    with monkeypatch.context() as once:
        once.setattr("isac_rt.cli.simulation.with_progress", stopped)
        assert main(command) == 130
    said = capsys.readouterr().err
    assert (
        f"{tmp_path / 'out' / FILE} keeps the frames so far" in said
        and "interrupted" in said
        and "going on" not in said
    )
    kept = (tmp_path / "out" / FILE).read_bytes()
    assert main(other) == 2
    progress, said = capsys.readouterr().err.strip().splitlines()
    assert "keeps frames of another" in said and progress == "loading the program"
    assert (tmp_path / "out" / FILE).read_bytes() == kept
    assert main(command) == 0
    assert "resuming after the frames" in capsys.readouterr().err
    assert not (tmp_path / "out" / FILE).exists() and (tmp_path / "out" / "results.nc").exists()
    Resume(tmp_path / "out", "another").append(1)
    assert main([*other, "--restart"]) == 2
    assert main([*other, "--restart", "--overwrite"]) == 0
    assert open_results(tmp_path / "out").summary["seed"] == 77


@pytest.mark.parametrize(
    ("problem", "status", "said"),
    [
        (MemoryError(), 2, "MemoryError: there is no more memory"),
        (OSError(errno.EIO, "Input/output error"), 2, "Input/output error"),
        (SystemError("a library's"), 1, "SystemError: a library's (this is a fault"),
        (Terminated(signal.SIGHUP), 129, "interrupted"),
    ],
)
def test_whatever_ends_a_run_keeps_what_is_done(
    tmp_path, monkeypatch, capsys, problem, status, said
):
    """One message, the exit code, where the frames are; the next call goes on. Planted bug: said
    on Ctrl-C only."""
    (tmp_path / "scene.yaml").write_text(to_yaml(small(frames=4)))
    keep_every_frame(monkeypatch)
    hear = stations.Station.receive

    def broken(self, frame, *rest):
        if frame.number == 3:
            raise problem
        return hear(self, frame, *rest)

    command = ["run", str(tmp_path / "scene.yaml"), "--out", str(tmp_path / "out")]
    with monkeypatch.context() as once:
        once.setattr(stations.Station, "receive", broken)
        assert main(command) == status
    shown = capsys.readouterr().err
    assert said in shown and "keeps the frames so far" in shown and "Traceback" not in shown
    assert main(command) == 0
    assert "resuming after" in capsys.readouterr().err


def test_a_run_on_a_full_disk_goes_on_once_there_is_room(tmp_path, small_disk, monkeypatch, capsys):
    """A real one, which is full when the frames are kept (a warning), and when the results are
    written (exit 2, one message, no half file): then the same command goes on to the same bits.
    Planted bug: the kept frames removed when no more can be."""
    (tmp_path / "scene.yaml").write_text(to_yaml(dense_scenario(frames=5)))
    keep_every_frame(monkeypatch)
    monkeypatch.setattr("isac_rt.results.files.ROOM_BYTES", 0)
    disk = small_disk(64)
    out = disk / "out"
    command = ["run", str(tmp_path / "scene.yaml"), "--out", str(out)]
    assert main(command) == 2
    said = capsys.readouterr().err
    assert said.count("cannot write") == 1 and "No space left" in said and "make room" in said
    assert "not kept (database or disk is full)" in said and "Traceback" not in said
    assert [p.name for p in out.iterdir()] == [FILE] and "keeps the frames so far" in said
    subprocess.run(["mount", "-o", "remount,size=40m", str(disk)], check=True)
    assert main(command) == 0
    assert "resuming after" in capsys.readouterr().err
    assert_equal_results(open_results(out), simulate.run(dense_scenario(frames=5)))


def entries_in(file):
    """Entries that are committed; none where there is no table yet."""
    try:
        with closing(sqlite3.connect(f"file:{file}?mode=ro", uri=True)) as database:
            return database.execute("SELECT count(*) FROM entry").fetchone()[0]
    except sqlite3.Error:
        return 0


@pytest.mark.slow
@pytest.mark.parametrize("how", [signal.SIGINT, signal.SIGTERM, signal.SIGKILL])
def test_the_command_goes_on_after_it_was_stopped(tmp_path, how):
    """From outside, once an entry is written: the message, the frames taken up, the same results,
    and no file left behind."""
    scenario = tmp_path / "scene.yaml"
    scenario.write_text(to_yaml(small(frames=8)))
    out = tmp_path / "out"
    program = f"""
import sys, isac_rt.simulation.resume
isac_rt.simulation.resume.Resume.__init__.__defaults__ = (0.0,)
from isac_rt.cli.cli import main
sys.exit(main(["run", {str(scenario)!r}, "--out", {str(out)!r}]))
"""
    command = [sys.executable, "-c", program]
    child = subprocess.Popen(
        command, stderr=subprocess.PIPE, stdout=subprocess.DEVNULL, text=True, cwd=ROOT
    )
    while child.poll() is None and not entries_in(out / FILE):
        time.sleep(0.01)
    os.kill(child.pid, how)
    _, said = child.communicate(timeout=60)
    if how != signal.SIGKILL:
        assert child.returncode == 128 + how and "keeps the frames so far" in said
    assert (out / FILE).exists() and not (out / "results.nc").exists()
    again = subprocess.run(command, capture_output=True, text=True, cwd=ROOT, timeout=300)
    assert again.returncode == 0 and "resuming after the frames" in again.stderr
    assert not (out / FILE).exists()
    assert_equal_results(open_results(out), simulate.run(small(frames=8)))
