"""Where the shipped mechanisms, scenarios, controllers and tuner weights are found.

A word is a shipped name; anything with a slash, or ending in `.yaml`, `.yml` or `.json`, is a path.
"""

import os
from pathlib import Path
from typing import Final, Literal

from stewart_drake.files.errors import ConfigError, resembling

Kind = Literal["mechanism", "scenario", "controller", "overlay", "weights"]

KINDS: Final[dict[Kind, str]] = {
    "mechanism": "mechanisms",
    "scenario": "scenarios",
    "controller": "controllers",
    "overlay": "overlays",
    "weights": "tuner weights",
}
"""What there is of shipped data, and its plural."""

_PACKAGE: Final = Path(__file__).resolve().parents[1]
_PLACES: Final[dict[Kind, tuple[str, str]]] = {
    "mechanism": ("models", ".yaml"),
    "scenario": ("diagrams/scenarios", ".yaml"),
    "controller": ("diagrams/controllers", ".yaml"),
    "overlay": ("diagrams/overlays", ".yaml"),
    "weights": ("models/weights", ".json"),
}


def data_root() -> Path:
    """The folder that holds `models/` and `diagrams/`.

    A wheel carries the data inside the package; a checkout or an editable install has them beside
    it. The package is looked at first, since a neighbour in site-packages may also be `models`.
    """
    packaged = _PACKAGE / "_data"
    return packaged if packaged.is_dir() else _PACKAGE.parent


def shipped(kind: Kind) -> list[str]:
    """The sorted names that `resolve` accepts as a bare word for this kind."""
    folder, suffix = _PLACES[kind]
    return sorted(path.stem for path in (data_root() / folder).glob(f"*{suffix}"))


def is_path(name_or_path: str | Path) -> bool:
    """Whether this is a path; otherwise it is a shipped name."""
    text = str(name_or_path)
    return (
        isinstance(name_or_path, Path) or "/" in text or text.endswith((".yaml", ".yml", ".json"))
    )


def absolute_path(path: str | Path, relative_to: Path | None = None) -> Path:
    """`path` made absolute against the folder `relative_to` (default: the working directory)."""
    return Path(os.path.abspath((relative_to or Path.cwd()) / path))


def resolve(kind: Kind, name_or_path: str | Path, relative_to: Path | None = None) -> Path:
    """Finds a data file.

    Args:
        kind: what is asked for.
        name_or_path: a shipped name or a path.
        relative_to: the folder that relative paths start from; the working directory by default.

    Returns:
        The absolute path of something that exists.

    Raises:
        ConfigError: no such name or file; the message lists what is shipped, nearest first.
    """
    if is_path(name_or_path):
        path = absolute_path(name_or_path, relative_to)
        if os.path.exists(path):
            return path
        raise ConfigError(f"{kind}: no file {str(path)!r}; shipped names: {_nearest(kind, '')}")
    name, (folder, suffix) = str(name_or_path), _PLACES[kind]
    path = data_root() / folder / f"{name}{suffix}"
    if not name or not path.exists():
        raise ConfigError(
            f"{kind}: got {name!r}; expected one of {_nearest(kind, name)}, or a path "
            "(with a slash, or ending in .yaml, .yml or .json)"
        )
    return path


def _nearest(kind: Kind, name: str) -> str:
    """The shipped names, those that resemble `name` first."""
    names = shipped(kind)
    alike = resembling(name, names)
    return ", ".join([*alike, *(n for n in names if n not in alike)]) or "none"
