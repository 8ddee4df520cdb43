"""`live --learn`: torques, or setpoints of servos, learned from a machine, in real time."""

import dataclasses

import numpy as np
import pytest

import stewart_drake as sd
from stewart_drake.cli import main
from stewart_drake.cli.common import Delivery
from stewart_drake.cli.live import LOG, _delivered
from stewart_drake.law.sensing import Measurement
from stewart_drake.law.servos import rise
from stewart_drake.live import design as designing
from stewart_drake.live import learning
from stewart_drake.live.exchange import Exchange
from stewart_drake.live.learned import LearnedSetpoints, LearnedTorques
from stewart_drake.live.learning import LiveLessons, learn_live
from stewart_drake.live.log import LiveRecord
from stewart_drake.live.loop import LiveLoop
from stewart_drake.live.options import LiveOptions
from stewart_drake.live.protocol import MachineFlags
from stewart_drake.loop.learned import motion_period, save_learned
from stewart_drake.loop.preparation import prepare
from stewart_drake.mechanism.trajectories import evaluate
from stewart_drake.reporting.learn import document
from stewart_drake.reporting.page import Provenance, html, unbroken
from stewart_drake.scenario.signals import NUM_PARAMETERS
from stewart_drake.studies.learn import LearnStudy, Repetition
from tests import test_learn
from tests.live_driver import in_real_time, running_machine
from tests.test_learn import UNKNOWN, some_torque
from tests.test_live import FROM_REST, OVER_A_NETWORK

STEPS = "delay.steps=13"
PERIOD = 2 * np.pi / 3.14159


class Message:
    """What a design reads from a machine's message."""

    torque_limit, flags = np.inf, MachineFlags(0)


def plan_of(learned, by_hand=lambda: False):
    """Return the learned part of a plan as a function of its time."""
    scenario = sd.load_scenario("reachy_mini", settings=(STEPS,))
    made = designing.design(scenario, Message(), designing.always(learned))
    part = LearnedSetpoints(made)
    return lambda t: part.plan(t, made.rows, by_hand())


def test_what_was_learned_begins_and_ends_softly_and_is_by_the_time_of_the_motion():
    signal, on_hand = some_torque(PERIOD, 0.05), [False]
    plan = plan_of(signal, lambda: on_hand[0])
    plans = []
    for k in range(120):
        on_hand[0] = k >= 80
        plans.append(plan(0.02 * k))
    first = np.array([plan[0] for plan in plans])
    times = 0.02 * np.arange(120)
    up, down = rise(times[:80]), rise(1 - (times[80:] - times[80]))
    np.testing.assert_allclose(first, np.append(up, down)[:, None] * signal(times), atol=1e-12)
    # Row i of a plan is the first row of the plan of i samples later.
    for k in (3, 40, 60, 90):
        np.testing.assert_allclose(plans[k], first[k : k + 16], atol=1e-12)
    assert np.abs(first).max() > 0.05


@pytest.mark.parametrize(("name", "settings"), [("reachy_mini", (STEPS,)), ("paper", ())])
def test_a_file_gives_the_same_as_the_signal(tmp_path, name, settings):
    wanted = sd.load_scenario(name, settings=settings)
    signal, file = some_torque(motion_period(wanted), 0.05), tmp_path / "learned.npz"
    save_learned(file, signal, prepare(wanted))
    given = sd.load_scenario(name, settings=(*settings, f"controller.learned={file}"))
    bare, learned = designing.read_learned(given)
    assert bare == wanted
    np.testing.assert_array_equal(learned().coefficients, signal.coefficients)


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["paper", "--set", "controller.limits=qp"], "controller.learned: got 'learned.npz' with"),
        (["paper", "--set", "link.kind=network"], "link.kind: got 'network' for learning"),
        (["reachy_mini", "--set", "reference.kind=hold"], "only a motion that repeats is learned"),
        (["reachy_mini", "--learned", "no/such/l.npz"], "--learned: got no/such/l.npz; expected"),
        (["reachy_mini", "--duration", "5"], "--duration: got 5.0 with --learn; expected none"),
        (["reachy_mini", "--hold"], "--hold: got True with --learn; expected none"),
        (["reachy_mini", "--set", "controller.learned=x.npz"], "expected null, where learning"),
    ],
)
def test_what_live_cannot_learn_is_one_line(words, message, capsys):
    assert main(["live", *words, "--machine", "127.0.0.1:9", "--learn", "3"]) == 2
    said = capsys.readouterr().err
    assert message in said and said.count("\n") == 1


