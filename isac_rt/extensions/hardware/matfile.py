"""Numeric arrays and structs of numeric arrays in MATLAB files: version 5, and version 7.3 by h5py.

Only what holds numbers is read. Every size is checked before anything is made of it, so that a
file cannot ask for more memory than `MOST_BYTES`, and nothing in it is ever run.
`scipy.io.loadmat` (1.17) is not used: it unfolds compressed variables without a limit, and an
unknown type of number ends the process (a segmentation fault).
"""

from __future__ import annotations

import io
import math
import struct
import zlib
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from isac_rt.extensions.hardware.types import CaptureError
from isac_rt.runtime import shortly
from isac_rt.storage import BAD_DATA, check_heaps, check_unfolded, read_whole

Tree = dict[str, Any]
"""Names to arrays, and to the arrays of a struct by name."""

MOST_BYTES = 1024**3
HEADER = 128
_TYPES = {
    1: "i1",
    2: "u1",
    3: "i2",
    4: "u2",
    5: "i4",
    6: "u4",
    7: "f4",
    9: "f8",
    12: "i8",
    13: "u8",
}
"""Numpy's names of the types that elements are stored in."""
_MATRIX, _COMPRESSED = 14, 15
_STRUCT, _NUMERIC = 2, range(6, 16)
_COMPLEX = 0x0800
_HDF5 = b"\x89HDF\r\n\x1a\n"


class _Element(NamedTuple):
    kind: int
    data: memoryview
    end: int


def read_mat(file: Path) -> Tree:
    """The numeric variables of a MATLAB file; anything else in it is passed over.

    Raises
    ------
    CaptureError  If it is none, or bent, or larger than `MOST_BYTES` when unfolded.
    """
    try:
        content = read_whole(file, MOST_BYTES)
    except OSError as problem:
        raise CaptureError(f"{file}: cannot be read: {problem.strerror}; check the path") from None
    try:
        if content[:8] == _HDF5 or content[512:520] == _HDF5:
            return _read_hdf5(content)
        return _Reader(content).tree()
    except (OSError, MemoryError, struct.error, zlib.error, *BAD_DATA) as problem:
        raise CaptureError(
            f"{file}: is no MATLAB file of version 5 or 7.3 that can be read ({shortly(problem)}); "
            "save the variables again with save -v7"
        ) from None


