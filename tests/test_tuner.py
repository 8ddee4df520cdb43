"""The tuner in the loop: window and network as systems, who knows what when, what goes wrong."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

import stewart_drake as sd
from stewart_drake.loop.diagram import build_closed_loop
from stewart_drake.loop.sensor import Sensor
from stewart_drake.loop.tuner import AnnTuner, DensityWindow
from stewart_drake.tuner.network import NUM_INPUTS, save_network
from stewart_drake.tuner.source import DensityFeatures, PaperPolicy, WeightsSource, densities
from tests.test_network import small_network, torch_twin
from tests.test_systems import carry_out, ports

FIXED = np.array([1.0, 2.0])
MAX_FACTOR = 1.5
OVERFLOWING = {"b2": [800.0, 0.0]}
"""Changes of a network after which the first weight is infinite."""


# ------------------------------------------------------------------ the law


def tune(network, rho, last, fixed):
    return WeightsSource(None, DensityFeatures(), PaperPolicy(network, fixed)).decide_by(rho, last)


@given(
    rho=arrays(np.float64, NUM_INPUTS, elements=st.floats()),
    last=arrays(np.float64, 2, elements=st.floats(1e-3, 1e3)),
)
def test_weights_stay_finite_positive_and_within_the_rate(rho, last):
    weights, fell_back = tune(small_network(), rho, last, FIXED)
    if np.abs(rho[np.isfinite(rho)]).max(initial=0) < 1e300:  # else sums overflow by their order
        assert fell_back is not bool(np.all(np.isfinite(small_network()(rho))))
    assert np.all(weights > 0)
    factor = MAX_FACTOR * (1 + 1e-15)
    assert np.all((last / factor <= weights) & (weights <= last * factor))


def test_where_the_rate_allows_it_the_weights_are_the_clipped_output():
    rng, network = np.random.default_rng(0), small_network()
    clipped = 0
    for rho in rng.uniform(0, 3, (200, NUM_INPUTS)):
        low, high = network.bounds
        expected = np.maximum(low, np.minimum(high, network(rho)))
        weights, fell_back = tune(network, rho, expected * rng.uniform(0.7, 1.4, 2), FIXED)
        np.testing.assert_allclose(weights, expected, rtol=1e-13)
        assert not fell_back
        clipped += bool(np.any(expected != network(rho)))
    assert 0 < clipped < 200


@pytest.mark.parametrize("output", ["not finite in", "infinite out"])
def test_a_failing_network_leads_back_to_the_fixed_weights_at_the_same_rate(output):
    network = small_network(**(OVERFLOWING if output == "infinite out" else {}))
    rho = np.full(NUM_INPUTS, np.nan if output == "not finite in" else 1.0)
    weights = np.array([4.0, 2.0])
    for expected in ([4 / 1.5, 2.0], [4 / 1.5**2, 2.0], [4 / 1.5**3, 2.0], [1.0, 2.0], [1.0, 2.0]):
        weights, fell_back = tune(network, rho, weights, FIXED)
        assert fell_back
        np.testing.assert_allclose(weights, expected, rtol=1e-15)


# ------------------------------------------------------------------ the systems


def sample_in(system, context, sample):
    """Let the window take one sample in; the densities afterwards."""
    reference = np.arange(18.0)
    for name, value in (
        ("measurement", sample[:12] + reference[:12]),
        ("reference", reference),
        ("torque", sample[12:]),
    ):
        system.GetInputPort(name).FixValue(context, value)
    carry_out(system._update, context)
    return np.array(system.GetOutputPort("density").Eval(context))


def test_ports_and_initial_states_of_window_and_tuner():
    system = DensityWindow(0.1)
    assert ports(system) == ({"measurement": 12, "reference": 18, "torque": 6}, {"density": 18})
    assert not system.HasAnyDirectFeedthrough()
    context = system.CreateDefaultContext()
    assert np.all(np.isnan(system.window(context)))
    unknown = system.GetOutputPort("density").Eval(context)
    assert np.all(np.isnan(unknown))
    tuner = AnnTuner(small_network(), FIXED, 0.1)
    assert ports(tuner) == ({"density": 18}, {"weights": 2})
    context = tuner.CreateDefaultContext()
    tuner.GetInputPort("density").FixValue(context, unknown)
    np.testing.assert_array_equal(tuner.GetOutputPort("weights").Eval(context), FIXED)
    assert tuner.fallbacks(context) == 0


@pytest.mark.parametrize("kind", ["magnitude", "signed"])
def test_window_gives_the_densities_of_the_samples_so_far(kind):
    samples = np.random.default_rng(1).normal(1, 1, (70, NUM_INPUTS))
    samples[[0, 20]] = np.nan  # nothing known at all, first and later
    samples[33, :12] = np.nan
    system = DensityWindow(0.1, kind)
    context = system.CreateDefaultContext()
    expected = densities(samples, kind)
    for k, sample in enumerate(samples):
        found = sample_in(system, context, sample)
        if k == 0:
            assert np.all(np.isnan(found))
        else:
            np.testing.assert_allclose(found, expected[k], rtol=1e-9)


# ------------------------------------------------------------------ the loop


def scenario(tmp_path, network, *settings):
    """Return the paper's scenario on the exact plant, with this network or with fixed weights."""
    tuner = []
    if network is not None:
        save_network(network, tmp_path / "network.json")
        tuner = ["tuner.kind=ann", f"tuner.weights={tmp_path / 'network.json'}"]
    return sd.load_scenario("paper", settings=["plant.kind=exact", *tuner, *settings])


