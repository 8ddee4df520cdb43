"""The reference of a live run: the scenario's motion, or a target set by hand through a governor.

The governor (theory.md, section 36) approaches a target smoothly and within the machine's limits.
Each coordinate follows an applied target g through three equal poles; with e = q - g at the start,

    q''' = w^3 (g - q) - 3 w^2 q' - 3 w q'',
    e(t) = (c0 + c1 t + c2 t^2) exp(-w t),
    c0 = e,   c1 = q' + w e,   c2 = (q'' + 2 w q' + w^2 e) / 2.

g moves towards the target by the largest share for which the whole future with constant g keeps to
the limits. The share 0 is the future that was checked before, so that a solution always exists. A
step takes torque in proportion to w^2: w is the fastest pace whose future keeps to the torque
limit. A slower w than before makes a moving plate stop later, so that it is taken only if it makes
no rate change its sign.

A torque computed at t acts at t + eta and is computed from the reference up to t + h, h >= eta. A
request at t therefore changes the reference from t + h on, and nothing before.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from typing import Final, NamedTuple

import numpy as np
from pydrake.trajectories import Trajectory

from stewart_drake.dynamics.stewart import StewartDynamics
from stewart_drake.dynamics.workspace import PITCH_LIMIT, border, home_sign, margins, measures_at
from stewart_drake.law.startup import sizes
from stewart_drake.mechanism.trajectories import (
    Piece,
    PlateTrajectory,
    evaluate,
    rows_along,
    through_states,
)
from stewart_drake.scenario.signals import (
    ACCELERATIONS,
    LEGS,
    NUM_COORDINATES,
    NUM_REFERENCE,
    POSE,
    RATES,
)
from stewart_drake.types import Array

PACE: Final = 4.0
"""Slowest pole w, 1/s: a step is 3 / w = 0.75 s late, and complete to 5 % after 6.3 / w = 1.6 s."""
FASTEST: Final = 10.0
"""Fastest pole w, 1/s: 0.3 s and 0.63 s."""
_PACES: Final = 5
"""Number of paces that are tried."""
LEAST_MARGIN: Final = 0.05
"""Smallest workspace margin (`dynamics.workspace.margin`) of a motion by hand."""
TORQUE_SHARE: Final = 0.8
"""Share of the torque limit for a motion by hand; feedback needs the rest."""
_GUARD: Final = 0.005
"""Additional margin at the checked instants, for those in between."""
_TORQUE_GUARD: Final = 0.995
"""Share of the torque that is allowed at the checked instants, for the same reason."""
_SETTLED: Final = 18.0
"""w t after which 2e-6 of a step are left."""
_FINE, _COARSE, _UNTIL = 0.1, 0.5, 6.0
"""Steps of w t at which the future is checked, before and after `_UNTIL`."""
_PHASES: Final = np.concatenate(
    [np.arange(_FINE, _UNTIL, _FINE), np.arange(_UNTIL, _SETTLED, _COARSE)]
)
"""w t at which the future is checked."""
_ZERO_RATE: Final = 1e-9
"""Largest rate that counts as zero, rad/s and m/s."""
_RESOLUTION: Final = 2e-4
"""Accuracy of the applied target, rad and shares of the reach."""
_TARGET_CLIP: Final = 4.0
"""Distance from home to which a target is clipped, in the same units; no machine goes that far."""
_REACHED: Final = 1e-6
"""Distance within which a target is reached, in the same units."""
_BLENDS: Final = (1.0, 1.5, 2.0, 3.0, 5.0, 8.0)
"""Durations of a blend onto a motion, s, tried in this order."""
_BLEND_STEP: Final = 0.02
"""Time between the checked instants of a blend, s."""
_HISTORY: Final = 3.0
"""Time for which past segments are kept, s."""
_UPDATE_INTERVAL: Final = 0.05
"""Shortest time between two updates of the target, s."""
_SHORTEST: Final = 1e-6
"""Shortest piece of a trajectory, s."""
_CACHED: Final = 4096
"""Number of instants whose reference is cached."""


def response(state: Array, applied: Array, pace: float, times: Array) -> Array:
    """Return pose, rates and accelerations (n, 18) of the three poles with a constant target.

    From a state (18,) at time 0 to the target g (6,), with the pole w = `pace`, at times (n,) >= 0.
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


