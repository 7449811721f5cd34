"""What a radar can see: numbers against closed forms written out here, frames outside against
flights by hand, and the range of a line of sight against what a receiver decodes."""

from __future__ import annotations

import warnings
from dataclasses import asdict
from typing import Any

import numpy as np
import pytest

from isac_rt.document import ScenarioWarning
from isac_rt.scenario.tree import Scenario
from isac_rt.simulation import simulate
from isac_rt.simulation.audit import make_plan
from isac_rt.simulation.setup import prepare
from isac_rt.views.tables import coverage_tables

C = 299792458.0
CARRIER, BANDWIDTH, RATE, SAMPLES, CHIRPS = 61.3e9, 433e6, 17.9e6, 128, 36
RADIO = {
    "carrier_hz": CARRIER,
    "bandwidth_hz": BANDWIDTH,
    "sampling_rate_hz": RATE,
    "samples_per_chirp": SAMPLES,
    "chirps_per_frame": CHIRPS,
    "groups": 3,
}
SAMPLED = SAMPLES / RATE
DELAY = SAMPLES / (BANDWIDTH - 2 * RATE)  # T_d
CHIRP = SAMPLED + 2 * DELAY
SLOT = CHIRP + 6 * DELAY
MIDDLE = CARRIER + BANDWIDTH / CHIRP * (2 * DELAY + SAMPLED / 2)
NORTH, SOUTH = [0, 1, 0], [0, -1, 0]


def body(role: str, place: tuple[float, ...], boresight=NORTH, **more: Any) -> dict[str, Any]:
    return {"role": role, "position_m": place, "boresight": boresight, **more}


def scenario(swarm: dict[str, Any], **changes: Any) -> Scenario:
    tree = {
        "name": "seen",
        "frames": 11,
        "frame_interval_s": 0.1,
        "radio": RADIO,
        "array": {"rx_x": 3, "rx_z": 5, "spacing_wavelengths": 0.61},
        "modulation": {"acquisition_frames": 2, "pilot_every_frames": 4, "dpsk_order": 4},
        "noise": {"model": "snr", "snr_db": 21.0},
        "swarm": swarm,
    }
    return Scenario.model_validate(tree | changes)


PAIR = {"A": body("active", (0, 0, 40.0)), "P": body("passive", (0, 7.3, 40.0), SOUTH)}


def test_limits_follow_from_the_settings():
    """Planted bugs: the paper's T_d = f_s T / B; Doppler counted at the start of the chirp; virtual
    elements at the passive terminal; pilots counted as data."""
    seen = prepare(scenario(PAIR)).coverage
    for of in seen.links:
        assert (of.slot_s, of.frame_s) == pytest.approx((SLOT, CHIRPS * SLOT), rel=1e-12)
    assert seen.frame_interval_s == 0.1
    assert [of.link for of in seen.links] == ["A->A", "A->P"]
    for of, passes, (across, up) in zip(seen.links, (2, 1), ((6, 10), (3, 5)), strict=True):
        cell = C * DELAY / SAMPLES / passes
        expected = {
            "max_range_m": C * DELAY / 2 / passes,
            "filtered_range_m": C * DELAY / passes,
            "min_range_m": np.ceil(2.0 / cell) * cell,
            "range_resolution_m": C * CHIRP / (BANDWIDTH * SAMPLED) / passes,
            "velocity_resolution_mps": C / MIDDLE / passes / (CHIRPS * SLOT),
            "max_velocity_mps": C / MIDDLE / passes / SLOT / 2,
            "azimuth_resolution_deg": np.degrees(np.arcsin(1 / (0.61 * across))),
            "elevation_resolution_deg": np.degrees(np.arcsin(1 / (0.61 * up))),
            "field_of_view_deg": 60.0,
        }
        record = asdict(of)
        for key, value in expected.items():
            assert record[key] == pytest.approx(value, rel=1e-9), key
        # at the middle of the range window, which may lie half a data shift off the samples' middle
        assert of.unambiguous_angle_deg == pytest.approx(
            np.degrees(np.arcsin(CARRIER / MIDDLE / 1.22)), rel=2e-4
        )
    # frames 2, 3, 5, 6, 7, 9 and 10 carry 6 bits by delay in every chirp and 2 by phase but in the
    # first of each antenna, but for the check sum
    bits = 3 * (CHIRPS * 6 + (CHIRPS - 3) * 2) - 8
    assert seen.links[1].bit_rate_bps == pytest.approx(7 * bits / (1.0 + CHIRPS * SLOT), rel=1e-12)
    assert seen.links[0].bit_rate_bps is None


