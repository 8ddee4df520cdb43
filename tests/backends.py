"""The law in Python where the compiled one would serve."""

import pytest

from stewart_drake.law.core_law import Serving
from stewart_drake.loop import controller


def stepped_in_python(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let controllers that are made from now on step their law in Python."""
    monkeypatch.setattr(controller, "serving", lambda law: Serving(law, "python (asked for)"))
