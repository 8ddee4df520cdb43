"""Workspace studies against closed forms, the kinematic Jacobian, energy, and `prepare` itself."""

import dataclasses
import math
import re
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from stewart_drake.cli import main
from stewart_drake.core.layout import DEAD_CENTRE_SINE
from stewart_drake.dynamics.workspace import SINGULARITY_LIMIT, margin, measures_at
from stewart_drake.files.errors import ConfigError
from stewart_drake.files.resources import shipped
from stewart_drake.loop.preparation import check_instants, prepare, prepare_unchecked
from stewart_drake.mechanism.files import load_mechanism, mechanism_yaml
from stewart_drake.mechanism.geometry import plate_radius
from stewart_drake.mechanism.kinematics import angle_rate_map, leg_geometry, rotation
from stewart_drake.mechanism.trajectories import make_reference, poses_along
from stewart_drake.scenario.loading import load_scenario
from stewart_drake.scenario.reference_config import HoldConfig, SineConfig
from stewart_drake.studies.workspace import size_motors, study_workspace
from stewart_drake.studies.workspace_map import (
    LARGEST_FACTOR,
    first_exit,
    largest_factor,
    last_inside,
    measure,
    sections,
    travel,
    wrenches,
)
from tests.faults import written
from tests.mechanisms import PAPER, random_mechanism, random_pose
from tests.screen import said, summary_in
from tests.singular import parallel_rods, stretched

pytestmark = pytest.mark.usefixtures("blank_figures")

seeds = st.integers(0, 2**32 - 1)
seeded = settings(max_examples=30, deadline=None, derandomize=True)


def heave(amplitude, frequency=1.0, pose=PAPER.home):
    """Return the paper's scenario, but up and down only."""
    sine = SineConfig(
        amplitude=[0.0] * 5 + [amplitude], offset=list(map(float, pose)), frequency=frequency
    )
    return dataclasses.replace(load_scenario("paper"), reference=sine)


# ------------------------------------------------------------------ measures of a pose


@given(seed=seeds)
@seeded
def test_condition_and_play_are_those_of_the_jacobian_in_twists(seed):
    """A = J diag(E^-1 / rho, 1), and J is checked against finite differences elsewhere."""
    rng = np.random.default_rng(seed)
    mechanism = random_mechanism(rng)
    pose = random_pose(rng, mechanism)
    found = measure(mechanism, pose)
    if found.margin <= 0:  # a random pose may lie beyond a parallel singularity
        return
    to_rates = np.eye(6)
    to_rates[:3, :3] = np.linalg.inv(angle_rate_map(pose[:3])) / plate_radius(mechanism)
    values = np.linalg.svd(mechanism.jacobian(pose) @ to_rates, compute_uv=False)
    np.testing.assert_allclose(found.condition, values[0] / values[-1], rtol=1e-8)
    np.testing.assert_allclose(found.play, 1 / values[-1], rtol=1e-8)


@given(seed=seeds, turn=st.floats(-3, 3), size=st.floats(0.1, 10))
@seeded
def test_condition_depends_neither_on_size_nor_on_the_frame(seed, turn, size):
    rng = np.random.default_rng(seed)
    mechanism = random_mechanism(rng)
    R = rotation(np.array([0.0, 0.0, turn]))
    scale = np.repeat([1.0, size], 3)

    def moved(pose):
        """Yaw comes last in R = Rz Ry Rx, so that turning the world adds to it."""
        return scale * np.concatenate([pose[:3] + [0, 0, turn], R @ pose[3:]])

    other = dataclasses.replace(
        mechanism,
        home=moved(mechanism.home),
        p_WS=size * mechanism.p_WS @ R.T,
        R_WS=R @ mechanism.R_WS,
        p_PQ=size * mechanism.p_PQ,
        crank_lengths=size * mechanism.crank_lengths,
        rod_lengths=size * mechanism.rod_lengths,
    )
    pose = random_pose(rng, mechanism)
    one, two = measure(mechanism, pose), measure(other, moved(pose))
    np.testing.assert_allclose(two.condition, one.condition, rtol=1e-7)
    np.testing.assert_allclose(two.parallel, one.parallel, rtol=1e-7, atol=1e-9)
    np.testing.assert_allclose(two.reach, size * one.reach, rtol=1e-7, atol=1e-9)
    np.testing.assert_allclose(two.play, size * one.play, rtol=1e-7)


