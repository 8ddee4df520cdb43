"""Limits of a scenario's delay: open loop, closed loop, and simulations."""

import math
from dataclasses import dataclass
from typing import Annotated, Any, Final, NamedTuple

import numpy as np
from pydantic import Field
from threadpoolctl import threadpool_limits

from stewart_drake.dynamics.stewart import StewartDynamics
from stewart_drake.dynamics.workspace import diagnose
from stewart_drake.law.riccati import RiccatiError
from stewart_drake.law.stability import amplification, fastest_pole, largest_delay
from stewart_drake.loop.controller_margin import ControllerMargin, controller_margin
from stewart_drake.loop.experiment import waits_at_rest
from stewart_drake.loop.metrics import delay_floor
from stewart_drake.scenario.config import Scenario
from stewart_drake.scenario.delay import Delay
from stewart_drake.scenario.signals import POSE
from stewart_drake.studies.delay_loop import LoopMargins, loop_margins
from stewart_drake.studies.delay_map import Cell, delay_map, map_delays
from stewart_drake.studies.jobs import Progress
from stewart_drake.studies.options import Options
from stewart_drake.studies.verdict import Basis, Verdict, basis, pole_in_motion
from stewart_drake.types import Array

INSTANTS: Final = 62
"""Number of poles along the reference, in 61 steps: a round number may be in step with it."""
TOLERABLE: Final = (2.0, 10.0, 100.0, 1000.0)
"""Growths of prediction errors for which the largest delay is given."""
_CHECKS: Final = 5
"""Number of poses at which growth is simulated."""
_LARGEST_GROWTH: Final = 1e5
"""Growth above which rounding errors would show in a simulation."""
_PERTURBATION: Final = 1e-5
"""Final size of a perturbation, as a share of the usual motion."""
_STEP: Final = 1e-3
"""Step of the Runge-Kutta method, s."""


class PolePoint(NamedTuple):
    """Fastest unstable poles at one instant of the reference, 1/s; 0 without one."""

    time: float
    """s."""
    moving: float
    """Linearised about the moving reference."""
    held: float
    """With the plate held still at that pose."""


class Growth(NamedTuple):
    """Simulated perturbation of the plate held still, along its fastest mode."""

    time: float
    """Of the pose, s."""
    seconds: float
    """Duration of the growth."""
    expected: float
    """e^(p seconds)."""
    simulated: float


@dataclass(frozen=True)
class DelayStudy:
    """Result of the analysis of the delay.

    Attributes:
        basis: of the analysis.
        controller: the scenario's loop along the reference, as far as that can be followed; None if
            it cannot be followed at all.
        eta: total delay, s.
        poles: along the reference, as far as it can be followed.
        growths: simulated checks of e^(p eta); none if nothing grows.
        floors: E_ac in % s of a plate that waits at rest, by whole periods of delay.
        loops: the closed loop by delay; empty with a reason in `loop_problem`.
        loop_problem: why the closed loop was not judged, or empty.
        cells: simulations by delay and amplitude.
        interrupted: whether Ctrl-C ended the simulations early.
    """

    basis: Basis
    controller: ControllerMargin | None
    eta: float
    poles: tuple[PolePoint, ...]
    growths: tuple[Growth, ...]
    floors: dict[int, float]
    loops: tuple[LoopMargins, ...]
    loop_problem: str
    cells: tuple[Cell, ...]
    interrupted: bool

    @property
    def verdict(self) -> Verdict | None:
        """Verdict on the delay alone; None if the reference cannot be followed at all."""
        if not self.poles:
            return None
        worst = max(self.poles, key=lambda point: point.moving)
        return Verdict(self.eta, worst.moving, worst.time)

    @property
    def loop(self) -> LoopMargins | None:
        """Closed loop at the scenario's delay."""
        own = self.basis.experiment.scenario.true_delay.steps
        return next((loop for loop in self.loops if loop.steps == own), None)

    @property
    def floor_applies(self) -> bool:
        """Whether the scenario waits at rest, an assumption of the floor."""
        return waits_at_rest(self.basis.experiment.scenario)

    @property
    def limits(self) -> list[tuple[float, float, float]]:
        """Tolerable growths, largest delays in s, and the time in s of the fastest pole."""
        if not self.poles:
            return []
        worst = max(self.poles, key=lambda point: point.moving)
        return [(a, largest_delay(worst.moving, a), worst.time) for a in TOLERABLE]

    @property
    def summary(self) -> dict[str, Any]:
        """Content of `summary.json`."""
        own = self.basis.experiment.scenario.true_delay.steps
        return {
            "eta": self.eta,
            "obstacles": self.basis.obstacles,
            "controller_margin": None if self.controller is None else self.controller.summary,
            "verdict": None if self.verdict is None else str(self.verdict),
            "beatable": None if self.verdict is None else self.verdict.beatable,
            "poses": [
                {
                    "t": point.time,
                    "fastest_pole": point.moving,
                    "amplification": amplification(point.moving, self.eta),
                    "fastest_pole_held": point.held,
                }
                for point in self.poles
            ],
            "growth_checks": [growth._asdict() for growth in self.growths],
            "largest_delay": [
                {"amplification": a, "delay": delay, "t": t} for a, delay, t in self.limits
            ],
            "error_floor": self.floors[own],
            "error_floor_applies": self.floor_applies,
            "loop": [loop.summary for loop in self.loops],
            "loop_problem": self.loop_problem or None,
            "map": [
                {**cell._asdict(), "floor": self.floors[cell.steps] if self.floor_applies else 0.0}
                for cell in self.cells
            ],
            "interrupted": self.interrupted,
        }


