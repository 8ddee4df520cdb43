"""`identify`: bad logs and options in one line each; from a lost run to one that is held."""

import json
from types import SimpleNamespace

import numpy as np
import pytest
import xarray as xr

import stewart_drake as sd
from stewart_drake.cli import main
from stewart_drake.files.errors import ConfigError
from stewart_drake.identification.logs import ANGLES, POSE, Precision, angle_std, load_log
from stewart_drake.identification.unknowns import DELAY, OFFSETS
from stewart_drake.loop.simulation import simulate
from stewart_drake.mechanism.files import load_mechanism
from stewart_drake.mechanism.geometry import fingerprint
from stewart_drake.reporting.identification import file_names
from stewart_drake.scenario.calibration import load_calibration
from stewart_drake.scenario.loading import load_scenario
from tests.mechanisms import PAPER
from tests.screen import too_long

pytestmark = pytest.mark.usefixtures("blank_figures")

HEADER = [
    "time[s]",
    *(f"torque_{leg}[N m]" for leg in range(1, 7)),
    *(f"angle_{leg}[deg]" for leg in range(1, 7)),
]
HOME = np.rad2deg(PAPER.crank_angles(PAPER.home))
ROWS = [
    [f"{0.02 * k:.2f}", *(f"{0.1 * (k // 5 % 3)}" for _ in range(6)), *(f"{a:.6f}" for a in HOME)]
    for k in range(60)
]


def csv_text(header=HEADER, rows=ROWS):
    return "\n".join(",".join(cells) for cells in [header, *rows]) + "\n"


def changed(row, column, text):
    rows = [list(cells) for cells in ROWS]
    rows[row][column] = text
    return csv_text(rows=rows)


def read(path):
    return load_log(path, PAPER, Precision())


def test_a_csv_log_is_read(tmp_path):
    path = tmp_path / "log.csv"
    poses = ["roll[deg]", "pitch[rad]", "yaw[rad]", "x[mm]", "y[m]", "z[m]"]
    rows = [
        [*row, "1.5", "0.1", ("", "nan")[k % 2], "2", "0", "0.38"] for k, row in enumerate(ROWS)
    ]
    path.write_text(csv_text([*HEADER, *poses], rows))
    log = read(path)
    assert len(log.times) == 60 and log.gravity == 9.81 and log.delay is None
    np.testing.assert_allclose(log.sent[:3], [0.0, 0.1, 0.2])  # only changes have a time
    np.testing.assert_allclose(log.torques[:3, 0], [0.0, 0.1, 0.2])
    np.testing.assert_allclose(log.values[5, ANGLES], np.deg2rad(HOME), atol=1e-8)
    np.testing.assert_allclose(log.values[5, POSE], [np.deg2rad(1.5), 0.1, np.nan, 2e-3, 0, 0.38])
    applied = log.applied_torque(np.array([0.0, 0.19, 0.21]), 0.1)
    np.testing.assert_allclose(applied[:, 0], [0, 0, 0.1])


def test_measurements_come_at_100_hz_at_most(tmp_path):
    path = tmp_path / "log.csv"
    rows = [[f"{0.001 * k:.3f}", *ROWS[k % 60][1:]] for k in range(1000)]
    path.write_text(csv_text(rows=rows))
    times = read(path).times
    assert len(times) == 100 and np.diff(times).min() > 0.0099


def test_the_error_of_a_code_is_that_of_rounding():
    angles, step = np.random.default_rng(0).uniform(-3, 3, 100_000), 2 * np.pi / 2**10
    assert angle_std(10) == pytest.approx((step * np.round(angles / step) - angles).std(), rel=0.01)


@pytest.mark.parametrize(
    ("text", "named"),
    [
        ("", "is empty"),
        (csv_text([*HEADER[:3], "torque_1[N m]", *HEADER[4:]]), "a second column"),
        (csv_text(HEADER[:-1], [row[:-1] for row in ROWS]), "angle_6 is missing"),
        (csv_text([*HEADER[:1], *HEADER[2:]], [row[:1] + row[2:] for row in ROWS]), "torque_1"),
        (changed(3, 0, "0.01"), "row 5, column time"),
        (changed(3, 4, "many"), "row 5, column torque_4"),
        (changed(3, 9, "inf"), "row 5, column angle_3"),
        (changed(3, 2, ""), "row 5: got some of the six torques"),
        (csv_text([name.replace("deg", "rad") for name in HEADER]), "row 2, column angle_1[rad]"),
        (changed(3, 9, "320"), "take off whole turns"),
        (csv_text(rows=[[str(1e3 * float(row[0])), *row[1:]] for row in ROWS]), "and time in s"),
        (csv_text(rows=ROWS[:15]), "at 15 instants"),
        (csv_text(rows=[[row[0], *ROWS[0][1:]] for row in ROWS]), "one torque throughout"),
    ],
)  # fmt: skip
def test_a_bad_csv_log_is_reported_in_one_line(tmp_path, text, named):
    path = tmp_path / "log.csv"
    path.write_text(text)
    with pytest.raises(ConfigError) as caught:
        read(path)
    assert named in str(caught.value) and str(path) in str(caught.value)
    assert "expected" in str(caught.value) and "\n" not in str(caught.value)


