"""Limits of a delay: open loop, closed loop, and simulations over delay and amplitude."""

import math
from collections.abc import Iterable
from dataclasses import dataclass, field, replace
from itertools import product
from typing import Any, Final, NamedTuple

import numpy as np
from threadpoolctl import threadpool_limits

from stewart_drake.dynamics.stewart import StewartDynamics
from stewart_drake.dynamics.workspace import diagnose
from stewart_drake.law import stability
from stewart_drake.law.cost import law_gain
from stewart_drake.law.delay_model import DelayedModel, double_integrators, linear_model
from stewart_drake.law.riccati import RiccatiError
from stewart_drake.law.timeline import Timeline
from stewart_drake.loop.controller_margin import (
    POLE_INSTANTS,
    ControllerMargin,
    controller_margin,
    over_wire,
    pole_in_motion,
)
from stewart_drake.loop.law_design import cost_of
from stewart_drake.loop.preparation import prepare_unchecked
from stewart_drake.loop.results import delay_floor, waits_at_rest
from stewart_drake.mechanism.assembly import torque_map
from stewart_drake.mechanism.trajectories import evaluate
from stewart_drake.scenario.calibration import believed_delay
from stewart_drake.scenario.config import Scenario
from stewart_drake.scenario.reference_config import ReferenceConfig
from stewart_drake.scenario.reference_files import waypoints
from stewart_drake.scenario.signals import POSE
from stewart_drake.scenario.timing import Delay
from stewart_drake.studies.jobs import Progress
from stewart_drake.studies.runs import run_scenarios
from stewart_drake.studies.study_options import DelayOptions
from stewart_drake.studies.verdict import Assessment, Verdict, assess
from stewart_drake.types import Array

TOLERABLE: Final = (2.0, 10.0, 100.0, 1000.0)
"""Growths of prediction errors for which the largest delay is given."""
DELAYS: Final = (0, 1, 2, 3, 4, 6, 8, 10, 12, 16, 20, 25, 30)
"""Delays in periods for which the loop is judged; the scenario's is added."""
WEIGHTS: Final = (1.0, 10.0, 100.0, 1000.0)
"""Values of controller.w_R for which the loop is judged; the scenario's is added."""
FACTORS: Final = (0.5, 0.75, 1.0, 1.25)
"""Factors on the reference's amplitude that are simulated."""
_CHECKS: Final = 5
"""Number of poses at which growth is simulated."""
_LARGEST_GROWTH: Final = 1e5
"""Growth above which rounding errors would show in a simulation."""
_PERTURBATION: Final = 1e-5
"""Final size of a perturbation, as a share of the usual motion."""
_STEP: Final = 1e-3
"""Step of the Runge-Kutta method, s."""
_POINTS: Final = 800
"""Number of frequencies of a motor's loop for python-control, without some low ones."""
_BEYOND: Final = 1.1
"""End of the grid in Nyquist frequencies, for a crossing exactly at Nyquist's."""


class PolePoint(NamedTuple):
    """Fastest unstable poles at one instant of the reference, 1/s; 0 without one.

    `moving` is linearised about the moving reference, `held` with the plate held still at that
    pose; `time` in s.
    """

    time: float
    moving: float
    held: float


class Growth(NamedTuple):
    """Simulated perturbation of the plate held still, along its fastest mode, for some seconds.

    `expected` is e^(p seconds); `time` in s is that of the pose.
    """

    time: float
    seconds: float
    expected: float
    simulated: float


class MotorMargins(NamedTuple):
    """Worst margins of the six loops that are cut at one motor: factors > 1, < 1, and degrees."""

    gain_up: float
    gain_down: float
    phase: float


@dataclass(frozen=True)
class LoopMargins:
    steps: int  # mu
    radius: float  # spectral radius of the closed loop
    S: stability.Peak  # of sensitivity at the motors
    T: stability.Peak  # of complementary sensitivity
    margins: stability.Margins  # errors of the delay, and of all motors alike
    # classical margins of one motor at a time; None if the loop is unstable
    motor: MotorMargins | None

    @property
    def summary(self) -> dict[str, Any]:
        return {
            "mu": self.steps,
            "spectral_radius": self.radius,
            "sensitivity_peak": self.S.value,
            "sensitivity_frequency": self.S.frequency,
            "complementary_peak": self.T.value,
            "complementary_frequency": self.T.frequency,
            "gain_margin": [self.margins.gain_down, self.margins.gain_up],
            "motor_gain_margin": self.motor and [self.motor.gain_down, self.motor.gain_up],
            "motor_phase_margin_deg": self.motor and self.motor.phase,
            "delay_margin_later": self.margins.longer,
            "delay_margin_earlier": self.margins.shorter,
        }


