"""Scenarios and controllers from files, overlays and settings.

Precedence, lowest first: the scenario file, a controller laid over it, single settings. Each layer
is checked on its own, so that a message names the place to mend. A field that is set where it has
no effect is refused (`scenario.dependencies`), unless a higher layer removed the effect: then it
is dropped.
"""

import dataclasses
import typing
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any, NamedTuple

from stewart_drake.files.errors import ConfigError
from stewart_drake.files.resources import absolute_path, is_path, resolve, shipped
from stewart_drake.files.schema import field_names, plain, sections, spelling
from stewart_drake.files.yamlio import brief, load_yaml, parse_value, validate, yaml_text
from stewart_drake.scenario.config import (
    ControllerConfig,
    DelayConfig,
    Scenario,
    compatible_actuator,
    with_actuator,
)
from stewart_drake.scenario.dependencies import Idle, idle_fields, reset_idle

_SETTINGS = "settings"
_FILES = {"file", "calibration", "learned"}  # always a path; others may be a shipped name
_OVERLAY = "overlay"
_KINDS = sections(Scenario)


def load_scenario(
    name_or_path: Scenario | str | Path,
    controller: str | Path | None = None,
    settings: Iterable[str] = (),
) -> Scenario:
    """Read and check a scenario.

    Args:
        name_or_path: a shipped name or a YAML file. Paths inside the file start from its folder;
            missing fields keep their defaults.
        controller: a shipped name or a YAML file, laid over the scenario's own.
        settings: `section.field=value`, `field=value` or deeper, the value in YAML, e.g.
            `plant.gravity=true`; paths start from the working directory. A setting of a section's
            kind also drops the file's fields of another kind. `overlay=dirty` lays the fields of a
            shipped overlay or a YAML file over the scenario.

    Raises:
        ConfigError: the first problem, in one line.
    """
    read = read_scenario(name_or_path, controller, settings)
    read.scenario.check(read.where)
    for idle in idle_fields(read.scenario):
        if place := read.place_to_mend(idle):
            raise ConfigError(f"{place}: {idle.problem}")
    reset_idle(read.scenario)
    sc, places = read.scenario, read.places
    overridden = places.get("link") == _SETTINGS != places.get("delay")
    if overridden and sc.link.kind == "network" and not sc.link.follows_delay:
        sc.delay = DelayConfig()  # without effect; see `loop.cautions.idle_delay`
    return sc


def as_scenario(
    given: Scenario | str | Path,
    controller: str | Path | None = None,
    settings: Iterable[str] = (),
) -> Scenario:
    """Return a scenario as it is, or load it by its shipped name or path.

    A controller and settings are laid over a Scenario, too.

    Raises:
        TypeError: another type.
        ConfigError: bad input.
    """
    if isinstance(given, Scenario) and controller is None and not settings:
        return given
    return load_scenario(given, controller, settings)


def title_of(scenario: Scenario | str | Path) -> str:
    """Return the name of a scenario in titles: its file's, or the folder's of scenario.yaml."""
    if isinstance(scenario, Scenario):
        return "scenario"
    path = Path(scenario)
    return path.stem if path.stem != "scenario" else path.resolve().parent.name


def load_compatible(
    name_or_path: Scenario | str | Path,
    controller: str | Path | None = None,
    settings: Iterable[str] = (),
) -> Scenario:
    """Read a scenario as `load_scenario`, for one of several controllers.

    A scenario's servos are for controllers that send cranks. Others drive the same machine without
    them, within the same torque limit. Fields without an effect are not refused.
    """
    scenario, where, *_ = read_scenario(name_or_path, controller, settings)
    scenario.actuator = compatible_actuator(scenario.controller.command, scenario.actuator)
    scenario.check(where)
    reset_idle(scenario)
    return scenario


