"""The reference governor, against brute force."""

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from stewart_drake.dynamics.stewart import StewartDynamics
from stewart_drake.dynamics.workspace import margin
from stewart_drake.live.governor import (
    FASTEST,
    LEAST_MARGIN,
    PACE,
    TORQUE_SHARE,
    Governor,
    GovernorState,
    response,
    stop_pose,
)
from stewart_drake.mechanism.files import load_mechanism
from stewart_drake.mechanism.trajectories import evaluate, make_reference
from stewart_drake.scenario.reference_config import SineConfig
from stewart_drake.scenario.signals import ACCELERATIONS, POSE, RATES

PERIOD = 0.1
FINE = np.arange(0.0, PERIOD, 1e-3)


def governor(name="paper", gravity=False, limit=np.inf):
    return Governor(StewartDynamics(load_mechanism(name), gravity), limit)


def ways(one, begin, targets, each=30):
    """Return the states (n, 18) of a run in steps of 1 ms, and the last memory."""
    now, states = begin, []
    for target in targets:
        for _ in range(each):
            now = one.follow(now, target)
            states.append(response(now.state, now.applied, now.pace, FINE))
            now = one.after(now, PERIOD)
    return np.vstack(states), now


def wild_targets(mechanism, number=12, seed=11):
    reach = np.repeat([0.9, 2 * mechanism.crank_lengths.min()], 3)
    return mechanism.home + reach * np.random.default_rng(seed).uniform(-1, 1, (number, 6))


def test_the_response_is_that_of_three_equal_poles():
    rng = np.random.default_rng(5)
    state, g, w = rng.standard_normal(18), rng.standard_normal(6), 3.7

    def change(_, x):
        q, v, a = np.split(x, 3)
        return np.concatenate([v, a, w**3 * (g - q) - 3 * w**2 * v - 3 * w * a])

    times = np.linspace(0, 2, 5)
    wanted = solve_ivp(change, (0, 2), state, t_eval=times, rtol=1e-11, atol=1e-12).y.T
    np.testing.assert_allclose(response(state, g, w, times), wanted, atol=1e-8)


def at_rest(pose):
    return GovernorState(np.append(pose, np.zeros(12)), pose)


@pytest.mark.parametrize(
    ("name", "gravity", "limit"),
    [("paper", False, 0.66), ("paper", False, 0.1), ("paper", True, 2.0), ("desktop", True, 0.4)],
)
def test_whatever_is_asked_for_the_limits_hold(name, gravity, limit):
    one = governor(name, gravity, limit)
    dynamics = one.dynamics
    begin = at_rest(dynamics.mechanism.home)
    states, _ = ways(one, begin, wild_targets(dynamics.mechanism), each=17)
    assert min(margin(dynamics.mechanism, x[POSE]) for x in states) >= LEAST_MARGIN
    torques = [dynamics.inverse_dynamics(x[POSE], x[RATES], x[ACCELERATIONS]) for x in states]
    assert np.abs(torques).max() <= TORQUE_SHARE * limit
    # The motion is one: pose, rates and accelerations go on where the last period ended.
    np.testing.assert_allclose(
        np.diff(states[:, POSE], axis=0) / 1e-3, states[:-1, RATES], atol=0.02
    )
    assert np.ptp(states[:, 5]) > 0.2 * dynamics.mechanism.crank_lengths.min()


@pytest.mark.parametrize("far", [1e3, 1e303])
def test_a_huge_target_takes_as_few_looks_ahead_as_a_near_one(far, monkeypatch):
    one = governor()
    looks, within = [], Governor._within
    monkeypatch.setattr(
        Governor, "_within", lambda self, states: looks.append(1) or within(self, states)
    )
    home = one.dynamics.mechanism.home
    governed = one.follow(at_rest(home), np.array([0, 0, 0, 0, 0, far]))
    assert 0 < len(looks) <= 20
    assert governed.applied[5] > home[5] + 0.01 and governed.limit


def test_coordinates_that_can_go_on_do_where_another_cannot():
    one = governor()
    home, tilted = one.dynamics.mechanism.home, np.array([0.3, 0, 0, 0, 0, 0])
    _, blocked = ways(one, at_rest(home), [home + tilted, home + tilted + [0, 0, 0, 0, 0, 0.5]])
    assert blocked.limit is not None and blocked.applied[0] == pytest.approx(0.3)
    _, end = ways(one, blocked, [home + [0, 0, 0, 0, 0, 0.5]], each=80)
    assert end.limit is not None and abs(end.state[0]) < 1e-3


def test_a_step_from_rest_never_turns_back_is_reached_and_nothing_is_said():
    one = governor("paper", False, 0.1)  # so little that g goes there in many steps
    home = one.dynamics.mechanism.home
    target = home + [0.1, -0.15, 0.2, 0.02, -0.01, 0.05]
    states, end = ways(one, at_rest(home), [target], each=120)
    assert (states[:, RATES] * np.sign(target - home) > -1e-12).all()
    assert end.limit is None
    np.testing.assert_allclose(end.state[POSE], target, atol=1e-9)


