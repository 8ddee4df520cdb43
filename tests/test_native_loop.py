"""The loop without Drake against Drake's: the same instants, noise, torques, ends and figures."""

import dataclasses
import functools
import math
import os
from pathlib import Path
from unittest import mock

import numpy as np
import pytest

import stewart_drake as sd
from stewart_drake.dynamics.open_loop import IntegrationError
from stewart_drake.law.catch_up import CatchUp
from stewart_drake.law.motion import KnownMotion, Preview
from stewart_drake.loop import bulk
from stewart_drake.loop.bulk import (
    Prepared,
    PythonController,
    ending_of,
    preparation_of,
    run_in_bulk,
    run_loop,
    run_prepared,
    uncovered,
)
from stewart_drake.loop.law_design import control_law
from stewart_drake.loop.preparation import prepare
from stewart_drake.loop.sensor import Sensor, white_noise, white_noises
from stewart_drake.loop.simulation import simulate
from stewart_drake.mechanism.files import mechanism_yaml
from stewart_drake.mechanism.geometry import Body
from stewart_drake.studies.study_options import Ranges
from stewart_drake.studies.uncertainty import MACHINE, apply_draw, draw, scales_of
from tests.mechanisms import PAPER

NOISE = "sensor.noise_std=[1e-4,1e-4,1e-4,1e-5,1e-5,1e-5,1e-4,1e-4,1e-4,1e-5,1e-5,1e-5]"
PACKETS = (
    "link.kind=network", "link.low=0.1", "link.high=0.3", "link.loss=0.1", "link.playout=0.3",
    "link.return={low: 0.02, high: 0.15, loss: 0.1}", "link.seed=3",
)  # fmt: skip
FOLLOWS = ("start=on_reference", "queue=reference")
DIRTY = (
    *(NOISE, "sensor.seed=3", "plant.torque_bias=[.001,.002,0,0,-.001,0]"),
    *("plant.payload_mass=0.2", "plant.joint_damping=0.001"),
)


def scenario(name="paper", *settings, controller=None):
    """Return a scenario on the exact plant, at its tightest accuracy."""
    tight = ["plant.kind=exact", "plant.accuracy=1e-12"]
    return sd.load_scenario(name, controller, [*tight, *settings])


LOOPS = {
    "from rest": scenario("paper", "duration=3"),
    # Its samples are where pieces of the way meet, with other accelerations on either side.
    "late measurements, joints": scenario("motion_base", "duration=12", "sensor.delay=0.02"),
    "dirty": scenario("paper", "duration=2", *FOLLOWS, *DIRTY),
    "late": scenario(
        "paper", "duration=2", "delay.fraction=0.37", *FOLLOWS, *DIRTY, "sensor.seed=4"
    ),
    "limited": scenario("paper", "duration=2", "actuator.torque_limit=0.015", *FOLLOWS, *DIRTY),
    "gravity": scenario("gravity", "duration=0.6", *DIRTY[:2]),
    "off the grid": scenario(
        "paper", "duration=1.01", "controller.period=0.03", "delay.steps=3", "delay.fraction=0.4"
    ),
    "no delay": scenario("paper", "duration=1", "delay.steps=0", "start=on_reference"),
    "part of a period": scenario(
        "paper", "duration=1", "delay.steps=0", "delay.fraction=0.6", "start=on_reference"
    ),
    "blind": scenario("paper", "duration=3", controller="lqi"),
    "leaves": scenario("paper", "plant.payload_mass=3.0", "controller.estimate=[]"),
    "linear": scenario("paper", "duration=2", controller="delay_lqr"),
    "printed": scenario(
        "paper", "duration=1", "controller.model=paper", "controller.estimate=[]",
        "start=on_reference", "queue=reference",
    ),
    "adaptive": scenario(
        "paper", "duration=2", "controller.delay_estimator=constant", "controller.delay_steps=6",
        "start=on_reference", "queue=reference",
    ),
    "jitter": scenario(
        "paper", "duration=2", "delay.jitter_std=0.06", "delay.seed=4", "delay.fraction=0.2",
        "controller.delay_steps=8", "plant.coulomb_friction=0.0003", *FOLLOWS, *DIRTY,
    ),
    "shorter and shorter": scenario(
        "paper", "duration=1.5", "delay.drift=-0.3", "delay.steps=3", "controller.delay_steps=3",
        *FOLLOWS,
    ),
    "rule": scenario(
        "paper", "duration=2", "tuner.kind=rule", "tuner.ratio=1", "tuner.knee=-0.5",
        "delay.fraction=0.3", "controller.delay_steps=8", *FOLLOWS, *DIRTY,
    ),
    "network": scenario("paper", "duration=2", "tuner.kind=ann", *FOLLOWS, *DIRTY),
    "packets": scenario("paper", "duration=3", *PACKETS, *FOLLOWS, *DIRTY),
    "packets between samples": scenario(
        "paper", "duration=3", *PACKETS, "link.playout=0.33", "link.dry=zero", "link.seed=6", *DIRTY
    ),
    "packets on the reference": scenario(
        "paper", "duration=1", *PACKETS, "link.playout=0.33", "link.dry=zero", *FOLLOWS
    ),
    "packets one way": scenario(
        "paper", "duration=3", *PACKETS[:4], "link.acknowledged=false", *FOLLOWS, *DIRTY
    ),
    "late measurements": scenario("paper", "duration=3", "sensor.delay=0.05", *FOLLOWS, *DIRTY),
    "lost": scenario("paper", "duration=3", "sensor.loss=0.2", *FOLLOWS, *DIRTY),
    "adaptive, late, from rest": scenario(
        "paper", "duration=2.5", "controller.delay_estimator=constant", "delay.fraction=0.37",
        "controller.delay_steps=7", "controller.replan=1.2",
    ),
    "packets, blind": scenario("paper", "duration=2", *PACKETS, *DIRTY, controller="delay_lqr"),
}  # fmt: skip


