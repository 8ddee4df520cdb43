"""What a result depends on beside its scenario."""

import platform
from importlib.metadata import version


def versions() -> dict[str, str]:
    """Versions of what a result depends on."""
    packages = ("stewart-drake", "drake", "casadi", "numpy", "scipy")
    return {"python": platform.python_version()} | {name: version(name) for name in packages}
