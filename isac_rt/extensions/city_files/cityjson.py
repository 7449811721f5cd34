"""CityJSON 1.x and 2.0, CityJSONSeq: the surfaces of the highest level of detail, or footprints
where there is nothing above level 0."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from typing import Annotated, Any, ClassVar, Literal, NamedTuple

import numpy as np
import shapely
from numpy.typing import NDArray
from pydantic import Field
from pydantic_core import from_json, to_json

from isac_rt.extensions.city_files.buildings import Outline
from isac_rt.extensions.city_files.extrude import check_corners, triangulate
from isac_rt.world import settings
from isac_rt.world.city.files import Items, Part, parsed
from isac_rt.world.city.heights import parse_length, roof_over_ground
from isac_rt.world.city.materials import CityError, MaterialUse
from isac_rt.world.city.mesh import Surface, check_coordinates

BUILDING_TYPES = ("Building", "BuildingPart", "BuildingUnit")
"""What stands on the ground."""
_INSIDE = ("BuildingFurniture", "BuildingRoom", "BuildingStorey", "TunnelFurniture")
"""What nobody sees from outside."""
_OTHERS = {
    "PlantCover": "vegetation",
    "SolitaryVegetationObject": "vegetation",
    "WaterBody": "water",
    "WaterSurface": "water",
    "Waterway": "water",
    "CityFurniture": "metal",
}
"""Material by type of what is no building, where `material_map` does not say."""
_GROUND_TYPES = "TINRelief LandUse Road Railway TransportSquare".split()
_FLAT_TYPES = (*_GROUND_TYPES, "PlantCover", "WaterBody", "WaterSurface", "Waterway")
"""What is taken as it is also where there is nothing above level 0."""
FOOT_M = 1e-3
"""What lies so near to the lowest point of a building stands on the ground."""
_Triple = tuple[float, float, float]
_Boundary = Items[Items[Annotated[int, Field(ge=0, lt=2**31)]]]


class _Kind(Part):
    type: str | None = None


class _Semantics(Part):
    surfaces: tuple[_Kind | None, ...] = ()
    values: list[Any] | None = None


class _Geometry(Part):
    lod: Annotated[float, Field(strict=False)] = 0.0
    semantics: _Semantics | None = None


class _Surfaces(_Geometry):
    type: Literal["MultiSurface", "CompositeSurface"]
    boundaries: Items[_Boundary]
    depth: ClassVar[int] = 0
    """How many lists lie around the list of surfaces."""


class _Solid(_Geometry):
    type: Literal["Solid"]
    boundaries: Items[Items[_Boundary]]
    depth: ClassVar[int] = 1


class _Solids(_Geometry):
    type: Literal["MultiSolid", "CompositeSolid"]
    boundaries: Items[Items[Items[_Boundary]]]
    depth: ClassVar[int] = 2


class _NoSurface(_Geometry):
    type: Literal["MultiPoint", "MultiLineString"]


class _Instance(_Geometry):
    """A template at a place."""

    type: Literal["GeometryInstance"]
    template: Annotated[int, Field(ge=0)]
    boundaries: Annotated[list[Annotated[int, Field(ge=0, lt=2**31)]], Field(min_length=1)]
    transformationMatrix: Annotated[list[float], Field(min_length=16, max_length=16)]


_Surfaced = _Surfaces | _Solid | _Solids
_AnyGeometry = Annotated[_Surfaced | _NoSurface | _Instance, Field(discriminator="type")]


class _Object(Part):
    type: str | None = None
    attributes: dict[str, Any] | None = None
    children: tuple[str, ...] = ()
    parents: tuple[str, ...] = ()
    geometry: tuple[_AnyGeometry, ...] = ()


class _Transform(Part):
    scale: _Triple
    translate: _Triple


class _Metadata(Part):
    referenceSystem: str | None = None


class _Templates(Part):
    templates: tuple[_AnyGeometry, ...] = ()
    vertices: Items[_Triple] = Field([], alias="vertices-templates")


class CityJson(Part):
    """Checked content of a CityJSON file."""

    type: Literal["CityJSON"]
    transform: _Transform | None = None
    metadata: _Metadata | None = None
    templates: _Templates | None = Field(None, alias="geometry-templates")
    vertices: Items[_Triple]
    CityObjects: dict[str, _Object] = Field({})


class _Sequel(Part):
    """A line of a CityJSONSeq file."""

    type: Literal["CityJSONFeature"]
    vertices: Items[_Triple]
    CityObjects: dict[str, _Object] = Field({})


class _Any(Part):
    """CityJSON whose objects are looked at one by one."""

    CityObjects: dict[str, Any] = Field({})


@dataclass(frozen=True)
class Solid:
    """A thing with surfaces.

    Parameters
    ----------
    what : str
        For messages.
    kind : str
        Its type.
    root : str
        The building that it is a part of, or itself.
    vertices : (V, 3) float64
    faces : mapping from material to (F, 3) int64
    foot : (K,) int64
        Vertices that stand on the ground.
    """

    what: str
    kind: str
    root: str
    vertices: NDArray[np.float64]
    faces: Mapping[str, NDArray[np.int64]]
    foot: NDArray[np.int64]

    def surfaces(self) -> Iterator[Surface]:
        """One for each material."""
        for material, faces in self.faces.items():
            yield Surface(self.vertices, faces, MaterialUse(material))


@dataclass
class CityModel:
    """City of a CityJSON file, in its own coordinates.

    Parameters
    ----------
    crs : str
        What the file says of its coordinate reference system.
    outlines : list of Outline
        Footprints to extrude.
    solids : list of Body
        All else; those of `BUILDING_TYPES` stand on the ground, TINRelief is ground.
    """

    crs: str = ""
    outlines: list[Outline] = field(default_factory=list)
    solids: list[Solid] = field(default_factory=list)


def _flat(boundaries: list, values: Any, depth: int) -> Iterator[tuple[list, int | None]]:
    """Each surface (a list of rings) with its semantic index, through `depth` outer lists."""
    for i, item in enumerate(boundaries):
        value = values[i] if isinstance(values, list) and i < len(values) else None
        if depth:
            yield from _flat(item, value, depth - 1)
        else:
            yield item, value if isinstance(value, int) else None


def _cross(a: NDArray[np.float64], b: NDArray[np.float64]) -> NDArray[np.float64]:
    """Cross product over the last axis: a tenth of numpy's time for a few vectors."""
    (x, y, z), (u, v, w) = (np.asarray(c).T for c in (a, b))
    return np.array([y * w - z * v, z * u - x * w, x * v - y * u]).T


