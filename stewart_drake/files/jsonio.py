"""JSON, strict to read: one object, every key once, finite numbers, text that is text.

Written whole or not at all, with null for a number that is not finite.
"""

import json
import math
import re
import zlib
from collections import Counter
from pathlib import Path
from typing import Any, Final, NoReturn

import numpy as np

from stewart_drake.files.errors import ConfigError
from stewart_drake.files.fileio import read_bytes, replacing
from stewart_drake.files.yamlio import brief

_MAX_DEPTH: Final = 50
_SEAL: Final = re.compile(rb'\{"crc32": "([0-9a-f]{8})", ')


def load_json(path: Path, most: int, expected: str, *, sealed: bool = False) -> dict[str, Any]:
    """Reads one JSON object from a file; nothing in it is executed.

    Args:
        path: a UTF-8 file.
        most: number of bytes above which it is refused.
        expected: what the file is, in words, closing every message.
        sealed: whether it must have the checksum that `sealed_json` writes, which is checked and
            not returned.

    Raises:
        ConfigError: the file cannot be read or decoded, is not one object, or holds a key twice, a
            number that is not finite, half a surrogate pair or something nested deeper than 50
            levels. One line, opened by the path.
    """
    raw = read_bytes(path, most, expected)
    if sealed:
        seal = _SEAL.match(raw)
        if seal is None:
            raise ConfigError(
                f"{path}: has no checksum, which files of 0.2 lack too; expected {expected}"
            )
        raw = raw[seal.end() :]
        if zlib.crc32(raw) != int(seal[1], 16):
            raise ConfigError(f"{path}: is damaged, its checksum differs; expected {expected}")
        raw = b"{" + raw
    try:
        data = json.loads(
            raw.decode("utf-8"),
            parse_constant=_no_constant,
            parse_float=_finite,
            object_pairs_hook=_unique,
        )
        _check(data)
    except UnicodeDecodeError:
        raise ConfigError(f"{path}: is not UTF-8 text; expected {expected}") from None
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
    text = json.dumps(jsonable(data), indent=2, allow_nan=False)
    with replacing(path) as partial:
        partial.write_text(text + "\n")


def jsonable(data: Any) -> Any:
    """Plain JSON values: arrays as lists, non-finite numbers as None."""
    if isinstance(data, dict):
        return {str(key): jsonable(value) for key, value in data.items()}
    if isinstance(data, (list, tuple, np.ndarray)):
        return [jsonable(value) for value in data]
    if isinstance(data, (float, np.floating)):
        return float(data) if np.isfinite(data) else None
    return data.item() if isinstance(data, np.generic) else data


def _no_constant(name: str) -> NoReturn:
    raise ValueError(f"{name} is not a number that JSON has")


def _finite(text: str) -> float:
    value = float(text)
    if not math.isfinite(value):
        raise ValueError(f"{brief(text)} is larger than any float")
    return value


def _unique(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    for key, number in Counter(key for key, _ in pairs).items():
        if number > 1:
            raise ValueError(f"key {brief(key)} given {number} times")
    return dict(pairs)


def _check(data: Any) -> None:
    """Refuse depth and half surrogate pairs, which whatever writes the data again trips over."""
    todo = [(data, 1)]
    while todo:
        value, depth = todo.pop()
        if depth > _MAX_DEPTH:
            raise ValueError("nested too deep")
        if isinstance(value, dict):
            todo += [(item, depth + 1) for pair in value.items() for item in pair]
        elif isinstance(value, list):
            todo += [(item, depth + 1) for item in value]
        elif isinstance(value, str) and any("\ud800" <= letter <= "\udfff" for letter in value):
            raise ValueError(f"{brief(value)} holds half a surrogate pair")
