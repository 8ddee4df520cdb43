"""Types of the scenario's fields, each with its range; shared by the sections."""

import dataclasses
import inspect
from typing import (
    Annotated,
    Any,
    Final,
    Literal,
    NotRequired,
    TypeVar,
    dataclass_transform,
    get_type_hints,
)

import pydantic
from pydantic import AfterValidator, ConfigDict, Field, with_config
from typing_extensions import TypedDict  # which pydantic wants before Python 3.12

from stewart_drake.files.yamlio import exactly, in_one_line, one_message, rule
from stewart_drake.scenario.timing import LEAST_FRACTION

_T = TypeVar("_T")
STRICT: Final = ConfigDict(extra="forbid", strict=True, allow_inf_nan=False)
"""Configuration of data in files: nothing is guessed."""


@dataclass_transform(field_specifiers=(dataclasses.field, Field))
def section(cls: type[_T]) -> type[_T]:
    """Return a strict dataclass; a wrong argument or assignment raises ConfigError."""
    config = ConfigDict(**STRICT, validate_assignment=True, populate_by_name=True)
    made = in_one_line(pydantic.dataclasses.dataclass(config=config)(cls))
    # `help` shows the types without their ranges.
    types, given = get_type_hints(made), inspect.signature(made)
    plain = [p.replace(annotation=types.get(p.name, Any)) for p in given.parameters.values()]
    made.__signature__ = given.replace(parameters=plain)
    return made


MOST_PERIODS: Final = 1000
"""Largest delay in periods, which is the number of torques in flight."""

# Limits far beyond any platform keep squares and products finite.
Positive = Annotated[float, Field(gt=0, le=1e6)]
Weight = Annotated[float, Field(gt=0, le=1e12)]
Seconds = Annotated[float, Field(ge=0, le=1e5)]
Deviation = Annotated[float, Field(ge=0, le=1e3)]
Length = Annotated[float, Field(ge=-1e3, le=1e3)]
Loss = Annotated[float, Field(ge=0, le=0.99)]
Fraction = Annotated[
    float,
    Field(ge=0, lt=1),
    AfterValidator(lambda f: f if f >= LEAST_FRACTION else 0.0),
    one_message("a share of a period, from 0 to below 1"),
]
TorqueLimit = Annotated[
    Positive | Literal["none"] | None,
    one_message("a number above 0 and of at most 1e6 N m, none for no limit"),
]
Seed = Annotated[int, Field(ge=0, lt=2**32)]
Steps = Annotated[
    int,
    Field(ge=0, le=MOST_PERIODS),
    one_message(f"a whole number of periods, from 0 to {MOST_PERIODS}"),
]
Row = Annotated[list[float], exactly(6)]
Six = Annotated[list[Length], exactly(6)]
Name = Annotated[str, Field(min_length=1)]


_Range = Annotated[
    list[Annotated[float, Field(ge=-10, le=10)]],
    exactly(2),
    rule(lambda ends: ends[0] < ends[1]),
]
AngleRange = Annotated[
    _Range | Annotated[list[_Range], exactly(6)] | None,
    one_message("[low, high] in rad with low below high, or a list of six of these, or null"),
]
"""Range of crank angles, one for all cranks or one for each."""

SPIKE: Final = 10.0
"""Default `size` of a spike."""

# A mapping and not a dataclass, because Python reserves the name `from`.
_Fault = TypedDict(
    "_Fault",
    {
        "kind": Literal["frozen", "missing", "spike"],
        "leg": NotRequired[Annotated[int, Field(ge=1, le=6)] | None],
        "from": Seconds,
        "to": Seconds,
        "size": NotRequired[Annotated[float, Field(gt=0, le=1e6)] | None],
        "share": NotRequired[Annotated[float, Field(gt=0, le=1)] | None],
    },
)
with_config(STRICT)(_Fault)


def _check_fault(fault: Any) -> Any:
    for name, kinds in {"size": ("spike",), "share": ("missing", "spike")}.items():
        if fault.get(name) is not None and fault["kind"] not in kinds:
            raise ValueError(f"{name} with kind {' or '.join(kinds)} only")
    if not fault["from"] < fault["to"]:
        raise ValueError("`to` after `from`")
    return fault


LegFault = Annotated[_Fault, AfterValidator(_check_fault)]
"""One fault of encoders, from `from` up to but not at `to`, in s.

`frozen` repeats the last measurement before it, `missing` measures nothing, and `spike` is off by
`size` (default SPIKE) times the motion of each coordinate or crank, times a number drawn anew at
every sample from the standard normal distribution. `leg` null is all six. A `missing` or a `spike`
with a `share` affects that share of the samples, drawn independently for each and for each leg.
"""
_no_leg = rule(
    lambda fault: fault.get("leg") is None,
    "leg null: pose and rates of the plate are measured, not the legs",
)
SensorFault = Annotated[LegFault, _no_leg]
"""One fault of a measurement of pose and rates, see `LegFault`."""
