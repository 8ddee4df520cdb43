"""Reachy Mini's own daemon, moved over Wi-Fi: each setpoint at once, against plans.

    make reachy

REACHY_DAEMON is the path of `reachy-mini-daemon`, which `make reachy` installs in an environment of
its own. Without it the benchmark is skipped. The daemon simulates the robot in real time, with the
ball joints as shipped. Wi-Fi is a relay on loopback: 20 ms and 30 ms lognormal(1) in each
direction, 5 % lost. The motion is that of `reachy.py`.

*At once*: setpoints at 50 Hz; the newest that has arrived is handed to the daemon. *Plans*:
`stewart-drake machine reachy_mini --reachy` beside the daemon, `stewart-drake live` beyond the
relay. The delay of the daemon is the lag of compensated setpoints without Wi-Fi at 0.5 Hz; plans
are sent ahead by it. The error is the angle between the daemon's own `head_pose` and the motion,
rms from 10 s on.
"""

import heapq
import json
import math
import os
import select
import socket
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from _bench import size, table, write
from live import Command
from reachy import BALL, FREQUENCIES, PERIOD, SERVOS, head_at, motion_file, setpoints

from stewart_drake.live.protocol import NEVER, SECOND, MachineMessage, decode

PORT = 8123
DURATION = size("DURATION", 60, 15)
SETTLED = 10.0
"""s from the begin of the motion; `live` leads the head onto it within 8 s."""
REST = 10.0
"""s of motion after the run, which `live` needs for coming to rest."""
LOSS, SEED = 0.05, 1
STEPS = int(os.environ.get("STEPS", "13"))
"""`delay.steps` of `live`."""
LAGS = np.arange(-0.1, 0.4, 0.005)
"""s, of the head behind the motion."""


def way(rng: np.random.Generator) -> float:
    """Return the time of a packet over Wi-Fi in s, infinite if it is lost."""
    return np.inf if rng.random() < LOSS else 0.02 + 0.03 * np.exp(rng.standard_normal())


class Wifi:
    """UDP relay to a machine on loopback, with the delays and losses of Wi-Fi.

    Attributes:
        address: where controllers find the machine.
        begin: time of the monotonic clock at which the machine began its last run, s.
    """

    def __init__(self, machine: str, seed: int) -> None:
        host, port = machine.split(":")
        self._machine, self._rng = (host, int(port)), np.random.default_rng(seed)
        self._front, self._back = (
            socket.socket(socket.AF_INET, socket.SOCK_DGRAM) for _ in range(2)
        )
        for one in (self._front, self._back):
            one.bind(("127.0.0.1", 0))
        self.address = f"127.0.0.1:{self._front.getsockname()[1]}"
        self._controller: Any = None
        self._origin, self.begin, self._closed = np.inf, np.nan, False
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    def close(self) -> None:
        """Close the relay."""
        self._closed = True
        self._thread.join()
        self._front.close()
        self._back.close()

    def _run(self) -> None:
        waiting, number = list[tuple[float, int, bool, bytes]](), 0
        while not self._closed:
            left = min(0.1, max(0.0, waiting[0][0] - time.monotonic())) if waiting else 0.1
            for one in select.select([self._front, self._back], [], [], left)[0]:
                data, sender = one.recvfrom(65536)
                there = one is self._front
                if there:
                    self._controller = sender
                else:
                    self._note(data)
                due = time.monotonic() + way(self._rng)
                if np.isfinite(due):
                    number += 1
                    heapq.heappush(waiting, (due, number, there, data))
            while waiting and waiting[0][0] <= time.monotonic():
                _, _, there, data = heapq.heappop(waiting)
                if there:
                    self._back.sendto(data, self._machine)
                elif self._controller is not None:
                    self._front.sendto(data, self._controller)

    def _note(self, data: bytes) -> None:
        message = decode(data)
        assert isinstance(message, MachineMessage)
        # A message leaves when its measurement is taken, or a little later.
        self._origin = min(self._origin, time.monotonic() - message.sampled / SECOND)
        if message.begin != NEVER:
            self.begin = self._origin + message.begin / SECOND


class Head:
    """Poses of the head that the daemon sends, with the time at which they came."""

    def __init__(self) -> None:
        from websockets.sync.client import connect

        self.times, self.rotations = list[float](), list[np.ndarray]()
        self._socket = connect(f"ws://127.0.0.1:{PORT}/ws/sdk", max_size=None, proxy=None)
        self._thread = threading.Thread(target=self._read, daemon=True)
        self._thread.start()

    def _read(self) -> None:
        for text in self._socket:
            message = json.loads(text) if isinstance(text, str) else {}
            if message.get("type") == "head_pose":
                self.times.append(time.monotonic())
                self.rotations.append(np.array(message["head_pose"])[:3, :3])

    def send(self, angles: np.ndarray) -> None:
        """Send crank angles (6,) in rad."""
        joints = [0.0, *angles.tolist()]
        self._socket.send(json.dumps({"type": "set_head_joints", "joints": joints}))

    def close(self) -> None:
        """Close the connection."""
        self._socket.close()
        self._thread.join()

    def errors(self, begin: float, frequency: float) -> np.ndarray:
        """Return the rms error in degrees for each of `LAGS`."""
        times, R = np.array(self.times) - begin, np.array(self.rotations)
        kept = (times > SETTLED) & (times < DURATION - 0.1)
        found = []
        for lag in LAGS:
            wanted, _ = head_at(times[kept] - lag, frequency)
            cosine = (np.einsum("nij,nij->n", wanted, R[kept]) - 1) / 2
            angles = np.degrees(np.arccos(np.clip(cosine, -1, 1)))
            found.append(np.sqrt(np.mean(angles**2)))
        return np.array(found)


