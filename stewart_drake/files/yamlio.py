"""Strict YAML in front of typed configuration: nothing is guessed, nothing is executed.

`load_yaml` turns a file into plain dicts, lists, strings, numbers and booleans; `validate` turns
these into a pydantic dataclass. Both report the first problem as a one-line `ConfigError`.
"""

import copy
import dataclasses
import functools
import io
import json
import re
import typing
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any, Final, TypeVar

import pydantic
from ruamel.yaml import YAML
from ruamel.yaml.composer import Composer
from ruamel.yaml.constructor import SafeConstructor
from ruamel.yaml.error import MarkedYAMLError, YAMLError
from ruamel.yaml.events import AliasEvent
from ruamel.yaml.nodes import ScalarNode
from ruamel.yaml.representer import RoundTripRepresenter

from stewart_drake.files.errors import ConfigError, resembling
from stewart_drake.files.fileio import read_bytes
from stewart_drake.files.schema import dotted_names

_MAX_BYTES: Final = 100_000
_MAX_DEPTH: Final = 20
_MOST_PROBLEMS: Final = 5
"""That one message tells of."""
_STR_TAG: Final = "tag:yaml.org,2002:str"

_T = TypeVar("_T")


class _StrictComposer(Composer):
    """Refuses what makes a short file large (anchors), typed (tags) or irregular (odd keys)."""

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
            if not (isinstance(key, ScalarNode) and str(key.tag) == _STR_TAG):
                _refuse("a key must be a word", key)
        return node


class _PlainConstructor(SafeConstructor):
    """Leaves dates as the text they were written as."""


_PlainConstructor.add_constructor("tag:yaml.org,2002:timestamp", SafeConstructor.construct_yaml_str)


def _refuse(problem: str, at: Any) -> typing.NoReturn:
    raise MarkedYAMLError(problem=problem, problem_mark=at.start_mark)


def load_yaml(path: str | Path) -> dict[str, Any]:
    """Reads one YAML mapping from a file.

    Args:
        path: a UTF-8 file of at most 100 kB.

    Returns:
        The mapping, of plain dicts, lists, strings, numbers, booleans and None.

    Raises:
        ConfigError: the file cannot be read or decoded; it is empty, is not a mapping, holds
            several documents, duplicate keys, anchors or tags, or is not YAML. The message names
            the file, and the line where there is one.
    """
    return yaml_of(read_yaml(path), Path(path))


def read_yaml(path: str | Path) -> bytes:
    """The content of a file for `yaml_of`.

    Raises:
        ConfigError: it cannot be read.
    """
    return read_bytes(Path(path), _MAX_BYTES, "a small YAML file")


def yaml_of(raw: bytes, path: Path) -> dict[str, Any]:
    """What `load_yaml` returns, of a file's content."""
    try:
        text = raw.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        line = raw.count(b"\n", 0, error.start) + 1
        raise ConfigError(f"{path}: line {line}: is not UTF-8 text; expected YAML") from None
    data = parse_yaml(text, str(path))
    if data is None:
        raise ConfigError(f"{path}: is empty; expected a YAML mapping")
    if not isinstance(data, dict):
        raise ConfigError(f"{path}: holds {brief(data)}; expected a YAML mapping")
    return data


def parse_yaml(text: str, where: str) -> Any:
    """Parses one YAML value under the rules of `load_yaml`.

    Args:
        text: the YAML text; it may be a mapping, a list or a single value.
        where: what the text is, opening every message.

    Raises:
        ConfigError: the text breaks one of the rules.
    """
    try:
        return copy.deepcopy(_parsed(text))
    except MarkedYAMLError as error:
        mark = error.problem_mark or error.context_mark
        line = f"line {mark.line + 1}: " if mark else ""
        problem = str(error.problem or error.context).strip().splitlines()[0]
        problem = problem.partition(", if necessary")[0]  # advice to programmers
        raise ConfigError(f"{where}: {line}{_cut(problem, 160)}; expected plain YAML") from None
    # Numbers of thousands of digits end in ValueError, deep nesting in RecursionError, and some
    # malformed directives in whatever the parser trips over.
    except (YAMLError, ValueError, RecursionError, AssertionError, LookupError) as error:
        problem = _cut((str(error).strip() or type(error).__name__).splitlines()[0], 160)
        raise ConfigError(f"{where}: is not YAML ({problem}); expected plain YAML") from None


