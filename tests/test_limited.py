"""Plans within limits: the quadratic program, its parts, and the law that sends them."""

from dataclasses import dataclass, replace

import numpy as np
import pytest
from pydrake.solvers import ClarabelSolver, MathematicalProgram

from stewart_drake.dynamics.stewart import StewartDynamics
from stewart_drake.export.controller import exported
from stewart_drake.files.errors import ConfigError
from stewart_drake.law.belief import Belief, Estimate
from stewart_drake.law.clear_space import ClearSpace
from stewart_drake.law.coverage import uncovered_part
from stewart_drake.law.feedforward import GAUSS_NODES, InverseDynamicsFeedforward, mean_torques
from stewart_drake.law.horizon import (
    NEAR,
    HoldModel,
    HorizonCost,
    QpError,
    condense,
    pose_root,
    problem_of,
    riccati,
    solve_by_daqp,
)
from stewart_drake.law.least_error import LEAST_ERROR_SHARE
from stewart_drake.law.limited import LimitedLqi
from stewart_drake.law.nominal import NominalPlant, TorqueLimit
from stewart_drake.law.timeline import Timeline
from stewart_drake.loop.bulk import run_in_bulk
from stewart_drake.loop.law_design import catch_up_of, clear_space, compose_law
from stewart_drake.loop.preparation import prepare
from stewart_drake.loop.simulation import simulate
from stewart_drake.mechanism.clearance import LINK_PAIRS
from stewart_drake.mechanism.files import load_mechanism
from stewart_drake.mechanism.kinematics import reach_margins
from stewart_drake.mechanism.trajectories import evaluate, rows_along
from stewart_drake.reporting.run import run_document
from stewart_drake.scenario.loading import load_scenario
from stewart_drake.scenario.timing import Delay
from tests.oracles import capsule_clearances, central_difference

ON = ("plant.kind=exact", "start=on_reference", "queue=reference")
NONE = "controller.estimate=[]"
TAU = 0.013267
"""Largest torque of the reference, N m."""


def limited(share, *settings, controller="predictor_mpc"):
    limit = f"actuator.torque_limit={share * TAU:g}"
    return load_scenario("paper", controller, (*ON, NONE, limit, *settings))


# ---------------------------------------------------------------- model, Riccati equation, QP


@pytest.fixture(scope="module")
def paper():
    return load_mechanism("paper")


@pytest.fixture(scope="module")
def plan(paper):
    """States and torques of five holds that are no motion, with model and cost about them."""
    rng = np.random.default_rng(4)
    plant = NominalPlant(StewartDynamics(paper, gravity=True), 4, 1.0, TorqueLimit())
    holds = HoldModel(plant, plant.dynamics.parameters, 0.1)
    states = np.zeros((6, 12))
    states[:, :6] = paper.home + 0.02 * rng.standard_normal((6, 6)) * paper.home[5]
    states[:, 6:] = 0.1 * rng.standard_normal((6, 12 - 6))
    torques = plant.dynamics.equilibrium_torque(paper.home) + 0.01 * rng.standard_normal((5, 6))
    root = rng.standard_normal((12, 12))
    cost = HorizonCost(
        wanted=paper.home + 0.01 * rng.standard_normal((5, 2, 6)),
        end=np.concatenate([paper.home, np.zeros(6)]),
        torques=torques + 0.01,
        Q=np.array([1.0, 2.0, 3.0, 100.0, 200.0, 300.0]),
        R=np.diag([1.0, 2.0, 3.0, 4.0, 5.0, 6.0]),
        P=root @ root.T,
    )
    return plant, states, torques, holds.linearised(states, torques), cost


def test_the_model_of_a_hold_converges_to_the_derivative_of_its_motion(plan):
    """The midpoint rule along the motion: the error of a hold falls with its length cubed."""
    plant, states, torques, *_ = plan
    state, torque = states[2], torques[2]

    def error(period):
        def after(xi):
            return plant.dynamics.predict(xi[:12], xi[12:], period, 64)[-1]

        holds = HoldModel(plant, plant.dynamics.parameters, period)
        model = holds.linearised(np.array([state, state]), torque[None])
        xi = np.concatenate([state, torque])
        np.testing.assert_allclose(model.defects[0], after(xi) - state, atol=1e-4)
        found = np.hstack([model.Phi[0], model.Gamma[0]])
        return np.abs(found - central_difference(after, xi, 1e-5)).max()

    coarse, fine = error(0.04), error(0.01)
    assert fine < 1e-3 and np.log(coarse / fine) / np.log(4) > 2


