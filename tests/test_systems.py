"""The systems of the loop, each from its ports up to a simulation; who acts when on the plants."""

import functools
from collections.abc import Callable

import numpy as np
import pytest
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import (
    Context,
    DiagramBuilder,
    LeafSystem,
    State,
)
from pydrake.systems.primitives import LogVectorOutput

from stewart_drake.dynamics.stewart import StewartDynamics
from stewart_drake.files.resources import resolve
from stewart_drake.law.cost import PdGain, QuadraticCost
from stewart_drake.law.motion import Preview
from stewart_drake.law.nominal import NominalPlant, PaperModel, TorqueLimit
from stewart_drake.law.observers import DelaySettings
from stewart_drake.law.planner import Replan
from stewart_drake.law.predictive_lqi import PredictiveLqi
from stewart_drake.law.sensing import EncoderSensing, Measurement, StateSensing
from stewart_drake.law.timeline import Timeline
from stewart_drake.loop.controller import DelayLqiController, Reference
from stewart_drake.loop.diagram import build_closed_loop
from stewart_drake.loop.exact import ExactPlant
from stewart_drake.loop.law_design import control_law
from stewart_drake.loop.link import DelayChain, LateMeasurements, PlayoutBuffer, VaryingDelay
from stewart_drake.loop.platforms import MultibodyStewart
from stewart_drake.loop.preparation import prepare
from stewart_drake.loop.sensor import Encoders, Sensor
from stewart_drake.loop.simulation import make_simulator
from stewart_drake.loop.tuner import AnnTuner, DensityWindow
from stewart_drake.mechanism.trajectories import evaluate, make_reference
from stewart_drake.scenario.loading import load_scenario
from stewart_drake.scenario.timing import Delay, look_time
from stewart_drake.tuner.network import load_network
from tests.backends import with_own
from tests.mechanisms import PAPER

DELAYS = [(steps, fraction) for steps in (0, 1, 8) for fraction in (0.0, 0.3)]
MOTION = make_reference(load_scenario("paper").reference, 10.0)
AT_REST = np.concatenate([PAPER.home, np.zeros(6)])


def ports(system):
    """Sizes of the input and output ports by name."""
    inputs = map(system.get_input_port, range(system.num_input_ports()))
    outputs = map(system.get_output_port, range(system.num_output_ports()))
    return {p.get_name(): p.size() for p in inputs}, {p.get_name(): p.size() for p in outputs}


def queue(steps, fraction):
    """Distinct torques in flight, the oldest first."""
    length = steps + (fraction > 0)
    return -np.arange(length, 0, -1.0)[:, None] * np.ones(6)


# Reference.


def test_reference_shows_the_true_motion_now_and_the_planned_one_ahead():
    faster = load_scenario("paper", settings=["reference.frequency=2"])
    planned = make_reference(faster.reference, 1.0)
    ahead = np.array([0.0, 0.25, -0.5])
    system = Reference(MOTION, planned, ahead)
    assert ports(system) == ({}, {"reference": 18, "preview": 54})
    context = system.CreateDefaultContext()
    assert context.num_continuous_states() == context.num_discrete_state_groups() == 0
    for t in (0.0, 0.3, 2.0):
        context.SetTime(t)
        now = system.GetOutputPort("reference").Eval(context)
        assert np.array_equal(now, evaluate(MOTION, t))
        preview = system.GetOutputPort("preview").Eval(context).reshape(3, 18)
        expected = [evaluate(planned, max(0.0, t + dt)) for dt in ahead]
        assert np.array_equal(preview, expected)


# Sensor.


def measure(sensor, state, time):
    context = sensor.CreateDefaultContext()
    context.SetTime(time)
    sensor.get_input_port().FixValue(context, state)
    return sensor.get_output_port().Eval(context)


def test_sensor_without_noise_passes_the_state_through():
    sensor, state = Sensor(np.zeros(12), 0, 0.1), np.random.default_rng(0).normal(0, 1, 12)
    assert ports(sensor) == ({"state": 12}, {"measurement": 12})
    assert sensor.CreateDefaultContext().num_total_states() == 0
    assert np.array_equal(measure(sensor, state, 0.7), state)
    partly = Sensor(np.eye(12)[3], 0, 0.1)
    same = np.arange(12) != 3
    assert np.array_equal(measure(partly, state, 0.7)[same], state[same])
    assert measure(partly, state, 0.7)[3] != state[3]


