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

_DELAYS: Final = ("constant", "drifting")
ESTIMABLE: Final = (
    *("torque_bias", "payload", "damping", "payload_position", "coulomb", "wrench", "offsets"),
)
"""Names of `controller.estimate`, in their order."""
REQUIRES: Final[tuple[tuple[str, Any, Accepted], ...]] = (
    ("controller.delay_steps", None, {"controller.delay_fraction": None}),
    ("controller.prediction", "linear", {"controller.delay_estimator": "none"}),
    ("controller.delay_estimator", _DELAYS, {"sensor.delay": 0.0, "controller.learned": None}),
    ("controller.estimate", [], {"controller.delay_estimator": "none"}),
    (
        *("controller.estimate", "offsets"),
        {"sensor.kind": "encoders", "controller.delay_estimator": "none"},
    ),
    ("controller.estimate", "wrench", {"plant.kind": ("multibody", "exact")}),
    ("controller.model", "multibody", {"controller.torque_map": "virtual_work"}),
    (
        *("controller.command", "cranks"),
        {
            "actuator.kind": ("servo", "position_servo"),
            "tuner.kind": "fixed",
            "controller.delay_estimator": "none",
        },
    ),
    ("actuator.kind", ("servo", "position_servo"), {"controller.command": "cranks"}),
    ("actuator.kind", "servo", {"link.kind": "wire", "controller.learned": None}),
    (
        *("actuator.kind", "position_servo"),
        {"plant.kind": "exact", "plant.joint_damping": 0.0, "plant.coulomb_friction": 0.0},
    ),
    (
        *("plant.kind", ("multibody", "paper")),
        {"plant.ball_joint_damping": 0.0, "plant.ball_joint_friction": 0.0},
    ),
    (
        *("controller.limits", "qp"),
        {
            "controller.kind": "lqi",
            "controller.command": "torque",
            "controller.prediction": "nonlinear",
            "controller.feedforward": "inverse_dynamics",
            "controller.model": "multibody",
            "controller.delay_estimator": "none",
            "controller.learned": None,
            "plant.kind": ("multibody", "exact"),
        },
    ),
    ("tuner.kind", ("ann", "rule"), {"controller.learned": None}),
    (
        *("plant.kind", "paper"),
        {
            "plant.gravity": False,
            "plant.payload_mass": 0.0,
            "plant.joint_damping": 0.0,
            "plant.coulomb_friction": 0.0,
            "plant.push.wrench": [0.0] * 6,
            "sensor.kind": "state",
            "actuator.kind": "torque",
            "controller.learned": None,
        },
    ),
    (
        *("link.kind", "network"),
        {
            "controller.delay_estimator": "none",
            "controller.delay_steps": (None, 0),
            "controller.learned": None,
        },
    ),
)
"""Where the first field has the value, other fields must have accepted ones."""
_HINTS: Final[dict[str | tuple[str, str], str]] = {
    "controller.command": ", as of the controllers servo_preview and servo_feedforward",
    ("actuator.kind", "plant.joint_damping"): "; the servos have their own, actuator.crank_damping",
    ("actuator.kind", "plant.coulomb_friction"): "; the servos have their own, actuator.friction",
    ("link.kind", "controller.delay_estimator"): ", as of the controller predictor_lqi, or "
    "link.kind 'wire': the play-out bound sets the delay",
    ("controller.delay_steps", "controller.delay_fraction"): ", or a number in "
    "controller.delay_steps",
    "controller.delay_steps": ": the play-out bound sets the delay, and 0 is a controller without "
    "one",
}
"""End of a message about a field of REQUIRES, with or without the first field; by default another
value of the first field."""


class Needs(NamedTuple):
    """Row of `NEEDS`: without an accepted value of `other` the `names` have no effect.

    Except where a delay is estimated, for a row with `known_delay`.
    """

    names: str  # of fields of the controller
    other: str
    accepted: Any
    known_delay: bool = False

    @property
    def fields(self) -> list[str]:
        return [f"controller.{name}" for name in self.names.split()]


