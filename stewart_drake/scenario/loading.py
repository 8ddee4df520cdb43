"""Scenarios and controllers from files, overlays and settings.

Precedence, lowest first: the scenario file, a controller laid over it, single settings. Each layer
is checked on its own, so that a message names the place to mend. A field that is set where it has
no effect is refused (`scenario.dependencies`), unless a layer above it made it so: then it is
dropped.
"""

import dataclasses
import typing
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

from stewart_drake.files.errors import ConfigError
from stewart_drake.files.resources import absolute_path, is_path, resolve, shipped
from stewart_drake.files.schema import field_names, plain, sections, spelling
from stewart_drake.files.yamlio import brief, load_yaml, parse_yaml, validate, yaml_text
from stewart_drake.scenario.config import (
    ControllerConfig,
    Scenario,
    compatible_actuator,
    with_actuator,
)
from stewart_drake.scenario.dependencies import Idle, idle_fields, reset

_SETTINGS = "settings"
_FILES = ("file", "calibration")
"""Fields that are always a path; others may be a shipped name."""
_OVERLAY = "overlay"
_KINDS = sections(Scenario)


def load_scenario(
    name_or_path: str | Path,
    controller: str | Path | None = None,
    settings: Iterable[str] = (),
) -> Scenario:
    """Reads and checks a scenario.

    Args:
        name_or_path: a shipped name or a YAML file. Paths inside the file start from its folder;
            what the file leaves out keeps its default.
        controller: a controller to lay over it, as `load_controller` takes it.
        settings: `section.field=value` or `field=value`, the value in YAML, e.g.
            `plant.gravity=true`; paths start from the working directory. A setting of a
            section's kind also drops what the file says for another kind. `overlay=dirty` lays the
            fields of a shipped overlay or a YAML file over the scenario.

    Raises:
        ConfigError: the first problem, in one line.
    """
    read = read_scenario(name_or_path, controller, settings)
    read.scenario.check(read.where)
    for idle in idle_fields(read.scenario):
        if place := read.asker(idle):
            raise ConfigError(f"{place}: {idle.problem}")
    return _without_idle(read.scenario)


def as_scenario(given: Scenario | str | Path) -> Scenario:
    """Return a scenario as it is, or load it by its shipped name or path."""
    return given if isinstance(given, Scenario) else load_scenario(given)


def load_compatible(
    name_or_path: str | Path,
    controller: str | Path | None = None,
    settings: Iterable[str] = (),
) -> Scenario:
    """As `load_scenario`, for one of several controllers on a scenario.

    What the scenario says of servos is for controllers that send cranks. Others drive the same
    machine without them, within the same torque limit. Fields without an effect are not refused.
    """
    scenario, where, *_ = read_scenario(name_or_path, controller, settings)
    scenario.actuator = compatible_actuator(scenario.controller.command, scenario.actuator)
    scenario.check(where)
    return _without_idle(scenario)


class Read(NamedTuple):
    """A scenario that was read.

    Attributes:
        scenario: its fields are checked one by one only.
        where: what it is, for messages.
        places: the file, or "settings", that set a field last, by the field's dotted name.
        idle: names of the fields without an effect in the scenario's file by itself.
        path: of that file.
    """

    scenario: Scenario
    where: str
    places: dict[str, str]
    idle: set[str]
    path: str

    def asker(self, idle: Idle) -> str | None:
        """Return the place that is to be mended, None if a layer above made the field idle.

        A controller's file is for scenarios of any kind: only its own fields are to fit.
        """
        place = self.places.get(idle.field)
        if place == self.path:
            return place if idle.field in self.idle else None
        return place if place == _SETTINGS or idle.other.startswith("controller.") else None


