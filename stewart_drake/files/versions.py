"""Versions that a result depends on."""

import platform
from functools import cache
from importlib.metadata import version

_version = cache(version)  # read from files, which takes ms


def versions() -> dict[str, str]:
    packages = ("stewart-drake", "drake", "numpy", "scipy")
    return {"python": platform.python_version()} | {name: _version(name) for name in packages}
