"""Arrays of one's own in a scenario: shapes, files, sensors, and what does not fit."""

from __future__ import annotations

import numpy as np
import pytest

from isac_rt.document import ScenarioError
from isac_rt.frame.antennas import antennas_of, ti_cascade
from isac_rt.frame.waveform import waveform_of
from isac_rt.scenario.file import load, to_yaml
from isac_rt.scenario.sensors import SENSORS

SCENE = """
frames: 4
radio: {mode: fmcw, carrier_hz: 60.0e+9, chirps_per_frame: 48}
swarm:
  R: {role: active, position_m: [0, 0, 10]}
  T: {role: target, position_m: [1, 8, 12]}
"""


def scenario(folder, *overrides):
    (folder / "scene.yaml").write_text(SCENE)
    return load(folder / "scene.yaml", overrides)


def positions(s):
    a = antennas_of(s.array, waveform_of(s.radio, s.array))
    return a.tx_positions[:, [0, 2]], a.rx_positions[:, [0, 2]]


def test_shapes_by_hand(tmp_path):
    """Row by row from the lower left, in wavelengths; bug: spacing taken in metres."""
    lam = 299792458 / 60e9
    s = scenario(
        tmp_path,
        "array.tx={shape: linear, columns: 2, spacing: [2, 1]}",
        "array.rx={shape: planar, columns: 2, rows: 3, spacing: [0.5, 0.6]}",
    )
    tx, rx = positions(s)
    assert tx == pytest.approx(lam * np.array([[-1, 0], [1, 0]]))
    by_hand = [(x, z) for z in (-0.6, 0, 0.6) for x in (-0.25, 0.25)]
    assert rx == pytest.approx(lam * np.array(by_hand))
    assert s.num_tx == 2
    cascade = positions(
        scenario(tmp_path, "array.tx.shape=ti_cascade", "array.rx.shape=ti_cascade")
    )
    for found, places in zip(cascade, ti_cascade(), strict=True):
        assert found == pytest.approx(np.array(places) - np.mean(places, axis=0))


def test_places_from_a_file_become_part_of_the_scenario(tmp_path):
    """The resolved scenario holds the numbers and needs the file no more; bug: the name kept."""
    (tmp_path / "rx.csv").write_text("# millimetres no: metres\nz; x\n0;0\n1e-3;2e-3\n0;5e-3\n")
    s = scenario(tmp_path, "array.rx={file: rx.csv, unit: metres}")
    assert s.array.rx.positions == ((0, 0), (2e-3, 1e-3), (5e-3, 0))
    (tmp_path / "elsewhere").mkdir()
    again = tmp_path / "elsewhere" / "scene.yaml"
    again.write_text(to_yaml(s))
    assert load(again).model_dump() == s.model_dump()


@pytest.mark.parametrize(
    ("content", "said"),
    [
        (b"x,z\n", "a header and no rows"),
        (b"", "is empty"),
        (b"x,y\n1,2\n", "no column z"),
        (b"x,z,w\n1,2,3\n", "the column 'w' is not known"),
        (b"x,z\n1,2,3\n", "line 2: 3 fields, the header has 2"),
        (b"x,z\n1,nan\n", "line 2: z = 'nan' is no finite number"),
        (b"x,z\n1,2\n1,1e999\n", "line 3: z = '1e999'"),
        (b'x,z\n"1,2\n', "line 2"),
        (b"\xff\xfe\x00", "is not UTF-8"),
        (b"x,z\n" + b"1,2\n" * 20001, "has 20001 rows"),
        (b"x,z\n" + b"1" * 4_000_001, "a table has at most"),
    ],
)
def test_hostile_tables_are_one_message(tmp_path, content, said):
    """With the key and the line; bug: a traceback of the csv module."""
    (tmp_path / "rx.csv").write_bytes(content)
    with pytest.raises(ScenarioError, match=said) as caught:
        scenario(tmp_path, "array.rx.file=rx.csv")
    assert "\n" not in str(caught.value) and "array.rx.file" in str(caught.value)


def test_what_is_no_file_is_one_message(tmp_path):
    """Missing, a folder, a pipe."""
    for name, said in (
        ("none.csv", "No such file"),
        (".", "not a regular"),
        ("/dev/zero", "not a"),
    ):
        with pytest.raises(ScenarioError, match=said):
            scenario(tmp_path, f"array.rx.file={name}")