def lateness(states):
    """Return the time by which a step of the height is late on average, s."""
    return 1e-3 * (1 - (states[:, 5] - states[0, 5]) / (states[-1, 5] - states[0, 5])).sum()


@pytest.mark.parametrize("limit", [np.inf, 0.66, 0.05, 0.01])
def test_a_step_is_as_fast_as_the_torque_allows(limit):
    """The impulse response w^3 t^2 exp(-wt) / 2 has its mean at 3 / w; torque grows with w^2."""
    one = governor("paper", False, limit)
    home = one.dynamics.mechanism.home
    target, allowed = home + [0, 0, 0, 0, 0, 0.02], TORQUE_SHARE * limit
    states, end = ways(one, at_rest(home), [target])

    def torque(pace):
        rows = response(at_rest(home).state, target, pace, np.arange(0, 3, 1e-3))
        return max(
            np.abs(one.dynamics.inverse_dynamics(x[POSE], x[RATES], x[ACCELERATIONS])).max()
            for x in rows
        )

    assert lateness(states) == pytest.approx(3 / end.pace, abs=1e-3)
    assert torque(end.pace) < allowed
    if np.isinf(limit):
        assert end.pace == PACE
    elif end.pace < FASTEST:
        assert torque((FASTEST / PACE) ** 0.25 * end.pace) > 0.99 * allowed


@pytest.mark.parametrize(("limit", "pace"), [(np.inf, PACE), (0.66, FASTEST)])
def test_a_target_beyond_reach_is_approached_as_fast_and_as_far_as_it_goes(limit, pace):
    one = governor("paper", False, limit)
    mechanism = one.dynamics.mechanism
    states, end = ways(one, at_rest(mechanism.home), [mechanism.home + [0, 0, 0, 0, 0, 0.5]])
    assert lateness(states) == pytest.approx(3 / pace, abs=5e-3)
    assert "leg" in end.limit
    assert LEAST_MARGIN <= margin(mechanism, end.state[POSE]) < LEAST_MARGIN + 0.02


def test_a_slower_pace_never_passes_the_target():
    """From a fast step, a far target in another direction takes so much torque that w falls."""
    one = governor("paper", False, 0.1)
    home = one.dynamics.mechanism.home
    now, paces = at_rest(home), []
    for k in range(80):
        now = one.follow(
            now, home + ([0, 0, 0, 0, 0, 0.005] if k < 2 else [0.4, 0, 0, 0.05, 0, 0.03])
        )
        paces.append(now.pace)
        fine = response(now.state, now.applied, now.pace, FINE)
        assert (fine[:, [0, 3, 5]] <= now.applied[[0, 3, 5]] + 1e-9).all()
        assert (fine[:, [6, 9, 11]] >= -1e-9).all()
        now = one.after(now, PERIOD)
    assert paces[1] == FASTEST and min(paces) < 0.7 * FASTEST
    np.testing.assert_allclose(now.state[[0, 3, 5]] - home[[0, 3, 5]], [0.4, 0.05, 0.03], atol=1e-6)


def test_a_stop_does_not_turn_back_and_is_soon():
    one = governor("paper", False, 10.0)
    home = one.dynamics.mechanism.home
    targets = home + np.array([[0, 0, 0, 0, 0, 0.08], [0, 0, 0, 0, 0, -0.08], [0.2, 0, 0, 0, 0, 0]])
    for each in (3, 7, 12):
        _, moving = ways(one, at_rest(home), targets, each)
        for pace in one.paces:
            stop = stop_pose(moving.state, pace)
            after = response(moving.state, stop, pace, np.arange(0, 6, 1e-3))
            assert (after[:, RATES] * np.sign(moving.state[RATES]) >= -1e-9).all()
            assert np.abs(after[-1, RATES]).max() < 1e-6


def test_a_motion_of_the_scenario_is_taken_over_and_given_back():
    one = governor("paper", False, 10.0)
    motion = make_reference(SineConfig(), 100.0)
    for t in np.arange(0.0, 6.0, 0.7):
        begun = one.begin(evaluate(motion, t))
        assert isinstance(begun, GovernorState), begun
        way = one.future(begun.state, begun.applied, begun.pace)
        assert one.problem(way) is None
        rest = one.after(begun, 0.5)
        blend = one.onto(rest.state, t + 0.5, motion)
        assert not isinstance(blend, str), blend
        later = t + 20.0
        for at, wanted in ((t + 0.5, rest.state), (later, evaluate(motion, later))):
            np.testing.assert_allclose(evaluate(blend, at), wanted, atol=1e-9)


def test_a_limit_that_leaves_no_way_is_reported():
    one = governor("paper", True, 0.5)  # less than what holds the plate
    begun = one.begin(at_rest(one.dynamics.mechanism.home).state)
    assert isinstance(begun, str) and begun.startswith("motor")
