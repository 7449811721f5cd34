"""PLY, OBJ, STL, glTF and GLB files. What colours and textures need is not read."""

from __future__ import annotations

import base64
import logging
import re
import warnings
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from pydantic_core import from_json

from isac_rt.world import settings
from isac_rt.world.city.files import beside, read_bytes
from isac_rt.world.city.georeference import GeoReference
from isac_rt.world.city.materials import CityError, MaterialUse, canonical_name, material_within
from isac_rt.world.city.mesh import MAX_FACES, Surface, gathered

logging.getLogger("trimesh").addHandler(logging.NullHandler())  # else it prints tracebacks
_MAX_PROPERTIES = 200
"""Of a PLY file: trimesh takes a time that grows with their square."""
_PLAIN_PLY = re.compile(
    rb"ply\nformat binary_little_endian 1.0\nelement vertex ([1-9]\d{0,8})\n"
    rb"property float x\nproperty float y\nproperty float z\n((?:property float (?![xyz]\n)\w+\n)*)"
    rb"element face ([1-9]\d{0,8})\nproperty list uchar int vertex_ind(?:ices|ex)\nend_header\n"
)
"""The header of a mesh of places, with more numbers of each at most (of textures, colours), and
faces, as of Sionna's thousands of buildings."""
_PLAIN_FACE = np.dtype([("count", "u1"), ("corners", "<i4", 3)])
_NAMED = 20
"""Most names that a message lists."""
_SOLID = re.compile(r"^[ \t]*solid\b", re.MULTILINE | re.IGNORECASE)
_VERTEX = re.compile(r"vertex\s+(\S+)\s+(\S+)\s+(\S+)", re.IGNORECASE)
Y_UP = (".glb", ".gltf")
"""Formats whose standard has y up."""
Y_UP_TO_Z_UP = np.array([[1.0, 0, 0], [0, 0, -1.0], [0, 1.0, 0]])


@dataclass(frozen=True)
class Piece:
    """A part of a mesh: vertices (V, 3), triangles (F, 3), and the names by which it may be called,
    the material's last."""

    vertices: NDArray[np.float64]
    faces: NDArray[np.int64]
    labels: tuple[str, ...]


def _used(
    vertices: NDArray, faces: NDArray[np.int64], labels: tuple[str | None, ...], name: str
) -> Piece:
    """The piece with the vertices that its faces use."""
    if faces.size and not 0 <= faces.min() <= faces.max() < len(vertices):
        raise CityError(
            f"{name}: a face names vertex {faces.max()} of {len(vertices)}; repair the file"
        )
    used, faces = np.unique(faces, return_inverse=True)
    corners = vertices[used].astype(np.float64).reshape(-1, 3)
    return Piece(corners, faces.reshape(-1, 3), tuple(str(label) for label in labels if label))


def _plain_triangles(data: bytes) -> tuple[NDArray, NDArray] | None:
    """Vertices and faces of a binary PLY file that holds places and triangles; None of any other,
    however near to it."""
    header = _PLAIN_PLY.match(data)
    if header is None:
        return None
    points, count, numbers = int(header[1]), int(header[3]), 3 + header[2].count(b"\n")
    first = header.end() + 4 * numbers * points
    if len(data) != first + _PLAIN_FACE.itemsize * count:
        return None
    vertices = np.frombuffer(data, "<f4", numbers * points, header.end()).reshape(-1, numbers)[
        :, :3
    ]
    faces = np.frombuffer(data, _PLAIN_FACE, count, first)
    return (vertices, faces["corners"]) if (faces["count"] == 3).all() else None


def _polygons(path: Path) -> Iterator[Piece]:
    """PLY: plain triangles are read here, of all else trimesh takes the numbers."""
    data = read_bytes(path)
    plain = _plain_triangles(data)
    if plain is not None:
        vertices, faces = plain
        yield Piece(vertices.astype(np.float64), faces.astype(np.int64), (path.name,))
        return
    from trimesh.exchange.ply import load_ply
    from trimesh.geometry import triangulate_quads

    if data.count(b"property", 0, data.find(b"end_header")) > _MAX_PROPERTIES:
        raise ValueError(f"more than {_MAX_PROPERTIES} properties")
    with warnings.catch_warnings():
        warnings.filterwarnings("error", "string or file could not be read to its end")
        found = load_ply(BytesIO(data), skip_materials=True)
    for kind, element in found["metadata"]["_ply_raw"].items():
        data = element.get("data", ())
        rows = len(next(iter(data.values()), ()) if isinstance(data, dict) else data)
        if rows != element["length"]:
            raise ValueError(f"{rows} of {element['length']} rows of {kind}")
    vertices = np.asarray(found.get("vertices", ()), dtype=np.float64).reshape(-1, 3)
    faces = triangulate_quads(found.get("faces", ())).astype(np.int64).reshape(-1, 3)
    yield Piece(vertices, faces, (path.name,))


