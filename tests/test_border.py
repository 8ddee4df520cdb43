"""The public border: shapes and values that are refused, and what can be copied and sent."""

import copy
import pickle

import numpy as np
import pytest

import stewart_drake as sd
from stewart_drake.files.errors import ConfigError
from tests.mechanisms import PAPER

HOME, REST = PAPER.home, np.zeros(6)
DYNAMICS = sd.StewartDynamics(PAPER, gravity=True, parameters=np.linspace(0.0, 0.07, 8))


@pytest.mark.parametrize("wrong", [0.0, [0.0], np.zeros(5), np.zeros((6, 1)), np.zeros((1, 6))])
@pytest.mark.parametrize(
    ("method", "good"),
    [
        ("accelerations", (HOME, REST, REST)),
        ("inverse_dynamics", (HOME, REST, REST)),
        ("energy", (HOME, REST)),
        ("mass_matrix", (HOME,)),
        ("bias", (HOME, REST)),
        ("actuation_map", (HOME,)),
        ("equilibrium_torque", (HOME,)),
        ("derivatives", (HOME, REST, REST)),
        ("linearize", (HOME, REST, REST)),
        ("predict", (np.append(HOME, REST), np.zeros((2, 6)), [0.1, 0.1])),
    ],
)
def test_one_number_does_not_stand_for_six(method, good, wrong):
    call = getattr(DYNAMICS, method)
    call(*good)
    call(*(np.asarray(argument).tolist() for argument in good))
    for place in range(len(good)):
        if method == "predict" and place == 2 and np.ndim(wrong) == 0:
            continue  # one duration is for all
        with pytest.raises(ValueError, match=r"^\w+: got shape .*; expected \(") as refused:
            call(*good[:place], wrong, *good[place + 1 :])
        assert "\n" not in str(refused.value)


@pytest.mark.parametrize(
    ("name", "value"),
    [
        *(("gravity", value) for value in (np.nan, [9.81, 0.0], "down", None)),
        *(("parameters", value) for value in (0.0, np.zeros(7), np.full(8, np.nan), "none")),
    ],
)
def test_arguments_of_the_dynamics_are_checked(name, value):
    with pytest.raises(ConfigError, match=rf"^{name}: got .*; expected"):
        sd.StewartDynamics(PAPER, **{name: value})
    with pytest.raises(ValueError, match=r"parameters: got shape \(\); expected \(8,\)"):
        DYNAMICS.accelerations(HOME, REST, REST, 0.0)


@pytest.mark.parametrize("wrong", [0.38, np.zeros((2, 6))])
def test_a_pose_has_six_coordinates(wrong):
    for method in (PAPER.crank_angles, PAPER.reach_margins, PAPER.jacobian):
        with pytest.raises(ValueError, match=r"^pose: got shape .*; expected \(6,\), \[roll"):
            method(wrong)
    with pytest.raises(ValueError, match=r"^crank_angles: got shape"):
        PAPER.forward_kinematics(wrong)
    with pytest.raises(ValueError, match=r"^guess: got shape"):
        PAPER.forward_kinematics(REST, wrong)


# Copies.


def work(dynamics):
    rates, torque = np.linspace(-0.1, 0.1, 6), np.linspace(0.0, 0.5, 6)
    return [
        dynamics.accelerations(HOME, rates, torque),
        dynamics.inverse_dynamics(HOME, rates, torque),
        *dynamics.derivatives(HOME, rates, torque),
        dynamics.predict(np.append(HOME, rates), np.tile(torque, (3, 1)), 0.01),
    ]


@pytest.mark.parametrize(
    "again", [copy.copy, copy.deepcopy, lambda d: pickle.loads(pickle.dumps(d))]
)
def test_a_copy_of_the_dynamics_is_as_good(again):
    for dynamics in (DYNAMICS, sd.StewartDynamics(PAPER, gravity=1.62)):
        other = again(dynamics)
        assert other is not dynamics and other.mechanism == PAPER
        assert hash(other.mechanism) == hash(PAPER)
        assert other.gravity == dynamics.gravity
        for a, b in zip(work(dynamics), work(other), strict=True):
            np.testing.assert_array_equal(a, b)
        other.parameters[0] = 7.0
        assert dynamics.parameters[0] == 0.0


@pytest.mark.parametrize("given", [None, 3, {"duration": 1.0}])
@pytest.mark.parametrize("function", [sd.simulate, sd.build_closed_loop, sd.analyze_delay])
def test_a_function_says_which_scenarios_it_takes(function, given):
    with pytest.raises(TypeError, match=r"^scenario: got a .*; expected a Scenario, or the name"):
        function(given)
