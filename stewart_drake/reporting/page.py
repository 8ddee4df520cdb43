"""A document as one self-contained HTML page.

The page needs no other file and no network: figures are embedded. It can be read on a small screen,
in dark mode, and printed in grey.
"""

import io
import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cache
from urllib.parse import quote

from jinja2 import Environment
from markupsafe import Markup, escape
from matplotlib.figure import Figure

from stewart_drake.files.versions import versions
from stewart_drake.reporting.document import Document, sentence, templates
from stewart_drake.reporting.style import figure_style, for_dark_too


@dataclass(frozen=True)
class Provenance:
    command: str  # makes the page again
    # of the package and its dependencies
    versions: Mapping[str, str] = field(default_factory=versions)
    seconds: float | None = None  # computing time, or None


def html(document: Document, made: Provenance) -> str:
    """Return the page, with all texts escaped."""
    return environment().get_template("page.html.j2").render(page=document, made=made)


def source(figure: Figure) -> str:
    """Return a figure as an SVG data URI for an HTML attribute.

    Only characters with a meaning in a URI or an attribute are encoded: a quarter shorter than
    base 64. Paths are rounded to a hundredth of a point, which saves a fifth.
    """
    data = io.BytesIO()
    with figure_style():
        figure.savefig(data, format="svg", metadata={"Date": None}, facecolor="none")
    text = for_dark_too(data.getvalue().decode())
    text = re.sub(r' d="[^"]*"', lambda path: re.sub(r"(\.\d\d)\d+", r"\1", path[0]), text)
    line = re.sub(r"\s*\n\s*", " ", text).replace("'", "&apos;").replace('"', "'")
    return "data:image/svg+xml," + quote(line, safe=" <>'=/:;,.()[]{}!*?@+-_")


def size(figure: Figure) -> tuple[int, int]:
    """Return width and height of a figure in pixels of a browser, 96 per inch."""
    width, height = 96 * figure.get_size_inches()
    return round(width), round(height)


def unbroken(text: object) -> Markup:
    """Return escaped text in which a line never ends at the hyphens of --set or 1e-05."""
    words = r"(?<!\S)(?!stewart-drake)\S*-\S+"
    return Markup(re.sub(words, r'<span class="unbroken">\g<0></span>', str(escape(text))))


@cache
def environment() -> Environment:
    # Names come from files, and are escaped. Numbers in styles and scripts keep all digits.
    found = templates().overlay(
        autoescape=True, trim_blocks=True, lstrip_blocks=True, finalize=None
    )
    found.filters |= {"source": source, "size": size, "unbroken": unbroken}
    found.filters |= {"sentence": sentence, "kind": lambda block: type(block).__name__}
    return found
