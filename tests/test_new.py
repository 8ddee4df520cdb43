"""new: a machine, a scenario and a first look from a few measurements."""

import dataclasses
import json
import re
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing
from http.client import HTTPConnection
from urllib.parse import parse_qs, urlsplit
from urllib.request import urlopen

import numpy as np
import pytest
import yaml

import stewart_drake as sd
from stewart_drake.cli import main, model
from stewart_drake.files.errors import ConfigError
from stewart_drake.mechanism.kinematics import leg_geometry
from stewart_drake.reporting.machine_form import MachineForm
from stewart_drake.studies.options import quantity
from stewart_drake.studies.study_options import Measurements
from tests.browser import needs_chromium
from tests.copies import Command
from tests.screen import too_long

MEASURED = {
    "base-radius": 0.2,
    "shaft-distance": 0.13,
    "plate-radius": 0.11,
    "joint-distance": 0.06,
    "crank": 0.05,
    "rod": 0.26,
    "plate-mass": 2.5,
    "crank-mass": 0.06,
    "rod-mass": 0.05,
}


UNITS = {
    **{"base_radius": "200 mm", "shaft_distance": "13cm", "rod": "0.26 m", "rod_mass": "50 g"},
    **{"delay": "50 ms", "torque_limit": "2 Nm"},
}
"""Some of them in other units."""


def flags(**other):
    given = MEASURED | {name.replace("_", "-"): value for name, value in other.items()}
    return [f"--{name}={value}" for name, value in given.items() if value is not None]


def made(folder, **other):
    """Return the machine that the function writes, which simulates nothing."""
    given = {name.replace("-", "_"): value for name, value in MEASURED.items()} | other
    sd.new(folder, "mine", **given)
    return sd.load_mechanism(folder / "machine.yaml")


@pytest.mark.parametrize("limit", [None, 6.0])
def test_the_start_is_planned_within_the_torque_limit(limit, tmp_path):
    machine = made(tmp_path, torque_limit=limit)
    assert machine.effort_limit == limit
    assert sd.load_scenario(tmp_path / "scenario.yaml").actuator.torque_limit == limit


def test_a_singular_home_is_an_error_that_says_what_else_to_try(tmp_path):
    sizes = {"base_radius": 0.16, "shaft_distance": 0.11, "plate_radius": 0.12, "crank": 0.08}
    with pytest.raises(ConfigError, match=r"^the home pose is singular, .* cranks that point toge"):
        made(tmp_path, **sizes, joint_distance=0.05, rod=0.3)


@pytest.mark.parametrize("cranks", ["apart", "together"])
def test_the_machine_is_as_it_was_measured(cranks, tmp_path):
    machine = made(tmp_path, cranks=cranks, upright=80, shaft_height=0.03)
    assert machine.name == "mine"
    shafts, joints = machine.p_WS, machine.p_PQ
    assert np.linalg.norm(shafts[:, :2], axis=1) == pytest.approx(np.full(6, 0.2), rel=1e-9)
    np.testing.assert_allclose(shafts[:, 2], 0.03)
    apart = np.linalg.norm(shafts[::2] - shafts[1::2], axis=1)
    np.testing.assert_allclose(apart, 0.13, rtol=1e-5)
    between = np.linalg.norm(joints[:, None] - joints, axis=2)
    np.testing.assert_allclose(np.sort(between, axis=1)[:, 1], 0.06, rtol=1e-5)
    legs = leg_geometry(machine, machine.home)
    tips = shafts + 0.05 * legs.crank
    beside = np.linalg.norm(tips[::2] - tips[1::2], axis=1)
    assert np.all(beside > apart + 0.05 if cranks == "apart" else beside < apart - 0.05)


def test_no_other_height_gives_the_rods_a_better_push(tmp_path):
    machine = made(tmp_path)

    def push(z):
        pose = np.array([0, 0, 0, 0, 0, z])
        return float(np.abs(leg_geometry(machine, pose).transmission).min())

    others = [push(z) for z in np.linspace(machine.home[5] - 0.04, machine.home[5] + 0.04, 81)]
    assert push(machine.home[5]) >= max(others) - 1e-4


@pytest.mark.parametrize(("gravity", "queue"), [(True, "equilibrium"), (False, "zero")])
def test_its_scenario_starts_as_live_advises(gravity, queue, tmp_path):
    made(tmp_path, gravity=gravity)
    # A balanced plate needs no torque at home.
    assert gravity or made(tmp_path / "weak", gravity=False, torque_limit=0.1).effort_limit == 0.1
    scenario = sd.load_scenario(tmp_path / "scenario.yaml")
    assert (scenario.start, scenario.queue) == ("rest", queue)


