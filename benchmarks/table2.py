"""Why the paper's Table II needs its conditions: `python benchmarks/table2.py`.

Writes benchmarks/results/table2.md. All runs are of the scenario `table2` on the exact plant; what
is varied is said at each table.
"""

import os
import sys
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory

os.environ.setdefault("OMP_NUM_THREADS", "1")

import numpy as np
from _page import table as plain_table
from _page import write
from joblib import Parallel, delayed

import stewart_drake as sd
from stewart_drake.loop.controller_margin import controller_margin
from stewart_drake.loop.preparation import check_instants, prepare
from stewart_drake.mechanism.files import mechanism_yaml
from stewart_drake.scenario.loading import load_comparison
from stewart_drake.studies.workspace_map import largest_factor

AMPLITUDE = np.array([np.pi / 12] * 3 + [0.02, 0.02, 0.08])
ROWS = ("delay_lqr", "delay_lqi", "delay_lqi_sum", "delay_lqi_200")
BLIND = ("lqr", "lqi")
RATIOS = 10.0 ** np.arange(-5, 4.1, 0.5)
LOW = 10.0 ** np.arange(-7, 0.1, 0.25)
HIGH = 10.0 ** np.arange(0, 8.1, 0.5)
SHARES = np.arange(0.3, 1.01, 0.01)
CRANKS = (0.11, 0.15, 0.18, 0.22)


def size(share: float) -> str:
    """The setting for such a share of (46)."""
    return "reference.amplitude=[" + ", ".join(f"{a:.10g}" for a in share * AMPLITUDE) + "]"


def run(row: str, *settings: str) -> sd.SimulationResult:
    """One run of a row of the scenario."""
    return sd.simulate(load_comparison("table2", BLIND, settings)[row], judge_stability=False)


def told(result: sd.SimulationResult) -> str:
    """E_ac, or when it ended."""
    if result.stopped is None:
        return f"{result.accumulated_error:.3g}"
    return f"left {result.stopped.time:.2f} s"


def table(title: str, heads: tuple[str, ...], rows: list[list[str]]) -> str:
    """As Markdown."""
    return f"## {title}\n\n{plain_table(heads, rows)}"


def shares() -> str:
    """How large the motion may be: the first share of SHARES with which the plate is lost."""

    def first_lost(row: str) -> list[str]:
        before = None
        for share in SHARES:
            found = run(row, size(share))
            if found.stopped is not None:
                break
            before = found
        return [row, f"{share:.2f}", told(found), "" if before is None else told(before)]

    rows = Parallel(n_jobs=-1)(delayed(first_lost)(row) for row in ROWS)
    heads = ("row", "first share of (46) that is lost", "there", "E_ac just below it")
    return table("A smaller motion", heads, rows)


def weights() -> str:
    """(46) at full size, whatever the weights, with either model in the gain."""
    jobs = [
        (row, (size(1), f"controller.model={model}", f"controller.w_Q={ratio:.6g}"))
        for row in ("delay_lqr", "delay_lqi")
        for model in ("multibody", "paper")
        for ratio in RATIOS
    ]

    def one(row: str, settings: tuple[str, ...]) -> sd.SimulationResult:
        return sd.simulate(sd.load_scenario("table2", row, settings), judge_stability=False)

    runs = Parallel(n_jobs=-1)(delayed(one)(*job) for job in jobs)
    rows = []
    for row in ("delay_lqr", "delay_lqi"):
        for model in ("multibody", "paper"):
            kept = [
                r
                for (name, settings), r in zip(jobs, runs, strict=True)
                if name == row and settings[1].endswith(model)
            ]
            ends = [r.stopped.time for r in kept if r.stopped is not None]
            rows.append(
                [row, model, f"{len(kept) - len(ends)} of {len(kept)}"]
                + [f"{min(ends):.2f} to {max(ends):.2f}"]
            )
    heads = ("controller", "model of the gain", "completed", "lost at, s")
    span = f"w_Q/w_R from {RATIOS[0]:.0e} to {RATIOS[-1]:.0e}"
    return table(f"(46) at full size, {span}", heads, rows)


def longer_cranks() -> str:
    """(46) at full size on machines with longer cranks, which have more room."""
    rows = []
    paper = sd.load_mechanism("paper")
    with TemporaryDirectory() as folder:
        for length in CRANKS:
            machine = replace(paper, crank_lengths=np.full(6, length))
            path = Path(folder) / "longer.yaml"
            path.write_text(mechanism_yaml(machine))
            settings = (size(1), f"mechanism={path}")
            e = prepare(sd.load_scenario("table2", settings=settings))
            room = largest_factor(e.mechanism, e.reference, check_instants(e.scenario.duration))
            names = (*BLIND, *ROWS)
            runs = Parallel(n_jobs=-1)(delayed(run)(row, *settings) for row in names)
            rows.append([f"{length:g}", f"{room.value:.2f}", *map(told, runs)])
    heads = ("crank, m", "room, of (46)", *BLIND, *ROWS)
    return table("(46) at full size, longer cranks", heads, rows)


def inertia() -> str:
    """The paper's model in the gain: the worst spectral radius along the motion, and E_ac."""

    def one(row: str, ratio: float) -> tuple[float, sd.SimulationResult]:
        settings = ("controller.model=paper", f"controller.w_Q={ratio:.6g}")
        scenario = sd.load_scenario("table2", row, settings)
        margin = controller_margin(prepare(scenario))
        return margin.radius, sd.simulate(scenario, judge_stability=False)

    rows = []
    for row in ("delay_lqr", "delay_lqi"):
        found = Parallel(n_jobs=-1)(delayed(one)(row, ratio) for ratio in LOW)
        least = min(range(len(LOW)), key=lambda k: found[k][0])
        errors = {
            ratio: r.accumulated_error
            for ratio, (_, r) in zip(LOW, found, strict=True)
            if r.stopped is None
        }
        best = min(errors, key=lambda ratio: errors[ratio])
        rows.append(
            [row, f"{found[least][0]:.4f} at {LOW[least]:.1e}"]
            + [f"{min(errors):.1e} to {max(errors):.1e}", f"{errors[best]:.0f} at {best:.1e}"]
        )
    heads = ("controller", "least radius, at w_Q/w_R", "completes with w_Q/w_R", "least E_ac")
    span = f"w_Q/w_R from {LOW[0]:.0e} to {LOW[-1]:.0e}"
    return table(f"The paper's model in the gain, {span}", heads, rows)


def exits() -> str:
    """When those that know of no delay are lost, from rest, (46) at full size."""
    rows = []
    for row in BLIND:
        for model in ("multibody", "paper"):
            settings = (size(1), "start=rest", "queue=zero", f"controller.model={model}")
            runs = Parallel(n_jobs=-1)(
                delayed(sd.simulate)(
                    sd.load_scenario("table2", row, (*settings, f"controller.w_Q={ratio:.6g}")),
                    judge_stability=False,
                )
                for ratio in HIGH
            )
            ends = [r.stopped.time for r in runs]
            rows.append([row, model, f"{ends[0]:.2f}", f"{min(ends):.2f}"])
    heads = ("controller", "model of the gain", "w_Q/w_R = 1", f"earliest, up to {HIGH[-1]:.0e}")
    return table("When a controller that knows of no delay is lost, s, from rest", heads, rows)


def main() -> None:
    """Write all tables."""
    parts = [make() for make in (shares, weights, longer_cranks, inertia, exits)]
    write(__file__, "Why the paper's Table II needs its conditions", parts)


if __name__ == "__main__":
    sys.exit(main())
