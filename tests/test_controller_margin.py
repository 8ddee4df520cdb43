"""The loop of a controller and its plant: stable or not, its margins, and what is said of it."""

import math
import re
from dataclasses import replace

import numpy as np
import pytest
import yaml
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import LeafSystem

import stewart_drake as sd
from stewart_drake.cli import main
from stewart_drake.files.resources import resolve
from stewart_drake.law.delay_model import sample, sample_in_steps
from stewart_drake.law.motion import Preview
from stewart_drake.law.sensing import Measurement
from stewart_drake.law.stability import fastest_pole
from stewart_drake.loop.cautions import cautions_after, cautions_before, coarse_step
from stewart_drake.loop.controller_margin import controller_margin, over_wire, true_model
from stewart_drake.loop.law_design import control_law
from stewart_drake.loop.platforms import MultibodyStewart
from stewart_drake.loop.preparation import prepare
from stewart_drake.mechanism.files import mechanism_yaml
from stewart_drake.mechanism.trajectories import evaluate
from stewart_drake.reporting.run import comparison_document
from stewart_drake.scenario.signals import NUM_TORQUES, POSE
from stewart_drake.studies.compare import CONTROLLERS
from stewart_drake.studies.delay import loop_margins
from stewart_drake.studies.verdict import assess, fold, loop_verdict
from tests.mechanisms import PAPER

HOLD = ("reference.kind=hold", "plant.kind=exact")
"""At rest at home nothing changes with time: what is linearised there is the loop."""


def scenario(*settings, controller=None, name="paper"):
    return sd.load_scenario(name, controller, settings)


def judged(sc):
    return controller_margin(prepare(sc))


# ---------------------------------------------------------------- against the law itself


SIZE = 1e-9
DIRECTION = np.random.default_rng(0).standard_normal(12)


def distances(sc, periods):
    """How two runs of the nonlinear law and plant come apart, that begin 2 SIZE apart.

    Torque by torque, with nothing of the linear loop: (periods + 1, 12).
    """
    experiment = prepare(sc)
    law = control_law(experiment)[0]
    truth, mu, share = experiment.true_dynamics(), sc.delay.steps, sc.delay.fraction
    held = np.array([share, 1 - share]) * sc.controller.period
    pair = []
    for sign in (1, -1):
        x = experiment.start + sign * SIZE * DIRECTION
        memory = law.initial_memory(experiment.torques_in_flight(law.timeline.delay))
        standing = np.zeros(NUM_TORQUES)
        if sc.queue == "equilibrium":
            standing = experiment.nominal.equilibrium_torque(experiment.start[POSE])
        sent, states = [standing] * (mu + 1), [x]
        for k in range(periods):
            times = k * sc.controller.period + law.preview_times
            rows = np.array([evaluate(experiment.reference, max(t, 0.0)) for t in times])
            preview = Preview(law.preview_times, rows)
            weights = np.array(sc.controller.weights)
            memory = law.step(memory, Measurement.of(x), preview, weights)
            sent.append(memory.torque)
            acting = np.array([sent[-mu - 2], sent[-mu - 1]])
            x = truth.predict(x, acting, held, substeps=20)[-1]
            states.append(x)
        pair.append(np.array(states))
    return np.asarray(pair[0] - pair[1])


def growth(sc, periods, last):
    """Factor per period over the `last` ones."""
    found = np.linalg.norm(distances(sc, periods), axis=1)
    assert found.max() < 1e-3, "no longer linear"
    return float((found[-1] / found[-1 - last]) ** (1 / last))


SHORT_PERIOD = ("controller.period=0.02", "delay.steps=5")
"""Over which the law's own integration of an unstable plant is exact enough."""
ALONE = (
    *HOLD,
    "controller.estimate=[]",
    "controller.catch_up=0",
    "controller.open_loop_start=false",
)