IN_PYTHON = {
    "blind": "native, controller.prediction in Python",
    "packets, blind": "native, controller.prediction in Python",
    "linear": "native, controller.prediction in Python",
    "printed": "native, controller.model in Python",
}
"""What the core has not."""


def drake(one, truth=None):
    return ending_of(simulate(one, true_mechanism=truth, judge_stability=False))


def assert_same(found, expected):
    assert found.status == expected.status
    for name, value in expected.figures._asdict().items():
        assert getattr(found.figures, name) == pytest.approx(value, rel=1e-6, nan_ok=True), name
    assert found.counts == expected.counts
    assert found.samples.shape == expected.samples.shape
    off = np.abs(found.samples - expected.samples) / np.abs(expected.samples).max(axis=0)
    assert off.max() < 1e-6 or np.isnan(expected.samples).any()
    assert (found.stopped is None) == (expected.stopped is None)
    if found.stopped is not None and expected.stopped is not None:
        assert found.stopped.time == pytest.approx(expected.stopped.time, abs=1e-6)
        assert found.stopped.reason == expected.stopped.reason
        assert found.stopped.leg == expected.stopped.leg


@pytest.mark.parametrize("name", LOOPS)
def test_the_loop_is_drakes(name):
    found = run_in_bulk(LOOPS[name])
    assert found.loop == IN_PYTHON.get(name, "native")
    assert_same(found, drake(LOOPS[name]))


@functools.cache
def scales():
    one = LOOPS["from rest"]
    return scales_of(prepare(one), run_in_bulk(one).figures.peak_torque)


def assert_drawn(indices, duration):
    """Machines as of `analyze robustness`, from rest, in Drake and in C."""
    one = scenario("paper", f"duration={duration}")
    for index in indices:
        changed = apply_draw(MACHINE, one, PAPER, draw(Ranges(), scales(), one, 9, index))
        variant, truth = changed.as_scenario(), changed.machine()
        found = run_in_bulk(variant, truth)
        assert found.loop == "native"
        assert_same(found, drake(variant, truth))


def test_drawn_machines_end_as_in_drake():
    assert_drawn(range(4), 3.0)


def test_the_plan_of_a_run_without_noise_is_not_that_of_one_with_noise():
    """The law predicts in two steps with noise, else in one; plans within a limit depend on it."""
    settings = ("controller.period=0.12", "delay.steps=7", "actuator.torque_limit=1", "duration=3")
    run_in_bulk(scenario("paper", *settings))
    noisy = scenario("paper", *settings, f"sensor.noise_std={[1e-5] * 12}")
    assert_same(run_in_bulk(noisy), drake(noisy))


