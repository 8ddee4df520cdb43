"""Learning from repetitions: the law with a learned torque, its file, and the study."""

import dataclasses
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from pydrake.systems.framework import LeafSystem

import stewart_drake as sd
from stewart_drake.cli import main
from stewart_drake.files.errors import ConfigError
from stewart_drake.law.learned import LearnedLqi, LearnedSignal, with_learned
from stewart_drake.loop.bulk import run_in_bulk
from stewart_drake.loop.learned import HARMONICS, harmonics_below, save_learned
from stewart_drake.loop.preparation import prepare
from stewart_drake.loop.results import Failure
from stewart_drake.loop.simulation import simulate
from stewart_drake.studies.learn import (
    Anderson,
    Fit,
    Lessons,
    corrected_setpoints,
    fit,
    study_learn,
)
from stewart_drake.studies.study_options import LearnOptions

EXACT = ("plant.kind=exact", "start=on_reference", "queue=reference")
AMPLITUDE = np.array([0.2617993878] * 3 + [0.02, 0.02, 0.08])
LAW = (
    f"reference.amplitude={(0.7 * AMPLITUDE).tolist()}",
    *("controller.estimate=[]", "controller.integral=false", "controller.w_R=100"),
)
BIAS = "plant.torque_bias=[3e-4, -3e-4, 3e-4, -3e-4, 3e-4, -3e-4]"
UNKNOWN = (
    "plant.coulomb_friction=1e-4",
    "plant.payload_mass=0.2",
    "plant.payload_position=[0.01, -0.008, 0.02]",
    BIAS,
)
"""Coulomb friction, a payload off the centre and biases, none of which the law can estimate."""


def scenario(*settings):
    return sd.load_scenario("paper", settings=(*EXACT, *settings))


def some_torque(period=2 * np.pi, size=1e-3):
    coefficients = np.zeros((1 + 2 * HARMONICS, 6))
    coefficients[[0, 1, 2, 1 + HARMONICS]] = size * np.random.default_rng(1).standard_normal((4, 6))
    return LearnedSignal(period, coefficients)


class Opposite(LeafSystem):
    """Torque at the shafts: minus a learned torque, held over each period of the controller."""

    def __init__(self, learned, dt):
        super().__init__()
        self._learned, self._dt = learned, dt
        self.DeclareVectorOutputPort("torque", 6, self._torque)

    def _torque(self, context, output):
        middle = (np.floor(context.get_time() / self._dt + 1e-6) + 0.5) * self._dt
        output.SetFromVector(-self._learned(np.array([middle]))[0])


def add(learned):
    return partial(with_learned, learned=learned)


def test_a_learned_torque_cancels_its_opposite_and_nothing_is_left_to_estimate():
    """The plant with the disturbance -l is the model, for torques without l."""
    learned = some_torque(size=2e-4)
    sc = scenario("duration=6")
    found, without = (
        sd.simulate(
            sc, modify_law=law, disturbance=Opposite(learned, 0.1), judge_stability=False
        ).signals
        for law in (add(learned), None)
    )
    assert np.abs(found.parameters.values[:, :6]).max() < 1e-5
    assert np.abs(without.parameters.values[:, :6]).max() > 1e-4
    after, missed = (np.abs(one.error[one.time >= 5.0]).max() for one in (found, without))
    assert after < 0.02 * missed


@pytest.mark.parametrize("fraction", [0.0, 0.4])
def test_the_python_law_takes_the_same_torque_as_the_core(fraction):
    learned = some_torque()
    sc = scenario("duration=2", f"delay.fraction={fraction}")

    def mine(law):
        class Mine(type(law.feedforward)):
            pass

        return LearnedLqi(**law.parts | {"feedforward": Mine()}, learned=learned)

    runs = [sd.simulate(sc, modify_law=one, judge_stability=False) for one in (add(learned), mine)]
    a, b = (one.signals.torque_commanded.values for one in runs)
    assert np.abs(a - b).max() < 1e-9 * np.abs(a).max()


def test_the_motors_limit_is_on_the_sum():
    learned = some_torque(size=1e-2)
    sc = scenario("duration=2", "actuator.torque_limit=0.012")
    found = sd.simulate(sc, modify_law=add(learned), judge_stability=False)
    asked = found.signals.torque_commanded.values[::5]
    assert np.abs(asked).max() > 0.012 >= found.summary["peak_torque_applied"]
    assert 0 < found.summary["counts"]["saturated_steps"] < 21


