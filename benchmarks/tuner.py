"""Whether the tuner is worth having: `python benchmarks/tuner.py [FOLDER]`.

Makes the data sets, trains a network from each kind of label, and evaluates them against the fixed
gains under three conditions. Writes benchmarks/results/tuner.md; what it runs is kept in FOLDER
(out/tuner-bench by default), and a second start goes on from there.
"""

import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from _bench import size, table, write

import stewart_drake as sd
from stewart_drake.reporting.document import number
from stewart_drake.reporting.terminal import count_bar
from stewart_drake.scenario.loading import scenario_to_dict
from stewart_drake.studies.jobs import run_jobs
from stewart_drake.studies.runs import read_outcome, run_scenario
from stewart_drake.tuner.network import save_network
from stewart_drake.tuning.data import make_data
from stewart_drake.tuning.evaluation import HINDSIGHT, TUNER, Evaluation, evaluate
from stewart_drake.tuning.families import Family, disturbed_family, paper_grid, with_gain
from stewart_drake.tuning.training import Training, train

WORKERS = 2
CELLS = size("CELLS", 16)
SCENARIOS = size("SCENARIOS", 20, least=2)
EXACT = ("plant.kind=exact",)
ON_REFERENCE = (*EXACT, "start=on_reference", "queue=reference")
BASES = {
    "as shipped, from rest": EXACT,
    "as shipped, on the reference": ON_REFERENCE,
    "no estimator, on the reference": (*ON_REFERENCE, "controller.estimate=[]"),
}
DATA = {
    "paper": ("as shipped, from rest", 0),
    "disturbed": ("as shipped, from rest", CELLS),
    "disturbed, no estimator": ("no estimator, on the reference", CELLS),
}
NETWORKS = {
    "paper, as_run": ("paper", "as_run"),
    "paper, best_in_cell": ("paper", "best_in_cell"),
    "paper, best_in_cell_torque": ("paper", "best_in_cell_torque"),
    "disturbed, best_in_cell": ("disturbed", "best_in_cell"),
    "disturbed, no estimator, best_in_cell": ("disturbed, no estimator", "best_in_cell"),
}
BEYOND = (1e-3, 5e-3, 200.0, 1e3)
"""Ratios w_Q / w_R outside the grid's 1/40 to 40."""


def base(name: str) -> sd.Scenario:
    """A condition as a scenario."""
    return sd.load_scenario("paper", settings=BASES[name])


@contextmanager
def bar(name: str) -> Iterator[Callable[[int, int], None]]:
    """A progress bar, if there is a terminal to show it on."""
    with count_bar(name[:14], quiet=False) as progress:
        yield progress


def networks(folder: Path) -> dict[str, Training]:
    """Every data set, and a network from each kind of label."""
    data = {}
    for name, (condition, cells) in DATA.items():
        with bar(name) as progress:
            scenario = base(condition)
            family = paper_grid(scenario)
            if cells:
                family = disturbed_family(scenario, cells, 0, "training")
            data[name] = make_data(family, folder / slug(name), workers=WORKERS, progress=progress)
    trained = {}
    for name, (source, kind) in NETWORKS.items():
        trained[name] = train(data[source], kind=kind, split="run")
        save_network(trained[name].network, folder / f"{slug(name)}.json")
    return trained


def unseen(condition: str) -> Family:
    """Conditions that no network was trained on."""
    return disturbed_family(base(condition), SCENARIOS, 0, "evaluation")


def evaluations(folder: Path) -> dict[str, dict[str, Evaluation]]:
    """By condition, then by network."""
    found: dict[str, dict[str, Evaluation]] = {}
    for condition in BASES:
        for name in NETWORKS:
            with bar(condition) as progress:
                found.setdefault(condition, {})[name] = evaluate(
                    unseen(condition),
                    [folder / f"{slug(name)}.json"],
                    folder / f"evaluation-{slug(condition)}",
                    workers=WORKERS,
                    progress=progress,
                )
    return found


