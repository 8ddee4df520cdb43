"""Machines found from their logs: `python benchmarks/identification.py [section ...]`.

Writes benchmarks/results/identification.md; MACHINES of the environment is their number. Sections:
ranges, drawing. All logs are of the exact plant with a delay that is believed to be 0.8 s and is
130 ms longer, logged while `adaptive_lqi` had the measured state: a multisine of 20 s around half
the paper's amplitude, crank angles in 14 bit at 50 Hz, whose zero within a step is random. "With
pose" is a pose beside them, off by 0.1 mrad and 20 um, and encoder offsets of 2 mrad nobody knows.
Times are the CPU's.

`ranges` draws machines as `analyze robustness` does; the tolerances of lengths and joints are the
root mean square of what it draws. `drawing` draws lengths and joints with a standard deviation of
0.2 mm, the default tolerance.

The next run of each machine is the paper's at full amplitude, its state measured without noise and
nothing limiting its torques but the motors, of a controller that goes by what was found
(`mechanism.yaml`, `calibration.yaml`); beside it one that knows the truth, and one that has the
drawing and the delay that was found.
"""

import dataclasses
import os
import sys
import time
from collections.abc import Callable
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, NamedTuple

import numpy as np
from _bench import RESULTS, size
from joblib import Parallel, delayed

import stewart_drake as sd
from stewart_drake.files.versions import versions
from stewart_drake.identification.identify import Identification, identify
from stewart_drake.identification.logs import ANGLES, NUM_MEASURED, POSE, Log, Precision
from stewart_drake.identification.plan import fitted_multisine
from stewart_drake.identification.tolerances import Tolerances
from stewart_drake.identification.unknowns import DELAY, DYNAMIC, GEOMETRY, NAMES, OFFSETS
from stewart_drake.loop.preparation import prepare
from stewart_drake.loop.results import SimulationResult
from stewart_drake.loop.simulation import simulate
from stewart_drake.mechanism.files import load_mechanism, mechanism_yaml
from stewart_drake.mechanism.geometry import Mechanism, fingerprint
from stewart_drake.scenario.calibration import CALIBRATED, Calibration, save_calibration
from stewart_drake.scenario.config import Scenario
from stewart_drake.scenario.loading import load_scenario
from stewart_drake.scenario.signals import COULOMB_SPEED
from stewart_drake.studies import uncertainty
from stewart_drake.studies.study_options import Ranges
from stewart_drake.types import Array

MACHINES = size("MACHINES", 50)
FRESH = int(os.environ.get("FRESH", "1000"))
"""The first seed; those below were looked at while this was made."""
AMPLITUDE = np.array([0.2617993878] * 3 + [0.02, 0.02, 0.08])
LATE = 0.13
STEP = 2 * np.pi / 2**14
PRECISION = Precision()
TOLERANCE = 2e-4
OFFSET = 2e-3
STARTS = {"on the reference": ("start=on_reference", "queue=reference"), "from rest": ()}
PLANT = (
    "torque_bias",
    "payload_mass",
    "joint_damping",
    "coulomb_friction",
    "coulomb_speed",
    "payload_position",
)
"""Fields of the plant that a draw changes."""
GOES_BY = ("what was found", "the truth", "the drawing, and the delay that was found")


def excitation(folder: Path) -> Path:
    """A multisine of 20 s as a CSV motion."""
    path = folder / "multisine.csv"
    mechanism = sd.load_mechanism("paper")
    times, poses, _ = fitted_multisine(mechanism, mechanism.home, AMPLITUDE / 2, 20.0)
    rows = "\n".join(
        ",".join(f"{x:.12g}" for x in (t, *p)) for t, p in zip(times, poses, strict=True)
    )
    path.write_text(f"time[s],roll[rad],pitch[rad],yaw[rad],x[m],y[m],z[m]\n{rows}\n")
    return path


class Truth(NamedTuple):
    """A machine, the scenario of its log, and what of the unknowns is true (NaN: not drawn)."""

    mechanism: Mechanism
    scenario: Scenario
    values: Array


