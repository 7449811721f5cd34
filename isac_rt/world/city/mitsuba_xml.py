"""Mitsuba scene files, among them those that ship with Sionna RT, read without Mitsuba and kept in
float64."""

from __future__ import annotations

import importlib.util
import re
import xml.etree.ElementTree as ET
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from isac_rt import scenario
from isac_rt.world.city.materials import (
    DEFAULT_EXPONENT,
    DEFAULT_THICKNESS,
    CityError,
    Material,
    MaterialUse,
    canonical_name,
)
from isac_rt.world.city.mesh import Surface
from isac_rt.world.city.meshfiles import read_triangles

_RECTANGLE = (
    np.array([[-1.0, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]]),
    np.array([[0, 1, 2], [0, 2, 3]]),
)
_CUBE = (
    np.array([[x, y, z] for z in (-1.0, 1) for y in (-1.0, 1) for x in (-1.0, 1)]),
    np.array(
        "0 2 3 0 3 1 4 5 7 4 7 6 0 1 5 0 5 4 2 6 7 2 7 3 0 4 6 0 6 2 1 3 7 1 7 5".split(), int
    ).reshape(-1, 3),
)


@dataclass
class _Reader:
    """One file: where it is, its defaults, and its materials by id."""

    path: Path
    city: scenario.City
    defaults: dict[str, str]

    def text(self, element: ET.Element, key: str, otherwise: str | None = None) -> str | None:
        """An attribute with `$name` replaced."""
        value = element.get(key, otherwise)
        if value is None:
            return None

        def known(match: re.Match[str]) -> str:
            name = match.group(1) or match.group(2)
            if name not in self.defaults:
                raise CityError(f"{self.path.name}: ${name} has no <default>; give it one")
            return self.defaults[name]

        return re.sub(r"\$(?:\{(\w+)\}|(\w+))", known, value)

    def numbers(
        self, element: ET.Element, key: str = "value", otherwise: str | None = None
    ) -> NDArray[np.float64]:
        value = self.text(element, key, otherwise)
        try:
            return np.array([float(v) for v in re.split(r"[\s,]+", (value or "").strip())])
        except ValueError:
            raise CityError(
                f"{self.path.name}: <{element.tag} {key}={value!r}> is not a list of numbers; "
                "correct it"
            ) from None

    def scalar(self, element: ET.Element, name: str) -> float | None:
        found = element.find(f"float[@name='{name}']")
        return None if found is None else float(self.numbers(found)[0])


def _vector(reader: _Reader, element: ET.Element, missing: float) -> NDArray[np.float64]:
    if element.get("value") is not None:
        value = reader.numbers(element)
        return np.full(3, value[0]) if value.size == 1 else value
    return np.array([reader.numbers(element, axis, str(missing))[0] for axis in "xyz"])


def _rotation(axis: NDArray[np.float64], angle: float) -> NDArray[np.float64]:
    x, y, z = axis / np.linalg.norm(axis)
    skew = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.eye(3) + np.sin(angle) * skew + (1 - np.cos(angle)) * skew @ skew


def transform_of(reader: _Reader, shape: ET.Element) -> NDArray[np.float64]:
    """(4, 4) `to_world` of a shape: its parts in the order in which they stand, each after the ones
    before."""
    total = np.eye(4)
    node = shape.find("transform[@name='to_world']")
    for part in [] if node is None else node:
        step = np.eye(4)
        if part.tag == "translate":
            step[:3, 3] = _vector(reader, part, 0.0)
        elif part.tag == "scale":
            step[:3, :3] = np.diag(_vector(reader, part, 1.0))
        elif part.tag == "rotate":
            angle = np.deg2rad(reader.numbers(part, "angle", "0")[0])
            step[:3, :3] = _rotation(_vector(reader, part, 0.0), angle)
        elif part.tag == "matrix":
            values = reader.numbers(part)
            size = round(values.size**0.5)
            step[:size, :size] = values.reshape(size, size)
        else:
            raise CityError(
                f"{reader.path.name}: <{part.tag}> in a transform is not read here; write it as "
                "<matrix>"
            )
        total = step @ total
    return total


