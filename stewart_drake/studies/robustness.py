"""Monte Carlo study of a scenario: many runs, each with one drawn machine."""

import dataclasses
import math
import re
from collections import Counter
from pathlib import Path
from typing import Any, Final, NamedTuple

import numpy as np

from stewart_drake.files.errors import ConfigError
from stewart_drake.files.fileio import remove_partials, write_whole
from stewart_drake.files.versions import versions
from stewart_drake.loop.preparation import Experiment, prepare
from stewart_drake.scenario.config import Scenario
from stewart_drake.scenario.loading import scenario_to_dict
from stewart_drake.studies.jobs import Progress, run_jobs
from stewart_drake.studies.runs import Outcome, read_outcome
from stewart_drake.studies.statistics import (
    Correlation,
    Explanation,
    Interval,
    explain,
    holm,
    quantile_interval,
    rank_correlation,
    wilson_interval,
)
from stewart_drake.studies.study_options import Ranges, RobustnessOptions
from stewart_drake.studies.uncertainty import MACHINE, Draw, Scales, draw, run_draw, scales_of
from stewart_drake.types import Array, Flags

QUANTILES: Final = (0.5, 0.75, 0.9, 0.95, 0.99)


class Influence(NamedTuple):
    factor: str  # of the quantity
    error: Correlation  # with E_ac among the runs that completed
    error_p: float  # its p-value, adjusted by Holm over all quantities
    failure: Correlation  # with failing (1 or 0) among all runs
    failure_p: float  # its p-value, adjusted

    @property
    def strength(self) -> float:
        """The larger of the two |rho|; -1 for a quantity that never changed."""
        return max(-1.0 if math.isnan(c.rho) else abs(c.rho) for c in (self.error, self.failure))

    @property
    def summary(self) -> dict[str, Any]:
        return {
            "factor": self.factor,
            "unit": unit_of(self.factor),
            "error": self.error._asdict() | {"adjusted_p": self.error_p},
            "failure": self.failure._asdict() | {"adjusted_p": self.failure_p},
        }


class RobustnessStudy(NamedTuple):
    """Monte Carlo study; the i-th draw belongs to the i-th outcome."""

    experiment: Experiment
    ranges: Ranges  # of the draws
    scales: Scales  # of the draws
    seed: int  # of the draws
    limit: float | None  # E_ac in % s above which a completed run counts as failed, or None
    undisturbed: Outcome  # outcome of the scenario itself
    draws: list[Draw]  # of the machines
    outcomes: list[Outcome]  # of the machines
    # the same draws with other controllers, by name
    also: "dict[str, RobustnessStudy]" = {}

    @property
    def files(self) -> list[str]:
        return ["runs.csv", "runs/"]

    @property
    def failed(self) -> Flags:
        """(n,) whether a run left the workspace, or ended above the limit."""
        return np.array([self.reason_of(one) != "" for one in self.outcomes], dtype=bool)

    @property
    def errors(self) -> Array:
        """(n,) E_ac in % s, NaN for a run that did not complete."""
        return np.array([one.error for one in self.outcomes])

    @property
    def success(self) -> Interval:
        return wilson_interval(int(np.sum(~self.failed)), len(self.outcomes))

    def reason_of(self, outcome: Outcome) -> str:
        """Return why a run counts as failed, without the number of the leg, or an empty text."""
        if outcome.status != "completed":
            return re.sub(r"\bleg \d\b", "a leg", outcome.reason)
        if self.limit is not None and not outcome.error <= self.limit:
            return f"completed with E_ac above {self.limit:g} % s"
        return ""

    @property
    def reasons(self) -> dict[str, int]:
        """Number of failures by reason, the most frequent first."""
        counts = Counter(self.reason_of(one) for one in self.outcomes)
        return {reason: n for reason, n in counts.most_common() if reason}

    @property
    def loops(self) -> dict[str, int]:
        """Number of runs by what ran them, the most frequent first, see `loop.bulk.Ending`."""
        return dict(Counter(one.loop for one in self.outcomes if one.loop).most_common())

    def quantile(self, probability: float) -> Interval:
        """Return a quantile of E_ac over all runs, % s; an incomplete run counts as infinite."""
        return quantile_interval(np.where(np.isnan(self.errors), np.inf, self.errors), probability)

    def influences(self) -> list[Influence]:
        """Return one per factor and per size of a signed one, the strongest first."""
        values, done = factor_values(self.draws), ~np.isnan(self.errors)
        error = {name: rank_correlation(x[done], self.errors[done]) for name, x in values.items()}
        failure = {name: rank_correlation(x, self.failed) for name, x in values.items()}
        error_p = holm([one.p_value for one in error.values()])
        failure_p = holm([one.p_value for one in failure.values()])
        found = [
            Influence(name, error[name], p, failure[name], q)
            for name, p, q in zip(values, error_p, failure_p, strict=True)
        ]
        return sorted(found, key=lambda one: -one.strength)

    @property
    def explanation(self) -> Explanation:
        return explain(factor_values(self.draws), self.failed)

    @property
    def _common_summary(self) -> dict[str, Any]:
        """The part of the summary that other controllers have too."""
        return {
            "success": {"runs": int(np.sum(~self.failed)), **self.success._asdict()},
            "failures": self.reasons,
            "E_ac_of_all": {str(q): self.quantile(q)._asdict() for q in QUANTILES},
            "undisturbed": dataclasses.asdict(self.undisturbed),
        }

    @property
    def summary(self) -> dict[str, Any]:
        """Content of `summary.json`; E_ac in % s, infinite quantiles (failed runs) as null."""
        done, of_completed = np.isfinite(self.errors), None
        if done.any():
            of_completed = {
                str(q): quantile_interval(self.errors[done], q)._asdict() for q in QUANTILES
            }
        by_leg = Counter(one.leg for one in self.outcomes if one.leg is not None)
        return {
            "runs": len(self.outcomes),
            "seed": self.seed,
            **self._common_summary,
            "limit": self.limit,
            "completed": int(done.sum()),
            "failures_by_leg": {str(leg): by_leg[leg] for leg in sorted(by_leg)},
            "E_ac_of_completed": of_completed,
            "influences": [one.summary for one in self.influences()],
            "explanation": self.explanation.summary,
            "loops": self.loops,
            "beside": {name: one._common_summary for name, one in self.also.items()},
            "ranges": dataclasses.asdict(self.ranges),
            "scales": self.scales._asdict(),
            "scenario": scenario_to_dict(self.experiment.scenario),
            "versions": versions(),
        }


