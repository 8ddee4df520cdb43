"""Error against computing time of the exact plant, Drake's SAP and MuJoCo on two open-loop motions.

The exact plant is integrated in Drake, and under the constant torque by the compiled DOP853 of
`stewart_drake.dynamics.open_loop`, too.

All start at home, at rest, under torques amplitude * sin(frequency t + phase). The error is that of
the pose at the end, its worst coordinate in rad or m, against an integration to 1e-13. The time is
that of the processor for the stepping alone, per simulated second, the least of several
interleaved repeats.
"""

import time
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import matplotlib.pyplot as plt
import mujoco
import numpy as np
from _bench import RESULTS, table, write
from matplotlib.figure import Figure
from mujoco_model import Closure, MujocoStewart
from pydrake.systems.analysis import ApplySimulatorConfig, Simulator, SimulatorConfig
from pydrake.systems.framework import DiagramBuilder
from pydrake.systems.primitives import Sine
from scipy.integrate import solve_ivp

import stewart_drake as sd
from stewart_drake.dynamics.open_loop import NativePlant
from stewart_drake.loop.exact import ExactPlant
from stewart_drake.loop.platforms import MultibodyStewart
from stewart_drake.reporting.style import figure_style, write_figures
from stewart_drake.scenario.signals import POSE, RATES
from stewart_drake.types import Array

ROUNDS, BUDGET = 25, 2.0
"""Repeats of each candidate, and the seconds after which it gets no more (but two at least)."""
SAP_STEPS = (2e-3, 1e-3, 5e-4, 2e-4, 1e-4)
MECHANISM = sd.load_mechanism("paper")
START = np.concatenate([MECHANISM.home, np.zeros(6)])


class Motion(NamedTuple):
    """Motor torques amplitude (6,) N m * sin(frequency t + phase (6,)), frequency in rad/s."""

    title: str
    gravity: bool
    duration: float
    amplitude: Array
    frequency: float
    phase: Array

    def torque(self, t: float) -> Array:
        return self.amplitude * np.sin(self.frequency * t + self.phase)


Run = Callable[[], tuple[float, Array]]
"""Simulates once: seconds of stepping and final state (12,)."""


def motions() -> tuple[Motion, Motion]:
    """Two percent off the equilibrium under gravity; a sine without."""
    hold = sd.StewartDynamics(MECHANISM, gravity=True).equilibrium_torque(MECHANISM.home)
    push = 0.02 * np.abs(hold) * [1.0, 0.6, -0.4, 0.8, -0.2, 0.5]
    quarter = np.full(6, np.pi / 2)
    return (
        Motion("constant torque, gravity", True, 0.5, hold + push, 0.0, quarter),
        Motion("sinusoidal torque", False, 1.0, np.full(6, 0.02), 2 * np.pi, np.arange(6) + 1.5),
    )


def reference(motion: Motion) -> Array:
    """Return the final state (12,) by scipy's eighth-order method."""
    dynamics = sd.StewartDynamics(MECHANISM, motion.gravity)

    def change(t: float, x: Array) -> Array:
        return np.concatenate(
            [x[RATES], dynamics.accelerations(x[POSE], x[RATES], motion.torque(t))]
        )

    span = (0.0, motion.duration)
    return solve_ivp(change, span, START, method="DOP853", rtol=1e-13, atol=1e-13).y[:, -1]


