"""CSV as spreadsheets write it: text by rows, with the numbers that a spreadsheet gives them."""

import csv
from collections.abc import Callable, Iterable, Iterator, Mapping
from pathlib import Path

from stewart_drake.files.errors import ConfigError
from stewart_drake.files.fileio import read_bytes
from stewart_drake.files.yamlio import brief


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


def read_columns(
    path: Path,
    header: Iterable[str],
    units: Mapping[str, Mapping[str, float]],
    read: Callable[[str], tuple[str, str]],
    expected: str,
) -> tuple[list[str], list[float]]:
    """Name of each column, and its factor to SI units.

    Args:
        path: of the file.
        header: its first row, cell by cell.
        units: by name of a column, factors by their unit.
        read: name and unit of a cell, "" and "" where it has none.
        expected: what the header is, in words, closing a message.

    Raises:
        ConfigError: a column or unit that is not known, or is there twice.
    """
    names, scales = list[str](), list[float]()
    for cell in header:
        name, unit = read(cell)
        if name not in units or name in names:
            problem = "a second" if name in names else "an unknown"
            raise ConfigError(
                f"{path}: row 1: got {problem} column {brief(cell)}; expected {expected}"
            )
        if unit not in units[name]:
            raise ConfigError(
                f"{path}: row 1: got column {brief(cell)}; expected {name} in "
                f"{' or '.join(units[name])}"
            )
        names.append(name)
        scales.append(units[name][unit])
    return names, scales
