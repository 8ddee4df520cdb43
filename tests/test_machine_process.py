"""The machine as a process, in real time: signals, suspensions, kills; and both ends in C."""

import json
import os
import re
import shutil
import signal
import socket
import subprocess
import sys
import threading
import time
from contextlib import contextmanager

import numpy as np
import pytest

import stewart_drake as sd
from stewart_drake.cli import main
from stewart_drake.export import controller as export_c
from stewart_drake.files.errors import ConfigError
from stewart_drake.loop.simulation import simulate
from stewart_drake.scenario.loading import load_scenario
from tests.building import SANITIZED, c_compiler, make
from tests.copies import Command
from tests.live_driver import in_real_time

SETTINGS = ("plant.kind=exact", "duration=2.5")
SAMPLES = 25
"""Of a run; the torques of all but the last eight act."""
LONG = ("plant.kind=exact", "duration=4.0", "delay.steps=2")
LONG_SOURCES = ("dynamics.o", "riccati.o", "law.o")
SLOW = 0.4
"""Rate of the machine's clock at which a busy computer still delivers measurements in time."""
DRAKE = "stewart-drake"
"""Runs in a copy of a process."""
PATIENCE = 120.0
"""s in which a process must say what is waited for, on a busy computer."""


def free_port():
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as found:
        found.bind(("127.0.0.1", 0))
        return int(found.getsockname()[1])


class Process:
    """A process whose lines are read one by one."""

    def __init__(self, command):
        if command[0] == DRAKE:
            self.popen = Command(*command[1:])
        else:
            streams = {"stdout": subprocess.PIPE, "stderr": subprocess.STDOUT}
            surroundings = os.environ | {"PYTHONUNBUFFERED": "1"}
            self.popen = subprocess.Popen(command, text=True, env=surroundings, **streams)
        self.lines: list[str] = []

    @property
    def said(self):
        """Return all output as one line."""
        return " ".join(" ".join(self.lines).split())

    def until(self, pattern):
        """Return the line that has it, which must come before the process ends."""
        for line in self._read():
            if re.search(pattern, line):
                return line
        raise AssertionError(f"no {pattern!r} in {self.lines}")

    def end(self, number=None):
        """Its exit status, after a signal."""
        if number is not None:
            self.popen.send_signal(number)
        for _ in self._read():
            pass
        return self.popen.wait()

    def _read(self):
        """Yield the lines as they come, for `PATIENCE` s; then the process is killed.

        Reads through the file object: `communicate(timeout=...)` reads the descriptor, and loses
        the lines that the file object has read ahead.
        """
        assert self.popen.stdout is not None
        late = threading.Timer(PATIENCE, self.popen.kill)
        late.start()
        try:
            for line in self.popen.stdout:
                self.lines.append(line.rstrip("\n"))
                yield line
        finally:
            late.cancel()


@contextmanager
def process(command):
    made = Process(command)
    try:
        yield made
    finally:
        if made.popen.poll() is None:
            made.popen.kill()
            made.popen.wait()
        made.popen.stdout.close()


@contextmanager
def machine(*options, settings=SETTINGS, command=(DRAKE,)):
    """`stewart-drake machine`, once it listens, and its port; Ctrl-C ends it."""
    said = [word for setting in settings for word in ("--set", setting)]
    with process([*command, "machine", "paper", "--port", "0", *said, *options]) as made:
        first = made.until("^machine paper at")
        made.until("waits for a controller")
        yield made, int(first.split("127.0.0.1:")[1].split(":")[0])
        assert made.end(signal.SIGINT) == 130


@contextmanager
def machine_in_c(folder, *options, kind="simulated", port=None):
    """`stewart_machine` of a folder, once it listens, and its port; Ctrl-C ends it."""
    port = port or free_port()
    with process([str(folder / "stewart_machine"), str(port), *options]) as made:
        made.until(f"a {kind} machine at port")
        yield made, port
        assert made.end(signal.SIGINT) == 0


def exported(made, settings, single=False):
    """Write what export-c writes, and compile the examples over UDP under the sanitizers."""
    c_compiler()
    scenario = load_scenario("paper", settings=settings)
    export_c.write(export_c.exported(scenario, single, measured=False), made)
    # tests/test_export_c.py tries the long sources under them, and has these objects, too.
    make(made, *LONG_SOURCES)
    make(made, "flags.txt", f"CFLAGS={' '.join(SANITIZED)}")
    for name in LONG_SOURCES:
        (made / name).touch()  # or make compiles them again
    make(made, "udp", f"CFLAGS={' '.join(SANITIZED)}")
    return made


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return exported(tmp_path_factory.mktemp("board"), SETTINGS)


