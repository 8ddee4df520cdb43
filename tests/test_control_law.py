"""`PredictiveLqi.step` without Drake: prediction, feedforward, saturation, and bad days."""

import dataclasses
import functools

import numpy as np
import pytest

from stewart_drake.law.cost import QuadraticCost
from stewart_drake.law.counts import Counts
from stewart_drake.law.delay_model import (
    delayed_model,
    double_integrators,
    linear_model,
)
from stewart_drake.law.feedforward import (
    GAUSS_NODES,
    InverseDynamicsFeedforward,
    held_torques,
    means_and_changes,
)
from stewart_drake.law.memory import Memory
from stewart_drake.law.motion import Preview
from stewart_drake.law.nominal import MultibodyModel, TorqueLimit
from stewart_drake.law.predictors import LinearPredictor, NonlinearPredictor
from stewart_drake.law.riccati import RiccatiError, full_gain
from stewart_drake.law.sensing import Measurement
from stewart_drake.law.startup import weight_scales
from stewart_drake.law.timeline import Timeline
from stewart_drake.loop.law_design import control_law
from stewart_drake.loop.preparation import prepare, prepare_unchecked
from stewart_drake.mechanism.assembly import torque_map
from stewart_drake.mechanism.trajectories import evaluate, make_reference
from stewart_drake.scenario.loading import load_scenario
from stewart_drake.scenario.timing import Delay
from tests.backends import Predicted
from tests.mechanisms import PAPER
from tests.oracles import relative

WEIGHTS = np.array([1.0, 1.0])
HOME = np.concatenate([PAPER.home, np.zeros(12)])
PLAIN = (
    "controller.estimate=[]",
    "controller.feedforward=none",
    "controller.weight_scaling=identity",
)
LINEAR = (*PLAIN, "controller.prediction=linear")


def law_of(*settings, controller=None, limit=None, **plant):
    """Return the law of the paper's scenario, started on the reference, with settings.

    `limit` is the motors', N m; `plant` changes what is believed of the plant.
    """
    law = _law(settings, controller)
    if limit is not None:
        plant |= {"motors": TorqueLimit(limit)}
    return dataclasses.replace(law, plant=dataclasses.replace(law.plant, **plant))


def step(law, memory, y, preview, weights=WEIGHTS):
    """One sample, from a measurement (12,), NaN where lost, and the reference (p, 18)."""
    return law.step(memory, Measurement.of(y), Preview(law.preview_times, preview), weights)


@functools.cache
def _law(settings, controller):
    usual = ["start=on_reference", "duration=2.0"]
    return control_law(prepare(load_scenario("paper", controller, [*usual, *settings])))[0]


def at_home(law):
    """Return a preview that asks to stay at home."""
    return np.tile(HOME, (len(law.preview_times), 1))


def sampled(law, **parts):
    """Return a memory after some sample, with random parts where none are given."""
    rng = np.random.default_rng(1)
    length = law.timeline.queue_length
    memory = law.initial_memory(np.zeros((length, 6)))
    some = {
        "state": HOME[:12],
        "in_flight": 0.1 * rng.normal(0, 1, (length + 1, 6)),
        "error": 1e-2 * rng.normal(0, 1, 6),
        "integral": 1e-2 * rng.normal(0, 1, 6) if law.cost.integrates else np.zeros(6),
    }
    return changed(memory, **some | parts)


def changed(memory, **fields):
    """Return a memory with other numbers in some fields; `state` is also the observer's.

    Of torques in flight the newest are others.
    """
    after = memory.copy()
    for name, value in fields.items():
        numbers = after.in_flight[-len(value) :] if name == "in_flight" else after.field(name)
        numbers[:] = value
    if "state" in fields:
        after.field("observer")[:12] = fields["state"]
    return after


