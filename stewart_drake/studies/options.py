"""Options of a study, declared once: field, unit and meaning, default, command-line form.

The command line, the Python signature and the command that a page names follow from them.
"""

import functools
import inspect
import re
import textwrap
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, Any, Final, NamedTuple, TypeVar

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from stewart_drake.files.errors import ConfigError
from stewart_drake.files.yamlio import explain

if TYPE_CHECKING:
    from stewart_drake.scenario.config import Scenario

_R = TypeVar("_R")

RENAMED: Final = {"beside": "also"}
"""Options of 0.2, with their present names."""


def option(
    default: Any,
    help: str,
    metavar: str | None = None,
    *,
    name: str = "",
    read: "Callable[[list[str], Callable[[str], Scenario]], Any] | None" = None,
    recorded: bool = True,
    unit: str | None = None,
    **bounds: Any,
) -> Any:
    """Return the field of an option that the command line has too, see `Option`.

    The default is `...` for none; `name` is that on the command line, if it differs from the
    field's; bounds are those of `pydantic.Field`.
    """
    extra: Any = {"flag": name, "metavar": metavar, "read": read, "recorded": recorded}
    extra["unit"] = unit
    return Field(default, description=help, json_schema_extra=extra, **bounds)


_UNITS: Final[Mapping[str, Mapping[str, float]]] = {
    "m": {"mm": 1e-3, "cm": 1e-2, "m": 1.0},
    "kg": {"g": 1e-3, "kg": 1.0},
    "s": {"ms": 1e-3, "s": 1.0},
    "N m": {"mN m": 1e-3, "N m": 1.0},
}


def quantity(name: str, text: str, unit: str) -> float:
    """Return a text such as `300 mm`, `0.3 m` or `0.3` in a unit: m, kg, s or N m."""
    number, word = re.fullmatch(
        r"\s*(.*?)\s*((?:[^\W\d_]+ )*[^\W\d_]*)\s*", text, re.DOTALL
    ).groups()  # type: ignore[union-attr]
    together = {name.replace(" ", ""): factor for name, factor in _UNITS[unit].items()}  # 6 Nm
    factor = {**together, **_UNITS[unit]}.get(word.strip() or unit)
    try:
        value = float(number)
    except ValueError:
        factor = None
    if factor is None:
        smallest = next(iter(_UNITS[unit]))
        size = f"{0.3 / _UNITS[unit][smallest]:g}"
        raise ConfigError(
            f"{name}: got {text!r}; expected a number with {', '.join(_UNITS[unit])} or without, "
            f"such as {size} {smallest} or 0.3 {unit}; without a unit it is in {unit}"
        )
    return float(f"{value * factor:.15g}")


class MissingOption(ConfigError):
    """An option is missing, and all given ones are right."""


class Option(NamedTuple):
    name: str  # of the field and of the Python argument
    annotation: Any  # of the Python argument
    default: Any  # in both; `inspect.Parameter.empty` for none
    help: str  # unit and meaning
    # name on the command line if it is another one, or empty; None for an option of Python only
    flag: str | None = None
    metavar: str | None = None  # shown there in place of the value
    # makes the value from the texts of a repeatable option. Its second argument loads the scenario
    # with another controller.
    read: "Callable[[list[str], Callable[[str], Scenario]], Any] | None" = None
    recorded: bool = True  # whether the command on a page contains the option
    unit: str | None = None  # of the value; a text such as `300 mm` is accepted too, see `quantity`

    @property
    def required(self) -> bool:
        return self.default is inspect.Parameter.empty

    @property
    def accepted(self) -> Any:
        """Type of the Python argument, which also takes texts as of the command line."""
        texts = Sequence[str] if self.read else str
        return texts | self.annotation if self.read or self.unit else self.annotation

    @property
    def dashed(self) -> str:
        """Name on the command line, without the dashes before it."""
        return (self.flag or self.name).replace("_", "-")


class Options(BaseModel):
    """Base class of the options of a study; wrong values raise ConfigError."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    def __init__(self, **values: Any) -> None:
        for one in type(self).described():
            if one.unit and isinstance(values.get(one.name), str):
                values[one.name] = quantity(one.name, values[one.name], one.unit)
        try:
            super().__init__(**values)
        except ValidationError as caught:
            errors = caught.errors(include_url=False)
            wrong = [error for error in errors if error["type"] != "missing"]
            kind = ConfigError if wrong else MissingOption
            first = (wrong or errors)[0]
            units = {one.name: one.unit for one in type(self).described() if one.unit and wrong}
            unit = units.get(str(first["loc"][0]), "")
            raise kind(f"{explain(values, first)} {unit}".rstrip()) from None

    def check_scenario(self, scenario: "Scenario") -> None:
        """Refuse a scenario that the study does not cover."""

    @classmethod
    def described(cls) -> Iterator[Option]:
        """Yield all options; those that pages do not record come last."""
        found = []
        for name, field in cls.model_fields.items():
            extra: Any = dict(field.json_schema_extra or {})  # type: ignore[arg-type]
            default = inspect.Parameter.empty if field.is_required() else field.default
            found.append(Option(name, field.annotation, default, field.description or "", **extra))
        yield from sorted(found, key=lambda option: not option.recorded)


def in_python(text: str, kind: type[Options], function: inspect.Signature) -> str:
    """Return a text with arguments of a Python function in place of the command's options."""
    names = {f"--{name}": name for name in function.parameters}
    names |= {f"--{one.dashed}": one.name for one in kind.described()}
    names |= {"SCENARIO": "scenario", "WEIGHTS": "networks", "--set": "the setting"}
    pattern = r"--[a-z]+(?:-[a-z]+)*|[A-Z]{4,}"
    return re.sub(pattern, lambda found: names.get(found[0], found[0]), text)


