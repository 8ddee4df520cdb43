"""The compiled core, loaded once in a process through cffi, which reads its headers."""

from functools import cached_property, lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from cffi import FFI
from numpy.typing import NDArray

from stewart_drake.core.build import DECLARED, LIBRARY, declarations, source_hash
from stewart_drake.files.errors import ConfigError


def _load_declarations(path: Path) -> Any:
    """Return the `FFI` with the declarations of the core.

    The build writes them to a module, so that no process parses the headers. Without a current
    module they are parsed here.
    """
    if path.exists():
        module: dict[str, Any] = {}
        exec(compile(path.read_text("utf-8"), path, "exec"), module)
        if module["source"] == source_hash():
            return module["ffi"]
    ffi = FFI()
    ffi.cdef(declarations())
    return ffi


class Core:
    """The compiled library.

    Args:
        path: of the shared library.

    Attributes:
        ffi: `cffi.FFI`, which creates structures and arrays of C.
        lib: functions and constants by their names in C.
    """

    def __init__(self, path: Path = LIBRARY) -> None:
        self.ffi: Any = _load_declarations(path.with_name(DECLARED))
        self.lib: Any = self.ffi.dlopen(str(path))
        names = {np.float64: "double[]", np.intc: "int[]"}
        self._pointer_types = {np.dtype(t): self.ffi.typeof(name) for t, name in names.items()}
        self._new_uncleared = self.ffi.new_allocator(should_clear_after_alloc=False)

    @cached_property
    def symbols(self) -> dict[int, str]:
        """Names of functions and tables of functions, by address."""
        names = [name for name in dir(self.lib) if name.startswith("stewart_")]
        pointers = {name: self.ffi.addressof(self.lib, name) for name in names}
        return {int(self.ffi.cast("intptr_t", at)): name for name, at in pointers.items()}

    def at(self, array: NDArray[Any] | None) -> Any:
        """Return a pointer to a contiguous array of doubles or C ints.

        The pointer keeps the array alive; its copy in a structure does not. None becomes NULL.

        Raises:
            ValueError: another type, or not contiguous.
        """
        if array is None:
            return self.ffi.NULL
        pointer_type = self._pointer_types.get(array.dtype)
        if pointer_type is None or not array.flags.c_contiguous:
            raise ValueError(
                f"array: got {array.dtype}, strides {array.strides}; expected contiguous doubles "
                "or C ints"
            )
        return self.ffi.from_buffer(pointer_type, array)

    def call(self, name: str, *arguments: Any) -> Any:
        """Call `stewart_NAME`, with arrays as pointers."""
        values = (self.at(one) if isinstance(one, np.ndarray) else one for one in arguments)
        return getattr(self.lib, f"stewart_{name}")(*values)

    def plant(self, geometry: Any, parameters: Any, gravity: Any) -> Any:
        """Return a `stewart_plant *` with these pointers, and friction of ball joints."""
        joints = self.ffi.addressof(self.lib, "stewart_ball_joints")
        return self.ffi.new("stewart_plant *", (geometry, parameters, gravity, joints))

    def scratch(self, numbers: int) -> Any:
        """Return a `stewart_scratch` of `numbers` numbers, for one call."""
        return [self._new_uncleared("real[]", numbers)]


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
