"""The error that every reader of user input raises."""

import difflib
from collections.abc import Iterable


class ConfigError(ValueError):
    """Bad input from a file, an option or a setting.

    The message is one line that names the field, the value, and what would be accepted.
    """

    def __init__(self, message: str) -> None:
        # File names may hold line breaks; what a user sees stays one line.
        super().__init__(" ".join(message.splitlines()))


def resembling(name: str, names: Iterable[str]) -> list[str]:
    """Return the names that resemble `name`, those that differ in case only first."""

    def distance(other: str) -> int:  # Levenshtein, by rows
        row = list(range(len(other) + 1))
        for i, a in enumerate(name, start=1):
            before, row = row, [i]
            for j, b in enumerate(other, start=1):
                row.append(min(before[j] + 1, row[-1] + 1, before[j - 1] + (a != b)))
        return row[-1]

    folded = name.casefold()
    close = {other for other in names if difflib.get_close_matches(folded, [other.casefold()], n=1)}
    return sorted(close, key=lambda other: (other.casefold() != folded, distance(other), other))
