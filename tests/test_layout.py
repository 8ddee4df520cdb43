"""Search for a layout: measures against what studies say, symmetry, limits, files, the command."""

import dataclasses
import json

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from stewart_drake.cli import main
from stewart_drake.files.errors import ConfigError
from stewart_drake.loop.preparation import check_instants, prepare, prepare_unchecked
from stewart_drake.mechanism.assembly import assemble
from stewart_drake.mechanism.files import build_mechanism, load_mechanism, mechanism_spec
from stewart_drake.mechanism.geometry import bar_inertia
from stewart_drake.mechanism.kinematics import rotation
from stewart_drake.mechanism.trajectories import poses_along
from stewart_drake.scenario.loading import load_scenario
from stewart_drake.studies.layout import (
    Found,
    Layout,
    LayoutStudy,
    judge,
    problem_of,
    search,
)
from stewart_drake.studies.layout_space import (
    MEASURES,
    PARAMETERS,
    Arrangement,
    Requirements,
    geometry,
    motion_of,
    own_numbers,
    peak_torque,
    requirements,
    space_around,
)
from stewart_drake.studies.runs import Outcome
from stewart_drake.studies.study_options import LayoutOptions
from stewart_drake.studies.workspace import size_motors
from stewart_drake.studies.workspace_map import measure
from tests.mechanisms import PAPER
from tests.screen import said, summary_in

pytestmark = pytest.mark.usefixtures("blank_figures")

SPEC = mechanism_spec("paper")
OWN = Arrangement((5, 0, 1, 2, 3, 4), (-1, 1) * 3)
QUICK = ("plant.kind=exact", "duration=1.5")


def numbers(**other):
    """Return `PARAMETERS` of the paper's machine with other numbers."""
    return np.array(list((own_numbers(SPEC) | other).values()))


def problem(**options):
    return problem_of(load_scenario("paper", None, QUICK), LayoutOptions(**options))


# ------------------------------------------------------------------ measures


@pytest.mark.parametrize("name", ["paper", "desktop", "motion_base"])
def test_measures_are_what_the_workspace_study_says(name):
    experiment = prepare(load_scenario(name))
    time = check_instants(experiment.scenario.duration)[::10]
    mechanism, reference = experiment.mechanism, experiment.reference
    motion = motion_of(mechanism.home, reference, time)
    found, along = geometry(mechanism, motion), measure(mechanism, poses_along(reference, time))
    home = measure(mechanism, poses_along(_still(mechanism.home), np.zeros(1)))
    for key, values, worst in (
        ("reach", [along.reach, home.reach], np.min),
        ("transmission", [along.transmission, home.transmission], np.min),
        ("condition", [along.condition, home.condition], np.max),
        ("parallel", [along.parallel, home.parallel], np.min),
    ):
        assert found[key] == pytest.approx(worst([worst(v) for v in values]), rel=1e-9), key
    torque = np.abs(size_motors(experiment.nominal, reference, time).torque).max()
    assert peak_torque(experiment.nominal, motion) == pytest.approx(torque, rel=1e-12)


def _still(pose):
    from pydrake.trajectories import PiecewisePolynomial

    return PiecewisePolynomial.ZeroOrderHold([0.0, 1.0], np.column_stack([pose, pose]))


def test_joint_angles_are_those_of_the_link_frames():
    experiment = prepare_unchecked(load_scenario("paper"))
    motion = motion_of(PAPER.home, experiment.reference, np.linspace(0, 6, 25))
    found, home = geometry(PAPER, motion), assemble(PAPER, PAPER.home)
    turns, leans = [], []
    for pose in motion.poses:
        now = assemble(PAPER, pose)
        for leg in range(6):
            seen = rotation(pose[:3]).T @ now.R_WD[leg][:, 0]
            turns.append(np.arccos(np.clip(seen @ home.R_WD[leg][:, 0], -1, 1)))
            axis = PAPER.R_WS[leg][:, 2]
            out = now.R_WD[leg][:, 0] @ axis
            leans.append(np.arctan2(abs(out), np.linalg.norm(np.cross(now.R_WD[leg][:, 0], axis))))
    assert found["plate_joint_deg"] == pytest.approx(np.rad2deg(max(turns)), rel=1e-9)
    assert found["crank_joint_deg"] == pytest.approx(np.rad2deg(max(leans)), rel=1e-9)