class DelayOptions(Options):
    """Options of `study_delay`."""

    simulations: Annotated[
        bool, Field(description="Whether to simulate over delay and amplitude too, on all cores.")
    ] = True


def study_delay(
    scenario: Scenario, options: DelayOptions, progress: Progress | None = None
) -> DelayStudy:
    """Analyse a scenario's delay; `progress` is called for each finished simulation.

    Raises:
        ConfigError: one line. A motion or a home pose outside the workspace is reported in
            `Basis.obstacles` instead.
    """
    with threadpool_limits(limits=1):
        found = basis(scenario)
        period, fraction = scenario.controller.period, scenario.true_delay.fraction
        poles = _poles(found)
        loops, problem = _loops(found)
        cells, interrupted = (
            delay_map(scenario, progress) if options.simulations and not problem else ([], False)
        )
        wanted = {scenario.true_delay.steps, *map_delays(scenario.true_delay.steps)}
        return DelayStudy(
            basis=found,
            controller=controller_margin(found.experiment, found.followed_until) if poles else None,
            eta=scenario.eta,
            poles=tuple(poles),
            growths=tuple(_growths(found, poles, scenario.eta)),
            floors={
                steps: error_floor(found, Delay(steps, fraction).eta(period)) for steps in wanted
            },
            loops=tuple(loops),
            loop_problem=problem,
            cells=tuple(cells),
            interrupted=interrupted,
        )


def error_floor(found: Basis, eta: float) -> float:
    """Return E_ac in % s of a plate at rest at the first pose after `eta` s without any torque."""
    reference, duration = found.experiment.reference, found.experiment.scenario.duration
    time: Array = np.linspace(0.0, min(eta, duration), 2001, dtype=np.float64)
    poses = np.array([reference.value(t)[:, 0] for t in time])
    return delay_floor(time, poses, found.experiment.scale, eta)


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
    expected = amplification(float(values[at].real), seconds)
    start = np.concatenate([pose, np.zeros(6)]) + size / expected * mode
    number = max(1, math.ceil(seconds / _STEP))
    states = dynamics.predict(start, np.tile(torque, (number, 1)), seconds / number)
    moved = np.linalg.norm(states[-1, POSE] - pose) / np.linalg.norm(start[POSE] - pose)
    return expected, float(moved)


def _poles(found: Basis) -> list[PolePoint]:
    experiment, points = found.experiment, []
    end = found.followed_until
    for t in np.linspace(0.0, end, INSTANTS) if end > 0 else ():
        pose = experiment.reference.value(t)[:, 0]
        held = fastest_pole(experiment.nominal.linearize(pose)[0])
        points.append(PolePoint(float(t), pole_in_motion(experiment, t), held))
    return points


def _growths(found: Basis, poles: list[PolePoint], eta: float) -> list[Growth]:
    experiment, growths = found.experiment, []
    for point in poles[:: max(1, len(poles) // _CHECKS)][:_CHECKS]:
        if point.held == 0 or eta == 0:
            continue
        seconds = min(eta, largest_delay(point.held, _LARGEST_GROWTH))
        pose = experiment.reference.value(point.time)[:, 0]
        size = _PERTURBATION * float(found.motion.min())
        pair = simulated_growth(experiment.nominal, pose, seconds, size)
        growths.append(Growth(point.time, seconds, *pair))
    return growths


def _loops(found: Basis) -> tuple[list[LoopMargins], str]:
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
