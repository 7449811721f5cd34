"""A labelled dataset as the bytes of a NetCDF-4 file: HDF5 whose dimensions are dimension scales.

Written by h5py alone. Libraries between it and the dataset look every variable up in the file again
and again: they take 5 ms for each of the hundreds that a run has.

References
----------
NetCDF Users Guide, "File structure and performance", appendix C: the netCDF-4 format on HDF5.
"""

from __future__ import annotations

import io
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    import h5py
    import xarray as xr

_NO_VARIABLE = "This is a netCDF dimension but not a netCDF variable."
"""Begins the name of a dimension's scale that holds no coordinates; its size ends it."""
_CLASHES = "_nc4_non_coord_"
"""Before the name of a variable that a dimension has too."""
_NUMBER, _COORDINATES = "_Netcdf4Dimid", "_Netcdf4Coordinates"
"""The number of a scale's dimension, or of a variable's first one; and the numbers of all."""
_FORMAT = "v110", "v110"
"""HDF5 1.10's, of 2016: what describes the numbers has checksums as they have. In older ones a bent
byte may lead to another variable's, and files are longer."""
_PACKED = {"compression": "gzip", "compression_opts": 4, "shuffle": True, "fletcher32": True}


def netcdf(dataset: xr.Dataset) -> bytes:
    """The file of a dataset, compressed and with checksums.

    Variables hold numbers, truth values or words; dates and missing words have no place in it. NaN
    is the fill value of floats. Booleans are bytes that say so, and coordinates without a dimension
    of their own are named by the attribute ``coordinates``, both as xarray reads them.
    """
    import h5py

    made = io.BytesIO()
    with h5py.File(made, "w", track_order=True, libver=_FORMAT) as file:
        properties = f"version=2,h5py={h5py.__version__},hdf5={h5py.version.hdf5_version}"
        file.attrs["_NCProperties"] = np.bytes_(properties)
        _describe(file, dataset.attrs)
        numbers = {str(dim): i for i, dim in enumerate(dataset.sizes)}
        named = {str(name): variable for name, variable in dataset.variables.items()}
        apart = {str(k): {*c.dims} for k, c in dataset.coords.items() if k not in numbers}
        for dim, number in numbers.items():
            size = dataset.sizes[dim]
            if dim in named and named[dim].dims == (dim,):
                scale, title = _variable(file, dim, named.pop(dim)), dim
                scale.attrs[_COORDINATES] = np.array([number], np.int32)
            else:
                scale = file.create_dataset(dim, (size,), ">f4", track_order=True)
                title = f"{_NO_VARIABLE}{size:10}"
            scale.make_scale(title)
            scale.attrs[_NUMBER] = np.int32(number)
        for name, variable in named.items():
            values = _variable(file, f"{_CLASHES * (name in numbers)}{name}", variable)
            dims = [str(dim) for dim in variable.dims]
            if dims:
                values.attrs[_COORDINATES] = np.array([numbers[dim] for dim in dims], np.int32)
                values.attrs[_NUMBER] = np.int32(numbers[dims[0]])
            for dim, along in zip(dims, values.dims, strict=True):
                along.attach_scale(file[dim])
            located = [other for other, along in apart.items() if along <= {*dims}]
            if located and name not in apart:
                values.attrs["coordinates"] = " ".join(located)
    return made.getvalue()


def _variable(file: h5py.File, name: str, variable: xr.Variable) -> h5py.Dataset:
    """The values of a variable and what is said of them, without its dimensions."""
    import h5py

    values, said = np.asarray(variable.values), dict(variable.attrs)
    options: dict[str, Any] = {}
    if values.dtype.kind in "OU":
        values = values.astype(h5py.string_dtype())
    elif values.ndim and values.size:  # words cannot be filtered
        options |= _PACKED
    if values.dtype == bool:
        values, said["dtype"] = values.astype(np.int8), "bool"
    if values.dtype.kind == "f":
        options["fillvalue"] = said["_FillValue"] = values.dtype.type(np.nan)
    made = file.create_dataset(name, data=values, track_order=True, **options)
    _describe(made, said)
    return made


def _describe(of: h5py.Dataset | h5py.File, attributes: Any) -> None:
    """Attributes: words and lists as they are, single numbers as arrays of one."""
    for name, value in attributes.items():
        of.attrs[name] = value if isinstance(value, str | list | tuple) else np.atleast_1d(value)
