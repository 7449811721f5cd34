"""Runs that are ended from outside, disks that are full, folders that cannot be written; and runs
that must not differ by a bit."""

from __future__ import annotations

import errno
import hashlib
import json
import os
import re
import signal
import subprocess
import sys
import time
import tomllib
from pathlib import Path

import numpy as np
import pytest
import xarray as xr
from fake_run import fake_run, fake_scenario
from talking import small

from isac_rt import storage
from isac_rt.cli.cli import main
from isac_rt.results.files import save
from isac_rt.scenario.file import load, to_yaml
from isac_rt.simulation import simulate
from isac_rt.storage import StorageError, write_whole

ROOT = Path(__file__).parents[2]
WHOLE = {"results.nc", "summary.json", "scenario.yaml"}
WITHOUT_A_NUMBER = {
    "jinja2",
    "matplotlib",
    "pandas",
    "pyyaml",
    "rich",
    "threadpoolctl",
    "typer",
}
"""Dependencies that start, show or look up what others compute."""

PROGRAM = """
import sys, time, types
import os
import isac_rt.results.files
from isac_rt import storage
from isac_rt.cli.cli import main
sys.path.insert(0, {tests!r})
from fake_run import fake_coverage, fake_run
import numpy as np
from isac_rt.simulation.setup import swarm_of
from isac_rt.world.city.mesh import empty_city
import isac_rt.simulation.setup as setup
fake = types.ModuleType("isac_rt.simulation.simulate")
setup.prepare = lambda s, **_: types.SimpleNamespace(
    city=empty_city("none", np.zeros(3)),
    swarm=swarm_of(s),
    timetable=types.SimpleNamespace(epoch=lambda f: 0.043 * f),
    coverage=fake_coverage(s),
)
setup.link_budgets = lambda setup: []
fake.run = lambda s, **_: fake_run(s)
sys.modules["isac_rt.simulation.simulate"] = isac_rt.simulation.simulate = fake
replace = os.replace
def slowly(temporary, file):
    print(file.name, flush=True)
    time.sleep(300 if file.name == {when!r} else 0)
    replace(temporary, file)
storage.os.replace = slowly
sys.exit(main(["run", {scenario!r}, "--out", {out!r}]))
"""


@pytest.mark.parametrize(
    ("how", "when"),
    [
        (signal.SIGTERM, "results.nc"),
        pytest.param(signal.SIGKILL, "summary.json", marks=pytest.mark.slow),
        pytest.param(signal.SIGINT, "results.nc", marks=pytest.mark.slow),
        pytest.param(signal.SIGTERM, "summary.json", marks=pytest.mark.slow),
        pytest.param(signal.SIGKILL, "results.nc", marks=pytest.mark.slow),
        pytest.param(signal.SIGHUP, "results.nc", marks=pytest.mark.slow),
    ],
)
def test_a_run_that_is_killed_while_it_writes(how, when, tmp_path):
    """Each file is whole or absent; asked to end (SIGTERM, Ctrl-C) the run takes its unfinished
    file along, which Python's own answer to SIGTERM would leave."""
    scenario, out = tmp_path / "s.yaml", tmp_path / "o"
    scenario.write_text(to_yaml(fake_scenario()))
    program = PROGRAM.format(
        tests=str(ROOT / "tests"), scenario=str(scenario), out=str(out), when=when
    )
    child = subprocess.Popen(
        [sys.executable, "-c", program],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        cwd=ROOT,
    )
    assert child.stdout is not None
    while (line := child.stdout.readline()) and line.strip() != when:
        pass
    assert line, child.communicate()
    time.sleep(0.1)
    os.kill(child.pid, how)
    _, said = child.communicate(timeout=60)
    left = {p.name for p in out.iterdir()}
    assert child.returncode == (-9 if how == signal.SIGKILL else 128 + how), said
    assert left - {n for n in left if n.endswith(".tmp")} == (
        set() if when == "results.nc" else {"results.nc", "scenario.yaml"}
    )
    if how != signal.SIGKILL:
        assert not [n for n in left if n.endswith(".tmp")], left
        assert "interrupted" in said and "Traceback" not in said
    for name in left & WHOLE:
        if name == "results.nc":
            with xr.open_dataset(out / name, engine="h5netcdf") as dataset:
                assert dataset.sizes["frame"] == 7
        else:
            assert load(out / name).name == "fake"


@pytest.mark.parametrize("code", [errno.ENOSPC, errno.EACCES, errno.EROFS, errno.EIO])
def test_a_full_disk_is_one_message_and_leaves_nothing(code, tmp_path, monkeypatch):
    """Written against: the temporary file left behind."""
    run = fake_run()

    def full(_):
        raise OSError(code, os.strerror(code))

    monkeypatch.setattr(storage.os, "fsync", full)
    with pytest.raises(StorageError, match=r"cannot write .*(make room|--out)"):
        write_whole(tmp_path / "summary.json", json.dumps(run.summary))
    assert not list(tmp_path.iterdir())


def test_an_unwritable_folder_is_refused_before_the_run(tmp_path, capsys):
    scenario = tmp_path / "s.yaml"
    scenario.write_text(to_yaml(fake_scenario()))
    (tmp_path / "file").touch()
    assert main(["run", str(scenario), "--out", str(tmp_path / "file" / "o")]) == 2
    said = capsys.readouterr().err
    assert "cannot write" in said and len(said.strip().splitlines()) == 1


def digest(run) -> str:
    """Digest of every number of a run and of the order of variables, but for times taken."""
    out = hashlib.sha256()
    for name in sorted(run.dataset.variables):
        values = run.dataset[name].values
        out.update(
            name.encode()
            + (
                repr(values.tolist()).encode()
                if values.dtype == object
                else np.ascontiguousarray(values).tobytes()
            )
        )
    return out.hexdigest() + json.dumps(
        {k: v for k, v in run.summary.items() if k != "timing_s"}, sort_keys=True
    )


def test_reruns_are_equal_bit_by_bit_whatever_the_threads():
    """One, two and five receivers at work at once, and again. Written against: a generator shared
    by the receivers."""
    found = {digest(simulate.run(small(), threads=threads)) for threads in (1, 2, 5, 1)}
    assert len(found) == 1
    assert digest(simulate.run(small().model_copy(update={"seed": 2}))) not in found


def test_versions_stand_in_the_results(tmp_path):
    """Another version of a package is seen in the file and in the summary. Written against:
    versions taken when the module is written, and a new dependency that nobody entered."""
    import importlib.metadata

    run = fake_run()
    save(run, tmp_path)
    with xr.open_dataset(tmp_path / "results.nc", engine="h5netcdf") as dataset:
        kept = json.loads(dataset.attrs["versions"])
    needed = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["dependencies"]
    names = {re.match(r"[\w-]+", line)[0] for line in needed} - WITHOUT_A_NUMBER
    assert len(names) > 7
    of_others = "llvmlite drjit mitsuba shapely pyproj mapbox_earcut".split()
    for name in [*names, *of_others]:  # numba's compiler, the tracer's, and of the extra cities
        assert kept[name] == importlib.metadata.version(name) == run.summary["versions"][name]
