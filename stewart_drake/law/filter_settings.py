"""What the estimator assumes of a machine: priors, bounds, trust in model and delay."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from stewart_drake.scenario.signals import (
    BIAS,
    DAMPING,
    NUM_PARAMETERS,
    PARAMETER_UNITS,
    PARAMETERS,
    PAYLOAD,
)

Array = NDArray[np.float64]


@dataclass(frozen=True)
class ParameterSet:
    """Constants of the plant that nobody tells the controller, and what is known beforehand.

    Attributes:
        names: of n parameters, in the order of the equations of motion.
        units: of each.
        prior: (n,) what each is taken for before any measurement.
        std: (n,) how far from there it may be.
        lower, upper: (n,) physical bounds.

    Raises:
        ValueError: naming the parameter; a shape that does not fit.
    """

    names: tuple[str, ...]
    units: tuple[str, ...]
    prior: Array
    std: Array
    lower: Array
    upper: Array

    def __post_init__(self) -> None:
        columns = (self.units, self.prior, self.std, self.lower, self.upper)
        for name, unit, prior, std, low, high in zip(self.names, *columns, strict=True):
            if not (low <= prior <= high and std > 0):
                raise ValueError(
                    f"{name}: got {prior:g} with a standard deviation of {std:g} {unit}; expected "
                    f"between {low:g} and {high:g}, and a deviation above 0"
                )


@dataclass(frozen=True)
class FilterSettings:
    """What the filter assumes; standard deviations in SI units.

    Attributes:
        parameters: what is estimated beside the state.
        model_std: (12,) by which one step of the model may be off; without it a noiseless sensor
            would let the filter explain integration errors by parameters.
        timing_std: s by which a torque may come early or late.
    """

    parameters: ParameterSet
    model_std: Array
    timing_std: float


MODEL_ERROR = 2e-4
"""Share of the motion by which one step of the model may be off: what a 1 ms engine deviates."""
TIMING_ERROR = 0.01
"""Share of a period by which the delay may be other than believed. A filter that trusts the delay
takes the effect of a late torque, large in a catch-up, for payload and bias."""


def filter_settings(
    motion_scale: Array,
    plate_mass: float,
    torque_scale: float,
    torque_limit: float | None,
    period: float,
) -> FilterSettings:
    """Settings for a machine: a payload up to ten plates, friction and bias by its torques.

    Args:
        motion_scale: (6,) how far each coordinate moves, rad and m; the same per s for the rates.
        plate_mass: kg.
        torque_scale: torque that the motion takes, N m.
        torque_limit: of the motors in N m, or None.
        period: between two torques, s.
    """
    std, lower, upper = (np.empty(NUM_PARAMETERS) for _ in range(3))
    bias_bound = 100 * torque_scale if torque_limit is None else torque_limit
    std[BIAS], lower[BIAS], upper[BIAS] = 0.3 * torque_scale, -bias_bound, bias_bound
    std[PAYLOAD], upper[PAYLOAD] = 0.25 * plate_mass, 10 * plate_mass
    lower[PAYLOAD] = -0.5 * plate_mass  # a plate that is lighter than believed
    std[DAMPING], lower[DAMPING], upper[DAMPING] = 0.1 * torque_scale, 0.0, 100 * torque_scale
    model_std = MODEL_ERROR * np.concatenate([motion_scale, motion_scale])
    nothing = np.zeros(NUM_PARAMETERS)
    parameters = ParameterSet(PARAMETERS, PARAMETER_UNITS, nothing, std, lower, upper)
    return FilterSettings(parameters, model_std, TIMING_ERROR * period)