def stop_pose(state: Array, pace: float) -> Array:
    """Return the target (6,) at which a motion (18,) stops soonest without turning back.

    The rates are [v + (a + w v) t - w c2 t^2] exp(-w t). With c2 = 0 they keep their sign if
    a + w v has the sign of v; otherwise they do with -4 w c2 v = (a + w v)^2.
    """
    q, v, a = state[POSE], state[RATES], state[ACCELERATIONS]
    slope, c2 = a + pace * v, np.zeros(NUM_COORDINATES)
    back = slope * v < 0
    c2[back] = -(slope[back] ** 2) / (4 * pace * v[back])
    return q - (2 * c2 - a - 2 * pace * v) / pace**2


def _reversals(states: Array) -> Array:
    """Return the number of sign changes (6,) of each rate along states (n, 18)."""
    signs = [np.sign(v[np.abs(v) > _ZERO_RATE]) for v in states[:, RATES].T]
    return np.array([np.count_nonzero(np.diff(sign)) for sign in signs])


class GovernorState(NamedTuple):
    """State of a governor at the beginning of a period."""

    state: Array  # pose, rates and accelerations (18,) of the reference, rad, m and per s, s^2
    applied: Array  # applied target g (6,), at which the reference ends at rest
    limit: str | None = None  # limit that keeps g from the target, in words, or None
    alone: int = 0  # coordinate that moves alone next if all together cannot
    pace: float = PACE  # pole w, 1/s


