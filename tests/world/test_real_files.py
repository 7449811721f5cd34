"""Small cuts of real files, and bent copies of them. Their own vertices are the truth."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from isac_rt import scenario
from isac_rt.world.city import CityError, CityMesh, load_city

DATA = Path(__file__).parent / "data"
MARGIN = 5.0


def read(folder: Path, file: str) -> CityMesh:
    node = scenario.City(source="footprints", file=file, ground_margin_m=MARGIN)
    return load_city(node, folder, 77e9, (0.0, 0.0, 0.0))


@pytest.mark.parametrize(
    ("name", "crs", "says"),
    [
        ("delft", "EPSG:28992", "1 PlantCover: vegetation, 1 WaterBody: water"),
        ("zurich", "EPSG:2056", "ground made through the feet of 5 buildings, 439 to 518 m"),
    ],
)
def test_a_city_fills_the_box_of_its_vertices(name, crs, says):
    """To the millimetre that the files count in; the ground reaches a margin beyond it."""
    held = json.loads((DATA / f"{name}.city.json").read_text())
    places = np.array(held["vertices"]) * held["transform"]["scale"]
    places += held["transform"]["translate"]
    city = read(DATA, f"{name}.city.json")
    low, high = city.bounds()
    assert low[:2] == pytest.approx(places.min(axis=0)[:2] - MARGIN, abs=1e-3)
    assert high[:2] == pytest.approx(places.max(axis=0)[:2] + MARGIN, abs=1e-3)
    assert (low[2], high[2]) == pytest.approx((places[:, 2].min(), places[:, 2].max()), abs=1e-3)
    assert city.georeference is not None and city.georeference.crs == crs
    assert any(says in note for note in city.notes)


@pytest.mark.parametrize("name", ["delft", "zurich"])
@pytest.mark.parametrize("curvature", ["cut", "no vertices", "beyond the vertices"])
def test_bent_copies_are_one_message(name, curvature, tmp_path):
    text = (DATA / f"{name}.city.json").read_text()
    held = json.loads(text)
    if curvature == "no vertices":
        del held["vertices"]
    if curvature == "beyond the vertices":
        held["vertices"] = held["vertices"][:9]
    bent = text[: len(text) // 2] if curvature == "cut" else json.dumps(held)
    (tmp_path / "bent.city.json").write_text(bent)
    with pytest.raises(CityError, match=r"bent\.city\.json"):
        read(tmp_path, "bent.city.json")
