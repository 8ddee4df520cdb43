"""The error model, equations (20)-(28), in block order e = [pose error; rate error; integral].

About a reference, e_bar = [X - X_d; d(X - X_d)/dt] obeys  e_bar_dot = A e_bar + B T + d,  with d
everything that neither error nor torque explains: minus the desired acceleration, gravity (21).
"""

from typing import NamedTuple

import numpy as np

from stewart_drake.scenario.signals import NUM_COORDINATES, NUM_STATE, POSE, RATES
from stewart_drake.types import Array


class ContinuousModel(NamedTuple):
    """A (n, n), B (n, m) of e_dot = A e + B T and C (p, n) of what the cost sees, y = C e."""

    A: Array
    B: Array
    C: Array


def double_integrators(torque_map: Array) -> ContinuousModel:
    """(20)-(23): accelerations = torque_map (6, 6) torque, nothing else; C picks the pose error."""
    A = np.zeros((NUM_STATE, NUM_STATE))
    A[POSE, RATES] = np.eye(NUM_COORDINATES)
    B = np.zeros((NUM_STATE, torque_map.shape[1]))
    B[RATES] = torque_map
    return linear_model(A, B)


def linear_model(A: Array, B: Array) -> ContinuousModel:
    """Any A (12, 12), B (12, 6) of [pose; rates], such as `StewartDynamics.linearize` gives."""
    return ContinuousModel(A, B, np.eye(NUM_COORDINATES, NUM_STATE))


def with_integral(model: ContinuousModel) -> ContinuousModel:
    """(24)-(28): z_dot = pose error appended, 18 states; C picks pose error and integral (28)."""
    n, m = model.B.shape
    p = model.C.shape[0]
    A = np.block([[model.A, np.zeros((n, p))], [model.C, np.zeros((p, p))]])
    B = np.vstack([model.B, np.zeros((p, m))])
    C = np.block([[model.C, np.zeros((p, p))], [np.zeros((p, n)), np.eye(p)]])
    return ContinuousModel(A, B, C)
