"""What is told of a result: made once, shown as a page (`report.page`) and at a terminal.

A document is a verdict and sections, a section an ordered list of blocks. A page shows all of it; a
terminal of 80 columns shows the verdict and, of sections that are not folded, the blocks that are
`brief`.
"""

import textwrap
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from itertools import zip_longest
from typing import TYPE_CHECKING, Any, ClassVar, Final, Literal, TypeVar

from stewart_drake.reporting.words import WIDTH, rows, sentence, wrap

if TYPE_CHECKING:
    from matplotlib.figure import Figure

Tone = Literal["good", "fair", "bad", "plain"]
"""What a verdict amounts to; shown by a word and a bar, so that grey print tells it too."""

_SHORT: Final = 36
"""Characters of a cell that stays on one line of a page."""


@dataclass(frozen=True)
class Paragraph:
    """Plain text."""

    text: str
    brief: bool = False
    kind: ClassVar = "paragraph"

    def plain(self) -> str:
        """For a terminal."""
        return wrap(self.text)


@dataclass(frozen=True)
class Caution:
    """What a reader should be warned of."""

    text: str
    brief: ClassVar = True
    kind: ClassVar = "caution"

    @property
    def sentence(self) -> str:
        """For a page."""
        return f"Warning: {sentence(self.text)}"

    def plain(self) -> str:
        """For a terminal."""
        return wrap(f"warning: {self.text}")


@dataclass(frozen=True)
class Values:
    """Names and what they are, with units."""

    entries: Mapping[str, str]
    brief: bool = True
    kind: ClassVar = "values"

    def plain(self) -> str:
        """For a terminal."""
        return rows(self.entries)


Cell = str | None
"""None is a cell that the one before it covers too."""


@dataclass(frozen=True)
class Table:
    """A table; its cells are shown as they are, columns of numbers to the right.

    Attributes:
        columns: the head, with units.
        rows: as many cells each as there are columns.
        caption: what it shows, a sentence.
        brief: whether a terminal shows it, or the heads that it has there, None for a column that
            is left out; "\\n" breaks a head.

    Raises:
        ValueError: a row of another length.
    """

    columns: Sequence[str]
    rows: Sequence[Sequence[Cell]]
    caption: str = ""
    brief: bool | Sequence[str | None] = False
    kind: ClassVar = "table"

    def __post_init__(self) -> None:
        for number, row in enumerate(self.rows, start=1):
            if len(row) != len(self.columns):
                raise ValueError(
                    f"row {number} has {len(row)} cells; expected {len(self.columns)}, one per "
                    "column"
                )

    def joined(self, row: Sequence[Cell]) -> list[tuple[int, str, int]]:
        """The cells of a row: its first column, the text, how many columns it covers."""
        starts = [k for k, cell in enumerate(row) if cell is not None]
        ends = [*starts[1:], len(row)]
        return [(k, row[k] or "", end - k) for k, end in zip(starts, ends, strict=True)]

    def _single(self, k: int) -> list[str]:
        cells = [one for row in self.rows for one in self.joined(row)]
        return [text for first, text, count in cells if first == k and count == 1]

    @cached_property
    def short(self) -> list[bool]:
        """Per column, whether no cell need be broken over lines."""
        return [all(len(text) <= _SHORT for text in self._single(k)) for k in self._numbers]

    @cached_property
    def numeric(self) -> list[bool]:
        """Per column, whether its cells are numbers (or dashes) and are aligned to the right."""
        return [
            bool(self._single(k)) and all(map(_is_number, self._single(k))) for k in self._numbers
        ]

    @property
    def _numbers(self) -> range:
        return range(len(self.columns))

    def plain(self) -> str:
        """For a terminal: what is too wide is wrapped, the widest column first."""
        heads = self.columns if isinstance(self.brief, bool) else self.brief
        kept = [k for k, head in enumerate(heads) if head is not None]
        shown = Table([heads[k] or "" for k in kept], [[row[k] for k in kept] for row in self.rows])
        gap, widths = shown._fitting()
        right = [self.numeric[k] for k in kept]
        lines = [wrap(self.caption)] if self.caption else []
        for row, is_head in [(shown.columns, True), *((row, False) for row in shown.rows)]:
            columns = []
            for k, text, count in shown.joined(row):
                width = sum(widths[k : k + count]) + gap * (count - 1)
                parts = [p for line in text.split("\n") for p in textwrap.wrap(line, width)]
                columns.append([(p.rjust if right[k] else p.ljust)(width) for p in parts or [""]])
                if is_head:  # stands on the line below it
                    columns[-1].reverse()
            blanks = [" " * len(column[0]) for column in columns]
            told = [
                (" " * gap).join(p or b for p, b in zip(line, blanks, strict=True)).rstrip()
                for line in zip_longest(*columns)
            ]
            lines += reversed(told) if is_head else told
        return "\n".join(lines)

    def _fitting(self) -> tuple[int, list[int]]:
        """The gap between columns and their widths, with heads of as few lines as will do."""
        for gap in (2, 1):
            for lines in range(1, 6):
                widths = self._widths(lines)
                if sum(widths) + gap * (len(widths) - 1) <= WIDTH:
                    return gap, widths
        while sum(widths) + len(widths) - 1 > WIDTH:
            widths[widths.index(max(widths))] -= 1
        return 1, widths

    def _widths(self, lines: int) -> list[int]:
        """Of columns that hold their cells, and their heads in so many lines."""
        widths = [
            max(map(len, [_broken(head, lines), *self._single(k)]))
            for k, head in enumerate(self.columns)
        ]
        for row in self.rows:
            for k, text, count in self.joined(row):
                lacking = len(text) - sum(widths[k : k + count]) - (count - 1)
                for j in range(lacking):
                    widths[k + j % count] += 1
        return widths


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
    """All that is told.

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
        """For a terminal: at most 80 columns."""
        text = wrap(self.verdict) if self.verdict else ""
        for section in self.sections:
            told = [
                block.plain()
                for block in section.blocks
                if block.brief and not isinstance(block, Picture | Listing | Frame)
            ]
            if told and not section.folded:
                text += "\n".join([f"\n\n{section.heading}" if section.heading else "", *told])
        return text.strip()


def _broken(head: str, lines: int) -> str:
    """The widest line of a head that is broken as evenly as so many lines allow."""
    broken = head.split("\n")
    if len(broken) == 1:
        widths = range(max(map(len, head.split()), default=1), len(head) + 1)
        wrapped = (textwrap.wrap(head, width) for width in widths)
        broken = next((parts for parts in wrapped if len(parts) <= lines), [head])
    return max(broken, key=len)


def _is_number(cell: str) -> bool:
    text = cell.strip()
    return text in ("", "-", "–", "∞", "NaN") or text.lstrip("+-−<>≤≥±* ")[:1].isdigit()
