"""Controllers, references and disturbances of a user in the loop of a scenario."""

import json
import re
from types import SimpleNamespace

import numpy as np
import pytest
from pydrake.systems.framework import LeafSystem
from pydrake.systems.primitives import ConstantVectorSource
from pydrake.trajectories import FunctionHandleTrajectory, PiecewisePolynomial

import stewart_drake as sd
from stewart_drake.loop.own import take
from stewart_drake.loop.preparation import as_experiment, prepare
from stewart_drake.reporting.report import verdict
from stewart_drake.reporting.results import ComparisonResult
from tests.test_analysis_scripts import script

FAST = ("plant.kind=exact", "delay.steps=0", "controller.period=0.01", "start=on_reference")
"""No delay, so that a controller which knows of none can hold the plate."""


def scenario(*settings):
    return sd.load_scenario("paper", settings=(*FAST, *settings))


class Constant(LeafSystem):
    """Any ports; every output is constant."""

    def __init__(self, inputs=(), outputs=(), value=0.0):
        super().__init__()
        for name, size in inputs:
            self.DeclareVectorInputPort(name, size)
        for name, size in outputs:
            self.DeclareVectorOutputPort(
                name, size, lambda context, output, n=size: output.SetFromVector(np.full(n, value))
            )


def controller(inputs=(("measurement", 12),), outputs=(("torque", 6),), value=0.0):
    return Constant(inputs, outputs, value)


class OfTime(LeafSystem):
    """A controller that asks the same of all motors, a function of the time."""

    def __init__(self, torque):
        super().__init__()
        self.DeclareVectorInputPort("measurement", 12)
        self.DeclareVectorOutputPort(
            "torque",
            6,
            lambda context, output: output.SetFromVector(np.full(6, torque(context.get_time()))),
        )


def disturbance(name="torque", size=6, value=0.0):
    return Constant((), ((name, size),), value)


# ------------------------------------------------------------------ the examples


@pytest.mark.slow
@pytest.mark.usefixtures("blank_figures")
@pytest.mark.parametrize("plant", ["exact", "multibody"])
def test_own_computed_torque_controller_with_table_figures_and_replay(tmp_path, capsys, plant):
    result = script("own_controller").main(str(tmp_path), "duration=2", f"plant.kind={plant}")
    table = capsys.readouterr().out
    assert "completed" in table and "ComputedTorque" in table
    assert result.summary["own"] == {"controller": "ComputedTorque"}
    # Poles of the error at -10 /s, sampled a hundred times a second: it follows to a millimetre.
    assert np.abs(result.signals.error.values).max() < 1e-3
    names = {path.name for path in tmp_path.iterdir()}
    assert {"states.png", "errors.svg", "torques.png", "signals.nc", "replay.html"} <= names
    assert "parameters.png" not in names, "nobody estimated any"
    saved = json.loads((tmp_path / "summary.json").read_text())
    margin = saved["controller_margin"]
    assert margin["stable"] and 0.904 < margin["spectral_radius"] < 0.93  # e^-0.1 without the hold


def test_own_kick_moves_the_plate_at_three_seconds(capsys):
    results = script("own_disturbance").main("plant.kind=exact", "duration=4")
    assert "kicked: E_ac" in capsys.readouterr().out
    calm, kicked = (results[name].signals.pose.sel(coordinate="x") for name in ("calm", "kicked"))
    moved = np.abs(kicked - calm)
    assert moved.sel(time=slice(0, 2.999)).max() == 0
    assert moved.sel(time=slice(3.05, 3.4)).max() > 1e-3
    assert results["kicked"].summary["own"] == {"disturbance": "Kick"}


