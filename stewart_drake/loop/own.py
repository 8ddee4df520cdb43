"""Systems, trajectory and law of the user, with checks before a run."""

import inspect
import math
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from traceback import walk_tb
from types import MappingProxyType
from typing import Any, Final, NamedTuple, TypedDict, TypeVar
from weakref import WeakSet

import numpy as np
from pydrake.systems.framework import InputPort, OutputPort, System
from pydrake.trajectories import FunctionHandleTrajectory, Trajectory

from stewart_drake.files.errors import ConfigError
from stewart_drake.law.predictive_lqi import PredictiveLqi
from stewart_drake.law.servos import ServoPreview
from stewart_drake.mechanism.trajectories import evaluate
from stewart_drake.scenario.config import Scenario
from stewart_drake.scenario.dependencies import Accepted, differing
from stewart_drake.scenario.signals import (
    ACCELERATIONS,
    NUM_COORDINATES,
    NUM_REFERENCE,
    NUM_STATE,
    NUM_TORQUES,
    POSE,
    RATES,
    TUNER_INPUTS,
    WEIGHTS,
)
from stewart_drake.types import Array

_REST: Final = 1e-6
"""Largest rates at the end of a trajectory that is held after its end, rad/s or m/s."""
_APART: Final = 1e-9
"""s before and after a joint of two pieces."""
_CHECKS: Final = 200
"""Number of instants at which a trajectory is checked."""
OwnSystem = System | Callable[[], System]
"""A system for one run, or a function that makes one, such as its class."""
OwnController = str | Path | OwnSystem
"""The same, or a controller's shipped name or file, laid over the scenario's."""
OwnReference = Trajectory | Callable[[], Trajectory]
OwnLaw = Callable[[Any], Any]
"""Takes the scenario's law, a `PredictiveLqi`, or `ServoPreview` for servos; returns a law of that
class."""
AnyLaw = TypeVar("AnyLaw", PredictiveLqi, ServoPreview)


class OwnSystems(TypedDict, total=False):
    """What `loop.simulation.simulate` accepts in place of the scenario's."""

    controller: OwnController | None
    reference: OwnReference | None
    disturbance: OwnSystem | None
    modify_law: OwnLaw | None
    sensor: OwnSystem | None
    link: OwnSystem | None
    tuner: OwnSystem | None


_SIZES: Final[Mapping[str, int]] = {
    "state": NUM_STATE,
    "measurement": NUM_STATE,
    "reference": NUM_REFERENCE,
    "density": len(TUNER_INPUTS),
    "weights": len(WEIGHTS),
    "commanded": NUM_TORQUES,
    "torque": NUM_TORQUES,
    "wrench": 6,
}
"""Sizes of the ports in all roles."""


class Role(NamedTuple):
    """Place of a system in the loop, with the names of its ports."""

    inputs: str  # required
    optional: str  # inputs
    outputs: str  # at least one of them required
    accepted: Accepted = MappingProxyType({})  # values of the scenario's fields


ROLES: Final[Mapping[str, Role]] = {
    "controller": Role(
        "measurement",
        "reference",
        "torque",
        {"sensor.kind": "state", "tuner.kind": "fixed", "actuator.kind": "torque"},
    ),
    "disturbance": Role("", "", "torque wrench"),
    "sensor": Role("state", "", "measurement", {"sensor.kind": "state"}),
    "link": Role("commanded", "", "torque", {"link.kind": "wire", "actuator.kind": "torque"}),
    "tuner": Role("", "density measurement reference", "weights"),
}
"""Places in the loop that a system of the user's own may take."""

_used: "WeakSet[Any]" = WeakSet()


class Own(NamedTuple):
    """Systems, reference and law of the user that replace the scenario's."""

    systems: Mapping[str, System] = MappingProxyType({})  # by their ROLES
    reference: Trajectory | None = None  # a 6 x 1 trajectory of the pose with two derivatives
    law: OwnLaw | None = None  # changes the scenario's law
    instances: tuple[System, ...] = ()  # systems given as instances, which remain the user's
    makers: Mapping[str, Callable[[], System]] = MappingProxyType({})  # of the others

    @property
    def names(self) -> dict[str, str]:
        """Classes by role, as in `summary.json`."""
        found = {role: type(system).__name__ for role, system in self.systems.items()}
        if self.reference is not None:
            found["reference"] = type(self.reference).__name__
        if self.law is not None:
            found["law"] = getattr(self.law, "__name__", type(self.law).__name__)
        return found

    @property
    def unjudged(self) -> str | None:
        """Role of a system with unknown dynamics, which prevents a stability verdict, or None."""
        return next((role for role in ("sensor", "link") if role in self.systems), None)

    def another(self, role: str) -> System | None:
        """Return a second system of a role, None of one that was given as an instance."""
        made = self.makers[role]() if role in self.makers else None
        return None if made is self.systems[role] else made

    @property
    def pushes(self) -> bool:
        """Whether there is a disturbance with a wrench."""
        disturbance = self.systems.get("disturbance")
        return disturbance is not None and disturbance.HasOutputPort("wrench")

    def place(self, error: Exception) -> str:
        """Return the system in which an error was raised, with its output, or an empty text."""
        for frame, _ in walk_tb(error.__traceback__):
            for role, system in self.systems.items():
                if frame.f_locals.get("self") is system:
                    outputs = _sizes(map(system.get_output_port, range(system.num_output_ports())))
                    return f"in {role} {type(system).__name__}, with output {_listed(outputs)}, "
        return ""

    def claim(self, scenario: Scenario) -> None:
        """Reserve the systems for one loop of a scenario."""
        for role in self.systems:
            if found := differing(scenario, ROLES[role].accepted):
                raise ConfigError(found.problem(f"with a {role} of your own"))
        for system in self.systems.values():
            if system in _used:
                raise ConfigError(
                    f"{type(system).__name__}: got an instance that has been in a loop already; "
                    "expected a new one, or a function that makes one for every run"
                )
            _used.add(system)

    def revised(self, law: AnyLaw) -> AnyLaw:
        """Return the law to use in place of the scenario's."""
        if self.law is None:
            return law
        made, kind = self.law(law), type(law)
        if not isinstance(made, kind):
            raise ConfigError(
                f"modify_law: got a {type(made).__name__} from the function; expected a "
                f"{kind.__name__}, such as dataclasses.replace(law, ...)"
            )
        return made


