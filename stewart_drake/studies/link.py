"""Search for the best play-out bound of a network, and for the losses that it survives.

With a longer bound fewer packets are late, but every torque acts later: the bound and a period per
repetition after its measurement, also if its packet was quicker. A bound at which most packets are
late is never the best: the model of the simulation is exact, so that plans replace torques there
without an error, as they do on no machine.

The scenario is simulated with several seeds for each bound: first for whole periods, then for half
periods near the best. Then it is simulated at the best bound for each loss, with new seeds: those
that chose the best bound are biased there.
"""

import math
import warnings
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final, NamedTuple

import numpy as np
from scipy import stats

from stewart_drake.scenario.config import Scenario
from stewart_drake.scenario.link_config import NetworkConfig
from stewart_drake.scenario.loading import scenario_to_dict
from stewart_drake.scenario.packets import default_bound, in_time, times_under_way, torque_missing
from stewart_drake.studies.jobs import Progress, part_of
from stewart_drake.studies.runs import run_scenarios
from stewart_drake.studies.statistics import CONFIDENCE, least_share
from stewart_drake.studies.study_options import LinkOptions

LOSSES: Final = (0.0, 0.02, 0.05, 0.1, 0.2, 0.3, 0.4)
"""Shares of lost packets that are tried, in addition to the scenario's own."""
_SHORTEST_ARRIVED: Final = 0.4
_LONGEST_ARRIVED: Final = 0.999
"""Shares of the packets that arrive within the shortest and the longest bound tried."""
_MAX_BOUNDS: Final = 12
"""Largest number of whole-period bounds tried."""
MOST_LATE: Final = 0.5
"""Largest share of late packets of a usable bound."""
NEGLIGIBLE: Final = 0.01
"""Relative difference of E_ac that does not matter."""


class Cell(NamedTuple):
    bound: float  # s
    loss: float  # share of lost packets
    late: float  # probability that a packet which is not lost arrives after the bound
    missing: float  # probability that no packet brings a torque in time, plans not counted
    runs: int  # number of simulations
    errors: tuple[float, ...]  # E_ac in % s of the completed ones

    @property
    def completed(self) -> float:
        """Share of the runs that completed; NaN without runs."""
        return len(self.errors) / self.runs if self.runs else math.nan

    @property
    def no_worse(self) -> float:
        """Least share of all runs that complete, with 95 % confidence; NaN without simulations.

        If all simulations completed, this share also has at most the largest of their errors.
        """
        return least_share(len(self.errors), self.runs) if self.runs else math.nan

    @property
    def mean(self) -> float:
        """Mean E_ac in % s of the completed runs, NaN without one."""
        return float(np.mean(self.errors)) if self.errors else math.nan

    @property
    def expected(self) -> float:
        """The same, infinite if a run was lost."""
        return self.mean if self.completed == 1 else math.inf

    @property
    def summary(self) -> dict[str, Any]:
        derived = {name: getattr(self, name) for name in ("completed", "expected", "no_worse")}
        return self._asdict() | derived


@dataclass(frozen=True)
class LinkStudy:
    scenario: Scenario  # with the network
    runs: int  # seeds per bound and loss
    bounds: Sequence[Cell]  # over the bound, the shortest first, at the scenario's loss
    losses: Sequence[Cell]  # over the loss, at the best bound, with new seeds
    default: float  # bound of a scenario with `playout: null`, s
    left_out: tuple[float, ...]  # bounds in s that the multibody plant's time_step does not divide
    interrupted: bool  # whether Ctrl-C ended it early

    @property
    def files(self) -> list[str]:
        return ["runs/"]

    @property
    def best(self) -> Cell | None:
        """Usable cell of the least mean E_ac among those with the most completed runs, or None."""
        return best_of(self.bounds)

    @property
    def usable(self) -> list[Cell]:
        """Cells of the bounds at which at least half of the packets are in time."""
        return usable(self.bounds)

    @property
    def alike(self) -> dict[float, float]:
        """Usable bounds in s that the seeds do not show to be worse than the best.

        Each has its excess: the largest share, with 95 % confidence, by which the mean E_ac exceeds
        that of the best; NaN for one seed. A bound is worse if its mean is larger by NEGLIGIBLE and
        a one-sided t-test confirms that it is larger. The test is paired, as all bounds have the
        same seeds; where runs were lost it is one of two samples. Bounds that lost more runs than
        the best are in `unconfirmed_losses`.
        """
        best, found = self.best, dict[float, float]()
        for cell in self.usable:
            if best is None or cell is best or len(cell.errors) < len(best.errors):
                continue
            with warnings.catch_warnings(), np.errstate(all="ignore"):
                warnings.simplefilter("ignore", RuntimeWarning)  # errors that hardly differ
                paired = cell.completed == best.completed == 1
                test: Any = stats.ttest_rel if paired else stats.ttest_ind
                # Each end of the two-sided 90 % interval is a one-sided 95 % bound.
                interval = test(cell.errors, best.errors).confidence_interval(2 * CONFIDENCE - 1)
            if cell.mean / best.mean - 1 < NEGLIGIBLE or not interval.low > 0:
                found[cell.bound] = float(interval.high / best.mean)
        return found

    @property
    def unconfirmed_losses(self) -> list[float]:
        """Usable bounds in s that lost more runs than the best, unconfirmed by Fisher's test."""
        best, found = self.best, list[float]()
        for cell in self.usable:  # an interrupted study has cells of fewer runs, or none
            if best is None or not cell.completed < best.completed:
                continue
            table = np.array([[len(c.errors), c.runs - len(c.errors)] for c in (best, cell)])
            if stats.fisher_exact(table, "greater").pvalue > 1 - CONFIDENCE:
                found.append(cell.bound)
        return found

    @property
    def checked(self) -> Cell | None:
        """The best bound at the scenario's loss with new seeds, or None."""
        link = self.scenario.link
        assert link.kind == "network"
        return next((cell for cell in self.losses if cell.loss == link.loss), None)

    @property
    def survivable(self) -> float:
        """Largest loss up to which every run completed at the best bound; NaN for none."""
        survived = math.nan
        for cell in self.losses:
            if cell.completed != 1:
                break
            survived = cell.loss
        return survived

    @property
    def summary(self) -> dict[str, Any]:
        return {
            "best_bound": None if self.best is None else self.best.bound,
            "alike_bounds": list(self.alike),
            "usual_bound": self.default,
            "survivable_loss": self.survivable,
            "runs": self.runs,
            "bounds": [cell.summary for cell in self.bounds],
            "losses": [cell.summary for cell in self.losses],
            "left_out": self.left_out,
            "interrupted": self.interrupted,
        }


