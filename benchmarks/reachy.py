"""Setpoints for Reachy Mini, judged in the robot's own MuJoCo model.

    REACHY_PYTHON=PATH python benchmarks/reachy.py

PATH is the Python of an environment with `mujoco==3.3.0`, and `reachy-mini==1.13.0` installed
without its dependencies (`pip install --no-deps`). Without it the benchmark is skipped.

The head turns by 0.2 rad and moves by 5 mm about and along three axes each. Setpoints come from
`sd.setpoints`, at 50 Hz. The error is the angle between the head and the motion at the end of each
period, rms from 2 s to 8 s.
"""

import os
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from _bench import table, write

import stewart_drake as sd
from stewart_drake.law.learned import LearnedSignal
from stewart_drake.law.servos import rise
from stewart_drake.loop.learned import harmonics_below
from stewart_drake.machines.reachy_mini import pose_of_head
from stewart_drake.mechanism.files import load_mechanism
from stewart_drake.mechanism.kinematics import rotation
from stewart_drake.studies.learn import Anderson, corrected_setpoints, fit

PLAYER = Path(__file__).with_name("reachy_player.py")
PERIOD, DURATION, SETTLED = 0.02, 8.0, 2.0
FREQUENCIES = (0.5, 1.0)
SERVOS = {
    "perfect": (10.0, 0.1, 0.15, 0.1, 0.001, 20.0),
    "xc330": (2.54, 0.0, 0.095, 0.058, 0.0018, 0.8),
}
"""Classes of the robot's MJCF: kp, kv, damping, friction, armature, force limit."""
WRONG = np.array([1.1, 0.9, 0.9, 0.9, 1.1])
"""Factors of the numbers that the setpoints assume, in the row `10 % wrong`."""
BALL = {"ball_joint_damping": 0.15, "ball_joint_friction": 0.1 * 4 / np.pi}
"""Of each ball joint as shipped. MuJoCo limits the friction about each axis of a joint by itself:
for turns about two axes at random, 4 / pi times the friction against the whole turn."""
REPETITIONS = 7
"""The first one without learning; rows with learning have the best of them, and its number."""
PREVIEW, PLAN = 0.25, 16
"""s from a plan to its first setpoint, and setpoints of a plan."""


def head_at(times: np.ndarray, frequency: Any) -> tuple[np.ndarray, np.ndarray]:
    """Return the head's rotations (n, 3, 3) and positions (n, 3) in m, from rest at t = 0.

    `frequency` in Hz is one number, or three of the axes.
    """
    phase = 2 * np.pi * np.broadcast_to(frequency, 3) * times[:, None]
    g = rise(times)[:, None]  # accelerations, and so torques, do not jump
    rotations = np.array([rotation(one) for one in 0.2 * g * np.sin(phase + [0.0, 1.0, 2.0])])
    return rotations, 0.005 * g * np.sin(phase + [0.0, np.pi / 2, 0.5])


def motion_file(
    frequency: Any, folder: Path, duration: float = DURATION + 1.0, ahead: float = 0.0
) -> Path:
    """Write the motion as CSV, as a reference of `kind: csv` reads it, ahead by a time in s."""
    times = np.arange(0.0, duration, 0.005)
    rows = ["time[s],roll[rad],pitch[rad],yaw[rad],x[m],y[m],z[m]"]
    for t, R, p in zip(times, *head_at(times + ahead, frequency), strict=True):
        head = np.eye(4)
        head[:3, :3], head[:3, 3] = R, p
        rows.append(",".join(f"{x:.15g}" for x in (t, *pose_of_head(head))))
    path = folder / f"motion_{len(list(folder.iterdir()))}.csv"
    path.write_text("\n".join(rows) + "\n")
    return path


def setpoints(
    motion: Path,
    servo: Any,
    ball: float = 0.0,
    *,
    plain: bool = False,
    duration: float = DURATION,
    more: Sequence[str] = (),
) -> np.ndarray:
    """Return the setpoints (n, 6) for assumed servos and ball joints, and `more` settings."""
    kp, kv, damping, friction, armature, force = servo
    fields = {
        "stiffness": kp,
        "velocity_gain": kv,
        "crank_damping": damping,
        "friction": friction,
        "armature": armature,
        "torque_limit": force,
    }
    settings = [f"actuator.{name}={value:.9g}" for name, value in fields.items()]
    if ball > 0:
        settings += [f"plant.{name}={ball * value:.9g}" for name, value in BALL.items()]
    settings += [f"reference={{kind: csv, file: {motion}}}", f"duration={duration}"]
    settings += ["start=on_reference", "actuator.angle_range=null", *more]
    return sd.setpoints("reachy_mini", 1 / PERIOD, plain=plain, settings=settings).angles


