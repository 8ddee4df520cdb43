"""Why the paper's Table II needs its conditions: runs of the scenario `table2`, exact plant.

The varied settings are given at each table.
"""

from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from _bench import AMPLITUDE, grouped, in_parallel, run_sections, section, table

import stewart_drake as sd
from stewart_drake.loop.controller_margin import controller_margin
from stewart_drake.loop.preparation import check_instants, prepare
from stewart_drake.mechanism.files import mechanism_yaml
from stewart_drake.scenario.loading import load_comparison
from stewart_drake.studies.workspace_map import largest_factor

ROWS = ("delay_lqr", "delay_lqi", "delay_lqi_sum", "delay_lqi_200")
BLIND = ("lqr", "lqi")
AWARE = ("delay_lqr", "delay_lqi")
MODELS = ("multibody", "paper")
RATIOS = 10.0 ** np.arange(-5, 4.1, 0.5)
LOW = 10.0 ** np.arange(-7, 0.1, 0.25)
HIGH = 10.0 ** np.arange(0, 8.1, 0.5)
SHARES = np.arange(0.3, 1.01, 0.01)
CRANKS = (0.11, 0.15, 0.18, 0.22)


def amplitude(share: float) -> str:
    """Return the setting of a share of (46)."""
    return "reference.amplitude=[" + ", ".join(f"{a:.10g}" for a in share * AMPLITUDE) + "]"


def run(row: str, *settings: str) -> sd.SimulationResult:
    """Run a row of the scenario."""
    return sd.simulate(load_comparison("table2", BLIND, settings)[row], judge_stability=False)


def run_controller(name: str, *settings: str) -> sd.SimulationResult:
    """Run the scenario with a shipped controller."""
    return sd.simulate(sd.load_scenario("table2", name, settings), judge_stability=False)


def outcome(result: sd.SimulationResult) -> str:
    """Return E_ac, or when the run ended."""
    if result.stopped is None:
        return f"{result.accumulated_error:.3g}"
    return f"left {result.stopped.time:.2f} s"


def first_lost(row: str) -> list[str]:
    """Return the first share of SHARES with which the plate is lost."""
    before = None
    for share in SHARES:
        found = run(row, amplitude(share))
        if found.stopped is not None:
            break
        before = found
    return [row, f"{share:.2f}", outcome(found), "" if before is None else outcome(before)]


def shares() -> str:
    """Return how large the motion may be."""
    heads = ("row", "first share of (46) that is lost", "there", "E_ac just below it")
    return section("A smaller motion", table(heads, in_parallel(first_lost, zip(ROWS))))


def weights() -> str:
    """Return runs of (46) at full size with all weights and either model in the gain."""
    cases = {
        (row, model): [
            (row, amplitude(1), f"controller.model={model}", f"controller.w_Q={ratio:.6g}")
            for ratio in RATIOS
        ]
        for row in AWARE
        for model in MODELS
    }
    rows = []
    for name, runs in grouped(run_controller, cases).items():
        ends = [r.stopped.time for r in runs if r.stopped is not None]
        completed = f"{len(runs) - len(ends)} of {len(runs)}"
        rows.append([*name, completed, f"{min(ends):.2f} to {max(ends):.2f}"])
    heads = ("controller", "model of the gain", "completed", "lost at, s")
    span = f"w_Q/w_R from {RATIOS[0]:.0e} to {RATIOS[-1]:.0e}"
    return section(f"(46) at full size, {span}", table(heads, rows))


def longer_cranks() -> str:
    """Return runs of (46) at full size on machines with longer cranks, which have more room."""
    rows, names, paper = [], (*BLIND, *ROWS), sd.load_mechanism("paper")
    with TemporaryDirectory() as folder:
        for length in CRANKS:
            machine = replace(paper, crank_lengths=np.full(6, length))
            path = Path(folder) / "longer.yaml"
            path.write_text(mechanism_yaml(machine))
            settings = (amplitude(1), f"mechanism={path}")
            e = prepare(sd.load_scenario("table2", settings=settings))
            room = largest_factor(e.mechanism, e.reference, check_instants(e.scenario.duration))
            runs = in_parallel(run, [(row, *settings) for row in names])
            rows.append([f"{length:g}", f"{room:.2f}", *map(outcome, runs)])
    heads = ("crank, m", "room, of (46)", *names)
    return section("(46) at full size, longer cranks", table(heads, rows))


def radius_and_run(row: str, ratio: float) -> tuple[float, sd.SimulationResult]:
    """Return the worst spectral radius along the motion, and a run."""
    settings = ("controller.model=paper", f"controller.w_Q={ratio:.6g}")
    radius = controller_margin(prepare(sd.load_scenario("table2", row, settings))).radius
    return radius, run_controller(row, *settings)


def inertia() -> str:
    """Return the worst spectral radius and E_ac with the paper's model in the gain."""
    rows = []
    for row, found in grouped(
        radius_and_run, {row: [(row, ratio) for ratio in LOW] for row in AWARE}
    ).items():
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
    return section(f"The paper's model in the gain, {span}", table(heads, rows))


def exits() -> str:
    """Return when delay-blind controllers lose the plate, from rest, (46) at full size."""
    start = (amplitude(1), "start=rest", "queue=zero")
    cases = {
        (row, model): [
            (row, *start, f"controller.model={model}", f"controller.w_Q={ratio:.6g}")
            for ratio in HIGH
        ]
        for row in BLIND
        for model in MODELS
    }
    rows = []
    for name, runs in grouped(run_controller, cases).items():
        ends = [r.stopped.time for r in runs]
        rows.append([*name, f"{ends[0]:.2f}", f"{min(ends):.2f}"])
    heads = ("controller", "model of the gain", "w_Q/w_R = 1", f"earliest, up to {HIGH[-1]:.0e}")
    return section(
        "When a delay-blind controller loses the plate, s, from rest", table(heads, rows)
    )


SECTIONS = {
    "shares": shares,
    "weights": weights,
    "longer_cranks": longer_cranks,
    "inertia": inertia,
    "exits": exits,
}

if __name__ == "__main__":
    run_sections(__file__, "Why the paper's Table II needs its conditions", SECTIONS)
