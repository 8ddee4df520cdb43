"""Send setpoints.csv to Reachy Mini's daemon, and log them with the crank angles.

    python analysis/reachy_send.py setpoints.csv --reachy 127.0.0.1:8000 --log log.csv --arm

The head moves softly to the first row, then gets each row at its time, and is held at the end or
at Ctrl-C. The body keeps its yaw. A file beyond the cranks' range or speed is refused.
`stewart-drake identify` takes the log. Needs websockets only.
"""

import argparse
import csv
import json
import math
import time

from websockets.exceptions import WebSocketException
from websockets.sync.client import connect

STALE = 0.5  # s without positions after which the daemon counts as lost
SPEED = 0.5  # rad/s, largest of a crank on the way to the first row
PERIOD = 0.02  # s, of setpoints on that way
JOINTS = 7  # the body's yaw, then the cranks
RANGES = [
    *([-0.837758, 1.396263], [-1.396263, 1.221730], [-0.837758, 1.396263]),
    *([-1.396263, 0.837758], [-1.221730, 1.396263], [-1.396263, 0.837758]),
]  # rad, of the cranks
SPEED_LIMIT = 8.0  # rad/s, of the cranks
ROUNDING = 1e-5  # rad, of the file
HEADER = ["time[s]"] + [f"{name}_{k}[rad]" for name in ("setpoint", "crank") for k in range(1, 7)]


def read(path):
    """Return the rows (time, six angles) of a file; refuse one that is not safe to send."""
    try:
        with open(path, newline="", encoding="utf-8") as file:
            head, *lines = list(csv.reader(file)) or [[]]
    except (OSError, UnicodeError, csv.Error) as error:
        raise SystemExit(f"{path}: got {error}; expected a file of setpoints") from None
    if len(head) != JOINTS or not all(name.endswith("[rad]") for name in head[1:]) or not lines:
        raise SystemExit(f"{path}: got columns {head}; expected time[s], six [rad], and rows")
    rows = []
    for number, cells in enumerate(lines, 2):
        if not safe(row := numbers(cells), rows[-1] if rows else [-PERIOD, *row[1:]]):
            raise SystemExit(
                f"{path}, line {number}: got {','.join(cells)}; expected a later time and six "
                f"angles in rad, within RANGES, at most {SPEED_LIMIT} rad/s from those before"
            )
        rows.append(row)
    return rows


def numbers(cells):
    try:
        return [float(cell) for cell in cells]
    except ValueError:
        return []


def safe(row, before):
    """Return whether a row is complete, later than the one before, and within the limits."""
    return (
        len(row) == JOINTS
        and 0 < row[0] - before[0] < math.inf
        and all(
            low - ROUNDING <= angle <= high + ROUNDING
            and abs(angle - last) <= SPEED_LIMIT * (row[0] - before[0]) + ROUNDING
            for angle, last, (low, high) in zip(row[1:], before[1:], RANGES, strict=True)
        )
    )


class Robot:
    """Connection to the daemon, with its newest positions and status."""

    def __init__(self, socket):
        self.socket, self.joints, self.status, self.heard = socket, None, {}, time.monotonic()

    def listen(self, until):
        """Take messages until a time of the own clock, s."""
        while (left := until - time.monotonic()) > 0:
            try:
                message = json.loads(self.socket.recv(timeout=left))
            except TimeoutError:
                break
            if message.get("type") == "daemon_status":
                self.status = message
            if message.get("type") == "joint_positions":
                self.joints, self.heard = message["head_joint_positions"], time.monotonic()
        if time.monotonic() - self.heard > STALE:
            raise SystemExit(f"the daemon sent no positions for {STALE} s; the head is held")

    def send(self, cranks):
        joints = [self.joints[0], *cranks]
        self.socket.send(json.dumps({"type": "set_head_joints", "joints": joints}))


def check(robot, armed):
    """Refuse a real robot without consent, and motors that are off."""
    while not robot.status and time.monotonic() < robot.heard + STALE:
        robot.listen(time.monotonic() + PERIOD)
    simulated = robot.status.get("simulation_enabled") or robot.status.get("mockup_sim_enabled")
    if not (simulated or armed):
        raise SystemExit("--arm: not given, for a daemon that does not report a simulation")
    mode = (robot.status.get("backend_status") or {}).get("motor_control_mode", "enabled")
    if mode != "enabled":
        raise SystemExit(f"motors {mode}: expected enabled, by the robot's own app")


def lead(robot, goal):
    """Move the cranks softly to the first setpoints."""
    start = robot.joints[1:]
    way = max(abs(b - a) for a, b in zip(start, goal, strict=True))
    number = max(50, round(1.875 * way / SPEED / PERIOD))  # a quintic peaks at 1.875 its mean
    begin = time.monotonic()
    for k in range(1, number + 1):
        s = k / number
        g = s**3 * (10 - 15 * s + 6 * s**2)
        robot.send([a + g * (b - a) for a, b in zip(start, goal, strict=True)])
        robot.listen(begin + k * PERIOD)
    robot.listen(time.monotonic() + 1.0)


def play(robot, rows, log):
    """Send each row (time, six angles) at its time; log it with the angles before it."""
    begin = time.monotonic()
    for at, *goals in rows:
        robot.listen(begin + at)
        log.writerow([f"{time.monotonic() - begin:.6f}", *goals, *robot.joints[1:]])
        robot.send(goals)
    robot.listen(time.monotonic() + PERIOD)


def main(words=None):
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("setpoints")
    parser.add_argument("--reachy", default="127.0.0.1:8000", metavar="HOST:PORT")
    parser.add_argument("--log", default="log.csv")
    parser.add_argument("--arm", action="store_true", help="drive a real robot")
    given = parser.parse_args(words)
    rows = read(given.setpoints)
    with (
        connect(f"ws://{given.reachy}/ws/sdk", proxy=None) as socket,
        open(given.log, "w", newline="") as file,
    ):
        robot, log = Robot(socket), csv.writer(file)
        while robot.joints is None:
            robot.listen(time.monotonic() + PERIOD)
        check(robot, given.arm)
        log.writerow(HEADER)
        lead(robot, rows[0][1:])
        play(robot, rows, log)
    print(f"sent {len(rows)} setpoints, logged to {given.log}; the head is held")


if __name__ == "__main__":
    try:
        main()
    except KeyboardInterrupt:
        raise SystemExit("stopped; the head is held") from None
    except (OSError, WebSocketException) as error:
        raise SystemExit(f"daemon: {error}") from None
