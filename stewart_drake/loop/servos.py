"""Servos: the local loops at the motors as Drake systems, and the design of their law."""

import math
from collections.abc import Callable
from dataclasses import replace
from typing import Any, Final, NamedTuple

import numpy as np
from pydrake.common.value import AbstractValue, Value
from pydrake.systems.framework import (
    BasicVector,
    Context,
    ContinuousState,
    LeafSystem,
    State,
    ValueProducer,
)
from pydrake.trajectories import Trajectory

from stewart_drake.dynamics.native_functions import functions_of
from stewart_drake.dynamics.stewart import StewartDynamics
from stewart_drake.dynamics.workspace import margin
from stewart_drake.files.arguments import fixed, positive
from stewart_drake.files.errors import ConfigError
from stewart_drake.law.catch_up import PIECE, shortest
from stewart_drake.law.feedforward import NoFeedforward
from stewart_drake.law.learned import with_learned
from stewart_drake.law.nominal import TorqueLimit
from stewart_drake.law.observers import CoreObserver
from stewart_drake.law.predictive_lqi import PredictiveLqi
from stewart_drake.law.servos import (
    PositionServo,
    ReportLayout,
    Segment,
    ServoLoop,
    ServoPreview,
    Stiffness,
    crank_mobility,
    mean_inertia,
    still,
)
from stewart_drake.law.startup import INSTANTS, reference_torque
from stewart_drake.law.timeline import Timeline
from stewart_drake.loop.law_design import compose_law, one_step_sizing
from stewart_drake.loop.learned import learned_signal
from stewart_drake.loop.own import NOTHING
from stewart_drake.loop.preparation import Experiment
from stewart_drake.loop.sampling import SteppedLaw, update_every, weak
from stewart_drake.mechanism.trajectories import (
    RESTING,
    SAME,
    catch_up,
    continues,
    evaluate,
    poses_along,
    spread_instants,
)
from stewart_drake.scenario.config import Scenario, compatible_actuator
from stewart_drake.scenario.signals import (
    ACCELERATIONS,
    MODEL_TORQUE,
    NUM_REFERENCE,
    NUM_STATE,
    NUM_TORQUES,
    POSE,
    RATES,
    SETPOINT,
)
from stewart_drake.scenario.timing import Delay, servo_ticks, servo_time
from stewart_drake.types import Array


class ServoState(NamedTuple):
    segment: Segment  # path of the setpoint to the newest command
    arrived: float  # arrival of that command, s; NaN before the first
    setpoint: Array  # (12,) last setpoint
    asked: Array  # (6,) torque before the limit, N m
    put_out: Array  # (n, 6) torques of the reported periods, oldest first; NaN before the start

    @property
    def torque(self) -> Array:
        """Torque (6,) that acts, N m."""
        return np.nan_to_num(self.put_out[-1])


