"""The stages before the data and the clocks in whole runs."""

from __future__ import annotations

import numpy as np
import pytest

from isac_rt.extensions.access.protocol import Establishment, LinkState
from isac_rt.extensions.access.synchronise import ClockEstimate
from isac_rt.frame.access import Access
from isac_rt.frame.clock import Clock
from isac_rt.frame.settings import Array, Modulation, Noise, RoleChange
from isac_rt.propagation.settings import Propagation
from isac_rt.receive.settings import Receivers
from isac_rt.scenario.radio import Radio
from isac_rt.scenario.swarm import Uav
from isac_rt.scenario.tree import Scenario
from isac_rt.simulation import simulate
from isac_rt.simulation.connections import Connections

C = 299792458.0
SMALL = Radio(samples_per_chirp=256, bandwidth_hz=320e6, chirps_per_frame=60)
A = Uav(
    role="active",
    position_m=(0.3, 0.2, 50.0),
    velocity_mps=(0.7, 3.1, 0.0),
    boresight=(0, 1, 0),
    rcs={"model": "constant"},
    clock_offset_s=31.7e-9,
    clock_drift_ppm=0.004,
)
P = Uav(
    role="passive",
    position_m=(-3.9, 17.3, 50.7),
    velocity_mps=(0.2, -1.9, 0.1),
    boresight=(0, -1, 0),
    rcs={"model": "constant"},
    clock_offset_s=-14.3e-9,
    clock_drift_ppm=-0.0113,
)


def run(**change):
    base = {
        "name": "access",
        "seed": 5,
        "frames": 5,
        "radio": SMALL,
        "array": Array(element_pattern="isotropic", element_gain_dbi=0),
        "propagation": Propagation(leakage={"enabled": False}),
        "noise": Noise(model="snr", snr_db=3.0),
        "modulation": Modulation(acquisition_frames=2, pilot_every_frames=None),
        "swarm": {"A": A, "P": P},
    }
    return simulate.run(Scenario(**base | change))


def reference(results):
    """Range and velocity of the passive terminal's line of sight less the truth, one row per
    frame."""
    d = results.dataset
    rows = []
    for frame in range(d.sizes["frame"]):
        here = (
            (d.det_frame == frame)
            & (d.det_observer == list(d.observer.values).index("P"))
            & d.det_is_reference
        )
        truth = d.isel(frame=frame).sel(observer="P", uav="A")
        one = d.isel(detection=np.flatnonzero(here.values)[0])
        rows.append(
            [
                float(one.det_range - truth.truth_range),
                float(one.det_velocity - truth.truth_velocity),
            ]
        )
    return np.array(rows)


def test_two_rounds_leave_no_clock_in_the_range():
    """46 ns and 15.3e-9 apart at the start (13.8 m, 4.6 m/s); what is left is what the two rounds
    say, and the data flow.

    Planted bug: the estimate's drift left out of the correction, 0.1 s after the first round (4.6
    m/s)."""
    r = run(access=Access(establish=True, synchronisation="two_round"))
    got = r.summary["access"]["links"]["A->P"]
    assert got["acknowledged"]
    assert abs(got["clock_error_s"]) < 4 * got["clock_error_std_s"] < 1e-9
    assert abs(got["drift_error"]) < 1e-9
    error = reference(r)
    assert error[:, 0] == pytest.approx(
        C * got["clock_error_s"], abs=0.05
    )  # the ranges' own spread: a tenth of a 0.47 m cell
    assert error[:, 1] == pytest.approx(C * got["drift_error"], abs=0.05)
    assert r.summary["terminals"]["P"]["ser_delay"] == r.summary["terminals"]["P"]["ser_dpsk"] == 0


def test_uncorrected_clocks_bias_range_and_velocity_and_not_the_data():
    """The paper's claim, on the signal: the whole offset is in the range, the drift in the
    velocity, no symbol is wrong.

    Planted bug: the sign of the receiver's clock."""
    r = run(access=Access(synchronisation="none"))
    epochs = r.dataset.time.values
    error = reference(r)
    assert error[:, 0] == pytest.approx(C * (46.0e-9 + 15.3e-9 * epochs), abs=0.05)
    assert error[:, 1] == pytest.approx(np.full(5, C * 15.3e-9), abs=0.05)
    assert r.summary["access"] is None
    assert r.summary["terminals"]["P"]["ser_delay"] == r.summary["terminals"]["P"]["ser_dpsk"] == 0


