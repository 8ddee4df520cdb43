"""Scenarios and controllers from files, overlays and settings.

Precedence, lowest first: the scenario file, a controller laid over it, single settings. Each layer
is checked on its own, so that a message names the place to mend.
"""

import dataclasses
import io
import typing
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from ruamel.yaml import YAML
from ruamel.yaml.representer import RoundTripRepresenter

from stewart_drake.config import KIND_FIELDS, ControllerConfig, Scenario
from stewart_drake.errors import ConfigError
from stewart_drake.resources import absolute_path, is_path, resolve
from stewart_drake.yamlio import brief, load_yaml, parse_yaml, validate

_SETTINGS = "settings"


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
            `plant.gravity=true`; paths start from the working directory. A setting of
            `reference.kind` or `tuner.kind` also drops what the file says for another kind.

    Raises:
        ConfigError: the first problem, in one line.
    """
    path = resolve("scenario", name_or_path)
    data = load_yaml(path)
    validate(Scenario, data, str(path))
    _refuse_foreign_fields(data, str(path))
    _make_paths_absolute(data, path.parent)
    if controller is not None:
        data["controller"] = {**data.get("controller", {}), **load_controller(controller)}
    overlay = _parse_settings(settings)
    for section, kinds in KIND_FIELDS.items():
        if "kind" in overlay.get(section, {}):
            kept = ("kind", *kinds[overlay[section]["kind"]])
            data[section] = {k: v for k, v in data.get(section, {}).items() if k in kept}
    for key, value in overlay.items():
        data[key] = {**data.get(key, {}), **value} if isinstance(value, dict) else value
    _refuse_foreign_fields(data, _SETTINGS)
    scenario = validate(Scenario, data, str(path))
    scenario.check(f"{path} with settings" if overlay else str(path))
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
    return data


def scenario_to_dict(scenario: Scenario) -> dict[str, Any]:
    """The scenario as plain data that JSON and YAML can hold, and `load_scenario` reads back.

    Fields without a meaning for the chosen kind of reference or tuner are left out.
    """
    data = dataclasses.asdict(scenario)
    for section, kinds in KIND_FIELDS.items():
        meant = ("kind", *kinds[data[section]["kind"]])
        data[section] = {k: v for k, v in data[section].items() if k in meant}
    return data


def scenario_yaml(scenario: Scenario) -> str:
    """The scenario as the text of a file that `load_scenario` reads back."""
    yaml, text = YAML(), io.StringIO()
    yaml.width, yaml.Representer = 96, _Representer
    yaml.dump(scenario_to_dict(scenario), text)
    return text.getvalue()


class _Representer(RoundTripRepresenter):
    """Lists on one line, and null by its name."""

    def flat(self, values: list[Any]) -> Any:
        return self.represent_sequence("tag:yaml.org,2002:seq", values, flow_style=True)

    def null(self, _: None) -> Any:
        return self.represent_scalar("tag:yaml.org,2002:null", "null")


_Representer.add_representer(list, _Representer.flat)
_Representer.add_representer(type(None), _Representer.null)


def setting_choices() -> list[str]:
    """The beginning of every setting, `plant.time_step=`; whole where values can be counted."""
    hints: dict[str, Any] = {}
    for field in dataclasses.fields(Scenario):
        section = getattr(Scenario(), field.name)
        if dataclasses.is_dataclass(section):
            hints |= {
                f"{field.name}.{leaf.name}": leaf.type for leaf in dataclasses.fields(section)
            }
        else:
            hints[field.name] = field.type
    choices = []
    for name, hint in hints.items():
        values: tuple[Any, ...] = ("",)
        if hint is bool:
            values = ("true", "false")
        elif typing.get_origin(hint) is typing.Literal:
            values = typing.get_args(hint)
        choices += [f"{name}={value}" for value in values]
    return choices


def _parse_settings(settings: Iterable[str]) -> dict[str, Any]:
    """Settings as a partial scenario; of two for one field the later one counts."""
    overlay: dict[str, Any] = {}
    for setting in settings:
        key, equals, text = setting.partition("=")
        parts = key.strip().split(".")
        if not equals or not all(parts) or len(parts) > 2:
            raise ConfigError(
                f"{_SETTINGS}: got {brief(setting)}; expected section.field=value or field=value"
            )
        value = parse_yaml(text, f"{_SETTINGS}: {key}")
        change: dict[str, Any] = {parts[-1]: value}
        if len(parts) == 2:
            change = {parts[0]: change}
        validate(Scenario, change, _SETTINGS)
        _make_paths_absolute(change, Path.cwd())
        for name, part in change.items():
            overlay[name] = {**overlay.get(name, {}), **part} if isinstance(part, dict) else part
    return overlay


def _refuse_foreign_fields(data: dict[str, Any], where: str) -> None:
    """Refuses fields of another kind: they would have no effect, and nobody would notice."""
    for section, kinds in KIND_FIELDS.items():
        given = data.get(section, {})
        kind = given.get("kind", next(iter(kinds)))
        for name, value in given.items():
            if name != "kind" and name not in kinds[kind] and value is not None:
                meant = ", ".join(kinds[kind]) or "none but kind"
                raise ConfigError(
                    f"{where}: {section}.{name}: got {brief(value)}, which kind {kind!r} does not "
                    f"use; expected only its own fields: {meant}"
                )


def _make_paths_absolute(data: dict[str, Any], folder: Path) -> None:
    """Ties every relative path in `data` to the folder it was written for; names stay names."""

    def tie(fields: dict[str, Any], name: str) -> None:
        value = fields.get(name)
        if value is not None and (name == "file" or is_path(value)):
            fields[name] = str(absolute_path(value, folder))

    tie(data, "mechanism")
    tie(data.get("reference", {}), "file")
    tie(data.get("tuner", {}), "weights")