@functools.lru_cache(maxsize=64)
def _parsed(text: str) -> Any:
    """What it says; kept, since a study reads the same few files for each of its runs."""
    yaml = YAML(typ="safe", pure=True)
    yaml.max_depth = _MAX_DEPTH
    yaml.Composer = _StrictComposer
    yaml.Constructor = _PlainConstructor
    return yaml.load(text)


class _Representer(RoundTripRepresenter):
    """Lists on one line, those of sections apart; and null by its name."""

    def flat(self, values: list[Any]) -> Any:
        plain = not any(isinstance(value, dict) for value in values)
        return self.represent_sequence("tag:yaml.org,2002:seq", values, flow_style=plain)

    def null(self, _: None) -> Any:
        return self.represent_scalar("tag:yaml.org,2002:null", "null")


_Representer.add_representer(list, _Representer.flat)
_Representer.add_representer(type(None), _Representer.null)


def yaml_text(data: dict[str, Any]) -> str:
    """Plain data as the text of a file that `load_yaml` reads back."""
    yaml, text = YAML(), io.StringIO()
    yaml.width, yaml.Representer = 96, _Representer
    yaml.dump(data, text)
    return text.getvalue()


def validate(type_: type[_T], data: dict[str, Any], where: str) -> _T:
    """Builds a pydantic dataclass, sections nested to any depth, from plain data.

    Args:
        type_: the dataclass.
        data: as `load_yaml` returns it.
        where: the file (or other origin) that opens the message.

    Raises:
        ConfigError: `<where>: <section.field>: got <value>; expected <what is accepted>`, one after
            the other in one line, what is accepted in pydantic's words. Unknown keys, each with the
            nearest known one, keep the others back, for which they may be the reason.
    """
    try:
        # JSON mode is the one in which strict pydantic lets a mapping become a nested dataclass.
        return pydantic.TypeAdapter(type_).validate_json(json.dumps(data))
    except pydantic.ValidationError as caught:
        errors = caught.errors(include_url=False)
        if errors[0]["type"] != "json_invalid":  # half a surrogate pair is no JSON text
            raise ConfigError(f"{where}: {_explained(type_, data, errors)}") from None
    except (TypeError, ValueError, RecursionError):
        pass
    raise ConfigError(f"{where}: got {brief(data)}; expected plain numbers, text and lists")


def validate_pairs(
    type_: type[_T], settings: Iterable[str], option: str, units: Mapping[str, str]
) -> _T:
    """Builds a pydantic dataclass from `name=value` texts, the value in YAML.

    Args:
        type_: the dataclass, flat; what is not set keeps its default.
        settings: the texts; of two with one name the later one counts.
        option: of the command line, opening the message.
        units: of each field, in words, told with the fields that a message speaks of.

    Raises:
        ConfigError: in one line.
    """

    def told(message: str, names: Iterable[str] = units) -> str:
        spoken = set(re.findall(r"\w+", message)) & set(units)
        found = [f"{name}: {units[name]}" for name in names if name in spoken]
        return f" ({'; '.join(found)})" if found else ""

    given: dict[str, Any] = {}
    for setting in settings:
        name, equals, text = setting.partition("=")
        if not equals or not name.strip():
            raise ConfigError(f"{option}: got {brief(setting)}; expected name=value{told(setting)}")
        given[name.strip()] = parse_yaml(text, f"{option}: {name.strip()}")
    try:
        return validate(type_, given, option)
    except ConfigError as error:
        raise ConfigError(f"{error}{told(str(error), given)}") from None


def units_of(type_: type) -> dict[str, str]:
    """The `description` of each annotated field of a pydantic dataclass, by its name."""
    return {
        name: next(one.description for one in hint.__metadata__ if one.description)
        for name, hint in typing.get_type_hints(type_, include_extras=True).items()
    }


