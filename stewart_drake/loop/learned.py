"""The file of a learned torque or setpoints, and the check that it belongs to a scenario."""

import io
from pathlib import Path
from typing import Final

import numpy as np

from stewart_drake.dynamics.stewart import plant_parameters
from stewart_drake.files.arrayio import load_npz
from stewart_drake.files.errors import ConfigError
from stewart_drake.files.fileio import write_whole
from stewart_drake.law.learned import LearnedSignal
from stewart_drake.loop.preparation import Experiment
from stewart_drake.mechanism.geometry import fingerprint
from stewart_drake.scenario.calibration import believed_delay
from stewart_drake.scenario.config import Scenario
from stewart_drake.scenario.signals import PLANT_PARAMETERS
from stewart_drake.types import Array

HARMONICS: Final = 8
"""Harmonics of the motion that are learned; those above half the control rate are zero."""
_POSES: Final = 32
"""Number of poses, over one period, by which a file identifies the motion."""
_SAME: Final = 1e-9
"""Largest difference of two motions that are the same, rad and m, and of two times, s."""


def motion_period(scenario: Scenario) -> float:
    """Return the period of a scenario's motion, s."""
    reference, dt = scenario.reference, scenario.controller.period
    if reference.kind != "sine":
        raise ConfigError(
            f"reference.kind: got {reference.kind}; expected sine: only a motion that repeats is "
            "learned"
        )
    both = zip(reference.angular_frequency, reference.amplitude, strict=True)
    found = {frequency for frequency, amplitude in both if amplitude != 0}
    if len(found) != 1:
        got = "several frequencies" if found else "a motion without amplitude"
        raise ConfigError(
            f"reference.frequency: got {got}; expected one, for a motion that repeats"
        )
    period = 2 * np.pi / found.pop()
    if period < 4 * dt:
        raise ConfigError(
            f"reference.frequency: got a period of {period:.3g} s; expected at least four of "
            f"controller.period, {4 * dt:g} s"
        )
    return float(period)


def harmonics_below(period: float, dt: float) -> int:
    """Return the number of harmonics that samples every dt s of one period determine twice over."""
    return determined_by(int(period / dt))


def determined_by(samples: int) -> int:
    """Return the largest H whose 1 + 2 H coefficients a number of samples determines twice over."""
    return min(HARMONICS, (samples - 2) // 4)


def save_learned(path: Path, learned: LearnedSignal, experiment: Experiment) -> None:
    """Write what was learned, with machine, motion, period and delay, to a .npz file."""
    buffer = io.BytesIO()
    np.savez(buffer, coefficients=learned.coefficients, **_marks(experiment))
    write_whole(path, buffer.getvalue())


def learned_signal(experiment: Experiment) -> LearnedSignal | None:
    """Return the torque or angles of `controller.learned`, or None without a file.

    Raises:
        ConfigError: unreadable, or of another machine, motion, period, delay or command.
    """
    file = experiment.scenario.controller.learned
    if file is None:
        return None
    try:
        own = _marks(experiment)
        shapes = {name: (np.asarray(one).dtype.kind, np.shape(one)) for name, one in own.items()}
        shapes["coefficients"] = ("f", (1 + 2 * HARMONICS, 6))
        found = load_npz(Path(file), shapes, "a file that the command learn wrote")
    except ConfigError as error:
        raise ConfigError(f"controller.learned: {error}") from None
    for name, value in own.items():
        text = value.dtype.kind == "U"
        same = found[name] == value if text else np.allclose(found[name], value, 0, _SAME)
        if not same:
            form, numbers = "" if text else ".9g", ""
            if not np.ndim(value):
                numbers = f" ({found[name][()]:{form}}); expected {value[()]:{form}}"
            raise ConfigError(
                f"controller.learned: got {file}, learned with another {_TEXTS[name]}{numbers}"
                + (", as in the scenario" if numbers else "; expected that of the scenario")
            )
    coefficients = found["coefficients"]
    if not np.all(np.isfinite(coefficients)):
        raise ConfigError(f"controller.learned: got {file} with NaN; expected finite numbers")
    return LearnedSignal(motion_period(experiment.scenario), coefficients)


_TEXTS: Final = {
    "machine": "machine",
    "command": "controller.command or feedforward, or another model",
    "motion": "motion",
    "motion_period": "period of the motion, s",
    "period": "controller.period, s",
    "delay": "delay, s",
}


def _command(experiment: Experiment) -> str:
    # Setpoints are learned on top of the feedforward; the torque that a model lacks is not.
    c, servo = experiment.scenario.controller, experiment.scenario.actuator
    if c.command == "torque":
        return c.command
    words = [f"{c.command} with feedforward {c.feedforward}"]
    if c.feedforward != "none" and servo.kind == "position_servo":
        known = {"stiffness": servo.stiffness, "velocity_gain": servo.velocity_gain}
        own, usual = experiment.nominal.plant_parameters, plant_parameters()
        known |= {PLANT_PARAMETERS[k]: own[k] for k in np.flatnonzero(own != usual)}
        words += [f"{name} {value:.9g}" for name, value in known.items()]
    return ", ".join(words)


def _marks(experiment: Experiment) -> dict[str, Array]:
    """Return the arrays that identify machine, command, motion, periods and delay in a file."""
    sc = experiment.scenario
    period = motion_period(sc)
    times = period / _POSES * np.arange(_POSES)
    return {
        "machine": np.array(fingerprint(experiment.mechanism)),
        "command": np.array(_command(experiment)),
        "motion_period": np.array(period),
        "motion": np.array(experiment.reference.vector_values(times).T),
        "period": np.array(sc.controller.period),
        "delay": np.array(believed_delay(sc).eta(sc.controller.period)),
    }
