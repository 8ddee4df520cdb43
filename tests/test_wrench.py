"""A wrench on the plate, in both engines."""

import numpy as np
import pytest
from pydrake.autodiffutils import ExtractGradient, InitializeAutoDiff
from pydrake.math import RollPitchYaw
from pydrake.systems.analysis import Simulator

import stewart_drake as sd
from stewart_drake.loop.exact import ExactPlant, set_accuracy
from stewart_drake.loop.platforms import MultibodyStewart
from stewart_drake.scenario.signals import NUM_CONSTANTS

PAPER = sd.load_mechanism("paper")
POSE0 = PAPER.home + np.array([0.1, -0.15, 0.2, 0.01, -0.02, 0.015])
RATES0 = np.array([0.3, -0.4, 0.5, 0.1, -0.2, 0.15])
WRENCH = np.array([0.3, -0.2, 0.4, 2.0, -3.0, 4.0])


def test_torques_of_virtual_work_balance_a_wrench():
    """At rest, no gravity: T . d alpha + F . dx = 0 for any dx, with d alpha by differences."""
    step, columns = 1e-6, []
    for unit in np.eye(6):
        ahead, behind = (PAPER.crank_angles(POSE0 + sign * step * unit) for sign in (1, -1))
        columns.append((ahead - behind) / (2 * step))
    # A small turn dx of roll, pitch, yaw is the rotation vector E dx.
    angles = [np.array(_rotation_vector(POSE0, unit)) for unit in np.eye(3)]
    work = np.concatenate([np.array(angles) @ WRENCH[:3], WRENCH[3:]])
    torque = -np.linalg.solve(np.array(columns), work)
    dynamics = sd.StewartDynamics(PAPER, gravity=False)
    found = dynamics.accelerations(POSE0, np.zeros(6), torque)
    scale = np.abs(found).max()
    found = found + dynamics.wrench_accelerations(POSE0, WRENCH)
    assert scale > 1 and np.abs(found).max() < 1e-7 * scale
    constants = dynamics.plant_parameters[:NUM_CONSTANTS]
    pushed = sd.StewartDynamics(PAPER, False, np.concatenate([constants, WRENCH]))
    assert np.abs(pushed.accelerations(POSE0, np.zeros(6), torque)).max() < 1e-7 * scale
    np.testing.assert_allclose(pushed.equilibrium_torque(POSE0), torque, rtol=1e-7)


def _rotation_vector(pose, unit):
    """d R R' by differences, as a vector."""
    step = 1e-6
    ahead, behind = (
        RollPitchYaw(pose[:3] + sign * step * unit).ToRotationMatrix().matrix() for sign in (1, -1)
    )
    here = RollPitchYaw(pose[:3]).ToRotationMatrix().matrix()
    w = (ahead - behind) / (2 * step) @ here.T
    return [w[2, 1], w[0, 2], w[1, 0]]


def test_a_weight_hung_on_the_plate_at_rest_is_a_payload():
    heavy = sd.StewartDynamics(PAPER, True, [0] * 6 + [0.7, 0])
    torque = heavy.equilibrium_torque(POSE0)
    light = sd.StewartDynamics(PAPER)
    found = light.accelerations(POSE0, np.zeros(6), torque)
    assert np.abs(found).max() > 1
    found += light.wrench_accelerations(POSE0, [0, 0, 0, 0, 0, -0.7 * 9.81])
    np.testing.assert_allclose(found, 0, atol=1e-9)