class Loop:
    """A plant that is the model, with its own bookkeeping of who acts when.

    The torque of sample k acts from k + mu + fraction periods on, for one period.
    """

    def __init__(self, law, reference, truth=None, queue=None):
        self.law, self.reference = law, reference
        self.delay = law.timeline
        length = law.timeline.queue_length
        self.truth = np.zeros(8) if truth is None else truth
        zeros = np.zeros((length, 6))
        queue = zeros if queue is None else queue
        self.torques = {k - len(queue): torque for k, torque in enumerate(queue)}
        self.memory = law.initial_memory(queue)
        self.states = [reference(0.0)[:12]]
        self.memories: list[Memory] = []

    def acting(self, k):
        """Torques and durations in the period after sample k."""
        o, nothing = self.delay, np.zeros(6)
        newer = self.torques.get(k - o.steps, nothing)
        if o.fraction == 0:
            return newer[None], np.array([o.period])
        older = self.torques.get(k - o.steps - 1, nothing)
        return np.array([older, newer]), o.period * np.array([o.fraction, 1 - o.fraction])

    def run(self, samples, seen=lambda k, x: x):
        """Go on; `seen` makes the measurement of the state."""
        plant, period = self.law.plant, self.delay.period
        for _ in range(samples):
            k, x = len(self.memories), self.states[-1]
            now = k * period

            def motion(times, now=now):
                return np.array([self.reference(max(0.0, t)) for t in now + times])

            measurement = Measurement.of(seen(k, x))
            self.memory = self.law.step(self.memory, measurement, motion, WEIGHTS)
            self.torques[k] = self.memory.in_flight[-1]
            self.memories.append(self.memory)
            torques, durations = self.acting(k)
            ends = plant.dynamics.predict(x, torques, durations, plant.substeps, self.truth)
            self.states.append(ends[-1])
        return self


PAPERS = make_reference(load_scenario("paper").reference, 10.0)


def sine(size=1.0):
    """Return the trajectory (46) at a share of its amplitude."""
    rest = evaluate(PAPERS, 0.0) * np.repeat([1.0, 0, 0], 6)
    return lambda t: rest + size * (evaluate(PAPERS, t) - rest)


def nominal_queue(law, reference):
    """Mean torques along the reference for all that are in flight at the start."""
    o = law.timeline
    ends = (o.steps + o.fraction) * o.period - o.period * np.arange(o.queue_length)[::-1]
    nodes = [[reference(max(0.0, t - o.period * (1 - g))) for g in GAUSS_NODES] for t in ends]
    torque = law.plant.dynamics.inverse_dynamics
    return np.array(
        [np.mean([torque(*np.split(x, 3)) for x in two], axis=0) for two in nodes]
    ).reshape(-1, 6)


# Linear prediction is the paper's gain.


@pytest.mark.parametrize("integral", [True, False])
@pytest.mark.parametrize("model", ["paper", "multibody"])
@pytest.mark.parametrize(("steps", "fraction"), [(0, 0.0), (8, 0.0), (3, 0.5), (0, 0.3)])
def test_linear_law_is_the_full_gain_times_the_augmented_error(steps, fraction, model, integral):
    law = law_of(
        *LINEAR,
        f"controller.model={model}",
        f"controller.integral={str(integral).lower()}",
        f"delay.steps={steps}",
        f"delay.fraction={fraction}",
    )
    rng, period = np.random.default_rng(steps), law.timeline.period
    memory, preview = sampled(law), at_home(law)
    for _ in range(5):
        x = HOME[:12] + 1e-2 * rng.normal(0, 1, 12)
        weights = 10 ** rng.uniform(-1, 1, 2)
        error = x - HOME[:12]
        z = memory.integral + period / 2 * (memory.error + error[:6]) if integral else []
        if model == "paper":
            continuous = double_integrators(torque_map(PAPER, x[:6]))
        else:
            zero = np.zeros(6)
            continuous = linear_model(*law.plant.dynamics.derivatives(x[:6], x[6:], zero)[:2])
        delayed = delayed_model(continuous, period, steps, fraction, integral=integral)
        size = 12 if integral else 6
        K, _ = full_gain(delayed, weights[0] * np.eye(size), weights[1] * np.eye(6))
        expected = -K @ np.concatenate([error, z, memory.in_flight[1:].ravel()])
        memory = step(law, memory, x, preview, weights)
        assert relative(memory.torque, expected) < 1e-8
        assert np.array_equal(memory.in_flight[-1], memory.torque)
        assert np.array_equal(memory.weights, weights)


