"""From densities to the weights of one sample."""

from typing import Final

import numpy as np

from stewart_drake.tuner.network import Network
from stewart_drake.types import Array

MAX_FACTOR: Final = 1.5
"""By which w_Q and w_R change at most from one sample to the next, up or down."""


def tune(
    network: Network, densities: Array, last: Array, fixed: Array, factor: float = MAX_FACTOR
) -> tuple[Array, bool]:
    """The weights of the next sample: clipped to the network's bounds, then limited in rate.

    Weights are scales, so the rate is a factor: last / factor <= w <= last * factor. The gain,
    which depends on w_Q / w_R, sees at most its square.

    Args:
        network: what decides.
        densities: (18,).
        last: (2,) weights of the last sample; NaN before the first, which takes `fixed`.
        fixed: (2,) weights to go back to, at the same rate, where the network's are not finite.
        factor: above 1.

    Returns:
        w_Q and w_R (2,), finite and above zero, and whether the network had to be passed over.
    """
    if not np.all(np.isfinite(last)):
        return fixed, False
    raw = network(densities)
    usable = bool(np.all(np.isfinite(raw)))
    goal = np.clip(raw, *network.bounds) if usable else fixed
    return np.clip(goal, last / factor, last * factor), not usable
