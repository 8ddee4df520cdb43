"""The calibration of a machine: parameters with their covariance, as `identify` writes them."""

from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np

from stewart_drake.files.arguments import fixed
from stewart_drake.files.errors import ConfigError
from stewart_drake.files.fileio import write_whole
from stewart_drake.files.jsonio import jsonable
from stewart_drake.files.yamlio import load_yaml, validate, yaml_text
from stewart_drake.scenario.config import Scenario
from stewart_drake.scenario.field_types import section
from stewart_drake.scenario.signals import (
    BALL_JOINT_FRICTION_SPEED,
    CONSTANTS,
    COULOMB_SPEED,
    LEGS,
)
from stewart_drake.scenario.timing import Delay
from stewart_drake.types import Array

DELAY: Final = "delay"  # name of the delay of a torque, s
OFFSETS: Final = tuple(f"offset_A{leg}" for leg in LEGS)
"""Names of the encoders' offsets: reading minus crank angle, rad."""
CALIBRATED: Final = (*CONSTANTS, DELAY, *OFFSETS)
"""Names of all parameters that a calibration can have."""
ROUNDING: Final = 1e-9  # relative error of a covariance that counts as rounding


@dataclass(frozen=True)
class Calibration:
    """Parameters of one machine, with their covariance, in SI units."""

    mechanism: str  # fingerprint of the machine's numbers, `mechanism.geometry.fingerprint`
    names: tuple[str, ...]  # (n,) out of CALIBRATED, each at the most once
    mean: Array  # (n,)
    covariance: Array  # (n, n); zero for exactly known parameters

    def __post_init__(self) -> None:
        n = len(self.names)
        if len({*self.names} & {*CALIBRATED}) < n:
            accepted = ", ".join(CALIBRATED)
            raise ConfigError(
                f"names: got {list(self.names)}; expected some of {accepted}, each once"
            )
        fixed(f"mean of {n} names", self.mean, (n,))
        self._check_covariance(fixed(f"covariance of {n} names", self.covariance, (n, n)))
        least = {DELAY: (0.0, "0 or more")} | {
            CONSTANTS[speed]: (1e-300, "above 0")
            for speed in (COULOMB_SPEED, BALL_JOINT_FRICTION_SPEED)
        }
        for name, (low, accepted) in least.items():
            found = self.value(name)
            if found is not None and found < low:
                raise ConfigError(f"mean: got a {name} of {found:g}; expected {accepted}")

    def _check_covariance(self, P: Array) -> None:
        variances = np.diag(P)
        for name, variance in zip(self.names, variances, strict=True):
            if variance < 0:
                raise ConfigError(
                    f"covariance: got a variance of {variance:g} for {name}; expected 0 or more"
                )
        # Check the correlations. Exactly known parameters are not scaled: their rows must be zero.
        std = np.sqrt(np.where(variances > 0, variances, 1.0))
        scaled = P / np.outer(std, std)
        skew = np.abs(scaled - scaled.T)
        if skew.max(initial=0.0) > ROUNDING:
            i, j = np.unravel_index(skew.argmax(), P.shape)
            raise ConfigError(
                f"covariance: got {P[i, j]:g} and {P[j, i]:g} for {self.names[i]} and "
                f"{self.names[j]}; expected a symmetric matrix"
            )
        least = np.linalg.eigvalsh((scaled + scaled.T) / 2).min(initial=0.0)
        if least < -ROUNDING * max(1, len(P)):
            raise ConfigError(
                f"covariance: got an eigenvalue of {least:.3g}, in units of the standard "
                "deviations; expected none below 0"
            )

    def value(self, name: str) -> float | None:
        """Return the mean of one parameter, None for one that is not calibrated."""
        return float(self.mean[self.names.index(name)]) if name in self.names else None


@section
class _File:
    mechanism: str
    names: list[str]
    mean: list[float]
    covariance: list[list[float]]


def load_calibration(path: str | Path) -> Calibration:
    """Read the calibration of a machine from YAML, with a key for each field of `Calibration`."""
    found = validate(_File, load_yaml(path), str(path))
    n = len(found.names)
    for row in found.covariance:
        if len(row) != n:
            raise ConfigError(f"{path}: covariance: got {len(row)} numbers in a row; expected {n}")
    covariance = np.array(found.covariance).reshape(len(found.covariance), n)
    try:
        return Calibration(found.mechanism, tuple(found.names), np.array(found.mean), covariance)
    except ConfigError as error:
        raise ConfigError(f"{path}: {error}") from None


def save_calibration(path: str | Path, calibration: Calibration) -> None:
    """Write a file that `load_calibration` reads back to the last digit."""
    write_whole(Path(path), yaml_text(jsonable(vars(calibration))))


def calibration_file(scenario: Scenario) -> Calibration | None:
    """Return the content of the file `controller.calibration`, or None without one."""
    if scenario.controller.calibration is None:
        return None
    try:
        return load_calibration(scenario.controller.calibration)
    except ConfigError as error:
        raise ConfigError(f"controller.calibration: {error}") from None


def believed_delay(scenario: Scenario) -> Delay:
    """Return the delay that the controller assumes: set, else calibrated, else the true one.

    Over a network the play-out bound sets the delay, with or without a calibration.
    """
    controller = scenario.controller
    if controller.delay_steps is not None:
        return Delay(controller.delay_steps, controller.delay_fraction or 0.0)
    known = None if scenario.link.kind == "network" else calibration_file(scenario)
    if known is not None and (seconds := known.value(DELAY)) is not None:
        return Delay.of(seconds, controller.period)
    return scenario.true_delay
