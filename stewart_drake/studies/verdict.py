"""What is told before anything is simulated: of this loop first, then of its delay alone."""

import math
from dataclasses import dataclass
from typing import Final, Literal

import numpy as np

from stewart_drake.law.limits import amplification, fastest_pole
from stewart_drake.loop.controller_margin import ControllerMargin, true_model
from stewart_drake.loop.experiment import Experiment, true_dynamics
from stewart_drake.loop.results import MarginSummary

INSTANTS: Final = 30
"""Poles are looked at this often along the reference; 29 steps, a prime, since a round number of
them may be in step with the motion."""
HARDLY: Final = 10.0
NO: Final = 1e3
"""Growth of prediction errors from which a delay is hardly, or not, beatable."""


@dataclass(frozen=True)
class Verdict:
    """What the delay does to an error of the prediction, whatever the controller.

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
        opening = f"the delay of {self.eta:.4g} s alone, under any controller, beatable: "
        if self.beatable == "yes":
            factor = f"{self.amplification:.1f}"
            return f"{opening}yes, prediction errors grow by a factor of {factor}"
        return (
            f"{opening}{self.beatable}, prediction errors grow e^(p eta) = "
            f"{_power(self.pole * self.eta)} fold at t = {self.time:.1f} s "
            f"(pole {self.pole:.3g} /s)"
        )


def loop_verdict(loop: ControllerMargin) -> str:
    """Whether this controller on this plant is stable, and by how much, in one sentence."""
    if loop.problem:
        return f"this loop is not judged: {loop.problem}"
    where = "linearised along the reference"
    if not loop.stable:
        return (
            f"this loop is unstable: {where}, errors grow {loop.radius:.3g} fold per period of "
            f"{loop.period:g} s at t = {loop.time:.1f} s{_left_out(loop)}"
        )
    m = loop.margins
    up = f"{m.gain_up:.4g}" if math.isfinite(m.gain_up) else "any"
    return (
        f"this loop is stable: {where}, it bears a true delay {milliseconds(m.shorter)} shorter "
        f"to {milliseconds(m.longer)} longer and motors {m.gain_down:.3g} to {up} times as "
        f"strong{_left_out(loop)}"
    )


def loop_word(margin: MarginSummary | None) -> str:
    """The same in a few words, of `controller_margin` in a run's summary."""
    if margin is None or margin["stable"] is None:
        return "not judged"
    if not margin["stable"]:
        return f"unstable, {margin['spectral_radius']:.3g} fold per period"
    return f"stable, bears a delay wrong by {milliseconds(min(margin['delay_margin_s']))}"


def delay_verdict(experiment: Experiment) -> Verdict:
    """Judge the scenario's true delay by the open loop's poles along its reference."""
    sc, times = experiment.scenario, np.linspace(0.0, experiment.scenario.duration, INSTANTS)
    poles = [pole_in_motion(experiment, t) for t in times]
    worst = int(np.argmax(poles))
    return Verdict(eta=sc.eta, pole=poles[worst], time=float(times[worst]))


def pole_in_motion(experiment: Experiment, time: float) -> float:
    """Fastest pole of the true plant, 1/s, 0 without a growing one, about the moving reference.

    `time` in s; the torque is the one that follows the reference then.
    """
    return fastest_pole(true_model(experiment, true_dynamics(experiment), time).A)


def milliseconds(seconds: float) -> str:
    """Three digits of a time; `any time` where it is not limited."""
    return f"{1e3 * seconds:.3g} ms" if math.isfinite(seconds) else "any time"


def _left_out(loop: ControllerMargin) -> str:
    """What the judgement supposes, where there is something to suppose."""
    supposed = []
    if loop.estimated:
        found = "payload, friction and delay" if loop.delay_found else "payload and friction"
        supposed.append(f"the estimator left out, {found} taken as found")
    if loop.tuned:
        supposed.append("with the weights that the tuner starts from")
    return f" ({'; '.join(supposed)})" if supposed else ""


def _power(exponent: float) -> str:
    """e^exponent in two digits, also where it overflows: 55, 3.1e10, 2.0e1353."""
    decades = exponent / math.log(10)
    if decades < 4:
        return f"{math.exp(exponent):.0f}"
    return f"{10 ** (decades % 1):.1f}e{int(decades)}"
