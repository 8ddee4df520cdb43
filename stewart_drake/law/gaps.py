"""Gaps of measurements: how long a law may go on without them.

A torque that acts up to eta after the last measurement is based on it or on earlier ones, so that a
gap of up to eta changes nothing. Later torques are based on a prediction over the gap and eta. With
A and G of the last measurement's state held, its covariance P of state and parameters becomes

    P(s) = F P F',   F = exp([[A, G], [0, 0]] s),   s = gap + eta,

and the deviation of leg i's reach has the variance (J P J')_ii, J = d reach / d pose. The gap is
too long if three standard deviations of a leg exceed its remaining reach.
"""

from collections.abc import Callable
from itertools import pairwise
from typing import Final

import numpy as np
from scipy.linalg import expm

from stewart_drake.law.belief import Estimate
from stewart_drake.law.nominal import NominalPlant
from stewart_drake.mechanism.kinematics import reach_margins
from stewart_drake.scenario.signals import NUM_COORDINATES, NUM_STATE, POSE, RATES
from stewart_drake.types import Array

LONGEST_GAP: Final = 1.0
"""Longest gap of measurements that is ever allowed, s."""
_DEVIATIONS: Final = 3.0
_STEP: Final = 1e-6
"""Step of the differences for J, rad and m."""


def within_reach(plant: NominalPlant, estimate: Estimate, torque: Array) -> Callable[[float], bool]:
    """Return whether the legs surely reach the pose after a span in s without measurements.

    Estimate and torque (6,) in N m are those at the last measurement; without a covariance the
    answer is yes.
    """
    if not estimate.uncertain:
        return lambda span: True
    x, mechanism = estimate.state, plant.mechanism
    found = plant.dynamics.derivatives(x[POSE], x[RATES], torque, estimate.parameters)
    rate = np.zeros_like(estimate.covariance)
    rate[:NUM_STATE, :NUM_STATE], rate[:NUM_STATE, NUM_STATE:] = found.A, found.G
    left = reach_margins(mechanism, x[POSE])
    J = (reach_margins(mechanism, x[POSE] + _STEP * np.eye(NUM_COORDINATES)) - left) / _STEP

    def within(span: float) -> bool:
        with np.errstate(all="ignore"):
            to_legs = np.transpose(J) @ expm(rate * span)[POSE]
            variance = np.einsum("ij,jk,ik->i", to_legs, estimate.covariance, to_legs)
            return bool(np.all(_DEVIATIONS * np.sqrt(variance) <= left))

    return within


def longest_gap(plant: NominalPlant, estimate: Estimate, torque: Array, eta: float) -> float:
    """Return the longest gap in s, from eta to `LONGEST_GAP`, after which the legs surely reach."""
    within = within_reach(plant, estimate, torque)
    gaps = np.linspace(min(eta, LONGEST_GAP), LONGEST_GAP, 21)
    return float(next((a for a, b in pairwise(gaps) if not within(b + eta)), LONGEST_GAP))
