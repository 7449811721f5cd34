"""Figures and report: they show something, they are whole, and they need nothing but themselves."""

from __future__ import annotations

import base64
import io
import os
import re
import subprocess
import sys
from functools import partial

import matplotlib
import numpy as np
import pytest
import xarray as xr
from fake_run import fake_run
from matplotlib.figure import Figure
from matplotlib.image import imread
from matplotlib.text import Text
from matplotlib.transforms import Bbox

from isac_rt.cli.cli import main
from isac_rt.results.files import save
from isac_rt.results.records import KINDS
from isac_rt.views import figures
from isac_rt.views.figures import error_cdf, make_figures, over_time, scene_map
from isac_rt.views.maps import map_limits, range_doppler
from isac_rt.views.style import KIND_COLOURS, STYLE

INK_VARIANCE = 1e-3
"""Variance of pixels in [0, 1]: an empty framed axis has about 1e-4, one line more than this."""


@pytest.fixture(scope="module")
def run():
    return fake_run()


@pytest.fixture(scope="module")
def written(run, tmp_path_factory):
    folder = tmp_path_factory.mktemp("run")
    return folder, make_figures(run, folder)


def test_all_figures_are_there_and_hold_ink(written):
    """Seen to fail with figures saved before anything was drawn on them."""
    folder, files = written
    assert {f.stem for f in files} == {
        "scene",
        "range_doppler_0002",
        "equivalent_range_0002",
        "tracks_AT",
        "tracks_PT1",
        "errors",
        "errors_terminals",
        "paths",
        "decoding",
        "link",
    }
    assert sorted(p.name for p in (folder / "figures").iterdir()) == sorted(f.name for f in files)
    for file in files:
        pixels = imread(file)[..., :3]
        assert pixels.var() > INK_VARIANCE, file
        assert min(pixels.shape[:2]) > 200


def test_what_has_nothing_to_show_is_not_drawn(run):
    """Errors without an estimate, delay symbols of a plain radar. Planted bugs: empty axes; the
    equivalent range of frames without data."""
    empty = run.dataset.assign(
        detected_range=run.dataset.detected_range * np.nan, modulated=run.dataset.modulated & False
    )
    names = {drawing.name for drawing in figures._all(empty, None, False)}
    assert not names & {"errors", "errors_terminals", "equivalent_range_0002"}
    assert "range_doppler_0002" in names


@pytest.mark.parametrize(("quantity", "scale"), [("hit_rate", "linear"), ("ber", "log")])
def test_error_rates_of_a_sweep_are_logarithmic_and_shares_are_not(quantity, scale):
    """Planted bug: a share of 0.2 to 1 over decades."""
    rate = xr.DataArray([[0.2], [1.0]], dims=("x", "link"))
    rates = {f"{quantity}_{end}": rate for end in ("pooled", "low", "high")}
    d = xr.Dataset(rates, {"x": [1, 2], "link": ["A->A"]}, {"axis_x": "key"})
    assert figures.sweep_curves(Figure().subplots(), d, quantity, "x").get_yscale() == scale


def test_axes_of_one_figure_name_alike_once_and_write_one_time_axis(run):
    """Planted bugs: a legend on every axis; a time axis that none shares."""
    drawing = next(d for d in figures._all(run.dataset, None, False) if d.name == "tracks_AT")
    axes = figures._figure(drawing, figures.STYLES["screen"]).axes
    assert [ax.get_legend() is not None for ax in axes] == [True, False, False]
    assert [ax.get_xlabel() for ax in axes] == ["", "", "time [s]"]
    assert axes[0].get_shared_x_axes().joined(axes[0], axes[2])


