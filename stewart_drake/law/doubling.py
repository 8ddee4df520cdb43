"""The Riccati equation by structure-preserving doubling, in C: see core/riccati.c.

The law in C designs with it. The law in Python and the analyses use `law.riccati.lqr`, by Drake's
solver, which is the oracle of this one.
"""

import numpy as np

from stewart_drake.core.law_layout import MAX_ORDER
from stewart_drake.dynamics.native_functions import NativeFunction
from stewart_drake.law.riccati import RiccatiError
from stewart_drake.scenario.signals import NUM_TORQUES
from stewart_drake.types import Array


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
        n, m = order, NUM_TORQUES
        arguments, results = [(n, n), (n, m), (n, n), (m, m)], [(m, n), (n, n), (1,)]
        nothing = np.empty(0)
        self._call = NativeFunction("riccati", nothing, arguments, results, [n])

    def __call__(self, A: Array, B: Array, Q: Array, R: Array) -> tuple[Array, Array]:
        """K (6, n) and P (n, n).

        Raises:
            RiccatiError: there is no stabilising solution, or none was found.
        """
        K, P, count = self._call(A, B, Q, R)
        if not count[0]:
            raise RiccatiError("Riccati equation: doubling has found no solution")
        return K, P
