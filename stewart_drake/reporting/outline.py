"""The prose of a document, apart from its numbers, in templates/NAME.md.j2.

A template has parts with empty lines between them. Jinja fills in each part by itself, so that no
value can change the structure; a part that comes out empty is left out.

    # Heading        begins a section
    #- Heading       begins a folded section
    text             is a paragraph of a page
    > text           is a paragraph of a page and of a terminal
    @name caption    is what the context has by this name: blocks, or a function that draws a figure
"""

import re
from collections.abc import Iterator
from dataclasses import replace
from functools import cache
from typing import Any, Final

from jinja2 import Environment, PackageLoader, StrictUndefined, Template

from stewart_drake.reporting.document import Block, Paragraph, Picture, Section, Table
from stewart_drake.reporting.words import number

_PART: Final = re.compile(r"(#-?|>|@\w+|) ?(.*)")


def sections(name: str, **context: Any) -> list[Section]:
    """Return the sections of a template, without those all of whose named blocks are missing."""
    found = []
    for heading, folded, parts in _template(name):
        blocks: list[Block] = []
        for mark, part in parts:
            text = " ".join(part.render(context).split())
            if mark.startswith("@"):
                blocks += _named(context[mark[1:]], text)
            elif text:
                blocks.append(Paragraph(text, mark == ">"))
        named = [bool(context[mark[1:]]) for mark, _ in parts if mark.startswith("@")]
        if any(named) or not named:
            found.append(Section(heading.render(context), *blocks, folded=folded))
    return found


def _named(value: Any, caption: str) -> Iterator[Block]:
    for one in value if isinstance(value, list | tuple) else [value] if value else []:
        if callable(one):
            yield Picture(one, caption)
        else:
            yield replace(one, caption=caption) if caption and isinstance(one, Table) else one


@cache
def _template(name: str) -> list[tuple[Template, bool, list[tuple[str, Template]]]]:
    """Return headings, whether they are folded, and marks and texts of the parts below them."""
    loader = PackageLoader("stewart_drake.reporting")
    environment = Environment(loader=loader, undefined=StrictUndefined)
    environment.filters["number"] = number
    found: list[tuple[Template, bool, list[tuple[str, Template]]]] = []
    source, *_ = loader.get_source(environment, f"{name}.md.j2")
    for part in re.split(r"\n\s*\n", source.strip()):
        mark, text = _PART.findall(" ".join(part.split()))[0]
        template = environment.from_string(text)
        if mark.startswith("#"):
            found.append((template, mark == "#-", []))
        else:
            found[-1][2].append((mark, template))
    return found
