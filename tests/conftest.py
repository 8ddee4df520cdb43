"""Fixtures and settings that all tests share."""

import signal
from collections.abc import Iterator

import pytest

from stewart_drake.reporting import terminal
from tests import building  # noqa: F401  (before the workers start: it makes their folder)
from tests.browser import Browser, browser
from tests.shorter import leave_blank

# A shell that runs the tests in the background lets them ignore Ctrl-C, and the commands that they
# start would inherit that; those are tested for what they do on Ctrl-C.
if signal.getsignal(signal.SIGINT) == signal.SIG_IGN:
    signal.signal(signal.SIGINT, signal.default_int_handler)

# What takes long on a busy machine tells on stderr how far it is, where tests expect nothing.
terminal.EVERY = 3600.0


@pytest.fixture(scope="session")
def one_browser() -> Iterator[Browser]:
    """Return the browser of a session, which takes seconds to start."""
    with browser() as opened:
        yield opened


@pytest.fixture
def tab(one_browser: Browser) -> Iterator[Browser]:
    """Its tab; `Browser.open` sets all that a test before may have changed."""
    yield one_browser
    one_browser.call("Page.navigate", url="about:blank")  # an animation would go on for ever


@pytest.fixture
def blank_figures(monkeypatch: pytest.MonkeyPatch) -> None:
    """Write empty pictures."""
    leave_blank(monkeypatch)
