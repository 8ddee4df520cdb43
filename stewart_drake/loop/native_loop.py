"""The closed loop without Drake, for many runs: the exact plant of core/plant.c behind the same
delay chain, limit, bias and noise, seen and judged at the same instants (theory.md, section 32).
"""

import math
from collections.abc import Callable
from typing import Any, Final, NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from stewart_drake.core.library import core
from stewart_drake.core.link import Link
from stewart_drake.dynamics.native_plant import Ended, NativePlant
from stewart_drake.dynamics.open_loop import IntegrationError
from stewart_drake.dynamics.workspace import Failure, diagnose
from stewart_drake.law.compiled import Compiled
from stewart_drake.law.core_law import CompiledLaw, CoreMemory
from stewart_drake.law.predictive_lqi import PredictiveLqi
from stewart_drake.loop.preparation import Experiment
from stewart_drake.loop.sensor import white_noises
from stewart_drake.scenario.config import Scenario
from stewart_drake.scenario.dependencies import Accepted, differing
from stewart_drake.scenario.link import SIMULTANEOUS, torque_delays
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

    def run(self, plant: NativePlant, loop: Any) -> Ended:
        """Take the plant to its end."""


class InPython:
    """A law that C calls at every sample.

    Args:
        torque: (sample, measurement (12)) -> (6,) N m.
    """

    def __init__(self, torque: Callable[[int, Array], Array]) -> None:
        self._torque = torque

    def run(self, plant: NativePlant, loop: Any) -> Ended:
        """Raises whatever the law does."""
        raised: list[BaseException] = []

        def step(_: object, sample: int, measurement: Any, torque: Any) -> int:
            try:
                asked = self._torque(sample, np.array(list(measurement[0:NUM_STATE])))
                torque[0:NUM_TORQUES] = list(asked)
            except BaseException as error:  # which cannot pass through C; it goes on below
                raised.append(error)
                return 1
            return 0

        ffi = core().ffi
        called = ffi.callback("stewart_controller", step)
        ended = plant.call("closed_loop", loop, called, ffi.NULL)
        if raised:
            raise raised[0]
        return ended


class InC:
    """The law of core/law.c, and the tuner of core/tuner.c, without Python in between.

    Args:
        law: one of which nothing is `law.core_law.uncovered`.
        queue: (L, 6) torques in flight at t = 0, as it believes, N m.
        previews: (k, p, 18) the motion that it follows, for each sample.
        weights: (2,) w_Q and w_R, without a tuner.
        tuner: of `tuner.compiled`, or None.
        wanted: (k, 18) the reference at each sample, for a tuner.

    Attributes:
        weights: (k, 2) of each sample, once it has run.
        rows: (k, n) what a tuner's features keep of each, as of `Ending`.
    """

    def __init__(
        self,
        law: PredictiveLqi,
        queue: Array,
        previews: Array,
        weights: Array,
        tuner: Compiled | None = None,
        wanted: Array | None = None,
    ) -> None:
        self._compiled, self._tuner, c = CompiledLaw(law), tuner, core()
        self._memory = self._compiled.start(queue)
        self._previews = np.ascontiguousarray(previews, np.float64)
        self.weights, self.rows = np.tile(weights, (len(previews), 1)), np.empty((len(previews), 0))
        self._scratch, self._tuned = np.empty(self._compiled.scratch), np.empty(0)
        self._wanted = np.empty((0, NUM_STATE))
        if tuner is not None and wanted is not None:
            self._wanted = np.ascontiguousarray(wanted[:, :NUM_STATE])
            self._tuned = np.empty(c.lib.stewart_tuner_memory(tuner.it))
            c.lib.stewart_tuner_start(tuner.it, c.at(self._tuned))
            columns = c.lib.stewart_newest_row(
                tuner.it, c.at(self._tuned), c.at(self._tuned.copy())
            )
            self.rows = np.empty((len(previews), columns))
            self._scratch = np.empty(c.lib.stewart_tuned_step_scratch(self._compiled.data))

    def run(self, plant: NativePlant, loop: Any) -> Ended:
        """See `Law`."""
        c = core()
        law = c.ffi.new(
            "stewart_law_in_loop *",
            {
                "law": self._compiled.data,
                "tuner": c.ffi.NULL if self._tuner is None else self._tuner.it,
                "memory": c.at(self._memory),
                "tuner_memory": c.at(self._tuned),
                "scratch": c.at(self._scratch),
                "previews": c.at(self._previews),
                "wanted": c.at(self._wanted),
                "weights": c.at(self.weights),
                "kept": c.at(self.rows),
                "rows": self._previews.shape[1],
                "columns": self.rows.shape[1],
            },
        )
        return plant.call("closed_loop_of_law", loop, law)

    @property
    def counts(self) -> dict[str, int]:
        """What went wrong and was survived, by cause, once it has run."""
        fallbacks = int(self._tuned[2]) if len(self._tuned) else 0
        counts = CoreMemory(self._memory, self._compiled).counts
        return counts.summary() | {"tuner_fallbacks": fallbacks}


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


def _wire_of(experiment: Experiment, number: int) -> tuple[Link, Array, Array]:
    """Return the link of an experiment, its memory at t = 0, and the delays (number,) in s."""
    sc, delay = experiment.scenario, experiment.scenario.true_delay
    period, queue = sc.controller.period, experiment.torques_in_flight(delay)
    delays = np.full(number, delay.eta(period))
    if not sc.delay.constant:
        drawn = torque_delays(sc)
        delays = drawn[np.minimum(np.arange(number), len(drawn) - 1)]
    kept = len(queue) + int(delays.max(initial=0.0) / period) + 2
    together, limit = SIMULTANEOUS * period, experiment.torque_limit
    link = Link(NUM_TORQUES, kept, period, wire=True, together=together, limit=limit)
    memory, first = link.start(), (delay.periods - len(queue)) * period
    if len(queue):
        link.assume(memory, first, queue[0])
        link.begin(memory, first, queue)
    return link, memory, delays


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
    truth = experiment.true_dynamics(biased=False)
    accuracy = SHARE * sc.plant.accuracy
    plant = NativePlant(truth, experiment.start, when.looks, accuracy, LONGEST_STEP)
    number = len(when.samples)
    link, memory, delays = _wire_of(experiment, number)
    measured, asked = np.empty((number, NUM_STATE)), np.empty((number, NUM_TORQUES))
    drawn = None
    if noise.any():
        drawn = noise * white_noises(sensor.seed, number)
    c = core()
    loop = c.ffi.new(
        "stewart_loop *",
        {
            "samples": number,
            "sampled": c.at(when.samples),
            "period": sc.controller.period,
            "delays": c.at(delays),
            "link": link.data,
            "memory": c.at(memory),
            "noise": c.at(drawn),
            "bias": list(sc.plant.torque_bias),
            "measured": c.at(measured),
            "asked": c.at(asked),
        },
    )
    ended = law.run(plant, loop)
    if ended == Ended.TOO_SHORT_STEPS:
        raise IntegrationError(f"no step is short enough at t = {plant.time:.6g} s")
    stopped = None
    if ended == Ended.LEFT:
        stopped = diagnose(experiment.truth, plant.time, plant.final[POSE])
    measured, asked = measured[: loop.taken], asked[: loop.taken]
    sent = np.clip(asked, -experiment.torque_limit, experiment.torque_limit)
    return Course(plant.states[: plant.seen], measured, asked, sent, plant.time, stopped)
