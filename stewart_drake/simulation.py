"""Running a scenario."""

import time as clock
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydrake.geometry import Meshcat
from pydrake.systems.analysis import (
    ApplySimulatorConfig,
    Simulator,
    SimulatorConfig,
    SimulatorStatus,
)
from pydrake.systems.framework import Context
from threadpoolctl import threadpool_limits

from stewart_drake.config import Scenario
from stewart_drake.diagram import ClosedLoop, build_closed_loop
from stewart_drake.experiment import prepare
from stewart_drake.lifetime import let_go
from stewart_drake.mechanism.geometry import Mechanism
from stewart_drake.plant.workspace import Failure, diagnose
from stewart_drake.recording import Recorder, summarize
from stewart_drake.results import SimulationResult
from stewart_drake.signals import POSE
from stewart_drake.timing import METRIC_PERIOD, look_time

Array = NDArray[np.float64]
Progress = Callable[[float, float], None]
"""Called with simulated time in s and the current pose error in % of peak to peak."""


def simulate(
    scenario: Scenario,
    *,
    progress: Progress | None = None,
    meshcat: Meshcat | None = None,
    truth: Mechanism | None = None,
) -> SimulationResult:
    """Run a scenario from t = 0 to its duration, or until the plate leaves its workspace.

    Ctrl-C ends the run with what has been computed, status `interrupted`.

    Args:
        scenario: what to run.
        progress: called at every logged instant.
        meshcat: where the multibody plant is shown live, or None.
        truth: the machine to simulate where it is not the one that the controller knows.

    Raises:
        ConfigError: bad input, an unreachable reference.
    """
    # Matrices of twenty rows are slower on several threads, fifty times so where cores are busy.
    with threadpool_limits(limits=1):
        return _run(scenario, truth, progress, meshcat)


def _run(
    scenario: Scenario,
    truth: Mechanism | None,
    progress: Progress | None,
    meshcat: Meshcat | None,
) -> SimulationResult:
    started = clock.perf_counter()
    experiment = prepare(scenario, truth)
    loop = build_closed_loop(experiment, meshcat=meshcat)
    simulator = make_simulator(loop)
    recorder = Recorder(loop)
    status, stopped = "completed", None
    context = simulator.get_context()
    try:
        simulator.Initialize()
        for t, logged, sampled in _instants(scenario):
            if t > 0:
                outcome = simulator.AdvanceTo(look_time(t))
                if outcome.reason() == SimulatorStatus.ReturnReason.kReachedTerminationCondition:
                    status, stopped = "left_workspace", _failure(loop, context)
                    break
            recorder.look(context, t)
            if t == 0:  # only here are the events of the instant still to come
                simulator.AdvancePendingEvents()
            recorder.keep(context, logged, sampled)
            if progress is not None and logged:
                progress(t, recorder.current_error())
    except KeyboardInterrupt:
        status = "interrupted"
        stopped = Failure(context.get_time(), None, np.nan, "interrupted")
    except RuntimeError as error:
        # Drake's solver gives up where constraints and dynamics contradict each other.
        status = "solver_failed"
        stopped = Failure(context.get_time(), None, np.nan, _one_line(error))
    wall = clock.perf_counter() - started
    signals = recorder.dataset()
    let_go(loop)
    return SimulationResult(
        scenario=scenario,
        status=status,
        stopped=stopped,
        signals=signals,
        summary=summarize(experiment, recorder, signals, status, stopped, wall),
    )


def make_simulator(loop: ClosedLoop) -> Simulator:
    """A simulator of the loop at its initial context, integrating as the scenario says."""
    plant = loop.experiment.scenario.plant
    context = loop.initial_context()
    simulator = Simulator(loop, context)
    if plant.kind == "exact":
        config = SimulatorConfig(
            integration_scheme="runge_kutta5",
            accuracy=plant.accuracy,
            max_step_size=METRIC_PERIOD,
            use_error_control=True,
        )
        ApplySimulatorConfig(config, simulator)
        context.SetAccuracy(plant.accuracy)
    return simulator


def _instants(scenario: Scenario) -> Iterator[tuple[float, bool, bool]]:
    """Instants to look at, whether on the metric's grid (or last), whether a controller sample."""
    end = scenario.duration

    def multiples(period: float) -> set[float]:
        # Grid and samples that agree but for rounding are one instant.
        return {*np.round(period * np.arange(int(end / period + 1e-9) + 1), 9).tolist()}

    logged = multiples(METRIC_PERIOD) | {round(end, 9)}
    samples = multiples(scenario.controller.period)
    for t in sorted(logged | samples):
        yield min(t, end), t in logged, t in samples


def _failure(loop: ClosedLoop, context: Context) -> Failure:
    plant: Any = loop.GetSubsystemByName("plant")
    plant_context = plant.GetMyContextFromRoot(context)
    cranks = None
    if plant.HasOutputPort("crank_angles"):
        cranks = plant.GetOutputPort("crank_angles").Eval(plant_context)
    pose = plant.GetOutputPort("state").Eval(plant_context)[POSE]
    failure = diagnose(loop.experiment.truth, context.get_time(), pose, cranks)
    assert failure is not None, "the simulation ended inside the workspace"
    return failure


def _one_line(error: Exception) -> str:
    return " ".join(str(error).split())
