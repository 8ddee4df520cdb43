"""Simulation of a scenario."""

import time as clock
from collections.abc import Iterable, Sequence
from pathlib import Path
from traceback import walk_tb
from typing import Any, Final

import numpy as np
from pydrake.geometry import Meshcat
from pydrake.systems.analysis import Simulator, SimulatorStatus
from pydrake.systems.framework import Context

from stewart_drake.dynamics.native_functions import one_blas_thread
from stewart_drake.dynamics.workspace import Failure
from stewart_drake.loop.cautions import cautions_after, cautions_before
from stewart_drake.loop.controller_margin import ControllerMargin, controller_margin
from stewart_drake.loop.diagram import ClosedLoop, PlantDiagram, build_closed_loop
from stewart_drake.loop.exact import set_accuracy
from stewart_drake.loop.own import OwnController, OwnLaw, OwnReference, OwnSystem
from stewart_drake.loop.preparation import Experiment, as_experiment
from stewart_drake.loop.recording import Recorder, summarize
from stewart_drake.loop.results import SimulationResult
from stewart_drake.loop.sampling import dispose
from stewart_drake.loop.scene import Live, Progress
from stewart_drake.mechanism.geometry import Mechanism
from stewart_drake.scenario.config import Scenario
from stewart_drake.scenario.run_log import RunLog, open_log
from stewart_drake.scenario.timing import instants, look_time

_PACKAGE: Final = __name__.partition(".")[0]


def simulate(
    scenario: Scenario | Experiment | str | Path,
    settings: Iterable[str] = (),
    *,
    controller: OwnController | None = None,
    reference: OwnReference | None = None,
    disturbance: OwnSystem | None = None,
    modify_law: OwnLaw | None = None,
    sensor: OwnSystem | None = None,
    link: OwnSystem | None = None,
    tuner: OwnSystem | None = None,
    progress: Progress | None = None,
    meshcat: Meshcat | None = None,
    true_mechanism: Mechanism | None = None,
    judge_stability: ControllerMargin | bool = True,
    log: str | Path | None = None,
) -> SimulationResult:
    """Run a scenario from t = 0 to its duration, or until the plate leaves its workspace.

    Ctrl-C ends the run with the results so far, status `interrupted`.

    A system of your own is an instance for one run, or a function that makes one, such as its
    class. `own` of the summary names them. With a controller of your own, estimates and weights are
    NaN in the record, and counts are 0.

    Args:
        scenario: a scenario, prepared or not, or a shipped name or file as for `load_scenario`.
        settings: as `load_scenario` takes them.
        controller: a shipped name or a YAML file, laid over the scenario's own; or a Drake system
            with the inputs `measurement` (12: measured pose and rates, rad, m and per s) and
            optionally `reference` (18: present pose, rates, accelerations), and the output `torque`
            (6, N m), which is read every `controller.period`, held, limited and delayed.
        reference: a 6 x 1 Drake Trajectory of the pose with derivatives of order 1 and 2, held
            after its end.
        disturbance: a Drake system with the output `torque` (6, N m), added at the shafts, or
            `wrench` (6: moment in N m, force in N, in the world, at the plate's COM), or both,
            unknown to the controller.
        modify_law: a function that takes the scenario's law, a `law.predictive_lqi.PredictiveLqi`,
            and returns another, such as `dataclasses.replace(law, observer=Mine())`.
        sensor: a Drake system with the input `state` (12) and the output `measurement` (12; NaN is
            lost), read every `controller.period`, without the scenario's noise and faults. Neither
            this nor a controller is possible with encoders.
        link: a Drake system with the input `commanded` (6, N m, limited) and the output `torque`
            (6, arriving now); the law still assumes the scenario's link.
        tuner: a Drake system with the output `weights` (2: w_Q, w_R), read every
            `controller.period`, and of the inputs `density` (18), `measurement` (12) and
            `reference` (18) those that it needs. With encoders `measurement` is the estimate of the
            sample before.
        progress: called every 20 ms of simulated time, with that time in s and the error in % of
            peak to peak; its exceptions reach the caller.
        meshcat: shows the machine, its reference and the torques live, at most in real time, or
            None.
        true_mechanism: the machine to simulate; by default that of the scenario's plant.
        judge_stability: whether to judge the loop before the run, in some tenths of a second, for
            `controller_margin` (else None) and `warnings` of the summary; or its known
            `controller_margin`.
        log: file that is written while the run goes on, .mcap or .csv; see `scenario.run_log`.

    Raises:
        ConfigError: bad input, an unreachable reference.
        TypeError: another type of scenario, or systems of your own with an `Experiment`.
    """
    # Matrices of twenty rows are slower on several threads, up to fifty times on busy cores.
    with one_blas_thread:
        experiment = as_experiment(
            scenario,
            true_mechanism,
            settings,
            controller=controller,
            reference=reference,
            disturbance=disturbance,
            modify_law=modify_law,
            sensor=sensor,
            link=link,
            tuner=tuner,
        )
        if isinstance(judge_stability, bool):
            judgeable = judge_stability and experiment.own.unjudged is None
            judged = controller_margin(experiment) if judgeable else None
        else:
            judged = judge_stability
        logs = [] if log is None else [open_log(Path(log), experiment.scenario)]
        try:
            return _run(experiment, judged, progress, meshcat, logs)
        finally:
            for one in logs:
                one.close()


