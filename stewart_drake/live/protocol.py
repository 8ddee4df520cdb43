"""The datagrams between a machine and its controller: contents and encoding.

docs/protocol.md defines every byte; `export-c` writes the same protocol in C. Numbers are
little-endian. Times are whole nanoseconds of the *machine's* clock, which starts with the machine.
Exceptions are `time`, of the sender's clock, and `echo`, of the receiver's.
"""

import hashlib
import hmac
import math
import struct
from dataclasses import dataclass, field
from enum import Enum, IntFlag
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from stewart_drake.loop.peer import (
    DIGEST,
    MOST_BITS,
    MOST_ROWS,
    MOST_SAMPLES,
    NAME,
    NO_FAULT,
    Fault,
    Identity,
    Part,
    Reason,
    in_words,
)
from stewart_drake.scenario.signals import NUM_LEGS, NUM_STATE, NUM_TORQUES
from stewart_drake.types import Array

VERSION: Final = 3
MAGIC_MACHINE: Final = b"STWM"
MAGIC_CONTROLLER: Final = b"STWC"
TAG: Final = 16
"""Bytes of HMAC-SHA256 at the end of a datagram with a key."""
NEVER: Final = 2**64 - 1
"""An unknown time."""
LONGEST: Final = 1452
"""Longest datagram, bytes: not fragmented by Ethernet and IPv6."""
MOST_HISTORY: Final = 16
"""Largest number of reported torques."""
MISSING: Final = -(2**31)
"""Code of a missing sample."""
SECOND: Final = 10**9

# magic, version, bytes of the tag, bytes in all, session, nonce, sequence, acknowledged, time,
# echo, held, flags
_HEAD: Final = struct.Struct("<4sBBHQQIIQQQI")
_MACHINE: Final = struct.Struct("<BBBBQQQQddQQIIIBBBBQQ")
_MACHINE_NUMBERS: Final = (
    *("kind", "samples", "bits", "history", "sampled", "begin", "period", "watchdog", "rate"),
    *("torque_limit", "arrived", "acted_from", "played", "dry", "refused"),
    *("fault", "leg", "before", "content", "lasted", "before_lasted"),
)
# rows, content, reserved (2); sampled, playout, begin
_CONTROLLER: Final = struct.Struct("<BB2xQQQ")
_PART: Final = struct.Struct(f"<{DIGEST}s{NAME}s")
_IDENTITY: Final = _PART.size * len(Identity._fields)
_PADDING: Final = bytes(_MACHINE.size - _CONTROLLER.size)
"""Padding that makes a request as long as its answer."""
_REQUEST: Final = 1
"""Content of a controller's datagram with an identity."""
_CRANKS: Final = 2
"""Content of a datagram whose rows are crank angles."""
_OFFERS: Final = 3
"""Kind of a machine's datagram with its identity instead of a measurement."""


class Refusal(Enum):
    MALFORMED = "malformed"
    """Not a datagram of this protocol: length, magic, a count or a number outside its range."""
    VERSION = "version"
    KEY = "key"
    """A wrong or missing tag, or a tag although no key is used."""
    FOREIGN = "foreign"
    """Another session or another address."""
    REPLAYED = "replayed"
    """A sequence that has come before."""
    LATE = "late"
    """Too old to be used, or to be distinguished from a replay."""
    RATE = "rate"
    """A request of an unknown address, above the rate at which these are answered."""


class RefusedError(Exception):
    def __init__(self, cause: Refusal, detail: str = "") -> None:
        super().__init__(f"{cause.value}: {detail}" if detail else cause.value)
        self.cause, self.detail = cause, detail


class MachineFlags(IntFlag):
    SIMULATION = 1
    """A simulation. Without it a controller must be armed."""
    PARKED = 2
    """Brakes are on: torques have no effect before `begin`."""
    RUNNING = 4
    """The run has begun and torques act."""
    SAFE = 8
    """The safe torque acts: after a stop, or `watchdog` without a datagram or a row in time."""
    LEFT = 16
    """The plate has left its workspace; the machine has stopped."""
    HOLDS = 32
    """A dry buffer holds the last torque; without it zero acts."""
    BUSY = 64
    """Another controller drives it: this offer of a session would be refused."""
    WIRE = 128
    """A simulated wire: torques act on arrival, without play-out time."""
    RESETS = 256
    """A new session begins at rest at the scenario's start; without it at the present state."""
    SAFE_HOLDS = 512
    """The safe torque is the last one; without it zero."""


