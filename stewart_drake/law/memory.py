"""Memory of the control law from one sample to the next."""

from collections import Counter
from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np

from stewart_drake.law.belief import Belief
from stewart_drake.law.channel import Sent
from stewart_drake.law.motion import Course
from stewart_drake.scenario.signals import NUM_TORQUES
from stewart_drake.types import Array


class Counts(NamedTuple):
    """Numbers of survived problems, by cause, in the order of the bits of `stewart_status`.

    Attributes:
        riccati_failures: samples without a new gain.
        unreachable: samples without a model: a plate at the predicted pose cannot be regulated.
        nonfinite_torque: samples with a torque that was not finite; the last one was sent again.
        measurements_missing: measurements with values that are not finite.
        measurements_frozen: measurements that repeat the last one, or with a leg that does.
        measurements_rejected: measurements that the plate cannot have, or that the filter rejects
            as outliers, or single values of theirs.
        saturated_steps: samples with a torque at the limit.
        references_missing: samples with NaN or infinity in the reference, which continued from the
            last one.
        limited_steps: samples in which a limit binds within the horizon, for `limits: qp`.
        qp_failures: samples without a plan within the limits; the last plan went on.
        qp_late: the same because time or iterations ran out.
    """

    riccati_failures: int = 0
    unreachable: int = 0
    nonfinite_torque: int = 0
    measurements_missing: int = 0
    measurements_frozen: int = 0
    measurements_rejected: int = 0
    saturated_steps: int = 0
    references_missing: int = 0
    limited_steps: int = 0
    qp_failures: int = 0
    qp_late: int = 0

    def plus(self, *causes: str | None) -> "Counts":
        """Return the counts with one more for each cause that is not None."""
        added = Counter(cause for cause in causes if cause)
        return self._replace(**{cause: getattr(self, cause) + n for cause, n in added.items()})

    @property
    def bad_measurements(self) -> int:
        """Measurements, by cause, that the model replaced in whole or in part."""
        return self.measurements_missing + self.measurements_frozen + self.measurements_rejected

    def summary(self) -> dict[str, int]:
        """Return every count by its name, with `bad_measurements`."""
        return self._asdict() | {"bad_measurements": self.bad_measurements}


@dataclass(frozen=True)
class Memory:
    """Memory of a law that Python steps.

    The shapes never change, but those of gain and course with the estimated delay.

    Attributes:
        in_flight: (n > L, 6) torques within the limit, oldest first. The last L are the queue; the
            one before them (and, where eta0 > 0, the first of them) acted during the last period.
        belief: at the last sample.
        measurement: (m,) at the last sample, as it came; NaN before the first.
        error: (6,) pose error at the last sample.
        integral: (6,) of the pose error.
        gain: (6, g) last good feedback gain; NaN before the first.
        torque: (6,) last computed torque, which may be beyond the limit.
        weights: (2,) last w_Q and w_R.
        counts: see `Counts`.
        plan: (N, 6) torques that were sent last, the first of them the last in flight.
        sent: memory of the channel.
        course: last preview, and the rows that were followed.
        delayed: belief at the last measurement, where it may be late, else None.
        lag: age of that belief, periods.
        path: (n, 38) pieces of a plan made in flight, or None.
        silence: samples that remain without feedback.
        feedforward: (6,) share of `torque` without feedback; NaN before the first sample.
    """

    in_flight: Array
    belief: Belief
    measurement: Array
    error: Array
    integral: Array
    gain: Array
    torque: Array
    weights: Array
    counts: Counts
    plan: Array
    sent: Sent
    course: Course
    delayed: Belief | None = None
    lag: int = 0
    path: Array | None = None
    silence: int = 0
    feedforward: Array = field(default_factory=lambda: np.full(NUM_TORQUES, np.nan))

    def without_error(self) -> "Memory":
        """Return the memory with error and integral reset."""
        nothing = np.zeros_like(self.error)
        return replace(self, error=nothing, integral=nothing)
