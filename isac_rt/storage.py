"""Files that appear whole or not at all, and data that say whether they are the ones asked for.

A file is written beside its place, synced, and renamed. Its temporary name is locked while a
process writes it, so that what a killed one left behind is known by its open lock, whatever machine
or container looks, and is taken away with the next file that is written there.

Data are a tree of words, numbers, lists and mappings as JSON and the bytes of its arrays: reading
them runs no code. In a file they carry the key under which they are kept and a checksum.

What takes long to prepare is kept in a folder of the user's (`cached`), under a digest of all that
it depends on, this program included. A file that is bent, cut off or another's is made anew.
"""

from __future__ import annotations

import errno
import fcntl
import grp
import hashlib
import importlib.metadata
import json
import math
import mmap
import os
import platform
import pwd
import re
import secrets
import stat
import struct
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any, BinaryIO, Literal

import numpy as np

from isac_rt.runtime import MachineProblem

ARRAY = "array"
"""Key of a mapping that stands for an array: its type, shape and order (C, F), and where its
bytes begin."""
BAD_DATA = (ArithmeticError, AttributeError, LookupError, RuntimeError, TypeError, ValueError)
"""What reading data can raise that this package did not write."""
MOST_BYTES = 4 * 1024**3
"""No file of data is larger than this."""
HDF5_PACKING = 1100
"""Bytes that one byte of an HDF5 file can stand for: deflate makes 1032 of one."""
MAX_HDF5_PIECE = 2**24
"""A piece (chunk) that is larger than its dataset has at most so many bytes."""
_HEAP = b"GCOL\x01\0\0\0"  # signature and version of a global heap
MAX_HDF5_DEPTH = 8
MOST_JSON_BYTES = 16 * 1024**2
"""No file of JSON is larger: nothing but empty lists takes 53 times its size."""
CACHE_VARIABLE = "ISAC_RT_KEPT"
"""Variable of the environment: folder of what is `cached`; empty: nothing is."""
CACHE_BYTES = 1024**3
LOW_WATER = 0.8
"""When the limit is passed a folder is brought down to this share of it, so that not every write
has to look."""
PACKAGES = (
    "isac_rt",
    "numpy",
    "scipy",
    "numba",
    "llvmlite",
    "drjit",
    "mitsuba",
    "sionna-rt",
    "trimesh",
    "shapely",
    "pyproj",
    "mapbox_earcut",
    "xarray",
    "h5netcdf",
    "h5py",
    "pydantic",
)
"""What a number of a result, or the file that holds it, can depend on."""
_OTHERS_WRITE = stat.S_IWGRP | stat.S_IWOTH
_TEMPORARY = re.compile(r"\..+\.[0-9a-f]{1,8}\.tmp")
_UNSYNCED = (errno.EINVAL, errno.ENOTSUP, errno.EACCES)
"""What file systems answer that cannot sync a folder."""
_in_work: set[Path] = set()


class StorageError(MachineProblem):
    """A file cannot be written; the text says why and what to do."""


class CacheWarning(UserWarning):
    """A folder of what earlier runs prepared is not used."""


@lru_cache
def is_own_folder(folder: Path) -> bool:
    """Return whether only this user, or root, can put files into a folder or another folder in its
    place; a warning says why not.

    The folder and all above it are looked at, with links and without; a folder above may be one
    that others write where each can remove only their own, as `/tmp`.
    """
    named, real = Path(os.path.abspath(folder)), Path(os.path.realpath(folder))
    for ancestor in dict.fromkeys([named, *named.parents, real, *real.parents]):
        fault = _fault_of(ancestor, ancestor in (named, real))
        if fault is not None:
            warnings.warn(
                CacheWarning(
                    f"{folder} is not used: {ancestor} {fault}, who could plant files there; "
                    "chmod it, or name a folder of your own"
                ),
                stacklevel=2,
            )
            return False
    return True


def _fault_of(path: Path, is_last: bool) -> str | None:
    """Who else may write a folder; None if nobody."""
    status = os.lstat(path)
    if status.st_uid not in (os.geteuid(), 0) and path != Path(path.anchor):
        return f"belongs to {_name_of(status.st_uid)}"
    if stat.S_ISLNK(status.st_mode):
        return None
    open_to = status.st_mode & _OTHERS_WRITE
    if open_to and status.st_mode & stat.S_ISVTX and not is_last:
        return None
    if open_to == stat.S_IWGRP and _is_private_group(status.st_gid):
        return None
    return "may be written by others" if open_to else None


