"""The experiments: files, names, refusals, and closed forms behind each."""

from __future__ import annotations

import json

import numpy as np
import pandas as pd
import pytest
import xarray as xr
from matplotlib.image import imread

import reproduce as experiments
from isac_rt.cli.cli import main
from isac_rt.frame.payload import random_payload
from isac_rt.frame.schedule import conventional_schedule
from isac_rt.frame.waveform import Waveform, waveform_of
from isac_rt.results.metrics import truth_of
from isac_rt.simulation.setup import swarm_of
from isac_rt.storage import StorageError
from reproduce import fig1, fig5, fig13, flight, onepath, table1, table2, tracks
from reproduce.outcome import Outcome, Verdict, blank, proportion, style, write


def silent(done, total):
    assert 0 <= done <= total


def outcome(tables=1):
    with style():
        figure, axes = blank()
        axes[0, 0].plot([1, 3], [2, 5])
    frames = {
        f"t{i}": pd.DataFrame({"snr_db": [1.5, 2.25], "ser": [0.1, i]}) for i in range(tables)
    }
    return Outcome(
        "fig99",
        "A figure",
        frames,
        figure,
        (Verdict("it rises", "holds", "3 [2, 4]"),),
        {"seed": 7, "trials": 12},
    )


def test_write_makes_table_picture_and_verdicts(tmp_path):
    """Planted bug: the verdicts as tuples instead of dictionaries."""
    files = write(outcome(), tmp_path)
    assert [f.name for f in files] == ["fig99.csv", "fig99.png", "fig99.json"]
    assert {f.name for f in tmp_path.iterdir()} == {f.name for f in files}
    assert pd.read_csv(files[0]).ser.tolist() == [0.1, 0.0]
    assert imread(files[1]).std() > 0
    about = json.loads(files[2].read_text())
    assert about["verdicts"] == [{"claim": "it rises", "verdict": "holds", "finding": "3 [2, 4]"}]
    assert (
        about["settings"] == {"seed": 7, "trials": 12}
        and "numpy" in about["versions"]
        and about["files"] == ["fig99.csv", "fig99.png"]
    )


def test_several_tables_get_names(tmp_path):
    assert [f.name for f in write(outcome(2), tmp_path)][:2] == ["fig99_t0.csv", "fig99_t1.csv"]


