"""The report in a real browser without a network. Left out where there is no Chromium."""

from __future__ import annotations

import json
import re
import shutil
import subprocess
from pathlib import Path

import pytest
from fake_run import fake_run

from isac_rt.scenario.file import load
from isac_rt.views.figures import make_figures
from isac_rt.views.report import write_report

BROWSER = next(
    (
        path
        for name in ("chromium", "chromium-browser", "google-chrome")
        if (path := shutil.which(name))
    ),
    None,
)
pytestmark = pytest.mark.skipif(BROWSER is None, reason="no Chromium on this machine")
PROBE = """
<script>
addEventListener("error", e => window.failed = (window.failed || 0) + 1);
addEventListener("load", () => {
  const pictures = [...document.images], page = document.documentElement;
  parent.postMessage(JSON.stringify({pictures: pictures.length,
    drawn: pictures.filter(i => i.naturalWidth > 300).length,
    outside: [...document.querySelectorAll("img, table")]
      .filter(e => e.src && !e.src.startsWith("data:")).length,
    wide: page.scrollWidth, view: page.clientWidth, failed: window.failed || 0,
    letters: parseFloat(getComputedStyle(document.querySelector("td")).fontSize),
    words: document.body.innerText.length}), "*");
});
</script>
"""
FRAME = """<!doctype html><script>
addEventListener("message", e => document.title = e.data);
</script><iframe src="probed.html" style="width: {width}px; height: 900px; border: 0"></iframe>
"""
"""A window has 500 pixels at least; a frame in it is as narrow as a phone."""


@pytest.fixture(scope="module")
def report(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("report")
    results = fake_run(
        load(Path(__file__).parents[2] / "scenes" / "street_canyon.yaml", ["frames=6"])
    )
    page = write_report(results, folder, make_figures(results, folder)).read_text(encoding="utf-8")
    file = folder / "probed.html"
    file.write_text(page.replace("<head>", "<head>" + PROBE), encoding="utf-8")
    return file


@pytest.mark.parametrize("width", [420, 1400])
def test_the_report_renders(report, width):
    """On a phone's width and on a desk's: every figure drawn, nothing fetched, no error, no
    sideways scrolling, letters of 12 pixels or more. Planted bug: an image by its file's name."""
    frame = report.with_name(f"frame_{width}.html")
    frame.write_text(FRAME.format(width=width), encoding="utf-8")
    command = [
        BROWSER,
        "--headless",
        "--no-sandbox",
        "--disable-gpu",
        "--hide-scrollbars",
        f"--window-size={width + 100},1000",
        "--enable-logging=stderr",
        f"--user-data-dir={report.parent / 'profile'}",
        "--virtual-time-budget=3000",
        "--dump-dom",
        frame.as_uri(),
    ]
    done = subprocess.run(command, capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stderr
    assert "CONSOLE" not in done.stderr
    found = json.loads(
        re.search(r"<title>(\{.*?\})</title>", done.stdout)[1].replace("&quot;", '"')
    )
    assert found["pictures"] == found["drawn"] >= 6
    assert found["outside"] == found["failed"] == 0
    assert found["wide"] <= found["view"] == width
    assert found["letters"] >= 12
    assert found["words"] > 1000
