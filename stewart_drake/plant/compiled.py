"""Calling CasADi functions from numpy without conversion costs."""

from collections.abc import Sequence

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]


class Compiled:
    """A CasADi function behind its buffer interface; a plain call spends twice its time converting.

    Arguments and results are dense; a matrix argument or result is held in CasADi's column order,
    which is numpy's row order of its transpose. Results are fresh arrays.
    """

    def __init__(self, function: ca.Function) -> None:
        self.function = function
        self._buffer, self._evaluate = function.buffer()
        self._arguments = [
            np.zeros(function.size_in(i)[::-1]).squeeze() for i in range(function.n_in())
        ]
        self._results = [
            np.zeros(function.size_out(i)[::-1]).squeeze() for i in range(function.n_out())
        ]
        for i, argument in enumerate(self._arguments):
            self._buffer.set_arg(i, memoryview(np.atleast_1d(argument)))  # type: ignore[call-arg]
        for i, result in enumerate(self._results):
            if function.sparsity_out(i).nnz() != result.size:
                raise ValueError(f"{function.name()}: result {i} is sparse; densify it")
            self._buffer.set_res(i, memoryview(np.atleast_1d(result)))  # type: ignore[call-arg]

    def __call__(self, *arguments: ArrayLike) -> Sequence[Array]:
        """Evaluate; every argument is broadcast to its place."""
        for place, argument in zip(self._arguments, arguments, strict=True):
            place[...] = argument
        self._evaluate()
        return [result.copy() for result in self._results]
