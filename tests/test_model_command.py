"""model check and model view: summary, drawing, and a viewer that survives any slider."""

import contextlib
import dataclasses
import json
import re

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pydrake.geometry import Meshcat

from stewart_drake.cli import main
from stewart_drake.dynamics.stewart import StewartDynamics
from stewart_drake.dynamics.workspace import diagnose
from stewart_drake.files.resources import data_root, shipped
from stewart_drake.mechanism.assembly import assemble
from stewart_drake.mechanism.files import load_mechanism, mechanism_yaml
from stewart_drake.reporting.mechanism import mechanism_figure
from stewart_drake.reporting.viewer import SLIDERS, STOP, PoseViewer, place, slider_range
from stewart_drake.studies.new_machine import check_mechanism
from tests.faults import written
from tests.mechanisms import PAPER
from tests.screen import said, summary_in
from tests.singular import parallel_rods, stretched

pytestmark = pytest.mark.usefixtures("blank_figures")

HOME_VALUES = PAPER.home * ([180 / np.pi] * 3 + [1e3] * 3)


# ------------------------------------------------------------------ model check


@pytest.mark.parametrize("name", shipped("mechanism"))
def test_check_tells_what_the_dynamics_say(name, tmp_path, capsys):
    told = " ".join(said(capsys, "model", "check", name, "--out", tmp_path).split())
    assert told.startswith("yes: ") and "ms under constant torques; servos hold the plate" in told
    pictures = {"mechanism.png", "mechanism.svg"}
    assert {path.name for path in tmp_path.iterdir()} == pictures | {"summary.json"}
    summary = summary_in(tmp_path)
    mechanism = load_mechanism(name)
    dynamics = StewartDynamics(mechanism, gravity=True)
    np.testing.assert_allclose(summary["torque"], dynamics.equilibrium_torque(mechanism.home))
    assert max(map(abs, summary["torque"])) < summary["torque_limit"]
    A, _ = dynamics.linearize(mechanism.home)
    poles = np.array(summary["poles"]) @ [1, 1j]
    # Vieta: sum and sum of squares of the poles.
    np.testing.assert_allclose(poles.sum(), np.trace(A), atol=1e-8)
    np.testing.assert_allclose((poles**2).sum(), np.trace(A @ A), rtol=1e-9)
    assert poles[0].real == poles.real.max() > 0
    assert len(summary["travel"]) == 6


