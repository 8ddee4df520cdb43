"""The programs over UDP of export-c, under the sanitizers: odd input, and what both sides say."""

import socket
import subprocess
import threading
import time

import pytest

from stewart_drake.core import build
from stewart_drake.export.controller import TEMPLATES
from stewart_drake.live.endpoint import LONGEST_KEY, SHORTEST_KEY, now
from stewart_drake.live.protocol import ControllerMessage, MachineMessage, encode
from stewart_drake.loop.peer import FAULTS, Fault
from stewart_drake.scenario.loading import load_scenario
from tests.building import SANITIZED, c_compiler
from tests.live_driver import Driver
from tests.test_machine_process import (
    DRAKE,
    SETTINGS,
    c_controller,
    folder,
    machine,
    machine_in_c,
    process,
)
from tests.test_protocol import PLAN, changed

__all__ = ["folder"]
TRIED = """
#include <arpa/inet.h>
#include <stdio.h>
#include <string.h>
#include "udp.h"
#include "stewart_example.h"
const char *const stewart_faults[STEWART_FAULTS];
int main(int argc, char **argv)
{
    uint8_t data[STEWART_LONGEST + 1];
    if (argc == 1)
        return !udp_draw(data, 32);
    if (strcmp(argv[1], "gets") != 0) {
        printf("%u\\n", (unsigned)udp_key(argv[1]).size);
        return 0;
    }
    stewart_key none = {NULL, 0};
    struct sockaddr_in at, from;
    socklen_t length = sizeof at;
    size_t size;
    int ear = udp_open(0, none), mouth = udp_open(0, none);
    if (getsockname(ear, (struct sockaddr *)&at, &length) != 0)
        return 1;
    memset(data, 7, sizeof data);
    udp_put(mouth, data, 0, &at);
    udp_put(mouth, data, 3, &at);
    udp_wait(ear, udp_now() + SECOND);
    while (udp_get(ear, data, &size, &from))
        printf("%u ", (unsigned)size);
    printf("\\n");
    return 0;
}
"""


@pytest.fixture(scope="module")
def tried(tmp_path_factory):
    """udp.c under the sanitizers, with and without a source of random bytes."""
    compiler = c_compiler()
    made = tmp_path_factory.mktemp("udp")
    (made / "tried.c").write_text(TRIED)
    sources = [str(made / "tried.c"), str(TEMPLATES / "udp.c"), str(TEMPLATES / "protocol.c")]
    native = f"-I{build.FOLDER}"
    flags = ["-D_POSIX_C_SOURCE=200809L", "-std=c99", "-Wall", "-Wextra", "-Wconversion", "-Werror"]
    for name, random in (("tried", "/dev/urandom"), ("without", "/nowhere")):
        command = [*compiler, *flags, *SANITIZED, f'-DUDP_RANDOM="{random}"', *sources]
        command += [f"-I{TEMPLATES}", native, "-lm", "-o", str(made / name)]
        subprocess.run(command, check=True)
    return made


def said(*command):
    done = subprocess.run([str(word) for word in command], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    return done.stdout.strip()


def test_a_key_file_beyond_what_python_takes_is_refused(tried, tmp_path):
    file = tmp_path / "key"
    for size, taken in (
        (0, 0),
        (SHORTEST_KEY - 1, 0),
        (SHORTEST_KEY, SHORTEST_KEY),
        (LONGEST_KEY, LONGEST_KEY),
        (LONGEST_KEY + 1, 0),
        (9000, 0),
    ):
        file.write_bytes(b"k" * size + b"\n")
        assert said(tried / "tried", file) == str(taken)


def test_without_random_bytes_there_is_no_session(tried):
    assert said(tried / "tried") == ""
    done = subprocess.run([tried / "without"], capture_output=True, text=True)
    assert done.returncode == 1 and done.stderr.startswith("/nowhere: no random bytes")


def test_a_datagram_without_a_byte_hides_none(tried):
    assert said(tried / "tried", "gets") == "0 3"


# ---------------------------------------------------------------- what both sides say


def test_a_controller_in_c_of_another_machine_is_refused_by_both(folder):
    settings = (*SETTINGS, "mechanism=paper_clear")
    with (
        machine(settings=settings) as (running, port),
        process(c_controller(folder, port)) as driving,
    ):
        assert driving.end() == 1
    names = "mechanism paper_clear", "mechanism paper"
    assert "the machine has {}; this controller is designed for {}".format(*names) in driving.said
    assert "is designed for {1}; this machine has {0}".format(*names) in running.said
    assert "0 sessions" in running.said


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
        "refused a controller: it is designed for mechanism paper_clear; this machine has "
        "mechanism paper"
    )
    assert running.lines.count(line) == 1


@pytest.mark.slow
def test_a_machine_in_c_is_not_locked_by_replayed_requests(folder, tmp_path):
    """Twenty a second, without the key: 10 of 10 runs connect."""
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
        for _ in range(10):
            with process(c_controller(folder, port, f"key={key}", "seconds=0.3")) as driving:
                connected += driving.end() == 0
        over.set()
        thread.join()
    attacker.close()
    assert connected == 10
    assert sum("a session begins" in line for line in running.lines) == 10


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
        driver = Driver(load_scenario("paper", settings=SETTINGS), ("127.0.0.1", port))
        while not driver.session.nonce:
            driver.say(now())
            time.sleep(0.1)
            driver.receive(now())
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
    assert FAULTS[Fault.ENDED] == "the machine was ended"