def test_a_run_draws_the_middle_maps_and_figures_those_of_every_snapshot(run):
    """Maps take longest to draw. Seen failing with the first snapshot's, and with all of them."""
    d = run.dataset.isel(snapshot=[0, 0, 0]).assign(snapshot_frame=("snapshot", [0, 1, 2]))

    def maps(every: bool) -> list[str]:
        names = [drawing.name for drawing in figures._all(d, None, every)]
        return [name for name in names if name.startswith("range_doppler")]

    numbers = d.frame.values[:3]
    assert maps(False) == [f"range_doppler_{numbers[1]:04d}"]
    assert maps(True) == [f"range_doppler_{number:04d}" for number in numbers]


def test_a_run_without_detections_maps_or_paths_still_makes_figures(tmp_path):
    bare = fake_run(detections=0)
    empty = bare.dataset.isel(snapshot=slice(0, 0), path=slice(0, 0))
    assert make_figures(type(bare)(empty, bare.summary, bare.scenario), tmp_path)


def test_range_doppler_marks_detections_and_truth_where_they_are(run):
    """Circle of U1 at the AT at its true range and velocity; the detections by kind. Seen to fail
    with axes exchanged and with an empty map."""
    ax = range_doppler(Figure().subplots(), run.dataset, 0, 0)
    lines = {line.get_label(): line for line in ax.get_lines()}
    truth = lines["UAV (truth)"]
    assert (
        truth.get_ydata()[0] == run.dataset.truth_range.values[2, 0, 2]
        and truth.get_xdata()[0] == run.dataset.truth_velocity.values[2, 0, 2]
    )
    assert {"target (1)", "specular (1)", "unexplained (1)"} <= set(lines)
    shown = np.asarray(ax.images[0].get_array())
    assert (
        np.unravel_index(shown.argmax(), shown.shape) == (17, 60)
        and shown.max() > 30
        and abs(np.median(shown)) < 1e-4
    )


def test_truth_beyond_the_unambiguous_velocity_is_drawn_where_it_folds_to(run):
    """U1 made faster by 1.25 spans shows a quarter of a span farther on. Seen to fail without the
    folding."""
    fast = run.dataset.copy(deep=True)
    axis = fast.map_velocity.values[0]
    span = 120 * (axis[1] - axis[0])
    fast.truth_velocity.values[2, 0, 2] = 1.25 * span + 0.1234
    ax = range_doppler(Figure().subplots(), fast, 0, 0)
    truth = next(line for line in ax.get_lines() if line.get_label() == "UAV (truth)")
    assert abs(truth.get_xdata()[0] - (0.25 * span + 0.1234)) < 1e-9


def test_a_terminal_without_the_data_shows_no_map_and_says_so(run):
    """A scale of a tenth of a decibel about nothing was what it showed before."""
    blank = run.dataset.copy(deep=True)
    blank.map_power.values[0, 1] = 0.0
    ax = range_doppler(Figure().subplots(), blank, 0, 1)
    assert (
        "no map" in " ".join(text.get_text() for text in ax.texts)
        and ax.images[0].get_clim()[1] >= 5
    )
    assert not range_doppler(Figure().subplots(), run.dataset, 0, 1).texts


def test_tracks_are_drawn_in_people_units_and_shadow_is_shaded(run):
    ax = over_time(Figure().subplots(), run.dataset, 1, "azimuth")
    line = next(line for line in ax.get_lines() if line.get_label() == "U1")
    assert np.allclose(
        line.get_ydata(), np.rad2deg(run.dataset.truth_azimuth.values[:, 1, 2]), rtol=1e-12
    )
    assert len(ax.patches) == 1


def test_error_cdf_ends_at_one_and_keeps_targets_and_terminals_apart(run):
    """PT1 detects U1 in 6 frames and the transmitter, which reports its position, in 7. Planted
    bugs: all UAVs in both; the observer itself counted."""
    for terminals, n in ((False, 6), (True, 7)):
        ax = error_cdf(Figure().subplots(), run.dataset, "range", terminals)
        raw = next(line for line in ax.get_lines() if line.get_label().startswith("PT1 detected"))
        assert raw.get_label().endswith(f"(n = {n})") and len(raw.get_ydata()) == n
        assert raw.get_ydata()[-1] == 1 and np.allclose(raw.get_xdata(), 0.0637, rtol=1e-9)


