"""The compiled core: found, checked and loaded once in a process."""

import ctypes
from functools import lru_cache

from stewart_drake.files.errors import ConfigError
from stewart_drake.native.build import LIBRARY, source_hash


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
        f"the compiled core {problem}; expected one that python -m stewart_drake.native.build made"
    )
