"""Types of the scenario's fields, each with its range; shared by the sections."""

from typing import Annotated, Final, Literal

from pydantic import AfterValidator, ConfigDict, Field

from stewart_drake.files.yamlio import one_message
from stewart_drake.scenario.timing import LEAST_FRACTION

STRICT: Final = ConfigDict(
    extra="forbid", strict=True, allow_inf_nan=False, validate_assignment=True
)
"""Of every section: nothing is guessed, and assignments are checked too."""
MOST_PERIODS: Final = 1000
"""Of a delay: as many torques are in flight."""

# Limits far beyond any platform keep squares and products of what a file says finite.
Positive = Annotated[float, Field(gt=0, le=1e6)]
Weight = Annotated[float, Field(gt=0, le=1e12)]
Seconds = Annotated[float, Field(ge=0, le=1e5)]
Deviation = Annotated[float, Field(ge=0, le=1e3)]
Fraction = Annotated[
    float, Field(ge=0, lt=1), AfterValidator(lambda f: f if f >= LEAST_FRACTION else 0.0)
]
TorqueLimit = Annotated[
    Positive | Literal["none"] | None,
    one_message("a number above 0 and of at most 1e6, none for no limit"),
]
Seed = Annotated[int, Field(ge=0, lt=2**32)]
Steps = Annotated[int, Field(ge=0, le=MOST_PERIODS)]
Row = Annotated[list[float], Field(min_length=6, max_length=6)]
Six = Annotated[list[Annotated[float, Field(ge=-1e3, le=1e3)]], Field(min_length=6, max_length=6)]
Name = Annotated[str, Field(min_length=1)]