def test_a_summary_is_no_log(tmp_path):
    path = tmp_path / "summary.json"
    path.write_text('{"status": "completed",\n"counts": [1, 2]}')
    with pytest.raises(ConfigError, match=r"summary.json: got a file of another kind; expected a"):
        read(path)


@pytest.fixture(scope="module")
def lost(tmp_path_factory):
    """Return the log of a run whose delay is believed to be 0.8 s and is 0.93 s."""
    folder = tmp_path_factory.mktemp("lost")
    settings = (
        "plant.kind=exact", "start=on_reference", "queue=reference", "controller.delay_steps=8",
        "delay.steps=9", "delay.fraction=0.3", "plant.payload_mass=0.4",
        "sensor.noise_std=[1e-4,1e-4,1e-4,2e-5,2e-5,2e-5,1e-3,1e-3,1e-3,1e-4,1e-4,1e-4]",
    )  # fmt: skip
    result = simulate(load_scenario("paper", settings=settings), judge_stability=False)
    assert result.status == "left_workspace" and result.stopped.time < 8
    result.save(folder)
    return folder / "signals.nc"


NETWORK = "link:\n  kind: network\n  low: 0.1\n  high: 0.2\n  return: {low: 0.1, high: 0.2}"
IN_SCENARIO = {
    "network": ("link:\n  kind: wire", NETWORK),
    "sensor.delay": ("  delay: 0.0\n  loss", "  delay: 0.1\n  loss"),
}


def broken(signals, how):
    """Return the signals of a run as no log has them."""
    if how == "scenario":
        signals.attrs.pop("scenario")
    elif how in IN_SCENARIO:
        old, new = IN_SCENARIO[how]
        assert old in signals.attrs["scenario"]
        signals.attrs["scenario"] = signals.attrs["scenario"].replace(old, new)
    elif how == "log_period":
        return signals.isel(time=slice(None, None, 9))
    elif how == "at 5 instants":
        return signals.isel(time=signals.time < 0.45)
    else:
        return signals.drop_vars(how)
    return signals


@pytest.mark.parametrize(
    "how",
    ["scenario", "network", "sensor.delay", "log_period", "at 5 instants", "measurement"],
)
def test_a_run_that_is_no_log_is_reported_in_one_line(lost, tmp_path, how):
    with xr.open_dataset(lost, engine="h5netcdf") as signals:
        broken(signals.load(), how).to_netcdf(tmp_path / "bad.nc", engine="h5netcdf")
    with pytest.raises(ConfigError) as caught:
        read(tmp_path / "bad.nc")
    assert how in str(caught.value) and "bad.nc" in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("arguments", "named"),
    [
        ([], "LOG, --plan"),
        (["LOG", "--plan", "paper"], "LOG, --plan"),
        (["LOG"], "--mechanism"),
        (["LOG", "--mechanism", "paper"], "does not move"),
        (["LOG", "--mechanism", "paper", "--tolerance", "lengths"], "--tolerance"),
        (["LOG", "--mechanism", "paper", "--tolerance", "lengths=-1"], "lengths"),
        (["LOG", "--mechanism", "paper", "--tolerance", "delay=null"], "delay"),
        (["LOG", "--mechanism", "paper", "--delay", "-1"], "--delay"),
        (["LOG", "--mechanism", "paper", "--bits", "0"], "--bits"),
        (["LOG", "--mechanism", "paper", "--pose-std", "1e-4,0"], "--pose-std"),
        (["LOG", "--mechanism", "paper", "--set", "duration=1"], "--set"),
        (["LEGLESS", "--mechanism", "paper"], "at 0 instants; expected at least 8"),
    ],
)
def test_a_bad_command_is_reported_in_one_line(tmp_path, capsys, arguments, named):
    path = tmp_path / "log.csv"
    path.write_text(csv_text())
    legless = tmp_path / "legless.csv"  # one encoder says nothing
    legless.write_text(csv_text(rows=[[*row[:9], "", *row[10:]] for row in ROWS]))
    places = {"LOG": str(path), "LEGLESS": str(legless)}
    words = [places.get(word, word) for word in arguments]
    assert main(["identify", *words, "--out", str(tmp_path / "out")]) == 2
    out, err = capsys.readouterr()
    assert out == "" and err.startswith("error: ") and named in err and err.count("\n") == 1
    assert not list((tmp_path / "out").glob("*.yaml"))


