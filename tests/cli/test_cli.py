"""The command line: exit codes, messages, files; the simulation behind it is a fake."""

from __future__ import annotations

import gc
import json
import logging
import os
import re
import signal
import subprocess
import sys
import time
import types
from pathlib import Path

import numpy as np
import pytest
import xarray as xr
from fake_run import fake_coverage, fake_records, fake_run, fake_scenario
from matplotlib.image import imread

import isac_rt.simulation
from isac_rt.cli import console
from isac_rt.cli.cli import main
from isac_rt.document import ScenarioWarning
from isac_rt.frame.level import LinkBudget
from isac_rt.scenario.file import to_yaml
from isac_rt.simulation.resume import sole_use
from isac_rt.simulation.setup import swarm_of

ROOT = Path(__file__).parents[2]


@pytest.fixture
def scenario_file(tmp_path):
    file = tmp_path / "fake.yaml"
    file.write_text(to_yaml(fake_scenario()))
    return file


def test_garbage_is_looked_for_less_often(capsys):
    """Twenty thousand objects that nothing refers to but themselves are made before it is; old
    ones are looked through as often as ever. Planted bugs: no threshold; one of 20 for old ones."""
    usual = gc.get_threshold()
    try:
        assert main(["--version"]) == 0
        assert gc.get_threshold()[1:] == usual[1:]
        before = gc.get_stats()[0]["collections"]
        for _ in range(15_000):
            itself: list = []
            itself.append(itself)
        assert gc.get_stats()[0]["collections"] <= before + 1
    finally:
        gc.set_threshold(*usual)


PROCESS = "from isac_rt.cli.cli import main; import sys; sys.exit(main())"


def shell(line: str, folder: Path, **environment: str) -> subprocess.CompletedProcess[bytes]:
    """What bash makes of a line in which `isac-rt` stands for the command in a process."""
    command = f"{sys.executable} -c '{PROCESS}'"
    return subprocess.run(
        ["bash", "-c", f"set -o pipefail; {line.replace('isac-rt', command)}"],
        cwd=folder,
        env=os.environ | {"PYTHONPATH": str(ROOT)} | environment,
        capture_output=True,
    )


@pytest.mark.parametrize("encoding", ["ascii", "latin-1", "utf-8"])
def test_letters_that_a_terminal_lacks_are_replaced(encoding, tmp_path):
    """Planted bug: a traceback of Python's."""
    text = "{name: n, swarm: {A: {role: active, position_m: [0, 0, 9]}}, \N{SNOWMAN}: 1}"
    (tmp_path / "s.yaml").write_text(text)
    done = shell("isac-rt plan s.yaml", tmp_path, PYTHONIOENCODING=encoding)
    assert (done.returncode, done.stderr.count(b"\n")) == (2, 1)
    program = (
        "import sys; from isac_rt.cli import cli, console; cli._settle_streams()\n"
        "console.say_table(['a \N{EN DASH} b'], [['\N{SNOWMAN}']])"
    )
    environment = os.environ | {"PYTHONIOENCODING": encoding}
    said = subprocess.run([sys.executable, "-c", program], env=environment, capture_output=True)
    assert (said.returncode, said.stderr) == (0, b"")


@pytest.mark.parametrize(
    ("line", "status", "said"),
    [
        ("isac-rt schema | head -1", 0, b""),
        ("isac-rt --help | true", None, b""),
        ("isac-rt plan none.yaml 2>&-", 2, b""),
        ("isac-rt none 2>&-", 2, b""),
        ("isac-rt plan none.yaml >&- 2>&- <&-", 2, b""),
        ("isac-rt plan none.yaml 2>/dev/full", 2, b""),
        ("isac-rt --version >&-", 0, b""),
    ],
)
def test_nobody_reads_what_is_said(line, status, said, tmp_path):
    """No traceback, and the status of what was asked. Planted bug: a message to a closed stderr
    is an error of its own, with status 1."""
    done = shell(line, tmp_path)
    assert done.stderr == said
    assert status is None or done.returncode == status


@pytest.mark.parametrize(
    ("given", "closed", "status"),
    [("--version", ">&-", 0), ("--version", "2>&-", 0), ("none", ">&-", 2)],
)
def test_it_ends_where_nobody_listens(given, closed, status):
    """With an output that was closed before it began, which Python has as None. Planted bug: its
    flush asked for (a traceback at the end, or Python's own end)."""
    command = "import sys; from isac_rt.cli.cli import main; sys.exit(main())"
    whole = f'exec "$0" -c "{command}" "$@" {closed}'
    done = subprocess.run(
        ["sh", "-c", whole, sys.executable, given], capture_output=True, text=True, cwd=ROOT
    )
    assert done.returncode == status and "Traceback" not in done.stderr


