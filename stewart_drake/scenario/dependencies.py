"""Fields of a scenario that have an effect only beside certain values of other fields.

A field that a user sets where it has no effect is refused, see `scenario.loading`. Fields that are
accepted without an effect are listed in docs/reference/scenario.md.
"""

import dataclasses
from typing import Any, Final, NamedTuple

from stewart_drake.files.schema import spelling
from stewart_drake.files.yamlio import brief
from stewart_drake.scenario.config import Scenario


class Needs(NamedTuple):
    """One row of `NEEDS`.

    Attributes:
        fields: names, dotted, as in files.
        other: field that decides whether these have an effect.
        accepted: values of `other` with which they have; of a list, items.
    """

    fields: tuple[str, ...]
    other: str
    accepted: tuple[Any, ...]

    def met(self, value: Any) -> bool:
        """Return whether the fields have an effect beside this value, of which a list has some."""
        return (
            not {*value}.isdisjoint(self.accepted)
            if isinstance(value, list)
            else value in self.accepted
        )


_TORQUE_LAW: Final = (
    *("integral", "integral_weight", "prediction", "model", "weight_scaling", "w_Q", "w_R"),
    *("packet_torques", "packet_repeats", "open_loop_start"),
)
_FILTER: Final = (
    *("prior.torque_bias", "prior.payload", "prior.damping", "prior.rates", "prior.offsets"),
)


def _of_controller(*names: str) -> tuple[str, ...]:
    return tuple(f"controller.{name}" for name in names)


NEEDS: Final = (
    Needs(_of_controller("integral_weight"), "controller.integral", (True,)),
    Needs(_of_controller(*_FILTER), "controller.estimate", ("torque_bias",)),
    Needs(_of_controller("prior.rates"), "sensor.kind", ("encoders",)),
    Needs(_of_controller("prior.offsets"), "controller.estimate", ("offsets",)),
    Needs(
        _of_controller("delay_std", "delay_max", "replan"),
        "controller.delay_estimator",
        ("constant", "drifting"),
    ),
    Needs(_of_controller("w_Q", "w_R"), "tuner.kind", ("fixed", "ann")),
    Needs(_of_controller(*_TORQUE_LAW), "controller.command", ("torque",)),
    Needs(_of_controller("catch_up", "open_loop_start"), "start", ("rest",)),
)
"""Which field needs which value of another one."""


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


def idle_fields(scenario: Scenario) -> list[Idle]:
    """Return the fields that are set without an effect.

    A value that switches something off, 0 or false, is none of them.
    """
    found = []
    for row in NEEDS:
        place = _place(scenario, row.other)
        assert place is not None  # every section has such a field
        got = getattr(*place)
        if row.met(got):
            continue
        for field in row.fields:
            owner_and_name = _place(scenario, field)
            if owner_and_name is None:
                continue
            value, usual = getattr(*owner_and_name), _default(*owner_and_name)
            if value == usual or value in (0, None):
                continue
            accepted = " or ".join(map(_spelled, row.accepted))
            problem = (
                f"{field}: got {_spelled(value)} with {row.other} {_spelled(got)}, where it has no "
                f"effect; expected {_spelled(usual)}, or {row.other} {accepted}"
            )
            found.append(Idle(field, row.other, problem))
    return found


def reset(scenario: Scenario, field: str) -> None:
    """Set a field to its default."""
    place = _place(scenario, field)
    assert place is not None
    setattr(*place, _default(*place))


def _place(scenario: Scenario, path: str) -> tuple[Any, str] | None:
    """Return the section that holds a field and the field's name in it, None if there is none."""
    owner: Any = None
    name, inner = "", scenario
    for part in path.split("."):
        names = {spelling(type(inner), f.name): f.name for f in dataclasses.fields(inner)}
        if part not in names:
            return None
        owner, name = inner, names[part]
        inner = getattr(owner, name)
        if not dataclasses.is_dataclass(inner):
            break
    return (owner, name) if spelling(type(owner), name) == path.split(".")[-1] else None


def _default(owner: Any, name: str) -> Any:
    found = next(f for f in dataclasses.fields(owner) if f.name == name)
    factory: Any = found.default_factory
    if factory is not dataclasses.MISSING:
        return factory()
    # pydantic keeps the default of a field with an alias in its own description
    default = found.default
    return getattr(default, "default", default)


def _spelled(value: Any) -> str:
    """Return a value as in a file."""
    if isinstance(value, list):
        return f"[{', '.join(map(_spelled, value))}]"
    words = {"True": "true", "False": "false", "None": "null"}
    return words.get(repr(value), brief(value))
