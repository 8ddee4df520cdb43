"""Warnings about results that may be wrong, one line each.

All but `Experiment.weak_motors`, which `design_law` needs too, are made here. Those known before a
run are printed then. All are in `summary.json` as `warnings`.
"""

import math
from collections.abc import Callable
from itertools import product
from typing import Final

from stewart_drake.law.belief import TOLERATED
from stewart_drake.loop.controller_margin import ControllerMargin
from stewart_drake.loop.peer import MOST_SAMPLES
from stewart_drake.loop.preparation import Experiment
from stewart_drake.loop.results import RunSummary
from stewart_drake.loop.servos import quickest_crank
from stewart_drake.scenario.calibration import believed_delay
from stewart_drake.scenario.config import DelayConfig, Scenario
from stewart_drake.scenario.timing import Delay

TOLERABLE: Final = 1e5
"""Growth of an error along the motion, by a step of the plant, above which there is a warning.

The error of an engine's step is some 1e-5 of the motion. Measured with the paper's machine under
gravity at full, a third and a tenth of its size: up to a growth of 5e4 runs complete as they
should, from 5e6 on they are lost or wrong by a hundred times the exact plant's error.
"""
_MANY_STEPS: Final = 1e6
"""Steps of the exact plant that take about a minute."""


def cautions_before(experiment: Experiment, margin: ControllerMargin | None) -> list[str]:
    """Return the warnings before a run; `margin` is None for a loop that was not judged."""
    said = (
        *(experiment.weak_motors(), stiff_friction(experiment), idle_delay(experiment.scenario)),
        *(many_samples(experiment.scenario), _of_loop(experiment, margin)),
    )
    return [line for line in said if line is not None]


def _of_loop(experiment: Experiment, margin: ControllerMargin | None) -> str | None:
    if experiment.own.unjudged:
        return f"the loop was not judged: its {experiment.own.unjudged} is not the scenario's"
    if margin is None or experiment.scenario.controller.command != "torque":
        return None  # servos have no loop across the delay
    if margin.problem:
        return f"the loop was not judged: {margin.problem}"
    return delays_apart(experiment, margin) or coarse_step(experiment, margin)


def delays_apart(experiment: Experiment, margin: ControllerMargin) -> str | None:
    """Return a warning about an unstable loop whose assumed delay is not the scenario's."""
    sc = experiment.scenario
    assumed = believed_delay(sc).eta(sc.controller.period)
    chosen, blind = sc.controller.delay_steps is not None, sc.controller.delay_steps == 0
    known = blind or "controller" in experiment.own.systems or math.isclose(assumed, sc.eta)
    if margin.stable or margin.delay_found or known:
        return None
    source, remedy = "controller.calibration", "set delay.steps and delay.fraction to it"
    if chosen:
        source = "controller.delay_steps and controller.delay_fraction"
        remedy = "leave both out, or set controller.delay_estimator"
    return (
        f"the loop is unstable, and its controller assumes a delay of {assumed:.6g} s ({source}), "
        f"the scenario's is {sc.eta:.6g} s: {remedy}"
    )


def idle_delay(scenario: Scenario) -> str | None:
    """Return a warning about a delay without effect, as the network's times are given, or None."""
    link, delay = scenario.link, scenario.delay
    if link.kind != "network" or link.follows_delay or delay == DelayConfig():
        return None
    given = Delay(delay.steps, delay.fraction).eta(scenario.controller.period)
    if math.isclose(given, scenario.eta):
        return None
    return (
        f"delay.steps and delay.fraction, {given:.4g} s, have no effect: the times of link are "
        f"given, and link.playout makes the delay {scenario.eta:.4g} s"
    )


def many_samples(scenario: Scenario) -> str | None:
    """Return a warning about more readings a period than a network's datagram holds, or None."""
    samples = scenario.sensor.samples
    if scenario.link.kind == "wire" or samples is None or samples <= MOST_SAMPLES:
        return None
    return f"sensor.samples is {samples}: live and machine take at most {MOST_SAMPLES}"


def stiff_friction(experiment: Experiment) -> str | None:
    """Return a warning about friction too stiff for the plant's steps, with a remedy, or None.

    Friction c tanh(rate / s) acts on the rates at the beginning of a step h. Near rest it is a
    damper of c / s: with H^-1 the accelerations of the cranks per torque, rates follow

        rates_{k+1} = (1 - h c / s H^-1) rates_k,

    which grow, up to h c H^-1, if h c / s exceeds 2 over the largest eigenvalue of H^-1. A crank
    that should creep then trembles. The integrator of the exact plant shortens its steps to about
    as much instead.
    """
    plant = experiment.scenario.plant
    if plant.kind not in ("multibody", "exact") or plant.coulomb_friction == 0:
        return None
    quickest = quickest_crank(experiment.true_dynamics(), experiment)
    longest = 2 * plant.coulomb_speed / (plant.coulomb_friction * quickest)
    if plant.kind == "exact":
        if (times := experiment.scenario.duration / longest / _MANY_STEPS) <= 1:
            return None
        return (
            f"Coulomb friction of {plant.coulomb_friction:g} N m within {plant.coulomb_speed:g} "
            "rad/s forces very short steps, so that this run takes minutes; "
            f"plant.coulomb_speed of {times * plant.coulomb_speed:.1g} or more takes less than one"
        )
    if plant.time_step <= longest:
        return None
    return (
        f"plant.time_step of {1e3 * plant.time_step:g} ms is too coarse for Coulomb friction of "
        f"{plant.coulomb_friction:g} N m within {plant.coulomb_speed:g} rad/s, with which cranks "
        f"tremble where they should stand: {_remedy(experiment.scenario, lambda h: h <= longest)}"
    )


