"""An unknown delay: which torque acts when, the filter, the search, the loop."""

import dataclasses
from dataclasses import replace
from itertools import pairwise
from typing import NamedTuple

import numpy as np
import pytest
from scipy.optimize import least_squares
from scipy.stats import norm, truncnorm

import stewart_drake as sd
from stewart_drake.core.library import core
from stewart_drake.dynamics.stewart import StewartDynamics
from stewart_drake.files.errors import ConfigError
from stewart_drake.law.compiled import machine_of
from stewart_drake.law.filter_settings import filter_settings, usual_parameters
from stewart_drake.law.nominal import NominalPlant, TorqueLimit
from stewart_drake.law.observers import CoreObserver, DelaySettings
from stewart_drake.law.sensing import Measurement, StateSensing, state_sensor
from stewart_drake.law.timeline import Arrivals, Timeline
from stewart_drake.loop.bulk import run_in_bulk
from stewart_drake.loop.controller_margin import controller_margin
from stewart_drake.loop.preparation import prepare
from stewart_drake.loop.simulation import simulate
from stewart_drake.scenario.loading import load_scenario
from stewart_drake.scenario.timing import Delay
from stewart_drake.studies.compare import ADAPTIVE, CONTROLLERS, shown
from stewart_drake.studies.verdict import loop_verdict
from tests.mechanisms import PAPER

DT = 0.1
AMPLITUDES = np.array([0.2617993878] * 3 + [0.02, 0.02, 0.08])
DYNAMICS = StewartDynamics(PAPER, gravity=False)
PLANT = NominalPlant(DYNAMICS, 2, 1.0, TorqueLimit())
SETTINGS = filter_settings(2e-4 * np.tile(AMPLITUDES, 2), DT, usual_parameters(4.0, 0.06, None))
NOISE = 1e-4 * np.tile(AMPLITUDES, 2)
SENSING = StateSensing(NOISE, AMPLITUDES)
DELAY = DelaySettings.of("constant", 0.45, 0.3, 1.5, open_loop_start=False)
HOME = np.concatenate([PAPER.home, np.zeros(6)])
OBSERVER = CoreObserver(SETTINGS, DELAY)
THETA = np.concatenate([1e-3 * np.array([1, -1, 2, 0, -2, 1.0]), [0.5, 0.002]])


# What acts when.


def acting_at(arrivals, torques, t, newest):
    """Return the own torque that arrived last, else the torque of `before`, by definition."""
    arrived = [
        i
        for i in range(newest - arrivals.num_own + 1, newest + 1)
        if (i * DT + arrivals.arrival) * (1 + arrivals.rate) <= t
    ]
    if arrived:
        return float(torques[len(torques) - 1 + max(arrived) - newest, 0])
    return float(arrivals.other_torques[min(int(t / DT), len(arrivals.other_torques) - 1), 0])


@pytest.mark.parametrize("newest", [-1, 0])
@pytest.mark.parametrize("sent", [0, 1, 4, 9])
@pytest.mark.parametrize("rate", [0.0, 0.05, -0.05])
@pytest.mark.parametrize("eta", [0.0, 0.03, 0.1, 0.37, 0.8, 1e6])
def test_what_acts_is_what_arrived_last(eta, rate, sent, newest):
    torques = np.arange(1.0, 10)[:, None] * np.ones(6)
    before = -np.arange(1.0, 8)[:, None] * np.ones(6)
    arrivals = Arrivals(DT, Delay(0), eta, rate, sent, before)
    end = min(arrivals.eta, 0.7)
    schedule = arrivals.within(torques, 0.0, end, newest)
    assert schedule.durations.sum() == pytest.approx(end) and np.all(schedule.durations >= 0)
    t = 0.0
    for torque, duration in zip(schedule.torques, schedule.durations, strict=True):
        for share in (0.01, 0.5, 0.99) if duration > 1e-6 else ():
            assert torque[0] == acting_at(arrivals, torques, t + share * duration, newest)
        t += duration


