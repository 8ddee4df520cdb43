"""The paper's Table II under the conditions in which it comes out, and rows of `compare`."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

import stewart_drake as sd
from stewart_drake.loop.controller_margin import controller_margin
from stewart_drake.loop.law_design import compose_law
from stewart_drake.loop.preparation import check_instants, prepare
from stewart_drake.mechanism.files import mechanism_yaml
from stewart_drake.reporting.document import Paragraph, Table
from stewart_drake.reporting.results import ComparisonResult
from stewart_drake.reporting.run import comparison_document
from stewart_drake.scenario.config import PlantConfig
from stewart_drake.scenario.loading import load_comparison
from stewart_drake.studies.compare import CONTROLLERS, is_papers, label
from stewart_drake.studies.workspace_map import largest_factor
from tests.mechanisms import PAPER


@pytest.fixture(scope="module")
def rows():
    return load_comparison("table2", CONTROLLERS)


@cache
def run(row):
    """Return the run of a row of the table."""
    scenario = load_comparison("table2", CONTROLLERS)[row]
    return sd.simulate(scenario, judge_stability=False)


def test_rows_are_the_controllers_and_what_the_scenario_adds(rows):
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


def test_a_row_that_does_not_fit_is_refused_in_one_line():
    printed = "{lqr: {torque_map: printed, model: multibody}}"
    for row, message in (("{mine: {}}", "mine"), (printed, "compare.lqr: controller.torque_map")):
        with pytest.raises(sd.ConfigError, match=rf"^[^\n]*{message}[^\n]*$"):
            load_comparison("paper", CONTROLLERS, [f"compare={row}"])


def test_the_integral_weight_scales_its_block_alone():
    def blocks(weight):
        settings = [f"controller.integral_weight={weight}"]
        law = compose_law(prepare(sd.load_scenario("paper", settings=settings)))
        return np.diag(law.cost.matrices(np.ones(2))[0])

    one, hundred = blocks(1), blocks(100)
    assert np.array_equal(hundred[:6], one[:6]) and np.array_equal(hundred[6:], 100 * one[6:])


@pytest.mark.parametrize(
    ("row", "error", "within"),
    [
        *(("lqr", np.nan, 0), ("lqi", np.nan, 0)),  # who does not know of the delay
        *(("delay_lqr", 225, 3), ("delay_lqi", 199, 3)),
        *(("delay_lqi_sum", 91, 2), ("delay_lqi_200", 82, 2)),
    ],
)
def test_table_two_comes_out(row, error, within):
    result = run(row)
    assert result.status == ("left_workspace" if np.isnan(error) else "completed")
    assert result.accumulated_error == pytest.approx(error, abs=within, nan_ok=True)


def test_a_multibody_plant_gives_the_same(rows):
    short = replace(rows["delay_lqi_200"], duration=4.0)
    exact, engine = (
        sd.simulate(replace(short, plant=PlantConfig(kind=kind)), judge_stability=False)
        for kind in ("exact", "multibody")
    )
    assert engine.accumulated_error == pytest.approx(exact.accumulated_error, rel=0.01)


@pytest.fixture(scope="module")
def short():
    return sd.compare("table2", ["duration=0.3"])


def of_the_paper(results):
    """Return the table that has the paper's numbers, and the paragraphs below it."""
    table, *told = comparison_document(results).sections[0].blocks
    assert isinstance(table, Table)
    return table, [block.text for block in told if isinstance(block, Paragraph)]


def test_the_table_has_paper_printed_and_reproduced_beside_each_other():
    names = ("lqr", "delay_lqr", "delay_lqi", "delay_lqi_200")
    table, told = of_the_paper({name: run(name) for name in names})
    found = {row[0]: [str(cell) for cell in row[1:]] for row in table.rows}
    blind = found["LQR, delay-blind"]
    assert blind[0] == "NaN" and blind[1] == blind[2] and blind[2].startswith("left 2.")
    assert found["LQR, delay-aware"] == ["225", "225", "225", "-"]
    assert found["LQI, delay-aware"] == ["80", "199", "199", "12"]
    assert found["delay_lqi_200: integral_weight 200"] == ["80", "199", "82.0", "63"]
    assert "0.3 of (46)" in told[0] and "w_Q/w_R = 2.5" in told[0] and "exact plant" in told[0]
    assert "= 1.28 of the motion" in told[1] and "room for 1.07 of (46)" in told[1]


