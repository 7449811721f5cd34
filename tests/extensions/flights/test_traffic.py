"""A file of SUMO as objects: places, boxes and courses against the arcs written into it."""

from __future__ import annotations

import numpy as np
import pytest

from isac_rt.document import ScenarioError
from isac_rt.extensions.street.boxes import box_corners
from isac_rt.scenario.file import load
from isac_rt.world.swarm import Swarm

SCENE = """
frames: 10
frame_interval_s: 0.2
radio: {mode: fmcw}
swarm:
  R: {role: active, position_m: [0, 0, 10]}
  street: {role: object, flight: "fcd.xml#*@2", box: {size_m: [1.8, 4.5, 1.4], material: metal}}
"""
SIZE = {"bus": (2.5, 12.0, 3.4), "car:1": (1.8, 4.5, 1.4), "van": (2.0, 6.0, 2.5)}


def bumper(name, t):
    """Place of the front bumper [m] and course [rad] in the file's time: arcs at 0.3 rad/s."""
    radius, centre = {"bus": (30, (5, -9)), "car:1": (22, (4, 2)), "van": (40, (0, 0))}[name]
    turn = 0.3 * t
    east, north = radius * np.sin(turn), radius * np.cos(turn)
    return np.array([centre[0] - north, centre[1] + east, 0.5]), turn  # clockwise from north


def fcd(folder, more=""):
    """A bus whose type has a size, with a rider, a car of none, a van with its own, which departs
    at 3.05 s, a person who waits, and a truck that has left before the run."""
    lines = ['<fcd-export><vType id="coach" width="2.5" length="12" height="3.4"/>', more]
    for t in np.arange(0, 6.01, 0.1):
        lines.append(f'<timestep time="{50 + t:.2f}">')
        for name in ("bus", "car:1", "van"):
            (x, y, z), turn = bumper(name, t)
            own = 'width="2" length="6" height="2.5"' if name == "van" else 'type="coach"'
            about = own if name != "car:1" else 'type="unknown"'
            where = f'x="{x:.9f}" y="{y:.9f}" z="{z}" angle="{np.degrees(turn):.9f}"'
            if name != "van" or t > 3.04:
                rider = f'<person id="r" {where}/>' if name == "bus" else ""
                lines.append(f'<vehicle id="{name}" {about} {where} slope="0">{rider}</vehicle>')
        if t < 1:
            lines.append(f'<vehicle id="truck" x="{t}" y="0" angle="0"/>')
        lines += ['<person id="p" x="3" y="4" z="0.2" angle="90"/>', "</timestep>"]
    (folder / "fcd.xml").write_text("\n".join([*lines, "</fcd-export>"]))
    (folder / "scene.yaml").write_text(SCENE)
    return folder / "scene.yaml"


def test_every_vehicle_is_a_box_behind_its_bumper(tmp_path, caplog):
    """Corners between the steps, at the run's time 0 of which the file shows 2 s. Planted bugs: the
    bumper for the middle; courses counted from east; sizes of the entry for all; START ignored;
    the rider walks."""
    with caplog.at_level("INFO", "isac_rt.inputs"):
        scenario = load(fcd(tmp_path))
    assert list(scenario.swarm) == ["R", "street_bus", "street_car_1", "street_p", "street_van"]
    assert "fcd.xml: 4 of 5 vehicles and persons" in caplog.text
    swarm = Swarm(scenario.swarm, 2.0)
    for name, uav in scenario.swarm.items():
        size = SIZE.get(name.removeprefix("street_").replace("_", ":"))
        assert (uav.box is None) if size is None else (uav.box.size_m, uav.role) == (size, "object")
    for name, (width, length, height) in SIZE.items():
        t = 1.93 if name == "van" else 0.57
        place, turn = bumper(name, t + 2)
        ahead, right = np.array([np.sin(turn), np.cos(turn), 0]), [np.cos(turn), -np.sin(turn), 0]
        found = box_corners(swarm, [t])["street_" + name.replace(":", "_")][0]
        expected = [
            place - a * length * ahead + b * width / 2 * np.array(right) + [0, 0, c * height]
            for b in (-1, 1)
            for a in (1, 0)
            for c in (0, 1)
        ]
        assert found == pytest.approx(np.array(expected), abs=2e-3)
    person = scenario.swarm["street_p"]
    assert person.extent.kind == "pedestrian"
    assert person.waypoints[0].position_m == pytest.approx((3, 4, 1.13))
    assert person.waypoints[0].attitude_deg == (90, 0, 0)


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (("frame_interval_s: 0.2", ""), "need frame_interval_s"),
        (("@2", "@9"), "0 of 5 vehicles and persons move in the 2 s from START"),
        (("fcd.xml#*", "none.xml#*"), "cannot be read: No such file"),
        (("#*@2", "#*~2@2"), "is not #.@START"),
        (("#*@2", "#*@0"), "truck has no angle"),
        (("  street:", "  street_bus: {role: target}\n  street:"), "named swarm.street_bus, which"),
    ],
)
def test_traffic_that_cannot_be_is_one_message(tmp_path, change, said):
    """Planted bug: a vehicle of a stated UAV's name takes its place."""
    scene = fcd(tmp_path)
    about = (tmp_path / "fcd.xml").read_text()
    (tmp_path / "fcd.xml").write_text(about.replace('y="0" angle="0"', 'y="0"'))
    scene.write_text(SCENE.replace(*change))
    with pytest.raises(ScenarioError, match=said) as refused:
        load(scene)
    assert "swarm.street.flight" in str(refused.value)
