"""Tables of numbers in CSV whose header names each column with its unit, `name[unit]`."""

import io
import math
import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np
import pandas as pd
from numpy.typing import NDArray

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
    """Columns of a file in SI units."""

    path: Path  # of the file
    header: str  # description of the expected header, for messages
    labels: dict[str, str]  # by name, the header's cell of each column that was read
    scales: dict[str, float]  # by name, the factor to SI units
    lines: NDArray[np.intp]  # (n,) row of each sample in the file, where the header is row 1
    columns: dict[str, Array]  # by name, the numbers (n,); NaN for an empty cell

    def location(self, row: int, name: str | None = None) -> str:
        """Return file, row and column, with which a message on a row or its cell begins."""
        column = "" if name is None else f", column {self.labels[name]}"
        return f"{self.path}: row {self.lines[row]}{column}"

    def stacked(self, names: Iterable[str]) -> Array:
        """Return the named columns (n, k); a missing one is an error."""
        for name in names:
            if name not in self.columns:
                raise ConfigError(
                    f"{self.path}: row 1: column {name} is missing; expected {self.header}"
                )
        return np.column_stack([self.columns[name] for name in names])


def csv_text(heads: list[str], rows: Array, digits: int = 12) -> str:
    """Return heads and rows (n, k) as CSV; a number that is not finite is an empty cell."""
    frame = pd.DataFrame(np.where(np.isfinite(rows), rows, np.nan), columns=heads)
    return str(frame.to_csv(index=False, float_format=f"%.{digits}g", lineterminator="\n"))


def read_table(
    path: Path,
    expected: str,
    header: str,
    units: Units,
    *,
    prefix: str | None = None,
    optional: Iterable[str] = (),
    others: bool = False,
) -> Table:
    """Read a table.

    Args:
        path: a UTF-8 file of at most 100 MB.
        expected: description of the file, at the end of messages.
        header: description of its header, likewise.
        units: of all columns that it may have.
        prefix: that the names in `units` may have in the file. If only columns with the prefix
            are in `units`, apart from `time`, all columns without it are ignored.
        optional: names of columns whose cells may be empty, or nan.
        others: whether to ignore columns that are not in `units`.

    Raises:
        ConfigError: one line that begins with the path, and the row and column if there are any.
    """
    raw = read_bytes(path, _MAX_BYTES, expected)
    try:
        cells = pd.read_csv(
            io.BytesIO(raw),
            header=None,
            dtype=str,
            keep_default_na=False,
            skip_blank_lines=False,
            encoding="utf-8-sig",
        )
    except pd.errors.EmptyDataError:
        raise ConfigError(f"{path}: is empty; expected a header {header}") from None
    except ValueError as error:
        problem = " ".join(str(error).rpartition("error: ")[2].split())
        raise ConfigError(
            f"{path}: is not CSV ({problem}); expected UTF-8 text, as many cells in each row as in "
            "row 1, with commas between them and points for the decimals"
        ) from None
    cells = cells.fillna("").apply(lambda column: column.str.strip())
    lines = 1 + np.flatnonzero((cells != "").any(axis=1))
    first = cells.iloc[0].tolist()
    columns: dict[str, Array] = {}
    labels, scales = {}, {}
    for column, name, scale in _columns(path, first, header, units, prefix, others):
        labels[name], scales[name] = first[column], scale
        texts = cells[column].iloc[lines[1:] - 1]
        # Converted by Python's float: that of pandas may round the last digit wrongly.
        is_number = pd.to_numeric(texts, errors="coerce").notna()
        values = texts.where(is_number, "nan").to_numpy(np.float64)
        may_be_empty = texts.str.lower().isin(("", "nan")).to_numpy() & (name in optional)
        wrong = np.flatnonzero(~(np.isfinite(values) | may_be_empty))
        if len(wrong):
            raise ConfigError(
                f"{path}: row {lines[1:][wrong[0]]}, column {first[column]}: got "
                f"{brief(texts.iloc[wrong[0]])}; expected a finite number"
            )
        columns[name] = values * scale
    return Table(path, header, labels, scales, lines[1:], columns)


def _columns(
    path: Path, first: list[str], header: str, units: Units, prefix: str | None, others: bool
) -> list[tuple[int, str, float]]:
    """Return index, name and factor to SI units of the columns to read."""
    for separator in (";", "\t"):
        if separator in first[0]:
            raise ConfigError(
                f"{path}: row 1: got cells separated by {separator!r}; expected commas, and points "
                "for the decimals"
            )
    if first[0][:1].isdigit():
        raise ConfigError(f"{path}: row 1: got {brief(first[0])}; expected a header {header}")
    matches = [_LABEL.fullmatch(cell) for cell in first]
    found = [(match[1].lower(), match[2]) if match else ("", "") for match in matches]
    names, known = {name for name, _ in found}, units.keys() - {"time"}
    prefixed = {name for name in names if prefix and name.startswith(prefix)}
    only_prefixed = prefixed and not names & known
    columns: dict[str, tuple[int, str, float]] = {}
    for index, (label, unit) in enumerate(found):
        if only_prefixed and label not in prefixed and label != "time":
            continue
        name = label.removeprefix(prefix or "")
        if others and name not in units:
            continue
        if name not in units or name in columns:
            problem = "a second" if name in columns else "an unknown"
            raise ConfigError(
                f"{path}: row 1: got {problem} column {brief(first[index])}; expected {header}"
            )
        scale = units[name].get(unit) or units[name].get(unit.lower())
        if scale is None:
            raise ConfigError(
                f"{path}: row 1: got column {brief(first[index])}; expected {name} in "
                f"{' or '.join(units[name])}"
            )
        columns[name] = (index, name, scale)
    return list(columns.values())
