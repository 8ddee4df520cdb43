"""Faults of the sensor, as a scenario lists them under `sensor.faults`."""

from collections.abc import Sequence
from typing import Annotated, Any, Final, Literal, NotRequired

from pydantic import ConfigDict, Field, with_config
from typing_extensions import TypedDict  # which pydantic wants before Python 3.12

from stewart_drake.files.yamlio import brief

Instant = Annotated[float, Field(ge=0, le=1e5)]

# A plain mapping and no dataclass, because `from` is no name in Python.
SensorFault = TypedDict(
    "SensorFault",
    {
        "kind": Literal["frozen", "missing", "spike"],
        "leg": NotRequired[Annotated[int, Field(ge=1, le=6)] | None],
        "from": Instant,
        "to": Instant,
        "size": NotRequired[Annotated[float, Field(gt=0, le=1e6)] | None],
        "share": NotRequired[Annotated[float, Field(gt=0, le=1)] | None],
    },
)
"""One fault, from `from` up to but not at `to`, in s.

`frozen` repeats what was measured last before it, `missing` measures nothing, and `spike` is off by
`size` (SPIKE where it is left out) times the motion of each coordinate or crank, times a number
drawn anew at every sample from the standard normal distribution. `leg` is for encoders; null is all
six. A `missing` or a `spike` with a `share` strikes that share of the samples, drawn for each, and
for each leg, by itself.
"""

with_config(ConfigDict(extra="forbid", strict=True, allow_inf_nan=False))(SensorFault)

SPIKE: Final = 10.0


def fault_problem(faults: Sequence[Any], legs: bool) -> str | None:
    """What is wrong with faults that are well formed one by one, or None.

    Args:
        faults: of a sensor.
        legs: whether it has legs.
    """
    for i, fault in enumerate(faults):
        field = f"sensor.faults[{i}]"
        if not fault["from"] < fault["to"]:
            return (
                f"{field}.to: got {fault['to']:g} s; expected more than from, {fault['from']:g} s"
            )
        if not legs and fault.get("leg") is not None:
            return (
                f"{field}.leg: got {fault['leg']}; expected null: what is measured are pose and "
                "rates of the plate, not its legs"
            )
        if fault.get("size") is not None and fault["kind"] != "spike":
            return (
                f"{field}.size: got {brief(fault['size'])} with kind {fault['kind']!r}; expected a "
                "size with kind 'spike' only"
            )
        if fault.get("share") is not None and fault["kind"] == "frozen":
            return (
                f"{field}.share: got {brief(fault['share'])} with kind 'frozen'; expected a share "
                "with kind 'missing' or 'spike' only"
            )
    return None
