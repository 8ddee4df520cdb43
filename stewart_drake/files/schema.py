"""What dataclasses say about the fields of a file, and sections that come in kinds.

Such a section is a union of dataclasses, told apart by their field `kind`.
"""

import dataclasses
import typing
from collections.abc import Iterator
from typing import Any

from pydantic import GetCoreSchemaHandler
from pydantic_core import core_schema
from typing_extensions import is_typeddict


class ByKind:
    """In `Annotated`, for one dataclass or a union of them, each with a `kind` of its own.

    A mapping is read as the member whose kind it names, as the first one where it names none. A new
    kind is one more class in the union.
    """

    def __get_pydantic_core_schema__(
        self, source: Any, handler: GetCoreSchemaHandler
    ) -> core_schema.CoreSchema:
        choices = {k: handler.generate_schema(section) for k, section in _members(source).items()}
        usual = next(iter(choices))

        def choose(value: Any) -> str:
            given = isinstance(value, dict)
            kind = value.get("kind", usual) if given else getattr(value, "kind", usual)
            return kind if isinstance(kind, str) else repr(kind)

        return core_schema.tagged_union_schema(choices, choose)


def kinds(hint: Any) -> dict[str, Any]:
    """Kind -> dataclass, the usual one first, of an annotation with `ByKind`; empty without."""
    if any(isinstance(note, ByKind) for note in getattr(hint, "__metadata__", ())):
        return _members(hint.__origin__)
    return {}


def sections(type_: type) -> dict[str, dict[str, Any]]:
    """The `kinds` of every field of a dataclass that has some."""
    hints = typing.get_type_hints(type_, include_extras=True)
    return {name: found for name, hint in hints.items() if (found := kinds(hint))}


def _members(hint: Any) -> dict[str, Any]:
    return {section.kind: section for section in typing.get_args(hint) or (hint,)}


def field_names(hint: Any) -> list[str]:
    """Return the names of the fields of a section, or of all its kinds."""
    owners = list(kinds(hint).values()) or [hint]
    return [spelling(owner, name) for owner in owners for name in typing.get_type_hints(owner)]


def spelling(owner: Any, name: str) -> str:
    """What a field is called in files: its alias, where Python keeps the word to itself."""
    field = getattr(owner, "__pydantic_fields__", {}).get(name)
    return (field and field.alias) or name


def plain(value: Any) -> Any:
    """A dataclass, and what it holds, as mappings in the spelling of files."""
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        fields = (field.name for field in dataclasses.fields(value))
        return {spelling(type(value), name): plain(getattr(value, name)) for name in fields}
    if isinstance(value, dict):
        return {key: plain(one) for key, one in value.items()}
    return [plain(one) for one in value] if isinstance(value, list) else value


def dotted_names(hint: Any) -> Iterator[tuple[str, Any]]:
    """Yield every field below a section, without places in lists: dotted name and owner."""
    if not _is_section(hint):
        for argument in typing.get_args(hint):
            yield from dotted_names(argument)
        return
    for name, inner in typing.get_type_hints(hint).items():
        if inner is not typing.ClassVar:
            field = spelling(hint, name)
            yield field, hint
            yield from ((f"{field}.{below}", owner) for below, owner in dotted_names(inner))


def _is_section(hint: Any) -> bool:
    return dataclasses.is_dataclass(hint) or is_typeddict(hint)