@pytest.mark.usefixtures("blank_figures")
def test_what_it_proposes_runs_and_is_reported(tmp_path, capsys):
    folder = tmp_path / "of mine" / "mine"
    assert main(["new", str(folder), *flags(**UNITS)]) == 0
    said = capsys.readouterr().out
    assert said.startswith("yes: ") and not too_long(said)
    assert f"next: stewart-drake simulate '{folder}/scenario.yaml' --out '{folder}/run'" in said
    assert "(estimated: uniform disc)" in said and "the motors have 2" in said
    words = " ".join(said.split())
    assert (
        "assumed by default: --shaft-height 0 m, --upright 90, --cranks apart, --gravity;" in words
    )
    assert re.search(r"[\d.]+ % of the delay, .*; a larger controller.w_R widens it", words)
    summary = json.loads((folder / "summary.json").read_text())
    assert summary["inertia_estimated"] == ["base", "plate", "crank", "rod"]
    scenario = sd.load_scenario(folder / "scenario.yaml")
    assert scenario.true_delay.eta(scenario.controller.period) == pytest.approx(0.05)
    from_rest = sd.simulate(scenario, judge_stability=False)
    assert from_rest.status == "completed" and from_rest.summary["accumulated_error"] < 1.0
    scenario = dataclasses.replace(scenario, start="on_reference", queue="reference")
    result = sd.simulate(scenario, judge_stability=False)
    assert result.status == "completed" and result.summary["accumulated_error"] < 0.1
    assert summary["peak_torque"] == pytest.approx(result.summary["peak_torque"], rel=0.05)
    page = (folder / "report.html").read_text()
    for words in ("First report on mine", "every leg in reach", "E_ac", "completed"):
        assert words in page
    assert page.count("<img") >= 4  # the drawing, and the figures of the run
    asked_for = yaml.safe_load((folder / "scenario.yaml").read_text())
    assert asked_for["mechanism"] == "machine.yaml"
    # The function writes the same without units.
    made(tmp_path, torque_limit=2.0, delay=0.05)
    for name in ("machine.yaml", "scenario.yaml"):
        texts = [(where / name).read_text() for where in (folder, tmp_path)]
        assert texts[0] == texts[1]


@pytest.mark.parametrize(
    ("delay", "torque_limit"),
    [
        ("80 ms", "6 N m"),
        ("80ms", "6Nm"),
        ("0.08 s", "6000 mN m"),
        ("0.08", " 6  "),
        (" 80 ms ", "6000mNm"),
        (0.08, 6),
    ],
)
def test_delay_and_torque_limit_may_have_units(delay, torque_limit):
    given = {name.replace("-", "_"): value for name, value in MEASURED.items()}
    taken = Measurements(**given, delay=delay, torque_limit=torque_limit)
    assert (taken.delay, taken.torque_limit) == (0.08, 6.0)


@pytest.mark.parametrize("text", ["a" * 5000 + "!", "6 N N m", "6 N  m", "6 m N", "N m", ""])
def test_other_texts_are_refused_at_once(text):
    with pytest.raises(ConfigError, match=r"torque_limit: got '.*expected a number with mN m, N m"):
        quantity("torque_limit", text, "N m")


@pytest.mark.usefixtures("blank_figures")
def test_links_that_cross_are_a_warning_below_the_findings(tmp_path, capsys):
    """Shafts of two cranks are nearer to each other than both cranks are long."""
    folder = tmp_path / "mine"
    assert main(["new", str(folder), *flags(cranks="together", shaft_distance=0.08)]) == 0
    said = " ".join(capsys.readouterr().out.split())
    crossing = r"warning: \d+ pairs of links cross, at worst [\d.]+ mm deep \(crank \d and crank \d"
    assert re.search(f"prediction errors grow [^:]*{crossing}.* written to", said)
    assert "; compare cranks that point apart" in said
    assert "cross, at worst" in json.loads((folder / "summary.json").read_text())["crossings"][0]
    page = (folder / "report.html").read_text()
    assert re.search(r"dead centre\. \d+ pairs of links cross", " ".join(page.split()))


