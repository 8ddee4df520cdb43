"""The law for servos: its design by a scenario, and the Drake system."""

import math
from collections.abc import Callable
from dataclasses import replace
from typing import Final

import numpy as np
from pydrake.systems.framework import Context
from pydrake.trajectories import Trajectory

from stewart_drake.dynamics.stewart import StewartDynamics
from stewart_drake.dynamics.workspace import margin
from stewart_drake.files.errors import ConfigError
from stewart_drake.law.catch_up import PIECE, shortest
from stewart_drake.law.core_law import serving
from stewart_drake.law.late import LateObserver
from stewart_drake.law.measurement import Measurement
from stewart_drake.law.motion import Preview
from stewart_drake.law.motors import TorqueLimit
from stewart_drake.law.observers import ParameterObserver
from stewart_drake.law.predictive_lqi import PredictiveLqi
from stewart_drake.law.servo_preview import ReportedTimeline, ServoMemory, ServoPreview
from stewart_drake.law.servos import ReportLayout, ServoLoop, crank_mobility, mean_inertia
from stewart_drake.law.startup import INSTANTS
from stewart_drake.loop.controller import HELD, held_by
from stewart_drake.loop.experiment import Experiment, planned_limit
from stewart_drake.loop.law_design import compose_law
from stewart_drake.loop.own import NOTHING
from stewart_drake.loop.sampling import SteppedLaw
from stewart_drake.scenario.config import Scenario, compatible_actuator
from stewart_drake.scenario.delay import Delay
from stewart_drake.scenario.signals import (
    ACCELERATIONS,
    MODEL_TORQUE,
    NUM_REFERENCE,
    NUM_STATE,
    NUM_TORQUES,
    POSE,
    RATES,
    ports_of,
)
from stewart_drake.scenario.timing import servo_ticks
from stewart_drake.scenario.trajectories import catch_up, evaluate, spread_instants
from stewart_drake.types import Array

_PART: Final = 0.005
"""s, about as long as the parts of a period over which servos report mean torques."""
_REPORTED: Final = 10
"""Periods in a report."""


def servo_loop(experiment: Experiment) -> ServoLoop:
    """What runs at each motor, tuned by the machine as it is known.

    Raises:
        ConfigError: sampled, it would be unstable at home or along the reference.
    """
    sc, nominal = experiment.scenario, experiment.nominal
    actuator = sc.actuator
    assert actuator.kind == "servo"
    loop = ServoLoop(
        inertia=mean_inertia(nominal),
        bandwidth=2 * math.pi * actuator.bandwidth,
        damping=actuator.damping,
        period=sc.controller.period / _ticks(sc),
        motors=TorqueLimit(experiment.torque_limit),
        speed_limit=math.inf if actuator.speed_limit is None else actuator.speed_limit,
    )
    most = quickest_crank(nominal, experiment)
    highest = loop.highest_bandwidth(np.array([1 / most])) / (2 * math.pi)
    if actuator.bandwidth >= highest:
        raise ConfigError(
            f"actuator.bandwidth: got {actuator.bandwidth:g} Hz; expected less than {highest:.3g} "
            f"Hz, from which on loops of {1 / loop.period:.4g} Hz are unstable with this machine"
        )
    return loop


def quickest_crank(dynamics: StewartDynamics, experiment: Experiment) -> float:
    """Largest acceleration per torque, rad/s^2 per N m, at home and along the reference.

    Of `crank_mobility`, whatever motors push together: one over the least inertia of a mode.
    """
    instants = spread_instants(experiment.scenario.duration, INSTANTS)
    along = (experiment.reference.value(t)[:, 0] for t in instants)
    poses = (dynamics.mechanism.home, *along)
    return max(float(np.linalg.eigvalsh(crank_mobility(dynamics, pose)).max()) for pose in poses)


def _ticks(scenario: Scenario) -> int:
    return servo_ticks(scenario.controller.period, scenario.plant.step)


def compose_servo_law(experiment: Experiment) -> ServoPreview:
    """The parts that a scenario with servos asks for: those of the law for torques, where alike."""
    like = _law_for_torques(experiment)
    period, ticks = like.timeline.period, _ticks(experiment.scenario)
    wanted = max(1, round(period / _PART))
    parts = next(n for n in range(min(wanted, ticks), 0, -1) if ticks % n == 0)
    observer = like.observer.observer if isinstance(like.observer, LateObserver) else like.observer
    if isinstance(observer, ParameterObserver):  # what acted when is not guessed but reported
        observer = replace(observer, settings=replace(observer.settings, timing_std=0.0))
    law = ServoPreview(
        timeline=ReportedTimeline(period, like.timeline.delay, parts),
        plant=replace(like.plant, substeps=1),
        sensing=like.sensing,
        observer=observer,
        feedforward=like.feedforward,
        reports=ReportLayout(parts, _REPORTED),
    )
    return experiment.own.revised(law)


def _law_for_torques(experiment: Experiment) -> PredictiveLqi:
    sc = experiment.scenario
    controller = replace(sc.controller, command="torque")
    actuator = compatible_actuator("torque", sc.actuator)
    alike = replace(sc, controller=controller, actuator=actuator)
    return compose_law(experiment._replace(scenario=alike, own=NOTHING))