def test_requirements_say_which_limits_are_missed_and_by_which_share():
    wanted = requirements("reach", {"clearance": 0.01, "condition": 4.0}, {"clearance": 1.0})
    missed = wanted.missed({"clearance": 0.004, "condition": 5.0, "reach": 0.1})
    assert missed == pytest.approx({"clearance": 0.6, "condition": 0.25})
    assert wanted.missed({"clearance": 0.01, "condition": 4.0}) == {}
    assert (
        wanted.cost({"reach": 0.1}) == -0.1
        and Requirements({}, "torque").cost({"torque": 2.0}) == 2.0
    )


# ------------------------------------------------------------------ the space


def test_the_machine_it_begins_from_is_in_the_space():
    space = space_around(SPEC, {}, ())
    machine = build_mechanism(space.machine(numbers(), OWN, "paper"))
    assert machine == PAPER
    assert space.arrangements()[0] == OWN and OWN.centre_deg == 60
    low, high = np.array(space.ranges(OWN)).T
    assert np.all((low <= numbers()) & (numbers() <= high))


@given(order=st.sampled_from([(5, 0, 1, 2, 3, 4), (0, 1, 2, 3, 4, 5)]), signs=st.booleans())
@settings(max_examples=4, deadline=None, derandomize=True)
def test_at_the_centre_the_legs_of_a_pair_are_mirror_images(order, signs):
    space = space_around(SPEC, {}, ())
    branches = (1, -1) * 3 if signs else (-1, 1) * 3
    arrangement = next(
        one for one in space.arrangements() if (one.order, one.branches) == (order, branches)
    )
    values = numbers(rotation_deg=0.0, plate_offset_deg=arrangement.centre_deg)
    legs = space.legs(values, arrangement)
    np.testing.assert_allclose(legs.p_WS[0] * [1, -1, 1], legs.p_WS[1], atol=1e-12)
    np.testing.assert_allclose(legs.p_PQ[0] * [1, -1, 1], legs.p_PQ[1], atol=1e-12)


def test_links_of_the_same_section_keep_a_uniform_bar_s_inertia():
    """The moment of a thin bar, m l^2 / 12, grows with the cube of its length."""
    moments = bar_inertia(0.08, 0.404).tolist()
    spec = dataclasses.replace(SPEC, rod=dataclasses.replace(SPEC.rod, inertia=moments))
    own = own_numbers(spec)
    values = numbers(rod=1.3 * own["rod"], plate_radius=1.2 * own["plate_radius"])
    made = space_around(spec, {}, ()).machine(values, OWN, "longer")
    assert made.rod.inertia is not None and made.plate.inertia is not None
    assert made.rod.mass == pytest.approx(1.3 * 0.08)
    wanted = bar_inertia(1.3 * 0.08, 1.3 * 0.404)
    assert made.rod.inertia[1:] == pytest.approx(wanted[1:].tolist())
    assert made.plate.mass == SPEC.plate.mass
    assert made.plate.inertia == pytest.approx([1.44 * i for i in SPEC.plate.inertia or []])


@pytest.mark.parametrize(
    ("vary", "keep", "word"),
    [
        ({"size": (1, 2)}, (), "--vary: got size"),
        ({}, ("size",), "--keep: got size"),
        ({"crank": (0.2, 0.1)}, (), "--vary crank: got 0.2:0.1"),
        ({"crank": (0.0, 0.1)}, (), "--vary crank: length: got 0.0"),
        ({"rod": (0.1, np.inf)}, (), "--vary rod: length: got inf"),
        ({"base_radius": (0.0, 0.1)}, (), "--vary: base_radius: got 0.0"),
        ({"plate_separation_deg": (5.0, 500.0)}, (), "--vary: plate_separation_deg: got 500.0"),
        ({"shaft_height": (0.0, 1e9)}, (), "--vary: shaft_height: got 1000000000.0"),
        ({"crank": (0.05, 0.06)}, ("crank",), "--keep: got crank, which --vary varies"),
        ({}, PARAMETERS, "--keep: got every number"),
    ],
)
def test_a_space_that_is_none_is_one_line(vary, keep, word):
    with pytest.raises(ConfigError, match=word):
        space_around(SPEC, vary, keep)


