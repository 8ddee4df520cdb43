"""Judgement of a scenario before it is simulated: its motion, its loop, and its delay alone."""

import math
from dataclasses import dataclass
from typing import Final, Literal, NamedTuple

import numpy as np

from stewart_drake.dynamics.workspace import Failure, diagnose
from stewart_drake.law.stability import Margins, amplification
from stewart_drake.law.startup import least_torque, reference_torques
from stewart_drake.loop.controller_margin import ControllerMargin, fastest_in_motion, over_wire
from stewart_drake.loop.preparation import REACH_CHECK_PERIOD, Experiment, prepare_unchecked
from stewart_drake.loop.results import MarginSummary
from stewart_drake.scenario.config import Scenario
from stewart_drake.scenario.link import oldest_periods
from stewart_drake.types import Array


class Assessment(NamedTuple):
    experiment: Experiment
    failure: Failure | None  # when and why the reference leaves the workspace, or None
    home_failure: Failure | None  # why the home pose is outside the workspace, or None
    motion: Array  # (6,) usual size of the pose, rad and m: half the reference's peak to peak
    # usual size of a torque, N m: the largest that following the reference takes. If it cannot be
    # followed, that of a median instant, because torques may grow without bound on the way out.
    torque: float
    followed_until: float  # last instant at which the reference is known to be inside, s

    @property
    def obstacles(self) -> tuple[str, ...]:
        """Sentences about the home pose and the reference outside the workspace."""
        sentences = []
        if self.home_failure is not None:
            sentences.append(f"At the home pose: {self.home_failure.reason}.")
        if self.failure is not None:
            short = -1e3 * self.failure.margin
            sentences.append(
                "The reference cannot be followed: "
                f"{self.failure.reason} at t = {self.failure.time:.2f} s"
                + (f", short by {short:.3g} mm." if short > 0 and self.failure.leg else ".")
            )
        return tuple(sentences)


def assess(scenario: Scenario) -> Assessment:
    """Assess a scenario whose mechanism can be assembled at its home pose."""
    experiment = prepare_unchecked(scenario)
    mechanism, reference = experiment.mechanism, experiment.reference
    failure = experiment.reference_failure()
    end, torque = scenario.duration, 0.0
    if failure is not None:
        end = max(0.0, failure.time - REACH_CHECK_PERIOD)
    if end > 0:
        torques = reference_torques(experiment.nominal, reference, end)
        torque = float(torques.max() if failure is None else np.median(torques))
    return Assessment(
        experiment=experiment,
        failure=failure,
        home_failure=diagnose(mechanism, 0.0, mechanism.home),
        motion=experiment.motion_scale,
        torque=max(torque, least_torque(experiment.nominal)),
        followed_until=end,
    )


HARDLY: Final = 10.0
NO: Final = 1e3
"""Growth of prediction errors from which a delay can hardly, or not, be compensated."""

FRAGILE: Final = 0.05
"""Smallest tolerable error of a good loop, as a share of the delay."""

LEAST: Final = 1e-6
"""Error of the delay below which no link stays, s."""


@dataclass(frozen=True)
class Verdict:
    """Growth of an error of the prediction over the delay, under any controller."""

    eta: float  # true total delay, s
    pole: float  # fastest unstable pole of the open loop along the reference, 1/s; 0 without one
    time: float  # of that pole, s
    period: float = math.inf  # of the controller, s; infinite to leave out periods

    @classmethod
    def of(cls, margin: ControllerMargin) -> "Verdict":
        return cls(margin.eta, margin.pole, margin.pole_time, margin.period)

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
        can = {"yes": "can", "hardly": "can hardly", "no": "cannot"}[self.beatable]
        growth = f"{self.amplification:.1f}"
        if self.beatable != "yes":
            growth = _power(self.pole * self.eta)
        periods = f" ({self.eta / self.period:.4g} periods)" if self.period < math.inf else ""
        return (
            f"the delay of {self.eta:.4g} s{periods} {can} be compensated: under any controller, "
            f"prediction errors grow by a factor of {growth} over it"
        )


