"""The constants of a law for its step in C (core/law.c), and the calls of that step.

A part is a table of functions: those of the core, or callbacks for a part in Python
(`law.own_parts`). The memory is one flat vector, whose fields `stewart_layout` names.
"""

import math
from functools import cached_property
from typing import Any, Final

import numpy as np

from stewart_drake.core.build import sources_of
from stewart_drake.core.library import core
from stewart_drake.dynamics.workspace import home_sign
from stewart_drake.law.channel import Packets, Wire, packets_of, report_of
from stewart_drake.law.compiled import (
    DYNAMICS,
    address_of,
    machine_of,
    numbers,
    raise_first,
)
from stewart_drake.law.cost import QuadraticCost
from stewart_drake.law.feedforward import (
    EquilibriumFeedforward,
    InverseDynamicsFeedforward,
    NoFeedforward,
)
from stewart_drake.law.memory import Memory
from stewart_drake.law.motion import KnownMotion, Motion
from stewart_drake.law.nominal import MultibodyModel
from stewart_drake.law.observers import CoreObserver, set_observer
from stewart_drake.law.own_parts import OwnParts, Step, preview_rows
from stewart_drake.law.planner import NoPlanner, Replan
from stewart_drake.law.predictors import ArrivalPredictor, NonlinearPredictor
from stewart_drake.law.sensing import Measurement
from stewart_drake.scenario.signals import NUM_REFERENCE, NUM_STATE, NUM_TORQUES, WEIGHTS
from stewart_drake.types import Array

_FEEDFORWARDS: Final = {
    NoFeedforward: "STEWART_NO_FEEDFORWARD",
    EquilibriumFeedforward: "STEWART_EQUILIBRIUM",
    InverseDynamicsFeedforward: "STEWART_INVERSE_DYNAMICS",
}
_DESIGN: Final = ("plant", "feedforward", "predictor", "model", "cost")
"""Parts that prediction and gain depend on."""
_KINDS: Final[dict[str, tuple[type, ...]]] = {
    "plant": DYNAMICS,
    "observer": (CoreObserver,),
    "feedforward": tuple(_FEEDFORWARDS),
    "planner": (NoPlanner, Replan),
    "predictor": (NonlinearPredictor, ArrivalPredictor),
    "model": (MultibodyModel,),
    "cost": (QuadraticCost,),
    "channel": (Wire, Packets),
}
"""Classes of each part that the core has."""


def in_python(law: Any) -> set[str]:
    """Return the names of the parts that Python computes, a user's subclasses among them."""
    parts = {name: getattr(law, name) for name in _KINDS if hasattr(law, name)}
    parts["plant"] = law.plant.dynamics
    names = {name for name, part in parts.items() if type(part) not in _KINDS[name]}
    if "predictor" in parts and law.finds_delay != isinstance(law.predictor, ArrivalPredictor):
        names.add("predictor")
    return names