@pytest.mark.parametrize(
    ("controller", "settings", "periods"),
    [
        ("lqr", (), 50),
        ("lqi", (), 50),
        ("delay_lqr", (), 50),
        ("delay_lqi", (), 50),
        ("delay_lqi", ("controller.w_Q=1e-6",), 200),
        ("delay_lqi", ("delay.steps=3", "delay.fraction=0.4"), 30),
        ("delay_lqi", ("delay.steps=1", "controller.delay_steps=2"), 20),
        ("pd_gravity", (), 50),
        ("pd_gravity", ("controller.delay_steps=8", "controller.delay_fraction=0.4"), 40),
        ("predictor_lqi", (), 100),
        ("predictor_lqi", ("controller.model=paper",), 40),
        ("predictor_lqi", ("delay.fraction=0.5", "delay.steps=2"), 100),
        ("predictor_lqi", ("controller.delay_steps=7",), 40),
        ("predictor_lqi", ("plant.payload_mass=1.0", "plant.joint_damping=0.01"), 50),
        ("predictor_lqi", (*SHORT_PERIOD, "plant.gravity=true", "queue=equilibrium"), 90),
    ],
)
def test_the_linear_loop_is_what_the_law_itself_does(controller, settings, periods):
    sc = scenario(*ALONE, *settings, controller=controller)
    M = judged(sc).loops[0].matrix()
    expected = np.zeros((periods + 1, len(M)))
    expected[0, :12] = 2 * SIZE * DIRECTION
    for k in range(periods):
        expected[k + 1] = M @ expected[k]
    found = distances(sc, periods)
    sizes = np.linalg.norm(expected[:, :12], axis=1)
    assert sizes.max() < 0.1
    near = sizes < 1e-4  # beyond, the law is no longer linear
    off = np.linalg.norm(found - expected[:, :12], axis=1)[near] / sizes[near]
    assert off.max() < 0.01


@pytest.mark.parametrize(
    ("controller", "settings", "periods", "last"),
    [
        ("lqi", (), 50, 20),
        ("predictor_lqi", (), 100, 50),
        ("predictor_lqi", ("plant.payload_mass=1.0", "plant.joint_damping=0.01"), 40, 10),
    ],
)
def test_the_radius_is_how_the_law_itself_grows(controller, settings, periods, last):
    """The dominant eigenvalue of these loops is real."""
    sc = scenario(*ALONE, *settings, controller=controller)
    assert growth(sc, periods, last) == pytest.approx(judged(sc).radius, rel=0.03)


@pytest.mark.parametrize(("share", "stable"), [(0.6, True), (1.6, False)])
@pytest.mark.parametrize("later", [True, False])
def test_the_delay_margin_is_where_the_law_itself_begins_to_grow(later, share, stable):
    sc = scenario(*ALONE)
    margins = judged(sc).margins
    by = share * (margins.longer if later else -margins.shorter) / sc.controller.period
    steps, fraction = divmod(8 + by, 1.0)
    off = (f"delay.steps={steps:g}", f"delay.fraction={fraction!r}", "controller.delay_steps=8")
    wrong = scenario(*ALONE, *off)
    assert judged(wrong).stable is stable
    assert (growth(wrong, 160, 60) < 1) is stable


def apart(loop, longer, gain, periods):
    """Return the growth of an error of 1 by the recurrence of the loop, not by its matrix."""
    plant, K = loop.sampled(longer), loop.K
    e = np.ones(len(plant.A))
    known = (K.shape[1] - len(e)) // NUM_TORQUES
    sent = [np.zeros(NUM_TORQUES)] * (max(known, plant.steps + 1) + 1)
    for _ in range(periods):
        queue = np.concatenate([e, *sent[len(sent) - known :]])
        sent.append(-K @ queue)
        e = plant.A @ e + gain * (
            plant.B_old @ sent[-plant.steps - 2] + plant.B_new @ sent[-plant.steps - 1]
        )
    return float(np.abs(e).max())


def test_margins_along_the_reference_are_those_of_the_recurrence():
    """Just inside no loop along the reference grows, just outside one does."""
    found = judged(scenario("plant.kind=exact"))
    m = found.margins
    assert found.stable
    for longer, gain in (
        (m.longer, 1.0), (-m.shorter, 1.0), (0.0, m.gain_up), (0.0, m.gain_down),
    ):  # fmt: skip

        def worst(share, longer=longer, gain=gain):
            factor = 1 + share * (gain - 1)
            return max(apart(one, share * longer, factor, 1200) for one in found.loops)

        assert worst(0.9) < 1e-1
        assert worst(1.15) > 1e3


