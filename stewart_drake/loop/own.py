"""What of a loop is the user's own: systems, a trajectory, a law, checked at the border."""

from collections.abc import Callable, Iterable, Mapping
from types import MappingProxyType
from typing import Any, Final, NamedTuple, TypeVar
from weakref import WeakSet

from pydrake.systems.framework import InputPort, OutputPort, PortDataType, System
from pydrake.trajectories import Trajectory

from stewart_drake.files.errors import ConfigError
from stewart_drake.law.predictive_lqi import PredictiveLqi
from stewart_drake.law.servo_preview import ServoPreview
from stewart_drake.scenario.signals import (
    NUM_REFERENCE,
    NUM_STATE,
    NUM_TORQUES,
    TUNER_INPUTS,
    WEIGHTS,
)

OwnSystem = System | Callable[[], System]
"""A system, which serves one run, or what makes one, such as its class."""
OwnReference = Trajectory | Callable[[], Trajectory]
OwnLaw = Callable[[Any], Any]
"""Takes the law that the scenario asks for, a `PredictiveLqi`, or `ServoPreview` for servos;
returns the one to be used, of that class."""
AnyLaw = TypeVar("AnyLaw", PredictiveLqi, ServoPreview)


class Role(NamedTuple):
    """What a system needs to take a place in the loop: its ports and their sizes."""

    inputs: Mapping[str, int]
    """That it must have."""
    may: Mapping[str, int]
    """Inputs that it may have."""
    outputs: Mapping[str, int]
    """Of which it has one at least."""


ROLES: Final[Mapping[str, Role]] = MappingProxyType(
    {
        "controller": Role(
            {"measurement": NUM_STATE}, {"reference": NUM_REFERENCE}, {"torque": NUM_TORQUES}
        ),
        "disturbance": Role({}, {}, {"torque": NUM_TORQUES, "wrench": 6}),
        "sensor": Role({"state": NUM_STATE}, {}, {"measurement": NUM_STATE}),
        "link": Role({"commanded": NUM_TORQUES}, {}, {"torque": NUM_TORQUES}),
        "tuner": Role(
            {},
            {
                "density": len(TUNER_INPUTS),
                "measurement": NUM_STATE,
                "reference": NUM_REFERENCE,
            },
            {"weights": len(WEIGHTS)},
        ),
    }
)
"""Places in the loop that a system of the user's own may take."""

_used: "WeakSet[Any]" = WeakSet()


class Own(NamedTuple):
    """What of a loop is the user's own; the scenario's is used for all else.

    Attributes:
        systems: by their ROLES.
        reference: a 6 x 1 trajectory of the pose with two derivatives.
        law: makes another law of the scenario's.
        instances: those of the systems that were given as such, and stay the user's.
    """

    systems: Mapping[str, System] = MappingProxyType({})
    reference: Trajectory | None = None
    law: OwnLaw | None = None
    instances: tuple[System, ...] = ()

    @property
    def names(self) -> dict[str, str]:
        """What each is, as `summary.json` tells it."""
        found = {role: type(system).__name__ for role, system in self.systems.items()}
        if self.reference is not None:
            found["reference"] = type(self.reference).__name__
        if self.law is not None:
            found["law"] = getattr(self.law, "__name__", type(self.law).__name__)
        return found

    @property
    def unjudged(self) -> str | None:
        """Whose dynamics nobody knows, so that no stability of the loop can be told, or None."""
        return next(
            (role for role in ("controller", "sensor", "link") if role in self.systems), None
        )

    def claim(self) -> None:
        """Note that the systems now belong to a loop.

        Raises:
            ConfigError: one of them belongs to another one.
        """
        for system in self.systems.values():
            if system in _used:
                raise ConfigError(
                    f"{type(system).__name__}: got an instance that has been in a loop already; "
                    "expected a new one, or a function that makes one for every run"
                )
            _used.add(system)

    def revised(self, law: AnyLaw) -> AnyLaw:
        """The law to be used in the place of the scenario's.

        Raises:
            ConfigError: the user's function returned something else.
        """
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
"""All is the scenario's."""


def take(given: Mapping[str, Any]) -> Own:
    """What a user gave for one run, made and checked, the reference's motion excepted.

    Args:
        given: by the name of its argument in `simulate`; None is nothing.

    Raises:
        ConfigError: one line.
    """
    given = {name: thing for name, thing in given.items() if thing is not None}
    systems = {role: _make(role, given[role], System) for role in ROLES if role in given}
    for role, system in systems.items():
        _check(role, system)
    reference, law = given.get("reference"), given.get("modify_law")
    if law is not None and not callable(law):
        raise ConfigError(
            f"modify_law: got a {type(law).__name__}; expected a function of the scenario's law"
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
    )


def _make(what: str, given: Any, kind: type) -> Any:
    made = given if isinstance(given, kind) or not callable(given) else given()
    if not isinstance(made, kind):
        name = "Drake system" if kind is System else "Drake trajectory"
        raise ConfigError(
            f"{what}: got a {type(made).__name__}; expected a {name}, or a function that makes one"
        )
    return made


def _check(role: str, system: System) -> None:
    """Whether the ports fit; the user's system is no longer needed where they do not."""
    needed, name = ROLES[role], f"{role}: {type(system).__name__}"
    inputs = _ports(system.get_input_port, system.num_input_ports())
    outputs = _ports(system.get_output_port, system.num_output_ports())
    must, may = (
        ", ".join(f"{port} ({size})" for port, size in ports.items())
        for ports in (needed.inputs, needed.may)
    )
    known = " and, if wanted, ".join(filter(None, (must, may))) or "none"
    sizes = {**needed.inputs, **needed.may}
    for port in inputs:
        if port not in sizes:
            raise ConfigError(f"{name}: got an input port {port!r}; expected {known}")
        _check_size(name, "input", inputs[port], sizes[port])
    for port in needed.inputs:
        if port not in inputs:
            raise ConfigError(f"{name}: got no input port {port!r}; expected {known}")
    found = [port for port in needed.outputs if port in outputs]
    if not found:
        wanted = " or ".join(f"{port!r} ({size})" for port, size in needed.outputs.items())
        raise ConfigError(f"{name}: got {_list(outputs)}; expected an output port {wanted}")
    for port in found:
        _check_size(name, "output", outputs[port], needed.outputs[port])


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
