"""Numbers that go wrong in the running loop: it recovers, or stops and says why; all are counted.

Faults are put in from outside: a sensor that fails at chosen samples, a gain that cannot be found,
motors that are too weak for a while.
"""

import json

import numpy as np
import pytest

import stewart_drake.law.cost as cost_module
import stewart_drake.loop.diagram as diagram_module
import stewart_drake.loop.kinds as kinds_module
from stewart_drake.law.riccati import RiccatiError
from stewart_drake.loop.results import accumulated_error
from stewart_drake.loop.sensor import Sensor
from stewart_drake.loop.simulation import simulate
from stewart_drake.scenario.loading import load_scenario
from stewart_drake.types import Array
from tests.backends import stepped_in_python

SMALL = "reference.amplitude=[0.01, 0.01, 0.01, 0.001, 0.001, 0.004]"
STATUSES = ("completed", "left_workspace", "solver_failed")
PLACES = ((0,), (12,), (10, 11, 12, 13, 14), (1, 5, 9, 13, 17))
"""The first sample, one later, five in a row, and every fourth."""


def scenario(*settings, controller=None, plant="exact"):
    """The paper's experiment with a delay of 0.3 s, from its reference on."""
    mine = (f"plant.kind={plant}", "delay.steps=3", "duration=4", "start=on_reference")
    return load_scenario("paper", controller, (*mine, "queue=reference", *settings))


def run_with(monkeypatch, spoil, sc=None):
    """A run whose sensor sends what `spoil` makes of the truth."""

    class Faulty(Sensor):
        def __init__(self, *arguments):
            super().__init__(*arguments)
            self._sent: dict[int, Array] = {}

        def _measure(self, context, output):
            super()._measure(context, output)
            k = round(context.get_time() / self._period)
            if k not in self._sent:  # the window of densities asks again
                self._sent[k] = spoil(k, np.array(output.value()), self._sent)
            output.SetFromVector(self._sent[k])

    monkeypatch.setattr(kinds_module, "Sensor", Faulty)
    return simulate(scenario() if sc is None else sc, judge_stability=False)


def check_outcome(run):
    """It ran to its end, or says when and why not; its record is whole and its torques are real."""
    assert run.status in STATUSES
    assert (run.failure is None) == (run.status == "completed")
    assert np.isfinite(run.accumulated_error) == (run.status == "completed")
    assert np.isfinite(run.signals.torque_commanded.values).all()
    json.dumps(run.summary["counts"])


def share_of_swing(run, last):
    """Mean error over the last so many s, as a share of the reference's peak to peak."""
    scale = np.ptp(run.signals.reference.values, axis=0)
    late = run.signals.sel(time=slice(run.scenario.duration - last, None))
    return accumulated_error(late.time.values, late.error.values, scale) / 100 / last


@pytest.mark.parametrize(
    ("places", "value"), list(zip(PLACES, (np.nan, np.inf, -np.inf, np.nan), strict=True))
)
def test_measurements_that_are_no_numbers(places, value, monkeypatch):
    """The model stands in for them."""

    def spoil(k, measured, _):
        if k in places:
            measured[k % 12] = value
        return measured

    run = run_with(monkeypatch, spoil)
    assert run.status == "completed"
    assert run.summary["counts"]["bad_measurements"] == len(places)
    assert run.summary["counts"]["riccati_failures"] == 0
    assert share_of_swing(run, 1.0) < 1e-3


def test_a_sensor_that_is_gone_for_good(monkeypatch):
    """Without any measurement the plant is steered by its model alone."""
    run = run_with(monkeypatch, lambda k, x, _: x if k < 10 else np.full(12, np.nan))
    check_outcome(run)
    assert run.summary["counts"]["bad_measurements"] == len(run.signals.time) // 5 + 1 - 10


@pytest.mark.parametrize("controller", ["predictor_lqi", "delay_lqi"])
@pytest.mark.parametrize("failing", [range(1), range(8, 9), range(8, 18)])
def test_gains_that_cannot_be_found(failing, controller, monkeypatch):
    """The last gain serves on; before the first one the feedforward goes alone."""
    stepped_in_python(monkeypatch)
    solve, calls = cost_module.reduced_gain, {"started": -1}

    def sometimes(*arguments):
        if calls["started"] >= 0:
            calls["started"] += 1
            if calls["started"] - 1 in failing:
                raise RiccatiError("the Riccati equation has no solution")
        return solve(*arguments)

    monkeypatch.setattr(cost_module, "reduced_gain", sometimes)
    build = diagram_module.DelayLqiController

    def started(*arguments):
        calls["started"] = 0  # the law tries itself out before
        return build(*arguments)

    monkeypatch.setattr(diagram_module, "DelayLqiController", started)
    # The paper's controller keeps the plate without a delay only, with or without these faults.
    delay = () if controller == "predictor_lqi" else ("delay.steps=0",)
    run = simulate(scenario(SMALL, *delay, controller=controller), judge_stability=False)
    assert run.summary["counts"]["riccati_failures"] == len(failing)
    assert run.status == "completed"
    if controller == "predictor_lqi":
        assert share_of_swing(run, 1.0) < 1e-3


def test_motors_at_their_limit_for_a_second(monkeypatch):
    """From rest, with a limit that the catch-up does not know of: they are at it for long, and the
    plate is caught in the end."""
    sc = scenario("duration=8", "start=rest", "queue=zero", "delay.steps=2", SMALL)
    free = simulate(sc, judge_stability=False)
    limit = free.summary["peak_torque"] / 3
    sc.actuator.torque_limit = limit
    sc.controller.catch_up = 0.3
    run = simulate(sc, judge_stability=False)
    check_outcome(run)
    assert run.summary["counts"]["saturated_steps"] >= 10
    assert run.summary["peak_torque_applied"] == limit < run.summary["peak_torque"]
    assert run.status == "completed"
    assert share_of_swing(run, 1.0) < 1e-3
