"""Speed in one table: ratios taken in one run, and the growth of times.

The plants' full curves are in plants.md, the parts of a controller step in controller_step.md and
all gains in riccati.md.
"""

import tempfile
import time
from collections.abc import Sequence

import joblib
import numpy as np
from _bench import table, write
from controller_step import evaluations, walls
from plants import SAP_STEPS, drake_run, motions
from plants import reference as plant_reference
from riccati import comparison

import stewart_drake as sd
from stewart_drake.loop.exact import ExactPlant
from stewart_drake.loop.platforms import MultibodyStewart
from stewart_drake.mechanism.files import load_mechanism
from stewart_drake.scenario.signals import POSE
from stewart_drake.studies.jobs import run_jobs
from stewart_drake.tuning.data import run_condition

Rows = list[list[str]]

ACCURACIES = (1e-4, 1e-5, 1e-6)
REPEATS = 3
DELAYS = (0, 8, 16, 30)
PERIODS = (0.2, 0.1, 0.05, 0.02)
RUNS = (100, 400, 1600)


def plants() -> Rows:
    """Compare the exact plant with SAP at its smallest step, at no larger error."""
    rows, mechanism = [], load_mechanism("paper")
    for motion in motions():
        expected = plant_reference(motion)
        sap = MultibodyStewart(mechanism, SAP_STEPS[-1], gravity=motion.gravity)
        runs = {"SAP": drake_run(motion, sap, None, 0.0)}
        for accuracy in ACCURACIES:
            plant = ExactPlant(sd.StewartDynamics(mechanism, motion.gravity))
            runs[f"exact, {accuracy:g}"] = drake_run(motion, plant, "runge_kutta5", accuracy)
        seconds, errors = dict.fromkeys(runs, np.inf), {}
        for _ in range(REPEATS):
            for name, run in runs.items():
                spent, state = run()
                seconds[name] = min(seconds[name], spent)
                errors[name] = np.abs(state - expected)[POSE].max()
        as_good = [name for name in runs if errors[name] <= errors["SAP"]]
        best = min(as_good, key=seconds.__getitem__)
        ratio = seconds["SAP"] / seconds[best]
        what = f"SAP at {1e3 * SAP_STEPS[-1]:g} ms / exact plant, {motion.title}"
        rows.append([what, f"{ratio:.3g}", f"errors {errors['SAP']:.0e}, {errors[best]:.0e}"])
    return rows


def gains() -> Rows:
    """Compare the whole chain's Riccati equation, by Drake and by scipy, with the reduced one."""
    rows = []
    header, lines = comparison(0.0)
    for line in lines:
        of = dict(zip(header, line, strict=True))
        if of["mu"] in ("8", "30"):
            full, scipy, reduced = (float(of[f"{who}, ms"]) for who in ("full", "scipy", "reduced"))
            differ = f"gains differ by {of['gains differ by']}"
            rows.append([f"full gain / reduced, mu = {of['mu']}", f"{full / reduced:.3g}", differ])
            rows.append([f"scipy's / reduced, mu = {of['mu']}", f"{scipy / reduced:.3g}", ""])
    return rows


def run(*settings: str, scenario: str = "paper") -> tuple[float, float, float]:
    """Return wall time in s, median and worst step in ms, each the least of several runs."""
    loaded = sd.load_scenario(scenario, settings=["plant.kind=exact", *settings])
    summaries = [sd.simulate(loaded).summary for _ in range(REPEATS)]
    steps = [summary["controller_step_ms"] for summary in summaries]
    return (
        min(summary["wall_s"] for summary in summaries),
        min(step["median"] for step in steps),
        min(step["worst"] for step in steps),
    )


def steps() -> Rows:
    """Time a complete step of `predictor_lqi`."""
    rows = []
    for name, settings in {"paper": (), "gravity": ("duration=2.0",)}.items():
        _, median, worst = run(*settings, scenario=name)
        period = 1e3 * sd.load_scenario(name).controller.period
        share = f"{median / period:.0%} of the period, {period:g} ms"
        rows.append([f"controller step, `{name}`", f"{median:.3g} ms, worst {worst:.3g}", share])
    return rows


def growth(field: str, values: Sequence[float]) -> Rows:
    """Time a run of 5 s and its steps over a field, also relative to the first value."""
    settings = ["duration=5.0", "start=on_reference", "queue=reference"]
    measured = [run(f"{field}={value}", *settings)[:2] for value in values]
    first_wall, first_median = measured[0]
    return [
        [f"{value:g}", f"{wall:.2f}", f"{median:.2f}"]
        + [f"{wall / first_wall:.2f}", f"{median / first_median:.2f}"]
        for value, (wall, median) in zip(values, measured, strict=True)
    ]


def studies() -> Rows:
    """Time many runs, in one process and on all cores."""
    cores = joblib.cpu_count()
    scenario = sd.load_scenario("paper", settings=["plant.kind=exact"])
    rows = []
    for number in RUNS:
        walls = []
        for workers in (1, cores):
            with tempfile.TemporaryDirectory() as folder:
                started = time.perf_counter()
                jobs = {f"run{k}": (scenario, ((1.0, 1.0),)) for k in range(number)}
                run_jobs(jobs, run_condition, folder, settings={}, suffix=".npz", workers=workers)
                walls.append(time.perf_counter() - started)
        efficiency = walls[0] / (cores * walls[1])
        rows.append([str(number), *(f"{wall:.1f}" for wall in walls), f"{efficiency:.0%}"])
    return rows


def main() -> None:
    again = [[what, f"{value} s", ""] for what, value in walls()]
    one = [[f"accelerations, {what}", value, ""] for what, value in evaluations()]
    cores = joblib.cpu_count()
    over = ["wall, s", "step, ms", "wall, ratio", "step, ratio"]
    parts = [
        table(["what", "ratio or time", ""], [*plants(), *gains(), *steps(), *again, *one]),
        "## Growth with the delay\n\nFive seconds of `paper` on the exact plant.\n",
        table(["mu", *over], growth("delay.steps", DELAYS)),
        "## Growth with the number of samples\n\nThe same with other periods, mu = 8.\n",
        table(["dt, s", *over], growth("controller.period", PERIODS)),
        "## Growth with the number of runs\n\nTen seconds of `paper` each.\n",
        table(["runs", "1 worker, s", f"{cores} workers, s", "efficiency"], studies()),
    ]
    write(__file__, "Speed", parts, f", on {cores} cores")


if __name__ == "__main__":
    main()
