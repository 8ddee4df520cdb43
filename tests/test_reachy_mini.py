"""Reachy Mini: its machine against the robot's own kinematics, and the shipped scenario."""

import json
import runpy
from dataclasses import replace
from importlib import metadata, util
from pathlib import Path

import numpy as np
import pytest
import yaml

import stewart_drake as sd
from stewart_drake.dynamics.workspace import margin
from stewart_drake.files.errors import ConfigError
from stewart_drake.law.servos import turned
from stewart_drake.loop.bulk import run_in_bulk
from stewart_drake.loop.preparation import prepare
from stewart_drake.loop.servos import servo_law
from stewart_drake.machines.reachy_mini import HEAD_HEIGHT, head_of_pose, pose_of_head, read_move
from stewart_drake.mechanism.kinematics import legs_along, reach_margins, rotation
from stewart_drake.mechanism.trajectories import make_reference

ROBOT = sd.load_mechanism("reachy_mini")
POSES = 10_000
RUST = "reachy_mini_rust_kinematics"
ROOT = Path(__file__).parents[1]
MOVES = ROOT / "diagrams" / "moves"


def reachable_heads(number, seed):
    """Return heads (n, 4, 4) with body yaws (n,) and poses (n, 6), all within the workspace."""
    rng = np.random.default_rng(seed)
    heads, yaws, poses = [], [], []
    while len(poses) < number:
        pose = ROBOT.home + rng.uniform(-1, 1, 6) * [0.5, 0.5, 0.8, 0.02, 0.02, 0.025]
        if margin(ROBOT, pose) > 0 and legs_are_far_from_their_limits(pose):
            yaw = rng.uniform(-1, 1)
            heads.append(head_of_pose(pose, yaw))
            yaws.append(yaw)
            poses.append(pose)
    return np.array(heads), np.array(yaws), np.array(poses)


def legs_are_far_from_their_limits(pose):
    """Off dead centres acos resolves a crank's angle to rounding."""
    return reach_margins(ROBOT, pose).min() > 2e-3 and (
        np.abs(legs_along(ROBOT, pose).transmission).min() > 0.2
    )


def test_poses_of_the_head_return():
    heads, yaws, poses = reachable_heads(50, 1)
    for head, yaw, pose in zip(heads, yaws, poses, strict=True):
        assert pose_of_head(head, yaw) == pytest.approx(pose, abs=1e-14)
        assert pose_of_head(head.ravel().tolist(), yaw) == pytest.approx(pose, abs=1e-14)
    assert head_of_pose(ROBOT.home) == pytest.approx(np.eye(4), abs=1e-15)
    turned_body = pose_of_head(np.eye(4), 0.3)  # the head looks ahead, the body to its left
    assert turned_body[2] == pytest.approx(-0.3)


@pytest.mark.parametrize("head", [np.eye(3), np.full((4, 4), np.nan), 2 * np.eye(4)])
def test_what_is_no_pose_is_refused(head):
    with pytest.raises(ConfigError, match="head: got"):
        pose_of_head(head)
    with pytest.raises(ConfigError, match="body_yaw: got 50; expected -pi to pi rad"):
        pose_of_head(np.eye(4), 50)


def test_forward_kinematics_from_home_finds_every_pose():
    _, _, poses = reachable_heads(POSES, 2)
    for angles, pose in zip(legs_along(ROBOT, poses).crank_angles, poses, strict=True):
        assert np.abs(ROBOT.forward_kinematics(angles) - pose).max() < 1e-9


def test_crank_angles_are_those_of_the_robot():
    """Their inverse kinematics in Rust, with the data of their package where it is installed."""
    rust = pytest.importorskip(RUST)
    theirs = rust.ReachyMiniRustKinematics(0.04, 0.085)
    for joint, R_WS, p_WS, branch in zip(
        ROBOT.p_PQ, ROBOT.R_WS, ROBOT.p_WS, ROBOT.branches, strict=True
    ):
        X_WS = np.eye(4)
        X_WS[:3, :3], X_WS[:3, 3] = R_WS, p_WS
        center = ROBOT.home[3:] - [0, 0, HEAD_HEIGHT]
        theirs.add_branch((joint + center).tolist(), X_WS.tolist(), float(branch))
    heads, yaws, poses = reachable_heads(POSES, 3)
    ours, theirs_found = legs_along(ROBOT, poses).crank_angles, []
    for head, yaw in zip(heads, yaws, strict=True):
        head[2, 3] += HEAD_HEIGHT
        theirs_found.append(theirs.inverse_kinematics(head.tolist(), float(yaw)))
    found = turned(np.array(theirs_found), ours)
    misfits = [rod_misfits(poses, angles) for angles in (ours, found)]
    assert misfits[0].max() < 1e-15
    # A few of their angles leave a rod too long or too short by up to 1e-13 m.
    apart, exact = np.abs(found - ours), misfits[1] < 1e-14
    assert exact.mean() > 0.999
    assert apart[exact].max() < 1e-12
    assert apart.max() < 1e-10


