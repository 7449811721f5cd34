"""Seeds: one stream per purpose, and no two of a run's noises or payloads alike."""

from __future__ import annotations

from dataclasses import replace
from itertools import combinations

import numpy as np
import pytest

from isac_rt.frame.settings import Array, Noise
from isac_rt.propagation.settings import Propagation
from isac_rt.randomness import generator, seed_sequence, splitmix64
from isac_rt.scenario.radio import Radio
from isac_rt.scenario.swarm import Uav
from isac_rt.scenario.tree import Scenario
from isac_rt.simulation.setup import Setup, prepare

SIGMAS = 5  # statistical: a false failure in 1.7 million


def test_every_purpose_has_its_own_stream():
    """Seeds and purposes that differ in one part, in their order or in where a word ends. Planted
    bugs: words run together; the seed left out; 32 bits of the hash alone, by which the last two
    agree."""
    purposes = [("noise", "A", "B", 1), ("noise", "A", "B", 11), ("noise", "B", "A", 1), ("noise",)]
    purposes += [("noise", "AB", 1), ("noise", "A", "B1"), ("payload", "A", "B", 1)]
    purposes += [("payload", "A", 166), ("payload", "A", 57997)]
    states = [
        tuple(seed_sequence(seed, *purpose).generate_state(4).tolist())
        for seed in (7, 8, 2**40 + 7)
        for purpose in purposes
    ]
    assert len(set(states)) == len(states)
    assert states[0] == tuple(seed_sequence(7, "noise", "A", "B", 1).generate_state(4).tolist())
    assert generator(7, "a").random() == generator(7, "a").random() != generator(7, "b").random()


def test_splitmix64_gives_its_published_sequence():
    """From the seed 1234567, by Vigna's reference; the k-th word moves the state k + 1 times.
    Planted bugs: a shift of the finaliser; the word not counted from one."""
    published = [
        6457827717110365317,
        3203168211198807973,
        9817491932198370423,
        4593380528125082431,
        16408922859458223821,
    ]
    state = np.full(5, 1234567, np.uint64)
    assert splitmix64(state, np.arange(5, dtype=np.uint64)).tolist() == published


def uav(role: str, x: float, y: float, **changes) -> Uav:
    return Uav(
        role=role,
        position_m=(x, y, 50.0),
        boresight=(0, 1 if role == "active" else -1, 0),
        rcs={"model": "constant"},
        **changes,
    )


@pytest.fixture(scope="module")
def setup() -> Setup:
    """Two transmitters and two receivers whose noise is 90 dB above every line of sight; the second
    transmitter's blocks are its own."""
    return prepare(
        Scenario(
            name="noise",
            seed=5,
            frames=6,
            radio=Radio(samples_per_chirp=256, chirps_per_frame=12, bandwidth_hz=320e6),
            array=Array(element_pattern="isotropic", element_gain_dbi=0, rx_x=2, rx_z=2),
            propagation=Propagation(leakage={"enabled": False}),
            noise=Noise(model="snr", snr_db=-90.0),
            swarm={
                "A": uav("active", 0.3, 0.2),
                "B": uav("active", 9.7, 1.1),
                "P": uav("passive", 1.9, 18.3),
                "Q": uav("passive", 6.1, 19.9),
            },
        )
    )


def noises(setup: Setup) -> dict[str, np.ndarray]:
    """What every link's receiver hears in two frames, over the deviation that it should have."""
    out = {}
    for number in (3, 4):
        frame = setup.frame(number)
        for link in setup.timetable.links(number):
            z = frame.samples(link).samples.ravel()
            out[f"{link} {number}"] = z / np.sqrt(frame.noise_power(link))
    return out


def test_no_two_receptions_share_their_noise(setup):
    """Every pair of links and frames, and both transmitters' links to one receiver, is
    uncorrelated, and each has the power that is stated. Planted bugs: one noise for all
    transmitters; for all receivers; for all frames; half of the power."""
    found = noises(setup)
    assert len(found) == 2 * 6
    size = next(iter(found.values())).size
    for name, z in found.items():
        assert abs(np.mean(np.abs(z) ** 2) - 1) < SIGMAS / np.sqrt(size), name
    for (one, a), (other, b) in combinations(found.items(), 2):
        for c in (b, b.conj()):
            assert abs(np.vdot(c, a)) / size < SIGMAS / np.sqrt(size), (one, other)


def test_another_seed_gives_other_noise_and_the_same_one_the_same(setup):
    frame, link = setup.frame(3), ("A", "P")
    other = prepare(setup.scenario.model_copy(update={"seed": 6})).frame(3)
    a, again, b = (f.samples(link).samples.ravel() for f in (frame, setup.frame(3), other))
    assert np.array_equal(a, again)
    rho = abs(np.vdot(a, b)) / (np.linalg.norm(a) * np.linalg.norm(b))
    assert rho < SIGMAS / np.sqrt(a.size)


def test_noise_is_so_far_under_the_reference_as_stated(setup):
    """Of a line of sight by Friis with unit gains, and of the strongest echo by the radar equation;
    the power of one antenna is 1 W where an SNR is stated. Planted bugs: amplitude for power; the
    other transmitter's distance; the receiver's own echo."""
    frame, wavelength = setup.frame(3), 299_792_458 / setup.waveform.carrier_frequency
    at = {name: pose.position for name, pose in frame.poses.items()}

    def apart(a: str, b: str) -> float:
        return float(np.linalg.norm(at[a] - at[b]))

    for tx, rx in (("A", "P"), ("A", "Q"), ("B", "P"), ("B", "Q")):
        friis = (wavelength / (4 * np.pi * apart(tx, rx))) ** 2
        assert frame.noise_power((tx, rx)) == pytest.approx(1e9 * friis, rel=1e-6, abs=0)
    area = 10**-1.281
    for name in ("A", "B"):
        nearest = min(apart(name, other) for other in at if other != name)
        echo = wavelength**2 * area / ((4 * np.pi) ** 3 * nearest**4)
        assert frame.noise_power((name, name)) == pytest.approx(1e9 * echo, rel=1e-6, abs=0)


def test_every_transmitter_says_something_else_in_every_frame(setup):
    """Bits agree as often as by chance. Planted bugs: one payload for all transmitters; for all
    frames."""
    timetable = setup.timetable
    said = {
        (name, number): timetable.payload(name, number).bits
        for name in ("A", "B")
        for number in (3, 4, 5)
    }
    for (one, a), (other, b) in combinations(said.items(), 2):
        assert abs(np.mean(a == b) - 0.5) < SIGMAS * 0.5 / np.sqrt(a.size), (one, other)
    assert all(abs(np.mean(a) - 0.5) < SIGMAS * 0.5 / np.sqrt(a.size) for a in said.values())
    again = replace(timetable, seed=timetable.seed + 1).payload("A", 3).bits
    assert abs(np.mean(again == said["A", 3]) - 0.5) < SIGMAS * 0.5 / np.sqrt(again.size)
