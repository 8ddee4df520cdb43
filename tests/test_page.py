"""The analysis page: one file, nothing fetched, names escaped."""

import re
from html.parser import HTMLParser
from pathlib import Path
from urllib.parse import unquote
from xml.etree import ElementTree

from matplotlib.figure import Figure

from stewart_drake.cli.common import command_line
from stewart_drake.reporting.document import (
    Caution,
    Document,
    Frame,
    Listing,
    Paragraph,
    Picture,
    Section,
    Table,
    Values,
)
from stewart_drake.reporting.page import Provenance, html
from stewart_drake.reporting.style import figure_style


class Outline(HTMLParser):
    """Tags and text of a page; complains of tags that do not match."""

    VOID = {"meta", "img", "br", "link"}

    def __init__(self, text):
        super().__init__()
        self.open: list[str] = []
        self.tags: list[tuple[str, dict[str, str | None]]] = []
        self.words: list[str] = []
        self.feed(text)
        assert not self.open

    def handle_starttag(self, tag, attributes):
        self.tags.append((tag, dict(attributes)))
        if tag not in self.VOID:
            self.open.append(tag)

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, data):
        self.words.append(data.strip())

    def all(self, tag):
        return [attributes for name, attributes in self.tags if name == tag]


def picture():
    with figure_style():
        figure = Figure(figsize=(3, 2))
        figure.subplots().plot([0, 1], [1, 0])
    return Picture(figure, "a line that goes down")


def embedded(text):
    """Return the figures in a page, as a browser finds them in its attributes."""
    head = "data:image/svg+xml,"
    sources = [str(image["src"]) for image in Outline(text).all("img")]
    assert all(one.startswith(head) for one in sources)
    return [ElementTree.fromstring(unquote(one.removeprefix(head))) for one in sources]


MADE = Provenance("stewart-drake analyze hautus 'a b'", {"drake": "1.51"}, 12.3)


def document(**changes):
    table = Table(
        ("model", "margin", "note"),
        [("<b>a</b> & b", "1.2e-3", "x" * 50), ("c", "-", "fine"), ("d", "> 5", "")],
        "Some models.",
    )
    blocks = (
        Values({"mass": "4 kg"}),
        Caution("look out"),
        Listing("a:\n  b: <1>"),
        Frame("<p>in"),
    )
    sections = [
        Section("One", "First.", "Second <i>paragraph</i>.", table, picture()),
        Section("Two", picture(), *blocks),
        Section("Three", "Hidden.", folded=True),
    ]
    parts = {"title": "A <title>", "verdict": "All is well.", "tone": "good", "facts": {"mu": "8"}}
    return Document(**{**parts, "sections": sections, **changes})


def page(**changes):
    return html(document(**changes), MADE)


def test_a_page_holds_everything_and_fetches_nothing():
    text = page()
    outline = Outline(text)
    sources = [image["src"] or "" for image in outline.all("img")]
    assert [source.partition(",")[0] for source in sources] == ["data:image/svg+xml"] * 2
    for figure in embedded(text):  # which refers to its own parts
        inside = ElementTree.tostring(figure, "unicode")
        assert set(re.findall(r"""(?:url\(|href=["'])(.)""", inside)) == {"#"}
    assert not outline.all("script")
    # Without an icon of its own a browser asks a page's server for one.
    assert [(one["rel"], one["href"]) for one in outline.all("link")] == [("icon", "data:,")]
    assert not re.search(r"(src|href)=\"(?!data:|#)", text)
    assert "url(" not in re.sub(r'src="[^"]*"', "", text)
    words = " ".join(outline.words)
    for part in ("All is well.", "First.", "a line that goes down", "drake 1.51", "12 s", "mu"):
        assert part in words
    assert outline.words[outline.words.index("mass") + 1] == "4 kg"
    # Without a capital: a warning may begin with a file's name.
    assert {"Warning: look out.", "a:\n  b: <1>"} <= set(outline.words)
    assert [frame["srcdoc"] for frame in outline.all("iframe")] == ["<p>in"]
    assert [image["alt"] for image in outline.all("img")] == ["a line that goes down"] * 2
    assert [a["href"] for a in outline.all("a")] == ["#s1", "#s2", "#s3"]
    assert {"s1", "s2", "s3"} <= {section["id"] for section in outline.all("section")}
    assert len(outline.all("details")) == 1


def test_names_from_files_are_text_and_not_markup():
    text = page(verdict="<script>alert(1)</script>")
    assert "<script" not in text
    assert "<b>a</b>" not in text
    outline = Outline(text)
    assert "<b>a</b> & b" in outline.words
    assert "A <title>" in outline.words
    assert "stewart-drake analyze hautus 'a b'" in outline.words


def test_a_terminal_gets_what_is_brief_in_80_columns():
    """The verdict, and of open sections the brief blocks."""
    long = "a reason that is told at some length, " * 4
    rows = [("one", "1.50", "-0.25", long), ("two", "3", "-", "x")]
    table = Table(("run", "E_ac, % s", "worst", "why"), rows, "Some runs.", brief=True)
    chosen = Table(("a", "b"), [("1", "never shown")], brief=("first head", None))
    text = document(
        sections=[
            Section("Shown", "For pages.", table, chosen, Paragraph("Told.", brief=True)),
            Section("Not shown", "For pages.", picture(), Listing("nothing")),
            Section("Folded", Values({"hidden": "yes"}), folded=True),
            Section("", Values({"mass": "4 kg"}), Caution("look out")),
        ]
    ).plain()
    lines = text.splitlines()
    assert lines[:4] == ["All is well.", "", "Shown", "Some runs."]
    assert max(map(len, lines)) <= 80 and not any(line != line.rstrip() for line in lines)
    first = next(k for k, line in enumerate(lines) if line.startswith("one"))
    assert lines[first].split()[:3] == ["one", "1.50", "-0.25"]
    told = " ".join(line[lines[first].index("a reason") :] for line in lines[first : first + 4])
    assert long.split() == told.split()[: len(long.split())]
    assert lines[lines.index("first head") + 1].strip() == "1"
    assert lines[-3:] == ["Told.", "mass  4 kg", "warning: look out"]
    for hidden in ("For pages.", "Not shown", "Folded", "hidden", "never shown"):
        assert hidden not in text


def test_command_lines_are_quoted_for_a_shell():
    line = command_line(
        "analyze",
        "delay",
        "my file.yaml",
        settings=["delay.steps=4", "reference.amplitude=[1, 2]"],
        options={"controller": None, "out": Path("out"), "gravity": True, "browser": False},
    )
    assert line == (
        "stewart-drake analyze delay 'my file.yaml' --set delay.steps=4 "
        "--set 'reference.amplitude=[1, 2]' --out out --gravity --no-browser"
    )
