"""Pages in a real browser: figures enlarged and legible, tables whole, on any screen."""

import pytest
from matplotlib.figure import Figure

from stewart_drake.reporting.document import Document, Picture, Section, Table
from stewart_drake.reporting.page import Provenance, html
from stewart_drake.reporting.style import CONTROLLER_LINES, figure_style
from tests.browser import needs_chromium

pytestmark = needs_chromium
NARROW = 400
MADE = Provenance(
    "stewart-drake analyze hautus paper "
    + " ".join(f"--set plant.{'m' * k}=1e-4" for k in range(3, 25))
)


@pytest.fixture(scope="module")
def small(tmp_path_factory):
    """Return a figure with a line of every controller, a wide table and one with long words."""
    with figure_style():
        figure = Figure(figsize=(10, 6))
        ax = figure.subplots()
        for k, (name, line) in enumerate(CONTROLLER_LINES.items()):
            ax.plot([0, 1], [k, k + 1], label=name, **line._asdict())
        ax.set(xlabel="time  [s]", ylabel="error  [mm]", title="lines")
        ax.legend()
    wide = Table([f"column {k}" for k in range(12)], [["1.234"] * 12] * 4, "Wide.")
    words = Table(
        ("model", "why"), [(f"chain {k}", "one reason or another " * 6) for k in range(9)]
    )
    sections = [Section("Figure", Picture(figure, "Lines.")), Section("Tables", wide, words)]
    path = tmp_path_factory.mktemp("small") / "report.html"
    path.write_text(html(Document("A page", "Fine.", sections), MADE), encoding="utf-8")
    return path


BROKEN = r"""(() => {
  const text = document.querySelector('footer pre'), range = document.createRange(), found = [];
  for (const parts = document.createTreeWalker(text, NodeFilter.SHOW_TEXT); parts.nextNode();)
    for (const word of parts.currentNode.data.matchAll(/\S+/g)) {
      range.setStart(parts.currentNode, word.index);
      range.setEnd(parts.currentNode, word.index + word[0].length);
      if (new Set([...range.getClientRects()].map(one => one.top)).size > 1) found.push(word[0]);
    }
  return found;
})()"""
"""Words of the command that a page breaks."""


def test_no_line_ends_within_an_option(tab, small):
    tab.open(small, NARROW, 1000)
    assert tab.evaluate(BROKEN) == []
    assert tab.evaluate("document.querySelector('footer pre').innerText") == MADE.command


def enlarged(tab):
    return tab.evaluate("document.querySelector('.figure:popover-open') !== null")


@pytest.mark.parametrize("width", [NARROW, 1280])
@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_a_page_fits_any_screen_and_fetches_nothing(tab, small, scheme, width):
    tab.open(small, width, 1000, prefers_color_scheme=scheme)
    assert tab.evaluate("document.documentElement.scrollWidth") == width
    assert tab.evaluate("[...document.images].every(i => i.naturalWidth > 100)")
    assert tab.errors == [] and tab.requests == []
    paper = tab.screenshot()[5, 5]
    assert paper.mean() < 0.15 if scheme == "dark" else paper.mean() > 0.95
    rows = tab.evaluate("[...document.querySelectorAll('tr')].map(row => row.offsetHeight)")
    assert max(rows) < 220, "words squeezed into a column of letters"
    assert tab.evaluate("document.querySelector('.wide').tabIndex") == 0, "not scrolled by keys"
