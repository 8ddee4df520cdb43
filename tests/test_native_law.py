"""The law with parts of the core against that with parts in Python, and the Riccati equation."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

import stewart_drake as sd
from stewart_drake.core.library import core
from stewart_drake.dynamics.stewart import StewartDynamics
from stewart_drake.law import core_law
from stewart_drake.law.core_law import CompiledLaw
from stewart_drake.law.coverage import backend, uncovered_part
from stewart_drake.law.delay_model import delayed_model, linear_model
from stewart_drake.law.motion import KnownMotion, Preview
from stewart_drake.law.predictive_lqi import PredictiveLqi
from stewart_drake.law.riccati import RiccatiError, lqr, lqr_by_doubling, reduced_gain
from stewart_drake.law.sensing import Measurement
from stewart_drake.loop.law_design import compose_law, control_law
from stewart_drake.loop.preparation import prepare
from stewart_drake.loop.servos import compose_servo_law
from stewart_drake.loop.tuner import weights_source
from stewart_drake.mechanism.trajectories import evaluate
from stewart_drake.scenario.loading import load_scenario
from stewart_drake.types import Array
from tests.backends import Predicted, with_own
from tests.mechanisms import PAPER, random_mechanism
from tests.test_riccati import riccati_gain

NOISE = "sensor.noise_std=[1e-4,1e-4,1e-4,1e-5,1e-5,1e-5,1e-3,1e-3,1e-3,1e-4,1e-4,1e-4]"
DIRTY = (
    NOISE,
    "plant.payload_mass=0.02",
    "plant.joint_damping=1e-4",
    "plant.torque_bias=[1e-3,-1e-3,2e-3,0,1e-3,-2e-3]",
)


# The Riccati equation.


def problem(seed):
    """Return a random machine at home, moving, with any delay and weights."""
    rng = np.random.default_rng(seed)
    mechanism = random_mechanism(rng)
    dynamics = StewartDynamics(mechanism, gravity=bool(rng.integers(2)))
    size = 0.05 * np.repeat([1.0, mechanism.crank_lengths.min()], 3)
    pose = mechanism.home + size * rng.normal(0, 1, 6)
    A, B, _ = dynamics.derivatives(
        pose, size * rng.normal(0, 5, 6), dynamics.inverse_dynamics(pose, np.zeros(6), np.zeros(6))
    )
    fraction = rng.choice([0.0, rng.uniform(0.05, 0.95)])
    model = delayed_model(
        linear_model(A, B), rng.uniform(0.01, 0.1), int(rng.integers(20)), fraction, integral=True
    )
    peak = np.abs(dynamics.inverse_dynamics(pose, np.zeros(6), 20 * size)).max()
    Q = np.diag(10 ** rng.uniform(-1, 1) / np.tile(size, 2) ** 2)
    return model, Q, np.eye(6) * 10 ** rng.uniform(-1, 1) / peak**2


def exact_gain(A, B, Q, R, P):
    """In extended precision, by value iteration from a solution that is nearly right."""
    a, b, q, r, p = (np.asarray(x, np.longdouble) for x in (A, B, Q, R, P))
    for _ in range(5000):
        after = q + a.T @ p @ (a - b @ riccati_gain(p, a, b, r))
        after = (after + after.T) / 2
        settled = np.abs(after - p).max() < 1e-17 * np.abs(p).max()
        p = after
        if settled:
            break
    return riccati_gain(p, a, b, r).astype(np.float64)


def assert_exact(seed):
    """1e-12 of the largest entry from the exact gain, and from Drake's as far as that is exact."""
    model, Q, R = problem(seed)
    given = []

    def by_drake(*matrices):
        given[:] = matrices
        return lqr(*matrices)

    expected = reduced_gain(model, Q, R, by_drake)
    found = reduced_gain(model, Q, R, lqr_by_doubling)
    K, P = lqr_by_doubling(*given)
    exact = exact_gain(*given, P)
    assert np.abs(K - exact).max() < 1e-12 * np.abs(exact).max(), seed
    drakes = np.abs(lqr(*given)[0] - exact).max() / np.abs(exact).max()
    size = np.abs(expected).max()
    assert np.abs(found - expected).max() < max(1e-12, 100 * drakes) * size, seed