def of_ranges(seed: int, motion: Path, calm: float) -> Truth:
    """A draw of the robustness study; `calm` is of `calm_torque`."""
    scenario = log_scenario(motion)
    experiment = prepare(scenario)
    scales = uncertainty.scales_of(experiment, calm)
    one = uncertainty.draw(Ranges(), scales, scenario, FRESH, seed)
    changed = uncertainty.apply_draw(uncertainty.MACHINE, scenario, experiment.mechanism, one)
    machine, drawn = changed.machine(), changed.as_scenario()
    values = truth_of(machine, drawn)
    values[6] += machine.plate.mass - experiment.mechanism.plate.mass
    return Truth(machine, drawn, values)


def calm_torque(motion: Path) -> float:
    """Largest that the undisturbed run commands, N m."""
    scenario = load_scenario("paper", "adaptive_lqi", _settings(motion, late=0.0))
    return simulate(scenario, judge_stability=False).summary["peak_torque"]


def of_drawing(seed: int, motion: Path) -> Truth:
    """A machine built with the default tolerances, with bias, payload and friction."""
    rng, m = np.random.default_rng(FRESH + seed), sd.load_mechanism("paper")

    def off(value: Array) -> Array:
        return value + TOLERANCE * rng.standard_normal(value.shape)

    machine = dataclasses.replace(
        m,
        crank_lengths=off(m.crank_lengths),
        rod_lengths=off(m.rod_lengths),
        p_WS=off(m.p_WS),
        p_PQ=off(m.p_PQ),
    )
    bias = ",".join(f"{x:.6g}" for x in 3e-4 * rng.standard_normal(6))
    place = ",".join(f"{x:.6g}" for x in 0.02 * rng.standard_normal(3))
    extra = (
        f"plant.torque_bias=[{bias}]",
        f"plant.payload_mass={0.4 * rng.uniform():.6g}",
        f"plant.payload_position=[{place}]",
        f"plant.joint_damping={1e-3 * rng.uniform():.6g}",
        f"plant.coulomb_friction={3e-4 * rng.uniform():.6g}",
    )
    scenario = load_scenario("paper", "adaptive_lqi", (*_settings(motion), *extra))
    return Truth(machine, scenario, truth_of(machine, scenario))


def _settings(motion: Path, late: float = LATE) -> tuple[str, ...]:
    steps, rest = divmod(round(0.8 + late, 9), 0.1)
    return (
        "plant.kind=exact",
        f"delay.steps={int(steps + 1e-9)}",
        f"delay.fraction={round(rest / 0.1, 9) % 1:.9g}",
        "controller.delay_steps=8",
        "reference.kind=csv",
        f"reference.file={motion}",
        "duration=20",
    )


def log_scenario(motion: Path) -> Scenario:
    """The run that is logged."""
    return load_scenario("paper", "adaptive_lqi", _settings(motion))


def truth_of(machine: Mechanism, scenario: Scenario) -> Array:
    """True values of the unknowns, without offsets."""
    values, plant = np.zeros(len(NAMES)), scenario.plant
    values[DYNAMIC] = [
        *plant.torque_bias,
        plant.payload_mass,
        plant.joint_damping,
        plant.coulomb_friction,
        plant.coulomb_speed,
        *plant.payload_position,
    ]
    legs = [machine.crank_lengths, machine.rod_lengths, machine.p_PQ, machine.p_WS]
    values[GEOMETRY] = np.column_stack(legs).ravel()
    values[DELAY] = scenario.eta
    return values


def log_of(run: SimulationResult, machine: Mechanism, seed: int, poses: bool) -> tuple[Log, Array]:
    """What encoders and, where asked for, a sensor of poses saw of a run; and the offsets."""
    rng, signals, period = np.random.default_rng(seed), run.signals, run.scenario.controller.period
    time = signals.time.values
    sent = period * np.arange(int(time[-1] / period + 1e-9) + 1)
    rows = np.searchsorted(time, sent - 1e-9)
    on_grid = np.abs(time / 0.02 - np.round(time / 0.02)) < 1e-6
    pose = signals.pose.values[on_grid]
    offsets = OFFSET * rng.standard_normal(6) if poses else np.zeros(6)
    phase = STEP * rng.uniform(size=6)
    angles = np.array([machine.crank_angles(one) for one in pose]) + offsets
    values = np.full((len(pose), NUM_MEASURED), np.nan)
    values[:, ANGLES] = STEP * np.round((angles + phase) / STEP) - phase
    if poses:
        noise = PRECISION.std[POSE] * rng.standard_normal(pose.shape)
        values[:, POSE] = pose + noise
    limit = run.scenario.actuator.torque_limit or machine.effort_limit
    torques = np.clip(signals.torque_commanded.values[rows], -limit, limit)
    gravity = 9.81 if run.scenario.plant.gravity else 0.0
    log = Log("run", sent, torques, time[on_grid], values, PRECISION.std, gravity, 0.8)
    return log, offsets


