"""Learning from repetitions of a motion of a machine, in real time.

*Torques.* All repetitions are one run. In each the plate follows the motion for some periods, then
the governor brings it back to the start, where it rests. The torques that the model lacks in the
last period correct those of the next repetition, as in `studies.learn`. They are computed on the
way back, some at each sample.

*Setpoints.* Each repetition is another session: a soft start, the motion, and rest. The angles
that the cranks lack in the last periods correct the setpoints of the next one.
"""

import math
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import closing
from dataclasses import replace
from itertools import islice, pairwise
from pathlib import Path
from typing import Any, Final, NamedTuple

import numpy as np

from stewart_drake.files.errors import ConfigError
from stewart_drake.law.learned import LearnedSignal
from stewart_drake.law.servos import rise
from stewart_drake.law.timeline import Timeline
from stewart_drake.live.contact import parse_address
from stewart_drake.live.design import Learned, always
from stewart_drake.live.endpoint import read_key
from stewart_drake.live.governor import PACE, Request
from stewart_drake.live.loop import REST_RATE, START_ERROR
from stewart_drake.live.options import LiveOptions
from stewart_drake.live.session import Ready, drive, plans, prepare_session
from stewart_drake.live.viewer import End, Snapshot, Viewer
from stewart_drake.loop.learned import HARMONICS, save_learned
from stewart_drake.loop.preparation import Experiment, knowing, prepare
from stewart_drake.loop.results import SimulationResult, accumulated_error
from stewart_drake.mechanism.trajectories import rows_along
from stewart_drake.scenario.config import Scenario
from stewart_drake.scenario.signals import POSE, RATES
from stewart_drake.studies.learn import (
    PERIOD_ERROR,
    LearnStudy,
    Lessons,
    Measure,
    Repetition,
    check_learning,
    estimated,
    lacking_angles,
    lacking_torque,
)
from stewart_drake.types import Array

_SETTLING: Final = 9.0
"""Time before the periods that are learned from, s: the longest way onto the motion, and 1 s."""
_DELAYS: Final = 5.0
"""Additional time for torques, in delays."""
_LEARNED_FROM: Final = 4.0
"""Least time that setpoints are learned from, s; it is rounded up to whole periods."""
_WAIT: Final = 10.0
"""Longest wait for a way onto the motion, s."""
_PACE: Final = 2.0
"""Pole of the governor over the motion's angular frequency, for a way back with little torque."""
_SOFT: Final = 2.0
"""Time in which one learned torque replaces another, s."""
_INSTANTS: Final = 200
"""Instants of a period at which its slowest one is sought."""
_EACH: Final = 4
"""Number of lacking torques that are computed at a sample; one takes about 0.7 ms."""
_AGAIN: Final = 3
"""Largest number of repetitions in a row that are done again for lack of measurements."""


class _Asked(NamedTuple):
    scenario: Scenario
    machine: str  # HOST:PORT
    options: LiveOptions
    say: Callable[[str], None]
    ending: Callable[[], bool]

    @property
    def file(self) -> Path:
        return self.options.learned or Path("learned.npz")

    def call(self, learned: Learned, duration: float = math.inf, plan: bool = True) -> Ready:
        """Find the machine; print the plan of a run of `duration` s."""
        address, key = parse_address(self.machine), read_key(self.options.key)
        ready = prepare_session(self.scenario, address, key, learned)
        for line in plans(ready, duration, ready.design.experiment.mechanism.name) if plan else ():
            self.say(line)
        return ready

    def drive(self, ready: Ready, duration: float = math.inf, **how: Any) -> SimulationResult:
        how |= self.options.model_dump(include={"armed", "accept_jitter", "max_missing"})
        with closing(ready.endpoint):
            return drive(ready, duration, ending=self.ending, say=self.say, **how)

    def end(self, lessons: Lessons, own: Experiment, done: list[Repetition]) -> LearnStudy:
        """Print the number of the best repetition; return all."""
        best = lessons.best
        self.say(
            f"repetition {1 + best} is the best; what it added is written to {self.file}, for "
            "controller.learned"
            if best
            else "nothing was learned: no repetition was better than the first one"
        )
        asked, file = self.options.learn, str(self.file)
        early = len(done) < asked and not lessons.ended
        cranks = self.scenario.controller.command == "cranks"
        measure = Measure("the rms error of the cranks", "deg") if cranks else PERIOD_ERROR
        return LearnStudy(own, lessons.period, done, asked, early, measure=measure, file=file)


