"""Machines identified from their logs.

MACHINES of the environment is their number. All logs are of the exact plant with a delay that is
believed to be 0.8 s and is 130 ms longer, logged while `adaptive_lqi` measured the state: a
multisine of 20 s around half the paper's amplitude, crank angles in 14 bit at 50 Hz, with a random
phase of the codes. "With pose" adds a pose with errors of 0.1 mrad and 20 um, and unknown encoder
offsets of 2 mrad. Times are the CPU's.

`ranges` draws machines as `analyze robustness` does; the tolerances of lengths and joints are the
root mean square of the draws. `drawing` draws lengths and joints with a standard deviation of
0.2 mm, the default tolerance.

The next run of each machine is the paper's at full amplitude, its state measured without noise,
torques limited by the motors only. Its controller uses the identified machine (`mechanism.yaml`,
`calibration.yaml`). For comparison one uses the true values, and one the drawing with the
identified delay.
"""

import dataclasses
import os
import time
from collections.abc import Callable
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, NamedTuple

import numpy as np
from _bench import (
    AMPLITUDE,
    EXACT,
    ON,
    delay_settings,
    in_parallel,
    run_sections,
    section,
    size,
    table,
)

import stewart_drake as sd
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
"""First seed; lower ones were used during development."""
LATE = 0.13
STEP = 2 * np.pi / 2**14
PRECISION = Precision()
TOLERANCE = 2e-4
OFFSET = 2e-3
STARTS = {"on the reference": ON, "from rest": ()}
PLANT = (
    "torque_bias",
    "payload_mass",
    "joint_damping",
    "coulomb_friction",
    "coulomb_speed",
    "payload_position",
    "ball_joint_damping",
    "ball_joint_friction",
    "ball_joint_friction_speed",
)
"""Fields of the plant that a draw changes, in the order of the unknowns."""
KNOWLEDGE = ("the identified machine", "the truth", "the drawing and the identified delay")


def excitation(folder: Path) -> Path:
    """Write a multisine of 20 s as a CSV motion."""
    path = folder / "multisine.csv"
    mechanism = sd.load_mechanism("paper")
    times, poses, _ = fitted_multisine(mechanism, mechanism.home, AMPLITUDE / 2, 20.0)
    rows = "\n".join(
        ",".join(f"{x:.12g}" for x in (t, *p)) for t, p in zip(times, poses, strict=True)
    )
    path.write_text(f"time[s],roll[rad],pitch[rad],yaw[rad],x[m],y[m],z[m]\n{rows}\n")
    return path


class Truth(NamedTuple):
    """A machine, the scenario of its log, and true values of the unknowns (NaN: not drawn)."""

    mechanism: Mechanism
    scenario: Scenario
    values: Array


def log_scenario(motion: Path, *more: str, late: float = LATE) -> Scenario:
    """Return the scenario of a log."""
    settings = (
        *(EXACT, *delay_settings(0.8 + late), "controller.delay_steps=8"),
        *("reference.kind=csv", f"reference.file={motion}", "duration=20"),
    )
    return load_scenario("paper", "adaptive_lqi", (*settings, *more))


def of_ranges(seed: int, motion: Path, calm: float) -> Truth:
    """Return a draw of the robustness study; `calm` is of `calm_torque`."""
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
    """Return the largest torque that the undisturbed run commands, N m."""
    scenario = log_scenario(motion, late=0.0)
    return simulate(scenario, judge_stability=False).summary["peak_torque"]


def of_drawing(seed: int, motion: Path) -> Truth:
    """Return a machine within the default tolerances, with bias, payload and friction."""
    rng, m = np.random.default_rng(FRESH + seed), sd.load_mechanism("paper")
    names = ("crank_lengths", "rod_lengths", "p_WS", "p_PQ")
    arrays = {name: getattr(m, name) for name in names}
    off = {name: a + TOLERANCE * rng.standard_normal(a.shape) for name, a in arrays.items()}
    machine = dataclasses.replace(m, **off)
    bias = ",".join(f"{x:.6g}" for x in 3e-4 * rng.standard_normal(6))
    place = ",".join(f"{x:.6g}" for x in 0.02 * rng.standard_normal(3))
    scenario = log_scenario(
        motion,
        f"plant.torque_bias=[{bias}]",
        f"plant.payload_mass={0.4 * rng.uniform():.6g}",
        f"plant.payload_position=[{place}]",
        f"plant.joint_damping={1e-3 * rng.uniform():.6g}",
        f"plant.coulomb_friction={3e-4 * rng.uniform():.6g}",
    )
    return Truth(machine, scenario, truth_of(machine, scenario))