class CompiledLaw:
    """The constants of a law in the core.

    Args:
        law: a `PredictiveLqi` or a `ServoPreview`.
        more: number of torques to keep in flight beyond those of the law.

    Attributes:
        data: `stewart_law *`, or of servos `stewart_servo *`.
        torques_law: `stewart_law *`, of servos the one in `data`.
        fields: (place, rows, columns) of each field of the memory.
        keep_alive: arrays and C structures that `data` points to.
    """

    def __init__(self, law: Any, more: int = 0) -> None:
        c = core()
        self.law, self._servos = law, not hasattr(law, "cost")
        self.keep_alive: list[Any] = []
        self.data = c.ffi.new("stewart_servo *" if self._servos else "stewart_law *")
        self.torques_law = c.ffi.addressof(self.data, "law") if self._servos else self.data
        self._own_parts, self._in_python = OwnParts(law, self.torques_law), in_python(law)
        self._raised = [self._own_parts.raised]
        self._set_common_parts(self.torques_law)
        if self._servos:
            self._set_servos()
            c.lib.stewart_servo_prepare(self.data)
        else:
            self._set_torque_law(more)
            c.lib.stewart_prepare(self.data)
        self.keep_alive += self._own_parts.keep_alive
        layout = self.torques_law.layout
        fields = {name: getattr(layout, name) for name, _ in c.ffi.typeof(layout).fields}
        self.fields = {
            name: (one.at, one.rows, one.columns) for name, one in fields.items() if one.rows
        }

    def _set_common_parts(self, data: Any) -> None:
        c, law, timeline = core(), self.law, self.law.timeline
        machine = machine_of(law.plant)
        data.machine = machine.pointer[0]
        self._raised += machine.raised
        self.keep_alive += machine.pointed()
        data.period, data.steps, data.fraction = timeline.period, timeline.steps, timeline.fraction
        data.num_values, data.rows = law.sensing.size, len(law.preview_times)
        if "feedforward" not in self._in_python:
            data.cost.feedforward = getattr(c.lib, _FEEDFORWARDS[type(law.feedforward)])
        if "observer" in self._in_python:
            self._own_parts.observer()
            return
        sensor = set_observer(data, law.observer, law.sensing, law.plant, timeline.period)
        self._raised += sensor.raised
        self.keep_alive += sensor.pointed()

    def _set_servos(self) -> None:
        law, d = self.law, self.data
        d.law.parts, d.periods = law.reports.parts, law.reports.periods
        computes = bool(self._in_python & set(_DESIGN))
        if computes or law.learned is not None:
            self._own_parts.command(d, computes=computes)
        if (servo := law.servo) is not None:
            limits = servo.low.tolist(), servo.high.tolist(), servo.most
            d.stiff = (servo.stiffness, servo.velocity_gain, *limits)

    def _set_torque_law(self, more: int) -> None:
        c, d, law, python = core(), self.data, self.law, self._in_python
        d.cost.integrates = law.cost.integrates
        if "cost" not in python:
            cost = law.cost
            d.cost.errors, d.cost.torques = cost.errors.tolist(), cost.torques.tolist()
            d.cost.integrals = (np.zeros(6) if cost.integrals is None else cost.integrals).tolist()
        d.extra_torques, d.longest_wait = law.extra_torques + more, law.longest_wait
        d.open_loop_samples = law.open_loop_samples
        d.tolerated_timing = 0.0 if math.isinf(law.tolerated_timing) else law.tolerated_timing
        if law.finds_delay:  # no delay is assumed
            d.extra_torques += law.observer.extra_torques(d.period)
            d.steps, d.fraction = 0, 0.0
            # now, the times of the prediction, and the two nodes of three holds
            d.rows = 1 + law.observer.max_schedule_length(d.period) + 2 * 3
        if python & {"observer", *_DESIGN}:
            self._set_design()
        if "channel" in python:
            self._own_parts.channel()
        elif isinstance(law.channel, Packets):
            d.channel = c.ffi.addressof(c.lib, "stewart_network")
            packets = packets_of(law.channel)
            d.packets = packets.pointer
            self.keep_alive += packets.pointed()
        if "planner" in python:
            self._own_parts.planner()
        elif isinstance(law.planner, Replan):
            self._set_planner(law.planner)

    def _set_design(self) -> None:
        """Set prediction and gain with parts in Python, for any delay that these may find."""
        d, law, python = self.data, self.law, self._in_python
        pending = law.predictor.pending(law.timeline)
        if "observer" in python:  # up to this many times and pending torques
            times = d.rows if law.finds_delay else 1 + d.extra_torques + law.timeline.queue_length
            pending, nodes = times, 2 * (times + 3)
            d.rows = times + (1 + nodes) * law.channel.torques
        self._own_parts.design(
            NUM_STATE + 6 * d.cost.integrates + NUM_TORQUES * pending,
            predicts=hasattr(law.predictor, "predict"),
            designs=bool(python & set(_DESIGN)),
        )

    def _set_planner(self, planner: Replan) -> None:
        c, d, law = core(), self.data, self.law
        plan = c.ffi.new("stewart_replan *")
        unknown_delay = law.finds_delay or "observer" in self._in_python
        plan.periods, plan.most = planner.lengths(d.period)
        plan.until = d.rows if unknown_delay else law.timeline.queue_length
        plan.size, plan.sign = planner.size.tolist(), home_sign(law.plant.mechanism)
        plan.sure = planner.sure
        d.planner, d.planning = c.ffi.addressof(c.lib, "stewart_replanner"), plan
        self.keep_alive.append(plan)

    @property
    def sources(self) -> list[str]:
        """Files of the core that the law needs."""
        law, step = self.torques_law, "stewart_servo_step" if self._servos else "stewart_step"
        parts = law.observer, law.make_sensing, law.channel, law.planner, law.machine.joints
        names = [core().symbols.get(address_of(part)) for part in parts]
        return sources_of([step, *filter(None, names)])

    @cached_property
    def scratch(self) -> int:
        """Numbers of scratch memory that a step takes at the most."""
        lib = core().lib
        count = lib.stewart_servo_scratch if self._servos else lib.stewart_step_scratch
        return int(count(self.data))

    def start(self, first: Array) -> Memory:
        """Return the memory before the first sample.

        Args:
            first: (n, 6) torques in flight, or for servos (18,) the command that was sent last.
        """
        c, memory = core(), Memory(np.empty(self.torques_law.memory), self, {})
        first, self._own_parts.now = numbers(first), Step(memory)
        if self._servos:
            c.lib.stewart_servo_start(self.data, c.at(memory.data), c.at(first))
        else:
            c.lib.stewart_start(self.data, c.at(memory.data), len(first), c.at(first))
        raise_first(self._raised)
        return memory

    def step(
        self,
        memory: Memory,
        measurement: Measurement,
        motion: Motion,
        report: Any,
        weights: Array | None = None,
    ) -> Memory:
        """Return the memory after a sample; see `PredictiveLqi.step` and `ServoPreview.step`."""
        if memory.compiled is not self and memory.compiled.fields != self.fields:
            raise ValueError("memory: got that of another law; expected one of this law")
        c, law = core(), self.law
        after = Memory(memory.data.copy(), self, dict(memory.own))
        values, scratch = measurement.known(law.sensing.size), np.empty(self.scratch)
        after.own["sample"] = after.own.get("sample", -1) + 1  # its number, from 0
        self._own_parts.now = Step(after, motion, report)
        sample, _kept = self._sample(motion)
        sample.measurement = c.at(values)
        sample.age = round(measurement.age / law.timeline.period)
        arguments = self.data, c.at(after.data), c.at(scratch), sample
        if weights is None:
            reported, command = numbers(report), np.empty(NUM_REFERENCE)
            c.lib.stewart_servo_step(*arguments, c.at(reported), c.at(command))
        else:
            if np.shape(weights) != (len(WEIGHTS),):
                raise ValueError(f"weights: got shape {np.shape(weights)}; expected (2,)")
            compiled, torque = report_of(report), np.empty(NUM_TORQUES)
            sample.report, sample.weights = compiled.pointer, list(weights)
            c.lib.stewart_step(*arguments, c.at(torque))
        raise_first(self._raised)
        return after

    def followed(self, memory: Memory, motion: Motion, times: Array) -> Array:
        """Return the rows (n, 18) that the law follows at instants (n,) in s from the last step."""
        c, planner = core(), self.data.planner
        if planner == c.ffi.NULL:
            return motion(times)
        rows, (sample, _kept) = np.empty((len(times), NUM_REFERENCE)), self._sample(motion)
        path = c.at(memory.field("planner"))
        planner.rows(self.data, path, sample, len(times), c.at(times), c.at(rows))
        raise_first(self._raised)
        return rows

    def _sample(self, motion: Motion) -> tuple[Any, Any]:
        """Return a `stewart_sample *` that reads a motion, and an object that must outlive it."""
        c, law = core(), self.law
        sample = c.ffi.new("stewart_sample *")
        known = motion.compiled() if isinstance(motion, KnownMotion) else None
        if known is not None:
            sample.reference, sample.goal = c.lib.stewart_planned_rows, c.lib.stewart_goal_rows
            sample.context = known
            return sample, known
        times_are_fixed = self._servos or not (law.moves or "observer" in self._in_python)
        if times_are_fixed:
            rows = preview_rows(motion(law.preview_times), len(law.preview_times))
            sample.reference, sample.context = c.lib.stewart_given_rows, c.at(rows)
            return sample, rows
        sample.reference, goal = self._own_parts.motion
        sample.goal = goal if isinstance(motion, KnownMotion) else c.ffi.NULL
        return sample, None
