"""Limits that a delay sets: closed forms, simulations, python-control."""

import math

import control
import numpy as np
import pytest
from pydrake.systems.analysis import ApplySimulatorConfig, Simulator, SimulatorConfig

import stewart_drake as sd
from stewart_drake.law.delay_model import (
    LinearModel,
    chain,
    delayed_model,
    double_integrators,
    linear_model,
)
from stewart_drake.law.stability import (
    amplification,
    closed_loop,
    fastest_pole,
    first_instability,
    largest_delay,
    loop_gain,
    peaks,
    sensitivity,
    spectral_radius,
)
from stewart_drake.loop.exact import ExactPlant
from stewart_drake.loop.results import delay_floor
from stewart_drake.mechanism.assembly import torque_map
from stewart_drake.mechanism.trajectories import evaluate
from stewart_drake.studies.delay import loop_margins, simulated_growth
from stewart_drake.studies.verdict import assess
from tests.mechanisms import PAPER
from tests.oracles import augmented_gain

HEAVY = sd.StewartDynamics(PAPER, gravity=True)


def found(*settings):
    return assess(sd.load_scenario("paper", settings=("plant.kind=exact", *settings)))


# ------------------------------------------------------------------ open loop


@pytest.mark.parametrize("time", [0.0, 0.7, 1.6, 2.5, 4.4])
def test_poles_are_those_of_central_differences(time):
    pose = evaluate(found().experiment.reference, time)[:6]
    torque = HEAVY.equilibrium_torque(pose)
    A = np.zeros((12, 12))
    h = 1e-5
    for k in range(12):
        step = h * np.eye(12)[k]
        ends = [np.concatenate([pose, np.zeros(6)]) + sign * step for sign in (1, -1)]
        rates = [np.concatenate([x[6:], HEAVY.accelerations(x[:6], x[6:], torque)]) for x in ends]
        A[:, k] = (rates[0] - rates[1]) / (2 * h)
    expected = np.linalg.eigvals(A).real.max()
    assert expected > 3
    assert fastest_pole(HEAVY.linearize(pose)[0]) == pytest.approx(expected, rel=1e-5)


@pytest.mark.parametrize(("time", "eta"), [(0.0, 0.8), (0.7, 0.3), (1.6, 0.2)])
def test_a_prediction_error_grows_by_e_to_the_pole_times_the_delay(time, eta):
    """Two runs of the exact plant in Drake's Simulator, 1e-7 apart along the fastest mode."""
    pose = evaluate(found().experiment.reference, time)[:6]
    torque = HEAVY.equilibrium_torque(pose)
    values, vectors = np.linalg.eig(HEAVY.linearize(pose)[0])
    at = values.real.argmax()
    pole, mode = values[at].real, vectors[:, at].real
    plant = ExactPlant(HEAVY)
    ends = []
    for sign in (1, -1):
        context = plant.CreateDefaultContext()
        plant.GetInputPort("torque").FixValue(context, torque)
        start = np.concatenate([pose, np.zeros(6)]) + sign * 1e-7 * mode
        context.SetContinuousState(start)
        simulator = Simulator(plant, context)
        config = SimulatorConfig(integration_scheme="runge_kutta5", accuracy=1e-12)
        ApplySimulatorConfig(config, simulator)
        simulator.AdvanceTo(eta)
        ends.append(context.get_continuous_state_vector().CopyToVector())
    growth = np.linalg.norm(ends[0] - ends[1]) / (2e-7 * np.linalg.norm(mode))
    assert growth > 20
    assert growth == pytest.approx(amplification(pole, eta), rel=0.05)
    expected, simulated = simulated_growth(HEAVY, pose, eta, 1e-6)
    assert expected == pytest.approx(amplification(pole, eta))
    assert simulated == pytest.approx(growth, rel=0.05)


def test_amplification_and_largest_delay_undo_each_other():
    for pole in (0.5, 5.0, 36.0):
        for tolerable in (2.0, 10.0, 1e3):
            delay = largest_delay(pole, tolerable)
            assert amplification(pole, delay) == pytest.approx(tolerable, rel=1e-12)
    assert largest_delay(0.0, 2.0) == math.inf
    assert amplification(0.0, 5.0) == 1
    assert amplification(1e3, 1e3) == math.inf
    assert fastest_pole(np.diag([-1.0, 1e-9])) == 0


