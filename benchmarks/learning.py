"""Learning from repetition: E of the last period after each repetition, and on fresh machines.

Sines of 0.7 of the motion of `paper`, exact plant, delay 0.8 s. Nothing is estimated, without
integral. The controller knows neither friction, payload and bias, nor the lengths of the true
machine.
"""

import tempfile
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from _bench import (
    AMPLITUDE,
    EXACT,
    NONE,
    ON,
    in_parallel,
    noise,
    run_sections,
    section,
    size,
    table,
)
from numpy.random import Generator, default_rng

import stewart_drake as sd
from stewart_drake.law.learned import with_learned
from stewart_drake.mechanism.files import load_mechanism, mechanism_yaml
from stewart_drake.scenario.config import Scenario
from stewart_drake.studies.learn import LearnStudy, last_error, study_learn
from stewart_drake.studies.study_options import LearnOptions

SEEDS = size("SEEDS", 6)
MACHINES = size("MACHINES", 20)
REPETITIONS = size("REPETITIONS", 5, least=2)
PERIODS = {"6 s": 2 * np.pi / 6, "2 pi s": 1.0}
BIAS = 3e-4
"""N m, of each motor."""
ALTERNATING = BIAS * np.array([1, -1, 1, -1, 1, -1])
COULOMB, MASS, POSITION = 1e-4, 0.2, (0.01, -0.008, 0.02)
"""N m; kg; m."""
WRONG = 3e-4
"""Error of every crank and rod, m, with random signs."""


def scenario(
    frequency: float = 1.0,
    share: float = 0.0,
    seed: int = 0,
    bias: Any = ALTERNATING,
    coulomb: float = COULOMB,
    mass: float = MASS,
    position: Any = POSITION,
    mechanism: str | None = None,
) -> Scenario:
    """Return the scenario of one machine; `share` of noise, and the file of its true lengths."""
    numbers = {
        "reference.amplitude": 0.7 * AMPLITUDE,
        "plant.torque_bias": bias,
        "plant.payload_position": position,
    }
    settings = [f"{name}={np.asarray(value).tolist()}" for name, value in numbers.items()]
    settings += [f"plant.coulomb_friction={coulomb:.6g}", f"plant.payload_mass={mass:.6g}"]
    settings += [f"reference.frequency={frequency:.10g}", noise(share), f"sensor.seed={seed}"]
    if mechanism is not None:
        settings.append(f"plant.mechanism={mechanism}")
    law = (NONE, "controller.integral=false", "controller.w_R=100")
    return sd.load_scenario("paper", settings=(EXACT, *ON, *law, *settings))


def wrong_lengths(rng: Generator, error: float, folder: str) -> str:
    """Write a machine into a folder whose lengths are off by an error in m; return its file."""
    machine = load_mechanism("paper")
    cranks, rods = (error * rng.choice([-1, 1], 6) for _ in range(2))
    true = replace(
        machine,
        crank_lengths=machine.crank_lengths + cranks,
        rod_lengths=machine.rod_lengths + rods,
    )
    path = Path(folder) / f"{rng.integers(1 << 30)}.yaml"
    path.write_text(mechanism_yaml(true), encoding="utf-8")
    return str(path)


def learnt(one: Scenario) -> LearnStudy:
    """Return the study of all repetitions."""
    return study_learn(one, LearnOptions(repetitions=REPETITIONS))


def errors(one: Scenario) -> list[float]:
    """Return E of each repetition, % s."""
    return [repetition.error for repetition in learnt(one).repetitions]


def on_fresh_noise(one: Scenario, seed: int) -> tuple[float, float]:
    """Return E without and with the best learned torque, with noise of another seed."""
    study = learnt(one)
    run = replace(study.repetitions[0].result.scenario, sensor=replace(one.sensor, seed=seed))
    changes = [None]
    if study.best.learned is not None:
        changes.append(partial(with_learned, learned=study.best.learned))
    scale, found = study.experiment.scale, []
    for change in changes:
        result = sd.simulate(run, modify_law=change, judge_stability=False)
        found.append(last_error(result, scale, study.period))
    return found[0], found[-1]


def shown(values: Any) -> str:
    """Return mean, least and most of values."""
    return f"{np.mean(values):.3g} ({np.min(values):.3g} to {np.max(values):.3g})"


def repetitions() -> str:
    """Return E of each repetition, clean, with noise, and with wrong lengths."""
    cases: dict[str, list[Scenario]] = {}
    for name, frequency in PERIODS.items():
        cases[f"period {name}"] = [scenario(frequency)]
        drawn = [(seed, default_rng(200 + seed).choice([-1, 1], 6)) for seed in range(SEEDS)]
        cases[f"period {name}, noise of 0.1 %, signs and noise of {SEEDS} seeds"] = [
            scenario(frequency, 1e-3, 1000 + 100 * seed, BIAS * signs) for seed, signs in drawn
        ]
    with tempfile.TemporaryDirectory() as folder:
        files = [wrong_lengths(default_rng(300 + seed), WRONG, folder) for seed in range(SEEDS)]
        cases["lengths wrong by 0.3 mm alone"] = [
            scenario(coulomb=0.0, mass=0.0, bias=np.zeros(6), mechanism=file) for file in files
        ]
        found = iter(in_parallel(errors, [(one,) for runs in cases.values() for one in runs]))
    rows = []
    for name, runs in cases.items():
        several = [next(found) for _ in runs]
        # A study that ended early keeps its best torque.
        columns = [[run[min(k, len(run) - 1)] for run in several] for k in range(REPETITIONS)]
        rows.append([name, *(shown(column) for column in columns)])
    head = ["case", *(f"repetition {k + 1}" for k in range(REPETITIONS))]
    text = "E of the last period, % s: mean, least and most. The first repetition has no torque."
    return section("Repetitions", text, table(head, rows))


def machines() -> str:
    """Return E on machines that differ from their file, with fresh noise."""
    drawn = []
    with tempfile.TemporaryDirectory() as folder:
        for seed in range(MACHINES):
            rng = default_rng(400 + seed)
            file = wrong_lengths(rng, 1e-4, folder)
            bias = BIAS * rng.choice([-1, 1], 6) * rng.uniform(0, 1, 6)
            load = rng.uniform(0, 2e-4), rng.uniform(0, 0.4), rng.uniform(-0.02, 0.02, 3)
            one = scenario(1.0, 1e-3, 5000 + 100 * seed, bias, *load, file)
            drawn.append((one, 9000 + seed))
        without, learned = np.array(in_parallel(on_fresh_noise, drawn)).T
    worse, most = int(np.sum(learned > without)), f"{np.max(learned / without):.3g}"
    rows = [[MACHINES, shown(without), shown(learned), worse, most]]
    head = ["machines", "without", "learned", "worse", "largest ratio"]
    text = (
        "Biases up to 3e-4 N m, friction up to 2e-4 N m, up to 0.4 kg within 20 mm, lengths wrong "
        "by 0.1 mm, noise of 0.1 %, period 2 pi s. Errors with noise that learning has not seen."
    )
    return section("Fresh machines", text, table(head, rows))


SECTIONS = {"repetitions": repetitions, "machines": machines}

if __name__ == "__main__":
    run_sections(__file__, "Learning from repetition", SECTIONS)
