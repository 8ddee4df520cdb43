"""The parts of the control law, each alone, and parts of a user."""

from dataclasses import dataclass, fields, replace

import numpy as np
import pytest

import stewart_drake as sd
from stewart_drake.core.library import core
from stewart_drake.dynamics.stewart import StewartDynamics
from stewart_drake.law.belief import Belief
from stewart_drake.law.feedforward import (
    EquilibriumFeedforward,
    InverseDynamicsFeedforward,
    NoFeedforward,
    held_torques,
    means_and_changes,
)
from stewart_drake.law.motion import Preview
from stewart_drake.law.nominal import (
    FINE_SUBSTEP_FACTOR,
    MultibodyModel,
    NominalPlant,
    PaperModel,
    TorqueLimit,
)
from stewart_drake.law.observers import CoreObserver
from stewart_drake.law.sensing import FirstState, Measurement, StateSensing
from stewart_drake.law.timeline import Timeline
from stewart_drake.mechanism.kinematics import UnreachablePoseError
from stewart_drake.scenario.signals import ACCELERATIONS, NUM_STATE
from stewart_drake.scenario.timing import Delay
from stewart_drake.types import Array
from tests.mechanisms import PAPER
from tests.oracles import relative
from tests.test_control_law import HOME, WEIGHTS, Loop, law_of, nominal_queue, sine

HEAVY = StewartDynamics(PAPER, gravity=True)
PLANT = NominalPlant(HEAVY, 2, 0.5, TorqueLimit(2.0))
ZERO = np.zeros(8)


# Time.


@pytest.mark.parametrize("fraction", [0.0, 0.3])
@pytest.mark.parametrize("steps", [0, 1, 4])
def test_what_acts_when_is_what_the_delay_says(steps, fraction):
    """Looked up at instants: T_k acts during [k dt + eta, (k + 1) dt + eta)."""
    dt, timeline = 0.1, Timeline(0.1, Delay(steps, fraction))
    count = timeline.queue_length + 1
    in_flight = np.arange(1.0, count + 1)[:, None] * np.ones(6)
    # The newest was computed at -dt, the sample is now at 0.
    computed = dt * np.arange(-count, 0)

    def at(t):
        (found,) = [
            torque[0]
            for torque, begin in zip(in_flight, computed + timeline.eta, strict=True)
            if begin - 1e-9 <= t < begin + dt - 1e-9
        ]
        return float(found)

    # One torque more than fly covers the last period too.
    begin = -dt
    torques, durations = timeline.schedule(in_flight)
    assert len(torques) == len(durations)
    for torque, duration in zip(torques, durations, strict=True):
        for share in (0.01, 0.5, 0.99):
            assert at(begin + share * duration) == torque[0]
        begin += duration
    assert begin == pytest.approx(steps * dt, abs=1e-12)  # where the next torque is not needed yet
    (acted, for_so_long), following = timeline.last_period(in_flight)
    assert for_so_long.sum() == pytest.approx(dt)
    assert [at(-0.99 * dt), at(-0.01 * dt)] == [acted[0, 0], acted[-1, 0]]
    if steps or fraction:
        assert following[0] == at(0.01 * dt)
    assert np.array_equal(timeline.queue(in_flight), in_flight[1:])
    assert np.allclose(timeline.samples, dt * np.arange(1, steps + 1))
    assert timeline.holds(-1, 1) == pytest.approx(timeline.eta + dt * np.array([-1, 0, 1]))


def test_older_torques_than_the_delay_needs_change_nothing():
    timeline, rng = Timeline(0.1, Delay(2, 0.4)), np.random.default_rng(0)
    many = rng.normal(0, 1, (9, 6))
    assert np.array_equal(timeline.queue(many), many[-3:])
    one, other = timeline.last_period(many), timeline.last_period(many[-4:])
    assert np.array_equal(one[0].torques, other[0].torques)
    assert np.array_equal(one[0].durations, other[0].durations)
    assert np.array_equal(one[1], other[1])


# The plant as it is known.