def sampled(result):
    """Return signals, and samples (n, 18) of errors and torques, at the controller's instants."""
    s = result.signals.isel(time=slice(None, None, 5))  # 0.1 s apart
    rate_error = s.rates.values - s.reference_rates.values
    return s, np.hstack([s.error.values, rate_error, s.torque_commanded.values])


@pytest.fixture(scope="module")
def tuned(tmp_path_factory):
    """Return the paper's whole experiment with a network."""
    return sd.simulate(
        scenario(tmp_path_factory.mktemp("tuned"), small_network()), judge_stability=False
    )


def test_the_papers_experiment_completes_with_a_network(tuned):
    assert tuned.status == "completed"
    assert tuned.accumulated_error < 25
    weights = tuned.signals.weights.values
    assert np.all((weights >= 0.1) & (weights <= 4.0))
    assert np.ptp(weights[:, 0]) > 0.5 and np.ptp(weights[:, 1]) > 0.5
    counts = tuned.summary["counts"]
    assert counts["tuner_fallbacks"] == counts["riccati_failures"] == 0
    rho = tuned.signals.density.values
    assert np.all((rho >= 0) & (rho <= 31))


def test_weights_rest_on_the_samples_before(tuned):
    """w_k = tune(rho_{k-1}, w_{k-1}), w_0 = fixed; neither earlier nor later data."""
    s, network = sampled(tuned)[0], small_network()
    weights, rho = s.weights.values, s.density.values
    np.testing.assert_array_equal(weights[0], [1.0, 1.0])

    def replay(age):
        """Had the tuner seen densities so many samples old."""
        samples = range(2, len(weights))
        return np.array(
            [tune(network, rho[k - age], weights[k - 1], np.ones(2))[0] for k in samples]
        )

    np.testing.assert_allclose(weights[2:], replay(1), rtol=1e-13)
    for wrong in (0, 2):
        assert np.abs(weights[2:] / replay(wrong) - 1).max() > 0.1


def test_the_network_in_the_loop_is_the_torch_network(tuned):
    torch = pytest.importorskip("torch")
    s, network = sampled(tuned)[0], small_network()
    weights = s.weights.values
    twin = torch_twin(torch, network)(s.density.values[:-1])
    goal = np.clip(twin, *network.bounds)
    limited = np.clip(goal, weights[:-1] / MAX_FACTOR, weights[:-1] * MAX_FACTOR)
    np.testing.assert_allclose(weights[1:], limited, rtol=1e-12, atol=0)
    free = np.abs(limited / twin - 1) < 1e-15  # neither bounded nor rate-limited
    assert free.mean() > 0.3


