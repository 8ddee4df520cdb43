"""Search for the best play-out bound of a network, and for the losses that it survives.

A longer bound makes packets late less often and every torque later: what is computed from a
measurement acts bound + repetitions later, also if its packet was quicker. The scenario is
simulated over bounds, first in whole periods, then in half periods near the best, and at the best
of them over losses, with several seeds each. The seeds of the losses are new: the best bound was
chosen by the others, which are therefore too good there.
"""

import math
from collections.abc import Iterable
from dataclasses import dataclass, replace
from tempfile import TemporaryDirectory
from typing import Any, Final, NamedTuple

import numpy as np

from stewart_drake.scenario.config import NetworkConfig, Scenario
from stewart_drake.scenario.loading import scenario_to_dict
from stewart_drake.scenario.packets import in_time, times_under_way, torque_missing
from stewart_drake.studies.jobs import Progress, finished, run_jobs
from stewart_drake.studies.runs import read_outcome, run_scenario
from stewart_drake.studies.statistics import least_share

LOSSES: Final = (0.0, 0.02, 0.05, 0.1, 0.2, 0.3, 0.4)
"""Shares of the packets that are tried, in addition to the scenario's own."""
_FEW: Final = 0.4
_NEARLY_ALL: Final = 0.999
"""Shares of the packets that are there by the shortest and by the longest bound looked at."""
_MOST: Final = 12
"""Bounds."""


class Cell(NamedTuple):
    """Simulations with one bound and loss."""

    bound: float
    """s."""
    loss: float
    late: float
    """Probability that a packet which is not lost is not there by the bound."""
    missing: float
    """Probability that a torque is in no packet that is there in time, but for plans."""
    runs: int
    """That were simulated."""
    errors: tuple[float, ...]
    """E_ac in % s of those that completed."""

    @property
    def completed(self) -> float:
        """Share of the runs; NaN for none."""
        return len(self.errors) / self.runs if self.runs else math.nan

    @property
    def no_worse(self) -> float:
        """Share of all runs that at least completes, with 95 % confidence; NaN for none simulated.

        Where all that were simulated completed, with at most the largest of their errors.
        """
        return least_share(len(self.errors), self.runs) if self.runs else math.nan

    @property
    def expected(self) -> float:
        """Mean E_ac in % s of the completed runs, infinite where one was lost."""
        return float(np.mean(self.errors)) if self.errors and self.completed == 1 else math.inf


@dataclass(frozen=True)
class LinkStudy:
    """Result of the study.

    Attributes:
        scenario: with the network.
        runs: seeds per bound and loss.
        bounds: over the bound, the shortest first, at the scenario's loss.
        losses: over the loss, at the best bound, with new seeds.
        usual: bound that a scenario with `playout: null` takes, s.
        left_out: bounds in s that the multibody plant of the scenario cannot have.
        interrupted: whether Ctrl-C ended it early.
    """

    scenario: Scenario
    runs: int
    bounds: tuple[Cell, ...]
    losses: tuple[Cell, ...]
    usual: float
    left_out: tuple[float, ...]
    interrupted: bool

    @property
    def best(self) -> Cell | None:
        """Cell of the least mean E_ac among those with the most completed runs, or None."""
        return best_of(self.bounds)

    @property
    def checked(self) -> Cell | None:
        """The best bound at the scenario's loss with new seeds, or None."""
        link = self.scenario.link
        assert link.kind == "network"
        return next((cell for cell in self.losses if cell.loss == link.loss), None)

    @property
    def survivable(self) -> float:
        """Largest loss up to which every run completed; NaN for none."""
        survived = math.nan
        for cell in self.losses:
            if cell.completed != 1:
                break
            survived = cell.loss
        return survived

    @property
    def summary(self) -> dict[str, Any]:
        best = self.best

        def told(cells: Iterable[Cell]) -> list[dict[str, Any]]:
            return [
                c._asdict()
                | {"completed": c.completed, "expected": c.expected, "no_worse": c.no_worse}
                for c in cells
            ]

        return {
            "best_bound": None if best is None else best.bound,
            "usual_bound": self.usual,
            "survivable_loss": self.survivable,
            "runs": self.runs,
            "bounds": told(self.bounds),
            "losses": told(self.losses),
            "left_out": self.left_out,
            "interrupted": self.interrupted,
        }


def possible(scenario: Scenario, link: NetworkConfig, bound: float) -> bool:
    """Return whether the scenario's own plant can have a bound in s."""
    other = replace(scenario, link=replace(link, playout=bound))
    return scenario.plant.kind != "multibody" or not other.step_problem(scenario.plant.time_step)


def bounds_for(link: NetworkConfig, period: float) -> list[float]:
    """Whole periods, s, from where few packets are there in time to where nearly all are."""
    times = times_under_way(link)
    first, last = (math.ceil(times.ppf(share) / period - 1e-9) for share in (_FEW, _NEARLY_ALL))
    steps = np.unique(np.linspace(first, last + 1, min(last + 2 - first, _MOST)).round())
    return [float(period * step) for step in steps]


def best_of(cells: Iterable[Cell]) -> Cell | None:
    done = [cell for cell in cells if cell.errors]
    return min(done, key=lambda c: (-c.completed, np.mean(c.errors)), default=None)


def simulated(
    base: Scenario, wanted: list[tuple[float, float]], runs: int, progress: Progress
) -> tuple[list[Cell], bool]:
    """Return a cell for each bound and loss, and whether Ctrl-C ended it early."""
    link, c = base.link, base.controller
    assert link.kind == "network"
    jobs = {
        f"bound{bound:g}-loss{loss:g}-seed{seed}": (
            replace(
                base,
                link=replace(link, playout=bound, loss=loss, seed=link.seed + seed),
                sensor=replace(base.sensor, seed=base.sensor.seed + seed),
            ),
        )
        for bound, loss in wanted
        for seed in range(runs)
    }
    stopped = False
    with TemporaryDirectory() as folder:
        try:
            settings = scenario_to_dict(base)
            run_jobs(jobs, run_scenario, folder, settings=settings, progress=progress)
        except KeyboardInterrupt:
            stopped = True
        results = {key: read_outcome(path) for key, path in finished(jobs, folder).items()}
    cells = []
    for bound, loss in wanted:
        keys = [f"bound{bound:g}-loss{loss:g}-seed{seed}" for seed in range(runs)]
        there = [results[key] for key in keys if key in results]
        errors = tuple(one.error for one in there if one.status == "completed")
        late = 1 - float(in_time(link, bound))
        missing = torque_missing(replace(link, loss=loss), bound, c.packet_repeats, c.period)
        cells.append(Cell(bound, loss, late, missing, len(there), errors))
    return cells, stopped
