"""Flights, attitudes, formations and tables by direction as their owners state them."""

from __future__ import annotations

import json
import warnings

import numpy as np
import pyproj
import pytest
import trimesh

from isac_rt.document import ScenarioError, ScenarioWarning
from isac_rt.frame.antennas import antennas_of
from isac_rt.frame.waveform import waveform_of
from isac_rt.propagation.rcs import CrossSection
from isac_rt.scenario.file import load, to_yaml
from isac_rt.settings import AspectTable
from isac_rt.simulation.setup import prepare
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


def test_a_smoothed_flight_loses_what_is_faster(tmp_path, caplog):
    """Sines of 20, 5 and 1 s, sampled at 10 Hz and smoothed over 5 s: gains 1/(1 + (5/period)^4) in
    the middle of the log, straight flight to the last digits. Bugs: the period for the time
    constant; the weight without the number of points a second."""
    t = np.arange(0, 120, 0.1)
    place = np.stack([np.sin(2 * np.pi * t / period) for period in (20, 5, 1)], axis=1)
    place += t[:, None] * [1.0, -2.0, 0.5]
    flight(tmp_path, np.column_stack([t, place]))
    with caplog.at_level("INFO", "isac_rt.inputs"):
        scene = (tmp_path / "scene.yaml").read_text().replace("flight.csv", "flight.csv~5")
        s = scenario(tmp_path, scene=scene)
    found = np.array([w.position_m for w in s.swarm["T"].waypoints])
    left = found - t[:, None] * [1.0, -2.0, 0.5]
    middle = slice(400, 800)
    for axis, period in enumerate((20, 5, 1)):
        truth = np.sin(2 * np.pi * t / period) / (1 + (5 / period) ** 4)
        assert left[middle, axis] == pytest.approx(truth[middle], abs=3e-3)
    assert "flight.csv: smoothed over 5 s, positions move by" in caplog.text
    with pytest.raises(ScenarioError, match=r"swarm\.T\.flight.*~0: smoothing needs a positive"):
        scenario(tmp_path, scene=scene.replace("~5", "~0"))
    with pytest.raises(ScenarioError, match="~SECONDS = 'x' is no finite number"):
        scenario(tmp_path, scene=scene.replace("~5", "~x"))


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
        ("time_s,x,y,z,roll_deg", [(0, 0, 0, 9, 1)], "without yaw_deg"),
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


# ---- in the coordinates of a map


def quarter(folder, origin=(11.0, 48.0), crs=None, scale=(1 / 74_600, 1 / 111_200)):
    """GeoJSON of two houses about an origin, in degrees or in a grid."""
    corners = np.array([[0, 0], [20, 0], [20, 22], [0, 22], [0, 0]], float)
    rings = [corners + at for at in ((-60, 0), (60, 0))]
    shapes = [
        {"type": "Polygon", "coordinates": [(np.array(origin) + ring * scale).tolist()]}
        for ring in rings
    ]
    tree = {
        "type": "FeatureCollection",
        "features": [
            {"type": "Feature", "properties": {"height": 9}, "geometry": shape} for shape in shapes
        ],
    }
    if crs:
        tree["crs"] = {"type": "name", "properties": {"name": crs}}
    (folder / "town.geojson").write_text(json.dumps(tree))


def over_a_map(folder, header, rows, city="source: footprints, file: town.geojson"):
    lines = [header, *(",".join(map(repr, map(float, row))) for row in rows)]
    (folder / "flight.csv").write_text("\n".join(lines) + "\n")
    scene = SCENE.replace("position_m: [1, 20, 12], velocity_mps: [3, 4, 0]", "flight: flight.csv")
    return scenario(folder, scene=f"city: {{{city}}}\n{scene}" if city else scene)


WGS84 = pyproj.Geod(ellps="WGS84")


@pytest.mark.parametrize("header", ["time_s,lat,lon,alt", "time_s,Latitude,longitude_deg,altitude"])
@pytest.mark.parametrize("grid", [None, "EPSG:25832"])
def test_latitude_and_longitude_are_read_with_the_city(tmp_path, header, grid):
    """Distance and bearing from the origin by the geodesic. Planted bug: latitude taken as x."""
    if grid:
        to_grid = pyproj.Transformer.from_crs("EPSG:4326", grid, always_xy=True)
        origin = to_grid.transform(11.0, 48.0)
        quarter(tmp_path, origin, grid, (1, 1))
    else:
        origin = (11.0, 48.0)
        quarter(tmp_path)
    city = f"source: footprints, file: town.geojson, origin: [{origin[0]}, {origin[1]}, 3]"
    rows = [(0, 48.00031, 11.00042, 18), (1, 48.00013, 10.99957, 19)]
    way = over_a_map(tmp_path, header, rows, city).swarm["T"].waypoints
    for row, point in zip(rows, way, strict=True):
        azimuth, _, distance = WGS84.inv(11, 48, row[2], row[1])
        x, y, z = point.position_m
        assert np.hypot(x, y) == pytest.approx(distance, rel=1e-3)  # the grid's scale
        turned = np.degrees(np.arctan2(x, y)) - azimuth
        assert (turned + 180) % 360 - 180 == pytest.approx(0, abs=0.01 if not grid else 2)
        assert z == row[3] - 3


