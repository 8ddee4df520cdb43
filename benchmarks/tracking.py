"""Tracking figures of README and docs/figures.md: `python benchmarks/tracking.py [section ...]`.

Writes benchmarks/results/tracking.md. Sections: faithful, starts, limit, coverage, gravity. All
runs use `predictor_lqi` unless the row says otherwise. What is unknown, noisy or late is in
benchmarks/claims.py.
"""

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from _bench import run_sections
from _bench import table as plain_table
from joblib import Parallel, delayed

import stewart_drake as sd
from stewart_drake.loop.results import SimulationResult
from stewart_drake.scenario.signals import PARAMETERS

EXACT = "plant.kind=exact"
ON_REFERENCE = ("start=on_reference", "queue=reference")
PAYLOAD = "plant.payload_mass=0.4"
NONE = "controller.estimate=[]"
COVERAGE_SEEDS = range(7400, 7500)
AMPLITUDES = np.array([0.2617993878] * 3 + [0.02, 0.02, 0.08])


def noise(share: float, seed: int = 0) -> tuple[str, str]:
    """Settings for sensor noise of a share of the amplitudes (per second, for the rates)."""
    std = ",".join(f"{share * a:.10g}" for a in np.tile(AMPLITUDES, 2))
    return f"sensor.noise_std=[{std}]", f"sensor.seed={seed}"


def run(scenario: str, settings: Sequence[str], controller: str | None = None) -> SimulationResult:
    """One run."""
    asked = sd.load_scenario(scenario, controller=controller, settings=settings)
    return sd.simulate(asked, judge_stability=False)


def runs(cases: Sequence[tuple[Any, ...]]) -> list[SimulationResult]:
    """Runs on all cores, in order."""
    return Parallel(n_jobs=-1)(delayed(run)(*case) for case in cases)


def outcome(result: SimulationResult) -> str:
    """E_ac, or when and why there is none."""
    if result.status == "completed":
        return f"{result.accumulated_error:.3g}"
    assert result.stopped is not None
    where = "parallel singularity" if result.stopped.leg is None else f"leg {result.stopped.leg}"
    return f"left at {result.stopped.time:.2f} s ({where})"


