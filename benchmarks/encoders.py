"""Motor encoders: estimated offsets, and the time of a step. Errors are in claims.py.

SEEDS of the environment is the number of runs. All runs are on the exact plant, on the reference,
with the paper's motion and delay. Times are the CPU's, of laws in Python.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np
from _bench import EXACT, NARROW, ON, CpuTime, in_parallel, run_sections, section, size, with_own

import stewart_drake as sd
from stewart_drake.law.predictive_lqi import PredictiveLqi
from stewart_drake.loop import sampling
from stewart_drake.loop.diagram import build_closed_loop
from stewart_drake.loop.simulation import make_simulator, simulate

SEEDS = size("SEEDS", 20)
FRESH = 7300
"""First seed, as in the table of claims."""
FINE = ("sensor.samples=100",)
MOUNTED = float(np.deg2rad(0.1))
INSTANTS = (2.0, 5.0, 10.0)


def in_python(law: PredictiveLqi) -> Any:
    """Return the law of a measured state with its observer as that of a user."""
    return with_own(law, "observer")


def median_step(settings: Sequence[str], seed: int) -> float:
    """Return the median CPU time of a step, ms, of the law in Python."""
    sampling.time = CpuTime  # type: ignore[assignment,attr-defined]
    state = "sensor.kind=state" in settings
    encoders = () if state else ("sensor.kind=encoders", f"sensor.seed={seed}")
    scenario = sd.load_scenario("paper", settings=(EXACT, *encoders, *ON, *settings))
    law = in_python if state else None
    result = simulate(scenario, modify_law=law, judge_stability=False)
    return result.summary["controller_step_ms"]["median"]


def remaining_error(seed: int) -> list[float]:
    """Return the largest error in rad of the six offsets at INSTANTS."""
    offsets = MOUNTED * np.random.default_rng(seed).choice([-1.0, 1.0], 6)
    settings = (
        *(EXACT, "sensor.kind=encoders", f"sensor.seed={seed}", *ON),
        f"sensor.offset={offsets.tolist()}",
        "controller.estimate=[torque_bias,payload,damping,offsets]",
        *(*FINE, NARROW),
    )
    loop = build_closed_loop(sd.load_scenario("paper", settings=settings))
    simulator, found = make_simulator(loop), []
    law: Any = loop.GetSubsystemByName("controller")
    for instant in INSTANTS:
        simulator.AdvanceTo(instant)
        belief = law.memory(law.GetMyContextFromRoot(simulator.get_context())).belief
        found.append(float(np.abs(belief.parameters[-6:] - offsets).max()))
    return found


def offsets() -> str:
    """Return the errors that remain of a tenth of a degree at each motor, of either sign."""
    left = in_parallel(remaining_error, [(seed,) for seed in range(FRESH, FRESH + SEEDS)])
    text = ", ".join(
        f"{1e3 * most:.2g} mrad after {t:g} s"
        for t, most in zip(INSTANTS, np.max(left, axis=0), strict=True)
    )
    head = f"Offsets of 0.1 degree, 14 bit, 1 kHz, narrow priors, {SEEDS} seeds"
    return section(head, f"Largest error of an offset, of all legs and seeds: {text}.")


def step_time() -> str:
    """Return times of interleaved runs, so that other load slows all alike."""
    kinds = {"state": ("sensor.kind=state",), "one sample": (), "1 kHz": FINE}
    found: dict[str, list[float]] = {name: [] for name in kinds}
    for seed in range(FRESH, FRESH + min(SEEDS, 5)):
        for name, settings in kinds.items():
            found[name].append(median_step(settings, seed))
    lines = [
        f"- {name}: {np.median(times):.2f} ms, {np.median(np.divide(times, found['state'])):.2f} "
        "times as long as with the state"
        for name, times in found.items()
    ]
    return section("Time per step, CPU, at the median", "\n".join(lines))


if __name__ == "__main__":
    run_sections(__file__, "Motor encoders", {"offsets": offsets, "time": step_time})
