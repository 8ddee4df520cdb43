"""A socket for datagrams of `live.protocol`, and who is at its other end.

Without a key only the loopback interface is used. What is not acted upon is counted by its cause.
"""

import contextlib
import hashlib
import hmac
import ipaddress
import secrets
import socket
import struct
import time
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final, NamedTuple

from stewart_drake.files.errors import ConfigError
from stewart_drake.live.protocol import (
    LONGEST,
    SECOND,
    Head,
    Message,
    Refusal,
    RefusedError,
    decode,
    encode,
    version_refusal,
)

Address = tuple[str, int]

WINDOW: Final = 64
"""Datagrams by which one may be overtaken and still be told from a replay."""
AT_ONCE: Final = 256
"""Datagrams that are read before anything else is done."""
SHORTEST_KEY: Final = 16
"""Bytes."""
LONGEST_KEY: Final = 4096
"""Bytes."""
ANSWERS: Final = 50
"""Requests of unknown addresses that are answered in a second."""
ANSWERS_AT_ONCE: Final = 10
"""Of them, without a pause."""
STOOD: Final = SECOND // 5
"""ns by which a process that comes late has stood still."""


def now() -> int:
    """ns of this process's clock, which nobody sets."""
    return time.monotonic_ns()


class OtherVersion(NamedTuple):
    """A datagram of another version of the protocol, and where it came from."""

    version: int
    session: int
    sequence: int
    address: Address


class Endpoint:
    """A UDP socket that never blocks.

    Args:
        takes: the class of message that comes in; the other side's own is malformed.
        host: to listen at; a name or number of an interface.
        port: 0 is any that is free.
        key: shared with the other side; None takes loopback addresses only.

    Attributes:
        refused: datagrams that were not acted upon, by cause; who finds more of them adds them.
        refusal: the last of them, in words; empty before there is one.
        versions: other versions of the protocol that were heard, since they were last looked at.
        unsent: datagrams that the system did not take: a full buffer, no way there.

    Raises:
        ConfigError: no key beyond loopback, a key that is too short, an address that is not free.
    """

    def __init__(
        self,
        takes: type[Message],
        host: str = "127.0.0.1",
        port: int = 0,
        key: bytes | None = None,
    ) -> None:
        self._takes, self._key, self.refused, self.unsent = takes, key, Counter[Refusal](), 0
        self.refusal, self.versions = "", list[OtherVersion]()
        if key is not None and len(key) < SHORTEST_KEY:
            raise ConfigError(f"key: got {len(key)} bytes; expected at least {SHORTEST_KEY}")
        self._check_reach(host, "host")
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.setblocking(False)
        try:
            self._socket.bind((host, port))
        except (OSError, OverflowError) as error:
            self._socket.close()
            raise ConfigError(f"port: got {host}:{port} ({error}); expected a free one") from None

    def _check_reach(self, host: str, name: str) -> None:
        if self._key is None and not is_loopback(host):
            raise ConfigError(
                f"{name}: got {host} without a key; expected a loopback address, such as "
                "127.0.0.1, or a key"
            )

    @property
    def address(self) -> Address:
        """Where it listens."""
        host, port = self._socket.getsockname()
        return host, port

    def fileno(self) -> int:
        """For `select`."""
        return self._socket.fileno()

    def close(self) -> None:
        """Nothing is sent or got any more."""
        self._socket.close()

    def send(self, message: Message, to: Address) -> bool:
        """Whether it went out; what did not is counted.

        Raises:
            ConfigError: no key, and not to loopback.
        """
        self._check_reach(to[0], "machine")
        try:
            self._socket.sendto(encode(message, self._key), to)
        except OSError:
            self.unsent += 1
            return False
        return True

    def refuse(self, cause: Refusal, detail: str = "") -> None:
        """Count a datagram that is not acted upon."""
        self.refused[cause] += 1
        self.refusal = f"{cause.value}: {detail}" if detail else cause.value

    def refuse_version(self, other: "OtherVersion") -> None:
        """Say to a peer of another version which one is spoken here, in a head alone."""
        with contextlib.suppress(OSError):
            self._socket.sendto(version_refusal(other.session, other.sequence), other.address)

    def receive(self) -> Iterator[tuple[Message, Address]]:
        """What has come, at most AT_ONCE of it; the rest next time."""
        for _ in range(AT_ONCE):
            try:
                data, address = self._socket.recvfrom(LONGEST + 1)
            except BlockingIOError:
                return
            except ConnectionError:  # what was sent before found nobody
                continue
            try:
                message = decode(data, self._key)
            except RefusedError as refused:
                self.refuse(refused.cause, refused.detail)
                if refused.cause == Refusal.VERSION:
                    session, sequence = struct.unpack_from("<Q8xI", data, 8)
                    self.versions = [OtherVersion(data[4], session, sequence, address)]
                continue
            if isinstance(message, self._takes):
                yield message, address
            else:
                self.refuse(Refusal.MALFORMED, "a datagram of this side's own")