def beyond(folder: Path, condition: str, grid: Evaluation) -> list[str]:
    """What gains outside the grid would add, as lines of text."""
    cells = [one.scenario for one in unseen(condition).conditions.values()]
    jobs = {
        f"{number:04d}_ratio{ratio:g}": (with_gain(cell, ratio**0.5, ratio**-0.5),)
        for ratio in BEYOND
        for number, cell in enumerate(cells)
    }
    outcomes = run_jobs(
        jobs,
        run_scenario,
        folder / f"beyond-{slug(condition)}",
        settings={"scenario": scenario_to_dict(base(condition))},
        read=read_outcome,
        workers=WORKERS,
    )
    error = np.array([one.error for one in outcomes.values()]).reshape(len(BEYOND), -1)
    fixed = grid.error[:-1]
    common = ~np.isnan(fixed).any(axis=0)
    best = grid.summary["candidates"][grid.summary["best_fixed"]]["mean"]
    every = np.vstack([fixed, error])[:, common]
    hindsight = 1 - np.nanmin(every, axis=0).mean() / best
    lines = [
        [f"{ratio:g}", str(int(np.isnan(row).sum())), number(row[common].mean(), 4)]
        for ratio, row in zip(BEYOND, error, strict=True)
    ]
    header = ["beyond the grid", "failures", "mean E_ac, same scenarios"]
    return [
        table(header, lines),
        f"With these four as well, the best gain of each scenario, picked in hindsight, is "
        f"{100 * hindsight:.1f} % below the best fixed gain of the grid.",
    ]


def slug(name: str) -> str:
    """A name as part of a file name."""
    return name.replace(", ", "-").replace(" ", "_")


def training_section(trained: dict[str, Training]) -> str:
    """How well each kind of label can be told from the densities."""
    lines = []
    for name, training in trained.items():
        card = training.network.card
        error, rows = card["rms_error"], card["rows"]
        share = 1 - (error["test"] / error["test_of_a_constant"]) ** 2
        lines.append(
            [
                name,
                f"{rows['labelled']}",
                number(error["train"]),
                number(error["test"]),
                number(error["test_of_a_constant"]),
                f"{100 * share:.1f} %",
            ]
        )
    header = ["data, labels", "rows", "rms, training", "rms, test", "constant", "explained"]
    return "## Training, split by run\n\n" + table(header, lines)


def row(name: str, one: dict[str, Any]) -> list[str]:
    """A candidate of an evaluation."""
    low, high = one["interval"]
    return [
        name,
        str(one["failures"]),
        number(one["mean"], 4),
        f"{number(low)} to {number(high)}",
        number(one["worst"]),
    ]


def evaluation_section(condition: str, found: dict[str, Evaluation], extra: list[str]) -> str:
    """The fixed gains, and each network on the scenarios that it and they complete."""
    first = next(iter(found.values())).summary
    header = ["w_Q / w_R", "failures", "mean E_ac", "95 %", "worst"]
    lines = [
        row(name, one)
        for name, one in first["candidates"].items()
        if name not in (TUNER, HINDSIGHT)
    ]
    text = [f"## {condition}", "", f"{SCENARIOS} scenarios, {first['common']} in common.", ""]
    text += [table(header, lines)]
    lines = []
    for name, evaluation in found.items():
        s = evaluation.summary
        low, high = (100 * x for x in s["improvement_interval"])
        lines.append(
            [
                name,
                str(s["candidates"][TUNER]["failures"]),
                number(s["candidates"][TUNER]["mean"], 4),
                s["best_fixed"],
                f"{100 * s['improvement']:.1f} % ({low:.1f} to {high:.1f})",
                f"{100 * s['hindsight']:.1f} %",
                str(s["fallbacks"][TUNER]),
            ]
        )
    header = [
        "network",
        "failures",
        "mean E_ac",
        "best fixed",
        "below it",
        "hindsight",
        "fallbacks",
    ]
    return "\n".join([*text, table(header, lines), *extra]) + "\n"


EXPLANATION = (
    "E_ac in % s. All candidates run the same drawn scenarios; means are over those that all fixed "
    "gains and the network complete. `below it`: the network's mean against that of the fixed gain "
    "that did best on these very scenarios, 95 % by bootstrap. `hindsight`: the same for the best "
    "gain of every scenario, picked afterwards, a bound for any choice among the gains."
)


def main(arguments: list[str]) -> None:
    """Run everything, or go on with it, and write the results."""
    folder = Path(arguments[0] if arguments else "out/tuner-bench")
    folder.mkdir(parents=True, exist_ok=True)
    parts = [training_section(networks(folder))]
    print(parts[0], flush=True)
    for condition, found in evaluations(folder).items():
        grid = next(iter(found.values()))
        parts.append(evaluation_section(condition, found, beyond(folder, condition, grid)))
        print(f"\n{parts[-1]}", flush=True)
    write(__file__, "The tuner", [f"{EXPLANATION}\n", *parts])


if __name__ == "__main__":
    main(sys.argv[1:])
