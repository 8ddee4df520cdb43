"""Signals as CSV: the header, the numbers, and what is refused."""

import csv
import io

import numpy as np
import pytest

import stewart_drake as sd
from stewart_drake.cli import main
from stewart_drake.files.errors import ConfigError
from stewart_drake.loop.preparation import prepare
from stewart_drake.reporting.csv_file import signals_csv
from stewart_drake.scenario.reference_files import read_csv

pytestmark = pytest.mark.usefixtures("blank_figures")

ON_REFERENCE = ("start=on_reference", "queue=reference")
SHORT = ("--set", "plant.kind=exact", "--set", "duration=0.3")


def table(text):
    head, *rows = csv.reader(io.StringIO(text))
    assert len(set(head)) == len(head) and {len(row) for row in rows} == {len(head)}
    values = np.array([[float(cell) if cell else np.nan for cell in row] for row in rows])
    return dict(zip(head, values.T, strict=True))


def test_every_number_of_every_signal_is_there(followed):
    columns = table(signals_csv(followed.signals))
    assert len(columns) == 1 + sum(signal[0].size for signal in followed.signals.values())
    assert np.array_equal(columns["time[s]"], followed.signals.time.values)
    for name, column, unit in (
        ("pose", "roll", "rad"),
        ("pose", "z", "m"),
        ("rates", "yaw", "rad/s"),
        ("integral", "x", "m s"),
        ("reference", "pitch", "rad"),
        ("torque_applied", "3", "N m"),
        ("parameters", "payload_mass", "kg"),
        ("parameter_std", "joint_damping", "N m s/rad"),
        ("weights", "w_R", "-"),
        ("density", "torque_6", "-"),
        ("measurement", "y", "m"),
        ("state_estimate", "z_dot", "m/s"),
    ):
        signal = followed.signals[name]
        dimension = next(d for d in signal.dims if d != "time")
        labels = [str(label) for label in signal[dimension].values]
        label = {"roll": "phi", "pitch": "theta", "yaw": "psi"}.get(column, column)
        expected = signal.values[:, labels.index(label)]
        assert np.allclose(columns[f"{name}_{column}[{unit}]"], expected, rtol=1e-11, atol=0)
    signals = followed.signals.copy(deep=True)  # what is not a number is an empty cell
    signals.parameters.values[2, 6] = np.nan
    column = table(signals_csv(signals))["parameters_payload_mass[kg]"]
    assert np.isnan(column[2]) and np.isfinite(column[3:]).all()
    assert "nan" not in signals_csv(signals)


def test_a_run_comes_back_as_a_motion(followed, tmp_path):
    """An exported run is the reference of the next run."""
    path = tmp_path / "run.csv"
    path.write_text(signals_csv(followed.signals))
    settings = ("plant.kind=exact", "duration=0.3", "reference.kind=csv", f"reference.file={path}")
    reference = prepare(sd.load_scenario("paper", settings=settings)).reference
    poses = np.array([reference.value(t)[:, 0] for t in followed.signals.time.values])
    np.testing.assert_allclose(poses, followed.signals.pose.values, rtol=1e-11, atol=1e-12)
    inside = followed.signals.time.values[:-1]  # at its end a sampled motion stops
    rates = np.array([reference.EvalDerivative(t)[:, 0] for t in inside])
    assert np.abs(rates - followed.signals.rates.values[:-1]).max() < 1e-3
    again = sd.simulate(
        sd.load_scenario("paper", settings=(*settings, *ON_REFERENCE)), judge_stability=False
    )
    assert again.status == "completed" and again.accumulated_error < 0.01


def test_an_exported_file_must_be_whole_in_its_motion_only(followed, tmp_path):
    path = tmp_path / "run.csv"
    path.write_text(signals_csv(followed.signals))
    lines = path.read_text().splitlines()
    header = lines[0].split(",")
    place = header.index("pose_yaw[rad]")
    path.write_text("\n".join(",".join(np.delete(line.split(","), place)) for line in lines))
    with pytest.raises(ConfigError, match="row 1: column yaw is missing; expected time"):
        read_csv(path)
    emptied = [line.split(",") for line in lines]
    emptied[3][place] = ""
    path.write_text("\n".join(map(",".join, emptied)))
    with pytest.raises(ConfigError, match=r"row 4, column pose_yaw\[rad\]: got ''"):
        read_csv(path)


@pytest.mark.slow
def test_export_gives_what_simulate_wrote(tmp_path, capsys):
    assert main(["simulate", *SHORT, "--out", str(tmp_path), "--csv", "--quiet"]) == 0
    written = (tmp_path / "signals.csv").read_text()
    assert main(["export", str(tmp_path / "signals.nc")]) == 0
    assert capsys.readouterr() == (written, "")
    out = tmp_path / "new" / "again.csv"
    assert main(["export", str(tmp_path / "signals.nc"), "--out", str(out)]) == 0
    assert "again.csv" in capsys.readouterr().out
    assert out.read_text() == written and len(table(written)["time[s]"]) == 16
    assert main(["simulate", *SHORT, "--out", str(tmp_path), "--quiet"]) == 0
    assert not (tmp_path / "signals.csv").exists(), "of an earlier run"
