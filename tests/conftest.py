"""Fixtures and settings that all tests share."""

import signal
from collections.abc import Iterator

import joblib
import pytest

from stewart_drake.live import contact
from stewart_drake.loop.results import SimulationResult
from stewart_drake.loop.simulation import simulate
from stewart_drake.reporting import terminal
from stewart_drake.scenario.loading import load_scenario
from tests import building  # noqa: F401  (before the workers start: it makes their folder)
from tests.browser import Browser, browser
from tests.shorter import leave_blank, map_few_poses

# A shell that runs the tests in the background lets them ignore Ctrl-C, and the commands that they
# start would inherit that; those are tested for what they do on Ctrl-C.
if signal.getsignal(signal.SIGINT) == signal.SIG_IGN:
    signal.signal(signal.SIGINT, signal.default_int_handler)

# What takes long on a busy machine tells on stderr how far it is, where tests expect nothing.
terminal.EVERY = 3600.0

# A session begins after half a second of requests, in the place of two seconds.
contact._ENOUGH_TRIPS = 25

# Studies run here: processes import for seconds. Tests of processes ask for workers or for cores.
joblib.cpu_count = lambda: 1


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Begin with the longest test: at the end all others would be done, and wait for it."""
    items.sort(key=lambda item: item.path.name != "test_tutorial.py")


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


@pytest.fixture
def few_poses(monkeypatch: pytest.MonkeyPatch) -> None:
    """Map the workspace coarsely."""
    map_few_poses(monkeypatch)


@pytest.fixture(scope="session")
def followed() -> SimulationResult:
    """Return 0.3 s on the paper's reference, of the exact plant."""
    settings = ("plant.kind=exact", "duration=0.3", "start=on_reference", "queue=reference")
    return simulate(load_scenario("paper", settings=settings), judge_stability=False)
