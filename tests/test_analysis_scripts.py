"""The scripts of `analysis/`, each on something small; those with own systems are run elsewhere."""

import importlib.util
import json
from pathlib import Path

import pytest

from tests.shorter import judge_few_delays

pytestmark = pytest.mark.usefixtures("blank_figures")

FOLDER = Path(__file__).resolve().parents[1] / "analysis"


def script(name, folder=FOLDER):
    spec = importlib.util.spec_from_file_location(name, folder / f"{name}.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def check(folder, answer):
    assert (folder / "report.html").read_text().count(answer.verdict[1:30])
    assert json.loads((folder / "summary.json").read_text())


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "less"), [("delay", {"simulations": False}), ("hautus", {}), ("workspace", {})]
)
def test_a_script_answers_its_question(name, less, tmp_path, capsys, monkeypatch):
    judge_few_delays(monkeypatch)
    small = ("plant.kind=exact", "duration=0.5", "delay.steps=2", "controller.catch_up=0")
    answer = script(name).main("paper", *small, out=str(tmp_path), **less)
    assert str(answer) in capsys.readouterr().out
    check(tmp_path, answer)


@pytest.mark.slow
def test_robustness_from_either_start(tmp_path, capsys):
    answers = script("robustness").main("2", "duration=0.3", out=str(tmp_path))
    printed = capsys.readouterr().out
    for start, answer in answers.items():
        assert f"{start}\n{answer}" in printed
        check(tmp_path / start, answer)
    assert set(answers) == {"rest", "on_reference"}


@pytest.mark.slow
def test_table_two_on_three_plants_and_what_its_law_lacks(tmp_path, capsys, monkeypatch):
    judge_few_delays(monkeypatch)
    tables, rows = script("table2").main("duration=0.3", out=str(tmp_path))
    assert list(tables) == ["exact", "multibody", "paper"]
    for table in tables.values():
        assert "delay_lqi_200" in table
        assert "as printed" not in table, "Table II is of ten seconds: see test_table2"
    lines = rows.splitlines()
    assert len(lines) == 5 and all(line.count("|") == 4 for line in lines)
    written = (tmp_path / "table2.txt").read_text()
    assert rows in written and capsys.readouterr().out == written
