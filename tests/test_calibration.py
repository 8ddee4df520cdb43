"""The calibration of a machine: its file, and its use in the law."""

import dataclasses
import re

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import stewart_drake as sd
from stewart_drake.files.errors import ConfigError
from stewart_drake.files.yamlio import yaml_text
from stewart_drake.law.filter_settings import CHANCE, EXACT, usual_parameters
from stewart_drake.law.observers import CoreObserver
from stewart_drake.law.startup import reference_torque
from stewart_drake.loop.cautions import cautions_before
from stewart_drake.loop.law_design import GENTLE, compose_law
from stewart_drake.loop.preparation import prepare
from stewart_drake.mechanism.geometry import Body, fingerprint
from stewart_drake.scenario.calibration import (
    CALIBRATED,
    OFFSETS,
    Calibration,
    believed_delay,
    load_calibration,
    save_calibration,
)
from stewart_drake.scenario.signals import CONSTANTS, DAMPING, PARAMETERS, PAYLOAD, PLANT_PARAMETERS
from stewart_drake.scenario.timing import Delay
from tests.faults import one_line, written
from tests.mechanisms import PAPER

NAMES = ("payload_mass", "joint_damping", "coulomb_friction", "delay")
MEAN = np.array([0.4, 1e-3, 2e-3, 0.73])
SPREAD = np.array([[3e-2, 0, 0, 0], [1e-4, 2e-4, 0, 0], [0, 1e-4, 1e-4, 0], [0, 0, 0, 1e-3]])
KNOWN = Calibration(fingerprint(PAPER), NAMES, MEAN, SPREAD @ SPREAD.T)
ON_REFERENCE = ("plant.kind=exact", "start=on_reference", "queue=reference")


# The file.


@settings(max_examples=50, deadline=None)
@given(st.sets(st.sampled_from(CALIBRATED)), st.integers(0, 2**32 - 1))
def test_a_file_is_read_back_to_the_last_digit(tmp_path_factory, names, seed):
    rng, n, path = np.random.default_rng(seed), len(names), tmp_path_factory.mktemp("k") / "k.yaml"
    spread = rng.normal(0, 1, (n, max(0, n - 1)))  # of less than full rank
    known = Calibration("abc", tuple(sorted(names)), rng.uniform(1e-3, 1, n), spread @ spread.T)
    save_calibration(path, known)
    found = load_calibration(path)
    assert (found.mechanism, found.names) == (known.mechanism, known.names)
    assert np.array_equal(found.mean, known.mean)
    assert np.array_equal(found.covariance, known.covariance)


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        (
            {"names": ["payload_mass", "mass"]},
            r"names: got \['payload_mass', 'mass'\]; expected some of torque_bias_1,",
        ),
        ({"names": ["delay", "delay"]}, r"names: got \['delay', 'delay'\]; expected .*each once"),
        ({"mean": [0.1]}, r"mean of 2 names: got shape \(1,\); expected \(2,\)"),
        ({"mean": [0.1, float("nan")]}, r"mean\[1\]: got nan; expected a finite number"),
        ({"mean": [0.1, -0.1]}, "mean: got a delay of -0.1; expected 0 or more"),
        (
            {"names": ["coulomb_speed", "delay"], "mean": [0.0, 0.1]},
            "coulomb_speed of 0; expected above 0",
        ),
        (
            {"covariance": [[1.0, 0.0]]},
            r"covariance of 2 names: got shape \(1, 2\); expected \(2, 2\)",
        ),
        ({"covariance": [[1.0], [0.0, 1.0]]}, "covariance: got 1 numbers in a row; expected 2"),
        ({"covariance": [[1.0, 0.5], [0.4, 1.0]]}, "got 0.5 and 0.4 .* expected a symmetric"),
        ({"covariance": [[1e-8, 2e-6], [2e-6, 1e-4]]}, "an eigenvalue of -1, in units"),
        ({"covariance": [[-1.0, 0.0], [0.0, 1.0]]}, "a variance of -1 for payload_mass"),
        ({"covariance": [[0.0, 0.1], [0.1, 1.0]]}, "an eigenvalue of"),
        ({"covariance": "none"}, "covariance: got 'none'; expected a list"),
        ({"means": [1.0]}, "means: unknown key; did you mean mean"),
        ({"mechanism": 3}, "mechanism: got 3; expected text"),
    ],
)
def test_a_wrong_file_is_refused_in_one_line(tmp_path, wrong, message):
    right = {
        "mechanism": "abc",
        "names": ["payload_mass", "delay"],
        "mean": [0.1, 0.7],
        "covariance": [[1.0, 0.0], [0.0, 1.0]],
    }
    path = written(tmp_path / "calibration.yaml", yaml_text(right))
    assert load_calibration(path).value("delay") == 0.7
    written(path, yaml_text(right | wrong))
    assert re.search(message, one_line(lambda: load_calibration(path), start=f"{path}: "))


