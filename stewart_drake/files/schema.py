"""Fields of a file as dataclasses declare them, and sections that come in kinds.

Such a section is a union of dataclasses with a field `kind` each.
"""

import dataclasses
import typing
from collections.abc import Iterator
from typing import Any

from pydantic import GetCoreSchemaHandler, TypeAdapter
from pydantic_core import core_schema
from typing_extensions import is_typeddict


class ByKind:
    """Annotation of a union of dataclasses, each with a default of its field `kind`.

    A mapping is read as the member of its `kind`, as the first member without one.
    """

    def __get_pydantic_core_schema__(
        self, source: Any, handler: GetCoreSchemaHandler
    ) -> core_schema.CoreSchema:
        choices = {k: handler.generate_schema(section) for k, section in _members(source).items()}
        usual = next(iter(choices))

        def choose(value: Any) -> str:
            get = value.get if isinstance(value, dict) else lambda *a: getattr(value, *a)
            kind = get("kind", usual)
            return kind if isinstance(kind, str) else repr(kind)

        return core_schema.tagged_union_schema(choices, choose)


def _members(hint: Any) -> dict[str, Any]:
    return {section.kind: section for section in typing.get_args(hint) or (hint,)}


def kinds(hint: Any) -> dict[str, Any]:
    """Return dataclasses by kind, the default one first; none for other annotations."""
    notes = getattr(hint, "__metadata__", ())
    return _members(hint.__origin__) if any(isinstance(n, ByKind) for n in notes) else {}


def sections(type_: type) -> dict[str, dict[str, Any]]:
    """Return the `kinds` of every field of a dataclass that has some."""
    hints = typing.get_type_hints(type_, include_extras=True)
    return {name: found for name, hint in hints.items() if (found := kinds(hint))}


def field_names(section: type) -> list[str]:
    return [spelling(section, name) for name in typing.get_type_hints(section)]


def spelling(owner: Any, name: str) -> str:
    """Return the name of a field in files: its alias if it has one."""
    field = getattr(owner, "__pydantic_fields__", {}).get(name)
    return (field and field.alias) or name


def plain(value: Any) -> Any:
    """Return a dataclass, and dataclasses within, as mappings with names as in files."""
    return TypeAdapter(type(value)).dump_python(value, by_alias=True, warnings=False)


def dotted_names(hint: Any) -> Iterator[tuple[str, Any]]:
    """Yield dotted name and owner of every field below a section, without places in lists."""
    if not (dataclasses.is_dataclass(hint) or is_typeddict(hint) or hasattr(hint, "_fields")):
        for argument in typing.get_args(hint):
            yield from dotted_names(argument)
        return
    for name, inner in typing.get_type_hints(hint).items():
        field = spelling(hint, name)
        yield field, hint
        yield from ((f"{field}.{below}", owner) for below, owner in dotted_names(inner))