def triangulate_planar(rings: list[NDArray[np.float64]]) -> NDArray[np.int64]:
    """Triangles of a planar polygon in space, with holes, in its own plane, keeping its
    orientation.

    Parameters
    ----------
    rings : list of (N, 3) float64
        Open rings, the outer one first. [m]

    Returns
    -------
    triangles : (T, 3) int64
        Indices into the concatenated rings; none if the outer ring has no area.
    """
    outer = rings[0] - rings[0][0]
    normal = _cross(outer[:-1], outer[1:]).sum(axis=0) / 2  # Newell; the first corner is the origin
    area = np.linalg.norm(normal)
    if not area > 0:
        return np.zeros((0, 3), dtype=np.int64)
    normal /= area
    across = _cross(normal, np.eye(3)[np.argmin(np.abs(normal))])
    across /= np.linalg.norm(across)
    basis = np.column_stack([across, _cross(normal, across)])
    return triangulate([(ring - rings[0][0]) @ basis for ring in rings])


def _material(city: settings.City, semantic: str | None, kind: str) -> str:
    """Return the material of a surface, by the scenario's `material_map` or by its semantics."""
    for name in (semantic, kind):
        if name is not None and name in city.material_map:
            return city.material_map[name]
    if kind in _OTHERS:
        return _OTHERS[kind]
    if kind in _GROUND_TYPES or semantic in ("GroundSurface", "OuterFloorSurface"):
        return city.ground_material
    if semantic == "Window":
        return "glass"
    roof = semantic in ("RoofSurface", "OuterCeilingSurface")
    return city.roof_material if roof else city.wall_material


class _Rings(NamedTuple):
    """The surfaces of one material: three corners, four corners, and all others as rings."""

    threes: list[list[int]]
    fours: list[list[int]]
    others: list[_Boundary]


