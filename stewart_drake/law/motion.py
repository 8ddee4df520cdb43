"""The motion that a law follows, as a function of the time from now."""

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from pydrake.trajectories import Trajectory

from stewart_drake.core.library import core
from stewart_drake.law.belief import Belief
from stewart_drake.law.compiled import machine_of, numbers
from stewart_drake.law.nominal import NominalPlant
from stewart_drake.law.timeline import TorqueSchedule
from stewart_drake.scenario.signals import NUM_REFERENCE, NUM_STATE
from stewart_drake.scenario.trajectories import evaluate
from stewart_drake.types import Array

Motion = Callable[[Array], Array]
"""The reference (p, 18), pose, rates and accelerations, at instants (p,) in s from now; some of
them may be negative."""


@dataclass(frozen=True)
class Preview:
    """A motion that is known at the instants that a law asks for.

    Attributes:
        times: (p,) s from now.
        reference: (p, 18).
    """

    times: Array
    reference: Array

    def __call__(self, times: Array) -> Array:
        """Return the reference at all of `times`.

        Raises:
            ValueError: at other instants than those.
        """
        expected = times is self.times or np.array_equal(times, self.times)
        if not expected or len(self.reference) != len(times):
            raise ValueError(
                f"preview: got {len(self.reference)} rows for {len(self.times)} instants; "
                f"expected the {len(times)} that the law asks for. A law that plans (see "
                "controller.replan) asks for any instants: give it the motion"
            )
        return self.reference


@dataclass(frozen=True)
class KnownMotion:
    """A motion that is known at all times.

    Attributes:
        planned: trajectory (6, 1) to follow: the way onto the reference, then the reference.
        reference: trajectory that a new plan leads back to.
        now: time of the sample on the clock of both trajectories, s.
        pieces: (n, 38) of a plan made in flight, see core/planning.h, which replaces `planned`
            until its end; then the reference follows.
    """

    planned: Trajectory
    reference: Trajectory
    now: float
    pieces: Array | None = None

    def __call__(self, times: Array) -> Array:
        """Return the motion at all of `times`."""
        return np.array([self._at(max(0.0, self.now + t)) for t in times])

    def goal(self, times: Array) -> Array:
        """Return the reference at all of `times`."""
        return np.array([evaluate(self.reference, max(0.0, self.now + t)) for t in times])

    def _at(self, time: float) -> Array:
        if self.pieces is None:
            return evaluate(self.planned, time)
        c, row = core(), np.empty(NUM_REFERENCE)
        if c.lib.stewart_along(len(self.pieces), c.at(self.pieces), time, c.at(row)):
            return row
        return evaluate(self.reference, time)


@dataclass(frozen=True)
class Course:
    """Preview of a sample, and the rows that the law follows, see core/reference.h.

    Attributes:
        times: (p,) s from the sample.
        reference: (p, 18), with numbers for what was missing; NaN before the first preview.
        followed: (p, 18) that the law follows: the same, after a gap with the way back.
        missing: whether anything was missing in the preview.
        gap: whether its last row was.
        offset: (12,) from the reference where the next torque acts, after a gap.
        holds: number of holds until the offset is zero.
        samples: number of samples after that until no torque of the way back is in flight.
    """

    times: Array
    reference: Array
    followed: Array
    missing: bool = False
    gap: bool = False
    offset: Array = field(default_factory=lambda: np.zeros(NUM_STATE))
    holds: int = 0
    samples: int = 0

    @classmethod
    def unknown(cls, times: Array) -> "Course":
        """Return the course before the first preview."""
        nothing = np.full((len(times), NUM_REFERENCE), np.nan)
        return cls(times, nothing, nothing)

    def following(
        self,
        times: Array,
        given: Array,
        belief: Belief,
        schedule: TorqueSchedule,
        plant: NominalPlant,
        quiet: bool,
    ) -> "Course":
        """Return the course of the next sample.

        Args:
            times: (p,) of its preview, s.
            given: (p, 18) its preview, NaN or infinite where it is missing.
            belief: now.
            schedule: torques until the next one acts.
            plant: model of the plant.
            quiet: whether nothing is fed back yet.
        """
        c, rows, timeline = core(), (len(times), NUM_REFERENCE), belief.timeline
        course, asked = Course(times, np.empty(rows), np.empty(rows)), numbers(given, *rows)
        state, theta, *torques = map(numbers, (belief.state, belief.parameters, *schedule))
        delay = timeline.period, timeline.queue_length, timeline.eta
        until = [len(torques[0]), *map(c.at, torques), 0]
        motion = c.ffi.new(
            "stewart_course_input *",
            [machine_of(plant).it, *delay, c.at(state), c.at(theta), until, quiet],
        )
        last, found = self._compiled(), course._compiled()
        scratch = c.scratch(2 * NUM_REFERENCE * len(times) + NUM_STATE * (len(torques[0]) + 1))
        c.lib.stewart_follow(motion, last, c.at(asked), found, scratch)
        back = found.back
        way = {"offset": np.array(list(back.offset)), "holds": back.holds, "samples": back.samples}
        return replace(course, missing=bool(found.missing), gap=bool(found.gap), **way)

    def _compiled(self) -> Any:
        """Return the `stewart_course`."""
        c = core()
        arrays = map(c.at, (self.times, self.reference, self.followed))
        back = [self.offset.tolist(), self.holds, self.samples]
        given = [len(self.times), *arrays, self.missing, self.gap, back]
        return c.ffi.new("stewart_course *", given)


def between(a: Array, b: Array, h: float, s: float) -> Array:
    """Return the reference (18,) at the share s of the way between two rows that are h s apart.

    The polynomial of fifth order with their poses, rates and accelerations.
    """
    c, row = core(), np.empty(NUM_REFERENCE)
    c.lib.stewart_between(c.at(a), c.at(b), h, s, c.at(row))
    return row
