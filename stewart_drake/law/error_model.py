"""The error model, equations (20)-(28), in block order e = [pose error; rate error; integral].

About a reference, e_bar = [X - X_d; d(X - X_d)/dt] obeys  e_bar_dot = A e_bar + B T + d,  with d
the rest: minus the desired acceleration, gravity (21).
"""

from typing import NamedTuple

import numpy as np

from stewart_drake.scenario.signals import NUM_COORDINATES, NUM_STATE, POSE, RATES
from stewart_drake.types import Array


class ContinuousModel(NamedTuple):
    """Model e_dot = A e + B T, A (n, n), B (n, m); the cost has the output y = C e, C (p, n)."""

    A: Array
    B: Array
    C: Array


def double_integrators(torque_map: Array) -> ContinuousModel:
    """Return (20)-(23): accelerations = torque_map (6, 6) torque; C selects the pose error."""
    A = np.zeros((NUM_STATE, NUM_STATE))
    A[POSE, RATES] = np.eye(NUM_COORDINATES)
    B = np.zeros((NUM_STATE, torque_map.shape[1]))
    B[RATES] = torque_map
    return linear_model(A, B)


def linear_model(A: Array, B: Array) -> ContinuousModel:
    """Return the model of any A (12, 12), B (12, 6) of [pose; rates]."""
    return ContinuousModel(A, B, np.eye(NUM_COORDINATES, NUM_STATE))


def with_integral(model: ContinuousModel) -> ContinuousModel:
    """Return (24)-(28): 18 states with z_dot = pose error; C selects pose error and integral."""
    n, m = model.B.shape
    p = model.C.shape[0]
    A = np.block([[model.A, np.zeros((n, p))], [model.C, np.zeros((p, p))]])
    B = np.vstack([model.B, np.zeros((p, m))])
    C = np.block([[model.C, np.zeros((p, p))], [np.zeros((p, n)), np.eye(p)]])
    return ContinuousModel(A, B, C)
