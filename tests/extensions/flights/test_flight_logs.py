"""Flights from ULog, bags of ROS 2 and SUMO, against the curves that were written into them."""

from __future__ import annotations

import json
import struct
import sys

import numpy as np
import pyproj
import pytest
from scipy.spatial.transform import Rotation

from isac_rt.document import ScenarioError
from isac_rt.runtime import UserError
from isac_rt.scenario.file import load
from isac_rt.world.swarm import Trajectory

SCENE = """
frames: 4
radio: {mode: fmcw}
swarm:
  R: {role: active, position_m: [0, 0, 10]}
  T: {role: target, flight: "LOG"}
"""
TIMES = np.arange(0, 4.001, 0.1)
BEGUN_US = 1_234_567_890


def curve(t):
    """East, north, up [m] of a climbing turn, unlike in all three."""
    return np.stack([20 * np.cos(0.5 * t), 5 + 30 * np.sin(0.5 * t), 40 + 2 * t], axis=-1)


def fly(folder, log, city=""):
    (folder / "scene.yaml").write_text(city + SCENE.replace("LOG", log))
    return load(folder / "scene.yaml").swarm["T"]


def check(uav, after=0.0):
    """Hold a flight to the curve between the samples; of the spline h^4 f''''/384 is 1e-6 m."""
    for t in (0.55, 1.234, 2.9 - after):
        assert Trajectory(uav).pose(t).position == pytest.approx(curve(t + after), abs=1e-4)


# ---- PX4


def ulog(file, *messages):
    """A ULog of messages (name, fields, rows), by its specification: F names the fields, A
    subscribes, D holds."""
    codes = {"uint64_t": "Q", "float": "f", "double": "d", "bool": "?", "float[4]": "4f"}

    def message(kind, content):
        return struct.pack("<HB", len(content), ord(kind)) + content

    parts = [b"ULog\x01\x12\x35\x01" + struct.pack("<Q", BEGUN_US)]
    for name, fields, _ in messages:
        form = f"{name}:" + "".join(f"{kind} {field};" for kind, field in fields)
        parts.append(message("F", form.encode()))
    for number, (name, fields, rows) in enumerate(messages, start=7):
        packed = "<H" + "".join(codes[kind] for kind, _ in fields)
        parts.append(message("A", struct.pack("<BH", 0, number) + name.encode()))
        parts += [message("D", struct.pack(packed, number, *row)) for row in rows]
    file.write_bytes(b"".join(parts))


LOCAL = [
    ("uint64_t", "timestamp"),
    ("float", "x"),
    ("float", "y"),
    ("float", "z"),
    ("bool", "xy_valid"),
]


def local_rows(times=TIMES, lost=()):
    stamps = BEGUN_US + np.round(1e6 * times).astype(int)
    for i, (t, (east, north, up)) in enumerate(zip(stamps, curve(times), strict=True)):
        yield int(t), north if i not in lost else 999.0, east, -up, i not in lost


def test_px4_local_positions(tmp_path, caplog):
    """North, east, down in microseconds since the board began; what the estimator calls invalid is
    left out. Planted bug: x taken as east; z upwards; the flag not asked for."""
    pytest.importorskip("pyulog")
    ulog(tmp_path / "log.ulg", ("vehicle_local_position", LOCAL, local_rows(lost=(17, 18))))
    with caplog.at_level("INFO", "isac_rt.inputs"):
        check(fly(tmp_path, "log.ulg"))
    assert "log.ulg: vehicle_local_position, 39 positions, 4.0 s" in caplog.text
    check(fly(tmp_path, "log.ulg#vehicle_local_position"))
    check(fly(tmp_path, "log.ulg#@1.5"), after=1.5)


def turned_by(t):
    """Yaw from north to the right, pitch with the nose up and roll with the right side down
    [degrees]."""
    return np.stack([170 + 15 * t, 9 * np.sin(t), -12 + 5 * t], axis=-1)


def axes(angles):
    """Ahead, right and up in the world by three rotations of a drone that points north, by hand."""
    yaw, pitch, roll = np.radians(angles)
    ahead, right, up = np.eye(3)[[1, 0, 2]]
    ahead, up = (
        ahead * np.cos(pitch) + up * np.sin(pitch),
        up * np.cos(pitch) - ahead * np.sin(pitch),
    )
    right, up = right * np.cos(roll) - up * np.sin(roll), up * np.cos(roll) + right * np.sin(roll)
    c, s = np.cos(yaw), np.sin(yaw)
    return np.stack([ahead, right, up]) @ np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])


def check_attitude(uav):
    """Hold arrays to the axes between the samples: right, ahead and up are the pose's columns."""
    for t in (0.55, 1.234, 2.9):
        ahead, right, up = axes(turned_by(t))
        found = Trajectory(uav).pose(t).rotation
        assert found == pytest.approx(np.stack([right, ahead, up], axis=1), abs=2e-4)


