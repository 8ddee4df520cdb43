"""A socket for datagrams of `live.protocol`, and the sessions over it.

Without a key only the loopback interface is used. Refused datagrams are counted by their cause.
"""

import contextlib
import ipaddress
import secrets
import socket
import time
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Final, Generic, NamedTuple, TypeVar

from stewart_drake.core.library import core
from stewart_drake.files.errors import ConfigError
from stewart_drake.live.protocol import (
    LONGEST,
    REFUSALS,
    SECOND,
    ControllerMessage,
    Head,
    MachineMessage,
    Message,
    Refusal,
    RefusedError,
    decode,
    encode,
    head_of,
    in_c,
    version_refusal,
)

Address = tuple[str, int]
Taken = TypeVar("Taken", MachineMessage, ControllerMessage)

AT_ONCE: Final = 256
"""Largest number of datagrams that are read at once."""
SHORTEST_KEY: Final = 16
"""Shortest key, bytes."""
LONGEST_KEY: Final = 4096
"""Longest key, bytes."""
STALL: Final = SECOND // 5
"""Delay of a process from which on it is reported as a stall, ns."""


def now() -> int:
    """Return this process's monotonic clock, ns."""
    return time.monotonic_ns()


class OtherVersion(NamedTuple):
    data: bytes
    address: Address  # of its sender

    @property
    def version(self) -> int:
        return self.data[4]

    @property
    def session(self) -> int:
        return int.from_bytes(self.data[8:16], "little")


class Endpoint(Generic[Taken]):
    """A UDP socket that never blocks, for messages of one side; any others are malformed.

    Port 0 is any free one. Without a key only loopback addresses are allowed.

    Attributes:
        refused: number of refused datagrams by cause.
        refusal: cause of the last one in words; empty before the first.
        versions: datagrams of other versions of the protocol; the reader empties it.
        unsent: number of datagrams that the system did not send.

    Raises:
        ConfigError: no key beyond loopback, a key that is too short, or an address in use.
    """

    def __init__(
        self,
        takes: type[Taken],
        host: str = "127.0.0.1",
        port: int = 0,
        key: bytes | None = None,
    ) -> None:
        self._takes: type[Taken] = takes
        self._key, self.refused, self.unsent = key, Counter[Refusal](), 0
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
        host, port = self._socket.getsockname()
        return host, port

    def fileno(self) -> int:
        return self._socket.fileno()

    def close(self) -> None:
        self._socket.close()

    def send(self, message: Message, to: Address) -> bool:
        """Send a message; return whether the system took it."""
        self._check_reach(to[0], "machine")
        try:
            self._socket.sendto(encode(message, self._key), to)
        except OSError:
            self.unsent += 1
            return False
        return True

    def refuse(self, cause: Refusal, detail: str = "") -> None:
        self.refused[cause] += 1
        self.refusal = f"{cause.value}: {detail}" if detail else cause.value

    def refuse_version(self, other: "OtherVersion") -> None:
        """Send this side's version to a peer of another one, in a head alone."""
        with contextlib.suppress(OSError):
            self._socket.sendto(version_refusal(other.data), other.address)

    def receive(self) -> Iterator[tuple[Taken, Address]]:
        """Yield what has come, at most AT_ONCE datagrams."""
        for _ in range(AT_ONCE):
            try:
                data, address = self._socket.recvfrom(LONGEST + 1)
            except BlockingIOError:
                return
            except ConnectionError:  # the address of an earlier datagram has no listener
                continue
            try:
                message = decode(data, self._key)
            except RefusedError as refused:
                self.refuse(refused.cause, refused.detail)
                if refused.cause == Refusal.VERSION:
                    self.versions = [OtherVersion(data, address)]
                continue
            if isinstance(message, self._takes):
                yield message, address
            else:
                self.refuse(Refusal.MALFORMED, "a datagram of this side's own")


