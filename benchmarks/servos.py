"""Position servos beside laws that close their loop across the delay, under the same conditions.

`python benchmarks/servos.py` writes benchmarks/results/servos.md, on the exact plant: bandwidths,
an unknown delay, a machine that is not as drawn, a push, and the torques that all this takes.
"""

import os
from dataclasses import replace
from functools import partial

os.environ.setdefault("OMP_NUM_THREADS", "1")

import numpy as np
from _page import RESULTS
from _push import Push
from joblib import Parallel, delayed

import stewart_drake as sd
from stewart_drake.files.versions import versions
from stewart_drake.scenario.loading import load_compatible

EXACT, GRAVITY = ("plant.kind=exact",), ("plant.gravity=true",)
ON, REST = ("start=on_reference", "queue=reference"), ()
BELIEVED = {
    "0.7 s": ("controller.delay_steps=7",),
    "0.8 s": (),
    "0.9 s": ("controller.delay_steps=9",),
}
CONDITIONS = {
    "on the reference": ON,
    "from rest": REST,
    "gravity": (*ON, *GRAVITY),
}
TOLERANCES = {"p_WS": 3e-4, "p_PQ": 3e-4, "crank_lengths": 1e-4, "rod_lengths": 2e-4}
"""m, standard deviations of a machine from its drawing."""
MACHINES = range(101, 106)
SERVOS = ("servo_preview", "servo_feedforward")
LAWS = ("predictor_lqi", "adaptive_lqi")
KNOWN = "controller.estimate=[]"
PUSH = partial(Push, (1.0, 0.0, 0.0), (4.0, np.inf))
"""1 N along x from t = 4 s on."""


def as_built(seed: int) -> sd.Mechanism:
    """A machine within TOLERANCES."""
    drawn, rng = sd.load_mechanism("paper"), np.random.default_rng(seed)
    off = {
        name: getattr(drawn, name) + std * rng.standard_normal(getattr(drawn, name).shape)
        for name, std in TOLERANCES.items()
    }
    return replace(drawn, **off)


def run(
    controller: str, settings: tuple[str, ...], machine: int | None = None, pushed: bool = False
) -> tuple[float, float]:
    """E_ac in % s, infinite for a lost run, and the largest torque in N m."""
    servo = ("actuator.kind=servo",) if controller in SERVOS else ()
    scenario = load_compatible("paper", controller, (*EXACT, *servo, *settings))
    result = sd.simulate(
        scenario,
        true_mechanism=None if machine is None else as_built(machine),
        disturbance=PUSH if pushed else None,
        judge_stability=False,
    )
    peak = result.summary["peak_torque_applied"]
    return (np.inf if result.stopped else result.accumulated_error), peak


def number(value: float) -> str:
    """Three digits, or lost."""
    return f"{value:.3g}" if np.isfinite(value) else "lost"


class Table:
    """Runs that are asked for while rows are written, and done together."""

    def __init__(self) -> None:
        self.asked: dict[tuple, tuple[float, float]] = {}

    def done(self) -> None:
        """Do them."""
        jobs = [key for key, found in self.asked.items() if not found]
        pool = Parallel(n_jobs=int(os.environ.get("JOBS", "2")))
        results = pool(delayed(run)(*key) for key in jobs)
        self.asked |= dict(zip(jobs, results, strict=True))

    def __call__(self, *key: object) -> tuple[float, float]:
        """What a run gave, zeros until it is done."""
        return self.asked.setdefault(key, ()) or (0.0, 0.0)


def lines(heads: list[str], rows: list[list[str]]) -> str:
    """A table in Markdown."""
    return "\n".join(f"| {' | '.join(row)} |" for row in (heads, ["---"] * len(heads), *rows))


def bandwidths(found: Table) -> str:
    """Rows of bandwidths, and the laws."""
    rows = []
    for name, own, all_of_them in (
        ("servo_preview", (), (2, 5, 10, 20)),
        ("servo_feedforward", (KNOWN,), (10,)),
        ("servo_feedforward", (), (2, 5, 10, 20)),
    ):
        for hz in all_of_them:
            soft = (*((f"actuator.bandwidth={hz}",) if hz != 10 else ()), *own)
            results = [found(name, (*given, *soft)) for given in CONDITIONS.values()]
            words = f"`{name}`" + ", nothing estimated" * bool(own)
            rows.append([words, f"{hz} Hz", *map(told, results)])
    for law in LAWS:
        results = [found(law, given) for given in CONDITIONS.values()]
        rows.append([f"`{law}`", "-", *map(told, results)])
    return lines(["controller", "bandwidth", *CONDITIONS], rows)


def told(result: tuple[float, float]) -> str:
    """E_ac and the peak torque."""
    return f"{number(result[0])} ({result[1]:.2g})"


def unknown_delay(found: Table) -> str:
    """What is believed of the 0.8 s."""
    rows = []
    for name in ("servo_feedforward", *LAWS):
        for words, start in (("on the reference", ON), ("from rest", REST)):
            results = [found(name, (*start, *believed)) for believed in BELIEVED.values()]
            rows.append([f"`{name}`", words, *map(told, results)])
    return lines(["controller", "start", *(f"believed {eta}" for eta in BELIEVED)], rows)


def not_seen(found: Table) -> str:
    """Geometry that is off, and a push."""
    rows = []
    for name in ("servo_feedforward", *LAWS):
        off = [found(name, ON, seed)[0] for seed in MACHINES]
        clean, pushed = found(name, ON)[0], found(name, ON, None, True)
        rows.append([f"`{name}`", number(clean), number(float(np.mean(off))), told(pushed)])
    return lines(["controller", "as drawn", "as built", "pushed"], rows)


def main() -> None:
    """Write the tables."""
    found = Table()
    for write in (bandwidths, unknown_delay, not_seen):
        write(found)
    found.done()
    about = ", ".join(f"{name} {version}" for name, version in versions().items())
    deviations = ", ".join(f"{name} {1e3 * std:g}" for name, std in TOLERANCES.items())
    text = f"""# Position servos

Made by `python benchmarks/servos.py` with {about}. The paper's motion, 0.8 s of delay, exact plant,
exact measurements: E_ac in % s, in brackets the largest torque in N m. Nothing limits the torques
but the machine's 10 N m.

## Bandwidths

With bias, payload and damping unknown: section Servos of the [table of claims](claims.md).

{bandwidths(found)}

## A delay that is not known

{unknown_delay(found)}

## What servos do not see

As built: means of {len(MACHINES)} machines, standard deviations in mm of {deviations}. Pushed: 1 N
along x from 4 s on.

{not_seen(found)}
"""
    RESULTS.mkdir(parents=True, exist_ok=True)
    (RESULTS / "servos.md").write_text(text, encoding="utf-8")
    print(text)


if __name__ == "__main__":
    main()
