"""Motor encoders: offsets that are found, and the time of a step. Errors are in claims.py.

`python benchmarks/encoders.py [offsets] [time]` writes benchmarks/results/encoders.md. SEEDS of the
environment is the number of runs, JOBS how many run side by side. All runs are on the exact plant,
on the reference, with the paper's motion and delay. Times are the CPU's, of laws in Python.
"""

import os
import sys
import time
from collections.abc import Sequence
from dataclasses import replace
from typing import Any, cast

os.environ.setdefault("OMP_NUM_THREADS", "1")

import numpy as np
from _page import run_sections, size
from joblib import Parallel, delayed

import stewart_drake as sd
from stewart_drake.law.observers import CoreObserver
from stewart_drake.law.predictive_lqi import PredictiveLqi
from stewart_drake.loop import sampling
from stewart_drake.loop.diagram import build_closed_loop
from stewart_drake.loop.simulation import make_simulator, simulate

SEEDS = size("SEEDS", 20)
FRESH = 7300
"""First seed, as in the table of claims."""
JOBS = int(os.environ.get("JOBS", "-1"))
ON_REFERENCE = ("start=on_reference", "queue=reference")
FINE = ("sensor.samples=100",)
NARROW = "controller.prior={torque_bias: 0.003, payload: 0.5, damping: 0.003}"
MOUNTED = float(np.deg2rad(0.1))


class CpuTime:
    """In the place of `time` where a step of the law is timed."""

    perf_counter = staticmethod(time.thread_time)


class InPython(CoreObserver):
    """As it is, but not known to the law in C."""


def in_python(law: PredictiveLqi) -> PredictiveLqi:
    """The law of a measured state in the language of that of encoders."""
    return replace(law, observer=InPython(cast(CoreObserver, law.observer).settings))


def median_step(settings: Sequence[str], seed: int) -> float:
    """Return the median CPU time of a step, ms, of the law in Python."""
    sampling.time = CpuTime  # type: ignore[assignment,attr-defined]
    base = ("plant.kind=exact", "sensor.kind=encoders", f"sensor.seed={seed}", *ON_REFERENCE)
    state = any(setting == "sensor.kind=state" for setting in settings)
    chosen = (base[0], *ON_REFERENCE, *settings) if state else (*base, *settings)
    law = in_python if state else None
    scenario = sd.load_scenario("paper", settings=chosen)
    result = simulate(scenario, modify_law=law, judge_stability=False)
    return result.summary["controller_step_ms"]["median"]


def _left(settings: Sequence[str], seed: int, instants: Sequence[float]) -> list[float]:
    """Largest error in rad of the six offsets at instants, s."""
    signs = np.random.default_rng(seed).choice([-1.0, 1.0], 6)
    offsets = MOUNTED * signs
    mounted = (
        f"sensor.offset={offsets.tolist()}",
        "controller.estimate=[torque_bias,payload,damping,offsets]",
    )
    base = ("plant.kind=exact", "sensor.kind=encoders", f"sensor.seed={seed}", *ON_REFERENCE)
    loop = build_closed_loop(sd.load_scenario("paper", settings=(*base, *mounted, *settings)))
    simulator, found = make_simulator(loop), []
    law: Any = loop.GetSubsystemByName("controller")
    for instant in instants:
        simulator.AdvanceTo(instant)
        belief = law.memory(law.GetMyContextFromRoot(simulator.get_context())).belief
        found.append(float(np.abs(belief.parameters[-6:] - offsets).max()))
    return found


def offsets() -> str:
    """Return what is left of a tenth of a degree at each motor, of either sign."""
    instants = (2.0, 5.0, 10.0)
    seeds = range(FRESH, FRESH + SEEDS)
    left = Parallel(n_jobs=JOBS)(delayed(_left)((*FINE, NARROW), s, instants) for s in seeds)
    told = ", ".join(
        f"{1e3 * most:.2g} mrad after {t:g} s"
        for t, most in zip(instants, np.max(left, axis=0), strict=True)
    )
    head = f"## Offsets of 0.1 degree, 14 bit, 1 kHz, narrow priors, {SEEDS} seeds"
    return f"{head}\n\nLargest error of an offset, of all legs and seeds: {told}.\n"


def step_time() -> str:
    """Interleaved, so that what else runs on the computer slows all alike."""
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
    return "## Time per step, CPU, at the median\n\n" + "\n".join(lines) + "\n"


SECTIONS = {"offsets": offsets, "time": step_time}


if __name__ == "__main__":
    run_sections(__file__, "Motor encoders", SECTIONS, sys.argv[1:])
