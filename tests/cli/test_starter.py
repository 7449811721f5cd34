"""`isac-rt new` over buildings of one's own: the swarm is where it makes sense, and its first run
decodes something."""

from __future__ import annotations

import itertools
import json
import shutil
import warnings
from collections.abc import Sequence
from pathlib import Path

import matplotlib.image
import numpy as np
import pytest
import trimesh

from isac_rt.cli.cli import main
from isac_rt.cli.starter import Wanted, write_starter
from isac_rt.scenario.file import load
from isac_rt.scenario.tree import Scenario
from isac_rt.simulation import simulate
from isac_rt.simulation.setup import city_of, swarm_of
from isac_rt.world.passage import hits

QUARTER = Path(__file__).parents[2] / "scenes" / "data" / "quarter.geojson"
SQUARE = ((0, 0), (9, 0), (9, 9), (0, 9), (0, 0))
SHELL = ((0, 3, 2, 1), (4, 5, 6, 7), (0, 1, 5, 4), (1, 2, 6, 5), (2, 3, 7, 6), (3, 0, 4, 7))


def osm(folder: Path) -> Path:
    """Blocks with streets of 18 m, as OpenStreetMap has them, in a field far larger."""
    features = []
    for i, j in itertools.product(range(5), range(4)):
        x, y = 7.1 + i * 58 / 76_000, 46.2 + j * 48 / 111_200
        ring = [
            [x + a * 40 / 76_000, y + b * 30 / 111_200] for a, b in ((0, 0), (1, 0), (1, 1), (0, 1))
        ]
        tags = {"building": "yes", "building:levels": str(4 + (i + j) % 3)}
        shape = {"type": "Polygon", "coordinates": [[*ring, ring[0]]]}
        features.append({"type": "Feature", "properties": tags, "geometry": shape})
    field = [[7.0, 46.1], [7.3, 46.1], [7.3, 46.3], [7.0, 46.3], [7.0, 46.1]]
    shape = {"type": "Polygon", "coordinates": [field]}
    features.append({"type": "Feature", "properties": {"landuse": "farmland"}, "geometry": shape})
    hut = [[7.2, 46.15], [7.2001, 46.15], [7.2001, 46.1501], [7.2, 46.15]]
    shape = {"type": "Polygon", "coordinates": [hut]}
    tags = {"building": "hut", "height": "3"}
    features.append({"type": "Feature", "properties": tags, "geometry": shape})
    (folder / "osm.geojson").write_text(
        json.dumps({"type": "FeatureCollection", "features": features})
    )
    return folder / "osm.geojson"


def swiss(folder: Path) -> Path:
    """Blocks on a slope of one in ten at 410 m in LV95, a tower at the end of the town."""
    vertices, objects = [], {}
    for i, j in itertools.product(range(5), range(4)):
        x, y, z = 55.0 * i, 50.0 * j, 410 + 5.5 * i
        side, top = ((36, 30), z + 11 + (i + 2 * j) % 4) if (i, j) != (4, 3) else ((12, 12), z + 90)
        k = len(vertices)
        plan = ((0, 0), (side[0], 0), side, (0, side[1]))
        vertices += [[x + a, y + b, level] for level in (z, top) for a, b in plan]
        faces = [[[k + corner for corner in face]] for face in SHELL]
        shape = {"type": "Solid", "lod": "2.2", "boundaries": [faces]}
        objects[f"b{k}"] = {"type": "Building", "geometry": [shape]}
    document = {
        "type": "CityJSON",
        "version": "2.0",
        "metadata": {"referenceSystem": "https://www.opengis.net/def/crs/EPSG/0/2056"},
        "transform": {"scale": [0.01] * 3, "translate": [2_683_400.0, 1_247_600.0, 0.0]},
        "CityObjects": objects,
        "vertices": [[round(100 * v) for v in p] for p in vertices],
    }
    (folder / "zurich.city.json").write_text(json.dumps(document))
    return folder / "zurich.city.json"


def quarter(folder: Path) -> Path:
    return QUARTER


def begun(make, folder: Path) -> Scenario:
    """The scenario that `new` writes, read without a doubt."""
    file = folder / "mine.yaml"
    assert main(["new", str(file), "--footprints", str(make(folder))]) == 0
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        return load(file)


def test_no_picture_is_written_over(tmp_path, capsys):
    """A picture of the scenario's name: nothing is written, and the message names it. Planted bug:
    the picture looked for after the scenario is there."""
    (tmp_path / "holiday.png").write_bytes(b"mine")
    file = tmp_path / "holiday.yaml"
    assert main(["new", str(file), "--footprints", str(QUARTER)]) == 2
    assert "holiday.png is there already" in capsys.readouterr().err
    assert [f.name for f in tmp_path.iterdir()] == ["holiday.png"]
    assert (tmp_path / "holiday.png").read_bytes() == b"mine"


