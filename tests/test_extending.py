"""The examples of docs/extending.md: each runs as it stands there, and its part is what acts."""

import functools
import re

import numpy as np
import pytest

import stewart_drake as sd
from tests import test_docs

GUIDE = test_docs.ROOT / "docs" / "extending.md"
EXAMPLES = dict(
    re.findall(r"^## (.*?)$.*?^```python\n(.*?)^```", GUIDE.read_text("utf-8"), re.DOTALL | re.M)
)


@functools.cache
def example(title):
    """Return the names that are there when its last line has run."""
    names = {"__name__": "__main__"}
    exec(compile(EXAMPLES[title], f"{GUIDE}: {title}", "exec", dont_inherit=True), names)
    return names


def peak_error(result):
    """m or rad."""
    return float(np.abs(result.signals.error.values).max())


def plain(*settings):
    return sd.simulate(sd.load_scenario("paper", settings=("plant.kind=exact", *settings)))


def test_there_is_one_for_every_kind_of_part():
    assert list(EXAMPLES) == [
        "A sensing",
        "An observer",
        "A controller",
        "A tuner",
        "A link",
    ]


def test_a_camera_that_is_off_is_as_good_as_one_that_is_not():
    names = example("A sensing")
    result = names["result"]
    assert result.summary["own"] == {"sensor": "Camera", "law": "with_camera"}
    bare = plain("start=on_reference", "queue=reference", "duration=2")
    assert peak_error(result) == pytest.approx(peak_error(bare), rel=1e-3)
    assert result.summary["counts"]["measurements_rejected"] == 0
    misled = sd.simulate(bare.scenario, sensor=names["Camera"])
    assert misled.summary["counts"]["measurements_rejected"] == 21, "1.2 m too high is out of reach"


def test_the_blend_is_less_noisy_than_the_measurement():
    names = example("An observer")
    signals = names["result"].signals
    assert names["result"].status == "completed"
    samples = signals.isel(time=np.flatnonzero(np.diff(signals.measurement.values[:, 0])) + 1)
    truth = np.concatenate([samples.pose.values, samples.rates.values], axis=1)[4:]
    off = samples.state_estimate.values[4:] - truth, samples.measurement.values[4:] - truth
    assert np.std(off[0][:, :3]) < 0.8 * np.std(off[1][:, :3])


def test_the_predictor_holds_the_plate_against_gravity_and_a_delay():
    names = example("A controller")
    result = names["result"]
    assert result.status == "completed" and peak_error(result) < 2e-3
    assert result.summary["own"] == {"controller": "Predictor"}
    predict = "        x = dynamics.predict(x, sent, PERIOD)[-1]\n"
    source = EXAMPLES["A controller"]
    assert source.count(predict) == 1
    blind = {"__name__": "__main__"}
    exec(compile(source.replace(predict, ""), f"{GUIDE}: blind", "exec"), blind)
    assert blind["result"].status == "left_workspace"


def test_the_tuners_weights_are_those_that_act():
    result = example("A tuner")["result"]
    weights = result.signals.weights.values
    assert result.status == "completed" and result.summary["own"] == {"tuner": "Cautious"}
    assert np.nanmin(weights[:, 0]) < 0.5 and np.nanmax(weights[:, 0]) > 0.9
    assert np.all(weights[np.isfinite(weights[:, 1]), 1] == 1)


def test_the_lossy_link_holds_what_it_had():
    result = example("A link")["result"]
    assert result.status == "completed" and result.summary["own"] == {"link": "Lossy"}
    assert any("not judged: its link" in text for text in result.summary["warnings"])
    applied = result.signals.torque_applied
    for k in range(30):
        now = applied.sel(time=0.1 * k + 0.04, method="nearest").values
        sent = result.signals.torque_commanded.sel(time=0.1 * (k - 1) + 0.04, method="nearest")
        before = applied.sel(time=0.1 * (k - 1) + 0.04, method="nearest").values
        expected = np.zeros(6) if k == 0 else before if k % 10 == 9 else sent.values
        np.testing.assert_allclose(now, expected, atol=1e-12)
