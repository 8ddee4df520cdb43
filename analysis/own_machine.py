"""A complete machine end in plain Python: put your drives and sensors in place of `Plate`.

    python analysis/own_machine.py 47000 &
    stewart-drake live paper --machine 127.0.0.1:47000 --duration 10 --no-browser

The bytes are those of docs/protocol.md; byte numbers below are of its tables. It talks over the
loopback interface only, without a key.
"""

import hmac
import math
import secrets
import struct
import sys
import time
from socket import AF_INET, SOCK_DGRAM, socket

import numpy as np

import stewart_drake as sd

NEVER, WATCHDOG = 2**64 - 1, 10**9  # ns
SIMULATION, PARKED, RUNNING, SAFE, BUSY, RESETS = 1, 2, 4, 8, 64, 256
PARTS = range(0, 160, 40)  # of an identity, each begins with a digest of 8 bytes
STOP, REQUEST, STATE, OFFER = 1, 1, 1, 3
HEAD = struct.Struct("<4sBBHQQIIQQQI")  # magic ... flags
FROM_CONTROLLER = struct.Struct("<BB2xQQQ")  # rows, content, sampled, playout, begin
FROM_MACHINE = struct.Struct("<BBBBQQQQddQQIIIBBBxQQ")  # kind ... before_lasted


class Plate:
    """The plant: motors, mechanics and sensors. Here the equations of motion, by Runge-Kutta."""

    def __init__(self, dynamics: sd.StewartDynamics) -> None:
        self.dynamics = dynamics
        self.state = np.concatenate([dynamics.mechanism.home, np.zeros(6)])

    def move(self, torque: np.ndarray, seconds: float, steps: int = 20) -> None:
        """Apply torques (6,) in N m for a time in s."""
        h, x = seconds / steps, self.state
        for _ in range(steps):
            k1 = self.dynamics.change(x, torque)
            k2 = self.dynamics.change(x + h / 2 * k1, torque)
            k3 = self.dynamics.change(x + h / 2 * k2, torque)
            k4 = self.dynamics.change(x + h * k3, torque)
            x = x + h / 6 * (k1 + 2 * k2 + 2 * k3 + k4)
        self.state = x

    def measured(self) -> np.ndarray:
        """Return pose and rates (12,), rad, m and per s."""
        return self.state