def total(plan, start, changes):
    """Cost of torque changes (5, 6) in model (plan), term by term."""
    _, states, torques, model, cost = plan
    value, dx = 0.0, start
    for j, change in enumerate(changes):
        both = np.concatenate([dx, change])
        for node in range(2):
            error = model.nodes[j, node] + model.node_maps[j, node] @ both - cost.wanted[j, node]
            value += error @ (cost.Q * error) / 4
        torque = torques[j] + change - cost.torques[j]
        value += torque @ cost.R @ torque / 2
        dx = model.Phi[j] @ dx + model.Gamma[j] @ change + model.defects[j]
    end = states[-1] + dx - cost.end
    return value + end @ cost.P @ end / 2


def test_condensed_deviations_cost_half_their_square_above_the_least(plan):
    _, states, torques, model, cost = plan
    rng = np.random.default_rng(1)
    start = 0.01 * rng.standard_normal(12)
    found = condense(model, riccati(model, cost, states, torques), start)
    least = total(plan, start, found.torques)
    for _ in range(5):
        v = rng.standard_normal(30)
        changes = found.torques + found.torque_map @ v
        assert total(plan, start, changes) - least == pytest.approx(v @ v / 2, rel=1e-8)
        dx = start
        for j, change in enumerate(changes):
            dx = model.Phi[j] @ dx + model.Gamma[j] @ change + model.defects[j]
        np.testing.assert_allclose(found.states[-1] + found.state_map[-1] @ v, dx, atol=1e-9)


def problems_of(scenario):
    """Every problem of a run."""
    found = []

    def keep(problem, seconds):
        found.append(problem)
        return solve_by_daqp(problem, seconds)

    def keeping(law):
        return replace(law, limits=replace(law.limits, solver=keep))

    simulate(scenario, judge_stability=False, modify_law=keeping)
    return found


@pytest.fixture(scope="module")
def problems():
    return problems_of(limited(0.8, "duration=0.8"))


def by_clarabel(problem):
    program = MathematicalProgram()
    z = program.NewContinuousVariables(len(problem.h))
    program.AddQuadraticCost(np.diag(problem.h), problem.g, z, is_convex=True)
    program.AddLinearConstraint(problem.A, problem.lower, problem.upper, z)
    program.AddBoundingBoxConstraint(0, np.inf, z[: problem.slacks])
    result = ClarabelSolver().Solve(program)
    assert result.is_success()
    return result.GetSolution(z)


def test_the_solver_agrees_with_an_interior_point_method(problems):
    assert len(problems) == 2 * 9
    assert any(problem.slacks for problem in problems)
    for problem in problems[::6]:
        z, other = solve_by_daqp(problem), by_clarabel(problem)
        slack = 1e-6
        assert (problem.A @ z >= problem.lower - slack).all()
        assert (problem.A @ z <= problem.upper + slack).all()
        v, w = z[problem.slacks :], other[problem.slacks :]
        np.testing.assert_allclose(v, w, atol=2e-3 * np.abs(w).max())


def test_a_problem_without_a_solution_is_an_error(problems):
    problem = problems[0]
    with pytest.raises(QpError, match="flag -1"):
        solve_by_daqp(problem._replace(lower=problem.upper + 1, upper=problem.upper))


def test_without_limits_the_problem_has_no_rows_far_from_the_edge(paper, plan):
    _, states, torques, model, cost = plan
    found = condense(model, riccati(model, cost, states, torques), np.zeros(12))
    space = ClearSpace.along(paper, paper.home[None])
    far = np.tile(paper.home, (5, 1))
    assert space.room(far)[:, :6].min() > NEAR
    unguarded = replace(space, pairs=space.pairs[:0], least=space.least[:6])
    assert problem_of(found, far, torques, np.inf, unguarded).A.size == 0


