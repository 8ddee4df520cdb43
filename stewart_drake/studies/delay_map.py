"""What is achieved at other delays and amplitudes: a scenario simulated over a grid of both."""

import math
from dataclasses import replace
from functools import singledispatch
from tempfile import TemporaryDirectory
from typing import Final, NamedTuple

from stewart_drake.loop.experiment import assemble, reference_failure
from stewart_drake.scenario.config import Scenario
from stewart_drake.scenario.loading import scenario_to_dict
from stewart_drake.scenario.reference_config import ReferenceConfig, SineConfig, WaypointsConfig
from stewart_drake.scenario.reference_files import waypoints
from stewart_drake.studies.jobs import Progress, finished, run_jobs
from stewart_drake.studies.runs import read_outcome, run_scenario

FACTORS: Final = (0.5, 0.75, 1.0, 1.25)
"""Of the reference's amplitude."""


class Cell(NamedTuple):
    """One simulation of the map."""

    steps: int
    """Whole periods of delay."""
    factor: float
    """Of the reference's amplitude."""
    status: str
    """As of a simulation, or `out_of_reach` where the reference leaves the workspace, or
    `not_run` after Ctrl-C."""
    error: float
    """E_ac in % s, NaN where the run did not complete."""
    time: float
    """s, when it ended early, or the reference leaves the workspace; else NaN."""


def map_delays(steps: int) -> list[int]:
    """Delays to look at around a scenario's own."""
    return sorted({0, steps // 2, steps, 3 * steps // 2, 2 * steps}) if steps > 1 else [0, 1, 2, 4]


def scaled_motion(reference: ReferenceConfig, factor: float) -> ReferenceConfig | None:
    """The motion with its amplitude, or its way from the first waypoint, times `factor`.

    None where it has no amplitude to scale: a constant pose, or a file of samples.
    """
    return reference if factor == 1 else _scaled(reference, factor)


@singledispatch
def _scaled(reference: ReferenceConfig, factor: float) -> ReferenceConfig | None:
    return None


@_scaled.register
def _scaled_sine(reference: SineConfig, factor: float) -> SineConfig:
    return replace(reference, amplitude=[factor * a for a in reference.amplitude])


@_scaled.register
def _scaled_way(reference: WaypointsConfig, factor: float) -> WaypointsConfig:
    times, poses = waypoints(reference)
    way = poses[0] + factor * (poses - poses[0])
    return replace(reference, file=None, times=times.tolist(), poses=way.tolist())


def delay_map(scenario: Scenario, progress: Progress | None = None) -> tuple[list[Cell], bool]:
    """Simulate a scenario on the exact plant over delays and amplitudes, on all cores.

    Everything else stays as it is, what the controller believes of the delay included.

    Returns:
        Cells by delay, then factor, and whether Ctrl-C ended it early.
    """
    cells: dict[str, Cell] = {}
    jobs: dict[str, tuple[Scenario]] = {}
    for steps in map_delays(scenario.delay.steps):
        for factor in FACTORS:
            motion = scaled_motion(scenario.reference, factor)
            if motion is None:
                continue
            variant = replace(
                scenario,
                reference=motion,
                plant=scenario.plant.without_engine,
                delay=replace(scenario.delay, steps=steps),
            )
            key = f"mu{steps}-x{factor}"
            failure = reference_failure(assemble(variant))
            if failure is None:
                jobs[key] = (variant,)
                cells[key] = Cell(steps, factor, "not_run", math.nan, math.nan)
            else:
                cells[key] = Cell(steps, factor, "out_of_reach", math.nan, float(failure.time))
    interrupted = False
    with TemporaryDirectory() as folder:
        try:
            settings = scenario_to_dict(scenario)
            run_jobs(jobs, run_scenario, folder, settings=settings, progress=progress)
        except KeyboardInterrupt:
            interrupted = True
        for key, path in finished(jobs, folder).items():
            one = read_outcome(path)
            cells[key] = cells[key]._replace(status=one.status, error=one.error, time=one.time)
    return list(cells.values()), interrupted
