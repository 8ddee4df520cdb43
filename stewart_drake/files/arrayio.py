"""Files of arrays, .npz and NetCDF, read so that a damaged one costs neither memory nor time.

An .npz is looked through before anything is unpacked. NetCDF 4 is HDF5, whose library runs into
endless loops on some damaged files (three in a thousand with a few bytes flipped), which nothing
within a process can end: another process tries each file first.
"""

import io
import subprocess
import sys
import warnings
import zipfile
import zlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Final

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from stewart_drake.files.errors import ConfigError
from stewart_drake.files.fileio import read_bytes, replacing

_MAX_NPZ: Final = 10_000_000
_MAX_NC: Final = 500_000_000
_MAX_HEADER: Final = 1000
"""Bytes of the text in which a .npy file says what it holds."""
_SECONDS: Final = 5
"""Of computing that trying a NetCDF file may take, and one more for each 10 MB."""
_TRIAL: Final = Path(__file__).with_name("hdf5_trial.py")

Shapes = Mapping[str, tuple[str, tuple[int, ...]]]
"""Of each array the kind, as `numpy.dtype.kind`, and the shape."""


def load_npz(path: Path, shapes: Shapes, expected: str) -> dict[str, NDArray[Any]]:
    """Reads exactly these arrays from a file of `numpy.savez`; nothing is unpickled.

    Args:
        path: of at most 10 MB, packed and unpacked.
        shapes: what it must hold.
        expected: what the file is, in words, closing every message.

    Raises:
        ConfigError: one line, opened by the path.
    """
    raw = read_bytes(path, _MAX_NPZ, expected)
    try:
        with zipfile.ZipFile(io.BytesIO(raw)) as file:
            names = sorted(one.filename for one in file.infolist())
            if names != sorted(f"{name}.npy" for name in shapes):
                raise ValueError("it does not hold the arrays that it should")
            if sum(one.file_size for one in file.infolist()) > _MAX_NPZ:
                raise ValueError("it is too large when unpacked")
            return {name: _array(file, name, *shapes[name]) for name in shapes}
    # What zipfile raises for an encrypted member is a RuntimeError, for an unknown packing a
    # NotImplementedError; numpy's own reader of headers trips over some that are nested.
    except (
        *(OSError, EOFError, ValueError, KeyError, RuntimeError, TypeError, SyntaxError),
        *(MemoryError, IndexError, OverflowError, zipfile.BadZipFile, zlib.error),
    ) as error:
        raise ConfigError(f"{path}: is damaged ({_brief(error)}); expected {expected}") from None


def _array(file: zipfile.ZipFile, name: str, kind: str, shape: tuple[int, ...]) -> NDArray[Any]:
    """One array, whose header is compared with what is wanted before room is made for it."""
    with file.open(f"{name}.npy") as member:
        # The size that is declared may be wrong: no more than it is ever unpacked.
        packed = member.read(_MAX_NPZ + 1)
    stream = io.BytesIO(packed)
    version = np.lib.format.read_magic(stream)
    read_header = {
        (1, 0): np.lib.format.read_array_header_1_0,
        (2, 0): np.lib.format.read_array_header_2_0,
    }
    if version not in read_header:
        raise ValueError(f"{name} has a header of an unknown version")
    found, _, dtype = read_header[version](stream, max_header_size=_MAX_HEADER)
    room = len(packed) - stream.tell()
    if dtype.kind != kind or found != shape or dtype.itemsize * int(np.prod(shape)) != room:
        raise ValueError(f"{name} is {dtype} {found}, not {kind} {shape}")
    stream.seek(0)
    array: NDArray[Any] = np.lib.format.read_array(stream, allow_pickle=False)
    return array


def load_netcdf(path: Path, expected: str) -> xr.Dataset:
    """Reads a NetCDF 4 file; times stay the numbers that they are in the file.

    Args:
        path: of at most 500 MB, packed and unpacked.
        expected: what the file is, in words, closing every message.

    Raises:
        ConfigError: one line, opened by the path.
    """
    raw = read_bytes(path, _MAX_NC, expected)
    problem = _tried(raw)
    if problem is None:
        # Of what is broken in it each of three libraries says by exceptions of its own, up to
        # KeyError and RuntimeError.
        try:
            with (
                warnings.catch_warnings(),
                xr.open_dataset(
                    io.BytesIO(raw), engine="h5netcdf", decode_times=False, decode_timedelta=False
                ) as file,
            ):
                warnings.simplefilter("ignore")
                return file.load()
        except Exception as error:
            problem = _brief(error)
    raise ConfigError(f"{path}: cannot be read ({problem}); expected {expected}")


def write_netcdf(path: Path, data: xr.Dataset) -> None:
    """Write NetCDF by way of a temporary file, so that no half file remains."""
    # Made in memory: HDF5 ends the process where a disk is full. Copied: a view of xarray's buffer
    # that the traceback of a failed write holds makes Python print a warning when both are freed.
    content = bytes(data.to_netcdf(engine="h5netcdf"))
    with replacing(path) as partial:
        partial.write_bytes(content)


def _tried(raw: bytes) -> str | None:
    """Let a process of its own read a NetCDF file: what is wrong, or None."""
    seconds = _SECONDS + len(raw) // 10_000_000
    try:
        done = subprocess.run(
            # -P: the package's own folder is no place to look for modules.
            [sys.executable, "-P", str(_TRIAL), str(seconds), str(_MAX_NC)],
            input=raw,
            capture_output=True,
            timeout=20 * seconds,  # on a busy machine; what is counted there is computing time
        )
    except subprocess.TimeoutExpired:
        return "it is damaged, reading it does not end"
    if done.returncode == 0:
        return None
    if done.returncode == 1:
        return done.stdout.decode(errors="replace").strip()
    return "it is damaged, the HDF5 library does not get through it"


def _brief(error: Exception) -> str:
    """What an exception says, in one line."""
    text = " ".join(str(error).split()) or type(error).__name__
    return text if len(text) <= 120 else f"{text[:117]}..."
