"""Rotors: samples against a sum in float64 at every sample, and blades against closed forms."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.integrate import quad
from scipy.special import jv
from truths.moving import echo_over

import isac_rt as irt
from isac_rt.extensions.street import centres
from isac_rt.extensions.street.centres import MovingCentres, remainder
from isac_rt.extensions.street.rotors import Blades, blade_points, blade_section, blades_of
from isac_rt.frame.antennas import Antennas, Arrays
from isac_rt.frame.link import Link
from isac_rt.frame.waveform import SPEED_OF_LIGHT
from isac_rt.propagation.pathset import PathKind, make_paths
from isac_rt.results.provenance import path_content
from isac_rt.scenario.tree import Scenario
from isac_rt.signal.exact import filter_gain
from isac_rt.world.settings import Rotors, Uav
from isac_rt.world.swarm import Pose, Swarm

OWN = Link("radar", "radar")
POINT = Arrays(Antennas(tx_x=1, tx_z=1, rx_x=1, rx_z=1, spacing=0.0))


class Isotropic:
    """Cross-section of one square metre."""

    def square_metres(self, incident, observed):
        return np.ones(incident.shape[:-1])


def scenario(chirps=24, **uav):
    flight = {"position_m": [1.0, 6.0, 1.5], "velocity_mps": [3.0, -4.0, 1.0]}
    return Scenario.model_validate(
        {
            "frames": 2,
            "sensor": "awr1843",
            "radio": {"chirps_per_frame": chirps},
            "receiver_preset": "plain",
            "accuracy": {"preset": "everything"},
            "swarm": {
                "radar": {"role": "active", "position_m": [0, 0, 1], "boresight": [0, 1, 0.1]},
                "Q": {
                    "role": "target",
                    "rcs": {"model": "constant", "value_dbsm": -10},
                    **flight,
                    **uav,
                },
            },
        }
    )


def circling(turning, radius, hub=(0.0, 0.0, 0.0), phase=0.3):
    """One point of a square metre that circles about a hub."""
    one = (np.array([v]) for v in (radius, phase, turning, 1.0))
    return Blades(np.array([hub]), *one)


def slow_time(body, distance, w, receiver=None):
    """Signals of a body's centres `distance` ahead in each slot of a frame about time 0, carrier
    phase included, without that of the body; also the slots' middles, and their pieces."""
    ends = {"A": Pose.at_rest(), "B": Pose.at_rest(receiver or (0, 0, 0))}
    place = np.array([0.0, distance, 0.0])
    swarm = Swarm({"U": Uav(role="target", position_m=tuple(place))})
    positions = np.array([ends["A"].position, ends["B"].position])
    echo = echo_over(place, positions, "A" if receiver is None else "B")
    moving = MovingCentres(swarm, {"U": Isotropic()}, w, POINT, [("U", body)])
    poses = ends | swarm.poses(0.0)
    paths = moving.with_centres(echo, poses, 0.0)
    t = moving.pieces(1, 0.0)[1]
    alive = at_times(paths.select(np.arange(1, len(paths))), t)
    beyond = (alive["delay"] - echo.delay) * w.carrier_frequency
    return (alive["gain"] * np.exp(2j * np.pi * beyond)).sum(axis=1), t, alive


def at_times(pieces, times):
    """Gain, delay [s] and its rate, (T, K) each, of the pieces that live at times (T,)."""
    alive = (pieces.begin <= times[:, None]) & (times[:, None] < pieces.end)
    t, (_, row) = times[:, None], np.nonzero(alive)
    row = row.reshape(times.size, -1)
    rate, accel = pieces.delay_rate[row], pieces.delay_accel[row]
    delay = pieces.delay[row] + (rate + accel * t / 2) * t
    return {"gain": pieces.gain[row], "delay": delay, "rate": rate + accel * t, "row": row}


def synthesised(setup, frame, method):
    """Samples without noise, of the body and with a set-up of rotors of its blades."""
    links, ears = frame._arriving(OWN), frame._listening(OWN)
    return irt.if_signal(setup.waveform, links, *ears, method).samples


