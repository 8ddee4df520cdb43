"""Systems and trajectories of the user's own in the loop, checked at the border."""

import math
from collections.abc import Callable, Iterable
from typing import Any, Final, NamedTuple
from weakref import WeakSet

import numpy as np
from numpy.typing import NDArray
from pydrake.systems.framework import InputPort, OutputPort, PortDataType, System
from pydrake.trajectories import FunctionHandleTrajectory, Trajectory

from stewart_drake.files.errors import ConfigError
from stewart_drake.scenario.signals import (
    ACCELERATIONS,
    NUM_COORDINATES,
    NUM_REFERENCE,
    NUM_STATE,
    NUM_TORQUES,
    POSE,
    RATES,
)
from stewart_drake.scenario.trajectories import evaluate

Array = NDArray[np.float64]

OwnSystem = System | Callable[[], System]
"""A system, which serves one run, or what makes one, such as its class."""
OwnReference = Trajectory | Callable[[], Trajectory]

_CONTROLLER: Final = {"measurement": NUM_STATE, "reference": NUM_REFERENCE}
"""Inputs of a controller; the first it must have."""
_DISTURBANCE: Final = {"torque": NUM_TORQUES, "wrench": 6}
"""Outputs of a disturbance, of which it has one or both."""
_REST: Final = 1e-6
"""rad/s or m/s; a trajectory that ends slower than this goes on at rest."""
_APART: Final = 1e-9
"""s before and after a joint of two pieces."""
_CHECKS: Final = 200
"""Instants at which a trajectory is looked at."""

_used: "WeakSet[Any]" = WeakSet()


class Own(NamedTuple):
    """What of a loop is the user's own; None where the scenario's is used.

    Attributes:
        controller: inputs `measurement` (12) and, if it wants, `reference` (18), what the plate
            shall do now; output `torque` (6), read every period of the controller.
        disturbance: output `torque` (6), at the shafts, or `wrench` (6), moment then force in the
            world at the plate's COM, or both.
        reference: a 6 x 1 trajectory of the pose with two derivatives.
    """

    controller: System | None = None
    disturbance: System | None = None
    reference: Trajectory | None = None
    instances: tuple[System, ...] = ()
    """Those of the systems that were given as such, and stay the user's."""

    @property
    def names(self) -> dict[str, str]:
        """What each is, as `summary.json` tells it."""
        given = {
            "controller": self.controller,
            "disturbance": self.disturbance,
            "reference": self.reference,
        }
        return {name: type(thing).__name__ for name, thing in given.items() if thing is not None}

    @property
    def systems(self) -> list[Any]:
        """Those that are systems."""
        return [system for system in (self.controller, self.disturbance) if system is not None]

    def claim(self) -> None:
        """Note that the systems now belong to a loop.

        Raises:
            ConfigError: one of them belongs to another one.
        """
        for system in self.systems:
            if system in _used:
                raise ConfigError(
                    f"{type(system).__name__}: got an instance that has been in a loop already; "
                    "expected a new one, or a function that makes one for every run"
                )
            _used.add(system)


NOTHING: Final = Own()
"""All is the scenario's."""


def take(
    controller: OwnSystem | None, reference: OwnReference | None, disturbance: OwnSystem | None
) -> Own:
    """What a user gave for one run, made and checked, the reference's motion excepted.

    Raises:
        ConfigError: one line.
    """
    own = Own(
        None if controller is None else _make("controller", controller, System),
        None if disturbance is None else _make("disturbance", disturbance, System),
        None if reference is None else _make("reference", reference, Trajectory),
        tuple(given for given in (controller, disturbance) if isinstance(given, System)),
    )
    if own.controller is not None:
        _check_controller(own.controller)
    if own.disturbance is not None:
        _check_disturbance(own.disturbance)
    return own


def _make(what: str, given: Any, kind: type) -> Any:
    made = given if isinstance(given, kind) or not callable(given) else given()
    if not isinstance(made, kind):
        name = "Drake system" if kind is System else "Drake trajectory"
        raise ConfigError(
            f"{what}: got a {type(made).__name__}; expected a {name}, or a function that makes one"
        )
    return made


def _check_controller(system: System) -> None:
    known = " and, if wanted, ".join(f"{name} ({size})" for name, size in _CONTROLLER.items())
    inputs = _ports(system.get_input_port, system.num_input_ports())
    name = f"controller: {type(system).__name__}"
    for port in inputs:
        if port not in _CONTROLLER:
            raise ConfigError(f"{name}: got an input port {port!r}; expected {known}")
        _check_size(name, "input", inputs[port], _CONTROLLER[port])
    if "measurement" not in inputs:
        raise ConfigError(f"{name}: got no input port 'measurement'; expected {known}")
    outputs = _ports(system.get_output_port, system.num_output_ports())
    if "torque" not in outputs:
        raise ConfigError(
            f"{name}: got {_list(outputs)}; expected an output port 'torque' ({NUM_TORQUES})"
        )
    _check_size(name, "output", outputs["torque"], NUM_TORQUES)