def study_link(
    scenario: Scenario,
    options: LinkOptions,
    progress: Progress | None = None,
    directory: str | Path | None = None,
) -> LinkStudy:
    """Simulate a scenario with a network on the exact plant over bounds, then over losses.

    The scenario's own `playout` is not used. A later call continues from the runs in `directory`.
    """
    options.check_scenario(scenario)
    link = scenario.assumed_link
    assert link.kind == "network"
    runs, period = options.runs, scenario.controller.period
    base = replace(scenario, link=link, plant=scenario.plant.without_engine)
    losses = sorted({*LOSSES, link.loss})
    kept: Any = {"settings": {"scenario": scenario_to_dict(base)}}
    kept["directory"] = None if directory is None else Path(directory) / "runs"

    def run(
        base: Scenario, wanted: list[tuple[float, float]], following: int
    ) -> tuple[list[Cell], bool]:
        """Simulate pairs of bound and loss; about `following` more are left, for the progress."""
        before, total = runs * len(found), runs * (len(found) + len(wanted) + following)
        return _simulated(base, wanted, runs, kept, part_of(progress, before, total))

    wanted, left_out, found = bounds_for(link, period), set[float](), list[Cell]()
    for step in (1.0, 0.5, 0.0):  # periods between the best bound and the next ones to try
        following = len(losses) + (2 if step else 0)
        cells, stopped = run(base, [(bound, link.loss) for bound in wanted], following)
        found = sorted([*found, *cells])
        best = best_of(found)
        if best is None or stopped:
            break
        near = {round(best.bound + sign * step * period, 12) for sign in (-1, 1)}
        near = {b for b in near if b > 0 and min(abs(b - cell.bound) for cell in found) > 1e-9}
        left_out |= {bound for bound in near if not _possible(scenario, link, bound)}
        wanted = sorted(near - left_out)
    checked: list[Cell] = []
    if best is not None and not stopped:
        sensor = replace(base.sensor, seed=base.sensor.seed + runs)
        fresh = replace(base, link=replace(link, seed=link.seed + runs), sensor=sensor)
        checked, stopped = run(fresh, [(best.bound, loss) for loss in losses], 0)
    default = default_bound(link, scenario.controller.packet_repeats, period)
    return LinkStudy(scenario, runs, found, checked, default, tuple(sorted(left_out)), stopped)


def bounds_for(link: NetworkConfig, period: float) -> list[float]:
    """Return bounds in s, whole periods, within which few packets arrive up to nearly all."""
    times = times_under_way(link)
    shares = (_SHORTEST_ARRIVED, _LONGEST_ARRIVED)
    first, last = (math.ceil(times.ppf(share) / period - 1e-9) for share in shares)
    steps = np.unique(np.linspace(first, last + 1, min(last + 2 - first, _MAX_BOUNDS)).round())
    return [float(period * step) for step in steps]


def usable(cells: Iterable[Cell]) -> list[Cell]:
    return [cell for cell in cells if cell.late <= MOST_LATE]


def best_of(cells: Iterable[Cell]) -> Cell | None:
    done = [cell for cell in usable(cells) if cell.errors]
    return min(done, key=lambda c: (-c.completed, c.mean), default=None)


def _possible(scenario: Scenario, link: NetworkConfig, bound: float) -> bool:
    """Return whether the scenario's own plant can be simulated with a bound in s."""
    other = replace(scenario, link=replace(link, playout=bound))
    return scenario.plant.kind != "multibody" or not other.step_problem(scenario.plant.time_step)


def _simulated(
    base: Scenario,
    wanted: list[tuple[float, float]],
    runs: int,
    kept: dict[str, Any],
    progress: Progress | None,
) -> tuple[list[Cell], bool]:
    """Return a cell for each bound and loss, and whether Ctrl-C ended it early."""
    link, c = base.link, base.controller
    assert link.kind == "network"
    keys = {
        (bound, loss): [f"bound{bound:g}-loss{loss:g}-seed{link.seed + k}" for k in range(runs)]
        for bound, loss in wanted
    }
    variants = {
        key: replace(
            base,
            link=replace(link, playout=bound, loss=loss, seed=link.seed + seed),
            sensor=replace(base.sensor, seed=base.sensor.seed + seed),
        )
        for (bound, loss), labels in keys.items()
        for seed, key in enumerate(labels)
    }
    results, stopped = run_scenarios(variants, progress, **kept) if variants else ({}, False)
    cells = []
    for (bound, loss), labels in keys.items():
        finished = [results[key] for key in labels if key in results]
        errors = tuple(one.error for one in finished if one.status == "completed")
        late = 1 - float(in_time(link, bound))
        missing = torque_missing(replace(link, loss=loss), bound, c.packet_repeats, c.period)
        cells.append(Cell(bound, loss, late, missing, len(finished), errors))
    return cells, stopped
