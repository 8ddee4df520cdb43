"""Learning the setpoints of a machine's servos from repetitions of its motion, in real time.

Each repetition is a session of its own: a soft start, the motion, and rest. The angles that the
cranks lack in the last periods correct the setpoints of the next one, as in `studies.learn`.
"""

import math
from collections.abc import Callable
from pathlib import Path
from typing import Final, NamedTuple

import numpy as np

from stewart_drake.files.errors import ConfigError
from stewart_drake.law.learned import LearnedSignal
from stewart_drake.live.contact import address_of
from stewart_drake.live.endpoint import read_key
from stewart_drake.live.loop import End
from stewart_drake.live.options import LiveOptions
from stewart_drake.live.session import drive, plans, prepare_session
from stewart_drake.loop.learned import harmonics_below, motion_period, save_learned
from stewart_drake.loop.results import SimulationResult
from stewart_drake.scenario.config import Scenario
from stewart_drake.studies.learn import PATIENCE, Anderson, corrected_setpoints, fit, lacking_angles

_SETTLING: Final = 9.0
"""Time before what is learned from, s: the longest soft start, and a second."""
_LEARNED_FROM: Final = 4.0
"""Least time that is learned from, s; whole periods."""


class Repetition(NamedTuple):
    """One repetition in real time.

    Attributes:
        error: rms of the angles that the cranks lacked in the last periods, rad.
        result: the run.
    """

    error: float
    result: SimulationResult


def check_learning(scenario: Scenario) -> None:
    """Refuse a scenario whose setpoints cannot be learned in real time.

    Raises:
        ConfigError: torques, a file of learned setpoints, or a motion that does not repeat.
    """
    c = scenario.controller
    if c.command != "cranks":
        raise ConfigError(
            f"--learn: got a controller.command of {c.command!r}; expected 'cranks': torques are "
            "learned in a simulation, by the command learn"
        )
    if c.learned is not None:
        raise ConfigError("controller.learned: got a file; expected null, where learning begins")
    motion_period(scenario)


def learn_setpoints(
    scenario: Scenario, machine: str, options: LiveOptions, say: Callable[[str], None]
) -> SimulationResult:
    """Repeat a motion on a machine, learn from each repetition, and write what was learned.

    Learning ends early after two repetitions without a smaller error, or with a run that does not
    complete.

    Args:
        scenario: that passes `check_learning`.
        machine: HOST:PORT where it listens.
        options: `learn`, `learned`, `armed`, `key`, `max_missing`, `accept_jitter`.
        say: prints a line.

    Returns:
        The best repetition, or the last run if none completed.

    Raises:
        ConfigError: see `check_learning` and `live.session`.
    """
    check_learning(scenario)
    file, learned, best = options.learned or Path("learned.npz"), None, 0
    if not file.parent.is_dir():
        raise ConfigError(f"--learned: got {file}; expected a file in a folder that is there")
    period, dt = motion_period(scenario), scenario.controller.period
    number, servo = harmonics_below(period, dt), scenario.actuator
    assert servo.kind == "position_servo"
    lag = (servo.velocity_gain + servo.crank_damping) / servo.stiffness
    last = period * math.ceil(_LEARNED_FROM / period)
    duration, least = dt * math.ceil((_SETTLING + last) / dt + 1), 2 * (1 + 2 * number)
    address, key = address_of(machine), read_key(options.key)
    how = options.model_dump(include={"armed", "accept_jitter", "max_missing"})
    done, steps = list[Repetition](), Anderson()
    for k in range(1, options.learn + 1):
        ready = prepare_session(scenario, address, key, learned)
        if k == 1:
            for line in plans(ready, duration, scenario.mechanism):
                say(line)
        experiment, result = ready.design.experiment, drive(ready, duration, say=say, **how)
        if result.status != "completed":
            say(f"repetition {k}: {End(result.status, result.stopped).words}; learning ends")
            break
        times, missed = lacking_angles(experiment, result, last)
        if len(times) < least:
            say(
                f"repetition {k}: {len(times)} measurements in the last {last:.3g} s; expected at "
                f"least {least}; learning ends"
            )
            break
        done.append(Repetition(float(np.sqrt(np.mean(missed**2))), result))
        say(f"repetition {k}: the cranks lack {np.degrees(done[-1].error):.3f} degrees rms")
        best = int(np.argmin([one.error for one in done]))
        if best == k - 1 and learned is not None:  # at once, so that Ctrl-C loses nothing
            save_learned(file, learned, experiment)
        if k - 1 - best >= PATIENCE:
            break
        fitted = corrected_setpoints(steps.used, fit(times, missed, period, number), period, lag)
        learned = LearnedSignal(period, steps.after(fitted))
    if not done:
        return result
    if best:
        say(f"repetition {1 + best} is the best; {file} is for controller.learned")
    else:
        say("nothing was learned: no repetition was better than the first one")
    return done[best].result