def _check_disturbance(system: System) -> None:
    name = f"disturbance: {type(system).__name__}"
    inputs = _ports(system.get_input_port, system.num_input_ports())
    if inputs:
        raise ConfigError(f"{name}: got an input port {min(inputs)!r}; expected none")
    outputs = _ports(system.get_output_port, system.num_output_ports())
    found = [port for port in _DISTURBANCE if port in outputs]
    if not found:
        raise ConfigError(
            f"{name}: got {_list(outputs)}; expected an output port "
            + " or ".join(f"{port!r} ({size})" for port, size in _DISTURBANCE.items())
        )
    for port in found:
        _check_size(name, "output", outputs[port], _DISTURBANCE[port])


def _ports(get: Callable[[int], Any], number: int) -> dict[str, Any]:
    return {port.get_name(): port for port in map(get, range(number))}


def _list(outputs: Iterable[str]) -> str:
    names = ", ".join(map(repr, outputs))
    return f"output ports {names}" if names else "no output port"


def _check_size(name: str, way: str, port: InputPort | OutputPort, size: int) -> None:
    if port.get_data_type() != PortDataType.kVectorValued:
        raise ConfigError(
            f"{name}: {way} port {port.get_name()!r}: got an abstract one; expected a vector of "
            f"{size}"
        )
    if port.size() != size:
        raise ConfigError(
            f"{name}: {way} port {port.get_name()!r}: got {port.size()} values; expected {size}"
        )


def own_motion(reference: Trajectory, duration: float) -> Trajectory:
    """A trajectory of the user's own, checked, and at rest after its end.

    Args:
        reference: 6 x 1, rad and m, with derivatives of order 1 and 2.
        duration: of the simulation, s.

    Returns:
        The same, defined for t >= 0: the controller looks ahead of the end.

    Raises:
        ConfigError: one line.
    """
    name = f"reference: {type(reference).__name__}"
    shape = (reference.rows(), reference.cols())
    if shape != (NUM_COORDINATES, 1):
        raise ConfigError(f"{name}: got shape {shape}; expected (6, 1), the pose")
    begin, end = reference.start_time(), reference.end_time()
    if begin > 0:
        raise ConfigError(f"{name}: got a start at {begin:g} s; expected one at 0 s or before")
    if end < 0:
        raise ConfigError(f"{name}: got an end at {end:g} s; expected one after 0 s")
    for t in np.linspace(0.0, min(duration, end), _CHECKS):
        try:
            values = evaluate(reference, float(t))
        except (Exception, SystemExit) as error:  # Drake ends the process where it has none
            raise ConfigError(
                f"{name}: got no pose, rates and accelerations at {t:.4g} s "
                f"({' '.join(str(error).split())}); expected derivatives of order 1 and 2"
            ) from error
        if not np.all(np.isfinite(values)):
            raise ConfigError(f"{name}: got {values} at {t:.4g} s; expected finite numbers")
    _check_joints(name, reference, min(duration, end))
    if math.isinf(end):
        return reference
    rates = evaluate(reference, end)[RATES]
    if end < duration and np.abs(rates).max() > _REST:
        raise ConfigError(
            f"{name}: got an end at {end:g} s with rates {rates}; expected it to come to rest, or "
            f"duration <= {end:g}"
        )
    return _held_after(reference, end)


def _check_joints(name: str, reference: Trajectory, until: float) -> None:
    """Refuse pieces that do not fit, such as straight lines: nothing with a mass follows a jump."""
    if not hasattr(reference, "get_segment_times"):
        return
    joints = [t for t in reference.get_segment_times() if 0 < t < until]
    for t in joints:
        before, after = (evaluate(reference, t + side * _APART) for side in (-1, 1))
        for what, part, change in (("pose", POSE, RATES), ("rates", RATES, ACCELERATIONS)):
            moving = np.abs(np.concatenate([before[change], after[change]])).max()
            jump = np.abs(after[part] - before[part]).max()
            if jump > _REST + 4 * _APART * moving:
                raise ConfigError(
                    f"{name}: got a jump of {jump:.3g} in the {what} at {t:.4g} s; expected pose "
                    "and rates without jumps"
                )


def _held_after(reference: Trajectory, end: float) -> Trajectory:
    still = np.zeros((NUM_COORDINATES, 1))

    def derivative(t: float, order: int) -> Array:
        return reference.EvalDerivative(t, order) if t <= end else still

    held = FunctionHandleTrajectory(
        lambda t: reference.value(min(t, end)), NUM_COORDINATES, 1, 0.0, math.inf
    )
    held.set_derivative(derivative)
    return held