def test_a_flight_in_utm_is_read_with_the_citys_origin(tmp_path):
    """Of a mesh and of footprints in a grid; a city that has no origin lies in the grid itself.
    Planted bug: the height not taken from the origin's."""
    rows = [(0, 691_010.0, 5_334_020.0, 535.0), (1, 691_011.5, 5_334_021.0, 535.5)]
    trimesh.creation.box((9, 9, 9)).export(tmp_path / "box.obj")
    origin = "origin: [691000, 5334000, 520]"
    quarter(tmp_path, (691_000, 5_334_000), "EPSG:25832", (1, 1))
    for source in ("source: mesh, file: box.obj", "source: footprints, file: town.geojson"):
        way = over_a_map(tmp_path, "time_s,x,y,z", rows, f"{source}, {origin}").swarm["T"].waypoints
        assert [w.position_m for w in way] == [(10, 20, 15), (11.5, 21, 15.5)]
        way = over_a_map(tmp_path, "time_s,x,y,z", rows, source).swarm["T"].waypoints
        assert way[0].position_m == rows[0][1:]
        near = [(0, 10.0, 20.0, 15.0), (1, 11.5, 21.0, 15.5)]
        way = over_a_map(tmp_path, "time_s,x,y,z", near, f"{source}, {origin}").swarm["T"].waypoints
        assert way[0].position_m == near[0][1:]


@pytest.mark.parametrize(
    ("header", "row", "city", "said"),
    [
        ("time_s,lat,lon,alt", (48, 11, 9), "", "state x, y, z"),
        ("time_s,lat,lon,alt", (48, 11, 9), "source: canyon", "state x, y, z"),
        ("time_s,lat,lon,alt", (98, 11, 9), "source: footprints, file: town.geojson", "exchange"),
        (
            "time_s,x,y,z",
            (691_000, 5_334_000, 535),
            "source: footprints, file: town.geojson",
            "lat, lon, alt over a map",
        ),
        (
            "time_s,x,y,z",
            (691_000, 5_334_000, 535),
            "source: blocks",
            "from the world's origin, as in UTM",
        ),
        ("time_s,lat,lon", (48, 11), "", "or time_s, lat, lon, alt"),
    ],
)
def test_a_flight_that_no_map_georeferences_says_what_to_state(tmp_path, header, row, city, said):
    """In one message with the key."""
    quarter(tmp_path)
    with pytest.raises(ScenarioError, match=said) as refused:
        over_a_map(tmp_path, header, [(0, *row), (1, *row)], city)
    assert "swarm.T.flight" in str(refused.value)


def test_yaw_alone_flies_level(tmp_path):
    """Pitch and roll are 0; without the yaw, they say nothing."""
    s = flight(tmp_path, [(0, 0, 0, 9, 10), (1, 1, 0, 9, 20)], "time_s,x,y,z,yaw_deg")
    assert [w.attitude_deg for w in s.swarm["T"].waypoints] == [(10, 0, 0), (20, 0, 0)]
    s = flight(tmp_path, [(0, 0, 0, 9, 1, 2), (1, 1, 0, 9, 3, 4)], "time_s,x,y,z,roll_deg,yaw_deg")
    assert s.swarm["T"].waypoints[1].attitude_deg == (4, 0, 3)


def test_waypoints_of_another_time_than_the_run_are_refused(tmp_path):
    """They were prolonged in silence. Those of a part of the run are warned of, all others not.
    Planted bug: the run's end taken for the flight's."""
    run = {"frames": 5, "frame_interval_s": 0.25}
    for begin, end in ((5.0, 25.0), (-9.0, -1.0)):
        s = flight(tmp_path, [(begin, 0, 30, 9), (end, 1, 30, 9)]).model_copy(update=run)
        with pytest.raises(ScenarioError, match=f"swarm.T: .* from {begin:g} to {end:g} s"):
            prepare(s)
    for begin, end in ((0.6, 9.0), (-9.0, 0.6)):
        s = flight(tmp_path, [(begin, 0, 30, 9), (end, 1, 30, 9)]).model_copy(update=run)
        with pytest.warns(ScenarioWarning, match="swarm.T: .* straight on"):
            prepare(s)
    s = flight(tmp_path, [(0, 0, 30, 9), (1.1, 1, 30, 9)]).model_copy(update=run)
    with warnings.catch_warnings():
        warnings.filterwarnings("error", message="swarm.T")
        prepare(s)
