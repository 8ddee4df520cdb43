"""Gain of a tuner in addition to the delay estimator: fresh conditions of family T.

`tune evaluate --family T` compares all candidates without the delay estimator. The runs are kept in
the folder of the first argument, out/tuner-families by default, so that a second start continues.
CONDITIONS, SEED and WORKERS of the environment.
"""

import os
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
from _bench import size, table, write

from stewart_drake.scenario.config import AnnTunerConfig, RuleTunerConfig, Scenario
from stewart_drake.studies.jobs import run_jobs
from stewart_drake.tuner.source import weights_of
from stewart_drake.tuning.data import log_cost, read_condition, run_condition
from stewart_drake.tuning.families import FAULTS, fault_of, faulty_family, with_gain

CONDITIONS = size("CONDITIONS", 24)
SEED = int(os.environ.get("SEED", "20263"))
WORKERS = int(os.environ.get("WORKERS", "2"))
ESTIMATOR = ("controller.delay_estimator=constant", "controller.delay_std=0.02")
"""The believed delay is known to some 20 ms."""
RULE, NETWORK = RuleTunerConfig(), AnnTunerConfig(weights="health_T")
CANDIDATES: dict[str, tuple[tuple[str, ...], object]] = {
    "fixed, -3": ((), -3.0),
    "fixed, 0": ((), 0.0),
    "rule": ((), RULE),
    "network": ((), NETWORK),
    **{f"delay estimator, {r:g}": (ESTIMATOR, r) for r in (-2.0, -1.0, 0.0, 1.0)},
    "delay estimator, rule": (ESTIMATOR, RULE),
    "delay estimator, network": (ESTIMATOR, NETWORK),
}
"""Settings, and a ratio or a section `tuner`, by name."""


def made(scenario: Scenario, how: object) -> Scenario:
    """Return the scenario with a fixed ratio or a tuner."""
    if isinstance(how, float):
        return with_gain(scenario, *weights_of(how).tolist())
    return replace(scenario, tuner=how)  # type: ignore[arg-type]


def main(folder: Path) -> None:
    plain = faulty_family("T", CONDITIONS, SEED, "evaluation")
    faults, rows = np.array([fault_of(one) for one in plain.draws]), []
    for number, (name, (settings, how)) in enumerate(CANDIDATES.items()):
        family = faulty_family("T", CONDITIONS, SEED, "evaluation", settings)
        found = run_jobs(
            {key: (made(one.scenario, how),) for key, one in family.conditions.items()},
            run_condition,
            folder / f"candidate{number}",
            settings={"name": name, "seed": SEED},
            suffix=".npz",
            read=read_condition,
            workers=WORKERS,
        ).values()
        J = np.array([one["J"][0] for one in found])
        done = sum(one["status"][0] == "completed" for one in found)
        chosen = (faults != "", *(faults == fault for fault in FAULTS))
        g = [np.exp(log_cost(J[some]).mean()) for some in chosen]
        rows.append([name, f"{done}", *(f"{x:.3g}" for x in (g[0], J.mean(), *g[1:]))])
        print(*rows[-1], flush=True)
    words = (
        f"{CONDITIONS} conditions of family T, seed {SEED}. g is the geometric mean of J in % s "
        "(E_ac up to the end, plus 50 for each second without a plate)."
    )
    heads = ["log10 w_Q/w_R", "completed", "g", "m", *(f"g, {f}" for f in FAULTS)]
    title = "What is left for a tuner with the delay estimator on"
    write(__file__, title, [words, table(heads, rows)])


if __name__ == "__main__":
    main(Path(sys.argv[1] if sys.argv[1:] else "out/tuner-families"))