def test_sensor_noise_is_a_function_of_seed_and_sample():
    std = np.linspace(1, 2, 12)
    one, again, other = (Sensor(std, seed, 0.1) for seed in (5, 5, 6))
    for k in (7, 0, 3):  # in any order
        y = measure(one, AT_REST, 0.1 * k)
        assert np.array_equal(y, AT_REST + one.noise(k))
        assert np.array_equal(y, measure(again, AT_REST, 0.1 * k * (1 - 1e-14)))
        assert not np.any(y == measure(other, AT_REST, 0.1 * k))
        assert not np.any(y == measure(one, AT_REST, 0.1 * (k + 1)))


def test_sensor_noise_is_white_and_as_large_as_asked_for():
    n, std = 20_000, np.linspace(1e-4, 2.0, 12)
    sensor = Sensor(std, 1, 0.1)
    normal = np.array([sensor.noise(k) for k in range(n)]) / std
    five_sigma = 5 / np.sqrt(n)
    assert np.abs(normal.mean(axis=0)).max() < five_sigma
    assert np.abs(np.cov(normal.T) - np.eye(12)).max() < np.sqrt(2) * five_sigma
    lagged = normal[1:].T @ normal[:-1] / n
    assert np.abs(lagged).max() < five_sigma
    assert abs((normal**4).mean() - 3) < 0.1


# Delay chain.


class Counter(LeafSystem):
    """Torque of sample k: `torque(k)`, at t = k dt."""

    def __init__(self, period, torque):
        super().__init__()
        self._period, self._torque = period, torque
        self.DeclareVectorOutputPort("torque", 6, self._output, {self.time_ticket()})

    def _output(self, context, output):
        output.SetFromVector(self._torque(round(context.get_time() / self._period)))


def test_delay_chain_topology_and_initial_state():
    for steps, fraction in DELAYS:
        chain = DelayChain(0.1, steps, fraction, queue(steps, fraction))
        assert ports(chain) == ({"commanded": 6}, {"torque": 6})
        assert not chain.HasAnyDirectFeedthrough()
        context = chain.CreateDefaultContext()
        # The oldest acts from the start.
        first = [*queue(steps, fraction), np.zeros(6)][0]
        assert np.array_equal(chain.get_output_port().Eval(context), first)
    for steps, fraction in ((2, 0.5), (2, 0.0)):
        with pytest.raises(ValueError, match="queue: got shape"):
            DelayChain(0.1, steps, fraction, queue(steps, 0.5 - fraction))


@pytest.mark.parametrize(("carries", "size"), [("torque", 6), ("command", 18)])
def test_a_delay_chain_without_a_queue_begins_with_zeros(carries, size):
    chain = DelayChain(0.1, 2, carries=carries)
    context = chain.CreateDefaultContext()
    for commanded in (1.0, 2.0, 3.0):
        chain.get_input_port().FixValue(context, np.full(size, commanded))
        carry_out(chain._take, context)
        acting = chain.GetOutputPort(carries).Eval(context)
        assert np.array_equal(acting, np.full(size, max(0.0, commanded - 2)))