class Cell(NamedTuple):
    steps: int  # whole periods of delay
    factor: float  # on the reference's amplitude
    # as of a simulation, or `out_of_reach` if the reference leaves the workspace, or `not_run`
    # after Ctrl-C
    status: str
    error: float  # E_ac in % s, NaN for a run that did not complete
    time: float  # s, when it ended early or the reference leaves the workspace; else NaN


@dataclass(frozen=True)
class DelayStudy:
    assessment: Assessment
    # the scenario's loop along the reference, as far as that can be followed; None if it cannot be
    # followed at all
    controller: ControllerMargin | None
    eta: float  # total delay, over a network that of `over_wire`, s
    poles: list[PolePoint]  # along the reference, as far as it can be followed
    growths: list[Growth]  # simulated checks of e^(p eta); none if nothing grows
    floors: dict[int, float]  # E_ac in % s of a plate that waits at rest, by whole periods of delay
    loops: list[LoopMargins]  # the closed loop by delay; empty with a reason in `loop_problem`
    loop_problem: str  # why the closed loop was not judged, or empty
    cells: list[Cell]  # simulations by delay and amplitude
    interrupted: bool  # whether Ctrl-C ended the simulations early
    # the stable loops by controller.w_R; empty if the scenario's is unstable or has no such weight
    choices: dict[float, ControllerMargin] = field(default_factory=dict)

    @property
    def verdict(self) -> Verdict | None:
        """Verdict on the delay alone; None if the reference cannot be followed at all."""
        if not self.poles:
            return None
        worst = max(self.poles, key=lambda point: point.moving)
        return Verdict(
            self.eta,
            worst.moving,
            worst.time,
            self.assessment.experiment.scenario.controller.period,
        )

    @property
    def loop(self) -> LoopMargins | None:
        """Closed loop at the scenario's delay."""
        own = self.assessment.experiment.scenario.true_delay.steps
        return next((loop for loop in self.loops if loop.steps == own), None)

    @property
    def floor_applies(self) -> bool:
        """Whether the scenario waits at rest, an assumption of the floor."""
        return waits_at_rest(self.assessment.experiment.scenario)

    @property
    def limits(self) -> list[tuple[float, float, float]]:
        """Tolerable growths, largest delays in s, and the time in s of the fastest pole."""
        worst = self.verdict
        if worst is None:
            return []
        return [(a, stability.largest_delay(worst.pole, a), worst.time) for a in TOLERABLE]

    @property
    def summary(self) -> dict[str, Any]:
        verdict = self.verdict
        return {
            "eta": self.eta,
            "obstacles": self.assessment.obstacles,
            "controller_margin": None if self.controller is None else self.controller.summary,
            "verdict": None if verdict is None else str(verdict),
            "beatable": None if verdict is None else verdict.beatable,
            "poses": [
                {
                    "t": point.time,
                    "fastest_pole": point.moving,
                    "amplification": stability.amplification(point.moving, self.eta),
                    "fastest_pole_held": point.held,
                }
                for point in self.poles
            ],
            "growth_checks": [growth._asdict() for growth in self.growths],
            "largest_delay": [
                {"amplification": a, "delay": delay, "t": t} for a, delay, t in self.limits
            ],
            "error_floor": self.floors[self.assessment.experiment.scenario.true_delay.steps],
            "error_floor_applies": self.floor_applies,
            "loop": [loop.summary for loop in self.loops],
            "loop_problem": self.loop_problem or None,
            "map": [
                {**cell._asdict(), "floor": self.floors[cell.steps] if self.floor_applies else 0.0}
                for cell in self.cells
            ],
            "interrupted": self.interrupted,
        }


def study_delay(
    scenario: Scenario, options: DelayOptions, progress: Progress | None = None
) -> DelayStudy:
    """Analyse a scenario's delay; `progress` is called for each finished simulation.

    A motion or a home pose outside the workspace is reported in `Assessment.obstacles`.
    """
    with threadpool_limits(limits=1):
        found = assess(scenario)
        delay, period = scenario.true_delay, scenario.controller.period
        poles = _poles(found)
        loops, problem = _loops(found)
        simulated = options.simulations and not problem
        cells, interrupted = delay_map(scenario, progress) if simulated else ([], False)
        floors = {
            steps: delay_floor(
                found.experiment.reference,
                found.experiment.scale,
                min(Delay(steps, delay.fraction).eta(period), scenario.duration),
            )
            for steps in {delay.steps, *map_delays(delay.steps)}
        }
        timed = found._replace(experiment=over_wire(found.experiment))
        eta = timed.experiment.scenario.eta
        own = controller_margin(timed.experiment, found.followed_until) if poles else None
        return DelayStudy(
            assessment=found,
            controller=own,
            eta=eta,
            poles=poles,
            growths=_growths(found, poles, eta),
            floors=floors,
            loops=loops,
            loop_problem=problem,
            cells=cells,
            interrupted=interrupted,
            choices=_choices(timed, own) if own and own.stable and own.weighted else {},
        )


