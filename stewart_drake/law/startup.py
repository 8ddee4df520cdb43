"""Design before the start: torques in flight, weights, steps of the prediction.

All numbers are relative: a machine of another size and mass, with everything else in proportion,
gets the same law. Lengths are relative to its `reach`, torques to its `machine_torque`.
"""

import functools
import math
from typing import Literal

import numpy as np
from pydrake.trajectories import Trajectory

from stewart_drake.dynamics.native_functions import functions_of
from stewart_drake.dynamics.stewart import StewartDynamics
from stewart_drake.law.clear_space import ClearSpace
from stewart_drake.law.feedforward import mean_torques
from stewart_drake.mechanism.geometry import Mechanism
from stewart_drake.mechanism.trajectories import evaluate, poses_along, rows_along, spread_instants
from stewart_drake.scenario.signals import (
    COULOMB,
    COULOMB_SPEED,
    NUM_STATE,
    NUM_TORQUES,
    PLANT_PARAMETERS,
    POSE,
)
from stewart_drake.scenario.timing import Delay
from stewart_drake.types import Array

PREDICTION_BUDGET = 2e-5
"""Largest integration error of the predicted pose over the delay, rad and shares of the reach."""
MOST_SUBSTEPS = 64
"""Per torque."""
ASTRAY = 0.3
"""Distance from the reference from which a prediction is of no use, rad and crank lengths."""
STILL = 0.1
"""Assumed motion of a coordinate that is only held, rad and crank lengths."""
BLOCK = 64
"""Holds per prediction; over a long delay the comparison may end with the first ones."""
INSTANTS = 200
"""Number of instants at which torques along a reference are evaluated."""
FILTER_INSTANTS = 100
"""Number of instants at which the integration error of the filter's model is evaluated."""
TOLERANCE = 0.03
"""Pose error that is tolerable, as a share of half the reference's peak to peak.

It sets the bandwidth of the loop, about (peak acceleration / tolerance)^(1/2): see docs/theory.md.
"""


def initial_queue(
    kind: Literal["zero", "equilibrium", "reference"],
    dynamics: StewartDynamics,
    reference: Trajectory,
    period: float,
    delay: Delay,
) -> Array:
    """Return the torques (L, 6) in flight at t = 0, oldest first, N m.

    They are zero, or those that hold the start pose, or those that follow the reference.
    """
    length = delay.queue_length
    if kind == "zero" or length == 0:
        return np.zeros((length, NUM_TORQUES))
    if kind == "equilibrium":
        return np.tile(dynamics.equilibrium_torque(evaluate(reference, 0.0)[POSE]), (length, 1))
    ends = delay.eta(period) - period * np.arange(length - 1, -1, -1)
    return mean_torques(dynamics, reference, np.maximum(ends - period, 0.0), ends)


def sizes(mechanism: Mechanism) -> Array:
    """Return 1 rad and the longest reach of a leg, crank and rod in line, in m, as (6,)."""
    return np.repeat([1.0, (mechanism.crank_lengths + mechanism.rod_lengths).max()], 3)


def machine_torque(dynamics: StewartDynamics) -> float:
    """Return the motor torque of a brisk motion without gravity, N m.

    At constant acceleration a plate goes from rest s = a T^2 / 2 in the time T. The torque is that
    for one rad or one crank length from home in 1 s, about or along the axis that takes most:
    max |B^-1 M 2 s|.
    """
    mechanism = dynamics.mechanism
    s = np.diag(np.repeat([1.0, mechanism.crank_lengths.min()], 3))
    M, B = dynamics.mass_matrix(mechanism.home), dynamics.actuation_map(mechanism.home)
    torques = np.linalg.lstsq(B, 2 * M @ s, rcond=1e-6)[0]  # home may be next to a singularity
    return float(np.abs(torques).max())


def least_torque(dynamics: StewartDynamics) -> float:
    """Return the torque that corresponds to STILL, for a reference that takes none, N m."""
    return STILL * machine_torque(dynamics)


def weight_scales(
    kind: Literal["bryson", "identity"],
    dynamics: StewartDynamics,
    peak_to_peak: Array,
    peak_torque: float,
) -> tuple[Array, Array, Array]:
    """Return weights (6,) of pose error, integral and torques in the cost, before w_Q and w_R.

    Bryson's rule, one over the square of the tolerable value: of the error TOLERANCE times half the
    reference's peak to peak (`sizes` where that is 0), that for 1 s of the integral, and the torque
    in N m that the reference takes, or `least_torque`. The paper's choice (41) is `identity`.
    """
    if kind == "identity":
        return np.ones(6), np.ones(6), np.ones(6)
    still = sizes(dynamics.mechanism)
    tolerable = TOLERANCE * np.where(peak_to_peak > 0, peak_to_peak / 2, still)
    peak = max(least_torque(dynamics), peak_torque)
    return 1 / tolerable**2, 1 / tolerable**2, np.full(NUM_TORQUES, 1 / peak**2)


def reference_torques(
    dynamics: StewartDynamics,
    reference: Trajectory,
    duration: float,
    space: ClearSpace | None = None,
) -> Array:
    """Return the largest of the six motor torques (INSTANTS,) along the reference, N m.

    With a space it is that along the reference shrunk into reach.
    """
    rows = rows_along(reference, spread_instants(duration, INSTANTS))
    return np.abs(dynamics.torques_along(space.shrunk(rows) if space else rows)).max(axis=1)


