"""The exact plant: energy, agreement with the multibody engine, linearisation, its ends."""

import functools

import numpy as np
import pytest
from pydrake.systems.analysis import (
    ApplySimulatorConfig,
    Simulator,
    SimulatorConfig,
    SimulatorStatus,
)
from pydrake.systems.framework import DiagramBuilder, LeafSystem
from pydrake.systems.primitives import (
    ConstantVectorSource,
    FirstOrderTaylorApproximation,
    Linearize,
)

from stewart_drake.core.layout import DEAD_CENTRE_SINE
from stewart_drake.dynamics.stewart import StewartDynamics
from stewart_drake.dynamics.workspace import (
    PITCH_LIMIT,
    SINGULARITY_LIMIT,
    diagnose,
    home_sign,
    margin,
    measures_at,
)
from stewart_drake.loop.exact import ExactPlant, set_accuracy
from stewart_drake.loop.platforms import MultibodyStewart
from stewart_drake.scenario.timing import look_time
from tests.mechanisms import PAPER, random_mechanism, random_pose
from tests.oracles import relative, size

TIGHT = ("runge_kutta5", 1e-10, 0.005, True)
USUAL = ("runge_kutta5", 1e-8, 0.02, True)
ENDED = SimulatorStatus.ReturnReason.kReachedTerminationCondition
FREE = StewartDynamics(PAPER, gravity=False)
AT_HOME = np.concatenate([PAPER.home, np.zeros(6)])


def simulator_of(plant, state, torque, scheme):
    """Return a simulator of one plant from a state, under a constant torque."""
    simulator = Simulator(plant)
    context = simulator.get_mutable_context()
    plant.set_state(context, state)
    plant.GetInputPort("torque").FixValue(context, torque)
    name, accuracy, step, controlled = scheme
    config = SimulatorConfig(
        integration_scheme=name,
        max_step_size=step,
        accuracy=accuracy,
        use_error_control=controlled,
    )
    ApplySimulatorConfig(config, simulator)
    if controlled:
        context.SetAccuracy(accuracy)
    return simulator, context


def state_of(plant, context):
    return plant.GetOutputPort("state").Eval(context).copy()


# Ports and energy.


def test_topology():
    plant = ExactPlant(FREE)
    assert plant.GetInputPort("torque").size() == 6
    assert plant.GetOutputPort("state").size() == 12
    assert (plant.num_input_ports(), plant.num_output_ports()) == (1, 1)
    assert not plant.HasAnyDirectFeedthrough()
    context = plant.CreateDefaultContext()
    assert context.num_continuous_states() == 12
    assert context.has_only_continuous_state()
    assert np.array_equal(state_of(plant, context), [*PAPER.home, *np.zeros(6)])
    elsewhere = ExactPlant(FREE, np.arange(12.0))
    assert np.array_equal(state_of(elsewhere, elsewhere.CreateDefaultContext()), np.arange(12.0))


@pytest.mark.parametrize("gravity", [False, True])
def test_energy_is_kept(gravity):
    """Half a second from moderate rates; constant torques, their work known by the crank angles."""
    for mechanism in (PAPER, random_mechanism(np.random.default_rng(1))):
        dynamics, rng = StewartDynamics(mechanism, gravity), np.random.default_rng(0)
        rates = 0.1 * rng.normal(0, 1, 6) * size(mechanism) * ([1.0] * 3 + [0.2] * 3)
        plant = ExactPlant(dynamics)
        torque = dynamics.equilibrium_torque(mechanism.home) + rng.normal(0, 0.005, 6)
        start = np.concatenate([mechanism.home, rates])
        simulator, context = simulator_of(plant, start, torque, TIGHT)
        before = None
        for t in np.arange(0.1, 0.51, 0.1):
            x = state_of(plant, context)
            total = dynamics.energy(x[:6], x[6:])
            kinetic = total - dynamics.energy(x[:6], np.zeros(6))
            now = total - torque @ mechanism.crank_angles(x[:6])
            before = now if before is None else before
            assert abs(now - before) < 1e-8 * kinetic
            simulator.AdvanceTo(t)


# The two plants.


class Sine(LeafSystem):
    """Torque mean + amplitude * sin(omega t + phase)."""

    def __init__(self, amplitude, omega, phase, mean):
        super().__init__()

        def output(context, result):
            result.SetFromVector(mean + amplitude * np.sin(omega * context.get_time() + phase))

        self.DeclareVectorOutputPort("torque", 6, output, {self.time_ticket()})