NOTHING: Final = Own()
"""Nothing replaced."""


def take(given: Mapping[str, Any]) -> Own:
    """Make and check the systems of a user for one run, except the motion of the reference.

    Args:
        given: values by the names of the arguments of `simulate`, None if not given.
    """
    if unknown := given.keys() - OwnSystems.__annotations__.keys():
        raise TypeError(f"got an unexpected keyword argument {min(unknown)!r}")
    given = {name: thing for name, thing in given.items() if thing is not None}
    systems = {role: _make(role, given[role], System) for role in ROLES if role in given}
    for role, system in systems.items():
        _check(role, system)
    reference, law = given.get("reference"), given.get("modify_law")
    misfit = _misfit(law, None) if callable(law) else ""
    if law is not None and (misfit or not callable(law)):
        raise ConfigError(
            f"modify_law: got a {type(law).__name__}{misfit}; expected a function of the "
            "scenario's law"
        )
    for other in ("modify_law", "tuner"):
        if "controller" in systems and other in given:
            raise ConfigError(
                f"{other}: got one with a controller of your own; expected one of the two"
            )
    return Own(
        systems,
        None if reference is None else _make("reference", reference, Trajectory),
        law,
        tuple(given[role] for role in systems if isinstance(given[role], System)),
        {role: given[role] for role in systems if not isinstance(given[role], System)},
    )


def _make(what: str, given: Any, kind: type) -> Any:
    called = callable(given) and not isinstance(given, kind)
    misfit = _misfit(given) if called else ""
    made = given() if called and not misfit else given
    if not isinstance(made, kind):
        name = f"system with {_ports(what)}" if kind is System else "trajectory"
        other = ", or a controller's name or path" if what == "controller" else ""
        raise ConfigError(
            f"{what}: got a {type(made).__name__}{misfit}; expected a Drake {name}, or a function "
            f"without arguments that makes one, such as its class{other}"
        )
    return made


def _misfit(function: Callable[..., Any], *arguments: Any) -> str:
    """Return why a function cannot be called with these arguments, in brackets, or ''."""
    try:
        inspect.signature(function).bind(*arguments)
    except TypeError as error:
        return f" ({error})"
    except ValueError:  # of C++
        pass
    return ""


def _roles_ports(role: str) -> list[dict[str, int]]:
    """Return the sizes of the ports that a system in a role needs, may have, and offers."""
    return [{name: _SIZES[name] for name in names.split()} for names in ROLES[role][:3]]


def _ports(role: str) -> str:
    needed, optional, offered = _roles_ports(role)
    wanted = f", if wanted {_listed(optional)}" if optional else ""
    return f"inputs {_listed(needed)}{wanted}, and output {_listed(offered, ' or ')}"


def _check(role: str, system: System) -> None:
    needed, optional, offered = _roles_ports(role)
    inputs = _sizes(map(system.get_input_port, range(system.num_input_ports())))
    outputs = _sizes(map(system.get_output_port, range(system.num_output_ports())))
    found = {name: size for name, size in outputs.items() if name in offered}
    if needed.items() <= inputs.items() <= (needed | optional).items() and (
        found and found.items() <= offered.items()
    ):
        return
    raise ConfigError(
        f"{role}: {type(system).__name__}: got inputs {_listed(inputs)} and outputs "
        f"{_listed(outputs)}; expected {_ports(role)}"
    )


def _sizes(ports: Iterable[InputPort | OutputPort]) -> dict[str, int]:
    """Return the sizes of ports by name, 0 for an abstract one."""
    return {port.get_name(): port.size() for port in ports}


def _listed(sizes: Mapping[str, int], between: str = ", ") -> str:
    return between.join(f"{name} ({size})" for name, size in sizes.items()) or "none"


def own_motion(reference: Trajectory, duration: float) -> Trajectory:
    """Check a trajectory of the user and hold it after its end.

    Args:
        reference: 6 x 1, rad and m, with derivatives of order 1 and 2.
        duration: of the simulation, s.

    Returns:
        The trajectory, defined for t >= 0: the preview passes the end.
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
        except (Exception, SystemExit) as error:  # Drake raises SystemExit without a derivative
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
            f"{name}: got an end at {end:g} s with rates {rates}; expected rest at the end, or "
            f"duration <= {end:g}"
        )
    return _held_after(reference, end)


def _check_joints(name: str, reference: Trajectory, until: float) -> None:
    """Check that pose and rates have no jumps between pieces, as straight lines would."""
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