NAN, SIX, TWELVE, EMPTY = np.nan, np.ones(6), np.zeros(12), np.zeros((0, 6))
MACHINE = StewartDynamics(PAPER)
AT_ONCE = Delay(0)
NETWORK = load_network(resolve("weights", "tuner"))


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: DelayChain(0.0, 0, 0.0, EMPTY), "period: got 0.0"),
        (lambda: DelayChain(NAN, 0, 0.0, EMPTY), "period: got nan"),
        (lambda: DelayChain("0.1", 0, 0.0, EMPTY), "period: got '0.1'"),
        (lambda: DelayChain(0.1, 1, 0.0, np.full((1, 6), NAN)), "queue: got [nan"),
        (
            lambda: DelayChain(0.1, 1.5, 0.0, np.zeros((1, 6))),
            "delay: got 1.5 steps",
        ),
        (lambda: DelayChain(0.1, 1, "half", np.zeros((1, 6))), "delay: got 1 steps and a fraction"),
        (lambda: DelayChain(0.1, 0, 0.0, EMPTY, "force"), "carries: got 'force'"),
        (lambda: VaryingDelay(0.0, [0.1], AT_ONCE, EMPTY), "period: got 0.0"),
        (lambda: VaryingDelay(0.1, [NAN], AT_ONCE, EMPTY), "delays: got [nan]"),
        (lambda: VaryingDelay(0.1, [0.1, -0.1], AT_ONCE, EMPTY), "delays: got [0.1, -0.1]"),
        (lambda: VaryingDelay(0.1, [], AT_ONCE, EMPTY), "delays: got []"),
        (lambda: VaryingDelay(0.1, [0.1], Delay(2), np.zeros((1, 6))), "queue: got shape (1, 6)"),
        (lambda: VaryingDelay(0.1, [0.1], 0.1, EMPTY), "delay: got 0.1; expected a Delay"),
        (lambda: PlayoutBuffer(0.1, [0.0], 1, EMPTY), "delay: got 1; expected a Delay"),
        (lambda: PlayoutBuffer(0.1, [-1.0], AT_ONCE, EMPTY), "times: got [-1.0]"),
        (
            lambda: PlayoutBuffer(0.1, [0.0], AT_ONCE, EMPTY, rows=0),
            "rows: got 0; expected a whole number, 1 or more",
        ),
        (
            lambda: PlayoutBuffer(0.1, [0.0], AT_ONCE, EMPTY, dry="drop"),
            "dry: got 'drop'",
        ),
        (lambda: LateMeasurements(0.0, [0.1], 12), "period: got 0.0"),
        (lambda: LateMeasurements(0.1, [0.1], 0), "size: got 0"),
        (lambda: Reference("paper", MOTION, [0.0]), "true_motion: got 'paper'"),
        (lambda: Reference(MOTION, MOTION, [NAN]), "preview_times: got [nan]"),
        (lambda: Sensor(-np.ones(12), 0, 0.1), "noise_std: got [-1"),
        (lambda: Sensor(TWELVE, 0.5, 0.1), "seed: got 0.5"),
        (lambda: Sensor(TWELVE, 0, 0.0), "period: got 0.0"),
        (lambda: Encoders(PAPER, 12, 0, np.zeros(6), 0, 0.1), "samples: got 0"),
        (lambda: Encoders(PAPER, 0, 1, np.zeros(6), 0, 0.1), "bits: got 0"),
        (lambda: Encoders("paper", 12, 1, np.zeros(6), 0, 0.1), "mechanism: got 'paper'"),
        (lambda: Encoders(PAPER, 12, 1, np.zeros(1), 0, 0.1), "offset: got shape (1,)"),
        (lambda: DensityWindow(0.1, "square"), "kind: got 'square'"),
        (lambda: DensityWindow(-0.1), "period: got -0.1"),
        (lambda: AnnTuner(NETWORK, [1.0, NAN], 0.1), "fixed: got [1, nan]"),
        (lambda: AnnTuner("tuner", [1.0, NAN], 0.1), "fixed: got [1, nan]"),
        (lambda: AnnTuner("health_T", [1.0, 1.0], 0.1), "network.features: got 'health'"),
        (lambda: ExactPlant(MACHINE, 0.1), "initial_state: got shape ()"),
        (lambda: Timeline(0.1, 0.8), "delay: got 0.8; expected a Delay"),
        (lambda: Timeline(0.0, AT_ONCE), "period: got 0.0"),
        (lambda: QuadraticCost(SIX, None, NAN * SIX), "torques: got [nan"),
        (lambda: QuadraticCost(SIX[:5], None, SIX), "errors: got shape (5,)"),
        (lambda: QuadraticCost(SIX, -SIX, SIX), "integrals: got [-1"),
        (lambda: PdGain(1.0, NAN, 0.1), "kp, kd: got [1, nan]"),
        (lambda: TorqueLimit(NAN), "limit: got nan"),
        (lambda: NominalPlant(MACHINE, 0, 1.0, TorqueLimit()), "substeps: got 0"),
        (lambda: NominalPlant(PAPER, 1, 1.0, TorqueLimit()), "dynamics: got Mechanism"),
        (lambda: PaperModel("exact"), "form: got 'exact'"),
        (lambda: StateSensing(TWELVE[:6], SIX), "noise_std: got shape (6,)"),
        (
            lambda: EncoderSensing(PAPER, 1, NAN, TWELVE, SIX, SIX, np.zeros(6)),
            "quantum: got nan",
        ),
        (lambda: DelaySettings(0.1, 0.0, 1.0), "std: got 0.0"),
        (lambda: DelaySettings(0.1, 0.1, NAN), "longest: got nan"),
        (lambda: Replan(NAN, 1.0, SIX), "duration: got nan"),
    ],
)
def test_a_bad_argument_is_one_line_at_construction(make, message):
    """Of systems and parts of the law, where the damage would show much later."""
    with pytest.raises(ValueError, match="; expected") as refused:
        make()
    assert str(refused.value).startswith(message) and "\n" not in str(refused.value)