def play(servo: Any, ball: float, rows: np.ndarray, first: np.ndarray, **more: Any) -> Any:
    """Return what the head did in the robot's model, as of `reachy_player.py`.

    `more` are optional parts of its job.
    """
    with tempfile.TemporaryDirectory() as folder:
        job, result = Path(folder) / "job.npz", Path(folder) / "result.npz"
        setpoints = np.vstack([first, rows])
        np.savez(job, servo=np.array(servo), ball=ball, setpoints=setpoints, **more)
        command = [os.environ["REACHY_PYTHON"], str(PLAYER), str(job), str(result)]
        own = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
        subprocess.run(command, check=True, env=own)
        with np.load(result) as found:
            return dict(found)


def errors(servo: Any, ball: float, rows: np.ndarray, first: np.ndarray, frequency: float) -> float:
    """Return the rms error of the head's angle in degrees, played in the robot's model."""
    return angle_error(play(servo, ball, rows, first)["rotations"], frequency)


def angle_error(found: np.ndarray, frequency: Any) -> float:
    """Return the rms error in degrees of the head's rotations (n, 3, 3) at the ends of periods."""
    times = PERIOD * (1 + np.arange(len(found)))
    wanted, _ = head_at(times, frequency)
    cosine = (np.einsum("nij,nij->n", wanted, found) - 1) / 2
    angle = np.degrees(np.arccos(np.clip(cosine, -1, 1)))[times > SETTLED + PERIOD / 2]
    return float(np.sqrt(np.mean(angle**2)))


def wanted_cranks(times: np.ndarray, frequency: float) -> np.ndarray:
    """Return the crank angles (n, 6) of the motion, rad."""
    mechanism, heads = load_mechanism("reachy_mini"), np.tile(np.eye(4), (len(times), 1, 1))
    heads[:, :3, :3], heads[:, :3, 3] = head_at(times, frequency)
    return np.array([mechanism.crank_angles(pose_of_head(head)) for head in heads])


def with_feedback(
    servo: Any, rows: np.ndarray, first: np.ndarray, frequency: float, late: float
) -> str:
    """Return the error in degrees as text, with integral feedback on crank angles, late by s."""
    wanted = wanted_cranks(PERIOD * (1 + np.arange(len(rows))), frequency)
    job = {"wanted": wanted, "gain": 0.5 / late, "late": round(late / PERIOD)}
    return f"{angle_error(play(servo, 0.0, rows, first, **job)['rotations'], frequency):.2f}"


def learnt(
    servo: Any, assumed: Any, ball: float, rows: np.ndarray, first: np.ndarray, frequency: float
) -> list[float]:
    """Return the error in degrees of each repetition, where setpoints are learned.

    What is known are the angles of the cranks at the ends of the periods, of the last period of the
    motion, and the numbers of the assumed servos.
    """
    motion, found, steps = 1 / frequency, list[float](), Anderson()
    ends, middles = PERIOD * (1 + np.arange(len(rows))), PERIOD * (0.5 + np.arange(len(rows)))
    wanted = wanted_cranks(ends, frequency)
    last = slice(len(ends) - round(motion / PERIOD), None)
    lag = (assumed[1] + assumed[2]) / assumed[0]
    for _ in range(REPETITIONS):
        learned = LearnedSignal(motion, steps.used)
        angles = rows + rise(middles)[:, None] * learned(middles)
        played = play(servo, ball, angles, first)
        found.append(angle_error(played["rotations"], frequency))
        number = harmonics_below(motion, PERIOD)
        missed = fit(ends[last], (wanted - played["cranks"])[last], motion, number)
        steps.after(corrected_setpoints(steps.used, missed, motion, lag))
    return found


def arrivals(number: int, seed: int) -> np.ndarray:
    """Return arrival times over Wi-Fi: 20 ms and lognormal 30 ms, 5 % lost."""
    rng = np.random.default_rng(seed)
    sent = PERIOD * np.arange(number)
    found = sent + 0.02 + 0.03 * np.exp(rng.standard_normal(number))
    found[rng.random(number) < 0.05] = np.inf
    return found


def send_now(rows: np.ndarray, first: np.ndarray, arrived: np.ndarray) -> np.ndarray:
    """Return the servos' setpoints (n, 6) if the newest one that has arrived acts at once."""
    setpoints = []
    for k in range(len(rows)):
        there = np.flatnonzero(arrived[: k + 1] <= PERIOD * k)
        setpoints.append(rows[there.max()] if len(there) else first)
    return np.array(setpoints)


