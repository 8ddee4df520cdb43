"""The compiled dynamics, where they are: found, checked and loaded once in a process."""

import ctypes
import os
from functools import lru_cache
from typing import Final, NamedTuple

from stewart_drake.files.errors import ConfigError
from stewart_drake.native.build import LIBRARY, source_hash

SWITCH: Final = "STEWART_NATIVE"
"""Of the environment: `0` is CasADi's virtual machine, `require` an error without the library."""


class Backend(NamedTuple):
    """What runs the dynamics: `native` or `casadi`, the latter with no library, and why."""

    name: str
    library: ctypes.CDLL | None = None
    reason: str = ""

    def __str__(self) -> str:
        return self.name + (f" ({self.reason})" if self.reason else "")


@lru_cache(maxsize=1)
def backend() -> Backend:
    """What this process uses.

    Raises:
        ConfigError: STEWART_NATIVE is none of its values, or requires what there is not.
    """
    wanted = os.environ.get(SWITCH, "")
    if wanted not in ("", "0", "require"):
        raise ConfigError(
            f"{SWITCH}: got {wanted!r}; expected 0 for CasADi's virtual machine, require for the "
            "compiled dynamics, or nothing for the best that there is"
        )
    if wanted == "0":
        return Backend("casadi", reason=f"{SWITCH}=0")
    found = _load()
    if wanted == "require" and found.library is None:
        raise ConfigError(
            f"{SWITCH}: got 'require', but {found.reason}; expected a C compiler and then "
            "python -m stewart_drake.native.build"
        )
    return found


def _load() -> Backend:
    if not LIBRARY.exists():
        return Backend("casadi", reason="the dynamics are not compiled here")
    try:
        library = ctypes.CDLL(str(LIBRARY))
        library.source.restype = ctypes.c_char_p
        source = library.source()
    except (OSError, AttributeError) as error:
        return Backend("casadi", reason=f"the compiled dynamics cannot be loaded: {error}")
    if source.decode() != source_hash():
        return Backend("casadi", reason="the compiled dynamics are older than their source")
    return Backend("native", library)
