"""Numbers of Reachy Mini's servos from logs of its own MuJoCo model.

    REACHY_PYTHON=PATH python benchmarks/reachy_logs.py [ROW ...]

PATH is the environment of `reachy.py`; without it the benchmark is skipped. SEEDS is the number of
logs per row. With rows such as perfect-0.1, a servo and its ball joints, only these are printed.

A log has the setpoints of `identify --plan reachy_mini`, 12 s at 50 Hz, and crank angles in 12
bits. Setpoints act 20 to 60 ms late, and angles are 8 ms old. Each seed has its own motion, delay
and phase of the codes. The machine and the motors' torque limit are known.

MuJoCo moves positions by the speeds at the end of a step, so that torques act half a step earlier:
the true delay is that of the continuous machine. Its implicit damping adds half a step times the
damping to the armature. With steps of 1 ms that is 2.6 % of the armature of xc330, nearly the width
of its interval; its logs with free ball joints have steps of 0.25 ms.

The head then follows a motion that is not in the log, of three frequencies. Its setpoints have the
numbers found and are sent ahead by the delay found, so that an error of the delay shifts the
motion. They are not checked against the torque limit, which the simulated servos have.

MuJoCo limits the friction of a ball joint about each axis; its true value is the equivalent of
`reachy.BALL`. The page in results/ has 20 logs of xc330 with free ball joints and 5 of perfect, two
where ball joints have a part of their friction, and one as shipped.
"""

import os
import sys
import tempfile
import time
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from _bench import in_parallel, run_sections, section, size, table
from reachy import BALL, PERIOD, SERVOS, angle_error, motion_file, play, setpoints

import stewart_drake as sd
from stewart_drake.identification.logs import angle_std
from stewart_drake.identification.servo_fit import NAMES, identify_servos
from stewart_drake.identification.servo_logs import ServoLog, servo_log
from stewart_drake.identification.servo_plan import plan_servos
from stewart_drake.loop.preparation import prepare

SEEDS = size("SEEDS", 5)
ROWS = [
    ("perfect", 0.0, 1e-3),
    ("xc330", 0.0, 2.5e-4),
    ("perfect", 0.1, 1e-3),
    ("xc330", 0.1, 1e-3),
    ("perfect", 1.0, 1e-3),
]
"""Servo, share of the ball joints' friction as shipped, and step of the physics in s."""
BITS, READING = 12, 0.008
"""Bits of a turn, and age of a measured angle in s."""
CODE = 2 * np.pi / 2**BITS
OTHER = (0.4, 0.7, 1.0)
"""Frequencies in Hz of the motion that is not in the log."""
NUMBERS = ("delay", "stiffness", "damping", "friction", "armature")
"""What MuJoCo's servos have, too."""
UNITS = {"s": ("ms", 1e3), "rad": ("mrad", 1e3)}
"""Of the table, where others than those of `identify`."""


class Found(NamedTuple):
    """Result of one log.

    Attributes:
        numbers: by name the true value, the error, half the width of the interval, and the unit.
        head: error of the head in degrees: plain setpoints, true numbers, numbers found.
        seconds: of the processor.
    """

    numbers: dict[str, tuple[float, float, float, str]]
    head: tuple[float, float, float]
    seconds: float


def log_of(
    planned: np.ndarray, servo: Any, ball: float, step: float, delay: float, seed: int
) -> ServoLog:
    """Return a log of the robot's model under setpoints (n, 6); `delay` is that of the log, s."""
    number = len(planned)
    instants = step * np.arange(round(number * PERIOD / step))
    newest = np.floor((instants - (delay - READING)) / PERIOD + 1e-9).astype(int)
    rows = planned[np.maximum(newest, 0)]
    cranks = play(servo, ball, rows, planned[0], step=step, period=step)["cranks"]
    times = PERIOD * np.arange(number)
    seen = np.round((times - READING) / step).astype(int) - 1  # row k ends at (k + 1) step
    phase = np.random.default_rng(seed).uniform(-0.5, 0.5, 6)
    rounded = CODE * (np.round(cranks[np.maximum(seen, 0)] / CODE - phase) + phase)
    return servo_log("log", times, planned, rounded, sd.load_mechanism("reachy_mini"))