@pytest.mark.parametrize("part", range(3))
def test_gains_are_exact(part):
    for seed in range(10 * part, 10 * part + 10):
        assert_exact(seed)


@pytest.mark.soak
@pytest.mark.parametrize("part", range(20))
def test_gains_of_a_thousand_machines_are_exact(part):
    for seed in range(50 * part, 50 * part + 50):
        assert_exact(seed)


@pytest.mark.parametrize("order", [6, 12, 18, 24])
def test_the_cost_of_a_run_is_what_the_solution_says(order):
    """Brute force: x'Px is what the loop costs from x on."""
    rng = np.random.default_rng(order)
    A = rng.normal(0, 1.2 / np.sqrt(order), (order, order))
    B, Q, R = rng.normal(0, 1, (order, 6)), np.eye(order), np.diag(rng.uniform(0.5, 2, 6))
    K, P = lqr_by_doubling(A, B, Q, R)
    x = first = rng.normal(0, 1, order)
    cost = 0.0
    for _ in range(2000):
        u = -K @ x
        cost += x @ Q @ x + u @ R @ u
        x = A @ x + B @ u
    assert np.linalg.norm(x) < 1e-12
    assert cost == pytest.approx(first @ P @ first, rel=1e-11)


def test_what_has_no_solution_is_a_failure():
    one, nothing = np.eye(12), np.zeros((12, 6))
    B = np.vstack([np.eye(6), np.zeros((6, 6))])
    for A, b, Q, R in (
        (2 * one, nothing, one, np.eye(6)),  # no torque reaches it
        (2 * one, B, one, np.eye(6)),  # nor half of it
        (one, B, 0 * one, np.eye(6)),  # the cost does not see it
        (one * np.nan, B, one, np.eye(6)),
        (one, B, one, np.zeros((6, 6))),
    ):
        with pytest.raises(RiccatiError, match="doubling"):
            lqr_by_doubling(A, b, Q, R)
    with pytest.raises(ValueError, match="A: got 25 states; expected at most 24"):
        lqr_by_doubling(np.eye(25), np.zeros((25, 6)), np.eye(25), np.eye(6))


# Step by step.


def spoiled(k, y):
    """Lost, frozen, impossible and outlying measurements, and a plate that was moved by hand."""
    y = y.copy()
    if k in (12, 13):
        y[3] = np.nan
    if 30 <= k < 34:
        y[:] = np.nan
    if k in (40, 41):
        y[0] += 0.3
    if k in (46, 47):
        y = STUCK
    if k == 52:
        y[5] += 1.0
    if 60 <= k < 66:
        y[3] += 0.004
    return y


STUCK = np.concatenate([PAPER.home + 1e-4, np.full(6, 1e-3)])
LATE = NOISE, "plant.payload_mass=0.4", "controller.period=0.05", "delay.steps=12"
FOLLOWS = "start=on_reference", "queue=reference"
CASES = {
    "paper": ("paper", (), None),
    "gravity": ("gravity", (NOISE,), None),
    "a fraction of a period": ("desktop", ("delay.fraction=0.3",), None),
    "no delay": ("gravity", ("delay.steps=0",), None),
    "less than a period": ("paper", ("delay.steps=0", "delay.fraction=0.5"), None),
    "without estimator": ("motion_base", ("controller.estimate=[]",), None),
    "wrench": ("gravity", (*DIRTY, "controller.estimate=[payload,wrench]"), spoiled),
    "saturation": ("paper", (*DIRTY, "actuator.torque_limit=0.03", "controller.replan=0"), None),
    "planned again": ("paper", LATE, None),
    "a plan as long as the limit asks for": (
        "paper",
        (*LATE, f"plant.torque_bias={[1e-3, -1e-3] * 3}", *FOLLOWS, "actuator.torque_limit=0.03"),
        None,
    ),
    "bad measurements": ("gravity", DIRTY, spoiled),
    "bad measurements without estimator": (
        *("gravity", (NOISE, "controller.estimate=[]"), spoiled),
    ),
    "late measurements": ("gravity", (*DIRTY, "sensor.delay=0.2"), spoiled),
    "from the reference": (
        *(
            "paper",
            ("queue=reference", "start=on_reference", "controller.open_loop_start=false"),
            None,
        ),
    ),
}
HAPPENED = {
    "saturation": ("saturated_steps",),
    "bad measurements": (
        *("measurements_missing", "measurements_frozen", "measurements_rejected"),
    ),
}


