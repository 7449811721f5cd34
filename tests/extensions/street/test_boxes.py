"""Boxes that move: their mirrors against a trace anew in every chirp, their shadows against Fresnel
integrals at each instant."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from fake_run import fake_run
from matplotlib.figure import Figure
from scipy.integrate import quad
from scipy.special import fresnel
from truths.cars import (
    HALF,
    LINK,
    OWN,
    POINT,
    WAVEFORM,
    WAVELENGTH,
    box_of,
    echoes_over,
    mirrors,
    paths_at,
    stage,
    stage_with_uav,
    traced_anew,
    turning,
)

import isac_rt as irt
from isac_rt.document import ScenarioError
from isac_rt.extensions.street.boxes import Boxes
from isac_rt.extensions.street.shadows import STEP, _with_reflections
from isac_rt.frame.waveform import SPEED_OF_LIGHT
from isac_rt.propagation.free_space import FreeSpace
from isac_rt.propagation.pathset import PathKind
from isac_rt.runtime import UserError
from isac_rt.simulation.simulate import _with_boxes
from isac_rt.views.figures import scene_map
from isac_rt.views.scene import moving_scene, scene_3d
from isac_rt.world.city.mesh import empty_city
from isac_rt.world.settings import Uav
from isac_rt.world.swarm import Swarm

SCENES = Path(__file__).parents[3] / "scenes"


@pytest.fixture(scope="module")
def traffic():
    return irt.prepare(irt.load(SCENES / "street_traffic.yaml"))


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


@pytest.mark.parametrize("link", [LINK, OWN])
def test_a_uav_in_a_side_echoes_by_the_radar_equation(link):
    """Over the side before, behind and both; metal scatters a hundredth. Planted bugs: `to.length`
    twice; no `factor` of either way."""
    swarm, model = stage_with_uav()
    over = echoes_over(swarm, model, 0.4, link)
    assert over.bounces.tolist() == [1, 1, 2]
    radar = WAVELENGTH / (4 * np.pi) ** 1.5 / (over.tx_radius * over.rx_radius)
    assert np.abs(over.gain) == pytest.approx(radar * (1 - 0.01) ** (over.bounces / 2), rel=0.05)


def test_points_of_reflection_move_with_both_ends():
    """Two walls in turn by images, differences over 1 ms; a UAV on the way is where it is. Planted
    bugs: the shares of both rays exchanged; one sweep."""
    ends = np.array([[4.0, -3, 1], [6.0, 9, 2]]), np.array([[9.0, 4, -2], [-5.0, 7, 3]])
    walls = np.array([[-1.0, 0, 0], [0.6, 0.8, 0]]), np.array([5.0, 12.0])  # n x = d

    def points(t):
        first, last = ends[0] + ends[1] * t
        images = [first]
        for n, d in zip(*walls, strict=True):
            images.append(images[-1] - 2 * (n @ images[-1] - d) * n)
        out = [last]
        for n, d, image in zip(walls[0][::-1], walls[1][::-1], images[::-1], strict=False):
            share = (d - n @ image) / (n @ (out[0] - image))
            out.insert(0, image + share * (out[0] - image))
        return np.array([first, *out])

    h, now = 1e-4, points(0.0)
    velocity = np.zeros((1, 4, 3))
    velocity[0, [0, 3]] = ends[1]
    found = _with_reflections(now[None], velocity, np.array([[False, True, True, False]]))
    assert found[0] == pytest.approx((points(h) - points(-h)) / (2 * h), abs=1e-5)


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
    scene = SCENES / "quadcopter.yaml"
    with pytest.raises(ScenarioError, match=r"radar.box.*: is for targets"):
        irt.load(scene, ["swarm.radar.box={size_m: [1, 2, 1]}"])


def test_a_car_hides_a_pedestrian_and_flashes(traffic):
    """The scene: the echo falls by 30 dB and more behind the car, whose side mirrors the radar.
    Planted bug: the shadow of one of both ways."""
    setup = traffic
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
    objects = dataset.assign(role=("uav", ["object", *dataset.role.values[1:]]))
    named = {text.get_text() for text in scene_map(Figure().subplots(), objects).texts}
    assert named - {""} == set(dataset.uav.values[1:])


def test_the_plan_counts_what_boxes_do(traffic):
    """Two frames of the scene: in the first the car flashes, and hides the pedestrian, seen on five
    paths, and the wall across. Planted bug: the counts of the last frame."""
    setup = traffic
    frames = [setup.find(frame) for frame in (9, 19)]
    (row,) = setup.boxes.report(frames)
    assert row["modelled"].startswith("3 paths a frame shadowed")
    assert row["modelled"].endswith("0.5 over faces")


def test_limbs_fade_as_the_path_to_them(traffic):
    """In a frame in which the car's edge passes before the pedestrian: the factor at each piece,
    of the pedestrian's own path. Planted bugs: the row of another path; the frame's middle in all
    pieces."""
    frame, when = traffic.frame(8), traffic.timetable.epoch(8)
    paths, every = frame.paths["radar", "radar"], traffic.moving_centres
    moving = replace(every, models=[m for m in every.models if m[0] == "pedestrian"])
    shadows = traffic.boxes.shadows(paths, frame.poses)
    plain, faded = (
        moving.with_centres(paths, frame.poses, when, 0.0, shadow)
        for shadow in (None, shadows.change)
    )
    walker = paths.target_names.index("pedestrian")
    own = np.flatnonzero((paths.target == walker) & (paths.kind == PathKind.TARGET))
    of_walker = (plain.target == walker) & (plain.kind == PathKind.TARGET)
    begin = np.unique(plain.begin[of_walker])
    assert len(begin) > 4
    for first in begin[[1, len(begin) // 2, -2]]:
        row = np.flatnonzero(of_walker & (plain.begin == first))[0]
        t = (first + plain.end[row]) / 2
        path = paths.select(own)
        ratio, now = faded.gain[row] / plain.gain[row], shadows.factor(path)[0]
        assert abs(ratio * now - shadows.factor(path, t)[0]) < STEP
    assert np.ptp(np.abs(faded.gain[of_walker] / plain.gain[of_walker])) > 0.3


@pytest.mark.slow
def test_the_street_has_its_numbers():
    """One seed of the scene: the pedestrian is found where the car does not hide it, and the car's
    two to four tracks are its own and not false."""
    figures = irt.run(irt.load(SCENES / "street_traffic.yaml"), snapshots=0).summary["links"]
    radar = figures["radar->radar"]
    assert radar["in_view"] == 20 and 0.45 <= radar["hit_rate"] <= 0.65
    assert 2 <= radar["object_tracks_per_frame"] < 4.2
    assert radar["false_tracks_per_frame"] < 0.7


@pytest.mark.slow
@pytest.mark.sionna
def test_a_street_with_sumos_traffic_has_its_numbers():
    """Five vehicles and a walker of the file, one seed: most of AT's tracks are of objects,
    and PT1 decodes all. Planted bug: objects' tracks counted as false."""
    scenario = irt.load(SCENES / "traffic_swarm.yaml")
    objects = [name for name, uav in scenario.swarm.items() if uav.role == "object"]
    assert objects == [f"street_{n}" for n in ("bus1", "car1", "car2", "car3", "van1", "walker1")]
    figures = irt.run(scenario, snapshots=0, progress=False).summary["terminals"]
    at, pt = figures["AT"], figures["PT1"]
    assert at["hit_rate"] == pytest.approx(0.75, abs=0.13)
    assert pt["hit_rate"] >= 0.9 and pt["ser_dpsk"] == pt["ser_delay"] == 0
    assert max(at["false_tracks_per_frame"], pt["false_tracks_per_frame"]) < 1.5
    assert at["object_tracks_per_frame"] == pytest.approx(7.6, abs=2)
    assert pt["object_tracks_per_frame"] == pytest.approx(7.4, abs=2)
