"""Whole runs with several transmitters, streams, changes of role and many UAVs."""

from __future__ import annotations

import numpy as np
import pytest

from isac_rt.frame.settings import Array, Modulation, Noise, RoleChange
from isac_rt.propagation.settings import Propagation
from isac_rt.receive.settings import Receivers
from isac_rt.scenario.radio import Radio
from isac_rt.scenario.swarm import Uav
from isac_rt.scenario.tree import Scenario
from isac_rt.simulation import simulate
from isac_rt.simulation.setup import prepare

SMALL = Radio(samples_per_chirp=256, bandwidth_hz=320e6, chirps_per_frame=60)
"""A frame of an eighth of the paper's samples: range cells of half a metre one way, 16 m of data
range per 2 dB."""
QUIET = Propagation(leakage={"enabled": False})
ARRAY = Array(element_pattern="isotropic", element_gain_dbi=0)


def uav(
    role: str,
    place: tuple[float, float, float],
    velocity: tuple[float, float, float],
    facing: tuple[float, float, float],
) -> Uav:
    return Uav(
        role=role,
        position_m=place,
        velocity_mps=velocity,
        boresight=facing,
        rcs={"model": "constant"},
    )


NORTH, SOUTH = (0, 1, 0), (0, -1, 0)
A = uav("active", (0.3, 0.2, 50.0), (0.7, 3.1, 0.0), NORTH)
B = uav("active", (9.7, 1.1, 53.0), (-0.4, 2.3, 0.3), NORTH)
P1 = uav("passive", (-3.9, 17.3, 50.7), (0.2, -1.9, 0.1), SOUTH)
P2 = uav("passive", (6.1, 19.9, 52.3), (1.1, 0.6, -0.2), SOUTH)


def scenario(swarm: dict[str, Uav], **changes) -> Scenario:
    base = {
        "name": "roles",
        "seed": 5,
        "frames": 6,
        "radio": SMALL,
        "array": ARRAY,
        "propagation": QUIET,
        "noise": Noise(model="snr", snr_db=3.0),
        "modulation": Modulation(acquisition_frames=2, pilot_every_frames=None),
    }
    return Scenario(**base | changes, swarm=swarm)


def test_two_active_terminals_in_their_own_blocks_do_not_hear_each_other():
    """Bit for bit what each link receives when the other is a mere body; every symbol right.
    Planted bug: the second AT in the blocks of the first."""
    both = simulate.run(scenario({"A": A, "B": B, "P1": P1, "P2": P2}))
    alone = simulate.run(
        scenario({"A": A, "B": B.model_copy(update={"role": "target"}), "P1": P1, "P2": P2})
    )
    assert set(both.summary["links"]) == {"A->A", "B->B", "A->P1", "A->P2", "B->P1", "B->P2"}
    for name, block in both.summary["links"].items():
        if name in alone.summary["links"]:
            other = alone.summary["links"][name]
            assert block["targets"] == other["targets"], name
            # all are scored as targets in a swarm of terminals, and B alone where it is a mere body
            for key in ("ser_delay", "ser_dpsk", "bits", "false_per_frame", "clutter_per_frame"):
                assert block[key] == other[key], name
        if name[0] != name[-1]:
            assert block["ser_delay"] == block["ser_dpsk"] == block["erased"] == 0, name
    pooled = both.summary["terminals"]["P1"]
    assert (
        pooled["bits"]
        == both.summary["links"]["A->P1"]["bits"] + both.summary["links"]["B->P1"]["bits"]
    )
    assert both.dataset.transmitter.sel(observer="B->P1") == "B"


def test_two_active_terminals_in_one_block_collide():
    """Both at like distances in the same blocks: at each terminal at least one of the two streams
    is lost."""
    swarm = {
        "A": A.model_copy(update={"resource_block": 0}),
        "B": B.model_copy(update={"resource_block": 0}),
        "P1": P1,
    }
    links = simulate.run(scenario(swarm)).summary["links"]
    assert max(links["A->P1"]["ser_delay"], links["B->P1"]["ser_delay"]) > 0.3


def test_streams_reach_their_terminals():
    """One group for P1, two for P2: each decodes its own and its rate is that of its groups, less
    the 8 bits by which it checks them. Planted bugs: all groups counted; one check sum for all
    groups, which neither can check."""
    streams = {"P1": (1,), "P2": (0, 2)}
    s = scenario(
        {"A": A, "P1": P1, "P2": P2},
        modulation=Modulation(acquisition_frames=2, pilot_every_frames=None, streams=streams),
    )
    run = simulate.run(s)
    per_group = prepare(s).waveform.bits_per_frame(8) // 3
    for name, groups in streams.items():
        block = run.summary["terminals"][name]
        assert block["ser_delay"] == block["ser_dpsk"] == block["erased"] == 0, name
        assert block["bits"] == 4 * (len(groups) * per_group - 8)


def test_a_change_of_roles_in_flight():
    """P1 takes over at frame 5: A and P2 acquire it in the next two frames and decode from then
    on."""
    s = scenario(
        {
            "A": A,
            "P1": P1.model_copy(update={"boresight": SOUTH}),
            "P2": P2.model_copy(update={"boresight": (-1, -0.2, 0)}),
        },
        frames=11,
        role_changes=(RoleChange(frame=5, from_uav="A", to_uav="P1"),),
    )
    run = simulate.run(s)
    links = run.summary["links"]
    for name in ("A->P1", "A->P2", "P1->A", "P1->P2"):
        assert links[name]["ser_delay"] == links[name]["ser_dpsk"] == 0, name
    assert run.summary["terminals"]["A"]["role"] == ["active", "passive"]
    d = run.dataset
    decoded = d.decoded.sel(observer="P1->A").values
    assert decoded.tolist() == [False] * 7 + [True] * 4
    assert not d.processed.sel(observer="A->A").values[5:].any()


@pytest.mark.slow
def test_a_swarm_of_thirty_two():
    """Two ATs, six PTs, 24 others on a jittered grid: all data links that see their AT decode; the
    ATs track most of what they see."""
    rng = np.random.default_rng(3)
    swarm: dict[str, Uav] = {}
    for i in range(32):
        place = (
            7.1 * (i % 6) - 18 + rng.normal(),
            6.7 * (i // 6) + 3 + rng.normal(),
            50 + 5 * rng.normal(),
        )
        role = "active" if i < 2 else "passive" if i < 8 else "target"
        swarm[f"U{i}"] = uav(
            role, place, tuple(2.5 * rng.normal(size=3)), NORTH if i < 2 else SOUTH
        )
    s = scenario(
        swarm,
        frames=12,
        receivers=Receivers(active_every_frames=1),
        noise=Noise(model="snr", snr_db=0.0),
        radio=Radio(chirps_per_frame=60),
    )
    run = simulate.run(s)
    links = run.summary["links"]
    assert len(links) == 2 + 2 * 6
    good = [b for name, b in links.items() if b["role"] == "passive" and b["ser_delay"] < 0.01]
    assert len(good) >= 9
    assert all(b["tracked_rate"] > 0.5 for name, b in links.items() if b["role"] == "active")
