"""Model of the plant about a plan over a horizon, its Riccati equation, and plans within limits.

A plan has N holds of a period each. With x_j the state at the beginning of hold j, T_j its torque,
and a deviation (dx, dT) of both,

    dx_{j+1} = Phi_j dx_j + Gamma_j dT_j + f_j,   f_j = F(x_j, T_j) - x_{j+1}.          (plan)

The defects f vanish where the plan is a motion of the plant. A plan about a reference that the
plant cannot follow has some.

Quadratic program. With the Riccati equation the cost of all torques of a plan is |v|^2 / 2, v = 0
without limits. Limits are affine in v, so that the plan within them is a least-distance problem,

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

from stewart_drake.core.library import core
from stewart_drake.dynamics.stewart import StewartDynamics
from stewart_drake.law.belief import Belief
from stewart_drake.law.clear_space import ClearSpace
from stewart_drake.law.compiled import Once, machine_of, numbers
from stewart_drake.law.feedforward import GAUSS_NODES
from stewart_drake.law.nominal import NominalPlant
from stewart_drake.law.timeline import TorqueSchedule
from stewart_drake.scenario.signals import (
    BIAS,
    NUM_COORDINATES,
    NUM_PLANT_PARAMETERS,
    NUM_STATE,
    NUM_TORQUES,
    PARAMETERS,
    POSE,
)
from stewart_drake.types import Array

NODES = len(GAUSS_NODES)
"""Number of times within a hold at which the cost has the pose error."""


class Plan(NamedTuple):
    """States and torques of N holds, with the feedback that keeps the plant to them."""

    states: Array  # (N + 1, 12)
    torques: Array  # (N, 6) N m
    gains: Array  # (N, 6, 12), torque T_j - K_j (x - x_j) for a state x off the plan

    def later(self, state: Array, torque: Array) -> "Plan":
        """Return the plan without its first hold, and with a last one of this state and torque."""
        return Plan(
            np.vstack([self.states[1:], state]),
            np.vstack([self.torques[1:], torque]),
            np.concatenate([self.gains[1:], self.gains[-1:]]),
        )


class Linearised(NamedTuple):
    """Model (plan) of N holds."""

    # Phi, Gamma: (N, 12, 12) and (N, 12, 6)
    Phi: Array
    Gamma: Array
    defects: Array  # (N, 12)
    nodes: Array  # (N, 2, 6) poses of the plan at the Gauss nodes of each hold
    node_maps: Array  # (N, 2, 6, 18) of [dx_j; dT_j] to the poses there


class HoldModel:
    """Motion of the plant over single holds, and its derivatives.

    Derivatives by the torque are those by the torque bias, which `stewart_transitions` has.

    Args:
        parameters: (p,) free parameters of its dynamics, as estimated.
        period: of a hold, s.
    """

    def __init__(self, plant: NominalPlant, parameters: Array, period: float) -> None:
        c, dynamics = core(), plant.dynamics
        by_bias = _by_bias(plant)
        whole = dynamics.complete(parameters)
        machine = c.ffi.new("stewart_machine *", machine_of(by_bias).pointer[0])
        for i in range(NUM_PLANT_PARAMETERS):
            machine.parameters[i] = whole[i]
        self._core, self._machine = c, machine
        first, last = period * GAUSS_NODES
        self._xi = np.concatenate([np.zeros(NUM_STATE), whole[BIAS]])
        self._theta = self._xi[NUM_STATE:]
        self._torques = np.zeros((NODES + 1, NUM_TORQUES))
        self._durations = np.array([first, last - first, period - last])
        self._whole = np.array([period])
        self._states = np.empty((NODES + 1, NUM_STATE))
        self._H = np.empty((NODES + 1, NUM_STATE, NUM_STATE + NUM_TORQUES))
        at = c.at(self._torques)
        self._once = c.ffi.new("stewart_schedule *", [1, at, c.at(self._whole), 0])
        parts = NODES + 1, at, c.at(self._durations), plant.substeps
        self._parts = c.ffi.new("stewart_schedule *", parts)
        self._scratch = c.scratch(c.lib.stewart_transitions_scratch(NUM_TORQUES))
        self._given = c.at(self._xi), c.at(self._theta), c.at(self._states), c.at(self._H)

    def after(self, state: Array, torque: Array) -> Array:
        """Return the state (12,) after a hold of a torque (6,)."""
        xi, theta, states, _ = self._given
        self._xi[:NUM_STATE], self._torques[0] = state, torque
        null = self._core.ffi.NULL
        self._core.lib.stewart_predict(self._machine, theta, self._once, xi, null, states)
        return self._states[0].copy()

    def linearised(self, states: Array, torques: Array) -> Linearised:
        """Return the model about states (N + 1, 12) and torques (N, 6).

        Raises:
            ArithmeticError: the derivatives do not exist, as at a dead centre.
        """
        n, size = len(torques), NUM_STATE + NUM_TORQUES
        ends, H = np.empty((n, NODES + 1, NUM_STATE)), np.empty((n, NODES + 1, NUM_STATE, size))
        xi, theta, at, maps = self._given
        lib = self._core.lib
        for j, (state, torque) in enumerate(zip(states[:-1], torques, strict=True)):
            self._xi[:NUM_STATE], self._torques[:] = state, torque
            lib.stewart_predict(self._machine, theta, self._parts, xi, self._core.ffi.NULL, at)
            given = self._machine, xi, self._parts, 0, at, NUM_STATE * size, maps, self._scratch
            if not lib.stewart_transitions(*given):
                raise ArithmeticError("plan: no derivatives at a state of it")
            ends[j], H[j] = self._states, self._H
        steepest = np.abs(H[..., :NUM_STATE]).max()  # those by torques depend on the machine's size
        if not (np.isfinite(H).all() and steepest < _STEEPEST):
            raise ArithmeticError("plan: next to a dead centre")
        Phi, Gamma = np.split(H[:, -1], [NUM_STATE], axis=2)
        return Linearised(
            Phi,
            Gamma,
            ends[:, -1] - states[1:],
            ends[:, :NODES, POSE],
            H[:, :NODES, POSE],
        )


_STEEPEST = 1e6
"""Largest derivative of a state by another one over a hold; next to a dead centre they diverge."""


@Once
def _by_bias(plant: NominalPlant) -> NominalPlant:
    """Return the plant with the torque biases as its only free parameters."""
    d = plant.dynamics
    own = StewartDynamics(d.mechanism, d.gravity, d.plant_parameters, PARAMETERS[BIAS])
    return NominalPlant(own, plant.substeps, plant.coarse_torque_limit, plant.motors)


def pose_root(
    plant: NominalPlant, belief: Belief, schedule: TorqueSchedule, states: Array
) -> Array:
    """Return a root W (6, n) of the covariance W W' of the pose at the end of a prediction.

    With C the covariance of [state; parameters] now, and H the derivative of the predicted pose by
    both, W W' = H C H'. Without a covariance W is zero.

    Args:
        belief: now.
        schedule: torques (k, 6) of the prediction.
        states: (k, 12) predicted after each of them.

    Raises:
        ArithmeticError: the derivatives do not exist, as at a dead centre.
    """
    mean, number = belief.estimate.mean, len(schedule.torques)
    if not belief.estimate.uncertain:
        return np.zeros((NUM_COORDINATES, 1))
    H = np.eye(len(mean))[:NUM_STATE]
    if number:
        c, H = core(), np.empty((NUM_STATE, len(mean)))
        given = [numbers(a) for a in (mean, states, *schedule)]
        xi, after, torques, durations = map(c.at, given)
        until = c.ffi.new("stewart_schedule *", [number, torques, durations, 0])
        scratch = c.scratch(c.lib.stewart_transitions_scratch(len(belief.parameters)))
        arrays = until, 0, after, 0, c.at(H), scratch
        if not c.lib.stewart_transitions(machine_of(plant).pointer, xi, *arrays):
            raise ArithmeticError("prediction: no derivatives at a state of it")
    return np.asarray(H[POSE] @ belief.estimate.covariance_root)


class HorizonCost(NamedTuple):
    """Cost of a plan: the law's, with the pose error at the Gauss nodes of each hold.

        J = sum_j [ (|e_{j,1}|_Q^2 + |e_{j,2}|_Q^2) / 2 + |T_j - T_ff,j|_R^2 ] + |e_N|_P^2

    Two Gauss nodes integrate the squared error of a motion between samples. A cost at the samples
    alone allows large torques of alternating sign there.
    """

    wanted: Array  # (N, 2, 6) poses of the reference at the nodes
    end: Array  # (12,) reference at the end of the last hold
    torques: Array  # (N, 6) feedforward, N m
    Q: Array  # (6,) diagonal
    R: Array  # (6, 6)
    P: Array  # (12, 12)


class Policy(NamedTuple):
    """Solution of the Riccati equation without limits: dT_j = d_j - K_j dx_j.

    A further c_j on dT_j costs c_j' S_j c_j / 2 more, S_j = L_j L_j'.
    """

    # K, d, L: (N, 6, 12), (N, 6), (N, 6, 6)
    K: Array
    d: Array
    L: Array


def riccati(model: Linearised, cost: HorizonCost, states: Array, torques: Array) -> Policy:
    """Solve the time-varying linear quadratic problem about a plan.

    With y = [dx_j; dT_j], M = [Phi_j Gamma_j] and W_g the map of y to the pose at node g,

        H = sum_g W_g' Q W_g / 2 + diag(0, R) + M' P_{j+1} M,
        g = sum_g W_g' Q e_g / 2 + [0; R (T_j - T_ff,j)] + M' (P_{j+1} f_j + p_{j+1}).

    In blocks of dx and dT, S = H_TT, K = S^-1 H_Tx, d = -S^-1 g_T,
    P_j = H_xx - H_xT K,  p_j = g_x - K' g_T.

    Raises:
        np.linalg.LinAlgError: a matrix S is not positive definite.
    """
    n, x = len(torques), NUM_STATE
    K, d, S = np.empty((n, 6, x)), np.empty((n, 6)), np.empty((n, 6, 6))
    weights = np.tile(cost.Q, NODES) / NODES
    P, p = cost.P, cost.P @ (states[-1] - cost.end)
    maps = model.node_maps.reshape(n, NODES * NUM_COORDINATES, -1)
    weighted, errors = maps.swapaxes(1, 2) * weights, (model.nodes - cost.wanted).reshape(n, -1)
    M = np.concatenate([model.Phi, model.Gamma], axis=2)
    Hs, gs = weighted @ maps, (weighted @ errors[..., None])[..., 0]
    Hs[:, x:, x:] += cost.R
    gs[:, x:] += (torques - cost.torques) @ cost.R.T
    for j in range(n - 1, -1, -1):
        H = Hs[j] + M[j].T @ P @ M[j]
        g = gs[j] + M[j].T @ (P @ model.defects[j] + p)
        S[j] = H[x:, x:]
        solved = np.linalg.solve(S[j], np.column_stack([H[x:, :x], g[x:]]))
        K[j], d[j] = solved[:, :x], -solved[:, x]
        P, p = H[:x, :x] - H[:x, x:] @ K[j], g[:x] - K[j].T @ g[x:]
        P = (P + P.T) / 2
    return Policy(K, d, np.linalg.cholesky(S))


class Condensed(NamedTuple):
    """Deviations of a plan by v (6 N,), c_j = L_j^-T v_j: an affine map.

    The cost is |v|^2 / 2 and a constant.
    """

    # states, torques: (N + 1, 12) and (N, 6) at v = 0, deviations from the plan
    states: Array
    torques: Array
    # state_map, torque_map: (N + 1, 12, 6 N) and (N, 6, 6 N)
    state_map: Array
    torque_map: Array


def condense(model: Linearised, policy: Policy, offset: Array) -> Condensed:
    """Return the deviations that begin at `offset` (12,), as functions of v."""
    n, u = len(policy.d), NUM_TORQUES
    states, torques = np.zeros((n + 1, NUM_STATE)), np.zeros((n, u))
    by_v, torque_by_v = np.zeros((n + 1, NUM_STATE, n * u)), np.zeros((n, u, n * u))
    states[0], inverses = offset, np.linalg.inv(policy.L).swapaxes(1, 2)
    for j in range(n):
        here, used = slice(u * j, u * (j + 1)), u * (j + 1)  # v_j acts from hold j on
        torques[j] = policy.d[j] - policy.K[j] @ states[j]
        torque_by_v[j, :, :used] = -policy.K[j] @ by_v[j, :, :used]
        torque_by_v[j, :, here] += inverses[j]
        Phi, Gamma = model.Phi[j], model.Gamma[j]
        states[j + 1] = Phi @ states[j] + Gamma @ torques[j] + model.defects[j]
        by_v[j + 1, :, :used] = Phi @ by_v[j, :, :used] + Gamma @ torque_by_v[j, :, :used]
    return Condensed(states, torques, by_v, torque_by_v)


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
        root: (6, n) of the covariance of the pose where the plan begins, see `pose_root`.
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