# Parts of the memory, and to what they are equal: at the first samples, without noise, the filter
# divides by next to nothing.
RECORDED = (
    (lambda m: m.error, 1e-8, 1e-11),
    (lambda m: m.integral, 1e-8, 1e-11),
    (lambda m: m.gain, 1e-6, 0.0),
    (lambda m: m.measurement, 0.0, 0.0),
    (lambda m: m.weights, 0.0, 0.0),
    (lambda m: m.belief.state, 1e-8, 1e-11),
    (lambda m: m.belief.measured, 0.0, 0.0),
    (lambda m: m.belief.parameters, 1e-5, 1e-7),
    (lambda m: m.belief.estimate.parameter_std, 1e-5, 1e-9),
    (lambda m: m.belief.delay, 0.0, 0.0),
)


class Pair:
    """Both laws in one loop with the plant: what the one with parts in Python says acts."""

    def __init__(self, name, settings):
        self.scenario = load_scenario(name, settings=("plant.kind=exact", *settings))
        experiment = prepare(self.scenario)
        self.law, self.planned, _ = control_law(experiment)
        self.goal = experiment.reference
        self.own = with_own(self.law, "observer", "feedforward", "model", "cost")
        if not self.law.finds_delay:
            self.own = replace(self.own, predictor=Predicted())
        queue = experiment.torques_in_flight(self.law.timeline.delay)
        self.one: Any = self.own.initial_memory(queue)
        self.other: Any = self.law.initial_memory(queue)
        sc = self.scenario
        self.truth = StewartDynamics(
            experiment.truth, gravity=sc.plant.gravity, parameters=sc.plant.parameters
        )
        self.states = [experiment.start]
        self.late = round(sc.sensor.delay / sc.controller.period)
        self.weights = np.array(sc.controller.weights)

    def step(self, k, noise, spoil, lose=None):
        """Return the difference of the torques; `lose` spoils the reference."""
        law, period = self.law, self.law.timeline.period
        age = min(self.late, k)
        y = self.states[-1 - age] + noise
        y = y if spoil is None else spoil(k, y)
        times = law.preview_times
        reference = np.array([evaluate(self.planned, max(0.0, k * period + t)) for t in times])
        reference = reference if lose is None else lose(k, reference)
        weights = np.full(2, np.nan) if lose is not None and k in (6, 20) else self.weights
        motion: Any = Preview(times, reference)
        if law.moves:
            motion = KnownMotion(self.planned, self.goal, k * period)
        given = Measurement.of(y, age * period), motion, weights
        self.one = self.own.step(self.one, *given)
        self.other = law.step(self.other, *given)
        gap = float(np.abs(self.one.torque - self.other.torque).max())
        self.other.in_flight[:] = self.one.in_flight
        (torques, durations), _ = law.timeline.last_period(self.one.in_flight)
        self.states.append(self.truth.predict(self.states[-1], torques, durations, 8)[-1])
        return gap


@pytest.mark.parametrize("case", CASES)
def test_step_by_step_the_torques_are_those_of_parts_in_python(case):
    """1e-9 of the peak torque; and all that is recorded."""
    name, settings, spoil = CASES[case]
    pair, rng = Pair(name, settings), np.random.default_rng(7)
    noise = np.array(pair.scenario.sensor.noise_std)
    gaps, peak = [], 0.0
    for k in range(70):
        gaps.append(pair.step(k, noise * rng.normal(0, 1, 12), spoil))
        one, other = pair.one, pair.other
        peak = max(peak, float(np.abs(one.torque).max()))
        assert one.counts == other.counts, k
        for part, relative, absolute in RECORDED:
            a, b = part(one), part(other)
            assert a.shape == b.shape
            assert np.array_equal(np.isnan(a), np.isnan(b)), k
            bound = relative * np.abs(a[np.isfinite(a)]).max(initial=0.0) + absolute
            assert np.nanmax(np.abs(a - b), initial=0.0) <= bound, k
    assert max(gaps) <= 1e-9 * peak
    if "plan" in case:
        assert pair.one.planner[1] > 0  # pieces
        assert peak < 0.03 or case == "planned again"  # the usual length takes 0.053 N m
    for count in HAPPENED.get(case, ()):
        assert getattr(pair.one.counts, count) > 0