def test_what_is_wrong_is_said_in_a_line_and_nothing_is_left(tmp_path, capsys):
    for other, words in (
        ({"rod": 260}, "--rod: got 260 m; expected metres, 0.26 for 260 mm"),
        ({"rod": 0.06}, "reach the plate"),
        ({"crank": 0.3}, "--rod: got 0.26 m with cranks of 0.3 m; expected a rod longer"),
        ({"rod": float("nan")}, "--rod: got 'nan'; expected a number with mm, cm, m"),
        ({"rod": "260 mmm"}, "--rod: got '260 mmm'; expected a number with mm, cm, m or without"),
        ({"rod_mass": "50 mm"}, "--rod-mass: got '50 mm'; expected a number with g, kg"),
        ({"crank_mass": -1}, "--crank-mass: got -1.0; expected more than 0"),
        ({"shaft_distance": 0.35}, "--shaft-distance: got 0.35 m on a circle of radius 0.2 m"),
        ({"delay": -1}, "--delay: got -1.0; expected at least 0"),
        ({"delay": "80"}, "--delay: got 80.0; expected at most 5"),
        ({"delay": "80 mm"}, "--delay: got '80 mm'; expected a number with ms, s or without"),
        ({"torque_limit": "6 N"}, "'6 N'; expected a number with mN m, N m or without"),
        ({"torque_limit": 0}, "--torque-limit: got 0.0; expected more than 0"),
        ({"torque_limit": 0.1}, "--torque-limit: got 0.1 N m, too weak to hold the plate at home"),
        ({"rod": None, "plate_mass": None}, "got no --rod, --plate-mass;"),
        ({"rod": None, "crank": "200 kg"}, "--crank: got '200 kg'; expected a number with mm"),
        ({"rod": None, "torque_limit": 0}, "--torque-limit: got 0.0; expected more than 0"),
        ({"rod": 0.01}, "rod: got 0.01 m with cranks of"),
        ({"plate_mass": 2500}, "plate-mass: got 2500 kg; expected kilograms, 2.5 for 2500 g"),
        ({"cranks": "up"}, "--cranks"),
    ):
        assert main(["new", str(tmp_path / "mine"), *flags(**other)]) == 2
        said = capsys.readouterr().err
        assert words in said and said.count("\n") == 1
        assert not (tmp_path / "mine").exists()
    made(tmp_path)
    before = (tmp_path / "machine.yaml").read_bytes()
    for given in (flags(rod=0.3), []):  # before anything is asked for
        assert main(["new", str(tmp_path), *given]) == 2
        said = capsys.readouterr().err
        assert "machine.yaml: already exists; expected a folder without it: another one, or" in said
    assert (tmp_path / "machine.yaml").read_bytes() == before


@pytest.mark.usefixtures("blank_figures")
def test_what_is_missing_or_does_not_fit_is_asked_for(tmp_path, monkeypatch, capsys):
    """A length that looks like millimetres is asked for again, unless it is confirmed."""
    agreed, answers = list[str](), iter(["long", "40 mm", "2500 g", "270", "260"])

    def agree(text, **_):
        agreed.append(text)
        return len(agreed) > 1  # no: it is asked for again

    monkeypatch.setattr(model.sys.stdin, "isatty", lambda: True, raising=False)
    monkeypatch.setattr(model.typer, "prompt", lambda *_, **__: next(answers))
    monkeypatch.setattr(model.typer, "confirm", agree)
    assert main(["new", str(tmp_path), *flags(rod=None, plate_mass=None)]) == 0
    assert next(answers, None) is None
    assert agreed == ["270 m? 0.27 m for 270 mm", "260 m? 0.26 m for 260 mm"]
    said = capsys.readouterr().err
    assert "rod: got 'long'" in said and "rod: got 0.04 m with cranks of 0.05 m" in said
    machine = sd.load_mechanism(tmp_path / "machine.yaml")
    assert machine.rod_lengths[0] == 0.26 and machine.plate.mass == 2.5


# The form.


def fields(**other):
    texts = {name.replace("-", "_"): str(value) for name, value in MEASURED.items()}
    return texts | {name: str(value) for name, value in other.items()}


def asked(url, path, data, token=None):
    """Return status and JSON of a request to a page."""
    where = urlsplit(url)
    token = parse_qs(where.query)["token"][0] if token is None else token
    connection = HTTPConnection(where.hostname, where.port, timeout=60)
    connection.request("POST", path, data, {"X-Token": token})
    answer = connection.getresponse()
    body = answer.read()
    return answer.status, json.loads(body) if answer.status == 200 else None


@pytest.fixture
def form():
    with closing(MachineForm({"rod": "0.26"}, "new machine")) as served:
        yield served


