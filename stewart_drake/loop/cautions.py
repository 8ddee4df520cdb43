"""What to say of a result that may not be trusted: one line each, collected here and only here.

They are printed before a run as far as they are known then, and stand in `summary.json` as
`warnings`.
"""

from collections.abc import Iterator
from itertools import product
from typing import Final

from stewart_drake.loop.controller_margin import ControllerMargin
from stewart_drake.loop.preparation import Experiment
from stewart_drake.loop.results import RunSummary
from stewart_drake.loop.servos import quickest_crank
from stewart_drake.scenario.config import Scenario

TOLERABLE: Final = 1e5
"""Growth of an error along the motion, by a step of the plant, up to which nothing is said.

An engine's step is wrong by some 1e-5 of the motion. Measured with the paper's machine under
gravity at full, a third and a tenth of its size: up to a growth of 5e4 runs complete as they
should, from 5e6 on they are lost or wrong by a hundred times the exact plant's error.
"""


def cautions_before(experiment: Experiment, margin: ControllerMargin | None) -> list[str]:
    """What can be said before the run; `margin` is None where the loop was not judged."""
    said = (stiff_friction(experiment), _of_loop(experiment, margin))
    return [line for line in said if line is not None]


def _of_loop(experiment: Experiment, margin: ControllerMargin | None) -> str | None:
    if experiment.own.unjudged:
        return f"the loop was not judged: its {experiment.own.unjudged} is not the scenario's"
    if margin is None or experiment.scenario.controller.command != "torque":
        return None  # servos have no loop across the delay
    if margin.problem:
        return f"the loop was not judged: {margin.problem}"
    return coarse_step(experiment, margin)


def stiff_friction(experiment: Experiment) -> str | None:
    """What is wrong with Coulomb friction in the step of a multibody plant, and which would do.

    Friction c tanh(rate / s) acts on the rates that a step h begins with. Near rest that is a
    damper of c / s: with H^-1 the accelerations of the cranks per torque, rates go

        rates_{k+1} = (1 - h c / s H^-1) rates_k,

    which grow, up to h c H^-1, where h c / s exceeds 2 over the largest eigenvalue of H^-1. Then a
    crank that should creep trembles.
    """
    plant = experiment.scenario.plant
    if plant.kind != "multibody" or plant.coulomb_friction == 0:
        return None
    quickest = quickest_crank(experiment.true_dynamics(), experiment)
    longest = 2 * plant.coulomb_speed / (plant.coulomb_friction * quickest)
    if plant.time_step <= longest:
        return None
    finer = next((h for h in _finer(experiment.scenario) if h <= longest), None)
    remedy = f"plant.time_step={finer:g} would do" if finer else "no multibody step would do"
    return (
        f"plant.time_step of {1e3 * plant.time_step:g} ms is too coarse for Coulomb friction of "
        f"{plant.coulomb_friction:g} N m within {plant.coulomb_speed:g} rad/s, with which cranks "
        f"tremble where they should stand: {remedy}, or plant.kind=exact"
    )


def coarse_step(experiment: Experiment, margin: ControllerMargin) -> str | None:
    """What is wrong with the step of a multibody plant, and which would do, or None.

    The engine moves the plate by semi-implicit Euler, whose error of first order acts like a delay
    that is wrong by h/2 in the pose: a loop that bears less is unstable with the plant in the
    simulation though not on the machine. Its ball joints are closed by constraints whose gaps are
    of second order in h and are no part of this. See `ControllerMargin.growth_in_steps`.
    """
    sc = experiment.scenario
    step = sc.plant.time_step
    if (
        sc.plant.kind != "multibody"
        or not margin.stable
        or margin.growth_in_steps(step) < TOLERABLE
    ):
        return None
    finer = next((h for h in _finer(sc) if margin.growth_in_steps(h) < TOLERABLE), None)
    remedy = f"plant.time_step={finer:g} would do" if finer else "no multibody step would do"
    return (
        f"plant.time_step of {1e3 * step:g} ms is too coarse for this loop, which is unstable with "
        f"the engine's errors of first order though stable without: {remedy}, or plant.kind=exact"
    )


def _finer(scenario: Scenario) -> Iterator[float]:
    """Smaller steps of one digit that suit the scenario's periods, s, the largest first."""
    for exponent, digit in product(range(-2, -7, -1), (5, 2, 1)):
        step = float(f"{digit}e{exponent}")
        if step < scenario.plant.time_step and not scenario.step_problem(step):
            yield step


def cautions_after(experiment: Experiment, summary: RunSummary) -> list[str]:
    """What the run has shown."""
    found, period = [], 1e3 * experiment.scenario.controller.period
    median, worst = (summary["controller_step_ms"][which] for which in ("median", "worst"))
    if median > period:  # one slow step is the machine's doing, the median is not
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
    margin = summary["controller_margin"]
    if summary["status"] == "completed" and margin is not None and margin["stable"] is False:
        found.append(
            "the run completed although its loop, linearised along the reference, is unstable: a "
            "longer run or a disturbance may end it"
        )
    return found
