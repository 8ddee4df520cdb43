"""An unknown, drifting, jumping delay: `python benchmarks/delay_estimator.py [section ...]`.

Writes benchmarks/results/delay_estimator.md; SEEDS and COVERED of the environment are the
numbers of runs. Sections: constant, dirty, changing, coverage, limits, network. The error of the
delay is against that of the torque sent last, which where it changes is not that of what arrives.
"Dirty" is noise of 0.1 % of the amplitudes (per second, for the rates), a torque bias of 3e-4 N m
of alternating sign and a payload of a tenth of the plate. All runs are on the exact plant with the
paper's motion and a true delay of 0.8 s where the row says nothing else. Times are the CPU's.
"""

import os
import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

os.environ.setdefault("OMP_NUM_THREADS", "1")

import numpy as np
from joblib import Parallel, delayed

import stewart_drake as sd
from stewart_drake.files.versions import versions
from stewart_drake.loop import controller
from stewart_drake.loop.simulation import simulate

RESULTS = Path(__file__).parent / "results"
AMPLITUDES = np.tile([0.2617993878] * 3 + [0.02, 0.02, 0.08], 2)
ON_REFERENCE = ("start=on_reference", "queue=reference")
SEEDS = int(os.environ.get("SEEDS", "20"))
COVERED = int(os.environ.get("COVERED", "200"))
FRESH = 100
"""The first seed; those below were looked at while the law was made."""
FRESH_SEEDS = range(FRESH, FRESH + SEEDS)


Case = tuple[Any, ...]
"""Kind of estimator, settings, and the scenario's name if it is not `paper`."""
Cases = dict[str, list[Case]]


class CpuTime:
    """In the place of `time` where a step of the law is timed."""

    perf_counter = staticmethod(time.thread_time)


class Outcome(NamedTuple):
    """Of one run."""

    error: float
    """E_ac; NaN for a run that did not complete."""
    late: float
    """s, last estimate of the delay minus its true value."""
    std: float
    """s, as stated."""
    worst: float
    """ms CPU of the slowest step."""


def dirty(seed: int) -> tuple[str, ...]:
    """Settings of a dirty run."""
    std = ",".join(f"{1e-3 * a:.10g}" for a in AMPLITUDES)
    bias = "plant.torque_bias=[3e-4,-3e-4,3e-4,-3e-4,3e-4,-3e-4]"
    noise = (f"sensor.noise_std=[{std}]", f"sensor.seed={seed}")
    return (*noise, bias, "plant.payload_mass=0.4")


def believed(eta: float) -> tuple[str, ...]:
    """Settings of a belief in s."""
    steps = int(eta / 0.1 + 1e-9)
    fraction = max(round(eta / 0.1 - steps, 9), 0.0)
    return f"controller.delay_steps={steps}", f"controller.delay_fraction={fraction}"


def run(kind: str, settings: Sequence[str], scenario: str = "paper") -> Outcome:
    """One run."""
    controller.time = CpuTime  # type: ignore[assignment,attr-defined]
    chosen = ("plant.kind=exact", f"controller.delay_estimator={kind}", *settings)
    result = simulate(sd.load_scenario(scenario, settings=chosen), margin=False)
    signals = result.signals
    late = float(signals.delay_estimate[-1] - signals.delay_true[-1])
    worst = result.summary["controller_step_ms"]["worst"]
    return Outcome(result.accumulated_error, late, float(signals.delay_std[-1]), worst)


def runs(cases: Sequence[Case]) -> list[Outcome]:
    """Runs on all cores, in order."""
    return Parallel(n_jobs=-1)(delayed(run)(*case) for case in cases)


