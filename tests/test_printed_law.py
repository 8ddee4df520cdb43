"""The paper's law where nothing but the law is in question: its own map as plant, frozen at home.

The plant is x'' = B T, which is the controller's model to the last digit, without limits; the loop
is written out here, sample by sample, and shares only matrices with the package.
"""

import functools
import math

import numpy as np
import pytest
from scipy.linalg import expm

from stewart_drake.law.delay_model import DelayedModel, delayed_model, double_integrators
from stewart_drake.loop.results import accumulated_error
from stewart_drake.mechanism.assembly import torque_map
from tests.mechanisms import PAPER
from tests.oracles import augmented_gain

AMPLITUDE = np.array([math.pi / 12] * 3 + [0.02, 0.02, 0.08])
PERIOD, STEPS, PARTS = 0.1, 8, 5
B = torque_map(PAPER, PAPER.home)


def sampled_as_printed(model):
    """By (35), z is sampled like any other state of (24)."""
    A = np.zeros((24, 24))
    A[:6, 6:12] = A[12:18, :6] = np.eye(6)
    A[6:12, 18:] = B
    both = expm(A * PERIOD)
    zero = np.zeros((18, 6))
    return DelayedModel(both[:18, :18], zero, both[:18, 18:], model.C, STEPS, 0.0)


@functools.cache
def error(ratio, *, integral, rest=False, printed_z=False, share=1.0):
    """E_ac in % s of (46) over 10 s with w_Q/w_R = ratio, with the torques for it in flight.

    The integral counts by `share` of what the error does.
    """
    model = delayed_model(double_integrators(B), PERIOD, STEPS, integral=integral)
    if printed_z:
        model = sampled_as_printed(model)
    Q = ratio * np.diag([1.0] * 6 + [share] * 6 * integral)
    K = augmented_gain(model, Q, np.eye(6))
    x, v, z = np.zeros(6), np.zeros(6) if rest else AMPLITUDE, np.zeros(6)
    # Mean of the torque that the reference takes, over each of the holds in flight.
    change = np.diff(np.cos(PERIOD * np.arange(STEPS + 1)))
    needed = np.outer(change / PERIOD, np.linalg.solve(B, AMPLITUDE))
    queue = list(np.zeros_like(needed) if rest else needed)
    before, errors = None, []
    fine = PERIOD / PARTS * np.arange(PARTS)[:, None]
    for t in PERIOD * np.arange(100):
        pose = x - AMPLITUDE * math.sin(t)
        if before is not None and not printed_z:
            z = z + PERIOD / 2 * (before + pose)
        before = pose
        state = (
            [pose, v - AMPLITUDE * math.cos(t), z]
            if integral
            else [pose, v - AMPLITUDE * math.cos(t)]
        )
        queue.append(-K @ np.concatenate([*state, *queue]))
        a = B @ queue.pop(0)
        errors.append(x + fine * v + fine**2 / 2 * a - AMPLITUDE * np.sin(t + fine))
        if printed_z:  # the integral itself
            held = PERIOD * x + PERIOD**2 / 2 * v + PERIOD**3 / 6 * a
            z = z + held - AMPLITUDE * (math.cos(t) - math.cos(t + PERIOD))
        x, v = x + PERIOD * v + PERIOD**2 / 2 * a, v + PERIOD * a
    errors.append(x[None] - AMPLITUDE * math.sin(10))
    time = np.linspace(0, 10, 100 * PARTS + 1)
    return accumulated_error(time, np.vstack(errors), 2 * AMPLITUDE)


def test_motors_that_are_off_cost_308():
    """Entry 12: 50 times the integral of |sin t| over 10 s, three half waves and a rest."""
    time = np.linspace(0, 10, 501)
    resting = np.outer(np.sin(time), AMPLITUDE)
    by_hand = 50 * (6 + 1 - math.cos(10 - 3 * math.pi))
    assert by_hand == pytest.approx(308, abs=0.1)
    assert accumulated_error(time, resting, 2 * AMPLITUDE) == pytest.approx(by_hand, rel=1e-3)


def test_no_weights_make_the_printed_law_follow_a_sine():
    """Entry 12: E_ac falls with the gain towards what the missing acceleration leaves."""
    ratios = 10.0 ** np.arange(7)
    for integral, least in ((False, 119), (True, 99)):
        found = [error(r, integral=integral) for r in ratios]
        assert np.all(np.diff(found) < 0)
        assert found[-1] == pytest.approx(least, abs=0.5)
        assert found[-2] - found[-1] < 2
        from_rest = [error(r, integral=integral, rest=True) for r in ratios]
        assert min(from_rest) == pytest.approx({119: 147, 99: 144}[least], abs=0.6)


def test_at_high_gain_the_plate_goes_where_the_tangent_leads():
    """Entry 12: x(t + eta) = x_d(t) + eta dx_d/dt, 1.28 of the amplitude and 0.314 of it off."""
    eta = PERIOD * STEPS
    assert math.hypot(1, eta) == pytest.approx(1.28, abs=0.005)
    missed = abs(np.exp(1j * eta) - 1 - 1j * eta)
    assert missed == pytest.approx(0.314, abs=5e-4)
    # Of a sine with that error the magnitude's mean is 2/pi of it: E_ac = 50 x 10 s x 0.2.
    assert 500 * 2 / math.pi * missed == pytest.approx(error(1e6, integral=False), rel=0.2)


def test_the_recurrence_of_the_integral_does_no_harm():
    """Entry 23: trapezoids against the integral itself, in the model and in the controller."""
    trapezoid, printed = error(3.0, integral=True), error(3.0, integral=True, printed_z=True)
    assert trapezoid == pytest.approx(191.7, abs=0.05)
    assert printed == pytest.approx(trapezoid, rel=1e-3)