@pytest.mark.parametrize(("steps", "fraction"), [(3, 0.0), (3, 0.4), (0, 0.5)])
def test_whole_and_real_delays_agree(steps, fraction):
    rng = np.random.default_rng(0)
    torques, whole = rng.normal(0, 0.02, (9, 6)), Timeline(DT, Delay(steps, fraction))
    real = Arrivals(DT, Delay(0), whole.eta, 0.0, 9, np.zeros((1, 6)))
    for t in (whole, real):
        schedule = t.until_next(t.queue(torques))
        # The exact dynamics tell whether both let the same act for as long.
        end = PLANT.predict(HOME, schedule)[-1]
        assert end == pytest.approx(PLANT.predict(HOME, real.until_next(torques))[-1], abs=1e-12)
    assert real.holds(-1, 1) == pytest.approx(whole.holds(-1, 1))


# The filter.


def swing(k):
    """Torques that move the plate in all coordinates."""
    return 0.02 * np.sin(0.9 * k + np.arange(6)) + 0.01 * np.cos(0.5 * k * np.arange(1, 7))


class Period:
    """One period of the filter in C.

    Args:
        torques: (n, 6) in flight, all the controller's.
        sent: how many of them; None is all.
        plant: as it is known.
    """

    def __init__(self, torques, sent=None, plant=PLANT):
        c = core()
        self.torques, self.before, self.n = torques, np.zeros((1, 6)), 22
        self.law = OBSERVER.law(Timeline(DT, Delay(0)), SENSING, plant)
        settings = c.ffi.cast("stewart_delay_settings *", self.law.pointer.estimation)
        sensing = c.lib.stewart_state_sensing(state_sensor(SENSING).pointer)
        self.delay = c.ffi.new("stewart_delay *", settings.delay)
        self.machine, self.sensing = machine_of(plant), c.ffi.new("stewart_sensing *", sensing)
        self.delay.filter.machine = self.machine.pointer
        self.delay.filter.sensing = self.sensing
        view = (DT, 0.0, 0.0, len(torques) if sent is None else sent, 1, c.at(self.before))
        numbers = (self.delay, view, len(torques), 0, c.at(torques))
        self.pointer = c.ffi.new("stewart_period *", numbers)

    def scratch(self):
        lib = core().lib
        return core().scratch(lib.stewart_delay_advance_scratch(8, 12, len(self.torques)))

    def end(self, xi):
        state = np.empty(12)
        given = (self.pointer, core().at(xi), core().at(state), self.scratch())
        assert core().lib.stewart_period_end(*given)
        return state

    def derivatives(self, xi):
        """(12, 22) of the state at the end."""
        state, H = np.empty(12), np.empty((12, self.n))
        given = (self.pointer, core().at(xi), 1, core().at(state), core().at(H), self.scratch())
        assert core().lib.stewart_period_at(*given)
        assert state == pytest.approx(self.end(xi), abs=1e-14)
        return H

    def late(self, xi, state, std):
        """Rows (k, 12) of the controller's own torques, which are all here."""
        K, others = np.empty((8, 12)), core().ffi.new("int *")
        given = (core().at(xi), core().at(state), std, core().at(K), others, self.scratch())
        rows = core().lib.stewart_period_late(self.pointer, *given)
        assert rows > 0 and others[0] == 0
        return K[:rows]


@pytest.mark.parametrize("eta", [0.137, 0.25, 0.449])
def test_sensitivity_to_the_delay_equals_a_finer_difference(eta):
    """Richardson's extrapolation of the response, with 64 steps per torque."""
    fine = NominalPlant(DYNAMICS, 64, 1.0, TorqueLimit())
    torques = np.array([swing(k) for k in range(12)])
    xi = np.concatenate([HOME, THETA, [eta, 0.0]])
    xi[6:12] = 0.3 * AMPLITUDES

    def end(at):
        moved = xi.copy()
        moved[-2] = at
        return Period(torques, plant=fine).end(moved)

    def slope(h):
        return (end(eta + h) - end(eta - h)) / (2 * h)

    expected = (4 * slope(5e-4) - slope(1e-3)) / 3
    found = Period(torques).derivatives(xi)[:, -2]
    assert np.abs(found - expected).max() < 1e-3 * np.abs(expected).max()


