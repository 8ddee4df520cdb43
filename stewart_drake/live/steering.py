"""What the law is to follow while somebody may take the reference over: the motion or a hand.

A torque computed at t acts at t + eta, and is computed from the reference up to t + h, h >= eta.
So what is asked for at t changes the reference from t + h on, and nothing before: no torque in
flight is ever wrong by it, and no error arises from a target that moves. That is how long a hand
waits.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Final, NamedTuple

import numpy as np
from pydrake.trajectories import PiecewisePolynomial, Trajectory

from stewart_drake.live.governor import Blend, Governed, Governor, response
from stewart_drake.scenario.signals import POSE
from stewart_drake.scenario.trajectories import Piece, evaluate, through_states
from stewart_drake.types import Array

_KEPT: Final = 3.0
"""s of the past that a way is kept for."""
_LEAST: Final = 0.05
"""s between two looks at a target."""
_SHORTEST: Final = 1e-6
"""s; what is shorter is no piece of a way."""


class Wish(NamedTuple):
    """What a person asks for.

    Attributes:
        target: (6,) pose in rad and m, or None for the scenario's motion.
        rest: whether to come to rest instead, as soon as that is smooth.
    """

    target: Array | None = None
    rest: bool = False


class Stretch(NamedTuple):
    """A part of a way, from `begin` in s on: states (18,) at instants."""

    begin: float
    at: Callable[[float], Array]


@dataclass(frozen=True)
class Way:
    """A reference, stretch after stretch.

    Attributes:
        stretches: by their begin; the first holds before that too.
    """

    stretches: tuple[Stretch, ...]

    @classmethod
    def along(cls, motion: Trajectory) -> "Way":
        """A trajectory, from its first instant on; before that where it begins."""
        return cls((Stretch(0.0, lambda t: evaluate(motion, max(0.0, t))),))

    def at(self, time: float) -> Array:
        """(18,) pose, rates and accelerations at a time in s."""
        for stretch in reversed(self.stretches):
            if stretch.begin <= time:
                return stretch.at(time)
        return self.stretches[0].at(time)

    def then(self, begin: float, at: Callable[[float], Array]) -> "Way":
        """The same up to `begin`, something else from there on; what is long past is dropped."""
        before = [s for s in self.stretches if s.begin < begin]
        while len(before) > 1 and before[1].begin < begin - _KEPT:
            del before[0]
        return Way((*before, Stretch(begin, at)))


@dataclass(frozen=True)
class Steering:
    """Who leads, and the way that follows from it.

    Attributes:
        governor: of a reference by hand.
        motion: the scenario's, a trajectory (6, 1).
        way: what is followed.
        governed: of the hand, at the time `until`; None while the motion leads.
        until: s, up to which the way is fixed.
        limit: why not all that is asked for is done, in words, or None.
    """

    governor: Governor
    motion: Trajectory
    way: Way
    governed: Governed | None = None
    until: float = 0.0
    limit: str | None = None

    def on(self, time: float, wish: Wish) -> "Steering":
        """With the way fixed up to `time` in s, and what is asked for from there on."""
        if time - self.until < _LEAST - 1e-9:
            return self
        if wish.target is None and not wish.rest:
            return self._let_go(time)
        governed = self.governed
        if governed is None:
            begun = self.governor.begin(self.way.at(time))
            if isinstance(begun, str):
                return replace(self, until=time, limit=begun)
            governed = begun
        else:
            governed = self.governor.after(governed, time - self.until)
        target = governed.applied if wish.rest or wish.target is None else wish.target
        return self._by_hand(self.governor.follow(governed, target), time)

    def _by_hand(self, governed: Governed, time: float) -> "Steering":
        way = self.way.then(time, _future(self.governor, governed, time))
        return replace(self, way=way, governed=governed, until=time, limit=governed.limit)

    def _let_go(self, time: float) -> "Steering":
        """Back onto the motion, if that is not where it is already."""
        if self.governed is None:
            return replace(self, until=time, limit=None)
        blend = self.governor.onto(self.way.at(time), time, self.motion)
        if isinstance(blend, Blend):
            way = self.way.then(time, _along(blend.way))
            return replace(self, way=way, governed=None, until=time, limit=None)
        governed = self.governor.after(self.governed, time - self.until)
        return replace(self._by_hand(governed, time), limit=blend)

    def anew(self, times: Array, states: Array) -> "Steering | str":
        """From where the plate will be when torques can be changed, whatever was followed before.

        Args:
            times: (n,) s, from now until then.
            states: (n, 18) the predicted way of the plate.

        Returns:
            The new way, or the limit by which there is none.
        """
        end, last = float(times[-1]), states[-1]
        drifted = self.way.then(float(times[0]), _through(times, states))
        if self.governed is not None:
            begun = self.governor.begin(last)
            if isinstance(begun, str):
                return begun
            way = drifted.then(end, _future(self.governor, begun, end))
            return replace(self, way=way, governed=begun, until=end, limit=None)
        blend = self.governor.onto(last, end, self.motion)
        if isinstance(blend, str):
            return blend
        return replace(self, way=drifted.then(end, _along(blend.way)), until=end, limit=None)


def _along(motion: Trajectory) -> Callable[[float], Array]:
    return lambda t: evaluate(motion, t)


def _future(governor: Governor, governed: Governed, begin: float) -> Callable[[float], Array]:
    """Under a target that stays, from `begin` in s on."""

    def at(time: float) -> Array:
        after = np.array([time - begin])
        return response(governed.state, governed.applied, governor.pace, after)[0]

    return at


def _through(times: Array, states: Array) -> Callable[[float], Array]:
    """Through predicted states (n, 18) at `times` (n,) s."""
    pieces: list[Piece] = [
        (float(times[i]), states[i], float(times[i + 1]), states[i + 1])
        for i in range(len(times) - 1)
        if times[i + 1] - times[i] > _SHORTEST
    ]
    if not pieces:  # no delay
        return lambda t: states[-1]
    return _along(through_states(pieces, PiecewisePolynomial(states[-1][POSE].reshape(6, 1))))