# ---------------------------------------------------------------- open loop


def simulated_growth(
    dynamics: StewartDynamics, pose: Array, seconds: float, size: float
) -> tuple[float, float]:
    """Return e^(p seconds), and the growth of a perturbation of a plate held still at a pose (6,).

    It starts along the mode of the fastest pole p, so small that it ends at about `size` (rad, m).
    The nonlinear equations are integrated with the torque that holds the plate.
    """
    torque = dynamics.equilibrium_torque(pose)
    values, vectors = np.linalg.eig(dynamics.linearize(pose, torque=torque)[0])
    at = int(values.real.argmax())
    mode = vectors[:, at].real / np.abs(vectors[POSE, at].real).max()
    expected = stability.amplification(float(values[at].real), seconds)
    start = np.concatenate([pose, np.zeros(6)]) + size / expected * mode
    number = max(1, math.ceil(seconds / _STEP))
    states = dynamics.predict(start, np.tile(torque, (number, 1)), seconds / number)
    moved = np.linalg.norm(states[-1, POSE] - pose) / np.linalg.norm(start[POSE] - pose)
    return expected, float(moved)


def _poles(found: Assessment) -> list[PolePoint]:
    experiment, points = found.experiment, []
    end, truth = found.followed_until, experiment.true_dynamics()
    for t in np.linspace(0.0, end, POLE_INSTANTS) if end > 0 else ():
        pose = experiment.reference.value(t)[:, 0]
        held = stability.fastest_pole(experiment.nominal.linearize(pose)[0])
        points.append(PolePoint(float(t), pole_in_motion(experiment, truth, t), held))
    return points