def record(eta, samples, seed, rate=0.0, jitter=0.0):
    """Return torques, states and measurements at the samples, by a separate fine integration."""
    torques = np.array([swing(k) for k in range(samples)])
    step, states, x = 5e-3, [HOME], HOME
    arrive = DT * np.arange(samples) + eta + rate * DT * np.arange(samples)
    arrive = arrive + jitter * np.random.default_rng([seed, 1]).normal(0, 1, samples)
    for k in range(samples - 1):
        edges = [k * DT, *arrive[(arrive > k * DT) & (arrive < (k + 1) * DT)], (k + 1) * DT]
        for begin, end in pairwise(edges):
            place = np.searchsorted(arrive, (begin + end) / 2) - 1
            torque = torques[place] if place >= 0 else np.zeros(6)
            if end - begin > 1e-12:
                n = int(np.ceil((end - begin) / step))
                x = DYNAMICS.predict(x, torque, end - begin, n, THETA)[-1]
        states.append(x)
    truth = np.array(states)
    noise = np.random.default_rng(seed).normal(0, 1, truth.shape) * NOISE
    return torques, truth, truth + noise


class Guess(NamedTuple):
    """A hypothesis of the delay: eta in s, and more as of `stewart_hypothesis`."""

    eta: float
    std: float
    low: float
    high: float
    fits: bool
    outliers: int
    timing: float
    weight: float


def guesses_of(belief):
    """Hypotheses: that nothing has arrived, then the cells; or the only one."""
    c, n, found = core(), 22, []
    memory = c.ffi.cast("stewart_delay_memory *", c.at(belief.memory[12:]))
    flights = OBSERVER.extra_torques(DT) + 1
    for place in range(1 + int(memory.cells)):
        g, root = c.lib.stewart_delay_hypothesis(8, 12, flights, memory, place), np.zeros((n, n))
        c.lib.stewart_unpack_root(n, g.numbers + n, c.at(root))
        said = g.low, g.high, bool(g.fits), int(g.outliers), g.timing, g.weight
        found.append(Guess(g.numbers[n - 2], float(np.linalg.norm(root[-2])), *said))
    return found


def observed(torques, measured, believed, **changes):
    """Return the beliefs at all samples."""
    observer = CoreObserver(SETTINGS, replace(DELAY, mean=believed, **changes))
    belief = observer.start(Timeline(DT, Delay(0)), SENSING, PLANT)
    in_flight = np.zeros((observer.extra_torques(DT) + 1, 6))
    found = []
    for torque, values in zip(torques, measured, strict=True):
        belief = observer.observe(belief, Measurement.of(values), in_flight, SENSING, PLANT)
        in_flight = np.vstack([in_flight[1:], torque])
        found.append(belief)
    return found


@pytest.mark.parametrize("eta", [0.2, 0.237])
def test_a_torque_that_is_early_or_late_does_what_the_filter_says(eta):
    """Second moment over normal errors; next to a sample each period has half of them."""
    torques, std = np.array([swing(k) for k in range(12)]), 2e-3
    model, xi = Period(torques), np.concatenate([HOME, THETA, [eta, 0.0]])
    on_time = model.end(xi)
    errors = std * norm.ppf((np.arange(200) + 0.5) / 200)
    late = [model.end(np.concatenate([HOME, THETA, [eta + error, 0.0]])) for error in errors]
    expected = np.array(late) - on_time
    expected = expected.T @ expected / len(errors) / std**2
    rows = model.late(xi, on_time, std) / std
    found = rows.T @ rows
    # To first order: the acceleration is that of the pose and the rates at the end.
    assert np.abs(found - expected).max() < 0.12 * expected.max()
    for part in (slice(0, 3), slice(3, 6), slice(6, 9), slice(9, 12)):
        own, true = (np.trace(matrix[part, part]) for matrix in (found, expected))
        assert own == pytest.approx(true, rel=0.2)


@pytest.mark.slow
@pytest.mark.parametrize(("jitter", "least", "most"), [(0.0, 0.0, 3e-4), (3e-3, 1.5e-3, 4.5e-3)])
def test_how_early_or_late_single_torques_come_is_found(jitter, least, most):
    for seed in range(5):
        torques, _, measured = record(0.337, 30, seed, jitter=jitter)
        [guess] = guesses_of(observed(torques, measured, 0.3)[-1])
        assert least <= np.sqrt(guess.timing) <= most
        # Of 26 torques the mean delay cannot be known better than this.
        assert guess.std >= 0.5 * jitter / np.sqrt(26)


