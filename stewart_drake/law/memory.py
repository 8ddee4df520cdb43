"""What the control law carries from one sample to the next."""

from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np

from stewart_drake.law.belief import Belief
from stewart_drake.law.channel import Sent
from stewart_drake.law.motion import Previewed
from stewart_drake.law.return_path import ReturnPath
from stewart_drake.scenario.signals import NUM_TORQUES
from stewart_drake.types import Array


class Counts(NamedTuple):
    """Things that went wrong and were survived, by cause.

    Attributes:
        riccati_failures: samples without a new gain.
        unreachable: samples without a model: a plate at the predicted pose cannot be regulated.
        nonfinite_torque: samples whose torque was no number, so that the last one was sent again.
        measurements_missing: measurements with values that are no numbers.
        measurements_frozen: measurements that only repeat the last one, or a leg of which does.
        measurements_rejected: measurements that the plate cannot have, or that the filter takes
            for outliers, or values of theirs.
        saturated_steps: samples with a torque at the limit.
        references_missing: samples with NaN or infinity in the reference, which continued from the
            last one.
    """

    riccati_failures: int = 0
    unreachable: int = 0
    nonfinite_torque: int = 0
    measurements_missing: int = 0
    measurements_frozen: int = 0
    measurements_rejected: int = 0
    saturated_steps: int = 0
    references_missing: int = 0

    def plus(self, *causes: str | None) -> "Counts":
        """One more of each cause that is not None."""
        return self._replace(**{cause: getattr(self, cause) + 1 for cause in causes if cause})

    @property
    def bad_measurements(self) -> int:
        """Samples and causes, for which the model stood in for a measurement or a part of it."""
        return self.measurements_missing + self.measurements_frozen + self.measurements_rejected

    def summary(self) -> dict[str, int]:
        """Every count by its name, `bad_measurements` too."""
        return self._asdict() | {"bad_measurements": self.bad_measurements}


@dataclass(frozen=True)
class Memory:
    """What the controller carries from one sample to the next.

    The shapes never change, but those of gain and reference with the delay that is believed in.

    Attributes:
        in_flight: (n > L, 6) torques, oldest first; the last is the newest. The last L are the
            queue; the one before them (and, where eta0 > 0, the first of them) acted during the
            last period. They are what the limit has let through.
        belief: at the last sample.
        measurement: (m,) at the last sample, as it came; NaN before the first.
        error: (6,) pose error at the last sample.
        integral: (6,) of the pose error.
        gain: (6, g) last good feedback gain; NaN before there is one.
        torque: (6,) last torque as asked for, which may be beyond the limit.
        weights: (2,) w_Q and w_R that were used.
        counts: see `Counts`.
        plan: (N, 6) torques that were sent last, the first of them the last in flight.
        sent: what the channel remembers.
        reference: that was given, with numbers for what was missing; NaN before there was any.
        followed: (p, 18) the same with the way back after a gap.
        delayed: belief at the last measurement, where it may be late, else None.
        lag: age of that belief, periods.
        path: (n, 38) pieces that were planned in flight, or None.
        silence: samples that are still to go on without feedback.
        gap: whether the last row of the last preview was missing.
        back: way back since the end of the last gap.
        feedforward: (6,) how much of `torque` rests on no measurement; NaN before the first sample.
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
    reference: Previewed
    followed: Array
    delayed: Belief | None = None
    lag: int = 0
    path: Array | None = None
    silence: int = 0
    gap: bool = False
    back: ReturnPath = field(default_factory=ReturnPath)
    feedforward: Array = field(default_factory=lambda: np.full(NUM_TORQUES, np.nan))

    def without_error(self) -> "Memory":
        """The same with nothing integrated."""
        nothing = np.zeros_like(self.error)
        return replace(self, error=nothing, integral=nothing)