def test_an_error_names_the_log_and_the_mechanism(lost, tmp_path, capsys):
    path = tmp_path / "log.csv"
    path.write_text(csv_text())
    for log, mechanism, words in (
        (lost, "desktop", "its poses do not suit the mechanism desktop (pose out of reach"),
        (path, "paper", "got a plate that does not move"),
    ):
        assert main(["identify", str(log), "--mechanism", mechanism]) == 2
        assert f"error: {log}: {words}" in capsys.readouterr().err


@pytest.mark.slow
def test_a_lost_log_lets_the_next_run_be_held(lost, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path.parent)
    assert main(["identify", str(lost), "--mechanism", "paper", "--out", tmp_path.name]) == 0
    out = capsys.readouterr().out
    assert "The delay is 9" in out and not too_long(out)
    summary = json.loads((tmp_path / "summary.json").read_text())
    assert abs(summary["delay_s"] - 0.93) < 1e-3 and summary["intervals"]
    assert abs(summary["delay_s"] - 0.93) < 4 * summary["delay_std_s"]
    assert abs(summary["parameters"]["payload_mass"]["value"] - 0.4) < 0.1
    assert summary["chi2"].keys() == {"pose", "rates", "prior", "all"}
    assert 0.7 < summary["chi2"]["all"] < 1.4
    assert summary["pose_uncertainty"].keys() >= {"angle_rad", "position_m"}
    known = load_calibration(tmp_path / "calibration.yaml")
    assert known.value("delay") == summary["delay_s"]
    machine = load_mechanism(tmp_path / "mechanism.yaml")
    assert np.abs(machine.rod_lengths - PAPER.rod_lengths).max() < 1e-3
    assert machine.drawn == fingerprint(PAPER) != fingerprint(machine)
    page = (tmp_path / "report.html").read_text()
    assert (
        f"Use found.yaml: stewart-drake simulate SCENARIO --set overlay={tmp_path.name}/found.yaml"
        in (" ".join(out.split()))
    )
    overlay = f"overlay={tmp_path / 'found.yaml'}"
    found = sd.load_scenario("paper", settings=("overlay=dirty", overlay, "plant.kind=exact"))
    assert found.mechanism == str(tmp_path / "mechanism.yaml")
    assert found.controller.calibration == str(tmp_path / "calibration.yaml")
    assert found.plant.payload_mass == pytest.approx(known.value("payload_mass"), rel=1e-5)
    assert found.plant.mechanism is None and found.sensor.noise_std[0] > 0  # that of dirty
    assert "What the log does not show" in page and "<svg" not in page.split("<body")[0]
    settings = (
        "plant.kind=exact", "plant.mechanism=paper", "delay.steps=9", "delay.fraction=0.3",
        "plant.payload_mass=0.4", "reference.amplitude=[0.13,0.13,0.13,0.01,0.01,0.04]",
        f"mechanism={tmp_path / 'mechanism.yaml'}",
        f"controller.calibration={tmp_path / 'calibration.yaml'}",
    )  # fmt: skip
    words = [word for setting in settings for word in ("--set", setting)]
    assert main(["simulate", "paper", *words, "--out", str(tmp_path / "next"), "--quiet"]) == 0
    run = json.loads((tmp_path / "next" / "summary.json").read_text())
    assert run["status"] == "completed"
    assert run["delay"]["estimated_s"] == pytest.approx(summary["delay_s"], rel=1e-12)


def test_logs_of_one_name_are_distinguished_by_their_folders():
    def told(*names):
        return file_names([SimpleNamespace(name=name) for name in names])

    assert told("a/signals.nc", "b/log.csv") == ["signals.nc", "log.csv"]
    assert told("a/signals.nc", "b/signals.nc") == ["a/signals.nc", "b/signals.nc"]
    assert told("x/a/s.nc", "y/a/s.nc", "b/s.nc")[:2] == ["x/a/s.nc", "y/a/s.nc"]
    assert told("a/s.nc", "a/s.nc") == ["s.nc", "s.nc"]


