"""How long a plate may be driven without measurements: until it may have left the legs' reach.

Torques that act up to eta after the last measurement rest on it or on earlier ones, so that a gap
of up to eta changes nothing. Later ones rest on a prediction over the gap and eta. With A and G of
the last measurement's state held, its covariance P of state and parameters becomes

    P(s) = F P F',   F = exp([[A, G], [0, 0]] s),   s = gap + eta,

and the deviation of leg i's reach has the variance (J P J')_ii, J = d reach / d pose. The gap is
too long where three standard deviations of a leg are more than the reach that it has left.
"""

from typing import Final

import numpy as np
from scipy.linalg import expm

from stewart_drake.law.belief import Estimate
from stewart_drake.law.nominal import NominalPlant
from stewart_drake.scenario.signals import NUM_COORDINATES, NUM_STATE, POSE, RATES
from stewart_drake.types import Array

LONGEST_GAP: Final = 1.0
"""Longest gap that is ever allowed, s; the gap that is allowed without an estimator."""
_DEVIATIONS: Final = 3.0
_STEP: Final = 1e-6
"""rad and m, of the differences that J is made of."""


def stays_within_reach(plant: NominalPlant, estimate: Estimate, torque: Array, span: float) -> bool:
    """Return whether the plate surely reaches its pose after `span` s without measurements.

    Args:
        plant: as it is known.
        estimate: at the last measurement; without a covariance the answer is yes.
        torque: (6,) N m, that acts then.
        span: s.
    """
    if not estimate.uncertain:
        return True
    x, mechanism = estimate.state, plant.mechanism
    found = plant.dynamics.derivatives(x[POSE], x[RATES], torque, estimate.parameters)
    rate = np.zeros_like(estimate.covariance)
    rate[:NUM_STATE, :NUM_STATE], rate[:NUM_STATE, NUM_STATE:] = found.A, found.G
    left = mechanism.reach_margins(x[POSE])
    J = [
        (mechanism.reach_margins(x[POSE] + _STEP * e) - left) / _STEP
        for e in np.eye(NUM_COORDINATES)
    ]
    with np.errstate(all="ignore"):
        to_legs = np.transpose(J) @ expm(rate * span)[POSE]
        variance = np.einsum("ij,jk,ik->i", to_legs, estimate.covariance, to_legs)
        return bool(np.all(_DEVIATIONS * np.sqrt(variance) <= left))
