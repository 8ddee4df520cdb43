"""Densities, equation (45): how each signal stands against its own recent mean.

With w_in + 1 = 31 samples in the window and n of them known,

    magnitude (bounded):   rho(k) = |eps(k)| / mean |eps(i)|,
    signed (as printed):   rho(k) = eps(k) / mean eps(i),         i = k - w_in, ..., k.

A sample is unknown before the first one and where it is not finite (a missed measurement); the mean
is over the known ones, so that a window that is not yet full has a value too. Where eps(k) itself
is unknown, or nothing but zeros is known, rho(k) = 1: nothing out of the ordinary.

The mean of n magnitudes is at least |eps(k)| / n, hence 0 <= rho <= n <= 31. The signed mean passes
through zero while eps(k) does not, so that (45) as printed has no bound; it is cut at SIGNED_LIMIT.
"""

from typing import Any, Final, Literal

import numpy as np
from numpy.typing import ArrayLike

from stewart_drake.scenario.signals import TUNER_INPUTS
from stewart_drake.types import Array

Kind = Literal["magnitude", "signed"]

WINDOW: Final = 31
"""w_in + 1 samples."""
NUM_INPUTS: Final = len(TUNER_INPUTS)
"""12 state errors (pose, rates) and 6 torques."""
SIGNED_LIMIT: Final = 1e6
"""Largest |rho| of kind `signed`, with the sign of eps(k) where the mean is exactly zero."""


def density(window: ArrayLike, kind: Kind = "magnitude") -> Array:
    """Equation (45) for the newest sample of a window.

    Args:
        window: (..., WINDOW, m) samples, the newest last; unknown ones are not finite.
        kind: `magnitude` or `signed`.

    Returns:
        (..., m) densities, finite: in [0, WINDOW], or in +-SIGNED_LIMIT.

    Raises:
        ValueError: a window of another length, or another kind.
    """
    samples = np.asarray(window, dtype=np.float64)
    if samples.ndim < 2 or samples.shape[-2] != WINDOW:
        raise ValueError(f"window: got shape {samples.shape}; expected (..., {WINDOW}, m)")
    if kind not in ("magnitude", "signed"):
        raise ValueError(f"kind: got {kind!r}; expected 'magnitude' or 'signed'")
    known = np.isfinite(samples)
    number = known.sum(axis=-2)
    values = np.where(known, np.abs(samples) if kind == "magnitude" else samples, 0.0)
    # In units of the largest, no sum overflows. A rounded sum of magnitudes is never below one of
    # them, so share <= 1 and the bound holds to the last bit.
    largest = np.abs(values).max(axis=-2)
    usable = known[..., -1, :] & (largest > 0)
    relative = values / np.where(largest > 0, largest, 1.0)[..., None, :]
    newest, total = relative[..., -1, :], relative.sum(axis=-2)
    if kind == "magnitude":
        ratio = number * (newest / np.where(usable, total, 1.0))
    else:
        with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
            ratio = number * (newest / np.where(usable, total, 1.0))
        ratio = np.clip(np.where(newest == 0, 0.0, ratio), -SIGNED_LIMIT, SIGNED_LIMIT)
    result: Any = np.where(usable, ratio, 1.0)
    return result


def densities(samples: ArrayLike, kind: Kind = "magnitude") -> Array:
    """Equation (45) along a record of samples.

    Args:
        samples: (N, 18) in time order, rows [measurement - reference (12); commanded torque (6)]
            in rad, m, rad/s, m/s and N m; what is not finite is unknown.
        kind: `magnitude` or `signed`.

    Returns:
        (N, 18); row k is of samples max(0, k - WINDOW + 1) to k.

    Raises:
        ValueError: samples of another shape, or another kind.
    """
    record = np.asarray(samples, dtype=np.float64)
    if record.ndim != 2 or record.shape[1] != NUM_INPUTS:
        raise ValueError(f"samples: got shape {record.shape}; expected (N, {NUM_INPUTS})")
    padded = np.vstack([np.full((WINDOW, NUM_INPUTS), np.nan), record])
    windows = np.lib.stride_tricks.sliding_window_view(padded, WINDOW, axis=0)[1:]
    return density(np.moveaxis(windows, -1, -2), kind)