def test_the_first_torques_that_jitter_are_believed():
    """Ten torques, each some 3 ms off: hardly an outlier, and the stated deviation is right.

    Taken to be on time, two or three of them were outliers, and the deviation was eight times too
    small.
    """
    odd, ratios = 0, []
    for seed in range(8):
        torques, _, measured = record(0.337, 14, seed, jitter=3e-3)
        guesses = [guesses_of(belief)[0] for belief in observed(torques, measured, 0.3)]
        odd += sum(guess.outliers > 0 or not guess.fits for guess in guesses)
        last = guesses[-1]
        ratios.append((last.eta - 0.337) / last.std)
    assert odd <= 8 and np.sqrt(np.mean(np.square(ratios))) < 3


def test_the_filter_finds_what_batch_least_squares_finds():
    """One nonlinear least-squares problem over all measurements, its own simulation and weights."""
    eta, samples = 0.337, 14
    torques, _, measured = record(eta, samples, seed=1)
    prior = SETTINGS.parameters

    def simulated(first, theta, delay):
        x, states = first, [first]
        for k in range(samples - 1):
            split = np.clip(delay % DT, 0, DT)
            j = k - int(delay // DT)
            pair = [torques[i] if i >= 0 else np.zeros(6) for i in (j - 1, j)]
            x = DYNAMICS.predict(x, np.array(pair), np.array([split, DT - split]), 2, theta)[-1]
            states.append(x)
        return np.array(states)

    def residuals(unknown):
        first, theta = unknown[:12] * NOISE + measured[0], unknown[12:20] * prior.std
        misses = (simulated(first, theta, unknown[20]) - measured) / NOISE
        return np.concatenate([misses.ravel(), unknown[12:20]])

    guess = np.concatenate([np.zeros(20), [0.33]])
    batch = least_squares(residuals, guess, x_scale=np.append(np.ones(20), 1e-2))
    jacobian = np.asarray(batch.jac)
    std = float(np.sqrt(np.linalg.inv(jacobian.T @ jacobian)[20, 20]))
    last = observed(torques, measured, believed=0.5)[-1]
    assert last.settled
    assert abs(batch.x[20] - eta) < 4 * std  # the oracle is one
    # The filter also allows for errors of the model, and is wider for them.
    assert std < last.delay_std < 0.01
    assert abs(last.delay_mean - batch.x[20]) < 2 * last.delay_std


@pytest.mark.parametrize("size", [3e-4, 5e-4])
def test_the_search_weighs_as_a_grid_of_filters_does(size):
    """Cells against the posterior of filters that each know the delay, on a grid of 10 ms.

    The torques are so small that what they do is hardly seen yet.
    """
    samples, believed, std = 7, 0.45, 0.1
    torques = size * np.array([swing(k) for k in range(samples)])
    measured = small_record(torques, 0.43, samples)
    belief = observed(torques, measured, believed, std=std)[-1]
    assert not belief.settled
    master, *cells = guesses_of(belief)
    weights = np.exp([master.weight, *(cell.weight for cell in cells)])
    weights = weights / weights.sum()
    grid = np.arange(0.005, 1.5, 0.01)
    log = np.array([known_delay_likelihood(torques, measured, eta) for eta in grid])
    posterior = norm(believed, std).pdf(grid) * np.exp(log - log.max())
    posterior /= posterior.sum()
    assert weights[0] == pytest.approx(posterior[grid > (samples - 1) * DT].sum(), abs=0.06)
    for weight, cell in zip(weights[1:], cells, strict=True):
        inside = (grid > cell.low) & (grid < cell.high)
        assert weight == pytest.approx(posterior[inside].sum(), abs=0.06)


def small_record(torques, eta, samples):
    """Measurements of a plate without payload under such torques."""
    x, states = HOME, [HOME]
    view = Arrivals(DT, Delay(0), eta, 0.0, 0, np.zeros((1, 6)))
    for k in range(samples - 1):
        sent = replace(view, num_own=k + 1)
        x = DYNAMICS.predict(x, *sent.within(torques[: k + 1], 0.0, DT, newest=0), 8)[-1]
        states.append(x)
    noise = np.random.default_rng(5).normal(0, 1, (samples, 12)) * NOISE
    return np.array(states) + noise


def known_delay_likelihood(torques, measured, eta):
    """Return the log-likelihood of the measurements by a filter that knows the delay."""
    c, prior = core(), SETTINGS.parameters
    size = c.lib.stewart_hypothesis_size(8)
    guess, after = np.zeros(size), np.zeros(size)
    before, later = (c.ffi.cast("stewart_hypothesis *", c.at(array)) for array in (guess, after))
    before.high, before.fits, before.torques = 1.5, 1, 1
    before.numbers = list(np.concatenate([measured[0], prior.prior, [eta, 0.0]]))
    root = np.diag(np.concatenate([NOISE, prior.std, [0.0, 0.0]]))
    c.lib.stewart_hypothesis_set_root(22, c.at(root), before)
    total = 0.0
    for k in range(1, len(measured)):
        period, y = Period(torques[:k].copy()), measured[k].copy()
        c.lib.stewart_delay_advance(period.pointer, before, c.at(y), later, period.scratch())
        guess[:] = after
        total += later.log_likelihood
    return total


@pytest.mark.parametrize("eta", [0.05, 0.337, 0.8, 1.21])
def test_the_delay_is_found_soon_after_the_first_arrival(eta):
    torques, truth, measured = record(eta, int(eta / DT) + 12, seed=3)
    beliefs = observed(torques, measured, believed=0.6)
    first = int(np.ceil(eta / DT))
    found = next(k for k, belief in enumerate(beliefs) if belief.settled)
    assert first <= found <= first + 3
    last = beliefs[-1]
    assert abs(last.delay_mean - eta) < 3 * last.delay_std + 1e-4 and last.delay_std < 5e-3
    assert np.all(np.abs(last.state - truth[-1]) < 6 * NOISE + 1e-4)

    prior = truncnorm(-0.6 / DELAY.std, (DELAY.longest - 0.6) / DELAY.std, 0.6, DELAY.std)
    assert beliefs[0].delay_mean == pytest.approx(prior.mean(), abs=1e-12)
    assert beliefs[0].delay_std == pytest.approx(prior.std(), abs=1e-12)


def test_a_lost_or_impossible_measurement_is_survived():
    torques, _, measured = record(0.337, 16, seed=4)
    measured[0] = np.nan  # there is nothing to begin with
    measured[9] = np.nan
    measured[12, :6] += 0.05
    beliefs = observed(torques, measured, believed=0.5)
    assert beliefs[0].faults == beliefs[9].faults == ("measurements_missing",)
    assert beliefs[12].faults == ("measurements_rejected",)
    assert beliefs[-1].settled and abs(beliefs[-1].delay_mean - 0.337) < 3e-3


def test_a_delay_near_the_longest_is_found_if_the_first_measurements_are_missing():
    torques, _, measured = record(1.43, 26, seed=3)
    measured[:18] = np.nan
    last = observed(torques, measured, believed=0.6)[-1]
    assert last.settled and abs(last.delay_mean - 1.43) < 1e-3


def test_the_stated_scratch_memory_is_enough(monkeypatch):
    """A search, a jump of the delay and outliers write nothing beyond it."""
    given, take, spare, mark = [], core().scratch, 100, -1.25

    def marked(numbers):
        scratch = take(numbers + spare)
        for i in range(numbers, numbers + spare):
            scratch[0][i] = mark
        given.append((scratch[0], numbers))
        return scratch

    torques, _, measured = record(0.337, 16, seed=4)
    torques[10:], measured[12, :6] = 2 * torques[10:], measured[12, :6] + 0.05
    monkeypatch.setattr(core(), "scratch", marked)
    observed(torques, measured, 0.3)
    for numbers, stated in given:
        assert list(numbers[stated : stated + spare]) == [mark] * spare


# The loop.


def looped(*settings, kind="constant"):
    chosen = ("plant.kind=exact", f"controller.delay_estimator={kind}", *settings)
    return simulate(sd.load_scenario("paper", settings=chosen), judge_stability=False)


ON_REFERENCE = ("start=on_reference", "queue=reference")


@pytest.mark.parametrize(
    ("settings", "bound"),
    [
        (("controller.delay_steps=6",), 25.0),
        ((*ON_REFERENCE, "controller.delay_steps=5"), 3.5),
        (ON_REFERENCE, 0.03),
    ],
)
def test_a_delay_believed_wrongly_is_found_in_the_loop(settings, bound):
    result = looped(*settings)
    assert result.status == "completed" and result.accumulated_error < bound
    assert abs(result.summary["delay"]["estimated_s"] - 0.8) < 5e-5
    assert result.summary["delay"]["true_s"] == pytest.approx(0.8)
    assert 0 < result.summary["delay"]["std_s"] < 3e-4


@pytest.mark.parametrize(
    ("settings", "found", "tolerance", "bound"),
    [
        (("controller.delay_steps=0", "delay.steps=0", "duration=4"), 0.0, 1e-3, np.inf),
        (("controller.delay_steps=0", "duration=4"), 0.8, 1e-3, np.inf),
        *(
            # Holds in flight at t = 0 began at instants unknown to the controller.
            ((*ON_REFERENCE, f"delay.fraction={part}", "duration=6"), 0.8 + 0.1 * part, 2e-4, 0.5)
            for part in (0.1, 0.37, 0.5, 0.63)
        ),
        ((*ON_REFERENCE, "delay.jump=0.1", "delay.jump_time=2", "duration=5"), 0.9, 1e-4, np.inf),
    ],
)
def test_no_delay_a_part_of_a_period_and_a_jump_are_found(settings, found, tolerance, bound):
    result = looped(*settings)
    assert result.status == "completed" and result.accumulated_error < bound
    assert result.summary["delay"]["estimated_s"] == pytest.approx(found, abs=tolerance)
    if "delay.jump=0.1" in settings:
        before = result.signals.delay_estimate.sel(time=slice(1.001, 2.799)).values
        assert np.all(np.abs(before - 0.8) < 1e-3)


@pytest.mark.parametrize("fraction", [0.0, 0.3])
@pytest.mark.parametrize("sensor", ["state", "encoders"])
def test_a_delay_of_less_than_a_period_may_be_believed_in(fraction, sensor):
    """The torques become those of the law that knows the delay, and those of the reference."""
    settings = (*ON_REFERENCE, "delay.steps=0", f"delay.fraction={fraction}", "duration=3")
    precise = (f"sensor.kind={sensor}", *["sensor.bits=null"] * (sensor == "encoders"))
    run, known = (
        looped(*settings, *precise, kind=kind).signals.sel(time=slice(2, None))
        for kind in ("constant", "none")
    )
    peak = np.abs(known.torque_commanded.values).max()
    np.testing.assert_allclose(run.torque_commanded, known.torque_commanded, atol=2e-3 * peak)
    assert np.all(np.abs(run.delay_estimate - 0.1 * fraction) < 3e-3)
    assert np.abs(run.pose - run.reference).max() < 1e-4


def test_nothing_is_fed_back_before_the_first_torque_has_acted_for_a_period():
    """The first torques from rest do not depend on the measurements; later ones do."""
    noisy = "sensor.noise_std=[" + ",".join(f"{n:g}" for n in 1e-3 * np.tile(AMPLITUDES, 2)) + "]"

    def first(*settings):
        run = looped("duration=1.5", *settings, kind="none")
        samples = run.signals.sel(time=np.arange(12) * DT, method="nearest")
        return np.asarray(samples.torque_commanded.values)

    quiet, same = first(noisy), first(noisy, "sensor.seed=1")
    assert np.array_equal(quiet[:9], same[:9]) and np.all(quiet[9] != same[9])
    loud = [
        first(noisy, seed, "controller.open_loop_start=false")
        for seed in ("sensor.seed=0", "sensor.seed=1")
    ]
    assert np.all(loud[0][0] != loud[1][0])


def test_the_comparison_shows_it_where_the_delay_is_believed_wrongly():
    assert tuple(shown("paper")) == CONTROLLERS
    rows = shown("paper", ("controller.delay_steps=6",))
    assert tuple(rows) == (*CONTROLLERS, ADAPTIVE)
    believed = [scenario.controller.delay_steps for scenario in rows.values()]
    assert believed == [0, 0, 6, 6, 6, 6]  # a controller that knows of no delay stays blind
    assert ADAPTIVE in shown("paper", ("delay.drift=0.01",))
    assert ADAPTIVE not in shown("paper", ("delay.drift=0.01", "sensor.delay=0.1"))


def test_what_does_not_fit_is_refused():
    for wrong in ("controller.estimate=[]", "controller.prediction=linear"):
        with pytest.raises(ConfigError, match=r"controller\.delay_estimator: got 'constant'"):
            looped(wrong)
    with pytest.raises(ConfigError, match=r"controller\.delay_max: got 0\.5 .* assumed delay"):
        looped("controller.delay_max=0.5")


@pytest.mark.soak
@pytest.mark.parametrize("kind", ["constant", "drifting"])
def test_the_stated_band_covers(kind):
    """95 % +- 5 % of 200 noisy records of random delays."""
    rng, ratios = np.random.default_rng(0), []
    settings = dataclasses.asdict(DelaySettings.of(kind, 0.45, 0.3, 1.5, open_loop_start=False))
    del settings["mean"]
    for seed in range(200):
        eta = rng.uniform(0.1, 0.7)
        torques, _, measured = record(eta, 30, seed)
        last = observed(torques, measured, rng.uniform(0.1, 0.7), **settings)[-1]
        assert last.settled
        ratios.append((last.delay_mean - eta) / last.delay_std)
    assert 0.9 <= np.mean(np.abs(ratios) < 1.96) <= 1.0


def test_the_loop_is_judged_with_the_delay_as_it_will_be_found():
    """Believed wrongly, a law that will find the delay is the law that knew it."""

    def judged(*settings):
        settings = ("plant.kind=exact", "start=on_reference", "queue=reference", *settings)
        return controller_margin(prepare(load_scenario("paper", settings=settings)), until=2.0)

    known, wrong = judged(), "controller.delay_steps=6"
    lost, found = judged(wrong), judged(wrong, "controller.delay_estimator=constant")
    assert known.stable and not lost.stable and found.stable
    assert found.radius == pytest.approx(known.radius, rel=1e-9)
    assert found.delay_found and not known.delay_found
    assert "estimated parameters and delay known" in loop_verdict(found)
    assert judged("delay.drift=0.01").problem == "its delay changes"


@pytest.mark.parametrize("signs", [[1, 1, 1, 1, -1, 1], [1, 1, 1, -1, -1, -1]])
def test_a_bias_that_looks_like_an_early_torque_does_not_end_the_right_hypothesis(signs):
    """E_ac 0.074 and 0.062; 4.4 for the first signs if the cell of the true delay is dropped."""
    delay = ("delay.steps=2", "delay.fraction=0.075")
    believed = ("controller.delay_steps=2", "controller.delay_fraction=0.267")
    bias = f"plant.torque_bias={[1.356e-3 * sign for sign in signs]}"
    exact = ("plant.kind=exact", f"sensor.noise_std={[0.0] * 12}")
    scenario = load_scenario("desktop", "adaptive_lqi", (*exact, *delay, *believed, bias))
    assert run_in_bulk(scenario).figures.accumulated_error < 0.2


@pytest.mark.parametrize("seed", [0, 1, 5])
def test_friction_that_looks_like_an_early_arrival_is_taken_back(seed):
    """E up to 6 s: 52, 42, 60 % s. All are lost if such a delay is kept while nothing fits it."""
    bias = f"plant.torque_bias={(3e-4 * np.random.default_rng(seed).standard_normal(6)).tolist()}"
    half = f"reference.amplitude={(AMPLITUDES / 2).tolist()}"
    delay = ("delay.steps=9", "delay.fraction=0.3")  # 0.8 s are believed
    settings = ("plant.kind=exact", "plant.coulomb_friction=2e-4", "duration=6", half, bias, *delay)
    assert run_in_bulk(load_scenario("paper", "adaptive_lqi", settings)).status == "completed"
