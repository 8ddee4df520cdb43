"""A study and what is told of it, from Python, in a notebook and as files."""

import html as escaping
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

from stewart_drake.files.jsonio import write_json
from stewart_drake.reporting.document import Document
from stewart_drake.reporting.page import Provenance, html, write_page

PAGE: Final = "report.html"


@dataclass(frozen=True, repr=False)
class Answer:
    """An analysis or a report; printed it is text, in a notebook the page.

    Attributes:
        study: everything that was found.
        summary: what `summary.json` holds.
        document: what is told of it.
        made: how.
    """

    study: Any
    summary: dict[str, Any]
    document: Document
    made: Provenance

    @property
    def verdict(self) -> str:
        """In a sentence or two."""
        return self.document.verdict

    def __repr__(self) -> str:
        return f"Answer({self.verdict!r})"

    def __str__(self) -> str:
        return self.document.plain()

    def _repr_html_(self) -> str:
        return framed(html(self.document, self.made))

    def save_page(self, directory: Path) -> Path:
        """Write report.html into a directory.

        Raises:
            OSError: the directory cannot be written to.
        """
        return write_page(self.document, self.made, directory / PAGE)

    def save(self, directory: str | Path) -> Path:
        """Write report.html and summary.json into a directory, which is made; the page's path.

        Raises:
            OSError: the directory cannot be written to.
        """
        folder = Path(directory)
        folder.mkdir(parents=True, exist_ok=True)
        write_json(folder / "summary.json", self.summary)
        return self.save_page(folder)


def answer_of(
    study: Callable[[], Any], document: Callable[[Any], Document], command: str
) -> Answer:
    """Do a study and tell of it.

    Args:
        study: what does it; what it returns has a `summary`, plain data.
        document: what tells of it.
        command: what does the same again, as typed.
    """
    started = time.perf_counter()
    found = study()
    made = Provenance(command, seconds=time.perf_counter() - started)
    return Answer(found, found.summary, document(found), made)


def framed(page: str) -> str:
    """A page inside another one, where its scripts reach nothing outside."""
    return (
        f'<iframe srcdoc="{escaping.escape(page)}" sandbox="allow-scripts" '
        'style="width: 100%; height: 600px; border: 0"></iframe>'
    )
