"""Strict YAML and typed configuration: nothing is guessed, nothing is executed.

`load_yaml` turns a file into plain dicts, lists, strings, numbers and booleans; `validate` turns
these into a pydantic dataclass. Errors are one line.
"""

import copy
import dataclasses
import functools
import io
import json
import re
import typing
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any, Final, TypeVar

import pydantic
from ruamel.yaml import YAML
from ruamel.yaml.composer import Composer
from ruamel.yaml.error import MarkedYAMLError, YAMLError
from ruamel.yaml.events import AliasEvent
from ruamel.yaml.nodes import ScalarNode
from ruamel.yaml.representer import RoundTripRepresenter

from stewart_drake.files.errors import ConfigError, resembling
from stewart_drake.files.fileio import read_bytes
from stewart_drake.files.schema import dotted_names

_MAX_BYTES: Final = 100_000
_MAX_DEPTH: Final = 20
_MOST_PROBLEMS: Final = 5  # largest number of problems in one message
_UNKNOWN: Final = ("extra_forbidden", "unexpected_keyword_argument")

_ALIKE: Final = {  # in meaning only
    **{"start": "from", "begin": "from", "end": "to", "until": "to"},
    "tolerance": "w_R",
}
_INDENTED: Final = re.compile("expected <block end>, but found '<block (mapping|sequence) start>'")
_SPELLED: Final = {
    **{"s": "s", "ms": "s", "m": "m", "cm": "m", "mm": "m", "kg": "kg", "g": "kg"},
    **{"Nm": "N m", "mNm": "N m", "rad": "rad", "Hz": "Hz", "rad/s": "rad/s"},
}
"""Unit of a field by that which was written after a number, without blanks."""

_T = TypeVar("_T")


class _StrictComposer(Composer):
    """Composer without anchors, which make a short file large, tags, and keys other than words."""

    def compose_node(self, parent: Any, index: Any) -> Any:
        event = self.parser.peek_event()
        if isinstance(event, AliasEvent) or event.anchor is not None:
            _refuse(f"anchors and aliases ({event.anchor}) are not accepted", event)
        if event.tag is not None:
            _refuse(f"tags ({event.tag}) are not accepted", event)
        return super().compose_node(parent, index)

    def compose_mapping_node(self, anchor: Any) -> Any:
        node = super().compose_mapping_node(anchor)
        for key, _ in node.value:
            if not (isinstance(key, ScalarNode) and str(key.tag).endswith(":str")):
                _refuse("a key must be a word", key)
        return node


def _refuse(problem: str, at: Any) -> typing.NoReturn:
    raise MarkedYAMLError(problem=problem, problem_mark=at.start_mark)


def load_yaml(path: str | Path) -> dict[str, Any]:
    """Read one YAML mapping from a UTF-8 file of at most 100 kB.

    Raises:
        ConfigError: the file cannot be read or decoded; it is empty, is not a mapping, holds
            several documents, duplicate keys, anchors or tags, or is not YAML. The message names
            the file, and the line where there is one.
    """
    try:
        text = read_bytes(Path(path), _MAX_BYTES, "a YAML file of at most 100 kB").decode(
            "utf-8-sig"
        )
    except UnicodeDecodeError as error:
        line = error.object.count(b"\n", 0, error.start) + 1
        raise ConfigError(f"{path}: line {line}: is not UTF-8 text; expected YAML") from None
    data = parse_yaml(text, str(path))
    if not isinstance(data, dict):
        problem = "is empty" if data is None else f"holds {brief(data)}"
        raise ConfigError(f"{path}: {problem}; expected a YAML mapping")
    return data


def parse_value(text: str, where: str) -> Any:
    """Parse the value of `name=value`, as `parse_yaml`; an empty one, which is null, is refused."""
    if not text.strip():
        raise ConfigError(f"{where}: got no value; expected a value, or null for none")
    return parse_yaml(text, where)


