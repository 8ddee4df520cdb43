"""Finding a machine, and finding out what is between it and here; nothing moves by it."""

import contextlib
import socket
from typing import Final

from stewart_drake.files.errors import ConfigError
from stewart_drake.live.contact import Contact
from stewart_drake.live.endpoint import Address, Endpoint, is_loopback, now
from stewart_drake.live.protocol import SECOND, MachineFlags, MachineMessage

_CALLS: Final = SECOND // 50
"""ns between two datagrams that ask for a session."""
_PATIENCE: Final = 5.0
"""s for which an answer is waited for."""
_TRIPS: Final = 100
"""Round trips from which the link is known well enough to begin."""
_LONGEST: Final = 5.0
"""s that they are waited for."""


def address_of(text: str) -> Address:
    """HOST:PORT.

    Raises:
        ConfigError: one line.
    """
    host, _, port = text.rpartition(":")
    if not host or not port.isdecimal() or not 0 < int(port) < 65536:
        raise ConfigError(f"--machine: got {text!r}; expected HOST:PORT, such as 127.0.0.1:7000")
    with contextlib.suppress(OSError, UnicodeError):
        return socket.gethostbyname(host), int(port)
    raise ConfigError(f"--machine: got {text!r}; expected a host that is known")


def open_endpoint(address: Address, key: bytes | None) -> Endpoint:
    """A socket for a controller of the machine at an address.

    Raises:
        ConfigError: beyond loopback without a key.
    """
    if key is None and not is_loopback(address[0]):
        raise ConfigError(
            f"--machine: got {address[0]} without a key; expected a loopback address, or --key FILE"
        )
    host = "127.0.0.1" if is_loopback(address[0]) else "0.0.0.0"
    return Endpoint(MachineMessage, host, 0, key)


def call(contact: Contact) -> MachineMessage:
    """Ask for a session until the machine offers one and the link is known.

    Args:
        contact: without a session.

    Returns:
        What the machine last said of itself.

    Raises:
        ConfigError: nobody answers.
    """
    began, first = now(), 0
    while True:
        came = _ask(contact)
        first = first or (now() if came else 0)
        if not first and now() - began > _PATIENCE * SECOND:
            host, port = contact.session.address
            raise ConfigError(
                f"--machine: got {host}:{port}, where nothing answers{_why(contact)}; expected a "
                "machine, such as stewart-drake machine SCENARIO --port PORT"
            )
        enough = len(contact.link.trips) >= _TRIPS or now() - first > _LONGEST * SECOND
        if first and enough and contact.last is not None:
            return contact.last


def await_free(contact: Contact) -> None:
    """Wait until nobody else drives the machine, and its offer is a new one.

    Raises:
        ConfigError: another controller goes on driving it.
    """
    contact.forget_waiting()
    began, last = now(), contact.last
    assert last is not None
    patience = max(_PATIENCE * SECOND, 2 * last.watchdog)
    while True:
        if _ask(contact) and MachineFlags.BUSY not in (contact.last or last).flags:
            return
        if now() - began > patience:
            raise ConfigError(
                "--machine: got one that another controller drives, or that is gone; expected a "
                f"free one, as it is {last.watchdog / SECOND:g} s after the last word of that one"
            )


def _ask(contact: Contact) -> bool:
    """Ask once; whether something came before it is time to ask again."""
    contact.send()
    until, came = now() + _CALLS, False
    while now() < until:
        for _ in contact.wait(until):
            came = True
    return came


def _why(contact: Contact) -> str:
    refused = ", ".join(f"{n} of cause {cause}" for cause, n in contact.refused.items())
    return f" that could be taken ({refused} refused)" if refused else ""