@dataclass(frozen=True)
class Governor:
    """Reference governor: keeps a reference set by hand within workspace and torque limits."""

    dynamics: StewartDynamics
    torque_limit: float = np.inf  # limit of each motor, N m; TORQUE_SHARE of it is used
    fastest: float = FASTEST  # fastest pole w, 1/s. Without a torque limit it is the slowest.
    slowest: float = PACE  # slowest pole w, 1/s. A blend takes at least 4 / w.

    @cached_property
    def paces(self) -> tuple[float, ...]:
        """Possible poles w, fastest first, 1/s."""
        if np.isinf(self.torque_limit) or self.fastest <= self.slowest:
            return (self.slowest,)
        return tuple(np.geomspace(self.fastest, self.slowest, _PACES).tolist())

    @cached_property
    def _size(self) -> Array:
        return sizes(self.dynamics.mechanism)

    def problem(self, states: Array) -> str | None:
        """Return the limit that reference states (n, 18) exceed, in words, or None."""
        mechanism = self.dynamics.mechanism
        found = margins(mechanism, states[:, POSE])
        if found.min() >= LEAST_MARGIN + _GUARD:
            return self._torque_problem(states)
        worst = measures_at(mechanism, states[int(np.argmin(found)), POSE])
        leg = int(worst.sines.argmin())
        limits = {
            f"leg {LEGS[leg]} is near the end of its reach": worst.sines[leg],
            "the pitch is near 90 degrees": PITCH_LIMIT - abs(worst.pitch),
            "the cranks could hardly hold the plate": home_sign(mechanism) * worst.parallel,
        }
        return min(limits, key=lambda limit: limits[limit])

    def _within(self, states: Array) -> bool:
        return self.problem(states) is None

    def _torque_problem(self, states: Array) -> str | None:
        limit = TORQUE_SHARE * self.torque_limit
        if np.isinf(limit):
            return None
        torques = np.abs(self.dynamics.torques_along(states)).max(axis=0)
        motor = int(np.argmax(torques))
        if torques[motor] <= _TORQUE_GUARD * limit:
            return None
        return f"motor {LEGS[motor]} would take {torques[motor]:.3g} N m of {limit:.3g}"

    def future(self, state: Array, applied: Array, pace: float) -> Array:
        """Return the checked states (n, 18) from a state (18,) to rest at g (6,), w in 1/s."""
        return response(state, applied, pace, _PHASES / pace)

    def follow(self, governed: GovernorState, target: Array) -> GovernorState:
        """Move g towards a target (6,) as far and as fast as the limits allow.

        Pose, rates and accelerations stay.
        """
        # Unclipped, a huge target would take a bisection per factor of two, and overflow.
        reach, home = _TARGET_CLIP * self._size, self.dynamics.mechanism.home
        target = np.clip(target, home - reach, home + reach)
        step = target - governed.applied
        if np.abs(step / self._size).max() <= _REACHED:
            return governed._replace(applied=target, limit=None)
        there = governed._replace(applied=target)
        pace = next(self._possible(there, self.paces), None)
        if pace is not None:
            return there._replace(limit=None, pace=pace)
        # The slowest pace leaves the most torque for the share of the step.
        governed = governed._replace(
            pace=next(self._possible(governed, self.paces[::-1]), governed.pace)
        )
        limit = self.problem(self.future(governed.state, target, governed.pace))
        share = self._share(governed, step)
        if share == 0:  # try one coordinate alone, another one each time
            alone = np.zeros(NUM_COORDINATES)
            alone[governed.alone] = step[governed.alone]
            step, share = alone, self._share(governed, alone)
            governed = governed._replace(alone=(governed.alone + 1) % NUM_COORDINATES)
        moved = governed._replace(applied=governed.applied + share * step, limit=limit)
        return moved._replace(pace=next(self._possible(moved, self.paces), moved.pace))

    def _possible(self, governed: GovernorState, paces: Sequence[float]) -> Iterator[float]:
        """Yield those of some paces that keep to the limits on the way to g.

        A slower one than the present one is left out if it makes a rate change its sign.
        """
        reversals = _reversals(self.future(*governed[:2], governed.pace))
        for pace in paces:
            states = self.future(*governed[:2], pace)
            no_more = pace >= governed.pace or np.all(_reversals(states) <= reversals)
            if no_more and self._within(states):
                yield pace

    def _share(self, governed: GovernorState, step: Array) -> float:
        def fits(share: float) -> bool:
            applied = governed.applied + share * step
            return self._within(self.future(governed.state, applied, governed.pace))

        size = max(_RESOLUTION, np.abs(step / self._size).max())
        return border(fits, 0.0, 1.0, _RESOLUTION / size)[0]

    def after(self, governed: GovernorState, time: float) -> GovernorState:
        """Advance the reference by `time` s."""
        way = response(governed.state, governed.applied, governed.pace, np.array([time]))
        return governed._replace(state=way[0])

    def begin(self, state: Array) -> GovernorState | str:
        """Return a governor that stops a motion (18,), or the limit that prevents it.

        Tried in this order: the slowest pace, faster ones, then poses nearer and nearer to home.
        """
        stops = [
            GovernorState(state, stop_pose(state, pace), pace=pace) for pace in self.paces[::-1]
        ]
        for stop in stops:
            if self._within(self.future(*stop[:2], stop.pace)):
                return stop
        slowest, home = stops[0], self.dynamics.mechanism.home
        limit = self.problem(self.future(*slowest[:2], slowest.pace)) or ""
        for share in (0.1, 0.25, 0.5, 0.75, 1.0):
            applied = slowest.applied + share * (home - slowest.applied)
            if self._within(self.future(state, applied, slowest.pace)):
                return slowest._replace(applied=applied, limit=limit)
        return limit

    def onto(self, state: Array, time: float, motion: Trajectory) -> Trajectory | str:
        """Return the shortest blend within the limits from a state (18,) at `time` s onto a motion.

        After the blend the trajectory is the motion. If no blend keeps to the limits, return the
        limit that the longest one exceeds.
        """
        states, least = np.empty((0, NUM_REFERENCE)), min(4 / self.slowest, _BLENDS[-1])
        for duration in (one for one in _BLENDS if one >= least):
            end = time + duration
            blend = through_states([(time, state, end, evaluate(motion, end))], motion)
            states = rows_along(blend, np.arange(time, end, _BLEND_STEP))
            if self._within(states):
                return blend
        return self.problem(states) or ""


# ---------------------------------------------------------------- the reference of a run


class Request(NamedTuple):
    target: Array | None = None  # pose (6,), rad and m, or None for the scenario's motion
    rest: bool = False  # whether to stop instead


class Segment(NamedTuple):
    """Part of the reference."""

    begin: float  # s
    at: Callable[[float], Array]  # states (18,) as a function of time


