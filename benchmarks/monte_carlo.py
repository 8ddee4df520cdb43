"""Runs of `analyze robustness` in C and in Drake, one after the other, machine by machine.

Drake's outcomes are those at an accuracy of 1e-12. Its times are those of the scenario as it
stands. Times are of the processor and include the draw, the law's parts and the file's text.
"""

import argparse
import json
import time
from collections.abc import Callable
from dataclasses import replace
from typing import Any, Final

import numpy as np
from _bench import size, table, write

import stewart_drake as sd
from stewart_drake.loop.bulk import run_in_bulk
from stewart_drake.loop.preparation import prepare
from stewart_drake.loop.simulation import simulate
from stewart_drake.scenario.config import Scenario
from stewart_drake.studies.study_options import Ranges
from stewart_drake.studies.uncertainty import MACHINE, Draw, apply_draw, draw, run_draw, scales_of

TIMED: Final = 5
"""Interval of the runs that are timed in Drake."""


def timed(call: Callable[[], Any]) -> tuple[float, Any]:
    """Return the processor time in s, and the result of a call."""
    started = time.process_time()
    found = call()
    return time.process_time() - started, found


def in_drake(scenario: Scenario, one: Draw) -> sd.SimulationResult:
    """Simulate a run."""
    changed = apply_draw(MACHINE, scenario, sd.load_mechanism(scenario.mechanism), one)
    return simulate(changed.as_scenario(), true_mechanism=changed.machine(), judge_stability=False)


def measure(scenario: Scenario, runs: int, seed: int) -> dict[str, str]:
    """Measure the rows of the table."""
    exact = replace(scenario, plant=replace(scenario.plant, accuracy=1e-12))
    peak = run_in_bulk(scenario).figures.peak_torque
    scales = scales_of(prepare(scenario), peak)
    same, errors, stops, native, loops = 0, [0.0], [0.0], [], set()
    drake: list[float] = []
    for index in range(runs):
        one = draw(Ranges(), scales, scenario, seed, index)
        seconds, file = timed(lambda one=one: json.loads(run_draw(scenario, one)))
        found, expected = file["outcome"], in_drake(exact, one)
        native.append(seconds)
        loops.add(found["loop"])
        if index % TIMED == 0:
            drake.append(timed(lambda one=one: in_drake(scenario, one))[0] / seconds)
        same += found["status"] == expected.status
        if expected.stopped is None and found["error"] is not None:
            errors.append(abs(found["error"] / expected.accumulated_error - 1))
        elif expected.stopped is not None and found["time"] is not None:
            stops.append(abs(found["time"] - expected.stopped.time))
    return {
        "runs, seed": f"{runs}, {seed}",
        "what ran them": ", ".join(sorted(loops)),
        "equal status": f"{same}",
        "E_ac, largest relative difference": f"{max(errors):.1e}",
        "instant of leaving, largest difference": f"{max(stops):.1e} s",
        "ms of a run in C": f"{1e3 * np.mean(native):.1f}",
        "Drake's time over that, median (quartiles)": (
            "{1:.1f} ({0:.1f} to {2:.1f})".format(*np.percentile(drake, [25, 50, 75]))
        ),
        "100 000 runs on two cores": f"{1e5 * np.mean(native) / 7200:.2f} h",
    }


def main() -> None:
    """Measure, print, and write the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--runs", type=int, default=size("RUNS", 500, least=5))
    parser.add_argument("--seed", type=int, default=20261)
    given = parser.parse_args()
    scenario = sd.load_scenario("paper", settings=["plant.kind=exact"])
    rows = measure(scenario, given.runs, given.seed)
    write(__file__, "Monte Carlo in C", [table(["what", "value"], list(rows.items()))])


if __name__ == "__main__":
    main()