def identified(planned: np.ndarray, name: str, ball: float, step: float, seed: int) -> Found:
    """Return what the log of a seed shows, and the errors of the head."""
    kp, kv, damping, friction, armature, force = servo = SERVOS[name]
    late = 1e-3 * float(np.random.default_rng(seed).integers(20, 61))
    delay = READING + late - 0.5 * step
    log = log_of(planned, servo, ball, step, delay, seed)
    began = time.process_time()
    machine = replace(sd.load_mechanism("reachy_mini"), effort_limit=force)
    fit = identify_servos(log, machine, angle_std(BITS))
    seconds = time.process_time() - began
    values = dict(zip(NAMES, fit.theta.tolist(), strict=True))
    true = dict(zip(NUMBERS, (delay, kp, kv + damping, friction, armature), strict=True))
    true |= {n: ball * one for n, one in BALL.items() if ball > 0}
    found = {
        n: (true[n], values[n] - true[n], one["interval"], one["unit"])
        for n, one in fit.summary["parameters"].items()
        if n in true
    }
    sums = (delay + (kv + damping) / kp, friction / kp)
    for truth, (n, (value, width, unit)) in zip(sums, fit.combined.items(), strict=True):
        found[n] = truth, value - truth, width, unit
    unlimited = 1e3
    with tempfile.TemporaryDirectory() as folder:
        motion = motion_file(OTHER, Path(folder))
        ahead = motion_file(OTHER, Path(folder), ahead=values["delay"] - delay)
        more = [f"plant.{n}={values[n]:.9g}" for n in BALL]
        more.append(f"actuator.friction_speed={values['friction_speed']:.9g}")
        numbers = values["stiffness"], 0.0, *(values[n] for n in NUMBERS[2:]), unlimited
        sent = (
            setpoints(motion, servo, plain=True),
            setpoints(motion, (*servo[:5], unlimited), ball),
            setpoints(ahead, numbers, more=more),
        )
    first = sent[0][0]
    plain, truly, mine = (
        angle_error(play(servo, ball, rows, first)["rotations"], OTHER) for rows in sent
    )
    return Found(found, (plain, truly, mine), seconds)


def row(name: str, ball: float, step: float) -> str:
    """Return the section of a servo and its ball joints."""
    experiment = prepare(sd.load_scenario("reachy_mini"))
    plans = [plan_servos(experiment, angle_std(BITS), seed=seed).log for seed in range(SEEDS)]
    cases = [(plan.setpoints, name, ball, step, seed) for seed, plan in enumerate(plans)]
    logs = in_parallel(identified, cases)
    rows = []
    for number in logs[0].numbers:
        true, errors, widths = np.array([log.numbers[number][:3] for log in logs]).T
        unit = logs[0].numbers[number][3]
        shown, scale = UNITS.get(unit, (unit, 1.0))
        inside = int(np.sum(np.abs(errors) <= widths))
        worst = int(np.argmax(np.abs(errors)))
        share = f"{100 * errors[worst] / true[worst]:+.1f} %"
        cells = (f"{scale * x:.3g}" for x in (true.mean(), errors[worst], np.median(widths)))
        rows.append([number, shown, *cells, share, f"{inside} of {len(logs)}"])
    heads = np.array([log.head for log in logs])
    plain, truly, _ = heads.mean(axis=0)
    seconds = [log.seconds for log in logs]
    return section(
        f"{name}, ball joints with {100 * ball:g} % of their friction as shipped",
        f"Head, degrees rms: plain {plain:.2f}, true numbers {truly:.2f}, numbers found "
        f"{heads[:, 2].mean():.2f} (worst {heads[:, 2].max():.2f}). Time of `identify`: "
        f"{min(seconds):.0f} to {max(seconds):.0f} s.",
        table(["number", "unit", "true", "worst error", "interval", "share", "inside"], rows),
    )


if __name__ == "__main__":
    if not os.environ.get("REACHY_PYTHON"):
        sys.exit("skipped: REACHY_PYTHON is not set, see the head of reachy.py")
    sections = {f"{name}-{ball:g}": partial(row, name, ball, step) for name, ball, step in ROWS}
    run_sections(__file__, "Numbers of Reachy Mini's servos from logs", sections)
