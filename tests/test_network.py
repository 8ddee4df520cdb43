"""The network: its output, and a file that is read strictly and comes back to the last bit."""

import dataclasses

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from stewart_drake.files.errors import ConfigError
from stewart_drake.files.resources import shipped
from stewart_drake.tuner.network import Network, load_network, save_network

ARRAYS = ("input_mean", "input_scale", "W1", "b1", "W2", "b2", "bounds")


def small_network(hidden=10, **changes):
    """Return an untrained network, always the same, with large weights."""
    rng = np.random.default_rng(7)
    fields = {
        "input_mean": rng.uniform(0.5, 1.5, 18),
        "input_scale": rng.uniform(0.5, 2.0, 18),
        "W1": rng.normal(0, 1, (hidden, 18)),
        "b1": rng.normal(0, 1, hidden),
        "W2": rng.normal(0, 0.7, (2, hidden)),
        "b2": rng.normal(0, 0.5, 2),
        "bounds": [[0.1, 0.1], [4.0, 4.0]],
        "output": "log_weights",
        "card": {"seed": 7, "errors": {"test": None}, "names": ["a", "ü"]},
    }
    return Network(**(fields | changes))


def torch_twin(torch, network):
    """Return the same network built from torch's own layers, in double precision."""
    layers = torch.nn.Sequential(
        torch.nn.Linear(18, network.hidden), torch.nn.Sigmoid(), torch.nn.Linear(network.hidden, 2)
    ).double()
    with torch.no_grad():
        parameters = (network.W1, network.b1), (network.W2, network.b2)
        for layer, (weight, bias) in zip(layers[::2], parameters, strict=True):
            layer.weight.copy_(torch.tensor(np.array(weight)))
            layer.bias.copy_(torch.tensor(np.array(bias)))

    def run(densities):
        with torch.no_grad():
            inputs = torch.tensor((densities - network.input_mean) / network.input_scale)
            outputs = layers(inputs)
            outputs = outputs if network.output == "weights" else torch.exp(outputs)
        return np.array(outputs.numpy())

    return run


# ------------------------------------------------------------------ the output


def test_a_network_small_enough_for_pencil_and_paper():
    """One neuron sees rho_1 only: sigmoid(ln 3 (rho - 2) / 0.5) is 3/4 at 2.5 and 1/2 at 2."""
    W1 = np.zeros((1, 18))
    W1[0, 0] = np.log(3)
    network = Network(
        input_mean=np.full(18, 2.0),
        input_scale=np.full(18, 0.5),
        W1=W1,
        b1=np.zeros(1),
        W2=np.array([[4.0], [-8.0]]),
        b2=np.array([1.0, 10.0]),
        bounds=np.array([[0.1, 0.1], [4.0, 4.0]]),
    )
    densities = np.ones((2, 18))
    densities[:, 0] = 2.5, 2.0
    np.testing.assert_allclose(network(densities), [[4.0, 4.0], [3.0, 6.0]], rtol=1e-15)
    np.testing.assert_allclose(network(densities[0]), [4.0, 4.0], rtol=1e-15)
    logs = dataclasses.replace(network, output="log_weights")
    np.testing.assert_allclose(logs(densities), np.exp([[4.0, 4.0], [3.0, 6.0]]), rtol=1e-15)


@pytest.mark.parametrize("output", ["weights", "log_weights"])
@pytest.mark.parametrize("hidden", [1, 10, 23])
def test_torch_gives_the_same_weights(hidden, output):
    torch = pytest.importorskip("torch")
    network = small_network(hidden, output=output)
    rho = np.random.default_rng(0).uniform(0, 31, (200, 18))
    expected = torch_twin(torch, network)(rho)
    np.testing.assert_allclose(network(rho), expected, rtol=1e-12, atol=1e-12)


def test_the_output_is_finite_for_any_density_and_not_for_a_missing_one():
    network = small_network(W1=1e4 * small_network().W1)
    assert np.all(np.isfinite(network(np.full(18, 1e6))))
    assert np.all(np.isnan(network(np.full(18, np.nan))))
    assert np.all(np.isinf(small_network(b2=[800.0, 800.0])(np.ones(18))))


def test_a_network_does_not_change_once_made():
    W1 = np.ones((10, 18))
    network = small_network(W1=W1)
    W1[:] = 2
    assert np.all(network.W1 == 1) and not network.W1.flags.writeable


# ------------------------------------------------------------------ the file


@settings(deadline=None)
@given(
    hidden=st.integers(1, 4),
    data=st.data(),
    output=st.sampled_from(["weights", "log_weights"]),
    density=st.sampled_from(["magnitude", "signed"]),
)
def test_a_file_comes_back_to_the_last_bit(hidden, data, output, density, tmp_path_factory):
    finite = st.floats(allow_nan=False, allow_infinity=False)
    W1 = data.draw(arrays(np.float64, (hidden, 18), elements=finite))
    W2 = data.draw(arrays(np.float64, (2, hidden), elements=finite))
    network = small_network(
        hidden, W1=W1, W2=W2, b1=W1[:, 0], b2=W2[:, 0], output=output, density=density
    )
    path = tmp_path_factory.mktemp("networks") / "one.json"
    save_network(network, path)
    first = path.read_bytes()
    again = load_network(path)
    for name in ARRAYS:
        np.testing.assert_array_equal(getattr(again, name), getattr(network, name), strict=True)
    assert (again.output, again.density, again.card) == (output, density, network.card)
    save_network(again, path)
    assert path.read_bytes() == first
    assert [p.name for p in path.parent.iterdir()] == ["one.json"]


def test_a_missing_file_or_name_and_a_directory_are_refused(tmp_path):
    with pytest.raises(ConfigError, match="no file"):
        load_network(tmp_path / "none.json")
    with pytest.raises(ConfigError, match="got 'no_such_network'"):
        load_network("no_such_network")
    with pytest.raises(ConfigError, match="is not a file"):
        load_network(tmp_path)


@pytest.mark.parametrize(
    "changes",
    [
        {"b1": [np.inf] + [0.0] * 9},
        {"b1": 0.0},
        {"W1": np.zeros((18, 10))},
        {"output": "log"},
        {"density": "plain"},
    ],
)
def test_a_wrong_network_cannot_be_made(changes):
    with pytest.raises(ConfigError, match=f"{next(iter(changes))}: got"):
        small_network(**changes)


@pytest.mark.parametrize("card", [{"a": np.nan}, {"a": np.float64}, {"a": {1, 2}}])
def test_a_card_that_is_no_json_leaves_the_old_file(tmp_path, card):
    path = tmp_path / "w.json"
    save_network(small_network(), path)
    before = path.read_bytes()
    with pytest.raises(ConfigError, match="card: "):
        save_network(small_network(card=card), path)
    assert path.read_bytes() == before


def test_shipped_networks_load():
    for name in shipped("weights"):
        network = load_network(name)
        assert network.card, f"{name} does not say where it comes from"
        weights = network(np.ones(18))
        assert np.all(np.isfinite(weights)) and np.all(weights > 0)