def _growths(found: Assessment, poles: list[PolePoint], eta: float) -> list[Growth]:
    experiment, growths = found.experiment, []
    for point in poles[:: max(1, len(poles) // _CHECKS)][:_CHECKS]:
        if point.held == 0 or eta == 0:
            continue
        seconds = min(eta, stability.largest_delay(point.held, _LARGEST_GROWTH))
        pose = experiment.reference.value(point.time)[:, 0]
        size = _PERTURBATION * float(found.motion.min())
        pair = simulated_growth(experiment.nominal, pose, seconds, size)
        growths.append(Growth(point.time, seconds, *pair))
    return growths


# ---------------------------------------------------------------- closed loop


def _loops(found: Assessment) -> tuple[list[LoopMargins], str]:
    if found.experiment.scenario.link.kind == "network":
        return [], "its torques come in packets, which analyze link is about"
    pose = found.experiment.reference.value(0.0)[:, 0]
    failure = diagnose(found.experiment.mechanism, 0.0, pose)
    if failure is not None:
        return [], f"at the reference's first pose: {failure.reason}"
    try:
        return loop_margins(found), ""
    except (RiccatiError, np.linalg.LinAlgError) as error:
        return [], f"no gain at the reference's first pose: {error}"


def loop_margins(found: Assessment, delays: Iterable[int] = DELAYS) -> list[LoopMargins]:
    """Judge the loop over the delay, linearised at the reference's first pose, held still.

    The law is designed as the scenario's controller (model, prediction, weights, believed delay)
    and closed around the true plant. An estimator is assumed to have found payload and friction.
    """
    experiment, sc = found.experiment, found.experiment.scenario
    c, pose = sc.controller, evaluate(experiment.reference, 0.0)[POSE]
    plant = linear_model(*experiment.true_dynamics().linearize(pose))
    known = experiment.true_dynamics() if c.estimate else experiment.nominal
    predictor = design = linear_model(*known.linearize(pose))
    if c.model == "paper":
        design = double_integrators(torque_map(experiment.mechanism, pose, c.torque_map))
    if c.prediction == "linear":
        predictor = design
    weights, judged = np.array(c.weights), []
    for steps in sorted({*delays, sc.delay.steps}):
        at = replace(sc, delay=replace(sc.delay, steps=steps))
        cost = cost_of(experiment._replace(scenario=at), found.torque)
        timeline = Timeline(c.period, believed_delay(at))
        K = law_gain(cost, design, predictor, timeline, weights)
        delay = Delay(steps, sc.delay.fraction)
        judged.append(_margins_of(stability.LinearLoop(plant, K, c.period, delay, cost.integrates)))
    return judged


def _choices(found: Assessment, own: ControllerMargin) -> dict[float, ControllerMargin]:
    """Return the loop along the reference by w_R, as far as it is stable, with the `own` one."""
    sc = found.experiment.scenario
    loops = {sc.controller.weights[1]: own}
    for w_R in {*WEIGHTS} - loops.keys():
        other = replace(sc, controller=replace(sc.controller, w_R=w_R))
        loops[w_R] = controller_margin(
            found.experiment._replace(scenario=other), found.followed_until
        )
    return {w_R: loop for w_R, loop in sorted(loops.items()) if loop.stable}


def _margins_of(loop: stability.LinearLoop) -> LoopMargins:
    radius, true = stability.spectral_radius(loop.matrix()), loop.sampled()
    S = T = stability.Peak(math.nan, math.nan)
    motor = None
    if radius < 1:
        S, T = stability.peaks(true, loop.K, loop.period)
        motor = _motor_margins(true, loop.K, loop.period)
    return LoopMargins(loop.delay.steps, radius, S, T, stability.worst_margins([loop]), motor)


def _motor_margins(plant: DelayedModel, K: Array, period: float) -> MotorMargins:
    """Return the worst margins of six single loops, from their frequency responses.

    With the other five closed, the loop of motor i is L_i = 1 / S_ii - 1.
    """
    import control

    nyquist = np.pi / period
    evenly = np.linspace(0.0, _BEYOND * nyquist, _POINTS)[1:]
    grid = np.union1d(stability.frequency_grid(period, _POINTS // 8), evenly)
    S = stability.sensitivity(stability.loop_gain(plant, K, np.exp(1j * grid * period)))
    up, down, phase = math.inf, 0.0, math.inf
    for motor in range(S.shape[1]):
        response = control.frd(1 / S[:, motor, motor] - 1, grid, smooth=True)
        gains, phases, *_ = control.stability_margins(response, returnall=True)
        up = min([up, *gains[gains > 1]])
        down = max([down, *gains[gains < 1]])
        phase = min([phase, *np.abs(phases)])
    return MotorMargins(float(up), float(down), float(phase))


# ---------------------------------------------------------------- simulations


def map_delays(steps: int) -> list[int]:
    """Return the delays in periods that are simulated for a scenario's own."""
    return sorted({0, steps // 2, steps, 3 * steps // 2, 2 * steps}) if steps > 1 else [0, 1, 2, 4]


def scaled_motion(reference: ReferenceConfig, factor: float) -> ReferenceConfig | None:
    """Return the motion with its amplitude, or its way from the first waypoint, times `factor`.

    None if it has no amplitude to scale: a constant pose, or a file of samples.
    """
    if factor == 1:
        return reference
    if reference.kind == "sine":
        return replace(reference, amplitude=[factor * a for a in reference.amplitude])
    if reference.kind == "waypoints":
        times, poses = waypoints(reference)
        way = poses[0] + factor * (poses - poses[0])
        return replace(reference, file=None, times=times.tolist(), poses=way.tolist())
    return None


def delay_map(scenario: Scenario, progress: Progress | None = None) -> tuple[list[Cell], bool]:
    """Simulate a scenario on the exact plant over delays and amplitudes, on all cores.

    Everything else stays the same, also the delay that the controller believes. Returns cells by
    delay, then factor, and whether Ctrl-C ended the simulations early.
    """
    cells: dict[str, Cell] = {}
    variants: dict[str, Scenario] = {}
    exact = replace(scenario, plant=scenario.plant.without_engine)
    for steps, factor in product(map_delays(scenario.delay.steps), FACTORS):
        motion = scaled_motion(scenario.reference, factor)
        if motion is None:
            continue
        variant = replace(exact, reference=motion, delay=replace(scenario.delay, steps=steps))
        key = f"mu{steps}-x{factor}"
        cells[key] = Cell(steps, factor, "not_run", math.nan, math.nan)
        if failure := prepare_unchecked(variant).reference_failure():
            cells[key] = cells[key]._replace(status="out_of_reach", time=float(failure.time))
        else:
            variants[key] = variant
    found, interrupted = run_scenarios(variants, progress)
    for key, one in found.items():
        cells[key] = cells[key]._replace(status=one.status, error=one.error, time=one.time)
    return list(cells.values()), interrupted
