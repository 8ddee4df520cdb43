"""The shipped controllers on one scenario."""

import math
import signal
from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor, wait
from multiprocessing import resource_tracker
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Final

import joblib
import numpy as np
from numpy.typing import NDArray

from stewart_drake.config import Scenario
from stewart_drake.errors import ConfigError
from stewart_drake.resources import resolve
from stewart_drake.results import SimulationResult, write_json, write_signals
from stewart_drake.scenario_loading import load_scenario
from stewart_drake.simulation import simulate

CONTROLLERS: Final = ("lqr", "lqi", "delay_lqr", "delay_lqi", "predictor_lqi")
"""Shipped names, in the order of tables and legends: the paper's four, and ours."""
LABELS: Final = {
    "lqr": "LQR, delay-blind",
    "lqi": "LQI, delay-blind",
    "delay_lqr": "LQR, delay-aware",
    "delay_lqi": "LQI, delay-aware",
    "predictor_lqi": "LQI, predictor",
}
PAPER_ERRORS: Final = {"lqr": None, "lqi": None, "delay_lqr": 225.0, "delay_lqi": 80.0}
"""E_ac in % s that the paper reports in its Table II, None where it reports a failure."""
PAPER_DELAY: Final = 0.8
"""s, of the experiment in that table."""

Progress = Callable[[str, float, float], None]
"""Called with a controller's name, its simulated time in s and its error in % of peak to peak."""

_POLL = 0.1
"""s between two looks at the runs."""


def compare(
    scenario_name: str | Path, settings: Iterable[str] = (), progress: Progress | None = None
) -> dict[str, SimulationResult]:
    """Run every shipped controller on a scenario, on all cores.

    Ctrl-C ends the runs that have begun, with status `interrupted`, and leaves out the others.

    Args:
        scenario_name: a shipped name or a path; its start, plant and tuner stay as they are.
        settings: as `load_scenario` takes them.
        progress: called for each run that got on, ten times a second.

    Returns:
        Results by controller, in the order of CONTROLLERS.

    Raises:
        ConfigError: bad input, an unreachable reference.
    """
    settings = tuple(settings)
    scenarios = {name: load_scenario(scenario_name, name, settings) for name in CONTROLLERS}
    with TemporaryDirectory() as folder, ThreadPoolExecutor(1) as thread:
        board = _Board(Path(folder) / "board", len(scenarios), new=True)
        runs = thread.submit(_run_all, scenarios, board.path)
        try:
            while not runs.done():
                try:
                    wait([runs], timeout=_POLL)
                    if progress is not None:
                        for name, time, error in zip(scenarios, *board.news(), strict=True):
                            if time > 0:
                                progress(name, time, error)
                except KeyboardInterrupt:
                    board.stop()
        finally:
            board.stop()
        results = zip(scenarios, runs.result(), strict=True)
    return {name: result for name, result in results if result is not None}


def is_papers(scenario: Scenario) -> bool:
    """Whether the paper's numbers are about this scenario: its mechanism, motion and delay."""
    own, delay = Scenario(), scenario.delay
    eta = (delay.steps + delay.fraction) * scenario.controller.period
    return (
        resolve("mechanism", scenario.mechanism) == resolve("mechanism", own.mechanism)
        and scenario.reference == own.reference
        and math.isclose(eta, PAPER_DELAY)
    )


def save_comparison(results: dict[str, SimulationResult], directory: str | Path) -> None:
    """Write NAME.nc of every controller, then summary.json; each file whole or not.

    Raises:
        OSError: the directory cannot be written to.
    """
    folder = Path(directory)
    folder.mkdir(parents=True, exist_ok=True)
    for name, result in results.items():
        write_signals(folder / f"{name}.nc", result.signals)
    write_json(folder / "summary.json", comparison_summary(results))


def comparison_summary(results: dict[str, SimulationResult]) -> dict[str, Any]:
    """What `summary.json` of a comparison holds: each controller's summary by its name."""
    return {"controllers": {name: result.summary for name, result in results.items()}}


class _Board:
    """Where each run notes its time and error and reads whether to stop; processes share a file."""

    def __init__(self, path: Path, runs: int, new: bool = False) -> None:
        self.path = path
        shape = (runs + 1, 2)
        self._rows = np.memmap(path, np.float64, "w+" if new else "r+", shape=shape)

    @property
    def stopped(self) -> bool:
        return bool(self._rows[-1, 0])

    def stop(self) -> None:
        self._rows[-1, 0] = 1.0

    def note(self, run: int, time: float, error: float) -> None:
        self._rows[run] = time, error

    def news(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        return self._rows[:-1, 0], self._rows[:-1, 1]


def _run_all(scenarios: dict[str, Scenario], board: Path) -> list[SimulationResult | None]:
    # Ctrl-C is for the main thread, which tells the processes by the board: in the middle of an
    # import it would break them. They inherit the mask of this thread; the resource tracker comes
    # first, because some Pythons unblock the signal when they start it.
    resource_tracker.ensure_running()
    signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    number = min(joblib.cpu_count(), len(scenarios))
    jobs = (
        joblib.delayed(_run)(name, scenario, board, run, len(scenarios))
        for run, (name, scenario) in enumerate(scenarios.items())
    )
    return list(joblib.Parallel(n_jobs=number, backend="loky", batch_size=1)(jobs))


def _run(name: str, scenario: Scenario, path: Path, run: int, runs: int) -> SimulationResult | None:
    board = _Board(path, runs)

    def progress(time: float, error: float) -> None:
        board.note(run, time, error)
        if board.stopped:
            raise KeyboardInterrupt

    if board.stopped:
        return None
    try:
        return simulate(scenario, progress=progress)
    except ConfigError as error:
        raise ConfigError(f"{name}: {error}") from None
