"""The documentation builds without a warning, and what it says about keys comes from the schema."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest
from extensions.access.test_access_run import run as access_run
from simulation.test_fall_back import scenario as dense
from talking import scenario as talking

from isac_rt.simulation import simulate
from isac_rt.views.plots import Plots

ROOT = Path(__file__).parent.parent


def files_of(folder: Path) -> dict[Path, int]:
    """Files below a folder with the time of their last change; byte code is left out."""
    files = (p for p in folder.rglob("*") if p.is_file() and "__pycache__" not in p.parts)
    return {p: p.stat().st_mtime_ns for p in files}


@pytest.fixture(scope="module")
def site(tmp_path_factory) -> Path:
    pytest.importorskip("sphinx")
    out = tmp_path_factory.mktemp("site")
    before = files_of(ROOT / "docs")
    options = ["-q", "-W", "--keep-going", "-D", "gallery_draws=0"]
    done = subprocess.run(
        [sys.executable, "-m", "sphinx", *options, str(ROOT / "docs"), str(out)],
        cwd=ROOT,
        env={**os.environ, "PYTHONPATH": str(ROOT)},
        capture_output=True,
        text=True,
        timeout=300,
    )
    assert done.returncode == 0, done.stderr
    assert files_of(ROOT / "docs") == before, "the build wrote into its source"
    return out


def gallery() -> list[tuple[str, str]]:
    """What is drawn, and the scenario, of every picture of the gallery."""
    page = (ROOT / "docs" / "gallery.md").read_text()
    return re.findall(r"^```\{picture\} (.+)\n((?:.*\n)*?)```", page, re.MULTILINE)


@pytest.mark.slow
@pytest.mark.parametrize("k", range(12))
def test_the_gallery_draws_its_scenarios(k, tmp_path, monkeypatch):
    """Each of the twelve gives a picture. Planted bug: the pictures' scenarios without `clutter`'s
    name."""
    monkeypatch.syspath_prepend(str(ROOT / "docs" / "_ext"))
    import gallery as pictures

    what, text = gallery()[k]
    pictures.draw(text, what.split(), tmp_path / "picture.png")
    assert (tmp_path / "picture.png").stat().st_size > 20_000


def test_the_gallery_shows_twelve_scenarios(tmp_path, monkeypatch):
    """All are read, and drawn by what is there. Planted bug: a key that is gone."""
    monkeypatch.syspath_prepend(str(ROOT / "docs" / "_ext"))
    import gallery as pictures

    entries = gallery()
    assert len(entries) == 12
    for k, (what, text) in enumerate(entries):
        (folder := tmp_path / f"{k}").mkdir()
        pictures.scenario_of(text, folder)
        assert what == "view" or hasattr(Plots, what.split()[0])


def test_every_page_is_there(site):
    pages = {
        p.relative_to(ROOT / "docs").with_suffix(".html") for p in (ROOT / "docs").rglob("*.md")
    }
    assert all((site / page).is_file() for page in pages)


def test_every_notebook_has_its_page(site):
    """The page shows cells and pictures. Planted bug: `fill` not connected."""
    stems = {p.stem for p in (ROOT / "notebooks").glob("*.ipynb")}
    assert {p.stem for p in (ROOT / "docs" / "notebooks").glob("*.md")} == stems
    for stem in stems:
        page = (site / "notebooks" / f"{stem}.html").read_text(encoding="utf-8")
        assert "highlight-ipython3" in page or "highlight-python" in page, stem
        for view in re.findall(r'src="../_static/([\w]+\.html)"', page):
            assert (site / "_static" / view).is_file(), view


def test_the_reference_has_every_key(site):
    """Keys deep in the tree, their defaults and their limits. Planted bug: nodes behind anyOf left
    out."""
    page = re.sub(r"<[^>]+>", "", (site / "scenario.html").read_text(encoding="utf-8"))
    for key in (
        "sampling_rate_hz",
        "weakest_path_db",
        "clock_drift_ppm",
        "cell_area_per_metre_m",
        "acceleration_std_mps2",
        "time_s",
    ):
        assert key in page, key
    assert "77000000000.0" in page


MOST_WORDS = 36_900
"""Words of all pages together, about three hours of reading."""
DIARY = re.compile(r"\b20\d\d-\d\d-\d\d\b|`(?!dca1000`)[0-9a-f]{7,40}`")
"""Dates and commits, which say when something was so and not what is so."""


def test_the_pages_are_short_and_no_diary():
    """Prose wraps at 100 columns. Planted bug: a commit named on a page."""
    words = 0
    for page in [ROOT / "README.md", *(ROOT / "docs").rglob("*.md")]:
        text = page.read_text(encoding="utf-8")
        words += len(text.split())
        assert not DIARY.search(text), f"{page.name}: {DIARY.search(text)}"
        prose = re.sub(r"^```.*?^```", "", text, flags=re.MULTILINE | re.DOTALL)
        for line in prose.splitlines():
            if not line.startswith(("|", "    ", "$$", "![", "#")):
                assert len(line) <= 100, f"{page.name}: {line}"
    assert words < MOST_WORDS


def test_links_between_pages_and_files_lead_somewhere():
    """Markdown links to files of the repository, and files named in backquotes that begin with a
    folder of it."""
    for page in [ROOT / "README.md", *(ROOT / "docs").glob("*.md")]:
        text = page.read_text(encoding="utf-8")
        for target in re.findall(r"\]\((?!https?:|#)([^)#]+)\)", text):
            assert (page.parent / target).exists(), f"{page.name}: {target}"
        for name in re.findall(r"`((?:isac_rt|docs|tests|scenes|notebooks)/[\w./-]+\.\w+)`", text):
            assert (ROOT / name).exists(), f"{page.name}: {name}"


def test_tests_that_the_pages_name_are_there():
    """`test_file::test_name`. Planted bug: one of them renamed."""
    found = 0
    for page in (ROOT / "docs").glob("*.md"):
        for file, name in re.findall(
            r"`(?:tests/)?(?:\w+/)?(test_\w+)(?:\.py)?::(test_\w+)`",
            page.read_text(encoding="utf-8"),
        ):
            (found_in,) = (ROOT / "tests").rglob(f"{file}.py")
            tests = found_in.read_text(encoding="utf-8")
            assert re.search(rf"^def {name}\(", tests, re.MULTILINE), f"{page.name}: {name}"
            found += 1
    assert found > 50


def test_the_page_shows_the_rooms_in_the_order_that_the_tests_hold():
    """Planted bug: a room that the page forgets."""
    from test_layout import GROUND_FILES, ORDER

    rows = re.findall(r"^\| `(\w+)/` \|", (ROOT / "docs" / "contributing.md").read_text(), re.M)
    assert rows == [room for room in ORDER if room not in GROUND_FILES]
    drawn = re.findall(r'class="name"[^>]*>(\w+)<', (ROOT / "docs" / "rooms.svg").read_text())
    assert sorted(drawn) == sorted(rows)


def explained() -> dict[str, set[str]]:
    """Keys that `docs/outputs.md` explains in a sentence, by what they are of."""
    page = (ROOT / "docs" / "outputs.md").read_text(encoding="utf-8").partition("## Keys")[2]
    parts = re.split(r"^### Of (.+)$", "### Of all\n" + page, flags=re.MULTILINE)[1:]
    rows = re.compile(r"^\| `([\w.]+)` \| .+\. \|$", re.MULTILINE)
    pairs = zip(parts[::2], parts[1::2], strict=True)
    return {name.strip("`"): set(rows.findall(text)) for name, text in pairs}


NAMES = {"targets": "UAV", "links": "LINK"}
"""Keys whose keys are names, and the word that stands for them."""
ELSEWHERE = {
    "rmse_tracked",
    "counts",
    "cooperative",
    "targets.UAV.median",
    "targets.UAV.p90",
    "targets.UAV.bound_median",
    "targets.UAV.bound_p90",
    "targets.UAV.losses",
    "wall",
    "links.LINK.kept_per_frame",
    "merged",
    "blocks",
    "missed_blocks",
    "false_blocks",
    "feedback",
    "terminals",
}
"""Keys whose own keys are names, or explained with another key."""
AT_TIMES = {"checked", "by_set"}
"""Keys that only some runs write."""


def keys_of(tree: dict, at: str = ""):
    for key, value in tree.items():
        name = f"{at}{key}"
        yield name
        if isinstance(value, dict) and name not in ELSEWHERE:
            inside = value.values() if name in NAMES else [value]
            way = f"{name}.{NAMES[name]}." if name in NAMES else f"{name}."
            for one in inside:
                yield from keys_of(one, way)


def test_every_key_of_a_summary_has_a_sentence():
    """Three small runs, one with the stages before the data and feedback, one whose receivers judge
    how sparse the scene is, one whose terminals cooperate; no sentence is left without its key.
    Planted bugs: a key more in a terminal's block; a sentence taken out."""
    access = {"establish": True, "synchronisation": "two_round", "feedback": True}
    with_access = access_run(frames=3, access=access).summary
    sparse = simulate.run(dense(frames=3), snapshots=0).summary
    written: dict[str, set[str]] = {"all": set(with_access)}
    blocks = [*with_access["terminals"].values(), *with_access["links"].values()]
    written["every terminal and link"] = {key for block in blocks for key in keys_of(block)}
    for part in ("city", "timing_s", "fidelity", "access"):
        written[part] = set(keys_of(with_access[part]))
    talked = simulate.run(talking(frames=3), snapshots=0).summary["swarm"]
    assert talked["terminals"].keys() == {"AT", "PT"}
    written["swarm"] = {key for of in (talked, talked["terminals"]["PT"]) for key in keys_of(of)}
    written["sparsity"] = {f"LINK.{key}" for row in sparse["sparsity"].values() for key in row}
    found = explained()
    assert written.keys() == found.keys()
    for part, keys in written.items():
        assert keys <= found[part], f"{part}: {sorted(keys - found[part])}"
        assert found[part] - keys <= AT_TIMES, f"{part}: {sorted(found[part] - keys)}"
