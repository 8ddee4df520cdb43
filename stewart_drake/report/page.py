"""An analysis as one self-contained HTML page: verdict, sections, and how it was made.

The page needs no other file and no network: figures are embedded. It is readable on a small screen,
in dark mode, and printed in grey.
"""

import base64
import io
import shlex
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import lru_cache
from pathlib import Path
from typing import Final, Literal

from jinja2 import Environment, PackageLoader, StrictUndefined
from matplotlib.figure import Figure

from stewart_drake.files.fileio import replacing
from stewart_drake.files.versions import versions
from stewart_drake.native.library import backend
from stewart_drake.report.style import figure_style, for_dark_too

Tone = Literal["good", "fair", "bad", "plain"]
"""What a verdict amounts to; shown by a word and a bar, so that grey print tells it too."""

_TEMPLATE: Final = "page.html.j2"
_SHORT: Final = 36
"""Characters of a cell that stays on one line."""


@dataclass(frozen=True)
class Table:
    """A table; its cells are shown as they are, those that start like a number to the right.

    Attributes:
        columns: the head, with units.
        rows: as many cells each as there are columns.
        caption: what it shows, a sentence.

    Raises:
        ValueError: a row of another length.
    """

    columns: Sequence[str]
    rows: Sequence[Sequence[str]]
    caption: str = ""

    def __post_init__(self) -> None:
        for number, row in enumerate(self.rows, start=1):
            if len(row) != len(self.columns):
                raise ValueError(
                    f"row {number} has {len(row)} cells; expected {len(self.columns)}, one per "
                    "column"
                )

    @property
    def short(self) -> list[bool]:
        """Per column, whether no cell need be broken over lines."""
        return [all(len(row[k]) <= _SHORT for row in self.rows) for k in range(len(self.columns))]

    @property
    def numeric(self) -> list[bool]:
        """Per column, whether its cells are numbers (or dashes) and are aligned to the right."""
        return [
            bool(self.rows) and all(_is_number(row[k]) for row in self.rows)
            for k in range(len(self.columns))
        ]


@dataclass(frozen=True)
class Picture:
    """A figure and the sentence under it.

    Attributes:
        figure: drawn inside `style.figure_style`.
        caption: what it shows.
    """

    figure: Figure
    caption: str

    @property
    def source(self) -> str:
        """The figure as a data URI: vectors, sharp when enlarged, readable on light and dark."""
        data = io.BytesIO()
        with figure_style():
            self.figure.savefig(data, format="svg", metadata={"Date": None})
        content = for_dark_too(data.getvalue())
        return f"data:image/svg+xml;base64,{base64.b64encode(content).decode()}"

    @property
    def size(self) -> tuple[int, int]:
        """Width and height in the pixels of a browser, 96 per inch."""
        width, height = 96 * self.figure.get_size_inches()
        return round(width), round(height)


@dataclass(frozen=True)
class Section:
    """A heading and what stands below it: paragraphs, tables, pictures, a listing, a frame.

    Attributes:
        heading: a short title.
        text: paragraphs of plain text.
        tables, pictures: may be none.
        folded: start closed, for what only some readers want.
        listing: lines to be shown as they are, or empty.
        frame: a whole HTML page to be shown inside this one, on screen only, or empty. It runs its
            scripts, but cannot reach anything outside.
    """

    heading: str
    text: Sequence[str] = ()
    tables: Sequence[Table] = ()
    pictures: Sequence[Picture] = ()
    folded: bool = False
    listing: str = ""
    frame: str = ""


@dataclass(frozen=True)
class Provenance:
    """How a page was made.

    Attributes:
        command: what makes it again, as typed.
        versions: of what it depends on.
        seconds: how long it took, or None.
        backend: what ran the dynamics.
    """

    command: str
    versions: Mapping[str, str] = field(default_factory=versions)
    seconds: float | None = None
    backend: str = field(default_factory=lambda: backend().name)


@dataclass(frozen=True)
class Page:
    """A whole page.

    Attributes:
        title: what was looked at.
        verdict: the answer, one sentence.
        tone: of the verdict.
        facts: a few names and values beside the verdict, with units.
        sections: in order; a list of contents is made of them where there are several.
        provenance: how it was made.
    """

    title: str
    verdict: str
    sections: Sequence[Section]
    provenance: Provenance
    tone: Tone = "plain"
    facts: Mapping[str, str] = field(default_factory=dict)

    def html(self) -> str:
        """The page as text; whatever its parts hold is escaped."""
        return environment().get_template(_TEMPLATE).render(page=self)


def write_page(page: Page, path: Path) -> Path:
    """Write a page whole or not at all.

    Raises:
        OSError: the file cannot be written.
    """
    text = page.html()
    with replacing(path) as partial:
        partial.write_text(text, encoding="utf-8")
    return path


def command_line(
    *words: str, settings: Iterable[str] = (), options: Mapping[str, object] | None = None
) -> str:
    """`stewart-drake` with these words, `--set` for each setting, and options that are not None.

    An option whose value is a list or tuple is given once for each of its items.
    """
    parts = ["stewart-drake", *words]
    for setting in settings:
        parts += ["--set", setting]
    for name, value in (options or {}).items():
        for one in value if isinstance(value, list | tuple) else (value,):
            if one is not None:
                parts += [f"--{name}", str(one)]
    return shlex.join(parts)


@lru_cache(maxsize=1)
def environment() -> Environment:
    """Where the templates of all pages are found, with their rules."""
    return Environment(
        loader=PackageLoader("stewart_drake.report"),
        autoescape=True,  # names come from files
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )


def _is_number(cell: str) -> bool:
    text = cell.strip()
    return text in ("", "-", "–", "∞", "NaN") or text.lstrip("+-−<>≤≥±").strip()[:1].isdigit()