def test_strong_torques_are_integrated_in_finer_steps():
    for size, steps in ((0.5, 2), (0.51, 2 * FINE_SUBSTEP_FACTOR)):
        torques = np.zeros((3, 6))
        torques[1, 4] = -size
        assert PLANT.substeps_for(torques) == steps
        expected = HEAVY.predict(HOME[:12], torques, np.full(3, 0.02), steps)
        found = PLANT.predict(HOME[:12], Timeline(0.02, Delay(3, 0.0)).schedule(torques))
        assert np.array_equal(found, expected)
    assert PLANT.substeps_for(np.zeros((0, 6))) == 2


# What is measured.


def test_a_measurement_marks_what_is_lost():
    values = np.array([1.0, np.nan, 3.0, np.inf])
    measurement = Measurement.of(values)
    assert np.array_equal(measurement.valid, [True, False, True, False])
    assert not measurement.complete and Measurement.of(np.ones(4)).complete
    assert np.array_equal(measurement.known(4), [1.0, np.nan, 3.0, np.nan], equal_nan=True)
    assert not measurement.missing().valid.any()
    values[0] = 5.0  # what it came from may be used again
    assert measurement.values[0] == 1.0


@pytest.mark.parametrize("estimate", ["[]", "[torque_bias,payload,damping]"])
def test_who_takes_values_for_those_of_now_refuses_old_ones(estimate):
    law = law_of(f"controller.estimate={estimate}", "delay.steps=0")
    old = Measurement.of(HOME[:12], age=0.1)
    memory = law.initial_memory(np.zeros((0, 6)))
    with pytest.raises(ValueError, match=r"got an age of 0\.1 s; expected 0"):
        law.step(memory, old, lambda times: np.tile(HOME, (len(times), 1)), WEIGHTS)


def test_a_loss_is_known_by_the_mask_alone():
    """A number in its place is not looked at."""
    law = law_of("controller.estimate=[]", "delay.steps=0")
    valid = np.ones(12, bool)
    valid[4] = False
    lost = Measurement(HOME[:12] + 1e-3 * np.eye(12)[4], valid)
    memory = law.initial_memory(np.zeros((0, 6)))

    def home(times):
        return np.tile(HOME, (len(times), 1))

    memory = law.step(memory, Measurement.of(HOME[:12]), home, WEIGHTS)
    memory = law.step(memory, lost, home, WEIGHTS)
    assert memory.counts.measurements_missing == 1
    assert np.abs(memory.belief.state - HOME[:12]).max() < 1e-12
    assert memory.belief.measured[4] == HOME[4]


@pytest.mark.parametrize(
    ("fault", "change"),
    [
        (None, {}),
        ("measurements_missing", {3: np.nan}),
        ("measurements_rejected", {1: 1.6}),
        ("measurements_rejected", {5: 1.0}),
        ("measurements_frozen", {6: 0.5}),  # moves on, but its pose does not
    ],
)
def test_each_fault_of_a_state_by_hand(fault, change):
    sensing = StateSensing(np.zeros(12), np.ones(6))
    last = HOME[:12]
    values = last.copy()
    for place, value in change.items():
        values[place] += value
    assert sensing.fault(Measurement.of(values), last, 0.1, PAPER) == fault
    noisy = replace(sensing, noise_std=np.full(12, 1e-3))
    if fault is None:  # noise never comes twice
        assert noisy.fault(Measurement.of(values), last, 0.1, PAPER) == "measurements_frozen"
    assert sensing.seen(values) is values and sensing.through(values, last) is last


@dataclass(frozen=True)
class Twice:
    """Pose and rates in other units, each measured by two sensors."""

    unit: Array
    std: Array

    @property
    def size(self):
        return 24

    @property
    def noise_std(self):
        return np.tile(np.sqrt(2) * self.std / self.unit, 2)

    def seen(self, state):
        return np.tile(state / self.unit, 2)

    def through(self, state, changes):
        scaled = (changes.T / self.unit).T
        return np.concatenate([scaled, scaled])

    def fault(self, measurement, last, period, mechanism):
        return None if measurement.complete else "measurements_missing"

    def start(self, measurement, near=None):
        state = self.unit * measurement.values.reshape(2, 12).mean(axis=0)
        return FirstState(state, np.diag(self.std**2))


