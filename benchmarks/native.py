"""The law's step with parts in C and in Python, and the Riccati equation by doubling and by Drake.

Both are timed in turns. A time is the least of its repeats.
"""

import time
from collections.abc import Callable
from typing import Any

import numpy as np
from _bench import table, with_own, write
from pydrake.math import DiscreteAlgebraicRiccatiEquation

import stewart_drake as sd
from stewart_drake.export.recording import record
from stewart_drake.law.delay_model import delayed_model, linear_model
from stewart_drake.law.motion import Preview
from stewart_drake.law.predictive_lqi import PredictiveLqi
from stewart_drake.law.riccati import lqr, lqr_by_doubling, reduced_gain
from stewart_drake.law.sensing import Measurement

MECHANISM = sd.load_mechanism("paper")


def repeated(call: Callable[[], object], number: int) -> float:
    """Return the CPU time of one call, s."""
    started = time.process_time()
    for _ in range(number):
        call()
    return (time.process_time() - started) / number


def replayed_steps(name: str, samples: int = 60, repeats: int = 8) -> dict[str, list[float]]:
    """Return the time in s of each step with parts in Python and in C, least of the repeats.

    Both repeat the steps of one run, in turns, and use the compiled dynamics.
    """
    settings = ["plant.kind=exact", "controller.replan=0", f"duration={samples / 10}"]
    scenario = sd.load_scenario(name, settings=settings)
    recorded = record(scenario)
    law = recorded.law
    assert isinstance(law, PredictiveLqi)
    own = with_own(law, "observer", "feedforward", "model", "cost")
    steppers: dict[str, Any] = {"python": own, "c": law}
    least = {which: [np.inf] * len(recorded.steps) for which in steppers}
    for which, stepper in [*steppers.items()] * repeats:
        memory = stepper.initial_memory(recorded.first)
        for k, step in enumerate(recorded.steps):
            given = Measurement.of(step.measurement), Preview(law.preview_times, step.preview)
            started = time.perf_counter()
            memory = stepper.step(memory, *given, step.weights)
            least[which][k] = min(least[which][k], time.perf_counter() - started)
            memory.in_flight[-1] = step.sent[:6]
    return least


def riccati_times(fraction: float) -> tuple[int, float, float]:
    """Return the number of states, and times in s of Drake's solver and of doubling, in turns."""
    dynamics = sd.StewartDynamics(MECHANISM)
    model = delayed_model(
        linear_model(*dynamics.linearize(MECHANISM.home)), 0.1, 8, fraction, integral=True
    )
    given: list[Any] = []

    def keep(*matrices: Any) -> Any:
        given[:] = [np.asfortranarray(matrix) for matrix in matrices]
        return lqr(*matrices)

    reduced_gain(model, 1e4 * np.eye(12), np.eye(6), keep)
    times = []
    for _ in range(60):
        one = repeated(lambda: DiscreteAlgebraicRiccatiEquation(*given), 3)
        times.append((one, repeated(lambda: lqr_by_doubling(*given), 3)))
    drake, ours = np.min(times, axis=0)
    return len(given[0]), float(drake), float(ours)


def steps() -> str:
    """Return rows of the law's step."""
    rows = []
    for name in ("paper", "gravity"):
        python, c = replayed_steps(name).values()
        fed = [k for k, seconds in enumerate(c) if k >= 8]  # earlier ones are without feedback
        mid = [float(np.median([times[k] for k in fed])) for times in (python, c)]
        worst = max(c[k] for k in fed) / mid[1]
        medians = [f"{1e6 * one:.4g}" for one in mid]
        rows.append([f"`{name}`", *medians, f"{mid[0] / mid[1]:.1f}", f"{worst:.2f}"])
    heads = [
        "step of the law",
        "parts in Python, median us",
        "in C, median us",
        "ratio",
        "in C, worst / median",
    ]
    return table(heads, rows)


def equations() -> str:
    """Return rows of the Riccati equation."""
    rows = []
    for fraction in (0.0, 0.5):
        order, drake, ours = riccati_times(fraction)
        rows.append([order, f"{1e6 * drake:.4g}", f"{1e6 * ours:.4g}", f"{drake / ours:.1f}"])
    return table(["Riccati equation, states", "Drake, us", "doubling, us", "ratio"], rows)


if __name__ == "__main__":
    write(__file__, "The law and the Riccati equation in C", [steps(), equations()])