def test_schedules_and_streams():
    """One group for the passive terminal, sent by the conventional schedule. Planted bug: the limit
    of the transmitter's own three groups."""
    changes = {"modulation": {"acquisition_frames": 2, "streams": {"P": [1]}}}
    array = {"rx_x": 3, "rx_z": 5, "schedule": "conventional"}
    own, other = prepare(scenario(PAIR, array=array, **changes)).coverage.links
    assert own.max_velocity_mps == pytest.approx(C / MIDDLE / 2 / SLOT / 2, rel=1e-9)
    assert other.max_velocity_mps == pytest.approx(C / MIDDLE / SLOT / 2 / 3, rel=1e-9)
    bits = CHIRPS * 6 + (CHIRPS - 3) * 3 - 8
    assert other.bit_rate_bps == pytest.approx(9 * bits / (1.0 + CHIRPS * SLOT), rel=1e-12)


def test_frames_outside_by_hand():
    """A flies north at 10 m/s past U1; U2 stands beyond the range of echoes in the first frames; U3
    crosses too fast; U4 is near. Planted bugs: the range of one way for echoes; a cause counted
    twice; the frames that A does not process counted."""
    reach = C * DELAY / 4  # of an echo
    half, speed = C * DELAY / SAMPLES / 4, 10.0
    epochs = np.arange(11) * 0.1 + CHIRPS * SLOT / 2
    here = epochs * speed
    limit = C / MIDDLE / 2 / SLOT / 2
    swarm = {
        "A": body("active", (0, 0, 40.0), velocity_mps=(0, speed, 0)),
        "U1": body("target", (4.0, 9.0, 40.0)),
        "U2": body("target", (0, reach + 4.1, 40.0)),
        "U3": body("target", (0, 3.0, 40.0), velocity_mps=(0, limit + 11.0, 0)),
        "U4": body("target", (0, 0.7, 40.0), velocity_mps=(0, speed, 0)),
        "U5": body("target", (0, -reach - 9.0, 40.0)),
    }
    with pytest.warns(ScenarioWarning):
        every = prepare(scenario(swarm)).coverage
    rows = {row.uav: row for row in every.outside}
    assert {row.link for row in every.outside} == {"A->A"} and len(rows) == len(every.outside)
    ahead = 9.0 - here
    hidden = ahead <= 4.0 / np.tan(np.pi / 3)
    assert 0 < hidden.sum() < 11
    assert rows["U1"].out_of_view == hidden.sum() and rows["U1"].unseen == hidden.sum()
    far = reach + 4.1 - here >= reach - half
    assert 0 < far.sum() < 11
    assert rows["U2"].beyond_range == far.sum() == rows["U2"].unseen
    gone = 3.0 + (limit + 1.0) * epochs >= reach - half
    assert 0 < gone.sum() < 11
    assert (rows["U3"].too_fast, rows["U3"].beyond_range) == ((~gone).sum(), gone.sum())
    assert rows["U4"].too_near == 11 == rows["U4"].frames
    assert rows["U5"].out_of_view == 11 == rows["U5"].unseen
    with pytest.warns(ScenarioWarning):
        some = prepare(scenario(swarm, receivers={"active_every_frames": 4})).coverage
    assert {row.uav: row.beyond_range for row in some.outside}["U2"] == far[::4].sum()