@pytest.mark.slow
def test_a_path_may_have_any_letters(tmp_path):
    """Planted bug: the path written as JSON, whose pairs of surrogates YAML does not join."""
    folder = tmp_path / 'ü\U0001f600 #: "q'
    folder.mkdir()
    shutil.copy(QUARTER, folder / "b.geojson")
    scenario = begun(lambda _: folder / "b.geojson", tmp_path)
    assert scenario.city_path().read_bytes() == QUARTER.read_bytes()


@pytest.mark.parametrize(
    "make", [osm, *(pytest.param(f, marks=pytest.mark.slow) for f in (swiss, quarter))]
)
def test_the_swarm_is_among_buildings_in_sight_and_before_a_wall(make, tmp_path):
    """By trimesh's rays. Planted bug: no site is good, so that the swarm flies over the highest
    roof, as it did."""
    scenario = begun(make, tmp_path)
    city, swarm = city_of(scenario), swarm_of(scenario)
    mesh = trimesh.Trimesh(
        city.corners.reshape(-1, 3) + city.origin,
        np.arange(3 * city.num_faces).reshape(-1, 3),
        process=False,
    )
    for time in (0.0, 1.0, 1.95):
        at = {name: pose.position for name, pose in swarm.poses(time).items()}
        assert max(np.abs(place).max() for place in at.values()) < 2e3  # a local origin
        for a, b in itertools.combinations(at.values(), 2):
            share = hit_shares(mesh, a, b - a)
            assert not ((share > 0) & (share < 1)).any()
        for place in at.values():
            fall = hit_shares(mesh, place, np.array([0.0, 0.0, -1.0]))
            assert 3.0 < fall[fall > 0].min() < 25.0  # metres above what is below
    at = swarm.poses(0.0)["AT"]
    walls = []
    for angle in np.deg2rad(np.arange(-55, 56, 5)):
        ray = at.rotation @ np.array([np.sin(angle), np.cos(angle), 0.0])
        share = hit_shares(mesh, at.position, ray)
        walls += share[share > 0].tolist()
    assert min(walls) < 60.0
    picture = matplotlib.image.imread(tmp_path / "mine.png")
    assert picture[..., :3].std() > 0.05


def houses(folder: Path, boxes: Sequence[tuple[float, float, float]]) -> Path:
    """Houses 9 m square at (x, y), with a height, in metres."""
    features = [
        {
            "type": "Feature",
            "properties": {"building": "yes", "height": height},
            "geometry": {
                "type": "Polygon",
                "coordinates": [[[x + a, y + b] for a, b in SQUARE]],
            },
        }
        for x, y, height in boxes
    ]
    (folder / "few.geojson").write_text(
        json.dumps({"type": "FeatureCollection", "features": features})
    )
    return folder / "few.geojson"


def hit_shares(mesh: trimesh.Trimesh, start: np.ndarray, way: np.ndarray) -> np.ndarray:
    """Shares of a way (3,) at which it meets a mesh."""
    places = mesh.ray.intersects_location(start[None], way[None])[0].reshape(-1, 3)
    return (places - start) @ way / (way @ way)


@pytest.mark.parametrize("boxes", [[(0, 0, 7)], [(-67, -102, 7), (37, 83, 6)], [(20, 5, 25)]])
def test_over_few_houses_the_swarm_stays_over_the_ground(boxes, tmp_path):
    """Ground under every flight, and a wall so near before the first that the picture, which is
    102 m wide, has it. Planted bugs: flights as high as low houses, where a far one is sought and
    found at 58 m; the ground's rim taken to go on."""
    write_starter(tmp_path / "few.yaml", Wanted(str(houses(tmp_path, boxes))))
    scenario = load(tmp_path / "few.yaml")
    corners, swarm = city_of(scenario).corners + city_of(scenario).origin, swarm_of(scenario)
    for time in (0.0, 1.0, 1.95):
        for pose in swarm.poses(time).values():
            assert hits(corners, pose.position, pose.position - [0, 0, 50])[0].size
    at, walls = swarm.poses(0.0)["AT"], []
    for angle in np.deg2rad(np.arange(-55, 56, 5)):
        ray = at.rotation @ np.array([np.sin(angle), np.cos(angle), 0.0])
        walls += (60 * hits(corners, at.position, at.position + 60 * ray)[1]).tolist()
    assert min(walls) < 20


