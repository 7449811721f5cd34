"""Scatterers merged where noise covers them: what merging keeps, when it is allowed, and what it
does to the power of range cells against the densest field."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import stats

from isac_rt import runtime

try:
    runtime.activate()
except runtime.RuntimeProblem as problem:
    pytest.skip(str(problem), allow_module_level=True)

from isac_rt import prepare, scenario
from isac_rt.frame.link import Link
from isac_rt.frame.waveform import SPEED_OF_LIGHT, Waveform
from isac_rt.propagation.clutter.cells import Cells, Density, cut
from isac_rt.propagation.clutter.field import in_local
from isac_rt.propagation.clutter.merging import (
    LIMIT_FACTORS,
    VisibleCells,
    allowed_area,
    merge,
    merged_below_noise,
    resolution_cell,
)
from isac_rt.propagation.clutter.visibility import Flight, ever_ahead
from isac_rt.propagation.scatter_paths import LinkState
from isac_rt.simulation.audit import check
from isac_rt.simulation.setup import Setup, swarm_of
from isac_rt.world.city import CityMesh, load_city
from isac_rt.world.swarm import Pose

PLACES = np.array([[0.7, -5.1, 8.3], [1.9, 26.2, 3.9]])
STREET = {"street_width_m": 19.3, "street_length_m": 71.0, "building_height_m": 14.9}


def street() -> CityMesh:
    return load_city(scenario.City(source="canyon", **STREET), ".", 77e9, np.zeros(3))


def cells_of(city: CityMesh, seed: int = 3, share: float = 0.7) -> Cells:
    """Cells of a street, some of them taken out as those that nobody sees."""
    cells = cut(city, np.ones(city.num_faces, bool), PLACES, Density(0.2, 0.3), seed)
    return cells.select(np.random.default_rng(seed).random(len(cells)) < share)


def by_recursion(cells: Cells, limit: np.ndarray, face: int) -> list[tuple[float, complex]]:
    """(area, amplitude) of what is left of a face, from a dictionary of its cells."""
    mine = {int(cells.code[i]): i for i in np.flatnonzero(cells.face == face)}
    out: list[tuple[float, complex]] = []

    def one(code: int, under: list[int]) -> tuple[float, float, complex] | None:
        """Area, limit and weighted sum of a cell, if it is whole; else its parts are given out."""
        if code in mine:
            i = mine[code]
            return float(cells.area[i]), limit[i], np.sqrt(cells.area[i]) * cells.amplitude[i]
        halves = []
        for half in (2 * code, 2 * code + 1):
            within = [c for c in under if c >> (c.bit_length() - half.bit_length()) == half]
            if within:
                halves.append(one(half, within))
        if len(halves) == 1:
            return halves[0]
        first, second = halves
        if first and second and first[0] + second[0] <= min(first[1], second[1]):
            return first[0] + second[0], min(first[1], second[1]), first[2] + second[2]
        out.extend((h[0], h[2] / np.sqrt(h[0])) for h in halves if h)
        return None

    root = one(1, list(mine)) if mine else None
    return [*out, *([(root[0], root[2] / np.sqrt(root[0]))] if root else [])]


def test_merged_cells_are_those_of_plain_recursion():
    """Areas and amplitudes face by face, with limits that let some merge. Planted bugs: a cell
    whose other half nobody sees waits for it; the limit of the second half is not looked at."""
    city = street()
    cells = cells_of(city)
    limit = cells.area * np.random.default_rng(5).choice([0.5, 3.0, 30.0, np.inf], len(cells))
    _, left = merge(cells, limit)
    for face in range(city.num_faces):
        here = left.face == face
        mine = sorted(zip(left.area[here], left.amplitude[here], strict=True), key=abs_first)
        true = sorted(by_recursion(cells, limit, face), key=abs_first)
        assert [a for a, _ in mine] == pytest.approx([a for a, _ in true], rel=1e-5)
        assert [z for _, z in mine] == pytest.approx([z for _, z in true], abs=1e-4)  # float32
    assert len(cells) / 3 < len(left) < len(cells) * 0.9


def abs_first(pair: tuple[float, complex]) -> tuple[float, float]:
    return round(float(pair[0]), 3), float(abs(pair[1]))


def test_merging_keeps_area_and_sum_and_places():
    """With no limit one scatterer is left of each face: all of its area, the coherent sum of its
    cells, the place of one of them. Planted bug: amplitudes are added without their weights."""
    city = street()
    cells = cells_of(city)
    place, left = merge(cells, np.full(len(cells), np.inf))
    assert np.array_equal(left.points, cells.points[place])
    assert np.array_equal(np.sort(left.face), np.unique(cells.face))
    area = np.bincount(cells.face, cells.area, city.num_faces)
    assert left.area == pytest.approx(area[left.face], rel=1e-6)
    total = np.zeros(city.num_faces, complex)
    np.add.at(total, cells.face, np.sqrt(cells.area) * cells.amplitude)
    assert np.sqrt(left.area) * left.amplitude == pytest.approx(total[left.face], rel=1e-5)
    places = {tuple(p) for p in cells.points}
    assert all(tuple(p) in places for p in left.points)


@pytest.mark.slow
def test_merged_amplitudes_are_gaussian_and_places_are_drawn_by_area():
    """Over 900 seeds: mean power one and the Rayleigh law (Kolmogorov-Smirnov at 1e-4), and the
    place that stands for a face against the areas of its cells (chi squared at 1e-4). Planted
    bugs: the first half's place always; a clock that knows no area."""
    city = street()
    face = int(np.argmax(city.areas))
    chosen = np.arange(city.num_faces) == face
    amplitudes, times = [], {}
    for seed in range(900):
        cells = cut(city, chosen, PLACES, Density(1.5, 3.0), seed)
        cells = cells.select(np.arange(len(cells)) % 4 != 2)
        _, left = merge(cells, np.full(len(cells), np.inf))
        amplitudes.append(complex(left.amplitude[0]))
        code = int(left.code[0])
        times[code] = times.get(code, 0) + 1
    share = cells.area / cells.area.sum()
    found = np.array([times.get(int(code), 0) for code in cells.code])
    assert found.sum() == 900
    assert share.max() > 1.9 * share.min()
    assert stats.chisquare(found, 900 * share).pvalue > 1e-4
    power = np.abs(amplitudes) ** 2
    assert stats.kstest(power, "expon").pvalue > 1e-4
    assert abs(power.mean() - 1) < 4 / np.sqrt(900)


