"""The Riccati equation by structure-preserving doubling, in C: see core/riccati.c.

The law in C designs with it. The law in Python and the analyses use `law.riccati.lqr`, by Drake's
solver, which is the oracle of this one.
"""

from typing import Final

import numpy as np

from stewart_drake.core.library import core
from stewart_drake.law.riccati import RiccatiError
from stewart_drake.scenario.signals import NUM_TORQUES
from stewart_drake.types import Array

MAX_ORDER: Final = 24
"""States of the gain: error, integral, and a torque that is still to act."""


class Doubling:
    """Gain and cost of n states, (n, n) and (n, 6), as `law.riccati.lqr` gives them.

    Args:
        order: n.

    Raises:
        ValueError: more states than it has place for.
    """

    def __init__(self, order: int) -> None:
        if not 0 < order <= MAX_ORDER:
            raise ValueError(f"order: got {order}; expected 1 to {MAX_ORDER}")
        self._order = order

    def __call__(self, A: Array, B: Array, Q: Array, R: Array) -> tuple[Array, Array]:
        """Return K (6, n) and P (n, n).

        Raises:
            RiccatiError: there is no stabilising solution, or none was found.
        """
        c, n = core(), self._order
        kept = [np.ascontiguousarray(matrix, np.float64) for matrix in (A, B, Q, R)]
        given = [c.at(matrix) for matrix in kept]
        K, P = np.empty((NUM_TORQUES, n)), np.empty((n, n))
        scratch = c.scratch(c.lib.stewart_lqr_scratch(n))
        if not c.lib.stewart_lqr(n, *given, c.at(K), c.at(P), scratch):
            raise RiccatiError("Riccati equation: doubling has found no solution")
        return K, P
