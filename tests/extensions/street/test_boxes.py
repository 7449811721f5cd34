"""Boxes that move: their mirrors against a trace anew in every chirp, their shadows against Fresnel
integrals at each instant."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from fake_run import fake_run
from matplotlib.figure import Figure
from scipy.integrate import quad
from scipy.special import fresnel

import isac_rt as irt
from isac_rt.document import ScenarioError
from isac_rt.extensions.street.boxes import Boxes
from isac_rt.frame.antennas import Antennas, Arrays
from isac_rt.frame.link import Link
from isac_rt.frame.waveform import SPEED_OF_LIGHT, Waveform
from isac_rt.propagation.free_space import FreeSpace
from isac_rt.propagation.pathset import PathKind
from isac_rt.runtime import UserError
from isac_rt.simulation.simulate import _with_boxes
from isac_rt.views.figures import scene_map
from isac_rt.views.scene import moving_scene, scene_3d
from isac_rt.world.city.mesh import empty_city
from isac_rt.world.settings import Box, Uav, Waypoint
from isac_rt.world.swarm import Swarm

WAVEFORM = Waveform()
WAVELENGTH = WAVEFORM.wavelength
HALF = WAVEFORM.frame_duration / 2
LINK, OWN = Link("AT", "PT"), Link("AT", "AT")
POINT = Arrays(Antennas(tx_x=1, tx_z=1, rx_x=1, rx_z=1, spacing=0.0, gain=1.0))


def box_of(size=(0.4, 8.0, 5.0), material="metal", **flight):
    return Uav(role="target", box=Box(size_m=size, material=material), **flight)


def turning(yaw_deg, places=((3.0, 9.0, 2.0), (3.4, 9.2, 2.1), (3.9, 9.3, 2.2)), tilt=1.0):
    """A box on three waypoints, with their yaw and some pitch and roll."""
    points = [
        Waypoint(time_s=t, position_m=p, attitude_deg=(yaw, 2 * tilt * t, -3 * tilt * t))
        for t, p, yaw in zip((0.0, 0.5, 1.0), places, yaw_deg, strict=True)
    ]
    return box_of(waypoints=points)


def stage(box, at=(-9.0, 3.0, 2.5), pt=(-8.0, 14.0, 1.5), velocities=((1, 0.5, 0), (0, -1, 0.2))):
    uavs = {
        "AT": Uav(role="active", position_m=at, velocity_mps=velocities[0]),
        "PT": Uav(role="passive", position_m=pt, velocity_mps=velocities[1]),
        "box": box,
    }
    swarm = Swarm(uavs, 1.0)
    free = FreeSpace(uavs, POINT, WAVELENGTH, 3)
    return swarm, Boxes(swarm, {}, free, free, WAVEFORM, None)


def paths_at(swarm, model, epoch, link=LINK):
    return model.trace(swarm.poses(epoch), epoch, [link]).paths[link]


def mirrors(swarm, model, epoch, link=LINK):
    paths = paths_at(swarm, model, epoch, link)
    return paths.select(paths.kind == PathKind.SPECULAR)


def face_at(swarm, t):
    """Corners of the face to the left, in order."""
    pose, half = swarm.trajectories["box"].pose(t), np.array(swarm.uavs["box"].box.size_m) / 2
    signs = np.array([(-1, -1, -1), (-1, 1, -1), (-1, 1, 1), (-1, -1, 1)])
    return pose.position + (signs * half) @ pose.rotation.T


def traced_anew(swarm, t, link=LINK):
    """Length over the plane of the face at an instant, and whether its point is on the face."""
    corners = face_at(swarm, t)
    normal = np.cross(corners[1] - corners[0], corners[3] - corners[0])
    normal /= np.linalg.norm(normal)
    first, last = (swarm.trajectories[name].pose(t).position for name in link)
    heights = [normal @ (end - corners[0]) for end in (first, last)]
    length = np.sqrt(((first - last) ** 2).sum() + 4 * heights[0] * heights[1])
    feet = [end - h * normal for end, h in zip((first, last), heights, strict=True)]
    point = (feet[0] * heights[1] + feet[1] * heights[0]) / (heights[0] + heights[1])
    sides = np.roll(corners, -1, axis=0) - corners
    inside = (np.cross(sides, point - corners) @ normal > 0).all()
    return length, inside and heights[0] * heights[1] > 0


@pytest.mark.parametrize(("link", "yaw"), [(LINK, 0.0), (OWN, -40.0)])
def test_a_moving_wall_is_traced_anew_in_every_chirp(link, yaw):
    """Delays over the frame to 1e-6 wavelengths; the wall moves and turns. Planted bugs: `rise`
    without `turn @ place`; `rise * turn` once; the wall at rest."""
    steady = ((3.0, 9.0, 2.0), (3.4, 9.2, 2.1), (3.8, 9.4, 2.2))
    swarm, model = stage(turning((yaw, yaw + 2, yaw + 4), steady, 0.0))
    path = mirrors(swarm, model, 0.4, link)
    assert len(path) == 1
    times = WAVEFORM.chirp_time[0] + WAVEFORM.window_start - HALF
    anew = np.array([traced_anew(swarm, 0.4 + t, link)[0] for t in times])
    ours = path.delay + path.delay_rate * times + path.delay_accel * times**2 / 2
    assert ours * SPEED_OF_LIGHT == pytest.approx(anew, abs=1e-6 * WAVELENGTH, rel=0)
    assert path.tx_radius == pytest.approx(path.delay * SPEED_OF_LIGHT)


@pytest.mark.parametrize(("link", "yaw"), [(LINK, 0.0), (OWN, -40.0)])
def test_a_wall_that_speeds_up_has_its_rate_and_acceleration(link, yaw):
    """Differences of lengths; the wall turns about all axes, ever faster. Planted bugs: no `accel`
    in `twist`; no `spin x turn` in it; `normal @ acceleration` left out."""
    swarm, model = stage(turning((yaw, yaw + 2, yaw + 5)))
    path, h = mirrors(swarm, model, 0.4, link), 1e-3
    before, now, after = (traced_anew(swarm, 0.4 + t, link)[0] for t in (-h, 0, h))
    rate, accel = path.delay_rate[0] * SPEED_OF_LIGHT, path.delay_accel[0] * SPEED_OF_LIGHT
    assert path.delay[0] * SPEED_OF_LIGHT == pytest.approx(now, abs=1e-12)
    assert rate == pytest.approx((after - before) / (2 * h), abs=2e-6)
    assert accel == pytest.approx((after - 2 * now + before) / h**2, abs=1e-5)


def test_directions_lead_to_the_point_of_reflection():
    """Planted bug: the departure of the image, not mirrored."""
    swarm, model = stage(turning((0.0, 2.0, 5.0)))
    path, poses = mirrors(swarm, model, 0.4), swarm.poses(0.4)
    for name, direction in (("AT", path.departure[0]), ("PT", path.arrival[0])):
        to = path.points[0, 0] - poses[name].position
        assert direction == pytest.approx(to / np.linalg.norm(to), abs=1e-12)


@pytest.mark.parametrize("material", ["metal", "concrete"])
def test_faces_reflect_by_fresnel(material):
    """A wall upright before vertical elements: TE. Planted bug: `tm, te`."""
    swarm, model = stage(
        box_of(material=material, position_m=(3.2, 9.0, 2.0), boresight=(0, 1, 0)),
        at=(-5.0, 6.0, 2.0),
        pt=(-5.0, 12.0, 2.0),
    )
    path = mirrors(swarm, model, 0.0)
    # 8 m to the face, 6 m along it
    cosine, length = 8 / np.hypot(8, 3), 2 * np.hypot(8, 3)
    f = WAVEFORM.carrier_frequency
    eps, sigma = {"metal": (1, 1e7), "concrete": (5.24, 0.0462 * (f / 1e9) ** 0.7822)}[material]
    root = np.sqrt(eps - 1j * sigma / (2 * np.pi * f * 8.8541878128e-12) - 1 + cosine**2)
    mirrored = np.sqrt(1 - {"metal": 0.1, "concrete": 0.3}[material] ** 2)
    expected = mirrored * (cosine - root) / (cosine + root) * WAVELENGTH / (4 * np.pi * length)
    # the sign is that of the elements' fields, vertical at both ends
    assert path.gain[0] == pytest.approx(expected, rel=1e-3)


def test_a_mirror_that_turns_away_lives_no_longer():
    """Instants at which a path lives, by its begin and end, against the point on the face at each.
    Planted bugs: lives from -inf to inf; no ends' heights in the margin; `half` for the whole
    frame."""
    swarm, model = stage(turning((-25.0, 0.0, 25.0)))
    edges = 0
    for epoch in (0.05, *np.arange(0.12, 0.15, 2 * HALF), 0.4, *np.arange(0.74, 0.77, 2 * HALF)):
        paths = mirrors(swarm, model, epoch)
        times = np.linspace(-HALF, HALF, 41)
        ours = [any((paths.begin <= t) & (t < paths.end)) for t in times]
        anew = [traced_anew(swarm, epoch + t)[1] for t in times]
        # the other faces are turned to none of both ends
        assert np.sum(np.array(ours) != anew) <= 1
        edges += np.isfinite([paths.begin, paths.end]).sum()
    assert edges == 2


def knife(nu):
    """Amplitude beyond an edge at nu: scipy's Fresnel integrals."""
    s, c = fresnel(nu)
    return np.hypot(0.5 - c, 0.5 - s) / np.sqrt(2)