def _solids(path: Path) -> Iterator[Piece]:
    """STL: binary, or text with a piece for each solid."""
    data = read_bytes(path)
    if len(data) == 84 + 50 * int.from_bytes(data[80:84], "little"):
        facets = np.frombuffer(
            data, np.dtype([("", "<f4", 3), ("corners", "<f4", (3, 3)), ("", "<u2")]), offset=84
        )
        solids: list[tuple[str, ArrayLike]] = [(path.name, facets["corners"])]
    else:
        named = (block.partition("\n") for block in _SOLID.split(data.decode(errors="replace"))[1:])
        solids = [(name.strip(), _VERTEX.findall(facets)) for name, _, facets in named]
    for name, corners in solids:
        vertices = np.array(corners, dtype=np.float64).reshape(-1, 3)
        yield Piece(vertices, np.arange(len(vertices)).reshape(-1, 3), (name or path.name,))


def _wavefront(path: Path) -> Iterator[Piece]:
    """OBJ: one piece for each material, or for each object where there is none."""
    text = read_bytes(path).decode(errors="replace").replace("\\\n", " ")
    vertices: list[list[float]] = []
    groups: dict[str, list[list[int]]] = {}
    thing, material = path.name, ""
    for number, line in enumerate(text.splitlines(), start=1):
        kind, _, rest = line.strip().replace("\t", " ").partition(" ")
        if kind == "usemtl":
            material = rest.strip()
        elif kind in ("o", "g"):
            thing = rest.strip()
        elif kind in ("v", "f"):
            try:
                if kind == "v":
                    x, y, z = rest.split()[:3]
                    vertices.append([float(x), float(y), float(z)])
                    continue
                words = rest.partition("#")[0].split()
                corners = [int(word.partition("/")[0]) for word in words]
            except ValueError as error:
                raise CityError(f"{path.name}: line {number}: {error}; export it again") from None
            corners = [n - 1 if n > 0 else len(vertices) + n for n in corners]
            triangles = groups.setdefault(material or thing, [])
            triangles += [corners[:3]] if len(corners) > 2 else []
            triangles += [
                [corners[i], corners[i + 1], corners[0]] for i in range(2, len(corners) - 1)
            ]
    points = np.array(vertices, dtype=np.float64).reshape(-1, 3)
    for name, triangles in reversed(groups.items()):
        labels = (name,) if len(groups) > 1 else (thing, name)
        yield _used(points, np.array(triangles, dtype=np.int64).reshape(-1, 3), labels, path.name)


_DTYPES = {5120: "<i1", 5121: "<u1", 5122: "<i2", 5123: "<u2", 5125: "<u4", 5126: "<f4"}
_TRIANGLES, _STRIP, _FAN = 4, 5, 6


def _gltf(path: Path) -> tuple[dict[str, Any], bytes]:
    """The description and the binary chunk of a glTF or GLB file."""
    data = read_bytes(path)
    chunks, at = [data], 12
    if data.startswith(b"glTF"):
        chunks = []
        while at + 8 <= len(data) and len(chunks) < 2:
            end = at + 8 + int.from_bytes(data[at : at + 4], "little")
            chunks.append(data[at + 8 : end])
            at = end
    text, binary, *_ = *chunks, b"", b""
    return from_json(text, allow_inf_nan=False), binary


def _buffer_file(path: Path, buffer: dict[str, Any]) -> Path | None:
    """Where a buffer lies, if in a file of its own."""
    uri = buffer.get("uri", "data:")
    return None if uri.startswith("data:") else beside(path, uri, "a buffer")