@pytest.mark.parametrize("gravity", [False, True])
def test_power_of_a_wrench_is_what_the_energy_gains(gravity):
    dynamics = sd.StewartDynamics(PAPER, gravity)
    torque = np.array([0.1, -0.2, 0.05, 0.1, -0.1, 0.2])
    a = dynamics.accelerations(POSE0, RATES0, torque)
    a += dynamics.wrench_accelerations(POSE0, WRENCH)
    h = 1e-6

    def energy(t):
        return dynamics.energy(POSE0 + t * RATES0 + t**2 / 2 * a, RATES0 + t * a)

    gained = (energy(h) - energy(-h)) / (2 * h)
    w = sum(
        rate * np.array(_rotation_vector(POSE0, e))
        for rate, e in zip(RATES0[:3], np.eye(3), strict=True)
    )
    by_wrench = WRENCH[:3] @ w + WRENCH[3:] @ RATES0[3:]
    by_motors = torque @ (PAPER.jacobian(POSE0) @ RATES0)
    assert gained == pytest.approx(by_wrench + by_motors, rel=1e-6)


def test_both_engines_agree_under_a_wrench():
    """The multibody one converges to the exact one, to first order in its step."""
    until, errors = 0.05, []
    torque = np.array([0.02, -0.01, 0.03, 0.01, -0.02, 0.01])
    start = np.concatenate([POSE0, 0.1 * RATES0])

    def run(plant):
        context = plant.CreateDefaultContext()
        plant.set_state(context, start)
        plant.GetInputPort("torque").FixValue(context, torque)
        plant.GetInputPort("wrench").FixValue(context, WRENCH)
        simulator = Simulator(plant, context)
        if isinstance(plant, ExactPlant):
            set_accuracy(simulator, 1e-10)
        simulator.AdvanceTo(until)
        return plant.GetOutputPort("state").Eval(context)

    exact = run(ExactPlant(sd.StewartDynamics(PAPER, gravity=False), wrench=True))
    moved = np.abs(exact - start).max()
    for step in (1e-3, 5e-4, 2.5e-4):
        errors.append(
            np.abs(run(MultibodyStewart(PAPER, step, gravity=False, wrench=True)) - exact)
        )
    sizes = [error.max() for error in errors]
    assert sizes[0] < 0.1 * moved
    assert sizes[0] / sizes[1] == pytest.approx(2, rel=0.15)
    assert sizes[1] / sizes[2] == pytest.approx(2, rel=0.15)


def test_unconnected_wrench_is_none_at_all():
    dynamics = sd.StewartDynamics(PAPER)
    changes = []
    for plant in (ExactPlant(dynamics), ExactPlant(dynamics, wrench=True)):
        context = plant.CreateDefaultContext()
        plant.GetInputPort("torque").FixValue(context, np.full(6, 0.1))
        changes.append(plant.EvalTimeDerivatives(context).CopyToVector())
    np.testing.assert_array_equal(*changes)


def test_gradients_with_a_wrench_agree_with_differences():
    dynamics = sd.StewartDynamics(PAPER)
    start = np.concatenate([POSE0, RATES0])
    torque = np.full(6, 0.1)

    def change(x, tau, wrench):
        plant = ExactPlant(dynamics, wrench=True)
        context = plant.CreateDefaultContext()
        context.SetContinuousState(x)
        plant.GetInputPort("torque").FixValue(context, tau)
        plant.GetInputPort("wrench").FixValue(context, wrench)
        return plant.EvalTimeDerivatives(context).CopyToVector()

    at = np.concatenate([start, torque, WRENCH])
    differences = []
    for unit in np.eye(24):
        ahead, behind = (change(*np.split(at + sign * 1e-6 * unit, [12, 18])) for sign in (1, -1))
        differences.append((ahead - behind) / 2e-6)

    plant = ExactPlant(dynamics, wrench=True).ToAutoDiffXd()
    context = plant.CreateDefaultContext()
    x, tau, wrench = np.split(InitializeAutoDiff(at).ravel(), [12, 18])
    context.SetContinuousState(x)
    plant.GetInputPort("torque").FixValue(context, tau)
    plant.GetInputPort("wrench").FixValue(context, wrench)
    found = ExtractGradient(plant.EvalTimeDerivatives(context).CopyToVector())
    scale = np.abs(found).max()
    np.testing.assert_allclose(found, np.array(differences).T, atol=1e-7 * scale)
