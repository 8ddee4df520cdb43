"""The closed loop without Drake, for many runs: the exact plant of core/plant.c behind the same
delay chain, limit, bias and noise, seen and judged at the same instants (theory.md, section 32).
"""

import ctypes
import math
from collections.abc import Callable
from typing import Any, Final, NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from stewart_drake.core.law_layout import CAUSES, address
from stewart_drake.core.plant import Controller, Ended, LoopStruct
from stewart_drake.dynamics.native_plant import NativePlant
from stewart_drake.dynamics.open_loop import IntegrationError
from stewart_drake.dynamics.workspace import Failure, diagnose
from stewart_drake.law.memory import Counts
from stewart_drake.law.native_law import configuration
from stewart_drake.law.predictive_lqi import PredictiveLqi
from stewart_drake.loop.experiment import Experiment, torques_in_flight, true_dynamics
from stewart_drake.loop.sensor import white_noises
from stewart_drake.scenario.config import Scenario
from stewart_drake.scenario.dependencies import Accepted, differing
from stewart_drake.scenario.link import releases, torque_delays
from stewart_drake.scenario.signals import NUM_STATE, NUM_TORQUES, POSE
from stewart_drake.scenario.timing import event_time, instants, look_time
from stewart_drake.types import Array

SHARE: Final = 0.1
"""Of the scenario's accuracy, for a step: those of order 8 are long, and a digit costs a sixth."""
LONGEST_STEP: Final = math.inf
"""s; the plate is looked at every 20 ms whatever the steps are."""


class Instants(NamedTuple):
    """When a run is looked at and sampled, as Drake's simulator does.

    Attributes:
        nominal: (n,) s, of the looks.
        looks: (n,) s, when they take place.
        on_grid: (n,) which are the metric's.
        sampled: (n,) which are the controller's.
        samples: (k,) s, when the controller takes its samples.
    """

    nominal: Array
    looks: Array
    on_grid: NDArray[np.bool_]
    sampled: NDArray[np.bool_]
    samples: Array


def instants_of(duration: float, period: float) -> Instants:
    """Those of a run of so many s with a controller of such a period, s."""
    all_of_them = list(instants(duration, period, None))
    nominal = np.array([one.time for one in all_of_them])
    early = event_time(period)
    number = int(duration / period) + 2
    samples = np.concatenate([[0.0], early + early * np.arange(number)])
    return Instants(
        nominal=nominal,
        looks=look_time(1.0) * nominal,
        on_grid=np.array([one.on_grid for one in all_of_them]),
        sampled=np.array([one.sampled for one in all_of_them]),
        samples=samples[samples <= look_time(duration)],
    )


class Course(NamedTuple):
    """What a loop did until its end.

    Attributes:
        states: (n, 12) at the looks that it came to.
        measured: (k, 12) at the samples.
        asked: (k, 6) torques in N m that the law asked for there.
        sent: (k, 6) what the limit let through.
        end: s.
        stopped: why it came no further, or None.
    """

    states: Array
    measured: Array
    asked: Array
    sent: Array
    end: float
    stopped: Failure | None


class Law(Protocol):
    """What gives a loop its torques."""

    def run(self, plant: NativePlant, loop: LoopStruct) -> Ended:
        """Take the plant to its end."""


class InPython:
    """A law that C calls at every sample.

    Args:
        torque: (sample, measurement (12)) -> (6,) N m.
    """

    def __init__(self, torque: Callable[[int, Array], Array]) -> None:
        self._torque = torque

    def run(self, plant: NativePlant, loop: LoopStruct) -> Ended:
        """Raises whatever the law does."""
        raised: list[BaseException] = []

        def step(_: object, sample: int, measurement: Any, torque: Any) -> int:
            try:
                asked = self._torque(sample, np.array(measurement[:NUM_STATE]))
                for i in range(NUM_TORQUES):
                    torque[i] = asked[i]
            except BaseException as error:  # which cannot pass through C; it goes on below
                raised.append(error)
                return 1
            return 0

        ended = plant.call("closed_loop", ctypes.byref(loop), Controller(step), None)
        if raised:
            raise raised[0]
        return ended


class InC:
    """The law of core/law.c.

    Args:
        law: one of which nothing is `law.native_law.uncovered`.
        queue: (L, 6) torques in flight at t = 0, as it believes, N m.
        previews: (k, p, 18) the motion that it follows, for each sample.
        weights: (2,) w_Q and w_R.

    Attributes:
        counts: what went wrong and was survived, once it has run.
    """

    def __init__(self, law: PredictiveLqi, queue: Array, previews: Array, weights: Array) -> None:
        given = [np.ascontiguousarray(a, np.float64) for a in (queue, previews, weights)]
        self._given = [configuration(law), *given]
        self._counts = np.zeros(len(CAUSES), dtype=np.intc)

    def run(self, plant: NativePlant, loop: LoopStruct) -> Ended:
        """See `Law`."""
        places = [ctypes.c_void_p(address(a)) for a in (*self._given, self._counts)]
        return plant.call("closed_loop_of_law", ctypes.byref(loop), *places)

    @property
    def counts(self) -> Counts:
        """By cause."""
        return Counts(**dict(zip(CAUSES, self._counts.tolist(), strict=True)))


