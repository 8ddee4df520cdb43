"""Documents of results, shown as a page (`reporting.page`) and on a terminal.

A document is a verdict and sections; a section is an ordered list of blocks. A page shows all of
it. A terminal of 80 columns shows the verdict and the `brief` blocks of sections that are not
folded.

The text of a document is a template, templates/NAME.md.j2: parts with empty lines between them.
Jinja renders each part separately, so that no value can change the structure. A part that is empty
after rendering is left out. Numbers get three significant digits.

    ! Title                  begins the document; paragraphs are its verdict, values its facts
    # Heading                begins a section, #- a folded one
    text                     is a paragraph of a page
    > text                   is a paragraph of a page and of a terminal
    = name :: value          is a value with its name
    @name caption            is what has this name, such as `study.loops`: blocks, texts of
                             warnings, or a function that draws a figure; a paragraph if it is True
      | head :: cell         below it is a column of a table of all `it` in the named items
      | head :: brief :: cell    with the head on a terminal; the head - leaves the column out
      | @other               has the columns of another table
    text
      + cell :: cell         below it are head and rows of a table
      = name :: value        below it is a value of the named item, `it`

A terminal shows a table or a paragraph of `@>name`. A line is not broken at ~, a blank.
"""

import math
import re
import textwrap
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cache, cached_property
from io import StringIO
from typing import TYPE_CHECKING, Any, ClassVar, Final, Literal, NamedTuple, TypeVar

if TYPE_CHECKING:
    from jinja2 import Environment, Template
    from matplotlib.figure import Figure

Tone = Literal["good", "fair", "bad", "plain"]
"""Grade of a verdict; a page shows it by the kind of a bar, in grey print too."""

WIDTH: Final = 80
PAGE: Final = "report.html"
_NO_BREAK: Final = "\N{NO-BREAK SPACE}"
_TOGETHER: Final = r"(?<=\d) (?=(?:%|mm|ms|s|N|mN|kg|deg)(?!\w))|(?<=N) (?=m\b)|(?<=\d %) (?=s\b)"
"""Spaces at which no line is broken: before a unit and in it."""
_SHORT: Final = 36
"""Characters of a cell that stays on one line."""


def wrap(text: str, first: str = "", rest: str = "  ") -> str:
    """Return a paragraph of at most WIDTH columns; `first` and `rest` open its lines.

    A longer word, such as a path, stays whole.
    """
    together = re.sub(_TOGETHER, _NO_BREAK, text)
    filled = textwrap.fill(
        together,
        WIDTH,
        initial_indent=first,
        subsequent_indent=rest,
        break_long_words=False,
        break_on_hyphens=False,
    )
    return filled.replace(_NO_BREAK, " ")


def rows(entries: Mapping[str, str]) -> str:
    """Return names and texts in two columns, long texts wrapped."""
    indent = " " * (max(map(len, entries)) + 2)
    return "\n".join(wrap(text, name.ljust(len(indent)), indent) for name, text in entries.items())


def number(value: float, digits: int = 3) -> str:
    """Return a number with significant digits, a dash for NaN and infinity."""
    if not math.isfinite(value):
        return "-"
    if value != 0 and not 1e-4 <= abs(value) < 1e5:
        return f"{value:.0e}"
    exponent = int(f"{value:.{digits - 1}e}".partition("e")[2])  # of the rounded value
    return f"{value:.{max(0, digits - 1 - exponent if value else 0)}f}"


def measured(std: float, value: float) -> tuple[str, str]:
    """Return a standard deviation in two digits, and a value with as many decimals."""
    interval = number(std, 2)
    if "e" in interval:
        return interval, f"{value:.6g}"
    decimals = len(interval.partition(".")[2])
    return interval, f"{round(value, decimals) + 0.0:.{decimals}f}"  # without -0


def listed(items: Iterable[object], form: str) -> str:
    """Return items in one text, each in a form such as `%s: %g`."""
    return ", ".join(form % one for one in items)


def counted(number: int, words: str) -> str:
    """Return a number and what it counts: `2 samples late`, `1 sample late`.

    The first of the words is a plural.
    """
    first, blank, rest = words.partition(" ")
    return f"{number} {first.removesuffix('s') if number == 1 else first}{blank}{rest}"


def capital(text: str) -> str:
    return text[:1].upper() + text[1:]


def sentence(text: str) -> str:
    """Return a text with a capital first letter and a full stop."""
    return capital(text).removesuffix(".") + "."


@dataclass(frozen=True)
class Paragraph:
    text: str
    brief: bool = False

    def plain(self) -> str:
        return wrap(self.text)


@dataclass(frozen=True)
class Caution:
    """A warning to the reader."""

    text: str
    brief: ClassVar = True

    def plain(self) -> str:
        return wrap(f"warning: {self.text}")


@dataclass(frozen=True)
class Values:
    entries: Mapping[str, str]
    brief: bool = True

    def plain(self) -> str:
        return rows(self.entries)


