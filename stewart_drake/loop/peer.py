"""Identity and faults of a machine and its controller (docs/protocol.md)."""

import hashlib
from enum import IntEnum
from typing import Final, NamedTuple

from stewart_drake.files.errors import ConfigError
from stewart_drake.mechanism.files import load_mechanism
from stewart_drake.mechanism.geometry import drawing_of
from stewart_drake.scenario.config import EncoderSensorConfig, Scenario, StateSensorConfig

DIGEST: Final = 8
"""Bytes of the SHA-256 of a part of an identity."""
NAME: Final = 32
"""Bytes of a part's name, padded with zeros."""
MOST_BITS: Final = 30
"""Largest number of bits of a turn in a datagram."""
MOST_SAMPLES: Final = 16
"""Largest number of samples of each encoder in a datagram."""
MOST_ROWS: Final = 24
"""Largest number of torques in a datagram."""
SECOND: Final = 10**9


class Fault(IntEnum):
    """Reason of a machine's stop.

    Attributes:
        text: for `live`, its page, `machine` and C. The number in it is the leg or s.
    """

    text: str

    def __new__(cls, number: int, text: str = "") -> "Fault":
        fault = int.__new__(cls, number)
        fault._value_, fault.text = number, text
        return fault

    NONE = 0, "no fault"
    REACH = 1, "leg {:g} reached the end of its reach"
    PITCH = 2, "the pitch passed 85 degrees"
    SINGULAR = 3, "parallel singularity: the cranks do not hold the plate"
    NOT_FINITE = 4, "the simulated state is not finite"
    LEFT = 5, "the plate left its workspace"
    SILENCE = 6, "nothing was heard from the controller for {:g} s"
    STOP = 7, "the controller said stop"
    STOOD = 8, "the machine stood still for {:.2f} s"
    ENDED = 9, "the machine was ended"
    DRIVE = 10, "a drive of the machine failed or does not answer"
    DRY = 11, "no torque or setpoint came in time for {:g} s"


class Reason(NamedTuple):
    """A fault, its leg (from 1, or 0) and its duration, ns."""

    fault: Fault = Fault.NONE
    leg: int = 0
    lasted: int = 0

    def __str__(self) -> str:
        return self.fault.text.format(self.leg or self.lasted / SECOND)


def in_words(reason: Reason, before: Reason) -> str:
    """Return a reason, and the fault before it if there was one."""
    return f"{reason} (before that, {before})" if before.fault else f"{reason}"


NO_FAULT: Final = Reason()


class Part(NamedTuple):
    """First bytes of the SHA-256 of a property, and its name."""

    digest: bytes
    name: str


class Identity(NamedTuple):
    """Properties on which a machine and its controller must agree."""

    mechanism: Part
    period: Part
    sensor: Part
    actuator: Part

    @property
    def packed(self) -> bytes:
        """The 160 bytes of an identity in a datagram."""
        return b"".join(part.digest + part.name.encode("ascii").ljust(NAME, b"\0") for part in self)

    def differing(self, other: "Identity") -> tuple[str, str] | None:
        """Return the parts that differ, of this side and of the other; None if all agree."""
        pairs = zip(self._fields, self, other, strict=True)
        found = [(field, a, b) for field, a, b in pairs if a.digest != b.digest]
        if not found:
            return None
        texts = [
            ", ".join(
                f"{field} {part.name}{f' ({part.digest.hex()})' if a.name == b.name else ''}"
                for field, a, b in found
                for part in ((a, b)[side],)
            )
            for side in (0, 1)
        ]
        return texts[0], texts[1]


def identity_of(scenario: Scenario) -> Identity:
    """Return the identity of a scenario's machine as drawn.

    What `identify` found (beside `drawn` in its mechanism.yaml, and `controller.calibration`) and
    the simulated machine (`plant.mechanism`) are not part of it.
    """
    mechanism, sensor = load_mechanism(scenario.mechanism), scenario.sensor
    period, read = scenario.controller.period, str(sensor.kind)
    if sensor.kind == "encoders":
        read = f"encoders, {sensor.samples} samples, {code_bits(sensor)} bits"
    return Identity(
        Part(bytes.fromhex(drawing_of(mechanism)), mechanism.name[:NAME]),
        _part(f"period {round(period * SECOND)} ns", f"{period:g} s"),
        _part(f"sensor {read}", read),
        _part(f"actuator {scenario.actuator.kind}", scenario.actuator.kind),
    )


def check_samples(scenario: Scenario) -> None:
    """Refuse more encoder readings a period than a datagram holds."""
    samples = scenario.sensor.samples
    if samples is not None and samples > MOST_SAMPLES:
        raise ConfigError(
            f"sensor.samples: got {samples}; expected at most {MOST_SAMPLES}, which a datagram "
            "holds"
        )


def machine_identity(scenario: Scenario) -> bytes:
    """Return the 160 bytes by which a scenario's machine and its controller know each other.

    docs/protocol.md has their meaning. A machine end of your own sends them in its offer.
    """
    return identity_of(scenario).packed


def code_bits(sensor: StateSensorConfig | EncoderSensorConfig) -> int:
    """Return the bits of a turn in the codes of a datagram, 0 of a sensor without codes."""
    if sensor.kind == "state":
        return 0
    return MOST_BITS if sensor.bits is None else min(sensor.bits, MOST_BITS)


def _part(text: str, name: str) -> Part:
    return Part(hashlib.sha256(text.encode("ascii")).digest()[:DIGEST], name[:NAME])