@pytest.fixture
def simulation(monkeypatch):
    """A stand-in for the simulation: it reports progress and hands back made-up results."""
    fake = types.ModuleType("isac_rt.simulation.simulate")

    def prepare(scenario, **_):
        from isac_rt.world.city.mesh import empty_city

        return types.SimpleNamespace(
            city=empty_city("none", np.zeros(3)),
            swarm=swarm_of(scenario),
            timetable=types.SimpleNamespace(epoch=lambda f: 0.043 * f),
            coverage=fake_coverage(scenario),
        )

    def run(scenario, *, setup, progress, snapshots, resume):
        for k in range(scenario.frames):
            progress(k + 1, scenario.frames)
        return fake_run(scenario)

    fake.run = run
    fake.setup = setup = types.ModuleType("isac_rt.simulation.setup")
    setup.prepare = prepare
    setup.link_budgets = lambda setup: [
        LinkBudget("AT->PT1", "line of sight", 34.4, -71.2, -88.9, 17.7, 47.1, 64.8)
    ]
    setup.trace = lambda s, frame, setup=None: {
        ("AT", n): o.paths for n, o in fake_records(s)[frame].observers.items()
    }
    for module in (fake, setup):
        monkeypatch.setitem(sys.modules, module.__name__, module)
        monkeypatch.setattr(
            isac_rt.simulation, module.__name__.rpartition(".")[2], module, raising=False
        )
    return fake


@pytest.fixture
def undrawn(simulation, monkeypatch):
    """Pictures take longer than all else."""
    monkeypatch.setattr("isac_rt.views.figures.make_figures", lambda *_: [])
    return simulation


def test_run_writes_everything(scenario_file, simulation, tmp_path, capsys):
    assert (
        main(
            [
                "run",
                str(scenario_file),
                "--out",
                str(tmp_path / "out"),
                "--frames",
                "5",
                "--seed",
                "42",
            ]
        )
        == 0
    )
    assert {p.name for p in (tmp_path / "out").iterdir()} == {
        "results.nc",
        "summary.json",
        "scenario.yaml",
        "report.html",
        "figures",
    }
    summary = json.loads((tmp_path / "out" / "summary.json").read_text())
    assert (summary["frames"], summary["seed"]) == (5, 42)
    said = capsys.readouterr()
    assert "AT to PT1" in said.out and "line of sight" in said.out and "report.html" in said.out
    assert "Traceback" not in said.err


def test_results_of_another_scenario_are_replaced_only_when_asked(
    scenario_file, undrawn, tmp_path, capsys
):
    """The same scenario may be run again. Planted bug: only seeds compared."""
    out = tmp_path / "out"
    command = ["run", str(scenario_file), "--out", str(out)]
    assert main(command) == 0
    assert main(command) == 0
    before = {file.name: file.read_bytes() for file in out.iterdir() if file.is_file()}
    for change in (["--seed", "42"], ["--frames", "5"], ["--set", "noise.tx_power_dbm=3"]):
        capsys.readouterr()
        assert main([*command, *change]) == 2
        said = capsys.readouterr().err
        assert "holds the results of another scenario" in said and "--overwrite" in said
        assert said.count("\n") == 1
    assert {file.name: file.read_bytes() for file in out.iterdir() if file.is_file()} == before
    assert main([*command, "--seed", "42", "--overwrite"]) == 0
    assert json.loads((out / "summary.json").read_text())["seed"] == 42


def test_a_folder_is_of_one_run_at_a_time(scenario_file, undrawn, tmp_path, capsys):
    """From before it is looked at. Planted bug: held while results are written only."""
    out = tmp_path / "out"
    out.mkdir()
    with sole_use(out):
        assert main(["run", str(scenario_file), "--out", str(out)]) == 2
    assert re.fullmatch(r".* is in use by another run; .*--out\n", capsys.readouterr().err)
    assert main(["run", str(scenario_file), "--out", str(out)]) == 0


