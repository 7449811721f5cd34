"""Targets with several scattering centres: 3GPP's tables, samples, and one track."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import yaml
from street_scene import (
    OVER_GROUND,
    OWN,
    echo_amplitude,
    error_of,
    over_ground,
    samples_of,
    scene,
    sum_over_points,
)
from truths.moving import echo_over

import isac_rt as irt
from isac_rt.extensions.street.centres import MovingCentres, body_axes
from isac_rt.extensions.street.extent import KINDS, fixed_of, of_several
from isac_rt.extensions.street.walker import walker_of_flight
from isac_rt.frame.antennas import Antennas, Arrays
from isac_rt.propagation.pathset import PathKind
from isac_rt.propagation.rcs import CrossSection
from isac_rt.receive.types import Detections
from isac_rt.track.tracker import spread
from isac_rt.world.settings import Extent, Rcs, Uav
from isac_rt.world.swarm import Pose, Swarm

PEDESTRIAN, VEHICLE = ({"extent": {"kind": kind}} for kind in ("pedestrian", "vehicle"))
# TR 38.901 v19 tables 7.9.2.1-5 and -7: g_max, sigma_max of each point
PRINTED = {
    "vehicle": [(20.60, 20.52), (13.90, 13.82), (20.60, 20.52), (14.99, 14.91), (21.12, 21.05)],
    "agv": [(13.00, 30.26), (7.27, 24.53), (10.98, 28.24), (7.27, 24.53), (11.77, 29.03)],
}


@pytest.mark.parametrize("kind", PRINTED)
def test_lobes_of_several_points_are_those_printed(kind):
    """Tables -5 and -7 from -4 and -6. Planted bugs: `len(lobes)` for `len(lobes) - 1`; 20 lg n."""
    for lobe, (peak, depth) in zip(of_several(KINDS[kind].lobes), PRINTED[kind], strict=True):
        assert lobe.peak == pytest.approx(peak, abs=0.02)
        assert lobe.depth == pytest.approx(depth, abs=0.03)


def test_centres_lie_on_the_faces_that_their_lobes_leave():
    """Planted bug: left and right exchanged in `_outward`."""
    vehicle = fixed_of(Extent(kind="vehicle"), 1, "V")
    assert vehicle.places.tolist() == [
        [-1.0, 0.0, 0.0],
        [0.0, -2.5, 0.0],
        [1.0, 0.0, 0.0],
        [0.0, 2.5, 0.0],
        [0.0, 0.0, 0.8],
    ]
    for place, section in zip(vehicle.places, vehicle.sections, strict=True):
        towards = place / np.linalg.norm(place)
        zenith, azimuth = np.radians(section.lobe.zenith), np.arctan2(-towards[0], towards[1])
        peak = [-np.sin(azimuth), np.cos(azimuth), 0] @ np.diag([np.sin(zenith)] * 2 + [0])
        peak[2] = np.cos(zenith)
        assert section._mean_db(peak, np.zeros(())) == pytest.approx(section.lobe.peak)


def test_samples_are_the_sum_over_centres_that_turn():
    """Against the places at every sample of two points on a UAV that yaws by 230 degrees a second
    in flight. Planted bugs: `spin` of the opposite sign; `turn` backwards; the UAV's echo kept."""
    spin, start = np.radians(230.0), np.radians(20.0)
    times = np.linspace(-0.2, 0.4, 13)
    way = [
        {
            "time_s": float(t),
            "position_m": [1.0 + 2.0 * float(t), 8.0 - 3.0 * float(t), 1.5],
            "attitude_deg": [float(np.degrees(start + spin * t)), 0.0, 0.0],
        }
        for t in times
    ]
    places = np.array([[0.4, -0.7, 0.1], [-0.2, 0.9, 0.0]])
    stated = [{"position_m": p.tolist(), "value_dbsm": -3.0} for p in places]
    s = scene(
        {"waypoints": way, "extent": {"kind": "centres", "centres": stated}}
        | {"rcs": {"model": "constant", "value_dbsm": 0.0}}
    )
    setup = irt.prepare(s)
    frame = setup.frame(1)

    def on_body(t):
        yaw, zero = start + spin * t, 0 * t
        axes = [
            np.stack([np.cos(yaw), -np.sin(yaw), zero], axis=1),
            np.stack([np.sin(yaw), np.cos(yaw), zero], axis=1),
            np.stack([zero, zero, zero + 1], axis=1),
        ]
        middle = np.stack([1 + 2 * t, 8 - 3 * t, zero + 1.5], axis=1)
        return middle[:, None] + np.einsum("kc,cnd->nkd", places, np.array(axes))

    level = 10 ** (-3 / 20) * echo_amplitude(frame, 1.0)
    truth = sum_over_points(setup, frame, on_body, lambda *_: level * np.ones(2))
    assert error_of(samples_of(setup, frame), truth) < 1e-3


