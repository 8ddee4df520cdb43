"""`live --learn`: setpoints of servos learned from a machine, in real time."""

import threading

import numpy as np
import pytest

import stewart_drake as sd
from stewart_drake.cli import main
from stewart_drake.files.errors import ConfigError
from stewart_drake.law.learned import LearnedSignal
from stewart_drake.law.servos import rise
from stewart_drake.live import design as designing
from stewart_drake.live import learning
from stewart_drake.live.endpoint import Endpoint
from stewart_drake.live.learning import learn_setpoints
from stewart_drake.live.loop import CrankLoop
from stewart_drake.live.machine import Machine, Settings
from stewart_drake.live.options import LiveOptions
from stewart_drake.live.protocol import ControllerMessage, MachineFlags
from stewart_drake.loop.learned import HARMONICS, save_learned
from stewart_drake.loop.preparation import prepare
from tests.live_driver import in_real_time

STEPS = "delay.steps=13"
PERIOD = 2 * np.pi / 3.14159


class Message:
    """What a design reads from a machine's message."""

    torque_limit, flags = np.inf, MachineFlags(0)


def some_angles(size=0.05):
    coefficients = np.zeros((1 + 2 * HARMONICS, 6))
    coefficients[[0, 1, 1 + HARMONICS]] = size * np.random.default_rng(3).standard_normal((3, 6))
    return LearnedSignal(PERIOD, coefficients)


def loop_of(learned, by_hand=lambda: False):
    """Return a loop that has only what plans are made of."""
    made = designing.design(sd.load_scenario("reachy_mini", settings=(STEPS,)), Message(), learned)

    class Alone(CrankLoop):
        _by_hand = property(lambda self: by_hand())

        def __init__(self):
            self._design, self._period, self._share = made, 0.02, 0.0

    return Alone()


def test_what_was_learned_begins_and_ends_softly_and_is_by_the_time_of_the_motion():
    signal, on_hand = some_angles(), [False]
    loop = loop_of(signal, lambda: on_hand[0])
    plans = []
    for k in range(120):
        on_hand[0] = k >= 80
        plans.append(loop._learned(0.02 * k))
    first = np.array([plan[0] for plan in plans])
    times = 0.02 * np.arange(120)
    up, down = rise(times[:80]), rise(1 - (times[80:] - times[80]))
    np.testing.assert_allclose(first, np.append(up, down)[:, None] * signal(times), atol=1e-12)
    # Row i of a plan is the first row of the plan of i samples later.
    for k in (3, 40, 60, 90):
        np.testing.assert_allclose(plans[k], first[k : k + 16], atol=1e-12)
    assert np.abs(first).max() > 0.05


def test_a_file_gives_the_same_as_the_signal(tmp_path):
    wanted, signal = sd.load_scenario("reachy_mini", settings=(STEPS,)), some_angles()
    save_learned(tmp_path / "learned.npz", signal, prepare(wanted))
    more = (STEPS, f"controller.learned={tmp_path / 'learned.npz'}")
    made = designing.design(sd.load_scenario("reachy_mini", settings=more), Message())
    np.testing.assert_array_equal(made.learned.coefficients, signal.coefficients)
    assert not hasattr(made.law, "learned")  # it is added once


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["paper"], "--learn: got a controller.command of 'torque'; expected 'cranks'"),
        (["reachy_mini", "--set", "reference.kind=hold"], "only a motion that repeats is learned"),
        (["reachy_mini", "--learned", "no/such/l.npz"], "--learned: got no/such/l.npz; expected"),
        (["reachy_mini", "--duration", "5"], "--learn: expected none of --duration, --log"),
        (["reachy_mini", "--set", "controller.learned=x.npz"], "expected null, where learning"),
    ],
)
def test_what_live_cannot_learn_is_one_line(words, message, capsys):
    assert main(["live", *words, "--machine", "127.0.0.1:9", "--learn", "3"]) == 2
    said = capsys.readouterr().err
    assert message in said and said.count("\n") == 1


def test_torques_are_not_taken_from_a_file(tmp_path):
    scenario = sd.load_scenario("paper", settings=(f"controller.learned={tmp_path / 'none.npz'}",))
    with pytest.raises(ConfigError, match=r"^controller\.learned: "):
        designing.design(scenario, Message())


@pytest.mark.slow
@in_real_time
def test_setpoints_of_a_machine_with_other_servos_are_learned(monkeypatch, tmp_path):
    """Twice the friction and 0.8 of the stiffness, over a network that loses packets."""
    monkeypatch.setattr(Machine, "stop", lambda self: None)
    monkeypatch.setattr(learning, "_SETTLING", 4.0)  # the soft starts here take a second
    network = "link={kind: network, low: 0.01, high: 0.05, loss: 0.03, playout: 0.26}"
    other = ("actuator.friction=0.2", "actuator.stiffness=8", network)
    lines, over = [], threading.Event()
    endpoint = Endpoint(ControllerMessage, "127.0.0.1", 0)
    experiment = prepare(sd.load_scenario("reachy_mini", settings=other))
    machine = Machine(experiment, endpoint, Settings(), lines.append)

    def run():
        while not over.is_set():
            machine.run(machine.time() / 1e9 + 0.05)

    thread = threading.Thread(target=run)
    thread.start()
    said, file = [], tmp_path / "learned.npz"
    try:
        options = LiveOptions(learn=3, learned=file, accept_jitter=True)
        wanted = sd.load_scenario("reachy_mini", settings=(STEPS,))
        where = f"127.0.0.1:{endpoint.address[1]}"
        result = learn_setpoints(wanted, where, options, said.append)
    finally:
        over.set()
        thread.join()
        endpoint.close()
    assert result.status == "completed"
    lacking = [float(line.split()[5]) for line in said if "degrees rms" in line]
    assert len(lacking) == 3
    assert 0.5 < lacking[0] < 1.5
    assert lacking[2] < 0.3 * lacking[0]
    assert said[-1].startswith("repetition ") and file.exists()
