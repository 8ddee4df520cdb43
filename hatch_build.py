"""Compiles the dynamics where there is a C compiler; without one the package is pure Python."""

import importlib.util
import os
import shutil
import tempfile
from pathlib import Path
from typing import Any

from hatchling.builders.hooks.plugin.interface import BuildHookInterface
from packaging.tags import sys_tags

BUILD = "stewart_drake/native/build.py"


class NativeHook(BuildHookInterface):
    """An editable installation gets the library into the checkout, a wheel into the package."""

    folder = None

    def initialize(self, version: str, build_data: dict[str, Any]) -> None:
        """Never fails, but where STEWART_NATIVE=require."""
        wanted = os.environ.get("STEWART_NATIVE")
        if wanted == "0":
            return
        spec = importlib.util.spec_from_file_location("native_build", Path(self.root, BUILD))
        build = importlib.util.module_from_spec(spec)
        spec.loader.exec_module(build)
        target = build.LIBRARY
        if version != "editable":
            self.folder = tempfile.mkdtemp()
            target = Path(self.folder, build.LIBRARY.name)
        reason = build.compile_library(target)
        if reason is not None:
            if wanted == "require":
                raise RuntimeError(f"the dynamics cannot be compiled: {reason}")
            self.app.display_warning(f"going on without compiled dynamics: {reason}")
            return
        if version != "editable":
            place = build.LIBRARY.relative_to(self.root).as_posix()
            build_data["force_include"][str(target)] = place
        # As hatchling does: neither manylinux nor musllinux, which would be a promise.
        tags = (tag.platform for tag in sys_tags())
        platform = next(tag for tag in tags if not tag.startswith(("manylinux", "musllinux")))
        build_data["pure_python"], build_data["tag"] = False, f"py3-none-{platform}"

    def finalize(self, version: str, build_data: dict[str, Any], artifact_path: str) -> None:
        """The library is in the wheel."""
        if self.folder is not None:
            shutil.rmtree(self.folder, ignore_errors=True)