@pytest.mark.parametrize("place", [[1.5, 3.0, 0.8], [-3.0, 5.0, 1.1]])
def test_a_car_near_the_radar_is_the_sum_over_its_faces(place):
    """A body within its own near field: each centre with the lobe, the elements' pattern and the
    spreading of its own direction, 0.05 %. Planted bugs: aspects (0.3) and patterns (1.8) towards
    the middle; spreading over the way to the UAV at that time (0.0009)."""
    s = scene({"position_m": place, "velocity_mps": [0.3, 6.0, 0.0]} | VEHICLE)
    setup = irt.prepare(s)
    frame, car = setup.frame(1), setup.moving_centres.models[0][1]
    epoch, pose, target = frame.paths[OWN].epoch, frame.poses["radar"], frame.poses["T"]
    axes = body_axes(setup.swarm, "T", epoch)

    def places(t):
        way = np.outer(t - epoch, target.velocity)
        return target.position + way[:, None] + car.places @ axes.T

    def amplitudes(_, points):
        back = (pose.position - points) @ axes
        back /= np.linalg.norm(back, axis=2)[..., None]
        each = [of.square_metres(back[:, k], back[:, k]) for k, of in enumerate(car.sections)]
        return level * np.sqrt(np.stack(each, axis=1))

    middle = (pose.position - target.position) @ axes
    middle /= np.linalg.norm(middle)
    level = echo_amplitude(
        frame, float(setup.reference.sections["T"].square_metres(middle, middle))
    )
    truth = sum_over_points(setup, frame, places, amplitudes)
    assert error_of(samples_of(setup, frame), truth) < 5e-4


def test_a_car_between_two_terminals_has_each_faces_own_directions():
    """By the bistatic radar equation: aspect, both ways and the elements' gains at both ends.
    Planted bugs: the transmitter's pattern at both ends; the way there in both spreadings."""
    w, arrays = irt.Waveform(num_chirps=6), Arrays(Antennas(gain=8.0, pattern="cosine"))
    place, ends = np.array([2.0, 4.0, 0.5]), np.array([[0.0, 0.0, 0.0], [6.0, 1.0, 0.8]])
    looks = (0.2, 1.0, 0.0), (-1.0, 0.6, 0.0)
    poses = {n: Pose.at_rest(*at) for n, *at in zip("AB", ends, looks, strict=True)}
    swarm = Swarm({"U": Uav(role="target", position_m=tuple(place))})
    axes, car = body_axes(swarm, "U", 0.0), fixed_of(Extent(kind="vehicle"), 1, "U")
    square_metre = CrossSection(Rcs(model="constant", value_dbsm=0.0), "U", 1)

    def amplitude(point, section):
        length = np.linalg.norm(point - ends, axis=1)
        towards = (point - ends) / length[:, None]
        gain = [arrays.common.element_gain(poses["AB"[i]].to_body(towards[i])) for i in (0, 1)]
        sigma = section.square_metres(*(-towards @ axes)) * np.prod(gain)
        return w.wavelength * np.sqrt(sigma / (4 * np.pi) ** 3) / length.prod()

    echo = replace(echo_over(place, ends), gain=np.array([amplitude(place, square_metre) + 0j]))
    moving = MovingCentres(swarm, {"U": square_metre}, w, arrays, [("U", car)])
    found = moving.with_centres(echo, poses | swarm.poses(0.0), 0.0).gain.reshape(-1, 5)
    centres = zip(place + car.places @ axes.T, car.sections, strict=True)
    assert found[0] == pytest.approx([amplitude(*one) for one in centres], rel=1e-9)


