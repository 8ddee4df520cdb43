"""Tracking with the shipped controllers: figures that claims.py does not have.

Sections: faithful, starts, limit, coverage, gravity.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np
from _bench import EXACT, NONE, ON, PAYLOAD, in_parallel, noise, run_sections, section, table

import stewart_drake as sd
from stewart_drake.loop.results import SimulationResult
from stewart_drake.scenario.signals import PARAMETERS

COVERAGE_SEEDS = range(7400, 7500)
PAPERS = ("lqr", "lqi", "delay_lqr", "delay_lqi")


def run(scenario: str, settings: Sequence[str], controller: str | None = None) -> SimulationResult:
    """Run a scenario."""
    loaded = sd.load_scenario(scenario, controller=controller, settings=settings)
    return sd.simulate(loaded, judge_stability=False)


def runs(cases: Sequence[tuple[Any, ...]]) -> list[SimulationResult]:
    return in_parallel(run, cases)


def outcome(result: SimulationResult) -> str:
    """Return E_ac, or when and why the plate was lost."""
    if result.status == "completed":
        return f"{result.accumulated_error:.3g}"
    assert result.stopped is not None
    where = "parallel singularity" if result.stopped.leg is None else f"leg {result.stopped.leg}"
    return f"left at {result.stopped.time:.2f} s ({where})"


def peak(result: SimulationResult, digits: str = ".3g") -> str:
    return format(result.summary["peak_torque"], digits)


def faithful() -> str:
    """Return the paper's four controllers, without and with the delay."""
    variants = {
        "no delay, from rest": ("delay.steps=0",),
        "no delay, on the reference": ("delay.steps=0", *ON),
        "no delay, from rest, w_R = 0.01": ("delay.steps=0", "controller.w_R=0.01"),
        "0.8 s, from rest": (),
        "0.8 s, on the reference": ON,
        "0.8 s, from rest, true dynamics in the model": ("controller.model=multibody",),
        "0.8 s, amplitudes / 10, true dynamics": (
            "controller.model=multibody",
            "reference.amplitude=[0.02618,0.02618,0.02618,0.002,0.002,0.008]",
        ),
    }
    cases = [(variant, name) for variant in variants for name in PAPERS]
    rows = []
    for case, r in zip(cases, runs([("paper", variants[v], n) for v, n in cases]), strict=True):
        numbers = (r.summary[key] for key in ("cost", "peak_torque", "torque_variation"))
        rows.append([*case, outcome(r), *(f"{x:.3g}" for x in numbers)])
    header = ["condition", "controller", "E_ac", "cost (40)", "peak N m", "variation N m"]
    return section("The paper's four controllers, multibody plant", table(header, rows))


def starts() -> str:
    """Return the paper's experiment on both plants and from both starts, over the time step."""
    plants = {"exact": EXACT}
    plants |= {f"multibody, {h} s": f"plant.time_step={h}" for h in (2e-3, 1e-3, 5e-4, 2e-4)}
    results = runs([("paper", (p, *start)) for p in plants.values() for start in ((), ON)])
    rows = [
        [name, outcome(rest), peak(rest, ".3f"), outcome(moving), peak(moving, ".4f")]
        for name, rest, moving in zip(plants, results[::2], results[1::2], strict=True)
    ]
    header = ["plant", "E_ac from rest", "peak N m", "E_ac on the reference", "peak N m"]
    title = "The paper's experiment, E_ac in % s (floor from rest: 15.16)"
    return section(title, table(header, rows))


def limit() -> str:
    """Return E_ac over the torque limit, catch-up chosen automatically."""
    limits = (0.1, 0.15, 0.2, 0.3, 0.5, 0.7, 1.0, 1.8, 3.0)
    results = runs([("paper", (EXACT, f"actuator.torque_limit={x}")) for x in limits])
    rows = [
        [f"{x:g}", outcome(r), f"{r.summary['peak_torque_applied']:.3f}"]
        for x, r in zip(limits, results, strict=True)
    ]
    header = ["limit N m", "E_ac", "applied peak N m"]
    return section("From rest with limited torque, exact plant", table(header, rows))


def coverage() -> str:
    """Return coverage and width of the final 2-sigma bands, over 100 runs."""
    extra = (EXACT, *ON, PAYLOAD, "plant.joint_damping=3e-4", noise(1e-3))
    biases = [
        (3e-4 * np.random.default_rng(seed).choice([-1.0, 1.0], 6)).tolist()
        for seed in COVERAGE_SEEDS
    ]
    truth = np.array([[*bias, 0.4, 3e-4] for bias in biases])
    results = runs(
        [
            ("paper", (*extra, f"plant.torque_bias={bias}", f"sensor.seed={seed}"))
            for seed, bias in zip(COVERAGE_SEEDS, biases, strict=True)
        ]
    )
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
    words = (
        "Noise 0.1 %, bias 3e-4 N m with random signs, payload 0.4 kg, damping 3e-4 N m s/rad. "
        "A consistent filter has 95 % inside and a ratio of 1. More inside is caution, not "
        "accuracy: the stated deviations are too large by the last column."
    )
    title = f"Final 2-sigma bands over 100 noisy runs ({len(kept)} completed), exact plant"
    header = ["parameter", "truth inside", "rms error", "stated", "stated / rms"]
    return section(title, words, table(header, rows))


def gravity() -> str:
    """Return runs at full amplitude under gravity, 10 ms samples, 0.16 s delay."""
    variants = {
        "exact": (EXACT,),
        "exact, no estimator": (EXACT, NONE),
        "multibody, 1 ms": (),
        "multibody, 1 ms, no estimator": (NONE,),
        "multibody, 0.1 ms": ("plant.time_step=1e-4",),
    }
    results = runs([("gravity", settings) for settings in variants.values()])
    rows = [[name, outcome(r), peak(r)] for name, r in zip(variants, results, strict=True)]
    return section(
        "Scenario `gravity`, on the reference", table(["plant", "E_ac", "peak N m"], rows)
    )


SECTIONS = {
    "faithful": faithful,
    "starts": starts,
    "limit": limit,
    "coverage": coverage,
    "gravity": gravity,
}


if __name__ == "__main__":
    run_sections(__file__, "Tracking", SECTIONS)
