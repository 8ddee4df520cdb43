"""Each kind of export over UDP: along its reference, and with damaged datagrams."""

import random
import select
import socket
import struct
import subprocess
import threading
import time
from contextlib import closing, contextmanager

import numpy as np
import pytest

import stewart_drake as sd
from stewart_drake.export import controller as export_c
from stewart_drake.live.endpoint import Endpoint
from stewart_drake.live.machine import Machine
from stewart_drake.live.options import Settings
from stewart_drake.live.protocol import ControllerMessage, decode
from stewart_drake.loop.preparation import prepare
from stewart_drake.mechanism.trajectories import evaluate
from stewart_drake.scenario.loading import load_scenario
from tests.building import SANITIZED, c_compiler, make
from tests.live_driver import in_a_thread, in_real_time
from tests.test_machine_process import c_controller
from tests.test_protocol import KEY, damaged

SECONDS = 3.0
ON_REFERENCE = ("plant.kind=exact", "start=on_reference", "queue=reference")
ENCODERS = ("sensor.kind=encoders", "sensor.bits=14", "sensor.samples=8")
WAY = "low: 0.05, high: 0.07, loss: 0.05"
NETWORK = (f"link={{kind: network, {WAY}, return: {{{WAY}}}, playout: 0.6}}",)
REACHY = ("delay.steps=4", "plant.accuracy=1e-7", "start=on_reference")
CASES = {
    "state": ("paper", ON_REFERENCE),
    "encoders": ("paper", (*ON_REFERENCE, *ENCODERS)),
    "network": ("paper", (*ON_REFERENCE, *NETWORK)),
    "encoders, network": ("paper", (*ON_REFERENCE, *ENCODERS, *NETWORK)),
    "setpoints": ("reachy_mini", REACHY),
}
BUFFERS = {
    "state": "link={kind: network, low: 0, high: 0.01, loss: 0.2, playout: 0.8}",
    "setpoints": "link={kind: network, low: 0, high: 0.01, loss: 0.2, playout: 0.08}",
}
"""Link of a machine with a play-out buffer, for an export for a wire."""


def scenario_of(case, *settings):
    name, own = CASES[case]
    return load_scenario(name, settings=(*own, f"duration={SECONDS}", *settings))


@pytest.fixture(scope="module")
def folder_of(tmp_path_factory):
    """Return a function that exports a case and compiles it under the sanitizers, once."""
    c_compiler()
    made = {}

    def folder(case):
        if case not in made:
            made[case] = tmp_path_factory.mktemp("driven")
            export_c.write(export_c.exported(scenario_of(case), measured=False), made[case])
            make(made[case], "udp", f"CFLAGS={' '.join(SANITIZED)}")
        return made[case]

    return folder


class Poses:
    """A log of poses, in memory."""

    def __init__(self):
        self.rows = []

    def write(self, time, values):
        self.rows.append((time, values["pose"]))

    def close(self):
        pass


@contextmanager
def machine_of(case, *settings, key=None):
    """Run the machine of a case in a thread, for a wire with a buffer; yield address and log."""
    buffer = [BUFFERS[case]] if case in BUFFERS else []
    log, scenario = Poses(), scenario_of(case, *buffer, *settings)
    with closing(Endpoint(ControllerMessage, "127.0.0.1", 0, key)) as endpoint:
        machine = Machine(prepare(scenario), endpoint, Settings(), lambda line: None, log=log)
        with in_a_thread(machine):
            yield endpoint.address, log


def error_of(case, log):
    """Return the mean error along the reference, as a share of its motion in %."""
    experiment, begin = prepare(scenario_of(case)), log.rows[0][0]
    errors = [
        np.abs(pose - evaluate(experiment.reference, time - begin)[:6]) / experiment.scale
        for time, pose in log.rows
        if time - begin < SECONDS - 1e-6
    ]
    assert len(errors) == round(SECONDS / experiment.scenario.controller.period)
    return 100 * np.mean(errors)


def drive(folder, port, *options):
    """Run the controller in C to its end."""
    command = c_controller(folder, port, f"seconds={SECONDS}", *options)
    return subprocess.run(command, capture_output=True, text=True, timeout=100)


# ---------------------------------------------------------------- along the reference


@pytest.mark.slow
@pytest.mark.parametrize(
    "case",
    [pytest.param(n, marks=pytest.mark.soak if n == "encoders, network" else ()) for n in CASES],
)
@in_real_time
def test_the_controller_in_c_follows_as_live_does(case, folder_of, tmp_path):
    """Its mean error is within 1.5 times that of `live` and 0.05 % of the motion."""
    errors = []
    with machine_of(case) as (address, log):
        done = drive(folder_of(case), address[1], f"log={tmp_path / 'log'}")
        assert done.returncode == 0, done
    if "network" in case:  # without a datagram there is no report, which a negative age says
        rows = np.loadtxt(tmp_path / "log", delimiter=",", skiprows=1)
        assert set(rows[np.isnan(rows[:, 1]), -1]) <= {-1.0}
    errors.append(error_of(case, log))
    with machine_of(case) as ((host, port), log):
        run = sd.run_live(scenario_of(case), f"{host}:{port}", duration=SECONDS, accept_jitter=True)
        assert run.status == "completed"
    errors.append(error_of(case, log))
    assert errors[0] < 1.5 * errors[1] + 0.05


@pytest.mark.slow
@in_real_time
@pytest.mark.parametrize(
    ("faults", "end"),
    [
        (
            "{kind: missing, from: 0.55, to: 9}",
            "no usable measurement for 1.1 s (11 missing, 0 froz",
        ),
        ("{kind: missing, leg: 2, from: 0.55, to: 9}", "completed after 30 samples, "),
    ],
)
def test_a_second_without_a_usable_measurement_ends_the_run(faults, end, folder_of):
    """The loss of a single encoder does not end it."""
    with machine_of("encoders", f"sensor.faults=[{faults}]") as ((_, port), _):
        done = drive(folder_of("encoders"), port)
    assert end in done.stdout and done.returncode == end.startswith("no"), done


