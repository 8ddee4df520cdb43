"""Files of arrays: .npz and NetCDF."""

import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from stewart_drake.files.errors import ConfigError
from stewart_drake.files.fileio import write_whole

Shapes = Mapping[str, tuple[str, tuple[int, ...]]]
"""Kind, as `numpy.dtype.kind`, and shape of each array."""


def load_npz(path: Path, shapes: Shapes, expected: str) -> dict[str, NDArray[Any]]:
    """Read exactly these arrays from a file of `numpy.savez`; nothing is unpickled."""
    try:
        with np.load(path, allow_pickle=False) as file:
            arrays = dict(file)
    except Exception as error:  # from zipfile, zlib and numpy
        raise _unreadable(path, error, expected) from None
    if {name: (array.dtype.kind, array.shape) for name, array in arrays.items()} != shapes:
        raise ConfigError(
            f"{path}: has arrays of other names, kinds or shapes; expected {expected}"
        )
    return arrays


def load_netcdf(path: Path, expected: str) -> xr.Dataset:
    """Read a NetCDF 4 file; times stay the numbers that they are in the file.

    The HDF5 library may hang or end the process on a damaged file.
    """
    try:
        return xr.load_dataset(path, engine="h5netcdf", decode_times=False, decode_timedelta=False)
    except Exception as error:  # from three libraries
        raise _unreadable(path, error, expected) from None


def write_netcdf(path: Path, data: xr.Dataset) -> None:
    """Write NetCDF by way of a temporary file, so that no half file remains."""
    # Made in memory: HDF5 ends the process where a disk is full. Copied: a view of xarray's buffer
    # that the traceback of a failed write holds makes Python print a warning when both are freed.
    write_whole(path, bytes(data.to_netcdf(engine="h5netcdf")))


def _unreadable(path: Path, error: Exception, expected: str) -> ConfigError:
    number = error.errno if isinstance(error, OSError) else None
    problem = os.strerror(number) if number else "it is damaged, or of another kind"
    return ConfigError(f"{path}: cannot be read ({problem}); expected {expected}")