def played(rows: np.ndarray, arrived: np.ndarray) -> tuple[np.ndarray, int]:
    """Return the setpoints (n, 6) from plans in a play-out buffer, and the number of dry periods.

    A plan sent at s has the setpoints of PLAN periods from s + PREVIEW on. The first ones were sent
    before the motion. A dry buffer holds the last setpoint.
    """
    sent, setpoints, dry = PERIOD * np.arange(len(rows)), list[np.ndarray](), 0
    for k, row in enumerate(rows):
        t = PERIOD * k
        begins = sent + PREVIEW
        covers = (begins <= t + 1e-9) & (t <= begins + (PLAN - 1) * PERIOD + 1e-9)
        there = t < PREVIEW or bool(np.any(covers & (arrived <= t)))
        dry += not there
        setpoints.append(row if there or not setpoints else setpoints[-1])
    return np.array(setpoints), dry


def judge(servo: Any, first: np.ndarray, frequency: float, rows: np.ndarray, ball: float) -> str:
    """Return the error in degrees as text."""
    return f"{errors(servo, ball, rows, first, frequency):.2f}"


def best(*given: Any) -> str:
    """Return the least error of the repetitions of `learnt`, and its number, as text."""
    found = learnt(*given)
    print(*(f"{error:.2f}" for error in found))
    return f"{min(found):.2f} ({1 + int(np.argmin(found))})"


def results(folder: Path) -> str:
    """Return the table of results as Markdown."""
    motions = {f: motion_file(f, folder) for f in FREQUENCIES}
    header = [f"{name} {f:g} Hz" for name in SERVOS for f in FREQUENCIES]
    cells: dict[str, list[str]] = {}
    for servo in SERVOS.values():
        for f, motion in motions.items():
            plain = setpoints(motion, servo, plain=True)
            first = plain[0]

            judged = partial(judge, servo, first, f)

            def row(name: str, value: str) -> None:
                cells.setdefault(name, []).append(value)
                print(name, value, flush=True)

            row("free ball joints, plain setpoints", judged(plain, 0.0))
            true = setpoints(motion, servo)
            row("free, true numbers", judged(true, 0.0))
            guess = (*(WRONG * servo[:5]), servo[5])
            wrong = setpoints(motion, guess)
            row("free, all numbers 10 % wrong", judged(wrong, 0.0))
            for late in (0.04, 0.26):
                name = f"10 % wrong, feedback on angles {1e3 * late:.0f} ms late"
                row(name, with_feedback(servo, wrong, first, f, late))
            row("10 % wrong, after learning", best(servo, guess, 0.0, wrong, first, f))
            row("as shipped, plain setpoints", judged(plain, 1.0))
            row(
                "as shipped, plain setpoints, after learning",
                best(servo, servo, 1.0, plain, first, f),
            )
            row("as shipped, ball friction not modelled", judged(true, 1.0))
            try:
                modelled = judged(setpoints(motion, servo, 1.0), 1.0)
            except sd.ConfigError as error:
                print(error)
                beyond = (*servo[:5], 1e3)
                modelled = f"refused: torque (else {judged(setpoints(motion, beyond, 1.0), 1.0)})"
            row("as shipped, ball friction modelled", modelled)
            arrived = [arrivals(len(plain), seed) for seed in range(5)]
            now = [errors(servo, 0.0, send_now(plain, first, one), first, f) for one in arrived]
            row("free, over Wi-Fi, newest setpoint at once, mean of 5", f"{np.mean(now):.2f}")
            plans = [played(true, one) for one in arrived]
            buffered = [errors(servo, 0.0, rows, first, f) for rows, _ in plans]
            dry = sum(number for _, number in plans)
            row(
                "free, over Wi-Fi, plans 0.25 s ahead, mean (worst) of 5",
                f"{np.mean(buffered):.2f} ({max(buffered):.2f})",
            )
            print("dry periods", dry, flush=True)
    return table(["rms, deg", *header], [[name, *row] for name, row in cells.items()])


if __name__ == "__main__":
    if not os.environ.get("REACHY_PYTHON"):
        sys.exit("skipped: REACHY_PYTHON is not set, see the head of this file")
    with tempfile.TemporaryDirectory() as folder:
        title = "Error of Reachy Mini's head in its own simulator"
        write(__file__, title, [results(Path(folder))], ", mujoco 3.3.0, reachy-mini 1.13.0")