class _Reader:
    """A file of version 5."""

    def __init__(self, content: bytes) -> None:
        mark = content[126:128]
        if len(content) < HEADER or mark not in (b"IM", b"MI"):
            raise ValueError("it does not begin like one")
        self._order = "<" if mark == b"IM" else ">"
        self._content = memoryview(content)
        self._left = MOST_BYTES

    def tree(self) -> Tree:
        found: Tree = {}
        at = HEADER
        while at + 8 <= len(self._content):
            element = self._element(self._content, at)
            at = element.end
            if element.kind == _COMPRESSED:
                element = self._element(memoryview(self._unfolded(element.data)), 0)
            if element.kind == _MATRIX:
                name, value = self._matrix(element.data, depth=0)
                if value is not None:
                    found[name] = value
        return found

    def _unfolded(self, data: memoryview) -> bytes:
        worker = zlib.decompressobj()
        out = worker.decompress(data, self._left + 1)  # zlib takes 0 for no limit
        self._left -= len(out)
        if self._left < 0:
            raise ValueError(f"it unfolds to more than {MOST_BYTES} bytes")
        return out

    def _element(self, data: memoryview, at: int) -> _Element:
        """The element at a place: eight bytes of tag and its data, or both in eight bytes."""
        (first,) = struct.unpack_from(self._order + "I", data, at)
        if first >> 16:
            kind, size, begin, end = first & 0xFFFF, first >> 16, at + 4, at + 8
            if size > 4:
                raise ValueError(f"a small element of {size} bytes")
        else:
            (size,) = struct.unpack_from(self._order + "I", data, at + 4)
            kind, begin = first, at + 8
            end = begin + size + (-size % 8 if kind != _COMPRESSED else 0)
        if begin + size > len(data):
            raise ValueError(f"an element of {size} bytes where {len(data) - begin} are left")
        return _Element(kind, data[begin : begin + size], end)

    def _numbers(self, element: _Element) -> np.ndarray:
        if element.kind not in _TYPES:
            raise ValueError(f"numbers of type {element.kind}")
        return np.frombuffer(element.data, self._order + _TYPES[element.kind])

    def _matrix(self, data: memoryview, depth: int) -> tuple[str, Any]:
        """Name and value of an array or a struct of one element; None for what is no number."""
        if not data:
            return "", None
        flags = self._element(data, 0)
        shape = self._element(data, flags.end)
        label = self._element(data, shape.end)
        flag = int(self._numbers(flags)[0])
        dimensions = tuple(self._numbers(shape).astype(np.int64).tolist())
        name = bytes(label.data).decode("latin1")
        kind = flag & 0xFF
        if kind == _STRUCT and depth == 0 and dimensions == (1, 1):
            return name, self._fields(data, label.end)
        if kind not in _NUMERIC:
            return name, None
        real = self._element(data, label.end)
        values = self._shaped(real, dimensions)
        if flag & _COMPLEX:
            values = values + 1j * self._shaped(self._element(data, real.end), dimensions)
        return name, values

    def _fields(self, data: memoryview, at: int) -> Tree:
        length = self._element(data, at)
        names = self._element(data, length.end)
        width = int(self._numbers(length)[0])
        if not 0 < width <= 64:
            raise ValueError(f"names of {width} characters")
        packed, offset = bytes(names.data), names.end
        found: Tree = {}
        for begin in range(0, len(packed) - width + 1, width):
            name = packed[begin : begin + width].split(b"\0")[0].decode("latin1")
            element = self._element(data, offset)
            offset = element.end
            value = self._matrix(element.data, depth=1)[1]
            if value is not None:
                found[name] = value
        return found

    def _shaped(self, element: _Element, shape: tuple[int, ...]) -> np.ndarray:
        flat = self._numbers(element)
        if min(shape, default=0) < 0 or math.prod(shape) != flat.size:
            raise ValueError(f"{flat.size} numbers for an array of {shape}")
        self._left -= 16 * flat.size
        if self._left < 0:
            raise ValueError(f"it unfolds to more than {MOST_BYTES} bytes")
        wide = flat.astype(np.float64 if flat.dtype.kind == "f" else flat.dtype.newbyteorder("="))
        return wide.reshape(shape, order="F")


def _read_hdf5(content: bytes) -> Tree:
    """A file of version 7.3, in which arrays lie transposed."""
    import h5py

    left = MOST_BYTES

    def numbers(group: Any, name: str) -> np.ndarray | None:
        nonlocal left
        if not isinstance(group.get(name, getlink=True), h5py.HardLink):
            return None  # links may lead to other files
        node = group[name]
        if not isinstance(node, h5py.Dataset) or node.is_virtual or node.external:
            return None
        parts = node.dtype.names == ("real", "imag")
        if not parts and node.dtype.kind not in "iuf":
            return None
        left -= node.size * max(node.dtype.itemsize, 8)
        if left < 0:
            raise ValueError(f"it unfolds to more than {MOST_BYTES} bytes")
        value = node[()]
        return np.asarray(value["real"] + 1j * value["imag"] if parts else value).T

    found: Tree = {}
    check_heaps(content)
    with h5py.File(io.BytesIO(content), "r") as opened:
        check_unfolded(opened, len(content), MOST_BYTES, refuse_links=False)
        for name in opened:
            if isinstance(opened.get(name, getlink=True), h5py.HardLink) and isinstance(
                opened[name], h5py.Group
            ):
                group = opened[name]
                inner = {key: numbers(group, key) for key in group if not key.startswith("#")}
                found[name] = {key: value for key, value in inner.items() if value is not None}
            elif (value := numbers(opened, name)) is not None:
                found[name] = value
    return found
