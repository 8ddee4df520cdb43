"""JSON: one object with every key once, written whole or not at all, NaN and infinity as null."""

import json
import re
import zlib
from collections import Counter
from pathlib import Path
from typing import Any, Final

import numpy as np

from stewart_drake.files.errors import ConfigError
from stewart_drake.files.fileio import read_bytes, write_whole
from stewart_drake.files.yamlio import brief

_SEAL: Final = re.compile(rb'\{"crc32": "([0-9a-f]{8})", ')


def load_json(path: Path, most: int, expected: str, *, sealed: bool = False) -> dict[str, Any]:
    """Read one JSON object from a UTF-8 file; `most` and `expected` are as of `read_bytes`.

    A `sealed` one must have the checksum that `sealed_json` writes, which is not returned.

    Raises:
        ConfigError: the file cannot be read or decoded, is not one object, or holds a key twice.
            One line, opened by the path.
    """
    raw = read_bytes(path, most, expected)
    if sealed:
        seal = _SEAL.match(raw)
        if seal is None:
            problem = "has no checksum, as files of 0.2"
            raise ConfigError(f"{path}: {problem}; expected {expected}")
        raw = raw[seal.end() :]
        if zlib.crc32(raw) != int(seal[1], 16):
            raise ConfigError(f"{path}: is damaged, its checksum differs; expected {expected}")
        raw = b"{" + raw
    try:
        data = json.loads(raw.decode(), object_pairs_hook=_unique)
    except (ValueError, RecursionError) as error:
        problem = "nested too deep" if isinstance(error, RecursionError) else str(error)
        raise ConfigError(
            f"{path}: is not readable as JSON ({problem}); expected {expected}"
        ) from None
    if not isinstance(data, dict):
        raise ConfigError(f"{path}: holds {brief(data)}; expected a JSON object, {expected}")
    return data


def sealed_json(data: dict[str, Any]) -> bytes:
    """Return a JSON object whose first key is a checksum of the rest."""
    rest = json.dumps(jsonable(data), allow_nan=False).encode()[1:]
    return b'{"crc32": "%08x", ' % zlib.crc32(rest) + rest


def write_json(path: Path, data: Any) -> None:
    """Write JSON with NaN as null, by way of a temporary file, so that no half file remains."""
    write_whole(path, json.dumps(jsonable(data), indent=2, allow_nan=False) + "\n")


def jsonable(data: Any) -> Any:
    """Return plain JSON values: arrays as lists, non-finite numbers as None."""
    if isinstance(data, dict):
        return {str(key): jsonable(value) for key, value in data.items()}
    if isinstance(data, (list, tuple, np.ndarray)):
        return [jsonable(value) for value in data]
    if isinstance(data, (float, np.floating)):
        return float(data) if np.isfinite(data) else None
    return data.item() if isinstance(data, np.generic) else data


def _unique(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    data = dict(pairs)
    if len(data) < len(pairs):
        twice, _ = Counter(key for key, _ in pairs).most_common(1)[0]
        raise ValueError(f"key {brief(twice)} given more than once")
    return data
