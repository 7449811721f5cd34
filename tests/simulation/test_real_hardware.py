"""Real hardware from a scenario to its results."""

from __future__ import annotations

import numpy as np
import pytest

import isac_rt as irt
from isac_rt.frame.schedule import codes_of
from isac_rt.scenario.tree import Scenario
from isac_rt.simulation.audit import make_plan

FREE = "radio.front_end.oscillator={mask_dbc_hz: [[1e4, -45], [1e7, -105]], locked: false}"


@pytest.fixture(scope="module")
def scenes():
    return [
        irt.load("scenes/paper_swarm_consistent.yaml", [*changes, "frames=5"])
        for changes in ([], [FREE])
    ]


def test_oscillators_reach_data_and_samples(scenes):
    """-85 dBc/Hz at 1 MHz without a lock is a walk of 4 rad from chirp to chirp at a passive
    terminal, where no phase symbol survives (7 of 8 are wrong by chance); what the active terminal
    hears of its own oscillator is hardly worse. Planted bugs: front ends by link in place of by
    terminal; a frame's phase drawn from its number."""
    ideal, noisy = (irt.prepare(scene).frame(0) for scene in scenes)
    own, other = (f.samples(("AT", "AT")).samples for f in (ideal, noisy))
    assert 1e-4 < np.linalg.norm(other - own) / np.linalg.norm(own) < 0.2
    own, other = (f.samples(("AT", "PT1")).samples for f in (ideal, noisy))
    assert np.linalg.norm(other - own) > np.linalg.norm(own)
    again = irt.prepare(scenes[1]).frame(0).samples(("AT", "PT1")).samples
    assert np.array_equal(again, other)


def test_no_phase_symbol_survives_a_free_walk(scenes):
    good, bad = (irt.run(scene).summary["terminals"]["PT1"]["ser_dpsk"] for scene in scenes)
    assert good < 0.05
    assert bad > 0.7


def test_the_plan_states_each_part_by_itself(scenes):
    """By link the parts that are not ideal, and none where all are. Planted bug: the parts of the
    receiver alone."""
    scene = irt.load(
        "scenes/paper_swarm_consistent.yaml",
        ["frames=4", "swarm.AT.front_end={preset: pll_poor, saturation_dbm: null}"],
    )
    found = [
        (item["link"], item["modelled"], item["estimate"])
        for item in make_plan(irt.prepare(scene))["items"]
        if item["what"] == "hardware"
    ]
    assert {link for link, _, _ in found} >= {"AT->PT1", "AT->PT2"}
    assert {part for _, part, _ in found} == {"oscillator"}
    assert all(error is None or error < 0 for *_, error in found)
    ideal = make_plan(irt.prepare(scenes[0]))["items"]
    assert not [item for item in ideal if item["what"] == "hardware"]


def sent_at_once(**front_end):
    """Samples of three antennas by Doppler division before one target, and the codes."""
    scenario = Scenario(
        seed=3,
        frames=1,
        radio={
            "mode": "fmcw",
            "scheme": "ddm",
            "samples_per_chirp": 64,
            "chirps_per_frame": 24,
            "front_end": front_end,
        },
        array={"tx_x": 2, "tx_z": 2, "rx_x": 3, "rx_z": 3},
        swarm={
            "R": {"role": "active", "position_m": [0, 0, 30], "boresight": [0, 1, 0]},
            "T": {
                "role": "target",
                "position_m": [1, 8, 31],
                "rcs": {"model": "constant", "value_dbsm": 20},
            },
        },
        propagation={"model": "free_space"},
        noise={"model": "link_budget"},
    )
    setup = irt.prepare(scenario)
    return setup.frame(0).samples(("R", "R")).samples, codes_of(setup.waveform)


def test_antennas_that_send_at_once_have_their_own_gains():
    """Doppler division: what 6 dB more at one antenna adds turns from chirp to chirp as its code,
    and what it adds at all of them is the sum. Such a run ended in a traceback."""

    def samples(*gain_db):
        return sent_at_once(transmit={"gain_db": gain_db})

    double = 20 * np.log10(2)
    ideal, codes = samples(1e-9, 0, 0)
    more = [samples(*np.eye(3)[a] * double)[0] - ideal for a in range(3)]
    for one, code in zip(more, codes, strict=True):
        turned = one / one[:, :, :1] * code[0]
        np.testing.assert_allclose(turned, np.broadcast_to(code[:, None], turned.shape), atol=0.02)
    every = samples(*np.full(3, double))[0] - ideal
    np.testing.assert_allclose(sum(more), every, atol=1e-3 * np.abs(every).max())


def test_a_wrong_step_of_a_phase_shifter_shows_where_the_code_takes_it():
    """Codes of four phases, shifters of 64 steps of which that of 90 degrees is 10 off: antenna 1,
    160 dB over the others, takes it in every fourth chirp; antenna 2, which goes from 0 to 180
    degrees, never. Planted bug: the step of the neighbouring antenna's code."""
    errors = np.zeros(64)
    errors[16] = 10.0
    alone = [{"gain_db": (160 * np.eye(3)[a] - 100).tolist()} for a in (1, 2)]
    shifter = {"bits": 6, "errors_deg": errors.tolist()}
    for transmit, off in zip(alone, (10.0, 0.0), strict=True):
        still, codes = sent_at_once(transmit=transmit)
        found, _ = sent_at_once(transmit=transmit, shifter=shifter)
        strong = np.abs(still) > 0.5 * np.abs(still).max()
        turn = np.broadcast_to((np.arange(24) % 4 == 1)[:, None] * off, still.shape)
        ratio = np.angle(found / still, deg=True)
        np.testing.assert_allclose(ratio[strong], turn[strong], atol=0.2)
    assert codes[1][1] == pytest.approx(1j)
