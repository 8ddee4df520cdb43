"""The scripts of `analysis/`, each on something small; those with own systems are run elsewhere."""

import importlib.util
from pathlib import Path

import pytest

from tests.shorter import judge_few_delays

pytestmark = pytest.mark.usefixtures("blank_figures")

FOLDER = Path(__file__).resolve().parents[1] / "analysis"


def script(name):
    spec = importlib.util.spec_from_file_location(name, FOLDER / f"{name}.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


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
