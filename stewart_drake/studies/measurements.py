"""What is measured on a machine with a ruler and scales; nothing heavy is imported here."""

import math
from typing import Annotated, Final, Literal

from pydantic import Field

from stewart_drake.files.errors import ConfigError
from stewart_drake.studies.options import Flag, Options

LARGEST: Final = 5.0
"""m; the parts of a larger machine are more likely in millimetres."""


class Measurements(Options):
    """Measurements of a machine, lengths in m and masses in kg."""

    base_radius: Annotated[
        float, Field(description="Radius of the circle of the motor shafts, m."), Flag()
    ]
    shaft_distance: Annotated[
        float, Field(description="Distance of the two shafts of a pair, m."), Flag()
    ]
    plate_radius: Annotated[
        float, Field(description="Radius of the circle of the plate's joints, m."), Flag()
    ]
    joint_distance: Annotated[
        float, Field(description="Distance of two neighbouring joints of the plate, m."), Flag()
    ]
    crank: Annotated[float, Field(description="Crank, from shaft to rod, m."), Flag()]
    rod: Annotated[float, Field(description="Rod, from joint to joint, m."), Flag()]
    plate_mass: Annotated[float, Field(description="Mass of the plate with its load, kg."), Flag()]
    crank_mass: Annotated[float, Field(description="Mass of a crank, kg."), Flag()]
    rod_mass: Annotated[float, Field(description="Mass of a rod, kg."), Flag()]
    shaft_height: Annotated[float, Field(description="Of the shafts, m."), Flag()] = 0.0
    upright: Annotated[
        float,
        Field(description="Degrees from the horizon of the planes the cranks turn in."),
        Flag(),
    ] = 90.0
    cranks: Annotated[
        Literal["apart", "together"],
        Field(description="Of a pair: they point apart, or together."),
        Flag(),
    ] = "apart"
    torque_limit: Annotated[float | None, Field(description="Of each motor, N m."), Flag()] = None
    delay: Annotated[
        float, Field(description="From computing a torque to feeling it, s."), Flag()
    ] = 0.1
    gravity: Annotated[
        bool, Field(description="Whether it acts; a counterbalanced plate feels none."), Flag()
    ] = True

    def __init__(self, **values: object) -> None:
        super().__init__(**values)
        self._check()

    def _check(self) -> None:
        for name, value in self.lengths().items():
            if not 0 < value < math.inf:
                raise ConfigError(f"{name}: got {value:g} m; expected a positive length")
            if value > LARGEST:
                raise ConfigError(
                    f"{name}: got {value:g} m; expected metres, {value / 1000:g} for {value:g} mm"
                )
        if self.rod <= self.crank:
            raise ConfigError(
                f"rod: got {self.rod:g} m with cranks of {self.crank:g} m; expected a rod longer "
                "than its crank"
            )
        for name in ("plate_mass", "crank_mass", "rod_mass"):
            if not 0 < getattr(self, name) < 1e6:
                raise ConfigError(
                    f"{name}: got {getattr(self, name):g}; expected a mass in kg, above 0"
                )
        for name, radius in (("shaft", self.base_radius), ("joint", self.plate_radius)):
            distance = getattr(self, f"{name}_distance")
            if distance >= math.sqrt(3) * radius:
                raise ConfigError(
                    f"{name}_distance: got {distance:g} m on a circle of radius {radius:g} m; "
                    f"expected less than {math.sqrt(3) * radius:.4g}, where pairs meet"
                )
        if self.torque_limit is not None and not 0 < self.torque_limit < 1e6:
            raise ConfigError(f"torque_limit: got {self.torque_limit:g}; expected N m above 0")
        if not 0 <= self.delay <= 5:
            raise ConfigError(f"delay: got {self.delay:g}; expected 0 to 5 s")
        if not 0 <= abs(self.shaft_height) <= LARGEST:
            raise ConfigError(f"shaft_height: got {self.shaft_height:g}; expected metres")
        if not -180 <= self.upright <= 180:
            raise ConfigError(f"upright: got {self.upright:g}; expected degrees, -180 to 180")

    def lengths(self) -> dict[str, float]:
        """Return the lengths by name, m."""
        return {name: getattr(self, name) for name in list(type(self).model_fields)[:6]}
