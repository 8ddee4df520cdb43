"""Stability and margins of a scenario's controller on its plant along the reference.

Law and plant are linearised at instants along the reference, and each loop is judged as if that
state of motion lasted ("frozen"): `law.stability`. The plant is the true one, with its payload,
friction, dimensions and delay. The law has the delay it believes in, its model, its prediction and
its initial weights. A controller of the user's own is linearised by differences: `own_loop`. Left
out are

- the estimator: a law with one is judged as if it had found the parameters that it estimates and,
  if it estimates that, the delay;
- the tuner, torque limits and the catch-up from rest;
- the change of reference and gain during the life of an error.

Plant, law, loop, S and T of a scenario as `control.StateSpace`, for Bode, Nyquist and margins.

All are sampled with the controller's period dt. Errors are [pose error; rate error] and, if the
law integrates, the integral of the pose error, in the order and the units of `signals`. The loop is
cut between the torques u_k of the law and the torques v_k of the motors:

    plant  P: v -> e,  e_{k+1} = A e_k + B_old v_{k-mu-1} + B_new v_{k-mu}     (32), the true delay
    law    F: e -> u,  u_k = -K [e_k; u_{k-L} ... u_{k-1}]                     (law), the believed
    loop   L = -F P,   S = (1 + L)^-1,   T = L (1 + L)^-1 = 1 - S.

L is the loop of a negative feedback, u = -L v, as `control.feedback(L, identity)`, `nyquist_plot`
and `disk_margins` expect. S leads from a torque added at the motors to the torque that acts.
"""

import math
from collections.abc import Iterable
from contextlib import suppress
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Final, NamedTuple

import numpy as np

from stewart_drake.dynamics.stewart import StewartDynamics
from stewart_drake.dynamics.workspace import margin
from stewart_drake.files.arguments import fixed, of_kind
from stewart_drake.files.errors import ConfigError
from stewart_drake.law.cost import law_gain
from stewart_drake.law.delay_model import LinearModel, chain, linear_model
from stewart_drake.law.nominal import MultibodyModel
from stewart_drake.law.predictive_lqi import PredictiveLqi
from stewart_drake.law.riccati import RiccatiError
from stewart_drake.law.sensing import EncoderSensing
from stewart_drake.law.stability import (
    LinearLoop,
    Margins,
    amplification,
    fastest_pole,
    is_stable,
    spectral_radius,
    worst_margins,
)
from stewart_drake.loop.law_design import DesignedLaw, compose_law, longest_wait
from stewart_drake.loop.own import OwnController
from stewart_drake.loop.own_loop import OwnLoop, UnjudgedError, linearised
from stewart_drake.loop.preparation import Experiment, as_experiment
from stewart_drake.loop.results import MarginSummary
from stewart_drake.mechanism.trajectories import evaluate, poses_along
from stewart_drake.scenario.calibration import believed_delay
from stewart_drake.scenario.config import DelayConfig, Scenario
from stewart_drake.scenario.field_types import MOST_PERIODS
from stewart_drake.scenario.link import oldest_periods
from stewart_drake.scenario.link_config import WireConfig
from stewart_drake.scenario.signals import (
    ACCELERATIONS,
    COORDINATES,
    LEGS,
    NUM_STATE,
    NUM_TORQUES,
    POSE,
    RATES,
    STATE,
)
from stewart_drake.types import Array

INSTANTS: Final = 30
"""Number of instants along the reference. A prime number of steps, 29, avoids the same phases
of a periodic motion. Twice as many change the margins of the shipped scenarios by less than a
tenth."""
POLE_INSTANTS: Final = 62
"""Number of instants at which the open loop's poles are found, also in 61 steps, a prime number."""
_COSTLY: Final = 150
"""Rows of a loop above which fewer instants are judged: an eigenvalue problem costs rows^3."""
_LARGEST: Final = 330
"""Rows of a loop above which it is not judged: fifty periods of delay."""
_FEWEST: Final = 6
_UNJUDGED: Final = Margins(*[math.nan] * 4)
Judged = Scenario | str | Path | Experiment | DesignedLaw
"""A loop of a scenario, or of a designed law with the machine that it assumes."""


