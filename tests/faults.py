"""Files that are wrong, and what a refusal must look like."""

import copy
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from stewart_drake.cli import main
from stewart_drake.files.errors import ConfigError

Loader = Callable[[Path], Any]


def put(document: dict[str, Any], name: str, value: Any) -> dict[str, Any]:
    """Return a copy with a dotted field set."""
    changed = copy.deepcopy(document)
    *above, last = name.split(".")
    section = changed
    for key in above:
        section = section.setdefault(key, {})
    section[last] = value
    return changed


def yaml_text(document: Any) -> str:
    """Return YAML, which is JSON but for numbers that are not finite."""
    text = json.dumps(document)
    return text.replace("-Infinity", "-.inf").replace("Infinity", ".inf").replace("NaN", ".nan")


def written(path: Path, content: str | bytes) -> Path:
    """Write a file and return its path."""
    path.write_bytes(content if isinstance(content, bytes) else content.encode())
    return path


def tree(folder: Path) -> dict[str, bytes | None]:
    """Return everything below a folder: the bytes of files, None for the rest."""
    return {
        str(path.relative_to(folder)): path.read_bytes() if path.is_file() else None
        for path in folder.rglob("*")
    }


def one_line(call: Callable[[], Any], *parts: str, start: str = "") -> str:
    """Return the message of a call that is refused: a line with a beginning and further parts."""
    with pytest.raises(ConfigError) as caught:
        call()
    said = str(caught.value)
    assert len(said.splitlines()) == 1 and said.startswith(start)
    for part in parts:
        assert part in said
    return said


def complaint(load: Loader, path: Path) -> str:
    """Return the message of a file that is refused: one line that names the path."""
    said = one_line(lambda: load(path), str(path))
    check_remedy(said)
    return said


def check_remedy(said: str) -> None:
    """Fail unless a message says what is accepted or what to do."""
    remedies = (
        "expected ",
        "did you mean ",
        "is missing",
        "shipped names",
        "--help",
        "accepted",
        "choose another",
    )
    assert any(words in said.lower() for words in map(str.lower, remedies)), f"no remedy: {said}"


def refusal(arguments: list[str], capsys: Any) -> str:
    """Return the line on stderr of a command that is refused with exit status 2."""
    status = main(arguments)
    out, err = capsys.readouterr()
    assert status == 2, f"exit status {status}: {err}"
    assert out == ""
    assert err.startswith("error: ") and err.endswith("\n") and err.count("\n") == 1, err
    assert "Traceback" not in err
    check_remedy(err)
    return err
