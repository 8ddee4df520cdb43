"""Parameters of the command line: those that commands share, and the options of a study."""

import contextlib
import inspect
from collections.abc import Callable, Collection, Mapping
from typing import Annotated, Any, Final

import typer

from stewart_drake.cli.common import Chosen, Delivery, named
from stewart_drake.scenario.config import Scenario
from stewart_drake.studies.options import Option, Options


class Given:
    """Options that a command was called with.

    Args:
        kind: class of the options.
        typed: values by the option's name on the command line, None for what is missing.
    """

    def __init__(self, kind: type[Options], typed: Mapping[str, Any]) -> None:
        self._kind = kind
        self._typed = [(one, typed[_name(one)]) for one in _offered(kind)]

    @property
    def missing(self) -> list[Option]:
        return [one for one, value in self._typed if one.required and value is None]

    @property
    def words(self) -> dict[str, Any]:
        """Typed values for the command on a page."""
        return {one.dashed: value for one, value in self._typed if one.recorded}

    @property
    def given(self) -> dict[str, Any]:
        """Typed values by field, without those that were not given."""
        return {one.name: value for one, value in self._typed if value is not None}

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
            values: dict[str, Any] = {
                one.name: one.read(value, load) if one.read else value  # type: ignore[arg-type]
                for one, value in self._typed
                if value is not None and not (one.read and value == [])
            }
            return self._kind(**(values | dict(more or {})))

    def named(self) -> contextlib.AbstractContextManager[None]:
        """Replace the name of a field in an error by the option that sets it."""
        return named(**{one.name: f"--{one.dashed}" for one, _ in self._typed})


_GROUPS: Final = {"chosen": Chosen, "delivery": Delivery}


def command(
    kind: type[Options] = Options, without: Collection[str] = (), **defaults: Any
) -> Callable[[Callable[..., int | None]], Callable[..., int | None]]:
    """Return a decorator that replaces arguments of a command by parameters of the command line.

    These are `given`, by the options of a study; `chosen` and `delivery`, by what makes a `Chosen`
    and a `Delivery`.

    Args:
        kind: class of the options.
        without: parameters that the command does not offer; they keep their defaults.
        defaults: by the name of a parameter.
    """
    options = {_name(one): _parameter(one) for one in _offered(kind)}
    make: dict[str, Callable[..., Any]] = {"given": lambda **typed: Given(kind, typed), **_GROUPS}

    def expanded(one: inspect.Parameter) -> dict[str, inspect.Parameter]:
        if one.name not in make:
            return {one.name: one}
        if one.name == "given":
            return options
        return {
            name: part.replace(kind=part.KEYWORD_ONLY, default=defaults.get(name, part.default))
            for name, part in inspect.signature(_GROUPS[one.name]).parameters.items()
            if name not in without
        }

    def decorate(command: Callable[..., int | None]) -> Callable[..., int | None]:
        own = {one.name: expanded(one) for one in inspect.signature(command).parameters.values()}

        def run(**typed: Any) -> int | None:
            parts = {name: {one: typed[one] for one in shown} for name, shown in own.items()}
            made = {name: make[name](**parts[name]) for name in own if name in make}
            return command(**{name: part.get(name) for name, part in parts.items()} | made)

        run.__name__, run.__doc__, run.__annotations__ = command.__name__, command.__doc__, {}
        parameters = [one for shown in own.values() for one in shown.values()]
        run.__signature__ = inspect.Signature(parameters)  # type: ignore[attr-defined]
        return run

    return decorate


def _offered(kind: type[Options]) -> list[Option]:
    return [one for one in kind.described() if one.flag is not None]


def _parameter(one: Option) -> inspect.Parameter:
    annotation, default, name = one.annotation, one.default, one.dashed
    if one.read:
        annotation, default = list[str] | None, None
    elif one.unit:
        bare = one.required or default is None
        annotation, default = str | None, None if bare else f"{default:g} {one.unit}"
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
