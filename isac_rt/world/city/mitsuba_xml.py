"""Mitsuba scene files, among them those that ship with Sionna RT, read without Mitsuba and kept in
float64."""

from __future__ import annotations

import importlib.util
import re
import xml.etree.ElementTree as ET
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache, lru_cache
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from pydantic import ValidationError

from isac_rt.world import settings
from isac_rt.world.city.files import beside, read_bytes
from isac_rt.world.city.materials import (
    DEFAULT_EXPONENT,
    DEFAULT_THICKNESS,
    CityError,
    Material,
    MaterialUse,
    canonical_name,
    material_within,
)
from isac_rt.world.city.mesh import Surface, gathered
from isac_rt.world.city.meshfiles import Piece, pieces
from isac_rt.world.settings import MaterialOverride

_MESHES = (".ply", ".obj", ".stl")
_LONGEST = 1000
"""Characters of an attribute, before and after its defaults are put in."""


def _shape(corners: list[list[float]], faces: str) -> list[Piece]:
    triangles = np.array([list(triangle) for triangle in faces.split()], dtype=np.int64)
    return [Piece(np.array(corners), triangles, ())]


_SHAPES = {
    "rectangle": _shape([[-1.0, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]], "012 023"),
    "cube": _shape(
        [[x, y, z] for z in (-1.0, 1) for y in (-1.0, 1) for x in (-1.0, 1)],
        "023 031 457 476 015 054 267 273 046 062 137 175",
    ),
}


class _Tree(ET.TreeBuilder):
    """Builds the tree of a file without a document type, whose entities might grow without end."""

    def doctype(self, *_: str | None) -> None:
        raise ValueError("a <!DOCTYPE> is not read here")


@dataclass(frozen=True)
class _Reader:
    """One file: where it is, what it holds, and its defaults."""

    path: Path
    root: ET.Element
    defaults: dict[str, str]
    beside: dict[str, Path]
    """Mesh files that were found already, by their names."""

    @classmethod
    def of(cls, path: Path) -> _Reader:
        return _reader(path, read_bytes(path))

    def text(self, element: ET.Element, key: str, otherwise: str | None = None) -> str | None:
        """An attribute with `$name` replaced."""
        value = element.get(key, otherwise)
        if value is None:
            return None

        def known(match: re.Match[str]) -> str:
            name = match.group(1) or match.group(2)
            if name not in self.defaults:
                raise CityError(f"{self.path.name}: ${name} has no <default>; give it one")
            return self.defaults[name][:_LONGEST]

        if len(value) > _LONGEST:
            raise CityError(
                f"{self.path.name}: <{element.tag} {key}> has {len(value)} characters, more than "
                f"{_LONGEST}; shorten it"
            )
        return re.sub(r"\$(?:\{(\w+)\}|(\w+))", known, value)

    def numbers(
        self,
        element: ET.Element,
        counts: tuple[int, ...],
        key: str = "value",
        otherwise: str | None = None,
    ) -> NDArray[np.float64]:
        """The finite numbers of an attribute, as many as one of `counts`."""
        value = self.text(element, key, otherwise)
        try:
            numbers = np.array([float(v) for v in re.split(r"[\s,]+", (value or "").strip())])
        except ValueError:
            numbers = np.full(1, np.nan)
        if len(numbers) not in counts or not np.isfinite(numbers).all():
            raise CityError(
                f"{self.path.name}: <{element.tag} {key}={value!r}> is not a list of "
                f"{' or '.join(map(str, counts))} numbers; correct it"
            )
        return numbers

    def scalar(self, element: ET.Element, name: str) -> float | None:
        found = element.find(f"float[@name='{name}']")
        return None if found is None else float(self.numbers(found, (1,))[0])


def _vector(reader: _Reader, element: ET.Element, missing: float) -> NDArray[np.float64]:
    if element.get("value") is not None:
        value = reader.numbers(element, (1, 3))
        return np.full(3, value[0]) if value.size == 1 else value
    return np.array([reader.numbers(element, (1,), axis, str(missing))[0] for axis in "xyz"])


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
            angle = np.deg2rad(reader.numbers(part, (1,), "angle", "0")[0])
            step[:3, :3] = _rotation(_vector(reader, part, 0.0), angle)
        elif part.tag == "matrix":
            values = reader.numbers(part, (9, 16))
            size = round(values.size**0.5)
            step[:size, :size] = values.reshape(size, size)
        else:
            raise CityError(
                f"{reader.path.name}: <{part.tag}> in a transform is not read here; write it as "
                "<matrix>"
            )
        total = step @ total
    return total


def _placed(
    reader: _Reader,
    parent: ET.Element,
    to_world: NDArray[np.float64],
    groups: dict[str, ET.Element] | None,
) -> Iterator[tuple[ET.Element, NDArray[np.float64]]]:
    """Yield the shapes under an element with their transforms (4, 4), those of one of the `groups`
    once for each instance; None: within a group, which holds no instance."""
    for shape in parent.findall("shape"):
        kind, own = shape.get("type"), to_world @ transform_of(reader, shape)
        if kind == "instance" and groups is not None:
            keys = [reader.text(ref, "id") or "" for ref in shape.findall("ref")]
            named = [*shape.findall("shape"), *(groups[key] for key in keys if key in groups)]
            if not named:
                raise CityError(f"{reader.path.name}: an instance names no shapegroup; correct it")
            yield from _placed(reader, named[0], own, None)
        elif kind == "merge":
            yield from _placed(reader, shape, own, groups)
        elif kind != "shapegroup":
            yield shape, own


