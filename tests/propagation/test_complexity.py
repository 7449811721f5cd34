"""How cost grows with what a scenario has more of: counted work where it can be counted, else
ratios with wide margins."""

from __future__ import annotations

import numpy as np
import pytest

from benchmarks import clutter, synthesis
from benchmarks.measure import cpu_seconds
from benchmarks.scenes import alone, town
from isac_rt.scenario.tree import Scenario
from isac_rt.signal.methods import Gridded
from isac_rt.simulation.audit import tracer_of
from isac_rt.simulation.setup import prepare


def test_synthesis_grows_no_faster_than_its_paths():
    """Four times the paths cost at most eight times as much. Planted bug: `_blocks` that lists
    every path once per hundred paths."""
    job = synthesis.Job(30)
    seconds = []
    for count in (1000, 4000):
        links = job.paths(count)
        seconds.append(cpu_seconds(lambda links=links: job.samples(links, Gridded()), 5))
    assert seconds[1] < 8 * seconds[0]


@pytest.mark.sionna
def test_tracing_grows_slower_than_the_triangles():
    """More than four times the triangles: less than four times the cost, since rays go through a
    hierarchy. All of what is not rays (unfolding, edges) is in the cost."""
    faces, seconds = [], []
    for blocks in (2, 6):
        setup = prepare(town(3, blocks, accuracy={"preset": "everything"}))
        poses, found = setup.find(1)
        when = setup.timetable.epoch(1)
        faces.append(setup.city.num_faces)
        seconds.append(
            cpu_seconds(
                lambda s=setup, p=poses, t=when, of=list(found): (
                    s.propagation.trace(p, t, of).paths
                ),
                3,
            )
        )
    assert faces[1] >= 4 * faces[0]
    assert seconds[1] < 4 * seconds[0]


@pytest.mark.sionna
@pytest.mark.parametrize("uavs", [3, 7])
def test_segments_are_traced_from_terminals_only(uavs):
    """Segments run from the two terminals to every UAV: 2 N pairs, not N^2; rays are sent by the
    two terminals only."""
    setup = prepare(town(uavs))
    tracer, searched, placed = tracer_of(setup), [], []
    chains, segments = tracer._search.chains, tracer._images.segments
    tracer._search.chains = lambda name, *args: (searched.append(name), chains(name, *args))[1]
    tracer._images.segments = lambda *args: (placed.append(segments(*args)), placed[-1])[1]
    setup.find(1)
    assert searched == tracer._terminals and len(searched) == 2
    assert [len(found) for found in placed] == [2 * uavs]


@pytest.mark.sionna
def test_rays_search_once_a_knot_however_many_frames_there_are():
    """The same way in ten frames and in forty: as many searches, each of a place and a number once.
    Planted bug: the time samples of the last frame are not kept."""
    counts = []
    for frames in (10, 40):
        setup = prepare(
            town(3, frames=frames, frame_interval_s=1.2 / frames, accuracy={"max_untraced_m": 2.0})
        )
        search, calls = tracer_of(setup)._search, []
        sent = search._sent
        search._sent = lambda place, number, sent=sent, calls=calls: (
            calls.append((*place, number)),
            sent(place, number),
        )[1]
        for frame in range(frames):
            setup.find(frame)
        assert len(set(calls)) == len(calls)
        counts.append(len(calls))
    assert 10 < counts[1] <= counts[0] + 2


@pytest.mark.sionna
def test_a_field_is_advanced_without_shooting_more_rays_per_frame():
    """Frames that follow each other share their tests of sight: a test every half metre of flight,
    however many frames."""
    tests = []
    for per_metre in (5, 20):
        speed = 5.315  # of the active terminal [m/s]
        setup = prepare(
            alone(
                frames=3 * per_metre,
                frame_interval_s=1 / speed / per_metre,
                clutter={"model": "field", "cell_area_per_metre_m": 1.0},
            )
        )
        sight = tracer_of(setup).field.visibility
        sees, calls = sight.los.all_seen, []
        sight.los.all_seen = lambda at, *args, sees=sees, calls=calls: (
            calls.extend(at),
            sees(at, *args),
        )[1]
        clutter.advance(setup, range(3 * per_metre))
        tests.append(len(calls))
    assert 0 < tests[1] <= tests[0] + 2


def slope(sizes, counts) -> float:
    """Of the line through the logarithms."""
    return float(np.polyfit(np.log(sizes), np.log(counts), 1)[0])


def rays_sent(setup) -> tuple[int, int]:
    """Rays that one frame's search sends, and the segments that its images place."""
    tracer, sent, placed = tracer_of(setup), [], []
    hit, segments = tracer._search._hit, tracer._images.segments
    tracer._search._hit = lambda at, along: (sent.append(len(at)), hit(at, along))[1]
    tracer._images.segments = lambda *args: (placed.append(segments(*args)), placed[-1])[1]
    setup.find(1)
    return sum(sent), sum(map(len, placed))


def with_terminals(count: int):
    """A town of six UAVs, so many of which are terminals."""
    tree = town(6).model_dump(mode="json", exclude_unset=True)
    for i in range(count - 2):
        tree["swarm"][f"U{i}"]["role"] = "passive"
    return Scenario.model_validate(tree)


@pytest.mark.sionna
def test_work_of_tracing_grows_with_terminals_and_bounces_and_not_with_faces():
    """Slopes of rays sent and segments placed over faces, bounces, terminals and UAVs, on
    logarithmic scales. Planted bug: rays sent for every UAV."""
    blocks = [prepare(town(3, count)) for count in (2, 4, 6)]
    faces = [setup.city.num_faces for setup in blocks]
    rays = [rays_sent(setup)[0] for setup in blocks]
    assert faces[-1] > 4 * faces[0] and abs(slope(faces, rays)) < 0.15
    walls = {"model": "ray_traced", "rays": 20_000}
    bounces = [
        rays_sent(prepare(town(3, propagation=walls | {"max_bounces": n})))[0] for n in (1, 2, 3)
    ]
    assert 0.3 < slope([1, 2, 3], bounces) < 1.05  # rays that leave the town are not sent on
    work = [rays_sent(prepare(with_terminals(n))) for n in (2, 4, 6)]
    assert slope([2, 4, 6], [rays for rays, _ in work]) == pytest.approx(1.0, abs=0.1)
    assert slope([2, 4, 6], [segments for _, segments in work]) == pytest.approx(1.0, abs=1e-9)
    segments = [rays_sent(prepare(town(count)))[1] for count in (3, 5, 7)]
    assert slope([3, 5, 7], segments) == pytest.approx(1.0, abs=1e-9)


@pytest.mark.sionna
def test_work_of_clutter_and_synthesis_grows_with_the_scatterers():
    """Paths that are advanced and synthesised, over scatterers of the field: slope one. Planted
    bug: every scatterer advanced once for each UAV."""
    made, kept = [], []
    for area in (1.0, 0.25, 0.06):
        setup = prepare(alone(clutter={"model": "field", "cell_area_per_metre_m": area}))
        field = tracer_of(setup).field
        kept.append(sum(len(some.cells) for some in field.merged.values()))
        made.append(sum(len(paths) for paths in setup.find(1)[1].values()))
    assert kept[-1] > 3 * kept[0]
    assert slope(kept, made) == pytest.approx(1.0, abs=0.1)