def test_a_fingerprint_is_of_the_numbers_that_a_machine_moves_by():
    own = fingerprint(PAPER)
    same = ({"name": "other"}, {"effort_limit": 1.0}, {"home": PAPER.home + 1e-3})
    rounded = ({"p_WS": PAPER.p_WS + 1e-13}, {"plate": _heavier(1e-12)})
    for change in (*same, *rounded):
        assert fingerprint(dataclasses.replace(PAPER, **change)) == own
    others = (
        {"p_WS": PAPER.p_WS + 1e-8},
        {"p_PQ": PAPER.p_PQ - 1e-8},
        {"rod_lengths": PAPER.rod_lengths + 1e-8},
        {"crank_lengths": PAPER.crank_lengths + 1e-8},
        {"plate": _heavier(1e-6)},
        {"rod": dataclasses.replace(PAPER.rod, center=0.4)},
    )
    prints = {fingerprint(dataclasses.replace(PAPER, **change)) for change in others}
    assert len(prints) == len(others)
    assert own not in prints


def _heavier(share):
    return Body(PAPER.plate.mass * (1 + share), PAPER.plate.inertia)


# What it is taken for.


def usual(free=PARAMETERS):
    return usual_parameters(4.0, 0.1, None, 0.2, free)


def test_what_is_known_is_the_prior_of_what_is_estimated():
    before, after = usual(), usual().knowing(KNOWN)
    assert np.array_equal(after.prior, [0, 0, 0, 0, 0, 0, 0.4, 1e-3])
    expected = np.diag(before.std**2)
    expected[PAYLOAD:, PAYLOAD:] = KNOWN.covariance[:2, :2]
    assert after.covariance == pytest.approx(expected, rel=1e-14)
    assert np.array_equal(after.usual_std, before.std)
    assert np.array_equal(before.covariance, np.diag(before.std**2))
    assert np.array_equal(after.upper, before.upper)
    # What is known exactly is nearly so.
    exactly = Calibration("abc", ("payload_mass", "delay"), np.array([0.4, 1.0]), np.zeros((2, 2)))
    found = usual().knowing(exactly)
    assert found.std[PAYLOAD] == EXACT * usual().std[PAYLOAD]
    assert np.linalg.eigvalsh(found.covariance).min() > 0


def test_a_mean_is_beyond_a_bound_by_chance_or_refused():
    near, far = (
        Calibration("abc", ("joint_damping",), np.array([-off * CHANCE * 1e-4]), np.array([[1e-8]]))
        for off in (0.9, 1.1)
    )
    assert usual().knowing(near).prior[DAMPING] == 0.0
    with pytest.raises(ValueError, match=r"joint_damping: got -0.00033 .*between 0 and"):
        usual().knowing(far)


def test_a_standard_deviation_that_is_said_goes_together_with_nothing():
    found = usual().knowing(KNOWN).trusting({"joint_damping": 5e-4})
    assert found.std[DAMPING] == 5e-4
    assert found.covariance[PAYLOAD, DAMPING] == 0
    assert found.covariance[PAYLOAD, PAYLOAD] == pytest.approx(KNOWN.covariance[0, 0], rel=1e-14)
    assert np.array_equal(found.prior, usual().knowing(KNOWN).prior)
    assert usual().trusting({}).correlation is None


def test_every_parameter_can_be_free():
    every = usual((*CONSTANTS, *OFFSETS))
    assert every.names == (*CONSTANTS, *OFFSETS)
    assert set(every.units) == {"N m", "kg", "N m s/rad", "rad/s", "m", "rad"}
    only = usual(("coulomb_speed", "offset_A3"))
    assert only.prior.tolist() == [0.02, 0.0]
    with pytest.raises(ValueError, match="payload_position_x: got 0 with a standard deviation"):
        usual_parameters(4.0, 0.1, None, free=("payload_position_x",))  # of no size


# What the law makes of it.


@pytest.fixture
def file(tmp_path):
    path = tmp_path / "calibration.yaml"
    save_calibration(path, KNOWN)
    return path


def experiment(*given):
    return prepare(sd.load_scenario("paper", "predictor_lqi", (*ON_REFERENCE, *given)))


def observer(law):
    assert isinstance(law.observer, CoreObserver)
    return law.observer


