"""What a run hands to its terminals, to their answers and to the stages before the data, by
hand."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from isac_rt.extensions.access import feedback, protocol
from isac_rt.extensions.access.feedback import Correction
from isac_rt.extensions.access.protocol import Establishment
from isac_rt.frame.access import Access
from isac_rt.frame.link import Link
from isac_rt.frame.settings import Array, Modulation, Noise
from isac_rt.propagation.settings import Propagation
from isac_rt.receive.types import Reception, no_detections
from isac_rt.scenario.radio import Radio
from isac_rt.scenario.swarm import Uav
from isac_rt.scenario.tree import Scenario
from isac_rt.simulation import simulate, stations
from isac_rt.simulation.setup import Setup, prepare
from isac_rt.track.terminal import ActiveTerminal, PassiveTerminal

RADIO = Radio(samples_per_chirp=256, bandwidth_hz=320e6, chirps_per_frame=12)


def scenario(**changes) -> Scenario:
    """Two that send, the second five blocks later, and two that listen, one to two groups alone."""

    def uav(role, place, velocity, facing, **more):
        return Uav(
            role=role,
            position_m=place,
            velocity_mps=velocity,
            boresight=(0, facing, 0),
            rcs={"model": "constant"},
            **more,
        )

    base = {
        "name": "handed",
        "seed": 3,
        "frames": 6,
        "frame_interval_s": 0.05,
        "radio": RADIO,
        "array": Array(element_pattern="isotropic", element_gain_dbi=0, rx_x=2, rx_z=2),
        "propagation": Propagation(leakage={"enabled": False}),
        "noise": Noise(model="snr", snr_db=3.0),
        "modulation": Modulation(
            acquisition_frames=2, pilot_every_frames=None, streams={"Q": (0, 2)}
        ),
        "swarm": {
            "A": uav("active", (0.3, 0.2, 50.0), (0.7, 3.1, 0.0), 1),
            "B": uav("active", (2.7, -0.6, 53.0), (-0.4, 2.3, 0.3), 1, resource_block=5),
            "P": uav("passive", (-3.9, 17.3, 50.7), (0.2, -1.9, 0.1), -1),
            "Q": uav("passive", (6.1, 19.9, 52.3), (1.1, 0.6, -0.2), -1),
        },
    }
    return Scenario(**base | changes)


class Kept:
    """What the terminals of a run were given, by link: (samples, own pose, time, the rest), and the
    tracks that they gave back."""

    def __init__(self) -> None:
        self.handed: dict[Link, list[tuple]] = {}
        self.shortened: list[tuple] = []
        self.tracks: dict[Link, list] = {}

    def terminal(self, setup: Setup, link: Link):
        """The scenario's receiver of a link, which keeps what it is given and hears nothing."""
        made = stations.standard_terminal(setup, link)

        def step(cube, *given, **options):
            own, time = (given[1], given[2]) if link.own else (given[0], given[1])
            rest = (given[0], options) if link.own else (given[2], options)
            self.handed.setdefault(link, []).append((cube, own, time, *rest))
            empty = Reception.undecoded(setup.waveform, no_detections())
            tracks = made.tracker.snapshot(own)
            self.tracks.setdefault(link, []).append(tracks)
            return empty, tracks

        vars(made)["step"] = step  # in place of the method
        vars(made)["shorten"] = lambda cells, own: self.shortened.append((link, cells, own))
        return made


def place(uav: Uav, time: float) -> np.ndarray:
    return np.array(uav.position_m) + time * np.array(uav.velocity_mps)


def test_every_terminal_is_given_its_own_frame():
    """Samples that begin with the block of the link's transmitter, the time of their middle, the
    own pose at that time, whether there are data, and at an active terminal what it sent itself.
    Planted bugs: the time of the first block for all; the pose at the start; the other one's data;
    the groups of all for the one who reads two."""
    s, kept = scenario(), Kept()
    setup = prepare(s)
    simulate.run(s, setup=setup, snapshots=2, terminal=kept.terminal, threads=1)
    w = setup.waveform
    assert set(kept.handed) == {Link(a, b) for a in "AB" for b in "PQ"} | {
        Link("A", "A"),
        Link("B", "B"),
    }
    for link, frames in kept.handed.items():
        later = (0 if link.tx == "A" else 5) * 2 * w.max_delay
        assert len(frames) == 6
        for number, (cube, own, time, what, options) in enumerate(frames):
            start = 0.05 * number + later
            assert cube.start_time == pytest.approx(start, abs=1e-15)
            assert time == pytest.approx(start + w.frame_duration / 2, abs=1e-15)
            assert own.position == pytest.approx(place(s.swarm[link.rx], time), abs=1e-12)
            if link.own:
                sent = setup.timetable.payload(link.tx, number)
                assert np.array_equal(what.delay_symbols, sent.delay_symbols)
                assert np.array_equal(what.phases, sent.phases)
            else:
                assert what is (number >= 2)
            assert options["maps"] is (number in setup.timetable.snapshots(2))
    standard = stations.standard_terminal(setup, Link("A", "Q"))
    assert isinstance(standard, PassiveTerminal) and standard._receiver.groups == (0, 2)
    standard = stations.standard_terminal(setup, Link("A", "P"))
    assert isinstance(standard, PassiveTerminal) and standard._receiver.groups is None
    assert isinstance(stations.standard_terminal(setup, Link("B", "B")), ActiveTerminal)