@dataclass(frozen=True)
class Table:
    """A table of texts; columns of numbers are aligned to the right.

    Raises:
        ValueError: a row of another length than the head.
    """

    columns: Sequence[str]  # heads, with units
    rows: Sequence[Sequence[str]]  # cells; a terminal breaks them at "\n"
    caption: str = ""  # a sentence above the table
    # whether a terminal shows it, or the heads on a terminal, None for a column left out
    brief: bool | Sequence[str | None] = False

    def __post_init__(self) -> None:
        for count, row in enumerate(self.rows, start=1):
            if len(row) != len(self.columns):
                raise ValueError(
                    f"row {count} has {len(row)} cells; expected {len(self.columns)}, as columns"
                )

    @cached_property
    def short(self) -> list[bool]:
        """Whether all cells of a column fit on one line of a page, per column."""
        return [all(len(row[k]) <= _SHORT for row in self.rows) for k in range(len(self.columns))]

    @cached_property
    def numeric(self) -> list[bool]:
        """Whether all cells of a column are numbers or dashes, per column."""
        columns = range(len(self.columns))
        return [bool(self.rows) and all(_is_number(row[k]) for row in self.rows) for k in columns]

    def plain(self) -> str:
        """Return the table for a terminal, heads and long cells wrapped."""
        from rich.console import Console
        from rich.table import Table as Grid
        from rich.text import Text

        heads = self.columns if isinstance(self.brief, bool) else self.brief
        kept = {k: head for k, head in enumerate(heads) if head is not None}
        cells = {
            k: min(
                _SHORT, max([1, *(len(line) for row in self.rows for line in row[k].split("\n"))])
            )
            for k in kept
        }
        # The heads are wrapped as little as the width allows, but not narrower than their cells.
        for gap, most in ((2, WIDTH), (2, 16), (2, 13), (2, 10), (2, 1), (1, 10), (1, 1)):
            wrapped = {
                k: textwrap.wrap(head, max(cells[k], most), break_long_words=False) or [""]
                for k, head in kept.items()
            }
            widths = [max(cells[k], *map(len, wrapped[k])) for k in kept]
            if sum(widths) + gap * (len(kept) - 1) <= WIDTH:
                break
        grid = Grid(box=None, padding=(0, gap, 0, 0), pad_edge=False)
        for k, lines in wrapped.items():
            justify: Literal["right", "left"] = "right" if self.numeric[k] else "left"
            grid.add_column(Text("\n".join(lines)), justify=justify)
        for row in self.rows:
            grid.add_row(*(Text(row[k]) for k in kept))
        console = Console(width=WIDTH, file=StringIO(), color_system=None)
        with console.capture() as capture:
            console.print(grid)
        shown = [line.rstrip() for line in capture.get().replace(_NO_BREAK, " ").splitlines()]
        return "\n".join([*([wrap(self.caption)] if self.caption else []), *shown])


@dataclass(frozen=True)
class Picture:
    # drawn inside `style.figure_style`, or a function that draws it for a page
    figure: "Figure | Callable[[], Figure]"
    caption: str  # the sentence below it
    name: str = "figure"
    brief: ClassVar = False

    @cached_property
    def drawn(self) -> "Figure":
        return self.figure() if callable(self.figure) else self.figure

    def __reduce__(self) -> tuple[Any, ...]:  # the function may hold what cannot be pickled
        return Picture, (self.drawn, self.caption, self.name)


@dataclass(frozen=True)
class Listing:
    text: str
    brief: ClassVar = False


@dataclass(frozen=True)
class Frame:
    """An HTML page inside a page, on screen only; its scripts reach nothing outside."""

    source: str | Callable[[], str]  # the page, or a function that makes it when it is written
    name: str = "replay"
    brief: ClassVar = False

    @property
    def html(self) -> str:
        return self.source if isinstance(self.source, str) else self.source()


Block = Paragraph | Caution | Values | Table | Picture | Listing | Frame
_Kind = TypeVar("_Kind")


class Section:
    """A heading and blocks.

    Args:
        heading: a short title, or empty.
        parts: blocks; a text is a paragraph that only pages show.
        folded: closed at first on a page, left out on a terminal.
    """

    def __init__(self, heading: str, *parts: Block | str, folded: bool = False) -> None:
        self.heading, self.folded = heading, folded
        self.blocks = [Paragraph(part) if isinstance(part, str) else part for part in parts]

    def all(self, kind: type[_Kind]) -> list[_Kind]:
        return [block for block in self.blocks if isinstance(block, kind)]


@dataclass(frozen=True)
class Document:
    title: str  # subject
    verdict: str  # the conclusion in a sentence or two, or empty
    sections: list[Section]  # in order; a page lists the headings of more than two
    tone: Tone = "plain"  # of the verdict
    # names and values below the verdict of a page, with units
    facts: Mapping[str, str] = field(default_factory=dict)

    def all(self, kind: type[_Kind]) -> list[_Kind]:
        return [block for section in self.sections for block in section.all(kind)]

    def plain(self) -> str:
        """Return the document for a terminal, in at most 80 columns."""
        text = wrap(self.verdict) if self.verdict else ""
        for section in self.sections:
            shown = [
                block.plain()
                for block in section.blocks
                if block.brief and not isinstance(block, Picture | Listing | Frame)
            ]
            if shown and not section.folded:
                text += "\n".join([f"\n\n{section.heading}" if section.heading else "", *shown])
        return text.strip("\n")


