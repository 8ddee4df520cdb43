"""Checks of arguments of Python functions."""

import math
from collections.abc import Sequence
from numbers import Integral, Real
from typing import Any

import numpy as np

from stewart_drake.files.errors import ConfigError
from stewart_drake.files.yamlio import brief
from stewart_drake.types import Array, ArrayLike


def fixed(
    field: str, values: ArrayLike | None, shape: tuple[int, ...], least: float = -math.inf
) -> Array:
    """Return a read-only copy, by rows, of finite numbers of this shape, of at least `least`."""
    try:
        given = np.array(values)
    except (TypeError, ValueError):  # ragged
        given = np.array(None)
    if given.dtype.kind not in "biuf":
        raise ConfigError(f"{field}: got {brief(values)}; expected numbers")
    copy = given.astype(np.float64, order="C")
    if copy.shape != shape:
        raise ConfigError(f"{field}: got shape {copy.shape}; expected {shape or 'one number'}")
    if not np.all(np.isfinite(copy)):
        raise ConfigError(f"{field}: got {listed(copy)}; expected finite numbers")
    if np.any(copy < least):
        raise ConfigError(f"{field}: got {listed(copy)}; expected numbers of at least {least:g}")
    copy.setflags(write=False)
    return copy


def listed(values: Array) -> str:
    """Return numbers as text, an array in brackets and cut after 18."""
    text = ", ".join(f"{v:g}" for v in np.ravel(values)[:18]) + ", ..." * (np.size(values) > 18)
    return f"[{text}]" if np.ndim(values) else text


def positive(field: str, value: Any, infinite: bool = False) -> float:
    """Return a number above 0, finite unless it may be `infinite`."""
    if not (isinstance(value, Real) and float(value) > 0 and (infinite or float(value) < math.inf)):
        kind = "number" if infinite else "finite number"
        raise ConfigError(f"{field}: got {value!r}; expected a {kind} above 0")
    return float(value)


def whole(field: str, value: Any, least: int) -> int:
    """Return a whole number of at least `least`."""
    if not (isinstance(value, Integral) and int(value) >= least):
        raise ConfigError(f"{field}: got {value!r}; expected a whole number, {least} or more")
    return int(value)


def one_of(field: str, value: Any, accepted: Sequence[str]) -> None:
    if value not in tuple(accepted):
        raise ConfigError(f"{field}: got {value!r}; expected {' or '.join(map(repr, accepted))}")


def of_kind(field: str, value: Any, kind: type) -> None:
    if not isinstance(value, kind):
        raise ConfigError(f"{field}: got {brief(value)}; expected a {kind.__name__}")