def test_every_kind_has_its_own_colour():
    assert set(KIND_COLOURS) == set(KINDS) and len(set(KIND_COLOURS.values())) == len(KINDS)


def test_scene_shows_every_uav(run):
    ax = scene_map(Figure().subplots(), run.dataset)
    assert {"AT", "PT1", "U1"} <= {t.get_text() for t in ax.texts}


def test_report_is_one_self_contained_page(run, written):
    """No address of any kind is followed. Seen to fail with names in place of the pictures'
    data."""
    from isac_rt.views.report import write_report

    folder, files = written
    page = write_report(run, folder, files).read_text()
    for reference in re.findall(r"(?:src|href|url)\s*[=(]\s*[\"']?([^\"')>\s]+)", page):
        assert reference.startswith(("data:", "#")), reference[:60]
    assert "<link" not in page and "@import" not in page
    embedded = [
        base64.b64decode(data) for data in re.findall(r"data:image/png;base64,([^\"]+)", page)
    ]
    assert sorted(embedded) == sorted(file.read_bytes() for file in files)
    for text in (
        "AT to PT1",
        "passive",
        "line of sight",
        "prefers-color-scheme",
        "viewport",
        "\u2013",
    ):
        assert text in page
    text = re.sub(r"base64,[^\"]+", "", page)
    assert not re.search(r"\b(nan|None|inf)\b", re.sub(r"(?s)<pre>.*</pre>", "", text))


@pytest.mark.parametrize("form", ["svg", "pdf"])
def test_figures_for_a_paper(run, tmp_path, form, capsys, monkeypatch):
    """Both columns or one, fonts of print, the same bytes twice: nothing of the clock is in them.
    Planted bug: a PDF's date left in."""
    save(run, tmp_path)
    drawings = [d for d in figures._all(run.dataset, None, True) if d.name == "errors"]
    monkeypatch.setattr(figures, "_all", lambda *_: drawings)
    made = []
    for where in ("a", "b"):
        command = ["figures", str(tmp_path), "--as", form, "--style", "column"]
        assert main([*command, "--out", str(tmp_path / where)]) == 0
        made.append({file.name: file.read_bytes() for file in (tmp_path / where).iterdir()})
    assert made[0] == made[1] and f"errors.{form}" in made[0]
    if form == "svg":
        assert b'width="252pt"' in made[0]["errors.svg"]  # 3.5 inches
    assert main(["figures", str(tmp_path), "--style", "poster"]) == 2
    assert "choose from screen, wide, column" in capsys.readouterr().err


def test_a_map_shows_a_target_beside_a_line_of_sight_and_is_cut_to_what_is_there(run):
    """A path of 60 dB saturates and leaves the colours of one of 15 dB as they were; a cell far out
    widens the map. Planted bugs: the scale of the strongest cell; limits of the whole map; false
    alarms kept in the map."""
    d = run.dataset.copy(deep=True)
    at = list(d.observer.values).index("AT")
    before = range_doppler(Figure().subplots(), d, 0, at).images[0].get_clim()
    (_, high), _ = map_limits(d, 0, at)
    velocity = d.map_velocity.values[at]
    assert high < np.nanmax(velocity) and before == (0, 35)
    power = d.map_power.values[0, at]
    power[3, np.isfinite(velocity).sum() - 1] = 1e6 * np.nanmedian(power)
    assert range_doppler(Figure().subplots(), d, 0, at).images[0].get_clim() == before
    (_, high), (low, _) = map_limits(d, 0, at)
    assert high == np.nanmax(velocity) and low < d.map_range.values[at, 3]
    power[:] = 0
    assert map_limits(d, 0, at)[0] == (np.nanmin(velocity), high)


