"""Rotors: samples against a sum in float64 at every sample, and blades against closed forms."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.integrate import quad
from scipy.special import jv
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
from isac_rt.document import ScenarioError
from isac_rt.extensions.street import centres, motion
from isac_rt.extensions.street.centres import MovingCentres, remainder
from isac_rt.extensions.street.rotors import (
    PLASTIC,
    Blades,
    blade_points,
    blade_section,
    blades_of,
)
from isac_rt.frame.antennas import Antennas, Arrays
from isac_rt.frame.waveform import SPEED_OF_LIGHT
from isac_rt.propagation.pathset import PathKind, make_paths
from isac_rt.results.provenance import path_content
from isac_rt.simulation import preflight
from isac_rt.world.settings import Rotors, Uav
from isac_rt.world.swarm import Pose, Swarm

POINT = Arrays(Antennas(tx_x=1, tx_z=1, rx_x=1, rx_z=1, spacing=0.0))


class Isotropic:
    """Cross-section of one square metre."""

    def square_metres(self, incident, observed):
        return np.ones(incident.shape[:-1])


def scenario(chirps=24, **uav):
    flight = {"position_m": [1.0, 6.0, 1.5], "velocity_mps": [3.0, -4.0, 1.0]}
    return scene({"rcs": {"model": "constant", "value_dbsm": -10}} | flight | uav, chirps)


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
    t = motion.pieces(w, 1, 0.0)[1]
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


def of_rotors(scenario, frame, mirrors=((1, 1, 1),), loss=1.0):
    """Samples of the points of T's blades alone, by their places at every sample."""
    setup, q = irt.prepare(scenario), frame.poses["T"]
    body = blades_of(scenario.swarm["T"].rotors, setup.waveform, scenario.seed, "T")
    forward = np.array([q.velocity[0], q.velocity[1], 0.0]) / np.hypot(*q.velocity[:2])
    right = np.array([forward[1], -forward[0], 0.0])
    epoch = setup.timetable.epoch(frame.number)

    def places(t):
        angle = body.phase + body.turning * t[:, None]
        arm = np.sin(angle)[..., None] * right + np.cos(angle)[..., None] * forward
        hub = body.hub[:, :1] * right + body.hub[:, 1:2] * forward
        return uav(t)[:, None] + hub + body.radius[:, None] * arm

    def uav(t):
        return q.position + np.outer(t - epoch, q.velocity)

    level = echo_amplitude(frame, 0.1)
    return sum_over_points(setup, frame, places, lambda *_: body.amplitude * level, mirrors, loss)


@pytest.mark.filterwarnings("ignore:.*too near")
@pytest.mark.parametrize(
    ("rev_per_min", "place", "bound"),
    [
        (6000.0, [1.0, 6.0, 1.5], 5e-4),
        (0.0, [1.0, 6.0, 1.5], 5e-4),
        (6000.0, [0.3, 1.0, 1.1], 2.5e-3),
    ],
)
def test_samples_are_the_sum_over_points_at_every_sample(rev_per_min, place, bound):
    """0.05 % of the sum; 0.2 % within reach of the rotors, where they are as far apart as from the
    radar. Planted bugs: `delay_accel` of centres without that of the return; `delay` without the
    term in the square of the slot's time; the blade's places at time 0 in every frame; velocity
    without that of the UAV in `segment`; pieces of a hundred times the slots."""
    rotors = {"number": 2, "blade_length_m": 0.05, "arm_m": 0.3, "rev_per_min": rev_per_min}
    rotors["blade_dbsm"] = 10.0  # over the rounding of the body's samples
    s = scenario(chirps=12, rotors=rotors, position_m=place)
    frame, body = (irt.prepare(x).frame(1) for x in (s, scenario(chirps=12, position_m=place)))
    found = samples_of(frame._setup, frame) - samples_of(body._setup, body)
    assert error_of(found, of_rotors(s, frame)) < bound


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


PLATES = Rotors(number=2, blade_length_m=0.05, chord_m=0.015, rev_per_min=6000.0)