def test_reflections_at_a_passive_terminal_by_hand():
    """The whole way counts, and both ends must have the body in view. Planted bug: the distance
    from the receiver alone."""
    reach = C * DELAY / 2
    half = C * DELAY / SAMPLES / 2
    out = (reach + np.array([-0.7, 0.7]) - half) / 2  # in line with both: way out and back
    base = 5.0
    swarm = {
        "A": body("active", (0, 0, 40.0)),
        "P": body("passive", (0, -base, 40.0)),  # behind A, looks the same way: A is in its view
        "NEAR": body("target", (0, out[0] - base / 2, 40.0)),
        "FAR": body("target", (0, out[1] - base / 2, 40.0)),
    }
    with pytest.warns(ScenarioWarning, match="A is outside the coverage of P"):
        rows = prepare(scenario(swarm)).coverage.outside
    at_p = {row.uav: row for row in rows if row.link == "A->P"}
    assert "NEAR" not in at_p
    assert at_p["FAR"].beyond_range == 11 == at_p["FAR"].unseen
    assert at_p["A"].out_of_view == 11  # P is not in A's


@pytest.mark.parametrize(("cells", "read"), [(-1.6, True), (+1.6, False)])
def test_a_line_of_sight_is_lost_at_half_of_the_range(cells, read):
    """N/2 cells, with data and without: a cell nearer every symbol is read, a cell farther none is,
    at 21 dB, and that is warned of before the run. Written against: no word."""
    cell = C * DELAY / SAMPLES
    place = (0, SAMPLES / 2 * cell + cells * cell, 40.0)
    s = scenario({"A": PAIR["A"], "P": body("passive", place, SOUTH)}, frames=6)
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        setup = prepare(s)
    lost = [str(one.message) for one in said if "receives no data" in str(one.message)]
    assert len(lost) == (0 if read else 1)
    link = simulate.summarise(s, setup=setup)["links"]["A->P"]
    assert link["ser_delay"] == (0.0 if read else 1.0)
    if lost:
        limit = f"{C * DELAY / 2:.4g}"
        assert f"P is beyond {limit} m from A in 6 of 6 frames" in lost[0]


def test_who_is_never_seen_is_named_before_the_run():
    """With the cause on each link; who is seen once is not. Planted bug: any link in place of
    every."""
    behind = {**PAIR, "U": body("target", (0, -9.0, 40.0))}
    with pytest.warns(
        ScenarioWarning, match=r"U: outside the coverage of all terminals \(A to A: out"
    ):
        prepare(scenario(behind))
    passing = {**PAIR, "U": body("target", (0, -3.0, 43.0), velocity_mps=(0, 9.0, 0))}
    with warnings.catch_warnings():
        warnings.simplefilter("error", ScenarioWarning)
        prepare(scenario(passing))


def test_plan_run_and_report_show_the_same(tmp_path):
    """One record in `isac-rt plan`, `results.nc` and the report."""
    import json

    s = scenario({**PAIR, "U": body("target", (0, -3.0, 43.0), velocity_mps=(0, 9.0, 0))}, frames=4)
    setup = prepare(s)
    planned = make_plan(setup)["coverage"]
    assert planned == asdict(setup.coverage)
    kept = json.loads(simulate.run(s, setup=setup).dataset.attrs["coverage"])
    assert kept == json.loads(json.dumps(planned))
    limits, words, outside = coverage_tables(kept)
    assert [row[0] for row in limits.rows] == ["A to A", "A to P"]
    assert limits.rows[0][1] == f"{C * DELAY / 4:.3g}"
    assert f"{SLOT * 1e6:.3g} us" in words
    assert outside.rows[0][0] == "U on A to A" and outside.rows[0][-1] == "4"
