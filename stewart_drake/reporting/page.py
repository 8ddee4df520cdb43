"""A document as one self-contained HTML page: verdict, sections, and how it was made.

The page needs no other file and no network: figures are embedded. It is readable on a small screen,
in dark mode, and printed in grey.
"""

import io
import re
import shlex
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from functools import lru_cache
from pathlib import Path
from typing import Final
from urllib.parse import quote

from jinja2 import Environment, PackageLoader, StrictUndefined
from matplotlib.figure import Figure

from stewart_drake.files.fileio import write_whole
from stewart_drake.files.versions import versions
from stewart_drake.reporting.document import Document
from stewart_drake.reporting.style import figure_style, for_dark_too, rounded

_TEMPLATE: Final = "page.html.j2"
_LINE_END: Final = re.compile(r"\s*\n\s*")
_AS_IT_IS: Final = " <>'=/:;,.()[]{}!*?@+-_"


@dataclass(frozen=True)
class Provenance:
    """How a page was made.

    Attributes:
        command: what makes it again, as typed.
        versions: of what it depends on.
        seconds: how long it took, or None.
    """

    command: str
    versions: Mapping[str, str] = field(default_factory=versions)
    seconds: float | None = None


def html(document: Document, made: Provenance) -> str:
    """The page as text; whatever its parts hold is escaped."""
    return environment().get_template(_TEMPLATE).render(page=document, made=made)


def write_page(document: Document, made: Provenance, path: Path) -> Path:
    """Write a page whole or not at all.

    Raises:
        OSError: the file cannot be written.
    """
    write_whole(path, html(document, made))
    return path


def source(figure: Figure) -> str:
    """A figure as a data URI for an attribute: vectors, sharp when enlarged, on what is behind it.

    Characters that mean something in a URI or end the attribute are encoded, the rest is as it is:
    a quarter less than in base 64.
    """
    data = io.BytesIO()
    with figure_style():
        figure.savefig(data, format="svg", metadata={"Date": None}, facecolor="none")
    content = for_dark_too(rounded(data.getvalue())).decode()
    line = _LINE_END.sub(" ", content).replace("'", "&apos;").replace('"', "'")
    return "data:image/svg+xml," + quote(line, safe=_AS_IT_IS)


def size(figure: Figure) -> tuple[int, int]:
    """Width and height of a figure in the pixels of a browser, 96 per inch."""
    width, height = 96 * figure.get_size_inches()
    return round(width), round(height)


def command_line(
    *words: str, settings: Iterable[str] = (), options: Mapping[str, object] | None = None
) -> str:
    """`stewart-drake` with these words, `--set` for each setting, and options that are not None.

    An option whose value is a list or tuple is given once for each of its items.
    """
    parts = ["stewart-drake", *words]
    for name, value in {"set": list(settings), **(options or {})}.items():
        for one in value if isinstance(value, list | tuple) else (value,):
            if one is not None:
                parts += [f"--{name}", str(one)]
    return shlex.join(parts)


@lru_cache(maxsize=1)
def environment() -> Environment:
    """Where the templates of all pages are found, with their rules."""
    found = Environment(
        loader=PackageLoader("stewart_drake.reporting"),
        autoescape=True,  # names come from files
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    found.filters |= {"source": source, "size": size}
    return found