NEEDS: Final = (
    Needs("kp kd", "controller.kind", "pd"),
    Needs("integral integral_weight weight_scaling w_Q w_R", "controller.kind", "lqi"),
    Needs("integral_weight", "controller.integral", True),
    Needs("prior.torque_bias", "controller.estimate", "torque_bias"),
    Needs("prior.payload", "controller.estimate", "payload"),
    Needs("prior.payload_position", "controller.estimate", "payload_position"),
    Needs("prior.damping", "controller.estimate", "damping"),
    Needs("prior.rates model_error timing_std", "controller.estimate", ESTIMABLE),
    Needs("prior.rates", "sensor.kind", "encoders"),
    Needs("timing_std", "controller.command", "torque"),
    Needs("prior.offsets", "controller.estimate", "offsets"),
    Needs("prior.wrench prior.wrench_walk", "controller.estimate", "wrench"),
    Needs("horizon", "controller.limits", "qp"),
    Needs("delay_std delay_max", "controller.delay_estimator", _DELAYS),
    Needs("w_Q w_R", "tuner.kind", ("fixed", "ann")),
    Needs(
        "kind kp kd integral integral_weight prediction model weight_scaling w_Q w_R "
        "packet_torques packet_repeats open_loop_start replan limits",
        "controller.command",
        "torque",
    ),
    Needs("catch_up open_loop_start", "start", "rest"),
    Needs("replan", "link.kind", "wire", known_delay=True),
    Needs("replan", "controller.estimate", ESTIMABLE, known_delay=True),
    Needs("replan", "controller.limits", "ignore"),
)
"""Fields that have an effect only with certain values of another field."""


class Differing(NamedTuple):
    """A field without an accepted value."""

    field: str
    got: Any
    accepted: Any

    def problem(self, condition: str = "", hint: str = "") -> str:
        """Return value, condition and accepted values, in one line."""
        got = f"{_spelled(self.got)} {condition}".rstrip()
        return f"{self.field}: got {got}; expected {_choice(self.accepted)}{hint}"


def differing(scenario: Any, accepted: Accepted) -> Differing | None:
    """Return the first field of a scenario without an accepted value, or None."""
    for field, values in accepted.items():
        if (place := _place(scenario, field)) and not _is_one(got := getattr(*place), values):
            return Differing(field, got, values)
    return None


def contradiction(scenario: Any) -> str | None:
    """Return the first row of `REQUIRES` that a scenario breaks, as a message, or None."""
    for field, value, accepted in REQUIRES:
        applies = differing(scenario, {field: value}) is None
        if applies and (found := differing(scenario, accepted)):
            place = _place(scenario, field)
            assert place is not None
            condition = f"with {field} {_spelled(getattr(*place))}"
            usual = _HINTS.get(found.field, f", or another {field}")
            return found.problem(condition, _HINTS.get((field, found.field), usual))
    return None


class Idle(NamedTuple):
    """A field that is not at its default and has no effect."""

    field: str  # dotted name, as in files
    other: str  # field that makes it so
    problem: str  # both, and the accepted values, in one line


def idle_fields(scenario: Any) -> list[Idle]:
    """Return the fields that are set without an effect, except to 0, false or null."""
    found = []
    for row in NEEDS:
        if not (unmet := differing(scenario, {row.other: row.accepted})):
            continue
        if row.known_delay and not differing(scenario, {"controller.delay_estimator": _DELAYS}):
            continue
        for field in row.fields:
            if (place := _place(scenario, field)) is None:
                continue
            value, usual = getattr(*place), _default(*place)
            if value != usual and value not in (0, None):
                problem = (
                    f"{field}: got {_spelled(value)} with {row.other} {_spelled(unmet.got)}, where "
                    f"it has no effect; expected {_spelled(usual)}, or {row.other} "
                    f"{_choice(row.accepted)}"
                )
                found.append(Idle(field, row.other, problem))
    return found


def reset_idle(scenario: Any) -> None:
    """Set the fields without an effect to their defaults."""
    for idle in idle_fields(scenario):
        if place := _place(scenario, idle.field):
            setattr(*place, _default(*place))


def _place(scenario: Any, path: str) -> tuple[Any, str] | None:
    """Return the section that holds a field and the field's name in it, None if there is none."""
    *above, name = path.split(".")
    section = functools.reduce(getattr, above, scenario)
    return (section, name) if hasattr(section, name) else None


def _default(section: Any, name: str) -> Any:
    return getattr(type(section)(), name)


def _choice(accepted: Any) -> str:
    return " or ".join(map(_spelled, accepted if isinstance(accepted, tuple) else (accepted,)))


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
