"""Laws with a torque, or setpoints, learned from repetitions of a periodic motion.

*Torques.* With T_k of `PredictiveLqi` and l the learned torque, the motors get

    T_k + l(t_k + eta + dt/2),

l at the middle of the hold of T_k, and the model of the plant gets T_k alone: l replaces what the
model lacks. If the model got the sum, the observer would estimate l as a disturbance and remove it
again.

*Setpoints.* The setpoints of the law for position servos get the learned angle in the middle of the
period in which they act. Nothing is fed back to them, so that nothing would remove it.
"""

from dataclasses import dataclass, field, replace
from typing import Any, TypeVar

import numpy as np

from stewart_drake.law.channel import Report
from stewart_drake.law.counts import Counts
from stewart_drake.law.motion import Motion
from stewart_drake.law.predictive_lqi import OuterLqi, OuterMemory, PredictiveLqi
from stewart_drake.law.sensing import Measurement
from stewart_drake.law.servos import ServoPreview
from stewart_drake.types import Array

Law = TypeVar("Law", PredictiveLqi, ServoPreview)


def harmonics(phase: Array, number: int) -> Array:
    """Return 1, cos(h p), sin(h p) for h = 1 to `number`: (n, 1 + 2 number) for phases p (n,)."""
    angles = np.outer(phase, np.arange(1, number + 1))
    return np.hstack([np.ones((len(phase), 1)), np.cos(angles), np.sin(angles)])


@dataclass(frozen=True, eq=False)
class LearnedSignal:
    """Periodic torque or angle l(t) = `harmonics`(2 pi t / T) @ coefficients, N m or rad."""

    period: float  # T of the motion, s
    coefficients: Array  # (1 + 2 H, 6), N m or rad

    def __call__(self, times: Array) -> Array:
        """Return the torque or angle (n, 6) at instants (n,) in s of the motion, N m or rad."""
        number = len(self.coefficients) // 2
        return harmonics(2 * np.pi / self.period * times, number) @ self.coefficients


@dataclass(frozen=True)
class LearnedMemory(OuterMemory):
    """Memory of `LearnedLqi`; other names are those of the free law's memory.

    Attributes:
        free: memory of the law without the learned torque; its torques in flight lack it.
        in_flight: (n, 6) as sent, oldest first.
        torque: (6,) sum, without limit.
        samples: number of samples so far.
        saturated_steps: as of `law.counts.Counts`, of the sum.
    """

    in_flight: Array
    torque: Array
    samples: int = 0
    saturated_steps: int = 0

    @property
    def plan(self) -> Array:
        """Torque that was sent last, (1, 6)."""
        return self.in_flight[-1:]

    @property
    def counts(self) -> Counts:
        counts: Counts = self.free.counts
        return counts._replace(saturated_steps=self.saturated_steps)


@dataclass(frozen=True)
class LearnedLqi(OuterLqi):
    """`PredictiveLqi` with a learned torque."""

    # by the time of the motion, which begins with the first sample
    learned: LearnedSignal = field(kw_only=True)

    def initial_memory(self, queue: Array) -> Any:
        begun = self.free.initial_memory(queue)
        ago = np.arange(-len(queue), 0)
        free = self.free.initial_memory(np.subtract(queue, self._acting(ago)))
        return LearnedMemory(free, np.array(begun.in_flight), np.array(begun.torque))

    def _acting(self, samples: Array) -> Array:
        """Return the learned torque (n, 6) in the holds of the torques of samples (n,)."""
        return self.learned(self.timeline.eta + self.timeline.period * (samples + 0.5))

    def step(
        self,
        memory: Any,
        measurement: Measurement,
        motion: Motion,
        weights: Array,
        report: Report | None = None,
    ) -> Any:
        free = self.free.step(memory.free, measurement, motion, weights, report)
        (learned,) = self._acting(np.array([memory.samples]))
        torque = free.torque + learned
        sent = self.plant.motors.saturate(torque)
        free.in_flight[-1] = sent - learned  # the limit is on the sum
        return replace(
            memory,
            free=free,
            in_flight=np.vstack([memory.in_flight[1:], sent]),
            torque=torque,
            samples=memory.samples + 1,
            saturated_steps=memory.saturated_steps + bool(np.any(sent != torque)),
        )


def with_learned(law: Law, learned: LearnedSignal | None) -> Law:
    """Return the law with a learned torque, or with learned setpoints; as it is for None."""
    if learned is None:
        return law
    if isinstance(law, ServoPreview):
        return replace(law, learned=learned)
    return LearnedLqi(**law.parts, learned=learned)
