"""Finding a machine, and finding out what is between it and here; nothing moves by it."""

import contextlib
import socket
from typing import Final

from stewart_drake.files.errors import ConfigError
from stewart_drake.live.contact import Contact
from stewart_drake.live.endpoint import Address, Endpoint, is_loopback, now
from stewart_drake.live.protocol import SECOND, VERSION, MachineFlags, MachineMessage

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
        ConfigError: nothing answers, or a machine that the controller is not designed for.
    """
    began, first, where = now(), 0, _where(contact)
    while True:
        came = _ask(contact)
        _check_identity(contact)
        first = first or (now() if came else 0)
        for other in contact.endpoint.versions:
            if other.address == contact.session.address:
                raise ConfigError(
                    f"--machine: {where} speaks protocol version {other.version}; expected "
                    f"{VERSION}, of the same release on both sides"
                )
        if not first and now() - began > _PATIENCE * SECOND:
            raise ConfigError(
                f"--machine: got {where.removeprefix('machine at ')}, where nothing "
                f"answers{_why(contact)}; expected a machine of protocol version {VERSION}, such "
                "as stewart-drake machine SCENARIO --port PORT"
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
            _check_identity(contact)
            return
        if now() - began > patience:
            raise ConfigError(_not_free(contact, patience / SECOND))


def _not_free(contact: Contact, patience: float) -> str:
    """Say why a machine that has answered offers no session any more."""
    last, where = contact.last, _where(contact)
    assert last is not None
    silent = (now() - contact.heard) / SECOND
    if silent < patience:
        return (
            f"{where} is in use by another controller (retry {last.watchdog / SECOND:g} s after it "
            "stops)"
        )
    if contact.endpoint.refusal:
        return (
            f"{where} sent nothing for {silent:.1f} s{_why(contact)}; the last was "
            f"{contact.endpoint.refusal}"
        )
    return f"{where} was silent for {silent:.1f} s"


def _check_identity(contact: Contact) -> None:
    """Refuse a machine that the controller is not designed for.

    Raises:
        ConfigError: naming what differs, on both sides.
    """
    last = contact.last
    if last is None or last.identity is None:
        return
    differs = last.identity.differing(contact.identity)
    if differs is not None:
        raise ConfigError(
            f"{_where(contact)} has {differs[0]}; the controller is designed for {differs[1]}"
        )


def _where(contact: Contact) -> str:
    host, port = contact.session.address
    return f"machine at {host}:{port}"


def _ask(contact: Contact) -> bool:
    """Ask once; whether something came before it is time to ask again."""
    contact.ask()
    until, came = now() + _CALLS, False
    while now() < until:
        for _ in contact.wait(until):
            came = True
    return came


def _why(contact: Contact) -> str:
    refused = ", ".join(f"{n} of cause {cause}" for cause, n in contact.refused.items())
    return f" that could be taken ({refused} refused)" if refused else ""