@pytest.mark.parametrize("formation", ["line", "column", "cross"])
def test_a_formation_has_as_many_targets_as_asked_for(formation, tmp_path):
    """Over a canyon, by the loaded scenario: the targets fly between AT and PT1, abreast, behind
    each other, or at right angles, and no two come nearer than a metre. Planted bug: both columns
    of the cross at one height and time."""
    write_starter(tmp_path / "many.yaml", Wanted(formation=formation, uavs=7))
    scenario = load(tmp_path / "many.yaml")
    swarm = swarm_of(scenario)
    targets = [name for name, uav in scenario.swarm.items() if uav.role == "target"]
    assert len(targets) == 7
    ahead = swarm.poses(0.0)["AT"].rotation[:, 1]
    for time in np.linspace(0, 2, 21):
        poses = swarm.poses(time)
        places = np.array([poses[name].position for name in targets])
        along = (places - poses["AT"].position) @ ahead
        assert (along > 5).all() and (
            along < (poses["PT1"].position - poses["AT"].position) @ ahead
        ).all()
        apart = np.linalg.norm(places[:, None] - places, axis=2)[np.triu_indices(7, 1)]
        assert apart.min() > 1.0
    depth = np.ptp(along)
    assert depth < 1e-6 if formation == "line" else depth > 11


def test_a_sensor_and_other_cities(tmp_path, capsys):
    """A sensor has no passive terminal and none of the data's keys; a mesh in UTM gets an origin
    near the swarm; blocks are generated. Planted bug: the origin of a mesh left out."""
    write_starter(tmp_path / "s.yaml", Wanted(sensor="awr1843"))
    scenario = load(tmp_path / "s.yaml")
    assert scenario.radio.mode == "fmcw" and [*scenario.swarm] == ["AT", "U1"]
    east, north = 691000.0, 5334000.0
    box = trimesh.creation.box(bounds=[[east, north, 500], [east + 30, north + 20, 515]])
    ground = trimesh.creation.box(
        bounds=[[east - 70, north - 70, 499], [east + 90, north + 90, 500]]
    )
    (box + ground).export(tmp_path / "utm.ply")
    write_starter(tmp_path / "m.yaml", Wanted(str(tmp_path / "utm.ply")))
    scenario = load(tmp_path / "m.yaml")
    assert scenario.city.source == "mesh" and scenario.city.origin[:2] == (east, north)
    assert np.abs(swarm_of(scenario).poses(0.0)["AT"].position).max() < 150
    write_starter(tmp_path / "b.yaml", Wanted("simple_street_canyon"))
    assert load(tmp_path / "b.yaml").city.name == "simple_street_canyon"
    write_starter(tmp_path / "g.yaml", Wanted("blocks"))
    assert city_of(load(tmp_path / "g.yaml")).num_faces > 0
    for options, said in (
        (["--city", "nowhere"], "there are box, "),
        (["--city", "no.xml"], "--city no.xml: there is no such file"),
        (
            ["--city", str(tmp_path / "utm.ply"), "--crs", "EPSG:2056"],
            "are of maps, not of utm.ply",
        ),
        (["--uavs", "3"], "--uavs is of --formation"),
        (["--sensor", "awr"], "--sensor awr: there are awr1843"),
    ):
        assert main(["new", str(tmp_path / "bad.yaml"), *options]) == 2
        assert said in capsys.readouterr().err and not (tmp_path / "bad.yaml").exists()


@pytest.mark.sionna
@pytest.mark.parametrize("make", [osm, pytest.param(swiss, marks=pytest.mark.slow)])
def test_the_first_run_decodes_something(make, tmp_path):
    """The first frames of it, without clutter, in a test's time."""
    begun(make, tmp_path)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        few = load(tmp_path / "mine.yaml", ["frames=5", "clutter.model=none"])
        summary = simulate.summarise(few)
    assert summary["terminals"]["PT1"]["bits"] > 1000
    assert summary["terminals"]["PT1"]["ber"] < 0.05
    assert summary["city"]["crs"] == ("OGC:CRS84" if make is osm else "EPSG:2056")


@pytest.mark.slow
@pytest.mark.sionna
@pytest.mark.parametrize("make", [osm, swiss])
def test_the_whole_first_run(make, tmp_path, capsys):
    begun(make, tmp_path)
    assert main(["run", str(tmp_path / "mine.yaml"), "--out", str(tmp_path / "o")]) == 0
    summary = json.loads((tmp_path / "o" / "summary.json").read_text())
    assert summary["terminals"]["PT1"]["ber"] < 0.05
    assert "arning" not in capsys.readouterr().err