def test_a_wrench_gives_the_momentum_of_its_impulse():
    """A free plate, no gravity: right after a short push M rates = N' integral of the wrench."""
    kick, settings = script("own_disturbance").Kick, ("reference.kind=hold", "duration=0.002")
    sc = scenario(*settings, "plant.accuracy=1e-12")
    start = np.array(sc.reference.offset)
    force = (30.0, -20.0, 40.0)
    result = sd.simulate(sc, controller=controller, disturbance=lambda: kick(force, 0.0))
    rates = result.signals.rates.values[-1]
    dynamics = sd.StewartDynamics(sd.load_mechanism("paper"), gravity=False)
    momentum = dynamics.mass_matrix(start) @ rates
    np.testing.assert_allclose(momentum, [0, 0, 0, *0.002 * np.array(force)], atol=2e-5)


@pytest.mark.parametrize("plant", ["exact", "multibody"])
def test_disturbing_torque_is_the_same_as_a_bias(plant):
    settings = ("duration=0.3", f"plant.kind={plant}")
    bias = np.array([0.02, -0.01, 0.03, 0.0, 0.01, -0.02])
    biased = sd.simulate(
        scenario(*settings, f"plant.torque_bias={bias.tolist()}"), judge_stability=False
    )
    system = ConstantVectorSource(bias)
    with pytest.raises(sd.ConfigError, match=r"and output torque \(6\)"):
        sd.simulate(scenario(*settings), disturbance=system)  # its port has another name
    pushed = sd.simulate(
        scenario(*settings), disturbance=lambda: disturbance(value=bias), judge_stability=False
    )
    np.testing.assert_allclose(pushed.signals.pose, biased.signals.pose, atol=1e-12)


# ------------------------------------------------------------------ sampling, counts, exceptions


def test_own_torque_is_sampled_held_limited_and_delayed():
    sc = scenario(
        "controller.period=0.1",
        "delay.steps=2",
        "delay.fraction=0.5",
        "actuator.torque_limit=0.25",
        "reference.kind=hold",
        "duration=0.9",
    )
    s = sd.simulate(sc, controller=lambda: OfTime(lambda t: t)).signals.sel(leg=1)
    held = 0.1 * np.floor(s.time.values / 0.1 + 1e-6)
    np.testing.assert_allclose(s.torque_commanded, held, atol=1e-9)
    late = 0.1 * np.floor((s.time.values - 0.25) / 0.1 + 1e-6)
    np.testing.assert_allclose(s.torque_applied, np.clip(late, 0, 0.25), atol=1e-9)


def test_what_is_no_number_is_sent_as_before_and_counted():
    def broken():
        return OfTime(lambda t: np.nan if 0.045 < t < 0.075 else 1e-3)

    faults = "sensor.faults=[{kind: missing, from: 0.02, to: 0.04}]"
    result = sd.simulate(scenario("duration=0.1", faults), controller=broken)
    counts = result.summary["counts"]
    assert counts["nonfinite_torque"] == 3 and counts["measurements_missing"] == 2
    assert any("not finite at 3 samples" in said for said in result.summary["warnings"])
    assert "without a finite torque" not in result.table()
    never = sd.simulate(scenario("duration=0.1"), controller=lambda: OfTime(lambda t: np.nan))
    assert "completed, without a finite torque" in " ".join(never.table().split())
    assert (result.signals.torque_commanded == 1e-3).all()
    for name in ("integral", "weights", "parameters", "state_estimate"):
        assert np.isnan(result.signals[name]).all()


def test_a_run_without_a_torque_has_no_score():
    run = sd.simulate(scenario("duration=0.1"), controller=lambda: OfTime(lambda t: np.nan))
    assert re.search(r"E_ac +none$", run.table(), re.MULTILINE)
    (outcome,) = re.findall(r"completed, .*", run.replay().html)
    assert "without a finite torque" in outcome and "E_ac" not in outcome
    table = ComparisonResult({"broken": run}).table()
    assert re.search(r"^broken +no finite( +-)+ ", table, re.MULTILINE)
    workspace = SimpleNamespace(summary={})
    text, tone = verdict(SimpleNamespace(run=run, analyses={"workspace": workspace}))
    assert tone == "bad" and "never had a finite torque" in text and "E_ac" not in text


