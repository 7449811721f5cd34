"""Samples of a data set as a learner reads them: by number from the shards, and as batches of one
size. PyTorch's `DataLoader` takes them; this program needs no PyTorch."""

from __future__ import annotations

import bisect
import io
import json
import tarfile
from collections.abc import Mapping, Sequence
from pathlib import Path
from tokenize import TokenError
from typing import Any, NamedTuple, get_args

import numpy as np

from isac_rt.results.files import ResultsError, with_new_names
from isac_rt.runtime import shortly
from isac_rt.storage import BAD_DATA, MOST_JSON_BYTES, read_whole
from isac_rt.sweep.drawn import SampleField

CARD = "card.json"
AXES = ("map_range", "map_velocity", "u_x")
"""Arrays that are the axes of others."""


class Samples:
    """The samples of a split, by number: what PyTorch's `DataLoader` takes as a data set.

    A sample is a dict: ``key``, ``truth`` (numbers, NaN where a UAV has none, and arrays), and its
    arrays by name. In a batch arrays differ in size; `DataLoader` gets them padded as `collate`
    does, and makes tensors of them.

    Parameters
    ----------
    folder : of a data set
    split : its name
    keep : arrays that are read; None: all

    Raises
    ------
    ResultsError  If it is the folder of no finished data set, has no such split or part, or a shard
        cannot be read.
    """

    def __init__(self, folder: str | Path, split: str, keep: Sequence[str] | None = None) -> None:
        self.folder, self.keep = Path(folder), keep
        card = read_card(self.folder)
        if split not in card["splits"]:
            raise ResultsError(
                f"{folder} has no split {split}; there are {', '.join(card['splits'])}"
            )
        known = [*card.get("data_set", {}).get("keep", get_args(SampleField)), *AXES]
        if unknown := [name for name in keep or () if name not in known]:
            raise ResultsError(
                f"{folder} has no part {', '.join(unknown)}; it has {', '.join(known)}"
            )
        shards: Mapping[str, int] = card["splits"][split]
        self._shards, self._ends = [*shards], np.cumsum([*shards.values()], dtype=int).tolist()
        self._indices: dict[str, Index] = {}

    def __len__(self) -> int:
        return self._ends[-1] if self._ends else 0

    def __getitem__(self, number: int) -> dict[str, Any]:
        """Its name, its truth, and its arrays by name."""
        if not 0 <= number < len(self):
            raise IndexError(f"sample {number} of {len(self)}")
        k = bisect.bisect_right(self._ends, number)
        within = number - (self._ends[k - 1] if k else 0)
        name = self._shards[k]
        if name not in self._indices:
            self._indices[name] = index_of(self.folder / name)
        return read_sample(self.folder / name, self._indices[name], within, self.keep)

    def __getitems__(self, numbers: Sequence[int]) -> list[dict[str, Any]]:
        """Samples of one batch, padded to one size (`collate`); `DataLoader` asks for them so."""
        return _padded([self[number] for number in numbers])


