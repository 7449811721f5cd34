"""The report of a run: one self-contained page with tables, figures and what they mean."""

from __future__ import annotations

import base64
import json
from collections.abc import Sequence
from importlib.resources import files as package_files
from pathlib import Path

import jinja2
import numpy as np
import pandas as pd
import xarray as xr

from isac_rt.propagation.pathset import PathKind
from isac_rt.results.recorder import Results
from isac_rt.runtime import MissingPackage
from isac_rt.storage import write_whole
from isac_rt.views import tables
from isac_rt.views.scene import MOST_LINES, moving_scene, page_part
from isac_rt.views.tables import DASH, Table, flat, link_words, number, row_table
from isac_rt.world.city.mesh import CityMesh

MOST_WALLS = 8
_KINDS = {
    "Diffuse": PathKind.DIFFUSE,
    "Ghosts": PathKind.GHOST,
    "Mirror images": PathKind.SPECULAR,
}
_WINDS = ("north", "north-east", "east", "south-east", "south", "south-west", "west", "north-west")
_UP = 0.7
"""A surface whose normal rises more faces up or down."""


def walls(dataset: xr.Dataset, city: CityMesh) -> pd.DataFrame:
    """The planes of the city that detections came from, those with most of them first.

    Parameters
    ----------
    dataset : of a run
    city : its city

    Returns
    -------
    a row for each plane: what it is, its middle [m], detections by kind of path, and whose ghosts
    they are
    """
    seen = pd.DataFrame(
        {name: dataset[f"det_{name}"].values.astype(int) for name in ("face", "kind", "target")}
    )
    seen = seen[(seen.face >= 0) & (seen.face < city.num_faces) & seen.kind.isin(_KINDS.values())]
    seen["plane"] = city.plane_of_face[seen.face.to_numpy()]
    names = [str(name) for name in dataset.uav.values]
    rows = []
    for _, mine in seen.groupby("plane"):
        faces = mine.face.to_numpy()
        ghosts = mine.target[(mine.kind == PathKind.GHOST) & (mine.target >= 0)]
        rows.append(
            {
                "Surface": _words(city, int(faces[0])),
                "Middle [m]": ", ".join(
                    f"{x:.0f}"
                    for x in (city.corners[faces].mean(axis=(0, 1)) + city.origin).round() + 0.0
                ),
                **{name: int((mine.kind == kind).sum()) for name, kind in _KINDS.items()},
                "Ghosts of": ", ".join(names[k] for k in sorted(set(ghosts))),
                "all": len(mine),
            }
        )
    table = pd.DataFrame(rows)
    if rows:
        table = table.sort_values("all", ascending=False, kind="stable").drop(columns="all")
    return table


def _words(city: CityMesh, face: int) -> str:
    """Material of a face, and where it looks."""
    material = city.materials[city.face_material[face]].name
    x, y, z = city.normals[face]
    if abs(z) > _UP:
        return f"{material}, level"
    wind = _WINDS[round(np.degrees(np.arctan2(x, y)) / 45) % 8]
    return f"{material}, facing {wind}"


FIGURES = (
    "scene",
    "range_doppler",
    "equivalent_range",
    "tracks",
    "errors_terminals",
    "errors",
    "paths",
    "decoding",
    "link",
)
"""Beginnings of the names of figures that have a place on the page; others stand at its end."""


_ROLES = {"active": "active terminal", "passive": "passive terminal", "target": "target"}


def _count(number: int, what: str) -> str:
    """Return a number with its noun."""
    return f"{number} {what}{'s' * (number != 1)}"


def _scene(dataset: xr.Dataset, city: CityMesh | None) -> tuple[str, str]:
    """Return the 3-D scene of the run, or the reason without one; empty without a city."""
    if city is None or "track_state" not in dataset:
        return "", ""
    try:
        return page_part(moving_scene(dataset, city), "scene"), ""
    except MissingPackage as problem:
        return "", str(problem)


def wall_table(dataset: xr.Dataset, city: CityMesh) -> Table:
    """The surfaces of the city that most detections came from, as `walls` finds them."""
    table = walls(dataset, city).head(MOST_WALLS)
    table = table.loc[:, [table[name].astype(bool).any() for name in table]]  # what occurs
    return Table([*table.columns], [[number(v) for v in row] for row in table.values.tolist()])


def _embedded(pictures: Sequence[Path]) -> dict[str, list[str]]:
    """The pictures in base 64 by `FIGURES`."""
    out: dict[str, list[str]] = {key: [] for key in (*FIGURES, "other")}
    for file in pictures:
        key = next((key for key in FIGURES if f"{file.stem}_".startswith(f"{key}_")), "other")
        out[key].append(base64.b64encode(file.read_bytes()).decode())
    return out


def write_report(
    results: Results, folder: str | Path, pictures: Sequence[Path], city: CityMesh | None = None
) -> Path:
    """Write ``report.html`` into `folder` with the figures `pictures` embedded, and with the 3-D
    scene of the `city` if it is given; nothing in it is fetched from elsewhere.

    Raises
    ------
    isac_rt.storage.StorageError  If the folder cannot be written.
    """
    s, d = results.summary, results.dataset
    radios = [one.radio for one in results.scenario.by_chirp()]
    scene, no_scene = _scene(d, city)
    materials = json.loads(d.attrs["materials"])
    environment = jinja2.Environment(
        autoescape=True, undefined=jinja2.StrictUndefined, trim_blocks=True
    )
    template = environment.from_string(
        (package_files("isac_rt.views") / "report.html.j2").read_text(encoding="utf-8")
    )
    roles = [str(r) for r in d.role.values]
    span = float(d.time.values[-1] - d.time.values[0]) if d.sizes["frame"] else 0.0
    page = template.render(
        summary=s,
        passive="passive" in roles,
        span=f"{span:.2f} s",
        roles=", ".join(_count(roles.count(r), _ROLES.get(r, r)) for r in dict.fromkeys(roles)),
        carrier=" and ".join(f"{radio.carrier_hz / 1e9:g} GHz" for radio in radios),
        bandwidth=" and ".join(f"{radio.bandwidth_hz / 1e6:g} MHz" for radio in radios),
        in_turn=any((radio.mode, radio.scheme) == ("fmcw", "tdm") for radio in radios),
        tables=tables,
        coverage=json.loads(d.attrs.get("coverage", "null")),
        walls=wall_table(d, city) if city is not None and "det_face" in d else Table((), ()),
        budget=row_table(
            [row | {"link": link_words(row["link"])} for row in json.loads(d.attrs["link_budget"])]
        ),
        paths=Table(
            ("Kind", "Paths"), [(k.replace("_", " "), number(v)) for k, v in s["paths"].items()]
        ),
        scene=scene,
        no_scene=no_scene,
        lines=MOST_LINES,
        figures=_embedded(pictures),
        access=Table(("Stages before the data", "Outcome"), flat(s["access"] or {})),
        sparsity=row_table(
            [{"link": link_words(name), **row} for name, row in (s.get("sparsity") or {}).items()]
        ),
        fidelity=Table(("Part", "Model"), flat(s["fidelity"])),
        materials=row_table([{"material": name, **values} for name, values in materials.items()]),
        versions=Table(
            ("Package", "Version"),
            [
                *s["versions"].items(),
                ("commit", d.attrs["commit"] or DASH),
                ("platform", d.attrs["platform"]),
            ],
        ),
        scenario_yaml=d.attrs["scenario"],
    )
    file = Path(folder) / "report.html"
    write_whole(file, page)
    return file
