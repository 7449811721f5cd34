"""Terminals with hardware of their own: arrays, powers and noise figures that differ."""

from __future__ import annotations

import copy

import numpy as np
import pytest
from oracles import mixed_chirps

import isac_rt as irt
from isac_rt.document import ScenarioError
from isac_rt.frame.link import Link
from isac_rt.signal.if_signal import if_signal
from isac_rt.signal.methods import Exact

TREE = {
    "frames": 5,
    "seed": 31,
    "radio": {
        "bandwidth_hz": 523e6,
        "sampling_rate_hz": 17.3e6,
        "samples_per_chirp": 64,
        "chirps_per_frame": 12,
    },
    "array": {"rx_x": 3, "rx_z": 2, "element_gain_dbi": 7.0},
    "modulation": {"acquisition_frames": 1, "pilot_every_frames": None},
    "noise": {"tx_power_dbm": 11.0, "noise_figure_db": 13.0},
    "swarm": {
        "AT": {"role": "active", "position_m": [0, 0, 30], "boresight": [0.1, 1, 0]},
        "PT": {
            "role": "passive",
            "position_m": [3, 17, 31],
            "boresight": [-0.3, -1, 0.1],
            "array": {
                "rx": {
                    "shape": "positions",
                    "unit": "metres",
                    "positions": [[0, 0], [3.1e-3, 0.4e-3]],
                },
                "tx": {
                    "shape": "positions",
                    "unit": "metres",
                    "positions": [[0, 0], [2.3e-3, 0], [4.9e-3, 1.7e-3]],
                },
                "element_gain_dbi": 4.1,
            },
            "noise": {"noise_figure_db": 5.0},
        },
        "U": {
            "role": "target",
            "position_m": [-2, 11, 29],
            "velocity_mps": [1.5, 0.4, 0],
            "rcs": {"model": "constant"},
        },
    },
}


def changed(**uav):
    tree = copy.deepcopy(TREE)
    tree["swarm"]["PT"] |= uav
    return tree


def cosine_gain(gain_dbi, axis, towards):
    """Power gain of the documented element: G cos^q with 2 (q + 1) = G."""
    gain = 10 ** (gain_dbi / 10)
    at = np.dot(axis, towards) / np.linalg.norm(axis) / np.linalg.norm(towards)
    return gain * max(at, 0.0) ** (gain / 2 - 1)


def gain_by_way_of(name, paths):
    return np.abs(paths.gain[paths.target == paths.target_names.index(name)])[0]


def test_samples_of_two_arrays_are_the_exact_model():
    """The link between two arrays and an echo against chirps mixed in long double; the
    transmitter's schedule goes over the transmitter's elements. Bugs: the receiver's elements at
    both ends; the common ones."""
    setup = irt.prepare(irt.load(TREE))
    frame = setup.frame(2)
    places = np.array([[0, 0, 0], [3.1, 0, 0.4]]) * 1e-3
    assert setup.arrays.of("PT").rx_positions == pytest.approx(places - places.mean(0), abs=1e-12)
    assert setup.arrays.of("AT").num_rx == 4
    for link in (Link("AT", "PT"), Link("AT", "AT")):
        sent, paths = frame.sent["AT"], frame.paths[link]
        receiver, reference = frame._listening(link)
        made = if_signal(setup.waveform, [(sent, paths)], receiver, reference, Exact()).samples
        truth = mixed_chirps(
            setup.waveform,
            [(sent, paths)],
            frame.poses[link.rx],
            setup.arrays.of(link.rx),
            setup.timetable.start_time(2, "AT"),
        )
        assert made.shape[1] == (2 if link.rx == "PT" else 4)
        assert np.abs(made - truth).max() <= 1e-6 * np.abs(truth).max()


def test_each_end_has_its_own_gain_power_and_noise():
    """The line of sight by Friis with both elements, the echo with the terminal's own; samples
    without paths are noise of the terminal's own figure. Bugs: the receiver's gain at both ends;
    the common noise figure; the receiver's transmit power."""
    setup = irt.prepare(irt.load(TREE))
    frame, k = setup.frame(2), 1.380649e-23 * 290 * 17.3e6
    at, pt, u = (frame.poses[name].position for name in ("AT", "PT", "U"))
    wavelength = setup.waveform.wavelength
    sent = cosine_gain(7.0, [0.1, 1, 0], pt - at)
    received = cosine_gain(4.1, [-0.3, -1, 0.1], at - pt)
    friis = wavelength / (4 * np.pi * np.linalg.norm(pt - at)) * np.sqrt(sent * received)
    sight = frame.paths["AT", "PT"]
    assert np.abs(sight.gain[sight.kind == 0][0]) == pytest.approx(friis, rel=1e-9)
    ahead, back, r = cosine_gain(7.0, [0.1, 1, 0], u - at), u - pt, np.linalg.norm(u - at)
    own = ahead / r**2
    by_u = np.sqrt(ahead * cosine_gain(4.1, [-0.3, -1, 0.1], back)) / (r * np.linalg.norm(back))
    echo, bistatic = (gain_by_way_of("U", frame.paths["AT", rx]) for rx in ("AT", "PT"))
    assert bistatic / echo == pytest.approx(by_u / own, rel=1e-9)
    for name, figure in (("AT", 13.0), ("PT", 5.0)):
        power = frame.noise_power(("AT", name))
        assert power == pytest.approx(k * 10 ** (figure / 10), rel=1e-9)
    assert frame.sent["AT"].amplitude ** 2 == pytest.approx(10**1.1 * 1e-3)


def test_a_stated_common_array_changes_no_bit():
    """A terminal that states what all have gives the same samples, receptions and tracks."""
    common = {**TREE, "swarm": {n: {**u} for n, u in TREE["swarm"].items()}}
    common["swarm"]["PT"] = {
        k: v for k, v in TREE["swarm"]["PT"].items() if k not in ("array", "noise")
    }
    stated = copy.deepcopy(common)
    stated["swarm"]["PT"]["array"] = dict(TREE["array"])
    stated["swarm"]["PT"]["noise"] = {"noise_figure_db": 13.0}
    one, other = (irt.run(irt.load(tree)).dataset for tree in (common, stated))
    assert one.equals(other)


def test_elements_of_a_common_front_end_fit_every_array():
    """Four gains for the common array of four receive elements, and a terminal of two. Bug: only
    the terminal's own front end is compared with its array."""
    tree = changed()
    tree["radio"] = TREE["radio"] | {"front_end": {"receive": {"gain_db": [0.1, 0.2, 0.3, 0.4]}}}
    said = r"radio\.front_end\.receive\.gain_db.*4 values for 2 receive elements"
    with pytest.raises(ScenarioError, match=said) as problem:
        irt.load(tree)
    assert str(problem.value).count("values for") == 1
    tree["swarm"]["PT"]["front_end"] = {"receive": {"gain_db": [0.1, 0.2]}}
    irt.load(tree)


@pytest.mark.parametrize(
    ("uav", "said"),
    [
        ({"array": {"tx_x": 3}}, "4 transmit elements, and array has 3"),
        ({"array": {"schedule": "conventional"}}, "share array.schedule"),
        ({"noise": {"model": "snr"}}, "share noise.model"),
        ({"role": "target"}, "has no meaning for what neither"),
    ],
)
def test_what_the_scheme_shares_cannot_differ(uav, said):
    """Bug: the order of the transmit elements taken from the common array for more of them."""
    tree = changed(**uav)
    if "array" in uav:
        tree["swarm"]["PT"]["array"] = uav["array"]
    with pytest.raises(ScenarioError, match=said):
        irt.load(tree)
