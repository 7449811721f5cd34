"""Targets with several scattering centres: 3GPP's tables, samples, and one track."""

from __future__ import annotations

import numpy as np
import pytest

import isac_rt as irt
from isac_rt.extensions.street.centres import body_axes
from isac_rt.extensions.street.extent import KINDS, fixed_of, of_several
from isac_rt.extensions.street.walker import walker_of_flight
from isac_rt.frame.link import Link
from isac_rt.frame.waveform import SPEED_OF_LIGHT
from isac_rt.scenario.tree import Scenario
from isac_rt.world.settings import Extent, Uav
from isac_rt.world.swarm import Swarm

OWN = Link("radar", "radar")
# TR 38.901 v19 tables 7.9.2.1-5 and -7: g_max, sigma_max of each point
PRINTED = {
    "vehicle": [(20.60, 20.52), (13.90, 13.82), (20.60, 20.52), (14.99, 14.91), (21.12, 21.05)],
    "agv": [(13.00, 30.26), (7.27, 24.53), (10.98, 28.24), (7.27, 24.53), (11.77, 29.03)],
}


def scenario(target, frames=2, chirps=24):
    return Scenario.model_validate(
        {
            "frames": frames,
            "frame_interval_s": 0.05,
            "sensor": "awr1843",
            "radio": {"chirps_per_frame": chirps},
            "receiver_preset": "plain",
            "accuracy": {"preset": "everything"},
            "swarm": {
                "radar": {"role": "active", "position_m": [0, 0, 1], "boresight": [0, 1, 0]},
                "T": {"role": "target", **target},
            },
        }
    )


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
        steady = section.random.square_metres(peak, peak)
        assert section(peak, peak) / steady == pytest.approx(10 ** (section.lobe.peak / 10))


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
    s = scenario(
        {"waypoints": way, "extent": {"kind": "centres", "centres": stated}}
        | {"rcs": {"model": "constant", "value_dbsm": 0.0}}
    )
    setup = irt.prepare(s)
    frame, w, antennas = setup.frame(1), setup.waveform, setup.arrays.of("radar")
    links, ears = frame._arriving(OWN), frame._listening(OWN)
    found = irt.if_signal(w, links, *ears, irt.Direct()).samples
    pose, sent = frame.poses["radar"], frame.sent["radar"]
    tx, rx = (
        pose.position + pose.to_world(r) for r in (antennas.tx_positions, antennas.rx_positions)
    )
    gain = sent.amplitude * frame.paths[OWN].gain[0] * 10 ** (-3 / 20)
    truth = np.zeros(found.shape, complex)
    for p in range(w.num_chirps):
        t = setup.timetable.start_time(1) + p * w.slot_duration + w.fast_time
        yaw = start + spin * t
        middle = np.stack([1 + 2 * t, 8 - 3 * t, 0 * t + 1.5], axis=1)
        right = np.stack([np.cos(yaw), -np.sin(yaw), 0 * t], axis=1)
        ahead = np.stack([np.sin(yaw), np.cos(yaw), 0 * t], axis=1)
        for place in places:
            point = middle + place[0] * right + place[1] * ahead + place[2] * np.array([0, 0, 1])
            near, far = (np.linalg.norm(x - pose.position, axis=1) for x in (middle, point))
            for r, element in enumerate(rx):
                both = np.linalg.norm(point - tx[sent.schedule[0, p]], axis=1)
                tau = (both + np.linalg.norm(point - element, axis=1)) / SPEED_OF_LIGHT
                tones = np.exp(2j * np.pi * w.phase(tau, w.fast_time))
                truth[0, r, p] += np.conj(gain) * (near / far) ** 2 * tones
    assert np.linalg.norm(found - truth) < 1e-3 * np.linalg.norm(truth)


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


@pytest.mark.parametrize(
    ("kind", "place", "speed", "found"),
    [("vehicle", (2, 22, 1), 3, 9), ("pedestrian", (1, 8, 1), 1, 5)],
)
def test_a_target_with_extent_is_one_track(kind, place, speed, found):
    """Regression: of ten frames; one track at most. Planted bug: each centre at ten times its
    place."""
    target = {"position_m": place, "velocity_mps": (0, -speed, 0), "extent": {"kind": kind}}
    run = irt.run(scenario(target, frames=10, chirps=96), progress=False)
    figures = run.summary["terminals"]["radar"]
    assert figures["targets"]["T"]["found"] >= found
    assert figures["false_tracks_per_frame"] < 0.2


@pytest.mark.parametrize(
    ("extent", "said"),
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
def test_refused(extent, said):
    """Planted bug: `==` for `!=` in `Extent.problems`."""
    with pytest.raises(ValueError, match=said):
        scenario({"position_m": [0, 9, 1], "extent": extent})