@pytest.mark.soak
@pytest.mark.parametrize("part", range(5))
def test_many_drawn_machines_end_as_in_drake(part):
    assert_drawn(range(4 + 20 * part, 24 + 20 * part), 10.0)


def test_states_torques_and_measurements_are_drakes():
    one = LOOPS["gravity"]
    preparation = preparation_of(one)
    prepared = preparation.prepared(preparation.experiment(one))
    wanted = preparation.references[preparation.when.sampled]
    law = PythonController(prepared, preparation.when, wanted)
    course = run_loop(prepared.experiment, preparation.when, law)
    signals = simulate(one, judge_stability=False).signals
    assert np.array_equal(signals.time.values, preparation.when.nominal)
    states = np.hstack([signals.pose.values, signals.rates.values])
    assert np.abs(course.states - states).max() < 1e-9
    sampled = preparation.when.sampled
    torques = signals.torque_commanded.values[sampled]
    assert np.abs(course.asked - torques).max() < 1e-9 * np.abs(torques).max()
    measured = signals.measurement.values[sampled]
    assert np.array_equal(course.measured[0], measured[0])
    assert np.abs(course.measured - measured).max() < 1e-9


@pytest.mark.parametrize("seed", [0, 1, 2**31 - 1])
def test_noise_is_drakes_to_the_last_bit(seed):
    """The noise is the measurement less the state of a plate at rest."""
    one = scenario("paper", "duration=2", NOISE, f"sensor.seed={seed}", "queue=zero")
    preparation = preparation_of(one)
    sensor, seen = Sensor(np.array(one.sensor.noise_std), seed, one.controller.period), []

    def law(sample, measured, report):
        seen.append(measured.values)
        return np.zeros(6), np.zeros((1, 6))

    run_loop(preparation.experiment(one), preparation.when, law)
    state = np.concatenate([PAPER.home, np.zeros(6)])
    assert len(seen) == len(preparation.when.samples) > 10
    for k, measurement in enumerate(seen):
        assert np.array_equal(measurement, state + sensor.noise(k))
        assert np.array_equal(white_noises(seed, k + 1)[k], white_noise(seed, k))


def test_what_a_law_raises_comes_through():
    preparation = preparation_of(LOOPS["from rest"])
    experiment = preparation.experiment(LOOPS["from rest"])
    taken = []

    def law(sample, measured, report):
        taken.append(sample)
        if sample == 3:
            raise KeyboardInterrupt("stop")
        return np.zeros(6), np.zeros((1, 6))

    with pytest.raises(KeyboardInterrupt, match="stop"):
        run_loop(experiment, preparation.when, law)
    assert taken == [0, 1, 2, 3]


@pytest.mark.parametrize(
    ("field", "settings"),
    [
        ("plant.kind", ["plant.kind=multibody"]),
        ("sensor.faults", ["sensor.faults=[{kind: missing, from: 0.05, to: 0.15}]"]),
    ],
)
def test_what_it_has_not_runs_in_drake_and_says_so(field, settings):
    usual = ["duration=0.2", "start=on_reference", "queue=reference", "plant.accuracy=1e-8"]
    one = scenario("paper", *usual, *settings)
    assert uncovered(one) == field
    found, expected = run_in_bulk(one), drake(one)
    assert found.loop == f"drake, {field}"
    assert_same(found, expected)
    assert np.array_equal(found.samples, expected.samples, equal_nan=True)


def test_servos_without_their_reports_run_in_drake():
    """The torques of a lost measurement are unknown, and with it the cost."""
    assert uncovered(sd.load_scenario("reachy_mini", settings=["sensor.loss=0.1"])) == "sensor.loss"


def test_where_no_step_is_short_enough_drake_tries(monkeypatch):
    def fails(*_):
        raise IntegrationError("no step is short enough")

    one = scenario("paper", "duration=0.2", "plant.accuracy=1e-8")
    monkeypatch.setattr(bulk, "run_loop", fails)
    assert run_in_bulk(one).loop == "drake, plant.accuracy"


# ---------------------------------------------------------------- what runs have in common


