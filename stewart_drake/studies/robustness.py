"""Monte Carlo study of a scenario: many runs, each with one drawn machine.

Drake is imported by the study, not by its options.
"""

import dataclasses
from pathlib import Path
from typing import TYPE_CHECKING, Any

from stewart_drake.files.fileio import remove_partials, write_whole
from stewart_drake.scenario.config import Scenario
from stewart_drake.studies.study_options import Ranges, RobustnessOptions

if TYPE_CHECKING:
    from stewart_drake.studies.jobs import Progress
    from stewart_drake.studies.robustness_result import RobustnessStudy


def study_robustness(
    scenario: Scenario,
    directory: str | Path,
    options: RobustnessOptions,
    progress: "Progress | None" = None,
) -> "RobustnessStudy":
    """Run a scenario undisturbed and then with drawn machines, or go on with an earlier study.

    Nothing is drawn where an undisturbed run, with this or another controller, does not complete.

    Args:
        scenario: to run; draws add to its own disturbances.
        directory: for runs.csv; the runs are kept in runs/. More runs may be asked for later.
        options: see `RobustnessOptions`. Names in `also` become names of folders.
        progress: as `run_jobs` takes it.

    Raises:
        As `run_jobs`, and ConfigError for a scenario that does not suit, and for an undisturbed run
            that does not complete.
    """
    from stewart_drake.loop.preparation import prepare
    from stewart_drake.scenario.loading import scenario_to_dict
    from stewart_drake.studies.jobs import run_jobs
    from stewart_drake.studies.robustness_result import RobustnessStudy, table
    from stewart_drake.studies.runs import read_outcome
    from stewart_drake.studies.uncertainty import draw, run_draw, scales_of, undisturbed_run

    ranges, seed, also = options.ranges or Ranges(), options.seed, dict(options.also or {})
    experiment, directory = prepare(scenario), Path(directory)
    settings: dict[str, Any] = {
        "scenario": scenario_to_dict(scenario),
        "ranges": dataclasses.asdict(ranges),
        "seed": seed,
    }
    common: dict[str, Any] = {
        "settings": settings,
        "workers": options.workers,
        "scheduler": options.scheduler,
        "read": read_outcome,
    }
    undisturbed = undisturbed_run(scenario, "", directory / "runs", common)
    alone = {
        name: undisturbed_run(other, name, directory / f"runs_{name}", common)
        for name, other in also.items()
    }
    scales = scales_of(experiment, undisturbed.peak_torque)
    draws = [draw(ranges, scales, scenario, seed, index) for index in range(options.runs)]
    jobs = {f"run{i:06d}": (scenario, one) for i, one in enumerate(draws)}
    outcomes = run_jobs(jobs, run_draw, directory / "runs", progress=progress, **common)
    others = {}
    for name, other in also.items():
        common["settings"] = settings | {"scenario": scenario_to_dict(other)}
        again = {key: (other, d) for key, (_, d) in jobs.items()}
        place = directory / f"runs_{name}"
        found = run_jobs(again, run_draw, place, progress=progress, **common)
        others[name] = (alone[name], list(found.values()))
    study = RobustnessStudy(
        experiment,
        ranges,
        scales,
        seed,
        options.limit,
        undisturbed,
        draws,
        list(outcomes.values()),
        others,
    )
    remove_partials(directory)
    write_whole(directory / "runs.csv", table(study))
    return study
