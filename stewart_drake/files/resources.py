"""Paths of the shipped mechanisms, scenarios, controllers and tuner weights.

A word is a shipped name; anything with a slash, or ending in `.yaml`, `.yml` or `.json`, is a path.
"""

import os
from pathlib import Path
from typing import Final, Literal

from stewart_drake.files.errors import ConfigError, resembling

Kind = Literal["mechanism", "scenario", "controller", "overlay", "weights", "move"]

KINDS: Final[dict[Kind, tuple[str, str, str]]] = {
    "mechanism": ("mechanisms", "models", ".yaml"),
    "scenario": ("scenarios", "diagrams/scenarios", ".yaml"),
    "controller": ("controllers", "diagrams/controllers", ".yaml"),
    "overlay": ("overlays", "diagrams/overlays", ".yaml"),
    "weights": ("tuner weights", "models/weights", ".json"),
    "move": ("moves of Reachy Mini", "diagrams/moves", ".json"),
}
"""Kinds of shipped data, with plural, folder and suffix."""

_PACKAGE: Final = Path(__file__).resolve().parents[1]


def data_root() -> Path:
    """Return the folder that holds `models/` and `diagrams/`.

    It is inside the package in a wheel, and the parent folder in a checkout. The package comes
    first, since site-packages may hold another folder `models`.
    """
    packaged = _PACKAGE / "_data"
    return packaged if packaged.is_dir() else _PACKAGE.parent


def shipped(kind: Kind) -> list[str]:
    """Return the sorted names that `resolve` accepts as a bare word for this kind."""
    if kind not in KINDS:
        raise ConfigError(f"kind: got {kind!r}; expected one of {', '.join(KINDS)}")
    _, folder, suffix = KINDS[kind]
    return sorted(path.stem for path in (data_root() / folder).glob(f"*{suffix}"))


def is_path(name_or_path: str | Path) -> bool:
    """Return whether the argument is a path, not a shipped name."""
    text = str(name_or_path)
    return (
        isinstance(name_or_path, Path) or "/" in text or text.endswith((".yaml", ".yml", ".json"))
    )


def absolute_path(path: str | Path, folder: str | Path = "") -> Path:
    """Return an absolute path; a relative one starts from a folder, by default the working one."""
    return Path(os.path.abspath(Path(folder, path)))


def resolve(kind: Kind, name_or_path: str | Path) -> Path:
    """Return the absolute path of an existing data file.

    Args:
        name_or_path: a shipped name, or the path of a file or of a folder with a file KIND.yaml; a
            mechanism's may be machine.yaml, as `new` writes it.

    Raises:
        ConfigError: no such name or file; the message lists what is shipped, nearest first.
    """
    name, (_, place, suffix) = str(name_or_path), KINDS[kind]
    inside = absolute_path(name) / f"{kind}.yaml"
    of_new = inside.with_name("machine.yaml")
    if kind == "mechanism" and os.path.exists(of_new) and not os.path.exists(inside):
        inside = of_new
    holds_one = bool(name) and os.path.exists(inside)
    lacks_one = bool(name) and os.path.isdir(name) and suffix == ".yaml" and not holds_one
    found = f"{name!r}, a folder without {kind}.yaml" if lacks_one else repr(name)
    if is_path(name_or_path):
        path = absolute_path(name_or_path)
        if holds_one:
            return inside
        if lacks_one:
            raise ConfigError(f"{kind}: got {found}; expected a file, or a folder with that one")
        if os.path.exists(path):
            return path
        raise ConfigError(f"{kind}: no file {str(path)!r}; shipped names: {_nearest(kind, '')}")
    path = data_root() / place / f"{name}{suffix}"
    if not name or not path.exists():
        nearest = f"{name}/{inside.name}, " if holds_one else ""
        raise ConfigError(
            f"{kind}: got {found}; expected {nearest}one of {_nearest(kind, name)}, or a path "
            "(with a slash, or ending in .yaml, .yml or .json)"
        )
    return path


def _nearest(kind: Kind, name: str) -> str:
    """Return the shipped names, those that resemble `name` first."""
    names = shipped(kind)
    alike = resembling(name, names)
    return ", ".join([*alike, *(n for n in names if n not in alike)]) or "none"
