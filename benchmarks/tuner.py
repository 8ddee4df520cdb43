"""Comparison of tuners with fixed gains: labels, data sets and conditions.

Makes the data sets, trains a network from each kind of label, and evaluates them against the fixed
gains under three conditions. The runs are kept in the folder of the first argument,
out/tuner-bench by default, so that a second start continues.
"""

import sys
from pathlib import Path
from typing import Any

import numpy as np
from _bench import EXACT, NONE, ON, section, size, table, write

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
BASES = {
    "as shipped, from rest": (EXACT,),
    "as shipped, on the reference": (EXACT, *ON),
    "no estimator, on the reference": (EXACT, *ON, NONE),
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
EXPLANATION = (
    "E_ac in % s. All candidates run the same drawn scenarios; means are over those that all fixed "
    "gains and the network complete. `below it`: the network's mean against that of the fixed gain "
    "that did best on these very scenarios, 95 % by bootstrap. `hindsight`: the same for the best "
    "gain of every scenario, picked afterwards, a bound for any choice among the gains."
)


def base(name: str) -> sd.Scenario:
    """Return a condition as a scenario."""
    return sd.load_scenario("paper", settings=BASES[name])


def slug(name: str) -> str:
    """Return a name as part of a file name."""
    return name.replace(", ", "-").replace(" ", "_")


def networks(folder: Path) -> dict[str, Training]:
    """Make every data set, and train a network from each kind of label."""
    data = {}
    for name, (condition, cells) in DATA.items():
        with count_bar(name[:14], quiet=False) as progress:
            scenario = base(condition)
            family = (
                disturbed_family(scenario, cells, 0, "training") if cells else paper_grid(scenario)
            )
            data[name] = make_data(family, folder / slug(name), workers=WORKERS, progress=progress)
    trained = {}
    for name, (source, kind) in NETWORKS.items():
        trained[name] = train(data[source], kind=kind, split="run")
        save_network(trained[name].network, folder / f"{slug(name)}.json")
    return trained


def unseen(condition: str) -> Family:
    """Return conditions that no network was trained on."""
    return disturbed_family(base(condition), SCENARIOS, 0, "evaluation")


def evaluations(folder: Path, condition: str) -> dict[str, Evaluation]:
    """Evaluate all networks under a condition."""
    found: dict[str, Evaluation] = {}
    for name in NETWORKS:
        with count_bar(condition[:14], quiet=False) as progress:
            found[name] = evaluate(
                unseen(condition),
                [folder / f"{slug(name)}.json"],
                folder / f"evaluation-{slug(condition)}",
                workers=WORKERS,
                progress=progress,
            )
    return found


def beyond(folder: Path, condition: str, grid: Evaluation) -> list[str]:
    """Return a table of gains outside the grid."""
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
    rows = [
        [f"{ratio:g}", int(np.isnan(row).sum()), number(row[common].mean(), 4)]
        for ratio, row in zip(BEYOND, error, strict=True)
    ]
    return [
        table(["beyond the grid", "failures", "mean E_ac, same scenarios"], rows),
        f"With these four as well, the best gain of each scenario, picked in hindsight, is "
        f"{100 * hindsight:.1f} % below the best fixed gain of the grid.",
    ]


def training_section(trained: dict[str, Training]) -> str:
    """Return how well the densities predict each kind of label."""
    rows = []
    for name, training in trained.items():
        card = training.network.card
        error = card["rms_error"]
        share = 1 - (error["test"] / error["test_of_a_constant"]) ** 2
        errors = map(number, (error["train"], error["test"], error["test_of_a_constant"]))
        rows.append([name, card["rows"]["labelled"], *errors, f"{100 * share:.1f} %"])
    header = ["data, labels", "rows", "rms, training", "rms, test", "constant", "explained"]
    return section("Training, split by run", table(header, rows))


def row(name: str, one: dict[str, Any]) -> list[object]:
    """Return the row of a candidate."""
    low, high = map(number, one["interval"])
    mean, worst = number(one["mean"], 4), number(one["worst"])
    return [name, one["failures"], mean, f"{low} to {high}", worst]


def evaluation_section(condition: str, found: dict[str, Evaluation], extra: list[str]) -> str:
    """Return tables of the fixed gains, and of the networks."""
    first = next(iter(found.values())).summary
    gains = [
        row(name, one)
        for name, one in first["candidates"].items()
        if name not in (TUNER, HINDSIGHT)
    ]
    rows = []
    for name, evaluation in found.items():
        s = evaluation.summary
        tuner = s["candidates"][TUNER]
        low, high = (100 * x for x in s["improvement_interval"])
        below = f"{100 * s['improvement']:.1f} % ({low:.1f} to {high:.1f})"
        hindsight = f"{100 * s['hindsight']:.1f} %"
        rows.append(
            [name, tuner["failures"], number(tuner["mean"], 4), s["best_fixed"], below, hindsight]
            + [s["fallbacks"][TUNER]]
        )
    heads = ["network", "failures", "mean E_ac", "best fixed", "below it", "hindsight", "fallbacks"]
    return section(
        condition,
        f"{SCENARIOS} scenarios, {first['common']} in common.",
        table(["w_Q / w_R", "failures", "mean E_ac", "95 %", "worst"], gains),
        table(heads, rows),
        *extra,
    )


def main(folder: Path) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    parts = [EXPLANATION, training_section(networks(folder))]
    for condition in BASES:
        found = evaluations(folder, condition)
        grid = next(iter(found.values()))
        parts.append(evaluation_section(condition, found, beyond(folder, condition, grid)))
    write(__file__, "The tuner", parts)


if __name__ == "__main__":
    main(Path(sys.argv[1] if sys.argv[1:] else "out/tuner-bench"))