# ------------------------------------------------------------------ the search


def test_a_search_keeps_limits_and_betters_the_goal(monkeypatch):
    monkeypatch.setattr("stewart_drake.studies.layout.POPULATION", 3)
    asked = problem(limits={"reach": 0.005, "clearance": -1.0}, vary={"crank": (0.1, 0.12)})
    found = json.loads(search(asked, OWN, 3, 0, 4))
    values, own = np.array(found["values"]), asked.trial(numbers(), OWN)
    assert found["missed"] == {} and not asked.requirements.missed(own)
    # The machine itself is among the first, so that nothing worse is found, but for rounding.
    assert found["measures"]["condition"] < 1.001 * own["condition"]
    for value, (low, high) in zip(values, asked.space.ranges(OWN), strict=True):
        assert low - 1e-4 <= value <= high + 1e-4
    assert asked.trial(values, OWN) == pytest.approx(found["measures"])
    assert json.loads(search(asked, OWN, 3, 0, 4)) == found
    assert json.loads(search(asked, OWN, 4, 0, 4))["values"] != found["values"]


def test_reach_counts_before_limits_and_limits_before_the_goal():
    asked = problem(goal="torque", limits={"reach": 0.005, "clearance": -1.0})
    own, short, shorter = numbers(), numbers(rod=0.33), numbers(rod=0.3)
    costs = [asked.cost(asked.trial(values, OWN)) for values in (own, short, shorter)]
    tight = problem(goal="torque", limits={"reach": 0.1, "clearance": -1.0})
    missed = tight.trial(own, OWN)
    assert costs[0] == pytest.approx(asked.trial(own, OWN)["torque"]) and "torque" not in missed
    assert costs[0] < tight.cost(missed) < costs[1] < costs[2]
    assert asked.cost(asked.trial(numbers(crank=0.41), OWN)) > tight.cost(missed)  # as the rod


def test_a_judgement_is_of_all_instants_and_a_run_unless_out_of_reach():
    asked = problem(limits={"clearance": -1.0})
    found = json.loads(judge(asked, "paper"))
    reference = prepare_unchecked(asked.scenario).reference
    along = measure(PAPER, poses_along(reference, check_instants(1.5)))
    assert found["measures"]["reach"] == pytest.approx(along.reach.min(), abs=1e-4)
    assert found["measures"]["clearance"] == found["nearest"][1] < 0
    assert found["outcome"]["status"] == "completed"
    assert set(found["measures"]) == {*MEASURES, "parallel"}
    far = load_scenario("paper", None, (*QUICK, "reference.offset=[0, 0, 0, 0, 0, 0.9]"))
    found = json.loads(judge(problem_of(far, LayoutOptions()), "paper"))
    assert found["outcome"]["status"] == "refused" and found["measures"]["reach"] < 0
    assert list(found["measures"]) == ["reach"]


def test_a_layout_that_loses_its_goal_between_the_instants_looked_at_is_reported():
    own = numbers()
    lost = Layout("layout_1", PAPER, OWN.order, own, {"reach": -0.01}, {"reach": 1.02}, None,
                  Outcome("refused", "out of reach", time=0.0))  # fmt: skip
    found = Found(list(OWN.order), list(OWN.branches), own.tolist(), {"condition": 3.0}, {}, 7)
    study = LayoutStudy(problem(), LayoutOptions(), {"a": found}, lost, [lost])
    assert study.verdict == (
        "partly: of 7 layouts in 1 searches the best has no condition at every instant; "
        "0 of 1 complete the scenario; layout_1 misses reach"
    )
    keeps = lost._replace(name="layout_2", measures={"condition": 3.0}, missed={})
    both = LayoutStudy(problem(), LayoutOptions(), {"a": found}, lost, [lost, keeps])
    assert "layout_2, which keeps the limits, has a condition of 3; 0 of 2" in both.verdict