def _triangles(rings: _Rings, vertices: NDArray[np.float64]) -> NDArray[np.int64]:
    """(F, 3) vertices of triangles. What is a triangle stays as it is; convex quadrangles are cut
    in two."""
    threes = np.array(rings.threes, dtype=np.int64).reshape(-1, 3)
    fours = np.array(rings.fours, dtype=np.int64).reshape(-1, 4)
    corners = vertices[fours]
    edges = corners[:, [1, 2, 3, 0]] - corners
    normals = _cross(edges[:, [3, 0, 1, 2]], edges)
    convex = ((normals * normals.sum(axis=1, keepdims=True)).sum(axis=2) > 0).all(axis=1)
    found = [threes, fours[convex][:, [0, 1, 2]], fours[convex][:, [0, 2, 3]]]
    for boundary in [*rings.others, *([ring] for ring in fours[~convex].tolist())]:
        index = np.array([i for ring in boundary for i in ring], dtype=np.int64)
        found.append(index[triangulate_planar([vertices[ring] for ring in boundary])])
    return np.concatenate(found)


def _faces(
    geometry: _Surfaced, vertices: NDArray[np.float64], city: settings.City, kind: str, what: str
) -> tuple[dict[str, NDArray[np.int64]], NDArray[np.int64]]:
    """Triangles by material, and the vertices of what the file calls ground."""
    semantics = geometry.semantics or _Semantics()
    kinds = [None if surface is None else surface.type for surface in semantics.surfaces]
    materials = [_material(city, of, kind) for of in kinds]
    plain = _material(city, None, kind)
    rings: dict[str, _Rings] = {}
    foot, highest = set[int](), -1
    for boundary, value in _flat(geometry.boundaries, semantics.values, geometry.depth):
        index = None if value is None or not 0 <= value < len(kinds) else value
        material = plain if index is None else materials[index]
        group = rings.setdefault(material, _Rings([], [], []))
        if index is not None and kinds[index] == "GroundSurface":
            foot.update(*boundary)
        highest = max([highest, *(max(ring, default=-1) for ring in boundary)])
        if len(boundary) == 1 and len(boundary[0]) in (3, 4):
            (group.threes if len(boundary[0]) == 3 else group.fours).append(boundary[0])
        elif boundary and len(boundary[0]) >= 3:
            check_corners(sum(map(len, boundary)), what)
            group.others.append([ring for ring in boundary if len(ring) >= 3])
    if highest >= len(vertices):
        raise CityError(
            f"{what}: a boundary names vertex {highest} of {len(vertices)}; check the file with a "
            "CityJSON validator"
        )
    return {m: _triangles(of, vertices) for m, of in rings.items()}, np.array(sorted(foot), int)


def _footprint(
    geometry: _Surfaced, vertices: NDArray[np.float64], what: str
) -> tuple[shapely.Geometry, float] | None:
    """The plan and the lowest height of surfaces, if they have any."""
    found = [b for b, _ in _flat(geometry.boundaries, None, geometry.depth) if b]
    highest = max((max(ring, default=0) for b in found for ring in b), default=0)
    if highest >= len(vertices):
        raise CityError(
            f"{what}: a boundary names vertex {highest} of {len(vertices)}; check the file with a "
            "CityJSON validator"
        )
    corners = [[vertices[ring] for ring in b if len(ring) >= 3] for b in found]
    rings = [c for c in corners if c]
    if not rings:
        return None
    polygons = [shapely.Polygon(r[0][:, :2], [c[:, :2] for c in r[1:]]) for r in rings]
    return shapely.MultiPolygon(polygons), min(float(c[:, 2].min()) for r in rings for c in r)


