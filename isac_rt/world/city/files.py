"""Reading of a city's file: whole, of a size that memory holds, from where it may lie, and checked
against a schema."""

from __future__ import annotations

import os
import stat
import zlib
from importlib import import_module
from pathlib import Path
from typing import Annotated, Any, TypeVar
from urllib.parse import unquote

from pydantic import BaseModel, ConfigDict, FailFast, ValidationError

from isac_rt.runtime import available_memory
from isac_rt.world.city.materials import CityError

MAX_BYTES = 1_000_000_000
"""No file of a city may be larger than this."""
READING_FACTOR = 6
"""Memory that reading a mesh takes, over the size of its file: text, arrays and their copies;
measured 3 to 5."""
JSON_FACTOR = 25
"""The same for JSON, whose numbers and lists become objects: measured 16 with footprints, 23 with
CityJSON (53 with nothing but empty lists)."""
ANY_MEMORY = 100_000
"""Of files up to this size the free memory is not asked: a city may have thousands."""
_BYTE_ORDER_MARK = b"\xef\xbb\xbf"


class Part(BaseModel):
    """A part of a JSON file: of the types that its format says, with finite numbers, and with keys
    that are not looked at."""

    model_config = ConfigDict(strict=True, allow_inf_nan=False, frozen=True)


def needs_extra(module: str, name: str, kind: str) -> Any:
    """A module of the extra `cities`.

    Raises
    ------
    CityError  If it is not installed.
    """
    try:
        return import_module(module)
    except ImportError:
        raise missing_extra(name, kind) from None


def missing_extra(name: str, kind: str) -> CityError:
    """The message that the extra `cities` is not installed."""
    return CityError(f"{name}: to read {kind}, install its readers: pip install 'isac_rt[cities]'")


Document = TypeVar("Document", bound=BaseModel)
Item = TypeVar("Item")
Items = Annotated[list[Item], FailFast()]
"""A list that is left at its first wrong item: a file may have a million of them."""


def read_bytes(path: Path, factor: float = READING_FACTOR) -> bytes:
    """The content of a regular file.

    Raises
    ------
    CityError  If there is none, it is a device or a pipe, or reading it takes `factor` times its
        size of memory and more than there is.
    """
    try:
        status = path.stat()
        if not stat.S_ISREG(status.st_mode):
            raise CityError(f"{path.name}: is no regular file; give a file")
        size = status.st_size
        free = available_memory() if size > ANY_MEMORY else None
        if free is not None and factor * size > free:
            raise CityError(
                f"{path.name}: a file of {size / 1e9:.3g} GB takes about "
                f"{factor * size / 1e9:.3g} GB of memory to read, "
                f"{free / 1e9:.3g} GB are free; simplify it, or cut out what is near the swarm"
            ) from MemoryError()
        if size > MAX_BYTES:
            raise CityError(
                f"{path.name}: a file of {size / 1e9:.3g} GB, more than the "
                f"{MAX_BYTES / 1e9:g} GB that are read; cut out what is near the swarm"
            )
        with path.open("rb") as opened:
            return opened.read(size)
    except (OSError, ValueError) as error:  # ValueError: a NUL in the name
        raise CityError(f"{path.name}: cannot be read ({error}); give a file") from None


def unpacked(data: bytes, name: str, factor: float) -> bytes:
    """The content of a gzip file; anything else as it is.

    Raises
    ------
    CityError  If it is broken, or grows beyond `MAX_BYTES` or the free memory over `factor`.
    """
    if not data.startswith(b"\x1f\x8b"):
        return data
    free = available_memory()
    most = MAX_BYTES if free is None else min(MAX_BYTES, int(free / factor))
    try:
        stream = zlib.decompressobj(wbits=31)
        found = stream.decompress(data, most)
    except zlib.error as error:
        raise CityError(f"{name}: is no whole gzip file ({error}); fetch it again") from None
    if stream.unconsumed_tail or not stream.eof:
        raise CityError(f"{name}: is cut off, or holds more than {most / 1e9:.3g} GB; cut it out")
    if stream.unused_data.strip(b"\0"):
        raise CityError(f"{name}: has several gzip streams; unpack it with gunzip")
    return found


def beside(path: Path, name: str, what: str) -> Path:
    """The file that `what` in the file `path` names: in its folder or below, and nowhere else."""
    relative = os.path.normpath(unquote(name))
    if os.path.isabs(relative) or relative.startswith(os.pardir):
        relative = os.path.relpath(path.parent / relative, path.parent)
    file, steps = path.parent / relative, relative.split(os.sep)
    inside = steps[0] != os.pardir
    if inside and any(os.path.islink(part) for part in (file, *file.parents[: len(steps) - 1])):
        inside = Path(os.path.realpath(file)).is_relative_to(os.path.realpath(path.parent))
    if not inside:
        raise CityError(f"{path.name}: {what} wants {name}, outside its folder; copy it there")
    if not os.path.isfile(file):
        raise CityError(f"{path.name}: {what} wants {name}, which is missing or no file")
    return file


def parsed(data: bytes, model: type[Document], name: str, remedy: str) -> Document:
    """A JSON file as its format's model.

    Raises
    ------
    CityError  With the first place that is not as it should be.
    """
    try:
        return model.model_validate_json(data.removeprefix(_BYTE_ORDER_MARK))
    except ValidationError as error:
        raise CityError(f"{name}: {first_error(error)}; {remedy}") from None


def first_error(error: ValidationError) -> str:
    """The first place that is not as it should be, and why."""
    first = error.errors(include_url=False, include_context=False, include_input=False)[0]
    key = " ".join(str(part) for part in first["loc"])
    return f"{key}: {first['msg']}"