def test_a_mistake_in_a_system_is_an_exception():
    def mistake(time):
        raise RuntimeError("my own mistake")

    with pytest.raises(RuntimeError, match="my own mistake"):
        sd.simulate(scenario("duration=0.1"), controller=lambda: OfTime(mistake))


@pytest.mark.parametrize(
    ("size", "error", "note"),
    [
        (6, ZeroDivisionError, "in controller Own, with output torque (6), at t = 0.05 s"),
        (5, IndexError, "in controller Own, with output torque (6), at t = 0 s"),
    ],
)
def test_an_exception_of_a_system_names_it_and_the_time(size, error, note):
    class Own(LeafSystem):
        def __init__(self):
            super().__init__()
            self.DeclareVectorInputPort("measurement", 12)
            self.DeclareVectorOutputPort("torque", 6, self.calc)

        def calc(self, context, output):
            output.SetFromVector([0 // (context.get_time() < 0.045)] * size)

    with pytest.raises(error) as caught:
        sd.simulate(scenario("duration=0.1"), controller=Own)
    assert caught.value.__notes__ == [note]


# ------------------------------------------------------------------ the border


def test_a_controller_is_also_a_shipped_name_or_a_file(tmp_path):
    """It is laid over the scenario's, as by `load_scenario`, wherever an own system is accepted."""
    chosen, laid = scenario("duration=0.1"), sd.load_scenario(scenario("duration=0.1"), "lqi")
    path = tmp_path / "mine.yaml"
    path.write_text("integral: false")
    run = sd.simulate(chosen, controller="lqi", judge_stability=False)
    assert run.scenario == laid and run.summary["own"] == {}
    assert not sd.build_closed_loop(chosen, controller=path).experiment.scenario.controller.integral
    found, expected = sd.controller_margin(chosen, controller="lqi"), sd.controller_margin(laid)
    assert found.summary == expected.summary
    assert sd.linear_models(chosen, 0.0, controller=str(path)).law.nstates == 0, "no integral"
    with pytest.raises(sd.ConfigError, match=r"controller: got 'no'; expected one of adaptive_lqi"):
        sd.simulate(chosen, controller="no")
    with pytest.raises(TypeError, match="controller: got one with a loop that has its own"):
        sd.simulate(prepare(chosen), controller="lqi")


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"controller": 3}, "controller: got a int; expected a Drake system"),
        (
            {"controller": lambda: "x"},
            "controller: got a str; expected a Drake system with inputs measurement (12), if want",
        ),
        (
            {"controller": lambda x: x},
            "controller: got a function (missing a required argument: 'x'); expected a Drake",
        ),
        ({"modify_law": lambda: 3}, "modify_law: got a function (too many positional arguments);"),
        (
            {"controller": lambda: controller((("measurement", 6),))},
            "got inputs measurement (6) and outputs torque (6); expected inputs measurement (12)",
        ),
        (
            {"controller": lambda: controller((("measurement", 12), ("state", 12)))},
            "expected inputs measurement (12), if wanted reference (18)",
        ),
        ({"disturbance": lambda: disturbance("force")}, "and output torque (6) or wrench (6)"),
        (
            {"disturbance": lambda: disturbance("wrench", 3)},
            "outputs wrench (3); expected inputs none, and output",
        ),
        ({"sensor": controller}, "sensor: Constant: got inputs measurement (12)"),
        (
            {"link": lambda: Constant((("commanded", 6),))},
            "expected inputs commanded (6), and output torque (6)",
        ),
        ({"tuner": lambda: Constant((("state", 12),))}, "density (18), measurement (12), refer"),
        ({"modify_law": 3}, "modify_law: got a int; expected a function of the scenario's law"),
        (
            {"modify_law": lambda law: None},
            "modify_law: got a NoneType from the function; expected a Predict",
        ),
        (
            {"modify_law": lambda law: law, "controller": controller},
            "modify_law: got one with a controller",
        ),
        ({"reference": np.zeros(6)}, "reference: got a ndarray; expected a Drake trajectory"),
        (
            {"reference": PiecewisePolynomial(np.zeros((3, 1)))},
            "got shape (3, 1); expected (6, 1), the pose",
        ),
        (
            {"reference": FunctionHandleTrajectory(lambda t: np.zeros((6, 1)), 6, 1, 0.0, 9.0)},
            "expected derivatives of order 1 and 2",
        ),
        (
            {"reference": PiecewisePolynomial.FirstOrderHold([0, 0.05], np.eye(6, 2))},
            "an end at 0.05 s with rates",
        ),
        (
            {"reference": PiecewisePolynomial.FirstOrderHold([0, 0.05, 1], np.eye(6, 3))},
            "got a jump of 21.1 in the rates at 0.05 s",
        ),
        (
            {"reference": PiecewisePolynomial.ZeroOrderHold([0, 0.05, 1], np.eye(6, 3))},
            "got a jump of 1 in the pose at 0.05 s",
        ),
        (
            {"reference": PiecewisePolynomial.ZeroOrderHold([0.05, 1], np.zeros((6, 2)))},
            "a start at 0.05 s; expected one at 0 s or before",
        ),
        (
            {"reference": PiecewisePolynomial(np.full((6, 1), np.nan))},
            "expected finite numbers",
        ),
        ({"reference": PiecewisePolynomial(np.zeros((6, 1)))}, "expected a motion within reach"),
    ],
)
def test_what_does_not_fit_is_refused_in_one_line(given, message):
    with pytest.raises(sd.ConfigError) as refused:
        sd.simulate(scenario("duration=0.1"), **given)
    assert message in str(refused.value) and "\n" not in str(refused.value)


