"""The worked exchange of docs/protocol.md: `python -m tests.exchange` prints its blocks.

A machine of the scenario `paper` with a fixed secret answers a controller at 127.0.0.1:50000.
"""

from dataclasses import replace
from typing import Any, Final

import numpy as np

from stewart_drake.live.endpoint import Offers
from stewart_drake.live.machine import Machine
from stewart_drake.live.protocol import (
    NEVER,
    NOTHING,
    SECOND,
    ControllerMessage,
    Head,
    Message,
    encode,
)
from stewart_drake.loop.peer import identity_of
from stewart_drake.loop.preparation import prepare
from stewart_drake.scenario.loading import load_scenario
from tests.live_driver import Clock, Wire

SESSION: Final = 0x1122334455667788
MILLISECOND: Final = 10**6
NAMES: Final = ("request", "offer", "confirmation", "measurement", "torques")


def exchange() -> list[Message]:
    """Return the datagrams from a request for a session to the first torques."""
    scenario = load_scenario("paper", settings=("plant.kind=exact",))
    wire, clock = Wire(), Clock()
    machine: Any = Machine(prepare(scenario), wire, say=lambda line: None, clock=clock)  # type: ignore[arg-type]
    machine.offers = Offers(bytes(range(32)))
    zero, found = clock.time, list[Message]()

    def says(message: ControllerMessage, milliseconds: int, answer_at: int | None = None) -> None:
        """Deliver a datagram; return the machine's next ones."""
        time = milliseconds * MILLISECOND
        clock.time = zero + time
        machine.advance(time)
        wire.said.clear()
        machine._arrive(message, ("127.0.0.1", 50000), time)
        found.append(message)
        if answer_at is not None:
            clock.time = zero + answer_at * MILLISECOND
            machine.advance(clock.time - zero)
            found.append(wire.said[0])

    asked = Head(SESSION, 0, 1, 0, 5 * SECOND, 0, 0)
    says(ControllerMessage(asked, identity=identity_of(scenario)), 2030, 2030)
    offer = found[-1].head
    confirmed = replace(
        asked,
        nonce=offer.nonce,
        sequence=2,
        acknowledged=offer.sequence,
        time=5 * SECOND + 20 * MILLISECOND,
        echo=offer.time,
        held=15 * MILLISECOND,
    )
    says(ControllerMessage(confirmed, begin=3 * SECOND), 2050, 2100)
    clock.time = zero + 3 * SECOND
    machine.advance(3 * SECOND)
    measured = wire.said[-1].head
    head = replace(
        confirmed,
        sequence=3,
        acknowledged=measured.sequence,
        time=5 * SECOND + 990 * MILLISECOND,
        echo=measured.time,
        held=5 * MILLISECOND,
    )
    torques, times = np.array([[0.5, -0.25, 0, 1, -1, 2]]), (3 * SECOND, 3800 * MILLISECOND)
    plan = ControllerMessage(head, NOTHING, *times, begin=3 * SECOND, torques=torques)
    says(plan, 3010)
    assert machine.begin == 3 * SECOND != NEVER and not wire.refused
    return found


def block(data: bytes) -> str:
    """Lines of 48 bytes."""
    text = data.hex()
    return "\n".join(text[i : i + 96] for i in range(0, len(text), 96))


def main() -> None:
    for name, message in zip(NAMES, exchange(), strict=True):
        print(f"*{name}*\n\n```text\n{block(encode(message))}\n```\n")


if __name__ == "__main__":
    main()
