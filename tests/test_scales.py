"""A machine of another size and mass, with everything in proportion, is controlled alike.

With lengths times s, masses times m and times as they are, inertias and torques go with m s^2 and
the equations of motion stay what they were. Any number with a unit in the law would show.
"""

import dataclasses

import numpy as np
import pytest

from stewart_drake.dynamics.stewart import StewartDynamics
from stewart_drake.law.riccati import full_gain
from stewart_drake.law.startup import machine_torque
from stewart_drake.loop import preparation as experiment_module
from stewart_drake.loop.simulation import simulate
from stewart_drake.mechanism.files import load_mechanism, mechanism_yaml
from stewart_drake.mechanism.geometry import Body, Link
from stewart_drake.scenario.loading import load_scenario
from tests.faults import written
from tests.mechanisms import PAPER
from tests.oracles import relative
from tests.test_riccati import STEPS, UNIT, delayed

SIZES = [(0.1, 1e-3), (0.01, 1e-6), (10.0, 1e3), (1.0, 100.0)]
"""Factors of length and mass; the second makes a crank of 1.1 mm and a plate of 4 mg."""
ON = ("start=on_reference", "queue=reference")


def scaled(s, m):
    def body(b):
        return Body(m * b.mass, m * s**2 * b.inertia)

    def link(b):
        return Link(m * b.mass, m * s**2 * b.inertia, b.center)

    return dataclasses.replace(
        PAPER,
        home=PAPER.home * np.repeat([1, s], 3),
        p_WS=s * PAPER.p_WS,
        p_PQ=s * PAPER.p_PQ,
        crank_lengths=s * PAPER.crank_lengths,
        rod_lengths=s * PAPER.rod_lengths,
        base=body(PAPER.base),
        plate=body(PAPER.plate),
        crank=link(PAPER.crank),
        rod=link(PAPER.rod),
        effort_limit=None,
    )


def shrink_motion(sc, s):
    for field in {"amplitude", "offset"} & set(vars(sc.reference)):  # a hold has one of them
        values = np.array(getattr(sc.reference, field)) * np.repeat([1, s], 3)
        setattr(sc.reference, field, values.tolist())


def run(monkeypatch, s, m, *settings):
    """Run on the exact plant; return the torques in units of m s^2, too."""
    sc = load_scenario("paper", None, ("plant.kind=exact", *settings))
    shrink_motion(sc, s)
    if sc.actuator.torque_limit is not None:
        sc.actuator.torque_limit *= m * s**2
    sc.plant.torque_bias = [m * s**2 * bias for bias in sc.plant.torque_bias]
    mechanism = scaled(s, m)
    monkeypatch.setattr(experiment_module, "load_mechanism", lambda _: mechanism)
    # Gravity goes with the lengths, as times stay.
    monkeypatch.setattr("stewart_drake.dynamics.stewart.DEFAULT_GRAVITY", 9.81 * s)
    result = simulate(sc, judge_stability=False)
    return result, result.signals.torque_commanded.values / (m * s**2)


CASES = {
    "from rest": ("duration=3",),
    "on the reference": (*ON, "duration=4"),
    "torque bias": (*ON, "duration=4", "plant.torque_bias=[3e-4, -3e-4, 3e-4, -3e-4, 3e-4, -3e-4]"),
    "torque limit": ("duration=3", "actuator.torque_limit=0.4"),
    "gravity": (*ON, "duration=2", "plant.gravity=true", "delay.steps=2", "controller.period=0.02"),
    "hold": (
        "reference.kind=hold",
        "duration=4",
        "plant.torque_bias=[1e-5, 0, 0, 0, 0, 0]",
        "delay.steps=2",
    ),
    "yaw alone": (*ON, "reference.amplitude=[0, 0, 0.2, 0, 0, 0]", "duration=3"),
}
AS_IT_IS = {}
"""Runs of the machine that is not scaled, by case, and their torques."""


