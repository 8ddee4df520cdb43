"""Assumptions of the estimator: priors, bounds, standard deviations of model and delay."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from stewart_drake.scenario.calibration import OFFSETS, Calibration
from stewart_drake.scenario.signals import (
    BALL_JOINT_FRICTION_SPEED,
    BALL_JOINTS,
    BIAS,
    COULOMB,
    COULOMB_SPEED,
    DAMPING,
    DEFAULT_BALL_JOINT_SPEED,
    DEFAULT_COULOMB_SPEED,
    NUM_PLANT_PARAMETERS,
    PARAMETERS,
    PAYLOAD,
    PAYLOAD_POSITION,
    PLANT_PARAMETER_UNITS,
    PLANT_PARAMETERS,
    WRENCH,
    WRENCHES,
)
from stewart_drake.types import Array


@dataclass(frozen=True)
class ParameterSet:
    """Unknown parameters of plant and sensor, and their prior: constants and random walks.

    The names are those of `free` of the dynamics, of `scenario.signals.PLANT_PARAMETERS` and
    `scenario.calibration.OFFSETS`.

    Raises:
        ValueError: wrong shapes; a prior beyond its bounds or without a standard deviation above 0.
    """

    names: tuple[str, ...]  # of n parameters, those of the equations of motion first
    units: tuple[str, ...]  # of each
    prior: Array  # (n,) mean before any measurement
    std: Array  # (n,) of the prior
    # lower, upper: (n,) physical bounds
    lower: Array
    upper: Array
    correlation: Array | None = None  # (n, n) of the prior; None: uncorrelated
    usual: Array | None = None  # (n,) standard deviation without a calibration; None: std
    # (n,) standard deviation of the change per root second; None: constants
    walk: Array | None = None
    jump: Array | None = None  # (n,) standard deviation of a sudden change; None: constants

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
        """Covariance (n, n) of the prior."""
        if self.correlation is None:
            return np.diag(self.std**2)
        return self.correlation * np.outer(self.std, self.std)

    @property
    def usual_std(self) -> Array:
        """Standard deviations (n,) without a calibration."""
        return self.std if self.usual is None else self.usual

    def knowing(self, known: Calibration) -> "ParameterSet":
        """Return the prior with the calibration of a machine: means, covariance.

        Other parameters stay, uncorrelated. A mean beyond a bound by up to three standard
        deviations is moved to the bound. A standard deviation is at least EXACT of the usual one,
        since an estimated parameter cannot be known exactly.

        Raises:
            ValueError: a mean is further beyond a bound; names the parameter.
        """
        prior, std, correlation = self.prior.copy(), self.std.copy(), np.eye(len(self.names))
        own = [i for i, name in enumerate(self.names) if name in known.names]  # places here
        theirs = [known.names.index(self.names[i]) for i in own]  # places in the calibration
        P = known.covariance[np.ix_(theirs, theirs)]
        known_std = np.sqrt(np.diag(P))
        std[own] = np.maximum(known_std, EXACT * self.usual_std[own])
        low, high = self.lower[own], self.upper[own]
        mean, chance = known.mean[theirs], CHANCE * known_std
        within = (low - chance <= mean) & (mean <= high + chance)
        prior[own] = np.where(within, np.clip(mean, low, high), mean)
        correlation[np.ix_(own, own)] = P / np.outer(std[own], std[own])
        correlation[own, own] = 1.0
        return replace(self, prior=prior, std=std, correlation=correlation, usual=self.usual_std)

    def trusting(self, std: Mapping[str, float]) -> "ParameterSet":
        """Return the prior with other standard deviations by name, uncorrelated with the rest."""
        chosen = np.array([name in std for name in self.names])
        correlation = self.correlation
        if correlation is not None:
            apart = chosen[:, None] | chosen[None, :]
            correlation = np.where(apart, np.eye(len(chosen)), correlation)
        return replace(self, std=self._with(self.std, std), correlation=correlation)

    def changing(self, walk: Mapping[str, float], jump: Mapping[str, float]) -> "ParameterSet":
        """Return the prior with other changes by name, `walk` per root second and `jump` at once.

        The prior standard deviation of such a parameter is that of its sudden change, else that of
        its change in a second.
        """
        constant = np.zeros(len(self.names))
        walks, jumps = (constant if own is None else own for own in (self.walk, self.jump))
        found = replace(self, walk=self._with(walks, walk), jump=self._with(jumps, jump))
        return found.trusting({**walk, **jump})

    def _with(self, own: Array, other: Mapping[str, float]) -> Array:
        values = [other.get(name, value) for name, value in zip(self.names, own, strict=True)]
        return np.array(values)


@dataclass(frozen=True)
class FilterSettings:
    """Assumptions of the filter; standard deviations in SI units."""

    parameters: ParameterSet  # estimated together with the state
    # (12,) error of one step of the model. Without it the filter would attribute integration
    # errors to parameters where a sensor has no noise
    model_std: Array
    timing_std: float  # s, of the timing of a torque
    walk_std: Array | None = None  # (p,) change of a parameter in a period; None: constants
    jump_std: Array | None = None  # (p,) sudden change of a parameter; None: constants
    learns_timing: bool = False  # whether innovations correct `timing_std`
    # assumed change of a parameter in a period, as a share of its usual standard deviation,
    # if innovations show that parameters change (core/noise.h); 0: constants
    wander: float = 0.0
    forgetting: float = 1.0  # factor on the information about the noise, per period


EXACT = 1e-6
"""Least standard deviation of an estimated parameter, as a share of the usual one."""
MOUNTING = float(np.deg2rad(0.1))
"""Standard deviation of the mounting angle of an encoder, rad."""
JUMP_SHARE = 0.4
"""Standard deviation of a sudden wrench, as a share of the motion's."""
WALK_SHARE = 2e-4
"""Standard deviation of a wrench's change in a second, as the same share."""
CHANCE = 3.0
"""Largest distance of a calibrated mean beyond a bound, in standard deviations."""
MODEL_ERROR = 2e-4
"""Error of the model in a USUAL_PERIOD, as a share of the motion, for an engine's USUAL_STEP."""
INTEGRATION_ERROR = 4e-6
"""The same for an exact plant: error of the filter's own integration, 3e-6 rms on `paper`."""
USUAL_PERIOD = 0.1
"""Period for which these errors are given, s."""
USUAL_STEP = 1e-3
"""Step of an engine for which MODEL_ERROR is given, s. Its error is of first order in the step."""
TIMING_ERROR = 0.01
"""Standard deviation of the timing of a torque, in periods. Without it the filter would
attribute the effect of a late torque, large in a catch-up, to payload and bias."""
FIRST_TIMING_ERROR = 0.006
"""Initial value of the same where innovations correct it."""
NOISE_MEMORY = 5.0
"""Time constant of forgetting in the noise estimate, s."""