def takes(
    kind: type[Options], second: str = ""
) -> Callable[[Callable[..., _R]], Callable[..., _R]]:
    """Return a decorator that replaces the argument `options` of a function by its options.

    The argument `second` may be positional. Errors name arguments, see `in_python`. An option may
    also have its name of the command line.
    """
    by_place, by_name = inspect.Parameter.POSITIONAL_OR_KEYWORD, inspect.Parameter.KEYWORD_ONLY

    def decorate(function: Callable[..., _R]) -> Callable[..., _R]:
        own = inspect.signature(function)
        parameters = [one for one in own.parameters.values() if one.name != "options"]
        parameters += [
            inspect.Parameter(one.name, by_name, default=one.default, annotation=one.accepted)
            for one in kind.described()
        ]
        parameters = [p.replace(kind=by_place) if p.name == second else p for p in parameters]
        shown = own.replace(parameters=sorted(parameters, key=lambda one: one.kind))
        flags = {one.flag: one.name for one in kind.described() if one.flag}

        @functools.wraps(function)
        def call(*args: Any, **kwargs: Any) -> _R:
            if "options" in kwargs:  # of a command, whose errors name its options
                return function(*args, **kwargs)
            for old in RENAMED.keys() & kwargs.keys():
                raise TypeError(
                    f"{function.__name__}: got {old}, an option of 0.2; expected {RENAMED[old]}"
                )
            if "settings" in shown.parameters and any(map(_is_settings, args[1:2])):
                raise TypeError(
                    f"{function.__name__}: got {args[1]} without a name; expected "
                    f"settings={args[1]}"
                )
            for flag in flags.keys() & kwargs.keys():
                if flags[flag] not in kwargs:
                    kwargs[flags[flag]] = kwargs.pop(flag)
            try:
                given = shown.bind(*args, **kwargs).arguments
            except TypeError as error:
                raise TypeError(f"{function.__name__}: {error}") from None
            values = {name: given.pop(name) for name in kind.model_fields if name in given}
            load = functools.partial(_load, given.get("scenario"), given.get("settings", ()))
            try:
                for one in kind.described():
                    texts = values.get(one.name)
                    if one.read and isinstance(texts, str | list | tuple):
                        texts = [texts] if isinstance(texts, str) else map(str, texts)
                        values[one.name] = one.read(list(texts), load)
                return function(**given, options=kind(**values))
            except ConfigError as error:
                raise ConfigError(in_python(str(error), kind, shown)) from None

        call.__signature__ = shown  # type: ignore[attr-defined]
        meanings = [f"{one.name}: {in_python(one.help, kind, shown)}" for one in kind.described()]
        wrap = textwrap.TextWrapper(96, initial_indent=" " * 4, subsequent_indent=" " * 8)
        lines = "\n".join(map(wrap.fill, meanings))
        call.__doc__ = inspect.cleandoc(function.__doc__ or "").replace("    OPTIONS", lines)
        return call

    return decorate


def _is_settings(value: Any) -> bool:
    return isinstance(value, list | tuple) and any("=" in str(one) for one in value)


def _load(scenario: Any, settings: Any, controller: str) -> "Scenario":
    from stewart_drake.scenario.loading import load_compatible

    return load_compatible(scenario, controller, settings)


def refuse(options: Mapping[str, object], why: str) -> None:
    """Refuse options that would be ignored, unless they are None or an empty list."""
    for name, value in options.items():
        if value is not None and value != []:
            raise ConfigError(f"{name}: got {value} {why}")


class JobOptions(Options):
    """Options of a study whose runs go to several processes."""

    workers: int | None = option(
        None, "Number of processes; all cores by default.", "N", recorded=False, ge=1
    )
    scheduler: str | None = option(
        None, "Address of a Dask scheduler to run on.", "ADDRESS", recorded=False
    )

    @property
    def jobs(self) -> dict[str, Any]:
        return {"workers": self.workers, "scheduler": self.scheduler}