def test_what_is_known_of_the_papers_loops():
    """At the first pose alone 1.6 and 1.9 ms and 3.5 %; the worst along the way is less."""
    first = next(m for m in loop_margins(assess(scenario("plant.kind=exact")), ()) if m.steps == 8)
    assert 1e3 * first.margins.longer == pytest.approx(1.6, abs=0.05)
    assert first.margins.gain_up - 1 == pytest.approx(0.035, abs=0.001)
    m = judged(scenario("plant.kind=exact")).margins
    assert 0.5 * first.margins.longer < m.longer < first.margins.longer
    assert 0.5 * first.margins.shorter < m.shorter < first.margins.shorter
    assert 0.5 * (first.margins.gain_up - 1) < m.gain_up - 1 < first.margins.gain_up - 1
    for steps in (1, 2, 4, 8):
        off = judged(scenario("plant.kind=exact", f"delay.steps={steps}", controller="delay_lqi"))
        assert off.stable is False
        assert (off.margins.longer, off.margins.gain_up) == (0, 1)
    light = judged(scenario(*HOLD, "controller.w_Q=1e-6", controller="delay_lqi"))
    assert light.stable  # but at home only
    verdicts = {name: judged(scenario(controller=name)).stable for name in CONTROLLERS}
    assert verdicts == dict.fromkeys(CONTROLLERS, False) | {"predictor_lqi": True}


class Feedback(LeafSystem):
    """u = K (r - y), at once or, from its discrete state, a period later."""

    def __init__(self, K, period=None):
        super().__init__()
        self.K = K
        self.DeclareVectorInputPort("measurement", 12)
        self.DeclareVectorInputPort("reference", 18)
        if period is None:
            self.DeclareVectorOutputPort("torque", 6, lambda c, y: y.SetFromVector(self.torque(c)))
        else:
            last = self.DeclareDiscreteState(6)
            self.DeclareStateOutputPort("torque", last)
            self.DeclarePeriodicDiscreteUpdateEvent(period, 0.0, self.update)

    def torque(self, context):
        wanted = self.GetInputPort("reference").Eval(context)[:12]
        return self.K @ (wanted - self.GetInputPort("measurement").Eval(context))

    def update(self, context, state):
        state.set_value(self.torque(context))


class Counting(Feedback):
    """State that is not in the Context."""

    def torque(self, context):
        self.K = 1.1 * self.K
        return super().torque(context) + self.K[:, 0]


def test_the_margin_of_an_own_controller_is_that_of_the_same_law():
    """A period in its state counts as a period of delay."""
    early, late = (
        scenario(*HOLD, f"delay.steps={n}", "controller.period=0.02", controller="lqr")
        for n in (1, 2)
    )
    expected, law = judged(late), judged(early).loops[0].K
    for sc, period in ((late, None), (early, 0.02)):
        found = sd.controller_margin(sc, controller=lambda p=period: Feedback(law, p))
        assert found.radius == pytest.approx(expected.radius, rel=1e-6)
        now, then = found.margins, expected.margins
        gains = then.gain_down, then.gain_up
        assert (now.gain_down, now.gain_up) == pytest.approx(gains, rel=3e-3)
        assert now.longer == pytest.approx(then.longer, rel=3e-3)
        assert "w_R" not in str(found)
        models = sd.linear_models(sc, 0.0, controller=lambda p=period: Feedback(law, p))
        assert np.abs(models.S.poles()).max() == pytest.approx(expected.radius, rel=1e-6)
    run = sd.simulate(early, ("duration=0.1",), controller=lambda: Feedback(law, 0.02))
    assert run.summary["controller_margin"]["stable"] is expected.stable


def test_what_has_no_linear_model_is_not_judged():
    sc, K = scenario(*HOLD, "duration=1", "delay.steps=1"), np.zeros((6, 12))
    for controller, reason in (
        (Feedback(K), "was given as an instance; its class"),
        (lambda: Feedback(K, 0.05), "does not update once every 0.1 s"),
        (lambda: Counting(K + 1), "not a function of its inputs and its Context"),
        (lambda: Feedback(np.zeros((6, 11))), "fails on the reference"),
    ):
        found = sd.controller_margin(sc, controller=controller)
        assert found.stable is None and reason in found.problem