def test_the_root_of_the_pose_is_that_of_sampled_predictions(paper):
    """States and parameters drawn from the belief, integrated through the torques in flight."""
    rng, size = np.random.default_rng(5), 400
    dynamics = StewartDynamics(paper, gravity=True)
    plant = NominalPlant(dynamics, 4, 1.0, TorqueLimit())
    n = 12 + len(dynamics.free)
    spread = np.concatenate([np.full(6, 1e-4), np.full(6, 1e-3), np.full(n - 12, 1e-4)])
    C = np.diag(spread**2)
    mean = np.concatenate([paper.home, np.zeros(6), dynamics.parameters])
    timeline = Timeline(0.1, Delay(4))
    belief = replace(Belief.nothing(timeline, 12, dynamics.parameters), estimate=Estimate(mean, C))
    schedule = timeline.until_next(np.tile(dynamics.equilibrium_torque(paper.home), (4, 1)))
    states = plant.predict(belief.state, schedule, belief.parameters)
    W = pose_root(plant, belief, schedule, states)
    drawn = mean + spread * rng.standard_normal((size, n))
    ends = [plant.predict(xi[:12], schedule, xi[12:])[-1, :6] for xi in drawn]
    stated = np.linalg.cholesky(W @ W.T)
    whitened = np.linalg.solve(stated, (ends - np.mean(ends, axis=0)).T)
    eigenvalues = np.linalg.eigvalsh(whitened @ whitened.T / (size - 1))
    low, high = ((1 + sign * np.sqrt(6 / size)) ** 2 for sign in (-1, 1))  # Marchenko-Pastur
    assert 0.9 * low < eigenvalues[0] and eigenvalues[-1] < 1.1 * high


def test_a_plan_keeps_a_standard_deviation_of_each_distance(paper, plan):
    _, states, torques, model, cost = plan
    found = condense(model, riccati(model, cost, states, torques), np.zeros(12))
    space, root = ClearSpace.along(paper, paper.home[None]), 1e-3 * np.eye(6)
    poses = states[1:, :6]
    known, unsure = (problem_of(found, poses, torques, np.inf, space, w) for w in (0 * root, root))
    slopes = space.near(poses, NEAR).slopes
    np.testing.assert_allclose(
        unsure.lower - known.lower, 1e-3 * np.linalg.norm(slopes, axis=1), rtol=1e-9, atol=1e-12
    )


def test_slopes_of_the_distances_are_their_derivatives(paper):
    space = clear_space(prepare(load_scenario("desktop")))
    poses = space.mechanism.home + 1e-3 * np.random.default_rng(2).standard_normal((3, 6))
    near = space.near(poses, below=np.inf)
    assert len(near.room) == 3 * (6 + len(space.pairs))
    for row in (0, 5, 20, len(near.room) - 1):
        pose = poses[near.pose[row]]
        which = np.flatnonzero(np.isclose(space.room(pose[None])[0], near.room[row], rtol=1e-12))[0]
        expected = central_difference(lambda q, w=which: space.room(q[None])[0, [w]], pose, 1e-5)
        scale = np.abs(expected).max()
        np.testing.assert_allclose(near.slopes[row], expected[0], atol=2e-3 * scale)


@pytest.mark.parametrize("name", ["paper", "desktop"])
def test_room_is_that_of_the_margins_and_clearances(name):
    space = clear_space(prepare(load_scenario(name)))
    machine, far = space.mechanism, np.random.default_rng(3).uniform(-1, 1, (300, 6))
    poses = machine.home + 0.6 * far * np.repeat([1.0, machine.crank_lengths.min()], 3)
    margins = reach_margins(machine, poses)
    apart = capsule_clearances(machine, poses)[:, space.pairs]
    expected = np.hstack([margins, apart]) / machine.crank_lengths.min() - space.least
    assert np.isnan(expected).any() and (expected < 0).any()
    np.testing.assert_allclose(space.room(poses), expected, atol=1e-12)


def test_pairs_that_touch_on_the_reference_are_not_guarded():
    touching = clear_space(prepare(load_scenario("paper")))
    names = {LINK_PAIRS[pair] for pair in touching.pairs}
    assert (0, 1) not in names and (0, 2) in names  # cranks 1 and 2 touch at home
    assert len(clear_space(prepare(load_scenario("desktop"))).pairs) == len(LINK_PAIRS)


# ---------------------------------------------------------------- the law


def test_where_nothing_binds_it_is_predictor_lqi():
    half = "reference.amplitude=[0.13, 0.13, 0.13, 0.01, 0.01, 0.04]"
    unknown = "plant.torque_bias=[1e-4, -1e-4, 1e-4, 1e-4, -1e-4, 1e-4]", "plant.payload_mass=0.1"
    settings = (*ON, half, *unknown, "duration=2", "delay.fraction=0.25")
    free, plans = (
        simulate(load_scenario("paper", name, settings), judge_stability=False)
        for name in ("predictor_lqi", "predictor_mpc")
    )
    assert plans.summary["counts"]["limited_steps"] == 0
    for signal in ("torque_commanded", "pose", "state_estimate"):
        assert np.array_equal(free.signals[signal], plans.signals[signal])


