"""The error that every reader of user input raises."""

import difflib
from collections.abc import Iterable


class ConfigError(ValueError):
    """Bad input from a file, an option or a setting.

    The message is one line that names the field, the value, and what would be accepted.
    """

    def __init__(self, message: str) -> None:
        super().__init__(" ".join(message.splitlines()))  # a file name may hold line breaks


def resembling(name: str, names: Iterable[str]) -> list[str]:
    """Return the names that resemble `name`, the nearest first; case does not count."""
    spelled = {other.casefold(): other for other in names}
    close = difflib.get_close_matches(name.casefold(), spelled, n=max(1, len(spelled)))
    return [spelled[one] for one in close]
