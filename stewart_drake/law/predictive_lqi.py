"""The predictive LQI control law as a pure function: memory and measurement in, memory out.

At t = k dt the torques in flight are known. They give the state at the time at which the next
torque begins to act, and (42) is applied there:

    T_k = T_ff - K [e; z; ...],   e = predicted pose and rate error, z = predicted integral,

with K from `law.riccati.reduced_gain` and T_ff the feedforward of the hold interval
[t + eta, t + eta + dt), see `law.feedforward`. Linear prediction multiplies [e_k; z_k; queue] by
`prediction_matrix`, which is the paper's K_aug e_dis; nonlinear prediction integrates the exact
dynamics through the queue. Torques enter the linear parts as deviations from their feedforward.
"""

import math
from dataclasses import dataclass, field, fields
from functools import cached_property
from typing import Any

import numpy as np

from stewart_drake.law.belief import Belief
from stewart_drake.law.channel import Channel, Packets, Report, Wire
from stewart_drake.law.core_law import CompiledLaw
from stewart_drake.law.cost import Cost
from stewart_drake.law.feedforward import Feedforward
from stewart_drake.law.memory import Memory
from stewart_drake.law.motion import Motion
from stewart_drake.law.nominal import DesignModel, NominalPlant
from stewart_drake.law.observers import CoreObserver, Observer
from stewart_drake.law.planner import NoPlanner, Planner, Replan
from stewart_drake.law.predictors import ArrivalPredictor, NonlinearPredictor, Predictor
from stewart_drake.law.sensing import Measurement, Sensing
from stewart_drake.law.timeline import Timeline
from stewart_drake.scenario.signals import NUM_TORQUES
from stewart_drake.types import Array


@dataclass(frozen=True)
class PredictiveLqi:
    """The control law for one machine, made of parts; `dataclasses.replace` swaps one.

    Attributes:
        timeline: clock of the controller, with the delay that is assumed at the start. Later the
            observer's belief has the delay.
        sensing: model of the sensor.
        observer: estimates state, parameters and delay.
        predictor: error and integral where the next torque acts.
        feedforward: torque that the reference takes.
        model: of the error, for the gain.
        cost: computes the gain.
        channel: link to the motors.
        extra_torques: number of torques in memory beyond those of the delay, for late measurements.
        longest_wait: periods to wait for a late measurement before the model continues; 0:
            measurements are of the present.
        planner: of a path back, where the prediction is off the reference.
        tolerated_timing: s, standard deviation of the timing of single torques above which the
            weight of the torques grows with its square; infinite: the weight is given.
        open_loop_samples: samples at the start without feedback: until an own torque has acted,
            feedback only adds noise.
    """

    timeline: Timeline
    plant: NominalPlant
    sensing: Sensing
    observer: Observer
    predictor: Predictor | NonlinearPredictor
    feedforward: Feedforward
    model: DesignModel
    cost: Cost
    channel: Channel | Wire | Packets = field(default_factory=Wire)
    extra_torques: int = 0
    longest_wait: int = 0
    planner: Planner | NoPlanner | Replan = field(default_factory=NoPlanner)
    open_loop_samples: int = 0
    tolerated_timing: float = math.inf

    def __post_init__(self) -> None:
        if isinstance(self.predictor, ArrivalPredictor) and not self.finds_delay:
            raise ValueError(
                f"observer: got {type(self.observer).__name__} with a predictor for a delay that "
                "the observer finds; expected one derived from CoreObserver, or NonlinearPredictor"
            )

    @property
    def parts(self) -> dict[str, Any]:
        """Attributes of this class by name, without those of a derived one."""
        return {one.name: getattr(self, one.name) for one in fields(PredictiveLqi)}

    @property
    def estimates(self) -> bool:
        """Whether the observer estimates parameters; of a user's own this is assumed."""
        return not (isinstance(self.observer, CoreObserver) and self.observer.settings is None)

    @property
    def finds_delay(self) -> bool:
        """Whether the observer estimates the delay."""
        return isinstance(self.observer, CoreObserver) and self.observer.delay is not None

    @property
    def moves(self) -> bool:
        """Whether the law reads the motion at times that it chooses itself."""
        return self.finds_delay or not isinstance(self.planner, NoPlanner)

    @cached_property
    def preview_times(self) -> Array:
        """`times_for` the delay that is assumed at the start."""
        return self.times_for(self.timeline)

    def times_for(self, timeline: Timeline) -> Array:
        """Return the times (p,) of a preview, s from now; some may be negative."""
        nodes = self.feedforward.nodes(timeline, self.predictor.pending(timeline))
        at = np.concatenate([[0.0], self.predictor.samples(timeline)])
        further = (
            np.append(at[-1], nodes) + timeline.period * i for i in range(1, self.channel.torques)
        )
        return np.concatenate([at, nodes, *further])

    @property
    def queue_length(self) -> int:
        """Torques in flight at the start."""
        if self.finds_delay:
            assert isinstance(self.observer, CoreObserver)
            return self.observer.extra_torques(self.timeline.period)
        return self.timeline.queue_length

    @cached_property
    def _compiled(self) -> CompiledLaw:
        return CompiledLaw(self)

    def initial_memory(self, queue: Array) -> Memory:
        """Return the memory before the first sample.

        Args:
            queue: (n >= L, 6) torques in flight, oldest first, L by the delay at the start; more
                for an observer of your own whose estimate of the delay may grow.
        """
        more = len(queue) - self.queue_length
        if more < 0 or np.shape(queue)[1:] != (NUM_TORQUES,):
            expected = self.queue_length, NUM_TORQUES
            raise ValueError(f"queue: got shape {queue.shape}; expected {expected}, or more rows")
        return (CompiledLaw(self, more) if more else self._compiled).start(queue)

    def step(
        self,
        memory: Memory,
        measurement: Measurement,
        motion: Motion,
        weights: Array,
        report: Report | None = None,
    ) -> Memory:
        """Compute the torque of one sample.

        Args:
            memory: after the last sample.
            measurement: of `sensing`; the model replaces one that has a fault.
            motion: to follow. It is evaluated once, at `times_for` the estimated delay.
            weights: (2,) w_Q and w_R.
            report: that came with the measurement, or None.

        Returns:
            The new memory; its torque (6,) is finite. In flight is the torque within the limit.

        Raises:
            ValueError: a shape that does not fit, or a late measurement for a law that does not
                wait for one. Bad numbers are survived and counted.
        """
        if measurement.age != 0 and self.longest_wait == 0:
            raise ValueError(f"measurement: got an age of {measurement.age} s; expected 0")
        compiled = memory.compiled if memory.law is self else self._compiled
        return compiled.step(memory, measurement, motion, report, weights)

    def caution(self, belief: Belief) -> float:
        """Return the factor on w_R for an uncertain delay and uncertain timing."""
        return belief.caution * max(1.0, belief.timing / self.tolerated_timing) ** 2


@dataclass(frozen=True)
class OuterLqi(PredictiveLqi):
    """`PredictiveLqi` around the free law of the same parts."""

    @cached_property
    def free(self) -> PredictiveLqi:
        """The law of the same parts without the addition of this class."""
        return PredictiveLqi(**self.parts)


@dataclass(frozen=True)
class OuterMemory:
    """Memory of an `OuterLqi`; other names are those of the free law's memory."""

    free: Any  # memory of the free law

    def __getattr__(self, name: str) -> Any:
        if name.startswith("_") or name == "free":
            raise AttributeError(f"{type(self).__name__} has no attribute {name!r}")
        return getattr(self.free, name)