@pytest.mark.parametrize("limit", [10.0, 0.005])
def test_a_packet_has_the_sum_and_the_law_the_rest(limit):
    """Each row is that of the law and the learned torque of its hold, within the limit.

    The measured states follow the reference whatever acts, so nothing is estimated from them.
    """
    network = "link={kind: network, low: 0.1, high: 0.3, loss: 0.02}"
    settings = ("plant.kind=exact", network, f"actuator.torque_limit={limit}")
    settings += ("controller.estimate=[]",)
    signal, on_hand = some_torque(size=2e-3), [False]
    scenario = sd.load_scenario("paper", settings=settings)
    made = designing.design(scenario, Message(), designing.always(signal))
    law, reference = made.law, made.experiment.reference

    class Alone(LiveLoop):
        _by_hand = property(lambda self: on_hand[0])

        def __init__(self):
            self._design, self._period, self._learned = made, 0.1, LearnedTorques(made)
            self.exchange = Exchange(None, 0.1, 12)
            self.record = LiveRecord(made.experiment, limit, None, print)
            self.memory = law.initial_memory(made.queue)

    loop, before, mean, acted, net = Alone(), None, signal.coefficients[0], {}, []
    timeline, weights = made.law.timeline, np.ones(2)
    eta = timeline.eta
    for k in range(40):
        on_hand[0] = k >= 25
        t = 0.1 * k
        state = Measurement.of(evaluate(reference, t)[:12])

        def ahead(times, t=t):
            return np.array([evaluate(reference, t + one) for one in times])

        loop.memory = law.step(loop.memory, state, ahead, weights)
        rows, asked = loop.memory.sent.packets[-1].copy(), np.array(loop.memory.torque)
        packet, first = loop._packet(k)
        share = rise(t if k < 25 else 1 - (t - 2.5))
        learned = mean + share * (signal(np.array([t + eta + 0.05]))[0] - mean)
        own = k - first
        np.testing.assert_allclose(packet[own], np.clip(asked + learned, -limit, limit), atol=1e-12)
        np.testing.assert_allclose(loop.memory.in_flight[-1] + learned, packet[own], atol=1e-12)
        assert np.abs(packet).max() <= limit
        if before is not None:
            np.testing.assert_allclose(packet[:own], before[own : 2 * own], atol=1e-12)
        if limit > 1 and k < 25:
            later = 0.1 * np.arange(len(packet) - own)
            planned = mean + rise(t + later)[:, None] * (signal(t + eta + 0.05 + later) - mean)
            np.testing.assert_allclose(packet[own:], rows[own:] + planned, atol=1e-12)
        before = packet
        acted[k + timeline.steps] = packet[own]
        net.append(loop.memory.in_flight[-1].copy())
    report = loop._heard(30, acted)
    assert len(report.acted) > 5
    for i, torque in enumerate(report.acted):
        sent_at = 29 - i - timeline.steps
        np.testing.assert_allclose(torque, net[sent_at], atol=1e-12)
    loop.record.finish()
    assert loop._as_sent(39).counts.saturated_steps == loop._learned.saturated
    assert (loop._learned.saturated > 0) == (limit < 1)
    np.testing.assert_allclose(loop._as_sent(39).torque, asked + learned, atol=1e-12)


@pytest.mark.usefixtures("blank_figures")
def test_the_command_writes_the_page_of_learn(tmp_path, monkeypatch, capsys):
    """The repetitions are canned."""
    scenario = sd.load_scenario("paper", settings=("plant.kind=exact", "duration=1"))
    run = sd.simulate(scenario, judge_stability=False)
    late = {"median": 1.0, "p99": 2.0, "worst": 3.0}
    counts = {"samples": 11, "deadlines_missed": 0, "periods_played": 10, "periods_dry": 0}
    counts |= {"recoveries": 0, "jitter_std_ms": 0.1}
    summary = run.summary | {"live": counts | {"sent_after_due_ms": late}}
    run = dataclasses.replace(run, summary=summary)
    done = [Repetition(None, run, 2.0), Repetition(some_torque(PERIOD, 0.05), run, 1.0)]
    found = LearnStudy(prepare(scenario), 0.5, done, 2, interrupted=False, file="mine.npz")
    monkeypatch.setattr(learning, "learn_live", lambda *_: LiveLessons(run, found))
    command = ["live", "paper", "--machine", "127.0.0.1:9", "--learn", "2", "--out", str(tmp_path)]
    assert main(command) == 0
    assert "signals.nc, report.html" in " ".join(capsys.readouterr().out.split())
    page = (tmp_path / "report.html").read_text()
    assert "from 2.00 to 1.00 % s" in " ".join(page.split()) and page.count("<iframe") == 2
    assert unbroken(f"stewart-drake {' '.join(command)}") in " ".join(page.split())
    assert "controller.learned=mine.npz" in page


