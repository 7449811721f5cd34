"""Files that are whole or not there, and data that are the ones asked for."""

from __future__ import annotations

import errno
import fcntl
import io
import os
import signal
import struct
import subprocess
import sys
from contextlib import nullcontext
from pathlib import Path

import h5py
import numpy as np
import pytest

from isac_rt import storage
from isac_rt.document import ScenarioError
from isac_rt.runtime import MachineProblem, UserError, of_machine
from isac_rt.storage import (
    StorageError,
    abandon,
    load_data,
    read_whole,
    save_data,
    unpack,
    write_whole,
)

ROOT = Path(__file__).parents[1]


# ---- whole files


def test_a_file_is_on_the_disk_before_it_has_its_name(tmp_path, monkeypatch):
    """Synced, renamed, and then its folder and those that were made for it, in this order: after a
    power cut the name never stands for half a file. Planted bugs: either sync left out."""
    done = []
    fsync, replace = os.fsync, os.replace

    def synced(opened):
        done.append(Path(os.readlink(f"/proc/self/fd/{opened}")).name)
        fsync(opened)

    monkeypatch.setattr(storage.os, "fsync", synced)
    monkeypatch.setattr(storage.os, "replace", lambda a, b: done.append("renamed") or replace(a, b))
    write_whole(tmp_path / "new" / "file.txt", "x")
    *made, temporary, renamed, folder = done
    assert made == [tmp_path.name] and renamed == "renamed" and folder == "new"
    assert temporary.startswith(".file.txt.") and (tmp_path / "new" / "file.txt").read_text() == "x"


KILLED = """
import os, signal, sys
from isac_rt import storage
storage.os.replace = lambda *_: os.kill(os.getpid(), signal.SIGKILL)
storage.write_whole(sys.argv[1], "half")
"""


def test_what_a_killed_process_left_goes_with_the_next_file_of_its_folder(tmp_path):
    """What another process is writing stays, and so does what only looks alike. Planted bugs:
    nothing tidied; locks not looked at."""
    left = subprocess.run([sys.executable, "-c", KILLED, str(tmp_path / "link.png")], cwd=ROOT)
    assert left.returncode == -signal.SIGKILL
    (dead,) = tmp_path.iterdir()
    earlier, mine = tmp_path / ".link.png.4711.tmp", tmp_path / ".notes.tmp"
    alive = tmp_path / ".scene.png.0a0b0c0d.tmp"
    for file in (earlier, mine, alive):
        file.touch()
    os.mkfifo(tmp_path / ".pipe.00000000.tmp")
    with alive.open() as opened:
        fcntl.flock(opened, fcntl.LOCK_EX)
        write_whole(tmp_path / "other.png", "x")
        found = {p.name for p in tmp_path.iterdir()} - {".pipe.00000000.tmp"}
    assert found == {".notes.tmp", alive.name, "other.png"}, dead


def test_a_file_that_was_tidied_away_before_it_was_locked_is_made_again(tmp_path, monkeypatch):
    """Planted bug: renamed without a look."""
    flock, times = fcntl.flock, []

    def stolen(opened, how):
        if not times:
            (name,) = tmp_path.iterdir()
            name.unlink()
        times.append(how)
        flock(opened, how)

    monkeypatch.setattr(storage.fcntl, "flock", stolen)
    write_whole(tmp_path / "f", "x")
    assert [p.name for p in tmp_path.iterdir()] == ["f"] and times == [fcntl.LOCK_EX] * 2


def test_a_process_that_ends_at_once_takes_its_half_file_along(tmp_path, monkeypatch):
    """Planted bug: the name not remembered."""
    seen = []

    def ending(*_):
        seen.extend(tmp_path.iterdir())
        abandon()
        raise OSError(errno.EIO, "x")

    monkeypatch.setattr(storage.os, "replace", ending)
    with pytest.raises(StorageError):
        write_whole(tmp_path / "f", "x")
    assert len(seen) == 1 and not list(tmp_path.iterdir())


def test_pipes_devices_and_giants_are_not_read(tmp_path):
    """A pipe would be waited for. Planted bug: `path.read_bytes()`."""
    os.mkfifo(tmp_path / "pipe")
    (tmp_path / "giant").write_bytes(bytes(11))
    for name in ("pipe", "giant", "none", "."):
        with pytest.raises(OSError, match=r"regular|larger|No such|directory"):
            read_whole(tmp_path / name, 10)
    assert read_whole(tmp_path / "giant", 11) == bytes(11)
    with pytest.raises(OSError, match="regular"):
        read_whole(Path("/dev/zero"))


