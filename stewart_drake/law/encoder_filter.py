"""The filter of core/encoder_filter.h for encoders: legs at several instants of a period."""

from dataclasses import dataclass

from stewart_drake.law.compiled import Compiled
from stewart_drake.law.encoder_sensing import EncoderSensing
from stewart_drake.law.parameter_filter import ParameterFilter, compiled_filter
from stewart_drake.types import Array


@dataclass(frozen=True)
class EncoderFilter(ParameterFilter):
    """The filter for one plant with encoders.

    Attributes:
        last: (6 N,) the measurement before, NaN for nothing.
        still: (6,) as of `Sensing.stood`.
    """

    last: Array
    still: Array

    def _before(self) -> tuple[Array, Array]:
        return self.last, self.still

    def _compiled(self) -> Compiled:
        assert isinstance(self.sensing, EncoderSensing)
        return compiled_filter(self.dynamics, self.sensing, self.settings, True)
