"""What is prepared once for all runs of a city and a flight: found again to the last bit, and only
where nothing that it depends on has changed."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import numpy as np
import pytest

from isac_rt import load, runtime
from isac_rt.plain import plain
from isac_rt.propagation.clutter import field as clutter_field
from isac_rt.propagation.clutter import visibility as sight
from isac_rt.propagation.clutter.field import in_local
from isac_rt.simulation.setup import prepare
from isac_rt.storage import CACHE_VARIABLE, pack
from isac_rt.world import area
from isac_rt.world.city import mesh

try:
    runtime.activate()
except runtime.RuntimeProblem as problem:
    pytest.skip(str(problem), allow_module_level=True)

TREE = {
    "seed": 3,
    "frames": 12,
    "frame_interval_s": 0.05,
    "swarm": {
        "AT": {"role": "active", "position_m": [-58.3, -8.4, 27.2], "velocity_mps": [5.3, -0.6, 0]},
        "PT1": {"role": "passive", "position_m": [4.6, -13.1, 30.4], "boresight": [-1, 0, 0]},
    },
    "receiver_preset": "plain",
    "city": {"source": "footprints", "file": "quarter.geojson", "wall_material": "brick"},
    "propagation": {"model": "ray_traced", "max_bounces": 0},
    "clutter": {"model": "field", "max_error_db": 1.0},
    "noise": {"model": "link_budget", "tx_power_dbm": 3},
}
CHANGES = {
    "nothing": {},
    "seed": {"seed": 4},
    "flight": {"swarm": {"AT": {"velocity_mps": [5.3, -0.5, 0]}}},
    "attitude": {"swarm": {"PT1": {"boresight": [-1, 0.2, 0]}}},
    "length of the flight": {"frames": 13},
    "material": {"city": {"wall_material": "concrete"}},
    "numbers of a material": {"city": {"materials": {"brick": {"scattering_coefficient": 0.31}}}},
    "density": {"clutter": {"max_error_db": 0.9}},
    "smallest cell": {"clutter": {"smallest_cell_m2": 1.0}},
    "noise": {"noise": {"tx_power_dbm": 4}},
    "carrier": {"radio": {"carrier_hz": 76e9}},
    "antennas": {"array": {"element_gain_dbi": 4.0}},
    "receivers": {"receivers": {"symbol_decision": "beams"}},
}


def changed(tree: dict, change: dict) -> dict:
    return tree | {
        key: changed(tree.get(key, {}), value) if isinstance(value, dict) else value
        for key, value in change.items()
    }


def prepared(folder: Path, change: dict) -> bytes:
    """City, planes and scatterers of a set-up, and how they are seen in a frame, as bytes."""
    (folder / "scene.yaml").write_text(json.dumps(changed(TREE, change)))
    area._near_city.cache_clear()
    area._loaded_city.cache_clear()
    setup = prepare(load(folder / "scene.yaml"))
    field = setup.propagation.field
    cells = [vars(field.of(link).cells) for link in [*field.merged, ("no", "link")]]
    time, at = setup.timetable.epoch(5), setup.swarm.poses(setup.timetable.epoch(5))
    shares = [
        field.of(link).visibility.share(name, in_local(at[name], setup.city.origin), time)
        for link in field.merged
        for name in link
    ]
    tree, arrays = pack([plain(setup.city), setup.city.plane_of_face, cells, shares])
    return tree.encode() + arrays


@pytest.fixture
def place(tmp_path, monkeypatch):
    """A folder with a city, and one for what is kept."""
    quarter = Path(__file__).parents[2] / "scenes/data/quarter.geojson"
    shutil.copy(quarter, tmp_path / "quarter.geojson")
    monkeypatch.setattr(mesh, "MIN_CACHED_FACES", 10)
    monkeypatch.setenv(CACHE_VARIABLE, str(tmp_path / "kept"))
    return tmp_path


def test_what_is_kept_is_what_would_be_prepared(place, monkeypatch):
    """Each change of a scenario, after the unchanged one was kept: the bytes are those of a set-up
    without a store. Planted bugs: a key without the seed, the materials, the poses or the noise;
    sight kept by its time samples alone, without its points."""
    monkeypatch.setenv(CACHE_VARIABLE, str(place / "kept"))
    first = prepared(place, {})
    found = {name: prepared(place, change) for name, change in CHANGES.items()}
    monkeypatch.setenv(CACHE_VARIABLE, "")
    for name, change in CHANGES.items():
        assert found[name] == prepared(place, change), name
    assert found["nothing"] == first
    assert len({*found.values()}) >= len(found) - 1  # another attitude may hide nothing else


def test_a_second_set_up_makes_nothing_and_sees_every_byte_of_the_city(place, monkeypatch):
    """Nothing is cut, merged nor asked of rays again; one changed digit of the city's file, and all
    is made anew. Planted bug: the file's name and size in the key instead of its bytes."""
    first = prepared(place, {})
    calls = []
    for room, name in (
        (clutter_field, "cut"),
        (clutter_field, "merged_below_noise"),
        (sight, "crossings"),
    ):
        old = getattr(room, name)
        monkeypatch.setattr(
            room, name, lambda *a, old=old, name=name: calls.append(name) or old(*a)
        )
    assert prepared(place, {}) == first
    assert calls == []
    file = place / "quarter.geojson"
    text = file.read_text()
    at = text.index('"height"') if '"height"' in text else text.index("coordinates")
    digit = next(i for i in range(at, len(text)) if text[i].isdigit() and text[i] not in "09")
    file.write_text(text[:digit] + str(int(text[digit]) + 1) + text[digit + 1 :])
    assert prepared(place, {}) != first
    assert {*calls} == {"cut", "merged_below_noise", "crossings"}


def test_a_bent_file_is_made_again(place):
    """Every kept file, one byte turned somewhere: the set-up is the same. Planted bug: no look at
    the checksum."""
    first = prepared(place, {})
    files = sorted((place / "kept").glob("*/*.data"))
    assert len(files) == 9
    rng = np.random.default_rng(2)
    for file in files:
        good = file.read_bytes()
        for at in [*rng.integers(0, len(good), 3), len(good) - 1]:
            file.write_bytes(good[:at] + bytes([good[at] ^ 4]) + good[at + 1 :])
            assert prepared(place, {}) == first
            assert file.read_bytes() == good