def test_a_delay_of_very_many_periods_is_not_judged_but_reported():
    experiment = prepare(scenario("delay.steps=900", "plant.kind=exact"))
    found = controller_margin(experiment)
    assert found.stable is None and math.isnan(found.radius)
    (said,) = cautions_before(experiment, found)
    assert said.startswith("the loop was not judged: with 900 periods of delay")


# ---------------------------------------------------------------- what is said of it


def test_a_run_tells_the_margin_of_its_loop():
    short = scenario("plant.kind=exact", "duration=0.5")
    told = sd.simulate(short).summary["controller_margin"]
    assert set(told) == {"stable", "spectral_radius", "delay_margin_s", "gain_margin", "growth"}
    for name, value in judged(short).summary.items():  # threads of BLAS round as they like
        np.testing.assert_allclose(told[name], value, rtol=1e-9, err_msg=name)
    down, up = told["gain_margin"]
    assert told["stable"] and told["spectral_radius"] < 1 and 0 < down < 1 < up
    assert min(told["delay_margin_s"]) > 0
    assert sd.simulate(short, judge_stability=False).summary["controller_margin"] is None
    unstable = sd.simulate(scenario("plant.kind=exact", "duration=1", controller="lqi"))
    assert unstable.status == "completed"
    assert any("unstable" in line for line in unstable.summary["warnings"])


def test_the_first_line_is_about_the_loop(capsys, monkeypatch):
    # Simulations over delay and amplitude have tests of their own.
    monkeypatch.setattr("stewart_drake.studies.delay.delay_map", lambda *_: ([], False))
    assert main(["analyze", "delay", "paper", "--controller", "lqi", "--set", "duration=2"]) == 0
    first, *others = capsys.readouterr().out.splitlines()
    assert first.startswith("This loop is unstable: linearised along the reference")
    alone = " ".join("".join(others).split())
    assert "The delay of 0.8 s (8 periods) can be compensated: under any controller" in alone
    run = ["simulate", "paper", "--controller", "lqi", "--set", "plant.kind=exact"]
    assert main(run) == 0
    first, *others = capsys.readouterr().out.splitlines()
    assert first.startswith("this loop is unstable: linearised along the reference")
    assert (fold(1.2345), fold(1.0004)) == ("1.23 fold", "by 0.04 %")
    assert any("left workspace" in line for line in others)
    settings = ("plant.kind=exact", "link.kind=network", "duration=0.2")
    assert main(["simulate", "paper", *(w for one in settings for w in ("--set", one))]) == 0
    out = capsys.readouterr().out
    assert "if every packet is in time, this loop is stable" in out and "judged" not in out
    result = sd.simulate(scenario(*settings))
    said = result.summary["warnings"]
    assert "warning: the loop was not judged" in comparison_document({"lqi": result}).plain()
    assert "warning:" not in comparison_document({"lqi": result}, said=said).plain()


def test_margins_over_a_network_count_the_way_back_of_the_measurements():
    """Packets of 4 periods and measurements of an age of 3 are judged as a wire of 7 steps."""
    period = "controller.period=0.02"
    network = (
        period,
        "link.kind=network",
        "link.low=0.015",
        "link.high=0.045",
        "link.playout=0.06",
    )
    back, late = "link.return={low: 0.015, high: 0.045}", "sensor.delay=0.06"
    wire = judged(scenario(period, "delay.steps=7", name="gravity"))
    for way in (back, late):
        found = controller_margin(over_wire(prepare(scenario(*network, way, name="gravity"))))
        assert found.eta == pytest.approx(0.14) and found.radius == pytest.approx(wire.radius)
        assert found.margins == pytest.approx(wire.margins)


@pytest.mark.parametrize("controller", ["pd_gravity", "lqr_gravity"])
def test_a_controller_that_assumes_no_delay_assumes_none_over_a_network(controller):
    over, wire = (
        controller_margin(over_wire(prepare(scenario(*HOLD, one, controller=controller))))
        for one in ("link={kind: network, low: 0.8, high: 0.8, playout: 0.9}", "delay.steps=10")
    )
    assert over.eta == wire.eta and over.radius == pytest.approx(wire.radius)