@pytest.fixture(scope="module")
def soon(tmp_path_factory):
    """Return the same for torques that act 0.2 s after their measurement."""
    return exported(tmp_path_factory.mktemp("soon"), LONG)


def c_controller(folder, port, *options):
    return [str(folder / "stewart_udp"), "127.0.0.1", str(port), *options]


def states_of(log):
    """(k, 12) that the C controller measured."""
    return np.loadtxt(log, delimiter=",", skiprows=1)[:, 1:13]


def simulated(samples, settings=SETTINGS):
    """(k, 12) states."""
    result = simulate(load_scenario("paper", settings=settings), judge_stability=False)
    kept = result.signals.sel(time=0.1 * np.arange(samples), method="nearest")
    return np.hstack([kept.pose.values, kept.rates.values])


def over(folder, settings, log, rate=1.0):
    """States (k, 12) of the machine of a scenario that C drives, and what machine and C said."""
    with (
        machine("--watchdog", "3", "--rate", f"{rate}", settings=settings) as (running, port),
        process(c_controller(folder, port, f"log={log}")) as driving,
    ):
        assert driving.end() == 0, driving.lines
    return states_of(log), running.said, driving.said


# ---------------------------------------------------------------- the three pairs with C


@in_real_time
def test_the_controller_in_c_drives_the_machine_in_python(folder, tmp_path):
    states, machine_said, said = over(folder, SETTINGS, tmp_path / "log", SLOW)
    assert "completed after 25 samples, 0 of them without a measurement" in said
    assert said.endswith(
        "refused: 0 malformed, 0 version, 0 key, 0 foreign, 0 replayed, 0 late, 0 rate"
    )
    assert "1 session, 1 run, " in machine_said and "refused: none" in machine_said
    np.testing.assert_allclose(states, simulated(SAMPLES), atol=1e-6)


@pytest.mark.slow
@in_real_time
def test_a_lost_datagram_of_the_controller_in_c_costs_nothing(folder, tmp_path):
    """The following datagrams repeat its torque in time: the run equals one without loss."""
    lossy = "link={kind: network, low: 0.0, high: 0.02, loss: 0.3, playout: 0.8}"
    settings = (*SETTINGS, lossy, "controller.packet_repeats=0")
    states, said, _ = over(folder, settings, tmp_path / "log")
    lost = int(re.search(r"(\d+) lost by", said)[1])
    assert lost >= 5 and "17 played, 0 periods without one (dry)" in said
    np.testing.assert_allclose(states, simulated(SAMPLES), atol=1e-6)


def in_a_row(number, loss, seed):
    """Return a link with losses in a row; a torque acts 0.2 s after its measurement."""
    lossy = f"low: 0.0, high: 0.02, loss: {loss}, burst: {number}, playout: 0.1"
    return (*LONG[:2], f"link={{kind: network, {lossy}, seed: {seed}}}")


MOTION = np.tile([0.26, 0.26, 0.26, 0.02, 0.02, 0.08], 2)
"""Amplitudes of the scenario's motion, rad and m, and of its rates, per s."""


@pytest.mark.slow
@in_real_time
def test_what_the_controller_in_c_plans_ahead_acts_in_the_place_of_what_is_lost(soon, tmp_path):
    """Too late to be said again, where 3 or 7 in a row are lost: as the law in Python under the
    same losses. Without plans the plate leaves its workspace."""
    settings = in_a_row(3, loss=0.3, seed=2)
    states, said, _ = over(soon, settings, tmp_path / "log", SLOW)
    assert "0 periods without one (dry)" in said
    off = np.abs(states - simulated(40, settings)) / MOTION
    assert off.max() < 5e-3


@pytest.mark.slow
@in_real_time
def test_the_controller_in_c_hears_what_has_acted(soon, tmp_path):
    """Ten in a row are lost, so that the last torque is held: without being told, the filter would
    take that for a torque bias, which takes the plate four amplitudes away."""
    settings = (*in_a_row(10, loss=0.2, seed=12), "controller.packet_torques=8")
    states, said, _ = over(soon, settings, tmp_path / "log", SLOW)
    dry = int(re.search(r"(\d+) periods? without one", said)[1])
    undisturbed = simulated(40, LONG)
    assert dry >= 2
    most = np.abs(simulated(40, settings) - undisturbed) / MOTION
    assert (np.abs(states - undisturbed) / MOTION).max() < min(0.5, most.max())