def sum_of_points(setup, frame):
    """Samples of the circling points alone, from positions of elements and points at every
    sample."""
    w, uav = setup.waveform, setup.scenario.swarm["Q"]
    rotors, antennas = uav.rotors, setup.arrays.of("radar")
    body = blades_of(rotors, w, setup.scenario.seed, "Q")
    pose = frame.poses["radar"]
    tx = pose.position + pose.to_world(antennas.tx_positions)
    rx = pose.position + pose.to_world(antennas.rx_positions)
    q = frame.poses["Q"]
    forward = np.array([q.velocity[0], q.velocity[1], 0.0])
    forward /= np.linalg.norm(forward)
    right = np.array([forward[1], -forward[0], 0.0])
    schedule = frame.sent["radar"].schedule
    out = np.zeros((1, len(rx), w.num_chirps, w.num_samples), complex)
    middle = setup.timetable.epoch(frame.number)
    gain = frame.paths[OWN].gain[0] * np.sqrt(blade_section(rotors) / 0.1)
    for p in range(w.num_chirps):
        t = p * w.slot_duration + w.fast_time - w.frame_duration / 2
        place = q.position + np.outer(t, q.velocity)
        for k in range(body.radius.size):
            angle = body.phase[k] + body.turning[k] * (t + middle)
            arm = np.sin(angle)[:, None] * right + np.cos(angle)[:, None] * forward
            hub = body.hub[k, 0] * right + body.hub[k, 1] * forward
            point = place + hub + body.radius[k] * arm
            there = np.linalg.norm(point - tx[schedule[0, p]], axis=1)
            near = np.linalg.norm(place - pose.position, axis=1)
            away = np.linalg.norm(point - pose.position, axis=1)
            share = body.amplitude[k] / np.sqrt(blade_section(rotors)) * (near / away) ** 2
            for r, ear in enumerate(rx):
                tau = (there + np.linalg.norm(point - ear, axis=1)) / SPEED_OF_LIGHT
                out[0, r, p] += gain.conj() * share * np.exp(2j * np.pi * w.phase(tau, w.fast_time))
    return out * filter_gain(w, 0.0) * frame.sent["radar"].amplitude


@pytest.mark.parametrize("rev_per_min", [6000.0, 0.0])
def test_samples_are_the_sum_over_points_at_every_sample(rev_per_min):
    """0.05 % of the sum. Planted bugs: `delay_accel` of centres without that of the return;
    `delay` without the term in the square of the slot's time; the blade's places at time 0 in
    every frame; velocity without that of the UAV in `segment`; pieces
    of a hundred times the slots."""
    rotors = {"number": 2, "blade_length_m": 0.05, "arm_m": 0.3, "rev_per_min": rev_per_min}
    rotors["blade_dbsm"] = 10.0  # over the rounding of the body's samples
    setup = irt.prepare(scenario(rotors=rotors))
    frame = setup.frame(1)
    body = irt.prepare(scenario())
    found = synthesised(setup, frame, irt.Direct()) - synthesised(body, body.frame(1), irt.Direct())
    truth = sum_of_points(setup, frame)
    assert np.linalg.norm(found - truth) < 5e-4 * np.linalg.norm(truth)


def test_bistatic_edge_is_two_v_cos_half_beta_over_lambda():
    """Planted bug: `back.rate` left out of `rate`."""
    w = irt.Waveform(num_chirps=300, num_groups=1)
    turning, radius = 2 * np.pi * 6000 / 60, 0.12
    receiver, distance = (2e3, 0.0, 0.0), 1e3
    half = np.arctan2(2e3, 1e3) / 2
    doppler = -slow_time(circling(turning, radius), distance, w, receiver)[2]["rate"]
    doppler *= w.carrier_frequency
    edge = 2 * turning * radius * np.cos(half) / w.wavelength
    assert abs(doppler.max() - edge) < 2e-4 * edge


@pytest.mark.parametrize("blades", [2, 4])
def test_blades_flash_every_share_of_a_turn(blades):
    """A flash every 1/(blades x rev/s). Planted bug: `2 * np.pi` in `blades_of` without 2."""
    w = irt.Waveform(num_chirps=450, num_groups=1)
    rotors = Rotors(number=1, arm_m=0.0, blades=blades, rev_per_min=3000)
    rotors = rotors.model_copy(update={"blade_length_m": 0.03, "blade_dbsm": 0.0})
    signal, t, _ = slow_time(blades_of(rotors, w, 1, "U"), 1e5, w)
    level = np.abs(signal)
    # two blades in line flash at once
    peaks = np.flatnonzero(
        (level > 1.6) & (level >= np.roll(level, 1)) & (level > np.roll(level, -1))
    )
    period = 1 / (blades * 3000 / 60)
    assert peaks.size >= 2
    assert np.abs(np.diff(t[peaks]) - period).max() < 2 * w.slot_duration


