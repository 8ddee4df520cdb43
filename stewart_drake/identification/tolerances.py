"""How far a machine may be off its drawing; nothing heavy is imported here."""

from collections.abc import Iterable
from typing import Annotated, Final

from pydantic import ConfigDict, Field
from pydantic.dataclasses import dataclass

from stewart_drake.files.yamlio import units_of, validate_pairs

_Std = Annotated[float, Field(ge=0, le=1e3)]


@dataclass(config=ConfigDict(extra="forbid", strict=True, allow_inf_nan=False))
class Tolerances:
    """Standard deviations of what is not known before any log; 0 is known, None by the machine.

    By the machine and the log: a bias and Coulomb friction as large as the largest torque that was
    commanded, viscous friction that takes this torque at the largest crank speed, a payload as
    heavy as the plate, anywhere on it.

    Attributes:
        lengths: of cranks and rods.
        joints: of each coordinate of a shaft's centre and a plate joint.
        offsets: of an encoder's zero; without encoders in the log there are none.
        delay: of the believed delay.
        bias: of each motor's torque.
        payload: its mass.
        position: of each coordinate of the payload in the plate.
        damping: viscous friction of a crank.
        coulomb: Coulomb friction of a crank.
    """

    lengths: Annotated[_Std, Field(description="m, of cranks and rods")] = 2e-4
    joints: Annotated[_Std, Field(description="m, of each coordinate of shafts and joints")] = 2e-4
    offsets: Annotated[_Std, Field(description="rad, of an encoder's zero")] = 2e-3
    delay: Annotated[_Std, Field(description="s")] = 0.3
    bias: Annotated[_Std | None, Field(description="N m, of each motor")] = None
    payload: Annotated[_Std | None, Field(description="kg")] = None
    position: Annotated[_Std | None, Field(description="m, of the payload in the plate")] = None
    damping: Annotated[_Std | None, Field(description="N m s/rad, of a crank")] = None
    coulomb: Annotated[_Std | None, Field(description="N m, of a crank")] = None


TOLERANCE_UNITS: Final = units_of(Tolerances)
"""By name of a field, its unit and what it is of."""


def read_tolerances(settings: Iterable[str]) -> Tolerances:
    """Tolerances from `name=value` settings, the value in YAML; the rest keeps its default.

    Raises:
        ConfigError: in one line.
    """
    return validate_pairs(Tolerances, settings, "--tolerance", TOLERANCE_UNITS)
