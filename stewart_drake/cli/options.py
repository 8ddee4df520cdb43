"""Command-line parameters that follow from the options of a study."""

import contextlib
import inspect
from collections.abc import Callable, Collection, Mapping
from typing import Annotated, Any

import typer

from stewart_drake.cli.common import named
from stewart_drake.scenario.config import Scenario
from stewart_drake.studies.options import Option, Options


class Given:
    """Options that a command was called with.

    Args:
        kind: class of the options.
        typed: values by the option's name on the command line, None for what is missing.
    """

    def __init__(self, kind: type[Options], typed: Mapping[str, Any]) -> None:
        self._kind, self._typed = kind, typed

    @property
    def missing(self) -> list[Option]:
        return [one for one in _offered(self._kind) if one.required and one.name not in self.given]

    @property
    def words(self) -> dict[str, Any]:
        """Typed values for the command on a page."""
        return {one.dashed: self._typed[_name(one)] for one in _offered(self._kind, True)}

    @property
    def given(self) -> dict[str, Any]:
        """Typed values by field, without those that were not given."""
        offered = ((one, self._typed[_name(one)]) for one in _offered(self._kind))
        return {one.name: value for one, value in offered if value is not None}

    def options(
        self,
        load: Callable[[str], Scenario] | None = None,
        more: Mapping[str, Any] | None = None,
    ) -> Any:
        """Return the options.

        Args:
            load: loads the scenario with another controller.
            more: values by field, which replace typed ones.
        """
        with self.named():
            values = {one.name: self._value(one, load) for one in _offered(self._kind)}
            values = {name: value for name, value in values.items() if value is not None}
            return self._kind(**(values | dict(more or {})))

    def named(self) -> contextlib.AbstractContextManager[None]:
        """Replace the name of a field in an error by the option that sets it."""
        return named(**{one.name: f"--{one.dashed}" for one in _offered(self._kind)})

    def _value(self, one: Option, load: Any) -> Any:
        typed = self._typed[_name(one)]
        if one.read is None:
            return typed
        return one.read(typed, load) if typed else one.default


def with_options(
    kind: type[Options], without: Collection[str] = ()
) -> Callable[[Callable[..., int]], Callable[..., int]]:
    """Return a decorator that replaces the argument `given` of a command by options.

    Args:
        kind: class of the options.
        without: arguments that the command does not offer; they keep their defaults.
    """

    def decorate(command: Callable[..., int]) -> Callable[..., int]:
        shown: list[inspect.Parameter] = []
        for one in inspect.signature(command).parameters.values():
            if one.name == "given":
                shown += map(_parameter, _offered(kind))
            elif one.name not in without:
                shown.append(one.replace(kind=inspect.Parameter.KEYWORD_ONLY))
        names = [_name(one) for one in _offered(kind)]

        def run(**typed: Any) -> int:
            given = Given(kind, {name: typed.pop(name) for name in names})
            return command(**typed, given=given)

        run.__name__, run.__doc__, run.__annotations__ = command.__name__, command.__doc__, {}
        run.__signature__ = inspect.Signature(shown)  # type: ignore[attr-defined]
        return run

    return decorate


def _offered(kind: type[Options], recorded: bool = False) -> list[Option]:
    return [one for one in kind.described() if one.flag and (one.recorded or not recorded)]


def _parameter(one: Option) -> inspect.Parameter:
    annotation, default, name = one.annotation, one.default, one.dashed
    if one.read:
        annotation, default = list[str] | None, None
    elif one.unit:
        annotation, default = str | None, None if one.required else f"{default:g} {one.unit}"
    elif one.required:
        annotation, default = annotation | None, None
    option = typer.Option(
        f"--{name}/--no-{name}" if default is True else f"--{name}",
        metavar=one.metavar,
        help=one.help + " Repeatable." * bool(one.read),
    )
    return inspect.Parameter(
        _name(one),
        inspect.Parameter.KEYWORD_ONLY,
        annotation=Annotated[annotation, option],
        default=default,
    )


def _name(one: Option) -> str:
    return one.flag or one.name
