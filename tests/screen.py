"""Run a command, and check that its output fits a terminal of 80 columns."""

import json
from pathlib import Path
from typing import Any

from stewart_drake.cli import main

NAMES_A_FILE = ("written to ", "next: ", "overlay=/")


def too_long(printed: str) -> list[str]:
    """Return the lines that do not fit, but for those that name a file or folder, of any length."""
    return [
        s for s in printed.splitlines() if len(s) > 80 and not s.lstrip().startswith(NAMES_A_FILE)
    ]


def said(capsys: Any, *words: str | Path) -> str:
    """Return what a command prints; it succeeds, fits the screen and has nothing on stderr."""
    assert main([*map(str, words)]) == 0
    out, err = capsys.readouterr()
    assert err == "" and not too_long(out)
    return str(out)


def summary_in(folder: Path) -> Any:
    """Return the summary that a command wrote into a folder."""
    return json.loads((folder / "summary.json").read_text())
