"""The replay shows runs by the SDFormat model, with their reference."""

import dataclasses
import json
import re

import numpy as np

import stewart_drake as sd
from stewart_drake.dynamics.workspace import Failure
from stewart_drake.loop import scene
from stewart_drake.reporting import replay as replay_module
from stewart_drake.reporting.replay import replay_html
from stewart_drake.scenario.signals import LEGS

PAPER = sd.load_mechanism("paper")


def data_of(html):
    """Return the data of the page's script."""
    return json.loads(re.search(r"const run = (\{.*\});", html)[1])


def test_every_frame_of_an_exact_run_closes_the_loops_of_the_model(followed, monkeypatch):
    gaps = []
    original = scene.set_pose

    def watched(plant, tree, *args):
        original(plant, tree, *args)
        for leg in LEGS:
            ends = (
                plant.GetFrameByName(f"{name}_{leg}").CalcPoseInWorld(tree).translation()
                for name in ("rod_end", "plate_joint")
            )
            gaps.append(np.abs(next(ends) - next(ends)).max())

    monkeypatch.setattr(scene, "set_pose", watched)
    meshcat = replay_module.replay(followed.signals, PAPER)
    assert len(gaps) == 6 * len(followed.signals.time)
    assert max(gaps) < 1e-12
    html = meshcat.StaticHtml()
    assert "<html" in html.lower() and len(html) > 100_000


def test_the_page_holds_what_the_run_was_like(followed):
    data = data_of(replay_html(followed, PAPER, "a <run>"))
    e = followed.signals.error.values
    assert np.allclose(data["time"], followed.signals.time.values, atol=1e-4)
    assert np.allclose(data["position"], 1e3 * np.linalg.norm(e[:, 3:], axis=1), atol=1e-4)
    # For small errors of small angles the turn is about as large as the angles' errors.
    assert np.allclose(data["angle"], np.rad2deg(np.linalg.norm(e[:, :3], axis=1)), rtol=0.2)
    torque = followed.signals.torque_applied.values
    shares = np.array(data["share"])
    assert np.abs(shares).max() == 1 and (np.sign(shares) == np.sign(torque))[shares != 0].all()


def test_a_page_of_servos_shows_no_torques(followed):
    """The torque of position servos is unknown: NaN in a log in real time."""
    assert "<div hidden>" not in replay_html(followed, PAPER, "torques")
    signals = followed.signals.copy(deep=True)
    signals.torque_applied.values[:] = np.nan
    page = replay_html(dataclasses.replace(followed, signals=signals), PAPER, "servos")
    assert "<div hidden>" in page and np.all(np.array(data_of(page)["share"]) == 0)


def test_the_angle_of_the_page_is_that_of_one_turn(followed):
    """Calibration by construction: the plate is turned about z against its reference."""
    signals = followed.signals.copy(deep=True)
    signals["reference"] = 0 * signals.reference + PAPER.home
    signals["pose"] = signals.reference.copy(deep=True)
    signals.pose.values[:, 2] += np.deg2rad(3.0)
    signals["error"] = signals.pose - signals.reference
    data = data_of(replay_html(dataclasses.replace(followed, signals=signals), PAPER, "turned"))
    assert np.allclose(data["angle"], 3.0, atol=1e-4) and np.allclose(data["position"], 0.0)


def test_names_are_escaped_and_the_outcome_is_reported(followed):
    failed = dataclasses.replace(
        followed, status="left_workspace", stopped=Failure(0.4, 2, 0.0, "leg 2 was too short")
    )
    html = replay_html(failed, PAPER, "<script>alert(1)</script>")
    assert "<script>alert(1)" not in html and "&lt;script&gt;alert(1)" in html
    assert "left workspace at 0.40 s" in html


def test_runs_of_one_instant_or_none_can_be_shown(followed):
    for rows in (0, 1):
        short = dataclasses.replace(followed, signals=followed.signals.isel(time=slice(0, rows)))
        assert len(data_of(replay_html(short, PAPER, "short"))["time"]) == rows


def test_a_run_that_ends_outside_is_shown_up_to_there(followed):
    signals = followed.signals.copy(deep=True)
    signals.pose.values[-3:, 5] += 1.0
    outside = dataclasses.replace(followed, signals=signals)
    assert "off by" in replay_html(outside, PAPER, "outside")


def test_the_paths_run_through_the_drawn_plate(followed, monkeypatch):
    """The centre of mass of Reachy Mini's head is 6 cm above its plate."""
    robot, lines = sd.load_mechanism("reachy_mini"), []
    monkeypatch.setattr(replay_module.Meshcat, "SetLine", lambda _, *args: lines.append(args[1]))
    signals = followed.signals.isel(time=slice(0, 3)).copy(deep=True)
    signals["pose"][:], signals["reference"][:] = robot.home, robot.home
    joints = robot.home[3:] + robot.p_PQ.mean(axis=0)
    replay_module.replay(signals, robot)
    assert np.abs(np.array(lines) - joints[:, None]).max() < 0.01
