"""How a scenario bears what is not known of the machine: many runs, each with one drawn machine."""

import dataclasses
from pathlib import Path
from typing import Any

from stewart_drake.dynamics.workspace import diagnose
from stewart_drake.files.errors import ConfigError
from stewart_drake.files.fileio import remove_partials
from stewart_drake.loop.experiment import assemble, prepare, simulated_machine
from stewart_drake.mechanism.kinematics import UnreachablePoseError
from stewart_drake.scenario.config import Scenario
from stewart_drake.scenario.loading import scenario_to_dict
from stewart_drake.scenario.signals import POSE
from stewart_drake.studies.jobs import Progress, run_jobs, write_atomically
from stewart_drake.studies.ranges import Ranges
from stewart_drake.studies.robustness_result import RobustnessStudy, table
from stewart_drake.studies.runs import (
    Outcome,
    outcome_of,
    read_outcome,
    run_file,
    run_to_its_end,
)
from stewart_drake.studies.uncertainty import MACHINE, Draw, draw, drawn, scales_of


def study_robustness(
    scenario: Scenario,
    directory: str | Path,
    *,
    ranges: Ranges | None = None,
    runs: int = 200,
    seed: int = 0,
    limit: float | None = None,
    workers: int | None = None,
    scheduler: str | None = None,
    progress: Progress | None = None,
) -> RobustnessStudy:
    """Run a scenario undisturbed and then with so many drawn machines, or go on with it.

    Args:
        scenario: what is to be borne; draws add to what it says already.
        directory: for runs.csv; the runs are kept in runs/. More runs may be asked for later.
        ranges: of what is drawn, the defaults if None.
        runs: number of draws.
        seed: of all draws.
        limit: E_ac in % s above which a completed run counts as failed, or None.
        workers, scheduler, progress: as `run_jobs` takes them.

    Raises:
        As `run_jobs`, and ConfigError for a scenario or numbers that do not suit.
    """
    if runs < 1:
        raise ConfigError(f"--runs: got {runs}; expected 1 or more")
    if limit is not None and not limit > 0:
        raise ConfigError(f"--limit: got {limit:g}; expected a positive E_ac in % s")
    ranges = Ranges() if ranges is None else ranges
    experiment, directory = prepare(scenario), Path(directory)
    common: dict[str, Any] = {
        "settings": {
            "scenario": scenario_to_dict(scenario),
            "ranges": dataclasses.asdict(ranges),
            "seed": seed,
        },
        "workers": workers,
        "scheduler": scheduler,
        "read": read_outcome,
    }
    first: dict[str, tuple[Scenario, Draw]] = {"undisturbed": (scenario, {})}
    undisturbed = run_jobs(first, run_draw, directory / "runs", **common)["undisturbed"]
    scales = scales_of(experiment, undisturbed.peak_torque)
    draws = [draw(ranges, scales, scenario, seed, index) for index in range(runs)]
    jobs = {f"run{i:06d}": (scenario, one) for i, one in enumerate(draws)}
    outcomes = run_jobs(jobs, run_draw, directory / "runs", progress=progress, **common)
    study = RobustnessStudy(
        experiment, ranges, scales, seed, limit, undisturbed, draws, list(outcomes.values())
    )
    remove_partials(directory)
    write_atomically(directory / "runs.csv", table(study).encode())
    return study


def run_draw(scenario: Scenario, one: Draw) -> bytes:
    """The file of one run of a scenario with what was drawn."""
    return run_file(_run(scenario, one), one)


def _run(scenario: Scenario, one: Draw) -> Outcome:
    try:
        changed = drawn(MACHINE, scenario, simulated_machine(scenario), one)
        variant = changed.as_scenario()
    except ConfigError as error:
        return Outcome("refused", str(error), time=0.0)
    try:
        truth = changed.machine()
    except (ConfigError, UnreachablePoseError) as error:
        return Outcome("not_assembled", str(error), time=0.0)
    try:
        outside = diagnose(truth, 0.0, assemble(variant, truth).start[POSE])
        if outside is not None:
            return Outcome("left_workspace", outside.reason, outside.leg, 0.0)
        return outcome_of(run_to_its_end(variant, truth))
    except ConfigError as error:
        return Outcome("refused", str(error), time=0.0)
