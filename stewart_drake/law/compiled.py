"""Structures of the core for parts of the law, made once for each part."""

from collections import OrderedDict
from collections.abc import Callable
from typing import Any, Generic, NamedTuple, TypeVar

import numpy as np

from stewart_drake.core.library import core
from stewart_drake.dynamics.frozen_map import FrozenDynamics
from stewart_drake.dynamics.stewart import StewartDynamics
from stewart_drake.mechanism.geometry import Mechanism, geometry_of
from stewart_drake.scenario.signals import PLANT_PARAMETERS
from stewart_drake.types import Array

Made = TypeVar("Made")


class Compiled(NamedTuple):
    """A structure of the core.

    Attributes:
        it: the pointer to it.
        keeps: what it points to.
        raised: errors of parts in Python that C has called.
    """

    it: Any
    keeps: tuple[Any, ...] = ()
    raised: tuple[list[BaseException], ...] = ()

    def require_calm(self) -> None:
        """Raise the first error of a part in Python since the last call."""
        for errors in self.raised:
            if errors:
                first = errors[0]
                errors.clear()
                raise first


class Once(Generic[Made]):
    """A function of objects that is called once for the same ones, the last 64 of them.

    Unlike a cache of the standard library's it does not ask them whether they are equal.
    """

    def __init__(self, make: Callable[..., Made]) -> None:
        self._make = make
        self._made: OrderedDict[tuple[int, ...], tuple[tuple[Any, ...], Made]] = OrderedDict()

    def __call__(self, *parts: Any) -> Made:
        """Return what was made of these objects, or make it."""
        key = tuple(map(id, parts))
        found = self._made.get(key)  # which holds the parts, so that no other has their id
        if found is None:
            found = parts, self._make(*parts)
            self._made[key] = found
            if len(self._made) > 64:
                self._made.popitem(last=False)
        return found[1]


def numbers(values: Any, *shape: int) -> Array:
    """Return a copy of numbers that C can read; of any shape if none is given.

    Raises:
        ValueError: another shape.
    """
    copied = np.array(values, dtype=np.float64, order="C")
    if shape and copied.shape != shape:
        raise ValueError(f"numbers for C: got shape {copied.shape}; expected {shape}")
    return copied


@Once
def geometry(mechanism: Mechanism) -> Array:
    """Return the numbers of a machine, for C."""
    return numbers(geometry_of(mechanism))


@Once
def machine_of(dynamics: StewartDynamics) -> Compiled:
    """Return the `stewart_machine` of a plant, for predictions whose substeps are given."""
    machine, names = core().ffi.new("stewart_machine *"), dynamics.free
    machine.geometry = list(geometry(dynamics.mechanism))
    machine.parameters = list(dynamics.plant_parameters)
    machine.gravity, machine.torque_limit = dynamics.gravity, np.inf
    machine.gentle_torque, machine.substeps = np.inf, 1
    machine.estimated = len(names)
    for i, name in enumerate(names):
        machine.place[i] = PLANT_PARAMETERS.index(name) if name in PLANT_PARAMETERS else -1
    if not isinstance(dynamics, FrozenDynamics):
        return Compiled(machine)
    frozen = numbers(dynamics.map)
    machine.map = core().at(frozen)
    return Compiled(machine, (frozen,))
