"""A scenario, antennas and receivers from Python."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from isac_rt.document import ScenarioError, ScenarioWarning
from isac_rt.frame.antennas import Antennas
from isac_rt.receive.active import receive_active
from isac_rt.receive.passive import receive_passive
from isac_rt.receive.types import Reception, no_detections
from isac_rt.scenario.file import load, to_yaml
from isac_rt.scenario.swarm import Uav
from isac_rt.simulation.setup import prepare
from isac_rt.simulation.simulate import run

TREE = {
    "frames": 3,
    "radio": {"samples_per_chirp": 128, "chirps_per_frame": 12},
    "modulation": {"acquisition_frames": 1},
    "array": {
        "rx_x": np.int64(3),
        "rx_z": 3,
        "element_pattern": "isotropic",
        "element_gain_dbi": 0,
    },
    "swarm": {
        "AT": {"role": "active", "position_m": np.array([0.0, 0, 10])},
        "PT": {"role": "passive", "position_m": (1, 8, 12), "boresight": [0, -1, 0]},
        "U": Uav(role="target", position_m=(2, 6, 11)),
    },
}


def test_a_dict_is_a_scenario(tmp_path):
    """With numpy's numbers, tuples and nodes; the same as its YAML. Bug: defaults of a node taken
    for stated."""
    s = load(TREE, ["noise.tx_power_dbm=20"], frames=4)
    assert (s.frames, s.noise.tx_power_dbm, s.array.rx_x) == (4, 20, 3)
    assert s.swarm["AT"].position_m == (0, 0, 10) and s.folder == Path()
    (tmp_path / "s.yaml").write_text(to_yaml(s))
    assert load(tmp_path / "s.yaml").model_dump() == s.model_dump()


@pytest.mark.parametrize(
    ("tree", "said"),
    [
        ({**TREE, "radio": {"groups": 9}}, r"load: radio.groups = 9: 9 groups are more than"),
        ({**TREE, "rado": 1}, r"load: rado = 1: unknown key; did you mean radio"),
        ({**TREE, "seed": 1j}, r"load: seed: complex is no value of a scenario"),
        ({**TREE, "name": b"x"}, r"load: name: bytes is no value"),
        ({"frames": 3}, r"load: swarm: missing"),
    ],
)
def test_a_dict_that_is_none_is_one_message(tree, said):
    """As of a file, with load in its place."""
    with pytest.raises(ScenarioError, match=said):
        load(tree)


def test_other_antennas_find_other_paths():
    """Isotropic elements of twice the amplitude: an echo has four times the amplitude there and
    back, a line of sight too, and the reference with them; other places other samples. Bug: the
    paths of the old antennas."""
    setup = prepare(load(TREE))
    louder = setup.with_antennas(replace(setup.antennas, gain=4 * setup.antennas.gain))
    for link in (("AT", "AT"), ("AT", "PT")):
        before, after = (s.frame(0).paths[link] for s in (setup, louder))
        assert after.gain == pytest.approx(4 * before.gain)
    assert louder.plan.arrays is louder.arrays
    row = setup.with_antennas(
        Antennas.placed(setup.antennas.tx_positions[:, [0, 2]], [(0, 0), (0.002, 0)])
    )
    assert row.frame(0).samples(("AT", "PT")).samples.shape[1] == 2
    with pytest.raises(ValueError, match="of 3 transmit antennas, the array has 1"):
        setup.with_antennas(Antennas.placed([(0, 0)], [(0, 0)]))


class Standard:
    """The package's receivers behind an object that is no terminal."""

    def __init__(self, setup, link):
        self.setup, self.own, self.calls = setup, link.own, 0

    def receive(self, cube, *known):
        self.calls += 1
        a, settings = self.setup.antennas, self.setup.scenario.receivers
        if self.own:
            payload, clutter, maps = known
            return receive_active(cube, payload, a, settings, clutter=clutter, maps=maps)
        prediction, modulated, maps = known
        order = self.setup.scenario.modulation.dpsk_order
        return receive_passive(cube, a, settings, order, prediction, modulated, maps=maps)


def test_any_object_with_receive_is_a_receiver():
    """At both terminals: the standard ones behind another object give the standard numbers, and
    deaf ones nothing. Bug: the object asked at the active terminal only."""
    scenario, made = load(TREE), []

    def standard(setup, link):
        made.append(Standard(setup, link))
        return made[-1]

    usual = run(scenario).summary
    mine = run(scenario, terminal=standard).summary
    assert mine["terminals"] == usual["terminals"] and usual["terminals"]["PT"]["bits"] > 0
    assert [one.calls for one in made] == [3, 3]

    class Deaf:
        def receive(self, cube, *known):
            return Reception.undecoded(cube.waveform, no_detections())

    deaf = run(scenario, terminal=lambda setup, link: Deaf()).summary["terminals"]
    assert [deaf[name]["hit_rate"] for name in ("AT", "PT")] == [0, 0] and deaf["PT"]["bits"] == 0
    with pytest.raises(TypeError, match="is object, which has no receive"):
        run(scenario, terminal=lambda setup, link: object())

    class Forgetful:
        def receive(self, cube, *known):
            Reception.undecoded(cube.waveform, no_detections())

    for at in ("AT", "PT"):  # found at either end

        def forgetful(setup, link, at=at):
            return Forgetful() if link.rx == at else Deaf()

        with pytest.raises(TypeError, match="returned NoneType, not a Reception"):
            run(scenario, terminal=forgetful)


def test_a_row_says_so_before_the_run():
    """Its elevation beam is none, and a run warns; bug: a beam of 90 degrees."""
    row = {"shape": "linear", "columns": 3}
    tree = {**TREE, "array": {"tx": row, "rx": row, "element_pattern": "isotropic"}}
    with pytest.warns(ScenarioWarning, match="does not observe elevation; tracks assume UAVs"):
        setup = prepare(load({**tree, "array": {**tree["array"], "element_gain_dbi": 0}}))
    beams = [link.elevation_resolution_deg for link in setup.coverage.links]
    assert beams == [None, None] and setup.coverage.links[0].azimuth_resolution_deg is not None