class Read(NamedTuple):
    scenario: Scenario  # its fields are checked one by one only
    where: str  # opening of a message
    places: dict[str, str]  # the file, or "settings", that set a field last, by its dotted name
    idle: set[str]  # names of the fields without an effect in the scenario's file by itself
    path: str  # of that file

    def place_to_mend(self, idle: Idle) -> str | None:
        """Return the place that set an idle field, None if a higher layer made it idle.

        A controller's file is for scenarios of any kind: only its own fields must fit.
        """
        place = self.places.get(idle.field)
        if place == self.path:
            return place if idle.field in self.idle else None
        return place if place == _SETTINGS or idle.other.startswith("controller.") else None


def read_scenario(
    name_or_path: Scenario | str | Path,
    controller: str | Path | None = None,
    settings: Iterable[str] = (),
    stays_blind: bool = False,
) -> Read:
    """Read a scenario and check its fields one by one only.

    Args:
        name_or_path: as of `load_scenario`, or a Scenario, like a file of all its fields.
        controller, settings: as of `load_scenario`.
        stays_blind: whether settings of the assumed delay leave a controller that assumes none.
    """
    if isinstance(name_or_path, Scenario):
        path, data = Path("scenario"), scenario_to_dict(name_or_path)
    elif isinstance(name_or_path, str | Path):
        path = resolve("scenario", name_or_path)
        data = load_yaml(path)
    else:
        raise TypeError(
            f"scenario: got a {type(name_or_path).__name__}; expected a Scenario, or the name or "
            "path of one"
        )
    _refuse_mechanism(path, data)
    _drop_foreign_nulls(data)
    idle = {one.field for one in idle_fields(validate(Scenario, data, str(path)))}
    places = dict.fromkeys(_dotted_names(data), str(path))
    _make_paths_absolute(data, path.parent)
    laid: dict[str, Any] = {}
    if controller is not None:
        laid = load_controller(controller)
        places |= dict.fromkeys(_dotted_names({"controller": laid}), str(controller))
        data["controller"] = data.get("controller", {}) | laid
    overlay = _parse_settings(setting_texts(settings), data)
    if stays_blind and laid.get("delay_steps") == 0 and "controller" in overlay:
        fields = overlay["controller"].items()
        overlay["controller"] = {k: v for k, v in fields if not k.startswith("delay_")}
    places |= dict.fromkeys(_dotted_names(overlay), _SETTINGS)
    for name, change in overlay.items():
        data[name] = _laid_over(name, data.get(name), change)
    where = f"{path} with settings" if overlay else str(path)
    return Read(validate(Scenario, data, str(path)), where, places, idle, str(path))


def _refuse_mechanism(path: Path, data: dict[str, Any]) -> None:
    if "home" in data and "mechanism" not in data:
        raise ConfigError(
            f"{path}: got a mechanism; expected a scenario, whose field mechanism names this file"
        )


def _dotted_names(data: dict[str, Any], above: str = "") -> Iterator[str]:
    """Yield the name of every field in the data, and of the sections."""
    for name, value in data.items():
        yield f"{above}{name}"
        if isinstance(value, dict):
            yield from _dotted_names(value, f"{above}{name}.")


def load_controller(name_or_path: str | Path) -> dict[str, Any]:
    """Read a controller: fields of the scenario's section `controller`, without `period`."""
    path = resolve("controller", name_or_path)
    data = load_yaml(path)
    if "period" in data:
        raise ConfigError(
            f"{path}: period: got {brief(data['period'])}; a controller keeps the scenario's "
            "controller.period, set it there"
        )
    validate(ControllerConfig, data, str(path))
    _make_paths_absolute({"controller": data}, path.parent)
    return data