@pytest.mark.slow
@pytest.mark.parametrize("case", CASES)
@pytest.mark.parametrize(("s", "m"), SIZES)
def test_a_scaled_machine_moves_alike(case, s, m, monkeypatch):
    """To six digits of the torques: the integrator's own tolerance is all that is not in scale."""
    if case not in AS_IT_IS:
        AS_IT_IS[case] = run(monkeypatch, 1.0, 1.0, *CASES[case])
    one, torques = AS_IT_IS[case]
    other, also = run(monkeypatch, s, m, *CASES[case])
    assert one.status == other.status == "completed"
    assert other.summary["counts"]["riccati_failures"] == 0
    assert other.summary["counts"] == one.summary["counts"]
    assert np.abs(also - torques).max() < 1e-5 * np.abs(torques).max()
    errors = (r.signals.error.values / np.repeat([1, z], 3) for r, z in ((one, 1.0), (other, s)))
    error, scaled_error = errors
    assert np.abs(scaled_error - error).max() < 1e-5 * np.abs(error).max() + 1e-12


@pytest.mark.parametrize(("s", "m"), SIZES)
def test_the_machines_torque_is_in_proportion(s, m):
    """And it is what inverse dynamics asks for: 2 cranks per s^2 along the axis that takes most."""
    expected = machine_torque(StewartDynamics(PAPER, False))
    found = machine_torque(StewartDynamics(scaled(s, m), True))
    assert found == pytest.approx(m * s**2 * expected, rel=1e-9)
    plant = StewartDynamics(PAPER, False)
    pushes = 2 * np.diag(np.repeat([1.0, 0.11], 3))
    torques = [plant.inverse_dynamics(PAPER.home, np.zeros(6), push) for push in pushes]
    assert expected == pytest.approx(np.abs(torques).max(), rel=1e-9)


def test_a_file_may_describe_a_machine_of_a_few_millimetres(tmp_path):
    s, m = 0.01, 1e-6
    path = written(tmp_path / "small.yaml", mechanism_yaml(scaled(s, m)))
    assert relative(load_mechanism(path).p_WS, scaled(s, m).p_WS) < 1e-12
    settings = ("plant.kind=exact", "duration=2", *ON)
    sc = load_scenario("paper", None, (f"mechanism={path}", *settings))
    one = simulate(load_scenario("paper", None, settings), judge_stability=False)
    shrink_motion(sc, s)
    result = simulate(sc, judge_stability=False)
    assert result.status == "completed"
    assert result.summary["counts"]["riccati_failures"] == 0
    # A_i is 2 amplitudes, but for rounding in the file all is the same.
    assert result.accumulated_error == pytest.approx(one.accumulated_error, rel=1e-6)


@pytest.mark.parametrize("fraction", [0.0, 0.5])
@pytest.mark.parametrize("steps", STEPS[:4])
@pytest.mark.parametrize("name", ["paper", "gravity"])
def test_units_change_no_gain(name, steps, fraction):
    """Metres or millimetres, N m or mN m: the gain in one unit follows from that in the other."""
    model, (Q, R) = delayed(name, steps, fraction), UNIT
    K, P = full_gain(model, Q, R)
    x, y = np.tile(np.repeat([1.0, 1e3], 3), 3), np.tile(np.repeat([1.0, 1e3], 3), 2)
    u = 1e6
    other = dataclasses.replace(
        model,
        A=model.A * x[:, None] / x,
        B_old=model.B_old * x[:, None] / u,
        B_new=model.B_new * x[:, None] / u,
        C=model.C * y[:, None] / x,
    )
    found, cost = full_gain(other, Q / np.outer(y, y), R / u**2)
    chain = np.concatenate([x, np.full(6 * model.queue_length, u)])
    assert relative(found * chain / u, K) < 1e-8
    assert relative(cost * np.outer(chain, chain), P) < 1e-8