def rod_misfits(poses, angles):
    """Return by how much each rod (n, 6) would change its length, m."""
    joints = poses[:, None, 3:] + ROBOT.p_PQ @ rotation(poses[:, :3]).swapaxes(-1, -2) - ROBOT.p_WS
    x, y, z = np.moveaxis(np.einsum("lij,nli->nlj", ROBOT.R_WS, joints), -1, 0)
    u = ROBOT.crank_lengths
    lengths = np.sqrt((x - u * np.cos(angles)) ** 2 + (y - u * np.sin(angles)) ** 2 + z**2)
    return np.abs(lengths - ROBOT.rod_lengths)


def test_the_machine_is_that_of_the_robots_files():
    """The package's data, if it is installed, with its dependencies or without."""
    if (spec := util.find_spec("reachy_mini")) is None:
        pytest.skip("package reachy-mini is not installed")
    assert metadata.version("reachy_mini") == "1.13.0"
    package = Path(spec.submodule_search_locations[0])
    script = runpy.run_path(str(ROOT / "analysis/reachy_machine.py"))
    shipped = yaml.safe_load((ROOT / "models/reachy_mini.yaml").read_text())
    assert flat(script["machine"](package)) == pytest.approx(flat(shipped))
    ranges = sd.load_scenario("reachy_mini").actuator.angle_range
    assert np.allclose(script["crank_ranges"](package), ranges, rtol=0, atol=1e-6)


def flat(content, name=""):
    """Return the values of nested dictionaries and lists by their path."""
    if not isinstance(content, (dict, list)):
        return {name: content}
    parts = content.items() if isinstance(content, dict) else enumerate(content)
    return {k: v for key, part in parts for k, v in flat(part, f"{name}/{key}").items()}


def test_the_scenario_follows_its_reference():
    compensated = run_in_bulk(sd.load_scenario("reachy_mini"))
    plain = run_in_bulk(sd.load_scenario("reachy_mini", "servo_preview"))
    assert compensated.status == plain.status == "completed"
    assert not any(compensated.counts.values())
    settled = slice(-150, None)  # after the start from rest
    errors = [np.abs(run.samples[settled, :3]).max() for run in (compensated, plain)]
    assert errors[0] < 0.01 < 0.03 < errors[1]


# ---------------------------------------------------------------- recorded moves


def move(path, times, poses, yaws, flat=False):
    """Write a move of poses (n, 6) of the plate, and return the reference."""
    targets = [
        {"head": (head.ravel() if flat else head).tolist(), "antennas": [0, 0], "body_yaw": yaw}
        for head, yaw in zip(map(head_of_pose, poses, yaws), yaws, strict=True)
    ]
    data = {"description": "", "time": list(times), "set_target_data": targets}
    path.write_text(json.dumps(data))
    return sd.ReachyMoveConfig(file=str(path))


def nod(number=51):
    """Return times (n,), poses (n, 6) and body yaws of two seconds that end at rest."""
    s = np.linspace(0, 1, number)
    swell = (s * (1 - s)) ** 3
    return 2 * s, ROBOT.home + 12 * swell[:, None] * [0.3, 0.5, -0.4, 0.01, 0.0, 0.02], 0.8 * s


@pytest.mark.parametrize("flat", [False, True])
def test_a_recorded_move_is_the_motion_of_its_poses(tmp_path, flat):
    times, poses, yaws = nod()
    reference = move(tmp_path / "nod.json", times + 1.7e9, poses, yaws, flat)  # by their clock
    motion = make_reference(reference, 3.0)
    found = np.array([motion.value(t)[:, 0] for t in [*times, 3.0]])
    # Seconds since 1970 are rounded to 2.4e-7 s.
    assert found == pytest.approx(np.vstack([poses, poses[-1]]), abs=1e-6)


def test_a_head_that_turns_past_half_a_turn_does_not_jump(tmp_path):
    times, path = np.linspace(0, 2, 51), tmp_path / "turn.json"
    yaws = np.pi + 0.5 * np.sin(times)
    move(path, times, np.tile(ROBOT.home, (51, 1)), yaws)
    data = json.loads(path.read_text())
    for target in data["set_target_data"]:
        target["body_yaw"] = 0.0
    path.write_text(json.dumps(data))
    _, poses = read_move(path)
    assert np.abs(np.diff(poses[:, 2])).max() < 0.1
    assert np.ptp(poses[:, 2]) == pytest.approx(np.ptp(yaws), abs=1e-9)


