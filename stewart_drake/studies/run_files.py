"""The small files in which studies keep each run, read back as strictly as a scenario.

A file says that a run completed only if all that a completed run has is there; whatever breaks a
rule is a ConfigError, never a success.
"""

import math
from pathlib import Path
from typing import Annotated, Any, Final, Literal, NamedTuple, TypeVar

from pydantic import ConfigDict, Field
from pydantic.dataclasses import dataclass

from stewart_drake.files.errors import ConfigError
from stewart_drake.files.jsonio import load_json
from stewart_drake.files.yamlio import brief, validate
from stewart_drake.studies.robustness_result import Outcome

_MAX_BYTES: Final = 1_000_000
_EXPECTED: Final = "the file of one run of a study"
_STRICT: Final = ConfigDict(extra="forbid", strict=True, allow_inf_nan=False)

_Status = Literal["completed", "left_workspace", "solver_failed"]
_Size = Annotated[float, Field(ge=0)] | None
"""A number that is not negative; null is NaN."""
_T = TypeVar("_T")


@dataclass(config=_STRICT)
class _Outcome:
    status: Literal[_Status, "not_assembled", "refused"]
    reason: str
    leg: Annotated[int, Field(ge=1, le=6)] | None
    time: _Size
    error: _Size
    peak_torque: _Size


@dataclass(config=_STRICT)
class _Draw:
    draw: dict[str, Any]
    outcome: _Outcome


@dataclass(config=_STRICT)
class _Evaluation:
    accumulated_error: _Size
    rms_torque: _Size
    peak_torque: _Size
    torque_variation: _Size
    status: _Status
    stopped: _Size
    tuner_fallbacks: Annotated[int, Field(ge=0)]


@dataclass(config=_STRICT)
class _Cell:
    status: _Status
    error: _Size
    time: _Size


class CellOutcome(NamedTuple):
    """Status, E_ac in % s and time of the end in s of a cell; NaN where there is none."""

    status: str
    error: float
    time: float


class EvaluationOutcome(NamedTuple):
    """E_ac in % s, NaN for a run that did not complete, and the tuner's fallbacks."""

    error: float
    tuner_fallbacks: int


def read_outcome(path: Path) -> Outcome:
    """How a run of `analyze robustness` ended, from the file that `run_draw` made.

    Raises:
        ConfigError: the file is damaged; one line, with the field.
    """
    one = _read(_Draw, path).outcome
    _check_end(path, one.status, error=one.error, time=one.time)
    done = one.status == "completed"
    if done != (one.reason == ""):
        wanted = "no reason" if done else "a reason"
        raise _damaged(
            path, f"outcome.reason: got {brief(one.reason)}; expected {wanted}", one.status
        )
    if done and one.leg is not None:
        raise _damaged(path, f"outcome.leg: got {one.leg}; expected null", one.status)
    numbers = (_number(one.time), _number(one.error), _number(one.peak_torque))
    return Outcome(one.status, one.reason, one.leg, *numbers)


def read_evaluation(path: Path) -> EvaluationOutcome:
    """How a run of `tune evaluate` ended.

    Raises:
        ConfigError: as `read_outcome`.
    """
    one = _read(_Evaluation, path)
    _check_end(path, one.status, accumulated_error=one.accumulated_error, stopped=one.stopped)
    return EvaluationOutcome(_number(one.accumulated_error), one.tuner_fallbacks)


def read_cell(path: Path) -> CellOutcome:
    """How a simulation of the delay map ended.

    Raises:
        ConfigError: as `read_outcome`.
    """
    one = _read(_Cell, path)
    _check_end(path, one.status, error=one.error, time=one.time)
    return CellOutcome(one.status, _number(one.error), _number(one.time))


def _read(type_: type[_T], path: Path) -> _T:
    return validate(type_, load_json(path, _MAX_BYTES, _EXPECTED), str(path))


def _check_end(path: Path, status: str, **numbers: float | None) -> None:
    """Of a run that completed the first of two numbers must be there, of any other the second."""
    done = status == "completed"
    for (name, value), there in zip(numbers.items(), (done, not done), strict=True):
        if (value is not None) != there:
            wanted = "a number" if there else "null"
            raise _damaged(path, f"{name}: got {brief(value)}; expected {wanted}", status)


def _damaged(path: Path, problem: str, status: str) -> ConfigError:
    return ConfigError(f"{path}: {problem} of a run with status {status}")


def _number(value: float | None) -> float:
    return math.nan if value is None else value
