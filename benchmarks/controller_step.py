"""Computing time of a closed loop: one controller step, one run, one process.

The parts of a step are those in Python, in the place of those of the core.
Times of steps are medians over a run and its worst step, each the least of several runs.
"""

import subprocess
import sys
import time
from collections import defaultdict
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from timeit import timeit
from typing import Any

import numpy as np
from _bench import table, with_own, write

import stewart_drake as sd
from stewart_drake.core.library import core
from stewart_drake.dynamics.stewart import plant_parameters
from stewart_drake.law.cost import QuadraticCost
from stewart_drake.law.feedforward import InverseDynamicsFeedforward
from stewart_drake.law.nominal import DesignModel
from stewart_drake.law.observers import CoreObserver

RUNS = 6
REPEATS = 300
"""Of an evaluation, 40 times each."""
SCENARIOS = {"paper": ["duration=10.0"], "gravity": ["duration=2.0"]}
ESTIMATORS = {"parameters": "[torque_bias,payload,damping]", "none": "[]"}
PARTS = {
    "observe": (CoreObserver, "observe"),
    "feedforward": (InverseDynamicsFeedforward, "held"),
    "linear model": (DesignModel, "at"),
    "sample": (QuadraticCost, "sampled"),
    "Riccati gain": (QuadraticCost, "gain"),
}
"""Calls of a step of `predictor_lqi`, in order; the rest is arithmetic on short vectors."""


def in_python(law: Any) -> Any:
    """Return a law with parts in Python."""
    return with_own(law, "observer", "feedforward", "model", "cost")


@contextmanager
def timed_parts() -> Iterator[dict[str, list[float]]]:
    """Time the parts of the law in Python: every call of PARTS appends its ms under its name."""
    spent: dict[str, list[float]] = defaultdict(list)
    originals = {name: getattr(*place) for name, place in PARTS.items()}

    def timed(name: str, original: Callable[..., Any]) -> Callable[..., Any]:
        def call(*args: Any, **kwargs: Any) -> Any:
            started = time.perf_counter()
            try:
                return original(*args, **kwargs)
            finally:
                spent[name].append(1e3 * (time.perf_counter() - started))

        return call

    for name, place in PARTS.items():
        setattr(*place, timed(name, originals[name]))
    try:
        yield spent
    finally:
        for name, place in PARTS.items():
            setattr(*place, originals[name])


def steps() -> tuple[list[list[str]], list[list[str]]]:
    """Return rows of the step times as `summary` reports them, and of their parts' medians."""
    totals, parts = [], []
    for name, settings in SCENARIOS.items():
        for estimator, estimate in ESTIMATORS.items():
            scenario = sd.load_scenario(
                name, settings=["plant.kind=exact", f"controller.estimate={estimate}", *settings]
            )
            medians: dict[str, list[float]] = defaultdict(list)
            sd.simulate(scenario)
            for _ in range(RUNS):
                step_ms = sd.simulate(scenario).summary["controller_step_ms"]
                with timed_parts() as spent:
                    result = sd.simulate(scenario, modify_law=in_python)
                    own = result.summary["controller_step_ms"]["median"]
                told = {"in Python": [own]} | {k: [v] for k, v in step_ms.items()}
                for part, milliseconds in (spent | told).items():
                    medians[part].append(float(np.median(milliseconds)))
            least = {part: f"{min(values):.3g}" for part, values in medians.items()}
            totals.append([name, estimator, least["median"], least["worst"]])
            whole = least["in Python"]
            parts.append([name, estimator, whole, *(least.get(part, "") for part in PARTS)])
    return totals, parts


def in_fresh_processes(code: str, times: int = 5) -> list[float]:
    """Return the numbers that `code` prints, each the least of several processes."""
    runs = [
        [float(word) for word in subprocess.check_output([sys.executable, "-c", code]).split()]
        for _ in range(times)
    ]
    return [min(column) for column in zip(*runs, strict=True)]


def walls() -> list[list[str]]:
    """Return the wall time of ten simulated seconds of `paper`."""
    rows = []
    for kind in ("exact", "multibody"):
        code = f"""
import time, stewart_drake as sd
scenario = sd.load_scenario("paper", settings=["plant.kind={kind}"])
for _ in range(4):
    started = time.perf_counter()
    sd.simulate(scenario)
    print(time.perf_counter() - started)
"""
        first, *others = in_fresh_processes(code, 3)
        rows.append([f"simulate, {kind}, first in its process", f"{first:.2f}"])
        rows.append([f"simulate, {kind}, again", f"{min(others):.2f}"])
    command = Path(sys.executable).with_name("stewart-drake")
    arguments = [str(command), "simulate", "paper", "--set", "plant.kind=exact"]
    if command.exists():
        call = f"import subprocess; subprocess.run({arguments!r}, capture_output=True, check=True)"
        code = f"import time; t = time.perf_counter(); {call}; print(time.perf_counter() - t)"
        title = "process `" + " ".join(["stewart-drake", *arguments[1:]]) + "`"
        rows.append([title, f"{in_fresh_processes(code)[0]:.2f}"])
    code = (
        "import time; t = time.perf_counter(); import stewart_drake; print(time.perf_counter() - t)"
    )
    rows.append(["`import stewart_drake`", f"{in_fresh_processes(code)[0]:.2f}"])
    return rows


def evaluations() -> list[list[str]]:
    """Return the time of an evaluation of the accelerations, and of the first one."""
    mechanism = sd.load_mechanism("paper")
    dynamics, pose, rates, torque = sd.StewartDynamics(mechanism), mechanism.home, *np.ones((2, 6))
    dynamics.accelerations(pose, rates, torque)
    compiled, theta = dynamics._functions.accelerations, plant_parameters(dynamics.parameters)
    c, gravity = core(), np.array(dynamics.gravity)
    arrays = mechanism.numbers, theta, gravity, pose, rates, torque, np.empty(6)
    *of_plant, at_pose, at_rates, at_torque, result = map(c.at, arrays)
    places = c.plant(*of_plant), at_pose, at_rates, at_torque, result
    calls: dict[str, Callable[[], object]] = {
        "the function alone": partial(c.lib.stewart_accelerations, *places),
        "with its arguments": lambda: compiled(pose, rates, torque, theta, dynamics.gravity),
        "`StewartDynamics.accelerations`": lambda: dynamics.accelerations(pose, rates, torque),
    }
    least = dict.fromkeys(calls, np.inf)
    for _ in range(REPEATS):
        for name, call in calls.items():
            least[name] = min(least[name], timeit(call, number=40) / 40)
    rows = [[name, f"{1e6 * seconds:.1f} us"] for name, seconds in least.items()]
    code = """
import time, numpy, stewart_drake as sd
mechanism, zero = sd.load_mechanism("paper"), numpy.zeros(6)
started = time.perf_counter()
sd.StewartDynamics(mechanism).accelerations(mechanism.home, zero, zero)
print(time.perf_counter() - started)
"""
    return [*rows, ["first one in a process", f"{in_fresh_processes(code)[0]:.3f} s"]]


def main() -> None:
    totals, parts = steps()
    write(
        __file__,
        "Time",
        [
            "## One step of `predictor_lqi` in the running loop, exact plant, ms\n",
            table(["scenario", "estimator", "median", "worst"], totals),
            "## The same in Python, medians of the whole and of its parts, ms\n",
            table(["scenario", "estimator", "all", *PARTS], parts),
            "## Ten simulated seconds of `paper`, s\n",
            table(["what", "s"], walls()),
            "## One evaluation of the accelerations\n",
            table(["what", "time"], evaluations()),
        ],
    )


if __name__ == "__main__":
    main()