@dataclass(frozen=True)
class ControllerMargin:
    """The loop at its worst along the reference.

    Attributes:
        period: of the controller, s.
        eta: true total delay, s.
        radius: largest spectral radius, the factor on an error per period; NaN with a `problem`.
        time: of that radius, s.
        margins: the least errors of the delay in s, `shorter` and `longer`, and factors of the
            motors, `gain_down` and `gain_up`, at the edge of stability; NaN with a `problem`.
        pole: fastest unstable pole of the open loop, 1/s; 0 without one.
        pole_time: of that pole, s.
        estimated: whether an estimator is assumed to have found the unknown parameters.
        delay_found: whether it is assumed to have found the delay too.
        tuned: whether a tuner changes the weights.
        weighted: whether `controller.w_R` is a setting of the law.
        problem: why the loop was not judged, or empty.
        loops: the judged ones in the order of time, evenly over `span`; none with a `problem`.
        span: s.
    """

    period: float
    eta: float
    radius: float = math.nan
    time: float = math.nan
    margins: Margins = _UNJUDGED
    pole: float = 0.0
    pole_time: float = 0.0
    estimated: bool = False
    delay_found: bool = False
    tuned: bool = False
    weighted: bool = False
    problem: str = ""
    loops: tuple[LinearLoop, ...] = field(default=(), repr=False)
    span: float = 0.0
    _growths: dict[float, float] = field(default_factory=dict, repr=False, compare=False)

    @property
    def stable(self) -> bool | None:
        """Whether the loop is stable; None if it was not judged."""
        return None if self.problem else self.radius < 1

    @property
    def delay_margin(self) -> float:
        """Error of the delay in s, of either sign, for which the loop is stable."""
        return min(self.margins.shorter, self.margins.longer)

    @property
    def share(self) -> float:
        """This error as a share of the delay; infinite without a delay."""
        return self.delay_margin / self.eta if self.eta else math.inf

    @property
    def growth(self) -> float:
        """Growth e^(pole eta) of an error of the prediction, infinite on overflow."""
        return amplification(self.pole, self.eta)

    def growth_in_steps(self, step: float) -> float:
        """Return the largest growth of an error over any stretch of the motion, for a step in s.

        The plant moves by semi-implicit Euler (`law.delay_model.sample_in_steps`). Each loop's
        spectral radius counts for the periods until the next loop, so that the growth exceeds 1
        only if some loop is unstable with that step. It is infinite on overflow.
        """
        if step not in self._growths:
            self._growths[step] = self._growth_in_steps(step)
        return self._growths[step]

    def _growth_in_steps(self, step: float) -> float:
        periods = self.span / self.period / max(len(self.loops) - 1, 1)
        so_far = most = 0.0
        for loop in self.loops:
            matrix = loop.matrix(step=step)
            if so_far == 0 and is_stable(matrix):
                continue
            so_far = max(0.0, so_far + periods * math.log(spectral_radius(matrix)))
            most = max(most, so_far)
        return math.exp(most) if most < 700 else math.inf

    @property
    def summary(self) -> MarginSummary:
        """Content of `summary.json`; a margin without a limit is infinite, in the file null."""
        m = self.margins
        return {
            "stable": self.stable,
            "spectral_radius": self.radius,
            "delay_margin_s": [m.shorter, m.longer],
            "gain_margin": [m.gain_down, m.gain_up],
            "growth": self.growth,
        }