@pytest.mark.slow
def test_a_lost_run_names_its_log_and_what_may_have_caused_the_loss(tmp_path, capsys):
    run = sd.simulate(sd.load_scenario("paper", "lqr", ("plant.kind=exact", "duration=2")))
    late = {"median": 1.0, "p99": 2.0, "worst": 3.0}
    counts = {"samples": 1, "deadlines_missed": 1, "periods_played": 14, "periods_dry": 9}
    live = counts | {"recoveries": 2, "sent_after_due_ms": late, "jitter_std_ms": 0.1}
    run = dataclasses.replace(run, summary=run.summary | {"live": live})
    assert _delivered(Delivery(tmp_path), run, LOG) == 1
    said = " ".join(capsys.readouterr().out.split())
    assert said.startswith("left workspace: leg 2 reached the end of its reach at t = 1.3")
    assert f"The log shows the loss: stewart-drake replay {tmp_path / LOG}. If it" in said
    assert "1 sample with those of coming to rest, 1 deadline missed;" in said
    assert "for 14 periods, and none (dry) for 9, with those of coming to rest" in said
    assert "torques came too late or not at all" in said
    assert "too far off 2 times: a new path led it back" in said
    live["periods_dry"] = 8  # those before the first torque acts
    assert _delivered(Delivery(None), run) == 1
    said = " ".join(capsys.readouterr().out.split())
    assert "too late or not at all" not in said and "replay" not in said


LAW = ("plant.kind=exact", *test_learn.LAW)
AMPLITUDE = 0.7 * test_learn.AMPLITUDE
ON_A_WIRE = ("start=on_reference", "queue=reference")


def learn(wanted, running, file, say):
    """Return the run and the study of three repetitions on a machine."""
    host, port = running.address
    options = LiveOptions(learn=3, learned=file, accept_jitter=True)
    return learn_live(wanted, f"{host}:{port}", options, say)


@pytest.mark.slow
@pytest.mark.parametrize("way", [ON_A_WIRE, (*FROM_REST, OVER_A_NETWORK)])
@in_real_time
def test_torques_of_a_machine_with_friction_and_payload_are_learned(tmp_path, way):
    """Friction, a payload off its centre and biases; the machine's clock is 5 times as fast.

    Between the repetitions the plate rests at the start. The file serves a simulation, too.
    """
    said, file = [], tmp_path / "learned.npz"
    wanted = sd.load_scenario("paper", settings=(*LAW, *way[:2]))
    machine = sd.load_scenario("paper", settings=(*LAW, *UNKNOWN, *way))
    with running_machine(machine, rate=5.0) as running:
        result, study = learn(wanted, running, file, said.append)
    assert result.status == "completed"
    # Each repetition is a separate run, to the same instant of the motion but for a sample.
    assert [one.error for one in study.repetitions] == study.summary["errors"]
    assert len(study.repetitions) == 3 and study.best is study.repetitions[2]
    last = [one.result.signals.isel(time=slice(-60, None)) for one in study.repetitions]
    np.testing.assert_allclose(last[0].reference, last[2].reference, atol=0.1 * AMPLITUDE.max())
    means = [np.abs(one.error.values / AMPLITUDE).mean() for one in last]
    assert means[2] < 0.1 * means[0]
    page = html(document(study), Provenance("live"))
    assert page.count("<iframe") == 2 and "Learning lowers E of one period" in page
    errors = [float(line.split()[-3]) for line in said if "E of one period" in line]
    assert len(errors) == 3
    assert 13 < errors[0] < 16 and errors[2] < 0.5
    assert "repetition 3 is the best" in said[-1]
    begin = prepare(wanted).start[:6]
    away = np.abs(result.signals.pose.values - begin).max(axis=1)
    rates = np.abs(result.signals.rates.values / AMPLITUDE).max(axis=1)
    resting = (away < 0.05) & (rates < 0.05)
    assert np.count_nonzero(np.diff(resting.astype(int)) == 1) >= 2
    run = (*LAW, *UNKNOWN, *ON_A_WIRE, "duration=12", f"controller.learned={file}")
    learned = sd.simulate(sd.load_scenario("paper", settings=run), judge_stability=False)
    after = learned.signals.error.sel(time=slice(6, None)).values
    assert np.abs(after / AMPLITUDE).max() < 0.01