Update = Callable[[Context, State], None]


def carry_out(update, context):
    """Apply an unrestricted update as a simulator does."""
    after = context.Clone()
    update(context, after.get_mutable_state())
    context.SetTimeStateAndParametersFrom(after)


@pytest.mark.parametrize(("steps", "fraction"), DELAYS)
def test_delay_chain_forced_updates_shift_the_queue(steps, fraction):
    chain = DelayChain(0.1, steps, fraction, queue(steps, fraction))
    context = chain.CreateDefaultContext()
    order = [*queue(steps, fraction), *(np.full(6, 10.0 + k) for k in range(12))]
    for k in range(12):
        chain.get_input_port().FixValue(context, np.full(6, 10.0 + k))
        carry_out(chain._take, context)
        assert np.array_equal(chain.get_output_port().Eval(context), order[k])
        if fraction > 0:
            carry_out(chain._release, context)
            assert np.array_equal(chain.get_output_port().Eval(context), order[k + 1])


@pytest.mark.parametrize("period", [0.1, 0.01, 1 / 30])
@pytest.mark.parametrize(("steps", "fraction"), DELAYS)
def test_torque_leaves_the_bare_chain_in_its_own_interval(steps, fraction, period):
    """Looked at next to every instant at which it may change, and by a logger in between."""
    builder = DiagramBuilder()
    source = builder.AddSystem(Counter(period, lambda k: np.full(6, float(k))))
    chain = builder.AddSystem(DelayChain(period, steps, fraction, queue(steps, fraction)))
    builder.Connect(source.get_output_port(), chain.get_input_port())
    logger = LogVectorOutput(chain.get_output_port(), builder, period / 8)
    diagram = builder.Build()
    simulator = Simulator(diagram)
    context = chain.GetMyContextFromRoot(simulator.get_context())
    output = chain.get_output_port()
    eta = (steps + fraction) * period
    near = 1e-9 * period
    for k in range(-steps, 30):
        starts = k * period + eta
        if starts - near > 0:
            simulator.AdvanceTo(starts - near)
            assert np.array_equal(output.Eval(context), np.full(6, k - 1.0))
        simulator.AdvanceTo(starts + near)
        assert np.array_equal(output.Eval(context), np.full(6, float(k)))
    log = logger.FindLog(simulator.get_context())
    phase = (log.sample_times() - eta) / period
    clear = np.abs(phase - np.round(phase)) > 1e-6
    assert clear.sum() > 100
    assert np.array_equal(log.data()[0, clear], np.floor(phase[clear]))


def chained(plant, period, steps, fraction, torque):
    """Counter, delay chain with nothing in flight, plant."""
    builder = DiagramBuilder()
    source = builder.AddSystem(Counter(period, torque))
    chain = builder.AddSystem(DelayChain(period, steps, fraction))
    builder.AddSystem(plant)
    builder.Connect(source.get_output_port(), chain.get_input_port())
    builder.Connect(chain.get_output_port(), plant.GetInputPort("torque"))
    builder.ExportOutput(plant.GetOutputPort("state"), "state")
    return builder.Build()


def state_at(simulator, time):
    """State of the plant at a nominal time, before a discrete plant steps out of it."""
    if time > 0:
        simulator.AdvanceTo(look_time(time))
    else:
        simulator.Initialize()
    return simulator.get_system().GetOutputPort("state").Eval(simulator.get_context()).copy()


@pytest.mark.parametrize(("steps", "fraction"), DELAYS)
def test_an_impulse_reaches_the_exact_plant_in_its_own_interval(steps, fraction):
    """At rest until the release, then on the way that the dynamics alone predict."""
    period, k0, push = 0.1, 2, 0.05 * np.array([1.0, -1, 0.5, 1, -0.5, 2])
    dynamics = StewartDynamics(PAPER, gravity=False)
    plant = ExactPlant(dynamics)
    diagram = chained(plant, period, steps, fraction, lambda k: push * (k == k0))
    simulator = Simulator(diagram)
    integrator = simulator.get_mutable_integrator()
    integrator.set_maximum_step_size(0.02)
    integrator.set_target_accuracy(1e-12)
    released = (k0 + steps + fraction) * period
    assert np.abs(state_at(simulator, released) - AT_REST).max() < 1e-12
    acceleration = dynamics.accelerations(PAPER.home, np.zeros(6), push)
    for after in (1e-6, 1e-3, 0.04, period, period + 0.05):
        torques = [push, np.zeros(6)]
        durations = [min(after, period), max(0.0, after - period)]
        expected = dynamics.predict(AT_REST, torques, durations, 50)[-1]
        found = state_at(simulator, released + after)
        assert np.abs(found - expected).max() < 1e-9 * max(1.0, after / 1e-3)
        if after < 1e-5:
            assert found[6:] == pytest.approx(after * acceleration, rel=1e-4)