def test_limbs_over_the_ground_are_the_sum_over_images_at_every_sample():
    """Four paths to each of 128 points of a pedestrian 4 m away, 0.05 %. Planted bugs: `mirror` of
    one end for both; the swing of the limbs at time 0 in every frame."""
    walk = {"position_m": [0.5, 4.0, 0.95], "velocity_mps": [0.3, -1.4, 0.0]}
    s = scene(
        walk
        | {"extent": {"kind": "pedestrian"}, "rcs": {"model": "constant", "value_dbsm": -1.37}},
        chirps=6,
    )
    setup = irt.prepare(s)
    frame = setup.frame(1)
    echo = over_ground(frame, -0.8)
    found = samples_of(
        setup, frame, setup.moving_centres.with_centres(echo, frame.poses, echo.epoch)
    )
    walker, person = setup.moving_centres.models[0][1], frame.poses["T"]
    axes = body_axes(setup.swarm, "T", echo.epoch)

    def places(t):
        way = np.outer(t - echo.epoch, person.velocity)
        return person.position + way[:, None] + walker.motion(t).place @ axes.T

    level = echo_amplitude(frame, 1.0) * walker.amplitude.conj() / 10 ** (-1.37 / 20)
    truth = sum_over_points(setup, frame, places, lambda *_: level, OVER_GROUND, -0.8)
    assert error_of(found, truth) < 5e-4


CSV = """right_m, ahead_m, up_m, azimuth_deg, elevation_deg, dbsm, phase_deg
0.1, 0.5, 0, -90, 0, -10, 170
0.1, 0.5, 0, 90, 0, 0, -170
0, -0.5, 0, -90, 0, 3, 0
0, -0.5, 0, 90, 0, 3, 90
"""


def test_centres_from_a_file(tmp_path):
    """Cross-section and phase by the bisector's azimuth, phases over the end of a turn. Planted
    bugs: degrees interpolated; the first centre's phase for all; rows of one centre for all."""
    (tmp_path / "centres.csv").write_text(CSV)
    s = scene({"position_m": [0, 9, 1], "extent": {"kind": "centres", "centres": ONE}})
    tree = s.model_dump(mode="json")
    tree["swarm"]["T"]["extent"] = {"kind": "centres", "file": "centres.csv"}
    (tmp_path / "scene.yaml").write_text(irt.to_yaml(s))
    change = ["swarm.T.extent={kind: centres, file: centres.csv}"]
    fixed = fixed_of(irt.load(tmp_path / "scene.yaml", change).swarm["T"].extent, 1, "T")
    assert fixed.places.tolist() == [[0.1, 0.5, 0.0], [0.0, -0.5, 0.0]]
    ahead, right = np.array([0.0, 1.0, 0.0]), np.array([1.0, 0.0, 0.0])
    middle = np.sqrt(10 ** (np.array([-5.0, 3.0]) / 10)) * np.exp(1j * np.radians([180, 45]))
    assert fixed.amplitudes(ahead, ahead, np.zeros(1))[0] == pytest.approx(middle)
    half = (ahead + right) / np.sqrt(2)
    (aside,) = fixed.amplitudes(ahead, right, np.zeros(1))
    assert aside == pytest.approx(fixed.amplitudes(half, half, np.zeros(1))[0])
    assert abs(aside[0]) == pytest.approx(10 ** (-2.5 / 20))


ONE = [{"position_m": [0, 0, 0], "value_dbsm": 0}]