def test_a_fit_finds_the_harmonics_of_a_motion_that_is_no_multiple_of_the_period():
    learned = some_torque()
    times = 0.1 * np.arange(62) + 0.05
    found = fit(times, learned(times), 2 * np.pi, HARMONICS)
    np.testing.assert_allclose(found.coefficients, learned.coefficients, atol=1e-15)
    assert found.variance < 1e-30


def test_andersons_method_solves_what_repetition_does_not():
    """g(c) = b + A c with eigenvalues of -1.5 and 0.3: plain repetition diverges."""
    shape = (1 + 2 * HARMONICS, 6)
    b, size = np.random.default_rng(2).standard_normal(shape), np.prod(shape)
    slope = np.where(np.arange(size) % 2, -1.5, 0.3).reshape(shape)
    steps, used = Anderson(), np.zeros(shape)
    for _ in range(4):
        used = steps.after(Fit(b + slope * used, 0.0))
    np.testing.assert_allclose(used, b / (1 - slope), rtol=1e-9)


def test_differences_that_are_noise_are_not_extrapolated():
    shape, rng = (1 + 2 * HARMONICS, 6), np.random.default_rng(3)
    b, steps = rng.standard_normal(shape), Anderson()
    for _ in range(6):
        noise = 0.01 * rng.standard_normal(shape)
        used = steps.after(Fit(b + noise, 1e-4 * np.prod(shape)))
    assert np.std(used - b) < 0.012


@pytest.fixture(scope="module")
def file(tmp_path_factory):
    path = tmp_path_factory.mktemp("learned") / "learned.npz"
    save_learned(path, some_torque(), prepare(scenario()))
    return path


def test_a_file_gives_the_torque_that_was_saved(file):
    sc = scenario("duration=1", f"controller.learned={file}")
    read = sd.simulate(sc, judge_stability=False).signals
    given = sd.simulate(
        scenario("duration=1"), modify_law=add(some_torque()), judge_stability=False
    ).signals
    np.testing.assert_array_equal(read.torque_commanded.values, given.torque_commanded.values)


@pytest.mark.parametrize(
    ("setting", "message"),
    [
        ("controller.period=0.05", "another controller.period, s"),
        ("delay.steps=7", "another delay, s"),
        ("reference.frequency=1.1", "another period of the motion"),
        ("reference.amplitude=[0.1, 0, 0, 0, 0, 0]", "another motion"),
        ("reference.kind=hold", r"^controller\.learned: .*only a motion that repeats"),
        ("reference.frequency=[1, 1, 1, 1, 1, 0.9]", "several frequencies"),
        ("controller.limits=qp", "controller.learned"),
        ("link.kind=network", "controller.learned"),
        ("tuner.kind=rule", "controller.learned"),
        ("controller.delay_estimator=constant", "controller.learned"),
    ],
)
def test_a_file_is_refused_elsewhere_in_one_line(file, setting, message):
    with pytest.raises(ConfigError, match=message) as error:
        prepare_law(scenario(f"controller.learned={file}", setting))
    assert "\n" not in str(error.value)


def test_a_file_of_another_machine_or_damaged_is_refused(file, tmp_path):
    own = prepare(scenario())
    other = dataclasses.replace(own.mechanism, crank_lengths=1.01 * own.mechanism.crank_lengths)
    save_learned(tmp_path / "other.npz", some_torque(), own._replace(mechanism=other))
    bad = some_torque()
    bad.coefficients[0, 0] = np.nan
    save_learned(tmp_path / "nan.npz", bad, own)
    (tmp_path / "text.npz").write_text("text")
    (tmp_path / "cut.npz").write_bytes(file.read_bytes()[:300])
    np.savez(tmp_path / "names.npz", coefficients=bad.coefficients)
    damaged = r"cannot be read \(it is damaged, or of another kind\); expected a file that the"
    for name, message in (
        *(("other.npz", "another machine"), ("nan.npz", "NaN"), ("text.npz", damaged)),
        *(("cut.npz", damaged), ("names.npz", r"names\.npz: has arrays of other names, kinds")),
        ("none.npz", r"none\.npz: cannot be read \(No such file or directory\); expected"),
    ):
        with pytest.raises(ConfigError, match=message):
            prepare_law(scenario(f"controller.learned={tmp_path / name}"))


