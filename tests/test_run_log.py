"""Logs that are written during a run, and their reading."""

import json
import os
import socket
import threading
import time
from dataclasses import replace
from functools import partial
from unittest.mock import Mock

import numpy as np
import pytest
import xarray as xr
from mcap.reader import make_reader

import stewart_drake as sd
from stewart_drake.cli import main
from stewart_drake.files.errors import ConfigError
from stewart_drake.files.jsonio import write_json
from stewart_drake.identification import logs
from stewart_drake.scenario.run_log import (
    Background,
    UdpMirror,
    open_log,
    read_log,
    scenario_of,
)
from stewart_drake.scenario.signals import SIGNALS, recorded_signals
from tests.faults import one_line, written
from tests.mechanisms import PAPER
from tests.test_machine_process import free_port

SHORT = ("plant.kind=exact", "duration=2.5", "start=on_reference", "queue=reference")
NOISE = f"sensor.noise_std={[1e-4] * 12}"
KINDS = {
    "state": (*SHORT, NOISE),
    "encoders": (*SHORT, "sensor.kind=encoders", "sensor.samples=2"),
    "network": (*SHORT, "link.kind=network", "link.loss=0.2"),
}


@pytest.fixture(scope="module", params=KINDS)
def run(request, tmp_path_factory):
    """Return a run and its folder; each log is written during an own run of the scenario."""
    folder = tmp_path_factory.mktemp(request.param)
    scenario = sd.load_scenario("paper", None, KINDS[request.param])
    for name in ("run.mcap", "run.csv"):
        result = sd.simulate(scenario, judge_stability=False, log=folder / name)
    result.save(folder)
    return result, folder


@pytest.mark.parametrize("name", ["run.mcap", "run.csv", "signals.nc", ""])
def test_a_log_has_the_signals_of_its_run_exactly(run, name):
    result, folder = run
    read = sd.read_log(folder / name)
    xr.testing.assert_equal(read.drop_attrs(), result.signals.drop_attrs())
    assert [*read.data_vars] == [*result.signals.data_vars]
    for signal in ("pose", "measurement", "packets"):
        assert read[signal].attrs == result.signals[signal].attrs
    assert read.attrs["scenario"] == result.signals.attrs["scenario"]


def test_the_reader_of_mcap_finds_schemas_that_fit_the_messages(run):
    result, folder = run
    with open(folder / "run.mcap", "rb") as file:
        reader = make_reader(file)
        summary = reader.get_summary()
        topics = {channel.topic for channel in summary.channels.values()}
        assert topics == {f"/{name}" for name, signal in SIGNALS.items() if signal.source}
        assert summary.statistics.message_count == len(result.signals.time) * len(topics)
        times = []
        for schema, channel, message in reader.iter_messages():
            about, found = json.loads(schema.data), json.loads(message.data)
            assert (schema.encoding, channel.message_encoding) == ("jsonschema", "json")
            assert about["type"] == "object" and found.keys() <= about["properties"].keys()
            assert all(isinstance(value, float | int) for value in found.values())
            assert message.log_time == round(1e9 * found["time"])
            if channel.topic == "/pose":
                times.append(message.log_time)
                assert about["properties"]["z"]["description"] == "m"
    assert np.allclose(1e-9 * np.array(times), result.signals.time, atol=1e-9)


@pytest.mark.parametrize("share", [0.4, 0.7, 0.95])
@pytest.mark.parametrize("name", ["run.mcap", "run.csv"])
def test_a_run_that_was_killed_leaves_its_log_up_to_there(run, tmp_path, name, share, caplog):
    result, folder = run
    data = (folder / name).read_bytes()
    (tmp_path / name).write_bytes(data[: int(share * len(data))])
    (tmp_path / "run.yaml").write_bytes((folder / "run.yaml").read_bytes())
    read = read_log(tmp_path / name)
    end = f"{name}: cut off, as of a killed run; read up to t = {read.time.values[-1]:g} s"
    assert caplog.text.count(end) == 1
    whole = result.signals.isel(time=slice(len(read.time)))
    assert 0.3 * share * len(result.signals.time) < len(read.time) <= len(result.signals.time)
    assert np.array_equal(read.time, whole.time)
    assert np.array_equal(read.pose[:-1], whole.pose[:-1])