def test_wrenches_are_what_shortens_rods_on_locked_cranks():
    """Virtual work: d |p_TQ| = W' [rho omega; v] dt, by central differences of the twist."""
    pose = PAPER.home + [0.1, -0.2, 0.15, 0.01, -0.02, 0.03]
    legs, rho = leg_geometry(PAPER, pose), plate_radius(PAPER)
    tips = PAPER.p_WS + PAPER.crank_lengths[:, None] * legs.crank

    def lengths(twist):
        p_PQ_W = legs.p_PQ_W + np.cross(twist[:3] / rho, legs.p_PQ_W)
        return np.linalg.norm(pose[3:] + twist[3:] + p_PQ_W - tips, axis=1)

    h = 1e-6
    rows = [(lengths(h * e) - lengths(-h * e)) / (2 * h) for e in np.eye(6)]
    np.testing.assert_allclose(wrenches(PAPER, legs), rows, atol=1e-9)


def test_the_condition_grows_like_the_root_of_the_distance_to_a_dead_centre():
    mechanism = stretched()
    distances = np.array([1e-3, 1e-4])
    values = [measure(mechanism, mechanism.home - [0, 0, 0, x, 0, 0]) for x in distances]
    slope = np.diff(np.log([v.condition for v in values])) / np.diff(np.log(distances))
    np.testing.assert_allclose(slope, -0.5, atol=0.03)
    assert not measure(mechanism, mechanism.home).margin > 0


# ------------------------------------------------------------------ around home


@given(end=st.floats(1e-3, 2.0) | st.integers(1, 200).map(lambda k: np.nextafter(k * 0.005, 0)))
@settings(deadline=None)
def test_the_last_inside_is_before_the_end_or_the_first_gap(end):
    found = last_inside(lambda s: s <= end, 1.0)
    np.testing.assert_allclose(found, min(end, 1.0), atol=1e-8)
    assert found <= end
    np.testing.assert_allclose(last_inside(lambda s: not 0.3 < s < 0.4, 1.0), 0.3, atol=1e-8)


@pytest.mark.parametrize("name", shipped("mechanism"))
def test_travel_ends_on_the_border(name):
    mechanism = load_mechanism(name)
    for k, t in enumerate(travel(mechanism)):
        assert t.low < 0 < t.high
        for end, reason in ((t.low, t.low_reason), (t.high, t.high_reason)):
            pose = mechanism.home + end * np.eye(6)[k]
            assert 0 <= margin(mechanism, pose) < 1e-3
            now = measures_at(mechanism, pose)
            if "end of its reach" in reason:
                np.testing.assert_allclose(now.sines.min(), DEAD_CENTRE_SINE, atol=1e-4)
            else:
                assert "parallel" in reason
                np.testing.assert_allclose(abs(now.parallel), SINGULARITY_LIMIT, rtol=1e-3)


def test_a_machine_with_a_mirror_plane_travels_alike_to_both_sides():
    """The desktop one, with rotation 0, is its own mirror image in the x-z plane."""
    for t in travel(load_mechanism("desktop")):
        if t.coordinate in ("phi", "psi", "y"):
            np.testing.assert_allclose(-t.low, t.high, rtol=1e-6)


def test_sections_meet_the_travel_on_their_axes():
    mechanism = load_mechanism("desktop")
    spans = travel(mechanism)
    for section in sections(mechanism, points=31):
        inside = np.isfinite(section.condition)
        assert 0.2 < inside.mean() < 0.9
        # The window was found on a rough grid: no more than the tip of a spike may touch its rim.
        assert np.mean([*inside[[0, -1]].ravel(), *inside[:, [0, -1]].ravel()]) < 0.03
        np.testing.assert_array_equal(inside, section.margin > 0)
        row = np.abs(section.y - mechanism.home[section.second]).argmin()
        ends = section.x[inside[row]][[0, -1]] - mechanism.home[section.first]
        low, high = spans[section.first][1:3]
        cell = section.x[1] - section.x[0]
        np.testing.assert_allclose(ends, [low, high], atol=2 * cell)
        assert np.nanmin(section.condition) >= 1


