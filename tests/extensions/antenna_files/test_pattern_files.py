"""Patterns from cuts, Planet's MSI and HFSS's tables, against the formulas they are made of."""

from __future__ import annotations

import numpy as np
import pytest

from isac_rt.document import ScenarioError
from isac_rt.frame.antennas import antennas_of
from isac_rt.frame.waveform import waveform_of
from isac_rt.scenario.file import load

SCENE = """
frames: 4
radio: {mode: fmcw}
array: {element_pattern: table, pattern_file: FILE}
swarm:
  R: {role: active, position_m: [0, 0, 10]}
  T: {role: target, position_m: [1, 20, 12], velocity_mps: [3, 4, 0]}
"""
GAIN_DBI = 7.5
RIGHT, UP = 10.0, -8.0
"""Where the separable beam looks: azimuth and elevation [degrees]."""
WAYS = np.random.default_rng(3).uniform([-60, -50], [60, 50], (40, 2))
"""Generic azimuths and elevations [degrees]."""


def read(folder, name, text, *overrides):
    (folder / name).write_text(text)
    (folder / "scene.yaml").write_text(SCENE.replace("FILE", name))
    return load(folder / "scene.yaml", overrides)


def gain_db(scenario, ways):
    """Gain [dBi] towards azimuths and elevations (N, 2) [degrees]."""
    antennas = antennas_of(scenario.array, waveform_of(scenario.radio, scenario.array))
    return 10 * np.log10(antennas.element_gain(directions(ways)))


def directions(ways):
    a, e = np.radians(ways).T
    return np.stack([np.cos(e) * np.sin(a), np.cos(e) * np.cos(a), np.sin(e)], axis=1)


def across(angle):
    """cos^3 about RIGHT [dB], down to -40 dB."""
    return np.maximum(30 * np.log10(np.maximum(np.cos(np.radians(angle - RIGHT)), 1e-9)), -40)


def along(angle):
    """cos^5 about UP [dB], down to -40 dB."""
    return np.maximum(50 * np.log10(np.maximum(np.cos(np.radians(angle - UP)), 1e-9)), -40)


@pytest.mark.parametrize("unit", ["dbi", "db"])
def test_two_cuts_add_up(tmp_path, unit):
    """cos^3 by cos^5 of a beam aside. In dBi the file states the gain, in dB the scenario. Planted
    bug: the gain where the cuts cross is not taken off the sum; elevation for azimuth."""
    angles = np.arange(-90, 91)
    top = GAIN_DBI if unit == "dbi" else 0.0
    cuts = top + across(angles) + along(0), top + across(0) + along(angles)
    rows = "\n".join(f"{a},{e:.6f},{g:.6f}" for a, g, e in zip(angles, *cuts, strict=True))
    header = f"angle_deg,elevation_{unit},azimuth_{unit}\n"
    stated = [f"array.element_gain_dbi={GAIN_DBI}"] if unit == "db" else []
    scenario = read(tmp_path, "cuts.csv", header + rows, *stated)
    truth = GAIN_DBI + across(WAYS[:, 0]) + along(WAYS[:, 1])
    assert gain_db(scenario, WAYS) == pytest.approx(truth, abs=0.03)


def planet(gain, angles=range(360)):
    """Text of an MSI file of the separable beam."""
    lines = ["NAME patch 7", "FREQUENCY 77000", f"GAIN {gain}", "TILT ELECTRICAL"]
    for key, cut in (("HORIZONTAL", lambda a: across(a)), ("VERTICAL", lambda a: along(-a))):
        lines += [f"{key} {len(angles)}", *(f"{a:.1f}\t{-cut(a):.5f}" for a in angles)]
    return "\n".join(lines) + "\n"


@pytest.mark.parametrize("gain", ["7.5 dBi", "7.5dBi", "5.35 dBd", "5.35"])
def test_planets_msi(tmp_path, gain):
    """Attenuations of a beam to the right and down below a gain over a dipole or over isotropic.
    Planted bug: the vertical cut taken upwards; dBd taken for dBi."""
    scenario = read(tmp_path, "patch.msi", planet(gain))
    assert scenario.array.element_gain_dbi == pytest.approx(GAIN_DBI)
    truth = GAIN_DBI + across(WAYS[:, 0]) + along(WAYS[:, 1])
    assert gain_db(scenario, WAYS) == pytest.approx(truth, abs=0.03)
    behind = np.array([[150.0, 20.0], [-179.0, -30.0]])
    truth = GAIN_DBI - 40 + along(behind[:, 1])
    assert gain_db(scenario, behind) == pytest.approx(truth, abs=0.03)


AXIS = np.array([0.3, 0.9, -0.2]) / np.linalg.norm([0.3, 0.9, -0.2])


def lobe(ways):
    """((1 + cos)/2)^4 about AXIS [dBi]: smooth all round but for its null behind."""
    return GAIN_DBI + 40 * np.log10((1 + ways @ AXIS) / 2)


def hfss(unit="deg", column="dB(GainTotal) []", theta=None, phi=None, step=2.0):
    """Text of HFSS's table of the lobe; its Z looks ahead, its Y up, its X to the left."""
    theta = np.arange(0, 180 + step, step) if theta is None else theta
    phi = np.arange(0, 360 + step, step) if phi is None else phi
    t, p = (a.ravel() for a in np.meshgrid(theta, phi))
    x, y, z = (
        np.sin(np.radians(t)) * np.cos(np.radians(p)),
        np.sin(np.radians(t)) * np.sin(np.radians(p)),
        np.cos(np.radians(t)),
    )
    values = lobe(np.stack([-x, z, y], axis=1))
    if unit == "rad":
        t, p = np.radians(t), np.radians(p)
    rows = (f"77,{a:.9g},{b:.9g},{v:.6f}" for a, b, v in zip(p, t, values, strict=True))
    return f'"Freq [GHz]","Phi [{unit}]","Theta [{unit}]","{column}"\n' + "\n".join(rows)