def test_the_law_begins_with_what_is_known(file):
    found = experiment(f"controller.calibration={file}", "controller.prior={payload: 0.2}")
    nominal = found.nominal
    known = dict(zip(PLANT_PARAMETERS, nominal.plant_parameters, strict=True))
    assert known["coulomb_friction"] == 2e-3
    assert known["coulomb_speed"] == 0.02
    assert np.array_equal(nominal.parameters, [0, 0, 0, 0, 0, 0, 0.4, 1e-3])
    law = compose_law(found)
    prior = observer(law).settings.parameters
    assert np.array_equal(prior.prior, nominal.parameters)
    assert prior.std[PAYLOAD] == 0.2
    assert prior.std[DAMPING] == pytest.approx(np.sqrt(KNOWN.covariance[1, 1]), rel=1e-14)
    belief = law.observer.start(law.timeline, law.sensing, law.plant)
    assert np.array_equal(belief.parameters, nominal.parameters)


def test_without_a_file_the_law_is_as_machine_and_motion_say():
    found = experiment()
    assert found.calibration is None
    law = compose_law(found)
    prior, torque = observer(law).settings.parameters, law.plant.coarse_torque_limit / GENTLE
    assert not prior.prior.any()
    usual = [0.3 * torque] * 6 + [PAPER.plate.mass / 4, 0.1 * torque]
    assert prior.usual_std == pytest.approx(usual, rel=1e-12)
    motion = reference_torque(found.nominal, found.reference, found.scenario.duration)
    expected = [0.05 * motion] * 6 + [PAPER.plate.mass / 10, 0.05 * motion]
    assert prior.std == pytest.approx(expected, rel=1e-12)


def test_a_known_delay_is_believed_where_nothing_else_is_said(file):
    known = f"controller.calibration={file}"
    assert believed_delay(experiment(known).scenario) == Delay.of(0.73, 0.1)
    assert believed_delay(experiment(known, "controller.delay_steps=6").scenario) == Delay(6)
    assert believed_delay(experiment().scenario) == Delay(8)


@pytest.mark.parametrize(
    ("change", "given", "message"),
    [
        (
            {"mechanism": "abc"},
            (),
            "controller.calibration: got .*, of another machine .abc.; expected",
        ),
        ({"mean": np.array([99.0, 0, 0, 0.7])}, (), "controller.calibration: payload_mass: got 99"),
        (
            {"mean": np.array([0.1, 0, 0, 1.7])},
            ("controller.delay_estimator=constant",),
            "controller.delay_max: got 1.5 s, less than the assumed delay of 1.7 s",
        ),
    ],
)
def test_what_cannot_be_used_is_refused_in_one_line(file, change, given, message):
    save_calibration(file, dataclasses.replace(KNOWN, **change))
    with pytest.raises(ConfigError, match=message):
        compose_law(experiment(f"controller.calibration={file}", *given))
    with pytest.raises(ConfigError, match=r"^controller\.calibration: .*nowhere"):
        experiment("controller.calibration=/nowhere/calibration.yaml")


def test_a_calibrated_delay_that_makes_the_loop_unstable_is_named(file):
    for delay, said in ((0.79, ["a delay of 0.79 s (controller.calibration)"]), (0.8, [])):
        save_calibration(file, dataclasses.replace(KNOWN, mean=np.array([0.4, 1e-3, 5e-4, delay])))
        found = experiment(f"controller.calibration={file}", "plant.kind=exact")
        lines = cautions_before(found, sd.controller_margin(found))
        assert len(lines) == len(said) and all(map(str.__contains__, lines, said))
    found = experiment("controller.delay_steps=7", "plant.kind=exact")
    lines = cautions_before(found, sd.controller_margin(found))
    assert len(lines) == 1 and "assumes a delay of 0.7 s (controller.delay_steps" in lines[0]
    assert "the scenario's is 0.8 s: leave both out, or set controller.delay_est" in lines[0]


def test_what_is_known_is_worth_something(file):
    """Friction that the estimator does not have, and parameters that it has to learn otherwise."""
    true = ("plant.payload_mass=0.4", "plant.joint_damping=1e-3", "plant.coulomb_friction=5e-4")
    save_calibration(file, dataclasses.replace(KNOWN, mean=np.array([0.4, 1e-3, 5e-4, 0.8])))
    settings = (*ON_REFERENCE, *true, "duration=5")
    told, not_told = (
        sd.simulate(
            sd.load_scenario("paper", "predictor_lqi", (*settings, *more)), judge_stability=False
        )
        for more in ([f"controller.calibration={file}"], [])
    )
    assert told.status == "completed"
    assert told.accumulated_error < 0.1
    assert not not_told.accumulated_error < 1  # or lost
