"""Documents of results: made once, shown as a page (`reporting.page`) and at a terminal.

A document is a verdict and sections, a section an ordered list of blocks. A page shows all of it; a
terminal of 80 columns shows the verdict and, of sections that are not folded, the blocks that are
`brief`.
"""

import textwrap
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from io import StringIO
from typing import TYPE_CHECKING, Any, ClassVar, Final, Literal, TypeVar

from stewart_drake.reporting.words import WIDTH, number, rows, sentence, wrap

if TYPE_CHECKING:
    from matplotlib.figure import Figure

Tone = Literal["good", "fair", "bad", "plain"]
"""Grade of a verdict; a page shows it by the kind of a bar, in grey print too."""

_SHORT: Final = 36
"""Characters of a cell that stays on one line of a page."""
_Item = TypeVar("_Item")


@dataclass(frozen=True)
class Paragraph:
    """Plain text."""

    text: str
    brief: bool = False
    kind: ClassVar = "paragraph"

    def plain(self) -> str:
        return wrap(self.text)


@dataclass(frozen=True)
class Caution:
    """A warning to the reader."""

    text: str
    brief: ClassVar = True
    kind: ClassVar = "caution"

    @property
    def sentence(self) -> str:
        return f"Warning: {sentence(self.text)}"

    def plain(self) -> str:
        return wrap(f"warning: {self.text}")


@dataclass(frozen=True)
class Values:
    """Names and what they are, with units."""

    entries: Mapping[str, str]
    brief: bool = True
    kind: ClassVar = "values"

    def plain(self) -> str:
        return rows(self.entries)


@dataclass(frozen=True)
class Table:
    """A table; its cells are shown as they are, columns of numbers to the right.

    Attributes:
        columns: the head, with units.
        rows: as many cells each as there are columns; a terminal breaks them at "\\n".
        caption: a sentence above it.
        brief: whether a terminal shows it, or the heads that it has there, None for a column that
            is left out; "\\n" breaks a head.

    Raises:
        ValueError: a row of another length.
    """

    columns: Sequence[str]
    rows: Sequence[Sequence[str]]
    caption: str = ""
    brief: bool | Sequence[str | None] = False
    kind: ClassVar = "table"

    def __post_init__(self) -> None:
        for count, row in enumerate(self.rows, start=1):
            if len(row) != len(self.columns):
                raise ValueError(
                    f"row {count} has {len(row)} cells; expected {len(self.columns)}, one per "
                    "column"
                )

    @cached_property
    def short(self) -> list[bool]:
        """Per column, whether no cell need be broken over lines."""
        return [all(len(row[k]) <= _SHORT for row in self.rows) for k in range(len(self.columns))]

    @cached_property
    def numeric(self) -> list[bool]:
        """Per column, whether its cells are numbers (or dashes) and are aligned to the right."""
        return [
            bool(self.rows) and all(_is_number(row[k]) for row in self.rows)
            for k in range(len(self.columns))
        ]

    def plain(self) -> str:
        """Return the table for a terminal; what is too wide is wrapped."""
        from rich.console import Console
        from rich.table import Table as Grid
        from rich.text import Text

        console = Console(width=WIDTH, file=StringIO(), color_system=None)
        brief = self.columns if isinstance(self.brief, bool) else self.brief
        kept = [k for k, head in enumerate(brief) if head is not None]
        heads = [brief[k] or "" for k in kept]
        cells = [
            min(
                _SHORT,
                max((len(part) for row in self.rows for part in row[k].split("\n")), default=1),
            )
            for k in kept
        ]
        for gap, most in ((2, WIDTH), (2, 16), (2, 13), (2, 10), (2, 1), (1, 10), (1, 1)):
            shown = [
                head
                if "\n" in head
                else textwrap.fill(head, max(width, most), break_long_words=False)
                for head, width in zip(heads, cells, strict=True)
            ]
            widths = [
                max(width, *map(len, head.split("\n")))
                for head, width in zip(shown, cells, strict=True)
            ]
            if sum(widths) + gap * (len(kept) - 1) <= WIDTH:
                break
        grid = Grid(box=None, padding=(0, gap, 0, 0), pad_edge=False)
        for k, head in zip(kept, shown, strict=True):
            grid.add_column(Text(head), justify="right" if self.numeric[k] else "left")
        for row in self.rows:
            grid.add_row(*(Text(row[k]) for k in kept))
        with console.capture() as capture:
            console.print(grid)
        lines = [line.rstrip() for line in capture.get().splitlines()]
        return "\n".join([*([wrap(self.caption)] if self.caption else []), *lines])