def test_a_damaged_mcap_log_is_refused(run, tmp_path):
    """The decompressor has exceptions of its own, and a wrong length looks like a cut."""
    data = (run[1] / "run.mcap").read_bytes()
    second = data.index(b"zstd", data.index(b"zstd") + 4)  # chunk
    for at in (second + 100, second - 33):  # its data, its length
        changed = data[:at] + bytes([data[at] ^ 0x7F]) + data[at + 1 :]
        path = written(tmp_path / "run.mcap", changed)
        one_line(partial(sd.read_log, path), "damaged after t = ", "run.mcap")


def test_identify_and_export_read_the_same_from_every_kind_of_log(run):
    _, folder = run
    paths = [folder / name for name in ("signals.nc", "run.mcap", "run.csv", ".")]
    assert len({sd.export_csv(path) for path in paths}) == 1
    read = [logs.load_log(path, PAPER, logs.Precision()) for path in paths]
    for other in read[1:]:
        for field in ("sent", "torques", "times", "values", "std", "before"):
            one, same = getattr(read[0], field), getattr(other, field)
            assert one is same or np.array_equal(one, same, equal_nan=True)
        assert (other.delay, other.gravity) == (read[0].delay, read[0].gravity)


def test_a_csv_log_without_its_scenario_is_read_but_not_identified(run, tmp_path):
    result, folder = run
    alone = tmp_path / "alone.csv"
    alone.write_bytes((folder / "run.csv").read_bytes())
    assert "scenario" not in read_log(alone).attrs
    with pytest.raises(ConfigError, match=r"has no scenario; .* alone\.yaml or summary\.json"):
        logs.load_log(alone, PAPER, logs.Precision())
    write_json(tmp_path / "summary.json", result.summary)
    assert scenario_of(read_log(alone), alone) == result.scenario


@pytest.mark.slow
def test_a_csv_log_does_not_replace_a_scenario_beside_it(run, tmp_path, capsys):
    own = tmp_path / "mine.yaml"
    own.write_text("mechanism: paper  # mine\n")
    assert main(["simulate", str(own), "--log", str(tmp_path / "mine.csv")]) == 2
    assert "would replace mine.yaml" in capsys.readouterr().err
    assert own.read_text() == "mechanism: paper  # mine\n" and not (tmp_path / "mine.csv").exists()


def test_a_log_is_replayed(run, tmp_path):
    _, folder = run
    for name in ("run.mcap", "run.csv", ""):
        page = tmp_path / "replay.html"
        assert main(["replay", str(folder / name), "--out", str(page)]) == 0
        assert "log of 2.5 s" in page.read_text() and page.stat().st_size > 100_000


@pytest.mark.parametrize(
    ("name", "data", "words"),
    [
        ("log.mcap", b"not MCAP" * 9, "no MCAP file"),
        ("log.mcap", b"hello", "no MCAP file"),
        ("log.mcap", b"", "no MCAP file"),
        ("log.csv", b"a,b\n1,2\n", "column 'a'"),
        ("log.csv", b"", "cannot be read"),
        ("log.csv", b"\xff\xfe\n", "cannot be read"),
        ("log.csv", b'"' + 200_000 * b"1", "field larger than field limit"),
        ("log.txt", b"", "file of another kind"),
        ("log.nc", b"CDF", "cannot be read"),
    ],
)
def test_what_is_no_log_is_said_in_a_line(tmp_path, name, data, words):
    path = written(tmp_path / name, data)
    one_line(lambda: sd.read_log(path), words, name)


@pytest.mark.parametrize("suffix", [".csv", ".mcap"])
def test_two_runs_do_not_write_one_log(tmp_path, suffix):
    path, scenario = tmp_path / f"log{suffix}", sd.load_scenario("paper")
    first = open_log(path, scenario)
    first.write(0.0, {"pose": np.zeros(6)})
    one_line(lambda: open_log(path, replace(scenario, duration=3.0)), "another log", str(path))
    first.close()
    read = sd.read_log(path)
    assert read.sizes["time"] == 1 and scenario_of(read, path) == scenario
    open_log(path, scenario).close()


