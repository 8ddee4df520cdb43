"""Whether a delay can be beaten at all, told before anything is simulated."""

import math
from dataclasses import dataclass
from typing import Final, Literal

import numpy as np

from stewart_drake.design.limits import amplification, fastest_pole
from stewart_drake.experiment import Experiment
from stewart_drake.signals import ACCELERATIONS, POSE, RATES
from stewart_drake.trajectories import evaluate

INSTANTS: Final = 30
"""Poles are looked at this often along the reference; 29 steps, a prime, since a round number of
them may be in step with the motion."""
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
        return amplification(self.pole, self.eta)

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
    """Judge the scenario's true delay by the open loop's poles along its reference."""
    sc, times = experiment.scenario, np.linspace(0.0, experiment.scenario.duration, INSTANTS)
    poles = [pole_in_motion(experiment, t) for t in times]
    worst = int(np.argmax(poles))
    eta = (sc.delay.steps + sc.delay.fraction) * sc.controller.period
    return Verdict(eta=eta, pole=poles[worst], time=float(times[worst]))


def pole_in_motion(experiment: Experiment, time: float) -> float:
    """Fastest pole of the nominal plant, 1/s, 0 without a growing one, about the moving reference.

    `time` in s; the torque is the one that follows the reference then.
    """
    x, plant = evaluate(experiment.reference, time), experiment.nominal
    torque = plant.inverse_dynamics(x[POSE], x[RATES], x[ACCELERATIONS])
    return fastest_pole(plant.derivatives(x[POSE], x[RATES], torque).A)


def _power(exponent: float) -> str:
    """e^exponent in two digits, also where it overflows: 55, 3.1e10, 2.0e1353."""
    decades = exponent / math.log(10)
    if decades < 4:
        return f"{math.exp(exponent):.0f}"
    return f"{10 ** (decades % 1):.1f}e{int(decades)}"
