"""The predictive law within limits of torque, reach and clearance.

At each sample `PredictiveLqi` computes its torque. From the predicted state at t + eta, where that
torque begins to act, its plan for N further periods follows: the same gain and feedforward. If this
plan meets all limits, its torque is sent, unchanged. Otherwise the plan is replaced by a
solution of the quadratic program (qp), linearised a few times about the plan found so far.

1. The first plan is the last one without its first hold, or else the reference, shrunk into the
   workspace where it leaves it.
2. Linearise (plan), solve the Riccati equation, condense, solve (qp).
3. Integrate the equations of motion under the new torques and the gains of 2, within the torque
   limit. A step that leads to the end of a leg's reach is shortened. Then repeat from 2.

The cost at the end of the horizon is TERMINAL times the Riccati solution for torques that cost
TERMINAL_R times as much. No terminal set exists: around a reference that takes more than the limits
no set is invariant. The two factors stand for the limits beyond the horizon, which no Riccati
solution knows (theory.md).
"""

import math
import time
from dataclasses import dataclass, field, replace
from typing import Any, Final, NamedTuple

import numpy as np

from stewart_drake.law.belief import Belief
from stewart_drake.law.channel import Report
from stewart_drake.law.clear_space import RESERVE, ClearSpace
from stewart_drake.law.cost import QuadraticCost
from stewart_drake.law.counts import Counts
from stewart_drake.law.feedforward import GAUSS_NODES
from stewart_drake.law.horizon import (
    NODES,
    HoldModel,
    HorizonCost,
    Plan,
    QpError,
    Solver,
    condense,
    pose_root,
    problem_of,
    riccati,
    solve_by_daqp,
)
from stewart_drake.law.memory import Memory
from stewart_drake.law.motion import Motion, Preview
from stewart_drake.law.nominal import NominalPlant, TorqueLimit
from stewart_drake.law.predictive_lqi import OuterLqi, OuterMemory
from stewart_drake.law.riccati import lqr_by_doubling
from stewart_drake.law.sensing import Measurement
from stewart_drake.law.timeline import Timeline
from stewart_drake.mechanism.kinematics import reach_margins
from stewart_drake.scenario.signals import NUM_COORDINATES, NUM_STATE, POSE
from stewart_drake.types import Array

TERMINAL: Final = 3.0
"""Cost at the end of the horizon over the Riccati solution."""
TERMINAL_R: Final = 100.0
"""Weight of torques in that Riccati equation over the law's."""
LINEARISATIONS: Final = 2
"""Quadratic programs per sample."""
_STEPS: Final = (1.0, 0.5, 0.25, 0.1)
"""Shares of the way to a solution that are tried."""
_INTO_RESERVE: Final = 0.5
"""Share of the distances to keep that the free law may use up before a plan replaces it."""
_EDGE: Final = 0.25
"""Least reach margin of a plan, as a share of the distance to keep."""


@dataclass(frozen=True, eq=False)
class QpLimits:
    """Limits that a plan keeps."""

    horizon: int  # N, number of periods
    space: ClearSpace  # distances to keep
    solver: Solver = solve_by_daqp  # of (qp)
    # time for a step, s, infinite in a simulation. Beyond it the last plan is continued
    budget: float = math.inf


@dataclass(frozen=True)
class LimitedMemory(OuterMemory):
    """Memory of `law.limited.LimitedLqi`; other names are those of the free law's memory.

    Attributes:
        free: memory of the law without limits, with the torques that were sent.
        plan: last plan, where the limits did bind at the last sample, else None.
        of_limits: counts of the samples in which a limit did bind, and of failures then.
    """

    plan: Plan | None = None
    of_limits: Counts = field(default_factory=Counts)

    @property
    def counts(self) -> Counts:
        return Counts(*map(sum, zip(self.free.counts, self.of_limits, strict=True)))

    def without_error(self) -> "LimitedMemory":
        return replace(self, free=self.free.without_error())