def test_a_circling_point_has_bessel_lines(monkeypatch):
    """Line n of a point at radius a has the amplitude J_n(4 pi a/lambda), to 1e-6. Planted bugs:
    sine and cosine exchanged in the velocity alone; `hub` left out of the place."""
    monkeypatch.setattr(centres, "PHASE_ERROR", 0.0)  # pieces of one slot, asked at their middles
    w = irt.Waveform(num_chirps=255, num_groups=1)
    radius, per_frame = 0.01, 1
    turning = 2 * np.pi * per_frame / w.frame_duration
    signal, _, _ = slow_time(circling(turning, radius), 1e6, w)
    lines = np.abs(np.fft.fft(signal))[np.arange(-40, 41) * per_frame] / signal.size
    truth = np.abs(jv(np.arange(-40, 41), 4 * np.pi * radius / w.wavelength))
    assert np.abs(lines - truth).max() < 1e-6


def test_a_blade_of_points_equals_its_integral():
    """At all aspects to 1e-5 of a flash. Planted bug: half the points in `num_points`."""
    length, wave_number = 0.12, 2 * np.pi * 78e9 / SPEED_OF_LIGHT
    place, weight = blade_points(length, wave_number)
    x = np.linspace(-2, 2, 1001) * wave_number * length / 2
    found = np.exp(2j * np.outer(x, place / length)) @ weight
    truth = np.sinc(x / np.pi) * np.exp(1j * x)
    assert np.abs(found - truth).max() < 1e-5
    assert place.size < 1.15 * length / (SPEED_OF_LIGHT / 78e9 / 4)


def test_energy_of_a_turn_is_that_of_the_integral():
    """Mean power of a blade over a turn. Planted bug: `np.sqrt(blade_section(r))` without the
    root."""
    w = irt.Waveform(num_chirps=4095, num_groups=1)
    rate = 60 / w.frame_duration
    rotors = Rotors(number=1, arm_m=0.0, blades=1, blade_length_m=0.03, rev_per_min=rate)
    signal, _, _ = slow_time(blades_of(rotors, w, 1, "U"), 1e5, w)
    k = 2 * np.pi / w.wavelength

    def pattern(angle):
        return np.sinc(k * 0.03 * np.sin(angle) / np.pi) ** 2

    mean = quad(pattern, 0, np.pi / 2, limit=500)[0] / (np.pi / 2)
    assert np.mean(np.abs(signal) ** 2) == pytest.approx(blade_section(rotors) * mean, rel=1e-3)


def test_blades_seen_along_the_axis_only_shift_the_phase_by_spreading():
    """A rotor whose plane lies across the view modulates nothing. Planted bug: `arm` along the
    body's Y and Z."""
    w = irt.Waveform(num_chirps=66, num_groups=1)
    body = circling(2 * np.pi * 100, 0.12)
    ends = {"A": Pose.at_rest()}
    swarm = Swarm({"U": Uav(role="target", position_m=(0, 0, 1e4))})
    echo = make_paths(
        gain=[1.0],
        delay=[2e4 / SPEED_OF_LIGHT],
        departure=[[0, 0, 1]],
        arrival=[[0, 0, 1]],
        kind=PathKind.TARGET,
        target=0,
        points=[[[0, 0, 1e4]]],
        faces=[[-1]],
        tx="A",
        rx="A",
        epoch=0.0,
        target_names=("U",),
    )
    moving = MovingCentres(swarm, {"U": Isotropic()}, w, POINT, [("U", body)])
    pieces = moving.with_centres(echo, ends | swarm.poses(0.0), 0.0)
    assert np.abs(pieces.delay_rate[1:]).max() * w.carrier_frequency < 1e-6
    assert np.ptp(pieces.delay[1:]) * w.carrier_frequency < 1e-3


