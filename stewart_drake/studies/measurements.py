"""Measurements of a machine with a ruler and scales; nothing heavy is imported here."""

import math
from typing import Annotated, Final, Literal

from pydantic import Field

from stewart_drake.files.errors import ConfigError
from stewart_drake.studies.options import Options, option

LARGEST: Final = 5.0
"""m; the parts of a larger machine are more likely in millimetres."""


_Length = Annotated[float, Field(gt=0, allow_inf_nan=False)]
_Mass = Annotated[float, Field(gt=0, lt=1e6)]


class Measurements(Options):
    """Measurements of a machine, lengths in m and masses in kg."""

    base_radius: _Length = option(..., "Radius of the circle of the motor shafts, m.")
    shaft_distance: _Length = option(..., "Distance of the two shafts of a pair, m.")
    plate_radius: _Length = option(..., "Radius of the circle of the plate's joints, m.")
    joint_distance: _Length = option(..., "Distance of two neighbouring joints of the plate, m.")
    crank: _Length = option(..., "Crank, from shaft to rod, m.")
    rod: _Length = option(..., "Rod, from joint to joint, m.")
    plate_mass: _Mass = option(..., "Mass of the plate with its load, kg.")
    crank_mass: _Mass = option(..., "Mass of a crank, kg.")
    rod_mass: _Mass = option(..., "Mass of a rod, kg.")
    shaft_height: float = option(0.0, "Height of the shafts, m.", ge=-LARGEST, le=LARGEST)
    upright: float = option(
        90.0, "Degrees from the horizon of the planes the cranks turn in.", ge=-180, le=180
    )
    cranks: Literal["apart", "together"] = option(
        "apart", "Of a pair: they point apart, or together."
    )
    torque_limit: float | None = option(None, "Torque limit of each motor, N m.", gt=0, lt=1e6)
    delay: float = option(0.1, "Time from computing a torque to its action, s.", ge=0, le=5)
    gravity: bool = option(True, "Gravity acts; not on a counterbalanced plate.")

    def __init__(self, **values: object) -> None:
        super().__init__(**values)
        self._check()

    def _check(self) -> None:
        for name, value in self.lengths().items():
            if value > LARGEST:
                raise ConfigError(
                    f"{name}: got {value:g} m; expected metres, {value / 1000:g} for {value:g} mm"
                )
        if self.rod <= self.crank:
            raise ConfigError(
                f"rod: got {self.rod:g} m with cranks of {self.crank:g} m; expected a rod longer "
                "than its crank"
            )
        for name, radius in (("shaft", self.base_radius), ("joint", self.plate_radius)):
            distance = getattr(self, f"{name}_distance")
            if distance >= math.sqrt(3) * radius:
                raise ConfigError(
                    f"{name}_distance: got {distance:g} m on a circle of radius {radius:g} m; "
                    f"expected less than {math.sqrt(3) * radius:.4g}, where pairs meet"
                )

    def lengths(self) -> dict[str, float]:
        """Return the lengths by name, m."""
        return {name: getattr(self, name) for name in list(type(self).model_fields)[:6]}
