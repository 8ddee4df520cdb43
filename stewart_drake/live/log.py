"""The record of a live run: the signals of a simulation at the controller's samples, as CSV.

The true state is unknown: `pose` and `rates` are measured, or estimated if the measurement was not
used or is of encoders. Servos given by their stiffness have no estimate: without a measurement
they are NaN. A row waits until the machine has reported the torque that acted.

A thread writes each row as a whole line, so that the file is readable up to its last row after the
process is killed. An error, such as a full disk, is reported once; the run goes on without a log.
"""

import math
import os
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Final

import numpy as np

from stewart_drake.files.errors import ConfigError
from stewart_drake.law.memory import Memory
from stewart_drake.law.sensing import Measurement
from stewart_drake.loop.controller import held_by
from stewart_drake.loop.preparation import Experiment
from stewart_drake.loop.recording import Record
from stewart_drake.scenario.config import Scenario
from stewart_drake.scenario.run_log import Background, CsvFile, RunLog, csv_heads
from stewart_drake.scenario.signals import (
    NUM_STATE,
    NUM_TORQUES,
    TUNER_INPUTS,
    ports_of,
    recorded_signals,
)
from stewart_drake.types import Array

_WAITS: Final = 24
"""Longest wait of a row for the report of the torque that acted, samples."""
_LATEST: Final = 0.5
"""The same, s."""
_KEPT: Final = 96
"""Number of periods whose applied torques are kept."""
_HELD: Final = tuple(ports_of("controller").values())
"""Signals that are in the memory of the law."""


class RowFile:
    """A CSV file of rows of numbers, a temporary one without a path; a thread writes it."""

    def __init__(
        self, path: Path | None, header: Sequence[str], say: Callable[[str], None]
    ) -> None:
        name, self._width = str(path or "the log"), len(header)
        try:
            file = CsvFile(path, header)
            self._written = os.dup(file.descriptor)
        except OSError as error:
            raise ConfigError(
                f"{name}: cannot be written ({error.strerror}); expected room for a log"
            ) from None
        self._log = Background(file, name, say)

    def append(self, row: Array) -> None:
        """Add a row (columns,), without waiting."""
        self._log.write(row.tolist())

    def close(self) -> Array:
        """Write the waiting rows and close the file; return all rows (n, columns)."""
        self._log.close()
        os.lseek(self._written, 0, os.SEEK_SET)
        with os.fdopen(self._written, encoding="ascii") as file:
            next(file)
            cells = (line.split(",") for line in file)
            rows = [np.array([float(cell.strip() or "nan") for cell in row]) for row in cells]
        return np.array(rows).reshape(-1, self._width)


class LiveRecord(Record):
    """Record of a live run in a CSV file, a temporary one without a path, and in further logs.

    The columns are those of `reporting.csv_file.signals_csv` without the error, then computing time
    and delay of the step (`step[s]`, `late[s]`). `limit` is that of the torque, N m.

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
        logs: Sequence[RunLog] = (),
    ) -> None:
        super().__init__(experiment, logs, experiment.mechanism)
        self._held = held_by(experiment.nominal)
        self._period, self._limit = experiment.scenario.controller.period, limit
        self._waits = max(1, min(_WAITS, round(_LATEST / self._period)))
        self._eta = experiment.scenario.eta
        # The torque at a sample began then, or in the period before if the delay has a fraction.
        self._began_before = int(experiment.scenario.true_delay.fraction > 0)
        self._measures_state = experiment.scenario.sensor.measures_state
        self._cranks = experiment.scenario.controller.command == "cranks"
        self._rows: dict[int, dict[str, Array]] = {}
        self.applied: dict[int, Array] = {}
        self.latest: Array = np.zeros(NUM_TORQUES)
        self._acts: Array = np.full(NUM_TORQUES, np.nan)
        header = csv_heads(recorded_signals(experiment.scenario.sensor.samples))
        self._file = RowFile(path, [*header, "step[s]", "late[s]"], say)

    def acted(self, torques: dict[int, Array]) -> None:
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
        memory: Memory,
        measurement: Measurement,
        wanted: Array,
        seconds: float,
        late: float,
        packets: Array,
    ) -> None:
        """Add a sample with the memory of the law after it.

        Its step took `seconds`. `late` is the time from the earliest arrival of the measurement to
        the sending of torques, s; `packets` has the counts (5,) of `scenario.signals.PACKETS`.
        """
        state, usable = np.array(memory.belief.state), self.count(memory)
        if usable and self._measures_state:
            state = measurement.values
        elif not usable and self._cranks:
            state = np.full(NUM_STATE, np.nan)  # the law keeps that of the last measurement
        belief = memory.belief
        self.delay = {
            "true_s": self._eta,
            "estimated_s": float(belief.delay[0]),
            "std_s": belief.delay_std,
        }
        self.packets = packets
        seen = {signal.exported: self._held[signal.name](memory) for signal in _HELD}
        seen["measurement"] = measurement.known(measurement.values.size)
        if self._cranks:
            seen["state_estimate"] = state
        row = seen | {
            "state": state,
            "reference": wanted[:NUM_STATE],
            "density": np.full(len(TUNER_INPUTS), math.nan),
            "delay_true": np.array([self._eta]),
            "packets": packets,
            "setpoint": self.setpoint,
            "step": np.array([seconds, late]),
        }
        self._rows[number] = row
        while self._rows:
            first = min(self._rows)
            if first - self._began_before not in self.applied and first > number - self._waits:
                break
            self._write(first)

    def ran(self, scenario: Scenario) -> None:
        self._scenario = scenario

    def finish(self) -> Array:
        """Close the file and read it for `summarize` and `dataset`; return its `late` (n,), s."""
        while self._rows:
            self._write(min(self._rows))
        rows = self._file.close()
        logged, (seconds, late) = rows[:, :-2], rows[:, -2:].T
        at, columns = 1, {}
        for signal in self._recorded:
            columns[signal.name], at = logged[:, at : at + signal.size], at + signal.size
        asked = columns["torque_commanded"]
        poses = columns["pose"], columns["reference"]
        error = self.errors(*poses)
        sent = np.clip(asked, -self._limit, self._limit)
        self._log = list(logged)
        self.on_grid = list(np.column_stack([logged[:, 0], *poses]))
        self.samples = list(np.column_stack([error, asked, sent, seconds]))
        return late

    def errors(self, poses: Array, reference: Array) -> Array:
        """Return the errors (n, 6), those without a measurement from the samples around them."""
        error = poses - reference
        known = np.flatnonzero(np.isfinite(error).all(axis=1))
        if len(known) in (0, len(error)):
            return error
        every = np.arange(len(error))
        return np.column_stack([np.interp(every, known, column) for column in error[known].T])

    def _write(self, number: int) -> None:
        row = self._rows.pop(number)
        self._acts = self.applied.get(number - self._began_before, self._acts)
        row["torque_applied"] = self._acts
        parts = [row[signal.exported][signal.part] for signal in self._recorded]
        self._file.append(np.concatenate([[number * self._period], *parts, row["step"]]))
        self.mirror(number * self._period, row)
