"""The record of a live run: the same signals as of a simulation, at the controller's samples.

Nobody knows where the plate truly is, so that `pose` and `rates` are what was measured, or what the
law goes on where that was lost or where encoders measure. What acted is known when the machine has
said so: rows wait for that.
"""

import math
from typing import Final

import numpy as np
from numpy.typing import NDArray

from stewart_drake.law.measurement import Measurement
from stewart_drake.law.native_law import AnyMemory
from stewart_drake.loop.controller import HELD
from stewart_drake.loop.experiment import Experiment
from stewart_drake.loop.recording import Record
from stewart_drake.scenario.config import Scenario, StateSensorConfig
from stewart_drake.scenario.signals import NUM_STATE, NUM_TORQUES, POSE, TUNER_INPUTS, ports_of

Array = NDArray[np.float64]

_WAITS: Final = 24
"""Samples that a row waits to be told what acted then."""
_KEPT: Final = 96
"""Periods for which it is remembered what acted."""


class LiveRecord(Record):
    """Collects the signals of a live run, sample by sample.

    Attributes:
        applied: torque (6,) in N m by the period that it began in, as far as the machine has said.
        latest: (6,) of them, the newest.
    """

    def __init__(self, experiment: Experiment, backend: str) -> None:
        super().__init__(experiment, backend)
        self._period = experiment.scenario.controller.period
        self._eta = experiment.scenario.eta
        # What acts at a sample began then, or, with a part of a period, in the one before.
        self._began_before = int(experiment.scenario.true_delay.fraction > 0)
        self._measures_state = isinstance(experiment.scenario.sensor, StateSensorConfig)
        self._rows: dict[int, dict[str, Array]] = {}
        self.applied: dict[int, Array] = {}
        self.latest: Array = np.zeros(NUM_TORQUES)
        self._acts: Array = np.full(NUM_TORQUES, np.nan)

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
        packets: Array,
    ) -> None:
        """Add a sample.

        Args:
            number: k.
            memory: of the law after it.
            measurement: as it came.
            wanted: (18,) of the reference.
            seconds: that the step took.
            packets: (5,) as of `scenario.signals.PACKETS`.
        """
        state = np.array(memory.belief.state)
        if self._measures_state and measurement.complete:
            state = measurement.values
        error, time = state[POSE] - wanted[POSE], number * self._period
        self.on_grid.append(time, error, wanted[POSE])
        self.samples.append(error, memory.torque, memory.in_flight[-1], seconds)
        self.counts = memory.counts
        belief = memory.belief
        self.delay = {
            "true_s": self._eta,
            "estimated_s": float(belief.delay[0]),
            "std_s": belief.delay_std,
        }
        seen = {signal.exported: HELD[signal.name](memory) for signal in _HELD}
        seen["measurement"] = measurement.after(np.full_like(measurement.values, np.nan))
        row = seen | {
            "state": state,
            "reference": wanted[:NUM_STATE],
            "density": np.full(len(TUNER_INPUTS), math.nan),
            "delay_true": np.array([self._eta]),
            "packets": packets,
        }
        self._rows[number] = row
        while len(self._rows) > _WAITS:
            self._write(min(self._rows))

    def ran(self, scenario: Scenario) -> None:
        """What the record says that was run."""
        self._scenario = scenario

    def flush(self) -> None:
        """Write the rows that still wait."""
        while self._rows:
            self._write(min(self._rows))

    def _write(self, number: int) -> None:
        row = self._rows.pop(number)
        self._acts = self.applied.get(number - self._began_before, self._acts)
        self.log(number * self._period, row | {"torque_applied": self._acts})


_HELD: Final = tuple(ports_of("controller").values())