def test_room_is_asked_for_before_a_run(scenario_file, simulation, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr("isac_rt.results.files.ROOM_BYTES", 10**18)
    assert main(["run", str(scenario_file), "--out", str(tmp_path / "out")]) == 2
    assert "MB are free" in capsys.readouterr().err


def test_demo_needs_no_file(undrawn, tmp_path, monkeypatch, capsys):
    """In an empty folder: the scenario beside its results, and what to do next; called again it
    keeps what was changed. Planted bug: the scenario written anew."""
    monkeypatch.chdir(tmp_path)
    assert main(["demo"]) == 0
    file = tmp_path / "isac_rt_demo" / "demo.yaml"
    assert (file.parent / "results" / "report.html").is_file()
    assert "next: change isac_rt_demo/demo.yaml" in capsys.readouterr().out
    file.write_text(file.read_text().replace("seed: 1 ", "seed: 17 "))
    assert main(["demo"]) == 0
    summary = json.loads((file.parent / "results" / "summary.json").read_text())
    assert (summary["seed"], summary["frames"]) == (17, 12)


def test_set_reaches_the_scenario(scenario_file, undrawn, tmp_path):
    assert (
        main(
            [
                "run",
                str(scenario_file),
                "--out",
                str(tmp_path / "o"),
                "--set",
                "modulation.dpsk_order=4",
            ]
        )
        == 0
    )
    assert "dpsk_order: 4" in (tmp_path / "o" / "scenario.yaml").read_text()


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["run", "no_such.yaml"], "no_such.yaml"),
        (["run", "{s}", "--set", "radio.grops=2"], "--set"),
        (["run", "{s}", "--frames", "0"], "frames"),
        (["run", "{s}", "--out", "{s}"], "cannot write"),
        (["run", "{s}", "--speed", "9"], "--speed"),
        (["paths", "{s}", "--frame", "7", "--out", "x.nc"], "0 to 6"),
        (["paths", "{s}"], "--frame"),
        (["fly"], "fly"),
    ],
)
def test_wrong_input_ends_with_2_and_one_message(
    arguments, words, scenario_file, simulation, capsys, monkeypatch, tmp_path
):
    """Planted bug: `class ResultsError(Exception)`."""
    monkeypatch.chdir(tmp_path)
    assert main([a.format(s=scenario_file) for a in arguments]) == 2
    said = capsys.readouterr().err
    assert words in said and "Traceback" not in said and len(said.strip().splitlines()) == 1


def test_anything_else_ends_with_1_and_says_how_to_look(
    scenario_file, simulation, capsys, monkeypatch, tmp_path
):
    def broken(scenario, **_):
        raise ZeroDivisionError("division by zero")

    simulation.run = broken
    arguments = ["run", str(scenario_file), "--out", str(tmp_path / "o")]
    assert main(arguments) == 1
    said = capsys.readouterr().err
    assert "ISAC_RT_DEBUG" in said and "Traceback" not in said
    assert not list((tmp_path / "o").iterdir())
    monkeypatch.setenv("ISAC_RT_DEBUG", "1")
    assert main(arguments) == 1 and "Traceback" in capsys.readouterr().err


def test_a_runtime_problem_ends_with_2(scenario_file, simulation, capsys, tmp_path):
    from isac_rt.runtime import RuntimeProblem

    def refuse(scenario, **_):
        raise RuntimeProblem("no usable LLVM; install libllvm19")

    simulation.setup.prepare = refuse
    assert main(["run", str(scenario_file), "--out", str(tmp_path / "o")]) == 2
    assert "libllvm19" in capsys.readouterr().err


def test_paths_writes_the_ledger(scenario_file, simulation, tmp_path, capsys):
    assert main(["paths", str(scenario_file), "--frame", "2", "--out", str(tmp_path / "p.nc")]) == 0
    with xr.open_dataset(tmp_path / "p.nc", engine="h5netcdf") as d:
        assert set(d.receiver.values) == {"AT", "PT1"} and d.sizes["path"] == 46
    assert "AT to PT1" in capsys.readouterr().out


def test_view_draws_a_picture(scenario_file, simulation, tmp_path):
    assert main(["view", str(scenario_file), "--out", str(tmp_path / "v.png")]) == 0
    assert imread(tmp_path / "v.png")[..., :3].var() > 1e-3


@pytest.mark.parametrize("columns", [None, 80])
def test_titles_keep_their_units_on_the_screen(
    columns, scenario_file, undrawn, tmp_path, capsys, monkeypatch
):
    """On a terminal of 80 columns and without one. Planted bug: `Console()`, for which
    "range [m]" is "range" in the style m."""
    if columns is not None:
        monkeypatch.setenv("TTY_COMPATIBLE", "1")
        monkeypatch.setenv("NO_COLOR", "1")
        monkeypatch.setenv("COLUMNS", str(columns))
    assert main(["run", str(scenario_file), "--out", str(tmp_path / "o [m] :smile:")]) == 0
    said = re.sub(r"\x1b\[[0-9;]*m", "", capsys.readouterr().out)
    for unit in ("[m]", "[m/s]", "[deg]", "[kbit/s]", "[dBm]", "[dB]", "o [m] :smile:"):
        assert unit in said, unit
    words = set(said.split())
    for word in ("Elevation", "Erased", "processed", "received", "AT"):
        assert word in words, word
    assert "GOSPA" in words
    assert "AT to PT1: of 6 target-frames in view: 5 found, 1 inaccurate" in said
    assert "AT to PT1: of 0.143 false tracks per frame: 0.143 target" in said
    if columns is not None:
        tables = [t for t in said.splitlines() if not t.startswith(("paths:", "results in"))]
        assert max(map(len, tables)) <= columns