@pytest.mark.parametrize(
    ("overrides", "said"),
    [
        (["array.rx={shape: positions}"], "needs one element or more"),
        (["array.rx={shape: linear, positions: [[0, 0]]}"], "no meaning with shape linear"),
        (["array.rx.positions=[[0, 0, 0]]"], "at most 2"),
        (["array.rx={shape: planar, columns: 64, rows: 64}"], "more than 1024"),
        (["sensor=awr9"], "sensor"),
        (["array.tx={shape: linear, columns: 5}"], "48 chirps are not a multiple"),
    ],
)
def test_arrays_that_do_not_fit_are_refused(tmp_path, overrides, said):
    """One message, which names the remedy."""
    with pytest.raises(ScenarioError, match=said):
        scenario(tmp_path, *overrides)


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("name", SENSORS)
def test_sensors_are_consistent_and_can_be_overridden(tmp_path, name):
    """Band by its data sheet; what the scenario states wins; none of a sensor's numbers raises a
    doubt; bug: the sensor's chirp merged into the stated one."""
    scene = SCENE.replace("radio: {mode: fmcw, carrier_hz: 60.0e+9, chirps_per_frame: 48}\n", "")
    (tmp_path / "scene.yaml").write_text(scene)
    s = load(tmp_path / "scene.yaml", [f"sensor={name}", "noise.noise_figure_db=9"])
    assert s == load(tmp_path / "scene.yaml", [f"sensor={name.upper()}", "noise.noise_figure_db=9"])
    bands = {
        "awr": (76e9, 81e9),
        "iwr1": (76e9, 81e9),
        "iwr6": (60e9, 64e9),
        "bgt": (24e9, 24.25e9),
    }
    low, high = next(band for start, band in bands.items() if name.startswith(start))
    assert low <= s.radio.carrier_hz and s.radio.carrier_hz + s.radio.bandwidth_hz <= high
    assert (s.noise.noise_figure_db, s.radio.mode) == (9, "fmcw")
    assert s.noise.tx_power_dbm == SENSORS[name]["noise"]["tx_power_dbm"]


def test_one_key_of_a_sensors_chirp_can_be_stated(tmp_path):
    """33 us at 20 MHz/us sweep 660 MHz. Planted bug: the stated chirp in place of the sensor's."""
    scene = SCENE.replace("radio: {mode: fmcw, carrier_hz: 60.0e+9, chirps_per_frame: 48}\n", "")
    (tmp_path / "scene.yaml").write_text(scene)
    radio = load(
        tmp_path / "scene.yaml", ["sensor=awr1843", "radio.chirp.slope_mhz_per_us=20"]
    ).radio
    assert (radio.chirp.idle_us, radio.bandwidth_hz) == (7, pytest.approx(660e6))


@pytest.mark.parametrize(
    ("name", "height", "low"),
    [("awr1843", 0.5, 8), ("iwr6843", 0.5, 8), ("awr2944", 0.8, 12)],
)
def test_boards_of_ti_have_the_virtual_arrays_of_tis_configurations(tmp_path, name, height, low):
    """`low` places half a wavelength apart, four more `height` wavelengths above the third to the
    sixth: `antGeometry0` and `antGeometry1` of TI's ISK_6m_default.cfg, RadarML/xwr's diagrams of
    AWR1843Boost and AWR2944EVM; bug: the raised transmitter in the column of another."""
    scene = SCENE.replace("radio: {mode: fmcw, carrier_hz: 60.0e+9, chirps_per_frame: 48}\n", "")
    (tmp_path / "scene.yaml").write_text(scene)
    s = load(tmp_path / "scene.yaml", [f"sensor={name}"])
    tx, rx = positions(s)
    virtual = (tx[:, None] + rx[None]).reshape(-1, 2) * s.radio.carrier_hz / 299792458
    virtual -= virtual.min(axis=0)
    expected = [(k / 2, 0.0) for k in range(low)] + [(k / 2, height) for k in range(2, 6)]
    found = sorted((round(x, 6), round(z, 6)) for x, z in virtual)
    assert found == pytest.approx(np.array(sorted(expected)))
