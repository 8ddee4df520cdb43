"""The record of a running loop, and the summary of a run."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import xarray as xr
from pydrake.systems.framework import Context

from stewart_drake.dynamics.native_functions import functions_of
from stewart_drake.dynamics.workspace import Failure
from stewart_drake.files.schema import plain
from stewart_drake.files.versions import versions
from stewart_drake.law.belief import Belief, Innovations
from stewart_drake.law.counts import Counts
from stewart_drake.loop import results as metrics
from stewart_drake.loop.controller_margin import ControllerMargin
from stewart_drake.loop.diagram import ClosedLoop
from stewart_drake.loop.preparation import Experiment, estimated_names
from stewart_drake.loop.results import DelaySummary, EstimateSummary, RunSummary, waits_at_rest
from stewart_drake.loop.tuner import AnnTuner, LawTuner
from stewart_drake.mechanism.geometry import Mechanism
from stewart_drake.scenario.loading import scenario_to_dict, scenario_yaml
from stewart_drake.scenario.run_log import RunLog, dataset_of
from stewart_drake.scenario.signals import (
    NUM_STATE,
    NUM_TORQUES,
    PACKETS,
    POSE,
    exported_ports,
    recorded_signals,
)
from stewart_drake.scenario.timing import Instant
from stewart_drake.types import Array

_HELD_BY = ("controller", "density")
"""Systems whose signals change at the controller's samples only."""


class Record:
    """Record of a run, in simulation or in real time.

    Args:
        logs: to be written while the run goes on.
        mechanism: whose cranks are logged with position servos.

    Attributes:
        on_grid: rows (13,) of time, pose and reference on the metric's grid and at the end.
        samples: rows (19,) at the controller's samples: pose error, torque of the law, the same
            within the limit, computing time.
        peak_applied: largest torque that acted, N m.
        counts: survived problems up to the last sample.
        sampled: number of the controller's samples.
        measured: number of samples with a usable measurement.
        innovations: of the estimator, up to the last sample.
        tuner_fallbacks: number of fallbacks of the tuner.
        delay: at the last sample, s: true, assumed or estimated, standard deviation.
        packets: last counts (5,) of `scenario.signals.PACKETS`.
        setpoint: crank angles (6,) sent last to servos, rad.
    """

    def __init__(
        self, experiment: Experiment, logs: Sequence[RunLog], mechanism: Mechanism
    ) -> None:
        self._logs, self._scenario = logs, experiment.scenario
        self._functions = functions_of(mechanism)
        self.setpoint: Array = np.full(NUM_TORQUES, np.nan)
        self._recorded = recorded_signals(experiment.scenario.sensor.samples)
        self._log, self.on_grid, self.samples = list[Array](), list[Array](), list[Array]()
        self.peak_applied = 0.0
        self.counts, self.tuner_fallbacks = Counts(), 0
        self.sampled = self.measured = 0
        self.innovations = Innovations()
        self._belief: Belief | None = None
        nan = float("nan")
        self.delay: DelaySummary = {"true_s": nan, "estimated_s": nan, "std_s": nan}
        self.packets: Array = np.full(len(PACKETS), nan)

    def log(self, time: float, seen: Mapping[str, Array]) -> None:
        """Add a row to the log: a time in s, and the value of each exported port."""
        row = [seen[signal.exported][signal.part] for signal in self._recorded]
        self.packets = seen["packets"]
        self._log.append(np.concatenate([[time], *row]))
        self.mirror(time, seen)

    def count(self, memory: Any) -> bool:
        """Take counts and estimates from the controller's memory; return `has_measured`."""
        usable = has_measured(memory, self.counts)
        belief = getattr(memory, "belief", None)  # missing in a controller of the user
        self._belief = belief
        self.innovations = Innovations() if belief is None else belief.innovations
        self.counts, self.sampled = memory.counts, self.sampled + 1
        self.setpoint = getattr(memory, "command", self.setpoint)[:NUM_TORQUES]
        self.measured += usable
        return usable

    @property
    def estimates(self) -> dict[str, EstimateSummary]:
        """The parameters in `controller.estimate` at the last sample, by name."""
        names, belief = estimated_names(self._scenario), self._belief
        if belief is None or not belief.estimate.uncertain or len(belief.parameters) != len(names):
            return {}
        each = zip(belief.parameters.tolist(), belief.estimate.parameter_std.tolist(), strict=True)
        return {
            name: {"value": value, "std": std}
            for name, (value, std) in zip(names, each, strict=True)
        }

    def errors(self, poses: Array, reference: Array) -> Array:
        """Return the errors (n, 6) of which the figures are made."""
        return poses - reference

    def dataset(self) -> xr.Dataset:
        """Return the log, see `SimulationResult.signals`."""
        ends = np.cumsum([1, *(signal.size for signal in self._recorded)])
        time, *columns, _ = np.split(np.reshape(self._log, (-1, ends[-1])), ends, axis=1)
        values = {s.name: np.array(c) for s, c in zip(self._recorded, columns, strict=True)}
        text, samples = scenario_yaml(self._scenario), self._scenario.sensor.samples
        return dataset_of(time[:, 0], values, text, samples)

    def mirror(self, time: float, seen: Mapping[str, Array]) -> None:
        """Write a row to the logs: a time in s, and the value of each exported port."""
        row = {signal.name: seen[signal.exported][signal.part] for signal in self._recorded}
        if self._logs and self._scenario.actuator.kind == "position_servo":
            row["setpoint"] = seen.get("setpoint", self.setpoint)
            row["crank"] = self._functions.crank_angles(row["pose"])
        for log in self._logs:
            log.write(time, row)