# ------------------------------------------------------------------ along a reference


@pytest.mark.usefixtures("few_poses")
def test_the_exit_of_a_heave_is_where_the_travel_says():
    """A sin(t) = travel; and at worst the leg is short by what its margin says at the peak."""
    up = travel(PAPER)[5]
    study = study_workspace(heave(0.2))
    assert study.exit is not None
    np.testing.assert_allclose(study.exit.time, math.asin(up.high / 0.2), atol=1e-6)
    assert study.exit.reason == up.high_reason and study.sizing is None
    time, leg, margin = study.worst
    at_peak = PAPER.reach_margins(PAPER.home + [0, 0, 0, 0, 0, 0.2])
    np.testing.assert_allclose(margin, at_peak.min(), rtol=1e-3)
    assert f"t = {study.exit.time:.3f} s" in study.verdict
    assert f"leg {leg} is short by {-1e3 * margin:.3g} mm at t = {time:.2f} s" in study.verdict
    with pytest.raises(ConfigError, match="reference: leg"):
        prepare(heave(0.2))


@pytest.mark.slow
@pytest.mark.usefixtures("few_poses")
@pytest.mark.parametrize(("later", "fits"), [(-1e-3, True), (1e-3, False)])
def test_a_motion_is_checked_up_to_its_end_and_not_beyond(later, fits):
    leaves = math.asin(travel(PAPER)[5].high / 0.2)
    scenario = dataclasses.replace(heave(0.2), duration=leaves + later)
    assert (study_workspace(scenario).exit is None) is fits
    assert (prepare_unchecked(scenario).reference_failure() is None) is fits


@pytest.mark.parametrize("name", shipped("scenario"))
def test_every_shipped_reference_fits_and_so_does_its_largest_scaling(name):
    experiment = prepare_unchecked(load_scenario(name))
    time = check_instants(experiment.scenario.duration)
    assert first_exit(experiment.mechanism, experiment.reference, time) is None
    factor = largest_factor(experiment.mechanism, experiment.reference, time)
    assert 1 < factor <= LARGEST_FACTOR
    poses = np.array([experiment.reference.value(t)[:, 0] for t in time])
    for share, inside in ((1.0, True), (1.002, False)):
        scaled = poses[0] + share * factor * (poses - poses[0])
        margins = [margin(experiment.mechanism, pose) for pose in scaled]
        assert (min(margins) > 0) is (inside or factor == LARGEST_FACTOR)


@pytest.mark.parametrize("name", ["paper", "desktop", "motion_base"])
def test_the_table_in_the_theory_is_what_comes_out(name):
    text = (Path(__file__).parents[1] / "docs" / "theory.md").read_text(encoding="utf-8")
    section = text[text.index("largest amplitude factor") :]
    row = re.findall(rf"^\| `{name}`.*\|$", section, re.MULTILINE)[0]
    numbers = [float(n) for n in re.findall(r"-?\d+\.?\d*", row.replace("−", "-").split("|", 2)[2])]
    experiment = prepare_unchecked(load_scenario(name))
    mechanism, time = experiment.mechanism, check_instants(experiment.scenario.duration)
    heave_range = travel(mechanism)[5]
    found = [
        *(1e3 * heave_range.low, 1e3 * heave_range.high),
        measure(mechanism, mechanism.home).condition,
        np.nanmax(measure(mechanism, poses_along(experiment.reference, time)).condition),
        largest_factor(mechanism, experiment.reference, time),
    ]
    np.testing.assert_allclose(numbers, found, rtol=5e-3)


def test_factors_at_the_ends_of_what_can_be():
    time = check_instants(2.0)
    still = make_reference(HoldConfig(offset=list(PAPER.home)), 2.0)
    assert math.isnan(largest_factor(PAPER, still, time))
    outside = list(map(float, PAPER.home + [0, 0, 0, 0, 0, 0.3]))
    gone = make_reference(HoldConfig(offset=outside), 2.0)
    assert largest_factor(PAPER, gone, time) == 0
    tiny = make_reference(heave(0.001).reference, 2.0)
    assert largest_factor(PAPER, tiny, time) == LARGEST_FACTOR
    failure = first_exit(PAPER, gone, time)
    assert failure is not None and failure.time == 0.0


