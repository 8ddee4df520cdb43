"""Innovations against the covariance of their model, and a servo's pulse against a simulation."""

import dataclasses

import numpy as np
import pytest

import stewart_drake as sd
from stewart_drake.identification.innovations import Innovations
from stewart_drake.identification.servo_fit import ServoModel
from stewart_drake.identification.servo_logs import ServoLog
from stewart_drake.identification.servo_plan import mixed_motion

ROBOT = sd.load_mechanism("reachy_mini")
DELAY = 0.04
SMOOTH = np.array([DELAY, 2.54, 0.095, 1e-6, 2.0, 0.0018, 0.0, 0.0])
"""Servos with next to no friction; all of their cranks are slow."""


def test_innovations_are_white():
    rng, number, rows, columns = np.random.default_rng(0), 12, 2, 3
    outputs = rng.standard_normal((number, rows, columns))
    maps = 0.5 * rng.standard_normal((number - 1, columns, columns))
    inputs = rng.standard_normal((number - 1, columns, 4))
    # Residuals r = R [w; v] of all inputs.
    size = 4 * (number - 1)
    R, x = np.zeros((number * rows, size)), np.zeros((columns, size))
    for k in range(number):
        R[rows * k : rows * (k + 1)] = outputs[k] @ x
        if k < number - 1:
            x = maps[k] @ x
            x[:, 4 * k : 4 * (k + 1)] += inputs[k]
    R = np.hstack([R, 0.3 * np.eye(number * rows)])
    e = Innovations(outputs, maps, inputs, 0.3)(R.reshape(number, rows, -1))
    flat = e.reshape(number * rows, -1)
    assert flat @ flat.T == pytest.approx(np.eye(number * rows), abs=1e-10)
    assert e[..., 0] == pytest.approx(
        Innovations(outputs, maps, inputs, 0.3)(R[:, 0].reshape(number, rows)), abs=1e-12
    )


def test_a_pulse_moves_the_cranks_as_in_a_simulation():
    motion = ROBOT.home + np.vstack(mixed_motion(np.repeat([0.1, 0.003], 3), 4.5, 0.02)[:2])
    setpoints = np.array([ROBOT.crank_angles(pose) for pose in motion])
    times = 0.02 * np.arange(len(setpoints))
    log = ServoLog("log", times, setpoints, setpoints, ROBOT.home[None])
    model, k, leg, torque = ServoModel(log, ROBOT, 0.8), 60, 2, 0.01
    pushed = setpoints.copy()
    pushed[k - round(DELAY / 0.02), leg] += torque / SMOOTH[1]
    other = dataclasses.replace(model, log=log._replace(setpoints=pushed))
    moved = other.residuals(SMOOTH) - model.residuals(SMOOTH)
    filtered = model.innovations(SMOOTH, 1e-3)
    first = int(np.argmax(model.counted))
    x, expected = np.zeros(12), np.zeros_like(moved)
    for row in range(k - first, len(moved) - 1):
        x = filtered.maps[row] @ x
        if row == k - first:
            x += filtered.inputs[row][:, leg] * torque / SMOOTH[3]
        expected[row + 1] = filtered.outputs[row + 1] @ x
    near = slice(k - first, k - first + 10)
    assert expected[near] == pytest.approx(moved[near], abs=0.03 * np.abs(moved).max())
    assert np.all(filtered.inputs.any(axis=1))
