"""Builds the compiled core: generated text where it is missing, then the library."""

import importlib.util
import shutil
import tempfile
from pathlib import Path
from typing import Any

from hatchling.builders.hooks.plugin.interface import BuildHookInterface
from packaging.tags import sys_tags

GENERATOR = ["casadi==3.8.2", "cffi>=1.16", "numpy>=2", "pydantic>=2", "ruamel.yaml>=0.18"]
READER = ["cffi>=1.16"]
COMPILER = ["ziglang==0.17.1"]


class CoreHook(BuildHookInterface):
    """An editable installation gets the library into the checkout, a wheel into the package."""

    folder = None

    @property
    def build(self) -> Any:
        """The module core/build.py, loaded by its path."""
        path = Path(self.root, "stewart_drake/core/build.py")
        spec = importlib.util.spec_from_file_location("core_build", path)
        module = importlib.util.module_from_spec(spec)
        spec.loader.exec_module(module)
        return module

    def dependencies(self) -> list[str]:
        """Return what the build needs and does not find: the generator's packages, a compiler."""
        needed = [] if self.build.is_generated() else [*GENERATOR]
        if self.target_name == "wheel":
            needed += READER + ([] if self.build.system_compiler() else COMPILER)
        return needed

    def initialize(self, version: str, build_data: dict[str, Any]) -> None:
        """Generate and compile.

        Raises:
            RuntimeError: the library cannot be compiled.
        """
        build = self.build
        if not build.is_generated():
            build.generate()
        if self.target_name != "wheel":
            return
        target = build.LIBRARY
        if version != "editable":
            self.folder = tempfile.mkdtemp()
            target = Path(self.folder, build.LIBRARY.name)
        reason = build.compile_library(target)
        if reason is not None:
            raise RuntimeError(f"the core cannot be compiled: {reason}")
        if version != "editable":
            for part in Path(self.folder).iterdir():
                place = build.LIBRARY.with_name(part.name).relative_to(self.root).as_posix()
                build_data["force_include"][str(part)] = place
        # As hatchling does: neither manylinux nor musllinux, which would be a promise.
        tags = (tag.platform for tag in sys_tags())
        platform = next(tag for tag in tags if not tag.startswith(("manylinux", "musllinux")))
        build_data["pure_python"], build_data["tag"] = False, f"py3-none-{platform}"

    def finalize(self, version: str, build_data: dict[str, Any], artifact_path: str) -> None:
        """Remove the library that is in the wheel now."""
        if self.folder is not None:
            shutil.rmtree(self.folder, ignore_errors=True)