# ---- data


def test_data_come_back_or_are_not_there(tmp_path):
    """Every byte changed in turn, every length cut off, another key, another's file: never other
    numbers. Planted bugs: the key not in the checksum; the arrays not in it."""
    file, value = tmp_path / "d", {"a": np.array([0.1, np.nan]), "b": [1, "x"]}
    save_data(file, "key", value)
    whole = file.read_bytes()
    back = load_data(file, "key")
    assert back["a"].tobytes() == value["a"].tobytes() and back["b"] == value["b"]
    for i in range(len(whole)):
        file.write_bytes(whole[:i] + bytes([whole[i] ^ 4]) + whole[i + 1 :])
        assert load_data(file, "key") is None, i
        file.write_bytes(whole[:i])
        assert load_data(file, "key") is None, i
    file.write_bytes(whole)
    assert load_data(file, "kez") is None
    file.write_bytes(whole.replace(b" key ", b" kez "))
    assert load_data(file, "kez") is None and load_data(tmp_path / "none", "key") is None
    for tree in (b"[" * 100_000, b'{"array": ["O", [1], "C", 0]}', b"\xff", b"no"):
        file.write_bytes(storage._seal("key", tree + b"\n") + tree + b"\n")
        assert load_data(file, "key") is None


@pytest.mark.parametrize("dtype", ["O", "<U1", "S4", "V8", "<M8[s]", "<m8[s]"])
def test_arrays_are_of_numbers(dtype):
    """Planted bug: any type that numpy makes of bytes."""
    with pytest.raises(ValueError, match="an array of"):
        unpack(f'{{"array": ["{dtype}", [1], "C", 0]}}', bytes(8))


def test_an_array_larger_than_its_bytes_is_refused():
    with pytest.raises(ValueError, match="buffer"):
        unpack('{"array": ["<f8", [9000000000], "C", 0]}', bytes(16))


# ---- whose trouble it is


def wrapped(problem: BaseException, by: type[Exception]) -> BaseException:
    try:
        try:
            raise problem
        except type(problem):
            raise by("said so") from None
    except by as outer:
        return outer


@pytest.mark.parametrize(
    ("problem", "expected"),
    [
        (OSError(errno.ENOSPC, "full"), True),
        (OSError(errno.EDQUOT, "quota"), True),
        (OSError(errno.EIO, "disk"), True),
        (PermissionError(errno.EACCES, "no"), True),
        (TimeoutError(errno.ETIMEDOUT, "late"), True),
        (FileNotFoundError(errno.ENOENT, "city.obj"), False),
        (IsADirectoryError(errno.EISDIR, "city.obj"), False),
        (OSError("not an image"), False),
        (MemoryError(), True),
        (MachineProblem("no LLVM"), True),
        (RuntimeError("jit_malloc(): out of memory! Could not allocate 7 bytes"), True),
        (RuntimeError("can't start new thread"), True),
        (RuntimeError("no such plugin"), False),
        (ValueError("x"), False),
        (ScenarioError("two bodies meet"), False),
    ],
)
def test_whose_trouble_it_is(problem, expected):
    """Also where a message of the program was made of it. Planted bug: the context not followed."""
    assert of_machine(problem) is expected
    assert of_machine(wrapped(problem, UserError)) is expected


def test_what_is_kept_is_found_by_all_that_it_depends_on(tmp_path, monkeypatch):
    """Made once for each content, by name and program too; made again where the variable is empty
    or the folder cannot be written. Planted bugs: a key without the name, without the arrays or
    without the program."""
    made = []

    def make():
        made.append(1)
        return {"a": np.arange(4.0), "n": len(made)}

    monkeypatch.setenv(storage.CACHE_VARIABLE, str(tmp_path / "kept"))
    first = storage.cached("x", ["y", np.arange(3)], make)
    again = storage.cached("x", ["y", np.arange(3)], make)
    assert (first["n"], again["n"], len(made)) == (1, 1, 1)
    assert np.array_equal(again["a"], first["a"])
    storage.cached("z", ["y", np.arange(3)], make)
    storage.cached("x", ["y", np.arange(1, 4)], make)
    storage.cached("x", ["y", np.arange(3.0)], make)
    assert len(made) == 4
    monkeypatch.setattr(storage, "program_fingerprint", lambda: "another")
    assert storage.cached("x", ["y", np.arange(3)], make)["n"] == 5
    (tmp_path / "file").write_text("")
    for folder in ("", str(tmp_path / "file" / "below")):
        monkeypatch.setenv(storage.CACHE_VARIABLE, folder)
        assert storage.cached("x", ["y", np.arange(3)], make)["n"] == len(made)