class _Reader:
    """Reads objects of one list of vertices."""

    def __init__(self, document: CityJson, city: settings.City, name: str) -> None:
        self.city, self.name = city, name
        self.header = document
        self.model = CityModel()
        self.counted = Counter[tuple[str, str]]()
        self.left, self.bad, self.good = Counter[str](), list[str](), 0
        templates = document.templates
        self.template_vertices = np.array(
            [] if templates is None else templates.vertices, dtype=np.float64
        ).reshape(-1, 3)

    def placed(self, numbers: list[_Triple]) -> NDArray[np.float64]:
        """Vertices of the file in its coordinates."""
        vertices = np.array(numbers, dtype=np.float64).reshape(-1, 3)
        transform = self.header.transform
        if transform is not None:
            vertices = vertices * transform.scale + transform.translate
        check_coordinates(vertices, f"{self.name}: vertices")
        return vertices

    def objects(self, objects: Mapping[str, _Object], vertices: NDArray[np.float64]) -> None:
        """Take in objects."""
        chosen = {key: self._chosen(item) for key, item in objects.items()}
        detailed = {key for key, g in chosen.items() if g is not None and _has_faces(g)}
        for key, item in objects.items():
            geometry = chosen[key]
            if geometry is None:
                continue
            try:
                self._take(key, item, geometry, objects, vertices, detailed)
                self.good += 1
            except CityError as problem:
                self.bad.append(str(problem))

    def _chosen(self, item: _Object) -> _Surfaced | _Instance | None:
        """The geometry of the highest level that is wanted."""
        usable = [g for g in item.geometry if not isinstance(g, _NoSurface)]
        self.left["geometries that are no surfaces"] += len(item.geometry) - len(usable)
        if usable and str(item.type) in _INSIDE:
            self.left[f"{item.type} inside of buildings"] += 1
            return None
        wanted = [g for g in usable if self.city.lod is None or g.lod <= self.city.lod]
        if wanted:
            return max(wanted, key=lambda geometry: geometry.lod)
        return min(usable, key=lambda geometry: geometry.lod) if usable else None

    def _take(
        self,
        key: str,
        item: _Object,
        geometry: _Surfaced | _Instance,
        objects: Mapping[str, _Object],
        vertices: NDArray[np.float64],
        detailed: set[str],
    ) -> None:
        what, kind = f"{self.name}: object {key}", str(item.type)
        if _has_faces(geometry) or kind in _FLAT_TYPES:
            root = _root(key, objects)
            solid = self._solid(what, kind, root, geometry, vertices)
            if not len(solid.vertices):
                raise CityError(f"{what}: has no surface; correct or remove it")
            self.model.solids.append(solid)
            if kind not in BUILDING_TYPES:
                self.counted[kind, next(iter(solid.faces))] += 1
        elif not detailed.intersection(item.children) and not isinstance(geometry, _Instance):
            try:
                height = _height(item.attributes or {}, self.city.height_property)
            except ValueError as problem:
                raise CityError(f"{what}: {problem}; correct it") from None
            plan = _footprint(geometry, vertices, what)
            if plan is not None:
                self.model.outlines.append(Outline(plan[0], what, height or None, foot=plan[1]))

    def _solid(
        self,
        what: str,
        kind: str,
        root: str,
        geometry: _Surfaced | _Instance,
        vertices: NDArray[np.float64],
    ) -> Solid:
        if isinstance(geometry, _Instance):
            geometry, vertices = self._instance(geometry, vertices, what)
        faces, ground = _faces(geometry, vertices, self.city, kind, what)
        used, index = np.unique(np.concatenate([*faces.values(), _NO_FACE]), return_inverse=True)
        cuts = np.cumsum([len(f) for f in faces.values()])
        parts = np.split(index.reshape(-1, 3), cuts)[:-1]
        own = vertices[used]
        foot = np.searchsorted(used, ground[np.isin(ground, used)])
        if not foot.size and len(own):
            foot = np.flatnonzero(own[:, 2] <= own[:, 2].min() + FOOT_M)
        return Solid(what, kind, root, own, dict(zip(faces, parts, strict=True)), foot)

    def _instance(
        self, instance: _Instance, vertices: NDArray[np.float64], what: str
    ) -> tuple[_Surfaced, NDArray[np.float64]]:
        """The geometry of a template, and its vertices where it stands."""
        templates = () if self.header.templates is None else self.header.templates.templates
        if instance.template >= len(templates) or instance.boundaries[0] >= len(vertices):
            raise CityError(f"{what}: names a template or a vertex that the file lacks; correct it")
        template = templates[instance.template]
        if isinstance(template, _NoSurface | _Instance):
            raise CityError(f"{what}: its template has no surfaces; correct it")
        matrix = np.array(instance.transformationMatrix).reshape(4, 4)
        placed = self.template_vertices @ matrix[:3, :3].T + matrix[:3, 3]
        placed = placed + vertices[instance.boundaries[0]]
        check_coordinates(placed, what)
        return template, placed

    def tell(self, notes: list[str]) -> None:
        """Say what was left out, and what is no building with its material."""
        if len(self.bad) > self.good:
            raise CityError(self.bad[0])
        if self.bad:
            notes.append(
                f"{len(self.bad)} of {len(self.bad) + self.good} objects left out; the first: "
                f"{self.bad[0]}"
            )
        notes += [f"{n} CityJSON {what} left out" for what, n in self.left.items() if n]
        others = [f"{n} {kind}: {of}" for (kind, of), n in self.counted.most_common()]
        if others:
            notes.append(f"no buildings, with their materials: {', '.join(others)}")


