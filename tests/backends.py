"""One process, both backends of the dynamics."""

import os
from collections.abc import Iterator
from contextlib import contextmanager
from unittest.mock import patch

import pytest

from stewart_drake.dynamics.functions import compiled_functions
from stewart_drake.law.native_law import Serving
from stewart_drake.loop import controller
from stewart_drake.native import library


@contextmanager
def switched(value: str | None) -> Iterator[None]:
    """Within it STEWART_NATIVE is this, or not there; objects that were made before stay."""
    settings = {} if value is None else {library.SWITCH: value}
    with patch.dict(os.environ, settings):
        if value is None:
            os.environ.pop(library.SWITCH, None)
        _forget()
        try:
            yield
        finally:
            _forget()


def _forget() -> None:
    library.backend.cache_clear()
    compiled_functions.cache_clear()


def stepped_in_python(monkeypatch: pytest.MonkeyPatch) -> None:
    """Controllers that are made from now on step their law in Python, whatever is compiled."""
    monkeypatch.setattr(controller, "serving", lambda law: Serving(law, "python (asked for)"))