def _material(reader: _Reader, bsdf: ET.Element) -> MaterialUse:
    name = reader.text(bsdf, "id") or ""
    if name in reader.city.material_map:
        return MaterialUse(reader.city.material_map[name])
    thickness = reader.scalar(bsdf, "thickness")
    if bsdf.get("type") == "radio-material":
        eps, sigma = (
            reader.scalar(bsdf, "relative_permittivity"),
            reader.scalar(bsdf, "conductivity"),
        )
        scattering = reader.scalar(bsdf, "scattering_coefficient")
        defined = Material(
            name,
            1.0 if eps is None else eps,
            sigma or 0.0,
            scattering or 0.0,
            "lambertian",
            DEFAULT_EXPONENT,
            DEFAULT_THICKNESS if thickness is None else thickness,
            f"numbers in {reader.path.name}",
        )
        return MaterialUse(name, defined=defined)
    kind = bsdf.find("string[@name='type']")
    wanted = name if kind is None else reader.text(kind, "value") or name
    short = name.removeprefix("mat-")
    if canonical_name(wanted) is None and short in reader.city.materials:
        wanted = short
    return MaterialUse(canonical_name(wanted) or wanted, thickness)


def _bsdf_of(reader: _Reader, shape: ET.Element, by_id: dict[str, ET.Element]) -> MaterialUse:
    own = shape.find("bsdf")
    if own is not None:
        return _material(reader, own)
    for ref in shape.findall("ref"):
        key = reader.text(ref, "id")
        if key in by_id:
            return _material(reader, by_id[key])
    return MaterialUse(reader.city.material)


def _geometry(reader: _Reader, shape: ET.Element) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    kind = shape.get("type")
    if kind in ("ply", "obj", "stl"):
        node = shape.find("string[@name='filename']")
        if node is None:
            raise CityError(
                f"{reader.path.name}: shape {shape.get('id')!r} has no filename; give it one"
            )
        folder = reader.path.parent.resolve()
        file = (folder / (reader.text(node, "value") or "")).resolve()
        if not file.is_relative_to(folder):
            name = reader.text(node, "value")
            raise CityError(
                f"{reader.path.name}: shape {shape.get('id')!r} wants {name}, outside the scene's "
                "folder; copy it there"
            )
        if not file.is_file():
            raise CityError(
                f"{reader.path.name}: shape {shape.get('id')!r} wants "
                f"{reader.text(node, 'value')}, which is missing"
            )
        return read_triangles(file)
    if kind == "rectangle":
        return _RECTANGLE
    if kind == "cube":
        return _CUBE
    raise CityError(
        f"{reader.path.name}: shape {shape.get('id')!r} is of type {kind!r}; ply, obj, stl, "
        "rectangle and cube are read here"
    )


def mitsuba_file(city: scenario.City, path: Path) -> tuple[list[Surface], list[str]]:
    """The surfaces of a Mitsuba scene file in world coordinates; lights, cameras and integrators
    are not looked at.

    Materials go by the `type` of an ITU radio material, else by the bsdf's id; a `radio-material`
    keeps its numbers; `material_map` by bsdf id comes first.

    Raises
    ------
    CityError
    """
    try:
        root = ET.parse(path).getroot()
    except ET.ParseError as error:
        raise CityError(f"{path.name}: not readable as XML ({error}); export it again") from None
    defaults = {d.get("name", ""): d.get("value", "") for d in root.iter("default")}
    reader = _Reader(path, city, defaults)
    by_id = {str(b.get("id")): b for b in root.findall("bsdf")}
    surfaces = []
    for shape in root.iter("shape"):
        if shape.get("type") == "merge":
            continue  # its members come along by themselves
        vertices, faces = _geometry(reader, shape)
        transform = transform_of(reader, shape)
        vertices = vertices @ transform[:3, :3].T + transform[:3, 3]
        surfaces.append(Surface(vertices, faces, _bsdf_of(reader, shape, by_id)))
    if not surfaces:
        raise CityError(f"{path.name}: there is no shape in it; export the scene with its meshes")
    return surfaces, []


def builtin_path(name: str) -> Path:
    """Where Sionna RT keeps the scene of that name. Sionna itself is not imported.

    Raises
    ------
    CityError  If there is no such scene, with the list of those there are.
    """
    package = importlib.util.find_spec("sionna")
    if package is None or not package.submodule_search_locations:
        raise CityError(
            "the built-in cities come with Sionna RT, which is not installed; run make setup"
        )
    folder = Path(package.submodule_search_locations[0]) / "rt" / "scenes"
    known = sorted(p.parent.name for p in folder.glob("*/*.xml") if p.stem == p.parent.name)
    if name not in known:
        raise CityError(f"city.name {name!r} is no built-in scene; there are {', '.join(known)}")
    return folder / name / f"{name}.xml"