def servo_law(experiment: Experiment) -> tuple[ServoPreview, Trajectory, float]:
    """The law, the motion that it follows, and the length of the blend onto the reference."""
    sc, law = experiment.scenario, compose_servo_law(experiment)
    law.warm_up()
    period, eta, reference = law.timeline.period, law.timeline.eta, experiment.reference
    if sc.start != "rest" or sc.controller.catch_up == 0:
        return law, reference, 0.0

    def blend(periods: int) -> Trajectory:
        start = experiment.start[POSE], experiment.start[RATES]
        return catch_up(*start, reference, eta, periods * period)

    def possible(periods: int, limit: float) -> bool:
        planned, span = blend(periods), periods * period
        for t in np.linspace(eta, eta + span, math.ceil(span / PIECE) + 1):
            x = evaluate(planned, t)
            if not margin(experiment.mechanism, x[POSE]) > 0:
                return False
            torque = experiment.nominal.inverse_dynamics(x[POSE], x[RATES], x[ACCELERATIONS])
            if np.abs(torque).max() > limit:
                return False
        return True

    periods = shortest(possible, period, sc.controller.catch_up, planned_limit(sc))
    return (law, reference, 0.0) if periods is None else (law, blend(periods), periods * period)


def commands_in_flight(
    experiment: Experiment, law: ServoPreview, delay: Delay
) -> tuple[Array, Array]:
    """What servos begin with (18,), and the commands (L, 18) under way at t = 0, oldest first.

    The oldest is reached at t = dt, or eta0 where that is above 0.
    """
    sc, length = experiment.scenario, delay.queue_length
    wanted = np.zeros((length + 1, NUM_REFERENCE))
    wanted[:, POSE] = experiment.start[POSE]
    wanted[0, RATES] = experiment.start[RATES]
    if sc.queue == "reference":
        ends = delay.eta(law.timeline.period) - law.timeline.period * np.arange(length)[::-1]
        moving = 1 if sc.start == "rest" else 0  # a plate at rest is not on the reference yet
        for row, t in zip(wanted[moving:], [0.0, *ends][moving:], strict=True):
            row[:] = evaluate(experiment.reference, t)
    commands = np.array([law.command(x, law.plant.dynamics.parameters) for x in wanted])
    if sc.queue == "zero":
        commands[:, MODEL_TORQUE] = 0.0
    return commands[0], commands[1:]


class ServoController(SteppedLaw):
    """Sends crank angles ahead, in the place of `loop.controller.DelayLqiController`.

    With m the memory and `step` the law (`law.servo_preview.ServoPreview`):

    Update:  every period m <- step(m, measurement, preview, report), and the time it took
    Output:  command = step(m, measurement, preview, report).command, to be taken at the samples;
             the others = parts of m, as of the last sample.

    | port | direction | size | unit | rate |
    | --- | --- | --- | --- | --- |
    | measurement | input | 12 | rad, m, rad/s, m/s | read every period; NaN is lost |
    | preview | input | 18 | rad, m and time derivatives | read every period |
    | report | input | of `law.servos.ReportLayout` | N m | read every period; NaN is lost |
    | age | input | 1 | s, whole periods | of measurement and report; 0 where unconnected |
    | command | output | 18 | rad, rad/s, N m | direct feedthrough |
    | estimate | output | 12 | rad, m, rad/s, m/s | direct feedthrough |
    | torque | output | 6 | N m, that servos asked for | held |
    | torque_commanded | output | 6 | the same | held |
    | integral, weights_used | output | 6, 2 | | NaN |
    | the others | output | as of `DelayLqiController` | | held |

    Args:
        law: the control law.
        command: (18,) that was sent before t = 0.
    """

    def __init__(self, law: ServoPreview, command: Array) -> None:
        super().__init__()
        self._law = law
        self._served = serving(law).law
        first = self._served.initial_memory(command)
        self._measurement = self.DeclareVectorInputPort("measurement", law.sensing.size)
        self._preview = self.DeclareVectorInputPort("preview", NUM_REFERENCE)
        self._report = self.DeclareVectorInputPort("report", law.reports.size)
        self._age = self.DeclareVectorInputPort("age", 1)
        self._begin(first, law.timeline.period)
        self._put_out("command", NUM_REFERENCE, lambda m: m.command, now=True)
        self._put_out("estimate", NUM_STATE, lambda m: m.belief.state, now=True)
        self._put_out("torque", NUM_TORQUES, HELD["torque_commanded"])
        held = held_by(law.plant.dynamics)
        for port, signal in ports_of("controller").items():
            part = held[signal.name]
            self._put_out(port, len(part(first)), part)

    def _prepared(self, context: Context) -> Callable[[], ServoMemory]:
        age = float(np.asarray(self._age.Eval(context))[0]) if self._age.HasValue(context) else 0.0
        measurement = Measurement.of(np.asarray(self._measurement.Eval(context)), age)
        reference = np.reshape(np.asarray(self._preview.Eval(context)), (-1, NUM_REFERENCE))
        motion, report = Preview(self._law.preview_times, reference), self._report.Eval(context)
        memory = self.sample(context).memory
        return lambda: self._served.step(memory, measurement, motion, np.asarray(report))