@pytest.mark.parametrize(("eta", "frequency"), [(0.8, 1.0), (0.4, 2.0), (1.5, 0.5)])
def test_floor_of_a_sine_is_the_closed_form(eta, frequency):
    """50 (1 - cos(w eta)) / w: 15.16 % s for the paper's delay."""
    expected = 50 * (1 - math.cos(frequency * eta)) / frequency
    experiment = found(f"reference.frequency={frequency}").experiment
    floor = delay_floor(experiment.reference, experiment.scale, eta)
    assert floor == pytest.approx(expected, rel=1e-6)


# ------------------------------------------------------------------ closed loop


def loop(steps, fraction=0.0):
    """Two coupled masses, one unstable, with their LQI gain."""
    stiffness, zero = np.array([[1.0, 0.3], [-0.2, -0.5]]), np.zeros((2, 2))
    A = np.block([[zero, np.eye(2)], [stiffness, -0.1 * np.eye(2)]])
    B = np.vstack([zero, [[1.0, 0.2], [-0.4, 2.0]]])
    continuous = LinearModel(A, B, np.eye(2, 4))
    model = delayed_model(continuous, 0.2, steps, fraction, integral=True)
    return model, augmented_gain(model, np.eye(4), 0.1 * np.eye(2))


@pytest.mark.parametrize(("steps", "fraction"), [(0, 0.0), (3, 0.0), (0, 0.4), (2, 0.7)])
def test_closed_loop_is_that_of_the_chain(steps, fraction):
    model, K = loop(steps, fraction)
    augmented = chain(model)
    assert closed_loop(model, K) == pytest.approx(augmented.A - augmented.B @ K, abs=1e-14)


def run(model, K, disturbance, gain=1.0):
    """Return the loop torque by torque: commanded (k, m) and the state at the end."""
    n, m = model.B_new.shape
    e, sent = np.zeros(n), np.zeros((len(disturbance) + 50, m))
    e[0] = 1e-3
    length = (K.shape[1] - n) // m
    for k in range(50, len(sent)):
        queue = sent[k - length : k].ravel()
        sent[k] = -K @ np.concatenate([e, queue])
        acting = gain * sent + np.vstack([np.zeros((50, m)), disturbance])
        old, new = acting[k - model.steps - 1], acting[k - model.steps]
        e = model.A @ e + model.B_old @ old + model.B_new @ new
    return sent[50:], e


@pytest.mark.parametrize(("steps", "fraction"), [(0, 0.0), (3, 0.0), (2, 0.7)])
def test_sensitivity_is_what_a_simulated_disturbance_of_a_motor_shows(steps, fraction):
    """In steady state the torque acting is S times the disturbance, the commanded one -T times."""
    model, K = loop(steps, fraction)
    omega, direction = 3.0, np.array([1.0, -0.5])
    k = np.arange(400)
    commanded, _ = run(model, K, np.sin(omega * 0.2 * k)[:, None] * direction)
    z = np.exp(1j * omega * 0.2)
    S = sensitivity(loop_gain(model, K, np.array([z])))[0]
    expected = np.imag(((S - np.eye(2)) @ direction)[None] * np.exp(1j * omega * 0.2 * k)[:, None])
    assert commanded[300:] == pytest.approx(expected[300:], abs=1e-6)


@pytest.mark.parametrize("steps", [0, 2, 5])
def test_margins_of_one_motor_agree_with_python_control(steps):
    """A double integrator: eigenvalues against its transfer function's crossings."""
    continuous = LinearModel(np.eye(2, k=1), np.array([[0.0], [1.0]]), np.eye(1, 2))
    model = delayed_model(continuous, 0.1, steps, 0.0, integral=False)
    K = augmented_gain(model, np.eye(1), np.eye(1))
    P = control.ss(model.A, model.B_new, K[:, :2], 0, 0.1)
    memory = np.concatenate([[1.0], K[0, 2:][::-1]])  # 1 + sum K_i z^-i
    lag = control.tf([1.0], [1.0] + steps * [0.0], 0.1)
    filter_ = control.tf([1.0] + steps * [0.0], memory, 0.1)
    L = control.tf(P) * lag * filter_
    gains, *_ = control.stability_margins(L, returnall=True, method="poly")
    up = first_instability(lambda by: closed_loop(model, K, 1 + by), 1e-3, 1e3)
    at_nyquist = -1 / L(-1.0).real  # which python-control leaves out
    crossings = np.append(gains, at_nyquist)
    assert 1 + up == pytest.approx(min(crossings[crossings > 1.001]), rel=2e-3)
    S, T = peaks(model, K, 0.1)
    omega = np.linspace(0.01, 31.4, 200_000)
    value = np.abs(1 / (1 + L(np.exp(0.1j * omega))))
    assert S.value == pytest.approx(value.max(), rel=1e-5)
    assert 1 / T.value <= up * 1.001


