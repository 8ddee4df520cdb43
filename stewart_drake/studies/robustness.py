"""How a scenario bears what is not known of the machine: many runs, each with one drawn machine."""

import dataclasses
import json
import math
from pathlib import Path
from typing import Any

from stewart_drake.dynamics.workspace import diagnose
from stewart_drake.files.errors import ConfigError
from stewart_drake.files.fileio import remove_partials
from stewart_drake.files.jsonio import jsonable
from stewart_drake.loop.experiment import assemble, prepare
from stewart_drake.loop.simulation import simulate
from stewart_drake.mechanism.files import load_mechanism
from stewart_drake.mechanism.kinematics import UnreachablePoseError
from stewart_drake.scenario.config import Scenario
from stewart_drake.scenario.loading import scenario_to_dict
from stewart_drake.scenario.signals import POSE
from stewart_drake.studies.jobs import Progress, run_jobs, write_atomically
from stewart_drake.studies.robustness_result import Outcome, RobustnessStudy, table
from stewart_drake.studies.run_files import read_outcome
from stewart_drake.studies.uncertainty import (
    UNDISTURBED,
    Draw,
    Ranges,
    disturbed,
    draw,
    scales_of,
    true_mechanism,
)


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
    experiment = prepare(scenario)
    directory = Path(directory)
    common: dict[str, Any] = {
        "settings": {
            "scenario": scenario_to_dict(scenario),
            "ranges": dataclasses.asdict(ranges),
            "seed": seed,
        },
        "workers": workers,
        "scheduler": scheduler,
        "check": read_outcome,
    }
    first = {"undisturbed": (scenario, (0.0,) * 6, UNDISTURBED)}
    undisturbed = read_outcome(
        run_jobs(first, run_draw, directory / "runs", **common)["undisturbed"]
    )
    scales = scales_of(experiment, undisturbed.peak_torque)
    draws = [draw(ranges, scales, scenario, seed, index) for index in range(runs)]
    jobs = {f"run{i:06d}": (scenario, scales.motion, one) for i, one in enumerate(draws)}
    files = run_jobs(jobs, run_draw, directory / "runs", progress=progress, **common)
    outcomes = [read_outcome(path) for path in files.values()]
    study = RobustnessStudy(experiment, ranges, scales, seed, limit, undisturbed, draws, outcomes)
    remove_partials(directory)
    write_atomically(directory / "runs.csv", table(study).encode())
    return study


def run_draw(scenario: Scenario, motion: tuple[float, ...], one: Draw) -> bytes:
    """One run: its draw and how it ended, as JSON.

    Args:
        scenario: undisturbed.
        motion: (6,) as in `Scales`.
        one: what to change.
    """
    outcome = _run(scenario, motion, one)
    return json.dumps(jsonable({"draw": one._asdict(), "outcome": outcome._asdict()})).encode()


def _run(scenario: Scenario, motion: tuple[float, ...], one: Draw) -> Outcome:
    try:
        mechanism = load_mechanism(scenario.mechanism)
        truth = true_mechanism(mechanism, scenario.plant.payload_mass, one)
    except (ConfigError, UnreachablePoseError) as error:
        return Outcome("not_assembled", str(error), None, 0.0, math.nan, math.nan)
    try:
        variant = disturbed(scenario, motion, one)
        start = assemble(variant, truth).start
        outside = diagnose(truth, 0.0, start[POSE])
        if outside is not None:
            return Outcome("left_workspace", outside.reason, outside.leg, 0.0, math.nan, math.nan)
        result = simulate(variant, truth=truth, margin=False)
    except ConfigError as error:
        return Outcome("refused", str(error), None, 0.0, math.nan, math.nan)
    if result.status == "interrupted":
        raise KeyboardInterrupt
    torque, stopped = float(result.summary["peak_torque"]), result.stopped
    if stopped is None:
        return Outcome(result.status, "", None, math.nan, result.accumulated_error, torque)
    return Outcome(result.status, stopped.reason, stopped.leg, stopped.time, math.nan, torque)