def prepare_law(sc):
    from stewart_drake.loop.law_design import compose_law

    return compose_law(prepare(sc))


def test_boards_and_setpoints_do_not_get_a_learned_torque(file, tmp_path):
    sc = scenario(f"controller.learned={file}")
    with pytest.raises(ConfigError, match=r"^controller\.learned: "):
        sd.export_c(sc, tmp_path)
    with pytest.raises(ConfigError, match=r"^controller\.learned: got .*torques"):
        sd.setpoints(sc, 10.0, plain=True)


@pytest.mark.parametrize(
    "setting", ["reference.kind=hold", "link.kind=network", "controller.limits=qp"]
)
def test_what_cannot_be_learned_is_refused(setting):
    with pytest.raises(ConfigError, match=r"^[^\n]+$"):
        study_learn(scenario(setting), LearnOptions())


def test_the_command_describes_no_network_that_it_refuses(capsys):
    assert main(["learn", "paper", "--set", "link.kind=network"]) == 2
    out, err = capsys.readouterr()
    assert out == "" and err.startswith("error: link.kind: got 'network' for learning")


@pytest.mark.slow
@pytest.mark.parametrize("frequency", [2 * np.pi / 6, 1.0])
def test_four_corrections_remove_friction_payload_and_bias(frequency):
    sc = scenario(*LAW, *UNKNOWN, f"reference.frequency={frequency}")
    found = study_learn(sc, LearnOptions(repetitions=5))
    errors = [one.error for one in found.repetitions]
    assert 13 < errors[0] < 15 and found.best.error < 0.1
    assert found.summary["best"] == 5


@pytest.mark.slow
def test_learning_leaves_to_the_estimator_what_it_finds():
    """Payload and biases are estimated: there is next to nothing to learn."""
    sc = scenario("plant.payload_mass=0.4", BIAS)
    found = study_learn(sc, LearnOptions(repetitions=3))
    assert max(one.error for one in found.repetitions) < 0.02


@pytest.mark.slow
def test_estimated_friction_is_not_learned_a_second_time():
    """With encoders; before, the second repetition had 4.4."""
    settings = ("plant.coulomb_friction=1e-4", "sensor.kind=encoders", "sensor.bits=14")
    sc = scenario(*settings, "controller.estimate=[coulomb]")
    found = study_learn(sc, LearnOptions(repetitions=2))
    assert max(one.error for one in found.repetitions) < 0.1
    assert found.competing == []
    assert found.estimable == "controller.estimate=[coulomb,payload_position]"