# ---------------------------------------------------------------- damaged datagrams


class Relay:
    """Link between a controller and a machine, whose datagrams pass `mangle`."""

    def __init__(self, machine, mangle):
        self._machine, self._mangle, self._over = machine, mangle, threading.Event()
        self._front, self._back, self._foreign = (
            socket.socket(socket.AF_INET, socket.SOCK_DGRAM) for _ in range(3)
        )
        self._front.bind(("127.0.0.1", 0))
        self._back.bind(("127.0.0.1", 0))
        self.port = self._front.getsockname()[1]
        self._thread = threading.Thread(target=self._run)

    def _run(self):
        controller = None
        while not self._over.is_set():
            for ready in select.select([self._front, self._back], [], [], 0.05)[0]:
                data, address = ready.recvfrom(2000)
                if ready is self._front:
                    controller = address
                    self._back.sendto(data, self._machine)
                elif controller is not None:
                    self._foreign.sendto(data, controller)
                    for one in self._mangle(data):
                        self._front.sendto(one, controller)

    def __enter__(self):
        self._thread.start()
        return self

    def __exit__(self, *_):
        self._over.set()
        self._thread.join()
        for one in (self._front, self._back, self._foreign):
            one.close()


def disturbed(rng):
    """Return a function that adds damaged and replayed datagrams, and reorders a few."""
    before, held = [], []

    def mangle(data):
        found = [damaged(rng, data), rng.randbytes(rng.randrange(1600)), b""]
        before.append(data)
        if not held and len(before) > 120 and rng.random() < 0.1:
            held.append(data)
            return found
        found += [data, data, *held, before[0], rng.choice(before)]
        held.clear()
        return found

    return mangle


@pytest.mark.slow
@pytest.mark.parametrize("case", ["state", "encoders, network", "setpoints"])
@in_real_time
def test_damaged_replayed_and_reordered_datagrams_change_nothing(case, folder_of, tmp_path):
    """Both sides have a key. A measurement that is overtaken counts as late, or is used later."""
    key = tmp_path / "key"
    key.write_bytes(KEY)
    with (
        machine_of(case, key=KEY) as (address, log),
        Relay(address, disturbed(random.Random(7))) as relay,
    ):
        done = drive(folder_of(case), relay.port, f"key={key}")
    assert done.returncode == 0, done
    assert "completed after" in done.stdout and done.stderr == ""
    refused = done.stdout.split("refused: ")[1].split()
    counts = dict(zip(refused[1::2], map(int, refused[::2]), strict=True))
    for cause in ("malformed,", "key,", "foreign,", "replayed,"):
        assert counts[cause] > 30, counts
    error = error_of(case, log)
    assert error < 1


OFFER = 3


def slower(data):
    """Delay what the machine sends by 10 ms, from the first sample of the run on."""
    message = decode(data)
    time.sleep(0.01 if message.begin <= message.sampled else 0.0)
    return [data]


@pytest.mark.slow
@in_real_time
def test_a_machine_that_answers_later_in_a_run_than_before_it_is_waited_for(folder_of):
    """A measurement is not lost before its torque must leave."""
    quiet = BUFFERS["state"].replace("loss: 0.2", "loss: 0.0")
    with machine_of("state", quiet) as (address, log), Relay(address, slower) as relay:
        done = drive(folder_of("state"), relay.port)
    assert " 0 of them without a measurement, 0 late" in done.stdout
    assert error_of("state", log) < 1


NUMBERS = {4: "<I", 8: "<Q"}
FIELDS = [(28, 4), *((place, 8) for place in (32, 40, 48)), (56, 4)]
FIELDS += [*((place, 8) for place in range(64, 128, 8)), (136, 4), (144, 8), (152, 8)]
EXTREMES = (0, 1, 2, 2**31 - 1, 2**31, 2**32 - 1, 2**52, 2**63 - 1, 2**63, 2**64 - 1)
REALS = (0.0, -0.0, 1e-300, 1e300, -1.0, 1e18, float("inf"), float("nan"))


def odd(rng):
    """Return a function that gives datagrams after the offers extreme numbers; most are valid."""

    def mangle(data):
        if data[60] == OFFER:
            return [data]
        changed = bytearray(data)
        for _ in range(rng.randrange(3) if rng.random() < 0.5 else 0):
            place, size = rng.choice(FIELDS)
            number = rng.choice(EXTREMES) % 2 ** (8 * size)
            new = struct.pack(NUMBERS[size], number)
            if size == 8 and rng.random() < 0.4:
                new = struct.pack("<d", rng.choice(REALS))
            changed[place : place + size] = new
        for _ in range(rng.randrange(3) if rng.random() < 0.5 and len(data) > 200 else 0):
            place = 160 + 8 * rng.randrange((len(data) - 160) // 8)
            changed[place : place + 8] = struct.pack("<d", rng.choice(REALS))
        return [bytes(changed)]

    return mangle


@pytest.mark.slow
@pytest.mark.parametrize("case", ["state", "encoders, network", "setpoints"])
def test_odd_numbers_in_valid_datagrams_are_survived(case, folder_of):
    """The run ends, completed or with a reason, without a word of the sanitizers."""
    for seed in range(3):
        with machine_of(case) as (address, _), Relay(address, odd(random.Random(seed))) as relay:
            done = drive(folder_of(case), relay.port)
        assert done.returncode in (0, 1) and done.stderr == "", (seed, done)
        assert " samples, " in done.stdout, (seed, done)