@pytest.mark.parametrize("limit", ["null", "none", "0.3", "0.9", "5.0"])
def test_a_prepared_run_is_that_of_the_scenario_alone(limit):
    """Law, previews and start, with what is drawn, as they are without anything in common."""
    first = preparation_of(scenario("paper", "duration=2"))
    one = scenario("paper", "duration=2", f"actuator.torque_limit={limit}", *DIRTY)
    preparation = preparation_of(one)
    assert preparation is first
    other = dataclasses.replace(one, controller=dataclasses.replace(one.controller, w_R=1e3))
    assert preparation_of(other) is first
    preparation.prepared(preparation.experiment(other))  # its plan of least error is another
    prepared, alone = preparation.prepared(preparation.experiment(one)), prepare(one)
    law, planned, _ = control_law(alone)
    assert repr(prepared.law) == repr(law)
    for sample in preparation.when.samples:
        followed, expected = prepared.motion(sample), KnownMotion(planned, alone.reference, sample)
        assert np.array_equal(followed(law.preview_times), expected(law.preview_times))
    assert np.array_equal(prepared.experiment.start, alone.start)
    assert prepared.experiment.torque_limit == alone.torque_limit


def test_a_late_truth_that_is_not_believed_has_the_same_preparation():
    believed = "controller.delay_steps=8"
    first = preparation_of(scenario("paper", "duration=2"))
    assert preparation_of(scenario("paper", "duration=2", believed, "delay.fraction=0.1")) is first
    assert preparation_of(scenario("paper", "duration=2", "delay.fraction=0.1")) is not first
    assert preparation_of(scenario("paper", "duration=2", "controller.delay_steps=7")) is not first
    assert preparation_of(scenario("paper", "duration=2", "controller.catch_up=1")) is not first


def test_the_machine_of_the_scenarios_plant_is_run(tmp_path):
    """Twice as heavy as the controller knows it; and a file that changes is read again."""
    path, plate = tmp_path / "true.yaml", PAPER.plate
    heavy = Body(2 * plate.mass, 2 * plate.inertia)
    path.write_text(mechanism_yaml(dataclasses.replace(PAPER, plate=heavy)))
    one = scenario("paper", f"plant.mechanism={path}", "duration=1", *FOLLOWS)
    found = run_in_bulk(one)
    assert found.loop == "native"
    assert_same(found, drake(one))
    path.write_text(mechanism_yaml(PAPER))
    os.utime(path, ns=(1, 1))
    assert_same(run_in_bulk(one), run_in_bulk(scenario("paper", "duration=1", *FOLLOWS)))


def test_another_mechanism_file_is_another_preparation(tmp_path):
    path = tmp_path / "mine.yaml"
    text = (Path(__file__).parents[1] / "models" / "paper.yaml").read_text()
    path.write_text(text)
    one = scenario("paper", f"mechanism={path}", "duration=0.2")
    first = preparation_of(one)
    assert preparation_of(one) is first
    path.write_text(text + "# changed\n")
    os.utime(path, ns=(1, 1))
    assert preparation_of(one) is not first


def test_a_shipped_move_is_run():
    """Its name is that of no file in the working folder."""
    motion = "reference={kind: reachy_move, file: look_around}"
    assert run_in_bulk(scenario("reachy_mini", motion, "duration=0.1")).status == "completed"


def test_a_motion_that_cannot_be_is_refused_each_time():
    one = scenario("paper", "reference.amplitude=[0,0,0,0,0,0.3]", "duration=2")
    for _ in range(2):
        with pytest.raises(sd.ConfigError, match="reference: leg"):
            run_in_bulk(one)
    assert math.isnan(run_in_bulk(LOOPS["leaves"]).figures.accumulated_error)


# A reference that is missing.

# A law that plans reads the motion as a function, in which nothing is missing.
START = {"rest": ("controller.replan=0",), "reference": (*FOLLOWS, "controller.replan=0")}


@functools.cache
def prepared_from(start):
    """Return what the runs from a start have in common, and a prepared run."""
    one = scenario("paper", *START[start])
    preparation = preparation_of(one)
    return preparation, preparation.prepared(preparation.experiment(one))


