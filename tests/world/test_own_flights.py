"""Flights, attitudes, formations and tables by direction as their owners state them."""

from __future__ import annotations

import numpy as np
import pytest

from isac_rt.document import ScenarioError
from isac_rt.frame.antennas import antennas_of
from isac_rt.frame.waveform import waveform_of
from isac_rt.propagation.rcs import CrossSection
from isac_rt.scenario.file import load, to_yaml
from isac_rt.settings import AspectTable
from isac_rt.sweep import load_sweep
from isac_rt.world.aspect import in_table
from isac_rt.world.swarm import Trajectory, turned

SCENE = """
frames: 4
radio: {mode: fmcw}
swarm:
  R: {role: active, position_m: [0, 0, 10]}
  T: {role: target, position_m: [1, 20, 12], velocity_mps: [3, 4, 0]}
"""


def scenario(folder, *overrides, scene=SCENE):
    (folder / "scene.yaml").write_text(scene)
    return load(folder / "scene.yaml", overrides)


def flight(folder, rows, header="time_s,x,y,z"):
    lines = [header, *(",".join(map(repr, map(float, row))) for row in rows)]
    (folder / "flight.csv").write_text("\n".join(lines) + "\n")
    scene = SCENE.replace("position_m: [1, 20, 12], velocity_mps: [3, 4, 0]", "flight: flight.csv")
    return scenario(folder, scene=scene)


def test_a_flight_from_csv_is_met_and_moves_as_it_says(tmp_path):
    """A helix sampled at 5 Hz: places to the last bit at the rows, between them to the spline's
    h^4 f''''/384; velocity and acceleration are the derivatives of the place by differences. Bug:
    the flight's time taken by row numbers."""
    t = np.arange(0, 4.01, 0.2) + 0.37
    place = np.stack([10 * np.cos(t), 10 * np.sin(t), 5 + 0.7 * t], axis=1)
    s = flight(tmp_path, np.column_stack([t, place]))
    way = Trajectory(s.swarm["T"])
    assert way.pose(float(t[7])).position.tolist() == place[7].tolist()
    at, h = 2.123, 1e-4
    truth = np.array([10 * np.cos(at), 10 * np.sin(at), 5 + 0.7 * at])
    assert way.pose(at).position == pytest.approx(truth, abs=10 * 0.2**4 / 384 * 1.5)
    before, now, after = (way.pose(at + d) for d in (-h, 0, h))
    assert now.velocity == pytest.approx((after.position - before.position) / (2 * h), abs=1e-6)
    assert now.acceleration == pytest.approx((after.velocity - before.velocity) / (2 * h), abs=1e-6)
    (tmp_path / "again.yaml").write_text(to_yaml(s))
    (tmp_path / "flight.csv").unlink()
    assert load(tmp_path / "again.yaml").model_dump() == s.model_dump()


def test_attitudes_by_hand():
    """Nose east is a yaw of 90 degrees; nose up; right side down. Bug: yaw counted from east."""
    assert turned((90, 0, 0)).as_matrix()[:, 1] == pytest.approx([1, 0, 0])
    assert turned((0, 30, 0)).as_matrix()[:, 1] == pytest.approx([0, np.sqrt(3) / 2, 0.5])
    assert turned((0, 0, 30)).as_matrix()[:, 0] == pytest.approx([np.sqrt(3) / 2, 0, -0.5])
    both = turned((90, 30, 0)).as_matrix()
    assert both[:, 1] == pytest.approx([np.sqrt(3) / 2, 0, 0.5])


def test_attitude_over_time(tmp_path):
    """Met at the rows, on the way in between, past 180 degrees the short way round; bug: angles
    interpolated one by one."""
    rows = [(0, 0, 0, 9, 170, 0, 0), (1, 1, 0, 9, -170, 10, 0), (2, 2, 0, 9, -150, 0, -20)]
    s = flight(tmp_path, rows, "time_s,x,y,z,yaw_deg,pitch_deg,roll_deg")
    way = Trajectory(s.swarm["T"])
    for row in rows:
        assert way.pose(row[0]).rotation == pytest.approx(turned(row[4:]).as_matrix(), abs=1e-12)
    nose = way.pose(0.5).rotation[:, 1]
    assert np.degrees(np.arctan2(nose[0], nose[1])) % 360 == pytest.approx(180, abs=3)
    assert way.pose(9).rotation == pytest.approx(way.pose(2).rotation)