def truth_of(machine: Mechanism, scenario: Scenario) -> Array:
    """Return true values of the unknowns, without offsets."""
    values = np.zeros(len(NAMES))
    values[DYNAMIC] = np.hstack([getattr(scenario.plant, name) for name in PLANT])
    legs = [machine.crank_lengths, machine.rod_lengths, machine.p_PQ, machine.p_WS]
    values[GEOMETRY] = np.column_stack(legs).ravel()
    values[DELAY] = scenario.eta
    return values


def log_of(run: SimulationResult, machine: Mechanism, seed: int, poses: bool) -> tuple[Log, Array]:
    """Return the log of a run by encoders, on request with a sensor of poses; and the offsets."""
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
        values[:, POSE] = pose + PRECISION.std[POSE] * rng.standard_normal(pose.shape)
    limit = run.scenario.actuator.torque_limit or machine.effort_limit
    torques = np.clip(signals.torque_commanded.values[rows], -limit, limit)
    gravity = 9.81 if run.scenario.plant.gravity else 0.0
    log = Log("run", sent, torques, time[on_grid], values, PRECISION.std, gravity, 0.8)
    return log, offsets


class Found(NamedTuple):
    """Identification of one machine.

    Attributes:
        status: of the logged run; `refused` where its log is too short, with NaN in all others.
        late: s, error of the delay.
        chi2: per measurement.
        seconds: CPU time.
        inside: (unknowns,) whether the 95 % interval holds the truth; NaN for fixed ones.
        away: (unknowns,) error.
        next_runs: (3, 2) E_ac by KNOWLEDGE and STARTS; NaN for a run that did not complete.
    """

    status: str
    late: float
    chi2: float
    seconds: float
    inside: Array
    away: Array
    next_runs: Array


def find(kind: str, seed: int, motion: Path, calm: float, poses: bool) -> Found:
    """Draw a machine, log it, identify it."""
    truth = of_ranges(seed, motion, calm) if kind == "ranges" else of_drawing(seed, motion)
    run = simulate(truth.scenario, true_mechanism=truth.mechanism, judge_stability=False)
    log, offsets = log_of(run, truth.mechanism, FRESH + seed, poses)
    try:
        found, seconds = identified(log, kind, poses)
    except sd.ConfigError:
        nothing = np.full(len(NAMES), np.nan)
        return Found("refused", *(np.nan,) * 3, nothing, nothing, np.full((3, 2), np.nan))
    true = truth.values.copy()
    true[OFFSETS] = offsets
    values, std = found.fit.guess.values, found.std
    away = np.where(std > 0, values - true, np.nan)
    inside = np.where(std > 0, np.abs(away) <= 1.96 * std, np.nan)
    if true[6] == 0:  # the position of no payload
        inside[COULOMB_SPEED + 1 : DYNAMIC.stop] = np.nan
    following = next_runs(truth, found, true)
    return Found(
        run.status, float(away[DELAY]), found.chi2["all"], seconds, inside, away, following
    )


def next_runs(truth: Truth, found: Identification, true: Array) -> Array:
    """Return (3, 2) as of `Found.next_runs`; `true` values of the unknowns."""
    unknowns = found.unknowns
    drawn = unknowns.mean.copy()
    drawn[DELAY] = found.values[DELAY]
    return np.array(
        [
            runs_with(truth, found.mechanism, found.calibration),
            runs_with(truth, unknowns.machine(true), lambda m: exactly(m, true, CALIBRATED)),
            runs_with(truth, unknowns.mechanism, lambda m: exactly(m, drawn, (NAMES[DELAY],))),
        ]
    )