class LiveLessons(NamedTuple):
    run: SimulationResult  # of all repetitions; of setpoints the best one, or the last one
    study: LearnStudy | None  # None if no repetition completed


def learn_live(
    scenario: Scenario,
    machine: str,
    options: LiveOptions,
    say: Callable[[str], None],
    ending: Callable[[], bool] = lambda: False,
) -> LiveLessons:
    """Repeat a motion on a machine, learn from each repetition, and write what was learned.

    Learning ends early after two repetitions without a smaller error, or if one does not complete,
    or four in a row lack measurements, or once `ending` returns True.

    Raises:
        ConfigError: see `studies.learn.check_learning` and `live.session`.
    """
    check_learning(scenario)
    asked = _Asked(scenario, machine, options, say, ending)
    if not asked.file.parent.is_dir():
        raise ConfigError(f"--learned: got {asked.file}; expected a file in a folder that is there")
    cranks = scenario.controller.command == "cranks"
    return _learn_setpoints(asked) if cranks else _learn_torques(asked)


class _Arrivals:
    """Decides whether a repetition that lacks measurements is done again."""

    def __init__(self, least: int, say: Callable[[str], None]) -> None:
        self._least, self._say, self._lost = least, say, 0

    @property
    def failed(self) -> bool:
        """Whether too many repetitions in a row lacked measurements."""
        return self._lost > _AGAIN

    def suffice(self, number: int, measurements: int) -> bool:
        """Return whether repetition `number` has enough; print what follows if not."""
        self._lost = 0 if measurements >= self._least else self._lost + 1
        if not self._lost:
            return True
        found = f"repetition {number}: {measurements} measurements to learn from"
        then = "learning ends" if self.failed else "it is done again"
        self._say(f"{found}; expected at least {self._least}; {then}")
        return False


# ---------------------------------------------------------------- torques


def _learn_torques(asked: _Asked) -> LiveLessons:
    lessons = TorqueLessons(prepare(asked.scenario), asked.options.learn, asked.say)
    ready = asked.call(lessons)
    result = asked.drive(ready, viewer=lessons, logs=[lessons], pace=lessons.pace)
    if result.status != "completed":
        asked.say(f"learning ends in repetition {len(lessons.learning.errors) + 1}")
    if not lessons.learning.errors:
        return LiveLessons(result, None)
    if best := lessons.learning.best:
        save_learned(asked.file, lessons.tried[best], lessons.experiment)
    done = lessons.repetitions(result)
    return LiveLessons(result, asked.end(lessons.learning, lessons.experiment, done))


class _Step(NamedTuple):
    """One of the controller's periods."""

    time: float  # of its begin, s
    states: Array  # (2, 12) at its begin and end
    acted: Array  # (2, 6) torques that acted at its begin and end, N m