@pytest.mark.slow
@pytest.mark.usefixtures("blank_figures")
def test_the_command_writes_what_a_run_uses(tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    settings = [word for one in (*EXACT, *LAW, *UNKNOWN) for word in ("--set", one)]
    out = Path("out")
    assert main(["learn", "paper", *settings, "--repetitions", "2", "--out", str(out)]) == 0
    text, told = capsys.readouterr()
    assert "Learning lowers E" in text and "learned.npz" in text and "from before" not in told
    assert max(map(len, text.splitlines())) <= 80
    page = (out / "report.html").read_text()
    assert page.count("<iframe") == 2
    errors = []
    for more in ([], ["--set", f"controller.learned={out / 'learned.npz'}"]):
        run = f"run{len(more)}"
        assert main(["simulate", "paper", *settings, *more, "--quiet", "--out", run]) == 0
        errors.append(sd.read_log(run).error)
    before, after = (np.abs(one.sel(time=slice(5, None)).values).max() for one in errors)
    assert after < 0.25 * before


SERVOS = ("reference.frequency=3", "queue=reference", "start=on_reference")


def head(*settings):
    return sd.load_scenario("reachy_mini", settings=(*SERVOS, *settings))


def test_learned_setpoints_are_added_in_the_middle_of_the_period_in_which_they_act():
    learned = some_torque(2 * np.pi / 3, 1e-3)
    sc = head("duration=0.4", "actuator.angle_range=null")
    dt, eta = 0.02, 0.04
    commands = []
    for change in (None, add(learned)):
        found = []

        def record(law, change=change, found=found):
            changed = law if change is None else change(law)

            class Recorded(type(changed)):
                def step(self, *given):
                    memory = super().step(*given)
                    found.append(memory.command)
                    return memory

            return Recorded(**vars(changed))

        sd.simulate(sc, modify_law=record, judge_stability=False)
        commands.append(np.array(found))
    plain, corrected = commands
    acting = dt * np.arange(len(plain)) + eta + dt / 2
    np.testing.assert_allclose((corrected - plain)[:, :6], learned(acting), atol=1e-15)
    np.testing.assert_array_equal((corrected - plain)[:, 6:], 0)


def test_runs_in_bulk_have_the_learned_setpoints(tmp_path):
    file, plain = tmp_path / "l.npz", ("controller.estimate=[]", "duration=0.4")
    save_learned(file, some_torque(2 * np.pi / 3), prepare(head(*plain)))
    sc = head(*plain, f"controller.learned={file}")
    ending, result = run_in_bulk(sc), sd.simulate(sc, judge_stability=False)
    assert ending.loop == "drake, controller.learned"
    assert ending.error_so_far == result.summary["accumulated_error"]
    assert ending.error_so_far > 2 * run_in_bulk(head(*plain)).error_so_far


def test_a_late_servo_gets_its_setpoint_early():
    """u + lag u' followed with that lag is u: a servo of first order needs one correction."""
    period, lag, wanted = 2.0, 0.03, some_torque(2.0)
    dt = 1e-4
    at = dt * np.arange(round(period / dt))
    slope = (wanted(at + 1e-6) - wanted(at - 1e-6)) / 2e-6
    missed = fit(at, wanted(at), period, HARMONICS)
    found = LearnedSignal(period, corrected_setpoints(0.0, missed, period, lag).coefficients)
    np.testing.assert_allclose(found(at), wanted(at) + lag * slope, atol=1e-9)


def test_setpoints_of_a_file_are_refused_where_torques_are_asked_for(tmp_path):
    sc = head()
    save_learned(tmp_path / "l.npz", some_torque(2 * np.pi / 3), prepare(sc))
    with np.load(tmp_path / "l.npz") as arrays:
        kept = dict(arrays) | {"command": np.array("torque")}
    np.savez(tmp_path / "torque.npz", **kept)
    assert sd.setpoints(head(f"controller.learned={tmp_path / 'l.npz'}"), 50.0) is not None
    with pytest.raises(ConfigError, match=r"another controller\.command"):
        sd.simulate(head(f"controller.learned={tmp_path / 'torque.npz'}"))
    with pytest.raises(ConfigError, match="rate: got 40 Hz"):
        sd.setpoints(head(f"controller.learned={tmp_path / 'l.npz'}"), 40.0)


def test_setpoints_are_refused_where_they_were_learned_with_others(tmp_path):
    file = tmp_path / "plain.npz"
    plain = "controller.feedforward=none"
    save_learned(file, some_torque(2 * np.pi / 3), prepare(head(plain)))
    with pytest.raises(ConfigError, match=r"another controller\.command or feedforward"):
        sd.setpoints(head(f"controller.learned={file}"), 50.0)
    with pytest.raises(ConfigError, match=r"^controller\.feedforward: got none"):
        sd.setpoints(head(plain, f"controller.learned={file}"), 50.0)
    learned = sd.setpoints(head(plain, f"controller.learned={file}"), 50.0, plain=True)
    without = sd.setpoints(head(plain), 50.0, plain=True)
    added = some_torque(2 * np.pi / 3)(learned.times + 0.01)
    np.testing.assert_allclose(learned.angles - without.angles, added, atol=1e-15)
    # `learn` does not know this friction and learns it, `setpoints` would compensate it again.
    rubs = "plant.ball_joint_friction=0.01"
    save_learned(file, some_torque(2 * np.pi / 3), prepare(head(rubs)))
    learned = sd.setpoints(head(f"controller.learned={file}"), 50.0)
    torque = learned.torques - sd.setpoints(head(), 50.0).torques
    np.testing.assert_allclose(torque, 10 * added, atol=1e-12)  # stiffness, checked with the limit
    for other in (rubs, "actuator.stiffness=9"):
        with pytest.raises(ConfigError, match=r"learned with another .*stiffness 10,.*; expected"):
            sd.setpoints(head(other, f"controller.learned={file}"), 50.0)


@pytest.mark.slow
def test_learned_setpoints_remove_what_plain_setpoints_lack():
    """Torque, velocity gain and damping, which no setpoint of these compensates."""
    sc = head("controller.feedforward=none")
    found = study_learn(sc, LearnOptions(repetitions=4))
    errors = [one.error for one in found.repetitions]
    assert found.best.error < 0.05 * errors[0]


FAST = (
    *LAW,
    *("reference.amplitude=[0.02,0.02,0.02,0.002,0.002,0.005]", "reference.frequency=3"),
    *("plant.coulomb_friction=2e-4", "delay.steps=3", "plant.kind=exact"),
)
"""A motion of 20 samples a period."""


def test_a_motion_of_few_samples_is_learned(tmp_path):
    """A period of 20 samples determines four harmonics twice over."""
    assert [harmonics_below(n * 0.1, 0.1) for n in (4.5, 6.5, 20.5, 34.5, 90)] == [0, 1, 4, 8, 8]
    found = sd.learn(sd.load_scenario("paper", settings=FAST), repetitions=3)
    first, *_, last = found.study.repetitions
    assert last.error < 0.1 * first.error < 1
    assert "More is learned" not in str(found)
    films = found.replay(tmp_path)
    assert list(films) == ["repetition_1", "repetition_3"]
    numbers = (1, found.summary["best"])
    for path, number in zip(films.values(), numbers, strict=True):
        assert f"repetition {number}" in path.read_text()


@pytest.mark.parametrize(("share", "repetitions"), [(0.1, 3), (0.3, 2), (0.7, 1)])
def test_learning_ends_with_a_word_where_too_much_is_not_measured(share, repetitions):
    lost = f"sensor.faults=[{{kind: missing, from: 0, to: 1000, share: {share}}}]"
    found = sd.learn(sd.load_scenario("paper", settings=(*FAST, lost)), repetitions=3)
    errors, said = found.summary["errors"], " ".join(str(found).split())
    early = repetitions < 3
    assert len(errors) == repetitions and found.summary["lacking_measurements"] == early
    assert (f"repetition {repetitions} had too few measurements" in said) == early
    assert ("Nothing is learned" in said) == (repetitions == 1)
    assert repetitions == 1 or errors[-1] < 0.2 * errors[0]
    assert not found.summary["stopped"]


@pytest.mark.parametrize("samples", [5, 6])
def test_a_lost_sample_of_few_does_not_cost_the_only_harmonic(samples):
    lessons = Lessons(sd.load_scenario("paper", settings=(*FAST, "reference.frequency=10")))
    assert lessons.least == 5
    times = 0.1 * np.arange(samples)
    learned = lessons.learned(times, np.outer(np.cos(10 * times), np.ones(6)))
    assert np.abs(learned.coefficients[1]).min() > 0.5


def test_what_takes_a_part_of_the_missing_torque_is_named():
    period = ("reference.frequency=3", "delay.steps=3", "plant.coulomb_friction=1e-4")
    found = sd.learn(scenario("duration=3", *period), repetitions=2)
    said = " ".join(str(found).split())
    assert "--set controller.estimate=[] --set controller.integral=false" in said


def test_nothing_is_learned_from_a_lost_first_repetition(tmp_path, monkeypatch, capsys):
    """Learning from what happens before a loss gave torques of 3 kN m."""
    monkeypatch.chdir(tmp_path)
    settings = ("controller.estimate=[]", "controller.integral=false", "plant.coulomb_friction=0.1")
    settings = [word for one in (*EXACT, *settings) for word in ("--set", one)]
    assert main(["learn", "paper", *settings, "--repetitions", "3"]) == 0
    said, warned = capsys.readouterr()
    said = " ".join(said.split())
    assert said.startswith("Nothing is learned, because the first repetition is lost: leg ")
    assert "simulate completes, such as a smaller reference.amplitude." in said
    assert said.count(" end of its reach") == 2 and "Warning" not in warned  # head and one row


def test_a_lost_repetition_ends_learning_and_the_best_one_is_kept(monkeypatch):
    def lost(*args, **kwargs):
        result = simulate(*args, **kwargs)
        runs.append(result)
        failure = Failure(1.0, 2, 0.0, "leg 2 reached the end of its reach")
        end = {"status": "left_workspace", "stopped": failure} if len(runs) == 3 else {}
        return dataclasses.replace(result, **end)

    runs = []
    monkeypatch.setattr("stewart_drake.studies.learn.simulate", lost)
    found = sd.learn(sd.load_scenario("paper", settings=FAST), repetitions=5)
    said = " ".join(str(found).split())
    assert len(runs) == 3 and found.summary["best"] == 2 and not found.summary["stopped"]
    assert "Learning ended because repetition 3 is lost: leg 2" in said