def test_the_edge_of_a_moving_shadow_is_a_static_knife_edge_at_each_instant():
    """A wall 60 m long that slides into a path at 15 m/s. Planted bugs: the unit at the box's far
    end; the box a frame late."""
    speed, seen = 15.0, []
    # its front edge crosses the path, 20 m from either end, at 0.5 s
    wall = box_of((0.1, 60.0, 60.0), position_m=(0, -30 - 7.5, 0), velocity_mps=(0, speed, 0))
    ends = {"at": (-20.0, 0, 0), "pt": (20.0, 0, 0), "velocities": ((0, 0, 0), (0, 0, 0))}
    swarm, model = stage(wall, **ends)
    friis = WAVELENGTH / (4 * np.pi * 40)
    for epoch in 0.5 + np.linspace(-0.024, 0.1, 32):
        height = speed * (epoch - 0.5)
        nu = height * np.sqrt(2 * 40 / (WAVELENGTH * 20 * 20))
        paths = paths_at(swarm, model, epoch)
        line = np.abs(paths.gain[paths.kind == PathKind.LINE_OF_SIGHT][0]) / friis
        seen.append((nu, line, knife(nu)))
    nu, ours, static = np.array(seen).T
    assert nu[0] < -2 and nu[-1] > 10
    assert ours == pytest.approx(static, abs=3e-3)  # three edges 30 m away