class TorqueLessons(Viewer):
    """Requests the repetitions of a motion, and learns torques from each.

    It is the viewer of a run, and a log of it. A call returns the torque that the loop adds. It is
    blended from that of the last repetition into that of the present one.

    Attributes:
        tried: added torques of the repetitions so far; those of the first one are zero.
        learning: its errors are E of the last period of each complete repetition, % s.
        done: whether learning has ended.
        pace: pole of the governor, 1/s.
    """

    def __init__(self, experiment: Experiment, number: int, say: Callable[[str], None]) -> None:
        self.experiment, self._number, self._say = experiment, number, say
        sc = experiment.scenario
        self.learning = Lessons(sc)
        self._dt, self._period = sc.controller.period, self.learning.period
        none = LearnedSignal(self._period, np.zeros((1 + 2 * HARMONICS, 6)))
        self.tried, self.done = [none], False
        self._arrivals = _Arrivals(self.learning.least, say)
        self._span = _SETTLING + _DELAYS * sc.eta + self._period
        self._size = 2 * experiment.motion_scale
        times = np.linspace(0.0, self._period, _INSTANTS, endpoint=False)
        rates = rows_along(experiment.reference, times)[:, RATES] / self._size
        self.pace = min(PACE, _PACE * 2 * np.pi / self._period)
        self._slowest = float(times[np.argmin(np.abs(rates).max(axis=1))])
        self._until, self._asked, self._returns = self._end_of_motion(0.0), 0.0, False
        self._ends = list[float]()  # of the motions that were judged, s
        self._before, self._share = none, 0.0
        self._left: Array = self.experiment.start[POSE]  # pose at which the motion ended
        self._target = self._left
        periods = round(self._period / self._dt)
        self._rows = deque[tuple[float, Mapping[str, Array]]](maxlen=periods + 1)
        self._whole = False
        self._lacking: Iterator[tuple[float, Array]] | None = None
        self._found: list[tuple[float, Array]] = []

    def __call__(self) -> LearnedSignal:
        before, present = self._before.coefficients, self.tried[-1].coefficients
        return LearnedSignal(self._period, before + self._share * (present - before))

    def request(self) -> Request:
        return Request(target=self._target) if self._returns else Request()

    def finished(self) -> bool:
        return self.done

    def write(self, time: float, values: Mapping[str, Array]) -> None:
        """Keep the samples of the motion's last period."""
        if not self._returns or time <= self._until + self._dt / 2:
            self._rows.append((time, values))
        else:
            self._whole = True

    def close(self) -> None:
        """Do nothing."""

    def show(self, snapshot: Snapshot) -> None:
        """Change from the motion to the way back, and from there to the next repetition."""
        t = snapshot.time
        if self.done:
            return
        if not self._returns:
            self._share = float(rise((t - self._asked) / _SOFT))
            if snapshot.by_hand:  # no way onto the motion was found yet
                self._until = self._end_of_motion(t)
                if t - self._asked > _WAIT:
                    self._end(f"no way onto the motion within {_WAIT:g} s: {snapshot.limit}")
            self._returns = t >= self._until - self._dt / 2
            self._left = self._target = snapshot.wanted[POSE]
            return
        share = rise(np.array([(t - self._until) / self._period]))[0]
        self._target = self._left + share * (self.experiment.start[POSE] - self._left)
        if self._lacking is None:
            if self._whole:
                self._judge(snapshot)
            return
        more = list(islice(self._lacking, _EACH))
        self._found += more
        if not more and self._rests(snapshot):
            self._begin(t)

    def repetitions(self, run: SimulationResult) -> list[Repetition]:
        """Return the end of each repetition's motion as a separate run."""
        found = list[Repetition]()
        for tried, end, error in zip(self.tried, self._ends, self.learning.errors, strict=False):
            begin = end - self._span
            part = run.signals.sel(time=slice(begin - self._dt / 2, end + self._dt / 2))
            signals = part.assign_coords(time=part.time - part.time[0])
            E_ac = accumulated_error(
                signals.time.values, signals.error.values, self.experiment.scale
            )
            result = replace(
                run,
                scenario=replace(run.scenario, duration=self._span),
                status="completed",
                stopped=None,
                signals=signals,
                summary=run.summary | {"accumulated_error": E_ac},
            )
            found.append(Repetition(tried if found else None, result, error))
        return found

    def _end_of_motion(self, t: float) -> float:
        """Return the end, in s, of a motion from t s on: where it is slowest, for a gentle stop."""
        least = t + self._span
        return least + (self._slowest - least) % self._period

    def _judge(self, snapshot: Snapshot) -> None:
        """Take the error of the last period, unless too much of it was not measured."""
        measured = list(self._measured())
        if not self._arrivals.suffice(len(self.learning.errors) + 1, len(measured)):
            self.done, self._lacking = self._arrivals.failed, iter(())
            return
        times = np.array([time for time, _ in self._rows])
        errors = np.array([row["pose"] - row["reference"] for _, row in self._rows])
        error = accumulated_error(times, errors, self.experiment.scale)
        self.learning.errors.append(error)
        self._ends.append(self._until)
        k = len(self.learning.errors)
        self._say(f"repetition {k}: E of one period is {error:.3g} % s")
        self.done = k == self._number or self.learning.ended
        self._lacking = self._lacking_torques(measured, snapshot.estimates)

    def _measured(self) -> Iterator[_Step]:
        """Yield the controller's periods with a measurement at both ends."""
        measures = self.experiment.scenario.sensor.measures_state
        state = "measurement" if measures else "state_estimate"
        for (time, row), (_, after) in pairwise(self._rows):
            states = np.array([row[state], after[state]])
            if np.all(np.isfinite(states)):
                acted = np.array([row["torque_applied"], after["torque_applied"]])
                yield _Step(time, states, acted)

    def _lacking_torques(
        self, measured: Iterable[_Step], last: Mapping[str, float]
    ) -> Iterator[tuple[float, Array]]:
        """Yield the middles of periods, s, and the torques (6,) that the model lacks there."""
        parameters = np.array([row["parameters"] for _, row in self._rows])
        dynamics = estimated(self.experiment, parameters, last)
        timeline = Timeline(self._dt, self.experiment.scenario.true_delay)
        for time, (begin, end), acted in measured:
            schedule = timeline.next_periods(acted)
            yield time + self._dt / 2, lacking_torque(dynamics, begin, end, schedule)

    def _rests(self, snapshot: Snapshot) -> bool:
        """Return whether the plate rests at the start, or as near to it as a limit permits."""
        wanted = snapshot.wanted
        away = np.abs(wanted[POSE] - self.experiment.start[POSE]) / self._size
        there = away.max() <= START_ERROR or snapshot.limit is not None
        return bool(there and np.all(np.abs(wanted[RATES]) <= REST_RATE * self._size))

    def _begin(self, t: float) -> None:
        """Begin the next repetition, with torques fitted to those that the last one lacked."""
        self._before = self.tried[-1]
        if self._found:  # else the last one is done again
            times, lacking = (np.array(column) for column in zip(*self._found, strict=True))
            self.tried.append(self.learning.learned(times, lacking))
        self._until, self._asked, self._returns = self._end_of_motion(t), t, False
        self._share = 0.0
        self._whole, self._lacking, self._found = False, None, []
        self._rows.clear()

    def _end(self, reason: str) -> None:
        self._say(f"repetition {len(self.learning.errors) + 1}: {reason}; learning ends")
        self.done = True


