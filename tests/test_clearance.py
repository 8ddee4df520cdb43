"""Clearances against closed forms and second implementations: segments, boxes, cylinders."""

from itertools import combinations, product

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import lsq_linear

from stewart_drake.files.resources import shipped
from stewart_drake.loop.clearance import ClearanceScene, Pair
from stewart_drake.loop.preparation import prepare_unchecked
from stewart_drake.mechanism.assembly import assemble
from stewart_drake.mechanism.clearance import (
    LINK_PAIRS,
    LINKS,
    clearances,
    proportions,
)
from stewart_drake.mechanism.files import load_mechanism
from stewart_drake.mechanism.kinematics import legs_along
from stewart_drake.scenario.loading import load_scenario
from stewart_drake.studies.clearance import clearance_along, study_clearance
from stewart_drake.studies.workspace_map import sections, travel
from tests.mechanisms import PAPER, random_mechanism, random_pose
from tests.oracles import center_lines, segment_distances
from tests.screen import said, summary_in

pytestmark = pytest.mark.usefixtures("blank_figures")

seeds = st.integers(0, 2**32 - 1)
seeded = settings(max_examples=25, deadline=None, derandomize=True)
LEG = ("1", "2", "3", "4", "5", "6")


def distance(p, u, q, v):
    """Return the distance of two segments by bounded least squares."""
    found = lsq_linear(np.column_stack([u, -v]), q - p, (0.0, 1.0), tol=1e-14)
    return float(np.linalg.norm(p + found.x[0] * u - q - found.x[1] * v))


# ------------------------------------------------------------------ centre lines


@given(seed=seeds)
@seeded
def test_segments_are_as_far_apart_as_least_squares_says(seed):
    rng = np.random.default_rng(seed)
    p, u, q, v = rng.normal(size=(4, 20, 3)) * rng.choice([0.1, 1.0, 3.0], (4, 20, 1))
    found = segment_distances(p, u, q, v)
    expected = [distance(*one) for one in zip(p, u, q, v, strict=True)]
    np.testing.assert_allclose(found, expected, atol=1e-6)


@pytest.mark.parametrize(
    ("q", "v", "wanted"),
    [
        ([0.3, 0, 2], [0.4, 0, 0], 2),  # beside each other
        ([4, 0, 4], [2, 0, 0], 5),  # one after the other, 3 and 4
        ([4, 0, 3], [-8, 0, 0], 3),  # the other way round
        ([0.5, -1, 0], [0, 2, 0], 0),  # crossing
        ([-3, 4, 0], [0, 9, 0], 5),  # end to end
    ],
)
def test_segments_in_the_plane(q, v, wanted):
    axis = np.array([1.0, 0, 0])
    found = segment_distances(np.zeros(3), axis, np.array(q, float), np.array(v, float))
    assert found == pytest.approx(wanted, abs=1e-12)


# ------------------------------------------------------------------ shapes


def test_every_pair_is_looked_at_but_those_that_meet_in_a_joint():
    names = {frozenset(pair) for pair in ClearanceScene(PAPER).pairs}
    links = {frozenset(pair) for pair in ClearanceScene(PAPER, base=False).pairs}
    assert links == {p for p in names if not Pair(*sorted(p)).fixed}
    assert links == {frozenset((LINKS[i], LINKS[j])) for i, j in LINK_PAIRS} | {
        frozenset(("plate", f"crank {leg}")) for leg in LEG
    }
    assert len(LINK_PAIRS) == 60 and all(
        frozenset((f"crank {k}", f"rod {k}")) not in links for k in LEG
    )
    for first, second in product(LEG, LEG):
        # A crank turns about its own motor, a rod does not.
        assert (frozenset((f"motor {first}", f"crank {second}")) in names) == (first != second)
        assert frozenset((f"motor {first}", f"rod {second}")) in names
    assert str(Pair("rod 1", "crank 2")) == "rod 1 and crank 2"


@given(seed=seeds)
@seeded
def test_rods_are_as_far_apart_as_least_squares_says(seed):
    """Capsules: their lines' distance less two radii, along the common normal."""
    rng = np.random.default_rng(seed)
    mechanism = random_mechanism(rng)
    pose = random_pose(rng, mechanism)
    scene, home = ClearanceScene(mechanism, base=False), assemble(mechanism, pose)
    radius = proportions(mechanism).rod_radius
    along = mechanism.rod_lengths[:, None] * home.R_WD[:, :, 0]
    start, line = (
        x[0] for x in center_lines(mechanism, pose[None], legs_along(mechanism, pose[None]))
    )
    np.testing.assert_allclose(start, np.vstack([mechanism.p_WS, home.p_WT]), atol=1e-12)
    np.testing.assert_allclose(line, np.vstack([home.p_WT - mechanism.p_WS, along]), atol=1e-12)
    found = dict(zip(scene.pairs, scene.distances(pose), strict=True))
    for i, j in combinations(range(6), 2):
        ends = home.p_WT[i], along[i], home.p_WT[j], along[j]
        apart = distance(*ends) - 2 * radius
        assert found[Pair(f"rod {i + 1}", f"rod {j + 1}")] == pytest.approx(apart, abs=1e-6)


