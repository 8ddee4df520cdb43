"""Pages in a real browser: figures enlarged and legible, tables whole, on any screen."""

import pytest
from matplotlib.figure import Figure

from stewart_drake.reporting.document import Document, Picture, Section, Table
from stewart_drake.reporting.page import Provenance, write_page
from stewart_drake.reporting.style import CONTROLLER_LINES, figure_style
from tests.browser import needs_chromium

pytestmark = needs_chromium
NARROW = 400
MADE = Provenance("stewart-drake analyze hautus paper --out out/hautus")


@pytest.fixture(scope="module")
def small(tmp_path_factory):
    """A figure with a line of every controller, a wide table and one with long words."""
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
    return write_page(Document("A page", "Fine.", sections), MADE, path)


def box(tab, selector):
    return tab.evaluate(f"document.querySelector('{selector}').getBoundingClientRect().toJSON()")


def press(tab, key, code, text=""):
    for kind in ("keyDown", "keyUp"):
        tab.call(
            "Input.dispatchKeyEvent",
            type=kind,
            key=key,
            code=key,
            windowsVirtualKeyCode=code,
            **({"text": text} if text and kind == "keyDown" else {}),
        )


def enlarged(tab):
    return tab.evaluate("document.querySelector('.figure:popover-open') !== null")


@pytest.mark.parametrize("width", [NARROW, 1280])
def test_a_figure_is_enlarged_and_put_back_by_hand_and_by_keys(tab, small, width):
    tab.open(small, width, 800)
    before, height = box(tab, ".figure img"), tab.evaluate("document.body.scrollHeight")
    assert before["width"] <= width
    place = {"x": before["x"] + 50, "y": before["y"] + 50, "button": "left", "clickCount": 1}
    tab.call("Input.dispatchMouseEvent", type="mousePressed", **place)
    tab.call("Input.dispatchMouseEvent", type="mouseReleased", **place)
    assert enlarged(tab)
    assert box(tab, ".figure img")["width"] >= max(960, width)
    there = tab.evaluate("document.body.scrollHeight")
    assert there == pytest.approx(height, abs=2), "the page behind jumps"
    scrolls = "(f => f.scrollWidth > f.clientWidth)(document.querySelector('.figure'))"
    assert tab.evaluate(scrolls) == (width == NARROW)
    press(tab, "Escape", 27)
    tab.wait("document.querySelector('.figure:popover-open') === null")
    assert box(tab, ".figure img") == before
    tab.evaluate("document.querySelector('.figure button').focus()")
    press(tab, "Enter", 13, "\r")
    assert enlarged(tab)
    press(tab, "Enter", 13, "\r")
    assert not enlarged(tab)


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
