"""Options of a study, declared once: field, unit and meaning, default, command-line form.

The command line, the Python signature and the command that a page names follow from them.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Annotated, Any, NamedTuple

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from stewart_drake.files.errors import ConfigError
from stewart_drake.files.yamlio import explain
from stewart_drake.scenario.config import Scenario


@dataclass(frozen=True)
class Flag:
    """Command-line form of an option. An option without one exists in Python only.

    Attributes:
        metavar: shown in place of the value.
        name: without dashes, if it differs from the field's.
        read: makes the value from the texts of a repeatable option. Its second argument loads the
            scenario with another controller.
        recorded: whether the command on a page contains the option.
    """

    metavar: str | None = None
    name: str = ""
    read: Callable[[list[str], Callable[[str], Scenario]], Any] | None = None
    recorded: bool = True


class Option(NamedTuple):
    """One option of a study.

    Attributes:
        name: of the field and of the Python argument.
        annotation: of the Python argument.
        default: in both.
        help: unit and meaning.
        flag: or None.
    """

    name: str
    annotation: Any
    default: Any
    help: str
    flag: Flag | None

    @property
    def recorded(self) -> bool:
        """Whether the command on a page contains the option."""
        return self.flag is None or self.flag.recorded


class Options(BaseModel):
    """Base class of the options of a study; wrong values raise ConfigError."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    def __init__(self, **values: Any) -> None:
        try:
            super().__init__(**values)
        except ValidationError as caught:
            raise ConfigError(explain(values, caught.errors(include_url=False)[0])) from None

    @classmethod
    def described(cls) -> Iterator[Option]:
        """Yield all options; those that pages do not record come last."""
        found = []
        for name, field in cls.model_fields.items():
            flag = next((one for one in field.metadata if isinstance(one, Flag)), None)
            found.append(
                Option(name, field.annotation, field.default, field.description or "", flag)
            )
        yield from sorted(found, key=lambda option: not option.recorded)


class JobOptions(Options):
    """Options of a study whose runs go to several processes."""

    workers: Annotated[
        int | None, Field(description="Processes; all cores by default."), Flag("N", recorded=False)
    ] = None
    scheduler: Annotated[
        str | None,
        Field(description="Of a Dask cluster to run on instead."),
        Flag("ADDRESS", recorded=False),
    ] = None


Seed = Annotated[int, Field(ge=0, description="Of everything that is drawn."), Flag()]