class _Numbers:
    """The numbers of a glTF file's accessors; each file is read once."""

    def __init__(self, path: Path, tree: dict[str, Any], binary: bytes) -> None:
        self._path, self._tree = path, tree
        self._read: dict[Path | str | None, bytes] = {None: binary}

    def _bytes(self, buffer: dict[str, Any]) -> bytes:
        file = _buffer_file(self._path, buffer)
        key = file or buffer.get("uri")
        if key not in self._read:
            encoded = buffer["uri"].partition("base64,")[2]
            self._read[key] = base64.b64decode(encoded) if file is None else read_bytes(file)
        return self._read[key]

    def rows(self, index: int, kind: str) -> NDArray:
        """(count, 1 or 3) numbers of an accessor of kind SCALAR or VEC3."""
        accessor, width = self._tree["accessors"][index], {"SCALAR": 1, "VEC3": 3}[kind]
        count, start = accessor["count"], accessor.get("byteOffset", 0)
        if "bufferView" not in accessor or accessor["type"] != kind or accessor.get("normalized"):
            raise ValueError(f"accessor {index} is compressed, sparse, normalized or no {kind}")
        view = self._tree["bufferViews"][accessor["bufferView"]]
        data = memoryview(self._bytes(self._tree["buffers"][view["buffer"]]))
        data = data[view.get("byteOffset", 0) :][: view["byteLength"]][start:]
        dtype = np.dtype(_DTYPES[accessor["componentType"]])
        stride = view.get("byteStride", width * dtype.itemsize)
        last = (count - 1) * stride + width * dtype.itemsize
        if not (0 <= count <= 3 * MAX_FACES and 0 < stride and (not count or last <= len(data))):
            raise ValueError(f"accessor {index} with {count} rows ends behind its data")
        return np.ndarray((count, width), dtype, data, 0, (stride, dtype.itemsize))


