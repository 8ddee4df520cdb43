"""Whether samples of a motion are dense and smooth enough for a cubic through them."""

from typing import Final

import numpy as np

from stewart_drake.types import Array

_MAX_KINK: Final = 0.05
"""Of the largest peak to peak of the angles, or of the positions."""
_LEAST_KINK: Final = 1e-3
"""rad, m; what stays below is noise of a sensor, not a jump."""


def roughest(times: Array, poses: Array) -> tuple[int, int, float] | None:
    """Row, column and size of the worst kink of samples (n,), (n, 6), or None if all is smooth.

    A sample should lie near the cubic through the two before and the two after it. With equal
    steps h the difference is the fourth difference over 6, (omega h)^4 / 6 of a sine's amplitude:
    1.3 % of its peak to peak with ten samples per period, 5 % with seven. A jump shows by half its
    size, a glitch with all of it. Ends are seen as neighbours only. The share is taken of the
    largest peak to peak among the angles, or the positions, since one may be still but for noise.
    """
    if len(times) < 5:
        return None
    near = np.array([-2, -1, 1, 2])
    at = np.arange(2, len(times) - 2)
    t = times[at[:, None] + near] - times[at][:, None]
    weights = np.ones_like(t)  # Lagrange's, at zero
    for i in range(4):
        for j in range(4):
            if i != j:
                weights[:, i] *= t[:, j] / (t[:, j] - t[:, i])
    kinks = np.abs(poses[at] - np.einsum("ki,kic->kc", weights, poses[at[:, None] + near]))
    spans = np.ptp(poses, axis=0)
    largest = np.repeat([spans[:3].max(), spans[3:].max()], 3)
    excess = kinks / np.maximum(_MAX_KINK * largest, _LEAST_KINK)
    row, column = np.unravel_index(excess.argmax(), excess.shape)
    if excess[row, column] <= 1:
        return None
    return int(at[row]), int(column), float(kinks[row, column])