def test_px4_attitudes(tmp_path, caplog):
    """Quaternions w, x, y, z that turn nose, right, down into north, east, down, at other times
    than the positions. A stated boresight stands in their place. Planted bugs: w last; the
    attitude of the row with the position's number; pitch counted downwards."""
    pytest.importorskip("pyulog")
    times = np.arange(-0.2, 4.3, 0.025) + 0.007
    rows = []
    for t in times:
        ahead, right, up = axes(turned_by(t))
        frame = np.stack([ahead, right, -up])[:, [1, 0, 2]] * [1, 1, -1]  # rows: north, east, down
        x, y, z, w = Rotation.from_matrix(frame.T).as_quat()
        rows.append((BEGUN_US + round(1e6 * t), w, x, y, z))
    fields = [("uint64_t", "timestamp"), ("float[4]", "q")]
    place = "vehicle_local_position", LOCAL, local_rows()
    ulog(tmp_path / "log.ulg", place, ("vehicle_attitude", fields, rows))
    with caplog.at_level("INFO", "isac_rt.inputs"):
        uav = fly(tmp_path, "log.ulg")
    check(uav)
    check_attitude(uav)
    assert "41 positions, 4.0 s, with attitudes" in caplog.text
    scene = SCENE.replace('"LOG"', "log.ulg, boresight: [0, 1, 0]")
    (tmp_path / "scene.yaml").write_text(scene)
    assert load(tmp_path / "scene.yaml").swarm["T"].waypoints[0].attitude_deg is None


def test_a_long_log_is_thinned(tmp_path, caplog):
    """12,000 rows become 4,000. Planted bug: the first 5,000."""
    pytest.importorskip("pyulog")
    times = np.arange(12_000) * 4 / 12_000
    ulog(tmp_path / "log.ulg", ("vehicle_local_position", LOCAL, local_rows(times)))
    with caplog.at_level("INFO", "isac_rt.inputs"):
        uav = fly(tmp_path, "log.ulg")
    assert len(uav.waypoints) == 4000
    assert "12000 positions, 4.0 s, one of 3 is taken" in caplog.text
    assert uav.waypoints[-1].position_m == pytest.approx(curve(times[-3]), abs=1e-5)


CITY = "city: {source: footprints, file: town.geojson, origin: [11.0, 48.0, 500]}\n"
WGS84 = pyproj.Geod(ellps="WGS84")


def town(folder):
    """GeoJSON of two houses about 11 degrees east, 48 north."""
    ring = np.array([[0, 0], [3e-4, 0], [3e-4, 2e-4], [0, 2e-4], [0, 0]])
    shapes = [np.add(ring, (11 + x, 48)).tolist() for x in (-1e-3, 1e-3)]
    features = [
        {
            "type": "Feature",
            "properties": {"height": 9},
            "geometry": {"type": "Polygon", "coordinates": [s]},
        }
        for s in shapes
    ]
    (folder / "town.geojson").write_text(
        json.dumps({"type": "FeatureCollection", "features": features})
    )


def on_earth(times=TIMES):
    """Longitude, latitude [degrees] and height [m] of the curve by geodesics from the origin."""
    east, north, up = curve(times).T
    azimuth, distance = np.degrees(np.arctan2(east, north)), np.hypot(east, north)
    lon, lat, _ = WGS84.fwd(np.full(len(times), 11.0), np.full(len(times), 48.0), azimuth, distance)
    return np.column_stack([lon, lat, up + 500])


def test_px4_global_positions_over_a_map(tmp_path):
    """Degrees by geodesics about the city's origin. Planted bug: longitude for latitude."""
    pytest.importorskip("pyulog")
    town(tmp_path)
    fields = [("uint64_t", "timestamp"), ("double", "lat"), ("double", "lon"), ("float", "alt")]
    rows = (
        (BEGUN_US + round(1e6 * t), lat, lon, up)
        for t, (lon, lat, up) in zip(TIMES, on_earth(), strict=True)
    )
    ulog(tmp_path / "log.ulg", ("vehicle_global_position", fields, rows))
    check(fly(tmp_path, "log.ulg", CITY))
    with pytest.raises(ScenarioError, match="no map says where on Earth"):
        fly(tmp_path, "log.ulg")


def test_damaged_logs_are_one_message(tmp_path):
    """With the key. Planted bug: the library's error goes through."""
    pytest.importorskip("pyulog")
    (tmp_path / "log.ulg").write_bytes(b"no log at all")
    with pytest.raises(ScenarioError, match=r"swarm\.T\.flight .*damaged or of another kind"):
        fly(tmp_path, "log.ulg")
    ulog(tmp_path / "log.ulg", ("sensor_accel", LOCAL, local_rows()))
    with pytest.raises(
        ScenarioError, match="name a message with positions as FILE#NAME; there are 0"
    ):
        fly(tmp_path, "log.ulg")