def parse_yaml(text: str, where: str) -> Any:
    """Parse one YAML value of any kind under the rules of `load_yaml`; `where` opens a message."""
    try:
        return copy.deepcopy(_parsed(text))
    # Numbers of thousands of digits end in ValueError, deep nesting in RecursionError, and some
    # malformed directives in other errors of the parser.
    except (YAMLError, ValueError, RecursionError, AssertionError, LookupError) as error:
        mark = isinstance(error, MarkedYAMLError) and (error.problem_mark or error.context_mark)
        line = f"line {mark.line + 1}: " if mark else "is not YAML: "
        text = getattr(error, "problem", None) or getattr(error, "context", None) or str(error)
        problem = (text.strip() or type(error).__name__).splitlines()[0]
        if _INDENTED.fullmatch(problem):
            problem = "the indentation does not fit the lines above"
        problem = _cut(problem.partition(", if necessary")[0], 160)  # advice to programmers
        raise ConfigError(f"{where}: {line}{problem}; expected plain YAML") from None


@functools.lru_cache(maxsize=64)
def _parsed(text: str) -> Any:
    """Return the content; kept, since a study reads the same few files for each of its runs."""
    yaml = YAML(typ="safe", pure=True)
    yaml.max_depth = _MAX_DEPTH
    yaml.Composer = _StrictComposer
    return yaml.load(text)


class _Representer(RoundTripRepresenter):
    """Representer with lists on one line, except those of sections, and null by its name."""

    def flat(self, values: list[Any]) -> Any:
        one_line = not any(isinstance(value, dict) for value in values)
        return self.represent_sequence("tag:yaml.org,2002:seq", values, flow_style=one_line)

    def null(self, _: None) -> Any:
        return self.represent_scalar("tag:yaml.org,2002:null", "null")


_Representer.add_representer(list, _Representer.flat)
_Representer.add_representer(type(None), _Representer.null)


def yaml_text(data: dict[str, Any]) -> str:
    """Return plain data as the text of a file that `load_yaml` reads back."""
    yaml, text = YAML(), io.StringIO()
    yaml.width, yaml.Representer = 96, _Representer
    yaml.dump(data, text)
    return text.getvalue()


def validate(type_: type[_T], data: Any, where: str) -> _T:
    """Return a pydantic dataclass, with sections nested to any depth, from plain data.

    `data` is as `load_yaml` returns it; `where` opens a message, such as the file.

    Raises:
        ConfigError: `<where>: <section.field>: got <value>; expected <accepted values>` for the
            first few problems, in one line. Unknown keys come first, each with the nearest known
            one. Then no field is reported as missing, as it may be one of these.
    """
    try:
        # JSON mode is the one in which strict pydantic lets a mapping become a nested dataclass.
        return pydantic.TypeAdapter(type_).validate_json(json.dumps(data, default=str))
    except pydantic.ValidationError as caught:
        raise _refusal(where, type_, data, caught) from None
    except (ValueError, RecursionError) as error:  # recursive data, numbers of too many digits
        raise ConfigError(f"{where}: {_cut(str(error), 160)}; expected plain data") from None


def in_one_line(type_: Any) -> Any:
    """Let a pydantic dataclass raise ConfigError, as `validate` does, for a wrong argument."""
    names = [one.name for one in dataclasses.fields(type_)]
    make, assign = type_.__init__, type_.__setattr__

    def checked(call: Callable[..., None], given: dict[str, Any]) -> None:
        try:
            call()
        except pydantic.ValidationError as caught:
            raise _refusal(type_.__name__, type_, given, caught) from None

    @functools.wraps(make)
    def init(self: Any, *args: Any, **kwargs: Any) -> None:
        given = {k: _as_list(v) for k, v in (*zip(names, args, strict=False), *kwargs.items())}
        checked(functools.partial(make, self, *args[len(names) :], **given), given)

    def setattr_(self: Any, name: str, value: Any) -> None:
        checked(functools.partial(assign, self, name, _as_list(value)), {name: value})

    type_.__init__, type_.__setattr__ = init, setattr_
    return type_


def _as_list(value: Any) -> Any:
    """Return a tuple or an array of Python as the list that a file has."""
    if hasattr(value, "tolist"):  # of numpy, which is not imported here
        return value.tolist()
    return [_as_list(one) for one in value] if isinstance(value, list | tuple) else value


