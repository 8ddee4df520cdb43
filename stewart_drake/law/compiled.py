"""Structures of the core for parts of the law, each made once."""

from collections import OrderedDict
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from typing import Any, Generic, NamedTuple, TypeVar

import numpy as np

from stewart_drake.core.library import core
from stewart_drake.dynamics.frozen_map import FrozenDynamics
from stewart_drake.dynamics.stewart import StewartDynamics
from stewart_drake.law.nominal import NominalPlant, TorqueLimit
from stewart_drake.law.timeline import TorqueSchedule
from stewart_drake.scenario.signals import BALL_JOINTS, PLANT_PARAMETERS
from stewart_drake.types import Array

Made = TypeVar("Made")
DYNAMICS = StewartDynamics, FrozenDynamics
"""Dynamics that the core has."""


class Compiled(NamedTuple):
    """A structure of the core."""

    pointer: Any
    keep_alive: tuple[Any, ...] = ()  # objects that it points to
    raised: tuple[list[BaseException], ...] = ()  # errors of Python parts that C has called

    def pointed(self) -> list[Any]:
        """Return the structure and all arrays and structures that it points to."""
        return [self.pointer, *_flat(self.keep_alive)]


def raise_first(raised: Iterable[list[BaseException]]) -> None:
    """Raise the first error of a Python part since the last call."""
    for errors in raised:
        if errors:
            first = errors[0]
            errors.clear()
            raise first


def _flat(objects: Any) -> list[Any]:
    if isinstance(objects, Compiled):
        return objects.pointed()
    if isinstance(objects, Mapping):
        objects = tuple(objects.values())
    if isinstance(objects, tuple):
        return [one for part in objects for one in _flat(part)]
    return [objects] if isinstance(objects, np.ndarray | core().ffi.CData) else []


class Once(Generic[Made]):
    """Function of objects and numbers that is called once for the same ones, the last 64 of them.

    Objects are compared by identity, since those that hold arrays have no hash.
    """

    def __init__(self, make: Callable[..., Made]) -> None:
        self._make = make
        self._made: OrderedDict[tuple[Any, ...], tuple[tuple[Any, ...], Made]] = OrderedDict()

    def __call__(self, *parts: Any) -> Made:
        key = tuple(part if isinstance(part, int | float) else id(part) for part in parts)
        found = self._made.get(key)  # which holds the parts, so that no other has their id
        if found is None:
            found = parts, self._make(*parts)
            self._made[key] = found
            if len(self._made) > 64:
                self._made.popitem(last=False)
        return found[1]


@dataclass(frozen=True)
class Out:
    """Argument of a callback that takes `size` numbers, as a writable array."""

    size: Any  # a number, or a function of all arguments


def call_back(it: Any, raised: list[BaseException], **functions: tuple[Any, ...]) -> list[Any]:
    """Set functions of a table of the core to Python ones; return what must outlive the table.

    Args:
        it: pointer to the table.
        raised: gets the errors of the functions, which C does not see.
        functions: (function, argument, ...) by name. An argument is the size of an array, which is
            copied, None for NULL; or `Out`; or None for a value that is passed as it is; or `...`
            for one that is not passed. A size is a number, or a function of all arguments.
    """
    ffi = core().ffi

    def failed(_: Any, error: BaseException, __: Any) -> None:
        raised.append(error)

    def array(pointer: Any, size: Any, given: tuple[Any, ...]) -> Any:
        if size is None:
            return pointer
        if pointer == ffi.NULL:
            return None
        wanted = size.size if isinstance(size, Out) else size
        number = wanted(*given) if callable(wanted) else wanted
        view = np.ndarray(number, buffer=ffi.buffer(pointer, 8 * number)) if number else np.empty(0)
        return view if isinstance(size, Out) else view.copy()

    def called(function: Callable[..., Any], *sizes: Any) -> Callable[..., Any]:
        return lambda *given: function(
            *(
                array(value, size, given)
                for value, size in zip(given, sizes, strict=True)
                if size is not ...
            )
        )

    keep_alive = []
    for name, (function, *sizes) in functions.items():
        kind = ffi.typeof(getattr(it, name))
        keep_alive.append(ffi.callback(kind, called(function, *sizes), onerror=failed))
        setattr(it, name, keep_alive[-1])
    return keep_alive


def numbers(values: Any, *shape: int) -> Array:
    """Return a copy of numbers that C can read, of a certain shape if one is given.

    Raises:
        ValueError: another shape.
    """
    copied = np.array(values, dtype=np.float64, order="C")
    if shape and copied.shape != shape:
        raise ValueError(f"numbers for C: got shape {copied.shape}; expected {shape}")
    return copied


def address_of(pointer: Any) -> int:
    return int(core().ffi.cast("intptr_t", pointer))


def resists(dynamics: StewartDynamics) -> bool:
    """Return whether the ball joints of a plant have friction, or may have some."""
    names = PLANT_PARAMETERS[BALL_JOINTS]
    known = np.any(dynamics.plant_parameters[BALL_JOINTS][:2])
    return bool(known) or any(name in names for name in dynamics.free)


@Once
def machine_of(plant: NominalPlant) -> Compiled:
    machine, dynamics = core().ffi.new("stewart_machine *"), plant.dynamics
    machine.geometry = list(dynamics.mechanism.numbers)
    machine.parameters = list(dynamics.plant_parameters)
    machine.gravity, machine.torque_limit = dynamics.gravity, plant.motors.limit
    machine.coarse_torque_limit, machine.substeps = plant.coarse_torque_limit, plant.substeps
    machine.estimated = len(dynamics.free)
    if resists(dynamics):
        machine.joints = core().ffi.addressof(core().lib, "stewart_ball_joints")
    for i, name in enumerate(dynamics.free):
        machine.place[i] = PLANT_PARAMETERS.index(name) if name in PLANT_PARAMETERS else -1
    keep_alive, raised = list[Any](), list[BaseException]()
    if isinstance(dynamics, FrozenDynamics):
        keep_alive = [numbers(dynamics.map)]
        machine.acceleration_per_torque = core().at(keep_alive[0])
    shipped = NominalPlant, TorqueLimit, *DYNAMICS
    if not all(type(part) in shipped for part in (plant, plant.motors, dynamics)):
        keep_alive += _own_machine(plant, machine, raised)
    return Compiled(machine, tuple(keep_alive), (raised,))


def _own_machine(plant: NominalPlant, machine: Any, raised: list[BaseException]) -> list[Any]:
    """Set the motion and the limit of a machine to those of a plant in Python."""

    def predict(theta: Array | None, it: Any, state: Array, states: Array) -> None:
        torques, durations = (
            np.reshape(core().ffi.unpack(values, it.number * n), (it.number, n))
            for values, n in ((it.torques, 6), (it.durations, 1))
        )
        states[:] = np.ravel(
            plant.predict(state, TorqueSchedule(torques, durations.ravel()), theta)
        )

    def limit(torque: Array, limited: Array) -> int:
        limited[:] = plant.motors.saturate(torque)
        return int(np.any(limited != torque))

    def at_limit(torques: Array) -> int:
        return int(plant.motors.reached(torques.reshape(-1, 6)))

    own, p = core().ffi.new("stewart_own_machine *"), len(plant.dynamics.free)
    given = p, None, 12, Out(lambda _, __, it, *___: 12 * it.number)
    keep_alive = call_back(
        own,
        raised,
        predict=(predict, ..., *given),
        limit=(limit, ..., 6, Out(6)),
        at_limit=(at_limit, ..., ..., lambda _, number, __: 6 * number),
    )
    machine.own = own
    return [own, *keep_alive]
