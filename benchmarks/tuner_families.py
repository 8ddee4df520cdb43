"""What the delay estimator leaves for a tuner: `python benchmarks/tuner_families.py [FOLDER]`.

Fresh conditions of family T (`tune evaluate --family T` weighs all candidates without the delay
estimator). The runs are kept in FOLDER, so that a second start goes on; the table goes to
benchmarks/results/tuner_families.md. CONDITIONS, SEED and WORKERS of the environment.
"""

import os
import sys
from dataclasses import replace
from pathlib import Path

os.environ.setdefault("OMP_NUM_THREADS", "1")

import numpy as np
from _page import RESULTS, size

from stewart_drake.files.versions import versions
from stewart_drake.scenario.config import AnnTunerConfig, RuleTunerConfig, Scenario
from stewart_drake.studies.jobs import run_jobs
from stewart_drake.tuner.source import weights_of
from stewart_drake.tuning.data import LEAST
from stewart_drake.tuning.evaluation import read_told, tuned_run
from stewart_drake.tuning.families import FAULTS, fault_of, faulty_family, with_gain

CONDITIONS = size("CONDITIONS", 24)
SEED = int(os.environ.get("SEED", "20263"))
WORKERS = int(os.environ.get("WORKERS", "2"))
ESTIMATOR = ("controller.delay_estimator=constant", "controller.delay_std=0.02")
"""Which knows that the delay is what it is believed to be to some 20 ms."""
NETWORK = "health_T"


def candidates() -> dict[str, tuple[tuple[str, ...], object]]:
    """Name -> settings, and a ratio or a section `tuner`."""
    network, rule = AnnTunerConfig(weights=NETWORK), RuleTunerConfig()
    alone: dict[str, tuple[tuple[str, ...], object]] = {
        "fixed, -3": ((), -3.0),
        "fixed, 0": ((), 0.0),
        "rule": ((), rule),
        "network": ((), network),
    }
    with_it = {f"delay estimator, {r:g}": (ESTIMATOR, r) for r in (-2.0, -1.0, 0.0, 1.0)}
    tuned = {
        "delay estimator, rule": (ESTIMATOR, rule),
        "delay estimator, network": (ESTIMATOR, network),
    }
    return {**alone, **with_it, **tuned}


def made(scenario: Scenario, how: object) -> Scenario:
    """With a fixed ratio or a tuner."""
    if isinstance(how, float):
        return with_gain(scenario, *weights_of(how).tolist())
    return replace(scenario, tuner=how)  # type: ignore[arg-type]


def main(folder: Path) -> None:
    """Run all candidates and write the table."""
    plain = faulty_family("T", CONDITIONS, SEED, "evaluation")
    faults = np.array([fault_of(one) for one in plain.draws])
    lines = [
        "# What is left for a tuner with the delay estimator on",
        "",
        f"Made by `python benchmarks/tuner_families.py` with {versions()['stewart-drake']}; "
        f"{CONDITIONS} conditions of family T, seed {SEED}. g is the geometric mean of J in % s "
        "(E_ac up to the end, plus 50 for each second without a plate).",
        "",
        f"| log10 w_Q/w_R | completed | g | m | {' | '.join(f'g, {f}' for f in FAULTS)} |",
        f"| {' | '.join(['---'] * (4 + len(FAULTS)))} |",
    ]
    for number, (name, (settings, how)) in enumerate(candidates().items()):
        family = faulty_family("T", CONDITIONS, SEED, "evaluation", settings)
        jobs = {key: (made(one.scenario, how),) for key, one in family.conditions.items()}
        told = run_jobs(
            jobs,
            tuned_run,
            folder / f"candidate{number}",
            settings={"name": name, "seed": SEED},
            read=read_told,
            workers=WORKERS,
        )
        J = np.array([one.cost[0] for one in told.values()])
        done = sum(one.error[0] is not None for one in told.values())
        g = [np.exp(np.mean(np.log(np.maximum(J[faults == f], LEAST)))) for f in FAULTS]
        every = np.exp(np.mean(np.log(np.maximum(J, LEAST))))
        cells = [f"{done}", *(f"{x:.3g}" for x in (every, J.mean(), *g))]
        lines.append(f"| {name} | {' | '.join(cells)} |")
        print(lines[-1], flush=True)
    RESULTS.mkdir(parents=True, exist_ok=True)
    (RESULTS / "tuner_families.md").write_text("\n".join(lines) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main(Path(sys.argv[1] if sys.argv[1:] else "out/tuner-families"))
