"""How well a run went: equation (47) and what stands beside it."""

from typing import NamedTuple

import numpy as np

from stewart_drake.scenario.config import ControllerConfig
from stewart_drake.types import Array


class Figures(NamedTuple):
    """What a run comes to, see `loop.results.RunSummary`; NaN where it has no value."""

    accumulated_error: float
    cost: float
    peak_torque: float
    rms_torque: float
    torque_variation: float


def figures(
    time: Array,
    error: Array,
    scale: Array,
    errors: Array,
    asked: Array,
    sent: Array,
    controller: ControllerConfig,
    completed: bool,
) -> Figures:
    """The figures of merit of a run.

    Args:
        time, error: on the metric's grid, as of `accumulated_error`.
        scale: (6,) as of `accumulated_error`.
        errors: (k, 6) pose error at the controller's samples.
        asked: (k, 6) torques that the law asked for there, N m.
        sent: (k, 6) what the limit let through, N m.
        controller: of the scenario.
        completed: whether the run did; otherwise it has no error and no cost.
    """
    c, nan, some = controller, float("nan"), len(asked) > 0
    cost = quadratic_cost(errors, sent, c.period, c.w_Q, c.w_R, c.integral) if completed else nan
    return Figures(
        accumulated_error=accumulated_error(time, error, scale) if completed else nan,
        cost=cost,
        peak_torque=float(np.abs(asked).max()) if some else nan,
        rms_torque=float(np.sqrt(np.mean(asked**2))) if some else nan,
        torque_variation=total_variation(asked) if some else nan,
    )


def accumulated_error(time: Array, error: Array, scale: Array) -> float:
    """E_ac in % s, equation (47): mean over the coordinates of integral |e_i| / A_i * 100 dt.

    Args:
        time: (n,) s; the trapezoid rule runs on it.
        error: (n, 6) pose error against the true reference.
        scale: (6,) A_i, peak to peak of the reference, 1 where it is constant.
    """
    return float(np.mean(np.trapezoid(np.abs(error) / scale * 100, time, axis=0)))


def quadratic_cost(
    error: Array, torque: Array, period: float, w_Q: float, w_R: float, integral: bool
) -> float:
    """Equation (40) on samples: sum of w_Q (|e|^2 + |z|^2) + w_R |T|^2, unscaled as in (41).

    Args:
        error: (n, 6) pose error at the controller's samples.
        torque: (n, 6) sent there, within the motors' limit, N m.
        period: s; z follows from the errors by the trapezoid rule.
        w_Q, w_R: the weights.
        integral: whether the cost sees z, (28).
    """
    cost = w_Q * float(np.sum(error**2)) + w_R * float(np.sum(torque**2))
    if integral:
        z = np.vstack([np.zeros(6), np.cumsum((error[1:] + error[:-1]) * period / 2, axis=0)])
        cost += w_Q * float(np.sum(z**2))
    return cost


def total_variation(torque: Array) -> float:
    """Mean over the motors of sum |T_{k+1} - T_k| in N m: the paper's trembling."""
    return float(np.mean(np.abs(np.diff(torque, axis=0)).sum(axis=0)))


def peak_error(error: Array, scale: Array) -> Array:
    """(6,) largest |error| in percent of peak to peak."""
    return 100 * np.abs(error).max(axis=0) / scale


def delay_floor(time: Array, reference: Array, scale: Array, eta: float) -> float:
    """E_ac in % s that a plate which waits at rest collects before any torque acts.

    Args:
        time: (n,) s.
        reference: (n, 6) poses; the plate stays at the first one until eta.
        scale: (6,) as in `accumulated_error`.
        eta: total delay in s.
    """
    waiting = time <= eta + 1e-9
    return accumulated_error(time[waiting], (reference - reference[0])[waiting], scale)