@pytest.mark.parametrize(("steps", "fraction"), DELAYS)
def test_torques_reach_the_multibody_plant_in_their_own_steps(steps, fraction):
    """The step that starts at the release is the first to feel a torque; none is late or early.

    Torques that all differ push along one direction, so that the change of the rates over each
    step of 1 ms tells which of them acted.
    """
    period, h, samples = 0.1, 1e-3, 16
    rng = np.random.default_rng(0)
    sizes = rng.permutation(np.arange(1, samples + 1)) * np.resize([1, -1], samples)
    direction = 2e-4 * np.array([1.0, 1, 1, 1, 1, 1]) * np.array([1, -1, 1, -1, 1, -1])
    plant = MultibodyStewart(PAPER, h, gravity=False)
    diagram = chained(
        plant, period, steps, fraction, lambda k: direction * (sizes[k] if k < samples else 0)
    )
    simulator = Simulator(diagram)
    plant.set_state(plant.GetMyMutableContextFromRoot(simulator.get_mutable_context()), AT_REST)
    count = round(samples * period / h)
    states = np.array([state_at(simulator, n * h) for n in range(count + 1)])
    dynamics = StewartDynamics(PAPER, gravity=False)
    accelerations = np.diff(states[:, 6:], axis=0) / h
    torques = [
        dynamics.inverse_dynamics(x[:6], x[6:], a)
        for x, a in zip(states, accelerations, strict=False)
    ]
    felt = np.array(torques) @ direction / (direction @ direction)
    delay = round((steps + fraction) * period / h)
    computed = (np.arange(count) - delay) // round(period / h)
    expected = np.where(computed >= 0, sizes[np.maximum(computed, 0)], 0)
    assert np.abs(felt - expected).max() < 0.3
    assert np.array_equal(np.round(felt), expected)


# Controller.


@functools.cache
def law():
    settings = ["start=on_reference", "duration=1.0", "delay.steps=2", "controller.replan=0"]
    return control_law(prepare(load_scenario("paper", settings=settings)))[0]


def test_controller_topology_and_initial_state():
    in_flight = 1e-3 * np.arange(12.0).reshape(2, 6)
    controller = DelayLqiController(law(), in_flight)
    _, outputs = ports(controller)
    for name in outputs:
        port = controller.GetOutputPort(name).get_index()
        through = any(
            controller.HasDirectFeedthrough(i, port) for i in range(controller.num_input_ports())
        )
        assert through == (name in ("torque", "estimate", "memory"))
    context = controller.CreateDefaultContext()
    memory = controller.memory(context)
    assert np.array_equal(memory.in_flight[-2:], in_flight)
    assert np.all(memory.in_flight[:-2] == in_flight[0])  # the oldest has acted before

    def shown(name):
        return controller.GetOutputPort(name).Eval(context)

    assert not shown("integral").any()
    assert np.isnan(shown("weights_used")).all()
    assert not shown("parameters").any()
    assert np.isnan(shown("parameter_std")).all() and np.isnan(shown("delay_std")).all()
    assert shown("delay_estimate")[0] == pytest.approx(law().timeline.eta)
    assert np.array_equal(shown("torque_commanded"), in_flight[-1])


def fixed(controller, context):
    """Constant inputs, off the reference."""
    preview = np.array([evaluate(MOTION, max(0.0, t)) for t in law().preview_times])
    values = {
        "measurement": preview[0, :12] + 1e-3,
        "preview": preview.ravel(),
        "weights": np.array([1.0, 2.0]),
    }
    for name, value in values.items():
        controller.GetInputPort(name).FixValue(context, value)
    return values


