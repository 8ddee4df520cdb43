"""Whether a delay can be beaten at all, told before anything is simulated."""

import math
from dataclasses import dataclass
from typing import Final, Literal

import numpy as np

from stewart_drake.experiment import Experiment
from stewart_drake.signals import ACCELERATIONS, POSE, RATES
from stewart_drake.trajectories import evaluate

INSTANTS: Final = 30
"""Poles are looked at this often along the reference."""
SLOWEST_POLE: Final = 1e-3
"""1/s; below it a pole is the rounding of a double integrator's zero."""
HARDLY: Final = 10.0
NO: Final = 1e3
"""Growth of prediction errors from which a delay is hardly, or not, beatable."""


@dataclass(frozen=True)
class Verdict:
    """What the delay does to an error of the prediction.

    Attributes:
        eta: true total delay, s.
        pole: fastest unstable pole of the open loop along the reference, 1/s, 0 without one.
        time: s, when it is there.
    """

    eta: float
    pole: float
    time: float

    @property
    def amplification(self) -> float:
        """e^(pole eta), infinite where that overflows."""
        try:
            return math.exp(self.pole * self.eta)
        except OverflowError:
            return math.inf

    @property
    def beatable(self) -> Literal["yes", "hardly", "no"]:
        """The answer in one word."""
        if self.amplification > NO:
            return "no"
        return "hardly" if self.amplification >= HARDLY else "yes"

    def __str__(self) -> str:
        opening = f"delay {self.eta:.4g} s, beatable: {self.beatable}"
        if self.beatable == "yes":
            return f"{opening}, prediction errors grow by a factor of {self.amplification:.1f}"
        return (
            f"{opening}, prediction errors grow e^(p eta) = {_power(self.pole * self.eta)} fold "
            f"at t = {self.time:.1f} s (pole {self.pole:.3g} /s)"
        )


def delay_verdict(experiment: Experiment) -> Verdict:
    """Judge the scenario's true delay by the open loop's poles along its reference.

    The nominal plant is linearised about the moving reference, with the torque that follows it.
    """
    sc, plant = experiment.scenario, experiment.nominal
    pole, time = 0.0, 0.0
    for t in np.linspace(0.0, sc.duration, INSTANTS):
        wanted = evaluate(experiment.reference, t)
        pose, rates = wanted[POSE], wanted[RATES]
        torque = plant.inverse_dynamics(pose, rates, wanted[ACCELERATIONS])
        fastest = np.linalg.eigvals(plant.derivatives(pose, rates, torque).A).real.max()
        if fastest > max(pole, SLOWEST_POLE):
            pole, time = float(fastest), float(t)
    eta = (sc.delay.steps + sc.delay.fraction) * sc.controller.period
    return Verdict(eta=eta, pole=pole, time=time)


def _power(exponent: float) -> str:
    """e^exponent in two digits, also where it overflows: 55, 3.1e10, 2.0e1353."""
    decades = exponent / math.log(10)
    if decades < 4:
        return f"{math.exp(exponent):.0f}"
    return f"{10 ** (decades % 1):.1f}e{int(decades)}"
