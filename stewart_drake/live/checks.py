"""Checks of a live run: the longest gap of measurements, and the machine's reports of torques.

A torque that acts up to eta after the last measurement is based on it or on earlier ones, so that a
gap of up to eta changes nothing. Later torques are based on a prediction over the gap and eta. With
A and G of the last measurement's state held, its covariance P of state and parameters becomes

    P(s) = F P F',   F = exp([[A, G], [0, 0]] s),   s = gap + eta,

and the deviation of leg i's reach has the variance (J P J')_ii, J = d reach / d pose. The gap is
too long if three standard deviations of a leg exceed its remaining reach.
"""

from collections.abc import Mapping
from typing import Final

import numpy as np
from scipy.linalg import expm

from stewart_drake.law.belief import Estimate
from stewart_drake.law.nominal import NominalPlant
from stewart_drake.scenario.signals import NUM_COORDINATES, NUM_STATE, POSE, RATES
from stewart_drake.types import Array

LONGEST_GAP: Final = 1.0
"""Longest gap of measurements that is ever allowed, s."""
_DEVIATIONS: Final = 3.0
_STEP: Final = 1e-6
"""Step of the differences for J, rad and m."""
_ROWS: Final = 8
"""Number of consecutive torques reported a period off that count as an error."""
_KEPT: Final = 64
"""Number of periods whose sent torques are kept."""


def stays_within_reach(plant: NominalPlant, estimate: Estimate, torque: Array, span: float) -> bool:
    """Return whether the legs surely reach the pose after `span` s without measurements.

    Estimate and torque (6,) in N m are those at the last measurement; without a covariance the
    answer is yes.
    """
    if not estimate.uncertain:
        return True
    x, mechanism = estimate.state, plant.mechanism
    found = plant.dynamics.derivatives(x[POSE], x[RATES], torque, estimate.parameters)
    rate = np.zeros_like(estimate.covariance)
    rate[:NUM_STATE, :NUM_STATE], rate[:NUM_STATE, NUM_STATE:] = found.A, found.G
    left = mechanism.reach_margins(x[POSE])
    J = [
        (mechanism.reach_margins(x[POSE] + _STEP * e) - left) / _STEP
        for e in np.eye(NUM_COORDINATES)
    ]
    with np.errstate(all="ignore"):
        to_legs = np.transpose(J) @ expm(rate * span)[POSE]
        variance = np.einsum("ij,jk,ik->i", to_legs, estimate.covariance, to_legs)
        return bool(np.all(_DEVIATIONS * np.sqrt(variance) <= left))


class ReportCheck:
    """Compares reported torques with those that were sent for their periods, up to a limit."""

    def __init__(self, limit: float) -> None:
        self._limit = limit
        self._sent: dict[int, list[Array]] = {}
        self._off: dict[int, int] = {-1: 0, 1: 0}
        self._newest = -1

    def sent(self, first: int, rows: Array) -> None:
        """Note torques (n, 6) for the periods from `first` on."""
        for i, row in enumerate(np.clip(rows, -self._limit, self._limit)):
            self._sent.setdefault(first + i, []).append(row)
        for old in [n for n in self._sent if n < first - _KEPT]:
            del self._sent[old]

    def problem(self, acted: Mapping[int, Array]) -> str | None:
        """Return that torques (6,), by period, were reported a period early or late, or None."""
        for number in sorted(n for n in acted if n > self._newest):
            self._newest = number
            here = self._was_sent(number, acted[number])
            for shift in self._off:
                off = not here and self._was_sent(number + shift, acted[number])
                self._off[shift] = self._off[shift] + 1 if off else 0
        for shift, rows in self._off.items():
            if rows >= _ROWS:
                early, after = ("early", "after") if shift > 0 else ("late", "before")
                return (
                    f"acted_from in the machine's datagrams is one period {early}: its last {_ROWS}"
                    f" rows of torques were sent for the period {after}"
                )
        return None

    def _was_sent(self, number: int, torque: Array) -> bool:
        return any(np.array_equal(row, torque) for row in self._sent.get(number, []))