class Servos(SteppedLaw):
    """Servos that follow arriving crank angles, with a local loop at each motor (`law.servos`).

    With h the period of the loops, x the state, c the newest command, arrived at t_c:

    Update:  every h  segment  <- from the setpoint at t_c to c, if c is new;
                      setpoint <- segment(t) within the speed limit;
                      asked    <- J (w^2 (a_r - a(x)) + 2 d w (a_r' - a'(x))) + tau_model.
    Output:  torque = asked within the limit, held; report = torques of the last periods.

    Updates come after the other events of an instant and before a discrete plant's step
    (`servo_time`), so that the torque follows from the present state. A command that is not finite
    is ignored. The torque is held at the edge of the workspace, where a pose has no crank angles or
    rates.

    | port | direction | size | unit | rate |
    | --- | --- | --- | --- | --- |
    | command | input | 18 | rad, rad/s, N m | read every h |
    | arrived | input | 1 | s, arrival of the command | the same |
    | state | input | 12 | rad, m, rad/s, m/s | the same |
    | torque | output | 6 | N m | held for h |
    | report | output | of `law.servos.ReportLayout` | N m | to be read at samples |

    Args:
        loop: of each motor.
        dynamics: of the true machine, for kinematics and the limit at the crank.
        command: (18,) held until the first one arrives.
        period: of the commands, s, a multiple of that of the loops.
    """

    def __init__(
        self,
        loop: ServoLoop,
        dynamics: StewartDynamics,
        command: Array,
        period: float,
        reports: ReportLayout,
    ) -> None:
        super().__init__()
        self._loop, self._period, self.reports = loop, period, reports
        self._functions = functions_of(dynamics.mechanism)
        command, period = fixed("command", command, (NUM_REFERENCE,)), positive("period", period)
        nothing = np.full((reports.periods * round(period / loop.period), NUM_TORQUES), np.nan)
        setpoint, asked = command[SETPOINT], np.zeros(NUM_TORQUES)
        self._command = self.DeclareVectorInputPort("command", NUM_REFERENCE)
        self._arrived = self.DeclareVectorInputPort("arrived", 1)
        self._state = self.DeclareVectorInputPort("state", NUM_STATE)
        first = ServoState(still(command, 0.0), np.nan, setpoint, asked, nothing)
        self._begin(first, loop.period, servo_time)
        self._put_out("torque", NUM_TORQUES, lambda memory: memory.torque)
        self._put_out(
            "report", reports.size, lambda m: reports.written(m.put_out, m.asked, loop.motors)
        )

    def _prepared(self, context: Context) -> Callable[[], ServoState]:
        before, now = self.sample(context).memory, context.get_time()
        segment, arrived = self._segment(before, context)
        state = np.asarray(self._state.Eval(context))

        def step() -> ServoState:
            wanted, asked = segment.at(now, self._period), before.asked
            setpoint = self._loop.limited(wanted[SETPOINT], before.setpoint[POSE])
            cranks = self._functions.cranks(state)
            if np.isfinite(cranks).all():
                asked = self._loop.torque(setpoint, wanted[MODEL_TORQUE], cranks)
            put_out = np.vstack([before.put_out[1:], self._loop.motors.saturate(asked)])
            return ServoState(segment, arrived, setpoint, asked, put_out)

        return step

    def _segment(self, before: ServoState, context: Context) -> tuple[Segment, float]:
        arrived = float(np.asarray(self._arrived.Eval(context))[0])
        command = np.array(self._command.Eval(context))
        if arrived == before.arrived or not np.all(np.isfinite([arrived, *command])):
            return before.segment, before.arrived
        begin = max(arrived, before.segment.begin)
        return before.segment.then(command, begin, arrived + self._period, self._period), arrived