@pytest.mark.slow
def test_live_drives_a_board_of_ones_own_once_it_is_armed(tmp_path):
    """The board is the shipped one, but real, and in single precision: no simulation, and nothing
    in flight at its begin."""
    own = exported(tmp_path, SETTINGS, single=True)
    board = own / "stewart_board.c"
    simulated_flags = "board_flags = STEWART_SIMULATION | STEWART_RESETS;"
    assert simulated_flags in board.read_text()
    board.write_text(board.read_text().replace(simulated_flags, "board_flags = STEWART_RESETS;"))
    make(own, "stewart_machine", f"CFLAGS={' '.join(SANITIZED)}")
    scenario = load_scenario("paper", settings=("plant.kind=exact",))
    with machine_in_c(own, kind="real") as (_, port):
        where = f"127.0.0.1:{port}"
        with pytest.raises(ConfigError, match=r"^armed"):
            sd.run_live(scenario, where, duration=5.0, accept_jitter=True)
        run = sd.run_live(scenario, where, duration=5.0, accept_jitter=True, armed=True)
    assert run.status == "completed" and run.summary["live"]["periods_played"] >= 40
    error = np.abs(run.signals.error.values) / np.array(scenario.reference.amplitude)
    assert np.nanmax(error[-15:]) < 0.02


FAULT = """
stewart_reason board_fault(uint64_t time, uint64_t *left_at)
{
    stewart_reason fault = {time < 4000000000u ? STEWART_NO_FAULT : STEWART_DRIVE, 0, 0};
    *left_at = time;
    return fault;
}
"""


@pytest.mark.slow
@pytest.mark.parametrize(("flags", "held"), [("0", False), ("STEWART_SAFE_HOLDS", True)])
def test_a_real_board_goes_safe_at_a_fault_and_begins_for_armed_controllers_only(
    folder, tmp_path, flags, held
):
    """Its drive fails at 4 s; a controller that does not ask whether it is armed is refused."""
    own = shutil.copytree(folder, tmp_path / "own")
    board, udp = own / "stewart_board.c", own / "stewart_udp.c"
    text = board.read_text().replace("STEWART_SIMULATION | STEWART_RESETS;", f"{flags};")
    text = text.replace("#include <math.h>", "#include <math.h>\n#include <stdio.h>")
    text = text[: text.index("stewart_reason board_fault")] + FAULT
    at = text.index("    follow(time);\n    for")
    board.write_text(text[:at] + '    printf("drive %a\\n", torque[0]);\n' + text[at:])
    objection = "STEWART_SIMULATION) && !(c->flags & STEWART_ARMED)"
    assert objection in udp.read_text()
    udp.write_text(udp.read_text().replace(objection, "STEWART_SIMULATION) && 0"))
    make(own, "udp", f"CFLAGS={' '.join(SANITIZED)}")
    with machine_in_c(own, kind="real") as (there, port):
        with process(c_controller(own, port, "seconds=2")) as controller:
            there.until("refused a controller: it is not armed")
            controller.end(signal.SIGINT)
        with process(c_controller(own, port, "seconds=20", "arm")) as controller:
            before = ["drive 0x0p+0"]
            there.until("the run began")
            while "stopped" not in (line := there.until("drive|stopped")):
                before.append(line.strip())
            assert line.startswith("a fault at 4.") and "a drive of the machine failed" in line
            after = there.until("drive").strip()
            assert after == (before[-1] if held else "drive 0x0p+0")
            assert before[-1] != "drive 0x0p+0"
            controller.popen.wait(timeout=60)


@pytest.mark.slow
@in_real_time
def test_both_ends_in_c(folder, tmp_path):
    log, key = tmp_path / "log", tmp_path / "key"
    key.write_bytes(b"a key of some length\n")
    with machine_in_c(folder, "60", str(key)) as (running, port):
        with process(c_controller(folder, port, f"log={log}", f"key={key}")) as driving:
            assert driving.end() == 0, driving.lines
            assert "warning" not in driving.said
        # Without the key, and with another one: refused, and nothing is done.
        with process(c_controller(folder, port, "seconds=1")) as other:
            time.sleep(0.5)
            assert other.end(signal.SIGINT) == 1
    np.testing.assert_allclose(states_of(log), simulated(SAMPLES), atol=1e-6)
    heads = log.read_text().splitlines()[0].split(",")
    assert [heads[0], heads[6], heads[12], heads[18]] == [
        *("time[s]", "z[m]", "z_dot[m/s]", "torque_6[N m]")
    ]
    assert sum("a session begins" in line for line in running.lines) == 1
    assert re.search(r"refused: 0 malformed, 0 version, [1-9]\d* key", running.lines[-1])