def at_once(motion: Path, frequency: float, *, plain: bool, wifi: bool) -> np.ndarray:
    """Send each setpoint to the daemon when it arrives; return the errors by lag."""
    rng, head = np.random.default_rng(SEED), Head()
    rows = setpoints(motion, SERVOS["perfect"], 1.0, plain=plain, duration=DURATION)
    for share in np.linspace(0, 1, 50):  # from its sleep to the first row
        head.send(share * rows[0])
        time.sleep(0.03)
    sent = PERIOD * np.arange(len(rows))
    arrives = sent + [way(rng) if wifi else 0.0 for _ in sent]
    begin, newest = time.monotonic(), -1
    for k in np.argsort(arrives, kind="stable"):
        if not np.isfinite(arrives[k]):
            break
        time.sleep(max(0.0, begin + arrives[k] - time.monotonic()))
        if k > newest:  # an older one that was overtaken is dropped
            newest = int(k)
            head.send(rows[k])
    head.close()
    return head.errors(begin, frequency)


def in_plans(motion: Path, frequency: float, ahead: float) -> np.ndarray:
    """Drive the daemon with `machine` and `live` over Wi-Fi; return the errors by lag.

    Args:
        motion: CSV file.
        frequency: of the motion, Hz.
        ahead: delay of the daemon, s.
    """
    fields = [f"plant.{name}={value:.9g}" for name, value in BALL.items()]
    fields.append(f"actuator.torque_limit={SERVOS['perfect'][-1]}")
    fields += [f"reference={{kind: csv, file: {motion}}}", f"duration={DURATION}"]
    sets = [word for field in (*fields, f"delay.steps={STEPS}") for word in ("--set", field)]
    robot = ("--reachy", f"127.0.0.1:{PORT}", "--ahead", f"{ahead:g}", "--port", "0")
    driver = Command("machine", "reachy_mini", *robot, *sets)
    _, where = driver.wait_for(r" at (127\.0\.0\.1:\d+)")
    wifi, head = Wifi(where, SEED), Head()
    with tempfile.TemporaryDirectory() as folder:
        out = ("--duration", f"{DURATION}", "--no-browser", "--yes", "--out", folder)
        controller = Command("live", "reachy_mini", "--machine", wifi.address, *out, *sets)
        controller.process.wait(DURATION + 120)
        head.close()
        driver.end()
        wifi.close()
        controller.end()
        text = "\n".join(line for _, line in controller.lines)
        if controller.process.returncode:
            raise RuntimeError(text)
        summary = json.loads((Path(folder) / "summary.json").read_text())
    live = summary["live"]
    print(text, *(line for _, line in driver.lines), sep="\n")
    print({name: live[name] for name in ("periods_played", "periods_dry", "deadlines_missed")})
    return head.errors(wifi.begin, frequency)


def results(folder: Path) -> str:
    """Return the table of results as Markdown."""
    motions = {f: motion_file(f, folder, DURATION + REST) for f in FREQUENCIES}
    ahead = math.nan
    ways: dict[str, Callable[[Path, float], np.ndarray]] = {
        "crank angles at once, without Wi-Fi": partial(at_once, plain=True, wifi=False),
        "crank angles at once, over Wi-Fi": partial(at_once, plain=True, wifi=True),
        "compensated at once, without Wi-Fi": partial(at_once, plain=False, wifi=False),
        "compensated at once, over Wi-Fi": partial(at_once, plain=False, wifi=True),
        "compensated, plans over Wi-Fi": lambda *given: in_plans(*given, ahead),
    }
    rows = []
    for name, drive in ways.items():
        cells = [name]
        for f, motion in motions.items():
            found = drive(motion, f)
            least = int(np.argmin(found))
            print(name, f, np.round(found[::4], 2), flush=True)
            cells += [f"{np.interp(0.0, LAGS, found):.2f}", f"{found[least]:.2f}"]
            cells.append(f"{1e3 * LAGS[least]:.0f} ms")
            if name.startswith("compensated at once, without") and f == FREQUENCIES[0]:
                ahead = max(0.0, float(LAGS[least]))
        rows.append(cells)
    header = [f"{f:g} Hz{what}" for f in FREQUENCIES for what in ("", ", lag taken out", ", lag")]
    return table(["rms, deg", *header], rows)


def main() -> None:
    """Run the daemon and write the page."""
    daemon = os.environ.get("REACHY_DAEMON")
    if not daemon:
        sys.exit("skipped: REACHY_DAEMON is not set, see the head of this file")
    options = "--sim --headless --no-media --no-wake-up-on-start --no-goto-sleep-on-stop"
    own = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
    with tempfile.TemporaryDirectory() as folder, (Path(folder) / "daemon.log").open("w+") as log:
        process = subprocess.Popen(
            [daemon, *options.split(), "--fastapi-port", str(PORT)],
            env=own | {"MUJOCO_GL": "disable"},
            stdout=log,
            stderr=subprocess.STDOUT,
        )
        try:
            await_daemon(process, log.name)
            title = "Reachy Mini's daemon over Wi-Fi"
            write(__file__, title, [results(Path(folder))], ", reachy-mini 1.13.0")
        finally:
            process.terminate()
            process.wait(20)


def await_daemon(process: "subprocess.Popen[bytes]", log: str) -> None:
    """Wait until the daemon sends poses.

    Raises:
        RuntimeError: it ended, or sends none for a minute.
    """
    for _ in range(60):
        time.sleep(1.0)
        if process.poll() is not None:
            break
        try:
            head = Head()
        except OSError:
            continue
        time.sleep(1.0)
        head.close()
        if head.times:
            return
    raise RuntimeError(Path(log).read_text()[-2000:])


if __name__ == "__main__":
    main()
