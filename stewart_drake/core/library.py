"""The compiled core: found, checked and loaded once in a process.

`core_library` is the library for ctypes, whose functions take packed buffers. `core` is the same
library for cffi, which reads the declarations in the headers themselves.
"""

import ctypes
import re
from functools import lru_cache
from typing import Any, Final

import numpy as np
from cffi import FFI
from numpy.typing import NDArray

from stewart_drake.core.build import FOLDER, LIBRARY, source_hash
from stewart_drake.files.errors import ConfigError

PRIVATE: Final = (
    *("real.h", "equations.h", "dop853.h", "dop853_table.h"),
    *("filter_attempt.h", "observing.h", "delay_observing.h"),
)
"""Headers that Python does not call."""


@lru_cache(maxsize=1)
def core_library() -> ctypes.CDLL:
    """Load the library.

    Raises:
        ConfigError: it is missing, older than its source, or cannot be loaded.
    """
    problem = "is missing"
    if LIBRARY.exists():
        try:
            library = ctypes.CDLL(str(LIBRARY))
            library.source.restype = ctypes.c_char_p
            if library.source().decode() == source_hash():
                return library
            problem = "is older than its source"
        except (OSError, AttributeError) as error:
            problem = f"cannot be loaded ({error})"
    raise ConfigError(
        f"the compiled core {problem}; expected one that python -m stewart_drake.core.build made"
    )


def declarations() -> str:
    """Return what the headers declare, without directives but for whole numbers.

    A size that is a sum is an enumeration constant in a header, not a macro.
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
    if name in headers or name in PRIVATE:
        return
    text = (FOLDER / name).read_text("utf-8")
    for included in re.findall(r'^#include "(.*)"', text, re.MULTILINE):
        _include(included, headers)
    headers.setdefault(name, text)


def _is_directive(line: str) -> bool:
    return line.startswith("#") and not re.fullmatch(r"#define \w+ +\d+ *", line)


class Core:
    """The library for cffi.

    Attributes:
        ffi: makes its structures.
        lib: its functions.
    """

    def __init__(self) -> None:
        core_library()  # which says what is wrong with it
        self.ffi: Any = FFI()
        self.ffi.cdef(declarations())
        self.lib: Any = self.ffi.dlopen(str(LIBRARY))
        self._block = self.ffi.new_allocator(should_clear_after_alloc=False)

    def at(self, array: NDArray[Any] | None) -> Any:
        """Return the numbers of a contiguous array of doubles or C ints, which it keeps alive.

        A structure that points to them does not.

        Raises:
            ValueError: other numbers, or not contiguous.
        """
        if array is None:
            return self.ffi.NULL
        kind = {np.dtype(np.float64): "double[]", np.dtype(np.intc): "int[]"}.get(array.dtype)
        if kind is None or not array.flags.c_contiguous:
            raise ValueError(f"array: got {array.dtype}; expected contiguous doubles or C ints")
        return self.ffi.from_buffer(kind, array)

    def scratch(self, numbers: int) -> Any:
        """Return a `stewart_scratch` of so many numbers, for one call."""
        return [self._block("real[]", numbers)]


@lru_cache(maxsize=1)
def core() -> Core:
    """Load the library for cffi.

    Raises:
        ConfigError: see `core_library`.
    """
    return Core()
