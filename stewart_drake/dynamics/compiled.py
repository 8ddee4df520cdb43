"""Calling functions from numpy without conversion costs."""

import threading
from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from typing import NamedTuple

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike, NDArray

from stewart_drake.dynamics.threads import BUILDING

Array = NDArray[np.float64]


class Buffers(NamedTuple):
    """Where a function reads arguments from and writes results to, and what makes it do so."""

    arguments: list[Array]
    results: list[Array]
    evaluate: Callable[[], object]
    owner: object
    """`evaluate` points into it without keeping it."""


class Buffered(ABC):
    """A function with fixed places for arguments and results; every thread has its own.

    A matrix argument or result is held in CasADi's column order, which is numpy's row order of its
    transpose. Results are fresh arrays.
    """

    def __init__(self) -> None:
        self._own = threading.local()

    def __call__(self, *arguments: ArrayLike) -> Sequence[Array]:
        """Evaluate; every argument is broadcast to its place."""
        places, results, evaluate, _ = self.own_buffers()
        for place, argument in zip(places, arguments, strict=True):
            place[...] = argument
        evaluate()
        return [result.copy() for result in results]

    def own_buffers(self) -> Buffers:
        """Those of this thread."""
        try:
            return self._own.buffers
        except AttributeError:
            self._own.buffers = self.buffers()
            return self._own.buffers

    @abstractmethod
    def buffers(self) -> Buffers:
        """Those of one more thread."""


class Compiled(Buffered):
    """A CasADi function behind its buffer interface; a plain call spends twice its time converting.

    Arguments and results are dense.
    """

    def __init__(self, function: ca.Function) -> None:
        super().__init__()
        self.function = function
        for i in range(function.n_out()):
            if function.sparsity_out(i).nnz() != function.numel_out(i):
                raise ValueError(f"{function.name()}: result {i} is sparse; densify it")

    def buffers(self) -> Buffers:
        """CasADi's own."""
        function = self.function
        with BUILDING:
            buffer, evaluate = function.buffer()
        arguments = [np.zeros(function.size_in(i)[::-1]).squeeze() for i in range(function.n_in())]
        results = [np.zeros(function.size_out(i)[::-1]).squeeze() for i in range(function.n_out())]
        for i, argument in enumerate(arguments):
            buffer.set_arg(i, memoryview(np.atleast_1d(argument)))  # type: ignore[call-arg]
        for i, result in enumerate(results):
            buffer.set_res(i, memoryview(np.atleast_1d(result)))  # type: ignore[call-arg]
        return Buffers(arguments, results, evaluate, buffer)