def test_the_form_draws_before_masses_are_known_and_names_what_is_wrong(form):
    lengths = fields(plate_mass="", crank_mass="", rod_mass="")
    _, found = asked(form.url, "/check", json.dumps(lengths))
    assert found["drawing"].startswith("data:image/svg")
    assert (found["field"], found["problem"]) == ("plate_mass", "is missing")
    assert not found["example"]
    # Before the lengths it draws the examples.
    _, begun = asked(form.url, "/check", json.dumps({"rod": "260 mm"}))
    assert begun["drawing"].startswith("data:image/svg") and begun["example"]
    # The other refusals are those of the command.
    for field, value, words in (
        ("rod", "55 mm", "reach the plate"),
        ("crank", "-1 mm", "expected more than 0"),
        ("cranks", "up", "expected"),
        ("torque_limit", "0.1", "too weak to hold the plate at home; expected more than 0.244 N m"),
    ):
        _, found = asked(form.url, "/check", json.dumps(fields(**{field: value})))
        assert found["field"] == field and words in found["problem"]
    folded = fields(rod="400 mm", plate_radius="60 mm", joint_distance="60 mm")
    _, found = asked(form.url, "/check", json.dumps(folded))
    assert found["problem"].endswith("expected other lengths, or cranks that point together")
    longer = asked(form.url, "/check", json.dumps(fields(rod="300 mm")))[1]
    assert longer["problem"] is None
    assert longer["drawing"] != asked(form.url, "/check", json.dumps(fields()))[1]["drawing"]


def test_the_form_draws_for_one_request_at_a_time(form):
    with ThreadPoolExecutor(4) as tabs:
        waiting = [
            tabs.submit(asked, form.url, "/check", json.dumps(fields(rod=f"{260 + 5 * one} mm")))
            for one in range(4)
        ]
    assert all(one.result()[1]["problem"] is None for one in waiting)


def test_the_form_refuses_strangers_and_malformed_requests(form):
    assert asked(form.url, "/check", b"{}", token="guess")[0] == 403
    for data in (b"", b"[]", b"{", b'{"rod": 1}', b'{"other": "1"}', b"[" * 4000, b"x" * 5000):
        assert asked(form.url, "/check", data)[0] in (400, 413)
    assert asked(form.url, "/other", json.dumps(fields()))[0] == 400
    with urlopen(form.url) as page:
        text = page.read().decode()
    assert (
        'value="0.26"' in text
        and 'value="0.1 s"' in text
        and "Radius of the circle of the motor shafts" in text
    )


def test_the_form_gives_the_measurements_and_shows_the_report(form):
    waiting, late = ThreadPoolExecutor(2), {"delay": "80 ms", "torque_limit": "6 Nm"}
    measured = waiting.submit(form.wait)
    assert asked(form.url, "/write", json.dumps(fields(rod="")))[1]["problem"] == "is missing"
    assert not measured.done()
    assert asked(form.url, "/write", json.dumps(fields(rod="260 mm", **late)))[1]["problem"] is None
    assert asked(form.url, "/check", json.dumps(fields()))[0] == 400  # not beside the report
    taken = measured.result(timeout=30)
    assert (taken.rod, taken.delay, taken.torque_limit) == (0.26, 0.08, 6)
    shown = waiting.submit(form.show, "<p>done</p>")
    with urlopen(form.url.replace("/?", "/report?")) as page:
        assert page.read() == b"<p>done</p>"
    shown.result(timeout=30)


def test_the_line_ends_with_the_address_of_the_form(tmp_path):
    process = Command("new", str(tmp_path / "mine"), "--form")
    with process.stdout:
        try:
            with urlopen(process.stdout.readline().split()[-1]) as page:
                assert page.status == 200
        finally:
            process.kill()


@pytest.mark.slow
@needs_chromium
def test_the_form_in_a_browser_by_keyboard(tab, tmp_path):
    """Type every measurement with Tab between them, press Enter, and read the report."""
    process = Command("new", str(tmp_path / "mine"), "--form")
    with process.stdout:
        try:
            url = re.search(r"http://\S+", process.stdout.readline())[0]
            for width in (1280, 400):
                tab.open(url, width, 500)
                assert tab.evaluate("document.documentElement.scrollWidth") == width
            names = [name.replace("-", "_") for name in MEASURED]
            tab.evaluate("document.forms[0].elements[0].focus()")
            for name in names:
                assert tab.evaluate("document.activeElement.name") == name
                bottom = "document.activeElement.getBoundingClientRect().bottom"
                note = "document.getElementById('note').getBoundingClientRect().top"
                assert tab.evaluate(f"{bottom} <= {note}"), name
                unit = "kg" if "mass" in name else "m"
                tab.type(f"{MEASURED[name.replace('_', '-')]} {unit}")
                tab.press("Tab")
            tab.wait("!document.querySelector('button').disabled")
            assert tab.evaluate("document.getElementById('drawing').naturalWidth") > 100
            tab.press("Enter")
            tab.wait("document.title.startsWith('First report')")
            # Without one the browser asks the server for an icon, without the token: 403.
            assert tab.evaluate("document.querySelector('link[rel=icon]') !== null")
            assert tab.errors == []
            assert process.wait() == 0
        finally:
            process.kill()
    assert (tmp_path / "mine" / "report.html").exists()
