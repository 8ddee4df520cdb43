"""Analysis of a network: the best play-out bound, and the losses that it survives.

Drake is imported by the analysis, not by its options.
"""

from dataclasses import replace
from typing import TYPE_CHECKING

from stewart_drake.files.errors import ConfigError
from stewart_drake.scenario.config import Scenario
from stewart_drake.studies.options import Options, option

if TYPE_CHECKING:
    from stewart_drake.studies.jobs import Progress
    from stewart_drake.studies.link_bound import LinkStudy


class LinkOptions(Options):
    """Options of `study_link`."""

    runs: int = option(5, "Number of seeds for each bound and loss.", "N", ge=1)


def study_link(
    scenario: Scenario, options: LinkOptions, progress: "Progress | None" = None
) -> "LinkStudy":
    """Simulate a scenario on the exact plant over bounds, then over losses.

    Args:
        scenario: with a network; its `playout` is not used.
        options: see `LinkOptions`.
        progress: called for each finished simulation.

    Raises:
        ConfigError: the scenario has no network.
    """
    from stewart_drake.scenario.packets import usual_bound
    from stewart_drake.studies.link_bound import (
        LOSSES,
        Cell,
        LinkStudy,
        best_of,
        bounds_for,
        possible,
        simulated,
    )

    link = scenario.assumed_link
    if link.kind != "network":
        raise ConfigError(f"link.kind: got {link.kind!r}; expected 'network'")
    runs = options.runs
    period, repeats = scenario.controller.period, scenario.controller.packet_repeats
    base = replace(scenario, link=link, plant=scenario.plant.without_engine)
    losses = sorted({*LOSSES, link.loss})
    done = 0

    def run(
        base: Scenario, cells: list[tuple[float, float]], following: int
    ) -> tuple[list[Cell], bool]:
        """Simulate cells, before some number of `following` ones."""
        nonlocal done
        if not cells:
            return [], False
        before, total = done, done + runs * (len(cells) + following)
        done += runs * len(cells)

        def tell(now: int, _: int) -> None:
            if progress is not None:
                progress(before + now, total)

        return simulated(base, cells, runs, tell)

    wanted, left_out, found = bounds_for(link, period), set[float](), list[Cell]()
    for step in (1.0, 0.5, 0.0):  # periods between the best bound and those that are tried next
        following = len(losses) + (2 if step else 0)
        cells, stopped = run(base, [(bound, link.loss) for bound in wanted], following)
        found = sorted([*found, *cells])
        best = best_of(found)
        if best is None or stopped:
            break
        near = {round(best.bound + sign * step * period, 12) for sign in (-1, 1)}
        near = {b for b in near if b > 0 and min(abs(b - cell.bound) for cell in found) > 1e-9}
        left_out |= {bound for bound in near if not possible(scenario, link, bound)}
        wanted = sorted(near - left_out)
    kept: list[Cell] = []
    if best is not None and not stopped:
        sensor = replace(base.sensor, seed=base.sensor.seed + runs)
        fresh = replace(base, link=replace(link, seed=link.seed + runs), sensor=sensor)
        kept, stopped = run(fresh, [(best.bound, loss) for loss in losses], 0)
    usual = usual_bound(link, repeats, period)
    there = tuple(sorted(left_out))
    return LinkStudy(scenario, runs, tuple(found), tuple(kept), usual, there, stopped)