def test_commands_state_the_delay_from_a_measurement_to_its_torque(capsys):
    network = ("plant.kind=exact", "link.kind=network", "duration=0.2", "controller.period=0.1")
    words = [w for one in (*network, "link.return={low: 0.1, high: 0.15}") for w in ("--set", one)]
    assert main(["simulate", "paper", *words]) == 0
    out = " ".join(capsys.readouterr().out.split())
    assert "if every packet is in time and measurements are 0.2 s old, this loop is stable" in out
    assert "up to 1.3 s after their measurement" in out and "delay of 1.3 s (13 periods)" in out
    assert main(["compare", "paper", "--controllers", "predictor_lqi", *words]) == 0
    assert "the delay of 1.3 s (13 periods)" in capsys.readouterr().out
    assert main(["analyze", "delay", "paper", *words]) == 0
    out = " ".join(capsys.readouterr().out.split())
    assert "If every packet is in time and measurements are 0.2 s old, this loop is stable" in out
    assert "The delay of 1.3 s (13 periods)" in out


@pytest.mark.parametrize(
    ("kind", "median", "worst", "told"),
    [
        ("none", 9.9, 99.0, []),
        ("none", 10.1, 99.0, ["took 10.1 ms at the median"]),
        ("none", 5.0, 10.1, []),
        ("constant", 5.0, 9.9, []),
        ("constant", 5.0, 10.1, ["slowest step took 10.1 ms"]),
    ],
)
def test_steps_longer_than_the_period_are_reported(kind, median, worst, told):
    """The slowest step of a search for the delay counts; the period is 10 ms."""
    experiment = prepare(scenario(f"controller.delay_estimator={kind}", name="gravity"))
    summary = {
        "controller_step_ms": {"median": median, "worst": worst},
        "controller_margin": None,
        "counts": {"nonfinite_torque": 0},
        "estimator_consistency": {"nis_ratio": 1.0, "verdict": "consistent"},
        "status": "completed",
    }
    found = cautions_after(experiment, summary)
    assert len(found) == len(told) and all(map(str.__contains__, found, told))


def test_the_fastest_pole_is_reported_where_it_is(tmp_path):
    """The true machine does not reach one side; on the way up it falls."""
    path = tmp_path / "short.yaml"
    path.write_text(mechanism_yaml(replace(PAPER, crank_lengths=0.6 * PAPER.crank_lengths)))
    way = ((0.0, 0.38), (0.12, 0.38), (0.0, 0.38), (0.0, 0.43), (0.0, 0.38))
    poses = [[0.0, 0.0, 0.0, x, 0.0, z] for x, z in way]
    motion = ("reference.times=[0, 1, 2, 3, 4]", f"reference.poses={poses}", "duration=4")
    sc = scenario(
        f"plant.mechanism={path}", "reference.kind=waypoints", *motion, "start=on_reference",
        name="gravity",
    )  # fmt: skip
    experiment = prepare(sc)
    found = controller_margin(experiment)
    truth = experiment.true_dynamics()
    assert "does not reach" in found.problem and found.pole > 0
    again = fastest_pole(true_model(experiment, truth, found.pole_time).A)
    assert found.pole == pytest.approx(again, rel=1e-12)


# ---------------------------------------------------------------- the engine's step


def shrunk(folder, scale):
    """Return settings of the paper's machine and motion at `scale`, under gravity."""
    data = yaml.safe_load(resolve("mechanism", "paper").read_text())
    data["home"] = [scale * value for value in data["home"]]
    for name in ("base_radius", "plate_radius", "shaft_height"):
        data["pattern"][name] *= scale
    for part in ("base", "plate", "crank", "rod"):
        data[part]["mass"] *= scale**3
        data[part]["inertia"] = [scale**5 * value for value in data[part]["inertia"]]
        if "length" in data[part]:
            data[part]["length"] *= scale
    path = folder / "shrunk.yaml"
    path.write_text(yaml.safe_dump(data))
    sizes = [0.26, 0.26, 0.26, 0.02 * scale, 0.02 * scale, 0.08 * scale]
    return [
        f"mechanism={path}",
        f"reference.amplitude={sizes}",
        f"reference.offset={[0, 0, 0, 0, 0, 0.38 * scale]}",
        "delay.steps=8",
        "duration=4",
    ]


