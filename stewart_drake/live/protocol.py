"""The datagrams between a machine and its controller: contents, and their bytes by core/protocol.h.

docs/protocol.md defines every byte; an export has the same C. Times are whole nanoseconds of the
*machine's* clock, which starts with the machine. Exceptions are `time`, of the sender's clock, and
`echo`, of the receiver's.
"""

from dataclasses import dataclass, field
from enum import Enum, IntFlag
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from stewart_drake.core.library import core
from stewart_drake.loop.peer import (
    MOST_ROWS,
    MOST_SAMPLES,
    NO_FAULT,
    Fault,
    Identity,
    Part,
    Reason,
    in_words,
)
from stewart_drake.scenario.signals import NUM_TORQUES
from stewart_drake.types import Array

VERSION: Final = 3
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

_HEAD: Final = ("session", "nonce", "sequence", "acknowledged", "time", "echo", "held")
_MACHINE: Final = (
    *("bits", "sampled", "begin", "period", "watchdog", "rate", "torque_limit", "arrived"),
    *("acted_from", "played", "dry", "refused"),
)
"""Numbers that have the same name in a message and in core/protocol.h."""


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


REFUSALS: Final = (None, *Refusal)
"""By the number in C."""


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


# ---------------------------------------------------------------- bytes


def encode(message: Message, key: bytes | None = None) -> bytes:
    """Return the datagram of a message, with a tag if there is a key.

    Raises:
        ValueError: a count outside its range.
        OverflowError: a number that does not fit its field.
    """
    c = core()
    if isinstance(message, MachineMessage):
        kind, fields = "measured", _of_machine(message)
    else:
        kind, fields = "plan", _of_controller(message)
    fields["head"] = vars(message.head) | {"flags": int(message.flags)}
    if message.identity is not None:
        parts = [(list(one.digest), one.name.encode("ascii")) for one in message.identity]
        fields["identity"] = {"parts": parts}
    data, given = c.ffi.new("uint8_t[]", LONGEST), c.ffi.new(f"stewart_{kind} *", fields)
    secret, _kept = _key(key)
    size = getattr(c.lib, f"stewart_write_{kind}")(given, secret, data)
    return bytes(c.ffi.buffer(data, size))


def _key(key: bytes | None) -> tuple[Any, object]:
    """Return a `stewart_key`, and the memory that it uses."""
    c = core()
    kept = c.ffi.from_buffer(key or b"")
    return c.ffi.new("stewart_key *", (kept, len(kept)))[0], kept


def _of_machine(m: MachineMessage) -> dict[str, Any]:
    lib, fields = core().lib, {name: getattr(m, name) for name in _MACHINE}
    content = lib.STEWART_CRANKS if m.cranks else lib.STEWART_TORQUES
    acted = _rows(m.acted, "acted", MOST_HISTORY)
    fields |= {"acted": acted, "history": len(acted), "content": content}
    fields |= {"reason": m.reason, "before": m.before}
    if m.state is not None:
        fields |= {"kind": lib.STEWART_STATE, "samples": 1, "state": m.state.tolist()}
    elif m.codes is not None and m.zeros is not None:
        codes = _rows(m.codes, "codes", MOST_SAMPLES)
        fields |= {"kind": lib.STEWART_ENCODERS, "samples": len(codes), "codes": codes}
        fields["zeros"] = m.zeros.tolist()
    elif m.identity is not None:
        fields["kind"] = lib.STEWART_OFFER
    return fields


def _of_controller(m: ControllerMessage) -> dict[str, Any]:
    lib, rows = core().lib, _rows(m.torques, "torques", MOST_ROWS)
    content = lib.STEWART_CRANKS if m.cranks else lib.STEWART_TORQUES
    if m.identity is not None:
        content = lib.STEWART_REQUEST
        if rows:
            raise ValueError("torques: got some in a request; expected none")
    times = {name: getattr(m, name) for name in ("sampled", "playout", "begin")}
    return times | {"rows": len(rows), "content": content, "torques": rows}


