"""The shipped controllers on one scenario, and the user's own."""

import math
import pickle
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor, wait
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Final

import numpy as np
from pydrake.systems.framework import System
from pydrake.trajectories import Trajectory

from stewart_drake.files.errors import ConfigError
from stewart_drake.files.resources import resolve
from stewart_drake.files.yamlio import brief
from stewart_drake.loop.own import OwnReference
from stewart_drake.loop.results import SimulationResult
from stewart_drake.loop.simulation import simulate
from stewart_drake.scenario.calibration import believed_delay
from stewart_drake.scenario.config import Scenario
from stewart_drake.scenario.loading import (
    load_comparison,
    load_compatible,
    read_scenario,
    setting_texts,
)
from stewart_drake.studies.jobs import run_jobs

ADAPTIVE: Final = "adaptive_lqi"
"""Added if the delay of the others is not the true one."""
CONTROLLERS: Final = ("lqr", "lqi", "delay_lqr", "delay_lqi", "predictor_lqi")
"""Shipped names, in the order of tables and legends: the paper's four, and ours."""
GRAVITY: Final = ("pd_gravity", "lqr_gravity")
"""Added if gravity acts: baselines that compensate gravity and ignore the delay."""
SERVOS: Final = ("servo_preview", "servo_feedforward")
"""Added if the machine has servos."""
LABELS: Final = {
    "lqr": "LQR, delay-blind",
    "lqi": "LQI, delay-blind",
    "delay_lqr": "LQR, delay-aware",
    "delay_lqi": "LQI, delay-aware",
    "predictor_lqi": "LQI, predictor",
    "adaptive_lqi": "LQI, delay found",
    "predictor_mpc": "LQI, limits by QP",
    "pd_gravity": "PD + gravity",
    "lqr_gravity": "LQR + gravity",
    "servo_preview": "servos",
    "servo_feedforward": "servos + torque",
}
PAPER_ERRORS: Final = {"lqr": None, "lqi": None, "delay_lqr": 225.0, "delay_lqi": 80.0}
"""E_ac in % s of the paper's Table II, None for a failure."""
PAPER_DELAY: Final = 0.8
"""s, of the experiment in that table."""

Progress = Callable[[str, float, float], None]
"""Called with a controller's name, its simulated time in s and its error in % of peak to peak."""

_Systems = Mapping[str, Callable[[], System]]
_NO_KEY: Final = re.compile(r"[^A-Za-z0-9_+-]")
_POLL: Final = 0.1
"""Interval of progress reports, s."""


def compare(
    scenario_name: Scenario | str | Path,
    settings: Iterable[str] = (),
    progress: Progress | None = None,
    *,
    controllers: _Systems | Sequence[str | Path | _Systems] | None = None,
    reference: OwnReference | None = None,
    disturbance: Callable[[], System] | None = None,
) -> dict[str, SimulationResult]:
    """Run every shipped controller on a scenario, and controllers of your own, on all cores.

    Ctrl-C ends the runs that have begun, with status `interrupted`, and leaves out the others. Give
    your own systems as functions that make one, such as their class. Runs go to worker processes; a
    run with a system that no other process can read, such as a class of a script or a notebook that
    derives from `LeafSystem`, is done in this process. An exception of a run is raised as it is,
    with a note that names the controller.

    Args:
        scenario_name: a Scenario, a shipped name or a path; its start, plant and tuner stay as they
            are.
        settings: as `load_scenario` takes them.
        progress: called for each running simulation, ten times a second, with the controller's
            name, simulated time in s and error in % of peak to peak.
        controllers: names or files, to compare these in this order; or a mapping of names to your
            own systems, with the ports listed at `simulate`, which are added to the shipped ones.
            A list with such a mapping has its systems and the named ones, and no other.
        reference, disturbance: for all runs, as of `simulate`.

    Returns:
        Results by controller, the shipped or given ones first, then your own. The name of a file
        is without its suffix.
    """
    settings = setting_texts(settings)
    chosen, makers = _chosen(controllers)
    scenarios = shown(scenario_name, settings, chosen)
    _check_makers(makers, reference, disturbance, taken={*LABELS, *scenarios})
    scenarios |= {name: load_compatible(scenario_name, settings=settings) for name in makers}
    shared = {"reference": reference, "disturbance": disturbance}
    with TemporaryDirectory() as folder, ThreadPoolExecutor(1) as thread:
        # A row with time and error for each run; a 1 in the last row stops all of them.
        path = Path(folder) / "board"
        board = np.memmap(path, np.float64, "w+", shape=(len(scenarios) + 1, 2))
        keys = [f"run{i}_{_NO_KEY.sub('_', name)[:99]}" for i, name in enumerate(scenarios)]
        jobs = {
            key: (name, one, shared | {"controller": makers.get(name)}, path, i)
            for i, (key, (name, one)) in enumerate(zip(keys, scenarios.items(), strict=True))
        }
        # Own controllers first: what runs in this process does so while workers do the others.
        jobs = dict(sorted(jobs.items(), key=lambda job: job[1][0] not in makers))
        # Ctrl-C reaches this thread only, which notifies the processes by the board.
        run: Callable[..., dict[str, SimulationResult | None]] = run_jobs
        runs = thread.submit(
            run, jobs, _run, folder, settings={}, suffix=".pickle", read=_unpickled
        )
        try:
            while not runs.done():
                try:
                    wait([runs], timeout=_POLL)
                    if progress is not None:
                        for name, (time, error) in zip(scenarios, board[:-1], strict=True):
                            if time > 0:
                                progress(name, time, error)
                except KeyboardInterrupt:
                    board[-1] = 1.0
        finally:
            board[-1] = 1.0
        results = {name: runs.result()[key] for name, key in zip(scenarios, keys, strict=True)}
    return {name: one for name, one in results.items() if one is not None}


