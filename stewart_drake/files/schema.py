"""What dataclasses say about the fields of a file, and sections that come in kinds.

Such a section is a union of dataclasses, told apart by their field `kind`.
"""

import dataclasses
import types
import typing
from collections.abc import Callable, Sequence
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
    """Of a section, or of all its kinds; none where the annotation is of no section."""
    owners = list(kinds(hint).values()) or [_alternative(hint, _is_section)]
    return [
        spelling(owner, name) for owner in owners if owner for name in typing.get_type_hints(owner)
    ]


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


def field_hint(owner: Any, name: str) -> Any:
    """The annotation of a section's field, with a mark of kinds where it has one; None without."""
    owner = _alternative(owner, _is_section)  # which may also be null
    if owner is None:
        return None
    names = {spelling(owner, own): own for own in typing.get_type_hints(owner)}
    own = names.get(name, name)
    marked = typing.get_type_hints(owner, include_extras=True).get(own)
    return marked if kinds(marked) else typing.get_type_hints(owner).get(own)


def place_of(type_: Any, loc: Sequence[int | str]) -> tuple[tuple[int | str, ...], Any]:
    """Where pydantic's `loc`, which has kinds in it, is in the file, and the annotation there."""
    place, hint = list[int | str](), type_
    for part in loc:
        if kinds(hint):
            hint = kinds(hint)[str(part)]
            continue
        place.append(part)
        if isinstance(part, int):  # the items of a list
            owner = _alternative(hint, lambda a: typing.get_origin(a) is list)
            hint = typing.get_args(owner)[0] if owner else None
        else:
            owner = _alternative(hint, _is_section)
            hint = field_hint(owner, part) if owner else None
    return tuple(place), hint


def _is_section(hint: Any) -> bool:
    return dataclasses.is_dataclass(hint) or is_typeddict(hint)


def _alternative(hint: Any, wanted: Callable[[Any], bool]) -> Any:
    """The member of the union `hint` that is `wanted`; a plain type is a union of one."""
    union = typing.get_origin(hint) in (typing.Union, types.UnionType)
    return next((a for a in (typing.get_args(hint) if union else (hint,)) if wanted(a)), None)
