"""Damaged files, each made from a good one by a seed: bytes that changed, parts that are others."""

import io
import json
import random
import zipfile
import zlib
from collections.abc import Callable
from typing import Any

import numpy as np
import xarray as xr

DEEP = "@@deep@@"
"""As text in a document: stands for lists inside lists, deeper than Python's own writers go."""
NASTY: tuple[Any, ...] = (
    *(None, True, False, 0, 1, -1, 7, 10**18, -(10**30), 10**400, 10**5000),
    *(0.0, -0.0, 0.5, -1.5, 1e-320, 1e308, -1e308, float("nan"), float("inf"), float("-inf")),
    *("", " ", "x", "completed", "left_workspace", "1.0", "\ud800", "\0", "a\nb", "é" * 300, DEEP),
    *([], {}, [[]], [None], {"a": 1}, {"": None}, [1.0] * 7, ["1"] * 6, {"\udfff": "\ud800"}),
)
PIECES = (
    b"\0",
    b"\xff",
    b"\xfe\xff",
    b"\n",
    b"\r",
    b'"',
    b"[",
    b"{",
    b"}",
    b"1e999",
    b"\x80",
    b",,",
)


def spoiled_bytes(raw: bytes, dice: random.Random) -> bytes:
    """Bits flipped, pieces cut, doubled, overwritten or put in, once to twenty times."""
    data = bytearray(raw)
    for _ in range(dice.choice((1, 1, 1, 2, 5, 20))):
        start = dice.randrange(len(data) + 1)
        end = min(len(data), start + dice.choice((1, 1, 4, 8, 64, 1000)))
        piece = bytes(data[start:end])
        at = dice.randrange(len(data) + 1)
        data[start:end] = dice.choice(
            (
                bytes(byte ^ 1 << dice.randrange(8) for byte in piece),
                b"",
                piece * dice.choice((2, 2, 50)),
                dice.randbytes(len(piece)),
                bytes(len(piece)),
                b"\xff" * len(piece),
                dice.choice(PIECES) + piece,
                bytes(data[at : at + len(piece)]),
            )
        )
    if dice.random() < 0.1:
        del data[dice.randrange(len(data) + 1) :]
    return bytes(data)


def spoiled_document(document: Any, dice: random.Random) -> Any:
    """One to three parts of nested dicts and lists replaced, left out, doubled or moved."""
    copy = json.loads(json.dumps(document))
    for _ in range(dice.choice((1, 1, 2, 3))):
        places = _places(copy)
        if not places:
            return dice.choice(NASTY)
        owner, key = dice.choice(places)
        what = dice.randrange(6)
        if what == 0:
            del owner[key]
        elif what == 1 and isinstance(owner, list):
            owner.insert(key, owner[key])
        elif what == 1:
            owner[dice.choice(("", "extra", "\ud800", "n" * 500, f"{key}s"))] = owner[key]
        elif what == 2:
            owner[key] = [owner[key]]
        else:
            owner[key] = dice.choice(NASTY)
    return copy if dice.random() < 0.98 else dice.choice(NASTY)


def _places(document: Any) -> list[tuple[Any, Any]]:
    """Owner and key of everything inside."""
    items: Any = document.items() if isinstance(document, dict) else ()
    items = enumerate(document) if isinstance(document, list) else items
    return [place for key, value in items for place in ((document, key), *_places(value))]


def json_bytes(document: Any, dice: random.Random) -> bytes:
    """As JSON, with NaN, halves of surrogate pairs and depths that JSON's own writers refuse."""
    depth = dice.choice((3, 40, 60, 900, 5000, 100_000))
    return _long_numbers(document).replace(f'"{DEEP}"', "[" * depth + "]" * depth).encode()


def sealed(text: bytes) -> bytes:
    """With its right checksum, so that a reader goes on to what the text says."""
    if not text.startswith(b"{"):
        return text
    return b'{"crc32": "%08x", ' % zlib.crc32(text[1:]) + text[1:]


def yaml_bytes(document: Any, dice: random.Random) -> bytes:
    """The same in YAML's words."""
    text = json_bytes(document, dice).decode()
    return (
        text.replace("-Infinity", "-.inf")
        .replace("Infinity", ".inf")
        .replace("NaN", ".nan")
        .encode()
    )


def _long_numbers(document: Any) -> str:
    """Python itself does not write more than 4300 digits."""
    text = json.dumps(_without_giants(document))
    return text.replace('"@@giant@@"', "1" * 5000)


def _without_giants(document: Any) -> Any:
    if isinstance(document, dict):
        return {key: _without_giants(value) for key, value in document.items()}
    if isinstance(document, list):
        return [_without_giants(value) for value in document]
    giant = isinstance(document, int) and abs(document) > 10**4000
    return "@@giant@@" if giant else document


class Acting:
    """Its pickle ends the process that loads it."""

    def __reduce__(self) -> Any:
        return exit, (99,)