def wide(theta, phi, name="dB(GainTotal) [] - Freq='77GHz' Phi='{}deg'"):
    """Text of a rectangular plot of HFSS: the lobe with a column for each Phi."""
    _, *rows = hfss(theta=theta, phi=phi).split("\n")
    gains = np.array([row.rsplit(",", 1)[1] for row in rows]).reshape(len(phi), len(theta))
    titles = ",".join(f'"{name.format(p)}"' for p in phi)
    lines = [f"{t},{','.join(row)}" for t, row in zip(theta, gains.T, strict=True)]
    return "\n".join([f'"Theta [deg]",{titles}', *lines])


@pytest.mark.parametrize("theta", [np.arange(0, 181, 2), np.arange(-180, 181, 2)])
def test_a_column_for_each_phi_is_the_same_table(tmp_path, theta):
    """Bugs: the cuts row by row; the file's second column as the whole pattern."""
    phi = np.arange(0, 360 if theta[0] == 0 else 180, 2)
    found = read(tmp_path, "a.csv", wide(theta, phi)).array
    rows = read(tmp_path, "b.csv", hfss(theta=theta, phi=phi)).array
    assert found.pattern == rows.pattern
    assert found.element_gain_dbi == rows.element_gain_dbi


@pytest.mark.parametrize(
    "stated",
    [
        {},
        {"unit": "rad", "column": "dB(RealizedGainTotal) []"},
        {"theta": np.arange(-180, 181, 2.0), "phi": np.arange(0, 180, 2.0)},
        {"phi": np.arange(-180, 181, 2.0)},
    ],
    ids=["degrees", "radians", "negative theta", "negative phi"],
)
def test_hfss_tables_turn_into_the_bodys_frame(tmp_path, stated, caplog):
    """A lobe about an axis of all three signs, in front and behind. Planted bug: X of HFSS taken to
    the right; Phi behind a negative Theta not turned by 180 degrees."""
    with caplog.at_level("INFO", "isac_rt.inputs"):
        scenario = read(tmp_path, "field.csv", hfss(**stated))
    ways = np.random.default_rng(4).uniform([-180, -80], [180, 80], (200, 2))
    ways = ways[directions(ways) @ AXIS > -0.7]
    assert gain_db(scenario, ways) == pytest.approx(lobe(directions(ways)), abs=0.05)
    assert "peak 7.5 dBi at azimuth 18, elevation -12 degrees" in caplog.text


def test_a_front_half_of_hfss_is_read(tmp_path):
    """Up to Theta 90. Planted bug: the grid held to reach 180."""
    scenario = read(tmp_path, "field.csv", hfss(theta=np.arange(0, 91, 2.0)))
    assert gain_db(scenario, WAYS) == pytest.approx(lobe(directions(WAYS)), abs=0.05)


CUTS = "angle_deg,azimuth_db,elevation_db\n"


@pytest.mark.parametrize(
    ("name", "text", "said"),
    [
        ("a.csv", CUTS + "-5,0,0\n5,0,0\n", "one gain at angle_deg 0"),
        ("a.csv", CUTS + "-5,0,0\n0,0,3\n", "one gain at angle_deg 0"),
        ("a.csv", CUTS + "-5,0,x\n0,0,3\n", "line 2: elevation_db = 'x'"),
        ("a.csv", "angle_deg,azimuth_db\n0,0\n", "no column elevation_db"),
        ("a.msi", planet("7 dBx"), "line 3: GAIN = '7DBX'"),
        ("a.msi", planet("7").replace("GAIN", "GAINS"), "needs GAIN, HORIZONTAL and VERTICAL"),
        (
            "a.msi",
            planet("7").replace("HORIZONTAL 360", "HORIZONTAL 361"),
            "line 5: HORIZONTAL 361",
        ),
        (
            "a.msi",
            planet("7").replace("VERTICAL 360\n0.0\t", "VERTICAL 360\n0.0\t-"),
            "line 367: an",
        ),
        ("a.csv", hfss().replace("Phi", "P"), "needs Theta, Phi and dB"),
        ("a.csv", hfss().replace("77", "76", 1), "several values; export one"),
        ("a.csv", hfss(phi=np.arange(0, 91, 2.0)), "no grid of Theta from 0 and of Phi"),
        ("a.csv", hfss(theta=np.arange(10, 91, 2.0)), "no grid of Theta from 0"),
        ("a.csv", wide(np.arange(0, 91, 2), [0, 180]), "no grid of Theta from 0 and of Phi"),
        (
            "a.csv",
            wide(np.arange(0, 91, 2), [0, 90, 180, 270]).replace("77", "76", 1),
            "several frequencies",
        ),
        ("a.csv", hfss(theta=np.zeros(1)), "no grid of Theta from 0"),
        ("a.csv", "\n".join(hfss().split("\n")[:-150]), "no grid of Theta from 0"),
    ],
)
def test_wrong_files_are_one_message(tmp_path, name, text, said):
    """With the key, the line and the remedy."""
    with pytest.raises(ScenarioError, match=said) as refused:
        read(tmp_path, name, text)
    assert "array.pattern_file" in str(refused.value)


def test_a_gain_beside_a_file_that_states_it_is_refused(tmp_path):
    """Planted bug: one of the two taken in silence."""
    with pytest.raises(ScenarioError, match="stands beside element_gain_dbi"):
        read(tmp_path, "patch.msi", planet("7.5 dBi"), "array.element_gain_dbi=6")
