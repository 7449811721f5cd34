"""Foreign radars: their paths, chirps and what a frame adds of them; tests/truths/street.py has the
dechirp at 20 times the rate."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from truths.street import START, WAVEFORM, one_path, receiver

from isac_rt import runtime
from isac_rt.document import ScenarioError
from isac_rt.extensions.street.emitters import Arrival, Train, add_foreign
from isac_rt.frame.antennas import Antennas
from isac_rt.frame.cube import ReceiveArray, Reference, Transmission
from isac_rt.frame.payload import unmodulated
from isac_rt.frame.waveform import SPEED_OF_LIGHT
from isac_rt.propagation.pathset import PathKind, make_paths
from isac_rt.scenario.file import load
from isac_rt.signal.if_signal import if_signal
from isac_rt.signal.methods import Exact
from isac_rt.simulation.audit import make_plan
from isac_rt.simulation.setup import prepare
from isac_rt.world.swarm import Pose

SCENE = Path(__file__).parents[3] / "scenes" / "foreign_swarm.yaml"
OPEN = ["propagation.model=free_space", "clutter.model=none"]


def test_a_foreign_chirp_that_is_the_own_one_is_an_echo():
    """Same slope, time and frequency: the exact model of a path, behind the filter's transient at
    its beginning. Planted bug: the gain without its conjugate."""
    w = replace(WAVEFORM, num_groups=1)
    train = Train(
        w.carrier_frequency, w.slope, 2 * w.chirp_duration, w.slot_duration, START, None, 0.0
    )
    ear, paths = receiver(), one_path(delay=120e-9)
    found = np.zeros((1, 4, w.num_chirps, w.num_samples), complex)
    add_foreign(found, w, Arrival(train, 1.0, paths), ear, Reference(START))
    alone = Antennas(tx_x=3, tx_z=1)
    sent = Transmission(
        name="E",
        pose=Pose.at_rest(),
        antennas=alone,
        schedule=np.zeros((1, w.num_chirps), int),
        payload=unmodulated(w),
    )
    truth = if_signal(w, [(sent, paths)], ear, Reference(START), Exact()).samples
    settled = slice(100, None)
    error = np.abs(found - truth)[..., settled].max() / np.abs(truth).max()
    assert error < 2e-3


def test_bursts_begin_at_their_interval():
    """Planted bug: the chirps of the burst before left out."""
    train = Train(77e9, 1e13, 20e-6, 25e-6, 3e-6, 4, 1e-3)
    found = train.starts(1.03e-3, 2.03e-3)
    assert found == pytest.approx(1e-3 + 3e-6 + np.array([50, 75, 1000, 1025]) * 1e-6)
    assert train.starts(80e-6, 90e-6).size == 0


def test_the_power_that_arrives_is_by_friis_and_both_patterns():
    """Straight through open space, with rain on the way. Planted bug: the emitter's boresight
    ignored; 20 for 10 in its power; no weather."""
    rain = ["weather.rain_mm_per_h=100"]
    dry, wet = (prepare(load(SCENE, [*OPEN, *more])).frame(2) for more in ([], rain))
    setup = prepare(load(SCENE, OPEN))
    time = setup.timetable.epoch(2)
    at, own = np.array([3.4, 21.5 - 11.2 * time, 0.7]), setup.swarm.poses(time)["AT"]
    line = own.position - at
    distance = np.linalg.norm(line)
    boresight = np.array([-0.1, -1, 0.15]) / np.linalg.norm([-0.1, -1, 0.15])
    sent = 10**1.2 * (line @ boresight / distance) ** (10**1.2 / 2 - 1)
    received = setup.antennas.element_gain(own.to_body(-line / distance))
    friis = 10 ** ((14 - 30) / 10) * sent * received
    friis *= (setup.waveform.wavelength / (4 * np.pi * distance)) ** 2
    arrival = dry.foreign["AT"][0]
    los = arrival.paths.kind == PathKind.LINE_OF_SIGHT
    power = arrival.amplitude**2 * arrival.paths.power[los]
    assert power == pytest.approx([friis], rel=1e-9)
    assert arrival.paths.delay_rate[los] * SPEED_OF_LIGHT == pytest.approx(
        [(own.velocity - np.array([0, -11.2, 0])) @ line / distance]
    )
    attenuated = wet.foreign["AT"][0].paths.power[los] / arrival.paths.power[los]
    assert -10 * np.log10(attenuated) == pytest.approx([0.0297 * distance], rel=0.02)


@pytest.mark.slow
@pytest.mark.sionna
def test_the_city_reflects_foreign_chirps_once():
    """The nearest wall's image is among the paths to a terminal. Planted bug: no bounces."""
    runtime.activate()
    setup = prepare(load(SCENE, ["clutter.model=none"]))
    frame = setup.frame(2)
    paths = frame.foreign["AT"][0].paths
    time = setup.timetable.epoch(2)
    image = np.array([22 - 3.4, 21.5 - 11.2 * time, 0.7])  # in the wall x = 11
    length = np.linalg.norm(image - frame.poses["AT"].position)
    mirrored = paths.kind == PathKind.SPECULAR
    assert paths.bounces.max() == 1 and mirrored.any()
    assert np.abs(paths.delay[mirrored] * SPEED_OF_LIGHT - length).min() < 1e-6