def test_a_mount_turns_the_arrays_against_the_body(tmp_path):
    """A car that drives north with a radar to its right looks east; bug: the mount before the
    attitude."""
    s = scenario(tmp_path, "swarm.R.velocity_mps=[0, 5, 0]", "swarm.R.mount_deg=[90, 0, 0]")
    assert Trajectory(s.swarm["R"]).pose(1.0).rotation[:, 1] == pytest.approx([1, 0, 0])
    s = scenario(tmp_path, "swarm.R.velocity_mps=[5, 0, 0]", "swarm.R.mount_deg=[90, 10, 0]")
    nose = Trajectory(s.swarm["R"]).pose(1.0).rotation[:, 1]
    assert nose == pytest.approx([0, -np.cos(np.radians(10)), np.sin(np.radians(10))])


@pytest.mark.parametrize(
    ("shape", "third"),
    [
        ("line", (-1, 0)),
        ("column", (0, -2)),
        ("wedge", (-1, -1)),
        ("grid", (0, -1)),
    ],
)
def test_formations_by_hand(tmp_path, shape, third):
    """Four UAVs, 5 m apart, about a flight to (3, 4)/5: right is (4, -3)/5. All keep the speed.
    Bug: sides taken along x and y of the world."""
    s = scenario(tmp_path, f"swarm.T.formation={{shape: {shape}, spacing_m: 5, count: 4}}")
    assert list(s.swarm) == ["R", "T_1", "T_2", "T_3", "T_4"]
    right, ahead = np.array([4, -3, 0]) / 5, np.array([3, 4, 0]) / 5
    by_hand = np.array([1, 20, 12]) + 5 * (third[0] * right + third[1] * ahead)
    assert s.swarm["T_3"].position_m == pytest.approx(by_hand)
    assert s.swarm["T_1"].position_m == (1, 20, 12)
    assert {uav.velocity_mps for name, uav in s.swarm.items() if name != "R"} == {(3, 4, 0)}


def test_tables_by_direction(tmp_path):
    """Bilinear in decibels by hand, for patterns and cross-sections, rows in any order; bug:
    azimuth to the left."""
    rows = [(-90, 0, -20), (90, 0, 0), (-90, 30, -40), (90, 30, -10)]
    for name, unit in (("gain", "dbi"), ("rcs", "dbsm")):
        text = "\n".join(f"{e},{a},{v}" for a, e, v in reversed(rows))
        (tmp_path / f"{name}.csv").write_text(f"elevation_deg,azimuth_deg,{unit}\n{text}\n")
    s = scenario(
        tmp_path,
        "array.element_pattern=table",
        "array.pattern_file=gain.csv",
        "array.element_gain_dbi=6",
        "swarm.T.rcs={model: table, file: rcs.csv}",
    )
    a, e = np.radians([45.0, 15.0])
    towards = np.array([np.cos(e) * np.sin(a), np.cos(e) * np.cos(a), np.sin(e)])
    by_hand = 0.5 * (-20 + 0.75 * 20) + 0.5 * (-40 + 0.75 * 30)
    antennas = antennas_of(s.array, waveform_of(s.radio, s.array))
    assert 10 * np.log10(antennas.element_gain(towards)) == pytest.approx(6 + by_hand)
    section = CrossSection(s.swarm["T"].rcs, "T", 1).square_metres(towards[None], towards[None])
    assert 10 * np.log10(section) == pytest.approx(by_hand)
    (tmp_path / "again.yaml").write_text(to_yaml(s))
    assert load(tmp_path / "again.yaml").model_dump() == s.model_dump()