@pytest.mark.parametrize("gravity", [False, True])
def test_multibody_plant_converges_to_it_at_first_order(gravity):
    """0.3 s of a sinusoidal torque with bias, payload and damping: the slope is 0.996."""
    rng = np.random.default_rng(3)
    held = StewartDynamics(PAPER, gravity).equilibrium_torque(PAPER.home)
    source = (0.05 * rng.normal(0, 1, 6), 20.0, rng.uniform(0, 6, 6))
    start = np.concatenate([PAPER.home, rng.normal(0, [0.2] * 3 + [0.02] * 3)])
    place, friction = [0.05, -0.03, 0.1], {"coulomb_friction": 5e-3, "coulomb_speed": 0.1}
    # The holding torque comes as a bias.
    parameters = np.concatenate([held, [0.3, 2e-3, *friction.values()], place])

    def motion(plant, added):
        builder = DiagramBuilder()
        builder.AddSystem(plant)
        torque = builder.AddSystem(Sine(*source, added))
        builder.Connect(torque.get_output_port(), plant.GetInputPort("torque"))
        diagram = builder.Build()
        simulator = Simulator(diagram)
        context = plant.GetMyContextFromRoot(simulator.get_mutable_context())
        plant.set_state(plant.GetMyMutableContextFromRoot(simulator.get_mutable_context()), start)
        simulator.get_mutable_integrator().set_target_accuracy(1e-11)
        simulator.get_mutable_integrator().set_maximum_step_size(0.01)
        simulator.AdvanceTo(look_time(0.3))
        return state_of(plant, context)

    expected = motion(ExactPlant(StewartDynamics(PAPER, gravity, parameters)), np.zeros(6))
    assert np.abs(expected - start)[:6].max() > 0.02

    def error(step):
        loads = {"payload_mass": 0.3, "joint_damping": 2e-3, "payload_position": place} | friction
        found = motion(MultibodyStewart(PAPER, step, gravity=gravity, **loads), held)
        return float(np.abs(found - expected)[:6].max())

    steps = [2e-3, 1e-3, 5e-4, 2e-4, 1e-4]
    errors = [error(step) for step in steps]
    slope = np.polyfit(np.log(steps), np.log(errors), 1)[0]
    assert 0.9 <= slope <= 1.1
    assert errors[-1] < 1e-2 * np.abs(expected - start)[:6].max()


# Linearisation.


@pytest.mark.parametrize("gravity", [False, True])
@pytest.mark.parametrize("index", range(-1, 2))
def test_drake_linearises_it_exactly(index, gravity):
    """At rest in equilibrium and on the move, by automatic differentiation of the plant."""
    rng = np.random.default_rng(index + 1)
    mechanism = PAPER if index < 0 else random_mechanism(rng)
    dynamics = StewartDynamics(mechanism, gravity)
    plant = ExactPlant(dynamics)
    pose = random_pose(rng, mechanism)
    held = dynamics.equilibrium_torque(pose)
    moving = np.concatenate([pose, rng.normal(0, 0.3, 6) * size(mechanism)])
    pushed = held + rng.normal(0, 0.1, 6)
    for state, torque, derive in (
        (np.concatenate([pose, np.zeros(6)]), held, Linearize),
        (moving, pushed, FirstOrderTaylorApproximation),
    ):
        context = plant.CreateDefaultContext()
        plant.set_state(context, state)
        plant.GetInputPort("torque").FixValue(context, torque)
        found = derive(plant, context)
        A, B = dynamics.linearize(state[:6], state[6:], torque)
        assert relative(found.A(), A) < 1e-13
        assert relative(found.B(), B) < 1e-13
        assert np.array_equal(found.C(), np.eye(12))
        assert not found.D().any()
    assert relative(found.A(), dynamics.linearize(pose)[0]) > 1e-3  # it matters where


# The ends of its reach.


def approach(seed):
    """Return a state at home whose rates lead to a dead centre within 2 s."""
    rng = np.random.default_rng(seed)
    direction = rng.normal(0, 1, 6)
    scale = np.array([1, 1, 1, 0.1, 0.1, 0.1])
    speed = 10 ** rng.uniform(0, 1.3)
    return np.concatenate([PAPER.home, speed * scale * direction / np.linalg.norm(direction)])


class Counting(StewartDynamics):
    """Counts the evaluations of the derivatives, and refuses to go on without end."""

    def __init__(self, limit, gravity=False):
        super().__init__(PAPER, gravity)
        self.count, self.limit = 0, limit

    def change(self, state, torque, parameters=None):
        self.count += 1
        if self.count > self.limit:
            raise AssertionError("the integration does not come to an end")
        return super().change(state, torque, parameters)


