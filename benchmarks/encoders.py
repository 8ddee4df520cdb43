"""Motor encoders instead of the state: `python benchmarks/encoders.py [section ...]`.

Writes benchmarks/results/encoders.md; SEEDS of the environment is the number of runs of a row, each
with encoders whose codes begin elsewhere, FIRST the first seed, JOBS how many run side by side.
Sections: codes, rest, known, unknown, gravity, offsets, faults, delay, time.

All runs are on the exact plant with the paper's motion and delay of 0.8 s, on the reference, with
the shipped priors, where a row says nothing else. "Identified" are standard deviations as a log
leaves them: 6e-5 N m, 10 g and 6e-5 N m s/rad. Times are the CPU's, of laws in Python.
"""

import os
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any, NamedTuple, cast

os.environ.setdefault("OMP_NUM_THREADS", "1")

import numpy as np
from _page import run_sections, size
from joblib import Parallel, delayed

import stewart_drake as sd
from stewart_drake.law.observers import ParameterObserver
from stewart_drake.law.predictive_lqi import PredictiveLqi
from stewart_drake.loop import controller
from stewart_drake.loop.diagram import build_closed_loop
from stewart_drake.loop.simulation import make_simulator, simulate

SEEDS = size("SEEDS", 5)
FRESH = int(os.environ.get("FIRST", "100"))
"""The first seed."""
JOBS = int(os.environ.get("JOBS", "-1"))
ON_REFERENCE = ("start=on_reference", "queue=reference")
FINE = ("sensor.samples=100",)
BIAS = "plant.torque_bias=[3e-4,-3e-4,3e-4,-3e-4,3e-4,-3e-4]"
UNKNOWN = (BIAS, "plant.payload_mass=0.4", "plant.joint_damping=1e-3")
NARROW = "controller.prior={torque_bias: 0.003, payload: 0.5, damping: 0.003}"
IDENTIFIED = "controller.prior={torque_bias: 0.00006, payload: 0.01, damping: 0.00006}"
MOUNTED = float(np.deg2rad(0.1))
Rows = dict[str, tuple[str, ...]]


class CpuTime:
    """In the place of `time` where a step of the law is timed."""

    perf_counter = staticmethod(time.thread_time)


class Outcome(NamedTuple):
    """Of one run."""

    error: float
    """E_ac; NaN for a run that did not complete."""
    missing: int
    frozen: int
    rejected: int
    step: float
    """ms CPU at the median."""


class InPython(ParameterObserver):
    """As it is, but not known to the law in C."""


def in_python(law: PredictiveLqi) -> PredictiveLqi:
    """The law of a measured state in the language of that of encoders."""
    return replace(law, observer=InPython(cast(ParameterObserver, law.observer).settings))


def run(settings: Sequence[str], scenario: str, seed: int) -> Outcome:
    """One run."""
    controller.time = CpuTime  # type: ignore[assignment,attr-defined]
    base = ("plant.kind=exact", "sensor.kind=encoders", f"sensor.seed={seed}")
    state = any(setting == "sensor.kind=state" for setting in settings)
    chosen = (base[0], *settings) if state else (*base, *settings)
    law = in_python if state else None
    result = simulate(
        sd.load_scenario(scenario, settings=chosen), modify_law=law, judge_stability=False
    )
    counts = result.summary["counts"]
    bad = (counts[f"measurements_{cause}"] for cause in ("missing", "frozen", "rejected"))
    return Outcome(result.accumulated_error, *bad, result.summary["controller_step_ms"]["median"])


def collect(title: str, rows: Rows, scenario: str = "paper") -> str:
    """The table of named settings; means over the seeds, and how many runs completed if not all."""
    jobs = [(settings, seed) for settings in rows.values() for seed in range(FRESH, FRESH + SEEDS)]
    ran = iter(Parallel(n_jobs=JOBS)(delayed(run)(s, scenario, seed) for s, seed in jobs))
    lines = ["| | E_ac | least, most | missing, frozen, rejected |", "| --- | --- | --- | --- |"]
    for name in rows:
        found = [next(ran) for _ in range(SEEDS)]
        errors = np.array([one.error for one in found if np.isfinite(one.error)])
        lost = "" if len(errors) == SEEDS else f" ({len(errors)} of {SEEDS} complete)"
        mean, low, high = (f(errors) if len(errors) else np.nan for f in (np.mean, np.min, np.max))
        bad = ", ".join(f"{np.mean([one[i] for one in found]):.3g}" for i in (1, 2, 3))
        lines.append(f"| {name} | {mean:.3g}{lost} | {low:.3g}, {high:.3g} | {bad} |")
    return f"## {title}, {SEEDS} seeds\n\n" + "\n".join(lines) + "\n"


def bits(number: int | None) -> str:
    """The setting of so many bits."""
    return f"sensor.bits={'null' if number is None else number}"


def codes() -> str:
    """On the reference."""
    rows: Rows = {"state measured": ("sensor.kind=state", *ON_REFERENCE)}
    for name, samples in (("one sample", ()), ("1 kHz", FINE)):
        for number in (None, 20, 17, 14, 12):
            what = "exact" if number is None else f"{number} bit"
            rows[f"{what}, {name}"] = (*ON_REFERENCE, bits(number), *samples)
    return collect("Codes, on the reference", rows)