def test_what_others_could_have_kept_is_not_taken(tmp_path, monkeypatch):
    """A checksum is no signature: who may write there could keep wrong numbers under a right one.
    Planted bug: a group of many taken for one's own."""
    folder = tmp_path / "kept"
    monkeypatch.setenv(storage.CACHE_VARIABLE, str(folder))
    assert storage.cached("x", "y", lambda: 1) == 1
    assert storage.cached("x", "y", lambda: 2) == 1
    for mode, private, taken in ((0o777, True, False), (0o775, False, False), (0o775, True, True)):
        storage.is_own_folder.cache_clear()
        folder.chmod(mode)
        monkeypatch.setattr(storage, "_is_private_group", lambda group, own=private: own)
        with nullcontext() if taken else pytest.warns(storage.CacheWarning, match="by others"):
            assert storage.cached("x", "y", lambda: 2) == (1 if taken else 2)


def test_a_store_keeps_to_its_limit_and_lets_the_oldest_go(tmp_path):
    """Twenty entries of 10 kB in a store of 60 kB: never more than that, the last are there, one
    that is read again stays. Planted bug: reading does not count as use."""
    store = storage.Store(tmp_path, ".data", 60_000)
    keys = [f"{i:02d}" * 8 for i in range(20)]
    for i, key in enumerate(keys):
        store.put(key, {"a": np.full(1250, i)})
        for file in tmp_path.glob("*/*.data"):  # clocks of file systems are coarse
            os.utime(file, ns=(0, file.stat().st_mtime_ns - 10**9))
        assert sum(f.stat().st_size for f in tmp_path.glob("*/*.data")) <= 60_000
        assert store.get(keys[0]) is not None
    assert store.get(keys[19])["a"][0] == 19
    assert store.get(keys[5]) is None


def test_a_store_that_has_room_is_not_counted_at_every_write(tmp_path, monkeypatch):
    """A first set-up puts hundreds of things into a folder of thousands: it is looked at when half
    of its room was used, four times for 200 entries that fill nine tenths of it. Planted bug: the
    first look's room is taken for all there will be."""
    looks, visit = [], storage.Store._make_room
    monkeypatch.setattr(storage.Store, "_make_room", lambda self: looks.append(1) or visit(self))
    store = storage.Store(tmp_path, ".data", 2_300_000)
    for i in range(200):
        store.put(f"{i:03d}" * 4, {"a": np.full(1250, i)})
    size = sum(f.stat().st_size for f in tmp_path.glob("*/*.data"))
    assert 0.85 * 2_300_000 < size < 2_300_000
    assert 2 <= len(looks) <= 8


def test_many_processes_keep_into_one_small_folder(tmp_path):
    """Four write and read the same twelve keys in a folder that holds five: whatever one finds is
    right, and none stumbles over what another took away. Planted bug: it must be there when it is
    taken away."""
    program = (
        "import sys, numpy as np; from pathlib import Path; from isac_rt.storage import Store\n"
        "store = Store(Path(sys.argv[1]), '.data', 500_000)\n"
        "rng = np.random.default_rng(int(sys.argv[2]))\n"
        "for k in rng.integers(0, 12, 150):\n"
        "    found = store.get(f'{k:02d}' * 4)\n"
        "    assert found is None or (found['a'] == k).all()\n"
        "    store.put(f'{k:02d}' * 4, {'a': np.full(12_000, k)})\n"
    )
    runs = [
        subprocess.Popen([sys.executable, "-c", program, str(tmp_path), str(i)]) for i in range(4)
    ]
    assert [run.wait(60) for run in runs] == [0, 0, 0, 0]
    assert not list(tmp_path.glob("*/.*.tmp"))


def test_a_heap_that_libhdf5_walks_for_ever_is_refused():
    """A piece of no size, and one whose size wraps. Planted bug: pieces of no size passed."""
    made = io.BytesIO()
    with h5py.File(made, "w") as whole:
        whole["names"] = np.array(["one", "another"], h5py.string_dtype())
    content = made.getvalue()
    storage.check_heaps(content)
    first = content.index(b"GCOL") + 16
    for index, size in ((0, 0), (1, 2**64 - 16)):
        bent = bytearray(content)
        struct.pack_into("<H6xQ", bent, first, index, size)
        with pytest.raises(ValueError, match="heap of HDF5"):
            storage.check_heaps(bytes(bent))