# ---------------------------------------------------------------- signals


@pytest.mark.slow
def test_sigterm_ends_it_like_ctrl_c():
    command = [sys.executable, "-m", "stewart_drake", "machine", "paper", "--port", "0"]
    with process([*command, "--set", "plant.kind=exact"]) as running:
        running.until("waits for a controller")
        assert running.end(signal.SIGTERM) == 143
    assert "ended after" in running.said and "Traceback" not in running.said


@pytest.mark.slow
def test_ctrl_c_ends_it_with_one_summary(capfd):
    with machine(command=(sys.executable, "-m", "stewart_drake")) as (running, _):
        pass
    begun = [line.split()[0] for line in running.lines if not line.startswith(" ")]
    assert begun == ["machine", "waits", "ended", "datagrams:", "torques:"]
    said = ["machine", "paper", "--set", "plant.kind=exact", "--port", "0"]
    assert main([*said, "--duration", "0.2", "--json"]) == 0
    summary = json.loads(capfd.readouterr().out)
    assert summary["sessions"] == 0 and set(summary["refused"].values()) == {0}


@pytest.mark.slow
@pytest.mark.parametrize("side", ["controller", "machine"])
def test_either_side_of_a_network_may_stand_still_for_a_second(side):
    """The suspended side reports it in one line; the machine is at its safe torque within the time
    that it promises, and the controller leads the plate back, or says why not."""
    way = "low: 0.1, high: 0.12"
    link = f"link={{kind: network, {way}, return: {{{way}}}}}"
    live = [DRAKE, "live", "paper", "--no-browser", "--duration", "6", "--machine"]
    with (
        machine("--watchdog", "0.7", settings=("plant.kind=exact", link)) as (running, port),
        process([*live, f"127.0.0.1:{port}"]) as driving,
    ):
        running.until("the run began")
        time.sleep(2.0)
        suspended = running if side == "machine" else driving
        suspended.popen.send_signal(signal.SIGSTOP)
        time.sleep(1.0)
        suspended.popen.send_signal(signal.SIGCONT)
        suspended.until(r"(stood still|did not run) for (0\.[5-9]|[12]\.)")
        survived = driving.end() == 0
    # A busy computer may suspend it for some tenths of a second more.
    stops = [
        float(s) for s in re.findall(r"(?:stood still|did not run) for ([\d.]+) s", suspended.said)
    ]
    assert sum(stop > 0.5 for stop in stops) == 1 and max(stops) < 3.0
    assert (
        "nothing was heard from the controller for 0.7 s: the safe torque (zero) acts"
        in running.said
    )
    # With a second of six missing, E_ac is near the share of samples from which it is not given.
    told = r"E_ac +(none|[\d.]+ % s)," if survived else "left workspace|lost (machine|contact)"
    assert re.search(told, driving.said), driving.lines


def longest_delay(began, until_kill, line, took):
    """Largest time from a kill to the safe torque, s: by this clock, or by the machine's.

    Either is too long if this process is late on a busy computer: the first at the last line, the
    second at the line of the begin.
    """
    times = [float(re.search(r"(\d+\.\d{3}) s", text)[1]) for text in (began, line)]
    return min(took, times[1] - times[0] - until_kill)


@pytest.mark.slow
@pytest.mark.parametrize("language", ["Python", "C"])
@in_real_time
def test_a_killed_controller_ends_in_the_safe_torque_and_the_next_one_takes_over(folder, language):
    python = language == "Python"
    watchdog = 0.4 if python else 1
    with machine("--watchdog", "0.4") if python else machine_in_c(folder) as (running, port):
        for wait in (0.5, 1.5):
            with process(c_controller(folder, port)) as driving:
                began, read = running.until("the run began"), time.monotonic()
                time.sleep(wait)
                driving.popen.kill()
                killed = time.monotonic()
                line = running.until("nothing was heard|left its workspace")
                took = longest_delay(began, killed - read, line, time.monotonic() - killed)
            assert f"nothing was heard from the controller for {watchdog} s" in line, line
            # It is heard once a period; scheduling of two busy cores is in it, too.
            assert took < watchdog + 0.25, (wait, took)
        with process(c_controller(folder, port, "seconds=1")) as last:
            assert last.end() == 0, last.lines
    assert sum("the run began" in line for line in running.lines) == 3