def test_the_verdict_names_the_least_error_and_the_runs_that_ended_early():
    found = {name: run(name) for name in ("lqr", "delay_lqr", "delay_lqi_200")}
    best = "least error: delay_lqi_200, E_ac 82.0 % s"
    assert comparison_document(found).verdict == f"{best}; ended early: lqr"
    assert comparison_document({"lqr": found["lqr"]}).verdict == "no run completed"


def test_it_is_shown_once_and_every_row_is_in_the_summary(rows):
    found = ComparisonResult({name: run(name) for name in rows})
    text = found.table()
    assert text.count("Table II") == 1 and max(map(len, text.splitlines())) <= 80
    assert list(found.summary["controllers"]) == list(rows)
    table, _ = of_the_paper(found)
    assert [row[0] for row in table.rows] == [
        *(label(name) for name in CONTROLLERS[:4]),
        "delay_lqi_sum: integral_weight 100",
        "delay_lqi_200: integral_weight 200",
    ]


def test_other_comparisons_have_no_such_table(short):
    assert len(comparison_document({name: short[name] for name in CONTROLLERS}).sections) == 1
    settings = ["duration=0.3", "delay.steps=2"]
    other = sd.simulate(
        load_comparison("table2", (), settings)["delay_lqi_sum"], judge_stability=False
    )
    assert len(comparison_document({"delay_lqi_sum": other}).sections) == 1


@pytest.mark.parametrize("setting", ["duration=3", "plant.payload_mass=0.4", "delay.steps=4"])
def test_the_papers_numbers_stand_beside_its_own_experiment_only(setting):
    assert is_papers(sd.load_scenario("paper", settings=["plant.kind=exact"]))
    assert not is_papers(sd.load_scenario("paper", settings=[setting]))


def test_the_legend_says_whether_rows_have_weights_of_their_own(short):
    def legend(*weights):
        runs = dict(zip("abc", weights, strict=False))
        for name, w_R in runs.items():
            c = replace(short["lqr"].scenario.controller, w_R=w_R)
            scenario = replace(short["lqr"].scenario, controller=c)
            runs[name] = replace(short["lqr"], scenario=scenario)
        return " ".join(ComparisonResult(runs).table().split())

    own = "Cost: each row with its own weights."
    assert own in legend(1.0, 4.0) and own not in legend(1.0, 1.0)


def test_more_room_alone_is_not_enough(tmp_path):
    """Theory 33: cranks of 0.18 m have room for 1.7 of (46), and the printed law needs 1.28."""
    path = tmp_path / "longer.yaml"
    path.write_text(mechanism_yaml(replace(PAPER, crank_lengths=np.full(6, 0.18))))
    amplitude = "reference.amplitude=[0.2617993878, 0.2617993878, 0.2617993878, 0.02, 0.02, 0.08]"
    rows = load_comparison("table2", CONTROLLERS, [amplitude, f"mechanism={path}"])
    experiment = prepare(rows["lqr"])
    room = largest_factor(experiment.mechanism, experiment.reference, check_instants(10.0))
    assert room > 1.7
    for row in ("lqr", "lqi", "delay_lqr", "delay_lqi", "delay_lqi_200"):
        assert sd.simulate(rows[row], judge_stability=False).status == "left_workspace", row


def test_the_papers_model_makes_a_loop_that_grows_whatever_the_weights():
    """Theory 33: on the exact plant, along 0.3 of (46)."""
    for controller in ("delay_lqr", "delay_lqi"):
        for ratio in 10.0 ** np.arange(-7, 1, 2):
            settings = ("controller.model=paper", f"controller.w_Q={ratio}")
            scenario = sd.load_scenario("table2", controller, settings)
            assert controller_margin(prepare(scenario)).radius > 1.004, (controller, ratio)


def test_nobody_is_lost_before_the_first_torque_and_for_some_time_after():
    """Theory 33: 0.8 s is when the first torque acts, and it takes time to move a plate."""
    for weight in (1.0, 1e8):
        settings = ("start=rest", f"controller.w_Q={weight}", "controller.model=multibody")
        result = sd.simulate(sd.load_scenario("paper", "lqi", settings), judge_stability=False)
        assert result.stopped is not None and result.stopped.time > 1.05