# ------------------------------------------------------------------ motors


def test_the_motors_work_is_the_machine_s_energy():
    """Sum of powers over time = kinetic plus potential energy gained; no friction."""
    experiment = prepare_unchecked(load_scenario("motion_base"))
    time = np.linspace(0.0, 4.7, 2001)
    sizing = size_motors(experiment.nominal, experiment.reference, time)
    work = np.concatenate(
        [[0.0], np.cumsum(np.diff(time) * (sizing.power[1:] + sizing.power[:-1]).sum(axis=1) / 2)]
    )
    energy = []
    for t in time[::200]:
        rates = experiment.reference.EvalDerivative(t, 1)[:, 0]
        energy.append(experiment.nominal.energy(experiment.reference.value(t)[:, 0], rates))
    gained = np.array(energy) - energy[0]
    np.testing.assert_allclose(work[::200], gained, atol=1e-4 * np.abs(gained).max())
    assert np.abs(gained).max() > 500


# ------------------------------------------------------------------ the command


@pytest.mark.slow
@pytest.mark.usefixtures("few_poses")
def test_the_command_writes_a_table_a_page_and_a_summary(tmp_path, capsys):
    printed = said(capsys, "analyze", "workspace", "desktop", "--out", tmp_path)
    assert printed.startswith("yes: the reference stays in the workspace")
    summary = summary_in(tmp_path)
    assert summary["fits"] is True and summary["exit"] is None
    assert summary["largest_factor"] > 1 and len(summary["motors"]) == 6
    assert [leg["leg"] for leg in summary["legs"]] == [1, 2, 3, 4, 5, 6]
    assert summary["torque_limit"] == 0.4 and summary["scenario"]["mechanism"] == "desktop"
    page = (tmp_path / "report.html").read_text()
    told = re.findall(r"amplitude that fits is ([\d.]+) times|<dd>([\d.]+) of this one", page)
    first, second = (float("".join(pair)) for pair in told)
    assert first == second <= summary["largest_factor"] < first + 1e-3
    assert "Workspace of desktop" in page and page.count("<img") == 4
    assert "stewart-drake analyze workspace desktop" in page


@pytest.mark.usefixtures("few_poses")
def test_a_reference_that_leaves_is_analysed_not_refused(tmp_path, capsys):
    amplitude = "reference.amplitude=[0.3, 0.3, 0.3, 0.02, 0.02, 0.1]"
    printed = said(capsys, "analyze", "workspace", "--set", amplitude, "--out", tmp_path)
    # Legs 2 to 4 do not reach, and no angle has a sine beyond the dead centre.
    rows = [line for line in printed.splitlines() if re.match(" *[1-6] ", line)]
    out = " ".join(printed.split())
    assert out.startswith("no: the reference leaves the workspace at t = 1.061 s, leg 2 reached")
    assert [row.split()[3] for row in rows] == ["0.908", "-", "-", "-", "0.216", "0.669"]
    assert "leg 4 is short by 15.2 mm" in out and "0.872 times this one" in out
    summary = summary_in(tmp_path)
    assert summary["fits"] is False and summary["exit"]["leg"] == 2 and summary["motors"] == []
    assert (tmp_path / "report.html").read_text().count("<img") == 3


@pytest.mark.usefixtures("few_poses")
@pytest.mark.parametrize("machine", [parallel_rods(), stretched()], ids=["parallel", "dead centre"])
def test_a_singular_home_pose_gets_a_verdict(machine, tmp_path, capsys):
    path = written(tmp_path / "singular.yaml", mechanism_yaml(machine))
    hold = ["--set", "reference.kind=hold", "--set", f"reference.offset={machine.home.tolist()}"]
    chosen = ["--set", f"mechanism={path}", *hold]
    out = said(capsys, "analyze", "workspace", "paper", *chosen, "--out", tmp_path / "a")
    assert " ".join(out.split()).startswith("no: the home pose is singular")
    summary = summary_in(tmp_path / "a")
    assert summary["home_failure"]["reason"] and summary["travel"] == summary["sections"] == []
    assert main(["simulate", "paper", *chosen]) == 2
    err = capsys.readouterr().err
    assert err.count("\n") == 1 and "reference:" in err