@pytest.mark.parametrize(
    ("overrides", "said"),
    [
        (["swarm.T.flight=none.csv"], "No such file"),
        (["swarm.T.flight=flight.csv"], "either position_m or waypoints"),
        (["swarm.T.formation={shape: ring, spacing_m: 5, count: 3}"], "formation.shape"),
        (["swarm.T.formation={shape: line, spacing_m: -5, count: 3}"], "greater than 0"),
        (["swarm.T.rcs.model=table"], "goes with model table"),
        (["array.element_pattern=table"], "needs it or pattern_file"),
        (["swarm.T.rcs={model: table, file: flight.csv}"], "no column azimuth_deg"),
        (["swarm.T.rcs={model: table, file: gap.csv}"], "are no grid of 2 azimuths and 2"),
        (["swarm.T.mount_deg=[1, 2]"], "three numbers"),
    ],
)
def test_what_cannot_be_flown_is_one_message(tmp_path, overrides, said):
    """With the key and the remedy."""
    (tmp_path / "flight.csv").write_text("time_s,x,y,z\n0,0,0,9\n1,1,0,9\n")
    (tmp_path / "gap.csv").write_text("azimuth_deg,elevation_deg,dbsm\n0,0,1\n5,0,1\n0,5,1\n")
    with pytest.raises(ScenarioError, match=said):
        scenario(tmp_path, *overrides)


@pytest.mark.parametrize(
    ("header", "rows", "said"),
    [
        ("time_s,x,y,z,yaw_deg", [(0, 0, 0, 9, 1)], "add the others"),
        ("time_s,x,y,z", [(0, 0, 0, 9), (0, 1, 0, 9)], "must be later"),
        ("time_s,x,y,z", [(i, i, 0, 9) for i in range(5001)], "at most 5000; thin it out"),
    ],
)
def test_flights_that_are_none_are_refused(tmp_path, header, rows, said):
    """Times that do not rise, attitudes by half, too many rows."""
    with pytest.raises(ScenarioError, match=said):
        flight(tmp_path, rows, header)


def test_a_sweep_takes_flights_as_values(tmp_path):
    """The key of a point depends on the numbers in its file; bug: on the file's name."""
    rows = [(0, 0, 0, 9), (1, 1, 0, 9)]
    flight(tmp_path, rows)
    (tmp_path / "other.csv").write_text("time_s,x,y,z\n0,0,5,9\n1,1,5,9\n")
    (tmp_path / "sweep.yaml").write_text(
        "scenario: scene.yaml\n"
        "axes: {way: {key: swarm.T.flight, values: [flight.csv, other.csv]}}\n"
    )
    first = list(load_sweep(tmp_path / "sweep.yaml").points())
    assert first[1].tree["swarm"]["T"]["waypoints"][0]["position_m"] == [0, 5, 9]
    (tmp_path / "other.csv").write_text("time_s,x,y,z\n0,0,6,9\n1,1,5,9\n")
    again = list(load_sweep(tmp_path / "sweep.yaml").points())
    assert (again[0].key, again[1].key != first[1].key) == (first[0].key, True)


def test_a_table_of_azimuths_may_begin_at_minus_360():
    """Right, behind, left and ahead. Planted bug: azimuths over its last are not turned back."""
    table = AspectTable(
        azimuth_deg=(-360, -270, -180, -90, 0),
        elevation_deg=(0,),
        values_db=((1, 10, 20, 30, 1),),
    )
    ways = np.array([[1.0, 0, 0], [0, -1.0, 0], [-1.0, 0, 0], [0, 1.0, 0]])
    assert in_table(table, ways) == pytest.approx([10, 20, 30, 1])


def test_a_table_of_azimuths_from_0_to_350_goes_round():
    """Half way from 350 back to 0, to either end of the circle, and beyond a table that leaves more
    than a step out the nearer end. Planted bug: clipped to the last."""
    line = tuple(range(0, 360, 10))
    values = (tuple(float(a) for a in line),)
    table = AspectTable(azimuth_deg=line, elevation_deg=(0,), values_db=values)
    angles = np.radians([-5.0, -8.0, 4.0, 175.0, -175.0])
    ways = np.stack([np.sin(angles), np.cos(angles), 0 * angles], axis=1)
    assert in_table(table, ways) == pytest.approx([175, 280, 4, 175, 185])
    table = AspectTable(azimuth_deg=(0, 90), elevation_deg=(0,), values_db=((1, 2),))
    angles = np.radians([-20.0, 110.0, -170.0])
    ways = np.stack([np.sin(angles), np.cos(angles), 0 * angles], axis=1)
    assert in_table(table, ways) == pytest.approx([1, 2, 2])
