"""What is fixed before the loop starts: torques in flight, weights, steps of the prediction."""

from typing import Literal

import numpy as np
from numpy.typing import NDArray
from pydrake.trajectories import Trajectory

from stewart_drake.design.holds import mean_torques
from stewart_drake.plant.dynamics import StewartDynamics
from stewart_drake.signals import ACCELERATIONS, NUM_TORQUES, POSE, RATES, queue_length
from stewart_drake.trajectories import evaluate, spread_instants

Array = NDArray[np.float64]

PREDICTION_BUDGET = 2e-5
"""rad and m by which integrating over the delay may move the predicted pose."""
ASTRAY = 0.3
"""rad, and crank lengths, from the reference on which a prediction is of no use."""
LEAST_TORQUE_SCALE = 0.01
"""N m."""
INSTANTS = 200
"""At which the torques along a reference are looked at."""
TOLERANCE = 0.03
"""Pose error that is tolerable, as a share of half the reference's peak to peak.

It sets the bandwidth of the loop, about (peak acceleration / tolerance)^(1/2): see docs/theory.md.
"""


def initial_queue(
    kind: Literal["zero", "equilibrium", "reference"],
    dynamics: StewartDynamics,
    reference: Trajectory,
    period: float,
    steps: int,
    fraction: float,
) -> Array:
    """Torques (L, 6) in flight at t = 0, oldest first: nothing, what holds still, what follows."""
    length = queue_length(steps, fraction)
    if kind == "zero" or length == 0:
        return np.zeros((length, NUM_TORQUES))
    if kind == "equilibrium":
        return np.tile(dynamics.equilibrium_torque(evaluate(reference, 0.0)[POSE]), (length, 1))
    ends = (steps + fraction) * period - period * np.arange(length - 1, -1, -1)
    return mean_torques(dynamics, reference, np.maximum(ends - period, 0.0), ends)


def weight_scales(
    kind: Literal["bryson", "identity"], peak_to_peak: Array, peak_torque: float
) -> tuple[Array, Array, Array]:
    """Weights (6,) of the pose error, its integral and the torques in the cost, before w_Q, w_R.

    Bryson's rule, one over the square of what is tolerable: of the error TOLERANCE times half the
    reference's peak to peak (1 where that is 0), that for 1 s of the integral, and the torque
    in N m that the reference takes.
    """
    if kind == "identity":
        return np.ones(6), np.ones(6), np.ones(6)
    tolerable = TOLERANCE * np.where(peak_to_peak > 0, peak_to_peak / 2, 1.0)
    peak = max(LEAST_TORQUE_SCALE, peak_torque)
    return 1 / tolerable**2, 1 / tolerable**2, np.full(NUM_TORQUES, 1 / peak**2)


def reference_torques(dynamics: StewartDynamics, reference: Trajectory, duration: float) -> Array:
    """Largest of the six motor torques (INSTANTS,) in N m along the reference."""
    states = (evaluate(reference, t) for t in spread_instants(duration, INSTANTS))
    torques = [dynamics.inverse_dynamics(x[POSE], x[RATES], x[ACCELERATIONS]) for x in states]
    return np.abs(torques).max(axis=1)


def reference_torque(dynamics: StewartDynamics, reference: Trajectory, duration: float) -> float:
    """Largest motor torque in N m that following the reference takes."""
    return float(reference_torques(dynamics, reference, duration).max())


def choose_substeps(
    dynamics: StewartDynamics, reference: Trajectory, period: float, steps: int, duration: float
) -> int:
    """Least number of Runge-Kutta steps per period that keeps the prediction within its budget.

    Along the reference, the pose predicted over the delay with n steps per period is compared with
    that of 2 n steps; their difference is 15/16 of the error with n. Torques held for long periods
    may lead far away from the reference, where no number of steps would do: there the comparison
    ends.
    """
    horizon = max(steps, 1)
    holds = period * np.arange(horizon)
    crank = dynamics.mechanism.crank_lengths.min()
    near = ASTRAY * np.repeat([1.0, crank], 3)
    cases = []
    for t in spread_instants(duration, 8):
        start = evaluate(reference, t)[:12]
        wanted = np.array([reference.value(t + hold + period)[:, 0] for hold in holds])
        torques = mean_torques(dynamics, reference, t + holds, t + holds + period)
        cases.append((start, torques, wanted))

    def error(substeps: int) -> float:
        worst = 0.0
        for start, torques, wanted in cases:
            coarse, fine = (
                dynamics.predict(start, torques, period, n)[:, POSE]
                for n in (substeps, 2 * substeps)
            )
            useful = np.logical_and.accumulate(np.all(np.abs(fine - wanted) < near, axis=1))
            worst = max(worst, np.abs(coarse - fine)[useful].max(initial=0.0))
        return worst

    substeps = 1
    while substeps < 64 and not error(substeps) <= PREDICTION_BUDGET:
        substeps *= 2
    return substeps
