"""The record of a live run: the signals of a simulation at the controller's samples, as CSV.

The true state is unknown: `pose` and `rates` are measured, or estimated if the measurement was not
used or is of encoders. A row waits until the machine has reported the torque that acted.

A thread writes each row as a whole line, so that the file is readable up to its last row after the
process is killed. An error, such as a full disk, is reported once; the run goes on without a log.
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
from stewart_drake.law.core_law import AnyMemory
from stewart_drake.law.measurement import Measurement
from stewart_drake.loop.controller import held_by
from stewart_drake.loop.preparation import Experiment
from stewart_drake.loop.recording import Record, Table
from stewart_drake.reporting.csv_file import headings
from stewart_drake.scenario.config import Scenario
from stewart_drake.scenario.signals import NUM_STATE, NUM_TORQUES, TUNER_INPUTS, ports_of
from stewart_drake.types import Array

_WAITS: Final = 24
"""Longest wait of a row for the report of the torque that acted, samples."""
_LATEST: Final = 0.5
"""Longest wait, s."""
_KEPT: Final = 96
"""Number of periods whose applied torques are kept."""
_QUEUE: Final = 4096
"""Largest number of rows that wait for the disk."""


class RowFile:
    """A CSV file of rows of numbers, which read back exactly; empty cells are not finite.

    Args:
        path: file, which is replaced; None for a temporary one.
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
        self._rows: queue.Queue[Array | None] = queue.Queue(_QUEUE)
        self._writer = threading.Thread(target=self._work, daemon=True)

    def append(self, row: Array) -> None:
        """Add a row (columns,), without waiting."""
        if not self._writer.is_alive():
            # Started here it has the priority of the loop, which waits for the GIL.
            self._writer.start()
        try:
            self._rows.put_nowait(row)
        except queue.Full:
            self._fail("the disk is too slow")

    def close(self) -> Array:
        """Write the waiting rows and close the file; return all rows (n, columns)."""
        if self._writer.is_alive():
            self._rows.put(None)
            self._writer.join()
        try:
            os.lseek(self._file, self._start, os.SEEK_SET)
            with os.fdopen(self._file, encoding="ascii") as file:
                cells = (line.split(",") for line in file)
                rows = [np.array([float(cell.strip() or "nan") for cell in row]) for row in cells]
        except OSError as error:
            self._fail(str(error.strerror))
            rows = []
        return np.array(rows).reshape(-1, self._width)

    def _work(self) -> None:
        while (row := self._rows.get()) is not None:
            if not self._failed:
                cells = (repr(x) if math.isfinite(x) else "" for x in row.tolist())
                self._write(",".join(cells) + "\n")

    def _write(self, text: str) -> None:
        """Write a line, or leave the file as it was."""
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


class LiveRecord(Record):
    """Record of a live run in a CSV file.

    The columns are those of `reporting.csv_file.signals_csv` without the error, then computing time
    and delay of the step (`step[s]`, `late[s]`).

    Args:
        experiment: prepared scenario.
        limit: torque limit, N m.
        path: file; None for a temporary one.
        say: prints a line.

    Attributes:
        applied: reported torques (6,), N m, by the period that they began in.
        latest: the newest of them.
    """

    def __init__(
        self,
        experiment: Experiment,
        limit: float,
        path: Path | None,
        say: Callable[[str], None],
    ) -> None:
        super().__init__(experiment)
        self._held = held_by(experiment.nominal)
        self._period, self._limit = experiment.scenario.controller.period, limit
        self._waits = max(1, min(_WAITS, round(_LATEST / self._period)))
        self._eta = experiment.scenario.eta
        # The torque at a sample began then, or in the period before if the delay has a fraction.
        self._began_before = int(experiment.scenario.true_delay.fraction > 0)
        self._measures_state = experiment.scenario.sensor.measures_state
        self._rows: dict[int, dict[str, Array]] = {}
        self.applied: dict[int, Array] = {}
        self.latest: Array = np.zeros(NUM_TORQUES)
        self._acts: Array = np.full(NUM_TORQUES, np.nan)
        header = ["time[s]"]
        for signal in self._recorded:
            dimension = signal.quantity.dimension
            labels = () if dimension is None else self._dimensions[dimension].labels
            header += headings(signal.name, labels, signal.quantity.units)
        self._file = RowFile(path, [*header, "step[s]", "late[s]"], say)

    def acted(self, torques: dict[int, Array]) -> None:
        """Note reported torques by period."""
        self.applied |= torques
        if torques:
            newest = max(torques)
            self.latest = torques[newest]
            self.peak_applied = max(
                [self.peak_applied, *(float(np.abs(t).max()) for t in torques.values())]
            )
            for old in [n for n in self.applied if n < newest - _KEPT]:
                del self.applied[old]

    def sample(
        self,
        number: int,
        memory: AnyMemory,
        measurement: Measurement,
        wanted: Array,
        seconds: float,
        late: float,
        packets: Array,
    ) -> None:
        """Add sample `number`.

        Args:
            number: k.
            memory: memory of the law after it.
            measurement: measurement at it.
            wanted: reference (18,).
            seconds: computing time of the step, s.
            late: time from the earliest arrival of the measurement to the sending of torques, s.
            packets: counts (5,) of `scenario.signals.PACKETS`.
        """
        state = np.array(memory.belief.state)
        if self.count(memory) and self._measures_state:
            state = measurement.values
        belief = memory.belief
        self.delay = {
            "true_s": self._eta,
            "estimated_s": float(belief.delay[0]),
            "std_s": belief.delay_std,
        }
        seen = {signal.exported: self._held[signal.name](memory) for signal in _HELD}
        seen["measurement"] = measurement.known(measurement.values.size)
        row = seen | {
            "state": state,
            "reference": wanted[:NUM_STATE],
            "density": np.full(len(TUNER_INPUTS), math.nan),
            "delay_true": np.array([self._eta]),
            "packets": packets,
            "step": np.array([seconds, late]),
        }
        self._rows[number] = row
        while self._rows:
            first = min(self._rows)
            if first - self._began_before not in self.applied and first > number - self._waits:
                break
            self._write(first)

    def ran(self, scenario: Scenario) -> None:
        """Set the scenario that was run."""
        self._scenario = scenario

    def flush(self) -> None:
        """Write the rows that wait for a report."""
        while self._rows:
            self._write(min(self._rows))

    def finish(self) -> Array:
        """Close the file and read it for `summarize` and `dataset`; return its `late` (n,), s."""
        self.flush()
        rows = self._file.close()
        logged, (seconds, late) = rows[:, :-2], rows[:, -2:].T
        at, columns = 1, {}
        for signal in self._recorded:
            columns[signal.name], at = logged[:, at : at + signal.size], at + signal.size
        reference, asked = columns["reference"], columns["torque_commanded"]
        error = columns["pose"] - reference
        sent = np.clip(asked, -self._limit, self._limit)
        self._log = Table.of(logged)
        self.on_grid = Table.of(np.column_stack([logged[:, 0], error, reference]))
        self.samples = Table.of(np.column_stack([error, asked, sent, seconds]))
        return late

    def _write(self, number: int) -> None:
        row = self._rows.pop(number)
        self._acts = self.applied.get(number - self._began_before, self._acts)
        row["torque_applied"] = self._acts
        parts = [row[signal.exported][signal.part] for signal in self._recorded]
        self._file.append(np.concatenate([[number * self._period], *parts, row["step"]]))


_HELD: Final = tuple(ports_of("controller").values())