def test_errata_another_layout_is_conditioned_better():
    """Published lengths and separations, and the search of docs/errata.md."""
    limits = {"reach": 0.005, "clearance": -1.0}
    asked = problem_of(load_scenario("paper"), LayoutOptions(limits=limits))
    other = numbers(
        rotation_deg=9.7451,
        plate_offset_deg=68.9924,
        shaft_height=0.0229,
        installation_deg=68.2484,
    )
    ours, theirs = asked.trial(numbers(), OWN), asked.trial(other, OWN)
    assert not asked.requirements.missed(theirs)
    assert ours["condition"] == pytest.approx(5.07, abs=0.01)
    assert theirs["condition"] == pytest.approx(3.73, abs=0.01)
    assert theirs["reach"] == pytest.approx(0.0103, abs=1e-4)


# ------------------------------------------------------------------ the command

SMALL = ["layout", "paper", "--set", "plant.kind=exact", "--set", "duration=1.5"]
SMALL += ["--keep", "branches", "--keep", "plate_order", "--generations", "1", "--best", "1"]


@pytest.fixture
def in_process(monkeypatch):
    """Jobs run here, with few trials, and are counted."""
    done = []

    def here(workers, calls):
        done.append(len(calls))
        return (call() for call in calls)

    monkeypatch.setattr("stewart_drake.studies.jobs._on_this_machine", here)
    monkeypatch.setattr("stewart_drake.studies.layout.POPULATION", 2)
    return done


@pytest.mark.slow
def test_the_command_writes_machines_that_run_and_goes_on(tmp_path, capsys, in_process):
    command = [*SMALL, "--limit", "clearance=-1", "--seed", "2", "--out", str(tmp_path)]
    assert said(capsys, *command).startswith("yes: of ")
    summary = summary_in(tmp_path)
    (best,) = summary["layouts"]
    machine = load_mechanism(tmp_path / "layout_1.yaml")
    assert machine.name == "layout_1" and best["run"]["status"] == "completed"
    assert best["measures"]["condition"] <= 1.01 * summary["before"]["measures"]["condition"]
    reference = prepare(
        load_scenario("paper", None, (f"mechanism={tmp_path / 'layout_1.yaml'}", *QUICK))
    ).reference
    reach = measure(machine, poses_along(reference, check_instants(1.5))).reach.min()
    assert best["measures"]["reach"] <= reach < best["measures"]["reach"] + 0.01
    page = (tmp_path / "report.html").read_text()
    assert "layout_1" in page and "stewart-drake layout paper" in page and page.count("<img") == 2
    assert in_process == [1, 2]
    # Again: nothing is left to do, and with a search lost this one is done again, to the same end.
    kept = (tmp_path / "layout_1.yaml").read_bytes()
    assert main(command) == 0 and in_process == [1, 2, 0, 0]
    (found,) = (tmp_path / "searches").glob("joints*.json")
    found.unlink()
    assert main(command) == 0 and in_process[-2:] == [1, 0]
    assert (tmp_path / "layout_1.yaml").read_bytes() == kept
    assert main([*command, "--seed", "3"]) == 2
    assert "belongs to other settings (seed: 2 there, 3 now)" in capsys.readouterr().err


def test_limits_that_nothing_keeps_are_reported_and_no_machine_is_written(tmp_path, capsys):
    told = " ".join(said(capsys, *SMALL, "--limit", "clearance=1", "--out", tmp_path).split())
    assert told.startswith("no: of ") and "the nearest misses" in told and "clearance by" in told
    assert not list(tmp_path.glob("*.yaml"))
    assert summary_in(tmp_path)["layouts"] == []
