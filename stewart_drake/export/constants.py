"""Structures of the core as initialisers of C."""

from collections.abc import Iterable
from typing import Any

import numpy as np

from stewart_drake.core.library import core
from stewart_drake.law.compiled import address_of
from stewart_drake.types import ArrayLike


class Constants:
    """Initialisers of structures, and definitions of the data that they point to.

    Args:
        keep: these arrays and C structures.
        tables: names of the core's tables of functions, by address.
        suffix: of a number, `f` in single precision.

    Attributes:
        before: the definitions.
    """

    def __init__(self, keep: Iterable[Any], tables: dict[int, str], suffix: str) -> None:
        self._tables, self._suffix = tables, suffix
        self._arrays, self._structures = {}, {}
        for kept in keep:
            if isinstance(kept, np.ndarray):
                self._arrays[kept.ctypes.data] = kept
            else:
                self._structures[address_of(kept)] = kept
        self.before: list[str] = []

    def struct(self, data: Any, about: str) -> str:
        """Return the initialiser of a structure."""
        fields = core().ffi.typeof(data).fields
        parts = (
            f".{name} = {self._value(getattr(data, name), field.type, f'{about}_{name}')}"
            for name, field in fields
        )
        return "{" + ", ".join(parts) + "}"

    def _value(self, value: Any, kind: Any, about: str) -> str:
        if kind.kind == "struct":
            return self.struct(value, about)
        if kind.kind == "array":
            return "{" + ", ".join(self._value(v, kind.item, about) for v in value) + "}"
        if kind.kind == "pointer":
            return self._pointed(value, about)
        return number(value, self._suffix) if kind.cname == "double" else str(int(value))

    def _pointed(self, value: Any, about: str) -> str:
        """Return the initialiser of a pointer, and define its target."""
        address = address_of(value)
        if address == 0:
            return "0"
        if address in self._tables:
            return f"&{self._tables[address]}"
        if address in self._arrays:
            values = numbers(self._arrays[address].ravel(), self._suffix)
            self.before.append(f"static const real {about}[] = {values};")
            return about
        pointer = self._structures[address]
        kind = core().ffi.typeof(pointer).item.cname
        text = self.struct(pointer[0], about)
        self.before.append(f"static const {kind} {about} = {text};")
        return f"&{about}"


def numbers(values: ArrayLike, suffix: str) -> str:
    """Return numbers in braces, or one number alone."""
    array = np.asarray(values, dtype=np.float64)
    found = [number(value, suffix) for value in array.ravel().tolist()]
    return found[0] if array.ndim == 0 else f"{{{', '.join(found)}}}"


def number(value: float, suffix: str) -> str:
    """Return a number, exact."""
    if not np.isfinite(value):
        return "NAN" if np.isnan(value) else "INFINITY" if value > 0 else "-INFINITY"
    return f"{value!r}{suffix}"