class ControllerFlags(IntFlag):
    STOP = 1
    """The safe torque at once, and the end of the session."""
    ARMED = 2
    """The controller may drive a real machine, which does not begin without it."""


NOTHING: Final = ControllerFlags(0)


@dataclass(frozen=True)
class Head:
    session: int  # random number of the controller, not 0
    nonce: int  # nonce of the machine's offer; 0 in a first request and in its refusal
    sequence: int  # number of the sender's datagram in the session, from 1 on
    acknowledged: int  # newest sequence received from the other side, 0 for none
    time: int  # sender's clock at sending, ns
    echo: int  # `time` of the acknowledged datagram
    held: int  # time since its arrival, ns


@dataclass(frozen=True, eq=False)
class MachineMessage:
    """A measurement and a report, machine to controller."""

    head: Head
    flags: MachineFlags
    sampled: int  # time of the measurement (of its last sample), ns
    begin: int  # time at which the run began or will begin, ns, or NEVER
    period: int  # sampling period, ns
    watchdog: int  # silence after which the safe torque acts, ns
    rate: float  # seconds of the machine's clock in a second
    torque_limit: float  # limit of each motor at the machine, N m; may be infinite
    arrived: int  # bit i of 64: whether the datagram `acknowledged` - i has arrived
    acted_from: int  # time at which the first row of `acted` began to act, ns; NEVER without rows
    acted: Array  # torques (h, 6) that acted, N m; row i acted i periods before the first
    played: int = 0  # number of periods with a torque of a plan
    dry: int = 0  # number of periods without one
    refused: int = 0  # number of refused datagrams
    # pose and rates (12,) in rad, m, rad/s, m/s, NaN for missing values; or None
    state: Array | None = None
    # encoder codes (N, 6), int32, the oldest first, MISSING for missing ones; or None
    codes: NDArray[np.int32] | None = None
    bits: int = 0  # bits of a turn of an encoder, 0 without encoders
    zeros: Array | None = None  # crank angles (6,) at code 0, rad; or None
    identity: Identity | None = None  # identity of the machine, in the answer to a request; or None
    reason: Reason = NO_FAULT  # why torques do not act
    before: Reason = NO_FAULT  # fault that preceded it; its `leg` is 0
    cranks: bool = False  # whether the rows of `acted` are setpoints of the cranks, rad

    @property
    def why(self) -> str:
        """The reason in words, with the fault that preceded it."""
        return in_words(self.reason, self.before)

    @property
    def values(self) -> Array | None:
        """State (12,), or crank angles (6 N,), rad, the oldest first; None without any."""
        if self.state is not None or self.codes is None:
            return self.state
        angles = self.zeros + 2 * np.pi / 2**self.bits * self.codes
        return np.where(self.codes == MISSING, np.nan, angles).ravel()


@dataclass(frozen=True, eq=False)
class ControllerMessage:
    """Torques for coming periods, controller to machine."""

    head: Head
    flags: ControllerFlags = NOTHING
    sampled: int = 0  # time of the sample that the torques were computed for, ns
    playout: int = 0  # time at which the first row acts, ns; each row acts for a period
    # requested begin of the run, ns, or NEVER; every datagram with torques has it
    begin: int = NEVER
    # torques (rows, 6), N m; without rows the datagram only shows presence
    torques: Array = field(default_factory=lambda: np.empty((0, NUM_TORQUES)))
    # identity of the machine that the controller is designed for, in a request
    identity: Identity | None = None
    cranks: bool = False  # whether the rows of `torques` are setpoints of the cranks, rad


Message = MachineMessage | ControllerMessage


# ---------------------------------------------------------------- writing


def encode(message: Message, key: bytes | None = None) -> bytes:
    """Return the datagram of a message, with a tag if there is a key.

    Raises:
        ValueError: a count outside its range, or more than LONGEST bytes.
        struct.error: a number that does not fit its field.
    """
    if isinstance(message, MachineMessage):
        magic, body = MAGIC_MACHINE, _machine_body(message)
    else:
        magic, body = MAGIC_CONTROLLER, _controller_body(message)
    tag = 0 if key is None else TAG
    length = _HEAD.size + len(body) + tag
    if length > LONGEST:
        raise ValueError(f"datagram: got {length} bytes; expected at most {LONGEST}")
    h = message.head
    numbers = (h.session, h.nonce, h.sequence, h.acknowledged, h.time, h.echo, h.held)
    data = _HEAD.pack(magic, VERSION, tag, length, *numbers, int(message.flags)) + body
    return data if key is None else data + _tag(data, key)