def test_an_instance_serves_one_run():
    system = controller()
    sd.simulate(scenario("duration=0.02"), controller=system)
    with pytest.raises(sd.ConfigError, match="an instance that has been in a loop already"):
        sd.simulate(scenario("duration=0.02"), controller=system)
    for _ in range(2):
        sd.simulate(scenario("duration=0.02"), controller=controller)
    spared = controller()
    with pytest.raises(sd.ConfigError, match="within reach"):
        sd.simulate(scenario("reference.offset=[0, 0, 0, 0, 0, 9]"), controller=spared)
    sd.simulate(scenario("duration=0.02"), controller=spared)  # it was in no loop yet


def test_a_tuner_needs_the_shipped_controller():
    with pytest.raises(sd.ConfigError, match="with a controller of your own; expected 'fixed'"):
        sd.simulate(scenario("duration=0.1", "tuner.kind=ann"), controller=controller)


# ------------------------------------------------------------------ reference


def test_own_reference_that_ends_is_held_there():
    knots = np.tile([[0.0], [0], [0], [0], [0], [0.38]], (1, 2)) + np.outer(
        [0] * 5 + [0.01], [0, 1]
    )
    still = np.zeros(6)
    motion = PiecewisePolynomial.CubicHermite([0, 0.5], knots, np.column_stack([still, still]))
    experiment = prepare(scenario("duration=2"), own=take({"reference": motion}))
    reference = experiment.reference
    for t in (0.5, 0.7, 5.0):
        np.testing.assert_allclose(reference.value(t)[:, 0], knots[:, 1])
    np.testing.assert_array_equal(reference.EvalDerivative(0.7, 1), np.zeros((6, 1)))
    np.testing.assert_allclose(experiment.peak_to_peak, [0, 0, 0, 0, 0, 0.01], atol=1e-12)


def test_systems_beside_an_experiment_are_refused_by_everybody():
    prepared = prepare(scenario("duration=0.05"))
    for build in (sd.build_closed_loop, sd.simulate):
        with pytest.raises(TypeError, match="controller: got one with a loop that has its own"):
            build(prepared, controller=Constant)


def test_an_unknown_argument_is_refused_by_everybody():
    for build in (sd.build_closed_loop, as_experiment):
        for name in ("truth", "law", "foo"):
            with pytest.raises(TypeError, match=f"unexpected keyword argument '{name}'"):
                build(scenario("duration=0.05"), **{name: None})