@pytest.mark.parametrize(
    ("at", "pt", "before", "spans"),
    [
        ((0, -12.0, 0), (0, 18.0, 0), 12.1, ((-0.6, 1.2), (-0.35, 1.15))),
        ((0, 0, 18.0), (0, 0, -12.0), 17.6, ((-0.6, 1.2), (-0.4, 0.6))),
    ],
)
def test_a_car_is_four_edges_at_once(at, pt, before, spans):
    """Against Kirchhoff's integral over the rectangle, by quadrature, along a street and from
    above. Planted bug: the sum of both sides' edges for their product."""
    car = box_of((1.8, 1.0, 1.5), position_m=(0.3, 0.1, 0.4), boresight=(0, 1, 0))
    swarm, model = stage(car, at=at, pt=pt, velocities=((0, 0, 0), (0, 0, 0)))
    unit = np.sqrt(WAVELENGTH * before * (30 - before) / (2 * 30))

    def integral(low, high):
        parts = (np.cos, lambda x: -np.sin(x))
        real, imag = (
            quad(lambda t, f=f: f(np.pi * t * t / 2), low / unit, high / unit, limit=400)[0]
            for f in parts
        )
        return real + 1j * imag

    factor = 1 - 0.5j * integral(*spans[0]) * integral(*spans[1])
    paths = paths_at(swarm, model, 0.0)
    line = paths.gain[paths.kind == PathKind.LINE_OF_SIGHT][0] * 4 * np.pi * 30 / WAVELENGTH
    assert line == pytest.approx(factor, abs=1e-9)


def test_a_tram_beside_a_terminal_hides_nothing_across_the_street():
    """The part behind the terminal is no screen. Planted bug: the extent of all corners."""
    tram = box_of((2.5, 30.0, 3.5), position_m=(3.3, 6.0, 0), boresight=(0, 1, 0))
    swarm, model = stage(tram, at=(0, 0, 0), pt=(-20.0, 20.0, 0))
    paths = paths_at(swarm, model, 0.0)
    line = np.abs(paths.gain[paths.kind == PathKind.LINE_OF_SIGHT][0])
    assert line == pytest.approx(WAVELENGTH / (4 * np.pi * np.hypot(20, 20)), rel=0.02)


