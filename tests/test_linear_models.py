"""Linear models for python-control: conventions, closed forms, and what the margins say."""

import control
import numpy as np
import pytest

import stewart_drake as sd
from stewart_drake.files.errors import ConfigError
from stewart_drake.law.delay_model import LinearModel
from stewart_drake.law.stability import LinearLoop, loop_gain, sensitivity, spectral_radius
from stewart_drake.loop.controller_margin import controller_margin, loop_at, state_spaces
from stewart_drake.loop.preparation import prepare
from stewart_drake.scenario.timing import Delay

OMEGA = np.geomspace(0.05, 30, 40)


def at(system, omega, period):
    return system(np.exp(1j * omega * period))


def test_double_integrator_in_closed_form():
    """L = (k1 h^2/2 (z + 1) + k2 h (z - 1)) / (z - 1)^2 z^-mu / (1 + k3 z^-1) by hand."""
    h, k1, k2, k3 = 0.1, 2.0, 3.0, 0.4
    plant = LinearModel(np.array([[0.0, 1], [0, 0]]), np.array([[0.0], [1]]), np.eye(1, 2))
    loop = LinearLoop(plant, np.array([[k1, k2, k3]]), h, Delay(1), integral=False)
    models = state_spaces(loop)
    for omega in OMEGA:
        z = np.exp(1j * omega * h)
        L = (k1 * h**2 / 2 * (z + 1) + k2 * h * (z - 1)) / (z - 1) ** 2 / z / (1 + k3 / z)
        assert models.loop(z) == pytest.approx(L, rel=1e-9)
        assert models.S(z) == pytest.approx(1 / (1 + L), rel=1e-9)
        assert models.T(z) == pytest.approx(L / (1 + L), rel=1e-9)


@pytest.mark.parametrize(
    ("controller", "settings"),
    [
        ("predictor_lqi", ()),
        ("delay_lqr", ("delay.fraction=0.3",)),
        ("lqi", ("delay.steps=3",)),
        ("delay_lqi", ("controller.delay_steps=2", "delay.steps=0", "delay.fraction=0.5")),
    ],
)
def test_they_are_the_loop_that_the_margins_judge(controller, settings):
    experiment = prepare(sd.load_scenario("paper", controller, settings))
    loop = loop_at(experiment, 2.0)
    models, h = state_spaces(loop, 2.0), loop.period
    for omega in OMEGA[np.pi / h > OMEGA][::4]:
        z = np.array([np.exp(1j * omega * h)])
        L = loop_gain(loop.sampled(), loop.K, z)
        size = np.abs(L).max()
        np.testing.assert_allclose(at(models.loop, omega, h), L[0], atol=1e-8 * size)
        S = sensitivity(L)[0]
        np.testing.assert_allclose(at(models.S, omega, h), S, atol=1e-7 * np.abs(S).max())
        np.testing.assert_allclose(
            at(models.T, omega, h), np.eye(6) - S, atol=1e-7 * np.abs(S).max()
        )
        law, plant = at(models.law, omega, h), at(models.plant, omega, h)
        np.testing.assert_allclose(-law @ plant, L[0], atol=1e-8 * size)
    radius = np.abs(models.S.poles()).max()
    assert radius == pytest.approx(spectral_radius(loop.matrix()), rel=1e-6)


def test_a_delay_that_is_estimated_has_been_found():
    """The models are the loop that the margins judge, for any delay assumed at first."""
    wrong = ("controller.delay_steps=4",)
    experiment = prepare(sd.load_scenario("paper", "adaptive_lqi", wrong))
    judged = controller_margin(experiment)
    radius = spectral_radius(loop_at(experiment, judged.time).matrix())
    assert radius == pytest.approx(judged.radius, rel=1e-9)


def test_gain_margin_of_the_models_is_that_of_the_summary():
    experiment = prepare(sd.load_scenario("paper"))
    margin = controller_margin(experiment)
    models = sd.linear_models("paper")
    assert models.time == margin.time
    loop = state_spaces(loop_at(experiment, margin.time))
    assert np.abs(loop.S.poles()).max() == pytest.approx(margin.radius, rel=1e-6)
    # The margins are the least along the reference: here the loop bears at least as much.
    for gain in (margin.margins.gain_up, margin.margins.gain_down):
        inside = 1 + 0.98 * (gain - 1)
        closed = control.feedback(inside * models.loop, np.eye(6))
        assert np.abs(closed.poles()).max() < 1
    found = [
        np.abs(control.feedback(margin.margins.gain_up * 1.02 * one.loop, np.eye(6)).poles()).max()
        for one in (state_spaces(loop) for loop in margin.loops)
    ]
    assert max(found) > 1, "some loop on the way is the one whose margin that is"


def test_names_and_period():
    for outside in (-1.0, 10.5, float("nan")):
        with pytest.raises(ConfigError, match="time: got"):
            sd.linear_models("paper", outside)
    models = sd.linear_models("paper", 1.0)
    assert models.plant.input_labels == [f"torque_{leg}" for leg in range(1, 7)]
    assert models.plant.output_labels[0] == "error_phi"
    assert models.plant.output_labels[-1] == "integral_z"
    assert models.law.input_labels == models.plant.output_labels
    assert models.loop.dt == 0.1
    assert repr(models).startswith("LinearModels(at t = 1 s, loop of ")