def scenario_verdict(experiment: Experiment, loop: ControllerMargin) -> str:
    """Return `loop_verdict` after its conditions: packets of `over_wire`, and strong motors."""
    sc, conditions = experiment.scenario, []
    if sc.link.kind == "network" and not loop.problem:
        conditions.append("every packet is in time")
        if late := oldest_periods(sc):
            conditions.append(f"measurements are {late * sc.controller.period:g} s old")
    if loop.stable and experiment.weak_motors():
        conditions.append("the motors give enough torque, which they do not")
    return f"if {' and '.join(conditions)}, " * bool(conditions) + loop_verdict(loop)


def loop_verdict(loop: ControllerMargin) -> str:
    """Return one sentence: stability and margins of this controller on this plant."""
    if loop.problem:
        return f"no stability check of this loop: {loop.problem}"
    assumptions = []
    if loop.estimated:
        found = "parameters and delay" if loop.delay_found else "parameters"
        assumptions.append(f"estimator off; estimated {found} known")
    if loop.tuned:
        assumptions.append("with the weights that the tuner starts from")
    assumed = f" ({'; '.join(assumptions)})" if assumptions else ""
    if not loop.stable:
        return (
            "this loop is unstable: linearised along the reference, errors grow "
            f"{fold(loop.radius)} per period of {loop.period:g} s at t = {loop.time:.1f} s{assumed}"
        )
    m = loop.margins
    if loop.delay_margin < LEAST:
        return (
            "this loop is stable in exact arithmetic only: linearised along the reference, an "
            f"error of the delay of {milliseconds(LEAST)} makes it unstable{assumed}"
        )
    share = f", {100 * loop.share:.2g} % of the delay," if loop.share < math.inf else ""
    up = f"{m.gain_up:.4g}" if math.isfinite(m.gain_up) else "any"
    widen = "; a larger controller.w_R widens it" if fragile(loop) and loop.weighted else ""
    return (
        "this loop is stable: linearised along the reference, it tolerates delay errors from "
        f"{delay_range(m)}{share} and motor gains from {m.gain_down:.3g} to {up}{assumed}{widen}"
    )


def delay_range(margins: Margins) -> str:
    """Return the delay errors for which a loop is stable, as `-0.6 ms to +0.5 ms`."""
    shorter, longer = margins.shorter, margins.longer
    low = f"-{milliseconds(shorter)}" if math.isfinite(shorter) else "any below 0"
    high = f"+{milliseconds(longer)}" if math.isfinite(longer) else "any"
    return f"{low} to {high}"


def fragile(loop: ControllerMargin) -> bool:
    """Return whether a small error of the delay makes a loop unstable; False if not judged."""
    return loop.share < FRAGILE


def fold(growth: float) -> str:
    """Return a growth as `1.23 fold`, near 1 as `by 0.04 %`."""
    return f"{growth:.3g} fold" if growth > 1.005 else f"by {100 * (growth - 1):.2g} %"


def loop_word(margin: MarginSummary | None) -> str:
    """Return a few words on `controller_margin` in a run's summary."""
    if margin is None or margin["stable"] is None:
        return "not judged"
    if not margin["stable"]:
        return f"unstable, {fold(margin['spectral_radius'])} per period"
    return f"stable, delay margin {milliseconds(min(margin['delay_margin_s']))}"


def delay_verdict(experiment: Experiment) -> Verdict:
    """Judge the true delay, of `over_wire`, by the open loop's poles along the reference."""
    sc = over_wire(experiment).scenario
    fastest = fastest_in_motion(experiment, experiment.true_dynamics(), sc.duration)
    return Verdict(sc.eta, *fastest, sc.controller.period)


def milliseconds(seconds: float) -> str:
    """Return a time in three digits, or `any time` if it is infinite."""
    return f"{1e3 * seconds:.3g} ms" if math.isfinite(seconds) else "any time"


def _power(exponent: float) -> str:
    """Return e^exponent in two digits, also on overflow: 55, 3.1e10, 2.0e1353."""
    decades = exponent / math.log(10)
    if decades < 4:
        return f"{math.exp(exponent):.0f}"
    return f"{10 ** (decades % 1):.1f}e{int(decades)}"
