"""The exact plant in Drake's simulator: convergence, linearisation, and how it ends."""

import numpy as np
import pytest
from numpy.typing import NDArray
from pydrake.systems.analysis import ApplySimulatorConfig, Simulator, SimulatorConfig
from pydrake.systems.primitives import Linearize

from stewart_drake.diagram import MultibodyStewart
from stewart_drake.plant.dynamics import StewartDynamics
from stewart_drake.plant.exact import ExactPlant
from stewart_drake.plant.workspace import diagnose, standing
from stewart_drake.signals import POSE
from stewart_drake.timing import look_time
from tests.mechanisms import PAPER

Array = NDArray[np.float64]
AT_HOME = np.concatenate([PAPER.home, np.zeros(6)])


def simulated(
    plant: ExactPlant,
    state: Array,
    torque: Array,
    end: float,
    scheme: str = "runge_kutta5",
    accuracy: float = 1e-10,
    longest_step: float = 0.1,
) -> tuple[float, Array, int]:
    """Time and state where the simulation ended, and the number of derivative evaluations."""
    context = plant.CreateDefaultContext()
    plant.set_state(context, state)
    plant.GetInputPort("torque").FixValue(context, torque)
    simulator = Simulator(plant, context)
    config = SimulatorConfig(
        integration_scheme=scheme,
        accuracy=accuracy,
        max_step_size=longest_step,
        use_error_control=True,
    )
    ApplySimulatorConfig(config, simulator)
    context.SetAccuracy(accuracy)
    simulator.AdvanceTo(end)
    evaluations = simulator.get_integrator().get_num_derivative_evaluations()
    return context.get_time(), context.get_continuous_state_vector().CopyToVector(), evaluations


def test_multibody_plant_approaches_it_at_first_order() -> None:
    """Slope of the pose error over the engine's step, 0.3 s of a constant torque near home."""
    torque = 0.02 * np.array([1.0, -0.5, 0.3, 0.8, -1.0, 0.4])
    plant = ExactPlant(StewartDynamics(PAPER, gravity=False))
    _, truth, _ = simulated(plant, AT_HOME, torque, 0.3)
    steps, errors = np.array([2e-3, 1e-3, 5e-4, 2e-4, 1e-4]), []
    for step in steps:
        engine = MultibodyStewart(PAPER, step, gravity=False)
        context = engine.CreateDefaultContext()
        engine.set_state(context, AT_HOME)
        engine.GetInputPort("torque").FixValue(context, torque)
        Simulator(engine, context).AdvanceTo(look_time(0.3))
        state = engine.GetOutputPort("state").Eval(context)
        errors.append(np.abs(state[POSE] - truth[POSE]).max())
    slope = np.polyfit(np.log(steps), np.log(errors), 1)[0]
    assert 0.9 < slope < 1.1


@pytest.mark.parametrize("t", [0.0, 1.0, 2.5, 4.0, 5.5])
def test_drakes_linearize_is_the_exact_one(t: float) -> None:
    dynamics = StewartDynamics(PAPER)
    pose = PAPER.home + np.array([np.pi / 12] * 3 + [0.02, 0.02, 0.08]) * np.sin(t)
    plant = ExactPlant(dynamics, np.concatenate([pose, np.zeros(6)]))
    context = plant.CreateDefaultContext()
    plant.GetInputPort("torque").FixValue(context, dynamics.equilibrium_torque(pose))
    linear = Linearize(plant, context, equilibrium_check_tolerance=1e-6)
    A, B = dynamics.linearize(pose)
    np.testing.assert_allclose(linear.A(), A, atol=1e-12 * np.abs(A).max())
    np.testing.assert_allclose(linear.B(), B, atol=1e-12 * np.abs(B).max())


@pytest.mark.parametrize(
    ("scheme", "accuracy", "longest_step"),
    [
        ("runge_kutta5", 1e-2, 1.0),
        ("runge_kutta3", 1e-2, 1.0),
        ("runge_kutta5", 1e-8, 0.1),
        ("radau3", 1e-3, 0.1),
    ],
)
@pytest.mark.parametrize("seed", range(6))
def test_a_run_to_the_boundary_ends_with_time_leg_and_margin(
    scheme: str, accuracy: float, longest_step: float, seed: int
) -> None:
    """Pushed hard in a random direction, whatever the integrator: no NaN, no endless halving."""
    rng = np.random.default_rng(seed)
    dynamics = StewartDynamics(PAPER)
    start = np.concatenate([PAPER.home, rng.normal(0, [1, 1, 1, 0.2, 0.2, 0.2])])
    torque = dynamics.equilibrium_torque(PAPER.home) + rng.normal(0, 0.7, 6)
    time, state, evaluations = simulated(
        ExactPlant(dynamics), start, torque, 20.0, scheme, accuracy, longest_step
    )
    assert np.all(np.isfinite(state))
    assert evaluations < 20_000
    failure = diagnose(PAPER, time, state[POSE])
    assert failure is not None and 0 < failure.time == time < 20
    assert f"{time:.3f} s" in str(failure)
    if failure.leg is not None:
        assert standing(PAPER, state[POSE]).sines[failure.leg - 1] <= 0.0101
        assert abs(failure.margin) < 1e-3


def test_no_crank_changes_its_branch_unseen() -> None:
    """Loose integration with large steps ends at the same leg and time as a fine one."""
    dynamics = StewartDynamics(PAPER)
    torque = 1.2 * dynamics.equilibrium_torque(PAPER.home)
    plant = ExactPlant(dynamics)
    fine = simulated(plant, AT_HOME, torque, 20.0, longest_step=0.01)
    loose = simulated(plant, AT_HOME, torque, 20.0, accuracy=1e-2, longest_step=1.0)
    ends = [diagnose(PAPER, time, state[POSE]) for time, state, _ in (fine, loose)]
    assert ends[0] is not None and ends[1] is not None
    assert ends[0].leg == ends[1].leg is not None
    assert fine[0] == pytest.approx(loose[0], rel=1e-2)


def test_a_parallel_singularity_ends_the_run() -> None:
    """Rolled far over, the six rods come to lie in a linear complex and hold the plate no more."""
    direction = np.array([-0.8776, -0.0826, -0.4703, -0.0276, -0.0205, -0.0239])
    sign = np.sign(standing(PAPER, PAPER.home).parallel)
    start = np.concatenate([PAPER.home + 1.25 * direction, 3 * direction])
    assert standing(PAPER, start[POSE]).parallel * sign > 0
    plant = ExactPlant(StewartDynamics(PAPER, gravity=False))
    time, state, _ = simulated(plant, start, np.zeros(6), 1.0, accuracy=1e-8)
    failure = diagnose(PAPER, time, state[POSE])
    assert failure is not None and failure.leg is None
    assert failure.reason.startswith("parallel singularity")
    assert standing(PAPER, state[POSE]).sines.min() > 0.05  # every leg still reaches
