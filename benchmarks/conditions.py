"""A wrongly believed delay under twenty conditions that nothing was tuned for.

Other machines, periods and motions, the delay believed a quarter too short or too long, with the
estimator (`adaptive_lqi`) and without (`predictor_lqi`). All on the exact plant.
"""

from _bench import EXACT, ON, CpuTime, believed, grouped, table, write

import stewart_drake as sd
from stewart_drake.loop import sampling

SCALED = "reference.amplitude=[0.13,0.13,0.13,0.01,0.01,0.04]"

# Scenario, settings, description. The true delay is the scenario's.
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
KINDS = [(name, f) for name in ("adaptive_lqi", "predictor_lqi") for f in (0.75, 1.25, 1.0)]
ABOUT = (
    "E_ac in % s; in brackets the slowest step with the estimator, CPU time. Believed are three "
    "and five quarters of the true delay, or itself."
)


def run(number: int, controller: str, factor: float) -> str:
    """Return E_ac in % s, or how the run ended."""
    sampling.time = CpuTime  # type: ignore[assignment,attr-defined]
    name, settings, _ = CONDITIONS[number]
    scenario = sd.load_scenario(name, controller, (EXACT, *settings))
    belief = believed(factor * scenario.eta, scenario.controller.period)
    scenario = sd.load_scenario(name, controller, (EXACT, *settings, *belief))
    result = sd.simulate(scenario, judge_stability=False)
    if result.stopped is not None:
        return f"left at {result.stopped.time:.2f} s"
    worst = result.summary["controller_step_ms"]["worst"]
    step = f" ({worst:.0f} ms)" if controller == "adaptive_lqi" else ""
    return f"{result.accumulated_error:.3g}{step}"


def main() -> None:
    numbers = range(len(CONDITIONS))
    found = grouped(run, {k: [(k, *kind) for kind in KINDS] for k in numbers})
    heads = ["estimated, 3/4", "5/4", "right", "taken for known, 3/4", "5/4", "right"]
    rows = [[f"`{CONDITIONS[k][0]}`", CONDITIONS[k][2], *found[k]] for k in numbers]
    title = "A wrongly believed delay, conditions that nothing was tuned for"
    write(__file__, title, [ABOUT, table(["scenario", "condition", *heads], rows)])


if __name__ == "__main__":
    main()
