"""Pages in a real browser: short on a narrow screen, figures enlarged and legible, tables whole."""

from pathlib import Path

import numpy as np
import pytest
from matplotlib.figure import Figure

import stewart_drake as sd
from stewart_drake.reporting import hautus as hautus_document
from stewart_drake.reporting.document import Document, Picture, Section, Table
from stewart_drake.reporting.page import Provenance, write_page
from stewart_drake.reporting.style import CONTROLLER_LINES, figure_style
from stewart_drake.studies.hautus import study_hautus
from tests.browser import Browser, needs_chromium

pytestmark = needs_chromium
NARROW = 400
MADE = Provenance("stewart-drake analyze hautus paper --out out/hautus")


@pytest.fixture(scope="module")
def hautus(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The page of the paper's scenario, with all its delays and poses."""
    path = tmp_path_factory.mktemp("hautus") / "report.html"
    study = study_hautus(sd.load_scenario("paper"))
    return write_page(hautus_document.document(study), MADE, path)


@pytest.fixture(scope="module")
def small(tmp_path_factory: pytest.TempPathFactory) -> Path:
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


def box(tab: Browser, selector: str) -> dict[str, float]:
    return tab.evaluate(f"document.querySelector('{selector}').getBoundingClientRect().toJSON()")


def press(tab: Browser, key: str, code: int, text: str = "") -> None:
    for kind in ("keyDown", "keyUp"):
        tab.call(
            "Input.dispatchKeyEvent",
            type=kind,
            key=key,
            code=key,
            windowsVirtualKeyCode=code,
            **({"text": text} if text and kind == "keyDown" else {}),
        )


def enlarged(tab: Browser) -> bool:
    return tab.evaluate("document.querySelector('.figure:popover-open') !== null")


@pytest.mark.slow
def test_the_hautus_page_is_short_on_a_telephone(tab, hautus):
    tab.open(hautus, NARROW, 800)
    assert tab.evaluate("document.documentElement.scrollHeight") < 3000
    assert tab.evaluate("document.documentElement.scrollWidth") == NARROW
    assert tab.errors == [] and tab.requests == []
    tab.evaluate("document.querySelectorAll('details').forEach(one => one.open = true)")
    rows = tab.evaluate("[...document.querySelectorAll('tr')].map(row => row.offsetHeight)")
    assert max(rows) < 200, "a row that is nearly empty"
    assert tab.evaluate("document.documentElement.scrollWidth") == NARROW


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


@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_figures_follow_the_page_and_stay_legible(tab, small, scheme):
    tab.open(small, 1280, 1000, prefers_color_scheme=scheme)
    b = box(tab, ".figure img")
    page = tab.screenshot()
    figure = page[
        int(b["top"]) + 3 : int(b["bottom"]) - 3, int(b["left"]) + 3 : int(b["right"]) - 3
    ]
    paper = page[5, 5]
    assert paper.mean() < 0.15 if scheme == "dark" else paper.mean() > 0.95
    off = np.abs(figure - paper).max(axis=2)
    assert (off < 0.02).mean() > 0.85, "another background than the page's"
    light = [luminance(color) for color in (paper, *seen(figure))]
    contrasts = [max(light[0], one) + 0.05 for one in light[1:]]
    contrasts = [
        a / (min(light[0], one) + 0.05) for a, one in zip(contrasts, light[1:], strict=True)
    ]
    # Orange is the palest on white; it is told apart by its dots, too.
    assert len(contrasts) == 5 and min(contrasts) > (4.5 if scheme == "dark" else 2.1)
    assert off[:, : figure.shape[1] // 9].max() > 0.75, "no letters along the axis"


def seen(figure: np.ndarray) -> list[np.ndarray]:
    """The colours of the five lines where they are drawn purest: at the far end of each hue."""
    hues = figure.reshape(-1, 3)
    spread = np.ptp(hues, axis=1)
    found = []
    for name, line in CONTROLLER_LINES.items():
        wanted = np.array([int(line.color[k : k + 2], 16) for k in (1, 3, 5)]) / 255
        if np.ptp(wanted) == 0:
            grey = hues[spread < 0.06]
            found.append(grey[np.abs(grey - hues[0]).max(axis=1).argmax()])
            continue
        direction = (wanted - wanted.mean()) / np.linalg.norm(wanted - wanted.mean())
        tint = hues - hues.mean(axis=1, keepdims=True)
        pure = tint @ direction / np.maximum(np.linalg.norm(tint, axis=1), 1e-9)
        like = hues[(pure > 0.97) & (spread > 0.3)]
        assert len(like) > 50, f"no line of {name}"
        full = np.ptp(like, axis=1)  # not the pixels that the line fills by half
        found.append(np.median(like[full >= np.quantile(full, 0.9)], axis=0))
    return found


def luminance(color: np.ndarray) -> float:
    """Relative luminance, as WCAG 2 defines it."""
    linear = np.where(color <= 0.04045, color / 12.92, ((color + 0.055) / 1.055) ** 2.4)
    return float(linear @ [0.2126, 0.7152, 0.0722])


@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_a_table_shows_on_which_side_it_goes_on(tab, small, scheme):
    tab.open(small, NARROW, 1600, prefers_color_scheme=scheme)
    b = box(tab, ".wide")
    assert tab.evaluate("document.documentElement.scrollWidth") == NARROW
    edges = []
    for place in (0, 10_000):
        tab.evaluate(f"document.querySelector('.wide').scrollLeft = {place}")
        row = tab.screenshot()[int(b["bottom"]) - 4]  # below the letters of the last row
        ends = (row[int(b["left"]) + 1], row[int(b["right"]) - 2])
        middle = row[int((b["left"] + b["right"]) / 2)]
        edges.append([float(np.abs(end - middle).max()) for end in ends])
    (left, right), (left_then, right_then) = edges
    least = 0.15 if scheme == "light" else 0.04
    assert right > least and left_then > least, "no shadow where columns are hidden"
    assert left < 0.02 and right_then < 0.02, "a shadow where none are"
    reached = tab.evaluate("document.querySelector('.wide').tabIndex")
    assert reached == 0, "not to be scrolled by keys"


def test_words_are_not_squeezed_into_a_column_of_letters(tab, small):
    tab.open(small, NARROW, 1600)
    rows = tab.evaluate("[...document.querySelectorAll('tr')].map(row => row.offsetHeight)")
    assert max(rows) < 220