def test_warnings_are_said_as_they_stand(scenario_file, undrawn, tmp_path, capsys):
    """Planted bug: warnings printed as markup."""
    changes = ["--set", "radio.carrier_hz=9e8", "--out", str(tmp_path / "o")]
    assert main(["run", str(scenario_file), *changes]) == 0
    assert "warning --set radio.carrier_hz=9e8: 9e+08 is outside" in capsys.readouterr().err
    isac_rt.cli.cli._say_warning("[bold]not[/] markup", ScenarioWarning)
    assert "warning [bold]not[/] markup" in capsys.readouterr().err


def test_the_help_groups_the_commands_in_80_columns(capsys, monkeypatch):
    """Every command stands in one panel with one sentence on at most two lines. Planted bugs: a
    command without a panel, which stands among "Commands"; help of four sentences."""
    monkeypatch.setenv("COLUMNS", "80")
    assert main(["--help"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert max(map(len, lines)) <= 80 and len(lines) < 60
    titles = [line.strip("\u256d\u2500\u256e ") for line in lines if line.startswith("\u256d")]
    assert titles == ["Options", *isac_rt.cli.cli.PANELS]


def test_help_shows_every_default(capsys, monkeypatch):
    """What stands for a missing option. Planted bug: an option with a default of None whose help
    does not say what happens without it."""
    monkeypatch.setenv("COLUMNS", "200")
    for name, defaults in (
        ("run", ("runs/NAME", "the scenario's", "default: 3")),
        ("figures", ("default: pdf", "default: wide", "DIR/figures_STYLE")),
        ("animate", ("DIR/run.gif", "default: 5.0", "the first")),
    ):
        assert main([name, "--help"]) == 0
        said = capsys.readouterr().out
        assert all(default in said for default in defaults), name


def test_help_of_every_command_says_its_options(capsys):
    """Flags take no value. Planted bug: typer's type, `--restart <bool>`."""
    for name, option in (("run", "--set"), ("sweep", "--retry-failed"), ("bench", "--json")):
        assert main([name, "--help"]) == 0
        said = capsys.readouterr().out
        assert option in said and "<bool>" not in said


def test_where_no_terminal_shows_a_bar_lines_come(capsys, monkeypatch):
    """At once, for a step that the program logs, at least so often while a native call holds on,
    and at the end with what is done. Planted bugs: the first line after the first period; nothing
    between two reports."""
    monkeypatch.setattr(console, "EVERY_S", 0.4)
    monkeypatch.setattr(console, "SOON_S", 0.1)
    said = list[tuple[float, str]]()
    begin = time.monotonic()
    monkeypatch.setattr(
        console.Console,
        "print",
        lambda _, text, **__: said.append((time.monotonic() - begin, text)),
    )

    def work(report):
        time.sleep(0.2)
        logging.getLogger("isac_rt.world").info("reading the %s", "city")
        time.sleep(1.0)
        report(2, 4)
        time.sleep(0.6)
        report(3, 4)
        time.sleep(0.6)
        report(4, 4)

    console.with_progress(work, "frames", 4)
    times, texts = zip(*said, strict=True)
    assert texts[0] == "frames: 0 of 4" and times[0] < 0.1
    assert texts[1] == "frames: 0 of 4, reading the city" and times[1] < 0.35
    assert max(np.diff(times)) < 0.4 + 0.2  # and the scheduler
    assert any(re.fullmatch(r"frames: 3 of 4, \d s, about \d s left", text) for text in texts)
    # the first part after a logged step says nothing of the rest
    assert not any("2 of 4" in text and "left" in text for text in texts)
    assert texts[-1].startswith("frames: 4 of 4")
    said.clear()
    with console.working("setting up"):
        time.sleep(0.5)
    assert [text for _, text in said] == ["setting up", "setting up"]
    logging.getLogger("isac_rt").info("nobody listens any more")
    assert len(said) == 2


@pytest.mark.parametrize(
    "command",
    [command for panel in isac_rt.cli.cli.PANELS.values() for command in panel],
    ids=lambda c: c.__name__,
)
def test_help_of_every_command_gives_an_example(command, capsys, monkeypatch):
    """Of that command, with options that it has and files that there are. Planted bug: an option
    of another command."""
    monkeypatch.setenv("COLUMNS", "140")
    name = command.__name__.rstrip("_")
    assert main([name, "--help"]) == 0
    said = capsys.readouterr().out
    example = re.search(rf"Example: (isac-rt {name}\b.*)", said)
    assert example is not None
    words = example[1].replace("│", " ").split()
    for word in words[2:]:
        if word.startswith("--"):
            assert said.count(word) >= 2, word
        if word.startswith("scenes/"):
            assert (Path(__file__).parents[2] / word).exists()


def test_version_names_the_program_and_what_is_under_it(capsys):
    assert main(["--version"]) == 0
    said = capsys.readouterr().out
    assert said.startswith(f"isac-rt {isac_rt.__version__} (python 3.")
    assert "sionna-rt" in said and said.count("\n") == 1


def test_schema_is_json_schema(capsys):
    assert main(["schema"]) == 0
    assert "swarm" in json.loads(capsys.readouterr().out)["properties"]


def test_doctor_says_what_to_do_and_fails_with_2(capsys, monkeypatch):
    from isac_rt import runtime

    monkeypatch.setattr(
        runtime, "doctor", lambda: [runtime.Check("LLVM", False, "none", "apt install libllvm19")]
    )
    assert main(["doctor"]) == 2 and "libllvm19" in capsys.readouterr().out
    monkeypatch.setattr(runtime, "doctor", lambda: [runtime.Check("LLVM", True, "19.1", "")])
    assert main(["doctor"]) == 0


def test_help_loads_nothing_heavy():
    """Seen to fail with `import numpy` at the top of cli.py."""
    heavy = ("numpy", "xarray", "matplotlib", "pydantic", "mitsuba")
    code = (
        "import sys; from isac_rt.cli.cli import main; main(['--help']); print([m for m in "
        f"{heavy} if m in sys.modules], file=sys.stderr)"
    )
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, cwd=ROOT, check=True
    )
    assert done.stderr.strip() == "[]" and "doctor" in done.stdout


def test_a_run_begins_without_what_writes_and_draws_its_results():
    """They take as long to load as a frame to make, and what is said before the first frame needs
    none of them. Planted bugs: `import xarray as xr` at the top of results/dataset.py, and of
    views/tables.py."""
    heavy = ("xarray", "pandas", "h5py", "matplotlib", "sionna")
    code = (
        "import sys; from isac_rt.cli import simulation; import isac_rt.scenario.file, "
        "isac_rt.results.files, isac_rt.simulation.resume, isac_rt.simulation.simulate, "
        f"isac_rt.views.tables; print([m for m in {heavy} if m in sys.modules])"
    )
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, cwd=ROOT, check=True
    )
    assert done.stdout.strip() == "[]"