def _refusal(where: str, type_: type, data: Any, caught: pydantic.ValidationError) -> ConfigError:
    errors = caught.errors(include_url=False)
    unknown = [_explain_unknown(type_, data, one) for one in errors if one["type"] in _UNKNOWN]
    hidden = (*_UNKNOWN, "missing") if unknown else ()
    units = units_of(type_)
    problems = unknown + [
        explain(data, one, next(iter(one["loc"]), "") not in units) + _fields_of(type_, data, one)
        for one in errors
        if one["type"] not in hidden
    ]
    if (more := len(problems) - _MOST_PROBLEMS) > 0:
        problems = [*problems[:_MOST_PROBLEMS], f"and {more} more"]
    return ConfigError(f"{where}: {'; '.join(problems)}")


def validate_pairs(type_: type[_T], settings: Iterable[str], option: str) -> _T:
    """Return a flat pydantic dataclass from `name=value` texts, the value in YAML.

    Args:
        type_: the dataclass; other fields keep their defaults. A message shows `units_of` it for
            the fields that it names.
        settings: the texts; of two with one name the later one counts.
        option: of the command line, opening the message.
    """
    given: dict[str, Any] = {}
    try:
        for setting in settings:
            name, equals, text = setting.partition("=")
            if not equals or not name.strip():
                raise ConfigError(f"{option}: got {brief(setting)}; expected name=value")
            given[name.strip()] = parse_value(text, f"{option}: {name.strip()}")
        return validate(type_, given, option)
    except ConfigError as error:
        named = set(re.findall(r"\w+", str(error).partition("; expected one of ")[0]))
        shown = [f"{name}: {unit}" for name, unit in units_of(type_).items() if name in named]
        raise ConfigError(f"{error} ({'; '.join(shown)})" if shown else str(error)) from None


def units_of(type_: type) -> dict[str, str]:
    """Return the `description` of each annotated field of a pydantic dataclass, by its name."""
    return {
        name: one.description
        for name, hint in typing.get_type_hints(type_, include_extras=True).items()
        for one in getattr(hint, "__metadata__", ())
        if getattr(one, "description", None)
    }


def one_message(expected: str) -> pydantic.WrapValidator:
    """Return an annotation with one message for all complaints about a value.

    pydantic has one for each member of a union.
    """

    def check(value: Any, accept: pydantic.ValidatorFunctionWrapHandler) -> Any:
        try:
            return accept(value)
        except pydantic.ValidationError:
            raise ValueError(expected) from None

    return pydantic.WrapValidator(check)


def rule(holds: Callable[[Any], bool], expected: str = "") -> pydantic.AfterValidator:
    """Return an annotation of values for which `holds` is true, with one message for the others."""

    def check(value: Any) -> Any:
        if not holds(value):
            raise ValueError(expected)
        return value

    return pydantic.AfterValidator(check)


def exactly(number: int, what: str = "numbers") -> pydantic.WrapValidator:
    """Return an annotation of a list with a fixed length, with one message for both bounds."""

    def check(value: Any, accept: pydantic.ValidatorFunctionWrapHandler) -> Any:
        if isinstance(value, int | float | str):
            raise ValueError(f"a list of {number} {what}")
        values = accept(value)
        if len(values) != number:
            raise ValueError(f"{number} {what}, not {len(values)}")
        return values

    return pydantic.WrapValidator(check)


def brief(value: object) -> str:
    """Return `repr(value)`, cut to 60 characters."""
    return _cut(repr(value), 60)


def differences(given: Any, usual: Any, path: str = "") -> str:
    """Return `section.field=value` of every field in which two dataclasses differ."""
    parts = []
    for field in dataclasses.fields(given):
        name, one = f"{path}{field.name}", getattr(given, field.name)
        other = getattr(usual, field.name, None)  # another kind may not have it
        if dataclasses.is_dataclass(one):
            parts.append(differences(one, other, f"{name}."))
        elif one != other:
            parts.append(f"{name}={brief(one)}")
    return ", ".join(filter(None, parts))


def _cut(text: str, length: int) -> str:
    return text if len(text) <= length else f"{text[: length - 3]}..."


