"""Tables of the fields of a scenario that go together.

A field that a user sets where it has no effect is refused, see `scenario.loading`. Fields that are
accepted without an effect are listed in docs/reference/scenario.md.
"""

import functools
from collections.abc import Mapping
from typing import Any, Final, NamedTuple

from stewart_drake.files.yamlio import brief

Accepted = Mapping[str, Any]
"""Accepted value by field, dotted as in files; a tuple holds several; a list has one as an item."""


class Requires(NamedTuple):
    """Row of `REQUIRES`: where `field` has a value, `other` is to have an accepted one."""

    field: str
    value: Any
    other: str
    accepted: Any
    hint: str = ""
    """End of the message; that another value of `field` will do, if empty."""


_DELAYS: Final = ("constant", "drifting")
REQUIRES: Final = (
    Requires("controller.delay_steps", None, "controller.delay_fraction", None),
    Requires("controller.prediction", "linear", "controller.delay_estimator", "none"),
    Requires("controller.delay_estimator", _DELAYS, "sensor.delay", 0.0),
    Requires("controller.estimate", [], "controller.delay_estimator", "none"),
    Requires("controller.estimate", "offsets", "sensor.kind", "encoders"),
    Requires("controller.estimate", "offsets", "controller.delay_estimator", "none"),
    Requires("controller.model", "multibody", "controller.torque_map", "virtual_work"),
    Requires("controller.command", "cranks", "actuator.kind", "servo"),
    Requires("controller.command", "cranks", "link.kind", "wire"),
    Requires("controller.command", "cranks", "tuner.kind", "fixed"),
    Requires("controller.command", "cranks", "controller.delay_estimator", "none"),
    Requires(
        "actuator.kind",
        "servo",
        "controller.command",
        "cranks",
        ", as of the controllers servo_preview and servo_feedforward",
    ),
    Requires("plant.kind", "paper", "plant.gravity", False),
    Requires("plant.kind", "paper", "plant.payload_mass", 0.0),
    Requires("plant.kind", "paper", "plant.joint_damping", 0.0),
    Requires("plant.kind", "paper", "plant.coulomb_friction", 0.0),
    Requires("plant.kind", "paper", "sensor.kind", "state"),
    Requires("plant.kind", "paper", "actuator.kind", "torque"),
    Requires("link.kind", "network", "controller.delay_estimator", "none"),
    Requires(
        "link.kind",
        "network",
        "controller.delay_steps",
        (None, 0),
        ": the play-out bound sets the delay, and 0 is a controller without one",
    ),
)
"""Values that are refused unless another field has an accepted one."""


class Needs(NamedTuple):
    """Row of `NEEDS`: without an accepted value of `other` the `fields` have no effect."""

    fields: tuple[str, ...]
    other: str
    accepted: Any


_TORQUE_LAW: Final = (
    *("integral", "integral_weight", "prediction", "model", "weight_scaling", "w_Q", "w_R"),
    *("packet_torques", "packet_repeats", "open_loop_start"),
)
_ANY: Final = ("torque_bias", "payload", "damping", "coulomb", "offsets")


def _of_controller(*names: str) -> tuple[str, ...]:
    return tuple(f"controller.{name}" for name in names)


_DELAY: Final = _of_controller("delay_std", "delay_max", "replan")
NEEDS: Final = (
    Needs(_of_controller("integral_weight"), "controller.integral", True),
    Needs(_of_controller("prior.torque_bias"), "controller.estimate", "torque_bias"),
    Needs(_of_controller("prior.payload"), "controller.estimate", "payload"),
    Needs(_of_controller("prior.damping"), "controller.estimate", "damping"),
    Needs(_of_controller("prior.rates"), "controller.estimate", _ANY),
    Needs(_of_controller("prior.rates"), "sensor.kind", "encoders"),
    Needs(_of_controller("prior.offsets"), "controller.estimate", "offsets"),
    Needs(_DELAY, "controller.delay_estimator", _DELAYS),
    Needs(_of_controller("w_Q", "w_R"), "tuner.kind", ("fixed", "ann")),
    Needs(_of_controller(*_TORQUE_LAW), "controller.command", "torque"),
    Needs(_of_controller("catch_up", "open_loop_start"), "start", "rest"),
)
"""Fields that have an effect only with certain values of another field."""