def load_comparison(
    name_or_path: Scenario | str | Path,
    controllers: Iterable[str | Path],
    settings: Iterable[str] = (),
    refuse_idle: bool = True,
    further: bool = True,
) -> dict[str, Scenario]:
    """Read a scenario once for every controller, and for every further row of its `compare`.

    Settings of the assumed delay do not change a controller that assumes none. Each row has
    compatible motors, see `load_compatible`.

    Args:
        name_or_path, settings: as of `load_scenario`.
        controllers: shipped names, rows of the scenario's `compare`, or paths; the row of a path
            is named after its file.
        refuse_idle: whether to refuse a field that has an effect in no row.
        further: whether to add the rows of `compare` that are not among the controllers, in the
            file's order.
    """
    settings = setting_texts(settings)
    read = read_scenario(name_or_path, settings=settings)
    read.scenario.check_rows(read.where)
    changes, rows = read.scenario.compare, {}
    named = _rows_of(controllers)
    everywhere = {one.field for one in idle_fields(read.scenario)}
    for row in dict.fromkeys([*named, *(changes if further else ())]):
        given = named.get(row, row)
        where = f"{read.path}: compare.{row}"
        change = {} if is_path(given) else dict(changes.get(row, {}))
        controller, actuator = change.pop("controller", given), change.pop("actuator", {})
        scenario = read_scenario(name_or_path, controller, settings, stays_blind=True).scenario
        changed = dataclasses.asdict(scenario.controller) | change
        scenario.controller = validate(ControllerConfig, changed, where)
        motors = compatible_actuator(scenario.controller.command, scenario.actuator)
        scenario.actuator = with_actuator(plain(motors), actuator, where)
        scenario.check(where)
        idle = {one.field: one for one in idle_fields(scenario)}
        for field in idle.keys() & {f"controller.{name}" for name in change}:
            raise ConfigError(f"{where}: {idle[field].problem}")
        everywhere &= idle.keys()
        reset_idle(scenario)
        rows[row] = scenario
    for one in idle_fields(read.scenario) if refuse_idle else ():
        if one.field in everywhere and (place := read.place_to_mend(one)):
            raise ConfigError(f"{place}: {one.problem}")
    return rows


def _rows_of(controllers: Iterable[str | Path]) -> dict[str, str | Path]:
    """Return controllers by the name of their row."""
    rows: dict[str, str | Path] = {}
    for one in controllers:
        row = Path(one).stem if is_path(one) else str(one)
        if row in rows:
            raise ConfigError(f"controllers: got {row!r} twice; expected different names")
        if is_path(one) and row in shipped("controller"):
            raise ConfigError(
                f"controllers: got {str(one)!r}, named as a shipped controller; expected another "
                "file name"
            )
        rows[row] = one
    return rows


def scenario_to_dict(scenario: Scenario) -> dict[str, Any]:
    """Return the scenario as plain data that `load_scenario` reads back from JSON or YAML."""
    return plain(scenario)


def scenario_yaml(scenario: Scenario) -> str:
    """Return the scenario as the text of a file that `load_scenario` reads back."""
    return yaml_text(scenario_to_dict(scenario))


def setting_choices() -> list[str]:
    """Return the beginning of every setting, `plant.time_step=`; whole for words and booleans."""
    choices: dict[str, None] = {}  # kinds have fields in common
    for name, hint in typing.get_type_hints(Scenario).items():
        members = [m for m in (*typing.get_args(hint), hint) if dataclasses.is_dataclass(m)]
        hints = [
            (f"{name}.{spelling(member, field)}", inner)
            for member in members
            for field, inner in typing.get_type_hints(member).items()
        ]
        for field, inner in hints or [(name, hint)]:
            is_literal = typing.get_origin(inner) is typing.Literal
            values = typing.get_args(inner) if is_literal else ("",)
            values = ("true", "false") if inner is bool else values
            choices |= dict.fromkeys(f"{field}={value}" for value in values)
    return [*choices, *(f"{_OVERLAY}={name}" for name in shipped("overlay"))]


def setting_texts(settings: Iterable[str]) -> tuple[str, ...]:
    """Return settings; raise an error for what is no list of texts, such as a text or a mapping."""
    given = () if isinstance(settings, str | Mapping) else tuple(settings)
    if isinstance(settings, str | Mapping) or not all(isinstance(one, str) for one in given):
        raise ConfigError(
            f"{_SETTINGS}: got {brief(settings)}; expected a list of texts, such as "
            "['plant.kind=exact']"
        )
    return given