class Found(NamedTuple):
    """Of one machine."""

    status: str
    late: float
    """s, error of the delay."""
    chi2: float
    seconds: float
    inside: Array
    """(unknowns,) whether the 95 % interval holds the truth; NaN where nothing was sought."""
    away: Array
    """(unknowns,) error."""
    next_runs: Array
    """(3, 2) E_ac by GOES_BY and STARTS; NaN for a run that did not complete."""


def find(kind: str, seed: int, motion: Path, calm: float, poses: bool) -> Found:
    """Draw a machine, log it, find it."""
    truth = of_ranges(seed, motion, calm) if kind == "ranges" else of_drawing(seed, motion)
    run = simulate(truth.scenario, true_mechanism=truth.mechanism, judge_stability=False)
    log, offsets = log_of(run, truth.mechanism, FRESH + seed, poses)
    found, seconds = identified(log, kind, poses)
    true = truth.values.copy()
    true[OFFSETS] = offsets
    values, std = found.fit.guess.values, found.std
    away = np.where(std > 0, values - true, np.nan)
    inside = np.where(std > 0, np.abs(away) <= 1.96 * std, np.nan)
    if true[6] == 0:  # where no payload is, it is nowhere
        inside[COULOMB_SPEED + 1 : DYNAMIC.stop] = np.nan
    following = next_runs(truth, found, true)
    late, chi2 = float(away[DELAY]), found.chi2["all"]
    return Found(run.status, late, chi2, seconds, inside, away, following)


def next_runs(truth: Truth, found: Identification, true: Array) -> Array:
    """(3, 2) as of `Found.next_runs`; `true` values of the unknowns."""
    unknowns = found.unknowns
    drawn = unknowns.mean.copy()
    drawn[DELAY] = found.values[DELAY]
    return np.array(
        [
            runs_by(truth, found.mechanism, found.calibration),
            runs_by(truth, unknowns.machine(true), lambda m: surely(m, true, CALIBRATED)),
            runs_by(truth, unknowns.mechanism, lambda m: surely(m, drawn, (NAMES[DELAY],))),
        ]
    )


def runs_by(
    truth: Truth, machine: Mechanism, known: Callable[[Mechanism], Calibration]
) -> tuple[float, ...]:
    """E_ac by STARTS of a controller that goes by a machine and what is known of it."""
    plant, delay = truth.scenario.plant, truth.scenario.delay
    with TemporaryDirectory() as folder:
        mechanism, file = Path(folder) / "mechanism.yaml", Path(folder) / "calibration.yaml"
        mechanism.write_text(mechanism_yaml(machine))
        save_calibration(file, known(load_mechanism(mechanism)))
        settings = (
            "plant.kind=exact",
            *(f"plant.{name}={getattr(plant, name)}" for name in PLANT),
            f"delay.steps={delay.steps}",
            f"delay.fraction={delay.fraction}",
            f"mechanism={mechanism}",
            f"controller.calibration={file}",
        )
        runs = (
            simulate(
                load_scenario("paper", "predictor_lqi", (*settings, *start)),
                true_mechanism=truth.mechanism,
                judge_stability=False,
            )
            for start in STARTS.values()
        )
        return tuple(run.accumulated_error for run in runs)


def surely(machine: Mechanism, values: Array, names: tuple[str, ...]) -> Calibration:
    """Of the unknowns' values, those of names, without a doubt."""
    mean = values[[NAMES.index(name) for name in names]]
    return Calibration(fingerprint(machine), names, mean, np.zeros((len(names), len(names))))