def test_a_move_within_reach_gives_setpoints_and_one_beyond_is_refused():
    def setpoints(name):
        chosen = f"reference={{kind: reachy_move, file: {name}}}"
        return sd.setpoints("reachy_mini", settings=(chosen, "duration=2"), plain=True)

    times, poses = read_move(MOVES / "look_around.json")
    k = int(np.argmin(np.abs(times - 1.8)))
    cranks = legs_along(ROBOT, poses[k][None]).crank_angles[0]
    found = setpoints("look_around").angles[[89, 90]].mean(axis=0)  # around 1.8 s
    assert found == pytest.approx(cranks, abs=1e-3)
    with pytest.raises(
        ConfigError, match=r"^[^\n]*leg 3 reached the end of its reach at t = 1\.36 s[^\n]*$"
    ):
        setpoints(MOVES / "tall_bow.json")


def changed(data, name, value, row=7):
    if name in data:
        return data | {name: value}
    targets = [dict(target) for target in data["set_target_data"]]
    targets[row][name] = value
    return data | {"set_target_data": targets}


@pytest.mark.parametrize(
    ("name", "value", "message"),
    [
        ("head", [1.0] * 15, r"set_target_data\[7\].head: got .*; expected 4 rows"),
        ("head", [[1.0], [2.0, 3.0]], r"set_target_data\[7\].head"),
        ("head", ["a"] * 16, r"set_target_data\[7\].head"),
        ("head", [0.0] * 16, r"set_target_data\[7\].head: got rows that are not a rotation"),
        ("head", None, r"set_target_data\[7\].head"),
        ("head", head_of_pose(ROBOT.home + [0, 0.5, 0, 0, 0, 0]).tolist(), "sample 7, pitch: got"),
        ("body_yaw", "left", r"set_target_data\[7\].body_yaw: got 'left'; expected a finite"),
        ("body_yaw", float("nan"), r"set_target_data\[7\].body_yaw: got nan"),
        ("body_yaw", 5.7, r"set_target_data\[7\].body_yaw: got 5.7; expected -pi to pi rad"),
        ("body_Yaw", 0.3, r"set_target_data\[7\]: got key 'body_Yaw'; did you mean body_yaw\?"),
        ("time", [40.0 * k for k in range(51)], "time: got steps of 40 s; expected at most 1 s"),
        ("time", [0.0] * 51, r"time\[1\]: got 0.0 after 0.0; expected increasing times"),
        ("time", [0.0], "got 1 times and 51 targets"),
        ("time", "now", "expected a recorded move"),
        ("set_target_data", [3] * 51, r"set_target_data\[0\]: got 3; expected an object"),
    ],
)
def test_a_bad_move_is_refused_in_one_line(tmp_path, name, value, message):
    path = tmp_path / "nod.json"
    reference = move(path, *nod())
    path.write_text(json.dumps(changed(json.loads(path.read_text()), name, value)))
    with pytest.raises(ConfigError, match=message) as said:
        make_reference(reference, 2.0)
    assert str(said.value).startswith(str(path)) and "\n" not in str(said.value)


@pytest.mark.parametrize(
    ("wrong", "right"), [("haed", "head"), ("times", "time"), ("set_target_dat", "set_target_data")]
)
def test_a_misspelt_key_is_named(tmp_path, wrong, right):
    path = tmp_path / "nod.json"
    move(path, *nod())
    path.write_text(path.read_text().replace(f'"{right}"', f'"{wrong}"'))
    with pytest.raises(ConfigError, match=f"got key '{wrong}'; did you mean {right}"):
        read_move(path)


@pytest.mark.parametrize("text", ["", "[]", "{}", '{"time": [], "set_target_data": []}'])
def test_a_file_that_is_no_move_is_refused(tmp_path, text):
    path = tmp_path / "none.json"
    path.write_text(text)
    with pytest.raises(ConfigError, match=r"none\.json"):
        make_reference(sd.ReachyMoveConfig(file=str(path)), 2.0)


def test_a_move_that_begins_at_rest_at_home_has_no_catch_up(tmp_path):
    """`simulate` plays it as `setpoints` sends it."""
    times = np.linspace(0, 4, 201)
    window = np.sin(np.pi * times / 4) ** 2
    reference = move(
        tmp_path / "mine.json",
        times,
        ROBOT.home + np.outer(window, [0, 0.25, 0.1, 0, 0, 0.005]),
        np.zeros(201),
    )
    scenario = replace(sd.load_scenario("reachy_mini"), duration=1.0, reference=reference)
    assert sd.setpoints(scenario).from_rest
    run = run_in_bulk(scenario)
    assert np.abs(run.samples[:, :3]).max() < 0.002  # 0.0079 with a catch-up of 1 s
    later = replace(scenario, delay=replace(scenario.delay, steps=20))
    assert servo_law(prepare(later))[2] == 1.0  # the reference is on its way when setpoints act
