"""The notebooks of `analysis/`: every cell in turn, as a notebook does, without its outputs."""

import ast
import json
from pathlib import Path
from typing import Any, NamedTuple

import pytest

from tests.shorter import judge_few_delays

FOLDER = Path(__file__).resolve().parents[1] / "analysis"
NOTEBOOKS = tuple(sorted(path.name for path in FOLDER.glob("*.ipynb")))


class Done(NamedTuple):
    """A notebook that has run: its names, and what the last expression of each cell shows."""

    names: dict[str, Any]
    shown: list[str]


def run(name):
    names = {"__name__": "__main__"}
    shown = []
    for cell in json.loads((FOLDER / name).read_text(encoding="utf-8"))["cells"]:
        if cell["cell_type"] != "code":
            continue
        tree = ast.parse("".join(cell["source"]))
        last = tree.body.pop() if isinstance(tree.body[-1], ast.Expr) else None
        exec(compile(tree, name, "exec"), names)
        if last is not None:
            value = eval(compile(ast.Expression(last.value), name, "eval"), names)
            shown.append(getattr(value, "_repr_html_", value.__repr__)())
    return Done(names, shown)


@pytest.mark.parametrize("name", NOTEBOOKS)
def test_outputs_are_not_committed(name):
    cells = json.loads((FOLDER / name).read_text(encoding="utf-8"))["cells"]
    code = [cell for cell in cells if cell["cell_type"] == "code"]
    assert code and all(c["outputs"] == [] and c["execution_count"] is None for c in code)


@pytest.mark.slow
def test_the_first_hour_shows_figures_and_pages(capsys, monkeypatch):
    judge_few_delays(monkeypatch)
    names, shown = run("first_hour.ipynb")
    assert len(shown) >= 6
    assert sum("<img" in text for text in shown) == 1
    assert sum("<iframe" in text for text in shown) == 2
    assert names["result"].status == "completed"
    assert names["blind"].status == "left_workspace"


@pytest.mark.slow
@pytest.mark.usefixtures("blank_figures")
def test_an_own_controller_holds_without_delay_and_not_with_it(capsys):
    names, _ = run("own_controller.ipynb")
    prompt, errors, late = (names[name] for name in ("prompt", "errors", "late"))
    compared = names["compared"]
    assert list(compared)[-1] == "computed torque" and len(compared) == 6
    assert compared["computed torque"].accumulated_error == errors[2].accumulated_error
    assert prompt.status == "completed" and prompt.accumulated_error < 1
    # The text: what a delay does grows with it, and ten periods are too many.
    assert errors[2].status == "completed" and errors[10].status == "left_workspace"
    assert errors[2].accumulated_error > prompt.accumulated_error
    # 0.8 s late, and better than the own one with 60 ms.
    assert late.status == "completed" and late.accumulated_error < errors[6].accumulated_error
    assert capsys.readouterr().out.count("left_workspace") >= 1


@pytest.mark.slow
@pytest.mark.usefixtures("blank_figures")
def test_a_lost_log_leads_to_full_amplitude(capsys):
    names, _ = run("lost_log.ipynb")
    assert names["lost"].status == "left_workspace"
    assert names["summary"]["delay_s"] == pytest.approx(0.95, abs=2e-4)
    assert names["summary"]["delay_std_s"] < 2e-4
    assert names["full"].status == "completed" and names["full"].accumulated_error < 10
    assert not names["folder"].exists()
    assert "completed" in capsys.readouterr().out


@pytest.mark.slow
@pytest.mark.usefixtures("blank_figures")
def test_at_the_limits_plans_are_better_than_cut_torques(capsys):
    names, _ = run("at_the_limits.ipynb")
    cut, planned = (names["compared"][f"predictor_{kind}"] for kind in ("lqi", "mpc"))
    assert planned.accumulated_error < cut.accumulated_error / 2
    assert names["too_large"].status == "completed"
    assert "predictor_mpc" in capsys.readouterr().out


@pytest.mark.slow
@pytest.mark.usefixtures("blank_figures")
def test_setpoints_of_reachy_mini_are_compensated(capsys):
    names, _ = run("reachy_mini.ipynb")
    plain, compensated = (names["runs"][f"servo_{k}"] for k in ("preview", "feedforward"))
    assert compensated.accumulated_error < plain.accumulated_error / 2
    assert names["angles"].shape == names["plain"].shape == (400, 6)
    assert names["made"].blend == 0
    assert "servo_feedforward: rms error 0.0" in capsys.readouterr().out