def read_key(path: Path | None) -> bytes | None:
    """Return the key in a file, without line breaks at its end; None without a file."""
    if path is None:
        return None
    try:
        with path.open("rb") as file:
            data = file.read(LONGEST_KEY + 1)
    except OSError as error:
        raise ConfigError(f"--key: got {str(path)!r} ({error.strerror}); expected a file") from None
    key = data.rstrip(b"\r\n")
    if not SHORTEST_KEY <= len(key) <= LONGEST_KEY:
        size = f"more than {LONGEST_KEY}" if len(key) > LONGEST_KEY else len(key)
        raise ConfigError(
            f"--key: got {str(path)!r} with {size} bytes; expected {SHORTEST_KEY} to {LONGEST_KEY}"
        )
    return key


def is_loopback(host: str) -> bool:
    try:
        return ipaddress.ip_address(socket.gethostbyname(host)).is_loopback
    except (OSError, UnicodeError, ValueError):
        return False


class Session:
    """One side's view of a session, by `stewart_session` of core/protocol.h.

    Attributes:
        address: of the other side.
        nonce: random number of the machine; 0 before its offer.
        window: sequence numbers that have come: the `newest`, 0 for none, and in bit i of `seen`
            whether `newest` - i has come.
        heard: own clock when the last datagram was accepted, ns; 0 for none.
    """

    def __init__(self, number: int, address: Address, nonce: int = 0) -> None:
        self.address = address
        self._c: Any = core().ffi.new("stewart_session *", {"number": number, "nonce": nonce})

    number = property(lambda self: self._c.number)  # random number of the controller
    window = property(lambda self: self._c.window)
    heard = property(lambda self: self._c.heard)

    @property
    def nonce(self) -> int:
        return int(self._c.nonce)

    @nonce.setter
    def nonce(self, nonce: int) -> None:
        self._c.nonce = nonce

    @classmethod
    def drawn(cls, address: Address) -> "Session":
        """Return a new session of a controller."""
        return cls(secrets.randbits(64) or 1, address)

    @classmethod
    def confirmed(cls, head: Head, address: Address, time: int) -> "Session":
        """Return a session of a machine, begun by a datagram with the nonce of its offer.

        Its sequences continue those of the offers, which repeat the requests'.
        """
        session = cls(head.session, address, head.nonce)
        session._c[0] = core().lib.stewart_confirmed(in_c(head), time)
        return session

    def head(self, time: int) -> Head:
        """Return the head of the next datagram, sent at `time`, ns of the own clock."""
        return head_of(core().lib.stewart_next(self._c, time, 0))

    def refusal(self, head: Head, address: Address, time: int) -> Refusal | None:
        """Accept a datagram that came at `time`, ns of the own clock; return why not, or None."""
        if address != self.address:
            return Refusal.FOREIGN
        return REFUSALS[core().lib.stewart_note(self._c, in_c(head), time)]


class Offers:
    """Offers of sessions, without state per request, by `stewart_offers` of core/protocol.h.

    A nonce is an HMAC of the session, its address and the number of sessions so far, under a secret
    of this process. Only the receiver of an offer knows it, and recorded sessions cannot be
    replayed. The secret has 32 bytes, random ones by default.
    """

    def __init__(self, secret: bytes | None = None) -> None:
        drawn = list(secret or secrets.token_bytes(32))
        start = {"secret": drawn, "tokens": core().lib.STEWART_AT_ONCE}
        self._c: Any = core().ffi.new("stewart_offers *", start)

    def nonce(self, session: int, address: Address) -> int:
        """Return the nonce for a session and an address, not 0."""
        host = int(ipaddress.IPv4Address(address[0]))
        return int(core().lib.stewart_nonce(self._c, session, host, address[1]))

    def taken(self) -> None:
        """Withdraw all offers, because a session has begun."""
        self._c.sessions += 1

    def may_answer(self, time: int) -> bool:
        """Take an answer to an unknown address from the allowance; return whether there is one."""
        return bool(core().lib.stewart_may_answer(self._c, time))
