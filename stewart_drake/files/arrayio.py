"""Files of arrays: .npz and NetCDF."""

import io
import warnings
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Final

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from stewart_drake.files.errors import ConfigError
from stewart_drake.files.fileio import read_bytes, write_whole

_MAX_NPZ: Final = 10_000_000
_MAX_NC: Final = 500_000_000

Shapes = Mapping[str, tuple[str, tuple[int, ...]]]
"""Kind, as `numpy.dtype.kind`, and shape of each array."""


def load_npz(path: Path, shapes: Shapes, expected: str) -> dict[str, NDArray[Any]]:
    """Read exactly these arrays from a file of `numpy.savez`; nothing is unpickled.

    Args:
        path: of at most 10 MB.
        shapes: what it must hold.
        expected: what the file is, in words, closing every message.

    Raises:
        ConfigError: one line, opened by the path.
    """
    raw = read_bytes(path, _MAX_NPZ, expected)
    # Damage shows as exceptions of zipfile, zlib and numpy, from KeyError to NotImplementedError.
    try:
        with np.load(io.BytesIO(raw), allow_pickle=False) as file:
            if sorted(file.files) != sorted(shapes):
                raise ValueError("it does not hold the arrays that it should")
            arrays = dict(file)
        for name, wanted in shapes.items():
            found = (arrays[name].dtype.kind, arrays[name].shape)
            if found != wanted:
                raise ValueError(f"{name} is {found}, not {wanted}")
        return arrays
    except Exception as error:
        raise ConfigError(f"{path}: is damaged ({_brief(error)}); expected {expected}") from None


def load_netcdf(path: Path, expected: str) -> xr.Dataset:
    """Read a NetCDF 4 file; times stay the numbers that they are in the file.

    The HDF5 library may hang or end the process on a damaged file.

    Args:
        path: of at most 500 MB, packed and unpacked.
        expected: what the file is, in words, closing every message.

    Raises:
        ConfigError: one line, opened by the path.
    """
    raw = read_bytes(path, _MAX_NC, expected)
    # Damage shows as exceptions of three libraries, up to KeyError and RuntimeError.
    try:
        with (
            warnings.catch_warnings(),
            xr.open_dataset(
                io.BytesIO(raw), engine="h5netcdf", decode_times=False, decode_timedelta=False
            ) as file,
        ):
            warnings.simplefilter("ignore")
            if file.nbytes > _MAX_NC:
                raise ValueError(f"its arrays need more than {_MAX_NC // 1_000_000} MB")
            return file.load()
    except Exception as error:
        raise ConfigError(
            f"{path}: cannot be read ({_brief(error)}); expected {expected}"
        ) from None


def write_netcdf(path: Path, data: xr.Dataset) -> None:
    """Write NetCDF by way of a temporary file, so that no half file remains."""
    # Made in memory: HDF5 ends the process where a disk is full. Copied: a view of xarray's buffer
    # that the traceback of a failed write holds makes Python print a warning when both are freed.
    content = bytes(data.to_netcdf(engine="h5netcdf"))
    write_whole(path, content)


def _brief(error: Exception) -> str:
    """Return the text of an exception in one line."""
    text = " ".join(str(error).split()) or type(error).__name__
    return text if len(text) <= 120 else f"{text[:117]}..."