def test_two_centres_in_one_cell_glint_beyond_the_body():
    """The phase from antenna to antenna points where the closed form of two scatterers says
    (Howard, Radar Target Angular Scintillation, 1959): with amplitudes 1 and a, at sines u_1, u_2,
    (u_1 + a^2 u_2 + a cos(phi) (u_1 + u_2)) / (1 + a^2 + 2 a cos(phi)), phi between their echoes.
    It wanders several lengths of the body out of it. Planted bugs: conjugate phase of centres; one
    centre for both."""
    half, away, a = 0.05, 12.0, 0.9
    outside = 0
    for phase in np.arange(0, 360, 30):
        stated = [
            {"position_m": [x, 0, 0], "value_dbsm": 20 * np.log10(level)} | extra
            for x, level, extra in ((half, 1.0, {}), (-half, a, {"phase_table": constant(phase)}))
        ]
        s = scene(
            {"position_m": [0, away, 1], "boresight": [0, 1, 0]}
            | {"extent": {"kind": "centres", "centres": stated}},
            chirps=3,
        )
        setup = irt.prepare(s)
        cube = samples_of(setup, setup.frame(1))[0, :, 0]
        spectra = np.fft.fft(cube * np.hanning(cube.shape[1]), axis=1)
        cell = spectra[:, np.abs(spectra).sum(axis=0).argmax()]
        antennas, k = setup.arrays.of("radar"), 2 * np.pi / setup.waveform.wavelength
        x = antennas.rx_positions[:, 0]
        found = np.angle(np.vdot(cell[2], cell[1])) / (k * (x[2] - x[1]))
        u = np.array([half, -half]) / away
        sender = antennas.tx_positions[setup.frame(1).sent["radar"].schedule[0, 0], 0]
        between = np.cos(np.radians(phase) - k * (u[0] - u[1]) * (sender + (x[1] + x[2]) / 2))
        share = 1 + a * a + 2 * a * between
        truth = (u[0] + a * a * u[1] + a * between * u.sum()) / share
        assert found == pytest.approx(truth, rel=0.02)
        outside += abs(found) > 4 * half / away
    assert outside == 1


def constant(phase):
    """A table of one phase."""
    return {"azimuth_deg": [0], "elevation_deg": [0], "values_db": [[float(phase)]]}


def test_what_stands_on_the_ground_stays_upright():
    """A UAV that brakes pitches up, a car does not. Planted bug: `stands` turned over."""
    way = [{"time_s": t, "position_m": [0, 10 * t - 2 * t * t, 1]} for t in (0.0, 0.5, 1.0, 1.5)]
    for extent, tilt in ((None, True), ({"kind": "vehicle"}, False)):
        uav = Uav.model_validate({"role": "target", "waypoints": way, "extent": extent})
        axes = body_axes(Swarm({"U": uav}), "U", 0.75)
        assert (axes[1, 2] < -0.2) == tilt


def test_a_pedestrian_walks_at_the_speed_of_the_flight():
    """Planted bugs: `PLACES` for the time between waypoints; the thigh for the leg."""
    uav = Uav(role="target", position_m=(0, 0, 1), velocity_mps=(0, 1.4, 0))
    walker = walker_of_flight(Extent(kind="pedestrian"), Swarm({"P": uav}), 1, "P")
    assert walker.length.size == 128
    assert 2 * np.pi / walker.rate == pytest.approx(1.346 * np.sqrt(0.53 * 1.75 / 1.4))
    assert 100 < 120 * walker.rate / (2 * np.pi) < 120  # steps a minute, as adults walk


def test_a_pedestrian_has_3gpps_cross_section_in_the_mean():
    """|sum of all points|^2 at 77 GHz over aspects within 30 degrees of level and a cycle of steps:
    -1.37 dBsm (TR 38.901, human); and level with 40 of them, for a trunk is the same from all
    sides there. Planted bugs: no phases (12 dB level with it); phases of each frame."""
    uav = Uav(role="target", position_m=(0, 0, 1), velocity_mps=(0, 1.4, 0))
    swarm, k = Swarm({"P": uav}), 2 * np.pi * 77e9 / 299792458
    aspects = np.random.default_rng(2)
    means = []
    for seed in range(40):
        walker = walker_of_flight(Extent(kind="pedestrian"), swarm, seed, "P")
        tilt, turn = aspects.uniform(-0.5, 0.5, 300), aspects.uniform(0, 2 * np.pi, 300)
        tilt[:150] = 0
        u = np.stack([np.cos(tilt) * np.sin(turn), np.cos(tilt) * np.cos(turn), np.sin(tilt)])
        time = np.linspace(0, 2 * np.pi / walker.rate, 16, endpoint=False)
        phase = 2 * k * walker.motion(time).place @ u
        sums = (walker.amplitudes(u[:, 0], u[:, 0], time)[:, None] * np.exp(1j * phase)).sum(axis=1)
        means.append((np.abs(sums) ** 2).reshape(16, 2, 150).mean(axis=(0, 2)))
    level, all_round = 10 * np.log10(np.mean(means, axis=0)), 10 * np.log10(np.array(means)[:, 1])
    assert level == pytest.approx([-1.37, -1.37], abs=0.5)
    assert np.abs(all_round + 1.37).max() < 1.5
    again = walker_of_flight(Extent(kind="pedestrian"), swarm, 39, "P")
    assert (again.amplitude == walker.amplitude).all()