class Recorder(Record):
    """Record of a simulated loop: `look` reads the plant, `keep` adds it and the held signals."""

    def __init__(self, loop: ClosedLoop, logs: Sequence[RunLog] = ()) -> None:
        controller: Any = loop.GetSubsystemByName("controller")
        super().__init__(loop.experiment, logs, loop.experiment.truth)
        self._loop, self._controller = loop, controller
        self._ports: dict[str, Any] = {}
        tuner = loop.GetSubsystemByName("tuner") if loop.HasSubsystemNamed("tuner") else None
        self._tuner = tuner if isinstance(tuner, AnnTuner | LawTuner) else None
        self._scale = loop.experiment.scale
        self._instant = 0.0
        self._state, self._wanted, self._error = np.empty(0), np.empty(0), np.empty(0)
        self._systems = {port: system for port, (system, _) in exported_ports().items()}
        self._held: dict[str, Array] = {}

    def _port(self, context: Context, name: str) -> Array:
        if name not in self._ports:
            self._ports[name] = self._loop.GetOutputPort(name)
        return np.array(self._ports[name].Eval(context))

    def look(self, context: Context, time: float) -> None:
        """Read plant and reference at the nominal time in s."""
        self._instant = time
        self._state = self._port(context, "state")
        self._wanted = self._port(context, "reference")[:NUM_STATE]
        self._error = self._state[POSE] - self._wanted[POSE]

    def keep(self, context: Context, instant: Instant) -> None:
        """Add the values of `look` to the log, the metric's grid or the controller's samples."""
        applied = self._port(context, "torque_applied")
        self.peak_applied = max(self.peak_applied, float(np.abs(applied).max()))
        if instant.sampled:
            controller_context = self._controller.GetMyContextFromRoot(context)
            sample = self._controller.sample(controller_context)
            memory, seconds = sample.memory, sample.seconds
            usable = self.count(memory)
            if self._tuner is not None:
                tuner_context = self._tuner.GetMyContextFromRoot(context)
                self.tuner_fallbacks = self._tuner.fallbacks(tuner_context)
            self.delay = {
                "true_s": float(self._port(context, "delay_true")[0]),
                "estimated_s": float(self._port(context, "delay_estimate")[0]),
                "std_s": float(self._port(context, "delay_std")[0]),
            }
            torques = np.array([memory.torque, memory.in_flight[-1]])
            if self._loop.HasSubsystemNamed("servos") and not usable:
                torques *= np.nan  # they come with the measurement
            self.samples.append(np.concatenate([self._error, *torques, [seconds]]))
            held = (port for port, system in self._systems.items() if system in _HELD_BY)
            self._held = {port: self._port(context, port) for port in held}
        if instant.on_grid:
            poses = self._state[POSE], self._wanted[POSE]
            self.on_grid.append(np.concatenate([[self._instant], *poses]))
        if instant.logged:
            # Plant and reference as of `look`: the plant may have moved since.
            seen = self._held | {"state": self._state, "reference": self._wanted}
            seen |= {n: self._port(context, n) for n in self._systems if n not in seen}
            self.log(self._instant, seen)

    def current_error(self) -> float:
        """Return the mean pose error in % of peak to peak."""
        return float(100 * np.mean(np.abs(self._error) / self._scale))


