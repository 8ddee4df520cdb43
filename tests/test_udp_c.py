"""The programs over UDP of export-c, under the sanitizers: odd input, and what both sides say."""

import re
import shutil
import socket
import subprocess
import threading
import time

import numpy as np
import pytest

from stewart_drake.live.endpoint import LONGEST_KEY, SHORTEST_KEY, now
from stewart_drake.live.protocol import (
    ControllerFlags,
    ControllerMessage,
    MachineFlags,
    MachineMessage,
    encode,
)
from stewart_drake.loop.peer import Fault
from stewart_drake.scenario.loading import load_scenario
from tests.building import SANITIZED, make
from tests.live_driver import Driver, in_real_time
from tests.test_machine_process import (
    DRAKE,
    SETTINGS,
    c_controller,
    folder,
    free_port,
    machine,
    machine_in_c,
    process,
)
from tests.test_protocol import PLAN, changed

__all__ = ["folder"]


def test_a_key_file_beyond_what_python_takes_is_refused(folder, tmp_path):
    file = tmp_path / "key"
    machine = [str(folder / "stewart_machine"), str(free_port()), "0.01", str(file)]
    takes = {SHORTEST_KEY, LONGEST_KEY}
    for size in (0, SHORTEST_KEY - 1, SHORTEST_KEY, LONGEST_KEY, LONGEST_KEY + 1, 9000):
        file.write_bytes(b"k" * size + b"\n")
        done = subprocess.run(machine, capture_output=True, text=True, timeout=60)
        assert done.returncode == (0 if size in takes else 2), (size, done.stderr)


def test_a_machine_with_another_key_does_not_answer(folder, tmp_path):
    """It stores and says nothing for a datagram that it cannot trust; the client names the key."""
    (tmp_path / "key").write_bytes(b"k" * SHORTEST_KEY)
    with machine("--key", str(tmp_path / "key")) as (_, port):
        command = [str(folder / "stewart_udp"), "127.0.0.1", str(port)]
        done = subprocess.run(command, capture_output=True, text=True, timeout=60)
    assert done.returncode == 1 and "with the same key=FILE" in done.stderr + done.stdout


def test_without_random_bytes_there_is_no_session(folder, tmp_path):
    own = shutil.copytree(folder, tmp_path / "own")
    make(own, "stewart_udp", 'CFLAGS=-DUDP_RANDOM=\\"/nowhere\\"')
    command = [str(own / "stewart_udp"), "127.0.0.1", str(free_port())]
    done = subprocess.run(command, capture_output=True, text=True, timeout=60)
    assert done.returncode != 0 and done.stderr.startswith("/nowhere: no random bytes")


def test_the_controller_in_c_keeps_its_times_in_a_flood(folder, tmp_path):
    """There is always one more datagram, which is malformed; it gives up a machine after 1 s."""
    own = shutil.copytree(folder, tmp_path / "own")
    for name, old, new in (
        ("udp.c", "return got >= 0;", "return 1;"),
        ("stewart_udp.c", "10ull * SECOND", "1ull * SECOND"),
    ):
        text = (own / name).read_text()
        assert text.count(old) == 1
        (own / name).write_text(text.replace(old, new))
    make(own, "stewart_udp", f"CFLAGS={' '.join(SANITIZED)}")
    command = [str(own / "stewart_udp"), "127.0.0.1", str(free_port())]
    done = subprocess.run(command, capture_output=True, text=True, timeout=60)
    assert done.returncode == 1 and "does not answer" in done.stdout


# ---------------------------------------------------------------- what both sides say


def test_a_controller_in_c_of_another_machine_is_refused_by_both(folder):
    settings = (*SETTINGS, "mechanism=paper_clear")
    with (
        machine(settings=settings) as (running, port),
        process(c_controller(folder, port)) as driving,
    ):
        assert driving.end() == 1
    line = (
        "not started: different mechanism (machine: paper_clear; controller: paper): export or "
        "start both ends from the same mechanism file"
    )
    assert line in driving.lines
    names = "mechanism paper_clear", "mechanism paper"
    assert "is designed for {1}; this machine has {0}".format(*names) in running.said
    assert "0 sessions" in running.said


