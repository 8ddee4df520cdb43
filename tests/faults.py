"""What can go wrong with files, by faults made from the dataclass that describes them."""

import copy
import dataclasses
import json
import types
import typing
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import pytest
from typing_extensions import is_typeddict

from stewart_drake.cli import main
from stewart_drake.files.errors import ConfigError
from stewart_drake.files.schema import spelling

Loader = Callable[[Path], Any]

MISSING = object()
"""As a value: the field is left out."""

NAN, INF = float("nan"), float("inf")
TOO_LONG = 10**400
"""A whole number that no float holds."""


class Fault(NamedTuple):
    """A field, what is wrong with it, and the value that makes it so."""

    field: str
    kind: str
    value: Any

    def __str__(self) -> str:
        return f"{self.field}: {self.kind}"


class Kind(NamedTuple):
    """What a field holds: number, text, truth, choice, numbers, mappings or other; null too?"""

    name: str
    null: bool
    whole: bool = False


def fields(type_: type, above: str = "") -> Iterator[tuple[str, Any, bool]]:
    """Name, annotation and whether it must be given, of every field that is not a section.

    Of a section that comes in kinds, each name once: of the first kind that has it.
    """
    hints = typing.get_type_hints(type_)
    for field in dataclasses.fields(type_):
        hint, name = hints[field.name], f"{above}{spelling(type_, field.name)}"
        required = (
            field.default is dataclasses.MISSING and field.default_factory is dataclasses.MISSING
        )
        sections = [t for t in members(hint) if dataclasses.is_dataclass(t)]
        if not sections:
            yield name, hint, required
        found = {
            inner[0]: inner
            for section in reversed(sections)
            for inner in fields(typing.cast(type, section), f"{name}.")
        }
        yield from found.values()


def members(hint: Any) -> tuple[Any, ...]:
    """The alternatives of a union; a plain type is a union of one."""
    union = typing.get_origin(hint) in (typing.Union, types.UnionType)
    return typing.get_args(hint) if union else (hint,)


def kind_of(hint: Any) -> Kind:
    """What a field with this annotation holds."""
    plain = [t for t in members(hint) if t is not types.NoneType]
    null = len(plain) < len(members(hint))
    lists = [t for t in plain if typing.get_origin(t) is list]
    if lists and is_typeddict(typing.get_args(lists[0])[0]):
        return Kind("mappings", null)
    if lists:
        return Kind("numbers", null)
    for type_, name in ((bool, "truth"), (float, "number"), (int, "number"), (str, "text")):
        if plain[0] is type_:
            return Kind(name, null, type_ is int)
    return Kind("choice" if typing.get_origin(plain[0]) is typing.Literal else "other", null)


def wrong_types(name: str, kind: Kind) -> Iterator[Fault]:
    """What no field of this kind may hold, whatever its range."""
    if not kind.null:
        yield Fault(name, "null", None)
    yield Fault(name, "a mapping", {"a": 1})
    if kind.name in ("number", "truth", "choice", "text"):
        yield Fault(name, "a list", [1.0])
    if kind.name in ("number", "truth", "numbers"):
        yield Fault(name, "text", "much")
    if kind.name == "choice":
        yield Fault(name, "an unknown word", "nonsense")
    if kind.name in ("choice", "text"):
        yield Fault(name, "a number", 3)
    if kind.name == "text":
        yield Fault(name, "empty", "")
    if kind.name == "truth":
        yield Fault(name, "a number", 1)
    if kind.name == "number":
        yield Fault(name, "a truth", True)
        yield from (Fault(name, "not finite", value) for value in (NAN, INF, -INF))
        yield from (Fault(name, "huge", value) for value in (1e300, -1e300, TOO_LONG))
        if kind.whole:
            yield Fault(name, "not whole", 1.5)
    if kind.name == "numbers":
        yield Fault(name, "a number", 1.0)
        yield Fault(name, "empty", [])
        yield Fault(name, "one number", [1.0])


def wrong_numbers(name: str, good: list[Any]) -> Iterator[Fault]:
    """The list `good` of numbers, or of rows of numbers, with one of them or its length wrong."""
    yield Fault(name, "too long", [*good, *good])
    yield Fault(name, "too short", good[:-1])
    values: dict[str, list[Any]] = {
        "text inside": ["much"],
        "null inside": [None],
        "a truth inside": [True],
        "not finite inside": [NAN, INF, -INF],
        "huge inside": [1e300, TOO_LONG],
    }
    for kind, wrong in values.items():
        for value in wrong:
            changed = copy.deepcopy(good)
            row = changed
            while isinstance(row[-1], list):
                row = row[-1]
            row[-1] = value
            yield Fault(name, kind, changed)


def put(document: dict[str, Any], name: str, value: Any) -> dict[str, Any]:
    """A copy with a dotted field set, or left out."""
    changed = copy.deepcopy(document)
    *above, last = name.split(".")
    section = changed
    for key in above:
        section = section.setdefault(key, {})
    if value is MISSING:
        del section[last]
    else:
        section[last] = value
    return changed


def yaml_text(document: Any) -> str:
    """As YAML, which JSON is but for what is not finite."""
    text = json.dumps(document)
    return text.replace("-Infinity", "-.inf").replace("Infinity", ".inf").replace("NaN", ".nan")


def written(path: Path, content: str | bytes) -> Path:
    """Write a file and give back its path."""
    path.write_bytes(content if isinstance(content, bytes) else content.encode())
    return path


def tree(folder: Path) -> dict[str, bytes | None]:
    """Everything below a folder: the bytes of files, None for the rest."""
    return {
        str(path.relative_to(folder)): path.read_bytes() if path.is_file() else None
        for path in folder.rglob("*")
    }


def complaint(load: Loader, path: Path) -> str:
    """The message of the ConfigError that reading a file ends in: one line, opened by the path."""
    with pytest.raises(ConfigError) as caught:
        load(path)
    said = str(caught.value)
    assert said.startswith(str(path)) and len(said.splitlines()) == 1
    check_remedy(said)
    return said


def check_remedy(said: str) -> None:
    """Fail unless a message says what to do about it."""
    remedies = (
        "expected ",
        "did you mean ",
        "is missing",
        "are missing",
        "shipped names",
        "--help",
        "accepted",
        "choose another",
    )
    assert any(words in said.lower() for words in map(str.lower, remedies)), f"no remedy: {said}"


def refusal(arguments: list[str], capsys: Any) -> str:
    """What the command says when it refuses: one line on stderr, exit status 2, nothing printed.

    The line must also say what to do about it.
    """
    status = main(arguments)
    out, err = capsys.readouterr()
    assert status == 2, f"exit status {status}: {err}"
    assert out == ""
    assert err.startswith("error: ") and err.endswith("\n") and err.count("\n") == 1, err
    assert "Traceback" not in err
    check_remedy(err)
    return err
