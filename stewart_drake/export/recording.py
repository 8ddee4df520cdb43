"""Recording of a law's inputs and results, for a replay in C."""

from collections.abc import Callable
from dataclasses import dataclass, field, fields, replace
from typing import Any, Final, NamedTuple

import numpy as np

from stewart_drake.files.errors import ConfigError
from stewart_drake.files.resources import shipped
from stewart_drake.files.schema import plain
from stewart_drake.law.channel import Report
from stewart_drake.law.coverage import uncovered_part
from stewart_drake.law.gaps import LONGEST_GAP, longest_gap
from stewart_drake.law.motion import Motion
from stewart_drake.law.predictive_lqi import PredictiveLqi
from stewart_drake.law.sensing import Measurement
from stewart_drake.law.servos import ServoPreview
from stewart_drake.loop.simulation import simulate
from stewart_drake.scenario.config import Scenario
from stewart_drake.scenario.loading import load_controller
from stewart_drake.types import Array

EXPORTED: Final = (
    *("adaptive_lqi", "lqr_gravity", "predictor_lqi", "servo_feedforward", "servo_preview"),
)
"""Shipped controllers that are exported."""
REPLAYED: Final = 10.0
"""Longest part of a run that the test replays, s."""
_JUDGED: Final = 0.1
"""Time between two samples at which the longest gap of measurements is judged, s."""


class Step(NamedTuple):
    measurement: Array  # (m,), NaN where it is missing
    age: int  # of the measurement, periods
    preview: Array  # (p, 18) rows of the reference; none if the law chooses their instants
    answer: Array  # (6,) torque before the limit, or (18,) command
    status: int  # bits of the causes that were counted
    # with the measurement: on packets (or None), or (r,) of servos
    report: Report | Array | None
    # of torques: (2,) w_Q and w_R, and (6 N,) those within the limit, of this sample and later ones
    weights: Array | None = None
    sent: Array | None = None


@dataclass
class Recorded:
    law: PredictiveLqi | ServoPreview  # the law itself, not the one that records
    duration: float  # of the run, s
    steps: list[Step] = field(default_factory=list)  # of the first REPLAYED s
    # (n, 6) torques in flight at t = 0, or (18,) the command before the first sample
    first: Array = field(default_factory=lambda: np.empty(0))
    gap: float = LONGEST_GAP  # longest without measurements in the second half of these steps, s

    @property
    def moves(self) -> bool:
        """Whether the law chooses the instants at which it reads the reference."""
        law = self.law
        return isinstance(law, PredictiveLqi) and law.moves

    def note(
        self,
        measurement: Measurement,
        before: Any,
        after: Any,
        motion: Motion,
        given: tuple[Any, ...],
    ) -> None:
        """Keep a step by its memories; `given` are weights and report, or the report of servos."""
        law, size = self.law, self.law.sensing.size
        if len(self.steps) >= round(REPLAYED / law.timeline.period):
            return
        new = np.subtract(after.counts, before.counts) > 0
        status = int(new @ 2 ** np.arange(len(new)))
        age = round(measurement.age / law.timeline.period)
        preview = np.empty(0) if self.moves else motion(law.preview_times)
        seen = measurement.known(size), age, preview
        if isinstance(law, PredictiveLqi):
            weights, report = given
            sent = after.plan.ravel()
            self._judge_gap(after)
            self.steps.append(Step(*seen, after.torque, status, report, weights, sent))
        else:
            self.steps.append(Step(*seen, after.command, status, np.array(given[0])))

    def _judge_gap(self, memory: Any) -> None:
        law, period = self.law, self.law.timeline.period
        often = max(1, round(_JUDGED / period))
        half = min(self.duration, REPLAYED) / 2
        if len(self.steps) * period >= half and len(self.steps) % often == 0:
            estimate, eta = memory.belief.estimate, law.timeline.eta
            self.gap = min(self.gap, longest_gap(law.plant, estimate, memory.torque, eta))


def _recording(law: Any, record: Recorded) -> Any:
    """Return a law that records its steps since its memory was last initialised."""
    kind: Any = type(law)

    class Recording(kind):  # type: ignore[misc]
        def initial_memory(self, first: Array) -> Any:
            record.steps.clear()
            record.gap = LONGEST_GAP
            record.first = first
            record.law = kind(**{f.name: getattr(self, f.name) for f in fields(kind)})
            return super().initial_memory(first)

        def step(self, memory: Any, measurement: Measurement, motion: Motion, *given: Any) -> Any:
            after = super().step(memory, measurement, motion, *given)
            record.note(measurement, memory, after, motion, given)
            return after

    return Recording(**{f.name: getattr(law, f.name) for f in fields(kind)})


def _refusal(scenario: Scenario, field: str) -> str:
    """Return why a law is not exported, by the name of its shipped controller if it is one."""
    fixed, known = plain(scenario.controller).items(), ", ".join(EXPORTED)
    fields = {name: load_controller(name) for name in shipped("controller")}
    names = [name for name in fields if fields[name].items() <= fixed]
    name = max(names, key=lambda name: len(fields[name]), default=EXPORTED[0])
    value: Any = scenario
    usual: Any = Scenario()
    for key in field.split("."):
        value, usual = getattr(value, key, None), getattr(usual, key, None)
    if name in EXPORTED:
        own = value == usual
        given, expected = ("a law of your own", "that of") if own else (value, f"{usual}, as in")
        return f"{field}: got {given}, which is not exported; expected {expected} {known}"
    return f"controller: {name} is not exported, because of {field}: {value}; exported are {known}"


def record(scenario: Scenario) -> Recorded:
    """Return the law of a scenario with its steps in a run on the exact plant.

    The plant is exact since only the controller is tested. The integration error of a *multibody*
    plant is one that some stable loops, such as that of `gravity`, cannot correct.
    """
    found: list[Recorded] = []

    def recorded(law: Any) -> Any:
        problem = uncovered_part(law)
        if problem is not None:
            raise ConfigError(_refusal(scenario, problem))
        found.append(Recorded(law, scenario.duration))
        return _recording(law, found[-1])

    exact: Callable[..., Any] = replace
    scenario = replace(scenario, plant=exact(scenario.plant, kind="exact"))
    result = simulate(scenario, modify_law=recorded, judge_stability=False)
    if result.failure is not None:
        raise ConfigError(
            f"scenario: {result.failure}; expected one whose run the test can replay to its end. "
            "`simulate` loses it, too: try queue=reference with a shorter delay.steps or "
            "controller.period"
        )
    return found[-1]
