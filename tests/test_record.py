"""The log of a run: which instants, what it says about itself, what it does not change."""

import dataclasses
import json
import typing

import numpy as np
import pytest
import xarray as xr

import stewart_drake as sd
from stewart_drake.files.jsonio import jsonable
from stewart_drake.loop.controller import held_by
from stewart_drake.loop.diagram import build_closed_loop
from stewart_drake.loop.results import RunSummary
from stewart_drake.loop.sensor import Sensor
from stewart_drake.reporting.csv_file import read_signals
from stewart_drake.scenario.loading import scenario_yaml
from stewart_drake.scenario.signals import SIGNALS, exported_ports, ports_of
from stewart_drake.scenario.timing import instants
from stewart_drake.tuning.data import run_condition
from tests.mechanisms import PAPER

ON_REFERENCE = ("start=on_reference", "queue=reference")
NOISE = "sensor.noise_std=[1e-4,1e-4,1e-4,1e-5,1e-5,1e-5,1e-3,1e-3,1e-3,1e-4,1e-4,1e-4]"


def scenario(*settings, plant="exact", start=ON_REFERENCE):
    return sd.load_scenario("paper", settings=(f"plant.kind={plant}", *start, *settings))


def run(*settings, plant="exact"):
    return sd.simulate(scenario(*settings, plant=plant), judge_stability=False)


# Instants.


@pytest.mark.parametrize("plant", ["exact", "multibody"])
@pytest.mark.parametrize("period", [0.01, 0.005, 0.03])
def test_no_torque_is_lost(period, plant):
    """The law's own torques, taken at its samples, are those of the log."""
    sc = scenario(f"controller.period={period}", "duration=0.3", "delay.steps=3", plant=plant)
    result = sd.simulate(sc, judge_stability=False)
    number = round(0.3 / period) + 1
    at = period * np.arange(number)
    logged = result.signals.sel(time=at, method="nearest")
    np.testing.assert_allclose(logged.time, at, atol=1e-12)
    torques = logged.torque_commanded.values
    assert len(np.unique(torques[:, 0])) == number, "each sample has a torque of its own"
    # Equation (40) of the summary is over all samples; here it is taken of the log.
    assert result.summary["rms_torque"] == pytest.approx(np.sqrt(np.mean(torques**2)), rel=1e-12)
    variation = np.abs(np.diff(torques, axis=0)).sum(axis=0).mean()
    assert result.summary["torque_variation"] == pytest.approx(variation, rel=1e-12)
    np.testing.assert_array_equal(logged.torque_applied.values[3:], torques[:-3])


def test_the_usual_instants_are_the_grid_and_every_sample_and_the_end_once():
    found = run("controller.period=0.03", "duration=0.1").signals.time.values
    np.testing.assert_allclose(found, [0, 0.02, 0.03, 0.04, 0.06, 0.08, 0.09, 0.1], atol=1e-12)
    found = list(instants(0.3, 0.1, None))
    assert [one.time for one in found] == pytest.approx(0.02 * np.arange(16), abs=1e-12)
    assert found[-1] == (0.3, True, True, True)
    assert [one.time for one in instants(0.25, 1.0, 0.1) if one.logged] == [0, 0.1, 0.2, 0.25]


@pytest.mark.parametrize(("period", "number"), [(0.005, 61), (0.1, 4), (0.25, 3), (10.0, 2)])
def test_a_log_has_the_period_that_is_asked_for(period, number):
    found = run(f"log_period={period}", "duration=0.3").signals.time.values
    expected = np.append(period * np.arange(number - 1), 0.3)
    np.testing.assert_allclose(found, expected, atol=1e-12)


def test_what_is_measured_of_a_run_does_not_depend_on_its_log():
    """The multibody plant steps as it does anyway: its numbers are the same to the last digit."""

    def numbers(result):
        measured = dict.fromkeys(("wall_s", "controller_step_ms", "scenario"))
        return jsonable(result.summary) | measured

    start = ("duration=0.9", "delay.steps=2", "start=rest", "queue=zero")
    usual = run(*start, plant="multibody")
    assert usual.accumulated_error > 0 and usual.summary["delay_floor"] > 0
    for period in ("0.001", "0.05", "5"):
        own = run(*start, f"log_period={period}", plant="multibody")
        assert numbers(own) == numbers(usual)
        shared = np.intersect1d(usual.signals.time.values, own.signals.time.values)
        assert own.signals.sel(time=shared).pose.equals(usual.signals.sel(time=shared).pose)
    # The integrator of the exact plant has to stop where it is looked at.
    exact = run(*start)
    assert run(*start, "log_period=0.04").accumulated_error == exact.accumulated_error
    finer = run(*start, "log_period=0.003").accumulated_error
    assert finer == pytest.approx(exact.accumulated_error, rel=1e-6)