@pytest.mark.slow
def test_an_identified_machine_has_the_encoder_offsets_of_the_true_one(tmp_path):
    offset = [4e-3, -3e-3, 2e-3, 0.0, 3e-3, -2e-3]
    encoders = ("plant.kind=exact", "sensor.kind=encoders", "sensor.samples=10", "duration=6")
    scenario = sd.load_scenario("paper", settings=(*encoders, f"sensor.offset={offset}"))
    sd.simulate(scenario, judge_stability=False).save(tmp_path)
    result = sd.identify(tmp_path, "paper", delay=0.8)
    result.save(tmp_path / "found")
    told = " ".join(str(result).split())
    assert "Encoder offsets of legs 1 to 6 (reading less crank angle), mrad: " in told
    overlay = f"overlay={tmp_path / 'found' / 'found.yaml'}"
    followed = (*encoders, "start=on_reference", "queue=reference", overlay)
    like = sd.load_scenario("paper", settings=followed)
    std = result.study.std[OFFSETS]
    assert np.all(np.abs(np.subtract(like.sensor.offset, offset)) < 4 * std)
    without = sd.load_scenario("paper", settings=(*followed, f"sensor.offset={[0.0] * 6}"))
    runs = [sd.simulate(one, judge_stability=False) for one in (like, without)]
    errors = [run.summary["accumulated_error"] for run in runs]
    assert errors[0] < 0.3 < 3 * errors[0] < errors[1]
    words = ["identify", str(tmp_path), "--mechanism", "paper", "--out", str(tmp_path / "found")]
    assert main([*words, "--delay", "0.7", "--tolerance", "delay=0"]) == 1
    assert not (tmp_path / "found" / "found.yaml").exists()


@pytest.mark.slow
def test_a_plan_can_be_run(tmp_path):
    assert main(["identify", "--plan", "paper", "--out", str(tmp_path), "--quiet"]) == 0
    summary = json.loads((tmp_path / "summary.json").read_text())
    assert 1e-6 < summary["delay_std_s"] < 1e-4 and summary["share"] == 1
    unseen = set(summary["unseen"]["names"])
    assert {f"where the base stands along {axis}" for axis in "xyz"} <= unseen
    alone = sd.controller_margin(tmp_path / "scenario.yaml").summary["delay_margin_s"]
    assert summary["controller_margin"]["delay_margin_s"] == pytest.approx(alone, rel=1e-3)
    words = ["--set", "plant.kind=exact", "--set", "duration=3", "--out", str(tmp_path / "run")]
    assert main(["simulate", str(tmp_path / "scenario.yaml"), *words, "--quiet"]) == 0
    run = json.loads((tmp_path / "run" / "summary.json").read_text())
    assert run["status"] == "completed"


@pytest.mark.slow
@pytest.mark.parametrize(
    ("setting", "share", "words"),
    [
        (
            "actuator.torque_limit=0.02",
            0.7,
            "amplitude is 70 % of the requested one: the",
        ),
        ("controller.delay_steps=4", 1.0, "loses the plate along this motion, and along smaller"),
    ],
)
def test_a_plan_shrinks_until_the_loop_keeps_it_or_says_that_it_does_not(
    setting, share, words, tmp_path
):
    scenario = sd.load_scenario("paper", settings=(setting, "plant.kind=exact"))
    found = sd.plan_identification(scenario)
    assert found.summary["share"] == pytest.approx(share)
    assert found.summary["kept"] == (share < 1) and "of its reach" in found.summary["lost"]
    assert words in " ".join(str(found).split())
    found.save(tmp_path)
    run = sd.simulate(tmp_path / "scenario.yaml", judge_stability=False)
    assert (run.status == "completed") == found.summary["kept"]


def test_a_plan_counts_with_the_encoders_of_its_scenario():
    """2 pi / 2^n / sqrt(12) of n bits, 14 where the scenario measures the state."""
    said, delays = [], []
    for encoders in ((), ("sensor={kind: encoders, bits: 10, samples: 1}",)):
        found = sd.plan_identification("paper", (*encoders, "plant.kind=exact", "duration=2"))
        said.append(" ".join(str(found).split()))
        delays.append(found.study.std[DELAY])
    assert "crank angles to ± 0.11 mrad" in said[0] and "crank angles to ± 1.8 mrad" in said[1]
    assert delays[1] > 4 * delays[0]


@pytest.mark.slow
def test_a_plan_says_that_its_loop_tolerates_less_than_the_log_leaves():
    encoders = "sensor={kind: encoders, bits: 8, samples: 1}"
    found = sd.plan_identification(sd.load_scenario("gravity", settings=("duration=2", encoders)))
    assert found.study.margin.delay_margin < found.study.std[DELAY]
    words = "tolerates an error of the delay of 0.00831 ms only. Plan again with --set controller"
    assert words in " ".join(str(found).split())


@pytest.mark.slow
def test_the_steps_of_the_multibody_plant_are_no_wrong_machine(tmp_path):
    scenario = sd.load_scenario("paper", settings=("duration=4",))
    sd.simulate(scenario, judge_stability=False).save(tmp_path)
    result = sd.identify(tmp_path, "paper")
    found, said = result.summary, " ".join(str(result).split())
    assert "its steps shift the delay by up to 1 ms, which its interval contains" in said
    assert found["chi2"]["all"] < 1.5
    assert abs(found["delay_s"] - 0.8) < found["delay_std_s"] < 2e-3
    assert f"± {1e3 * found['delay_std_s']:.1f} ms" in result.verdict