def drawn_texts(figure: Figure) -> list[tuple[str, Bbox]]:
    """Every text that is drawn, and its box [pixels]."""
    drawn, draw = {}, Text.draw

    def record(text, renderer, *rest, **more):
        if (
            text.get_text() and text.get_visible()
        ):  # the layout draws before, elsewhere: the last time counts
            drawn[id(text)] = text.get_text(), text.get_window_extent(renderer)
        return draw(text, renderer, *rest, **more)

    with pytest.MonkeyPatch.context() as patched:
        patched.setattr(Text, "draw", record)
        figure.savefig(io.BytesIO(), format="png", dpi=figure.dpi)
    return list(drawn.values())


def complaints(figure: Figure) -> list[str]:
    """Texts that are cut off, and those that cover another by more than two pixels."""
    whole, out = figure.bbox.padded(1.0), []
    boxes = [(text, box.padded(-1.0)) for text, box in drawn_texts(figure)]
    for k, (text, box) in enumerate(boxes):
        if not all(whole.contains(*corner) for corner in box.corners()):
            out.append(f"{text!r} is cut off")
        out += [f"{text!r} covers {other!r}" for other, seen in boxes[:k] if box.overlaps(seen)]
    return out


@pytest.mark.parametrize("style", ["wide", "column"])
def test_no_text_covers_another_or_is_cut_off(run, style):
    """Planted bugs: a title of a hundred letters; titles over a legend; an axis's label longer than
    the axis."""
    with matplotlib.rc_context(STYLE | {**figures.STYLES[style].settings}):
        for drawing in figures._all(run.dataset, None, False):
            figure = figures._figure(drawing, figures.STYLES[style])
            assert not complaints(figure), drawing.name


def test_names_of_a_dense_swarm_cover_each_other_nowhere():
    """Nine UAVs within a few metres of each other, and one far off. Planted bug: every name to the
    right of its marker."""
    rng = np.random.default_rng(5)
    place = np.vstack([rng.normal(0, 6, (9, 3)), [[90.0, 70.0, 9.0]]])
    names = ["AT", *(f"PT{k}" for k in range(1, 4)), *(f"U{k}" for k in range(1, 7))]
    dataset = xr.Dataset(
        {
            "uav_position": (("frame", "uav", "axis"), place[None]),
            "uav_attitude": (
                ("frame", "uav", "axis", "body_axis"),
                np.tile(np.eye(3), (1, 10, 1, 1)),
            ),
            "role": ("uav", ["active", *["passive"] * 3, *["target"] * 6]),
        },
        {"uav": names},
    )
    for style in figures.STYLES.values():
        with matplotlib.rc_context(STYLE | {**style.settings}):
            drawing = figures.Drawing("scene", [partial(scene_map, dataset=dataset)], 6.4)
            figure = figures._figure(drawing, style)
            assert not complaints(figure)
            assert {text for text, _ in drawn_texts(figure)} >= set(names)


@pytest.mark.slow
def test_files_figures_and_report_load_no_dask(tmp_path):
    """Arrays of arrays in blocks take longer to load than three figures to draw. Planted bugs: a
    variable made with a look at its type; names of places left to the dataset to index; an observer
    taken by its own indexing; a file written by xarray."""
    code = (
        "import sys\nfrom fake_run import fake_run\n"
        "from isac_rt.results.files import save\n"
        "from isac_rt.views.figures import make_figures\n"
        "from isac_rt.views.report import write_report\n"
        "results, out = fake_run(), sys.argv[1]\n"
        "save(results, out)\n"
        "write_report(results, out, make_figures(results, out))\n"
        "print([name for name in sys.modules if name in ('dask', 'dask.array')])"
    )
    done = subprocess.run(
        [sys.executable, "-c", code, str(tmp_path)],
        capture_output=True,
        text=True,
        check=True,
        env=os.environ | {"PYTHONPATH": os.pathsep.join(sys.path)},
    )
    assert done.stdout.split() == ["[]"]