@pytest.mark.parametrize("own", [(), ("observer", "feedforward")])
def test_controller_output_and_forced_update_are_steps_of_the_law(own):
    steps = with_own(law(), *own)
    controller = DelayLqiController(steps, np.zeros((2, 6)))
    context = controller.CreateDefaultContext()
    inputs = fixed(controller, context)
    expected = steps.initial_memory(np.zeros((2, 6)))
    for k in range(3):
        inputs["weights"] = np.array([1.0, 2.0 + k])
        controller.GetInputPort("weights").FixValue(context, inputs["weights"])
        preview = Preview(law().preview_times, inputs["preview"].reshape(-1, 18))
        measurement = Measurement.of(inputs["measurement"])
        expected = steps.step(expected, measurement, preview, inputs["weights"])
        held = controller.GetOutputPort("torque_commanded").Eval(context).copy()
        torque = controller.GetOutputPort("torque").Eval(context)
        assert np.array_equal(torque, expected.torque)
        assert not np.array_equal(torque, held)
        carry_out(controller._update, context)
        for name, value in (
            ("torque_commanded", expected.torque),
            ("integral", expected.integral),
            ("weights_used", inputs["weights"]),
            ("parameters", expected.belief.parameters),
            ("parameter_std", expected.belief.estimate.parameter_std),
        ):
            assert np.array_equal(controller.GetOutputPort(name).Eval(context), value)


def short_loop(plant, *settings, controller=None):
    usual = ["duration=1.0", f"plant.kind={plant}", "start=on_reference", "queue=reference"]
    return build_closed_loop(load_scenario("paper", controller, [*usual, *settings]))


@pytest.mark.parametrize("plant", ["exact", "multibody"])
@pytest.mark.parametrize("fraction", [0.0, 0.3])
def test_the_law_is_evaluated_once_per_sample(fraction, plant, monkeypatch):
    step, calls = PredictiveLqi.step, []

    def counted(self, memory, *inputs):
        calls.append(memory)
        return step(self, memory, *inputs)

    loop = short_loop(plant, f"delay.fraction={fraction}", "delay.steps=1")
    simulator = make_simulator(loop)
    monkeypatch.setattr(PredictiveLqi, "step", counted)
    for samples, until in ((1, 0.05), (2, 0.15), (6, 0.55)):
        simulator.AdvanceTo(until)
        for name in ("torque_commanded", "torque_applied", "integral", "parameters"):
            loop.GetOutputPort(name).Eval(simulator.get_context())
        assert len(calls) == samples


@pytest.mark.parametrize("plant", ["exact", "multibody"])
def test_two_contexts_of_one_diagram_do_not_know_of_each_other(plant):
    """Nothing lives on the systems: interrupting a run by another leaves no trace."""
    noise = "sensor.noise_std=[" + ", ".join(["1e-4"] * 12) + "]"
    loop = short_loop(plant, "delay.steps=2", "delay.fraction=0.3", noise)

    def outcome(simulator):
        context = simulator.get_context()
        names = ("state", "torque_commanded", "torque_applied", "integral", "parameters")
        return [loop.GetOutputPort(name).Eval(context).copy() for name in names]

    whole = make_simulator(loop)
    whole.AdvanceTo(0.25)
    whole.AdvanceTo(0.5)
    interrupted, other = make_simulator(loop), make_simulator(loop)
    interrupted.AdvanceTo(0.25)
    other.AdvanceTo(0.4)
    interrupted.AdvanceTo(0.5)
    for expected, found in zip(outcome(whole), outcome(interrupted), strict=True):
        assert np.array_equal(expected, found)


@pytest.mark.parametrize(
    "settings",
    [
        ("delay.steps=2", "delay.fraction=0.3"),
        ("link.kind=network", "link.low=0.1", "link.high=0.2"),
        ("delay.steps=1", "sensor.kind=encoders", "sensor.delay=0.04", "sensor.samples=2"),
        ("delay.steps=1", "actuator.kind=servo"),
    ],
)
def test_a_simulator_that_is_initialised_again_takes_no_further_sample(settings):
    """At the start, between samples, at a sample, and as a new simulator of a cloned context."""
    controller = "servo_preview" if "actuator.kind=servo" in settings else None
    loop = short_loop("multibody", *settings, controller=controller)
    whole, again = make_simulator(loop), make_simulator(loop)
    again.Initialize()
    again.Initialize()
    for time in (0.25, 0.3):
        again.AdvanceTo(time)
        again.Initialize()
    again = Simulator(loop, again.get_context().Clone())
    for simulator in (whole, again):
        simulator.AdvanceTo(0.55)
    for name in ("state", "torque_commanded", "torque_applied"):
        expected, found = (
            loop.GetOutputPort(name).Eval(simulator.get_context()) for simulator in (whole, again)
        )
        assert np.array_equal(expected, found)