# Nonlinear prediction.


@pytest.mark.parametrize("gravity", [False, True])
@pytest.mark.parametrize(("steps", "fraction"), [(4, 0.0), (4, 0.5), (1, 0.3)])
def test_nonlinear_law_is_the_linear_one_where_errors_are_small(steps, fraction, gravity):
    """Their torques differ in the second order of the error's size."""
    settings = (
        f"plant.gravity={str(gravity).lower()}",
        "controller.period=0.05",
        "reference.kind=hold",
        f"delay.steps={steps}",
        f"delay.fraction={fraction}",
        "controller.estimate=[]",
        "controller.feedforward=equilibrium",
    )
    nonlinear = law_of(*settings, substeps=16)
    linear = dataclasses.replace(nonlinear, predictor=LinearPredictor())
    rng = np.random.default_rng(2)
    held = nonlinear.plant.dynamics.equilibrium_torque(PAPER.home)
    random = rng.normal(0, 0.02, (steps + 2, 6))
    error, z, dx = rng.normal(0, 0.1, 6), rng.normal(0, 0.1, 6), rng.normal(0, 0.1, 12)

    def torque(law, size):
        in_flight = held + size * random[: law.timeline.queue_length + 1]
        memory = sampled(law, in_flight=in_flight, error=size * error, integral=size * z)
        return step(law, memory, HOME[:12] + size * dx, at_home(law)).torque - held

    sizes = np.array([0.1, 0.05, 0.025, 0.0125])
    differences = [np.linalg.norm(torque(nonlinear, s) - torque(linear, s)) for s in sizes]
    order = np.polyfit(np.log(sizes), np.log(differences), 1)[0]
    assert order == pytest.approx(2.0, abs=0.2)
    assert differences[-1] < 0.05 * np.linalg.norm(torque(linear, sizes[-1]))


@pytest.mark.parametrize("feedforward", ["none", "inverse_dynamics"])
def test_only_feedforward_makes_the_linear_law_see_a_moving_reference(feedforward):
    """The laws then differ by K [x_d(t + eta) - x_d - eta x_d'; x_d'(t + eta) - x_d'].

    Motion and errors are small, so that both are linear; the plate is on the reference, with the
    torques that keep it there in flight.
    """
    nonlinear = law_of(*PLAIN, "controller.integral=false", f"controller.feedforward={feedforward}")
    linear = dataclasses.replace(nonlinear, predictor=LinearPredictor())
    size, now, eta, dt = 1e-3, 0.7, 0.8, 0.1
    amplitude = size * np.array([np.pi / 12] * 3 + [0.02, 0.02, 0.08])

    def wanted(t):
        wave = np.concatenate(
            [np.sin(t) * amplitude, np.cos(t) * amplitude, -np.sin(t) * amplitude]
        )
        return HOME + wave

    def takes(t):
        pose, rates, accelerations = np.split(wanted(t), 3)
        return nonlinear.plant.dynamics.inverse_dynamics(pose, rates, accelerations)

    in_flight = np.array([takes(now + (i - 0.5) * dt) for i in range(9)])

    def after(law):
        memory = sampled(law, in_flight=in_flight, state=wanted(now - dt)[:12], error=np.zeros(6))
        preview = np.array([wanted(now + t) for t in law.preview_times])
        return step(law, memory, wanted(now)[:12], preview)

    one, other = after(nonlinear), after(linear)
    ahead, here = wanted(now + eta), wanted(now)
    missed = np.concatenate([(ahead - here)[:6] - eta * here[6:12], (ahead - here)[6:12]])
    expected = one.gain @ missed
    difference = one.torque - other.torque
    if feedforward == "inverse_dynamics":
        # What is left is the hold's own, dt^2/12 of the motion.
        assert np.linalg.norm(difference) < 0.01 * np.linalg.norm(expected)
    else:
        np.testing.assert_allclose(difference, expected, atol=0.01 * np.abs(expected).max())