@pytest.mark.slow
def test_a_killed_machine_in_c_ends_its_controller_and_the_next_one_drives_its_successor(folder):
    port = free_port()
    command = [str(folder / "stewart_machine"), str(port)]
    with process(command) as running, process(c_controller(folder, port)) as driving:
        running.until("the run began")
        running.popen.kill()
        running.popen.wait()
        with machine_in_c(folder, port=port) as (anew, _):
            assert driving.end() == 1  # what it sends is of a session that the new one never had
            assert "the machine has fallen silent after" in driving.lines[-2]
            with process(c_controller(folder, port, "seconds=1")) as second:
                assert second.end() == 0, second.lines
    assert sum("a session begins" in line for line in anew.lines) == 1
    assert re.search(r" [1-9]\d* foreign", anew.lines[-1])
    took, sent = re.match(r"ended after (.*) s: (\d+) measurements", anew.lines[-2]).groups()
    assert int(sent) < 10 * float(took) + 5  # without offers


@pytest.mark.parametrize(
    ("arguments", "expected"),
    [
        (("machine", "0"), "PORT: got 0; expected a whole number above 0 and up to 65535"),
        (("machine", "4700o"), "PORT: got 4700o; expected"),
        (("machine", "47000", "nan"), "SECONDS: got nan; expected a number above 0"),
        (("machine", "47000", "1", "key", "more"), "expected: stewart_machine PORT"),
        (("udp", "127.0.0.1", "65536"), "PORT: got 65536; expected"),
        (("udp", "127.0.0.1", "47000", "seconds=-1"), "seconds: got -1; expected"),
        (("udp", "127.0.0.1", "47000", "log=no/log"), "log=no/log: No such file"),
        (
            ("udp", "127.0.0.1", "47000", "key=none"),
            "none: cannot be read; expected a file with a key",
        ),
        (("udp", "127.0.0.1", "47000", "armed"), "expected: stewart_udp ADDRESS PORT"),
        (("udp", "10.0.0.1", "47000"), "expected: stewart_udp ADDRESS PORT"),
    ],
)
def test_wrong_commands_of_the_programs_in_c_are_one_line(arguments, expected, folder, tmp_path):
    program, *rest = arguments
    command = [str(folder / f"stewart_{program}"), *rest]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, timeout=60)
    assert (done.returncode, done.stdout) == (2, "")
    assert done.stderr.count("\n") == 1 and done.stderr.startswith(expected)


def test_a_controller_in_c_that_is_not_started_keeps_an_old_log(folder, tmp_path):
    log = tmp_path / "run.csv"
    log.write_text("old\n")
    command = [str(folder / "stewart_udp"), "127.0.0.1", str(free_port()), f"log={log}"]
    done = subprocess.run([*command, "armed"], capture_output=True, text=True, timeout=60)
    assert done.returncode == 2 and log.read_text() == "old\n"
    done = subprocess.run(command, capture_output=True, text=True, timeout=60)
    assert done.returncode == 1 and "not started: the machine does not answer" in done.stdout
    assert log.read_text() == "old\n"


@pytest.mark.parametrize("program", ["stewart_machine", "stewart_udp"])
def test_the_programs_in_c_print_their_usage(program, folder):
    command = [str(folder / program), "--help"]
    done = subprocess.run(
        command, capture_output=True, text=True, timeout=60, stdin=subprocess.DEVNULL
    )
    assert (done.returncode, done.stderr, done.stdout.count("\n")) == (0, "", 1)
    assert done.stdout.startswith(f"usage: {program} ")


def test_wrong_commands_are_one_line(capfd, tmp_path):
    busy = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    busy.bind(("127.0.0.1", 0))
    exact = ("machine", "paper", "--set", "plant.kind=exact")
    for options, expected in (
        (("--host", "0.0.0.0"), "host: got 0.0.0.0 without a key"),
        (("--port", str(busy.getsockname()[1])), "expected a free one"),
        (("--safe", "brake"), "brake"),
        (("--rate", "0"), "--rate: got 0.0; expected"),
        (("--watchdog", "nan"), "--watchdog: got nan; expected"),
        (("--key", str(tmp_path / "none")), "--key: got"),
    ):
        assert main([*exact, *options]) == 2
        error = capfd.readouterr().err
        assert error.count("\n") == 1 and expected in error, error
    busy.close()