def lost(k, reference):
    """One number, one row, all accelerations, the last rows, everything, and that several times."""
    reference, rng = reference.copy(), np.random.default_rng(k)
    if k in (4, 5, 9, 15):
        reference.flat[rng.integers(reference.size)] = (np.nan, np.inf, -np.inf)[k % 3]
    if k in (11, 33):
        reference[rng.integers(len(reference))] = np.nan
    if k == 13:
        reference[:, 12:] = np.inf
    if k == 17:
        reference[-2:] = np.nan
    if k in (0, 22, 23, 24):
        reference[:] = np.nan
    return reference


@pytest.mark.parametrize("case", ["paper", "a fraction of a period", "no delay", "gravity"])
@pytest.mark.parametrize("start", ["measured", "unmeasured"])
def test_a_reference_that_is_missing_is_continued_with_parts_in_python(case, start):
    """Torques, counts and memory are the same, with weights that are NaN, too."""
    name, settings, _ = CASES[case]
    reads = "start=on_reference", "queue=reference", "controller.replan=0"
    pair = Pair(name, (*settings, *reads))
    gaps, peak = [], 0.0
    for k in range(40):
        blind = np.full(12, np.nan) if start == "unmeasured" and k < 2 else np.zeros(12)
        gaps.append(pair.step(k, blind, None, lost))
        one, other = pair.one, pair.other
        peak = max(peak, float(np.abs(one.torque).max()))
        assert one.counts == other.counts, k
        for part in (lambda m: m.error, lambda m: m.integral, lambda m: m.torque):
            assert np.all(np.isfinite(part(one))), k
            assert np.allclose(part(one), part(other), rtol=1e-8, atol=1e-11), k
    assert max(gaps) <= 1e-9 * peak
    assert pair.one.counts.references_missing == 12


def test_what_was_sent_in_its_place_is_in_flight():
    pair = Pair("paper", ("controller.replan=0",))
    for k in range(3):
        pair.step(k, np.zeros(12), None)
    torque, c = np.arange(6.0), core()
    law, memory = pair.other.compiled.data, pair.other.data
    c.lib.stewart_note_acted(law, c.at(memory), 1, 1, c.at(torque))
    assert np.array_equal(pair.other.in_flight[-1], torque)
    assert np.array_equal(pair.other.in_flight[:-1], pair.one.in_flight[:-1])


# Which of them steps.


COVERED = (
    (),
    ("controller.estimate=[]",),
    ("controller.estimate=[payload]",),
    ("controller.feedforward=none",),
    ("controller.integral=false",),
    ("controller.delay_estimator=constant",),
    ("controller.period=0.01", "delay.steps=80"),
    ("controller.period=0.01", "sensor.delay=0.3"),
    ("link.kind=network",),
    ("sensor.kind=encoders",),
)


def law_of(*settings, controller=None):
    return compose_law(prepare(load_scenario("paper", controller, settings=settings)))


@pytest.mark.parametrize(
    ("settings", "field"),
    [
        (("controller.prediction=linear",), "controller.prediction"),
        (("controller.model=paper",), "controller.model"),
        *((settings, None) for settings in COVERED),
    ],
)
def test_what_the_law_in_c_has_not_is_named(settings, field):
    assert uncovered_part(law_of(*settings)) == field


def test_a_part_of_ones_own_is_named():
    class Mine(PredictiveLqi):
        pass

    law = law_of()
    mine = replace(law, planner=type("Planner", (), {})())
    assert uncovered_part(mine) == "controller.replan"
    assert uncovered_part(Mine(**law.parts)) == "law"
    assert backend(law) == "native"
    assert backend(mine) == "native, controller.replan in Python"


def test_an_error_of_a_part_is_raised():
    class Broken(type(law_of().feedforward)):
        def held(self, *_):
            raise KeyError("by the test")

    law = replace(law_of(), feedforward=Broken())
    memory, home = law.initial_memory(np.zeros((8, 6))), np.append(PAPER.home, np.zeros(12))
    preview = Preview(law.preview_times, np.tile(home, (len(law.preview_times), 1)))
    with pytest.raises(KeyError, match="by the test"):
        law.step(memory, Measurement.of(home[:12]), preview, np.ones(2))