def table(title: str, rows: dict[str, list[Outcome]]) -> str:
    """Mean over the seeds of a row; the number that completed, if not all."""
    head = ("condition", "E_ac", "error of the delay ms", "stated ms", "slowest step ms")
    lines = [" | ".join(head), " | ".join("---" for _ in head)]
    for name, found in rows.items():
        done = [one for one in found if np.isfinite(one.error)]
        lost = "" if len(done) == len(found) else f" ({len(done)} of {len(found)} complete)"
        mean = np.mean([one.error for one in done]) if done else np.nan
        late = 1e3 * np.sqrt(np.mean([one.late**2 for one in done])) if done else np.nan
        std = 1e3 * np.mean([one.std for one in done]) if done else np.nan
        worst = max(one.worst for one in found)
        lines.append(f"{name} | {mean:.3g}{lost} | {late:.2g} | {std:.2g} | {worst:.0f}")
    return f"## {title}\n\n" + "\n".join(f"| {line} |" for line in lines) + "\n"


def collect(title: str, cases: Cases) -> str:
    """The table of named lists of cases."""
    found = iter(runs([case for of_row in cases.values() for case in of_row]))
    return table(title, {name: [next(found) for _ in of] for name, of in cases.items()})


def constant() -> str:
    """A delay that is constant and believed wrongly, without noise."""
    cases: Cases = {}
    for eta in (0.8, 0.6, 1.0, 0.2, 1.4):
        cases[f"from rest, believed {eta} s"] = [("constant", believed(eta))]
    for eta in (0.8, 0.5, 1.1, 0.2, 1.4):
        cases[f"on the reference, believed {eta} s"] = [
            ("constant", (*ON_REFERENCE, *believed(eta)))
        ]
    for name, where in (("from rest", ()), ("on the reference", ON_REFERENCE)):
        cases[f"{name}, known"] = [("none", where)]
    return collect("Constant, clean", cases)


def dirty_runs() -> str:
    """The same with noise, bias and payload."""
    cases: Cases = {}
    slow = "controller.catch_up=1.0"
    rows = {
        f"on the reference, believed {eta} s": ("constant", (*ON_REFERENCE, *believed(eta)))
        for eta in (0.8, 0.5, 1.1)
    }
    rows["from rest, believed 0.6 s, catch-up 1.0 s"] = ("constant", (*believed(0.6), slow))
    rows["on the reference, known"] = ("none", ON_REFERENCE)
    rows["from rest, known, catch-up 1.0 s"] = ("none", (slow,))
    rows["the same without the quiet start"] = ("none", (slow, "controller.quiet_start=false"))
    for name, (kind, settings) in rows.items():
        cases[name] = [(kind, (*settings, *dirty(seed))) for seed in FRESH_SEEDS]
    return collect(f"Constant, dirty, {SEEDS} seeds", cases)


def changing() -> str:
    """Drift, swing, jumps, jitter, on the reference."""
    ramp: Case = ("drifting", (*ON_REFERENCE, "delay.drift=0.01"))
    swing: Case = ("drifting", (*ON_REFERENCE, "delay.swing=0.02"))
    cases: Cases = {
        "0.8 to 0.9 s in 10 s": [ramp],
        "20 ms at 1 rad/s": [swing],
    }
    seeds = FRESH_SEEDS
    cases["0.8 to 0.9 s, dirty"] = [(ramp[0], (*ramp[1], *dirty(seed))) for seed in seeds]
    for jump in (0.1, -0.1, 0.05, 0.3):
        at_four = (*ON_REFERENCE, f"delay.jump={jump}", "delay.jump_time=4")
        cases[f"jump of {jump:+g} s at 4 s"] = [("constant", at_four)]
        if abs(jump) == 0.1:
            cases[f"jump of {jump:+g} s, dirty"] = [
                ("constant", (*at_four, *dirty(seed))) for seed in seeds
            ]
    for std in (0.001, 0.003, 0.01):
        jitter = (*ON_REFERENCE, f"delay.jitter_std={std}")
        cases[f"jitter of {1e3 * std:g} ms"] = [
            ("constant", (*jitter, f"delay.seed={seed}")) for seed in seeds
        ]
    return collect("Changing", cases)