@pytest.mark.parametrize("kind", ["magnitude", "signed"])
def test_recorded_densities_are_those_of_the_recorded_signals(tmp_path, kind):
    """The multibody plant has the same state just before and after an instant."""
    settings = ("plant.kind=multibody", "duration=4.0", "controller.replan=0")
    result = sd.simulate(
        scenario(tmp_path, small_network(density=kind), *settings), judge_stability=False
    )
    s, samples = sampled(result)
    expected = densities(samples, kind)
    # The reference is read 5e-15 t apart. Signed sums can cancel: a density as large as x / sum
    # multiplies what rounding leaves in the sum by itself.
    size = np.abs(expected)
    assert np.all(np.abs(s.density.values - expected) <= 1e-11 + 1e-12 * size * np.maximum(size, 1))
    assert list(s.tuner_input.values[[0, 6, 12]]) == ["error_phi", "rate_error_phi", "torque_1"]


def test_fixed_weights_stay_and_a_network_takes_their_place(tmp_path):
    fixed = scenario(tmp_path, None, "duration=1.0", "controller.w_R=3")
    result = sd.simulate(fixed, judge_stability=False)
    np.testing.assert_array_equal(result.signals.weights.values, np.tile([1.0, 3.0], (51, 1)))
    assert result.summary["counts"]["tuner_fallbacks"] == 0
    loops = [build_closed_loop(sc) for sc in (fixed, scenario(tmp_path, small_network()))]
    without, parts = ({system.get_name() for system in loop.GetSystems()} for loop in loops)
    assert without ^ parts == {"weights", "tuner"}
    with_network = loops[1]
    tuner = with_network.GetSubsystemByName("tuner")
    sources = {
        target.get_name(): source.get_name()
        for (target, _), (source, _) in with_network.connection_map().items()
        if "tuner" in (target.get_name(), source.get_name())
    }
    assert sources == {"controller": "tuner", "tuner": "density"}
    assert not with_network.HasAnyDirectFeedthrough()
    assert tuner.HasAnyDirectFeedthrough()


def test_a_network_that_fails_is_a_controller_with_fixed_weights(tmp_path):
    settings = ("duration=2.0", "controller.w_R=1000")  # outside the network's bounds
    failing = sd.simulate(
        scenario(tmp_path, small_network(**OVERFLOWING), *settings), judge_stability=False
    )
    fixed = sd.simulate(scenario(tmp_path, None, *settings), judge_stability=False)
    # But for the scenario among the attributes.
    assert failing.signals.drop_attrs(deep=False).identical(fixed.signals.drop_attrs(deep=False))
    assert failing.summary["counts"]["tuner_fallbacks"] == 20  # all samples but the first
    assert failing.accumulated_error == fixed.accumulated_error


def test_missed_measurements_do_not_reach_the_weights(tmp_path, monkeypatch):
    missed, measure = (0, 7, 8), Sensor._measure

    def lose(self, context, output):
        measure(self, context, output)
        if round(context.get_time() / 0.1) in missed:
            output.SetFromVector(np.full(12, np.nan))

    monkeypatch.setattr(Sensor, "_measure", lose)
    result = sd.simulate(scenario(tmp_path, small_network(), "duration=4.5"), judge_stability=False)
    assert result.status == "completed"
    counts = result.summary["counts"]
    assert counts["bad_measurements"] == 3 and counts["tuner_fallbacks"] == 0
    s, samples = sampled(result)
    assert np.all(np.isfinite(s.weights.values)) and np.all(np.isfinite(s.density.values))
    np.testing.assert_array_equal(s.density.values[list(missed), :12], 1.0)
    samples[list(missed), :12] = np.nan
    np.testing.assert_allclose(s.density.values, densities(samples), rtol=1e-6)