def read_scenario(
    name_or_path: str | Path,
    controller: str | Path | None = None,
    settings: Iterable[str] = (),
) -> Read:
    """Read a scenario, its fields checked one by one only."""
    path = resolve("scenario", name_or_path)
    data = load_yaml(path)
    _drop_foreign_nulls(data)
    idle = {one.field for one in idle_fields(validate(Scenario, data, str(path)))}
    places = dict.fromkeys(_dotted_names(data), str(path))
    _make_paths_absolute(data, path.parent)
    if controller is not None:
        laid = load_controller(controller)
        places |= dict.fromkeys(_dotted_names({"controller": laid}), str(controller))
        data["controller"] = {**data.get("controller", {}), **laid}
    overlay = _parse_settings(settings, data)
    places |= dict.fromkeys(_dotted_names(overlay), _SETTINGS)
    for name, change in overlay.items():
        data[name] = _laid_over(name, data.get(name), change)
    where = f"{path} with settings" if overlay else str(path)
    return Read(validate(Scenario, data, str(path)), where, places, idle, str(path))


def _dotted_names(data: dict[str, Any], above: str = "") -> Iterator[str]:
    """Every field in the data, with those that it is in."""
    for name, value in data.items():
        yield f"{above}{name}"
        if isinstance(value, dict):
            yield from _dotted_names(value, f"{above}{name}.")


def _without_idle(scenario: Scenario) -> Scenario:
    """The scenario with fields without an effect at their defaults."""
    for idle in idle_fields(scenario):
        reset(scenario, idle.field)
    return scenario


def load_controller(name_or_path: str | Path) -> dict[str, Any]:
    """Reads a controller: the fields of the scenario's `controller` section that it sets.

    Args:
        name_or_path: a shipped name or a YAML file of flat keys.

    Returns:
        The keys listed in the file and their values, checked; `period` is never among them.

    Raises:
        ConfigError: unreadable file, unknown key, bad value, or a `period`.
    """
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
    name_or_path: str | Path,
    controllers: Iterable[str],
    settings: Iterable[str] = (),
    refuse_idle: bool = True,
) -> dict[str, Scenario]:
    """Reads a scenario once for every controller, and for every further row of its `compare`.

    What `settings` say of the delay that is believed in does not change a controller that knows of
    none. Each has motors that understand it, see `load_compatible`.

    Args:
        name_or_path, settings: as of `load_scenario`.
        controllers: names or paths.
        refuse_idle: whether to refuse a field that has an effect in no row.

    Returns:
        Scenarios by row: the controllers, then the further rows in the file's order.

    Raises:
        ConfigError: the first problem, in one line.
    """
    settings = tuple(settings)
    others = tuple(s for s in settings if not s.strip().startswith("controller.delay_"))
    unchecked = read_scenario(name_or_path, settings=settings)
    unchecked.scenario.check_rows(unchecked.where)
    changes, rows = unchecked.scenario.compare, {}
    everywhere = {one.field for one in idle_fields(unchecked.scenario)}
    for row in dict.fromkeys([*controllers, *changes]):
        where, change = f"{name_or_path}: compare.{row}", dict(changes.get(row, {}))
        controller, actuator = change.pop("controller", row), change.pop("actuator", {})
        blind = load_controller(controller).get("delay_steps") == 0
        scenario = read_scenario(name_or_path, controller, others if blind else settings).scenario
        changed = dataclasses.asdict(scenario.controller) | change
        scenario.controller = validate(ControllerConfig, changed, where)
        motors = compatible_actuator(scenario.controller.command, scenario.actuator)
        scenario.actuator = with_actuator(plain(motors), actuator, where)
        scenario.check(where)
        idle = {one.field: one for one in idle_fields(scenario)}
        for field in idle.keys() & {f"controller.{name}" for name in change}:
            raise ConfigError(f"{where}: {idle[field].problem}")
        everywhere &= idle.keys()
        rows[row] = _without_idle(scenario)
    for one in idle_fields(unchecked.scenario) if refuse_idle else ():
        if one.field in everywhere and (place := unchecked.asker(one)):
            raise ConfigError(f"{place}: {one.problem}")
    return rows


