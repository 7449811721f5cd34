"""The experiments: files, names, refusals, and closed forms behind each."""

from __future__ import annotations

import json

import pandas as pd
import pytest
from matplotlib.image import imread

from isac_rt import experiments
from isac_rt.cli import main
from isac_rt.experiments import fig13
from isac_rt.experiments.outcome import Outcome, Verdict, blank, proportion, style, write
from isac_rt.results import ResultsError


def silent(done, total):
    assert 0 <= done <= total


def outcome(tables=1):
    with style():
        figure, axes = blank()
        axes[0, 0].plot([1, 3], [2, 5])
    frames = {f"t{i}": pd.DataFrame({"snr_db": [1.5, 2.25], "ser": [0.1, i]}) for i in range(tables)}
    return Outcome("fig99", "A figure", frames, figure, (Verdict("it rises", "holds", "3 [2, 4]"),), {"seed": 7, "trials": 12})


def test_write_makes_table_picture_and_verdicts(tmp_path):
    """Planted bug: the verdicts as tuples instead of dictionaries."""
    files = write(outcome(), tmp_path)
    assert [f.name for f in files] == ["fig99.csv", "fig99.png", "fig99.json"]
    assert {f.name for f in tmp_path.iterdir()} == {f.name for f in files}
    assert pd.read_csv(files[0]).ser.tolist() == [0.1, 0.0]
    assert imread(files[1]).std() > 0
    about = json.loads(files[2].read_text())
    assert about["verdicts"] == [{"claim": "it rises", "verdict": "holds", "finding": "3 [2, 4]"}]
    assert about["settings"] == {"seed": 7, "trials": 12} and "numpy" in about["versions"] and about["files"] == ["fig99.csv", "fig99.png"]


def test_several_tables_get_names(tmp_path):
    assert [f.name for f in write(outcome(2), tmp_path)][:2] == ["fig99_t0.csv", "fig99_t1.csv"]


def test_an_unwritable_place_is_refused(tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(ResultsError, match="cannot write"):
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
    [("51.2 us", 461.4, 596.7), ("25.6 us, all times halved", 830, 1101), ("25.6 us, T_d kept", 686, 910)],
)
def test_rates_are_the_formula_by_hand(reading, low, high):
    """M (P b + (P - L) log2 D) / (P slot) with the slot in 60ths of 51.2 us: 76, 38, 30 + 2 + 2 x 3 x 2 + 2 of them.

    Planted bug: 9 bits instead of 8 for 512 samples."""
    unit = 51.2e-6 / 60
    slot, bits = {"51.2 us": (76, 9), "25.6 us, all times halved": (38, 8), "25.6 us, T_d kept": (30 + 4 + 12, 8)}[reading]
    for order, k, printed in ((2, 1, low), (16, 4, high)):
        by_hand = 3 * (120 * bits + 117 * k) / (120 * slot * unit) / 1e3
        assert fig13.rate(3, order, reading) == pytest.approx(by_hand, rel=1e-12)
        assert by_hand == pytest.approx(printed, rel=1e-3)  # the digits of the notes


def test_fig13_verdicts():
    judged = [v.verdict for v in fig13.run(True, 1, silent).verdicts]
    assert judged == ["does not hold", "holds"]