@pytest.mark.parametrize(
    ("measured", "ends"),
    [
        ([0.95, 0.95], ["E", "E"]),
        ([0.5, 0.95, 0.95], ["again", "E", "E"]),
        ([0.5, 0.5, 0.5, 0.95, 0.95], ["again", "again", "again", "E", "E"]),
        ([0.5] * 9, ["again", "again", "again", "learning ends"]),
    ],
)
def test_a_repetition_of_which_too_little_was_measured_is_done_again(measured, ends):
    """The shares are those of each motion; 37 samples are one of its periods."""
    settings = ("plant.kind=exact", "delay.steps=3", "reference.frequency=1.7")
    experiment, said = prepare(sd.load_scenario("paper", settings=settings)), []
    lessons, rng = learning.TorqueLessons(experiment, 2, said.append), np.random.default_rng(5)
    rest, number, returned = experiment.start, 0, False
    blank = dict.fromkeys(learning.Snapshot._fields, 0.0) | {"by_hand": False, "limit": None}
    blank["estimates"] = {}
    blank["wanted"] = np.append(rest, np.zeros(6))
    row = {"pose": rest[:6], "reference": rest[:6] + 1e-3}
    row |= {"parameters": np.zeros(NUM_PARAMETERS), "torque_applied": np.zeros(6)}
    for k in range(1000):
        if lessons.done:
            break
        number += returned and lessons.request().target is None
        returned = lessons.request().target is not None
        state = rest if rng.random() < measured[number] else np.full(12, np.nan)
        lessons.show(learning.Snapshot(**blank | {"time": 0.1 * k}))
        lessons.write(0.1 * k, row | {"measurement": state})
    assert lessons.done and len(said) == len(ends)
    for line, end in zip(said, ends, strict=True):
        assert {"E": "E of one period", "again": "it is done again"}.get(end, end) in line
    assert len(lessons.tried) == max(1, ends.count("E"))
    assert np.isfinite(lessons.tried[-1].coefficients).all()


@pytest.mark.slow
@in_real_time
def test_friction_that_keeps_the_plate_off_is_learned(tmp_path):
    """It keeps the small motion 10 % off, which is no reason for a new reference."""
    small = "reference.amplitude=[0.08,0.08,0.08,0.008,0.008,0.02]"
    common = ("plant.kind=exact", "delay.steps=3", small, "reference.frequency=1.7")
    machine = sd.load_scenario("paper", settings=(*common, "plant.coulomb_friction=2e-4"))
    law = ("controller.estimate=[]", "controller.integral=false", "controller.w_R=100")
    options = LiveOptions(learn=2, learned=tmp_path / "learned.npz", accept_jitter=True)
    with running_machine(machine, rate=5.0) as running:
        host, port = running.address
        wanted = sd.load_scenario("paper", settings=(*common, *law))
        result, study = learn_live(wanted, f"{host}:{port}", options, print)
    assert study is not None and len(study.repetitions) == 2
    first, second = (one.error for one in study.repetitions)
    assert second < 0.2 * first and second < 0.5
    assert result.status == "completed" and result.summary["live"]["recoveries"] == 0


@pytest.mark.slow
@in_real_time
def test_setpoints_of_a_machine_with_other_servos_are_learned(monkeypatch, tmp_path):
    """Twice the friction and 0.8 of the stiffness, over a network that loses packets."""
    monkeypatch.setattr(learning, "_SETTLING", 4.0)  # the soft starts here take a second
    network = "link={kind: network, low: 0.01, high: 0.05, loss: 0.03, playout: 0.26}"
    said, file = [], tmp_path / "learned.npz"
    other = ("actuator.friction=0.2", "actuator.stiffness=8", network)
    wanted = sd.load_scenario("reachy_mini", settings=(STEPS,))
    with running_machine(sd.load_scenario("reachy_mini", settings=other)) as running:
        result, study = learn(wanted, running, file, said.append)
    assert result.status == "completed"
    assert study.best.result is result and study.measure.unit == "deg"
    assert "Learning lowers the rms error of the cranks" in document(study).plain()
    lacking = [float(line.split()[5]) for line in said if "degrees rms" in line]
    assert len(lacking) == 3
    assert 0.5 < lacking[0] < 1.5
    assert lacking[2] < 0.3 * lacking[0]
    assert said[-1].startswith("repetition ") and file.exists()