def ending_along(previews, preparation, prepared):
    """Run along rows (k, p, 18) of the reference at each sample."""
    period = prepared.law.timeline.period

    class Given(Prepared):
        def motion(self, time):
            return Preview(self.law.preview_times, previews[round(time / period)])

    with mock.patch.object(bulk, "uncovered_part", return_value="reference"):
        return run_prepared(preparation, Given(*prepared))


def error_without(start, missing):
    """E_ac with NaN in parts of the previews, by sample, and how often that was counted."""
    preparation, prepared = prepared_from(start)
    times = prepared.law.preview_times
    previews = np.array([prepared.motion(t)(times) for t in preparation.when.samples])
    for sample, part in missing.items():
        previews[sample][part] = np.nan
    ending = ending_along(previews, preparation, prepared)
    assert ending.status == "completed" and ending.figures is not None
    return ending.figures.accumulated_error, ending.counts["references_missing"]


def samples(number):
    return sorted({0, 1, 2, *np.linspace(3, 100, number).astype(int).tolist()})


@pytest.mark.parametrize("number", [5, pytest.param(40, marks=pytest.mark.slow)])
@pytest.mark.parametrize("start", START)
def test_what_is_missing_in_the_reference_costs_next_to_nothing(start, number):
    """One number, a row, or all: E_ac stays within 1 % from rest, below 0.05 on the reference.

    On the reference the last torque in flight is held where the first preview is missing.
    """
    rng, (before, nothing) = np.random.default_rng(number), error_without(start, {})
    assert nothing == 0
    for sample in samples(number):
        entry = int(rng.integers(15)), int(rng.integers(18))
        parts = [entry, entry[0], slice(None)]
        if not sample:  # from rest the first torque begins the way onto the reference
            parts = [entry] if start == "rest" else [entry, slice(None)]
        for part in parts:
            error, counted = error_without(start, {sample: part})
            assert counted == 1
            assert abs(error - before) < 0.01 * before if start == "rest" else error < 0.05


def error_of_a_later_start(samples_late):
    """Return E_ac of `paper` from rest, held there for some samples before the first torque."""
    one = scenario("paper", *START["rest"])
    preparation = preparation_of(one)
    prepared = preparation.prepared(preparation.experiment(one))
    experiment, law, late = prepared.experiment, prepared.law, 0.1 * samples_late
    planned, _ = CatchUp(
        *(experiment.nominal, experiment.reference, experiment.start),
        *(law.timeline.eta + late, law.timeline.period),
    ).plan(None, None)
    motion, times = prepared._replace(planned=planned).motion, law.preview_times
    previews = np.array([motion(t)(times) for t in preparation.when.samples])
    previews[:samples_late] = np.concatenate([experiment.start[:6], np.zeros(12)])
    ending = ending_along(previews, preparation, prepared)
    assert ending.figures is not None
    return ending.figures.accumulated_error


@pytest.mark.parametrize(
    ("number", "share"), [(1, 0.01), (2, 0.13), (3, 0.05), (5, 0.08), (10, 0.03), (20, 0.01)]
)
def test_without_the_first_previews_the_run_begins_later(number, share):
    """E_ac is that of a planned later start, or larger by a share of that at the most."""
    error, counted = error_without("rest", dict.fromkeys(range(number), slice(None)))
    assert counted == number
    assert error < (1 + share) * error_of_a_later_start(number)


def test_without_the_first_accelerations_the_run_begins_a_sample_later():
    without, _ = error_without("rest", {0: (slice(None), slice(12, 18))})
    whole, _ = error_without("rest", {0: slice(None)})
    assert without == whole


@pytest.mark.parametrize("number", [5, 10])
@pytest.mark.parametrize(
    "first",
    [1, 2, 3, 10, 20, 40, *(pytest.param(k, marks=pytest.mark.soak) for k in range(4, 80))],
)
def test_a_longer_gap_does_not_lose_the_plate(first, number):
    """The whole run from rest has 21 % s; the same gaps on the reference."""
    gap = dict.fromkeys(range(first, first + number), slice(None))
    error, counted = error_without("rest", gap)
    assert counted == number and error < (31 if number == 5 else 55)
    error, _ = error_without("reference", gap)
    assert error < (1.5 if number == 5 else 8)