class _Ahead(NamedTuple):
    """Reference over the horizon."""

    rows: Array  # (N + 1, 18) at the beginning of each hold and the end of the last
    nodes: Array  # (2 (N + 2), 18) at the Gauss nodes of the holds and a neighbour on each side
    share: float  # factor on its distance from home that keeps the reach, at most 1
    torques: Array  # (N, 6) feedforward of the shrunk reference, N m

    def states(self, space: ClearSpace) -> Array:
        """Return the states (N + 1, 12) of the shrunk reference."""
        return space.scaled(self.rows, self.share)[:, :NUM_STATE]


@dataclass(frozen=True, eq=False)
class _Search:
    """Search for a plan within the limits, from one state."""

    plant: NominalPlant  # model of the plant
    limits: QpLimits  # to keep
    holds: HoldModel  # motion of the plant over single holds
    start: Array  # (12,) state at the beginning of the plan
    reference: Plan  # plan that replaces another one after the edge of the workspace

    def continued(self, last: Plan) -> Plan:
        """Return the motion of the plant along the last plan, a hold later."""
        later = last.later(self.reference.states[-1], self.reference.torques[-1])
        return self._along(later, 0) or later

    def within(self, plan: Plan, cost: HorizonCost, root: Array, until: float) -> Plan:
        """Return the plan after LINEARISATIONS quadratic programs, fewer if time is short.

        Args:
            plan: to begin with.
            root: (6, n) of the covariance of the pose at the start, see `law.horizon.pose_root`.
            until: end of the time, s, as of `time.perf_counter`.

        Raises:
            QpError: the first one has no solution.
            ArithmeticError: the model or its Riccati equation does not exist.
        """
        limits, motors = self.limits, self.plant.motors
        for number in range(LINEARISATIONS):
            left = until - time.perf_counter()
            if left <= 0:
                if number > 0:
                    break
                raise QpError("QP: no time is left", late=True)
            try:
                model = self.holds.linearised(plan.states, plan.torques)
                policy = riccati(model, cost, plan.states, plan.torques)
                m = condense(model, policy, self.start - plan.states[0])
                poses = plan.states[1:, POSE]
                problem = problem_of(m, poses, plan.torques, motors.limit, limits.space, root)
                v = limits.solver(problem, left)[problem.slacks :]
            except (ArithmeticError, np.linalg.LinAlgError):
                if number > 0:
                    break
                raise
            change = Plan(m.states + m.state_map @ v, m.torques + m.torque_map @ v, policy.K)
            plan = self._towards(plan, change)
        return plan

    def _towards(self, plan: Plan, change: Plan) -> Plan:
        """Return the motion of the plant for the largest step that stays within the first half."""
        for share in _STEPS:
            least = 0 if share == _STEPS[-1] else self.limits.horizon // 2
            wanted = Plan(
                plan.states + share * change.states,
                plan.torques + share * change.torques,
                change.gains,
            )
            moved = self._along(wanted, least)
            if moved is not None:
                return moved
        raise QpError("QP: no step keeps the plate in its workspace")

    def _along(self, plan: Plan, least: int) -> Plan | None:
        """Return the motion of the plant along a plan; the reference replaces it after an edge.

        None if one of the first `least` holds leads to the edge of the workspace.
        """
        states, torques = plan.states.copy(), plan.torques.copy()
        states[0], mechanism = self.start, self.plant.mechanism
        for j, (torque, K) in enumerate(zip(plan.torques, plan.gains, strict=True)):
            torques[j] = self.plant.motors.saturate(torque - K @ (states[j] - plan.states[j]))
            states[j + 1] = self.holds.after(states[j], torques[j])
        edge = _EDGE * RESERVE * mechanism.crank_lengths.min()
        beyond = ~(reach_margins(mechanism, states[1:, POSE]).min(axis=1) > edge)
        if beyond[:least].any():
            return None
        if beyond.any():
            first = int(np.argmax(beyond))
            states[first + 1 :] = self.reference.states[first + 1 :]
            torques[first + 1 :] = self.reference.torques[first + 1 :]
        finite = np.isfinite(states).all() and np.isfinite(torques).all()
        return Plan(states, torques, plan.gains) if finite else None