def _material(
    reader: _Reader, city: settings.City, bsdf: ET.Element, notes: list[str]
) -> MaterialUse:
    name = reader.text(bsdf, "id") or ""
    if name in city.material_map:
        return MaterialUse(city.material_map[name])
    given = {
        key: reader.scalar(bsdf, re.sub("_s_per_m$|_m$", "", key))
        for key in MaterialOverride.model_fields
        if key not in ("scattering_pattern", "pattern_exponent")
    }
    try:
        numbers = MaterialOverride.model_validate(given)
    except ValidationError as error:
        first = error.errors()[0]
        raise CityError(
            f"{reader.path.name}: <bsdf id={name!r}>: {first['loc'][0]}: {first['msg']}; correct it"
        ) from None
    thickness = numbers.thickness_m
    if bsdf.get("type") == "radio-material" and numbers.relative_permittivity is not None:
        defined = Material(
            name,
            numbers.relative_permittivity,
            numbers.conductivity_s_per_m or 0.0,
            numbers.scattering_coefficient or 0.0,
            "lambertian",
            DEFAULT_EXPONENT,
            thickness or DEFAULT_THICKNESS,
            f"numbers in {reader.path.name}",
        )
        return MaterialUse(name, defined=defined)
    kind = bsdf.find("string[@name='type']")
    wanted = name if kind is None else reader.text(kind, "value") or name
    short, known = name.removeprefix("mat-"), canonical_name(wanted)
    if known is None and short in city.materials:
        wanted = short
    elif known is None and (known := material_within(wanted)):
        notes.append(f"{name[:60]} without numbers, and no known material, became {known}")
    return MaterialUse(known or wanted, thickness)


@lru_cache(maxsize=1)
def _reader(path: Path, content: bytes) -> _Reader:
    """Return a reader of a file whose content was read before for its digest."""
    parser = ET.XMLParser(target=_Tree())
    try:
        root = ET.fromstring(content, parser)
    except (ET.ParseError, LookupError, ValueError) as error:
        raise CityError(f"{path.name}: not readable as XML ({error}); export it again") from None
    defaults = {d.get("name", ""): d.get("value", "") for d in root.iter("default")}
    return _Reader(path, root, defaults, {})


def _mesh_path(reader: _Reader, shape: ET.Element) -> Path:
    """The mesh file that a shape names."""
    what = f"shape {shape.get('id')!r}"
    node = shape.find("string[@name='filename']")
    if node is None:
        raise CityError(f"{reader.path.name}: {what} has no filename; give it one")
    name = (reader.text(node, "value") or "").replace("\\", "/")  # as Windows writes it
    if name not in reader.beside:
        reader.beside[name] = beside(reader.path, name, what)
    return reader.beside[name]


def mitsuba_files(path: Path) -> list[Path]:
    """A Mitsuba scene file and the meshes that it is read from."""
    reader = _Reader.of(path)
    shapes = (s for s in reader.root.iter("shape") if f".{s.get('type')}" in _MESHES)
    return list(dict.fromkeys([path, *(_mesh_path(reader, shape) for shape in shapes)]))


def mitsuba_file(city: settings.City, path: Path) -> tuple[list[Surface], list[str]]:
    """The surfaces of a Mitsuba scene file in world coordinates; lights, cameras and integrators
    are not looked at.

    Materials go by the `type` of an ITU radio material, else by the bsdf's id; a `radio-material`
    keeps its numbers; `material_map` by bsdf id comes first.

    Raises
    ------
    CityError
    """
    reader = _Reader.of(path)
    by_id = {str(b.get("id")): b for b in reader.root.findall("bsdf")}
    notes = list[str]()
    read = cache(lambda file: list(pieces(file, _MESHES)))
    known = cache(lambda key: _material(reader, city, by_id[key], notes))

    def use(shape: ET.Element) -> MaterialUse:
        own = shape.find("bsdf")
        if own is not None:
            return _material(reader, city, own, notes)
        keys = (reader.text(ref, "id") for ref in shape.findall("ref"))
        key = next((key for key in keys if key in by_id), None)
        return MaterialUse(city.material) if key is None else known(key)

    def surfaces() -> Iterator[Surface]:
        groups = {str(g.get("id")): g for g in reader.root.findall("shape[@type='shapegroup']")}
        for shape, transform in _placed(reader, reader.root, np.eye(4), groups):
            kind = shape.get("type", "")
            if kind not in _SHAPES and f".{kind}" not in _MESHES:
                raise CityError(
                    f"{path.name}: shape {shape.get('id')!r} is of type {kind!r}; "
                    f"{', '.join(_SHAPES)} and meshes ({', '.join(_MESHES)}) are read here"
                )
            material = use(shape)
            for piece in _SHAPES.get(kind) or read(_mesh_path(reader, shape)):
                vertices = piece.vertices @ transform[:3, :3].T + transform[:3, 3]
                yield Surface(vertices, piece.faces, material)

    found = gathered(surfaces(), path.name)
    if not found:
        raise CityError(f"{path.name}: there is no shape in it; export the scene with its meshes")
    return found, notes


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