def test_missing_logs_are_said_in_a_line(tmp_path):
    one_line(lambda: sd.read_log(tmp_path / "none.mcap"), "no such file")
    one_line(lambda: sd.read_log(tmp_path), "has no signals.nc")
    pipe = tmp_path / "pipe.csv"
    os.mkfifo(pipe)
    one_line(lambda: sd.read_log(pipe), "is not a file")
    one_line(lambda: sd.identify(pipe, PAPER), "is not a file")


# Live.


def row(value):
    return {one.name: np.full(one.size, value) for one in recorded_signals(None)}


def test_the_mirror_sends_every_row_as_json():
    scenario = sd.load_scenario("paper")
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as listener:
        listener.bind(("127.0.0.1", 0))
        listener.settimeout(10)
        mirror = UdpMirror(listener.getsockname(), scenario)
        mirror.write(0.5, row(1.25))
        found = json.loads(listener.recv(65536))
        assert found["timestamp"] == 0.5 and found["torque_applied"]["leg_6"] == 1.25
        assert set(found) == {"timestamp", *row(0)}
        mirror.write(0.6, row(np.nan))
        assert json.loads(listener.recv(65536))["pose"] == {}
    for _ in range(5):
        mirror.write(0.7, row(1.0))  # nothing listens any more
    mirror.close()


def test_a_full_disk_is_reported_once_and_the_loop_goes_on():
    said, full = [], Mock()
    full.write.side_effect = OSError(28, "No space left on device")
    log = Background(full, "run.mcap", said.append)
    for k in range(50):
        log.write(0.1 * k, row(1.0))
    log.close()
    assert said == ["run.mcap: No space left on device; the run goes on, the file ends here"]
    full.close.assert_called_once_with()


def test_the_background_writes_all_rows_in_order(tmp_path):
    scenario = sd.load_scenario("paper")
    log = Background(open_log(tmp_path / "run.mcap", scenario), "run.mcap", print)
    for k in range(200):
        log.write(0.1 * k, {"pose": np.full(6, float(k))})
    log.close()
    read = sd.read_log(tmp_path / "run.mcap")
    assert np.array_equal(read.pose[:, 2], np.arange(200.0)) and "rates" not in read


@pytest.mark.slow
def test_machine_and_controller_log_a_live_run(tmp_path):
    port = free_port()
    listener = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    listener.bind(("127.0.0.1", 0))
    scenario = sd.load_scenario("paper", None, ("plant.kind=exact",))
    how = {"port": port, "duration": 12.0, "log": tmp_path / "machine.csv"}
    machine = threading.Thread(target=sd.run_machine, args=(scenario,), kwargs=how)
    machine.start()
    time.sleep(1.0)
    mirror = f"127.0.0.1:{listener.getsockname()[1]}"
    how = {"duration": 2.0, "accept_jitter": True, "log": tmp_path / "live.mcap", "mirror": mirror}
    result = sd.run_live(scenario, f"127.0.0.1:{port}", **how)
    machine.join()
    read = sd.read_log(tmp_path / "live.mcap")
    assert len(read.time) == len(result.signals.time)
    for name in ("pose", "torque_commanded", "torque_applied", "measurement"):
        assert np.array_equal(read[name], result.signals[name], equal_nan=True)
    listener.settimeout(5)
    first = json.loads(listener.recv(65536))
    listener.close()
    assert first["pose"]["z"] == read.pose[0, 5]
    true = sd.read_log(tmp_path / "machine.csv")
    assert len(true.time) >= len(read.time) and np.isfinite(true.pose).all()
    assert "log of " in sd.replay_log(tmp_path / "machine.csv")  # which has no reference
    with pytest.raises(ConfigError, match=r"not those sent.*expected that of its controller"):
        sd.identify(tmp_path / "machine.csv", "paper")
    # The controller measures without noise what the machine's log has as true.
    there = np.isfinite(read.measurement.values).all(axis=1)
    seen = read.measurement.values[there]
    distance = np.abs(seen[:, None, :6] - true.pose.values).max(axis=2)
    assert np.median(distance.min(axis=1)) < 1e-9
    rows = distance.argmin(axis=1)  # both logs have the torque that acts from there on
    off = true.torque_applied.values[rows] - read.torque_applied.values[there]
    assert np.median(np.abs(off).max(axis=1)) < 1e-9