def test_a_wrong_gain_of_the_motors_is_what_the_recurrence_shows():
    model, K = loop(3)
    limit = first_instability(lambda by: closed_loop(model, K, 1 + by), 1e-3, 10.0)
    quiet = np.zeros((3000, 2))
    inside = np.abs(run(model, K, quiet, 1 + 0.97 * limit)[1]).max()
    outside = np.abs(run(model, K, quiet, 1 + 1.03 * limit)[1]).max()
    assert inside < 1e-3 < outside


def test_a_longer_delay_is_the_delayed_model_with_that_delay():
    """Delay that the gain does not know of adds places to the loop, no more."""
    model, K = loop(2)
    later, _ = loop(4, 0.5)
    A = closed_loop(later, K)
    assert A.shape == (6 + 5 * 2,) * 2
    assert spectral_radius(closed_loop(model, K)) < 1 < spectral_radius(A)
    end = np.abs(run(later, K, np.zeros((300, 2)))[1]).max()
    assert end > 1e3


def margins(*settings, steps=8):
    case = found(f"delay.steps={steps}", *settings)
    return next(m for m in loop_margins(case, ()) if m.steps == steps)


def test_margins_of_the_papers_loop():
    """Those of docs/theory.md, section 13: 1.6 and 1.9 ms, and with tolerance 1 38 and 40 ms."""
    tight, loose = margins(), margins("controller.w_R=1111.1111")
    assert 1e3 * tight.margins.longer == pytest.approx(1.6, abs=0.05)
    assert 1e3 * tight.margins.shorter == pytest.approx(1.9, abs=0.05)
    assert 1e3 * loose.margins.longer == pytest.approx(38, abs=0.5)
    assert 1e3 * loose.margins.shorter == pytest.approx(40, abs=0.5)
    for m in (tight, loose):
        least = min(m.margins.gain_up - 1, 1 - m.margins.gain_down)
        assert 1 / m.T.value <= least * 1.001  # the small-gain bound
        assert m.motor is not None
        assert m.motor.gain_up >= m.margins.gain_up  # six wrong motors are worse than one
        # |S| bounds both classical margins of each motor from below.
        assert m.motor.gain_up >= m.S.value / (m.S.value - 1) * 0.999
        assert np.deg2rad(m.motor.phase) >= 2 * np.arcsin(0.5 / m.S.value) * 0.999


def test_the_faithful_controller_is_unstable_on_the_true_plant():
    """Its model has twice the true accelerations, through eight torques in flight."""
    scenario = sd.load_scenario("paper", "delay_lqi", ("plant.kind=exact",))
    (m,) = loop_margins(assess(scenario), ())
    assert m.radius > 1.3
    assert m.margins.longer == m.margins.shorter == 0
    assert m.motor is None
    assert math.isnan(m.S.value)


@pytest.mark.parametrize(
    ("controller", "weight", "radius"),
    [
        ("delay_lqr", 1e-4, 0.990),
        ("delay_lqi", 1e-6, 0.996),
        ("delay_lqi", 1e-4, 1.011),
        ("delay_lqi", 1.0, 1.356),
    ],
)
def test_weights_that_hardly_act_keep_the_faithful_controllers_stable(controller, weight, radius):
    """A separate eigenvalue problem at mu = 8; w_Q = w_R is unstable for every mu."""
    integral = controller == "delay_lqi"
    models = [
        delayed_model(model, 0.1, 8, integral=integral)
        for model in (
            double_integrators(torque_map(PAPER, PAPER.home)),
            linear_model(*sd.StewartDynamics(PAPER, gravity=False).linearize(PAPER.home)),
        )
    ]
    K = augmented_gain(models[0], weight * np.eye(12 if integral else 6), np.eye(6))
    true = chain(models[1])
    found = np.abs(np.linalg.eigvals(true.A - true.B @ K)).max()
    assert found == pytest.approx(radius, abs=1e-3)
    settings = ("plant.kind=exact", f"controller.w_Q={weight}")
    (m,) = loop_margins(assess(sd.load_scenario("paper", controller, settings)), ())
    assert m.radius == pytest.approx(found, rel=1e-6)