def test_two_sensors_with_the_noise_of_two_are_one():
    """Another kind of sensing, other units, other size: the same estimates, the same torques."""
    law, reference, rng = law_of("delay.steps=2"), sine(0.5), np.random.default_rng(3)
    # The noise is learnt from single values, which are others here: it is given.
    given = replace(law.observer.settings, learns_timing=False, wander=0.0)
    law = replace(law, observer=replace(law.observer, settings=given))
    std = 1e-4 * np.repeat([0.3, 0.03, 0.3, 0.03], 3)
    single = replace(law, sensing=StateSensing(std, np.ones(6)))
    double = Twice(10.0 ** rng.integers(-2, 3, 12), std)
    noise = [std * rng.standard_normal(12) for _ in range(12)]
    away = [std * rng.standard_normal(12) for _ in range(12)]
    queue, truth = nominal_queue(law, reference), np.array([0.01] * 6 + [0.3, 1e-3])

    def both(k, x):
        if k == 7:
            return np.full(24, np.nan)
        two = [x + noise[k] + away[k], x + noise[k] - away[k]]
        return np.concatenate([double.seen(state)[:12] for state in two])

    one = Loop(single, reference, truth, queue)
    one.run(12, lambda k, x: np.full(12, np.nan) if k == 7 else x + noise[k])
    other = Loop(replace(law, sensing=double), reference, truth, queue).run(12, both)
    for a, b in zip(one.memories, other.memories, strict=True):
        deviation = (a.belief.estimate.mean - b.belief.estimate.mean) / np.sqrt(
            np.diag(a.belief.estimate.covariance)
        )
        assert np.abs(deviation).max() < 1e-5
        assert relative(b.belief.estimate.covariance, a.belief.estimate.covariance) < 1e-6
        assert np.abs(a.torque - b.torque).max() < 1e-6 * np.abs(a.torque).max()
        assert b.measurement.shape == b.belief.measured.shape == (24,)
        assert a.counts == b.counts
    assert other.memory.counts.measurements_missing == 1


# Feedforward, model, cost.


def nodes_of(feedforward, timeline):
    """Return the reference (n, 18) at the nodes of an asymmetric motion."""
    reference = sine(0.7)
    return np.array([reference(1.0 + t) for t in feedforward.nodes(timeline, 2)])


def test_nodes_are_those_of_the_holds_and_their_neighbours():
    timeline = Timeline(0.1, Delay(3, 0.5))
    nodes = NoFeedforward().nodes(timeline, 2).reshape(-1, 2)
    begins = timeline.eta + 0.1 * np.array([-3, -2, -1, 0, 1])
    assert nodes.mean(axis=1) == pytest.approx(begins + 0.05)
    assert np.ptp(nodes, axis=1) == pytest.approx(0.1 / np.sqrt(3))


def test_each_feedforward_holds_what_it_says():
    timeline = Timeline(0.1, Delay(3, 0.4))
    nodes = nodes_of(NoFeedforward(), timeline)
    still = nodes * np.repeat([1.0, 0.0, 0.0], 6)

    def by_hand(rows):
        torques = [HEAVY.inverse_dynamics(*np.split(row, 3), ZERO) for row in rows]
        return means_and_changes(np.reshape(torques, (-1, 2, 6)))

    nothing = NoFeedforward().held(nodes, HEAVY, ZERO)
    assert nothing.torques.shape == (3, 6) and nothing.changes.shape == (5, 6)
    assert not nothing.torques.any() and not nothing.changes.any()
    equilibrium = EquilibriumFeedforward().held(nodes, HEAVY, ZERO)
    assert np.array_equal(equilibrium.torques, by_hand(still)[0][1:-1])
    moving = InverseDynamicsFeedforward().held(nodes, HEAVY, ZERO)
    assert np.array_equal(moving.torques, held_torques(*by_hand(nodes)))
    assert np.abs(moving.torques - equilibrium.torques).max() > 1e-3
    at_rest = InverseDynamicsFeedforward().held(np.tile(still[:1], (10, 1)), HEAVY, ZERO)
    assert at_rest.torques == pytest.approx(
        np.tile(HEAVY.equilibrium_torque(still[0, :6]), (3, 1)), abs=1e-12
    )
    B = np.diag(np.arange(1.0, 7))
    for kind in (NoFeedforward(), EquilibriumFeedforward()):
        assert not kind.offset(moving.changes, B, timeline).any()
    assert InverseDynamicsFeedforward().offset(moving.changes, B, timeline).all()