@pytest.mark.parametrize(("steps", "fraction"), [(0, 0.0), (8, 0.0), (3, 0.5), (1, 0.3), (0, 0.3)])
def test_state_is_predicted_through_the_torques_in_flight(steps, fraction):
    """The gain at sample k is designed for the state of the plant at sample k + mu."""
    law = law_of(f"delay.steps={steps}", f"delay.fraction={fraction}", "controller.estimate=[]")
    points = []

    class Spy(MultibodyModel):
        def about(self, state, *rest):
            points.append(state)
            return super().about(state, *rest)

    assert law.model == MultibodyModel()
    law = dataclasses.replace(law, model=Spy())
    reference = sine(0.6)
    queue = nominal_queue(law, reference) + 1e-3 * np.random.default_rng(3).normal(
        0, 1, (law.timeline.queue_length, 6)
    )
    loop = Loop(law, reference, queue=queue).run(12 + steps)
    assert len(points) == 12 + steps
    for k in range(12):
        assert np.abs(points[k] - loop.states[k + steps]).max() < 1e-9


# Feedforward: torques that are held, and what they make of a motion.


@pytest.mark.parametrize("passed", [0.0, 0.3, 0.5, 0.8])
def test_held_torques_meet_a_sine_at_fourth_order(passed):
    """Double integrators under held torques, integrated by hand.

    With (hold), and rates that start by (rates), the pose at the samples is off by O(dt^4), and
    rates there by O(dt^3) after subtracting their offset; holding plain means leaves O(dt^2). The
    offset is looked at when the share `passed` of each hold is over.
    """
    B, offset_of = np.diag([0.5, 1.0, 2.0, 3.0, 4.0, 5.0]), InverseDynamicsFeedforward().offset
    omega, phase = np.array([1.0, 1.5, 2.0, 0.7, 1.2, 1.0]), np.arange(6.0)

    def motion(t, order):
        return omega**order * np.sin(omega * t + phase + order * np.pi / 2)

    def worst(dt, corrected):
        starts = dt * np.arange(-1, round(3.0 / dt) + 1)
        nodes = [[motion(s + dt * g, 2) / np.diag(B) for g in GAUSS_NODES] for s in starts]
        means, changes = means_and_changes(np.array(nodes))
        torques = held_torques(means, changes) if corrected else means[1:-1]
        x, v = motion(0.0, 0), motion(0.0, 1)
        if corrected:
            v = v + offset_of(changes, B, Timeline(dt, Delay(0)))[6:]
        pose, rates = 0.0, 0.0
        for k, torque in enumerate(torques):
            now, part = k * dt, passed * dt
            x_in, v_in = x + part * v + part**2 / 2 * B @ torque, v + part * B @ torque
            offset = np.zeros(12)
            if corrected:  # the share that is still to pass, 0 between two holds
                left = Delay(0, 1 - passed if passed else 0)
                offset = offset_of(changes[k : k + 2], B, Timeline(dt, left))
            pose = max(pose, np.abs(x_in - offset[:6] - motion(now + part, 0)).max())
            rates = max(rates, np.abs(v_in - offset[6:] - motion(now + part, 1)).max())
            x, v = x + dt * v + dt**2 / 2 * B @ torque, v + dt * B @ torque
        return pose, rates

    periods = np.array([0.1, 0.05, 0.025, 0.0125])
    plain = np.array([worst(dt, False) for dt in periods])
    held = np.array([worst(dt, True) for dt in periods])

    def order(errors):
        return float(np.polyfit(np.log(periods), np.log(errors), 1)[0])

    assert order(plain[:, 0]) == pytest.approx(2.0, abs=0.15)
    if passed in (0.0, 0.5):
        assert order(held[:, 0]) == pytest.approx(4.0, abs=0.3)
    else:
        assert order(held[:, 0]) > 3.7 or held[0, 0] < 1e-2 * plain[0, 0]
    assert order(held[:, 1]) > 2.7
    assert held[0, 0] < 0.02 * plain[0, 0]