def test_feedback_goes_to_the_links_own_active_terminal(monkeypatch):
    """In frames that active terminals process: the passive one's reception and tracks, the tracks
    of the terminal that it listens to, and the clocks' deviation of that link at that time; an
    answer moves its range as seen from its place then. Planted bugs: the other active terminal's
    tracks; no deviation of the clocks; the place at another time; answers of zero cells counted."""
    s, kept, asked = scenario(access=Access(feedback=True)), Kept(), []
    monkeypatch.setattr(
        type(prepare(s).connections), "offset_std", lambda self, link, time: (link, time)
    )

    def exchange(reception, reported, own, num_rx, clock, waveform):
        asked.append((reported, own, num_rx, clock))
        cells = 3 if clock[0] == ("B", "P") else 0
        return None if clock[0] == ("A", "Q") else Correction(cells, 1.0, True)

    monkeypatch.setattr(feedback, "exchange", exchange)
    run = simulate.run(
        replace_receivers(s, active_every_frames=2), snapshots=0, terminal=kept.terminal, threads=1
    )
    w = prepare(s).waveform
    assert len(asked) == 3 * 4
    for reported, own, num_rx, (link, time) in asked:
        later = (0 if link.tx == "A" else 5) * 2 * w.max_delay
        number = round((time - later - w.frame_duration / 2) / 0.05)
        assert number in (0, 2, 4) and num_rx == 3
        assert time == pytest.approx(0.05 * number + later + w.frame_duration / 2, abs=1e-15)
        assert reported is kept.tracks[link][number]
        assert own is kept.tracks[Link(link.tx, link.tx)][number // 2]
    reports = run.summary["access"]["feedback"]
    assert reports["B->P"] == {"answers": 3, "corrections": 3}
    assert reports["A->P"] == {"answers": 3, "corrections": 0}
    assert reports["A->Q"] == {"answers": 0, "corrections": 0}
    assert [(link, cells) for link, cells, _ in kept.shortened] == [(("B", "P"), 3)] * 3
    for (_, _, own), number in zip(kept.shortened, (0, 2, 4), strict=True):
        time = 0.05 * number + 10 * w.max_delay + w.frame_duration / 2
        assert own.position == pytest.approx(place(s.swarm["P"], time), abs=1e-12)


def replace_receivers(s: Scenario, **change) -> Scenario:
    return s.model_copy(update={"receivers": s.receivers.model_copy(update=change)})


def test_the_stages_before_the_data_are_given_the_scenario(monkeypatch):
    """They end by the first frame; each receiver has the noise that its own SNR says: the passive
    ones' under the line of sight of the first that sends, the active ones' under their strongest
    echo. Planted bugs: all passive ones with one noise; a start at zero; drifts in ppm; the clocks
    of an external source kept."""
    drifting = {
        name: uav.model_copy(update={"clock_offset_s": 1e-8 * i, "clock_drift_ppm": 0.01 * i})
        for i, (name, uav) in enumerate(scenario().swarm.items())
    }
    reports: list[Any] = []

    def establish(network):
        reports.append(network)
        return Establishment({"A": 0, "B": None}, {}, {}, {}, 0, 0, 0, 0, 1, 0.1)

    monkeypatch.setattr(protocol, "establish", establish)
    access = Access(establish=True, synchronisation="two_round")
    s = scenario(swarm=drifting, access=access, modulation=Modulation(acquisition_frames=2))
    setup = prepare(s)
    (n,) = reports
    w = setup.waveform
    frames = 2 * (2 * -(-w.num_resource_blocks // 3) + 1 + 2)
    assert n.longest == pytest.approx(frames * w.frame_duration)
    assert n.start == pytest.approx(-frames * w.frame_duration)
    assert n.wishes == {"A": 0, "B": 5}
    assert n.listeners == {"A": ("P", "Q"), "B": ("P", "Q")}
    assert not n.external_clock and (n.seed, n.dpsk_order) == (3, s.modulation.dpsk_order)
    for i, name in enumerate("ABPQ"):
        assert n.clocks[name].offset == pytest.approx(1e-8 * i)
        assert n.clocks[name].drift == pytest.approx(1e-8 * i)
    wavelength = 299_792_458 / w.carrier_frequency
    first = {name: place(uav, w.frame_duration / 2) for name, uav in s.swarm.items()}
    for name in "PQ":
        friis = (wavelength / (4 * np.pi * np.linalg.norm(first["A"] - first[name]))) ** 2
        assert n.noise_power[name] == pytest.approx(friis / 10**0.3, rel=1e-6, abs=0)
    for name in "AB":
        nearest = min(np.linalg.norm(first[name] - x) for k, x in first.items() if k != name)
        echo = wavelength**2 * 10**-1.281 / ((4 * np.pi) ** 3 * nearest**4)
        assert n.noise_power[name] == pytest.approx(echo / 10**0.3, rel=1e-6, abs=0)
    assert setup.timetable.blocks == {"A": 0, "B": None}
    prepare(s.model_copy(update={"access": replace_access(access)}))
    assert reports[1].external_clock and reports[1].clocks == {}


def replace_access(access: Access) -> Access:
    return access.model_copy(update={"synchronisation": "external"})
