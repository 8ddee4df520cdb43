"""The dynamics in C against CasADi's virtual machine, ratios of times in one interleaved run.

Two processes, one with each backend, take turns; a time is the least CPU time of its repeats.
Writes benchmarks/results/native.md.
"""

import os
import sys
import time
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from dataclasses import fields
from multiprocessing import get_context
from typing import Any

os.environ.setdefault("OMP_NUM_THREADS", "1")

import numpy as np
from _page import write
from pydrake.math import DiscreteAlgebraicRiccatiEquation
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder
from pydrake.systems.primitives import Sine

import stewart_drake as sd
from stewart_drake.dynamics.compiled import Buffered
from stewart_drake.dynamics.stewart import plant_parameters
from stewart_drake.law.delay_model import delayed_model
from stewart_drake.law.doubling import Doubling
from stewart_drake.law.error_model import linear_model
from stewart_drake.law.measurement import Measurement
from stewart_drake.law.motion import Preview
from stewart_drake.law.native_law import NativeLqi
from stewart_drake.law.predictive_lqi import PredictiveLqi
from stewart_drake.law.riccati import lqr, reduced_gain
from stewart_drake.loop.exact import ExactPlant, set_accuracy
from stewart_drake.native.library import SWITCH, backend
from stewart_drake.report.export_c import recorded_law

ROUNDS = 12
BACKENDS = {"casadi": "0", "native": "require"}
MECHANISM = sd.load_mechanism("paper")
RNG = np.random.default_rng(0)
POSE, (RATES, ACCELERATIONS, TORQUE) = MECHANISM.home, RNG.normal(0, 0.3, (3, 6))
THETA, GRAVITY = plant_parameters(), 9.81
FUNCTIONS = (
    "accelerations",
    "inverse dynamics",
    "residual's derivatives",
    "measures of the workspace",
    "prediction, 32 steps",
)


def repeated(call: Callable[[], object], number: int) -> float:
    """Seconds of CPU time that one call takes."""
    started = time.process_time()
    for _ in range(number):
        call()
    return (time.process_time() - started) / number


def function(name: str) -> tuple[Buffered, tuple[object, ...]]:
    """One of FUNCTIONS and its arguments."""
    f = sd.StewartDynamics(MECHANISM)._functions
    state, many = np.concatenate([POSE, np.zeros(6)]), np.full((32, 6), 0.01)
    at, rest = (POSE, RATES), (THETA, GRAVITY)
    choices = (
        lambda: (f.accelerations, (*at, TORQUE, *rest)),
        lambda: (f.inverse_dynamics, (*at, ACCELERATIONS, *rest)),
        lambda: (f.residual_derivatives, (*at, ACCELERATIONS, TORQUE, *rest)),
        lambda: (f.measures, (POSE,)),
        lambda: (f.many_steps(32), (state, many, *rest, 1e-3)),
    )
    return choices[FUNCTIONS.index(name)]()


def alone(name: str) -> float:
    """A function without its arguments being copied, but with the call from Python."""
    found, arguments = function(name)
    found(*arguments)
    return repeated(found.own_buffers().evaluate, 500)


def called(name: str) -> float:
    """A function as the package calls it."""
    found, arguments = function(name)
    return repeated(lambda: found(*arguments), 500)


def open_loop(gravity: bool) -> float:
    """Half a second of `ExactPlant` at 1e-9: constant torque and gravity, or a sine without."""
    dynamics = sd.StewartDynamics(MECHANISM, gravity)
    builder = DiagramBuilder()
    plant = builder.AddSystem(ExactPlant(dynamics))
    held = dynamics.equilibrium_torque(POSE)
    push = 0.02 * np.abs(held) * [1.0, 0.6, -0.4, 0.8, -0.2, 0.5]
    amplitude, frequency, phase = np.full(6, 0.02), 2 * np.pi, np.arange(6) + 1.5
    if gravity:
        amplitude, frequency, phase = held + push, 0.0, np.full(6, np.pi / 2)
    source = builder.AddSystem(Sine(amplitude, np.full(6, frequency), phase))
    builder.Connect(source.get_output_port(0), plant.GetInputPort("torque"))
    diagram = builder.Build()
    simulator = Simulator(diagram)
    set_accuracy(simulator, 1e-9)
    simulator.Initialize()
    return repeated(lambda: simulator.AdvanceTo(0.5), 1)


def closed_loop(what: str, name: str = "paper") -> float:
    """Of two seconds (`step`) or ten (`run`) of a scenario on the exact plant."""
    duration = "duration=2.0" if what == "step" else "duration=10.0"
    scenario = sd.load_scenario(name, settings=["plant.kind=exact", duration])
    started = time.process_time()
    summary = sd.simulate(scenario, margin=False).summary
    spent = time.process_time() - started
    assert summary["backend"] == backend().name and summary["status"] == "completed"
    return summary["controller_step_ms"]["median"] / 1e3 if what == "step" else spent


