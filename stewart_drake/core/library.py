"""The compiled core, loaded once in a process through cffi, which reads its headers."""

import re
from functools import lru_cache
from pathlib import Path
from typing import Any, Final

import numpy as np
from cffi import FFI
from numpy.typing import NDArray

from stewart_drake.core.build import FOLDER, LIBRARY, source_hash
from stewart_drake.files.errors import ConfigError

SOURCE_ONLY_HEADERS: Final = (
    *("real.h", "equations.h", "dop853.h", "dop853_table.h"),
    *("filter_attempt.h", "legs.h", "short.h"),
)
"""Headers that Python does not use."""


def declarations() -> str:
    """Return the declarations of the headers, without directives but for integer constants.

    cffi reads only `#define NAME 123`; a header writes any other constant as an enum.
    """
    headers: dict[str, str] = {}
    for path in sorted(FOLDER.glob("*.h")):
        _include(path.name, headers)
    text = "\n".join(headers.values())
    text = re.sub(r"/\*.*?\*/", "", text, flags=re.DOTALL)
    text = re.sub(r"^static inline .*?^}\n", "", text, flags=re.DOTALL | re.MULTILINE)
    text = re.sub(r"\brestrict\b|(?<=extern )const", "", text)
    lines = (line for line in text.splitlines() if not _is_directive(line))
    return "typedef double real;\n" + "\n".join(lines)


def _include(name: str, headers: dict[str, str]) -> None:
    """Add a header to the others, after those that it includes."""
    if name in headers or name in SOURCE_ONLY_HEADERS:
        return
    text = (FOLDER / name).read_text("utf-8")
    for included in re.findall(r'^#include "(.*)"', text, re.MULTILINE):
        _include(included, headers)
    headers.setdefault(name, text)


def _is_directive(line: str) -> bool:
    return line.startswith("#") and not re.fullmatch(r"#define \w+ +\d+ *", line)


class Core:
    """The library for cffi.

    Args:
        path: of the library.

    Attributes:
        ffi: creates structures.
        lib: functions and constants.
    """

    def __init__(self, path: Path = LIBRARY) -> None:
        self.ffi: Any = FFI()
        self.ffi.cdef(declarations())
        self.lib: Any = self.ffi.dlopen(str(path))
        names = {np.float64: "double[]", np.intc: "int[]"}
        self._kinds = {np.dtype(kind): self.ffi.typeof(name) for kind, name in names.items()}
        self._block = self.ffi.new_allocator(should_clear_after_alloc=False)

    def at(self, array: NDArray[Any] | None) -> Any:
        """Return a pointer to a contiguous array of doubles or C ints.

        The pointer keeps the array alive; a copy of it in a structure does not.

        Raises:
            ValueError: other numbers, or not contiguous.
        """
        if array is None:
            return self.ffi.NULL
        kind = self._kinds.get(array.dtype)
        if kind is None or not array.flags.c_contiguous:
            raise ValueError(f"array: got {array.dtype}; expected contiguous doubles or C ints")
        return self.ffi.from_buffer(kind, array)

    def call(self, name: str, *given: Any) -> Any:
        """Call a function; an array is given by its address."""
        addresses = (self.at(one) if isinstance(one, np.ndarray) else one for one in given)
        return getattr(self.lib, f"stewart_{name}")(*addresses)

    def plant(self, geometry: Any, parameters: Any, gravity: Any) -> Any:
        """Return a `stewart_plant` that points to numbers of these addresses."""
        return self.ffi.new("stewart_plant *", (geometry, parameters, gravity))

    def scratch(self, numbers: int) -> Any:
        """Return a `stewart_scratch` with `numbers` numbers, for one call."""
        return [self._block("real[]", numbers)]


@lru_cache(maxsize=1)
def core() -> Core:
    """Load the library.

    Raises:
        ConfigError: it is missing, was built from other source, or cannot be loaded.
    """
    problem = "is missing"
    if LIBRARY.exists():
        try:
            loaded = Core(LIBRARY)
            if loaded.ffi.string(loaded.lib.stewart_source()).decode() == source_hash():
                return loaded
            problem = "was built from other source"
        except (OSError, AttributeError) as error:
            problem = f"cannot be loaded ({error})"
    raise ConfigError(f"the compiled core {problem}; run: python -m stewart_drake.core.build")