def test_limits_are_kept_and_the_error_is_less_than_half_of_that_of_cut_torques():
    duration = "duration=3"
    plans = run_in_bulk(limited(0.85, duration))
    cut = run_in_bulk(limited(0.85, duration, controller="predictor_lqi"))
    assert plans.status == "completed" and plans.counts["limited_steps"] == 31
    assert plans.counts["qp_failures"] == plans.counts["qp_late"] == 0
    largest, limit = np.abs(plans.samples[:, 12:]).max(axis=1), float(f"{0.85 * TAU:g}")
    assert largest.max() <= limit
    at_limit = np.count_nonzero(largest == limit)
    assert 0 < plans.counts["saturated_steps"] == at_limit < 31
    assert plans.error_so_far < cut.error_so_far / 2


def test_from_rest_it_catches_up_without_a_planned_way():
    settings = ("plant.kind=exact", NONE, f"actuator.torque_limit={7.5 * TAU:g}", "duration=2.5")
    plans, way = (
        run_in_bulk(load_scenario("paper", name, settings))
        for name in ("predictor_mpc", "predictor_lqi")
    )
    assert 0 < plans.counts["limited_steps"] < 20  # then it is the free law again
    assert plans.error_so_far < way.error_so_far


def test_a_reference_that_leaves_the_workspace_is_refused_without_plans_and_governed_with_them():
    beyond = "reference.amplitude=[0.288, 0.288, 0.288, 0.022, 0.022, 0.088]"
    with pytest.raises(ConfigError, match=r"reference: leg . reached the end of its reach"):
        prepare(load_scenario("paper", "predictor_lqi", (*ON, NONE, beyond)))
    scenario = load_scenario("paper", "predictor_mpc", (*ON, NONE, beyond, "duration=2.4"))
    found = run_in_bulk(scenario)
    assert found.status == "completed" and found.counts["limited_steps"] > 0
    out = "reference.offset=[0, 0, 0, 0, 0, 0.9]"
    with pytest.raises(ConfigError, match=r"reference: .* at t = 0\.00 s"):
        prepare(load_scenario("paper", "predictor_mpc", (*ON, NONE, out)))


@pytest.mark.parametrize("seed", [7001, 7002, 7006])
def test_a_reference_that_leaves_the_workspace_is_governed_with_an_unknown_bias(seed):
    """The prior is that of a motion within reach: beyond it torques have no bound."""
    signs = np.random.default_rng(seed).choice([-1.0, 1.0], 6)
    amplitude = np.array([np.deg2rad(15)] * 3 + [0.02, 0.02, 0.08])
    noise = (1e-3 * np.tile(amplitude, 2)).tolist()
    settings = (
        f"reference.amplitude={(1.2 * amplitude).tolist()}",
        f"sensor.noise_std={noise}",
        f"sensor.seed={seed}",
        f"plant.torque_bias={(3e-4 * signs).tolist()}",
        "plant.payload_mass=0.02",
        "duration=2",
    )
    found = run_in_bulk(load_scenario("paper", "predictor_mpc", (*ON, *settings)))
    assert found.status == "completed"


def test_drakes_loop_and_the_loop_in_c_agree():
    scenario = limited(0.9, "duration=1.5")
    drake, bulk = simulate(scenario, judge_stability=False), run_in_bulk(scenario)
    assert bulk.loop == "native, controller.limits in Python"
    assert drake.accumulated_error == pytest.approx(bulk.error_so_far, rel=1e-3)


@pytest.mark.slow
def test_plans_go_over_a_network():
    network = (
        "link.kind=network",
        "link.low=0.4",
        "link.high=0.7",
        "link.loss=0.3",
        "link.burst=3",
    )
    found = run_in_bulk(limited(0.9, *network, "controller.packet_torques=8", "duration=6"))
    assert found.status == "completed"
    assert np.abs(found.samples[:, 12:]).max() <= 0.9 * TAU * (1 + 1e-12)
    assert found.error_so_far < 5