def ending(plant, start, torque, scheme, until):
    """Return whether a simulation ended before its time, why the plate cannot be there, and x."""
    simulator, context = simulator_of(plant, start, torque, scheme)
    status = simulator.AdvanceTo(until)
    ended = status.reason() == ENDED
    assert not ended or status.system() is plant
    assert not ended or status.message() == "the plate left its workspace"
    x = state_of(plant, context)
    return ended, diagnose(plant.dynamics.mechanism, context.get_time(), x[:6]), x


def end_of(start, scheme, limit, torque):
    """Failure and state where a simulation of at most 20 s ended."""
    ended, failure, x = ending(ExactPlant(Counting(limit)), start, torque, scheme, 20.0)
    assert ended and failure is not None
    return failure, x


NO_TORQUE, PRESSING = np.zeros(6), 0.5 * np.array([1.0, -1, 1, -1, 1, -1])


@functools.cache
def true_end(seed):
    """Return the true end of `approach`; every second run has torques."""
    return end_of(approach(seed), TIGHT, 20_000, (NO_TORQUE, PRESSING)[seed % 2])[0]


@pytest.mark.parametrize(
    "scheme",
    [
        USUAL,
        ("runge_kutta5", 1e-2, 0.02, True),
        ("runge_kutta5", 1e-2, 0.5, True),
        ("runge_kutta3", 1e-6, 0.1, True),
        ("runge_kutta3", 1e-4, 0.5, True),
        ("radau3", 1e-4, 0.1, True),
    ],
    ids=lambda s: f"{s[0]}-{s[1]:g}-{s[2]:g}",
)
def test_at_a_dead_centre_the_simulation_ends_in_time_and_names_the_leg(scheme):
    """Each run against one with 1e-10 and 5 ms: there the same leg, then the same instant."""
    legs = set()
    for seed in range(12):
        expected = true_end(seed)
        found, x = end_of(approach(seed), scheme, 5_000, (NO_TORQUE, PRESSING)[seed % 2])
        assert np.all(np.isfinite(x))
        assert found.time == pytest.approx(expected.time, rel=0.02, abs=1e-3)
        assert "end of its reach" in found.reason
        assert abs(found.margin) < 1e-3
        now = measures_at(PAPER, x[:6])
        assert now.sines[found.leg - 1] == now.sines.min() <= DEAD_CENTRE_SINE
        legs.add(found.leg)
        if np.partition(now.sines, 1)[1] > 0.1:  # only one leg is near its end
            assert found.leg == expected.leg
    assert len(legs) > 2


COARSE = [
    USUAL,
    ("explicit_euler", 0.0, 0.05, False),
    ("runge_kutta2", 0.0, 0.05, False),
    ("runge_kutta3", 0.0, 0.05, False),
    ("runge_kutta5", 1e-2, 1.0, True),
    ("bogacki_shampine3", 1e-1, 0.5, True),
    ("implicit_euler", 1e-2, 0.5, True),
    ("radau3", 1e-2, 0.5, True),
]


@pytest.mark.parametrize(
    ("faster", "gravity", "scheme"),
    [
        *((1.0, gravity, scheme) for scheme in COARSE for gravity in (False, True)),
        *((1e4, False, scheme) for scheme in COARSE[:2]),
    ],
)
def test_coarse_integration_stays_finite_and_comes_to_an_end(scheme, faster, gravity):
    """No NaN, no endless halving of steps; a coarse step may pass a dead centre unnoticed.

    With error control those end that press a leg into its dead centre, and at 100,000 radians per
    second a usual step and one of Euler's do.
    """
    absurd = faster > 1
    rng = np.random.default_rng(0)
    held = StewartDynamics(PAPER).equilibrium_torque(PAPER.home)
    for seed in range(12):
        torque = held + rng.normal(0, 0.7, 6) if gravity else (NO_TORQUE, PRESSING)[seed % 2]
        start = approach(seed) * np.repeat([1.0, faster], 6)
        plant = ExactPlant(Counting(20_000, gravity))
        ended, failure, x = ending(plant, start, torque, scheme, 0.05 if absurd else 2.0)
        assert np.all(np.isfinite(x))
        assert ended or not (absurd or (gravity and scheme[3]))
        assert ended == (failure is not None)


def crossing(mechanism, seed):
    """Return a pose on a parallel singularity well off dead centres, and a direction across it."""
    rng, sign = np.random.default_rng(seed), home_sign(mechanism)
    scale = np.array([1, 1, 1, 0.3, 0.3, 0.3])

    def parallel(distance):
        return sign * measures_at(mechanism, mechanism.home + distance * direction).parallel

    while True:
        direction = rng.normal(0, 1, 6) * scale
        direction /= np.linalg.norm(direction / scale)
        low = 0.0
        for high in np.linspace(0.02, 2, 100):
            now = measures_at(mechanism, mechanism.home + high * direction)
            if now.sines.min() < 0.1 or abs(now.pitch) > 1.3:
                break
            if parallel(high) < 0:
                while low < (middle := (low + high) / 2) < high:
                    low, high = (middle, high) if parallel(middle) > 0 else (low, middle)
                return mechanism.home + low * direction, direction
            low = high