def scenario_to_dict(scenario: Scenario) -> dict[str, Any]:
    """The scenario as plain data that JSON and YAML can hold, and `load_scenario` reads back."""
    return plain(scenario)


def scenario_yaml(scenario: Scenario) -> str:
    """The scenario as the text of a file that `load_scenario` reads back."""
    return yaml_text(scenario_to_dict(scenario))


def setting_choices() -> list[str]:
    """The beginning of every setting, `plant.time_step=`; whole where values can be counted."""
    choices: dict[str, None] = {}  # kinds have fields in common
    for name, hint in typing.get_type_hints(Scenario).items():
        members = [m for m in (*typing.get_args(hint), hint) if dataclasses.is_dataclass(m)]
        hints = [
            (f"{name}.{spelling(member, field)}", inner)
            for member in members
            for field, inner in typing.get_type_hints(member).items()
        ]
        for field, inner in hints or [(name, hint)]:
            values: tuple[Any, ...] = ("",)
            if inner is bool:
                values = ("true", "false")
            elif typing.get_origin(inner) is typing.Literal:
                values = typing.get_args(inner)
            choices |= dict.fromkeys(f"{field}={value}" for value in values)
    return [*choices, *(f"{_OVERLAY}={name}" for name in shipped("overlay"))]


def _parse_settings(settings: Iterable[str], data: dict[str, Any]) -> dict[str, Any]:
    """Settings for a scenario's data as a partial one; of two for one field the later one counts.

    The kind of a section that any of them touches is said in what is returned.
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
    """One setting as a partial scenario."""
    key, equals, text = setting.partition("=")
    if key.strip() == _OVERLAY and text:
        path = resolve("overlay", text.strip())
        overlay = load_yaml(path)
        validate(Scenario, overlay, str(path))
        _make_paths_absolute(overlay, path.parent)
        return overlay
    parts = key.strip().split(".")
    if not equals or not all(parts) or len(parts) > 2:
        raise ConfigError(
            f"{_SETTINGS}: got {brief(setting)}; expected section.field=value or field=value"
        )
    value = parse_yaml(text, f"{_SETTINGS}: {key}")
    change: dict[str, Any] = {parts[-1]: value}
    return {parts[0]: change} if len(parts) == 2 else change


def _laid_over(name: str, below: Any, above: Any) -> Any:
    """A scenario's field under a checked change; a new kind drops what it does not know."""
    if not isinstance(above, dict):
        return above
    kept = below or {}
    if name in _KINDS:
        known = field_names(_KINDS[name][above["kind"]])
        kept = {field: value for field, value in kept.items() if field in known}
    return {**kept, **above}


def _drop_foreign_nulls(data: dict[str, Any]) -> None:
    """Forget a null for a field of another kind: it says that there is none, as in older files."""
    for section, kinds in _KINDS.items():
        given = data.get(section)
        if not isinstance(given, dict):
            continue
        own = kinds.get(str(given.get("kind", next(iter(kinds)))))
        foreign = {name for kind in kinds.values() for name in field_names(kind)}
        for name in foreign - set(field_names(own)) if own else ():
            if name in given and given[name] is None:
                del given[name]


def _make_paths_absolute(data: dict[str, Any], folder: Path) -> None:
    """Ties every relative path in `data` to the folder it was written for; names stay names."""

    def tie(fields: dict[str, Any], name: str) -> None:
        value = fields.get(name)
        if isinstance(value, str) and (name in _FILES or is_path(value)):
            fields[name] = str(absolute_path(value, folder))

    tie(data, "mechanism")
    tie(data.get("plant", {}), "mechanism")
    for fields in (data.get("controller", {}), *data.get("compare", {}).values()):
        tie(fields, "calibration")
        tie(fields, "controller")  # of a row of `compare`
    tie(data.get("reference", {}), "file")
    tie(data.get("tuner", {}), "weights")