@pytest.mark.slow
def test_a_controller_in_c_warns_of_a_link_that_is_too_slow(folder):
    """It waits for measurements as long as the link takes, as `live` does. The first ones may be
    late, as the machine begins to compute then.
    """
    times = "low=0.45", "high=0.46", "loss=0", "return={low: 0.45, high: 0.46}"
    link = ("link.kind=network", *(f"link.{time}" for time in times))
    with (
        machine(settings=(*SETTINGS, *link)) as (_, port),
        process(c_controller(folder, port, "seconds=0.6")) as driving,
    ):
        driving.end()
    assert "but torques are to act 800 ms after their sample" in driving.said
    missing = re.search(
        r"completed after 6 samples, (\d) of them without a measurement", driving.said
    )
    assert missing and int(missing[1]) <= 2


@pytest.mark.slow
def test_a_machine_in_c_refuses_a_controller_of_another_mechanism(folder):
    live = [DRAKE, "live", "paper", "--no-browser", "--set", "mechanism=paper_clear"]
    with (
        machine_in_c(folder) as (running, port),
        process([*live, "--machine", f"127.0.0.1:{port}"]) as driving,
    ):
        assert driving.end() == 2
    assert (
        f"machine at 127.0.0.1:{port} has mechanism paper; the controller is designed for "
        "mechanism paper_clear" in driving.said
    )
    line = (
        "refused a controller: different mechanism (machine: paper; controller: paper_clear): "
        "export or start both ends from the same mechanism file"
    )
    assert running.lines.count(line) == 1


@pytest.mark.slow
def test_a_machine_in_c_is_not_locked_by_replayed_requests(folder, tmp_path):
    """Twenty a second, without the key: 4 of 4 runs connect."""
    key = tmp_path / "key"
    key.write_bytes(b"a key of some length")
    driver = Driver(load_scenario("paper", settings=SETTINGS), ("127.0.0.1", 0))
    asked = ControllerMessage(driver.session.head(0), identity=driver.identity)
    recorded, over = encode(asked, key.read_bytes()), threading.Event()
    attacker = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)

    def attack():
        while not over.wait(0.05):
            attacker.sendto(recorded, ("127.0.0.1", port))

    thread = threading.Thread(target=attack)
    with machine_in_c(folder, "300", str(key)) as (running, port):
        thread.start()
        connected = 0
        for _ in range(4):
            with process(c_controller(folder, port, f"key={key}", "seconds=0.3")) as driving:
                connected += driving.end() == 0
        over.set()
        thread.join()
    attacker.close()
    assert connected == sum("a session begins" in line for line in running.lines) == 4


def greeted(port):
    """Return a driver to which a machine has offered a session."""
    driver = Driver(load_scenario("paper", settings=SETTINGS), ("127.0.0.1", port))
    while not driver.session.nonce:
        driver.say(now())
        time.sleep(0.1)
        driver.receive(now())
    return driver


