"""The law for a machine that is really there: the scenario's, over the link as it was found.

A torque acts a fixed time eta after the measurement that it rests on was taken, as in the scenario:
the machine's buffer waits for what comes sooner. On its way back a measurement has spent some of
eta, so that the law sees a link of round trips whose measurements are of now. What comes later than
its time, or never, the repetitions and plans of packets stand in for (theory.md, section 25).
"""

import math
import time as clock
from dataclasses import replace
from typing import Any, Final, NamedTuple

import numpy as np
from pydrake.trajectories import Trajectory

from stewart_drake.files.errors import ConfigError
from stewart_drake.law.core_law import serving
from stewart_drake.law.measurement import Measurement
from stewart_drake.law.motion import KnownMotion
from stewart_drake.law.nominal import TorqueLimit
from stewart_drake.law.predictive_lqi import PredictiveLqi
from stewart_drake.live.contact import Link
from stewart_drake.live.protocol import (
    MOST_HISTORY,
    MOST_ROWS,
    MachineFlags,
    MachineMessage,
)
from stewart_drake.loop.law_design import control_law, first_queue
from stewart_drake.loop.preparation import Experiment, prepare
from stewart_drake.scenario.config import Scenario
from stewart_drake.scenario.dependencies import differing
from stewart_drake.scenario.link_config import NetworkConfig
from stewart_drake.scenario.packets import default_bound
from stewart_drake.scenario.signals import NUM_STATE
from stewart_drake.scenario.trajectories import evaluate
from stewart_drake.types import Array

_ROOM: Final = 0.25
"""Share of what was seen of the link's jitter by which a round trip may yet be longer."""
_COMPUTING: Final = 0.01
"""s, for the law's step and for waking up."""
_TRIED: Final = 5
"""Number of steps of which the quickest counts."""
_LEAST_LOSS: Final = 0.01
"""Of packets; none was seen to be lost in a few seconds."""


class Design(NamedTuple):
    """Law and settings of a controller before its start.

    Attributes:
        experiment: of the scenario as it is seen.
        law: that is stepped.
        planned: the motion that it follows from a start at rest at the scenario's first pose.
        queue: (L, 6) torques in flight at a begin, as the scenario says.
        repeats: torques that a packet says again.
        torque_limit: of each motor, N m: the tighter one of the scenario's and of the machine's.
        step: s that a step of the law takes here, and what it is stepped by.
    """

    experiment: Experiment
    law: PredictiveLqi
    planned: Trajectory
    queue: Array
    repeats: int
    torque_limit: float
    step: tuple[float, str]


def check_controller(scenario: Scenario) -> None:
    """Refuse what `live` does not run.

    Raises:
        ConfigError: one line.
    """
    if found := differing(scenario, {"tuner.kind": "fixed", "actuator.kind": "torque"}):
        raise ConfigError(found.problem("for live"))


def as_seen(scenario: Scenario, link: Link, machine: MachineMessage) -> Scenario:
    """The scenario with the link that was found in the place of its own.

    Args:
        scenario: its delay, or the bound of its network, is the time from a measurement to its
            torque.
        link: as it was found.
        machine: what the machine says of itself.

    Raises:
        ConfigError: the link takes longer than that.
    """
    loss = max(scenario.sensor.loss, link.loss_back)
    sensor = replace(scenario.sensor, delay=0.0, loss=loss, faults=[])
    seen = replace(scenario, sensor=sensor, plant=replace(scenario.plant, kind="exact"))
    if MachineFlags.WIRE in machine.flags:  # it does as the scenario says
        return seen
    c = scenario.controller
    if c.delay_estimator != "none":
        raise ConfigError(
            f"controller.delay_estimator: got {c.delay_estimator!r}; expected 'none' for a machine "
            "that keeps to the play-out times of torques"
        )
    jitter = link.longest - link.shortest
    longest = link.longest + _ROOM * jitter + _COMPUTING
    network = NetworkConfig(
        low=link.shortest,
        high=longest,
        loss=max(link.loss_there, _LEAST_LOSS),
        burst=scenario.link.burst,
        dry="hold" if MachineFlags.HOLDS in machine.flags else "zero",
    )
    eta, period = _whole_delay(scenario, network), c.period
    repeats = max(0, min(c.packet_repeats, math.floor((eta - longest) / period + 1e-9)))
    if eta < longest:
        raise ConfigError(
            f"delay.steps: got {eta:g} s from a measurement to its torque; the link takes up to "
            f"{longest:.3g} s there and back: expected at least --set delay.steps="
            f"{math.ceil(longest / period) + c.packet_repeats}"
        )
    network = replace(network, playout=round(eta - repeats * period, 9))
    torques = min(c.packet_torques, MOST_ROWS - repeats)
    controller = replace(
        c, delay_steps=None, delay_fraction=None, packet_repeats=repeats, packet_torques=torques
    )
    return replace(seen, link=network, controller=controller)


def _whole_delay(scenario: Scenario, found: NetworkConfig) -> float:
    """s from a measurement to its torque: as the scenario says, or of the link that was found."""
    c, link = scenario.controller, scenario.link
    if link.kind == "wire":
        return scenario.eta
    if link.playout is not None:
        return link.playout + c.packet_repeats * c.period
    return default_bound(found, c.packet_repeats, c.period) + c.packet_repeats * c.period


def design(scenario: Scenario, machine: MachineMessage) -> Design:
    """The law for a scenario as it is seen.

    Raises:
        ConfigError: as `loop.preparation.prepare` and `control_law`.
    """
    experiment = prepare(scenario)
    law, planned, _ = control_law(experiment)
    limit = min(law.plant.motors.limit, machine.torque_limit)
    law = replace(law, plant=replace(law.plant, motors=TorqueLimit(limit)))
    repeats = scenario.controller.packet_repeats if scenario.link.kind == "network" else 0
    queue = first_queue(experiment, law)
    assert law.kept < MOST_HISTORY
    return Design(experiment, law, planned, queue, repeats, limit, _step_time(law, planned, queue))


def _step_time(law: PredictiveLqi, motion: Trajectory, queue: Array) -> tuple[float, str]:
    """The shortest of some steps along a motion, s of this thread, and what the law is stepped by.

    What else the computer does meanwhile does not count: it is the least that a step takes.
    """
    served: Any
    served, backend = serving(replace(law, silence=0))
    memory, weights, took = served.initial_memory(queue), np.ones(2), list[float]()
    measured = Measurement.of(law.sensing.seen(evaluate(motion, 0.0)[:NUM_STATE]))
    for _ in range(_TRIED):
        started = clock.thread_time()
        memory = served.step(memory, measured, KnownMotion(motion, motion, 0.0), weights)
        took.append(clock.thread_time() - started)
    return min(took), backend
