"""Checks whether the plate is where the reference leads it, and references from where it is."""

from contextlib import suppress
from dataclasses import replace
from typing import Any, Final

import numpy as np

from stewart_drake.dynamics.workspace import diagnose
from stewart_drake.law.belief import Belief
from stewart_drake.law.nominal import NominalPlant
from stewart_drake.law.timeline import Timeline, TorqueSchedule
from stewart_drake.live.governor import Steering
from stewart_drake.scenario.delay import Delay
from stewart_drake.scenario.signals import NUM_STATE, NUM_TORQUES, POSE, RATES
from stewart_drake.types import Array

REPLAN_ERROR: Final = 0.08
"""Prediction error at which a new reference is planned, as a share of the motion."""


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
    """Return a new reference if the prediction is too far from the old one, else None.

    Where there is none, the reason is returned. `memory` is that of the law after the sample at t
    in s, `size` (6,) that of the motion.
    """
    belief, plant, in_flight = memory.belief, law.plant, memory.in_flight
    if not (belief.has_state and belief.feeds_back and belief.settled and not memory.silence):
        return None
    until, period = until_next(belief.timeline, in_flight[:-1]), law.timeline.period
    schedule = TorqueSchedule(
        np.vstack([until.torques, in_flight[-1:]]), np.append(until.durations, period)
    )
    ahead = plant.predict(belief.state, schedule, belief.parameters)[-1]
    away = np.abs(ahead - _wanted(steering, law, t, in_flight[-1], belief)) / np.tile(size, 2)
    if not away.max() > REPLAN_ERROR:  # or NaN
        return None
    return replanned(steering, plant, t, belief.state, schedule, belief.parameters)


def _wanted(steering: Steering, law: Any, t: float, torque: Array, belief: Belief) -> Array:
    """Return the state (12,) that the next torque leads to at the end of its hold, if all is well.

    Constant torques reach the poses of the reference there. The rates differ from its rates by
    equation (rates) of `law.feedforward`.
    """
    way, timeline, dynamics = steering.way, belief.timeline, law.plant.dynamics
    wanted = way.at(t + timeline.eta + timeline.period)[:NUM_STATE].copy()
    nodes = [way.at(t + node) for node in law.feedforward.nodes(timeline, 0)]
    changes = law.feedforward.held(np.array(nodes), dynamics, belief.parameters).changes
    with suppress(ArithmeticError, np.linalg.LinAlgError):
        B = law.model.at(wanted, torque, belief.parameters, law.plant).B[RATES]
        wanted += law.feedforward.offset(changes[1:], B, replace(timeline, delay=Delay(1)))
    return wanted