def recorded(law, kept):
    """Return a law that keeps the memory after each step in a list."""

    class Kept(LimitedLqi):
        def step(self, *given):
            kept.append(super().step(*given))
            return kept[-1]

    return Kept(**{name: getattr(law, name) for name in law.__dataclass_fields__})


def test_packets_carry_the_plan():
    network = ("link.kind=network", "link.low=0.4", "link.high=0.7", "controller.packet_torques=8")
    law, kept = compose_law(prepare(limited(0.9, *network))), []
    scenario = limited(0.9, *network, "duration=0.5")
    simulate(scenario, judge_stability=False, modify_law=lambda law: recorded(law, kept))
    memory = kept[-1]
    np.testing.assert_array_equal(memory.sent.packets[-1, -8:], memory.plan.torques[:8])
    assert law.channel.torques == 8


@dataclass(frozen=True)
class Own(InverseDynamicsFeedforward):
    """A part in Python."""


def test_it_works_next_to_a_part_in_python():
    def with_part(law):
        return replace(law, feedforward=Own())

    scenario = limited(0.9, "duration=1")
    compiled, python = (
        simulate(scenario, judge_stability=False, modify_law=change)
        for change in (lambda law: law, with_part)
    )
    free = with_part(compose_law(prepare(scenario))).free
    assert uncovered_part(free) == "controller.feedforward"
    np.testing.assert_allclose(
        compiled.signals.torque_commanded, python.signals.torque_commanded, atol=1e-7
    )


# ---------------------------------------------------------------- failures


class Failing:
    """Solver that fails at some calls."""

    def __init__(self, failing, late=False):
        self.failing, self.late, self.calls = failing, late, 0

    def __call__(self, problem, seconds):
        self.calls += 1
        if self.calls in self.failing:
            raise QpError("injected", self.late)
        return solve_by_daqp(problem, seconds)


@pytest.mark.parametrize(
    ("late", "cause", "shown"),
    [
        (False, "qp_failures", "1 sample without a plan within the limits"),
        (True, "qp_late", "1 sample with a plan that was late"),
    ],
)
def test_after_a_failure_the_last_plan_goes_on(late, cause, shown):
    # Two programs a sample; at sample 5 the one about the last plan and about the reference fail.
    plans, solver = [], Failing({11, 12}, late)

    def failing(law):
        return recorded(replace(law, limits=replace(law.limits, solver=solver)), plans)

    result = simulate(limited(0.9, "duration=1.2"), judge_stability=False, modify_law=failing)
    assert result.status == "completed" and result.summary["counts"][cause] == 1
    before, after = plans[4], plans[5]
    assert getattr(after.counts, cause) == 1
    np.testing.assert_allclose(after.plan.torques[0], before.plan.torques[1], atol=1e-4 * TAU)
    np.testing.assert_array_equal(after.in_flight[-1], after.plan.torques[0])
    assert shown in " ".join(run_document(result).plain().split())


def test_without_any_plan_the_cut_torque_of_the_free_law_is_sent():
    def never(law):
        return replace(law, limits=replace(law.limits, solver=Failing(range(1000))))

    scenario = limited(0.9, "duration=0.8")
    failing = simulate(scenario, judge_stability=False, modify_law=never)
    counts = failing.summary["counts"]
    assert counts["qp_failures"] == counts["limited_steps"] == 9
    free = load_scenario(
        "paper",
        "predictor_lqi",
        (*ON, NONE, f"actuator.torque_limit={0.9 * TAU:g}", "duration=0.8"),
    )
    cut = simulate(free, judge_stability=False)
    limit = 0.9 * TAU
    np.testing.assert_allclose(
        failing.signals.torque_applied,
        np.clip(cut.signals.torque_applied, -limit, limit),
        atol=1e-9,
    )


def test_a_step_without_time_is_late():
    def hurried(law):
        return replace(law, limits=replace(law.limits, budget=0.0))

    result = simulate(limited(0.9, "duration=0.5"), judge_stability=False, modify_law=hurried)
    assert result.summary["counts"]["qp_late"] == 6


def test_it_is_not_exported():
    with pytest.raises(ConfigError, match=r"controller\.limits: got qp, which is not exported"):
        exported(limited(0.9))


# ---------------------------------------------------------------- way of least error


