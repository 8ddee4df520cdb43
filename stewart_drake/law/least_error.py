"""Path of least error onto a moving reference within a torque limit.

The shortest plan along a quintic (`law.catch_up`) reaches the torque limit at one time only, and
minimises its length instead of its error. Here N torques T_j are free, each held for a time, the
*hold* j. The plan of least error solves

    minimise   sum_j [ (|e_{j,1}|_Q^2 + |e_{j,2}|_Q^2) / 2 + |T_j - T_ff,j|_R^2 ]
    subject to |T_j| <= limit,  distances kept,  x_N on the reference,                    (least)

with the pose errors e at the two Gauss nodes of a hold, the torques T_ff of the reference, and the
distances of `law.clear_space`. The cost is that of `law.horizon`.

Sequential quadratic programming: each program (`law.horizon`) is linearised about the motion
under the torques of the last one, and has the end state as a further constraint. A fixed point
meets (least) and the equations of motion.
"""

import math
from dataclasses import dataclass
from typing import Final

import numpy as np
from pydrake.trajectories import Trajectory

from stewart_drake.dynamics.workspace import margins
from stewart_drake.law.clear_space import ClearSpace
from stewart_drake.law.feedforward import (
    GAUSS_NODES,
    InverseDynamicsFeedforward,
    mean_torques,
    means_and_changes,
    torques_at_nodes,
)
from stewart_drake.law.horizon import (
    HoldModel,
    HorizonCost,
    LeastDistance,
    condense,
    problem_of,
    riccati,
    solve_by_daqp,
)
from stewart_drake.law.nominal import NominalPlant
from stewart_drake.law.timeline import Timeline
from stewart_drake.mechanism.trajectories import evaluate, poses_along
from stewart_drake.scenario.signals import NUM_REFERENCE, NUM_STATE, POSE, RATES
from stewart_drake.scenario.timing import Delay
from stewart_drake.types import Array

LEAST_ERROR_SHARE: Final = 0.65
"""Share of the torque limit for a plan, which is at its limit for most of its time. Feedback needs
the rest."""
_LONGER: Final = 1.2
"""Length, as a share of that of the shortest plan; the error of longer ones is within 0.1 %."""
_MOST_HOLDS: Final = 40
"""Largest number of holds; a longer plan holds each torque for several periods."""
_PARTS: Final = 4
"""Parts of a hold, each a piece of the plan."""
_MAX_PROGRAMS: Final = 40
"""Largest number of quadratic programs; 8 are usual, 24 where the torque limit is tight."""
_END_TOLERANCE: Final = 1e-7
"""Largest error of the end state, each coordinate times the root of its weight Q."""
_VIOLATION: Final = 0.05
"""Largest violation of the distances during the iteration, in lengths of the shortest crank."""