# ---------------------------------------------------------------- setpoints


def _learn_setpoints(asked: _Asked) -> LiveLessons:
    scenario, say = asked.scenario, asked.say
    learned: LearnedSignal | None = None
    lessons, dt = Lessons(scenario), scenario.controller.period
    last = lessons.period * math.ceil(_LEARNED_FROM / lessons.period)
    duration = dt * math.ceil((_SETTLING + last) / dt + 1)
    done, own = list[Repetition](), knowing(prepare(scenario))
    arrivals = _Arrivals(lessons.least, say)
    while (k := len(done) + 1) <= asked.options.learn:
        ready = asked.call(always(learned), duration, plan=not done)
        result = asked.drive(ready, duration)
        if result.status != "completed":
            say(f"repetition {k}: {End(result.status, result.stopped).words}; learning ends")
            break
        times, missed = lacking_angles(ready.design.experiment, result, last)
        if not arrivals.suffice(k, len(times)):
            if arrivals.failed:
                break
            continue
        lessons.errors.append(float(np.sqrt(np.mean(missed**2))))  # rad
        done.append(Repetition(learned, result, float(np.degrees(lessons.errors[-1]))))
        say(f"repetition {k}: the cranks lack {np.degrees(lessons.errors[-1]):.3f} degrees rms")
        best = lessons.best
        if best == k - 1 and learned is not None:  # at once, so that Ctrl-C loses nothing
            save_learned(asked.file, learned, own)
        if lessons.ended:
            break
        learned = lessons.learned(times, missed)
    if not done:
        return LiveLessons(result, None)
    return LiveLessons(done[lessons.best].result, asked.end(lessons, own, done))