def test_an_external_source_takes_the_clocks_out():
    """Bit for bit the run of terminals with perfect clocks."""
    perfect = {
        name: uav.model_copy(update={"clock_offset_s": 0.0, "clock_drift_ppm": 0.0})
        for name, uav in (("A", A), ("P", P))
    }
    one, other = run(frames=3).summary, run(frames=3, swarm=perfect).summary
    assert one["links"] == other["links"]


def test_a_link_that_noise_hides_carries_nothing():
    """At -45 dB per sample the announcement is not understood: the link is not there, and the
    summary says why."""
    r = run(
        frames=3,
        noise=Noise(model="snr", snr_db=-45.0),
        access=Access(establish=True, synchronisation="two_round"),
    )
    assert set(r.summary["links"]) == {"A->A"}
    assert set(r.summary["terminals"]) == {"A"}
    assert r.summary["access"]["missed_announcements"] == 1
    assert r.summary["access"]["links"]["A->P"] == {
        "identified": False,
        "acknowledged": False,
        "clock_error_s": None,
        "clock_error_std_s": None,
        "drift_error": None,
    }


def test_clocks_between_any_two_terminals():
    """A receiver corrects by what it knows of its link's transmitter; its own echoes need nothing,
    an interferer keeps its own clock.

    Planted bug: the interferer corrected by its own estimate."""
    clocks = {"A": Clock(3.1e-8, 4e-9), "B": Clock(-1.7e-8, 1.3e-8), "P": Clock(5.3e-9, -7e-9)}
    estimate = ClockEstimate(
        time=-0.2, offset=2.5e-8, drift=1.05e-8, range=0, velocity=0, covariance=np.eye(4)
    )
    state = LinkState(0, None, True, estimate, True, True)
    links = {("A", "P"): state}
    c = Connections(clocks, Establishment({"A": 0, "B": None}, links, {}, {}, 0, 0, 0, 0, 34, 0.3))
    t = 1.3
    known = 2.5e-8 + 1.05e-8 * 1.5
    left = c.clock_difference("A", ("A", "P"), t)
    assert left.offset == pytest.approx(
        (3.1e-8 + 4e-9 * t) - (5.3e-9 - 7e-9 * t) - known, abs=1e-20
    )
    assert left.drift == pytest.approx(1.1e-8 - 1.05e-8, abs=1e-20)
    other = c.clock_difference("B", ("A", "P"), t)
    assert other.offset == pytest.approx(
        (-1.7e-8 + 1.3e-8 * t) - (5.3e-9 - 7e-9 * t) - known, abs=1e-20
    )
    assert c.clock_difference("A", ("A", "A"), t) == Clock()
    assert c.clock_difference("B", ("A", "A"), t).offset == pytest.approx(
        -4.8e-8 + 9e-9 * t, abs=1e-20
    )
    assert c.refused == frozenset()


@pytest.mark.parametrize(
    ("access", "said"),
    [
        (Access(synchronisation="two_round"), "establish"),
        (Access(establish=True), "role"),
    ],
)
def test_what_cannot_be_together_is_refused(access, said):
    changes = (
        {"role_changes": (RoleChange(frame=2, from_uav="A", to_uav="P"),)}
        if access.establish
        else {}
    )
    with pytest.raises(ValueError, match=said):
        run(access=access, **changes)


@pytest.mark.parametrize("feedback", [True, False])
def test_feedback_undoes_a_slip(monkeypatch, feedback):
    """The terminal's own repair taken away and its range a cell too long from frame 7 on: read
    wrong in frames 7 and 8, after which the active terminal answers, or to the end. The active
    terminal processes every second frame.

    Planted bug: the range moved the other way."""
    from isac_rt.track import reference, terminal

    monkeypatch.setattr(reference.Reference, "slip", lambda *frame: 0)
    step, times = terminal.PassiveTerminal.step, []

    def slipping(self, cube, own_pose, time, modulated, **options):
        times.append(time)
        if len(times) == 8:
            self.shorten(-1, own_pose)
        return step(self, cube, own_pose, time, modulated, **options)

    monkeypatch.setattr(terminal.PassiveTerminal, "step", slipping)
    r = run(frames=12, access=Access(feedback=feedback), receivers=Receivers(active_every_frames=2))
    wrong = 2 if feedback else 5
    assert r.summary["terminals"]["P"]["ser_delay"] == pytest.approx(
        wrong / 10, abs=0.01
    )  # a slipped symbol is never right
    told = (r.summary["access"] or {}).get("feedback")
    assert (told["A->P"]["corrections"] if feedback else told) == (1 if feedback else None)
