"""Catch-up: a path from rest onto a moving reference, with held torques (core/planning.h)."""

import math
from collections.abc import Callable
from functools import cache
from typing import NamedTuple

import numpy as np
from pydrake.trajectories import Trajectory

from stewart_drake.core.library import core
from stewart_drake.dynamics.stewart import StewartDynamics
from stewart_drake.dynamics.workspace import home_sign
from stewart_drake.files.errors import ConfigError
from stewart_drake.law.compiled import machine_of
from stewart_drake.law.least_error import LeastError
from stewart_drake.law.nominal import NominalPlant, TorqueLimit
from stewart_drake.mechanism.trajectories import rows_along, through_states
from stewart_drake.scenario.signals import NUM_REFERENCE
from stewart_drake.types import Array

DEFAULT_CATCH_UP = 0.3
"""s; without a torque limit."""
LONGEST_CATCH_UP = 10.0
HEADROOM = 0.95
"""Share of the torque limit for a plan; feedback needs the rest."""
PIECE = 0.025
"""s; largest distance of the times at which a planned motion is checked."""


class Plan(NamedTuple):
    """A plan as of core/planning.h."""

    pieces: Array  # (n, 38) of the planned motion
    peak: float  # N m, its largest torque


class CatchUp:
    """Motions from one state onto the reference, for any torque limit; each is planned once.

    Args:
        dynamics: the nominal plant.
        reference: the motion to reach.
        start: (12,) state at `t_start`, the first time at which a torque can act.
        t_start: s.
        period: of the controller, s.
        least: makes the plans of least error under a torque limit, or None for the shortest ones.
    """

    def __init__(
        self,
        dynamics: StewartDynamics,
        reference: Trajectory,
        start: Array,
        t_start: float,
        period: float,
        least: Callable[[], LeastError] | None = None,
    ) -> None:
        c = core()
        self._least = None if least is None else cache(least)
        self._reference, self._period = reference, period
        self._from = reference, start, t_start, period
        self._machine = machine_of(NominalPlant(dynamics, 1, math.inf, TorqueLimit()))
        self._sign, self._model = home_sign(dynamics.mechanism), c.ffi.new("stewart_model *")
        c.lib.stewart_set_model(self._machine.pointer, c.ffi.NULL, self._model)
        self._planned, self._motion = cache(self.over), cache(self._follow)
        self._improved = cache(self._improve)

    def plan(self, duration: float | None, torque_limit: float | None) -> tuple[Trajectory, float]:
        """Plan the motion, then the reference; return it with the duration of the plan in s.

        Equal plans are the same trajectory. Where no plan of up to LONGEST_CATCH_UP is possible,
        because the plate leaves its workspace before the first torque acts, that is the reference
        alone, and 0 s.

        Args:
            duration: s, rounded up to whole periods, two at least; None for the shortest that keeps
                HEADROOM to the torque limit, or for DEFAULT_CATCH_UP or more without a limit.
            torque_limit: N m, or None.

        Raises:
            ConfigError: with the given duration the plate would leave its workspace.
        """
        periods = shortest(self._possible, self._period, duration, torque_limit)
        if periods is None:
            return self._reference, 0.0
        plan = self._motion(periods), periods * self._period
        if self._least is None or torque_limit is None or duration is not None:
            return plan
        return self._improved(periods, torque_limit) or plan

    def over(self, periods: int) -> Plan | None:
        """Return the plan over a number of periods, two at least, or None without one."""
        c, times, peak = core(), np.empty(3), np.empty(1)
        reference, start, begin, period = self._from
        c.lib.stewart_plan_times(begin, period, periods, c.at(times))
        rows = rows_along(reference, times)
        pieces = np.empty((c.lib.stewart_plan_pieces(period, periods), c.lib.STEWART_PIECE))
        scratch = c.scratch(c.lib.stewart_plan_scratch(period, periods))
        given = c.at(np.array(start, np.float64)), begin, period, periods, c.at(rows)
        results = c.at(pieces), c.at(peak), scratch
        number = c.lib.stewart_plan_path(self._model, self._sign, *given, *results)
        return Plan(pieces, float(peak[0])) if number else None

    def _possible(self, periods: int, limit: float) -> bool:
        found = self._planned(periods)
        return found is not None and found.peak <= limit

    def _follow(self, periods: int) -> Trajectory:
        found = self._planned(periods)
        assert found is not None
        return self._through(found.pieces)

    def _improve(self, periods: int, torque_limit: float) -> tuple[Trajectory, float] | None:
        """Return the plan of least error in place of the shortest one, or None without one."""
        assert self._least is not None
        least = self._least()
        limit = least.share * torque_limit
        pieces = least.pieces(self._motion(periods), *self._from, periods, limit)
        if pieces is None:
            return None
        return self._through(pieces), float(pieces[-1, 1]) - self._from[2]

    def _through(self, pieces: Array) -> Trajectory:
        """Return the motion along pieces (n, 38), then the reference."""
        states = [(p[0], p[2 : 2 + NUM_REFERENCE], p[1], p[-NUM_REFERENCE:]) for p in pieces]
        return through_states(states, self._reference)


def shortest(
    possible: Callable[[int, float], bool],
    period: float,
    duration: float | None,
    torque_limit: float | None,
) -> int | None:
    """Return the periods of the requested plan, or of the shortest possible one, or None.

    Args:
        possible: whether a plan of n periods keeps to a limit in N m.
        period: s.
        duration, torque_limit: as of `CatchUp.plan`.

    Raises:
        ConfigError: no plan has the given duration.
    """
    wanted = DEFAULT_CATCH_UP if duration is None else duration
    fewest = 2 if torque_limit is not None and duration is None else periods_of(wanted, period)
    most = fewest if duration is not None else periods_of(LONGEST_CATCH_UP, period)
    limit = math.inf if torque_limit is None or duration is not None else HEADROOM * torque_limit
    # A longer plan takes less torque: double n, then halve the bracket.
    failed, periods = fewest - 1, fewest
    while not (found := possible(periods, limit)) and periods < most:
        failed, periods = periods, min(2 * periods, most)
    if not found and duration is None:
        return None
    if not found:
        raise ConfigError(
            f"controller.catch_up: got {duration:g} s, with which the plate would leave its "
            "workspace; expected a longer time, or null for the shortest possible"
        )
    while periods - failed > 1:
        middle = (failed + periods) // 2
        failed, periods = (failed, middle) if possible(middle, limit) else (middle, periods)
    return periods


def periods_of(duration: float, period: float) -> int:
    """Return the number of periods of a plan with a duration in s."""
    return max(2, math.ceil(duration / period - 1e-9))
