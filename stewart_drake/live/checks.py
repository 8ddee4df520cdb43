"""Checks of a live run, and references from where the plate is."""

import math
from collections.abc import Mapping
from dataclasses import replace
from typing import Any, Final

import numpy as np

from stewart_drake.dynamics.workspace import diagnose
from stewart_drake.law.nominal import NominalPlant
from stewart_drake.law.timeline import Timeline, TorqueSchedule
from stewart_drake.live.governor import Steering
from stewart_drake.loop.preparation import Experiment, check_reach
from stewart_drake.mechanism.trajectories import make_reference
from stewart_drake.scenario.reference_config import SineConfig
from stewart_drake.scenario.signals import NUM_TORQUES, POSE, RATES
from stewart_drake.types import Array

_ROWS: Final = 8
"""Number of consecutive torques reported a period off that count as an error."""
_KEPT: Final = 64
"""Number of periods whose sent torques are kept."""
_LONGEST: Final = 600.0
"""Checked part of a motion that does not repeat, s."""
REPLAN_ERROR: Final = 0.08
"""Smallest prediction error at which a new reference is planned, as a share of the motion."""


def check_whole_motion(experiment: Experiment, duration: float) -> None:
    """Check the motion of a run, which may be longer than the scenario's duration, in s.

    Raises:
        ConfigError: it leaves the workspace, or its file ends while it still moves.
    """
    scenario, reference = experiment.scenario, experiment.scenario.reference
    if isinstance(reference, SineConfig):
        frequencies = {*reference.angular_frequency}
        whole = 2 * math.pi / frequencies.pop() if len(frequencies) == 1 else _LONGEST
    else:
        whole = float(make_reference(reference, 0.0).times[-1:].sum()) + 1  # with the rest after it
    longer = replace(scenario, duration=max(scenario.duration, min(duration, whole)))
    make_reference(reference, longer.duration)
    check_reach(experiment._replace(scenario=longer))


class DelayCheck:
    """Compares the periods in which commands act with those that they were sent for.

    Args:
        limit: of a torque at the machine, N m; reported torques keep to it.
        eta: designed delay, s.
        period: of the controller, s.
        sends: whether plans are sent to a buffer; otherwise commands pass a simulated wire.
    """

    def __init__(self, limit: float, eta: float, period: float, sends: bool) -> None:
        self._limit, self._eta, self._period, self._sends = limit, eta, period, sends
        self._shifts = (-1, 0, 1) if sends else range(-_KEPT, _KEPT)
        self._sent: dict[int, list[Array]] = {}
        # of the last rows: by how many periods they were late, and how many were so in a row
        self._shift = self._rows = 0
        self._newest = -1

    def sent(self, first: int, rows: Array) -> None:
        """Note commands (n, 6) for the periods from `first` on."""
        for i, row in enumerate(np.clip(rows, -self._limit, self._limit)):
            self._sent.setdefault(first + i, []).append(row)
        for old in [n for n in self._sent if n < first - _KEPT]:
            del self._sent[old]

    def problem(self, acted: Mapping[int, Array]) -> str | None:
        """Return how commands (6,), by period, acted early or late, or None if they did not."""
        for number in sorted(n for n in acted if n > self._newest):
            self._newest = number
            found = [s for s in self._shifts if self._was_sent(number - s, acted[number])]
            shift = found[0] if len(found) == 1 else 0  # at rest several match
            self._rows = self._rows + 1 if shift == self._shift else 1
            self._shift = shift
        if not self._shift or self._rows < _ROWS:
            return None
        if self._sends:
            early, after = ("early", "after") if self._shift < 0 else ("late", "before")
            return (
                f"acted_from in the machine's datagrams is one period {early}: its last {_ROWS} "
                f"rows of torques were sent for the period {after}"
            )
        took = self._eta + self._shift * self._period
        return (
            f"commands act {took:.3g} s after their measurement, and this end expects "
            f"{self._eta:.3g} s: give machine and live the same delay.steps"
        )

    def _was_sent(self, number: int, command: Array) -> bool:
        return any(np.array_equal(row, command) for row in self._sent.get(number, []))


# ---------------------------------------------------------------- new references


def until_next(timeline: Timeline, in_flight: Array) -> TorqueSchedule:
    """Return the schedule until the next torque acts, of torques (n >= L, 6) in flight."""
    return timeline.until_next(timeline.queue(np.vstack([np.zeros(NUM_TORQUES), in_flight])))


def replanned(
    steering: Steering,
    plant: NominalPlant,
    t: float,
    state: Array,
    schedule: TorqueSchedule,
    parameters: Array | None = None,
) -> Steering | str:
    """Return a reference from the state after the torques in flight, or why there is none.

    `state` (12,) is that at t in s; `schedule` has the torques in flight.
    """
    dynamics = plant.dynamics if parameters is None else plant.dynamics.assuming(parameters)
    states = np.vstack([state, plant.predict(state, schedule, parameters)])
    if not np.all(np.isfinite(states)):
        return "the plate leaves its workspace before a torque can act"
    for x in states:
        failure = diagnose(plant.mechanism, t, x[POSE])
        if failure is not None:
            return f"{failure.reason} before a torque can act"
    torques = np.zeros((1, NUM_TORQUES))
    if len(schedule.torques):
        torques = np.vstack([schedule.torques[:1], schedule.torques])
    full = np.array(
        [
            np.append(x, dynamics.accelerations(x[POSE], x[RATES], torque))
            for x, torque in zip(states, torques, strict=True)
        ]
    )
    return steering.replan(t + np.append(0.0, np.cumsum(schedule.durations)), full)


def recovered(
    steering: Steering, law: Any, memory: Any, t: float, size: Array
) -> Steering | str | None:
    """Return a new reference if the law would hardly lead the plate back to the old one, else None.

    The law may overshoot by as much as the plate is off. It needs help where that pose, or the
    predicted one, has less than half of the room that the reference has; elsewhere it is faster
    than a new reference, which takes a second. If there is none, the reason is returned. `memory`
    is that of the law after the sample at t in s, `size` (6,) that of the motion.
    """
    belief, plant, in_flight = memory.belief, law.plant, memory.in_flight
    if not (
        belief.has_state and belief.feeds_back and belief.settled and not memory.open_loop_samples
    ):
        return None
    until, period = until_next(belief.timeline, in_flight[:-1]), law.timeline.period
    schedule = TorqueSchedule(
        np.vstack([until.torques, in_flight[-1:]]), np.append(until.durations, period)
    )
    ahead = plant.predict(belief.state, schedule, belief.parameters)[-1, POSE]
    wanted = steering.way.at(t + belief.timeline.eta + period)[POSE]
    if not np.any(np.abs(ahead - wanted) > REPLAN_ERROR * size):  # or NaN
        return None
    room, *others = (
        plant.mechanism.reach_margins(pose).min() for pose in (wanted, ahead, 2 * wanted - ahead)
    )
    if min(others) > room / 2:
        return None
    return replanned(steering, plant, t, belief.state, schedule, belief.parameters)
