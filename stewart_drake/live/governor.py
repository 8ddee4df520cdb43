"""A target that somebody moves by hand, approached smoothly and as far as the machine can go.

Each coordinate follows an applied target g through three equal poles,

    q''' = w^3 (g - q) - 3 w^2 q' - 3 w q'',

so that pose, rates and accelerations are continuous. With e = q - g at the start, and g constant,

    e(t) = (c0 + c1 t + c2 t^2) exp(-w t),
    c0 = e,   c1 = q' + w e,   c2 = (q'' + 2 w q' + w^2 e) / 2.

The impulse response of three equal poles is positive: a target that moves one way moves the
coordinate that way, without overshoot, and a pose at rest never turns back.

The governor moves g towards the target, by the largest share k in [0, 1] for which the whole future
under g + k (target - g) keeps to the limits (a scalar reference governor; Garone, Di Cairano,
Kolmanovsky, "Reference and command governors for systems with constraints", Automatica 75, 2017).
k = 0 is the future that was found good before, so that there is always one: whatever is asked for,
and whenever it ends, the plate goes on within the limits and comes to rest at g.
"""

from dataclasses import dataclass
from functools import cached_property
from typing import Final, NamedTuple

import numpy as np
from pydrake.trajectories import Trajectory

from stewart_drake.dynamics.stewart import StewartDynamics
from stewart_drake.dynamics.workspace import PITCH_LIMIT, home_sign, margin, standing
from stewart_drake.law.startup import sizes
from stewart_drake.scenario.signals import (
    ACCELERATIONS,
    LEGS,
    NUM_COORDINATES,
    NUM_REFERENCE,
    POSE,
    RATES,
)
from stewart_drake.scenario.trajectories import evaluate, through_states
from stewart_drake.types import Array

PACE: Final = 4.0
"""1/s, w: a step is done to 5 % after 6.3 / w = 1.6 s."""
LEAST_MARGIN: Final = 0.05
"""Of the workspace (`dynamics.workspace.margin`), below which no target is followed."""
TORQUE_SHARE: Final = 0.8
"""Of the motors' limit that a motion by hand may take; feedback needs the rest."""
_GUARD: Final = 0.005
"""By which the margin is larger at the instants that are looked at, for those in between."""
_TORQUE_GUARD: Final = 0.995
"""Share of the torque that is used there, for the same reason."""
_SETTLED: Final = 18.0
"""w t after which 2e-6 of a step are left."""
_FINE, _COARSE, _UNTIL = 0.1, 0.5, 6.0
"""Steps of w t of the look ahead, before and after `_UNTIL`."""
_CLOSE: Final = 2e-4
"""rad, and shares of the reach, to which it is found how far a target can be approached."""
_FARTHEST: Final = 4.0
"""The same, from home: farther targets are clipped to it. No machine travels that far."""
_THERE: Final = 1e-6
"""The same, within which it is reached."""
_BLENDS: Final = (1.0, 1.5, 2.0, 3.0, 5.0, 8.0)
"""s; lengths of a way onto a motion, tried in this order."""
_BLEND_STEP: Final = 0.02
"""s between the instants at which such a way is looked at."""


def response(state: Array, applied: Array, pace: float, times: Array) -> Array:
    """(n, 18) pose, rates and accelerations at `times` (n,) s from a state (18,), g constant.

    Args:
        state: pose, rates, accelerations.
        applied: (6,) g, rad and m.
        pace: w, 1/s.
        times: s, >= 0.
    """
    e, v, a = state[POSE] - applied, state[RATES], state[ACCELERATIONS]
    c0, c1, c2 = e, v + pace * e, (a + 2 * pace * v + pace**2 * e) / 2
    t = np.asarray(times)[:, None]
    decay = np.exp(-pace * t)
    # Derivatives of p(t) exp(-w t) are (p' - w p) exp(-w t), and so on.
    p, dp, ddp = c0 + c1 * t + c2 * t**2, c1 + 2 * c2 * t, 2 * c2
    out = np.empty((len(t), NUM_REFERENCE))
    out[:, POSE] = applied + p * decay
    out[:, RATES] = (dp - pace * p) * decay
    out[:, ACCELERATIONS] = (ddp - 2 * pace * dp + pace**2 * p) * decay
    return out


class Governed(NamedTuple):
    """What a governor remembers, at the beginning of a period.

    Attributes:
        state: (18,) pose, rates and accelerations of the reference, rad, m and per s, s^2.
        applied: (6,) g, where it comes to rest if nothing more is asked for.
        limit: what keeps it from the target, in words, or None.
        turn: which coordinate goes on alone next, where all together cannot.
    """

    state: Array
    applied: Array
    limit: str | None = None
    turn: int = 0