def _parse_settings(settings: Iterable[str], data: dict[str, Any]) -> dict[str, Any]:
    """Return settings as a partial scenario; of two for one field the later one counts.

    A section with kinds that a setting touches has its kind in the result.
    """
    changes = [_parse_setting(setting) for setting in settings]
    for section, kinds in _KINDS.items():
        touching = [part for c in changes if isinstance(part := c.get(section), dict)]
        layers = [{"kind": next(iter(kinds))}, data.get(section, {}), *touching]
        kind = [layer["kind"] for layer in layers if "kind" in layer][-1]
        for part in touching:
            part.setdefault("kind", kind)
    overlay: dict[str, Any] = {}
    for change in changes:
        _drop_foreign_nulls(change)
        validate(Scenario, change, _SETTINGS)
        _make_paths_absolute(change, Path.cwd())
        for name, part in change.items():
            overlay[name] = _laid_over(name, overlay.get(name), part)
    return overlay


def _parse_setting(setting: str) -> dict[str, Any]:
    key, equals, text = setting.partition("=")
    if key.strip() == _OVERLAY and text:
        path = resolve("overlay", text.strip())
        overlay = load_yaml(path)
        _refuse_mechanism(path, overlay)
        validate(Scenario, overlay, str(path))
        _make_paths_absolute(overlay, path.parent)
        return overlay
    parts = key.strip().split(".")
    if not equals or not all(parts):
        raise ConfigError(
            f"{_SETTINGS}: got {brief(setting)}; expected section.field=value or field=value, "
            "where a value may be {name: value, ...}"
        )
    change = parse_value(text, f"{_SETTINGS}: {key.strip()}")
    for part in reversed(parts[2:]):
        change = _Within({part: change})
    for part in reversed(parts[:2]):
        change = {part: change}
    return dict(change)


def _laid_over(name: str, below: Any, above: Any) -> Any:
    """Return a scenario's field under a checked change; a new kind drops fields of others."""
    if not isinstance(above, dict):
        return above
    kept = below or {}
    if name in _KINDS:
        known = field_names(_KINDS[name][above["kind"]])
        kept = {field: value for field, value in kept.items() if field in known}
    return {**kept, **{field: _within(kept.get(field), part) for field, part in above.items()}}


class _Within(dict[str, Any]):
    """Fields of a value below a section's fields; its others stay as they are."""


def _within(below: Any, above: Any) -> Any:
    if not isinstance(above, _Within) or not isinstance(below, dict):
        return above
    return type(below)({**below, **{k: _within(below.get(k), v) for k, v in above.items()}})


def _drop_foreign_nulls(data: dict[str, Any]) -> None:
    """Remove nulls for fields of another kind, which files of 0.1 have."""
    for section, kinds in _KINDS.items():
        given = data.get(section)
        if isinstance(given, dict) and (
            own := kinds.get(str(given.get("kind", next(iter(kinds)))))
        ):
            foreign = {n for kind in kinds.values() for n in field_names(kind)} - {
                *field_names(own)
            }
            for name in foreign & {n for n, value in given.items() if value is None}:
                del given[name]


def _make_paths_absolute(data: dict[str, Any], folder: Path) -> None:
    """Make every relative path in `data` absolute against a folder; shipped names stay."""

    def resolved(fields: dict[str, Any], *names: str) -> None:
        for name in names:
            value = fields.get(name)
            if isinstance(value, str) and (name in _FILES or is_path(value)):
                fields[name] = str(absolute_path(value, folder))

    resolved(data, "mechanism")
    resolved(data.get("plant", {}), "mechanism")
    for fields in (data.get("controller", {}), *data.get("compare", {}).values()):
        resolved(fields, "calibration", "learned", "controller")  # the latter in a row of `compare`
    reference = data.get("reference", {})
    if reference.get("file") not in shipped("move") or reference.get("kind") != "reachy_move":
        resolved(reference, "file")
    resolved(data.get("tuner", {}), "weights")