def _height(attributes: Mapping[str, Any], key: str) -> float | None:
    """Return a building's stated height [m]: under `key`, as CityGML's `measuredHeight`, or as the
    3D BAG's heights of roof and ground over the sea; None if it states none.

    Raises
    ------
    ValueError  If it is no height.
    """
    stated = attributes.get(key, attributes.get("measuredHeight"))
    return roof_over_ground(attributes) if stated is None else parse_length(stated)


_NO_FACE = np.zeros((0, 3), dtype=np.int64)


def _root(key: str, objects: Mapping[str, _Object]) -> str:
    """The building that an object is a part of, or itself."""
    for _ in range(_GENERATIONS):
        parents = objects[key].parents if key in objects else ()
        if not parents:
            break
        key = parents[0]
    return key


_GENERATIONS = 8


def _has_faces(geometry: _Surfaced | _Instance) -> bool:
    return isinstance(geometry, _Instance) or geometry.lod >= 1


def read_cityjson(data: bytes, city: settings.City, name: str, notes: list[str]) -> CityModel:
    """The surfaces and footprints of a CityJSON file.

    Parameters
    ----------
    data : bytes
        CityJSON, or CityJSONSeq: a first line with CityJSON, then one CityJSONFeature a line.
    city : settings.City
        Materials, the level of detail, and the attribute with heights; `measuredHeight` is looked
        for besides it.
    name : str
        For messages.
    notes : list of str
        Grows.
    """
    first, *rest = data.strip().split(b"\n") if is_sequence(data) else [data]
    document, bad = _document(first, name)
    reader = _Reader(document, city, name)
    reader.bad += bad
    reader.objects(document.CityObjects, reader.placed(document.vertices))
    for number, line in enumerate(rest, start=2):
        if line.strip():
            try:
                sequel = parsed(line, _Sequel, f"{name}: line {number}", _CHECK)
                reader.objects(sequel.CityObjects, reader.placed(sequel.vertices))
            except CityError as problem:
                reader.bad.append(str(problem))
        if len(reader.bad) > 100 + reader.good:
            break
    reader.tell(notes)
    metadata = document.metadata
    reader.model.crs = (metadata and metadata.referenceSystem) or ""
    return reader.model


_CHECK = "check the file with a CityJSON validator"


def is_sequence(data: bytes) -> bool:
    """Return whether a file is CityJSONSeq."""
    return b'"CityJSONFeature"' in data


def _document(data: bytes, name: str) -> tuple[CityJson, list[str]]:
    """A CityJSON file, and what is wrong with the objects that are left out of it."""
    try:
        return parsed(data, CityJson, name, _CHECK), []
    except CityError:
        loose = parsed(data, _Any, name, _CHECK)
        bad = []
        good: dict[str, _Object] = {}
        for key, item in loose.CityObjects.items():
            try:
                good[key] = parsed(to_json(item), _Object, f"{name}: object {key}", _CHECK)
            except CityError as problem:
                bad.append(str(problem))
            if len(bad) > 100 + len(good):
                break
        if not good or not bad:
            raise
        tree = from_json(data.removeprefix(b"\xef\xbb\xbf")) | {"CityObjects": {}}
        document = parsed(to_json(tree), CityJson, name, _CHECK)
        return document.model_copy(update={"CityObjects": good}), bad