def _tag(data: bytes, key: bytes) -> bytes:
    return hmac.new(key, data, hashlib.sha256).digest()[:TAG]


def _machine_body(m: MachineMessage) -> bytes:
    _check(m.acted, "acted", MOST_HISTORY)
    kind, samples, measured = 0, 0, b""
    if m.state is not None:
        kind, samples, measured = 1, 1, np.asarray(m.state, "<f8").tobytes()
    elif m.codes is not None and m.zeros is not None:
        kind, samples = 2, len(m.codes)
        _check(m.codes, "codes", MOST_SAMPLES)
        zeros, codes = np.asarray(m.zeros, "<f8"), np.asarray(m.codes, "<i4")
        measured = zeros.tobytes() + codes.tobytes()
    elif m.identity is not None:
        kind, measured = _OFFERS, m.identity.packed
    numbers = vars(m) | {"kind": kind, "samples": samples, "history": len(m.acted)}
    numbers |= {"fault": m.reason.fault, "leg": m.reason.leg, "lasted": m.reason.lasted}
    numbers |= {"before": m.before.fault, "before_lasted": m.before.lasted}
    numbers |= {"content": _CRANKS * m.cranks}
    packed = _MACHINE.pack(*(numbers[name] for name in _MACHINE_NUMBERS))
    return packed + measured + np.asarray(m.acted, "<f8").tobytes()


def _controller_body(m: ControllerMessage) -> bytes:
    _check(m.torques, "torques", MOST_ROWS)
    content = _CRANKS * m.cranks if m.identity is None else _REQUEST
    packed = _CONTROLLER.pack(len(m.torques), content, m.sampled, m.playout, m.begin)
    if m.identity is not None:
        if len(m.torques):
            raise ValueError("torques: got some in a request; expected none")
        return packed + m.identity.packed + _PADDING
    return packed + np.asarray(m.torques, "<f8").tobytes()


def version_refusal(session: int, acknowledged: int) -> bytes:
    """Return a head alone, which states this version to a controller of another one."""
    numbers = (session, 0, 1, acknowledged, 0, 0, 0, 0)
    return _HEAD.pack(MAGIC_MACHINE, VERSION, 0, _HEAD.size, *numbers)


def _check(rows: NDArray[Any], name: str, most: int) -> None:
    if rows.ndim != 2 or rows.shape[1] != NUM_TORQUES or len(rows) > most:
        raise ValueError(f"{name}: got shape {rows.shape}; expected up to {most} rows of six")


# ---------------------------------------------------------------- reading


def decode(data: bytes, key: bytes | None = None) -> Message:
    """Return the message of a datagram.

    Checks length and magic, then the version, the tag, and only then the rest.

    Raises:
        RefusedError: malformed, version or key.
    """
    _demand(_HEAD.size <= len(data) <= LONGEST, f"{len(data)} bytes")
    magic, version, tag, length, *numbers, flags = _HEAD.unpack_from(data)
    _demand(magic in (MAGIC_MACHINE, MAGIC_CONTROLLER), f"magic {magic!r}")
    if version != VERSION:
        raise RefusedError(Refusal.VERSION, str(version))
    fits = length == len(data) and tag in (0, TAG) and length >= _HEAD.size + tag
    _demand(fits, f"{len(data)} bytes that say {length}, tag {tag}")
    _authenticate(data, tag, key)
    head, body = Head(*numbers), data[_HEAD.size : length - tag]
    _demand(head.session > 0 and head.sequence > 0, "a session or a sequence of 0")
    if magic == MAGIC_MACHINE:
        return _machine(head, flags, body)
    return _controller(head, flags, body)


def _demand(holds: bool | None, problem: str) -> None:
    if not holds:
        raise RefusedError(Refusal.MALFORMED, problem)


def _authenticate(data: bytes, tag: int, key: bytes | None) -> None:
    if (tag != 0) != (key is not None):
        raise RefusedError(Refusal.KEY, "a tag" if tag else "no tag")
    if key is not None and not hmac.compare_digest(_tag(data[:-TAG], key), data[-TAG:]):
        raise RefusedError(Refusal.KEY, "a wrong tag")