WORK: dict[str, tuple[Callable[..., float], tuple[object, ...]]] = {
    **{f"{name}, alone": (alone, (name,)) for name in FUNCTIONS},
    **{f"{name}, called": (called, (name,)) for name in FUNCTIONS},
    "exact plant at 1e-9, constant torque and gravity": (open_loop, (True,)),
    "exact plant at 1e-9, sine": (open_loop, (False,)),
    "controller step, median": (closed_loop, ("step",)),
    "controller step, `gravity`, median": (closed_loop, ("step", "gravity")),
    "ten seconds of `paper`": (closed_loop, ("run",)),
}


def replayed_steps(name: str, samples: int = 60, repeats: int = 8) -> dict[str, list[float]]:
    """Seconds of each step of a scenario's law, in Python and in C, least of the repeats.

    Both are given what happened in a run, in turns; the law in Python on this process's dynamics.
    """
    scenario = sd.load_scenario(name, settings=["plant.kind=exact", f"duration={samples / 10}"])
    recorded = recorded_law(scenario)
    law = PredictiveLqi(**{f.name: getattr(recorded, f.name) for f in fields(PredictiveLqi)})
    library = backend().library
    assert library is not None
    steppers: dict[str, Any] = {"python": law, "c": NativeLqi(law, library)}
    least = {which: [np.inf] * len(recorded.steps) for which in steppers}
    for which, stepper in [*steppers.items()] * repeats:
        memory = stepper.initial_memory(recorded.queue[0])
        for k, step in enumerate(recorded.steps):
            given = Measurement.of(step.measurement), Preview(law.preview_times, step.preview)
            started = time.perf_counter()
            memory = stepper.step(memory, *given, step.weights)
            least[which][k] = min(least[which][k], time.perf_counter() - started)
            memory.in_flight[-1] = step.sent
    return least


def riccati_times(fraction: float) -> tuple[int, float, float]:
    """States, and seconds of Drake's solver and of doubling, in turns, at home under gravity."""
    dynamics = sd.StewartDynamics(MECHANISM)
    model = delayed_model(
        linear_model(*dynamics.linearize(MECHANISM.home)), 0.1, 8, fraction, integral=True
    )
    given: list[Any] = []

    def keep(*matrices: Any) -> Any:
        given[:] = [np.asfortranarray(matrix) for matrix in matrices]
        return lqr(*matrices)

    reduced_gain(model, 1e4 * np.eye(12), np.eye(6), keep)
    library = backend().library
    assert library is not None
    doubling, times = Doubling(library, len(given[0])), []
    for _ in range(60):
        one = repeated(lambda: DiscreteAlgebraicRiccatiEquation(*given), 3)
        times.append((one, repeated(lambda: doubling(*given), 3)))
    drake, ours = np.min(times, axis=0)
    return len(given[0]), float(drake), float(ours)


def controller_lines() -> list[str]:
    """Rows of the law's step and of the Riccati equation."""
    lines = [
        "| step of the law | Python, median us | C, median us | ratio | C, worst / median |",
        "| --- | --- | --- | --- | --- |",
    ]
    for name in ("paper", "gravity"):
        python, c = replayed_steps(name).values()
        fed = [k for k, seconds in enumerate(c) if k >= 8]  # before, nothing is fed back
        mid = [float(np.median([times[k] for k in fed])) for times in (python, c)]
        worst = max(c[k] for k in fed) / mid[1]
        lines.append(
            f"| `{name}` | {1e6 * mid[0]:.4g} | {1e6 * mid[1]:.4g} | {mid[0] / mid[1]:.1f} | "
            f"{worst:.2f} |"
        )
    lines += ["", "| Riccati equation, states | Drake, us | doubling, us | ratio |"]
    lines += ["| --- | --- | --- | --- |"]
    for fraction in (0.0, 0.5):
        order, drake, ours = riccati_times(fraction)
        lines.append(f"| {order} | {1e6 * drake:.4g} | {1e6 * ours:.4g} | {drake / ours:.1f} |")
    return lines


def use(value: str) -> None:
    """Of a process that has not made any function yet."""
    os.environ[SWITCH] = value
    backend.cache_clear()


def measure() -> dict[str, dict[str, float]]:
    """Work -> backend -> least seconds."""
    context = get_context("spawn")
    pools = {
        name: ProcessPoolExecutor(1, context, use, (value,)) for name, value in BACKENDS.items()
    }
    least = {work: dict.fromkeys(BACKENDS, np.inf) for work in WORK}
    for _ in range(ROUNDS):
        for work, (job, arguments) in WORK.items():
            for name, pool in pools.items():
                found = pool.submit(job, *arguments).result()
                least[work][name] = min(least[work][name], found)
    for pool in pools.values():
        pool.shutdown()
    return least


def main() -> None:
    """Measure, print and write."""
    lines = ["| what | casadi, us | native, us | ratio |\n| --- | --- | --- | --- |"]
    for work, times in measure().items():
        numbers = " | ".join(f"{1e6 * times[name]:.4g}" for name in BACKENDS)
        lines.append(f"| {work} | {numbers} | {times['casadi'] / times['native']:.2f} |")
    lines += [
        "",
        "Least times of repeats, both in turns; the law in Python on the compiled dynamics:",
        "",
    ]
    with ProcessPoolExecutor(1, get_context("spawn"), use, ("require",)) as pool:
        lines += pool.submit(controller_lines).result()
    write(__file__, "The dynamics in C", lines)


if __name__ == "__main__":
    sys.exit(main())