def read_key(path: Path | None) -> bytes | None:
    """Return the bytes of a key's file without line breaks at its end; None without a file.

    Raises:
        ConfigError: it cannot be read, or is too short or too long to be a key.
    """
    if path is None:
        return None
    try:
        with path.open("rb") as file:
            data = file.read(LONGEST_KEY + 1)
    except OSError as error:
        raise ConfigError(f"--key: got {str(path)!r} ({error.strerror}); expected a file") from None
    key = data.rstrip(b"\r\n")
    if not SHORTEST_KEY <= len(key) <= LONGEST_KEY:
        raise ConfigError(
            f"--key: got {str(path)!r} with {len(key)} bytes or more; expected {SHORTEST_KEY} to "
            f"{LONGEST_KEY}"
        )
    return key


def is_loopback(host: str) -> bool:
    """Whether an address or a name is of this machine alone."""
    try:
        return ipaddress.ip_address(socket.gethostbyname(host)).is_loopback
    except (OSError, UnicodeError, ValueError):
        return False


@dataclass
class Window:
    """Which sequence numbers were there already, of the last WINDOW.

    Attributes:
        newest: of them, 0 for none.
        seen: bit i is for `newest` - i.
    """

    newest: int = 0
    seen: int = 0

    def tell(self, sequence: int) -> str:
        """Return what is wrong with a number that `take` refuses."""
        return f"sequence {sequence} after {self.newest}"

    def take(self, sequence: int) -> Refusal | None:
        """Note a number; why it is refused, or None."""
        behind = self.newest - sequence
        if behind < 0:
            self.seen = (self.seen << -behind if -behind < WINDOW else 0) & (2**WINDOW - 1) | 1
            self.newest = sequence
            return None
        if behind >= WINDOW:
            return Refusal.LATE
        if self.seen >> behind & 1:
            return Refusal.REPLAYED
        self.seen |= 1 << behind
        return None


@dataclass
class Session:
    """One side's view of a session: who is there, what was sent, what has come.

    Attributes:
        number: drawn by the controller.
        address: of the other side.
        nonce: drawn by the machine; 0 where it has not offered one.
        window: of what has come.
        heard: ns of the own clock when the last one was taken, 0 for none.
    """

    number: int
    address: Address
    nonce: int = 0
    window: Window = field(default_factory=Window)
    heard: int = 0
    _sent: int = 0
    _echo: int = 0
    _got: int = 0

    @classmethod
    def drawn(cls, address: Address) -> "Session":
        """A new one of a controller's."""
        return cls(draw(), address)

    @classmethod
    def confirmed(cls, head: Head, address: Address, time: int) -> "Session":
        """Return a machine's, begun by a datagram with the nonce of an offer.

        The machine counts on from the sequences of its offers, which are those of the requests.
        """
        session = cls(head.session, address, head.nonce, _sent=head.sequence - 1)
        session.refusal(head, address, time)
        return session

    def head(self, time: int) -> Head:
        """Of the next datagram, which is sent now, in ns of the own clock."""
        self._sent += 1
        held = time - self._got if self.window.newest else 0
        return Head(
            *(self.number, self.nonce, self._sent, self.window.newest, time, self._echo, held)
        )

    def refusal(self, head: Head, address: Address, time: int) -> Refusal | None:
        """Why a datagram is not taken, or None: then it is noted, with the time of now."""
        if head.session != self.number or address != self.address:
            return Refusal.FOREIGN
        if self.nonce not in (0, head.nonce):
            return Refusal.FOREIGN
        before = self.window.newest
        refused = self.window.take(head.sequence)
        if refused is None:
            self.heard = time
            if head.sequence > before:
                self._echo, self._got = head.time, time
        return refused


def draw() -> int:
    """A number of 64 bits that nobody guesses, not 0."""
    return secrets.randbits(64) or 1


class Offers:
    """Offers of sessions, without any memory of who has asked.

    A nonce follows from the session, the address that asks and the number of sessions so far, under
    a secret that is drawn at the start. So only who got an offer knows it, and what was recorded of
    earlier sessions is worthless.

    Args:
        secret: 32 bytes; drawn if None.
    """

    def __init__(self, secret: bytes | None = None) -> None:
        self._secret = secrets.token_bytes(32) if secret is None else secret
        self._sessions, self._tokens, self._counted = 0, float(ANSWERS_AT_ONCE), 0

    def nonce(self, session: int, address: Address) -> int:
        """Return the nonce that is offered to an address for a session, not 0."""
        text = f"{session} {address[0]} {address[1]} {self._sessions}"
        digest = hmac.new(self._secret, text.encode(), hashlib.sha256).digest()
        return int.from_bytes(digest[:8], "little") or 1

    def taken(self) -> None:
        """Withdraw all offers: a session has begun."""
        self._sessions += 1

    def may_answer(self, time: int) -> bool:
        """Whether an unknown address is answered at ns of the own clock; then it counts."""
        grown = self._tokens + (time - self._counted) * ANSWERS / SECOND
        self._tokens, self._counted = min(float(ANSWERS_AT_ONCE), grown), time
        if self._tokens < 1:
            return False
        self._tokens -= 1
        return True
