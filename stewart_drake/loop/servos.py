"""The servos of a machine as a Drake system: local loops at its motors."""

from contextlib import suppress
from typing import Any, NamedTuple

import numpy as np
from pydrake.common.value import Value
from pydrake.systems.framework import BasicVector, Context, LeafSystem, State

from stewart_drake.dynamics.stewart import StewartDynamics
from stewart_drake.law.servos import ReportLayout, Segment, ServoLoop, still
from stewart_drake.loop.sampling import update_every, weak
from stewart_drake.mechanism.kinematics import UnreachablePoseError
from stewart_drake.scenario.signals import (
    MODEL_TORQUE,
    NUM_REFERENCE,
    NUM_STATE,
    NUM_TORQUES,
    POSE,
    RATES,
    SETPOINT,
)
from stewart_drake.scenario.timing import servo_time
from stewart_drake.types import Array


class ServoState(NamedTuple):
    """What servos remember."""

    segment: Segment
    """The way of the setpoint to the command that arrived last."""
    arrived: float
    """When that did, s; NaN before any has."""
    setpoint: Array
    """(12,) that was followed last."""
    asked: Array
    """(6,) torque before the limit, N m."""
    put_out: Array
    """(n, 6) torques of the periods that are reported, the oldest first; NaN before the start."""

    @property
    def torque(self) -> Array:
        """(6,) what acts, N m."""
        return np.nan_to_num(self.put_out[-1])

    def __deepcopy__(self, memo: dict[int, Any]) -> "ServoState":
        """Drake copies what it keeps; nobody changes this, so that itself will do."""
        return self


class Servos(LeafSystem):
    """Follows the crank angles that arrive, with a local loop at each motor (`law.servos`).

    With h the period of the loops, x the state, c the command that has arrived, at t_c:

    Update:  every h  segment  <- on to c, from where the setpoint was at t_c, if c is new;
                      setpoint <- segment(t), as fast as the speed limit allows;
                      asked    <- J (w^2 (a_r - a(x)) + 2 d w (a_r' - a'(x))) + tau_model.
    Output:  torque = asked within the limit, held; report = what the last periods' torques were.

    It ticks after the events of an instant and before a discrete plant's step (`servo_time`): a
    torque acts that knows the state of now. A command that is no number is not followed. Where the
    pose has no crank angles, at the workspace's edge, where the plant ends the run, the torque is
    held.

    | port | direction | size | unit | rate |
    | --- | --- | --- | --- | --- |
    | command | input | 18 | rad, rad/s, N m | read every h |
    | arrived | input | 1 | s, when the command arrived | the same |
    | state | input | 12 | rad, m, rad/s, m/s | the same |
    | torque | output | 6 | N m | held for h |
    | report | output | of `law.servos.ReportLayout` | N m | meant to be read at samples |

    Args:
        loop: of each motor.
        dynamics: of the machine as it is: kinematics, and the limit at the crank.
        command: (18,) to be held until one arrives.
        period: of the commands, s, a whole number of the loops'.
        reports: what the report tells of.
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
        self._loop, self._dynamics, self._period, self.reports = loop, dynamics, period, reports
        nothing = np.full((reports.periods * round(period / loop.period), NUM_TORQUES), np.nan)
        setpoint, asked = command[SETPOINT], np.zeros(NUM_TORQUES)
        first = ServoState(still(command, 0.0), np.nan, setpoint, asked, nothing)
        self._memory = self.DeclareAbstractState(Value(first))
        self._command = self.DeclareVectorInputPort("command", NUM_REFERENCE)
        self._arrived = self.DeclareVectorInputPort("arrived", 1)
        self._state = self.DeclareVectorInputPort("state", NUM_STATE)
        ticket = {self.abstract_state_ticket(self._memory)}
        self.DeclareVectorOutputPort("torque", NUM_TORQUES, weak(self._torque), ticket)
        self.DeclareVectorOutputPort("report", reports.size, weak(self._report), ticket)
        update_every(self, loop.period, self._tick, servo_time)

    def remembered(self, context: Context) -> ServoState:
        """What is remembered in a context of this system."""
        value: Any = context.get_abstract_state(int(self._memory))
        return value.get_value()

    def _tick(self, context: Context, state: State) -> None:
        before, now = self.remembered(context), context.get_time()
        segment, arrived = self._segment(before, context)
        wanted = segment.at(now, self._period)
        setpoint = self._loop.limited(wanted[SETPOINT], before.setpoint[POSE])
        asked = before.asked
        with suppress(UnreachablePoseError):
            cranks = self._cranks(np.asarray(self._state.Eval(context)))
            asked = self._loop.torque(setpoint, wanted[MODEL_TORQUE], cranks)
        put_out = np.vstack([before.put_out[1:], self._loop.motors.let_through(asked)])
        after = ServoState(segment, arrived, setpoint, asked, put_out)
        state.get_mutable_abstract_state(int(self._memory)).set_value(after)

    def _segment(self, before: ServoState, context: Context) -> tuple[Segment, float]:
        arrived = float(np.asarray(self._arrived.Eval(context))[0])
        command = np.array(self._command.Eval(context))
        if arrived == before.arrived or not np.all(np.isfinite([arrived, *command])):
            return before.segment, before.arrived
        begin = max(arrived, before.segment.begin)
        return before.segment.then(command, begin, arrived + self._period, self._period), arrived

    def _cranks(self, state: Array) -> Array:
        """Crank angles and rates (12,) of pose and rates (12,)."""
        angles = self._dynamics.mechanism.crank_angles(state[POSE])
        rates = self._dynamics.actuation_map(state[POSE]).T @ state[RATES]
        return np.concatenate([angles, rates])

    def _torque(self, context: Context, output: BasicVector) -> None:
        output.SetFromVector(self.remembered(context).torque)

    def _report(self, context: Context, output: BasicVector) -> None:
        memory = self.remembered(context)
        report = self.reports.written(memory.put_out, memory.asked, self._loop.motors)
        output.SetFromVector(report)
