"""Runs are shown live in Meshcat: where the machine is, where it should be, what its motors do."""

import gc
import socket
import time

import msgpack
import numpy as np
import pytest
from pydrake.geometry import Meshcat, MeshcatParams

import stewart_drake as sd
from stewart_drake.loop.scene import (
    Scene,
    crank_paths,
    full_color,
    torque_color,
    torque_shares,
)
from stewart_drake.mechanism.kinematics import rotation
from stewart_drake.reporting.replay import replay
from stewart_drake.scenario.signals import LEGS

PAPER = sd.load_mechanism("paper")
MOVING = ("duration=0.24", "start=on_reference", "queue=reference")
PLATE = "/drake/visualizer/paper/plate"


@pytest.fixture
def meshcat():
    return Meshcat(MeshcatParams(host="localhost", show_stats_plot=False))


def transform(meshcat, path):
    """Return the transform (4, 4) of a path in the browser."""
    return np.reshape(msgpack.unpackb(meshcat._GetPackedTransform(path))["matrix"], (4, 4)).T


def value(meshcat, path, name):
    return msgpack.unpackb(meshcat._GetPackedProperty(path, name))["value"]


def crank(leg):
    return "/" + "/".join(crank_paths("paper")[LEGS.index(leg)][0]) + "/<object>"


def test_the_ring_begins_around_the_plate_at_home(meshcat):
    scene = Scene(PAPER, meshcat)
    np.testing.assert_allclose(transform(meshcat, "/reference")[:2, 3], PAPER.home[3:5], atol=1e-9)
    assert transform(meshcat, "/reference")[2, 3] == pytest.approx(PAPER.home[5], abs=0.05)
    scene.close()


@pytest.mark.parametrize("kind", ["exact", "multibody"])
def test_a_live_run_shows_the_plate_the_ring_and_the_torques(kind, meshcat):
    looks = []

    def look(now, error):
        looks.append(
            (transform(meshcat, PLATE), transform(meshcat, "/reference"))
            + tuple(value(meshcat, crank(leg), "color") for leg in LEGS)
        )

    scenario = sd.load_scenario("paper", settings=(f"plant.kind={kind}", *MOVING))
    run = sd.simulate(scenario, meshcat=meshcat, progress=look, judge_stability=False)
    for path in ("/reference/ring", "/reference/pointer"):
        assert meshcat.HasPath(path)
    assert len(looks) == 13
    for (plate, ghost, *colors), now in zip(looks, run.signals.time.values, strict=True):
        row = run.signals.sel(time=now)
        np.testing.assert_allclose(plate[:3, 3], row.pose.values[3:], atol=2e-4)
        np.testing.assert_allclose(plate[:3, :3], rotation(row.pose.values[:3]), atol=2e-3)
        # The ring lies around the drawn disc, off the plate's origin along its z axis only.
        wanted = rotation(row.reference.values[:3])
        offset = wanted.T @ (ghost[:3, 3] - row.reference.values[3:])
        np.testing.assert_allclose(offset[:2], 0, atol=1e-9)
        np.testing.assert_allclose(ghost[:3, :3], wanted, atol=1e-9)
        for (red, _, blue, alpha), torque in zip(colors, row.torque_applied.values, strict=True):
            assert alpha == 1 and np.sign(red - blue) == np.sign(torque)
    first, last = looks[0][0], looks[-1][0]
    assert np.abs(first - last).max() > 1e-3, "it moves"


def test_a_live_run_keeps_to_real_time(meshcat):
    scenario = sd.load_scenario("paper", settings=("plant.kind=exact", "duration=0.6"))
    seen = []
    run = sd.simulate(
        scenario,
        meshcat=meshcat,
        progress=lambda now, _: seen.append((now, time.monotonic())),
        judge_stability=False,
    )
    assert run.status == "completed"
    (start, began), (end, ended) = seen[0], seen[-1]
    assert ended - began > 0.9 * (end - start)
    unpaced = sd.simulate(scenario, judge_stability=False)
    np.testing.assert_array_equal(unpaced.signals.pose, run.signals.pose)


def test_colours_are_of_the_usual_torque():
    assert full_color(np.array([])) == full_color(np.zeros(3)) == 1
    assert full_color(np.array([0.0] * 99 + [0.4])) == 0.4, "before that there was none"
    assert full_color(np.r_[np.ones(99), 50.0]) == pytest.approx(1)
    np.testing.assert_array_equal(torque_shares(np.array([-5.0, 0.5]), 2.0), [-1, 0.25])
    for share, expected in ((-1, "0072b2"), (0, "dadada"), (1, "d55e00")):
        got = "".join(f"{round(255 * part):02x}" for part in torque_color(share))
        assert got == expected


def listening(port):
    try:
        socket.create_connection(("localhost", port), 1).close()
    except OSError:
        return False
    return True


@pytest.mark.parametrize("show", ["live", "replay"])
def test_meshcat_goes_with_its_last_user_and_waits_for_no_collection_of_garbage(show):
    """One that is collected in another thread than its own ends the process."""
    made = Meshcat(MeshcatParams(host="localhost", show_stats_plot=False))
    port = made.port()
    scenario = sd.load_scenario("paper", settings=("plant.kind=exact", "duration=0.06"))
    gc.disable()
    try:
        run = sd.simulate(scenario, meshcat=made if show == "live" else None, judge_stability=False)
        if show == "replay":
            replay(run.signals, PAPER, made)
        assert listening(port)
        del made
        assert not listening(port)
    finally:
        gc.enable()