def test_a_data_set_needs_the_samples_whatever_the_log():
    sc = sd.load_scenario("paper", settings=("plant.kind=exact", "delay.steps=1", *ON_REFERENCE))
    both = [dataclasses.replace(sc, log_period=period) for period in (None, 0.05)]
    rows = [run_condition(one, ((1.0, 1.0),)) for one in both]
    assert rows[0] == rows[1]


# What the controller got, and what it made of it.


def test_measurement_and_estimate_are_the_controllers():
    result = run(NOISE, "duration=0.5", "delay.steps=2", "controller.period=0.02")
    signals, sc = result.signals, result.scenario
    sensor = Sensor(np.array(sc.sensor.noise_std), sc.sensor.seed, 0.02)
    state = np.hstack([signals.pose, signals.rates])
    noise = np.array([sensor.noise(k) for k in range(len(state))])
    np.testing.assert_allclose(signals.measurement, state + noise, rtol=0, atol=1e-12)
    estimate = signals.state_estimate.values
    np.testing.assert_array_equal(estimate[0], signals.measurement[0])
    off = np.abs(estimate - state)[5:].mean(axis=0)
    assert np.all(off < np.abs(noise)[5:].mean(axis=0)), "the filter knows better than the sensor"
    assert list(signals.state.values[[0, 3, 6, 11]]) == ["phi", "x", "phi_dot", "z_dot"]


def test_measurements_are_held_between_samples_and_kept_where_they_are_missing():
    """The log shows a bad reading as received, and the state of the model."""
    loop = build_closed_loop(scenario("duration=0.5"))
    port = loop.GetOutputPort("measurement")
    assert np.isnan(port.Eval(loop.CreateDefaultContext())).all(), "nothing was measured yet"
    signals = run("duration=0.25").signals
    values = signals.measurement.values
    for first, last in ((0, 4), (5, 9)):
        assert np.all(values[first : last + 1] == values[first])
    assert np.any(values[4] != values[5])


# What the file says.


def test_the_file_says_what_is_in_it(tmp_path):
    result = run("duration=0.3", "controller.w_R=3")
    result.save(tmp_path)
    plain = xr.load_dataset(tmp_path / "signals.nc")
    for read in (plain, read_signals(tmp_path / "signals.nc")):
        assert read.identical(result.signals)
        assert set(read.data_vars) == set(SIGNALS)
        for name in (*read.data_vars, *read.coords):
            assert read[name].attrs["long_name"]
        for name, signal in SIGNALS.items():
            dimension = signal.quantity.dimension
            labels = read.sizes[dimension.name] if dimension else 1
            units = read[name].attrs["units"].split(", ")
            assert len(units) in (1, labels) and signal.size == labels
            assert list(signal.quantity.units) in (units, units * labels)
            assert not dimension or list(read[dimension.name].values) == list(signal.labels)
        assert read.time.attrs["units"] == "s"
        assert json.loads(read.attrs["versions"])["drake"]
    again = tmp_path / "again.yaml"
    again.write_text(plain.attrs["scenario"])
    assert sd.load_scenario(again) == result.scenario
    assert plain.attrs["scenario"] == scenario_yaml(result.scenario)


# The table of signals.


def test_every_signal_of_the_controller_has_a_value_and_no_other():
    held = held_by(sd.StewartDynamics(PAPER))
    assert set(held) == {signal.name for signal in ports_of("controller").values()}
    assert all(signal.size == (len(signal.labels) or 1) for signal in SIGNALS.values())


def test_the_ports_are_those_of_the_table():
    loop = build_closed_loop(scenario())
    ports = {loop.get_output_port(n).get_name() for n in range(loop.num_output_ports())}
    assert ports == set(exported_ports())
    for signal in SIGNALS.values():
        if signal.source:
            port = loop.GetOutputPort(signal.exported)
            assert len(range(port.size())[signal.part]) == signal.size


# The summary.


@pytest.mark.parametrize(
    "settings",
    [("duration=0.3",), ("duration=2", "start=rest", "queue=zero", "plant.gravity=true")],
)
def test_the_summary_has_the_kinds_that_its_type_tells(settings):
    """One run completes, one leaves the workspace."""
    summary = sd.simulate(scenario(*settings)).summary
    assert (summary["status"] == "completed") == (len(settings) == 1)
    hints = typing.get_type_hints(RunSummary)
    assert list(summary) == list(hints)
    for name, hint in hints.items():
        assert hint not in (float, str) or type(summary[name]) is hint, name