def collate(samples: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Stack samples as one batch, for any loader that works in NumPy.

    Returns
    -------
    batch : numbers and arrays stacked along a new first axis; arrays of different sizes are padded
        with NaN (integers with 0), and an array that a sample has not is all padding.
        ``NAME_valid`` marks what is no padding. Words are lists.

    Examples
    --------
    >>> import isac_rt as irt
    >>> samples = [{"key": key, "map": np.ones((rows, 3))} for key, rows in (("a", 2), ("b", 1))]
    >>> batch = irt.collate(samples)
    >>> batch["key"], batch["map"].shape, batch["map_valid"][:, :, 0].tolist()
    (['a', 'b'], (2, 2, 3), [[True, True], [True, False]])
    """
    batch: dict[str, Any] = _stacked(_padded(samples))
    return batch


def _padded(samples: Sequence[Mapping[str, Any]]) -> list[dict[str, Any]]:
    """Give samples the same keys and arrays of one size, and add which of these are valid."""
    marked = [
        {
            **{
                f"{name}_valid": np.ones(value.shape, bool)
                for name, value in sample.items()
                if isinstance(value, np.ndarray) and not name.endswith("_valid")
            },
            **sample,
        }
        for sample in samples
    ]
    return _alike(marked)


def _alike(values: Sequence[Any]) -> list[Any]:
    """Bring values of one kind to one form: dicts to the same keys, arrays to the largest size;
    where a value is None, it is all padding."""
    first = next(value for value in values if value is not None)
    if isinstance(first, Mapping):
        keys = dict.fromkeys(key for value in values if value is not None for key in value)
        by_key = {
            key: _alike([None if value is None else value.get(key) for value in values])
            for key in keys
        }
        return [{key: by_key[key][i] for key in keys} for i in range(len(values))]
    if not isinstance(first, np.ndarray):
        missing = {str: "", bool: False}.get(type(first), np.nan)
        return [missing if value is None else value for value in values]
    shape = np.max([value.shape for value in values if value is not None], axis=0)
    blank = np.nan if first.dtype.kind in "fc" else 0
    out = [np.full(shape, blank, first.dtype) for _ in values]
    for one, value in zip(out, values, strict=True):
        if value is not None:
            one[tuple(map(slice, value.shape))] = value
    return out


def _stacked(values: Sequence[Any]) -> Any:
    """Stack values of one form along a new first axis."""
    if isinstance(values[0], Mapping):
        return {key: _stacked([value[key] for value in values]) for key in values[0]}
    return list(values) if isinstance(values[0], str) else np.stack(values)


def read_card(folder: Path) -> dict[str, Any]:
    """Read the card of a finished data set.

    Raises
    ------
    ResultsError  If it is the folder of none.
    """
    try:
        card = json.loads(read_whole(folder / CARD, MOST_JSON_BYTES))
        if not all(isinstance(part, str) for part in card.get("data_set", {}).get("keep", ())):
            raise ValueError("its parts have no names")
        for name, count in (item for shards in card["splits"].values() for item in shards.items()):
            if type(count) is not int or count < 0 or ".." in name or Path(name).is_absolute():
                raise ValueError(f"the shard {name[:80]} cannot be")
    except (OSError, *BAD_DATA) as problem:
        raise ResultsError(
            f"{folder} holds no finished data set ({shortly(problem)}); give the folder that "
            "`isac-rt dataset` wrote"
        ) from problem
    return dict(card)


class _File(NamedTuple):
    """A file of a shard: its name after the first dot, and where its bytes are."""

    ending: str
    start: int
    size: int


Index = dict[str, list[_File]]
"""The files of each sample of a shard, by its name."""
_BENT = SyntaxError, TokenError, tarfile.TarError
_UNREADABLE = OSError, EOFError, MemoryError, *_BENT, *BAD_DATA


def index_of(shard: Path) -> Index:
    """Index the contents of a shard from the headers of its files.

    Raises
    ------
    ResultsError  If it cannot be read.
    """
    found: Index = {}
    try:
        with tarfile.open(shard, "r:") as tar:  # not packed: what is read is as large as the file
            for member in tar:
                if member.issparse():
                    raise ValueError("a file in it has holes")
                stem, _, ending = member.name.partition(".")
                files = found.setdefault(stem, [])
                if member.isreg():
                    files.append(_File(ending, member.offset_data, member.size))
    except _UNREADABLE as problem:
        raise _unreadable(shard, problem) from problem
    return found


def read_sample(
    shard: Path, index: Index, number: int, keep: Sequence[str] | None = None
) -> dict[str, Any]:
    """A sample of a shard: `key`, `truth`, and the arrays by name.

    Raises
    ------
    ResultsError  If it cannot be read.
    """
    try:
        key = [*index][number]
        out: dict[str, Any] = {"key": key}
        with shard.open("rb") as opened:
            for ending, start, size in index[key]:
                name = ending.removesuffix(".npy")
                if ending != "json" and keep is not None and name not in keep:
                    continue
                opened.seek(start)
                content = opened.read(size)
                if len(content) < size:
                    raise EOFError(f"{ending} ends early")
                if ending == "json":
                    out["truth"] = _numbers(with_new_names(json.loads(content)))
                    continue
                out[name] = np.load(io.BytesIO(content), allow_pickle=False)
                if not isinstance(out[name], np.ndarray):
                    raise ValueError(f"{ending} is no array")
    except _UNREADABLE as problem:
        raise _unreadable(shard, problem) from problem
    return out


def _numbers(value: Any) -> Any:
    """Return a truth with NaN for null and arrays for lists."""
    if isinstance(value, dict):
        return {key: _numbers(one) for key, one in value.items()}
    if isinstance(value, list):
        return np.array(value, float)
    return np.nan if value is None else value


def _unreadable(shard: Path, problem: BaseException) -> ResultsError:
    return ResultsError(f"{shard} cannot be read ({shortly(problem)}); make the data set again")