@pytest.mark.parametrize(
    ("kind", "dbsm"), [("vehicle", 11.25), ("agv", -4.25), ("uav", -5.85), ("pedestrian", -1.37)]
)
def test_paths_and_scores_have_the_cross_section_of_the_extent(kind, dbsm):
    """Where no `rcs` is stated, also in what a run saves: 3GPP's means over all aspects, within its
    lobes' 1.5 dB; a stated one stays. Planted bug: that of the small UAV."""
    s = scene({"position_m": [0, 9, 1], "extent": {"kind": kind}})
    u = np.random.default_rng(3).standard_normal((4000, 3))
    u /= np.linalg.norm(u, axis=1, keepdims=True)
    for one in (s, irt.load(yaml.safe_load(irt.to_yaml(s)))):
        section = irt.prepare(one).reference.sections["T"]
        assert 10 * np.log10(section.square_metres(u, u).mean()) == pytest.approx(dbsm, abs=1.5)
    for rcs, level in (({"model": "constant", "value_dbsm": 3.0}, 3.0), ({}, None)):
        setup = irt.prepare(scene({"position_m": [0, 9, 1], "extent": {"kind": kind}, "rcs": rcs}))
        frame, towards = setup.frame(1), np.array([0.0, -1.0, 0.0])
        own = setup.reference.sections["T"].square_metres(towards, towards)
        expected = own if level is None else 10 ** (level / 10)
        radar = setup.waveform.wavelength * setup.arrays.common.gain * np.sqrt(expected)
        gain = radar / (4 * np.pi) ** 1.5 / 81
        assert abs(frame.paths[OWN].gain[0]) == pytest.approx(gain, rel=1e-3)


SMALL = {"extent": {"kind": "uav", "size_m": (0.4, 0.4, 0.15)}, "rotors": {}}


@pytest.mark.parametrize(
    ("body", "place", "speed", "size"),
    [
        ({"extent": {"kind": "vehicle"}}, (2, 22, 1), 3, 6.0),
        ({"extent": {"kind": "pedestrian"}}, (1, 8, 1), 1, 1.0),
        ({"extent": {"kind": "agv"}}, (1, 12, 1), 2, 0.6),
        ({"extent": {"kind": "uav"}}, (1, 8, 3), 3, 2.0),
        (SMALL, (1, 12, 2), 3, 0.5),
    ],
    ids=["vehicle", "pedestrian", "agv", "uav", "rotors"],
)
def test_a_target_with_extent_is_one_track(body, place, speed, size):
    """Regression: of 20 frames, and of the vehicle three tracks as a point. Planted bugs: each
    centre at ten times its place; all detections kept; `spread` by nothing."""
    target = {"position_m": place, "velocity_mps": (0, -speed, 0)} | body
    points = scene(target, frames=20, chirps=96)
    tree = points.model_dump(mode="json") | {"tracking": {"target_size_m": size}}
    run = irt.run(type(points).model_validate(tree), progress=False, snapshots=0)
    tracks = tracks_by_frame(run.dataset)
    assert tracks.tolist()[5:] == [1] * 15
    assert tracks.max() == 1
    assert run.summary["terminals"]["radar"]["false_tracks_per_frame"] == 0
    if size > 5:
        assert tracks_by_frame(irt.run(points, progress=False, snapshots=0).dataset).max() > 2


