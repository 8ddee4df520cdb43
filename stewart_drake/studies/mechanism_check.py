"""What a mechanism is, before anybody moves it: reach, torque, poles and singularity at home."""

from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from stewart_drake.dynamics.stewart import StewartDynamics
from stewart_drake.dynamics.workspace import Failure, diagnose
from stewart_drake.mechanism.geometry import Mechanism
from stewart_drake.studies.singularity import Measures, characteristic_length, measure
from stewart_drake.studies.workspace_map import Travel, travel
from stewart_drake.types import Array

BODIES: Final = ("base", "plate", "crank", "rod")


class MechanismCheck(NamedTuple):
    """A mechanism at its home pose, standing still."""

    mechanism: Mechanism
    failure: Failure | None
    """Why home is no pose to work from, or None; with it torque, poles and travel are empty."""
    measures: Measures
    crank_angles: Array
    """(6,) rad"""
    torque: Array
    """(6,) N m that hold the plate under gravity."""
    poles: NDArray[np.complex128]
    """(12,) of the open loop under gravity, 1/s, the fastest growing first."""
    travel: list[Travel]

    @property
    def verdict(self) -> str:
        """Whether the machine can be used as described, in a sentence."""
        if self.failure is not None:
            return f"no: the home pose is singular, {self.failure.reason}"
        limit, worst = self.mechanism.effort_limit, float(np.abs(self.torque).max())
        if limit is not None and worst > limit:
            return (
                f"no: the motors cannot hold the plate, {worst:.3g} N m at home against a limit "
                f"of {limit:.3g} N m"
            )
        return "yes: it stands at home, every leg in reach and off its dead centre"

    @property
    def summary(self) -> dict[str, Any]:
        """What `summary.json` holds; SI units, NaN where a value does not exist."""
        limit = self.mechanism.effort_limit
        return {
            "name": self.mechanism.name,
            "verdict": self.verdict,
            "failure": None if self.failure is None else self.failure._asdict(),
            "home": self.mechanism.home,
            "inertia": {name: getattr(self.mechanism, name).inertia for name in BODIES},
            "inertia_estimated": [
                name for name in BODIES if getattr(self.mechanism, name).estimated
            ],
            "crank_angles": self.crank_angles,
            "characteristic_length": characteristic_length(self.mechanism),
            "measures": self.measures._asdict(),
            "torque": self.torque,
            "torque_limit": np.nan if limit is None else limit,
            "poles": [[pole.real, pole.imag] for pole in self.poles],
            "travel": [t._asdict() for t in self.travel],
        }


def check_mechanism(mechanism: Mechanism) -> MechanismCheck:
    """Look at a mechanism at home; a singular home pose is a finding, not an error."""
    home = mechanism.home
    failure = diagnose(mechanism, 0.0, home)
    torque, poles = np.empty(0), np.empty(0, dtype=np.complex128)
    if failure is None:
        dynamics = StewartDynamics(mechanism, gravity=True)
        torque = dynamics.equilibrium_torque(home)
        found = np.linalg.eigvals(dynamics.linearize(home)[0]).astype(np.complex128)
        poles = found[np.lexsort((found.imag, -found.real))]
    return MechanismCheck(
        mechanism=mechanism,
        failure=failure,
        measures=measure(mechanism, home),
        crank_angles=mechanism.crank_angles(home),
        torque=torque,
        poles=poles,
        travel=travel(mechanism),
    )