def _rows(rows: NDArray[Any], name: str, most: int) -> list[Any]:
    if rows.ndim != 2 or rows.shape[1] != NUM_TORQUES or len(rows) > most:
        raise ValueError(f"{name}: got shape {rows.shape}; expected up to {most} rows of six")
    found: list[Any] = rows.tolist()
    return found


def decode(data: bytes, key: bytes | None = None) -> Message:
    """Return the message of a datagram.

    Checks length and magic, then the version, the tag, and only then the rest.

    Raises:
        RefusedError: malformed, version or key.
    """
    c = core()
    is_machine, (secret, _kept) = data[:4] == b"STWM", _key(key)
    kind = "measured" if is_machine else "plan"
    read = c.ffi.new(f"stewart_{kind} *")
    given = c.ffi.from_buffer("uint8_t[]", data)
    if cause := getattr(c.lib, f"stewart_read_{kind}")(given, len(data), secret, read):
        refusal = REFUSALS[cause]
        version = refusal == Refusal.VERSION
        raise RefusedError(refusal, str(data[4]) if version else f"{len(data)} bytes")
    head = head_of(read.head)
    return _machine(head, read) if is_machine else _controller(head, read)


def version_refusal(data: bytes) -> bytes:
    """Return a head alone, which states this version to a controller of another one."""
    c, answer = core(), core().ffi.new("uint8_t[]", LONGEST)
    size = c.lib.stewart_write_version(c.ffi.from_buffer("uint8_t[]", data), answer)
    return bytes(c.ffi.buffer(answer, size))


def head_of(read: Any) -> Head:
    """Return a head from that in C."""
    return Head(*(getattr(read, name) for name in _HEAD))


def in_c(head: Head) -> Any:
    """Return a `stewart_head *`."""
    return core().ffi.new("stewart_head *", vars(head))


def _machine(head: Head, read: Any) -> MachineMessage:
    lib, reason, before = core().lib, read.reason, read.before
    codes = _array(read.codes, np.int32)[: read.samples]
    is_state, is_codes = read.kind == lib.STEWART_STATE, read.kind == lib.STEWART_ENCODERS
    return MachineMessage(
        head,
        MachineFlags(read.head.flags),
        **{name: getattr(read, name) for name in _MACHINE},
        acted=_array(read.acted)[: read.history],
        state=_array(read.state) if is_state else None,
        codes=codes if is_codes else None,
        zeros=_array(read.zeros) if is_codes else None,
        identity=_identity(read.identity) if read.kind == lib.STEWART_OFFER else None,
        reason=Reason(Fault(reason.fault), reason.leg, reason.lasted),
        before=Reason(Fault(before.fault), 0, before.lasted),
        cranks=read.content == lib.STEWART_CRANKS,
    )


def _controller(head: Head, read: Any) -> ControllerMessage:
    lib, flags = core().lib, ControllerFlags(read.head.flags)
    torques = _array(read.torques)[: read.rows]
    identity = _identity(read.identity) if read.content == lib.STEWART_REQUEST else None
    times, cranks = (read.sampled, read.playout, read.begin), read.content == lib.STEWART_CRANKS
    return ControllerMessage(head, flags, *times, torques, identity, cranks)


def _array(values: Any, kind: Any = np.float64) -> NDArray[Any]:
    """Return a copy of an array of numbers (n,), or of rows (n, 6)."""
    ffi = core().ffi
    found = np.frombuffer(ffi.buffer(values), kind).copy()
    return found if ffi.typeof(values).item.kind == "primitive" else found.reshape(-1, NUM_TORQUES)


def _identity(read: Any) -> Identity:
    ffi = core().ffi
    parts = ((ffi.buffer(one.digest)[:], ffi.string(one.name).decode()) for one in read.parts)
    return Identity(*(Part(digest, name) for digest, name in parts))