@pytest.mark.parametrize(("place", "speed"), [((2, 22, 1), 3), ((-3, 9, 1), 4)])
def test_detections_of_a_cars_parts_are_its_own(place, speed):
    """As its faces are cells apart, its own path explains a third of them. Planted bug: paths as
    they are drawn."""
    flight = {"position_m": place, "velocity_mps": (0, -speed, 0)}
    run = irt.run(scene(flight | VEHICLE, frames=4, chirps=96), progress=False, snapshots=0)
    kinds = run.dataset.det_kind.values
    assert len(kinds) >= 8 and (kinds == PathKind.TARGET).all()
    assert run.summary["terminals"]["radar"]["false_per_frame"] == 0


@pytest.mark.parametrize(
    ("target", "size"),
    [
        ({"position_m": (1, 15, 1), "velocity_mps": (0, -1.4, 0)} | PEDESTRIAN, 1.0),
        ({"position_m": (-3, 20, 1), "velocity_mps": (1.4, -0.2, 0)} | PEDESTRIAN, 1.0),
        ({"position_m": (1, 20, 3), "velocity_mps": (0, -3, 0), "extent": {"kind": "uav"}}, 2.0),
        ({"position_m": (-8, 30, 1), "velocity_mps": (8, -6, 0)} | VEHICLE, 6.0),
    ],
    ids=["walks up", "walks by", "uav", "vehicle"],
)
def test_parts_that_move_start_no_second_track(target, size):
    """40 frames, three seeds. Planted bugs: exact velocities (half of the frames of who walks up);
    the stated deviations in `strongest` (a third of the frames of the UAV)."""
    second = []
    for seed in (1, 2, 3):
        s = scene(target, frames=40, chirps=96)
        tree = s.model_dump(mode="json") | {"tracking": {"target_size_m": size}, "seed": seed}
        run = irt.run(type(s).model_validate(tree), progress=False, snapshots=0)
        second.append(tracks_by_frame(run.dataset)[5:] > 1)
    assert np.mean(second) < 0.06


def test_parts_deviate_by_place_and_swing():
    """Of a point that swings through a target: E[v^2] = E[x^2]^1/2 E[a^2]^1/2, over two legs twice
    as much. Planted bugs: `size` for its deviation; one leg for two."""
    size, a = 0.9, 2.5
    t = np.linspace(0, 2 * np.pi, 400, endpoint=False)
    x_rms = size / np.sqrt(12)
    omega = np.sqrt(a / x_rms)
    swing = np.sqrt(2) * x_rms * omega * np.cos(t)
    one = Detections(
        range=np.array([4.0]),
        velocity=np.zeros(1),
        direction=np.zeros((1, 2)),
        snr=np.ones(1),
        std=np.array([[0.3, 0.4, 0.01, 0.02]]),
        is_reference=np.zeros(1, bool),
        starts=np.ones(1, bool),
    )
    for legs in (1, 2):
        found = spread(one, size, a, legs)[0]
        assert found[0] == pytest.approx(np.hypot(0.3, legs * x_rms))
        assert found[1] == pytest.approx(np.hypot(0.4, legs * swing.std()))
        assert found[2:] == pytest.approx(np.hypot([0.01, 0.02], x_rms / 4))


def tracks_by_frame(dataset):
    """Confirmed tracks in each frame."""
    confirmed = dataset.track_confirmed.values.astype(bool)
    return np.bincount(dataset.track_frame.values[confirmed], minlength=dataset.sizes["frame"])


@pytest.mark.parametrize(
    ("extent", "message"),
    [
        ({"kind": "centres"}, "go with kind centres"),
        ({"kind": "uav", "centres": [{"position_m": [0, 0, 0], "value_dbsm": 0}]}, "go with kind"),
        (
            {"kind": "centres", "size_m": [1, 1, 1]}
            | {"centres": [{"position_m": [0, 0, 0], "value_dbsm": 0}]},
            "remove it",
        ),
    ],
)
def test_refused(extent, message):
    """Planted bug: `==` for `!=` in `Extent.problems`."""
    with pytest.raises(ValueError, match=message):
        scene({"position_m": [0, 9, 1], "extent": extent})
