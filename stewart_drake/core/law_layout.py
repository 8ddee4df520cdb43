"""Configuration and memory of the law in C, stewart.h, as they lie in memory."""

import ctypes
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from stewart_drake.core.layout import GEOMETRY
from stewart_drake.scenario.signals import (
    NUM_COORDINATES,
    NUM_PARAMETERS,
    NUM_PLANT_PARAMETERS,
    NUM_REFERENCE,
    NUM_STATE,
    NUM_TORQUES,
)

Fields = dict[str, Any]

MAX_QUEUE: Final = 64
"""Torques in flight, at the most."""
MAX_KEPT: Final = 32
"""Further torques that are remembered."""
MAX_ORDER: Final = 24
"""States of the gain: error, integral, and a torque that is still to act."""
_MEANS: Final = NUM_STATE + NUM_PARAMETERS

CAUSES: Final = (
    "riccati_failures",
    "unreachable",
    "nonfinite_torque",
    "measurements_missing",
    "measurements_frozen",
    "measurements_rejected",
    "saturated_steps",
    "references_missing",
)
"""Names of the bits of a status, as of `law.memory.Counts`."""

CONFIG_FIELDS: Final[Fields] = {
    "geometry": GEOMETRY,
    "parameters": NUM_PLANT_PARAMETERS,
    "gravity": (),
    "period": (),
    "fraction": (),
    "torque_limit": (),
    "gentle_torque": (),
    "noise_std": NUM_STATE,
    "motion": NUM_COORDINATES,
    "error_weights": NUM_COORDINATES,
    "integral_weights": NUM_COORDINATES,
    "torque_weights": NUM_TORQUES,
    "prior": NUM_PARAMETERS,
    "std": NUM_PARAMETERS,
    "lower": NUM_PARAMETERS,
    "upper": NUM_PARAMETERS,
    "model_std": NUM_STATE,
    "timing_std": (),
    "gate": (),
}
"""Numbers, by shape; whole ones follow."""
CONFIG_FLAGS: Final = ("estimates", "steps", "kept", "longest_wait", "substeps", "silence")

MEMORY_FIELDS: Final[Fields] = {
    "in_flight": (1 + MAX_KEPT + MAX_QUEUE, NUM_TORQUES),
    "mean": _MEANS,
    "covariance": (_MEANS, _MEANS),
    "state": NUM_STATE,
    "measurement": NUM_STATE,
    "measured": NUM_STATE,
    "outlier": NUM_STATE,
    "error": NUM_COORDINATES,
    "integral": NUM_COORDINATES,
    "gain": NUM_TORQUES * MAX_ORDER,
    "torque": NUM_TORQUES,
    "feedforward": NUM_TORQUES,
    "weights": 2,
    "reference": (MAX_QUEUE + 8, NUM_REFERENCE),
    "followed": (MAX_QUEUE + 8, NUM_REFERENCE),
    "offset": NUM_STATE,
}
MEMORY_FLAGS: Final = (
    *("has_covariance", "has_gain", "has_started"),
    *("outliers", "unseen", "behind", "gap", "return_holds", "return_samples", "silence"),
)


def _structure(fields: Fields, flags: tuple[str, ...], *more: tuple[Any, ...]) -> np.dtype[np.void]:
    numbers = [(name, np.float64, shape) for name, shape in fields.items()]
    return np.dtype([*numbers, *((name, np.intc) for name in flags), *more], align=True)


CONFIG: Final = _structure(CONFIG_FIELDS, CONFIG_FLAGS)
MEMORY: Final = _structure(MEMORY_FIELDS, MEMORY_FLAGS, ("counts", np.intc, len(CAUSES)))


def check_sizes(library: ctypes.CDLL) -> None:
    """That this file and stewart.h say the same.

    Raises:
        AssertionError: they do not.
    """
    sizes = np.zeros(2, dtype=np.intc)
    library.law_sizes(ctypes.c_void_p(sizes.ctypes.data))
    assert sizes.tolist() == [CONFIG.itemsize, MEMORY.itemsize]


def address(array: NDArray[Any]) -> int:
    """Where the numbers of an array are; `__array_interface__` would describe every field first."""
    return int(array.ctypes.data)