SPARE, UNTOUCHED = 5000, 12345.678


class Painted:
    """numpy for `law.core_law`: new arrays are painted, and kept."""

    def __init__(self):
        self.kept: list[Array] = []

    def __getattr__(self, name):
        return getattr(np, name)

    def empty(self, shape):
        """Return an array that shows what was written."""
        self.kept.append(np.full(shape, UNTOUCHED))
        return self.kept[-1]


@pytest.mark.parametrize(
    "settings",
    [
        (),
        ("controller.estimate=[]", "controller.integral=false", "delay.steps=0"),
        ("delay.fraction=0.4", "sensor.delay=0.2", "sensor.loss=0.2"),
        ("sensor.kind=encoders", "sensor.samples=20", "sensor.bits=14"),
        ("link.kind=network", "link.loss=0.1"),
        (
            *("controller.delay_estimator=drifting", "controller.estimate=[payload]"),
            *("delay.steps=1", "controller.delay_max=0.3", "controller.delay_std=0.05"),
        ),
    ],
)
def test_a_step_takes_no_more_scratch_than_stated(settings, monkeypatch):
    """Nothing behind the stated number of numbers is written; most of them are."""
    stated = CompiledLaw(law_of(*settings)).scratch
    monkeypatch.setattr(CompiledLaw, "scratch", stated + SPARE)
    painted = Painted()
    monkeypatch.setattr(core_law, "np", painted)
    sd.simulate(load_scenario("paper", settings=("duration=2", *settings)), judge_stability=False)
    used = [array for array in painted.kept if array.shape == (stated + SPARE,)]
    assert used and all((array[stated:] == UNTOUCHED).all() for array in used)
    assert max(np.count_nonzero(array != UNTOUCHED) for array in used) > stated / 5


@pytest.mark.parametrize(
    ("name", "controller", "settings", "most"),
    [
        ("reachy_mini", "servo_feedforward", (), 24_000),
        ("paper", "servo_preview", ("actuator.kind=servo", "controller.estimate=[]"), 6_000),
    ],
)
def test_servos_take_no_more_scratch_than_stated_after_lost_measurements(
    name, controller, settings, most, monkeypatch
):
    """The observer goes over ten periods of 20 torques, and keeps their whole transition only.

    Without estimates it does so for the first measurement with a fault after the lost ones.
    """
    experiment = prepare(load_scenario(name, controller, settings=settings))
    law, painted = compose_servo_law(experiment), Painted()
    stated, motion = CompiledLaw(law).scratch, Preview(law.preview_times, np.zeros((1, 18)))
    monkeypatch.setattr(CompiledLaw, "scratch", stated + SPARE)
    monkeypatch.setattr(core_law, "np", painted)
    report, nothing = np.zeros(law.reports.size), np.full(law.reports.size, np.nan)
    memory, lost = law.initial_memory(np.zeros(18)), np.full(12, np.nan)
    for k in range(2 + law.reports.periods):
        missing = 1 < k < 1 + law.reports.periods
        y = lost if missing else experiment.start + (k > 1 and bool(settings))
        given = Measurement.of(y)
        memory = law.step(memory, given, motion, nothing if missing and settings else report)
    assert memory.counts.measurements_missing == law.reports.periods - 1
    assert memory.counts.measurements_rejected == bool(settings)
    used = [array for array in painted.kept if array.shape == (stated + SPARE,)]
    assert all((array[stated:] == UNTOUCHED).all() for array in used)
    written = max(np.count_nonzero(array != UNTOUCHED) for array in used)
    assert stated / 2 < written and stated < most


def test_a_missing_preview_over_a_network_leaves_the_torques_as_they_are():
    """Its instants repeat but for rounding, so that rows between two of them are no motion."""
    network = "link.kind=network", "link.low=0.5", "link.high=0.9"
    pair = Pair("paper", (*network, "start=on_reference", "queue=reference"))
    peak = {}
    for k in range(52):
        pair.step(k, 0.0, None, lambda k, rows: rows * np.nan if k == 40 else rows)
        for name, one in (("python", pair.one), ("core", pair.other)):
            size = float(np.abs(one.torque).max())
            peak[name, k < 40] = max(peak.get((name, k < 40), 0.0), size)
    for name in ("python", "core"):
        assert peak[name, False] < 2 * peak[name, True]


