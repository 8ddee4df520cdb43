"""The record of a live run: the same signals as of a simulation, at the controller's samples.

The true state is unknown. `pose` and `rates` are what was measured, or the law's estimate where it
could not use that or where encoders measure. What acted is known when the machine has said so: rows
wait for that.
"""

import math
from collections.abc import Callable
from pathlib import Path
from typing import Final

import numpy as np

from stewart_drake.law.core_law import AnyMemory
from stewart_drake.law.measurement import Measurement
from stewart_drake.live.rows import RowFile
from stewart_drake.loop.controller import held_by
from stewart_drake.loop.preparation import Experiment
from stewart_drake.loop.recording import Record, Table
from stewart_drake.reporting.csv_file import headings
from stewart_drake.scenario.config import Scenario
from stewart_drake.scenario.signals import NUM_STATE, NUM_TORQUES, TUNER_INPUTS, ports_of
from stewart_drake.types import Array

_WAITS: Final = 24
"""Longest wait of a row for the machine's report of what acted then, samples."""
_LATEST: Final = 0.5
"""The same in s."""
_KEPT: Final = 96
"""Number of periods whose applied torques are kept."""


class LiveRecord(Record):
    """Writes the signals of a live run to a CSV file, sample by sample.

    The columns are those of `reporting.csv_file.signals_csv` but for the error, then computing time
    and delay of the step (`step[s]`, `late[s]`).

    Args:
        experiment: that is run.
        limit: of each motor, N m.
        path: of the file; None is a temporary one.
        say: prints a line.

    Attributes:
        applied: torque (6,) in N m by the period that it began in, as far as the machine has said.
        latest: (6,) of them, the newest.
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
        # What acts at a sample began then, or, with a part of a period, in the one before.
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
        """Note what the machine says that acted, by period."""
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
        """Add a sample.

        Args:
            number: k.
            memory: of the law after it.
            measurement: as it came.
            wanted: (18,) of the reference.
            seconds: that the step took.
            late: s, from when the sample was due until its torques went out.
            packets: (5,) as of `scenario.signals.PACKETS`.
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
        """What the record says that was run."""
        self._scenario = scenario

    def flush(self) -> None:
        """Write the rows that still wait."""
        while self._rows:
            self._write(min(self._rows))

    def finish(self) -> Array:
        """Close the file and take from it what `summarize` and `dataset` need.

        Returns:
            (n,) `late` of the rows in the file, s.
        """
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
