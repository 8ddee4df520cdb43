"""The compiled core, loaded once in a process through cffi, which reads its headers."""

from functools import cached_property, lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from cffi import FFI
from numpy.typing import NDArray

from stewart_drake.core.build import DECLARED, LIBRARY, declarations, source_hash
from stewart_drake.files.errors import ConfigError


def _declared(path: Path) -> Any:
    """Return the declarations that the build has read; parse the headers where it has not."""
    if path.exists():
        names: dict[str, Any] = {}
        exec(compile(path.read_text("utf-8"), path, "exec"), names)
        if names["source"] == source_hash():
            return names["ffi"]
    ffi = FFI()
    ffi.cdef(declarations())
    return ffi


class Core:
    """The library for cffi.

    Args:
        path: of the library.

    Attributes:
        ffi: creates structures.
        lib: functions and constants.
    """

    def __init__(self, path: Path = LIBRARY) -> None:
        self.ffi: Any = _declared(path.with_name(DECLARED))
        self.lib: Any = self.ffi.dlopen(str(path))
        names = {np.float64: "double[]", np.intc: "int[]"}
        self._kinds = {np.dtype(kind): self.ffi.typeof(name) for kind, name in names.items()}
        self._block = self.ffi.new_allocator(should_clear_after_alloc=False)

    @cached_property
    def symbols(self) -> dict[int, str]:
        """Names of the functions and their tables, by address."""
        names = [name for name in dir(self.lib) if name.startswith("stewart_")]
        at = {name: self.ffi.addressof(self.lib, name) for name in names}
        return {int(self.ffi.cast("intptr_t", pointer)): name for name, pointer in at.items()}

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
            raise ValueError(
                f"array: got {array.dtype}, strides {array.strides}; expected contiguous doubles "
                "or C ints"
            )
        return self.ffi.from_buffer(kind, array)

    def call(self, name: str, *given: Any) -> Any:
        """Call a function; an array is given by its address."""
        addresses = (self.at(one) if isinstance(one, np.ndarray) else one for one in given)
        return getattr(self.lib, f"stewart_{name}")(*addresses)

    def plant(self, geometry: Any, parameters: Any, gravity: Any) -> Any:
        """Return a `stewart_plant` that points to numbers of these addresses."""
        joints = self.ffi.addressof(self.lib, "stewart_ball_joints")
        return self.ffi.new("stewart_plant *", (geometry, parameters, gravity, joints))

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