@pytest.mark.parametrize("value", [0.0, np.nan, np.inf, 1e300])
@pytest.mark.parametrize("settings", [(), ("tuner.kind=rule",), ("actuator.kind=servo",)])
def test_memory_that_was_never_started_gives_zeros(settings, value):
    controller = "servo_preview" if "actuator.kind=servo" in settings else None
    experiment, c = prepare(load_scenario("paper", controller, settings)), core()
    servos = controller is not None
    law = (compose_servo_law if servos else compose_law)(experiment)
    compiled = CompiledLaw(law)
    y, rows = experiment.start.copy(), np.zeros((len(law.preview_times), 18))
    sample = c.ffi.new("stewart_sample *", {"measurement": c.at(y), "context": c.at(rows)})
    sample.reference, sample.weights = c.lib.stewart_given_rows, [1.0, 1.0]
    memory, scratch = np.full(compiled.torques_law.memory, value), np.zeros(100_000)
    before, output = memory.copy(), np.full(18 if servos else 6, np.nan)
    given = c.at(memory), c.at(scratch), sample
    if servos:
        report = np.zeros(law.reports.size)
        status = c.lib.stewart_servo_step(compiled.data, *given, c.at(report), c.at(output))
    elif settings:
        tuner = weights_source(experiment, law).compiled.pointer
        own = np.full(c.lib.stewart_tuner_memory(tuner), np.nan)
        c.lib.stewart_tuner_start(tuner, c.at(own))
        status = c.lib.stewart_tuned_step(
            *(compiled.data, tuner, c.at(memory), c.at(own), c.at(scratch), sample),
            *(c.at(rows[0]), c.at(output)),
        )
    else:
        status = c.lib.stewart_step(compiled.data, *given, c.at(output))
    assert status == c.lib.STEWART_NOT_STARTED and np.array_equal(output, np.zeros_like(output))
    assert np.array_equal(memory, before, equal_nan=True)


def test_a_measurement_that_is_too_old_or_repeated_is_missing():
    pair = Pair("paper", ("sensor.delay=0.2",))
    law = pair.law
    y, motion = pair.states[0], KnownMotion(pair.planned, pair.goal, 0.0)
    most, missing = law.longest_wait, 0
    old = [(most + 1, 1)] * (most + 1)
    for age, more in (*old, (most, 0), (most + 1, 1), (1, 0), (2, 1), (4, 1), (0, 0)):
        missing += more
        given = Measurement.of(y, age * law.timeline.period), motion, pair.weights
        pair.one, pair.other = pair.own.step(pair.one, *given), law.step(pair.other, *given)
        for one in (pair.one, pair.other):
            assert one.counts.measurements_missing == missing, age


def test_shapes_that_do_not_fit_are_refused():
    law = law_of()
    with pytest.raises(ValueError, match=r"queue: got shape \(2, 6\); expected \(8, 6\)"):
        law.initial_memory(np.zeros((2, 6)))
    memory = law.initial_memory(np.zeros((8, 6)))
    preview = np.tile(np.concatenate([PAPER.home, np.zeros(12)]), (len(law.preview_times), 1))
    motion = Preview(law.preview_times, preview)
    y, weights = np.concatenate([PAPER.home, np.zeros(6)]), np.ones(2)
    for arguments, field in (
        ((Measurement.of(y[:6]), motion, weights), "measurement"),
        ((Measurement.of(y), lambda times: preview[:, :6], weights), "preview"),
        ((Measurement.of(y), motion, np.ones(3)), "weights"),
        ((Measurement.of(y, 0.1), motion, weights), "measurement: got an age of 0.1 s"),
    ):
        with pytest.raises(ValueError, match=field):
            law.step(memory, *arguments)
    after = law.step(memory, Measurement.of(y), motion, weights)
    assert not np.array_equal(after.data, memory.data)  # which stays as it was
    assert np.isnan(memory.weights).all()