@pytest.mark.slow
@in_real_time
def test_a_machine_in_c_plays_rows_in_time_on_one_grid_from_the_begin_on(folder):
    """As the one in Python, see tests/test_machine.py. Without such a row it goes safe."""

    def send(number, ahead):
        """Send a row at each of a number of measurements, for `ahead` periods after it."""
        for _ in range(number):
            before = len(driver.got)
            while len(driver.got) == before:
                time.sleep(0.002)
                driver.receive(now())
            sampled = driver.got[-1].sampled
            playout = sampled + round(ahead * driver.period)
            driver.say(now(), sampled=sampled, playout=playout, torques=np.full((1, 6), 1e-4))
        return driver.got[-1]

    with machine_in_c(folder) as (running, port):
        driver = greeted(port)
        driver.begin = (driver.got[-1].head.time // driver.period + 10) * driver.period
        driver.say(now())
        assert send(5, 2).flags & MachineFlags.PARKED
        while send(1, 2).sampled < driver.begin:
            pass
        last = send(3, 2)
        assert last.before.fault == Fault.NONE and last.acted_from >= driver.begin
        assert last.played <= 4 and last.refused >= 5
        refused = send(2, 2).refused
        last = send(2, 2.5)
        assert last.refused >= refused + 1 and last.acted_from % driver.period == 0
        last = send(16, -5)
        assert last.reason.fault == Fault.DRY and MachineFlags.SAFE in last.flags
        assert not last.acted[0].any()
        assert MachineFlags.SAFE not in send(5, 2).flags
    assert "no torque or setpoint came in time for 1 s: the safe torque acts" in running.said
    assert re.search(r"refused: 2 malformed, .* 2\d late, 0 rate", running.lines[-1])


@pytest.mark.slow
def test_a_real_machine_in_c_goes_safe_before_another_controller_takes_it_over(folder, tmp_path):
    """Also where that one's datagram is there at the instant at which the watchdog ends."""
    own = shutil.copytree(folder, tmp_path / "own")
    board = own / "stewart_board.c"
    text = board.read_text().replace("STEWART_SIMULATION | STEWART_RESETS;", "0;")
    text = text.replace("#include <math.h>", "#include <math.h>\n#include <stdio.h>")
    at = text.index("    follow(time);\n    for")
    board.write_text(text[:at] + '    printf("drive %g\\n", torque[0]);\n' + text[at:])
    make(own, "stewart_machine", f"CFLAGS={' '.join(SANITIZED)}")
    armed, torques = ControllerFlags.ARMED, np.full((20, 6), 1e-4)
    with machine_in_c(own, kind="real") as (running, port):
        first = greeted(port)
        first.begin = (first.got[-1].head.time // first.period + 3) * first.period
        first.say(now(), armed, playout=first.begin + first.period, torques=torques)
        running.until("drive 0.0001")
        second, end = greeted(port), time.monotonic() + 1.5
        while time.monotonic() < end:
            second.say(now(), armed)
            time.sleep(2e-4)
    lines = [line for line in running.lines if not line.startswith("nothing was heard")]
    again = len(lines) - lines[::-1].index("a session begins") - 1
    assert lines.count("a session begins") == 2 and lines[again - 1] == "drive 0", lines


@pytest.mark.slow
@in_real_time
def test_the_farewell_of_a_machine_in_c_is_not_refused(folder):
    """It ends soon after a sample, woken by datagrams of another sender."""
    port, other = free_port(), socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    with process(c_controller(folder, port)) as driving:
        with machine_in_c(folder, "3.03", port=port) as (running, _):
            while running.popen.poll() is None:
                other.sendto(b"", ("127.0.0.1", port))
                time.sleep(0.005)
        assert driving.end() == 1
    other.close()
    assert "the machine was ended after" in driving.said
    assert driving.lines[-1].endswith("0 foreign, 0 replayed, 0 late, 0 rate")


@pytest.mark.slow
def test_a_machine_in_c_says_why_it_stopped(folder):
    """Silence and its end, in its datagrams; a controller of version 1 is told the version."""
    with machine_in_c(folder) as (running, port):
        old = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        old.settimeout(5)
        for _ in range(3):
            old.sendto(b"", ("127.0.0.1", port))
            old.sendto(changed(encode(PLAN), 4, b"\1"), ("127.0.0.1", port))
        answer = old.recv(2000)
        old.close()
        assert len(answer) == 60 and answer[:5] == b"STWM\3"
        driver = greeted(port)
        driver.begin = driver.got[-1].head.time + 4 * driver.period
        driver.say(now())
        running.until("nothing was heard from the controller for 1 s: the safe torque acts")
        time.sleep(0.3)
        driver.receive(now())
        heard = driver.got[-1]
        assert isinstance(heard, MachineMessage) and heard.reason.fault == Fault.SILENCE
        assert heard.why == "nothing was heard from the controller for 1 s"
    driver.receive(now())
    last = driver.got[-1]
    assert last.reason.fault in (Fault.ENDED, Fault.REACH)
    assert last.before.fault == Fault.SILENCE
    assert [m.reason for m in driver.got[-3:]] == [last.reason] * 3
    refusal = "refused a controller: it speaks protocol version 1; expected 3"
    assert running.lines.count(refusal) == 1
    assert Fault.ENDED.text == "the machine was ended"