def drake_run(motion: Motion, plant: Any, scheme: str | None, accuracy: float) -> Run:
    """Drake's Simulator on a plant; `scheme` None leaves a discrete plant to its own steps."""
    builder = DiagramBuilder()
    builder.AddSystem(plant)
    source = builder.AddSystem(Sine(motion.amplitude, np.full(6, motion.frequency), motion.phase))
    builder.Connect(source.get_output_port(0), plant.GetInputPort("torque"))
    diagram = builder.Build()
    context = diagram.CreateDefaultContext()
    own = plant.GetMyMutableContextFromRoot(context)
    simulator = Simulator(diagram, context)
    if scheme is not None:
        config = SimulatorConfig(
            integration_scheme=scheme, accuracy=accuracy, use_error_control=True
        )
        ApplySimulatorConfig(config, simulator)
        context.SetAccuracy(accuracy)

    def run() -> tuple[float, Array]:
        context.SetTime(0.0)
        plant.set_state(own, START)
        simulator.Initialize()
        started = time.process_time()
        simulator.AdvanceTo(motion.duration)
        return time.process_time() - started, np.array(plant.GetOutputPort("state").Eval(own))

    return run


def dop853_run(motion: Motion, accuracy: float) -> Run:
    """Return a run by the compiled DOP853, under a constant torque."""
    dynamics = sd.StewartDynamics(MECHANISM, motion.gravity)
    end, torque = np.array([motion.duration]), motion.torque(0.0)

    def run() -> tuple[float, Array]:
        plant = NativePlant(dynamics, START, end, accuracy)
        started = time.process_time()
        plant.hold([0.0], torque)
        return time.process_time() - started, plant.final

    return run


def mujoco_run(motion: Motion, time_step: float, closure: Closure) -> Run:
    """MuJoCo's RK4."""
    plant = MujocoStewart(MECHANISM, motion.gravity, closure)
    torque = motion.torque if motion.frequency else motion.torque(0.0)
    return lambda: plant.simulate(START, torque, motion.duration, time_step)


def candidates(motion: Motion) -> dict[tuple[str, str], Run]:
    """All runs of a motion, by family and setting.

    MuJoCo's springs, in time steps, are the best of those from 0.5 to 10 (hardened: 4 to 100).
    """
    runs: dict[tuple[str, str], Run] = {}
    for scheme, digits in (("runge_kutta5", range(4, 12)), ("runge_kutta3", range(4, 9))):
        for digit in digits:
            plant = ExactPlant(sd.StewartDynamics(MECHANISM, motion.gravity))
            setting = f"accuracy 1e-{digit:02d}"
            runs[f"exact, {scheme}", setting] = drake_run(motion, plant, scheme, 10.0**-digit)
    for digit in range(4, 14) if motion.frequency == 0 else ():
        runs["exact, DOP853", f"accuracy 1e-{digit:02d}"] = dop853_run(motion, 10.0**-digit)
    for step in SAP_STEPS:
        plant = MultibodyStewart(MECHANISM, step, gravity=motion.gravity)
        runs["SAP", f"step {1e3 * step:g} ms"] = drake_run(motion, plant, None, 0.0)
    spring = 1.0 if motion.gravity else 2.0
    for name, closure, steps in (
        ("MuJoCo RK4", Closure(spring), (5e-3, 2.5e-3, 1e-3, 5e-4, 2.5e-4, 1e-4)),
        ("MuJoCo RK4, hardened", Closure(30.0, 1e6, 2), (5e-3, 2.5e-3, 1e-3, 5e-4)),
    ):
        for step in steps:
            scaled = closure._replace(time_constant=closure.time_constant * step)
            setting = f"step {1e3 * step:g} ms, spring {1e3 * scaled.time_constant:g} ms"
            runs[name, setting] = mujoco_run(motion, step, scaled)
    return runs


class Curve(NamedTuple):
    """Errors of the settings of a family in rad or m, and times in ms per simulated second."""

    settings: list[str]
    error: Array
    time: Array

    def time_at(self, error: float) -> float:
        """Time that an error takes, by log-log interpolation; NaN where it is not reached."""
        order = np.argsort(self.error)
        logs = np.log(self.error[order]), np.log(self.time[order])
        reached = self.error.min() <= error
        return float(np.exp(np.interp(np.log(error), *logs))) if reached else float("nan")