class PositionServos(LeafSystem):
    """Servos given by their stiffness: the newest setpoint acts, with the torque

        asked  = k (u - a(x)) - k_v a'(x),
        torque = asked within the limit,

    x the state, u the angles of the command. Damping, Coulomb friction and armature are those of
    the plant.

    Dynamics:  d[p; q]/dt = [torque; sum |asked - torque|].
    Update:    every part of a period, keep p and q, from which the report has mean torques.

    | port | direction | size | unit | rate |
    | --- | --- | --- | --- | --- |
    | command | input | 18 (only angles are used) | rad | piecewise constant |
    | state | input | 12 | rad, m, rad/s, m/s | continuous |
    | torque | output | 6 | N m | continuous, direct feedthrough |
    | report | output | of `law.servos.ReportLayout` | N m | to be read at samples |

    Args:
        servo: stiffness, velocity gain and torque limit.
        dynamics: of the true machine, for its geometry.
        command: (18,) held until the first one arrives.
        period: of the commands, s.
    """

    def __init__(
        self,
        servo: PositionServo,
        dynamics: StewartDynamics,
        command: Array,
        period: float,
        reports: ReportLayout,
    ) -> None:
        super().__init__()
        self._geometry = dynamics.mechanism.numbers
        self._first = fixed("command", command, (NUM_REFERENCE,))
        self._servo, self.reports = servo, reports
        self._part = positive("period", period) / reports.parts
        self._command = self.DeclareVectorInputPort("command", NUM_REFERENCE)
        self._state = self.DeclareVectorInputPort("state", NUM_STATE)
        self.DeclareContinuousState(NUM_TORQUES + 1)
        parts = reports.periods * reports.parts
        # Integrals at the ends of the reported parts, the oldest first.
        self._ends = self.DeclareAbstractState(Value(np.full((parts, NUM_TORQUES + 1), np.nan)))
        inputs = {self.input_port_ticket(p.get_index()) for p in (self._command, self._state)}
        self._torques_entry = self.DeclareCacheEntry(
            "torques",
            ValueProducer(allocate=lambda: Value(np.empty((2, 6))), calc=weak(self._torques)),
            inputs,
        )
        torques = self._torques_entry.ticket()
        self.DeclareVectorOutputPort("torque", NUM_TORQUES, weak(self._torque), {torques})
        read = {self.abstract_state_ticket(self._ends), self.xc_ticket(), torques}
        self.DeclareVectorOutputPort("report", reports.size, weak(self._report), read)
        update_every(self, self._part, self._keep, servo_time)

    def _torques(self, context: Context, result: AbstractValue) -> None:
        """Compute the torques (2, 6): as asked, and within the limit."""
        command = np.array(self._command.Eval(context))
        if not np.all(np.isfinite(command)):
            command = self._first
        state = np.array(self._state.Eval(context))
        result.set_value(self._servo.torques(self._geometry, command[POSE], state))

    def _torque(self, context: Context, output: BasicVector) -> None:
        pair: Any = self._torques_entry.Eval(context)
        output.SetFromVector(pair[1])

    def DoCalcTimeDerivatives(self, context: Context, derivatives: ContinuousState) -> None:
        pair: Any = self._torques_entry.Eval(context)
        asked, limited = pair
        derivatives.SetFromVector(np.append(limited, np.abs(asked - limited).sum()))

    def _impulses(self, context: Context) -> Array:
        """Return the integrals at the ends of all reported parts and now (n + 1, 7)."""
        value: Any = context.get_abstract_state(int(self._ends))
        now = context.get_continuous_state_vector().CopyToVector()
        return np.vstack([value.get_value(), now])

    def _keep(self, context: Context, state: State) -> None:
        state.get_mutable_abstract_state(int(self._ends)).set_value(self._impulses(context)[1:])

    def _report(self, context: Context, output: BasicVector) -> None:
        parts = np.diff(self._impulses(context), axis=0) / self._part
        pair: Any = self._torques_entry.Eval(context)
        output.SetFromVector(self.reports.of_means(parts[:, :-1], parts[:, -1] > 0, pair[0]))


_PART: Final = 0.005
"""Approximate length of the parts of a period with a reported mean torque, s."""
_FINE_PART: Final = 0.001
"""The same of servos given by their stiffness, s. Their torque changes faster: with parts of 5 ms
the estimator rejects measurements."""
_REPORTED: Final = 10
"""Periods in a report."""


def servo_loop(experiment: Experiment) -> ServoLoop:
    """Design the loop at each motor for the assumed machine."""
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


def position_servo(experiment: Experiment) -> PositionServo:
    """Return the servos of the machine that is simulated."""
    actuator = experiment.scenario.actuator
    assert actuator.kind == "position_servo"
    limit = experiment.torque_limit
    return PositionServo(actuator.stiffness, actuator.velocity_gain, limit)


def _part(scenario: Scenario) -> float:
    """Return the approximate length of the parts of a report, s."""
    if scenario.actuator.kind != "position_servo":
        return _PART
    return _FINE_PART if scenario.controller.estimate else scenario.controller.period


def known_stiffness(scenario: Scenario) -> Stiffness | None:
    """Return servos given by their stiffness as the controller knows them; None for others."""
    actuator = scenario.actuator
    if actuator.kind != "position_servo":
        return None
    given = actuator.angle_range
    ranges = np.array([-math.inf, math.inf] if given is None else given)
    low, high = np.broadcast_to(ranges, (NUM_TORQUES, 2)).T.copy()
    speed = math.inf if actuator.speed_limit is None else actuator.speed_limit
    most = speed * scenario.controller.period
    return Stiffness(actuator.stiffness, actuator.velocity_gain, low, high, most)


def quickest_crank(dynamics: StewartDynamics, experiment: Experiment) -> float:
    """Return the largest acceleration per torque, rad/s^2 per N m, at home and along the reference.

    It is the largest eigenvalue of `crank_mobility`: one over the least inertia of a mode.
    """
    instants = spread_instants(experiment.scenario.duration, INSTANTS)
    poses = (dynamics.mechanism.home, *poses_along(experiment.reference, instants))
    return max(float(np.linalg.eigvalsh(crank_mobility(dynamics, pose)).max()) for pose in poses)


def _ticks(scenario: Scenario) -> int:
    return servo_ticks(scenario.controller.period, scenario.plant.step)