def test_ghosts_follow_the_centre_over_the_mirror():
    """Delay and direction of an echo by way of a wall, from the radar's image. Planted bugs: the
    mirror left out of the direction; of the image's velocity."""
    w = irt.Waveform(num_chirps=6, num_groups=1)
    radar = Pose(np.zeros(3), np.array([2.0, 5.0, 0.0]), np.zeros(3), np.eye(3))
    uav = np.array([3.0, 20.0, 4.0])
    image = np.array([20.0, 0.0, 0.0])  # over the wall x = 10
    share = (10 - uav[0]) / (image[0] - uav[0])
    hit = uav + share * (image - uav)
    there, back = np.linalg.norm(uav - image), np.linalg.norm(uav)
    swarm = Swarm({"U": Uav(role="target", position_m=tuple(uav))})
    ghost = make_paths(
        gain=[1.0],
        delay=[(there + back) / SPEED_OF_LIGHT],
        departure=[hit / np.linalg.norm(hit)],
        arrival=[uav / back],
        tx_radius=[there],
        rx_radius=[back],
        kind=PathKind.GHOST,
        target=0,
        bounces=1,
        points=[[hit, uav]],
        faces=[[7, -1]],
        tx="A",
        rx="A",
        epoch=0.0,
        target_names=("U",),
    )
    body = circling(2 * np.pi * 50, 0.2)

    def scene_at(t):
        """Places of the image, the point and the radar."""
        angle = 0.3 + 2 * np.pi * 50 * t
        point = uav + 0.2 * np.array([np.sin(angle), np.cos(angle), 0.0])
        return image + radar.velocity * t * [-1, 1, 1], point, radar.velocity * t

    moving = MovingCentres(swarm, {"U": Isotropic()}, w, POINT, [("U", body)])
    paths = moving.with_centres(ghost, {"A": radar} | swarm.poses(0.0), 0.0)
    pieces, time = paths.select(np.arange(1, len(paths))), moving.pieces(1, 0.0)[1]
    for t, delay in zip(time, at_times(pieces, time)["delay"], strict=True):
        mirrored, point, at = scene_at(t)
        way = np.linalg.norm(point - mirrored) + np.linalg.norm(point - at)
        # the path itself is given without rates: what its ends move is in the centre alone
        still = np.linalg.norm(uav - mirrored) + np.linalg.norm(uav - at) - there - back
        assert delay * SPEED_OF_LIGHT == pytest.approx(way - still, abs=1e-7)
    middle = (pieces.begin + pieces.end) / 2 + w.window_start / 2
    for row, t in enumerate(middle):
        mirrored, point, _ = scene_at(t)
        leaves = (point - mirrored) * [-1, 1, 1] / np.linalg.norm(point - mirrored)
        # the direction of the path at the epoch, turned by the centre and the image's motion
        assert pieces.departure[row] == pytest.approx(leaves, abs=1e-5)
        assert pieces.tx_radius[row] == pytest.approx(np.linalg.norm(point - mirrored), abs=1e-3)


def over_ground(frame, middle):
    """Echo of Q from the radar with those by way of the ground, z = 0, which reflects by -0.8."""
    radar, q = (frame.poses[name] for name in ("radar", "Q"))
    images = np.array([radar.position, radar.position * [1, 1, -1]])

    def delay(t):
        ways = np.linalg.norm(q.position + np.multiply.outer(t, q.velocity) - images, axis=-1)
        return (ways[..., :, None] + ways[..., None, :]).ravel() / SPEED_OF_LIGHT

    h = 1e-4
    before, now, after = (delay(t) for t in (-h, 0.0, h))
    away = q.position - images
    share = images[1, 2] / (images[1, 2] - q.position[2])
    hit = images[1] + share * away[1]
    unit = away / np.linalg.norm(away, axis=1)[:, None] * [[1, 1, 1], [1, 1, -1]]
    nowhere = np.full(3, np.nan)
    there, back = np.array([0, 0, 1, 1]), np.array([0, 1, 0, 1])
    points = [
        [hit if a else nowhere, q.position, hit if b else nowhere]
        for a, b in zip(there, back, strict=True)
    ]
    return make_paths(
        gain=1e-6 * (-0.8) ** (there + back),
        delay=now,
        delay_rate=(after - before) / (2 * h),
        delay_accel=(after - 2 * now + before) / h**2,
        departure=unit[there],
        arrival=unit[back],
        tx_radius=np.linalg.norm(away, axis=1)[there],
        rx_radius=np.linalg.norm(away, axis=1)[back],
        kind=np.where(there + back, PathKind.GHOST, PathKind.TARGET),
        target=1,
        bounces=there + back,
        points=points,
        faces=[[a - 1, -1, b - 1] for a, b in zip(there, back, strict=True)],
        tx="radar",
        rx="radar",
        epoch=middle,
        target_names=("radar", "Q"),
    )