@pytest.mark.parametrize(("name", "module"), [("log.ulg", "pyulog"), ("log.mcap", "rosbags")])
def test_a_missing_library_is_one_message(tmp_path, monkeypatch, name, module):
    """With the extra. Planted bug: ModuleNotFoundError goes through."""
    monkeypatch.setitem(sys.modules, module, None)
    (tmp_path / name).write_bytes(b"")
    with pytest.raises(UserError, match=rf"{module}: pip install 'isac_rt\[flights\]'"):
        fly(tmp_path, name)


# ---- ROS 2


def bag(folder, topics):
    """A bag with topics of (type, make, times): `make` builds a message of a header and a row."""
    rosbag2 = pytest.importorskip("rosbags.rosbag2")
    typesys = pytest.importorskip("rosbags.typesys")
    store = typesys.get_typestore(typesys.Stores.ROS2_HUMBLE)
    types = store.types
    with rosbag2.Writer(folder, version=9) as writer:
        for topic, (kind, make, times) in topics.items():
            connection = writer.add_connection(topic, kind, typestore=store)
            for i, t in enumerate(times):
                ns = 1_700_000_000_000_000_000 + round(1e9 * t)
                stamp = types["builtin_interfaces/msg/Time"](sec=ns // 10**9, nanosec=ns % 10**9)
                header = types["std_msgs/msg/Header"](stamp=stamp, frame_id="map")
                late = ns + 7_000_000 * (i % 3)  # as messages arrive
                writer.write(connection, late, store.serialize_cdr(make(types, header, i), kind))


def pose_of(types, point, quaternion=(0.0, 0.0, 0.0, 1.0)):
    at = types["geometry_msgs/msg/Point"](*map(float, point))
    turn = types["geometry_msgs/msg/Quaternion"](*map(float, quaternion))
    return types["geometry_msgs/msg/Pose"](at, turn)


def odometry(types, header, i):
    zero = types["geometry_msgs/msg/Vector3"](0.0, 0.0, 0.0)
    pose = types["geometry_msgs/msg/PoseWithCovariance"](
        pose_of(types, curve(TIMES[i])), np.zeros(36)
    )
    twist = types["geometry_msgs/msg/Twist"](zero, zero)
    twist = types["geometry_msgs/msg/TwistWithCovariance"](twist, np.zeros(36))
    return types["nav_msgs/msg/Odometry"](header, "base_link", pose, twist)


def posed(types, header, i):
    return types["geometry_msgs/msg/PoseStamped"](header, pose_of(types, curve(TIMES[i])))


def fix(types, header, i):
    lon, lat, up = on_earth()[i]
    lost = i in (7, 8)
    status = types["sensor_msgs/msg/NavSatStatus"](-1 if lost else 0, 1)
    lat = 0.0 if lost else lat
    return types["sensor_msgs/msg/NavSatFix"](header, status, lat, lon, up, np.zeros(9), 0)


@pytest.mark.parametrize(
    ("kind", "make"),
    [
        ("nav_msgs/msg/Odometry", odometry),
        ("geometry_msgs/msg/PoseStamped", posed),
        ("sensor_msgs/msg/NavSatFix", fix),
    ],
)
def test_ros_topics(tmp_path, kind, make, caplog):
    """Times by the header, not by arrival, which is up to 14 ms late; samples without a fix left
    out. Planted bug: the time of arrival; the status not asked for."""
    town(tmp_path)
    bag(tmp_path / "bag", {"/uav/at": (kind, make, TIMES)})
    with caplog.at_level("INFO", "isac_rt.inputs"):
        check(fly(tmp_path, "bag", CITY))
    assert f"bag: /uav/at, {41 - 2 * (make is fix)} positions, 4.0 s" in caplog.text


def test_ros_attitudes(tmp_path):
    """Quaternions x, y, z, w that turn ahead, left, up into east, north, up. Identities throughout
    are what writers leave: the UAV looks where it flies. Planted bugs: yaw from north; pitch
    upwards."""

    def turning(types, header, i):
        ahead, right, up = axes(turned_by(TIMES[i]))
        q = Rotation.from_matrix(np.stack([ahead, -right, up], axis=1)).as_quat()
        pose = pose_of(types, curve(TIMES[i]), q)
        return types["geometry_msgs/msg/PoseStamped"](header, pose)

    kind = "geometry_msgs/msg/PoseStamped"
    bag(tmp_path / "bag", {"/a": (kind, turning, TIMES), "/b": (kind, posed, TIMES)})
    uav = fly(tmp_path, "bag#/a")
    check(uav)
    check_attitude(uav)
    assert fly(tmp_path, "bag#/b").waypoints[0].attitude_deg is None


def test_topics_of_a_bag_share_a_clock(tmp_path):
    """The second topic begins half a second later. Planted bug: each from its own first message."""
    kind = "geometry_msgs/msg/PoseStamped"
    bag(tmp_path / "bag", {"/a": (kind, posed, TIMES), "/b": (kind, posed, TIMES + 0.5)})
    check(fly(tmp_path, "bag#/a"))
    late = fly(tmp_path, "bag#/b")
    assert Trajectory(late).pose(1.734).position == pytest.approx(curve(1.234), abs=1e-4)
    with pytest.raises(ScenarioError, match="as FILE#NAME; there are 2: /a, /b"):
        fly(tmp_path, "bag")


# ---- SUMO


def sumo(file, comment="", late=1.0, head="", z=True):
    """Floating-car data: a bus that stands, and from `late` [s] on a car on the curve."""
    lines = ['<?xml version="1.0" encoding="UTF-8"?>', head, f"<!-- {comment} -->", "<fcd-export>"]
    places = on_earth() if "true" in comment else curve(TIMES)
    for t, (x, y, up) in zip(TIMES, places, strict=True):
        lines += [f'<timestep time="{100 + t:.2f}">', f'<vehicle id="bus" x="{x + 1}" y="{y}"/>']
        height = f'z="{up!r}"' if z else ""
        lines += (
            [f'<vehicle id="car.0" x="{x!r}" y="{y!r}" {height} angle="3"/>'] if t >= late else []
        )
        lines += ["</timestep>"]
    file.write_text(
        "\n".join([*lines, "</fcd-export>"]).replace("np.float64(", "").replace(')"', '"')
    )


def test_sumos_vehicles(tmp_path, caplog):
    """Times from the file's first step, which all vehicles share. Planted bug: from the vehicle's
    first; the bus's places among the car's."""
    sumo(tmp_path / "fcd.xml")
    with caplog.at_level("INFO", "isac_rt.inputs"):
        uav = fly(tmp_path, "fcd.xml#car.0")
    assert uav.waypoints[0].time_s == pytest.approx(1.0)
    assert "fcd.xml: car.0, 31 positions, 3.0 s" in caplog.text
    assert Trajectory(uav).pose(2.345).position == pytest.approx(curve(2.345), abs=1e-4)
    check(fly(tmp_path, "fcd.xml#car.0@1.2"), after=1.2)


def test_sumos_degrees_are_told_by_its_comment(tmp_path):
    """Longitude is x. Without heights the flight is on the world's z = 0, wherever the origin is.
    Planted bug: the origin's height taken from a height that there is not."""
    town(tmp_path)
    sumo(tmp_path / "fcd.xml", '<fcd-output.geo value="true"/>', 0.0)
    check(fly(tmp_path, "fcd.xml#car.0", CITY))
    sumo(tmp_path / "fcd.xml", '<fcd-output.geo value="true"/>', 0.0, z=False)
    at = Trajectory(fly(tmp_path, "fcd.xml#car.0", CITY)).pose(1.234).position
    assert at == pytest.approx([*curve(1.234)[:2], 0], abs=1e-4)


ENTITIES = '<!DOCTYPE f [<!ENTITY a "aaaa"><!ENTITY b "&a;&a;&a;">]>'


@pytest.mark.parametrize(
    ("head", "change", "name", "said"),
    [
        (ENTITIES, ("", ""), "#bus", "line 2: a <!DOCTYPE> is not read"),
        ("", ("", ""), "", "name a vehicle as FILE#NAME; there are 2: bus, car.0"),
        ("", ("", ""), "#tram", "name a vehicle as FILE#NAME"),
        ("", ("", ""), "#bus@9", "bus: 0 of 41 positions are valid"),
        ("", ("", ""), "#bus@soon", "START = 'soon' is no finite number"),
        ("", ("</timestep>", ""), "#bus", "mismatched tag: line"),
        ("", ('time="100.00"', 'time="1:40"'), "#bus", "line 5: time = '1:40' is no finite number"),
        ("", ('y="5.0"', ""), "#bus", "line 6: y = '' is no finite number"),
    ],
)
def test_what_is_no_log_is_one_message(tmp_path, head, change, name, said):
    """With the key and the line. Planted bug: entities are expanded."""
    sumo(tmp_path / "fcd.xml", head=head)
    text = (tmp_path / "fcd.xml").read_text()
    (tmp_path / "fcd.xml").write_text(text.replace(*change) if change[0] else text)
    with pytest.raises(ScenarioError, match=said) as refused:
        fly(tmp_path, f"fcd.xml{name}")
    assert "swarm.T.flight" in str(refused.value)
