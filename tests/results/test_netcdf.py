"""What is written as NetCDF comes back, and a bent byte shows no other numbers."""

from __future__ import annotations

import io

import numpy as np
import pytest
import xarray as xr

from isac_rt.results.files import read_dataset, write_dataset


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


def test_it_reads_back_as_it_was(dataset, tmp_path):
    """Values, types, attributes and coordinates, compressed and with checksums. Planted bugs: words
    encoded as numbers are; an encoding that a variable was read with kept."""
    write_dataset(dataset, tmp_path / "one.nc")
    found = read_dataset(tmp_path / "one.nc")
    write_dataset(found, tmp_path / "two.nc")
    assert found.identical(dataset) and read_dataset(tmp_path / "two.nc").identical(dataset)
    for name in dataset.variables:
        words = dataset[name].dtype.kind in "OU"
        assert words or found[name].dtype == dataset[name].dtype, name
    assert found.level.encoding["zlib"] and found.level.encoding["fletcher32"]


@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")  # refused files
def test_a_bent_byte_shows_no_other_numbers(tmp_path):
    """Every 197th byte of a file of 12 variables bent, one at a time: the file is refused or says
    what it said. Planted bug: HDF5's oldest format, where what describes the numbers has no
    checksum."""
    numbers = np.random.default_rng(3).random((12, 3, 2))
    whole = xr.Dataset({f"v{k}": (("a", "b"), of) for k, of in enumerate(numbers)})
    write_dataset(whole, tmp_path / "whole.nc")
    content, refused = (tmp_path / "whole.nc").read_bytes(), 0
    for i in range(0, len(content), 197):
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