def table(title: str, header: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """A Markdown table under a heading."""
    return f"## {title}\n\n{plain_table(header, rows)}"


def faithful() -> str:
    """The paper's four controllers, without and with the delay, and what stops them."""
    variants = {
        "no delay, from rest": ("delay.steps=0",),
        "no delay, on the reference": ("delay.steps=0", *ON_REFERENCE),
        "no delay, from rest, w_R = 0.01": ("delay.steps=0", "controller.w_R=0.01"),
        "0.8 s, from rest": (),
        "0.8 s, on the reference": ON_REFERENCE,
        "0.8 s, from rest, true dynamics in the model": ("controller.model=multibody",),
        "0.8 s, amplitudes / 10, true dynamics": (
            "controller.model=multibody",
            "reference.amplitude=[0.02618,0.02618,0.02618,0.002,0.002,0.008]",
        ),
    }
    rows = []
    names = ("lqr", "lqi", "delay_lqr", "delay_lqi")
    results = iter(runs([("paper", v, name) for v in variants.values() for name in names]))
    for variant in variants:
        for name in names:
            r = next(results)
            numbers = (r.summary[key] for key in ("cost", "peak_torque", "torque_variation"))
            rows.append([variant, name, outcome(r), *(f"{x:.3g}" for x in numbers)])
    header = ["condition", "controller", "E_ac", "cost (40)", "peak N m", "variation N m"]
    return table("The paper's four controllers, multibody plant", header, rows)


def starts() -> str:
    """The paper's experiment on both plants and from both starts, against the time step."""
    plants = [(EXACT, "exact")]
    plants += [(f"plant.time_step={h}", f"multibody, {h} s") for h in (2e-3, 1e-3, 5e-4, 2e-4)]
    cases = [("paper", (p, *start)) for p, _ in plants for start in ((), ON_REFERENCE)]
    results = runs(cases)
    rows = [
        [
            name,
            outcome(rest),
            f"{rest.summary['peak_torque']:.3f}",
            outcome(moving),
            f"{moving.summary['peak_torque']:.4f}",
        ]
        for (_, name), rest, moving in zip(plants, results[::2], results[1::2], strict=True)
    ]
    header = ["plant", "E_ac from rest", "peak N m", "E_ac on the reference", "peak N m"]
    return table("The paper's experiment, E_ac in % s (floor from rest: 15.16)", header, rows)


def limit() -> str:
    """E_ac against the torque limit, catch-up chosen automatically."""
    limits = (0.1, 0.15, 0.2, 0.3, 0.5, 0.7, 1.0, 1.8, 3.0)
    results = runs([("paper", (EXACT, f"actuator.torque_limit={x}")) for x in limits])
    rows = [
        [f"{x:g}", outcome(r), f"{r.summary['peak_torque_applied']:.3f}"]
        for x, r in zip(limits, results, strict=True)
    ]
    return table(
        "From rest with limited torque, exact plant",
        ["limit N m", "E_ac", "applied peak N m"],
        rows,
    )


def coverage() -> str:
    """How often the final 2-sigma bands hold the truth, and how wide they are, over 100 runs."""
    extra = (EXACT, *ON_REFERENCE, PAYLOAD, "plant.joint_damping=3e-4")
    signs = [np.random.default_rng(seed).choice([-1.0, 1.0], 6) for seed in COVERAGE_SEEDS]
    truth = np.array([[*(3e-4 * sign), 0.4, 3e-4] for sign in signs])
    cases = []
    for seed, sign in zip(COVERAGE_SEEDS, signs, strict=True):
        bias = f"plant.torque_bias={(3e-4 * sign).tolist()}"
        cases.append(("paper", (*extra, bias, *noise(1e-3, seed))))
    results = runs(cases)
    done = np.array([r.status == "completed" for r in results])
    kept = [r.signals for r in results if r.status == "completed"]
    error = np.array([s.parameters.values[-1] for s in kept]) - truth[done]
    std = np.array([s.parameter_std.values[-1] for s in kept])
    inside = np.abs(error) <= 2 * std
    rms, stated = np.sqrt(np.mean(error**2, axis=0)), np.sqrt(np.mean(std**2, axis=0))
    rows = [
        [
            name,
            f"{100 * inside[:, i].mean():.0f} %",
            f"{rms[i]:.2e}",
            f"{stated[i]:.2e}",
            f"{stated[i] / rms[i]:.1f}",
        ]
        for i, name in enumerate(PARAMETERS)
    ]
    rows.append(["all eight", f"{100 * inside.all(axis=1).mean():.0f} %", "", "", ""])
    title = f"Final 2-sigma bands over 100 noisy runs ({len(kept)} completed), exact plant"
    header = ["parameter", "truth inside", "rms error", "stated", "stated / rms"]
    words = (
        "Noise 0.1 %, bias 3e-4 N m with random signs, payload 0.4 kg, damping 3e-4 N m s/rad. "
        "A consistent filter has 95 % inside and a ratio of 1. More inside is caution, not "
        "accuracy: the stated deviations are too large by the last column."
    )
    head, body = table(title, header, rows).split("\n\n", 1)
    return f"{head}\n\n{words}\n\n{body}"


def gravity() -> str:
    """Full amplitude under gravity, 10 ms samples, 0.16 s delay."""
    variants = {
        "exact": (EXACT,),
        "exact, no estimator": (EXACT, NONE),
        "multibody, 1 ms": (),
        "multibody, 1 ms, no estimator": (NONE,),
        "multibody, 0.1 ms": ("plant.time_step=1e-4",),
    }
    results = runs([("gravity", settings) for settings in variants.values()])
    rows = [
        [name, outcome(r), f"{r.summary['peak_torque']:.3g}"]
        for name, r in zip(variants, results, strict=True)
    ]
    return table("Scenario `gravity`, on the reference", ["plant", "E_ac", "peak N m"], rows)


SECTIONS: dict[str, Callable[[], str]] = {
    "faithful": faithful,
    "starts": starts,
    "limit": limit,
    "coverage": coverage,
    "gravity": gravity,
}


if __name__ == "__main__":
    run_sections(__file__, "Tracking", SECTIONS)