def has_measured(memory: Any, before: Counts) -> bool:
    """Return whether the last measurement was usable by the controller, at least in part.

    Args:
        memory: of the controller after that sample.
        before: its counts at the sample before.
    """
    belief = getattr(memory, "belief", None)  # missing in a controller of the user
    partial = 0 if belief is None else belief.partial
    more: int = memory.counts.bad_measurements - before.bad_measurements
    return more <= partial


def summarize(
    experiment: Experiment,
    recorder: Record,
    status: str,
    stopped: Failure | None,
    wall: float,
    margin: ControllerMargin | None,
) -> RunSummary:
    """Return the summary of a run, without its warnings."""
    sc, nan = experiment.scenario, float("nan")
    on_grid = np.vstack([np.empty((0, 13)), *recorder.on_grid])
    samples = np.vstack([np.empty((0, 19)), *recorder.samples])
    time, (poses, reference) = on_grid[:, 0], np.split(on_grid[:, 1:], 2, axis=1)
    error = recorder.errors(poses, reference)
    errors, torques, sent, rest = np.split(samples, [6, 12, 18], axis=1)
    seconds, some, scale = rest[:, 0], len(samples) > 0, experiment.scale
    completed = status == "completed"
    found = metrics.figures(
        time=time,
        error=error,
        scale=scale,
        errors=errors,
        asked=torques,
        sent=sent,
        controller=sc.controller,
        completed=completed,
    )
    peaks = metrics.peak_error(error, scale).tolist() if len(error) else [nan] * 6
    floor = 0.0
    if waits_at_rest(sc) and len(time):
        floor = metrics.delay_floor(experiment.reference, scale, min(sc.eta, time[-1]))
    return {
        "status": status,
        "accumulated_error": found.accumulated_error,
        "measured_share": recorder.measured / recorder.sampled if recorder.sampled else nan,
        "failure": None if stopped is None else stopped._asdict(),
        "cost": found.cost,
        "peak_torque": found.peak_torque,
        "peak_torque_applied": recorder.peak_applied if some else nan,
        "rms_torque": found.rms_torque,
        "torque_variation": found.torque_variation,
        "peak_error": peaks,
        "rms_error": metrics.rms_error(poses, reference)
        if completed
        else {"angle_deg": nan, "position_mm": nan},
        "delay_floor": floor,
        "controller_step_ms": {
            "median": float(1e3 * np.median(seconds)) if some else nan,
            "worst": float(1e3 * seconds.max()) if some else nan,
        },
        "delay": recorder.delay,
        "estimator_consistency": {
            "nis_ratio": recorder.innovations.ratio,
            "verdict": recorder.innovations.verdict,
        },
        "estimates": recorder.estimates,
        "wall_s": wall,
        "counts": recorder.counts.summary(recorder.tuner_fallbacks),
        "link": plain(sc.assumed_link),
        "packets": {
            name: int(number)
            for name, number in zip(PACKETS, recorder.packets, strict=True)
            if np.isfinite(number)
        },
        "own": experiment.own.names,
        "scenario": scenario_to_dict(sc),
        "versions": versions(),
        "controller_margin": None if margin is None else margin.summary,
        "warnings": [],
    }
