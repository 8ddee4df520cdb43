"""A delay believed wrongly under twenty conditions that nothing was tuned for.

`python benchmarks/conditions.py` writes benchmarks/results/conditions.md: other machines, periods
and motions, the delay believed a quarter too short or too long, with the estimator
(`adaptive_lqi`) and without (`predictor_lqi`). All on the exact plant.
"""

import math
import os

os.environ.setdefault("OMP_NUM_THREADS", "1")

from _page import RESULTS
from delay_estimator import CpuTime
from joblib import Parallel, delayed

import stewart_drake as sd
from stewart_drake.files.versions import versions
from stewart_drake.loop import controller as step_timer

SCALED = "reference.amplitude=[0.13,0.13,0.13,0.01,0.01,0.04]"
ON = ("start=on_reference", "queue=reference")

# Scenario, settings, what they are. The true delay is the scenario's.
CONDITIONS = (
    ("desktop", (), "camera tour, gravity, 0.06 s of 0.02 s periods"),
    ("desktop", ("delay.steps=5",), "the same, 0.1 s"),
    ("desktop", ("controller.period=0.01", "delay.steps=6"), "the same, 0.06 s of 0.01 s periods"),
    ("motion_base", (), "rough road (CSV), gravity, 0.1 s of 0.02 s periods"),
    ("motion_base", ("delay.steps=3",), "the same, 0.06 s"),
    ("motion_base", ("controller.period=0.05", "delay.steps=2"), "the same, 0.05 s periods"),
    ("gravity", (), "paper's motion, gravity, 0.16 s of 0.01 s periods"),
    ("gravity", ("controller.period=0.02", "delay.steps=6"), "the same, 0.12 s of 0.02 s periods"),
    ("paper", (*ON, "controller.period=0.05", "delay.steps=16"), "0.05 s periods"),
    ("paper", ("controller.period=0.05", "delay.steps=16"), "0.05 s periods, from rest"),
    ("paper", (*ON, "controller.period=0.02", "delay.steps=20"), "0.4 s of 0.02 s periods"),
    ("paper", ("controller.period=0.02", "delay.steps=20"), "the same, from rest"),
    ("paper", (*ON, SCALED), "half the motion"),
    ("paper", (SCALED,), "half the motion, from rest"),
    ("paper", (*ON, SCALED, "reference.frequency=2"), "half the motion, twice as fast"),
    ("paper", (*ON, "delay.steps=4"), "0.4 s"),
    ("paper", ("delay.steps=4",), "0.4 s, from rest"),
    ("paper", (*ON, "delay.steps=11"), "1.1 s"),
    ("paper", (*ON, "delay.fraction=0.37"), "0.837 s"),
    ("paper", (*ON, "plant.joint_damping=1e-3", "plant.payload_mass=0.3"), "friction, payload"),
)


def run(number: int, controller: str, factor: float) -> str:
    """E_ac in % s, or how the run ended."""
    step_timer.time = CpuTime  # type: ignore[assignment,attr-defined]
    name, settings, _ = CONDITIONS[number]
    chosen = ("plant.kind=exact", *settings)
    scenario = sd.load_scenario(name, controller, chosen)
    periods = factor * scenario.true_delay.periods
    steps = math.floor(periods + 1e-9)
    believed = (
        f"controller.delay_steps={steps}",
        f"controller.delay_fraction={max(0.0, round(periods - steps, 9))}",
    )
    result = sd.simulate(
        sd.load_scenario(name, controller, (*chosen, *believed)), judge_stability=False
    )
    if result.stopped is not None:
        return f"left at {result.stopped.time:.2f} s"
    worst = result.summary["controller_step_ms"]["worst"]
    return f"{result.accumulated_error:.3g}" + (
        f" ({worst:.0f} ms)" if controller[0] == "a" else ""
    )


def main() -> None:
    """Write the table."""
    kinds = [("adaptive_lqi", 0.75), ("adaptive_lqi", 1.25), ("adaptive_lqi", 1.0)]
    kinds += [("predictor_lqi", 0.75), ("predictor_lqi", 1.25), ("predictor_lqi", 1.0)]
    jobs = (delayed(run)(k, *kind) for k in range(len(CONDITIONS)) for kind in kinds)
    found = iter(Parallel(n_jobs=-1)(jobs))
    heads = ["estimated, 3/4", "5/4", "right", "taken for known, 3/4", "5/4", "right"]
    lines = [" | ".join(["scenario", "condition", *heads]), " | ".join(["---"] * 8)]
    for name, _, words in CONDITIONS:
        lines.append(" | ".join([f"`{name}`", words, *(next(found) for _ in kinds)]))
    about = ", ".join(f"{name} {version}" for name, version in versions().items())
    text = "# A delay believed wrongly, conditions that nothing was tuned for\n\n"
    text += f"Made by `python benchmarks/conditions.py` with {about}.\n\n"
    text += "E_ac in % s; behind it the slowest step with the estimator, CPU time. "
    text += "Believed are three and five quarters of the true delay, or itself.\n\n"
    text += "\n".join(f"| {line} |" for line in lines) + "\n"
    RESULTS.mkdir(parents=True, exist_ok=True)
    (RESULTS / "conditions.md").write_text(text, encoding="utf-8")
    print(text)


if __name__ == "__main__":
    main()
