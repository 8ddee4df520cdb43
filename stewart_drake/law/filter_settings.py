"""What the estimator assumes of a machine: priors, bounds, trust in model and delay."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from stewart_drake.scenario.calibration import OFFSETS, Calibration
from stewart_drake.scenario.signals import (
    BIAS,
    COULOMB,
    COULOMB_SPEED,
    DAMPING,
    DEFAULT_COULOMB_SPEED,
    NUM_PLANT_PARAMETERS,
    PARAMETERS,
    PAYLOAD,
    PAYLOAD_POSITION,
    PLANT_PARAMETER_UNITS,
    PLANT_PARAMETERS,
)
from stewart_drake.types import Array


@dataclass(frozen=True)
class ParameterSet:
    """Constants that nobody tells the controller, and what is known beforehand.

    They are the plant's (`scenario.signals.PLANT_PARAMETERS`) or the sensor's; what of them is
    estimated is a matter of this set, and of `free` of the dynamics, which has the same names.

    Attributes:
        names: of n parameters, those of the equations of motion first.
        units: of each.
        prior: (n,) what each is taken for before any measurement.
        std: (n,) how far from there it may be.
        lower, upper: (n,) physical bounds.
        correlation: (n, n) of these errors; None is none.
        usual: (n,) std where nobody knows more than the machine, which says what it is to know a
            parameter well; None is std.

    Raises:
        ValueError: naming the parameter; a shape that does not fit.
    """

    names: tuple[str, ...]
    units: tuple[str, ...]
    prior: Array
    std: Array
    lower: Array
    upper: Array
    correlation: Array | None = None
    usual: Array | None = None

    def __post_init__(self) -> None:
        columns = (self.units, self.prior, self.std, self.lower, self.upper)
        for name, unit, prior, std, low, high in zip(self.names, *columns, strict=True):
            if not (low <= prior <= high and std > 0):
                raise ValueError(
                    f"{name}: got {prior:g} with a standard deviation of {std:g} {unit}; expected "
                    f"between {low:g} and {high:g}, and a deviation above 0"
                )

    @property
    def covariance(self) -> Array:
        """(n, n) of the prior."""
        if self.correlation is None:
            return np.diag(self.std**2)
        return self.correlation * np.outer(self.std, self.std)

    @property
    def usual_std(self) -> Array:
        """(n,) of a machine of which nobody knows more."""
        return self.std if self.usual is None else self.usual

    def knowing(self, known: Calibration) -> "ParameterSet":
        """With what is known of a machine: means, standard deviations, correlations.

        What it says nothing of stays, and goes together with nothing. A mean that is beyond a bound
        by chance, up to three standard deviations, is taken for the bound; a standard deviation is
        at least EXACT of the usual one, since what is estimated cannot be known exactly.

        Raises:
            ValueError: naming the parameter that is further off.
        """
        prior, std, correlation = self.prior.copy(), self.std.copy(), np.eye(len(self.names))
        own = [i for i, name in enumerate(self.names) if name in known.names]
        there = [known.names.index(self.names[i]) for i in own]
        P = known.covariance[np.ix_(there, there)]
        of_known = np.sqrt(np.diag(P))
        std[own] = np.maximum(of_known, EXACT * self.usual_std[own])
        low, high = self.lower[own], self.upper[own]
        mean, chance = known.mean[there], CHANCE * of_known
        within = (low - chance <= mean) & (mean <= high + chance)
        prior[own] = np.where(within, np.clip(mean, low, high), mean)
        correlation[np.ix_(own, own)] = P / np.outer(std[own], std[own])
        correlation[own, own] = 1.0
        return replace(self, prior=prior, std=std, correlation=correlation, usual=self.usual_std)

    def trusting(self, std: Mapping[str, float]) -> "ParameterSet":
        """With other standard deviations by name, of errors that go together with no other."""
        chosen = np.array([name in std for name in self.names])
        correlation = self.correlation
        if correlation is not None:
            apart = chosen[:, None] | chosen[None, :]
            correlation = np.where(apart, np.eye(len(chosen)), correlation)
        values = [std.get(name, own) for name, own in zip(self.names, self.std, strict=True)]
        return replace(self, std=np.array(values), correlation=correlation)


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


EXACT = 1e-6
"""Least standard deviation of what is estimated, as a share of the usual one."""
MOUNTING = float(np.deg2rad(0.1))
"""rad by which an encoder may be mounted otherwise than drawn."""
CHANCE = 3.0
"""Standard deviations by which an estimate may be beyond what is possible."""
MODEL_ERROR = 2e-4
"""Share of the motion by which one step of the model may be off: what a 1 ms engine deviates."""
TIMING_ERROR = 0.01
"""Share of a period by which the delay may be other than believed. A filter that trusts the delay
takes the effect of a late torque, large in a catch-up, for payload and bias."""


def usual_parameters(
    plate_mass: float,
    torque_scale: float,
    torque_limit: float | None,
    radius: float = 0.0,
    free: Sequence[str] = PARAMETERS,
) -> ParameterSet:
    """What is known of a machine of which nobody knows more than its drawing and its motion.

    A payload up to ten plates, within two radii of the plate's joints; friction and bias by its
    torques; encoders that are mounted to a tenth of a degree.

    Args:
        plate_mass, torque_scale, torque_limit: as of `filter_settings`.
        radius: of the plate's joints, m; only the payload's place asks for it.
        free: names out of PLANT_PARAMETERS and OFFSETS, those of the plant first.
    """
    prior, std, lower, upper = (np.zeros(NUM_PLANT_PARAMETERS) for _ in range(4))
    bias_bound = 100 * torque_scale if torque_limit is None else torque_limit
    std[BIAS], lower[BIAS], upper[BIAS] = 0.3 * torque_scale, -bias_bound, bias_bound
    std[PAYLOAD], upper[PAYLOAD] = 0.25 * plate_mass, 10 * plate_mass
    lower[PAYLOAD] = -0.5 * plate_mass  # a plate that is lighter than believed
    for friction in (DAMPING, COULOMB):
        std[friction], upper[friction] = 0.1 * torque_scale, 100 * torque_scale
    at = COULOMB_SPEED
    prior[at] = std[at] = DEFAULT_COULOMB_SPEED
    lower[at], upper[at] = 1e-3, 10.0
    std[PAYLOAD_POSITION] = radius / 2
    lower[PAYLOAD_POSITION], upper[PAYLOAD_POSITION] = -2 * radius, 2 * radius
    of_sensor = (0.0, MOUNTING, -np.pi, np.pi)
    columns = [
        np.append(column, len(OFFSETS) * [value])
        for column, value in zip((prior, std, lower, upper), of_sensor, strict=True)
    ]
    names, units = (*PLANT_PARAMETERS, *OFFSETS), (*PLANT_PARAMETER_UNITS, *("rad",) * len(OFFSETS))
    chosen = [names.index(name) for name in free]
    return ParameterSet(
        tuple(free),
        tuple(units[i] for i in chosen),
        *(column[chosen] for column in columns),
    )


def filter_settings(
    motion_scale: Array,
    plate_mass: float,
    torque_scale: float,
    torque_limit: float | None,
    period: float,
    parameters: ParameterSet | None = None,
) -> FilterSettings:
    """Settings for a machine.

    Args:
        motion_scale: (6,) how far each coordinate moves, rad and m; the same per s for the rates.
        plate_mass: kg.
        torque_scale: torque that the motion takes, N m.
        torque_limit: of the motors in N m, or None.
        period: between two torques, s.
        parameters: what is estimated, `usual_parameters` if None.
    """
    if parameters is None:
        parameters = usual_parameters(plate_mass, torque_scale, torque_limit)
    model_std = MODEL_ERROR * np.concatenate([motion_scale, motion_scale])
    return FilterSettings(parameters, model_std, TIMING_ERROR * period)