@pytest.mark.parametrize("stuck", ["time.sleep(60)", "native()"])
def test_interrupt_ends_within_two_seconds(stuck, scenario_file, tmp_path):
    """Also inside a native call that Python cannot interrupt, with a partial file on disk. Seen
    to fail without the thread."""
    program = f"""
import ctypes, sys, time, types, os, pathlib
import isac_rt.storage
from isac_rt.cli.cli import main
import isac_rt.simulation.setup
def native():
    libc = ctypes.CDLL(None)
    end = time.time() + 60
    while time.time() < end:  # a native call that goes on: sleep itself returns on a signal
        try: libc.sleep(60)
        except KeyboardInterrupt: pass
def prepare(scenario, **_):
    with isac_rt.storage._beside(pathlib.Path({str(tmp_path / "o")!r}, "results.nc")) as half:
        half[1].write(b"half")
        print("ready", flush=True)
        {stuck}
isac_rt.simulation.setup.prepare = prepare
sys.exit(main(["run", {str(scenario_file)!r}, "--out", {str(tmp_path / "o")!r}]))
"""
    for _ in range(
        5
    ):  # others may keep the machine busy: one try in time shows that the program can
        child = subprocess.Popen(
            [sys.executable, "-c", program],
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
            cwd=ROOT,
        )
        assert child.stdout.readline().strip() == "ready"
        time.sleep(0.2)
        began = time.monotonic()
        os.kill(child.pid, signal.SIGINT)
        _, said = child.communicate(timeout=50)
        took = time.monotonic() - began
        assert child.returncode == 130
        assert "interrupted" in said and "Traceback" not in said
        if took < 2.0:
            break
    assert took < 2.0
    assert stuck != "native()" or not list((tmp_path / "o").iterdir())
