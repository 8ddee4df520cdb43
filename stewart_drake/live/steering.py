"""The reference of a live run: the scenario's motion, or a target set by hand.

A torque computed at t acts at t + eta and is computed from the reference up to t + h, h >= eta. A
request at t therefore changes the reference from t + h on, and nothing before: torques in flight
stay right, and a moving target causes no tracking error. A hand waits for h.
"""

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Final, NamedTuple

from pydrake.trajectories import PiecewisePolynomial, Trajectory

from stewart_drake.live.governor import Blend, Governor, GovernorState
from stewart_drake.scenario.signals import POSE
from stewart_drake.scenario.trajectories import Piece, evaluate, through_states
from stewart_drake.types import Array

_KEPT: Final = 3.0
"""Time for which past segments are kept, s."""
_LEAST: Final = 0.05
"""Shortest time between two updates of the target, s."""
_SHORTEST: Final = 1e-6
"""Shortest piece of a trajectory, s."""
_CACHED: Final = 4096
"""Number of instants whose reference is cached."""


class Request(NamedTuple):
    """Request of a person."""

    target: Array | None = None  # pose (6,), rad and m, or None for the scenario's motion
    rest: bool = False  # whether to come to rest instead


class Segment(NamedTuple):
    """A part of the reference: states (18,) as a function of time, from `begin` in s on."""

    begin: float
    at: Callable[[float], Array]


@dataclass(frozen=True)
class Way:
    """The reference in segments, ordered by their begin; the first one also holds before it.

    A law asks for the same instants again at each sample, so that they are cached, to 1 ns.
    """

    segments: tuple[Segment, ...]
    _cache: dict[int, Array] = field(default_factory=dict, compare=False)

    @classmethod
    def along(cls, motion: Trajectory) -> "Way":
        """Return the reference of a trajectory, constant before t = 0."""
        return cls((Segment(0.0, lambda t: evaluate(motion, max(0.0, t))),))

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
        while len(before) > 1 and before[1].begin < begin - _KEPT:
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
        if time - self.until < _LEAST - 1e-9:
            return self
        governed = self._governed_at(time)
        if request.target is None and not request.rest:
            if governed is None:
                return replace(self, until=time, limit=None)
            blend = self.governor.onto(self.way.at(time), time, self.motion)
            if isinstance(blend, Blend):
                way = self.way.then(time, _along(blend.way))
                return replace(self, way=way, governed=None, until=time, limit=None)
            return replace(self._by_hand(governed, time), limit=blend)
        if governed is None:
            begun = self.governor.begin(self.way.at(time))
            if isinstance(begun, str):
                return replace(self, until=time, limit=begun)
            governed = begun
        target = governed.applied if request.rest or request.target is None else request.target
        return self._by_hand(self.governor.follow(governed, target), time)

    def _governed_at(self, time: float) -> GovernorState | None:
        if self.governed is None:
            return None
        return self.governor.after(self.governed, time - self.until)

    def _by_hand(self, governed: GovernorState, time: float) -> "Steering":
        way = self.way.then(time, _future(self.governor, governed, time))
        return replace(self, way=way, governed=governed, until=time, limit=governed.limit)

    def replan(self, times: Array, states: Array) -> "Steering | str":
        """Return a new reference from the state at which new torques can act, or the limit.

        Args:
            times: instants (n,) from now until then, s.
            states: predicted states (n, 18) of the plate.
        """
        end, last = float(times[-1]), states[-1]
        way = self.way.then(float(times[0]), _through(times, states))
        if self.governed is None:
            blend = self.governor.onto(last, end, self.motion)
            if isinstance(blend, str):
                return blend
            return replace(self, way=way.then(end, _along(blend.way)), until=end, limit=None)
        begun = self.governor.begin(last)
        if isinstance(begun, str):
            return begun
        way = way.then(end, _future(self.governor, begun, end))
        return replace(self, way=way, governed=begun, until=end, limit=None)


def _along(motion: Trajectory) -> Callable[[float], Array]:
    return lambda t: evaluate(motion, t)


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
    return _along(through_states(pieces, PiecewisePolynomial(states[-1][POSE].reshape(6, 1))))
