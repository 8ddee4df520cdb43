"""CSV as spreadsheets write it: text by rows, with the numbers that a spreadsheet gives them."""

import csv
from collections.abc import Iterator
from pathlib import Path

from stewart_drake.files.errors import ConfigError
from stewart_drake.files.fileio import read_bytes


def read_lines(path: Path, most_bytes: int, expected: str) -> list[str]:
    """The lines of a file in UTF-8.

    Args:
        path: of the file.
        most_bytes: that it may have.
        expected: what it is, in words, closing a message.

    Raises:
        ConfigError: one line, opened by the path.
    """
    raw = read_bytes(path, most_bytes, expected)
    try:
        return raw.decode("utf-8-sig").splitlines()
    except UnicodeDecodeError:
        raise ConfigError(f"{path}: is not UTF-8 text; expected a CSV file") from None


def csv_rows(path: Path, text: list[str]) -> Iterator[tuple[int, list[str]]]:
    """The rows that hold anything, each with its line number.

    Raises:
        ConfigError: what is not CSV, with its row.
    """
    reader = csv.reader(text, strict=True)
    try:
        for row in reader:
            if any(map(str.strip, row)):
                yield reader.line_num, row
    except csv.Error as error:
        raise ConfigError(f"{path}: row {reader.line_num}: is not CSV ({error})") from None