def usual_parameters(
    plate_mass: float,
    torque_scale: float,
    torque_limit: float | None,
    radius: float = 0.0,
    free: Sequence[str] = PARAMETERS,
    wrench: Sequence[float] = (1.0, 1.0),
) -> ParameterSet:
    """Return default priors, from the drawing and the reference motion only.

    The payload is up to ten plates, within two radii of the plate's joints. Friction and bias scale
    with the torques. A wrench scales with `wrench`: its prior is its change in a second, WALK_SHARE
    of that, and a sudden change is JUMP_SHARE of it. Encoders are mounted to a tenth of a degree.

    Args:
        plate_mass: kg.
        torque_scale: of the motion, N m.
        torque_limit: of the motors in N m, or None.
        radius: of the plate's joints, m, for the position of the payload.
        free: names of PLANT_PARAMETERS and OFFSETS, those of the plant first.
        wrench: scale of a wrench on the plate, moment in N m and force in N.
    """
    names, units = (*PLANT_PARAMETERS, *OFFSETS), (*PLANT_PARAMETER_UNITS, *("rad",) * len(OFFSETS))
    bias = 100 * torque_scale if torque_limit is None else torque_limit
    scale = np.repeat(wrench, 3)
    friction = 0.0, 0.1 * torque_scale, 0.0, 100 * torque_scale
    speed, joint_speed = DEFAULT_COULOMB_SPEED, DEFAULT_BALL_JOINT_SPEED
    table: list[tuple[int | slice, tuple[Any, ...]]] = [  # prior, std, lower, upper
        (BIAS, (0.0, 0.3 * torque_scale, -bias, bias)),
        # The plate may be lighter than assumed.
        (PAYLOAD, (0.0, 0.25 * plate_mass, -0.5 * plate_mass, 10 * plate_mass)),
        (PAYLOAD_POSITION, (0.0, radius / 2, -2 * radius, 2 * radius)),
        (DAMPING, friction),
        (COULOMB, friction),
        (slice(BALL_JOINTS.start, BALL_JOINTS.start + 2), friction),
        (COULOMB_SPEED, (speed, speed, 1e-3, 10.0)),
        (BALL_JOINT_FRICTION_SPEED, (joint_speed, joint_speed, 1e-3, 10.0)),
        (WRENCH, (0.0, WALK_SHARE * scale, -np.inf, np.inf)),
        (slice(NUM_PLANT_PARAMETERS, None), (0.0, MOUNTING, -np.pi, np.pi)),
    ]
    columns, changes = np.zeros((4, len(names))), np.zeros((2, len(names)))
    for place, values in table:
        for column, value in zip(columns, values, strict=True):
            column[place] = value
    changes[0, WRENCH], changes[1, WRENCH] = WALK_SHARE * scale, JUMP_SHARE * scale
    chosen = [names.index(name) for name in free]
    prior, std, lower, upper = columns[:, chosen]
    changing = scale.any() and any(name in WRENCHES for name in free)
    return ParameterSet(
        tuple(free),
        tuple(units[i] for i in chosen),
        prior,
        std,
        lower,
        upper,
        walk=changes[0, chosen] if changing else None,
        jump=changes[1, chosen] if changing else None,
    )


