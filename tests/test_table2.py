"""The paper's Table II under the conditions in which it comes out, and rows of `compare`."""

import numpy as np
import pytest

import stewart_drake as sd
from stewart_drake.loop.experiment import compose_law, prepare
from stewart_drake.scenario.loading import load_comparison
from stewart_drake.studies.compare import CONTROLLERS


@pytest.fixture(scope="module")
def rows() -> dict[str, sd.Scenario]:
    return load_comparison("table2", CONTROLLERS)


def test_rows_are_the_controllers_and_what_the_scenario_adds(rows: dict[str, sd.Scenario]) -> None:
    assert list(rows) == [*CONTROLLERS, "delay_lqi_sum", "delay_lqi_200"]
    for name in ("lqr", "lqi", "delay_lqr", "delay_lqi", "delay_lqi_sum"):
        assert rows[name].controller.model == "multibody", name
        assert rows[name].controller.prediction == "linear", name
    assert rows["lqi"].controller.delay_steps == 0
    assert rows["delay_lqi_sum"].controller.integral_weight == 100
    plain = load_comparison("paper", CONTROLLERS)
    assert list(plain) == list(CONTROLLERS)
    for name, scenario in plain.items():
        assert scenario == sd.load_scenario("paper", name)


@pytest.mark.parametrize(
    ("compare", "message"),
    [
        ("{lqr: {w_Q: -1}}", "compare.lqr: w_Q"),
        ("{lqr: {colour: red}}", "compare.lqr: colour"),
        ("{mine: {}}", "mine"),
        ("{lqr: 3}", "compare"),
        ("{lqr: {torque_map: printed, model: multibody}}", "compare.lqr: controller.torque_map"),
    ],
)
def test_a_row_that_does_not_fit_is_refused_in_one_line(compare: str, message: str) -> None:
    with pytest.raises(sd.ConfigError) as refused:
        load_comparison("paper", CONTROLLERS, [f"compare={compare}"])
    assert message in str(refused.value) and "\n" not in str(refused.value)


def test_a_bad_row_is_found_when_the_scenario_is_read() -> None:
    with pytest.raises(sd.ConfigError, match=r"compare\.lqr: w_Q: got -1"):
        sd.load_scenario("paper", settings=["compare={lqr: {w_Q: -1}}"])


def test_the_integral_weight_scales_its_block_alone() -> None:
    def blocks(weight: float) -> np.ndarray:
        settings = [f"controller.integral_weight={weight}"]
        law = compose_law(prepare(sd.load_scenario("paper", settings=settings)))
        return np.diag(law.cost.matrices(np.ones(2))[0])

    one, hundred = blocks(1), blocks(100)
    assert np.array_equal(hundred[:6], one[:6]) and np.array_equal(hundred[6:], 100 * one[6:])


@pytest.mark.parametrize(
    ("row", "error", "within"),
    [
        ("delay_lqr", 225, 3),
        ("delay_lqi", 199, 3),
        ("delay_lqi_sum", 91, 2),
        ("delay_lqi_200", 82, 2),
    ],
)
def test_table_two_comes_out(
    rows: dict[str, sd.Scenario], row: str, error: float, within: float
) -> None:
    result = sd.simulate(rows[row], margin=False)
    assert result.status == "completed"
    assert result.accumulated_error == pytest.approx(error, abs=within)


@pytest.mark.parametrize("row", ["lqr", "lqi"])
def test_who_does_not_know_of_the_delay_loses_the_plate(
    rows: dict[str, sd.Scenario], row: str
) -> None:
    assert sd.simulate(rows[row], margin=False).status == "left_workspace"


def test_the_table_has_the_papers_numbers_beside_every_row() -> None:
    results = sd.compare("table2", ["duration=0.3"])
    assert list(results) == [*CONTROLLERS, "delay_lqi_sum", "delay_lqi_200"]
    lines = {line[:17].strip(): line for line in sd.table(results).splitlines()}
    for row, paper in (("LQR, delay-aware", "225"), ("LQI, delay-aware", "80")):
        assert lines[row].split()[2] == paper
    for row in ("delay_lqi_sum", "delay_lqi_200"):
        assert lines[row].split()[1] == "80"
    assert lines["LQI, predictor"].split()[2] == "-"