class Differing(NamedTuple):
    """A field that has no accepted value."""

    field: str
    got: Any
    accepted: Any

    def problem(self, condition: str = "", hint: str = "") -> str:
        """Return the value, under which condition, and what is accepted, in one line."""
        got = f"{_spelled(self.got)} {condition}".rstrip()
        return f"{self.field}: got {got}; expected {_choice(self.accepted)}{hint}"


def differing(scenario: Any, accepted: Accepted) -> Differing | None:
    """Return the first field of a scenario that has no accepted value, or None."""
    for field, values in accepted.items():
        if (place := _place(scenario, field)) and not _is_one(got := getattr(*place), values):
            return Differing(field, got, values)
    return None


def contradiction(scenario: Any) -> str | None:
    """Return the first row of `REQUIRES` that a scenario breaks, as a message, or None."""
    for row in REQUIRES:
        asked = differing(scenario, {row.field: row.value}) is None
        if asked and (found := differing(scenario, {row.other: row.accepted})):
            value = _spelled(getattr(*_existing(scenario, row.field)))
            hint = row.hint or f", or another {row.field}"
            return found.problem(f"with {row.field} {value}", hint)
    return None


class Idle(NamedTuple):
    """A field that is not at its default and has no effect.

    Attributes:
        field: its name, dotted, as in files.
        other: field whose value makes it so.
        problem: both and what is accepted, in one line.
    """

    field: str
    other: str
    problem: str


def idle_fields(scenario: Any) -> list[Idle]:
    """Return the fields that are set without an effect.

    A value that switches something off, 0 or false, is none of them.
    """
    found = []
    for row in NEEDS:
        unmet = differing(scenario, {row.other: row.accepted})
        for field in row.fields if unmet else ():
            if (place := _place(scenario, field)) is None:
                continue
            value, usual = getattr(*place), _default(*place)
            if unmet and value != usual and value not in (0, None):
                problem = (
                    f"{field}: got {_spelled(value)} with {row.other} {_spelled(unmet.got)}, where "
                    f"it has no effect; expected {_spelled(usual)}, or {row.other} "
                    f"{_choice(row.accepted)}"
                )
                found.append(Idle(field, row.other, problem))
    return found


def reset(scenario: Any, field: str) -> None:
    """Set a field to its default."""
    section, name = _existing(scenario, field)
    setattr(section, name, _default(section, name))


def _place(scenario: Any, path: str) -> tuple[Any, str] | None:
    """Return the section that holds a field and the field's name in it, None if there is none."""
    *above, name = path.split(".")
    section = functools.reduce(getattr, above, scenario)
    return (section, name) if hasattr(section, name) else None


def _existing(scenario: Any, path: str) -> tuple[Any, str]:
    place = _place(scenario, path)
    assert place is not None, path
    return place


def _default(section: Any, name: str) -> Any:
    return getattr(type(section)(), name)


def _choice(accepted: Any) -> str:
    several = accepted if isinstance(accepted, tuple) else (accepted,)
    return " or ".join(map(_spelled, several))


def _is_one(value: Any, accepted: Any) -> bool:
    several = accepted if isinstance(accepted, tuple) else (accepted,)
    items = value if isinstance(value, list) else ()
    return value in several or any(item in several for item in items)


def _spelled(value: Any) -> str:
    """Return a value as in a file."""
    if isinstance(value, list):
        return f"[{', '.join(map(_spelled, value))}]"
    words = {"True": "true", "False": "false", "None": "null"}
    return words.get(repr(value), brief(value))
