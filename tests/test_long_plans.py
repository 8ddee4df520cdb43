"""Short periods and long delays: what is prepared before a run takes no longer for them."""

import time

import numpy as np
import pytest

from stewart_drake.core.library import core
from stewart_drake.dynamics.stewart import StewartDynamics
from stewart_drake.law.catch_up import CatchUp
from stewart_drake.law.feedforward import mean_torques
from stewart_drake.law.startup import BLOCK, choose_substeps, filter_substeps
from stewart_drake.loop.preparation import prepare
from stewart_drake.mechanism.trajectories import evaluate, through_states
from stewart_drake.scenario.loading import load_scenario

MOST_HOLDS = 100


@pytest.fixture
def work(monkeypatch):
    """Integration steps since the test began."""
    done = {"steps": 0}
    predict = StewartDynamics.predict

    def predicted(self, x, T, h, substeps=1, *more):
        done["steps"] += substeps * len(T)
        return predict(self, x, T, h, substeps, *more)

    monkeypatch.setattr(StewartDynamics, "predict", predicted)
    return done


@pytest.mark.parametrize("period", [0.1, 0.003, 0.0007, 1e-4])
@pytest.mark.parametrize("duration", [0.3, 0.31])
def test_a_plan_of_many_periods_is_followed_period_by_period(period, duration):
    """Onto the reference, by the torques that its own inverse dynamics gives for each period."""
    experiment = prepare(
        load_scenario("paper", None, ("plant.kind=exact", f"controller.period={period}"))
    )
    plant, reference, begin = experiment.nominal, experiment.reference, 0.8
    start = np.concatenate([experiment.mechanism.home, np.zeros(6)])
    planned, span = CatchUp(plant, reference, start, begin, period).plan(duration, None)
    assert duration <= span < duration + period * (1 + 1e-9)
    n = round(span / period)
    assert n * period == pytest.approx(span)
    edges = begin + period * np.arange(n + 1)
    torques = mean_torques(plant, planned, edges[:-1], edges[1:])
    jumps = np.abs(np.diff(torques, axis=0)).max(axis=1) > 1e-5
    assert jumps.sum() < MOST_HOLDS
    end = plant.predict(start, torques, period, 1 if period < 0.01 else 4)[-1]
    wanted = evaluate(planned, begin + span)
    assert np.abs(wanted[:6] - evaluate(reference, begin + span)[:6]).max() < 1e-9
    assert np.abs(end[:6] - wanted[:6]).max() < (2e-5 if period == 0.1 else 1e-6)


def test_the_shortest_plan_within_a_limit_is_found_in_a_few_steps(monkeypatch):
    period, limit, made, over = 1e-3, 0.5, [], CatchUp.over
    monkeypatch.setattr(CatchUp, "over", lambda *given: (made.append(given[-1]), over(*given))[1])
    experiment = prepare(
        load_scenario("paper", None, ("plant.kind=exact", f"controller.period={period}"))
    )
    start = np.concatenate([experiment.mechanism.home, np.zeros(6)])
    spans = [
        CatchUp(experiment.nominal, experiment.reference, start, 0.8, dt).plan(None, limit)[1]
        for dt in (period, 0.02)
    ]
    assert spans[0] == pytest.approx(spans[1], abs=0.021)
    assert len(made) < 30


def test_a_way_planned_in_flight_is_what_drake_makes_of_its_pieces():
    """Two plans in sequence: before, within, between and after their pieces."""
    experiment = prepare(load_scenario("paper"))
    reference, start = experiment.reference, np.zeros(12)
    start[:6] = experiment.mechanism.home
    plan = CatchUp(experiment.nominal, reference, start, 0.8, 0.1).over(3)
    assert plan is not None
    pieces = plan.pieces.copy()
    pieces[:4, :2] -= 0.05  # a gap behind the fourth, as where a hold was too short for a piece
    made = [(p[0], p[2:20], p[1], p[20:]) for p in pieces]
    early, late = through_states(made[:4], reference), through_states(made[4:], reference)
    c, row = core(), np.empty(18)
    edges = np.unique(pieces[:, :2])
    times = np.concatenate([[0.0, 0.5], edges, (edges[1:] + edges[:-1]) / 2, [1.2, 2.0]])
    for at in times:
        expected = evaluate(early if at < pieces[3, 1] else late, at)
        if not c.lib.stewart_path_row(len(pieces), c.at(pieces), at, c.at(row)):
            row[:] = evaluate(reference, at)
        assert row == pytest.approx(expected, rel=1e-9, abs=1e-9)


def test_a_long_delay_is_compared_no_further_than_the_prediction_is_of_use(work):
    """Torques held for 0.1 s lead away from the reference long before 100 s are over."""
    experiment = prepare(load_scenario("paper"))
    began = time.perf_counter()
    substeps = choose_substeps(experiment.nominal, experiment.reference, 0.1, 1000, 10.0)
    assert substeps == 8
    # Whole horizons of 8 instants, 3 n steps for n = 1, 2, 4 and 8, were 360 thousand.
    assert work["steps"] < 8 * 3 * 15 * 1000 / 2
    assert time.perf_counter() - began < 120
    assert BLOCK < 1000


@pytest.mark.parametrize("share", [1.0, 0.1])
def test_a_filter_steps_as_finely_as_its_model_error_asks(share):
    """Against 64 steps a period. Half the steps have 16 times the error, of fourth order."""
    experiment = prepare(load_scenario("motion_base", "predictor_lqi", ["controller.period=0.2"]))
    dynamics, reference, dt = experiment.nominal, experiment.reference, 0.2
    std = 2e-4 * share * np.tile(experiment.motion_scale, 2)
    found = filter_substeps(dynamics, reference, dt, 10.0, std)

    def worst(substeps):
        errors = []
        for t in np.arange(0, 10, 0.5):
            torque = mean_torques(dynamics, reference, np.array([t]), np.array([t + dt]))
            x = evaluate(reference, t)[:12]
            exact = dynamics.predict(x, torque, dt, 64)[-1]
            errors.append(np.abs(dynamics.predict(x, torque, dt, substeps)[-1] - exact) / std)
        return np.max(errors)

    assert found > 1 and worst(found) < 1.5 and worst(found // 2) > 1
