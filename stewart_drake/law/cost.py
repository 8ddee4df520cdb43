"""Cost that the gain minimises, and the gain."""

import math
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from stewart_drake.files.arguments import fixed, positive
from stewart_drake.law.delay_model import DelayedModel, LinearModel, delayed_model
from stewart_drake.law.riccati import prediction_matrix, reduced_gain
from stewart_drake.law.timeline import Timeline
from stewart_drake.scenario.signals import NUM_COORDINATES, RATES
from stewart_drake.types import Array


class Cost(Protocol):
    """A kind of gain. Instances are immutable."""

    @property
    def integrates(self) -> bool:
        """Whether the law has an integral."""
        ...

    def sampled(self, model: LinearModel, timeline: Timeline) -> DelayedModel:
        """Return a model of error, rates and, if there is one, integral.

        Raises:
            FloatingPointError: the model cannot be sampled.
        """
        period, steps, fraction = timeline.period, timeline.steps, timeline.fraction
        return delayed_model(model, period, steps, fraction, integral=self.integrates)

    def gain(self, model: DelayedModel, weights: Array) -> Array:
        """Return the gain (6, n) for a model from `sampled` and w_Q and w_R (2,).

        It multiplies [error; integral; the torque that is still to act], see
        `law.riccati.reduced_gain`.
        """
        ...


def law_gain(
    cost: Cost,
    design: LinearModel,
    predictor: LinearModel,
    timeline: Timeline,
    weights: Array,
) -> Array:
    """Return K P (m, n + m L): the gain of one model on the prediction of another.

    Args:
        cost: that has the gain.
        design: model of the gain.
        predictor: model of the prediction.
        timeline: with the delay that the law assumes.
        weights: (2,) w_Q and w_R.

    Raises:
        RiccatiError: no gain was found.
    """
    K = cost.gain(cost.sampled(design, timeline), weights)
    return K @ prediction_matrix(cost.sampled(predictor, timeline))


@dataclass(frozen=True)
class QuadraticCost(Cost):
    """w_Q [e; z]' Q [e; z] + w_R T' R T, with diagonal Q and R.

    Attributes:
        errors: (6,) scale of the pose error, 1 / s^2.
        integrals: (6,) scale of its integral, or None for a law without one.
        torques: (6,) scale of the torques.
    """

    errors: Array
    integrals: Array | None
    torques: Array

    def __post_init__(self) -> None:
        for name in ("errors", "integrals", "torques"):
            if (scale := getattr(self, name)) is not None:
                fixed(name, scale, (NUM_COORDINATES,), 0.0)

    @property
    def integrates(self) -> bool:
        return self.integrals is not None

    def matrices(self, weights: Array) -> tuple[Array, Array]:
        """Return w_Q Q and w_R R for w_Q and w_R (2,)."""
        scales = [self.errors] if self.integrals is None else [self.errors, self.integrals]
        Q, R = np.diag(np.concatenate(scales)), np.diag(self.torques)
        return weights[0] * Q, weights[1] * R

    def gain(self, model: DelayedModel, weights: Array) -> Array:
        """Return `law.riccati.reduced_gain` of a model from `sampled`.

        Raises:
            RiccatiError: no gain was found.
        """
        return reduced_gain(model, *self.matrices(weights))


def pd_gains(delay: float, pole: float = 0.0) -> tuple[float, float]:
    """Return kp in 1/s^2 and kd in 1/s of equation (pd).

    Args:
        delay: h, uncompensated, s; above 0.
        pole: p, 1/s.
    """
    turns = pole * delay
    sh = -2 + math.sqrt(2 + turns**2)
    excess, factor = sh**2 - turns**2, math.exp(sh)
    damping = -(2 * sh + excess) * factor
    return (-excess * factor - damping * sh) / delay**2, damping / delay


@dataclass(frozen=True)
class PdGain(Cost):
    """Spring and damper on the error of the pose, in place of the LQI gain.

    With B the accelerations per torque, T = T_ff - B^-1 (kp e + kd e') gives every
    coordinate a separate loop:

        e'' = p^2 e - kp e(t - h) - kd e'(t - h),

    with h the uncompensated delay, and p the pole with which gravity lets the plate fall; p = 0
    without gravity. The characteristic function times exp(s h) is

        f(s) = (s^2 - p^2) exp(s h) + kp + kd s.

    f = f' = f'' = 0 is a triple real pole s. From f'' = 0, (s h)^2 + 4 s h + 2 - (p h)^2 = 0, so

        s h = -2 + sqrt(2 + (p h)^2),
        kd = -(2 s + h (s^2 - p^2)) exp(s h),     kp = -(s^2 - p^2) exp(s h) - kd s.       (pd)

    The pole is stable where p h < sqrt(2), the limit of every controller of this form. Without
    gravity, kp h^2 = 0.079 and kd h = 0.461.

    Attributes:
        kp: 1/s^2.
        kd: 1/s.
        period: of the controller, s.
    """

    kp: float
    kd: float
    period: float

    def __post_init__(self) -> None:
        fixed("kp, kd", (self.kp, self.kd), (2,))
        positive("period", self.period)

    integrates = False  # not annotated: no field

    def gain(self, model: DelayedModel, weights: Array) -> Array:
        """Return B^-1 [kp, kd] (6, 12), with zeros for a torque that is still to act.

        B is the change of the rates by a torque held for a period, divided by the period.

        Args:
            model: of `sampled`.
            weights: (2,) without effect.

        Raises:
            numpy.linalg.LinAlgError: B is singular.
        """
        B = (model.B_old + model.B_new)[RATES] / self.period
        one = np.eye(NUM_COORDINATES)
        K = np.linalg.solve(B, np.hstack([self.kp * one, self.kd * one]))
        if model.fraction > 0:
            K = np.hstack([K, np.zeros_like(one)])
        if not np.all(np.isfinite(K)):
            raise np.linalg.LinAlgError("B: is singular")
        return K