@pytest.mark.parametrize("prediction", ["nonlinear", "linear"])
@pytest.mark.parametrize("fraction", [0.0, 0.3, 0.5])
def test_a_known_reference_is_followed_at_a_high_order_of_the_period(fraction, prediction):
    """Feedback does next to nothing on the reference, with its torques in flight."""

    def worst(period):
        law = law_of(
            f"controller.period={period}",
            f"controller.prediction={prediction}",
            "controller.estimate=[]",
            "delay.steps=2",
            f"delay.fraction={fraction}",
            substeps=4,
        )
        reference = sine(0.5)
        loop = Loop(law, reference, queue=nominal_queue(law, reference))
        samples = round(3.0 / period)
        loop.run(samples)
        half = samples // 2  # what the start with plain means leaves has settled by then
        return max(
            float(np.abs(loop.states[k][:6] - reference(k * period)[:6]).max())
            for k in range(half, samples)
        )

    errors = [worst(0.1), worst(0.05)]
    assert errors[0] < 5e-6
    assert errors[1] < errors[0] / 5


# Saturation.


@pytest.mark.parametrize("prediction", ["nonlinear", "linear"])
def test_what_flies_keeps_the_limit_and_saturated_steps_are_counted(prediction):
    """The law commands as if there were no limit, and expects the limited torque to act."""
    law = law_of(f"controller.prediction={prediction}", "controller.estimate=[]", limit=0.02)
    rng, memory, preview = np.random.default_rng(4), sampled(law), at_home(law)
    unlimited_plant = dataclasses.replace(law.plant, motors=TorqueLimit())
    free = dataclasses.replace(law, plant=unlimited_plant)
    expected = 0
    for size in (0.0, 1e-5, 1e-4, 1e-3, 1e-2, 0.1):
        before = {"in_flight": np.zeros((9, 6)), "integral": np.zeros(6), "error": np.zeros(6)}
        memory = sampled(law, **before, counts=memory.field("counts"))
        x = HOME[:12] + size * rng.normal(0, 1, 12)
        unlimited = step(free, memory, x, preview).torque
        memory = step(law, memory, x, preview)
        expected += bool(np.abs(unlimited).max() > 0.02)
        assert np.array_equal(memory.torque, unlimited)
        assert np.array_equal(memory.in_flight[-1], np.clip(unlimited, -0.02, 0.02))
        assert memory.counts.saturated_steps == expected
    assert 0 < expected < 6


@pytest.mark.parametrize("fraction", [0.0, 0.5])
def test_integral_waits_while_a_motor_is_at_its_limit(fraction):
    """The torque that acted during the last period decides, or the two that did."""
    law = law_of(*PLAIN, "delay.steps=3", f"delay.fraction={fraction}", limit=0.1)
    o = law.timeline
    x = HOME[:12] + np.repeat([1e-3, 0.0], 6)
    below = np.full((o.queue_length + 1, 6), 0.05)
    acted = 1 if fraction == 0 else 2
    for place in range(len(below)):
        for leg, value in ((0, 0.1), (5, -0.1)):
            in_flight = below.copy()
            in_flight[place, leg] = value
            memory = sampled(law, in_flight=in_flight)
            after = step(law, memory, x, at_home(law))
            trapezoid = o.period / 2 * (memory.error + x[:6] - HOME[:6])
            expected = memory.integral + (0.0 if place < acted else trapezoid)
            assert np.allclose(after.integral, expected, rtol=0, atol=1e-16)
            assert np.array_equal(after.error, x[:6] - HOME[:6])


@pytest.mark.parametrize("fraction", [0.0, 0.5])
def test_predicted_integral_waits_in_the_same_periods(fraction):
    """The predicted integral is the integral at the sample at which the torque acts."""
    law = law_of(
        *PLAIN,
        "delay.steps=3",
        f"delay.fraction={fraction}",
        limit=5e-4,
    )
    predicted = []

    class Spy(Predicted):
        def predict(self, *arguments):
            result = super().predict(*arguments)
            predicted.append(result.integral)
            return result

    assert law.predictor == NonlinearPredictor()
    law = dataclasses.replace(law, predictor=Spy())
    loop = Loop(law, lambda t: HOME)
    loop.states[0] = HOME[:12] + np.concatenate([np.full(6, 2e-3), np.zeros(6)])
    loop.run(25)
    limited = [bool(np.abs(m.torque).max() >= 5e-4) for m in loop.memories]
    assert 3 < sum(limited) < 22
    for k in range(20):
        assert np.allclose(predicted[k], loop.memories[k + 3].integral, rtol=0, atol=1e-10)