def measure(motion: Motion) -> dict[str, Curve]:
    """Return the curve of each family."""
    expected, runs = reference(motion), candidates(motion)
    errors: dict[tuple[str, str], float] = {}
    times: dict[tuple[str, str], list[float]] = {key: [] for key in runs}
    for turn in range(ROUNDS):
        for key, run in runs.items():
            if turn < 2 or sum(times[key]) < BUDGET:
                seconds, state = run()
                times[key].append(1e3 * seconds / motion.duration)
                errors[key] = float(np.abs(state - expected)[POSE].max())
    curves = {}
    for family in dict.fromkeys(key[0] for key in runs):
        keys = [key for key in runs if key[0] == family]
        curves[family] = Curve(
            [key[1] for key in keys],
            np.array([errors[key] for key in keys]),
            np.array([min(times[key]) for key in keys]),
        )
    return curves


def claims(curves: Sequence[dict[str, Curve]]) -> list[list[str]]:
    """Return the ratios of each plant, as rows."""
    rows = []
    for motion, families in zip(motions(), curves, strict=True):
        exact, sap = families["exact, runge_kutta5"], families["SAP"]
        ratio = sap.time[-1] / exact.time_at(sap.error[-1])
        order = np.log(sap.error[0] / sap.error[-1]) / np.log(SAP_STEPS[0] / SAP_STEPS[-1])
        rows += [
            ["exact against SAP's smallest step, at SAP's error", motion.title, f"{ratio:.3g}"],
            ["order of SAP", motion.title, f"{order:.2f}"],
            ["exact, ms per simulated s at 1e-9", motion.title, f"{exact.time_at(1e-9):.3g}"],
        ]
        others = ("exact, runge_kutta3", "MuJoCo RK4", "MuJoCo RK4, hardened")
        compared = {"exact, runge_kutta5": others}
        if "exact, DOP853" in families:
            fast = families["exact, DOP853"].time_at(1e-9)
            rows.append(["exact, DOP853, ms per simulated s at 1e-9", motion.title, f"{fast:.3g}"])
            compared["exact, DOP853"] = ("exact, runge_kutta5", *others[1:])
        for own, against in compared.items():
            for name in against:
                ratio = families[name].time_at(1e-9) / families[own].time_at(1e-9)
                rows.append([f"{own} against {name}, at 1e-9", motion.title, f"{ratio:.3g}"])
    return rows


def figure(curves: Sequence[dict[str, Curve]]) -> Figure:
    """Error against time, a panel per motion."""
    styles = dict(zip(curves[0], ("ok-", "sk:", "*g-", "^r-", "vb-", "Db:"), strict=True))
    drawn, panels = plt.subplots(1, 2, figsize=(7.4, 3.4), sharey=True, layout="constrained")
    for panel, motion, families in zip(panels, motions(), curves, strict=True):
        for family, curve in families.items():
            panel.loglog(curve.time, curve.error, styles[family], ms=3.5, lw=1.2, label=family)
        panel.set(title=motion.title, xlabel="computing time, ms per simulated s")
    panels[0].set_ylabel("pose error at the end, rad or m")
    shown = panels[0].get_legend_handles_labels()
    drawn.legend(*shown, loc="outside upper center", ncols=6, fontsize=7)
    return drawn


def main() -> None:
    curves = [measure(motion) for motion in motions()]
    parts = ["## Claims\n\n" + table(["what", "motion", "value"], claims(curves))]
    for motion, families in zip(motions(), curves, strict=True):
        rows = [
            [family, setting, f"{error:.1e}", f"{t:.3g}"]
            for family, curve in families.items()
            for setting, error, t in zip(*curve, strict=True)
        ]
        header = ["family", "setting", "error, rad or m", "ms per simulated s"]
        parts.append(f"## {motion.title.capitalize()}\n\n" + table(header, rows))
    more = f", mujoco {mujoco.__version__}"
    write(__file__, "Error against computing time", parts, more)
    with figure_style():
        write_figures({"plants": figure(curves)}, RESULTS)


if __name__ == "__main__":
    main()
