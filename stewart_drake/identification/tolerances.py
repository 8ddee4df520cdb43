"""Tolerances of a machine's drawing; nothing heavy is imported here."""

from typing import Annotated, Final

from pydantic import Field
from pydantic.dataclasses import dataclass

from stewart_drake.files.yamlio import units_of
from stewart_drake.scenario.field_types import STRICT

_Std = Annotated[float, Field(ge=0, le=1e3)]


@dataclass(config=STRICT)
class Tolerances:
    """Prior standard deviations of a machine's unknowns; 0 is known, None depends on the machine.

    None is for bias and Coulomb friction the largest commanded torque, for viscous friction this
    torque at the largest crank speed, for the payload the mass of the plate, anywhere on it.
    """

    lengths: Annotated[_Std, Field(description="m, of cranks and rods")] = 2e-4
    joints: Annotated[_Std, Field(description="m, of each coordinate of shafts and joints")] = 2e-4
    # of an encoder's zero; without encoders in the log there are none
    offsets: Annotated[_Std, Field(description="rad, of an encoder's zero")] = 2e-3
    delay: Annotated[_Std, Field(description="s")] = 0.3  # of the believed delay
    bias: Annotated[_Std | None, Field(description="N m, of each motor")] = None
    payload: Annotated[_Std | None, Field(description="kg")] = None  # its mass
    position: Annotated[_Std | None, Field(description="m, of the payload in the plate")] = None
    # viscous friction of a crank
    damping: Annotated[_Std | None, Field(description="N m s/rad, of a crank")] = None
    # Coulomb friction of a crank
    coulomb: Annotated[_Std | None, Field(description="N m, of a crank")] = None


TOLERANCE_UNITS: Final = units_of(Tolerances)  # unit and meaning of each field
