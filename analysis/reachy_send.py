"""Send setpoints.csv to Reachy Mini's daemon, and log them with the crank angles.

    python analysis/reachy_send.py setpoints.csv --reachy 127.0.0.1:8000 --log log.csv --arm

The head moves softly to the first row, then gets each row at its time, and is held at the end or
at Ctrl-C. Motors that are off end it. The body keeps its yaw. A file beyond the cranks' range or
speed is refused.
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
GAP = 0.1  # s without positions after which the next row waits for them
PATIENCE = 2.5  # s to wait for the status, sent once a second
FOLLOWED = 0.3  # rad, largest distance of a crank after the way to the first row
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
    if len(head) != JOINTS or not all(name.endswith("[rad]") for name in head[1:]):
        raise SystemExit(f"{path}: got columns {head}; expected time[s] and six in [rad]")
    rows = []
    for number, cells in enumerate(lines, 2):
        if cells:
            row = numbers(cells)
            if wrong := problem(row, rows[-1] if rows else [-math.inf, *row[1:]]):
                raise SystemExit(f"{path}, line {number}: got {','.join(cells)}; expected {wrong}")
            rows.append(row)
    if not rows:
        raise SystemExit(f"{path}: got a header only; expected rows")
    return rows


def numbers(cells):
    try:
        return [float(cell) for cell in cells]
    except ValueError:
        return []


def problem(row, before):
    """Return what is expected where a row is incomplete, out of order or beyond the limits."""
    if len(row) != JOINTS or not all(map(math.isfinite, row)):
        return "a time and six angles, finite numbers"
    if (since := row[0] - before[0]) <= 0:
        return f"a time after {before[0]:g} s"
    for k, (angle, last, (low, high)) in enumerate(zip(row[1:], before[1:], RANGES, strict=True)):
        if not low - ROUNDING <= angle <= high + ROUNDING:
            return f"setpoint_{k + 1} from {low:.4g} to {high:.4g} rad"
        if abs(angle - last) > SPEED_LIMIT * since + ROUNDING:
            return f"setpoint_{k + 1} at most {SPEED_LIMIT:g} rad/s from {last:g} rad"
    return ""


class Robot:
    """Connection to the daemon, with its newest positions and status."""

    def __init__(self, socket):
        self.socket, self.yaw, self.cranks, self.status = socket, None, None, {}
        self.heard = time.monotonic()

    def listen(self, until):
        """Take messages until a time of the own clock, s, and on while no positions come."""
        while (now := time.monotonic()) < until or now - self.heard > GAP:
            if now - self.heard > STALE:
                raise SystemExit(f"the daemon sent no positions for {STALE} s; the head is held")
            try:
                text = self.socket.recv(timeout=until - now if now < until else GAP)
            except TimeoutError:
                continue
            try:
                self.take(json.loads(text))
            except (ValueError, LookupError, TypeError, AttributeError):
                continue  # without usable positions for STALE it ends

    def take(self, message):
        """Take the status or the positions; raise ValueError where positions are unusable."""
        if message["type"] == "daemon_status":
            self.status = message
            mode = (message.get("backend_status") or {}).get("motor_control_mode", "enabled")
            if mode != "enabled":
                raise SystemExit(f"motors {mode}: nothing is sent; enable them, start again")
        if message["type"] == "joint_positions":
            yaw, *cranks = message["head_joint_positions"]
            if len(cranks) != JOINTS - 1 or not all(abs(a) < 2 * math.pi for a in (yaw, *cranks)):
                raise ValueError
            self.yaw = yaw if self.yaw is None else self.yaw
            self.cranks, self.heard = cranks, time.monotonic()

    def send(self, cranks):
        message = {"type": "set_head_joints", "joints": [self.yaw, *cranks]}
        self.socket.send(json.dumps(message))

    def distance(self, goal):
        """Return the largest distance of a crank from its setpoint, rad."""
        return max(abs(b - a) for a, b in zip(self.cranks, goal, strict=True))

    def play(self, rows):
        """Send each row (time, six angles) at its time; yield it before, and the seconds so far.

        After a pause of the connection the rows follow later; none catches up.
        """
        began = begin = time.monotonic() - rows[0][0]
        for at, *goals in rows:
            self.listen(begin + at)
            begin = max(begin, time.monotonic() - at - PERIOD)
            yield time.monotonic() - began - rows[0][0], goals
            self.send(goals)
        self.listen(time.monotonic() + PERIOD)


def check(robot, armed):
    """Refuse a daemon without a status, and a real robot without consent."""
    until = time.monotonic() + PATIENCE
    while (robot.cranks is None or not robot.status) and time.monotonic() < until:
        robot.listen(time.monotonic() + PERIOD)
    if not robot.status:
        raise SystemExit(f"the daemon sent no status for {PATIENCE} s: are the motors on?")
    simulated = robot.status.get("simulation_enabled") or robot.status.get("mockup_sim_enabled")
    if not (simulated or armed):
        raise SystemExit("--arm: not given, for a daemon that does not report a simulation")


def lead(robot, goal):
    """Move the cranks softly to the first setpoints."""
    start, way = robot.cranks, robot.distance(goal)
    number = max(50, round(1.875 * way / SPEED / PERIOD))  # a quintic peaks at 1.875 its mean
    rows = []
    for k in range(1, number + 1):
        s = k / number
        g = s**3 * (10 - 15 * s + 6 * s**2)
        rows.append([k * PERIOD, *(a + g * (b - a) for a, b in zip(start, goal, strict=True))])
    for _ in robot.play(rows):
        pass
    robot.listen(time.monotonic() + 1.0)
    if (left := robot.distance(goal)) > FOLLOWED:
        raise SystemExit(
            f"the head did not follow: a crank is {left:.2g} rad from its setpoint; "
            "expected no other app or move that holds the head"
        )


def main(words=None):
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("setpoints")
    parser.add_argument("--reachy", default="127.0.0.1:8000", metavar="HOST:PORT")
    parser.add_argument("--log", default="log.csv")
    parser.add_argument("--arm", action="store_true", help="drive a real robot")
    given = parser.parse_args(words)
    rows = read(given.setpoints)
    furthest = seconds = 0.0
    with open(given.log, "a", newline="") as file:  # a refused start keeps an earlier log
        try:
            with connect(f"ws://{given.reachy}/ws/sdk", proxy=None) as socket:
                robot, log = Robot(socket), csv.writer(file)
                check(robot, given.arm)
                lead(robot, rows[0][1:])
                file.truncate(0)
                log.writerow(HEADER)
                for seconds, goals in robot.play(rows):
                    log.writerow([f"{seconds:.6f}", *goals, *robot.cranks])
                    furthest = max(furthest, robot.distance(goals))
        except (OSError, ValueError, WebSocketException) as error:
            raise SystemExit(
                f"daemon at {given.reachy}: {error}; expected a daemon at HOST:PORT, usually 8000"
            ) from None
    print(
        f"sent {len(rows)} setpoints in {seconds:.2f} s, the cranks at most {furthest:.2g} rad "
        f"from them, logged to {given.log}; the head is held"
    )


if __name__ == "__main__":
    try:
        main()
    except KeyboardInterrupt:
        raise SystemExit("stopped; the head is held") from None
    except OSError as error:
        raise SystemExit(f"--log: {error}") from None
