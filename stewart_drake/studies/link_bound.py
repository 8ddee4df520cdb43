"""Which play-out bound suits a network, and how much of its packets may be lost.

A longer bound makes packets late less often and every torque later: what is computed from a
measurement acts bound + repetitions later, whatever the packet took. The scenario is simulated over
bounds and, at the best of them, over losses, with several seeds each.
"""

import math
from collections.abc import Iterable
from dataclasses import dataclass, replace
from tempfile import TemporaryDirectory
from typing import Any, Final, NamedTuple

import numpy as np

from stewart_drake.files.errors import ConfigError
from stewart_drake.scenario.config import NetworkConfig, Scenario
from stewart_drake.scenario.link import in_time, times_under_way, torque_missing, usual_bound
from stewart_drake.scenario.loading import scenario_to_dict
from stewart_drake.studies.jobs import Progress, finished, run_jobs
from stewart_drake.studies.runs import read_outcome, run_scenario

LOSSES: Final = (0.0, 0.02, 0.05, 0.1, 0.2, 0.3, 0.4)
"""Shares of the packets, looked at beside the scenario's own."""
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
    def expected(self) -> float:
        """Mean E_ac in % s of the completed runs, infinite where one was lost."""
        return float(np.mean(self.errors)) if self.errors and self.completed == 1 else math.inf


@dataclass(frozen=True)
class LinkStudy:
    """What was found.

    Attributes:
        scenario: with the network.
        runs: seeds per bound and loss.
        bounds: over the bound, the shortest first, at the scenario's loss.
        losses: over the loss, at the best bound.
        usual: bound that a scenario with `playout: null` takes, s.
        interrupted: whether Ctrl-C ended it early.
    """

    scenario: Scenario
    runs: int
    bounds: tuple[Cell, ...]
    losses: tuple[Cell, ...]
    usual: float
    interrupted: bool

    @property
    def best(self) -> Cell | None:
        """Of the bounds at which most runs completed that of the least mean E_ac, or None."""
        return _best(self.bounds)

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
        """What summary.json holds."""
        best = self.best

        def told(cells: Iterable[Cell]) -> list[dict[str, Any]]:
            return [c._asdict() | {"completed": c.completed, "expected": c.expected} for c in cells]

        return {
            "best_bound": None if best is None else best.bound,
            "usual_bound": self.usual,
            "survivable_loss": self.survivable,
            "runs": self.runs,
            "bounds": told(self.bounds),
            "losses": told(self.losses),
            "interrupted": self.interrupted,
        }


def study_link(scenario: Scenario, runs: int = 5, progress: Progress | None = None) -> LinkStudy:
    """Simulate a scenario on the exact plant over bounds, then over losses.

    Args:
        scenario: with a network; its `playout` is not used.
        runs: seeds of network and sensor, for each bound and each loss.
        progress: called for each finished simulation.

    Raises:
        ConfigError: no network, or no runs.
    """
    link = scenario.link
    if not isinstance(link, NetworkConfig):
        raise ConfigError(f"link.kind: got {link.kind!r}; expected 'network'")
    if runs < 1:
        raise ConfigError(f"runs: got {runs}; expected at least 1")
    period, repeats = scenario.controller.period, scenario.controller.packet_repeats
    base = replace(scenario, plant=scenario.plant.without_engine)
    bounds = bounds_for(link, period)
    losses = sorted({*LOSSES, link.loss})
    total = runs * (len(bounds) + len(losses))
    found, stopped = _simulated(base, [(b, link.loss) for b in bounds], runs, progress, 0, total)
    best = _best(found)
    kept: list[Cell] = []
    if best is not None and not stopped:
        wanted = [(best.bound, loss) for loss in losses]
        kept, stopped = _simulated(base, wanted, runs, progress, runs * len(bounds), total)
    usual = usual_bound(link, repeats, period)
    return LinkStudy(scenario, runs, tuple(found), tuple(kept), usual, stopped)


def bounds_for(link: NetworkConfig, period: float) -> list[float]:
    """Whole periods, s, from where few packets are there in time to where nearly all are."""
    times = times_under_way(link)
    first, last = (math.ceil(times.ppf(share) / period - 1e-9) for share in (_FEW, _NEARLY_ALL))
    steps = np.unique(np.linspace(first, last + 1, min(last + 2 - first, _MOST)).round())
    return [float(period * step) for step in steps]


def _best(cells: Iterable[Cell]) -> Cell | None:
    done = [cell for cell in cells if cell.errors]
    return min(done, key=lambda c: (-c.completed, np.mean(c.errors)), default=None)


def _simulated(
    base: Scenario,
    wanted: list[tuple[float, float]],
    runs: int,
    progress: Progress | None,
    before: int,
    total: int,
) -> tuple[list[Cell], bool]:
    """A cell for each bound and loss, and whether Ctrl-C ended it early."""
    link, c = base.link, base.controller
    assert isinstance(link, NetworkConfig)
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

    def tell(done: int, _: int) -> None:
        if progress is not None:
            progress(before + done, total)

    stopped = False
    with TemporaryDirectory() as folder:
        try:
            settings = scenario_to_dict(base)
            run_jobs(jobs, run_scenario, folder, settings=settings, progress=tell)
        except KeyboardInterrupt:
            stopped = True
        results = {key: read_outcome(path) for key, path in finished(jobs, folder).items()}
    cells = []
    for bound, loss in wanted:
        keys = [f"bound{bound:g}-loss{loss:g}-seed{seed}" for seed in range(runs)]
        there = [results[key] for key in keys if key in results]
        errors = tuple(one.error for one in there if one.status == "completed")
        lossy = replace(link, loss=loss)
        late = 1 - in_time(replace(link, loss=0.0), bound)
        missing = torque_missing(lossy, bound, c.packet_repeats, c.period)
        cells.append(Cell(bound, loss, late, missing, len(there), errors))
    return cells, stopped