def nearest_in_box(point, half):
    return np.clip(point, -half, half)


def nearest_in_capsule(point, radius, half):
    on_axis = np.array([np.clip(point[0], -half, half), 0, 0])
    off = point - on_axis
    return on_axis + off * min(1.0, radius / max(float(np.linalg.norm(off)), 1e-300))


def by_projections(mechanism, pose, first, second):
    """Distance of two links: projected from one onto the other until nothing changes."""
    size, home = proportions(mechanism), assemble(mechanism, pose)

    def onto(name, point):
        kind, leg = name.split()[0], int(name.split()[1]) - 1
        if kind == "crank":
            R, half = home.R_WC[leg], mechanism.crank_lengths[leg] / 2
            middle = mechanism.p_WS[leg] + half * R[:, 0]
            extent = np.array([half, size.crank_width / 2, size.crank_thickness / 2])
            return middle + R @ nearest_in_box(R.T @ (point - middle), extent)
        R, half = home.R_WD[leg], mechanism.rod_lengths[leg] / 2
        middle = home.p_WT[leg] + half * R[:, 0]
        return middle + R @ nearest_in_capsule(R.T @ (point - middle), size.rod_radius, half)

    point, before = np.zeros(3), np.full(3, np.inf)
    for _ in range(20000):
        other = onto(second, point)
        point = onto(first, other)
        if np.abs(point - before).max() < 1e-12:
            break
        before = point
    return float(np.linalg.norm(point - other))


@pytest.mark.parametrize("name", ["paper_clear", "desktop"])
def test_cranks_and_rods_are_as_far_apart_as_by_projections(name):
    experiment = prepare_unchecked(load_scenario("paper" if name == "paper_clear" else name))
    mechanism = load_mechanism(name)
    scene = ClearanceScene(mechanism, base=False)
    for time in (0.0, 2.3, 4.7):
        pose = experiment.reference.value(time)[:, 0]
        found = dict(zip(scene.pairs, scene.distances(pose), strict=True))
        links = [pair for pair in found if "plate" not in pair]
        for pair in sorted(links, key=lambda pair: found[pair])[:12]:
            wanted = by_projections(mechanism, pose, *pair)
            # The projections are two points of the links, so that Drake's distance is too large
            # where it is larger: its iteration has stopped before the end.
            assert -1e-7 < found[pair] - wanted < 1e-7 + 0.01 * wanted, pair
            if pair.first[:3] == pair.second[:3]:  # two cranks, or two rods
                assert found[pair] == pytest.approx(wanted, abs=1e-7), pair


@given(seed=seeds)
@seeded
def test_capsules_are_never_further_apart_than_the_links_in_them(seed):
    rng = np.random.default_rng(seed)
    mechanism = random_mechanism(rng)
    pose = random_pose(rng, mechanism)
    low = clearances(mechanism, pose[None])[0]
    scene = ClearanceScene(mechanism, base=False)
    found = {frozenset(p): d for p, d in zip(scene.pairs, scene.distances(pose), strict=True)}
    for (i, j), least in zip(LINK_PAIRS, low, strict=True):
        if least > 0:
            assert found[frozenset((LINKS[i], LINKS[j]))] >= least - 1e-6


# ------------------------------------------------------------------ along a motion, around home


def along(name, machine=None):
    experiment = prepare_unchecked(load_scenario(name))
    mechanism = load_mechanism(machine or name)
    time = np.linspace(0, 10, 101)
    return mechanism, time, np.array([experiment.reference.value(t)[:, 0] for t in time])


def test_the_reference_mechanism_crosses_and_paper_clear_does_not():
    mechanism, time, poses = along("paper")
    crossing = clearance_along(ClearanceScene(mechanism), mechanism, time, poses).touching
    names = {str(one.pair) for one in crossing}
    assert {"crank 1 and crank 2", "rod 1 and rod 2", "crank 1 and rod 2"} <= names
    assert len(crossing) == 9
    mechanism, time, poses = along("paper", "paper_clear")
    found = clearance_along(ClearanceScene(mechanism), mechanism, time, poses)
    assert not found.touching
    least = found.least(fixed=False)
    assert least is not None and least.distance == pytest.approx(0.567e-3, abs=2e-6)
    of_motors = [one for one in found.nearest if one.pair.fixed and "base" not in one.pair]
    assert of_motors[0].distance > 0  # its motors and posts stand free too, the drawn disc does not