@dataclass(frozen=True)
class Way:
    """The reference in segments, the earliest first. Before its begin the first one holds too.

    A law reads the same instants again at each sample. They are therefore cached, to 1 ns.
    """

    segments: tuple[Segment, ...]
    _cache: dict[int, Array] = field(default_factory=dict, compare=False)

    @classmethod
    def along(cls, motion: Trajectory) -> "Way":
        """Return the reference of a trajectory, constant before t = 0."""
        return cls((Segment(0.0, _along(motion)),))

    def at(self, time: float) -> Array:
        """Return pose, rates and accelerations (18,) at a time in s."""
        instant = round(1e9 * time)
        state = self._cache.get(instant)
        if state is None:
            if len(self._cache) >= _CACHED:
                self._cache.clear()
            begun = (s for s in reversed(self.segments) if s.begin <= time)
            state = self._cache[instant] = next(begun, self.segments[0]).at(time)
        return state

    def then(self, begin: float, at: Callable[[float], Array]) -> "Way":
        """Replace the reference from `begin` on, and drop segments that are long past."""
        before = [s for s in self.segments if s.begin < begin]
        while len(before) > 1 and before[1].begin < begin - _HISTORY:
            del before[0]
        return Way((*before, Segment(begin, at)))


@dataclass(frozen=True)
class Steering:
    """The reference, and the governor that leads it."""

    governor: Governor  # governor of a reference set by hand
    motion: Trajectory  # motion of the scenario, a trajectory (6, 1)
    way: Way
    # state of the governor at the time `until`; None while the motion leads
    governed: GovernorState | None = None
    until: float = 0.0  # time up to which the reference is fixed, s
    limit: str | None = None  # limit that prevents the requested motion, in words, or None

    def on(self, time: float, request: Request) -> "Steering":
        """Fix the reference up to `time` in s, and follow a request from there on."""
        if time - self.until < _UPDATE_INTERVAL - 1e-9:
            return self
        governed = self.governed
        if governed is not None:
            governed = self.governor.after(governed, time - self.until)
        if request.target is None and not request.rest:
            if governed is None:
                return replace(self, until=time, limit=None)
            blend = self.governor.onto(self.way.at(time), time, self.motion)
            if isinstance(blend, str):
                return replace(self._by_hand(governed, time), limit=blend)
            way = self.way.then(time, _along(blend))
            return replace(self, way=way, governed=None, until=time, limit=None)
        if governed is None:
            begun = self.governor.begin(self.way.at(time))
            if isinstance(begun, str):
                return replace(self, until=time, limit=begun)
            governed = begun
        target = governed.applied if request.rest or request.target is None else request.target
        return self._by_hand(self.governor.follow(governed, target), time)

    def _by_hand(self, governed: GovernorState, time: float) -> "Steering":
        way = self.way.then(time, _future(self.governor, governed, time))
        return replace(self, way=way, governed=governed, until=time, limit=governed.limit)

    def replan(self, times: Array, states: Array) -> "Steering | str":
        """Return a new reference from the state at which new torques can act, or the limit.

        `states` (n, 18) are predicted at `times` (n,) in s, from now until then.
        """
        end, last = float(times[-1]), states[-1]
        way = self.way.then(float(times[0]), _through(times, states))
        if self.governed is None:
            blend = self.governor.onto(last, end, self.motion)
            if isinstance(blend, str):
                return blend
            return replace(self, way=way.then(end, _along(blend)), until=end, limit=None)
        begun = self.governor.begin(last)
        if isinstance(begun, str):
            return begun
        way = way.then(end, _future(self.governor, begun, end))
        return replace(self, way=way, governed=begun, until=end, limit=None)


def _along(motion: Trajectory) -> Callable[[float], Array]:
    return partial(evaluate, motion)


def _future(governor: Governor, governed: GovernorState, begin: float) -> Callable[[float], Array]:
    return lambda t: governor.after(governed, t - begin).state


def _through(times: Array, states: Array) -> Callable[[float], Array]:
    """Return the reference through predicted states (n, 18) at `times` (n,) s."""
    pieces: list[Piece] = [
        (float(times[i]), states[i], float(times[i + 1]), states[i + 1])
        for i in range(len(times) - 1)
        if times[i + 1] - times[i] > _SHORTEST
    ]
    if not pieces:  # no delay
        return lambda t: states[-1]
    return _along(through_states(pieces, PlateTrajectory(offset=states[-1][POSE])))