@dataclass(frozen=True)
class LeastError:
    """Plans of least error."""

    plant: NominalPlant  # model of the plant
    space: ClearSpace  # distances to keep
    Q: Array  # (6,) weights of the pose error
    R: Array  # (6, 6) weights of the torques
    share: float = LEAST_ERROR_SHARE  # of the torque limit, see `law.catch_up`

    def pieces(
        self,
        motion: Trajectory,
        reference: Trajectory,
        start: Array,
        begin: float,
        period: float,
        periods: int,
        limit: float,
    ) -> Array | None:
        """Return the pieces (n, 38) of (least), see core/planning.h, or None without a solution.

        Args:
            motion: from the start onto the reference within the limit, then the reference.
            reference: the motion to reach.
            start: (12,) state at `begin`, s.
            period: of the controller, s.
            periods: until `motion` reaches the reference.
            limit: of each motor, N m.
        """
        # At least four periods more, in holds of a whole number of periods.
        longer = max(int(_LONGER * periods), periods + 4)
        periods_per_hold = math.ceil(longer / _MOST_HOLDS)
        number, hold = math.ceil(longer / periods_per_hold), periods_per_hold * period
        edges = begin + hold * np.arange(number + 1)
        torques = mean_torques(self.plant.dynamics, motion, edges[:-1], edges[1:])
        nodes = edges[:-1, None] + hold * GAUSS_NODES
        cost = HorizonCost(
            wanted=poses_along(reference, nodes.ravel()).reshape(*nodes.shape, 6),
            end=self._end(reference, edges[-1], period),
            torques=mean_torques(self.plant.dynamics, reference, edges[:-1], edges[1:]),
            Q=self.Q,
            R=self.R,
            P=np.diag(np.tile(self.Q, 2)),
        )
        try:
            found = self._solved(start, np.clip(torques, -limit, limit), hold, limit, cost)
        except (ArithmeticError, np.linalg.LinAlgError):
            return None
        return None if found is None else self._as_pieces(begin, hold, *found)

    def _end(self, reference: Trajectory, time: float, period: float) -> Array:
        """Return the end state (12,) from which held torques follow the reference.

        It differs from the reference by the offset (rates) of `law.feedforward` for the next hold.
        """
        dynamics, state = self.plant.dynamics, evaluate(reference, time)[:NUM_STATE].copy()
        next_hold = np.array([time]), np.array([time + period])
        means, changes = means_and_changes(torques_at_nodes(dynamics, reference, *next_hold))
        B = dynamics.linearize(state[POSE], state[RATES], means[0])[1][RATES]
        timeline, two_holds = Timeline(period, Delay(0)), np.array([np.zeros(6), changes[0]])
        return np.asarray(state + InverseDynamicsFeedforward().offset(two_holds, B, timeline))

    def _solved(
        self, start: Array, torques: Array, hold: float, limit: float, cost: HorizonCost
    ) -> tuple[Array, Array] | None:
        """Return states (N _PARTS + 1, 12) and torques (N, 6) that solve (least), or None."""
        holds = HoldModel(self.plant, self.plant.dynamics.parameters, hold)
        fine, size = self._motion(start, torques, hold), np.sqrt(np.tile(self.Q, 2))
        for _ in range(_MAX_PROGRAMS):
            states = fine[::_PARTS]
            model = holds.linearised(states, torques)
            model = model._replace(defects=np.zeros_like(model.defects))  # a motion has none
            m = condense(model, riccati(model, cost, states, torques), np.zeros(NUM_STATE))
            problem = problem_of(m, states[1:, POSE], torques, limit, self.space)
            missing = cost.end - states[-1] - m.states[-1]
            problem = _with_end(problem, size * m.state_map[-1].T, size * missing)
            change = m.torques + m.torque_map @ solve_by_daqp(problem)[problem.slacks :]
            for share in (1.0, 0.5, 0.25, 0.1):  # line search
                tried = np.clip(torques + share * change, -limit, limit)
                fine = self._motion(start, tried, hold)
                room = self.space.room(fine[::_PARTS, POSE])
                if np.isfinite(fine).all() and room.min() > -_VIOLATION:
                    break
            else:
                return None
            torques = tried
            if np.abs(size * (fine[-1] - cost.end)).max() <= _END_TOLERANCE:
                inside = margins(self.plant.mechanism, fine[:, POSE]).min() > 0
                return (fine, torques) if inside else None
        return None

    def _motion(self, start: Array, torques: Array, hold: float) -> Array:
        """Return the states (N _PARTS + 1, 12) under torques (N, 6)."""
        fine, step = np.repeat(torques, _PARTS, axis=0), hold / _PARTS
        substeps = self.plant.substeps_for(fine)
        return np.vstack([start, self.plant.dynamics.predict(start, fine, step, substeps)])

    def _as_pieces(self, begin: float, hold: float, states: Array, torques: Array) -> Array:
        """Return the pieces (N _PARTS, 38) of a motion: two times in s, and a row at each."""
        dynamics, number = self.plant.dynamics, len(states) - 1
        times = begin + hold / _PARTS * np.arange(number + 1)
        pieces = np.empty((number, 2 + 2 * NUM_REFERENCE))
        pieces[:, 0], pieces[:, 1] = times[:-1], times[1:]
        for i in range(number):
            for x, place in ((states[i], 2), (states[i + 1], 2 + NUM_REFERENCE)):
                torque = torques[i // _PARTS]
                row = np.append(x, dynamics.accelerations(x[POSE], x[RATES], torque))
                pieces[i, place : place + NUM_REFERENCE] = row
        return pieces


def _with_end(problem: LeastDistance, end_map: Array, missing: Array) -> LeastDistance:
    """Return a problem with the end state as equality constraint.

    Args:
        problem: of variables v (6 N,) after the slacks.
        end_map: (6 N, 12) whose transpose times v is the change of the end state.
        missing: (12,) required change.
    """
    rows = np.hstack([np.zeros((len(missing), problem.slacks)), end_map.T])
    return problem._replace(
        A=np.vstack([problem.A, rows]),
        lower=np.append(problem.lower, missing),
        upper=np.append(problem.upper, missing),
    )
