"""Help with examples, shell completion, 80 columns."""

import dataclasses

import pytest
import typer

from stewart_drake.cli import app, main
from stewart_drake.cli.examples import EXAMPLES
from stewart_drake.files.resources import shipped
from stewart_drake.files.schema import field_names, plain, sections
from stewart_drake.files.yamlio import parse_yaml, validate
from stewart_drake.scenario.config import Scenario
from stewart_drake.scenario.loading import load_scenario, scenario_yaml, setting_choices
from stewart_drake.studies.study_options import RANGE_UNITS, Ranges
from tests import test_docs

main(["--version"])  # which also puts the examples where they belong


def commands(group, words=()):
    """All commands by the words that call them."""
    found = {}
    for name, command in group.commands.items():
        if hasattr(command, "commands"):
            found |= commands(command, (*words, name))
        else:
            found[" ".join((*words, name))] = command
    return found


COMMANDS = commands(typer.main.get_command(app))


@pytest.mark.parametrize("words", COMMANDS)
def test_the_help_of_every_command_ends_with_an_example(words, capsys):
    assert main([*words.split(), "--help"]) == 0
    lines = capsys.readouterr().out.rstrip().splitlines()
    assert lines[0].startswith("Usage: stewart-drake")
    assert any(line.strip() in ("Example:", "Examples:") for line in lines)
    assert lines[-1].startswith(f"    stewart-drake {words}")
    assert all(len(line) <= 80 for line in lines)


CONTINUING = ("analyze robustness", "layout", "tune dataset", "tune train", "tune evaluate")


@pytest.mark.parametrize("words", CONTINUING)
def test_the_help_of_a_long_command_says_that_it_continues(words, capsys):
    assert main([*words.split(), "--help"]) == 0
    said = " ".join(capsys.readouterr().out.split())
    assert "same command continues an interrupted " in said


def test_every_example_is_of_a_command_and_parses():
    unknown = set(EXAMPLES) - set(COMMANDS) - {""}
    assert not unknown
    for lines in EXAMPLES.values():
        test_docs.test_commands_parse(
            test_docs.Block(test_docs.ROOT / "examples", 1, "sh", "\n".join(lines))
        )


def test_robustness_tells_the_unit_of_everything_that_it_varies(capsys):
    """In its help, with the default, and in the line about a wrong value."""
    assert set(RANGE_UNITS) == {field.name for field in dataclasses.fields(Ranges)}
    assert main(["analyze", "robustness", "--help"]) == 0
    shown = " ".join(capsys.readouterr().out.split())
    for name, unit in RANGE_UNITS.items():
        assert f"{name}: {unit} ({getattr(Ranges(), name)})" in shown
        assert main(["analyze", "robustness", "--vary", f"{name}=-1"]) == 2
        error = capsys.readouterr().err
        assert f"{name}: {unit}" in " ".join(error.split()) and len(error.splitlines()) == 1
    assert main(["analyze", "robustness", "--vary", "zzz=1"]) == 2
    error = capsys.readouterr().err
    assert error.startswith("error: --vary: zzz: unknown key; expected one of payload, ")
    assert "share of" not in error  # units are for a wrong value


# ---------------------------------------------------------------- completion


def test_the_shell_completes_commands_names_and_settings(monkeypatch, capsys):
    monkeypatch.setenv("_STEWART_DRAKE_COMPLETE", "complete_bash")

    def offered(typed):
        monkeypatch.setenv("COMP_WORDS", typed)
        monkeypatch.setenv("COMP_CWORD", str(len(typed.split(" ")) - 1))
        with pytest.raises(SystemExit) as done:
            main([])
        out, err = capsys.readouterr()
        assert err == "" and done.value.code == 0
        return out.split()

    assert offered("stewart-drake si") == ["simulate"]
    assert set(offered("stewart-drake simulate ")) >= set(shipped("scenario"))
    assert offered("stewart-drake model check mot") == ["motion_base"]
    assert offered("stewart-drake simulate --set plant.k") == [
        "plant.kind=multibody",
        "plant.kind=exact",
        "plant.kind=paper",
    ]
    assert "--replay" in offered("stewart-drake simulate --r")


def test_every_offered_setting_names_a_field_and_its_values_are_accepted():
    assert len(setting_choices()) == len(set(setting_choices())) > 40
    for choice in setting_choices():
        name, _, value = choice.partition("=")
        section, _, field = name.rpartition(".")
        if name == "overlay":  # no field but a file laid over the scenario
            assert load_scenario("paper", settings=[choice]) != load_scenario("paper")
            continue
        given = {field: parse_yaml(value, name)} if value else {}
        if not section:
            assert hasattr(validate(Scenario, given, name), field)
            continue
        # A section's kind may be offered before the rest of what that kind needs.
        kinds = sections(Scenario).get(section, {})
        kind = {"kind": next((k for k in kinds if field in field_names(kinds[k])), None)}
        whole = validate(Scenario, {section: (kind if kinds else {}) | given}, name)
        assert field in plain(getattr(whole, section))


# ---------------------------------------------------------------- scenarios as text


@pytest.mark.parametrize("name", shipped("scenario"))
def test_a_scenario_written_as_text_is_read_back(name, tmp_path):
    path = tmp_path / "again.yaml"
    path.write_text(scenario_yaml(load_scenario(name)))
    assert load_scenario(path) == load_scenario(name)
    assert all(len(line) <= 120 for line in path.read_text().splitlines())