class Machine:
    """A session, a play-out buffer and a clock in ns from the start of the machine."""

    def __init__(self, scenario: sd.Scenario, port: int) -> None:
        self.period = round(scenario.controller.period * 1e9)
        self.identity = sd.machine_identity(scenario)
        self.dynamics = sd.StewartDynamics(
            sd.load_mechanism(scenario.mechanism), scenario.plant.gravity
        )
        self.limit = self.dynamics.mechanism.effort_limit or math.inf
        self.socket = socket(AF_INET, SOCK_DGRAM)
        self.socket.bind(("127.0.0.1", port))
        self.secret, self.sessions, self.started = secrets.token_bytes(32), 0, time.monotonic_ns()
        self.session = self.nonce = 0
        self.address = None
        self.rest()

    def rest(self) -> None:
        """Put the plate to rest, with brakes on and an empty buffer."""
        self.plate, self.torque = Plate(self.dynamics), np.zeros(6)
        self.begin, self.plans, self.acted, self.stopped = NEVER, {}, [], False
        self.played = self.dry = self.refused = self.sequence = 0

    def now(self) -> int:
        return time.monotonic_ns() - self.started

    def run(self, seconds: float = math.inf) -> None:
        """Take a measurement and change the torque at each multiple of the period."""
        tick = self.period
        while self.now() < seconds * 1e9:
            while (left := tick - self.now()) > 0:
                self.socket.settimeout(left / 1e9)
                try:
                    self.take(*self.socket.recvfrom(2048))
                except (TimeoutError, BlockingIOError):
                    break
                except (struct.error, ValueError):
                    self.refused += 1
            self.step(tick)
            tick += self.period

    def step(self, tick: int) -> None:
        """Move the plate up to a multiple of the period, measure, and play the newest row."""
        if self.begin < tick:  # brakes are off
            self.plate.move(self.torque, self.period / 1e9)
        if self.begin <= tick:
            rows = {n: (tick - at) // self.period for n, (at, _) in self.plans.items()}
            there = [n for n, row in rows.items() if 0 <= row < len(self.plans[n][1])]
            self.torque, safe = np.zeros(6), self.safe(tick)
            dry = not there or safe
            if not dry:
                newest = max(there)
                wanted = self.plans[newest][1][rows[newest]]
                self.torque = np.clip(wanted, -self.limit, self.limit)
            self.played += not dry
            self.dry += dry and self.played > 0 and not safe  # from the first play-out on
            self.acted = [self.torque, *self.acted[:7]]
            self.plans = {n: plan for n, plan in self.plans.items() if n in there or rows[n] < 0}
        if self.address is not None:
            self.sequence += 1
            state = self.plate.measured()
            content = struct.pack("<12d", *state)
            self.send(self.address, self.head(self.sequence), STATE, tick, content)

    def safe(self, now: int) -> bool:
        """Return whether the safe torque, zero, acts: after stop, and after silence."""
        return self.stopped or now - self.heard > WATCHDOG

    def take(self, data: bytes, address: tuple[str, int]) -> None:
        """Take a datagram of a controller."""
        head = HEAD.unpack_from(data)
        magic, version, tag, length, session, nonce, number, _, sent, _, _, flags = head
        if (magic, version, tag, length) != (b"STWC", 3, 0, len(data)) or 0 in (session, number):
            raise ValueError("malformed")
        count, content, _, playout, begin = FROM_CONTROLLER.unpack_from(data, 60)
        now = self.now()
        driven = self.address is not None and not self.safe(now)
        key = f"{session} {address} {self.sessions}".encode()
        offered = int.from_bytes(hmac.digest(self.secret, key, "sha256")[:8], "little") | 1
        if content == REQUEST:
            digests = [(data[88 + at : 96 + at], self.identity[at : at + 8]) for at in PARTS]
            nonce = offered if all(a == b for a, b in digests) else 0
            head = session, nonce, number, number, sent, now, 1, PARKED | BUSY * driven
            self.send(address, head, OFFER, now, self.identity)
            return
        if (session, nonce) != (self.session, self.nonce):
            if driven or nonce != offered:
                raise ValueError("foreign")
            self.rest()
            self.session, self.nonce, self.address = session, nonce, address
            self.sessions, self.sequence = self.sessions + 1, number - 1
            self.newest, self.seen, self.heard = number, 0, now
        behind = self.newest - number
        if behind >= 64 or (behind >= 0 and self.seen >> behind & 1):
            raise ValueError("late or replayed")
        self.seen = (self.seen << max(-behind, 0) | 1 << max(behind, 0)) & NEVER
        if number >= self.newest:
            self.newest, self.echo = number, sent
        self.heard, self.stopped = now, self.stopped or bool(flags & STOP)
        if begin != NEVER and self.begin == NEVER:
            self.begin = -(-max(begin, now) // self.period) * self.period
        rows = np.frombuffer(data, "<f8", 6 * count, 88).reshape(-1, 6)
        if count and np.all(np.isfinite(rows)):
            self.plans[number] = playout, rows

    def head(self, sequence: int) -> tuple[int, ...]:
        """Return session, nonce, sequence, what was received last, and the flags."""
        now = self.now()
        flags = SAFE * self.safe(now) | (RUNNING if self.begin <= now else PARKED)
        received = self.newest, self.echo, self.heard, self.seen
        return self.session, self.nonce, sequence, *received, flags

    def send(self, to: tuple, head: tuple, kind: int, sampled: int, content: bytes) -> None:
        """Send an offer, or a measurement with the torques that acted, the newest first."""
        session, nonce, sequence, acknowledged, echo, heard, seen, flags = head
        acted = [] if kind == OFFER else self.acted
        body = FROM_MACHINE.pack(
            *(kind, kind == STATE, 0, len(acted), sampled, NEVER if kind == OFFER else self.begin),
            *(self.period, WATCHDOG, 1.0, self.limit, seen, sampled if acted else NEVER),
            *(self.played, self.dry, self.refused, 0, 0, 0, 0, 0),
        )
        body += content + b"".join(torque.astype("<f8").tobytes() for torque in acted)
        now, size = self.now(), HEAD.size + len(body)
        numbers = session, nonce, sequence, acknowledged, now, echo, now - heard
        first = HEAD.pack(b"STWM", 3, 0, size, *numbers, SIMULATION | RESETS | flags)
        self.socket.sendto(first + body, to)


if __name__ == "__main__":
    Machine(sd.load_scenario("paper"), int(sys.argv[1]) if sys.argv[1:] else 47000).run()
