"""Quadratic program of a plan within limits, as a least-distance problem.

With the Riccati equation of `law.horizon` the cost of all torques of a plan is |v|^2 / 2, v = 0
without limits. Limits are affine in v, so that the plan within them is

    minimise   |v|^2 / 2 + sum_j (w s_j + q s_j^2 / 2)   over v and s >= 0
    subject to |T_j| <= limit,                                                          (qp)
               room_i(x_j) - sigma_i + s_j >= 0    for each leg and pair of links i that is near.

sigma_i is the standard deviation of the room where the plan begins: parameters that are not yet
known may lead the plate nearer to the edge than the plan does. It is not propagated along the plan,
since each later sample plans again and knows more.
The room has one slack s_j per sample, with the linear penalty w. It is exact: s = 0 wherever a plan
within the workspace exists, since w exceeds the multipliers. The identity as Hessian needs no
factorisation, and a dual active-set method starts at v = 0.
"""

from collections.abc import Callable
from typing import Final, NamedTuple

import daqp
import numpy as np

from stewart_drake.law.clear_space import ClearSpace
from stewart_drake.law.horizon import Condensed
from stewart_drake.scenario.signals import NUM_COORDINATES, POSE
from stewart_drake.types import Array

SLACK_WEIGHT = 1e3
"""Cost w of the slack per shortest crank; a pose error of the whole motion costs 1/2."""
_SLACK_CURVATURE = 0.1
KNOWN: Final = np.zeros((NUM_COORDINATES, 1))
"""Root of the covariance of a pose that is known exactly."""
NEAR = 0.25
"""Room, in shortest cranks, below which a distance is a constraint."""
MOST_ITERATIONS = 1000
"""Iterations of the solver; some 10 to 200 are usual."""


class LeastDistance(NamedTuple):
    """Problem (qp): minimise h.z^2 / 2 + g.z, z = [s; v], for s >= 0 and lower <= A z <= upper."""

    # h, g: (n,) with n = slacks + 6 N
    h: Array
    g: Array
    A: Array  # (m, n)
    # lower, upper: (m,); the upper one may be infinite
    lower: Array
    upper: Array
    slacks: int  # number of s


class QpError(ArithmeticError):
    """The solver found no solution.

    Attributes:
        late: whether it took more iterations or time than it may.
    """

    def __init__(self, text: str, late: bool = False) -> None:
        super().__init__(text)
        self.late = late


Solver = Callable[[LeastDistance, float], Array]
"""Returns z (n,) of a problem within a time in s, which may be infinite; else raises QpError."""


def problem_of(
    found: Condensed,
    poses: Array,
    torques: Array,
    limit: float,
    space: ClearSpace,
    root: Array = KNOWN,
) -> LeastDistance:
    """Return (qp) of a plan.

    Args:
        found: deviations from the plan.
        poses: (N, 6) of the plan at the ends of its holds.
        torques: (N, 6) of the plan, N m.
        limit: of each motor, N m, infinite for none.
        space: distances to keep.
        root: (6, n) of the covariance of the pose where the plan begins, see `horizon.pose_root`.
    """
    n = torques.size
    near = space.near(poses, NEAR)
    uncertainty = np.linalg.norm(near.slopes @ root, axis=1)  # one standard deviation of the room
    samples, column = np.unique(near.pose, return_inverse=True)
    moved = np.einsum("ri,ri->r", near.slopes, found.states[1:][near.pose, POSE])
    by_v = np.einsum("ri,riv->rv", near.slopes, found.state_map[1:][near.pose, POSE])
    slack, number = np.eye(len(samples))[column], len(samples)
    A, lower = [np.hstack([slack, by_v])], [uncertainty - near.room - moved]
    upper = [np.full(len(column), np.inf)]
    if np.isfinite(limit):
        by_torque = found.torque_map.reshape(n, n) / limit
        held = (torques + found.torques).ravel() / limit
        A.append(np.hstack([np.zeros((n, number)), by_torque]))
        lower, upper = [*lower, -1 - held], [*upper, 1 - held]
    return LeastDistance(
        h=np.concatenate([np.full(number, _SLACK_CURVATURE * SLACK_WEIGHT), np.ones(n)]),
        g=np.concatenate([np.full(number, SLACK_WEIGHT), np.zeros(n)]),
        A=np.vstack(A),
        lower=np.concatenate(lower),
        upper=np.concatenate(upper),
        slacks=number,
    )


_INFINITE: Final = 1e30  # of DAQP
_ITERATION_LIMIT, _TIME_LIMIT = -4, -7  # its exit flags


def solve_by_daqp(problem: LeastDistance, seconds: float = np.inf) -> Array:
    """Return the solution by DAQP, a dual active-set method; see `Solver`."""
    h, slacks = problem.h, problem.slacks
    lower = np.concatenate([np.zeros(slacks), problem.lower])  # the first ones bound s itself
    upper = np.concatenate([np.full(slacks, np.inf), problem.upper])
    z, _, flag, _ = daqp.solve(
        *(np.diag(h), problem.g, np.ascontiguousarray(problem.A)),
        *(np.minimum(upper, _INFINITE), lower, np.zeros(len(lower), np.int32)),
        iter_limit=MOST_ITERATIONS,
        time_limit=seconds if np.isfinite(seconds) else 0,
    )
    if flag < 1 or not np.isfinite(z).all():
        late = flag in (_ITERATION_LIMIT, _TIME_LIMIT)
        raise QpError(f"QP: DAQP ended with flag {flag}", late)
    return np.asarray(z)