def test_samples_hold_what_arrives_and_the_plan_says_how_much():
    """Samples with the emitters less those without are the sum over emitters; without emitters a
    frame has none of them. Planted bug: the strongest path left out; noise added twice."""
    small = [*OPEN, "frames=4", "radio.chirps_per_frame=24", "radio.samples_per_chirp=512"]
    setup = prepare(load(SCENE, small))
    frame, link = setup.frame(3), ("AT", "AT")
    assert prepare(load(SCENE, [*small, "emitters={}"])).frame(3).foreign == {}
    alone = replace(frame, foreign={}).samples(link).samples
    extra = frame.samples(link).samples - alone
    truth = np.zeros(alone.shape, complex)
    ear = ReceiveArray(frame.poses["AT"], setup.antennas)
    for arrival in frame.foreign["AT"]:
        add_foreign(truth, setup.waveform, arrival, ear, Reference(setup.timetable.start_time(3)))
    noise = frame.noise_power(link)
    assert np.mean(np.abs(extra - truth) ** 2) < 0.02 * noise
    assert np.mean(np.abs(truth) ** 2) > 0.2 * noise
    rows = {
        row["link"]: row for row in make_plan(setup)["items"] if row["what"] == "foreign radars"
    }
    rise = 10 * np.log10(1 + np.mean(np.abs(truth) ** 2) / noise)
    assert f"floor {rise:.2g} dB up" in rows["AT->AT"]["modelled"]


TWO = {
    "frames": 4,
    "frame_interval_s": 0.02,
    "sensor": "awr1843",
    "swarm": {
        "A": {"role": "active", "position_m": [0, 0, 5], "boresight": [0, 1, 0]},
        "B": {
            "role": "active",
            "position_m": [3, 40, 6],
            "velocity_mps": [1, -9, 0],
            "boresight": [0, -1, 0],
            "clock_offset_s": 4e-6,
            "clock_drift_ppm": -30.0,
            "radio": {
                "chirps_per_frame": 64,
                "scheme": "ddm",
                "sub_bands": 4,
                "chirp": {
                    "slope_mhz_per_us": 18.0,
                    "idle_us": 6.0,
                    "adc_start_us": 6.0,
                    "ramp_end_us": 34.0,
                },
            },
        },
    },
}


@pytest.mark.filterwarnings("ignore::isac_rt.scenario.file.ScenarioWarning")
def test_radars_of_two_chirps_disturb_each_other():
    """Numbers of the data sheet, by hand: B in the samples of A and A in those of B, and neither
    where its carrier is elsewhere. Planted bug: the power of one antenna of three; the clock of B
    ignored where it sends, or where it receives; bands taken to overlap anywhere; the drift of B
    taken for A's."""
    setup = prepare(load(TWO))
    frame, at_a, at_b = setup.frame(3), ("A", "A"), ("B", "B")
    power, d = 10 ** ((12 - 30) / 20), 1 - 30e-6  # what B's clock takes for a second
    chirps_of_b = Train(77e9 / d, 18e12 / d**2, 34e-6 * d, 40e-6 * d, 4e-6 * d, 64, 0.02 * d)
    chirps_of_a = Train(77e9 * d, 15e12 * d**2, 33e-6 / d, 40e-6 / d, -4e-6 / d, 192, 0.02 / d)
    trains = {"A": (chirps_of_b, power * np.sqrt(3)), "B": (chirps_of_a, power)}
    for link, other in ((at_a, "B"), (at_b, "A")):
        part = setup.of(link[0])
        of_part = part.frame(3)
        extra = frame.samples(link).samples - replace(of_part, foreign={}).samples(link).samples
        here, there = (part.swarm.trajectories[n] for n in (link[0], other))
        when = part.timetable.epoch(3, link[0])
        line = there.pose(when).position - here.pose(when).position
        distance = np.linalg.norm(line)
        gains = [
            part.antennas.element_gain(pose.to_body(sign * line / distance))
            for pose, sign in ((here.pose(when), 1), (there.pose(when), -1))
        ]
        closing = there.pose(when).velocity - here.pose(when).velocity
        path = make_paths(
            gain=[part.waveform.wavelength / (4 * np.pi * distance) * np.sqrt(np.prod(gains))],
            delay=[distance / SPEED_OF_LIGHT],
            delay_rate=[closing @ line / distance / SPEED_OF_LIGHT],
            departure=[-line / distance],
            arrival=[line / distance],
            rx_radius=[distance],
            kind=PathKind.LINE_OF_SIGHT,
            epoch=when,
            tx=other,
            rx=link[0],
        )
        truth = np.zeros(extra.shape, complex)
        ear = ReceiveArray(here.pose(when), part.antennas)
        start = Reference(part.timetable.start_time(3, link[0]))
        add_foreign(truth, part.waveform, Arrival(*trains[link[0]], path), ear, start)
        assert np.linalg.norm(truth) ** 2 > truth.size * frame.noise_power(link)
        assert np.linalg.norm(extra - truth) < 0.03 * np.linalg.norm(truth)
    apart = {**TWO["swarm"]["B"], "radio": {**TWO["swarm"]["B"]["radio"], "carrier_hz": 79e9}}
    elsewhere = prepare(load({**TWO, "swarm": {**TWO["swarm"], "B": apart}})).frame(1)
    assert all(not part.foreign for part in elsewhere._by_chirp.values())