def controller_margin(
    loop: Judged,
    until: float | None = None,
    machine: StewartDynamics | None = None,
    *,
    settings: Iterable[str] = (),
    controller: OwnController | None = None,
) -> ControllerMargin:
    """Judge stability and margins of a loop along its reference.

    Takes 0.2 s for a delay of ten periods. An estimator, a tuner and torque limits are left out.

    Args:
        loop: a scenario, prepared or not, a shipped name or a path; or a `DesignedLaw`, with the
            machine and the delay that it assumes.
        until: s; None is the duration, or the horizon of the design.
        machine: the machine that the law drives; None is that of the scenario's plant.
        settings: as `load_scenario` takes them.
        controller: in place of the scenario's, as of `simulate`: a name, a file, or your own class
            or function. Your own is linearised by differences, and may have discrete state.

    Raises:
        ConfigError: bad input, an unreachable reference.
        TypeError: settings or a controller without a scenario.
    """
    experiment = _experiment_of(loop, settings, controller)
    sc, own = experiment.scenario, experiment.own.systems.get("controller")
    end = sc.duration if until is None else float(fixed("until", until, (), 0.0))
    if sc.controller.command != "torque":
        # The loops of servos are checked where the servos are made.
        problem = "the servos close their own loops, the delay is outside"
        return ControllerMargin(sc.controller.period, sc.eta, problem=problem, span=end)
    truth, law = _parts(loop, experiment)
    if machine is not None:
        of_kind("machine", machine, StewartDynamics)
        truth = machine
    times = np.linspace(0.0, end, INSTANTS)
    poses = poses_along(experiment.reference, times)
    inside = [margin(truth.mechanism, pose) > 0 for pose in poses]
    pole, pole_time = fastest_in_motion(experiment, truth, end)
    queue = max(sc.true_delay.steps + 1, law.timeline.queue_length)
    rows = 12 + 6 * law.cost.integrates + 6 * queue
    radius, time, margins = math.nan, math.nan, _UNJUDGED
    problem, loops = "", list[LinearLoop]()
    if not all(inside):
        problem = "the true machine does not reach all of the reference"
    elif sc.link.kind == "network" or longest_wait(sc):
        problem = (
            "its packets or measurements do not all take the same time; see analyze robustness, "
            "and over a network analyze delay, which assumes every packet in time"
        )
    elif isinstance(law.sensing, EncoderSensing) and not law.estimates:
        problem = (
            "its rates are differences of measured poses, half a period old, with which a plate is "
            "soon lost; a controller.estimate that is not empty finds them"
        )
    elif not sc.delay.constant:
        problem = "its delay changes"
    elif rows > _LARGEST:
        problem = (
            f"with {sc.true_delay.steps} periods of delay it has {rows} states, too many to judge"
        )
    else:
        every = math.ceil((max(rows, _COSTLY) / _COSTLY) ** 3)
        chosen = times[:: min(every, INSTANTS // _FEWEST)]
        try:
            loops = _loops(experiment, truth, law, chosen)
        except UnjudgedError as error:
            problem = str(error)
    if loops:
        radii = [spectral_radius(loop.matrix()) for loop in loops]
        worst = int(np.argmax(radii))
        radius, time = radii[worst], float(chosen[worst])
        margins = worst_margins([loops[i] for i in _order(radii)])
    return ControllerMargin(
        period=sc.controller.period,
        eta=sc.eta,
        radius=radius,
        time=time,
        margins=margins,
        pole=pole,
        pole_time=pole_time,
        estimated=law.estimates and own is None,
        delay_found=law.finds_delay and own is None,
        tuned=experiment.tuned,
        weighted=sc.controller.kind == "lqi" and own is None,
        problem=problem,
        loops=tuple(loops),
        span=end,
    )


def over_wire(experiment: Experiment) -> Experiment:
    """Return the experiment with a constant delay, as if every packet came in time.

    The delay is that from a measurement as old as `oldest_periods` to its torque: with
    x_{k-m} and the torques since, the law computes at k the u_{k-m} of a wire with m more periods.
    """
    sc = experiment.scenario
    if sc.link.kind == "wire":
        return experiment
    late = oldest_periods(sc)
    true, believed = (
        DelayConfig(steps=min(eta.steps + late, MOST_PERIODS), fraction=eta.fraction)
        for eta in (sc.true_delay, believed_delay(sc))
    )
    controller = replace(
        sc.controller, delay_steps=believed.steps, delay_fraction=believed.fraction
    )
    sensor = replace(sc.sensor, delay=0.0)
    link = WireConfig()
    scenario = replace(sc, link=link, delay=true, sensor=sensor, controller=controller)
    return experiment._replace(scenario=scenario)


def _order(radii: list[float]) -> list[int]:
    """Return the order of the loops in the search for the least margin.

    The likely worst come first, the ends of the order by radius. The rest are shuffled: margins
    that fall steadily along the motion would be searched for one by one.
    """
    first, *between, last = (int(i) for i in np.argsort(radii)[::-1])
    return [first, last, *(int(i) for i in np.random.default_rng(0).permutation(between))]


def true_model(experiment: Experiment, truth: StewartDynamics, time: float) -> LinearModel:
    """Return the plant about the moving reference at `time` in s, under its inverse dynamics."""
    x = evaluate(experiment.reference, time)
    torque = truth.inverse_dynamics(x[POSE], x[RATES], x[ACCELERATIONS])
    return linear_model(*truth.derivatives(x[POSE], x[RATES], torque)[:2])


def pole_in_motion(experiment: Experiment, truth: StewartDynamics, time: float) -> float:
    """Return the fastest pole of `true_model`, 1/s; 0 if nothing grows, or out of reach."""
    if not margin(truth.mechanism, evaluate(experiment.reference, time)[POSE]) > 0:  # or NaN
        return 0.0
    return fastest_pole(true_model(experiment, truth, time).A)


def fastest_in_motion(
    experiment: Experiment, truth: StewartDynamics, end: float
) -> tuple[float, float]:
    """Return the fastest pole of `true_model` in 1/s, 0 without one, and its time in s."""
    times = np.linspace(0.0, end, POLE_INSTANTS)
    poles = [pole_in_motion(experiment, truth, t) for t in times]
    worst = int(np.argmax(poles))
    return poles[worst], float(times[worst])


def loop_at(loop: Judged, time: float) -> LinearLoop:
    """Return a loop about its reference at `time` in s."""
    experiment = _experiment_of(loop)
    return _loops(experiment, *_parts(loop, experiment), np.array([time]))[0]


def _experiment_of(
    loop: Judged, settings: Iterable[str] = (), controller: OwnController | None = None
) -> Experiment:
    given = loop.experiment if isinstance(loop, DesignedLaw) else loop
    return as_experiment(given, settings=settings, controller=controller)


def _parts(loop: Judged, experiment: Experiment) -> tuple[StewartDynamics, PredictiveLqi]:
    """Return the true machine, and the law with the true delay if it estimates the delay."""
    if isinstance(loop, DesignedLaw):
        truth, law = loop.law.plant.dynamics, loop.law
    else:
        truth, law = experiment.true_dynamics(), compose_law(experiment)
    if not law.finds_delay:
        return truth, law
    late = replace(law.timeline, delay=experiment.scenario.true_delay)
    return truth, replace(law, timeline=late)


def _loops(
    experiment: Experiment, truth: StewartDynamics, law: PredictiveLqi, times: Array
) -> list[LinearLoop]:
    if "controller" in experiment.own.systems:
        return _own_loops(experiment, truth, times)
    sc, loops, integrates = experiment.scenario, [], law.cost.integrates
    states = 12 + 6 * integrates
    gain = np.zeros((NUM_TORQUES, states + NUM_TORQUES * law.timeline.queue_length))
    for t in times:
        # On failure the law keeps its last gain.
        with suppress(RiccatiError, np.linalg.LinAlgError, ArithmeticError):
            gain = _gain(experiment, truth, law, t)
        plant = true_model(experiment, truth, t)
        loops.append(LinearLoop(plant, gain, law.timeline.period, sc.true_delay, integrates))
    return loops


def _own_loops(experiment: Experiment, truth: StewartDynamics, times: Array) -> list[LinearLoop]:
    """Return the loops of the user's controller.

    Raises:
        UnjudgedError: see `own_loop.linearised`.
    """
    sc, loops, n = experiment.scenario, list[LinearLoop](), NUM_TORQUES
    if (system := experiment.own.another("controller")) is None:
        raise UnjudgedError(
            "its controller was given as an instance; its class, or a function that makes one, is "
            "judged"
        )
    try:
        found = linearised(system, experiment, times)
    except UnjudgedError:
        raise
    except Exception as error:  # of the user's code; the run raises it where it belongs
        raise UnjudgedError(f"its controller fails on the reference: {error}") from error
    for t, J in zip(times, found, strict=True):
        plant, parts = true_model(experiment, truth, t), (J[n:, NUM_STATE:], J[n:, :NUM_STATE])
        period = sc.controller.period
        loops.append(OwnLoop(plant, -J[:n], period, sc.true_delay, False, *parts))
    return loops


def _gain(experiment: Experiment, truth: StewartDynamics, law: PredictiveLqi, time: float) -> Array:
    """Return `law.cost.law_gain` of a law about the reference at `time` in s."""
    plant, timeline, c = law.plant, law.timeline, experiment.scenario.controller
    known = plant.dynamics
    theta = known.free_of(truth.plant_parameters) if law.estimates else known.parameters
    x = evaluate(experiment.reference, time)
    # The torques in flight move the true plant; the model's torque is the feedforward.
    current = truth.inverse_dynamics(x[POSE], x[RATES], x[ACCELERATIONS])
    forward = law.feedforward.at(x, plant.dynamics, theta)
    design = law.model.about(x, forward, theta, plant)
    predictor = law.predictor.model(design, MultibodyModel().about(x, current, theta, plant))
    weights = np.array(c.weights)
    return law_gain(law.cost, design, predictor, timeline, weights)


class LinearModels(NamedTuple):
    """`control.StateSpace` systems, linearised at `time` in s; see the module."""

    plant: Any
    """P, torques (6) to errors (12 or 18)."""
    law: Any
    """F, errors to torques."""
    loop: Any
    """L (6 x 6), cut at the motors, for negative feedback."""
    S: Any
    """Sensitivity (6 x 6)."""
    T: Any
    """Complementary sensitivity (6 x 6)."""
    time: float

    def one_motor(self, leg: int) -> Any:
        """Return the loop (1 x 1) cut at one motor, from 1, with all others closed.

        S_ii = 1 / (1 + L_i). It has one input and output, as `bode_plot`, `nyquist_plot` and
        `disk_margins` expect. `disk_margins` of the whole loop needs the package slycot.

        Raises:
            ConfigError: no such motor.
        """
        import control  # slow

        L = self.loop
        if leg not in range(1, L.ninputs + 1):
            raise ConfigError(f"leg: got {leg!r}; expected 1 to {L.ninputs}")
        own = np.arange(L.ninputs) == leg - 1
        A = L.A - L.B[:, ~own] @ L.C[~own]
        name = [f"torque_{leg}"]
        return control.ss(A, L.B[:, own], L.C[own], 0, L.dt, inputs=name, outputs=name)

    def __repr__(self) -> str:
        return (
            f"LinearModels(at t = {self.time:.3g} s, loop of {self.loop.nstates} states every "
            f"{self.loop.dt:g} s)"
        )


def linear_models(
    scenario: Judged,
    time: float | None = None,
    *,
    settings: Iterable[str] = (),
    controller: OwnController | None = None,
) -> LinearModels:
    """Return a loop, linearised about its moving reference ("frozen").

    An estimator, a tuner and torque limits are left out, see `controller_margin`.

    Args:
        scenario: a Scenario, a shipped name or a path; or a `DesignedLaw`.
        time: s; None is that of the largest spectral radius.
        settings, controller: as of `controller_margin`.

    Raises:
        ConfigError: bad input, an unreachable reference; no time, and a loop that was not judged.
        TypeError: settings or a controller without a scenario.
    """
    experiment = _experiment_of(scenario, settings, controller)
    loop = scenario if isinstance(scenario, DesignedLaw) else experiment
    duration = experiment.scenario.duration
    if time is None:
        margin = controller_margin(loop)
        if margin.problem:
            raise ConfigError(f"time: got None, but {margin.problem}; expected a time in s")
        time = margin.time
    time = float(fixed("time", time, ()))
    if not 0 <= time <= duration:
        raise ConfigError(f"time: got {time!r}; expected 0 to {duration:g} s")
    try:
        return state_spaces(loop_at(loop, time), time)
    except UnjudgedError as error:
        raise ConfigError(f"controller: {error}") from None


def state_spaces(loop: LinearLoop, time: float = 0.0) -> LinearModels:
    """Return the systems of a linear loop with any numbers of states and inputs."""
    import control  # slow

    m = len(loop.K)
    one = np.eye(m)
    torques = [f"torque_{leg}" for leg in LEGS] if m == NUM_TORQUES else m
    errors: Any = [f"error_{name}" for name in STATE]
    if loop.integral:
        errors += [f"integral_{name}" for name in COORDINATES]

    def named(system: Any, name: str, inputs: Any, outputs: Any) -> Any:
        return control.ss(system, name=name, inputs=inputs, outputs=outputs)

    plant, law = _plant(loop), _law(loop)
    n = plant.noutputs
    if n != len(errors) or m != NUM_TORQUES:
        errors = n
    L = -law * plant
    return LinearModels(
        named(plant, "plant", torques, errors),
        named(law, "law", errors, torques),
        named(L, "loop", torques, torques),
        named(control.feedback(one, L), "S", torques, torques),
        named(control.feedback(L, one), "T", torques, torques),
        time,
    )


def _plant(loop: LinearLoop) -> Any:
    """Return P with the states [e; torques under way, oldest first]."""
    import control  # slow

    model = LinearLoop.sampled(loop)
    line, n = chain(model), len(model.A)
    return control.ss(line.A, line.B, np.eye(n, len(line.A)), 0, loop.period)


def _law(loop: LinearLoop) -> Any:
    """Return F with its last L torques, oldest first, as states."""
    import control  # slow

    K, m = loop.K, len(loop.K)
    if isinstance(loop, OwnLoop):
        n = len(loop.plant.A)
        return control.ss(loop.F, loop.G, -K[:, n:], -K[:, :n], loop.period)
    n = loop.plant.A.shape[0] + (loop.plant.C.shape[0] if loop.integral else 0)
    size = K.shape[1] - n
    A, B = np.zeros((size, size)), np.zeros((size, n))
    if size:
        A[:-m, m:] = np.eye(size - m)
        A[-m:], B[-m:] = -K[:, n:], -K[:, :n]
    return control.ss(A, B, -K[:, n:], -K[:, :n], loop.period)