def table(
    items: Iterable[_Item],
    columns: Mapping[str, Callable[[_Item], object]],
    caption: str = "",
    brief: bool | Sequence[str | None] = False,
) -> Table:
    """Return a table with a row per item, and per column how a cell follows from it.

    Floats get three significant digits. Blanks at the end of a head tell it from another one that
    is shown alike.
    """
    rows = [[_text(cell(item)) for cell in columns.values()] for item in items]
    return Table([head.rstrip(" ") for head in columns], rows, caption, brief)


def _text(value: object) -> str:
    return number(value) if isinstance(value, float) else str(value)


@dataclass(frozen=True)
class Picture:
    """A figure and the sentence under it, for a page.

    Attributes:
        figure: drawn inside `style.figure_style`, or what draws it when the page is made.
        caption: what it shows.
    """

    figure: "Figure | Callable[[], Figure]"
    caption: str
    brief: ClassVar = False
    kind: ClassVar = "picture"

    @cached_property
    def drawn(self) -> "Figure":
        """The figure."""
        return self.figure() if callable(self.figure) else self.figure

    def __reduce__(self) -> tuple[Any, ...]:  # what draws it may hold what no process can send
        return Picture, (self.drawn, self.caption)


@dataclass(frozen=True)
class Listing:
    """Lines shown as they are on a page."""

    text: str
    brief: ClassVar = False
    kind: ClassVar = "listing"


@dataclass(frozen=True)
class Frame:
    """A whole HTML page inside a page, on screen only.

    It runs its scripts, but cannot reach anything outside.
    """

    html: str
    brief: ClassVar = False
    kind: ClassVar = "frame"


Block = Paragraph | Caution | Values | Table | Picture | Listing | Frame
_Kind = TypeVar("_Kind")


class Section:
    """A heading and what stands below it.

    Args:
        heading: a short title, or empty.
        parts: blocks; a bare text is a paragraph that only pages show.
        folded: start closed, for what only some readers want; not at a terminal.
    """

    def __init__(self, heading: str, *parts: Block | str, folded: bool = False) -> None:
        self.heading, self.folded = heading, folded
        self.blocks = [Paragraph(part) if isinstance(part, str) else part for part in parts]

    def all(self, kind: type[_Kind]) -> list[_Kind]:
        """The blocks of a kind."""
        return [block for block in self.blocks if isinstance(block, kind)]


@dataclass(frozen=True)
class Document:
    """A verdict and its sections.

    Attributes:
        title: what was looked at.
        verdict: the answer in a sentence or two, or empty.
        sections: in order; a page lists their headings where there are several.
        tone: of the verdict.
        facts: a few names and values below the verdict of a page, with units.
    """

    title: str
    verdict: str
    sections: Sequence[Section]
    tone: Tone = "plain"
    facts: Mapping[str, str] = field(default_factory=dict)

    def plain(self) -> str:
        """Return the document for a terminal, in at most 80 columns."""
        text = wrap(self.verdict) if self.verdict else ""
        for section in self.sections:
            told = [
                block.plain()
                for block in section.blocks
                if block.brief and not isinstance(block, Picture | Listing | Frame)
            ]
            if told and not section.folded:
                text += "\n".join([f"\n\n{section.heading}" if section.heading else "", *told])
        return text.strip("\n")


def _is_number(cell: str) -> bool:
    text = cell.strip()
    return text in ("", "-", "–", "∞", "NaN") or text.lstrip("+-−<>≤≥±* ")[:1].isdigit()