def test_an_unwritable_place_is_refused(tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(StorageError, match="cannot write"):
        write(outcome(), tmp_path / "file")


def test_proportion_is_clopper_pearson():
    """The interval of 0 in n ends at 1 - 0.025^(1/n), that of n in n begins at 0.025^(1/n)."""
    n = 37
    assert proportion(0, n) == f"0 [0, {1 - 0.025 ** (1 / n):.4g}] (0 of {n})"
    assert proportion(n, n) == f"1 [{0.025 ** (1 / n):.4g}, 1] ({n} of {n})"


def test_every_module_there_is_can_be_run():
    for name in experiments.names():
        assert callable(experiments.experiment(name)), name
    with pytest.raises(KeyError):
        experiments.experiment("fig2")


def test_reproduce_lists_and_refuses(capsys):
    assert main(["reproduce"]) == 0
    assert "fig13" in capsys.readouterr().out
    assert main(["reproduce", "fig13", "fig77"]) == 2
    said = capsys.readouterr().err
    assert "fig77" in said and "fig13" in said and "Traceback" not in said


def test_reproduce_writes_and_prints_verdicts(tmp_path, capsys):
    assert main(["reproduce", "fig13", "--quick", "--out", str(tmp_path / "o"), "--seed", "5"]) == 0
    assert {f.name for f in (tmp_path / "o").iterdir()} == {"fig13.csv", "fig13.png", "fig13.json"}
    assert "does not hold" in capsys.readouterr().out
    assert json.loads((tmp_path / "o" / "fig13.json").read_text())["settings"]["seed"] == 5


@pytest.mark.parametrize(
    ("reading", "low", "high"),
    [
        ("51.2 us", 461.4, 596.7),
        ("25.6 us, all times halved", 830, 1101),
        ("25.6 us, T_d kept", 686, 910),
    ],
)
def test_rates_are_the_formula_by_hand(reading, low, high):
    """M (P b + (P - L) log2 D) / (P slot) with the slot in 60ths of 51.2 us: 76, 38, 30 + 2 + 2 x 3
    x 2 + 2 of them.

    Planted bug: 9 bits instead of 8 for 512 samples."""
    unit = 51.2e-6 / 60
    slot, bits = {
        "51.2 us": (76, 9),
        "25.6 us, all times halved": (38, 8),
        "25.6 us, T_d kept": (30 + 4 + 12, 8),
    }[reading]
    for order, k, printed in ((2, 1, low), (16, 4, high)):
        by_hand = 3 * (120 * bits + 117 * k) / (120 * slot * unit) / 1e3
        assert fig13.rate(3, order, reading) == pytest.approx(by_hand, rel=1e-12)
        assert by_hand == pytest.approx(printed, rel=1e-3)  # the digits of the notes


def test_fig13_verdicts():
    judged = [v.verdict for v in fig13.run(True, 1, silent).verdicts]
    assert judged == ["does not hold", "holds"]


@pytest.mark.parametrize(
    ("terminal", "first", "second", "half"),
    [("AT", 247.571, 511.646, 127.911), ("PT", 495.141, 1023.292, 255.823)],
)
def test_table1_range_columns_contradict_each_other(terminal, first, second, half):
    """The three lengths as worked out by hand in the notes. Planted bug: T_d = f_s T / B."""
    rows = {r["quantity"]: r for r in table1.entries(Waveform(), terminal)}
    assert rows["range, first expression"]["paper"] == pytest.approx(first, rel=2e-6)
    assert rows["range, second expression"]["paper"] == pytest.approx(second, rel=2e-6)
    assert rows["range, first expression"]["ours"] == pytest.approx(half, rel=4e-6)


def test_table1_verdicts():
    judged = {v.claim: v.verdict for v in table1.run(True, 1, silent).verdicts}
    assert (
        judged["AT range resolution"] == "holds"
        and judged["PT velocity range"] == "holds under a condition"
    )
    assert {c for c, v in judged.items() if v == "does not hold"} == {
        f"{t} range, {n} expression" for t in ("AT", "PT") for n in ("first", "second")
    }


def test_table2_views_by_hand():
    """The frames worked out from straight lines and 60 degrees per axis. Planted bug: PT2 left to
    fly along -y.

    AT (0, 10 t), PT2 (4, -8 + 20 t): in view once 4 <= tan(60) (10 t - 8), counted at the middle of
    a frame."""
    scene = flight.scenario("consistent")
    seen = flight.views(scene)
    tan, frame = np.tan(np.pi / 3), 7.7824e-3
    enters = (8 + 4 / tan) / 10 / frame - 0.5
    assert flight.span(seen["AT", "PT2"]) == f"{int(np.ceil(enters))} to 499"
    # PT1 (-8, 8 + 15 t) faces -y and PT2 (4, -8 + 20 t) must be 12/tan behind it
    leaves = (16 - 12 / tan) / 5 / frame - 0.5
    assert flight.span(seen["PT1", "PT2"]) == f"0 to {int(np.floor(leaves))}"
    assert (
        flight.span(np.zeros(5, bool)) == "never"
        and flight.span(np.array([1, 0, 1, 1], bool)) == "0 to 0, 2 to 3"
    )


def test_table2_verdicts():
    judged = [v.verdict for v in table2.run(True, 1, silent).verdicts]
    mended = "holds under a condition"
    assert judged == ["holds", mended, mended, "does not hold", "does not hold", mended]


def test_fig5_ambiguities_are_the_pulse_rates():
    """One antenna's pulses come every L_tx slots in turn: c/(4 L_tx T- f) is the limit, and without
    the order c/(4 T- f).

    Planted bug: the second answer searched from the first bin instead of from the peak."""
    w = Waveform()
    limit = 299_792_458 / (4 * w.slot_duration * w.effective_carrier)
    chosen = fig5.schedules(11)
    (a,) = fig5.spectra("a", chosen["a"])
    alone, united = fig5.spectra("d", chosen["d"])
    assert a.unambiguous == pytest.approx(limit / 3, rel=1e-9)
    assert alone.unambiguous == pytest.approx(
        limit, rel=1e-9
    ) and united.unambiguous == pytest.approx(limit, rel=1e-9)
    # 40 of 120 pulses, mean over 9 channels: sidelobes stand near 1/40 (-16 dB); the full sampling
    # has only those of its window
    assert -20 < alone.sidelobe_db < -6 and united.sidelobe_db < -40


def test_filter_verdict_needs_every_decile():
    """Made-up errors: halved by the filter in range, doubled in velocity."""
    rng = np.random.default_rng(5)
    e = rng.standard_normal((60, 1))
    columns = {f"truth_{q}": (("frame", "uav"), np.zeros((60, 1))) for q in tracks.UNITS}
    columns |= {f"detected_{q}": (("frame", "uav"), e) for q in tracks.UNITS}
    columns |= {
        f"tracked_{q}": (("frame", "uav"), e * f)
        for q, f in zip(tracks.UNITS, (0.5, 2.0, 0.5), strict=True)
    }
    good = {q: (np.abs(e[:, 0]), np.abs(e[:, 0]) / 3) for q in tracks.UNITS}
    runs = [xr.Dataset(columns, {"uav": ["AT"]})]
    v = tracks.filter_verdict(runs, ("AT",), "PT1", good)
    assert (
        v.verdict == "holds under a condition"
        and "left at every decile: range, azimuth (" in v.finding
        and "(60 of 60)" in v.finding
    )
    worse = {q: pair[::-1] for q, pair in good.items()}
    assert tracks.left_of(worse) == [] and tracks.left_of(good) == list(tracks.UNITS)


def test_the_papers_grids_have_uniform_errors_and_the_filter_lowers_them():
    """True values of the flight itself as detections: rounding to cells leaves errors of RMS
    cell/sqrt(12) (uniform over many cells; 20 % for 100 frames), and an EKF that knows that must do
    better. Planted bug: the detections left unrounded."""
    scene = flight.scenario("consistent")
    w, swarm = waveform_of(scene.radio, scene.array), swarm_of(scene)
    frames, every = 100, 5
    truth = []
    for k in range(frames):
        poses = swarm.poses((k * every + 0.5) * w.frame_duration)
        t = truth_of(poses["PT1"], poses["AT"])
        truth.append([t.range, t.velocity, t.azimuth])
    columns = {
        f"{group}_{q}": (("frame", "uav"), np.array(truth)[:, i : i + 1])
        for i, q in enumerate(tracks.UNITS)
        for group in ("truth", "detected")
    }
    pairs = tracks.on_grid([xr.Dataset(columns, {"uav": ["AT"]})], ("AT",), every, "PT1")
    cells = {
        "range": w.range_cell(1),
        "velocity": w.velocity_cell(1),
        "azimuth": tracks.ANGLE_STEP_DEG,
    }
    for quantity, (raw, fused) in pairs.items():
        assert raw.size == frames - tracks.SETTLED
        assert raw.max() <= cells[quantity] / 2 * (1 + 1e-9)
        rms = [np.sqrt(np.mean(e**2)) for e in (raw, fused)]
        assert rms[0] == pytest.approx(cells[quantity] / np.sqrt(12), rel=0.25)
        # the velocity changes by three cells in all, so that its rounding errors hardly average out
        assert rms[1] < (0.9 if quantity == "velocity" else 0.6) * rms[0], quantity


def test_fig1_beats_are_symbol_plus_path():
    """The chirps of the paper's equation, mixed sample by sample, against the formula of the cell:
    alpha T (tau_D + tau) plus the Doppler of the carrier over the window. Planted bug: the phase of
    the carrier during tau_D left out, which turns whole chirps."""
    w = Waveform(num_groups=1, num_chirps=12)
    payload = random_payload(w, conventional_schedule(1, 12, 3), 8, np.random.default_rng(4))
    model = np.stack([fig1.mixed(w, payload, p, w.fast_time) for p in range(12)])
    assert np.abs(np.abs(model) - 1).max() < 1e-9  # rounding
    assert (
        fig1.beat_error(w, payload, model) < 0.05
    )  # half a step of 1/16, and what the beat bends within a chirp
    cube = onepath.frame(
        w,
        conventional_schedule(1, 12, 3),
        payload,
        onepath.antennas(w, 1),
        delay=2 * fig1.RANGE / 299_792_458,
        rate=2 * fig1.VELOCITY / 299_792_458,
    )
    assert np.abs(cube.samples[0, 0] - model).max() < 1e-5  # complex64 and the direct method


def test_fig1_verdicts():
    outcome = fig1.run(True, 3, silent)
    assert [v.verdict for v in outcome.verdicts] == ["holds", "holds", "holds under a condition"]
    assert outcome.figure is not None and set(outcome.tables["fig1"].chirp) == {3, 4, 5}