def one_message(expected: str) -> pydantic.WrapValidator:
    """For a union in `Annotated`: what it expects, where pydantic complains for each member."""

    def check(value: Any, accept: pydantic.ValidatorFunctionWrapHandler) -> Any:
        try:
            return accept(value)
        except pydantic.ValidationError:
            raise ValueError(expected) from None

    return pydantic.WrapValidator(check)


def brief(value: object) -> str:
    """`repr(value)`, cut to 60 characters."""
    return _cut(repr(value), 60)


def differences(given: Any, usual: Any, path: str = "") -> str:
    """`section.field=value` of every field in which two dataclasses of a kind differ."""
    parts = []
    for field in dataclasses.fields(given):
        name, one = f"{path}{field.name}", getattr(given, field.name)
        other = getattr(usual, field.name, None)  # which another kind may not have
        if dataclasses.is_dataclass(one):
            parts.append(differences(one, other, f"{name}."))
        elif one != other:
            parts.append(f"{name}={brief(one)}")
    return ", ".join(filter(None, parts))


def _cut(text: str, length: int) -> str:
    return text if len(text) <= length else f"{text[: length - 3]}..."


def _explained(type_: type, data: Any, errors: list[Any]) -> str:
    """Return the first few problems in one line; unknown keys keep the others back."""
    unknown = [e for e in errors if e["type"] in ("extra_forbidden", "unexpected_keyword_argument")]
    told = [_explain_unknown(type_, data, error) for error in unknown]
    told = told or [explain(data, error) for error in errors]
    more = [f"and {len(told) - _MOST_PROBLEMS} more"] if len(told) > _MOST_PROBLEMS else []
    return "; ".join([*told[:_MOST_PROBLEMS], *more])


def explain(data: Any, error: Any) -> str:
    """Return an error of pydantic as `place: got value; expected what is accepted`."""
    place, value = _place(data, error["loc"]), error["input"]
    expected = re.sub(r"^(\w+ should (be|have) |Value error, )| after validation", "", error["msg"])
    if error["type"].startswith("missing"):
        return f"{place}.{error['loc'][-1]}: is missing".removeprefix(".")
    if error["type"] == "union_tag_invalid":
        place, value, expected = f"{place}.kind", error["ctx"]["tag"], error["ctx"]["expected_tags"]
    return f"{place}: got {brief(value)}; expected {expected}"


def _explain_unknown(type_: type, data: Any, error: Any) -> str:
    place, known = _place(data, error["loc"]), dict(dotted_names(type_))
    plain = re.sub(r"\[\d+\]", "", place)
    above, _, name = plain.rpartition(".")
    section = place.rpartition(".")[0]
    if plain in known:
        return (
            f"{_cut(place, 60)}: got {brief(error['input'])}, which kind {error['loc'][-2]!r} does "
            "not use; expected a field of that kind"
        )
    beside = [one.rpartition(".")[2] for one in known if one.rpartition(".")[0] == above]
    owners = (known[f"{above}.{one}".removeprefix(".")] for one in beside)
    if new := next((o.renamed[name] for o in owners if name in getattr(o, "renamed", ())), None):
        new = f"{section}.{new}".removeprefix(".")
        return f"{_cut(place, 60)}: unknown key; it is called {new} since 0.3"
    alike = [f"{section}.{one}".removeprefix(".") for one in resembling(name, beside)]
    # A field may have been named without its section.
    deeper = [one for one in known if one.endswith(f".{name}")]
    meant = alike or (deeper if len(deeper) == 1 else [])
    hint = f"did you mean {meant[0]}?" if meant else f"expected one of {', '.join(beside)}"
    return f"{_cut(place, 60)}: unknown key; {hint}"


def _place(data: Any, loc: Iterable[int | str]) -> str:
    """Return where pydantic's `loc`, which also names kinds, is in the data, as `a.poses[2][0]`."""
    place = ""
    for part in loc:
        if isinstance(part, int) and isinstance(data, list):
            place, data = f"{place}[{part}]", data[part]
        elif isinstance(data, dict) and part in data:
            place, data = f"{place}.{part}", data[part]
    return place.removeprefix(".")
