"""Recorded torques of every shipped scenario with every controller on both plants.

    python -m tests.recorded.runs                       # what has no row yet
    python -m tests.recorded.runs paper/lqi/exact ...   # these rows anew, after a deliberate change

A row holds what the controller was given and what it answered at its first samples, so that the
law can be checked step by step without a plant, and the loop as a whole. With servos a measurement
has what they report of the last period at its end, and the answers are commands (n, 18).
"""

import hashlib
import platform
import sys
from functools import cache
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
from pydrake.math import DiscreteAlgebraicRiccatiEquation
from pydrake.systems.analysis import Simulator
from scipy.linalg import expm

from stewart_drake.dynamics.stewart import StewartDynamics
from stewart_drake.files.resources import shipped
from stewart_drake.loop.diagram import ClosedLoop, build_closed_loop
from stewart_drake.loop.simulation import make_simulator
from stewart_drake.mechanism.files import load_mechanism
from stewart_drake.scenario.loading import load_compatible
from stewart_drake.scenario.signals import NUM_STATE, NUM_TORQUES
from stewart_drake.scenario.timing import event_time, look_time
from stewart_drake.types import Array

FILE = Path(__file__).with_name("torques.npz")
SAMPLES = 60
"""At the most; a plate that leaves its workspace ends the row."""
SERVO_SAMPLES = 20
"""As many where servos report."""
EXACT_ONLY = {"reachy_mini/servo_feedforward/multibody", "reachy_mini/servo_preview/multibody"}
"""Drake's trees have no servos given by their stiffness."""
ROWS = tuple(
    f"{scenario}/{controller}/{kind}"
    for scenario in shipped("scenario")
    for controller in shipped("controller")
    for kind in ("exact", "multibody")
    if f"{scenario}/{controller}/{kind}" not in EXACT_ONLY
)


def closed_loop(row: str) -> ClosedLoop:
    """Return the loop of a row."""
    scenario, controller, kind = row.split("/")
    settings = (f"plant.kind={kind}",)
    return build_closed_loop(load_compatible(scenario, controller, settings))


def _run_servos(loop: ClosedLoop) -> tuple[Array, Array]:
    """Run as `run` does, for controllers that send commands to servos."""
    simulator = make_simulator(loop)
    context = simulator.get_context()
    period = loop.experiment.scenario.controller.period
    servos: Any = loop.GetSubsystemByName("servos")
    controller: Any = loop.GetSubsystemByName("controller")
    told = servos.reports.width + NUM_TORQUES
    measurements, commands = [], []
    for k in range(SERVO_SAMPLES):
        # Before the sample, whose event comes early: the servos' next torque would be in it.
        if k > 0:
            simulator.AdvanceTo(event_time(event_time(k * period)))
        report = servos.GetOutputPort("report").Eval(servos.GetMyContextFromRoot(context))
        if k > 0:
            simulator.AdvanceTo(look_time(k * period))
        else:
            simulator.Initialize()
        memory = controller.sample(controller.GetMyContextFromRoot(context)).memory
        measurements.append(np.append(memory.measurement, report[-told:]))
        commands.append(memory.command)
    return np.array(measurements), np.array(commands)


def run(loop: ClosedLoop) -> tuple[Array, Array]:
    """Measurements (n, 12) and torques (n, 6) at the controller's first samples."""
    if loop.experiment.scenario.controller.command != "torque":
        return _run_servos(loop)
    simulator = make_simulator(loop)
    context = simulator.get_context()
    period = loop.experiment.scenario.controller.period
    simulator.Initialize()
    measurements, torques = [], []
    for k in range(SAMPLES):
        if k > 0:
            outcome = simulator.AdvanceTo(look_time(k * period))
            if outcome.reason() == outcome.ReturnReason.kReachedTerminationCondition:
                break
        measurements.append(loop.GetOutputPort("measurement").Eval(context))
        torques.append(loop.GetOutputPort("torque_commanded").Eval(context))
    return np.array(measurements), np.array(torques)


