"""Files that appear whole or not at all, and data that say whether they are the ones asked for.

A file is written beside its place, synced, and renamed. Its temporary name is locked while a
process writes it, so that what a killed one left behind is known by its open lock, whatever machine
or container looks, and is taken away with the next file that is written there.

Data are a tree of words, numbers, lists and mappings as JSON and the bytes of its arrays: reading
them runs no code. In a file they carry the key under which they are kept and a checksum.
"""

from __future__ import annotations

import errno
import fcntl
import hashlib
import json
import math
import os
import re
import secrets
import stat
from collections.abc import Iterator
from contextlib import contextmanager, suppress
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
_TEMPORARY = re.compile(r"\..+\.[0-9a-f]{1,8}\.tmp")
_UNSYNCED = (errno.EINVAL, errno.ENOTSUP, errno.EACCES)
"""What file systems answer that cannot sync a folder."""
_in_work: set[Path] = set()


class StorageError(MachineProblem):
    """A file cannot be written; the text says why and what to do."""


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
            f"cannot write {file}: {problem.strerror or problem}; choose another place with --out, "
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


def save_data(file: Path, key: str, value: Any) -> None:
    """Keep data under a key.

    Raises
    ------
    StorageError  If the file cannot be written.
    """
    tree, arrays = pack(value)
    body = tree.encode() + b"\n" + arrays
    write_whole(file, _seal(key, body) + body)


def load_data(file: Path, key: str) -> Any | None:
    """What `save_data` kept under a key; None where it is not there, or not whole, or was kept
    under another key."""
    try:
        content = read_whole(file)
    except OSError:
        return None
    seal, _, body = content.partition(b"\n")
    if seal + b"\n" != _seal(key, body):
        return None
    tree, _, arrays = body.partition(b"\n")
    try:
        return unpack(tree.decode(), arrays)
    except BAD_DATA:  # sealed, but not by `save_data`
        return None


def checksum(key: str, content: bytes) -> str:
    """SHA-256 of content that is kept under a key."""
    return hashlib.sha256(key.encode() + b"\n" + content).hexdigest()


def pack(value: Any) -> tuple[str, bytes]:
    """A tree of plain values and arrays as JSON and bytes.

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
            return {ARRAY: [value.dtype.str, list(value.shape), order, here]}
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
        dtype, shape, order, begin = node[ARRAY]
        if np.dtype(dtype).kind not in "biufc" or min(shape, default=0) < 0:
            raise ValueError(f"an array of {dtype}, {shape}")
        flat = np.frombuffer(arrays, dtype, math.prod(shape), begin)
        return flat.reshape(shape, order=order).copy(order)

    return json.loads(tree, object_hook=made)


def _seal(key: str, body: bytes) -> bytes:
    return f"isac_rt {key} {checksum(key, body)}\n".encode()


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