def test_a_model_is_refused_where_the_plate_cannot_be():
    far = HOME[:12] + 0.3 * np.eye(12)[5]
    for kind in (PaperModel(), MultibodyModel()):
        with pytest.raises(UnreachablePoseError):
            kind.at(far, np.zeros(6), ZERO, PLANT)
        kind.at(HOME[:12], np.zeros(6), ZERO, PLANT)


# Memory.


def test_a_preview_of_other_instants_is_a_mistake():
    law = law_of("delay.steps=2")
    memory, times = law.initial_memory(np.zeros((2, 6))), law.preview_times
    for wrong in (times[:-1], times + 0.01):
        preview = Preview(wrong, np.tile(HOME, (len(wrong), 1)))
        with pytest.raises(ValueError, match=f"expected the {len(times)} that the law asks for"):
            law.step(memory, Measurement.of(HOME[:12]), preview, WEIGHTS)


# Parts of one's own.


@dataclass(frozen=True)
class Blend:
    """A fourth observer: the model, corrected by a share of the innovation."""

    share: float

    def start(self, timeline, sensing, plant):
        return Belief.nothing(timeline, sensing.size, plant.dynamics.parameters)

    def observe(self, belief, measurement, in_flight, sensing, plant):
        if not belief.has_state:
            return belief.at(measurement.values) if measurement.complete else belief
        schedule, _ = belief.timeline.last_period(in_flight)
        x = plant.predict(belief.state, schedule)[-1]
        beside = np.where(measurement.valid, measurement.values - x, 0.0)
        return belief.at(x + self.share * beside)


def test_a_fourth_observer_needs_no_change_of_the_package():
    """It smooths noise, goes on where values are lost, and holds the plate on the reference."""
    law, reference, rng = law_of("delay.steps=2"), sine(0.5), np.random.default_rng(0)
    noise = 1e-4 * rng.standard_normal((40, 12))

    def seen(k, x):
        lost = k in (0, 9) or (k == 20) & (np.arange(12) < 3)
        return np.where(lost, np.nan, x + noise[k])

    errors = {}
    for observer in (Blend(0.2), CoreObserver()):
        mine = replace(law, observer=observer)
        loop = Loop(mine, reference, queue=nominal_queue(law, reference)).run(40, seen)
        believed = np.array([memory.belief.state for memory in loop.memories])
        errors[observer] = np.std(believed[10:] - loop.states[10:-1])
        assert np.abs(loop.states[-1][:6] - reference(4.0)[:6]).max() < 2e-3
    assert errors[Blend(0.2)] < 0.5 * errors[CoreObserver()]


@dataclass(frozen=True)
class Told(CoreObserver):
    """An observer that begins with the assumed delay and learns another one at the first sample."""

    other: Timeline | None = None

    def observe(self, belief, *rest):
        return super().observe(replace(belief, timeline=self.other), *rest)


