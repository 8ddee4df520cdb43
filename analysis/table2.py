"""Under which conditions does the paper's Table II come out, and what does its law lack?

python analysis/table2.py [section.field=value ...]
"""

import sys
from pathlib import Path

import stewart_drake as sd

PLANTS = {
    "exact": (),
    "multibody": ("plant.kind=multibody",),
    "paper": ("overlay=paper_plant",),  # its model taken for the machine, (46) at its full size
}
MOTIONS = {
    "0.3 of (46), w_Q 2.5": (),
    "(46), w_Q 10": (
        "reference.amplitude=[0.2617993878, 0.2617993878, 0.2617993878, 0.02, 0.02, 0.08]",
        "controller.w_Q=10",
    ),
}
# Each with what the one above it has; the gain knows the true inertia in all three.
PREVIEW = ("controller.prediction=nonlinear",)
FEEDFORWARD = ("controller.feedforward=inverse_dynamics",)
LAWS = {
    "as printed": (),
    "with preview": PREVIEW,
    "with preview and feedforward": PREVIEW + FEEDFORWARD,
}


def outcome(controller: str, *settings: str) -> str:
    """E_ac of a run in % s, or when it was lost."""
    inertia = "controller.model=multibody"
    scenario = sd.load_scenario("table2", controller, (inertia, *settings))
    run = sd.simulate(scenario, judge_stability=False)
    return f"{run.accumulated_error:.3g}" if run.stopped is None else f"lost {run.stopped.time:.2f}"


def ablation(*settings: str) -> str:
    """LQR and LQI, as a table for a document."""
    lines = ["| E_ac in % s: LQR, LQI | " + " | ".join(MOTIONS) + " |", "| --- | --- | --- |"]
    for law, options in LAWS.items():
        cells = [
            ", ".join(outcome(c, *motion, *options, *settings) for c in ("delay_lqr", "delay_lqi"))
            for motion in MOTIONS.values()
        ]
        lines.append(f"| {law} | " + " | ".join(cells) + " |")
    return "\n".join(lines)


def main(*settings: str, out: str = "out/table2") -> tuple[dict[str, str], str]:
    """Print the table on every plant, and the ablation, and write them."""
    tables, parts = {}, []
    for kind, plant in PLANTS.items():
        tables[kind] = sd.compare("table2", (*plant, *settings)).table()
        parts.append(f"plant.kind {kind}\n{tables[kind]}\n")
        print(parts[-1], flush=True)
    rows = ablation(*settings)
    print(rows)
    Path(out).mkdir(parents=True, exist_ok=True)
    (Path(out) / "table2.txt").write_text("\n".join([*parts, rows, ""]))
    return tables, rows


if __name__ == "__main__":
    main(*sys.argv[1:])
