"""The replay in a real browser: it shows something, it moves, it says what is true, offline."""

import time

import numpy as np
import pytest

import stewart_drake as sd
from stewart_drake.reporting.replay import replay_html
from tests.browser import needs_chromium

pytestmark = [needs_chromium, pytest.mark.slow]

SETTINGS = ("plant.kind=exact", "duration=3.0")  # from rest: the plate is far off at first


@pytest.fixture(scope="module")
def run():
    return sd.simulate(sd.load_scenario("paper", settings=SETTINGS), judge_stability=False)


@pytest.fixture(scope="module")
def page(run, tmp_path_factory):
    path = tmp_path_factory.mktemp("replay") / "replay.html"
    path.write_text(replay_html(run, sd.load_mechanism("paper"), "paper, from rest"))
    return path


@pytest.fixture
def replay(tab, page):
    tab.open(page)
    tab.wait("viewer.animator.actions.length > 0 && document.querySelector('canvas') !== null")
    return tab


def seek(tab, time):
    """Go to a time by the page's own slider, and let it draw."""
    tab.evaluate(f"slider.value = {time}; slider.dispatchEvent(new Event('input'))")
    frames = "new Promise(done => requestAnimationFrame(() => requestAnimationFrame(done)))"
    for _ in range(3):
        tab.evaluate(frames)


def scene(tab):
    """Return the middle of the canvas, where no panel covers the machine."""
    return tab.screenshot()[60:620, 380:900]


def test_it_loads_without_an_error_and_without_a_network(replay):
    seek(replay, 1.0)
    assert replay.errors == []
    assert replay.requests == []
    assert replay.evaluate("document.title") == "paper, from rest"


def test_the_canvas_shows_a_machine(replay):
    seek(replay, 0.0)
    image = scene(replay)
    assert image.std() > 0.03, "a blank canvas"
    red, green, blue = image.reshape(-1, 3).T
    assert ((blue > 0.6) & (red < 0.3)).sum() > 1000, "no blue plate"
    assert ((green > red + 0.15) & (green > blue + 0.05)).sum() > 200, "no green reference"


def test_plate_reference_and_readout_are_where_the_run_had_them(replay, run):
    world = (
        "(path => { const o = viewer.scene_tree.find(path).object; o.updateWorldMatrix(true, true);"
        " return o.matrixWorld.elements.slice(12, 15) })"
    )
    # Meshcat draws with y up: its (x, y, z) are our (x, z, -y).
    turned = np.array([[1, 0, 0], [0, 0, -1], [0, 1, 0]])
    for at in (0.4, 1.0, 2.5):
        seek(replay, at)
        row = run.signals.sel(time=at, method="nearest")
        plate = turned @ replay.evaluate(f"{world}(['drake', 'visualizer', 'paper', 'plate'])")
        assert np.allclose(plate, row.pose.values[3:], atol=2e-4)
        ghost = turned @ replay.evaluate(f"{world}(['reference'])")
        assert np.linalg.norm(ghost - row.reference.values[3:]) < 0.02  # the disc's own height
        off = 1e3 * np.linalg.norm(row.error.values[3:])
        shown = replay.evaluate("now.textContent")
        assert shown.startswith(f"t = {at:.2f} s")
        told = float(shown.split("off by ")[1].split(" mm")[0])
        assert told == pytest.approx(off, rel=0.1, abs=5e-3)


# Alone; in a report on a tablet and on a phone.
@pytest.mark.parametrize(("width", "height"), [(400, 800), (552, 641), (353, 641)])
def test_a_narrow_screen_shows_all_and_keys_alone_drive_it(tab, page, width, height):
    tab.open(page, width, height)
    tab.wait("viewer.animator.actions.length > 0 && document.querySelector('canvas') !== null")
    assert tab.evaluate("document.documentElement.scrollWidth") == width
    panels = "['run-about', 'run-play'].map(id => document.getElementById(id))"
    about, play = tab.evaluate(f"{panels}.map(x => x.getBoundingClientRect().toJSON())")
    for box in (about, play):
        assert min(box["left"], box["top"]) >= 0
        assert box["right"] <= width and box["bottom"] <= height
    assert about["bottom"] + 300 < play["top"], "the panels leave no room for the machine"
    seek(tab, 1.5)  # where the plate is highest
    plate = "viewer.scene_tree.find(['drake', 'visualizer', 'paper', 'plate']).object"
    up = f"{plate}.getWorldPosition({plate}.position.clone()).project(viewer.camera).y"
    centre = tab.evaluate(up)
    assert (1 - centre) / 2 * height > about["bottom"] + 20, "a panel covers the plate"

    tab.go_to("button")
    tab.press("Enter")
    tab.wait("!player.playing && button.textContent === 'Play'")
    held = tab.evaluate("player.time")
    time.sleep(0.5)
    assert tab.evaluate("player.time") == held
    tab.go_to("slider")
    tab.press("Home")
    tab.wait("player.time === 0")
    for _ in range(5):
        tab.press("ArrowRight")
    tab.wait("shown > 0 && now.textContent.startsWith(`t = ${run.time[shown].toFixed(2)} s`)")
    tab.press("Space")
    tab.wait("player.playing")
    assert tab.errors == []
