"""What terminals believe wrongly reaches them, and nothing else."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from talking import scenario

from isac_rt.document import ScenarioError
from isac_rt.extensions.city_receivers import static_clutter as standing
from isac_rt.scenario.file import load
from isac_rt.simulation import simulate
from isac_rt.simulation.setup import prepare
from isac_rt.track.settings import Belief

SCENES = Path(__file__).parents[2] / "scenes"

WRONG = Belief(position_m=(0.3, -0.2, 0.1), velocity_mps=(0.5, 0.0, 0.0), attitude_deg=(0, 0, 2.0))


def test_a_believed_pose_is_the_true_one_with_its_errors():
    """Two degrees about the vertical turn the boresight, which looks north, to the west. Planted
    bugs: the turn about the body's own axes; degrees for radians."""
    setup = prepare(scenario(belief=WRONG))
    true = setup.swarm.trajectories["PT"].pose(0.1)
    found = setup.believed(true)
    assert np.allclose(found.position - true.position, [0.3, -0.2, 0.1])
    assert np.allclose(found.velocity - true.velocity, [0.5, 0, 0])
    turned = np.array([[np.cos(a := np.radians(2)), -np.sin(a), 0], [np.sin(a), np.cos(a), 0]])
    assert np.allclose(found.rotation[:2], turned @ true.rotation)
    north = prepare(scenario(belief=WRONG)).believed(setup.swarm.trajectories["AT"].pose(0.0))
    assert north.rotation[0, 1] == pytest.approx(-np.sin(a))
    assert prepare(scenario()).believed(true) is true


def test_only_terminals_are_wrong():
    """Samples, paths and symbols are those of a right run; tracks follow the same echoes, and the
    PT's echo lies where the AT believes it, beside where it is by the error of the position.
    Planted bugs: the swarm itself moved; the true pose told to the others, so that the PT is not
    where it says."""
    belief = WRONG.model_copy(update={"attitude_deg": (0.0, 0.0, 0.0)})
    right = simulate.run(scenario(frames=6), snapshots=0)
    wrong = simulate.run(scenario(frames=6, belief=belief), snapshots=0)
    for name in ("det_range", "det_u_x", "path_power", "uav_position", "symbol_errors", "hit"):
        assert np.array_equal(right.dataset[name], wrong.dataset[name]), name
    places = []
    for d in (right.dataset, wrong.dataset):
        mine = (d.fused_frame.values == 5) & (d.fused_picture.values == 0)
        (k,) = np.flatnonzero(mine & (d.fused_terminal.values == 1))
        places.append([float(d[f"fused_{axis}"].values[k]) for axis in "xyz"])
    # the pair's weights change with what they say
    assert np.allclose(np.subtract(*places[::-1]), belief.position_m, atol=0.05)


def test_a_mesh_without_a_building(tmp_path):
    """Of a ground and two houses the terminals' mesh lacks one: the walls that they hold births
    against, not the city. Planted bug: the city's own mesh cut."""
    houses = [(0, 0), (40, 0)]
    lines = ["v -99 -99 0", "v 99 -99 0", "v 0 99 0"]
    faces = ["usemtl itu_concrete", "f 1 2 3"]
    for k, (x, y) in enumerate(houses):
        lines += [f"v {x} {y} 0", f"v {x + 9} {y} 0", f"v {x} {y} 9"]
        faces += [f"f {4 + 3 * k} {5 + 3 * k} {6 + 3 * k}"]
    (tmp_path / "town.obj").write_text("\n".join(lines + faces))
    (tmp_path / "s.yaml").write_text(
        "name: s\nframes: 4\ncity: {source: mesh, file: town.obj}\n"
        "swarm:\n  A: {role: active, position_m: [5, -30, 5], boresight: [0, 1, 0]}\n"
        "belief: {missing_m: [[39, -1, 50, 1]]}\n"
    )
    setup = prepare(load(tmp_path / "s.yaml"))
    assert setup.city.num_faces == 3
    known = setup.city.without(setup.scenario.belief.missing_m)
    assert sorted((known.corners + known.origin)[..., 0].max(axis=1)) == [9, 99]
    assert setup.city.without([]) is setup.city
    assert setup.city.without([(-200, -200, 0.5, 200)]).num_faces == 3  # none lies wholly within
    with pytest.raises(ScenarioError, match="in this order"):
        load(tmp_path / "s.yaml", ["belief.missing_m=[[5, 0, 1, 2]]"])


@pytest.mark.slow
@pytest.mark.sionna
def test_a_terminal_does_not_believe_its_mesh_against_the_samples(monkeypatch):
    """A street whose houses on one side the terminals' mesh lacks: their walls are found in every
    frame. 0.4 false tracks a frame were measured, 30 with the memory of still echoes switched
    off."""
    said = [
        "clutter={model: field}",
        "modulation={acquisition_frames: 1, pilot_every_frames: null}",
        "belief.missing_m=[[10, -100, 60, 100]]",
    ]
    flight = load(SCENES / "street_canyon.yaml", said, frames=12)

    def false() -> float:
        block = simulate.run(flight, snapshots=0).summary["links"]["AT->AT"]
        return block["false_tracks_per_frame"]

    assert false() < 1
    monkeypatch.setattr(standing, "CROWD", 10**9)
    assert false() > 10