def _machine(head: Head, flags: int, body: bytes) -> MachineMessage:
    _demand(len(body) >= _MACHINE.size, "a short body")
    n = dict(zip(_MACHINE_NUMBERS, _MACHINE.unpack_from(body), strict=True))
    kind, samples, bits, history = (n[name] for name in _MACHINE_NUMBERS[:4])
    fits = {
        0: samples == 0 and bits == 0,
        1: samples == 1 and bits == 0,
        2: 1 <= samples <= MOST_SAMPLES and 1 <= bits <= MOST_BITS,
        _OFFERS: samples == 0 and bits == 0 and history == 0,
    }
    encoders = 8 * NUM_LEGS + 4 * NUM_LEGS * samples
    sizes = {0: 0, 1: 8 * NUM_STATE, 2: encoders, _OFFERS: _IDENTITY}
    plausible = 0 < n["rate"] < math.inf and n["torque_limit"] > 0 and n["period"] > 0
    plausible = plausible and n["content"] in (0, _CRANKS) and n["leg"] <= NUM_LEGS
    plausible = plausible and max(n["fault"], n["before"]) < len(Fault) and flags < 1024
    plausible = plausible and history <= MOST_HISTORY
    _demand(fits.get(kind) and plausible, "a number outside its range")
    length = _MACHINE.size + sizes[kind] + 8 * NUM_TORQUES * history
    _demand(len(body) == length, "a body of another length")
    measured = body[_MACHINE.size :]
    acted = _rows(body[_MACHINE.size + sizes[kind] :])
    state = codes = zeros = None
    if kind == 1:
        state = np.frombuffer(measured, "<f8", NUM_STATE).astype(np.float64)
    elif kind == 2:
        zeros = np.frombuffer(measured, "<f8", NUM_LEGS).astype(np.float64)
        read = np.frombuffer(measured, "<i4", NUM_LEGS * samples, 8 * NUM_LEGS)
        codes = read.astype(np.int32).reshape(samples, NUM_LEGS)
    identity = _identity(measured) if kind == _OFFERS else None
    finite = np.all(np.isfinite(acted)) and (zeros is None or np.all(np.isfinite(zeros)))
    _demand(bool(finite), "a torque or an angle that is not finite")
    own = {name: n[name] for name in n.keys() & MachineMessage.__annotations__.keys()}
    own |= {"head": head, "flags": MachineFlags(flags), "acted": acted, "state": state}
    own |= {"codes": codes, "zeros": zeros, "identity": identity, "cranks": n["content"] == _CRANKS}
    own["reason"] = Reason(Fault(n["fault"]), n["leg"], n["lasted"])
    own["before"] = Reason(Fault(n["before"]), 0, n["before_lasted"])
    return MachineMessage(**own)


def _identity(data: bytes) -> Identity:
    parts = []
    for digest, padded in _PART.iter_unpack(data[:_IDENTITY]):
        name = padded.rstrip(b"\0")
        _demand(all(0x20 <= letter <= 0x7E for letter in name), "a name that cannot be printed")
        parts.append(Part(digest, name.decode("ascii")))
    return Identity(*parts)


def _controller(head: Head, flags: int, body: bytes) -> ControllerMessage:
    _demand(len(body) >= _CONTROLLER.size, "a short body")
    rows, content, sampled, playout, begin = _CONTROLLER.unpack_from(body)
    asks, told = content == _REQUEST, body[_CONTROLLER.size :]
    plausible = rows <= MOST_ROWS and content <= _CRANKS and flags <= 3 and not any(body[2:4])
    _demand(plausible and not (asks and rows), "a number outside its range")
    if asks:
        _demand(told[_IDENTITY:] == _PADDING, "a request of another length")
        torques, identity = _rows(b""), _identity(told)
    else:
        _demand(len(told) == 8 * NUM_TORQUES * rows, "a body of another length")
        torques, identity = _rows(told), None
    _demand(bool(np.all(np.isfinite(torques))), "a torque that is not finite")
    _demand(rows == 0 or begin != NEVER, "torques for no run")
    times, cranks = (sampled, playout, begin), content == _CRANKS
    return ControllerMessage(head, ControllerFlags(flags), *times, torques, identity, cranks)


def _rows(data: bytes) -> Array:
    return np.frombuffer(data, "<f8").astype(np.float64).reshape(-1, NUM_TORQUES)