COVERED: Final[Accepted] = {
    "plant.kind": "exact",
    "link.kind": "wire",
    "actuator.kind": "torque",
    "sensor.kind": "state",
    "sensor.faults": [],
    "sensor.delay": 0,
    "sensor.loss": 0,
}
"""Values of fields that the loop in C has."""


def uncovered(scenario: Scenario) -> str | None:
    """Return the field of a scenario for which only Drake's loop will do, or None."""
    found = differing(scenario, COVERED)
    return found and found.field


class Wire(NamedTuple):
    """What a run's torques wait for.

    Attributes:
        applied: (6,) N m, what acts at first.
        waiting: (b, 6) N m, sent before the start and still to act.
        released: (n,) s, ascending, when another torque begins to act.
        which: (n,) its place among those that wait and, after them, the run's own.
    """

    applied: Array
    waiting: Array
    released: Array
    which: NDArray[np.int_]


def wire_of(experiment: Experiment, when: Instants) -> Wire:
    """The delay chain of an experiment, as `loop.delay_chain` and `loop.varying_delay` are."""
    sc, delay, number = experiment.scenario, experiment.scenario.true_delay, len(when.samples)
    period, queue = sc.controller.period, torques_in_flight(experiment, delay)
    nothing = np.zeros(NUM_TORQUES)
    if sc.delay.constant:
        released = when.samples
        if delay.fraction > 0:
            first = event_time(delay.fraction * period)
            released = first + event_time(period) * np.arange(number, dtype=np.float64)
        waiting, applied = queue[len(queue) - delay.steps :], queue[0] if len(queue) else nothing
        return Wire(applied, waiting, released, np.arange(number))
    numbers, arrivals = releases(period, torque_delays(sc), delay)
    ours = numbers < number
    numbers, arrivals = numbers[ours], arrivals[ours]
    begun = (arrivals <= 0) & (numbers < 0)
    which = numbers + len(queue)
    applied = queue[which[begun][-1]] if begun.any() else nothing
    at_once = arrivals == period * numbers
    at_samples = when.samples[np.maximum(numbers, 0)]
    acts = np.where(at_once, at_samples, event_time(1.0) * arrivals)
    return Wire(applied, queue, acts[~begun], which[~begun])


def run_loop(experiment: Experiment, when: Instants, law: Law) -> Course:
    """Run an experiment to its end.

    Args:
        experiment: what to run; nothing of its scenario is `uncovered`.
        when: `instants_of` its duration and period.
        law: of the torques.

    Raises:
        IntegrationError: the accuracy cannot be had.
        Whatever the law raises.
    """
    sc, sensor = experiment.scenario, experiment.scenario.sensor
    assert sensor.kind == "state"
    noise = np.array(sensor.noise_std)
    truth = true_dynamics(experiment, biased=False)
    accuracy = SHARE * sc.plant.accuracy
    plant = NativePlant(truth, experiment.start, when.looks, accuracy, LONGEST_STEP)
    number = len(when.samples)
    wire = wire_of(experiment, when)
    before = len(wire.waiting)
    waiting = np.vstack([wire.waiting, np.zeros((number, NUM_TORQUES))])
    measured, asked = np.empty((number, NUM_STATE)), np.empty((number, NUM_TORQUES))
    drawn = None
    if noise.any():
        drawn = noise * white_noises(sensor.seed, number)
    loop = LoopStruct(
        samples=number,
        before=before,
        sampled=when.samples.ctypes.data,
        releases=len(wire.released),
        released=wire.released.ctypes.data,
        which=wire.which.ctypes.data,
        noise=None if drawn is None else drawn.ctypes.data,
        waiting=waiting.ctypes.data,
        applied=tuple(wire.applied),
        bias=tuple(sc.plant.torque_bias),
        limit=experiment.torque_limit,
        measured=measured.ctypes.data,
        asked=asked.ctypes.data,
    )
    ended = law.run(plant, loop)
    if ended == Ended.TOO_SHORT_STEPS:
        raise IntegrationError(f"no step is short enough at t = {plant.time:.6g} s")
    stopped = None
    if ended == Ended.LEFT:
        stopped = diagnose(experiment.truth, plant.time, plant.final[POSE])
    taken = loop.taken
    sent = waiting[before : before + taken]
    return Course(
        plant.states[: plant.seen], measured[:taken], asked[:taken], sent, plant.time, stopped
    )