def from_rest(share, controller="predictor_lqi"):
    limit = f"actuator.torque_limit={share * TAU:g}"
    experiment = prepare(load_scenario("paper", controller, ("plant.kind=exact", NONE, limit)))
    law = compose_law(experiment)
    return experiment, law, catch_up_of(experiment, law)


@pytest.mark.parametrize("share", [2.3, 7.5])
def test_a_catch_up_of_least_error_follows_torques_within_the_limit(share):
    """Inverse dynamics of the motion are its torques: held, bounded, and on the reference after."""
    experiment, law, way = from_rest(share)
    motion, span = way.plan(None, experiment.planned_limit)
    begin, dynamics = law.timeline.eta, experiment.nominal
    edges = begin + 0.1 * np.arange(round(span / 0.1) + 1)
    torques = []
    for edge in edges[:-1]:
        rows = [evaluate(motion, edge + 0.025 * part) for part in (1, 2, 3)]
        held = [dynamics.inverse_dynamics(x[:6], x[6:12], x[12:]) for x in rows]
        np.testing.assert_allclose(held, held[:1] * np.ones((3, 1)), atol=1e-3 * TAU)
        torques.append(held[0])
    peak = np.abs(torques).max()
    assert peak == pytest.approx(LEAST_ERROR_SHARE * share * TAU, rel=1e-3)
    after = begin + span + 1e-6
    np.testing.assert_allclose(
        evaluate(motion, after)[:6], evaluate(experiment.reference, after)[:6], atol=1e-6
    )
    assert way.plan(None, experiment.planned_limit)[0] is motion


def test_no_other_torques_within_the_limit_have_less_error():
    """Random changes of the torques that keep end and limits, to first order, cost more."""
    experiment, law, way = from_rest(2.3)
    limit = LEAST_ERROR_SHARE * experiment.planned_limit
    motion, span = way.plan(None, experiment.planned_limit)
    edges = law.timeline.eta + 0.1 * np.arange(round(span / 0.1) + 1)
    torques = mean_torques(experiment.nominal, motion, edges[:-1], edges[1:])
    states = rows_along(motion, edges)[:, :12]
    nodes = edges[:-1, None] + 0.1 * GAUSS_NODES
    Q, R = law.cost.matrices(np.ones(2))
    wanted = np.array([[evaluate(experiment.reference, t)[:6] for t in pair] for pair in nodes])
    free = mean_torques(experiment.nominal, experiment.reference, edges[:-1], edges[1:])
    cost = HorizonCost(wanted, states[-1], free, np.diag(Q)[:6], R, np.zeros((12, 12)))
    holds = HoldModel(law.plant, law.plant.dynamics.parameters, 0.1)
    model = holds.linearised(states, torques)
    ends = np.zeros((12, torques.size))  # of the end state by each torque
    for j in range(torques.size):
        dx = np.zeros(12)
        for k, change in enumerate(np.eye(torques.size)[j].reshape(-1, 6)):
            dx = model.Phi[k] @ dx + model.Gamma[k] @ change
        ends[:, j] = dx
    within = np.abs(torques).ravel() < 0.999 * limit
    assert 0.2 < within.mean() < 0.9  # the limit binds
    plan_ = None, states, torques, model._replace(defects=0 * model.defects), cost
    rng, base = np.random.default_rng(2), total(plan_, np.zeros(12), 0 * torques)
    for _ in range(20):
        change = np.zeros(torques.size)
        change[within] = rng.standard_normal(within.sum())
        change[within] -= np.linalg.pinv(ends[:, within]) @ (ends @ change)
        change *= 1e-3 * limit / np.abs(change).max()
        for sign in (1, -1):
            assert total(plan_, np.zeros(12), sign * change.reshape(-1, 6)) > base - 1e-9 * base


LESS_ERROR = [
    *(("predictor_lqi", *case) for case in ((1.5, 53.0), (2.3, 46.0), (7.5, 31.0), (49.5, 23.0))),
    *(("predictor_mpc", *case) for case in ((1.5, 46.0), (2.3, 39.0), (4.0, 34.0), (7.5, 29.0))),
]


@pytest.mark.slow
@pytest.mark.parametrize(("controller", "share", "most"), LESS_ERROR)
def test_the_way_of_least_error_is_nearer_than_the_shortest(controller, share, most):
    """The shortest ones have 84, 68, 36 and 23 % s."""
    experiment, *_ = from_rest(share, controller)
    assert simulate(experiment.scenario, judge_stability=False).accumulated_error < most