@pytest.mark.filterwarnings("ignore::isac_rt.scenario.file.ScenarioWarning")
def test_radars_of_one_chirp_on_two_clocks_disturb_each_other():
    """B, which is 0.3 us late, is a tone of A's at the slope times that and the delay; on one clock
    they take turns. Planted bug: the clock left out of what tells radars apart."""
    late = 0.3e-6
    swarm = {
        name: {key: value for key, value in uav.items() if key not in ("radio", "clock_drift_ppm")}
        for name, uav in TWO["swarm"].items()
    }
    for uav in swarm.values():
        uav["clock_offset_s"] = 4e-6
    assert not prepare(load({**TWO, "swarm": swarm})).by_chirp
    swarm["B"]["clock_offset_s"] += late
    setup = prepare(load({**TWO, "swarm": swarm}))
    frame, part, link = setup.frame(3), setup.of("A"), ("A", "A")
    extra = frame.samples(link).samples - replace(part.frame(3), foreign={}).samples(link).samples
    poses = frame.poses
    delay = np.linalg.norm(poses["B"].position - poses["A"].position) / SPEED_OF_LIGHT
    beat = part.waveform.slope * (late + delay)
    cells = np.abs(np.fft.fft(extra[0, 0, 0])).argmax()
    assert cells == round(beat / part.waveform.sampling_rate * 256)


def test_radars_of_chirps_shorter_than_any_that_is_stated_disturb_each_other():
    """What a radar sends is within its own limits. Planted bug: it checked as an emitter that a
    person states."""
    radio = {"mode": "fmcw", "samples_per_chirp": 32, "sampling_rate_hz": 1e8}
    radio |= {"bandwidth_hz": 3e8, "chirps_per_frame": 24}
    swarm = {
        name: {k: v for k, v in uav.items() if k != "radio"} for name, uav in TWO["swarm"].items()
    }
    swarm["B"]["radio"] = radio | {"bandwidth_hz": 4e8}
    tree = {"frames": 1, "receiver_preset": "plain", "radio": radio, "swarm": swarm}
    setup = prepare(load(tree | {"noise": {"model": "link_budget"}}))
    assert setup.waveform.chirp_duration < 1e-6
    assert all(part.foreign for part in setup.frame(0)._by_chirp.values())


@pytest.mark.parametrize(
    ("more", "message"),
    [
        (["emitters.car.slope=1"], "emitters.car.slope"),
        (["emitters.gate.burst_interval_s=0.001"], "shorter than a burst, which lasts 0.004864 s"),
        (["emitters.gate.burst_chirps=null"], "goes with burst_interval_s"),
        (["emitters.car.boresight=[0,0,0]"], "points nowhere"),
        (["emitters.gate.start_hz=77"], "emitters.gate.start_hz"),
        (["emitters.gate.slope_mhz_per_us=-9000"], "ends below 0 Hz"),
        (["emitters.gate.slope_mhz_per_us=1e4", "emitters.gate.ramp_us=1e6"], "ends above 1e12 Hz"),
        (["emitters.gate.offset_us=1e300"], "emitters.gate.offset_us"),
        (["emitters.car.velocity_mps=[0,20000,0]"], "faster than"),
        (["emitters.car.position_m=[15,0,5]", *OPEN], "emitters.car: starts inside a building"),
        (["emitters.car.position_m=[3,20,-1]", *OPEN], "emitters.car: .*under its ground"),
        (["emitters.car.position_m=[-3.1,-20.3,9.2]"], "emitters.car: .*0.05 m from AT"),
        (["noise.model=snr"], "emitters: .*noise.model snr does not know"),
        (["emitters.AT={position_m: [0,0,1], boresight: [0,1,0], start_hz: 77e9}"], "emitters.AT"),
    ],
)
def test_emitters_that_cannot_be_are_refused(more, message):
    with pytest.raises(ScenarioError, match=message):
        prepare(load(SCENE, more))