@dataclass(frozen=True)
class Governor:
    """Keeps a reference by hand within the workspace and the motors' limits.

    Attributes:
        dynamics: of the machine as it is known.
        torque_limit: of each motor, N m, infinite for none; TORQUE_SHARE of it is used.
        pace: w, 1/s.
    """

    dynamics: StewartDynamics
    torque_limit: float = np.inf
    pace: float = PACE

    @cached_property
    def _times(self) -> Array:
        fine = np.arange(_FINE, _UNTIL, _FINE)
        return np.concatenate([fine, np.arange(_UNTIL, _SETTLED, _COARSE)]) / self.pace

    @cached_property
    def _size(self) -> Array:
        return sizes(self.dynamics.mechanism)

    def problem(self, states: Array) -> str | None:
        """Which limit states (n, 18) pass, in words, or None."""
        mechanism, least = self.dynamics.mechanism, LEAST_MARGIN + _GUARD
        margins = [margin(mechanism, state[POSE]) for state in states]
        if not min(margins) >= least:  # or NaN
            return self._named(states[int(np.argmin(margins))])
        return self._torque_problem(states)

    def _torque_problem(self, states: Array) -> str | None:
        most = TORQUE_SHARE * self.torque_limit
        if np.isinf(most):
            return None
        torques = np.abs(
            [self.dynamics.inverse_dynamics(x[POSE], x[RATES], x[ACCELERATIONS]) for x in states]
        ).max(axis=0)
        motor = int(np.argmax(torques))
        if torques[motor] <= _TORQUE_GUARD * most:
            return None
        return f"motor {LEGS[motor]} would take {torques[motor]:.3g} N m of {most:.3g}"

    def _named(self, state: Array) -> str:
        now = standing(self.dynamics.mechanism, state[POSE])
        sign = home_sign(self.dynamics.mechanism)
        leg = int(now.sines.argmin())
        limits = {
            f"leg {LEGS[leg]} comes to the end of its reach": now.sines[leg],
            "the pitch comes near 90 degrees": PITCH_LIMIT - abs(now.pitch),
            "the cranks would hardly hold the plate there": sign * now.parallel,
        }
        return min(limits, key=lambda reason: limits[reason])

    def future(self, state: Array, applied: Array) -> Array:
        """(n, 18) the way on from a state (18,) to rest at g (6,), where it is looked at."""
        return response(state, applied, self.pace, self._times)

    def follow(self, governed: Governed, target: Array) -> Governed:
        """With g moved towards a target (6,) as far as the limits let it; the state is the same."""
        # A huge target would take a bisection per factor of two, and overflow.
        reach = _FARTHEST * self._size
        home = self.dynamics.mechanism.home
        target = np.clip(target, home - reach, home + reach)
        away = target - governed.applied
        if np.abs(away / self._size).max() <= _THERE:
            return governed._replace(applied=np.array(target), limit=None)
        limit = self.problem(self.future(governed.state, target))
        if limit is None:
            return governed._replace(applied=np.array(target), limit=None)
        share = self._share(governed, away)
        if share == 0:  # what cannot go together goes on alone, one at a time
            alone = np.zeros(NUM_COORDINATES)
            alone[governed.turn] = away[governed.turn]
            away, share = alone, self._share(governed, alone)
            governed = governed._replace(turn=(governed.turn + 1) % NUM_COORDINATES)
        return governed._replace(applied=governed.applied + share * away, limit=limit)

    def _share(self, governed: Governed, away: Array) -> float:
        low, high, size = 0.0, 1.0, np.abs(away / self._size).max()
        while (high - low) * size > _CLOSE:
            middle = (low + high) / 2
            future = self.future(governed.state, governed.applied + middle * away)
            low, high = (middle, high) if self._within(future) else (low, middle)
        return low

    def _within(self, states: Array) -> bool:
        """Whether `problem` has none; most often the last state shows it."""
        mechanism, least = self.dynamics.mechanism, LEAST_MARGIN + _GUARD
        inside = all(margin(mechanism, state[POSE]) >= least for state in states[::-1])
        return inside and self._torque_problem(states) is None

    def after(self, governed: Governed, time: float) -> Governed:
        """The same `time` s later."""
        state = response(governed.state, governed.applied, self.pace, np.array([time]))[0]
        return governed._replace(state=state)

    def stop_pose(self, state: Array) -> Array:
        """(6,) the target at which a motion (18,) comes to rest soonest without turning back.

        The rates are [v + (a + w v) t - w c2 t^2] exp(-w t). With c2 = 0 they keep their sign where
        a + w v has that of v; where it has not, they do with -4 w c2 v = (a + w v)^2.
        """
        q, v, a = state[POSE], state[RATES], state[ACCELERATIONS]
        w, slope = self.pace, a + self.pace * v
        c2 = np.zeros(NUM_COORDINATES)
        back = slope * v < 0
        c2[back] = -(slope[back] ** 2) / (4 * w * v[back])
        return q - (2 * c2 - a - 2 * w * v) / w**2

    def begin(self, state: Array) -> Governed | str:
        """Take over from a motion (18,) that somebody else has made: towards rest, within limits.

        Tried is to stop at once, then to stop on the way home, ever nearer to it.

        Returns:
            What to go on with, or the limit by which there is no way to rest now.
        """
        stop, home = self.stop_pose(state), self.dynamics.mechanism.home
        first = self.problem(self.future(state, stop))
        if first is None:
            return Governed(state, stop)
        for share in (0.1, 0.25, 0.5, 0.75, 1.0):
            applied = stop + share * (home - stop)
            if self.problem(self.future(state, applied)) is None:
                return Governed(state, applied, first)
        return first

    def onto(self, state: Array, time: float, motion: Trajectory) -> "Blend | str":
        """The shortest way from a state (18,) at `time` s onto a motion that is within the limits.

        Returns:
            The way, or the limit that the longest one passes.
        """
        limit = ""
        for duration in _BLENDS:
            end = time + duration
            way = through_states([(time, state, end, evaluate(motion, end))], motion)
            steps = np.arange(time, end, _BLEND_STEP)
            found = self.problem(np.array([evaluate(way, float(t)) for t in steps]))
            if found is None:
                return Blend(way, end)
            limit = found
        return limit


class Blend(NamedTuple):
    """A way onto a motion."""

    way: Trajectory
    """The way, then the motion."""
    end: float
    """s, when the motion is reached."""