def _is_number(cell: str) -> bool:
    text = cell.strip()
    return text in ("", "-", "–", "∞", "NaN") or text.lstrip("+-−<>≤≥±* ")[:1].isdigit()


def from_template(name: str, tone: Tone = "plain", /, **context: Any) -> Document:
    """Return the document of a template, with the sections that have a named block or need none."""
    found = []
    for heading, folded, parts in _template(name):
        values = [part.entry and part.entry(context) for part in parts]
        if any(values) or not any(part.entry for part in parts):
            pairs = zip(parts, values, strict=True)
            blocks = [block for part, value in pairs for block in _blocks(part, value, context)]
            found.append(Section(heading.render(context), *blocks, folded=folded))
    top, *others = found
    verdict = " ".join(part.text for part in top.all(Paragraph))
    facts = {key: text for one in top.all(Values) for key, text in one.entries.items()}
    return Document(top.heading, verdict, others, tone, facts)


class _Part(NamedTuple):
    """A part of a template; `rows` are the pieces of its lines that begin with `kind`."""

    mark: str
    entry: "Callable[[Mapping[str, Any]], Any] | None"  # returns what is named
    text: "Template"
    kind: str
    rows: "list[list[Template]]"
    name: str  # of what is named, such as `runs_figure`


def _blocks(part: _Part, value: Any, context: Mapping[str, Any]) -> Iterator[Block]:
    if part.entry and not value:
        return
    text = " ".join(part.text.render(context).split())
    if part.kind == "|":
        yield _table(part, text, value, context)
    elif part.kind == "=":
        pairs = ([one.render(context, it=value).strip() for one in row] for row in part.rows)
        if entries := {name: text for name, text in pairs if text}:
            yield Values(entries)
    elif part.kind == "+":
        head, *rows = [[one.render(context).strip() for one in row] for row in part.rows]
        yield Table(head, rows, text)
    elif part.entry is None:
        if text:
            yield Paragraph(text, part.mark == ">")
    else:
        for one in value if isinstance(value, list | tuple) else [value]:
            if one is True:
                yield Paragraph(text, part.mark == "@>")
            elif callable(one):
                yield Picture(one, text, part.name.removesuffix("_figure"))
            elif isinstance(one, str):
                yield Caution(one)
            else:
                yield replace(one, caption=text) if text and isinstance(one, Table) else one


def _table(part: _Part, caption: str, items: Any, context: Mapping[str, Any]) -> Table:
    heads = [[one.render(context).replace("~", _NO_BREAK) for one in row[:-1]] for row in part.rows]
    kept = [k for k, names in enumerate(heads) if names[0] != "-"]
    cells = [part.rows[k][-1] for k in kept]
    rows = [[one.render(context, it=item).strip() for one in cells] for item in items]
    brief: bool | list[str | None] = part.mark == "@>"
    if any(len(names) > 1 for names in heads):
        brief = [None if heads[k][-1] == "-" else heads[k][-1] for k in kept]
    return Table([heads[k][0] for k in kept], rows, caption, brief)


@cache
def _template(name: str) -> "list[tuple[Template, bool, list[_Part]]]":
    """Return the headings of a template, whether they are folded, and their parts."""
    environment = templates()
    assert environment.loader is not None
    found: list[tuple[Template, bool, list[_Part]]] = []
    columns: dict[str, list[list[Template]]] = {}
    source, *_ = environment.loader.get_source(environment, f"{name}.md.j2")
    for part in re.split(r"\n\s*\n", source.strip()):
        first, *lines = re.split(r"\n *(?=[|=+] )", f"\n{part}")
        opening = " ".join(first.split())
        ((mark, named, text),) = re.findall(r"^(#-?|[!>]|@>?|)([\w.]*)(.*)", opening)
        if "@" not in mark:
            named, text = "", named + text
        template = environment.from_string(text.strip())
        if mark in ("!", "#", "#-"):
            found.append((template, mark == "#-", []))
            continue
        rows = [re.sub(r"\s*\n\s*", " ", line[2:]).split(" :: ") for line in lines]
        pieces = [[environment.from_string(piece) for piece in row] for row in rows]
        if rows and rows[0][0].startswith("@"):
            pieces = columns[rows[0][0]]
        columns[f"@{named}"] = pieces
        entry = environment.compile_expression(named, undefined_to_none=False) if named else None
        found[-1][2].append(
            _Part(mark, entry, template, lines[0][0] if lines else "", pieces, named)
        )
    return found


@cache
def templates() -> "Environment":
    from jinja2 import Environment, PackageLoader, StrictUndefined

    def shown(value: object) -> object:
        return number(value) if isinstance(value, float) else value

    found = Environment(
        loader=PackageLoader("stewart_drake.reporting"), undefined=StrictUndefined, finalize=shown
    )
    found.filters |= {"number": number, "capital": capital, "listed": listed, "counted": counted}
    found.globals["inf"] = math.inf
    return found
