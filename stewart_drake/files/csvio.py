"""Tables of numbers in CSV whose header names each column with its unit, `name[unit]`."""

import csv
import math
import re
from array import array
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np

from stewart_drake.files.errors import ConfigError
from stewart_drake.files.fileio import read_bytes
from stewart_drake.files.yamlio import brief
from stewart_drake.types import Array

Units = Mapping[str, Mapping[str, float]]
"""By name of a column, the factor to SI units of each accepted unit."""

ANGLE_UNITS: Final = {"rad": 1.0, "deg": math.pi / 180}
LENGTH_UNITS: Final = {"m": 1.0, "mm": 1e-3}
TORQUE_UNITS: Final = {"N m": 1.0, "mN m": 1e-3}
_MAX_BYTES: Final = 100_000_000
_LABEL: Final = re.compile(r"\s*(\w+)\s*\[\s*([\w ]+?)\s*\]\s*")


@dataclass(frozen=True)
class Table:
    """Columns of a file in SI units.

    Attributes:
        path: of the file.
        header: description of the expected header.
        labels: by name, the header's cell of each column that was read.
        scales: by name, the factor to SI units.
        lines: line number of each row.
        columns: by name, the numbers (n,); NaN for an empty cell.
    """

    path: Path
    header: str
    labels: dict[str, str]
    scales: dict[str, float]
    lines: list[int]
    columns: dict[str, Array]

    def place(self, row: int, name: str | None = None) -> str:
        """Return the opening of a message about a row, or about one of its cells."""
        column = "" if name is None else f", column {self.labels[name]}"
        return f"{self.path}: row {self.lines[row]}{column}"

    def stacked(self, names: Iterable[str]) -> Array:
        """Return columns (n, k).

        Raises:
            ConfigError: a column is missing.
        """
        names = list(names)
        for name in names:
            if name not in self.columns:
                raise ConfigError(
                    f"{self.path}: row 1: column {name} is missing; expected {self.header}"
                )
        return np.column_stack([self.columns[name] for name in names])


def read_table(
    path: Path,
    expected: str,
    header: str,
    units: Units,
    *,
    prefix: str | None = None,
    optional: Iterable[str] = (),
) -> Table:
    """Read a table.

    Args:
        path: a UTF-8 file of at most 100 MB.
        expected: description of the file, closing a message.
        header: description of its header, likewise.
        units: of all columns that it may have.
        prefix: of columns whose names, without it, are in `units`. In a file that has such columns
            and none of these names without it, apart from `time`, all other columns are ignored.
        optional: names of columns whose cells may be empty.

    Raises:
        ConfigError: one line, opened by the path, with row and column where there are such.
    """
    try:
        text = read_bytes(path, _MAX_BYTES, expected).decode("utf-8-sig").splitlines()
    except UnicodeDecodeError:
        raise ConfigError(f"{path}: is not UTF-8 text; expected a CSV file") from None
    rows = _rows(path, text)
    _, first = next(rows, (0, list[str]()))
    if not first:
        raise ConfigError(f"{path}: is empty; expected a header {header}")
    places, names, scales = _columns(path, first, header, units, prefix)
    labels = {name: first[at].strip() for name, at in zip(names, places, strict=True)}
    empty = {name: name in optional for name in names}
    lines, numbers = list[int](), array("d")
    for line, row in rows:
        lines.append(line)
        if len(row) != len(first):
            hint = ", with a point for the decimals" if len(row) > len(first) else ""
            raise ConfigError(
                f"{path}: row {line}: got {len(row)} cells; expected {len(first)}, as above{hint}"
            )
        cells = [row[at] for at in places]
        try:
            values = [*map(float, cells)]
        except ValueError:
            values = [math.nan]
        if not all(map(math.isfinite, values)):
            where = f"{path}: row {line}, column"
            values = [
                _number(f"{where} {labels[name]}", cell, empty[name])
                for name, cell in zip(names, cells, strict=True)
            ]
        numbers.extend(values)
    table = np.frombuffer(numbers).reshape(-1, len(names)) * scales
    columns = dict(zip(names, np.ascontiguousarray(table.T), strict=True))
    return Table(path, header, labels, dict(zip(names, scales, strict=True)), lines, columns)


def _rows(path: Path, text: list[str]) -> Iterator[tuple[int, list[str]]]:
    """Yield the rows that are not blank, with their line numbers."""
    reader = csv.reader(text, strict=True)
    try:
        for row in reader:
            if any(map(str.strip, row)):
                yield reader.line_num, row
    except csv.Error as error:
        raise ConfigError(
            f"{path}: row {reader.line_num}: is not CSV ({error}); expected cells between commas"
        ) from None


def _columns(
    path: Path, first: list[str], header: str, units: Units, prefix: str | None
) -> tuple[list[int], list[str], list[float]]:
    """Return place, name and factor to SI units of the columns to read."""
    for separator in (";", "\t"):
        if separator in first[0]:
            raise ConfigError(
                f"{path}: row 1: got cells separated by {separator!r}; expected commas, and points "
                "for the decimals"
            )
    if first[0].strip()[:1].isdigit():
        raise ConfigError(f"{path}: row 1: got {brief(first[0])}; expected a header {header}")
    found = [_name_and_unit(cell) for cell in first]
    all_names, known = {name for name, _ in found}, units.keys() - {"time"}
    prefixed = {name for name in all_names if prefix and name.startswith(prefix)}
    alone = prefixed and not all_names & known
    names, scales, places = list[str](), list[float](), list[int]()
    for at, (label, unit) in enumerate(found):
        if alone and label not in prefixed and label != "time":
            continue
        name = label.removeprefix(prefix or "")
        if name not in units or name in names:
            problem = "a second" if name in names else "an unknown"
            raise ConfigError(
                f"{path}: row 1: got {problem} column {brief(first[at])}; expected {header}"
            )
        scale = units[name].get(unit) or units[name].get(unit.lower())
        if scale is None:
            raise ConfigError(
                f"{path}: row 1: got column {brief(first[at])}; expected {name} in "
                f"{' or '.join(units[name])}"
            )
        places.append(at)
        names.append(name)
        scales.append(scale)
    return places, names, scales


def _name_and_unit(cell: str) -> tuple[str, str]:
    """Return both parts of a header's cell, empty ones of any other text."""
    match = _LABEL.fullmatch(cell)
    return (match[1].lower(), match[2]) if match else ("", "")


def _number(where: str, cell: str, may_be_empty: bool) -> float:
    if may_be_empty and not cell.strip():
        return math.nan
    try:
        value = float(cell)
    except ValueError:
        raise ConfigError(f"{where}: got {brief(cell)}; expected a number") from None
    if not math.isfinite(value):
        raise ConfigError(f"{where}: got {cell.strip()}; expected a finite number")
    return value
