"""The error that every reader of user input raises."""

import difflib
import importlib
from collections.abc import Iterable
from typing import Any, Final


class ConfigError(ValueError):
    """Bad input from a file, an option or a setting.

    The message is one line that names the field, the value, and what would be accepted.
    """

    def __init__(self, message: str) -> None:
        super().__init__(" ".join(message.splitlines()))  # a file name may hold line breaks


def optional(module: str, problem: str) -> Any:
    """Import a module that may be missing; `problem` is the message of the ConfigError then."""
    try:
        return importlib.import_module(module)
    except ImportError:
        raise ConfigError(problem) from None


_LEAST_ALIKE: Final = 0.7
"""Least share of common letters, by `difflib`, of two names that resemble each other."""


def resembling(name: str, names: Iterable[str]) -> list[str]:
    """Return the names that resemble `name`, the nearest first; case does not count."""
    spelled = {other.casefold(): other for other in names}
    close = difflib.get_close_matches(name.casefold(), spelled, max(1, len(spelled)), _LEAST_ALIKE)
    return [spelled[one] for one in close]
