"""Progress of an identification: its phase, and the iterations of that."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from typing import Final

_show: Final = ContextVar[Callable[[str], None]]("show", default=lambda _: None)
_phase: Final = ContextVar[str]("phase", default="")


@contextmanager
def shown_by(show: Callable[[str], None]) -> Iterator[None]:
    """Call `show` with the phase and the iteration of each fit inside."""
    token = _show.set(show)
    try:
        yield
    finally:
        _show.reset(token)


def phase(text: str) -> None:
    """Begin a phase, such as `start 1 of at most 4`."""
    _phase.set(text)
    _show.get()(text)


def iteration(number: int, most: int) -> None:
    """Report an iteration of the phase, of at most `most`."""
    _show.get()(f"{_phase.get()}, iteration {number} of at most {most}")
