"""How far each quantity of `analyze robustness` may be off; nothing heavy is imported here."""

import dataclasses
from collections.abc import Iterable
from typing import Annotated, Final

from pydantic import ConfigDict, Field
from pydantic.dataclasses import dataclass

from stewart_drake.files.errors import ConfigError
from stewart_drake.files.yamlio import units_of, validate_pairs

_Positive = Annotated[float, Field(gt=0)]


@dataclass(config=ConfigDict(extra="forbid", strict=True, allow_inf_nan=False))
class Ranges:
    """How far each quantity may be off; 0 (null for `torque_limit`) leaves it alone.

    The controller is told the torque limit and the sensor's noise, and nothing else. What the
    numbers are shares of stands beside them, and in `RANGE_UNITS`.

    Attributes:
        payload: a mass at the plate's centre of mass, uniform in +-.
        torque_bias: rms over the motors, uniform from 0; its direction in the space of the six
            motors is random.
        noise: standard deviation of the measured pose (rates: per second), uniform from 0.
        torque_limit: of the motors, least and most, uniform; what limits the undisturbed run, the
            scenario's number or the mechanism's motors, is never exceeded.
        damping: friction torque of a crank, uniform from 0.
        delay: true delay less the believed one, uniform in +-; over a wire.
        delay_steps: the same, each number in +- alike; adds to `delay`.
        lengths: error of crank and rod lengths, rms over the twelve, uniform from 0.
        anchors: error of the coordinates of motor shafts and plate joints, rms over the 36,
            uniform from 0.
        coulomb: Coulomb friction of a crank, uniform from 0.
        payload_position: error of the coordinates of the payload's place, rms over the three,
            uniform from 0; it matters where there is a payload.
        jitter: standard deviation of the delay from torque to torque, uniform from 0; over a wire.
        loss: share of the measurements that are lost, uniform from 0; over a network of packets.
    """

    payload: Annotated[float, Field(ge=0, lt=1, description="+-share of the plate's mass")] = 0.1
    torque_bias: Annotated[
        float, Field(ge=0, description="share of the reference's largest torque")
    ] = 0.02
    noise: Annotated[
        float, Field(ge=0, description="share of half the reference's peak to peak")
    ] = 1e-3
    torque_limit: Annotated[
        Annotated[list[_Positive], Field(min_length=2, max_length=2)] | None,
        Field(description="[least, most] in peak torques of the undisturbed run"),
    ] = dataclasses.field(default_factory=lambda: [1.0, 3.0])
    damping: Annotated[
        float,
        Field(
            ge=0, description="share of the reference's largest torque, at its largest crank speed"
        ),
    ] = 0.02
    delay: Annotated[float, Field(ge=0, le=100, description="+-periods of the controller")] = 0.01
    delay_steps: Annotated[int, Field(ge=0, le=100, description="+-whole periods")] = 0
    lengths: Annotated[float, Field(ge=0, lt=1, description="share of the mean crank length")] = (
        2e-4
    )
    anchors: Annotated[float, Field(ge=0, lt=1, description="share of the mean crank length")] = (
        2e-4
    )
    coulomb: Annotated[
        float, Field(ge=0, description="share of the reference's largest torque")
    ] = 0.0
    payload_position: Annotated[
        float, Field(ge=0, description="share of the mean crank length")
    ] = 0.0
    jitter: Annotated[float, Field(ge=0, le=1, description="periods of the controller")] = 0.0
    loss: Annotated[
        float, Field(ge=0, lt=0.99, description="share of measurements, of packets over a network")
    ] = 0.0


RANGE_UNITS: Final = units_of(Ranges)
"""By name of a field of `Ranges`, what its numbers are shares of."""


def read_ranges(settings: Iterable[str]) -> Ranges:
    """Ranges from `name=value` settings, the value in YAML; the rest keeps its default.

    Raises:
        ConfigError: in one line.
    """
    ranges = validate_pairs(Ranges, settings, "--vary", RANGE_UNITS)
    limit = ranges.torque_limit
    if limit is not None and limit[0] > limit[1]:
        raise ConfigError(
            f"--vary: torque_limit: got {limit!r}; expected the lesser one first"
            f" (torque_limit: {RANGE_UNITS['torque_limit']})"
        )
    return ranges