def compose_servo_law(experiment: Experiment) -> ServoPreview:
    """Compose the law for servos; it shares most parts with the law for torques."""
    like = _law_for_torques(experiment)
    period, ticks = like.timeline.period, _ticks(experiment.scenario)
    wanted = max(1, round(period / _part(experiment.scenario)))
    parts = next(n for n in range(min(wanted, ticks), 0, -1) if ticks % n == 0)
    observer = like.observer
    if isinstance(observer, CoreObserver) and observer.settings is not None:
        # The machine reports which torque acted when.
        observer = replace(observer, settings=replace(observer.settings, timing_std=0.0))
    law = ServoPreview(
        timeline=Timeline(period, like.timeline.delay, parts=parts),
        plant=like.plant,
        sensing=like.sensing,
        observer=observer,
        feedforward=like.feedforward,
        reports=ReportLayout(parts, _REPORTED),
        servo=known_stiffness(experiment.scenario),
    )
    return experiment.own.revised(with_learned(law, learned_signal(experiment)))


def _law_for_torques(experiment: Experiment) -> PredictiveLqi:
    sc = experiment.scenario
    controller = replace(sc.controller, command="torque", learned=None)
    actuator = compatible_actuator("torque", sc.actuator)
    alike = replace(sc, controller=controller, actuator=actuator)
    like = experiment._replace(scenario=alike, own=NOTHING)
    return compose_law(like, one_step_sizing(like))


def servo_law(experiment: Experiment) -> tuple[ServoPreview, Trajectory, float]:
    """Return the law, the motion that it follows, and the length of the blend, s."""
    sc, law = experiment.scenario, compose_servo_law(experiment)
    period, eta, reference = law.timeline.period, law.timeline.eta, experiment.reference
    if sc.start != "rest" or sc.controller.catch_up == 0:
        return law, reference, 0.0
    # The motion may have begun, if slightly, when the first command acts.
    begun = evaluate(reference, float(law.preview_times[0]))[POSE] - experiment.start[POSE]
    slight = np.all(np.abs(begun) <= RESTING * experiment.peak_to_peak + SAME)
    if slight and continues(experiment.start, reference, 0.0, sc.duration):
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

    try:
        periods = shortest(possible, period, sc.controller.catch_up, experiment.planned_limit)
    except ConfigError:
        needed = reference_torque(experiment.nominal, reference, sc.duration)
        if needed <= experiment.torque_limit:
            raise
        raise ConfigError(
            f"reference: needs up to {needed:.3g} N m of a motor; expected at most "
            f"{experiment.torque_limit:.3g} N m, a slower or smaller motion"
        ) from None
    return (law, reference, 0.0) if periods is None else (law, blend(periods), periods * period)


def commands_in_flight(
    experiment: Experiment, law: ServoPreview, delay: Delay
) -> tuple[Array, Array]:
    """Return the first command (18,), and those in flight at t = 0 (L, 18), oldest first.

    The oldest in flight is reached at t = dt, or eta0 if that is above 0.
    """
    sc, length = experiment.scenario, delay.queue_length
    wanted = np.zeros((length + 1, NUM_REFERENCE))
    wanted[:, POSE] = experiment.start[POSE]
    wanted[0, RATES] = experiment.start[RATES]
    if sc.queue == "reference":
        ends = delay.eta(law.timeline.period) - law.timeline.period * np.arange(length)[::-1]
        if law.servo is not None:  # it holds a setpoint, which is that of the middle of the period
            ends = ends - law.timeline.period / 2
        moving = 1 if sc.start == "rest" else 0  # at rest the plate is not yet on the reference
        for row, t in zip(wanted[moving:], [0.0, *ends][moving:], strict=True):
            row[:] = evaluate(experiment.reference, t)
    if sc.queue == "zero":
        law = replace(law, feedforward=NoFeedforward())
    commands = np.array([law.command(x, law.plant.dynamics.parameters) for x in wanted])
    return commands[0], commands[1:]


def command_sent_last(experiment: Experiment, law: ServoPreview) -> Array:
    """Return the last command (18,) before t = 0, for the delay that the law assumes."""
    first, flying = commands_in_flight(experiment, law, law.timeline.delay)
    return flying[-1] if len(flying) else first