@pytest.mark.parametrize("index", [-1, 0, 1])
def test_at_a_parallel_singularity_the_simulation_ends(index):
    """The cranks do not hold the plate where the determinant of the rods' wrenches changes sign."""
    mechanism = PAPER if index < 0 else random_mechanism(np.random.default_rng(index))
    pose, direction = crossing(mechanism, 2)
    sign = home_sign(mechanism)
    before, after = (
        sign * measures_at(mechanism, pose + s * 1e-3 * direction).parallel for s in (-1, 1)
    )
    assert before > 0 > after
    start = np.concatenate([pose - 0.1 * direction, direction])
    plant = ExactPlant(StewartDynamics(mechanism, gravity=False))
    ended, failure, x = ending(plant, start, NO_TORQUE, USUAL, 2.0)
    assert ended and failure is not None and failure.leg is None
    assert "parallel singularity" in failure.reason
    assert 0 < failure.time < 1
    # Before the sign changes, and not by far.
    assert sign * measures_at(mechanism, x[:6]).parallel == pytest.approx(
        SINGULARITY_LIMIT, rel=0.1
    )


def test_at_the_limit_of_the_pitch_the_simulation_ends():
    for seed in range(200):
        rng = np.random.default_rng(seed)
        pose = PAPER.home + rng.normal(0, [0.3, 0, 0.3, 0.05, 0.05, 0.05])
        pose[1] = PITCH_LIMIT - 0.05
        if margin(PAPER, pose) > 0.04:
            break
    start = np.concatenate([pose, 2.0 * np.eye(6)[1]])
    ended, failure, _ = ending(ExactPlant(FREE), start, NO_TORQUE, USUAL, 1.0)
    assert ended and failure is not None and "pitch" in failure.reason


def test_a_state_without_numbers_is_named_as_such():
    for value in (np.nan, np.inf):
        pose = PAPER.home.copy()
        pose[4] = value
        assert (failure := diagnose(PAPER, 1.0, pose)) is not None
        assert failure.reason == "the simulated state is not finite"


# In a diagram of one's own.


def test_a_diagram_of_ones_own_ends_where_a_plate_leaves():
    """Two machines side by side; the pushed one is found to leave to 1e-8, the other is at home."""
    builder = DiagramBuilder()
    pushed, idle = (builder.AddNamedSystem(name, ExactPlant(FREE)) for name in ("pushed", "idle"))
    for plant, torque in ((pushed, np.full(6, 0.1)), (idle, np.zeros(6))):
        source = builder.AddSystem(ConstantVectorSource(torque))
        builder.Connect(source.get_output_port(), plant.GetInputPort("torque"))
    simulator = Simulator(builder.Build())
    simulator.set_target_realtime_rate(100.0)
    set_accuracy(simulator)
    context = simulator.get_context()
    status = simulator.AdvanceTo(5.0)
    assert status.reason() == ENDED and status.system() is pushed
    assert abs(pushed.margin(pushed.GetMyContextFromRoot(context))) < 1e-5
    assert idle.margin(idle.GetMyContextFromRoot(context)) > 0.01
    assert simulator.get_target_realtime_rate() == 100.0
    assert simulator.get_integrator().get_target_accuracy() == context.get_accuracy() == 1e-8
    # The same time as with other settings that do, to the accuracy asked for.
    alone, _ = simulator_of(ExactPlant(FREE), AT_HOME, np.full(6, 0.1), TIGHT)
    assert alone.AdvanceTo(5.0).reason() == ENDED
    assert context.get_time() == pytest.approx(alone.get_context().get_time(), abs=1e-5)


@pytest.mark.parametrize("accuracy", [0.0, -1e-8, 0.1, 1e-13, np.nan, np.inf])
def test_an_accuracy_that_means_nothing_is_refused(accuracy):
    simulator, _ = simulator_of(ExactPlant(FREE), AT_HOME, np.zeros(6), USUAL)
    with pytest.raises(ValueError, match=r"^accuracy: got .*; expected a number from 1e-12"):
        set_accuracy(simulator, accuracy)


def test_a_torque_that_is_no_number_is_refused():
    """The integrator would shorten its steps for ever."""
    simulator, _ = simulator_of(ExactPlant(FREE), AT_HOME, np.full(6, np.nan), USUAL)
    with pytest.raises(ValueError, match=r"torque: got .*nan.*; expected finite numbers"):
        simulator.AdvanceTo(0.01)
