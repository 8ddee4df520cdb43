"""Verdicts before a simulation: stability of this loop, then its delay alone."""

import math
from dataclasses import dataclass
from typing import Final, Literal

import numpy as np

from stewart_drake.law.stability import amplification, fastest_pole
from stewart_drake.loop.controller_margin import INSTANTS, ControllerMargin, true_model
from stewart_drake.loop.experiment import Experiment, true_dynamics
from stewart_drake.loop.results import MarginSummary

HARDLY: Final = 10.0
NO: Final = 1e3
"""Growth of prediction errors from which a delay is hardly, or not, beatable."""


@dataclass(frozen=True)
class Verdict:
    """Growth of an error of the prediction over the delay, under any controller.

    Attributes:
        eta: true total delay, s.
        pole: fastest unstable pole of the open loop along the reference, 1/s; 0 without one.
        time: of that pole, s.
    """

    eta: float
    pole: float
    time: float

    @property
    def amplification(self) -> float:
        """Growth e^(pole eta), infinite on overflow."""
        return amplification(self.pole, self.eta)

    @property
    def beatable(self) -> Literal["yes", "hardly", "no"]:
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
    """Return one sentence: stability and margins of this controller on this plant."""
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
    """Return a few words on `controller_margin` in a run's summary."""
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
    """Return the fastest pole of `true_model`, 1/s, 0 if nothing grows; `time` in s."""
    return fastest_pole(true_model(experiment, true_dynamics(experiment), time).A)


def milliseconds(seconds: float) -> str:
    """Return a time in three digits, or `any time` if it is infinite."""
    return f"{1e3 * seconds:.3g} ms" if math.isfinite(seconds) else "any time"


def _left_out(loop: ControllerMargin) -> str:
    """Return the assumptions of the judgement, in brackets."""
    supposed = []
    if loop.estimated:
        found = "payload, friction and delay" if loop.delay_found else "payload and friction"
        supposed.append(f"the estimator left out, {found} taken as found")
    if loop.tuned:
        supposed.append("with the weights that the tuner starts from")
    return f" ({'; '.join(supposed)})" if supposed else ""


def _power(exponent: float) -> str:
    """Return e^exponent in two digits, also on overflow: 55, 3.1e10, 2.0e1353."""
    decades = exponent / math.log(10)
    if decades < 4:
        return f"{math.exp(exponent):.0f}"
    return f"{10 ** (decades % 1):.1f}e{int(decades)}"