def test_paper_clear_has_what_the_paper_publishes():
    clear = load_mechanism("paper_clear")
    assert proportions(clear)[:2] == pytest.approx((0.011, 0.0176))  # of a crank of 0.11 m
    for lengths in ("crank_lengths", "rod_lengths"):
        np.testing.assert_array_equal(getattr(clear, lengths), getattr(PAPER, lengths))
    for body in ("base", "plate", "crank", "rod"):
        ours, theirs = getattr(clear, body), getattr(PAPER, body)
        assert ours.mass == theirs.mass and list(ours.inertia) == list(theirs.inertia)
    for points in ("p_WS", "p_PQ"):
        for ours, theirs in zip(
            *(sorted_gaps(getattr(m, points)) for m in (clear, PAPER)), strict=True
        ):
            assert ours == pytest.approx(theirs, abs=1e-12)


def sorted_gaps(points):
    """Return the invariants of a turned pattern: radii and distances of all pairs."""
    radii = np.hypot(points[:, 0], points[:, 1])
    gaps = np.linalg.norm(points[:, None] - points[None], axis=2)
    return [*np.sort(radii), *np.sort(gaps.ravel())]


@pytest.mark.parametrize("name", shipped("mechanism"))
def test_travel_ends_where_two_links_touch(name):
    mechanism = load_mechanism(name)
    scene, ways = ClearanceScene(mechanism, base=False), travel(mechanism)
    found = study_clearance(mechanism, np.zeros(1), mechanism.home[None], ways, [])
    for k, (whole, one) in enumerate(zip(ways, found.travel, strict=True)):
        for end, limit, pair in (
            (one.low, whole.low, one.low_pair),
            (one.high, whole.high, one.high_pair),
        ):
            pose = mechanism.home.copy()
            pose[k] += end
            if pair is None:
                assert end == pytest.approx(limit, rel=1e-5)
            else:
                found_there = dict(zip(scene.pairs, scene.distances(pose), strict=True))
                assert abs(end) < abs(limit)
                assert end == 0 or found_there[pair] >= 0
                pose[k] += 2e-3 * limit
                beyond = dict(zip(scene.pairs, scene.distances(pose), strict=True))
                assert min(beyond.values()) < 0


def test_sections_tell_where_links_touch():
    clear = load_mechanism("paper_clear")
    parts = sections(clear, points=13)
    ways = travel(clear)
    found = study_clearance(clear, np.zeros(1), clear.home[None], ways, parts)
    scene = ClearanceScene(clear, base=False)
    for section, part in zip(found.sections, parts, strict=True):
        inside = np.isfinite(section.distance)
        assert section.touching == pytest.approx(np.mean(section.distance[inside] < 0))
        j, i = np.argwhere(inside)[len(np.argwhere(inside)) // 2]
        pose = clear.home.copy()
        pose[[part.first, part.second]] = section.x[i], section.y[j]
        assert section.distance[j, i] == pytest.approx(scene.distances(pose).min())
    assert 0 < found.sections[2].touching < 1  # tilted far enough, rods of two pairs meet


def test_out_of_reach_there_are_no_legs_and_nothing_is_said_to_be_clear():
    far = np.array([PAPER.home + [0, 0, 0, 0, 0, 1.0]])
    legs = legs_along(PAPER, np.array([PAPER.home, far[0]]))
    assert np.isfinite(legs.rod[0]).all() and np.isnan(legs.rod[1]).all()
    found = study_clearance(PAPER, np.zeros(1), far, [], [])
    assert found.along.nearest == [] and found.summary["least"] is None
    assert "nothing is known" in found.verdict


@pytest.mark.usefixtures("few_poses")
def test_the_command_names_the_links_that_cross(tmp_path, capsys):
    told = " ".join(said(capsys, "analyze", "workspace", "paper", "--out", tmp_path).split())
    found = summary_in(tmp_path)["clearance"]
    page = (tmp_path / "report.html").read_text()
    for one in found["touching"]:
        name = " and ".join(one["parts"])
        assert one["distance"] < 0 and name in told and name in page
    assert "workspace, but 9 pairs of links cross" in told and len(found["touching"]) == 9
    assert found["least"]["distance"] == min(one["distance"] for one in found["touching"])
    assert len(found["pairs"]) == len(ClearanceScene(PAPER).pairs)
    assert found["base"]["distance"] < 0
    assert " base," not in told and "below the base: cut it out" in told
    assert told.count("crosses a base that is a full disc") == 1  # its rows are on the page
