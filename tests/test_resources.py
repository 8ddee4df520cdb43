"""Shipped data are found by name in a checkout and in a wheel, everything else by path."""

from pathlib import Path

import pytest

from stewart_drake.files import resources
from stewart_drake.files.errors import ConfigError
from tests.faults import one_line


def test_a_wheel_carries_the_data_inside_the_package(tmp_path, monkeypatch):
    package = tmp_path / "site-packages" / "stewart_drake"
    wanted = package / "_data" / "models" / "mine.yaml"
    wanted.parent.mkdir(parents=True)
    wanted.touch()
    (package.parent / "models").mkdir()
    (package.parent / "models" / "somebody_elses.yaml").touch()
    monkeypatch.setattr(resources, "_PACKAGE", package)

    assert resources.shipped("mechanism") == ["mine"]
    assert resources.resolve("mechanism", "mine") == wanted


def test_a_path_starts_from_the_working_directory(tmp_path, monkeypatch):
    file = tmp_path / "sub" / "mine.yaml"
    file.parent.mkdir()
    file.touch()
    assert resources.resolve("scenario", file) == file
    inside = file.with_name("scenario.yaml")
    inside.touch()
    assert resources.resolve("scenario", file.parent) == inside
    monkeypatch.chdir(tmp_path)
    assert resources.resolve("scenario", "./sub/mine.yaml") == file
    assert resources.resolve("scenario", "sub/mine.yaml") == file
    assert resources.resolve("scenario", Path("sub/mine.yaml")) == file
    machine = inside.with_name("machine.yaml")
    machine.touch()
    assert resources.resolve("mechanism", "./sub") == machine
    with pytest.raises(ConfigError, match=r"got 'sub'; expected sub/machine\.yaml, one of"):
        resources.resolve("mechanism", "sub")
    with pytest.raises(ConfigError, match=r"got 'sub'; expected sub/scenario\.yaml, one of"):
        resources.resolve("scenario", "sub")


def test_a_shipped_name_is_a_file_and_never_one_in_the_working_directory(tmp_path, monkeypatch):
    (tmp_path / "paper").write_text("not this one")
    monkeypatch.chdir(tmp_path)
    for kind in ("mechanism", "scenario", "controller", "weights"):
        for name in resources.shipped(kind):
            path = resources.resolve(kind, name)
            assert path.is_absolute() and path.is_file() and path.stem == name
            assert path.parent != tmp_path


@pytest.mark.parametrize(
    ("name", "parts"),
    [
        ("gravty", ["'gravty'", "expected one of gravity, ", "paper"]),
        ("", ["''", "gravity", "a path"]),
        ("..", ["'..'", "paper"]),
        ("./paper", ["no file", "/paper'", "gravity", "paper"]),
        ("missing.yaml", ["no file", "/missing.yaml'"]),
        *((odd, ["no file"]) for odd in ("nul\0/x", "two\nlines/x", "long" * 5000 + "/x")),
    ],
)
def test_what_is_missing_is_named_in_one_line(name, parts):
    one_line(lambda: resources.resolve("scenario", name), *parts, start="scenario: ")
