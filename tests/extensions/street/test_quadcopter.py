"""The quadcopter's scene, the plan's line on it, and the benchmark of moving centres."""

from __future__ import annotations

import numpy as np
import pytest

import isac_rt as irt
from benchmarks import moving
from isac_rt.frame.link import Link
from isac_rt.simulation.audit import make_plan

OWN = Link("radar", "radar")
SCENE = "scenes/quadcopter.yaml"


def samples(*changes):
    """Noisy samples of the scene's second frame."""
    setup = irt.prepare(irt.load(SCENE, list(changes)))
    return setup.frame(1).samples(OWN).samples


def test_blades_spread_over_all_velocities_of_their_range_cell():
    """The mean over velocities of what turning blades add is their mean power over a turn; blades
    at rest add nothing beyond the body's cell. Planted bug: `turning` without its sixtieth."""
    body, turning, still = (
        samples(*change)
        for change in (
            ["swarm.Q.rotors=null"],
            ["swarm.Q.rotors.blade_dbsm=0"],
            ["swarm.Q.rotors.blade_dbsm=0", "swarm.Q.rotors.rev_per_min=0"],
        )
    )
    window = np.hanning(body.shape[2] // 3)[:, None] * np.hanning(body.shape[3])

    def spectrum(cube):
        return np.abs(np.fft.fft2(cube[0, 0, ::3] * window)) ** 2

    cell = int(spectrum(body).sum(axis=0).argmax())
    near = slice(cell - 2, cell + 3)
    away = slice(8, -8)  # of zero velocity and the window's skirt
    power = {
        name: spectrum(cube - body)[away, near].mean()
        for name, cube in (("turning", turning), ("still", still))
    }
    assert power["turning"] > 1e3 * power["still"]


def test_the_quadcopter_is_tracked():
    """Regression: found in every frame while it hovers, tilts and flies off, a track from the third
    on, no false tracks. Planted bug: blades of 0 dBsm in the scene."""
    run = irt.run(irt.load(SCENE), progress=False, snapshots=0)
    targets = run.summary["terminals"]["radar"]["targets"]["Q"]
    assert targets["in_view"] == targets["found"] == 20 and targets["tracked"] >= 16
    assert run.summary["terminals"]["radar"]["false_tracks_per_frame"] == 0
    assert run.summary["links"]["radar->radar"]["rmse"]["velocity_mps"] < 0.004


def test_the_plan_names_the_rotors():
    """Planted bug: `model.jerk` for `model.speed` in `report`."""
    items = make_plan(irt.prepare(irt.load(SCENE)))["items"]
    (line,) = [i for i in items if i["what"] == "moving parts of Q"]
    assert "8 blades as 912 points" in line["modelled"]
    assert "3.873e+04 Hz" in line["modelled"]
    assert line["estimate"] == 1e-3


def test_a_pedestrian_of_many_points_is_exact_within_chirps():
    """0.05 % against places at every sample. Planted bug: directions that stay over the frame."""
    job = moving.Job(8)
    some = range(0, 24, 6)
    assert moving.relative(job.samples()[:, :, ::6], job.truth(some)) < 5e-4


def test_limbs_move_as_their_places_say():
    """Velocities and accelerations against differences of places. Planted bugs: the sign of the
    centripetal term; `ahead` for `up` in the velocity."""
    walker = moving.Job(1).walker
    t, h = np.array([0.2]), 1e-4
    before, now, after = (walker.motion(t + d) for d in (-h, 0.0, h))
    assert (after.place - before.place) / (2 * h) == pytest.approx(now.velocity, abs=1e-5)
    assert (after.velocity - before.velocity) / (2 * h) == pytest.approx(now.acceleration, abs=1e-4)
    # a step is as long as the pedestrian walks in half a cycle
    speed = 1.4
    person = moving.walker_of(1.75, speed, 1.0, np.random.default_rng(4))
    leg = person.length.max()
    assert 4 * leg * np.sin(person.swing.max()) == pytest.approx(speed * 2 * np.pi / person.rate)


def test_a_run_of_one_frame_passes():
    """Planted bug: `_off_the_ends` of one place."""
    assert irt.prepare(irt.load(SCENE, ["frames=1"])).timetable.frames == 1