def coverage() -> str:
    """How often the stated 95 % band has the true delay, of delays and beliefs drawn at random."""
    rng, text = np.random.default_rng(FRESH), "## Coverage of the stated 95 % band\n\n"
    for kind in ("constant", "drifting"):
        cases = []
        for seed in range(FRESH, FRESH + COVERED):
            eta, guess = rng.uniform(0.6, 1.0), rng.uniform(0.6, 1.0)
            true = (f"delay.steps={int(10 * eta)}", f"delay.fraction={10 * eta % 1:.9f}")
            settings = (*ON_REFERENCE, *believed(guess), *true, *dirty(seed), "duration=5")
            cases.append((kind, settings))
        found = [one for one in runs(cases) if np.isfinite(one.error)]
        ratio = np.array([one.late / one.std for one in found])
        inside = np.mean(np.abs(ratio) <= 1.96)
        text += (
            f"- {kind}: {100 * inside:.1f} % of {len(found)} runs that completed, of {COVERED}; "
            f"deviations of {np.mean(ratio):+.2f} +- {np.std(ratio):.2f} times what is stated\n"
        )
    return text


def limits() -> str:
    """Gravity, where an error of the prediction grows by e^(p eta), 300 here in 0.16 s."""
    cases: Cases = {}
    for periods in (16, 15, 17, 12, 20):
        for kind in ("none", "constant"):
            settings = (f"controller.delay_steps={periods}", "duration=4")
            cases[f"believed {periods / 100:g} s, {kind}"] = [(kind, settings, "gravity")]
    return collect("Gravity, 0.16 s, period 10 ms, 4 s", cases)


def network() -> str:
    """Packets under way for 0.5 to 0.9 s, played out after 0.9 s, the delay known."""
    usual = ("link.kind=network", "link.playout=0.9")
    rows: dict[str, tuple[tuple[str, ...], bool]] = {
        "5 % lost": ((*ON_REFERENCE, "link.loss=0.05"), False),
        "5 % lost, dirty": ((*ON_REFERENCE, "link.loss=0.05"), True),
        "20 % lost": ((*ON_REFERENCE, "link.loss=0.2"), False),
        "20 % lost, dirty": ((*ON_REFERENCE, "link.loss=0.2"), True),
        "5 % lost, from rest, dirty, catch-up 1.0 s": (
            ("link.loss=0.05", "controller.catch_up=1.0"),
            True,
        ),
        "5 % lost, without plans": (
            (*ON_REFERENCE, "link.loss=0.05", "controller.packet_torques=1"),
            False,
        ),
    }
    cases: Cases = {
        name: [
            ("none", (*usual, *settings, f"link.seed={seed}", *(dirty(seed) if more else ())))
            for seed in FRESH_SEEDS
        ]
        for name, (settings, more) in rows.items()
    }
    half = (*ON_REFERENCE, "sensor.loss=0.5")
    cases["wire, half of the measurements lost, dirty"] = [
        ("none", (*half, *dirty(seed))) for seed in FRESH_SEEDS
    ]
    return collect(f"Network, one repeat, {SEEDS} seeds", cases)


SECTIONS: dict[str, Callable[[], str]] = {
    "constant": constant,
    "dirty": dirty_runs,
    "changing": changing,
    "coverage": coverage,
    "limits": limits,
    "network": network,
}


def main(names: Sequence[str]) -> None:
    """Run sections and print them; all of them are written."""
    used: Any = ", ".join(f"{name} {release}" for name, release in versions().items())
    texts = []
    for name in names or SECTIONS:
        texts.append(SECTIONS[name]())
        print(texts[-1], flush=True)
    if not names:
        head = f"# Unknown delay\n\nMade by `python benchmarks/delay_estimator.py` with {used}.\n\n"
        (RESULTS / "delay_estimator.md").write_text(head + "\n\n".join(texts))


if __name__ == "__main__":
    main(sys.argv[1:])
