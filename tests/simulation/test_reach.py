"""How far the mesh reaches, and how many scatterers there are: decisions that the plan shows and
the summary repeats."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from isac_rt.propagation.clutter.cells import Density, area_for, error_for
from isac_rt.propagation.pathset import PathKind, PathSet
from isac_rt.scenario.tree import Scenario
from isac_rt.simulation import simulate
from isac_rt.simulation.audit import make_plan
from isac_rt.simulation.plan import extent, mechanisms
from isac_rt.simulation.setup import city_of, prepare, propagation_in
from isac_rt.world.city.mesh import CityMesh

SHORT = {"groups": 1, "samples_per_chirp": 256, "chirps_per_frame": 12}
"""A waveform that hears no farther than 66 m."""


def district(seed: int, **changes: Any) -> Scenario:
    """Three bodies between many blocks of houses, drawn at random: nothing was tuned on it."""
    rng = np.random.default_rng(seed)
    swarm = {
        name: {
            "role": role,
            "position_m": rng.uniform([-5, -30, 6], [5, 30, 17]).tolist(),
            "velocity_mps": rng.normal(0, 4, 3).tolist(),
            "boresight": [*rng.normal(0, 1, 2).tolist(), 0],
        }
        for name, role in (("A", "active"), ("P", "passive"), ("U", "target"))
    }
    tree = {
        "name": f"district{seed}",
        "seed": seed,
        "frames": 3,
        "frame_interval_s": 0.4,
        "radio": SHORT,
        "modulation": {"acquisition_frames": 1},
        "receiver_preset": "plain",
        "city": {
            "source": "blocks",
            "street_width_m": float(rng.uniform(14, 24)),
            "block_size_m": float(rng.uniform(14, 27)),
            "blocks_x": 8,
            "blocks_y": 8,
            "building_height_m": 12,
            "height_spread_m": 4,
        },
        "swarm": swarm,
        "propagation": {"model": "ray_traced", "max_bounces": 2, "rays": 20_000},
        "clutter": {"model": "field", "cell_area_per_metre_m": 0.4},
    } | changes
    return Scenario.model_validate(tree)


def places(paths: PathSet, city: CityMesh, kind: PathKind) -> set[tuple[int, ...]]:
    """Of each path of one kind its delay and its points, in whole micrometres of way and
    millimetres of place."""
    some = paths.select(paths.kind == kind)
    return {
        (round(delay * 3e14), *np.rint(np.nan_to_num(points.ravel()) * 1e3).astype(int))
        for delay, points in zip(some.delay, some.points, strict=True)
    }


@pytest.mark.sionna
@pytest.mark.parametrize("seed", [311, 312])
def test_a_cut_mesh_returns_all_that_is_heard(seed: int):
    """Whole and cut meshes of two districts: the same line of sight, echoes, ghosts, mirror images
    and scatterers within the filter, with the same gains. Planted bug: the reach counted one way,
    half of it."""
    setup = prepare(district(seed))
    whole = city_of(setup.scenario)
    assert setup.city.num_faces + setup.city.num_beyond == whole.num_faces
    assert setup.city.num_beyond > 0.3 * whole.num_faces
    full = propagation_in(whole, setup.scenario)
    part = propagation_in(setup.city, setup.scenario)
    seen = set()
    for frame in (0, 2):
        epoch = setup.timetable.epoch(frame)
        poses = setup.swarm.poses(epoch)
        links = [("A", "A"), ("A", "P")]
        expected, got = (model.trace(poses, epoch, links).paths for model in (full, part))
        for link in links:
            a, b = (
                one[link].select(one[link].delay <= setup.plan.longest_delay)
                for one in (expected, got)
            )
            assert len(a) == len(b) > 0
            for kind in PathKind:
                assert places(a, whole, kind) == places(b, setup.city, kind), kind
            seen |= set(a.kind.tolist())
            power = [np.sort(one.power) for one in (a, b)]
            # Sionna's float32 amplitudes, of a chain that it found next to an edge: 3e-4 where it
            # bounces 7 cm from one
            assert power[1] == pytest.approx(power[0], rel=1e-3, abs=0)
    assert seen >= {PathKind.TARGET, PathKind.DIFFUSE} and len(seen) >= 4


def test_a_city_within_a_radius():
    """Faces that come near enough stay whole with their materials. Planted bug: the distance of
    centroids."""
    city = city_of(district(313))
    part = city.within(61.7)
    nearest = np.linalg.norm(city.corners, axis=2).min(axis=1)
    assert part.num_faces + part.num_beyond == city.num_faces
    # by corners alone: whatever has a corner inside stays; what stays and has none inside is larger
    # than its distance
    kept = {tuple(np.sort(face, axis=0).ravel()) for face in np.round(part.corners, 9)}
    for face, distance in zip(np.round(city.corners, 9), nearest, strict=True):
        if distance <= 61.7:
            assert tuple(np.sort(face, axis=0).ravel()) in kept
    ground = [m.name for m in city.materials]
    assert [m.name for m in part.materials] == ground
    assert part.within(61.7) is part
    assert city.within(np.inf) is city
    none = city.within(1e-3) if nearest.min() > 1e-3 else city
    assert none.num_faces + none.num_beyond == city.num_faces


def test_the_reach_follows_the_groups():
    """One group hears up to T_d and the filter's skirt, three up to 4 T_d more. Planted bug: the
    number of groups for their distance."""
    w = prepare(district(314)).waveform
    for groups in (1, 3):
        plan = prepare(district(314, radio=SHORT | {"groups": groups})).plan
        expected = (
            (w.max_delay + 0.4e6 / w.slope + (groups - 1) * 2 * w.max_delay) * 299_792_458 / 2
        )
        assert plan.reach == pytest.approx(expected, rel=1e-9)
        far = max(
            np.linalg.norm(plan.swarm.poses(plan.timetable.epoch(f))[n].position)
            for f in range(3)
            for n in "AP"
        )
        assert plan.mesh_radius(np.zeros(3)) - far - expected == pytest.approx(
            1.6, abs=1.2
        )  # whole metres, a metre, the way in a frame
    free = district(314, propagation={"model": "free_space"}, city=None, clutter={"model": "none"})
    assert prepare(free).plan.whole_mesh
    everything = prepare(district(314, accuracy={"preset": "everything"}))
    assert everything.city.num_beyond == 0


@pytest.mark.sionna
def test_the_plan_counts_what_the_summary_counts():
    """Faces and scatterers. Planted bug: the candidates of the field in place of its scatterers in
    the plan."""
    s = district(315, frames=2)
    setup = prepare(s)
    planned, done = make_plan(setup), simulate.summarise(s)["fidelity"]
    record = extent(setup.city, setup.propagation.census(), s.clutter)
    assert record["scatterers"] == len(setup.propagation.field.cells) > 0
    for key, value in {**record, **mechanisms(s.propagation, s.clutter)}.items():
        assert planned[key] == done[key] == value, key
    lines = {item["what"]: item for item in planned["items"]}
    assert str(record["city_faces"]) in lines["mesh"]["modelled"]
    assert str(record["city_faces_beyond_reach"]) in lines["mesh"]["left_out"]
    assert f"{record['scatterers']:,}" in lines["clutter field"]["modelled"]
    assert lines["clutter field"]["estimate"] == record["clutter_error_db"]
    assert planned["clutter_bounces"] == 1 and record["mirrors"] is None
    assert "clutter.mirrors" in lines["clutter by mirrors"]["left_out"]


@pytest.mark.sionna
def test_the_plan_counts_mirrors():
    """Two bounces: the mirrors of each terminal and the share of its power that they and all others
    send on, in the plan's record, its line and the summary; few mirrors and the rest are what many
    are. Planted bugs: the share left out without the next mirror; the line's error that of the
    terminal with the least."""
    s = district(315, frames=2)
    some, all_of_them = (
        s.model_copy(update={"clutter": s.clutter.model_copy(update={"mirrors": n})})
        for n in (3, 64)
    )
    setup = prepare(some)
    planned, done = make_plan(setup), simulate.summarise(some)["fidelity"]
    assert (
        planned["mirrors"] == done["mirrors"]
        and planned["clutter_bounces"] == done["clutter_bounces"] == 2
    )
    assert set(planned["mirrors"]) == {"A", "P"}
    most = extent(setup.city, prepare(all_of_them).propagation.census(), s.clutter)["mirrors"]
    for name, row in planned["mirrors"].items():
        assert row["count"] == len(setup.propagation.two_bounces.mirrors[name]) == 3
        whole = most[name]["share"] + most[name]["share_left_out"]
        assert row["share"] + row["share_left_out"] == pytest.approx(
            whole, abs=3e-6, rel=0
        )  # six digits of each are kept
        assert row["share"] > most[name]["share"] / 4 and row["share_left_out"] > 0
    (line,) = (item for item in planned["items"] if item["what"] == "clutter by mirrors")
    assert "3 of A, 3 of P" in line["modelled"]
    assert line["estimate"] == max(row["share_left_out"] for row in planned["mirrors"].values())


def test_the_density_follows_from_the_error():
    """The law and its inverse, what a scenario says against what it asks for. Planted bug: the
    exponent the other way round."""
    assert area_for(0.2) == pytest.approx(0.024, rel=1e-5)
    assert area_for(0.37) == pytest.approx(0.024 * 1.85 ** (4 / 3), rel=1e-5)
    assert error_for(area_for(0.731)) == pytest.approx(0.731, rel=1e-5)
    said = district(316).clutter
    assert Density.of(said).per_metre == 0.4
    asked = said.model_copy(update={"cell_area_per_metre_m": None, "max_error_db": 0.9})
    assert Density.of(asked).per_metre == area_for(0.9)