def test_allowed_areas_are_those_of_the_rule():
    """By hand. Four cells: clutter of a third of the noise in a hundred parts, where the area
    grows by (1 + C)/C to the 4/3; of nine times in two, each more than a sixth; one faint
    scatterer that would be the whole cell; and one of 0.8 of the noise, which 1/sqrt(n) limits.
    Planted bugs: C over 1 + C; no limit for one alone; no limit by the number in a cell."""
    power = np.concatenate([np.full(100, 1 / 300), [4.0, 5.0], [0.004], [0.8]])
    cell = np.concatenate([np.full(100, 7), [9, 9], [2], [3]])
    area = np.full(power.size, 1.7)
    heard = VisibleCells(np.arange(power.size), power, cell)
    found = allowed_area(heard, area, np.full(power.size, 2.1), 0.2, 1.0)
    assert found[:100] == pytest.approx(2.1 * 4 ** (4 / 3), rel=1e-12)
    assert found[100:102] == pytest.approx([1.7 * 9 / 6 / p for p in (4.0, 5.0)], rel=1e-12)
    most = 42.0 * 0.2**2 * 1.004
    assert found[102] == pytest.approx(1.7 * most / 0.004, rel=1e-12)
    assert found[102] < 2.1 * (1.004 / 0.004) ** (4 / 3)
    assert found[103] == pytest.approx(1.7 * 4.0 * 0.2**2 * 1.8**2 / 0.8 / 0.8, rel=1e-12)
    factor = allowed_area(heard, area, np.full(power.size, 2.1), 0.2, 3.0)
    assert factor[:102] == pytest.approx(found[:102], rel=1e-12)
    assert factor[102:] == pytest.approx(3.0 * found[102:], rel=1e-12)