def identified(log: Log, kind: str, poses: bool) -> tuple[Identification, float]:
    """The machine of a log, and the CPU's seconds."""
    mechanism, tolerances = sd.load_mechanism("paper"), Tolerances(offsets=OFFSET if poses else 0.0)
    if kind == "ranges":
        drawn = Ranges().lengths * float(mechanism.crank_lengths.mean()) / np.sqrt(3)
        tolerances = dataclasses.replace(tolerances, lengths=drawn, joints=drawn)
    before = time.process_time()
    found = identify([log], mechanism, tolerances)
    found.summary  # noqa: B018
    return found, time.process_time() - before


GROUPS: dict[str, Any] = {
    "delay": DELAY,
    "torque bias": slice(0, 6),
    "payload": 6,
    "damping": 7,
    "Coulomb friction": 8,
    "payload's place": slice(10, 13),
    "lengths and joints": GEOMETRY,
    "offsets": OFFSETS,
    "all": slice(None),
}


def machines(kind: str) -> str:
    """The tables of so many machines."""
    jobs = Parallel(n_jobs=int(os.environ.get("JOBS", "-1")))
    with TemporaryDirectory() as folder:
        motion = excitation(Path(folder))
        calm = calm_torque(motion)
        return "\n".join(
            table(
                f"{kind}, {'with pose' if poses else 'encoders alone'}",
                jobs(delayed(find)(kind, seed, motion, calm, poses) for seed in range(MACHINES)),
            )
            for poses in (False, True)
        )


def table(title: str, found: list[Found]) -> str:
    """Errors and coverage by kind of unknown."""
    late = 1e3 * np.abs([one.late for one in found])
    chi2, seconds = [one.chi2 for one in found], [one.seconds for one in found]
    lost = sum(one.status != "completed" for one in found)
    text = (
        f"## {title}: {len(found)} machines, {lost} of the runs lost\n\n"
        f"error of the delay: rms {np.sqrt(np.mean(late**2)):.3g} ms, largest {late.max():.3g} ms; "
        f"chi2/n {min(chi2):.3g} to {max(chi2):.3g}; CPU {np.mean(seconds):.3g} s, at most "
        f"{max(seconds):.3g} s\n\n| unknown | rms error | 95 % intervals that hold the truth |\n"
        "| --- | --- | --- |\n"
    )
    inside, away = (np.array([getattr(one, name) for one in found]) for name in ("inside", "away"))
    for name, part in GROUPS.items():
        if np.isfinite(inside[:, part]).any():
            size = np.sqrt(np.nanmean(away[:, part] ** 2))
            shown = "" if name == "all" else f"{size:.2g}"
            text += f"| {name} | {shown} | {100 * np.nanmean(inside[:, part]):.1f} % |\n"
    return text + next_table(np.array([one.next_runs for one in found]))


def next_table(errors: Array) -> str:
    """Of (machines, 3, 2): mean E_ac of the next runs, and the largest, by what is gone by."""
    heads = ("the next run goes by", *(f"{start}: mean, largest" for start in STARTS))
    text = f"\n| {' | '.join(heads)} |\n| {' | '.join(['---'] * len(heads))} |\n"
    for row, name in enumerate(GOES_BY):
        cells = [name]
        for one in errors[:, row].T:
            done = one[np.isfinite(one)]
            lost = "" if len(done) == len(one) else f", {len(one) - len(done)} lost"
            cells.append((f"{done.mean():.3g}, {done.max():.3g}" if len(done) else "-") + lost)
        text += f"| {' | '.join(cells)} |\n"
    extra = errors[:, 0] - errors[:, 1]
    worst = ", ".join(
        f"{np.nanmean(one):.3g} and {np.nanmax(one):.3g} {start}"
        for start, one in zip(STARTS, extra.T, strict=True)
        if np.isfinite(one).any()
    )
    return f"{text}\nFound less truth, mean and largest: {worst}.\n"


SECTIONS = {"ranges": lambda: machines("ranges"), "drawing": lambda: machines("drawing")}


def main() -> None:
    """Write the results of the sections that are asked for, all of them by default."""
    RESULTS.mkdir(parents=True, exist_ok=True)
    names = sys.argv[1:] or list(SECTIONS)
    text = "\n".join(SECTIONS[name]() for name in names)
    made = ", ".join(f"{name} {version}" for name, version in versions().items())
    print(text)
    (RESULTS / "identification.md").write_text(f"# Machines from their logs\n\n{made}\n\n{text}")


if __name__ == "__main__":
    main()