def answers(loop: ClosedLoop, measurements: Array) -> Array:
    """Torques (n, 6) that the controller of a loop, alone, answers to measurements (n, 12)."""
    whole = loop.CreateDefaultContext()
    period = loop.experiment.scenario.controller.period
    controller = loop.GetSubsystemByName("controller")
    reference = loop.GetSubsystemByName("reference")
    settings = loop.experiment.scenario.controller
    weights = np.array(settings.weights)
    context = controller.CreateDefaultContext()
    simulator = None
    torques = []
    weighted = controller.HasInputPort("weights")
    for k, measurement in enumerate(measurements):
        early = event_time(period)
        whole.SetTime(early + (k - 1) * early if k else 0.0)  # as Drake computes it
        if not weighted:
            report = np.full(controller.GetInputPort("report").size(), np.nan)
            report[NUM_STATE - len(measurement) :] = measurement[NUM_STATE:]
            measurement = measurement[:NUM_STATE]
            controller.GetInputPort("report").FixValue(context, report)
        controller.GetInputPort("measurement").FixValue(context, measurement)
        preview = reference.GetOutputPort("preview").Eval(reference.GetMyContextFromRoot(whole))
        controller.GetInputPort("preview").FixValue(context, preview)
        if weighted:
            controller.GetInputPort("weights").FixValue(context, weights)
        if simulator is None:
            simulator = Simulator(controller, context)
            simulator.Initialize()
        else:
            simulator.AdvanceTo(look_time(k * period))
        if weighted:
            torques.append(controller.GetOutputPort("torque_commanded").Eval(context))
        else:
            own: Any = controller
            torques.append(own.sample(context).memory.command)
    return np.array(torques)


def processor() -> str:
    """Return the model of the processor, as Linux numbers it."""
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
    except OSError:
        return platform.processor()
    entries = dict(map(str.strip, line.split(":", 1)) for line in lines if ":" in line)
    fields = "vendor_id", "cpu family", "model", "stepping"
    return " ".join(entries.get(field, "?") for field in fields)


def made_with() -> str:
    """Return a key of everything that rounding depends on: releases and processor.

    Sines, products and factorisations choose their code by the processor, which need not show in
    its name: their own last bits are the witness, and those of the compiled core. Neither suffices
    alone.
    """
    releases = [f"{name} {version(name)}" for name in ("drake", "numpy", "scipy")]
    releases.append(processor())
    draw = np.random.default_rng(0).standard_normal
    A, B, paper = draw((18, 18)), draw((18, 6)), StewartDynamics(load_mechanism("paper"))
    rounded = [
        np.linalg.solve(A, B),
        np.linalg.eigvals(A @ A.T),
        expm(A),
        DiscreteAlgebraicRiccatiEquation(A / 4, B, np.eye(18), np.eye(6)),
        paper.change(np.append(paper.mechanism.home, np.ones(6)), np.ones(6)),
    ]
    digest = hashlib.sha256(b"".join(np.ascontiguousarray(part).tobytes() for part in rounded))
    return ", ".join([*releases, digest.hexdigest()[:16]])


@cache
def same_rounding() -> bool:
    """Whether the record was made with what is here."""
    with np.load(FILE) as arrays:
        return str(arrays["made_with"]) == made_with()


def load() -> dict[str, tuple[Array, Array]]:
    """Row -> measurements and torques."""
    if not FILE.exists():
        return {}
    with np.load(FILE) as arrays:
        return {
            row: (arrays[f"{row}/measurement"], arrays[f"{row}/torque"])
            for row in ROWS
            if f"{row}/torque" in arrays
        }


def main(rows: list[str]) -> None:
    """Record rows anew; without any, those that are missing.

    All of them where the record was made elsewhere: its key holds for every row.
    """
    if not (FILE.exists() and same_rounding()):
        kept, rows = {}, []
    else:
        kept = load()
    for row in rows or [row for row in ROWS if row not in kept]:
        kept[row] = run(closed_loop(row))
        print(row, len(kept[row][1]), "samples")
    arrays = {}
    for row, (measurements, torques) in kept.items():
        arrays |= {f"{row}/measurement": measurements, f"{row}/torque": torques}
    np.savez_compressed(FILE, made_with=made_with(), **arrays)


if __name__ == "__main__":
    main(sys.argv[1:])
