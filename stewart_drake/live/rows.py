"""A CSV file that grows by rows while a run goes on, written by a thread.

Each row is written as a whole line, so that the file is readable up to its last row after a kill
of the process. An error, such as a full disk, is reported once. What was written stays, and the run
goes on without the file.
"""

import math
import os
import queue
import tempfile
import threading
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Final

import numpy as np

from stewart_drake.files.errors import ConfigError
from stewart_drake.types import Array

_WAITING: Final = 4096
"""Rows that may wait for the disk."""


class RowFile:
    """Rows of numbers in a CSV file.

    Numbers are written so that they read back exactly, and empty cells for what is not finite.

    Args:
        path: of the file, which is replaced; None is a temporary one without a name.
        header: cells of the first line.
        say: prints a line.

    Raises:
        ConfigError: the file cannot be opened.
    """

    def __init__(
        self, path: Path | None, header: Sequence[str], say: Callable[[str], None]
    ) -> None:
        self._name, self._width, self._say = str(path or "the log"), len(header), say
        flags = os.O_RDWR | os.O_CREAT | os.O_TRUNC | os.O_CLOEXEC
        try:
            if path is None:
                with tempfile.TemporaryFile() as file:
                    self._file = os.dup(file.fileno())
            else:
                self._file = os.open(path, flags, 0o666)
        except OSError as error:
            raise ConfigError(
                f"{self._name}: cannot be written ({error.strerror}); expected room for a log"
            ) from None
        self._whole, self._failed = 0, False
        self._write(",".join(header) + "\n")
        self._start = self._whole
        self._rows: queue.Queue[Array | None] = queue.Queue(_WAITING)
        self._writer = threading.Thread(target=self._work, daemon=True)

    def append(self, row: Array) -> None:
        """Add a row (columns,); never waits."""
        if not self._writer.is_alive():
            # Here, so that it has the priority of the loop: it must not be held up with Python's
            # lock in its hands.
            self._writer.start()
        try:
            self._rows.put_nowait(row)
        except queue.Full:
            self._fail("the disk is too slow")

    def close(self) -> Array:
        """Write what waits, and close the file.

        Returns:
            All rows that were written, (n, columns), NaN where a cell is empty.
        """
        if self._writer.is_alive():
            self._rows.put(None)
            self._writer.join()
        try:
            os.lseek(self._file, self._start, os.SEEK_SET)
            with os.fdopen(self._file, encoding="ascii") as file:
                rows = [np.array([_number(cell) for cell in line.split(",")]) for line in file]
        except OSError as error:
            self._fail(str(error.strerror))
            rows = []
        return np.array(rows).reshape(-1, self._width)

    def _work(self) -> None:
        while (row := self._rows.get()) is not None:
            if not self._failed:
                self._write(",".join(map(_cell, row.tolist())) + "\n")

    def _write(self, text: str) -> None:
        """Write lines, or leave the file as it was before them."""
        data = text.encode("ascii")
        try:
            done = 0
            while done < len(data):
                done += os.write(self._file, data[done:])
            self._whole += done
        except OSError as error:
            os.ftruncate(self._file, self._whole)
            self._fail(str(error.strerror))

    def _fail(self, reason: str) -> None:
        if not self._failed:
            self._failed = True
            self._say(f"{self._name}: {reason}; the run goes on, the file ends here")


def _cell(value: float) -> str:
    return repr(value) if math.isfinite(value) else ""


def _number(cell: str) -> float:
    return float(cell) if cell.strip() else math.nan