@pytest.mark.slow
def test_a_small_machine_is_warned_of_the_step_that_loses_it(tmp_path):
    """A plate of 80 mm: lost at 1 ms, followed at the step that is named."""
    small = shrunk(tmp_path, 1 / 3)
    small.append("plant.kind=multibody")
    result = sd.simulate(scenario(*small, name="gravity"))
    assert result.status == "left_workspace"
    said = result.summary["warnings"][0]
    assert "plant.time_step of 1 ms is too coarse" in said and "plant.kind=exact" in said
    step = next(word for word in said.split() if word.startswith("plant.time_step="))
    # The coarse step loses it after 1.4 s.
    finer = sd.simulate(scenario(*small, step, "duration=1.5", name="gravity"))
    assert finer.status == "completed"
    assert not any("too coarse" in line for line in finer.summary["warnings"])
    assert finer.accumulated_error < 0.01
    exact = scenario(*small, "plant.kind=exact", name="gravity")
    assert cautions_before(prepare(exact), judged(exact)) == []


@pytest.mark.slow
def test_shipped_scenarios_are_warned_only_where_the_step_is_too_coarse():
    for name in ("paper", "desktop", "motion_base"):
        sc = scenario(name=name)
        assert sc.plant.kind == "multibody"
        assert coarse_step(prepare(sc), judged(sc)) is None
    engine = "plant.kind=multibody"
    sc = scenario(engine, name="gravity")
    said = coarse_step(prepare(sc), judged(sc))
    assert said is not None and "plant.time_step=0.0002 would do" in said
    finer = scenario(engine, "plant.time_step=0.0002", name="gravity")
    assert coarse_step(prepare(finer), judged(finer)) is None
    # With a log of 0.75 ms, of which 0.2 ms are no part, nor 0.1.
    logged = scenario(engine, "plant.time_step=0.00025", "log_period=0.00075", name="gravity")
    margin = replace(judged(logged), _growths={0.00025: 1e9, 0.0002: 1.0, 0.0001: 1.0, 5e-5: 1.0})
    said = coarse_step(prepare(logged), margin)
    assert said is not None and "plant.time_step=5e-05 would do" in said
    logged.plant.time_step = 5e-5
    logged.check()


def test_a_range_without_room_is_called_so():
    """With gravity an error of 1 us is multiplied by 1e8 over 0.8 s."""
    said = loop_verdict(judged(scenario("plant.kind=exact", "plant.gravity=true", "duration=1")))
    assert "stable in exact arithmetic only" in said and "-0 ms" not in said
    blind = ("plant.kind=exact", "plant.gravity=true", "duration=1", "controller.period=0.02")
    said = loop_verdict(judged(scenario(*blind, "delay.steps=0", controller="lqr_gravity")))
    assert "delay errors from any below 0 to +3" in said
    said = loop_verdict(judged(scenario("plant.kind=exact", "duration=1")))
    assert re.search(r"-\S+ ms to \+\S+ ms, 0\.23 % of the delay, and", said)
    assert said.endswith("; a larger controller.w_R widens it")
    said = loop_verdict(judged(scenario("controller.w_R=1e4", "duration=1")))
    assert "of the delay" in said and "widens" not in said


def test_one_engine_step_is_semi_implicit_euler():
    """The multibody plant under a small constant torque, against the linear model in its steps."""
    step, number, torque = 5e-3, 20, 1e-4 * np.array([1.0, -2, 3, 1, 0.5, -1])
    plant = MultibodyStewart(PAPER, step, gravity=False)
    simulator = Simulator(plant)
    context = simulator.get_mutable_context()
    start = np.concatenate([PAPER.home, np.zeros(6)])
    plant.set_state(context, start)
    plant.GetInputPort("torque").FixValue(context, torque)
    simulator.AdvanceTo(number * step)
    moved = plant.GetOutputPort("state").Eval(context) - start
    A, B = sd.StewartDynamics(PAPER, gravity=False).linearize(PAPER.home)
    stepped = sample_in_steps(A, B, number * step, step)[1] @ torque
    smooth = sample(A, B, number * step)[1] @ torque
    assert moved == pytest.approx(stepped, rel=1e-3, abs=1e-3 * np.abs(stepped[POSE]).min())
    # Of the motion itself the pose is ahead by half a step: 2.5 of 50 ms on average.
    assert np.linalg.norm(moved[POSE] - smooth[POSE]) > 0.04 * np.linalg.norm(smooth[POSE])