@pytest.mark.parametrize("assumed", [0, 1, 4])
@pytest.mark.parametrize("prediction", ["linear", "nonlinear"])
def test_the_law_believes_in_the_delay_that_its_observer_believes_in(prediction, assumed):
    """The law equals the one that knew the delay, with torques kept for the longest delay."""
    known = law_of("delay.steps=2", "controller.estimate=[]", f"controller.prediction={prediction}")
    reference = sine(0.5)
    queue = nominal_queue(known, reference)
    expected = Loop(known, reference, queue=queue).run(8)
    law = replace(
        known,
        timeline=replace(known.timeline, delay=Delay(assumed)),
        observer=Told(other=known.timeline),
    )
    loop = Loop(known, reference, queue=queue)
    loop.law = law
    loop.memory = law.initial_memory(np.vstack([np.ones((4, 6)), queue]))
    loop.run(8)
    for one, other in zip(loop.memories, expected.memories, strict=True):
        assert np.array_equal(one.torque, other.torque)
        assert np.array_equal(one.integral, other.integral)


@dataclass(frozen=True)
class Later(Told):
    """The same, at the second sample."""

    def observe(self, belief, *rest):
        if belief.has_state:
            return super().observe(belief, *rest)
        return CoreObserver.observe(self, belief, *rest)


@pytest.mark.parametrize(("prediction", "kept"), [("linear", False), ("nonlinear", True)])
def test_a_gain_for_another_delay_is_used_only_where_it_fits(prediction, kept):
    """The Riccati equation fails at the very sample at which another delay is believed in."""
    known = law_of("delay.steps=2", "controller.estimate=[]", f"controller.prediction={prediction}")
    timeline = replace(known.timeline, delay=Delay(3))
    observer = Later(other=known.timeline)
    law = replace(known, timeline=timeline, observer=observer)
    away = HOME[:12] + 1e-3

    def home(times):
        return np.tile(HOME, (len(times), 1))

    memory = law.step(law.initial_memory(np.zeros((3, 6))), Measurement.of(away), home, WEIGHTS)
    after = law.step(memory, Measurement.of(away + 1e-4), home, np.array([np.nan, 1.0]))
    assert after.counts.riccati_failures == 1
    assert np.any(np.abs(after.torque) > 1e-6) == kept  # else the feedforward alone, none at home
    good = law.step(after, Measurement.of(away), home, WEIGHTS)
    assert np.isfinite(good.gain).all() and np.abs(good.torque).max() > 1e-6


def test_a_delay_longer_than_what_is_kept_is_refused():
    known = law_of("delay.steps=2", "controller.estimate=[]")
    law = replace(known, observer=Told(other=replace(known.timeline, delay=Delay(3))))
    with pytest.raises(ValueError, match="2 torques are kept in flight; expected at least the 3"):
        Loop(law, lambda t: HOME).run(1)


class ReturnPath:
    """A `stewart_blend`."""

    def __init__(self, way):
        self._way = way
        self.offset, self.holds, self.samples = np.array(list(way.offset)), way.holds, way.samples

    @property
    def active(self):
        return self.holds + self.samples > 0

    def after(self, h):
        way = core().ffi.new("stewart_blend *", self._way[0])
        core().lib.stewart_advance_blend(way, h)
        return ReturnPath(way)

    def at(self, time, h):
        row = np.zeros(18)
        core().lib.stewart_add_offset(self._way[0], h, time, core().at(row))
        return row


def path(period, seed=1):
    offset = np.random.default_rng(seed).normal(0, 1, NUM_STATE)
    way = core().ffi.new("stewart_blend *")
    core().lib.stewart_begin_blend(core().at(offset), period, 8, way)
    return ReturnPath(way)


@pytest.mark.parametrize(("period", "holds"), [(0.1, 3), (0.02, 15), (0.15, 2), (0.5, 2)])
def test_it_ends_at_rest_relative_to_the_reference(period, holds):
    """After the time of a catch-up, or two holds."""
    back, size = path(period), np.abs(path(period).offset).max()
    n = back.holds
    assert n == holds
    assert np.abs(back.at(n * period, period)[:NUM_STATE]).max() < 1e-12 * size / period
    assert not np.any(back.at((n + 0.01) * period, period))
    for _ in range(n + back.samples):
        assert back.active
        back = back.after(period)
    assert not back.active