def nine_of_ten(cells: Cells, place, left: Cells, heard: VisibleCells, least: float) -> float:
    """Error of noise plus clutter that nine of ten cells keep to [dB], of those that hold more
    than `least` of the noise."""
    stands_for = dict(zip(place.tolist(), left.area / cells.area[place], strict=True))
    every, now = {}, {}
    for i, p, c in zip(*heard, strict=True):
        every[c] = every.get(c, 0.0) + p
        now[c] = now.get(c, 0.0) + p * stands_for.get(i, 0.0)
    errors = [abs(10 * np.log10((1 + now[c]) / (1 + p))) for c, p in every.items() if p > least]
    return float(np.quantile(errors, 0.9)) if errors else 0.0


@pytest.mark.parametrize(("level", "expected"), [(3e-5, 6.0), (3e-4, 1.0), (3.2e-3, 2.0)])
def test_the_rule_is_eased_as_far_as_the_error_allows(level, expected):
    """A street of cells heard at two instants, far under the noise, about it and over it: what is
    left is that of the rule with the largest easing under which nine of ten cells keep 0.2 dB at
    both, of all and of those over the noise; errors are added up here by themselves. Planted bugs:
    the first easing always; only the cells over the noise count."""
    cells = cells_of(street())
    rng, finest = np.random.default_rng(11), cells.area
    heard = []
    for _ in range(2):
        index = np.flatnonzero(rng.random(len(cells)) < 0.8)
        power = level * cells.area[index] * rng.uniform(0.2, 3.0, index.size)
        heard.append(VisibleCells(index, power, cells.points[index] @ [0.9, 2.3, 1.1] // 2.7))
    heard = [h._replace(cell=h.cell.astype(int) - int(h.cell.min())) for h in heard]
    found = merged_below_noise(cells, heard, finest, 0.2)
    for factor in LIMIT_FACTORS:
        limit = np.full(len(cells), np.inf)
        for some in heard:
            allowed = allowed_area(some, cells.area, finest, 10**0.02 - 1, factor)
            limit[some.which] = np.minimum(limit[some.which], allowed)
        place, left = merge(cells, limit)
        mine = cells, place, left
        worst = max(nine_of_ten(*mine, some, least) for some in heard for least in (0.0, 1.0))
        if worst <= 0.2:
            break
    assert factor == expected
    assert np.array_equal(found.area, left.area)


def test_resolution_cells_are_those_of_the_waveform():
    """A metre of path and a metre per second against the waveform's own cells; velocities alias.
    Planted bugs: two-way cells for path lengths; no aliasing."""
    w = Waveform()
    path, speed = w.range_cell(1), w.velocity_cell(1)
    delay = np.array([10.0, 11.0, 10.0, 10.0]) * path / SPEED_OF_LIGHT
    rate = np.array([3.0, 3.0, 4.0, 3.0 + w.num_chirps]) * speed / SPEED_OF_LIGHT
    cell = resolution_cell(w, delay, rate)
    assert (cell - cell[0]).tolist() == [0, w.num_chirps, 1, 0]


def swarm_tree(**changes) -> dict:
    """An active and a passive terminal that cross a street; clutter from far over the noise to far
    under it."""
    places = {
        "A": ((2.4, -22.7, 9.3), (-0.9, 7.7, 0.6)),
        "P": ((-1.3, 17.9, 11.1), (0.7, -4.1, 0.3)),
    }
    tree = {
        "frames": 60,
        "frame_interval_s": 0.02,
        "swarm": {
            name: {"role": role, "position_m": places[name][0], "velocity_mps": places[name][1]}
            for name, role in (("A", "active"), ("P", "passive"))
        },
        "receiver_preset": "plain",
        "city": {"source": "canyon", **STREET},
        "propagation": {"model": "ray_traced", "max_bounces": 0},
        "clutter": {"model": "field"},
        "noise": {"model": "link_budget", "tx_power_dbm": -14},
    }
    for key, value in changes.items():
        tree[key] = {**tree.get(key, {}), **value} if isinstance(value, dict) else value
    return tree


def prepared(**changes) -> Setup:
    return prepare(scenario.Scenario.model_validate(swarm_tree(**changes)))


def over_noise(setup: Setup, link: Link, frame: int, *, whole: bool) -> tuple[np.ndarray, ...]:
    """Mean powers over the noise of a cell, path lengths and range-Doppler cells of a link's
    clutter."""
    field = setup.propagation.field
    epoch, poses = setup.timetable.epoch(frame), setup.swarm.poses(setup.timetable.epoch(frame))
    local = [
        Pose(p.position - setup.city.origin, p.velocity, p.acceleration, p.rotation)
        for p in (poses[link.tx], poses[link.rx])
    ]
    state = LinkState(link, epoch, *local)
    seen = (field.whole() if whole else field).seen(state)
    level = setup.plan.cell_noise_gain(link.tx) / setup.noise_power(poses, link)
    power = level * (seen.magnitude * state.elements(setup.arrays, seen)) ** 2
    motion = seen.length / SPEED_OF_LIGHT, seen.rate / SPEED_OF_LIGHT
    return power, seen.length, resolution_cell(setup.waveform, *motion)


def test_noise_and_clutter_keep_their_power():
    """Seven draws of the places, both links, three frames. Nine of ten range-Doppler cells keep
    noise plus mean clutter to the error asked for, against all scatterers. In range cells of 4 m of
    path noise plus clutter over noise plus dense clutter is that of a field six times as
    dense: no link and frame is apart by more than the draws explain (Student's t at 1e-4). Planted
    bugs: merged cells keep the area of one half; what the transmitter sees counts as seen by
    both."""
    error, edges = 1.0, np.arange(0.0, 300.0, 4.0)
    dense = prepared(
        seed=99, clutter={"max_error_db": error / 4}, accuracy={"preset": "everything"}
    )
    off, left, seen = [], 0, 0
    found = {(Link("A", rx), frame): [] for rx in "AP" for frame in (3, 29, 57)}
    for seed in range(7):
        setup = prepared(seed=seed, clutter={"max_error_db": error})
        for link, frame in found:
            every, _, cell = over_noise(setup, link, frame, whole=True)
            some, length, mine = over_noise(setup, link, frame, whole=False)
            left, seen = left + some.size, seen + every.size
            size = max(cell.max(), mine.max()) + 1
            a, b = np.bincount(cell, every, size), np.bincount(mine, some, size)
            off.append((10 * np.log10((1 + b) / (1 + a)))[(a > 0) | (b > 0)])
            found[link, frame].append(np.histogram(length, edges, weights=some)[0])
    off = np.abs(np.concatenate(off))
    assert np.quantile(off, 0.9) < error
    assert np.quantile(off, 0.99) < 3 * error
    assert left < 0.6 * seen
    for (link, frame), draws in found.items():
        power, length, _ = over_noise(dense, link, frame, whole=True)
        true = np.histogram(length, edges, weights=power)[0]
        apart = ((np.array(draws) - true) / (10 + true))[:, true > 1].mean(axis=1)
        assert stats.ttest_1samp(apart, 0.0).pvalue > 1e-4
        assert abs(apart.mean()) < 0.02


def test_who_sees_all_scatterers():
    """Nothing is merged where everything is asked for, where mirrors bring clutter to other cells,
    and on links that are not of the run; receivers that add their antennas in phase see deeper and
    have more. Planted bugs: no look at the preset; the same noise for all receivers."""
    setup = prepared()
    field, link = setup.propagation.field, Link("A", "P")
    assert set(field.merged) == {Link("A", "A"), link}
    assert field.of(Link("P", "A")).cells is field.cells
    for changes in ({"accuracy": {"preset": "everything"}}, {"clutter": {"mirrors": 2}}):
        assert not prepared(**changes).propagation.field.merged
    beams = prepared(receivers={"symbol_decision": "beams"}).propagation.field
    assert len(beams.of(link).cells) > 1.1 * len(field.of(link).cells)
    own = Link("A", "A")
    assert np.array_equal(beams.of(own).cells.area, field.of(own).cells.area)
    census = setup.propagation.census()
    assert census.merged == {str(one): len(field.of(one).cells) for one in (own, link)}


@pytest.mark.slow
def test_the_budget_check_measures_what_merging_does():
    """Beside its bound, on every link; nothing where nothing is merged. Planted bug: the merged
    field against itself."""
    for preset in ("budget", "everything"):
        setup = prepared(accuracy={"preset": preset}, city={"street_length_m": 31.0})
        for row in check(setup, 1)["links"].values():
            assert row["clutter_bound_db"] == pytest.approx(0.2, rel=1e-3)
            if preset == "budget":
                assert 0.001 < row["clutter_db"] < row["clutter_bound_db"]
            else:
                assert row["clutter_db"] == 0


def turning_tree() -> dict:
    """Both ends turn while they fly through the street, the transmitter by 100 degrees."""
    scatter_paths = {
        "A": (((2.4, -22.7, 9.3), -40), ((1.3, -8.1, 10.2), 5), ((-1.9, 6.3, 9.8), 60)),
        "P": (((-1.3, 17.9, 11.1), 170), ((0.2, 12.4, 10.9), 200), ((1.1, 8.3, 12.2), 215)),
    }
    roles = {"A": "active", "P": "passive"}
    swarm = {
        name: {
            "role": roles[name],
            "waypoints": [
                {"time_s": 0.6 * k, "position_m": place, "attitude_deg": [yaw, -8, 3]}
                for k, (place, yaw) in enumerate(way)
            ],
        }
        for name, way in scatter_paths.items()
    }
    return swarm_tree() | {"swarm": swarm}


def test_what_no_element_sends_or_hears_is_left_out_and_nothing_else():
    """Two terminals that turn: every scatterer that a link hears in a frame of a field with nothing
    left out is there, and with the same power, before merging; a fifth of all are not. Planted
    bugs: the boresight of another axis; the receiver's planes for what is sent."""
    every = prepare(
        scenario.Scenario.model_validate(turning_tree() | {"accuracy": {"preset": "everything"}})
    )
    some = prepare(scenario.Scenario.model_validate(turning_tree()))
    fields = every.propagation.field, some.propagation.field.whole()
    assert len(fields[1].cells) < 0.8 * len(fields[0].cells)
    for frame in range(0, 60, 7):
        poses = some.swarm.poses(some.timetable.epoch(frame))
        local = [in_local(poses[name], some.city.origin) for name in ("A", "P")]
        for rx, end in zip("AP", local, strict=True):
            state = LinkState(Link("A", rx), some.timetable.epoch(frame), local[0], end)
            heard = []
            for field in fields:
                seen = field.seen(state)
                power = (seen.magnitude * state.elements(some.arrays, seen)) ** 2
                lit = np.flatnonzero(power)
                order = np.lexsort(field.cells.points[seen.index[lit]].T)
                heard.append((field.cells.points[seen.index[lit]][order], power[lit][order]))
            assert len(heard[0][0]) > 100
            assert np.array_equal(*(points for points, _ in heard))
            assert np.array_equal(*(power for _, power in heard))


def test_nothing_that_is_ahead_at_any_time_is_taken_to_be_behind():
    """40,000 places about a flight that turns and one that draws back from what it looks at, at
    1,500 instants. Planted bug: planes through the foremost place of a boresight."""
    tree = turning_tree()
    tree["swarm"]["B"] = {
        "role": "passive",
        "position_m": (7.1, 3.2, 14.9),
        "velocity_mps": (-0.9, -13.7, 0.4),
        "boresight": (0.1, 1.0, 0.2),
    }
    swarm = swarm_of(scenario.Scenario.model_validate(tree))
    points = np.random.default_rng(7).uniform(-150, 150, (40_000, 3))
    for name in "AB":
        trajectory = swarm.trajectories[name]
        ahead = np.zeros(len(points), bool)
        for time in np.linspace(0, swarm.duration, 1500):
            pose = trajectory.pose(time)
            ahead |= points @ pose.rotation[:, 1] > pose.position @ pose.rotation[:, 1]
        found = ever_ahead(Flight(trajectory, swarm.duration, np.zeros(3)).fronts, points)
        assert not (ahead & ~found).any()
        assert (found & ~ahead).sum() < 0.2 * (~ahead).sum()