def _run(
    experiment: Experiment,
    margin: ControllerMargin | None,
    progress: Progress | None,
    meshcat: Meshcat | None,
    logs: Sequence[RunLog],
) -> SimulationResult:
    started, scenario = clock.perf_counter(), experiment.scenario
    loop = build_closed_loop(experiment)
    simulator = make_simulator(loop)
    live = None if meshcat is None else Live(loop, simulator, meshcat, progress)
    recorder = Recorder(loop, logs)
    try:
        status, stopped = _advance(simulator, recorder, loop, live or progress)
        wall = clock.perf_counter() - started
        signals = recorder.dataset()
    finally:
        if live is not None:
            live.close()
        dispose(loop, experiment.own.instances, tuple(experiment.own.systems.values()))
    summary = summarize(experiment, recorder, status, stopped, wall, margin)
    summary["warnings"] = cautions_before(experiment, margin) + cautions_after(experiment, summary)
    return SimulationResult(
        scenario=scenario,
        status=status,
        stopped=stopped,
        signals=signals,
        summary=summary,
    )


def _advance(
    simulator: Simulator, recorder: Recorder, loop: ClosedLoop, progress: Progress | None
) -> tuple[str, Failure | None]:
    """Run to the end and record; return status and the reason of an early end."""
    sc, context = loop.experiment.scenario, simulator.get_context()
    try:
        for instant in instants(sc.duration, sc.controller.period, sc.log_period):
            t = instant.time
            # Without `progress`, whose RuntimeError is not Drake's.
            try:
                left = _advance_to(t, simulator, recorder)
            except Exception as error:
                if not isinstance(error, RuntimeError) or _raised_elsewhere(error):
                    place = loop.experiment.own.place(error)
                    error.add_note(f"{place}at t = {context.get_time():.6g} s")
                    raise
                return "solver_failed", solver_failure(context, error)
            if left:
                return "left_workspace", failure_of(loop, context)
            recorder.keep(context, instant)
            if progress is not None and instant.on_grid:
                progress(t, recorder.current_error())
    except KeyboardInterrupt:
        return "interrupted", Failure(context.get_time(), None, np.nan, "interrupted")
    return "completed", None


def _raised_elsewhere(error: Exception) -> bool:
    """Return whether an error comes from Python code of the user."""
    frames = walk_tb(error.__traceback__)
    return any(not str(f.f_globals.get("__name__")).startswith(_PACKAGE) for f, _ in frames)


def _advance_to(t: float, simulator: Simulator, recorder: Recorder) -> bool:
    """Simulate to t in s and read the plant; return True if the plate left before."""
    if t == 0:
        simulator.Initialize()
    else:
        outcome = simulator.AdvanceTo(look_time(t))
        if outcome.reason() == SimulatorStatus.ReturnReason.kReachedTerminationCondition:
            return True
    recorder.look(simulator.get_context(), t)
    if t == 0:  # the events of this instant are still pending
        simulator.AdvancePendingEvents()
    return False


def make_simulator(machine: PlantDiagram) -> Simulator:
    plant = machine.experiment.scenario.plant
    simulator = Simulator(machine, machine.CreateDefaultContext())
    if plant.kind != "multibody":
        set_accuracy(simulator, plant.accuracy)
    return simulator


def failure_of(machine: PlantDiagram, context: Context) -> Failure:
    """Return why the plant ended its simulation."""
    plant: Any = machine.GetSubsystemByName("plant")
    failure: Failure | None = plant.diagnose(plant.GetMyContextFromRoot(context))
    assert failure is not None, "the simulation ended inside the workspace"
    return failure


def solver_failure(context: Context, error: Exception) -> Failure:
    """Return that Drake's solver failed: constraints contradict the dynamics."""
    return Failure(context.get_time(), None, np.nan, " ".join(str(error).split()))