def other_npz(good: dict[str, Any], dice: random.Random) -> bytes:
    """A sound file of numpy.savez, or nearly, that holds something else."""
    arrays = dict(good)
    for _ in range(dice.choice((1, 1, 2))):
        name = dice.choice(sorted(arrays)) if arrays else "a"
        value = np.asarray(arrays.get(name, 0.0))
        change: Callable[[], Any] = dice.choice(
            (
                lambda value=value: value.reshape(-1)[:-1],
                lambda value=value: np.stack([value, value]),
                lambda value=value: value.astype("U20"),
                lambda value=value: value.astype("S20"),
                lambda: np.array([Acting()], dtype=object),
                lambda: np.array(dice.choice((np.nan, np.inf, -np.inf, -1.0, 1e308))),
                lambda: np.array(dice.choice(("completed", "left_workspace", "", "x" * 999))),
                lambda value=value: np.full(value.shape, dice.choice((np.nan, np.inf, 0.0))),
                lambda: np.zeros((0, 0)),
                lambda: np.datetime64("2020-01-01"),
                lambda: np.zeros(3, dtype=[("a", "f8"), ("b", "O")]),
                lambda: np.zeros(300_000),
            )
        )
        arrays[name] = change()
        if dice.random() < 0.2:
            arrays.pop(name)
        if dice.random() < 0.1:
            arrays["extra"] = np.zeros(3)
    stream = io.BytesIO()
    how = dice.randrange(10)
    if how == 0:
        np.save(stream, np.asarray(next(iter(arrays.values()), 0.0)), allow_pickle=True)
    elif how == 1:
        np.savez_compressed(stream, **good)
    elif how == 2:
        return _odd_zip(good, dice)
    else:
        np.savez(stream, **arrays)
    data = bytearray(stream.getvalue())
    if dice.random() < 0.2:  # one that says it is encrypted, or packed in another way
        for mark, place in ((b"PK\1\2", 8), (b"PK\3\4", 6)):
            at = data.find(mark)
            if at >= 0:
                data[at + place + dice.choice((0, 2))] ^= dice.choice((1, 8, 12, 14))
    return bytes(data)


def _odd_zip(good: dict[str, Any], dice: random.Random) -> bytes:
    """Members twice, or one of 30 MB of zeros in a few kB, or one that declares a huge array."""
    stream, npy = io.BytesIO(), io.BytesIO()
    np.save(npy, np.asarray(good["samples"]))
    header = npy.getvalue()[:128].replace(b"(100, 18)", b"(999999,)")
    with zipfile.ZipFile(stream, "w", zipfile.ZIP_DEFLATED) as file:
        for name, value in good.items():
            npy = io.BytesIO()
            np.save(npy, np.asarray(value))
            content = npy.getvalue()
            if name == "samples":
                content = dice.choice((header + content[128:], content + bytes(30_000_000), b""))
            file.writestr(f"{name}.npy", content)
        if dice.random() < 0.3:
            file.writestr("../../outside.npy", b"x")
    return stream.getvalue()


def other_netcdf(good: xr.Dataset, dice: random.Random) -> bytes:
    """A sound NetCDF file of another structure."""
    data = good.copy(deep=True)
    for _ in range(dice.choice((1, 1, 2))):
        names = [str(name) for name in data.variables]
        if not names:
            break
        name = dice.choice(names)
        what = dice.randrange(12)
        variable = data[name]
        if what == 0:
            data = data.drop_vars(name)
        elif what == 1:
            data[name] = variable.astype(dice.choice(("U9", "S9", "i4", "f4", "bool", "complex")))
        elif what == 2:
            data[name] = variable.expand_dims(extra=2)
        elif what == 3 and variable.dims:
            data = data.rename({variable.dims[-1]: "other"})
        elif what == 4 and variable.dims:
            data = data.isel({variable.dims[0]: slice(0, dice.choice((0, 1, 3)))})
        elif what == 5:
            times = np.full(variable.shape, np.datetime64("2020-01-01", "ns"))
            data[name] = (variable.dims, times)
        elif what == 6:
            data[name] = variable.transpose()
        elif what == 7:
            key = dice.choice(("units", "scale_factor", "_FillValue", "calendar", "add_offset"))
            data[name].attrs[key] = dice.choice(("days since 0", "text", 3, 0.0, float("nan")))
        elif what == 8 and variable.dtype.kind == "f" and variable.size:
            values = variable.values.copy()
            values.flat[dice.randrange(values.size)] = dice.choice((np.nan, np.inf, -1.0, 1e308))
            data[name] = (variable.dims, values)
        elif what == 9 and variable.dims:
            data = data.isel({variable.dims[0]: slice(None, None, -1)})
        elif what == 10:
            data.attrs = {k: dice.choice(("", "{", "[]", '{"data": 3}')) for k in data.attrs}
        else:
            data[name] = 3.0
    content: Any = data.to_netcdf(engine="h5netcdf")
    return bytes(content)