# Bad days.

FILTERS = ["controller.estimate=[torque_bias,payload,damping]", "controller.estimate=[]"]


@pytest.mark.parametrize("estimator", FILTERS)
@pytest.mark.parametrize("prediction", ["nonlinear", "linear"])
@pytest.mark.parametrize(
    "bad",
    [(0,), (0, 1, 2), (5,), (3, 4, 5, 6, 7), (0, 4, 5, 9), tuple(range(12))],
    ids=["first", "first three", "one", "five", "some", "all"],
)
def test_torque_is_finite_whatever_the_sensor_says(bad, prediction, estimator):
    law = law_of(estimator, f"controller.prediction={prediction}", "delay.steps=2")
    reference = sine(0.3)
    nonsense = [np.nan, np.inf, -np.inf]

    def seen(k, x):
        y = x.copy()
        if k in bad:
            y[k % 12 if k % 2 else slice(None)] = nonsense[k % 3]
        return y

    loop = Loop(law, reference, queue=nominal_queue(law, reference)).run(12, seen)
    for k, memory in enumerate(loop.memories):
        assert np.all(np.isfinite(memory.torque))
        assert np.all(np.isfinite(memory.belief.state))
        assert memory.counts.bad_measurements == sum(b <= k for b in bad)
        assert np.abs(memory.torque).max() < 1.0
    if len(bad) < 12:
        well = Loop(law, reference, queue=nominal_queue(law, reference)).run(12)
        assert np.abs(loop.states[-1] - well.states[-1])[:6].max() < 1e-3


@pytest.mark.parametrize("fraction", [0.0, 0.3])
@pytest.mark.parametrize("steps", [0, 1, 4])
def test_without_a_measurement_the_state_goes_on_by_the_model(steps, fraction):
    """The right torques act in the right periods: the state is the plant's to rounding."""
    law = law_of(f"delay.steps={steps}", f"delay.fraction={fraction}", "controller.estimate=[]")
    reference = sine(0.5)
    rng = np.random.default_rng(5)
    queue = nominal_queue(law, reference) + 2e-3 * rng.normal(0, 1, (law.timeline.queue_length, 6))
    loop = Loop(law, reference, queue=queue)
    loop.run(15, lambda k, x: np.full(12, np.nan) if 4 <= k < 9 else x)
    for memory, state in zip(loop.memories, loop.states, strict=False):
        assert np.abs(memory.belief.state - state).max() < 1e-12


def test_a_plate_out_of_reach_gets_the_feedforward_alone():
    law = law_of("controller.estimate=[]", "delay.steps=0")
    preview = at_home(law)
    far = HOME[:12] + np.eye(12)[5] * 0.3
    memory = sampled(law, gain=np.full((6, 18), 1e3), state=far, in_flight=np.zeros((1, 6)))
    for _ in range(2):  # a measurement there is no use either; the model puts the plate out there
        after = step(law, memory, far, preview)
        assert np.abs(after.torque).max() < 1e-9  # at home without gravity
        assert np.array_equal(after.gain, memory.gain)
    assert after.counts == Counts(unreachable=1, measurements_rejected=1)


def test_a_failed_riccati_equation_keeps_the_last_good_gain():
    calls = 0

    class FailsSometimes(QuadraticCost):
        def gain(self, *arguments):
            nonlocal calls
            calls += 1
            if calls in (1, 5, 6, 7):
                raise RiccatiError("by the test")
            return super().gain(*arguments)

    law = law_of("delay.steps=2")
    law = dataclasses.replace(law, cost=FailsSometimes(**vars(law.cost)))
    reference = sine(0.3)
    queue = nominal_queue(law, reference)
    loop = Loop(law, reference, queue=queue).run(10)
    failures = [m.counts.riccati_failures for m in loop.memories]
    assert failures == [1, 1, 1, 1, 2, 3, 4, 4, 4, 4]
    gains = [m.gain for m in loop.memories]
    assert np.isnan(gains[0]).all() and np.isfinite(gains[3]).all()
    assert all(np.array_equal(gain, gains[3]) for gain in gains[4:7])
    assert not np.array_equal(gains[7], gains[3])
    assert all(np.all(np.isfinite(m.torque)) for m in loop.memories)
    assert np.abs(loop.states[-1][:6] - reference(1.0)[:6]).max() < 1e-3


