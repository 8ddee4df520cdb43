"""Section `link` of a scenario, the link between controller and motors, by kind."""

from typing import Annotated, Final, Literal

from pydantic import Field

from stewart_drake.files.schema import ByKind
from stewart_drake.scenario.field_types import Loss, Positive, Seconds, Seed, section

ASSUMED_TIMES: Final = (0.8, 1.2)
"""Shortest and longest transit time, in delays, of a network without `low` and `high`."""


@section
class WireConfig:
    """A link that delays every torque by `delay`, and loses none."""

    # Without annotations these are constants, not fields.
    back, burst, acknowledged, follows_delay = None, 1, True, False
    kind: Literal["wire"] = "wire"


@section
class PacketsConfig:
    """Transit times and losses of packets.

    Attributes:
        distribution: of the transit time, `uniform` from `low` to `high`, or `lognormal`.
        low, high: bounds of the uniform distribution, s; null otherwise.
        median: of the lognormal distribution, s; null otherwise.
        sigma: standard deviation of the logarithm, of the lognormal one; null otherwise.
        loss: share of the packets that never arrive.
        burst: number of packets in a row that are lost together.
    """

    distribution: Literal["uniform", "lognormal"] = "uniform"
    low: Seconds | None = None
    high: Seconds | None = None
    median: Positive | None = None
    sigma: Annotated[float, Field(gt=0, le=10)] | None = None
    loss: Loss = 0.05
    burst: Annotated[int, Field(ge=1, le=1000)] = 1

    def problem(self, where: str) -> str | None:
        """Return the message of the first broken rule between fields, or None."""
        used = ("low", "high") if self.distribution == "uniform" else ("median", "sigma")
        for name in ("low", "high", "median", "sigma"):
            value = getattr(self, name)
            if (value is None) == (name in used):
                got, expected = ("null", "a number") if name in used else (f"{value:g}", "null")
                found = f"got {got} with distribution {self.distribution!r}"
                return f"{where}.{name}: {found}; expected {expected}"
        if self.low is not None and self.high is not None and self.low > self.high:
            return f"{where}.low: got {self.low:g} s; expected at most high, {self.high:g} s"
        return None


@section
class NetworkConfig(PacketsConfig):
    """Packets of torques and the times at which these act, and a play-out buffer at the machine.

    A torque acts a fixed time after it was sent, the play-out bound. The buffer is dry in a period
    for which no packet has brought a torque. The clocks of controller and machine agree. Without
    `low` and `high`, a uniform transit time is 0.8 to 1.2 times the constant delay of the section
    `delay`; `Scenario.assumed_link` has the numbers.

    Attributes:
        playout: play-out bound, s; null makes late packets as rare as lost ones
            (`scenario.packets.default_bound`). The controller adds its `packet_repeats` periods.
        dry: output of a dry buffer, `hold` the last torque or `zero`.
        back: `return` in files, transit times and losses of the measurements; null: every one
            arrives, without delay.
        acknowledged: whether each measurement reports the packets that have arrived and the
            torques that have acted.
        seed: of times and losses.
    """

    kind: Literal["network"] = "network"
    playout: Seconds | None = None
    dry: Literal["hold", "zero"] = "hold"
    back: PacketsConfig | None = Field(default=None, alias="return")
    acknowledged: bool = True
    seed: Seed = 0

    @property
    def follows_delay(self) -> bool:
        """Whether the transit times follow from the scenario's delay."""
        return self.distribution == "uniform" and self.low is None and self.high is None


LinkConfig = Annotated[WireConfig | NetworkConfig, ByKind()]
