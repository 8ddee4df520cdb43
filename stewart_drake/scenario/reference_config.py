"""Section `reference` of a scenario, by kind.

`mechanism.trajectories.make_reference` makes the motion itself.
"""

import math
from dataclasses import field
from typing import Annotated, Final, Literal

from pydantic import Field

from stewart_drake.files.schema import ByKind
from stewart_drake.files.yamlio import one_message
from stewart_drake.scenario.field_types import Name, Row, Seconds, Six, section

MOST_TURN: Final = 2 * math.pi
"""Largest |roll| and |yaw| of a motion, rad: a plate on legs turns less."""


def degrees_hint(angle: float, length: float = 0.0) -> str:
    """Return the end of a message about an angle in rad that may be one in degrees, or ''.

    A length beside it, in m, may then be one in mm.
    """
    units = "degrees and mm" if length >= 1 else "degrees"
    return f" (are these {units}?)" if abs(angle) > math.pi else ""


def _angle_problem(offset: list[float], amplitude: list[float]) -> str | None:
    for k, name, limit, expected in (
        (1, "pitch", math.pi / 2, "pi/2, where roll and yaw stay distinct"),
        (0, "roll", MOST_TURN, "2 pi"),
        (2, "yaw", MOST_TURN, "2 pi"),
    ):
        middle, swing = abs(offset[k]), abs(amplitude[k])
        if middle + swing >= limit:
            field = "amplitude" if swing > middle else "offset"
            hint = degrees_hint(middle + swing, max(map(abs, amplitude[3:])))
            return (
                f"reference.{field}: the {name} reaches {middle + swing:.4g} rad; expected "
                f"|offset| + |amplitude| below {expected}{hint}"
            )
    return None


_Frequency = Annotated[float, Field(gt=0, le=1e4)]
_Frequencies = Annotated[
    _Frequency | Annotated[list[_Frequency], Field(min_length=6, max_length=6)],
    one_message("a number above 0 and of at most 1e4, or six of them"),
]


@section
class SineConfig:
    """Sine motion: offset + amplitude sin(frequency t).

    Attributes:
        amplitude: [roll, pitch, yaw, x, y, z] in rad and m.
        offset: middle of the motion, rad and m.
        frequency: in `frequency_unit`; one for all coordinates, or a list of six.
        frequency_unit: `rad/s` or `Hz`.
    """

    kind: Literal["sine"] = "sine"
    amplitude: Six = field(
        default_factory=lambda: [0.2617993878, 0.2617993878, 0.2617993878, 0.02, 0.02, 0.08]
    )  # 15 degrees
    offset: Six = field(default_factory=lambda: [0.0, 0.0, 0.0, 0.0, 0.0, 0.38])
    frequency: _Frequencies = 1.0
    frequency_unit: Literal["rad/s", "Hz"] = "rad/s"

    @property
    def angular_frequency(self) -> list[float]:
        """Frequency of each coordinate, rad/s."""
        frequencies = self.frequency if isinstance(self.frequency, list) else [self.frequency] * 6
        factor = 2 * math.pi if self.frequency_unit == "Hz" else 1.0
        return [frequency * factor for frequency in frequencies]

    def problem(self) -> str | None:
        """Return the message of the first broken rule between fields, or None."""
        return _angle_problem(self.offset, self.amplitude)


@section
class HoldConfig:
    """One constant pose.

    Attributes:
        offset: the pose, [roll, pitch, yaw, x, y, z] in rad and m.
    """

    kind: Literal["hold"] = "hold"
    offset: Six = field(default_factory=lambda: [0.0, 0.0, 0.0, 0.0, 0.0, 0.38])

    def problem(self) -> str | None:
        return _angle_problem(self.offset, [0.0] * 6)


@section
class WaypointsConfig:
    """A smooth motion through poses of lists or a file, at rest in the first and the last.

    Attributes:
        times: ascending, s.
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


@section
class CsvConfig:
    """A sampled motion.

    Attributes:
        file: CSV of the time and six coordinates, see `scenario.reference_files.read_csv`.
    """

    kind: Literal["csv"] = "csv"
    file: Name | None = None

    def problem(self) -> str | None:
        if self.file is None:
            return "reference.file: got None; expected the CSV file that kind csv reads"
        return None


@section
class ReachyMoveConfig:
    """A recorded move of Reachy Mini, in the format of its SDK.

    Attributes:
        file: a shipped move, or JSON of `time` and `set_target_data`, see
            `machines.reachy_mini.read_move`.
    """

    kind: Literal["reachy_move"] = "reachy_move"
    file: Name | None = None

    def problem(self) -> str | None:
        if self.file is None:
            return "reference.file: got None; expected the JSON file of a recorded move"
        return None


ReferenceConfig = Annotated[
    SineConfig | HoldConfig | WaypointsConfig | CsvConfig | ReachyMoveConfig, ByKind()
]