def study_robustness(
    scenario: Scenario,
    directory: str | Path,
    options: RobustnessOptions,
    progress: Progress | None = None,
) -> RobustnessStudy:
    """Run a scenario undisturbed and then with drawn machines, or continue an earlier study.

    Draws add to the scenario's own disturbances. The directory gets runs.csv and the folder runs/;
    a later call may ask for more runs. Names in `also` become names of folders. An undisturbed run
    that does not complete is an error, also with another controller.
    """
    ranges, seed = options.sizes, options.seed
    experiment, directory = prepare(scenario), Path(directory)
    drawn_with = {"ranges": dataclasses.asdict(ranges), "seed": seed}

    def run(
        name: str, scenario: Scenario, draws: dict[str, Draw], progress: Progress | None = None
    ) -> list[Outcome]:
        found = run_jobs(
            {key: (scenario, one) for key, one in draws.items()},
            run_draw,
            directory / (f"runs_{name}" if name else "runs"),
            settings={"scenario": scenario_to_dict(scenario), **drawn_with},
            read=read_outcome,
            progress=progress,
            **options.jobs,
        )
        return list(found.values())

    controllers = {"": scenario, **(options.also or {})}
    undisturbed = {}
    for name, one in controllers.items():
        (undisturbed[name],) = run(name, one, {"undisturbed": {}})
        if (first := undisturbed[name]).status != "completed":
            raise ConfigError(
                f"robustness{f' with {name}' if name else ''}: the undisturbed run fails at "
                f"{first.time:.2f} s ({first.reason}), so no machine was drawn; expected a "
                "scenario and a controller that complete undisturbed"
            )
    scales = scales_of(experiment, undisturbed[""].peak_torque)
    draws = [draw(ranges, scales, scenario, seed, index) for index in range(options.runs)]
    named = {f"run{i:06d}": one for i, one in enumerate(draws)}
    studies = {
        name: RobustnessStudy(
            experiment,
            ranges,
            scales,
            seed,
            options.limit,
            undisturbed[name],
            draws,
            run(name, one, named, progress),
        )
        for name, one in controllers.items()
    }
    study = studies.pop("")._replace(also=studies)
    remove_partials(directory)
    write_whole(directory / "runs.csv", table(study))
    return study


def unit_of(factor: str) -> str:
    """Return the unit of a factor, or of its size."""
    return MACHINE[factor.strip("|")].unit


def factors(draws: list[Draw]) -> dict[str, str]:
    """Return the ranked quantities with their units; of several numbers the rms counts."""
    return {
        name: one.unit
        for name, one in MACHINE.items()
        if one.unit
        and (not one.optional or any(name in d and one.in_unit(d[name]) != 0 for d in draws))
    }


def factor_values(draws: list[Draw]) -> dict[str, Array]:
    """Return (n,) of each factor in its unit, and of the sizes of those with a sign, as |delay|."""
    arrays = {
        name: np.array([MACHINE[name].in_unit(one[name]) for one in draws], dtype=np.float64)
        for name in factors(draws)
    }
    return arrays | {f"|{name}|": np.abs(x) for name, x in arrays.items() if MACHINE[name].signed}


def table(study: RobustnessStudy) -> str:
    """Return all runs as CSV, a row each; a missing number is empty."""
    import pandas

    outcomes, values = study.outcomes, factor_values(study.draws)
    columns: dict[str, Any] = {
        "run": range(len(outcomes)),
        "status": [one.status for one in outcomes],
        "reason": [study.reason_of(one) for one in outcomes],
        "leg": [one.leg or "" for one in outcomes],
        "time [s]": [one.time for one in outcomes],
        "E_ac [% s]": study.errors,
        "peak_torque [N m]": [one.peak_torque for one in outcomes],
    }
    columns |= {f"{name} [{unit}]": values[name] for name, unit in factors(study.draws).items()}
    frame = pandas.DataFrame(columns).replace([np.inf, -np.inf], np.nan)
    return str(frame.to_csv(index=False, lineterminator="\n"))