def grid(rotors, angle, lead, hub):
    """Places (..., K, 3) on one flat blade at angles (...), normals (..., 3) and weights (K,)."""
    (along, of_length), (across, of_chord) = map(np.polynomial.legendre.leggauss, (60, 24))
    tilt = np.radians(rotors.incidence_deg)
    turned = np.stack([np.sin(angle), np.cos(angle), 0 * angle], axis=-1)
    ahead = lead * np.stack([np.cos(angle), -np.sin(angle), 0 * angle], axis=-1)
    chord = np.cos(tilt) * ahead + np.sin(tilt) * np.array([0, 0, 1])
    r = rotors.blade_length_m * (1 + along) / 2
    c = rotors.chord_m * across / 2
    places = r[:, None] * turned[..., None, None, :] + c[:, None, None] * chord[..., None, None, :]
    weights = np.multiply.outer(of_chord, of_length).ravel() / 4
    places = places.reshape(*np.shape(angle), -1, 3) + hub
    return places, np.cross(turned, chord), weights


def blades_and_hubs(rotors, body, time):
    """Angle (...), lead and hub of each blade at times (...)."""
    for b in range(rotors.number * rotors.blades):
        where = (b // rotors.blades + 0.5) * 2 * np.pi / rotors.number
        hub = rotors.arm_m * np.array([np.sin(where), np.cos(where), 0]) * (rotors.number > 1)
        start, rotor = body.start[b], b // rotors.blades
        speed = (-1) ** rotor * np.array(rotors.rev_per_min)
        if rotors.phase_deg is not None:
            start = np.radians(rotors.phase_deg[rotor]) + b % rotors.blades * np.pi
            speed = rotors.rev_per_min[rotor]
        spin, lead = np.pi * speed / 30, np.copysign(1, speed)
        yield start + spin * time, lead, hub


def physical_optics(rotors, body, time, u1, u2):
    """Amplitude of all blades at times (...): the integral over each plate by a fine grid."""
    total, k = 0j, body.wave_number
    for angle, lead, hub in blades_and_hubs(rotors, body, np.asarray(time)):
        places, normal, weight = grid(rotors, angle, lead, hub)
        obliquity = (abs(normal @ u1) + abs(normal @ u2)) / 2
        total = total + obliquity * (np.exp(-1j * k * (places @ (u1 + u2))) @ weight)
    area = rotors.blade_length_m * rotors.chord_m
    return total * area * k / np.sqrt(np.pi) * np.sqrt(PLASTIC)


def test_rotors_flash_by_their_own_phase_and_speed():
    """Only where phase and 6 rev/min t are 90 degrees or -90 do blades lie across the view. Planted
    bugs: the first phase for all; the first speed for all; a negative speed taken as positive."""
    w = irt.Waveform(num_chirps=450, num_groups=1)
    speeds, phases = (2000.0, 2700.0, -3300.0), (35.0, -20.0, 170.0)
    rotors = Rotors(number=3, arm_m=0, blades=1, rev_per_min=speeds, phase_deg=phases)
    rotors = rotors.model_copy(update={"blade_length_m": 0.03, "blade_dbsm": 0.0})
    signal, t, _ = slow_time(blades_of(rotors, w, 1, "U"), 1e5, w)
    half_turns = [(p + 6 * s * t - 90) / 180 for p, s in zip(phases, speeds, strict=True)]
    flashes = [k for turn in half_turns for k in np.flatnonzero(np.diff(np.floor(turn)))]
    assert len(flashes) >= 7
    assert min(np.abs(signal[k : k + 2]).max() for k in flashes) > 0.8
    beside = np.abs(half_turns - np.rint(half_turns)).min(axis=0) > 0.1
    assert np.abs(signal[beside]).max() < 0.4


OTHER_WAYS = PLATES.model_copy(update={"rev_per_min": (-4e3, -6e3), "phase_deg": (20.0, 130.0)})


@pytest.mark.parametrize(
    ("rotors", "bistatic"), [(PLATES, False), (PLATES, True), (OTHER_WAYS, True)]
)
def test_a_flat_blade_equals_its_integral_of_physical_optics(rotors, bistatic):
    """At generic directions to 1e-4 of the flash. Planted bugs: `chord @ incident` for `chord @
    both`; the phase of `nodes` with the other sign; `lead` left out of `side`, or that of every
    second rotor turned whatever its speed; `np.sin(tilt)` of the places without."""
    w, rng = irt.Waveform(num_chirps=6), np.random.default_rng(3)
    body = blades_of(rotors, w, 1, "U")
    k, flash = body.wave_number, np.sqrt(blade_section(rotors, body.wave_number))
    for _ in range(10):
        u1, u2 = (v / np.linalg.norm(v) for v in rng.normal(size=(2, 3)))
        u2, t = u2 if bistatic else u1, np.array([rng.uniform(0, 1)])
        gain = body.amplitudes(u1, u2, t)[0]
        found = gain.conj() @ np.exp(-1j * k * body.motion(t).place[0] @ (u1 + u2))
        truth = physical_optics(rotors, body, t[0], u1, u2)
        assert abs(found - truth) < 1e-4 * flash


def test_a_flat_blade_flashes_along_its_normal():
    """4 pi A^2/lambda^2. Planted bug: `obliquity` without its half."""
    w = irt.Waveform(num_chirps=6)
    body = blades_of(PLATES, w, 1, "U")
    k, flash = body.wave_number, np.sqrt(blade_section(PLATES, body.wave_number))
    tilt = np.radians(PLATES.incidence_deg)
    angle = body.start[0]  # at time 0, seen along the normal of the first rotor's first blade
    back = -np.array([np.cos(angle), -np.sin(angle), 0])
    normal = np.sin(tilt) * back + np.cos(tilt) * np.array([0, 0, 1])
    one = blades_of(PLATES.model_copy(update={"number": 1, "blades": 1}), w, 1, "U")
    own = body.start[0] - one.start[0]
    assert own == pytest.approx(0)
    gain = one.amplitudes(normal, normal, np.zeros(1))[0]
    echo = gain.conj() @ np.exp(-2j * k * one.motion(np.zeros(1)).place[0] @ normal)
    assert abs(echo) == pytest.approx(flash, rel=1e-6)
    assert 4 * np.pi * (0.05 * 0.015 / (2 * np.pi / k)) ** 2 * PLASTIC == pytest.approx(flash**2)


def test_energy_of_flat_blades_is_that_of_the_integral():
    """Mean power of all blades over a turn, each by itself. Planted bug: `x` of the chord."""
    u1, u2 = np.array([0.1, 0.3, -1.0]), np.array([0.0, -0.2, -1.0])
    u1, u2 = u1 / np.linalg.norm(u1), u2 / np.linalg.norm(u2)
    one = PLATES.model_copy(update={"blades": 1, "number": 1})
    alone = blades_of(one, irt.Waveform(num_chirps=6), 1, "U")
    turns = np.arange(400) / 400 / (PLATES.rev_per_min / 60)
    power = np.abs(physical_optics(one, alone, turns, u1, u2)) ** 2
    assert alone.square_metres(u1, u2) == pytest.approx(power.mean(), rel=1e-3)


def test_a_flat_blade_seen_from_its_edge_is_dark():
    """Without incidence and in the plane of the rotors. Planted bug: obliquity of 1."""
    flat = blades_of(PLATES.model_copy(update={"incidence_deg": 0.0}), irt.Waveform(), 1, "U")
    ahead = np.array([0.0, 1.0, 0.0])
    assert np.abs(flat.amplitudes(ahead, ahead, np.linspace(0, 0.1, 7))).max() < 1e-12
    assert flat.square_metres(ahead, ahead) < 1e-24


@pytest.mark.filterwarnings("ignore:.*too near")
@pytest.mark.parametrize(
    ("rotors", "place"),
    [
        ({"number": 1, "blades": 1, "incidence_deg": 30.0}, [1.0, 4.0, 5.0]),
        ({"number": 2, "arm_m": 0.3}, [0.3, 0.5, 2.5]),
    ],
)
def test_samples_of_flat_blades_are_the_integral_at_every_sample(rotors, place):
    """0.3 % of the sum of physical optics over a fine grid, with its phase and obliquity at every
    sample and place, also where the radar is 1.6 m below; obliquity changes by 0.6 % in half a
    slot. Planted bugs: one node; amplitudes at the epoch in all slots; directions and patterns of
    the body's middle (0.07 and 1.7 nearby)."""
    rotors = {"blade_length_m": 0.05, "chord_m": 0.015, "blade_dbsm": 10.0} | rotors
    flight = {"position_m": place, "velocity_mps": [3.0, -4.0, 0.0]}
    s = scenario(chirps=3, rotors=rotors, **flight)
    setup = irt.prepare(s)
    frame, q = setup.frame(1), setup.frame(1).poses["T"]
    echo = frame.paths[OWN]
    moving = setup.moving_centres.with_centres(echo, frame.poses, echo.epoch)
    found = samples_of(setup, frame, moving.select(np.arange(1, len(moving))))
    body, r = blades_of(s.swarm["T"].rotors, setup.waveform, s.seed, "T"), s.swarm["T"].rotors
    axes = centres.body_axes(setup.swarm, "T", echo.epoch)

    def blades(t):
        return [grid(r, *blade) for blade in blades_and_hubs(r, body, t)]

    def places(t):
        body_places = np.concatenate([places for places, *_ in blades(t)], axis=1)
        return q.position + np.outer(t - echo.epoch, q.velocity)[:, None] + body_places @ axes.T

    def amplitudes(t, points):
        back = (frame.poses["radar"].position - points) @ axes
        back /= np.linalg.norm(back, axis=2)[..., None]
        each = zip(blades(t), np.split(back, len(blades(t)), axis=1), strict=True)
        parts = [np.abs(np.vecdot(n[:, None], u)) * weight for (_, n, weight), u in each]
        return np.concatenate(parts, axis=1) * np.sqrt(10) * echo_amplitude(frame, 0.1)

    truth = sum_over_points(setup, frame, places, amplitudes)
    assert error_of(found, truth) < 3e-3


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
    pieces, time = paths.select(np.arange(1, len(paths))), motion.pieces(w, 1, 0.0)[1]
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


def test_ground_multipath_is_the_sum_over_images_at_every_sample():
    """Four paths to each point, 0.05 %. Planted bugs: `mirror` of one end for both; `points[:at]`
    for `points[:at:-1]`; spreading of the way there alone."""
    s = scenario(rotors={"number": 1, "arm_m": 0.1, "blade_length_m": 0.03}, chirps=12)
    setup = irt.prepare(s)
    frame, middle = setup.frame(1), setup.timetable.epoch(1)
    paths = over_ground(frame, -0.8)
    moving = setup.moving_centres.with_centres(paths, frame.poses, middle)
    found = samples_of(setup, frame, moving.select(np.arange(4, len(moving))))
    assert error_of(found, of_rotors(s, frame, OVER_GROUND, -0.8)) < 5e-4


@pytest.mark.filterwarnings("ignore:.*does not observe")
@pytest.mark.parametrize("one_place", [True, False])
def test_own_blades_are_the_sum_over_points_at_every_sample(one_place):
    """Echoes of a radar's own blades at 25 to 35 cm, within what the plan states: 0.7 % with all
    antennas in one place, for the spreading changes within a slot. Planted bugs: `distance` for
    `2 * distance`; `distance` once in the radar equation; the pose's axes for the body's."""
    rotors = {"number": 2, "arm_m": 0.3, "blade_length_m": 0.05, "height_m": 0.05}
    flight = {"position_m": [1.0, 6.0, 1.5], "rcs": {"model": "constant"}}
    array = {"tx": [[0, 0], [1e-6, 0], [0, 1e-6]], "rx": [[0, 0], [2e-6, 0], [0, 2e-6], [3e-6, 0]]}
    array = {end: {"positions": of} for end, of in array.items()}
    own = {"rotors": rotors, "boresight": [0.3, 1, 0]} | ({"array": array} if one_place else {})
    s = scene(flight, 12, **own)
    setup = irt.prepare(s)
    frame = setup.frame(1)
    echo, antennas = frame.paths[OWN], setup.arrays.of("radar")
    own = setup.moving_centres.own_echoes(echo, frame.poses, 0.0)
    found = samples_of(setup, frame, own)
    body, pose = setup.moving_centres.own["radar"], frame.poses["radar"]
    axes = centres.body_axes(setup.swarm, "radar", echo.epoch)

    def places(t):
        return pose.position + body.motion(t).place @ axes.T

    level = antennas.element_gain(pose.to_body(echo.departure)) * body.amplitude
    level = level * setup.waveform.wavelength / (4 * np.pi) ** 1.5
    error = error_of(found, sum_over_points(setup, frame, places, lambda *_: level))
    rows = setup.moving_centres.report({OWN: echo}, frame.poses, {OWN: 1.0})
    (bound,) = [row["estimate"] for row in rows if row["what"] == "own rotors of radar"]
    assert bound / 10 < error < bound < 0.05


def test_own_blades_that_stand_still_that_nobody_sees_and_that_are_plates():
    """At 0 rev/min each slot has the same echoes; behind the antennas there are none; a level of a
    plate, which is along its normal, is not that of its edges. Planted bugs: one piece of all slots
    where nothing turns; `blade_dbsm` kept by `as_wires`."""
    rotors = {"arm_m": 0.3, "blade_length_m": 0.05, "height_m": 0.05}
    plate = {"chord_m": 0.015, "blade_dbsm": -7}

    def own(**values):
        up = {"boresight": [0.0, 1.0, 1.0]}
        setup = irt.prepare(scene({"position_m": [1, 6, 1.5]}, 12, rotors=rotors | values, **up))
        poses, found = setup.find(0)
        return setup, found, poses, setup.moving_centres.own_echoes(found[OWN], poses, 0.0)

    setup, found, poses, still = own(rev_per_min=0)
    gain = still.gain.reshape(setup.waveform.num_chirps, -1)
    assert np.array_equal(gain, gain[:1].repeat(len(gain), axis=0))
    assert setup.moving_centres.report(found, poses, {OWN: 1.0})
    assert own(height_m=-1)[-1] is None
    flat, edges = (own(**values)[-1] for values in (plate, {}))
    assert np.array_equal(flat.gain, edges.gain)


def test_the_plan_says_what_nobody_receives():
    """A sole radar's own extent, and its rotors, which it receives itself. Planted bug: without
    `and name in self.own`."""
    centres = [{"position_m": [0, 1, 0], "value_dbsm": 0}]
    flight = {"position_m": [1.0, 6.0, 1.5], "rcs": {"model": "constant"}}
    extent = {"extent": {"kind": "centres", "centres": centres}}
    for parts, lines in (
        (extent, {"moving parts of radar": "without effect: no terminal"}),
        ({"rotors": {"height_m": 0.1}}, {"own rotors of radar": "dB over the noise"}),
    ):
        setup = irt.prepare(scene(flight, 12, **parts))
        rows = setup.moving_centres.report(*setup.find(0)[::-1], {OWN: 1.0})
        stated = {row["what"]: row["modelled"] for row in rows}
        assert stated.keys() == lines.keys()
        assert all(words in stated[what] for what, words in lines.items())


def test_blades_far_below_noise_are_left_out():
    """Planted bug: `<` for `>` in `with_centres`."""
    setup = irt.prepare(scenario(rotors={}))
    frame, epoch = setup.frame(0), setup.timetable.epoch(0)
    job = frame.paths[OWN], frame.poses, epoch
    blades = setup.moving_centres.models[0][1].amplitude
    power = frame.paths[OWN].power[0] * (blades**2).sum() / 0.1
    assert len(setup.moving_centres.with_centres(*job, 0.9 * power)) > 1000
    assert len(setup.moving_centres.with_centres(*job, 1.1 * power)) == 1


def test_points_of_blades_count_in_the_memory_of_a_run(monkeypatch):
    """As many as there are, and a run that they overfill is refused. Planted bug: the chord left
    out."""
    setup = irt.prepare(scenario())
    for chord in (None, 0.015, 0.3):
        rotors = Rotors(chord_m=chord, blade_length_m=0.5)
        swarm = Swarm({"Q": Uav(role="target", position_m=(0, 9, 1), rotors=rotors)})
        points = blades_of(rotors, setup.waveform, 1, "Q").radius.size
        counted = preflight.copies_needed(swarm, setup.waveform) / setup.waveform.num_chirps
        assert counted == points
    monkeypatch.setattr(preflight, "available_memory", lambda: 6e8)
    with pytest.raises(ScenarioError, match="shorten blades"):
        preflight.check_memory(setup.arrays, setup.timetable, swarm)


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
    ("uav", "message"),
    [
        ({"rotors": {"rev_per_min": 50_000}}, "faster than sound"),
        ({"rotors": {"number": 2, "rev_per_min": [1, -50_000]}}, "faster than sound"),
        ({"rotors": {"rev_per_min": [6000, 5000]}}, "2 values for 4 rotors; state one"),
        ({"rotors": {"rev_per_min": -1}}, "from 0 on, or a list with one for each"),
        ({"rotors": {"phase_deg": []}}, "0 values for 4 rotors"),
        ({"rotors": {}, "rcs": {"model": "relative"}}, "another rcs.model"),
        ({"rotors": {"blade_length_m": 0}}, "greater than or equal to 0.005"),
        ({"rotors": {"number": 1}, "role": "passive"}, "0 m from the arrays"),
    ],
)
def test_refused(uav, message):
    """Planted bug: `>` for `<` in `Rotors.problems`."""
    with pytest.raises(ValueError, match=message):
        scenario(**uav)
