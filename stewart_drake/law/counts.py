"""Counts of the problems that the law survives."""

from collections import Counter
from typing import NamedTuple


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

    def summary(self, tuner_fallbacks: int = 0) -> dict[str, int]:
        """Return every count by its name, with `bad_measurements` and fallbacks of the tuner."""
        more = {"bad_measurements": self.bad_measurements, "tuner_fallbacks": tuner_fallbacks}
        return self._asdict() | more
