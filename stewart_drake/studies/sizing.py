"""What the motors must do along a motion: torque, speed and power by inverse dynamics."""

from typing import Any, NamedTuple

import numpy as np
from pydrake.trajectories import Trajectory

from stewart_drake.dynamics.stewart import StewartDynamics
from stewart_drake.scenario.signals import ACCELERATIONS, LEGS, POSE, RATES
from stewart_drake.scenario.trajectories import evaluate
from stewart_drake.types import Array


class Sizing(NamedTuple):
    """Along a motion; arrays (n, 6), a column per crank."""

    time: Array
    """(n,) s."""
    torque: Array
    """N m, friction and payload as the dynamics' own parameters say."""
    speed: Array
    """Crank rates, rad/s."""

    @property
    def power(self) -> Array:
        """W, positive where the motor drives, negative where it brakes."""
        return self.torque * self.speed

    def summary(self, torque_limit: float | None) -> list[dict[str, Any]]:
        """Per leg the peak and rms of torque (N m), speed (rad/s) and power (W), least power too.

        Args:
            torque_limit: N m, or None; `use_of_limit` is the peak's share of it.
        """
        torque, speed, power = np.abs(self.torque), np.abs(self.speed), self.power
        return [
            {
                "leg": LEGS[i],
                "peak_torque": torque[:, i].max(),
                "rms_torque": rms(torque[:, i]),
                "peak_speed": speed[:, i].max(),
                "rms_speed": rms(speed[:, i]),
                "peak_power": power[:, i].max(),
                "least_power": power[:, i].min(),
                "rms_power": rms(power[:, i]),
                "use_of_limit": np.nan
                if torque_limit is None
                else torque[:, i].max() / torque_limit,
            }
            for i in range(len(LEGS))
        ]


def rms(values: Array) -> float:
    """Root mean square of evenly spaced values."""
    return float(np.sqrt(np.mean(np.square(values))))


def size_motors(dynamics: StewartDynamics, reference: Trajectory, time: Array) -> Sizing:
    """The motors' part in following a reference exactly, at the instants `time` (n,) in s.

    T = inverse dynamics of (X, X', X''), crank rates = J X'.

    Raises:
        UnreachablePoseError, SingularPoseError: the reference is not within the workspace there.
    """
    wanted = np.array([evaluate(reference, t) for t in time])
    torque = [dynamics.inverse_dynamics(x[POSE], x[RATES], x[ACCELERATIONS]) for x in wanted]
    speed = [dynamics.mechanism.jacobian(x[POSE]) @ x[RATES] for x in wanted]
    return Sizing(np.asarray(time), np.array(torque), np.array(speed))