def _name_of(user: int) -> str:
    try:
        return pwd.getpwuid(user).pw_name
    except KeyError:
        return f"user {user}"


def _is_private_group(group: int) -> bool:
    """Return whether a group is this user's alone, as many systems give to each."""
    try:
        user, found = pwd.getpwuid(os.geteuid()), grp.getgrgid(group)
    except KeyError:
        return False
    return found.gr_name == user.pw_name and set(found.gr_mem) <= {user.pw_name}


def write_whole(file: str | Path, content: bytes | str) -> None:
    """Write a file, and the folders above it, so that it is there whole or not at all, also after
    a power cut.

    Raises
    ------
    StorageError  If it cannot be written; what was there before is still there.
    """
    file = Path(file)
    try:
        _make(file.parent)
        with _beside(file) as (temporary, opened):
            opened.write(content.encode() if isinstance(content, str) else content)
            opened.flush()
            os.fsync(opened.fileno())
            os.replace(temporary, file)
        _sync(file.parent)
        _tidy(file.parent)
    except OSError as problem:
        raise StorageError(
            f"cannot write {file}: {problem.strerror or problem}; choose another --out, "
            "or make room"
        ) from problem


def abandon() -> None:
    """Take away what is being written; for a process that ends at once."""
    for temporary in list(_in_work):
        with suppress(OSError):
            temporary.unlink(missing_ok=True)


def read_whole(file: Path, most: int = MOST_BYTES) -> bytes:
    """The content of a regular file of at most so many bytes.

    Raises
    ------
    OSError  If there is none, or it is larger, or a device or a pipe.
    """
    with open(os.open(file, os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC), "rb") as opened:
        status = os.fstat(opened.fileno())
        if not stat.S_ISREG(status.st_mode):
            raise OSError(errno.EINVAL, "is no regular file", str(file))
        if status.st_size > most:
            raise OSError(errno.EFBIG, f"is larger than {most} bytes", str(file))
        return opened.read()


