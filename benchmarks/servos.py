"""Position servos compared with laws that close their loop across the delay.

On the exact plant: bandwidths, an unknown delay, a machine that differs from its drawing, a push,
and the torques of all these runs.
"""

from dataclasses import replace
from functools import partial

import numpy as np
from _bench import EXACT, NONE, ON, Push, in_parallel, section, table, write

import stewart_drake as sd
from stewart_drake.scenario.loading import load_compatible

REST: tuple[str, ...] = ()
BELIEVED = {
    "0.7 s": ("controller.delay_steps=7",),
    "0.8 s": (),
    "0.9 s": ("controller.delay_steps=9",),
}
CONDITIONS = {
    "on the reference": ON,
    "from rest": REST,
    "gravity": (*ON, "plant.gravity=true"),
}
TOLERANCES = {"p_WS": 3e-4, "p_PQ": 3e-4, "crank_lengths": 1e-4, "rod_lengths": 2e-4}
"""m, standard deviations of a machine from its drawing."""
MACHINES = range(101, 106)
SERVOS = ("servo_preview", "servo_feedforward")
LAWS = ("predictor_lqi", "adaptive_lqi")
PUSH = partial(Push, (1.0, 0.0, 0.0), (4.0, np.inf))
"""1 N along x from t = 4 s on."""
ABOUT = (
    "The paper's motion, 0.8 s of delay, exact plant, exact measurements: E_ac in % s, in brackets "
    "the largest torque in N m. Torques are limited by the machine's 10 N m only."
)


def as_built(seed: int) -> sd.Mechanism:
    """Return a machine within TOLERANCES."""
    drawing, rng = sd.load_mechanism("paper"), np.random.default_rng(seed)
    off = {
        name: getattr(drawing, name) + std * rng.standard_normal(getattr(drawing, name).shape)
        for name, std in TOLERANCES.items()
    }
    return replace(drawing, **off)


def run(
    controller: str, settings: tuple[str, ...], machine: int | None = None, pushed: bool = False
) -> tuple[float, float]:
    """Return E_ac in % s, infinite for a lost run, and the largest torque in N m."""
    servo = ("actuator.kind=servo",) if controller in SERVOS else ()
    scenario = load_compatible("paper", controller, (EXACT, *servo, *settings))
    result = sd.simulate(
        scenario,
        true_mechanism=None if machine is None else as_built(machine),
        disturbance=PUSH if pushed else None,
        judge_stability=False,
    )
    peak = result.summary["peak_torque_applied"]
    return (np.inf if result.stopped else result.accumulated_error), peak


class Runs:
    """Runs that are collected while rows are written a first time, and done together."""

    def __init__(self) -> None:
        self.results: dict[tuple, tuple[float, float]] = {}

    def do(self) -> None:
        jobs = [key for key, found in self.results.items() if not found]
        self.results |= dict(zip(jobs, in_parallel(run, jobs), strict=True))

    def __call__(self, *key: object) -> tuple[float, float]:
        """Return the result of a run, zeros before it is done."""
        return self.results.setdefault(key, ()) or (0.0, 0.0)


def number(value: float) -> str:
    return f"{value:.3g}" if np.isfinite(value) else "lost"


def text(result: tuple[float, float]) -> str:
    return f"{number(result[0])} ({result[1]:.2g})"


def bandwidths(found: Runs) -> str:
    """Return rows of bandwidths, and the laws."""
    rows = []
    for name, own, all_of_them in (
        ("servo_preview", (), (2, 5, 10, 20)),
        ("servo_feedforward", (NONE,), (10,)),
        ("servo_feedforward", (), (2, 5, 10, 20)),
    ):
        for hz in all_of_them:
            soft = (*((f"actuator.bandwidth={hz}",) if hz != 10 else ()), *own)
            results = [found(name, (*given, *soft)) for given in CONDITIONS.values()]
            words = f"`{name}`" + ", nothing estimated" * bool(own)
            rows.append([words, f"{hz} Hz", *map(text, results)])
    for law in LAWS:
        results = [found(law, given) for given in CONDITIONS.values()]
        rows.append([f"`{law}`", "-", *map(text, results)])
    words = "With bias, payload and damping unknown: section Servos of the "
    words += "[table of claims](claims.md).\n"
    return section("Bandwidths", words, table(["controller", "bandwidth", *CONDITIONS], rows))


def unknown_delay(found: Runs) -> str:
    """Return rows of believed delays, the true one being 0.8 s."""
    rows = []
    for name in ("servo_feedforward", *LAWS):
        for words, start in (("on the reference", ON), ("from rest", REST)):
            results = [found(name, (*start, *believed)) for believed in BELIEVED.values()]
            rows.append([f"`{name}`", words, *map(text, results)])
    heads = ["controller", "start", *(f"believed {eta}" for eta in BELIEVED)]
    return section("An unknown delay", table(heads, rows))


def unmeasured(found: Runs) -> str:
    """Return rows with an unknown geometry, and with a push."""
    rows = []
    for name in ("servo_feedforward", *LAWS):
        off = [found(name, ON, seed)[0] for seed in MACHINES]
        clean, pushed = found(name, ON)[0], found(name, ON, None, True)
        rows.append([f"`{name}`", number(clean), number(float(np.mean(off))), text(pushed)])
    deviations = ", ".join(f"{name} {1e3 * std:g}" for name, std in TOLERANCES.items())
    words = f"As built: means of {len(MACHINES)} machines, standard deviations in mm of "
    words += f"{deviations}. Pushed: 1 N along x from 4 s on."
    heads = ["controller", "as drawn", "as built", "pushed"]
    return section("Errors that servos do not measure", words, table(heads, rows))


def main() -> None:
    found, sections = Runs(), (bandwidths, unknown_delay, unmeasured)
    for make in sections:
        make(found)
    found.do()
    write(__file__, "Position servos", [ABOUT, *(make(found) for make in sections)])


if __name__ == "__main__":
    main()