def runs_with(
    truth: Truth, machine: Mechanism, calibration: Callable[[Mechanism], Calibration]
) -> tuple[float, ...]:
    """Return E_ac by STARTS with a machine and a calibration in the controller."""
    plant, delay = truth.scenario.plant, truth.scenario.delay
    with TemporaryDirectory() as folder:
        mechanism, file = Path(folder) / "mechanism.yaml", Path(folder) / "calibration.yaml"
        mechanism.write_text(mechanism_yaml(machine))
        save_calibration(file, calibration(load_mechanism(mechanism)))
        settings = (
            EXACT,
            *(f"plant.{name}={getattr(plant, name)}" for name in PLANT),
            *(f"delay.steps={delay.steps}", f"delay.fraction={delay.fraction}"),
            *(f"mechanism={mechanism}", f"controller.calibration={file}"),
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


def exactly(machine: Mechanism, values: Array, names: tuple[str, ...]) -> Calibration:
    """Return some of the unknowns as a calibration without uncertainty."""
    mean = values[[NAMES.index(name) for name in names]]
    return Calibration(fingerprint(machine), names, mean, np.zeros((len(names), len(names))))


def identified(log: Log, kind: str, poses: bool) -> tuple[Identification, float]:
    """Return the machine of a log, and the CPU time in s."""
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
    """Return the tables of a kind of machines, without and with poses."""
    with TemporaryDirectory() as folder:
        motion = excitation(Path(folder))
        calm = calm_torque(motion)
        found = {
            name: in_parallel(find, [(kind, k, motion, calm, poses) for k in range(MACHINES)])
            for name, poses in (("encoders alone", False), ("with pose", True))
        }
    return "\n".join(summary(f"{kind}, {name}", some) for name, some in found.items())


def summary(title: str, found: list[Found]) -> str:
    """Return errors and coverage by kind of unknown, and the next runs."""
    late = 1e3 * np.abs([one.late for one in found])
    chi2, seconds = [one.chi2 for one in found], [one.seconds for one in found]
    lost = sum(one.status != "completed" for one in found)
    refused = sum(one.status == "refused" for one in found)
    words = (
        f"error of the delay: rms {np.sqrt(np.nanmean(late**2)):.3g} ms, largest "
        f"{np.nanmax(late):.3g} ms; chi2/n {np.nanmin(chi2):.3g} to {np.nanmax(chi2):.3g}; CPU "
        f"{np.nanmean(seconds):.3g} s, at most {np.nanmax(seconds):.3g} s"
    )
    inside, away = (np.array([getattr(one, name) for one in found]) for name in ("inside", "away"))
    rows = []
    for name, part in GROUPS.items():
        if np.isfinite(inside[:, part]).any():
            rms = "" if name == "all" else f"{np.sqrt(np.nanmean(away[:, part] ** 2)):.2g}"
            rows.append((name, rms, f"{100 * np.nanmean(inside[:, part]):.1f} %"))
    heads = ("unknown", "rms error", "95 % intervals that hold the truth")
    return section(
        f"{title}: {len(found)} machines, {lost} of the runs lost, {refused} logs too short",
        words,
        table(heads, rows),
        *next_table(np.array([one.next_runs for one in found])),
    )


def next_table(errors: Array) -> tuple[str, str]:
    """Return mean and largest E_ac of the next runs (machines, 3, 2), and their excess."""
    rows = []
    for row, name in enumerate(KNOWLEDGE):
        cells = [name]
        for one in errors[:, row].T:
            done = one[np.isfinite(one)]
            lost = "" if len(done) == len(one) else f", {len(one) - len(done)} lost"
            cells.append((f"{done.mean():.3g}, {done.max():.3g}" if len(done) else "-") + lost)
        rows.append(cells)
    extra = errors[:, 0] - errors[:, 1]
    worst = ", ".join(
        f"{np.nanmean(one):.3g} and {np.nanmax(one):.3g} {start}"
        for start, one in zip(STARTS, extra.T, strict=True)
        if np.isfinite(one).any()
    )
    heads = ("the next run uses", *(f"{start}: mean, largest" for start in STARTS))
    return table(heads, rows), f"Identified minus truth, mean and largest: {worst}."


if __name__ == "__main__":
    sections = {kind: lambda kind=kind: machines(kind) for kind in ("ranges", "drawing")}
    run_sections(__file__, "Machines from their logs", sections)