@pytest.mark.parametrize("period", [0.02, 0.1])
def test_its_accelerations_are_the_least(period):
    """The solution of least norm of the 2 equations per coordinate, by lstsq."""
    back, h = path(period), period
    n = back.holds
    A = np.array([h * h * (n - np.arange(n) - 0.5), np.full(n, h)])
    pose, rates = back.offset[:6], back.offset[6:]
    least = np.linalg.lstsq(A, -np.array([pose + n * h * rates, rates]))[0]
    found = [back.at((i + 0.5) * h, h)[ACCELERATIONS] for i in range(n)]
    assert np.allclose(found, least, rtol=1e-9)


def test_the_rest_of_a_path_is_the_same_path():
    back, h = path(0.1), 0.1
    for time in (0.0, 0.03, 0.1, 0.17):
        assert np.allclose(back.after(h).at(time, h)[:12], back.at(time + h, h)[:12], atol=1e-12)


class Weak(TorqueLimit):
    """Motors with half of the limit at the last one."""

    def saturate(self, torques):
        limit = self.limit * np.array([1, 1, 1, 1, 1, 0.5])
        return np.clip(torques, -limit, limit)

    def reached(self, torques):
        return bool(np.any(self.saturate(torques) != torques))


class CountingPlant(NominalPlant):
    """A plant that keeps the numbers of torques that it predicts with."""

    calls: list[int] = []

    def predict(self, state, schedule, parameters=None):
        self.calls.append(len(schedule.torques))
        return super().predict(state, schedule, parameters)


def test_motors_and_a_plant_of_your_own_are_those_of_the_law():
    law = law_of("delay.steps=2", "controller.estimate=[]", limit=0.003)
    reference = sine(0.5)
    plant = CountingPlant(
        law.plant.dynamics, law.plant.substeps, law.plant.coarse_torque_limit, Weak(0.003)
    )
    loop = Loop(replace(law, plant=plant), reference, queue=np.zeros((2, 6))).run(8)
    asked = np.array([memory.torque for memory in loop.memories])
    sent = np.array([memory.in_flight[-1] for memory in loop.memories])
    assert np.array_equal(sent, plant.motors.saturate(asked)) and np.abs(sent[:, 5]).max() == 0.0015
    assert 2 in plant.calls
    same = replace(
        law, plant=CountingPlant(*(getattr(law.plant, n) for n in law.plant.__dataclass_fields__))
    )
    loops = [Loop(one, reference, queue=np.zeros((2, 6))).run(8) for one in (law, same)]
    assert loops[0].memory.torque == pytest.approx(loops[1].memory.torque, abs=1e-12)


class Mine:
    """A part of a user's own that does what a shipped one does."""

    def __init__(self, part):
        self._part = part

    def __getattr__(self, name):
        return getattr(self._part, name)


def run_with(part=None, wrap=Mine):
    """Return a run whose part of the law is wrapped."""

    def modified(law):
        return law if part is None else replace(law, **{part: wrap(getattr(law, part))})

    settings = ("plant.kind=exact", "duration=3", "start=on_reference", "queue=reference")
    scenario = sd.load_scenario("paper", "adaptive_lqi", (*settings, "controller.delay_steps=7"))
    return sd.simulate(scenario, modify_law=modified, judge_stability=False)


class Derived(CoreObserver):
    """An observer in Python: of another class than the core's."""


def derived(observer):
    return Derived(**{one.name: getattr(observer, one.name) for one in fields(CoreObserver)})


@pytest.mark.parametrize(("part", "wrap"), [("predictor", Mine), ("observer", derived)])
def test_a_wrapped_part_of_the_adaptive_law_changes_nothing(part, wrap):
    """It also plans again as before."""
    torques, found = (
        run.signals.torque_commanded.values for run in (run_with(), run_with(part, wrap))
    )
    assert np.abs(found - torques).max() < 1e-9 * np.abs(torques).max()


def test_an_observer_that_does_not_find_the_delay_needs_another_predictor():
    with pytest.raises(ValueError, match="observer: got Mine with a predictor for a delay"):
        run_with("observer")