def rest() -> str:
    """From rest."""
    rows: Rows = {"state measured": ("sensor.kind=state",)}
    for name, samples in (("one sample", ()), ("1 kHz", FINE)):
        for number in (None, 14, 12):
            what = "exact" if number is None else f"{number} bit"
            rows[f"{what}, {name}"] = (bits(number), *samples)
    return collect("From rest", rows)


def known() -> str:
    """Narrower priors."""
    rows: Rows = {}
    for name, prior in (("narrow", NARROW), ("identified", IDENTIFIED)):
        for number, samples in ((17, ()), (14, ()), (14, FINE), (12, FINE)):
            often = "1 kHz" if samples else "one sample"
            rows[f"{name}, {number} bit, {often}"] = (
                *ON_REFERENCE,
                bits(number),
                *samples,
                prior,
            )
    return collect("Priors of 3e-3 N m, 0.5 kg, 3e-3 N m s/rad (narrow), and identified", rows)


def unknown() -> str:
    """Bias, payload, damping that nobody tells."""
    rows: Rows = {}
    for name, prior in (("shipped priors", ()), ("narrow priors", (NARROW,))):
        for number in (14, 12):
            rows[f"{number} bit, 1 kHz, {name}"] = (
                *ON_REFERENCE,
                bits(number),
                *FINE,
                *UNKNOWN,
                *prior,
            )
    return collect("Bias 3e-4 N m, payload 0.4 kg and damping 1e-3 N m s/rad unknown", rows)


def gravity() -> str:
    """Where an error of the prediction grows 300 fold within the delay of 0.16 s."""
    rows = {
        f"{number} bit, {name}": (bits(number), *samples)
        for number in (20, 17, 14)
        for name, samples in (("one sample", ()), ("1 kHz", ("sensor.samples=10",)))
    }
    return collect("`gravity`, 10 s", rows, "gravity")


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
    """A tenth of a degree at each motor, of either sign."""
    signs = np.random.default_rng(FRESH).choice([-1.0, 1.0], 6)
    mounted = f"sensor.offset={(MOUNTED * signs).tolist()}"
    rows: Rows = {}
    for name, found in (("not looked for", ""), ("estimated", ",offsets")):
        estimate = f"controller.estimate=[torque_bias,payload,damping{found}]"
        rows[f"14 bit, 1 kHz, {name}"] = (*ON_REFERENCE, *FINE, NARROW, mounted, estimate)
    text = collect("Offsets of 0.1 degree, narrow priors", rows)
    instants = (2.0, 5.0, 10.0)
    seeds = range(FRESH, FRESH + SEEDS)
    left = Parallel(n_jobs=JOBS)(delayed(_left)((*FINE, NARROW), s, instants) for s in seeds)
    told = ", ".join(
        f"{1e3 * most:.2g} mrad after {t:g} s"
        for t, most in zip(instants, np.max(left, axis=0), strict=True)
    )
    return text + f"\nLargest error of an offset, of all legs and seeds: {told}.\n"


def faults() -> str:
    """Of legs and of all of them."""
    rows: Rows = {}
    told = {
        "5 % NaN": "{kind: missing, share: 0.05, from: 0, to: 100}",
        "a leg silent for 1 s": "{kind: missing, leg: 2, from: 4, to: 5}",
        "a leg frozen for 0.4 s": "{kind: frozen, leg: 3, from: 4, to: 4.4}",
        "all silent for 0.5 s": "{kind: missing, from: 4, to: 4.5}",
        "1 % spikes from the first sample on": "{kind: spike, share: 0.01, from: 0, to: 100}",
    }
    for often, samples in (("one sample", ()), ("1 kHz", FINE)):
        rows[f"clean, {often}"] = (*ON_REFERENCE, *samples)
        for name, fault in told.items():
            if samples or "spike" not in fault:
                rows[f"{name}, {often}"] = (*ON_REFERENCE, *samples, f"sensor.faults=[{fault}]")
    return collect("Faults, 14 bit", rows)


def delay() -> str:
    """Believed 0.1 s too short, and found."""
    wrong = ("controller.delay_estimator=constant", "controller.delay_steps=7", *FINE)
    rows = {"on the reference": (*ON_REFERENCE, *wrong), "from rest": wrong}
    return collect("14 bit, 1 kHz, delay believed 0.1 s too short", rows)


def step_time() -> str:
    """Interleaved, so that what else runs on the computer slows all alike."""
    kinds = {"state": ("sensor.kind=state",), "one sample": (), "1 kHz": FINE}
    found: dict[str, list[float]] = {name: [] for name in kinds}
    for seed in range(FRESH, FRESH + SEEDS):
        for name, settings in kinds.items():
            found[name].append(run((*ON_REFERENCE, *settings), "paper", seed).step)
    lines = [
        f"- {name}: {np.median(times):.2f} ms, {np.median(np.divide(times, found['state'])):.2f} "
        "times as long as with the state"
        for name, times in found.items()
    ]
    return "## Time per step, CPU, at the median\n\n" + "\n".join(lines) + "\n"


SECTIONS: dict[str, Callable[[], str]] = {
    "codes": codes,
    "rest": rest,
    "known": known,
    "unknown": unknown,
    "gravity": gravity,
    "offsets": offsets,
    "faults": faults,
    "delay": delay,
    "time": step_time,
}


if __name__ == "__main__":
    run_sections(__file__, "Motor encoders", SECTIONS, sys.argv[1:])
