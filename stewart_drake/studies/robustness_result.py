"""Results of a Monte Carlo study of a scenario: shares, quantiles, and influences."""

import csv
import dataclasses
import io
import math
import re
from collections import Counter
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from stewart_drake.files.versions import versions
from stewart_drake.loop.preparation import Experiment
from stewart_drake.scenario.loading import scenario_to_dict
from stewart_drake.studies.runs import Outcome, loops_of
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
from stewart_drake.studies.study_options import Ranges
from stewart_drake.studies.uncertainty import MACHINE, Draw, Scales
from stewart_drake.types import Array

QUANTILES: Final = (0.5, 0.75, 0.9, 0.95, 0.99)
SIGNED: Final = tuple(name for name, one in MACHINE.items() if one.signed)
"""These are ranked by their size too, as |payload| and |delay|."""


class Influence(NamedTuple):
    """Correlation of a quantity with the outcome. Adjusted p-values are Holm's, over all asked."""

    factor: str
    unit: str
    error: Correlation
    """With E_ac among the runs that completed."""
    error_p: float
    """Adjusted."""
    failure: Correlation
    """With failing (1 or 0) among all runs."""
    failure_p: float
    """Adjusted."""


class RobustnessStudy(NamedTuple):
    """A Monte Carlo study; the i-th draw belongs to the i-th outcome."""

    experiment: Experiment
    ranges: Ranges
    scales: Scales
    seed: int
    limit: float | None
    """E_ac in % s above which a run counts as failed although it completed, or None."""
    undisturbed: Outcome
    draws: list[Draw]
    outcomes: list[Outcome]
    beside: dict[str, tuple[Outcome, list[Outcome]]] = {}
    """By name of another controller: undisturbed, and on the same draws."""

    @property
    def files(self) -> list[str]:
        """Names of the files and folders of the study."""
        return ["runs.csv", "runs/"]

    @property
    def others(self) -> "dict[str, RobustnessStudy]":
        """The study as it would be with each of the other controllers."""
        return {
            name: self._replace(undisturbed=undisturbed, outcomes=outcomes, beside={})
            for name, (undisturbed, outcomes) in self.beside.items()
        }

    @property
    def failed(self) -> NDArray[np.bool_]:
        """(n,) whether a run left the workspace, or ended above the limit."""
        return np.array([self.reason_of(one) != "" for one in self.outcomes], dtype=bool)

    @property
    def errors(self) -> Array:
        """(n,) E_ac in % s, NaN where a run did not complete."""
        return np.array([one.error for one in self.outcomes])

    @property
    def success(self) -> Interval:
        """Share of runs that did not fail."""
        return wilson_interval(int(np.sum(~self.failed)), len(self.outcomes))

    def reason_of(self, outcome: Outcome) -> str:
        """Why a run counts as failed, without the number of the leg, or nothing."""
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
        """Number of runs by what ran them, see `loop.bulk.Ending`."""
        return loops_of(self.outcomes)

    def quantile(self, probability: float) -> Interval:
        """Return a quantile of E_ac over all runs, % s; an incomplete run counts as infinite."""
        return quantile_interval(np.where(np.isnan(self.errors), np.inf, self.errors), probability)

    def influences(self) -> list[Influence]:
        """One per factor and per size of a signed one, what matters most first."""
        values, done = factor_values(self.draws), ~np.isnan(self.errors)
        error = {name: rank_correlation(x[done], self.errors[done]) for name, x in values.items()}
        failure = {name: rank_correlation(x, self.failed) for name, x in values.items()}
        error_p = holm([one.p_value for one in error.values()])
        failure_p = holm([one.p_value for one in failure.values()])
        found = [
            Influence(name, unit_of(name), error[name], p, failure[name], q)
            for name, p, q in zip(values, error_p, failure_p, strict=True)
        ]
        return sorted(found, key=lambda one: -_strength(one))

    def _of_all(self) -> dict[str, Any]:
        """Return the part of the summary that another controller has too."""
        return {
            "success": {"runs": int(np.sum(~self.failed)), **self.success._asdict()},
            "failures": self.reasons,
            "E_ac_of_all": {str(q): self.quantile(q)._asdict() for q in QUANTILES},
            "undisturbed": dataclasses.asdict(self.undisturbed),
        }

    @property
    def explanation(self) -> Explanation:
        """How the failing runs differ from the others."""
        return explain(factor_values(self.draws), self.failed)

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
            **self._of_all(),
            "limit": self.limit,
            "completed": int(done.sum()),
            "failures_by_leg": {str(leg): by_leg[leg] for leg in sorted(by_leg)},
            "E_ac_of_completed": of_completed,
            "influences": [_influence_summary(one) for one in self.influences()],
            "explanation": self.explanation.summary,
            "loops": self.loops,
            "beside": {name: one._of_all() for name, one in self.others.items()},
            "ranges": dataclasses.asdict(self.ranges),
            "scales": self.scales._asdict(),
            "scenario": scenario_to_dict(self.experiment.scenario),
            "versions": versions(),
        }


def unit_of(factor: str) -> str:
    """Unit of a factor, or of its size."""
    return MACHINE[factor.strip("|")].unit


def factors(draws: list[Draw]) -> dict[str, str]:
    """Return the ranked quantities with their units; several numbers count by their rms."""
    return {
        name: one.unit
        for name, one in MACHINE.items()
        if one.unit
        and (not one.optional or any(name in d and one.told(d[name]) != 0 for d in draws))
    }


def factor_values(draws: list[Draw]) -> dict[str, Array]:
    """(n,) of each factor in its unit, and of the sizes of those with a sign."""
    arrays = {
        name: np.array([MACHINE[name].told(one[name]) for one in draws], dtype=np.float64)
        for name in factors(draws)
    }
    return arrays | {f"|{name}|": np.abs(arrays[name]) for name in SIGNED}


def table(study: RobustnessStudy) -> str:
    """Return all runs as CSV, a row each; a missing number is empty."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    told = factors(study.draws)
    head = [f"{name} [{unit}]" for name, unit in told.items()]
    writer.writerow(
        ["run", "status", "reason", "leg", "time [s]", "E_ac [% s]", "peak_torque [N m]", *head]
    )
    values = factor_values(study.draws)
    for i, one in enumerate(study.outcomes):
        numbers = [one.time, one.error, one.peak_torque, *(values[name][i] for name in told)]
        cells = [repr(float(v)) if math.isfinite(v) else "" for v in numbers]
        writer.writerow([i, one.status, study.reason_of(one), one.leg or "", *cells])
    return text.getvalue()


def _strength(one: Influence) -> float:
    """The larger of the two |rho|; -1 for what never changed."""
    return max(-1.0 if math.isnan(c.rho) else abs(c.rho) for c in (one.error, one.failure))


def _influence_summary(one: Influence) -> dict[str, Any]:
    return {
        "factor": one.factor,
        "unit": one.unit,
        "error": one.error._asdict() | {"adjusted_p": one.error_p},
        "failure": one.failure._asdict() | {"adjusted_p": one.failure_p},
    }