def reference_torque(
    dynamics: StewartDynamics,
    reference: Trajectory,
    duration: float,
    space: ClearSpace | None = None,
) -> float:
    """Return the largest motor torque that the reference takes, N m; see `reference_torques`."""
    return float(reference_torques(dynamics, reference, duration, space).max())


def near(mechanism: Mechanism) -> Array:
    """Return the distance (6,) from the reference up to which a prediction is useful, rad and m."""
    return ASTRAY * np.repeat([1.0, mechanism.crank_lengths.min()], 3)


def choose_substeps(
    dynamics: StewartDynamics, reference: Trajectory, period: float, steps: int, duration: float
) -> int:
    """Return the fewest Runge-Kutta steps per period that keep the prediction within its budget.

    Along the reference, the pose predicted over the delay with n steps per period is compared with
    that of 2 n steps; their difference is 15/16 of the error with n. Torques held for long periods
    may lead far away from the reference, where no number of steps would do: there the comparison
    ends.
    """
    size, horizon = sizes(dynamics.mechanism), max(steps, 1)
    instants = spread_instants(duration, 8)

    @functools.cache
    def block(t: float, first: int) -> tuple[Array, Array]:
        """Return torques of up to BLOCK holds and the poses they are for, (n, 6)."""
        holds = period * np.arange(first, min(first + BLOCK, horizon))
        wanted = np.array([reference.value(t + hold + period)[:, 0] for hold in holds])
        return mean_torques(dynamics, reference, t + holds, t + holds + period), wanted

    def within_budget(substeps: int) -> bool:
        for t in instants:
            coarse = fine = evaluate(reference, t)[None, :NUM_STATE]
            for first in range(0, horizon, BLOCK):
                torques, wanted = block(t, first)
                coarse, fine = (
                    dynamics.predict(before[-1], torques, period, n)
                    for before, n in ((coarse, substeps), (fine, 2 * substeps))
                )
                away = np.abs(fine[:, POSE] - wanted)
                useful = np.logical_and.accumulate(np.all(away < near(dynamics.mechanism), axis=1))
                moved = np.abs((coarse - fine)[:, POSE] / size)[useful]
                if moved.max(initial=0.0) > PREDICTION_BUDGET:
                    return False
                if not useful.all():
                    break
        return True

    substeps = 1
    while substeps < MOST_SUBSTEPS and not within_budget(substeps):
        substeps *= 2
    return substeps


def filter_substeps(
    dynamics: StewartDynamics,
    reference: Trajectory,
    period: float,
    duration: float,
    model_std: Array,
) -> int:
    """Return the fewest Runge-Kutta steps, a power of 2, that keep to the filter's model error.

    A larger integration error over a period is not the assumed noise: it repeats, and the filter
    attributes it to parameters. The root mean square along the reference of the difference between
    n and 2 n steps is at most the assumed deviation.

    Args:
        dynamics: nominal plant.
        reference: of the pose.
        period: s.
        duration: of the reference, s.
        model_std: (12,) assumed error of the state over a period.
    """
    begin = spread_instants(duration, FILTER_INSTANTS)
    torques = mean_torques(dynamics, reference, begin, begin + period)
    states = rows_along(reference, begin)[:, :NUM_STATE]
    ends = poses_along(reference, begin + period)

    def after(substeps: int) -> Array:
        """Return the states (FILTER_INSTANTS, 12) a period after each instant."""
        held = zip(states, torques, strict=True)
        return np.array([dynamics.predict(x, T[None], period, substeps)[-1] for x, T in held])

    substeps, coarse = 1, after(1)
    while substeps < MOST_SUBSTEPS:
        fine = after(2 * substeps)
        astray = np.abs([coarse[:, POSE] - ends, fine[:, POSE] - ends]) >= near(dynamics.mechanism)
        useful = ~astray.any(axis=(0, 2))
        errors = (coarse - fine)[useful] / model_std
        if useful.any() and np.mean(errors**2, axis=0).max() <= 1:
            break
        substeps, coarse = 2 * substeps, fine
    return substeps


def turning_substeps(
    dynamics: StewartDynamics, reference: Trajectory, period: float, duration: float
) -> int:
    """Return Runge-Kutta steps per period that resolve changes of a crank rate by its slip.

    Coulomb friction changes sides while a crank that turns back passes the rates within
    coulomb_speed, which coarser steps do not see. 1 where no friction is known or looked for.
    """
    values, name = dynamics.plant_parameters, PLANT_PARAMETERS[COULOMB]
    if values[COULOMB] == 0 and name not in dynamics.free:
        return 1

    functions = functions_of(dynamics.mechanism)

    def crank_rates(t: float) -> Array:
        pose, rates = reference.value(t)[:, 0], reference.EvalDerivative(t, 1)[:, 0]
        turning = functions.cranks(np.concatenate([pose, rates]))[NUM_TORQUES:]
        if np.isnan(turning).any():  # the error names the leg
            return dynamics.mechanism.jacobian(pose) @ rates
        return turning

    times, h = spread_instants(duration, INSTANTS), 1e-3
    fastest = max(np.abs(crank_rates(t + h) - crank_rates(t)).max() / h for t in times)
    return min(MOST_SUBSTEPS, math.ceil(period * fastest / values[COULOMB_SPEED]))
