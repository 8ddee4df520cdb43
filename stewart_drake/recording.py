"""Collecting the signals of a running loop, and summing them up."""

import dataclasses
from typing import Any

import numpy as np
import xarray as xr
from numpy.typing import NDArray
from pydrake.systems.framework import Context

from stewart_drake import metrics
from stewart_drake.design.law_types import Counts
from stewart_drake.diagram import ClosedLoop
from stewart_drake.experiment import Experiment, waits_at_rest
from stewart_drake.plant.workspace import Failure
from stewart_drake.results import versions
from stewart_drake.signals import (
    COORDINATES,
    LEGS,
    PARAMETERS,
    POSE,
    RATES,
    TUNER_INPUTS,
    WEIGHTS,
)

Array = NDArray[np.float64]

_DIMENSIONS = {
    "pose": "coordinate",
    "rates": "coordinate",
    "reference": "coordinate",
    "reference_rates": "coordinate",
    "error": "coordinate",
    "integral": "coordinate",
    "torque_commanded": "leg",
    "torque_applied": "leg",
    "weights": "weight",
    "parameters": "parameter",
    "parameter_std": "parameter",
    "density": "tuner_input",
}
_HELD = (
    "integral",
    "torque_commanded",
    "torque_applied",
    "parameters",
    "parameter_std",
    "density",
)
_LABELS = {
    "coordinate": COORDINATES,
    "leg": LEGS,
    "weight": WEIGHTS,
    "parameter": PARAMETERS,
    "tuner_input": TUNER_INPUTS,
}


class Recorder:
    """Collects signals of the loop: `look` at the plant, then `keep` that and the held signals."""

    def __init__(self, loop: ClosedLoop) -> None:
        self._loop = loop
        self._ports: dict[str, Any] = {}
        self._controller: Any = loop.GetSubsystemByName("controller")
        self._tuner: Any = (
            loop.GetSubsystemByName("tuner") if loop.HasSubsystemNamed("tuner") else None
        )
        self._scale = loop.experiment.scale
        self._now: dict[str, Array] = {}
        self._instant = 0.0
        self._rows: list[dict[str, Array]] = []
        self._time: list[float] = []
        self.samples: list[tuple[Array, Array, float]] = []
        """Pose error, torque and computing time at each of the controller's samples."""
        self.counts = Counts()
        self.tuner_fallbacks = 0
        """Samples at which the tuner passed its network over."""

    def _port(self, context: Context, name: str) -> Array:
        if name not in self._ports:
            self._ports[name] = self._loop.GetOutputPort(name)
        return np.array(self._ports[name].Eval(context))

    def look(self, context: Context, time: float) -> None:
        """Read plant and reference at the nominal time in s."""
        self._instant = time
        state, reference = self._port(context, "state"), self._port(context, "reference")
        self._now = {
            "pose": state[POSE],
            "rates": state[RATES],
            "reference": reference[POSE],
            "reference_rates": reference[RATES],
            "error": state[POSE] - reference[POSE],
        }

    def keep(self, context: Context, logged: bool, sampled: bool) -> None:
        """Add a row to the log, to the list of the controller's samples, or to both."""
        if sampled:
            memory = self._controller.memory(self._controller.GetMyContextFromRoot(context))
            self.counts = memory.counts
            if self._tuner is not None:
                tuner_context = self._tuner.GetMyContextFromRoot(context)
                self.tuner_fallbacks = self._tuner.fallbacks(tuner_context)
            self.samples.append((self._now["error"], memory.torque, memory.seconds))
        if logged:
            held = {name: self._port(context, name) for name in _HELD}
            held["weights"] = self._port(context, "weights_used")
            self._time.append(self._instant)
            self._rows.append(self._now | held)

    def current_error(self) -> float:
        """Mean pose error in % of peak to peak."""
        return float(100 * np.mean(np.abs(self._now["error"]) / self._scale))

    def dataset(self) -> xr.Dataset:
        """The log, see `SimulationResult.signals`."""
        variables = {
            name: (
                ("time", dimension),
                np.array([row[name] for row in self._rows]).reshape(
                    len(self._rows), len(_LABELS[dimension])
                ),
            )
            for name, dimension in _DIMENSIONS.items()
        }
        coordinates: dict[str, Any] = {name: list(labels) for name, labels in _LABELS.items()}
        coordinates["time"] = ("time", np.array(self._time), {"units": "s"})
        return xr.Dataset(variables, coordinates)


def summarize(
    experiment: Experiment,
    recorder: Recorder,
    signals: xr.Dataset,
    status: str,
    stopped: Failure | None,
    wall: float,
) -> dict[str, Any]:
    """What `summary.json` holds; NaN where a run that did not complete has no value."""
    sc, nan = experiment.scenario, float("nan")
    done = status == "completed"
    time, error = signals.time.values, signals.error.values
    errors, torques, seconds = (
        (np.array(column) for column in zip(*recorder.samples, strict=True))
        if recorder.samples
        else (np.empty((0, 6)), np.empty((0, 6)), np.empty(0))
    )
    some = len(torques) > 0
    c = sc.controller
    return {
        "status": status,
        "accumulated_error": metrics.accumulated_error(time, error, experiment.scale)
        if done
        else nan,
        "failure": None if stopped is None else stopped._asdict(),
        "cost": metrics.quadratic_cost(errors, torques, c.period, c.w_Q, c.w_R, c.integral)
        if done
        else nan,
        "peak_torque": np.abs(torques).max() if some else nan,
        "rms_torque": np.sqrt(np.mean(torques**2)) if some else nan,
        "torque_variation": metrics.total_variation(torques) if some else nan,
        "peak_error": metrics.peak_error(error, experiment.scale) if len(error) else [nan] * 6,
        "delay_floor": _floor(experiment, signals),
        "controller_step_ms": {
            "median": 1e3 * np.median(seconds) if some else nan,
            "worst": 1e3 * seconds.max() if some else nan,
        },
        "wall_s": wall,
        "counts": recorder.counts._asdict() | {"tuner_fallbacks": recorder.tuner_fallbacks},
        "scenario": dataclasses.asdict(sc),
        "versions": versions(),
    }


def _floor(experiment: Experiment, signals: xr.Dataset) -> float:
    sc = experiment.scenario
    if not waits_at_rest(sc):
        return 0.0
    eta = (sc.delay.steps + sc.delay.fraction) * sc.controller.period
    return metrics.delay_floor(signals.time.values, signals.reference.values, experiment.scale, eta)
