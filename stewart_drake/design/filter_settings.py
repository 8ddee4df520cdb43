"""What the estimator assumes of a machine: noise, priors, bounds, trust in model and delay."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from stewart_drake.signals import BIAS, DAMPING, NUM_PARAMETERS, PAYLOAD

Array = NDArray[np.float64]


@dataclass(frozen=True)
class FilterSettings:
    """What the filter assumes; standard deviations in SI units.

    Attributes:
        noise_std: (12,) of the measurement.
        prior_std: (8,) of the parameters before any measurement.
        lower, upper: (8,) physical bounds of the parameters.
        model_std: (12,) by which one step of the model may be off; without it a noiseless sensor
            would let the filter explain integration errors by parameters.
        timing_std: s by which a torque may come early or late.
    """

    noise_std: Array
    prior_std: Array
    lower: Array
    upper: Array
    model_std: Array
    timing_std: float


MODEL_ERROR = 2e-4
"""Share of the motion by which one step of the model may be off: what a 1 ms engine deviates."""
TIMING_ERROR = 0.01
"""Share of a period by which the delay may be other than believed. A filter that trusts the delay
takes the effect of a late torque, large in a catch-up, for payload and bias."""


def filter_settings(
    noise_std: Array,
    motion_scale: Array,
    plate_mass: float,
    torque_scale: float,
    torque_limit: float | None,
    period: float,
) -> FilterSettings:
    """Settings for a machine: a payload up to ten plates, friction and bias by its torques.

    Args:
        noise_std: (12,) of the measurement.
        motion_scale: (6,) how far each coordinate moves, rad and m; the same per s for the rates.
        plate_mass: kg.
        torque_scale: torque that the motion takes, N m.
        torque_limit: of the motors in N m, or None.
        period: between two torques, s.
    """
    prior, lower, upper = (np.empty(NUM_PARAMETERS) for _ in range(3))
    bias_bound = 100 * torque_scale if torque_limit is None else torque_limit
    prior[BIAS], lower[BIAS], upper[BIAS] = 0.3 * torque_scale, -bias_bound, bias_bound
    prior[PAYLOAD], upper[PAYLOAD] = 0.25 * plate_mass, 10 * plate_mass
    lower[PAYLOAD] = -0.5 * plate_mass  # a plate that is lighter than believed
    prior[DAMPING], lower[DAMPING], upper[DAMPING] = 0.1 * torque_scale, 0.0, 100 * torque_scale
    model_std = MODEL_ERROR * np.concatenate([motion_scale, motion_scale])
    return FilterSettings(
        np.asarray(noise_std), prior, lower, upper, model_std, TIMING_ERROR * period
    )