def test_a_box_hides_others_and_not_its_own_echo():
    """Planted bug: `owner` of nobody."""
    uavs = {
        "AT": Uav(role="active", position_m=(0, 0, 1)),
        "behind": Uav(role="target", position_m=(1, 30, 1)),
        "box": box_of((2.0, 4.0, 3.0), position_m=(0.2, 15, 1), boresight=(0, 1, 0)),
    }
    free, swarm = FreeSpace(uavs, POINT, WAVELENGTH, 3), Swarm(uavs, 1.0)
    model = Boxes(swarm, {}, free, free, WAVEFORM, None)
    ours, alone = (m.trace(swarm.poses(0.0), 0.0, [OWN]).paths[OWN].gain[:2] for m in (model, free))
    loss = np.abs(ours / alone)
    assert loss[1] == 1.0 and loss[0] < 0.05


def test_bad_boxes_are_refused_with_their_key():
    with pytest.raises(UserError, match=r"swarm.box.box.material: .*marzipan.*known are"):
        stage(box_of(material="marzipan", position_m=(0, 0, 0)))
    scene = Path(__file__).parents[3] / "scenes" / "quadcopter.yaml"
    with pytest.raises(ScenarioError, match=r"radar.box.*: is for targets"):
        irt.load(scene, ["swarm.radar.box={size_m: [1, 2, 1]}"])


def test_a_car_hides_a_pedestrian_and_flashes():
    """The scene: the echo falls by 30 dB and more behind the car, whose side mirrors the radar.
    Planted bug: the shadow of one of both ways."""
    scene = Path(__file__).parents[3] / "scenes" / "street_traffic.yaml"
    setup = irt.prepare(irt.load(scene))
    level, flash = [], []
    for frame in (2, 10, 18):
        paths = setup.find(frame)[1]["radar", "radar"]
        level.append(paths.power[paths.target == paths.target_names.index("pedestrian")].max())
        over = (paths.kind == PathKind.SPECULAR) & (paths.faces < 0).all(axis=1)
        flash.append(paths.delay[over].tolist())
    assert 1e-5 * level[0] > level[1] < 1e-5 * level[2]
    assert flash[0] == flash[2] == []
    assert flash[1] == pytest.approx([2 * (9.1 - 3.6 - 0.9) / SPEED_OF_LIGHT])


def test_figures_draw_the_box_where_it_is():
    """Corners by hand: 6 m ahead along the course, 2 m beside it, in the map, the page and the
    scene of a run. Planted bugs: width and length exchanged; the box of the last frame in all."""
    course = np.array([0.6, 0.8, 0.0])
    car = box_of((2.0, 6.0, 1.0), position_m=(5, 3, 0.5), velocity_mps=tuple(10 * course))
    run, city = fake_run(), empty_city("", np.zeros(3))
    uavs = {name: Uav(role="active", position_m=(0, 0, 5)) for name in ("AT", "PT1")}
    swarm = Swarm({**uavs, "U1": car}, 1.0)
    dataset = _with_boxes(run.dataset, swarm)
    assert "box" not in run.dataset.variables
    time, beside = run.dataset.time.values[4], np.array([0.8, -0.6, 0.0])
    corners = [
        np.array([5, 3, 0.5]) + 10 * course * time + 3 * a * course + b * beside + [0, 0, 0.5 * c]
        for a in (-1, 1)
        for b in (-1, 1)
        for c in (-1, 1)
    ]
    figure = moving_scene(dataset, city)
    drawn = next(t for t in figure["frames"][4]["data"] if t["name"] == "boxes")
    still = next(t for t in scene_3d(city, swarm, [0.0], time, {}).data if t.name == "boxes")
    for found in ([drawn[a] for a in "xyz"], [still[a] for a in "xyz"]):
        apart = np.linalg.norm(np.transpose(found)[:, None] - corners, axis=2)
        assert apart.min(axis=0).max() < 0.01 and apart.shape == (8, 8)
    outline = scene_map(Figure().subplots(), dataset.isel(frame=slice(5))).patches[0].get_xy()
    near = np.linalg.norm(outline[:, None] - np.array(corners)[:, :2], axis=2).min(axis=1)
    assert near.max() < 1e-6 and len(outline) >= 5