@dataclass(frozen=True)
class LimitedLqi(OuterLqi):
    """`PredictiveLqi` whose torques come from a quadratic program where a limit binds."""

    limits: QpLimits = field(kw_only=True)  # to keep

    def times_for(self, timeline: Timeline) -> Array:
        """Return the times (p,) of a preview: those of the free law, then those of the horizon."""
        n = self.limits.horizon
        ends = timeline.holds(0, n)
        nodes = timeline.holds(-1, n)[:, None] + timeline.period * GAUSS_NODES
        return np.concatenate([self.free.times_for(timeline), ends, nodes.ravel()])

    def initial_memory(self, queue: Array) -> Any:
        return LimitedMemory(self.free.initial_memory(queue))

    def step(
        self,
        memory: Any,
        measurement: Measurement,
        motion: Motion,
        weights: Array,
        report: Report | None = None,
    ) -> Any:
        """Compute the torque of one sample; see `PredictiveLqi.step`.

        Returns:
            The new memory. Its torque is that of the free law where its plan meets the limits.
        """
        begun, before = time.perf_counter(), memory.free
        own = self.free.preview_times
        times, given = self.preview_times[len(own) :], motion
        if not self.free.moves:
            rows = np.asarray(motion(self.preview_times))
            given, motion = Preview(own, rows[: len(own)]), Preview(times, rows[len(own) :])
        after = self.free.step(before, measurement, given, weights, report)
        further = after.compiled.followed(after, motion, times)
        following = replace(memory, free=after, plan=None)  # with the free law's torque
        open_loop = before.open_loop_samples > 0 and after.open_loop_samples > 0
        if open_loop or not after.belief.feeds_back or not np.isfinite(further).all():
            return following
        belief, timeline = after.belief, after.belief.timeline
        flying = after.in_flight[:-1]
        queue = flying[len(flying) - timeline.queue_length :]
        schedule, start, predicted = timeline.until_next(queue), belief.state, np.empty(0)
        if len(queue):
            predicted = self.plant.predict(belief.state, schedule, belief.parameters)
            start = predicted[-1]
        holds = HoldModel(self.plant, belief.parameters, timeline.period)
        ahead = self._ahead(further, belief)
        if self._meets_limits(after, ahead, start, holds):
            return following
        until = begun + self.limits.budget
        search = _Search(self.plant, self.limits, holds, start, self._reference_plan(ahead))
        plan = last = None if memory.plan is None else search.continued(memory.plan)
        cause = None
        try:
            cost = self._cost(after, ahead, holds, weights * [1.0, self.caution(belief)])
            root = pose_root(self.plant, belief, schedule, predicted)
            try:
                plan = search.within(last or search.reference, cost, root, until)
            except (ArithmeticError, np.linalg.LinAlgError):
                if last is None:
                    raise
                plan = search.within(search.reference, cost, root, until)
        except (ArithmeticError, np.linalg.LinAlgError) as error:  # the last plan goes on
            cause = "qp_late" if isinstance(error, QpError) and error.late else "qp_failures"
        torques = after.plan
        if plan is not None:  # which may be shorter than a packet
            torques = np.vstack([plan.torques[: len(torques)], torques[len(plan.torques) :]])
        sent = _sending(after, torques, before, self.plant.motors)
        counts = memory.of_limits.plus("limited_steps", cause)
        return replace(memory, free=sent, plan=plan, of_limits=counts)

    def _ahead(self, further: Array, belief: Belief) -> _Ahead:
        n, space, dynamics = self.limits.horizon, self.limits.space, self.plant.dynamics
        rows, nodes = further[: n + 1], further[n + 1 :]
        share = space.reachable_share(further[:, POSE])
        within = space.scaled(nodes, share)
        held = self.feedforward.held(within, dynamics, belief.parameters)
        return _Ahead(rows, nodes, share, held.torques)

    def _meets_limits(self, after: Any, ahead: _Ahead, start: Array, holds: HoldModel) -> bool:
        """Return whether the plan of the free law meets the limits: gain and feedforward go on.

        The integral goes on by the trapezoid rule.
        """
        gain, motors, dt = after.gain, self.plant.motors, self.timeline.period
        size = NUM_STATE + NUM_COORDINATES * self.cost.integrates
        if ahead.share < 1 or not np.isfinite(gain).all():
            return False
        torque, state, integral = after.torque, start, after.integral
        wanted = ahead.rows[:, :NUM_STATE]
        error, states = state - wanted[0], []
        for j in range(self.limits.horizon):
            if j > 0:
                regulated = np.concatenate([error, integral])[:size]
                torque = ahead.torques[j] - gain[:, :size] @ regulated
            if not np.abs(torque).max() <= motors.limit:
                return False
            last, state = error, holds.after(state, torque)
            error = state - wanted[j + 1]
            integral = integral + dt / 2 * (last[POSE] + error[POSE])
            states.append(state)
        space, poses = self.limits.space, np.array(states)[:, POSE]
        return bool(np.all(space.room(poses) >= -_INTO_RESERVE * space.least))

    def _cost(self, after: Any, ahead: _Ahead, holds: HoldModel, weights: Array) -> HorizonCost:
        """Return the cost of a plan, with TERMINAL times the Riccati solution at its end.

        The integral is constant in a plan; its share of the law's torque joins the feedforward.
        """
        assert isinstance(self.cost, QuadraticCost)  # of `controller.kind: lqi`
        Q, R = self.cost.matrices(weights)
        errors = np.zeros(NUM_STATE)
        errors[POSE] = np.diag(Q)[:NUM_COORDINATES]
        ends = np.tile(ahead.states(self.limits.space)[-1], (2, 1))
        last = holds.linearised(ends, ahead.torques[-1:])
        _, P = lqr_by_doubling(last.Phi[0], last.Gamma[0], np.diag(errors), TERMINAL_R * R)
        torques = ahead.torques
        if self.cost.integrates and np.isfinite(after.gain).all():
            size = NUM_STATE + NUM_COORDINATES
            torques = torques - after.gain[:, NUM_STATE:size] @ after.integral
        nodes = ahead.nodes[NODES:-NODES, POSE].reshape(-1, NODES, NUM_COORDINATES)
        end = ahead.rows[-1, :NUM_STATE]
        return HorizonCost(nodes, end, torques, errors[POSE], R, TERMINAL * P)

    def _reference_plan(self, ahead: _Ahead) -> Plan:
        """Return the shrunk reference, with its torques within the limit."""
        torques = self.plant.motors.saturate(ahead.torques)
        gains = np.zeros((len(torques), 6, NUM_STATE))
        return Plan(ahead.states(self.limits.space), torques, gains)


def _sending(memory: Memory, torques: Array, before: Memory, motors: TorqueLimit) -> Memory:
    """Return the memory of the free law with other torques (n, 6) sent.

    Its integral is that of the memory `before` the sample. Of the torques at the limit it counts
    the one that is sent, not the free law's.
    """
    after = memory.copy()
    reached = before.counts.saturated_steps + motors.reached(torques[0])
    after.field("counts")[Counts._fields.index("saturated_steps")] = reached
    after.field("torque")[:], after.in_flight[-1] = torques[0], torques[0]
    after.field("integral")[:] = before.integral
    after.plan[:] = torques
    packets = after.sent.packets
    if len(packets):
        packets[-1, -len(torques) :] = torques
    return after
