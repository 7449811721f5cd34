"""A scenario whose terminals know their boards: a calibration found in one run serves another."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import isac_rt as irt
from isac_rt.document import ScenarioError
from isac_rt.extensions.hardware.calibrate import save_calibration
from isac_rt.extensions.hardware.types import Capture, CaptureError
from isac_rt.results.provenance import path_content, run_content
from isac_rt.scenario.file import to_yaml

SCENE = """
name: bench
frames: 1
radio: {mode: fmcw, groups: 1, chirps_per_frame: 24, samples_per_chirp: 128, scheme: tdm}
array: {tx_x: 2, tx_z: 2, rx_x: 3, rx_z: 2, element_pattern: isotropic, element_gain_dbi: 0,
  schedule: conventional}
propagation: {leakage: {enabled: false}}
noise: {model: snr, snr_db: 50}
swarm:
  A: {role: active, position_m: [0, 0, 50], boresight: [0, 1, 0]}
  B: {role: target, position_m: [0, 9, 50], rcs: {model: constant, value_dbsm: 0}}
"""
ERRORS = (
    "radio.front_end={transmit: {gain_std_db: 1, phase_std_deg: 30, delay_std_ps: 20}, "
    "receive: {gain_std_db: 1, phase_std_deg: 30, delay_std_ps: 20}}"
)


@pytest.fixture
def scene(tmp_path):
    (tmp_path / "s.yaml").write_text(SCENE)
    return tmp_path / "s.yaml"


def heard(scene, *changes):
    setup = irt.prepare(irt.load(scene, changes))
    return setup, setup.frame(0).received(("A", "A"))


def apart_db(a, b):
    """Power of a - c b over that of a, c the best factor of every sample of a chirp, for the delay
    that all channels share is no error between them [dB]."""
    level = (b.conj() * a).sum(axis=(0, 1, 2)) / (np.abs(b) ** 2).sum(axis=(0, 1, 2))
    return 20 * np.log10(np.linalg.norm(a - level * b) / np.linalg.norm(a))


def test_a_board_that_was_calibrated_is_an_ideal_one(scene, tmp_path):
    """1 dB, 30 degrees and 20 ps of error a channel, found from a reflector 9 m ahead: what is left
    of them is 40 dB down, where without the calibration it is over -10 dB.

    Planted bug: `calibrated` multiplies."""
    _, ideal = heard(scene)
    setup, raw = heard(scene, ERRORS)
    found = irt.calibrate(Capture(cube=raw, antennas=setup.antennas))
    save_calibration(found, tmp_path / "board.cal")
    _, clean = heard(scene, ERRORS, "radio.calibration=board.cal")
    assert apart_db(ideal.samples, raw.samples) > -10
    assert apart_db(ideal.samples, clean.samples) < -40
    loaded = irt.load(scene, ["radio.calibration=board.cal"])
    assert "calibration: ../board.cal" in to_yaml(loaded, tmp_path / "out")
    assert path_content(loaded.model_dump(mode="json"), "x") == path_content(
        irt.load(scene).model_dump(mode="json"), "x"
    )
    before = run_content(loaded, 1)
    save_calibration(replace(found, range_m=3.0), tmp_path / "board.cal")
    assert run_content(loaded, 1) != before


def test_files_that_are_no_calibration_are_refused(scene, tmp_path):
    with pytest.raises(ScenarioError, match=r"radio\.calibration=no\.cal: no such file"):
        irt.load(scene, ["radio.calibration=no.cal"])
    (tmp_path / "bent.cal").write_text("no")
    with pytest.raises(CaptureError, match="is no calibration"):
        heard(scene, "radio.calibration=bent.cal")
    _, raw = heard(scene)
    save_calibration(irt.calibrate(Capture(cube=raw)), tmp_path / "board.cal")
    with pytest.raises(
        CaptureError, match="4 receivers and 3 transmitters, the samples of 5 and 3"
    ):
        heard(scene, "radio.calibration=board.cal", "array.rx_x=4")