def _triangles(corners: NDArray, mode: int) -> NDArray[np.int64]:
    """(F, 3) triangles of a primitive's corners."""
    corners = corners.astype(np.int64).reshape(-1)
    if mode == _TRIANGLES:
        return corners[: len(corners) // 3 * 3].reshape(-1, 3)
    i = np.arange(max(len(corners) - 2, 0))
    if mode == _STRIP:
        return corners[np.column_stack([i, i + 1 + i % 2, i + 2 - i % 2])]
    return corners[np.column_stack([0 * i, i + 1, i + 2])]


def _to_parent(node: dict[str, Any]) -> NDArray[np.float64]:
    """(4, 4) from a node to its parent."""
    from trimesh.transformations import quaternion_matrix, translation_matrix

    if "matrix" in node:
        return np.array(node["matrix"], dtype=np.float64).reshape(4, 4).T
    x, y, z, w = node.get("rotation", (0.0, 0.0, 0.0, 1.0))
    turned = translation_matrix(node.get("translation", (0, 0, 0))) @ quaternion_matrix(
        [w, x, y, z]
    )
    return turned @ np.diag([*node.get("scale", (1.0, 1.0, 1.0)), 1.0])


def _scene(path: Path) -> Iterator[Piece]:
    """glTF and GLB: every primitive of every node, in world coordinates."""
    tree, binary = _gltf(path)
    numbers = _Numbers(path, tree, binary)
    roots = tree["scenes"][tree.get("scene", 0)].get("nodes", [])
    left, seen = [(np.eye(4), root) for root in roots], set[int]()
    while left:
        above, number = left.pop()
        if number in seen:
            raise ValueError(f"node {number} hangs from two nodes")
        seen.add(number)
        node = tree["nodes"][number]
        to_world = above @ _to_parent(node)
        left += [(to_world, child) for child in node.get("children", [])]
        mesh = tree["meshes"][node["mesh"]] if "mesh" in node else {"primitives": []}
        for primitive in mesh["primitives"]:
            mode = primitive.get("mode", _TRIANGLES)
            if mode not in (_TRIANGLES, _STRIP, _FAN):
                continue  # points and lines
            points = numbers.rows(primitive["attributes"]["POSITION"], "VEC3")
            indexed = "indices" in primitive
            corners = (
                numbers.rows(primitive["indices"], "SCALAR") if indexed else np.arange(len(points))
            )
            of = tree["materials"][primitive["material"]] if "material" in primitive else {}
            labels = (node.get("name", str(number)), mesh.get("name"), of.get("name"))
            faces = _triangles(corners, mode)
            piece = _used(points, faces, labels, path.name)
            yield replace(piece, vertices=piece.vertices @ to_world[:3, :3].T + to_world[:3, 3])


_READERS: dict[str, Callable[[Path], Iterator[Piece]]] = {
    ".ply": _polygons,
    ".obj": _wavefront,
    ".stl": _solids,
    ".glb": _scene,
    ".gltf": _scene,
}
MESHES = tuple(_READERS)
"""Endings of mesh files."""


@contextmanager
def _readable(path: Path) -> Iterator[None]:
    """Whatever a parser raises becomes one message."""
    try:
        yield
    except CityError:
        raise
    except Exception as error:
        raise CityError(
            f"{path.name}: not readable as a mesh ({type(error).__name__}: {error}); export it "
            "again"
        ) from None


def pieces(path: Path, formats: tuple[str, ...] = MESHES) -> Iterator[Piece]:
    """The pieces of a mesh file; larger faces become triangles."""
    if path.suffix.lower() not in formats:
        raise CityError(
            f"{path.name}: {path.suffix!r} is not a mesh format known here; use one of "
            f"{', '.join(formats)}"
        )
    with _readable(path):
        yield from _READERS[path.suffix.lower()](path)


def mesh_files(path: Path) -> list[Path]:
    """A mesh file and those that it is read from."""
    if path.suffix.lower() not in Y_UP:
        return [path]
    with _readable(path):
        named = [_buffer_file(path, buffer) for buffer in _gltf(path)[0].get("buffers", [])]
    return list(dict.fromkeys([path, *(file for file in named if file is not None)]))


def _use(
    labels: tuple[str, ...], city: settings.City, file: str, guessed: Counter[str]
) -> MaterialUse | None:
    """The material of a piece; None if no name of it says, which that of the file is not. Names
    that only hold one of a material are counted."""
    for label in labels:
        if label in city.material_map:
            return MaterialUse(city.material_map[label])
    own = [label for label in reversed(labels) if label != file]
    for label in own:
        if (name := canonical_name(label)) is not None:
            return MaterialUse(name)
    for label in own:
        if (name := material_within(label)) is not None:
            guessed[f"{label[:60]} as {name}"] += 1
            return MaterialUse(name)
    return None


def _listed(names: Counter[str], unit: str) -> str:
    """Names with their counts, the most frequent first."""
    listed = [f"{name[:80]} ({count} {unit})" for name, count in names.most_common(_NAMED)]
    rest = f" and {len(names) - _NAMED} more" if len(names) > _NAMED else ""
    return f"{', '.join(listed)}{rest}; city.material_map says what they are"


def _is_y_up(city: settings.City, path: Path) -> bool:
    return city.up_axis == "y" or (city.up_axis == "auto" and path.suffix.lower() in Y_UP)


def mesh_georeference(city: settings.City, path: Path) -> GeoReference | None:
    """Return the relation of a mesh file to the world; None where it is no plain shift."""
    plain = city.origin is not None and city.scale == 1 and not _is_y_up(city, path)
    return GeoReference("", city.origin) if plain and city.origin else None


def point_in_file(
    city: settings.City, path: Path, point: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return a world point (3,) [m] in the coordinates and units of a mesh file."""
    turned = point @ Y_UP_TO_Z_UP if _is_y_up(city, path) else point
    return turned / city.scale + (city.origin or 0.0)


def mesh_file(
    city: settings.City, path: Path
) -> tuple[list[Surface], list[str], GeoReference | None, bool]:
    """The surfaces of a mesh file in world coordinates: node transforms applied, then taken from
    `city.origin`, scaled, and turned z-up; with notes, the place of the origin, and whether z is up
    by assumption.

    A piece's material is what `material_map` says of its node, geometry or material name, else a
    known material of that name, else `material`."""
    seen, notes, unknown, guessed = set[str](), list[str](), Counter[str](), Counter[str]()
    gltf, origin = path.suffix.lower() in Y_UP, city.origin or (0.0, 0.0, 0.0)
    y_up = _is_y_up(city, path)

    def surfaces() -> Iterator[Surface]:
        for piece in pieces(path):
            if not len(piece.faces):
                notes.append(f"{piece.labels[0]}: no triangles, left out")
                continue
            vertices = (piece.vertices - origin) * city.scale
            if y_up:
                vertices = vertices @ Y_UP_TO_Z_UP.T
            seen.update(piece.labels)
            use = _use(piece.labels, city, path.name, guessed)
            if use is None:
                unknown[piece.labels[-1] if piece.labels else "no name"] += len(piece.faces)
            yield Surface(vertices, piece.faces, use or MaterialUse(city.material))

    found = gathered(surfaces(), path.name)
    if not found:
        raise CityError(f"{path.name}: there is no triangle in it; export a mesh")
    unused = sorted(set(city.material_map) - seen)
    if unused:
        raise CityError(
            f"{path.name}: city.material_map names {', '.join(unused)}, which the file lacks; "
            f"it has {', '.join(sorted(seen)) or 'no names'}"
        )
    if unknown:
        text = f"names that are no known material became {city.material}"
        notes.append(f"{text}: {_listed(unknown, 'faces')}")
    if guessed:
        text = "names that hold that of a known material are taken for it"
        notes.append(f"{text}: {_listed(guessed, 'pieces')}")
    if gltf and not y_up:
        notes.append("glTF is y-up by its standard, and city.up_axis is z")
    return found, notes, mesh_georeference(city, path), city.up_axis == "auto" and not gltf