def test_check_marks_moments_that_nobody_measured(tmp_path, capsys):
    path = tmp_path / "mine.yaml"
    text = (data_root() / "models/paper.yaml").read_text()
    path.write_text(text.replace(", inertia: [30.0e-4, 30.0e-4, 60.0e-4]", ""))
    told = " ".join(said(capsys, "model", "check", path, "--out", tmp_path).split())
    assert "plate 0.0144, 0.0144, 0.0288 (estimated: uniform disc); crank 1e-06, " in told
    summary = summary_in(tmp_path)
    assert summary["inertia_estimated"] == ["plate"]
    np.testing.assert_allclose(summary["inertia"]["plate"], [144e-4, 144e-4, 288e-4])
    assert "estimated" not in said(capsys, "model", "check", "paper")
    assert main(["model", "check", "desktop", "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["name"] == "desktop"


@pytest.mark.parametrize(
    ("machine", "why"), [(parallel_rods(), "parallel singularity"), (stretched(), "end of its")]
)
def test_a_singular_machine_gets_a_verdict_and_can_be_viewed(machine, why, tmp_path, capsys):
    path = written(tmp_path / "machine.yaml", mechanism_yaml(machine))
    lines = said(capsys, "model", "check", path, "--out", tmp_path / "out").splitlines()
    assert lines[0].startswith("no: the home pose is singular") and why in " ".join(lines[:2])
    assert (tmp_path / "out" / "mechanism.png").exists()
    with contextlib.closing(PoseViewer(machine, Meshcat())) as viewer:
        assert place(machine, viewer.values()).failure is not None
    assert summary_in(tmp_path / "out")["torque"] == []


def test_one_crank_the_wrong_way_is_reported(tmp_path):
    turned = tmp_path / "turned.yaml"
    text = (data_root() / "models/paper.yaml").read_text()
    turned.write_text(re.sub(r"(branches: \[)(-?1)", lambda m: f"{m[1]}{-int(m[2])}", text))
    check = check_mechanism(load_mechanism(turned))
    assert check.unlike.startswith("not alike, though drawn alike: torques to hold")
    assert check_mechanism(load_mechanism("paper_clear")).unlike == ""


def test_motors_that_cannot_hold_the_plate_are_reported():
    weak = dataclasses.replace(load_mechanism("motion_base"), effort_limit=500.0)
    assert "cannot hold the plate, 928 N m" in check_mechanism(weak).verdict


# ------------------------------------------------------------------ the drawing


def test_the_drawing_shows_cranks_and_rods_where_they_are():
    mechanism = load_mechanism("motion_base")
    home = assemble(mechanism, mechanism.home)
    top, front = mechanism_figure(mechanism).axes
    for ax, axes in ((top, [0, 1]), (front, [0, 2])):
        drawn = {tuple(np.round(np.ravel(line.get_xydata()), 6)) for line in ax.lines}
        for shaft, tip in zip(mechanism.p_WS, home.p_WT, strict=True):
            crank = 1e3 * np.concatenate([shaft[axes], tip[axes]])
            assert tuple(np.round(crank, 6)) in drawn


# ------------------------------------------------------------------ model view


@pytest.fixture(scope="module")
def viewer():
    with contextlib.closing(PoseViewer(PAPER, Meshcat())) as shown:
        yield shown


def test_the_viewer_starts_at_home_with_a_slider_per_coordinate(viewer):
    np.testing.assert_allclose(viewer.values(), HOME_VALUES)
    assert set(viewer.meshcat.GetSliderNames()) == set(SLIDERS)
    low, high = slider_range(PAPER)
    assert np.all(low < HOME_VALUES) and np.all(high > HOME_VALUES)


def plate_of(viewer):
    """Return the position (3,) at which the plate is shown."""
    tree = viewer._plant.GetMyContextFromRoot(viewer._context)
    return viewer._plant.GetBodyByName("plate").EvalPoseInWorld(tree).translation()


def test_sliders_place_the_machine(viewer):
    values = HOME_VALUES + [5, -4, 10, 15, -20, 30]
    placement = viewer.step(values)
    pose = np.concatenate([np.deg2rad(values[:3]), values[3:] / 1e3])
    np.testing.assert_allclose(placement.pose, pose)
    np.testing.assert_allclose(placement.reach, PAPER.reach_margins(pose))
    assert str(placement).startswith("reach margin")
    np.testing.assert_allclose(plate_of(viewer), pose[3:], atol=1e-12)


def test_out_of_reach_is_shown_and_the_machine_stays_where_it_was(viewer):
    viewer.step(HOME_VALUES)
    placement = viewer.step(HOME_VALUES + [0, 0, 0, 0, 0, 150])
    margins = PAPER.reach_margins(placement.pose)
    assert placement.failure is not None
    leg = int(margins.argmin()) + 1
    assert f"leg {leg} short by {-1e3 * margins.min():.3g} mm" in str(placement)
    assert str(placement).startswith("out of reach: ")
    assert viewer.meshcat.GetButtonClicks(str(placement)) == 0  # the panel says it
    np.testing.assert_allclose(plate_of(viewer), PAPER.home[3:], atol=1e-12)
    viewer.step(HOME_VALUES)
    with pytest.raises(RuntimeError):  # Drake's way to say that the old label is gone
        viewer.meshcat.GetButtonClicks(str(placement))


@given(values=st.lists(st.floats(-1e4, 1e4), min_size=6, max_size=6))
@settings(deadline=None, max_examples=60)
def test_no_slider_value_crashes(viewer, values):
    placement = viewer.step(values)
    assert (placement.failure is None) == (diagnose(PAPER, 0.0, placement.pose) is None)
    assert len(str(placement)) > 10


def test_the_viewer_follows_the_sliders_until_it_is_stopped(viewer):
    class Clicked:
        """A Meshcat whose sliders move and whose button is pressed at the fourth look."""

        def __init__(self, meshcat):
            self.looks, self._meshcat = 0, meshcat

        def __getattr__(self, name):
            return getattr(self._meshcat, name)

        def GetButtonClicks(self, name):
            assert name == STOP
            self.looks += 1
            if self.looks == 2:
                self._meshcat.SetSliderValue("z [mm]", 400.0)
            return int(self.looks == 4)

    said = []
    real = viewer.meshcat
    viewer.meshcat = Clicked(real)
    try:
        viewer.run(said.append)
    finally:
        viewer.meshcat = real
    assert said == [str(place(PAPER, HOME_VALUES)), str(place(PAPER, viewer.values()))]
    assert viewer.values()[5] == 400.0


def test_view_writes_a_page_that_needs_no_server(tmp_path, capsys):
    assert "view.html" in said(capsys, "model", "view", "desktop", "--out", tmp_path)
    assert (tmp_path / "view.html").stat().st_size > 500_000
