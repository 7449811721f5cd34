"""The fall-back from the pseudo-random to the conventional schedule in whole runs, and what each
receiver's advice does."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from isac_rt.frame.schedule import conventional_schedule, pseudo_random_schedule
from isac_rt.frame.settings import Array, Modulation, Noise
from isac_rt.frame.waveform import Waveform
from isac_rt.propagation.settings import Propagation
from isac_rt.receive.types import Reception, no_detections
from isac_rt.scenario.doubts import doubts
from isac_rt.scenario.radio import Radio
from isac_rt.scenario.swarm import Uav
from isac_rt.scenario.tree import Scenario
from isac_rt.simulation import simulate
from isac_rt.simulation.fall_back import Schedules
from isac_rt.views.report import write_report

COUNT = 9


def swarm() -> dict[str, Uav]:
    """Bodies at one distance and of different speeds: one range row that holds more velocities than
    40 random chirps recover, and that drifts apart within 0.1 s. A passive terminal behind them."""
    out = {
        "A": Uav(role="active", position_m=(0, 0, 50)),
        "P": Uav(role="passive", position_m=(3.1, 27.4, 50), boresight=(0, -1, 0)),
    }
    for i, azimuth in enumerate(np.deg2rad(np.linspace(-50, 50, COUNT))):
        u = np.array([np.sin(azimuth), np.cos(azimuth), 0.0])
        speed = -4.5 + 9 * (4 * i % COUNT) / (COUNT - 1)
        place = 20.3 * u + [0, 0, 50]
        out[f"T{i}"] = Uav(
            role="target",
            position_m=tuple(place),
            velocity_mps=tuple(speed * u),
            rcs={"model": "constant"},
        )
    return out


SMALL_ARRAY = {"rx_x": 2, "rx_z": 2, "element_pattern": "isotropic", "element_gain_dbi": 0}


def scenario(**changes) -> Scenario:
    base = {
        "name": "dense",
        "seed": 4,
        "frames": 12,
        "frame_interval_s": 0.02,
        "radio": Radio(samples_per_chirp=256, groups=1),
        "array": Array(**SMALL_ARRAY, fall_back=True),
        "noise": Noise(model="snr", snr_db=-5.0),
        "propagation": Propagation(leakage={"enabled": False}),
        "modulation": Modulation(acquisition_frames=2, pilot_every_frames=None),
    }
    return Scenario(**base | changes, swarm=swarm())


@pytest.fixture(scope="module")
def run():
    return simulate.run(scenario(), snapshots=0)


def test_the_transmitter_follows_the_advice_one_frame_later(run):
    """Dense at the start, sparse once the bodies have drifted apart. Planted bugs: the advice acts
    on the frame that it came from; no way back from the conventional schedule."""
    d = run.dataset
    sparse, fell_back = d.sparse.sel(observer="A").values, d.fell_back.sel(observer="A").values
    assert sparse[0] == 0 and sparse[-1] == 1
    advised = (d.sparse.sel(observer="A").values == 0) | (d.sparse.sel(observer="P").values == 0)
    # every receiver judges every frame here, so that the last word is that of the frame before
    assert (d.sparse.values[2:] >= 0).all()
    assert not fell_back[0] and fell_back[3:].tolist() == advised[2:-1].tolist()
    assert fell_back[1] and not fell_back[-1]
    row = run.summary["sparsity"]["A->A"]
    assert row == {
        "tested": 12,
        "dense": int((sparse == 0).sum()),
        "fell_back": int(fell_back.sum()),
    }


def test_data_are_read_by_either_schedule(run):
    """Planted bug: the payload's phases laid out by the usual schedule."""
    block = run.summary["links"]["A->P"]
    assert block["ser_delay"] == block["ser_dpsk"] == block["erased"] == 0 and block["bits"] > 0


def test_without_the_key_the_advice_is_recorded_and_nothing_changes(run, tmp_path):
    still = simulate.run(scenario(frames=3, array=Array(**SMALL_ARRAY)), snapshots=0)
    assert (
        not still.dataset.fell_back.any() and still.dataset.sparse.sel(observer="A").values[0] == 0
    )
    row = still.summary["sparsity"]["A->A"]
    assert row["tested"] == 3 and row["dense"] >= 1 and row["fell_back"] == 0
    assert "dense" in write_report(run, tmp_path, []).read_text()


def test_one_dense_advice_is_enough_and_the_last_word_counts(run):
    """Planted bug: the first advice of a link is kept."""
    usual = pseudo_random_schedule(1, 120, 3, np.random.default_rng(1))
    s, other = Schedules(usual, 3), conventional_schedule(1, 120, 3)

    def said(sparse):
        return replace(empty(), sparse=sparse)

    assert s.of("A") is usual
    s.take_advice({("A", "A"): said(True), ("A", "P"): said(False), ("B", "B"): said(True)})
    assert np.array_equal(s.of("A"), other) and s.of("B") is usual
    s.take_advice({("A", "P"): said(None)})
    assert np.array_equal(s.of("A"), other)
    s.take_advice({("A", "P"): said(True)})
    assert s.of("A") is usual


def empty():
    return Reception.undecoded(Waveform(), no_detections())


def test_a_fall_back_that_can_never_act_is_doubted():
    """With all groups at hand the union needs no sparsity. Planted bug: streams forgotten."""

    def doubted(s: Scenario) -> bool:
        return any("never acts" in p.text for p in doubts(s))

    assert not doubted(scenario())
    three = Radio(samples_per_chirp=256)
    assert doubted(scenario(radio=three))
    assert not doubted(scenario(radio=three, modulation=Modulation(streams={"P": (0,)})))
    assert doubted(scenario(array=Array(fall_back=True, schedule="conventional")))
