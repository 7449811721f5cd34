"""What is written as NetCDF, held against xarray's own writer."""

from __future__ import annotations

import io

import h5py
import numpy as np
import pytest
import xarray as xr

from isac_rt.results.files import read_dataset, write_dataset
from isac_rt.results.netcdf import netcdf

GIVEN = {"compression": "gzip", "compression_opts": 4, "shuffle": True, "fletcher32": True}


@pytest.fixture
def dataset():
    """Every kind of variable that results, cubes, sweeps and path ledgers have, and those that
    they might: none, one value, words of both kinds, coordinates off the dimensions."""
    rng = np.random.default_rng(3)
    level = rng.normal(size=(7, 3))
    level[2, 1] = np.nan
    said = {"units": "m", "long_name": "\u03bb over 4"}
    values = {
        "level": (("frame", "uav"), level, said),
        "small": ("detection", rng.normal(size=5).astype(np.float32), {"count": 3}),
        "gone": ("nothing", np.zeros(0), {}),
        "hit": (("frame", "uav"), level > 0, said),
        "code": ("frame", np.arange(7, dtype=np.int8), {"flag_values": np.arange(2, dtype="i1")}),
        "role": ("uav", np.array(["active", "", "t\u00e4rget"], object), said),
        "short": ("uav", np.array(["a", "bc", "d"]), {}),
        "one": ((), 3.5, said),
        "detection": ("track", np.arange(4), {"long_name": "what a track was made of"}),
        "picture": (("uav", "frame", "detection"), rng.normal(size=(3, 7, 5)), said),
    }
    along = {
        "uav": np.array(["AT", "PT1", "U1"], object),
        "frame": np.arange(10, 17),
        "power": ("frame", np.linspace(0, 1, 7), {"units": "W"}),
        "place": (("frame", "uav"), level, {}),
    }
    about = {"title": "a \u03bb", "seed": 4, "carrier": 7.7e10, "made_by": ("", "\u03bb")}
    return xr.Dataset(values, along, about)


@pytest.fixture
def both(dataset, tmp_path):
    write_dataset(dataset, tmp_path / "ours.nc")
    packed = {
        name: GIVEN for name, v in dataset.variables.items() if v.dtype.kind not in "OU" and v.size
    }
    del packed["one"]
    dataset.to_netcdf(tmp_path / "theirs.nc", engine="h5netcdf", encoding=packed)
    return tmp_path / "ours.nc", tmp_path / "theirs.nc"


def test_it_reads_back_as_what_xarray_writes(dataset, both):
    """Values, types, attributes and coordinates. Planted bugs: no attribute `dtype` for booleans;
    no `coordinates`; a scale attached to the wrong dimension; no fill value; words in a tuple taken
    for numbers."""
    ours, theirs = map(read_dataset, both)
    assert ours.identical(theirs) and ours.identical(dataset)
    for name in dataset.variables:
        assert ours[name].dtype == theirs[name].dtype, name
        for key in ("dtype", "_FillValue", "zlib", "shuffle", "fletcher32"):
            mine, other = (d[name].encoding.get(key) for d in (ours, theirs))
            assert mine == other or np.isnan(mine) == np.isnan(other), (name, key)


def test_other_libraries_see_the_same_layout(both):
    """HDF5's own view: names, shapes, chunks, scales, and all attributes but the dimensions'
    numbers, which are those of the scales named. Planted bugs: `_Netcdf4Dimid` counted from one;
    bare dimensions under another name; a variable that is named as a dimension of others in its
    place."""
    with h5py.File(both[0]) as ours, h5py.File(both[1]) as theirs:
        assert set(ours) == set(theirs)
        assert set(ours.attrs) == set(theirs.attrs)
        for name in ours:
            a, b = ours[name], theirs[name]
            assert (a.shape, a.dtype) == (b.shape, b.dtype)
            assert a.chunks == b.chunks or not a.size
            assert [[s.name for s in d.values()] for d in a.dims] == [
                [s.name for s in d.values()] for d in b.dims
            ]
            unwritten = {"_Netcdf4Dimid"} if not a.size else set()  # theirs comes with the values
            assert {*a.attrs} == {*b.attrs} | unwritten, name
            assert a.attrs.get("NAME") == b.attrs.get("NAME")
            for key in ("_Netcdf4Coordinates", "_Netcdf4Dimid"):
                if key in b.attrs:
                    assert _named(ours, a.attrs[key]) == _named(theirs, b.attrs[key]), (name, key)


def _named(file, numbers):
    """The dimensions of numbers."""
    scales = {int(v.attrs["_Netcdf4Dimid"]): name for name, v in file.items() if "CLASS" in v.attrs}
    assert sorted(scales) == list(range(len(scales)))
    return [scales[n] for n in np.atleast_1d(numbers)]


@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")  # refused files
def test_a_bent_byte_shows_no_other_numbers():
    """Every 97th byte of a file of 12 variables bent, one at a time: the file is refused or says
    what it said. Planted bug: HDF5's oldest format, where what describes the numbers has no
    checksum."""
    numbers = np.random.default_rng(3).random((12, 3, 2))
    whole = xr.Dataset({f"v{k}": (("a", "b"), of) for k, of in enumerate(numbers)})
    content, refused = netcdf(whole), 0
    for i in range(0, len(content), 97):
        bent = content[:i] + bytes([content[i] ^ 0x55]) + content[i + 1 :]
        try:
            with xr.open_dataset(io.BytesIO(bent), engine="h5netcdf") as file:
                found = file.load()
        except Exception:  # HDF5, h5netcdf and xarray each have their own
            refused += 1
            continue
        for name in set(whole) & set(found):
            np.testing.assert_array_equal(found[name], whole[name], err_msg=f"{i}, {name}")
    assert refused
