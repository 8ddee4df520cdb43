"""The reference motion, as a scenario describes it, by kind.

`scenario.trajectories.make_reference` makes the motion itself.
"""

import math
from dataclasses import field
from typing import Annotated, Literal

from pydantic import Field
from pydantic.dataclasses import dataclass

from stewart_drake.files.schema import ByKind
from stewart_drake.scenario.field_types import STRICT, Name, Row, Seconds, Six


def _pitch_problem(largest: float) -> str | None:
    if largest < math.pi / 2:
        return None
    expected = "|offset| + |amplitude| below pi/2, where roll and yaw stay distinct"
    return f"reference.offset: the pitch reaches {largest:.4g} rad; expected {expected}"


@dataclass(config=STRICT)
class SineConfig:
    """offset + amplitude sin(frequency t).

    Attributes:
        kind: `sine`.
        amplitude: [roll, pitch, yaw, x, y, z] in rad and m.
        offset: middle of the motion, rad and m.
        frequency: in `frequency_unit`.
        frequency_unit: `rad/s` or `Hz`.
    """

    kind: Literal["sine"] = "sine"
    amplitude: Six = field(
        default_factory=lambda: [0.2617993878, 0.2617993878, 0.2617993878, 0.02, 0.02, 0.08]
    )
    offset: Six = field(default_factory=lambda: [0.0, 0.0, 0.0, 0.0, 0.0, 0.38])
    frequency: Annotated[float, Field(gt=0, le=1e4)] = 1.0
    frequency_unit: Literal["rad/s", "Hz"] = "rad/s"

    @property
    def angular_frequency(self) -> float:
        """Frequency in rad/s."""
        return self.frequency * (2 * math.pi if self.frequency_unit == "Hz" else 1.0)

    def problem(self) -> str | None:
        """Return the first rule between the fields that is broken, or None."""
        return _pitch_problem(abs(self.amplitude[1]) + abs(self.offset[1]))


@dataclass(config=STRICT)
class HoldConfig:
    """One constant pose.

    Attributes:
        kind: `hold`.
        offset: the pose, [roll, pitch, yaw, x, y, z] in rad and m.
    """

    kind: Literal["hold"] = "hold"
    offset: Six = field(default_factory=lambda: [0.0, 0.0, 0.0, 0.0, 0.0, 0.38])

    def problem(self) -> str | None:
        return _pitch_problem(abs(self.offset[1]))


@dataclass(config=STRICT)
class WaypointsConfig:
    """A smooth motion through poses, at rest in the first and the last; in lists or in a file.

    Attributes:
        kind: `waypoints`.
        times: s, increasing.
        poses: one [roll, pitch, yaw, x, y, z] per time, rad and m.
        file: a YAML file of `times` and `poses`.
    """

    kind: Literal["waypoints"] = "waypoints"
    times: Annotated[list[Seconds], Field(min_length=2)] | None = None
    poses: Annotated[list[Row], Field(min_length=2)] | None = None
    file: Name | None = None

    def problem(self) -> str | None:
        if self.file is not None:
            if self.times is None and self.poses is None:
                return None
            return "reference.file: got both a file and times or poses; expected one of the two"
        if self.times is None or self.poses is None:
            missing = "times" if self.times is None else "poses"
            return f"reference.{missing}: got None; expected times and poses, or a file"
        if len(self.times) != len(self.poses):
            found, expected = len(self.poses), len(self.times)
            return f"reference.poses: got {found} poses; expected {expected}, one per time"
        return None


@dataclass(config=STRICT)
class CsvConfig:
    """A sampled motion.

    Attributes:
        kind: `csv`.
        file: of time and six columns, see `scenario.reference_files.read_csv`.
    """

    kind: Literal["csv"] = "csv"
    file: Name | None = None

    def problem(self) -> str | None:
        if self.file is None:
            return "reference.file: got None; expected the CSV file that kind csv reads"
        return None


ReferenceConfig = Annotated[SineConfig | HoldConfig | WaypointsConfig | CsvConfig, ByKind()]