@pytest.mark.parametrize("fraction", [0.0, 0.3])
def test_the_last_good_gain_sees_the_same_errors(fraction):
    """The last good gain, too, does not see the rates that held torques leave."""
    law = law_of("delay.steps=2", f"delay.fraction={fraction}", "controller.estimate=[]")
    preview = np.array([sine(1.0)(max(0.0, 0.3 + t)) for t in law.preview_times])
    memory, x = sampled(law), preview[0, :12] + 1e-3
    well = step(law, memory, x, preview)
    failed = step(law, changed(memory, gain=well.gain), x, preview, np.array([np.nan, 1.0]))
    assert failed.counts.riccati_failures == 1
    assert np.array_equal(failed.torque, well.torque)


@pytest.mark.parametrize("bad", [slice(None), 0])
def test_bad_weights_and_a_gain_that_is_not_finite_keep_the_last_good_one(bad):
    class Broken(QuadraticCost):
        def gain(self, model, weights):
            K = super().gain(model, weights)
            K[bad] = np.nan
            return K

    law = law_of("delay.steps=2", "controller.estimate=[]")
    good = step(law, sampled(law), HOME[:12], at_home(law))
    own = dataclasses.replace(law, cost=Broken(**vars(law.cost)))
    odd = [np.nan, 1.0], [1.0, 0.0], [-1.0, 1.0], [np.inf, 1.0]
    for one, weights in ((own, WEIGHTS), *((law, np.array(weights)) for weights in odd)):
        after = step(one, good, HOME[:12], at_home(law), weights)
        assert np.array_equal(after.gain, good.gain) and after.counts.riccati_failures == 1
        assert np.all(np.isfinite(after.torque))


def test_a_step_changes_nothing_it_was_given():
    law = law_of("delay.steps=2")
    memory, preview = sampled(law), at_home(law)
    x, weights = HOME[:12] + 1e-3, WEIGHTS.copy()
    belief = memory.belief.estimate
    inputs = [memory.in_flight, belief.mean, belief.covariance, memory.error, memory.integral]
    inputs += [x, preview, weights]
    before = [value.copy() for value in inputs]
    step(law, memory, x, preview, weights)
    assert all(np.array_equal(a, b, equal_nan=True) for a, b in zip(inputs, before, strict=True))


@pytest.mark.parametrize(("frequency", "whole", "odd"), [("0.5", 200, 203.7), ("0.8", 10, 10.37)])
def test_a_duration_of_whole_periods_designs_the_same_law(frequency, whole, odd):
    """Evenly spaced instants would all see the sine at rest, free of torque and of acceleration."""
    motion = (f"reference.frequency={frequency}", "reference.frequency_unit=Hz", "delay.steps=1")
    one, other = (law_of(*motion, f"duration={d}") for d in (whole, odd))
    assert one.cost.torques == pytest.approx(other.cost.torques, rel=0.02)
    assert one.plant.coarse_torque_limit == pytest.approx(other.plant.coarse_torque_limit, rel=0.02)
    assert one.plant.substeps == other.plant.substeps


def test_a_motion_of_one_radian_peak_to_peak_is_no_constant():
    """Constants have the scale 1, as has an amplitude of 0.5."""
    scales = []
    for amplitude in (0.5, 0.5001):
        settings = [f"reference.amplitude=[0,0,{amplitude},0,0,0]", "plant.kind=exact"]
        experiment = prepare_unchecked(load_scenario("paper", None, settings))
        scales.append(experiment.motion_scale)
        assert scales[-1][2] == pytest.approx(amplitude)
        assert experiment.scale == pytest.approx([1, 1, 2 * amplitude, 1, 1, 1])
        weights, _, _ = weight_scales("bryson", experiment.nominal, experiment.peak_to_peak, 1.0)
        assert weights[2] == pytest.approx((0.03 * amplitude) ** -2)
    assert scales[0] == pytest.approx(scales[1], rel=1e-3)