def shown(
    scenario_name: Scenario | str | Path,
    settings: Iterable[str] = (),
    controllers: Sequence[str | Path] | None = None,
) -> dict[str, Scenario]:
    """Return scenarios by controller: the given ones, or the shipped and those of `compare`.

    The latter are SERVOS for servos given by their stiffness. For others ADAPTIVE is added if the
    delay is not the true one, or changes, and the scenario supports it; GRAVITY if gravity acts;
    SERVOS if the motors are servos.
    """
    settings = setting_texts(settings)
    if controllers is not None:
        return load_comparison(scenario_name, controllers, settings, further=False)
    motors = read_scenario(scenario_name, settings=settings).scenario.actuator.kind
    if motors == "position_servo":
        return load_comparison(scenario_name, SERVOS, settings)
    rows, further = load_comparison(scenario_name, CONTROLLERS, settings, False), list[str]()
    aware = rows["predictor_lqi"]
    known = aware.delay.constant and believed_delay(aware) == aware.true_delay
    at_once = aware.link.kind == "wire" and aware.sensor.delay == 0
    if not known and at_once and "offsets" not in aware.controller.estimate:
        further.append(ADAPTIVE)
    if aware.plant.gravity:
        further += GRAVITY
    if motors != "torque":
        further += SERVOS
    return load_comparison(scenario_name, (*CONTROLLERS, *further), settings)


def _chosen(controllers: Any) -> tuple[list[str | Path] | None, dict[str, Callable[[], System]]]:
    """Return chosen names and files, None for the shipped controllers, and the user's systems."""
    if controllers is None:
        return None, {}
    if isinstance(controllers, Mapping) and controllers:
        return None, dict(controllers)
    few = isinstance(controllers, str | Mapping) or not any(map(bool, controllers))
    wrong = [] if few else [one for one in controllers if not isinstance(one, str | Path | Mapping)]
    if few or wrong:
        raise ConfigError(
            f"controllers: got {brief(wrong[0] if wrong else controllers)}; expected a list of "
            "names, files, or mappings of names to systems, or one mapping"
        )
    makers = [pair for one in controllers if isinstance(one, Mapping) for pair in one.items()]
    return [one for one in controllers if not isinstance(one, Mapping)], dict(makers)


def label(name: str) -> str:
    return LABELS.get(name, name)


def _check_makers(
    controllers: Mapping[str, Any], reference: Any, disturbance: Any, taken: set[str]
) -> None:
    for name in controllers:
        if name in taken:
            raise ConfigError(
                f"controllers: got {name!r} for a system, the name of a shipped controller or of "
                "the scenario's; expected another name, and shipped ones by name in a list"
            )
    systems = {f"controllers[{name!r}]": maker for name, maker in controllers.items()}
    for what, maker in (systems | {"disturbance": disturbance}).items():
        if isinstance(maker, System):
            raise ConfigError(
                f"{what}: got an instance, which serves one run; expected a function that makes one"
            )
        if not (maker is None or callable(maker)):
            raise ConfigError(
                f"{what}: got {brief(maker)}; expected a function that makes a system, and shipped "
                "controllers by name in a list"
            )
    if isinstance(reference, Trajectory):
        try:
            pickle.dumps(reference)
        except (TypeError, pickle.PicklingError):
            raise ConfigError(
                f"reference: got a {type(reference).__name__}, which cannot be sent to other "
                "processes; expected a function that makes one"
            ) from None


def is_papers(scenario: Scenario, *, any_size: bool = False) -> bool:
    """Return whether a scenario has the paper's machine, motion, duration and delay.

    With `any_size` the motion may be a multiple of the paper's: E_ac is relative to it.
    """
    own, motion = Scenario(), scenario.reference
    if any_size and motion.kind == "sine" and own.reference.kind == "sine":
        shares = np.divide(motion.amplitude, own.reference.amplitude)
        if np.allclose(shares, shares[0], rtol=1e-6) and shares[0] > 0:
            motion = replace(motion, amplitude=own.reference.amplitude)
    engine = {name: getattr(own.plant, name) for name in ("kind", "time_step", "accuracy")}
    return (
        replace(scenario.plant, **engine) == own.plant
        and scenario.duration == own.duration
        and resolve("mechanism", scenario.mechanism) == resolve("mechanism", own.mechanism)
        and motion == own.reference
        and math.isclose(scenario.eta, PAPER_DELAY)
    )


def _run(name: str, scenario: Scenario, own: dict[str, Any], board: Path, run: int) -> bytes:
    """Return the pickled result: None if it was stopped before, or an error if it is refused."""
    rows = np.memmap(board, np.float64, "r+").reshape(-1, 2)

    def progress(time: float, error: float) -> None:
        rows[run] = time, error
        if rows[-1, 0]:
            raise KeyboardInterrupt

    try:
        stopped = rows[-1, 0]
        return pickle.dumps(None if stopped else simulate(scenario, progress=progress, **own))
    except ConfigError as error:
        return pickle.dumps(ConfigError(f"{name}: {error}"))


def _unpickled(path: Path) -> SimulationResult | None:
    # Written by our own workers into a temporary folder.
    result: SimulationResult | ConfigError | None = pickle.loads(path.read_bytes())
    if isinstance(result, ConfigError):
        raise result
    return result