def check_heaps(content: bytes | mmap.mmap) -> None:
    """Refuse HDF5 whose global heaps hold pieces that do not follow on each other: libhdf5 walks
    such a heap for ever.

    Raises
    ------
    ValueError
    """
    at = content.find(_HEAP)
    while at >= 0:
        end = min(at + int.from_bytes(content[at + 8 : at + 16], "little"), len(content))
        piece = at + 16
        while piece + 16 <= end:
            index, size = struct.unpack_from("<H6xQ", content, piece)
            step = 16 + -(-size // 8) * 8 if index else size
            if not 16 <= step <= end - piece:
                raise ValueError(f"a heap of HDF5 at byte {at} is bent")
            piece += step
        at = content.find(_HEAP, at + len(_HEAP))


def check_unfolded(opened: Any, file_bytes: int, most: float, refuse_links: bool = True) -> None:
    """Refuse an HDF5 file (an open `h5py.File`) that asks for more than its numbers need: more
    bytes than `most`, more than any packing of its bytes makes, or pieces that are larger than what
    they are pieces of; and links and other files, unless the reader leaves them out.

    Raises
    ------
    ValueError
    """
    import h5py

    total = 0

    def visit(group: Any, depth: int) -> None:
        nonlocal total
        for name in group:
            if not isinstance(group.get(name, getlink=True), h5py.HardLink):
                if refuse_links:
                    raise ValueError(f"{name} is a link")
                continue
            node = group[name]
            if isinstance(node, h5py.Group) and depth < MAX_HDF5_DEPTH:
                visit(node, depth + 1)
            if not isinstance(node, h5py.Dataset) or node.shape is None:
                continue
            if node.is_virtual or node.external:
                if refuse_links:
                    raise ValueError(f"{name} lies in other files")
                continue
            size = node.size * node.dtype.itemsize
            piece = math.prod(node.chunks or ()) * node.dtype.itemsize
            if piece > max(size, MAX_HDF5_PIECE):
                raise ValueError(f"{name} has {size} bytes in pieces of {piece}")
            total += size
            if total > min(most, HDF5_PACKING * file_bytes + MAX_HDF5_PIECE):
                raise ValueError(f"{file_bytes} bytes unfold to more than {total:.3g}")

    visit(opened, 0)


def save_data(file: Path, key: str, value: Any) -> None:
    """Keep data under a key.

    Raises
    ------
    StorageError  If the file cannot be written.
    """
    tree, arrays = pack(value)
    data = tree.encode() + b"\n" + arrays
    write_whole(file, _seal(key, data) + data)


def load_data(file: Path, key: str) -> Any | None:
    """Return the data that `save_data` kept under a key; None where it is missing, incomplete, or
    was kept under another key."""
    try:
        content = read_whole(file)
    except OSError:
        return None
    seal, _, data = content.partition(b"\n")
    if seal + b"\n" != _seal(key, data):
        return None
    tree, _, arrays = data.partition(b"\n")
    try:
        return unpack(tree.decode(), arrays)
    except BAD_DATA:  # sealed, but not by `save_data`
        return None


@lru_cache(maxsize=1)
def program_fingerprint() -> str:
    """Version of this package and a digest of its source and tables: two runs with the same one
    were made by the same program."""
    source = source_digest(Path(__file__).resolve().parent)
    return f"{importlib.metadata.version('isac_rt')}+{source}"


def source_digest(folder: Path) -> str:
    """Digest of the source and the tables in a folder."""
    digest = hashlib.sha256()
    files = (file for file in folder.rglob("*") if file.suffix in (".py", ".json"))
    for file in sorted(files):
        digest.update(f"{file.relative_to(folder)}\0".encode() + file.read_bytes() + b"\0")
    return digest.hexdigest()[:16]


@lru_cache(maxsize=1)
def _versions() -> dict[str, str]:
    versions = {"python": platform.python_version()}
    for name in PACKAGES:
        try:
            versions[name] = importlib.metadata.version(name)
        except importlib.metadata.PackageNotFoundError:
            versions[name] = "not installed"
    return versions


def versions() -> dict[str, str]:
    """Python's version and the installed one of every package that a result depends on: the same
    in every process, for keys."""
    return dict(_versions())


@dataclass(frozen=True)
class Store:
    """A folder of data by key with a limit on its size [bytes]; the least recently used go first.

    Several processes may share it: files appear whole, and one that another process takes away is
    made again.
    """

    folder: Path
    suffix: str
    limit: int

    def get(self, key: str) -> Any | None:
        """Return the data kept under a key; None where it is not (or no longer) here."""
        file = self._file(key)
        data = load_data(file, key)
        if data is not None:
            with suppress(OSError):
                os.utime(file)
        return data

    def put(self, key: str, value: Any) -> None:
        """Keep data under a key; nothing, where the folder cannot be written."""
        with suppress(OSError, StorageError):
            save_data(self._file(key), key, value)
            room = _ROOM.get(self, 0) - self._file(key).stat().st_size
            _ROOM[self] = self._make_room() // 2 if room < 0 else room

    def _file(self, key: str) -> Path:
        return self.folder / key[:2] / f"{key}{self.suffix}"

    def _make_room(self) -> int:
        """Keep to the limit; how much is left of it [bytes]."""
        entries = []
        for file in self.folder.glob(f"*/*{self.suffix}"):
            try:
                status = file.stat()
            except OSError:
                continue
            entries.append((status.st_mtime_ns, status.st_size, file))
        total = sum(size for _, size, _ in entries)
        if total <= self.limit:
            return self.limit - total
        for _, size, file in sorted(entries, key=lambda e: e[0]):
            if total <= LOW_WATER * self.limit:
                break
            file.unlink(missing_ok=True)
            total -= size
        return self.limit - total


_ROOM: dict[Store, int] = {}
"""What may be put into a folder until it is looked at again [bytes], half of what it had room for:
others put things there too, and a look at thousands of files takes 10 ms."""


def cached(what: str, depends_on: Any, make: Callable[[], Any]) -> Any:
    """Return what `make` returns, plain data and arrays, or what it returned in an earlier run for
    the same `depends_on`, plain data and arrays too."""
    named = os.environ.get(CACHE_VARIABLE)
    if named is None:
        try:
            user = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")
        except RuntimeError:  # a user without a home
            return make()
        named = str(user / "isac_rt" / "kept")
    if not named:
        return make()
    try:
        Path(named).mkdir(parents=True, exist_ok=True)
        if not is_own_folder(Path(named)):
            return make()
    except OSError:
        return make()
    store = Store(Path(named), ".data", CACHE_BYTES)
    tree, arrays = pack([what, depends_on, program_fingerprint(), versions()])
    key = hashlib.sha256(tree.encode() + b"\n" + arrays).hexdigest()
    data = store.get(key)
    if data is None:
        data = make()
        store.put(key, data)
    return data


def checksum(key: str, content: bytes) -> str:
    """SHA-256 of content that is kept under a key."""
    return hashlib.sha256(key.encode() + b"\n" + content).hexdigest()


def pack(value: Any) -> tuple[str, bytes]:
    """A tree of plain values and arrays, also of rows with named fields, as JSON and bytes.

    Examples
    --------
    >>> tree, arrays = pack({"time": 0.25, "mean": np.arange(3.0)})
    >>> unpack(tree, arrays)
    {'time': 0.25, 'mean': array([0., 1., 2.])}
    """
    arrays: list[bytes] = []
    position = 0

    def plain(value: Any) -> Any:
        nonlocal position
        if isinstance(value, np.ndarray):
            order: Literal["C", "F"] = "C" if value.flags.c_contiguous else "F"
            arrays.append(value.tobytes(order))
            here = position
            position += value.nbytes
            kind = value.dtype.descr if value.dtype.names else value.dtype.str
            return {ARRAY: [kind, list(value.shape), order, here]}
        if isinstance(value, np.generic):
            return value.item()
        if isinstance(value, dict):
            return {key: plain(entry) for key, entry in value.items()}
        return [plain(entry) for entry in value] if isinstance(value, list | tuple) else value

    return json.dumps(plain(value)), b"".join(arrays)


def unpack(tree: str, arrays: bytes) -> Any:
    """The value that `pack` took apart."""

    def made(node: dict[str, Any]) -> Any:
        if node.keys() != {ARRAY}:
            return node
        kind, shape, order, begin = node[ARRAY]
        if isinstance(kind, list):
            kind = [(name, of, *map(tuple, size)) for name, of, *size in kind]
        dtype = np.dtype(kind)
        parts = [dtype[name].base for name in dtype.names] if dtype.names else [dtype]
        if any(part.kind not in "biufc" for part in parts) or min(shape, default=0) < 0:
            raise ValueError(f"an array of {dtype}, {shape}")
        flat = np.frombuffer(arrays, dtype, math.prod(shape), begin)
        return flat.reshape(shape, order=order).copy(order)

    return json.loads(tree, object_hook=made)


def _seal(key: str, data: bytes) -> bytes:
    return f"isac_rt {key} {checksum(key, data)}\n".encode()


@contextmanager
def _beside(file: Path) -> Iterator[tuple[Path, BinaryIO]]:
    """A locked file of a temporary name in the folder of `file`; it is gone afterwards unless it
    was renamed."""
    while True:
        temporary = file.with_name(f".{file.name}.{secrets.token_hex(4)}.tmp")
        _in_work.add(temporary)
        try:
            flags = os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC
            with open(os.open(temporary, flags, 0o666), "wb") as opened:
                with suppress(OSError):  # not every file system locks
                    fcntl.flock(opened, fcntl.LOCK_EX)
                if not temporary.exists():  # tidied away before it was locked
                    continue
                yield temporary, opened
            return
        finally:
            with suppress(OSError):
                temporary.unlink(missing_ok=True)
            _in_work.discard(temporary)


def _make(folder: Path) -> None:
    if not folder.is_dir():
        _make(folder.parent)
        folder.mkdir(exist_ok=True)
        _sync(folder.parent)


def _sync(folder: Path) -> None:
    """Have the names in a folder on the disk."""
    try:
        opened = os.open(folder, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
        try:
            os.fsync(opened)
        finally:
            os.close(opened)
    except OSError as problem:
        if problem.errno not in _UNSYNCED:
            raise


def _tidy(folder: Path) -> None:
    """Take away what killed processes left half-written in a folder."""
    for left in folder.glob(".*.tmp"):
        if _TEMPORARY.fullmatch(left.name):
            with suppress(OSError):
                opened = os.open(left, os.O_RDWR | os.O_NONBLOCK | os.O_NOFOLLOW | os.O_CLOEXEC)
                try:
                    fcntl.flock(opened, fcntl.LOCK_EX | fcntl.LOCK_NB)  # nobody writes it
                    left.unlink()
                finally:
                    os.close(opened)