_PLAIN: Final = {
    "a valid integer": "a whole number",
    "a valid boolean": "true or false",
    "a valid number": "a number",
    "a valid string": "text",
    "an object": "a mapping of fields",
    "a valid dictionary": "a mapping",
    "a valid tuple": "a list of numbers",
    "a valid list": "a list",
    "a valid array": "a list",
    "greater than or equal to": "at least",
    "less than or equal to": "at most",
    "greater than": "more than",
}
"""Words of pydantic, and those of a message."""


def accepted(message: str) -> str:
    """Return what a message of pydantic accepts, in words."""
    words = r"^(\w+ should (be|have) |Value error, )| after validation|, unable to parse.*"
    expected = re.sub(words, "", message)
    for theirs, plain in _PLAIN.items():
        expected = expected.replace(theirs, plain)
    return expected


def explain(data: Any, error: Any, of_si: bool = True) -> str:
    """Return an error of pydantic as `place: got value; expected what is accepted`.

    `of_si` is whether to name the SI unit where a number has come with a unit.
    """
    place, value, expected = _place(data, error["loc"]), error["input"], accepted(error["msg"])
    if error["type"].startswith("missing"):
        return f"{place}.{error['loc'][-1]}: is missing".removeprefix(".")
    if error["type"] == "union_tag_invalid":
        place, value, expected = f"{place}.kind", error["ctx"]["tag"], error["ctx"]["expected_tags"]
    of_si = of_si and isinstance(value, str) and error["type"].startswith("float")
    with_unit = re.fullmatch(r"[-+.\deE]*\d\s*(\D+)", value) if of_si else None
    if with_unit and (unit := _SPELLED.get(with_unit[1].replace(" ", ""))):
        expected += f", in {unit}"
    return f"{place}: got {brief(value)}; expected {expected}".removeprefix(": ")


def _fields_of(type_: type, data: Any, error: Any) -> str:
    """Return the end of a message about a section other than a mapping: its fields, or ''."""
    if not accepted(error["msg"]).endswith("a mapping of fields"):
        return ""
    above = re.sub(r"\[\d+\]", "", _place(data, error["loc"]))
    names = dict.fromkeys(
        name.rpartition(".")[2]
        for name, _ in dotted_names(type_)
        if name.rpartition(".")[0] == above
    )
    return _cut(f": {', '.join(names)}", 160)


def _explain_unknown(type_: type, data: Any, error: Any) -> str:
    place, fields = _place(data, error["loc"]), list(dotted_names(type_))
    start = f"{_cut(place, 60)}: "
    plain = re.sub(r"\[\d+\]", "", place)
    known = dict(fields)
    if kinds := [owner.kind for name, owner in fields if name == plain and hasattr(owner, "kind")]:
        got = f"got {brief(error['input'])}, which kind {error['loc'][-2]!r} does not use"
        section = place.rpartition(".")[0]
        return f"{start}{got}; expected {section}.kind={' or '.join(kinds)}"
    above, dot, name = plain.rpartition(".")
    section = place.rpartition(".")[0] + dot
    full = [one for one in known if one.rpartition(".")[0] == above]
    siblings = [one.rpartition(".")[2] for one in full]
    for one in full:
        if new := getattr(known[one], "renamed", {}).get(name):
            return f"{start}unknown key; it is called {section}{new} since 0.3"
    alike = [_ALIKE[name]] if _ALIKE.get(name) in siblings else resembling(name, siblings)
    meant = [section + one for one in alike]
    # A field may have been named without its section.
    deeper = [one for one in known if one.endswith(f".{name}")]
    if meant or len(deeper) == 1:
        return f"{start}unknown key; did you mean {[*meant, *deeper][0]}?"
    return f"{start}unknown key; expected one of {', '.join(siblings)}"


def _place(data: Any, loc: Iterable[int | str]) -> str:
    """Return where pydantic's `loc`, which also names kinds, is in the data, as `a.poses[2][0]`."""
    place = ""
    for part in loc:
        if isinstance(part, int) and isinstance(data, list):
            place, data = f"{place}[{part}]", data[part]
        elif isinstance(data, dict) and part in data:
            place, data = f"{place}.{part}", data[part]
    return place.removeprefix(".")