def acceleration_noise(share: float, motion_scale: Array, period: float) -> Array:
    """Return the model's error (12,) over a period, for white noise in the accelerations.

    With the intensity sigma = share * motion_scale, rates are off by sigma sqrt(dt) and poses by
    sigma sqrt(dt^3 / 3), as an integrated random walk is. One number therefore serves all periods.

    Args:
        share: of the motion, per s^1.5.
        motion_scale: (6,) range of each coordinate, rad and m.
        period: dt, s.
    """
    rates = share * math.sqrt(period) * motion_scale
    return np.concatenate([rates * period / math.sqrt(3), rates])


def usual_model_error(motion_scale: Array, period: float) -> Array:
    """Return the model's error (12,) over a period where no number is given.

    Poses and rates are off by MODEL_ERROR in a USUAL_PERIOD. In a shorter one they are off by less,
    as with `acceleration_noise`.
    """
    share = period / USUAL_PERIOD
    poses = MODEL_ERROR * share**1.5 * motion_scale
    return np.concatenate([poses, poses / share])


def filter_settings(
    model_std: Array,
    period: float,
    parameters: ParameterSet,
    timing_std: float | None = None,
    learns: bool = False,
) -> FilterSettings:
    """Return the settings for a machine.

    Args:
        model_std: (12,) error of the model over a period.
        period: between two torques, s.
        parameters: to estimate.
        timing_std: s, of the timing of a torque; None:
            TIMING_ERROR of the period, or FIRST_TIMING_ERROR with `learns`.
        learns: whether innovations correct the noise, see core/noise.h.
    """
    usual_timing = period * (FIRST_TIMING_ERROR if learns else TIMING_ERROR)
    return FilterSettings(
        parameters,
        model_std,
        usual_timing if timing_std is None else timing_std,
        None if parameters.walk is None else math.sqrt(period) * parameters.walk,
        parameters.jump,
        learns_timing=learns and timing_std is None,
        wander=math.sqrt(period) if learns else 0.0,
        forgetting=math.exp(-period / NOISE_MEMORY),
    )