def test_ground_multipath_is_the_sum_over_images_at_every_sample():
    """Four paths to each point, 0.05 %. Planted bugs: `mirror` of one end for both; `points[:at]`
    for `points[:at:-1]`; spreading of the way there alone."""
    s = scenario(rotors={"number": 1, "arm_m": 0.1, "blade_length_m": 0.03}, chirps=12)
    setup = irt.prepare(s)
    frame, w, antennas = setup.frame(1), setup.waveform, setup.arrays.of("radar")
    middle = setup.timetable.epoch(1)
    paths = over_ground(frame, middle)
    moving = setup.moving_centres.with_centres(paths, frame.poses, middle)
    links = [(frame.sent["radar"], moving.select(np.arange(4, len(moving))))]
    found = irt.if_signal(w, links, *frame._listening(OWN), irt.Direct()).samples
    radar, q, sent = frame.poses["radar"], frame.poses["Q"], frame.sent["radar"]
    body = blades_of(s.swarm["Q"].rotors, w, s.seed, "Q")
    tx, rx = (
        radar.position + radar.to_world(r) for r in (antennas.tx_positions, antennas.rx_positions)
    )
    section = setup.reference.sections["Q"].square_metres(*2 * [np.array([0.0, 1.0, 0.0])])
    forward = q.velocity * [1, 1, 0] / np.hypot(*q.velocity[:2])
    right = np.array([forward[1], -forward[0], 0.0])
    flip = np.array([[1, 1, 1], [1, 1, -1]])
    truth = np.zeros(found.shape, complex)
    for p, k in np.ndindex(w.num_chirps, body.radius.size):
        t = p * w.slot_duration + w.fast_time - w.frame_duration / 2
        angle = body.phase[k] + body.turning[k] * (t + middle)
        place = q.position + np.outer(t, q.velocity)
        arm = np.outer(np.sin(angle), right) + np.outer(np.cos(angle), forward)
        point = place + body.hub[k, 0] * right + body.hub[k, 1] * forward + body.radius[k] * arm
        level = body.amplitude[k] / np.sqrt(section) * sent.amplitude * 1e-6

        def way(element, image, point=point):
            return np.linalg.norm(point - element * flip[image], axis=1)

        spread = [
            np.linalg.norm(place - radar.position * f, axis=1)
            / np.linalg.norm(point - radar.position * f, axis=1)
            for f in flip
        ]
        for r, a, b in np.ndindex(len(rx), 2, 2):
            tau = (way(tx[sent.schedule[0, p]], a) + way(rx[r], b)) / SPEED_OF_LIGHT
            wave = np.exp(2j * np.pi * w.phase(tau, w.fast_time))
            truth[0, r, p] += level * (-0.8) ** (a + b) * spread[a] * spread[b] * wave
    assert np.linalg.norm(found - truth) < 5e-4 * np.linalg.norm(truth)


def test_blades_far_below_noise_are_left_out():
    """Planted bug: `<` for `>` in `with_centres`."""
    setup = irt.prepare(scenario(rotors={}))
    frame, epoch = setup.frame(0), setup.timetable.epoch(0)
    job = frame.paths[OWN], frame.poses, epoch
    blades = setup.moving_centres.models[0][1].amplitude
    power = frame.paths[OWN].power[0] * (blades**2).sum() / 0.1
    assert len(setup.moving_centres.with_centres(*job, 0.9 * power)) > 1000
    assert len(setup.moving_centres.with_centres(*job, 1.1 * power)) == 1


def test_the_second_order_leaves_out_what_it_says():
    """Planted bug: `half**2` in `remainder`."""
    speed, rate, half = 75.4, 2 * np.pi * 100, 32e-6
    t = np.linspace(-half, half, 101)
    radius = speed / rate
    angle = np.linspace(0, 2 * np.pi, 400)[:, None]
    exact = np.sin(angle + rate * t)
    second = np.sin(angle) + np.cos(angle) * rate * t - np.sin(angle) * (rate * t) ** 2 / 2
    error = 2 * radius * np.abs(exact - second).max() / SPEED_OF_LIGHT
    assert 0.99 < remainder(speed * rate**2, half) / error < 1.01


def test_paths_of_a_frame_are_the_bodys_own():
    """What scores and draws sees no pieces. Planted bug: `with_centres` in `Setup.frame_of`."""
    plain, rotors = (irt.prepare(scenario(rotors=r)).frame(0) for r in (None, {}))
    for name, column in plain.paths[OWN].arrays().items():
        assert np.array_equal(column, rotors.paths[OWN].arrays()[name], equal_nan=True)


def test_traced_paths_are_kept_whatever_the_rotors():
    """A sweep of rotors traces once. Planted bug: `rotors` among what paths depend on."""
    trees = (scenario(rotors=r).model_dump(mode="json") for r in (None, {}, {"rev_per_min": 3000}))
    assert len({path_content(tree, "") for tree in trees}) == 1


@pytest.mark.parametrize(
    ("uav", "said"),
    [
        ({"rotors": {"rev_per_min": 50_000}}, "faster than sound"),
        ({"rotors": {}, "rcs": {"model": "relative"}}, "another rcs.model"),
        ({"rotors": {"blade_length_m": 0}}, "greater than 0"),
    ],
)
def test_refused(uav, said):
    """Planted bug: `>` for `<` in `Rotors.problems`."""
    with pytest.raises(ValueError, match=said):
        scenario(**uav)