def coarse_step(experiment: Experiment, margin: ControllerMargin) -> str | None:
    """Return a warning about a time step too long for the loop, with a step that suits, or None.

    The engine uses semi-implicit Euler. Its error of first order acts like a delay error of h/2 in
    the pose: a loop with a smaller margin is unstable in the simulation though not on the machine.
    The gaps of its ball joints, of second order in h, are neglected. See
    `ControllerMargin.growth_in_steps`.
    """
    sc = experiment.scenario
    step = sc.plant.time_step
    if (
        sc.plant.kind != "multibody"
        or not margin.stable
        or margin.growth_in_steps(step) < TOLERABLE
    ):
        return None
    remedy = _remedy(sc, lambda h: margin.growth_in_steps(h) < TOLERABLE)
    return (
        f"plant.time_step of {1e3 * step:g} ms is too coarse for this loop, which is unstable with "
        f"the engine's errors of first order though stable without: {remedy}"
    )


def _remedy(scenario: Scenario, suits: Callable[[float], bool]) -> str:
    """Name the longest shorter step, of one digit, that suits loop and periods, if there is one."""
    for exponent, digit in product(range(-2, -7, -1), (5, 2, 1)):
        step = float(f"{digit}e{exponent}")
        if step < scenario.plant.time_step and not scenario.step_problem(step) and suits(step):
            return f"plant.time_step={step:g} would do, or plant.kind=exact"
    return "no multibody step would do, or plant.kind=exact"


def overconfidence(scenario: Scenario, summary: RunSummary) -> list[str]:
    """Return a warning if the estimator's standard deviations are too small."""
    consistency = summary["estimator_consistency"]
    if consistency["verdict"] != "overconfident":
        return []
    ratio = consistency["nis_ratio"]
    shown = (
        f"the squares of its prediction errors are {ratio:.3g} times those that it states"
        if ratio > TOLERATED
        else "parameters that it takes as constant had to change; it widened their uncertainty"
    )
    delay, margin = summary["delay"], summary["controller_margin"]
    wrong = not math.isclose(delay["estimated_s"], delay["true_s"], rel_tol=1e-6)
    likely = (
        f"Most likely it is the delay, which the controller takes for {delay['estimated_s']:.4g} s "
        f"and which is {delay['true_s']:.4g} s: the loop is unstable with this error. "
    ) * bool(wrong and margin and margin["stable"] is False)
    estimated = scenario.controller.estimate
    causes = [one for one in ("coulomb", "payload_position", "wrench") if one not in estimated]
    further = f", or with {' or '.join(causes)} in controller.estimate" * bool(causes)
    return [
        "the estimator is overconfident: the machine does what its model cannot explain, as "
        f"friction, a payload off the centre, a push or a wrong delay do, and {shown}. {likely}"
        f"Estimate the cause, with controller.delay_estimator{further}, or raise "
        "controller.model_error"
    ]


def cautions_after(experiment: Experiment, summary: RunSummary) -> list[str]:
    found, period = [], 1e3 * experiment.scenario.controller.period
    median, worst = (summary["controller_step_ms"][which] for which in ("median", "worst"))
    if median > period:  # a single slow step may be due to the computer
        found.append(
            f"the controller's step took {median:.3g} ms at the median, longer than its period of "
            f"{period:.3g} ms: on this computer it would not keep up with a real machine"
        )
    elif worst > period and experiment.scenario.controller.delay_estimator != "none":
        found.append(
            f"the controller's slowest step took {worst:.3g} ms, longer than its period of "
            f"{period:.3g} ms: the search for the delay takes as long as it has hypotheses, "
            "and a real machine would get the torques of such samples late"
        )
    if broken := summary["counts"]["nonfinite_torque"]:
        found.append(
            f"the controller's torque was not finite at {broken} samples, which sent the last "
            "finite one, or zero"
        )
    found += overconfidence(experiment.scenario, summary)
    margin = summary["controller_margin"]
    if summary["status"] == "completed" and margin is not None and margin["stable"] is False:
        found.append(
            "the run completed although its loop, linearised along the reference, is unstable: a "
            "longer run or a disturbance may end it"
        )
    return found
